# SPDX-License-Identifier: MIT
"""The unknowns that a step has: its own numbering, vectors and matrices.

Functions live on the whole grid; vectors, matrices and factors hold only the free degrees of freedom
of active nodes or cells.  A local-to-global map with -1 for every other degree of freedom lets
dolfinx assemble straight into them: PETSc ignores negative indices.
"""

from __future__ import annotations

from itertools import combinations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat

ITERATIVE = 1500
"""Unknowns of a 3D problem from which on it is solved by iterations: see `multigrid_solver`.

Seconds of five load steps of a square beam by factors and by iterations: 0.5 and 0.5 with 1200 unknowns, 2.5 and 1.4
with 2600, 8.2 and 2.1 with 4900.  In a plate of one cell both cost the same up to 6000.
"""


class Unknowns:
    """Numbering of some of the degrees of freedom of a function's space.

    Parameters
    ----------
    function
        Any function of the space; its ghost pattern is used.
    dofs
        Unrolled local degrees of freedom, ghosts included, that are unknowns.
    """

    def __init__(self, function: fem.Function, dofs: NDArray[np.int64]):
        self._space = space = function.function_space
        self.comm = space.mesh.comm
        owned = space.dofmap.index_map.size_local * space.dofmap.bs
        number = np.full(len(function.x.array), -1, dtype=np.int32)
        self.owned = dofs[dofs < owned]
        """Unrolled local degrees of freedom of the entries of the vectors."""
        self.size = len(self.owned)
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
    def iterative(self) -> bool:
        """Whether problems of these unknowns are better solved by iterations than by factors."""
        return self._space.mesh.topology.dim == 3 and self.global_size >= ITERATIVE

    def rigid_body_modes(self) -> PETSc.NullSpace:
        """Return translations and rotations, as far as the unknowns allow them: what strain does not see."""
        d = self._space.dofmap.bs
        node, axis = np.divmod(self.owned, d)
        x, direction = self._space.tabulate_dof_coordinates()[node, :d], np.eye(d)[axis]
        modes = np.concatenate([direction, np.empty((self.size, d * (d - 1) // 2))], axis=1)
        x = x - self.comm.allreduce(x.sum(axis=0)) / self.global_size
        x /= np.sqrt(self.comm.allreduce(float(np.square(x).sum())) / self.global_size)
        for k, (a, b) in enumerate(combinations(range(d), 2)):
            modes[:, d + k] = direction[:, a] * x[:, b] - direction[:, b] * x[:, a]
        size, turn = np.linalg.eigh(self.comm.allreduce(modes.T @ modes))
        kept = size > 1e-10 * size.max()
        modes = modes @ (turn[:, kept] / np.sqrt(size[kept]))
        vectors = [self.gather_owned(mode) for mode in modes.T]
        return PETSc.NullSpace().create(vectors=vectors, comm=self.comm)

    def gather_owned(self, values: NDArray[np.float64]) -> PETSc.Vec:
        """Return a new vector with these entries of this process."""
        v = self.vector()
        v.array_w[:] = values
        return v

    def vector(self) -> PETSc.Vec:
        """Return a new vector of zeros."""
        v = PETSc.Vec().createMPI((self.size, None), comm=self.comm)
        if self.comm.size == 1:
            v.destroy()
            v = PETSc.Vec().createSeq(self.size, comm=self.comm)
        v.set(0.0)
        return v

    def gather(self, values: NDArray[np.float64], out: PETSc.Vec) -> PETSc.Vec:
        """Copy the entries of a local array on the whole grid into a vector."""
        out.array_w[:] = values[self.owned]
        return out

    def add(self, function: fem.Function, scale: float, v: PETSc.Vec) -> None:
        """Add scale * v to a function, ghosts updated."""
        with np.errstate(invalid="ignore", over="ignore"):  # a failed solve; the residual tells
            function.x.array[self.owned] += scale * v.array_r
        function.x.scatter_forward()


def matrix(rows: Unknowns, columns: Unknowns, row_length: int | NDArray[np.int64]) -> PETSc.Mat:
    """Return an empty sparse matrix for assembly, with room for `row_length` entries a row, or in each row."""
    A = PETSc.Mat().create(rows.comm)
    A.setSizes(((rows.size, None), (columns.size, None)))
    A.setType(PETSc.Mat.Type.AIJ)
    length = np.broadcast_to(row_length, (rows.size,)).astype(PETSc.IntType)
    A.setPreallocationNNZ((np.minimum(length, columns.size), length if rows.comm.size > 1 else 0))
    A.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
    A.setLGMap(rows.map, columns.map)
    return A


def direct_solver(A: PETSc.Mat, name: str, symmetric: bool = True, often: bool = False) -> PETSc.KSP:
    """Return a solver that factorises A, a symmetric one as L D L^T, refactorised when A has changed.

    On one process PETSc's own with an approximate minimum degree ordering: at 3000 unknowns in 2D 3 ms (nested
    dissection 4, MUMPS 5, UMFPACK 7, CHOLMOD 9), at 44000 150 (290) ms.  In parallel MUMPS, whose factors take
    as long on two processes, and a solve five to ten times as long as PETSc's own: if factors are used `often`,
    each of a few processes (`REDUNDANT`) has them all and they do the same work.
    """
    if symmetric:
        A.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    ksp = PETSc.KSP().create(A.comm)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.setOptionsPrefix(f"mpm_{name}_")
    kind = PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU
    options = PETSc.Options(ksp.getOptionsPrefix())
    if often and 1 < A.comm.size <= REDUNDANT:
        ksp.pc.setType(PETSc.PC.Type.REDUNDANT)
        for name, value in {"type": kind, "factor_mat_ordering_type": "amd", "factor_zeropivot": 0.0}.items():
            options.setValue(f"redundant_pc_{name}", value)
    else:
        ksp.pc.setType(kind)
        if A.comm.size > 1:
            options.setValue("mat_mumps_icntl_13", 1)  # counts negative pivots
            ksp.pc.setFactorSolverType("mumps")
        else:
            ksp.pc.setFactorOrdering("amd")
            ksp.pc.setFactorPivot(0.0)  # PETSc's 2e-14 refuses slivers of cells: rows of any scale are welcome
    ksp.setOperators(A)
    ksp.setFromOptions()
    return ksp


REDUNDANT = 4
"""Processes up to which each has the factors that are used often."""


def negative_pivots(solver: PETSc.KSP) -> int:
    """Return the number of negative eigenvalues of the matrix whose L D L^T factors a direct solver has."""
    factors = solver.pc.getFactorMatrix()
    return factors.getMumpsInfog(12) if factors.comm.size > 1 else factors.getInertia()[0]


def multigrid_solver(A: PETSc.Mat, name: str) -> PETSc.KSP:
    """Return GMRES with smoothed aggregation multigrid (GAMG), set up anew when A has changed.

    For elasticity A must have the rigid body modes as near-null space when it is set up.  GMRES because a
    tangent may be unsymmetric or, where a body buckles, indefinite; on definite ones conjugate gradients
    take as many iterations: about 20 to 1e-8, with 5000 unknowns as with 60000.  With 60000 the set-up takes 1.0 s,
    for another tangent of the same unknowns 0.3 s, the solution 0.5 s; BoomerAMG (hypre) takes three to four times
    as long, and ML cannot keep its set-up.  Unknowns in blocks of three, with rows of the identity for fixed ones,
    would save a quarter.
    """
    prefix = f"mpm_{name}_"
    options = PETSc.Options(prefix)
    for option, value in _MULTIGRID.items():
        if not options.hasName(option):
            options.setValue(option, value)
    ksp = PETSc.KSP().create(A.comm)
    ksp.setType(PETSc.KSP.Type.GMRES)
    ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.setOptionsPrefix(prefix)
    ksp.pc.setType(PETSc.PC.Type.GAMG)
    ksp.setOperators(A)
    ksp.setFromOptions()
    return ksp


_MULTIGRID = {
    "pc_gamg_reuse_interpolation": "true",  # a new tangent of the same unknowns: a quarter of the time
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_pc_type": "jacobi",
}


def zero(A: PETSc.Mat) -> None:
    """Empty a matrix for assembly, whether it was assembled before or not."""
    if A.assembled:
        A.zeroEntries()


def collect_garbage(comm: MPI.Intracomm) -> None:
    """Free the PETSc objects that Python has dropped on all processes, together: PETSc keeps them until it is asked.

    On several processes their order of going may differ from one to the other; releases before 3.20 or so keep
    those of a single process too.  Without this, a run keeps the matrices and factors of all its steps.
    """
    PETSc.garbage_cleanup(comm)
    PETSc.garbage_cleanup(PETSc.COMM_SELF)


def sum_ghosts(function: fem.Function) -> NDArray[np.float64]:
    """Add up what other processes assembled into ghosts; return the function's local array."""
    if function.function_space.mesh.comm.size > 1:
        _compat.scatter_reverse_add(function)
    return function.x.array
