# SPDX-License-Identifier: MIT
"""Nodal forces and element matrices of Q1 vectors, summed over the points of a cell before the global assembly."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.forms.point_forms import BATCH, NONE, CellSums, FormPoints, Given, Places, PointData, PointExpression
from mpm_dolfinx.grid.grid import Grid, sum_by


def shape_gradients(points: FormPoints) -> list:
    """Return the gradients of the Q1 shape functions at the points as UFL.  In 3D they are means over the pieces."""
    grid, xi = points.grid, points.offset
    h = grid.edge_in_forms()
    out = []
    for signs in grid.signs.tolist():
        t = [0.5 + signs[a] * xi[a] / h[a] for a in range(grid.dim)]
        slopes = []
        for a in range(grid.dim):
            b, *more = [k for k in range(grid.dim) if k != a]
            mean = prod(t[k] for k in (b, *more))
            for c in more:
                mean += signs[b] * signs[c] / (h[b] * h[c]) * points.mixed[a]
            slopes.append(signs[a] / h[a] * mean)
        out.append(ufl.as_vector(slopes))
    return out


def shape_over_radius(points: FormPoints) -> list:
    """Return the mean of N / r over each piece as UFL, for each Q1 shape function N.  Here r is the radius."""
    grid, hoop = points.grid, points.functions["hoop"]
    h, out = grid.edge_in_forms(), []
    for s in grid.signs.tolist():
        linear = (0.5 + s[0] * hoop[0] / h[0]) * (0.5 + s[1] * hoop[1] / h[1])
        out.append((linear + s[0] * s[1] * (hoop[2] - hoop[0] * hoop[1]) / (h[0] * h[1])) / hoop[3])
    return out


def along_shapes(T, points: FormPoints) -> list:
    """Return T : grad v as UFL, for the Q1 test functions v of each node and component."""
    gradients, d = shape_gradients(points), points.grid.dim
    if not points.grid.axisymmetric:
        return [ufl.dot(T, g)[i] for g in gradients for i in range(d)]
    out = []
    for g, h in zip(gradients, shape_over_radius(points), strict=True):
        radial, axial = (T[i, 0] * g[0] + T[i, 1] * g[1] for i in range(d))
        out += [radial + T[2, 2] * h, axial]
    return out


def element_dofs(grid: Grid, cells: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the unrolled local dofs (cells, n) of Q1 vectors in the given cells."""
    dofs = grid.cell_nodes[cells][:, :, None] * grid.dim + np.arange(grid.dim, dtype=grid.cell_nodes.dtype)
    return dofs.reshape(len(cells), dofs.shape[1] * grid.dim)


def insert(A: PETSc.Mat, grid: Grid, cells: NDArray[np.int32], matrices: NDArray[np.float64]) -> None:
    """Add the element matrices (cells, n, n) of Q1 vectors to `A`."""
    if len(cells):
        dofs = element_dofs(grid, cells).astype(PETSc.IntType)
        A.setValuesLocalRCV(dofs, dofs, matrices, addv=True)


def insert_rows(A: PETSc.Mat, grid: Grid, cells: NDArray[np.int32], rows: NDArray[np.float64]) -> None:
    """Add rows (cells, n) to a matrix with a row for each cell and a column for each dof.  The caller assembles `A`."""
    if len(cells):
        dofs = element_dofs(grid, cells).astype(PETSc.IntType)
        A.setValuesLocalRCV(cells[:, None].astype(PETSc.IntType), dofs, rows[:, None], addv=True)


def _entries(count: int, symmetric: bool) -> tuple[NDArray, NDArray, NDArray]:
    """Return rows and columns of the stored entries of a matrix, and the storage index (count, count) of each entry."""
    rows, columns = np.triu_indices(count) if symmetric else np.divmod(np.arange(count**2), count)
    place = np.empty((count, count), dtype=np.int64)
    if symmetric:
        place[columns, rows] = np.arange(len(rows))
    place[rows, columns] = np.arange(len(rows))
    return rows, columns, place


class ElementForces:
    """The linear form T : grad v of Q1 vectors, integrated over the points.

    `stress`: UFL tensor T (d, d) at the points.
    """

    def __init__(self, stress: ufl.core.expr.Expr, points: FormPoints):
        self._sums = CellSums(along_shapes(stress, points), points)

    def assemble_vector(self, b: NDArray[np.float64], data: PointData, given: Given = NONE) -> None:
        """Add the assembled vector to the local array `b`, which includes ghosts."""
        dofs, at = data.places.dofs
        b[dofs] += sum_by(at, self._sums(data, given).ravel(), len(dofs))


class Beside(NamedTuple):
    """Integrals over each cell that are computed together with an element matrix."""

    # UFL tensors T[i, k] (d, d), multiplied by grad v (or by grad v F) for each dof of v
    along: Sequence[ufl.core.expr.Expr] = ()
    scalars: Sequence[ufl.core.expr.Expr] = ()  # UFL scalars


NOTHING = Beside()


class ElementMatrices:
    """The bilinear form grad v : A : grad u of Q1 vectors, integrated over the points.

    DG0 test functions make the assembler of dolfinx sum each entry of an element matrix over the points of the cell.
    Each element matrix is then added to the global matrix once.

    Parameters
    ----------
    tangent : UFL tensor (d, d, d, d)
        Components A[i, k, j, l] at the points.
    points
        UFL coefficients of the integration points.
    symmetric
        Whether A[i, k, j, l] = A[j, l, i, k].  If True, only half of the entries are computed.
    beside
        Integrals over each cell that are computed together with the element matrix.
    """

    def __init__(
        self, tangent: ufl.core.expr.Expr, points: FormPoints, symmetric: bool = True, beside: Beside = NOTHING
    ):
        self._grid, dim = points.grid, points.grid.dim
        rows, columns, self._entry = _entries(2**dim * dim, symmetric)
        gradients, entries = shape_gradients(points), []
        over_radius = shape_over_radius(points) if points.grid.axisymmetric else []
        for row, column in zip(rows, columns, strict=True):
            (v, i), (u, j) = divmod(row, dim), divmod(column, dim)
            block = ufl.as_matrix([[tangent[int(i), k, int(j), l] for l in range(dim)] for k in range(dim)])
            entries.append(ufl.dot(gradients[v], ufl.dot(block, gradients[u])))
            if points.grid.axisymmetric:
                entries[-1] += _circumferential(tangent, gradients, over_radius, (int(v), int(i)), (int(u), int(j)))
        self._count = len(entries)
        along = [part for T in beside.along for part in along_shapes(T, points)]
        self._sums = CellSums([*entries, *along, *beside.scalars], points)

    def assemble_matrix(self, A: PETSc.Mat, data: PointData, given: Given = NONE) -> NDArray[np.float64]:
        """Add the matrix to `A`, for assembly by the caller.  Return the integrals (cells, quantities) of `beside`."""
        sums = self._sums(data, given)
        insert(A, self._grid, data.places.filled, sums[:, self._entry])
        return sums[:, self._count :]


def _circumferential(tangent, gradients: list, over_radius: list, row: tuple[int, int], column: tuple[int, int]):
    """Return the contribution of circumferential strains to one entry of an element matrix, as UFL.

    `row`: node and axis of v.  `column`: node and axis of u.
    """
    (v, i) = row
    (u, j) = column
    out = 0
    if i == 0:
        out += over_radius[v] * sum(tangent[2, 2, j, l] * gradients[u][l] for l in range(2))
    if j == 0:
        out += sum(tangent[i, k, 2, 2] * gradients[v][k] for k in range(2)) * over_radius[u]
    if i == j == 0:
        out += over_radius[v] * tangent[2, 2, 2, 2] * over_radius[u]
    return out


class StackedElementMatrices:
    """The bilinear form (grad v F) : A : (grad u F) of Q1 vectors, with products by BLAS.

    In 3D, cells contain many points, so that products by BLAS are faster than products in the kernel.  An element
    matrix is the product of two matrices for the n points of a cell.  The first (8, 3n) contains the weighted gradients
    grad N F of the shape functions N.  The second (3n, 72) contains A times these gradients.  Cells with about the same
    number of points are computed together.

    Parameters: see `ElementMatrices`.  The points must have the field F (d, d).
    """

    def __init__(
        self, tangent: ufl.core.expr.Expr, points: FormPoints, symmetric: bool = True, beside: Beside = NOTHING
    ):
        self._grid, self._d = points.grid, points.grid.dim
        self._along, self._scalars = map(len, beside)
        d, (rows, columns, place) = self._d, _entries(self._d**2, symmetric)
        self._entry = place.reshape(d, d, d, d).transpose(1, 0, 2, 3).ravel()  # (k, i, j, l)
        pairs = [(*divmod(int(r), d), *divmod(int(c), d)) for r, c in zip(rows, columns, strict=True)]
        self._count = len(pairs)
        parts = [T[i, k] for T in beside.along for i in range(d) for k in range(d)]
        parts = [*(tangent[pair] for pair in pairs), *parts, *beside.scalars]
        self._values = PointExpression(ufl.as_vector(parts), points)
        self._sorted: Latest[list] = Latest()

    def assemble_matrix(self, A: PETSc.Mat, data: PointData, given: Given = NONE) -> NDArray[np.float64]:
        """Add the matrix to `A`, for assembly by the caller.  Return the integrals (cells, quantities) of `beside`."""
        live, filled = self._values.live(data, given), data.places.filled
        sums = np.empty((len(filled), self._along * 2**self._d * self._d + self._scalars))
        for cells, points, missing in self._sorted(data.places.key, lambda: batches(data.places)):
            matrices, sums[cells] = self._of_batch(data, live, points.ravel(), missing)
            insert(A, self._grid, filled[cells], matrices)
        return sums

    def _of_batch(self, data: PointData, live, chosen: NDArray[np.int64], missing: NDArray) -> tuple[NDArray, NDArray]:
        """Return the element matrices of a batch of cells, and the integrals of `beside` over each cell."""
        d, (cells, most) = self._d, missing.shape
        g = data.places.shape_gradients(chosen)
        g = g @ data["F"][chosen].reshape(-1, d, d)
        nodes, values = g.shape[1], self._values.evaluate(data, chosen, live)
        tangent = values[:, self._entry].reshape(-1, d**3, d)
        right = (tangent @ g.transpose(0, 2, 1)).reshape(cells, most * d, d * d * nodes)
        weight = np.where(missing.ravel(), 0.0, data["weight"][chosen, 0] * self._grid.volumes(data.cells[chosen]))
        g *= weight[:, None, None]
        left = g.reshape(cells, most, nodes, d).transpose(0, 2, 1, 3).reshape(cells, nodes, most * d)
        matrices = (left @ right).reshape(cells, nodes, d, d, nodes)
        matrices = matrices.transpose(0, 1, 2, 4, 3).reshape(cells, nodes * d, nodes * d)
        if not (self._along or self._scalars):
            return matrices, np.empty((cells, 0))
        last = values.shape[1] - self._scalars
        T = values[:, self._count : last].reshape(cells, most, self._along, d, d).transpose(0, 2, 1, 4, 3)
        along = left[:, None] @ T.reshape(cells, self._along, most * d, d)
        scalars = (weight[:, None] * values[:, last:]).reshape(cells, most, self._scalars).sum(axis=1)
        return matrices, np.concatenate([along.reshape(cells, self._along * nodes * d), scalars], axis=1)


def batches(places: Places) -> list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]]:
    """Return batches of cells with similar numbers of points.

    Returns for each batch
    ----------------------
    Indices (c,) of the batch's cells in `Places.filled`.  Indices (c, most) of the points in each cell; cells with
    fewer than `most` points have placeholders at the end.  Mask (c, most), True for placeholders.
    """
    cells = places.cells
    filled = places.filled
    out = []
    order = np.argsort(cells, kind="stable")
    start = np.searchsorted(cells[order], filled)
    count = np.diff(start, append=len(cells))
    by_count = np.argsort(count, kind="stable")
    while len(by_count):
        size = max(1, BATCH // count[by_count[0]])
        size = max(1, BATCH // count[by_count[min(size, len(by_count)) - 1]])
        batch, by_count = by_count[:size], by_count[size:]
        turn = np.arange(count[batch].max())
        missing = turn >= count[batch, None]
        points = order[np.where(missing, start[batch, None], start[batch, None] + turn)]
        out.append((batch, points, missing))
    return out
