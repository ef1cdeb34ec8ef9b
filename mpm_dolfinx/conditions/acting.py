# SPDX-License-Identifier: MIT
"""Interface of all loads on the momentum: tractions, prescribed displacements, tools, weight, user conditions.

A condition has a method `acting(setting)` that returns an `Acting`.  Conditions on the fluid: `flow/feeding.py`.

Each condition has three levels.  `Acting` is made once a stage and finds the faces.  `Acting.placed` returns the
`Loads` of a substep at the present position of the faces.  `Loads` add to residual and tangent at each assembly.  The
step and the momentum balance loop over all of them, and know no condition by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

from petsc4py import PETSc

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.bodies.faces import Surface
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
"""Effects of conditions on the bodies, by quantity, such as "reactions", and by name of the condition."""
QUANTITIES = ("reactions", "wall_reactions", "outflows", "tool_forces", "tool_travel")
"""Quantities of the package's own conditions."""
MOTIONS = ("tool_velocity", "tool_rotation", "tool_spin")
"""Quantities of free tools."""


class FormsOf:
    """Compiled forms of a scene's conditions; each kind of form is made at its first use.

    Parameters
    ----------
    grid
        Background grid.
    u
        Displacement increment of the step, m.
    velocity
        Velocity of the bodies in a substep.
    """

    def __init__(self, grid: Grid, u: fem.Function, velocity: Velocity):
        self.grid, self.u = grid, u
        self.velocity = velocity
        self._made: dict[Callable, Any] = {}

    def __call__(self, make: Callable[..., T], *more) -> T:
        """Return the forms that the class `make` returns for grid, u and further arguments; each class only once."""
        if make not in self._made:
            self._made[make] = make(self.grid, self.u, *more)
        return self._made[make]

    @property
    def made(self) -> set[str]:
        """Names of the form classes in use."""
        return {make.__name__ for make in self._made}


@dataclass(frozen=True, eq=False)
class Setting:
    """Setting of the conditions in a stage.

    sides: finds the faces of conditions; free (nodes, d): components without a fixing wall; materials: the scene's;
    forms: the scene's compiled forms; conditions: all conditions of the stage, by name.
    """

    sides: Sides
    free: NDArray[np.bool_]
    materials: SceneMaterials
    forms: FormsOf
    conditions: Mapping[str, Any]

    @property
    def grid(self) -> Grid:
        """Background grid."""
        return self.sides.grid

    def of(self, *kinds: type) -> dict[str, Any]:
        """Return the conditions of the given classes, by name."""
        return {name: one for name, one in self.conditions.items() if isinstance(one, kinds)}


class Place(NamedTuple):
    """Place and time of a condition in a substep.

    cut: cut particle domains; fill: volume fraction of the local cells; points: present points; pieces: quadrature
    points, see `QuadratureData`; start, dt: start and length of the step, s; t: end of the substep, s; before: outcome
    of the last step; inertia: whether the bodies have inertia.
    """

    cut: CutDomains
    fill: NDArray[np.float64]
    points: MaterialPoints
    pieces: Any
    start: float
    dt: float
    t: float
    before: Outcome
    inertia: bool = False


class Shares(NamedTuple):
    """Time weights own and before of a substep, s, see `Substep`; gravity (d,), m/s^2, in it, None without."""

    own: float
    before: float
    gravity: NDArray[np.float64] | None


class At(NamedTuple):
    """Displacement increment u of the step, a local array, m, and the numbering of its unknowns."""

    unknowns: Unknowns
    u: NDArray[np.float64]

    @property
    def nodal(self) -> NDArray[np.float64]:
        """u as an array (nodes, d), m."""
        return self.u.reshape(-1, self.unknowns.dim)


class Loads:
    """Effect of a condition in a substep.  Methods that a subclass does not define have no effect.

    Arrays b are local nodal forces, unrolled, N; entries at ghosts are added at their owners.
    """

    linear: bool = True
    """Whether the tangent is independent of the displacement."""
    smooth: bool = True
    """Whether the tangent of a substep may serve in the next one."""
    varies: bool = False
    """Whether `loads` and `resists` depend on the displacement."""
    stiff: bool = False
    """Whether there is a `penalty`."""
    holding: bool = False
    """Whether bodies may be constrained in ways that `touching` does not report."""
    couples: bool = False
    """Whether the tangent couples nodes of different cells."""
    touches: bool = False
    """Whether bodies may separate from the condition."""
    key: Any = None
    """Key of all dependences of the penalty except the positions of faces."""

    def begun(self, shares: Shares, gone: Any) -> Loads:
        """Return the loads for a substep with inertia; gone: result of `flown` in the previous substep."""
        return self

    def flown(self, at: At) -> Any:
        """Return data of this solved substep for the next one, with inertia."""

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """Return powers at u on this process, W: dissipation by slip, and further power that `push` leaves out.

        v: velocities, a local array, m/s.
        """
        return 0.0, 0.0

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add forces that are constant in the substep."""

    def pulls(self, b: NDArray[np.float64]) -> None:
        """Add the forces of the penalty that do not depend on u; they do not enter the scale of residuals."""

    def loads(self, b: NDArray[np.float64]) -> None:
        """Add forces that depend on u."""

    def resists(self, b: NDArray[np.float64]) -> None:
        """Add resisting forces at u, with the sign of internal forces."""

    def takes_up(self, b: NDArray[np.float64]) -> None:
        """Add forces at u that enter the scale of residuals together with internal forces."""

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the matrix of forces linear in u; walls: add the rows of components fixed by walls."""

    def pulling(self, at: At, v: NDArray[np.float64]) -> float:
        """Return the power, W, of `pulls` and `penalty` at u on this process; v: velocities, a local array, m/s."""
        return 0.0

    def tangent(self, K: PETSc.Mat) -> None:
        """Add the derivative at u of `resists`, less that of `loads`, without final assembly."""

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Subtract forces at u from a residual of the unknowns or of fixed components; they do not enter its scale."""

    def inertia(self, at: At) -> PETSc.Vec | None:
        """Return forces at u, N, that add to the residual of the unknowns and to its scale; None without."""

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return a zero matrix with the pattern of `coupling` beyond that of the cells; None if there is none."""

    def coupling(self, at: At) -> PETSc.Mat | None:
        """Return minus the derivative of the forces in `push`, except for the part in `tangent`."""

    def settle(self, at: At, sticks: bool) -> bool:
        """Update the slipping set at u and, if sticks, let points return to stick; return whether the set changed."""
        return False

    def augment(self, at: At) -> bool:
        """Update the multipliers at equilibrium; return whether forces changed."""
        return False

    def follow(self, at: At) -> bool:
        """Update contact positions at u; return whether the equilibrium changed."""
        return False

    def guess(self, parts: Parts, nodal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return an initial guess of displacements (nodes, d), m; None if there is none."""

    def moved(self, u: fem.Function) -> Loads:
        """Return the loads with the reactions of prescribed sides after a displacement u, m, of the nodes at rest."""
        return self

    def counted(self, at: At) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return unrolled local degrees of freedom (n,) on walls, and the forces (n,), N, on them not from the wall."""
        return np.empty(0, dtype=np.int64), np.empty(0)

    def touching(self) -> tuple | None:
        """Return the initial constraints: cells (m,), cells of the deformable other side or None, positions and
        directions (m, d).
        """

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """Local cells with prescribed sides."""
        return np.empty(0, dtype=np.int32)

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rounding errors (cells,), N, of forces in the local cells, given the errors without it."""
        return of_cells

    @property
    def rounding_beside(self) -> float:
        """Rounding error of forces in cells of other sides, N."""
        return 0.0

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the effects on the bodies at u, by quantity and name of the condition."""
        return {}

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with the history of the condition."""
        return points

    def ended(self, at: At) -> Loads:
        """Return the loads at the end of the step."""
        return self

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners (n, 2^d, d), m, after the step are so near that they follow the Q1 field alone."""
        return False

    def outside(
        self, corners: NDArray[np.float64], free: NDArray[np.bool_], everywhere: bool = False
    ) -> NDArray[np.float64]:
        """Return corners (n, 2^d, d), m, without penetration of forbidden regions; by default, small penetrations only.

        free (n, 2^d, d): components that no other condition prescribes; everywhere: correct penetrations of any depth.
        """
        return corners

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return new corners (m, 2^d, d), m, of domains whose prescribed faces keep their tracked corners."""
        return corners

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise an error if points lie in forbidden regions after a step; before: points at its start."""


class Acting:
    """The conditions of one kind in a stage.

    Parameters
    ----------
    setting
        Setting of the stage.
    """

    conditions: ClassVar[tuple[type, ...]] = ()
    """Condition classes of this kind."""
    title: ClassVar[str] = "user-defined conditions"
    """Name in the summary of a scene."""
    symmetric: bool = True
    """Whether the tangent is symmetric."""
    linear: bool = True
    """Whether the tangent is independent of the displacement."""
    surfaces: Sequence[Surface] = ()
    """Loaded faces; all are cut together."""
    outside: Surface | None = None
    """Faces that tools may touch."""
    held: Sequence[tuple[Any, Surface, Sequence[int]]] = ()
    """(condition, prescribed faces, prescribed axes)."""

    def placed(self, place: Place) -> Loads:
        """Return the loads of a substep."""
        raise NotImplementedError

    def check_start(self, place: Place) -> None:
        """Raise an error if the stage cannot begin at this position."""

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the initial history of n points: condition -> name of the data -> values."""
        return {}

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the outcome before the first step, filled with this value."""
        return {}
