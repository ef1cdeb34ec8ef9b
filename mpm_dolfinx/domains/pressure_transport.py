# SPDX-License-Identifier: MIT
"""Conservative remap of the pore pressure from one grid to the next, of second order.

In each cell the pressure is reconstructed as p + s . (x - c) about the centroid c of what the cell stores.  The
slope s along an axis is van Leer's mean of the differences to the neighbours behind open faces, or to the pressure of
a drained side, and nothing where one of them is missing; it is scaled so that nowhere in the cell the extremes of
cell, neighbours and drained sides are passed.

A piece of a domain takes the pressure at its own centroid and moves with the domain.  When the domain is cut
anew, each cell that it lay in and still lies in keeps its pressure for the part that stayed; what newly lies
in a cell takes the mean pressure of what left the others.  The places of the pieces are passed on in the same way;
how far they then are from the true ones tells, with the domain's mean slope, what is still amiss.  Shares of every
domain sum to one, and so does this correction to nothing: nothing is lost; where nothing moves nothing changes.

What is told of the points, and taken along by none, is reconstructed up to sealed sides as well: see `up_to_surface`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import mass_potential
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.cutting import Pieces
from mpm_dolfinx.points.material_points import MaterialPoints


@dataclass(frozen=True, eq=False)
class PiecePressures:
    """The pore pressure of a scene between two steps; arrays over the pieces of domains, ordered by point and cell.

    id : (m,) number of the point; cell : (m,) lexicographic cell, -1 at the start; fraction : (m,) share of the domain;
    x : (m, d), m, where the centroid has moved to.  What pieces take to the next grid, None where all stay on this one:
    pressure : (m,), Pa, at the centroid; slope : (m, d) of it, Pa/m; bounds : (m, 2) least and largest pressure that
    any part of the piece may have, Pa.  What pieces have that stay, None where none does: of_cell, start : (m,), Pa,
    pressure of the cell, and that when the grid was reset.
    """

    id: NDArray[np.int64]
    cell: NDArray[np.int64]
    fraction: NDArray[np.float64]
    pressure: NDArray[np.float64] | None
    x: NDArray[np.float64]
    slope: NDArray[np.float64] | None
    bounds: NDArray[np.float64] | None
    of_cell: NDArray[np.float64] | None = None
    start: NDArray[np.float64] | None = None

    def __post_init__(self):
        for rows in self.arrays.values():
            rows.flags.writeable = False

    @property
    def arrays(self) -> dict[str, NDArray]:
        """Those that there are, by name."""
        return {name: rows for name, rows in vars(self).items() if rows is not None}

    def migrated(self, exchange: Exchange) -> PiecePressures:
        """Return the pieces of this process after each went to where its point goes."""
        return self._each(exchange.send)._ordered()

    def potentials(self, bulk: float) -> PiecePressures:
        """Return the same of the mass potentials of a fluid of this bulk modulus, Pa: see `transport`."""
        pi, bounds = mass_potential(self.pressure, bulk), mass_potential(self.bounds, bulk)
        slope = np.exp(self.pressure / bulk)[:, None] * self.slope
        return replace(self, pressure=pi, slope=slope, bounds=bounds)

    def less(self, slope: NDArray[np.float64]) -> PiecePressures:
        """Return the same of what pressures differ by from those of an even slope (d,), Pa/m."""
        even = self.x @ slope
        bounds = self.bounds - even[:, None]
        return replace(self, pressure=self.pressure - even, slope=self.slope - slope, bounds=bounds)

    def of(self, ids: NDArray[np.int64], kept: bool = True) -> PiecePressures:
        """Return the pieces of the points of these ids, or of all others."""
        rows = np.isin(self.id, ids) == kept
        return self._each(lambda values: values[rows])

    def joined(self, other: PiecePressures) -> PiecePressures:
        """Return these pieces and others, of points that have not been on the grid: all leave it, none stays."""
        pairs = {name: (getattr(self, name), values) for name, values in other.arrays.items()}
        return PiecePressures(**{name: np.concatenate(both) for name, both in pairs.items()})._ordered()

    def _each(self, change: Callable[[NDArray], NDArray]) -> PiecePressures:
        return replace(self, **{name: change(rows) for name, rows in self.arrays.items()})

    def _ordered(self) -> PiecePressures:
        order = np.lexsort((self.cell, self.id))
        return self._each(lambda values: values[order])


def at_start(points: MaterialPoints) -> PiecePressures:
    """Return what points carry that have not been in a cell yet: one piece each, of even pressure."""
    n, p = len(points), points.pressure
    cell = np.full(n, -1)
    slope = np.zeros_like(points.x)
    bounds = np.stack([p, p], axis=1)
    return PiecePressures(points.id, cell, np.ones(n), p, points.x, slope, bounds)


class CellPressures(NamedTuple):
    """What slopes in owned cells are drawn from.

    cells : (n,) owned cells; of all local cells: p : (c,), Pa; centroid : (c, d), m, relative to the midpoints; faces :
    (c, d, 2) open shares, zero for empty cells; outer : (n, d, 2, 2) by axis and end, difference to the pressure on
    drained sides ahead, Pa, and slope to them, Pa/m, nan where there is none.
    """

    cells: NDArray[np.int64]
    p: NDArray[np.float64]
    centroid: NDArray[np.float64]
    faces: NDArray[np.float64]
    outer: NDArray[np.float64]


class Reconstruction:
    """Limited slopes of cellwise values on the owned cells of a grid.

    Parameters
    ----------
    grid
        Background grid.
    """

    def __init__(self, grid: Grid):
        self.grid = grid
        self._slope = fem.Function(grid.cellwise((grid.dim,)))
        self._neighbour = grid.beside(np.arange(grid.num_owned))

    def __call__(
        self, seen: CellPressures, origin: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return slopes (n, d) and bounds (n, 2), drawn from places (n, d), m, relative to the cells' midpoints."""
        cells, p, centroid, *_ = seen
        jump, one_sided, _, drained = self._differences(seen)
        slope, low, high = van_leer(one_sided), *_spread(jump)
        whole = self.grid.sizes(cells)[..., None] * [-0.5, 0.5]
        filled = (2 * centroid[cells][:, :, None] - whole[..., ::-1]).clip(whole[..., :1], whole[..., 1:])
        ends = slope[:, :, None] * (np.where(drained, filled, whole) - origin[:, :, None])
        scale = np.ones(len(cells))
        for reach, room in ((ends.min(axis=2).sum(axis=1), low), (ends.max(axis=2).sum(axis=1), high)):
            scale = np.minimum(scale, np.divide(room, reach, out=np.ones(len(cells)), where=reach != 0))
        return slope * scale[:, None], p[cells, None] + np.stack([low, high], axis=1)

    def _differences(self, seen: CellPressures) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return differences and slopes to neighbours and drained sides, and where there is the one or the other.

        All (n, d, 2), by axis and end, zero where there is neither.
        """
        cells, p, centroid, faces, outer = seen
        there = self._neighbour[cells]
        here = p[cells]
        jump, one_sided = np.zeros(there.shape), np.zeros(there.shape)
        is_open = np.zeros(there.shape, dtype=bool)
        for axis in range(self.grid.dim):
            for end in (0, 1):
                other, way = there[:, axis, end], 2 * end - 1
                is_open[:, axis, end] = inside = (
                    (other >= 0) & (faces[cells, axis, end] > 0) & (faces[other, axis, 1 - end] > 0)
                )
                jump[:, axis, end] = np.where(inside, p[other] - here, 0.0)
                apart = self.grid.between(cells, other, axis) + way * (centroid[other, axis] - centroid[cells, axis])
                one_sided[:, axis, end] = way * jump[:, axis, end] / np.where(inside, apart, 1.0)
        drained = ~is_open & np.isfinite(outer[..., 0])
        jump, one_sided = np.where(drained, outer[..., 0], jump), np.where(drained, outer[..., 1], one_sided)
        return jump, one_sided, is_open, drained

    def up_to_surface(
        self, seen: CellPressures, x: NDArray[np.float64], slot: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return pressures (m,), Pa, at places in owned cells (n,), also of second order in cells at the surface.

        At a sealed side the slope is that of the cell before it, or what its change leaves if that is less: linear
        values are met, and steep ones not carried on.  No place passes cell, neighbours, drained sides, or what this
        slope has at the surface.

        Parameters
        ----------
        x : (m, d), m
            Places, relative to the cells' midpoints.
        slot : (m,)
            Place of each one's cell among the owned ones.
        """
        cells, p, centroid, *_ = seen
        jump, one_sided, is_open, drained = self._differences(seen)
        slope = van_leer(one_sided)
        at, axis = np.nonzero(is_open.any(axis=2) & ~(is_open | drained).all(axis=2))
        end = is_open[at, axis, 1].astype(int)
        to, there = one_sided[at, axis, end], self._neighbour[cells][at, axis, end]
        before = self._everywhere(cells, slope)[there, axis]
        same = before * to > 0
        slope[at, axis] = np.where(same, np.sign(to) * np.minimum(np.abs(before), np.abs(2 * to - before)), 0.0)
        way = 1 - 2 * end
        reach = self.grid.along(cells[at], axis) / 2 - way * centroid[cells[at], axis]
        on = way * slope[at, axis] * reach
        low, high = _spread(jump)
        low, high = low + sum_by(at, np.minimum(on, 0), len(cells)), high + sum_by(at, np.maximum(on, 0), len(cells))
        rise = np.einsum("md,md->m", slope[slot], x - centroid[cells[slot]])
        return p[cells[slot]] + share_within(rise, low, high, slot)[slot] * rise

    def _everywhere(self, cells: NDArray[np.int64], slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return slopes of owned cells (n, d) in a local array, that of active ghosts included."""
        out = self._slope.x.array.reshape(-1, self.grid.dim)
        out[cells] = slope
        self._slope.x.scatter_forward()
        return out


def van_leer(one_sided: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the harmonic means (n, d) of slopes to both sides (n, d, 2), zero where their signs differ."""
    a, b = one_sided[..., 0], one_sided[..., 1]
    return np.divide(2 * a * b, a + b, out=np.zeros(a.shape), where=a * b > 0)


def share_within(
    rise: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], slot: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the largest shares (n,) of rises (m,) in cells by which none passes the cell's low or high (n,)."""
    room, share = np.where(rise > 0, high[slot], low[slot]), np.ones(len(low))
    beyond = np.flatnonzero(np.abs(rise) > np.abs(room))
    np.minimum.at(share, slot[beyond], room[beyond] / rise[beyond])
    return share


def _spread(jump: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far the least and the largest of neighbours are from the cells (n,), from differences (n, d, 2)."""
    return jump.min(axis=(1, 2)).clip(max=0), jump.max(axis=(1, 2)).clip(min=0)


def transport(old: PiecePressures, points: MaterialPoints, new: Pieces) -> NDArray[np.float64]:
    """Return the pressures (m,), Pa, that the new pieces bring to their cells, or mass potentials, which add up."""
    n = len(points)
    if not n:
        return np.empty(0)
    owner = np.searchsorted(points.id, old.id)
    cells = 2 + max(old.cell.max(initial=-1), new.cell.max(initial=-1))
    old_key, new_key = owner * cells + old.cell + 1, new.point * cells + new.cell + 1
    at = np.minimum(np.searchsorted(old_key, new_key), max(len(old_key) - 1, 0))
    match = np.flatnonzero(old_key[at] == new_key)
    before = at[match]

    stays = np.zeros(len(new_key))
    stays[match] = np.minimum(new.fraction[match], old.fraction[before])
    leaves = old.fraction.copy()
    leaves[before] -= stays[match]
    left = sum_by(owner, leaves, n)
    share = stays / new.fraction

    def passed_on(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what the new pieces have of values of the old: their own, and the mean of what left."""
        mean = np.divide(sum_by(owner, leaves * values, n), left, out=np.zeros(n), where=left > 0)
        kept = np.zeros(len(new_key))
        kept[match] = values[before]
        return share * kept + (1 - share) * mean[new.point]

    pressure = passed_on(old.pressure)
    amiss = np.zeros(len(new_key))
    for axis in range(old.x.shape[1]):
        slope = sum_by(owner, old.fraction * old.slope[:, axis], n)
        then = old.x[:, axis] - sum_by(owner, old.fraction * old.x[:, axis], n)[owner]
        now = new.x[:, axis] - sum_by(new.point, new.fraction * new.x[:, axis], n)[new.point]
        amiss += slope[new.point] * (now - passed_on(then))
    return pressure + _within(amiss, pressure, old, owner, new) * amiss


def _within(amiss, pressure, old: PiecePressures, owner, new: Pieces) -> NDArray[np.float64]:
    """Return the share (m,) of a correction, the same for all pieces of a domain, that keeps to the bounds."""
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    low, high = np.minimum.reduceat(old.bounds[:, 0], first), np.maximum.reduceat(old.bounds[:, 1], first)
    room = np.where(amiss > 0, high[new.point] - pressure, low[new.point] - pressure)
    share = np.divide(room, amiss, out=np.ones(len(amiss)), where=amiss != 0).clip(0, 1)
    return np.minimum.reduceat(share, np.flatnonzero(np.diff(new.point, prepend=-1)))[new.point]
