# SPDX-License-Identifier: MIT
"""Push a rough disc into a ring of two layers of soil, on any number of processes, and write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.6, 1.3], [16, 13], axisymmetric=True)
bodies = [mpm.box(grid, [0, 0], [1.03, 0.5]), mpm.box(grid, [0, 0.5], [1.03, 1.0], material=1)]
sand = mpm.DruckerPrager(bulk=4e6, shear=2e6, friction=30, dilation=5, cohesion=1e4, conductivity=1e-4)
gel = mpm.NeoHookean(bulk=2e6, shear=1e6, conductivity=1e-5)
push = mpm.Displacement("top", lambda t, X: (0, -0.1 * t), region=((0, 0), (0.45, 2)))
drained = [mpm.Drained("right"), mpm.Drained("top", region=((0.45, 0), (2, 2)))]
acting = {"conditions": [push, *drained, mpm.Pressure("right", 2e4)]}
simulation = mpm.Simulation(grid, bodies, [sand, gel], fluid=mpm.Fluid(), walls={"bottom": "xy"}, **acting)
result = simulation.run(1.0, 0.5, progress=False)
points = simulation.points
stress, hardened = simulation.effective_stress(), points.data["hardened"]
acts = {"reactions": simulation.reactions.array.ravel(), "outflows": simulation.outflows.array}
if state := gathered(simulation, p=points.pressure, stress=stress, F=points.F, hardened=hardened):
    assert state["hardened"].max() > 1e-3
    np.savez(sys.argv[1], **state, **acts, balance=result.balance, walls=simulation.wall_reactions.array)
