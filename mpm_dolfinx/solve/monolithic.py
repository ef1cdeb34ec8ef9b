# SPDX-License-Identifier: MIT
"""Both linearised problems at once, where a direct solver is too expensive: large bodies in 3D, larger ones in 2D.

    [ K  -B^T ] [du]   [R_u]
    [ B   C   ] [dp] = [R_p]

The solver is GMRES, preconditioned from the right with the upper block triangle. There the fixed-stress operator P = C
+ beta V approximates the Schur complement C + B K^-1 B^T. One multigrid cycle each approximates K^-1 and P^-1.

In 3D it takes 7 to 12 iterations to 1e-3, each with one cycle on K. Other methods were slower, with algebraic multigrid
and Jacobi smoothing (10 to 15 iterations here). Conjugate gradients on the Schur complement took 3 iterations, but 35
to 60 cycles in their inner solves. Flexible GMRES with inner solves to 0.1 or 0.01 took 12 to 24 cycles. MINRES with
the diagonal blocks took 17 to 23, and left five times the residual. In 2D it takes 8 to 1e-5, 12 with AMG on P.

At nu = 0.499 the cycle is poor: more than 100 iterations with 14^3 cells. A solve that takes many (see `plan`), or is
predicted to, continues with factors of K in place of the cycle. They stay until a solve with them takes as many: for
the other tangents of the step about 10 iterations. A step takes 6.2 s, and 8.5 s with factors of each tangent (then 4
to 6 iterations). Four steps of yielding soil, 12^3 cells, take 33 and 41 s. MUMPS factorises 3190 unknowns in 0.2 s,
8610 in 1.4 s (PETSc in 3.4 s). No solve takes more than 19 then, nor more than 22 at nu = 0.49 with contrasts of 1e3.

In 2D yielding soil would take 20 to 500 (a footing on 41 cells, with any smoother). Shear bands are one cell wide, and
coarse grids cannot represent them. With a viscosity of 0.05 it takes 28. Its time is 0.9 times that of a direct solver
on 41 cells, but 1.7 times on 81. Moving the volumetric stiffness of K to the storage, p -> p + k B u, leaves K as at nu
= 0.3, but alternating pressures become almost free: 500 iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.flow.storage import FluxSlope, StorageSystem
from mpm_dolfinx.mechanics.momentum import MomentumSystem
from mpm_dolfinx.solve.factors import MOST, direct_solver, displacement_solver, factorise, solved
from mpm_dolfinx.solve.solver_choice import SolverPlan

LEAST = 1e-4
"""Smallest scale of the fluid / fluid volume that the residual forces would displace in a drained body.

Sealed bodies exchange nearly no fluid: with scales that differ by 5e5 rounding left 2e-5 of a residual.
"""

IDLE = object()
"""Context between solves: PETSc keeps contexts and all of their references."""
Scale = NDArray[np.float64] | float
Inverses = tuple[PETSc.PC, PETSc.PC]
"""Preconditioners that approximate K^-1 and P^-1."""


@dataclass(frozen=True, eq=False)
class BlockOperator:
    """Operator and preconditioner of one solve for PETSc, with scaled rows.

    Parameters
    ----------
    momentum, storage
        The matrices.
    inverses
        Approximations of K^-1 and P^-1.
    work
        Two displacement vectors and two pressure vectors.
    scale
        Scales of the rows of both problems.
    slopes
        Derivative of the fluxes with respect to displacements, if it is included.
    """

    momentum: MomentumSystem
    storage: StorageSystem
    inverses: Inverses
    work: tuple[PETSc.Vec, ...]
    scale: tuple[Scale, Scale] = (1.0, 1.0)
    slopes: tuple[FluxSlope, ...] = ()

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply by the operator."""
        s, (u, f, p, g) = self.storage, self.work
        self.part(x, u, p)
        s.change_by(u, g, *self.slopes)
        s.C.multAdd(p, g, g)
        s.B_momentum.multTranspose(p, f)
        f.scale(-1.0)
        self.momentum.K.multAdd(u, f, f)
        self.join(f, g, y, *(1 / scale for scale in self.scale))

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner."""
        (u, f, p, g), (on_u, on_p) = self.work, self.inverses
        self.part(x, f, g, *self.scale)
        on_p.apply(g, p)
        self.storage.B_momentum.multTransposeAdd(p, f, f)
        on_u.apply(f, u)
        self.join(u, p, y)

    def displaced(self) -> NDArray[np.float64]:
        """Return (fluid volume displaced by the residual forces) / (their norm) of each part (parts,), m^d/N."""
        forces, (u, _, _, g) = self.momentum.residual, self.work
        self.inverses[0].apply(forces, u)
        self.storage.B.mult(u, g)
        norms = self.momentum.of_parts.norms(forces.array_r)
        displaced = self.storage.of_parts.norms(g.array_r)
        return np.divide(displaced, norms, out=np.zeros(len(norms)), where=norms > 0)

    @staticmethod
    def part(x: PETSc.Vec, u: PETSc.Vec, p: PETSc.Vec, scale_u: Scale = 1.0, scale_p: Scale = 1.0) -> None:
        """Set (u, p) to the scaled parts of x."""
        values = x.array_r
        np.multiply(values[: u.local_size], scale_u, out=u.array_w)
        np.multiply(values[u.local_size :], scale_p, out=p.array_w)

    @staticmethod
    def join(u: PETSc.Vec, p: PETSc.Vec, x: PETSc.Vec, scale_u: Scale = 1.0, scale_p: Scale = 1.0) -> None:
        """Set the parts of x to (u, p), scaled."""
        values = x.array_w
        np.multiply(u.array_r, scale_u, out=values[: u.local_size])
        np.multiply(p.array_r, scale_p, out=values[u.local_size :])


class BlockSolver:
    """GMRES on displacement and pressure together.

    Parameters
    ----------
    how
        The plan.
    momentum, storage
        The matrices.
    cycles
        One multigrid cycle each on K and on P.
    """

    def __init__(self, how: SolverPlan, momentum: MomentumSystem, storage: StorageSystem, cycles: Inverses):
        self._plan = how
        self._momentum = momentum
        self._storage = storage
        self._cycles = cycles
        self._work = tuple(of.unknowns.vector() for of in (momentum, momentum, storage, storage))
        size = (momentum.unknowns.size + storage.unknowns.size, None)
        self._A = PETSc.Mat().createPython((size, size), IDLE, comm=momentum.unknowns.comm)
        self._A.setUp()
        self._x, self._b = self._A.createVecs()
        self._ksp = PETSc.KSP().create(self._A.comm)
        self._ksp.setType(PETSc.KSP.Type.GMRES)
        self._ksp.setOptionsPrefix("mpm_block_")
        self._ksp.setPCSide(PETSc.PC.Side.RIGHT)
        self._ksp.setGMRESRestart(MOST)
        self._ksp.setConvergenceHistory(MOST, reset=True)
        self._ksp.pc.setType(PETSc.PC.Type.PYTHON)
        self._ksp.setOperators(self._A)
        self._ksp.setMonitor(_foresight(how.many))
        self._ksp.setFromOptions()

    def solve(
        self,
        du: PETSc.Vec,
        dp: PETSc.Vec,
        scales: tuple[NDArray, NDArray],
        rtol: float,
        slopes: tuple[FluxSlope, ...] = (),
        factors: Inverses | None = None,
    ) -> tuple[int, Inverses | None]:
        """Solve for (du, dp) with the residuals of both problems on the right side.

        Parameters
        ----------
        scales : (parts,), (parts,)
            Scales of both residuals in each part, N and m^d.
        rtol
            Tolerance relative to the norm of both scaled residuals, in each part.
        slopes
            Derivative of the fluxes with respect to displacements, if it is included.
        factors
            Factors in place of the cycles so far.

        Returns
        -------
        The number of iterations, and the factors that now replace the cycles, or None.
        """
        operator = BlockOperator(self._momentum, self._storage, factors or self._cycles, self._work)
        on_u, on_p = self._momentum.of_parts, self._storage.of_parts
        residuals = self._momentum.residual, self._storage.residual
        scale_u, scale_p = scales
        scale_p = np.maximum(scale_p, LEAST * scale_u * operator.displaced())
        if on_u.count > 1:  # parts are uncoupled: all count equally
            sizes = [of.norms(r.array_r) for of, r in zip((on_u, on_p), residuals, strict=True)]
            size = np.hypot(sizes[0] / scale_u, sizes[1] / scale_p)
            scale_u, scale_p = (scale * np.where(size > 0, size, 1.0) for scale in (scale_u, scale_p))
        scale = scale_u[on_u.of], scale_p[on_p.of]
        operator.join(*residuals, self._b, *(1 / s for s in scale))
        most = self._plan.many if self._plan.fallback else MOST
        count = self._iterate(operator.inverses, scale, slopes, rtol, most)
        if self._plan.fallback and self._ksp.getConvergedReason() < 0:
            with _compat.Timer("factorisation"):
                factors = self._factorised()
            self._ksp.setInitialGuessNonzero(True)
            count += self._iterate(factors, scale, slopes, rtol, MOST)
            self._ksp.setInitialGuessNonzero(False)
        operator.part(self._x, du, dp)
        return count, factors

    def _iterate(self, inverses: Inverses, scale: tuple, slopes: tuple, rtol: float, most: int) -> int:
        """Solve with these approximations of K^-1 and P^-1; return the iterations, at most `most`."""
        operator = BlockOperator(self._momentum, self._storage, inverses, self._work, scale, slopes)
        self._A.setPythonContext(operator)
        self._ksp.pc.setPythonContext(operator)
        self._ksp.setTolerances(rtol=rtol, atol=0.0, max_it=most)
        self._ksp.solve(self._b, self._x)
        self._A.setPythonContext(IDLE)
        self._ksp.pc.setPythonContext(IDLE)
        return solved(self._ksp, "momentum and storage")

    def _factorised(self) -> Inverses:
        """Return preconditioners with factors of the present K, and in 2D of the present P, which may change later."""
        K, unknowns = self._momentum.K, self._momentum.unknowns
        solvers = [displacement_solver(K, "factors", unknowns, self._plan.fallback, self._plan.symmetric)]
        if unknowns.dim == 2:
            solvers.append(direct_solver(self._storage.P, "storage_factors", gathered=self._plan.gathered))
        found = [ksp.pc for ksp in solvers]
        factorise(*found)
        for pc in found:
            pc.setReusePreconditioner(True)
        return found[0], found[1] if found[1:] else self._cycles[1]


def _foresight(many: int) -> Callable[[PETSc.KSP, int, float], None]:
    """Return a monitor that stops `many` iterations if the rate of the last quarter of them is too slow."""
    quarter = max(1, many // 4)

    def monitor(ksp: PETSc.KSP, count: int, norm: float) -> None:
        rtol, _, _, most = ksp.getTolerances()
        if most != many or not count or count % quarter:
            return
        norms = ksp.getConvergenceHistory()
        if norm * (norm / norms[count - quarter]) ** ((many - count) / quarter) > rtol * norms[0]:
            ksp.setTolerances(max_it=count)

    return monitor
