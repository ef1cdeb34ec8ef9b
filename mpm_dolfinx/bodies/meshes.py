# SPDX-License-Identifier: MIT
"""Bodies from meshes: each mesh cell becomes one or more particle domains.

Cells are divided into domains (`mesh_cells`).  Large domains are divided again, evenly in local coordinates.  The first
process reads and divides a mesh.  On several processes, each machine has one temporary file with all domains.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.base.validation import whole
from mpm_dolfinx.bodies.bodies import Body, check_inside
from mpm_dolfinx.bodies.mesh_cells import KINDS, PARTS, distinct
from mpm_dolfinx.bodies.touching import Faces, allowance, covers, face_vectors, separation, warps
from mpm_dolfinx.grid.grid import FACES, Grid, corner_bits, linked, rounding, sum_by
from mpm_dolfinx.parallel.machine_files import once_a_machine
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn
from mpm_dolfinx.points.cutting import simplex_volumes, vertices, volumes

LONG = 1.5  # domains with edges longer than this factor times (cell size / per_cell) are divided
SMALL = 0.2  # fraction of the desired domain size; smaller domains cause a warning


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh on one process.  In quadrilaterals and hexahedra, the nodes have tensor-product order."""

    x: NDArray[np.float64]  # positions of nodes (nodes, d), m
    cells: Mapping[str, NDArray[np.int64]]  # cell type -> nodes (n, k)
    parts: Mapping[str, Mapping[str, NDArray[np.int64]]]  # name of a part -> cell type -> indices of cells
    sides: Mapping[str, Sequence[NDArray[np.int64]]]  # name of a side -> nodes of its facets, arrays (m, k)

    def part(self, name: str | None) -> dict[str, NDArray[np.int64]]:
        """Return the cells of a part, or all cells, by cell type."""
        if name is not None and (not isinstance(name, str) or name not in self.parts):
            known = ", ".join(map(repr, self.parts)) or "none, for the mesh has no parts with a name"
            raise ValueError(f"mesh: part {name!r}, must be one of its parts: {known}")
        chosen = {kind: cells if name is None else cells[self.parts[name][kind]] for kind, cells in self.cells.items()}
        chosen = {kind: cells for kind, cells in chosen.items() if len(cells)}
        if not chosen:
            dim = self.x.shape[1]
            what = f"has no {' and no '.join(KINDS[dim])}" + (f" in part {name!r}" if name is not None else "")
            raise ValueError(f"mesh: {what}, must have cells to fill a body in {dim}D")
        return chosen


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MeshBody(Body):
    """A body seeded from a mesh.  Its `boxes` are the bounding boxes of the domains."""

    vertices: NDArray[np.float64]  # corners of the domains before all maps (n, 2^d, d), m
    surface: NDArray[np.bool_]  # whether a face lies on the surface of the body (n, d, 2)
    tagged: Mapping[str, NDArray[np.bool_]]  # name of a side -> whether a face belongs to the side (n, d, 2)
    numbers: NDArray[np.int64]  # indices of the domains' corners (n, 2^d); shared corners have one index

    lattice, widths = None, ()  # a mesh has no rows

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def dim(self) -> int:
        """Number d of dimensions."""
        return self.vertices.shape[2]

    def sides_of(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each face (domain, axis, end) of the chosen domains lies on the body's surface, (n, d, 2)."""
        return self.surface[chosen]

    @property
    def aligned(self) -> bool:
        """Whether all domains are boxes with edges along the axes.  This is False for bodies from a mesh."""
        return False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sides."""
        return tuple(self.tagged)

    def named(self, name: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the faces on the side `name`: the indices of their domains (n,), ascending, and face indices (n,)."""
        if name not in self.tagged:
            return (np.empty(0, np.int64),) * 2
        return np.nonzero(self.tagged[name].reshape(len(self), 2 * self.dim))

    def facing(self, axis: int, end: int, least: float = 0.0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """See `Body`."""
        row, face = self.outer()
        outward = face_vectors(self.corners(row), face)
        along = np.abs(outward).argmax(axis=1) == axis
        along &= (2 * end - 1) * outward[:, axis] > least * np.linalg.norm(outward, axis=1)
        return row[along], face[along]

    def across(self, axis: int) -> tuple[float, float]:
        """Return the approximate number of domains along an axis, and their mean edge length in m."""
        edge = self._mean_edge(axis)
        return float(np.ptp(self.vertices[:, :, axis])) / edge, edge

    def reference(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the corners (n, 2^d, d), in m, of the chosen reference domains."""
        return self.vertices[chosen]

    def nodes(self, rows: slice | NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the node indices (n, 2^d) of the corners of domains.  A corner that domains share has one index."""
        return self.numbers[rows]


def _numbered(vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the node indices of the corners of domains.  Coincident corners have one index."""
    x = vertices.reshape(-1, vertices.shape[2])
    pairs = cKDTree(x).query_pairs(NEAR * np.ptp(vertices, axis=1).min(), output_type="ndarray")
    return linked(len(x), *pairs.T)[0].reshape(vertices.shape[:2])


def seeded(
    grid: Grid,
    mesh: Callable[[], Mesh],
    name: str,
    *,
    part: str | None = None,
    per_cell: int,
    material: int,
    warns: bool = True,
) -> MeshBody:
    """Return the body of a part of a mesh, or of the whole mesh; see `from_mesh`.

    `mesh`: function that returns the mesh on rank 0.
    `warns`: whether to warn of small domains.
    """
    per_cell, material = whole("body: per_cell", per_cell), whole("body: material", material, 0)

    def arrays() -> dict[tuple[str, str], NDArray]:
        body = _divided(grid, mesh(), part, per_cell, name)
        if warns:
            _warn_small(grid, body, per_cell, name)
        tagged = {("tagged", side): rows for side, rows in body.tagged.items()}
        return {(of, ""): getattr(body, of) for of in ("vertices", "numbers", "surface")} | tagged

    found = once_a_machine(grid.comm, arrays)
    tagged = {side: found.pop(key) for key in [*found] if (side := key[1])}
    return MeshBody(**{of: array for (of, _), array in found.items()}, tagged=tagged, material=material)


def _divided(grid: Grid, mesh: Mesh, part: str | None, per_cell: int, name: str) -> MeshBody:
    """Return the body of a part of a mesh, or of the whole mesh, on one process."""
    cells = mesh.part(part)
    _check_repeated(mesh, cells, name)
    domains, keys, cell = map(np.concatenate, zip(*_domains(mesh, cells), strict=True))
    out = np.flatnonzero(grid.outside(domains.reshape(-1, grid.dim) - grid.base))
    if len(out):
        x = domains.reshape(-1, grid.dim)[out[0]]
        raise ValueError(f"{name}: has a vertex at {x}, must be inside the grid {grid.lower} to {grid.upper}")
    domains, keys = _oriented(domains, keys)
    _check_convex(domains, name)
    facets, facet = _facets(keys)
    sides = np.stack([facet.ravel(), np.repeat(cell, 2 * grid.dim)], axis=1)
    of, by = sides[distinct(sides)[0]].T
    count = np.bincount(of, minlength=len(facets))
    if count[1:].max() > 2:
        nodes = facets[1 + count[1:].argmax()]
        x = mesh.x[nodes[nodes >= 0]].mean(axis=0)
        raise ValueError(f"{name}: three cells share the facet at {x}, must be at most two cells")
    outer = (facet > 0) & (count[facet] == 1)  # facet 0: face inside a cell
    twice = (of > 0) & (count[of] == 2)
    _check_sides(mesh, domains, facets, facet, count == 2, name)
    _check_overlaps(domains, cell, np.unique(cell[outer.any(axis=1)]), by[twice].reshape(-1, 2), name)
    tagged = {side: outer & _in_side(facets, rows)[facet] for side, rows in mesh.sides.items()}
    vertices, row, kept = _split(grid, domains, per_cell)
    surface, *tagged_rows = (rows[row].reshape(kept.shape) & kept for rows in (outer, *tagged.values()))
    named = {side: rows for side, rows in zip(tagged, tagged_rows, strict=True) if rows.any()}
    node = _numbered(vertices)  # domains get equal coordinates at a shared node, to the last digit
    vertices[...] = vertices.reshape(-1, grid.dim)[np.unique(node, return_index=True)[1]][node]
    body = MeshBody(vertices=vertices, surface=surface, tagged=named, numbers=node)
    _check_conforming(body, name)
    return check_inside(grid, body, name)


def _domains(mesh: Mesh, cells: Mapping[str, NDArray[np.int64]]) -> list[tuple[NDArray, NDArray, NDArray]]:
    """Return the corners of the particle domains, the mesh facet of each face, and the cell of each domain.

    A facet is a row of node indices; for triangles, it begins with -1.  For faces inside cells, all entries are -1.
    """
    d = mesh.x.shape[1]
    start = 0
    out = []
    for kind, nodes in cells.items():
        number = start + np.arange(len(nodes))
        start += len(nodes)
        for part in PARTS[kind]:
            corners = np.stack([mesh.x[nodes[:, list(of)]].mean(axis=1) for of in part.corners], axis=1)
            keys = np.full((len(nodes), 2 * d, 2 ** (d - 1)), -1)
            for face, of in enumerate(part.faces):
                if of:
                    keys[:, face, 2 ** (d - 1) - len(of) :] = np.sort(nodes[:, list(of)], axis=1)
            out.append((corners, keys, number))
    return out


def _check_repeated(mesh: Mesh, cells: Mapping[str, NDArray[np.int64]], name: str) -> None:
    """Raise an error for cells that occur more than once."""
    for kind, nodes in cells.items():
        first, same = distinct(np.sort(nodes, axis=1))
        count = np.bincount(same)
        if (count > 1).any():
            x = mesh.x[nodes[first[count > 1][0]]].mean(axis=0)
            what = f"{np.count_nonzero(count > 1)} cells ({kind}) occur more than once, the first at {x}"
            raise ValueError(f"{name}: {what}, must occur once")


def _check_sides(
    mesh: Mesh,
    domains: NDArray[np.float64],
    facets: NDArray[np.int64],
    facet: NDArray[np.int64],
    shared: NDArray[np.bool_],
    name: str,
) -> None:
    """Raise an error if two cells lie on the same side of a common facet."""
    d, size = domains.shape[2], len(facets)
    outward = np.stack([face_vectors(domains, face) for face in range(2 * d)], axis=1).reshape(-1, d)
    of = facet.ravel()
    total = np.linalg.norm([sum_by(of, outward[:, a], size) for a in range(d)], axis=0)
    same = shared & (total > sum_by(of, np.linalg.norm(outward, axis=1), size) / 2)
    same[0] = False  # faces inside cells
    if same.any():
        nodes = facets[same.argmax()]
        x, what = mesh.x[nodes[nodes >= 0]].mean(axis=0), "have both of their cells on one side, the first at"
        raise ValueError(f"{name}: {same.sum()} facets {what} {x}; cells must not overlap")


def _check_overlaps(
    domains: NDArray[np.float64],
    cell: NDArray[np.int64],
    outer: NDArray[np.int64],
    neighbours: NDArray[np.int64],
    name: str,
) -> None:
    """Raise an error for overlapping cells.  It is sufficient to check the cells `outer` at the surface.

    `domains` (n, 2^d, d): corners of the particle domains.
    `cell` (n,): cell of each domain.
    `neighbours` (m, 2): pairs of cells that share a facet.
    """
    slack = allowance(np.ptp(domains, axis=1).min(axis=1)) + rounding(domains) + 2 * warps(domains)
    i, j = _box_overlaps(domains, np.flatnonzero(np.isin(cell, outer)), slack)
    count = cell.max() + 1
    both, shared = (np.sort(pairs, axis=1) @ [count, 1] for pairs in (np.stack([cell[i], cell[j]], axis=1), neighbours))
    separate = (cell[i] != cell[j]) & ~np.isin(both, shared)
    i, j = i[separate], j[separate]
    depth = -separation(domains[i], domains[j])
    deep = depth > slack[i] + slack[j]
    if deep.any():
        k = np.where(deep, depth, 0.0).argmax()
        one, other = domains[i[k]], domains[j[k]]
        meet = (np.maximum(one.min(axis=0), other.min(axis=0)) + np.minimum(one.max(axis=0), other.max(axis=0))) / 2
        what = f"{len(np.unique(cell[[i[deep], j[deep]]]))} cells overlap, most deeply at {meet}"
        raise ValueError(f"{name}: {what} by {depth[k]:.3g} m; cells must be apart or touch")


def _box_overlaps(
    domains: NDArray[np.float64], outer: NDArray[np.int64], slack: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of domains with overlapping bounding boxes.  The first domain of each pair belongs to `outer`."""
    low, high = domains.min(axis=1), domains.max(axis=1)
    size, middle = high - low, (low + high) / 2
    octave = np.frexp(size.max(axis=1))[1]
    of = [[rows[octave[rows] == k] for k in np.unique(octave[rows])] for rows in (outer, np.arange(len(domains)))]
    out = [np.empty((2, 0), dtype=np.int64)]
    for a, b in product(*of):
        scale = (size[a].max(axis=0) + size[b].max(axis=0)) / 2
        trees = [cKDTree(middle[rows] / scale) for rows in (a, b)]
        pairs = trees[0].sparse_distance_matrix(trees[1], 1.0, p=np.inf, output_type="ndarray")
        i, j = a[pairs["i"]], b[pairs["j"]]
        lap = np.minimum(high[i], high[j]) - np.maximum(low[i], low[j])
        overlap = (i != j) & (lap > (slack[i] + slack[j])[:, None]).all(axis=1)
        out.append(np.stack([i[overlap], j[overlap]]))
    return tuple(np.concatenate(out, axis=1))


def _oriented(domains: NDArray[np.float64], keys: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the domains with corners in right-handed order, and the mesh facets of their faces in the new order."""
    d, left = domains.shape[2], volumes(domains) < 0
    bits, face = corner_bits(d), np.arange(2 * d)
    swapped = (bits[:, [1, 0, *range(2, d)]] << np.arange(d)).sum(axis=1)
    face[:4] = [2, 3, 0, 1]
    domains, keys = domains.copy(), keys.copy()
    domains[left], keys[left] = domains[left][:, swapped], keys[left][:, face]
    return domains, keys


def _check_convex(domains: NDArray[np.float64], name: str) -> None:
    """Raise an error for cells that are flat, inverted or not convex."""
    d, bits = domains.shape[2], corner_bits(domains.shape[2])
    size = np.ptp(domains, axis=1).prod(axis=1)
    ends = np.arange(2**d)[:, None] ^ (1 << np.arange(d))
    edges = (domains[:, ends] - domains[:, :, None]) * (1 - 2 * bits)[:, :, None]
    least = np.linalg.det(edges).min(axis=1)
    of_simplices = simplex_volumes(vertices(np.ascontiguousarray(domains.transpose(1, 2, 0))))
    least = np.minimum(least, of_simplices.min(axis=0, initial=np.inf))
    invalid = np.flatnonzero(~(least > NEAR * size))
    if len(invalid):
        x = domains[invalid[0]].mean(axis=0)
        what = f"{len(invalid)} cells are flat, inverted or not convex, the first at {x}"
        raise ValueError(f"{name}: {what}; cells must be convex, with no flat corner")


def _facets(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the different mesh facets, and the facet index of each face, or 0 for faces inside cells."""
    rows = np.concatenate([np.full((1, keys.shape[2]), -1), keys.reshape(-1, keys.shape[2])])
    first, facet = distinct(rows)
    return rows[first], facet[1:].reshape(keys.shape[:2])


def _in_side(facets: NDArray[np.int64], named: Sequence[NDArray[np.int64]]) -> NDArray[np.bool_]:
    """Return which facets (m,) of a mesh belong to a side."""
    width = facets.shape[1]
    rows = [np.pad(np.sort(n, axis=1), ((0, 0), (width - n.shape[1], 0)), constant_values=-1) for n in named]
    first, at = distinct(np.concatenate([facets, *rows]))
    among = np.zeros(len(first), dtype=bool)
    among[at[len(facets) :]] = True
    return among[at[: len(facets)]]


def _split(
    grid: Grid, domains: NDArray[np.float64], per_cell: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Divide domains that are large compared with the cells of the grid.

    Return the corners and the original domain of each new domain, and which of its faces lie on the original's faces.
    """
    d = grid.dim
    bits = corner_bits(grid.dim)
    out = []
    y = grid.in_cells(domains - grid.base)
    edges = [y[:, FACES[d][2 * a + 1]] - y[:, FACES[d][2 * a]] for a in range(d)]
    longest = np.max([np.linalg.norm(e, axis=2).max(axis=1) for e in edges], axis=0)
    count = 2 ** np.ceil(np.log2(np.maximum(1.0, longest * per_cell / LONG) - SAME)).astype(np.int64)
    for n in np.unique(count):
        row = np.flatnonzero(count == n)
        index = np.stack(np.unravel_index(np.arange(n**d), (n,) * d), axis=1)
        t = (index[:, None] + bits)[:, :, None] / n
        N = np.where(bits, t, 1 - t).prod(axis=3)  # (parts, corners, corners of the whole)
        parts = np.einsum("pkl,mld->mpkd", N, domains[row]).reshape(-1, 2**d, d)
        on = np.stack([index == 0, index == n - 1], axis=2)
        out.append((parts, np.repeat(row, n**d), np.tile(on, (len(row), 1, 1))))
    return tuple(map(np.concatenate, zip(*out, strict=True)))


def _check_conforming(body: MeshBody, name: str) -> None:
    """Raise an error if surface faces of a body touch each other."""
    own = Faces.around(body)
    cover = covers(own, own)
    if len(cover.face):
        x = own.corners[cover.face[0]].mean(axis=0)[: body.dim]
        what = f"{len(np.unique(cover.face))} faces touch other faces without common nodes, the first at {x}"
        raise ValueError(f"{name}: {what}; touching faces must share nodes or belong to two parts")


def _warn_small(grid: Grid, body: MeshBody, per_cell: int, name: str) -> None:
    """Warn of domains that are much smaller than the cells of the grid."""
    cell = grid.sizes_at(body.centre - grid.base).prod(axis=-1)
    size = (volumes(body.vertices) / cell) ** (1 / grid.dim) * per_cell
    small = np.flatnonzero(size < SMALL)
    if len(small):
        what = "%s: %d of %d domains are smaller than %.3g of the grid's resolution, the first at %s; "
        what += "they cost as much as large ones; a coarser mesh is sufficient"
        warn(MPI.COMM_SELF, ResolutionWarning, what, name, len(small), len(body), SMALL, body.centre[small[0]])
