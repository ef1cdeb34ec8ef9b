# SPDX-License-Identifier: MIT
"""Solvers of the linearised problem for one set of active cells.

    [ K  -B^T ] [du]     [R_u]
    [ B   C   ] [dp] = - [R_p]

The symbols are defined in `newton`. Elimination of du gives the Schur complement `S = C + B K^-1 B^T`. Systems with S
are solved by conjugate gradients or FGMRES, with the fixed-stress operator as preconditioner. For large bodies, GMRES
solves for both unknowns (`monolithic`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from weakref import finalize

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.flow.storage import FILTER, FluxSlope, StorageProblem, StorageSystem
from mpm_dolfinx.mechanics.momentum import MomentumProblem, MomentumSystem
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.parallel.messages import ConditionWarning, warn
from mpm_dolfinx.points.parts import OfParts, relative
from mpm_dolfinx.solve.factors import MOST, direct_solver, displacement_solver, factorise, renew, solved
from mpm_dolfinx.solve.monolithic import BlockSolver, Inverses
from mpm_dolfinx.solve.multigrid import multigrid_solver
from mpm_dolfinx.solve.petsc_options import using
from mpm_dolfinx.solve.scheme import Scheme
from mpm_dolfinx.solve.solver_choice import AT_ONCE, MULTIGRID, MUMPS, SolverPlan, plan


def planned(scheme: Scheme, momentum: MomentumSystem, storage: StorageSystem | None, symmetric: bool) -> SolverPlan:
    """Return the solver plan for the matrices of the balances.

    `symmetric`: whether K is symmetric.
    """
    unknowns = momentum.unknowns
    return plan(
        unknowns.global_size,
        unknowns.dim,
        wet=storage is not None,
        yields=momentum.elastic_shear is not None,
        locks=momentum.locks,
        symmetric=symmetric,
        processes=unknowns.comm.size,
        coupling=scheme.coupling,
    )


@dataclass(frozen=True, eq=False)
class SchurComplement:
    """Matrix-free Schur complement `S = C + B K^-1 B^T` for PETSc's Krylov solvers.

    `storage`: the matrices B and C.
    `solve`: solver for systems with K.
    `f`, `v`: work vectors for the forces `B^T x` and the displacements `K^-1 f`.
    `slopes`: derivative of the fluxes with respect to displacements, if the tangent includes this derivative.
    """

    storage: StorageSystem
    solve: PETSc.KSP
    f: PETSc.Vec
    v: PETSc.Vec
    slopes: tuple[FluxSlope, ...] = ()

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply x by S."""
        s = self.storage
        s.B_momentum.multTranspose(x, self.f)
        self.solve.solve(self.f, self.v)
        s.B.mult(self.v, y)  # as in `change_by`, without a call of Python in each iteration
        for slope in self.slopes:
            y.array_w[:] += slope(self.v)
        s.C.multAdd(x, y, y)


@dataclass
class Kept:
    """Factors that the tangents of one step share.

    `operator`: whether the factors of the fixed-stress operator can be reused.
    `factors`: direct solvers in place of multigrid, or None.
    """

    operator: bool = False
    factors: Inverses | None = None


class LinearSolvers:
    """Linear solvers for the matrices of one set of active cells.

    `how`: solver plan, see `planned`.
    `scheme`: coupling scheme.
    `momentum`, `storage`: matrices and vectors of the balances. `storage` is None without fluid.
    """

    def __init__(self, how: SolverPlan, scheme: Scheme, momentum: MomentumSystem, storage: StorageSystem | None):
        self.plan = how
        self.scheme = scheme
        self._momentum = momentum
        self._storage = storage
        self.tangent: Latest[bool] = Latest()
        """Cache whose key identifies the present tangent, if several steps use this tangent."""
        self._solve_s = self._schur = self._block = None
        self.du, self._rhs = momentum.unknowns.vector(), momentum.unknowns.vector()
        """`du`: Newton direction of the displacements. `_rhs`: work vector for right-hand sides."""
        self._unread = set(scheme.petsc_options)
        with _compat.Timer("factorisation"), using(scheme.petsc_options, self._unread):
            self.solve_u = self._momentum_solver()
            if storage is None:
                return
            self.dp, self._g = storage.unknowns.vector(), storage.unknowns.vector()
            """`dp`: Newton direction of the pressures. `_g`: work vector for right-hand sides."""
            if how.route == AT_ONCE:
                self._solve_s = multigrid_solver(storage.P, "storage", *storage.places(), False, how.coarsest)
                cycles = self.solve_u.pc, self._solve_s.pc
                self._block = BlockSolver(how, momentum, storage, cycles, self._multigrid())
                return
            work = momentum.unknowns.vector(), momentum.unknowns.vector()
            n, self._context = (storage.unknowns.size, None), SchurComplement(storage, self.solve_u, *work)
            finalize(self, vars(self._context).clear)  # PETSc never frees the contexts of matrices, nor objects in them
            self._schur = PETSc.Mat().createPython((n, n), self._context, storage.unknowns.comm)
            self._schur.setUp()
            mumps = how.pressures == MUMPS
            package = "mumps" if mumps else None
            self._solve_s = direct_solver(storage.P, "storage", storage.symmetric, gathered=not mumps, package=package)
            self._set_krylov(how.krylov)
            self._solve_s.setFromOptions()
            self._krylov = self._solve_s.getType()

    def _momentum_solver(self) -> PETSc.KSP:
        """Return the solver for systems with K."""
        how = self.plan
        if how.displacements == MULTIGRID:
            return self._multigrid()(smoother=how.smoother)
        momentum = self._momentum
        return displacement_solver(momentum.K, "momentum", momentum.unknowns, how.displacements, how.symmetric)

    def _multigrid(self) -> Callable[..., PETSc.KSP]:
        """Return a function that creates multigrid on K with a given smoother."""
        momentum = self._momentum
        given = {"nodal": True, "coarsest": self.plan.coarsest, "lines": momentum.lines}
        return partial(multigrid_solver, momentum.K, "momentum", *momentum.places(), **given)

    def _set_krylov(self, kind: str) -> None:
        """Set the type of the iterative solver for the pressures."""
        if self._solve_s.getType() != kind:
            self._solve_s.setType(kind)
            self._solve_s.setGMRESRestart(MOST)

    @property
    def schur(self) -> tuple[PETSc.Mat, PETSc.KSP]:
        """The Schur complement and its solver. With `monolithic` multigrid, this property raises ValueError."""
        if self._schur is None:
            raise ValueError("solvers: monolithic multigrid has no Schur complement; direct solvers must be used")
        return self._schur, self._solve_s

    def linearise(
        self,
        momentum: MomentumProblem,
        storage: StorageProblem | None,
        kept: Kept | None = None,
        data: QuadratureData | None = None,
        shift: NDArray[np.float64] | float = 0.0,
    ) -> bool:
        """Assemble the tangents at (u, p), and factorise them.

        `kept`: factors that the tangents of the step share, see `Kept`.
        `data`: integration points, by default the points of `momentum` and `storage`.
        `shift`: fraction of the elastic shear stiffness that regularises the tangent; one number, or one for each part.
        """
        kept = kept or Kept()
        with _compat.Timer("tangent"):
            first = not self._momentum.K.assembled
            momentum.assemble_tangent(data, shift)
            if first and not self.plan.symmetric and self.du.comm.size == 1:
                renew(self._momentum.K)
            if storage is not None:
                storage.assemble_tangent(data and data.pieces, momentum.of_suction(data))
        with _compat.Timer("factorisation"), using(self.scheme.petsc_options, self._unread):
            if storage is None:
                self.solve_u.setUp()
            elif self._block is not None:
                storage.assemble_preconditioner(self.scheme.beta, FILTER)
                self._solve_s.pc.setUp()
                if kept.factors is None:
                    self.solve_u.setUp()
            else:
                if not kept.operator:
                    share = 0.0 if self.scheme.richardson else FILTER
                    P = storage.assemble_preconditioner(self.scheme.beta, share)
                    self._solve_s.setOperators(self._schur, P)
                factorise(self.solve_u.pc, self._solve_s.pc)
                # reused within a step only, because a resumed run has no factors of earlier steps
                kept.operator = not self.scheme.richardson and data is None
        if first:
            self._tell_unread()
        return True

    def _tell_unread(self) -> None:
        """Warn of options that no solver has read."""
        if not self.scheme.petsc_options:
            return
        comm = self.du.comm.tompi4py()
        names = sorted(set.intersection(*comm.allgather(self._unread)))
        if names:
            warn(comm, ConditionWarning, "petsc_options: no solver reads %s (%s)", ", ".join(names), self.plan)

    def solve(
        self,
        kept: Kept,
        rtol: float,
        forces: NDArray[np.float64],
        exchanged: NDArray[np.float64] | None = None,
        slope: FluxSlope | None = None,
        goal: float = 0.0,
    ) -> int:
        """Solve for (du, dp) with the present residuals, and return the number of coupling iterations.

        `kept`: factors that the tangents of the step share, see `Kept`.
        `rtol`: relative tolerance, for each connected part.
        `forces`, `exchanged` (parts,): scales of the residuals: forces (N) and exchanged fluid volume (m^d).
        `slope`: derivative of the fluxes with respect to displacements, if the tangent includes it.
        `goal`: with inertia, relative residual of the storage after the solve.  The condensed residual may be larger.
        """
        slopes = () if slope is None else (slope,)
        if self._storage is None:
            self.solve_u.setTolerances(rtol=rtol, atol=0.0, max_it=MOST)
            self.solve_momentum()
            count = solved(self.solve_u, "momentum")
            return count if self.plan.iterative else 0
        if self._block is not None:
            r = self._storage.residual  # scaled so that its Euclidean norm equals the error
            of = self._storage.of_parts
            size, total = of.norms(r.array_r), of.sums(np.abs(r.array_r))
            share = np.divide(size, total, out=np.ones(of.count), where=total > 0)
            scales = np.where(forces > 0, forces, 1.0), np.where(exchanged > 0, exchanged, 1.0) * share
            with using(self.scheme.petsc_options):
                count, kept.factors = self._block.solve(self.du, self.dp, scales, rtol, slopes, kept.factors)
            return count
        symmetric = slope is None and not self._storage.moves
        self._set_krylov(self._krylov if symmetric else PETSc.KSP.Type.FGMRES)
        if slope is not None:
            self._schur.setPythonContext(replace(self._context, slopes=slopes))
        g = self.condense(*slopes)
        if self._storage.moves:
            off = relative(self._storage.of_parts.sums(np.abs(g.array_r)), exchanged).max(initial=0.0)
            rtol = min(rtol, goal / min(1.0, max(off, goal)))
        self._solve_s.setTolerances(rtol=rtol, atol=0.0, max_it=MOST)
        cg = self._solve_s.getType() == PETSc.KSP.Type.CG  # CG uses preconditioned norms
        self._evenly(self._solve_s, g, self.dp, self._storage.of_parts, self._solve_s.pc.apply if cg else None)
        self._schur.setPythonContext(self._context)
        self._follow()
        count = solved(self._solve_s, "storage")
        kept.operator = kept.operator and count <= self.plan.many
        return count

    @staticmethod
    def _evenly(
        ksp: PETSc.KSP,
        b: PETSc.Vec,
        x: PETSc.Vec,
        of: OfParts,
        measured: Callable[[PETSc.Vec, PETSc.Vec], None] | None = None,
    ) -> None:
        """Solve iteratively for x with equal relative accuracy in all connected parts.

        `measured`: function that preconditions b, if the solver uses preconditioned norms.
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

    def restrain(self, storage: StorageProblem, log_change: NDArray[np.float64] | float) -> NDArray[np.float64] | float:
        """Limit the pressure decreases of the Newton direction (see `restrained`), and update the displacements."""
        if not storage.forms.retains:
            return log_change
        dp, log_change = storage.restrained(self.dp.array_r, log_change)
        far = not np.array_equal(dp, self.dp.array_r)
        if self.du.comm.tompi4py().allreduce(far, MPI.LOR):
            self.dp.array_w[:] = dp
            if self._block is None:
                self._follow()
        return log_change

    def _follow(self) -> None:
        """Solve the balance of momentum for the displacements at the pressures of the Newton direction."""
        self._storage.B_momentum.multTranspose(self.dp, self._rhs)
        self._rhs.axpy(1.0, self._momentum.residual)
        self.solve_u.solve(self._rhs, self.du)

    def turn_round(self, parts: NDArray[np.bool_] | None = None) -> None:
        """Reverse the Newton direction in the chosen connected parts, by default in all."""
        directions = [(self.du, self._momentum)] + ([(self.dp, self._storage)] if self._storage is not None else [])
        for direction, system in directions:
            if parts is None or parts.all():
                direction.scale(-1.0)
            else:
                direction.array_w[:] *= np.where(parts, -1.0, 1.0)[system.of_parts.of]

    def condense(self, *slopes: FluxSlope) -> PETSc.Vec:
        """Return the right-hand side `R_p - B K^-1 R_u` of the system with the Schur complement."""
        self.solve_u.solve(self._momentum.residual, self.du)
        self._storage.change_by(self.du, self._g, *slopes)
        self._g.aypx(-1.0, self._storage.residual)
        return self._g

    def filtered(self, volumes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the inverse of the fixed-stress operator to volumes (m^d) of owned cells, and return pressures (Pa)."""
        self._g.array_w[:] = volumes
        self._solve_s.pc.apply(self._g, self.dp)
        return self.dp.array_r

    def solve_momentum(self) -> None:
        """Solve for du at fixed pressure."""
        if self._storage is not None:
            self.dp.set(0.0)
        if self.plan.iterative:
            self._evenly(self.solve_u, self._momentum.residual, self.du, self._momentum.of_parts)
        else:
            self.solve_u.solve(self._momentum.residual, self.du)

    def solve_storage(self) -> PETSc.Vec:
        """Solve for dp at fixed stress, and return dp."""
        self._solve_s.solve(self._storage.residual, self.dp)
        return self.dp
