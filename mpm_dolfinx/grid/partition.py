# SPDX-License-Identifier: MIT
"""Partition of the grid's cells among processes: recursive coordinate bisection, weighted by the work of each cell.

dolfinx's partitioners distribute the whole background grid.  Most cells are empty, so one process might hold the whole
body.  Here the box of the grid is bisected recursively into halves of equal work (Berger and Bokhari 1987).  Each plane
of bisection lies between cells, normal to the longest extent of the filled cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IMBALANCE = 1.2
"""Largest allowed imbalance: largest number of points of a process, divided by the mean number.

If the imbalance is larger, cells are distributed again.  Results do not depend on this limit.  Source: definition, the
documented limit of the imbalance.
"""
EMPTY = 1e-2
"""Weight of an empty cell, which needs some memory and time, divided by the mean weight of a filled cell."""


class Partition:
    """Boxes of cells, one for each process.

    `boxes` (ranks, 2, d): first index of the cells in each box along each axis, and last index plus one.
    `shape` (d,): number of cells of the grid along each axis.

    Raises
    ------
    ValueError
        The boxes do not fill the grid exactly once.
    """

    def __init__(self, boxes: NDArray[np.int64], shape: tuple[int, ...]):
        self.boxes, self.shape = boxes, shape
        self.low, high = boxes[:, 0], boxes[:, 1]
        self.count = high - self.low
        """Number of cells (ranks, d) along the edges of each box."""
        within = (boxes >= 0).all() and (high <= shape).all() and (self.count >= 0).all()
        if not within or self.count.prod(axis=1).sum() != np.prod(shape) or self._overlap():
            raise ValueError("partition: boxes of cells do not fill the grid exactly once")

    def _overlap(self) -> bool:
        """Return whether any two boxes share a cell."""
        low, high = self.boxes[self.count.all(axis=1)].transpose(1, 0, 2)
        return any(((low[k] < high[:k]) & (low[:k] < high[k])).all(axis=1).any() for k in range(1, len(low)))

    def owner(self, index: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the owner ranks (...) of cells with indices (d, ...) along the axes."""
        cells = index.reshape(len(index), -1)
        out = np.zeros(cells.shape[1], dtype=np.int32)
        if cells.size:
            near = (self.low <= cells.max(axis=1)) & (cells.min(axis=1) < self.boxes[:, 1])
            for rank in np.flatnonzero(near.all(axis=1)):
                low, high = self.boxes[rank, :, :, None]
                out[((low <= cells) & (cells < high)).all(axis=0)] = rank
        return out.reshape(index.shape[1:])

    def cells(self, rank: int) -> NDArray[np.int64]:
        """Return the lexicographic indices (n,) of the cells of a process, in ascending order."""
        return self.numbered(np.full(self.count[rank].prod(), rank), np.arange(self.count[rank].prod()))

    def numbered(self, rank: NDArray[np.int64], k: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the lexicographic index (n,) of cell number `k` (n,), counted from 0, of process `rank` (n,)."""
        out, stride = np.zeros_like(k), 1
        for axis in reversed(range(len(self.shape))):
            k, place = np.divmod(k, self.count[rank, axis])
            out += (self.low[rank, axis] + place) * stride
            stride *= self.shape[axis]
        return out


def boxes(load: NDArray[np.float64], processes: int) -> NDArray[np.int64]:
    """Return the boxes of cells (ranks, 2, d) of all ranks, see `Partition`.

    `load` (cells along each axis): work >= 0 to compute each cell, such as its number of points.
    `processes`: number of ranks, >= 1.
    """
    filled = load > 0
    weight = load + (EMPTY * load[filled].mean() if filled.any() else 1.0)
    out = np.zeros((processes, 2, load.ndim), dtype=np.int64)
    _bisect(weight, filled, np.zeros(load.ndim, dtype=np.int64), out)
    return out


def better(load: NDArray[np.float64], of: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return the boxes (ranks, 2, d) of a new bisection, or None if the boxes `of` are almost as good.

    The imbalance of new boxes must be below `IMBALANCE`, or below the imbalance of the boxes `of` divided by
    `IMBALANCE`.
    """
    new = boxes(load, len(of))
    return new if imbalance(load, new) < max(IMBALANCE, imbalance(load, of) / IMBALANCE) else None


def imbalance(load: NDArray[np.float64], of: NDArray[np.int64]) -> float:
    """Return the largest sum of `load` in a box, divided by the mean sum.  The result is 1 if all sums are 0."""
    each = np.array([load[tuple(map(slice, *box))].sum() for box in of])
    return float(each.max() / each.mean()) if each.any() else 1.0


def _bisect(weight: NDArray[np.float64], filled: NDArray[np.bool_], low: NDArray[np.int64], out: NDArray[np.int64]):
    """Divide a box of cells into a box for each rank, written to `out`.

    If there are enough cells, each rank gets at least one cell, even if this makes the work less equal.
    """
    count = len(out)
    if count == 1 or weight.size == 1:
        out[0] = low, low + weight.shape
        return
    axis = int(np.argmax([_extent(filled, a) if filled.any() else n for a, n in enumerate(weight.shape)]))
    layers = weight.sum(axis=tuple(a for a in range(weight.ndim) if a != axis))
    if len(layers) == 1:  # all filled cells lie in one layer
        axis = int(np.argmax(weight.shape))
        layers = weight.sum(axis=tuple(a for a in range(weight.ndim) if a != axis))
    cells = np.arange(1, len(layers)) * (weight.size // len(layers))  # numbers of cells below each plane
    ranks = np.clip(count // 2, count - (weight.size - cells), cells)  # below each plane: half, unless some get no cell
    even = (ranks == count // 2) | (ranks != count // 2).all()
    off = np.abs(np.cumsum(layers)[:-1] - layers.sum() * ranks / count)
    plane = int(np.argmin(np.where(even, off, np.inf)))
    half, plane = int(ranks[plane]), plane + 1
    parts = [np.moveaxis(array, axis, 0) for array in (weight, filled)]
    lower, upper = ([np.moveaxis(p[side], 0, axis) for p in parts] for side in (slice(plane), slice(plane, None)))
    _bisect(*lower, low, out[:half])
    _bisect(*upper, low + plane * np.eye(len(low), dtype=np.int64)[axis], out[half:])


def _extent(filled: NDArray[np.bool_], axis: int) -> int:
    """Return the number of layers along an axis from the first to the last filled cell."""
    layers = np.flatnonzero(filled.any(axis=tuple(a for a in range(filled.ndim) if a != axis)))
    return int(layers[-1] - layers[0] + 1)


def destinations(partition: Partition, cells: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return one list of all ranks that have each cell (owner first), and the index where the ranks of each cell begin.

    `cells` (n,): lexicographic indices.  A cell is a ghost on the processes that own its neighbours across faces.
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
