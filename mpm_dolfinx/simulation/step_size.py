# SPDX-License-Identifier: MIT
"""Length of the steps of a run: all equal, or adapted to the estimated error of each step.

Three errors are estimated: the error of the pressures in `solve/newton.py`, the error of the water content in
`flow/storage.py`, and the error of the motion in `dynamics/motion_error.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, isfinite

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike

from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.base.tolerances import EPSILON, NEAR, ROUND_OFF, SAME
from mpm_dolfinx.base.validation import line, numbers
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.solve.newton import ERROR
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State, StepControl

MIN_CUT, MIN_CUT_BY_ERROR = 2.0**-10, 2.0**-30
"""Shortest length of a step, divided by its nominal length: first for equal steps, then for adaptive steps.

Adaptive steps may have grown by several powers of ten before a slide begins, and must then shrink again.
"""
FINEST = NEAR**2
"""Length of the shortest adaptive step, divided by the present time.

Source: machine epsilon; shorter steps change only the last four digits of the time.
"""
SAFETY, SHRINKS, GROWS, KEEPS = 0.9, 0.2, 5.0, 1.2
"""Constants for the ratio of the lengths of an adaptive step and the previous step.

The ratio is `SAFETY` times a power of (tolerance / error), but at least `SHRINKS` and at most `GROWS`.  If the ratio is
between 1 and `KEEPS`, the step keeps its length.  Source: Hairer, Norsett and Wanner (1993), equation 4.13; for `KEEPS`
Hairer and Wanner (1996), IV.8.
"""
RINGS = 5e-3
"""Sudden pressure change above which a step is halved, divided by the largest pressure change so far.

SDIRK2 overshoots a jump by at most 0.21 times the jump.
"""
AGAIN = 2.0
"""A pressure change is a jump only if its rate exceeds this factor times the rate at the start of the last step."""
MOST = SAME / EPSILON
"""Largest number of output intervals.  Source: exact; `SAME` times t / `MOST` is the rounding error of t."""
RESOLVED = 10
"""Smallest `rtol`, divided by the solver's tolerance.  If `rtol` is smaller, errors of the solver dominate."""
OF_MODE = 0.081
"""True error of the motion in a step, divided by `omega dt` times the norm in `motion_error`.

Source: exact for a mode of small `omega dt`, |1/6 - 3 g^2 + 2 g^3| / (1 - g)^2 with the constant g of SDIRK2.
"""
STIFFEST = 12.0
"""Largest squared frequency of a row of cells, divided by `c^2 / h^2` with the wave speed c and the cell size h.

Source: exact for Q1 elements with consistent mass.
"""
FIRST = 1e-3
"""Smallest default length of the first adaptive step, divided by the first output interval."""


@dataclass(frozen=True)
class Adaptive:
    """Adaptive steps with limits of their length, for example `run(t_end, rtol=Adaptive(1e-3, max_step=60.0))`.

    Parameters
    ----------
    rtol
        Tolerance, see `run`.
    first_step : s
        First trial step of a new run, > 0.  The default is 18 `rtol` times the diffusion time of a cell, but at least
        0.001 times the first output interval, and at most this interval.  With inertia, it is also at most the time in
        which a wave crosses a cell.
    max_step : s
        Longest step, > 0.

    Raises
    ------
    ValueError
        `first_step` or `max_step` is not positive.
    """

    rtol: float
    first_step: float | None = None
    max_step: float = inf

    def __post_init__(self):
        if self.first_step is not None:
            numbers("first_step", self.first_step, test=lambda v: v > 0, allowed="> 0")
        numbers("max_step", self.max_step, test=lambda v: v > 0, allowed="> 0")


@dataclass(frozen=True)
class StepSize:
    """Rule for the length of the steps of a run.

    Parameters
    ----------
    first : s
        Length of the first step.
    longest : s
        Length of equal steps, or of the longest adaptive step.
    rtol
        Tolerance of adaptive steps, see `run`; None for equal steps.
    frequency : rad/s
        Upper bound of the angular frequencies of the bodies on the grid, see `highest_frequency`.
    """

    first: float
    longest: float
    rtol: float | None = None
    frequency: float = inf

    @property
    def by_error(self) -> bool:
        """Whether the steps are adaptive."""
        return self.rtol is not None

    def ended(self, t: float, target: float, control: StepControl) -> bool:
        """Return whether the time `t` has reached the time `target`, up to rounding."""
        slack = ROUND_OFF * abs(target) if self.by_error else SAME * min(control.small, self.longest)
        return target - t <= slack

    def least(self, size: float, t: float) -> float:
        """Return the length of the shortest allowed step at the time `t`, for the nominal length `size`, in s."""
        return max(MIN_CUT_BY_ERROR * size, FINEST * abs(t)) if self.by_error else MIN_CUT * size

    def preferred(self, size: float) -> float:
        """Return the nominal length of a step whose first trial has the length `size`, both in s."""
        return size if self.by_error else self.longest

    def fitted(self, left: float, small: float) -> float:
        """Return the step length `small`, adjusted to an output time that is `left` seconds away."""
        if self.by_error:  # prevents a tiny step before an output
            small = min(small, self.longest)  # `small` is longer than `longest` if an earlier run had longer steps
            return left if left <= min(1.05 * small, (1 + SAME) * self.longest) else min(small, left / 2)
        # steps that fit up to rounding have equal lengths
        return left if not left > (1 - SAME) * small else small

    def whole(self, first: float, small: float) -> float:
        """Return the length of a step that the test of overshoots may halve.

        `first`, in s: first trial length of the step.  It is shorter than the present length of the steps, `small`, if
        the step ends at an output or at a jump of the loads.
        """
        return first if first < (1 - SAME) * min(small, self.longest) else self.longest

    def refused(self, size: float, report: Report, control: StepControl, whole: float) -> float:
        """Return the factor by which a computed step must be shortened, or 1 if the step is accepted.

        `whole`: see the method of this name.
        """
        if not self.by_error:
            return 0.5 if size > 0.75 * whole and self._rings(size, report, control) else 1.0
        # most rejected steps are at jumps or kinks of the loads, where the error is of first order
        return 1.0 if self._excess(size, report, control) <= 1 else self._factor(size, report, control, 1.0)

    def next(self, size: float, report: Report, control: StepControl, failed: bool) -> float:
        """Return the length of the next trial step, in s.  `failed`: whether a longer trial did not converge."""
        if not self.by_error:
            grows = report.easy and not self._rings(size, report, control)  # twice the step would be rejected
            return max(control.small, min(2 * size, self.longest)) if grows else control.small
        factor = self._factor(size, report, control, 0.5)
        if factor >= 1:
            # a step as long as a failed step mostly fails again: in a test 78 times, with this rule once
            factor = 1.0 if factor < KEEPS or failed or not report.easy else factor
            return min(max(size * factor, control.small), self.longest)  # an output time may have shortened the step
        return size * factor

    def cut(self, size: float, control: StepControl) -> StepControl:
        """Return the step control after a step that did not converge.  The next trial is half as long."""
        whole = size > (1 - SAME) * control.small
        waits = 2 * control.waits + 1 if whole and control.kept == 0 else control.waits
        return replace(control, small=size / 2, waits=waits, kept=1)

    def grown(self, size: float, report: Report, control: StepControl, failed: bool) -> StepControl:
        """Return the step control after a completed step.

        After a reduction, the length of equal steps doubles again as soon as `waits` steps have converged.  The initial
        value of `waits` is 0.  When a doubled step fails, `waits` increases to 2 `waits` + 1.  When a doubled step
        converges, `waits` is halved.
        """
        small, whole = self.next(size, report, control, failed), size > (1 - SAME) * control.small
        if self.by_error:
            return replace(control, small=small)
        waits = control.waits // 2 if whole and control.kept == 0 else control.waits
        if small > (1 + SAME) * control.small and control.kept > waits:  # larger by more than rounding
            return replace(control, small=small, waits=waits, kept=0)
        # a step shortened to an output time does not show whether longer steps converge
        return replace(control, waits=waits, kept=control.kept + whole)

    def _rings(self, size: float, report: Report, control: StepControl) -> bool:
        """Return whether the step may have overshot a jump of the loads.

        A sudden pressure change is not a jump if pressures also changed suddenly in the last step.
        """
        excess = report.sudden - AGAIN * size * np.asarray(control.first)
        return bool((excess > np.maximum(RINGS * np.asarray(control.change), NEAR * max(control.change))).any())

    def _factor(self, size: float, report: Report, control: StepControl, power: float) -> float:
        """Return the ratio of the next step length to the present one, from the error of the present step."""
        excess = self._excess(size, report, control)
        return min(GROWS, max(SHRINKS, SAFETY / excess**power if excess > 0 else GROWS))

    def _excess(self, size: float, report: Report, control: StepControl) -> float:
        """Return the largest of three ratios of error to tolerance: for the pressure, the motion and the water content.

        If pressures dissipate within a step, their error does not affect the motion.  The tolerance of the pressure is
        therefore at least `rtol` times the pressure change that the step would cause without flow.

        In steps that resolve the highest frequency of the grid, the error of the motion is below its estimate.  The
        estimate of a step with a strike does not decrease with the length of the step, but the true error does.
        """
        error, motion = report.moves
        error *= min(1.0, OF_MODE / ERROR * self.frequency * size)
        motion = max(control.motion or 0.0, motion)
        allowed = self.rtol * max(*control.change, report.undrained)
        wrong, filled = report.fills
        errors = [
            (report.error, allowed),
            (error, self.rtol * motion),
            (wrong, self.rtol * max(control.filled, filled)),
        ]
        return max(off / least if least > 0 else 0.0 if off == 0 else inf for off, least in errors)


def measured(control: StepControl, report: Report) -> StepControl:
    """Return the step control with the largest changes of pressure, motion and water content so far."""
    change = np.maximum(np.maximum(control.change, report.change), NEAR * report.stress)
    start = control.start
    if report.extremes is not None:
        start = report.extremes[0].tolist() if start is None else start
        change = np.maximum(change, np.abs(report.extremes[1] - start).max(axis=0))
    motion = None if control.motion is None else max(control.motion, report.moves[1])
    filled = max(control.filled, report.fills[1])
    return replace(control, change=change.tolist(), start=start, motion=motion, filled=filled)


class Times:
    """Output times of a run.

    Parameters
    ----------
    start : s
        Time of the first row of the histories.
    now : s
        Time at which the run begins.
    end, interval, given, rtol
        Arguments t_end, dt, t_eval and rtol of `run`.
    goes_on
        Whether the run continues the histories of an earlier run.

    Raises
    ------
    ValueError
        An argument is invalid, t_end is not after the present time, or output intervals are below rounding errors.
    """

    def __init__(self, start: float, now: float, end, interval, given, rtol, goes_on: bool):
        more, least = (">=", now) if goes_on else (">", np.nextafter(now, inf))
        test, allowed = lambda v: (v >= least) & (v < inf), f"{more} {now:g} s and finite"
        self.end = float(numbers("t_end", end, allowed=allowed, test=test))
        if interval is None and rtol is None:
            raise ValueError("dt = None, must be given, or rtol for adaptive steps")
        if given is not None and interval is not None and rtol is not None:
            raise ValueError(
                f"dt = {line(interval)}, must be left out with rtol and t_eval, because t_eval are the output times"
            )
        self.interval, self.each = 0.0, given is None and interval is None
        """`interval`: output interval, in s; 0 if intervals are unequal.  `each`: whether every step is an output."""
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
        """Return the output times after the time `t`, including the end of the run."""
        if self._times is not None:
            return [*(time for time in self._times if t < time < self.end), *([self.end] if t < self.end else [])]
        # the last interval may be a fraction of dt
        start, dt = self.start, self.interval
        done = round((t - start) / dt)
        count = max(done + (self.end - t > SAME * dt), round((self.end - start) / dt))
        return [start + k * dt for k in range(done + 1, count)] + [self.end] * (count > done)

    def next(self, t: float) -> float:
        """Return the first output time after the time `t`, in s, plus a margin for rounding errors."""
        return max([*self.after(t)[:1], t]) + SAME * self.interval


def diffusion_time(scene: Scene, points: MaterialPoints) -> float:
    """Return the shortest diffusion time of all cells, in s, or 0 if no soil conducts."""
    if scene.fluid is None:
        return 0.0
    stored = scene.materials.table(points, lambda m: m.biot**2 / m.oedometric)
    stored = stored + scene.materials.storage(points)
    mobility = scene.materials.table(points, lambda m: m.conductivity) / scene.fluid.unit_weight
    at = mobility > 0
    h = np.broadcast_to(scene.grid.sizes_at(points.x).min(axis=-1), len(points))[at]
    least = (h**2 * (stored[at] / mobility[at])).min(initial=inf)
    least = float(over_all(scene.grid.comm, least, MPI.MIN))
    return least if isfinite(least) else 0.0


def cell_time(scene: Scene, points: MaterialPoints) -> float:
    """Return the shortest time, in s, in which a wave crosses any cell."""
    fastest = _largest(scene, points, lambda rows: scene.grid.sizes_at(rows.x).min(axis=-1))
    return 1 / fastest if fastest > 0 else inf


def highest_frequency(scene: Scene, points: MaterialPoints) -> float:
    """Return an upper bound of the angular frequencies (rad/s) of bodies on the grid."""
    return (STIFFEST * scene.grid.dim) ** 0.5 * _largest(scene, points, lambda rows: scene.grid.least)


def _largest(scene: Scene, points: MaterialPoints, size: Callable[[MaterialPoints], ArrayLike]) -> float:
    """Return the largest ratio (1/s) of wave speed to cell size of all points with a mass."""
    density = scene.materials.density(points)
    at = density > 0
    h = np.broadcast_to(size(points), len(points))[at]
    fastest = (scene.materials.confined_modulus(points)[at] / density[at] / h**2).max(initial=0.0)
    return over_all(scene.grid.comm, float(fastest), MPI.MAX) ** 0.5


def step_rule(times: Times, rtol: float | Adaptive | None, scene: Scene, state: State) -> StepSize:
    """Return the rule for the steps of a run.  Raise ValueError if arguments of the run are invalid."""
    if rtol is None:
        return StepSize(times.interval, times.interval)
    given = rtol if isinstance(rtol, Adaptive) else Adaptive(rtol)
    rtol, longest = given.rtol, float(given.max_step)
    least = RESOLVED * scene.scheme.tolerance
    numbers("rtol", rtol, test=lambda v: (least <= v) & (v < 1), allowed=f"in [{least:g}, 1), >= {RESOLVED} tolerance")
    if scene.numerics.method == "backward-euler":
        raise ValueError(f"rtol = {line(rtol)}: method backward-euler has no error estimate, the method must be sdirk2")
    timed = any("dt" in law.by_scene for law in scene.materials.laws)
    points, inertia = state.points, state.stage.inertia
    if (scene.momentum.own.rates or timed) and not scene.flows and not inertia:
        why = "without flow of fluid, velocities have no error estimate"
        raise ValueError(f"rtol = {line(rtol)}, must be left out: {why}")
    first = times.after(times.start)[0] - times.start
    if len(scene.substeps(state.stage)) > 1:  # a scene without time derivatives has no pressure error in time
        # for a load that grows from zero the relative error is ERROR dt c_v / h^2
        first = min(first, max(FIRST * first, SAFETY * rtol / ERROR * diffusion_time(scene, points)))
    if inertia:  # bodies may be released or loaded suddenly
        first = min(first, cell_time(scene, points))
    if given.first_step is not None:
        first = float(given.first_step)
    highest = highest_frequency(scene, points) if inertia else inf
    return StepSize(min(first, longest), longest, float(rtol), highest)
