# SPDX-License-Identifier: MIT
"""How long the steps of a run are: all alike, or by the error that each has made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, isfinite

from mpi4py import MPI

import numpy as np

from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.base.tolerances import EPSILON, NEAR, ROUND_OFF, SAME
from mpm_dolfinx.base.validation import line, numbers
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.solve.newton import ERROR
from mpm_dolfinx.stepping.result import Result
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.step_control import StepControl

MIN_CUT, MIN_CUT_BY_ERROR = 2.0**-10, 2.0**-30
"""Share of what a step should be long below which it is not cut.

Steps by error grow over decades: where soil begins to slide they have to come down to the time that this takes.
"""
FINEST = NEAR**2
"""Share of the time below which steps by error are not cut: bodies that burst would take ever shorter ones.

Source: epsilon, a shorter step is told from the time by less than four digits.
"""
SAFETY, SHRINKS, GROWS, KEEPS = 0.9, 0.2, 5.0, 1.2
"""A step by error follows SAFETY times its error's root, by SHRINKS to GROWS; below KEEPS it stays as it is.

Source: Hairer, Norsett and Wanner (1993), eq. 4.13; the last Hairer and Wanner (1996), IV.8.
"""
RINGS = 5e-3
"""Sudden change of the pressures, in proportion to the largest so far, from which on a step is taken in two halves.

The stability function is never below -0.21: what goes unseen overshoots by a thousandth.
"""
AGAIN = 2.0
"""Sudden changes, in proportion to those in the step before and its length, that need not be those of jumps."""
MOST = SAME / EPSILON
"""Output intervals of a run.  Source: exact bound, with more a step's slack SAME is below epsilon times the time."""
RESOLVED = 10
"""Errors that can be told from what the solver leaves, in proportion to its tolerance."""
FIRST = 1e-3
"""Share of the first output interval that a step by error is first tried with at least."""


@dataclass(frozen=True)
class StepSize:
    """The rule for the length of a run's steps.

    Parameters
    ----------
    first, longest : s
        The step to begin with; the step where all are alike, else the longest.
    rtol
        Largest error of the pressures in proportion to their largest change since the run began, or to what it would
        be in the step if no fluid flowed; None: equal steps.
    """

    first: float
    longest: float
    rtol: float | None = None

    @property
    def by_error(self) -> bool:
        """Whether steps are chosen by their error."""
        return self.rtol is not None

    def ended(self, t: float, target: float, control: StepControl) -> bool:
        """Return whether a time, s, is the target but for rounding."""
        slack = ROUND_OFF * abs(target) if self.by_error else SAME * min(control.small, self.longest)
        return target - t <= slack

    def least(self, wanted: float, t: float) -> float:
        """Return the length, s, below which a step is not cut at a time, s, that should be so long."""
        return max(MIN_CUT_BY_ERROR * wanted, FINEST * abs(t)) if self.by_error else MIN_CUT * wanted

    def wanted(self, taken: float) -> float:
        """Return what a step should be that is first tried with a length, s: below a share of it it is not cut."""
        return taken if self.by_error else self.longest

    def fitted(self, left: float, small: float) -> float:
        """Return the length of the next step, s: `small`, fitted to the time that is left to the next output."""
        if self.by_error:  # no scrap of a step before an output
            small = min(small, self.longest)  # of a run that went on with other steps it may be longer
            return left if left <= min(1.05 * small, (1 + SAME) * self.longest) else min(small, left / 2)
        # steps that fit but for rounding are all of the same length
        return left if not left > (1 - SAME) * small else small

    def refused(self, taken: float, report: Report, control: StepControl) -> float:
        """Return by how much its error has to shrink a step that has been solved; 1 where it is accepted.

        After a jump of the loads one long step may overshoot by a fifth of what is left, two halves of it do not: the
        stability function is squared.
        """
        if not self.by_error:
            return 0.5 if taken > 0.75 * self.longest and self._rings(taken, report, control) else 1.0
        # steps are refused where loads jump or bend, mostly: there the error is of first order
        return 1.0 if self._excess(report, control) <= 1 else self._factor(report, control, 1.0)

    def next(self, taken: float, report: Report, control: StepControl, failed: bool) -> float:
        """Return the step to try after one that was taken, s; failed: after a longer one had not converged."""
        if not self.by_error:
            grows = report.easy and not self._rings(taken, report, control)  # twice as long it would be refused
            return max(control.small, min(2 * taken, self.longest)) if grows else control.small
        factor = self._factor(report, control, 0.5)
        if factor >= 1:
            # a step as long as one that has just failed would mostly fail again: in soil that yields, 78 cuts, not 1
            factor = 1.0 if factor < KEEPS or failed or not report.easy else factor
            return min(max(taken * factor, control.small), self.longest)  # it may have been short for an output's sake
        return taken * factor

    def cut(self, taken: float, control: StepControl) -> StepControl:
        """Return the memory with half a step, s, to try next: the step has not converged."""
        whole = taken > (1 - SAME) * control.small
        waits = 2 * control.waits + 1 if whole and control.kept == 0 else control.waits
        return replace(control, small=taken / 2, waits=waits, kept=1)

    def grown(self, taken: float, report: Report, control: StepControl, failed: bool) -> StepControl:
        """Return the memory with the step to try next after one that was taken, s; failed: see `next`.

        Equal steps that were cut grow at once, until one that has just grown fails as well: then they wait for one more
        step, for three, seven ..., and for half as many after one that has grown has converged.  `waits` is how many,
        `kept` how many steps there were since the last cut or growth, from one on; 0: the step has just grown.
        """
        small, whole = self.next(taken, report, control, failed), taken > (1 - SAME) * control.small
        if self.by_error:
            return replace(control, small=small)
        waits = control.waits // 2 if whole and control.kept == 0 else control.waits
        if small > (1 + SAME) * control.small and control.kept > waits:  # not by rounding only
            return replace(control, small=small, waits=waits, kept=0)
        # a step that was fitted to an output tells nothing of longer ones
        return replace(control, waits=waits, kept=control.kept + whole)

    def _rings(self, taken: float, report: Report, control: StepControl) -> bool:
        """Return whether a step may have overshot.

        What is as sudden in step after step is no jump of the loads, of which a step leaves a fifth at most: where the
        grid is reset in every step, pressures beside an edge that is pushed into a body change in the first substep.
        """
        return report.sudden - AGAIN * control.first * taken > RINGS * control.change

    def _factor(self, report: Report, control: StepControl, power: float) -> float:
        """Return the step whose error would be as large as it may be, in proportion to one that was solved."""
        excess = self._excess(report, control)
        return min(GROWS, max(SHRINKS, SAFETY / excess**power if excess > 0 else GROWS))

    def _excess(self, report: Report, control: StepControl) -> float:
        """Return by how much the error of a step is larger than it may be: of pressures, water content, or motion."""
        error, motion = report.moves
        motion = max(control.motion or 0.0, motion)
        allowed = self._allowed(report, control)
        wrong, filled = report.fills
        errors = [
            (report.error, allowed),
            (error, self.rtol * motion),
            (wrong, self.rtol * max(control.filled, filled)),
        ]
        return max(off / least if least > 0 else 0.0 if off == 0 else inf for off, least in errors)

    def _allowed(self, report: Report, control: StepControl) -> float:
        """Return how large the error of the pressures may be in a step, Pa.

        Where water flows freely pressures follow the motion of the bodies: what time steps make of them moves nothing,
        and what the grid makes of them, some percent, no shorter step mends.
        """
        return self.rtol * max(control.change, report.sealed)


def measured(control: StepControl, report: Report, result: Result) -> StepControl:
    """Return the memory with the largest change of the pressures so far, that of a step that was solved included."""
    change = max(control.change, report.change, NEAR * report.stress)
    if len(result.rows) and len(start := result.pressure[0]) and report.extremes is not None:
        change = max(change, *(abs(now - then) for now, then in zip(report.extremes, start.tolist(), strict=True)))
    motion = None if control.motion is None else max(control.motion, report.moves[1])
    return replace(control, change=change, motion=motion, filled=max(control.filled, report.fills[1]))


class Times:
    """The output times of a run.

    Parameters
    ----------
    start, now : s
        Where the run began, and where it goes on.
    end, interval, given, rtol
        t_end, dt, t_eval and rtol of `run`.
    goes_on
        Whether the run goes on with histories.

    Raises
    ------
    ValueError
        Naming what is not allowed: no time left, or more steps than times can tell apart.
    """

    def __init__(self, start: float, now: float, end, interval, given, rtol, goes_on: bool):
        more, least = (">=", now) if goes_on else (">", np.nextafter(now, inf))
        test, allowed = lambda v: (v >= least) & (v < inf), f"{more} {now:g} s and finite"
        self.end = float(numbers("t_end", end, allowed=allowed, test=test))
        if interval is None and rtol is None:
            raise ValueError("dt = None: must be given, or rtol for steps that are chosen by their error")
        if given is not None and interval is not None and rtol is not None:
            raise ValueError(
                f"dt = {line(interval)}: with rtol and t_eval there is no output interval, must be left out"
            )
        self.interval, self.each = 0.0, given is None and interval is None
        """Output interval, s, 0 without; whether every step is an output."""
        if interval is not None:
            allowed = f"> 0, and not below {(self.end - now) / MOST:g} s"
            test = lambda v: (v > 0) & (v * MOST >= self.end - now)  # noqa: E731
            self.interval = min(float(numbers("dt", interval, allowed=allowed, test=test)), self.end - start)
        self._times = None
        if given is not None:
            times = numbers("t_eval", given, None, allowed="times, s")
            if times.ndim != 1 or not (np.diff(times, prepend=start) > 0).all() or not (times <= self.end).all():
                raise ValueError(f"t_eval = {line(given)}: must be increasing times in ({start:g}, {self.end:g}] s")
            self._times = times.tolist()
        elif self.each:
            self._times = []
        self.start = start

    def after(self, t: float) -> list[float]:
        """Return the output times after one, s, the end included."""
        if self._times is not None:
            return [*(time for time in self._times if t < time < self.end), *([self.end] if t < self.end else [])]
        # a last interval that is a fraction of dt counts as one
        start, dt = self.start, self.interval
        done = round((t - start) / dt)
        count = max(done + (self.end - t > SAME * dt), round((self.end - start) / dt))
        return [start + k * dt for k in range(done + 1, count)] + [self.end] * (count > done)

    def next(self, t: float) -> float:
        """Return until when a run that has been broken off after an output time may have got, s."""
        return max([*self.after(t)[:1], t]) + SAME * self.interval


def diffusion_time(scene: Scene, points: MaterialPoints) -> float:
    """Return the least time in which pressures diffuse through a cell, h^2 / c_v, s; 0 where nothing conducts."""
    if scene.fluid is None:
        return 0.0
    stored = scene.materials.table(points, lambda m: m.biot**2 / m.oedometric)
    stored = stored + scene.materials.storage(points)
    mobility = scene.materials.table(points, lambda m: m.conductivity) / scene.fluid.unit_weight
    at = mobility > 0
    least = scene.grid.h.min() ** 2 * (stored[at] / mobility[at]).min(initial=inf)
    least = float(over_all(scene.grid.comm, least, MPI.MIN))
    return least if isfinite(least) else 0.0


def cell_time(scene: Scene, points: MaterialPoints) -> float:
    """Return the least time in which waves run through a cell, s."""
    density = scene.materials.density(points)
    at = density > 0
    fastest = (scene.materials.confined_modulus(points)[at] / density[at]).max(initial=0.0)
    fastest = over_all(scene.grid.comm, float(fastest), MPI.MAX)
    return float(scene.grid.h.min()) / fastest**0.5 if fastest > 0 else inf


def step_rule(times: Times, rtol, first_step, max_step: float, scene: Scene, points: MaterialPoints) -> StepSize:
    """Return the rule of a run: see `run`; ValueError naming what is not allowed."""
    positive = {"test": lambda v: v > 0, "allowed": "> 0"}
    if rtol is None:
        for name, value in {"first_step": first_step, "max_step": max_step if max_step != inf else None}.items():
            if value is not None:
                raise ValueError(f"{name} = {line(value)}: needs rtol, for steps that are chosen by their error")
        return StepSize(times.interval, times.interval)
    least = RESOLVED * scene.scheme.tolerance
    numbers("rtol", rtol, test=lambda v: (least <= v) & (v < 1), allowed=f"in [{least:g}, 1): the solver's tolerance")
    if scene.numerics.method == "backward-euler":
        raise ValueError(f"rtol = {line(rtol)}: backward-euler knows no error of a step, must be sdirk2")
    timed = any("dt" in law.by_scene for law in scene.materials.laws)
    inertia = scene.momentum.inertia is not None
    if (scene.momentum.own.rates or timed) and not scene.flows and not inertia:
        raise ValueError(f"rtol = {line(rtol)}: where nothing flows no error of a velocity is known, must be dt")
    longest = float(numbers("max_step", max_step, **positive)) if max_step != inf else inf
    first = times.after(times.start)[0] - times.start
    if len(scene.substeps) > 1:  # without a rate no step has an error
        # under a load that grows from nothing the error is ERROR dt c_v / h^2 of the change
        first = min(first, max(FIRST * first, SAFETY * rtol / ERROR * diffusion_time(scene, points)))
    if inertia:  # what is let go, or pushed all of a sudden
        first = min(first, cell_time(scene, points))
    if first_step is not None:
        first = float(numbers("first_step", first_step, **positive))
    return StepSize(min(first, longest), longest, float(rtol))
