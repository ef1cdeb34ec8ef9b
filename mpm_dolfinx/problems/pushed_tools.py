# SPDX-License-Identifier: MIT
"""Tools that a load pushes: how far they go is found where the bodies resist with as much.

What a tool meets grows with its way, but with a slope that only the bodies know: at first that of the contact alone,
which is too steep, then the secant of the last two ways that balanced.  It stays between the farthest way that met too
little and the nearest that met too much.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.errors import NotConverged

CLOSE = 1e-6  # of the load: what bodies may resist with more or less
FAR, FAR_FROM = 0.85, 4.0  # share of a secant's step that is taken, if it is so many times the last: contacts stiffen
MOST = 50  # ways that are tried
STRIDE = 0.1  # cells: the farthest that a tool goes between two tries
BEGINS, REACH = 1e-3, 1.0  # cells: how far it goes where it touches nothing, at first and in all


class PushedTools:
    """The ways of k tools in a substep, beside their own displacement; they change as it is solved.

    Parameters
    ----------
    names : (k,)
        What errors call them.
    ways : (k,), m
        At the start of the step.
    loads : (k,), N
        At the end of the substep; nan for tools that no load pushes.
    h
        Size of a cell, m.
    """

    def __init__(self, names: list[str], ways: NDArray[np.float64], loads: NDArray[np.float64], h: float):
        self._names, self.start, self.loads, self._h = names, ways, loads, h
        self.ways = ways.copy()
        self._last = np.full((2, len(ways)), np.nan)  # way that balanced last, and what it met less the load
        self._ends = np.stack([np.full_like(ways, -np.inf), np.full_like(ways, np.inf)])
        self._count = np.zeros(1, dtype=int)

    def go(self, met: NDArray[np.float64], slope: NDArray[np.float64]) -> bool:
        """Go on, from ways that balance and meet (k,), N; return whether there is another way to balance.

        slope : (k,), N/m, by which the contact alone resists.

        Raises
        ------
        NotConverged
            A tool that a load pushes meets nothing, or no way has been found.
        """
        off = met - self.loads
        open_ = np.flatnonzero(np.abs(off) > CLOSE * self.loads)  # never of those whose load is nan
        if not len(open_):
            return False
        self._count[0] += 1
        for k in open_:
            if self._count[0] > MOST:
                what = f"is pushed by {self.loads[k]:.6g} N and meets {met[k]:.6g} N after {MOST} tries"
                raise NotConverged(f"{self._names[k]}: {what}: do the bodies hold it?")
            self._ends[int(off[k] > 0), k] = self.ways[k]
            way = self.ways[k] + np.clip(self._step(k, off[k], slope[k]), -STRIDE * self._h, STRIDE * self._h)
            low, high = self._ends[:, k]
            if not low < way < high:
                way = (low + high) / 2
            self._last[:, k] = self.ways[k], off[k]
            self.ways[k] = way
        return True

    def _step(self, k: int, off: float, slope: float) -> float:
        """Return the way to go on by, m."""
        way, before = self._last[:, k]
        last = self.ways[k] - way
        secant = (off - before) / last if last else np.nan
        if secant > 0:
            step = -off / secant
            return step * (FAR if abs(step) > FAR_FROM * abs(last) else 1.0)
        if slope > 0:
            return -off / slope
        gone = self.ways[k] - self.start[k]
        if gone > REACH * self._h:
            raise NotConverged(f"{self._names[k]}: is pushed by {self.loads[k]:.6g} N and meets nothing within a cell")
        return max(BEGINS * self._h, gone)
