# SPDX-License-Identifier: MIT
"""Shapes of rigid tools in their initial position, as signed distances in m that are positive outside the tool."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from mpm_dolfinx.base.tolerances import CENTRAL, NEAR, SAME, SECOND, TINY
from mpm_dolfinx.base.validation import asked, line, numbers

ROUNDED = SAME  # penetration, divided by the cell size, below which a position lies on the surface
DISTANCE = 0.1
"""Largest allowed difference between 1 and the slope of a user's distance function."""


DistanceField = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Signed distances (n,), in m, their gradients (n, d), and their second derivatives (n, d, d), in 1/m."""


class Shape(Protocol):
    """A rigid solid.  Positions y (n, d), in m, are in the frame of the tool."""

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, from the surface."""

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d) of the distance."""

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """Return the signed distances with their first and second derivatives."""


def _flat(y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return zero second derivatives (n, d, d)."""
    return np.zeros((*y.shape, y.shape[1]))


def _across(offset: NDArray[np.float64]) -> DistanceField:
    """Return the lengths of vectors, with first and second derivatives with respect to the vectors."""
    r = np.maximum(np.linalg.norm(offset, axis=1), TINY)
    e = offset / r[:, None]
    return r, e, (np.eye(offset.shape[1]) - e[:, :, None] * e[:, None, :]) / r[:, None, None]


class Uniform(NamedTuple):
    """Centroid and squared radius of gyration of a uniform solid in 2D."""

    centroid: NDArray[np.float64]
    gyration: float


def unit_vector(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return the unit vector (d,) along a vector.  Raise ValueError if the vector is invalid or zero."""
    v = numbers(name, value, (2,), (3,), allowed="a vector of 2 or 3 finite components, not zero")
    if not v.any():
        raise ValueError(f"{name} = {line(value)}, must be a vector of 2 or 3 finite components, not zero")
    v = v / np.abs(v).max()  # avoids overflow and underflow of squares
    return v / np.linalg.norm(v)


class Placed:
    """Base class of shapes whose first attribute contains one or several positions."""

    @property
    def dim(self) -> int:
        """Number d of dimensions."""
        return np.asarray(getattr(self, fields(self)[0].name)).shape[-1]

    @property
    def places(self) -> NDArray[np.float64]:
        """Positions (n, d), in m, in the first attribute, such as corners or a tip."""
        return np.atleast_2d(getattr(self, fields(self)[0].name))

    @property
    def middle(self) -> NDArray[np.float64]:
        """Mean (d,), in m, of the positions in the first attribute."""
        return self.places.mean(axis=0)

    def moved(self, by: NDArray[np.float64]) -> Shape:
        """Return the shape, translated by a vector (d,), in m."""
        place = fields(self)[0].name
        return replace(self, **{place: np.asarray(getattr(self, place)) + by})

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """Return the signed distances with their first and second derivatives."""
        raise NotImplementedError

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d) of the distance."""
        return self.geometry(y)[1]


@dataclass(frozen=True, eq=False)
class HalfSpace(Placed):
    """The half-space behind a plane, for a plate, a wall, or the ground.

    Parameters
    ----------
    point : (d,), m
        A position on the plane.
    outward : (d,)
        Normal of the plane, of any length.  The normal points out of the tool towards the bodies.
    """

    point: ArrayLike
    outward: ArrayLike

    def __post_init__(self):
        numbers("HalfSpace: point", self.point, self._n.shape, allowed=f"{len(self._n)} finite coordinates")

    @cached_property
    def _n(self) -> NDArray[np.float64]:
        return unit_vector("HalfSpace: outward", self.outward)

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, from the surface."""
        return (y - self.point) @ self._n

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """See `Placed`."""
        return self.distance(y), np.broadcast_to(self._n, y.shape), _flat(y)


@dataclass(frozen=True, eq=False)
class Ball(Placed):
    """A sphere in 3D.  In 2D, a disc, which is the section of a cylinder.

    Parameters
    ----------
    centre : (d,), m
        Centre of the sphere.
    radius
        Radius, m, > 0.
    """

    centre: ArrayLike
    radius: float

    def __post_init__(self):
        numbers("Ball: centre", self.centre, (2,), (3,), allowed="2 or 3 finite coordinates")
        numbers("Ball: radius", self.radius, test=lambda r: (r > 0) & (r < np.inf), allowed="> 0 and finite")

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, from the surface."""
        return np.linalg.norm(y - self.centre, axis=1) - self.radius

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """See `Placed`."""
        r, e, second = _across(y - self.centre)
        return r - self.radius, e, second


@dataclass(frozen=True, eq=False)
class Convex(Placed):
    """The convex hull of corners: a polygon in 2D, a polyhedron in 3D.

    The signed distance is the largest signed distance from the planes of the faces.  Outside the hull, near edges and
    corners, this value is less than the true distance.

    Parameters
    ----------
    corners : (n, d), m
        At least d + 1 corners, not all on one line or plane.
    """

    corners: ArrayLike

    def __post_init__(self):
        x, what = numbers("Convex: corners", self.corners, None, allowed="finite coordinates"), ""
        if x.ndim != 2 or x.shape[1] not in (2, 3) or len(x) <= x.shape[1]:
            what = f"Convex: corners = {line(self.corners)}"
        else:
            try:
                _ = self._planes
            except QhullError:
                what = f"Convex: corners = {line(self.corners)} lie in one line or plane"
        if what:
            raise ValueError(
                f"{what}, must be 3 or more places (x, y), not on a line, or 4 or more (x, y, z), not in a plane"
            )

    @cached_property
    def _planes(self) -> NDArray[np.float64]:
        return ConvexHull(np.asarray(self.corners, dtype=float)).equations

    def _each(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        return y @ self._planes[:, :-1].T + self._planes[:, -1]

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, from the surface."""
        return self._each(y).max(axis=1)

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """See `Placed`.  If several faces are equally near, the gradient is their mean normal."""
        each = self._each(y)
        gap = each.max(axis=1)
        near = each >= gap[:, None] - ROUNDED * np.abs(each).max(axis=1, keepdims=True)
        return gap, near @ self._planes[:, :-1] / near.sum(axis=1, keepdims=True), _flat(y)


def uniform(shape: Ball | Convex) -> Uniform:
    """Return the centroid and the squared radius of gyration of a disc or polygon."""
    if isinstance(shape, Ball):
        return Uniform(np.array(shape.centre, dtype=float), shape.radius**2 / 2)
    hull = ConvexHull(np.asarray(shape.corners, dtype=float))
    x = hull.points[hull.vertices]
    a, b = (x - x[0])[1:-1], (x - x[0])[2:]
    area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    share = area / area.sum()
    centroid = share @ (a + b) / 3
    second = share @ (a**2 + b**2 + a * b).sum(axis=1) / 6
    return Uniform(x[0] + centroid, float(second - centroid @ centroid))


@dataclass(frozen=True, eq=False)
class Cone(Placed):
    """An infinite cone in 3D, or an infinite wedge in 2D.

    Parameters
    ----------
    tip : (d,), m
        Tip of the cone.
    axis : (d,)
        Direction from the tip into the tool, of any length.
    angle_deg
        Angle between axis and flank, half the apex angle, in degrees, between 0 and 90.  It is 30 degrees for the cone
        of a cone penetration test.
    """

    tip: ArrayLike
    axis: ArrayLike
    angle_deg: float

    def __post_init__(self):
        numbers("Cone: tip", self.tip, self._axis.shape, allowed=f"{len(self._axis)} finite coordinates")
        numbers("Cone: angle_deg", self.angle_deg, test=lambda a: (a > 0) & (a < 90), allowed="in (0, 90) degrees")

    @cached_property
    def _axis(self) -> NDArray[np.float64]:
        return unit_vector("Cone: axis", self.axis)

    def _polar(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the heights (n,) above the tip, and the offsets (n, d) from the axis, in m."""
        z = (y - self.tip) @ self._axis
        return z, y - self.tip - z[:, None] * self._axis

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, from the flank."""
        z, offset = self._polar(y)
        beta = np.radians(self.angle_deg)
        return np.linalg.norm(offset, axis=1) * np.cos(beta) - z * np.sin(beta)

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """See `Placed`.  On the axis, the gradient is the mean normal of the flank."""
        z, offset = self._polar(y)
        r, away, second = _across(offset)
        beta = np.radians(self.angle_deg)
        normal = away * (r > ROUNDED * np.abs(z))[:, None] * np.cos(beta) - self._axis * np.sin(beta)
        gap = r * np.cos(beta) - z * np.sin(beta)
        if y.shape[1] == 2:
            return gap, normal, _flat(y)
        near_axis = r[:, None, None] <= NEAR * np.abs(y - self.tip).max(initial=0.0)
        along = self._axis[:, None] * self._axis / np.where(near_axis, np.inf, r[:, None, None])
        return gap, normal, np.where(near_axis, 0.0, second - along) * np.cos(beta)


@dataclass(frozen=True, eq=False)
class Distance:
    """A shape given by a user's signed distance function.

    Derivatives are finite differences.  The increments of the differences are powers of two, for small rounding errors.
    """

    function: Callable[[NDArray[np.float64]], ArrayLike]  # signed distance, m
    size: float  # cell size, to which increments are proportional, m
    base: NDArray[np.float64] | float = 0.0  # origin of the positions (d,), m

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, from the surface."""
        return self._at(y + self.base)

    def _at(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances, in m, at positions y in the user's coordinates."""
        if not len(y):  # a user's function may fail for an empty array
            return np.zeros(0)
        allowed = f"a finite number for each of {len(y)} places (m, {y.shape[1]})"
        value = asked("Tool: shape", allowed, self.function, y)
        return numbers("Tool: shape", value, (len(y),), allowed=allowed)

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d) of the distance."""
        return self._slopes(y + self.base, _power_of_two(CENTRAL * self.size))

    def _slopes(self, y: NDArray[np.float64], step: float) -> NDArray[np.float64]:
        """Return the gradients of the distance at positions in the user's coordinates, by central differences."""
        slopes = [(self._at(y + e) - self._at(y - e)) / (2 * step) for e in step * np.eye(y.shape[1])]
        return np.stack(slopes, axis=1)

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """See `Placed`."""
        at, wide = y + self.base, _power_of_two(SECOND * self.size)
        steps = wide * np.eye(y.shape[1])
        slopes = [(self._slopes(at + e, wide) - self._slopes(at - e, wide)) / (2 * wide) for e in steps]
        return self.distance(y), self.normal(y), np.stack(slopes, axis=2)


def _power_of_two(x: float) -> float:
    """Return the power of two that is nearest to a number."""
    return float(2.0 ** np.rint(np.log2(x)))
