# SPDX-License-Identifier: MIT
"""A scene as it is compiled: grid, bodies, materials and forms; all that lasts from its first step to its last."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from dolfinx import fem
from dolfinx.common import Timer
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.time_integration import Substep, substeps
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.bodies import Body, material_points
from mpm_dolfinx.conditions.acting import Loads
from mpm_dolfinx.conditions.conditions import OnSide
from mpm_dolfinx.conditions.unit_weights import other_gravity, weighed
from mpm_dolfinx.diagnostics.resolution import warn_overfilled, warn_smeared
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.sources import Sources
from mpm_dolfinx.flow.storage import CellPressure, StorageForms
from mpm_dolfinx.grid.grid import Grid, in_chunks
from mpm_dolfinx.materials.evaluate import ConductivityAtPieces
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
from mpm_dolfinx.stepping.grid_reset import Assembled, OnGrid, System, assembled
from mpm_dolfinx.stepping.renewal import Renewal
from mpm_dolfinx.stepping.stage import Stage
from mpm_dolfinx.stepping.state import State


class When(NamedTuple):
    """A substep: its end, s, with the time since the start of the step, s, and gravity (d,), m/s^2, or None.

    own: time in which a rate at its end counts, s; past: share of the displacements at its start before it.
    """

    t: float
    since: float
    gravity: NDArray[np.float64] | None
    own: float
    past: float


class Scene:
    """A scene.  Nothing of it tells one step from another: what a step depends on is in its `State`.

    Parameters
    ----------
    grid, bodies, materials, fluid, numerics
        See `Simulation`.
    weighs
        Whether there is gravity.
    pressure
        Pore pressure at the start, Pa, or a function of places.
    extensions
        The user's terms in the balance of momentum, and those in the storage of fluid.
    initial
        Stresses of bodies as seeded, see `initial_stress.by_body`.
    velocity
        At the start, m/s, of a scene whose bodies may have inertia, see `Simulation`; None of others.
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
    ):
        self.grid = grid
        self.bodies = tuple(bodies)
        self.fluid = fluid
        self.numerics, scheme = numerics, numerics.scheme
        terms, sources = self.extensions = extensions
        """The user's terms and sources."""
        pressure = weighed(pressure, fluid)
        self.initial = InitialStresses(self.bodies, initial, pressure)
        seeded = material_points(grid, bodies, pressure)
        if velocity is not None:
            seeded = replace(seeded, data=moving(seeded, velocity, grid.base, grid.axisymmetric))
        self.materials = scene = SceneMaterials(grid, materials, bodies, seeded, fluid, bool(initial))
        self.gravity = fem.Constant(grid.mesh, np.zeros(grid.dim)) if weighs else None
        self.t, self.dt = fem.Constant(grid.mesh, 0.0), fem.Constant(grid.mesh, 1.0)
        """Time at the end of the substep, and since the start of the step, s, for forms."""
        inside = [term for term in terms if not isinstance(term, OnSide)]
        self.pieces = QuadraturePoints(grid, scene, fluid, weighs, bool(len(inside) + len(sources)))
        laws, p = self.pieces.laws, CellPressure(*(fem.Function(grid.cellwise()) for _ in range(3))) if fluid else None
        with compiling(f"materials: {', '.join(law.__name__ for law in scene.laws)}", "laws in UFL of these shapes"):
            wet = fluid.density if fluid else None
            options = (self.gravity, wet, scene.symmetric)
            options = (*options, numerics.quadrature == "point", terms, self.t, self.dt, velocity is not None)
            options = (*options, scene.retentions)
            self.momentum = MomentumForms(self.pieces.pieces, laws, p and p.now, *options)
        if scheme.coupling == "schur-cg" and not (self.momentum.symmetric and scene.retentions is None):
            scheme = replace(scheme, coupling="schur-fgmres")
        self.scheme, self.storage = scheme, None
        if fluid:
            weight = fluid.density * self.gravity if weighs else None
            symmetric = scheme.coupling != "schur-fgmres"
            moves = self.momentum.inertia
            inertial = None if moves is None else -fem.Constant(grid.mesh, fluid.density) * moves.acceleration
            pieces = self.pieces.pieces
            u = self.momentum.u
            laws = scene.conductivity_laws
            law = ConductivityAtPieces(scene.materials, laws, pieces, u, p.before) if laws else None
            kind = (symmetric, scene.conducts, scene.evolves)
            feeding = [Sources(sources, pieces, p.now, self.t)] if sources else []
            forms = (pieces, u, p, fluid.bulk, weight, *kind, law, feeding, inertial, scene.retentions)
            self.storage = StorageForms(*forms)
        self.motion = Motion(scene, bodies, self.momentum, self.storage)
        # what is still to be looked for, to be warned of, of which nothing but the log knows
        self._looks = (warn_overfilled, *[partial(warn_smeared, materials=scene)] * scene.uneven)
        self._on_grid: Latest[OnGrid] = Latest()
        self._systems: Latest[System] = Latest()
        self._assembled: Latest[Assembled] = Latest()
        self._renewed: Latest[tuple[dict[str, Any], int]] = Latest()
        _ = self._renewal  # refuses scenes that have none

    @property
    def flows(self) -> bool:
        """Whether fluid moves, or is brought by sources."""
        return self.storage is not None and (self.materials.conducts or bool(self.storage.feeding))

    @property
    def substeps(self) -> tuple[Substep, ...]:
        """Substeps of a step."""
        return substeps(
            self.numerics.method, self.flows or self.momentum.own.rates or self.momentum.inertia is not None
        )

    def balance(
        self,
        when: When,
        system: MomentumSystem,
        data: QuadratureData,
        loads: Sequence[Loads],
        u: NDArray[np.float64] | float | None = None,
        **options,
    ) -> MomentumProblem:
        """Return the balance of momentum at the end of a substep, which begins: all that forms see of it is set.

        Parameters
        ----------
        when
            The substep.
        system, data, loads, options
            See `MomentumProblem`.
        u : (unknowns,), m
            Displacements at which the iterations begin, a local array; None: the present ones.
        """
        self.t.value, self.dt.value = when.t, when.since
        if when.gravity is not None:
            self.gravity.value = when.gravity
        self.momentum.velocity.set(when.own, when.past)
        if self.storage is not None:
            self.storage.p_before.x.array[:] = self.storage.p.x.array
        if u is not None:
            self.momentum.u.x.array[:] = u
        return MomentumProblem(self.momentum, system, data, loads, self.scheme.tolerance, **options)

    @cached_property
    def _told(self) -> set[str]:
        """What has been warned of, of which nothing but the log knows."""
        return set()

    def look_at(self, gravity: Sequence[NDArray[np.float64] | None]) -> None:
        """Warn, once, of a gravity at the start of a step and in it that is not that of the conductivities."""
        if self.fluid is None or not self.materials.conducts or gravity[0] is None or "gravity" in self._told:
            return
        if strength := other_gravity(self.fluid, gravity):
            what = "gravity = %.6g m/s^2, but conductivities become mobilities by the fluid's density x 9.81 m/s^2, as "
            what += "gravity changes with time: must be given as Fluid(gravity=...)"
            warn(self.grid.comm, ConditionWarning, what, strength)
            self._told.add("gravity")

    def rests_at(self, stage: Stage, t: float) -> None:
        """Set the weight of the fluid by which pressures within a cell differ where pores drain, see `Retentions`.

        Of a stage at the time, s, at which a step begins; where gravity changes the grid is reset in each step.
        """
        if self.materials.retentions is not None:
            gravity = stage.gravity_at(t) if self.materials.conducts else None
            self.materials.retentions.weight.value = 0.0 if gravity is None else self.fluid.density * gravity

    def check(self, state: State) -> None:
        """Refuse what is no state of this scene: its conditions act on the materials of another one."""
        if not isinstance(state, State) or state.stage.materials is not self.materials:
            raise ValueError(f"state = {line(state)}, must be a state of this simulation")

    def on_grid(self, points: MaterialPoints) -> OnGrid:
        """Return the bodies on the grid, reset for these points."""
        grid = self.grid

        def make() -> OnGrid:
            self._assembled.clear()  # of coefficients that change now
            with Timer("mpm: cut domains"):
                cut = CutDomains(grid, points, self.numerics.quadrature == "domain", self.momentum.inertia is not None)
                self._looks = tuple(filter(None, [look(cut, self.bodies) for look in self._looks]))
            with Timer("mpm: integration data"):
                problems = (self.momentum, self.storage)
                return OnGrid(self.pieces, *problems, cut, self.scheme.of_fluid)

        return self._on_grid(points.arrays, make, grid.comm)

    @cached_property
    def _renewal(self) -> Renewal | None:
        """Renews domains; None where these are never renewed."""
        grid = self.grid
        if not self.numerics.renewal:
            return None
        has = {
            "is in 3D": grid.dim == 3,
            "is axisymmetric": grid.axisymmetric,
            "has cells of many sizes": not grid.even,
            "has groups in contact": grid.copies > 1,
            "has pores that drain": self.materials.drains or self.materials.retentions is not None,
            "has inertia": self.momentum.inertia is not None,
            "has quadrature 'point'": self.numerics.quadrature != "domain",
            "has no soil that yields": "plastic" not in self.materials.state_names,
        }
        if found := [what for what, so in has.items() if so]:
            what = f"Numerics: renewal = True: the scene {' and '.join(found)}"
            raise ValueError(f"{what}, must be of soil that yields, dry or saturated, in plane strain on equal cells")
        return Renewal(grid, self.bodies, self.materials)

    def for_reset(self, state: State, renew: bool) -> tuple[State, int]:
        """Return a state for a reset of the grid, with points at their owners, and how many domains were renewed.

        renew: whether any may be.
        """
        if self._renewal is None or not renew:
            return state.at_owners(self.grid), 0

        def make() -> tuple[dict[str, Any], int]:
            with Timer("mpm: renew domains"):
                new, count = self._renewal.renewed(state)
            return {name: getattr(new, name) for name in ("points", "pieces", "stay") if count}, count

        pieces, stay = state.pieces, state.stay
        key = (*state.points.arrays, state.stage, state.watched, stay and stay.keeps)
        key = key if pieces is None else (*key, *pieces.arrays.values())
        new, count = self._renewed(key, make, self.grid.comm)
        return replace(state, **new).at_owners(self.grid), count

    def assembled(
        self, on_grid: OnGrid, stage: Stage, now: Sequence[Loads], as_cut: Callable[[], Sequence[Loads]], begins: bool
    ) -> Assembled:
        """Return the matrices for a stage of the bodies on the grid.

        Parameters
        ----------
        now
            What acts on the bodies.
        as_cut
            Returns this, placed where the points were cut.
        begins
            Whether all parts of the bodies must be held.
        """

        def make() -> Assembled:
            problems = (self.momentum, self.storage, self.scheme, self._systems)
            return assembled(*problems, on_grid, stage, as_cut(), begins)

        return self._assembled((on_grid.key, stage, *(one.key for one in now)), make, self.grid.comm)

    def all_ids(self, present: Sequence[bool]) -> NDArray[np.int64]:
        """Return the numbers of all points of the bodies that are there."""
        return np.flatnonzero(np.repeat(present, [len(body) for body in self.bodies]))

    @cached_property
    def description(self) -> dict[str, Any]:
        """The constants that make the scene, by name: what a checkpoint of it is known by."""
        grid = self.grid
        out = {"grid cells": grid.shape.tolist(), "grid lower": grid.lower.tolist(), "grid upper": grid.upper.tolist()}
        if not grid.even:
            out |= {f"grid lines along {letter}": x.tolist() for letter, x in zip("xyz", grid.lines, strict=False)}
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
            laws = ("retention",)  # known by what it gives, in the checksums
            given = {key: value for key, value in constants.items() if key not in laws and value is not None}
            constants = {key: value for key, value in given.items() if not callable(value)}
            out |= {f"{key} of {name}": np.asarray(value).tolist() for key, value in constants.items()}
        return {**out, **self.materials.checksums, "data of the points": sorted(self.materials.seeded.data)}

    @property
    def last(self) -> tuple[OnGrid | None, Assembled | System | None]:
        """The bodies as they were last cut, and the matrices of the last step, to be looked at."""
        return self._on_grid.value, self._assembled.value or self._systems.value

    def forget(self) -> None:
        """Drop all that was made for a step: it may have been broken off anywhere."""
        for made in (self._assembled, self._systems, self._on_grid):
            made.clear()
