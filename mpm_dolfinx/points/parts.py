# SPDX-License-Identifier: MIT
"""Connected parts of the bodies: material in cells that are connected by common nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from mpm_dolfinx.grid.grid import Grid, corner_bits, linked
from mpm_dolfinx.parallel.exchange import over_all


@dataclass(frozen=True, eq=False)
class Parts:
    """Connected parts of the bodies on the grid."""

    count: int  # number of parts
    cells: NDArray[np.int64]  # index, from 0, of the part of each local cell; -1 for inactive cells
    nodes: NDArray[np.int64]  # index, from 0, of the part of each local node; -1 for inactive nodes

    def largest(self, comm: MPI.Comm, part: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the largest of `values` (n, ...) in each connected part (count, ...), or -inf for empty parts."""
        return largest_of_parts(comm, part, values, self.count)


@dataclass(frozen=True, eq=False)
class OfParts:
    """Entries of a distributed vector.  `of` contains the index of the connected part of each local entry."""

    comm: MPI.Comm
    of: NDArray[np.int64]
    count: int

    @cached_property
    def _sorted(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Order of the entries by part, index of the first entry of each part in this order, and parts with entries."""
        sizes = np.bincount(self.of, minlength=self.count)
        present = sizes.nonzero()[0]
        return self.of.argsort(kind="stable"), (sizes.cumsum() - sizes)[present], present

    def sums(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (..., count) of the entries (..., n) of each part, over all processes."""
        order, start, present = self._sorted
        out = np.zeros((*values.shape[:-1], self.count))
        out[..., present] = np.add.reduceat(values.take(order, axis=-1), start, axis=-1)
        return out if self.comm.size == 1 else over_all(self.comm, out)

    def norms(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Euclidean norms (..., count) of the entries (..., n) of each part, over all processes."""
        return np.sqrt(self.sums(values * values))

    @cached_property
    def sizes(self) -> NDArray[np.float64]:
        """Number (count,) of entries of each part, over all processes."""
        return self.sums(np.ones(len(self.of)))


def largest_of_parts(comm: MPI.Comm, part: NDArray, values: NDArray, count: int) -> NDArray[np.float64]:
    """Return the largest value (count, ...) in each connected part, over all processes."""
    out = np.full((count, *values.shape[1:]), -np.inf)
    np.maximum.at(out, part, values)
    return over_all(comm, out, MPI.MAX)


def largest_of_bodies(
    comm: MPI.Comm, part: NDArray[np.int64], values: NDArray[np.float64], inside: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the largest values (k, bodies) in the connected parts of each body, or 0 for bodies without parts.

    `part` (m,): index, from 0, of the connected part of each column of `values` (k, m).
    `inside` (bodies, parts): whether a part contains points of a body on this process.
    """
    largest = largest_of_parts(comm, part, values.T, inside.shape[1]).T[:, None]
    inside = over_all(comm, inside.astype(int), MPI.MAX) > 0
    return np.where(inside.any(axis=1), np.where(inside, largest, -np.inf).max(axis=2, initial=-np.inf), 0.0)


def relative(
    norms: NDArray[np.float64], scales: NDArray[np.float64], round_off: NDArray[np.float64] | float = 0.0
) -> NDArray[np.float64]:
    """Return the norms divided by the scales.

    Norms of at most `round_off` give 0.  All larger norms with a scale of 0, and infinite norms, give inf.
    """
    ratio = np.empty(norms.shape)
    ratio.fill(np.inf)
    np.divide(norms, scales, out=ratio, where=(scales > 0) & (norms < np.inf))
    ratio[norms <= round_off] = 0.0
    return ratio


def parts_of_cells(grid: Grid, active: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """Return the connected part (cells,) of each active local cell, counted from 1, and the number of parts.

    Cells with common nodes belong to one part.  Inactive cells have index 0.
    """
    cells, out = active.nonzero()[0], np.zeros(len(active), dtype=np.int64)
    own, count = _touching(grid.cell_places(cells))
    if grid.comm.size > 1:
        nodes, at = np.unique(grid.cell_nodes[cells], return_inverse=True)
        of_node = np.zeros(len(nodes), dtype=np.int64)
        of_node[at.ravel()] = own.repeat(2**grid.dim)
        own, count = _over_processes(grid, own, count, nodes, of_node)
    first = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(first, own, grid.cell_number[cells].astype(np.int64))
    place = np.empty(count, dtype=np.int64)
    place[over_all(grid.comm, first, MPI.MIN).argsort()] = np.arange(count)
    out[cells] = place[own] + 1
    return out, count


def parts_of_domains(grid: Grid, corners: NDArray[np.float64], copy: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the connected part (n,) of each domain, counted from 0.

    `copy` (n,): first cell of the copy of the grid for each domain, see `Grid.copy`.
    """
    cell = grid.number(grid.index(corners.reshape(-1, grid.dim))).reshape(corners.shape[:2]) + copy.reshape(-1, 1)
    cell, at = np.unique(cell, return_inverse=True)
    own, count = _touching(
        np.stack([*np.unravel_index(cell % grid.cells, tuple(grid.shape)), cell // grid.cells], axis=1)
    )
    of = own[at.reshape(corners.shape[:2])]
    return _joined(np.repeat(np.arange(len(of)), of.shape[1]), of.ravel(), (len(of), count))[0]


def joined_parts(
    grid: Grid, part: NDArray[np.int64], count: int, pairs: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """Connect the parts of both cells in each pair.  Return the new results of `parts_of_cells`.

    `pairs` (m, 2): lexicographic indices of active cells.  Processes may have different pairs.

    All processes must call this function.
    """
    cells, at = np.unique(np.concatenate(grid.comm.allgather(np.unique(pairs, axis=0))), return_inverse=True)
    of = np.where(grid.owner(cells) == grid.comm.rank, part[grid.locals[cells]], 0)
    one, other = over_all(grid.comm, of, MPI.MAX)[at].reshape(-1, 2).T - 1
    new, total = linked(count, one, other)
    return np.append(0, new + 1)[part], total


def _touching(index: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return the connected part of each cell, and the number of parts.  `index`: grid indices, and copy of the grid."""
    if not len(index):
        return np.empty(0, dtype=np.int64), 0
    low = index.min(axis=0)
    at, box = tuple((index - low).T), np.zeros(index.max(axis=0) - low + 1, dtype=bool)
    box[at] = True
    around = np.zeros((3,) * index.shape[1], dtype=bool)
    around[..., 1] = True  # copies of the grid have no nodes in common
    number, count = label(box, around)
    return number[at].astype(np.int64) - 1, count


def _joined(rows: NDArray[np.int64], columns: NDArray[np.int64], shape: Sequence[int]) -> tuple[NDArray[np.int64], int]:
    """Return the connected component of each row, and their number.  Rows with a common column are connected."""
    part, count = linked(sum(shape), rows, shape[0] + columns)
    return part[: shape[0]], count


def _over_processes(
    grid: Grid, own: NDArray[np.int64], count: int, nodes: NDArray[np.integer], of_node: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """Return the connected part of each cell, joined over all processes, and the number of parts."""
    counts = grid.comm.allgather(count)
    start = sum(counts[: grid.comm.rank])
    index, copy = np.split(grid.node_places(nodes), [grid.dim], axis=1)
    shared = np.zeros(len(nodes), dtype=bool)
    for bits in corner_bits(grid.dim):
        cell = grid.number(np.minimum(np.maximum(index - bits, 0), grid.shape - 1)) + copy[:, 0] * grid.cells
        shared |= grid.owner(cell) != grid.comm.rank
    number = np.ravel_multi_index(tuple(index[shared].T), tuple(grid.shape + 1)) + copy[shared, 0] * grid.nodes
    pairs = np.concatenate(grid.comm.allgather(np.stack([start + of_node[shared], number], axis=1)))
    # one more column for each part, so that no row is empty
    columns, at = np.unique(pairs[:, 1], return_inverse=True)
    rows = np.concatenate([pairs[:, 0], np.arange(sum(counts))])
    at = np.concatenate([at.ravel(), len(columns) + np.arange(sum(counts))])
    part, total = _joined(rows, at, (sum(counts), len(columns) + sum(counts)))
    return part[start + own], total
