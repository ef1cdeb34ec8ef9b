# SPDX-License-Identifier: MIT
"""Mobility of cells with several conductivities, from lines through the cell along each axis.

Soils along a line are in series, and lines are in parallel.  The mobility of a line is the harmonic mean over its
soils.  The mobility of a cell along an axis is the arithmetic mean over the lines along this axis (Cardwell and Parsons
1945).  This mobility is exact for flow along and across layers parallel to the grid.  Inclined layers must be at least
a cell thick.

The pressure of a cell refers to one position in the cell, the *pressure position*.  In steady flow along a line, the
pressure at this position equals the mean pressure of the line.  With the resistance R and a coordinate s from 0 to 1
along the line, the resistance from the pressure position to the lower end is `int (1 - s) dR`.  The resistance to the
upper end is `int s dR`.  If layers are inclined by more than `INCLINED`, the pressure position moves to the more
conductive end of the cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR, ROUND_OFF, SAME, TINY
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.fluxes import CellContents, Mobility
from mpm_dolfinx.flow.series import Paths, none
from mpm_dolfinx.grid.grid import ranges, sum_by
from mpm_dolfinx.parallel.exchange import over_all

INCLINED = 0.01
"""Smallest slope of layers, relative to the grid, at which the pressure position moves to the more conductive end.
Sensitivity (scene "slope" of tests/plateaus.py): half this value changes the result by 4.1e-04, and twice this value by
5.0e-05. Finer cells change it by 3.4e-03.
"""
PAIRS = 2**16
"""Number of pairs of pieces in a batch."""


@dataclass(frozen=True)
class Lines:
    """Lines through the centroids of pieces, parallel to an axis of the grid."""

    line: NDArray[np.int64]  # index, among pieces of mixed cells, of the piece through whose centroid the line runs
    piece: NDArray[np.int64]  # index of the crossed piece
    length: NDArray[np.float64]  # length in the crossed piece, divided by the cell size
    before: NDArray[np.float64]  # fraction of the piece's resistance that lies below the pressure position
    total: NDArray[np.float64]  # length of the whole line in the cell, divided by the cell size


class MixedCells:
    """Owned cells with several conductivities (mixed cells), and lines through them.

    `rows`: indices (m,) of the pieces in mixed cells, ordered by cell.
    `cells`: cells (m,) of the pieces.
    `low`, `high`: corners (m, d) of the bounding boxes of pieces, in cell coordinates from 0 to 1.
    `x`: centroids (m, d) of the pieces, in cell coordinates.
    `volume`: volumes (m,) of the pieces, m^d.
    `soils` (m, k): material constants.  Pieces with identical constants have equal conductivities.
    """

    def __init__(self, rows, cells, low, high, x, volume, contents: CellContents, soils):
        self._rows = rows
        self._x = x
        self._kind = np.unique(soils, axis=0, return_inverse=True)[1].ravel()
        self._volume = volume
        own, first, self._at, count = np.unique(cells, return_index=True, return_inverse=True, return_counts=True)
        self._h = contents.grid.sizes(own)
        self.cells = own
        """The mixed cells."""
        self._filled, self._middle = contents.slot(own), contents.centroid[own] / self._h
        middle = self._middle
        self._bounds = np.minimum(ROUND_OFF - 0.5 - middle, 0.0), np.maximum(0.5 - ROUND_OFF - middle, 0.0)
        count, first = count[self._at], first[self._at]
        ends = (1 + np.flatnonzero(np.diff(np.cumsum(count) // PAIRS, append=-1))).tolist() or [0]
        crossings = [self._crossed(slice(a, b), first, count, low, high) for a, b in pairwise([0, *ends])]
        size, share = np.maximum(high - low, NEAR), volume / contents.grid.sizes(cells).prod(axis=-1)
        self._lines = []
        for axis, found in enumerate(zip(*crossings, strict=True)):
            line, piece, fraction = (np.concatenate(rows) for rows in zip(*found, strict=True))
            length = (share / np.delete(size, axis, axis=1).prod(axis=1))[piece] * fraction
            total, place = (sum_by(line, length * y, len(cells)) for y in (1.0, x[piece, axis]))
            before = 0.5 + ((place / total)[line] - x[piece, axis]) / total[line]
            self._lines.append(Lines(line, piece, length, before, total))

    def _crossed(self, rows: slice, first, count, low, high) -> list[tuple[NDArray, NDArray, NDArray]]:
        """Return arrays for each axis: lines through centroids of `rows`, pieces that these lines cross, and weights.

        A crossed piece has a weight below one if the line runs along its border.
        """
        line, piece = ranges(first[rows], count[rows])
        line += rows.start
        # means of two shifted lines, because a line lies on the border of a piece only within rounding
        places = [self._x[line] + shift for shift in (-NEAR / 2, NEAR / 2)]
        inside = np.mean([(low[piece] <= x) & (x <= high[piece]) for x in places], axis=0)
        out = []
        for axis in range(self._x.shape[1]):
            fraction = np.delete(inside, axis, axis=1).prod(axis=1)
            kept = np.flatnonzero(fraction)
            lines, fraction = line[kept], fraction[kept]
            start, stop = (np.searchsorted(lines, lines, end) for end in ("left", "right"))
            one, other = ranges(start, stop - start)  # all pairs of pieces on a line
            a, b = (piece[kept][rows] for rows in (one, other))
            overlap = np.minimum(high[a], high[b]) - np.maximum(low[a], low[b])
            overlap = overlap.clip(0) / np.maximum(high[a] - low[a], NEAR)
            # boxes of neighbouring pieces may overlap after deformation: if a line crosses both, each counts half
            lateral = 1 - np.delete(overlap, axis, axis=1).min(axis=1)
            counted = fraction + sum_by(one, lateral * fraction[other] * overlap[:, axis], len(lines))
            out.append((lines, piece[kept], fraction / np.maximum(counted, 1.0)))
        return out

    def mobility(
        self,
        kappa: NDArray[np.float64],
        mean: NDArray[np.float64],
        share: NDArray[np.float64] | None,
        now: NDArray[np.float64] | None = None,
    ) -> Mobility:
        """Return the mobility of filled cells.

        `kappa`, m^2/(Pa s): mobilities of all pieces.
        `mean` (n,), m^2/(Pa s): means of `kappa` in the filled cells.
        `share` (n, d): mobility along each axis divided by `mean`.  This method replaces the values of mixed cells.
        `now`, m^2/(Pa s): mobilities of all pieces at their pressures, in unsaturated soil.
        """
        along, off = self._along(kappa[self._rows])
        if now is not None:
            off = self._along(now[self._rows], 0.0)[1]
        shift = np.zeros((len(mean), along.shape[1]))
        share = np.ones_like(shift) if share is None else share
        share[self._filled] = np.divide(along, mean[self._filled, None], out=np.zeros_like(along), where=along > 0)
        shift[self._filled] = off.clip(*self._bounds) * self._h
        return Mobility(mean, share, shift)

    def _along(self, kappa: NDArray[np.float64], mean: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mobilities along the axes, and shifts, in cell sizes, from centroids to pressure positions.

        `mean`: 1 if all layers shift the pressure position, 0 if only inclined layers shift it.
        """
        n, d = len(self._filled), self._x.shape[1]
        mobility = np.zeros((n, d))
        shift = np.zeros((n, d))
        sharper = self._sharper(kappa) + mean
        with np.errstate(divide="ignore"):
            resistivity = 1 / kappa
        for axis, lines in enumerate(self._lines):
            resistances = lines.length * resistivity[lines.piece]
            resistance = sum_by(lines.line, resistances, len(kappa))
            conducts = self._volume * lines.total / resistance
            resistances = np.where((resistance < np.inf)[lines.line], resistances, 0.0)
            below = sum_by(lines.line, resistances * lines.before, len(kappa))
            below = np.divide(below, resistance, out=np.full(len(kappa), 0.5), where=resistance < np.inf)
            off = lines.total * (sharper[self._at] * (below - 0.5)).clip(-0.5, 0.5)
            total = sum_by(self._at, conducts, n)
            mobility[:, axis] = total / sum_by(self._at, self._volume, n)
            np.divide(sum_by(self._at, conducts * off, n), total, out=shift[:, axis], where=total > 0)
        return mobility, shift

    def paths(
        self, kappa: NDArray[np.float64], law: NDArray[np.int64], laws: int, shift: NDArray[np.float64] | None
    ) -> Paths:
        """Return the flow paths of the mixed cells, see `Paths`.

        `kappa` (m,), m^2/(Pa s): mobilities of all pieces at saturation.
        `law` (m,): index of the retention curve of each piece, smaller than `laws`.
        `shift` (n, d), m: vectors from the centroids of filled cells to their pressure positions, or None for zeros.
        """
        kappa, law = kappa[self._rows], law[self._rows]
        place = 0.5 + self._middle + (0.0 if shift is None else shift[self._filled] / self._h)
        found = [self._path(axis, end, kappa, law, laws, place[:, axis]) for axis, end in np.ndindex(place.shape[1], 2)]
        slots = max(1, *(path.law.shape[1] for path in found))
        padded, shape = zip(*(path.with_slots(slots) for path in found), strict=True), (*place.shape, 2)
        return Paths(*(np.stack(parts, axis=1).reshape(*shape, parts[0].shape[1]) for parts in padded))

    def _path(self, axis: int, end: int, kappa, law, laws: int, place: NDArray[np.float64]) -> Paths:
        """Return the flow paths along an axis from the pressure positions to one end of the cells."""
        n, lines = len(place), self._lines[axis]
        middle = (2 * end - 1) * (self._x[lines.piece, axis] - place[self._at[lines.line]])
        length = np.clip(middle + lines.length / 2, 0.0, lines.length)  # of the part beyond the pressure position
        kept = np.flatnonzero(length > SAME)
        kept = kept[np.lexsort((middle[kept], lines.line[kept]))]
        line, piece = lines.line[kept], lines.piece[kept]
        length = length[kept]
        total = sum_by(line, length, len(kappa))
        weight = np.where(total > 0, self._volume, 0.0)
        weight = weight / np.maximum(sum_by(self._at, weight, n), TINY)[self._at]
        part = length / total[line]
        with np.errstate(divide="ignore"):
            resistances = part / kappa[piece]
        run = np.append(0, np.cumsum((np.diff(line) != 0) | (np.diff(self._kind[piece]) != 0)))
        start = np.searchsorted(line, line)
        run = run - run[start] if len(run) and len(line) else run[:0]
        several = np.zeros(len(kappa), dtype=bool)
        several[line[run > 0]] = True
        alone = ~several[line]
        parallel = np.zeros((n, laws))
        first = np.zeros(len(kappa), dtype=np.int64)
        first[line] = law[piece]
        resistance = sum_by(line[alone], resistances[alone], len(kappa))
        single = np.flatnonzero((total > 0) & ~several)
        np.add.at(parallel, (self._at[single], first[single]), weight[single] / resistance[single])
        cell = self._at[line]
        share = sum_by(self._at, np.where(several, weight, 0.0), n)
        keys = np.stack([cell, run, self._kind[piece]], axis=1)[~alone]
        slots, slot = np.unique(keys, axis=0, return_inverse=True)
        slot = slot.ravel()
        of = slots[:, 0]
        number = np.arange(len(of)) - np.searchsorted(of, of)
        out = none(n, laws, int(number.max(initial=-1)) + 1)
        counts = weight[line[~alone]]
        out.law[of[slot], number[slot]] = law[piece[~alone]]
        np.add.at(out.length, (of[slot], number[slot]), counts * part[~alone] / share[of[slot]])
        np.add.at(out.resistance, (of[slot], number[slot]), counts * resistances[~alone] / share[of[slot]] ** 2)
        return out._replace(parallel=parallel)

    def _sharper(self, kappa: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return factors (n,) for the shifts in `_along`: 0 without inclined layers, >= 1 for slopes > `INCLINED`."""
        n = len(self._filled)

        def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return sum_by(self._at, self._volume * values, n)

        volume = total(np.ones(len(kappa)))
        both = kappa + (total(kappa) / volume)[self._at]
        conducts = np.divide(kappa, both, out=np.zeros_like(kappa), where=both > 0)
        conducts -= (total(conducts) / volume)[self._at]
        moment = np.stack([total(conducts * x) for x in self._x.T], axis=1) ** 2
        whole = moment.sum(axis=1) ** 2
        inclined = np.divide(whole - (moment**2).sum(axis=1), 2 * whole, out=np.zeros(n), where=whole > 0)
        return inclined / INCLINED**2


def graded(
    contents: CellContents, offset: NDArray[np.float64], kappa: NDArray[np.float64], mean: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return mobilities (n, d) along the axes, divided by `mean`, of cells in which the mobility varies gradually.

    The mean over the cell is harmonic along the gradient of the mobility, and arithmetic normal to this gradient.

    `offset` (m, d), m: positions of the pieces relative to the midpoints of their cells.
    `kappa` (m,), m^2/(Pa s): mobilities of the pieces.
    `mean` (n,), m^2/(Pa s): mean mobilities of the filled cells.
    """
    with np.errstate(divide="ignore"):
        series = 1 / contents.mean(1 / kappa)
    parts = []  # fraction of the variance that a linear variation along each axis explains
    for x, least in zip(offset.T, (NEAR * contents.grid.sizes(contents.filled).T) ** 2, strict=True):
        middle, moment = contents.mean(x), contents.mean(x * kappa)
        variance = contents.mean(x**2) - middle**2
        square = (moment - middle * mean) ** 2
        parts.append(np.divide(square, variance, out=np.zeros(len(mean)), where=variance > least))
    parts = np.stack(parts, axis=1)
    whole = parts.sum(axis=1, keepdims=True)
    along = np.divide(parts, whole, out=np.full(parts.shape, 1 / parts.shape[1]), where=whole > 0)
    reduction = np.divide(mean - series, mean, out=np.zeros(len(mean)), where=mean > 0)
    return 1 - reduction[:, None] * along


def mixed_cells(cut: CutDomains, soils: NDArray[np.float64], contents: CellContents) -> MixedCells | None:
    """Return the owned cells with pieces of different conductivity, or None if no process has a mixed cell.

    `soils` (m, k): material constants.  Pieces with identical constants have equal conductivities.
    """
    grid = cut.grid
    cells = cut.cells
    volume = contents.area
    some = np.zeros((grid.num_local, soils.shape[1]))
    some[cells] = soils  # constants of an arbitrary piece of the cell
    mixed = sum_by(cells, (soils != some[cells]).any(axis=1), grid.num_local) > 0
    corners = cut.points.corners
    low, high = (cut.to_cells(rows) for rows in (corners.min(axis=1), corners.max(axis=1)))
    if over_all(grid.comm, bool(mixed.any())) == 0:
        return None
    rows = np.flatnonzero(mixed[cells])
    rows = rows[np.argsort(cells[rows], kind="stable")]
    cells, volume = cells[rows], volume[rows]
    h = grid.sizes(cells)
    x = (cut.x[rows] - grid.midpoints[cells]) / h + 0.5
    if cut.domains:
        low, high = (((y[rows] - grid.midpoints[cells]) / h + 0.5).clip(0, 1) for y in (low, high))
    else:
        half = 0.5 * (volume / grid.volumes(cells))[:, None] ** (1 / grid.dim)
        low, high = x - half, x + half
    return MixedCells(rows, cells, low, high, x, volume, contents, soils[rows])
