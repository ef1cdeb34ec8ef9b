# SPDX-License-Identifier: MIT
"""Parts of the bodies that hang together: no force and no fluid goes from one to another."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.grid import Grid, sum_by


@dataclass(frozen=True, eq=False)
class Parts:
    """Parts of the bodies on the grid.

    count: how many there are; cells, nodes : (cells,), (nodes,) part of each active local cell and node, from 0, else
    -1.
    """

    count: int
    cells: NDArray[np.int64]
    nodes: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class OfParts:
    """Entries of a vector of this process, each of a part.

    Parameters
    ----------
    comm
        The processes.
    of : (n,)
        Part of each entry.
    count
        Number of parts.
    """

    comm: MPI.Comm
    of: NDArray[np.int64]
    count: int

    def sums(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (count,) of entries (n,) over each part, of all processes."""
        return over_all(self.comm, sum_by(self.of, values, self.count))

    def norms(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Euclidean norms (count,) of entries (n,) of each part."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.sqrt(self.sums(values**2))

    @cached_property
    def sizes(self) -> NDArray[np.float64]:
        """Numbers (count,) of entries of each part."""
        return self.sums(np.ones(len(self.of)))


def relative(
    norms: NDArray[np.float64], scales: NDArray[np.float64], round_off: NDArray[np.float64] | float = 0.0
) -> NDArray[np.float64]:
    """Return norms / scales; 0 where the norm is round-off, never nan, which no comparison would notice."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        ratio = np.where((scales > 0) & (norms < np.inf), norms / scales, np.inf)
    return np.where(norms <= round_off, 0.0, ratio)


def parts_of_cells(grid: Grid, active: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """Return the part (cells,), from 1, that each active cell belongs to, by common nodes, and how many there are."""
    index = np.column_stack([grid.cell_number[active] // grid.cells, grid.index(grid.midpoints[active])])
    everywhere = np.concatenate(grid.comm.allgather(index))
    lowest = everywhere.min(axis=0)
    filled = np.zeros(everywhere.max(axis=0) - lowest + 1, dtype=bool)
    filled[tuple((everywhere - lowest).T)] = True
    together = np.zeros((3,) * (grid.dim + 1))
    together[1] = 1  # copies of the grid have no node in common
    labels, count = label(filled, structure=together)
    out = np.zeros(len(active), dtype=np.int64)
    out[active] = labels[tuple((index - lowest).T)]
    return out, count
