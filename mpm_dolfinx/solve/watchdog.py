# SPDX-License-Identifier: MIT
"""How far Newton's iterations may stray before they are called back.

The residual of a body that bends grows in good steps, for rotations stretch at first order.  Where soil yields it grows
too, mostly for the better, but iterations may also circle or run away.  Steps may raise it until the least residual so
far has stood for some of them; then the iterations go back to it and descend from there until they are below it
(watchdog technique: Chamberlain, Powell, Lemarechal and Pedersen 1982).

A step that raises the residual is full only if the forces do less work along it at its end than half of that at its
start; else it goes about as far as where they do none (Matthies and Strang 1979).

Soil that flows has next to no stiffness along its mechanisms, where flow is not associated even less than none: full
steps go far astray there.  A share of the elastic shear stiffness in the tangent, as the residual is large, holds them
back (Levenberg 1944, Marquardt 1963).  A footing of 21 cells, pushed by 0.07 widths in 5 steps, takes 1 cut, not 4, and
313 tangents, not 405.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

EXPLODES = 1e4
"""Growth of the residual from which on a step is shortened: that of a bending body may grow as much in a good one."""
PATIENCE = 3
"""Steps that may pass without a residual below the least so far."""
SHORTEST_DESCENT = 0.1
"""Share of a step below which a descent does not shorten it."""
WORK, STEEPER, TRIES = 0.5, 2.0, 4
"""Work along a step, over that at its start, that it may end with, and that tells that it is too long; most tries."""
LARGEST = sys.float_info.max
FIRM, FIRMEST = 0.1, 0.1
"""Share of the elastic shear stiffness over the residual that is added to a tangent where soil yields, and its most."""


@dataclass(frozen=True)
class Watchdog:
    """Watches the iterations where soil yields.

    least: least residual so far; where: (u, p) there; since: steps since; descends: whether they were called back.
    """

    least: float
    where: list[NDArray[np.float64]]
    since: int = 0
    descends: bool = False

    def limit(self, residual: float) -> float:
        """Return what the next step may make of a residual."""
        return min(residual, LARGEST) if self.descends else np.inf

    def after(self, residual: float, iterate: Callable[[], list[NDArray[np.float64]]]) -> Watchdog:
        """Return what is known after a step to a residual at (u, p) = iterate()."""
        if residual < self.least:
            return Watchdog(residual, iterate())
        return replace(self, since=self.since + 1)

    def strays(self, residual: float) -> bool:
        """Return whether the iterations are to go back to the least residual, and to descend from there."""
        runs_away = not residual <= min(EXPLODES * self.least, LARGEST)
        return not self.descends and (runs_away or self.since >= PATIENCE)


def firmness(residual: float) -> float:
    """Return the share of the elastic shear stiffness that is added to the tangent at a relative residual."""
    return min(FIRMEST, FIRM * residual)


def shortened(growth: float, step: float) -> float:
    """Return by how much to shorten a step after which the residual has grown by a factor, from a tenth to a half.

    To where the parabola through both squared residuals is least whose slope at first is Newton's, -2.
    """
    if not growth < LARGEST:
        return 0.5
    return min(0.5, max(0.1, step / (growth**2 - 1 + 2 * step)))


@dataclass(frozen=True)
class Search:
    """Search for a step along which the forces do next to no work at its end.

    step: the one to try; low, high: too short and too long ones, each with the work at its end over that at its start;
    tries: how many there have been.
    """

    step: float = 1.0
    low: tuple[float, float] = (0.0, 1.0)
    high: tuple[float, float] | None = None
    tries: int = 1

    def after(self, work: float) -> Search | None:
        """Return the next step to try after one that ends with such a work, nan if that is not finite; None: none."""
        if abs(work) <= WORK or self.tries == TRIES:
            return None
        low, high = self.low, self.high
        if WORK < work <= STEEPER:
            low = self.step, work
        else:
            high = self.step, work
        if high is None:
            return None
        share = low[1] / (low[1] - high[1]) if high[1] < 0 else 0.2
        return Search(low[0] + min(0.9, max(0.1, share)) * (high[0] - low[0]), low, high, self.tries + 1)
