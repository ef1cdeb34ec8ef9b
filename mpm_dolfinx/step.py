# SPDX-License-Identifier: MIT
"""One step of a scene: the algorithm, and the only place that knows its order."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

from mpm_dolfinx.forms.unknowns import collect_garbage
from mpm_dolfinx.problems.momentum import MomentumProblem
from mpm_dolfinx.problems.on_grid import Assembled, OnGrid
from mpm_dolfinx.problems.side_forms import SideData
from mpm_dolfinx.problems.storage import StorageProblem
from mpm_dolfinx.result import Report
from mpm_dolfinx.scene import Scene
from mpm_dolfinx.solve.newton import solve_step
from mpm_dolfinx.state import State


class Balances(NamedTuple):
    """The two balances of a step, set up, with the state on the grid from which they start."""

    state: State
    on_grid: OnGrid
    sides: SideData
    matrices: Assembled
    momentum: MomentumProblem
    storage: StorageProblem | None


def set_up(scene: Scene, state: State, dt: float) -> Balances:
    """Return the balances of a step of dt (s)."""
    collect_garbage(scene.grid.mesh.comm)
    t, stage = state.t + dt, state.stage
    scene.set_time(t, dt, gravity := stage.gravity_at(t))
    state = state if state.stay else state.at_owners(scene.grid)
    cut_points = state.stay.points if state.stay else state.points  # points that hardly move stay as they were cut
    on_grid = scene.on_grid(cut_points)
    place = partial(stage.mechanical.data, scene.momentum.sides, on_grid.cut, t)
    sides, data = place(state.points), on_grid.data_of(state)
    matrices = scene.assembled(on_grid, stage, lambda: place(cut_points) if state.stay else sides, state.begins)
    momentum = MomentumProblem(scene.momentum, matrices.momentum, data, sides, matrices.round_off)
    if scene.storage is None:
        return Balances(state, on_grid, sides, matrices, momentum, None)
    on_grid.start(state)
    outflow = matrices.outflow(state.points, None if gravity is None else scene.fluid.density * gravity)
    storage = StorageProblem(scene.storage, matrices.storage, data.pieces, on_grid.contents, outflow, dt)
    return Balances(state, on_grid, sides, matrices, momentum, storage)


def step(scene: Scene, state: State, dt: float) -> tuple[State, Report]:
    """Return the state after a step of dt (s), and what it took; `state` stays what it is, whatever is raised."""
    state, on_grid, sides, matrices, momentum, storage = set_up(scene, state, dt)
    key, as_reset, stage = (on_grid.key, state.stage, dt), partial(on_grid.as_reset, state), state.stage
    report = solve_step(matrices.solvers(), momentum, storage, as_reset, key)
    reactions = stage.mechanical.reactions(sides, scene.momentum.u.x.array.reshape(-1, scene.grid.dim))
    new, report.rederived = scene.motion.advanced(state, on_grid, state.t + dt)
    return replace(new, reactions=reactions, resets=state.resets + (state.stay is None), begins=False), report
