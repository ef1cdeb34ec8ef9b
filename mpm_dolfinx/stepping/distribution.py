# SPDX-License-Identifier: MIT
"""New distribution of the cells among processes at a reset of the grid, once the bodies have moved, grown or shrunk.

The scene is compiled again on a grid with other owners; its forms are those that are already compiled.  The state goes
over as a checkpoint does: points and pieces travel to the new owners of their cells, nodal data to the new owners of
nodes, and the conditions of the stage find their faces again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.grid.partition import boxes, unevenness
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.parallel.messages import log
from mpm_dolfinx.stepping.initial_state import stage_of
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State

UNEVEN = 1.2
"""Largest number of points of a process, divided by the mean, above which cells are distributed anew.  The answers do
not depend on this number.  Source: definition, the documented limit of the imbalance.
"""
NODAL = ("velocity", "held", "rest")
"""Nodal fields of a `State`."""


class Distributed(Protocol):
    """A simulation, or a copy of it; scene and state are replaced together."""

    scene: Scene
    state: State


def distribute(simulation: Distributed) -> None:
    """Distribute the cells anew before a step that resets the grid, if this makes uneven numbers of points more even."""
    scene, state = simulation.scene, simulation.state
    comm = scene.grid.comm
    if comm.size == 1 or state.stays or scene.extended:
        return
    before, after, new = _better(scene.grid, state)
    if new is not None and spread(simulation, new):
        log(comm, "t = %g s: cells distributed anew: imbalance %.3g, before %.3g", state.t, after, before)


def spread(simulation: Distributed, boxes: NDArray[np.int64]) -> bool:
    """Distribute the cells by boxes (ranks, 2, d), see `Cells`; return whether the scene allows it.

    Scenes with user-defined terms or sources keep their distribution, because terms may be defined on the mesh.
    """
    scene = simulation.scene
    new = None if scene.extended else scene.spread(boxes)
    if new is not None:
        simulation.scene, simulation.state = new, on(new, simulation.state)
    return new is not None


def _better(grid: Grid, state: State) -> tuple[float, float, NDArray[np.int64] | None]:
    """Return the imbalance of points now and after a new bisection, and its boxes (ranks, 2, d); None to keep all.

    A bisection that leaves more than `UNEVEN` must be better by this factor.  Otherwise every reset might distribute
    few cells anew.
    """
    if state.lines is not None:
        grid.move([state.lines[letter] for letter in sorted(state.lines)])
    size = grid.comm.size
    number = grid.number(grid.index_from_base(state.as_cut.x))
    before = unevenness(over_all(grid.comm, np.bincount(grid.owner(number), minlength=size)))
    if before <= UNEVEN:
        return before, before, None
    load = over_all(grid.comm, np.bincount(number, minlength=grid.cells).astype(float)).reshape(grid.shape)
    new = boxes(load, size)
    after = unevenness(np.array([load[tuple(map(slice, *box))].sum() for box in new]))
    return before, after, new if after < max(UNEVEN, before / UNEVEN) else None


def on(scene: Scene, state: State) -> State:
    """Return the state of an equal scene with another distribution, as a state of this scene."""
    before = state.stage
    given = {**before.conditions, "conditions": tuple(before.given.values())}
    grid = before.materials.grid
    nodal = {name: _sent(grid, scene.grid, getattr(state, name)) for name in NODAL}
    stage = stage_of(scene, given, before.present, before.later)
    return replace(state, stage=stage, **nodal).at_owners(scene.grid)


def _sent(old: Grid, new: Grid, nodal: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return nodal values (unknowns,) on this process's nodes of another distribution.  Node i passes by rank i % P."""
    if nodal is None:
        return None
    rows = nodal.reshape(-1, old.dim)
    some = rows.any(axis=1)
    known, wanted = old.node_numbers()[some], new.node_numbers()
    there, back = (Exchange(old.comm, (node % old.comm.size).astype(np.int32)) for node in (known, wanted))
    node, first = np.unique(there.send(known), return_index=True)
    return back.back(at_nodes(node, there.send(rows[some])[first], back.send(wanted))).ravel()


def at_nodes(
    node: NDArray[np.int64], values: NDArray[np.float64], wanted: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the values (n, d) of the nodes `wanted` (n,), from values (m, d) of ascending nodes (m,); 0 elsewhere."""
    at = np.searchsorted(node, wanted)
    found = np.append(node, -1)[at] == wanted
    return np.concatenate([values, np.zeros((1, values.shape[1]))])[np.where(found, at, len(node))]
