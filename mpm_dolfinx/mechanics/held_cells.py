# SPDX-License-Identifier: MIT
"""Penalties of prescribed displacements in the cells at a side.

In each cell, a stiff penalty acts on the mean displacement of the side, and a weak penalty on the deviations from this
mean.  A stiff penalty at each point would lock sides that are curved or inclined to the grid.  The traction at the
start of the step is applied as a load, so the penalties carry only the increment of the traction.

With inertia, a second penalty acts on the displacement increment of the step.  Its modulus is rho (h / (gamma dt))^2,
with the density rho, the cell size h and `GAMMA`.  This penalty prevents a lag of the side in short steps.  An earlier
lag, and its slope along the side, do not enter this penalty.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR, TINY
from mpm_dolfinx.conditions.conditions import HOLD
from mpm_dolfinx.grid.grid import Grid, among, means_of_rows, sum_by, sums_of_rows
from mpm_dolfinx.mechanics.ghost_penalty import RATIO
from mpm_dolfinx.parallel.exchange import over_all

ALIGNED = 1e-2
"""A side has a stiff penalty at each point if its slope relative to a grid axis is at most this value.  Sensitivity
(scene "held" of tests/plateaus.py): half this value changes the result by 0.0e+00, and twice this value by 1.4e-05.
Finer cells change it by 4.0e-03.
"""
WEAK = 8.0
"""Stiffness of the weak penalty on deviations from the mean, divided by (modulus + 10 stress) / cell size.  Sensitivity
(scene "soil" of tests/plateaus.py): half this value changes the result by 5.0e-06, and twice this value by 7.9e-06.
Finer cells change it by 3.0e-02.
"""
EVERYWHERE = 1e2
"""Normal stiffness at points of sides with slopes below `ALIGNED`, divided by modulus / cell size.  Sensitivity (scene
"soil" of tests/plateaus.py): half this value changes the result by 2.2e-05, and twice this value by 1.7e-05.  Finer
cells change it by 3.0e-02.
"""
TENSE = 10
"""The modulus of the weak penalty is the soil's modulus plus this factor times the norm of the stress.  The stress term
prevents buckling of the side.  Sensitivity (scene "soil" of tests/plateaus.py): half this value changes the result by
2.8e-06, and twice this value by 4.7e-06.  Finer cells change it by 3.0e-02.
"""


class HeldPoints(NamedTuple):
    """Integration points on sides with prescribed displacements, as arrays for n points in owned cells."""

    number: NDArray[np.int64]  # (n,) index of the condition
    cell: NDArray[np.int32]  # (n,) local cell
    area: NDArray[np.float64]  # (n,) reference area, m^(d-1)
    modulus: NDArray[np.float64]  # (n,) penalty modulus times area, N; fields up to `undrained`: at the last reset
    tension: NDArray[np.float64]  # (n,) norm of the stress times area, N
    resistance: NDArray[np.float64]  # (n,) resisting modulus times area, N
    confined: NDArray[np.float64]  # (n,) confined modulus times area, N, with a limited contribution of the fluid
    undrained: NDArray[np.float64]  # (n,) undrained confined modulus times area, N
    inertial: NDArray[np.float64]  # (n,) rho (h / (gamma dt))^2 times area, N; 0 without inertia
    x: NDArray[np.float64]  # (n, d) position, m
    gap: NDArray[np.float64]  # (n, d) prescribed position minus present position, m
    step: NDArray[np.float64]  # (n, d) prescribed displacement since the start of the step, plus any jump, m
    given: NDArray[np.float64]  # (n, 2 d) prescribed displacements at start and end of the step, m
    normal: NDArray[np.float64]  # (n, d) area vector at the last reset of the grid, m^(d-1)
    force: NDArray[np.float64]  # (n, d) force of the present stress, rotated with the side, N


def inner_cells(
    grid: Grid,
    fill: NDArray[np.float64],
    sides: Sequence[tuple[Collection[int], NDArray[np.float64]]],
    number: NDArray[np.int64],
    cell: NDArray[np.int32],
    normal: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Return the local cell (n,) of each point on a side: the cell whose penalty on the mean includes the point.

    Points in nearly empty cells belong to the penalty of the next cell inside the body (aggregation; Badia, Verdugo and
    Martin 2018).

    `fill` (cells,): volume fractions.
    `sides`: for each condition, the prescribed components, and the extent (d,), in m, of the prescribed positions.
    `number` (n,): index of each point's condition.
    `cell` (n,): owned cell of each point.
    `normal` (n, d): outward area vector of each point.
    """
    inner = cell.astype(np.int64)
    for k, (axes, extent) in enumerate(sides):
        axis = (extent / grid.finest).argmin()
        if axis not in axes or extent[axis] > ALIGNED * grid.finest[axis]:
            continue
        own, side = (number == k).nonzero()[0], fem.Function(grid.cellwise()).x
        side.array[cell[own]] = 1.0
        side.scatter_forward()
        neighbour = grid.neighbours(cell[own])[np.arange(len(own)), axis, (normal[own, axis] < 0).astype(int)]
        aggregated = (neighbour >= 0) & (side.array[neighbour] > 0) & (fill[cell[own]] < RATIO * fill[neighbour])
        inner[own[aggregated]] = neighbour[aggregated]
    return inner


class HeldCells:
    """Penalties of prescribed displacements: first the penalties on cell means, then the penalties at points.

    Attributes
    ----------
    number, cell
        Index of the condition, and local cell, of each penalty.
    x, shape, moments
        Of each penalty, `x`: position (m), `shape`: shape functions, `moments`: products of offsets from the cell's
        midpoint.  For a penalty on a mean, these values are means over the side too.
    stiffness
        Stiffness of each penalty and component, N/m.
    static
        Fraction of each stiffness that does not come from inertia.
    limit : (2, k, d)
        Largest plausible force, N, of each of k penalties on means: limit[0] for the skeleton, limit[1] for undrained
        soil.  Larger forces would cause strains above 1 in a step.
    path
        Increment (d,) of the prescribed displacement in the step, m, for each penalty.
    """

    def __init__(self, grid: Grid, points: HeldPoints):
        self.grid, p = grid, points
        key, at = np.unique(p.number * grid.num_local + p.cell, return_inverse=True)
        whole = sum_by(at, p.area, len(key))

        def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return sums_of_rows(at, values, len(key))

        def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return means_of_rows(at, p.area, values, len(key))

        def both(means: NDArray, values: NDArray) -> NDArray:
            return np.concatenate([means, values])

        x = mean(p.x)
        gap = mean(p.gap)
        normal = total(p.normal)
        N = grid.shape_values(p.cell, p.x)
        off = p.x - x[at]
        cell = key % grid.num_local
        given, spread = mean(p.given), (mean(off**2) + NEAR * grid.sizes(cell) ** 2)[:, :, None]
        step = mean(p.step)
        pairs = (p.gap, gap), (p.given, given), (p.step, step)
        slopes = (mean(off[:, :, None] * (v - m[at])[:, None, :]) / spread for v, m in pairs)
        slope, rise, turn = (both(of, of[at]) for of in slopes)
        along = 2 * normal**2 <= (normal**2).sum(axis=1, keepdims=True)
        self.number, self.cell = both(key // grid.num_local, p.number), both(key % grid.num_local, p.cell)
        self.x, self.shape = both(x, p.x), both(mean(N), N)
        local = p.x - grid.midpoints[p.cell]
        moments = {"squares": local[:, :, None] * local[:, None, :], "product": local.prod(axis=1)}
        self.moments = {name: both(mean(values), values) for name, values in moments.items()}
        flat = normal**2 > (1 - ALIGNED**2) * (normal**2).sum(axis=1, keepdims=True)
        h = [grid.sizes(cells).min(axis=-1, keepdims=True) for cells in (cell, p.cell)]
        weights = both(np.full(normal.shape, HOLD) / h[0], np.where(flat[at], EVERYWHERE, WEAK) / h[1])
        means = np.where(flat, total(p.confined)[:, None], total(p.modulus)[:, None])
        at_points = np.where(flat[at], p.resistance[:, None], (p.modulus + TENSE * p.tension)[:, None])
        static = weights * both(means, at_points)
        # the inertia of a cell resists a short step more than its stiffness
        inert = weights * both(total(p.inertial), p.inertial)[:, None]
        self.stiffness = static + inert
        self.static = static / self.stiffness
        # at the end of a side, a small area in a cell may bear the whole force of a node
        short = np.maximum(1.0, grid.smallest_faces(cell) * grid.around(x) / whole)
        outward = normal**2 / np.maximum((normal**2).sum(axis=1, keepdims=True), TINY)
        skeleton = total(p.resistance + TENSE * p.tension + p.inertial)[:, None]
        more = outward * np.maximum(total(p.undrained) - total(p.resistance), 0.0)[:, None]
        self.limit = short[:, None] * np.stack([skeleton + 0 * more, skeleton + more])
        self._gap, self._force = both(gap, p.gap), both(0 * gap, p.force)
        if inert.any():  # a gap at the start causes no velocity
            self._gap = self.static * self._gap + (1 - self.static) * both(step, p.step)
            slope = self.static[:, None] * slope + (1 - self.static[:, None]) * turn
        self._slope, self._along = slope, both(along, along[at])
        self._given, self._rise = both(given, given[at]), rise
        self._x = both(x, x[at])
        self.path = np.diff(self._given.reshape(-1, 2, grid.dim), axis=1)[:, 0]

    def rows(self, axis: int, given: NDArray[np.bool_], free: NDArray[np.bool_]) -> tuple:
        """Return the penalties on one component, with their stiffness, gap and distribution of the force to nodes.

        If the prescribed displacement does not tend to zero at a wall, the wall carries the force on its nodes.  A
        penalty at a wall is omitted if another penalty of the same condition acts on one of the same free nodes.

        `given` (conditions,): whether each condition prescribes component `axis`.
        `free` (nodes,): whether no wall fixes the node.

        Returns
        -------
        `index` (k,): indices of the penalties.
        `stiffness` (k,), in N/m: stiffness of these penalties.
        `gap` (k,), in m: gaps of these penalties.
        `share` (k, 2^d): fraction of the force of each penalty on each node, without the fraction that walls carry.
        `stuck`: index of a penalty that must move but has fixed nodes only, or -1.
        """
        grid, chosen = self.grid, np.flatnonzero(given[self.number])
        nodes, x, gap, N = (v[chosen] for v in (grid.cell_nodes[self.cell], self.x, self._gap[:, axis], self.shape))
        walled = ~free[nodes]
        held = ((N * ~walled).sum(axis=1) < NEAR) & (np.abs(gap) > NEAR * grid.least)
        stuck, asked = np.zeros_like(walled), np.repeat(gap[:, None], N.shape[1], axis=1)
        moved, rise = (v[chosen][..., axis :: grid.dim, None] for v in (self._given, self._rise))  # at both times
        torn = np.zeros(len(chosen), dtype=bool)
        for b in range(grid.dim):
            for sign in (-1, 1):
                here = grid.signs[:, b] == sign
                at_wall = (walled[:, here].all(axis=1) & self._along[chosen, b])[:, None] & here
                asked += at_wall * ((grid.node_x[nodes, b] - x[:, b, None]) * self._slope[chosen, b, axis, None])
                stuck |= at_wall
                there = moved + rise[:, b] * (grid.node_x[nodes, b] - self._x[chosen, b, None])[:, None]
                torn |= (at_wall[:, None] & (np.abs(there) > np.abs(moved) / 2)).any(axis=(1, 2))
        kept = ~self._held_beside(self.number[chosen], nodes, N, stuck & torn[:, None])
        stiffness = self.stiffness[chosen, axis]
        gap = gap - (N * stuck * asked).sum(axis=1) + self._force[chosen, axis] / stiffness
        own = N * ~(stuck & torn[:, None])
        return *(rows[kept] for rows in (chosen, stiffness, gap, own)), chosen[held][0] if held.any() else -1

    def _held_beside(
        self, number: NDArray[np.int64], nodes: NDArray[np.int32], N: NDArray[np.float64], stuck: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return a mask of penalties at a wall that share a free node with another penalty of the same condition.

        `N` (k, 2^d): values of the shape functions of the nodes.
        `stuck` (k, 2^d): whether each node is at a wall.
        """
        grid = self.grid
        at_wall = stuck.any(axis=1)
        some = N > NEAR
        if not over_all(grid.comm, int(at_wall.sum())):
            return at_wall
        shape = (*(grid.shape + 1), grid.copies)
        place = np.ravel_multi_index(tuple(grid.node_places(nodes.ravel()).T), shape).reshape(nodes.shape)
        key = place + number[:, None] * np.prod(shape)
        asked = np.unique(np.concatenate(grid.comm.allgather(key[(some & ~stuck) & at_wall[:, None]])))
        found = over_all(grid.comm, np.isin(asked, key[some & ~at_wall[:, None]]).astype(np.int64)) > 0
        return at_wall & (among(key, asked[found]) & some & ~stuck).any(axis=1)

    def beyond(
        self, row: NDArray, axis: NDArray, force: NDArray, reached: NDArray[np.bool_], reported: Collection[int]
    ) -> list[tuple[int, NDArray[np.float64]]]:
        """Return the conditions with implausibly large forces, each with the position of its largest force.

        The sum of the forces at a node must also exceed the sum of their limits: penalties in neighbouring cells may
        oppose each other.

        `row` (k,): index of the penalty of each of k prescribed components.
        `axis` (k,): axis of each component.
        `force` (k,), in N: force of each component.
        `reached` (k,): whether each component is at its prescribed position.
        `reported`: indices of conditions to exclude.
        """
        grid = self.grid
        comm = grid.comm
        unreported = ~np.isin(self.number[row], list(reported))
        row, axis, force, reached = (values[unreported] for values in (row, axis, force, reached))
        limit = np.concatenate([self.limit, np.zeros((2, len(self.number) - self.limit.shape[1], grid.dim))], axis=1)
        limit = limit[reached.astype(int), row, axis]
        far = np.unique(self.number[row[np.abs(force) > np.where(limit > 0, limit, np.inf)]])
        suspected = sorted({int(k) for numbers in comm.allgather(far) for k in numbers})
        if not suspected:
            return []
        mine = np.isin(self.number[row], suspected)
        node = grid.nodes_along(grid.node_x[grid.cell_nodes[self.cell[row[mine]]]])
        columns = (self.number[row[mine]], axis[mine], force[mine], limit[mine], node, self.shape[row[mine]])
        rows = (*columns, self.x[row[mine]])
        number, axis, force, limit, node, N, x = map(np.concatenate, zip(*comm.allgather(rows), strict=True))
        key = np.concatenate([np.tile(np.stack([number, axis], axis=1)[:, None], (1, N.shape[1], 1)), node], axis=2)
        _, at = np.unique(key.reshape(-1, key.shape[2]), axis=0, return_inverse=True)
        size = at.max() + 1
        at = at.reshape(N.shape)
        on_nodes, most = (sum_by(at.ravel(), (N * v[:, None]).ravel(), size) for v in (force, limit))
        ratio = np.divide(np.abs(on_nodes), most, out=np.zeros(size), where=most > 0)
        net = (N * ratio[at]).sum(axis=1)
        net = np.where((np.abs(force) > limit) & (limit > 0), net, 0.0)
        worst = [np.where(number == k, net, 0.0).argmax() for k in suspected]
        return [(k, x[i]) for k, i in zip(suspected, worst, strict=True) if number[i] == k and net[i] > 1]
