# SPDX-License-Identifier: MIT
"""Particle domains cut by the grid: their pieces, and the exchange of values with the owners of the cells."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from math import prod

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Keyed
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.bodies.faces import Surface, face_vectors, interpolate, on_face
from mpm_dolfinx.domains.bending import followed
from mpm_dolfinx.domains.renewed_faces import PARENT, ROOT, RenewedFaces, on_parts, renewed_faces
from mpm_dolfinx.grid.grid import TURN, Grid, sum_by
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.points.cutting import Pieces, cut, cut_faces, simplex_volumes, vertices
from mpm_dolfinx.points.material_points import MaterialPoints, middle

STILL = 3e-4
"""Largest motion of corners, divided by the cell size, up to which the domains are not cut again.

In a consolidating column of ten cells, a new cut in every step changes pressures by 7e-5 of the load, and the
settlement by the fraction 3e-5.  Sensitivity (scene "strip" of tests/plateaus.py): half this value changes the result
by 0.0e+00, and twice this value by 7.6e-05.  Finer cells change it by 3.7e-02.
"""


class Patches:
    """Quadrature points on faces of particle domains.  Arrays have a row for each of n points.

    Parameters
    ----------
    grid
        Background grid.
    faces, row : (n,)
        `faces`: surface faces of the bodies, or parts of them.  `row`: index of each point's face in `faces`.
    face, at : (n,)
        `face`: index of the face in its domain.  `at`: index of the material point with this domain.
    cell : (n,)
        Lexicographic index of the cell.
    x, xi : (n, d)
        `x`: position at the last cut, m.  `xi`: local coordinates in the domain.
    share : (n,)
        Fraction of the face that the point represents.
    """

    def __init__(
        self, grid: Grid, faces: Surface, face, row, at, cell, x, xi, share, renewed: RenewedFaces | None = None
    ):
        self._faces = faces
        self._row = row
        self.face = face
        self.at = at
        self.xi = xi
        self.cell = cell
        self.x = x
        self._grid = grid
        self._renewed = renewed
        area0 = faces.area0[row]
        self._whole0, self._face = faces.whole0[row], faces.face[row]
        if renewed is not None:
            area0, self._whole0, self._face = renewed.in_place_of(area0, self._whole0, self._face)
        self._share0 = share * area0
        self.base = grid.base
        """Origin of positions (d,), in m, see `Grid`."""
        around = grid.around(interpolate(faces.domain[row], xi)) if grid.axisymmetric else 1.0
        if renewed is not None:
            around = np.where(renewed.old, around, 1.0)  # areas of renewed faces are already areas of rings
        self.area0 = self._share0 * around
        """Reference areas (n,), in m^(d-1), or areas of rings in axisymmetry, in m^2."""

    @cached_property
    def X(self) -> NDArray[np.float64]:
        """Reference positions (n, d), in m."""
        X = self._faces.reference(self._row, self.xi)
        return X if self._renewed is None else self._renewed.reference(X, self.xi)

    def origin(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the positions (n, d), in m, at zero displacement."""
        return interpolate(points.origin[self.at], self.xi)

    def now(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the current positions (n, d), in m."""
        return interpolate(points.corners[self.at], self.xi)

    def positions(self, points: MaterialPoints) -> Callable[[str], NDArray[np.float64]]:
        """Return a function of a name: "X" gives the reference positions, and "x" the current positions."""
        return lambda name: self.X if name == "X" else self.now(points) + self.base

    def area(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the current outward area vectors (n, d), in m^(d-1), or in m^2 for rings in axisymmetry."""
        share = self._share0 / self._whole0
        if self._grid.axisymmetric:
            share = share * self._grid.around(self.now(points))
        return face_vectors(points.corners[self.at], self._face) * share[:, None]


class CutDomains(Keyed):
    """Particle domains cut by the cells, and the exchange of their data with the owners of the cells.

    The cut is valid until corners have moved by more than `STILL` cells.  Until then, shape functions are evaluated at
    the positions of the pieces at the cut.

    Parameters
    ----------
    grid
        Background grid.
    points
        Material points of this process.  All points must be inside the grid.
    domains
        Whether to integrate over the exact pieces of the domains.  Otherwise each point is one piece, as in standard
        MPM.
    second, faces
        Whether to compute second moments of the pieces (`second`), and their areas on cell faces (`faces`).
    """

    def __init__(self, grid: Grid, points: MaterialPoints, domains: bool, second: bool = False, faces: bool = True):
        self.grid = grid
        self.points = points
        self.domains = domains
        self._patches: dict[Surface | tuple[Surface, str], Patches] = {}
        pieces = cut(grid, points.corners, second, faces) if domains else whole_points(grid, points.x)
        if grid.copies > 1:
            pieces.cell += grid.copy(points.id)[pieces.point]
        exchange = Exchange(grid.comm, grid.owner(pieces.cell))
        self.pieces_to_cells = exchange.send
        """Function that sends values of the pieces to the owners of their cells."""
        self.to_pieces = exchange.back
        """Function that sends values of the pieces from the owners of their cells to the processes of the points."""
        self.cells, self.x = grid.locals[exchange.send(pieces.cell)], exchange.send(pieces.x)
        """Cells (m,) and centroids (m, d), in m, of the m pieces in owned cells."""
        self.mixed = exchange.send(pieces.mixed) if grid.dim == 3 and domains else None
        """In 3D: mean products of coordinates in each piece, see `Pieces`."""
        self.hoop = exchange.send(pieces.hoop) if grid.axisymmetric else None
        """In axisymmetry: moments (m, 4) of the pieces in the plane, see `Pieces`."""
        self._faces = exchange.send(pieces.faces) if faces else None
        pieces.faces, pieces.mixed = pieces.faces[:0].copy(), pieces.mixed[:0].copy()
        self.pieces = pieces
        """Pieces of the points on this process, without areas and mean products."""

    def faces(self) -> NDArray[np.float64]:
        """Return areas (m, d, 2), in m^(d-1), of pieces on cell faces."""
        faces, self._faces = self._faces, None
        return faces

    def crossed(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the distances (n, 2^d, d) of corners from their positions at the cut, in cell sizes."""
        return self.grid.cells_between(self.points.corners, points.corners)

    def moved(self, crossed: NDArray[np.float64], part: NDArray[np.int64], count: int) -> NDArray[np.float64]:
        """Return the largest motion of corners since the cut, in cell sizes, for each connected part (count,).

        `crossed`: result of `crossed`.
        `part` (n,): index of the connected part of each point.
        """
        far = np.maximum.reduce(crossed, axis=(1, 2))
        largest = np.zeros(count) if count > 1 else far.max(initial=0.0, keepdims=True)
        if count > 1:
            np.maximum.at(largest, part, far)
        return over_all(self.grid.comm, largest, MPI.MAX)

    def valid(self, crossed: NDArray[np.float64], part: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
        """Return whether the cut is still valid for each connected part (count,).  Parameters: see `moved`."""
        return self.moved(crossed, part, count) <= STILL

    def to_cells(self, values: NDArray) -> NDArray:
        """Send values (n, ...) of points to the owners of cells.  Return values (m, ...) of pieces in owned cells."""
        return self.pieces_to_cells(values[self.pieces.point])

    def shares(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Divide extensive quantities (n,), such as volumes, among pieces.  Return values (m,) in owned cells."""
        return self.pieces_to_cells(self.pieces.fraction * values[self.pieces.point])

    def plane(self, volume: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return volumes (m,) and centroids (m, d) of pieces, or in axisymmetry of their meridional sections."""
        if not self.grid.axisymmetric:
            return volume, self.x
        return volume / (TURN * self.hoop[:, 3]), self.grid.midpoints[self.cells] + self.hoop[:, :2]

    def mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the volume-weighted mean (n, ...) of values (m, ...) over the pieces of each point."""
        columns = values.reshape(len(values), prod(values.shape[1:])).T
        means = sum_by(self.pieces.point, self.pieces.fraction * columns, len(self.points))
        return means.T.copy().reshape(len(self.points), *values.shape[1:])

    def in_plane(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return means over the pieces of each point, weighted by volume or, in axisymmetry, by meridional area."""
        if not self.grid.axisymmetric:
            return self.mean(values)
        area = self.pieces.fraction / self.pieces.hoop[:, 3]
        whole, total = (sum_by(self.pieces.point, area * each, len(self.points)) for each in (1.0, values))
        return total / whole

    def unfolded(self) -> NDArray[np.float64]:
        """Return the volumes (n,) of the parts of domains that are not inverted, divided by the domain volumes."""
        volumes = simplex_volumes(vertices(self.points.corners.transpose(1, 2, 0).copy()))
        return np.maximum(volumes, 0.0).sum(axis=0) / volumes.sum(axis=0)

    def surface(self, faces: Surface) -> Patches:
        """Return the quadrature points on a surface, for faces of points on this process.

        The cell of each quadrature point contains a piece of the domain.
        """
        return self.surfaces([faces])[0]

    def contact_surface(self, faces: Surface) -> Patches:
        """Return quadrature points of a contact surface.  In 3D, corners within `NEAR` cells of a plane count as on it.

        If a plane cut off a tiny corner of a triangle, all points on the triangle would move.  The contact of a sharp
        tool would then change by a finite amount.  In 2D, points on an edge change continuously.
        """
        if self.grid.dim == 2:
            return self.surface(faces)
        key = faces, "contact"
        if key not in self._patches:
            self._patches[key] = self._cut_surfaces([faces], NEAR)[0]
        return self._patches[key]

    def surfaces(self, several: Sequence[Surface]) -> list[Patches]:
        """Return the quadrature points of several surfaces."""
        if not self._patches.keys() >= set(several):
            new = [faces for faces in dict.fromkeys(several) if faces not in self._patches]
            self._patches.update(zip(new, self._cut_surfaces(new), strict=True))
        return list(map(self._patches.__getitem__, several))

    def _cut_surfaces(self, several: Sequence[Surface], least: float = 0.0) -> list[Patches]:
        origin = None
        if ROOT in self.points.data:
            several, origin = zip(*[on_parts(faces, self.points) for faces in several], strict=True)
        columns = ((faces.id, faces.face, faces.xi, faces.skew, np.arange(len(faces))) for faces in several)
        ids, number, xi, skew, row = map(np.concatenate, zip(*columns, strict=True))
        here, at = self.points.find(ids)
        number, xi = number[here], xi[here]
        renewed = renewed_faces(self.points, several) if PARENT in self.points.data else None
        if renewed is not None:
            here, at = np.concatenate([here, renewed.row]), np.concatenate([at, renewed.at])
            number, xi = np.concatenate([number, renewed.face]), np.concatenate([xi, renewed.xi])
        corners = self.points.corners[at]
        count = xi.shape[1]
        places = interpolate(corners.repeat(count, axis=0), xi.reshape(-1, self.grid.dim)).reshape(xi.shape)
        face, x, xi, share, middle = cut_faces(self.grid, places, xi, least)
        outward = face_vectors(corners, number)
        size = np.sqrt(np.add.reduce(outward**2, axis=1, keepdims=True))
        skew = skew[here][face].nonzero()[0]  # over a triangle, positions are linear, but xi is not
        if len(skew):
            xi[skew] = on_face(corners[face[skew]], number[face[skew]], x[skew], xi[skew])
        inward = -NEAR * self.grid.least * np.divide(outward, size, out=np.zeros(outward.shape), where=size > 0)
        cell, _ = self._filled_cell(at[face], middle + inward[face])
        rows = row[here][face], at[face], cell, x, xi, share
        surface = np.arange(len(several)).repeat(list(map(len, several)))[here][face]
        out = []
        for k, faces in enumerate(several):
            own = (surface == k).nonzero()[0]
            anew = renewed and renewed.of(face[own] - (len(here) - len(renewed.row)))
            given = rows[0][own] if origin is None else origin[k][rows[0][own]]
            out.append(Patches(self.grid, faces, given, *[v[own] for v in rows], anew))
        return out

    def displacement(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values (n, d) of a Q1 field u (nodes, d) at the points.  Only for a cut without `domains`."""
        exchange, cells = self._followed[:2]
        return exchange.back(self.grid.at(cells, exchange.send(self._tracked), u))

    def followed(
        self,
        u: NDArray[np.float64],
        filled: NDArray[np.bool_],
        one_sided: bool = True,
        yielded: NDArray[np.bool_] | None = None,
    ) -> Iterator[NDArray[np.float64]]:
        """Yield two arrays (n, 2^d, d), in m: the Q1 field u (nodes, d) at the corners, and its quadratic correction.

        Inverted parts of domains have no pieces.  If a domain has no piece in the cell of its corner, this corner
        follows the cell of the domain's largest piece, so that F is consistent.  In yielded soil, F does not depend on
        corners.  The corner then follows its own cell, because other domains have the same corner.

        `filled`, `one_sided`: see `bending.followed`.
        `yielded` (n,): whether the domain is of yielded soil, by default none.
        """
        exchange, cells = self._followed[:2] if yielded is None else self._together(yielded)
        moved = followed(self.grid, cells, exchange.send(self._tracked), u, filled, one_sided)
        return (exchange.back(v).reshape(self.points.corners.shape) for v in moved)

    @property
    def _tracked(self) -> NDArray[np.float64]:
        """Positions of all corners, in m, or positions of the points in a cut without `domains`."""
        return self.points.corners.reshape(-1, self.grid.dim) if self.domains else self.points.x

    @cached_property
    def _followed(self) -> tuple[Exchange, NDArray[np.int32], tuple[NDArray[np.int64], ...]]:
        """Exchange that sends `_tracked` positions to the owners of the cells that they follow, and these cells.

        Then follow arrays with a row for each position: its point, the cell that contains it, and the cell it follows.
        """
        at = np.arange(len(self.points))
        at = at.repeat(2**self.grid.dim) if self.domains else at
        x = self._tracked
        cell, own = self._filled_cell(at, x + NEAR * (self.points.x[at] - x))
        return *self._sent(cell), (at, own, cell)

    def _sent(self, cell: NDArray[np.int64]) -> tuple[Exchange, NDArray[np.int32]]:
        exchange = Exchange(self.grid.comm, self.grid.owner(cell))
        return exchange, self.grid.locals[exchange.send(cell)]

    def _together(self, yielded: NDArray[np.bool_]) -> tuple[Exchange, NDArray[np.int32]]:
        """Return `_followed`, but corners of yielded domains follow the filled cells that contain them."""
        exchange, cells, (at, own, cell) = self._followed
        other = (yielded[at] & (cell != own)).nonzero()[0]
        if not over_all(self.grid.comm, len(other)):
            return exchange, cells
        exchange, cells = self._sent(own[other])
        filled = exchange.back(np.isin(cells, self.cells))
        cell = cell.copy()
        cell[other[filled]] = own[other[filled]]
        return self._sent(cell)

    def total_displacement(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the total displacements (m, d), in m, of the pieces' centroids."""
        pieces = self.pieces
        now, then = (c - c.mean(axis=1, keepdims=True) for c in (points.corners, points.origin))
        stretch = np.linalg.solve(then.swapaxes(1, 2) @ then, then.swapaxes(1, 2) @ now)  # affine fit to the corners
        off = pieces.x - middle(points.corners)[pieces.point]
        off0 = np.linalg.solve(stretch.swapaxes(1, 2)[pieces.point], off[:, :, None])[:, :, 0]
        return off + (middle(points.corners) - middle(points.origin))[pieces.point] - off0

    def cells_at(self, at: NDArray[np.int64], x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return lexicographic indices (n,) of the cells of positions x (n, d), in m, in the domains of points `at`."""
        # rounding must not assign a corner on a grid line to a cell outside the domain
        return self._filled_cell(at, x + NEAR * (self.points.x[at] - x))[0]

    def _filled_cell(
        self, at: NDArray[np.int64], x: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return two cells for each position x (n, d), in m, in the domains of points `at`.

        The second contains the position.  The first is the same cell, or the cell of the largest piece of the domain if
        the domain has no piece in the second.
        """
        pieces, cells = self.pieces, self.grid.all_cells
        own = self.grid.number(self.grid.index_from_base(x)) + self.grid.copy(self.points.id[at])
        key, keys = at * cells + own, pieces.point * cells + pieces.cell
        if not len(key):
            return own, own
        found = np.minimum(keys.searchsorted(key), len(keys) - 1)
        empty = keys[found] != key
        if not empty.any():
            return own, own
        cell = own.copy()
        cell[empty] = pieces.cell[self._largest()[at[empty]]]
        return cell, own

    def _largest(self) -> NDArray[np.int64]:
        """Return the index of the largest piece of each point."""
        order = np.lexsort((self.pieces.fraction, self.pieces.point))
        return order[np.cumsum(np.bincount(self.pieces.point, minlength=len(self.points))) - 1]


def whole_points(grid: Grid, x: NDArray[np.float64]) -> Pieces:
    """Return one piece for each point, located at the point, as in standard MPM."""
    n, number = len(x), grid.number(grid.index_from_base(x))
    _, cell, count = np.unique(number, return_inverse=True, return_counts=True)
    h = grid.sizes_of(number)
    share = h.prod(axis=-1, keepdims=True) / h / count[cell][:, None]
    return Pieces(np.arange(n), number, np.ones(n), x.copy(), np.stack([share, share], axis=2), np.zeros((n, 0)))
