# SPDX-License-Identifier: MIT
"""State at the start of each stage.

Initial stresses are not exactly in equilibrium. The momentum balance is therefore solved at constant pressures. This
solution changes the elastic strains of the points, but not their positions.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import partial
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.errors import Report, StepFailed
from mpm_dolfinx.base.fluid_content import mass_potential, pressure_of
from mpm_dolfinx.base.tolerances import FOREVER, ROUND_OFF, SAME, TINY
from mpm_dolfinx.base.validation import chosen, flag, instance, line, numbers
from mpm_dolfinx.bodies.bodies import pressure_at
from mpm_dolfinx.bodies.faces import Surface, surface
from mpm_dolfinx.bodies.fills import put, touches
from mpm_dolfinx.bodies.touching import check_apart
from mpm_dolfinx.conditions.acting import Place
from mpm_dolfinx.conditions.conditions import Quiet, Tied
from mpm_dolfinx.conditions.unit_weights import warn_levels, warn_units, waters
from mpm_dolfinx.domains.fitted import fitted_at
from mpm_dolfinx.domains.pressure_transport import PiecePressures, at_start
from mpm_dolfinx.dynamics.at_rest import balancing_tractions
from mpm_dolfinx.dynamics.quiet_sides import QuietSides, traction_name
from mpm_dolfinx.flow.feeding import Beginning
from mpm_dolfinx.grid.grid import SIDES, sum_by
from mpm_dolfinx.materials.initial_stress import strained
from mpm_dolfinx.mechanics.inertia import resting
from mpm_dolfinx.mechanics.momentum import MomentumProblem
from mpm_dolfinx.mechanics.tractions import owners
from mpm_dolfinx.parallel.exchange import over_all, together
from mpm_dolfinx.parallel.messages import ConditionWarning, log, warn
from mpm_dolfinx.points.material_points import MaterialPoints, body_of
from mpm_dolfinx.solve.newton import solve_substep
from mpm_dolfinx.solve.schur import Kept, LinearSolvers, planned
from mpm_dolfinx.stepping.balances import Start, at_rest
from mpm_dolfinx.stepping.scene import Scene, When
from mpm_dolfinx.stepping.stage import Condition, Stage, checked, contacts_of
from mpm_dolfinx.stepping.state import State, Stay
from mpm_dolfinx.stepping.step import set_up

DEPTH = 40
"""Number of previous iterations in Anderson mixing. Twice this value gives the same number of iterations.

Iterations end if `DEPTH / 2` iterations in succession do not halve the square of the smallest residual.
"""
REMARKABLE = 0.05
"""A change of the initial stress by more than this fraction of the largest initial stress causes a warning.

This value is also the largest allowed relative residual of the forces.
"""

OF_CONTENT = ("porosity", "biot", "grain_bulk")
"""Material constants that determine the fluid content at a given pressure and volume."""


def first_state(scene: Scene, conditions: Mapping[str, Any], later: Sequence[int]) -> State:
    """Return the state of a scene in its first stage, before its initial stresses are balanced."""
    present = [body not in later for body in range(len(scene.bodies))]
    check_apart(scene.grid, scene.bodies, present)
    first = scene.stage(conditions, present, later, {})
    if scene.initial.given and (quiet := first.of(Quiet)):
        raise ValueError(
            f"{next(iter(quiet))}: cannot balance initial stress, must begin in a later stage: first prescribe the side"
        )
    _check_weight(first, None, 0.0)
    first.check_motions(0.0)
    _warn_dammed(scene, first, 0.0)
    scene.check_followed(first)
    comm, gravity = scene.grid.comm, first.conditions["gravity"]
    warn_levels(comm, scene.fluid, gravity, [("pressure", scene.initial.pressure), *waters(first.named)])
    if scene.fluid and scene.materials.conducts:
        warn_units(comm, scene.fluid, gravity)
    points = scene.seeded(present)
    points = _prestressed(scene, points, present, first.gravity_at(0.0) if scene.initial.given else None)
    for one in first.feeding:
        one.check(Beginning(points, first.named, first.gravity_at(0.0)))
    pieces = None
    if all(present):
        scene.materials.seeds_no_more()
    scene.rests_at(first, 0.0)
    if scene.fluid:
        placed = callable(scene.initial.pressure) or scene.materials.retentions is not None
        pieces = pieces_at_start(scene, points) if placed else at_start(points)
    return State(
        t=0.0,
        points=_gripped(scene, first, points),
        pieces=pieces,
        outcome=first.unknown(np.nan if scene.initial.given else 0.0),
        stage=first,
    )


def begin_stage(
    scene: Scene,
    state: State,
    named: Mapping[str, Any],
    add: Sequence[int],
    remove: Sequence[int],
    reset_displacement: bool,
    fields: Mapping[str, ArrayLike],
) -> State:
    """Return the state at the beginning of a stage with the new conditions `named`, see `Simulation.stage`."""
    flag("stage: reset_displacement", reset_displacement)
    before, after = state.stage, _stage_after(scene, state, named, add, remove)
    quiet = {name: one for name, one in after.of(Quiet).items() if name not in after.same(before)}
    if quiet and before.inertia:
        raise ValueError(f"{next(iter(quiet))}: must act from the first stage in which its bodies have inertia")
    state, tractions = _released(scene, state, after, quiet) if quiet else (state, {})
    scene.rests_at(before, state.t)
    state = scene.followed(state)
    if state.stays:  # points have the pressures of cells, not of pieces
        state = scene.motion.left_grid(state, scene.on_grid(state.stay.points))
    starts_moving = after.inertia and not before.inertia
    rests = starts_moving and (not state.begins or state.held is not None)
    state, supported = replace(state, stay=None), _holds_as(after, before)
    if rests and supported and not scene.momentum.own.rates:
        state = _kept_at_rest(scene, state)
    else:
        state = replace(state, held=None)
    removed = _points_of(scene, state.points, remove)
    points, new = _joined(scene, state, after, add, remove, fields)
    ended = before.data_names(before.named.keys() - after.same(before))
    points = _gripped(scene, after, points, _without_data(state.points, ended))
    points = _changed(scene, _with_tractions(points, tractions), fields)
    if starts_moving:
        points = replace(points, data=points.data | resting(points))
    if reset_displacement:
        points = replace(points, origin=points.corners)
    pieces = state.pieces
    if pieces is not None:
        pieces = pieces.of(removed, kept=False).joined(at_start(new))
    return replace(
        state,
        points=points,
        pieces=pieces,
        stage=after,
        begins=True,
        outcome=after.initial_outcome(before, state.outcome, np.nan if state.resets else 0.0),
        rest=state.rest if supported else None,
        trend=None if add or remove else state.trend,
    )


def _stage_after(
    scene: Scene, state: State, named: Mapping[str, Any], add: Sequence[int], remove: Sequence[int]
) -> Stage:
    """Return the stage that follows the stage of a state, checked.  Parameters: see `Simulation.stage`."""
    before = state.stage
    if "gravity" in named and scene.gravity is None:
        raise ValueError("gravity: the scene has none, must be created with gravity=(0, 0)")
    if "inertia" in named:
        flag("stage: inertia", named["inertia"])
        if scene.momentum.inertia is None:
            raise ValueError("stage: inertia: the scene has none, must be created with inertia=False")
    chosen("stage: remove", remove, np.flatnonzero(before.present).tolist(), "bodies that are present")
    chosen("stage: add", add, list(before.later), "bodies that are still to be added")
    present = [(is_present and body not in remove) or body in add for body, is_present in enumerate(before.present)]
    later = [body for body in before.later if body not in add]
    conditions = _with_contacts(before, named.get("conditions", tuple(before.given.values())))
    after = scene.stage({**before.conditions, **named, "conditions": conditions}, present, later, before.given)
    _check_weight(after, before, state.t)
    after.check_motions(state.t)
    _warn_dammed(scene, after, state.t)
    for one in after.feeding:
        one.check(Beginning(state.points, after.named.keys() - before.named.keys(), after.gravity_at(state.t)))
    if "gravity" in named or waters(after.given) != waters(before.given):
        warn_levels(scene.grid.comm, scene.fluid, after.conditions["gravity"], waters(after.named))
    if remove:
        _warn_moved_on(scene, before, after)
    for name, volume in state.outcome.get("ponded", {}).items():
        if volume > 0 and after.given.get(name) is not before.given[name]:
            what = "stage: %s: its pond of %.3g m^%d runs off, because this condition ends; to change the rain, give "
            warn(scene.grid.comm, ConditionWarning, f"{what}it as a function of t", name, volume, scene.grid.stretches)
    return after


def _points_of(scene: Scene, points: MaterialPoints, bodies: Sequence[int]) -> NDArray[np.int64]:
    """Return the ids of the points of bodies, which are given by index."""
    return points.id[np.isin(body_of(points.id, np.cumsum([0, *map(len, scene.bodies)])), list(bodies))]


def _joined(
    scene: Scene, state: State, after: Stage, add: Sequence[int], remove: Sequence[int], fields: Mapping[str, ArrayLike]
) -> tuple[MaterialPoints, MaterialPoints]:
    """Return all points of the next stage, without the data of conditions, and the points of added bodies alone."""
    before = state.stage
    bare = _without_data(state.points, before.data_names(before.named))
    if add and over_all(scene.grid.comm, int((bare.id >= sum(map(len, scene.bodies))).any())):
        what = f"stage: add: body {add[0]} after a renewal of domains"
        raise ValueError(f"{what}, must be added before the first renewal, or without Numerics(renewal=True)")
    bare = _without_extra(scene, bare, add, fields) if add else bare
    bare = bare.of(_points_of(scene, bare, remove), kept=False)
    standing = [body for body, is_present in enumerate(before.present) if is_present and body not in remove]
    return _filled(scene, bare, standing, add, after.gravity_at(state.t) if scene.initial.given else None)


def _with_tractions(
    points: MaterialPoints, tractions: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]]
) -> MaterialPoints:
    """Return the points with the tractions of quiet sides, which are results of `_released`."""
    data = dict(points.data)
    for name, (ids, values) in tractions.items():
        known, at = points.find(ids)
        data[name] = data[name].copy()
        data[name][at] = values[known]
    return replace(points, data=data)


def next_stage(
    scene: Scene,
    state: State,
    named: Mapping[str, Any],
    add: Sequence[int],
    remove: Sequence[int],
    reset_displacement: bool,
    fields: Mapping[str, ArrayLike],
) -> State:
    """Return the result of `begin_stage`, or `state` itself if the stage changes nothing."""
    new = begin_stage(scene, state, named, add, remove, reset_displacement, fields)
    changes = len(add) + len(remove) + len(fields) > 0 or reset_displacement
    return new if changes or not new.stage.equals(state.stage) else state


def _released(
    scene: Scene, state: State, after: Stage, quiet: Mapping[str, Quiet]
) -> tuple[State, dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    """Return the state on the grid of the next step, and the static tractions on sides that become quiet.

    Tractions balance the stresses, the loads of the previous stage, and the remaining supports. The keys of the
    dictionary are names of point data. Each value has the ids of points, and the tractions at them.
    """
    start = set_up(scene, state, 0.0)
    state, momentum = start.state, scene.momentum
    when, given = When(state.t, 1.0, start.acting[-1].gravity, 1.0, 0.0), (start.data, start.acting[-1].loads)
    problem = scene.balance(when, start.matrices.momentum, *given, held=state.held)
    forces = problem.unbalanced().reshape(-1, scene.grid.dim)
    surfaces = next(of for of in after.acting if isinstance(of, QuietSides)).named(quiet)
    cut = start.on_grid.cut

    def near(some: Sequence[Surface], axes: Sequence[int]) -> NDArray[np.bool_]:
        """Return a mask of displacement components along `axes`, at nodes of cells that contain the surfaces `some`."""
        nodes = momentum.active_nodes(np.unique(owners(scene.grid, cut.surfaces(some))[1].cells))
        return nodes[:, None] & np.isin(np.arange(scene.grid.dim), list(axes))

    now, then = ~after.free, ~state.stage.free
    for of, held in ((after, now), (state.stage, then)):
        for _, faces, axes in of.held:
            held |= near([faces], axes)
    counts = ~now & (near(list(surfaces.values()), range(scene.grid.dim)) | ~then)
    owned = momentum.u.function_space.dofmap.index_map.size_local
    given = scene.grid.comm, list(map(len, scene.bodies)), state.points
    stresses = {
        name: fitted_at(*given, faces.id, faces.xi.mean(axis=1), scene.materials.total_stress)
        for name, faces in surfaces.items()
    }
    parts = start.matrices.momentum.parts
    found = balancing_tractions(cut, state.points, stresses, surfaces, parts, (forces * counts)[:owned], now)
    return state, {traction_name(name): of for name, of in found.items()}


def _kept_at_rest(scene: Scene, state: State) -> State:
    """Return the state on the grid of the next step, with forces `held` that keep its bodies at rest.

    These forces cancel the small out-of-balance forces that a reset of the grid causes.  Scenes with contact have no
    such forces.
    """
    start, forms = set_up(scene, state, 0.0), scene.momentum
    state, system = start.state, start.matrices.momentum
    if any(one.touches for one in start.acting[-1].loads):
        return replace(state, held=None)
    where = start.on_grid.cut, start.on_grid.fill, state.points, start.data
    place = Place(*where, state.t, TINY, state.t, state.outcome, inertia=True)  # dt = 0: no prescribed displacements
    (loads,) = at_rest(scene, state, [state.stage.placed(place)])
    when = When(state.t, FOREVER, start.acting[-1].gravity, FOREVER, 0.0)
    residual, _ = scene.balance(when, system, start.data, loads, 0.0).assemble_residual()
    forms.u.x.array[:] = 0.0
    system.unknowns.add(forms.u.x, 1.0, residual)
    return replace(state, held=forms.u.x.array.copy())


def _gripped(
    scene: Scene, after: Stage, points: MaterialPoints, before: MaterialPoints | None = None
) -> MaterialPoints:
    """Return the points with the data that conditions store in points."""
    kept = after.kept(len(points))
    if clashes := sorted(kept.keys() & scene.materials.seeded.data.keys()):
        raise ValueError(f"{clashes[0]!r}: points have data of this name, the condition must have another name")
    if before is not None:
        known, at = before.find(points.id)
        for name in kept.keys() & before.data.keys():
            kept[name][known] = before.data[name][at]
    return replace(points, data={**points.data, **kept}) if kept else points


def _without_data(points: MaterialPoints, names: Collection[str]) -> MaterialPoints:
    """Return the points without the named data."""
    return replace(points, data={name: rows for name, rows in points.data.items() if name not in names})


def _holds_as(after: Stage, before: Stage) -> bool:
    """Return whether the same conditions support the same faces in two stages."""
    return len(after.held) == len(before.held) and all(
        hold is was and np.array_equal(faces.id, then.id) and np.array_equal(faces.xi, then.xi)
        for (hold, faces, _), (was, then, _) in zip(after.held, before.held, strict=True)
    )


def _check_weight(after: Stage, before: Stage | None, t: float) -> None:
    """Raise ValueError if a stage with quiet sides changes gravity."""
    quiet = after.of(Quiet)
    now = after.gravity_at(t) if quiet else None
    was = None if before is None else before.gravity_at(t)
    was = np.zeros(after.free.shape[1]) if was is None else was
    if now is not None and (now != was).any():
        what = f"{next(iter(quiet))}: its traction at rest does not bear the weight, gravity = {line(now.tolist())}"
        allowed = "must begin in a later stage: first prescribe the side in a stage without inertia"
        raise ValueError(f"{what} after {line(was.tolist())}, {allowed}")


def _warn_dammed(scene: Scene, stage: Stage, t: float) -> None:
    """Warn of a gravity component along the normal of tied sides. This component drives pore fluid."""
    tied = stage.of(Tied)
    gravity = stage.gravity_at(t) if tied and scene.fluid and scene.materials.conducts else None
    for name, one in tied.items() if gravity is not None else ():
        if along := gravity[SIDES[scene.grid.dim][one.side][0]]:
            what = (
                "%s: gravity has the component %.3g between the sides, but must have none with flowing pore fluid: no "
            )
            more = "fluid flows through tied sides, so pressures will rise from one side to the other"
            warn(scene.grid.comm, ConditionWarning, what + more, name, along)


def _prestressed(
    scene: Scene, points: MaterialPoints, present: Sequence[bool], gravity: NDArray | None
) -> MaterialPoints:
    """Return new points with their initial stress."""
    points = scene.initial.of(scene.materials, points, present, gravity)
    if scene.initial.given and (where := scene.initial.lifted(scene.materials, points)):
        what = "initial_stress: K0 gives vertical tension, such as %s, because the pore pressure exceeds the overburden"
        warn(scene.grid.comm, ConditionWarning, what + "; K0 needs the weight of open water as surcharge", where)
    return points


def _with_contacts(before: Stage, conditions: Sequence[Condition]) -> list[Condition]:
    """Return the conditions together with the contacts of the scene."""
    standing, given = contacts_of(before.given.values()), contacts_of(checked(conditions))
    if given and str([vars(one) for one in given]) != str([vars(one) for one in standing]):
        raise ValueError(f"stage: conditions: {line(given[0])}, must be the contacts of the scene, or left out")
    return [*(one for one in conditions if one not in given), *standing]


def _warn_moved_on(scene: Scene, before: Stage, after: Stage) -> None:
    """Warn of unchanged conditions that also act on faces exposed by an excavation."""
    stop = np.cumsum([len(body) for body in scene.bodies])
    for name, condition in after.given.items():
        if not hasattr(condition, "side") or before.given.get(name) is not condition:
            continue
        where = condition.side, getattr(condition, "region", None)
        was, now = (surface(scene.bodies, *where, s.present) for s in (before, after))
        bare = sum_by(now.id, now.area0, stop[-1]) - sum_by(was.id, was.area0, stop[-1])
        was_present = np.repeat(before.present, [len(body) for body in scene.bodies])
        new = np.flatnonzero(was_present[now.id] & (bare[now.id] > SAME * now.whole0))
        if len(new):
            area = bare[np.unique(now.id[new])].sum()
            what = "stage: remove: %s is unchanged and now also acts on %.3g %s of newly exposed faces, first at %s"
            unit = "m^2" if scene.grid.stretches == 3 else "m"
            values = line(condition), area, unit, now.X[new[0]].mean(axis=0)
            warn(scene.grid.comm, ConditionWarning, what, *values)


def _filled(
    scene: Scene, points: MaterialPoints, standing: Sequence[int], add: Sequence[int], gravity: NDArray | None
) -> tuple[MaterialPoints, MaterialPoints]:
    """Return all points, including added bodies, and the points of added bodies alone."""
    standing = list(standing)
    waiting = list(add)
    new = scene.materials.seeded.of(np.empty(0, np.int64))
    while waiting:
        fill = next((body for body in waiting if touches(scene.bodies, standing, body)), waiting[0])
        placed = scene.seeded(np.arange(len(scene.bodies)) == fill)
        placed = put(scene.grid, scene.bodies, standing, fill, points, placed)
        placed = _prestressed(scene, placed, [i in (*standing, *add) for i in range(len(scene.bodies))], gravity)
        if scene.momentum.inertia is not None:
            placed = replace(placed, data=placed.data | resting(placed))
        points, new = points.joined(placed), new.joined(placed)
        standing.append(fill)
        waiting.remove(fill)
    return points, new


def _without_extra(
    scene: Scene, points: MaterialPoints, add: Sequence[int], fields: Mapping[str, ArrayLike]
) -> MaterialPoints:
    """Return the points without data that added bodies lack. Raise ValueError if `fields` lacks any of these data."""
    extra = points.data.keys() - scene.materials.seeded.data.keys()
    for name in sorted(extra - fields.keys()):
        what = f"stage: add: body {add[0]}: its points have no {name!r}"
        raise ValueError(f"{what}, must be given for all points in fields=")
    return _without_data(points, extra)


def _changed(scene: Scene, points: MaterialPoints, fields: Mapping[str, ArrayLike]) -> MaterialPoints:
    """Return the points with new values of the data named in `fields`."""
    instance("stage: fields", fields, Mapping)
    data = dict(points.data)
    comm = scene.grid.comm
    for name, value in fields.items():
        if name not in data and name in scene.materials.constants:
            law, value = type(scene.materials.constants[name]).__name__, getattr(scene.materials.constants[name], name)
            allowed = f"given to it as a function of position, lambda X: np.full(len(X), {value}), to be changed"
            raise ValueError(f"stage: fields: {name!r}: a constant of {law}, must be {allowed}")
        new, what = numbers(f"stage: fields: {name}", value, None, allowed="finite numbers"), f"stage: fields: {name!r}"
        if name in data and new.shape == data[name].shape[1:]:
            new = np.broadcast_to(new, data[name].shape)
        if new.shape != (data[name].shape if name in data else (len(points), *new.shape[1:])):
            each = "one value for all, or " if name in data else f"one of {', '.join(data)}, or new data: " * bool(data)
            raise ValueError(f"{what} of shape {new.shape}, must be {each}one value for each of {len(points)} points")
        if name not in data and (close := get_close_matches(name, data)):
            warn(comm, ConditionWarning, "%s: new data that no law reads; is %r meant?", what, close[0])
        data[name] = new.copy()

    def checked_fields() -> MaterialPoints:
        new = scene.materials.changed("stage: fields", replace(points, data=data), fields)
        for name in [name for name in OF_CONTENT if scene.fluid and name in fields and name in points.data]:
            for k in np.flatnonzero(data[name] != points.data[name])[:1]:
                what = f"stage: fields: {name!r} = {data[name][k]:g}: water would appear or vanish"
                raise ValueError(f"{what}, must remain {points.data[name][k]:g} in a scene with fluid")
        return new

    return together(comm, checked_fields)


def pieces_at_start(scene: Scene, points: MaterialPoints) -> PiecePressures:
    """Return the initial pressures of the pieces. Each cell has the value of the pressure field at its centroid."""
    on_grid = scene.on_grid(points)
    grid = scene.grid
    pressure = scene.initial.pressure
    cut = on_grid.cut
    contents = on_grid.contents
    bulk = scene.fluid.bulk
    pi = mass_potential(
        cut.pieces_to_cells(pressure_at(pressure, cut.pieces.x + grid.base)), bulk
    )  # potentials in a cell may be added
    store = on_grid.weight * on_grid.data.pieces["storage"][:, 0]
    held = contents.total(store)
    weight = np.where(held[contents.slot(cut.cells)] > 0, store, on_grid.weight)
    mean = contents.total(weight * pi) / contents.total(weight)
    target = pressure_at(pressure, grid.base + grid.midpoints[contents.filled] + contents.centroid[contents.filled])
    pi = pi + (mass_potential(target, bulk) - mean)[contents.slot(cut.cells)]
    p = pressure_of(pi, bulk)
    water = on_grid.pore_water(points)
    if water is not None:
        offset = p - target[water.slot]
        p = water.level(water.of_cells(target[water.slot] + on_grid.heads), target, offset)[water.slot] + offset
    p = cut.to_pieces(p)
    pieces, bounds = cut.pieces, np.stack([p, p], axis=1)
    return PiecePressures(points.id[pieces.point], pieces.cell, pieces.fraction, p, pieces.x, 0 * pieces.x, bounds)


def balanced(scene: Scene, state: State) -> State:
    """Return a state with stresses in equilibrium with its loads and pore pressures.

    If the points have the strain of a displacement w, the momentum balance gives an additional displacement u(w). The
    fixed-point iteration `w <- w + u(w)` with Anderson mixing (Walker and Ni 2011) finds w with the smallest u(w).
    Points store mean strains, so small nodal forces remain. The forces `State.held` balance them.  Gaps do not change
    with w, so the contact forces are those of the last solution u.

    Raises
    ------
    ValueError
        No equilibrium exists with the laws of the scene.
    """
    forms, materials = scene.momentum, scene.materials
    try:
        start = set_up(scene, state, 0.0)
        seeded = _as_reset(scene, start)
        if scene.storage is not None:  # points have pressures, as after a step
            pressure = scene.motion.pressures(start.on_grid, state.stage, state.t)
            seeded = replace(seeded, points=replace(seeded.points, pressure=pressure))
        unknowns = start.matrices.momentum.unknowns
        best = (np.inf, 0)
        count = 0
        scheme = scene.scheme
        momentum = start.matrices.momentum
        report = Report()
        solvers = LinearSolvers(planned(scheme, momentum, None, start.matrices.symmetric), scheme, momentum, None)
        seen = []
        w = np.zeros_like(forms.u.x.array)
        points = seeded.points
        pressed = unknowns.vector()
        while count - best[1] < DEPTH / 2:
            forms.u.x.array[:] = w
            problem = _problem(scene, start, replace(seeded, points=points))
            residual, scale = problem.assemble_residual()
            residual += pressed - _contact(problem)
            left = residual.norm() / max(scale, start.matrices.round_off)
            if left**2 < best[0] ** 2 / 2:
                unknowns.add(forms.u.x, 1.0, residual)
                held, forms.u.x.array[:] = forms.u.x.array.copy(), 0.0
                best = left, count, points, held, w, problem.outcome()
            if left <= scene.scheme.tolerance:
                break
            solve_substep(solvers, problem, None, None, partial(start.on_grid.as_reset, seeded), count, report, Kept())
            for one in problem.loads:
                seeded = replace(seeded, points=one.gripped(problem.at, seeded.points))
            pressed = _contact(problem)
            seen = [*seen[-DEPTH:], (w, forms.u.x.array.copy())]
            w, count = _mixed(unknowns.comm, unknowns.owned, seen), count + 1
            forms.u.x.array[:] = w
            points = strained(materials, seeded.points, scene.motion.strained(seeded.points, start.on_grid, start.data))
    except StepFailed as error:
        scene.forget()
        what = f"initial_stress: must be in equilibrium with the loads at the start: {error}"
        hint = "if the loads may exceed the limit load, omit initial_stress or apply them in later steps"
        raise ValueError(f"{what}; {hint}") from None
    left, count, points, held, rest, outcome = best
    _report(scene, seeded, points, count, left, any(one.touches for one in problem.loads))
    cells = np.concatenate([np.empty(0, np.int32), *(one.held_cells for one in problem.loads)])
    if over_all(scene.grid.comm, len(cells)):  # zero outside the cells at supported sides
        rest = np.where(np.repeat(forms.active_nodes(np.unique(cells)), scene.grid.dim), rest, 0.0)
    else:
        rest = None
    reactions = {name: values for name, values in outcome.items() if name == "reactions"}
    return replace(start.state, points=points, held=held, rest=rest, outcome={**state.outcome, **reactions})


def _contact(problem: MomentumProblem) -> Any:
    """Return minus the nodal forces of contact at u, in N."""
    out = problem.at.unknowns.vector()
    for one in (one for one in problem.loads if one.touches):
        one.push(problem.at, out, problem.at.unknowns)
    return out


def _report(scene: Scene, seeded: State, points: MaterialPoints, count: int, left: float, touches: bool) -> None:
    """Log the changes of the stresses. Raise ValueError for a large relative residual; with contact, warn instead."""
    materials, comm = scene.materials, scene.grid.comm
    if left > REMARKABLE and not touches:
        scene.forget()
        what = "initial_stress: must be in equilibrium with loads and supports at the start"
        raise ValueError(f"{what}: {100 * left:.2g} % of the forces remain out of balance")
    before, after = (np.nan_to_num(materials.effective_stress_3d(of)) for of in (seeded.points, points))
    largest, changed = (over_all(comm, float(np.abs(v).max(initial=0.0)), MPI.MAX) for v in (before, after - before))
    what = "initial_stress: balanced after %d iterations, changed by at most %.3g of %.3g Pa; %.2g of its forces remain"
    if changed > REMARKABLE * largest or left > REMARKABLE:
        bears = ", until contact bears them in the first step" if left > REMARKABLE else "; this is normal on slopes"
        warn(comm, ConditionWarning, what + bears, count, changed, largest, left)
    else:
        log(comm, what, count, changed, largest, left)


def _problem(scene: Scene, start: Start, state: State) -> MomentumProblem:
    """Return the momentum balance at zero displacement and zero velocity."""
    matrices, data = start.matrices, start.on_grid.data_of(state)
    at = start.on_grid.cut, start.on_grid.fill, state.points, data
    place = Place(*at, state.t, 0.0, state.t, state.outcome)
    loads = [one.moved(scene.momentum.u) for one in state.stage.placed(place)]
    when = When(state.t, FOREVER, start.acting[-1].gravity, FOREVER, 0.0)
    return scene.balance(when, matrices.momentum, data, loads, 0.0)


def _as_reset(scene: Scene, start: Start) -> State:
    """Return the state after a reset of the grid without motion."""
    cut, pieces = start.on_grid.cut, None
    if scene.storage is not None:
        p = cut.to_pieces(scene.storage.p_n.x.array[start.data.pieces.cells])
        of_cut = (cut.points.id[cut.pieces.point], cut.pieces.cell, cut.pieces.fraction)
        pieces = PiecePressures(*of_cut, None, cut.pieces.x, None, None, p, p)
    return replace(start.state, pieces=pieces, stay=Stay(cut.points))


def _mixed(
    comm: MPI.Intracomm, owned: NDArray[np.int32], seen: Sequence[tuple[NDArray, NDArray]]
) -> NDArray[np.float64]:
    """Return the next displacement of a fixed-point iteration with Anderson mixing.

    `owned`: indices of the unknowns that this process owns.
    """
    w, u = seen[-1]
    if len(seen) == 1:
        return w + u
    dw, du = (np.stack([b - a for a, b in pairwise(values)]) for values in zip(*seen, strict=True))
    rows = du[:, owned]
    sums = over_all(comm, np.column_stack([rows @ rows.T, rows @ u[owned]]))
    share = np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=ROUND_OFF)[0]
    return w + u - share @ (dw + du)
