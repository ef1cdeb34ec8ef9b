# SPDX-License-Identifier: MIT
"""Given displacements of sides in the cells: their means are held firmly, what is left of them weakly.

A Q1 field cannot follow a side at more places than it has nodes for: held firmly at each of them, sides that are curved
or lie aslant to the grid would lock.  The weak part leaves no wave to itself that the means do not see.  It carries
the stress that the body has there, turned as the side is, so what holds takes the step's change of stress only, and
gives way by so much less.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.conditions.conditions import HOLD, WEAK
from mpm_dolfinx.grid.grid import Grid, among, sum_by
from mpm_dolfinx.parallel.exchange import over_all

ALIGNED = 1e-2
"""Slope of a side in a cell to an axis below which its cells can follow it, whatever they keep their volume."""
EVERYWHERE = 1e2
"""Stiffness of what holds each point of such a side across it, in units of (what resists) / (cell size).

Plateau (soil): halved 2.2e-05, doubled 1.7e-05, cells 3.0e-02.
"""
TENSE = 10
"""Share of the stress of a side that adds to its modulus: held with less than its stress it buckles.

Plateau (soil): halved 2.8e-06, doubled 4.7e-06, cells 3.0e-02.
"""
CARRIED = 0.3  # change of traction in a step, in units of what resists and stress: no body's stress changes so much


class HeldPoints(NamedTuple):
    """Points of integration on sides with given displacements; arrays over n points in owned cells.

    number, cell : (n,) condition, and local cell; area : (n,) reference area, m^(d-1); modulus, tension, resistance,
    firm : (n,) modulus to hold with, norm of the stress when the grid was reset, what resists, and what resists where
    nothing can give way, times area, N; x, gap : (n, d) position, and how far it is from where it is to be, m; given :
    (n, 2 d) given displacements at the start and the end of the step, m; normal : (n, d) area vector when the grid was
    reset, m^(d-1); force : (n, d) of the body's present stress, as the side turns it, N.
    """

    number: NDArray[np.int64]
    cell: NDArray[np.int32]
    area: NDArray[np.float64]
    modulus: NDArray[np.float64]
    tension: NDArray[np.float64]
    resistance: NDArray[np.float64]
    firm: NDArray[np.float64]
    x: NDArray[np.float64]
    gap: NDArray[np.float64]
    given: NDArray[np.float64]
    normal: NDArray[np.float64]
    force: NDArray[np.float64]


class HeldCells:
    """What holds given displacements: rows of means, one a condition and cell, and after these one a point.

    Parameters
    ----------
    grid
        Background grid.
    points
        The points of integration.

    Attributes
    ----------
    number, cell, x, shape, moments
        Of each row: condition, cell, mean position (m), mean shape functions, means of products of
        the components of the offset from the cell's midpoint.
    stiffness, limit
        By component, N/m: across a flat side along the grid that of what cannot give way; and force beyond which it is
        an artefact, N, for means.
    """

    def __init__(self, grid: Grid, points: HeldPoints):
        self.grid, p = grid, points
        key, at = np.unique(p.number * grid.num_local + p.cell, return_inverse=True)
        whole = sum_by(at, p.area, len(key))

        def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
            columns = values.reshape(len(values), int(np.prod(values.shape[1:]))).T
            columns = [sum_by(at, column, len(key)) for column in columns]
            return np.stack(columns, axis=1).reshape(len(key), *values.shape[1:])

        def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
            each = (slice(None), *(None,) * (values.ndim - 1))
            return total(p.area[each] * values) / whole[each]

        def both(means: NDArray, values: NDArray) -> NDArray:
            return np.concatenate([means, values])

        x = mean(p.x)
        gap = mean(p.gap)
        normal = total(p.normal)
        N = grid.shape_values(p.cell, p.x)
        off = p.x - x[at]
        cell = key % grid.num_local
        given, spread = mean(p.given), (mean(off**2) + NEAR * grid.sizes(cell) ** 2)[:, :, None]
        slopes = (mean(off[:, :, None] * (v - m[at])[:, None, :]) / spread for v, m in ((p.gap, gap), (p.given, given)))
        slope, rise = slopes
        along = 2 * normal**2 <= (normal**2).sum(axis=1, keepdims=True)
        self.number, self.cell = both(key // grid.num_local, p.number), both(key % grid.num_local, p.cell)
        self.x, self.shape = both(x, p.x), both(mean(N), N)
        local = p.x - grid.midpoints[p.cell]
        moments = {"squares": local[:, :, None] * local[:, None, :], "product": local.prod(axis=1)}
        self.moments = {name: both(mean(values), values) for name, values in moments.items()}
        against = p.modulus + TENSE * p.tension
        flat = normal**2 > (1 - ALIGNED**2) * (normal**2).sum(axis=1, keepdims=True)
        modulus = np.where(flat, total(p.firm)[:, None], total(p.modulus)[:, None])
        each = np.where(flat[at], EVERYWHERE * p.resistance[:, None], WEAK * against[:, None])
        h = [grid.sizes(cells).min(axis=-1, keepdims=True) for cells in (cell, p.cell)]
        self.stiffness = both(HOLD / h[0] * modulus, each / h[1])
        # at the end of a side a node's force may come by a small part of a cell
        short = np.maximum(1.0, grid.smallest_faces(cell) * grid.around(x) / whole)
        self.limit = CARRIED * total(p.resistance + TENSE * p.tension) * short
        self._gap, self._force = both(gap, p.gap), both(0 * gap, p.force)
        self._slope, self._along = both(slope, slope[at]), both(along, along[at])
        self._given, self._rise = both(given, given[at]), both(rise, rise[at])
        self._x = both(x, x[at])

    def rows(self, axis: int, given: NDArray[np.bool_], free: NDArray[np.bool_]) -> tuple:
        """Return which rows give a component, their gaps (k,), m, with what their force makes of them; what is refused.

        Where a wall that the side runs into holds nodes of the cell, these are asked for nothing: else its other nodes
        would make up for them, and others for these, to and fro along the side.  A side that is to move at the wall,
        by more than half of its motion beside it, bends over this cell; then its other nodes are held by it only where
        no other cell holds them.  It does all through a step if it is off its place at the start or the end of it.

        Parameters
        ----------
        axis
            The component.
        given : (conditions,)
            Which conditions give it.
        free : (nodes,)
            Which nodes no wall holds.

        Returns
        -------
        Rows (k,), their stiffnesses (k,) and gaps (k,), and the shares (k, 2^d) of their forces that they have on each
        node, but for what the wall bears; of a row that walls hold and that has to move, its index or -1.
        """
        grid, chosen = self.grid, np.flatnonzero(given[self.number])
        nodes, x, gap, N = (v[chosen] for v in (grid.cell_nodes[self.cell], self.x, self._gap[:, axis], self.shape))
        walled = ~free[nodes]
        held = ((N * ~walled).sum(axis=1) < NEAR) & (np.abs(gap) > NEAR * grid.least)
        stuck, asked = np.zeros_like(walled), np.repeat(gap[:, None], N.shape[1], axis=1)
        moved, rise = (v[chosen][..., axis :: grid.dim, None] for v in (self._given, self._rise))  # at both ends
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
        """Return which rows (k,) have nodes of a wall, `stuck` (k, 2^d), and others that all have rows without such.

        number, nodes, N : (k,), (k, 2^d) twice
            Conditions, nodes, and shape functions.
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
        return at_wall & (among(key, asked[found]) | ~some | stuck).all(axis=1)

    def beyond(
        self, row: NDArray[np.int64], axis: NDArray[np.int64], force: NDArray[np.float64], told: Collection[int]
    ) -> list[tuple[int, NDArray[np.float64]]]:
        """Return the conditions, but those told of, whose force is beyond its limit, and where (d,), m, it is most.

        A Q1 field that cannot have the means of two cells at once is pulled to and fro between them, as where a side
        lies along a grid line.  The body feels their sum at the nodes, and so does the reaction: a row is beyond its
        limit where what its condition does to its nodes is, besides its own force.

        Parameters
        ----------
        row, axis, force : (k,)
            Rows, their components, and their forces, N.
        told
            Numbers of conditions.
        """
        grid = self.grid
        comm = self.grid.comm
        asked = ~np.isin(self.number[row], list(told))
        row = row[asked]
        axis = axis[asked]
        force = force[asked]
        limit = np.append(self.limit, np.zeros(len(self.number) - len(self.limit)))[row]
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
