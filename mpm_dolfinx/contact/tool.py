# SPDX-License-Identifier: MIT
"""Rigid tools in contact with the bodies: their shape, contact strength, prescribed motion and loads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import check_names, given, line, numbers
from mpm_dolfinx.contact.shapes import ROUNDED, Ball, Convex, Distance, Placed, Shape, Uniform, uniform, unit_vector
from mpm_dolfinx.contact.surface_mesh import SurfaceMesh
from mpm_dolfinx.grid.grid import Grid

AS_CELL = [0, 1, 2, 2, 0, 1, 2, 2]  # triangle corner at each corner of a flat cell


class Pose(NamedTuple):
    """Pose of a tool: a rotation R about `centre` (d,), in m, and then a translation `shift` (d,), in m."""

    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    shift: NDArray[np.float64]

    def own(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert current positions x (m, d) to positions in the frame of the tool."""
        y, turn = x - self.shift, self.R - np.eye(len(self.R))
        return y + (y - self.centre) @ turn if turn.any() else y

    def put(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert positions y (m, d) in the frame of the tool to current positions."""
        return y + self.shift + (y - self.centre) @ (self.R - np.eye(len(self.R))).T

    def moved(self, by_forces: NDArray[np.float64]) -> Pose:
        """Return the pose after an additional displacement (d,), in m, and an optional rotation, in rad."""
        d = len(self.R)
        R = rotation(by_forces[d]) @ self.R if by_forces[d:].any() else self.R
        return Pose(R, self.centre, self.shift + by_forces[:d])


def rotation(angle: float) -> NDArray[np.float64]:
    """Return the matrix (2, 2) of a rotation by an angle, in rad."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def motion_by_forces(outcome: Mapping[str, Mapping[str, NDArray]], name: str) -> NDArray[np.float64]:
    """Return the displacement, in m, of a tool due to forces, and the rotation, in rad, if the tool rotates freely."""
    angle = outcome.get("tool_rotation", {})
    by_forces = outcome["tool_travel"][name]
    return np.append(by_forces, angle[name]) if name in angle else by_forces


@dataclass(frozen=True, eq=False, repr=False)
class Tool:
    """Rigid tool, for example a footing, pile or indenter, in contact with the bodies.

    Bodies cannot penetrate the tool, but may separate from it.  Contact does not change hydraulic boundary conditions.
    `Simulation.tool_forces` contains the forces and moments of the tool on the bodies.

    Parameters
    ----------
    shape : HalfSpace, Ball, Convex, Cone, SurfaceMesh, or callable y (m, d) -> (m,), m
        The tool in its initial position.  A function gives the signed distance from the tool, positive outside.
    displacement : (d,) or callable t (s) -> (d,), m
        Displacement from the initial position.  In axisymmetry, the displacement must be along the axis.
    rotation_rad : float or callable t (s) -> float, rad
        Counterclockwise rotation about `centre`, applied before the displacement.  Tools rotate in plane strain only.
    centre : (d,), m
        Centre of rotation, at the initial position of the tool.  Moments are about this centre.  A free tool has its
        centre of mass there.  The default is the centroid of a free disc or polygon, and the origin for other tools.
    friction
        Coulomb's coefficient mu, >= 0.
    adhesion
        Shear strength of the contact in addition to friction, Pa, >= 0; limited to ten times the normal pressure.  For
        undrained soil, use the product of the adhesion factor and s_u, with friction 0.
    load : float or callable t (s) -> float, N (N/m in plane strain), >= 0
        Force on the tool along `direction`.  The tool moves along `direction` until the reaction equals the load.  This
        motion is added to `displacement`, and `Simulation.tool_travel` contains it.  At the start, the gap between tool
        and body must be smaller than a cell.  In axisymmetry, the load is the total over the circumference.
    direction : (d,)
        Direction of the load, of any length.  In axisymmetry, the direction must be along the axis.
    mass
        Mass of a free tool, kg (kg/m in plane strain), > 0, for scenes with inertia.  Weight, load and contact forces
        move a free tool along `direction`, or by default in any direction.  The motion starts at the initial position
        plus `displacement`.  Results are the displacement `tool_travel` (d,), in m, and the velocity
        `outcome("tool_velocity")` (d,), in m/s.
    velocity : (d,), m/s
        Initial velocity of a free tool.
    moment
        Moment of inertia of a free tool about `centre`, kg m, > 0; only in plane strain.  The default for a disc or
        polygon is the moment of inertia of a uniform solid.  Other shapes, and tools with `direction`, rotate only with
        a given `moment`.  Results are `outcome("tool_rotation")`, in rad, and `outcome("tool_spin")`, in rad/s.
    spin
        Initial angular velocity of a free tool, rad/s, counterclockwise.
    name
        Name of the tool in results; by default "tool".  The point field NAME_pressure is the contact pressure.  A tool
        with the same name in a later stage continues with this pressure.

    Raises
    ------
    ValueError
        A value is invalid.  A step also raises this error if the tool starts in a body, or touches a side with
        prescribed displacement.
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
    moment: float | None = None
    spin: float = 0.0
    name: str | None = field(default=None, kw_only=True, repr=False)
    MOVED: ClassVar[tuple[str, ...]] = ("displacement", "rotation_rad")
    _base: ClassVar[NDArray[np.float64] | float] = 0.0
    _moved: ClassVar[Shape | None] = None

    def __repr__(self) -> str:
        """Return the call of the constructor, for messages.  Arguments equal to their defaults are left out."""
        given = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if getattr(self, f.name) is not f.default]
        return f"Tool({', '.join(given)})"

    def __post_init__(self):
        if not isinstance(self.shape, Placed) and not callable(self.shape):
            allowed = "a HalfSpace, Ball, Convex, Cone, SurfaceMesh or a function"
            raise ValueError(f"Tool: shape = {line(self.shape)}, must be {allowed}")
        for name in ("friction", "adhesion"):
            value = getattr(self, name)
            numbers(f"Tool: {name}", value, test=lambda v: (v >= 0) & (v < np.inf), allowed=">= 0 and finite")
        if (self.load is None) != (self.direction is None) and (self.load is not None or self.mass is None):
            what = f"Tool: load = {line(self.load)} and direction = {line(self.direction)}"
            raise ValueError(f"{what}, must be given together")
        self._check_free()
        for name, value in vars(self).items():
            if name in ("displacement", "rotation_rad", "load") and callable(value):
                check_names(f"{line(self)}: {name}", value, ("t",))
            elif isinstance(value, (list, np.ndarray, Placed)):
                object.__setattr__(self, name, deepcopy(value))  # protects against later changes
        if self.load is not None and not callable(self.load):
            self.pushes(0.0)

    def _check_free(self) -> None:
        """Raise an error for invalid arguments of a free tool."""
        if self.mass is None:
            of_free = {"velocity": self.velocity is None, "moment": self.moment is None, "spin": self.spin == 0}
            for name in [name for name, absent in of_free.items() if not absent][:1]:
                raise ValueError(f"Tool: {name} = {line(getattr(self, name))}, must be given with a mass")
            return
        numbers("Tool: mass", self.mass, test=lambda v: (v > 0) & (v < np.inf), allowed="> 0 and finite")
        numbers("Tool: spin", self.spin)
        if self.moment is not None:
            numbers("Tool: moment", self.moment, test=lambda v: v > 0, allowed="> 0, or infinity")
        if callable(self.displacement) or callable(self.rotation_rad):
            raise ValueError(
                f"{line(self)}: forces move a free tool, so displacement and rotation_rad must be constant"
            )

    @property
    def free(self) -> bool:
        """Whether forces move the tool."""
        return self.mass is not None

    def begins(self, dim: int) -> NDArray[np.float64]:
        """Return the initial velocity (d,), in m/s, of a free tool."""
        if self.velocity is None:
            return np.zeros(dim)
        v = numbers("Tool: velocity", self.velocity, (dim,), allowed=f"{dim} finite numbers")
        if np.linalg.norm(v - self.guide(dim) @ v) > ROUNDED * np.linalg.norm(v):
            raise ValueError(f"Tool: velocity = {line(self.velocity)}, must be along its direction")
        return v

    def guide(self, dim: int) -> NDArray[np.float64]:
        """Return the projection (d, d) onto the directions in which a free tool may move."""
        along = self.along(dim)
        return np.eye(dim) if self.direction is None else np.outer(along, along)

    def _uniform(self, dim: int) -> Uniform | None:
        """Return the centroid and squared radius of gyration of a free disc or polygon, or None for other tools."""
        if not self.free or dim != 2:
            return None
        if isinstance(self.shape, SurfaceMesh):
            return Uniform(self.shape.centroid, float(self.shape.inertia / self.shape.volume))
        return uniform(self.shape) if isinstance(self.shape, (Ball, Convex)) else None

    def inertia(self, dim: int) -> float:
        """Return the moment of inertia about the centre, in kg m^2, or infinity for a tool that does not rotate."""
        if self.moment is not None:
            return float(self.moment)
        of = self._uniform(dim)
        return np.inf if of is None or self.direction is not None else self.mass * of.gyration

    def rotates(self, dim: int) -> bool:
        """Whether forces rotate the tool."""
        return self.free and np.isfinite(self.inertia(dim))

    def pushes(self, t: float) -> float:
        """Return the load at time t (s), in N, or nan for a tool without a load."""
        if self.load is None:
            return np.nan
        value = float(self._given("load", t))
        if not 0 <= value < np.inf:
            raise ValueError(f"{line(self)}: load at t = {t:g} s = {value:g}, must be >= 0 and finite")
        return value

    def _given(self, name: str, t: float, dim: int = 0) -> NDArray[np.float64]:
        """Return the value of an attribute at time t, in s.  A vector has `dim` components."""
        return given(f"{self._title}: {name} at t = {t:g} s", getattr(self, name), t, None, dim)

    @cached_property
    def _title(self) -> str:
        """Representation of the tool in one line, for messages."""
        return line(self)

    def along(self, dim: int) -> NDArray[np.float64]:
        """Return the unit vector (d,) along `direction`, or zero without a direction."""
        if self.direction is None:
            return np.zeros(dim)
        along = unit_vector("Tool: direction", self.direction)
        if len(along) != dim:
            raise ValueError(f"Tool: direction = {line(self.direction)}, must have {dim} components in a {dim}D grid")
        return along

    def on(self, grid: Grid) -> Tool:
        """Return a copy of the tool for positions relative to `grid.base`."""
        out, base = copy(self), grid.base
        if base.any():
            vars(out).update(_base=base, _moved=None if callable(self.shape) else self.shape.moved(-base))
        return out

    @property
    def frictional(self) -> bool:
        """Whether the tool resists slip."""
        return self.friction > 0 or self.adhesion > 0

    def solid(self, h: float) -> Shape:
        """Return the shape.  `h` is the cell size, in m, for finite differences."""
        return Distance(self.shape, h, self._base) if callable(self.shape) else self._moved or self.shape

    def gap(self, y: NDArray[np.float64], h: float) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, of positions y (n, d) in the frame of the tool.

        For distances above the cell size `h`, in m, the result may be a lower bound.
        """
        solid = self.solid(h)
        return solid.distance_up_to(y, h) if isinstance(solid, SurfaceMesh) else solid.distance(y)

    def check(self, dim: int) -> None:
        """Raise an error for a tool of the wrong dimension, or with an invalid initial motion."""
        of = dim if callable(self.shape) else self.shape.dim
        if of != dim:
            raise ValueError(f"{line(self)}: the shape is in {of}D, must be in {dim}D like the grid")
        if dim == 3 and (callable(self.rotation_rad) or self.rotation_rad):
            raise ValueError(f"Tool: rotation_rad = {line(self.rotation_rad)}, must be 0 in 3D")
        for name in ("displacement", "rotation_rad"):  # values of functions are checked when they are used
            if not callable(getattr(self, name)):
                self._given(name, 0.0, dim if name == "displacement" else 0)
        self._centre(dim)
        self.along(dim)
        self.begins(dim)
        self._check_turns(dim)

    def _check_turns(self, dim: int) -> None:
        """Raise an error for an invalid rotation of a free tool."""
        of, rotates = self._uniform(dim), self.rotates(dim)
        if dim == 3 and rotates:
            raise ValueError(f"Tool: moment = {self.moment:g}, must be left out, because in 3D tools do not rotate")
        if self.spin and not rotates:
            raise ValueError(f"Tool: spin = {self.spin:g}, must be 0 for a tool that does not rotate")
        if not rotates:
            return
        if self.centre is None and of is None:
            raise ValueError(f"Tool: moment = {line(self.moment)}, centre = None: both must be given for this shape")
        if self.moment is None:
            off, size = self._centre(dim) + self._base - of.centroid, np.sqrt(of.gyration)
            if np.linalg.norm(off) > ROUNDED * (size + np.linalg.norm(of.centroid)):
                what = f"Tool: centre = {line(self.centre)}, must be the centroid {of.centroid}"
                raise ValueError(f"{what}, or be given with a moment")

    def _centre(self, dim: int) -> NDArray[np.float64]:
        if self.centre is None:
            of = self._uniform(dim)
            return (np.zeros(dim) if of is None else of.centroid) - self._base
        return numbers("Tool: centre", self.centre, (dim,), allowed=f"{dim} finite coordinates") - self._base

    def pose(self, t: float, dim: int, by_forces: NDArray[np.float64] | float = 0.0) -> Pose:
        """Return the pose at time t (s).

        `by_forces`: displacement along the load, in m, of a tool with a load.  For a free tool, `by_forces` is the
        displacement (d,), in m.  If the free tool rotates, the rotation, in rad, is appended.
        """
        shift = self._given("displacement", t, dim)
        if shift.ndim == 0 and shift:
            raise ValueError(f"{line(self)}: displacement at t = {t:g} s = {shift:g}, must be {dim} finite numbers")
        R = rotation(float(self._given("rotation_rad", t))) if dim == 2 else np.eye(dim)
        pose = Pose(R, self._centre(dim), np.broadcast_to(shift, (dim,)))
        return pose.moved(by_forces if np.ndim(by_forces) else by_forces * self.along(dim))

    def drawn(self, grid: Grid, t: float, by_forces: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
        """Return the corners (n, 2^d, d), in m, of the grid cells inside the tool at time t (s), for pictures.

        Corners of partly covered cells are projected onto the surface of the tool.  For a `SurfaceMesh` in 3D, the
        result contains its facets as flat cells.  `by_forces`: see `pose`.
        """
        pose = self.pose(t, grid.dim, by_forces)
        if isinstance(self.shape, SurfaceMesh) and grid.dim == 3:
            return pose.put(self.shape.vertices)[self.shape.facets[:, AS_CELL]]
        solid = self.solid(grid.least)
        nodes = tuple(grid.shape + 1)
        y = pose.own(grid.base + grid.places(np.stack(np.unravel_index(np.arange(np.prod(nodes)), nodes), axis=1)))
        inside = solid.distance(y) < -ROUNDED * grid.least
        cells = grid.corners(np.arange(np.prod(grid.shape)))
        used, at = np.unique(cells[inside[cells].any(axis=1)], return_inverse=True)
        y = y[used]
        for _ in range(2 * np.finfo(float).nmant):  # edges between planes need several projections
            gap = solid.distance(y)
            if (gap <= ROUNDED * grid.least).all():
                break
            y = y - np.maximum(gap, 0)[:, None] * solid.normal(y)
        return pose.put(y)[at.reshape(-1, cells.shape[1])]
