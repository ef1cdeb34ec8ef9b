# SPDX-License-Identifier: MIT
"""The unknowns of a step: their numbering, vectors and matrices.

Functions are defined on the whole grid.  Vectors, matrices and factorisations contain only the free degrees of freedom
of active nodes or cells.  All other degrees of freedom have the index -1 in the local-to-global map.  PETSc ignores
this index, so dolfinx can assemble directly into the vectors and matrices.
"""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from dolfinx import fem, la
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat


class Unknowns:
    """Numbering of the unknowns, a subset of the degrees of freedom of a function space.

    `function`: any function of the space, with ghosts.
    `dofs`: unrolled local degrees of freedom that are unknowns, ghosts included.
    `at`: positions (entities, d), in m, of this process's nodes or cells, and a mask.  Matrix rows may have entries in
    columns of other processes only where the mask is True.  Without `at`, all rows may have such entries.
    """

    def __init__(self, function: fem.Function, dofs: NDArray[np.int64], at: tuple[NDArray, NDArray] | None = None):
        self._x, near = at or (None, None)
        self._space = space = function.function_space
        self.comm = space.mesh.comm
        dofmap = space.dofmap
        owned = dofmap.index_map.size_local * dofmap.bs
        number = np.full(len(function.x.array), -1, dtype=np.int32)
        self.owned = dofs[dofs < owned]
        """Unrolled local degree of freedom of each entry of a vector of unknowns."""
        self.size = len(self.owned)
        self.near = True if near is None else near[self.owned // dofmap.bs]
        start = 0
        if self.comm.size > 1:
            start = self.comm.exscan(self.size) or 0
        number[self.owned] = np.arange(start, start + self.size)
        if self.comm.size > 1:
            carrier = fem.Function(space)
            carrier.x.array[:] = number
            carrier.x.scatter_forward()
            number[:] = carrier.x.array
        self.global_size = self.comm.allreduce(self.size)
        self.map = PETSc.LGMap().create(number, comm=self.comm)

    @property
    def dim(self) -> int:
        """Number of degrees of freedom of a node or a cell."""
        return self._space.dofmap.bs

    @property
    def nodes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Node (or cell) and component of each entry of a vector of unknowns."""
        return np.divmod(self.owned, self.dim)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Position (n, d), in m, of each entry of a vector of unknowns."""
        x = self._space.tabulate_dof_coordinates() if self._x is None else self._x
        return x[self.owned // self.dim, : self._space.mesh.geometry.dim]

    def gather_owned(self, values: NDArray[np.float64]) -> PETSc.Vec:
        """Return a new vector of unknowns, with the given values on this process."""
        v = self.vector()
        v.array_w[:] = values
        return v

    def vector(self) -> PETSc.Vec:
        """Return a new vector of unknowns, with zeros."""
        if self.comm.size == 1:
            v = PETSc.Vec().createSeq(self.size, comm=self.comm)
        else:
            v = PETSc.Vec().createMPI((self.size, None), comm=self.comm)
        v.set(0.0)
        return v

    def gather(self, values: NDArray[np.float64], out: PETSc.Vec) -> PETSc.Vec:
        """Copy the unknowns from an array of all local dofs into `out`, and return `out`."""
        out.array_w[:] = values[self.owned]
        return out

    def add(self, x: la.Vector, scale: NDArray[np.float64] | float, v: PETSc.Vec) -> None:
        """Add scale * v to the vector x of a function, with a vector v of unknowns, and update the ghosts of x."""
        x.array[self.owned] += scale * v.array_r
        x.scatter_forward()


def matrix(rows: Unknowns, columns: Unknowns, row_length: int | NDArray[np.int64]) -> PETSc.Mat:
    """Return an empty sparse matrix with memory for `row_length` entries in each row."""
    A = PETSc.Mat().create(rows.comm)
    A.setSizes(((rows.size, None), (columns.size, None)))
    A.setType(PETSc.Mat.Type.AIJ)
    length = np.zeros(rows.size, dtype=PETSc.IntType) + np.asarray(row_length, dtype=PETSc.IntType)
    elsewhere = np.where(rows.near, np.minimum(length, columns.global_size), 0) if rows.comm.size > 1 else 0
    A.setPreallocationNNZ((np.minimum(length, columns.size), elsewhere))
    A.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
    A.setLGMap(rows.map, columns.map)
    return A


def petsc_matrix(rows: scipy.sparse.csr_matrix, columns: int, comm: MPI.Intracomm, own: bool = False) -> PETSc.Mat:
    """Return the PETSc matrix with the given rows and number of columns on this process.

    `own`: whether the column indices of `rows` are local; otherwise they are global.
    """
    rows.sort_indices()  # PETSc requires it
    start = int(comm.exscan(columns) or 0) if own and comm.size > 1 else 0
    csr = [values.astype(PETSc.IntType) for values in (rows.indptr, rows.indices + start)]
    A = PETSc.Mat().createAIJ(((rows.shape[0], None), (columns, None)), csr=(*csr, rows.data), comm=comm)
    A.assemble()
    return A


def zero(A: PETSc.Mat) -> None:
    """Set a matrix to zero before assembly.  A matrix that has never been assembled does not change."""
    if A.assembled:
        A.zeroEntries()


def collect_garbage(comm: MPI.Intracomm) -> None:
    """Free the PETSc objects that Python has released on all processes.  All processes must call this function.

    PETSc keeps released objects in memory, because the order of release may differ between processes.  PETSc before
    about 3.20 keeps them on one process, too.  Without this function, the matrices of all steps would stay in memory.
    """
    PETSc.garbage_cleanup(comm)
    PETSc.garbage_cleanup(PETSc.COMM_SELF)


def sum_ghosts(function: fem.Function) -> NDArray[np.float64]:
    """Add the values at ghosts to the values of their owners, and return the local array."""
    if function.function_space.mesh.comm.size > 1:
        _compat.scatter_reverse_add(function)
    return function.x.array


def with_ghosts(space, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `rows` after the rows of ghosts are replaced by the rows of their owners.

    `rows` (n, k): values at the n local dofs.
    """
    if space.mesh.comm.size == 1:
        return rows
    carrier, out = fem.Function(space), np.empty_like(rows)
    for i, column in enumerate(rows.T):
        carrier.x.array[:] = column
        carrier.x.scatter_forward()
        out[:, i] = carrier.x.array
    return out
