# SPDX-License-Identifier: MIT
"""Shake a wet layer between tied sides, on any number of processes."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.4, 1.3], [14, 13])
layer = mpm.box(grid, [0.15, 0.13], [1.25, 1.13])
soil = mpm.Hencky(bulk=1e6, shear=6e5, grain_density=2000.0, conductivity=1e-3)
base = mpm.Displacement("bottom", lambda t: (0.01 * np.sin(20 * t), 0.0))
simulation = mpm.Simulation(
    grid,
    [layer],
    [soil],
    fluid=mpm.Fluid(),
    walls={},
    conditions=[base, mpm.Tied("left", "right"), mpm.Drained("top")],
    gravity=(1.0, -9.81),
    inertia=True,
)
result = simulation.run(0.05, 0.01, progress=False)
points = simulation.points
if state := gathered(simulation, velocity=points.velocity, pressure=points.pressure):
    np.savez(sys.argv[1], **state, balance=result.balance)
