# SPDX-License-Identifier: MIT
"""Grid lines that move with a body or tool, at resets of the grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import takes
from mpm_dolfinx.domains.cut_domains import STILL
from mpm_dolfinx.grid.following import carried, lines_at
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.stepping.state import State


def with_lines(grid: Grid, state: State, left: Callable[[State], State]) -> State:
    """Move the grid lines for the next step.  Return the state.  If lines have moved, the step cuts all domains anew.

    `left`: function that adds pressures of pieces to a state, called before the lines move.
    """
    grid.move(state.lines)
    before = grid.lines
    lines = _wanted(grid, state, before)
    if state.stay is not None:
        moved = [
            np.abs(new - old)[1:-1] / np.minimum(np.diff(old)[1:], np.diff(old)[:-1])
            for new, old in zip(lines, before, strict=True)
        ]
        if max(far.max(initial=0.0) for far in moved) <= STILL:
            lines = before
        else:
            state = left(state) if state.stays else state
            pieces = state.pieces and replace(state.pieces, of_cell=None, start=None)
            state = replace(state, stay=None, held=None, rest=None, pieces=pieces)
    state = replace(state, lines=dict(zip("xyz", lines, strict=False)))
    grid.move(state.lines)
    return state


def _wanted(grid: Grid, state: State, before: Sequence[NDArray[np.float64]]) -> Sequence[NDArray[np.float64]]:
    """Return the new coordinates of the grid lines along each axis."""
    if hasattr(grid.follow, "pose"):
        moved = state.stage.moved(grid, state.t, state.outcome)
        return before if moved is None else carried(grid.seeded, moved)
    x = _of_all(grid, state) if "x" in takes(grid.follow) else None
    lines = grid.from_base(
        lines_at(grid.follow, [x + start for x, start in zip(grid.seeded, grid.base, strict=True)], state.t, x)
    )
    ends = [over_all(grid.comm, np.concatenate(lines), op) for op in (MPI.MIN, MPI.MAX)]
    if (ends[0] != ends[1]).any():
        raise ValueError(f"grid: follow at t = {state.t:g} s: lines differ between processes, must be equal on all")
    return lines


def _of_all(grid: Grid, state: State) -> NDArray[np.float64]:
    """Return the true positions of the points of all processes, ordered by id."""
    found = grid.comm.allgather((state.points.id, state.points.x))
    ids, x = (np.concatenate(values) for values in zip(*found, strict=True))
    return x[np.argsort(ids)] + grid.base
