# SPDX-License-Identifier: MIT
"""One step of a scene: the algorithm, and the only place that knows its order."""

from __future__ import annotations

from dataclasses import replace

from dolfinx.common import Timer

from mpm_dolfinx.forms.unknowns import collect_garbage
from mpm_dolfinx.points.pressure_transport import transport
from mpm_dolfinx.problems.momentum import MomentumProblem
from mpm_dolfinx.problems.storage import StorageProblem
from mpm_dolfinx.result import Report
from mpm_dolfinx.scene import Scene
from mpm_dolfinx.solve.newton import solve_step
from mpm_dolfinx.state import State


def step(scene: Scene, state: State, dt: float) -> tuple[State, Report]:
    """Return the state after a step of dt (s), and what the step took; `state` stays what it is, whatever is raised."""
    collect_garbage(scene.grid.comm)
    t, stage = state.t + dt, state.stage
    gravity = stage.gravity_at(t)
    scene.set_time(t, dt, gravity)

    # the points on the grid: cut anew, or where they were cut while they hardly move
    state = state if state.stay else state.at_owners(scene.grid)
    points = state.points
    on_grid = scene.on_grid(state.stay.points if state.stay else points)
    cut, forms = on_grid.cut, scene.momentum.sides
    with Timer("mpm: loads"):
        sides = stage.mechanical.data(forms, cut, points, t)
    with Timer("mpm: integration data"):
        data = on_grid.data_of(points if state.stay else cut.points)
    at_cut = (lambda: stage.mechanical.data(forms, cut, cut.points, t)) if state.stay else (lambda: sides)
    fixed = scene.assembled(on_grid, stage, at_cut, state.begins)

    # the two balances
    with Timer("mpm: loads"):
        momentum = MomentumProblem(scene.momentum, fixed.momentum, data, sides, fixed.round_off)
    storage = None
    if scene.storage is not None:
        with Timer("mpm: remap"):
            if state.stay:
                on_grid.set_pressures(state.stay.pressure)
            else:
                on_grid.average_pressures(transport(state.transported, points, cut.pieces))
        outflow = fixed.outflow(points, None if gravity is None else scene.fluid.density * gravity)
        storage = StorageProblem(scene.storage, fixed.storage, data.pieces, on_grid.contents, outflow, dt)
    report = solve_step(fixed.solvers(), momentum, storage, on_grid.data, (on_grid, stage, dt))

    # points, deformation and pressures at the end
    reactions = stage.mechanical.reactions(sides, scene.momentum.u.x.array.reshape(-1, scene.grid.dim))
    new, report.rederived = scene.motion.advanced(state, on_grid, t, stays=not scene.pieces.varies)
    resets = state.resets + (state.stay is None)
    return replace(new, reactions=reactions, resets=resets, begins=False), report
