# SPDX-License-Identifier: MIT
"""Both linearised problems at once, where factors of K cost too much: large bodies in 3D.

    [ K  -B^T ] [du]   [R_u]
    [ B   C   ] [dp] = [R_p]

GMRES, preconditioned from the right with the upper triangle in which the fixed-stress operator P = C + beta V
stands for the Schur complement C + B K^-1 B^T, and one multigrid cycle each for K^-1 and P^-1.

To 1e-3 it takes 10 to 15 iterations, each with one cycle on K.  Conjugate gradients on the Schur complement take 3,
but with 35 to 60 cycles in their inner solves; flexible GMRES with inner solves to 0.1 or 0.01 takes 12 to 24
cycles, MINRES with the diagonal blocks 17 to 23 and leaves five times the residual.
"""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from mpm_dolfinx.problems.momentum import Momentum
from mpm_dolfinx.solve.linear import multigrid_solver
from mpm_dolfinx.problems.storage import Storage


class BlockSolver:
    """GMRES on displacement and pressure together.

    Parameters
    ----------
    momentum, storage
        The two problems.
    cycle
        One multigrid cycle on K.
    """

    def __init__(self, momentum: Momentum, storage: Storage, cycle: PETSc.PC):
        self._momentum, self._storage, self._cycle = momentum, storage, cycle
        self._u, self._f = momentum.unknowns.vector(), momentum.unknowns.vector()
        self._p, self._g = storage.unknowns.vector(), storage.unknowns.vector()
        self._split = momentum.unknowns.size
        size = (self._split + storage.unknowns.size, None)
        self._A = PETSc.Mat().createPython((size, size), self, comm=momentum.unknowns.comm)
        self._A.setUp()
        self._x, self._b = self._A.createVecs()
        self._storage_solver = multigrid_solver(storage.P, "storage")
        self._storage_cycle = self._storage_solver.pc
        self._ksp = PETSc.KSP().create(self._A.comm)
        self._ksp.setType(PETSc.KSP.Type.GMRES)
        self._ksp.setOptionsPrefix("mpm_block_")
        self._ksp.setPCSide(PETSc.PC.Side.RIGHT)
        self._ksp.setGMRESRestart(60)
        self._ksp.pc.setType(PETSc.PC.Type.PYTHON)
        self._ksp.pc.setPythonContext(self)
        self._ksp.setOperators(self._A)
        self._ksp.setFromOptions()
        self._scale = 1.0, 1.0

    def free(self) -> None:
        """Free solvers and matrix, which refer to this object as it does to them."""
        for own in (self._ksp, self._A, self._storage_solver):
            own.destroy()

    def set_preconditioner(self, P: PETSc.Mat) -> None:
        """Take the present fixed-stress operator."""
        self._storage_cycle.setOperators(P, P)
        self._storage_cycle.setUp()

    def solve(self, du: PETSc.Vec, dp: PETSc.Vec, scale: tuple[float, float], rtol: float) -> int:
        """Solve for (du, dp) with the problems' residuals on the right; return the number of iterations.

        Parameters
        ----------
        scale
            Of the two residuals, m^d and N: what counts as equally large.
        rtol
            Relative to the norm of both residuals, scaled.
        """
        self._scale = scale
        self._join(self._momentum.residual, self._storage.residual, self._b, *(1 / s for s in scale))
        self._ksp.setTolerances(rtol=rtol, atol=0.0, max_it=500)
        self._ksp.solve(self._b, self._x)
        self._part(self._x, du, dp)
        return self._ksp.getIterationNumber()

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply by the operator; the rows are scaled."""
        s = self._storage
        self._part(x, self._u, self._p)
        s.B.mult(self._u, self._g)
        s.C.multAdd(self._p, self._g, self._g)
        s.B_momentum.multTranspose(self._p, self._f)
        self._f.scale(-1.0)
        self._momentum.K.multAdd(self._u, self._f, self._f)
        self._join(self._f, self._g, y, *(1 / a for a in self._scale))

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner."""
        self._part(x, self._f, self._g, *self._scale)
        self._storage_cycle.apply(self._g, self._p)
        self._storage.B_momentum.multTransposeAdd(self._p, self._f, self._f)
        self._cycle.apply(self._f, self._u)
        self._join(self._u, self._p, y)

    def _part(self, x: PETSc.Vec, u: PETSc.Vec, p: PETSc.Vec, scale_u: float = 1.0, scale_p: float = 1.0) -> None:
        values = x.array_r
        np.multiply(values[: self._split], scale_u, out=u.array_w)
        np.multiply(values[self._split :], scale_p, out=p.array_w)

    def _join(self, u: PETSc.Vec, p: PETSc.Vec, x: PETSc.Vec, scale_u: float = 1.0, scale_p: float = 1.0) -> None:
        values = x.array_w
        np.multiply(u.array_r, scale_u, out=values[: self._split])
        np.multiply(p.array_r, scale_p, out=values[self._split :])
