# SPDX-License-Identifier: MIT
"""Pressures and stresses at probes, at their places: fitted to cells and points around them (`LocalFit`).

Cells count that lie on a way to the probe through open faces, up to three away along each axis, and hold nothing but
what conducts and deforms as the probe's own material.  Of others only the flux tells: the pressure that it has on the
face between the two.  Pressures of drained sides count where these are, and the weight of the fluid is taken out, so
water at rest is exact.  No value passes those of the cells beside the probe's, of drained sides of its cell, or up to
other sides what the slope of the cells before has there.
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
from mpm_dolfinx.points.local_fit import RADIUS, LocalFit, near
from mpm_dolfinx.probing.probes import Probes
from mpm_dolfinx.stepping.grid_reset import OnGrid
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State

REACH = int(RADIUS)
"""Cells along each axis from that of a probe to the last one that counts: all that `LocalFit` gives weight."""


def probe_pressures(scene: Scene, state: State, probes: Probes) -> NDArray[np.float64]:
    """Return the pore pressures (m,), Pa, at the places of probes; on all processes together."""
    state = state if state.stays else state.at_owners(scene.grid)
    on_grid = scene.on_grid(state.as_cut)  # the next step has use for it
    gravity = state.stage.gravity_at(state.t)
    weight = np.zeros(scene.grid.dim) if gravity is None else scene.fluid.density * gravity
    return _Around(scene, state, on_grid, probes).pressures(weight)


class _Lattice:
    """The (2 REACH + 1)^d cells about those of probes, along the axes.

    number (m, cells): lexicographic, -1 outside of the grid; midpoint, size (m, cells, d), m; middle: which is the
    probe's own; stride (d,): from one to the next along each axis; beside: by axis and end, which cells have one there,
    and it.
    """

    def __init__(self, grid: Grid, cell: NDArray[np.int64]):
        d, width = grid.dim, 2 * REACH + 1
        copy, number = np.divmod(cell, grid.cells)
        index = np.stack(np.unravel_index(number, tuple(grid.shape)), axis=1)
        steps = np.stack(np.unravel_index(np.arange(width**d), (width,) * d), axis=1)
        there = index[:, None] + steps - REACH
        inside = ((there >= 0) & (there < grid.shape)).all(axis=2)
        number = grid.number(np.where(inside[:, :, None], there, 0).reshape(-1, d)).reshape(inside.shape)
        self.number = np.where(inside, number + copy[:, None] * grid.cells, -1)
        self.midpoint = grid.places(there, 0.5)
        self.size = np.broadcast_to(grid.widths_of(np.clip(there, 0, grid.shape - 1).reshape(-1, d)), (inside.size, d))
        self.size = self.size.reshape(there.shape)
        self.middle = len(steps) // 2
        self.stride = width ** np.arange(d)[::-1]
        self.beside = {}
        for axis, end in np.ndindex(d, 2):
            step = steps[:, axis] + 2 * end - 1
            rows = np.flatnonzero((step >= 0) & (step < width))
            self.beside[axis, end] = rows, rows + (2 * end - 1) * self.stride[axis]


class _Around:
    """What the cells around m probes hold, the same on every process.

    All (m, cells, ...): p, Pa; centroid (d,), m, from the probe; half: from the cell's midpoint; open (d, 2): shares of
    faces; kappa, shift (d,): see `Mobility`; counts, reached: see `_connected`.
    """

    def __init__(self, scene: Scene, state: State, on_grid: OnGrid, probes: Probes):
        self._grid = scene.grid
        self._contents = on_grid.contents
        cut = on_grid.cut
        points = cut.points
        d = scene.grid.dim
        m = len(probes.id)
        alike = np.column_stack([scene.materials.conducting(points), points.material])
        here, at = points.find(probes.id)
        own = np.zeros((m, d + 4))
        x = interpolate(points.corners[at], probes.xi[here]) if cut.domains else points.x[at]
        own[here] = np.column_stack([x, alike[at], cut.cells_at(at, x)])
        x, key, cell = np.split(over_all(scene.grid.comm, own), [d, d + 3], axis=1)
        self._lattice = lattice = _Lattice(scene.grid, cell[:, 0].astype(np.int64))
        self._x = x
        self._local, rows = self._gathered(on_grid, on_grid.pressures(state), cut.to_cells(alike))
        ends = np.cumsum([1, 1, d, d, d, 3])
        filled, p, self._half, self._kappa, self._shift, held, share = np.split(rows, ends, axis=2)
        self._filled = filled[..., 0] > 0
        self._p = p[..., 0]
        self._open = share.reshape(*share.shape[:2], d, 2)
        self._centroid = lattice.midpoint + self._half - x[:, None]
        self._counts, self._reached = self._connected(held == key[:, None])
        wet = Wet(cut, points, self._contents, state.t)
        self._sides = open_sides([one.placed(wet) for one in state.stage.feeding], d)

    def _gathered(self, on_grid: OnGrid, p: NDArray[np.float64], alike: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Return the local numbers (m, cells) of the cells that this process owns, else -1, and what all hold.

        p: of the filled owned cells, Pa; alike: of pieces (k, 3), what those have in common that conduct and deform
        alike.  The columns are one where a cell is filled, p, centroid, mobility, shift, `alike` or nan
        where pieces differ, and open shares.
        """
        grid = self._grid
        contents = self._contents
        number = self._lattice.number
        filled = contents.filled
        mobility = on_grid.resting_mobility()
        slot = contents.slot(on_grid.cut.cells)
        held = np.zeros((len(filled), 3))
        held[slot] = alike  # of any of the cell's pieces
        held[np.stack([sum_by(slot, other, len(filled)) > 0 for other in (alike != held[slot]).T], axis=1)] = np.nan
        one = np.ones((len(filled), grid.dim))
        kappa = mobility.mean[:, None] * (one if mobility.share is None else mobility.share)
        shift = 0 * one if mobility.shift is None else mobility.shift
        share = contents.open[filled].reshape(len(filled), 2 * grid.dim)
        rows = np.column_stack([one[:, 0], p, contents.centroid[filled], kappa, shift, held, share])
        local = np.where(number >= 0, grid.local(np.maximum(number, 0)), -1)
        local[local >= grid.num_owned] = -1
        own = local >= 0  # a process may have no cell
        local[own] = np.where(on_grid.active[local[own]], local[own], -1)
        out, (probe, place) = np.zeros((*local.shape, rows.shape[1])), np.nonzero(local >= 0)
        out[probe, place] = rows[contents.slot(local[probe, place])]
        return local, over_all(grid.comm, out)

    def _connected(self, same: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which cells (m, cells) count, and which lie behind open faces of these or of the probe's.

        Where none holds the probe's material alone, as in thin layers and where it changes from point to point, those
        of its material's number count, else all.

        same: (m, cells, 3) where cells hold nothing but the probe's conductivity, law of it, and material.
        """
        same = same & self._filled[:, :, None]
        levels = [same.all(axis=2), same[:, :, 2], self._filled]
        alike = levels[-1].copy()
        for level in levels[1::-1]:
            some = level.any(axis=1)
            alike[some] = level[some]
        start = np.zeros_like(alike)
        start[:, self._lattice.middle] = True
        reached, passes = start & self._filled, alike | start
        for _ in range(2 * REACH * self._grid.dim):
            for (axis, end), (here, there) in self._lattice.beside.items():
                reached[:, there] |= (reached & passes)[:, here] & self._opening(axis, end)
        return reached & alike, reached

    def _opening(self, axis: int, end: int) -> NDArray[np.bool_]:
        """Return between which cells, here and there by `_beside`, there is an open face (m, n)."""
        here, there = self._lattice.beside[axis, end]
        return (self._open[:, here, axis, end] > 0) & (self._open[:, there, axis, 1 - end] > 0)

    def pressures(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures (m,), Pa, at the probes; weight (d,), N/m^3: of the fluid."""
        comm = self._grid.comm
        head = self._p - self._centroid @ weight
        base, (low, high) = head[:, self._lattice.middle], self._bounds(head)
        at, offset, value, share, own = self._drained(weight)
        rows = [(at, offset, value, share)]
        if comm.rank == 0:  # what all know
            probe, place = np.nonzero(self._counts)
            rows += [(probe, self._centroid[probe, place], head[probe, place], np.ones(len(probe)))]
            rows += self._beside_others(head)
        fit = LocalFit(len(base), self._grid.dim, 2)
        for probe, away, values, part in rows:
            y = away / self._lattice.size[probe, self._lattice.middle]
            cells = y
            if not self._grid.even:
                cells = self._grid.in_cells(self._x[probe] + away) - self._grid.in_cells(self._x[probe])
            fit.add(probe, y, (values - base[probe])[:, None], near(cells) * part)
        least, most = (np.full(len(base), start) for start in (np.inf, -np.inf))
        np.minimum.at(least, at[own], value[own])
        np.maximum.at(most, at[own], value[own])
        low, high = np.minimum(low, over_all(comm, least, MPI.MIN)), np.maximum(high, over_all(comm, most, MPI.MAX))
        return np.clip(base + fit.values(comm)[:, 0], low, high)

    def _bounds(self, head: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the least and largest head (m,), Pa, of the probe's cell, those beside it, and up to its surface."""
        i = self._lattice.middle
        low, high = head[:, i].copy(), head[:, i].copy()
        for axis in range(self._grid.dim):
            stride, h = self._lattice.stride[axis], self._lattice.size[:, :, axis]
            beside = {}
            for way in (-1, 1):
                j = i + way * stride
                beside[way] = self._filled[:, j] & (self._open[:, i, axis, (way + 1) // 2] > 0)
                beside[way] &= self._open[:, j, axis, (1 - way) // 2] > 0
                low = np.where(beside[way], np.minimum(low, head[:, j]), low)
                high = np.where(beside[way], np.maximum(high, head[:, j]), high)
            for way in (-1, 1):
                j, k = i - way * stride, i - 2 * way * stride
                to, before = (
                    (head[:, a] - head[:, b])
                    / np.maximum(way * (self._centroid[:, a, axis] - self._centroid[:, b, axis]), h[:, i] / 2)
                    for a, b in ((i, j), (j, k))
                )
                before = np.where(self._counts[:, k], van_leer(np.stack([to, before], axis=1)), to)
                on = np.where(before * to > 0, np.sign(to) * np.minimum(np.abs(before), np.abs(2 * to - before)), 0.0)
                on = on * np.maximum(-way * self._centroid[:, i, axis], 0)
                on[~(self._counts[:, i] & self._counts[:, j] & beside[-way] & ~beside[way])] = 0.0
                low, high = low + np.minimum(on, 0), high + np.maximum(on, 0)
        return low, high

    def _beside_others(self, head: NDArray[np.float64]) -> list[tuple[NDArray, ...]]:
        """Return probes, offsets, heads and weights of faces between cells that count and others, by the flux there."""
        out = []
        for (axis, end), pair in self._lattice.beside.items():
            here, there = pair
            inward = (1 - 2 * end, 2 * end - 1)  # from the face
            ways = [
                np.maximum(self._lattice.size[:, cells, axis] / 2 + way * (self._half + self._shift)[:, cells, axis], 0)
                for way, cells in zip(inward, pair, strict=True)
            ]
            with np.errstate(divide="ignore", invalid="ignore"):
                own, other = (way / self._kappa[:, cells, axis] for way, cells in zip(ways, pair, strict=True))
                share = own / (own + other)
            meets = self._counts[:, here] & self._reached[:, there] & ~self._counts[:, there]
            probe, k = np.nonzero(meets & self._opening(axis, end) & np.isfinite(own) & np.isfinite(share))
            offset = self._centroid[probe, here[k]]
            offset[:, axis] -= inward[0] * ways[0][probe, k]
            rise = share[probe, k] * (head[probe, there[k]] - head[probe, here[k]])
            out.append((probe, offset, head[probe, here[k]] + rise, np.ones(len(k))))
        return out

    def _drained(self, weight: NDArray[np.float64]) -> tuple[NDArray, ...]:
        """Return probes, offsets, heads and weights of drained sides of cells that count, and which are of its own.

        A side counts once, by its middle: of several faces a fit would make slopes along it.
        """
        sides, d = self._sides, self._grid.dim
        probe, place = np.nonzero(self._counts & (self._local >= 0))
        cells, order = self._local[probe, place], np.argsort(sides.cells, kind="stable")
        first, last = (np.searchsorted(sides.cells[order], cells, side=side) for side in ("left", "right"))
        row = np.repeat(np.arange(len(cells)), last - first)
        face = order[np.arange(len(row)) + np.repeat(first - np.cumsum(last - first) + last - first, last - first)]
        flows = (sides.shape > 0)[face] & ~(sides.seeps[face] & (self._p[probe, place][row] <= sides.pressure[face]))
        row, face = row[flows], face[flows]
        offset, axis = self._centroid[probe, place][row] + sides.reach[face], np.abs(sides.normal[face]).argmax(axis=1)
        looks = 2 * axis + (sides.normal[face, axis] > 0)
        side, group = np.unique(2 * d * row + looks, return_inverse=True)
        area = np.linalg.norm(sides.area[face], axis=1)
        columns = np.column_stack([offset, sides.pressure[face] - offset @ weight]) * area[:, None]
        total = sum_by(group, area, len(side))
        means = np.stack([sum_by(group, column, len(side)) / total for column in columns.T], axis=1)
        row = side // (2 * d)
        return probe[row], means[:, :d], means[:, d], np.ones(len(row)), (place == self._lattice.middle)[row]


def probe_stresses(scene: Scene, state: State, probes: Probes) -> NDArray[np.float64]:
    """Return the effective stresses (m, 3, 3), Pa, at the places of probes; on all processes together."""
    comm, sizes = scene.grid.comm, list(map(len, scene.bodies))
    return fitted_at(comm, sizes, state.points, probes.id, probes.xi, scene.materials.effective_stress_3d)
