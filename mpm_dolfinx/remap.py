# SPDX-License-Identifier: MIT
"""Conservative remap of the pore pressure from one grid to the next.

A piece of a domain keeps the pressure of the cell it lay in and moves with the domain.  When the
domain is cut anew, each cell that it lay in and still lies in keeps its pressure for the part that
stayed; what newly lies in a cell takes the mean pressure of what left the others.  Shares of every
domain sum to one, so nothing is lost; where nothing moves nothing changes; what moves is a
donor-cell remap.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.domains import Pieces
from mpm_dolfinx.exchange import Exchange
from mpm_dolfinx.grid import sum_by
from mpm_dolfinx.points import MaterialPoints


@dataclass
class Carried:
    """Pressures of the pieces between two steps; arrays over the pieces, ordered by point and cell.

    id : (m,) number of the point; cell : (m,) lexicographic cell, -1 at the start;
    fraction : (m,) share of the domain; pressure : (m,), Pa.
    """

    id: NDArray[np.int64]
    cell: NDArray[np.int64]
    fraction: NDArray[np.float64]
    pressure: NDArray[np.float64]

    def migrated(self, exchange: Exchange) -> Carried:
        """Return the pieces of this process after each went to where its point goes."""
        id, cell = exchange.send(self.id), exchange.send(self.cell)
        order = np.lexsort((cell, id))
        fraction, pressure = exchange.send(self.fraction), exchange.send(self.pressure)
        return Carried(id[order], cell[order], fraction[order], pressure[order])

    def kept(self, ids: NDArray[np.int64]) -> Carried:
        """Return the pieces of some points, given by their ids in order."""
        rows = np.isin(self.id, ids)
        return Carried(self.id[rows], self.cell[rows], self.fraction[rows], self.pressure[rows])

    def joined(self, other: Carried) -> Carried:
        """Return these pieces and those of other points, ordered by point and cell."""
        pairs = [(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)]
        id, cell, fraction, pressure = map(np.concatenate, pairs)
        order = np.lexsort((cell, id))
        return Carried(id[order], cell[order], fraction[order], pressure[order])


def carry(points: MaterialPoints, pieces: Pieces | None = None, pressure=None) -> Carried:
    """Return what the pieces of the points carry: the pressures of their cells, or of the points themselves."""
    if pieces is None:
        n = len(points)
        return Carried(points.id.copy(), np.full(n, -1), np.ones(n), points.pressure.copy())
    return Carried(points.id[pieces.point], pieces.cell, pieces.fraction, pressure)


def remap(old: Carried, points: MaterialPoints, new: Pieces) -> NDArray[np.float64]:
    """Return the pressures (m,), Pa, that the new pieces bring to their cells."""
    n = len(points)
    owner = np.searchsorted(points.id, old.id)
    cells = 2 + max(old.cell.max(initial=-1), new.cell.max(initial=-1))
    old_key, new_key = owner * cells + old.cell + 1, new.point * cells + new.cell + 1
    at = np.minimum(np.searchsorted(old_key, new_key), max(len(old_key) - 1, 0))
    match = np.flatnonzero(old_key[at] == new_key) if len(old_key) else at[:0]
    before = at[match]

    stays = np.zeros(len(new_key))
    stays[match] = np.minimum(new.fraction[match], old.fraction[before])
    leaves = old.fraction.copy()
    leaves[before] -= stays[match]
    mean = sum_by(owner, leaves * old.pressure, n)
    left = sum_by(owner, leaves, n)
    mean = np.divide(mean, left, out=np.zeros(n), where=left > 0)

    kept = np.zeros(len(new_key))
    kept[match] = old.pressure[before]
    share = stays / new.fraction
    return share * kept + (1 - share) * mean[new.point]
