# SPDX-License-Identifier: MIT
"""One step of a scene: the algorithm, and the only place that knows its order."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from mpm_dolfinx.base.report import Report
from mpm_dolfinx.forms.unknowns import collect_garbage
from mpm_dolfinx.solve.newton import Kept, note_pressures, solve_substep
from mpm_dolfinx.stepping.balances import Acting, Start, at_rest, balances, has_yielded
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State


def set_up(scene: Scene, state: State, dt: float, how: tuple = ()) -> Start:
    """Return the start of a step of dt (s): the state on the grid, its matrices, and what acts in its substeps."""
    scene.check(state)
    collect_garbage(scene.grid.mesh.comm)
    stage, times = state.stage, [state.t + substep.end * dt for substep in how or scene.substeps]
    start, *gravity = (stage.gravity_at(t) for t in [state.t, *times])
    if dt > 0:
        scene.look_at([start, *gravity])
    state = state if state.stays else state.at_owners(scene.grid)
    cut_points = state.as_cut
    on_grid = scene.on_grid(cut_points)
    on_grid.cut.surfaces(stage.surfaces)  # all at once
    place = partial(stage.mechanical.data, scene.momentum.sides, on_grid.cut, (state.t, dt), state.tool_travel)
    if state.begins:
        stage.mechanical.check_start(on_grid.cut, state.points, state.t, state.tool_travel)
    sides, data = [place(t, state.points) for t in times], on_grid.data_of(state)
    as_cut = partial(place, times[-1], cut_points) if state.stay else partial(sides.__getitem__, -1)
    matrices, sides = scene.assembled(on_grid, stage, sides[-1], as_cut, state.begins), at_rest(scene, state, sides)
    scene.momentum.u.x.array[:] = 0.0
    on_grid.start(state)
    acting = [Acting(*one) for one in zip(how or scene.substeps, times, sides, gravity, strict=True)]
    return Start(state, on_grid, data, matrices, dt, has_yielded(scene, state), acting)


def step(scene: Scene, state: State, dt: float, how: tuple = ()) -> tuple[State, Report]:
    """Return the state after a step of dt (s), and what it took; `state` stays what it is, whatever is raised."""
    start, report, kept, rates = set_up(scene, state, dt, how), Report(), Kept(), []
    state, on_grid, solvers = start.state, start.on_grid, start.matrices.solvers()
    for acting in start.acting:
        both, key = balances(scene, start, acting, *rates[-1:]), (start.matrices.key, acting.substep.own * dt)
        rates.append(solve_substep(solvers, *both, partial(on_grid.as_reset, state), key, report, kept))
    note_pressures(report, solvers, both.storage, acting.substep.before * dt, dt, rates)
    del solvers
    start.matrices.end_step()
    mechanical, at = state.stage.mechanical, (start.matrices.momentum.unknowns, scene.momentum.u.x.array)
    now = both.outcome(state, acting)
    tools, ways = mechanical.going(acting.sides, state.t, state.t + dt, state.tool_travel)
    end = state.t + dt, tools, both.came(rates[-1]), report
    new, report.rederived = scene.motion.advanced(state, on_grid, start.data, *end)
    velocity = None if scene.momentum.elastic else scene.momentum.u.x.array / dt
    mechanical.check_end(on_grid.cut, new.points, new.t, state.points, state.t, tools)
    forces, points = mechanical.touched(acting.sides, *at, new.points)
    now |= {"tool_forces": forces, "tool_travel": ways, "points": points, "velocity": velocity}
    return replace(new, **now, resets=state.resets + (not state.stays), begins=False), report
