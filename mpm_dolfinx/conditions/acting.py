# SPDX-License-Identifier: MIT
"""What acts on the momentum: the one protocol of tractions, given displacements, tools, weight, conditions of users.

To add a condition: give it a method `acting(setting)`, which returns an `Acting`.  For the fluid: `flow/feeding.py`.

A condition is placed three times: `Acting` once a stage, where it finds its faces; `Acting.placed` once a substep, with
the faces where they have moved to; and its `Loads` add to residual and tangent as often as these are assembled.  The
step and the balance of momentum loop over them, and know none by name.
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
"""What conditions do to the bodies, by quantity, such as "reactions", and by name of the condition."""
QUANTITIES = ("reactions", "wall_reactions", "outflows", "tool_forces", "tool_travel")
"""Those of the conditions of the package."""


class FormsOf:
    """The compiled forms of a scene's conditions: each kind of form is made once, when a condition first asks for it.

    Parameters
    ----------
    grid
        Background grid.
    u
        Increment of the displacement in the step, m.
    velocity
        Of the bodies in a substep.
    """

    def __init__(self, grid: Grid, u: fem.Function, velocity: Velocity):
        self.grid, self.u = grid, u
        self.velocity = velocity
        self._made: dict[Callable, Any] = {}

    def __call__(self, make: Callable[..., T], *more) -> T:
        """Return what `make` returns of the grid, u and more, a class of forms."""
        if make not in self._made:
            self._made[make] = make(self.grid, self.u, *more)
        return self._made[make]

    @property
    def made(self) -> set[str]:
        """Names of the kinds that have been asked for."""
        return {make.__name__ for make in self._made}


@dataclass(frozen=True, eq=False)
class Setting:
    """Where a stage puts its conditions.

    sides: finds their faces; free (nodes, d): components that no wall holds; materials: those of the scene; forms: its
    compiled forms; conditions: all of the stage, by name.
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
        """Return the conditions of some classes by their names."""
        return {name: one for name, one in self.conditions.items() if isinstance(one, kinds)}


class Place(NamedTuple):
    """When and where a condition acts in a substep.

    cut, points: the domains as they are cut, and the points as they are now; pieces: their points of integration, see
    `QuadratureData`; start, dt: of the step, s; t: end of the substep, s; before: outcome of the last step; inertia:
    whether bodies have any.
    """

    cut: CutDomains
    points: MaterialPoints
    pieces: Any
    start: float
    dt: float
    t: float
    before: Outcome
    inertia: bool = False


class Shares(NamedTuple):
    """Shares own and before of a substep in its step, s, see `Substep`; gravity (d,) in it, m/s^2, if there is any."""

    own: float
    before: float
    gravity: NDArray[np.float64] | None


class At(NamedTuple):
    """Displacements u of the step, a local array, m, and which of them are unknowns."""

    unknowns: Unknowns
    u: NDArray[np.float64]

    @property
    def nodal(self) -> NDArray[np.float64]:
        """u by nodes (nodes, d), m."""
        return self.u.reshape(-1, self.unknowns.dim)


class Loads:
    """What a condition does in a substep; of what a class does not define it does nothing.

    Arrays b are local ones of forces at the nodes, unrolled, N: what is added to ghosts is sent to their owners.
    """

    linear: bool = True
    """Whether its tangent is the same at all displacements."""
    smooth: bool = True
    """Whether the tangent of a substep may lead the next one."""
    varies: bool = False
    """Whether `loads` and `resists` are to be asked for at each displacement."""
    stiff: bool = False
    """Whether it has a `penalty`."""
    holding: bool = False
    """Whether it may hold bodies in ways that `touching` does not tell."""
    couples: bool = False
    """Whether its tangent joins nodes of different cells."""
    touches: bool = False
    """Whether bodies may part from it."""
    key: Any = None
    """What the penalty depends on beside the places of faces."""

    def begun(self, shares: Shares, gone: Any) -> Loads:
        """Return the same in a substep of bodies with inertia; gone: what `flown` returned of the last one."""
        return self

    def flown(self, at: At) -> Any:
        """Return what the next substep of bodies with inertia needs of this one, which has been solved, at u."""

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """Return powers at u on this process, W: what slip on it takes, and what it brings beside `push`.

        v: velocities, a local array, m/s.
        """
        return 0.0, 0.0

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add the forces on the bodies that stay through the substep."""

    def pulls(self, b: NDArray[np.float64]) -> None:
        """Add the forces that stay and belong to the penalty: residuals are not measured by them."""

    def loads(self, b: NDArray[np.float64]) -> None:
        """Add the forces on the bodies at u."""

    def resists(self, b: NDArray[np.float64]) -> None:
        """Add the forces at u that act as the bodies' own stresses do, against loads."""

    def takes_up(self, b: NDArray[np.float64]) -> None:
        """Add the forces at u that are counted with those of the stresses."""

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the matrix of forces that are linear in u; walls: to the rows of what walls hold."""

    def pulling(self, at: At, v: NDArray[np.float64]) -> float:
        """Return the power, W, of `pulls` and `penalty` at u on this process; v: velocities, a local array, m/s."""
        return 0.0

    def tangent(self, K: PETSc.Mat) -> None:
        """Add minus the derivative of `loads`, and the derivative of `resists`, at u; who calls finalises it."""

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Take forces at u that residuals are not measured by off a residual, of the unknowns or what walls hold."""

    def inertia(self, at: At) -> PETSc.Vec | None:
        """Return forces at u that add to the residual of the unknowns, and measure it, N; None without."""

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return zeros wherever `coupling` may have entries that cells have not; None if nowhere."""

    def coupling(self, at: At) -> PETSc.Mat | None:
        """Return minus the derivative of what `push` takes off, as far as `tangent` has not added it."""

    def settle(self, at: At, sticks: bool) -> bool:
        """Choose what slips at u, and if asked for what sticks again; return whether it is another choice."""
        return False

    def augment(self, at: At) -> bool:
        """Go on with other forces where the balance is met; return whether they differ."""
        return False

    def follow(self, at: At) -> bool:
        """Find places anew at u; return whether the balance is another one since."""
        return False

    def guess(self, parts: Parts, nodal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return displacements (nodes, d), m, near which the balance may be; None where nothing is known."""

    def moved(self, u: fem.Function) -> Loads:
        """Return the same with the forces of what is held after a displacement u, m, of the nodes, at rest."""
        return self

    def counted(self, at: At) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return unrolled local degrees of freedom (n,) at walls, and forces (n,), N, there that walls do not bear."""
        return np.empty(0, dtype=np.int64), np.empty(0)

    def touching(self) -> tuple | None:
        """Return where it holds bodies at the start: cells (m,), cells of other sides that deform or None, places and
        directions (m, d).
        """

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """Local cells whose sides it holds."""
        return np.empty(0, dtype=np.int32)

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what rounding may leave of forces in the local cells (cells,), N, of what it leaves without."""
        return of_cells

    @property
    def rounding_beside(self) -> float:
        """What it may leave in cells of other sides, N."""
        return 0.0

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return what it does to the bodies at u, by quantity and name of the condition."""
        return {}

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with what they keep of it."""
        return points

    def ended(self, at: At) -> Loads:
        """Return the same at the end of the step."""
        return self

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners (n, 2^d, d), m, after the step are so near that they follow the Q1 field alone."""
        return False

    def outside(
        self, corners: NDArray[np.float64], free: NDArray[np.bool_], everywhere: bool = False
    ) -> NDArray[np.float64]:
        """Return corners (n, 2^d, d), m, put out of what they may not be in; all of them, or those a little inside.

        free (n, 2^d, d): components that nothing else gives.
        """
        return corners

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return new corners (m, 2^d, d), m, of domains with faces that it holds, where their tracked corners are."""
        return corners

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Refuse the points after a step, from those before it, where they are in what they may not be."""


class Acting:
    """The conditions of one kind in a stage.

    Parameters
    ----------
    setting
        Where they are put.
    """

    conditions: ClassVar[tuple[type, ...]] = ()
    """Classes of conditions of this kind."""
    title: ClassVar[str] = "conditions of the user's own"
    """What they are called where a scene lists what it has."""
    symmetric: bool = True
    """Whether the tangent is symmetric."""
    linear: bool = True
    """Whether the tangent is the same at all displacements."""
    surfaces: Sequence[Surface] = ()
    """Faces on which they act; found together, these are cut once."""
    outside: Surface | None = None
    """Faces that tools may meet."""
    held: Sequence[tuple[Any, Surface, Sequence[int]]] = ()
    """Conditions that hold faces, these faces, and the axes along which."""

    def placed(self, place: Place) -> Loads:
        """Return what they do in a substep."""
        raise NotImplementedError

    def check_start(self, place: Place) -> None:
        """Refuse a stage that begins in a place where it cannot."""

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return what n points keep of each condition, by names of data, as it begins."""
        return {}

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return their outcome of this value before a first step."""
        return {}
