# SPDX-License-Identifier: MIT
"""Move two wet soils, boxes or meshes, with fields of materials, on any number of processes, and write the memory.

The script also writes a checkpoint, reads the checkpoint of a single process in the same folder, and measures both.
"""

import sys
import tracemalloc
from pathlib import Path

import numpy as np
import scaling
from meshes import box_mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.io.checkpoint import save

file = sys.argv[1]
points, seen = float(sys.argv[2]), []


def stiffness(X):
    seen.append(len(X))
    return 4e6 * (2 - X[:, 1])


def peak(action):
    """Return the largest memory of Python and numpy in an action on this process, in bytes."""
    tracemalloc.start()
    action()
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


h = 2 * np.sqrt(2 / points)
grid = mpm.Grid([0, 0], [2 + 4 * h, 1 + 4 * h], [round(2 / h) + 4, round(1 / h) + 4])
ends = [((0, 0), (2, 0.3)), ((0, 0.3), (2, 1))]
if sys.argv[3:] == ["meshes"]:
    counts = [[round(2 * (b - a) / h) for a, b in zip(*of, strict=True)] for of in ends]
    meshes = [box_mesh("quad", count, *of) for count, of in zip(counts, ends, strict=True)]
    bodies = [mpm.from_mesh(grid, mesh, material=i) for i, mesh in enumerate(meshes)]
else:
    bodies = [mpm.box(grid, *of, material=i) for i, of in enumerate(ends)]
sand = mpm.DruckerPrager(bulk=stiffness, shear=2e6, friction=30, dilation=5, cohesion=1e4, conductivity=1e-4)
gel = mpm.NeoHookean(bulk=2e6, shear=lambda X: 1e6 * (1 + X[:, 0]), conductivity=1e-5)
WHOLE = {*map(len, bodies), grid.cells, grid.nodes}
acting = {"conditions": [mpm.Traction("top", lambda t: (1e3 * t, -1e4 * t)), mpm.Drained("top")]}
walls = {"bottom": "xy", "left": "x", "right": "x"}
s = mpm.Simulation(grid, bodies, [sand, gel], fluid=mpm.Fluid(), walls=walls, **acting)
s.run(0.1, 0.1, progress=False)
bytes_of, lengths = scaling.held(s, buffers=False)
files = bytes_of.pop("files")
row = [len(s.points), max(seen, default=0), sum(bytes_of.values()), len(lengths & WHOLE), files]
row.append(peak(lambda: save(s, Path(f"{file}-{grid.comm.size}.checkpoint"))))
row.append(peak(lambda: mpm.resume(s, f"{file}-1.checkpoint")))
names = ("points", "asked", "held", "whole", "files", "written", "read")
if rows := grid.comm.gather(row):
    np.savez(f"{file}-{grid.comm.size}.npz", **dict(zip(names, np.array(rows).T, strict=True)))
