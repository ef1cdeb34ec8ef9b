# SPDX-License-Identifier: MIT
"""Forms at material points: any UFL form, evaluated at the positions of the points.

The problem: a form is integrated over points at arbitrary positions, but FFCx compiles fixed quadrature points.  A
function v that is multilinear on a box of dimension d equals d + 1 terms of its Taylor series about the midpoint,

    v(x_p) = v + grad v . xi + 1/2 xi . grad grad v . xi + ...,

with the offset xi = x_p - x_mid of the point p from the midpoint x_mid.  The right side is evaluated at the midpoint.
It is plain UFL, integrated by the one-point rule.

The list of cells of the integral contains each cell once for each point in the cell, so that the assembler calls the
kernel once for each point.  The offset xi and all other data of the points are DG0 coefficients, with one row for each
entry of the list.  The integral of f w / |cell| over the list is sum_p w_p f(x_p), with the weights w_p of the points
and the cell volume |cell|.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from math import factorial

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.caching import Keyed, Latest
from mpm_dolfinx.forms.axes import block
from mpm_dolfinx.grid.grid import Grid, in_chunks

BATCH, MANY = 2**10, 2**12
"""Number of points in a batch of element matrices, and in one call of an expression.

A batch fits into the cache.  An expression evaluates lists of `MANY` cells, and for its last points `BATCH` cells.
"""


class PointMeasure(ufl.Measure):
    """Integration measure with a weight, for sums over points: `f * dx` is `sum_p w_p f(x_p)`."""

    def __init__(self, mesh: Mesh, weight: ufl.core.expr.Expr, subdomain=_compat.SUBDOMAIN, degree: int = 0):
        super().__init__("dx", domain=mesh, subdomain_id=subdomain, metadata={"quadrature_degree": degree})
        self._weight = weight

    def __rmul__(self, integrand) -> ufl.Form:
        return super().__rmul__(self._weight * integrand)


class FormPoints:
    """The points in forms, as UFL coefficients.  The values of these coefficients are in `PointData`.

    grid: background grid.
    fields: shape of each quantity at the points, by name.  The coefficient is an attribute with this name.
    """

    def __init__(self, grid: Grid, **fields: tuple[int, ...]):
        self.grid = grid
        self.functions = {
            name: grid.coefficient(shape)
            for name, shape in {"offset": (grid.dim,), "weight": (), **_moments(grid), **fields}.items()
        }
        self.live: dict[str, Callable[[PointData], NDArray[np.float64]]] = {}
        """Functions that return the values (n, size) of fields that change between assemblies."""
        self.dx = PointMeasure(grid.mesh, self.functions["weight"])
        self.sizes = {name: int(np.prod(shape, dtype=int)) for name, shape in fields.items()}

    def __getattr__(self, name: str) -> fem.Function:
        functions = self.__dict__.get("functions", {})
        if name in functions:
            own = self.grid.dim == 2 and name in ("F", "dF") and functions[name].ufl_shape == (3, 3)
            return block(functions[name]) if own else functions[name]
        raise AttributeError(f"the points have {', '.join(functions)}, not {name!r}")

    def at(self, cells: NDArray[np.int32], x: NDArray[np.float64], weight: NDArray[np.float64], **fields) -> PointData:
        """Return points with these positions, in m, weights, in m^d, and fields; see `PointData`."""
        return PointData(self, Places(self.grid, cells, x), weight, fields)

    def value(self, f):
        """Return a Q1 function, test function or trial function at the points."""
        return self._taylor(f, self.grid.dim)

    def grad(self, f):
        """Return the gradient of a Q1 function, test function or trial function at the points.

        In axisymmetry the gradient of a vector f is (3, 3), with f_r / r on the diagonal.
        """
        plane = self.plane_grad(f)
        if not (self.grid.axisymmetric and f.ufl_shape):
            return plane
        return ufl.as_matrix([[plane[0, 0], plane[0, 1], 0], [plane[1, 0], plane[1, 1], 0], [0, 0, self.hoop(f)]])

    def plane_grad(self, f):
        """Return the gradient at the points without the circumferential component in axisymmetry."""
        return self._taylor(ufl.grad(f), self.grid.dim - 1)

    def hoop(self, f):
        """Return f_r / r of a Q1 vector f in axisymmetry, averaged over the piece of each point."""
        *offset, product, radius = (self.functions["hoop"][i] for i in range(4))
        slope = ufl.grad(f[0])
        return (f[0] + ufl.dot(slope, ufl.as_vector(offset)) + ufl.grad(slope)[0, 1] * product) / radius

    def gradient(self, u: fem.Function) -> fem.Function:
        """Return grad u at the points as a coefficient that numpy evaluates, for a Q1 vector function u.

        All forms with the same u share the values.  UFL would otherwise expand u as a Taylor polynomial, with many
        terms in 3D.  With the coefficient, a kernel of Hencky's law runs in half of the time, and compiles in a fifth.
        """
        if "gradient" not in self.live:
            values = u.x.array
            self.follow("gradient", (self.grid.dim, self.grid.dim), partial(PointData.gradients, u=values))
        return self.functions["gradient"]

    def follow(self, name: str, shape: tuple[int, ...], values: Callable[[PointData], NDArray]) -> fem.Function:
        """Return a new field as a coefficient.  The function `values` is called at each assembly."""
        self.functions[name] = self.grid.coefficient(shape)
        self.live[name] = values
        return self.functions[name]

    def increment(self, u: fem.Function):
        """Return I + grad u at the points, as UFL."""
        if self.grid.axisymmetric and not self.grid.even:
            if "increments" not in self.live:
                self.follow("increments", (3, 3), lambda data: data.increments(u.x.array.copy()))
            return self.functions["increments"]
        return ufl.Identity(self.grid.stretches) + (self.grad(u) if self.grid.axisymmetric else self.gradient(u))

    def moved_by(self, u: fem.Function):
        """Return u at the points as UFL.  In unequal cells it is a coefficient, so that kernels fit all cells."""
        if self.grid.even:
            return self.value(u)
        d = self.grid.dim
        return self.follow("displaced", (d,), lambda data: self.grid.at(data.cells, data.x, u.x.array.reshape(-1, d)))

    def deformation(self, u: fem.Function):
        """Return the deformation gradient at the points as a UFL variable, from u and the field `F`."""
        F = self.increment(u) * self.F
        return ufl.variable(block(F) if self.grid.axisymmetric else F)

    def _taylor(self, f, order: int):
        total = derivative = f
        for k in range(1, order + 1):
            derivative = term = ufl.grad(derivative)
            for _ in range(k):  # contracting the k-th gradient takes half of the time of nested grad(dot(., xi))
                term = ufl.dot(term, self.offset)
            total += term / factorial(k)
        return total


def _moments(grid: Grid) -> dict[str, tuple[int, ...]]:
    """Return the names and shapes of the geometric moments of pieces, see `cutting.Pieces`."""
    return {"mixed": (3,)} if grid.dim == 3 else {"hoop": (4,)} if grid.axisymmetric else {}


class Places(Keyed):
    """Positions of points and their cells, as an immutable object.

    Parameters
    ----------
    cells : (n,)
        Owned local cell of each point.
    x : (n, d), m
        Positions of the points.
    mixed : (n, d), m^2
        In 3D: mean products of the offsets from the centroid of each piece, see `Pieces`.  For points without extent it
        is None, and the products are zero.
    hoop : (n, 4)
        In axisymmetry: moments of the pieces in the plane, see `Pieces`.  For points without extent it is None.
    """

    def __init__(
        self,
        grid: Grid,
        cells: NDArray[np.int32],
        x: NDArray[np.float64],
        mixed: NDArray[np.float64] | None = None,
        hoop: NDArray[np.float64] | None = None,
    ):
        self.grid = grid
        self.cells = cells
        self.x = x
        self.mixed = mixed
        self.offset = offset = x - grid.midpoints[cells]
        if grid.axisymmetric and hoop is None:
            hoop = np.column_stack([offset, offset.prod(axis=1), x[:, 0]])
        self.hoop = hoop
        self.filled, self.slots = np.unique(cells, return_inverse=True)
        """Two arrays: the cells that contain points, and for each point the index of its cell among these cells."""

    @cached_property
    def nodal(self) -> NDArray[np.intp]:
        """Unrolled local dofs (d, 2^d, cells) of Q1 vectors in the cells that contain points."""
        d = self.grid.dim
        return (self.grid.cell_nodes[self.filled] * d + np.arange(d)[:, None, None]).transpose(0, 2, 1).copy()

    @cached_property
    def dofs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Dofs (n,) of Q1 vectors in all cells with points, and the indices of the dofs of each cell in this array."""
        d = self.grid.dim
        nodes, at = np.unique(self.grid.cell_nodes[self.filled], return_inverse=True)
        return tuple((rows.reshape(-1, 1) * d + np.arange(d)).astype(np.intp).ravel() for rows in (nodes, at))

    def part(self, rows: NDArray[np.int64]) -> Places:
        """Return the positions of the points with the indices `rows`."""
        mixed, hoop = (None if values is None else values[rows] for values in (self.mixed, self.hoop))
        return Places(self.grid, self.cells[rows], self.x[rows], mixed, hoop)

    def shape_gradients(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the gradients (n, 2^d, d), in 1/m, of the shape functions at points, or their means over pieces."""
        mixed = None if self.mixed is None else self.mixed[chosen]
        return self.grid.shape_gradients(self.cells[chosen], self.x[chosen], mixed)

    @cached_property
    def products(self) -> list[list[tuple[int, NDArray[np.float64] | float]]]:
        """For each axis, pairs of `bits` and `product`.

        The number `bits` selects some of the other axes, see `Grid.monomials`.  The array `product` (n,) is the product
        of the offsets from the midpoint of the cell along these axes.  For pieces it is the mean of this product.
        """
        along = []
        for axis in range(self.grid.dim):
            others = [a for a in range(self.grid.dim) if a != axis]
            out = [(0, 1.0), *((1 << a, self.offset[:, a]) for a in others)]
            if len(others) == 2:
                mixed = 0.0 if self.mixed is None else self.mixed[:, axis]
                out.append((sum(1 << a for a in others), self.offset[:, others].prod(axis=1) + mixed))
            along.append(out)
        return along

    def stretch(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 1 + u_r / r at the points for nodal displacements u (nodes, d), in m, see `FormPoints.hoop`."""
        grid, (*offset, product, radius) = self.grid, self.hoop.T
        h = grid.h if grid.even else grid.sizes(self.cells).T[..., None]
        hats = [0.5 + x[:, None] * grid.signs[:, a] / h[a] for a, x in enumerate(offset)]
        uneven = (product - offset[0] * offset[1])[:, None] * grid.signs.prod(axis=1) / h.prod(axis=0)
        return 1 + ((hats[0] * hats[1] + uneven) * u[grid.cell_nodes[self.cells], 0]).sum(axis=1) / radius


class PointData(Keyed):
    """Points with weights and fields, as an immutable object.

    Parameters
    ----------
    points
        Coefficients of the forms.
    places
        Cells and positions of the points.
    weight : (n,), m^d
        Volumes that the points represent.
    fields
        Values (n, ...) of the fields by name.  Names that the forms do not use are ignored.
    """

    def __init__(self, points: FormPoints, places: Places, weight: NDArray[np.float64], fields: dict[str, NDArray]):
        self.points = points
        self.places = places
        self.cells = places.cells
        self.x = places.x
        self.volume, n = weight, len(places.cells)
        self.rows = {"offset": places.offset, "weight": (weight / points.grid.volumes(self.cells))[:, None]}
        if points.grid.dim == 3:
            self.rows["mixed"] = np.zeros_like(places.x) if places.mixed is None else places.mixed
        if points.grid.axisymmetric:
            self.rows["hoop"] = places.hoop
        self.rows |= {name: fields[name].reshape(n, size) for name, size in points.sizes.items()}
        self._stored: Latest[NDArray[np.float64]] = Latest()

    def part(self, points: FormPoints, places: Places, rows: NDArray[np.int64]) -> PointData:
        """Return the data of the points with the indices `rows`, for the fields of `points`."""
        fields = {name: self.rows[name][rows] for name in points.sizes}
        return PointData(points, places, self.volume[rows], fields)

    def having(self, **fields: NDArray[np.float64]) -> PointData:
        """Return these points with new values of the named fields."""
        kept = {name: self.rows[name] for name in self.points.sizes}
        return PointData(self.points, self.places, self.volume, kept | fields)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the values (n, size) of a field."""
        return self.rows[name]

    def gradients(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) of a Q1 vector with the nodal values u, and store them."""
        nodal = u.take(self.places.nodal)
        return self._stored(nodal, partial(self._of_nodal, nodal))

    def forget(self) -> None:
        """Delete the gradients that `gradients` has stored."""
        self._stored = Latest()

    def increments(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return I + grad u (n, 9), with the circumferential stretch, for the nodal values u of a Q1 vector."""
        out = np.zeros((len(self.cells), 3, 3))
        out[:, :2, :2] = np.eye(2) + self.gradients_of(u).reshape(-1, 2, 2)
        out[:, 2, 2] = self.places.stretch(u.reshape(-1, 2))
        return out.reshape(len(out), 9)

    def gradients_of(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) of a Q1 vector with the nodal values u."""
        return self._of_nodal(u.take(self.places.nodal))

    def _of_nodal(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) of a Q1 vector from its values at the nodes of the cells."""
        places = self.places
        grid = self.points.grid
        d = self.points.grid.dim
        of_cells = grid.over_edges(grid.monomials @ nodal, places.filled)
        out = np.empty((len(self.cells), d, d))
        # one component at a time: numpy takes six times as long for rows of a few numbers
        for axis in range(d):
            along = 0.0
            for others, product in places.products[axis]:
                along += product * of_cells[:, others | 1 << axis].take(places.slots, axis=1, mode="wrap")
            out[:, :, axis] = along.T
        return out.reshape(len(self.cells), d**2)


Packed = tuple[NDArray[np.float64], list[tuple[slice, NDArray[np.float64], NDArray[np.intp]]]]
"""Coefficients with one row per point; and for each grid function its columns, its values, and the dofs of each row."""


class Rows:
    """Coefficients of a compiled form, with one row for each point."""

    def __init__(self, compiled: _compat.CompiledForm, points: FormPoints):
        names = {f: name for name, f in points.functions.items()}
        self._fixed, self._changing = [], []
        self._gathered = []
        start = 0
        for f in compiled.coefficients:
            dofs, bs = _compat.cell_dofs(f.function_space), f.function_space.dofmap.bs
            columns = slice(start, start + dofs.shape[1] * bs)
            if f not in names:
                self._gathered.append((columns, f.x.array, dofs, bs))
            elif names[f] in points.live:
                self._changing.append((columns, names[f], points.live[names[f]]))
            else:
                self._fixed.append((columns, names[f]))
            start = columns.stop
        self._width = start
        self._packed: Latest[Packed] = Latest()
        self._room: Latest[NDArray[np.float64]] = Latest(self._packed)

    def live(self, data: PointData) -> dict[str, NDArray[np.float64]]:
        """Return the present values of the fields that change between assemblies."""
        out = {}
        for _, name, values in self._changing:
            out[name] = values(data)
        return out

    def room(self, size: int) -> NDArray[np.float64]:
        """Return a buffer for at least `size` rows.  It is kept between steps, because allocation is slow."""
        buffer = self._room.value
        if buffer is None or size > len(buffer):
            buffer = self._room(size, lambda: np.zeros((size, self._width)))
        return buffer

    def __call__(
        self, data: PointData, chosen: slice | NDArray[np.int64], live: dict[str, NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return the rows of the chosen points.  The argument `live` is the result of the method `live`."""
        if isinstance(chosen, slice):
            key = (data.key, chosen.start) if chosen.start else data.key
        else:
            key = object()  # no later call has the same points
        rows, dofs = self._packed(key, partial(self._pack, data, chosen))
        for columns, name, _ in self._changing:
            rows[:, columns] = live[name][chosen]
        for columns, values, at in dofs:
            rows[:, columns] = values.take(at, mode="wrap")  # "raise" checks every index
        return rows

    def _pack(self, data: PointData, chosen: slice | NDArray[np.int64]) -> Packed:
        """Return rows with the fields that do not change for the same points, and the dofs of grid functions."""
        cells = data.cells[chosen]
        rows, dofs = self.room(len(cells))[: len(cells)], []
        for columns, name in self._fixed:
            rows[:, columns] = data.rows[name][chosen]
        for columns, values, of_cells, bs in self._gathered:
            at = of_cells[cells][:, :, None].astype(np.intp) * bs + np.arange(bs)  # numpy's index type avoids copies
            dofs.append((columns, values, at.reshape(len(cells), at.shape[1] * bs)))
        return rows, dofs


class PointForm:
    """A form with the measure `points.dx`, compiled once and assembled for any positions of the points.

    form: linear or bilinear UFL form, with integrals over `points.dx` only.
    dense: whether the values of a DG0 test function are numbered over the cells with points, not over all cells.
    Kernels are then called for other cells, as in `PointExpression`, and all cells must be equal.
    """

    def __init__(self, form: ufl.Form, points: FormPoints, dense: bool = False):
        self._dense, self.compiled = dense, _compat.CompiledForm(form)
        self._rows, self._bound = Rows(self.compiled, points), Latest()

    def _parts(self, data: PointData) -> list[tuple]:
        """Return the chunks of points, each with the form bound to its cells."""
        cells, bind = data.places.slots if self._dense else data.cells, self.compiled.bind
        return self._bound(cells, lambda: [(rows, bind(cells[rows])) for rows in in_chunks(len(cells))])

    def assemble_vector(self, b: NDArray[np.float64], data: PointData) -> None:
        """Add the vector to the local array `b`, with contributions to ghosts in the ghost entries."""
        live = self._rows.live(data)
        for part, form in self._parts(data):
            self.compiled.assemble_vector(b, self._rows(data, part, live), form)

    def assemble_matrix(self, A: PETSc.Mat, data: PointData) -> None:
        """Add the matrix to `A`, with unrolled local dofs and without final assembly."""
        live = self._rows.live(data)
        for part, form in self._parts(data):
            self.compiled.assemble_matrix(A, self._rows(data, part, live), form)


class FacetForm:
    """A form over active cells, or over faces between them.

    The form is compiled when any process has such cells or faces.
    """

    def __init__(self, form: ufl.Form, comm: MPI.Intracomm):
        self._form, self._comm = form, comm
        self._last: Latest[FacetSum] = Latest()

    @property
    def used(self) -> bool:
        """Whether the form has been compiled so far."""
        return "compiled" in vars(self)

    def on(self, facets: NDArray[np.int32]) -> FacetSum:
        """Return the form over these facets of this process.  All processes must call this method."""
        make = partial(FacetSum, self, facets)
        return self._last(facets, lambda: make(self._comm.allreduce(len(facets)) > 0), self._comm)

    @cached_property
    def compiled(self) -> _compat.CompiledForm:
        """The compiled form."""
        return _compat.CompiledForm(self._form)


class FacetSum:
    """A form over `facets` of this process.

    some: whether any process has such facets.
    """

    def __init__(self, form: FacetForm, facets: NDArray[np.int32], some: bool):
        self._of = form
        self._facets = facets
        self.some = some

    @cached_property
    def _bound(self):
        compiled = self._of.compiled if self.some else None
        return compiled.bind(self._facets) if len(self._facets) else None

    def assemble_matrix(self, A: PETSc.Mat) -> None:
        """Add the matrix to `A`, with unrolled local dofs and without final assembly."""
        if self._bound is not None:
            self._of.compiled.assemble_matrix(A, None, self._bound)

    def assemble_vector(self, b: NDArray[np.float64]) -> None:
        """Add the vector to the local array `b`, with contributions to ghosts in the ghost entries."""
        if self._bound is not None:
            self._of.compiled.assemble_vector(b, None, self._bound)


class PointExpression:
    """A UFL expression of the fields of points, evaluated at every point.

    Kernels are called for arbitrary cells, one cell for each point, so that a DG0 test function yields one value for
    each point.  The result is divided by the volume of the cell.  Gradients of grid functions are allowed only if all
    cells are equal.

    expression: UFL expression of any shape in the fields of `points`.
    """

    def __init__(self, expression: ufl.core.expr.Expr, points: FormPoints):
        self._shape = expression.ufl_shape
        q = ufl.TestFunction(points.grid.cellwise(self._shape))
        dx = ufl.dx(domain=points.grid.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 0})
        self._compiled = _compat.CompiledForm(ufl.inner(expression, q) * dx)
        self._rows = Rows(self._compiled, points)
        sizes = {min(size, points.grid.num_owned) for size in (MANY, BATCH)}
        self._bound = {size: self._compiled.bind(np.arange(size)) for size in sorted(sizes)}
        self._rows.room(max(sizes))
        self._values = np.empty((max(sizes), int(np.prod(self._shape, dtype=int))))
        self._grid = points.grid

    def live(self, data: PointData) -> dict[str, NDArray[np.float64]]:
        """Return the present values of the fields that change between assemblies."""
        return self._rows.live(data)

    def evaluate(
        self, data: PointData, chosen: NDArray[np.int64] | None = None, live: dict[str, NDArray] | None = None
    ) -> NDArray[np.float64]:
        """Return the values (n, *shape) at the chosen points, by default at all points.

        live: result of the method `live`.
        """
        live = self.live(data) if live is None else live
        count = len(data.cells if chosen is None else chosen)
        out, start = np.empty((count, self._values.shape[1])), 0
        of_cells = self._grid.volumes(np.arange(len(self._values)))[..., None] if not self._grid.even else None
        while start < count:
            size = max((size for size in self._bound if size <= count - start), default=min(self._bound))
            stop, values = min(start + size, count), self._values[:size]
            self._rows(data, slice(start, stop) if chosen is None else chosen[start:stop], live)
            values[:] = 0.0
            self._compiled.assemble_vector(values.reshape(-1), self._rows.room(size)[:size], self._bound[size])
            of_cell = self._grid.cell_volume if of_cells is None else of_cells[: stop - start]
            np.divide(values[: stop - start], of_cell, out=out[start:stop])
            start = stop
        return out.reshape(count, *self._shape)


class CellSums:
    """Sums of scalar UFL expressions over the points of each cell."""

    def __init__(self, quantities: Sequence[ufl.core.expr.Expr], points: FormPoints):
        self._count = len(quantities)
        self._grid, q = points.grid, ufl.TestFunction(points.grid.cellwise((self._count,)))
        dense = points.grid.even
        self._form = PointForm(ufl.inner(ufl.as_vector(quantities), q) * points.dx, points, dense)

    def __call__(self, data: PointData) -> NDArray[np.float64]:
        """Return the sums (cells, quantities) in the cells that contain points."""
        if not self._grid.even:
            sums = np.zeros((self._grid.num_local, self._count))
            self._form.assemble_vector(sums.reshape(-1), data)
            return sums[data.places.filled]
        sums = np.zeros((len(data.places.filled), self._count))
        self._form.assemble_vector(sums.reshape(-1), data)
        return sums
