# SPDX-License-Identifier: MIT
"""How far Newton's iterations may stray before they are called back.

The residual of a body that bends grows in good steps, for rotations stretch at first order.  Where soil yields it grows
too, mostly for the better, but iterations may also circle or run away.  Steps may raise it until the least residual so
far has stood for some of them; then the iterations go back to it and descend from there until they are below it
(watchdog technique: Chamberlain, Powell, Lemarechal and Pedersen 1982).

A step is full if the residual falls, or if the forces do less work along it at its end than half of that at its start;
else it goes to about where they do none (Matthies and Strang 1979): there points that it unloads leave their yield
surface, and the next tangent is as stiff as they are.  Shorter steps, with lower residuals, would be followed by ones
as short.

Soil that flows has next to no stiffness along its mechanisms, where flow is not associated even less than none: full
steps go far astray there.  A share of the elastic shear stiffness in the tangent, as the residual of the forces is
large, holds them back (Levenberg 1944, Marquardt 1963).  The residual of the fluid, which grows with the length of a
step, says nothing of the soil.  There is ten times as much after a step that was shortened to next to nothing, a tenth
after a full one to the least residual so far.  If it went with each full step, the next one would be as short as
before, and the iterations would circle.  Soil that has not yielded gets the share too: where it does so for the first
time it flows as far.  Only while nothing has yielded before, and each step brings the residual to less than a
tenth, tangents stay as they are: wet elastic soil takes 1.6 times the Newton steps with firmer ones.

Where a few points flow and their tangent has less than no stiffness, Newton's direction leads backwards: it unloads
them, the next step loads them again, and the iterations circle between the two.  There the residuals do negative work
along it, and the step goes the other way.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

EXPLODES = 1e4
"""Growth of the residual from which on a step is shortened: that of a bending body may grow as much in a good one."""
PATIENCE = 6
"""Steps that may pass without a residual below the least so far."""
SHORTEST, SHORTEST_DESCENT = 1e-3, 0.1
"""Share of a step below which it is not shortened, and below which a descent does not shorten it."""
WORK, STEEPER, TRIES = 0.5, 2.0, 6
"""Work along a step, over that at its start, that it may end with, and that tells that it is too long; most tries."""
LARGEST = sys.float_info.max
FIRM, FIRMEST = 0.1, 0.1
"""Share of the elastic shear stiffness over the residual that is added to a tangent where soil yields, and its most."""
SHORT, LONG, FIRMER, MOST = 0.15, 0.9, 10.0, 1e4
"""Steps below which and from which on tangents become firmer and less firm, by which factor, and the most in all."""
EASY = 0.1
"""Fall of the residual in a step up to which tangents of soil that has not yielded before stay as they are."""
RECENT, FALLS = 8, 0.1
"""Steps in which the least residual falls to what share lets iterations go on beyond the most that there may be."""


@dataclass(frozen=True)
class Watchdog:
    """Watches the iterations where soil yields.

    least: least residual so far; where: (u, p) there; since: steps since; descends: whether they were called back;
    firm: by how much the tangents are firmer than usual; leasts: least residuals so far, of recent steps; eases:
    whether no soil had yielded before and each step so far has brought the residual to less than a tenth.
    """

    least: float
    where: list[NDArray[np.float64]]
    since: int = 0
    descends: bool = False
    firm: float = 1.0
    leasts: tuple[float, ...] = ()
    eases: bool = False

    def limit(self, residual: float) -> float:
        """Return what the next step may make of a residual."""
        return min(residual, LARGEST) if self.descends else np.inf

    def after(self, residual: float, step: float, iterate: Callable[[], list[NDArray[np.float64]]]) -> Watchdog:
        """Return what is known after such a share of a Newton step to a residual at (u, p) = iterate()."""
        falls, short = residual < self.least, step < SHORT
        firm = self.firm * FIRMER if short else self.firm / FIRMER if falls and step >= LONG else self.firm
        leasts, eases = (*self.leasts, self.least)[-RECENT:], self.eases and residual < EASY * self.least
        now = replace(self, firm=min(MOST, max(1.0, firm)), leasts=leasts, eases=eases)
        if falls:
            return replace(now, least=residual, where=iterate(), since=0, descends=False)
        return replace(now, since=self.since + 1)

    @property
    def converges(self) -> bool:
        """Whether the least residual has fallen in recent steps."""
        return len(self.leasts) == RECENT and self.least < FALLS * self.leasts[0]

    def strays(self, residual: float) -> bool:
        """Return whether the iterations are to go back to the least residual, and to descend from there."""
        runs_away = not residual <= min(EXPLODES * self.least, LARGEST)
        return not self.descends and (runs_away or self.since >= PATIENCE)

    def firmness(self, residual: float) -> float:
        """Return the share of the elastic shear stiffness that is added to the tangent at a residual of the forces."""
        return 0.0 if self.eases else min(FIRMEST, self.firm * FIRM * residual)


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

    def after(self, work: float, falls: bool = False) -> Search | None:
        """Return the next step to try after one that ends with such a work, nan if that is not finite; None: none.

        falls: whether the residual is lower there.  Of a full step that is enough.  A shorter one that ends before the
        work turns leaves the points that it would unload on their yield surface, with their soft tangent: the next
        steps would be as short.
        """
        full = self.high is None
        if abs(work) <= WORK or self.tries == TRIES or (full and falls and work >= -STEEPER):
            return None
        low, high = self.low, self.high
        if WORK < work <= STEEPER:
            low = self.step, work
        else:
            high = self.step, work
        if high is None:
            return None
        share = np.sqrt(low[1] / (low[1] - high[1])) if high[1] < 0 else 0.2  # beyond the turn it grows ever faster
        return Search(low[0] + min(0.8, max(0.1, share)) * (high[0] - low[0]), low, high, self.tries + 1)


@dataclass(frozen=True)
class Descent:
    """Backtracking along a step until the residual is no larger than a limit.

    before: residual at its start; limit, most: what it may be at its end, and at least has to be below; shortest: share
    of the step below which it is not shortened; by_half: how it is shortened, else see `shortened`; step: share to try;
    best: least residual so far, and its share; settles: whether the best one is taken now.
    """

    before: float
    limit: float
    most: float
    shortest: float
    by_half: bool
    step: float = 1.0
    best: tuple[float, float] = (np.inf, 1.0)
    settles: bool = False

    @classmethod
    def of(cls, before: float, dog: Watchdog | None) -> Descent:
        """Return the search from a residual, by a watchdog that wants it to descend, or without one."""
        most = min(EXPLODES * before, LARGEST)
        if dog is None:
            return cls(before, most, most, SHORTEST, by_half=True)
        return cls(before, dog.limit(before), most, SHORTEST_DESCENT, by_half=False)

    def ends(self, residual: float) -> bool:
        """Return whether the search may end with a residual."""
        return residual <= self.limit or self.settles

    def after(self, residual: float) -> Descent | None:
        """Return the search with the next step to try; None: it has ended, or there is no descent."""
        if self.ends(residual):
            return None
        best = min(self.best, (residual, self.step))
        step = self.step * (0.5 if self.by_half else shortened(residual / self.before, self.step))
        if step >= self.shortest:
            return replace(self, step=step, best=best)
        return replace(self, step=best[1], settles=True, best=best) if best[0] <= self.most else None
