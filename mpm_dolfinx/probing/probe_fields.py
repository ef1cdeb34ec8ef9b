# SPDX-License-Identifier: MIT
"""Pore pressure and stress at probes, by a weighted fit to surrounding cells and material points (`local_fit`).

The fit uses cells that are connected to the probe's cell by open faces.  They are at most three cells away along each
axis.  Cells with soil of another conductivity or stiffness are excluded.  At faces to cells outside the fit, the fit
uses the face pressure of the two-point flux.  On drained sides the fit uses the prescribed pressure.  Heads are fitted
instead of pressures, so hydrostatic states are exact.  The result is bounded by the heads of the probe's cell, of the
neighbouring cells and of the drained sides in the probe's cell.  Towards an undrained side this bound is extrapolated
with the gradient of the head in the adjacent cells.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.faces import interpolate
from mpm_dolfinx.domains.fitted import fitted_at
from mpm_dolfinx.domains.pressure_transport import van_leer
from mpm_dolfinx.flow.feeding import Wet, open_sides
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.local_fit import RADIUS, fitted, near
from mpm_dolfinx.probing.probes import Probes
from mpm_dolfinx.stepping.grid_reset import OnGrid
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State

CELLS = int(RADIUS)
"""Largest distance along each axis, in cells, from a probe's cell to a cell with a weight in `local_fit`."""


def probe_pressures(scene: Scene, state: State, probes: Probes) -> NDArray[np.float64]:
    """Return the pore pressures (n,), in Pa, at n probes; all processes must call it."""
    state = scene.followed(state)
    state = state if state.stays else state.at_owners(scene.grid)
    on_grid = scene.on_grid(state.as_cut)  # cached for the next step
    gravity = state.stage.gravity_at(state.t)
    weight = np.zeros(scene.grid.dim) if gravity is None else scene.fluid.density * gravity
    return _Around(scene, state, on_grid, probes).pressures(weight)


class _Lattice:
    """Blocks of (2 `CELLS` + 1)^d cells around the cells of n probes.

    number (n, cells): lexicographic indices of the cells, -1 outside the grid.
    midpoint, size (n, cells, d): midpoints and sizes of the cells, in m.
    middle: index of the probe's cell in its block.
    stride (d,): increment of an index in the block along each axis.
    neighbours: two index arrays for each axis and end. They list the cells with a neighbour there, and the neighbours.
    """

    def __init__(self, grid: Grid, cell: NDArray[np.int64]):
        d, width = grid.dim, 2 * CELLS + 1
        copy, number = np.divmod(cell, grid.cells)
        index = np.stack(np.unravel_index(number, tuple(grid.shape)), axis=1)
        steps = np.stack(np.unravel_index(np.arange(width**d), (width,) * d), axis=1)
        place = index[:, None] + steps - CELLS
        inside = ((place >= 0) & (place < grid.shape)).all(axis=2)
        number = grid.number(np.where(inside[:, :, None], place, 0).reshape(-1, d)).reshape(inside.shape)
        self.number = np.where(inside, number + copy[:, None] * grid.cells, -1)
        self.midpoint = grid.places(place, 0.5)
        self.size = np.broadcast_to(grid.widths_of(np.clip(place, 0, grid.shape - 1).reshape(-1, d)), (inside.size, d))
        self.size = self.size.reshape(place.shape)
        self.middle = len(steps) // 2
        self.stride = width ** np.arange(d)[::-1]
        self.neighbours = {}
        for axis, end in np.ndindex(d, 2):
            step = steps[:, axis] + 2 * end - 1
            rows = np.flatnonzero((step >= 0) & (step < width))
            self.neighbours[axis, end] = rows, rows + (2 * end - 1) * self.stride[axis]


class _Around:
    """Data of the cells around n probes, equal on every process; arrays (n, cells, ...).

    p: pressures, in Pa.
    centroid (d,): vectors, in m, from the probe to the centroids of the material in the cells.
    half (d,): vectors, in m, from the midpoints of the cells to these centroids.
    open (d, 2): open fractions of the faces.
    kappa, shift (d,): see `Mobility`.
    counts, reached: see `_connected`.
    """

    def __init__(self, scene: Scene, state: State, on_grid: OnGrid, probes: Probes):
        self._grid = scene.grid
        self._contents = on_grid.contents
        cut = on_grid.cut
        points = cut.points
        d = scene.grid.dim
        m = len(probes.id)
        soils = np.column_stack([scene.materials.conducting(points), points.material])
        known, at = points.find(probes.id)
        own = np.zeros((m, d + 4))
        x = interpolate(points.corners[at], probes.xi[known]) if cut.domains else points.x[at]
        own[known] = np.column_stack([x, soils[at], cut.cells_at(at, x)])
        x, key, cell = np.split(over_all(scene.grid.comm, own), [d, d + 3], axis=1)
        self._lattice = lattice = _Lattice(scene.grid, cell[:, 0].astype(np.int64))
        self._x = x
        self._local, rows = self._gathered(on_grid, on_grid.pressures(state), cut.to_cells(soils))
        ends = np.cumsum([1, 1, d, d, d, 3])
        filled, p, self._half, self._kappa, self._shift, held, share = np.split(rows, ends, axis=2)
        self._filled = filled[..., 0] > 0
        self._p = p[..., 0]
        self._open = share.reshape(*share.shape[:2], d, 2)
        self._centroid = lattice.midpoint + self._half - x[:, None]
        self._counts, self._reached = self._connected(held == key[:, None])
        wet = Wet(cut, points, self._contents, state.t)
        self._sides = open_sides([one.placed(wet) for one in state.stage.feeding], d)

    def _gathered(self, on_grid: OnGrid, p: NDArray[np.float64], soils: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Return two arrays: local indices (n, cells) of filled owned cells, -1 for others, and data of all cells.

        p: pressures of the filled owned cells, in Pa.
        soils (k, 3): conductivity, index of the conductivity law, and material of each piece.
        Data columns: 1 for filled cells, p, `half`, `kappa`, `shift`, `soils` (nan if not unique), `open`.
        """
        grid = self._grid
        contents = self._contents
        number = self._lattice.number
        filled = contents.filled
        mobility = on_grid.resting_mobility()
        slot = contents.slot(on_grid.cut.cells)
        held = np.zeros((len(filled), 3))
        held[slot] = soils  # soil of any one piece in the cell
        held[np.stack([sum_by(slot, other, len(filled)) > 0 for other in (soils != held[slot]).T], axis=1)] = np.nan
        one = np.ones((len(filled), grid.dim))
        kappa = mobility.mean[:, None] * (one if mobility.share is None else mobility.share)
        shift = 0 * one if mobility.shift is None else mobility.shift
        share = contents.open[filled].reshape(len(filled), 2 * grid.dim)
        rows = np.column_stack([one[:, 0], p, contents.centroid[filled], kappa, shift, held, share])
        local = np.where(number >= 0, grid.locals[np.maximum(number, 0)], -1)
        local[local >= grid.num_owned] = -1
        own = local >= 0  # a cell of this process may be empty
        local[own] = np.where(on_grid.active.contains[local[own]], local[own], -1)
        out, (probe, place) = np.zeros((*local.shape, rows.shape[1])), np.nonzero(local >= 0)
        out[probe, place] = rows[contents.slot(local[probe, place])]
        return local, over_all(grid.comm, out)

    def _connected(self, same: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return two masks (n, cells): cells that the fit uses, and cells that open faces connect to the probe's cell.

        The fit uses cells that contain only the probe's soil. If there are none, it uses cells that contain only the
        probe's material. If there are none either, it uses all filled cells.

        same (n, cells, 3): whether all soil in a cell has the probe's conductivity, conductivity law and material.
        """
        same = same & self._filled[:, :, None]
        levels = [same.all(axis=2), same[:, :, 2], self._filled]
        groups = levels[-1].copy()
        for level in levels[1::-1]:
            some = level.any(axis=1)
            groups[some] = level[some]
        start = np.zeros_like(groups)
        start[:, self._lattice.middle] = True
        reached, passes = start & self._filled, groups | start
        pairs = [(*pair, passes[:, pair[0]] & self._opening(*side)) for side, pair in self._lattice.neighbours.items()]
        for _ in range(2 * CELLS * self._grid.dim):
            for one, other, leads in pairs:
                reached[:, other] |= reached[:, one] & leads
        return reached & groups, reached

    def _opening(self, axis: int, end: int) -> NDArray[np.bool_]:
        """Return a mask (n, pairs) of neighbouring cells along an axis: whether their common face is open."""
        one, other = self._lattice.neighbours[axis, end]
        return (self._open[:, one, axis, end] > 0) & (self._open[:, other, axis, 1 - end] > 0)

    def pressures(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures (n,), in Pa, at the probes; weight (d,): weight of the fluid per volume, N/m^3."""
        comm, head = self._grid.comm, self._p - self._centroid @ weight
        base, (low, high) = head[:, self._lattice.middle], self._bounds(head)
        at, offset, value, share, own = self._drained(weight)
        rows = [(at, offset, value, share)]
        if comm.rank == 0:  # data that are equal on all processes are added once
            probe, place = np.nonzero(self._counts)
            rows += [(probe, self._centroid[probe, place], head[probe, place], np.ones(len(probe)))]
            rows += self._outside_faces(head)
        probe, away, values, part = map(np.concatenate, zip(*rows, strict=True))
        y = cells = away / self._lattice.size[probe, self._lattice.middle]
        if not self._grid.even:
            cells = self._grid.in_cells(self._x[probe] + away) - self._grid.in_cells(self._x[probe])
        above = fitted(comm, len(base), 2, probe, y, (values - base[probe])[:, None], near(cells) * part)[:, 0]
        least, most = (np.full(len(base), start) for start in (np.inf, -np.inf))
        np.minimum.at(least, at[own], value[own])
        np.maximum.at(most, at[own], value[own])
        low, high = np.minimum(low, over_all(comm, least, MPI.MIN)), np.maximum(high, over_all(comm, most, MPI.MAX))
        return np.clip(base + above, low, high)

    def _bounds(self, head: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a lower and an upper bound (n,), in Pa, of the head at each probe; see the module's docstring."""
        i = self._lattice.middle
        low, high = head[:, i].copy(), head[:, i].copy()
        for axis in range(self._grid.dim):
            stride, h = self._lattice.stride[axis], self._lattice.size[:, :, axis]
            filled = {}
            for sign in (-1, 1):
                j = i + sign * stride
                filled[sign] = self._filled[:, j] & (self._open[:, i, axis, (sign + 1) // 2] > 0)
                filled[sign] &= self._open[:, j, axis, (1 - sign) // 2] > 0
                low = np.where(filled[sign], np.minimum(low, head[:, j]), low)
                high = np.where(filled[sign], np.maximum(high, head[:, j]), high)
            for sign in (-1, 1):
                j, k = i - sign * stride, i - 2 * sign * stride
                to, before = (
                    (head[:, a] - head[:, b])
                    / np.maximum(sign * (self._centroid[:, a, axis] - self._centroid[:, b, axis]), h[:, i] / 2)
                    for a, b in ((i, j), (j, k))
                )
                before = np.where(self._counts[:, k], van_leer(np.stack([to, before], axis=1)), to)
                on = np.where(before * to > 0, np.sign(to) * np.minimum(np.abs(before), np.abs(2 * to - before)), 0.0)
                on = on * np.maximum(-sign * self._centroid[:, i, axis], 0)
                on[~(self._counts[:, i] & self._counts[:, j] & filled[-sign] & ~filled[sign])] = 0.0
                low, high = low + np.minimum(on, 0), high + np.maximum(on, 0)
        return low, high

    def _outside_faces(self, head: NDArray[np.float64]) -> list[tuple[NDArray, ...]]:
        """Return for faces to cells outside the fit: probe, vector from the probe, head of two-point flux, weight."""
        out = []
        for (axis, end), pair in self._lattice.neighbours.items():
            own_cells, other_cells = pair
            inward = (1 - 2 * end, 2 * end - 1)  # from the face
            size, offset = self._lattice.size[:, :, axis], (self._half + self._shift)[:, :, axis]
            lengths = [
                np.maximum(size[:, i] / 2 + sign * offset[:, i], 0) for sign, i in zip(inward, pair, strict=True)
            ]
            with np.errstate(divide="ignore", invalid="ignore"):
                own, other = (length / self._kappa[:, i, axis] for length, i in zip(lengths, pair, strict=True))
                share = own / (own + other)
            outer = self._counts[:, own_cells] & self._reached[:, other_cells] & ~self._counts[:, other_cells]
            probe, k = np.nonzero(outer & self._opening(axis, end) & np.isfinite(own) & np.isfinite(share))
            offset = self._centroid[probe, own_cells[k]]
            offset[:, axis] -= inward[0] * lengths[0][probe, k]
            increment = share[probe, k] * (head[probe, other_cells[k]] - head[probe, own_cells[k]])
            out.append((probe, offset, head[probe, own_cells[k]] + increment, np.ones(len(k))))
        return out

    def _drained(self, weight: NDArray[np.float64]) -> tuple[NDArray, ...]:
        """Return for drained sides: probe, vector from the probe, head, weight, and whether in the probe's cell.

        For each side of a cell, the fit uses the mean head of all drained faces on this side. Heads of single faces
        would give false gradients.
        """
        sides, d = self._sides, self._grid.dim
        probe, place = np.nonzero(self._counts & (self._local >= 0))
        cells, order = self._local[probe, place], np.argsort(sides.cells, kind="stable")
        first, last = (np.searchsorted(sides.cells[order], cells, side=side) for side in ("left", "right"))
        row = np.repeat(np.arange(len(cells)), last - first)
        face = order[np.arange(len(row)) + np.repeat(first - np.cumsum(last - first) + last - first, last - first)]
        flows = (sides.shape > 0)[face] & ~(sides.seeps[face] & (self._p[probe, place][row] <= sides.pressure[face]))
        row, face = row[flows], face[flows]
        offset, axis = self._centroid[probe, place][row] + sides.offset[face], np.abs(sides.normal[face]).argmax(axis=1)
        direction = 2 * axis + (sides.normal[face, axis] > 0)
        side, group = np.unique(2 * d * row + direction, return_inverse=True)
        area = np.linalg.norm(sides.area[face], axis=1)
        columns = np.column_stack([offset, sides.pressure[face] - offset @ weight]) * area[:, None]
        total = sum_by(group, area, len(side))
        means = np.stack([sum_by(group, column, len(side)) / total for column in columns.T], axis=1)
        row = side // (2 * d)
        return probe[row], means[:, :d], means[:, d], np.ones(len(row)), (place == self._lattice.middle)[row]


def probe_stresses(scene: Scene, state: State, probes: Probes) -> NDArray[np.float64]:
    """Return the effective stresses (n, 3, 3), in Pa, at n probes; all processes must call it."""
    comm, sizes = scene.grid.comm, list(map(len, scene.bodies))
    return fitted_at(comm, sizes, state.points, probes.id, probes.xi, scene.materials.effective_stress_3d)
