# SPDX-License-Identifier: MIT
"""Rigid tools that press on the bodies, and how they move."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy, deepcopy
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import check_names, given, line, numbers
from mpm_dolfinx.contact.shapes import ROUNDED, Ball, Cone, Convex, Distance, HalfSpace, Shape, unit_vector
from mpm_dolfinx.grid.grid import Grid

ONTO = 100  # times at most that a place is put onto the surface


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
    mass
        Of a free tool, kg (kg/m in plane strain), > 0, beside bodies with inertia: its weight, its load and what it
        touches move it from `displacement`, along `direction` if there is one, else in any; it does not turn.  How far
        is in `tool_travel` (d,), m, its velocity in `outcome("tool_velocity")` (d,), m/s.
    velocity : (d,), m/s
        Of a free tool, as it begins.
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
    mass: float | None = None
    velocity: ArrayLike | None = None
    name: str | None = field(default=None, kw_only=True, repr=False)
    _base: ClassVar[NDArray[np.float64] | float] = 0.0
    _moved: ClassVar[Shape | None] = None

    def __post_init__(self):
        if not isinstance(self.shape, (HalfSpace, Ball, Convex, Cone)) and not callable(self.shape):
            raise ValueError(f"Tool: shape = {line(self.shape)}, must be a HalfSpace, Ball, Convex, Cone or a function")
        for name in ("friction", "adhesion"):
            value = getattr(self, name)
            numbers(f"Tool: {name}", value, test=lambda v: (v >= 0) & (v < np.inf), allowed=">= 0 and finite")
        if (self.load is None) != (self.direction is None) and (self.load is not None or self.mass is None):
            raise ValueError(f"{line(self)}: load and direction, must be given both, or none")
        self._check_free()
        for name in ("displacement", "rotation_rad", "load"):
            value = getattr(self, name)
            if callable(value):
                check_names(f"{line(self)}: {name}", value, ("t",))
            elif isinstance(value, (list, np.ndarray)):
                object.__setattr__(self, name, deepcopy(value))  # nobody changes it
        if self.load is not None and not callable(self.load):
            self.pushes(0.0)

    def _check_free(self) -> None:
        """Refuse a mass that is none, and what only free tools have, or have not."""
        if self.mass is None:
            if self.velocity is not None:
                raise ValueError(f"{line(self)}: velocity, must be given with a mass")
            return
        numbers("Tool: mass", self.mass, test=lambda v: (v > 0) & (v < np.inf), allowed="> 0 and finite")
        if callable(self.displacement) or callable(self.rotation_rad):
            raise ValueError(
                f"{line(self)}: a free tool moves by itself, displacement and rotation_rad must be constant"
            )

    @property
    def free(self) -> bool:
        """Whether forces move the tool."""
        return self.mass is not None

    def begins(self, dim: int) -> NDArray[np.float64]:
        """Return the velocity (d,), m/s, with which a free tool begins."""
        if self.velocity is None:
            return np.zeros(dim)
        v = numbers("Tool: velocity", self.velocity, (dim,), allowed=f"{dim} finite numbers")
        if not np.allclose(v, self.guide(dim) @ v):
            raise ValueError(f"Tool: velocity = {line(self.velocity)}, must be along its direction")
        return v

    def guide(self, dim: int) -> NDArray[np.float64]:
        """Return the projection (d, d) on the ways that a free tool may go."""
        along = self.along(dim)
        return np.eye(dim) if self.direction is None else np.outer(along, along)

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
        along = unit_vector("Tool: direction", self.direction)
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
        return Distance(self.shape, h, self._base) if callable(self.shape) else self._moved or self.shape

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
        self.begins(dim)

    def _centre(self, dim: int) -> NDArray[np.float64]:
        if self.centre is None:
            return np.zeros(dim) - self._base
        return numbers("Tool: centre", self.centre, (dim,), allowed=f"{dim} finite coordinates") - self._base

    def pose(self, t: float, dim: int, way: NDArray[np.float64] | float = 0.0) -> Pose:
        """Return where the tool is at time t (s), after forces have pushed it by a way, m, a vector of a free tool."""
        shift = self._given("displacement", t, dim)
        if shift.ndim == 0 and shift:
            raise ValueError(f"{line(self)}: displacement at t = {t:g} s = {shift:g}, must be {dim} finite numbers")
        R, angle = np.eye(dim), float(self._given("rotation_rad", t))
        if angle:
            R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        gone = way if np.ndim(way) else way * self.along(dim)
        return Pose(R, self._centre(dim), np.broadcast_to(shift, (dim,)) + gone)

    def drawn(self, grid: Grid, t: float, way: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
        """Return the corners (m, 2^d, d), m, of the grid's cells that the tool fills at time t (s): for pictures.

        way, m: by which forces have pushed it, see `pose`.
        Corners beyond its surface are put onto it; so its edges are blunt by a part of a cell.
        """
        pose = self.pose(t, grid.dim, way)
        solid = self.solid(grid.h.min())
        nodes = tuple(grid.shape + 1)
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
