# SPDX-License-Identifier: MIT
"""Active part of a grid: a step only touches cells with material, for any size of the box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import Grid


class ActiveSet(NamedTuple):
    """Local numbers, ascending, ghosts included: active cells, their nodes, and unrolled degrees of freedom."""

    cells: NDArray[np.int64]
    nodes: NDArray[np.int64]
    dofs: NDArray[np.int64]


class Active:
    """The cells with material since the last grid reset, and their nodes.

    Parameters
    ----------
    grid
        Background grid.
    wet
        Whether cells may contain fluid.
    cells, dofs
        Local arrays by cells, and by unrolled degrees of freedom, that are zero outside the active part.

    Attributes
    ----------
    slot : (cells,)
        Index of each cell among the owned active ones.
    centroid, opening : (cells, d), (cells, d, 2)
        Offsets of the centroids of the contents from the midpoints, m, and open fractions of faces.  Empty without
        fluid, like `slot`.
    """

    def __init__(self, grid: Grid, wet: bool, cells: Sequence[NDArray], dofs: Sequence[NDArray]):
        self._dim = d = grid.dim
        count = grid.num_local if wet else 0
        self.slot = np.zeros(count, dtype=np.int64)
        self.centroid, self.opening = np.zeros((count, d)), np.zeros((count, d, 2))
        self._now = ActiveSet(*(np.empty(0, dtype=np.int64) for _ in range(3)))
        self._of_cells = (*cells, *[self.centroid, self.opening] * wet)
        self._of_dofs = tuple(dofs)

    @property
    def cells(self) -> NDArray[np.int64]:
        """Active local cells."""
        return self._now.cells

    @property
    def nodes(self) -> NDArray[np.int64]:
        """Local nodes of active cells of any process."""
        return self._now.nodes

    @property
    def dofs(self) -> NDArray[np.int64]:
        """Unrolled degrees of freedom of these nodes."""
        return self._now.dofs

    def clear(self) -> None:
        """Reset the arrays to zero, before other cells become active."""
        for rows, arrays in ((self.cells, self._of_cells), (self.dofs, self._of_dofs)):
            for values in arrays:
                values[rows] = 0.0

    def set(self, cells: NDArray[np.int64], nodes: NDArray[np.int64]) -> None:
        """Set the active cells and nodes."""
        dofs = (nodes[:, None] * self._dim + np.arange(self._dim)).ravel()
        self._now = ActiveSet(cells, nodes, dofs)
