# SPDX-License-Identifier: MIT
"""Surface of the bodies: faces of particle domains on a side or in a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.tolerances import SAME, TINY
from mpm_dolfinx.base.validation import line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.touching import (
    BITS,
    Cover,
    Faces,
    covers,
    face_vectors,
    local,
    split,
    uncovered,
    uncovered_triangles,
    weights,
    within,
)
from mpm_dolfinx.grid.grid import ABOUT_MIDDLE, FACES, corner_bits, ranges, rounding

TANGENTIAL = {d: np.array([[a for a in range(d) if a != axis] for axis in range(d)]) for d in (2, 3)}
"""Tangential axes (d, d-1) of the faces normal to each axis."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of particle domains on one side of the bodies.

    Every process has the same faces.  Parts of faces in contact with another body are excluded.  The rest of each face
    is divided into triangles and quadrilaterals.  Arrays have a row for each of these m polygons.
    """

    id: NDArray[np.int64]  # identifier of the material point (m,), ascending
    face: NDArray[np.int64]  # index of the face in its domain (m,), see `grid.FACES`
    # corners (m, 2^(d-1), d) of the polygon, in local coordinates of the domain, -1 to 1; triangles repeat a corner
    xi: NDArray[np.float64]
    domain: NDArray[np.float64]  # seeded corners of the domain, after all maps (m, 2^d, d), m
    before: NDArray[np.float64]  # reference positions of the domain's corners, before all maps (m, 2^d, d), m
    region: NDArray[np.float64]  # box of reference positions that limits the faces (2, d), m

    def __len__(self) -> int:
        return len(self.id)

    def off_axis(self) -> Surface:
        """Return the surface without faces on the axis of revolution."""
        off = self.places()[:, :, 0].max(axis=1, initial=0.0) > SAME * self.whole0
        if off.all():
            return self
        rows = {f.name: getattr(self, f.name)[off] for f in fields(self) if f.name != "region"}
        return Surface(**rows, region=self.region)

    @cached_property
    def outward(self) -> NDArray[np.float64]:
        """Outward area vectors at seeding (m, d), in m^(d-1), of the whole faces that contain the polygons."""
        return face_vectors(self.domain, self.face)

    @cached_property
    def whole0(self) -> NDArray[np.float64]:
        """Areas at seeding (m,), in m^(d-1), of the whole faces that contain the polygons."""
        return np.linalg.norm(self.outward, axis=1)

    @cached_property
    def area0(self) -> NDArray[np.float64]:
        """Areas at seeding (m,), in m^(d-1), of the polygons."""
        x = self.places()
        if x.shape[2] == 2:
            return np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
        return np.linalg.norm(np.cross(x[:, 3] - x[:, 0], x[:, 2] - x[:, 1]), axis=1) / 2

    @cached_property
    def skew(self) -> NDArray[np.bool_]:
        """Whether each seeded face (m,) differs from a parallelogram."""
        x = np.take_along_axis(self.domain, FACES[self.xi.shape[2]][self.face][:, :, None], axis=1)
        off = np.linalg.norm(x[:, -1] - x[:, 1] - x[:, -2] + x[:, 0], axis=1) if x.shape[2] == 3 else np.zeros(len(x))
        return off > SAME * np.ptp(x, axis=1).max(axis=1)

    def places(self) -> NDArray[np.float64]:
        """Return the seeded positions (m, 2^(d-1), d), in metres, of the corners of the polygons."""
        domain = np.repeat(self.domain, self.xi.shape[1], axis=0)
        return interpolate(domain, self.xi.reshape(-1, self.xi.shape[2])).reshape(self.xi.shape)

    def reference(self, at: NDArray[np.int64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return reference positions (n, d), in m, at local coordinates xi (n, d) in the domains of polygons `at`."""
        return np.clip(interpolate(self.before[at], xi), *self.region)

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """Reference positions (m, 2^(d-1), d), in m, of the corners of the polygons."""
        at = np.repeat(np.arange(len(self)), self.xi.shape[1])
        return self.reference(at, self.xi.reshape(len(at), self.xi.shape[2])).reshape(self.xi.shape)

    @property
    def X(self) -> NDArray[np.float64]:
        """Bounding boxes (m, 2, d), in m, of the reference positions of the polygons."""
        return np.stack([self.corners.min(axis=1), self.corners.max(axis=1)], axis=1)

    def check_apart(self, others: Surface, conditions: tuple[Any, Any]) -> None:
        """Raise an error if two incompatible conditions act on the same part of a face."""
        first, stop = (np.searchsorted(others.id, self.id, end) for end in ("left", "right"))
        a, b = ranges(first, stop - first)  # all pairs of faces of the same domain
        same = self.face[a] == others.face[b]
        a, b = a[same], b[same]
        low, high = np.maximum(self.X[a, 0], others.X[b, 0]), np.minimum(self.X[a, 1], others.X[b, 1])
        size = self.X[a, 1] - self.X[a, 0]
        common = (high - low > SAME * size) | (size <= SAME * size.max(axis=1, keepdims=True))  # or no extent along it
        both = np.flatnonzero(common.all(axis=1))
        if len(both):
            x = (low[both[0]] + high[both[0]]) / 2
            raise ValueError(f"{' and '.join(map(line, conditions))}: both act at {x}, must be limited by regions")


Region = tuple[ArrayLike, ArrayLike]


def limits(region: Region | None, dim: int) -> NDArray[np.float64]:
    """Return the lower and upper corner (2, d) of a region, in m.  If `region` is None, the corners are infinite."""
    if region is None:
        return np.repeat([[-np.inf], [np.inf]], dim, axis=1)
    allowed = f"two corners of {dim} coordinates each, the lower first"
    corners = numbers("region", region, (2, dim), allowed=allowed, test=lambda x: x[0] <= x[1])
    return np.ascontiguousarray(corners) + 0.0  # no -0.0


def surface(
    bodies: Sequence[Body], name: str | None, region: Region | None = None, present: Sequence[bool] | None = None
) -> Surface:
    """Return the faces on a side of the active bodies, without the parts that touch other bodies at seeding.

    Parameters
    ----------
    name
        Side: "left", "right", "bottom", "top", in 3D "front", "back", or a name from a mesh; None for all sides.
    region : ((d,), (d,)), m
        Box of reference positions that limits the faces.
    present
        Whether each body is active; by default all bodies are.
    """
    shown = [present is None or bool(present[i]) for i in range(len(bodies))]
    dim, known = bodies[0].dim, dict.fromkeys(name for body in bodies for name in body.names)
    if name is not None and (not isinstance(name, str) or name not in known):
        allowed = f"must be one of {', '.join(known)}" if known else "no body has a named side"
        raise ValueError(f"side {name!r}: {allowed}")
    box = limits(region, dim)
    around = [Faces.around(body) if seen and sum(shown) > 1 else None for body, seen in zip(bodies, shown, strict=True)]
    none = np.empty(0, np.int64)
    start, found = 0, [(none, none, *(np.empty((0, n, dim)) for n in (2 ** (dim - 1), 2**dim, 2**dim)))]
    for i, body in enumerate(bodies):
        on = body.outer() if name is None else body.named(name)
        row, face = _in_region(body, *on, box) if shown[i] else (none, none)
        others = [faces for j, faces in enumerate(around) if faces is not None and j != i]
        part, t = _free(Faces.of(body, row, face), others)
        part, xi = _limited(body, row, face, part, t, box)
        row, face = row[part], face[part]
        found.append((start + row, face, xi, body.corners(row), body.reference(row)))
        start += len(body)
    return Surface(*map(np.concatenate, zip(*found, strict=True)), box)


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Return the surfaces of different bodies as one surface."""
    names = [f.name for f in fields(Surface) if f.name != "region"]
    rows = {name: np.concatenate([getattr(one, name) for one in surfaces]) for name in names}
    order = np.argsort(rows["id"], kind="stable")
    return Surface(**{name: values[order] for name, values in rows.items()}, region=surfaces[0].region)


def _face_corners(body: Body, row: NDArray[np.int64], face: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the reference positions, in m, of the corners of faces."""
    return np.take_along_axis(body.reference(row), FACES[body.dim][face][:, :, None], axis=1)


def _in_region(
    body: Body, row: NDArray[np.int64], face: NDArray[np.int64], region: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the faces of a body that may intersect a box of reference positions."""
    x = _face_corners(body, row, face)
    low, high = x.min(axis=1), x.max(axis=1)
    size = high - low
    slack = SAME * size.max(axis=1, keepdims=True) + rounding(x)  # faces with only a sliver in the region are left out
    within = (low >= region[0] - slack) & (high <= region[1] + slack)
    common = np.minimum(high, region[1]) - np.maximum(low, region[0])
    on = np.where(size <= slack, within, common > slack).all(axis=1)
    return row[on], face[on]


def _limited(
    body: Body,
    row: NDArray[np.int64],
    face: NDArray[np.int64],
    part: NDArray[np.int64],
    t: NDArray[np.float64],
    region: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Clip parts of faces to a region.  Return the index of the face, and the corners, of each clipped part."""
    dim, three = body.dim, (t[:, 2] == t[:, 3]).all(axis=1)
    X = _face_corners(body, row[part], face[part])
    bent = np.zeros(len(X), dtype=bool)
    clipped = np.empty((0, 3, 2))
    of = np.empty(0, np.int64)
    if dim == 3 and body.lattice is None:  # faces that may cross the region and are no rectangles along the axes
        bent = ((X.min(axis=1) < region[0]) | (X.max(axis=1) > region[1])).any(axis=1) & ~_along_axes(X)
        clipped, of = _clipped(X[bent], t[bent], region)
    quad, three = np.flatnonzero(~bent & ~three), np.flatnonzero(~bent & three)
    low, high = _interval(X, region)
    triangles, at = within(t[three, :3].transpose(1, 2, 0), three, low[three], high[three])
    triangles = np.concatenate([triangles.transpose(2, 0, 1), clipped])
    quads = np.clip(t[quad], low[quad, None], high[quad, None])
    at = np.concatenate([quad, at, np.flatnonzero(bent)[of]])
    t = np.concatenate([quads, triangles[:, [0, 1, 2, 2]]])
    kept = np.flatnonzero((np.ptp(t, axis=1) > 0).all(axis=1))
    kept = kept[np.lexsort((at[kept], row[part[at[kept]]]))]
    part, t = part[at[kept]], t[kept][:, : 2 ** (dim - 1), : dim - 1]
    axis, end = (k[:, None] for k in np.divmod(face[part], 2))
    xi = np.empty((*t.shape[:2], dim))
    np.put_along_axis(xi, np.broadcast_to(TANGENTIAL[dim][axis], t.shape), 2 * t - 1, axis=2)
    np.put_along_axis(xi, np.broadcast_to(axis[:, None], xi[:, :, :1].shape), 2.0 * end[:, None] - 1, axis=2)
    return part, xi


def _along_axes(X: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether faces are rectangles with edges along the axes."""
    edges = X[:, [1, 2, 3, 3]] - X[:, [0, 0, 2, 1]]
    return ((np.abs(edges) > rounding(X)).sum(axis=2) == 1).all(axis=1)


def _interval(X: NDArray[np.float64], region: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper face coordinates of the part of each face inside a region."""
    low, high = np.zeros((len(X), 2)), np.ones((len(X), 2))
    for k in range(X.shape[2] - 1):
        edge = X[:, 1 << k] - X[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):  # edges normal to an axis have no limits along it
            ends = np.where(np.abs(edge) > rounding(X), (region[:, None] - X[:, 0]) / edge, [[[-np.inf]], [[np.inf]]])
        low[:, k] = np.maximum(0.0, ends.min(axis=0).max(axis=1))
        high[:, k] = np.minimum(1.0, ends.max(axis=0).min(axis=1))
    return low, np.maximum(low, high)


def _clipped(
    X: NDArray[np.float64], t: NDArray[np.float64], region: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Divide parts of faces into triangles, and clip these to a region.  Return triangles, and their parts' indices."""
    places = np.einsum("npk,nkd->npd", weights(t.reshape(-1, 2)).reshape(*t.shape[:2], 4), X)
    three = (t[:, 2] == t[:, 3]).all(axis=1)[:, None]  # in triangles, the middle is a corner
    middle = np.where(three, places[:, 2], places.mean(axis=1))
    places = np.concatenate([places, middle[:, None]], axis=1)
    s = np.concatenate([places[:, list(triangle)].transpose(1, 2, 0) for triangle in ABOUT_MIDDLE], axis=2)
    at = np.tile(np.arange(len(X)), len(ABOUT_MIDDLE))
    for axis in range(3):
        _, _, s, at = split(s, at, axis, region[0, axis])
        s, at, _, _ = split(s, at, axis, region[1, axis])
    diagonals = np.cross(X[:, 3] - X[:, 0], X[:, 2] - X[:, 1])
    normal = diagonals / np.maximum(np.linalg.norm(diagonals, axis=1, keepdims=True), TINY)
    return np.clip(local(X[at], s.transpose(2, 0, 1), normal[at])[0], 0.0, 1.0), at


def _free(own: Faces, others: Sequence[Faces]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the face and the corners of each part without contact.  Triangles repeat a corner."""
    on = [covers(own, other) for other in others]
    if not on:
        return np.arange(len(own.row)), np.tile(BITS, (len(own.row), 1, 1)).astype(float)
    cover = Cover(*(np.concatenate([getattr(c, f.name) for c in on]) for f in fields(Cover)))
    flipped = np.isin(cover.face, cover.face[cover.corner[:, 0] < 0])
    row, low, high = uncovered(len(own.row), *(x[~flipped] for x in (cover.face, cover.low, cover.high, cover.slack)))
    whole = ~np.isin(row, cover.face[flipped])
    quads = np.where(BITS, high[whole, None], low[whole, None])
    if not flipped.any():
        return row, quads
    split, triangles = uncovered_triangles(own, cover, np.unique(cover.face[flipped]))
    return np.concatenate([row[whole], split]), np.concatenate([quads, triangles[:, [0, 1, 2, 2]]])


def interpolate(corners: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions (m, d) at local coordinates xi (m, d) in [-1, 1] of domains with corners (m, 2^d, d)."""
    signs = 2 * corner_bits(xi.shape[1]) - 1
    N = (0.5 * (1 + signs * xi[:, None, :])).prod(axis=2)
    return np.add.reduce(N[:, :, None] * corners, axis=1)


def on_face(
    corners: NDArray[np.float64], face: NDArray[np.int64], x: NDArray[np.float64], xi: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the local coordinates xi (n, 3) of positions x (n, 3), in m, on faces."""
    quads = np.take_along_axis(corners, FACES[3][face][:, :, None], axis=1)
    normal = face_vectors(corners, face)
    t, _ = local(quads, x[:, None], normal)
    out = xi.copy()
    np.put_along_axis(out, TANGENTIAL[3][face // 2], 2 * t[:, 0] - 1, axis=1)
    return out
