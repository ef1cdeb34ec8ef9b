# SPDX-License-Identifier: MIT
"""A substep's equations: momentum and storage exchange u and p until both balance.

A Newton step of the two problems reads

    [ K  -B^T ] [du]     [R_u]
    [ B   C   ] [dp] = - [R_p].

`schur-cg` eliminates du and solves with S = C + B K^-1 B^T by conjugate gradients, preconditioned
with the fixed-stress operator C + beta V (beta = 0.75 alpha^2 / K_dr), filtered: less beta V for pressures
that alternate from cell to cell (`StorageProblem.assemble_preconditioner`).  These are two separate
solvers, accelerated.  `schur-fgmres` does the same with the full, slightly unsymmetric Jacobian.
`fixed-stress` is the Richardson iteration of the fixed-stress split: a storage solve with C + beta V at frozen stress,
then a momentum solve, in turn.  Large bodies, of which factors of K cost too much, are solved by multigrid:
`schur-...` then solve both problems at once, see `monolithic`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
from dolfinx.common import Timer
from numpy.typing import NDArray

from mpm_dolfinx.errors import NotConverged
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.problems.momentum import MomentumProblem
from mpm_dolfinx.problems.quadrature_data import QuadratureData
from mpm_dolfinx.problems.storage import Rates, StorageProblem, StorageResidual
from mpm_dolfinx.result import Report
from mpm_dolfinx.solve.linear import negative_pivots
from mpm_dolfinx.solve.schur import LinearSolvers
from mpm_dolfinx.solve.watchdog import EXPLODES, LARGEST, SHORTEST_DESCENT, Search, Watchdog, shortened

KEEP, KEEP_WET = 0.05, 0.01
"""The tangent is kept while a Newton step reduces the residual to less than this: the second in 2D, wet and elastic.

The seed beam in 26 steps by error: 205 steps and 79 tangents with 0.05, 179 and 83 with 0.01, 174 and 94 with 0.002.
In 3D, where tangents cost more, a beam takes up to a fifth longer with 0.01 than with 0.05.
"""
FORCING_IN_3D, FORCING, FINEST = 1e-3, 1e-5, 1e-9
"""Relative accuracy of linear solves by multigrid in 3D and of others, and the best that is asked for.

With factors an iteration is cheap, and what a solve leaves of the fluid's residual costs a Newton step: a step of a
block of 10 x 10 cells that drains takes 4.6 of them for 6.1 with 1e-3, in 0.86 of the time, the seed beam 383 for 408,
a footing on 21 cells (backward Euler) 299 for 370.
"""
SHORTEST = 1e-3  # share of a Newton step below which it is not shortened
INNER = 1e-3  # the momentum is solved to this share of the storage's error: rotations fake volume changes
MOMENTUM_STEPS = 10
REBALANCED = 6  # times the most iterations, in all, of what is to balance with other pressures or pairs of contacts
SETTLED = 1e-2  # residual from which on what slips on tools may stick: before, what touches them still changes
ERROR = 1 / 20
"""Share of the estimate of first order that the pressures of a run are off by: of consolidations, see tests."""
SUDDEN = np.sqrt(2)
"""Change in the second substep over that in the first below which pressures decay so fast that sdirk2 overshoots.

The stability function (1 + (1 - 2 gamma) z) / (1 - gamma z)^2 changes its sign at z = -1 - sqrt(2), where the
changes are -gamma z / (1 - gamma z) = sqrt(2) - 1 and 2 - sqrt(2).  What follows the loads has (1 - gamma) / gamma.
"""


@dataclass(frozen=True)
class Errors:
    """Relative residuals of momentum and storage; forces: what the first is measured by, N; fluid: the other residual.

    start: forces at the start of the step, N; scales: forces, N, and fluid that changes places, m^d, that counts: no
    less than what makes round-off the tolerance.
    """

    u: float
    p: float
    scales: tuple[float, float]
    forces: float
    start: float
    fluid: StorageResidual | None

    @property
    def worst(self) -> float:
        """The larger one."""
        return max(self.u, self.p)


def solve_substep(
    solvers: LinearSolvers,
    momentum: MomentumProblem,
    storage: StorageProblem | None,
    as_reset: Callable[[], QuadratureData],
    key: Hashable,
    report: Report,
) -> Rates | None:
    """Solve the equations of a substep for (u, p), which the forms then hold; return the rates of the storage.

    Parameters
    ----------
    solvers
        Of the active set.
    momentum, storage
        The problems; storage is None without fluid.
    as_reset, key
        Returns the pieces when the grid was reset, and sets the pressures of then: their tangent serves linear laws
        while the key stays the same.
    report
        Of the step: what the substep took is added.

    Raises
    ------
    NotConverged
        With the residual history.
    """
    newton = Newton(solvers, momentum, storage)
    in_turn = solvers.scheme.richardson and storage is not None
    serves = report.newton > 0 and momentum.smooth
    errors = newton.alternate() if in_turn else newton.newton(as_reset, key, serves)
    took = newton.report
    if took.newton and storage is None and solvers.symmetric and not solvers.iterative:
        newton.check_stable()
    report.newton, report.coupling = report.newton + took.newton, report.coupling + took.coupling
    report.history += took.history
    count, most = (took.coupling, "coupling") if in_turn else (took.newton, "newton")
    report.easy = report.easy and 3 * count <= 2 * getattr(solvers.scheme, f"most_{most}")
    if storage is None:
        return None
    grid, nodes = momentum.forms.grid, momentum.system.unknowns.global_size
    area = grid.cell_volume / grid.h.max() * (storage.ring if grid.axisymmetric else 1.0)
    report.stress = errors.forces / (area * np.sqrt(max(1, nodes)))
    report.balance = _relative(abs(storage.balance(errors.fluid)), errors.scales[1])
    return errors.fluid.rates


def note_pressures(
    report: Report,
    solvers: LinearSolvers,
    storage: StorageProblem | None,
    seconds: float,
    dt: float,
    rates: Sequence[Rates],
) -> None:
    """Note what the cells' pressures have done in a step, and the estimated error of it.

    The difference of the step to one of first order is seconds (Q2 - Q1), a fluid volume.  The fixed-stress operator
    makes it a pressure that stays bounded for stiff modes, as in Hosea and Shampine (1996).  Cells count with what they
    hold.

    Parameters
    ----------
    seconds
        Time in which the first of the rates counts, s.
    dt
        The step, s.
    """
    if storage is None or not report.newton:
        return
    start, p = storage.system.p_start.array_r, rates[-1].pressure
    error, sealed = np.zeros((2, len(p)))
    first, second = rates[0].pressure - start, p - rates[0].pressure
    if len(rates) > 1:
        error = ERROR * np.abs(solvers.filtered(seconds * (rates[1].cells - rates[0].cells)))
        sealed = storage.sealed(seconds * rates[0].cells + (dt - seconds) * rates[1].cells)
    largest = [np.abs(storage.fill * values).max(initial=0.0) for values in (error, p - start, first, second, sealed)]
    largest += [values.max(initial=-np.inf) for values in (-p, p)]
    largest = over_all(storage.forms.grid.comm, np.array(largest), MPI.MAX).tolist()
    report.error, report.change, report.first, second, report.sealed, low, high = largest
    report.extremes = (-low, high)
    report.sudden = report.first if len(rates) > 1 and second < SUDDEN * report.first else 0.0


class Newton:
    """Newton's method on the problems of one substep.

    Parameters
    ----------
    solvers, momentum, storage
        See `solve_substep`.
    """

    def __init__(self, solvers: LinearSolvers, momentum: MomentumProblem, storage: StorageProblem | None):
        self._solvers, self._scheme, self._momentum, self._storage = solvers, solvers.scheme, momentum, storage
        self.report = Report()
        wet_in_2d = storage is not None and momentum.forms.grid.dim == 2
        self._keep = KEEP_WET if wet_in_2d and momentum.forms.elastic else KEEP
        self._linear = momentum.linear and (storage is None or storage.linear)
        self._functions = [momentum.forms.u] + ([storage.forms.p] if storage is not None else [])

    def newton(self, as_reset: Callable[[], QuadratureData], key: Hashable, serves: bool) -> Errors:
        """Solve both problems at once; the tangent is kept while it serves, of linear laws over steps.

        serves: whether the tangent of the substep before may serve.
        """
        errors, other = self._begin()
        fresh, watched = self._linear or not serves, not self._momentum.forms.elastic
        if other is not None:
            try:
                return self._iterations(errors, as_reset, key, fresh, watched)
            except NotConverged:
                self._go_to(other)
                errors, fresh = self._errors(errors.start), True
        return self._iterations(errors, as_reset, key, fresh, watched)

    def _iterations(
        self, errors: Errors, as_reset: Callable[[], QuadratureData], key: Hashable, fresh: bool, watched: bool
    ) -> Errors:
        """Iterate from the present (u, p), of these errors; fresh: with its own tangent; watched: by a watchdog."""
        count, eases = 0, not self._momentum.yielded
        dog = Watchdog(errors.worst, self._iterate(), eases=eases) if watched else None
        while (found := self._augmented(errors)).worst > self._scheme.tolerance:
            if found is not errors:  # what has balanced is to do so with other pressures or pairs of contacts
                errors, count, fresh = found, 0, True
            if not watched or (fresh and not dog.converges) or count == 2 * self._scheme.most_newton:
                self._check(max(count, self.report.newton // REBALANCED), "newton")
            if fresh and self._linear and not self.report.newton:
                self._solvers.tangent(key, lambda: self._linearise_as_reset(as_reset))
            elif fresh:
                self._linearise(dog.firmness(errors.u) if dog else 0.0)
            self.report.coupling += self._direction(errors)
            before, (errors, step) = errors, self._line_search(errors, dog)
            count += 1
            fresh = errors.worst > self._keep * min(1.0, before.worst)  # inf where no fluid has moved yet
            dog = dog and dog.after(errors.worst, step, self._iterate)
            if dog and dog.strays(errors.worst):
                self._go_to(dog.where)
                errors, fresh, dog = self._errors(errors.start), True, replace(dog, since=0, descends=True)
            seeps = self._storage is not None and self._storage.settle_seepage()
            if self._momentum.settle_tools(errors.worst <= SETTLED) or seeps:
                errors, fresh = self._errors(errors.start), True
        return found

    def _augmented(self, errors: Errors) -> Errors:
        """Return the errors, of what balances with the pressures of tools that penetrate too deep shifted."""
        momentum = self._momentum
        while errors.worst <= self._scheme.tolerance and (
            momentum.settle_tools(True) or momentum.augment_tools() or momentum.follow_contacts()
        ):
            errors = self._errors(errors.start)
        return errors

    def _begin(self) -> tuple[Errors, list[NDArray[np.float64]] | None]:
        """Return the errors where the iterations begin: at a guess that balances better than where (u, p) are.

        Also where else they may begin, if there is another place.
        """
        errors, start, best = self._errors(), self._iterate(), None
        guesses = [] if self._linear else self._momentum.guesses()
        for guess in guesses:
            self._go_to([guess, *start[1:]])
            try:
                found = self._errors(errors.start)
            except NotConverged:
                continue
            if found.u < (best or errors).u:  # of no other p: where no fluid has moved yet the storage tells nothing
                best, at = found, guess
        if best is None:
            if guesses:
                self._go_to(start)
                errors = self._errors(errors.start)
            return errors, None
        if guess is not at:
            self._go_to([at, *start[1:]])
            best = self._errors(errors.start)
        return best, start

    def _iterate(self) -> list[NDArray[np.float64]]:
        """Return a copy of the present (u, p), local arrays, m and Pa."""
        return [f.x.array.copy() for f in self._functions]

    def _go_to(self, iterate: Sequence[NDArray[np.float64]]) -> None:
        """Set (u, p)."""
        for f, values in zip(self._functions, iterate, strict=True):
            f.x.array[:] = values

    def check_stable(self) -> None:
        """Refuse an equilibrium that the body leaves at the least disturbance: smaller steps find where it goes.

        Its tangent has negative eigenvalues.  Without water only, which holds a buckling body back for a while.
        Where a step kept its first tangent, it is the next step that finds out.
        """
        if not negative_pivots(self._solvers.solve_u):
            return
        self._linearise()  # the last tangent may be that of another state
        if count := negative_pivots(self._solvers.solve_u):
            why = f"the equilibrium is unstable, its tangent has {count} negative eigenvalues"
            raise NotConverged(why, self.report.history)

    def alternate(self) -> Errors:
        """Fixed-stress iteration: momentum at fixed pressure, then storage at fixed stress, until both balance."""
        errors, report = self._errors(), self.report
        self._linearise()
        while (errors := self._augmented(errors)).worst > self._scheme.tolerance:
            self._check(report.coupling, "coupling")
            try:
                self._balance_momentum(errors)
            except NotConverged as failed:
                why = "beta is below alpha^2 / (2 K_dr)" if self._scheme.of_fluid else "cut the step"
                name = self._scheme.coupling
                raise NotConverged(f"the {name} iteration diverges ({why})", report.history) from failed
            with Timer("mpm: linear solve"):
                dp = self._solvers.solve_storage()
            with _ignored():
                self._storage.system.unknowns.add(self._storage.forms.p, -1.0, dp)
            report.coupling += 1
            if self._storage.settle_seepage():
                self._linearise()
            errors = self._errors(errors.start)
        return errors

    def _balance_momentum(self, errors: Errors) -> None:
        """Newton's method on the momentum at fixed pressure."""
        goal = INNER * max(self._scheme.tolerance, min(1.0, errors.p))
        for count in range(MOMENTUM_STEPS):
            if count and errors.u <= goal:
                return
            with Timer("mpm: linear solve"):
                self._solvers.solve_momentum()
            before, (errors, _) = errors.u, self._line_search(errors)
            settled = self._momentum.settle_tools(errors.u <= SETTLED)
            errors = self._errors(errors.start) if settled else errors
            if settled or errors.u > max(goal, KEEP * before):
                self._linearise()

    def _check(self, count: int, kind: str) -> None:
        if count >= getattr(self._scheme, f"most_{kind}"):
            raise NotConverged(f"no convergence in {count} iterations", self.report.history)

    def _errors(self, scale_u: float = 0.0) -> Errors:
        """Assemble both residuals; return and note their norms relative to their scales.

        scale_u: forces at the start of the step, N.  Those of other iterates do not count: after one that has gone far
        astray everything would seem to balance.

        What is round-off counts as 0.  It is noted as it is, relative to no less than what makes it the tolerance.
        """
        history, tolerance = self.report.history, self._scheme.tolerance
        with Timer("mpm: residual"):
            r, scale = self._momentum.assemble_residual()
            measure = max(scale_u, scale)
            # a tiny load drowns in the round-off of a stiff part: that is no reason not to solve for it once
            round_off = self._momentum.round_off if history else 0.0
            norm, norm_p, fluid, p = r.norm(), 0.0, None, 0.0
            u = _relative(norm, measure, round_off)
            scales = max(measure, self._momentum.round_off / tolerance), 0.0
            if self._storage is not None:
                fluid = self._storage.assemble_residual()
                norm_p = fluid.off
                p = _relative(norm_p, fluid.exchanged, fluid.round_off)
                scales = scales[0], max(fluid.exchanged, fluid.round_off / tolerance)
        if not history and not np.isfinite(norm + norm_p):
            where, what = ("storage: a source", norm_p) if np.isfinite(norm) else ("momentum: a law or term", norm)
            raise NotConverged(f"{what:g} in the residual of the {where} gives it, must be finite")
        history.append((_relative(norm, scales[0]), _relative(norm_p, scales[1])))
        return Errors(u, p, scales, measure, scale_u or scale, fluid)

    def _linearise(self, firmness: float = 0.0) -> None:
        """Set the tangent at the present (u, p), which no other step is to use; firmness: see `LinearSolvers`."""
        self._solvers.tangent.clear()
        self._solvers.linearise(self._momentum, self._storage, firmness=firmness)

    def _linearise_as_reset(self, as_reset: Callable[[], QuadratureData]) -> bool:
        """Set the tangent of the pieces and pressures when the grid was reset, whatever steps have been taken since."""
        functions = [self._momentum.forms.u]
        if self._storage is not None:
            functions += [self._storage.forms.p, self._storage.forms.p_n]
        now = [f.x.array.copy() for f in functions]
        self._momentum.forms.u.x.array[:] = 0.0
        pieces = as_reset()
        if self._storage is not None:
            self._storage.set_fluxes()
        done = self._solvers.linearise(self._momentum, self._storage, pieces)
        for f, values in zip(functions, now, strict=True):
            f.x.array[:] = values
        return done

    def _direction(self, errors: Errors) -> int:
        """Solve the linearised problem; return the coupling iterations."""
        # no more accuracy than the next residual can use
        iterative = self._solvers.iterative
        in_3d = iterative and self._momentum.forms.grid.dim == 3
        least = FORCING_IN_3D if in_3d else 0.0 if self._momentum.linear else FORCING
        rtol = min(1e-2, max(least, 0.05 * self._scheme.tolerance / min(1.0, errors.worst)))
        if iterative:  # the pull of given displacements, which is all of a first residual, hides the rest
            rtol = max(FINEST, rtol / max(1.0, errors.worst))
        with Timer("mpm: linear solve"):
            return self._solvers.solve(rtol, *errors.scales)

    def _line_search(self, before: Errors, dog: Watchdog | None = None) -> tuple[Errors, float]:
        """Go against the direction, backtracking while the residual is not finite or explodes, or as a watchdog says.

        Return the errors there, and the share of the step.

        Where a watchdog lets the iterations stray, see `_balance_work`.  Where it wants them to descend and no residual
        is as low, the lowest is taken.
        """
        self.report.newton += 1
        if dog is not None and not dog.descends:
            return self._balance_work(before)
        step, moved, tried = 1.0, 0.0, {}
        explodes = min(EXPLODES * before.worst, LARGEST)
        limit, shortest = (explodes, SHORTEST) if dog is None else (dog.limit(before.worst), SHORTEST_DESCENT)
        while step >= shortest:
            self._move(moved - step)
            moved, errors = step, self._errors(before.start)
            if errors.worst <= limit:
                return errors, step
            tried[errors.worst] = step
            step *= 0.5 if dog is None else shortened(errors.worst / before.worst, step)
        if not min(tried) <= explodes:
            raise NotConverged("no descent along the Newton direction", self.report.history)
        best = tried[min(tried)]
        self._move(moved - best)
        return self._errors(before.start), best

    def _balance_work(self, before: Errors) -> tuple[Errors, float]:
        """Go against the direction, fully where the residual falls, else to where the forces do no work along it.

        See `watchdog`, to which it is left where no try does so.
        """
        self._turn_forwards(before)
        force, first = self._momentum.system.residual, self._momentum.system.residual.dot(self._solvers.du)
        search, moved = Search(), 0.0
        while search is not None:
            self._move(moved - search.step)
            moved, errors = search.step, self._errors(before.start)
            search = search.after(_ratio(force.dot(self._solvers.du), first), errors.worst <= before.worst)
        return errors, moved

    def _turn_forwards(self, errors: Errors) -> None:
        """Turn a direction round along which the residuals do negative work: see `watchdog`.

        The work of both residuals, in which the coupling's cancels, is what the tangent takes.
        """
        work = self._momentum.system.residual.dot(self._solvers.du)
        if self._storage is not None:
            work += errors.fluid.vector.dot(self._solvers.dp)
        if work < 0:
            self._solvers.turn_round()

    def _move(self, scale: float) -> None:
        with _ignored():
            self._momentum.system.unknowns.add(self._momentum.forms.u, scale, self._solvers.du)
            if self._storage is not None:
                self._storage.system.unknowns.add(self._storage.forms.p, scale, self._solvers.dp)


def _ignored() -> np.errstate:
    """Return what ignores that a solve has failed: the residual tells."""
    return np.errstate(invalid="ignore", over="ignore")


def _ratio(part: float, whole: float) -> float:
    """Return part / whole, nan where that is not finite."""
    return part / whole if whole and np.isfinite(part) else np.nan


def _relative(norm: float, scale: float, round_off: float = 0.0) -> float:
    """Return norm / scale; 0 where the norm is round-off, never nan, which no comparison would notice."""
    if norm <= round_off:
        return 0.0
    return norm / scale if scale > 0 and norm < np.inf else np.inf
