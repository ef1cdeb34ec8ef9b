# SPDX-License-Identifier: MIT
"""Bodies: how they are seeded with material points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.parallel.exchange import first
from mpm_dolfinx.points.cutting import FACES, corner_bits, domain_volumes, volumes
from mpm_dolfinx.points.grid import SIDES, Grid, in_chunks
from mpm_dolfinx.points.material_points import MaterialPoints, middle
from mpm_dolfinx.validation import asked, instance, numbers, whole


@dataclass(frozen=True, eq=False)
class Body:
    """A body as seeded: reference geometry of all its domains, the same on every process.

    lower, spacing : (n, d), (d,), m — box of each domain; sides : (n, d, 2) — whether a face of the
    domain lies on the surface of the body; map : where the corners of the boxes are put, see `mapped`.
    """

    lower: NDArray[np.float64]
    spacing: NDArray[np.float64]
    sides: NDArray[np.bool_]
    material: int = 0
    map: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None

    def __len__(self) -> int:
        return len(self.lower)

    @property
    def dim(self) -> int:
        """Number d of coordinates."""
        return self.lower.shape[1]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Reference positions (n, d), m, of the centres of the domains."""
        return self.lower + 0.5 * self.spacing

    @property
    def aligned(self) -> bool:
        """Whether the domains are boxes along the axes."""
        return self.map is None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sides."""
        return tuple(SIDES[self.dim])

    def named(self, name: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the domains (m,) that have a face on a side, ascending, and the numbers (m,) of these faces."""
        return self.facing(*SIDES[self.dim][name]) if name in self.names else (np.empty(0, np.int64),) * 2

    def facing(self, axis: int, end: int, least: float = 0.0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the domains (m,) with a face on the surface that looks towards an end of an axis, and its numbers.

        Of unstructured bodies, whose normal has its largest component there, and not below `least`.
        """
        row = np.flatnonzero(self.sides[:, axis, end])
        return row, np.full(len(row), 2 * axis + end)

    def across(self, axis: int) -> tuple[float, float]:
        """Return how many domains the body has across an axis, and their edge, m; means."""
        return len(self) / max(1, int(self.sides[:, axis, 0].sum())), float(self.spacing[axis])

    def outer(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the domains (m,) and numbers (m,) of all faces on the surface, by their numbers."""
        face, row = np.nonzero(self.sides.reshape(len(self), 2 * self.dim).T)
        return row, face

    def reference(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the reference positions (m, 2^d, d), m, of the corners of domains: those before the map."""
        lower = self.lower[chosen]
        return lower[:, None] + corner_bits(self.dim) * self.spacing

    def corners(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the corners (m, 2^d, d), m, of domains, after the map."""
        return self.images(self.reference(chosen))

    @cached_property
    def lattice(self) -> tuple[int, ...] | None:
        """Domains along the axes of the lattice that they lie on, some of which may be empty; None without."""
        return tuple(self.place(np.arange(len(self))).max(axis=0) + 1)

    def place(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the places (m, d) of domains on the lattice."""
        return np.rint((self.lower[rows] - self._lowest) / self.spacing).astype(np.int64)

    @cached_property
    def _lowest(self) -> NDArray[np.float64]:
        return self.lower.min(axis=0)

    def nodes(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers (m, 2^d) of the corners of domains, the same for a corner of several; lexicographic."""
        corners = self.place(rows)[:, None] + corner_bits(self.dim)
        return np.ravel_multi_index(tuple(np.moveaxis(corners, 2, 0)), tuple(np.add(self.lattice, 1)))

    def images(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the map puts reference positions (..., d), m."""
        if self.map is None or not X.size:  # a map need not have an answer for no positions
            return X
        x = X.reshape(-1, X.shape[-1])
        images = numbers("body: the map", asked("body: the map", "a function of positions", self.map, x), None)
        if images.shape != x.shape:
            raise ValueError(f"body: the map gives shape {images.shape}, must be one position each, {x.shape}")
        return images.reshape(X.shape)

    def bend(self, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return how far the middles of the domains' edges lie from the images of their middles (m,), m.

        By so much the straight edges of two domains may differ that follow the same curve.
        """
        out = np.zeros(len(chosen))
        if self.map is None:
            return out
        corners, X = self.corners(chosen), self.reference(chosen)
        for axis in range(self.dim):
            first, other = FACES[self.dim][2 * axis], FACES[self.dim][2 * axis + 1]
            middle = self.images((X[:, first] + X[:, other]) / 2)
            off = np.linalg.norm((corners[:, first] + corners[:, other]) / 2 - middle, axis=2)
            out = np.maximum(out, off.max(axis=1))
        return out

    def boxes(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the edges (m, d), m, of the boxes of domains, before the map."""
        return np.broadcast_to(self.spacing, self.lower.shape)[chosen]

    def size(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the edges (m, d), m, of boxes that are as large as domains."""
        boxes = self.boxes(chosen)
        if self.aligned:
            return boxes
        ratio = volumes(self.corners(chosen)) / boxes.prod(axis=1)
        return boxes * ratio[:, None] ** (1 / self.dim)


def box(grid: Grid, lower: ArrayLike, upper: ArrayLike, per_cell: int = 2, material: int = 0) -> Body:
    """Seed the box [lower, upper] with a lattice of points that fills it exactly; return the body.

    Parameters
    ----------
    grid
        Background grid.
    lower, upper : (d,), m
        Corners of the box, inside the grid; they need not lie on grid lines.
    per_cell
        Points per cell and direction (rounded so that they fit the box), >= 1.  With 1, bodies of a few cells'
        thickness bend too easily (a warning says so), and the error is about ten times that of 2.
    material
        Index of the material in the scene's list, >= 0.

    Raises
    ------
    ValueError
        A corner outside the grid, upper not above lower, or per_cell or material that is no such integer.
    """
    instance("body: grid", grid, Grid)
    lower, upper = (
        numbers(f"body: {name}", x, (grid.dim,), allowed=f"{grid.dim} finite coordinates")
        for name, x in (("lower", lower), ("upper", upper))
    )
    if not (upper > lower).all():
        raise ValueError(f"body: box {lower.tolist()} to {upper.tolist()}: upper must be > lower")
    material, per_cell = whole("body: material", material, 0), whole("body: per_cell", per_cell)
    count = np.maximum(1, np.rint((upper - lower) / (grid.h / per_cell))).astype(int)
    spacing = (upper - lower) / count
    index = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, grid.dim)
    sides = np.stack([index == 0, index == count - 1], axis=-1)
    return check_inside(grid, Body(lower + index * spacing, spacing, sides, material))


def shape(
    grid: Grid, inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]], per_cell: int = 2, material: int = 0
) -> Body:
    """Seed the points of the grid's own lattice whose centres are inside a shape; return the body.

    Its surface is made of steps of a point's size: for smooth sides take `mapped`.

    Parameters
    ----------
    grid
        Background grid.
    inside
        Maps positions (n, d), m, to booleans (n,).
    per_cell
        Points per cell and direction, >= 1.
    material
        Index of the material in the scene's list, >= 0.

    Raises
    ------
    ValueError
        `inside` raises, gives no booleans or holds nowhere; per_cell or material that is no such integer.
    """
    instance("body: grid", grid, Grid)
    material, per_cell = whole("body: material", material, 0), whole("body: per_cell", per_cell)
    spacing = grid.h / per_cell
    count = grid.shape * per_cell
    index = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, grid.dim)
    allowed = f"one bool a position, ({len(index)},)"
    filled = np.asarray(asked("body: inside(x)", allowed, inside, grid.lower + (index + 0.5) * spacing))
    if filled.shape != (len(index),) or filled.dtype != bool:  # a distance is neither inside nor outside
        raise ValueError(f"body: inside(x) has shape {filled.shape} of {filled.dtype}, must be {allowed}")
    padded = np.pad(filled.reshape(count), 1)
    index = index[filled]
    if not len(index):
        raise ValueError("body: inside(x) holds at no point of the grid, must hold at one; the body fits in no cell")
    sides = np.empty((len(index), grid.dim, 2), dtype=bool)
    for axis in range(grid.dim):
        for end in (0, 1):
            neighbour = index + 1
            neighbour[:, axis] += 2 * end - 1
            sides[:, axis, end] = ~padded[tuple(neighbour.T)]
    return check_inside(grid, Body(grid.lower + index * spacing, spacing, sides, material))


def mapped(grid: Grid, body: Body, map: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Body:
    """Bend a body: its boxes become the quadrilaterals or hexahedra between the images of their corners.

    Reference positions are those before all maps: regions, probes, X of fields of materials and of displacements.
    All else is judged after them: what touches, lies in one another, is flat, is loaded.  Sides keep their names.
    Returns the bent body.

    Parameters
    ----------
    grid
        Background grid.
    body
        Of `box`, `shape`, `from_mesh` or `polygon`, or of `mapped`: then its own map comes first.
    map
        Maps positions (n, d), m, to positions (n, d), m, inside the grid; smooth, and not turning boxes inside out.

    Raises
    ------
    ValueError
        The map raises, gives another shape or nan, leads out of the grid or turns a box inside out.
    """
    instance("body: grid", grid, Grid)
    instance("body to bend", body, Body)
    inner = body.map
    bent = replace(body, map=map if inner is None else lambda x: map(np.asarray(inner(x), dtype=float)))
    corners = bent.corners()
    out = np.flatnonzero(grid.outside(corners.reshape(-1, grid.dim)))
    if len(out):
        x = corners.reshape(-1, grid.dim)[out[0]]
        raise ValueError(
            f"body: the map takes a corner to {x}, must not be outside the grid {grid.lower} to {grid.upper}"
        )
    smallest = int(np.argmin(volumes(corners)))
    if not volumes(corners)[smallest] > 0:
        raise ValueError(f"body: the map turns the domain at {body.centre[smallest]} inside out, must not")
    return bent


def check_inside(grid: Grid, body: Body, name: str = "body") -> Body:
    """Return a body; refuse one that is not wholly in the grid.  What a map has bent has been looked at."""
    outside = grid.outside(body.lower) | grid.outside(body.lower + body.spacing)
    out = np.flatnonzero(outside & (body.map is None))
    if len(out):
        raise ValueError(
            f"{name}: {len(out)} points outside the grid, the first at {body.centre[out[0]]}, "
            f"must be inside {grid.lower} to {grid.upper}"
        )
    return body


def pressure_at(pressure: float | Callable[[NDArray], ArrayLike], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pore pressure as seeded (n,), Pa, a number or a function of places, at places x (n, d), m."""
    if callable(pressure) and len(x):
        allowed = f"a finite number, or one for each of {len(x)} places"
        given = asked("pressure(x)", allowed, pressure, x)
        return np.broadcast_to(numbers("pressure(x)", given, (), (len(x),), allowed=allowed), len(x)).copy()
    return np.full(len(x), 0.0 if callable(pressure) else float(numbers("pressure", pressure)))


def material_points(
    grid: Grid, bodies: Sequence[Body], pressure: float | Callable[[NDArray], ArrayLike] = 0.0
) -> MaterialPoints:
    """Return this process's material points of the bodies, at rest at a pore pressure: see `pressure_at`."""
    starts, own = np.cumsum([0, *map(len, bodies)])[:-1], [_own(grid, body) for body in bodies]
    rows, corners = [rows for rows, _ in own], np.concatenate([corners for _, corners in own])
    mine = np.concatenate([start + row for start, row in zip(starts, rows, strict=True)])
    size = np.concatenate([body.size(row) for body, row in zip(bodies, rows, strict=True)])
    material = np.repeat(np.array([body.material for body in bodies], dtype=np.int32), list(map(len, rows)))
    x = middle(corners)
    n, pressures, refused = len(mine), np.empty(0), ""
    try:
        pressures = pressure_at(pressure, x)
    except ValueError as error:
        refused = str(error)
    if refused := first(grid.comm, refused):
        raise ValueError(refused)
    return MaterialPoints(
        id=mine,
        corners=corners,
        F=np.tile(np.eye(grid.stretches), (n, 1, 1)),
        volume0=domain_volumes(corners, True) if grid.axisymmetric else size.prod(axis=1),
        material=material,
        pressure=pressures,
        x=x,
        origin=corners,
        reference=corners,
    )


def _own(grid: Grid, body: Body) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the domains (m,) whose middles are in cells of this process, and their corners (m, 2^d, d), m."""
    rows, corners = [np.empty(0, dtype=np.int64)], [np.empty((0, 2**grid.dim, grid.dim))]
    for part in in_chunks(len(body)):
        of_part = body.corners(part)
        # of all copies of the grid alike
        here = np.flatnonzero(grid.owner(grid.number(grid.index(middle(of_part)))) == grid.comm.rank)
        rows.append(part.start + here)
        corners.append(of_part[here])
    return np.concatenate(rows), np.concatenate(corners)


def check_bodies(grid: Grid, bodies: Sequence[Body]) -> None:
    """Refuse bodies of another dimension or outside of the grid, and a list that names one twice."""
    check_different(bodies)
    for i, body in enumerate(bodies):
        if body.dim != grid.dim:
            raise ValueError(f"body {i}: has {body.dim} coordinates, must have the grid's {grid.dim}")
        check_inside(grid, body, f"body {i}")


def check_different(bodies: Sequence[Body]) -> None:
    """Refuse a list that names a body twice: conditions would count its faces twice and act on one of the two."""
    for j, body in enumerate(bodies):
        for i in range(j):
            if bodies[i] is body:
                raise ValueError(f"bodies {i} and {j}: are one and the same, must be two; seed the second one anew")
