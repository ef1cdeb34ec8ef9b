# SPDX-License-Identifier: MIT
"""A scene and its state: what is given, how it goes on, and what may be asked of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.errors import Report, StepFailed, raise_interrupt
from mpm_dolfinx.base.validation import instance, numbers
from mpm_dolfinx.bodies.bodies import Body, points_in_cells
from mpm_dolfinx.conditions.axis import check_axisymmetry, with_axis
from mpm_dolfinx.conditions.conditions import OnSide, Source, sorted_terms
from mpm_dolfinx.conditions.names import ByName
from mpm_dolfinx.conditions.unit_weights import under
from mpm_dolfinx.contact.groups import grouped
from mpm_dolfinx.diagnostics.resolution import warn_thin
from mpm_dolfinx.diagnostics.scene_parts import check_options, check_parts
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.initial_stress import InitialStress, by_body
from mpm_dolfinx.materials.skeleton import Fluid, Skeleton
from mpm_dolfinx.mechanics.inertia import checked_velocity
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.probing.cell_fields import CellFields, cell_fields
from mpm_dolfinx.probing.point_fields import PointFields, point_fields
from mpm_dolfinx.simulation import summary
from mpm_dolfinx.simulation.tangent import tangent
from mpm_dolfinx.simulation.timeloop import run
from mpm_dolfinx.solve.numerics import DEFAULT, Numerics
from mpm_dolfinx.stepping.initial_state import balanced
from mpm_dolfinx.stepping.result import Result
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.stage import Condition, checked
from mpm_dolfinx.stepping.stages import begin_stage, first_state
from mpm_dolfinx.stepping.state import State
from mpm_dolfinx.stepping.step import step


class Simulation:
    """A scene and its state.

    Parameters
    ----------
    grid, bodies
        Background grid, and seeded bodies.
    materials
        Material of each index that the bodies name.
    walls
        Walls of the grid ("left", "right", "bottom", "top", in 3D also "front", "back") with the components that
        are zero there, such as {"left": "xy", "bottom": "y"}.
    conditions
        What acts on the bodies, in any order: `Traction`, `Pressure`, `Displacement`, `RigidPlate`, `Drained` and
        `Inflow` on their sides, rigid `Tool`s, and `Contact`s of groups of bodies.  Other sides are free and sealed.
    fluid
        Pore fluid; without it there is no storage problem.
    gravity : (d,) or callable t -> (d,), m/s^2
        Acceleration of gravity; in axisymmetry along the axis.
    pressure
        Pore pressure at the start, Pa, needs a fluid: a number, or a function of places x (n, d) as of `hydrostatic`.
    initial_stress
        Effective stress at the start, tension positive: `K0`, a function of places x (n, d) that gives normal stresses
        (n, 3) or tensors (n, 3, 3), Pa, or one of these for each of some bodies, {index: ...}; of fills too, which
        otherwise have none.  It is brought into balance with what acts at the start, at the pore pressures given,
        so that a first step in which nothing changes moves nothing.
    terms
        Terms of the user's own in UFL: functions for the balance of momentum, see `user_functions`, such functions on
        a side, `OnSide`, and those for the storage of fluid, `Source`.
    later
        Indices of bodies that a later stage adds, each once.
    numerics
        Quadrature, coupling, tolerance and method of time integration, see `Numerics`.
    inertia
        Whether bodies have inertia: then they need no walls.  With False they have none at first, and a later stage may
        give it to them; with None no stage can.  Not with `quadrature="point"`.
    velocity : (d,) or callable x (n, d) -> (n, d), m/s
        Velocity at the start of bodies that may have inertia, or a function of places; none is rest.

    Attributes
    ----------
    state
        All that the scene remembers between two steps (`State`): replaced as a whole, at the end of a step.  What
        raises in between, Ctrl-C included, leaves it; the next `run` goes on from it.
    scene
        Grid, bodies and materials, with the compiled forms.

    Raises
    ------
    ValueError
        Naming the object, its value and what is allowed.
    """

    def __init__(
        self,
        grid: Grid,
        bodies: Sequence[Body],
        materials: Sequence[Skeleton],
        *,
        walls: Mapping[str, str],
        conditions: Sequence[Condition] = (),
        fluid: Fluid | None = None,
        gravity: ArrayLike | Callable[[float], ArrayLike] | None = None,
        pressure: float | Callable[[NDArray], ArrayLike] = 0.0,
        initial_stress: InitialStress | Mapping[int, InitialStress] | None = None,
        terms: Sequence[Callable | OnSide | Source] = (),
        later: Sequence[int] = (),
        numerics: Numerics = DEFAULT,
        inertia: bool | None = None,
        velocity: ArrayLike | Callable[[NDArray], ArrayLike] | None = None,
    ):
        instance("numerics", numerics, Numerics)
        quadrature = numerics.quadrature
        check_parts(grid, bodies, materials, later)
        terms, sources = sorted_terms(terms)
        check_options(bodies, fluid, pressure, terms, sources, quadrature)
        grid = grouped(grid, bodies, checked(conditions), quadrature, {"terms": terms, "sources": sources})
        grid = grid.shared(points_in_cells(grid, bodies), keep=bool(len(terms) + len(sources)))
        warn_thin(grid, bodies, with_axis(grid, walls), fluid is not None)
        check_axisymmetry(grid, bodies, quadrature)
        velocity = checked_velocity(grid, quadrature, inertia, velocity)
        began = time.perf_counter()
        initial = by_body(initial_stress, bodies, later)
        self.scene = Scene(
            grid,
            bodies,
            materials,
            under(fluid, gravity),
            numerics=numerics,
            weighs=gravity is not None,
            pressure=pressure,
            extensions=(terms, sources),
            initial=initial,
            velocity=velocity,
        )
        given = {"walls": walls, "conditions": conditions, "gravity": gravity, "inertia": bool(inertia)}
        self.state = first_state(self.scene, given, later)
        if initial:
            self.state = balanced(self.scene, self.state)
        self.jit = time.perf_counter() - began
        """Seconds spent on compiling or finding the forms."""

    def __str__(self) -> str:
        """Return a table of the terms and solvers that the scene has, and why it does without the others."""
        return summary.table(self.scene, self.state)

    # ---- what may be asked ----------------------------------------------------------------------

    @property
    def grid(self) -> Grid:
        """Background grid."""
        return self.scene.grid

    @property
    def bodies(self) -> tuple[Body, ...]:
        """All bodies."""
        return self.scene.bodies

    @property
    def points(self) -> MaterialPoints:
        """The material points of this process; their arrays can be read, not written."""
        return self.state.points.placed(self.grid.base)

    @property
    def t(self) -> float:
        """Time, s; it may be set between two runs."""
        return self.state.t

    @t.setter
    def t(self, value: float) -> None:
        self.state = replace(self.state, t=float(numbers("t", value)))

    @property
    def result(self) -> Result | None:
        """Histories of the last run, also while it runs."""
        return self.state.result

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The conditions in force, as they were given."""
        return tuple(self.state.stage.given.values())

    @property
    def reactions(self) -> ByName[NDArray[np.float64]]:
        """Force (d,) by which each given displacement acts on the bodies, by its name, N (N/m in plane strain).

        In axisymmetry all around, the radial one the sum of what acts outward.  Of the last step; nan where none has
        been taken since a stage set them.
        """
        return self.outcome("reactions")

    @property
    def wall_reactions(self) -> ByName[NDArray[np.float64]]:
        """Force (d,), N (N/m in plane strain), of each wall of the grid on the bodies; zero where it holds nothing.

        A component of a node that two walls hold counts once: for the wall across it, else half for each.
        """
        return self.outcome("wall_reactions")

    @property
    def outflows(self) -> ByName[NDArray[np.float64]]:
        """What leaves through each drained side and inflow, by its name, m^3/s (m^2/s in plane strain)."""
        return self.outcome("outflows")

    @property
    def tool_forces(self) -> ByName[NDArray[np.float64]]:
        """Force and moment (d + 1,), in 3D (6,), of each `Tool` and `Contact` on the bodies, by its name."""
        return self.outcome("tool_forces")

    @property
    def tool_travel(self) -> ByName[NDArray[np.float64]]:
        """How far a load has pushed each `Tool` beyond its displacement, by its name, m."""
        return self.outcome("tool_travel")

    def outcome(self, quantity: str) -> ByName[NDArray[np.float64]]:
        """Return what conditions do to the bodies at the end of the last step, by name: of the above, or own ones."""
        return ByName(self.state.outcome.get(quantity, {}))

    @property
    def present(self) -> tuple[bool, ...]:
        """Which bodies are there."""
        return self.state.stage.present

    def effective_stress(self) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), Pa, tension positive, at the material points.

        In axisymmetry (n, 3, 3), of radius, axis and hoops.  On several processes all call it together.
        """
        return self.scene.materials.effective_stress(self.state.points)

    def point_fields(self) -> PointFields:
        """Return stresses, p', q and porosity of the points, see `PointFields`; all processes call it together."""
        return point_fields(self.scene, self.state.points)

    def cells(self) -> CellFields:
        """Return centroids and fields of the cells at present, see `CellFields`; all processes call it together."""
        return cell_fields(self.scene, self.state)

    # ---- stages and steps -----------------------------------------------------------------------

    def stage(
        self,
        *,
        walls: Mapping[str, str] | None = None,
        conditions: Sequence[Condition] | None = None,
        gravity: ArrayLike | Callable[[float], ArrayLike] | None = None,
        inertia: bool | None = None,
        add: Sequence[int] = (),
        remove: Sequence[int] = (),
        reset_displacement: bool = False,
        fields: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Begin a stage: bodies come and go; what is given takes the place of what was in force.

        Stresses and pressures stay what they are; the next `run` finds the new balance, all at once or, where
        loads depend on time, little by little.

        Parameters
        ----------
        walls, gravity
            As for the scene; `gravity` only if the scene had it.
        inertia
            Whether bodies have inertia from now on; only if the scene may.  Bodies that get it begin at rest.
        conditions
            All conditions from now on; without, those in force stay: `[*simulation.conditions, more]` adds one.
            Contacts are those of the scene, named or not.
        add
            Indices of bodies that were to come `later`: a fill, at rest and without stress, put onto the
            present surface of what it touches as seeded; the side opposite to it stays where it was seeded.
        remove
            Indices of bodies: an excavation.
        reset_displacement
            From now on displacements count from the present positions.  Conditions that stay are as they
            were: a `Displacement` then counts from there too, and moves its side once more.
        fields
            New values (n, ...) at the points of this process, or one for all, of what they carry in `points.data`:
            constants of materials that were given as functions of place, and state of laws; or data of your own, that
            the points take along.

        Raises
        ------
        ValueError
            The scene is then what it was.
        """
        given = {"walls": walls, "conditions": conditions, "gravity": gravity, "inertia": inertia}
        named = {name: value for name, value in given.items() if value is not None}
        self.state = begin_stage(self.scene, self.state, named, add, remove, reset_displacement, fields or {})

    def step(self, dt: float) -> Report:
        """Advance by dt (s), > 0; return what the step took.

        Raises
        ------
        NotConverged, LeftGrid
            The step cannot be taken; a shorter one may.
        ValueError
            What a function of time gives is none that is allowed.
        """
        self.state, report = self.advanced(dt)
        return report

    def advanced(self, dt: float, *how: tuple) -> tuple[State, Report]:
        """Return the state after a step of dt (s), and what it took; how: other substeps.  The own state stays."""
        numbers("dt", dt, test=lambda v: (0 < v) & (v < np.inf), allowed="> 0 and finite")
        try:
            return step(self.scene, self.state, dt, *how)
        except StepFailed:
            raise
        except BaseException as error:  # broken off anywhere
            self.scene.forget()
            raise_interrupt(error)
            raise

    run, tangent = run, tangent
