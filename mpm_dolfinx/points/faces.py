# SPDX-License-Identifier: MIT
"""The surface of the bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.points.contact import Faces, covered, covers, face_vectors, uncovered
from mpm_dolfinx.points.cutting import corner_bits
from mpm_dolfinx.points.grid import rounding, side
from mpm_dolfinx.validation import numbers


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of domains on one side of the bodies, the same on every process; arrays over m faces.

    A face of which several parts count has a row for each.

    id : (m,) number of the point; xi : (m, 2, d) ends of the part of the face that counts, in the domain's
    coordinates from -1 to 1; X : (m, 2, d) their reference positions, before all maps, m; domain : (m, 2^d, d)
    corners of the domain as seeded, after them, m; axis, end : side of the domain.
    """

    id: NDArray[np.int64]
    xi: NDArray[np.float64]
    X: NDArray[np.float64]
    domain: NDArray[np.float64]
    axis: int
    end: int

    def __len__(self) -> int:
        return len(self.id)

    @cached_property
    def whole0(self) -> NDArray[np.float64]:
        """Area (m,) of the whole faces as seeded, m^(d-1)."""
        return np.linalg.norm(face_vectors(self.domain, self.axis, self.end), axis=1)

    @property
    def area0(self) -> NDArray[np.float64]:
        """Area (m,) of the parts that count as seeded, m^(d-1)."""
        return self.whole0 * np.delete((self.xi[:, 1] - self.xi[:, 0]) / 2, self.axis, axis=1).prod(axis=1)

    def places(self) -> NDArray[np.float64]:
        """Return where the corners of the parts (m, 2^(d-1), d) are as seeded, m."""
        xi = self.corners()
        domain = np.repeat(self.domain, xi.shape[1], axis=0)
        return interpolate(domain, xi.reshape(-1, xi.shape[2])).reshape(xi.shape)

    def corners(self) -> NDArray[np.float64]:
        """Return the corners (m, 2^(d-1), d) of the parts in the domain's coordinates."""
        dim = self.xi.shape[2]
        bits = np.insert(corner_bits(dim - 1), self.axis, 0, axis=1)
        return self.xi[:, bits, np.arange(dim)]

    def reference(self, face: NDArray[np.int64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reference positions (n, d), m, of places xi (n, d) on faces."""
        (a, b), (A, B) = self.xi[face].swapaxes(0, 1), self.X[face].swapaxes(0, 1)
        t = np.divide(xi - a, b - a, out=np.zeros_like(xi), where=b > a)
        return A + t * (B - A)


Region = tuple[ArrayLike, ArrayLike]


def limits(region: Region | None, dim: int) -> NDArray[np.float64]:
    """Return the corners (2, d) of a region, m; without one, of all space.

    Equal regions have equal bytes (`tobytes`), however they are given: by these they are compared.
    """
    if region is None:
        return np.repeat([[-np.inf], [np.inf]], dim, axis=1)
    allowed = f"two corners of {dim} coordinates each, the lower first"
    corners = numbers("region", region, (2, dim), allowed=allowed, test=lambda x: x[0] <= x[1])
    return np.ascontiguousarray(corners) + 0.0  # no -0


def surface(
    bodies: Sequence[Body], name: str, region: Region | None = None, present: Sequence[bool] | None = None
) -> Surface:
    """Return the faces on a named side of the bodies that are present, but for what of them lies on another body.

    Bodies lie on one another as they are seeded, after their maps, and from then on: bodies that touch stick.

    Parameters
    ----------
    name
        Side: "left", "right", "bottom", "top", in 3D also "front", "back".
    region : ((d,), (d,)), m
        Box of reference positions that limits the faces; faces partly in it count with that part.
    present
        Which bodies are there, by default all.

    Raises
    ------
    ValueError
        A face of which others cover a part that is no union of rectangles.
    """
    there = [present is None or bool(present[i]) for i in range(len(bodies))]
    dim = bodies[0].lower.shape[1]
    axis, end = side(name, dim)
    box = limits(region, dim)
    around = [Faces.around(body) if here and sum(there) > 1 else None for body, here in zip(bodies, there, strict=True)]
    start, found = 0, [(np.empty(0, np.int64), *np.empty((2, 0, 2, dim)), np.empty((0, 2**dim, dim)))]
    for i, body in enumerate(bodies):
        chosen = _in_region(body, axis, end, box) if there[i] else np.empty(0, np.int64)
        others = [faces for j, faces in enumerate(around) if faces is not None and j != i]
        row, ends = _free(Faces.of(body, axis, end, chosen), others, name)
        row, xi, X = _limited(body, axis, end, chosen[row], ends, box)
        found.append((start + row, xi, X, body.corners(row)))
        start += len(body)
    return Surface(*map(np.concatenate, zip(*found, strict=True)), axis, end)


def _in_region(body: Body, axis: int, end: int, region: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the domains of a body that have a face on a side of which a part lies in a box (2, d) of all space."""
    box, tangential = np.stack([body.lower, body.lower + body.spacing], axis=1), np.arange(len(body.spacing)) != axis
    at, slack = box[:, end, axis], 1e-9 * body.spacing[axis] + rounding(box)
    on = body.sides[:, axis, end] & (at >= region[0, axis] - slack) & (at <= region[1, axis] + slack)
    on &= (np.minimum(box[:, 1], region[1]) > np.maximum(box[:, 0], region[0]))[:, tangential].all(axis=1)
    return np.flatnonzero(on)


def _limited(
    body: Body, axis: int, end: int, row: NDArray[np.int64], ends: NDArray[np.float64], region: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what of rectangles lies in a region: domains (m,), ends (m, 2, d) in them and reference positions."""
    dim = len(body.spacing)
    tangential, lower = np.arange(dim) != axis, body.lower[row][:, None]
    t = np.full((len(row), 2, dim), float(end))
    t[:, :, tangential] = ends[:, :, : dim - 1]
    X = np.where(t == 1, lower + body.spacing, lower + t * body.spacing)
    part = np.stack([np.maximum(X[:, 0], region[0]), np.minimum(X[:, 1], region[1])], axis=1)
    part[:, :, axis] = X[:, :, axis]
    t = np.where(part == X, t, (part - lower) / body.spacing)
    kept = (part[:, 1] > part[:, 0])[:, tangential].all(axis=1)
    return row[kept], 2 * t[kept] - 1, part[kept]


def _free(own: Faces, others: Sequence[Faces], name: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the free rectangles of faces: the face (n,) of each, and its ends (n, 2, 2), from 0 to 1 over the face."""
    on = [covers(own, other) for other in others]
    none = np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)), np.empty(0)
    boxes = [none, *((c.face[s], c.low[s], c.high[s], c.slack[s]) for c in on for s in [c.corner[:, 0] >= 0])]
    turned = np.zeros(len(own.row), dtype=bool)
    for c in on:
        turned[c.face[c.corner[:, 0] < 0]] = True
    if turned.any():
        share = sum(covered(len(own.row), c) for c in on)
        whole = np.flatnonzero(turned & (share > 1 - 1e-6))
        boxes.append((whole, np.zeros((len(whole), 2)), np.ones((len(whole), 2)), np.zeros(len(whole))))
        unclear = np.flatnonzero(turned & (share > 1e-6) & (share <= 1 - 1e-6))
        if len(unclear):
            x = own.corners[unclear[0]].mean(axis=0)
            raise ValueError(
                f"side {name!r}: {share[unclear[0]]:.2g} of the face at {x} lies under faces that are turned against "
                "it, must be all, nothing, or rectangles; leave it out by a region"
            )
    row, low, high = uncovered(len(own.row), *map(np.concatenate, zip(*boxes, strict=True)))
    return row, np.stack([low, high], axis=1)


def interpolate(corners: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions (m, d) in domains (m, 2^d, d) at local coordinates (m, d) from -1 to 1."""
    signs = 2 * corner_bits(xi.shape[1]) - 1
    N = (0.5 * (1 + signs * xi[:, None, :])).prod(axis=2)
    return np.einsum("mk,mkd->md", N, corners)
