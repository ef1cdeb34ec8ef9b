# SPDX-License-Identifier: MIT
"""Run blocks on grids with so few cells that some processes have no cells or faces, and write the settlements."""

import sys

import numpy as np

import mpm_dolfinx as mpm

SHAPES = [(1, 2), (2, 2), (1, 1, 3)]
soil = mpm.Hencky(bulk=1e8, shear=6e7, conductivity=1e-4)
tops, worst = [], 0.0
for shape in SHAPES:
    dim = len(shape)
    grid = mpm.Grid([0] * dim, np.array(shape, dtype=float), shape)
    top = np.array([*shape[:-1], shape[-1] - 0.4])
    body = mpm.box(grid, [0] * dim, top)
    walls = {"left": "x", "right": "x", "bottom": "xyz"[:dim]} | ({"front": "y", "back": "y"} if dim == 3 else {})
    s = mpm.Simulation(
        grid,
        [body],
        [soil],
        fluid=mpm.Fluid(),
        walls=walls,
        conditions=[mpm.Traction("top", -1e4), mpm.Drained("top")],
        gravity=(0,) * (dim - 1) + (-9.81,),
    )
    result = s.run(2.0, 1.0, progress=False, probes=mpm.probes([body], [top]))
    tops.append(result.displacement[-1][0, -1])
    worst = max(worst, result.balance)
    counts = grid.comm.allgather(grid.num_owned)
    assert min(counts) > 0 or sum(counts) < grid.comm.size, counts
assert max(tops) < -1e-6
if grid.comm.rank == 0:
    np.savez(sys.argv[1], x=tops, tops=tops, balance=worst, counts=counts)
