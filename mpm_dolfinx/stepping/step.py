# SPDX-License-Identifier: MIT
"""One step of a scene: the complete algorithm."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.conditions.acting import Place
from mpm_dolfinx.dynamics.energies import after, after_renewal
from mpm_dolfinx.forms.unknowns import collect_garbage
from mpm_dolfinx.solve.newton import Kept, note_pressures, solve_substep
from mpm_dolfinx.stepping.balances import Acting, Start, at_rest, balances, flight_of, has_yielded, joined, leads, left
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State


def set_up(scene: Scene, state: State, dt: float, how: tuple = ()) -> Start:
    """Return the start of a step of length dt (s): the state on the grid, the matrices, and the loads."""
    scene.check(state)
    scene.rests_at(state.stage, state.t)
    collect_garbage(scene.grid.mesh.comm)
    how = how or scene.substeps(state.stage)
    stage, times = state.stage, [state.t + substep.end * dt for substep in how]
    start, *gravity = [stage.gravity_at(t) for t in [state.t, *times]]
    if dt > 0:
        scene.look_at([start, *gravity])
    state, renewed = scene.for_reset(scene.followed(state), dt > 0)
    on_grid = scene.on_grid(cut_points := state.as_cut)
    on_grid.cut.surfaces(stage.surfaces)  # all faces are cut together
    data = on_grid.data_of(state)
    now = state.t, dt, state.t, state.outcome, stage.inertia, state.begins
    place = Place(on_grid.cut, on_grid.fill, state.points, data, *now)
    stage.check_start(place)
    loads = joined([stage.placed(place._replace(t=t)) for t in times])
    at_cut = place._replace(points=cut_points, pieces=on_grid.data, t=times[-1])
    as_cut = partial(stage.placed, at_cut) if state.stay else partial(loads.__getitem__, -1)
    matrices, loads = scene.assembled(on_grid, stage, loads[-1], as_cut, state.begins, dt), at_rest(scene, state, loads)
    scene.momentum.u.x.array[scene.momentum.active.now.dofs] = 0.0
    due = on_grid.start(state)
    acting = [Acting(*one) for one in zip(how, times, loads, gravity, strict=True)]
    return Start(state, on_grid, data, matrices, dt, has_yielded(scene, state), acting, renewed, due)


def step(scene: Scene, state: State, dt: float, how: tuple = ()) -> tuple[State, Report]:
    """Return the state after a step of length dt (s), and the report of the step."""
    start = set_up(scene, state, dt, how)
    report, kept = Report(renewed=start.renewed), Kept()
    rates, passed = [], []
    before, state = state, start.state
    on_grid, earlier = start.on_grid, None
    flights, found = [flight_of(start)], []
    for placed in start.acting:
        acting = start.begun(placed, earlier)
        key = start.matrices.key, acting.substep.own * dt
        both = balances(scene, start, acting, rates[-1] if rates else None, flights[-1])
        problem = both.momentum, both.storage, both.ahead, partial(on_grid.as_reset, state)
        rates.append(solve_substep(start.matrices.solvers, *problem, key, report, kept))
        passed.append(both.results(state, placed is start.acting[-1]))
        flights.append(both.flown(flights[-1], acting.substep, dt))
        if "energy" in state.outcome:
            found.append(both.momentum.powers())
        earlier = [one.flown(both.momentum.at) for one in acting.loads]
    bodies = partial(scene.motion.of_bodies, on_grid)
    note_pressures(report, start.matrices.solvers, both.storage, acting.substep.before * dt, dt, rates, bodies)
    report.moves = start.moves(flights[1:] if report.newton else [], acting.substep)
    start.matrices.end_step()
    seconds = dt * np.array([acting.substep.before, acting.substep.own])
    at, outcome = both.momentum.at, both.outcome(state, passed, seconds)
    end = state.t + dt, [one.ended(at) for one in acting.loads], both.net_inflow(rates[-1]), report
    new, report.reinitialised = scene.motion.advanced(state, on_grid, start.data, *end, start.carrying(flights[-1]))
    velocity = scene.momentum.u.x.array / dt if leads(scene, acting.loads) else None
    now = {"outcome": outcome, "points": left(end[1], at, state.points, new.points), "velocity": velocity}
    if found:
        energy = after_renewal(scene.materials, before.outcome["energy"], before.points, state.points, start.renewed)
        outcome["energy"] = after(energy, scene.materials, now["points"], state.stage.kinetic(outcome), seconds, found)
    return replace(new, **now, begins=False, resets=state.resets + (not state.stays)), report
