# SPDX-License-Identifier: MIT
"""How far a Newton step goes.

Where nothing yields it goes all the way, also if the residual grows: rotations of a body that bends stretch it at first
order.  It is halved while a law cannot be evaluated at its end, or the residual explodes.

Where soil yields a step is full if the residual falls, or if the forces do less work along it at its end than half of
that at its start; else it goes to about where they do none (Matthies and Strang 1979): there points that it unloads
leave their yield surface, and the next tangent is as stiff as they are.  Work is that of the forces and of the fluid:
that of the forces alone is next to none where these balance and the fluid does not.  Shorter steps, with lower
residuals, would be followed by ones as short.  Bracketed secants find it.  Soil that has lost its strength needs
several: with one, a bank that slumps takes twice the Newton steps.

Soil that flows has next to no stiffness along its mechanisms, where flow is not associated even less than none: full
steps go far astray there.  A share of the elastic shear stiffness in the tangent, as the residual of the forces is
large, holds them back (Levenberg 1944, Marquardt 1963).  The residual of the fluid, which grows with the length of a
step, says nothing of the soil.  Soil that has not yielded gets the share too: where it does so for the first time it
flows as far.  Only while nothing has yielded before, and the tangents serve on, they stay as they are: wet elastic soil
takes 1.6 times the Newton steps with firmer ones.

Where a few points flow and their tangent has less than no stiffness, Newton's direction leads backwards: it unloads
them, the next step loads them again, and the iterations circle between the two.  There the residuals do negative work
along it, and the step goes the other way.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

EXPLODES, SHORTEST = 1e4, 1e-3
"""Growth of the residual from which on a step is halved where nothing yields, and the least share of it.

With 1e3 and 1e5 scenes take the same steps: the growth is below them, or the residual not finite.
"""
WORK = 0.5
"""Work along a step, over that at its start, that it may end with (Matthies and Strang 1979)."""
FIRM = 0.1
"""Share of the elastic shear stiffness over the residual, at most 1, that is added to a tangent where soil yields.

With 0.05 and 0.2 a footing on 9 cells takes 291 and 293 Newton steps, pushed ground 42 and 43, with 0.1 293 and 41.
"""


@dataclass(frozen=True)
class Halving:
    """Search where nothing yields; step: the share to try."""

    step: float = 1.0
    limit = EXPLODES
    """What the residual may have grown by at its end."""

    def after(self, work: float, growth: float) -> Halving | None:
        """Return the next step to try after one with which the residual grows by a factor; None: it has ended."""
        ends = growth <= self.limit or self.step < 2 * SHORTEST
        return None if ends else Halving(0.5 * self.step)


@dataclass(frozen=True)
class Search:
    """Search for a step at whose end the residuals do less work than half of that at its start.

    step: the one to try; low, high: steps between which the work changes its sign; at_low, at_high: the work there,
    over that at the start; ends: whether the next step is the last one.
    """

    step: float = 1.0
    low: float = 0.0
    at_low: float = 1.0
    high: float = np.inf
    at_high: float = np.nan
    ends: bool = False
    limit = sys.float_info.max
    """What the residual may have grown by at its end."""

    def after(self, work: float, growth: float) -> Search | None:
        """Return the next step to try after one that ends with such a work, nan if that is not finite; None: none.

        growth: of the residual.  If a full step does not raise it, it is enough that the residuals do no more work than
        at its start.  A secant gives the next step; the middle does where a bound stays for a second time.
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
