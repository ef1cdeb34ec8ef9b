# SPDX-License-Identifier: MIT
"""Run a slab with a plate, gravity, inflow and almost no flow on any number of processes, and write its state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.2, 1.3], [12, 13])
slab = mpm.box(grid, [0, 0], [1, 1.03])
soil = mpm.Hencky(bulk=4e6 / 3, shear=1e6, conductivity=1e-9, biot=0.9, grain_bulk=1e9)
simulation = mpm.Simulation(
    grid,
    [slab],
    [soil],
    fluid=mpm.Fluid(),
    walls={"left": "x", "bottom": "y"},
    conditions=[
        mpm.Drained("right", pressure=50.0),
        mpm.Inflow("left", 1e-9),
        mpm.RigidPlate("top", lambda t: 2e4 * t),
        mpm.Pressure("right", 50.0),
    ],
    gravity=lambda t: (0, -9.81 * t),
)
result = simulation.run(1.0, 0.5, progress=False)
if state := gathered(simulation, p=simulation.points.pressure, stress=simulation.effective_stress()):
    np.savez(sys.argv[1], **state, balance=result.balance)
