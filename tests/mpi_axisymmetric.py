# SPDX-License-Identifier: MIT
"""Push a rough disc into a ring of two layers of soil, on any number of processes, and write the state."""

import sys

import numpy as np

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.6, 1.3], [16, 13], axisymmetric=True)
bodies = [mpm.box(grid, [0, 0], [1.03, 0.5]), mpm.box(grid, [0, 0.5], [1.03, 1.0], material=1)]
sand = mpm.DruckerPrager(bulk=4e6, shear=2e6, friction=30, dilation=5, cohesion=1e4, conductivity=1e-4)
gel = mpm.NeoHookean(bulk=2e6, shear=1e6, conductivity=1e-5)
push = mpm.Displacement("top", lambda t, X: (0, -0.1 * t), region=((0, 0), (0.45, 2)))
drained = [mpm.Drained("right"), mpm.Drained("top", region=((0.45, 0), (2, 2)))]
acting = {"conditions": [push, *drained, mpm.Pressure("right", 2e4)]}
simulation = mpm.Simulation(grid, bodies, [sand, gel], fluid=mpm.Fluid(), walls={"bottom": "xy"}, **acting)
result = simulation.run(1.0, 0.2, progress=False)
stress, points = simulation.effective_stress(), simulation.points
columns = (points.id, points.x, points.pressure, stress, points.F, points.data["hardened"])
acts = np.concatenate([simulation.reactions.array.ravel(), simulation.outflows.array])
parts = simulation.grid.comm.gather(columns)
if parts:
    ids, x, p, s, F, hardened = (np.concatenate(a) for a in zip(*parts, strict=True))
    assert hardened.max() > 1e-3
    order = np.argsort(ids)
    state = {"x": x, "p": p, "stress": s, "F": F, "hardened": hardened}
    counts = [len(part[0]) for part in parts]
    state = {k: v[order] for k, v in state.items()} | {"reactions": acts[:2], "outflows": acts[2:]}
    np.savez(sys.argv[1], **state, balance=result.balance, counts=counts, walls=simulation.wall_reactions.array)
