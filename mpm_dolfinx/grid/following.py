# SPDX-License-Identifier: MIT
"""Grid lines that follow a tool or a function, from one reset of the grid to the next.

The number of lines never changes, and the sides of the grid do not move.  The points store the whole state when the
grid is reset, so lines may move between any two steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.base.validation import asked, called, check_names, line
from mpm_dolfinx.grid.lines import checked, equal, rounding

PLACES = ("t", "x")
"""Names of allowed parameters of a function that returns grid lines."""


def check_follow(follow: Any, lines: Sequence[ArrayLike] | None) -> None:
    """Raise ValueError if grid lines cannot follow the object `follow`, or if there are no `lines`."""
    if hasattr(follow, "pose"):
        if lines is not None and all(map(equal, checked(lines))):
            raise ValueError(f"grid: follow = {line(follow)}: all cells are equal, must be smaller around the tool")
    elif callable(follow):
        check_names("grid: follow", follow, PLACES)
    else:
        raise ValueError(f"grid: follow = {line(follow)}, must be a Tool, or a function of t, x or both")
    if lines is None:
        raise ValueError("grid: follow is given without lines; lines must be given, and their number is kept")


def lines_at(
    follow: Any, given: Sequence[NDArray[np.float64]], t: float, x: NDArray[np.float64] | None
) -> list[NDArray[np.float64]]:
    """Return the lines (m) along each axis that a user's function `follow` gives at time t (s) and positions x (n, d),
    in m.

    Along each axis, number of lines, first and last coordinate must be as in `given`, the lines at the start.
    """
    what, count = f"grid: follow at t = {t:g} s", [len(of) for of in given]
    allowed = f"{' and '.join(map(str, count))} coordinates along the axes"
    out = checked(asked(what, allowed, called, follow, {"t": t, "x": x}), what)
    if [len(of) for of in out] != count:
        raise ValueError(f"{what}: {' and '.join(str(len(of)) for of in out)} lines, must be {allowed}")
    for letter, new, old in zip("xyz", out, given, strict=False):
        if np.abs(new - old)[[0, -1]].max() > rounding(old):
            raise ValueError(
                f"{what}: lines along {letter} reach from {new[0]} to {new[-1]} m, must be from {old[0]} to {old[-1]} m"
            )
        new[[0, -1]] = old[[0, -1]]
    return out


def carried(lines: Sequence[NDArray[np.float64]], shift: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the lines (m) along each axis after the smallest cells have moved by `shift` (d,), in m.

    The smallest cells move by a whole number of cells, rounded towards zero.  Relative to these cells, a tool therefore
    moves as in a fixed grid.  On each side of the smallest cells, the size of the k-th cell (k = 1, 2, ...) is
    multiplied by the k-th power of a common factor.

    Raises
    ------
    ValueError
        The smallest cells touch a side and move along its normal, or other cells would become smaller than these cells.
    """
    out = []
    for letter, x, step in zip("xyz", lines, shift.tolist(), strict=False):
        width = np.diff(x)
        small = np.flatnonzero(width <= width.min() * (1 + SAME))
        first, last = small[0], small[-1] + 1
        step = np.trunc(step / width.min() + np.copysign(SAME, step)) * width.min()
        if step == 0 or last - first == len(width):
            out.append(x)
            continue
        low = _filled(width[:first][::-1], x[first] - x[0], step, width.min(), letter)
        high = _filled(width[last:], x[-1] - x[last], -step, width.min(), letter)
        small = x[first : last + 1] + step
        new = np.concatenate([small[0] - np.cumsum(low)[::-1], small, small[-1] + np.cumsum(high)])
        new[0], new[-1] = x[0], x[-1]
        out.append(new)
    return out


def _filled(width: NDArray[np.float64], length: float, more: float, least: float, letter: str) -> NDArray[np.float64]:
    """Return the new edge lengths of the cells between the smallest cells and a side.

    `width` (n,), m: old edge lengths.
    `length`, m: old distance between the smallest cells and the side.  The new distance is `length + more`.
    """
    what = f"grid: follow: the tool has moved by {abs(more):.3g} m along {letter}"
    if not len(width):
        raise ValueError(f"{what}, but the small cells begin at a side; there must be larger cells on both sides")
    power = np.arange(1, len(width) + 1)
    total = length + more
    if total < len(width) * least * (1 - SAME):
        allowed = f"must be at least {len(width) * least:.3g} m for the {len(width)} cells between them"
        raise ValueError(f"{what}, which leaves {total:.3g} m between the small cells and a side, {allowed}")
    factor = scipy.optimize.brentq(lambda f: float((width * f**power).sum() - total), 0.0, 1 + total / width[0])
    out = width * factor**power
    return out * (total / out.sum())
