# SPDX-License-Identifier: MIT
"""Wrappers of every function of dolfinx that differs between the supported releases (0.5.2 and 0.9 to 0.11).

No other module of the package depends on dolfinx's release.  Branches marked OLD are for release 0.5 only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from time import perf_counter

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import cpp, fem, la, mesh
from numpy.typing import NDArray

from mpm_dolfinx.base._compiler import compiler

OLD = not hasattr(fem, "functionspace")
SUBDOMAIN = 1  # the one subdomain id of all measures

if OLD:
    from dolfinx import jit
else:
    import basix.ufl
    from dolfinx import graph


def box_mesh(
    comm: MPI.Intracomm,
    cells: NDArray[np.int64],
    x: NDArray[np.float64],
    ranks: NDArray[np.int32],
    offsets: NDArray[np.int32],
) -> mesh.Mesh:
    """Return a mesh of quadrilaterals or hexahedra with a given partition.

    Parameters
    ----------
    cells : (n, 2^d)
        Global indices of the nodes of this process's cells.  In the order of the nodes of a cell, the first coordinate
        varies fastest.
    x : (m, d), m
        Positions of the mesh nodes that this process contributes.  Nodes of lower ranks have lower global indices.
    ranks, offsets
        `ranks[offsets[i] : offsets[i + 1]]` contains the owner of cell i, then the ranks where this cell is a ghost.
    """
    kind = {4: "quadrilateral", 8: "hexahedron"}[cells.shape[1]]
    where = (ranks, offsets)
    if OLD:
        # FFCx would add this variant itself after its first form, and so change the names of later libraries
        domain = ufl.Mesh(ufl.VectorElement("Lagrange", kind, 1, variant="equispaced"))
        ghosts = mesh.GhostMode.shared_facet
        lists, cells = cpp.graph.AdjacencyList_int32(*where), cpp.graph.AdjacencyList_int64(cells)
        return mesh.create_mesh(comm, cells, x, domain, ghosts, lambda *_: lists)
    domain = ufl.Mesh(basix.ufl.element("Lagrange", kind, 1, shape=(x.shape[1],)))
    lists = graph.adjacencylist(*where)
    lists = getattr(lists, "_cpp_object", lists)  # 0.11 wraps lists, but does not unwrap the result of a partitioner
    return mesh.create_mesh(comm, cells=cells, x=x, e=domain, partitioner=lambda *_: lists)


def function_space(msh: mesh.Mesh, family: str, degree: int, shape: tuple[int, ...] = ()):
    """Return the function space of a family ("DG", "Lagrange"), a degree and a value shape."""
    if not OLD:
        return fem.functionspace(msh, (family, degree, shape) if shape else (family, degree))
    with compiler(msh.comm):
        return fem.FunctionSpace(msh, _old_element(msh, family, degree, shape))


def _old_element(msh, family: str, degree: int, shape: tuple[int, ...]):
    cell = msh.ufl_cell()
    if family == "DG" and cell.cellname() in ("quadrilateral", "hexahedron"):
        family = "DQ"  # UFL would rename DG itself, but print a line about it
    if len(shape) == 2:
        return ufl.TensorElement(family, cell, degree, shape=shape)
    if len(shape) == 1:
        return ufl.VectorElement(family, cell, degree, dim=shape[0])
    return ufl.FiniteElement(family, cell, degree)


def mixed_space(msh: mesh.Mesh, parts: Sequence[tuple[str, int, tuple[int, ...]]]):
    """Return the mixed function space of several spaces, each given as (family, degree, shape)."""
    if OLD:
        with compiler(msh.comm):
            return fem.FunctionSpace(msh, ufl.MixedElement(*[_old_element(msh, *p) for p in parts]))
    elements = [basix.ufl.element(f, msh.basix_cell(), k, shape=s) for f, k, s in parts]
    return fem.functionspace(msh, basix.ufl.mixed_element(elements))


def cell_dofs(V) -> NDArray[np.int32]:
    """Return the blocked degrees of freedom (cells, n) of all cells on this process, ghosts included."""
    dofs = V.dofmap.list
    return dofs.array.reshape(-1, V.dofmap.dof_layout.num_dofs) if OLD else np.asarray(dofs)


def petsc_vec(u: fem.Function) -> PETSc.Vec:
    """Return the PETSc vector that shares memory with a function."""
    return u.vector if OLD else u.x.petsc_vec


def num_cells(msh: mesh.Mesh) -> tuple[int, int]:
    """Return the number of owned cells on this process, and the number of cells including ghosts."""
    index_map = msh.topology.index_map(msh.topology.dim)
    return index_map.size_local, index_map.size_local + index_map.num_ghosts


def cell_kind(msh: mesh.Mesh) -> str:
    """Return the name of the mesh's cell type, such as "tetrahedron"."""
    return msh.topology.cell_name()


def geometry_dofs(msh: mesh.Mesh) -> NDArray[np.int32]:
    """Return the geometry nodes (cells, n) of all cells on this process, ghosts included."""
    if OLD:
        return msh.geometry.dofmap.array.reshape(len(msh.geometry.dofmap), -1)
    return np.asarray(msh.geometry.dofmaps[0] if hasattr(msh.geometry, "dofmaps") else msh.geometry.dofmap)


def scatter_reverse_add(u: fem.Function) -> None:
    """Add the values of ghost entries to the values on the processes that own these entries."""
    u.x.scatter_reverse(la.ScatterMode.add if OLD else la.InsertMode.add)


seconds: Counter[str] = Counter()
"""Total wall time, s, of each part of a run on this process, measured by `Timer`."""


class Timer:
    """Context that adds its wall time to an entry of `seconds`.  The timers of dolfinx 0.9 resolve only 10 ms."""

    __enter__ = staticmethod(perf_counter)  # only `__init__` keeps the time

    def __init__(self, part: str):
        self._part = part
        self._start = perf_counter()

    def __exit__(self, *_: object) -> None:
        seconds[self._part] += perf_counter() - self._start


def expanded(form: ufl.Form) -> ufl.Form:
    """Return a form in which all derivatives are expanded.

    Expansion may remove coefficients from a facet form. Without it, dolfinx 0.9 packs coefficients that kernels omit.
    """
    return ufl.algorithms.expand_derivatives(form)


class CompiledForm:
    """A UFL form over cells or interior facets, compiled once and integrated over any list of entities.

    The kernel is called once for each entry of the list, so a cell may occur several times.  Ghost cells are not
    allowed, because dolfinx 0.5 silently skips them.

    `form`: form whose integrals all have the same type, and the subdomain id `SUBDOMAIN`.
    """

    def __init__(self, form: ufl.Form):
        (self.integral_type,) = {i.integral_type() for i in form.integrals()}
        self.mesh = _mesh_of(form)
        self._spaces = [a.ufl_function_space() for a in form.arguments()]
        coefficients, self._constants = form.coefficients(), form.constants()
        if OLD:
            with compiler(self.mesh.comm):
                self._ufcx, self._module, _ = jit.ffcx_jit(self.mesh.comm, form)
            position = self._ufcx.original_coefficient_position
            count = self._ufcx.num_coefficients
        else:
            with compiler(self.mesh.comm):
                self._compiled = fem.compile_form(self.mesh.comm, form)
            position = self._compiled.ufcx_form.original_coefficient_positions
            count = self._compiled.ufcx_form.num_coefficients
            self._all = coefficients
        self.coefficients = [coefficients[position[i]] for i in range(count)]
        self._last = None
        if OLD:
            address = self._module.ffi.cast("uintptr_t", self._module.ffi.addressof(self._ufcx))
            several = self._spaces, self.coefficients, self._constants
            self._parts = int(address), *([one._cpp_object for one in of] for of in several)

    @property
    def form(self):
        """Dolfinx's form over the entities of the last call of `bind`."""
        return self._last if OLD else self._last._cpp_object

    def bind(self, entities: NDArray[np.int32]):
        """Return dolfinx's form with an integral over the given cells or interior facets.

        Later calls do not change the returned form.  `assemble_vector` and `assemble_matrix` accept it.
        """
        entities = np.ascontiguousarray(entities, dtype=np.int32)
        cells = self.integral_type == "cell"
        kind = fem.IntegralType.cell if cells else fem.IntegralType.interior_facet
        dim = self.mesh.topology.dim - (0 if cells else 1)
        if OLD:
            values = np.full(len(entities), SUBDOMAIN, dtype=np.int32)
            tags = cpp.mesh.MeshTags_int32(self.mesh, dim, entities, values)
            self._last = cpp.fem.Form_float64(*self._parts, {kind: tags}, self.mesh)
        else:
            if not cells:
                entities = _facet_cells(self.mesh, entities, dim)
            bound = fem.create_form(
                self._compiled,
                self._spaces,
                self.mesh,
                {kind: [(SUBDOMAIN, entities)]},
                {c: c for c in self._all},
                {c: c for c in self._constants},
            )
            self._last = bound  # keeps the data of its C++ object alive
        return self.form

    def packed(self, form=None) -> dict:
        """Return dolfinx's coefficient values: an array for each integral, with one row for each entity."""
        form = form or self.form
        return cpp.fem.pack_coefficients(form)

    def assemble_vector(self, b: NDArray[np.float64], rows: NDArray[np.float64] | None = None, form=None) -> None:
        """Add the assembled vector to `b`, without communication between processes.

        `rows`: values of the coefficients, one row for each entity, by default from `packed()`.
        """
        form = form or self.form
        packed = self.packed(form) if rows is None else dict.fromkeys(self._keys, rows)
        cpp.fem.assemble_vector(b, form, cpp.fem.pack_constants(form), packed)

    def assemble_matrix(self, A: PETSc.Mat, rows: NDArray[np.float64] | None = None, form=None) -> None:
        """Add the form's matrix to `A`, which has one row for each component of a node.  The caller must assemble `A`.

        `rows`: values of the coefficients, one row for each entity, by default from `packed()`.
        """
        form = form or self.form
        packed = self.packed(form) if rows is None else dict.fromkeys(self._keys, rows)
        cpp.fem.petsc.assemble_matrix(A, form, cpp.fem.pack_constants(form), packed, [], unrolled=True)

    @cached_property
    def _keys(self) -> list[tuple]:
        """Keys of `packed()`: indices of the integrals in dolfinx 0.11, subdomain ids in older releases."""
        return [(fem.IntegralType.cell, key) for _, key in self.packed()] or [(fem.IntegralType.cell, SUBDOMAIN)]


def _mesh_of(form: ufl.Form):
    if OLD:
        return form.ufl_domain().ufl_cargo()
    spaces = [a.ufl_function_space() for a in (*form.arguments(), *form.coefficients())]
    return spaces[0].mesh


def links(msh: mesh.Mesh) -> list[NDArray[np.int32]]:
    """Return the arrays of all computed connectivities of a mesh."""
    found = []
    for pair in np.ndindex(*[msh.topology.dim + 1] * 2):
        with suppress(RuntimeError):  # raised by dolfinx 0.9 and later if not computed
            found.append(msh.topology.connectivity(*pair))
    return [one.array for one in found if one is not None]


def _facet_cells(msh, facets, dim: int) -> NDArray[np.int32]:
    """Return the two cells of each interior facet, and its index in each: (cell0, index0, cell1, index1, ...)."""
    adjacency = msh.topology.connectivity(dim, dim + 1)
    cells = adjacency.array[adjacency.offsets[facets][:, None] + np.arange(2)]
    cell_facets = msh.topology.connectivity(dim + 1, dim).array.reshape(-1, 2 * (dim + 1))  # cells are boxes
    local = np.argmax(cell_facets[cells] == facets[:, None, None], axis=2)
    return np.stack([cells, local], axis=2).reshape(-1).astype(np.int32)


def compiled(form: ufl.Form):
    """Return `fem.form(form)`, compiled within the context `compiler`."""
    with compiler(_mesh_of(form).comm):
        return fem.form(form)
