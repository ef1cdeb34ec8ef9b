# SPDX-License-Identifier: MIT
"""Seeded bodies: the reference geometry of their particle domains, and their material points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import asked, at_places, instance, numbers
from mpm_dolfinx.grid.grid import FACES, SIDES, Grid, begin_with, in_chunks
from mpm_dolfinx.parallel.exchange import together
from mpm_dolfinx.points.cutting import centroids, domain_volumes, volumes
from mpm_dolfinx.points.material_points import MaterialPoints


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """A seeded body: the reference geometry of all its particle domains, on every process.

    A reference domain is a box of a lattice, or a part of a mesh cell.  The function `map` moves the corners of
    reference domains to the seeded positions.
    """

    material: int = 0  # index in the scene's list of materials
    map: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None  # moves corners of reference domains

    def __len__(self) -> int:
        raise NotImplementedError

    def __repr__(self) -> str:
        """Return one line with the number of domains, the bounding box before mapping, the material and the sides."""
        low, high = (f"[{' '.join(f'{x:.6g}' for x in corner)}]" for corner in self.bounds)
        what = f"{type(self).__name__}({len(self)} domains in {self.dim}D, {low} to {high} m"
        return f"{what}, material {self.material}, sides {', '.join(self.names) or 'without names'})"

    @property
    def dim(self) -> int:
        """Number d of dimensions."""
        raise NotImplementedError

    def lower_of(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the lower corners (n, d), in m, of the bounding boxes of the chosen reference domains."""
        return self.reference(chosen).min(axis=1)

    def sides_of(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each face (domain, axis, end) of the chosen domains lies on the body's surface, (n, d, 2)."""
        raise NotImplementedError

    @property
    def lower(self) -> NDArray[np.float64]:
        """Lower corners (n, d), in m, of the bounding boxes of all reference domains."""
        return self.lower_of(slice(None))

    @property
    def sides(self) -> NDArray[np.bool_]:
        """Whether each face (domain, axis, end) of all domains lies on the body's surface, (n, d, 2)."""
        return self.sides_of(slice(None))

    @property
    def centre(self) -> NDArray[np.float64]:
        """Reference positions (n, d), in m, of the centres of all domains."""
        return self.centre_of(slice(None))

    def centre_of(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the reference positions (n, d), in m, of the centres of the chosen domains."""
        return centroids(self.reference(chosen))

    @cached_property
    def spacing(self) -> NDArray[np.float64]:
        """Smallest edge lengths (d,), in m, of the bounding boxes of the reference domains."""
        return np.min([self.boxes(part).min(axis=0) for part in in_chunks(len(self))], axis=0)

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner (d,), in m, of the bounding box of all reference domains."""
        low, high = np.full((2, self.dim), [[np.inf], [-np.inf]])
        for part in in_chunks(len(self)):
            lower = self.lower_of(part)
            low = np.minimum(low, lower.min(axis=0))
            high = np.maximum(high, (lower + self.boxes(part)).max(axis=0))
        return low, high

    @property
    def aligned(self) -> bool:
        """Whether the domains are boxes with edges along the axes."""
        return self.map is None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sides."""
        return tuple(SIDES[self.dim])

    def named(self, name: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the faces on the side `name`: the indices of their domains (n,), ascending, and face indices (n,)."""
        return self.facing(*SIDES[self.dim][name]) if name in self.names else (np.empty(0, np.int64),) * 2

    def facing(self, axis: int, end: int, least: float = 0.0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the surface faces with normals along an axis: indices of their domains (n,), and face indices (n,).

        `end`: 0 for normals in the negative direction, 1 for the positive direction.
        `least`: in bodies from meshes, smallest component of the unit normals along the axis.
        """
        row = self._with_face(axis, end)
        return row, np.full(len(row), 2 * axis + end)

    def _with_face(self, axis: int, end: int) -> NDArray[np.int64]:
        """Return the domains with a surface face at the lower (0) or upper (1) end of an axis."""
        rows = [part.start + np.flatnonzero(self.sides_of(part)[:, axis, end]) for part in in_chunks(len(self))]
        return np.concatenate([np.empty(0, np.int64), *rows])

    def across(self, axis: int) -> tuple[float, float]:
        """Return the mean number of domains along an axis, and their mean edge length in m."""
        return len(self) / max(1, len(self._with_face(axis, 0))), self._mean_edge(axis)

    def _mean_edge(self, axis: int) -> float:
        """Return the mean edge length, in m, of the bounding boxes of the reference domains along an axis."""
        return sum(float(self.boxes(part)[:, axis].sum()) for part in in_chunks(len(self))) / len(self)

    def outer(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return all surface faces, sorted by face index: the indices of their domains (n,), and face indices (n,)."""
        rows = [self._with_face(axis, end) for axis in range(self.dim) for end in (0, 1)]
        return np.concatenate(rows), np.repeat(np.arange(len(rows)), list(map(len, rows)))

    def reference(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the corners (n, 2^d, d), in m, of the chosen reference domains."""
        raise NotImplementedError

    def corners(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the seeded corners (n, 2^d, d), in m, of the chosen domains, after `map`."""
        return self.images(self.reference(chosen))

    def images(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the images (..., d) of reference positions (..., d) under `map`, both in m."""
        if self.map is None or not X.size:  # user maps may fail for an empty array
            return X
        x = X.reshape(-1, X.shape[-1])
        images = numbers("body: the map", asked("body: the map", "a function of positions", self.map, x), None)
        if images.shape != x.shape:
            raise ValueError(f"body: the map returns shape {images.shape}, must be {x.shape}, that of the positions")
        return images.reshape(X.shape)

    def bend(self, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the largest distance (n,), in m, of each chosen domain's edges from the images of reference edges."""
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
        """Return the edge lengths (n, d), in m, of the bounding boxes of the chosen reference domains."""
        return np.ptp(self.reference(chosen), axis=1)

    @property
    def volume_of_boxes(self) -> float:
        """Total volume, in m^d, of the bounding boxes of all reference domains."""
        return sum(float(self.boxes(part).prod(axis=1).sum()) for part in in_chunks(len(self)))

    def size(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the edge lengths (n, d), in m, of `boxes`, scaled to the volumes of the chosen seeded domains."""
        boxes = self.boxes(chosen)
        if self.aligned:
            return boxes
        ratio = volumes(self.corners(chosen)) / boxes.prod(axis=1)
        return boxes * ratio[:, None] ** (1 / self.dim)


@dataclass(frozen=True, eq=False)
class Later:
    """A body that `Simulation.stage` adds in a later stage: `Simulation(grid, [ground, Later(fill)], ...)`."""

    body: Body

    def __post_init__(self):
        instance("Later: body", self.body, Body)


@dataclass(frozen=True, eq=False)
class Moving:
    """Initial motion of bodies with inertia: `Simulation(..., inertia=Moving((0, -1)))`.

    Parameters
    ----------
    velocity : (d,) or callable x (n, d) -> (n, d), m/s
        Initial velocity of all bodies, or a function of position.
    """

    velocity: ArrayLike | Callable[[NDArray], ArrayLike]


def mapped(grid: Grid, body: Body, map: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Body:
    """Return a body with another initial shape: a map moves the corners of its particle domains.

    Reference positions X refer to the shape before the map, also in regions, probes and functions of X.  Sides keep
    their names.

    Parameters
    ----------
    grid
        Background grid.
    body
        Body from `box`, `shape`, `from_mesh`, `polygon`, or `mapped`.  An earlier map of this body is applied first.
    map
        Smooth function from positions (n, d) to positions (n, d) in the grid, both in m.  The Jacobian determinant must
        be positive.

    Raises
    ------
    ValueError
        The map raises an exception, or returns invalid values.  A mapped domain is inverted, or outside the grid.
    """
    begin_with("body: grid", grid)
    instance("body to map", body, Body)
    inner = body.map
    bent = replace(body, map=map if inner is None else lambda x: map(np.asarray(inner(x), dtype=float)))
    smallest, where = np.inf, None
    for part in in_chunks(len(bent)):
        corners = bent.corners(part)
        out = np.flatnonzero(grid.outside(corners.reshape(-1, grid.dim) - grid.base))
        if len(out):
            x = corners.reshape(-1, grid.dim)[out[0]]
            raise ValueError(
                f"body: the map moves a corner to {x}, must not be outside the grid {grid.lower} to {grid.upper}"
            )
        volume = volumes(corners)
        if volume.min() < smallest:
            smallest, where = volume.min(), body.centre_of(part)[volume.argmin()]
    if not smallest > 0:
        raise ValueError(f"body: the map turns the domain at {where} inside out, must preserve orientation")
    return bent


def check_inside(grid: Grid, body: Body, name: str = "body") -> Body:
    """Return the body, or raise ValueError for a body outside the grid."""
    count, where = 0, None
    for part in in_chunks(len(body) if body.map is None else 0):
        lower = body.lower_of(part) - grid.base
        out = np.flatnonzero(grid.outside(lower) | grid.outside(lower + body.boxes(part)))
        where = body.centre_of(part)[out[0]] if len(out) and not count else where
        count += len(out)
    if count:
        raise ValueError(
            f"{name}: {count} points outside the grid, the first at {where}, must be inside {grid.lower} to "
            f"{grid.upper}"
        )
    return body


PRESSURES = "a finite number (0 by default), or a function of x"


def pressure_at(pressure: float | Callable[[NDArray], ArrayLike], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pore pressures (n,), in Pa, at positions x (n, d), from a number or a function of position."""
    if callable(pressure) and len(x):
        allowed = f"a finite number, or one for each of {len(x)} places"
        given = at_places("pressure", allowed, pressure, "x", x)
        return np.broadcast_to(numbers("pressure(x)", given, (), (len(x),), allowed=allowed), len(x)).copy()
    return np.full(len(x), 0.0 if callable(pressure) else float(numbers("pressure", pressure, allowed=PRESSURES)))


def material_points(
    grid: Grid, bodies: Sequence[Body], pressure: float | Callable[[NDArray], ArrayLike] = 0.0
) -> MaterialPoints:
    """Return the material points of the bodies on this process."""
    starts, own = np.cumsum([0, *map(len, bodies)])[:-1], [_own(grid, body) for body in bodies]
    rows, corners = [rows for rows, _ in own], np.concatenate([corners for _, corners in own])
    ids = np.concatenate([start + row for start, row in zip(starts, rows, strict=True)])
    size = np.concatenate([body.size(row) for body, row in zip(bodies, rows, strict=True)])
    material = np.repeat(np.array([body.material for body in bodies], dtype=np.int32), list(map(len, rows)))
    x = centroids(corners)
    n = len(ids)
    return MaterialPoints(
        id=ids,
        corners=corners,
        F=np.broadcast_to(np.eye(grid.stretches), (n, grid.stretches, grid.stretches)),
        volume0=domain_volumes(corners, True) if grid.axisymmetric else size.prod(axis=1),
        material=material,
        pressure=together(grid.comm, lambda: pressure_at(pressure, x + grid.base)),
        x=x,
        origin=corners,
        reference=corners,
    )


def _own(grid: Grid, body: Body) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the domains with centroids in cells of this process, and the corners of these domains."""
    rows, corners = [np.empty(0, dtype=np.int64)], [np.empty((0, 2**grid.dim, grid.dim))]
    for part in in_chunks(len(body)):
        of_part = body.corners(part) - grid.base
        # all copies of the grid have the same partition
        own = np.flatnonzero(grid.owner(grid.number(grid.index_from_base(centroids(of_part)))) == grid.comm.rank)
        rows.append(part.start + own)
        corners.append(of_part[own])
    return np.concatenate(rows), np.concatenate(corners)


def points_in_cells(grid: Grid, bodies: Sequence[Body]) -> NDArray[np.float64]:
    """Return the number (cells,) of seeded points in each cell of the grid."""
    out = np.zeros(int(np.prod(grid.shape)))
    for body in bodies:
        for part in in_chunks(len(body)):
            x = body.centre_of(part) if body.map is None else centroids(body.corners(part))
            np.add.at(out, grid.number(grid.index(x)), 1.0)
    return out


def check_bodies(grid: Grid, bodies: Sequence[Body]) -> None:
    """Raise an error for bodies of the wrong dimension, bodies outside the grid, and repeated bodies."""
    check_different(bodies)
    for i, body in enumerate(bodies):
        if body.dim != grid.dim:
            raise ValueError(f"body {i}: has {body.dim} coordinates, must have the grid's {grid.dim}")
        check_inside(grid, body, f"body {i}")


def check_different(bodies: Sequence[Body]) -> None:
    """Raise an error for a repeated body, because conditions would count its faces twice."""
    for j, body in enumerate(bodies):
        for i in range(j):
            if bodies[i] is body:
                raise ValueError(f"bodies {i} and {j}: are the same object, must be two objects; seed each separately")
