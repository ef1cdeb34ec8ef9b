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

from mpm_dolfinx.grid import Grid, sum_by

SNAP = 1e-10  # cells: vertices this close to a grid plane are taken to lie on it
SLIVER = 1e-12  # of the domain: smaller pieces are dropped; less than a piece that is SNAP thin, whose face is open
TANGLED = 0.2  # of its volume: a domain whose corners span less is re-derived from F


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


def tangled(corners: NDArray[np.float64], volume: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which domains (n, 2^d, d) have folded: their corners span far less, or more, than their volume (n,)."""
    simplices = corners[:, kuhn_simplices(corners.shape[2])]
    spanned = np.linalg.det(simplices[:, :, 1:] - simplices[:, :, :1]) * _ORIENTATION[corners.shape[2]]
    ratio = spanned.mean(axis=1) / volume
    return (ratio < TANGLED) | (ratio > 1 / TANGLED)


def parallelepipeds(
    x: NDArray[np.float64], F: NDArray[np.float64], spacing: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the corners (n, 2^d, d), m, of boxes of size `spacing` (n, d) about x (n, d), deformed by F (n, d, d)."""
    offset = (corner_bits(x.shape[1]) - 0.5) * spacing[:, None, :]
    return x[:, None] + np.einsum("nab,nkb->nka", F, offset)


_ORIENTATION = {d: np.sign(np.linalg.det(np.diff(corner_bits(d)[kuhn_simplices(d)], axis=1))) for d in (2, 3)}


def cut(grid: Grid, corners: NDArray[np.float64]) -> Pieces:
    """Cut the domains by the grid.

    Parameters
    ----------
    corners : (n, 2^d, d), m
        Corners of the domains, inside the grid; corner k has the ends `corner_bits(d)[k]`.

    Returns
    -------
    The pieces, slivers below 1e-12 of their domain left out; fractions sum to one for every domain.
    """
    d = grid.dim
    y = np.ascontiguousarray(((corners - grid.lower) / grid.h).transpose(1, 2, 0))
    nearest = np.rint(y)
    y = np.where(np.abs(y - nearest) < SNAP, nearest, y)
    # simplices (d+1, d, m): vertices and coordinates first, which keeps the loops below in numpy's fast lanes
    s = np.concatenate([y[corner] for corner in kuhn_simplices(d)], axis=2)
    owner = np.tile(np.arange(len(corners)), s.shape[2] // max(1, len(corners)))
    for axis in range(d):
        s, owner = _slice(s, owner, axis)
    return _sum(grid, y, s, owner)


def _volume(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the volumes of simplices (d+1, d, m)."""
    e = s[1:] - s[0]
    if len(e) == 2:
        return np.abs(e[0, 0] * e[1, 1] - e[0, 1] * e[1, 0]) / 2
    return np.abs(np.einsum("am,am->m", e[0], np.cross(e[1], e[2], axis=0))) / 6


def _sum(grid: Grid, y: NDArray[np.float64], s: NDArray[np.float64], owner: NDArray[np.int64]) -> Pieces:
    """Sum the simplices by (point, cell) into pieces."""
    d, n = grid.dim, y.shape[2]
    volume, x, top = _volume(s), s.mean(axis=0), (grid.shape - 1)[:, None]
    index = np.clip(np.floor(x).astype(np.int64), 0, top)
    low = np.clip(np.floor(y.min(axis=0)).astype(np.int64), 0, top)
    high = np.clip(np.floor(y.max(axis=0)).astype(np.int64), 0, top)
    span = high - low + 1  # cells that the domain's bounding box touches
    count = span.prod(axis=0)
    start = np.concatenate([[0], np.cumsum(count)])
    slot = np.zeros(len(owner), dtype=np.int64)
    for a in range(d):
        slot = slot * span[a][owner] + (index[a] - low[a][owner])
    slot += start[owner]

    def total(values):
        return sum_by(slot, values, start[-1])

    sums = total(volume)
    whole = sum_by(owner, volume, n)
    point = np.repeat(np.arange(n), count)
    kept = np.flatnonzero(sums > SLIVER * whole[point])
    point, sums = point[kept], sums[kept]
    centroid = np.stack([total(volume * x[a])[kept] / sums for a in range(d)], axis=1)

    rest = kept - start[point]
    cell = np.empty((len(kept), d), dtype=np.int64)
    for a in reversed(range(d)):
        cell[:, a] = low[a][point] + rest % span[a][point]
        rest //= span[a][point]

    faces = np.zeros((len(kept), d, 2))
    solid = volume > 1e-13  # a vertex on a plane leaves simplices whose height is rounding
    for a in range(d):
        for end in (0, 1):
            distance = np.abs(s[:, a] - (index[a] + end))
            height = distance.max(axis=0)
            near = distance < np.minimum(2 * SNAP, height / 2)  # of two domains that touch, rounding may snap one only
            on = np.flatnonzero((near.sum(axis=0) == d) & solid)  # a facet lies on the plane
            area = d * volume[on] / height[on]
            area = sum_by(slot[on], area, start[-1])[kept]
            faces[:, a, end] = area * grid.cell_volume / grid.h[a]

    # centroids stay off the grid lines, and inside the cell that they belong to
    centroid = np.clip(centroid, cell + SNAP, cell + 1 - SNAP)
    fraction = sums / sum_by(point, sums, n)[point]
    return Pieces(point, grid.number(cell), fraction, grid.lower + grid.h * centroid, faces)


def cut_faces(
    grid: Grid, corners: NDArray[np.float64], local: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Cut faces of domains by the grid; return points of integration, exact for what P1 makes of a face in a cell.

    A force on a face that crosses a grid line belongs to the nodes on both sides by what lies there: with one
    point a face, what is left over moves nodes of partly filled cells in every step, for ever.

    Parameters
    ----------
    corners : (m, 2^(d-1), d), m
        Corners of the faces.
    local : (m, 2^(d-1), e)
        Coordinates of the corners to be interpolated.

    Returns
    -------
    Of each point: its face, its position (n, d), its local coordinates (n, e), its share of the face; and the
    middle (n, d) of the part of the face in one cell that it belongs to.
    """
    d, m = grid.dim, len(corners)
    y = (corners - grid.lower) / grid.h
    nearest = np.rint(y)
    y = np.where(np.abs(y - nearest) < SNAP, nearest, y)
    both = np.concatenate([y, local], axis=2).transpose(1, 2, 0)
    split = kuhn_simplices(d - 1)
    s = np.concatenate([both[list(simplex)] for simplex in split], axis=2)
    owner = np.arange(s.shape[2])
    whole = s
    for axis in range(d):
        s, owner = _slice(s, owner, axis)
    # the local coordinates tell sizes, for they are never degenerate
    share = _size(s[:, d:]) / _size(whole[:, d:])[owner] / len(split)
    solid = share > 0  # a corner on a plane leaves parts without size
    s, owner, share = s[:, :, solid], owner[solid], share[solid]
    points = np.einsum("qk,kam->qam", _RULES[d], s)
    middle = np.tile((grid.lower + grid.h * s[:, :d].mean(axis=0).T), (len(points), 1))
    points = points.transpose(0, 2, 1).reshape(-1, both.shape[1])
    face = np.tile(owner % max(1, m), d)
    return face, grid.lower + grid.h * points[:, :d], points[:, d:], np.tile(share / d, d), middle


def _size(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return lengths or areas, up to a factor, of segments or triangles (k+1, e, m)."""
    e = s[1:] - s[0]
    return np.sqrt(np.abs(np.linalg.det(np.einsum("iam,jam->mij", e, e))))


_RULES = {  # barycentric points of equal weight, exact to second order on segments and triangles
    2: 0.5 + np.array([[1, -1], [-1, 1]]) / np.sqrt(12),
    3: (1 + 3 * np.eye(3)) / 6,
}


def _slice(s: NDArray[np.float64], owner: NDArray[np.int64], axis: int):
    """Slice simplices by the integer planes of an axis until none crosses a plane."""
    done_s, done_owner = [], []
    while True:
        t = s[:, axis]
        plane = np.floor(t.min(axis=0)) + 1
        crossing = t.max(axis=0) > plane
        if not crossing.any():
            break
        done_s.append(s[:, :, ~crossing])
        done_owner.append(owner[~crossing])
        below, below_owner, s, owner = _cut_at(s[:, :, crossing], owner[crossing], axis, plane[crossing])
        done_s.append(below)
        done_owner.append(below_owner)
    return (np.concatenate([s, *done_s], axis=2), np.concatenate([owner, *done_owner])) if done_s else (s, owner)


def _cut_at(s, owner, axis: int, plane):
    """Cut each simplex at its plane; return the parts below and above with their owners."""
    order = np.argsort(s[:, axis], axis=0)
    s = np.take_along_axis(s, order[:, None], axis=0)
    count = (s[:, axis] < plane).sum(axis=0)  # vertices below the plane
    dim = len(s) - 1
    parts = {"below": [s[:, :, :0]], "above": [s[:, :, :0]]}
    owners = {"below": [owner[:0]], "above": [owner[:0]]}
    for k in range(1, dim + 1):
        chosen = np.flatnonzero(count == k)
        v, c = s[:, :, chosen], plane[chosen]
        points = {(i,): v[i] for i in range(dim + 1)}
        for i in range(k):
            for j in range(k, dim + 1):
                points[i, j] = _on_plane(v[i], v[j], axis, c)
        for where, simplices in _CUTS[dim][k].items():
            parts[where] += [np.stack([points[p] for p in simplex]) for simplex in simplices]
            owners[where] += [owner[chosen]] * len(simplices)
    return (
        np.concatenate(parts["below"], axis=2),
        np.concatenate(owners["below"]),
        np.concatenate(parts["above"], axis=2),
        np.concatenate(owners["above"]),
    )


def _on_plane(a, b, axis: int, plane):
    """Return the points where the edges from a to b meet the plane, exactly on it."""
    t = (plane - a[axis]) / (b[axis] - a[axis])
    x = a + t * (b - a)
    x[axis] = plane
    return x


def _prism(a, b):
    """Return the 3 tetrahedra of the prism with triangles a and b."""
    return [(a[0], a[1], a[2], b[2]), (a[0], a[1], b[1], b[2]), (a[0], b[0], b[1], b[2])]


_A, _B, _C, _D = (0,), (1,), (2,), (3,)
# vertices are sorted along the axis; (i, j) is the point where the edge from i to j meets the plane
_CUTS = {
    1: {1: {"below": [(_A, (0, 1))], "above": [((0, 1), _B)]}},
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
