# SPDX-License-Identifier: MIT
"""Whether pressures on the bodies have a potential: their surface is closed, or held where it ends.

The tangent of a pressure p on a surface is symmetric but for its boundary, whose edges dx contribute p/2 (v x du) . dx.
That vanishes where two surfaces of one pressure meet, and on a wall that holds the normal component: there v, du and
the edge lie in the wall.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.given_values import by_place
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.conditions import Pressure
from mpm_dolfinx.grid.grid import SIDES, Grid
from mpm_dolfinx.parallel.exchange import over_all


def closed(grid: Grid, free: NDArray[np.bool_], pressures: Sequence[tuple[Pressure, Surface]]) -> bool:
    """Return whether the surfaces of equal pressures are closed, or end on walls that hold them.

    Faces whose corners lie on the edges of others are taken to be open.

    Parameters
    ----------
    free : (nodes, d)
        Components that no wall holds.
    pressures
        With the faces on which they act.
    """
    if not pressures:
        return True
    if any(by_place(pressure.value) for pressure, _ in pressures):
        return False
    groups: dict[float, list[Surface]] = {}
    for pressure, faces in pressures:
        groups.setdefault(id(pressure.value) if callable(pressure.value) else float(pressure.value), []).append(faces)
    return all(_closed(grid, _held_walls(grid, free), faces) for faces in groups.values())


def _held_walls(grid: Grid, free: NDArray[np.bool_]) -> list[tuple[int, float]]:
    """Return axis and place, m, of the walls that hold their normal component."""
    out = []
    for wall, (axis, end) in SIDES[grid.dim].items():
        if not over_all(grid.comm, int(free[grid.wall_nodes(wall), axis].sum())):
            out.append((axis, (grid.lower, grid.upper)[end][axis]))
    return out


def _closed(grid: Grid, walls: Sequence[tuple[int, float]], surfaces: Sequence[Surface]) -> bool:
    """Return whether every edge of some faces belongs to two of them, or lies in a wall that holds it."""
    x = np.concatenate([faces.places() for faces in surfaces])
    count, edges = x.shape[1], _EDGES[grid.dim]
    number = np.rint((x.reshape(-1, grid.dim) - grid.lower) / (NEAR * grid.h) + 1 / 3)  # on no half between two numbers
    _, corner = np.unique(number, axis=0, return_inverse=True)
    edge = np.sort(corner.reshape(-1, count)[:, edges].reshape(-1, edges.shape[1]), axis=1)
    x = x[:, edges].reshape(-1, edges.shape[1], grid.dim)
    if grid.dim == 3:  # of a triangle two corners are the same
        real = edge[:, 0] != edge[:, 1]
        edge, x = edge[real], x[real]
    _, kind, often = np.unique(edge, axis=0, return_inverse=True, return_counts=True)
    lone = x[often[kind.ravel()] == 1]
    held = np.zeros(len(lone), dtype=bool)
    for axis, place in walls:
        held |= (np.abs(lone[:, :, axis] - place) < NEAR * grid.h[axis]).all(axis=1)
    return bool(held.all() and often.max(initial=0) <= 2)


_EDGES = {2: np.array([[0], [1]]), 3: np.array([[0, 1], [1, 3], [3, 2], [2, 0]])}
"""Corners of the edges of a face; in 2D its ends."""
