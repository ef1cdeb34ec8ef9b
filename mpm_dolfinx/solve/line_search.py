# SPDX-License-Identifier: MIT
"""Line search: length of a Newton step.

Without yield, a Newton step is halved in two cases: a law cannot be evaluated at its end, or the residual grows by more
than the factor `EXPLODES`.

In yielding soil, the criterion is the work of the residuals along the step.  A full step is accepted in two cases: if
the work at its end is less than half of the initial work, or if neither residual nor work increase.  In all other
cases, bracketed secants find the step length at which the work is zero.  The secants end when the work is less than
half of the initial work (Matthies and Strang 1979).  A step with negative initial work is reversed.

In yielding soil, full steps overshoot.  The tangent is therefore regularised by a fraction of the elastic shear
stiffness, proportional to the relative residual of the forces (Levenberg 1944, Marquardt 1963).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

SHORTEST = 1e-3
"""Smallest length of a step, as a fraction of the full Newton step.  Sensitivity (scene "tool" of tests/plateaus.py):
half this value changes the result by 1.2e-03, and twice this value by 0.0e+00.  Finer cells change it by 7.1e-02.
"""
EXPLODES = 1e4
"""Largest factor by which the residual may grow in a step without yield.

With 1e3 or 1e5 in place of 1e4, scenes take the same steps.
"""
WORK = 0.5
"""Largest ratio of the work at the end of an accepted step to the work at its start.

Source: Matthies and Strang (1979).
"""
SHIFT = 0.1
"""Fraction of the elastic shear stiffness that regularises the tangent of yielding soil, divided by the relative
residual.

A footing on 9 cells takes 291 Newton steps with 0.05, 293 with 0.1, and 293 with 0.2. Pushed ground takes 42 Newton
steps with 0.05, 41 with 0.1, and 43 with 0.2.
"""


@dataclass(frozen=True)
class Halving:
    """Search for the step length in soil that does not yield.

    `step`: next trial, as a fraction of the full step.
    """

    step: float = 1.0
    limit = EXPLODES
    """Largest factor by which the residual may grow in a step."""

    def after(self, work: float, growth: float) -> Halving | None:
        """Return the next trial, or None if the search ends.

        `growth`: growth factor of the residual in the last trial.
        """
        ends = growth <= self.limit or self.step < 2 * SHORTEST
        return None if ends else Halving(0.5 * self.step)


@dataclass(frozen=True)
class Search:
    """Search for a step length in yielding soil, by the work of the residuals."""

    step: float = 1.0  # next trial, as a fraction of the full step
    low: float = 0.0  # the work changes its sign between `low` and `high`
    at_low: float = 1.0  # work at `low`, divided by the initial work
    high: float = np.inf
    at_high: float = np.nan  # work at `high`, divided by the initial work
    ends: bool = False  # whether the next step is the last trial
    limit = sys.float_info.max
    """Largest factor by which the residual may grow in a step."""

    def after(self, work: float, growth: float) -> Search | None:
        """Return the next trial, or None if the search ends.

        `work`: work in the last trial divided by the initial work, or nan.
        `growth`: growth factor of the residual in the last trial.
        """
        if not np.isfinite(work):
            end = self.step < 2 * SHORTEST
            return None if end else Search(0.5 * (self.low + self.step), self.low, self.at_low, self.step)
        enough = 1.0 if growth <= 1 and self.step == 1 else WORK
        if self.ends or abs(work) <= enough or self.high - self.low < SHORTEST:
            return None
        if work > 0 and np.isinf(self.high):
            return Search(0.5 * self.step, ends=True)
        if work > 0:
            bounds, stays = (self.step, work, self.high, self.at_high), self.low > 0
        else:
            bounds, stays = (self.low, self.at_low, self.step, work), np.isfinite(self.at_high)
        low, at_low, high, at_high = bounds
        share = 0.5 if stays or np.isnan(at_high) else at_low / (at_low - at_high)
        return Search(low + share * (high - low), *bounds)
