# SPDX-License-Identifier: MIT
"""Both linearised problems at once, where factors of K cost too much: large bodies in 3D.

    [ K  -B^T ] [du]   [R_u]
    [ B   C   ] [dp] = [R_p]

GMRES, preconditioned from the right with the upper triangle in which the fixed-stress operator P = C + beta V
stands for the Schur complement C + B K^-1 B^T, and one multigrid cycle each for K^-1 and P^-1.

To 1e-3 it takes 7 to 12 iterations, each with one cycle on K, 11 to 26 at nu = 0.49 or where contrasts are 1e3.  With
Jacobi's smoothing of K (10 to 15, and 100 at nu = 0.49), conjugate gradients on the Schur complement took 3, but with
35 to 60 cycles in their inner solves; flexible GMRES with inner solves to 0.1 or 0.01 12 to 24 cycles, MINRES with the
diagonal blocks 17 to 23, leaving five times the residual.
"""

from __future__ import annotations

from weakref import finalize

from petsc4py import PETSc

import numpy as np

from mpm_dolfinx.problems.momentum import MomentumSystem
from mpm_dolfinx.problems.storage import StorageSystem
from mpm_dolfinx.solve.linear import multigrid_solver, solved


class BlockOperator:
    """Operator and preconditioner for PETSc, with rows scaled by what counts as equally large.

    Parameters
    ----------
    momentum, storage
        The matrices.
    momentum_cycle, storage_cycle
        One multigrid cycle each on K and P.
    """

    def __init__(self, momentum: MomentumSystem, storage: StorageSystem, momentum_cycle: PETSc.PC, storage_cycle):
        self._momentum, self._storage = momentum, storage
        self._cycle_u, self._cycle_p, self._split = momentum_cycle, storage_cycle, momentum.unknowns.size
        self._u, self._f = momentum.unknowns.vector(), momentum.unknowns.vector()
        self._p, self._g = storage.unknowns.vector(), storage.unknowns.vector()
        self.scale = np.ones(2)

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply by the operator."""
        s = self._storage
        self.part(x, self._u, self._p)
        s.B.mult(self._u, self._g)
        s.C.multAdd(self._p, self._g, self._g)
        s.B_momentum.multTranspose(self._p, self._f)
        self._f.scale(-1.0)
        self._momentum.K.multAdd(self._u, self._f, self._f)
        self.join(self._f, self._g, y, *(1 / self.scale))

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner."""
        self.part(x, self._f, self._g, *self.scale)
        self._cycle_p.apply(self._g, self._p)
        self._storage.B_momentum.multTransposeAdd(self._p, self._f, self._f)
        self._cycle_u.apply(self._f, self._u)
        self.join(self._u, self._p, y)

    def part(self, x: PETSc.Vec, u: PETSc.Vec, p: PETSc.Vec, scale_u: float = 1.0, scale_p: float = 1.0) -> None:
        """Set (u, p) to the scaled parts of x."""
        values = x.array_r
        np.multiply(values[: self._split], scale_u, out=u.array_w)
        np.multiply(values[self._split :], scale_p, out=p.array_w)

    def join(self, u: PETSc.Vec, p: PETSc.Vec, x: PETSc.Vec, scale_u: float = 1.0, scale_p: float = 1.0) -> None:
        """Set the parts of x to (u, p), scaled."""
        values = x.array_w
        np.multiply(u.array_r, scale_u, out=values[: self._split])
        np.multiply(p.array_r, scale_p, out=values[self._split :])


class BlockSolver:
    """GMRES on displacement and pressure together.

    Parameters
    ----------
    momentum, storage
        The matrices.
    cycle
        One multigrid cycle on K.
    """

    def __init__(self, momentum: MomentumSystem, storage: StorageSystem, cycle: PETSc.PC):
        self._momentum, self._storage = momentum, storage
        self._storage_solver = multigrid_solver(storage.P, "storage")
        self._operator = BlockOperator(momentum, storage, cycle, self._storage_solver.pc)
        finalize(self, vars(self._operator).clear)  # PETSc keeps contexts, and what they refer to
        size = (momentum.unknowns.size + storage.unknowns.size, None)
        self._A = PETSc.Mat().createPython((size, size), self._operator, comm=momentum.unknowns.comm)
        self._A.setUp()
        self._x, self._b = self._A.createVecs()
        self._ksp = PETSc.KSP().create(self._A.comm)
        self._ksp.setType(PETSc.KSP.Type.GMRES)
        self._ksp.setOptionsPrefix("mpm_block_")
        self._ksp.setPCSide(PETSc.PC.Side.RIGHT)
        self._ksp.setGMRESRestart(60)
        self._ksp.pc.setType(PETSc.PC.Type.PYTHON)
        self._ksp.pc.setPythonContext(self._operator)
        self._ksp.setOperators(self._A)
        self._ksp.setFromOptions()

    @property
    def preconditioner(self) -> PETSc.PC:
        """One cycle on the fixed-stress operator."""
        return self._storage_solver.pc

    def set_preconditioner(self, P: PETSc.Mat) -> None:
        """Take the present fixed-stress operator."""
        self._storage_solver.pc.setOperators(P, P)
        self._storage_solver.pc.setUp()

    def solve(self, du: PETSc.Vec, dp: PETSc.Vec, scale: tuple[float, float], rtol: float) -> int:
        """Solve for (du, dp) with the problems' residuals on the right; return the number of iterations.

        Parameters
        ----------
        scale
            Of the two residuals, N and m^d: what counts as equally large.
        rtol
            Relative to the norm of both residuals, scaled.
        """
        self._operator.scale[:] = scale
        self._operator.join(self._momentum.residual, self._storage.residual, self._b, *(1 / s for s in scale))
        self._ksp.setTolerances(rtol=rtol, atol=0.0, max_it=500)
        self._ksp.solve(self._b, self._x)
        self._operator.part(self._x, du, dp)
        return solved(self._ksp, "momentum and storage")
