# SPDX-License-Identifier: MIT
"""Tools that a load pushes: how far they go is found where the bodies resist with as much.

What tools meet grows with their ways, but with slopes that only the bodies know: at first those of the contact alone,
which are too steep, then those that the ways that have balanced tell: the secant of one tool, the update of Broyden,
Fletcher, Goldfarb and Shanno (1970) of several, which press on one another through the bodies.  A single tool stays
between the farthest way that met too little and the nearest that met too much.  Bodies go along as they did between the
last two ways: left behind, they would jump off a tool that goes back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged

CLOSE = 1e-6  # of the load: what bodies may resist with more or less
FAR, FAR_FROM = 0.85, 4.0  # share of a secant's step that is taken, if it is so many times the last: contacts stiffen
SOFTER = 0.1  # slopes, where the balance cannot tell one way from the next
MOST = 50  # ways that are tried
STRIDE = 0.1  # cells: the farthest that a tool goes between two tries
BEGINS, REACH = 1e-3, 1.0  # cells: how far it goes where nothing resists, at first and in all
LEAST = 1e-300


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
        self._of = np.flatnonzero(~np.isnan(loads))  # what follows is of these alone
        n = len(self._of)
        self._slopes = np.zeros((n, n))  # of what each meets by each way, N/m
        self._pairs = np.zeros(1, dtype=int)  # of ways that slopes have been learned from
        self._seen: dict[bytes, tuple[NDArray, NDArray]] = {}  # last ways with each set in touch; what met too much
        self._touched = np.full(n, np.nan)  # last way in touch
        self._ends = np.array([-np.inf, np.inf])  # of a single one
        self._balanced: list[NDArray[np.float64]] = []  # ways that balanced last, and the displacements there
        self._count = np.zeros(1, dtype=int)

    def go(
        self,
        u: NDArray[np.float64],
        met: NDArray[np.float64],
        slope: NDArray[np.float64],
        unknown: NDArray[np.float64],
    ) -> bool:
        """Go on, from ways that balance and meet (k,), N; return whether there are other ways to balance.

        Parameters
        ----------
        u : (nodes, d), m
            Displacements, which go along.
        slope : (k,), N/m
            By which the contact alone resists.
        unknown : (k,), N
            How well the balance tells what they meet.

        Raises
        ------
        NotConverged
            A tool that a load pushes meets nothing, or no ways have been found.
        """
        met, slope, unknown, loads = (values[self._of] for values in (met, slope, unknown, self.loads))
        off, touches, before = met - loads, (slope > 0) | (met != 0), self.ways.copy()
        wrong = (np.abs(off) > np.maximum(CLOSE * loads, unknown)) | (~touches & (loads > 0))
        if not wrong.any():
            return False
        self._count[0] += 1
        if self._count[0] > MOST:
            k = np.argmax(wrong * np.abs(off))
            raise self._lost(k, f"meets {met[k]:.6g} N after {MOST} tries: do the bodies hold it?")
        step = self._seek(touches, loads)
        if touches.any():
            step[touches] = self._resisted(off, slope, touches, unknown)
        step *= min(1.0, STRIDE * self._h / max(np.abs(step).max(), LEAST))
        self.ways[self._of] = self._between(self.ways[self._of], step, off)
        self._lead(u, before)
        return True

    def _lost(self, k: int, why: str) -> NotConverged:
        k = self._of[k]
        return NotConverged(f"{self._names[k]}: is pushed by {self.loads[k]:.6g} N and {why}")

    def _resisted(
        self, off: NDArray[np.float64], slope: NDArray[np.float64], on: NDArray[np.bool_], unknown: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the ways to go on by, m, of those tools that touch."""
        ways, far = self.ways[self._of], np.abs(self.ways - self.start)[self._of]
        alone = np.where(slope > 0, slope, np.abs(off) / np.maximum(far, BEGINS * self._h))
        softer = np.diag(self._slopes) / np.maximum(alone, LEAST)
        new = on & (softer == 0)
        self._slopes[new, new] = np.maximum(min([1.0, *softer[softer > 0]]) * alone, LEAST)[new]
        last, of = self._seen.get(on.tobytes(), (ways[on], off[on]))
        gone, more = ways[on] - last, off[on] - of
        self._seen[on.tobytes()], self._touched[on] = (ways[on], off[on]), ways[on]
        if gone.any() and not (np.abs(more) > unknown[on]).any():
            self._slopes[:] *= SOFTER
        elif gone @ more > 0:
            self._learn(np.ix_(on, on), gone, more)
        elif gone.any():
            for k in np.flatnonzero(on & (slope == 0) & (far > REACH * self._h))[:1]:
                met = self.loads[self._of[k]] + off[k]
                raise self._lost(k, f"meets {met:.6g} N, a cell farther too: do the bodies hold it?")
        step = -np.linalg.solve(self._slopes[np.ix_(on, on)], off[on])
        jumps = gone.any() and np.abs(step).max() > FAR_FROM * np.abs(gone).max()
        return step * (FAR if jumps else 1.0)

    def _learn(self, at: tuple[NDArray, NDArray], gone: NDArray[np.float64], more: NDArray[np.float64]) -> None:
        """Learn slopes of some tools from how much more they meet, N, where they have gone on, m."""
        slopes = self._slopes[at]
        if not self._pairs[0]:
            slopes = slopes * (gone @ more / (gone @ slopes @ gone))
        self._pairs[0] += 1
        known = slopes @ gone
        self._slopes[at] = slopes + np.outer(more, more) / (gone @ more) - np.outer(known, known) / (gone @ known)

    def _seek(self, touches: NDArray[np.bool_], loads: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the ways to go on by, m, of loaded tools that touch nothing, else zero."""
        step, seeks = np.zeros(len(loads)), ~touches & (loads > 0)
        gone, back = (self.ways - self.start)[self._of], self._touched - self.ways[self._of]
        for k in np.flatnonzero(seeks & ~(back > 0) & (gone > REACH * self._h))[:1]:
            raise self._lost(k, "meets nothing within a cell: does it begin where it touches the bodies?")
        step[seeks] = np.where(back > 0, back / 2, np.maximum(BEGINS * self._h, gone))[seeks]
        return step

    def _between(self, ways: NDArray, step: NDArray, off: NDArray) -> NDArray[np.float64]:
        """Return the next ways, m; that of a single tool is no farther than where it met too much, nor less far."""
        if len(ways) > 1:
            return ways + step
        self._ends[int(off[0] > 0)] = ways[0]
        low, high = self._ends
        inside = low < ways[0] + step[0] < high or not np.isfinite(high - low)
        return ways + step if inside else np.array([(low + high) / 2])

    def _lead(self, u: NDArray[np.float64], ways: NDArray[np.float64]) -> None:
        """Let bodies that balance at u with these ways go along as they did since the balance before."""
        balanced = ways, u.copy()
        if self._balanced:
            last, of = self._balanced
            gone = ways - last
            u += np.clip((self.ways - ways) @ gone / max(gone @ gone, LEAST), -1, 1) * (u - of)
        self._balanced[:] = balanced
