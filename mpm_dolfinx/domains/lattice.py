# SPDX-License-Identifier: MIT
"""Lattice of the seeded corners of a body, and a third-difference filter of their displacements.

Nodes cannot represent a displacement wave of the corners with a wavelength of two domains.  A filter damps such waves
when the grid is reset.  For each axis a in turn, the filter replaces the displacement d of the corners by

    d - D_a^T (s / 64) D_a d.

D_a is the third difference at four corners in a row along axis a.  If domains have different widths, D_a is the scaled
divided difference.  The factor s is `min(1, FAST c)`, with the number c of cells that the corners have crossed since
the last reset.

Quadratic fields remain unchanged.  A wave with a length of two domains is reduced by the fraction s, and a wave with a
length of eight domains by 0.003 s.  Yielded soil is not filtered.  The filter does not move corners at a wall, a
prescribed displacement, a plate or another body.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.bodies.touching import Faces, covers
from mpm_dolfinx.domains.renewed_faces import ROOT, is_part, roots
from mpm_dolfinx.grid.grid import FACES, Grid, among, corner_bits, in_chunks, sum_by
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.material_points import MaterialPoints

FAST = 10
"""Fraction (at most 1) that the filter removes, per crossed cell, of a wave with a length of two domains.

Sensitivity (scene "cycles" of tests/plateaus.py): half this value changes the result by 1.5e-04, and twice this value
by 3.4e-04. Finer cells change it by 6.2e-03.
"""
THIRD = (-1, 3, -3, 1)
MARGIN = len(THIRD) - 1
"""Number of neighbouring layers of the lattice, on each side, that influence the change of a layer."""


class Lattice:
    """Lattice of the domain corners of an active body.

    `start`: identifier of the first point of the body.
    `given`: for each condition, the faces with prescribed displacements, and the prescribed axes.
    `contacts`: domains (m,) with a face in contact with another body, and corner indices (m, 4) of this face.
    """

    def __init__(
        self,
        body: Body,
        start: int,
        given: Iterable[tuple[Surface, Iterable[int]]],
        contacts: tuple[NDArray[np.int64], NDArray[np.int64]],
    ):
        self._body = body
        self._start = start
        self._stop = start + len(body)
        self._dim, self._count = body.dim, body.lattice
        self._thirds = None
        if any((widths != widths[0]).any() for widths in body.widths):
            self._thirds = [_divided(body.corner_rows(axis)) for axis in range(self._dim)]
        self._numbers: Latest[NDArray[np.int64]] = Latest()
        self._tolerance = np.append(np.full(self._dim, NEAR * body.spacing.min()), NEAR)
        # stores indices of held corners: flags for all corners would be as large as the body, on every process
        self._contacts = np.unique(np.take_along_axis(body.nodes(contacts[0]), contacts[1], axis=1))
        of_axes = [[np.empty(0, dtype=np.int64)] for _ in range(self._dim)]
        for faces, axes in given:
            own = (faces.id >= self._start) & (faces.id < self._stop)
            corners = body.nodes(faces.id[own] - self._start), FACES[self._dim][faces.face[own]]
            for axis in axes:
                of_axes[axis].append(np.take_along_axis(*corners, axis=1).ravel())
        self._given = [np.unique(np.concatenate(numbers)) for numbers in of_axes]
        self._held: Latest[tuple[NDArray[np.bool_], NDArray[np.bool_]]] = Latest()

    def rows(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return the indices of the points of the body."""
        return ((points.id >= self._start) & (points.id < self._stop)).nonzero()[0]

    def held_of(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which displacement components (m, 2^d, d) of corners are prescribed, and which corners (m, 2^d) touch
        other bodies.
        """

        def held() -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
            number = self.nodes(ids)
            return np.stack([among(number, of_axis) for of_axis in self._given], axis=2), among(number, self._contacts)

        return self._held(ids, held)

    def nodes(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the indices (m, 2^d), in the body, of the corners of domains."""
        return self._numbers(ids, lambda: self._body.nodes(ids - self._start))

    def corners_of_parts(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return the lattice indices (m,) of corners of divided or merged domains."""
        own = is_part(points).nonzero()[0]
        root, part = (of[own] for of in roots(points))
        own = ((root >= self._start) & (root < self._stop)).nonzero()[0]
        if not len(own) or self._count is None:
            return own[:0]
        bits, first = corner_bits(self._dim), self._body.places(root[own] - self._start)
        corners = first[:, None] + np.where(bits, part[own, None, :, 1], part[own, None, :, 0])
        corners = corners[(corners == np.rint(corners)).all(axis=2)].astype(np.int64)
        return np.ravel_multi_index(tuple(corners.T), tuple(np.add(self._count, 1)))

    def corners_change(
        self,
        comm: MPI.Intracomm,
        ids: NDArray[np.int64],
        d: NDArray[np.float64],
        crossed: NDArray[np.float64],
        parts: Sequence[int],
    ) -> NDArray[np.float64]:
        """Return the change (n, 2^d, d), in m, of the domain corners by the filter.

        `d` (n, 2^d, d), in m: displacements of the corners.
        `crossed` (n, 2^d): numbers of cells that the corners have crossed since the grid reset.
        `parts` (k,): indices of corners that the filter does not move.
        """
        if self._count is None:
            return np.zeros_like(d)
        values = np.concatenate([d, crossed[:, :, None]], axis=2).reshape(-1, self._dim + 1)
        number = self.nodes(ids).ravel()
        if len(parts):
            number, values = np.append(number, parts), np.pad(values, ((0, len(parts)), (0, 0)), constant_values=np.nan)
        where = comm, tuple(np.add(self._count, 1)), number
        field, layers, to_rows = _at_sites(*where, values, self._tolerance)
        del values  # frees an array as large as the corners
        thirds = self._thirds and [self._thirds[0][:, layers], *self._thirds[1:]]
        change = _filtered(field[..., :-1], field[..., -1:], thirds) - field[..., :-1]
        change[np.isnan(change)] = 0.0
        change = to_rows(change.reshape(-1, self._dim))[: d[..., 0].size].reshape(d.shape)
        change[self.held_of(ids)[1]] = 0.0
        return change


def _at_sites(
    comm: MPI.Intracomm,
    shape: tuple[int, ...],
    number: NDArray[np.int64],
    values: NDArray[np.float64],
    tolerance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], slice, Callable[[NDArray[np.float64]], NDArray[np.float64]]]:
    """Return site values and layers (a slice) of this process, and a function that copies site values to corners.

    The layers of the lattice are distributed over the processes.  A site has the mean value of its corners, or nan if a
    value differs from the mean by more than `tolerance`.
    """
    across, starts = int(np.prod(shape[1:])), np.arange(comm.size + 1) * shape[0] // comm.size
    layer = number // across if comm.size > 1 else number[:0]
    rank = starts.searchsorted(layer, side="right") - 1
    exchange = Exchange(comm, rank)
    rows = [(exchange.send(number), exchange.send(values))]
    for other in range(-MARGIN, MARGIN + 1) if comm.size > 1 else ():  # a process may have one layer only
        to = np.minimum(np.maximum(rank + other, 0), comm.size - 1)
        near = (to != rank) & (to == rank + other) & (layer >= starts[to] - MARGIN) & (layer < starts[to + 1] + MARGIN)
        halo = Exchange(comm, to[near])
        rows.append((halo.send(number[near]), halo.send(values[near])))
    first = max(0, starts[comm.rank] - MARGIN)
    last = min(shape[0], starts[comm.rank + 1] + MARGIN)
    rows = [(at - first * across, d) for at, d in rows]
    field = np.full(((last - first) * across, values.shape[1]), np.nan)
    for at, d in rows:
        field[at] = d
    count = np.maximum(sum(np.bincount(at, minlength=len(field)) for at, _ in rows), 1)
    for column in range(values.shape[1]):  # the mean of equal values is exact
        field[:, column] += sum(sum_by(at, d[:, column] - field[at, column], len(field)) for at, d in rows) / count
    for at, d in rows:
        for part in in_chunks(len(at)):
            sites = at[part]
            differs = np.abs(field.take(sites, axis=0) - d[part]) > tolerance
            field[sites[np.logical_or.reduce(differs.T)]] = np.nan
        field[at[np.isnan(d[:, 0])]] = np.nan
    field, home = field.reshape(-1, *shape[1:], values.shape[1]), rows[0][0]
    return field, slice(first, max(first, last - MARGIN)), lambda change: exchange.back(change.take(home, axis=0))


def _filtered(
    d: NDArray[np.float64],
    crossed: NDArray[np.float64],
    thirds: Sequence[NDArray[np.float64]] | None,
    axes: Sequence[int] | None = None,
) -> NDArray[np.float64]:
    """Return the values at the sites of a lattice, filtered along `axes`, by default along all axes."""
    if axes is None:
        axes = tuple(axis for axis, count in enumerate(d.shape[:-1]) if count >= len(THIRD))
    if not axes:
        return d
    by = [None] * (d.ndim - 1) if thirds is None else thirds
    orders = [_filtered(_along(d, crossed, a, by[a]), crossed, thirds, [b for b in axes if b != a]) for a in axes]
    return sum(orders[1:], orders[0]) / len(orders)


def _divided(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights of third differences at positions (n,) along an axis.  The sum of absolute weights is 8."""
    rows = np.stack([x[k : max(k, len(x) - 3 + k)] for k in range(len(THIRD))])
    distances = rows[:, None] - rows[None]
    weights = 1 / np.where(np.eye(len(THIRD), dtype=bool)[:, :, None], 1.0, distances).prod(axis=1)
    return 8 * weights / np.abs(weights).sum(axis=0)


def _along(
    d: NDArray[np.float64], crossed: NDArray[np.float64], axis: int, weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return the values at the sites of a lattice, filtered along one axis."""
    out, count = d.copy(), d.shape[axis]
    along, cells = out.swapaxes(axis, 0), crossed.swapaxes(axis, 0)
    share = np.minimum(1.0, FAST * (cells[1 : count - 2] + cells[2 : count - 1]) / 2)
    factors = THIRD if weights is None else weights.reshape(len(THIRD), -1, *(1,) * (along.ndim - 1))
    third = share / 64 * sum([factor * along[k : count - 3 + k] for k, factor in enumerate(factors)])
    third[np.isnan(third)] = 0.0
    for k, factor in enumerate(factors):
        along[k : count - 3 + k] -= factor * third
    return out


def lattices(
    bodies: Sequence[Body], present: Sequence[bool], given: Sequence[tuple[Surface, Iterable[int]]]
) -> list[Lattice]:
    """Return the lattices of the active bodies.

    `given`: faces with prescribed displacements, and their prescribed axes.
    """
    start = np.cumsum([0, *map(len, bodies)])
    around = {i: Faces.around(body) for i, body in enumerate(bodies) if present[i]}
    out = []
    for i, own in around.items():
        touching = [covers(own, other).face for j, other in around.items() if j != i]
        contacts = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *touching]))
        out.append(Lattice(bodies[i], int(start[i]), given, (own.row[contacts], own.index[contacts])))
    return out


def given(lattices: Sequence[Lattice], points: MaterialPoints) -> NDArray[np.bool_]:
    """Return which displacement components (n, 2^d, d) of the corners of domains are prescribed."""
    out = np.zeros(points.corners.shape, dtype=bool)
    for lattice in lattices:
        rows = lattice.rows(points)
        out[rows] = lattice.held_of(points.id[rows])[0]
    return out


def seeded(lattices: Sequence[Lattice], points: MaterialPoints) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the indices (n, 2^d) of corners, counted in each body, and which corners touch other bodies.

    Corners of renewed domains have the index -1.
    """
    numbers, touching = np.full(points.corners.shape[:2], -1), np.zeros(points.corners.shape[:2], dtype=bool)
    for lattice in lattices:
        rows = lattice.rows(points)
        ids = points.id[rows]
        numbers[rows], touching[rows] = lattice.nodes(ids), lattice.held_of(ids)[1]
    return numbers, touching


def filtered(
    grid: Grid, lattices: Sequence[Lattice], points: MaterialPoints, crossed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the change of the corners (n, 2^d, d), in m, by the filter.

    `crossed` (n, 2^d): numbers of cells that corners have crossed since the grid reset; 0 for points without filter.
    """
    out = np.zeros(points.corners.shape)
    for lattice in lattices:
        rows = lattice.rows(points)
        moved = points.corners[rows] - points.reference[rows]
        parts = lattice.corners_of_parts(points) if ROOT in points.data else ()
        out[rows] = lattice.corners_change(grid.comm, points.id[rows], moved, crossed[rows], parts)
    return out
