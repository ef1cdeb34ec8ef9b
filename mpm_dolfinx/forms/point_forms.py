# SPDX-License-Identifier: MIT
"""Forms at material points: any UFL form, evaluated at the positions of the points.

A multilinear function on a box is a polynomial of degree d.  Its Taylor series about the midpoint of the cell ends
after d terms.  With xi = x_p - x_mid,

    v(x_p) = v + grad v . xi + 1/2 xi . grad grad v . xi + ...,   with the right side at the midpoint.

The right side is plain UFL, integrated by the one-point rule.  The offset xi and all other data of a point are DG0
coefficients.  Each entry in the list of cells of the integral has separate values of these coefficients.

The list contains a cell once for each point in it, with one row of coefficients per point.  The assembler therefore
calls the kernel once for each point, and the integral of f w/|cell| over the list is sum_p w_p f(x_p).  The generated
code is not modified.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
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
"""Points in one batch of element matrices, which fits into the cache; points in one call of an expression.

For few points the smaller number is used, because a bound kernel is called for all of its cells.
"""


class PointMeasure(ufl.Measure):
    """Integration measure with a weight, for sums over points: `f * dx` is sum_p w_p f(x_p)."""

    def __init__(self, mesh: Mesh, weight: ufl.core.expr.Expr, subdomain=_compat.SUBDOMAIN, degree: int = 0):
        super().__init__("dx", domain=mesh, subdomain_id=subdomain, metadata={"quadrature_degree": degree})
        self._weight = weight

    def __rmul__(self, integrand) -> ufl.Form:
        return super().__rmul__(self._weight * integrand)


class FormPoints:
    """The points in forms: UFL coefficients, whose values are given by a `PointData`.

    Parameters
    ----------
    grid
        Background grid.
    fields
        Name and shape of each quantity at the points; `points.name` is the UFL coefficient.
    """

    def __init__(self, grid: Grid, **fields: tuple[int, ...]):
        self.grid = grid
        self.functions = {
            name: grid.coefficient(shape)
            for name, shape in {"offset": (grid.dim,), "weight": (), **_moments(grid), **fields}.items()
        }
        self.live: dict[str, Callable[[PointData], NDArray[np.float64]]] = {}
        """Functions that return the values (n, size) of fields that change between assemblies for the same points."""
        self.dx = PointMeasure(grid.mesh, self.functions["weight"])
        self.sizes = {name: int(np.prod(shape, dtype=int)) for name, shape in fields.items()}

    def __getattr__(self, name: str) -> fem.Function:
        functions = self.__dict__.get("functions", {})
        if name in functions:
            own = self.grid.dim == 2 and name in ("F", "dF") and functions[name].ufl_shape == (3, 3)
            return block(functions[name]) if own else functions[name]
        raise AttributeError(f"the points carry {', '.join(functions)}, not {name!r}")

    def at(self, cells: NDArray[np.int32], x: NDArray[np.float64], weight: NDArray[np.float64], **fields) -> PointData:
        """Return points in owned cells (n,), at x (n, d), m, with weight (n,), m^d, and fields; see `PointData`."""
        return PointData(self, Places(self.grid, cells, x), weight, fields)

    def value(self, f):
        """Return f at the points, for a Q1 function, test or trial function f of any shape."""
        return self._taylor(f, self.grid.dim)

    def grad(self, f):
        """Return grad f at the points, for a Q1 function, test or trial function f of any shape.

        In axisymmetry the gradient of a vector is (3, 3), with f_r / r on the diagonal.
        """
        plane = self.plane_grad(f)
        if not (self.grid.axisymmetric and f.ufl_shape):
            return plane
        return ufl.as_matrix([[plane[0, 0], plane[0, 1], 0], [plane[1, 0], plane[1, 1], 0], [0, 0, self.hoop(f)]])

    def plane_grad(self, f):
        """Return grad f at the points like `grad`; in axisymmetry without the circumferential component."""
        return self._taylor(ufl.grad(f), self.grid.dim - 1)

    def hoop(self, f):
        """Return f_r / r of a Q1 vector f in axisymmetry, as the mean over the piece of each point."""
        *offset, product, radius = (self.functions["hoop"][i] for i in range(4))
        slope = ufl.grad(f[0])
        return (f[0] + ufl.dot(slope, ufl.as_vector(offset)) + ufl.grad(slope)[0, 1] * product) / radius

    def gradient(self, u: fem.Function) -> fem.Function:
        """Return grad u at the points as a coefficient, for a Q1 vector function u; numpy evaluates it.

        UFL derivatives by u do not see this dependence.  All forms at the same u share the values.  UFL would otherwise
        expand u as a Taylor polynomial about the cell's midpoint, with many terms in 3D.  With the coefficient instead,
        a kernel of Hencky's law takes at most half of the time to run, and a fifth of the time to compile.
        """
        if "gradient" not in self.live:
            values = u.x.array
            self.follow("gradient", (self.grid.dim, self.grid.dim), lambda data: data.gradients(values))
        return self.functions["gradient"]

    def follow(self, name: str, shape: tuple[int, ...], values: Callable[[PointData], NDArray]) -> fem.Function:
        """Return a new field as a coefficient.  `values` returns the values (n, size) at each assembly."""
        self.functions[name] = self.grid.coefficient(shape)
        self.live[name] = values
        return self.functions[name]

    def increment(self, u: fem.Function):
        """Return Delta = I + grad u at the points, as UFL."""
        if self.grid.axisymmetric and not self.grid.even:
            if "increments" not in self.live:
                self.follow("increments", (3, 3), lambda data: data.increments(u.x.array.copy()))
            return self.functions["increments"]
        return ufl.Identity(self.grid.stretches) + (self.grad(u) if self.grid.axisymmetric else self.gradient(u))

    def moved_by(self, u: fem.Function):
        """Return u at the points, as UFL; for unequal cells as a coefficient, so that kernels fit all cells."""
        if self.grid.even:
            return self.value(u)
        d = self.grid.dim
        return self.follow("displaced", (d,), lambda data: self.grid.at(data.cells, data.x, u.x.array.reshape(-1, d)))

    def deformation(self, u: fem.Function):
        """Return F = Delta F_n at the points, as a UFL variable; F_n is the field `F` of the points."""
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
    """Return names and shapes of the geometric moments of points in 3D and in axisymmetry, see `cutting.Pieces`."""
    return {"mixed": (3,)} if grid.dim == 3 else {"hoop": (4,)} if grid.axisymmetric else {}


class Places(Keyed):
    """Positions of points and their cells.  The object is immutable.

    Parameters
    ----------
    cells : (n,)
        Owned local cell of each point.
    x : (n, d), m
        Positions of the points.
    mixed : (n, d), m^2
        In 3D: mean products of the offsets in a piece about its centroid, see `Pieces`.  None, for points, means zero.
    hoop : (n, 4)
        In axisymmetry: moments of the pieces in the plane, see `Pieces`.  None, for points, means moments of points.
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
        """Cells that contain points, and the index of the cell of each point among these."""

    @cached_property
    def nodal(self) -> NDArray[np.intp]:
        """Unrolled local dofs (d, 2^d, cells) of Q1 vectors in the cells that contain points."""
        d = self.grid.dim
        return (self.grid.cell_nodes[self.filled] * d + np.arange(d)[:, None, None]).transpose(0, 2, 1).copy()

    @cached_property
    def dofs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Unrolled local dofs (n,) of Q1 vectors in all cells with points; index of each cell's dofs in these."""
        d = self.grid.dim
        nodes, at = np.unique(self.grid.cell_nodes[self.filled], return_inverse=True)
        return tuple((rows.reshape(-1, 1) * d + np.arange(d)).astype(np.intp).ravel() for rows in (nodes, at))

    def part(self, rows: NDArray[np.int64]) -> Places:
        """Return the positions of the points with indices `rows`."""
        mixed, hoop = (None if values is None else values[rows] for values in (self.mixed, self.hoop))
        return Places(self.grid, self.cells[rows], self.x[rows], mixed, hoop)

    def shape_gradients(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the gradients (m, 2^d, d), 1/m, of the shape functions at points, or their means over pieces."""
        mixed = None if self.mixed is None else self.mixed[chosen]
        return self.grid.shape_gradients(self.cells[chosen], self.x[chosen], mixed)

    @cached_property
    def products(self) -> list[list[tuple[int, NDArray[np.float64] | float]]]:
        """For each axis, pairs (bits, product).  `bits` selects some of the other axes, see `Grid.monomials`.

        `product` (n,) is the product of the offsets from the cell's midpoint along these axes, or its mean over the
        piece; 1 for no axis.
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
        """Return 1 + u_r / r (n,) for nodal displacements u (nodes, d), m, see `FormPoints.hoop`."""
        grid, (*offset, product, radius) = self.grid, self.hoop.T
        h = grid.h if grid.even else grid.sizes(self.cells).T[..., None]
        hats = [0.5 + x[:, None] * grid.signs[:, a] / h[a] for a, x in enumerate(offset)]
        uneven = (product - offset[0] * offset[1])[:, None] * grid.signs.prod(axis=1) / h.prod(axis=0)
        return 1 + ((hats[0] * hats[1] + uneven) * u[grid.cell_nodes[self.cells], 0]).sum(axis=1) / radius


class PointData(Keyed):
    """Points with weights and fields.  The object is immutable.

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
        self._rows = {"offset": places.offset, "weight": (weight / points.grid.volumes(self.cells))[:, None]}
        if points.grid.dim == 3:
            self._rows["mixed"] = np.zeros_like(places.x) if places.mixed is None else places.mixed
        if points.grid.axisymmetric:
            self._rows["hoop"] = places.hoop
        self._rows |= {name: fields[name].reshape(n, size) for name, size in points.sizes.items()}
        self._gradients: Latest[NDArray[np.float64]] = Latest()

    def part(self, points: FormPoints, places: Places, rows: NDArray[np.int64]) -> PointData:
        """Return the data of the points `rows`, for the fields of `points`, at the positions `places`."""
        fields = {name: self._rows[name][rows] for name in points.sizes}
        return PointData(points, places, self.volume[rows], fields)

    def having(self, **fields: NDArray[np.float64]) -> PointData:
        """Return the same points, with new values (n, ...) of some fields."""
        kept = {name: self._rows[name] for name in self.points.sizes}
        return PointData(self.points, self.places, self.volume, kept | fields)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the values (n, size) of a field."""
        return self._rows[name]

    def gradients(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) of a Q1 vector with nodal values u, a local array; stores the last result."""
        nodal = u.take(self.places.nodal)
        return self._gradients(nodal, lambda: self._of_nodal(nodal))

    def increments(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return I + grad u (n, 9), with the circumferential stretch, for a Q1 vector with nodal values u."""
        out = np.zeros((len(self.cells), 3, 3))
        out[:, :2, :2] = np.eye(2) + self.gradients_of(u).reshape(-1, 2, 2)
        out[:, 2, 2] = self.places.stretch(u.reshape(-1, 2))
        return out.reshape(len(out), 9)

    def gradients_of(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) of a Q1 vector with nodal values u, a local array."""
        return self._of_nodal(u.take(self.places.nodal))

    def _of_nodal(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) from values at the nodes of the cells, see `Places.nodal`."""
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
"""Rows of coefficients; and for each grid function among these the columns, the values, and the dofs of each row."""


class Rows:
    """Coefficients of a compiled form at the points, one row per point.

    Parameters
    ----------
    compiled
        The compiled form.
    points
        Points of the form.
    """

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
        """Return the current values of the fields that change between assemblies for the same points."""
        return {name: values(data) for _, name, values in self._changing}

    def room(self, size: int) -> NDArray[np.float64]:
        """Return a buffer for at least `size` rows.  It is kept between steps, because allocation of memory is slow."""
        if self._room.value is None or size > len(self._room.value):
            return self._room(size, lambda: np.zeros((size, self._width)))
        return self._room.value

    def __call__(
        self, data: PointData, chosen: slice | NDArray[np.int64], live: dict[str, NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return the rows of the chosen points, at the start of the buffer.  `live`: result of the method `live`."""
        if isinstance(chosen, slice):
            key = (data.key, chosen.start) if chosen.start else data.key
        else:
            key = object()  # no later call has the same points
        rows, dofs = self._packed(key, lambda: self._pack(data, chosen))
        for columns, name, _ in self._changing:
            rows[:, columns] = live[name][chosen]
        for columns, values, at in dofs:
            rows[:, columns] = values.take(at, mode="wrap")  # "raise" checks every index
        return rows

    def _pack(self, data: PointData, chosen: slice | NDArray[np.int64]) -> Packed:
        """Return rows with the fields that stay constant for the same points, and the dofs of grid functions."""
        cells = data.cells[chosen]
        rows, dofs = self.room(len(cells))[: len(cells)], []
        for columns, name in self._fixed:
            rows[:, columns] = data[name][chosen]
        for columns, values, of_cells, bs in self._gathered:
            at = of_cells[cells][:, :, None].astype(np.intp) * bs + np.arange(bs)  # numpy's index type avoids copies
            dofs.append((columns, values, at.reshape(len(cells), at.shape[1] * bs)))
        return rows, dofs


class PointForm:
    """A form with the measure `points.dx`, compiled once and assembled for any positions of the points.

    Parameters
    ----------
    form
        Linear or bilinear UFL form; all integrals use `points.dx`.
    points
        Points of the form.
    dense
        Whether to number the values of a DG0 test function by the cells that contain points, in place of all cells.
        Kernels are then called for other cells, as in `PointExpression`, so all cells must be equal.
    """

    def __init__(self, form: ufl.Form, points: FormPoints, dense: bool = False):
        self._dense, self.compiled = dense, _compat.CompiledForm(form)
        self._rows, self._bound = Rows(self.compiled, points), Latest()

    def _parts(self, data: PointData) -> Iterator[tuple]:
        """Yield for each chunk of points the form bound to their cells, and their rows of coefficients."""
        cells, live = data.places.slots if self._dense else data.cells, self._rows.live(data)
        bind = self.compiled.bind
        for part, form in self._bound(cells, lambda: [(rows, bind(cells[rows])) for rows in in_chunks(len(cells))]):
            yield form, self._rows(data, part, live)

    def assemble_vector(self, b: NDArray[np.float64], data: PointData) -> None:
        """Add the vector to the local array `b`.  Contributions to ghosts remain in the ghost entries."""
        for form, rows in self._parts(data):
            self.compiled.assemble_vector(b, rows, form)

    def assemble_matrix(self, A: PETSc.Mat, data: PointData) -> None:
        """Add the matrix to `A`, with unrolled local dofs and without final assembly."""
        for form, rows in self._parts(data):
            self.compiled.assemble_matrix(A, rows, form)


class FacetForm:
    """A form over faces between active cells, or over active cells.  It is compiled once any process has one of these.

    Parameters
    ----------
    form
        Linear or bilinear UFL form over interior facets or cells.
    comm
        Communicator of the processes.
    """

    def __init__(self, form: ufl.Form, comm: MPI.Intracomm):
        self._form, self._comm = form, comm
        self._last: Latest[FacetSum] = Latest()

    @property
    def used(self) -> bool:
        """Whether the form has been compiled so far."""
        return "compiled" in vars(self)

    def on(self, facets: NDArray[np.int32]) -> FacetSum:
        """Return the form over these facets of this process; all processes must call this, because it may compile."""
        make = partial(FacetSum, self, facets)
        return self._last(facets, lambda: make(self._comm.allreduce(len(facets)) > 0), self._comm)

    @cached_property
    def compiled(self) -> _compat.CompiledForm:
        """The compiled form."""
        return _compat.CompiledForm(self._form)


class FacetSum:
    """A form over some facets.  `some` tells whether any process has facets."""

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
        """Add the vector to the local array `b`.  Contributions to ghosts remain in the ghost entries."""
        if self._bound is not None:
            self._of.compiled.assemble_vector(b, None, self._bound)


class PointExpression:
    """A UFL expression of the fields of points, evaluated at every point.

    The kernel depends on the cell only through the cell's volume, and the result is divided by this volume.  Gradients
    of grid functions are therefore allowed only if all cells are equal.  The kernel is called for as many arbitrary
    cells as there are points, so that the DG0 test function yields one value for each point.

    Parameters
    ----------
    expression
        UFL expression of any shape in the fields of `points`.
    points
        Points of the expression.
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
        """Return the current values of the fields that change between assemblies for the same points."""
        return self._rows.live(data)

    def evaluate(
        self, data: PointData, chosen: NDArray[np.int64] | None = None, live: dict[str, NDArray] | None = None
    ) -> NDArray[np.float64]:
        """Return the values (m, *shape) at chosen points, by default all.  `live`: result of the method `live`."""
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
    """Sums over the points of each cell.  The assembler adds up the points through DG0 test functions.

    Parameters
    ----------
    quantities
        Scalar UFL expressions at the points.
    points
        Points of the expressions.
    """

    def __init__(self, quantities: Sequence[ufl.core.expr.Expr], points: FormPoints):
        self._count = len(quantities)
        self._grid, q = points.grid, ufl.TestFunction(points.grid.cellwise((self._count,)))
        dense = points.grid.even
        self._form = PointForm(ufl.inner(ufl.as_vector(quantities), q) * points.dx, points, dense)

    def __call__(self, data: PointData) -> NDArray[np.float64]:
        """Return the sums (cells, quantities) for the cells that contain points."""
        if not self._grid.even:
            sums = np.zeros((self._grid.num_local, self._count))
            self._form.assemble_vector(sums.reshape(-1), data)
            return sums[data.places.filled]
        sums = np.zeros((len(data.places.filled), self._count))
        self._form.assemble_vector(sums.reshape(-1), data)
        return sums
