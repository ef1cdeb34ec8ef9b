# SPDX-License-Identifier: MIT
"""From one stage to the next: bodies come and go, conditions change, fields of the points are set anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.pressure_transport import at_start
from mpm_dolfinx.problems.stage import Stage, stage
from mpm_dolfinx.scene import Scene
from mpm_dolfinx.state import State
from mpm_dolfinx.validation import chosen, flag, numbers


def first_state(scene: Scene, conditions: Mapping[str, Any], later: Sequence[int]) -> State:
    """Return the state of a scene at rest, in its first stage."""
    begun = _stage(scene, conditions, [body not in later for body in range(len(scene.bodies))], later)
    points = scene.materials.seeded.of(_ids(scene.bodies, later), kept=False)
    transported = at_start(points) if scene.fluid else None
    reactions = np.zeros((len(begun.mechanical.holds), scene.grid.dim))
    return State(0.0, points, transported, None, 0, reactions, begun, True, None)


def begin_stage(
    scene: Scene,
    state: State,
    named: Mapping[str, Any],
    add: Sequence[int],
    remove: Sequence[int],
    reset_displacement: bool,
    fields: Mapping[str, ArrayLike],
) -> State:
    """Return the state in which a stage begins: see `Simulation.stage`; named: the conditions that are new."""
    before = state.stage
    if "gravity" in named and scene.gravity is None:
        raise ValueError("gravity: the scene was made without, must be made with (0, 0) first")
    chosen("stage: remove", remove, np.flatnonzero(before.present).tolist(), "bodies that are present")
    chosen("stage: add", add, list(before.later), "bodies that are to come later")
    flag("stage: reset_displacement", reset_displacement)
    present = [(here and body not in remove) or body in add for body, here in enumerate(before.present)]
    later = [body for body in before.later if body not in add]
    begun = _stage(scene, {**before.conditions, **named}, present, later)
    if state.stay:  # pressures are those of the cells
        state = scene.motion.left_grid(state, scene.on_grid(state.stay.points))
    gone, new = _ids(scene.bodies, remove), scene.materials.seeded.of(_ids(scene.bodies, add))
    points, transported = state.points.of(gone, kept=False).joined(new), state.transported
    if transported is not None:
        transported = transported.of(gone, kept=False).joined(at_start(new))
    points = _changed(points, fields)
    if reset_displacement:
        points = replace(points, origin=points.corners)
    reactions = state.reactions
    if "displacements" in named:
        unknown = np.nan if state.resets else 0.0
        reactions = np.full((len(begun.mechanical.holds), scene.grid.dim), unknown)
    return replace(state, points=points, transported=transported, stage=begun, reactions=reactions, begins=True)


def _stage(scene: Scene, conditions: Mapping[str, Any], present: Sequence[bool], later: Sequence[int]) -> Stage:
    wet = scene.fluid is not None
    return stage(scene.grid, scene.bodies, scene.materials, wet, conditions, present, later)


def _ids(bodies: Sequence[Body], chosen: Sequence[int]) -> NDArray[np.int64]:
    """Return the numbers of the points of some bodies."""
    stop = np.cumsum([len(body) for body in bodies])
    return np.concatenate([np.empty(0, np.int64), *(np.arange(stop[i] - len(bodies[i]), stop[i]) for i in chosen)])


def _changed(points: MaterialPoints, fields: Mapping[str, ArrayLike]) -> MaterialPoints:
    """Return points with new values of some of their data."""
    data = dict(points.data)
    for name, value in fields.items():
        new, what = numbers(f"stage: fields: {name}", value, None, allowed="finite numbers"), f"stage: fields: {name!r}"
        if name in data and new.shape == data[name].shape[1:]:
            new = np.broadcast_to(new, data[name].shape)
        if new.shape != (data[name].shape if name in data else (len(points), *new.shape[1:])):
            each = "one value for all, or " if name in data else ""
            raise ValueError(f"{what} of shape {new.shape}, must be {each}one for each of {len(points)} points")
        data[name] = new.copy()
    return replace(points, data=data)
