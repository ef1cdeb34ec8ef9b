# SPDX-License-Identifier: MIT
"""Parts of seeded domains, after division and merging: intervals of seeded domains, identifiers, corners and faces.

A part is the image of a box [a, b] under the bilinear or trilinear map of its domain, in the reference configuration and
in the deformed one. Coordinates count seeded domains: a whole domain is the interval [0, 1] along each axis. Intervals
are dyadic: a division bisects an interval, and two parts merge if they are the halves of one interval. On the lattice
of a box, whole domains merge as well, to [0, 2], [0, 4], and so on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.domains.domain_gradient import gradient
from mpm_dolfinx.domains.renewed_faces import AREA, ENDS, PARENT
from mpm_dolfinx.grid.grid import FACES, corner_bits
from mpm_dolfinx.points.cutting import centroids, domain_volumes
from mpm_dolfinx.points.material_points import MaterialPoints

ROOT = "seeded domain"
PART = "part of the seeded domain"
"""Names of point data: id of the seeded domain with the lower corner of a part, or -1; ends (n, d, 2) of the part."""


def with_parts(points: MaterialPoints) -> MaterialPoints:
    """Return the points with the data of parts.  Points that lack these data are whole domains, or were renewed."""
    if ROOT in points.data:
        return points
    n, d = points.x.shape
    return replace(points, data={**points.data, ROOT: np.full(n, -1), PART: np.zeros((n, d, 2))})


def is_part(points: MaterialPoints) -> NDArray[np.bool_]:
    """Return which points (n,) are parts of seeded domains, or merged seeded domains."""
    return points.data[ROOT] >= 0 if ROOT in points.data else np.zeros(len(points), dtype=bool)


def roots(points: MaterialPoints) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return `ROOT` (n,) and `PART` (n, d, 2) of all points; a whole domain is [0, 1] of its own."""
    part, (n, d) = is_part(points), points.x.shape
    if not part.any():
        return points.id, np.broadcast_to([0.0, 1.0], (n, d, 2))
    return np.where(part, points.data[ROOT], points.id), np.where(part[:, None, None], points.data[PART], [0.0, 1.0])


class Identifiers:
    """Identifiers of the parts of seeded domains, which follow from domain and interval.

    They are `points.body_of` numbers with an odd index in the body; renewed points have even indices.

    bodies: all bodies of the scene.
    """

    def __init__(self, bodies: Sequence[Body]):
        self.starts = np.cumsum([0, *map(len, bodies)])
        self._bodies = bodies
        self._dim = bodies[0].dim
        most = np.iinfo(np.int64).max // 4
        self._codes = int((most // (len(bodies) * int(self.starts[-1] + 1))) ** (1 / self._dim))

    def known(self, part: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which intervals (n, d, 2) are so large that 64-bit integers identify them."""
        return (self._code(part) < self._codes).all(axis=1)

    def of(self, root: NDArray[np.int64], part: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the identifiers (n,) of parts; a whole domain has its seeded identifier."""
        code = np.zeros(len(root), dtype=np.int64)
        for column in self._code(part).T:
            code = code * self._codes + column
        body = self.starts.searchsorted(root, side="right") - 1
        number = 2 * (root * self._codes**self._dim + code) + 1
        return np.where(whole(part), root, self.starts[-1] + body + len(self._bodies) * number)

    @staticmethod
    def _code(part: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return a number (n, d) for each dyadic interval: even up to the size 1, odd above."""
        size = np.ptp(part, axis=2)
        code = np.where(size <= 1, 2 * (1 + part[..., 0]) / size, 2 * np.log2(size) - 1)
        return np.rint(code).astype(np.int64)

    def at(self, root: NDArray[np.int64], lower: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the domain (n,) with the lower corner of a part, and this corner (n, d) relative to the domain.

        root (n,), lower (n, d): any domain of the body, and the corner relative to this domain.
        """
        step = np.floor(lower).astype(np.int64)
        out, moved = root.copy(), step.any(axis=1).nonzero()[0]
        body = self.starts.searchsorted(root[moved], side="right") - 1
        for i in np.unique(body):
            at = moved[body == i]
            out[at] = self.starts[i] + self._bodies[i].neighbour(root[at] - self.starts[i], step[at])
        return out, lower - step

    def places(self, root: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the body and lattice index (n, 1 + d) of seeded domains; of domains without lattice -1 - id."""
        out = np.zeros((len(root), 1 + self._dim), dtype=np.int64)
        body = self.starts.searchsorted(root, side="right") - 1
        for i in np.unique(body):
            at, one = body == i, self._bodies[i]
            out[at, 0] = i if one.lattice else -1 - root[at]
            if one.lattice:
                lower = one.nodes(root[at] - self.starts[i])[:, 0]
                out[at, 1:] = np.stack(np.unravel_index(lower, tuple(np.add(one.lattice, 1))), axis=1)
        return out


def whole(part: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which parts (n, d, 2) are whole seeded domains."""
    return (part == [0.0, 1.0]).all(axis=(1, 2))


def halves(corners: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the corners (2, n, 2^d, d) of both halves of domains (n, 2^d, d) that are bisected along a local axis."""
    low, high = FACES[corners.shape[2]][2 * axis : 2 * axis + 2]
    out = np.stack([corners, corners])
    out[0, :, high] = out[1, :, low] = ((corners[:, low] + corners[:, high]) / 2).swapaxes(0, 1)
    return out


def merged(lower: NDArray[np.float64], upper: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the corners (n, 2^d, d) of domains merged from their halves along a local axis."""
    return np.where(corner_bits(lower.shape[2])[:, axis, None] == 0, lower, upper)


def beyond_corners(points: MaterialPoints, axisymmetric: bool) -> NDArray[np.float64]:
    """Return the part (n, k, k) of F that corners do not determine: F, divided by the gradient of the corners."""
    return np.linalg.inv(gradient(points.corners, points.reference, axisymmetric)) @ points.F


def halved(points: MaterialPoints, axis: int, identifiers: Identifiers, axisymmetric: bool) -> MaterialPoints:
    """Return both halves (2n,) of each point, the lower half of all points first.

    Volumes at rest and in the deformed state add up to those of the point.
    """
    corners, reference, origin = (
        halves(of, axis).reshape(-1, *of.shape[1:]) for of in (points.corners, points.reference, points.origin)
    )
    root, part = roots(points)
    ends = np.concatenate([part, part])
    middle, n = part[:, axis].mean(axis=1), len(points)
    ends[:n, axis, 1] = ends[n:, axis, 0] = middle
    root, lower = identifiers.at(np.concatenate([root, root]), ends[..., 0])
    ends = np.stack([lower, lower + np.ptp(ends, axis=2)], axis=2)
    both = points.map(lambda values: np.concatenate([values, values]))
    size = np.abs(domain_volumes(reference, axisymmetric))
    share = size / np.tile(size[:n] + size[n:], 2)
    F = gradient(corners, reference, axisymmetric) @ beyond_corners(both, axisymmetric)
    return replace(
        both,
        id=identifiers.of(root, ends),
        corners=corners,
        reference=reference,
        origin=origin,
        x=centroids(corners),
        volume0=both.volume0 * share,
        F=F,
        data={**both.data, **_named(root, ends)},
    )


def joined(
    lower: MaterialPoints, upper: MaterialPoints, axis: int, identifiers: Identifiers, axisymmetric: bool
) -> MaterialPoints:
    """Return the points (n,) merged from their halves.

    F is the ratio of corners and reference corners.  Data are means, weighted by the volumes at rest.
    """
    corners, reference, origin = (
        merged(getattr(lower, name), getattr(upper, name), axis) for name in ("corners", "reference", "origin")
    )
    (root, part), size = roots(lower), np.ptp(roots(upper)[1], axis=2)[:, axis]
    part = part.copy()
    part[:, axis, 1] += size
    volume0 = lower.volume0 + upper.volume0
    weight = lower.volume0 / volume0

    def mean(a: NDArray, b: NDArray) -> NDArray:
        share = weight.reshape(-1, *[1] * (a.ndim - 1))
        return (share * a + (1 - share) * b).astype(a.dtype)

    beyond = mean(*(beyond_corners(of, axisymmetric) for of in (lower, upper)))
    data = {name: mean(values, upper.data[name]) for name, values in lower.data.items()}
    return replace(
        lower,
        id=identifiers.of(root, part),
        corners=corners,
        reference=reference,
        origin=origin,
        x=centroids(corners),
        volume0=volume0,
        F=gradient(corners, reference, axisymmetric) @ beyond,
        pressure=mean(lower.pressure, upper.pressure),
        data={**data, **_named(root, part)},
    )


def _named(root: NDArray[np.int64], part: NDArray[np.float64]) -> dict[str, NDArray]:
    """Return `ROOT` and `PART` as data of points; whole domains have none."""
    is_whole = whole(part)
    return {ROOT: np.where(is_whole, -1, root), PART: np.where(is_whole[:, None, None], 0.0, part)}


def halved_faces(
    faces: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]],
    reference: NDArray[np.float64],
    axis: int,
    axisymmetric: bool,
) -> dict[str, NDArray]:
    """Return `PARENT`, `AREA` and `ENDS` of both halves (2n, ...) of points in 2D.

    faces: the same data (n, ...) of the points; reference (2n, 4, 2), m: reference corners of the halves.
    """
    parent, area, ends = (np.concatenate([of, of]) for of in faces)
    n, along = len(faces[0]), [2 * (1 - axis), 2 * (1 - axis) + 1]
    inner = (np.arange(2 * n) < n).astype(int) + 2 * axis  # the face between both halves
    parent[np.arange(2 * n), inner] = -1
    middle = faces[2][:, along].mean(axis=2)
    ends[:n, along, 1] = ends[n:, along, 0] = middle
    share = np.full((2 * n, 2), 0.5)
    if axisymmetric:
        at = FACES[2][along]
        radius = reference[:, at, 0].mean(axis=2)
        total = np.tile(radius[:n] + radius[n:], (2, 1))
        share = np.divide(radius, total, out=share, where=total > 0)
    area[:, along] *= share
    none = parent < 0
    return {PARENT: parent, AREA: np.where(none, 0.0, area), ENDS: np.where(none[..., None, None], 0.0, ends)}


def joined_faces(lower: Sequence[NDArray], upper: Sequence[NDArray], axis: int) -> dict[str, NDArray]:
    """Return `PARENT`, `AREA` and `ENDS` of merged points (n, ...) in 2D, from those of their halves."""
    (parent, area, ends), end = (of.copy() for of in lower), 2 * axis + 1
    for of, values in zip((parent, area, ends), upper, strict=True):
        of[:, end] = values[:, end]
    for face in (2 * (1 - axis), 2 * (1 - axis) + 1):
        area[:, face] += upper[1][:, face]
        ends[:, face, 1] = upper[2][:, face, 1]
    return {PARENT: parent, AREA: area, ENDS: ends}
