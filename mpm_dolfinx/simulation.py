# SPDX-License-Identifier: MIT
"""A scene and one step of it: cut the domains by the grid, solve for u and p, move the points, reset the grid."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from dolfinx import fem
from dolfinx.common import Timer
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.io import summary
from mpm_dolfinx.problems.mechanical_boundary import Boundary
from mpm_dolfinx.validation import all_of, asked, chosen, flag, functions, instance, line, numbers
from mpm_dolfinx.problems.conditions import Displacement, Drained, Inflow, RigidPlate, Traction
from mpm_dolfinx.solve.newton import COUPLINGS, Coupler, Report
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.constitutive.user_functions import compiling
from mpm_dolfinx.points.grid import Grid, sum_by
from mpm_dolfinx.problems.scene_checks import check_held
from mpm_dolfinx.forms.quadrature_data import IntegrationData
from mpm_dolfinx.constitutive.fields import SceneMaterials
from mpm_dolfinx.constitutive.skeleton import Fluid, Skeleton
from mpm_dolfinx.problems.momentum import FULL, Momentum
from mpm_dolfinx.points.advance import Motion
from mpm_dolfinx.points.cut_domains import Placement
from mpm_dolfinx.points.bodies import Body, MaterialPoints, check_apart, check_inside, material_points
from mpm_dolfinx.points.pressure_transport import Carried, at_start, remap
from mpm_dolfinx.problems.storage import Storage
from mpm_dolfinx.points.faces import Probes
from mpm_dolfinx.problems.thin import warn_thin
from mpm_dolfinx.timeloop import Observer, Result, run
from mpm_dolfinx.forms.unknowns import collect_garbage

CONDITIONS = {
    "tractions": Traction,
    "displacements": Displacement,
    "drained": Drained,
    "inflows": Inflow,
    "plates": RigidPlate,
}


class Simulation:
    """A scene and its state.

    Parameters
    ----------
    grid
        Background grid.
    bodies
        Seeded bodies.
    materials
        Material of each index that the bodies name.
    fixed
        Walls of the grid ("left", "right", "bottom", "top", in 3D also "front", "back") with the components that
        are zero there, such as {"left": "xy", "bottom": "y"}.
    fluid
        Pore fluid; without it there is no storage problem.
    tractions, displacements, drained, inflows, plates
        Boundary conditions on sides of the bodies; other sides are free and sealed.
    gravity : (d,) or callable t -> (d,), m/s^2
        Acceleration of gravity.
    pressure
        Pore pressure at the start, Pa, the same everywhere; needs a fluid.  A hydrostatic one comes from a first
        stage with gravity that is long enough to drain.
    quadrature
        "domain": exact pieces of the points' domains; "point": at the points, as in the seed paper.
    coupling, tolerance
        See `Coupler`.
    terms, sources
        Functions that give terms of the user's own to the two balances in UFL: see `extend`.
    later
        Indices of bodies that a later stage adds, each once.

    Attributes
    ----------
    points
        The material points of this process.
    t
        Time, s.
    result
        Histories of the last run, also while it runs.
    reactions
        Forces of the given displacements.

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
        fixed: Mapping[str, str],
        fluid: Fluid | None = None,
        tractions: Sequence[Traction] = (),
        displacements: Sequence[Displacement] = (),
        drained: Sequence[Drained] = (),
        inflows: Sequence[Inflow] = (),
        plates: Sequence[RigidPlate] = (),
        gravity: ArrayLike | Callable[[float], ArrayLike] | None = None,
        pressure: float = 0.0,
        quadrature: str = "domain",
        coupling: str = "schur-cg",
        tolerance: float = 1e-8,
        terms: Sequence[Callable] = (),
        sources: Sequence[Callable] = (),
        later: Sequence[int] = (),
    ):
        if quadrature not in ("domain", "point"):
            raise ValueError(f"quadrature {quadrature!r}: must be domain or point")
        if not isinstance(coupling, str) or coupling not in COUPLINGS:
            raise ValueError(f"coupling {coupling!r}: must be one of {', '.join(COUPLINGS)}")
        if fluid is None and sources:
            raise ValueError("sources need a fluid")
        instance("grid", grid, Grid)
        all_of("bodies", bodies, Body, 1)
        all_of("materials", materials, Skeleton, 1)
        if fluid is not None:
            instance("fluid", fluid, Fluid)
        elif numbers("pressure", pressure):
            raise ValueError(f"pressure = {line(pressure)}: needs a fluid")
        chosen("later", later, range(len(bodies)), "indices of the bodies")
        functions("terms", terms)
        functions("sources", sources)
        for i, body in enumerate(bodies):
            if body.lower.shape[1] != grid.dim:
                raise ValueError(f"body {i}: has {body.lower.shape[1]} coordinates, must have the grid's {grid.dim}")
            check_inside(grid, body, f"body {i}")
        self.grid, self.materials, self.fluid, self.bodies = grid, materials, fluid, bodies
        self.quadrature = quadrature
        grid.share(np.concatenate([body.centre for body in bodies]))
        self.gravity = None if gravity is None else fem.Constant(grid.mesh, np.zeros(grid.dim))
        self.t, self.active_cells = 0.0, 0
        self.points = material_points(grid, bodies, pressure)
        self._scene = SceneMaterials(grid, materials, bodies, self.points)
        self.present = [body not in later for body in range(len(bodies))]
        """Which bodies are there."""
        check_apart(bodies, self.present)
        warn_thin(grid, bodies, fixed)
        self.placement: Placement | None = None
        """The domains as they have been cut; None where they are to be cut anew."""
        self.resets = 0
        """How often the grid has been reset, and the domains cut."""

        start = time.perf_counter()
        self._build(self._fixed_nodes(fixed), coupling, tolerance, terms, sources)
        self._conditions: dict[str, Any] = {}
        self._set_conditions(
            self.present,
            fixed=fixed,
            tractions=tractions,
            displacements=displacements,
            drained=drained,
            inflows=inflows,
            plates=plates,
            gravity=gravity,
        )
        self.jit = time.perf_counter() - start
        """Seconds spent on compiling or finding the forms."""
        self._carried = at_start(self.points) if fluid else None
        self._waiting = {body: self._take(body) for body in later}
        self._prepared = False
        self.result: Result | None = None
        """Histories of the last run, also while it runs."""

    def __str__(self) -> str:
        """Return a table of the terms and solvers that the scene has, and why it does without the others."""
        return summary.table(self)

    # ---- building -------------------------------------------------------------------------------

    def _fixed_nodes(self, fixed: Mapping[str, str]) -> NDArray[np.bool_]:
        d = self.grid.dim
        out = np.zeros((len(self.grid.node_x), d), dtype=bool)
        if not isinstance(fixed, Mapping):
            raise ValueError(f"fixed = {line(fixed)}, must be walls with their components, such as {{'left': 'xy'}}")
        for wall, axes in fixed.items():
            if not isinstance(axes, str) or not axes or any(a not in "xyz"[:d] for a in axes):
                raise ValueError(f"fixed wall {wall!r}: components {axes!r}, must be some of {'xyz'[:d]!r}")
            for a in axes:
                out[self.grid.wall_nodes(wall), "xyz".index(a)] = True
        return out

    def _build(self, fixed: NDArray[np.bool_], coupling: str, tolerance: float, terms, sources) -> None:
        """Compile the forms that the scene needs."""
        grid, fluid, scene = self.grid, self.fluid, self._scene
        self._integration = IntegrationData(
            grid, scene, self.points, fluid, weighs=self.gravity is not None, extended=bool(terms or sources)
        )
        self.pieces, self.laws = self._integration.pieces, self._integration.laws
        p = fem.Function(grid.cellwise()) if fluid else None
        options = {"mean_dilatation": scene.nearly_incompressible, "symmetric": scene.symmetric}
        with compiling(f"materials: {', '.join(law.__name__ for law in scene.laws)}", "laws in UFL of these shapes"):
            self.momentum = Momentum(grid, self.pieces, self.laws, fixed, p, self.gravity, **options)
        self._time, self._dt = fem.Constant(grid.mesh, 0.0), fem.Constant(grid.mesh, 1.0)
        for term in terms:
            self.momentum.add(term, self._time, self._dt)
        self.storage = None
        if not self.momentum.symmetric and coupling == "schur-cg":
            coupling = "schur-fgmres"
        if fluid:
            weight = None if self.gravity is None else fluid.density * self.gravity
            self.storage = Storage(
                grid, self.pieces, self.momentum.u, p, weight, coupling != "schur-fgmres", scene.conducts
            )
            for source in sources:
                self.storage.add(source, self._time)
        self.coupler = Coupler(self.momentum, self.storage, coupling, tolerance)
        problems = (self.momentum, self.storage, fluid)
        self._motion = Motion(scene, self.bodies, self.pieces, *problems, domains=self.quadrature == "domain")

    # ---- stages ---------------------------------------------------------------------------------

    def stage(
        self,
        *,
        fixed: Mapping[str, str] | None = None,
        tractions: Sequence[Traction] | None = None,
        displacements: Sequence[Displacement] | None = None,
        drained: Sequence[Drained] | None = None,
        inflows: Sequence[Inflow] | None = None,
        plates: Sequence[RigidPlate] | None = None,
        gravity: ArrayLike | Callable[[float], ArrayLike] | None = None,
        add: Sequence[int] = (),
        remove: Sequence[int] = (),
        reset_displacement: bool = False,
    ) -> None:
        """Begin a stage: bodies come and go; conditions that are named take the place of those so far.

        Stresses and pressures stay what they are; the next `run` finds the new balance, all at once or, where
        loads depend on time, little by little.

        Parameters
        ----------
        fixed, tractions, displacements, drained, inflows, plates, gravity
            As for the scene; `gravity` only if the scene had it.
        add
            Indices of bodies that were to come `later`: a fill, at rest and without stress where it was seeded.
        remove
            Indices of bodies: an excavation.
        reset_displacement
            From now on displacements count from the present positions.  Conditions that are not named stay as they
            are: a `Displacement` then counts from there too, and moves its side once more.

        Raises
        ------
        ValueError
            The scene is then what it was.
        """
        if gravity is not None and self.gravity is None:
            raise ValueError("gravity: the scene was made without, must be made with (0, 0) first")
        chosen("stage: remove", remove, np.flatnonzero(self.present).tolist(), "bodies that are present")
        chosen("stage: add", add, list(self._waiting), "bodies that are to come later")
        flag("stage: reset_displacement", reset_displacement)
        present = [(here and body not in remove) or body in add for body, here in enumerate(self.present)]
        check_apart(self.bodies, present)
        named = {"fixed": fixed, "tractions": tractions, "displacements": displacements, "drained": drained}
        named |= {"inflows": inflows, "plates": plates, "gravity": gravity}
        self._set_conditions(present, **{name: value for name, value in named.items() if value is not None})
        for body in remove:
            self._take(body)
        for body in add:
            points = self._waiting.pop(body)
            self.present[body] = True
            self.points = self.points.joined(points)
            if self._carried is not None:
                self._carried = self._carried.joined(at_start(points))
        if reset_displacement:
            self.points.origin = self.points.corners.copy()

    def _take(self, body: int) -> MaterialPoints:
        """Take a body away; return its points."""
        self.present[body] = False
        start = sum(len(b) for b in self.bodies[:body])
        mine = (self.points.id >= start) & (self.points.id < start + len(self.bodies[body]))
        taken, self.points = self.points.map(lambda rows: rows[mine]), self.points.map(lambda rows: rows[~mine])
        if self._carried is not None:
            self._carried = self._carried.kept(self.points.id)
        return taken

    def _set_conditions(self, present: Sequence[bool], **conditions) -> None:
        """Take over the conditions that are named, on the bodies that are there, or none if one is refused."""
        now = self._conditions | conditions
        for name, kind in CONDITIONS.items():
            all_of(name, now[name], kind)
        if self.fluid is None and (now["drained"] or now["inflows"]):
            raise ValueError("drained and inflow sides need a fluid")
        if now["gravity"] is not None and not callable(now["gravity"]):
            self._gravity(now["gravity"], "gravity")
        fixed = self._fixed_nodes(now["fixed"])
        self.boundary = side = Boundary(
            self.grid,
            self.bodies,
            present,
            self._scene.stiffest,
            now["tractions"],
            now["displacements"],
            now["plates"],
            [*now["drained"], *now["inflows"]],
        )
        self._conditions, self._begins = now, True
        if "displacements" in conditions:
            unknown = np.nan if self.active_cells else 0.0
            self.reactions = np.full((len(side.holds), self.grid.dim), unknown)
            """(displacements, d): force by which each given displacement acts on the bodies, N (N/m in plane strain).

            Of the last step; nan where none has been taken since a stage set them or the state was restored.
            """
        self.momentum.require(bool(side.loads), bool(side.plates), bool(side.holds))
        self.momentum.fix(fixed)
        self._leave_grid()
        self._prepared = False

    def _gravity(self, value: ArrayLike, name: str) -> NDArray[np.float64]:
        """Return a given acceleration of gravity (d,), m/s^2; `name` for the message of one that is not."""
        return numbers(name, value, (self.grid.dim,), allowed=f"{self.grid.dim} finite numbers")

    # ---- one step -------------------------------------------------------------------------------

    def step(self, dt: float) -> Report:
        """Advance by dt (s).

        Raises
        ------
        NotConverged
            The state is then still that before the step.
        """
        numbers("dt", dt, test=lambda v: (0 < v) & (v < np.inf), allowed="> 0 and finite")
        self._begin(self.t + dt)
        report = self.coupler.solve(dt)
        if self.boundary.holds:
            self.reactions = self.boundary.reactions(self.momentum)
        report.rederived = self._move_points()
        self.t += dt
        return report

    def _begin(self, t: float) -> None:
        """Set up the step that ends at time t: grid, loads of that time, u = 0 and the cells' pressure."""
        collect_garbage(self.grid.mesh.comm)
        self._time.value, self._dt.value = t, t - self.t
        if self.gravity is not None:
            given, name = self._conditions["gravity"], f"gravity at t = {t:g} s"
            given = asked(name, f"{self.grid.dim} numbers for a time", given, t) if callable(given) else given
            self.gravity.value = self._gravity(given, name)
        fresh = not self._prepared and not self._stays()
        if fresh:
            self._reset_grid()
        else:
            if not self._prepared:
                self._stay()
            if self.gravity is not None and self.storage:
                self._open_outlets()  # with the gravity of another time
        self._place_loads(t)
        if fresh:
            self.momentum.set_penalty()
            if self._renumbered and not self.momentum.holding:
                self._check_held()
        self._prepared = True
        self.momentum.start()
        if self.storage:
            self.storage.start(t - self.t)

    def _stays(self) -> bool:
        """Return whether the points have moved so little that nothing need be cut or remapped."""
        return self.placement is not None and self._integration.stays and self.placement.serves()

    def _stay(self) -> None:
        """Bring the integration data to where the points are now, in the same cells."""
        with Timer("mpm: integration data"):
            self._integration.renew(self.placement, self.points)
            if self.momentum.plates is not None:
                self.boundary.place_plates(self.placement, self.momentum)
            if self.storage:
                self.storage.p_n.x.array[:] = self.storage.p.x.array

    def _leave_grid(self) -> None:
        """Let the points take the pressures of their pieces along; the domains are cut anew in the next step.

        Until a step has been taken in the cells, the points still carry what they brought.
        """
        if self.placement is not None and self.storage and self._carried is None:
            if self._prepared:  # a step has failed: the pressures are those at its start
                self.storage.p.x.array[:] = self.storage.p_n.x.array
            with Timer("mpm: remap"):
                self._carried = self._motion.carry(self.points, self.placement)
        self.placement = None

    def _reset_grid(self) -> None:
        """Rebuild the integration data on the fresh grid: pieces, active cells, remapped pressure."""
        self.resets += 1
        self._leave_grid()
        self._migrate()
        with Timer("mpm: cut domains"):
            place = Placement(self.grid, self.points, self.quadrature, self.t)
        brought = None
        if self.storage:
            with Timer("mpm: remap"):
                brought = place.pieces_to_cells(remap(self._carried, self.points, place.pieces))
        with Timer("mpm: integration data"):
            self.placement = place
            self._integration.place(place, self.points)
            self._activate(brought)

    def _activate(self, pressure: NDArray[np.float64] | None) -> None:
        """Set the active cells and what they hold; pressure: (m,), Pa, that the pieces bring, if there is fluid."""
        grid, pieces, momentum = self.grid, self.pieces, self.momentum
        weight = pieces.data["weight"][:, 0] * grid.cell_volume
        filled = sum_by(pieces.cells, weight, grid.num_local)
        stiffness = sum_by(pieces.cells, weight * self._rows(lambda m: m.oedometric), grid.num_local)
        momentum.fill.x.array[:] = filled / grid.cell_volume
        momentum.modulus.x.array[:] = np.divide(stiffness, filled, out=stiffness, where=filled > 0)
        for f in (momentum.fill, momentum.modulus):
            f.x.scatter_forward()
        fill = momentum.fill.x.array
        active = fill > 0
        cells = np.flatnonzero(active)
        self.active_cells = grid.comm.allreduce(int(active[: grid.num_owned].sum()))
        facets = grid.interior_facets(active, cells)
        renumbered = momentum.set_active(cells, facets, fill < FULL)
        if momentum.plates is not None:
            self.boundary.place_plates(self.placement, momentum)
        if self.storage:
            s, place, as_printed = self.storage, self.placement, COUPLINGS[self.coupler.coupling] is None
            if renumbered:
                s.set_active(cells, facets)
                s.set_coupled(momentum.unknowns)
            s.set_contents(
                pieces.cells,
                weight,
                pieces.x,
                self._integration.mobility(place, self.points),
                place.pieces_to_cells(place.pieces.faces),
                pieces.data["storage"][:, 0],
                pressure,
                self._integration.fixed_stress(place, self.points, as_printed),
                self._rows(lambda m: m.pressure_damping(grid.dim)),
            )
            self._open_outlets()
        if renumbered:
            self.coupler.set_unknowns()
        self._renumbered = renumbered

    def _rows(self, value: Callable[[Skeleton], float]) -> NDArray[np.float64]:
        """Return a constant of the materials at the pieces of this process (m,)."""
        return self._integration.rows(self.placement, self.points, value)

    def _check_held(self) -> None:
        """Refuse a scene whose body can move as a rigid body; at the start of a stage, any part of it."""
        momentum, holds = self.momentum, self.momentum.holds
        held = (holds.cells, holds.x, holds.data["direction"]) if self.boundary.holds else None
        check_held(self.grid, momentum.fill.x.array > 0, momentum.free, held, self._begins)
        self._begins = False

    def _place_loads(self, t: float) -> None:
        """Put the loads and given displacements of time t on the surface."""
        with Timer("mpm: loads"):
            if self.momentum.loads is not None:
                self.boundary.place_loads(self.placement, self.momentum, t)
            if self.momentum.holds is not None:
                self.boundary.place_holds(self.placement, self.momentum, t)
            self.momentum.set_loads()

    def _open_outlets(self) -> None:
        weight = None if self.gravity is None else self.fluid.density * self.gravity.value
        self.boundary.open_outlets(self.placement, self.storage, weight)

    def _move_points(self) -> int:
        """Move the points; return how many domains had folded."""
        with Timer("mpm: move points"):
            folded = self._motion.move(self.points, self.placement, self.boundary)
        self._carried, self._prepared = None, False  # the pressures are those of the cells
        return folded

    def _migrate(self) -> None:
        """Send the points whose cell another process owns."""
        grid = self.grid
        if grid.comm.size == 1:
            return
        owner = grid.owner(grid.number(grid.index(self.points.x)))
        if self._carried is not None:
            travel = Exchange(grid.comm, owner[np.searchsorted(self.points.id, self._carried.id)])
            self._carried = self._carried.migrated(travel)
        self.points = self.points.migrated(Exchange(grid.comm, owner))

    @property
    def carried(self) -> Carried | None:
        """Pressures of the points' pieces between two steps, None without fluid; the next step cuts them anew."""
        self._leave_grid()
        return self._carried

    def restore(self, points: MaterialPoints, carried: Carried | None, t: float) -> None:
        """Put the scene into a state at time t, s: points and pieces, on whatever processes they are."""
        self.points, self._carried, self.t = points, carried, t
        self._prepared, self.placement = False, None
        self.reactions = np.full_like(self.reactions, np.nan)  # not in the file: until the next step
        self._begins = False  # parts that have torn off since are what they are
        if self.active_cells:  # of a step that was taken before
            self.coupler.forget()
        self._migrate()

    def effective_stress(self) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), Pa, tension positive, at the material points."""
        return self._scene.effective_stress(self.points)

    # ---- many steps -----------------------------------------------------------------------------

    def run(
        self,
        t_end: float,
        dt: float,
        *,
        probes: Probes | None = None,
        observe: Observer | Sequence[Observer] = (),
        checkpoint: Observer | None = None,
        after: Result | None = None,
        progress: bool = True,
    ) -> Result:
        """Advance to t_end in steps of dt; a step that does not converge is cut in two, and grows again.

        Parameters
        ----------
        t_end
            End time, s, not a duration: > t.
        dt
            Step and output interval, s, > 0; one step to t_end where it is longer than that.
        probes
            Particles whose displacement is recorded.
        observe
            Called with the simulation after each output interval, such as a `Writer`; its `result` then holds the
            histories so far.
        checkpoint
            Called after all observers: a `Checkpoint`.
        after
            Histories to go on with, of a run with the same dt: what `resume` returns.
        progress
            Show a progress bar on a terminal.

        Returns
        -------
        The histories.

        Raises
        ------
        ValueError
            An argument, or what a function of time gives, is none that is allowed.
        GaveUp
            With the histories so far; `points` and `t` are those of the last good step.
        """
        options = {"probes": probes, "observe": observe, "checkpoint": checkpoint, "after": after}
        return run(self, t_end, dt, progress=progress, **options)
