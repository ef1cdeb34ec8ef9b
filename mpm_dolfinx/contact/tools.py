# SPDX-License-Identifier: MIT
"""Rigid tools that press on the bodies: their shapes, and how they move.

A shape is a signed distance, m, positive outside of the tool, in the place that the tool has before its motion.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from mpm_dolfinx.base.given_values import check_names, given
from mpm_dolfinx.base.validation import asked, line, numbers
from mpm_dolfinx.grid.grid import Grid

LEAST = 1e-300  # in place of a distance from a centre, m
ROUNDED = 1e-9  # cells: what is no deeper in a tool is on its surface
ONTO = 100  # times at most that a place is put onto the surface
DISTANCE = 0.1
"""Relative error of the slope of a user's distance from which on it is none."""


class Shape(Protocol):
    """A solid; places y (m, d) are in the frame of the tool."""

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (m,), m."""

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (m, d) of the distance."""

    def curvature(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the second derivatives (m, d, d) of the distance, 1/m."""


def _flat(y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.zeros((*y.shape, y.shape[1]))


def _across(offset: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
    """Return lengths (m,) of vectors (m, d), their directions, and the second derivatives of the lengths, 1/m."""
    r = np.maximum(np.linalg.norm(offset, axis=1), LEAST)
    e = offset / r[:, None]
    return r, e, (np.eye(offset.shape[1]) - e[:, :, None] * e[:, None, :]) / r[:, None, None]


def _direction(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return a unit vector (d,); ValueError where there is none."""
    v = numbers(name, value, (2,), (3,), allowed="a vector of 2 or 3 finite components, not zero")
    if not v.any():
        raise ValueError(f"{name} = {line(value)}, must be a vector of 2 or 3 finite components, not zero")
    v = v / np.abs(v).max()  # squares of huge and tiny ones are not finite, or zero
    return v / np.linalg.norm(v)


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """All that lies behind a plane: a plate, a wall, the ground.

    Parameters
    ----------
    point : (d,), m
        A place on the plane.
    outward : (d,)
        Normal of the plane that points out of the tool, towards the bodies; of any length.
    """

    point: ArrayLike
    outward: ArrayLike

    def __post_init__(self):
        numbers("HalfSpace: point", self.point, self._n.shape, allowed=f"{len(self._n)} finite coordinates")

    @cached_property
    def _n(self) -> NDArray[np.float64]:
        return _direction("HalfSpace: outward", self.outward)

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return len(self._n)

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (m,), m."""
        return (y - self.point) @ self._n

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (m, d) of the distance."""
        return np.broadcast_to(self._n, y.shape)

    def curvature(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the second derivatives (m, d, d) of the distance, 1/m."""
        return _flat(y)

    def moved(self, by: NDArray[np.float64]) -> HalfSpace:
        """Return the shape moved by a vector (d,), m."""
        return replace(self, point=np.asarray(self.point) + by)


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere; in 2D a disc, that is a cylinder.

    Parameters
    ----------
    centre : (d,), m
        Its centre.
    radius
        m, > 0.
    """

    centre: ArrayLike
    radius: float

    def __post_init__(self):
        numbers("Ball: centre", self.centre, (2,), (3,), allowed="2 or 3 finite coordinates")
        numbers("Ball: radius", self.radius, test=lambda r: (r > 0) & (r < np.inf), allowed="> 0 and finite")

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return len(np.asarray(self.centre))

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (m,), m."""
        return _across(y - self.centre)[0] - self.radius

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (m, d) of the distance."""
        return _across(y - self.centre)[1]

    def curvature(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the second derivatives (m, d, d) of the distance, 1/m."""
        return _across(y - self.centre)[2]

    def moved(self, by: NDArray[np.float64]) -> Ball:
        """Return the shape moved by a vector (d,), m."""
        return replace(self, centre=np.asarray(self.centre) + by)


@dataclass(frozen=True, eq=False)
class Convex:
    """The convex hull of corners: a polygon, in 3D a polyhedron.

    Its distance is that of the nearest of its planes: inside exact; outside, beside edges and corners, where nothing
    touches, too small.

    Parameters
    ----------
    corners : (m, d), m
        At least d + 1 that do not lie in one line or plane.
    """

    corners: ArrayLike

    def __post_init__(self):
        x, what = numbers("Convex: corners", self.corners, None, allowed="finite coordinates"), ""
        if x.ndim != 2 or x.shape[1] not in (2, 3) or len(x) <= x.shape[1]:
            what = f"Convex: corners = {line(self.corners)}"
        else:
            try:
                assert len(self._planes)
            except QhullError:
                what = f"Convex: corners = {line(self.corners)}: lie in one line or plane"
        if what:
            raise ValueError(f"{what}, must be at least d + 1 places of d = 2 or 3 coordinates that span a solid")

    @cached_property
    def _planes(self) -> NDArray[np.float64]:
        return ConvexHull(np.asarray(self.corners, dtype=float)).equations

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return self._planes.shape[1] - 1

    def _each(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        return y @ self._planes[:, :-1].T + self._planes[:, -1]

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (m,), m."""
        return self._each(y).max(axis=1)

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (m, d) of the distance: where planes are as near, the mean of their normals."""
        each = self._each(y)
        near = each >= each.max(axis=1, keepdims=True) - ROUNDED * np.abs(each).max(axis=1, keepdims=True)
        return near @ self._planes[:, :-1] / near.sum(axis=1, keepdims=True)

    def curvature(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the second derivatives (m, d, d) of the distance, 1/m."""
        return _flat(y)

    def moved(self, by: NDArray[np.float64]) -> Convex:
        """Return the shape moved by a vector (d,), m."""
        return replace(self, corners=np.asarray(self.corners) + by)


@dataclass(frozen=True, eq=False)
class Cone:
    """A cone without end; in 2D a wedge.

    Parameters
    ----------
    tip : (d,), m
        Its tip.
    axis : (d,)
        Direction from the tip into the tool; of any length.
    angle_deg
        Between axis and flank, degrees, in (0, 90): 30 of a CPT's cone.
    """

    tip: ArrayLike
    axis: ArrayLike
    angle_deg: float

    def __post_init__(self):
        numbers("Cone: tip", self.tip, self._axis.shape, allowed=f"{len(self._axis)} finite coordinates")
        numbers("Cone: angle_deg", self.angle_deg, test=lambda a: (a > 0) & (a < 90), allowed="in (0, 90) degrees")

    @cached_property
    def _axis(self) -> NDArray[np.float64]:
        return _direction("Cone: axis", self.axis)

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return len(self._axis)

    def _polar(self, y: NDArray[np.float64]) -> tuple:
        """Return heights (m,) over the tip, and what `_across` gives of the offsets from the axis."""
        z = (y - self.tip) @ self._axis
        return z, *_across(y - self.tip - z[:, None] * self._axis)

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (m,), m, from the flank."""
        z, r, _, _ = self._polar(y)
        beta = np.radians(self.angle_deg)
        return r * np.cos(beta) - z * np.sin(beta)

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (m, d) of the distance."""
        beta = np.radians(self.angle_deg)
        return self._polar(y)[2] * np.cos(beta) - self._axis * np.sin(beta)

    def curvature(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the second derivatives (m, d, d) of the distance, 1/m."""
        _, r, _, second = self._polar(y)
        if y.shape[1] == 2:
            return _flat(y)
        near_axis = r[:, None, None] <= 1e-6 * np.abs(y - self.tip).max(initial=0.0)
        along = self._axis[:, None] * self._axis / np.where(near_axis, np.inf, r[:, None, None])
        return np.where(near_axis, 0.0, second - along) * np.cos(np.radians(self.angle_deg))

    def moved(self, by: NDArray[np.float64]) -> Cone:
        """Return the shape moved by a vector (d,), m."""
        return replace(self, tip=np.asarray(self.tip) + by)


@dataclass(frozen=True, eq=False)
class Distance:
    """A shape whose signed distance a function of the user's gives; its derivatives are differences over `step`, m.

    base : (d,), m — from which places count; of true places the function is asked.  Steps are powers of two, by which
    no true place is rounded to another one.
    """

    function: Callable[[NDArray[np.float64]], ArrayLike]
    step: float
    base: NDArray[np.float64] | float = 0.0

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (m,), m."""
        return self._at(y + self.base)

    def _at(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (m,), m, at true places."""
        if not len(y):  # a function need not have an answer for no places
            return np.zeros(0)
        allowed = f"a finite number for each of {len(y)} places (m, {y.shape[1]})"
        value = asked("Tool: shape", allowed, self.function, y)
        return numbers("Tool: shape", value, (len(y),), allowed=allowed)

    def normal(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (m, d) of the distance."""
        return self._slopes(y + self.base, _power_of_two(self.step))

    def _slopes(self, y: NDArray[np.float64], step: float) -> NDArray[np.float64]:
        """Return differences (m, d) of the distance over a step, m, at true places."""
        slopes = [(self._at(y + e) - self._at(y - e)) / (2 * step) for e in step * np.eye(y.shape[1])]
        return np.stack(slopes, axis=1)

    def curvature(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the second derivatives (m, d, d) of the distance, 1/m."""
        y, wide = y + self.base, _power_of_two(30 * self.step)  # of second differences less is lost in rounding
        steps = wide * np.eye(y.shape[1])
        slopes = [(self._slopes(y + e, wide) - self._slopes(y - e, wide)) / (2 * wide) for e in steps]
        return np.stack(slopes, axis=2)


def _power_of_two(x: float) -> float:
    """Return the power of two next to a number."""
    return float(2.0 ** np.rint(np.log2(x)))


class Pose(NamedTuple):
    """Where a tool is: R (d, d) turns it about `centre` (d,), m, and `shift` (d,), m, moves it."""

    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    shift: NDArray[np.float64]

    def own(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places x (m, d) in the frame of the tool."""
        y = x - self.shift
        return y + (y - self.centre) @ (self.R - np.eye(len(self.R)))  # what does not turn loses no digits

    def put(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where places y (m, d) of the tool are."""
        return y + self.shift + (y - self.centre) @ (self.R - np.eye(len(self.R))).T


@dataclass(frozen=True, eq=False)
class Tool:
    """A rigid tool that presses on the surface of the bodies, wherever it meets it.

    Nothing passes into it; what leaves it is free.  Where it touches, sides keep their hydraulic condition.  The forces
    and moments by which it acts on the bodies are the simulation's `tool_forces`.

    Parameters
    ----------
    shape : HalfSpace, Ball, Convex, Cone, or callable y (m, d) -> (m,), m
        The solid, as it is before its motion; a function gives the signed distance, positive outside of the tool.
    displacement : (d,) or callable t (s) -> (d,), m
        Of the tool from there; not since a stage.  In axisymmetry along the axis, without a rotation.
    rotation_rad : float or callable t (s) -> float, rad
        In 2D: turn about `centre`, anti-clockwise, before the displacement.
    centre : (d,), m
        About which it turns, and moments count; by default the origin.  It moves with the tool.
    friction
        Coulomb's coefficient mu, >= 0.
    adhesion
        Shear stress that the contact takes besides, Pa, >= 0: alpha s_u of undrained soil, with friction 0.  All of it
        where the normal pressure is a tenth of it or more, and as much less as that is less.
    load : float or callable t (s) -> float, N (N/m in plane strain), >= 0
        Pushes the tool along `direction`, beyond its displacement, as far as the bodies resist with as much, from the
        first step on; it begins where it touches them, or less than a cell before.  How far that is, is in the
        simulation's `tool_travel`.  In axisymmetry the load all around.
    direction : (d,)
        In which a load pushes; of any length; in axisymmetry along the axis.
    name
        By which its results are found, and what it has on points, as NAME_pressure; without, "tool".
        A tool of a later stage that is given the same name keeps that.

    Raises
    ------
    ValueError
        What is none that is allowed; from a step: the tool begins inside of a body, or meets a given displacement.
    """

    shape: Shape | Callable[[NDArray[np.float64]], ArrayLike]
    displacement: ArrayLike | Callable[[float], ArrayLike] = 0.0
    rotation_rad: float | Callable[[float], float] = 0.0
    centre: ArrayLike | None = None
    friction: float = 0.0
    adhesion: float = 0.0
    load: float | Callable[[float], float] | None = None
    direction: ArrayLike | None = None
    name: str | None = field(default=None, kw_only=True, repr=False)
    _base: ClassVar[NDArray[np.float64] | float] = 0.0
    _moved: ClassVar[Shape | None] = None

    def __post_init__(self):
        if not isinstance(self.shape, (HalfSpace, Ball, Convex, Cone)) and not callable(self.shape):
            raise ValueError(f"Tool: shape = {line(self.shape)}, must be a HalfSpace, Ball, Convex, Cone or a function")
        for name in ("friction", "adhesion"):
            value = getattr(self, name)
            numbers(f"Tool: {name}", value, test=lambda v: (v >= 0) & (v < np.inf), allowed=">= 0 and finite")
        if (self.load is None) != (self.direction is None):
            raise ValueError(f"{line(self)}: load and direction, must be given both, or none")
        for name in ("displacement", "rotation_rad", "load"):
            value = getattr(self, name)
            if callable(value):
                check_names(f"{line(self)}: {name}", value, ("t",))
            elif isinstance(value, (list, np.ndarray)):
                object.__setattr__(self, name, deepcopy(value))  # nobody changes it
        if self.load is not None and not callable(self.load):
            self.pushes(0.0)

    def pushes(self, t: float) -> float:
        """Return the load at time t (s), N; nan where none pushes the tool."""
        if self.load is None:
            return np.nan
        value = float(self._given("load", t))
        if not 0 <= value < np.inf:
            raise ValueError(f"{line(self)}: load at t = {t:g} s = {value:g}, must be >= 0 and finite")
        return value

    def _given(self, name: str, t: float, dim: int = 0) -> NDArray[np.float64]:
        """Return one of its values at time t (s): a number, or with a dimension also (d,)."""
        return given(f"{line(self)}: {name} at t = {t:g} s", getattr(self, name), t, None, dim)

    def along(self, dim: int) -> NDArray[np.float64]:
        """Return the unit vector (d,) in which a load pushes, zero without."""
        if self.direction is None:
            return np.zeros(dim)
        along = _direction("Tool: direction", self.direction)
        if len(along) != dim:
            raise ValueError(f"Tool: direction = {line(self.direction)}, must have {dim} components as the grid")
        return along

    def on(self, grid: Grid) -> Tool:
        """Return the tool as places see it that count from the grid's base."""
        out, base = copy(self), grid.base
        if base.any():
            vars(out).update(_base=base, _moved=None if callable(self.shape) else self.shape.moved(-base))
        return out

    @property
    def grips(self) -> bool:
        """Whether the tool resists slip."""
        return self.friction > 0 or self.adhesion > 0

    def solid(self, h: float) -> Shape:
        """Return the shape; h, m: size of a cell."""
        return Distance(self.shape, 1e-6 * h, self._base) if callable(self.shape) else self._moved or self.shape

    def check(self, dim: int) -> None:
        """Refuse a tool of another dimension, or whose motion at the start is none."""
        of = dim if callable(self.shape) else self.shape.dim
        if of != dim:
            raise ValueError(f"{line(self)}: a shape in {of}D, must be in {dim}D as the grid")
        if dim == 3 and (callable(self.rotation_rad) or self.rotation_rad):
            raise ValueError(f"{line(self)}: rotation_rad, must be 0 in 3D")
        for name in ("displacement", "rotation_rad"):  # what a function gives is checked when it is called
            if not callable(getattr(self, name)):
                self._given(name, 0.0, dim if name == "displacement" else 0)
        self._centre(dim)
        self.along(dim)

    def _centre(self, dim: int) -> NDArray[np.float64]:
        if self.centre is None:
            return np.zeros(dim) - self._base
        return numbers("Tool: centre", self.centre, (dim,), allowed=f"{dim} finite coordinates") - self._base

    def pose(self, t: float, dim: int, way: float = 0.0) -> Pose:
        """Return where the tool is at time t (s), after a load has pushed it by a way, m."""
        shift = self._given("displacement", t, dim)
        if shift.ndim == 0 and shift:
            raise ValueError(f"{line(self)}: displacement at t = {t:g} s = {shift:g}, must be {dim} finite numbers")
        R, angle = np.eye(dim), float(self._given("rotation_rad", t))
        if angle:
            R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return Pose(R, self._centre(dim), np.broadcast_to(shift, (dim,)) + way * self.along(dim))

    def drawn(self, grid: Grid, t: float, way: float = 0.0) -> NDArray[np.float64]:
        """Return the corners (m, 2^d, d), m, of the grid's cells that the tool fills at time t (s): for pictures.

        way, m: by which a load has pushed it.
        Corners beyond its surface are put onto it; so its edges are blunt by a part of a cell.
        """
        pose, solid, nodes = self.pose(t, grid.dim, way), self.solid(grid.h.min()), tuple(grid.shape + 1)
        y = pose.own(grid.lower + np.stack(np.unravel_index(np.arange(np.prod(nodes)), nodes), axis=1) * grid.h)
        inside = solid.distance(y) < -ROUNDED * grid.h.min()
        cells = grid.corners(np.arange(np.prod(grid.shape)))
        used, at = np.unique(cells[inside[cells].any(axis=1)], return_inverse=True)
        y = y[used]
        for _ in range(ONTO):  # where planes meet
            gap = solid.distance(y)
            if (gap <= ROUNDED * grid.h.min()).all():
                break
            y = y - np.maximum(gap, 0)[:, None] * solid.normal(y)
        return pose.put(y)[at.reshape(-1, cells.shape[1])]
