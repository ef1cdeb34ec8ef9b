# SPDX-License-Identifier: MIT
"""Forces of the walls on the bodies, from the forces on fixed components of nodes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import SIDES, Grid, sum_by


def wall_forces(
    grid: Grid, walls: Mapping[str, str], dofs: NDArray[np.int64], forces: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return the force (d,), N, of each wall by name; all processes must call this function.

    If several walls fix a component of a node, the wall normal to this component carries the force, or all of them
    carry it evenly if none is normal.  The axis of revolution has no area, so its radial force is zero.

    Parameters
    ----------
    walls
        Names of the walls, and the components that each fixes.
    dofs : (n,)
        Local degrees of freedom, unrolled; repetitions are allowed.  Free components are ignored.
    forces : (n,), N
        Forces on these degrees of freedom.
    """
    d, sides = grid.dim, SIDES[grid.dim]
    node, component = np.divmod(dofs, d)
    place, fixed = grid.nodes_along(grid.node_x[node]), [[a in walls.get(name, "") for a in "xyz"] for name in sides]
    across = np.array([component == axis for axis, _ in sides.values()])
    holds = np.array([place[:, axis] == end * grid.shape[axis] for axis, end in sides.values()])
    holds &= np.array(fixed)[:, component]
    holds = np.where((holds & across).any(axis=0), holds & across, holds)
    shares = holds / np.maximum(1, holds.sum(axis=0)) * forces
    out = grid.comm.allreduce(sum_by(component, shares, d))
    if grid.has_axis:
        out[0, 0] = 0.0
    return dict(zip(sides, out, strict=True))
