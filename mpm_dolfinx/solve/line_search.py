# SPDX-License-Identifier: MIT
"""Line search: length of a Newton step, see `Newton._line_search`.

Without yield the step is full, even if the residual grows, because linearised rotations of a bending body cause a
spurious stretch. The step is halved while a law cannot be evaluated at its end, or the residual grows enormously.

In yielding soil the step is full if the residual forces at its end do less than half of their initial work along it, or
if the residual falls and they do at most all of this work. Otherwise bracketed secants look for the step length at
which the work is zero. They end at less than half of the initial work (Matthies and Strang 1979): nearer to zero, soil
may unload, and is then elastic in the next tangent. The work of the fluid's residual is added, because forces do nearly
no work if only the fluid is out of balance. Shorter steps with smaller residuals would lead to more short steps.
Soil that has lost its strength needs several secants: with one secant, a slumping bank takes twice the Newton steps.

Flowing soil has almost no stiffness along its mechanisms, and negative stiffness with non-associated flow: full steps
overshoot far. The tangent is therefore regularised by a fraction of the elastic shear stiffness, proportional to the
relative residual of the forces (Levenberg 1944, Marquardt 1963). The residual of the fluid is not used: it grows with
the step length for any soil. Soil that has not yielded is regularised too, because full steps overshoot just as far
when this soil first yields. Before any soil yields there is no regularisation while the tangents converge: with
regularisation, wet elastic soil would take 1.6 times the Newton steps.

A few flowing points may give the tangent a negative stiffness. Newton's direction then leads backwards: it unloads
these points, the next step loads them again, and the iterations cycle. The work of the residuals along the direction is
then negative, and the step is reversed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

EXPLODES, SHORTEST = 1e4, 1e-3
"""Largest growth of the residual in a step without yield, and smallest fraction of the full step.

With 1e3 or 1e5 as largest growth, scenes take the same steps: the growth is below 1e3, or the residual is not finite.
"""
WORK = 0.5
"""Largest ratio of the work at the end of a step to the work at its start (Matthies and Strang 1979)."""
FIRM = 0.1
"""Fraction, <= 1, of elastic shear stiffness in the tangent of yielding soil, divided by the relative residual.

With 0.05, 0.1 and 0.2 a footing on 9 cells takes 291, 293 and 293 Newton steps; pushed ground takes 42, 41 and 43.
"""


@dataclass(frozen=True)
class Halving:
    """Search without yield; step: next trial, as a fraction of the full step."""

    step: float = 1.0
    limit = EXPLODES
    """Largest growth of the residual at the end of a step."""

    def after(self, work: float, growth: float) -> Halving | None:
        """Return the next trial after one in which the residual grew by a factor `growth`; None if the search ends."""
        ends = growth <= self.limit or self.step < 2 * SHORTEST
        return None if ends else Halving(0.5 * self.step)


@dataclass(frozen=True)
class Search:
    """Search for a step at whose end the residuals do less than half of their initial work."""

    step: float = 1.0  # next trial, as a fraction of the full step
    low: float = 0.0  # from `low` to `high` the work changes its sign
    at_low: float = 1.0  # work at `low`, divided by the initial work
    high: float = np.inf
    at_high: float = np.nan  # work at `high` / initial work
    ends: bool = False  # whether the next step is the last trial
    limit = sys.float_info.max
    """Largest growth of the residual at the end of a step."""

    def after(self, work: float, growth: float) -> Search | None:
        """Return the next trial, or None if the search ends; work: last trial's work / initial work, or nan.

        growth: factor by which the residual grew. A full step that does not increase the residual ends the search if
        |work| <= 1. A secant gives the next trial, or bisection if the same bound stays twice.
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
