# SPDX-License-Identifier: MIT
"""The displacement that corners of domains follow: the Q1 field of the grid, without its kinks.

In bending the true strain varies linearly over a cell, that of a Q1 field does not: it jumps at the grid lines.
Domains that followed it would take along a sawtooth, and on the way back, with other grid lines across the body, leave
it as stress.  So corners follow the field with its second differences along each axis,

    u(x) = sum_i N_i(x) [u_i - 1/2 sum_a t_a (1 - t_a) D_a],

t_a in [0, 1] the place in the cell: exact for quadratic fields, Q1 at the nodes, and continuous.  D_a is the second
difference along the edge of the cell that node i ends: the smaller one of those at its two ends, zero where their signs
differ, and that of one end where the other has none.  So a kink that is no error of the grid, as between materials,
stays one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.forms.point_forms import CHUNK
from mpm_dolfinx.points.cutting import corner_bits
from mpm_dolfinx.points.grid import Grid


def followed(
    grid: Grid, cells: NDArray[np.int32], x: NDArray[np.float64], u: NDArray[np.float64], active: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the Q1 field at corners, and what they follow besides (2, m, d), m.

    Parameters
    ----------
    cells, x : (m,), (m, d), m
        Owned cells that the corners lie in, and their positions.
    u : (nodes, d), m
        Nodal displacements.
    active : (nodes,)
        Which nodes belong to cells that hold something.
    """
    used = np.flatnonzero(np.bincount(cells, minlength=1))
    slot = np.zeros(used.max(initial=0) + 1, dtype=np.intp)
    slot[used] = np.arange(len(used))
    nodal = np.concatenate([u[grid.cell_nodes[used]], *_second_differences(grid, used, u, active)], axis=2)
    out = np.empty((2, *x.shape))
    for part in (slice(start, start + CHUNK) for start in range(0, len(x), CHUNK)):
        here = cells[part]
        N, t = grid.shape_values(here, x[part]), (x[part] - grid.midpoints[here]) / grid.h + 0.5
        values = np.einsum("mk,mkd->md", N, np.take(nodal, slot[here], axis=0)).reshape(len(t), -1, t.shape[1])
        out[0, part] = values[:, 0]
        out[1, part] = np.einsum("ma,mad->md", 0.5 * t * (t - 1), values[:, 1:])
    return out


def _second_differences(
    grid: Grid, cells: NDArray[np.int32], u: NDArray[np.float64], active: NDArray[np.bool_]
) -> list[NDArray[np.float64]]:
    """Return the second differences (cells, 2^d, d), m, along the edges of owned cells, an array an axis."""
    d, bits, out = grid.dim, corner_bits(grid.dim), []
    order = np.lexsort(grid.signs.T)  # of the nodes, as `bits` has them
    nodes, beside = grid.cell_nodes[cells], grid.beside(cells)
    for a in range(d):
        low, high = (order[bits[:, a] == end] for end in (0, 1))
        along = u[nodes[:, high]] - u[nodes[:, low]]
        ends, known = [], []
        for k, end in enumerate((low, high)):
            local = beside[:, a, k]
            beyond = grid.cell_nodes[local][:, end]
            known.append((local >= 0)[:, None] & active[beyond])
            ends.append(u[beyond] - u[nodes[:, end]] - (2 * k - 1) * along)
        first, last = (np.where(known[k][:, :, None], ends[k], ends[1 - k]) for k in (0, 1))
        smaller = np.where(first * last > 0, np.where(np.abs(first) < np.abs(last), first, last), 0.0)
        bend = np.empty((len(cells), 2**d, d))
        bend[:, low] = bend[:, high] = np.where((known[0] | known[1])[:, :, None], smaller, 0.0)
        out.append(bend)
    return out
