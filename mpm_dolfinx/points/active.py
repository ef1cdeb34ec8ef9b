# SPDX-License-Identifier: MIT
"""Active cells of a grid, which contain material.  A step computes active cells only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.points.parts import parts_of_cells


@dataclass(frozen=True, eq=False)
class ActiveSet:
    """The active cells of a grid, and quantities derived from them."""

    grid: Grid
    cells: NDArray[np.int64]  # local indices, ascending, with ghosts
    nodes: NDArray[np.int64]  # local indices of nodes of cells that are active on any process, ascending, with ghosts

    @cached_property
    def dofs(self) -> NDArray[np.int64]:
        """Unrolled indices of the displacement components at the nodes."""
        return (self.nodes[:, None] * self.grid.dim + np.arange(self.grid.dim)).ravel()

    @cached_property
    def contains(self) -> NDArray[np.bool_]:
        """Whether each local cell is active."""
        out = np.zeros(self.grid.num_local, dtype=bool)
        out[self.cells] = True
        return out

    @cached_property
    def facets(self) -> NDArray[np.int32]:
        """Faces of this process between two active cells."""
        return self.grid.interior_facets(self.contains, self.cells)

    @cached_property
    def parts_of_cells(self) -> tuple[NDArray[np.int64], int]:
        """Connected part (cells,) of each local cell, counted from 1 (0 for empty cells), and the number of parts."""
        return parts_of_cells(self.grid, self.contains)


class Active:
    """The cells with material since the last reset of the grid, and their nodes.

    Parameters
    ----------
    grid
        Background grid.
    wet
        Whether cells may contain fluid.
    cells, dofs
        Arrays with a row for each local cell, and for each unrolled local dof.  `clear` sets these arrays to 0.

    Attributes
    ----------
    now
        The active set.
    slot : (cells,)
        Index of each local cell among the owned active cells.
    centroid : (cells, d), m
        Vector from the midpoint of the cell to the centroid of its material.  The array is empty without fluid.
    opening : (cells, d, 2)
        Fraction of each cell face that material covers.  The array is empty without fluid.
    """

    def __init__(self, grid: Grid, wet: bool, cells: Sequence[NDArray], dofs: Sequence[NDArray]):
        self._grid, d = grid, grid.dim
        count = grid.num_local if wet else 0
        self.slot = np.zeros(count, dtype=np.int64)
        self.centroid, self.opening = np.zeros((count, d)), np.zeros((count, d, 2))
        self._last: Latest[ActiveSet] = Latest()
        self.set(np.empty(0, dtype=np.int64), lambda: np.empty(0, dtype=np.int64))
        self._of_cells = (*cells, *[self.centroid, self.opening] * wet)
        self._of_dofs = tuple(dofs)

    def clear(self) -> None:
        """Reset the arrays `cells` and `dofs` to zero.  Call this before other cells become active."""
        for rows, arrays in ((self.now.cells, self._of_cells), (self.now.dofs, self._of_dofs)):
            for values in arrays:
                values[rows] = 0.0

    def set(self, cells: NDArray[np.int64], nodes: Callable[[], NDArray[np.int64]]) -> None:
        """Set the active cells.  `nodes` returns the nodes of these cells.  All processes must call this method."""
        self.now = self._last(cells, lambda: ActiveSet(self._grid, cells, nodes()), self._grid.comm)
