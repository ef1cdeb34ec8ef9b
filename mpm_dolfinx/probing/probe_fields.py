# SPDX-License-Identifier: MIT
"""Pore pressure and stress at probes, which lie at any position in the bodies.

The pressure at a probe is a weighted polynomial fit (`local_fit`) to the pressures of cells.  The fit uses cells of the
same soil, at most three cells away.  Open faces must connect these cells to the cell of the probe.  The fit also uses
pressures on drained sides, and on faces between cells of the fit and other cells.  Heads are fitted instead of
pressures, so hydrostatic states are exact.

The fitted pressure is limited to the range of pressures in the cell of the probe, in the cells around it and on drained
sides.  The head is limited likewise.  Towards an undrained side, the gradients of both extend these ranges.

The stress at a probe is a fit to the stresses of material points.
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.faces import interpolate
from mpm_dolfinx.domains.fitted import fitted_at
from mpm_dolfinx.domains.pressure_transport import van_leer
from mpm_dolfinx.flow.feeding import Wet, open_sides
from mpm_dolfinx.grid.grid import Grid, means_of_rows, sum_by
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.local_fit import RADIUS, fitted, near
from mpm_dolfinx.probing.probes import Probes
from mpm_dolfinx.stepping.grid_reset import OnGrid
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State

CELLS = int(RADIUS)
"""Largest distance along each axis, in cells, between the cell of a probe and the cells of the fit."""


def probe_pressures(scene: Scene, state: State, probes: Probes) -> NDArray[np.float64]:
    """Return the pore pressures at the probes, in Pa.  All processes must call this function."""
    state = scene.followed(state)
    state = state if state.stays else state.at_owners(scene.grid)
    on_grid = scene.on_grid(state.as_cut)  # cached for the next step
    gravity = state.stage.gravity_at(state.t)
    weight = np.zeros(scene.grid.dim) if gravity is None else scene.fluid.density * gravity
    return _Around(scene, state, on_grid, probes).pressures(weight)


class _Lattice:
    """Blocks of cells, one around each of n probes.

    `number` (n, cells): lexicographic indices of the cells in the grid, or -1 outside the grid.
    `middle`: index of the probe's cell in its block.
    `stride` (d,): difference of the indices, in a block, of two neighbouring cells along each axis.
    `neighbours`: indices, in a block, of cells and of their neighbours, for each axis and end (0 or 1).
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
    """Values of the cells in blocks around n probes, as arrays (n, cells, ...).  All processes have the same arrays."""

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
        """Return arrays (n, cells, ...) with the local indices and the values of the cells in the blocks.

        An empty cell, or a cell of another process, has the index -1.

        `soils` (k, 3): conductivity, index of the conductivity law, and material of each piece.
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
        """Return a mask of the cells that the fit uses, and a mask of the cells connected to the cell of the probe.

        The fit uses cells that contain only the soil of the probe.  Without such cells, the fit uses cells with only
        the material of the probe, or else all filled cells.

        `same` (n, cells, 3): whether conductivity, conductivity law and material of all soil in a cell are as at the
        probe.
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
        """Return whether the common face is open to flow, for each pair of neighbouring cells along an axis."""
        one, other = self._lattice.neighbours[axis, end]
        return (self._open[:, one, axis, end] > 0) & (self._open[:, other, axis, 1 - end] > 0)

    def pressures(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures at the probes, in Pa.  `weight` (d,): weight of the fluid per volume, in N/m^3."""
        comm, head = self._grid.comm, self._p - self._centroid @ weight
        base = head[:, self._lattice.middle]
        at, offset, value, share, own = self._drained(weight)
        rows = [(at, offset, value, share)]
        if comm.rank == 0:  # data that are equal on all processes are added once
            probe, place = np.nonzero(self._counts)
            rows += [(probe, self._centroid[probe, place], head[probe, place], np.ones(len(probe)))]
            rows += self._outside_faces(head)
        probe, away, values, part = map(np.concatenate, zip(*rows, strict=True))
        y = away / self._lattice.size[probe, self._lattice.middle]
        cells = self._grid.in_cells(self._x[probe] + away) - self._grid.in_cells(self._x[probe])
        above = fitted(comm, len(base), 2, probe, y, (values - base[probe])[:, None], near(cells) * part)[:, 0]
        out = base + above
        for slope in (weight, 0 * weight):
            low, high = self._bounds(head, slope)
            side = value[own] + offset[own] @ slope
            np.minimum.at(low, at[own], side)
            np.maximum.at(high, at[own], side)
            out = np.clip(out, over_all(comm, low, MPI.MIN), over_all(comm, high, MPI.MAX))
        return out

    def _bounds(
        self, head: NDArray[np.float64], slope: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a lower and an upper bound of the pressure at each probe, in Pa.

        The bounds are the range of values in the cell of the probe and in the cells around it, also diagonally.  For a
        cell that is missing or outside the fit, differences along the axes are added to the value in the cell of the
        probe.  Along an axis without a cell of the fit, this difference is hydrostatic, or follows the gradient.  If
        the cell of the probe is not in the fit, only heads have bounds, because pressures may have a kink.

        `head` (n, cells), in Pa: pressures of cells, extended hydrostatically to the probe.
        `slope` (d,), in Pa/m: hydrostatic gradient to limit the pressure, or zero to limit the head.
        """
        i, strides = self._lattice.middle, self._lattice.stride
        centroid = self._centroid - self._centroid[:, i : i + 1]
        value = head + self._centroid @ slope
        known = self._filled & (self._counts if slope.any() else True)
        least, most = {}, {}
        for axis, sign in product(range(self._grid.dim), (-1, 1)):
            j = i + sign * strides[axis]
            filled = self._leads(i, axis, sign)
            distance = np.maximum(-sign * self._centroid[:, i, axis], 0)  # from the centroid to the probe
            hydrostatic = sign * distance * slope[axis]
            linear = hydrostatic + distance * self._gradient(head, axis, sign)
            change = filled * (head[:, j] - head[:, i] + centroid[:, j, axis] * slope[axis])
            ends = np.stack([0 * change, change, *np.where(filled & known[:, j], 0.0, [hydrostatic, linear])])
            least[axis, sign], most[axis, sign] = ends.min(axis=0), ends.max(axis=0)
        low, high = np.zeros((2, len(value)))
        connected = {}
        for step in sorted(product((-1, 0, 1), repeat=self._grid.dim), key=np.count_nonzero):
            j, moved = i + strides @ step, [(axis, sign) for axis, sign in enumerate(step) if sign]
            connected[step] = np.full(len(value), not moved)
            for axis, sign in moved:
                before = (*step[:axis], 0, *step[axis + 1 :])
                connected[step] |= connected[before] & self._leads(j - sign * strides[axis], axis, sign)
            change, unknown = connected[step] * (value[:, j] - value[:, i]), ~(connected[step] & known[:, j])
            low = np.minimum(low, np.minimum(change, unknown * sum(least[one] for one in moved)))
            high = np.maximum(high, np.maximum(change, unknown * sum(most[one] for one in moved)))
        limited = known[:, i] | (not slope.any())
        return value[:, i] + np.where(limited, low, -np.inf), value[:, i] + np.where(limited, high, np.inf)

    def _leads(self, cell: int, axis: int, sign: int) -> NDArray[np.bool_]:
        """Return whether the next cell along an axis is filled, and connected to a cell of each block."""
        other, end = cell + sign * self._lattice.stride[axis], (sign + 1) // 2
        is_open = (self._open[:, cell, axis, end] > 0) & (self._open[:, other, axis, 1 - end] > 0)
        return self._filled[:, other] & is_open

    def _gradient(self, head: NDArray[np.float64], axis: int, sign: int) -> NDArray[np.float64]:
        """Return the gradient of the head, in Pa/m, in the cell of each probe towards a side.

        The gradient is zero if the head is not monotone, or if the opposite neighbour is not in the fit.
        """
        i, back = self._lattice.middle, -sign * self._lattice.stride[axis]
        j, k = i + back, i + 2 * back
        half, place = self._lattice.size[:, :, axis] / 2, sign * self._centroid[:, :, axis]
        to = (head[:, i] - head[:, j]) / np.maximum(place[:, i] - place[:, j], half[:, j])
        before = (head[:, j] - head[:, k]) / np.maximum(place[:, j] - place[:, k], half[:, k])
        before = np.where(self._counts[:, k], van_leer(np.stack([to, before], axis=1)), to)
        out = np.where(before * to > 0, np.sign(to) * np.minimum(np.abs(before), np.abs(2 * to - before)), 0.0)
        return np.where(self._counts[:, i] & self._counts[:, j] & self._leads(i, axis, -sign), out, 0.0)

    def _outside_faces(self, head: NDArray[np.float64]) -> list[tuple[NDArray, ...]]:
        """Return arrays for faces between cells in and outside the fit: index of probe, position, head, weight."""
        out = []
        for (axis, end), pair in self._lattice.neighbours.items():
            own_cells, other_cells = pair
            inward = (1 - 2 * end, 2 * end - 1)  # signs of directions from the face into both cells
            size, offset = self._lattice.size[:, :, axis], (self._half + self._shift)[:, :, axis]
            lengths = [np.maximum(size[:, i] / 2 + s * offset[:, i], 0) for s, i in zip(inward, pair, strict=True)]
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
        """Return arrays for drained sides: index of probe, position, head, weight, whether the cell has the probe.

        Positions and heads are means over all drained faces on the side.
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
        columns = np.column_stack([offset, sides.pressure[face] - offset @ weight])
        means = means_of_rows(group, area, columns, len(side))
        row = side // (2 * d)
        return probe[row], means[:, :d], means[:, d], np.ones(len(row)), (place == self._lattice.middle)[row]


def probe_stresses(scene: Scene, state: State, probes: Probes) -> NDArray[np.float64]:
    """Return the effective stresses (n, 3, 3) at the probes, in Pa.  All processes must call this function."""
    comm, sizes = scene.grid.comm, list(map(len, scene.bodies))
    return fitted_at(comm, sizes, state.points, probes.id, probes.xi, scene.materials.effective_stress_3d)
