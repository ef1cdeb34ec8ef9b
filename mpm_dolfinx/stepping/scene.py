# SPDX-License-Identifier: MIT
"""A scene with compiled forms: grid, bodies and materials."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property, partial
from typing import Any, NamedTuple
from weakref import WeakSet

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.time_integration import Substep, substeps
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.bodies import Body, material_points
from mpm_dolfinx.conditions.acting import Loads
from mpm_dolfinx.conditions.conditions import OnSide
from mpm_dolfinx.conditions.unit_weights import other_gravity, weighed
from mpm_dolfinx.diagnostics.resolution import warn_mixed, warn_overlaps
from mpm_dolfinx.diagnostics.scene_checks import check_held
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.domains.renewed_faces import SeededFaces
from mpm_dolfinx.flow.sources import Sources
from mpm_dolfinx.flow.storage import CellPressure, StorageForms
from mpm_dolfinx.grid.grid import Grid, in_chunks
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.initial_stress import InitialStresses
from mpm_dolfinx.materials.skeleton import Fluid, Skeleton
from mpm_dolfinx.materials.user_functions import compiling
from mpm_dolfinx.mechanics.inertia import moving
from mpm_dolfinx.mechanics.momentum import MomentumForms, MomentumProblem, MomentumSystem
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData, QuadraturePoints
from mpm_dolfinx.parallel.messages import ConditionWarning, warn
from mpm_dolfinx.points.cutting import volumes
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.solve.numerics import Numerics
from mpm_dolfinx.stepping.advance import Motion
from mpm_dolfinx.stepping.division import Division
from mpm_dolfinx.stepping.grid_reset import Assembled, OnGrid, System
from mpm_dolfinx.stepping.moving_lines import with_lines
from mpm_dolfinx.stepping.renewal import Renewal
from mpm_dolfinx.stepping.stage import Stage, stage
from mpm_dolfinx.stepping.state import NODAL, State


class When(NamedTuple):
    """Times and weights of a substep."""

    t: float  # time at the end of the substep, s
    since: float  # time since the start of the step, s
    gravity: NDArray[np.float64] | None  # (d,), m/s^2
    own: float  # weight of the rate at the end of the substep, s
    past: float  # fraction of the displacement at the start of the substep, see `Velocity`


class Scene:
    """A scene with compiled forms.  The `State` contains all data that change from step to step.

    `grid`, `bodies`, `materials`, `fluid`, `numerics`: see `Simulation`.
    `weighs`: whether the scene has gravity.
    `pressure`: initial pore pressure, Pa, or a function of position.
    `extensions`: user-defined terms in the balance of momentum, and in the storage of fluid.
    `initial`: initial stresses of bodies, see `initial_stress.by_body`.
    `velocity`: initial velocity, m/s, see `Simulation`; None if bodies cannot have inertia.
    `own`: names of more fields of the points, for user-defined terms.  The fields are zero in seeded points.
    """

    def __init__(
        self,
        grid: Grid,
        bodies: Sequence[Body],
        materials: Sequence[Skeleton],
        fluid: Fluid | None,
        *,
        numerics: Numerics,
        weighs: bool,
        pressure: float | Callable,
        extensions: tuple[Sequence[Callable], Sequence[Callable]],
        initial: Mapping[int, Any],
        velocity: ArrayLike | Callable | None = None,
        own: Sequence[str] = (),
    ):
        self.grid = grid
        given = {"numerics": numerics, "weighs": weighs, "pressure": pressure, "extensions": extensions}
        given |= {"initial": initial, "velocity": velocity, "own": own}
        self._on = partial(Scene, bodies=bodies, materials=materials, fluid=fluid, **given)
        self.former: WeakSet[SceneMaterials] = WeakSet()
        """Materials of this scene on earlier partitions of the grid among processes."""
        self.bodies = tuple(bodies)
        self.numerics, scheme = numerics, numerics.scheme
        terms, sources = extensions
        pressure = weighed(pressure, fluid)
        self.initial = InitialStresses(self.bodies, initial, pressure)
        seeded = material_points(grid, bodies, pressure)
        seeded = replace(seeded, data=seeded.data | {name: np.zeros(len(seeded)) for name in own})
        if velocity is not None:
            seeded = replace(seeded, data=moving(seeded, velocity, grid.base, grid.axisymmetric))
        self.materials = scene = SceneMaterials(grid, materials, bodies, seeded, fluid, bool(initial))
        self.gravity = fem.Constant(grid.mesh, np.zeros(grid.dim)) if weighs else None
        self.t, self.dt = fem.Constant(grid.mesh, 0.0), fem.Constant(grid.mesh, 1.0)
        """Constants of forms, in s: time at the end of the substep, and its difference from the start of the step."""
        inside = [term for term in terms if not isinstance(term, OnSide)]
        self.pieces = QuadraturePoints(scene, bodies, weighs, bool(len(inside) + len(sources)))
        laws, p = self.pieces.laws, CellPressure(*(fem.Function(grid.cellwise()) for _ in range(3))) if fluid else None
        with compiling(f"materials: {', '.join(law.__name__ for law in scene.laws)}", "laws in UFL of these shapes"):
            options = (scene, numerics.quadrature == "point", terms, self.t, self.dt, velocity is not None)
            self.momentum = MomentumForms(self.pieces.pieces, laws, p and p.now, self.gravity, *options)
        if scheme.coupling == "schur-cg" and not (self.momentum.symmetric and scene.retentions is None):
            scheme = replace(scheme, coupling="schur-fgmres")
        self.scheme, self.storage = scheme, None
        if fluid:
            weight = fluid.density * self.gravity if weighs else None
            symmetric = scheme.coupling != "schur-fgmres"
            moves = self.momentum.inertia
            inertial = None
            if moves is not None:
                inertial = moves.moved, -fem.Constant(grid.mesh, fluid.density) * moves.acceleration
            pieces = self.pieces.pieces
            feeding = [Sources(sources, pieces, p.now, p.start, self.t)] if sources else []
            of_fluid = (scene, weight, symmetric, feeding, inertial)
            self.storage = StorageForms(pieces, self.momentum.u, p, self.momentum.active, *of_fluid)
        keeps_volumes = numerics.keep_volumes and numerics.quadrature == "domain" and scene.evolves
        self.motion = Motion(scene, bodies, self.momentum, self.storage, keeps_volumes)
        # checks still to be made, which only write to the log
        mixed = [partial(warn_mixed, materials=scene)] * scene.varied
        renewable = grid.dim == 2 and "plastic" in scene.state_names and not numerics.renewal
        self._looks = (partial(warn_overlaps, evolves=scene.evolves, renewable=renewable), *mixed)
        self._assembled: Latest[Assembled] = Latest()
        self._on_grid: Latest[OnGrid] = Latest(self._assembled)
        self._systems: Latest[System] = Latest()
        self._renewed: Latest[tuple[dict[str, Any], int]] = Latest()
        _ = self._replacing  # raises ValueError for scenes that do not support renewal

    @property
    def flows(self) -> bool:
        """Whether the scene has flow of fluid, or sources of fluid."""
        return self.storage is not None and (self.materials.conducts or bool(self.storage.feeding))

    @cached_property
    def fluid(self) -> Fluid | None:
        """Pore fluid."""
        return self.materials.fluid

    @property
    def extensions(self) -> tuple[Sequence[Callable], Sequence[Callable]]:
        """User-defined terms and sources."""
        return self._on.keywords["extensions"]

    @property
    def extended(self) -> bool:
        """Whether the scene has user-defined terms or sources."""
        return any(map(len, self.extensions))

    def substeps(self, stage: Stage) -> tuple[Substep, ...]:
        """Return the substeps of each step of a stage."""
        return substeps(self.numerics.method, self.flows or self.momentum.own.rates or stage.inertia)

    def balance(
        self,
        when: When,
        system: MomentumSystem,
        data: QuadratureData,
        loads: Sequence[Loads],
        u: NDArray[np.float64] | float | None = None,
        **options,
    ) -> MomentumProblem:
        """Return the balance of momentum at the end of a substep, after setting the coefficients of its forms.

        `when`: the substep.
        `system`, `data`, `loads`, `options`: see `MomentumProblem`.
        `u` (unknowns,), m: initial guess of the displacements, as a local array.  Default: present displacements.
        """
        self.t.value.fill(when.t)
        self.dt.value.fill(when.since)
        if when.gravity is not None:
            self.gravity.value = when.gravity
        self.momentum.velocity.set(when.own, when.past, self.momentum.active.now.dofs)
        if self.storage is not None:
            cells = self.momentum.active.now.cells
            self.storage.p_before.x.array[cells] = self.storage.p.x.array[cells]
        if u is not None:
            self.momentum.u.x.array[:] = u
        return MomentumProblem(self.momentum, system, data, loads, self.scheme.tolerance, **options)

    @cached_property
    def _warned(self) -> set[str]:
        """Texts of earlier warnings, which are not repeated."""
        return set()

    def look_at(self, gravity: Sequence[NDArray[np.float64] | None]) -> None:
        """Warn once if conductivities refer to a gravity other than the gravity of a step."""
        if self.fluid is None or not self.materials.conducts or gravity[0] is None or "gravity" in self._warned:
            return
        if strength := other_gravity(self.fluid, gravity):
            what = "gravity = %.6g m/s^2, but because gravity varies in time, conductivities become mobilities by the "
            what += "fluid's density x 9.81 m/s^2; their gravity must be given as Fluid(gravity=...)"
            warn(self.grid.comm, ConditionWarning, what, strength)
            self._warned.add("gravity")

    def rests_at(self, stage: Stage, t: float) -> None:
        """Set the unit weight of the fluid in unsaturated cells, with the gravity of `stage` at time t (s)."""
        if self.materials.retentions is not None:
            gravity = stage.gravity_at(t) if self.materials.conducts else None
            self.materials.retentions.weight.value = 0.0 if gravity is None else self.fluid.density * gravity

    def distributed(self, boxes: NDArray[np.int64]) -> Scene | None:
        """Return the scene on another partition of the grid, by boxes (ranks, 2, d), see `Partition`.

        The result is None for user-defined terms, and if a function of position, such as a random field, returns other
        values in a second call.
        """
        if self.extended:
            return None
        out = self._on(self.grid.distributed(boxes))
        if not self.grid.comm.allreduce(out.materials.checksums == self.materials.checksums, op=MPI.LAND):
            return None
        if not self.grid.comm.allreduce(len(self.materials.seeded)):
            out.materials.seeds_no_more()
        out.former = self.former | {self.materials}
        out.scheme, out._warned = self.scheme, self._warned
        left = [getattr(look, "func", look) for look in self._looks]
        out._looks = tuple(look for look in out._looks if getattr(look, "func", look) in left)
        return out

    def adopted(self, state: State) -> State:
        """Convert a state of this scene on another partition to the present partition, and return it."""
        before = state.stage
        given = {**before.conditions, "conditions": tuple(before.given.values())}
        nodal = {name: rows for name in NODAL if (rows := getattr(state, name)) is not None}
        nodal = {name: self.grid.from_other(before.materials.grid, rows) for name, rows in nodal.items()}
        after = self.stage(given, before.present, before.later, before.given)
        return replace(state, stage=after, **nodal).at_owners(self.grid)

    def stage(
        self, conditions: Mapping[str, Any], present: Sequence[bool], later: Sequence[int], known: Mapping[str, Any]
    ) -> Stage:
        """Return a stage of the scene.  Parameters: see `stepping.stage.stage`."""
        fed = self.storage.feeding if self.storage else ()
        return stage(self.bodies, self.materials, self.momentum, fed, conditions, present, later, known)

    def check(self, state: State) -> None:
        """Raise ValueError if an object is not a state of this scene."""
        if not isinstance(state, State) or state.stage.materials is not self.materials:
            raise ValueError(f"state = {line(state)}, must be a state of this simulation")

    def on_grid(self, points: MaterialPoints) -> OnGrid:
        """Return the bodies on the grid, reset for the given points."""
        grid = self.grid

        def make() -> OnGrid:
            with _compat.Timer("cut domains"):
                more = self.momentum.inertia is not None, self.storage is not None
                cut = CutDomains(grid, points, self.numerics.quadrature == "domain", *more)
                self._looks = tuple(filter(None, [look(cut, self.bodies) for look in self._looks]))
            with _compat.Timer("integration data"):
                problems = (self.momentum, self.storage)
                return OnGrid(self.pieces, *problems, cut, self.scheme.of_fluid)

        lines = () if grid.follow is None else grid.lines
        return self._on_grid((points.arrays, lines), make, grid.comm)

    def check_followed(self, first: Stage) -> None:
        """Raise ValueError if grid lines follow a tool that is absent from the first stage."""
        follow = self.grid.follow
        if hasattr(follow, "pose") and first.followed(self.grid) is None:
            raise ValueError(f"grid: follow = {line(follow)}, not in the first stage, must be one of its conditions")

    def followed(self, state: State) -> State:
        """Move the grid lines for the next step.  Return the state on the new lines."""
        if self.grid.follow is None:
            return state
        state = with_lines(self.grid, state, lambda at: self.motion.left_grid(at, self.on_grid(at.stay.points)))
        self.materials.check_cells()
        return state

    @cached_property
    def _replacing(self) -> Sequence[Callable[[State], tuple[State, int]]]:
        """Functions that replace particle domains at a reset of the grid, by division and merging, or by renewal."""
        grid = self.grid
        if not self.numerics.renewal:
            return ()
        has = {
            "has groups in contact": grid.copies > 1,
            "has `specific_yield`": self.materials.drains,
            "has quadrature 'point'": self.numerics.quadrature != "domain",
        }
        moves = self.momentum.inertia is not None
        of_yield = has | {
            "is in 3D": grid.dim == 3,
            "has inertia in axisymmetry": grid.axisymmetric and moves,
            "has no soil that yields": "plastic" not in self.materials.state_names,
        }
        unsaturated = self.materials.retentions is not None
        of_lines = has | {
            "has unsaturated soil": unsaturated,
            "has inertia": moves,
            "has grid lines that stay": grid.follow is None,
        }
        found = [[what for what, so in of.items() if so] for of in (of_yield, of_lines)]
        if all(found):
            allowed = "of soil that yields, in 2D"
            if grid.follow is not None:
                found, allowed = found[1:], "dry or saturated, without inertia, on a grid whose lines move"
            raise ValueError(f"Numerics(renewal=True): the scene {' and '.join(found[0])}, must be {allowed}")
        faces = SeededFaces(grid, self.bodies)
        renewal, division = (of(faces, self.materials) for of in (Renewal, Division))
        both = (division.divided, not found[1]), (renewal.renewed, not found[0])
        return [one for one, possible in both if possible]

    def for_reset(self, state: State, renew: bool) -> tuple[State, int]:
        """Return a state for a reset of the grid, and the number of renewed domains.

        In this state, each point is on the process that owns its cell.  `renew`: whether renewal is allowed.
        """
        if state.stays:
            return state, 0
        if not self._replacing or not renew:
            return state.at_owners(self.grid), 0

        def make() -> tuple[dict[str, Any], int]:
            with _compat.Timer("renew domains"):
                new, count = state, 0
                for replacing in self._replacing:
                    new, number = replacing(new)
                    count += number
            return {name: getattr(new, name) for name in ("points", "pieces", "stay", "trend") if count}, count

        pieces, stay = state.pieces, state.stay
        key = (*state.points.arrays, *self.grid.lines, state.stage, state.watched, stay and stay.keeps)
        key = key if pieces is None else (*key, *pieces.arrays.values())
        new, count = self._renewed(key, make, self.grid.comm)
        return replace(state, **new).at_owners(self.grid), count

    def assembled(
        self,
        on_grid: OnGrid,
        stage: Stage,
        now: Sequence[Loads],
        as_cut: Callable[[], Sequence[Loads]],
        begins: bool,
        dt: float,
    ) -> Assembled:
        """Return the matrices for a stage of the bodies on the grid.

        `now`: present loads in a step of length `dt` (s).
        `as_cut`: function that returns the loads at the last reset.
        `begins`: whether this is the first step of a stage.  If so, all parts of the bodies must have supports.

        Raises
        ------
        ValueError
            A body has a free rigid-body mode, or a connected part of a body has one at the start of a stage.
        """

        def make() -> Assembled:
            loads, active = as_cut(), self.momentum.active.now
            with _compat.Timer("integration data"):
                dofs = active.dofs[stage.free[active.nodes].ravel()]
                pairs = tuple((on_grid.key, one.key) for one in now if one.couples)  # depend on the positions
                others = pairs, on_grid.not_full if stage.inertia else None, () if grid.follow is None else grid.lines
                # a cell between active nodes may become active, so active cells may differ for equal dofs
                key = (stage, on_grid.cells, dofs, on_grid.penalised, *others)
                system = self._systems(key, lambda: self._system(on_grid, stage, dofs, loads, begins), grid.comm)
                return Assembled(self.momentum, self.storage, system, on_grid, stage, loads)

        grid = self.grid
        inertia = self.momentum.inertia is not None
        of_contact = dt if inertia and any(one.touches for one in now) else None  # rounding errors depend on dt
        return self._assembled((on_grid.key, stage, of_contact, *(one.key for one in now)), make, grid.comm)

    def _system(
        self, on_grid: OnGrid, stage: Stage, dofs: NDArray[np.int32], loads: Sequence[Loads], begins: bool
    ) -> System:
        """Return vectors, matrices and solvers for the active cells."""
        if not stage.inertia and not any(one.holding for one in loads):
            check_held(on_grid.active, stage.free, [held for one in loads if (held := one.touching())], begins)
        stiff, symmetric = any(one.stiff for one in loads), self.momentum.symmetric and stage.symmetric
        return System(self.momentum, self.storage, self.scheme, on_grid, dofs, stiff, symmetric, loads)

    def seeded(self, chosen: Sequence[bool]) -> MaterialPoints:
        """Return the seeded points of the chosen bodies on this process."""
        return self.materials.seeded.of_bodies(chosen, np.cumsum([0, *map(len, self.bodies)]))

    @cached_property
    def description(self) -> dict[str, Any]:
        """Constants that define the scene, by name.  A checkpoint must have the same constants."""
        grid = self.grid
        out = {"grid cells": grid.shape.tolist(), "grid lower": grid.lower.tolist(), "grid upper": grid.upper.tolist()}
        if not grid.even:
            out |= {f"grid lines along {letter}": x.tolist() for letter, x in zip("xyz", grid.seeded, strict=False)}
        out |= {"quadrature": self.numerics.quadrature, **({"axisymmetric": True} if grid.axisymmetric else {})}
        if grid.copies > 1:
            first = np.cumsum([0, *(len(body) for body in self.bodies[:-1])])
            out["groups of the bodies"] = (grid.copy(first) // grid.cells).tolist()
        for i, body in enumerate(self.bodies):
            out[f"points of body {i}"], out[f"material of body {i}"] = len(body), int(body.material)
            volume, checksum = 0.0, 0
            for part in in_chunks(len(body)):
                volume += float(np.abs(volumes(body.reference(part))).sum())
                checksum = zlib.crc32(np.ascontiguousarray(body.corners(part)).tobytes(), checksum)
            out[f"volume of body {i}"], out[f"checksum of the positions of body {i}"] = volume, checksum
        materials = {f"material {i}": m for i, m in enumerate(self.materials.materials)}
        for name, one in {**materials, "fluid": self.fluid}.items():
            out[name] = None if one is None else type(one).__name__
            constants = {f.name: getattr(one, f.name) for f in fields(one)} if one is not None else {}
            laws = ("retention",)  # sampled values identify these laws
            given = {key: value for key, value in constants.items() if key not in laws and value is not None}
            constants = {key: value for key, value in given.items() if not callable(value)}
            out |= {f"{key} of {name}": np.asarray(value).tolist() for key, value in constants.items()}
        return {**out, **self.materials.checksums, "data of the points": sorted(self.materials.seeded.data)}

    @property
    def last(self) -> tuple[OnGrid | None, Assembled | System | None]:
        """The bodies on the grid and the matrices of the last step, for inspection."""
        return self._on_grid.value, self._assembled.value or self._systems.value

    def forget(self) -> None:
        """Delete all data of a step, for example after an interrupt."""
        for made in (self._systems, self._on_grid):
            made.clear()
