# SPDX-License-Identifier: MIT
"""The points' domains, cut by the grid into pieces that lie in one cell each.

A point stands for a quadrilateral or hexahedron of tracked corners.  Its pieces carry exact volumes
and centroids: gradients of P1 functions are linear within a cell, so one row of integration data a
piece integrates them exactly, and the answer does not depend on how points lie on the grid.

The domains are split into simplices (2 triangles, or the 6 Kuhn tetrahedra, whose faces match those
of the neighbours), all simplices are sliced by the grid planes of one axis after the other, and the
slices are summed by (point, cell).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid import Grid

SNAP = 1e-10  # cells: vertices this close to a grid plane are taken to lie on it
SLIVER = 1e-9  # of the domain: smaller pieces are dropped


@dataclass
class Pieces:
    """Domains cut by the cells; arrays over the pieces, ordered by point.

    point : (m,) index of the domain; cell : (m,) lexicographic number of the cell;
    fraction : (m,) share of the domain's volume; x : (m, d) centroid, m;
    faces : (m, d, 2) area of the piece on the lower and upper face of its cell, m^(d-1).
    """

    point: NDArray[np.int64]
    cell: NDArray[np.int64]
    fraction: NDArray[np.float64]
    x: NDArray[np.float64]
    faces: NDArray[np.float64]


def corner_bits(dim: int) -> NDArray[np.int64]:
    """Return the (2^d, d) ends (0 lower, 1 upper) of the corners of a domain along each axis."""
    return (np.arange(2**dim)[:, None] >> np.arange(dim)) & 1


def kuhn_simplices(dim: int) -> NDArray[np.int64]:
    """Return the (d!, d+1) corners of the simplices that a domain is split into."""
    return np.array([[sum(1 << a for a in p[:k]) for k in range(dim + 1)] for p in permutations(range(dim))])


def cut(grid: Grid, corners: NDArray[np.float64]) -> Pieces:
    """Cut the domains by the grid.

    Parameters
    ----------
    corners : (n, 2^d, d), m
        Corners of the domains, inside the grid; corner k has the ends `corner_bits(d)[k]`.

    Returns
    -------
    The pieces, slivers below 1e-9 of their domain left out; fractions sum to one for every domain.
    """
    d = grid.dim
    y = (corners - grid.lower) / grid.h
    nearest = np.rint(y)
    y = np.where(np.abs(y - nearest) < SNAP, nearest, y)
    simplices = kuhn_simplices(d)
    s = y[:, simplices].reshape(-1, d + 1, d)
    owner = np.repeat(np.arange(len(corners)), len(simplices))
    for axis in range(d):
        s, owner = _slice(s, owner, axis)

    volume = np.abs(np.linalg.det(s[:, 1:] - s[:, :1])) if d == 3 else _triangle(s)
    volume /= 1 if d == 2 else 6
    x = s.mean(axis=1)
    index = np.clip(np.floor(x).astype(np.int64), 0, grid.shape - 1)
    return _sum(grid, len(corners), y, s, owner, volume, x, index)


def _triangle(s: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b = s[:, 1] - s[:, 0], s[:, 2] - s[:, 0]
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _sum(grid, n, y, s, owner, volume, x, index) -> Pieces:
    """Sum the simplices by (point, cell) into pieces."""
    d = grid.dim
    low = np.clip(np.floor(y.min(axis=1)).astype(np.int64), 0, grid.shape - 1)
    high = np.clip(np.floor(y.max(axis=1)).astype(np.int64), 0, grid.shape - 1)
    span = high - low + 1  # cells that the domain's bounding box touches
    start = np.concatenate([[0], np.cumsum(span.prod(axis=1))])
    slot, width = np.zeros(len(s), dtype=np.int64), span[owner]
    for a in range(d):
        slot = slot * width[:, a] + (index[:, a] - low[owner, a])
    slot += start[owner]

    def total(values):
        return np.bincount(slot, weights=values, minlength=start[-1])

    sums = total(volume)
    whole = np.bincount(owner, weights=volume, minlength=n)
    point = np.repeat(np.arange(n), span.prod(axis=1))
    kept = np.flatnonzero(sums > SLIVER * whole[point])
    point, sums = point[kept], sums[kept]
    centroid = np.stack([total(volume * x[:, a])[kept] / sums for a in range(d)], axis=1)

    rest = kept - start[point]
    cell = np.empty((len(kept), d), dtype=np.int64)
    for a in reversed(range(d)):
        cell[:, a] = low[point, a] + rest % span[point, a]
        rest //= span[point, a]

    faces = np.zeros((len(kept), d, 2))
    for a in range(d):
        for end in (0, 1):
            plane = (index[:, a] + end)[:, None]
            distance = np.abs(s[:, :, a] - plane)
            on = (distance == 0).sum(axis=1) == d  # the facet opposite to the last vertex lies on the plane
            area = np.zeros(len(s))
            area[on] = d * volume[on] / distance[on].max(axis=1)
            faces[:, a, end] = total(area)[kept] * grid.cell_volume / grid.h[a]

    # centroids stay off the grid lines, and inside the cell that they belong to
    centroid = np.clip(centroid, cell + SNAP, cell + 1 - SNAP)
    fraction = sums / np.bincount(point, weights=sums, minlength=n)[point]
    return Pieces(point, grid.number(cell), fraction, grid.lower + grid.h * centroid, faces)


def _slice(s: NDArray[np.float64], owner: NDArray[np.int64], axis: int):
    """Slice simplices by the integer planes of an axis until none crosses a plane."""
    done_s, done_owner = [], []
    while len(s):
        t = s[:, :, axis]
        plane = np.floor(t.min(axis=1)) + 1
        crossing = t.max(axis=1) > plane
        done_s.append(s[~crossing])
        done_owner.append(owner[~crossing])
        below, below_owner, s, owner = _cut_at(s[crossing], owner[crossing], axis, plane[crossing])
        done_s.append(below)
        done_owner.append(below_owner)
    return np.concatenate(done_s), np.concatenate(done_owner)


def _cut_at(s, owner, axis: int, plane):
    """Cut each simplex at its plane; return the parts below and above with their owners."""
    order = np.argsort(s[:, :, axis], axis=1)
    s = np.take_along_axis(s, order[:, :, None], axis=1)
    count = (s[:, :, axis] < plane[:, None]).sum(axis=1)  # vertices below the plane
    dim = s.shape[2]
    parts = {"below": [], "above": []}
    owners = {"below": [], "above": []}
    for k in range(1, dim + 1):
        chosen = np.flatnonzero(count == k)
        if not len(chosen):
            continue
        v, c = s[chosen], plane[chosen]
        points = {(i,): v[:, i] for i in range(dim + 1)}
        for i in range(k):
            for j in range(k, dim + 1):
                points[i, j] = _on_plane(v[:, i], v[:, j], axis, c)
        for where, simplices in _CUTS[dim][k].items():
            for simplex in simplices:
                parts[where].append(np.stack([points[p] for p in simplex], axis=1))
                owners[where].append(owner[chosen])
    empty = np.empty((0, dim + 1, dim)), np.empty(0, dtype=np.int64)
    out = []
    for where in ("below", "above"):
        out += [np.concatenate([empty[0], *parts[where]]), np.concatenate([empty[1], *owners[where]])]
    return out


def _on_plane(a, b, axis: int, plane):
    """Return the points where the edges from a to b meet the plane, exactly on it."""
    t = (plane - a[:, axis]) / (b[:, axis] - a[:, axis])
    x = a + t[:, None] * (b - a)
    x[:, axis] = plane
    return x


def _prism(a, b):
    """Return the 3 tetrahedra of the prism with triangles a and b."""
    return [(a[0], a[1], a[2], b[2]), (a[0], a[1], b[1], b[2]), (a[0], b[0], b[1], b[2])]


_A, _B, _C, _D = (0,), (1,), (2,), (3,)
# vertices are sorted along the axis; (i, j) is the point where the edge from i to j meets the plane
_CUTS = {
    2: {
        1: {"below": [(_A, (0, 1), (0, 2))], "above": [((0, 1), _B, _C), ((0, 1), _C, (0, 2))]},
        2: {"below": [(_A, _B, (1, 2)), (_A, (1, 2), (0, 2))], "above": [((0, 2), (1, 2), _C)]},
    },
    3: {
        1: {
            "below": [(_A, (0, 1), (0, 2), (0, 3))],
            "above": _prism(((0, 1), (0, 2), (0, 3)), (_B, _C, _D)),
        },
        2: {
            "below": _prism((_A, (0, 2), (0, 3)), (_B, (1, 2), (1, 3))),
            "above": _prism((_C, (0, 2), (1, 2)), (_D, (0, 3), (1, 3))),
        },
        3: {
            "below": _prism((_A, _B, _C), ((0, 3), (1, 3), (2, 3))),
            "above": [((0, 3), (1, 3), (2, 3), _D)],
        },
    },
}
