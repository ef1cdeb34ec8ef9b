# SPDX-License-Identifier: MIT
"""Scene and state of a simulation: input, stages, steps and results."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.errors import Report, StepFailed, raise_interrupt
from mpm_dolfinx.base.validation import instance, line, numbers
from mpm_dolfinx.bodies.bodies import Body, Later, Moving, points_in_cells
from mpm_dolfinx.conditions.conditions import OnSide, Source, sorted_terms
from mpm_dolfinx.conditions.names import ByName
from mpm_dolfinx.conditions.unit_weights import under
from mpm_dolfinx.conditions.walls import with_axis
from mpm_dolfinx.contact.groups import grouped
from mpm_dolfinx.diagnostics.resolution import check_stiff, warn_thin
from mpm_dolfinx.diagnostics.scene_parts import (
    check_axisymmetry,
    check_masses,
    check_options,
    checked_parts,
    initial_velocity,
)
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.initial_stress import InitialStress, by_body
from mpm_dolfinx.materials.skeleton import Fluid, Skeleton
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.probing.cell_fields import CellFields, cell_fields
from mpm_dolfinx.probing.point_fields import PointFields, point_fields
from mpm_dolfinx.simulation import summary
from mpm_dolfinx.simulation.tangent import tangent
from mpm_dolfinx.simulation.timeloop import run
from mpm_dolfinx.solve.numerics import DEFAULT, Numerics
from mpm_dolfinx.stepping.distribution import distribute
from mpm_dolfinx.stepping.initial_state import balanced, first_state, next_stage
from mpm_dolfinx.stepping.result import OUTCOMES, Result
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.stage import Condition, checked, contacts_of
from mpm_dolfinx.stepping.state import State
from mpm_dolfinx.stepping.step import step


class Simulation:
    """A simulation: a scene and its state.

    Parameters
    ----------
    grid, bodies
        Background grid, and seeded bodies. `Later(body)` is absent until a stage adds it.
    materials
        Materials; bodies refer to them by index.
    walls
        Walls of the grid ("left", "right", "bottom", "top", in 3D also "front", "back") with the displacement
        components that they fix, such as {"left": "xy", "bottom": "y"}.
    conditions
        Conditions on the bodies, in any order: on their sides `Traction`, `Pressure`, `Displacement`, `RigidPlate`,
        `Quiet`, `Tied`, `Drained`, `Inflow`, `Rain` and the two conditions of `water`; rigid `Tool`s; and `Contact`s
        between groups of bodies. Sides without a condition are free of traction and undrained.
    fluid
        Pore fluid; None for a dry scene.
    gravity : (d,) or callable t -> (d,), m/s^2
        Acceleration of gravity, in axisymmetry along the axis.
    pressure
        Initial pore pressure, Pa: a number, or a function of positions x (n, d) such as `hydrostatic`. A nonzero
        pressure requires a fluid.
    initial_stress
        Initial effective stress, tension positive: `K0`, or a function of positions x (n, d). The function returns
        normal stresses (n, 3) or tensors (n, 3, 3), Pa. A dictionary {index: ...} gives initial stresses to some bodies
        only. A body that a stage adds has initial stress only if the dictionary lists it. Iterations at the start bring
        the stress into equilibrium with loads and initial pore pressures. After these iterations, the first step under
        constant loads causes no displacement.
    terms
        User-defined terms in UFL. A function is a term of the momentum balance, see `user_functions`.  `OnSide` is such
        a term on a side.  A `Source` is a term of the fluid balance.
    numerics
        Quadrature, coupling, tolerance and time integration, see `Numerics`.
    inertia
        True: bodies have inertia, and need no walls.  `Moving`: bodies also have an initial velocity.  False: only
        later stages may have inertia.  None: no stage has inertia. Inertia requires `quadrature="domain"`.

    Attributes
    ----------
    state
        The complete state between two steps (`State`).  If an error or Ctrl-C stops a step, the state does not change,
        and the next `run` continues from this state.
    scene
        Grid, bodies and materials, with the compiled forms.

    Raises
    ------
    ValueError
        The input is invalid.  The message names the object, its value and the allowed values.
    """

    def __init__(
        self,
        grid: Grid,
        bodies: Sequence[Body | Later],
        materials: Sequence[Skeleton],
        *,
        walls: Mapping[str, str],
        conditions: Sequence[Condition] = (),
        fluid: Fluid | None = None,
        gravity: ArrayLike | Callable[[float], ArrayLike] | None = None,
        pressure: float | Callable[[NDArray], ArrayLike] = 0.0,
        initial_stress: InitialStress | Mapping[int, InitialStress] | None = None,
        terms: Sequence[Callable | OnSide | Source] = (),
        numerics: Numerics = DEFAULT,
        inertia: bool | Moving | None = None,
    ):
        instance("numerics", numerics, Numerics)
        quadrature = numerics.quadrature
        bodies, later = checked_parts(grid, bodies, materials)
        terms, sources = sorted_terms(terms)
        check_options(bodies, fluid, pressure, terms, sources, quadrature)
        grid = grouped(grid, bodies, contacts_of(checked(conditions)), quadrature, {"terms": terms, "sources": sources})
        grid = grid.shared(points_in_cells(grid, bodies), keep=bool(len(terms) + len(sources)))
        check_stiff(grid, bodies)
        warn_thin(grid, bodies, with_axis(grid, walls), fluid is not None)
        check_axisymmetry(grid, bodies, quadrature)
        velocity = initial_velocity(grid, quadrature, inertia)
        if velocity is not None:
            check_masses(materials, fluid)
        start = time.perf_counter()
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
        self.state = balanced(self.scene, self.state) if initial else self.state
        self.jit = time.perf_counter() - start
        """Wall time for compiling or loading the forms, in s."""

    def __str__(self) -> str:
        """Return a table of all terms and solvers.  The table shows whether the scene uses each of them, and why."""
        return summary.table(self.scene, self.state)

    # ---- results --------------------------------------------------------------------------------

    @property
    def grid(self) -> Grid:
        """Background grid."""
        return self.scene.grid

    @property
    def bodies(self) -> tuple[Body, ...]:
        """All bodies."""
        return self.scene.bodies

    @property
    def state(self) -> State:
        """The complete state between two steps."""
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        materials = state.stage.materials if isinstance(state, State) else None
        if materials is not self.scene.materials and materials in self.scene.former:
            state = self.scene.adopted(state)  # a state from before the cells were distributed anew
        self._state = state

    @property
    def points(self) -> MaterialPoints:
        """The material points of this process; their arrays are read-only."""
        return self.state.points.placed(self.grid.base)

    @property
    def t(self) -> float:
        """Time, in s.  Between two runs, you may set the time."""
        return self.state.t

    @t.setter
    def t(self, value: float) -> None:
        self.state = replace(self.state, t=float(numbers("t", value)))

    @property
    def result(self) -> Result | None:
        """Histories of the last run, or of the run in progress."""
        return self.state.result

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Conditions of the present stage, as passed by the user."""
        return tuple(self.state.stage.given.values())

    @property
    def reactions(self) -> ByName[NDArray[np.float64]]:
        """Force (d,) of each prescribed displacement on the bodies in the last step, by name, in N.

        In plane strain the unit is N/m.  In axisymmetry the force acts on the full circumference, and the radial
        component is positive outwards.  Before the first step of a stage, the force is nan.
        """
        return self.outcome("reactions")

    @property
    def wall_reactions(self) -> ByName[NDArray[np.float64]]:
        """Force (d,) of each wall of the grid on the bodies in the last step, by name, in N.

        In plane strain the unit is N/m.  Components that the wall does not fix are zero.  If two walls fix the same
        component of a node, its force acts on the wall that is normal to this component.  If neither wall is normal to
        the component, half of the force acts on each wall.
        """
        return self.outcome("wall_reactions")

    @property
    def outflows(self) -> ByName[NDArray[np.float64]]:
        """Outflow through each drained side and each side with inflow, by name, in m^3/s (m^2/s in plane strain).

        For a `Contact` that conducts, the outflow is the flow from its bodies `one` to its bodies `other`.
        """
        return self.outcome("outflows")

    @property
    def tool_forces(self) -> ByName[NDArray[np.float64]]:
        """Force, in N, and moment, in N m, of each `Tool` and `Contact` on the bodies, by name.

        Each array contains the components of the force, and then the moment: three values in 2D, and six in 3D.
        """
        return self.outcome("tool_forces")

    @property
    def tool_travel(self) -> ByName[NDArray[np.float64]]:
        """Displacement of each `Tool` due to its load, by name, in m.  Prescribed displacements are not included."""
        return self.outcome("tool_travel")

    def outcome(self, quantity: str) -> ByName[NDArray[np.float64]]:
        """Return one quantity, such as "reactions", at the end of the last step, for each condition by its name.

        User-defined conditions are included.  The dictionary is empty if no condition of the stage has this quantity.
        Time integrals begin at the start of a condition, and use the weights of the time integration.  "flowed" is the
        integral of the outflow, in m^3 (m^2 in plane strain).  With inertia, "impulse" is the integral of the forces
        `reactions` and `tool_forces`, and "wall_impulse" of `wall_reactions`, in N s (N s/m in plane strain).

        Raises
        ------
        KeyError
            The quantity is unknown.  The message lists the known quantities.
        """
        known = dict.fromkeys([*OUTCOMES, *self.state.outcome])
        if quantity not in known:
            raise KeyError(f"outcome: quantity = {line(quantity)}, must be one of {', '.join(known)}")
        return ByName({name: np.asarray(of)[()] for name, of in self.state.outcome.get(quantity, {}).items()})

    @property
    def present(self) -> tuple[bool, ...]:
        """Whether each body is present in the current stage."""
        return self.state.stage.present

    def effective_stress(self) -> NDArray[np.float64]:
        """Return the effective Cauchy stresses (n, d, d) of the material points, in Pa, positive in tension.

        In axisymmetry the stresses (n, 3, 3) have radial, axial and circumferential components.  All processes must
        call this method.
        """
        return self.scene.materials.effective_stress(self.state.points)

    def point_fields(self) -> PointFields:
        """Return stresses and porosity of the material points.  All processes must call this method."""
        return point_fields(self.scene, self.state.points)

    def cells(self) -> CellFields:
        """Return the fields of the cells.  All processes must call this method."""
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
        """Begin a stage: add and remove bodies, and replace walls, conditions or gravity.

        Stresses and pressures change in the next `run`.  A stage with the present values changes nothing.

        Parameters
        ----------
        walls, gravity
            New walls and new gravity, as for `Simulation`.  A scene without gravity cannot get gravity later.
        inertia
            Whether bodies have inertia; they start without velocity.  A scene made with `inertia=None` has none.
        conditions
            All conditions from now on; by default the present conditions.  To add a condition `new`, pass
            `[*simulation.conditions, new]`.  Every `Contact` remains in force, even if it is not listed.
        add
            Indices of bodies that are `Later`, for example a fill.  They have no velocity, and an initial stress only
            if `initial_stress` lists them.  A fill is added to the present surface of the bodies that it touched at
            seeding.  The free sides of the fill remain at their seeded positions.
        remove
            Indices of bodies to be removed, for example by an excavation.
        reset_displacement
            Whether displacements are measured from the present positions from now on. Values of conditions do not
            change: a present `Displacement` with the value d then moves its side by another d.
        fields
            New values of `points.data`, by name: arrays (n, ...) for the n points of this process, or one value for
            all: state variables of laws, constants that vary with position (not those of wet pores), and user data.

        Raises
        ------
        ValueError
            An argument is invalid.  The scene does not change.
        """
        given = {"walls": walls, "conditions": conditions, "gravity": gravity, "inertia": inertia}
        named = {name: value for name, value in given.items() if value is not None}
        self.state = next_stage(self.scene, self.state, named, add, remove, reset_displacement, fields or {})

    def step(self, dt: float) -> Report:
        """Advance by one step of length `dt`, in s, and return the report of the step.  `run` may divide steps.

        Raises
        ------
        NotConverged, LeftGrid
            The step fails, but a shorter step may succeed.
        ValueError
            A function of time returns an invalid value, or jumps within the step (see `Stepwise`).
        """
        dt = self._state.stage.up_to_jumps(self._state.t, dt)
        distribute(self)
        self._state, report = self.advanced(dt)
        return report

    def advanced(self, dt: float, *how: tuple) -> tuple[State, Report]:
        """Return the state after a step of length `dt`, in s, and the report of the step.  `state` does not change."""
        numbers("dt", dt, test=lambda v: (0 < v) & (v < np.inf), allowed="> 0 and finite")
        try:
            return step(self.scene, self._state, dt, *how)
        except StepFailed:
            raise
        except BaseException as error:  # an interrupt may have come at any line of the step
            self.scene.forget()
            raise_interrupt(error)
            raise

    def without_jump(self, dt: float) -> tuple[float, bool]:
        """Return the length of the next step, at most `dt`, in s, and whether a displacement jumps at its start."""
        return self._state.stage.without_jump(self._state.t, dt)

    run, tangent = run, tangent
