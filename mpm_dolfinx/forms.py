# SPDX-License-Identifier: MIT
"""Forms at material points: any UFL form, evaluated where the points are.

A multilinear function on a box is a polynomial of degree d, so its Taylor series about the cell's
midpoint ends after d terms: with xi = x_p - x_mid,

    v(x_p) = v + grad v . xi + 1/2 xi . grad grad v . xi + ...,   the right side taken at the midpoint.

The right side is plain UFL, integrated by the one-point rule; xi and whatever else a point carries
are DG0 coefficients, of which every entry of the integral's entity list has values of its own.
Hence listing a cell as often as it has points, with one row of coefficients a point, makes the
assembler call the kernel once a point, and int f w/|cell| dx over that list is sum_p w_p f(x_p).
No generated code is touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial, prod

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.grid import Grid


class PointMeasure(ufl.Measure):
    """Measure of a sum over points: `f * dx` stands for sum_p w_p f(x_p)."""

    def __init__(self, grid: Grid, weight: ufl.core.expr.Expr):
        super().__init__(
            "dx",
            domain=grid.mesh,
            subdomain_id=_compat.SUBDOMAIN,
            metadata={"quadrature_degree": 0},
        )
        self._weight = weight

    def __rmul__(self, integrand) -> ufl.Form:
        return super().__rmul__(self._weight * integrand)


class FormPoints:
    """Points, weights and data of the points at which forms are evaluated.

    Parameters
    ----------
    grid
        The background grid.
    fields
        Name and shape of each quantity that the points carry; `points.name` is then a UFL
        coefficient with the point's value.
    """

    def __init__(self, grid: Grid, **fields: tuple[int, ...]):
        self.grid = grid
        self._functions = {
            name: fem.Function(_compat.function_space(grid.mesh, "DG", 0, shape))
            for name, shape in {"offset": (grid.dim,), "weight": (), **fields}.items()
        }
        self.dx = PointMeasure(grid, self._functions["weight"])
        self._size = {name: int(np.prod(shape, dtype=int)) for name, shape in fields.items()}
        self.cells = self.filled = np.empty(0, dtype=np.int32)
        self.data: dict[str, NDArray[np.float64]] = {}
        self.version = 0

    def __getattr__(self, name: str) -> fem.Function:
        functions = self.__dict__.get("_functions", {})
        if name in functions:
            return functions[name]
        raise AttributeError(f"the points carry {', '.join(functions)}, not {name!r}")

    def place(self, cells: NDArray[np.int32], x: NDArray[np.float64], weight: NDArray[np.float64], **data) -> None:
        """Put the points into owned cells, with all their data.

        Parameters
        ----------
        cells : (n,)
            Owned local cell of each point.
        x : (n, d), m
            Positions.
        weight : (n,), m^d
            Volumes.
        data : (n, ...)
            Values of the fields.
        """
        self.cells, self.x, self.filled = cells, x, np.unique(cells)
        self.data = {
            "offset": x - self.grid.midpoints[cells],
            "weight": (weight / self.grid.cell_volume)[:, None],
            **{name: value.reshape(len(cells), self._size[name]) for name, value in data.items()},
        }
        self.version += 1

    def take(self, points: FormPoints, rows: NDArray[np.int64]) -> None:
        """Be some rows of other points, which carry the fields of these."""
        self.cells, self.x = points.cells[rows], points.x[rows]
        self.filled = np.unique(self.cells)
        self.data = {name: points.data[name][rows] for name in self._functions}
        self.version += 1

    @property
    def position(self):
        """Position of the point as UFL, m."""
        return ufl.SpatialCoordinate(self.grid.mesh) + self.offset

    def value(self, f):
        """Return f at the point, f a P1 function, test or trial function (any shape)."""
        return self._taylor(f, self.grid.dim)

    def grad(self, f):
        """Return grad f at the point, f a P1 function, test or trial function (any shape)."""
        return self._taylor(ufl.grad(f), self.grid.dim - 1)

    def _taylor(self, f, order: int):
        total = derivative = f
        for k in range(1, order + 1):
            derivative = term = ufl.grad(derivative)
            for _ in range(k):  # contracting a k-th gradient halves the cost of nested grad(dot(., xi))
                term = ufl.dot(term, self.offset)
            total += term / factorial(k)
        return total


class PointForm:
    """A form over `points.dx`, compiled once, assembled wherever the points are.

    Parameters
    ----------
    form
        Linear or bilinear UFL form whose integrals are all over `points.dx`.
    points
        The points; their data and the nodal values of grid functions are read at each assembly.
    """

    def __init__(self, form: ufl.Form, points: FormPoints):
        self.points = points
        self.compiled = _compat.CompiledForm(form)
        self._version = -1
        names = {f: name for name, f in points._functions.items()}
        self._columns, self._gathered, start = [], [], 0
        for f in self.compiled.coefficients:
            dofs, bs = _compat.cell_dofs(f.function_space), f.function_space.dofmap.bs
            stop = start + dofs.shape[1] * bs
            if f in names:
                self._columns.append((slice(start, stop), names[f]))
            else:
                # as numpy's own index type, which it would else convert to in every assembly
                unrolled = (dofs[:, :, None].astype(np.intp) * bs + np.arange(bs)).reshape(len(dofs), stop - start)
                self._gathered.append((slice(start, stop), f, unrolled))
            start = stop
        self._width, self._room = start, np.empty((0, start))

    def rows(self) -> NDArray[np.float64]:
        """Return the coefficients of the form, one row a point."""
        cells = self.points.cells
        if self._version != self.points.version:
            self._version = self.points.version
            self.compiled.bind(cells)
            if len(cells) > len(self._room):  # memory that is kept saves the page faults of every step
                self._room = np.empty((len(cells) + len(cells) // 8, self._width))
            self._packed = self._room[: len(cells)]
            for columns, name in self._columns:
                self._packed[:, columns] = self.points.data[name]
            self._dofs = [(c, f, dofs[cells]) for c, f, dofs in self._gathered]
        for columns, f, dofs in self._dofs:
            self._packed[:, columns] = np.take(f.x.array, dofs, mode="wrap")  # "raise" checks every index
        return self._packed

    def assemble_vector(self, b: NDArray[np.float64]) -> None:
        """Add the vector to the local array `b`; contributions to ghosts stay there."""
        rows = self.rows()
        if len(rows):
            self.compiled.assemble_vector(b, rows)

    def assemble_matrix(self, A: PETSc.Mat) -> None:
        """Add the matrix to `A`, by unrolled local dofs; the caller finalises it."""
        rows = self.rows()
        if len(rows):
            self.compiled.assemble_matrix(A, rows)


class ElementMatrices:
    """The bilinear form grad v : A : grad u of P1 vectors over points, summed in each cell before insertion.

    Inserting the matrix of every point costs twice as much as computing it.  Here the entries of the
    element matrix, A contracted with the gradients of the shape functions at the point, are tested
    with DG0, so that the assembler sums them over the points of a cell; then each cell is inserted once.

    Parameters
    ----------
    tangent : UFL tensor (d, d, d, d)
        A[i, k, j, l] at the points.
    points
        The points.
    symmetric
        Whether A[i, k, j, l] = A[j, l, i, k]: half of the entries are then left out.
    """

    def __init__(self, tangent: ufl.core.expr.Expr, points: FormPoints, symmetric: bool = True):
        self.points, dim = points, points.grid.dim
        count = 2**dim * dim
        rows, columns = np.triu_indices(count) if symmetric else np.divmod(np.arange(count**2), count)
        self._entry = np.empty((count, count), dtype=np.int64)  # place of each entry among the sums
        if symmetric:
            self._entry[columns, rows] = np.arange(len(rows))
        self._entry[rows, columns] = np.arange(len(rows))
        gradients, entries = shape_gradients(points), []
        for row, column in zip(rows, columns, strict=True):
            (v, i), (u, j) = divmod(row, dim), divmod(column, dim)
            block = ufl.as_matrix([[tangent[int(i), k, int(j), l] for l in range(dim)] for k in range(dim)])
            entries.append(ufl.dot(gradients[v], ufl.dot(block, gradients[u])))
        self._sums = CellSums(entries, points)

    def assemble_matrix(self, A: PETSc.Mat) -> None:
        """Add the matrix to `A`, by unrolled local dofs; the caller finalises it."""
        insert(A, self.points, self._sums()[:, self._entry])


def shape_gradients(points: FormPoints) -> list:
    """Return the gradients of the cell's P1 shape functions at the point as UFL."""
    grid, xi = points.grid, points.offset
    h = fem.Constant(grid.mesh, grid.h)
    out = []
    for signs in grid.signs.tolist():
        t = [0.5 + signs[a] * xi[a] / h[a] for a in range(grid.dim)]
        slopes = [signs[a] / h[a] * prod(t[b] for b in range(grid.dim) if b != a) for a in range(grid.dim)]
        out.append(ufl.as_vector(slopes))
    return out


def insert(A: PETSc.Mat, points: FormPoints, matrices: NDArray[np.float64]) -> None:
    """Add the element matrices of P1 vectors (cells, n, n) in the filled cells of `points` to `A`."""
    grid, cells = points.grid, points.filled
    if len(cells):
        dofs = grid.cell_nodes[cells][:, :, None] * grid.dim + np.arange(grid.dim)
        dofs = dofs.reshape(len(cells), -1).astype(PETSc.IntType)
        A.setValuesLocalRCV(dofs, dofs, matrices, addv=True)


class CellSums:
    """Sums over the points of each cell: DG0 tests them, so that the assembler adds them up.

    Parameters
    ----------
    quantities
        Scalar UFL expressions at the points.
    points
        The points.
    """

    def __init__(self, quantities: Sequence[ufl.core.expr.Expr], points: FormPoints):
        self.points, self._count = points, len(quantities)
        space = _compat.function_space(points.grid.mesh, "DG", 0, (self._count,))
        self._values, q = fem.Function(space), ufl.TestFunction(space)
        self._form = PointForm(ufl.inner(ufl.as_vector(quantities), q) * points.dx, points)

    def __call__(self) -> NDArray[np.float64]:
        """Return the sums (cells, quantities) in the filled cells of the points."""
        cells = self.points.filled
        values = self._values.x.array.reshape(-1, self._count)
        values[cells] = 0.0
        self._form.assemble_vector(self._values.x.array)
        return values[cells]


class PointExpression:
    """A UFL expression of the fields that points carry, evaluated at every point.

    Tested with DG0 the assembler sums the points of a cell, so it is called once for the first
    points of all cells, once for the second ones, and so on.

    Parameters
    ----------
    expression
        UFL expression of any shape in the fields of `points`.
    points
        The points.
    """

    def __init__(self, expression: ufl.core.expr.Expr, points: FormPoints):
        self.points, self._shape = points, expression.ufl_shape
        space = _compat.function_space(points.grid.mesh, "DG", 0, self._shape)
        self._sum = fem.Function(space)
        q = ufl.TestFunction(space)
        self._form = PointForm(ufl.inner(expression, q) * points.dx, points)

    def evaluate(self) -> NDArray[np.float64]:
        """Return the values (n, *shape) at the points where they are now."""
        rows, cells, form = self._form.rows(), self.points.cells, self._form.compiled
        values = np.empty((len(cells), int(np.prod(self._shape, dtype=int))))
        order = np.argsort(cells, kind="stable")
        first = np.searchsorted(cells[order], cells[order])
        turn = np.empty(len(cells), dtype=np.int64)
        turn[order] = np.arange(len(cells)) - first
        total = self._sum.x.array.reshape(-1, values.shape[1])
        for k in range(turn.max(initial=-1) + 1):
            chosen = np.flatnonzero(turn == k)
            total[:] = 0.0
            form.bind(cells[chosen])
            form.assemble_vector(self._sum.x.array, np.ascontiguousarray(rows[chosen]))
            values[chosen] = total[cells[chosen]]
        volume = self.points.data["weight"] * self.points.grid.cell_volume
        return (values / volume).reshape(len(cells), *self._shape)
