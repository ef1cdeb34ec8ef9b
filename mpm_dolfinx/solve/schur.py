# SPDX-License-Identifier: MIT
"""Solvers of the linearised problem, made once for the matrices of an active set.

    [ K  -B^T ] [du]     [R_u]
    [ B   C   ] [dp] = - [R_p]

du is eliminated: S = C + B K^-1 B^T is solved with by conjugate gradients (or FGMRES), preconditioned with the
fixed-stress operator.  Of large bodies both are solved for at once, see `monolithic`.

PETSc's PCFIELDSPLIT with the same two solvers (full Schur factorisation) takes as many iterations, ends with the same
digits, and takes 0.8 to 1 of the time of a solve.  It wants a copy of -B^T at each tangent, and fixed-stress iterations
would still need the parts.
"""

from __future__ import annotations

from collections.abc import Callable
from weakref import finalize

from petsc4py import PETSc

import numpy as np
from dolfinx.common import Timer
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.flow.storage import FILTER, FluxSlope, StorageProblem, StorageSystem
from mpm_dolfinx.mechanics.momentum import MomentumProblem, MomentumSystem
from mpm_dolfinx.points.parts import OfParts
from mpm_dolfinx.solve.linear import (
    by_mumps,
    direct_solver,
    factorise,
    iterative,
    nodal_solver,
    solved,
)
from mpm_dolfinx.solve.monolithic import RESTART, BlockSolver, factorisable
from mpm_dolfinx.solve.multigrid import multigrid_solver
from mpm_dolfinx.solve.scheme import Scheme

WORN = 25
"""Iterations of a solve after which the next tangent has factors of its own fixed-stress operator.

Before, those of the first tangent of the step serve: a footing on 41 cells spends a tenth of its time on the others.
"""


class SchurComplement:
    """Matrix-free S = C + B K^-1 B^T for PETSc's Krylov solvers."""

    def __init__(self, storage: StorageSystem, solve_momentum: PETSc.KSP):
        self.storage, self.solve = storage, solve_momentum
        self.f, self.v = storage.B.createVecRight(), storage.B.createVecRight()
        self.slope: list[FluxSlope] = []

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply."""
        s = self.storage
        s.B_momentum.multTranspose(x, self.f)
        self.solve.solve(self.f, self.v)
        s.lost(self.v, y, *self.slope)
        s.C.multAdd(x, y, y)


class LinearSolvers:
    """Solvers for the matrices of one active set, complete when made.

    Parameters
    ----------
    scheme
        How the two problems are coupled.
    momentum, storage
        Matrices and vectors; storage is None without fluid.
    symmetric
        Whether the momentum's tangent is symmetric.
    """

    def __init__(
        self,
        scheme: Scheme,
        momentum: MomentumSystem,
        storage: StorageSystem | None,
        symmetric: bool,
    ):
        self.scheme, self._momentum, self._storage, self.symmetric = scheme, momentum, storage, symmetric
        at_once = storage is not None and not scheme.richardson
        self.iterative = iterative(momentum.unknowns, at_once, momentum.firm is not None)
        """Whether a multigrid cycle stands for K^-1, not factors."""
        self.tangent: Latest[bool] = Latest()
        """What the matrices hold the tangent of, where it is kept."""
        self._solve_s = self._schur = self._block = None
        self._operator: Latest[bool] = Latest()  # the fixed-stress operator that has been factorised
        if self.iterative:
            firmly = momentum.locks and not (at_once and factorisable(momentum.unknowns))
            self.solve_u = multigrid_solver(momentum.K, "momentum", *momentum.places(), nodal=True, firmly=firmly)
        elif storage is None:
            self.solve_u = direct_solver(momentum.K, "momentum", symmetric)
        else:
            self.solve_u = nodal_solver(momentum.K, "momentum", momentum.unknowns, symmetric)
        self.du, self._rhs = momentum.unknowns.vector(), momentum.unknowns.vector()
        """Direction of the displacements."""
        if storage is None:
            return
        self.dp, self._g = storage.unknowns.vector(), storage.unknowns.vector()
        """Direction of the pressures."""
        if self.iterative and at_once:
            self._solve_s = multigrid_solver(storage.P, "storage", *storage.places(), nodal=False)
            self._block = BlockSolver(momentum, storage, self.solve_u.pc, self._solve_s.pc, symmetric)
            return
        n, self._context = (storage.unknowns.size, None), SchurComplement(storage, self.solve_u)
        finalize(self, vars(self._context).clear)  # PETSc keeps contexts of its matrices, and what they refer to
        self._schur = PETSc.Mat().createPython((n, n), self._context, storage.unknowns.comm)
        self._schur.setUp()
        large = by_mumps(momentum.unknowns, symmetric)
        self._solve_s = direct_solver(storage.P, "storage", often=not large, package="mumps" if large else None)
        krylov = PETSc.KSP.Type.CG if symmetric else PETSc.KSP.Type.FGMRES
        kind = {"schur-cg": krylov, "schur-fgmres": PETSc.KSP.Type.FGMRES}
        self._krylov = kind.get(scheme.coupling, PETSc.KSP.Type.PREONLY)
        self._solve_s.setType(self._krylov)
        self._solve_s.setGMRESRestart(RESTART)

    def begin(self) -> None:
        """Begin a step, which depends on no factors of the one before."""
        self._operator.clear()
        if self._block is not None:
            self._block.begin()

    @property
    def schur(self) -> tuple[PETSc.Mat, PETSc.KSP]:
        """The Schur complement, and the solver with its preconditioner; ValueError where there is none."""
        if self._schur is None:
            raise ValueError("solvers: multigrid solves for displacements and pressures at once, must be factors")
        return self._schur, self._solve_s

    def linearise(
        self,
        momentum: MomentumProblem,
        storage: StorageProblem | None,
        data=None,
        firmness: NDArray[np.float64] | float = 0.0,
    ) -> bool:
        """Set the tangents at (u, p), of the problems' pieces or of others, and factorise them.

        firmness: share of the elastic shear stiffness that is added, one number or one for each part.
        """
        with Timer("mpm: tangent"):
            K = momentum.assemble_tangent(data, firmness)
            if storage is not None:
                storage.assemble_tangent(data and data.pieces)
        with Timer("mpm: factorisation"):
            if self._block is None or not self._block.factorised:
                self.solve_u.setOperators(K)
                self.solve_u.setUp()
            if self._block is not None:
                storage.assemble_preconditioner(self.scheme.beta, FILTER)
                self._block.linearise()
            elif storage is not None:
                self._operator((), lambda: self._set_operator(storage))
                factorise(self.solve_u.pc, self._solve_s.pc)
                if self.scheme.richardson or data is not None:  # what a resumed run may not have any more
                    self._operator.clear()
        return True

    def _set_operator(self, storage: StorageProblem) -> bool:
        """Take the present fixed-stress operator, which is then to be factorised."""
        share = 0.0 if self.scheme.richardson else FILTER
        self._solve_s.setOperators(self._schur, storage.assemble_preconditioner(self.scheme.beta, share))
        self._solve_s.setUp()
        return True

    def solve(
        self,
        rtol: float,
        forces: NDArray[np.float64],
        exchanged: NDArray[np.float64] | None = None,
        slope: FluxSlope | None = None,
    ) -> int:
        """Solve for (du, dp) with the present residuals; return the coupling iterations.

        Parameters
        ----------
        rtol
            Relative accuracy of each part.
        forces, exchanged : (parts,)
            What the residuals are measured by: forces, N, and fluid that changes places, m^d.
        slope
            What the fluxes gain by displacements; without, the tangent leaves that out.
        """
        residual = self._momentum.residual
        if self._storage is None:
            self.solve_u.setTolerances(rtol=rtol, atol=0.0, max_it=500)
            self.solve_momentum()
            count = solved(self.solve_u, "momentum")
            return count if self.iterative else 0
        if self._block is not None:
            r = self._storage.residual  # scales of Euclidean norms that make them the errors
            of = self._storage.of_parts
            size, total = of.norms(r.array_r), of.sums(np.abs(r.array_r))
            share = np.divide(size, total, out=np.ones(of.count), where=total > 0)
            scales = np.where(forces > 0, forces, 1.0), np.where(exchanged > 0, exchanged, 1.0) * share
            return self._block.solve(self.du, self.dp, scales, rtol, slope)
        krylov = self._krylov if slope is None else PETSc.KSP.Type.FGMRES
        self._context.slope[:] = [] if slope is None else [slope]
        if self._solve_s.getType() != krylov:
            self._solve_s.setType(krylov)
            self._solve_s.setGMRESRestart(RESTART)
        g = self.condense()
        self._solve_s.setTolerances(rtol=rtol, atol=0.0, max_it=500)
        measured = self._solve_s.pc.apply if krylov == PETSc.KSP.Type.CG else None  # which takes preconditioned norms
        self._evenly(self._solve_s, g, self.dp, self._storage.of_parts, measured)
        self._storage.B_momentum.multTranspose(self.dp, self._rhs)
        self._rhs.axpy(1.0, residual)
        self.solve_u.solve(self._rhs, self.du)
        count = solved(self._solve_s, "storage")
        if count > WORN:
            self._operator.clear()
        return count

    @staticmethod
    def _evenly(
        ksp: PETSc.KSP,
        b: PETSc.Vec,
        x: PETSc.Vec,
        of: OfParts,
        measured: Callable[[PETSc.Vec, PETSc.Vec], None] | None = None,
    ) -> None:
        """Solve for x iteratively, so that all parts are as accurate: nothing couples them, so each may have a scale.

        measured: makes of the right-hand side b what the solver takes the norm of; None: b itself.
        """
        if of.count <= 1:
            ksp.solve(b, x)
            return
        if measured is not None:
            measured(b, x)
        size = of.norms((b if measured is None else x).array_r)
        scale = np.where((size > 0) & (size < np.inf), size, 1.0)[of.of]
        b.array_w[:] /= scale
        ksp.solve(b, x)
        b.array_w[:] *= scale
        x.array_w[:] *= scale

    def turn_round(self, parts: NDArray[np.bool_] | None = None) -> None:
        """Turn the direction round, of all parts or of some (parts,)."""
        directions = [(self.du, self._momentum)] + ([(self.dp, self._storage)] if self._storage is not None else [])
        for direction, system in directions:
            if parts is None or parts.all():
                direction.scale(-1.0)
            else:
                direction.array_w[:] *= np.where(parts, -1.0, 1.0)[system.of_parts.of]

    def condense(self) -> PETSc.Vec:
        """Return the residual of the Schur complement's system, R_p - B K^-1 R_u."""
        self.solve_u.solve(self._momentum.residual, self.du)
        self._storage.lost(self.du, self._g, *self._context.slope)
        self._g.aypx(-1.0, self._storage.residual)
        return self._g

    def filtered(self, volumes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures, Pa, that the fixed-stress operator makes of fluid volumes of the owned cells, m^d."""
        self._g.array_w[:] = volumes
        self._solve_s.pc.apply(self._g, self.dp)
        return self.dp.array_r

    def solve_momentum(self) -> None:
        """Solve for du alone, pressures kept."""
        if self._storage is not None:
            self.dp.set(0.0)
        if self.iterative:
            self._evenly(self.solve_u, self._momentum.residual, self.du, self._momentum.of_parts)
        else:
            self.solve_u.solve(self._momentum.residual, self.du)

    def solve_storage(self) -> PETSc.Vec:
        """Return dp, solved for at fixed stress."""
        self._solve_s.solve(self._storage.residual, self.dp)
        return self.dp
