# SPDX-License-Identifier: MIT
"""The lattice of corners that a body was seeded with, and the filter of what only neighbouring domains can see.

A wave of two domains in the displacement of the corners moves no node of the grid, so that no stress acts against it:
what crossing grid lines leaves of it would add up from cycle to cycle.  When the grid is reset the corners lose it,

    d <- d - D_a^T s / 64 D_a d     for one axis a after the other, the mean over all orders of the axes,

d their displacement since they were at rest, D_a the third difference along axis a where the lattice has four corners
in a row (of rows of many widths the divided one, of weights as large in sum), s = `FAST` times the cells that they have
crossed, at most 1: what hardly moves is left alone.  Quadratic fields stay as they are, also at the surface; along its
axis a wave of two domains is taken away by the share s, one of eight by 0.003 s.  Nothing is filtered where domains
have parted from their neighbours, and where soil has yielded: it does not come back, and its kinks are its own.
Corners that a wall, a given displacement, a plate or another body holds stay where they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.boxes import RowsBody
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.bodies.touching import Faces, covers
from mpm_dolfinx.grid.grid import SIDES, Grid, among, in_chunks
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.cutting import FACES
from mpm_dolfinx.points.material_points import MaterialPoints

FAST = 10
"""Share of a wave of two domains that is taken away, over the cells that it has crossed; at most all of it.

Plateau (cycles): halved 1.5e-04, doubled 3.4e-04, cells 6.2e-03.
"""
THIRD = (-1, 3, -3, 1)
MARGIN = len(THIRD) - 1
"""Layers of a lattice on both sides that the change of one depends on."""


class Lattice:
    """The domains and corners of a body that is there, and which corners are held; a mesh is not filtered.

    Parameters
    ----------
    body, start
        The body, and the number of its first point.
    given : (faces, axes)
        Faces of a side, and the components that a condition gives them.
    joined : (rows, corners)
        Domains (m,) that touch other bodies, and which of their corners (m, 4) do.
    """

    def __init__(
        self,
        body: Body,
        start: int,
        given: Iterable[tuple[Surface, Iterable[int]]],
        joined: tuple[NDArray[np.int64], NDArray[np.int64]],
    ):
        self._body = body
        self._start = start
        self._stop = start + len(body)
        self._dim, self._count = body.dim, body.lattice
        self._thirds = None
        if isinstance(body, RowsBody):
            self._thirds = [_divided(body.corner_rows(axis)) for axis in range(self._dim)]
        self._numbers: Latest[NDArray[np.int64]] = Latest()
        self._parted = np.append(np.full(self._dim, NEAR * body.spacing.min()), NEAR)
        # the numbers of corners that are held: a flag for each corner would be as large as the body, on every process
        self._joined = np.unique(np.take_along_axis(body.nodes(joined[0]), joined[1], axis=1))
        of_axes = [[np.empty(0, dtype=np.int64)] for _ in range(self._dim)]
        for faces, axes in given:
            here = (faces.id >= self._start) & (faces.id < self._stop)
            corners = body.nodes(faces.id[here] - self._start), FACES[self._dim][faces.face[here]]
            for axis in axes:
                of_axes[axis].append(np.take_along_axis(*corners, axis=1).ravel())
        self._given = [np.unique(np.concatenate(numbers)) for numbers in of_axes]
        self._held: Latest[tuple[NDArray[np.bool_], NDArray[np.bool_]]] = Latest()

    def rows(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return which points are the body's."""
        return np.flatnonzero((points.id >= self._start) & (points.id < self._stop))

    def given(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which components (m, 2^d, d) of the corners of domains conditions give."""
        return self._held_of(ids)[0]

    def _held_of(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return `given` of domains, and which of their corners (m, 2^d) other bodies hold."""

        def held() -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
            number = self._nodes(ids)
            return np.stack([among(number, of_axis) for of_axis in self._given], axis=2), among(number, self._joined)

        return self._held(ids, held)

    def _nodes(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers (m, 2^d) of the corners of domains."""
        return self._numbers(ids, lambda: self._body.nodes(ids - self._start))

    def corners_change(
        self, comm: MPI.Intracomm, ids: NDArray[np.int64], d: NDArray[np.float64], crossed: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return what the filter adds (m, 2^d, d), m, to the displacements d, alike, of the corners of domains.

        crossed (m, 2^d): cells that they have crossed since the grid was reset.
        """
        if self._count is None:
            return np.zeros_like(d)
        number = self._nodes(ids)
        values = np.concatenate([d, crossed[:, :, None]], axis=2).reshape(-1, self._dim + 1)
        shape = tuple(np.add(self._count, 1))
        change = _change(comm, shape, number.ravel(), values, self._parted, self._thirds).reshape(d.shape)
        change[self._held_of(ids)[1]] = 0.0
        return change


def _change(
    comm: MPI.Intracomm,
    shape: tuple[int, ...],
    number: NDArray[np.int64],
    values: NDArray[np.float64],
    parted: NDArray[np.float64],
    thirds: Sequence[NDArray[np.float64]] | None = None,
) -> NDArray[np.float64]:
    """Return what the filter adds (m, k) to values at places of a lattice.

    Processes share out the lattice by slabs across its first axis.

    Parameters
    ----------
    shape, number
        Places along each axis; lexicographic number (m,) of each row's place, which may have several.
    values : (m, k + 1)
        Values, and last how many cells their place has crossed.
    parted : (k + 1,)
        Places of which some of these differ by more are nobody's neighbours.
    thirds : (4, n - 3) along each axis
        Weights of third differences along n corners in rows of many widths, see `_divided`.
    """
    across, starts = int(np.prod(shape[1:])), np.arange(comm.size + 1) * shape[0] // comm.size
    layer = number // across
    home = np.searchsorted(starts, layer, side="right") - 1
    to_home = Exchange(comm, home)
    rows = [(to_home.send(number), to_home.send(values))]
    for other in range(-MARGIN, MARGIN + 1) if comm.size > 1 else ():  # a slab may be one layer thin
        to = np.clip(home + other, 0, comm.size - 1)
        near = (to != home) & (to == home + other) & (layer >= starts[to] - MARGIN) & (layer < starts[to + 1] + MARGIN)
        halo = Exchange(comm, to[near])
        rows.append((halo.send(number[near]), halo.send(values[near])))
    first = max(0, starts[comm.rank] - MARGIN)
    last = min(shape[0], starts[comm.rank + 1] + MARGIN)
    rows = [(at - first * across, d) for at, d in rows]
    field = np.full(((last - first) * across, values.shape[1]), np.nan)
    for at, d in rows:
        field[at] = d
    for at, d in rows:
        for part in in_chunks(len(at)):
            here = at[part]
            field[here[(np.abs(field[here] - d[part]) > parted).any(axis=1)]] = np.nan
    field = field.reshape(-1, *shape[1:], values.shape[1])
    if thirds is not None:  # of this slab
        thirds = [thirds[0][:, first : max(first, last - MARGIN)], *thirds[1:]]
    change = np.nan_to_num(_filtered(field[..., :-1], field[..., -1:], thirds) - field[..., :-1])
    return to_home.back(change.reshape(-1, values.shape[1] - 1)[rows[0][0]])


def _filtered(
    d: NDArray[np.float64],
    crossed: NDArray[np.float64],
    thirds: Sequence[NDArray[np.float64]] | None = None,
    axes: tuple[int, ...] | None = None,
) -> NDArray[np.float64]:
    """Return a box (..., k) of values after the filter along axes, by default all; nan stands for no place.

    Filters along two axes do not commute where the share differs, so the mean over their orders is taken: a body that
    is turned by a right angle is filtered alike.
    """
    if axes is None:
        axes = tuple(axis for axis, count in enumerate(d.shape[:-1]) if count >= len(THIRD))
    if not axes:
        return d
    by = [None] * (d.ndim - 1) if thirds is None else thirds
    orders = [_filtered(_along(d, crossed, a, by[a]), crossed, thirds, tuple(b for b in axes if b != a)) for a in axes]
    return sum(orders[1:], orders[0]) / len(orders)


def _divided(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights (4, n - 3) of third differences at places (n,): quadratics have none, alternation has 8."""
    rows = np.stack([x[k : max(k, len(x) - 3 + k)] for k in range(len(THIRD))])
    apart = rows[:, None] - rows[None]
    weights = 1 / np.where(np.eye(len(THIRD), dtype=bool)[:, :, None], 1.0, apart).prod(axis=1)
    return 8 * weights / np.abs(weights).sum(axis=0)


def _along(
    d: NDArray[np.float64], crossed: NDArray[np.float64], axis: int, weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return a box (..., k) of values after the filter along one axis; weights: see `_divided`, else even rows."""
    out, count = d.copy(), d.shape[axis]
    along, cells = np.moveaxis(out, axis, 0), np.moveaxis(crossed, axis, 0)
    share = np.minimum(1.0, FAST * (cells[1 : count - 2] + cells[2 : count - 1]) / 2)
    if weights is None:
        factors, third = THIRD, np.diff(along, 3, axis=0)
    else:
        factors = weights.reshape(len(THIRD), -1, *(1,) * (along.ndim - 1))
        third = sum(factor * along[k : count - 3 + k] for k, factor in enumerate(factors))
    third = share / 64 * third
    third[np.isnan(third)] = 0.0
    for k, factor in enumerate(factors):
        along[k : count - 3 + k] -= factor * third
    return out


def lattices(
    bodies: Sequence[Body], present: Sequence[bool], given: Sequence[tuple[Surface, Iterable[int]]]
) -> list[Lattice]:
    """Return the lattices of the bodies that are there; given: faces that conditions hold, and their components."""
    start = np.cumsum([0, *map(len, bodies)])
    around = {i: Faces.around(body) for i, body in enumerate(bodies) if present[i]}
    out = []
    for i, own in around.items():
        touching = [covers(own, other).face for j, other in around.items() if j != i]
        covered = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *touching]))
        out.append(Lattice(bodies[i], int(start[i]), given, (own.row[covered], own.index[covered])))
    return out


def given(
    grid: Grid, lattices: Sequence[Lattice], walls: Mapping[str, str], points: MaterialPoints
) -> NDArray[np.bool_]:
    """Return which components (n, 2^d, d) of corners conditions or walls give; walls: components that these hold."""
    out = np.zeros(points.corners.shape, dtype=bool)
    for lattice in lattices:
        rows = lattice.rows(points)
        out[rows] = lattice.given(points.id[rows])
    for name, axes in walls.items():
        axis, end = SIDES[grid.dim][name]
        at_wall = np.abs(points.corners[:, :, axis] - (grid.low, grid.high)[end][axis]) < NEAR * grid.finest[axis]
        for letter in axes:
            out[:, :, "xyz".index(letter)] |= at_wall
    return out


def filtered(
    grid: Grid, lattices: Sequence[Lattice], points: MaterialPoints, then: MaterialPoints, free: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return what the filter adds to the corners (n, 2^d, d), m.

    then: the points when the grid was reset; free (n,): which of them are filtered.
    """
    out, cells = np.zeros_like(points.corners), crossed(grid, points, then, free)
    for lattice in lattices:
        rows = lattice.rows(points)
        moved = points.corners[rows] - points.reference[rows]
        out[rows] = lattice.corners_change(grid.comm, points.id[rows], moved, cells[rows])
    return out


def crossed(grid: Grid, points: MaterialPoints, then: MaterialPoints, free: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return how many cells the corners (n, 2^d) have crossed since the grid was reset; of points not free none."""
    return grid.cells_between(then.corners, points.corners).sum(axis=2) * free[:, None]
