# SPDX-License-Identifier: MIT
"""Check that all connected parts are constrained, because free rigid-body modes make the tangent singular."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.active import ActiveSet


def check_held(
    active: ActiveSet,
    free: NDArray[np.bool_],
    holds: Sequence[tuple[NDArray[np.int32], NDArray[np.int64] | None, NDArray[np.float64], NDArray[np.float64]]],
    each: bool,
) -> None:
    """Raise an error if a connected part of the bodies can move as a rigid body.

    `active`: cells of this process that contain pieces of domains.
    `free` (nodes, d): whether no wall fixes a displacement component.
    `holds`: constraints by prescribed displacements, tools and contact. Each is a tuple: constrained cells (n,),
    opposite cells (n,), positions (n, d) in m, and directions (n, d).  In a contact, opposite cells are lexicographic
    indices; in all other constraints they are None.  A fixed part fixes the parts in contact with it.
    `each`: whether to check each connected part alone, and not all parts together as one body.

    Raises
    ------
    ValueError
        A part can move as a rigid body.  The message gives the part's position and number of free rigid-body modes.
    """
    grid = active.grid
    part, count = active.parts_of_cells if each else (active.contains.astype(np.int64), 1)
    cells = active.cells
    centre, size = _extents(active, part[cells] - 1, count)
    nodes, first = np.unique(grid.cell_nodes[cells], return_index=True)
    row, axis = np.nonzero(~free[nodes])
    x, direction = grid.node_x[nodes[row]], np.eye(grid.dim)[axis]
    number = part[cells[first[row] // 2**grid.dim]]  # any cell at the node: all belong to one part
    against = np.zeros(len(number), dtype=np.int64)
    for cell, other, place, along in holds:
        both, sides = [part[cell]], 1
        if other is not None:
            exchange, sides = Exchange(grid.comm, grid.owner(other)), 2
            both.append(exchange.back(part[grid.locals[exchange.send(other)]]))
        number = np.concatenate([number, *both])
        against = np.concatenate([against, *(both[::-1] if sides == 2 else [np.zeros(len(cell), dtype=np.int64)])])
        x, direction = np.concatenate([x, *[place] * sides]), np.concatenate([direction, *[along] * sides])
    x = (x - centre[number - 1]) / size[number - 1, None]  # scaled, so that rotations of small distant parts count
    modes = list(direction.T)
    modes += [direction[:, a] * x[:, b] - direction[:, b] * x[:, a] for a in range(grid.dim) for b in range(a)]
    if grid.axisymmetric:  # rings have one rigid-body mode, along the axis
        modes = [direction[:, 1]]
    R = np.array(modes).T
    reached, missing = np.arange(count + 1) == 0, np.full(count, len(modes))  # index 0: the ground
    while True:
        on = reached[against]
        grams = [R[on & (number == k)].T @ R[on & (number == k)] for k in range(1, count + 1)]
        grams, before = grid.comm.allreduce(np.array(grams)), missing
        ranks = [np.linalg.matrix_rank(gram, tol=NEAR**2 * max(1.0, np.abs(gram).max())) for gram in grams]
        missing = len(modes) - np.array(ranks)
        reached[1:] = missing == 0
        if reached.all() or (missing == before).all():
            break
    for k in range(1, count + 1):
        if missing[k - 1]:
            places = [p for p in grid.comm.allgather(grid.midpoints[part == k][:1].tolist()) if p]
            where = (
                f"the part at [{' '.join(f'{x:.9g}' for x in places[0][0] + grid.base)}]" if count > 1 else "the body"
            )
            raise ValueError(
                f"walls: {where} is free to move as a rigid body in {missing[k - 1]} of {len(modes)} modes; "
                "it must be constrained by walls that it touches, by prescribed displacements, or by contact with "
                "a tool or a constrained group"
            )


def _extents(active: ActiveSet, part: NDArray[np.int64], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres and the longest edges of the bounding boxes of connected parts."""
    grid = active.grid
    low, high = np.full((2, count, grid.dim), np.inf)  # `high` has a negative sign
    for sign, ends in ((1, low), (-1, high)):
        for k in range(count):
            ends[k] = (sign * grid.midpoints[active.cells[part == k]]).min(axis=0, initial=np.inf)
        grid.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MIN)
    return (low - high) / 2, (-high - low + (grid.h if grid.even else grid.most)).max(axis=1)
