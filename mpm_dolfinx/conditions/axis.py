# SPDX-License-Identifier: MIT
"""The axis of revolution of axisymmetric scenes: radial displacements vanish; holes must be at least a cell wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn


def with_axis(grid: Grid, walls: Mapping[str, str]) -> Mapping[str, str]:
    """Return the fixed components of each wall; the wall on the axis also fixes the radial component."""
    left = walls.get("left", "") if isinstance(walls, Mapping) else None
    if not grid.has_axis or not isinstance(left, str) or "x" in left:
        return walls
    return {**walls, "left": "x" + left}


def check_axisymmetry(grid: Grid, bodies: Sequence[Body], quadrature: str) -> None:
    """Raise an error for invalid axisymmetric scenes.  Warn about narrow holes around the axis."""
    if grid.axisymmetric and quadrature == "point":
        raise ValueError("quadrature 'point': must be domain in axisymmetry")
    if not grid.has_axis:
        return
    x = np.concatenate([body.corners() for body in bodies])
    inner = x[:, :, 0].min(axis=1)
    h = grid.h[0] if grid.even else grid.widths[0][0]
    near = np.flatnonzero(inner < h * (1 - NEAR))
    row = grid.index(x[near].mean(axis=1))[:, 1]
    touches = np.zeros(grid.shape[1] + 2, dtype=bool)
    for k in range(3):  # an inclined surface leaves the axis in the next row of cells
        touches[row[inner[near] <= NEAR * h] + k] = True
    hole = near[~touches[row + 1]]
    if len(hole):  # nodes of the first cells lie on the axis, and are fixed
        k = hole[inner[hole].argmin()]
        what = "a hole of radius %.3g m about the axis, at %s, is narrower than a cell of %.3g m: its side moves like "
        what += "that of a solid core; use smaller cells, or a grid that begins at a radius > 0"
        warn(grid.comm, ResolutionWarning, what, inner[k], x[k].mean(axis=0), h)
