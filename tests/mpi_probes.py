# SPDX-License-Identifier: MIT
"""Evaluate probes behind a wetting front on any number of processes, and write their pressures."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [2.0, 3.0], [4, 6])
sand = mpm.Hencky(1e7, 5e6, conductivity=1e-5, retention=mpm.VanGenuchten(4905.0, residual=0.08, n=2.2))
simulation = mpm.Simulation(
    grid,
    [mpm.box(grid, [0, 0], [1.7, 2.9])],
    [sand],
    fluid=mpm.Fluid(),
    walls={"left": "x", "bottom": "xy"},
    conditions=[mpm.Rain("top", lambda t, X: np.where(X[:, 0] < 1, 5e-6, 0.0)), mpm.Drained("bottom", 1e3)],
    gravity=(0, -9.81),
    pressure=mpm.hydrostatic(-2.0),
    initial_stress=mpm.K0(0.5),
    numerics=mpm.Numerics(tolerance=1e-10),
)
X = np.random.default_rng(1).uniform(0, [1.7, 2.9], (60, 2))
result = simulation.run(2e4, 1e4, probes=mpm.probes(simulation.bodies, X), progress=False)
probed = result.probe_pressure[-1]
if state := gathered(simulation, p=simulation.points.pressure):
    np.savez(sys.argv[1], **state, probed=probed, balance=result.balance)
