# SPDX-License-Identifier: MIT
"""The surface of the bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.points.cutting import corner_bits
from mpm_dolfinx.points.grid import rounding, side
from mpm_dolfinx.validation import numbers


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of domains on one side of the bodies, the same on every process; arrays over m faces.

    id : (m,) number of the point; xi : (m, 2, d) ends of the part of the face that counts, in the domain's
    coordinates from -1 to 1; X : (m, 2, d) their reference positions, before a map, m; whole0 : (m,) reference
    area of the whole face, m^(d-1); axis, end : side of the domain.
    """

    id: NDArray[np.int64]
    xi: NDArray[np.float64]
    X: NDArray[np.float64]
    whole0: NDArray[np.float64]
    axis: int
    end: int

    def __len__(self) -> int:
        return len(self.id)

    @property
    def area0(self) -> NDArray[np.float64]:
        """Reference area (m,) of the parts that count, m^(d-1)."""
        return self.whole0 * np.delete((self.xi[:, 1] - self.xi[:, 0]) / 2, self.axis, axis=1).prod(axis=1)

    def corners(self) -> NDArray[np.float64]:
        """Return the corners (m, 2^(d-1), d) of the parts in the domain's coordinates."""
        return self._at_corners(self.xi)

    def reference_corners(self) -> NDArray[np.float64]:
        """Return the reference positions (m, 2^(d-1), d), m, of the corners of the parts."""
        return self._at_corners(self.X)

    def _at_corners(self, ends: NDArray[np.float64]) -> NDArray[np.float64]:
        dim = ends.shape[2]
        bits = np.insert(corner_bits(dim - 1), self.axis, 0, axis=1)
        return ends[:, bits, np.arange(dim)]

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
    """Return the faces on a named side of the bodies that are present, where no other of them touches.

    Parameters
    ----------
    name
        Side: "left", "right", "bottom", "top", in 3D also "front", "back".
    region : ((d,), (d,)), m
        Box of reference positions that limits the faces; faces partly in it count with that part.
    present
        Which bodies are there, by default all.
    """
    there = [body for i, body in enumerate(bodies) if present is None or present[i]]
    dim = bodies[0].lower.shape[1]
    axis, end = side(name, dim)
    tangential = np.arange(dim) != axis
    low, high = limits(region, dim)
    start, ids, xis, Xs, wholes = 0, [], [], [], []
    for body in bodies:
        chosen = np.flatnonzero(body.sides[:, axis, end] & any(body is other for other in there))
        box = np.stack([body.lower[chosen], body.lower[chosen] + body.spacing], axis=1)
        face = box.copy()
        face[:, :, axis] = box[:, end, None, axis]
        part = np.stack([np.maximum(face[:, 0], low), np.minimum(face[:, 1], high)], axis=1)
        on = (part[:, 1] > part[:, 0])[:, tangential].all(axis=1)
        on &= ~_touched(face.mean(axis=1), axis, end, [other for other in there if other is not body])
        at, slack = face[:, 0, axis], 1e-9 * body.spacing[axis] + rounding(face)
        on &= (at >= low[axis] - slack) & (at <= high[axis] + slack)
        part[:, :, axis] = face[:, :, axis]
        ids.append(start + chosen[on])
        xis.append((2 * part - box.sum(axis=1, keepdims=True))[on] / body.spacing)
        Xs.append(part[on])
        wholes.append(np.linalg.norm(face_vectors(body.corners(chosen[on]), axis, end), axis=1))
        start += len(body)
    return Surface(*map(np.concatenate, (ids, xis, Xs, wholes)), axis, end)


def _touched(centre: NDArray[np.float64], axis: int, end: int, others: Sequence[Body]) -> NDArray[np.bool_]:
    """Return which faces, given by their centres (m, d) in the reference configuration, lie on one of other bodies."""
    out = np.zeros(len(centre), dtype=bool)
    for body in others:
        just_outside = centre / body.spacing
        just_outside[:, axis] += 1e-6 * (2 * end - 1)
        distance, _ = cKDTree(body.centre / body.spacing).query(just_outside, p=np.inf, distance_upper_bound=0.5)
        out |= distance < 0.5
    return out


def interpolate(corners: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions (m, d) in domains (m, 2^d, d) at local coordinates (m, d) from -1 to 1."""
    signs = 2 * corner_bits(xi.shape[1]) - 1
    N = (0.5 * (1 + signs * xi[:, None, :])).prod(axis=2)
    return np.einsum("mk,mkd->md", N, corners)


def face_vectors(corners: NDArray[np.float64], axis: int, end: int) -> NDArray[np.float64]:
    """Return the outward area vectors (m, d), m^(d-1), of one face of domains (m, 2^d, d)."""
    dim = corners.shape[2]
    face = corners[:, corner_bits(dim)[:, axis] == end]
    if dim == 2:
        t = face[:, 1] - face[:, 0]
        n = np.stack([t[:, 1], -t[:, 0]], axis=1) * (1 if axis == 0 else -1)
    else:
        n = 0.5 * np.cross(face[:, 3] - face[:, 0], face[:, 2] - face[:, 1])
        n *= 1 if axis != 1 else -1
    return n * (1 if end else -1)
