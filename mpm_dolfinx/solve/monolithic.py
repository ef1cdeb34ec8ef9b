# SPDX-License-Identifier: MIT
"""Solver for both balances together, for large bodies.

    [ K  -B^T ] [du]     [R_u]
    [ B   C   ] [dp] = - [R_p]

K is the stiffness, C the storage and B the coupling of the balances (`newton`).  The solver is GMRES.  Its right
preconditioner is the upper block triangle, with the fixed-stress operator `P = C + beta V` in place of the Schur
complement `C + B K^-1 B^T`.  Here beta is the fixed-stress coefficient, and V contains the cell volumes.  One multigrid
cycle approximates K^-1, and another cycle P^-1.

In 3D, GMRES takes 7 to 12 iterations to the tolerance 1e-3, each with one cycle on K.  In 2D, GMRES takes 8 iterations
to the tolerance 1e-5.  With algebraic multigrid, GMRES takes 10 to 15 cycles in 3D.  MINRES with diagonal blocks takes
17 to 23 cycles, and conjugate gradients on the Schur complement 35 to 60 cycles.

At nu = 0.499 with 14^3 cells, GMRES takes more than 100 iterations.  If a solve takes too many iterations, factors of K
replace the multigrid cycle.  In large 3D bodies that may yield, multigrid with sweeps (`SMOOTHERS`) replaces the cycle.
In yielding soil in 2D, GMRES with multigrid would take 20 to 500 iterations: coarse grids cannot represent shear bands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.flow.storage import FluxSlope, StorageSystem
from mpm_dolfinx.mechanics.momentum import MomentumSystem
from mpm_dolfinx.solve.factors import MOST, direct_solver, displacement_solver, factorise, solved
from mpm_dolfinx.solve.solver_choice import MUMPS, SWEEPS, THREE_SWEEPS, SolverPlan

LEAST = 1e-4
"""Smallest scale of the fluid residual, divided by the fluid volume that residual forces displace in a drained body.

With 2e-6 in place of this value, rounding errors would cause a relative residual of 2e-5 in undrained bodies.
"""

IDLE = object()
"""Placeholder for the operator in PETSc between solves, to free memory."""
Scale = NDArray[np.float64] | float
Inverses = tuple[PETSc.PC, PETSc.PC]
"""Preconditioners that approximate K^-1 and P^-1."""


@dataclass(frozen=True, eq=False)
class BlockOperator:
    """Operator and preconditioner of one solve, with scaled equations.

    `inverses`: approximations of K^-1 and P^-1.
    `work`: work vectors: two of displacements and two of pressures.
    `scale`: scales of the equations of both balances.
    `slopes`: derivative of the fluxes with respect to displacements, if the tangent includes it.
    """

    momentum: MomentumSystem
    storage: StorageSystem
    inverses: Inverses
    work: tuple[PETSc.Vec, ...]
    scale: tuple[Scale, Scale] = (1.0, 1.0)
    slopes: tuple[FluxSlope, ...] = ()

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply x by the operator."""
        s, (u, f, p, g) = self.storage, self.work
        self.part(x, u, p)
        s.change_by(u, g, *self.slopes)
        s.C.multAdd(p, g, g)
        s.B_momentum.multTranspose(p, f)
        f.scale(-1.0)
        self.momentum.K.multAdd(u, f, f)
        self.join(f, g, y, *(1 / scale for scale in self.scale))

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner to x."""
        (u, f, p, g), (on_u, on_p) = self.work, self.inverses
        self.part(x, f, g, *self.scale)
        on_p.apply(g, p)
        self.storage.B_momentum.multTransposeAdd(p, f, f)
        on_u.apply(f, u)
        self.join(u, p, y)

    def displaced(self) -> NDArray[np.float64]:
        """Return the fluid volumes (parts,) that residual forces displace, divided by the forces, in m^d/N."""
        forces, (u, _, _, g) = self.momentum.residual, self.work
        self.inverses[0].apply(forces, u)
        self.storage.B.mult(u, g)
        norms = self.momentum.of_parts.norms(forces.array_r)
        displaced = self.storage.of_parts.norms(g.array_r)
        return np.divide(displaced, norms, out=np.zeros(len(norms)), where=norms > 0)

    @staticmethod
    def part(x: PETSc.Vec, u: PETSc.Vec, p: PETSc.Vec, scale_u: Scale = 1.0, scale_p: Scale = 1.0) -> None:
        """Split x into displacements u and pressures p, multiplied by their scales."""
        values = x.array_r
        np.multiply(values[: u.local_size], scale_u, out=u.array_w)
        np.multiply(values[u.local_size :], scale_p, out=p.array_w)

    @staticmethod
    def join(u: PETSc.Vec, p: PETSc.Vec, x: PETSc.Vec, scale_u: Scale = 1.0, scale_p: Scale = 1.0) -> None:
        """Set x to the displacements u and the pressures p, multiplied by their scales."""
        values = x.array_w
        np.multiply(u.array_r, scale_u, out=values[: u.local_size])
        np.multiply(p.array_r, scale_p, out=values[u.local_size :])


class BlockSolver:
    """GMRES for displacements and pressures together.

    `how`: solver plan.
    `momentum`, `storage`: the matrices.
    `cycles`: two preconditioners, a multigrid cycle on K and a multigrid cycle on P.
    `multigrid`: function that creates multigrid on K with a given smoother.
    """

    def __init__(
        self,
        how: SolverPlan,
        momentum: MomentumSystem,
        storage: StorageSystem,
        cycles: Inverses,
        multigrid: Callable[..., PETSc.KSP],
    ):
        self._multigrid = multigrid
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
        self._foresight = Foresight(max(1, how.many // 4))
        self._ksp.setMonitor(self._foresight)
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
        """Solve for (du, dp) with the residuals of both balances as right-hand side.

        `scales`: two arrays (parts,): scales of the momentum residual (N) and of the fluid residual (m^d).
        `rtol`: tolerance relative to the norm of both scaled residuals, for each connected part.
        `slopes`: derivative of the fluxes with respect to displacements, if the tangent includes it.
        `factors`: factors from an earlier solve that replace multigrid cycles, or None.

        Returns
        -------
        The number of iterations, and the factors for later solves, or None.
        """
        given = du, dp, scales, rtol, slopes
        cycles = self._plan.fallback == SWEEPS
        replaceable = bool(self._plan.fallback) and not (factors and cycles)
        self._foresight.active = replaceable and not cycles
        count = self._iterate(factors or self._cycles, *given, self._plan.many if replaceable else MOST)
        self._foresight.active = False
        if replaceable and self._ksp.getConvergedReason() < 0:
            with _compat.Timer("factorisation"):
                factors = self._factorised()
            count += self._iterate(factors, *given, MOST)
        return count, factors

    def _iterate(
        self,
        inverses: Inverses,
        du: PETSc.Vec,
        dp: PETSc.Vec,
        scales: tuple[NDArray, NDArray],
        rtol: float,
        slopes: tuple[FluxSlope, ...],
        most: int,
    ) -> int:
        """Solve with approximations of K^-1 and P^-1, and return the number of iterations, at most `most`."""
        operator = BlockOperator(self._momentum, self._storage, inverses, self._work)
        on_u, on_p = self._momentum.of_parts, self._storage.of_parts
        residuals = self._momentum.residual, self._storage.residual
        scale_u, scale_p = scales
        scale_p = np.maximum(scale_p, LEAST * scale_u * operator.displaced())
        if on_u.count > 1:  # the residuals of the uncoupled parts are scaled to equal size
            sizes = [of.norms(r.array_r) for of, r in zip((on_u, on_p), residuals, strict=True)]
            size = np.hypot(sizes[0] / scale_u, sizes[1] / scale_p)
            scale_u, scale_p = (scale * np.where(size > 0, size, 1.0) for scale in (scale_u, scale_p))
        scale = scale_u[on_u.of], scale_p[on_p.of]
        operator.join(*residuals, self._b, *(1 / s for s in scale))
        operator = replace(operator, scale=scale, slopes=slopes)
        self._A.setPythonContext(operator)
        self._ksp.pc.setPythonContext(operator)
        self._ksp.setTolerances(rtol=rtol, atol=0.0, max_it=most)
        self._ksp.solve(self._b, self._x)
        self._A.setPythonContext(IDLE)
        self._ksp.pc.setPythonContext(IDLE)
        operator.part(self._x, du, dp)
        return solved(self._ksp, "momentum and storage")

    def _factorised(self) -> Inverses:
        """Return preconditioners that later tangents reuse: factors of K (in 2D also P), or multigrid with sweeps."""
        K, unknowns = self._momentum.K, self._momentum.unknowns
        if self._plan.fallback == SWEEPS:
            return self._multigrid(smoother=THREE_SWEEPS).pc, self._cycles[1]
        solvers = [displacement_solver(K, "factors", unknowns, self._plan.fallback, self._plan.symmetric)]
        if unknowns.dim == 2:
            solvers.append(direct_solver(self._storage.P, "storage_factors", gathered=self._plan.fallback != MUMPS))
        found = [ksp.pc for ksp in solvers]
        factorise(*found)
        for pc in found:
            pc.setReusePreconditioner(True)
        return found[0], found[1] if found[1:] else self._cycles[1]


class Foresight:
    """Monitor that ends a solve early if the allowed number of iterations would not suffice.

    `interval`: number of iterations between two predictions.
    """

    def __init__(self, interval: int):
        self._interval = interval
        self.active = False
        """Whether another solver can replace the present one."""

    def __call__(self, ksp: PETSc.KSP, count: int, norm: float) -> None:
        """End the solve if the residual, extrapolated to the last allowed iteration, exceeds the tolerance."""
        rtol, _, _, most = ksp.getTolerances()
        if not self.active or not count or count % self._interval:
            return
        norms = ksp.getConvergenceHistory()
        if norm * (norm / norms[count - self._interval]) ** ((most - count) / self._interval) > rtol * norms[0]:
            ksp.setTolerances(max_it=count)
