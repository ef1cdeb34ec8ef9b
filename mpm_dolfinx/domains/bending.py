# SPDX-License-Identifier: MIT
"""Displacement of the corners of particle domains: the Q1 field of the grid with a quadratic correction.

The strain of a Q1 field jumps at the grid lines.  The correction removes these jumps.  The displacement u of a corner
at x is

    u(x) = sum_i N_i(x) [u_i - 1/2 sum_a t_a (1 - t_a) D_a],

where N_i are the shape functions, u_i are the nodal displacements, and t_a is the position along axis a in the cell,
from 0 to 1.  D_a is a limited second difference of nodal displacements along axis a: the minmod of the second
differences at both ends of the cell edge at node i.  If only one end has a second difference, D_a is this difference.
With inertia, D_a is zero in this case, because stresses would otherwise oscillate at surfaces on grid lines.  The field
u is continuous, and exact for quadratic displacements.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import Grid, corner_bits, in_chunks, polynomial


def followed(
    grid: Grid,
    cells: NDArray[np.int32],
    x: NDArray[np.float64],
    u: NDArray[np.float64],
    filled: NDArray[np.bool_],
    one_sided: bool = True,
) -> NDArray[np.float64]:
    """Return two fields (2, n, d), in m: the Q1 displacement of the corners, and its quadratic correction.

    `cells` (n,): owned cells that contain the corners.
    `x` (n, d), in m: positions of the corners.
    `u` (nodes, d), in m: nodal displacements.
    `filled` (cells,): whether local cells contain material.
    `one_sided`: whether a second difference at one end of an edge is enough for a correction.
    """
    used = np.bincount(cells, minlength=1).nonzero()[0]
    slot = np.zeros(used.max(initial=0) + 1, dtype=np.intp)
    slot[used] = np.arange(len(used))
    field = grid.over_edges(grid.monomials @ _at(u, grid.cell_nodes[used]), used)
    bends = _second_differences(grid, used, u, filled, one_sided)
    out = np.empty((2, *x.shape))
    # the last axis is the corner: numpy takes six times as long for rows of a few numbers each
    for part in in_chunks(len(x)):
        slots, y = slot[cells[part]], (x[part] - grid.midpoints[cells[part]]).T.copy()
        out[0, part] = polynomial(field, y, slots).T
        h = grid.sizes(cells[part]).reshape(-1, grid.dim).T
        weights = 0.5 * ((y / h) ** 2 - 0.25)  # t (t - 1) / 2
        out[1, part] = sum(weights[a] * polynomial(bends[a], y, slots, a) for a in range(grid.dim)).T
    return out


def _at(u: NDArray[np.float64], nodes: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the values of a nodal field at nodes."""
    return u.take(u.shape[1] * nodes.T[None] + np.arange(u.shape[1])[:, None, None])


def _second_differences(
    grid: Grid, cells: NDArray[np.int32], u: NDArray[np.float64], filled: NDArray[np.bool_], one_sided: bool
) -> list[NDArray[np.float64]]:
    """Return the second differences along the edges of owned cells, for each axis.

    A polynomial interpolates between the edges of each cell.  Its coefficients are returned, see `polynomial`.
    """
    d = grid.dim
    bits = corner_bits(grid.dim)
    out = []
    order = np.lexsort(grid.signs.T)  # order of the nodes that matches `bits`
    nodes, neighbours = grid.cell_nodes[cells], grid.neighbours(cells)
    for a in range(d):
        low, high = order[bits[:, a] == 0], order[bits[:, a] == 1]
        first, last = _at(u, nodes[:, low]), _at(u, nodes[:, high])
        along, h = last - first, grid.along(cells, a)
        ends = []
        known = []
        for k, (end, value) in enumerate(((low, first), (high, last))):
            local = neighbours[:, a, k]
            beyond = grid.cell_nodes[local][:, end]
            known.append((local >= 0) & filled[local])
            g = grid.along(local, a)  # below: h^2 times the second derivative of a parabola
            ends.append(2 * h / (h + g) * (h / g * (_at(u, beyond) - value) - (2 * k - 1) * along))
        first, last = np.where(known[0], *ends), np.where(known[1], *ends[::-1])
        smaller = np.where(np.abs(first) < np.abs(last), first, last)
        enough = known[0] | known[1] if one_sided else known[0] & known[1]
        bend = np.where((first * last > 0) & enough, smaller, 0.0)
        across = grid.monomials[np.arange(2**d) >> a & 1 == 0]  # the same at both ends
        bend = (across[:, low] + across[:, high]) @ bend
        if not grid.even:  # coefficients for offsets in m
            rows = (np.arange(2**d) >> a & 1 == 0).nonzero()[0]
            whole = np.zeros((d, 2**d, len(cells)))
            whole[:, rows] = bend
            bend = grid.over_edges(whole, cells)[:, rows]
        out.append(bend)
    return out
