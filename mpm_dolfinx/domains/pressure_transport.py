# SPDX-License-Identifier: MIT
"""Conservative, second-order remap of the pore pressure from one grid to the next.

In each cell, the pressure at x is reconstructed as `p + s . (x - c)`.  The cell pressure is p, and c is the centroid of
the material, weighted by storage.  The slope s along an axis is van Leer's mean of the slopes to both neighbours.  A
drained side counts as a neighbour.  At a no-flow side, s is zero.  A limiter keeps the pressure in the cell between the
extremes of the cell, its neighbours and drained sides.

Each piece of a particle domain stores the pressure at its centroid.  After the motion, the domain is cut again.  The
fraction of the domain that is still in the same cell keeps its pressure.  All other fractions get the mean pressure of
the fractions that left their cells.  The mean slope in the domain corrects these pressures to second order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import mass_potential, pressure_of
from mpm_dolfinx.grid.grid import Grid, means_of_rows, sum_by
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.cutting import Pieces
from mpm_dolfinx.points.material_points import MaterialPoints

AtPlaces = Callable[[NDArray[np.integer], NDArray[np.float64]], NDArray[np.float64]]
"""Function of local cells (n,) and positions (n, d), in m, in these cells. The function returns values (n,)."""


@dataclass(frozen=True, eq=False)
class PiecePressures:
    """Pore pressures of m pieces between two steps, sorted by point and cell.

    Kept pieces are the pieces of points that hardly move.  They have the pressures of their cells.
    """

    id: NDArray[np.int64]  # identifier of the point (m,)
    cell: NDArray[np.int64]  # lexicographic index of the cell (m,); -1 before the first cut
    fraction: NDArray[np.float64]  # fraction of the domain (m,)
    pressure: NDArray[np.float64] | None  # pressure at the centroid (m,), Pa; None for kept pieces
    x: NDArray[np.float64]  # current centroid (m, d), m
    slope: NDArray[np.float64] | None  # pressure gradient (m, d), Pa/m; None for kept pieces
    bounds: NDArray[np.float64] | None  # smallest and largest allowed pressure (m, 2), Pa; None for kept pieces
    of_cell: NDArray[np.float64] | None = None  # current pressure of the cell (m,), Pa; only for kept pieces
    start: NDArray[np.float64] | None = None  # pressure of the cell at the grid reset (m,), Pa; only for kept pieces

    def __post_init__(self):
        for rows in self.arrays.values():
            rows.flags.writeable = False

    @property
    def arrays(self) -> dict[str, NDArray]:
        """Arrays that are not None, by name."""
        return {name: rows for name, rows in vars(self).items() if rows is not None}

    def migrated(self, exchange: Exchange) -> PiecePressures:
        """Return the pieces on this process after an exchange of points."""
        return self._each(exchange.send)._ordered()

    def potentials(self, bulk: float) -> PiecePressures:
        """Return the pieces with mass potentials (see `fluid_content`) in place of pressures.

        `bulk`, in Pa: bulk modulus of the fluid.
        """
        pi, bounds = mass_potential(self.pressure, bulk), mass_potential(self.bounds, bulk)
        slope = np.exp(self.pressure / bulk)[:, None] * self.slope
        return replace(self, pressure=pi, slope=slope, bounds=bounds)

    def less(self, slope: NDArray[np.float64]) -> PiecePressures:
        """Return the pieces after subtraction of a linear pressure field with the slope (d,), in Pa/m."""
        even = self.x @ slope
        bounds = self.bounds - even[:, None]
        return replace(self, pressure=self.pressure - even, slope=self.slope - slope, bounds=bounds)

    def of(self, ids: NDArray[np.int64], kept: bool = True) -> PiecePressures:
        """Return the pieces of the points `ids`, or of all other points if `kept` is False."""
        rows = np.isin(self.id, ids) == kept
        return self._each(lambda values: values[rows])

    def joined(self, other: PiecePressures) -> PiecePressures:
        """Return these pieces together with the pieces `other` of new points."""
        pairs = {name: (getattr(self, name), values) for name, values in other.arrays.items()}
        return PiecePressures(**{name: np.concatenate(both) for name, both in pairs.items()})._ordered()

    def _each(self, change: Callable[[NDArray], NDArray]) -> PiecePressures:
        return replace(self, **{name: change(rows) for name, rows in self.arrays.items()})

    def _ordered(self) -> PiecePressures:
        order = np.lexsort((self.cell, self.id))
        return self._each(lambda values: values[order])


def at_start(points: MaterialPoints) -> PiecePressures:
    """Return one piece with uniform pressure for each new point."""
    n, p = len(points), points.pressure
    cell = np.full(n, -1)
    slope = np.zeros_like(points.x)
    bounds = np.stack([p, p], axis=1)
    return PiecePressures(points.id, cell, np.ones(n), p, points.x, slope, bounds)


class CellPressures(NamedTuple):
    """Pressures of the c local cells, and data for slopes in n owned cells."""

    cells: NDArray[np.int64]  # owned cells (n,)
    p: NDArray[np.float64]  # pressure (c,), Pa
    centroid: NDArray[np.float64]  # centroid relative to the midpoint of the cell (c, d), m
    faces: NDArray[np.float64]  # open fractions of the faces (c, d, 2), zero for empty cells
    # by axis and end of owned cells: pressure difference to a drained side, Pa, and slope, Pa/m; nan if not drained
    outer: NDArray[np.float64]  # (n, d, 2, 2)


class Reconstruction:
    """Limited slopes of cellwise values on the owned cells of a grid."""

    def __init__(self, grid: Grid):
        self.grid = grid
        self._slope = fem.Function(grid.cellwise((grid.dim,)))
        self._neighbour = grid.neighbours(np.arange(grid.num_owned))

    def __call__(
        self, pressures: CellPressures, origin: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the slopes (n, d), in Pa/m, and the bounds (n, 2), in Pa, of the pressures in cells.

        `origin` (n, d), in m: position to which the cell pressure refers, relative to the midpoint of the cell.
        """
        cells, p, centroid, *_ = pressures
        jump, one_sided, _, drained = self._differences(pressures)
        slope, low, high = van_leer(one_sided), *_bounds_of(jump)
        whole = self.grid.sizes(cells)[..., None] * [-0.5, 0.5]
        filled = 2 * centroid[cells][:, :, None] - whole[..., ::-1]
        filled = np.minimum(np.maximum(filled, whole[..., :1]), whole[..., 1:])
        ends = slope[:, :, None] * (np.where(drained, filled, whole) - origin[:, :, None])
        scale = np.ones(len(cells))
        for end, bound in ((ends.min(axis=2).sum(axis=1), low), (ends.max(axis=2).sum(axis=1), high)):
            scale = np.minimum(scale, np.divide(bound, end, out=np.ones(len(cells)), where=end != 0))
        return slope * scale[:, None], p[cells, None] + np.array([low, high]).T

    def _differences(self, pressures: CellPressures) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return pressure differences, slopes, masks of neighbours and of drained sides, for both ends of each cell."""
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
        self,
        pressures: CellPressures,
        x: NDArray[np.float64],
        slot: NDArray[np.int64],
        at_rest: AtPlaces | None = None,
        alike: NDArray[np.bool_] | bool = True,
    ) -> NDArray[np.float64]:
        """Return pressures (m,), in Pa, at positions in owned cells, with second-order accuracy even at the surface.

        At a no-flow side, the slope is extrapolated from the cells inside, and limited by the slope in the next cell.

        `x` (m, d), in m: positions relative to the midpoints of their cells.
        `slot` (m,): index of the cell of each position in `pressures.cells`.
        `at_rest`: hydrostatic pressures to be added if `pressures` are heads, or None.  The sum is limited to the range
        in the cell and its neighbours.  At sides and other soils, hydrostatic and linear continuations bound the range.
        `alike` (n, d, 2): whether a cell and its neighbour contain the same soil alone.
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
        increment = np.add.reduce(slope[slot] * (x - centroid[cells[slot]]), axis=1)
        share = share_within(increment, low, high, slot)
        head = p[cells[slot]] + share[slot] * increment
        if at_rest is None:
            return head
        jump = np.where(is_open & ~alike, np.nan, jump)
        mean, low, high = self._range(pressures, jump, (is_open, drained), share[:, None] * slope, at_rest)
        increment = head + at_rest(cells[slot], self.grid.midpoints[cells[slot]] + x) - mean[slot]
        return mean[slot] + share_within(increment, low, high, slot)[slot] * increment

    def _range(
        self,
        pressures: CellPressures,
        jump: NDArray[np.float64],
        ends: tuple[NDArray[np.bool_], NDArray[np.bool_]],
        slope: NDArray[np.float64],
        at_rest: AtPlaces,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the pressures (n,) of cells, and the smallest (<= 0) and largest difference (n,) from them, in Pa.

        `jump` (n, d, 2), in Pa: differences of the heads to neighbours and drained sides; nan at other soils.
        `ends` (n, d, 2): whether there is a neighbour, and whether there is a drained side.
        `slope` (n, d), in Pa/m: slopes of the heads.
        """
        cells, p, centroid, *_ = pressures
        is_open, drained = ends
        place = self.grid.midpoints[cells] + centroid[cells]
        least, most = np.zeros((2, len(cells)))
        rest, neighbours = at_rest(cells, place), self._neighbour[cells]
        for axis in range(self.grid.dim):
            changes = []
            for end in range(2):
                face, other = place.copy(), np.where(neighbours[:, axis, end] < 0, cells, neighbours[:, axis, end])
                face[:, axis] = self.grid.midpoints[cells, axis] + (end - 0.5) * self.grid.along(cells, axis)
                to_side = at_rest(cells, face) - rest
                extended = to_side + slope[:, axis] * (face - place)[:, axis]
                hydrostatic = at_rest(other, self.grid.midpoints[other] + centroid[other]) - rest
                across = jump[:, axis, end] + np.where(is_open[:, axis, end], hydrostatic, to_side)
                known = (is_open | drained)[:, axis, end] & ~np.isnan(across)
                changes += [np.where(known, across, to_side), np.where(known, across, extended)]
            least, most = least + np.minimum(np.min(changes, axis=0), 0), most + np.maximum(np.max(changes, axis=0), 0)
        return p[cells] + rest, least, most

    def _everywhere(self, cells: NDArray[np.int64], slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the slopes of owned cells as an array over all local cells, with ghosts."""
        out = self._slope.x.array.reshape(-1, self.grid.dim)
        out[cells] = slope
        self._slope.x.scatter_forward()
        return out


def van_leer(one_sided: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the harmonic means (n, d) of the slopes to both sides (n, d, 2), or zero if their signs differ."""
    a, b = one_sided[..., 0], one_sided[..., 1]
    return np.divide(2 * a * b, a + b, out=np.zeros(a.shape), where=a * b > 0)


def share_within(
    increment: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], slot: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return one factor (n,) <= 1 for each cell: the largest with which its increments are within [`low`, `high`]."""
    bound, share = np.where(increment > 0, high[slot], low[slot]), np.ones(len(low))
    excessive = (np.abs(increment) > np.abs(bound)).nonzero()[0]
    np.minimum.at(share, slot[excessive], bound[excessive] / increment[excessive])
    return share


def _bounds_of(jump: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest (<= 0) and the largest (>= 0) pressure difference of each cell to its neighbours."""
    return np.minimum(jump.min(axis=(1, 2)), 0), np.maximum(jump.max(axis=(1, 2)), 0)


def transport(old: PiecePressures, points: MaterialPoints, new: Pieces) -> NDArray[np.float64]:
    """Return the pressures (n,), in Pa, of new pieces.  If `old` has mass potentials, the result has potentials too."""
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
    share = common / new.fraction
    # rows are pressure and centroid; centroids of pieces are relative to the centroid of the domain
    sums, d = sum_by(owner, old.fraction * np.concatenate([old.slope, old.x], axis=1).T, n), old.x.shape[1]
    slope, centre = sums[:d], sums[d:]
    then = np.concatenate([old.pressure[None], old.x.T - centre[:, owner]])
    leaving = sum_by(owner, np.concatenate([left_fraction[None], left_fraction * then]), n)
    mean = np.divide(leaving[1:], leaving[0], out=np.zeros((len(then), n)), where=leaving[0] > 0)
    # the common part keeps its value, and the rest has the mean of the parts that left
    values = np.zeros((len(then), len(new_key)))
    values[:, match] = then[:, before]
    values = share * values + (1 - share) * mean[:, new.point]
    pressure = values[0]
    now = new.x.T - sum_by(new.point, new.fraction * new.x.T, n)[:, new.point]
    correction = np.add.reduce(slope[:, new.point] * (now - values[1:]))
    return pressure + _limited(correction, pressure, old, owner, new) * correction


def _limited(correction, pressure, old: PiecePressures, owner, new: Pieces) -> NDArray[np.float64]:
    """Return a factor <= 1 (m,) for each correction: the largest with which its domain's pressures are in bounds."""
    first, new_first = (of.searchsorted(np.arange(of[-1] + 1)) for of in (owner, new.point))
    low, high = np.minimum.reduceat(old.bounds[:, 0], first), np.maximum.reduceat(old.bounds[:, 1], first)
    margin = np.where(correction > 0, high[new.point] - pressure, low[new.point] - pressure)
    share = np.divide(margin, correction, out=np.ones(len(correction)), where=correction != 0)
    return np.minimum.reduceat(np.minimum(np.maximum(share, 0.0), 1.0), new_first)[new.point]


def halved_pieces(
    pieces: PiecePressures,
    points: tuple[MaterialPoints, MaterialPoints],
    into: NDArray[np.int64],
    storage: tuple[NDArray[np.float64], NDArray[np.float64]],
    bulk: float,
) -> PiecePressures:
    """Return one piece for each half of a divided domain.  Its pressure follows from the mean slope in the domain.

    `pieces`: pieces of the n old points.
    `points`: the n old points and the m new points, as a pair.
    `into` (m,): old point of each new point.
    `storage`, in 1/Pa: two arrays of storage coefficients, (n,) of old points and (m,) of new points.
    `bulk`, in Pa: bulk modulus of the fluid.
    """
    (old, new), n = points, len(points[0])
    order = np.argsort(into, kind="stable")
    size = new.volume0 * new.J
    fraction = size / sum_by(into, size, n)[into]
    cell = 1 + pieces.cell.max(initial=-1) + np.arange(len(new)) // n
    parts = Pieces(into[order], cell[order], fraction[order], new.x[order], np.empty((len(new), 0, 2)))
    given, of = pieces.potentials(bulk), old.id.searchsorted(pieces.id)
    potential = np.empty(len(new))
    potential[order] = transport(given, old, parts)
    store = storage[1] * size
    held = storage[0] * old.volume0 * old.J * sum_by(of, pieces.fraction * given.pressure, n)
    pressure = pressure_of(potential + _missing(held, store, potential, into)[into], bulk)
    slope, bounds = sum_by(of, pieces.fraction * pieces.slope.T, n).T, _outermost(pieces.bounds, of, n)
    cell, fraction = np.full(len(new), -1), np.ones(len(new))
    return PiecePressures(new.id, cell, fraction, pressure, new.x, slope[into], bounds[into])


def joined_pieces(
    pieces: PiecePressures,
    points: tuple[MaterialPoints, MaterialPoints],
    into: NDArray[np.int64],
    storage: tuple[NDArray[np.float64], NDArray[np.float64]],
    bulk: float,
) -> PiecePressures:
    """Return the pieces of merged points, one for each new point in each cell.

    `into` (n,): new point of each old point.
    For the other parameters see `halved_pieces`.
    """
    old, new = points
    order = np.argsort(old.id)
    of = order[np.searchsorted(old.id[order], pieces.id)]
    given, size = pieces.potentials(bulk), old.volume0 * old.J
    store = pieces.fraction * (storage[0] * size)[of]
    fraction = pieces.fraction * (size / sum_by(into, size, len(new))[into])[of]
    key = into[of] * (2 + pieces.cell.max(initial=-1)) + 1 + pieces.cell
    _, at, piece = np.unique(key, return_index=True, return_inverse=True)
    piece, m = piece.ravel(), len(at)
    weight = np.where(sum_by(piece, store, m)[piece] > 0, store, fraction)
    potential = means_of_rows(piece, weight, given.pressure, m)
    point, share = into[of][at], sum_by(piece, fraction, m)
    held = sum_by(into[of], store * given.pressure, len(new))
    potential += _missing(held, share * (storage[1] * new.volume0 * new.J)[point], potential, point)[point]
    x, slope = (means_of_rows(piece, fraction, rows, m) for rows in (pieces.x, pieces.slope))
    pressure = pressure_of(potential, bulk)
    bounds = _outermost(pieces.bounds, piece, m)
    return PiecePressures(new.id[point], pieces.cell[at], share, pressure, x, slope, bounds)


def _missing(
    held: NDArray[np.float64], store: NDArray[np.float64], potential: NDArray[np.float64], of: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the change of potentials, in Pa, after which each point contains the fluid volume `held`."""
    (total, now), n = sum_by(of, np.array([store, store * potential]), len(held)), len(held)
    return np.divide(held - now, total, out=np.zeros(n), where=total > 0)


def _outermost(bounds: NDArray[np.float64], of: NDArray[np.int64], n: int) -> NDArray[np.float64]:
    """Return the smallest lower bound and the largest upper bound for each index in `of`."""
    out = np.stack([np.full(n, np.inf), np.full(n, -np.inf)], axis=1)
    np.minimum.at(out[:, 0], of, bounds[:, 0])
    np.maximum.at(out[:, 1], of, bounds[:, 1])
    return out
