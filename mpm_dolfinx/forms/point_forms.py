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
from math import factorial

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.points.grid import Grid

CHUNK = 2**14
"""Points whose coefficients are packed at a time: no form holds a row for each point of a large body."""
BATCH = 2**10
"""Points whose element matrices are made at a time, in the processor's cache."""


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
            name: grid.coefficient(shape) for name, shape in {"offset": (grid.dim,), "weight": (), **fields}.items()
        }
        self._live: dict[str, fem.Function] = {}
        self._of: tuple[int, NDArray[np.float64]] | None = None
        self._gradients = np.empty((0, grid.dim**2))
        self._taken: NDArray[np.int32] | None = None
        self.dx = PointMeasure(grid, self._functions["weight"])
        self._size = {name: int(np.prod(shape, dtype=int)) for name, shape in fields.items()}
        self.cells = self.filled = self.slots = np.empty(0, dtype=np.int32)
        """Cell of each point; the cells that hold points; and the place of each point's cell among these."""
        self.data: dict[str, NDArray[np.float64]] = {}
        self.version = self.places = 0
        """Count of changes of the data, and of the cells too."""

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
        self._put(cells)
        self.x = x
        self.data = {"offset": x - self.grid.midpoints[cells]}
        self.renew(weight, **data)

    def renew(self, weight: NDArray[np.float64] | None = None, **data) -> None:
        """Give the points, which stay where they are, new values of some fields, or new weights too."""
        rows = {name: value.reshape(len(self.cells), self._size[name]) for name, value in data.items()}
        if weight is not None:
            rows["weight"] = (weight / self.grid.cell_volume)[:, None]
        self.data |= rows
        self.version += 1

    def take(self, points: FormPoints, rows: NDArray[np.int64]) -> None:
        """Be some rows of other points, which carry the fields of these."""
        if self._taken is not points.cells:
            self._taken = points.cells
            self._put(points.cells[rows])
        self.x = points.x[rows]
        self.data = {name: points.data[name][rows] for name in self._functions if name not in self._live}
        self.version += 1

    def _put(self, cells: NDArray[np.int32]) -> None:
        self.cells = cells
        self.filled, self.slots = np.unique(cells, return_inverse=True)
        self.places += 1

    def value(self, f):
        """Return f at the point, f a Q1 function, test or trial function (any shape)."""
        return self._taylor(f, self.grid.dim)

    def grad(self, f):
        """Return grad f at the point, f a Q1 function, test or trial function (any shape)."""
        return self._taylor(ufl.grad(f), self.grid.dim - 1)

    def gradient(self, u: fem.Function) -> fem.Function:
        """Return grad u at the point, u a Q1 vector function, as a coefficient that numpy computes for the kernels.

        Derivatives by u do not see it.  In 3D, where the Taylor series has many terms, a kernel of Hencky's law
        takes half or a quarter of the time, and its compilation a fifth.
        """
        if "gradient" in self._live:
            return self._functions["gradient"]
        shape = (self.grid.dim, self.grid.dim)
        self._functions["gradient"] = self.grid.coefficient(shape)
        self._live["gradient"] = u
        return self._functions["gradient"]

    def increment(self, u: fem.Function):
        """Return Delta = I + grad u at the points as UFL."""
        return ufl.Identity(self.grid.dim) + (self.grad(u) if self.grid.dim == 2 else self.gradient(u))

    def deformation(self, u: fem.Function):
        """Return F = Delta F_n at the points, which carry F_n as F, as a UFL variable."""
        return ufl.variable(self.increment(u) * self.F)

    def values(self, name: str, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return a field at the chosen points (m, size)."""
        return self._gradients[chosen] if name in self._live else self.data[name][chosen]

    def refresh(self) -> None:
        """Set the gradients of u at the points, of which several forms ask, if u or the points have changed."""
        for u in self._live.values():
            self._update(u.x.array)

    def _update(self, u: NDArray[np.float64]) -> None:
        if self._of is not None and self._of[0] == self.version and np.array_equal(self._of[1], u):
            return
        self._of = (self.version, u.copy())
        d, n = self.grid.dim, len(self.cells)
        if len(self._gradients) != n:
            self._gradients = np.empty((n, d * d))
        nodal = u.reshape(-1, d)
        for part in (slice(start, start + BATCH) for start in range(0, n, BATCH)):
            cells = self.cells[part]
            slopes = self.grid.shape_gradients(cells, self.x[part])
            du = nodal[self.grid.cell_nodes[cells]].transpose(0, 2, 1) @ slopes
            self._gradients[part] = du.reshape(len(cells), d * d)

    def changes(self, name: str) -> bool:
        """Return whether a field changes while the points stay."""
        return name in self._live

    def _taylor(self, f, order: int):
        total = derivative = f
        for k in range(1, order + 1):
            derivative = term = ufl.grad(derivative)
            for _ in range(k):  # contracting a k-th gradient halves the cost of nested grad(dot(., xi))
                term = ufl.dot(term, self.offset)
            total += term / factorial(k)
        return total


class Rows:
    """Coefficients of a compiled form, one row a point.

    Parameters
    ----------
    compiled
        The form.
    points
        The points; their data and the nodal values of grid functions are read at each call.
    """

    def __init__(self, compiled: _compat.CompiledForm, points: FormPoints):
        self.points = points
        names = {f: name for name, f in points._functions.items()}
        self._columns, self._gathered, start = [], [], 0
        for f in compiled.coefficients:
            dofs, bs = _compat.cell_dofs(f.function_space), f.function_space.dofmap.bs
            stop = start + dofs.shape[1] * bs
            if f in names:
                self._columns.append((slice(start, stop), names[f]))
            else:
                self._gathered.append((slice(start, stop), f, dofs))
            start = stop
        self._room = np.zeros((0, start))
        self._packed: tuple[int, slice | None] = (-1, None)
        self._gathered_at: tuple[int, slice | None] = (-1, None)

    def room(self, size: int) -> NDArray[np.float64]:
        """Return the memory of the rows, at least `size` of them; what is kept saves the page faults of every step."""
        if size > len(self._room):
            self._room = np.zeros((size, self._room.shape[1]))
            self._packed = (-1, None)
        return self._room

    def __call__(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the rows of the chosen points, the first of the memory of all."""
        cells = self.points.cells[chosen]
        rows = self.room(len(cells))[: len(cells)]
        now = (self.points.version, chosen if isinstance(chosen, slice) else None)
        fresh = now[1] is None or now != self._packed
        for columns, name in self._columns:
            if fresh or self.points.changes(name):
                rows[:, columns] = self.points.values(name, chosen)
        where = (self.points.places, now[1])
        if where[1] is None or where != self._gathered_at:
            self._dofs = [(columns, f, _unrolled(f, dofs[cells])) for columns, f, dofs in self._gathered]
        self._packed, self._gathered_at = now, where
        for columns, f, dofs in self._dofs:
            rows[:, columns] = np.take(f.x.array, dofs, mode="wrap")  # "raise" checks every index
        return rows


def _unrolled(f: fem.Function, dofs: NDArray[np.int32]) -> NDArray[np.intp]:
    """Return unrolled (n, m) dofs, in numpy's own index type, which it would else convert to in every assembly."""
    bs = f.function_space.dofmap.bs
    return (dofs[:, :, None].astype(np.intp) * bs + np.arange(bs)).reshape(len(dofs), dofs.shape[1] * bs)


class PointForm:
    """A form over `points.dx`, compiled once, assembled wherever the points are.

    Parameters
    ----------
    form
        Linear or bilinear UFL form whose integrals are all over `points.dx`.
    points
        The points; their data and the nodal values of grid functions are read at each assembly.
    dense
        Tested by DG0, it has a value for each of `points.filled` rather than for each cell of the grid: as
        `PointExpression`, it is called for other cells.
    """

    def __init__(self, form: ufl.Form, points: FormPoints, dense: bool = False):
        self.points, self._dense = points, dense
        self.compiled = _compat.CompiledForm(form)
        self._rows, self._bound, self._places = Rows(self.compiled, points), [], -1

    def _parts(self):
        """Yield the form bound to CHUNK points after the other, with their rows."""
        self.points.refresh()
        if self._places != self.points.places:
            self._places, cells = self.points.places, self.points.slots if self._dense else self.points.cells
            parts = [slice(start, start + CHUNK) for start in range(0, len(cells), CHUNK)]
            self._bound = [(part, self.compiled.bind(cells[part])) for part in parts]
        for part, form in self._bound:
            yield form, self._rows(part)

    def assemble_vector(self, b: NDArray[np.float64]) -> None:
        """Add the vector to the local array `b`; contributions to ghosts stay there."""
        for form, rows in self._parts():
            self.compiled.assemble_vector(b, rows, form)

    def assemble_matrix(self, A: PETSc.Mat) -> None:
        """Add the matrix to `A`, by unrolled local dofs; the caller finalises it."""
        for form, rows in self._parts():
            self.compiled.assemble_matrix(A, rows, form)


class FacetForm:
    """A form over faces between active cells, compiled when first a process has such a face.

    All processes assemble it together, for they compile it together.

    Parameters
    ----------
    form
        Linear or bilinear UFL form over interior facets.
    comm
        The processes.
    """

    def __init__(self, form: ufl.Form, comm: MPI.Intracomm):
        self._form, self._comm = form, comm
        self._compiled: _compat.CompiledForm | None = None
        self._facets = np.empty(0, dtype=np.int32)
        self._bound = False

    @property
    def used(self) -> bool:
        """Whether the form has been needed so far."""
        return self._compiled is not None

    def place(self, facets: NDArray[np.int32]) -> None:
        """Set the facets of this process."""
        self._facets, self._bound = facets, False

    def _bind(self) -> bool:
        """Compile and bind the form if need be; return whether this process has a facet."""
        if not self._bound:
            self._bound = True
            if self._comm.allreduce(len(self._facets)) and self._compiled is None:
                self._compiled = _compat.CompiledForm(self._form)
            if len(self._facets):
                self._compiled.bind(self._facets)
        return len(self._facets) > 0

    def assemble_matrix(self, A: PETSc.Mat) -> None:
        """Add the matrix to `A`, by unrolled local dofs; the caller finalises it."""
        if self._bind():
            self._compiled.assemble_matrix(A)

    def assemble_vector(self, b: NDArray[np.float64]) -> None:
        """Add the vector to the local array `b`; contributions to ghosts stay there."""
        if self._bind():
            self._compiled.assemble_vector(b)


class PointExpression:
    """A UFL expression of the fields that points carry, evaluated at every point.

    The kernel sees of its cell the size only, which all have in common.  So it is called for as many
    different cells, whichever, and DG0, which tests the expression, keeps a value for each point.

    Parameters
    ----------
    expression
        UFL expression of any shape in the fields of `points`.
    points
        The points.
    """

    def __init__(self, expression: ufl.core.expr.Expr, points: FormPoints):
        self.points, self._shape = points, expression.ufl_shape
        grid = points.grid
        q = ufl.TestFunction(grid.cellwise(self._shape))
        dx = ufl.dx(domain=grid.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 0})
        self._compiled = _compat.CompiledForm(ufl.inner(expression, q) * dx)
        self._rows = Rows(self._compiled, points)
        self._many = min(BATCH, grid.num_owned)
        self._compiled.bind(np.arange(self._many))
        self._rows.room(self._many)
        self._values = np.empty((self._many, int(np.prod(self._shape, dtype=int))))

    def evaluate(self, chosen: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
        """Return the values (m, *shape) at the chosen points, after a `refresh`, or else at all, where they are now."""
        if chosen is None:
            self.points.refresh()
            chosen = np.arange(len(self.points.cells))
        out = np.empty((len(chosen), self._values.shape[1]))
        for start in range(0, len(chosen), max(1, self._many)):
            part = chosen[start : start + self._many]
            self._rows(part)
            self._values[:] = 0.0
            self._compiled.assemble_vector(self._values.reshape(-1), self._rows.room(self._many))
            np.divide(self._values[: len(part)], self.points.grid.cell_volume, out=out[start : start + len(part)])
        return out.reshape(len(chosen), *self._shape)


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
        q = ufl.TestFunction(points.grid.cellwise((self._count,)))
        self._form = PointForm(ufl.inner(ufl.as_vector(quantities), q) * points.dx, points, dense=True)

    def __call__(self) -> NDArray[np.float64]:
        """Return the sums (cells, quantities) in the filled cells of the points."""
        sums = np.zeros((len(self.points.filled), self._count))
        self._form.assemble_vector(sums.reshape(-1))
        return sums
