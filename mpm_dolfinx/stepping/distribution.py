# SPDX-License-Identifier: MIT
"""New distribution of the cells among processes (load balancing), at a reset of the grid.

The scene is created again on the new partition of the grid.  Points, pieces and nodal data are sent to the owners of
their cells and nodes.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.parallel.messages import log
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State


class Distributed(Protocol):
    """Simulation whose scene and state `distribute` may replace."""

    scene: Scene
    state: State


def distribute(simulation: Distributed) -> None:
    """Distribute the cells anew, if this makes the numbers of points on the processes more equal.

    Cells are distributed only before a step that resets the grid.
    """
    grid = simulation.scene.grid
    if grid.comm.size == 1 or (state := simulation.state).stays:
        return
    grid.move(state.lines)
    boxes = None if simulation.scene.extended else grid.better(state.as_cut.x)
    if boxes is not None and distribute_by(simulation, boxes):
        log(grid.comm, "t = %g s: cells distributed anew among %d processes", state.t, grid.comm.size)
    elif grid.follow is None:
        simulation.state = state.at_owners(grid)  # otherwise the step would hold a second state, with the old points


def distribute_by(simulation: Distributed, boxes: NDArray[np.int64]) -> bool:
    """Distribute the cells by boxes (ranks, 2, d), see `Partition`.  Return False if this is not possible."""
    new = simulation.scene.distributed(boxes)
    if new is not None:
        simulation.scene, simulation.state = new, new.adopted(simulation.state)
    return new is not None
