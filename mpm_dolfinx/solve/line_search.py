# SPDX-License-Identifier: MIT
"""Line search: the length of a Newton step, see `Newton._line_search`.

Without yield the step is full, even if the residual grows: rotations of a bending body cause a spurious stretch at
first order. It is halved while a law cannot be evaluated at its end, or the residual explodes.

In yielding soil the step is full if the residual falls, or if the forces at its end do less than half of the initial
work along it. Otherwise the search ends where they do about none (Matthies and Strang 1979). Points that the step
unloads leave their yield surface there, and the next tangent is as stiff as they are. The work includes the fluid's
work: the work of the forces alone nearly vanishes where these are in equilibrium and the fluid is not. Shorter steps
with smaller residuals would lead to more short steps. Bracketed secants find the point. Soil that has lost its strength
needs several: with one, a slumping bank takes twice the Newton steps.

Flowing soil has almost no stiffness along its mechanisms, and negative stiffness with non-associated flow: full steps
overshoot far. The tangent is therefore regularised by a fraction of the elastic shear stiffness, proportional to the
residual of the forces (Levenberg 1944, Marquardt 1963). The residual of the fluid does not count: it grows with the
step length, and says nothing about the soil. Soil that has not yielded is regularised too: it flows as far when it
first yields. There is no regularisation before the first yield while the tangents converge: it would cost wet elastic
soil 1.6 times the Newton steps.

A few flowing points may have a tangent with negative stiffness. Newton's direction then leads backwards: it unloads
them, the next step loads them again, and the iterations cycle. The residuals do negative work along it, and the step is
reversed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

EXPLODES, SHORTEST = 1e4, 1e-3
"""Growth of the residual at which a step is halved without yield, and smallest fraction of the step.

With 1e3 and 1e5 scenes take the same steps: the growth is below them, or the residual not finite.
"""
WORK = 0.5
"""Largest work at the end of a step, divided by the work at its start (Matthies and Strang 1979)."""
FIRM = 0.1
"""Fraction of elastic shear stiffness in the tangent of yielding soil, per unit of relative residual, at most 1.

With 0.05 and 0.2 a footing on 9 cells takes 291 and 293 Newton steps, pushed ground 42 and 43, with 0.1 293 and 41.
"""


@dataclass(frozen=True)
class Halving:
    """Search without yield; step: the next trial, as a fraction of the full step."""

    step: float = 1.0
    limit = EXPLODES
    """Largest growth of the residual at the end."""

    def after(self, work: float, growth: float) -> Halving | None:
        """Return the next trial after one that multiplies the residual by `growth`; None: the search has ended."""
        ends = growth <= self.limit or self.step < 2 * SHORTEST
        return None if ends else Halving(0.5 * self.step)


@dataclass(frozen=True)
class Search:
    """Search for a step with less than half of the initial work of the residuals at its end.

    step: the next trial; low, high: steps between which the work changes its sign; at_low, at_high: work there /
    initial work; ends: whether the next step is the last one.
    """

    step: float = 1.0
    low: float = 0.0
    at_low: float = 1.0
    high: float = np.inf
    at_high: float = np.nan
    ends: bool = False
    limit = sys.float_info.max
    """Largest growth of the residual at the end."""

    def after(self, work: float, growth: float) -> Search | None:
        """Return the next trial after one with this relative work, nan if it is not finite; None: the search has ended.

        growth: growth of the residual. A full step that does not increase the residual may end with up to the initial
        work. A secant gives the next trial; bisection gives it where a bound stays for a second time.
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
