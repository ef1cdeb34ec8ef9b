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
"""Points whose element matrices are made at a time, in the processor's cache; those that an expression takes at a time.

The latter where there are as many: kernels are called for all that a form is bound to.
"""


class PointMeasure(ufl.Measure):
    """Measure with a weight; of a sum over points, `f * dx` stands for sum_p w_p f(x_p)."""

    def __init__(self, mesh: Mesh, weight: ufl.core.expr.Expr, subdomain=_compat.SUBDOMAIN, degree: int = 0):
        super().__init__("dx", domain=mesh, subdomain_id=subdomain, metadata={"quadrature_degree": degree})
        self._weight = weight

    def __rmul__(self, integrand) -> ufl.Form:
        return super().__rmul__(self._weight * integrand)


class FormPoints:
    """What forms see of the points at which they are evaluated: coefficients, whose values come with the data.

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
        self.functions = {
            name: grid.coefficient(shape)
            for name, shape in {"offset": (grid.dim,), "weight": (), **_moments(grid), **fields}.items()
        }
        self.live: dict[str, Callable[[PointData], NDArray[np.float64]]] = {}
        """What gives the values (n, size) of fields that change while the points stay."""
        self.dx = PointMeasure(grid.mesh, self.functions["weight"])
        self.sizes = {name: int(np.prod(shape, dtype=int)) for name, shape in fields.items()}

    def __getattr__(self, name: str) -> fem.Function:
        functions = self.__dict__.get("functions", {})
        if name in functions:
            own = self.grid.dim == 2 and name in ("F", "dF") and functions[name].ufl_shape == (3, 3)
            return block(functions[name]) if own else functions[name]
        raise AttributeError(f"the points carry {', '.join(functions)}, not {name!r}")

    def at(self, cells: NDArray[np.int32], x: NDArray[np.float64], weight: NDArray[np.float64], **fields) -> PointData:
        """Return points in owned cells: see `PointData`; cells (n,), x (n, d) in m."""
        return PointData(self, Places(self.grid, cells, x), weight, fields)

    def value(self, f):
        """Return f at the point, f a Q1 function, test or trial function (any shape)."""
        return self._taylor(f, self.grid.dim)

    def grad(self, f):
        """Return grad f at the point, f a Q1 function, test or trial function (any shape).

        Of a vector in axisymmetry (3, 3), with f_r / r.
        """
        plane = self.plane_grad(f)
        if not (self.grid.axisymmetric and f.ufl_shape):
            return plane
        return ufl.as_matrix([[plane[0, 0], plane[0, 1], 0], [plane[1, 0], plane[1, 1], 0], [0, 0, self.hoop(f)]])

    def plane_grad(self, f):
        """Return grad f at the point, f a Q1 function, test or trial function, in axisymmetry in the plane."""
        return self._taylor(ufl.grad(f), self.grid.dim - 1)

    def hoop(self, f):
        """Return f_r / r, f a Q1 vector, in axisymmetry: its mean over what the point stands for."""
        *offset, product, radius = (self.functions["hoop"][i] for i in range(4))
        slope = ufl.grad(f[0])
        return (f[0] + ufl.dot(slope, ufl.as_vector(offset)) + ufl.grad(slope)[0, 1] * product) / radius

    def gradient(self, u: fem.Function) -> fem.Function:
        """Return grad u at the point, u a Q1 vector function, as a coefficient that numpy computes for the kernels.

        Derivatives by u do not see it.  All forms at the same u share the values.  In 3D, where the Taylor series has
        many terms, a kernel of Hencky's law takes half or a quarter of the time, and its compilation a fifth.
        """
        if "gradient" not in self.live:
            self.follow("gradient", (self.grid.dim, self.grid.dim), lambda data: data.gradients(u))
        return self.functions["gradient"]

    def follow(self, name: str, shape: tuple[int, ...], values: Callable[[PointData], NDArray]) -> fem.Function:
        """Return a new field as a coefficient; `values` gives those (n, size) of the points whenever a form is made."""
        self.functions[name] = self.grid.coefficient(shape)
        self.live[name] = values
        return self.functions[name]

    def increment(self, u: fem.Function):
        """Return Delta = I + grad u at the points as UFL."""
        if self.grid.axisymmetric and not self.grid.even:
            if "increments" not in self.live:
                self.follow("increments", (3, 3), lambda data: data.increments(u.x.array.copy()))
            return self.functions["increments"]
        return ufl.Identity(self.grid.stretches) + (self.grad(u) if self.grid.axisymmetric else self.gradient(u))

    def moved_by(self, u: fem.Function):
        """Return u at the points as UFL, in cells of many sizes as a coefficient: for forms called for other cells."""
        if self.grid.even:
            return self.value(u)
        d = self.grid.dim
        return self.follow("displaced", (d,), lambda data: self.grid.at(data.cells, data.x, u.x.array.reshape(-1, d)))

    def deformation(self, u: fem.Function):
        """Return F = Delta F_n at the points, which carry F_n as F, as a UFL variable."""
        F = self.increment(u) * self.F
        return ufl.variable(block(F) if self.grid.axisymmetric else F)

    def _taylor(self, f, order: int):
        total = derivative = f
        for k in range(1, order + 1):
            derivative = term = ufl.grad(derivative)
            for _ in range(k):  # contracting a k-th gradient halves the cost of nested grad(dot(., xi))
                term = ufl.dot(term, self.offset)
            total += term / factorial(k)
        return total


def _moments(grid: Grid) -> dict[str, tuple[int, ...]]:
    """Return name and shape of the moments that points carry in 3D and in axisymmetry, see `cutting.Pieces`."""
    return {"mixed": (3,)} if grid.dim == 3 else {"hoop": (4,)} if grid.axisymmetric else {}


class Places(Keyed):
    """Where points lie; nobody changes it.

    Parameters
    ----------
    cells : (n,)
        Owned local cell of each point.
    x : (n, d), m
        Positions.
    mixed : (n, d), m^2
        In 3D mean products of offsets of pieces about them, see `Pieces`; None for points.
    hoop : (n, 4)
        Of axisymmetric pieces their moments in the plane, see `Pieces`; without it, those of points.
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
        """The cells that hold points; and the place of each point's cell among these."""

    @cached_property
    def nodal(self) -> NDArray[np.intp]:
        """Unrolled local dofs (d, 2^d, cells) of Q1 vectors in the filled cells."""
        d = self.grid.dim
        return (self.grid.cell_nodes[self.filled] * d + np.arange(d)[:, None, None]).transpose(0, 2, 1).copy()

    @cached_property
    def dofs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Unrolled local dofs (n,) of Q1 vectors in the filled cells, and the places of each cell's among them."""
        d = self.grid.dim
        nodes, at = np.unique(self.grid.cell_nodes[self.filled], return_inverse=True)
        return tuple((rows.reshape(-1, 1) * d + np.arange(d)).astype(np.intp).ravel() for rows in (nodes, at))

    def part(self, rows: NDArray[np.int64]) -> Places:
        """Return some of the places."""
        mixed, hoop = (None if values is None else values[rows] for values in (self.mixed, self.hoop))
        return Places(self.grid, self.cells[rows], self.x[rows], mixed, hoop)

    def shape_gradients(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the gradients (m, 2^d, d), 1/m, of the shape functions at some of the points, or means over pieces."""
        mixed = None if self.mixed is None else self.mixed[chosen]
        return self.grid.shape_gradients(self.cells[chosen], self.x[chosen], mixed)

    def products(self, axis: int) -> list[tuple[int, NDArray[np.float64] | float]]:
        """Return the products (n,) of offsets along sets of the other axes, see `Grid.monomials`; means over pieces."""
        others = [a for a in range(self.grid.dim) if a != axis]
        out = [(0, 1.0), *((1 << a, self.offset[:, a]) for a in others)]
        if len(others) == 2:
            mixed = 0.0 if self.mixed is None else self.mixed[:, axis]
            out.append((sum(1 << a for a in others), self.offset[:, others].prod(axis=1) + mixed))
        return out

    def stretch(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 1 + u_r / r (n,) of nodal displacements u (nodes, d), m, in axisymmetry: see `FormPoints.hoop`."""
        grid, (*offset, product, radius) = self.grid, self.hoop.T
        h = grid.h if grid.even else grid.sizes(self.cells).T[..., None]
        hats = [0.5 + x[:, None] * grid.signs[:, a] / h[a] for a, x in enumerate(offset)]
        uneven = (product - offset[0] * offset[1])[:, None] * grid.signs.prod(axis=1) / h.prod(axis=0)
        return 1 + ((hats[0] * hats[1] + uneven) * u[grid.cell_nodes[self.cells], 0]).sum(axis=1) / radius


class PointData(Keyed):
    """Points with weights and fields, complete when made; nobody changes it.

    Parameters
    ----------
    points
        What forms see of them.
    places
        Their cells and positions.
    weight : (n,), m^d
        Volumes.
    fields
        Name and values (n, ...) of all fields of the points; those of other names are left out.
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
        """Return some of the points, at `places`, with those fields that `points` have."""
        fields = {name: self._rows[name][rows] for name in points.sizes}
        return PointData(points, places, self.volume[rows], fields)

    def having(self, **fields: NDArray[np.float64]) -> PointData:
        """Return the same points with other values (n, ...) of some fields."""
        kept = {name: self._rows[name] for name in self.points.sizes}
        return PointData(self.points, self.places, self.volume, kept | fields)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the values (n, size) of a field."""
        return self._rows[name]

    def gradients(self, u: fem.Function) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) of a Q1 vector function at its present values."""
        nodal = u.x.array.take(self.places.nodal)
        return self._gradients(nodal, lambda: self._of_nodal(nodal))

    def increments(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return I + grad u (n, 9), in axisymmetry with hoops, of a Q1 vector function with these values."""
        out = np.zeros((len(self.cells), 3, 3))
        out[:, :2, :2] = np.eye(2) + self.gradients_of(u).reshape(-1, 2, 2)
        out[:, 2, 2] = self.places.stretch(u.reshape(-1, 2))
        return out.reshape(len(out), 9)

    def gradients_of(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (n, d^2) of a Q1 vector function with these values, a local array."""
        return self._of_nodal(u.take(self.places.nodal))

    def _of_nodal(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the same by values at the nodes of the filled cells, see `Places.nodal`."""
        places = self.places
        grid = self.points.grid
        d = self.points.grid.dim
        of_cells = grid.over_edges(grid.monomials @ nodal, places.filled)
        out = np.empty((len(self.cells), d, d))
        # component by component: rows of a few numbers each would take numpy six times as long
        for axis in range(d):
            along = 0.0
            for others, product in places.products(axis):
                along += product * np.take(of_cells[:, others | 1 << axis], places.slots, axis=1, mode="wrap")
            out[:, :, axis] = along.T
        return out.reshape(len(self.cells), d**2)


class Rows:
    """Coefficients of a compiled form, one row a point.

    Parameters
    ----------
    compiled
        The form.
    points
        The points.
    """

    def __init__(self, compiled: _compat.CompiledForm, points: FormPoints):
        names = {f: name for name, f in points.functions.items()}
        self._columns = []
        self._gathered = []
        start = 0
        for f in compiled.coefficients:
            dofs, bs = _compat.cell_dofs(f.function_space), f.function_space.dofmap.bs
            stop = start + dofs.shape[1] * bs
            if f in names:
                self._columns.append((slice(start, stop), names[f]))
            else:
                self._gathered.append((slice(start, stop), f, dofs))
            start = stop
        self._width = start
        self._live = {name: points.live[name] for _, name in self._columns if name in points.live}
        self._room = Latest()
        self._dofs = Latest()
        self._packed = Latest()

    def live(self, data: PointData) -> dict[str, NDArray[np.float64]]:
        """Return the present values of those fields of the form that change while the points stay."""
        return {name: values(data) for name, values in self._live.items()}

    def room(self, size: int) -> NDArray[np.float64]:
        """Return the memory of the rows, at least `size` of them; what is kept saves the page faults of every step."""
        if self._room.value is None or size > len(self._room.value):
            self._packed.clear()
            return self._room(size, lambda: np.zeros((size, self._width)))
        return self._room.value

    def __call__(
        self, data: PointData, chosen: slice | NDArray[np.int64], live: dict[str, NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return the rows of the chosen points, the first of the memory of all; live: as `live` gives it."""
        cells = data.cells[chosen]
        rows = self.room(len(cells))[: len(cells)]
        if isinstance(chosen, slice):
            key = (data.key, chosen.start)
            dofs = self._dofs((data.places.key, chosen.start), lambda: self._dofs_of(cells))
            self._packed(key, lambda: self._pack(rows, data, chosen))
        else:
            self._packed.clear()
            dofs = self._dofs_of(cells)
            self._pack(rows, data, chosen)
        for columns, name in self._columns:
            if name in live:
                rows[:, columns] = live[name][chosen]
        for columns, f, at in dofs:
            rows[:, columns] = np.take(f.x.array, at, mode="wrap")  # "raise" checks every index
        return rows

    def _pack(self, rows: NDArray[np.float64], data: PointData, chosen: slice | NDArray[np.int64]) -> bool:
        """Set the columns that stay while the points do."""
        for columns, name in self._columns:
            if name not in self._live:
                rows[:, columns] = data[name][chosen]
        return True

    def _dofs_of(self, cells: NDArray[np.int32]) -> list[tuple[slice, fem.Function, NDArray[np.intp]]]:
        """Return where the values of grid functions are: unrolled, in numpy's own index type, which it else makes."""
        out = []
        for columns, f, dofs in self._gathered:
            bs = f.function_space.dofmap.bs
            at = dofs[cells][:, :, None].astype(np.intp) * bs + np.arange(bs)
            out.append((columns, f, at.reshape(len(cells), at.shape[1] * bs)))
        return out


class PointForm:
    """A form over `points.dx`, compiled once, assembled wherever the points are.

    Parameters
    ----------
    form
        Linear or bilinear UFL form whose integrals are all over `points.dx`.
    points
        The points.
    dense
        Tested by DG0, it has a value for each of the filled cells rather than for each cell of the grid: as
        `PointExpression`, it is called for other cells, which must be equal.
    """

    def __init__(self, form: ufl.Form, points: FormPoints, dense: bool = False):
        self._dense, self.compiled = dense, _compat.CompiledForm(form)
        self._rows, self._bound = Rows(self.compiled, points), Latest()

    def _parts(self, data: PointData) -> Iterator[tuple]:
        """Yield the form bound to one chunk of points after the other, with their rows."""
        cells, live = data.places.slots if self._dense else data.cells, self._rows.live(data)
        parts = in_chunks(len(cells))
        bound = self._bound(cells, lambda: [self.compiled.bind(cells[part]) for part in parts])
        for part, form in zip(parts, bound, strict=True):
            yield form, self._rows(data, part, live)

    def assemble_vector(self, b: NDArray[np.float64], data: PointData) -> None:
        """Add the vector to the local array `b`; contributions to ghosts stay there."""
        for form, rows in self._parts(data):
            self.compiled.assemble_vector(b, rows, form)

    def assemble_matrix(self, A: PETSc.Mat, data: PointData) -> None:
        """Add the matrix to `A`, by unrolled local dofs; the caller finalises it."""
        for form, rows in self._parts(data):
            self.compiled.assemble_matrix(A, rows, form)


class FacetForm:
    """A form over faces between active cells, or over these, compiled when first a process has such an entity.

    Parameters
    ----------
    form
        Linear or bilinear UFL form over interior facets or cells.
    comm
        The processes.
    """

    def __init__(self, form: ufl.Form, comm: MPI.Intracomm):
        self._form, self._comm = form, comm
        self._last: Latest[FacetSum] = Latest()

    @property
    def used(self) -> bool:
        """Whether the form has been needed so far."""
        return "compiled" in vars(self)

    def on(self, facets: NDArray[np.int32]) -> FacetSum:
        """Return the form over the facets of this process; all processes ask together, for they compile together."""
        make = partial(FacetSum, self, facets)
        return self._last(facets, lambda: make(self._comm.allreduce(len(facets)) > 0), self._comm)

    @cached_property
    def compiled(self) -> _compat.CompiledForm:
        """The compiled form."""
        return _compat.CompiledForm(self._form)


class FacetSum:
    """A form over some facets; some: whether any process has one."""

    def __init__(self, form: FacetForm, facets: NDArray[np.int32], some: bool):
        self._of = form
        self._facets = facets
        self.some = some

    @cached_property
    def _bound(self):
        compiled = self._of.compiled if self.some else None
        return compiled.bind(self._facets) if len(self._facets) else None

    def assemble_matrix(self, A: PETSc.Mat) -> None:
        """Add the matrix to `A`, by unrolled local dofs; the caller finalises it."""
        if self._bound is not None:
            self._of.compiled.assemble_matrix(A, None, self._bound)

    def assemble_vector(self, b: NDArray[np.float64]) -> None:
        """Add the vector to the local array `b`; contributions to ghosts stay there."""
        if self._bound is not None:
            self._of.compiled.assemble_vector(b, None, self._bound)


class PointExpression:
    """A UFL expression of the fields that points carry, evaluated at every point.

    The kernel sees of its cell the size only, by which it is divided: of grid functions expressions have no gradients,
    but where all cells are equal.  So it is called for as many different cells, whichever, and DG0, which tests the
    expression, keeps a value for each point.

    Parameters
    ----------
    expression
        UFL expression of any shape in the fields of `points`.
    points
        The points.
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
        volumes = points.grid.volumes(np.arange(max(sizes)))
        self._volume = volumes if points.grid.even else volumes[:, None]

    def live(self, data: PointData) -> dict[str, NDArray[np.float64]]:
        """Return the present values of the fields that change while the points stay."""
        return self._rows.live(data)

    def evaluate(
        self, data: PointData, chosen: NDArray[np.int64] | None = None, live: dict[str, NDArray] | None = None
    ) -> NDArray[np.float64]:
        """Return the values (m, *shape) at the chosen points, by default all; live: as `live` gives it."""
        live = self.live(data) if live is None else live
        count = len(data.cells if chosen is None else chosen)
        out, start = np.empty((count, self._values.shape[1])), 0
        while start < count:
            size = max((size for size in self._bound if size <= count - start), default=min(self._bound))
            stop, values = min(start + size, count), self._values[:size]
            self._rows(data, slice(start, stop) if chosen is None else chosen[start:stop], live)
            values[:] = 0.0
            self._compiled.assemble_vector(values.reshape(-1), self._rows.room(size)[:size], self._bound[size])
            of_cell = self._volume if np.isscalar(self._volume) else self._volume[: stop - start]
            np.divide(values[: stop - start], of_cell, out=out[start:stop])
            start = stop
        return out.reshape(count, *self._shape)


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
        self._count = len(quantities)
        self._grid, q = points.grid, ufl.TestFunction(points.grid.cellwise((self._count,)))
        dense = points.grid.even
        self._form = PointForm(ufl.inner(ufl.as_vector(quantities), q) * points.dx, points, dense)

    def __call__(self, data: PointData) -> NDArray[np.float64]:
        """Return the sums (cells, quantities) in the filled cells of the points."""
        if not self._grid.even:
            sums = np.zeros((self._grid.num_local, self._count))
            self._form.assemble_vector(sums.reshape(-1), data)
            return sums[data.places.filled]
        sums = np.zeros((len(data.places.filled), self._count))
        self._form.assemble_vector(sums.reshape(-1), data)
        return sums
