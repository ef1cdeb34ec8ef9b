# SPDX-License-Identifier: MIT
"""Background grid: a box of quadrilaterals or hexahedra between lines along the axes.

In a grid of equal cells, a division finds the cell of a point.  Other grids search the lines along each axis.  Methods
such as `sizes` and `volumes` return an entry for each cell.  If all cells are equal, `sizes` returns a single row
(`h`), and `volumes` a single number.

The mesh is created at its first use.  A simulation first distributes the cells so that processes have similar numbers
of points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, cached_property, partial, reduce
from math import prod
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.base.validation import flag, instance, line, numbers
from mpm_dolfinx.grid.following import check_follow
from mpm_dolfinx.grid.lines import MOST, checked, equal, rounding
from mpm_dolfinx.grid.partition import IMBALANCE, Partition, better, boxes, destinations
from mpm_dolfinx.parallel.exchange import Exchange, over_all

SIDES = {
    2: {"left": (0, 0), "right": (0, 1), "bottom": (1, 0), "top": (1, 1)},
    3: {"left": (0, 0), "right": (0, 1), "front": (1, 0), "back": (1, 1), "bottom": (2, 0), "top": (2, 1)},
}
"""Axis and end of each side of a box.  The end is 0 at the lower coordinate, and 1 at the upper coordinate."""
REACH = 1e-4  # distance, in cell sizes, by which bodies may lie outside the grid: penalties of walls are inexact

TURN = 2 * np.pi
"""Angle of a whole revolution.  Axisymmetric volumes, forces and outflows refer to this angle.  Source: definition."""
CHUNK = 2**14
"""Largest number of rows of an array that are processed together.  This limits the size of temporary arrays."""
SNAP = 1e-10
"""Distance, in cell sizes, below which a vertex is considered to lie on a plane of the grid; see `Grid.snap`."""
ORDER = "the order is Grid(lower, upper, cells)"
MANY = "grid: h is undefined for unequal cells, must be replaced by sizes"


def cross_in_plane(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the scalar cross products (...) of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def corner_bits(dim: int) -> NDArray[np.int64]:
    """Return coordinates (2^d, d), 0 or 1, of the corners of the unit box."""
    return (np.arange(2**dim)[:, None] >> np.arange(dim)) & 1


def _faces(dim: int) -> NDArray[np.int64]:
    """Return the corner indices of the faces of a box.  Face `2 a + e` is at end `e` (0 or 1) of axis `a`."""
    bits = corner_bits(dim)
    return np.stack([(bits[:, axis] == end).nonzero()[0] for axis in range(dim) for end in (0, 1)])


FACES = {d: _faces(d) for d in (2, 3)}
"""Corner indices (2d, 2^(d-1)) of the faces of a cell or a particle domain."""
FACE_SIGNS = (-1, 1, 1, -1, -1, 1)
"""Sign (6,) of the normal that follows from the order of the corners in `FACES`, for each face: 1 if this normal points
outward, and -1 if inward.  In 2D, only the first four signs apply.
"""
ABOUT_MIDDLE = ((0, 1, 4), (1, 3, 4), (3, 2, 4), (2, 0, 4))
"""Triangles that divide a face in 3D symmetrically.  Each triangle has two corners of the face and its middle."""


def side(name: str, dim: int) -> tuple[int, int]:
    """Return the axis and the end (see `SIDES`) of the side `name` of a box."""
    if not isinstance(name, str) or name not in SIDES[dim]:
        raise ValueError(f"side {name!r}: must be one of {', '.join(SIDES[dim])} in {dim}D")
    return SIDES[dim][name]


def in_chunks(count: int) -> list[slice]:
    """Divide `count` rows into consecutive slices of at most `CHUNK` rows.  For 0 rows the list is empty."""
    return [slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]


def sum_by(index: NDArray, values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the sums (..., size) of all values (..., n) with equal index (n,), as floats."""
    if values.ndim == 1:
        return np.bincount(index, values, size).astype(float, copy=False)
    if len(index) > CHUNK:  # the index of all rows together would take as much memory as the values
        return np.array([sum_by(index, row, size) for row in values])
    shape = values.shape[:-1]
    index = (index + size * np.arange(prod(shape))[:, None]).ravel()
    sums = np.bincount(index, values.ravel(), size * prod(shape))
    return sums.astype(float, copy=False).reshape(*shape, size)


def sums_of_rows(index: NDArray, rows: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the sums (size, ...) of all rows (n, ...) with equal index (n,), as floats."""
    return np.ascontiguousarray(np.moveaxis(sum_by(index, np.moveaxis(rows, 0, -1), size), -1, 0))


def means_of_rows(index: NDArray, weight: NDArray, rows: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return weighted means (size, ...) of rows (n, ...) with equal index (n,), or 0 where the weights (n,) are 0."""
    whole = sum_by(index, weight, size)
    sums = sum_by(index, weight * np.moveaxis(rows, 0, -1), size)
    return np.ascontiguousarray(np.moveaxis(sums / np.where(whole == 0, 1.0, whole), -1, 0))


def linked(count: int, one: NDArray[np.int64], other: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return the group index (count,) of each object, and the number of groups.  Linked objects are in one group.

    `one`, `other` (m,): the two objects of each link.
    """
    links = coo_matrix((np.ones(len(one)), (one, other)), shape=(count, count))
    number, group = connected_components(links, directed=False)
    return group.astype(np.int64), number


def polynomial(
    coefficients: NDArray[np.float64], y: NDArray[np.float64], slot: NDArray[np.intp], without: int | None = None
) -> NDArray[np.float64]:
    """Return the values (d, n) of a multilinear vector field in cells.

    `coefficients` (d, k, cells): coefficients of the field, in the order of `Grid.monomials`.
    `y` (d, n), m: offsets from the midpoints of the cells.
    `slot` (n,): index of the cell in which a value is computed.
    `without`: axis along which the field is constant, or None.
    """
    rows = [row for row in range(2 ** len(y)) if without is None or not row >> without & 1]
    total = np.zeros(y.shape)
    for k, row in enumerate(rows):
        term = coefficients[:, k].take(slot, axis=1)
        for a in range(len(y)):
            if row >> a & 1:
                term *= y[a]
        total += term
    return total


def ranges(first: NDArray[np.int64], count: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return range index (n,) and value (n,) of each integer in the ranges `first` to `first + count - 1`."""
    of = np.arange(len(count)).repeat(count)
    return of, np.arange(len(of)) + np.repeat(first - (np.cumsum(count) - count), count)


def among(numbers: NDArray[np.integer], chosen: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return a mask (...) of the `numbers` (...) that the sorted array `chosen` (m,) contains."""
    if not len(chosen):
        return np.zeros(numbers.shape, dtype=bool)
    return chosen[np.minimum(chosen.searchsorted(numbers), len(chosen) - 1)] == numbers


def distinct(numbers: NDArray[np.integer], count: int) -> tuple[NDArray[np.integer], NDArray[np.intp]]:
    """Return the distinct numbers (k,), ascending, and the index (n,) of each of the n numbers among them.

    `count`: upper limit, with 0 <= `numbers` < `count`.
    """
    if count > numbers.size:
        return np.unique(numbers.ravel(), return_inverse=True)
    found = np.zeros(count, dtype=bool)
    found[numbers] = True
    return found.nonzero()[0].astype(numbers.dtype), (found.cumsum() - 1)[numbers.ravel()]


def values_at(
    chosen: NDArray[np.int64], numbers: NDArray[np.int64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the values (n, k) that belong to the numbers `chosen` (n,), or 0 for a number without values.

    `numbers` (m,): sorted numbers, to which the `values` (m, k) belong.
    """
    at = numbers.searchsorted(chosen)
    found = np.append(numbers, -1)[at] == chosen
    return np.concatenate([values, np.zeros((1, values.shape[1]))])[np.where(found, at, len(numbers))]


def across_faces(grid: Grid, n: Any) -> tuple[Any, Any, Any]:
    """Return the lengths of the "+" and "-" cells along the normal n of their face, and the mean length, as UFL."""
    h = grid.edge_in_forms()
    if grid.even:
        return (sum(abs(n[a]) * h[a] for a in range(grid.dim)),) * 3
    first, other = (sum(abs(n[a]) * h(side)[a] for a in range(grid.dim)) for side in "+-")
    return first, other, (first + other) / 2


class CellPlaces(NamedTuple):
    """Positions of nodes and cells, relative to the base of the grid."""

    node_x: NDArray[np.float64]  # nodes (nodes, d), m
    midpoints: NDArray[np.float64]  # midpoints of cells (cells, d), m
    sizes: NDArray[np.float64] | None  # edge lengths of cells (cells, d), m; None for equal cells


class Spacing(NamedTuple):
    """Lines of a grid, and quantities that depend on the lines.  `Grid` documents these attributes."""

    lines: tuple[NDArray[np.float64], ...]
    widths: tuple[NDArray[np.float64], ...]
    finest: NDArray[np.float64]
    least: float
    most: float
    snap: NDArray[np.float64]


class LocalCells:
    """Table from lexicographic to local indices of cells: `self[number]`.  Cells of other processes have index -1.

    `number` (cells,): lexicographic indices of the local cells.
    """

    def __init__(self, grid: Grid, number: NDArray[np.int64]):
        self._shape, self._cells = tuple(grid.shape), grid.cells
        index = np.array(np.unravel_index(number % grid.cells, self._shape))
        self._low = index.min(axis=1, keepdims=True) if len(number) else np.zeros((grid.dim, 1), dtype=np.int64)
        extent = (index - self._low + 1).max(axis=1, initial=0)
        self.table = np.full((grid.copies, *extent), -1, dtype=np.int32)
        self.table[(number // grid.cells, *(index - self._low))] = np.arange(len(number))

    def __getitem__(self, number: NDArray[np.int64]) -> NDArray[np.int32]:
        copy, cell = np.divmod(np.ravel(number), self._cells)
        index = np.array(np.unravel_index(cell, self._shape)) - self._low
        out = np.full(len(cell), -1, dtype=np.int32)
        inside = ((index >= 0) & (index < np.array(self.table.shape[1:])[:, None])).all(axis=0)
        out[inside] = self.table[(copy[inside], *index[:, inside])]
        return out.reshape(np.shape(number))


class Cells:
    """The cells of a grid on this process, ghosts included, in the numbering of the mesh.

    num_owned, num_local
        Number of cells of this process: without ghosts, and with ghosts.
    cell_nodes : (cells, 2^d)
        Nodes of each cell, in the numbering of Q1 functions.
    signs : (2^d, d)
        Direction from the midpoint of a cell to each of its nodes: -1 or 1 along each axis.
    at
        Current positions of nodes and cells.
    cell_number
        Lexicographic index of each local cell.
    partition
        The boxes of cells that the processes own.
    locals
        Local index of each cell of all copies of the grid (`copies`), or -1 if the cell is on another process.
    cell_facets : (cells, 2d)
        Facets of each cell.
    facet_cells : (facets, 2)
        The two cells at each facet, or one cell and -1 at the boundary.
    """

    def __init__(self, grid: Grid, mesh: Any, partition: Partition):
        self.mesh = mesh
        self.partition = partition
        d = grid.dim
        self._nodes = nodes = _compat.function_space(mesh, "Lagrange", 1)
        self.num_owned, self.num_local = _compat.num_cells(mesh)
        self.cell_nodes = _compat.cell_dofs(nodes)
        node_x = nodes.tabulate_dof_coordinates()[:, :d]
        corners = node_x[self.cell_nodes]
        midpoints = corners.mean(axis=1)
        # all cells list their vertices in the same order (tested), so all processes compile the same forms, even a
        # process without cells
        self.signs = np.concatenate(grid.comm.allgather(np.sign(corners[:1] - midpoints[:1, None])))[0]
        self.cell_number = grid.number(grid.index_from_base(midpoints))
        if grid.copies > 1:
            brought, cells = np.asarray(mesh.topology.original_cell_index), partition.count.prod(axis=1)
            start = np.cumsum([0, *(grid.copies * cells)])
            rank = start.searchsorted(brought, side="right") - 1
            copy, k = np.divmod(brought - start[rank], cells[rank])
            self.cell_number = partition.numbered(rank, k) + copy * grid.cells
        self.at = CellPlaces(node_x, midpoints, None if grid.even else grid.sizes_of(self.cell_number))
        self._index = [grid.nodes_along(x[:, :d]) for x in (node_x, mesh.geometry.x)] if grid.follow is not None else []
        self.locals = LocalCells(grid, self.cell_number)
        if self.locals.table.size == grid.all_cells:
            self.locals = self.locals.table.ravel()
        topology = mesh.topology
        topology.create_connectivity(d, d - 1)
        topology.create_connectivity(d - 1, d)
        if d == 3 and grid.comm.size > 1:  # all processes must call this, even without facets
            topology.create_entity_permutations()
        self.cell_facets = topology.connectivity(d, d - 1).array.reshape(-1, 2 * d)
        adjacency = topology.connectivity(d - 1, d)
        first = adjacency.offsets[:-1]
        two = np.diff(adjacency.offsets) == 2
        self.facet_cells = np.stack([adjacency.array[first], np.full(len(first), -1, dtype=np.int32)], axis=1)
        self.facet_cells[two, 1] = adjacency.array[first[two] + 1]
        self.facets_owned = topology.index_map(d - 1).size_local
        self.cellwise = cache(partial(_compat.function_space, mesh, "DG", 0))
        """Function that returns the DG0 space for a value shape, and creates each space only once."""
        self.memory = cache(lambda shape, space=self.cellwise: fem.Function(space(shape)))
        self.move(grid)

    @cached_property
    def near_others(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks of local nodes within two cells of nodes that processes share, and of local cells with shared nodes."""
        holders = fem.Function(self._nodes)
        holders.x.array[:] = 1.0
        _compat.scatter_reverse_add(holders)
        holders.x.scatter_forward()
        near = holders.x.array > 1
        cells = near[self.cell_nodes].any(axis=1)
        for _ in range(2):
            near[self.cell_nodes[near[self.cell_nodes].any(axis=1)]] = True
        return near, cells

    @cached_property
    def edges(self) -> fem.Function:
        """Edge lengths of the cells, in m, for forms on grids of unequal cells."""
        out = fem.Function(self.cellwise((self.at.sizes.shape[1],)))
        out.x.array[:] = self.at.sizes.ravel()
        return out

    def move(self, grid: Grid) -> None:
        """Move mesh, nodes and cells to the current lines of the grid."""
        if grid.follow is None:
            return
        node_x, x = map(grid.places, self._index)
        self.mesh.geometry.x[:, : grid.dim] = x
        self.at = CellPlaces(node_x, node_x[self.cell_nodes].mean(axis=1), grid.sizes_of(self.cell_number))
        if "edges" in vars(self):
            self.edges.x.array[:] = self.at.sizes.ravel()


def of_cells(name: str) -> cached_property:
    """Return a property of `Grid` that reads an attribute of the grid's `Cells`."""
    return cached_property(lambda grid: getattr(grid._of_process, name))


def of_places(name: str) -> property:
    """Return a property of `Grid` that reads an attribute of the present `CellPlaces`."""
    return property(lambda grid: getattr((grid._cells or grid._of_process).at, name))


def of_spacing(name: str) -> property:
    """Return a property of `Grid` that reads an attribute of the present `Spacing`."""
    return property(lambda grid: getattr(grid._spacing, name))


class Grid:
    """Background grid over the box [lower, upper], with equal cells or with cells between given lines.

    Bodies must stay inside the grid.  Empty cells need little time and memory.  The sides of the grid are the walls of
    a scene: "left", "right" (x), "bottom", "top" (y in 2D, z in 3D), and in 3D "front", "back" (y).

    Parameters
    ----------
    lower, upper : (d,), m
        Lower and upper corner; d = 2 (plane strain) or 3.
    cells : (d,)
        Number of cells along each axis, at least 1.
    comm
        Processes that share the grid.
    lines : (n,) along each axis, m
        Ascending coordinates of all grid lines, instead of `lower`, `upper` and `cells`; see `graded`.  Equally spaced
        lines along all axes give a grid of equal cells.
    follow : Tool, or callable -> (n,) along each axis, m
        Object that the lines follow, at each reset of the grid.  The smallest cells of `lines` move with one point of a
        tool: the centre of a ball, the tip of a cone, or the mean of the corners.  If the tool's shape is a function,
        the smallest cells move with `Tool.centre`.  All other cells become wider or narrower.  The tool must be a
        condition of the first stage.  Lines do not move in stages without this tool.  A function of time t (s), of the
        positions x (n, d) of all points, or of both returns all lines.  Along each axis, the number of lines and the
        first and last coordinate must be as in `lines`.
    axisymmetric
        Whether the first axis is the radius r >= 0, and the second axis is the axis of revolution.  There is no
        torsion.  Volumes (m^3), forces (N) and outflows (m^3/s) refer to the whole revolution.  If the grid begins at r
        = 0, the side "left" is the axis, where radial displacements are zero.

    Raises
    ------
    ValueError
        Corners or lines are not finite or not ascending.  Numbers of cells are not integers >= 1.  PETSc cannot number
        so many nodes.  An axisymmetric grid is in 3D or has r < 0.  `follow` is given without lines.

    Attributes
    ----------
    dim
        Dimension d.
    shape : (d,)
        Number of cells along each axis.
    lower, upper : (d,), m
        Corners of the grid.
    even
        Whether all cells are equal.
    lines : (n,) along each axis, m
        Current lines, relative to `base`.
    widths : (n - 1,) along each axis, m
        Current edge lengths of the cells.
    finest : (d,), m
        Shortest edge of all cells along each axis.
    least, most : m
        Shortest and longest edge of all cells.
    snap
        Distances (d,) along the axes, in cell sizes, below which a vertex is considered to lie on a plane of the grid.
    base : (d,), m
        Origin of all internal positions: the lower corner of the grid, in axisymmetry at the radius 0.  A near origin
        reduces rounding errors.
    low, high : (d,), m
        Lower and upper corner of the grid, relative to `base`.
    stretches
        Dimension of deformation gradients: d, or 3 in axisymmetry, because of the circumferential stretch.
    mesh
        The dolfinx mesh, created at its first use.  The coordinates of the mesh are relative to `base`.  On several
        processes, a scene whose cells are distributed in another way has a separate mesh and grid, `Simulation.grid`.
        Scenes with user-defined terms or sources always use this mesh, because terms may be defined on it.
    """

    def __init__(
        self,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        cells: Sequence[int] | None = None,
        comm: MPI.Intracomm = MPI.COMM_WORLD,
        *,
        lines: Sequence[ArrayLike] | None = None,
        follow: Any = None,
        axisymmetric: bool = False,
    ):
        self.even, self.follow = lines is None, follow
        if follow is not None:
            check_follow(follow, lines)
        if not self.even:
            if any(value is not None for value in (lower, upper, cells)):
                raise ValueError("grid: lines are given together with lower, upper or cells; lines must be given alone")
            lines = checked(lines)
            self.even = all(map(equal, lines)) and follow is None
            lower, upper, cells = ([of(x) for x in lines] for of in (np.min, np.max, lambda x: len(x) - 1))
        self.lower = numbers("grid: lower", lower, (2,), (3,), allowed="2 or 3 finite coordinates")
        self.dim = d = self.lower.size
        self.upper = numbers("grid: upper", upper, (d,), allowed=f"{d} finite coordinates, as lower")
        if not (self.upper > self.lower).all():
            raise ValueError(f"grid: upper = {line(upper)}, must be > lower = {line(lower)}; {ORDER}")
        flag("grid: axisymmetric", axisymmetric)
        if axisymmetric and (d != 2 or self.lower[0] < 0):
            what = f"lower = {line(lower)}, must begin at a radius >= 0" if d == 2 else f"{d} coordinates, must have 2"
            raise ValueError(f"grid: axisymmetric = True: {what}")
        self.axisymmetric, self.stretches = axisymmetric, 3 if axisymmetric else d
        count = numbers(
            "grid: cells", cells, (d,), allowed=f"{d} integers >= 1; {ORDER}", test=lambda n: (n >= 1) & (n % 1 == 0)
        )
        instance("grid: comm", comm, MPI.Comm)
        self.shape = count.astype(np.int64)
        if d * np.prod(count + 1) > MOST:
            raise ValueError(
                f"grid: cells = {line(cells)}: has {np.prod(count + 1):.3g} nodes, must have fewer than {MOST // d}"
            )
        self.base = self.lower * [not axisymmetric, *[True] * (d - 1)]
        self.low, self.high = self.lower - self.base, self.upper - self.base
        self._h = (self.upper - self.lower) / self.shape if self.even else None
        self.seeded: tuple[NDArray[np.float64], ...] | None = None if self.even else self.from_base(lines)
        """Initial lines (n,) along each axis, in m, relative to the base.  Bodies are seeded on these lines."""
        self._spacing = self._spaced(self.seeded)
        self.comm = comm
        self._cells: Cells | None = None

    def from_base(self, lines: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.float64], ...]:
        """Convert lines (n,), in m, along each axis from the user's coordinates to coordinates relative to the base."""
        return tuple(x - start for x, start in zip(lines, self.base, strict=True))

    def _spaced(self, lines: tuple[NDArray[np.float64], ...] | None) -> Spacing:
        """Return the `Spacing` for lines relative to the base, or for equal cells."""
        finest, most = self._h, self._h
        if lines is None:
            lines = tuple(low + np.arange(n + 1) * h for low, n, h in zip(self.low, self.shape, self._h, strict=True))
        widths = tuple(map(np.diff, lines))
        if not self.even:
            finest, most = (np.array([of(w) for w in widths]) for of in (np.min, np.max))
        snap = np.maximum(SNAP, [rounding(e) for e in zip(self.lower, self.upper, strict=True)] / finest)
        return Spacing(lines, widths, finest, float(finest.min()), float(most.max()), snap)

    def move(self, lines: Mapping[str, NDArray[np.float64]] | None) -> None:
        """Move the lines of a grid that has `follow` to `lines`: coordinates (n,) for "x", "y", "z", in m from the
        base.

        With None, the lines return to their initial coordinates.  All coordinates of nodes, cells and mesh are then
        bitwise equal to coordinates in a new grid with these lines.
        """
        new = self.seeded if lines is None else tuple(lines[letter] for letter in "xyz"[: self.dim])
        if self.follow is not None and any((x != old).any() for x, old in zip(new, self.lines, strict=True)):
            self._spacing = self._spaced(new)
            if self._cells is not None:
                self._cells.move(self)

    lines, widths, finest = map(of_spacing, ("lines", "widths", "finest"))
    least, most, snap = map(of_spacing, ("least", "most", "snap"))

    @property
    def h(self) -> NDArray[np.float64]:
        """Edge lengths (d,), m, of equal cells."""
        if self._h is None:
            raise ValueError(MANY)
        return self._h

    @cached_property
    def cell_volume(self) -> float:
        """Volume of equal cells, m^d, or in axisymmetry the area of a cell in the plane."""
        return float(np.prod(self.h))

    def sizes(self, cells: Any) -> NDArray[np.float64]:
        """Return the edge lengths (n, d) of local cells, in m."""
        return self._h if self.even else self._of_process.at.sizes[cells]

    def along(self, cells: Any, axis: Any) -> NDArray[np.float64]:
        """Return the edge length (n,) of each local cell along an axis, in m.  `axis` may be an array (n,)."""
        return self._h[axis] if self.even else self._of_process.at.sizes[cells, axis]

    def between(self, cells: Any, others: Any, axis: Any) -> NDArray[np.float64]:
        """Return the distances (n,), in m, between midpoints of local cells and of their neighbours along an axis."""
        return self._h[axis] if self.even else (self.along(cells, axis) + self.along(others, axis)) / 2

    def volumes(self, cells: Any) -> NDArray[np.float64] | float:
        """Return the volumes (n,) of local cells in m^d, or in axisymmetry the areas of cells in the plane."""
        return self.cell_volume if self.even else self._of_process.at.sizes[cells].prod(axis=-1)

    def smallest_faces(self, cells: Any) -> NDArray[np.float64] | float:
        """Return the area (n,) of the smallest face of each local cell, in m^(d-1)."""
        return self.volumes(cells) / self.sizes(cells).max(axis=-1)

    def sizes_of(self, number: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the edge lengths (n, d) of the cells with the lexicographic indices `number`, in m."""
        if self.even:
            return self._h
        return self.widths_of(np.stack(np.unravel_index(number % self.cells, tuple(self.shape)), axis=-1))

    def sizes_at(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the edge lengths (..., d) of the cells at positions x, in m from the base."""
        if self.even:
            return self._h
        return self.widths_of(self.index_from_base(x.reshape(-1, self.dim))).reshape(x.shape)

    def in_cells(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert positions x (..., d), in m from the base, to units of cells: cell index plus fraction of the cell."""
        if self.even:
            return (x - self.low) / self._h
        out = np.empty(x.shape)
        for a, (lines, width) in enumerate(zip(self.lines, self.widths, strict=True)):
            i = self.cells_along(a, x[..., a])
            out[..., a] = i + (x[..., a] - lines[i]) / width[i]
        return out

    def cells_between(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances (..., d) between positions x and y along the axes, in units of cells (`in_cells`)."""
        if self.even:
            return np.abs((y - x) / self._h)
        return np.abs(self.in_cells(y) - self.in_cells(x))

    def places(self, index: NDArray[np.integer], share: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
        """Return positions (n, d) in cells, in m from the base: lower corner plus the fraction `share` of the edges.

        `index` (n, d): indices of cells along the axes.  Beyond a side, cells are as large as the outermost cell.
        """
        if self.even:
            return self.low + (index + share) * self._h
        out = np.empty(index.shape)
        for a, (lines, width) in enumerate(zip(self.lines, self.widths, strict=True)):
            i = np.minimum(np.maximum(index[..., a], 0), len(width) - 1)
            part = share if np.isscalar(share) else share[..., a]
            out[..., a] = lines[i] + (index[..., a] - i + part) * width[i]
        return out

    def edge_in_forms(self) -> Any:
        """Return the edge lengths (d,) of a cell, in m, as a UFL coefficient, or as a constant if cells are equal."""
        return fem.Constant(self.mesh, self._h) if self.even else self._of_process.edges

    def nodes_along(self, x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices (..., d), along the axes, of the nodes at positions x, in m from the base."""
        return np.rint(self.in_cells(x)).astype(np.int64)

    def widths_of(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the edge lengths (n, d) of the cells with indices (n, d) along the axes, in m."""
        if self.even:
            return self._h
        return np.stack([w[i] for w, i in zip(self.widths, index.T, strict=True)], axis=-1)

    def next_plane(self, axis: int, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the next line (n,) above each coordinate x (n,), or inf, along an axis of unequal cells; all in m."""
        return np.append(self.lines[axis], np.inf)[self.lines[axis].searchsorted(x, side="right")]

    def cells_along(self, axis: int, x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices, along an axis of unequal cells, of the cells nearest to coordinates x, in m."""
        return np.minimum(np.maximum(self.lines[axis].searchsorted(x, side="right") - 1, 0), self.shape[axis] - 1)

    mesh = of_cells("mesh")
    near_others = of_cells("near_others")
    partition = of_cells("partition")
    locals = of_cells("locals")
    num_owned = of_cells("num_owned")
    num_local = of_cells("num_local")
    cell_nodes = of_cells("cell_nodes")
    node_x, midpoints = map(of_places, ("node_x", "midpoints"))
    signs = of_cells("signs")
    cell_number = of_cells("cell_number")
    cell_facets = of_cells("cell_facets")
    facet_cells = of_cells("facet_cells")
    facets_owned = of_cells("facets_owned")

    @property
    def _of_process(self) -> Cells:
        """The cells of this process.  If `share` was not called, processes get equally many cells."""
        if self._cells is None:
            self.share(np.zeros(int(np.prod(self.shape))))
        return self._cells

    def share(self, load: NDArray[np.float64]) -> None:
        """Create the mesh, if it does not exist, such that processes have nearly equal sums of `load`, see `shared`."""
        if self._cells is None:
            self._cells = self._made(boxes(load.reshape(self.shape), self.comm.size))

    def shared(self, load: NDArray[np.float64], keep: bool) -> Grid:
        """Return a grid whose processes have nearly equal sums of `load`: this grid, or a copy with another mesh.

        `load` (cells,): work >= 0 to compute each cell, such as its number of points.
        `keep`: whether to return this grid in any case, because other objects use its mesh.
        """
        new = boxes(load.reshape(self.shape), self.comm.size)
        if self._cells is None:
            self._cells = self._made(new)
        elif not keep and (self.partition.boxes != new).any():  # distributed for an earlier scene
            return self.distributed(new)
        return self

    def better(self, x: NDArray[np.float64]) -> NDArray[np.int64] | None:
        """Return boxes (ranks, 2, d) that distribute the points of all processes more evenly than the present boxes.

        The result is None if the imbalance is at most `IMBALANCE`, or if new boxes are not better.  `x`: positions of
        points.
        """
        number = self.number(self.index_from_base(x))
        counts = over_all(self.comm, np.bincount(self.owner(number), minlength=self.comm.size))
        if counts.max() <= IMBALANCE * counts.mean():
            return None
        load = np.bincount(number, minlength=self.cells).astype(float)
        return better(over_all(self.comm, load).reshape(self.shape), self.partition.boxes)

    def check_boxes(self, boxes: NDArray[np.int64]) -> None:
        """Raise ValueError if boxes (ranks, 2, d) do not fill the grid exactly once."""
        Partition(boxes, tuple(self.shape))

    def distributed(self, boxes: NDArray[np.int64]) -> Grid:
        """Return a copy of this grid, with its present lines.  Each process owns one of the boxes (ranks, 2, d)."""
        other = self._again()
        other.seeded, other._spacing = self.seeded, self._spacing
        other._cells = other._made(boxes)
        return other

    def _again(self) -> Grid:
        return Grid(**self.given)

    def _made(self, boxes: NDArray[np.int64]) -> Cells:
        """Create the mesh, and return its cells."""
        partition = Partition(boxes, tuple(self.shape))
        own = partition.cells(self.comm.rank)
        nodes = np.concatenate([self.corners(own) + copy * self.nodes for copy in range(self.copies)])
        ranks, first = destinations(partition, own)
        each = np.tile(np.diff(first), self.copies)
        where = np.tile(ranks, self.copies), np.concatenate([[0], np.cumsum(each)]).astype(np.int32)
        mesh = _compat.box_mesh(self.comm, nodes, self._nodes(), *where)
        return Cells(self, mesh, partition)

    def corners(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the lexicographic indices (n, 2^d) of the nodes of cells."""
        bits = corner_bits(self.dim)
        index = np.stack(np.unravel_index(cells, self.shape), axis=-1)[:, None] + bits
        return np.ravel_multi_index(tuple(index.transpose(2, 0, 1)), tuple(self.shape + 1))

    def _nodes(self) -> NDArray[np.float64]:
        """Return the positions of the nodes that this process contributes to a new mesh, in lexicographic order."""
        count = self.copies * self.nodes
        start, stop = (count * (self.comm.rank + end) // self.comm.size for end in (0, 1))
        index = np.stack(np.unravel_index(np.arange(start, stop) % self.nodes, self.shape + 1), axis=-1)
        return self.places(index)

    @property
    def copies(self) -> int:
        """Number of copies of the grid's box in the mesh: one, or in `GridOfGroups` one for each contact group."""
        return 1

    @property
    def cells(self) -> int:
        """Number of cells in one copy of the box."""
        return prod(self.shape.tolist())

    @cached_property
    def all_cells(self) -> int:
        """Number of cells in all copies of the box."""
        return self.copies * self.cells

    @property
    def nodes(self) -> int:
        """Number of nodes in one copy of the box."""
        return int(np.prod(self.shape + 1))

    def copy(self, ids: NDArray[np.int64]) -> NDArray[np.int64] | int:
        """Return the index (n,) of the first cell in the copy of the box that contains each point of `ids` (n,)."""
        return 0

    def cellwise(self, shape: tuple[int, ...] = ()):
        """Return the space of cellwise constant functions (DG0) with a value shape."""
        return self._of_process.cellwise(shape)

    def coefficient(self, shape: tuple[int, ...] = ()) -> fem.Function:
        """Return a cellwise coefficient for forms.  All coefficients with the same value shape share one array."""
        return fem.Function(self.cellwise(shape), self._of_process.memory(shape).x)

    @property
    def given(self) -> dict[str, Any]:
        """Keyword arguments with which `Grid` creates a copy of this grid."""
        rest = {"axisymmetric": self.axisymmetric, "comm": self.comm}
        if self.even:
            return {"lower": self.lower, "upper": self.upper, "cells": self.shape, **rest}
        lines = [x + start for x, start in zip(self.seeded, self.base, strict=True)]
        return {"lines": lines, "follow": self.follow, **rest}

    @property
    def reach(self) -> float:
        """Largest absolute coordinate on the grid, in m, relative to the base."""
        return float(np.abs([self.low, self.high]).max())

    @property
    def has_axis(self) -> bool:
        """Whether the side "left" is the axis of revolution."""
        return self.axisymmetric and bool(self.lower[0] <= SAME * self.finest[0])

    def around(self, x: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """Return the weight of volume integrals at x (n, d): `2 pi r` (n,), in m, in axisymmetry, and 1 otherwise."""
        return TURN * x[:, 0] if self.axisymmetric else 1.0

    def number(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert indices (n, d) of cells along axes to lexicographic indices (n,) in the first copy of the grid."""
        return np.ravel_multi_index(tuple(index.T), tuple(self.shape))

    def index(self, x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices (n, d) of the cells nearest to positions x in the user's coordinates, in m."""
        return self.index_from_base(x - self.base)

    def index_from_base(self, x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices (n, d) of the cells nearest to positions x, in m from the base."""
        if not self.even:
            return np.stack([self.cells_along(a, x[:, a]) for a in range(self.dim)], axis=1)
        i = np.floor((x - self.low) / self._h).astype(np.int64)
        return np.minimum(np.maximum(i, 0), self.shape - 1, out=i)

    def owner(self, number: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the owner rank of the cells with lexicographic indices `number`."""
        if self.comm.size == 1:
            return np.zeros(number.shape, dtype=np.int32)
        return self.partition.owner(np.array(np.unravel_index(number % self.cells, tuple(self.shape))))

    def gathered(
        self, parts: Sequence[tuple[NDArray[np.int64], NDArray[np.float64], Mapping[str, NDArray]]]
    ) -> tuple[NDArray[np.int32], NDArray[np.float64], dict[str, NDArray[np.float64]]]:
        """Send positions and values to the processes that own their cells.  Return local cells, positions and values.

        `parts`: tuples of lexicographic indices of cells (n,), positions (n, d), in m, and values (n, ...) by name.
        """
        cell = np.concatenate([cell for cell, *_ in parts])
        x = np.concatenate([x for _, x, _ in parts])
        shapes = {name: values.shape[1:] for name, values in parts[0][2].items()}
        columns = [
            np.concatenate([values[name].reshape(len(values[name]), prod(shape)) for *_, values in parts])
            for name, shape in shapes.items()
        ]
        travel = Exchange(self.comm, self.owner(cell))
        cell, x, sent = map(travel.send, (cell, x, np.concatenate(columns, axis=1)))
        fields, stop = {}, 0
        for name, shape in shapes.items():
            start, stop = stop, stop + prod(shape)
            fields[name] = sent[:, start:stop].reshape(len(x), *shape).copy()
        return self.locals[cell], x, fields

    def node_places(self, nodes: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the indices (n, d + 1) of local nodes (n,): one along each axis, and the index of the box's copy."""
        copy = np.zeros(len(self.node_x), dtype=np.int64)
        if self.copies > 1:
            copy[self.cell_nodes] = (self.cell_number // self.cells)[:, None]
        return np.column_stack([self.nodes_along(self.node_x[nodes]), copy[nodes]])

    def node_numbers(self) -> NDArray[np.int64]:
        """Return the lexicographic indices (nodes,) of the local nodes, counted over all copies of the box."""
        *index, copy = self.node_places(np.arange(len(self.node_x))).T
        return np.ravel_multi_index(tuple(index), tuple(self.shape + 1)) + copy * self.nodes

    def from_other(self, other: Grid, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return nodal values (unknowns,) from values on `other`, a copy of this grid with another partition."""
        rows = nodal.reshape(-1, self.dim)
        some = rows.any(axis=1)
        return self.from_rows(other.node_numbers()[some], rows[some])

    def from_rows(self, nodes: NDArray[np.int64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return nodal values (unknowns,) from rows (n, d) of values, whose nodes may be on any process.

        `nodes` (n,): lexicographic indices of the nodes of the rows.  All other nodes have zero values.
        """
        new = self.node_numbers()
        store, fetch = (Exchange(self.comm, (node % self.comm.size).astype(np.int32)) for node in (nodes, new))
        node, first = np.unique(store.send(nodes), return_index=True)
        return fetch.back(values_at(fetch.send(new), node, store.send(rows)[first])).ravel()

    def cell_places(self, cells: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return indices (n, d + 1) of local cells (n,) along each axis, and last the index of the copy (`copies`)."""
        copy, number = np.divmod(self.cell_number[cells].astype(np.int64), self.cells)
        return np.array([*np.unravel_index(number, tuple(self.shape)), copy]).T.copy()

    def neighbours(self, cells: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the local indices (n, axis, end) of the neighbours of local cells, or -1 if not on this process."""
        index = self.cell_places(cells)
        out = np.full((len(cells), self.dim, 2), -1, dtype=np.int64)
        for axis in range(self.dim):
            stride = prod(self.shape[axis + 1 :].tolist())
            for end, inside in enumerate((index[:, axis] > 0, index[:, axis] < self.shape[axis] - 1)):
                out[inside, axis, end] = self.locals[self.cell_number[cells[inside]] + (2 * end - 1) * stride]
        return out

    def outside(self, x: NDArray[np.float64], tolerance: float = SAME) -> NDArray[np.bool_]:
        """Return whether positions x, in m from the base, are outside the grid by more than `tolerance` cells."""
        least = self._h if self.even else np.array([w[[0, -1]].min() for w in self.widths])  # at the sides
        tolerance = tolerance + rounding(np.array([self.lower, self.upper])) / least
        inside, cells = np.ones(len(x), dtype=bool), None if self.even else self.in_cells(x)
        for a in range(self.dim):
            y = (x[:, a] - self.low[a]) / self._h[a] if self.even else cells[:, a]
            inside &= (y >= -tolerance[a]) & (y <= self.shape[a] + tolerance[a])
        return ~inside  # nan counts as outside

    def shape_gradients(
        self, cells: NDArray[np.int32], x: NDArray[np.float64], mixed: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the gradients (n, 2^d, d) of the Q1 shape functions of local cells at points x, in 1/m.

        If `mixed` is given in 3D, gradients are means over pieces with centroids x.  `mixed` (n, 3), m^2: means over
        each piece of products of two offsets from its centroid.
        """
        hats, h = self._hats(cells, x), self.sizes(cells).T[..., None]
        dN = np.empty((*hats[0].shape, self.dim))
        for a in range(self.dim):
            b, *more = [k for k in range(self.dim) if k != a]
            others = reduce(np.multiply, [hats[k] for k in (b, *more)])
            if mixed is not None and more:
                c = more[0]
                others = others + mixed[:, a, None] * (self.signs[:, b] * self.signs[:, c] / (h[b] * h[c]))
            np.multiply(others, self.signs[:, a] / h[a], out=dN[:, :, a])
        return dN

    @cached_property
    def monomials(self) -> NDArray[np.float64]:
        """Coefficients of the Q1 shape functions: a row for each of 2^d monomials, a column for each of 2^d functions.

        Monomial s is the product of the offsets from the cell's midpoint along the axes whose bits are set in s.  For
        unequal cells, the offsets are divided by the edge lengths, see `over_edges`.
        """
        bits = corner_bits(self.dim)[:, None]
        return np.where(bits, self.signs / (self._h if self.even else 1.0), 0.5).prod(axis=2)

    def over_edges(self, coefficients: NDArray[np.float64], cells: NDArray[np.int32]) -> NDArray[np.float64]:
        """Convert coefficients (d, 2^d, cells) for offsets as in `monomials` to coefficients for offsets in m."""
        if self.even:
            return coefficients
        bits = corner_bits(self.dim)[:, None]
        return coefficients / np.where(bits, self.sizes(cells), 1.0).prod(axis=2)

    def shape_values(self, cells: NDArray[np.int32], x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values (n, 2^d) of the Q1 shape functions of local cells at points x."""
        return reduce(np.multiply, self._hats(cells, x))

    def at(self, cells: NDArray[np.int32], x: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values of a Q1 field u (nodes, k) at points x in local cells."""
        out = np.empty((len(x), u.shape[1]))
        for part in in_chunks(len(x)):
            N, at_nodes = self.shape_values(cells[part], x[part]), u[self.cell_nodes[cells[part]]]
            np.einsum("mk,mkd->md", N, at_nodes, out=out[part])
        return out

    def _hats(self, cells: NDArray[np.int32], x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return the factors of the Q1 shape functions, one for each axis.  Each factor is linear in one coordinate."""
        y = (x - self.midpoints[cells]) / self.sizes(cells)
        return [0.5 + y[:, a, None] * self.signs[:, a] for a in range(self.dim)]

    def interior_facets(self, active: NDArray[np.bool_], cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the owned facets between two active cells.

        `active`, `cells`: mask and indices of the active cells.
        """
        facets = np.unique(self.cell_facets[cells])
        facets = facets[facets < self.facets_owned]
        both = self.facet_cells[facets]
        return facets[(both[:, 1] >= 0) & active[both[:, 0]] & active[both[:, 1]]]

    def wall_nodes(self, name: str) -> NDArray[np.bool_]:
        """Return a mask of the nodes on the side `name` of the box."""
        axis, end = side(name, self.dim)
        plane = (self.low, self.high)[end][axis]
        return np.abs(self.node_x[:, axis] - plane) < NEAR * self.finest[axis]


def begin_with(name: str, grid: Any) -> None:
    """Reset moved lines of a grid to their initial coordinates.  Raise ValueError if `grid` is not a Grid."""
    instance(name, grid, Grid)
    grid.move(None)


class GridOfGroups(Grid):
    """A grid with a separate copy of the box for each contact group, so that groups share no nodes.

    All copies occupy the same space.  Cells at the same position in all copies belong to the same process.

    `grid`: grid of the bodies.
    `group` (bodies,): index, from 0, of the group of each body.
    `starts` (bodies,): id of the first material point of each body.
    """

    def __init__(self, grid: Grid, group: NDArray[np.int64], starts: NDArray[np.int64]):
        super().__init__(**grid.given)
        self._group, self._starts = group, starts
        self._copies = int(group.max()) + 1
        if self.dim * self.copies * self.nodes > MOST:
            what = f"grid: has {self.nodes:.3g} nodes for each of {self.copies} groups"
            raise ValueError(f"{what}, must be below {MOST // (self.dim * self.copies)}")

    @property
    def copies(self) -> int:
        """Number of groups."""
        return self._copies

    def _again(self) -> Grid:
        return GridOfGroups(self, self._group, self._starts)

    def copy(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the index (n,) of the first cell in the copy of the box that contains each point of `ids` (n,)."""
        return self._group[self._starts.searchsorted(ids, side="right") - 1] * np.int64(self.cells)
