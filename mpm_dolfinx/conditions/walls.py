# SPDX-License-Identifier: MIT
"""Walls of the grid: fixed displacement components, and forces on bodies.

The argument `walls` of functions maps the name of each wall to its fixed components.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.grid.grid import SIDES, Grid


def with_axis(grid: Grid, walls: Mapping[str, str]) -> Mapping[str, str]:
    """Return the fixed components of each wall.  The wall on the axis also fixes the radial component."""
    left = walls.get("left", "") if isinstance(walls, Mapping) else None
    if not grid.has_axis or not isinstance(left, str) or "x" in left:
        return walls
    return {**walls, "left": "x" + left}


def fixed_nodes(grid: Grid, walls: Mapping[str, str]) -> NDArray[np.bool_]:
    """Return which displacement components (nodes, d) walls fix.  Raise ValueError for invalid walls."""
    d = grid.dim
    out = np.zeros((len(grid.node_x), d), dtype=bool)
    if not isinstance(walls, Mapping):
        raise ValueError(f"walls = {line(walls)}, must be a mapping of walls to components, such as {{'left': 'xy'}}")
    for wall, axes in walls.items():
        if not isinstance(axes, str) or not axes or any(a not in "xyz"[:d] for a in axes):
            raise ValueError(f"walls: {wall!r} fixes {axes!r}, must fix components among {'xyz'[:d]!r}")
        for a in axes:
            out[grid.wall_nodes(wall), "xyz".index(a)] = True
    return out


def fixed_corners(grid: Grid, walls: Mapping[str, str], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which displacement components (n, 2^d, d) walls fix at corners of domains."""
    out = np.zeros(corners.shape, dtype=bool)
    for name, axes in walls.items():
        axis, end = SIDES[grid.dim][name]
        at_wall = np.abs(corners[:, :, axis] - (grid.low, grid.high)[end][axis]) < NEAR * grid.finest[axis]
        for letter in axes:
            out[:, :, "xyz".index(letter)] |= at_wall
    return out


def stopped(
    grid: Grid, walls: Mapping[str, str], corners: NDArray[np.float64], before: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the corners (n, 2^d, d), in m, of particle domains, after corners outside the grid have moved onto walls.

    Corners also move onto sides of the grid without a wall, if their old positions `before` were inside the grid.
    """
    shut = np.zeros((2, grid.dim), dtype=bool)
    for name, axes in walls.items():
        axis, end = SIDES[grid.dim][name]
        shut[end, axis] = "xyz"[axis] in axes
    corners = np.where(shut[0] | (before >= grid.low), np.maximum(corners, grid.low), corners)
    return np.where(shut[1] | (before <= grid.high), np.minimum(corners, grid.high), corners)


def wall_shares(grid: Grid, walls: Mapping[str, str], dofs: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the share (2 d, n) of each wall in the forces on degrees of freedom.

    If several walls fix a component of a node, the wall normal to this component gets the force.  If none of them is
    normal to the component, all get equal shares.

    `dofs` (n,): flat local degrees of freedom, possibly repeated.
    """
    sides, (node, component) = SIDES[grid.dim], np.divmod(dofs, grid.dim)
    place, fixed = grid.nodes_along(grid.node_x[node]), [a in walls.get(name, "") for name in sides for a in "xyz"]
    across = np.array([component == axis for axis, _ in sides.values()])
    holds = np.array([place[:, axis] == end * grid.shape[axis] for axis, end in sides.values()])
    holds &= np.array(fixed).reshape(-1, 3)[:, component]
    holds = np.where((holds & across).any(axis=0), holds & across, holds)
    return holds / np.maximum(1, holds.sum(axis=0))
