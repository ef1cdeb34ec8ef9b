# SPDX-License-Identifier: MIT
"""Direct linear solvers.  `solver_choice.plan` chooses between direct solvers and multigrid.

On one process, PETSc factorises displacement matrices with a block for each node, in nested-dissection order.  With
33000 unknowns in 2D and a symmetric matrix, the first factorisation takes 214 ms with these blocks, and 888 ms in
minimum degree order without blocks.  CHOLMOD takes 185 ms, UMFPACK 286 ms, and MUMPS 722 ms.

On several processes, one process has the factors of displacements, and another process the factors of pressures.  In
large scenes, all processes share the factors of MUMPS (`Thresholds.mumps`).
"""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.solve.petsc_options import set_defaults
from mpm_dolfinx.solve.solver_choice import MUMPS, NODAL

MOST = 500
"""Largest number of iterations of a linear solve. The Krylov space has this dimension, so GMRES never restarts.

With a restart every 30 iterations (the default of PETSc), FGMRES stagnates on the nearly singular tangent of a footing.
Without restarts, FGMRES takes 50 iterations.
"""
TOLERABLE = (-3, -8, -10)  # PETSc's reasons: too many iterations, indefinite preconditioner, indefinite matrix


def direct_solver(
    A: PETSc.Mat, name: str, symmetric: bool = True, gathered: bool = False, package: str | None = None
) -> PETSc.KSP:
    """Return a solver that factorises A at the first solve and after changes of A.

    `symmetric`: whether the factors are L D L^T; otherwise they are L U.
    `gathered`: whether only the last process has the factors.  This is faster if many systems have the same matrix.
    `package`: package of the factorisation, by default PETSc on one process, and MUMPS on several processes.
    """
    if symmetric:
        A.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    ksp = _preonly(A, name)
    if gathered and A.comm.size > 1:
        _set_gathered(ksp, A, SingleFactors(name, symmetric), A.comm.size - 1)
    else:
        ksp.pc.setType(PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU)
        if A.comm.size > 1:
            PETSc.Options(ksp.getOptionsPrefix()).setValue("mat_mumps_icntl_13", 1)  # makes MUMPS count negative pivots
            package = "mumps"
        if package is not None:
            ksp.pc.setFactorSolverType(package)
        else:
            ksp.pc.setFactorOrdering("nd" if gathered else "amd")
            ksp.pc.setFactorPivot(0.0)  # PETSc's smallest pivot, 2e-14, would reject nearly empty cells
    ksp.setOperators(A)
    ksp.setFromOptions()
    return ksp


def _preonly(A: PETSc.Mat, name: str) -> PETSc.KSP:
    ksp = PETSc.KSP().create(A.comm)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.setOptionsPrefix(f"mpm_{name}_")
    return ksp


def renew(A: PETSc.Mat) -> None:
    """Rebuild the sparsity pattern of a matrix in PETSc, after other matrices were added to this matrix."""
    A.setPreallocationCSR([part.copy() for part in A.getValuesCSR()])


def solved(ksp: PETSc.KSP, name: str) -> int:
    """Return the number of iterations of the last solve. Raise NotConverged if this solve failed.

    A solve has not failed if it ends at an indefinite matrix, or after the largest number of iterations.
    """
    count, reason = ksp.getIterationNumber(), ksp.getConvergedReason()
    if reason < 0 and reason not in TOLERABLE:
        why = (
            "values are not finite"
            if reason == PETSc.KSP.ConvergedReason.DIVERGED_NANORINF
            else f"PETSc reason {reason}"
        )
        raise NotConverged(f"the linear solver of the {name} failed after {count} iterations ({why})")
    return count


def negative_pivots(solver: PETSc.KSP) -> int:
    """Return the number of negative eigenvalues of a matrix from the L D L^T factors of a direct solver."""
    factors = solver.pc.getFactorMatrix()
    return factors.getMumpsInfog(12) if factors.comm.size > 1 else factors.getInertia()[0]


def displacement_solver(A: PETSc.Mat, name: str, unknowns: Unknowns, how: str, symmetric: bool) -> PETSc.KSP:
    """Return a direct solver for many solves with one matrix A of displacements. `how`: see `SolverPlan`."""
    if how != NODAL:
        return direct_solver(A, name, symmetric, package="mumps" if how == MUMPS else None)
    ksp = _preonly(A, name)
    _set_gathered(ksp, A, NodalFactors(unknowns, symmetric), 0)
    ksp.setOperators(A)
    return ksp


def _set_gathered(ksp: PETSc.KSP, A: PETSc.Mat, factors: NodalFactors | SingleFactors, rank: int) -> None:
    """Replace the preconditioner of a solver by factors on one process."""
    ksp.pc.setType(PETSc.PC.Type.PYTHON)
    ksp.pc.setPythonContext(Gathered(A.createVecRight(), factors, rank))


def factorise(*preconditioners: PETSc.PC) -> None:
    """Factorise all matrices, in parallel if different processes have their factors."""
    for pc in preconditioners:
        pc.setUp()
    for pc in preconditioners:
        if pc.getType() == PETSc.PC.Type.PYTHON:
            pc.getPythonContext().factorise()


class Gathered:
    """Preconditioner for PETSc: factors of a matrix on one process. `setUp` gathers the matrix.

    `x`: vector with an entry for each column of the matrix.
    `factors`: factors of the gathered matrix.
    `rank`: process that has the factors.
    """

    def __init__(self, x: PETSc.Vec, factors: NodalFactors | SingleFactors, rank: int):
        self._factors = factors
        self._here = x.comm.rank == rank
        self._scatter = None
        if x.comm.size > 1:
            self._rows = PETSc.IS().createStride(x.size if self._here else 0, step=1, comm=PETSc.COMM_SELF)
            self._whole = PETSc.Vec().createSeq(self._rows.size, comm=PETSc.COMM_SELF)
            self._scatter = PETSc.Scatter().create(x, self._rows, self._whole, self._rows)

    def setUp(self, pc: PETSc.PC) -> None:
        """Gather the present matrix on the process of the factors."""
        A = pc.getOperators()[1]
        if self._scatter is None:
            self._factors.take(*A.getValuesCSR())
            return
        (whole,) = A.createSubMatrices([self._rows], [self._rows])
        if self._here:
            self._factors.take(*whole.getValuesCSR())
        whole.destroy()

    def factorise(self) -> None:
        """Factorise the matrix if it has changed."""
        if self._factors.latest.value is not None:  # on the process of the factors
            self._factors.latest.value.factorise()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Set y to the solution for the right-hand side x."""
        factors = self._factors.latest.value
        if self._scatter is None:
            if factors is not None:
                y.array_w[:] = factors.solve(x.array_r)
            return
        insert = PETSc.InsertMode.INSERT
        self._scatter.scatter(x, self._whole, insert, PETSc.ScatterMode.FORWARD)
        if factors is not None:
            self._whole.array_w[:] = factors.solve(self._whole.array)
        self._scatter.scatter(self._whole, y, insert, PETSc.ScatterMode.REVERSE)


class SingleFactors:
    """Factors of matrices on one process, computed on demand.

    `name`, `symmetric`: see `direct_solver`.
    """

    def __init__(self, name: str, symmetric: bool):
        self._options = f"{name}_gathered", symmetric
        self.latest: Latest[RowFactors] = Latest()
        """The last factors, or None."""

    def take(self, rows: NDArray[np.int32], columns: NDArray[np.int32], values: NDArray[np.float64]) -> None:
        """Set the matrix, in compressed rows."""
        self.latest((rows, columns), lambda: RowFactors(rows, columns, *self._options)).take(values)


class RowFactors:
    """Factors of matrices with one sparsity pattern, by `direct_solver`.

    `rows`, `columns`: the sparsity pattern, in compressed rows.
    """

    def __init__(self, rows: NDArray[np.int32], columns: NDArray[np.int32], name: str, symmetric: bool):
        csr = rows, columns, np.zeros(len(columns))
        self._matrix = PETSc.Mat().createAIJ(len(rows) - 1, csr=csr, comm=PETSc.COMM_SELF)
        self._pattern = rows, columns
        self._solver = direct_solver(self._matrix, name, symmetric, gathered=True)
        self._x, self._b = self._matrix.createVecs()

    def take(self, values: NDArray[np.float64]) -> None:
        """Set the entries of the matrix to `values`, in the order of the pattern."""
        self._matrix.setValuesCSR(*self._pattern, values)
        self._matrix.assemble()

    def factorise(self) -> None:
        """Factorise the matrix if it has changed."""
        self._solver.pc.setUp()  # PETSc's KSPSetUp ignores a change of entries alone

    def solve(self, b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the solution for the right-hand side b."""
        self._b.array_w[:] = b
        self._solver.solve(self._b, self._x)
        return self._x.array_r


class NodalFactors:
    """Factors of displacement matrices with a block for each node, on the first process, computed on demand.

    `unknowns`: unknown displacements, with consecutive components of each node.
    `symmetric`: whether the factors are U^T D U; otherwise they are L U.
    """

    def __init__(self, unknowns: Unknowns, symmetric: bool):
        node, axis = unknowns.nodes
        comm = unknowns.comm
        counts = np.concatenate([[0], np.cumsum(comm.allgather(len(np.unique(node))))])
        block = counts[comm.rank] + np.unique(node, return_inverse=True)[1]
        rows = (block, axis, unknowns.positions)
        self._nodes = tuple(np.concatenate(comm.gather(values) or [values]) for values in rows)  # all on process 0
        self._dim, self._symmetric = unknowns.dim, symmetric
        self.latest: Latest[BlockFactors] = Latest()
        """The last factors, or None."""

    def take(self, rows: NDArray[np.int32], columns: NDArray[np.int32], values: NDArray[np.float64]) -> None:
        """Set the matrix, in compressed rows."""
        if len(rows) > 1:  # otherwise walls fix all nodes, and the matrix is empty, which PETSc rejects
            make = (rows, columns, *self._nodes, self._dim, self._symmetric)
            self.latest((rows, columns), lambda: BlockFactors(*make)).take(values)


def dissection(x: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the nested-dissection order (n,) of nodes of a grid at positions x (n, d), in m.

    The middle grid line halves a box of nodes. Nodes on this line come last. Each half is divided in the same way.
    """
    at = np.stack([_lines(along) for along in x.T], axis=1)
    high, every = np.tile(at.max(axis=0, initial=0), (len(at), 1)), np.arange(len(at))
    low, key = np.zeros_like(high), np.zeros(len(at), dtype=np.int64)
    while (high > low).any():
        axis = (high - low).argmax(axis=1)
        one = every, axis
        middle, place = (low[one] + high[one]) // 2, at[one]
        key = 3 * key + np.where(place == middle, 2, place > middle)
        low[one] = np.where(place < middle, low[one], middle + (place > middle))
        high[one] = np.where(place > middle, high[one], middle - (place < middle))
    return np.argsort(key, kind="stable")


def _lines(x: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the index of the grid line of each coordinate. Only lines with nodes are counted."""
    values, at = np.unique(x, return_inverse=True)
    return np.cumsum(np.diff(values, prepend=values[:1]) > SAME * (values[-1:] - values[:1]))[at]


class BlockFactors:
    """Factors of matrices with one sparsity pattern, with a block for each node.

    `rows`, `columns`: the sparsity pattern, in compressed rows.
    `block`, `axis`: node and component of each unknown.
    `x` (n, d): position of each unknown, m.
    `dim`: number of components of a node.
    `symmetric`: whether the factors are U^T D U; otherwise they are L U.
    """

    def __init__(self, rows, columns, block, axis, x, dim: int, symmetric: bool):
        count = int(block.max(initial=-1)) + 1
        rank = np.empty(count, dtype=np.int64)
        rank[dissection(x[np.unique(block, return_index=True)[1]])] = np.arange(count)
        node, lengths = rank[block].astype(np.int32), np.diff(rows)
        self._place = node * dim + axis
        kept = np.arange(len(columns))
        if symmetric:  # the upper triangle
            kept = np.flatnonzero(np.repeat(node, lengths) <= node[columns])
        place = self._place.astype(np.int32)
        i, j = np.repeat(place, lengths)[kept], place[columns[kept]]
        # components that walls fix have 1 on the diagonal
        missing = np.setdiff1d(np.arange(count * dim, dtype=np.int32), place)
        number = np.concatenate([kept, np.full(len(missing), len(columns))]) + 1
        where, n = (np.concatenate([i, missing]), np.concatenate([j, missing])), count * dim
        blocks = scipy.sparse.coo_matrix((number, where), shape=(n, n)).tocsr().tobsr((dim, dim))
        blocks.sort_indices()
        self._source = blocks.data
        self._pattern = blocks.indptr.astype(PETSc.IntType), blocks.indices.astype(PETSc.IntType)
        make = PETSc.Mat().createSBAIJ if symmetric else PETSc.Mat().createBAIJ
        self._matrix = make((n, n), dim, csr=(*self._pattern, np.zeros(blocks.data.shape)), comm=PETSc.COMM_SELF)
        self._solver = ksp = _preonly(self._matrix, "nodal_factors")
        ksp.pc.setType(PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU)
        ksp.pc.setFactorOrdering("natural")
        ksp.pc.setFactorPivot(0.0)  # see `direct_solver`
        # size of the factors in nested dissection, 31/4 n^2 log2 n for n^2 nodes (George 1973)
        fill = 31 / 8 * count * np.log2(count + 1) / max(1, len(self._pattern[1]))
        set_defaults(ksp, {"pc_factor_fill": max(1.0, fill)})
        ksp.setOperators(self._matrix)
        ksp.setFromOptions()
        self._b, self._x = self._matrix.createVecs()
        self._b.set(0.0)

    def take(self, values: NDArray[np.float64]) -> None:
        """Set the entries of the matrix to `values`, in the order of the pattern."""
        self._matrix.setValuesBlockedIJV(*self._pattern, np.concatenate([[0.0], values, [1.0]])[self._source])
        self._matrix.assemble()

    def factorise(self) -> None:
        """Factorise the matrix if it has changed."""
        self._solver.pc.setUp()

    def solve(self, b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the solution for the right-hand side b, for all unknowns."""
        self._b.array_w[self._place] = b
        self._solver.solve(self._b, self._x)
        return self._x.array_r[self._place]
