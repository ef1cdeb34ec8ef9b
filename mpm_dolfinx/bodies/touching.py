# SPDX-License-Identifier: MIT
"""Contact between seeded bodies: parts of faces in contact, and distances between domains.

Faces are quadrilaterals in 3D.  A face in 2D is an edge, extended by unit width along the third axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import NEAR, ROUND_OFF, SAME, TINY
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.grid.grid import FACE_SIGNS, FACES, Grid, corner_bits, cross_in_plane, rounding, sum_by
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn
from mpm_dolfinx.points.cutting import cut_at, kuhn_simplices

BITS = corner_bits(2)  # Source: definition
MISFIT = 1e-2
"""Largest gap or overlap of surfaces in contact, divided by the cell size."""


@dataclass
class Faces:
    """Faces of a body at seeding, after `Body.map`."""

    row: NDArray[np.int64]  # domain of the face (m,)
    index: NDArray[np.int64]  # indices of the face's corners in the domain (m, 4)
    corners: NDArray[np.float64]  # positions of the corners (m, 4, 3), m
    outward: NDArray[np.float64]  # outward area vector (m, 3), m^2
    bend: NDArray[np.float64]  # distance of the domain's edges from mapped edges (m,), m, see `Body.bend`

    @classmethod
    def of(cls, body: Body, row: NDArray[np.int64], face: NDArray[np.int64]) -> Faces:
        """Return the faces of a body with domains `row` (m,) and face indices `face` (m,)."""
        domains, dim = body.corners(row), body.dim
        outward = np.pad(face_vectors(domains, face), ((0, 0), (0, 3 - dim)))
        # in plane strain each corner occurs at both ends of axis 3
        index = FACES[dim][face] if dim == 3 else FACES[dim][face][:, BITS[:, 0]]
        corners = np.take_along_axis(domains, index[:, :, None], axis=1)
        if dim == 2:
            corners = np.concatenate([corners, np.broadcast_to(BITS[:, 1:], (len(row), 4, 1))], axis=2)
        return cls(row, index, corners, outward, body.bend(row))

    @classmethod
    def around(cls, body: Body) -> Faces:
        """Return all surface faces of a body."""
        return cls.of(body, *body.outer())

    def edge(self) -> NDArray[np.float64]:
        """Return the length (n,), in m, of the shortest edge of each face."""
        c = self.corners
        pairs = [(1, 0), (3, 2), (2, 0), (3, 1)] if (self.index[:, 0] != self.index[:, 2]).any() else [(1, 0)]
        return np.min([np.linalg.norm(c[:, i] - c[:, j], axis=1) for i, j in pairs], axis=0)


@dataclass
class Cover:
    """Pairs of faces in contact: the covered face of one body, and the covering face of another body.

    Face coordinates run from 0 to 1 along two edges of the covered face.
    """

    face: NDArray[np.int64]  # index of the covered face (n,)
    by: NDArray[np.int64]  # index of the covering face (n,)
    low: NDArray[np.float64]  # lower corner of the covering face's bounding box (n, 2), in face coordinates
    high: NDArray[np.float64]  # upper corner of this box (n, 2)
    corner: NDArray[np.int64]  # corner of this box for each corner of the covering face (n, 4); -1 for rotated faces
    t: NDArray[np.float64]  # corners of the covering face (n, 4, 2), in face coordinates
    slack: NDArray[np.float64]  # error of the face coordinates (n,)
    plane: NDArray[np.float64]  # corners of the covering face (n, 4, 2), in affine coordinates of the covered face

    def at(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the bilinear weights (n, 4) of the covering faces' corners at face coordinates t (n, 2)."""
        return np.take_along_axis(weights((t - self.low) / (self.high - self.low)), self.corner, axis=1)


def face_vectors(corners: NDArray[np.float64], face: NDArray[np.int64] | int) -> NDArray[np.float64]:
    """Return the outward area vectors (n, d), in m^(d-1), of one face of each domain (n, 2^d, d)."""
    dim = corners.shape[2]
    x = corners[np.arange(len(corners))[:, None], FACES[dim][face]]
    if dim == 2:
        t = x[:, 1] - x[:, 0]
        n = np.array([t[:, 1], -t[:, 0]]).T
    else:
        n = 0.5 * np.cross(x[:, 3] - x[:, 0], x[:, 2] - x[:, 1])
    return n * np.array(FACE_SIGNS)[face].reshape(-1, 1)


def weights(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bilinear weights (n, 4) of a face's corners at face coordinates t (n, 2) in [0, 1]."""
    return np.where(BITS, t[:, None], 1 - t[:, None]).prod(axis=2)


def near(a: NDArray[np.float64], b: NDArray[np.float64], distance: float = 0.0) -> tuple[NDArray, NDArray]:
    """Return pairs of polytopes, of a (k, c, d) and of b (l, c, d), with bounding boxes within `distance`, in m."""
    if not (len(a) and len(b)):
        return (np.empty(0, dtype=np.int64),) * 2
    low, high = np.maximum(a.min(axis=(0, 1)), b.min(axis=(0, 1))), np.minimum(a.max(axis=(0, 1)), b.max(axis=(0, 1)))
    size = [np.ptp(c, axis=1) for c in (a, b)]
    edge = np.maximum(size[0].max(axis=0), size[1].max(axis=0))
    slack = distance + edge.max() / 100
    i, j = (
        np.flatnonzero(((c.max(axis=1) >= low - slack) & (c.min(axis=1) <= high + slack)).all(axis=1)) for c in (a, b)
    )
    if not (len(i) and len(j)):
        return i[:0], j[:0]
    scale = (size[0][i].max(axis=0) + size[1][j].max(axis=0)) / 2 + slack
    trees = [cKDTree((c.min(axis=1) + c.max(axis=1)) / (2 * scale)) for c in (a[i], b[j])]
    pairs = trees[0].sparse_distance_matrix(trees[1], 1.0, p=np.inf, output_type="ndarray")
    return i[pairs["i"]], j[pairs["j"]]


def covers(own: Faces, other: Faces) -> Cover:
    """Return the contacts between faces of one body and faces of another body."""
    i, j = near(own.corners, other.corners)
    n, m = (f.outward / np.maximum(np.linalg.norm(f.outward, axis=1, keepdims=True), TINY) for f in (own, other))
    opposite = np.einsum("nd,nd->n", n[i], m[j]) < -0.5
    i, j = i[opposite], j[opposite]
    t, off = local(own.corners[i], other.corners[j], n[i])
    low, high = t.min(axis=1), t.max(axis=1)
    edge, bend = own.edge()[i], own.bend[i] + other.bend[j]
    tolerance = 4 * rounding(own.corners)
    slack = np.minimum(SAME + (tolerance + bend) / np.maximum(edge, TINY), (high - low).min(axis=1) / 4)
    upper = t > ((low + high) / 2)[:, None]
    corner = upper @ [1, 2]
    straight = np.abs(t - np.where(upper, high[:, None], low[:, None])).max(axis=(1, 2)) <= np.maximum(slack, SAME)
    straight &= (np.sort(corner, axis=1) == np.arange(4)).all(axis=1)
    flat = _parallelograms(own.corners[i])
    plane, whole = (local(flat, corners, n[i])[0] for corners in (other.corners[j], own.corners[i]))
    out = Cover(i, j, low, high, np.where(straight[:, None], corner, -1), t, slack, plane)
    box = [np.where(straight[:, None], one, two) for one, two in ((low, plane.min(axis=1)), (high, plane.max(axis=1)))]
    within = [np.where(straight[:, None], k, x) for k, x in enumerate((whole.min(axis=1), whole.max(axis=1)))]
    ends = [np.clip(x, *within) for x in box]
    on = ((ends[1] - ends[0]) > slack[:, None]).all(axis=1)
    at = (ends[0] + ends[1]) / 2
    off_edges = np.einsum("nk,nkd->nd", weights(at), flat)  # equals `middle` if faces are parallelograms
    at = np.where(straight[:, None], at, local(own.corners[i], off_edges[:, None], n[i])[0][:, 0])
    middle = np.einsum("nk,nkd->nd", weights(at), own.corners[i])
    _, in_plane = local(other.corners[j], middle[:, None], m[j])
    gap = np.where(straight, 0.0, np.abs(in_plane[:, 0]))  # of rotated faces: at the middle of the overlap
    with np.errstate(divide="ignore", invalid="ignore"):  # boxes of zero width, excluded by `on`
        for bits in BITS:
            at = out.at(np.where(bits, ends[1], ends[0]))
            gap = np.where(straight, np.maximum(gap, np.abs((at * off).sum(axis=1))), gap)
    on &= gap <= NEAR * np.minimum(edge, other.edge()[j]) + tolerance + 2 * bend
    return Cover(*(getattr(out, name)[on] for name in Cover.__dataclass_fields__))


def _parallelograms(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return parallelograms with the first three corners of each face."""
    return np.stack([*(corners[:, k] for k in range(3)), corners[:, 1] + corners[:, 2] - corners[:, 0]], axis=1)


def local(corners: NDArray, x: NDArray, normal: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the face coordinates (n, c, 2) of positions x (n, c, 3), and the normal distances (n, c) from the faces.

    `corners` (n, 4, 3): corners of the faces.
    `normal` (n, 3): unit normals of the faces.
    """
    t = np.full((*x.shape[:2], 2), 0.5)
    c0, c1, c2, c3 = (corners[:, k, None] for k in range(4))
    for _ in range(8):  # Gauss-Newton; the first step is exact for parallelograms
        a, b = t[..., :1], t[..., 1:]
        e = (c1 - c0) * (1 - b) + (c3 - c2) * b, (c2 - c0) * (1 - a) + (c3 - c1) * a
        r = x - (c0 * (1 - a) * (1 - b) + c1 * a * (1 - b) + c2 * (1 - a) * b + c3 * a * b)
        aa, ab, bb = (np.einsum("ncd,ncd->nc", *p) for p in ((e[0], e[0]), (e[0], e[1]), (e[1], e[1])))
        ra, rb = (np.einsum("ncd,ncd->nc", r, v) for v in e)
        step = np.stack([bb * ra - ab * rb, aa * rb - ab * ra], axis=2) / np.maximum(aa * bb - ab**2, TINY)[..., None]
        t = np.clip(t + step, -1e3, 1e3)
        if np.abs(step).max(initial=0.0) < ROUND_OFF:
            break
    return t, np.einsum("ncd,nd->nc", r, normal)


def covered(count: int, cover: Cover) -> NDArray[np.float64]:
    """Return the covered fraction (n,) of the area of each face."""
    s, owner = within(*_triangles(cover.t, cover.face), np.zeros(2), np.ones(2))
    return sum_by(owner, _areas(s), count)


def uncovered_triangles(
    own: Faces, cover: Cover, faces: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Divide the uncovered parts of `faces` into triangles.  Return the face and corners (n, 3, 2) of each triangle."""
    corners = own.corners[faces]
    normal = own.outward[faces] / np.linalg.norm(own.outward[faces], axis=1, keepdims=True)
    whole, _ = local(_parallelograms(corners), corners, normal)
    of = np.flatnonzero(np.isin(cover.face, faces))
    of = of[np.argsort(cover.face[of], kind="stable")]
    first = np.searchsorted(cover.face[of], faces)
    count = np.searchsorted(cover.face[of], faces, "right") - first
    s, owner = _triangles(whole, np.arange(len(faces)))
    for k in range(count.max()):  # subtract the k-th covering face from each face
        has = count[owner] > k
        free, whose = [s[:, :, ~has]], [owner[~has]]
        s, owner = s[:, :, has], owner[has]
        quad = cover.plane[of[np.minimum(first + k, len(of) - 1)]][:, [0, 1, 3, 2]]  # corners in circular order
        orientation = np.sign(cross_in_plane(quad[:, 2] - quad[:, 0], quad[:, 3] - quad[:, 1]))
        for a in range(4):
            p, q = quad[owner, a].T, quad[owner, (a + 1) % 4].T
            inside = orientation[owner] * cross_in_plane((q - p).T, (s - p).transpose(0, 2, 1))
            s3 = np.concatenate([s, inside[:, None]], axis=1)
            out, out_owner, s3, owner = split(s3, owner, 2, 0.0)
            free.append(out[:, :2])
            whose.append(out_owner)
            s = s3[:, :2]
        s, owner = np.concatenate(free, axis=2), np.concatenate(whose)
        some = _areas(s) > SAME
        s, owner = s[:, :, some], owner[some]
    slack = np.zeros(len(faces))
    np.maximum.at(slack, np.searchsorted(faces, cover.face[of]), cover.slack[of])
    edge = np.linalg.norm(s - s[[1, 2, 0]], axis=1).max(axis=0)
    some = 2 * _areas(s) > 2 * slack[owner] * edge  # removes slivers between different chords of the same curve
    s, owner = s[:, :, some].transpose(2, 0, 1), owner[some]
    kites = np.abs(whole[owner] - BITS).max(axis=(1, 2), initial=0.0) > SAME
    x = np.einsum(
        "nck,nkd->ncd", weights(s[kites].reshape(-1, 2)).reshape(-1, 3, 4), _parallelograms(corners)[owner[kites]]
    )
    s[kites] = np.clip(local(corners[owner[kites]], x, normal[owner[kites]])[0], 0.0, 1.0)
    return faces[owner], s


def within(s: NDArray, owner: NDArray, low: NDArray, high: NDArray) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Clip triangles (3, 2, n) to boxes from `low` to `high`.  Return the triangles, each with its entry of `owner`."""
    low, high = (np.broadcast_to(x, (s.shape[2], 2)) for x in (low, high))
    index = np.arange(s.shape[2])
    for axis in (0, 1):
        _, _, s, index = split(s, index, axis, low[index, axis])
        s, index, _, _ = split(s, index, axis, high[index, axis])
    return s, owner[index]


def _triangles(quads: NDArray, owner: NDArray) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Divide each quadrilateral into two triangles.  Return the triangles, each with its entry of `owner`."""
    both = [quads[:, list(simplex)].transpose(1, 2, 0) for simplex in kuhn_simplices(2)]
    return np.concatenate(both, axis=2).astype(float), np.tile(owner, 2)


def _areas(s: NDArray) -> NDArray[np.float64]:
    """Return the areas (n,) of triangles (3, 2, n)."""
    return 0.5 * np.abs(cross_in_plane(*(s[1:] - s[0]).swapaxes(1, 2)))


def split(s: NDArray, owner: NDArray, axis: int, plane) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Cut triangles (3, e, n) by a plane.  Return the parts below and above it, each with its entry of `owner`."""
    plane = np.broadcast_to(plane, len(owner))
    low, high = s[:, axis].min(axis=0) < plane, s[:, axis].max(axis=0) > plane
    both = np.flatnonzero(low & high)
    below, below_owner, above, above_owner = cut_at(s[:, :, both], owner[both], axis, plane[both])
    parts = (below, below_owner, low & ~high), (above, above_owner, high & ~low)  # triangles in the plane have no area
    out = [(np.concatenate([c, s[:, :, k]], axis=2), np.concatenate([o, owner[k]])) for c, o, k in parts]
    return *out[0], *out[1]


def uncovered(
    count: int, face: NDArray[np.int64], low: NDArray[np.float64], high: NDArray[np.float64], slack: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Divide the uncovered parts of faces into rectangles.  Return the face and the corners of each rectangle.

    `count`: number of faces.
    `face` (n,): index of the face that each box covers.
    `low`, `high` (n, 2): corners of the boxes, in face coordinates from 0 to 1.
    `slack` (n,): tolerance of the face coordinates.
    """
    touched, row = np.unique(face, return_inverse=True)
    whole = np.setdiff1d(np.arange(count), touched)
    k, most = len(touched), np.full(len(touched), SAME)
    np.maximum.at(most, row, slack)
    # along both axes: lines through the ends of boxes, for all faces in turn
    ends = []
    lines = []
    start = []
    size = []
    for a in range(2):
        value = np.clip(np.concatenate([np.zeros(k), np.ones(k), low[:, a], high[:, a]]), 0, 1)
        owner = np.concatenate([np.arange(k), np.arange(k), row, row])
        order = np.lexsort((value, owner))
        v, o = value[order], owner[order]
        new = np.append(True, (np.diff(v) > most[o[1:]]) | (np.diff(o) > 0))[: len(v)]
        at = np.empty(len(v), dtype=np.int64)
        at[order] = np.cumsum(new) - 1
        planes = v[new]
        planes[at[k : 2 * k]] = 1.0
        start.append(at[:k])
        size.append(at[k : 2 * k] - at[:k] + 1)
        lines.append(planes)
        ends.append(at[2 * k :].reshape(2, -1) - at[:k][row])
    block = size[0] * size[1]
    offset = np.cumsum(block) - block
    cover = np.zeros(int(block.sum()), dtype=np.int64)
    for e0 in (0, 1):
        for e1 in (0, 1):
            np.add.at(cover, offset[row] + ends[0][e0] * size[1][row] + ends[1][e1], 1 if e0 == e1 else -1)
    owner = np.repeat(np.arange(k), block)
    i, j = np.divmod(np.arange(len(cover)) - offset[owner], size[1][owner])
    cover = np.cumsum(cover)  # along the second axis; increments in each row of a face add up to zero
    across = np.lexsort((i, j, owner))
    cover[across] = np.cumsum(cover[across])
    free = (cover == 0) & (i < size[0][owner] - 1) & (j < size[1][owner] - 1)
    begin = np.flatnonzero(free & np.append(True, ~free[:-1])[: len(free)])  # runs of free cells along the second axis
    stop = np.flatnonzero(free & np.append(~free[1:], True)[: len(free)])
    order = np.lexsort((i[begin], j[stop], j[begin], owner[begin]))
    begin, stop = begin[order], stop[order]
    same = [owner[begin], j[begin], j[stop], i[begin] - np.arange(len(begin))]  # equal in adjacent runs
    first = np.append(True, np.any([np.diff(s) != 0 for s in same], axis=0))[: len(begin)]
    last = np.append(first[1:], True)[: len(begin)]
    stop = stop[last]
    o = owner[begin[first]]
    begin = begin[first]
    corners = [
        np.stack([lines[0][start[0][o] + a], lines[1][start[1][o] + b]], axis=1)
        for a, b in ((i[begin], j[begin]), (i[stop] + 1, j[stop] + 1))
    ]
    wholes = np.zeros((len(whole), 2)), np.ones((len(whole), 2))
    out = np.concatenate([whole, touched[o]])
    order = np.argsort(out, kind="stable")
    return out[order], *(np.concatenate(pair)[order] for pair in zip(wholes, corners, strict=True))


def separation(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gaps (n,), in m, between convex domains a and b (n, 2^d, d).  Overlapping domains have negative gaps.

    The method is the separating axis theorem.
    """
    d = a.shape[2]
    out = _between_planes(a, b, (face_vectors(c, face) for c in (a, b) for face in range(2 * d)))
    if d == 3:
        k = np.flatnonzero(out < 0)
        bits = corner_bits(3)
        edges = [(i, i + (1 << axis)) for axis in range(3) for i in np.flatnonzero(bits[:, axis] == 0)]
        e, f = ([c[k, j] - c[k, i] for i, j in edges] for c in (a, b))
        out[k] = np.maximum(out[k], _between_planes(a[k], b[k], (np.cross(x, y) for x in e for y in f)))
    return out


def _between_planes(a: NDArray, b: NDArray, normals: Iterable[NDArray]) -> NDArray[np.float64]:
    """Return the largest of the gaps, in m, between a and b along the given normals."""
    out, size = np.full(len(a), -np.inf), np.ptp(a, axis=1).max(axis=1)
    for n in normals:
        length = np.linalg.norm(n, axis=1)
        n = n / np.where(length > 0, length, 1.0)[:, None]
        pa, pb = (np.einsum("nkd,nd->nk", c, n) for c in (a, b))
        gap = np.maximum(pb.min(axis=1) - pa.max(axis=1), pa.min(axis=1) - pb.max(axis=1))
        out = np.maximum(out, np.where(length > SAME * size ** (a.shape[2] - 1), gap, -np.inf))
    return out


def solids(body: Body) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the domains (n, 2^d, d) of a body, and the tolerances (n,) of their overlaps, both in m."""
    low, high = body.bounds
    size, edge = high - low, body.spacing.min()
    if body.aligned and np.isclose(size.prod(), body.volume_of_boxes, rtol=SAME, atol=0):
        return (low + corner_bits(len(size)) * size)[None], allowance(np.full(1, edge))
    corners = body.corners()
    warp = 0.0 if body.aligned else warps(corners)
    return corners, allowance(np.ptp(corners, axis=1).min(axis=1)) + 2 * (body.bend(np.arange(len(body))) + warp)


def warps(domains: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest distances (n,), in m, of domain corners (n, 2^d, d) from the mean planes of their faces."""
    out = np.zeros(len(domains))
    for face, index in enumerate(FACES[3] if domains.shape[2] == 3 else ()):
        f, n = domains[:, index], face_vectors(domains, face)  # only the part along the normal is warp
        off = np.einsum("nd,nd->n", f[:, 0] - f[:, 1] - f[:, 2] + f[:, 3], n)
        out = np.maximum(out, np.abs(off) / np.maximum(np.linalg.norm(n, axis=1), TINY) / 4)
    return out


def allowance(edge: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tolerances (n,), in m, for gaps and overlaps of domains with edge lengths (n,), in m."""
    return NEAR / 2 * edge


def meeting(
    a: tuple[NDArray[np.float64], NDArray[np.float64]],
    b: tuple[NDArray[np.float64], NDArray[np.float64]],
    in_cells: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> tuple[float, float, NDArray[np.float64]]:
    """Return the largest overlap (m) of two bodies, their smallest gap (cells; one of both is 0), and the position.

    `a`, `b`: results of `solids` for both bodies.
    `in_cells`: function that divides positions by the cell size.
    """
    i, j = near(a[0], b[0])
    separations, slack = separation(a[0][i], b[0][j]), a[1][i] + b[1][j] + rounding(a[0])
    if (separations <= slack).any():
        k = int(np.argmin(separations + slack))
        depth, gap = max(0.0, -separations[k]) if separations[k] < -slack[k] else 0.0, 0.0
    else:
        one, other = in_cells(a[0]), in_cells(b[0])
        i, j = near(one, other, 1.0)
        separations = separation(one[i], other[j])
        if not len(i):
            return 0.0, np.inf, np.zeros(one.shape[-1])
        k = int(np.argmin(separations))
        depth, gap = 0.0, float(separations[k])
    one, other = a[0][i[k]], b[0][j[k]]
    x = (np.maximum(one.min(axis=0), other.min(axis=0)) + np.minimum(one.max(axis=0), other.max(axis=0))) / 2
    return depth, gap, x


def check_apart(grid: Grid, bodies: Sequence[Body], present: Sequence[bool]) -> None:
    """Raise an error for overlapping bodies.  Warn of gaps smaller than a cell."""
    indices = [i for i in range(len(bodies)) if present[i]]
    found = {i: solids(bodies[i]) for i in indices} if len(indices) > 1 else {}
    first = np.cumsum([0, *(len(body) for body in bodies[:-1])])  # first point of each body
    for i, j in combinations(indices, 2):
        depth, gap, x = meeting(found[i], found[j], lambda x: grid.in_cells(x - grid.base))
        if depth:
            raise ValueError(f"bodies {i} and {j}: overlap at {x} by {depth:.3g} m, must be apart or touch")
        together = grid.copies == 1 or np.ptp(grid.copy(first[[i, j]])) == 0  # contact groups share no node
        if together and 0 < gap < 1 and not any(_inside(x, found[k][0]) for k in indices if k not in (i, j)):
            warn_near(grid, f"bodies {i} and {j}", gap, x)


def _inside(x: NDArray[np.float64], domains: NDArray[np.float64]) -> bool:
    """Return whether a position lies in one of the domains."""
    point = np.broadcast_to(x, (1, *domains.shape[1:]))
    which, _ = near(domains, point)
    return bool((separation(domains[which], np.repeat(point, len(which), axis=0)) <= 0).any())


def warn_near(grid: Grid, names: str, gap: float, x: NDArray[np.float64]) -> None:
    """Warn of bodies with a gap smaller than a cell.  These bodies share nodes and are bonded."""
    if 0 < gap < 1:
        where = "%s: %.2g cells apart at %s, but they stick, because they share nodes of the grid"
        warn(
            grid.comm,
            ResolutionWarning,
            where + "; seed them in contact, or take cells smaller than the gap",
            names,
            gap,
            x,
        )
