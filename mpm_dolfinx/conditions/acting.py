# SPDX-License-Identifier: MIT
"""Interface of all loads in the momentum balance: tractions, prescribed displacements, tools, weight, user conditions.

In each stage, the method `acting(setting)` of a condition creates an `Acting` with the loaded faces.  `Acting.placed`
returns the `Loads` of a substep, for the current position of these faces.  `Loads` add forces to the residual, and
stiffness to the tangent.  `flow/feeding.py` defines the same interface for the pore fluid.
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

from mpm_dolfinx.base.time_integration import GAMMA
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
"""Reactions, outflows and other results, by quantity (such as "reactions") and then by condition."""
QUANTITIES = ("reactions", "wall_reactions", "outflows", "tool_forces", "tool_travel")
"""Names of the results of conditions."""
OF_RAIN = ("rain", "runoff", "ran_off", "ponded")
"""Names of the results that only scenes with rain have."""
VOLUMES = {"outflows": "flowed", "rain": "rained"}
"""Names of the volumes that are time integrals of rates since the start of a condition, by the name of the rate."""
IMPULSES = {"reactions": "impulse", "tool_forces": "impulse", "wall_reactions": "wall_impulse"}
"""With inertia: names of the time integrals of forces since the start of a condition, by the name of the force."""
MOTIONS = ("tool_velocity", "tool_rotation", "tool_spin")
"""Names of the results that only free tools have."""


class FormsOf:
    """Forms of the conditions of a scene, compiled at first use."""

    def __init__(self, grid: Grid, u: fem.Function, velocity: Velocity):
        self.grid, self.u = grid, u
        self.velocity = velocity
        self._made: dict[Callable, Any] = {}

    def __call__(self, make: Callable[..., T], *more) -> T:
        """Return the forms `make(grid, u, *more)`.  The first call for each class `make` compiles the forms."""
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
        """Prescribed displacements of the stage, each with its faces and its prescribed axes."""
        holds = [(hold, hold.axes(self.grid.dim)) for hold in self.of(Displacement).values()]
        rest = [[other for other, more in holds if other is not hold and set(axes) & set(more)] for hold, axes in holds]
        return [(hold, self.sides.held(hold, those), axes) for (hold, axes), those in zip(holds, rest, strict=True)]

    def of(self, *kinds: type) -> dict[str, Any]:
        """Return the conditions of the given classes, by name."""
        return {name: one for name, one in self.conditions.items() if isinstance(one, kinds)}


class Place(NamedTuple):
    """Geometry, points and times of a substep, for the conditions."""

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

    @property
    def rate(self) -> float:
        """Derivative of acceleration with respect to displacement in a substep of SDIRK2, 1/s^2; 0 without inertia."""
        return 1 / (GAMMA * self.dt) ** 2 if self.inertia and self.dt > 0 else 0.0


class Shares(NamedTuple):
    """Time weights and gravity of a substep, see `Substep`."""

    own: float  # weight of the rate in this substep, s
    before: float  # weight of the rate in the previous substep, s
    gravity: NDArray[np.float64] | None  # at the end of the substep (d,), m/s^2; None without gravity


class At(NamedTuple):
    """Displacement increment of the step in one iteration of Newton's method."""

    unknowns: Unknowns  # numbering of the unknowns in u
    u: NDArray[np.float64]  # nodal displacement increments (dofs,), m
    parts: Parts | None = None  # connected parts of the bodies
    held: NDArray[np.float64] | None = None  # forces `State.held` (dofs,), N; None without them

    @property
    def nodal(self) -> NDArray[np.float64]:
        """Displacement increment as an array (nodes, d), m."""
        return self.u.reshape(-1, self.unknowns.dim)


class Loads:
    """Forces and tangents of the conditions of one kind in a substep.  The methods of this base class add nothing.

    Arguments b are flat arrays of forces, in N, at the local nodes.
    """

    linear: bool = True
    """Whether the tangent is independent of the displacement."""
    smooth: bool = True
    """Whether the tangent of a substep may be reused in the next substep."""
    stiff: bool = False
    """Whether `penalty` adds a matrix."""
    holding: bool = False
    """Whether the condition may support bodies by constraints that `touching` does not return."""
    couples: bool = False
    """Whether the tangent couples nodes of different cells."""
    rounding_at_unknowns: NDArray[np.float64] | float = 0.0
    """Rounding errors of the forces at the unknowns in this substep, in N."""
    touches: bool = False
    """Whether the condition is a contact, which may open."""
    conducts: bool = False
    """Whether fluid may pass between the pairs of cells that `within_reach` returns."""
    key: Any = None
    """Cache key: penalty matrix and sparsity pattern are reused while it does not change."""

    def joined(self, substeps: Sequence[Any]) -> Loads:
        """Return the loads with a sparsity pattern that is valid in all substeps of the step."""
        return self

    def begun(self, shares: Shares, earlier: Any) -> Loads:
        """Return these loads, prepared for a substep with inertia.

        `earlier`: result of `flown` in the previous substep.
        """
        return self

    def flown(self, at: At) -> Any:
        """Return values of this converged substep that the next substep with inertia needs."""

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """Return the dissipation by slip, and a correction of the external power, in W, on this process.

        `v`, m/s: nodal velocities.  The external power is the power of the forces in `push`, plus the correction.
        """
        return 0.0, 0.0

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add forces that are constant during the substep."""

    def pulls(self, b: NDArray[np.float64]) -> None:
        """Add the part of the penalty forces that is independent of u."""

    def loads(self, b: NDArray[np.float64]) -> None:
        """Add external forces that depend on u."""

    def resists(self, b: NDArray[np.float64]) -> None:
        """Add resisting forces at u, with the sign of the internal forces."""

    def takes_up(self, b: NDArray[np.float64]) -> None:
        """Add forces at u that count as internal forces, such as minus the weight of pore fluid that flows in."""

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the stiffness matrix of forces linear in u.  `walls`: whether to add rows of dofs that walls fix."""

    def pulling(self, at: At, v: NDArray[np.float64]) -> float:
        """Return the power (W) of the forces of `pulls` and `penalty` at u and nodal velocities v, on this process."""
        return 0.0

    def tangent(self, K: PETSc.Mat) -> None:
        """Add the derivative, with respect to u, of `resists` minus `loads`.  The caller assembles K."""

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Subtract contact forces, inertia forces and forces of tied sides at u from the residual."""

    def inertia(self, at: At) -> PETSc.Vec | None:
        """Return the inertia forces at u, in N, or None without inertia."""

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return a zero matrix with the sparsity pattern of `coupling`, or None if `coupling` returns None."""

    def joins(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return a zero matrix with the sparsity pattern of couplings between cell pressures, or None if none exist."""

    def coupling(self, at: At) -> PETSc.Mat | None:
        """Return minus the derivative, with respect to u, of the forces in `push`, or None if `tangent` adds it."""

    def settle(self, at: At, sticks: bool) -> bool:
        """Update the set of slipping positions, and return whether it changed.  If `sticks`, some may stick again."""
        return False

    def augment(self, at: At) -> bool:
        """Update the multipliers after equilibrium is reached, and return whether forces changed."""
        return False

    def follow(self, at: At) -> bool:
        """Update the contact positions, and return whether the equilibrium changed."""
        return False

    def guess(self, parts: Parts, nodal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return an initial guess of the displacements (nodes, d), in m, or None without a guess."""

    def moved(self, u: fem.Function) -> Loads:
        """Return the loads after an additional displacement u (m) of the nodes."""
        return self

    def counted(self, at: At) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return local dofs (n,), and forces (n,) on them, in N, that wall reactions must not include."""
        return np.empty(0, dtype=np.int64), np.empty(0)

    def within_reach(self) -> NDArray[np.int64]:
        """Return the pairs (n, 2) of cells, by lexicographic index, that the condition may couple in the step."""
        return np.empty((0, 2), dtype=np.int64)

    def touching(self) -> tuple | None:
        """Return the constraints that this condition imposes on displacements, before the first iteration.

        The result has cells (n,), opposite cells (n,), positions (n, d) and directions (n, d) of n constraints.  In
        contact of two bodies, opposite cells belong to the second body; otherwise they are None.
        """

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """Local cells with sides whose displacement is prescribed."""
        return np.empty(0, dtype=np.int32)

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rounding errors (cells,), in N, of forces in local cells.  `of_cells`: errors due to stresses."""
        return of_cells

    @property
    def rounding_beside(self) -> float:
        """Return the largest rounding error, in N, of contact forces in the opposite cells (see `touching`)."""
        return 0.0

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the reactions and other results at u, by quantity and then by condition."""
        return {}

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points after an update of the point fields of this condition."""
        return points

    def ended(self, at: At) -> Loads:
        """Return these loads, with the state that they have at the end of the step."""
        return self

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners (n, 2^d, d) are near a contact after a step, and get no correction of the Q1 field."""
        return False

    def outside(
        self, corners: NDArray[np.float64], free: NDArray[np.bool_], everywhere: bool = False
    ) -> NDArray[np.float64]:
        """Return the corners (n, 2^d, d), in m, after corners inside tools have moved out.

        `free` (n, 2^d, d): components that may change.
        `everywhere`: whether to correct large penetrations too.
        """
        return corners

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return corners (n, 2^d, d), in m, of re-initialised domains.  At prescribed displacements, they form prisms.

        `ids` (n,): identifiers of the points.
        `tracked`: corners before the re-initialisation from F; `corners`: corners after it.
        `volume` (n,), in m^d: volumes of the domains.
        """
        return corners

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise an error if the positions after a step are invalid, for example inside a tool.

        `before`: points at the start of the step.
        """


def defined(loads: Sequence[Loads], *names: str) -> dict[str, list[Callable]]:
    """Return the methods that loads define, by name.  Methods of the class `Loads` add nothing, and are left out."""
    found = {name: [] for name in names}
    for one in loads:
        for name, methods in found.items():
            if getattr(type(one), name) is not getattr(Loads, name):
                methods.append(getattr(one, name))
    return found


class Acting:
    """All conditions of one kind in a stage."""

    conditions: ClassVar[tuple[type, ...]] = ()
    """Classes of conditions of this kind."""
    title: ClassVar[str] = "user-defined conditions"
    """Name of this kind in the summary of a scene."""
    symmetric: bool = True
    """Whether the tangent is symmetric."""
    linear: bool = True
    """Whether the tangent is independent of the displacement."""
    surfaces: Sequence[Surface] = ()
    """Loaded faces."""
    outside: Surface | None = None
    """Faces that tools may touch, or None without tools."""
    held: Sequence[tuple[Any, Surface, Sequence[int]]] = ()
    """Prescribed displacements, each with condition, faces and prescribed axes."""
    seeded: Sequence[Surface] = ()
    """Faces, without `held`, whose conditions refer to seeded positions.  Renewal must not replace their domains."""

    def placed(self, place: Place) -> Loads:
        """Return the loads of a substep."""
        raise NotImplementedError

    def check_start(self, place: Place) -> None:
        """Raise an error if the stage cannot start from the current positions."""

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return initial values, at n points, of the point fields of this condition, by condition and field name."""
        return {}

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return placeholders for results, by quantity and condition: each component is `value`."""
        return {}
