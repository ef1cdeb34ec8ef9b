# SPDX-License-Identifier: MIT
"""The surface of the bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.points.contact import (
    BITS,
    Cover,
    Faces,
    covers,
    face_vectors,
    uncovered,
    uncovered_triangles,
    within,
)
from mpm_dolfinx.points.cutting import corner_bits
from mpm_dolfinx.points.grid import rounding, side
from mpm_dolfinx.validation import numbers


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of domains on one side of the bodies, the same on every process; arrays over m faces.

    A face of which several parts count has a row for each.

    id : (m,) number of the point; xi : (m, 2^(d-1), d) corners of the part of the face that counts, in the domain's
    coordinates from -1 to 1, of a triangle the last one twice; X : (m, 2, d) the box around it in reference positions,
    before all maps, m; domain : (m, 2^d, d) corners of the domain as seeded, after them, m; axis, end : side of it.
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
        t = np.delete(self.xi, self.axis, axis=2) / 2
        if self.xi.shape[2] == 2:
            return self.whole0 * np.abs(t[:, 1, 0] - t[:, 0, 0])
        (a, b), (c, d) = (t[:, 3] - t[:, 0]).T, (t[:, 2] - t[:, 1]).T
        return self.whole0 * np.abs(a * d - b * c) / 2

    def places(self) -> NDArray[np.float64]:
        """Return where the corners of the parts (m, 2^(d-1), d) are as seeded, m."""
        domain = np.repeat(self.domain, self.xi.shape[1], axis=0)
        return interpolate(domain, self.xi.reshape(-1, self.xi.shape[2])).reshape(self.xi.shape)

    def reference_corners(self) -> NDArray[np.float64]:
        """Return the corners (m, 2^(d-1), d) of the boxes around the parts in reference positions, m."""
        bits = np.insert(corner_bits(self.X.shape[2] - 1), self.axis, 0, axis=1)
        return self.X[:, bits, np.arange(self.X.shape[2])]

    def reference(self, face: NDArray[np.int64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reference positions (n, d), m, of places xi (n, d) on faces."""
        (A, B), a, b = self.X[face].swapaxes(0, 1), self.xi.min(axis=1)[face], self.xi.max(axis=1)[face]
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
    """
    there = [present is None or bool(present[i]) for i in range(len(bodies))]
    dim = bodies[0].lower.shape[1]
    axis, end = side(name, dim)
    box = limits(region, dim)
    around = [Faces.around(body) if here and sum(there) > 1 else None for body, here in zip(bodies, there, strict=True)]
    start, found = 0, [(np.empty(0, np.int64), *(np.empty((0, n, dim)) for n in (2 ** (dim - 1), 2, 2**dim)))]
    for i, body in enumerate(bodies):
        chosen = _in_region(body, axis, end, box) if there[i] else np.empty(0, np.int64)
        others = [faces for j, faces in enumerate(around) if faces is not None and j != i]
        row, t = _free(Faces.of(body, axis, end, chosen), others)
        row, xi, X = _limited(body, axis, end, chosen[row], t, box)
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
    body: Body, axis: int, end: int, row: NDArray[np.int64], t: NDArray[np.float64], region: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what of parts t (n, 4, 2) of faces lies in a region: domains (m,), xi and X as of a `Surface`."""
    dim = len(body.spacing)
    tangential = np.flatnonzero(np.arange(dim) != axis)
    low, high = ((region[k, tangential] - body.lower[row][:, tangential]) / body.spacing[tangential] for k in (0, 1))
    if dim == 2:
        low, high = (np.pad(x, ((0, 0), (0, 1)), constant_values=c) for x, c in ((low, 0.0), (high, 1.0)))
    three = (t[:, 2] == t[:, 3]).all(axis=1)
    triangles, at = within(t[three, :3].transpose(1, 2, 0), np.flatnonzero(three), low[three], high[three])
    triangles = triangles.transpose(2, 0, 1)[:, [0, 1, 2, 2]]
    at = np.concatenate([np.flatnonzero(~three), at])
    t = np.concatenate([np.clip(t[~three], low[~three, None], high[~three, None]), triangles])
    kept = np.flatnonzero((np.ptp(t, axis=1) > 0).all(axis=1))
    kept = kept[np.argsort(at[kept], kind="stable")]
    row, t = row[at[kept]], t[kept][:, : 2 ** (dim - 1), : dim - 1]
    xi = np.insert(2 * t - 1, axis, 2.0 * end - 1, axis=2)
    ends, lower = np.stack([xi.min(axis=1), xi.max(axis=1)], axis=1), body.lower[row][:, None]
    X = np.where(ends == 1, lower + body.spacing, lower + (ends + 1) / 2 * body.spacing)
    X[:, :, tangential] = np.clip(X[:, :, tangential], *region[:, tangential])
    return row, xi, X


def _free(own: Faces, others: Sequence[Faces]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the free parts of faces: the face (n,) of each, and its corners (n, 4, 2), from 0 to 1 over the face.

    They are rectangles where boxes lie along the face's edges, else triangles, whose last corner comes twice.
    """
    on = [covers(own, other) for other in others]
    if not on:
        return np.arange(len(own.row)), np.tile(BITS, (len(own.row), 1, 1)).astype(float)
    cover = Cover(*(np.concatenate([getattr(c, f.name) for c in on]) for f in fields(Cover)))
    turned = np.isin(cover.face, cover.face[cover.corner[:, 0] < 0])
    row, low, high = uncovered(len(own.row), *(x[~turned] for x in (cover.face, cover.low, cover.high, cover.slack)))
    whole = ~np.isin(row, cover.face[turned])
    quads = np.where(BITS, high[whole, None], low[whole, None])
    if not turned.any():
        return row, quads
    split, triangles = uncovered_triangles(cover, np.unique(cover.face[turned]))
    return np.concatenate([row[whole], split]), np.concatenate([quads, triangles[:, [0, 1, 2, 2]]])


def interpolate(corners: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions (m, d) in domains (m, 2^d, d) at local coordinates (m, d) from -1 to 1."""
    signs = 2 * corner_bits(xi.shape[1]) - 1
    N = (0.5 * (1 + signs * xi[:, None, :])).prod(axis=2)
    return np.einsum("mk,mkd->md", N, corners)
