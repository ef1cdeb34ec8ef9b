# SPDX-License-Identifier: MIT
"""Partition of the grid's cells among processes: recursive coordinate bisection, weighted by loads.

dolfinx's partitioners distribute the whole background grid.  Most of its cells are empty, so one process might hold the
whole body.  Here the box is bisected recursively, across the longest extent of the filled cells, into halves of equal
load.  The two halves are separated by a plane between cells (Berger and Bokhari 1987).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EMPTY = 1e-2
"""Weight of an empty cell divided by the mean weight of a filled cell, for memory and time that empty cells need."""


class Partition:
    """Boxes of cells, one for each process.

    load (cells along each axis): load of a cell, such as its number of points, >= 0; processes: number of ranks, >= 1.
    """

    def __init__(self, load: NDArray[np.float64], processes: int):
        self.shape = load.shape
        self.low, self.count = np.zeros((2, processes, load.ndim), dtype=np.int64)
        """First index (processes, d) of each process's box, and numbers of cells (processes, d) along its edges."""
        cuts: list[tuple[int, int, int, int]] = []  # axis, first cell beyond, first rank below and beyond
        filled = load > 0
        weight = load + (EMPTY * load[filled].mean() if filled.any() else 1.0)
        self._bisect(weight, filled, np.zeros(load.ndim, dtype=np.int64), (0, processes), cuts)
        self._cuts = cuts

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Partition) and bool((self.low == other.low).all() & (self.count == other.count).all())

    __hash__ = None

    def _bisect(
        self,
        weight: NDArray[np.float64],
        filled: NDArray[np.bool_],
        low: NDArray[np.int64],
        ranks: tuple[int, int],
        cuts: list[tuple[int, int, int, int]],
    ) -> None:
        """Distribute a box of cells from index `low` (d,) on among ranks, and add its cuts to `cuts`.

        If there are enough cells, each rank gets at least one; this has priority over equal loads.

        ranks: first rank and number of ranks.  Arrays are views of the arrays of the whole grid.
        """
        first, count = ranks
        if count == 1 or weight.size == 1:
            self.low[first], self.count[first] = low, weight.shape
            return
        axis = int(np.argmax([_extent(filled, a) if filled.any() else n for a, n in enumerate(weight.shape)]))
        layers = weight.sum(axis=tuple(a for a in range(weight.ndim) if a != axis))
        if len(layers) == 1:  # all filled cells lie in one layer
            axis = int(np.argmax(weight.shape))
            layers = weight.sum(axis=tuple(a for a in range(weight.ndim) if a != axis))
        cells = np.arange(1, len(layers)) * (weight.size // len(layers))  # below each plane
        # ranks below each plane: half, unless ranks stay idle
        below = np.clip(count // 2, count - (weight.size - cells), cells)
        even = (below == count // 2) | (below != count // 2).all()
        off = np.abs(np.cumsum(layers)[:-1] - layers.sum() * below / count)
        plane = int(np.argmin(np.where(even, off, np.inf)))
        half, plane = int(below[plane]), plane + 1
        parts = [np.moveaxis(array, axis, 0) for array in (weight, filled)]
        lower, upper = ([np.moveaxis(p[side], 0, axis) for p in parts] for side in (slice(plane), slice(plane, None)))
        beyond = low.copy()
        beyond[axis] += plane
        cuts.append((axis, int(beyond[axis]), first, first + half))
        self._bisect(*lower, low, (first, half), cuts)
        self._bisect(*upper, beyond, (first + half, count - half), cuts)

    def owner(self, index: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the owner ranks (...) of cells with indices (d, ...) along the axes."""
        out = np.zeros(index.shape[1:], dtype=np.int32)
        for axis, plane, first, middle in self._cuts:  # from the whole box to its parts
            out[(out == first) & (index[axis] >= plane)] = middle
        return out

    def cells(self, rank: int) -> NDArray[np.int64]:
        """Return the lexicographic indices (n,) of the cells of a process, ascending."""
        return self.numbered(np.full(self.count[rank].prod(), rank), np.arange(self.count[rank].prod()))

    def numbered(self, rank: NDArray[np.int64], k: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the lexicographic index (n,) of the k-th cell (n,), from 0, of each process `rank` (n,)."""
        out, stride = np.zeros_like(k), 1
        for axis in reversed(range(len(self.shape))):
            k, place = np.divmod(k, self.count[rank, axis])
            out += (self.low[rank, axis] + place) * stride
            stride *= self.shape[axis]
        return out


def _extent(filled: NDArray[np.bool_], axis: int) -> int:
    """Return the number of layers along an axis from the first to the last filled cell."""
    layers = np.flatnonzero(filled.any(axis=tuple(a for a in range(filled.ndim) if a != axis)))
    return int(layers[-1] - layers[0] + 1)


def destinations(partition: Partition, cells: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the ranks that hold each cell, the owner first, in one list; and the start of each cell in this list.

    Processes that own a neighbour across a face hold the cell as a ghost.  cells (n,): lexicographic indices.
    """
    index, shape = np.array(np.unravel_index(cells, partition.shape)), np.array(partition.shape)[:, None]
    ranks = [partition.owner(index)]
    for axis in range(len(shape)):
        for step in (-1, 1):
            neighbour = index.copy()
            neighbour[axis] += step
            ranks.append(partition.owner(np.clip(neighbour, 0, shape - 1)))
    ranks = np.stack(ranks, axis=1)
    new = np.ones(ranks.shape, dtype=bool)
    for k in range(1, ranks.shape[1]):
        new[:, k] = (ranks[:, k, None] != ranks[:, :k]).all(axis=1)
    return ranks[new], np.concatenate([[0], np.cumsum(new.sum(axis=1))]).astype(np.int32)
