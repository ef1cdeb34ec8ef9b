# SPDX-License-Identifier: MIT
"""Parts of seeded particle domains after division and merging.

Local coordinates in a seeded domain are from 0 to 1.  A part of the domain has an interval of local coordinates along
each axis.  A division bisects this interval along one axis.  Both halves may merge again.  Inside a body from `box`,
neighbouring seeded domains may also merge.  The merged domain then has a longer interval, such as [0, 2] or [0, 4].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.domains.domain_gradient import gradient
from mpm_dolfinx.domains.renewed_faces import PART, ROOT, roots
from mpm_dolfinx.grid.grid import FACES, Grid, corner_bits, sum_by
from mpm_dolfinx.points.cutting import centroids, domain_volumes
from mpm_dolfinx.points.material_points import MaterialPoints, body_of

PLACES = "corners", "reference", "origin"
"""Names of the arrays of `MaterialPoints` that contain corners of domains."""


class SeededDomains:
    """Seeded domains of the bodies, and identifiers of their parts."""

    def __init__(self, bodies: Sequence[Body]):
        self.starts = np.cumsum([0, *map(len, bodies)])
        self.bodies = bodies
        self._dim = bodies[0].dim
        self._seeded: Latest[NDArray[np.float64]] = Latest()
        most = np.iinfo(np.int64).max // 16  # for `renewed_faces.keys`, too
        self._codes = int((most // (len(bodies) * int(self.starts[-1] + 1))) ** (1 / self._dim))

    def known(self, part: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which parts (n, d, 2) have a 64-bit identifier.  Very small parts have no identifier."""
        return (self._code(part) < self._codes).all(axis=1)

    def of(self, root: NDArray[np.int64], part: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the identifiers (n,) of parts.  A whole domain has its seeded identifier."""
        code = np.zeros(len(root), dtype=np.int64)
        for column in self._code(part).T:
            code = code * self._codes + column
        body = body_of(root, self.starts)
        number = 2 * (root * self._codes**self._dim + code) + 1
        return np.where(whole(part), root, self.starts[-1] + body + len(self.bodies) * number)

    @staticmethod
    def _code(part: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return an integer that identifies each interval."""
        size = np.ptp(part, axis=2)
        code = np.where(size <= 1, 2 * (1 + part[..., 0]) / size, 2 * np.log2(size) - 1)
        return np.rint(code).astype(np.int64)

    def at(self, root: NDArray[np.int64], lower: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the seeded domain (n,) at the lower corner of each part, and the local coordinates (n, d) of the
        corner.

        `root` (n,): any seeded domain of the body.
        `lower` (n, d): local coordinates of the lower corner in the domain `root`.
        """
        step = np.floor(lower).astype(np.int64)
        out, moved = root.copy(), step.any(axis=1).nonzero()[0]
        body = body_of(root[moved], self.starts)
        for i in np.unique(body):
            at = moved[body == i]
            out[at] = self.starts[i] + self.bodies[i].neighbour(root[at] - self.starts[i], step[at])
        return out, lower - step

    def places(self, root: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return body and lattice index (n, 1 + d) of seeded domains.

        In bodies without a lattice, the entry -1 - (identifier of the domain) replaces the body.
        """
        out = np.zeros((len(root), 1 + self._dim), dtype=np.int64)
        body = body_of(root, self.starts)
        for i in np.unique(body):
            at, one = body == i, self.bodies[i]
            regular = one.lattice and one.aligned
            out[at, 0] = i if regular else -1 - root[at]
            if regular:
                out[at, 1:] = one.places(root[at] - self.starts[i])
        return out

    def sizes(self, grid: Grid, points: MaterialPoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return edge lengths (n, d) of domains, and of their seeded domains at seeding, both in cell sizes."""
        root = roots(points)[0]
        return _lengths(grid.in_cells(points.corners)), self._seeded((root,), lambda: self._as_seeded(grid, root))

    def _as_seeded(self, grid: Grid, root: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the edge lengths of domains at seeding, in cells, or nan for renewed domains."""
        seeded, body = np.full((len(root), self._dim), np.nan), body_of(root, self.starts)
        for i in range(len(self.bodies)):
            at = (body == i) & (root < self.starts[-1])
            x = self.bodies[i].corners(root[at] - self.starts[i]) - grid.base
            place = [np.interp(x[..., a], lines, np.arange(len(lines))) for a, lines in enumerate(grid.seeded)]
            seeded[at] = _lengths(np.stack(place, axis=-1))
        return seeded

    def from_middle(self, places: NDArray[np.int64], axis: int) -> NDArray[np.float64]:
        """Return row numbers (n,) of domains along an axis, counted from the body's middle; nan without a lattice."""
        out = np.full(len(places), np.nan)
        for i in np.unique(places[places[:, 0] >= 0, 0]):
            at, count = places[:, 0] == i, self.bodies[i].lattice[axis]
            twice = 2 * places[at, 1 + axis] + 1 - count
            out[at] = np.where(twice > 0, np.ceil(twice / 2) - 1, np.where(twice < 0, np.floor(twice / 2), np.nan))
        return out

    def middle(self, root: NDArray[np.int64], part: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        """Return the fractions (n,) of the edges along an axis, from 0 to 1, at which a division cuts the domains."""
        out, size = np.full(len(root), 0.5), np.rint(np.ptp(part, axis=2)[:, axis]).astype(np.int64)
        body = body_of(root, self.starts)
        for i in np.unique(body[size > 1]):
            at = ((body == i) & (size > 1)).nonzero()[0]
            row, one = root[at] - self.starts[i], self.bodies[i]
            step = np.zeros((len(at), self._dim), dtype=np.int64)
            step[:, axis] = size[at] // 2
            first, half = (one.lower_of(rows)[:, axis] for rows in (row, one.neighbour(row, step)))
            step[:, axis] = size[at] - 1
            last = one.neighbour(row, step)
            out[at] = (half - first) / ((one.lower_of(last) + one.boxes(last))[:, axis] - first)
        return out


def _lengths(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of the mean edges of domains."""
    x, d = np.ascontiguousarray(corners.transpose(1, 2, 0)), corners.shape[2]  # numpy is fast along the last axis
    faces = [np.add.reduce(x[at]) for at in FACES[d]]
    edges = [high - low for low, high in zip(faces[::2], faces[1::2], strict=True)]
    return np.sqrt([np.add.reduce(edge**2) for edge in edges]).T / 2 ** (d - 1)


def whole(part: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which parts (n, d, 2) are whole seeded domains."""
    return (part == [0.0, 1.0]).all(axis=(1, 2))


def halves(corners: NDArray[np.float64], axis: int, middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return both halves (2, n, 2^d, d) of domains (n, 2^d, d), cut at the fractions `middle` (n,) of the edges."""
    low, high = FACES[corners.shape[2]][2 * axis : 2 * axis + 2]
    t = middle[:, None, None]
    out = np.stack([corners, corners])
    out[0][:, high] = out[1][:, low] = (1 - t) * corners[:, low] + t * corners[:, high]
    return out


def merged(lower: NDArray[np.float64], upper: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the corners (n, 2^d, d) of domains merged from their halves along a local axis."""
    return np.where(corner_bits(lower.shape[2])[:, axis, None] == 0, lower, upper)


def beyond_corners(points: MaterialPoints, axisymmetric: bool) -> NDArray[np.float64]:
    """Return the factor A (n, k, k) in F = G A, where the corners determine G, but not A."""
    return np.linalg.inv(gradient(points.corners, points.reference, axisymmetric)) @ points.F


def halved(points: MaterialPoints, axis: int, domains: SeededDomains, axisymmetric: bool) -> MaterialPoints:
    """Return the halves (2n,) of n points: first all lower halves, then all upper halves."""
    root, part = roots(points)
    at, n = domains.middle(root, part, axis), len(points)
    places = {name: halves(getattr(points, name), axis, at).reshape(-1, *points.corners.shape[1:]) for name in PLACES}
    ends = np.concatenate([part, part])
    ends[:n, axis, 1] = ends[n:, axis, 0] = part[:, axis].mean(axis=1)
    root, lower = domains.at(np.concatenate([root, root]), ends[..., 0])
    ends = np.stack([lower, lower + np.ptp(ends, axis=2)], axis=2)
    both = points.map(lambda values: np.concatenate([values, values]))
    size = np.abs(domain_volumes(places["reference"], axisymmetric))
    both = replace(both, volume0=both.volume0 * size / np.tile(size[:n] + size[n:], 2))
    return _placed(both, places, domains.of(root, ends), (root, ends), beyond_corners(both, axisymmetric))


def joined(
    lower: MaterialPoints, upper: MaterialPoints, axis: int, domains: SeededDomains, axisymmetric: bool
) -> MaterialPoints:
    """Return the points (n,) merged from their halves.  F follows from the corners; other values are weighted means."""
    places = {name: merged(getattr(lower, name), getattr(upper, name), axis) for name in PLACES}
    root, part = roots(lower)
    part = part.copy()
    part[:, axis, 1] += np.ptp(roots(upper)[1][:, axis], axis=1)
    volume0 = lower.volume0 + upper.volume0

    def mean(a: NDArray, b: NDArray) -> NDArray:
        share = (lower.volume0 / volume0).reshape(-1, *[1] * (a.ndim - 1))
        return (share * a + (1 - share) * b).astype(a.dtype)

    beyond = mean(*(beyond_corners(of, axisymmetric) for of in (lower, upper)))
    data = {name: mean(values, upper.data[name]) for name, values in lower.data.items()}
    both = replace(lower, volume0=volume0, pressure=mean(lower.pressure, upper.pressure), data=data)
    return _placed(both, places, domains.of(root, part), (root, part), beyond)


def _placed(
    points: MaterialPoints,
    places: dict[str, NDArray[np.float64]],
    id: NDArray[np.int64],
    of: tuple[NDArray[np.int64], NDArray[np.float64]],
    beyond: NDArray[np.float64],
) -> MaterialPoints:
    """Return points with new corners, identifiers, `ROOT` and `PART`.  F is computed from the corners."""
    root, part = of
    is_whole = whole(part)
    data = {ROOT: np.where(is_whole, -1, root), PART: np.where(is_whole[:, None, None], 0.0, part)}
    F = gradient(places["corners"], places["reference"], beyond.shape[1] > part.shape[1]) @ beyond
    return replace(points, id=id, **places, x=centroids(places["corners"]), F=F, data={**points.data, **data})


def with_defect(new: MaterialPoints, old: MaterialPoints, into: NDArray[np.int64]) -> MaterialPoints:
    """Return the new points with changed volume defects ("owed"), so that fluid is conserved.

    `into`: index of the old point for each new point, or after merging, index of the new point for each old point.
    """
    if "owed" not in new.data:
        return new
    fewer, more = sorted((old, new), key=len)
    excess = sum_by(into, more.volume0 * more.J, len(fewer)) / fewer.volume0 - fewer.J
    return replace(new, data={**new.data, "owed": new.data["owed"] + (excess[into] if more is new else -excess)})
