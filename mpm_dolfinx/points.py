# SPDX-License-Identifier: MIT
"""Material points: what the body remembers while the grid is reset, and the surface of the body."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.check import all_of, asked, instance, line, numbers, whole
from mpm_dolfinx.domains import corner_bits, volumes
from mpm_dolfinx.exchange import Exchange, over_all
from mpm_dolfinx.grid import Grid, side


def determinant(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return det F (n,) of (n, d, d); numpy's own, by factors, takes twenty times as long."""
    if F.shape[1] == 2:
        return F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
    return np.einsum("ni,ni->n", F[:, 0], np.cross(F[:, 1], F[:, 2]))


@dataclass
class MaterialPoints:
    """Material points of this process; arrays over its n points.

    Attributes
    ----------
    id : (n,)
        Number of the point in the body.
    corners : (n, 2^d, d), m
        Tracked corners of the point's domain, in the order of `domains.corner_bits`.
    F : (n, d, d)
        Deformation gradient.
    volume0 : (n,), m^d
        Reference volume.
    material : (n,)
        Index of the point's material in the scene's list.
    pressure : (n,), Pa
        Pore pressure, positive in compression.
    x : (n, d), m
        Position.
    origin : (n, 2^d, d), m
        Corners from which displacements count: as seeded, or when a stage reset them.
    data : name -> (n, ...)
        What else the points carry: parameters that differ from point to point, state of the law.
    """

    id: NDArray[np.int64]
    corners: NDArray[np.float64]
    F: NDArray[np.float64]
    volume0: NDArray[np.float64]
    material: NDArray[np.int32]
    pressure: NDArray[np.float64]
    x: NDArray[np.float64]
    origin: NDArray[np.float64]
    data: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.id)

    @property
    def J(self) -> NDArray[np.float64]:
        """Volume ratio det F (n,)."""
        return determinant(self.F)

    def map(self, function: Callable[[NDArray], NDArray]) -> MaterialPoints:
        """Return points with a function applied to each of their arrays: a choice of rows, a copy, a transfer."""
        arrays = {f.name: function(getattr(self, f.name)) for f in fields(self) if f.name != "data"}
        return MaterialPoints(**arrays, data={name: function(values) for name, values in self.data.items()})

    def joined(self, other: MaterialPoints) -> MaterialPoints:
        """Return these points and others, ordered by id."""
        order = np.argsort(np.concatenate([self.id, other.id]))
        pairs = {f.name: (getattr(self, f.name), getattr(other, f.name)) for f in fields(self) if f.name != "data"}
        data = {name: np.concatenate([rows, other.data[name]])[order] for name, rows in self.data.items()}
        return MaterialPoints(**{name: np.concatenate(pair)[order] for name, pair in pairs.items()}, data=data)

    def copy(self) -> MaterialPoints:
        """Return a copy that shares no array."""
        return self.map(np.copy)

    def migrated(self, exchange: Exchange) -> MaterialPoints:
        """Return the points of this process after every point went to its destination, ordered by id."""
        received = self.map(exchange.send)
        order = np.argsort(received.id)
        return received.map(lambda rows: rows[order])

    def find(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return (which of `ids` are points of this process, their indices); points are ordered by id."""
        at = np.searchsorted(self.id, ids)
        here = np.flatnonzero((at < len(self)) & (self.id[np.minimum(at, len(self) - 1)] == ids)) if len(self) else []
        here = np.asarray(here, dtype=np.int64)
        return here, at[here]


@dataclass(frozen=True)
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
    def centre(self) -> NDArray[np.float64]:
        """Centres of the boxes (n, d), m."""
        return self.lower + 0.5 * self.spacing

    def corners(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the reference corners (m, 2^d, d), m, of domains."""
        lower = self.lower[chosen]
        corners = lower[:, None] + corner_bits(lower.shape[1]) * self.spacing
        if self.map is None:
            return corners
        x = corners.reshape(lower.shape[0] * corners.shape[1], -1)
        images = numbers("body: the map", asked("body: the map", "a function of positions", self.map, x), None)
        if images.shape != x.shape:
            raise ValueError(f"body: the map gives shape {images.shape}, must be one position each, {x.shape}")
        return images.reshape(corners.shape)

    def size(self) -> NDArray[np.float64]:
        """Return the edges (n, d), m, of boxes that are as large as the domains."""
        boxes = np.broadcast_to(self.spacing, self.lower.shape)
        if self.map is None:
            return boxes
        ratio = volumes(self.corners()) / self.spacing.prod()
        return boxes * ratio[:, None] ** (1 / len(self.spacing))


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

    Sides keep their names; regions and probes are given by places before the map.  Returns the bent body.

    Parameters
    ----------
    grid
        Background grid.
    body
        Of `box` or `shape`.
    map
        Maps positions (n, d), m, to positions (n, d), m, inside the grid; smooth, and not turning boxes inside out.

    Raises
    ------
    ValueError
        The map raises, gives another shape or nan, leads out of the grid or turns a box inside out.
    """
    instance("body: grid", grid, Grid)
    instance("body to bend", body, Body)
    bent = replace(body, map=map)
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


def material_points(grid: Grid, bodies: Sequence[Body], pressure: float = 0.0) -> MaterialPoints:
    """Return this process's material points of the bodies, at rest at pore pressure `pressure` (Pa)."""
    d = grid.dim
    corners = np.concatenate([b.corners() for b in bodies])
    size = np.concatenate([b.size() for b in bodies])
    material = np.concatenate([np.full(len(b), b.material, dtype=np.int32) for b in bodies])
    x = corners.mean(axis=1)
    mine = np.flatnonzero(grid.owner(grid.number(grid.index(x))) == grid.comm.rank)
    n = len(mine)
    return MaterialPoints(
        id=mine,
        corners=corners[mine],
        F=np.tile(np.eye(d), (n, 1, 1)),
        volume0=size[mine].prod(axis=1),
        material=material[mine],
        pressure=np.full(n, float(numbers("pressure", pressure))),
        x=x[mine],
        origin=corners[mine],
    )


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of domains on one side of the bodies, the same on every process; arrays over m faces.

    id : (m,) number of the point; xi : (m, 2, d) ends of the part of the face that counts, in the domain's
    coordinates from -1 to 1; X : (m, 2, d) their reference positions, before a map, m; whole0 : (m,) reference
    area of the whole face, m^(d-1); axis, end : side of the domain.
    """

    id: NDArray[np.int64]
    xi: NDArray[np.float64]
    X: NDArray[np.float64]
    whole0: NDArray[np.float64]
    axis: int
    end: int

    def __len__(self) -> int:
        return len(self.id)

    @property
    def area0(self) -> NDArray[np.float64]:
        """Reference area (m,) of the parts that count, m^(d-1)."""
        return self.whole0 * np.delete((self.xi[:, 1] - self.xi[:, 0]) / 2, self.axis, axis=1).prod(axis=1)

    def corners(self) -> NDArray[np.float64]:
        """Return the corners (m, 2^(d-1), d) of the parts in the domain's coordinates."""
        dim = self.xi.shape[2]
        bits = np.insert(corner_bits(dim - 1), self.axis, 0, axis=1)
        return self.xi[:, bits, np.arange(dim)]

    def reference(self, face: NDArray[np.int64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reference positions (n, d), m, of places xi (n, d) on faces."""
        (a, b), (A, B) = self.xi[face].swapaxes(0, 1), self.X[face].swapaxes(0, 1)
        t = np.divide(xi - a, b - a, out=np.zeros_like(xi), where=b > a)
        return A + t * (B - A)


Region = tuple[ArrayLike, ArrayLike]


def limits(region: Region | None, dim: int) -> NDArray[np.float64]:
    """Return the corners (2, d) of a region, m; without one, of all space."""
    if region is None:
        return np.repeat([[-np.inf], [np.inf]], dim, axis=1)
    allowed = f"two corners of {dim} coordinates each, the lower first"
    return numbers("region", region, (2, dim), allowed=allowed, test=lambda x: x[0] <= x[1])


def check_apart(bodies: Sequence[Body], present: Sequence[bool]) -> None:
    """Refuse bodies of which domains lie in each other as seeded; those that a map has bent are not looked at."""
    there = [i for i, body in enumerate(bodies) if present[i] and body.map is None]
    for i, j in combinations(there, 2):
        a, b = bodies[i], bodies[j]
        low, high = (
            np.maximum(a.lower.min(axis=0), b.lower.min(axis=0)),
            [(body.lower.max(axis=0) + body.spacing) for body in (a, b)],
        )
        size = (a.spacing + b.spacing) / 2
        if not (np.minimum(*high) - low > 1e-6 * size).all():
            continue
        distance, _ = cKDTree(a.centre / size).query(b.centre / size, p=np.inf, distance_upper_bound=1 - 1e-6)
        inside = np.flatnonzero(distance < 1 - 1e-6)
        if len(inside):
            raise ValueError(f"bodies {i} and {j}: both are at {b.centre[inside[0]]}, must not lie in each other")


def surface(
    bodies: Sequence[Body], name: str, region: Region | None = None, present: Sequence[bool] | None = None
) -> Surface:
    """Return the faces on a named side of the bodies that are present, where no other of them touches.

    Parameters
    ----------
    name
        Side: "left", "right", "bottom", "top", in 3D also "front", "back".
    region : ((d,), (d,)), m
        Box of reference positions that limits the faces; faces partly in it count with that part.
    present
        Which bodies are there, by default all.
    """
    there = [body for i, body in enumerate(bodies) if present is None or present[i]]
    dim = bodies[0].lower.shape[1]
    axis, end = side(name, dim)
    tangential = np.arange(dim) != axis
    low, high = limits(region, dim)
    start, ids, xis, Xs, wholes = 0, [], [], [], []
    for body in bodies:
        chosen = np.flatnonzero(body.sides[:, axis, end] & any(body is other for other in there))
        box = np.stack([body.lower[chosen], body.lower[chosen] + body.spacing], axis=1)
        face = box.copy()
        face[:, :, axis] = box[:, end, None, axis]
        part = np.stack([np.maximum(face[:, 0], low), np.minimum(face[:, 1], high)], axis=1)
        on = (part[:, 1] > part[:, 0])[:, tangential].all(axis=1)
        on &= ~_touched(face.mean(axis=1), axis, end, [other for other in there if other is not body])
        on &= (face[:, 0, axis] >= low[axis] - 1e-12) & (face[:, 0, axis] <= high[axis] + 1e-12)
        part[:, :, axis] = face[:, :, axis]
        ids.append(start + chosen[on])
        xis.append((2 * part - box.sum(axis=1, keepdims=True))[on] / body.spacing)
        Xs.append(part[on])
        wholes.append(np.linalg.norm(face_vectors(body.corners(chosen[on]), axis, end), axis=1))
        start += len(body)
    return Surface(*map(np.concatenate, (ids, xis, Xs, wholes)), axis, end)


def _touched(centre: NDArray[np.float64], axis: int, end: int, others: Sequence[Body]) -> NDArray[np.bool_]:
    """Return which faces, given by their centres (m, d) in the reference configuration, lie on one of other bodies."""
    out = np.zeros(len(centre), dtype=bool)
    for body in others:
        just_outside = centre / body.spacing
        just_outside[:, axis] += 1e-6 * (2 * end - 1)
        distance, _ = cKDTree(body.centre / body.spacing).query(just_outside, p=np.inf, distance_upper_bound=0.5)
        out |= distance < 0.5
    return out


def interpolate(corners: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions (m, d) in domains (m, 2^d, d) at local coordinates (m, d) from -1 to 1."""
    signs = 2 * corner_bits(xi.shape[1]) - 1
    N = (0.5 * (1 + signs * xi[:, None, :])).prod(axis=2)
    return np.einsum("mk,mkd->md", N, corners)


def face_vectors(corners: NDArray[np.float64], axis: int, end: int) -> NDArray[np.float64]:
    """Return the outward area vectors (m, d), m^(d-1), of one face of domains (m, 2^d, d)."""
    dim = corners.shape[2]
    face = corners[:, corner_bits(dim)[:, axis] == end]
    if dim == 2:
        t = face[:, 1] - face[:, 0]
        n = np.stack([t[:, 1], -t[:, 0]], axis=1) * (1 if axis == 0 else -1)
    else:
        n = 0.5 * np.cross(face[:, 3] - face[:, 0], face[:, 2] - face[:, 1])
        n *= 1 if axis != 1 else -1
    return n * (1 if end else -1)


@dataclass(frozen=True)
class Probes:
    """Tracked positions: material particles whose displacement is wanted; m of them.

    x0 : (m, d) reference positions; id : (m,) the domain that holds each; xi : (m, d) place in it;
    bodies: those of the scene that they are for.
    """

    x0: NDArray[np.float64]
    id: NDArray[np.int64]
    xi: NDArray[np.float64]
    bodies: tuple[Body, ...] = ()

    def check(self, bodies: Sequence[Body], present: Sequence[bool]) -> None:
        """Refuse, with a ValueError, a scene of other bodies, or one from which a probed body has gone."""
        if len(bodies) != len(self.bodies) or not all(map(_same, bodies, self.bodies)):
            what = f"made for {len(self.bodies)} bodies, the scene has {len(bodies)}"
            raise ValueError(f"probes: {what}; must be made with all bodies of the scene, in its order")
        body = np.searchsorted(np.cumsum([len(b) for b in bodies]), self.id, side="right")
        gone = np.flatnonzero(~np.asarray(present)[body])
        if len(gone):
            raise ValueError(f"probe at {self.x0[gone[0]]}: in body {body[gone[0]]}, must be in one that is there now")

    def displacement(self, points: MaterialPoints, comm) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, on every process."""
        here, at = points.find(self.id)
        u = np.zeros_like(self.x0)
        u[here] = interpolate(points.corners[at] - points.origin[at], self.xi[here])
        return over_all(comm, u)


def _same(a: Body, b: Body) -> bool:
    """Whether two bodies have the same points."""
    return a is b or (a.lower.shape == b.lower.shape and np.array_equal(a.lower, b.lower))


def positions(x0: ArrayLike, dim: int) -> NDArray[np.float64]:
    """Return places where something is probed, as an array (m, d), m."""
    allowed = f"positions of {dim} finite coordinates"
    x = np.atleast_2d(numbers("probes: x0", x0, None, allowed=allowed))
    if x.shape[1:] != (dim,):
        raise ValueError(f"probes: x0 = {line(x0)}, must be {allowed}")
    return x


def probes(bodies: Sequence[Body], x0: ArrayLike) -> Probes:
    """Return probes: material particles whose displacement a run records, the `probes` of `Simulation.run`.

    Parameters
    ----------
    bodies
        All bodies of the scene, in its order.
    x0 : (m, d), m
        Reference positions, before a map, inside or on the surface of the bodies.  Where bodies touch, a position
        belongs to the first of them: keep off by a little to have the other.

    Raises
    ------
    ValueError
        A position outside the bodies; from the run: other bodies than the scene's, or one that is not there now.
    """
    all_of("probes: bodies", bodies, Body, 1)
    x0 = positions(x0, bodies[0].lower.shape[1])
    centre = np.concatenate([b.centre for b in bodies])
    spacing = np.concatenate([np.broadcast_to(b.spacing, b.lower.shape) for b in bodies])
    ids = np.empty(len(x0), dtype=np.int64)
    for i, x in enumerate(x0):  # a handful of positions, once a scene
        far = np.abs((centre - x) / spacing).max(axis=1)
        ids[i] = np.flatnonzero(far <= far.min() + 1e-9)[0]
    xi = 2 * (x0 - centre[ids]) / spacing[ids]
    far = np.flatnonzero((np.abs(xi) > 1 + 1e-9).any(axis=1))
    if len(far):
        raise ValueError(f"probe at {x0[far[0]]}: outside the bodies, must be in one or on its surface")
    return Probes(x0, ids, xi, tuple(bodies))
