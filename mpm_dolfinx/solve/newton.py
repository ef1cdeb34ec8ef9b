# SPDX-License-Identifier: MIT
"""Equations of a substep: balance of momentum and storage of fluid, coupled by u and p.

Relative residuals and step lengths refer to each connected part of the bodies separately. The momentum residual is
divided by the forces, and the fluid residual by the exchanged fluid volume. A Newton step of the two balances is

    [ K  -B^T ] [du]     [R_u]
    [ B   C   ] [dp] = - [R_p],

with the displacement increments du, the pressure increments dp, and the residuals R_u and R_p of the two balances.  The
scheme `schur-cg` eliminates du, and solves for dp by conjugate gradients with the Schur complement
`S = C + B K^-1 B^T`.  The preconditioner is the fixed-stress operator `C + beta V`, with cell volumes V and
`beta = 0.75 alpha^2 / K_dr`.  Here alpha is Biot's coefficient, and K_dr is the drained bulk modulus.  For pressures
that alternate from cell to cell, beta V is reduced (`StorageProblem.assemble_preconditioner`).  With inertia, fluxes
depend on accelerations, and FGMRES replaces conjugate gradients.

The scheme `schur-fgmres` uses FGMRES and the full, slightly unsymmetric Jacobian. The scheme `fixed-stress` alternates
between storage solves with `C + beta V` at constant stress and momentum solves. For large bodies, multigrid solves for
both unknowns together (`monolithic`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.errors import NotConverged, Report
from mpm_dolfinx.flow.storage import Rates, StorageProblem, StorageResidual
from mpm_dolfinx.mechanics.momentum import MomentumProblem
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.parts import relative
from mpm_dolfinx.solve.factors import negative_pivots
from mpm_dolfinx.solve.line_search import SHIFT, Halving, Search
from mpm_dolfinx.solve.schur import Kept, LinearSolvers

INNER = 1e-3  # tolerance of momentum solves, divided by the storage residual; wrong rotations would change volumes
MOMENTUM_STEPS = 10
REBALANCED = 6  # largest number of Newton steps while contacts change, divided by the usual largest number
LOOSEST = 1e-2
"""Largest ratio of the residual after a linear solve to the residual before this solve. Sensitivity (scene "soil" of
tests/plateaus.py): half this value changes the result by 2.2e-11, and twice this value by 6.0e-12. Finer cells change
it by 3.0e-02.
"""
SOLVED = 0.05
"""Smallest residual that a linear solve must reach, divided by the tolerance of Newton's method.  Sensitivity (scene
"soil" of tests/plateaus.py): half this value changes the result by 4.0e-12, and twice this value by 3.1e-11.  Finer
cells change it by 3.0e-02.
"""
SETTLED = 1e-2
"""Largest relative residual at which slipping contacts may stick again.  At larger residuals, contact areas change.
Sensitivity (scene "contact" of tests/plateaus.py): half this value changes the result by 1.5e-13, and twice this value
by 6.4e-12.  Finer cells change it by 1.1e-02.
"""
ERROR = 1 / 20
"""Assumed pressure error of a run, divided by the estimated error e of a first-order step (`note_pressures`).

For a mode with decay rate l, the stability function of sdirk2 gives an error of `0.081 dt abs(l) e` in a step, at most
0.28 e. A pressure that follows a varying load has an error of at most 0.14 e. With little decay, the errors of all
steps add up to 0.081 e. Errors were measured by comparison with steps an eighth as long. The errors are 0.01 to 0.08 e
for varying loads, pressures and sources. The error is 0.17 e in a first step from zero load, and 0.26 e after a jump.
The error of a run is at most 5 times the assumed error e / 20. Sensitivity (scene "adaptive" of tests/plateaus.py):
half this value changes the result by 1.8e-02, and twice this value by 3.9e-03. Finer cells change it by 3.8e-02.
"""
SUDDEN = np.sqrt(2)
"""Pressure change in the second substep divided by the change in the first substep, below which sdirk2 overshoots.

For a mode with `z = -(decay rate) dt`, the stability function `(1 + (1 - 2 gamma) z) / (1 - gamma z)^2` is zero at
`z = -1 - sqrt(2)`. The pressure then changes by `-gamma z / (1 - gamma z) = sqrt(2) - 1` in the first substep, and by
`2 - sqrt(2)` in the second. Source: exact.
"""


AsReset = Callable[[], AbstractContextManager[QuadratureData]]
"""Type of `OnGrid.as_reset`."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Relative residuals of momentum and storage. Arrays have an entry for each connected part of the bodies."""

    u: NDArray[np.float64]  # relative residual of momentum
    p: NDArray[np.float64]  # relative residual of storage
    forces: NDArray[np.float64]  # forces that scale the residual of momentum, N
    exchanged: NDArray[np.float64]  # exchanged fluid volume that scales the residual of storage, m^d
    start: NDArray[np.float64]  # forces at the start of the step, N
    fluid: StorageResidual | None  # residual of the storage, or None

    @cached_property
    def each(self) -> NDArray[np.float64]:
        """The larger of the two relative residuals, for each part."""
        return np.maximum(self.u, self.p)

    @cached_property
    def worst(self) -> float:
        """The largest relative residual of both balances in all parts."""
        return float(np.maximum.reduce(self.each, initial=0.0))


def solve_substep(
    solvers: LinearSolvers,
    momentum: MomentumProblem,
    storage: StorageProblem | None,
    ahead: Callable[[], list[NDArray[np.float64]]] | None,
    as_reset: AsReset,
    key: Hashable,
    report: Report,
    kept: Kept,
) -> Rates | None:
    """Solve the equations of a substep for (u, p). Return the outflow rates at its end, or None without fluid.

    `solvers`: linear solvers for the unknowns of the active cells.
    `momentum`, `storage`: the balances. `storage` is None without fluid.
    `ahead`: function that extrapolates (u, p) at active dofs and cells from the last steps, or None.
    `as_reset`: context with the state at the last grid reset.  `key`: for linear laws, cache key of that tangent.
    `report`: report of the step, to which the counts of the substep are added.
    `kept`: factors that the tangents of the step share.

    Raises
    ------
    NotConverged
        Newton's method does not converge. The exception has the history of the residuals.
    """
    newton = Newton(solvers, momentum, storage, kept)
    in_turn = solvers.scheme.richardson and storage is not None
    reusable = report.newton > 0 and momentum.smooth
    follows = not report.history or max(report.history[0]) ** 2 <= solvers.plan.keep  # after a small first residual
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # the residual shows a failed solve
        errors = newton.alternate() if in_turn else newton.newton(as_reset, key, reusable, ahead if follows else None)
        took = newton.report
    report.newton, report.coupling = report.newton + took.newton, report.coupling + took.coupling
    report.history += took.history
    count, most = (took.coupling, "coupling") if in_turn else (took.newton, "newton")
    report.easy = report.easy and 3 * count <= 2 * getattr(solvers.scheme, f"most_{most}")
    if storage is None:
        return None
    grid = momentum.forms.grid
    nodes = momentum.system.of_parts.sizes
    fluid = errors.fluid
    area = grid.finest.prod() / grid.finest.max() * (storage.ring if grid.axisymmetric else 1.0)
    report.stress = float((errors.forces / (area * np.sqrt(np.maximum(1, nodes)))).max(initial=0.0))
    least = fluid.round_off / solvers.scheme.tolerance
    report.balance = float(relative(np.abs(fluid.gain), np.maximum(fluid.exchanged, least)).max(initial=0.0))
    return errors.fluid.rates


def note_pressures(
    report: Report,
    solvers: LinearSolvers,
    storage: StorageProblem | None,
    seconds: float,
    dt: float,
    rates: Sequence[Rates],
    of_bodies: Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]],
) -> None:
    """Store the pressure changes and the estimated pressure error of a step in the report.

    After a first-order step, the fluid volumes would differ by `seconds` times the change of the outflow between the
    substeps.  The inverse of the fixed-stress operator converts this difference into a pressure (Hosea and Shampine
    1996).  The estimated error is `ERROR` times this pressure, weighted by the filled fraction of the cell.

    `seconds`, s: time weight of the rates of the first substep.
    `dt`, s: length of the step.
    `of_bodies`: function that returns the largest values in each body, see `Motion.of_bodies`.
    """
    if storage is None or not report.newton:
        return
    forms, owned = storage.forms, storage.system.unknowns.owned
    start, before, p = (f.x.array[owned] for f in (forms.p_n, forms.p_before, forms.p))
    before = before if len(rates) > 1 else p
    error, undrained = np.zeros((2, len(p)))
    first, second = before - start, p - before
    if len(rates) > 1:
        error = ERROR * np.abs(solvers.filtered(seconds * (rates[1].cells - rates[0].cells)))
        undrained = storage.undrained(seconds * rates[0].cells + (dt - seconds) * rates[1].cells)
    largest = [np.abs(storage.fill * values).max(initial=0.0) for values in (error, undrained)]
    filling = storage.filling(error) if forms.retains else (error[:0], error[:0])
    largest += [values.max(initial=0.0) for values in filling]
    report.error, report.undrained, *fills = over_all(storage.forms.grid.comm, np.array(largest), MPI.MAX).tolist()
    report.fills = tuple(fills)
    changes = storage.fill * np.abs([p - start, first, second])
    report.change, report.first, second, *ends = of_bodies(owned, np.concatenate([changes, [-start, start, -p, p]]))
    report.extremes = np.reshape(ends, (2, 2, -1)) * [[-1.0], [1.0]]
    least = np.maximum(second / SUDDEN, forms.rounding)
    report.sudden = np.where((len(rates) > 1) & (report.first > least), report.first, 0.0)


class Newton:
    """Newton's method for the balances in one substep.

    `solvers`, `momentum`, `storage`, `kept`: see `solve_substep`.
    """

    def __init__(self, solvers: LinearSolvers, momentum: MomentumProblem, storage: StorageProblem | None, kept: Kept):
        self._solvers = solvers
        self._scheme = solvers.scheme
        self._momentum = momentum
        self._storage = storage
        self.report, self._kept = Report(), kept
        self._linear = momentum.linear and (storage is None or storage.linear)
        forms, active = momentum.forms, momentum.forms.active.now
        u = forms.u.x
        self._vectors, self._moved = [(u, active.dofs)], [(u, momentum.system, solvers.du)]
        if storage is not None:
            p = storage.forms.p.x
            self._vectors.append((p, active.cells))
            self._moved.append((p, storage.system, solvers.dp))

    def newton(self, as_reset: AsReset, key: Hashable, reusable: bool, ahead: Callable | None) -> Errors:
        """Solve the balances by Newton's method. A tangent is reused while the iterations converge.

        `reusable`: whether the tangent of the previous substep may be reused.
        `as_reset`, `key`, `ahead`: see `solve_substep`.
        """
        errors, other = self._begin(ahead)
        fresh = self._linear or not reusable
        if other is not None:
            try:
                return self._stable(self._iterations(errors, as_reset, key, fresh))
            except NotConverged:
                self._go_to(other)
                errors, fresh = self._errors(errors.start), True
        return self._stable(self._iterations(errors, as_reset, key, fresh))

    def _iterations(self, errors: Errors, as_reset: AsReset, key: Hashable, fresh: bool) -> Errors:
        """Iterate from the present (u, p). `fresh`: whether to start with a new tangent."""
        elastic = self._momentum.forms.elastic
        tolerance = self._scheme.tolerance
        keep = self._solvers.plan.keep
        count = 0
        slow = False
        log_change: NDArray[np.float64] | float = 0.0
        eases = np.full(len(errors.u), elastic or not self._momentum.yielded)
        while (found := self._augmented(errors)).worst > tolerance:
            if found is not errors:  # the iterations converged, but contact forces or multipliers have changed
                errors = found
                count = 0
                fresh |= any(one.touches for one in self._momentum.loads)
            if elastic or fresh:
                self._check(max(count, self.report.newton // REBALANCED), "newton")
            if fresh and self._linear and not self.report.newton:
                self._solvers.tangent(key, lambda: self._linearise_as_reset(as_reset))
            elif fresh:
                self._linearise(np.where(eases, 0.0, SHIFT * np.minimum(1.0, errors.u)))
            self.report.coupling += self._direction(errors, slow)
            if self._storage is not None:
                log_change = self._solvers.restrain(self._storage, log_change)
            before, errors = errors, self._line_search(errors, elastic)
            # without exchanged fluid the first residual is infinite; with yield only prescribed displacements cause it
            count, known = count + 1, np.minimum(1.0, before.each) * (elastic | (before.each <= 1))
            lags = (errors.each > keep * known) & (errors.each > tolerance)
            slow = fresh and bool((lags & (errors.p > errors.u)).any())
            fresh, eases = bool(lags.any()), eases & (elastic | ~lags)
            seeps = self._storage is not None and self._storage.settle()
            if self._momentum.settle(errors.worst <= SETTLED) or seeps:
                errors, fresh = self._errors(errors.start), True
        return found

    def _augmented(self, errors: Errors) -> Errors:
        """Update contacts until none changes, or an update lifts a residual above the tolerance. Return the errors."""
        momentum = self._momentum
        count = 0
        while errors.worst <= self._scheme.tolerance and (momentum.settle(True) or momentum.augment()):
            self._check(count, "newton")
            errors, count = self._errors(errors.start), count + 1
        return errors

    def _begin(self, ahead: Callable | None) -> tuple[Errors, list[NDArray[np.float64]] | None]:
        """Set the initial guess of Newton's method. Return its errors, and an alternative guess or None.

        The guess is the result of `ahead`. If its residual is large, each part takes the u with the smallest residual.
        """
        start = self._iterate()
        if ahead is not None:
            u, *p = ahead()
            self._go_to([self._momentum.freely(u), *p])
            errors, _ = self._tried(None)
            worst = np.inf if errors is None else errors.worst
            if errors is not None and errors.fluid is not None:  # without flow, volume errors resemble exchanged fluid
                flows = np.abs(self._storage.net_inflow(errors.fluid.rates)).sum()
                worst = max(worst, errors.fluid.off.sum() / over_all(self._solvers.du.comm.tompi4py(), flows))
            if worst**2 <= self._solvers.plan.keep:
                return errors, start
            self._go_to(start)
            self.report.history.clear()
        errors = self._errors()
        guesses = [] if self._linear or errors.worst <= self._scheme.tolerance else self._momentum.guesses()
        at = last = start[0]
        least = errors.u
        for guess in guesses:
            self._go_to([guess, *start[1:]])
            last = None
            try:
                found = self._errors(errors.start)
            except NotConverged:
                continue
            better = found.u < least  # all guesses have the same p
            if better.any():
                at = guess if better.all() else np.where(better[self._parts], guess, at)
                least, last = np.minimum(found.u, least), at if better.all() else None
        if last is not at:
            self._go_to([at, *start[1:]])
            found = self._errors(errors.start)
        return (errors, None) if at is start[0] and not guesses else (found, None if at is start[0] else start)

    def _iterate(self) -> list[NDArray[np.float64]]:
        """Return copies of the present u and p."""
        return [x.array[rows] for x, rows in self._vectors]

    @cached_property
    def _parts(self) -> NDArray[np.int64]:
        """Connected part of each active degree of freedom."""
        momentum = self._momentum
        return momentum.system.parts.nodes[momentum.forms.active.now.dofs // momentum.forms.grid.dim]

    def _go_to(self, iterate: Sequence[NDArray[np.float64]]) -> None:
        """Set (u, p) to an iterate."""
        for (x, rows), values in zip(self._vectors, iterate, strict=True):
            x.array[rows] = values
            x.scatter_forward()

    def _stable(self, found: Errors) -> Errors:
        """Return the errors. Raise NotConverged if the equilibrium is unstable.

        The tangent of an unstable equilibrium has negative eigenvalues. Only dry bodies with symmetric, factorised
        tangents are checked.
        """
        plan = self._solvers.plan
        if not self.report.newton or self._storage is not None or not plan.symmetric or plan.iterative:
            return found
        if not negative_pivots(self._solvers.solve_u):
            return found
        self._linearise()  # the last tangent may belong to another state
        if not (count := negative_pivots(self._solvers.solve_u)):
            return found
        self._solvers.solve_momentum()
        self._move(-np.ones(self._momentum.system.of_parts.count))
        errors = self._errors()
        self._linearise()
        if negative_pivots(self._solvers.solve_u) or errors.worst > self._scheme.tolerance:
            why = f"the equilibrium is unstable, its tangent has {count} negative eigenvalues"
            raise NotConverged(why, self.report.history)
        return errors

    def alternate(self) -> Errors:
        """Alternate momentum solves at fixed pressure and storage solves at fixed stress, until both converge."""
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
            with _compat.Timer("linear solve"):
                dp = self._solvers.solve_storage()
            self._storage.system.unknowns.add(self._storage.forms.p.x, -1.0, dp)
            report.coupling += 1
            if self._storage.settle():
                self._linearise()
            errors = self._errors(errors.start)
        return errors

    def _balance_momentum(self, errors: Errors) -> None:
        """Solve the balance of momentum at fixed pressure, by Newton's method."""
        goal = INNER * max(self._scheme.tolerance, min(1.0, errors.p.max()))
        for count in range(MOMENTUM_STEPS):
            if count and errors.u.max() <= goal:
                return
            with _compat.Timer("linear solve"):
                self._solvers.solve_momentum()
            before, errors = errors.u.max(), self._line_search(errors, True)
            settled = self._momentum.settle(errors.u.max() <= SETTLED)
            errors = self._errors(errors.start) if settled else errors
            if settled or errors.u.max() > max(goal, self._solvers.plan.keep * before):
                self._linearise()

    def _check(self, count: int, kind: str) -> None:
        if count >= getattr(self._scheme, f"most_{kind}"):
            raise NotConverged(f"no convergence in {count} iterations", self.report.history)

    def _errors(self, start: NDArray[np.float64] | None = None) -> Errors:
        """Assemble both residuals, add their relative norms to the history, and return the norms.

        `start`, N: forces at the start of the step, a lower bound of the scales. Residuals within rounding count as 0.
        """
        first = not self.report.history
        with _compat.Timer("residual"):
            r, forces = self._momentum.residual_of_parts()
            forces = forces if start is None else np.maximum(start, forces)
            u, error_u = self._momentum.out_of_balance(r, forces, first)
            exchanged = np.zeros(len(u))
            p = error_p = exchanged
            fluid, size = None, 0.0
            if self._storage is not None:
                fluid = self._storage.assemble_residual()
                exchanged, size = fluid.exchanged, float(np.add.reduce(fluid.off))
                p = relative(fluid.off, exchanged, fluid.round_off)
                error_p = relative(fluid.off, np.maximum(exchanged, fluid.round_off / self._scheme.tolerance))
        if first and not np.isfinite(norm := r.norm() + size):
            where = "storage, from a source" if np.isfinite(r.norm()) else "momentum, from a law or term"
            raise NotConverged(f"{norm:g} in the residual of the {where}, must be finite")
        largest = np.maximum.reduce(np.array([error_u, error_p]), axis=1, initial=0.0)
        self.report.history.append(tuple(largest.tolist()))
        return Errors(u, p, forces, exchanged, forces if start is None else start, fluid)

    def _linearise(self, shift: NDArray[np.float64] | float = 0.0) -> None:
        """Set the tangent at the present (u, p), for this step only."""
        self._solvers.tangent.clear()
        self._solvers.linearise(self._momentum, self._storage, self._kept, shift=shift)

    def _linearise_as_reset(self, as_reset: AsReset) -> bool:
        """Set the tangent for the state at the last reset of the grid."""
        with as_reset() as pieces:
            if self._storage is not None:
                self._storage.set_fluxes()
            return self._solvers.linearise(self._momentum, self._storage, self._kept, pieces)

    def _direction(self, errors: Errors, slow: bool) -> int:
        """Solve the linearised problem, and return the number of coupling iterations.

        `slow`: whether to include the derivative of fluxes with respect to displacements, after slow convergence.
        """
        # the linear solve need not be more accurate than the next residual
        iterative, least = self._solvers.plan.iterative, self._solvers.plan.forcing
        if self._momentum.linear and not (iterative and self._momentum.forms.grid.dim == 3):
            least = 0.0
        rtol = min(LOOSEST, max(least, SOLVED * self._scheme.tolerance / min(1.0, errors.worst)))
        if iterative:  # in the first residual, the penalty of prescribed displacements hides all other terms
            rtol = max(SOLVED * self._scheme.tolerance, rtol / max(1.0, errors.worst))
        if self._storage is not None:
            rtol = min(rtol, self._storage.accuracy)
        done = errors.each <= self._scheme.tolerance
        if done.any():  # converged parts are not changed
            self._momentum.system.residual.array_w[done[self._momentum.system.of_parts.of]] = 0.0
            if self._storage is not None:
                errors.fluid.vector.array_w[done[self._storage.system.of_parts.of]] = 0.0
        forces = np.maximum(errors.forces, self._momentum.system.round_off / self._scheme.tolerance)
        with _compat.Timer("linear solve"):
            if errors.fluid is None:
                return self._solvers.solve(self._kept, rtol, forces)
            least = errors.fluid.round_off / self._scheme.tolerance
            measures, goal = (forces, np.maximum(errors.exchanged, least)), SOLVED * self._scheme.tolerance
            if not slow or self._linear or self._storage.forms.retains:
                return self._solvers.solve(self._kept, rtol, *measures, goal=goal)
            forms = self._momentum.forms
            slope = self._storage.flux_slope(forms.u, self._momentum.system.unknowns, forms.active.now.dofs)
            count = self._solvers.solve(self._kept, rtol, *measures, slope, goal)
            self._storage.set_fluxes()
            return count

    def _line_search(self, before: Errors, elastic: bool) -> Errors:
        """Move u and p against the Newton direction in each part, and return the errors."""
        self.report.newton += 1
        of = self._momentum.system.of_parts
        moved = np.zeros(of.count)
        steps = moved + 1.0
        first = np.empty(0) if elastic else self._work()  # without yield the work is not used
        if not elastic and (first < 0).any():
            self._solvers.turn_round(first < 0)
            first = np.abs(first)
        start = Halving() if elastic else Search()
        searches = dict.fromkeys((before.each > self._scheme.tolerance).nonzero()[0], start)
        while True:
            self._move(moved - steps)
            moved, (errors, why) = steps.copy(), self._tried(before)
            growth, work = errors.each / before.each, first if elastic else self._work()
            for part, search in list(searches.items()):
                ratio = np.nan if why or elastic else _ratio(work[part], first[part])
                then = search.after(ratio, growth[part])
                if then is not None:
                    searches[part], steps[part] = then, then.step
                elif growth[part] <= search.limit:
                    del searches[part]
                else:
                    what = "" if why is None else f": {why.reason}"
                    raise NotConverged(f"no descent along the Newton direction{what}", self.report.history)
            if not searches:
                return errors

    def _tried(self, before: Errors | None) -> tuple[Errors | None, NotConverged | None]:
        """Return the errors after a trial step, and the exception if a law fails."""
        try:
            return self._errors(before and before.start), None
        except NotConverged as failed:
            if before is None:
                return None, failed
            self.report.history.append((np.inf, np.inf))
            away = np.where(before.each > self._scheme.tolerance, np.inf, before.each)
            return replace(before, u=away, p=away), failed

    def _work(self) -> NDArray[np.float64]:
        """Return the work of both residuals along the Newton direction, in J."""
        system = self._momentum.system
        work = system.of_parts.sums(system.residual.array_r * self._solvers.du.array_r)
        if self._storage is None:
            return work
        system = self._storage.system
        return work + system.of_parts.sums(system.residual.array_r * self._solvers.dp.array_r)

    def _move(self, steps: NDArray[np.float64]) -> None:
        """Add fractions of the Newton direction to u and p in each part."""
        for x, system, direction in self._moved:
            system.unknowns.add(x, steps[system.of_parts.of], direction)


def _ratio(part: float, whole: float) -> float:
    """Return `part / whole`, or nan if the ratio is not finite."""
    return part / whole if whole and np.isfinite(part) else np.nan
