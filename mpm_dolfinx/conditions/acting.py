# SPDX-License-Identifier: MIT
"""Interface of all loads in the momentum balance: tractions, prescribed displacements, tools, weight, user conditions.

The method `acting(setting)` of a condition returns an `Acting`.  See `flow/feeding.py` for conditions on the fluid.

A condition acts on three levels: stage, substep, assembly.  `Acting` is created once in a stage and holds loaded faces.
`Acting.placed` returns the `Loads` of a substep at the current position of the faces.  At each assembly `Loads` add
forces to the residual and stiffness to the tangent.  The code of the step and of the momentum balance calls only this
interface, and names no particular condition.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, TypeVar

from petsc4py import PETSc

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.conditions import Displacement
from mpm_dolfinx.conditions.sides import Sides
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.forms.velocity import Velocity
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.parts import Parts

T = TypeVar("T")

Outcome = Mapping[str, Mapping[str, NDArray[np.float64]]]
"""Reactions, outflows and other results of the conditions: quantity (such as "reactions") -> condition -> values."""
QUANTITIES = ("reactions", "wall_reactions", "outflows", "tool_forces", "tool_travel")
"""Quantities that the conditions of the package return."""
OF_RAIN = ("runoff", "flowed", "ran_off", "ponded")
"""Further quantities of scenes with rain."""
MOTIONS = ("tool_velocity", "tool_rotation", "tool_spin")
"""Further quantities of free tools."""


class FormsOf:
    """Compiled forms of the conditions of a scene.  Each kind of form is compiled at the first use.

    grid: background grid; u: displacement increment of the step, m; velocity: velocity of the bodies in a substep.
    """

    def __init__(self, grid: Grid, u: fem.Function, velocity: Velocity):
        self.grid, self.u = grid, u
        self.velocity = velocity
        self._made: dict[Callable, Any] = {}

    def __call__(self, make: Callable[..., T], *more) -> T:
        """Return the forms `make(grid, u, ...)` with further arguments, compiled once for each class `make`."""
        if make not in self._made:
            self._made[make] = make(self.grid, self.u, *more)
        return self._made[make]

    @property
    def made(self) -> set[str]:
        """Names of the form classes compiled so far."""
        return {make.__name__ for make in self._made}


@dataclass(frozen=True, eq=False)
class Setting:
    """Data that all conditions of a stage share."""

    sides: Sides  # finds the faces of conditions
    free: NDArray[np.bool_]  # whether no wall fixes a displacement component (nodes, d)
    materials: SceneMaterials  # materials of the scene
    forms: FormsOf  # compiled forms of the scene's conditions
    conditions: Mapping[str, Any]  # all conditions of the stage, by name

    @property
    def grid(self) -> Grid:
        """Background grid."""
        return self.sides.grid

    @cached_property
    def held(self) -> list[tuple[Displacement, Surface, Sequence[int]]]:
        """Prescribed displacements of the stage, with the faces and the axes on which they are imposed."""
        holds = [(hold, hold.axes(self.grid.dim)) for hold in self.of(Displacement).values()]
        rest = [[other for other, more in holds if other is not hold and set(axes) & set(more)] for hold, axes in holds]
        return [(hold, self.sides.held(hold, those), axes) for (hold, axes), those in zip(holds, rest, strict=True)]

    def of(self, *kinds: type) -> dict[str, Any]:
        """Return the conditions of the given classes, by name."""
        return {name: one for name, one in self.conditions.items() if isinstance(one, kinds)}


class Place(NamedTuple):
    """Positions and times at which conditions act in a substep."""

    cut: CutDomains  # particle domains cut by the grid
    fill: NDArray[np.float64]  # fraction of the volume of each local cell that bodies fill
    points: MaterialPoints  # material points at the start of the step
    pieces: Any  # quadrature points, see `QuadratureData`
    start: float  # start of the step, s
    dt: float  # length of the step, s
    t: float  # end of the substep, s
    before: Outcome  # reactions, outflows and other results of the previous step
    inertia: bool = False  # whether the bodies have inertia
    begins: bool = False  # whether the step is the first of its stage


class Shares(NamedTuple):
    """Time weights and gravity of a substep, see `Substep`."""

    own: float  # weight of the rate in this substep, s
    before: float  # weight of the rate in the previous substep, s
    gravity: NDArray[np.float64] | None  # (d,), m/s^2, at the end of the substep; None without gravity


class At(NamedTuple):
    """Numbering of the unknowns, displacement increment u of the step (a local array, m), and connected parts."""

    unknowns: Unknowns
    u: NDArray[np.float64]
    parts: Parts | None = None

    @property
    def nodal(self) -> NDArray[np.float64]:
        """Displacement increment as an array (nodes, d), m."""
        return self.u.reshape(-1, self.unknowns.dim)


class Loads:
    """Forces and tangents of the conditions of one kind in a substep.  A method that is not overridden adds nothing.

    Arrays b are local, unrolled nodal forces, N.  Entries at ghost nodes are added at their owners.
    """

    linear: bool = True
    """Whether the tangent is independent of the displacement."""
    smooth: bool = True
    """Whether the tangent of a substep may be used in the next substep."""
    varies: bool = False
    """Whether `loads` and `resists` depend on the displacement."""
    stiff: bool = False
    """Whether the condition adds a `penalty`."""
    holding: bool = False
    """Whether the condition may constrain bodies in ways that `touching` does not report."""
    couples: bool = False
    """Whether the tangent couples nodes of different cells."""
    touches: bool = False
    """Whether this is a contact with a tool or another body, from which bodies may separate."""
    key: Any = None
    """Key of everything on which the penalty, or the pattern, depends, except for the positions of faces."""

    def joined(self, substeps: Sequence[Any]) -> Loads:
        """Return the loads with the pattern of the same condition in all substeps of the step."""
        return self

    def begun(self, shares: Shares, earlier: Any) -> Loads:
        """Return the loads for a substep with inertia.  `earlier` is the result of `flown` in the previous substep."""
        return self

    def flown(self, at: At) -> Any:
        """With inertia, return the data of this converged substep that the next substep needs."""

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """Return two powers at u on this process, W: the dissipation by slip, and the correction of the external power.

        The external power is first computed from the forces in `push` and the nodal velocities v, a local array, m/s.
        """
        return 0.0, 0.0

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add forces that are constant during the substep."""

    def pulls(self, b: NDArray[np.float64]) -> None:
        """Add the constant part of the penalty forces.  The scale of residuals does not include these forces."""

    def loads(self, b: NDArray[np.float64]) -> None:
        """Add forces that depend on u."""

    def resists(self, b: NDArray[np.float64]) -> None:
        """Add resisting forces at u, with the sign of the internal forces."""

    def takes_up(self, b: NDArray[np.float64]) -> None:
        """Add forces at u that count as internal forces; the scale of residuals includes them."""

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the matrix of forces that are linear in u.  `walls`: whether to add rows of components fixed by walls."""

    def pulling(self, at: At, v: NDArray[np.float64]) -> float:
        """Return the power, W, of `pulls` and `penalty` at u on this process.  `v`: velocities, a local array, m/s."""
        return 0.0

    def tangent(self, K: PETSc.Mat) -> None:
        """Add the derivative of `resists` minus `loads` at u, without final assembly."""

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Subtract forces at u from the residual of unknowns or fixed components.  The scale omits these forces."""

    def inertia(self, at: At) -> PETSc.Vec | None:
        """Return the inertia forces at u, N, or None.  These forces enter the residual and its scale."""

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return a zero matrix with the entries that `coupling` adds to the pattern of the cells, or None."""

    def coupling(self, at: At) -> PETSc.Mat | None:
        """Return minus the derivative of the forces in `push`, without the part in `tangent`."""

    def settle(self, at: At, sticks: bool) -> bool:
        """Update which points slip at u; return whether any point changed.  `sticks`: whether points may stick."""
        return False

    def augment(self, at: At) -> bool:
        """When equilibrium is reached, update the multipliers; return whether forces changed."""
        return False

    def follow(self, at: At) -> bool:
        """Update the contact positions at u, and return whether equilibrium changed."""
        return False

    def guess(self, parts: Parts, nodal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return an initial guess of the displacements (nodes, d), m, or None."""

    def moved(self, u: fem.Function) -> Loads:
        """Return the loads in the initial state, with the penalty forces that a displacement u, m, causes."""
        return self

    def counted(self, at: At) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return local dofs (n,) on walls, unrolled, and their loads (n,), N, which are not part of wall reactions."""
        return np.empty(0, dtype=np.int64), np.empty(0)

    def within_reach(self) -> NDArray[np.int64]:
        """Return pairs (m, 2) of lexicographic cells, on this process, that the condition may couple in the step."""
        return np.empty((0, 2), dtype=np.int64)

    def touching(self) -> tuple | None:
        """Return the initial constraints: cells (m,), cells of the other body (m,), positions and directions (m, d).

        Cells of the other body are None if that body does not deform.
        """

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """Local cells with sides whose displacement is prescribed."""
        return np.empty(0, dtype=np.int32)

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rounding errors (cells,), N, of forces in local cells.  `of_cells`: errors without this condition."""
        return of_cells

    @property
    def rounding_beside(self) -> float:
        """Rounding error of the forces, N, in the cells of other bodies in contact."""
        return 0.0

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the reactions and other results at u: quantity -> condition -> values."""
        return {}

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with the updated history of the condition."""
        return points

    def ended(self, at: At) -> Loads:
        """Return the loads at the end of the step."""
        return self

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners (n, 2^d, d), m, are near a contact after a step, and must follow the Q1 field alone."""
        return False

    def outside(
        self, corners: NDArray[np.float64], free: NDArray[np.bool_], everywhere: bool = False
    ) -> NDArray[np.float64]:
        """Return the corners (n, 2^d, d), m, moved out of forbidden regions.

        `free` (n, 2^d, d) tells which components no other condition prescribes.  By default only small penetrations
        are corrected; with `everywhere`, penetrations of any depth are corrected.
        """
        return corners

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return new corners (m, 2^d, d), m, of re-initialised domains; on prescribed sides these are tracked corners.

        `ids` (m,) identify the points; `tracked` are the tracked corners, `corners` the corners initialised from F, and
        `volume` (m,), m^d, the volumes.  A domain with a face on a prescribed side becomes a prism of its volume.
        """
        return corners

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise an error if points lie in forbidden regions after a step; `before` are the points at the start."""


class Acting:
    """All conditions of one kind in a stage.

    Parameters
    ----------
    setting
        Data that all conditions of the stage share.
    """

    conditions: ClassVar[tuple[type, ...]] = ()
    """Classes of conditions of this kind."""
    title: ClassVar[str] = "user-defined conditions"
    """Name in the summary of a scene."""
    symmetric: bool = True
    """Whether the tangent is symmetric."""
    linear: bool = True
    """Whether the tangent is independent of the displacement."""
    surfaces: Sequence[Surface] = ()
    """Loaded faces; the grid cuts all of them together."""
    outside: Surface | None = None
    """Faces that tools may touch; None without tools."""
    held: Sequence[tuple[Any, Surface, Sequence[int]]] = ()
    """Prescribed displacements: (condition, faces, prescribed axes)."""
    seeded: Sequence[Surface] = ()
    """Further faces whose displacement from the seeded position is needed; renewal must not replace their domains."""

    def placed(self, place: Place) -> Loads:
        """Return the loads of a substep."""
        raise NotImplementedError

    def check_start(self, place: Place) -> None:
        """Raise an error if the stage cannot start from the current positions."""

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the initial history of n points: condition -> name of the data -> values."""
        return {}

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the results of the conditions before the first step, all equal to `value`."""
        return {}
