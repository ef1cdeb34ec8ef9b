# SPDX-License-Identifier: MIT
"""Particle domains cut by the grid into pieces.  A piece is the part of a domain in one cell.

A material point has a quadrilateral or hexahedral domain with tracked corners.  Volumes and centroids of the pieces are
exact, and in 3D also mean products of coordinates.  Gradients of Q1 functions are linear within a cell, in 3D bilinear.
One quadrature point in each piece therefore integrates these gradients exactly.

The surface of a domain consists of four edges, or in 3D of four triangles about the middle of each face.  The grid
planes slice this surface, one axis after the other.  Gauss's theorem gives the volume and the first moments of each
piece.  Inverted parts of a domain have negative volume.  Pieces with negative volume are omitted.

In axisymmetry, pieces are rings.  The volume of a ring is `2 pi r_c` times the area of its meridional section, where
r_c is the centroid radius of the section (Pappus).  Gradients are evaluated at the centroid of the volume,
`(mean r^2 / r_c, mean r z / r_c)`.  The circumferential strain `u_r / r` is the mean of the radial displacement u_r
over the section, divided by r_c.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.grid.grid import ABOUT_MIDDLE, FACE_SIGNS, FACES, TURN, Grid, corner_bits, in_chunks, sum_by

SLIVER = NEAR**2
"""Smallest volume of a piece, divided by the volume of its domain.  Source: epsilon."""
CHUNK = 2**15  # simplices cut in one call, so that they fit into the processor's cache
TANGLED = 0.2  # smallest volume inside the corners, divided by the point's volume, without re-initialisation


@dataclass
class Pieces:
    """Pieces of particle domains.  Arrays have a row for each of m pieces, ordered by point and cell."""

    point: NDArray[np.int64]  # (m,) index of the domain
    cell: NDArray[np.int64]  # (m,) lexicographic index of the cell
    fraction: NDArray[np.float64]  # (m,) volume of the piece, divided by the volume of the domain
    x: NDArray[np.float64]  # (m, d) centroid, m
    # (m, d, 2) on request, else (m, 0, 2): area on the lower and upper face of the cell along each axis, m^(d-1)
    faces: NDArray[np.float64]
    # (m, d) in 3D, else (m, 0): mean product of the offsets from the centroid along the two other axes, m^2
    mixed: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    # (m, 4) in axisymmetry, else (m, 0): offset (2,) of the section's centroid from the cell's midpoint, m; mean over
    # the section of the product of both offsets from this midpoint, m^2; radius of the section's centroid, m
    hoop: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    # (m, d, d) on request, else (m, 0): second moments about the centroid, divided by volume, m^2; in axisymmetry for
    # pieces with sections symmetric about their centroids
    second: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))


@cache
def kuhn_simplices(dim: int) -> NDArray[np.int64]:
    """Return the indices (d!, d+1) of the corners of Kuhn's simplices of a domain or face."""
    return np.array([[sum(1 << a for a in p[:k]) for k in range(dim + 1)] for p in permutations(range(dim))])


@cache
def simplices(dim: int) -> NDArray[np.int64]:
    """Return the simplices (4 or 24, d+1) of a domain: indices of their vertices in the result of `vertices`.

    The vertices of a simplex are the corners of a facet of the surface, oriented outward, and the middle of the domain.
    """
    rings = FACES[dim][:, [0, 1, 3, 2][: 2 ** (dim - 1)]]
    facets = []
    for face, (ring, sign) in enumerate(zip(rings, FACE_SIGNS, strict=False)):
        ring = ring[::sign]
        if dim == 2:
            facets.append(ring)
        else:
            facets += [(a, b, 8 + face) for a, b in zip(ring, np.roll(ring, -1), strict=True)]
    return np.pad(facets, ((0, 0), (0, 1)), constant_values=(4, 14)[dim - 2])


def vertices(y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners y (2^d, d, n) of domains, then in 3D the middles of faces, and last the middles of domains."""
    faces = [y[index].sum(axis=0) / 4 for index in FACES[3]] if y.shape[1] == 3 else []
    return np.concatenate([y, *(v[None] for v in faces), np.add.reduce(y)[None] / len(y)])


def simplex_volumes(v: NDArray[np.float64], most: int | None = None) -> NDArray[np.float64]:
    """Return the signed volumes (k, n) of all, or of the first `most`, simplices of n domains.  `v`: see `vertices`."""
    d, vertex = v.shape[1], simplices(v.shape[1])[:most].T
    s = v[vertex[:-1]].transpose(0, 2, 1, 3).reshape(d, d, -1)
    height = s[0] - v[vertex[-1]].transpose(1, 0, 2).reshape(d, -1)
    volume = np.add.reduce(_area_vectors(s) * height) / d
    return volume.reshape(vertex.shape[1], -1)


def volumes(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the volumes (n,), in m^d, of domains with corners (n, 2^d, d).  Inverted domains have negative volumes."""
    if corners.shape[1] == 4:
        y = np.ascontiguousarray((corners - corners[:, :1]).transpose(1, 2, 0))
        (ax, ay), (bx, by) = y[3] - y[0], y[2] - y[1]
        return (ax * by - ay * bx) / 2
    out = np.zeros(len(corners))
    for part in in_chunks(len(corners)):
        y = np.ascontiguousarray((corners[part] - corners[part, :1]).transpose(1, 2, 0))
        for (p, q, r, s), sign in zip(y[FACES[3]], FACE_SIGNS, strict=True):
            out[part] += sign * ((p + q + r + s) * cross(s - p, r - q)).sum(axis=0)
        out[part] /= 24
    return out


def cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross products (3, n) of vectors (3, n)."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def domain_volumes(corners: NDArray[np.float64], axisymmetric: bool) -> NDArray[np.float64]:
    """Return the volumes (n,) of domains with corners (n, 2^d, d), in m^d, or of rings in axisymmetry, in m^3."""
    if not axisymmetric:
        return volumes(corners)
    v = vertices(np.ascontiguousarray(corners.transpose(1, 2, 0)))
    return TURN * (simplex_volumes(v) * v[simplices(2), 0].mean(axis=1)).sum(axis=0)


def edges(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean edge vectors of domains, in m, as columns of matrices (n, d, d)."""
    signs = 2.0 * corner_bits(corners.shape[2]) - 1
    return np.einsum("nki,ka->nia", corners, signs) / 2 ** (corners.shape[2] - 1)


def centroids(corners: NDArray[np.float64], within: bool = False) -> NDArray[np.float64]:
    """Return the centroids (n, d), in m, of domains, or in axisymmetry of their sections.

    The centroid of a partly inverted domain may be outside of the domain.
    `within`: whether to move such centroids into the domain, by positive weights of inverted simplices.
    """
    parts = [_centroids(corners[part], within) for part in _chunks(len(corners), corners.shape[2])]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _centroids(corners: NDArray[np.float64], within: bool) -> NDArray[np.float64]:
    v = vertices(np.ascontiguousarray(corners.transpose(1, 2, 0)))
    volume, middle = simplex_volumes(v), v[-1]
    volume = np.abs(volume) if within else volume
    whole, moment = np.add.reduce(volume), np.zeros(middle.shape)
    for share, simplex in zip(volume, simplices(v.shape[1]), strict=True):
        moment += share * (np.add.reduce(v[simplex]) / len(simplex) - middle)
    return (middle + np.divide(moment, whole, out=np.zeros(moment.shape), where=whole != 0)).T.copy()


def tangled(corners: NDArray[np.float64], volume: NDArray[np.float64], axisymmetric: bool = False) -> NDArray[np.bool_]:
    """Return a mask (n,) of inverted domains: corners enclose much less or more than `volume` (n,), in m^d."""
    ratio = domain_volumes(corners, axisymmetric) / volume
    return (ratio < TANGLED) | (ratio > 1 / TANGLED)


def parallelepipeds(
    x: NDArray[np.float64], F: NDArray[np.float64], spacing: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return corners (n, 2^d, d), in m, of boxes with centres x and edges `spacing` (n, d), deformed by F (n, d, d)."""
    offset = (corner_bits(x.shape[1]) - 0.5) * spacing[:, None, :]
    return x[:, None] + np.einsum("nab,nkb->nka", F, offset)


def _chunks(count: int, dim: int) -> list[slice]:
    """Divide the domains into slices that fit into the cache of the processor."""
    size = CHUNK // len(simplices(dim))
    return [slice(start, start + size) for start in range(0, max(1, count), size)]


def cut(grid: Grid, corners: NDArray[np.float64], second: bool = False, faces: bool = True) -> Pieces:
    """Cut the particle domains by the grid.

    `corners` (n, 2^d, d), in m: corners of the domains, inside the grid, in the order of `corner_bits`.
    `second`: whether to compute second moments of the pieces.  `faces`: whether to compute areas on cell faces.

    Returns
    -------
    The pieces.  The volume fractions of the pieces of a domain sum to one.
    """
    chunks = _chunks(len(corners), grid.dim)
    if len(chunks) == 1:
        return _cut(grid, corners, second, faces)
    parts = [_cut(grid, corners[chunk], second, faces) for chunk in chunks]
    for chunk, part in zip(chunks, parts, strict=True):
        part.point += chunk.start
    columns = zip(*([getattr(part, f.name) for f in fields(Pieces)] for part in parts), strict=True)
    return Pieces(*map(np.concatenate, columns))


def on_planes(
    grid: Grid, true: NDArray[np.float64], x: NDArray[np.float64], axes: int, least: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions in cell units, and positions for slicing.  Positions near a grid plane are moved onto this
    plane.

    Positions for slicing are in cell units if all cells have equal size; otherwise they are in m.

    `true`: positions from the lower corner of the grid, in cell units.
    `x`, in m: the same positions, from the base of the grid.
    `axes`: array axis of the d components of a position.
    `least`, in cell sizes: smallest distance that counts as near, at least `grid.snap`.
    """
    shape = [1] * true.ndim
    shape[axes] = grid.dim
    nearest = np.rint(true)
    near = np.abs(true - nearest) < np.maximum(grid.snap, least).reshape(shape)
    y = np.where(near, nearest, true)
    if grid.even:
        return y, y
    planes = np.moveaxis(grid.places(np.moveaxis(nearest, axes, -1).astype(np.int64)), -1, axes)
    return y, np.where(near, planes, x)


def slices_in_cells(grid: Grid, s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return slices (d, d, m) as distances from the lower corner of the grid, in cell units."""
    if grid.even:
        return s
    out = s.copy()
    for a in range(grid.dim):
        i = grid.cells_along(a, s[:, a].min(axis=0))
        out[:, a] = i + (s[:, a] - grid.lines[a][i]) / grid.widths[a][i]
    return out


def _cut(grid: Grid, corners: NDArray[np.float64], second: bool, faces: bool) -> Pieces:
    d, true = grid.dim, np.ascontiguousarray(grid.in_cells(corners).transpose(1, 2, 0))
    x = true if grid.even else np.ascontiguousarray(corners.transpose(1, 2, 0))
    in_cells, y = on_planes(grid, true, x, 1)
    v = vertices(y)
    flat = (simplex_volumes(v, 1)[0] == 0).nonzero()[0]
    flat = flat[~np.logical_or.reduce(simplex_volumes(v[:, :, flat]))] if len(flat) else flat
    if len(flat):  # domains on a plane and thinner than the snapping distance: snapping would leave no volume
        in_cells[:, :, flat] = true[:, :, flat]
        y[:, :, flat] = x[:, :, flat]
        v = vertices(y)
    # segments or triangles (d, d, m): vertices and coordinates first, for fast loops in numpy
    s = np.concatenate([v[facet] for facet in simplices(d)[:, :-1]], axis=2)
    outward, owner = _area_vectors(s), np.arange(len(corners))[None].repeat(len(simplices(d)), axis=0).ravel()
    facet = np.arange(s.shape[2])
    for axis in range(d):
        s, facet = sliced(s, facet, axis, grid)
    s = slices_in_cells(grid, s)
    area = _area_vectors(s)
    area *= np.sign(np.add.reduce(area * outward.take(facet, axis=1)))  # slicing has changed the order of vertices
    return _sum(grid, _Slots(grid, in_cells), s, area, owner[facet], second, faces)


def _area_vectors(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normals of segments or triangles, with their length or area as norm."""
    e = s[1:] - s[0]
    if len(e) == 1:
        return np.array([e[0, 1], -e[0, 0]])
    (ax, ay, az), (bx, by, bz) = e
    return 0.5 * np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


class _Slots:
    """Cells in the bounding boxes of domains.  Each pair of a domain and a cell has an index, the slot."""

    def __init__(self, grid: Grid, y: NDArray[np.float64]):
        top = (grid.shape - 1)[:, None]
        self.low = np.minimum(np.maximum(np.floor(np.minimum.reduce(y)).astype(np.int64), 0), top)
        self.high = np.minimum(np.maximum(np.ceil(np.maximum.reduce(y)).astype(np.int64) - 1, self.low), top)
        self._span = span = self.high - self.low + 1
        self._stride = np.array([np.multiply.reduce(span[axis + 1 :]) for axis in range(len(span))])
        count = self._stride[0] * span[0]
        stop = count.cumsum()
        self.size = int(stop[-1]) if len(stop) else 0
        self.point = np.arange(y.shape[2]).repeat(count)
        self._start = stop - count
        number = np.arange(self.size) - self._start[self.point]
        self._place = number // self._stride[:, self.point] % span[:, self.point]
        self.cell = self.low[:, self.point] + self._place

    def of(self, owner: NDArray[np.int64], index: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the slots (n,) of n pairs: domains `owner` (n,), and cells with the grid indices `index` (d, n)."""
        before = self._start - np.add.reduce(self.low * self._stride)
        out = before.take(owner) + index[-1].astype(np.int64)  # the last stride is 1
        for place, stride in zip(index[:-1], self._stride, strict=False):
            out += place.astype(np.int64) * stride.take(owner)
        return out

    def beyond(self, values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        """For each slot, return the sum of `values` over the slots of its domain with larger indices along `axis`."""
        out = np.zeros(self.size)
        for steps in range(1, int(np.maximum.reduce(self._span[axis], initial=1))):
            has = (self._place[axis] + steps < self._span[axis][self.point]).nonzero()[0]
            out[has] += values[has + steps * self._stride[axis][self.point[has]]]
        return out


def _sum(
    grid: Grid,
    slots: _Slots,
    s: NDArray[np.float64],
    area: NDArray[np.float64],
    owner: NDArray[np.int64],
    second: bool,
    faces: bool,
) -> Pieces:
    """Return the pieces, one for each domain and cell, from sums over the slices of surfaces."""
    d = grid.dim
    index = np.floor(np.add.reduce(s) / d)
    least, most = np.minimum.reduce(s), np.maximum.reduce(s)
    ends = []
    for a in range(d):
        # a slice on a grid plane belongs to the cell that contains the body
        index[a] -= (area[a] > 0) & (most[a] == index[a])
        np.minimum(np.maximum(index[a], slots.low[a].take(owner)), slots.high[a].take(owner), out=index[a])
        flat = most[a] - least[a] < grid.snap[a]  # rounding may snap only one of two touching domains: factor 2 below
        lower = (flat & (area[a] < 0) & (most[a] - index[a] < 2 * grid.snap[a])).nonzero()[0]
        upper = (flat & (area[a] > 0) & (index[a] + 1 - least[a] < 2 * grid.snap[a])).nonzero()[0]
        ends.append((lower, upper))
    slot = slots.of(owner, index)

    def total(values, chosen=slice(None)):
        return sum_by(slot[chosen], values[chosen], slots.size)

    # integrals of (x, x^2/2, xy, xz) n_x over the slices, from the cell's lower face, and over the columns beyond
    x = s - index

    @cache
    def pair(a: int, b: int) -> NDArray[np.float64]:
        """Return the products of two coordinates, summed over the vertices of the slices."""
        return np.add.reduce(x[:, a] * x[:, b])

    sums, products = np.add.reduce(x), area[0] / (d * (d + 1))
    rows = [area[0], area[0] * sums[0] / d, products / 2 * (sums[0] ** 2 + pair(0, 0))]
    for a in range(1, d):
        rows += [products * (sums[0] * sums[a] + pair(0, a)), area[0] * sums[a] / d]
    shadow, volume, moment, *others = sum_by(slot, np.array(rows), slots.size)
    beyond = slots.beyond(shadow, 0)
    volume, moments = volume + beyond, [moment + beyond / 2]
    for within, along in zip(others[::2], others[1::2], strict=True):
        moments.append(within + slots.beyond(along, 0))
    pairs = [(1, 2), (0, 2), (0, 1)] if d == 3 else [(0, 1)] * second
    pairs += [(a, a) for a in range(d)] * second
    uneven = _products(pairs, x, sums, area[0], pair, total, slots)

    size = volume if grid.even else volume * grid.widths_of(slots.cell.T).prod(axis=1)
    whole = sum_by(slots.point, size, len(slots.low[0]))[slots.point]
    kept = (size / whole > SLIVER).nonzero()[0]
    point, cell = slots.point[kept], slots.cell.take(kept, axis=1).T
    h = grid.widths_of(cell).T  # (d, m), or (d,) if all cells are equal
    if grid.axisymmetric:
        x0, x1 = x[:, 0]
        squares = total(area[0] / 12 * (x0 + x1) * (x0**2 + x1**2)) + beyond / 3
        products = area[0] / 24 * (x0**2 * (3 * x[0, 1] + x[1, 1]) + x1**2 * (x[0, 1] + 3 * x[1, 1]))
        products = total(products + area[0] / 12 * x0 * x1 * sums[1])
        products += slots.beyond(total(area[0] * sums[1] / 2), 0) / 2
        r = s[:, 0].mean(axis=0)
        if grid.even:
            area[1] *= grid.low[0] + grid.h[0] * r  # sections normal to the axis of revolution are rings too
        else:
            area[1] *= grid.lines[0][index[0].astype(int)] + grid.widths[0][index[0].astype(int)] * (r - index[0])
    sections = np.empty((d * faces, 2, len(kept)))
    for a, part in enumerate(sections):
        shadow = total(area[a]) if a else shadow
        beyond = slots.beyond(shadow, a)
        lower, upper = total(area[a], ends[a][0]), total(area[a], ends[a][1])
        # areas of the body's sections just above the lower and just below the upper face
        np.multiply([(beyond + shadow - lower)[kept], (beyond + upper)[kept]], np.multiply.reduce(h) / h[a], out=part)

    # centroids are kept away from grid lines, inside the cell of the piece
    volume = volume[kept]
    hoop = np.empty((len(kept), 0))
    spread = np.zeros((len(kept), d, d))
    middle = np.array([m[kept] / volume for m in moments]).T.copy()
    centroid = np.minimum(np.maximum(middle, grid.snap), 1 - grid.snap)
    for (a, b), product in zip(pairs, uneven, strict=True):
        # rounding may spoil the mean in very thin pieces: it is clipped to its exact range
        mean = product[kept] / volume - middle[:, a] * middle[:, b]
        mean = np.minimum(np.maximum(mean, 0.0 if a == b else -0.25), 0.25)
        spread[:, a, b] = spread[:, b, a] = mean * h[a] * h[b]
    columns = [(1, 2), (0, 2), (0, 1)] if d == 3 else []
    mixed = np.array([spread[:, a, b] for a, b in columns]).T.copy().reshape(len(kept), len(columns))
    if grid.axisymmetric:
        ends = cell[:, [0]] + [0, 1]
        if faces:
            sections[0] *= TURN * (grid.low[0] + grid.h[0] * ends if grid.even else grid.lines[0][ends]).T
            sections[1] *= TURN
        radius, centroid, hoop = _rings(grid, cell, centroid, squares[kept] / volume, products[kept] / volume)
        volume = volume * radius if grid.even else volume * h.prod(axis=0) * radius
        spread = of_rings(spread, hoop[:, 3])
    elif not grid.even:
        volume = volume * h.prod(axis=0)
    fraction, x = volume / sum_by(point, volume, len(slots.low[0]))[point], grid.places(cell, centroid)
    moments = spread if second else np.empty((len(kept), 0))
    areas = np.ascontiguousarray(np.abs(sections).transpose(2, 0, 1))
    return Pieces(point, grid.number(cell), fraction, x, areas, mixed, hoop, moments)


def spreads(corners: NDArray[np.float64], rings: bool) -> NDArray[np.float64]:
    """Return the second moments (n, d, d) of domains about their centroids, divided by their volumes, in m^2.

    `rings`: whether the domains are meridional sections of rings.
    """
    E = edges(corners)
    out = E @ E.swapaxes(1, 2) / 12  # 1/12: second moment of a unit length, exact
    return of_rings(out, centroids(corners)[:, 0]) if rings else out


def of_rings(spread: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the second moments (n, 2, 2) of rings about their centroids, divided by their volumes, in m^2.

    `spread` (n, 2, 2), in m^2: second moments of the meridional sections, divided by their areas.
    `radius` (n,), in m: centroid radii of the sections.
    """
    off = spread[:, 0] / radius[:, None]
    return spread - off[:, :, None] * off[:, None]


def _rings(
    grid: Grid, cell: NDArray[np.int64], c: NDArray[np.float64], squares: NDArray, products: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the radii of pieces, the centroids of their volumes in cell coordinates, and `hoop` of `Pieces`."""
    (h, height), (x, z) = grid.widths_of(cell).T, c.T
    squares = np.minimum(np.maximum(squares, x**2), x)  # rounding may violate these bounds in very thin pieces
    products = np.minimum(np.maximum(products, np.maximum(0.0, x + z - 1)), np.minimum(x, z))
    inner = grid.low[0] + h * cell[:, 0] if grid.even else grid.lines[0][cell[:, 0]]
    radius = inner + h * x
    of_volume = np.stack([inner * x + h * squares, inner * z + h * products], axis=1) / radius[:, None]
    product = h * height * (products - (x + z) / 2 + 0.25)
    hoop = np.stack([h * (x - 0.5), height * (z - 0.5), product, radius], axis=1)
    return radius, np.minimum(np.maximum(of_volume, grid.snap), 1 - grid.snap), hoop


def _products(
    pairs: Sequence[tuple[int, int]],
    x: NDArray[np.float64],
    sums: NDArray[np.float64],
    area: NDArray[np.float64],
    pair: Callable[[int, int], NDArray[np.float64]],
    total: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    slots: _Slots,
) -> list[NDArray[np.float64]]:
    """Return integrals of products x_a x_b over each piece, with x relative to the lower corner of its cell."""
    d = len(x)

    def mean(*factors: int) -> NDArray[np.float64]:
        """Return the integral over each slice of a product of up to three coordinates, or of 1 without factors."""
        if not factors:
            return area
        if len(factors) == 1:
            return area / d * sums[factors[0]]
        if len(factors) == 2:
            (a, b), of = factors, sums
            return area / (d * (d + 1)) * (of[a] * of[b] + pair(a, b))
        a, b, c = factors
        pairs = sums[a] * pair(b, c) + sums[b] * pair(a, c) + sums[c] * pair(a, b)
        cubes = (x[:, a] * x[:, b] * x[:, c]).sum(axis=0)
        return area / (d * (d + 1) * (d + 2)) * (sums[a] * sums[b] * sums[c] + pairs + 2 * cubes)

    out = []
    for a, b in pairs:
        rest = [axis for axis in (a, b) if axis]
        out.append((total(mean(0, a, b)) + slots.beyond(total(mean(*rest)), 0)) / (3 - len(rest)))
    return out


def cut_faces(
    grid: Grid, corners: NDArray[np.float64], local: NDArray[np.float64], least: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Cut faces of domains by the grid, and return integration points that are exact for products of Q1 functions.

    `corners` (faces, 2^(d-1), d), in m: corners of the faces; triangles repeat their last corner.
    `local` (faces, 2^(d-1), e): e values at the corners, which are interpolated to the points.
    `least`: see `on_planes`.

    Returns
    -------
    Index (n,) of the face of each of n points.
    Position (n, d) of each point.
    Values (n, e) interpolated from `local` to each point.
    Fraction (n,) of the face that each point represents.
    Middle (n, d) of the segment or triangle of each point.
    """
    d, m = grid.dim, len(corners)
    y = on_planes(grid, grid.in_cells(corners), corners, 2, least)[1]
    both = np.concatenate([y, local], axis=2).transpose(1, 2, 0)
    split = [(0, 1)]
    if d == 3:
        three = (both[2] == both[3]).all(axis=0)  # triangles, about a corner
        both, split = np.concatenate([both, np.where(three, both[2], both.sum(axis=0) / 4)[None]]), ABOUT_MIDDLE
    whole = np.concatenate([both[list(simplex)] for simplex in split], axis=2)
    count = whole.shape[2]
    # sizes are computed from local coordinates, which are never degenerate; a triangle is half of a face
    size = _size(whole[:, d:]).reshape(len(split), m)
    share = (size / np.add.reduce(size)).ravel()
    s = np.concatenate([whole, np.eye(d)[:, :, None].repeat(count, axis=2)], axis=1)  # last: barycentric coordinates
    owner = np.arange(count)
    for axis in range(d):
        s, owner = sliced(s, owner, axis, grid)
    kept = (_size(s[:, -d:-1]) * share[owner] > SLIVER).nonzero()[0]  # slices that only touch a plane are left out
    s, owner = s[:, :, kept], owner[kept]
    if d == 3:
        s, owner = _polygons(grid, s, owner)
    share = _size(s[:, -d:-1]) * share[owner]
    s, owner = s[:, :-d], owner % max(1, m)
    share /= sum_by(owner, share, m)[owner]  # slices left out must not reduce a face

    def place(y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions (n, d), in m, relative to the base."""
        return grid.low + grid.h * y if grid.even else y

    points = (_RULES[d] @ s.reshape(d, -1)).reshape(len(_RULES[d]), *s.shape[1:])
    count = len(_RULES[d])
    middle = place(np.add.reduce(s[:, :d]).T / d)[None].repeat(count, axis=0).reshape(-1, d)
    points = points.transpose(0, 2, 1).reshape(-1, both.shape[1])
    face, share = (rows[None].repeat(count, axis=0).ravel() for rows in (owner, share / count))
    return face, place(points[:, :d]), points[:, d:], share, middle


def _polygons(
    grid: Grid, s: NDArray[np.float64], owner: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Divide the part of each face in each cell into triangles that do not depend on the order of the cuts."""
    cut = np.bincount(owner, minlength=1)[owner] > 1
    part, of = s[:, :, cut], owner[cut]
    cell = np.floor(slices_in_cells(grid, part[:, :3]).mean(axis=0)).astype(np.int64)
    cell -= cell.min(axis=1, initial=0, keepdims=True)
    keys = np.ravel_multi_index((of, *cell), (owner.max(initial=0) + 1, *(cell.max(axis=1, initial=0) + 1)))
    _, first, group = np.unique(keys, return_index=True, return_inverse=True)
    v, group = np.concatenate(list(part), axis=1), np.tile(group, 3)
    near = grid.snap.max()  # corners nearer to a plane lie on it
    two = slice(-3, -1)  # two barycentric coordinates, from which areas are computed
    middle = sum_by(group, v[two], len(first)) / np.bincount(group)
    order = np.lexsort((np.arctan2(*(v[two] - middle[:, group])), group))
    v, group = v[:, order], group[order]
    after = _around(group)
    distinct = np.abs(v[two, after] - v[two]).max(axis=0) > near
    v, group = v[:, distinct], group[distinct]
    after = _around(group)
    before = np.empty_like(after)
    before[after] = np.arange(len(after))
    a, b = v[two] - v[two, before], v[two, after] - v[two]
    bend = np.abs(a[0] * b[1] - a[1] * b[0])
    corner = bend > near * (np.linalg.norm(a, axis=0) + np.linalg.norm(b, axis=0))
    v, group = v[:, corner], group[corner]
    after, sides = _around(group), np.bincount(group, minlength=len(first))
    middle = sum_by(group, v, len(first)) / np.maximum(sides, 1)
    triangle = sides[group] == 3
    begins = np.diff(group, prepend=-1).nonzero()[0]
    alone = begins[triangle[begins]]
    fan = (sides[group] > 3).nonzero()[0]
    parts = np.stack([v[:, alone], v[:, after[alone]], v[:, after[after[alone]]]])
    fans = np.stack([middle[:, group[fan]], v[:, fan], v[:, after[fan]]])
    of = of[first]
    triangles = np.concatenate([s[:, :, ~cut], parts, fans], axis=2)
    return triangles, np.concatenate([owner[~cut], of[group[alone]], of[group[fan]]])


def _around(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of the next entry in the same group; the first entry follows the last. `group` ascends."""
    after, starts = np.arange(1, len(group) + 1), np.diff(group, prepend=-1).nonzero()[0]
    after[np.append(starts[1:], len(group))[: len(starts)] - 1] = starts
    return after


def _size(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return lengths of segments, or areas of triangles, up to a constant factor."""
    e = s[1:] - s[0]
    if len(e) == 1:
        return np.sqrt(np.add.reduce(e[0] ** 2))
    a, b = e  # a determinant of a . b would lose thin triangles in rounding
    return np.sqrt(sum((a[i] * b[j] - a[j] * b[i]) ** 2 for i, j in combinations(range(len(a)), 2)))


_CUBIC = (0.659027622374092, 0.231933368553031, 0.109039009072877)  # Source: Strang and Fix (1973)
_RULES = {  # Source: Gauss, Strang and Fix (1973); equal weights, exact to third order
    2: 0.5 + np.array([[1, -1], [-1, 1]]) / np.sqrt(12),
    3: np.array(list(permutations(_CUBIC))),
}


def sliced(s: NDArray[np.float64], owner: NDArray[np.int64], axis: int, grid: Grid):
    """Slice simplices by the grid planes of an axis until no simplex crosses a plane."""
    done_s, done_owner = [], []
    while True:
        least, most = np.minimum.reduce(s[:, axis]), np.maximum.reduce(s[:, axis])
        plane = np.floor(least) + 1 if grid.even else grid.next_plane(axis, least)
        crossing = most > plane
        if not np.logical_or.reduce(crossing):
            break
        below, below_owner, *above = cut_at(s.compress(crossing, axis=2), owner[crossing], axis, plane[crossing])
        done_s += [s.compress(~crossing, axis=2), below]
        done_owner += [owner[~crossing], below_owner]
        s, owner = above
    return (np.concatenate([s, *done_s], axis=2), np.concatenate([owner, *done_owner])) if done_s else (s, owner)


def cut_at(s, owner, axis: int, plane):
    """Cut each simplex at its plane.  Return parts below planes, their owners, parts above planes, their owners."""
    order = s[:, axis].argsort(axis=0)
    s = s[order[:, None], np.arange(s.shape[1])[:, None], np.arange(s.shape[2])]
    count = (s[:, axis] < plane).sum(axis=0)  # vertices below the plane
    dim = len(s) - 1
    parts, owners = {"below": [], "above": []}, {"below": [], "above": []}
    for k in range(1, dim + 1):
        chosen = (count == k).nonzero()[0]
        v, c = s.take(chosen, axis=2), plane[chosen]
        points = {(i,): v[i] for i in range(dim + 1)}
        for i in range(k):
            for j in range(k, dim + 1):
                points[i, j] = _on_plane(v[i], v[j], axis, c)
        for where, simplices in _CUTS[dim][k].items():
            parts[where] += [np.array(list(map(points.__getitem__, simplex))) for simplex in simplices]
            owners[where] += [owner[chosen]] * len(simplices)
    found = parts["below"], owners["below"], parts["above"], owners["above"]
    return [rows[0] if len(rows) == 1 else np.concatenate(rows, axis=-1) for rows in found]


def _on_plane(a, b, axis: int, plane):
    """Return the intersections of edges from a to b with the plane."""
    t = (plane - a[axis]) / (b[axis] - a[axis])
    x = a + t * (b - a)
    x[axis] = plane
    return x


_A, _B, _C = (0,), (1,), (2,)  # Source: definition, the vertices
# vertices are sorted along the axis; (i, j) is the intersection of the edge from i to j with the plane
_CUTS = {
    1: {1: {"below": [(_A, (0, 1))], "above": [((0, 1), _B)]}},
    2: {
        1: {"below": [(_A, (0, 1), (0, 2))], "above": [((0, 1), _B, _C), ((0, 1), _C, (0, 2))]},
        2: {"below": [(_A, _B, (1, 2)), (_A, (1, 2), (0, 2))], "above": [((0, 2), (1, 2), _C)]},
    },
}
