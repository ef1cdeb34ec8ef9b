# SPDX-License-Identifier: MIT
"""Conservative remap of the pore pressure from one grid to the next, of second order.

In each cell the pressure is reconstructed as p + s . (x - c) about the centroid c of the cell's storage.  The slope s
along an axis is van Leer's mean of two differences: to the neighbours across open faces, or to the pressure of a
drained side.  If one of them is missing, s is zero.  The slope is scaled so that the pressure in the cell stays between
the extremes of cell, neighbours and drained sides.

A piece of a particle domain takes the pressure at its centroid and moves with the domain.  Then the domain is cut
again.  In a cell that contained the domain before, the common part keeps its pressure.  A part that is new in a cell
takes the mean pressure of the parts that left other cells.  The centroids of the pieces are remapped in the same way.
Their error times the mean slope of the domain corrects the pressure.  The fractions of a domain sum to one, and this
correction sums to zero, so the remap is conservative.  Without motion it changes nothing.

Point pressures for output use a reconstruction up to no-flow sides, which is not transported: see `up_to_surface`.
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
    """Pore pressure of a scene between two steps; arrays over the pieces of domains, ordered by point and cell.

    id : (m,) number of the point; cell : (m,) lexicographic cell, -1 at the start; fraction : (m,) fraction of the
    domain; x : (m, d) present centroid, m.  For pieces that go to the next grid, else None: pressure : (m,) at the
    centroid, Pa; slope : (m, d) its gradient, Pa/m; bounds : (m, 2) smallest and largest pressure allowed in the piece,
    Pa.  For pieces that stay, else None: of_cell, start : (m,) pressure of the cell now and at the reset, Pa.
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
        """Arrays that are not None, by name."""
        return {name: rows for name, rows in vars(self).items() if rows is not None}

    def migrated(self, exchange: Exchange) -> PiecePressures:
        """Return the pieces of this process after the exchange of their points."""
        return self._each(exchange.send)._ordered()

    def potentials(self, bulk: float) -> PiecePressures:
        """Return mass potentials in place of pressures, for a fluid with this bulk modulus, Pa: see `transport`."""
        pi, bounds = mass_potential(self.pressure, bulk), mass_potential(self.bounds, bulk)
        slope = np.exp(self.pressure / bulk)[:, None] * self.slope
        return replace(self, pressure=pi, slope=slope, bounds=bounds)

    def less(self, slope: NDArray[np.float64]) -> PiecePressures:
        """Return the pressures minus a field with a uniform slope (d,), Pa/m."""
        even = self.x @ slope
        bounds = self.bounds - even[:, None]
        return replace(self, pressure=self.pressure - even, slope=self.slope - slope, bounds=bounds)

    def of(self, ids: NDArray[np.int64], kept: bool = True) -> PiecePressures:
        """Return the pieces of the points with these ids, or (kept=False) of all other points."""
        rows = np.isin(self.id, ids) == kept
        return self._each(lambda values: values[rows])

    def joined(self, other: PiecePressures) -> PiecePressures:
        """Return these pieces and others, of points new on the grid; no piece stays on this grid."""
        pairs = {name: (getattr(self, name), values) for name, values in other.arrays.items()}
        return PiecePressures(**{name: np.concatenate(both) for name, both in pairs.items()})._ordered()

    def _each(self, change: Callable[[NDArray], NDArray]) -> PiecePressures:
        return replace(self, **{name: change(rows) for name, rows in self.arrays.items()})

    def _ordered(self) -> PiecePressures:
        order = np.lexsort((self.cell, self.id))
        return self._each(lambda values: values[order])


def at_start(points: MaterialPoints) -> PiecePressures:
    """Return the pressures of points that have not been in a cell yet: one piece each, with uniform pressure."""
    n, p = len(points), points.pressure
    cell = np.full(n, -1)
    slope = np.zeros_like(points.x)
    bounds = np.stack([p, p], axis=1)
    return PiecePressures(points.id, cell, np.ones(n), p, points.x, slope, bounds)


class CellPressures(NamedTuple):
    """Data for slopes in owned cells.

    cells : (n,) owned cells.  For all local cells: p : (c,), Pa; centroid : (c, d), m, relative to the midpoints;
    faces : (c, d, 2) open fractions, zero for empty cells.  outer : (n, d, 2, 2), by axis and end: difference to the
    pressure on a drained side, Pa, and slope to it, Pa/m; nan without a drained side.
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
        self._neighbour = grid.neighbours(np.arange(grid.num_owned))

    def __call__(
        self, pressures: CellPressures, origin: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return slopes (n, d), Pa/m, and bounds (n, 2), Pa, of the pressures of cells.

        origin (n, d), m: position of the cell's pressure relative to its midpoint.
        """
        cells, p, centroid, *_ = pressures
        jump, one_sided, _, drained = self._differences(pressures)
        slope, low, high = van_leer(one_sided), *_bounds_of(jump)
        whole = self.grid.sizes(cells)[..., None] * [-0.5, 0.5]
        filled = (2 * centroid[cells][:, :, None] - whole[..., ::-1]).clip(whole[..., :1], whole[..., 1:])
        ends = slope[:, :, None] * (np.where(drained, filled, whole) - origin[:, :, None])
        scale = np.ones(len(cells))
        for end, bound in ((ends.min(axis=2).sum(axis=1), low), (ends.max(axis=2).sum(axis=1), high)):
            scale = np.minimum(scale, np.divide(bound, end, out=np.ones(len(cells)), where=end != 0))
        return slope * scale[:, None], p[cells, None] + np.stack([low, high], axis=1)

    def _differences(self, pressures: CellPressures) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return differences and slopes to neighbours and drained sides, and which neighbours and sides exist.

        All (n, d, 2), by axis and end; zero without a neighbour or drained side.
        """
        cells, p, centroid, faces, outer = pressures
        neighbours, own = self._neighbour[cells], cells[:, None, None]
        axis, end = np.arange(self.grid.dim)[:, None], np.arange(2)
        sign = 2 * end - 1
        is_open = (neighbours >= 0) & (faces[cells] > 0) & (faces[neighbours, axis, 1 - end] > 0)
        jump = np.where(is_open, p[neighbours] - p[own], 0.0)
        distance = self.grid.between(own, neighbours, axis) + sign * (centroid[neighbours, axis] - centroid[own, axis])
        one_sided = sign * jump / np.where(is_open, distance, 1.0)
        drained = ~is_open & np.isfinite(outer[..., 0])
        jump, one_sided = np.where(drained, outer[..., 0], jump), np.where(drained, outer[..., 1], one_sided)
        return jump, one_sided, is_open, drained

    def up_to_surface(
        self, pressures: CellPressures, x: NDArray[np.float64], slot: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return pressures (m,), Pa, at positions in owned cells (n,), of second order also in cells at the surface.

        At a no-flow side the slope is the slope of the next cell inside, or the linear extrapolation of the slopes if
        this is smaller.  Linear fields are exact, and steep slopes are not continued.  Pressures stay within cell,
        neighbours, drained sides, and the value of this slope at the surface.

        Parameters
        ----------
        x : (m, d), m
            Positions relative to the midpoints of their cells.
        slot : (m,)
            Index of the cell of each position among the owned cells.
        """
        cells, p, centroid, *_ = pressures
        jump, one_sided, is_open, drained = self._differences(pressures)
        slope = van_leer(one_sided)
        at, axis = np.nonzero(is_open.any(axis=2) & ~(is_open | drained).all(axis=2))
        end = is_open[at, axis, 1].astype(int)
        to, inner = one_sided[at, axis, end], self._neighbour[cells][at, axis, end]
        before = self._everywhere(cells, slope)[inner, axis]
        same = before * to > 0
        slope[at, axis] = np.where(same, np.sign(to) * np.minimum(np.abs(before), np.abs(2 * to - before)), 0.0)
        sign = 1 - 2 * end
        depth = self.grid.along(cells[at], axis) / 2 - sign * centroid[cells[at], axis]
        on = sign * slope[at, axis] * depth
        low, high = _bounds_of(jump)
        low, high = low + sum_by(at, np.minimum(on, 0), len(cells)), high + sum_by(at, np.maximum(on, 0), len(cells))
        increment = np.einsum("md,md->m", slope[slot], x - centroid[cells[slot]])
        return p[cells[slot]] + share_within(increment, low, high, slot)[slot] * increment

    def _everywhere(self, cells: NDArray[np.int64], slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return slopes of owned cells (n, d) as an array over local cells, including active ghosts."""
        out = self._slope.x.array.reshape(-1, self.grid.dim)
        out[cells] = slope
        self._slope.x.scatter_forward()
        return out


def van_leer(one_sided: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the harmonic means (n, d) of slopes to both sides (n, d, 2), zero where their signs differ."""
    a, b = one_sided[..., 0], one_sided[..., 1]
    return np.divide(2 * a * b, a + b, out=np.zeros(a.shape), where=a * b > 0)


def share_within(
    increment: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], slot: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the largest factors (n,) with which all increments (m,) in a cell stay between its low and high (n,)."""
    bound, share = np.where(increment > 0, high[slot], low[slot]), np.ones(len(low))
    excessive = (np.abs(increment) > np.abs(bound)).nonzero()[0]
    np.minimum.at(share, slot[excessive], bound[excessive] / increment[excessive])
    return share


def _bounds_of(jump: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest (<= 0) and largest (>= 0) difference to neighbours (n,), from differences (n, d, 2)."""
    return np.minimum(jump.min(axis=(1, 2)), 0), np.maximum(jump.max(axis=(1, 2)), 0)


def transport(old: PiecePressures, points: MaterialPoints, new: Pieces) -> NDArray[np.float64]:
    """Return the pressures (m,), Pa, of the new pieces, or their mass potentials, which are additive."""
    n = len(points)
    if not n:
        return np.empty(0)
    owner = points.id.searchsorted(old.id)
    cells = 2 + max(old.cell.max(initial=-1), new.cell.max(initial=-1))
    old_key, new_key = owner * cells + old.cell + 1, new.point * cells + new.cell + 1
    at = np.minimum(old_key.searchsorted(new_key), max(len(old_key) - 1, 0))
    match = (old_key[at] == new_key).nonzero()[0]
    before = at[match]

    common = np.zeros(len(new_key))
    common[match] = np.minimum(new.fraction[match], old.fraction[before])
    left_fraction = old.fraction.copy()
    left_fraction[before] -= common[match]
    leaving = sum_by(owner, left_fraction, n)
    share = common / new.fraction

    def remapped(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values of the new pieces: the old value on the common part, elsewhere the mean of parts that left."""
        mean = np.divide(sum_by(owner, left_fraction * values, n), leaving, out=np.zeros(n), where=leaving > 0)
        old_values = np.zeros(len(new_key))
        old_values[match] = values[before]
        return share * old_values + (1 - share) * mean[new.point]

    pressure = remapped(old.pressure)
    correction = np.zeros(len(new_key))
    for axis in range(old.x.shape[1]):
        slope = sum_by(owner, old.fraction * old.slope[:, axis], n)
        then = old.x[:, axis] - sum_by(owner, old.fraction * old.x[:, axis], n)[owner]
        now = new.x[:, axis] - sum_by(new.point, new.fraction * new.x[:, axis], n)[new.point]
        correction += slope[new.point] * (now - remapped(then))
    return pressure + _limited(correction, pressure, old, owner, new) * correction


def _limited(correction, pressure, old: PiecePressures, owner, new: Pieces) -> NDArray[np.float64]:
    """Return the factor (m,) of a correction, equal for all pieces of a domain, that respects the bounds."""
    first = np.diff(owner, prepend=-1).nonzero()[0]
    low, high = np.minimum.reduceat(old.bounds[:, 0], first), np.maximum.reduceat(old.bounds[:, 1], first)
    margin = np.where(correction > 0, high[new.point] - pressure, low[new.point] - pressure)
    share = np.divide(margin, correction, out=np.ones(len(correction)), where=correction != 0).clip(0, 1)
    return np.minimum.reduceat(share, np.diff(new.point, prepend=-1).nonzero()[0])[new.point]
