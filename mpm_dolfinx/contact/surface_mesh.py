# SPDX-License-Identifier: MIT
"""Rigid solids whose surface is a mesh: closed polygons in 2D, and closed surfaces of triangles in 3D."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from math import factorial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import NEAR, ROUND_OFF, TINY
from mpm_dolfinx.base.validation import line, numbers
from mpm_dolfinx.bodies.mesh_files import surface_of
from mpm_dolfinx.contact.shapes import ROUNDED, DistanceField, Placed
from mpm_dolfinx.grid.grid import linked
from mpm_dolfinx.points.facet_search import AT_ONCE, FacetTree

if TYPE_CHECKING:  # meshio takes long to import, so functions import it
    import meshio

SHAPES = {2: "(n, 2) in 2D", 3: "(n, 3) in 3D"}


def _place(x: NDArray[np.float64]) -> str:
    """Return positions as text."""
    return " to ".join("({})".format(", ".join(f"{c:.6g}" for c in row)) for row in np.atleast_2d(x))


class Nearest(NamedTuple):
    """Nearest positions on a surface."""

    facet: NDArray[np.int64]  # nearest facet (m,)
    part: NDArray[np.int64]  # part of the facet (m,): 0 its interior, 1 to d its sides, from d + 1 on its vertices
    offset: NDArray[np.float64]  # vector from the nearest position (m, d), m


class Facets:
    """Facets with their normals, for the search of nearest positions.

    Side k of a triangle is the edge from vertex k to the next vertex.  In 2D, side k of a segment is its vertex k.
    """

    def __init__(self, x: NDArray[np.float64], facets: NDArray[np.int64]):
        d = x.shape[1]
        self.corners = x[facets]
        along = np.roll(self.corners, -1, axis=1) - self.corners
        if d == 2:
            self.normal = np.stack([along[:, 0, 1], -along[:, 0, 0]], axis=1)
        else:
            self.normal = np.cross(along[:, 0], along[:, 1])
        size = np.linalg.norm(self.normal, axis=1)
        self.area = size / factorial(d - 1)
        longest = np.linalg.norm(along, axis=2).max(axis=1)
        self.height = size / np.maximum(longest ** (d - 2), TINY)
        """Length of each segment, or smallest height of each triangle (n,), in m."""
        self.normal /= np.maximum(size, TINY)[:, None]
        out = np.cross(along, self.normal[:, None]) if d == 3 else -along
        self.along = along * (d == 3)
        columns = [self.corners, out / np.maximum(np.linalg.norm(out, axis=2, keepdims=True), TINY), self.along]
        self._columns = [np.ascontiguousarray(of.transpose(1, 2, 0)) for of in columns]  # axes: side, component, facet
        self._normal = np.ascontiguousarray(self.normal.T)
        self._margin = ROUND_OFF * np.abs(x).max()
        self.rounded = ROUNDED * np.ptp(x, axis=0).max()
        """Distance, in m, below which a position lies on the surface, on an edge, or at a vertex."""
        self._squares = np.maximum((self.along**2).sum(axis=2).T, TINY)

    @cached_property
    def tree(self) -> FacetTree:
        """Search tree of the facets."""
        return FacetTree(self.corners)

    def inside(self, y: NDArray[np.float64], at: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each position y (d, m) lies in its facet (m,) after projection onto the plane of the facet."""
        corners, out, _ = self._columns
        return (((y - corners.take(at, 2)) * out.take(at, 2)).sum(axis=1) <= self._margin).all(axis=0)

    def heights(self, y: NDArray[np.float64], at: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the heights (m,), in m, of positions y (d, m) above the lines or planes of facets (m,)."""
        return ((y - self._columns[0][0].take(at, 1)) * self._normal.take(at, 1)).sum(axis=0)

    def _from_sides(self, y: NDArray[np.float64], at: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
        """For the points on sides nearest to y, return coordinates from 0 to 1 (d, m), and vectors to y (d, d, m)."""
        corners, _, along = (of.take(at, 2) for of in self._columns)
        offset = y - corners
        share = np.clip((offset * along).sum(axis=1) / self._squares.take(at, 1), 0, 1)
        return share, offset - share[:, None] * along

    def distances(self, y: NDArray[np.float64], at: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the distances (m,), in m, of positions y (d, m) from facets (m,)."""
        out = np.abs(self.heights(y, at))
        off = np.flatnonzero(~self.inside(y, at))
        out[off] = np.sqrt((self._from_sides(y.take(off, 1), at[off])[1] ** 2).sum(axis=1).min(axis=0))
        return out

    def nearest(self, y: NDArray[np.float64]) -> Nearest:
        """Return the position on the surface that is nearest to each position y (m, d)."""
        parts = [self._nearest(y[start : start + AT_ONCE].T) for start in range(0, max(len(y), 1), AT_ONCE)]
        return Nearest(*map(np.concatenate, zip(*parts, strict=True)))

    def _nearest(self, y: NDArray[np.float64]) -> Nearest:
        d, m = y.shape
        y = np.ascontiguousarray(y)
        at, facet = self.tree.within(y, self.distances(y, self.tree.near(y)))
        far = self.distances(y.take(at, 1), facet)
        least = np.minimum.reduceat(far, np.flatnonzero(np.diff(at, prepend=-1))) if m else far
        rows = np.flatnonzero(far == least[at])
        facet = facet[rows[np.flatnonzero(np.diff(at[rows], prepend=-1))]]
        part, offset = np.zeros(m, dtype=np.int64), self.heights(y, facet) * self._normal.take(facet, 1)
        off = np.flatnonzero(~self.inside(y, facet))
        share, vectors = self._from_sides(y.take(off, 1), facet[off])
        k, rows = (vectors**2).sum(axis=1).argmin(axis=0), np.arange(len(off))
        share, offset[:, off] = share[k, rows], vectors[k, :, rows].T
        part[off] = np.where(share <= 0, 1 + d + k, np.where(share >= 1, 1 + d + (k + 1) % d, 1 + k))
        return Nearest(facet, part, offset.T)

    def part_at(self, y: NDArray[np.float64], at: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the part (m,) of the facet `at` on which each position y (m, d) lies, numbered as in `Nearest`."""
        d, rows = y.shape[1], np.arange(len(at))
        to_corners = np.linalg.norm(y[:, None] - self.corners[at], axis=2)
        vectors = self._from_sides(np.ascontiguousarray(y.T), at)[1]
        to_sides = np.sqrt((vectors**2).sum(axis=1)).T
        k, vertex = to_sides.argmin(axis=1), to_corners.argmin(axis=1)
        part = np.where(to_sides[rows, k] <= self.rounded, 1 + k, 0)
        return np.where(to_corners[rows, vertex] <= self.rounded, 1 + d + vertex, part)


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceMesh(Placed):
    """A solid inside a closed surface of triangles in 3D, or inside closed polygons in 2D, convex or not.

    Vertices at a distance below 10^-6 times the size of the mesh are merged.  Facets of zero area are ignored.  The
    order of the vertices in a facet has no effect.  A surface inside another surface bounds a cavity.  In axisymmetry,
    the section must extend over both sides of the axis.

    Contact has one pressure and one normal in each cell.  Contact is therefore inaccurate in concave edges, and on
    parts of the solid that are thinner than a cell.  `volume` and `centroid` help to compute the mass and centre of a
    tool.

    Parameters
    ----------
    vertices : (n, d), m
        Positions of the vertices.
    facets : (m, d)
        Indices of the vertices of each facet, from 0.  The default, in 2D only, is one polygon through all vertices in
        the given order.

    Raises
    ------
    ValueError
        The surface is open, intersects or touches itself, or has an edge with more than two facets.  A coordinate is
        not finite, an index is not allowed, or a facet is too thin to have a normal.

    Source: Baerentzen and Aanaes (2005), for the sign of the distance.
    """

    vertices: ArrayLike
    facets: ArrayLike | None = None

    def __repr__(self) -> str:
        """Return the numbers of vertices and facets, for messages."""
        return f"SurfaceMesh({len(self.vertices)} vertices, {len(self.facets)} facets)"

    def __post_init__(self):
        x = numbers("SurfaceMesh: vertices", self.vertices, None, allowed="finite coordinates")
        if x.ndim != 2 or x.shape[1] not in SHAPES or len(x) <= x.shape[1]:
            what = f"SurfaceMesh: vertices = {line(self.vertices)} of shape {x.shape}"
            raise ValueError(f"{what}, must be 3 or more positions (n, 2), or 4 or more positions (n, 3)")
        x, facets = _merged(x, self._rows(len(x), x.shape[1]))
        thin = Facets(x, facets).height <= NEAR * np.ptp(x, axis=0).max()
        if thin.any():
            what = f"SurfaceMesh: the facet {_place(x[facets[thin][0]])} m lies in a line"
            raise ValueError(f"{what}, must be a triangle higher than 1e-6 times the size of the mesh")
        facets = _outward(x, facets, _closed(x, facets))
        self._set(x, facets)
        _check_crossings(x, facets, self._table)

    @classmethod
    def from_mesh(cls, mesh: str | os.PathLike | meshio.Mesh, scale: float = 1.0) -> SurfaceMesh:
        """Return the solid inside the surface of a mesh: STL, PLY, OBJ, gmsh, VTK or another format that meshio reads.

        For another orientation or position, rotate and translate the `vertices`, and create a new `SurfaceMesh`.

        Parameters
        ----------
        mesh
            A file, or a mesh object of meshio.  The triangles and quadrilaterals of the mesh are the surface.  In a
            plane mesh, the lines are the surface of a 2D solid.
        scale
            Unit of length of the mesh, in m, > 0; 1e-3 for a mesh in mm.

        Raises
        ------
        ValueError
            The file is missing, unreadable or has no surface, or the surface is invalid, see `SurfaceMesh`.
        """
        numbers("SurfaceMesh: scale", scale, test=lambda s: (s > 0) & (s < np.inf), allowed="> 0 and finite")
        x, facets = surface_of(mesh)
        try:
            return cls(scale * x, facets)
        except ValueError as error:
            file = f" {os.fspath(mesh)}" if isinstance(mesh, (str, os.PathLike)) else ""
            raise ValueError(str(error).replace("SurfaceMesh:", f"SurfaceMesh{file}:", 1)) from None

    def _rows(self, count: int, d: int) -> NDArray[np.int64]:
        """Return the facets as integers, or raise ValueError for invalid indices."""
        if self.facets is None and d == 2:
            return np.stack([np.arange(count), np.roll(np.arange(count), -1)], axis=1)
        allowed = f"integers (m, {d}) from 0 to {count - 1}"
        rows = numbers("SurfaceMesh: facets", [] if self.facets is None else self.facets, None, allowed=allowed)
        if rows.ndim != 2 or rows.shape[1] != d:
            raise ValueError(f"SurfaceMesh: facets = {line(self.facets)}, must be {allowed}")
        wrong = (rows != np.rint(rows)) | (rows < 0) | (rows >= count)
        if wrong.any():
            raise ValueError(f"SurfaceMesh: facets: {rows[wrong.any(axis=1)][0]}, must be {allowed}")
        return rows.astype(np.int64)

    def _set(self, x: NDArray[np.float64], facets: NDArray[np.int64]) -> None:
        vars(self).clear()
        vars(self).update(vertices=x, facets=facets)

    def moved(self, by: NDArray[np.float64]) -> SurfaceMesh:
        """Return the shape, translated by a vector (d,), in m."""
        out = object.__new__(SurfaceMesh)
        out._set(self.vertices + np.asarray(by, dtype=float), self.facets)
        return out

    @property
    def on_axis(self) -> bool:
        """Whether a facet lies on the axis x = 0 of an axisymmetric grid."""
        return bool((np.abs(self.vertices[self.facets][..., 0]) <= self._table.rounded).all(axis=1).any())

    @property
    def middle(self) -> NDArray[np.float64]:
        """Centroid (d,), in m."""
        return self.centroid

    @cached_property
    def _table(self) -> Facets:
        return Facets(self.vertices, self.facets)

    @cached_property
    def _normals(self) -> NDArray[np.float64]:
        """Normals (m, 1 + 2 d, d) of each facet, its sides and its vertices.  Sides and vertices have mean normals."""
        table, d = self._table, self.vertices.shape[1]
        n = table.normal
        out = np.repeat(n[:, None], 1 + 2 * d, axis=1)
        weight = np.ones(self.facets.shape)
        if d == 3:
            side = _sides(self.facets)[1]
            total = np.zeros((side.max() + 1, d))
            np.add.at(total, side, n.repeat(d, axis=0) / 2)
            out[:, 1 : 1 + d] = total[side].reshape(-1, d, d)
            a = table.along / np.linalg.norm(table.along, axis=2, keepdims=True)
            back = -np.roll(a, 1, axis=1)
            sine = np.linalg.norm(np.cross(a, back), axis=2)
            weight = np.arctan2(sine, np.einsum("mkd,mkd->mk", a, back))
        total = np.zeros((len(self.vertices), d))
        share = np.zeros(len(self.vertices))
        np.add.at(total, self.facets, weight[..., None] * n[:, None])
        np.add.at(share, self.facets, weight)
        out[:, 1 + d :] = (total / share[:, None])[self.facets]
        return out

    def _near(self, y: NDArray[np.float64]) -> tuple[Nearest, NDArray, NDArray]:
        """Return the nearest positions on the surface, the normals there (m, d), and signed distances (m,), in m."""
        near = self._table.nearest(y)
        n = self._normals[near.facet, near.part]
        return near, n, np.copysign(np.linalg.norm(near.offset, axis=1), np.einsum("md,md->m", near.offset, n))

    def distance(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m, from the surface."""
        return self._near(y)[2]

    def distance_up_to(self, y: NDArray[np.float64], limit: float) -> NDArray[np.float64]:
        """Return the signed distances (n,), in m.  Distances above `limit` (m) may be replaced by a lower bound."""
        low, high = self._bounds
        out = np.linalg.norm(np.maximum(0, np.maximum(low - y, y - high)), axis=1)
        near = out <= limit
        out[near] = self.distance(y[near])
        return out

    @cached_property
    def _bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the box around the mesh, in m."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def geometry(self, y: NDArray[np.float64]) -> DistanceField:
        """See `Placed`.  On edges and vertices, the gradient is the mean normal."""
        near, n, gap = self._near(y)
        d, on = y.shape[1], np.abs(gap) <= self._table.rounded
        n = n.copy()
        n[on] = self._normals[near.facet[on], self._table.part_at(y[on], near.facet[on])]
        away = (near.part > 0) & ~on
        far = np.where(away, gap, np.inf)[:, None]
        e = near.offset / far
        second = np.eye(d) - e[:, :, None] * e[:, None, :]
        if d == 3:
            t = self._table.along[near.facet, (near.part - 1) % d] * ((near.part > 0) & (near.part <= d))[:, None]
            t = t / np.maximum(np.linalg.norm(t, axis=1), TINY)[:, None]
            second -= t[:, :, None] * t[:, None, :]
        return gap, np.where(away[:, None], e, n), second / far[:, None]

    @cached_property
    def _moments(self) -> tuple[float, NDArray, NDArray]:
        """Volume, centroid, and second moments (d, d) about the centroid, by the divergence theorem."""
        origin = self.vertices.mean(axis=0)
        x = (self.vertices - origin)[self.facets]
        d = x.shape[2]
        share = np.linalg.det(x) / factorial(d)  # signed volumes of the simplices between facets and origin
        whole, total = share.sum(), x.sum(axis=1)
        centre = share @ total / (d + 1) / whole
        second = np.einsum("m,mi,mj->ij", share, total, total) + np.einsum("m,mki,mkj->ij", share, x, x)
        second = second / ((d + 1) * (d + 2)) - whole * np.outer(centre, centre)
        return float(whole), origin + centre, second

    @property
    def volume(self) -> float:
        """Volume of the solid, in m^3; in 2D the area, in m^2."""
        return self._moments[0]

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Centroid of the solid (d,), in m."""
        return self._moments[1]

    @property
    def inertia(self) -> NDArray[np.float64]:
        """Moments of inertia about the centroid, divided by the density: (3, 3), in m^5, or in 2D a number, in m^4."""
        second = self._moments[2]
        trace = np.trace(second)
        return trace if len(second) == 2 else trace * np.eye(3) - second


def _merged(x: NDArray[np.float64], facets: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Merge coincident vertices.  Return the vertices, and the facets without a repeated vertex."""
    used, facets = np.unique(facets, return_inverse=True)
    x, same = np.unique(x[used], axis=0, return_inverse=True)
    facets = same.ravel()[facets.reshape(-1, x.shape[1])]
    size = np.ptp(x, axis=0).max(initial=0.0) if len(x) else 0.0
    pairs = cKDTree(x).query_pairs(NEAR * size, output_type="ndarray") if size else np.zeros((0, 2), np.int64)
    group, _ = linked(len(x), *pairs.T)
    first = np.unique(group, return_index=True)[1]
    x, facets = x[first], group[facets]
    facets = facets[(facets != np.roll(facets, 1, axis=1)).all(axis=1)]
    if len(facets) <= x.shape[1]:
        raise ValueError(f"SurfaceMesh: {len(facets)} facets with extent, must be {x.shape[1] + 1} or more")
    return x, facets


def _sides(facets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the distinct sides (q, d - 1) of facets, and for each facet the indices and orientations of its sides."""
    d = facets.shape[1]
    if d == 2:
        vertex, side = np.unique(facets, return_inverse=True)
        return vertex[:, None], side.ravel(), np.tile([True, False], len(facets))
    ends = np.stack([facets, np.roll(facets, -1, axis=1)], axis=2).reshape(-1, 2)
    key = np.sort(ends, axis=1) @ [facets.max() + 1, 1]
    _, first, side = np.unique(key, return_index=True, return_inverse=True)
    return np.sort(ends[first], axis=1), side.ravel(), ends[:, 0] < ends[:, 1]


def _closed(x: NDArray[np.float64], facets: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Return pairs (q, 2) of facets with a common side, and whether both facets have the same orientation.

    Raise ValueError for a side that does not belong to two facets, and for solids that touch in a vertex.
    """
    d = facets.shape[1]
    sides, side, sense = _sides(facets)
    count = np.bincount(side)
    for k in np.flatnonzero(count != 2)[:1]:
        what = f"the {'vertex' if d == 2 else 'edge'} {_place(x[sides[k]])} m belongs to {count[k]} facets"
        raise ValueError(f"SurfaceMesh: {what}, must belong to 2, so that the surface is closed and simple")
    one, other = np.argsort(side, kind="stable").reshape(-1, 2).T
    if d == 3:  # corners of facets are linked around their vertex
        flip = sense[one] == sense[other]
        ahead = [(k // d) * d + (k + 1) % d for k in (one, other)]
        start, end = np.where(flip, other, ahead[1]), np.where(flip, ahead[1], other)
        fan, number = linked(len(side), np.append(one, ahead[0]), np.append(start, end))
        if number > len(x):
            twice = np.bincount(facets.ravel()[np.unique(fan, return_index=True)[1]], minlength=len(x)) > 1
            what = f"parts of the surface touch in the vertex {_place(x[twice][0])} m"
            raise ValueError(f"SurfaceMesh: {what}, must be apart, or share edges")
    return np.stack([one // d, other // d], axis=1), sense[one] != sense[other]


def _outward(x: NDArray[np.float64], facets: NDArray[np.int64], pairs: tuple[NDArray, NDArray]) -> NDArray[np.int64]:
    """Return the facets, oriented so that normals point out of the solid."""
    (one, other), agree = pairs[0].T, pairs[1]
    m = len(facets)
    part, number = linked(m, one, other)
    turn = np.where(agree, 0, m)  # indices m to 2 m: facets with reversed orientation
    sheet, sheets = linked(2 * m, np.append(one, one + m), np.append(other + turn, other + m - turn))
    if sheets != 2 * number:
        raise ValueError("SurfaceMesh: the surface has one side only, must have an inside and an outside")
    first = np.unique(part, return_index=True)[1]
    facets = _flipped(facets, sheet[:m] != sheet[first][part])
    corners = x[facets] - x.mean(axis=0)
    volume = np.bincount(part, np.linalg.det(corners - corners[first][part][:, :1]))
    area = np.bincount(part, Facets(x, facets).area)
    flat = np.abs(volume) <= NEAR * np.ptp(x, axis=0).max() * area
    if flat.any():
        what = f"the part of the surface at {_place(x[facets[first[flat][0], 0]])} m has no volume"
        raise ValueError(f"SurfaceMesh: {what}, must bound a solid")
    facets = _flipped(facets, (volume < 0)[part])
    if number == 1:
        return facets
    around = np.array([_winding(x[facets[part != k]] - x[facets[first[k], 0]]) for k in range(number)])
    return _flipped(facets, (np.rint(around) % 2 == 1)[part])


def _flipped(facets: NDArray[np.int64], which: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Reverse the orientation of the flagged facets."""
    return np.where(which[:, None], facets[:, ::-1], facets)


def _winding(x: NDArray[np.float64]) -> float:
    """Return the winding number of the surface with facets x (m, d, d) about the origin.

    Source: van Oosterom and Strackee (1983), for the solid angle of a triangle.
    """
    r, d = np.linalg.norm(x, axis=2), x.shape[1]
    if d == 2:
        return float(np.arctan2(np.linalg.det(x), np.einsum("md,md->m", x[:, 0], x[:, 1])).sum() / (2 * np.pi))
    dots = np.einsum("mkd,mkd->mk", x, np.roll(x, -1, axis=1))
    under = r.prod(axis=1) + (dots * np.roll(r, 1, axis=1)).sum(axis=1)
    return float(np.arctan2(np.linalg.det(x), under).sum() / (2 * np.pi))


def _check_crossings(x: NDArray[np.float64], facets: NDArray[np.int64], table: Facets) -> None:
    """Raise ValueError for a surface that crosses or touches itself."""
    ends = facets if x.shape[1] == 2 else _sides(facets)[0]
    a, b = x[ends].swapaxes(0, 1)
    at, facet = table.tree.within((a + b).T / 2, np.linalg.norm(b - a, axis=1) / 2)
    separate = (ends[at][:, :, None] != facets[facet][:, None]).all(axis=(1, 2))
    at, facet = at[separate], facet[separate]
    below, above = table.heights(a[at].T, facet), table.heights(b[at].T, facet)
    cross = (below * above <= 0) & (below != above)
    at, facet = at[cross], facet[cross]
    y = a[at] + (below[cross] / (below - above)[cross])[:, None] * (b - a)[at]
    wrong = np.flatnonzero(table.inside(y.T, facet))
    if len(wrong):
        raise ValueError(
            f"SurfaceMesh: the surface crosses or touches itself at {_place(y[wrong[0]])} m, must be simple"
        )
