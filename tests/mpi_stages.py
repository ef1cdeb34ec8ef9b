# SPDX-License-Identifier: MIT
"""Run stages with an excavation, a fill and a moving side on any number of processes, and write the state."""

import sys

import numpy as np

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.2, 1.4], [12, 14])
boxes = [([0, 0], [1.2, 0.5]), ([0, 0.5], [0.6, 0.8]), ([0.6, 0.5], [1.2, 0.93])]
bodies = [mpm.box(grid, low, high) for low, high in boxes]
soil = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5)
walls = {"left": "x", "right": "x", "bottom": "y"}
options = {"fluid": mpm.Fluid(), "walls": walls, "gravity": (0, -9.81), "conditions": [mpm.Drained("top")]}
simulation = mpm.Simulation(grid, [*bodies[:2], mpm.Later(bodies[2])], [soil], **options)
simulation.run(1.0, 0.5, progress=False)
push = mpm.Displacement("top", lambda t, X: (0, -0.02 * (t - 1)), region=((0.0, 0.0), (0.31, 0.5)))
simulation.stage(add=[2], remove=[1], conditions=[*simulation.conditions, push], reset_displacement=True)
result = simulation.run(2.0, 0.25, probes=mpm.probes(bodies, [[0.3, 0.4], [0.9, 0.9]]), progress=False)
points = simulation.points
parts = grid.comm.gather((points.id, points.x, points.pressure, simulation.effective_stress()))
if parts:
    ids, x, p, s = (np.concatenate(a) for a in zip(*parts, strict=True))
    order = np.argsort(ids)
    np.savez(
        sys.argv[1],
        x=x[order],
        p=p[order],
        stress=s[order],
        probes=result.displacement[-1],
        reaction=simulation.reactions.array,
        balance=result.balance,
        counts=[len(part[0]) for part in parts],
    )
