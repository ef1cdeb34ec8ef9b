# SPDX-License-Identifier: MIT
"""Load, unload and reload a beam of two bodies, of clay in plane strain and in 3D, on any number of processes."""

import sys

import numpy as np
from helpers import SOFT

import mpm_dolfinx as mpm

CLAY = mpm.Hencky(bulk=1.7e8, shear=3.4e6)  # nu = 0.49


def cycled(dim):
    """Return a simulation after one and a half load cycles."""
    grid = mpm.Grid([0] * dim, [1.3, *[0.4] * (dim - 2), 1.0], [13, *[4] * (dim - 2), 10])
    lower, upper = [0.0, *[0.13] * (dim - 2), 0.43], [1.0, *[0.33] * (dim - 2), 0.63]
    bodies = [mpm.box(grid, lower, [0.55, *upper[1:]]), mpm.box(grid, [0.55, *lower[1:]], upper, material=3 - dim)]
    load = mpm.Traction("top", lambda t: [0.0] * (dim - 1) + [-8e3 * (1 - abs(2 * (t % 1) - 1))])
    s = mpm.Simulation(grid, bodies, [SOFT, CLAY], walls={"left": "xyz"[:dim]}, conditions=[load])
    s.run(1.5, 0.5, progress=False)
    return s


out = {}
for dim in (2, 3):
    s = cycled(dim)
    parts = s.grid.comm.gather((s.points.id, s.points.x, s.points.pressure, s.effective_stress()))
    if parts:
        ids, x, p, stress = (np.concatenate(a) for a in zip(*parts, strict=True))
        order = np.argsort(ids)
        out |= {f"x{dim}": x[order], f"stress{dim}": stress[order]}
        out["counts"] = [len(part[0]) for part in parts]
if out:
    x, stress = (np.concatenate([out[f"{name}{dim}"].ravel() for dim in (2, 3)]) for name in ("x", "stress"))
    np.savez(sys.argv[1], x=x, p=np.zeros(1), stress=stress, balance=0.0, counts=out["counts"])
