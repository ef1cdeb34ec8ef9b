# SPDX-License-Identifier: MIT
"""The coupler: momentum and storage exchange u and p until both balance.

A Newton step of the two problems reads

    [ K  -B^T ] [du]     [R_u]
    [ B   C   ] [dp] = - [R_p].

`schur-cg` eliminates du and solves with S = C + B K^-1 B^T by conjugate gradients, preconditioned
with the fixed-stress operator C + beta V (beta = 0.75 alpha^2 / K_dr), filtered: less beta V for pressures
that alternate from cell to cell (`Storage.assemble_preconditioner`).  These are the paper's two separate
solvers, accelerated.  `schur-fgmres` does the same with the full, slightly unsymmetric Jacobian.
`fixed-stress` is the paper's Richardson iteration: a storage solve with C + beta V at frozen stress,
then a momentum solve, in turn.  Large bodies in 3D, of which factors of K cost too much, are solved by
iterations: `schur-...` then solve both problems at once, see `block`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from petsc4py import PETSc

import numpy as np
from dolfinx.common import Timer

from mpm_dolfinx.solve.monolithic import BlockSolver
from mpm_dolfinx.validation import numbers
from mpm_dolfinx.problems.momentum import Momentum
from mpm_dolfinx.solve.linear import direct_solver, iterative, multigrid_solver, negative_pivots, nodal_solver
from mpm_dolfinx.problems.storage import FILTER, Storage

COUPLINGS = {
    "schur-cg": 0.75,
    "schur-fgmres": 0.75,
    "fixed-stress": 0.75,
    "fixed-stress-full": 1.0,
    "fixed-stress-paper": None,
}
"""Coupling schemes and the multiple of alpha^2/K_dr that they take as beta; None: 1/K_w, as printed in the paper."""

KEEP = 0.05  # the tangent is kept while a Newton step reduces the residual to less than this
FORCING = 1e-3  # relative accuracy of the linear solve
EXPLODES = 1e4  # a bending body's residual may grow this much in a good step: rotations stretch at first order
INNER = 1e-3  # the momentum is solved to this share of the storage's error: rotations fake volume changes
MOMENTUM_STEPS = 10


class NotConverged(RuntimeError):
    """A step's equations could not be solved; `history` lists (momentum, storage) relative residuals."""

    def __init__(self, reason: str, history: list[tuple[float, float]]):
        finite = [h for h in history if np.isfinite(h).all()]
        worst = "momentum" if not finite or finite[-1][0] >= finite[-1][1] else "storage"
        shown = ", ".join(f"({u:.1e}, {p:.1e})" for u, p in finite[-4:])
        super().__init__(reason + (f"; worst in {worst}; last residuals (momentum, storage): {shown}" if shown else ""))
        self.reason, self.field, self.history = reason, worst, history


@dataclass
class Report:
    """What a converged step took: Newton and coupling iterations, relative residuals, fluid balance, and mending."""

    newton: int = 0
    coupling: int = 0
    history: list[tuple[float, float]] = field(default_factory=list)
    balance: float = 0.0
    rederived: int = 0
    """Domains that had folded and were re-derived from F."""


class SchurComplement:
    """Matrix-free S = C + B K^-1 B^T for PETSc's Krylov solvers."""

    def __init__(self, storage: Storage, solve_momentum: PETSc.KSP):
        self.storage, self.solve = storage, solve_momentum
        self.f = storage.B.createVecRight()
        self.v = storage.B.createVecRight()

    def free(self) -> None:
        """Let the problems and the solver go: the matrix refers to this object, which refers to them."""
        self.storage = self.solve = None

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        s = self.storage
        s.B_momentum.multTranspose(x, self.f)
        self.solve.solve(self.f, self.v)
        s.B.mult(self.v, y)
        s.C.multAdd(x, y, y)


class Coupler:
    """Solver of one step of the coupled problem, or of the momentum problem alone.

    Parameters
    ----------
    momentum, storage
        The two problems; storage is None without fluid.
    coupling
        Name in `COUPLINGS`.
    tolerance
        Both residuals fall below this, relative to the forces and to the fluid that changes places.
    max_iterations
        Newton steps, or coupling iterations of `fixed-stress`, before a step is given up.
    """

    def __init__(
        self,
        momentum: Momentum,
        storage: Storage | None,
        coupling: str = "schur-cg",
        tolerance: float = 1e-8,
        max_iterations: int | None = None,
    ):
        numbers("tolerance", tolerance, test=lambda v: (0 < v) & (v < 1), allowed="in (0, 1)")
        self.momentum, self.storage, self.coupling, self.tolerance = momentum, storage, coupling, tolerance
        self.richardson = storage is not None and coupling.startswith("fixed-stress")
        self.max_iterations = max_iterations or (200 if self.richardson else 25)
        self.beta = COUPLINGS[coupling] or 1.0
        self._solve_u = self._solve_s = self._schur = self._block = None

    def set_unknowns(self) -> None:
        """Make the solvers for the present matrices."""
        m = self.momentum
        self._iterative = iterative(m.unknowns)
        self._make_solvers()
        self._du, self._rhs = self.momentum.unknowns.vector(), self.momentum.unknowns.vector()
        if self.storage is None:
            return
        self._dp, self._g = self.storage.unknowns.vector(), self.storage.unknowns.vector()

    def _make_solvers(self) -> None:
        m = self.momentum
        if self._block is not None:
            self._block.free()
        if self._schur is not None:
            self._schur.getPythonContext().free()
        self._tangent_of = self._solve_s = self._schur = self._block = None
        if self._iterative:
            self._solve_u, self._modes = multigrid_solver(m.K, "momentum"), m.unknowns.rigid_body_modes()
        elif self.storage is None:
            self._solve_u = direct_solver(m.K, "momentum", m.symmetric)
        else:
            self._solve_u = nodal_solver(m.K, "momentum", m.unknowns, m.symmetric)

    def forget(self) -> None:
        """Make tangent and multigrid anew in the next step: what follows does not depend on the steps before."""
        self._tangent_of = None
        if self._iterative:
            self._make_solvers()

    def solve(self, dt: float) -> Report:
        """Solve a step from the present (u, p).

        Raises
        ------
        NotConverged
            With the residual history; u and p are then void, the state of the points is untouched.
        """
        report = Report()
        self._scale_u = 0.0
        try:
            if self.richardson:
                self._alternate(dt, report)
            else:
                self._newton(dt, report)
            if report.newton and self.storage is None and self.momentum.symmetric and not self._iterative:
                self._check_stable(dt, report)
        except NotConverged:
            self.forget()
            raise
        if self.storage is not None:
            report.balance = _relative(abs(self.storage.balance(dt)), self._exchanged, self.storage.round_off)
        return report

    def easy(self, report: Report) -> bool:
        """Return whether a step converged in a third of the iterations it may take: the next one may be longer."""
        return 3 * (report.coupling if self.richardson else report.newton) <= self.max_iterations

    def _newton(self, dt: float, report: Report) -> None:
        """Newton's method on both problems at once; the tangent is kept while it serves, of linear laws over steps."""
        errors, fresh = self._errors(dt, report), not (self.momentum.linear and self._kept(dt))
        while max(errors) > self.tolerance:
            self._check(report, report.newton)
            if fresh:
                self._linearise(dt)
            report.coupling += self._direction(dt, max(errors))
            before, errors = errors, self._line_search(dt, errors, report)
            fresh = max(errors) > KEEP * min(1.0, max(before))  # inf where no fluid has moved yet

    def _check_stable(self, dt: float, report: Report) -> None:
        """Refuse an equilibrium that the body leaves at the least disturbance: smaller steps find where it goes.

        Its tangent has negative eigenvalues.  Without water only, which holds a buckling body back for a while.
        Where a step kept its first tangent, it is the next step that finds out.
        """
        if not negative_pivots(self._solve_u):
            return
        self._linearise(dt)  # the last tangent may be that of another state
        if count := negative_pivots(self._solve_u):
            raise NotConverged(
                f"the equilibrium is unstable, its tangent has {count} negative eigenvalues", report.history
            )

    def _kept(self, dt: float) -> bool:
        """Return whether there is a tangent of steps of dt, but for rounding."""
        return self._tangent_of is not None and abs(self._tangent_of - dt) < 1e-9 * dt

    def _alternate(self, dt: float, report: Report) -> None:
        """The paper's iteration: momentum at fixed pressure, then storage at fixed stress, until both balance."""
        errors = self._errors(dt, report)
        self._linearise(dt)
        while max(errors) > self.tolerance:
            self._check(report, report.coupling)
            try:
                self._balance_momentum(dt, errors, report)
            except NotConverged as failed:
                why = "beta is below alpha^2 / (2 K_dr)" if COUPLINGS[self.coupling] is None else "cut the step"
                raise NotConverged(f"the {self.coupling} iteration diverges ({why})", report.history) from failed
            with Timer("mpm: linear solve"):
                self._solve_s.solve(self.storage.residual, self._dp)
            self.storage.unknowns.add(self.storage.p, -1.0, self._dp)
            report.coupling += 1
            errors = self._errors(dt, report)

    def _balance_momentum(self, dt: float, errors: tuple[float, float], report: Report) -> None:
        """Newton's method on the momentum at fixed pressure."""
        self._dp.set(0.0)
        goal = INNER * max(self.tolerance, min(1.0, errors[1]))
        for count in range(MOMENTUM_STEPS):
            if count and errors[0] <= goal:
                return
            with Timer("mpm: linear solve"):
                self._solve_u.solve(self.momentum.residual, self._du)
            before, errors = errors[0], self._line_search(dt, errors, report)
            if errors[0] > max(goal, KEEP * before):
                self._linearise(dt)

    def _check(self, report: Report, count: int) -> None:
        if count >= self.max_iterations:
            raise NotConverged(f"no convergence in {count} iterations", report.history)

    def _errors(self, dt: float, report: Report) -> tuple[float, float]:
        """Assemble both residuals; return and note their norms relative to their scales."""
        with Timer("mpm: residual"):
            r, scale = self.momentum.assemble_residual()
            self._scale_u = max(self._scale_u, scale)
            # a tiny load drowns in the round-off of a stiff part: that is no reason not to solve for it once
            round_off = self.momentum.round_off if report.history else 0.0
            norm, norm_p = r.norm(), 0.0
            errors = [_relative(norm, self._scale_u, round_off), 0.0]
            if self.storage is not None:
                r, self._exchanged = self.storage.assemble_residual(dt)
                norm_p = r.norm(PETSc.NormType.N1)
                errors[1] = _relative(norm_p, self._exchanged, self.storage.round_off)
        if not report.history and np.isnan(norm + norm_p):
            where = "storage: a source" if norm == norm else "momentum: a law or term"
            raise NotConverged(f"nan in the residual of the {where} gives it, must be finite", [])
        report.history.append((errors[0], errors[1]))
        return errors[0], errors[1]

    def _linearise(self, dt: float) -> None:
        self._tangent_of = dt
        with Timer("mpm: tangent"):
            K = self.momentum.assemble_tangent()
            if self.storage is not None:
                self.storage.assemble_tangent(dt)
        with Timer("mpm: factorisation"):
            if self._iterative:
                K.setNearNullSpace(self._modes)
            self._solve_u.setOperators(K)
            self._solve_u.setUp()
            if self.storage is not None:
                P = self.storage.assemble_preconditioner(self.beta, 0.0 if self.richardson else FILTER)
                if self._iterative and not self.richardson:
                    self._block = self._block or BlockSolver(self.momentum, self.storage, self._solve_u.pc)
                    self._block.set_preconditioner(P)
                    return
                if self._schur is None:
                    self._make_schur()
                self._solve_s.setOperators(self._schur, P)
                self._solve_s.setUp()

    def _make_schur(self) -> None:
        """Make the Krylov solver on the Schur complement; Richardson's needs only its preconditioner."""
        n = (self.storage.unknowns.size, None)
        context = SchurComplement(self.storage, self._solve_u)
        self._schur = PETSc.Mat().createPython((n, n), context, comm=self.storage.unknowns.comm)
        self._schur.setUp()
        self._solve_s = direct_solver(self.storage.P, "storage", often=True)
        kind = {"schur-cg": PETSc.KSP.Type.CG, "schur-fgmres": PETSc.KSP.Type.FGMRES}
        self._solve_s.setType(kind.get(self.coupling, PETSc.KSP.Type.PREONLY))

    def _direction(self, dt: float, error: float) -> int:
        """Solve the linearised problem for (du, dp) in place; return the coupling iterations."""
        with Timer("mpm: linear solve"):
            # no more accuracy than the next residual can use
            linear = self.momentum.linear and not self._iterative
            rtol = min(1e-2, max(0.0 if linear else FORCING, 0.05 * self.tolerance / min(1.0, error)))
            if self.storage is None:
                self._solve_u.setTolerances(rtol=rtol, atol=0.0, max_it=500)
                self._solve_u.solve(self.momentum.residual, self._du)
                return self._solve_u.getIterationNumber() if self._iterative else 0
            if self._block is not None:
                return self._block.solve(self._du, self._dp, self._scales(), rtol)
            s, g = self.storage, self._condense()
            self._solve_s.setTolerances(rtol=rtol, atol=0.0, max_it=500)
            self._solve_s.solve(g, self._dp)
            s.B_momentum.multTranspose(self._dp, self._rhs)
            self._rhs.axpy(1.0, self.momentum.residual)
            self._solve_u.solve(self._rhs, self._du)
            return self._solve_s.getIterationNumber()

    def _scales(self) -> tuple[float, float]:
        """Return the scales of the residuals' Euclidean norms that make them the errors."""
        r = self.storage.residual
        size, total = r.norm(), r.norm(PETSc.NormType.N1)
        return self._scale_u or 1.0, (self._exchanged or 1.0) * (size / total if total > 0 else 1.0)

    def _condense(self) -> PETSc.Vec:
        """Return the residual of the Schur complement's system, R_p - B K^-1 R_u."""
        self._solve_u.solve(self.momentum.residual, self._du)
        self.storage.B.mult(self._du, self._g)
        self._g.aypx(-1.0, self.storage.residual)
        return self._g

    def _line_search(self, dt: float, before: tuple[float, float], report: Report) -> tuple[float, float]:
        """Go against the direction, backtracking while the residual is not finite or explodes."""
        report.newton += 1
        step, moved = 1.0, 0.0
        while True:
            self._move(moved - step)
            moved = step
            errors = self._errors(dt, report)
            if np.isfinite(errors).all() and max(errors) < EXPLODES * max(before):
                return errors
            step /= 2
            if step < 1e-3:
                raise NotConverged("no descent along the Newton direction", report.history)

    def _move(self, scale: float) -> None:
        self.momentum.unknowns.add(self.momentum.u, scale, self._du)
        if self.storage is not None:
            self.storage.unknowns.add(self.storage.p, scale, self._dp)


def _relative(norm: float, scale: float, round_off: float) -> float:
    """Return norm / scale; 0 where the norm is round-off, never nan, which no comparison would notice."""
    if norm <= round_off:
        return 0.0
    return norm / scale if scale > 0 and norm < np.inf else np.inf
