# SPDX-License-Identifier: MIT
"""The forces of the grid's walls on the bodies, from those on the components of nodes that they hold."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import SIDES, Grid, sum_by


def wall_forces(
    grid: Grid, walls: Mapping[str, str], dofs: NDArray[np.int64], forces: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return the forces (d,), N, of all walls by their names; on several processes all call it together.

    A component of a node that several walls hold is that of the wall across it, else they share it evenly.  The axis of
    revolution has no surface: nothing acts on it across.

    Parameters
    ----------
    walls
        Walls with the components that they hold.
    dofs : (n,)
        Unrolled local degrees of freedom, each once or more often; of those that no wall holds forces do not count.
    forces : (n,), N
        Forces on them.
    """
    d, sides = grid.dim, SIDES[grid.dim]
    node, component = np.divmod(dofs, d)
    place, letter = grid.nodes_along(grid.node_x[node]), np.array(list("xyz"))[component]
    across = np.array([component == axis for axis, _ in sides.values()])
    holds = np.array(
        [
            (place[:, axis] == end * grid.shape[axis]) & np.isin(letter, list(walls.get(name, "")))
            for name, (axis, end) in sides.items()
        ]
    )
    holds = np.where((holds & across).any(axis=0), holds & across, holds)
    shares = holds / np.maximum(1, holds.sum(axis=0)) * forces
    out = grid.comm.allreduce(np.stack([sum_by(component, share, d) for share in shares]))
    if grid.has_axis:
        out[0, 0] = 0.0
    return dict(zip(sides, out, strict=True))
