# SPDX-License-Identifier: MIT
"""Faces of renewed or divided particle domains, and the seeded faces that they replace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Surface, interpolate
from mpm_dolfinx.domains.refilled_cells import OuterFaces, no_faces, ring_lengths, ring_share
from mpm_dolfinx.grid.grid import FACES, Grid, corner_bits, ranges
from mpm_dolfinx.points.material_points import MaterialPoints

PARENT = "renewed faces"
AREA = "renewed areas"
ENDS = "renewed ends"
"""Names of point data for the faces of renewed domains.

PARENT: key (see `keys`) of the seeded face that the face replaces, or -1.
AREA: seeded area, in m^(d-1).
ENDS: reference positions of the ends, in m.
"""


ROOT = "seeded domain"
PART = "part of the seeded domain"
"""Names of point data for parts of seeded domains.

ROOT: identifier of the seeded domain at the lower corner of the part, or -1.
PART: lower and upper ends (n, d, 2) of the part, in local coordinates of the seeded domain.
"""


def keys(point: NDArray[np.int64], face: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return integers (m,) that identify faces of seeded points, in 2D."""
    return 4 * np.asarray(point, dtype=np.int64) + face


def with_faces(points: MaterialPoints) -> MaterialPoints:
    """Return the points with the data `PARENT`, `AREA` and `ENDS`; missing data are added as placeholders."""
    if PARENT in points.data:
        return points
    n = len(points)
    return replace(points, data={**points.data, **dict(zip((PARENT, AREA, ENDS), no_faces(n), strict=True))})


def with_parts(points: MaterialPoints) -> MaterialPoints:
    """Return the points with the data `ROOT` and `PART`; missing data are added as for whole domains."""
    if ROOT in points.data:
        return points
    n, d = points.x.shape
    return replace(points, data={**points.data, ROOT: np.full(n, -1), PART: np.zeros((n, d, 2))})


def is_part(points: MaterialPoints) -> NDArray[np.bool_]:
    """Return which points (n,) are parts of seeded domains, or merged seeded domains."""
    return points.data[ROOT] >= 0 if ROOT in points.data else np.zeros(len(points), dtype=bool)


def roots(points: MaterialPoints) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return `ROOT` (n,) and `PART` (n, d, 2) of all points.

    A whole domain has its own identifier as `ROOT`, and the interval [0, 1] along each axis.
    """
    part, (n, d) = is_part(points), points.x.shape
    if not part.any():
        return points.id, np.broadcast_to([0.0, 1.0], (n, d, 2))
    return np.where(part, points.data[ROOT], points.id), np.where(part[:, None, None], points.data[PART], [0.0, 1.0])


def faces_of_parts(
    points: MaterialPoints, id: NDArray[np.int64], face: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the parts of divided domains that lie on given faces of seeded domains.

    `id`, `face` (m,): identifiers of seeded domains, and indices of faces in these domains.

    Returns
    -------
    Index (n,), among the m faces, of the face of each part.
    Index (n,) of the point for each part.
    Lower and upper ends (n, d) of each part in its seeded domain.
    """
    at = is_part(points).nonzero()[0]
    root, part = (of[at] for of in roots(points))
    order = root.argsort(kind="stable")
    first, stop = (np.searchsorted(root[order], id, side=side) for side in ("left", "right"))
    row, found = ranges(first, stop - first)
    at, part = (of[order[found]] for of in (at, part))
    axis, end = np.divmod(face[row], 2)
    on = (part[np.arange(len(row)), axis, end] == end) & (part <= 1).all(axis=(1, 2))
    return row[on], at[on], part[on, :, 0], part[on, :, 1]


def on_parts(faces: Surface, points: MaterialPoints) -> tuple[Surface, NDArray[np.int64]]:
    """Return the surface plus faces of divided domains, and for each face the index of its origin in `faces`.

    Polygons of the given surface must be rectangles in local coordinates.
    """
    own = np.arange(len(faces))
    if not is_part(points).any():
        return faces, own
    row, at, low, high = faces_of_parts(points, faces.id, faces.face)
    low, high = 2 * low - 1, 2 * high - 1
    clipped = np.clip(faces.xi[row], low[:, None], high[:, None])
    some = (np.ptp(clipped, axis=1) > 0).sum(axis=1) == clipped.shape[2] - 1
    if not some.any():
        return faces, own
    row, at, low, high = (values[some] for values in (row, at, low, high))
    size = (high - low)[:, None]
    corners, d = low[:, None] + corner_bits(low.shape[1]) * size, low.shape[1]
    of = {"id": points.id[at], "face": faces.face[row], "xi": 2 * (clipped[some] - low[:, None]) / size - 1}
    for name in ("domain", "before"):
        rows = getattr(faces, name)[row].repeat(2**d, axis=0)
        of[name] = interpolate(rows, corners.reshape(-1, d)).reshape(corners.shape)
    both = {name: np.concatenate([getattr(faces, name), values]) for name, values in of.items()}
    return Surface(**both, region=faces.region), np.append(own, row)


class SeededFaces:
    """Surface faces of the bodies of a scene in 2D, at seeding and now."""

    def __init__(self, grid: Grid, bodies: Sequence[Body]):
        self.bodies = bodies
        self._grid = grid

    @cached_property
    def seeded(self) -> OuterFaces:
        """All outer faces of the bodies as seeded, ordered by key."""
        found = []
        starts = np.cumsum([0, *map(len, self.bodies)])
        for start, body in zip(starts, self.bodies, strict=False):
            row, face = body.outer()
            at = FACES[2][face]
            X, x = (np.take_along_axis(of(row), at[:, :, None], axis=1) for of in (body.reference, body.corners))
            size = np.linalg.norm(x[:, 1] - x[:, 0], axis=1) * ring_lengths(self._grid, x.mean(axis=1))
            found.append((start + row, face, keys(start + row, face), size, X))
        columns = [np.concatenate(column) for column in zip(*found, strict=True)]
        order = np.argsort(columns[2])
        return OuterFaces(*(column[order] for column in columns))

    def of(self, points: MaterialPoints) -> OuterFaces:
        """Return the present outer faces of the points' domains."""
        seeded = self.seeded
        known, at = points.find(seeded.point)
        columns = [(at, *(v[known] for v in (seeded.face, seeded.key, seeded.area, seeded.ends)))]
        if PARENT in points.data:
            at, face = np.nonzero(points.data[PARENT] >= 0)
            columns.append((at, face, *(points.data[name][at, face] for name in (PARENT, AREA, ENDS))))
        if is_part(points).any():
            row, at, low, high = faces_of_parts(points, seeded.point, seeded.face)
            along = 1 - seeded.face[row] // 2
            low, high = (t[np.arange(len(row)), along, None] for t in (low, high))
            (first, last), middle = seeded.ends[row].swapaxes(0, 1), (low + high)[:, 0] / 2
            share = (high - low)[:, 0]
            if self._grid.axisymmetric:
                share = share * ring_share(*seeded.ends[row, :, 0].T, middle)
            ends = np.stack([first + low * (last - first), first + high * (last - first)], axis=1)
            columns.append((at, seeded.face[row], seeded.key[row], seeded.area[row] * share, ends))
        return OuterFaces(*map(np.concatenate, zip(*columns, strict=True)))

    def needed(self, surfaces: Sequence[Surface], points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of points with faces on any of the surfaces."""
        out = np.zeros(len(points), dtype=bool)
        if surfaces:
            faces = self.of(points)
            out[faces.point[np.isin(faces.key, np.concatenate([keys(one.id, one.face) for one in surfaces]))]] = True
        return out

    def signatures(self, surfaces: Sequence[Surface]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the keys of seeded faces, and the index of each face's set of conditions, or -1 to forbid renewal."""
        key = self.seeded.key
        kind = np.zeros((len(key), len(surfaces)), dtype=np.int8)
        barred = np.zeros(len(key), dtype=bool)
        for k, faces in enumerate(surfaces):
            at = np.minimum(np.searchsorted(key, keys(faces.id, faces.face)), len(key) - 1)
            ok = key[at] == keys(faces.id, faces.face)
            whole = np.ptp(faces.xi, axis=1).max(axis=1) >= 2 * (1 - SAME)
            kind[at[ok & whole], k] = 1
            barred[at[ok & ~whole]] = True
        number = np.unique(kind, axis=0, return_inverse=True)[1].ravel() if len(surfaces) else np.zeros(len(key), int)
        return key, np.where(barred, -1, number)


@dataclass(frozen=True)
class RenewedFaces:
    """Faces of renewed domains that lie on given surfaces."""

    row: NDArray[np.int64]  # index of the seeded face among the faces of all surfaces (m,)
    at: NDArray[np.int64]  # index of the point (m,)
    face: NDArray[np.int64]  # index of the face in its domain (m,)
    xi: NDArray[np.float64]  # local coordinates (m, 2, 2) of the ends of the part that is in the surface
    area: NDArray[np.float64]  # seeded area (m,), m^(d-1), in axisymmetry of the ring, m^2, see `AREA`
    ends: NDArray[np.float64]  # reference positions of the ends (m, 2, 2), m, see `ENDS`
    old: NDArray[np.bool_] | None = None  # in the result of `of`: which positions lie on seeded faces (n,)

    def of(self, number: NDArray[np.int64]) -> RenewedFaces:
        """Return the renewed faces with indices `number` (n,).  Negative indices are seeded faces."""
        old, at = number < 0, np.maximum(number, 0)
        if not len(self.row):
            return RenewedFaces(*(np.zeros((len(number), *v.shape[1:]), v.dtype) for v in self._columns), old)
        return RenewedFaces(*(v[at] for v in self._columns), old)

    @property
    def _columns(self) -> tuple[NDArray, ...]:
        return self.row, self.at, self.face, self.xi, self.area, self.ends

    def in_place_of(
        self, area: NDArray[np.float64], whole: NDArray[np.float64], face: NDArray[np.int64]
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Replace areas of parts, areas of faces and face indices (n,) by values of renewed faces, and return them."""
        part = np.ptp(self.xi, axis=1).max(axis=1) / 2
        new = self.area * part, self.area, self.face
        return tuple(np.where(self.old, a, b) for a, b in zip((area, whole, face), new, strict=True))

    def reference(self, X: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reference positions (n, 2), in m, at local coordinates xi (n, 2), or X on seeded faces."""
        along = xi[np.arange(len(xi)), 1 - self.face // 2]
        share = (1 + along[:, None]) / 2
        new = self.ends[:, 0] + share * (self.ends[:, 1] - self.ends[:, 0])
        return np.where(self.old[:, None], X, new)


def renewed_faces(points: MaterialPoints, several: Sequence[Surface]) -> RenewedFaces:
    """Return the faces of renewed domains on several surfaces, in the order of the surfaces."""
    at, face = np.nonzero(points.data[PARENT] >= 0)
    key = points.data[PARENT][at, face]
    area, ends = points.data[AREA][at, face], points.data[ENDS][at, face]
    found, start = [], 0
    for faces in several:
        own = keys(faces.id, faces.face)
        order = np.argsort(own, kind="stable")
        near = (
            order[np.minimum(np.searchsorted(own[order], key), len(own) - 1)] if len(own) else np.zeros(len(key), int)
        )
        rows = np.flatnonzero(own[near] == key) if len(own) else np.zeros(0, dtype=np.int64)
        low, high = _within(ends[rows], faces.region)
        rows, low, high = (v[high > low] for v in (rows, low, high))
        xi = np.empty((len(rows), 2, 2))
        axis = face[rows] // 2
        n = np.arange(len(rows))
        for k, t in enumerate((low, high)):
            xi[n, k, axis] = 2.0 * (face[rows] % 2) - 1
            xi[n, k, 1 - axis] = 2 * t - 1
        found.append((start + near[rows], at[rows], face[rows], xi, area[rows], ends[rows]))
        start += len(faces)
    return RenewedFaces(*map(np.concatenate, zip(*found, strict=True)))


def _within(ends: NDArray[np.float64], region: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the fractions of edge lengths at which edges enter and leave a region."""
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    edge_vector = ends[:, 1] - ends[:, 0]
    slack = SAME * np.abs(edge_vector).max(axis=1)
    for axis in range(2):
        for end, sign in ((0, 1.0), (1, -1.0)):
            excess = sign * (ends[:, 0, axis] - region[end, axis])
            slope = sign * edge_vector[:, axis]
            flat = np.abs(slope) <= slack
            t = -excess / np.where(flat, 1.0, slope)
            low = np.where(~flat & (slope > 0), np.maximum(low, t), low)
            high = np.where(~flat & (slope < 0), np.minimum(high, t), high)
            high = np.where(flat & (excess < -slack), low, high)
    return low, high
