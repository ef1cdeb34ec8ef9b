# SPDX-License-Identifier: MIT
"""Push a side of two soils into cells of many sizes, on any number of processes, and write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid(lines=mpm.graded([0, 0], [3, 2.5], [[[0, 0.6], [0.6, 1.4]]], 0.1, 1.3, 0.3))
assert not grid.even and grid.lines is not None
bodies = [mpm.box(grid, [0, 0], [2.5, 0.7]), mpm.box(grid, [0, 0.7], [2.5, 1.3], material=1)]
sand = mpm.DruckerPrager(bulk=4e6, shear=2e6, friction=30, dilation=5, cohesion=1e4, conductivity=1e-4)
gel = mpm.NeoHookean(bulk=2e6, shear=1e6, conductivity=1e-5)
push = mpm.Displacement("top", lambda t, X: (0, -0.1 * t), region=((0, 0), (0.45, 2)))
acting = {"conditions": [push, mpm.Drained("right"), mpm.Drained("top", region=((0.45, 0), (3, 2)))]}
walls = {"bottom": "xy", "left": "x"}
simulation = mpm.Simulation(grid, bodies, [sand, gel], fluid=mpm.Fluid(), walls=walls, **acting)
result = simulation.run(1.0, 0.5, progress=False)
if state := gathered(simulation):
    np.savez(sys.argv[1], **state, balance=result.balance)
