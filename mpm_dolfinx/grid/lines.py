# SPDX-License-Identifier: MIT
"""Grid lines: checks of lines, and lines of graded grids, whose cells grow with the distance from fine boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.tolerances import EPSILON, SAME
from mpm_dolfinx.base.validation import line, numbers

MOST = 2**31 - 1
"""Largest number of unknowns that PETSc's 32-bit integers allow."""


def rounding(x: NDArray[np.float64]) -> float:
    """Return the largest rounding error, in m, of coordinates as large as x, in m."""
    return 8 * EPSILON * float(np.abs(x).max(initial=0.0))


def checked(lines: Sequence[ArrayLike], what: str = "grid") -> list[NDArray[np.float64]]:
    """Return grid lines (n,), in m, along two or three axes as arrays.  Raise ValueError for invalid lines."""
    if not isinstance(lines, Sequence | np.ndarray) or len(lines) not in (2, 3):
        raise ValueError(f"{what}: lines = {line(lines)}, must be 2 or 3 lists of coordinates, one for each axis")
    out = []
    for letter, places in zip("xyz", lines, strict=False):
        allowed = "at least 2 finite coordinates, each > the one before"
        x = numbers(f"{what}: lines along {letter}", places, None, allowed=allowed)
        if x.ndim != 1 or len(x) < 2 or not (np.diff(x) > 0).all():
            raise ValueError(f"{what}: lines along {letter} = {line(places)}, must be {allowed}")
        if np.diff(x).min() <= rounding(x) / SAME:
            least = f"smallest spacing {np.diff(x).min():.3g} m, must be > {rounding(x) / SAME:.3g} m for rounding"
            raise ValueError(f"{what}: lines along {letter}: {least}")
        out.append(x)
    return out


def equal(x: NDArray[np.float64]) -> bool:
    """Return whether lines (n,), m, are equally spaced except for rounding errors."""
    return bool(np.abs(x - np.linspace(x[0], x[-1], len(x))).max() <= rounding(x))


def graded(
    lower: ArrayLike,
    upper: ArrayLike,
    fine: Sequence[ArrayLike],
    size: ArrayLike,
    ratio: float = 1.1,
    largest: float = np.inf,
) -> list[NDArray[np.float64]]:
    """Return grid lines with small cells in fine boxes.  Other cells grow with the distance from these boxes.

    Lines cross the whole grid, so cells in the rows and columns of a fine box are as narrow as cells in the box.

    Parameters
    ----------
    lower, upper : (d,), m
        Lower and upper corner of the grid; d = 2 or 3.
    fine : (boxes, 2, d), m
        Lower and upper corners of at least one fine box.  Boxes must be inside the grid.  Small cells also fill gaps
        narrower than `size` between two boxes, or between a box and a side.
    size : number or (d,), m
        Largest edge lengths > 0 of the small cells.  Cells may be smaller, because each box contains a whole number of
        cells.
    ratio
        Largest ratio > 1 of edge lengths of neighbouring cells.  If there is too little space between boxes, the ratio
        is larger.
    largest : m
        Largest edge length of a cell, >= size.

    Returns
    -------
    Lines (n,), in m, along each axis, for `Grid(lines=...)`.

    Raises
    ------
    ValueError
        Boxes are outside the grid, numbers are out of range, or a box has more cells than a grid can have.
    """
    lower = numbers("graded: lower", lower, (2,), (3,), allowed="2 or 3 finite coordinates")
    d = lower.size
    upper = numbers("graded: upper", upper, (d,), allowed=f"{d} finite coordinates, as lower")
    least = numbers("graded: size", size, (), (d,), allowed="> 0", test=lambda v: (v > 0) & (v < np.inf))
    given, size = size, np.broadcast_to(least, (d,))
    ratio = float(numbers("graded: ratio", ratio, allowed="> 1", test=lambda v: (v > 1) & (v < np.inf)))
    if largest != np.inf:
        largest = float(numbers("graded: largest", largest, test=lambda v: v >= size.max(), allowed=f">= {size.max()}"))
    allowed = f"at least one box, a lower and an upper corner of {d} coordinates each, in the grid"
    boxes = numbers("graded: fine", fine, None, allowed=allowed)
    if boxes.ndim != 3 or boxes.shape[1:] != (2, d) or not (boxes[:, 1] > boxes[:, 0]).all():
        raise ValueError(f"graded: fine = {line(fine)}, must be {allowed}")
    if not (boxes[:, 0] >= lower - rounding(lower)).all() or not (boxes[:, 1] <= upper + rounding(upper)).all():
        raise ValueError(f"graded: fine = {line(fine)}, must be in {lower.tolist()} to {upper.tolist()}")
    cells = np.prod(np.maximum(1.0, np.ptp(boxes, axis=1).max(axis=0) / size))
    if cells > MOST / d:
        raise ValueError(f"graded: size = {line(given)}: the box has {cells:.3g} cells, must have at most {MOST // d}")
    return [_along(lower[a], upper[a], boxes[:, :, a], size[a], ratio, largest) for a in range(d)]


def _along(
    low: float, high: float, fine: NDArray[np.float64], size: float, ratio: float, largest: float
) -> NDArray[np.float64]:
    """Return the lines from `low` to `high` along an axis, with small cells in the intervals `fine`."""
    joined: list[list[float]] = []
    for start, stop in sorted(fine.tolist()):
        if joined and start - joined[-1][1] <= size * (1 + SAME):
            joined[-1][1] = max(joined[-1][1], stop)
        else:
            joined.append([start, stop])
    if joined[0][0] - low < size * (1 - SAME):
        joined[0][0] = low
    if high - joined[-1][1] < size * (1 - SAME):
        joined[-1][1] = high
    parts = [joined[0][0] - np.cumsum(_growing(joined[0][0] - low, size, ratio, largest))[::-1]]
    for k, (start, stop) in enumerate(joined):
        count = max(1, int(np.ceil((stop - start) / size - SAME)))
        parts.append(np.linspace(start, stop, count + 1))
        if k + 1 < len(joined):
            gap = joined[k + 1][0] - stop
            half = np.cumsum(_growing(gap / 2, size, ratio, largest))
            parts += [stop + half[:-1], stop + gap - half[::-1]]
    parts.append(joined[-1][1] + np.cumsum(_growing(high - joined[-1][1], size, ratio, largest)))
    out = np.concatenate(parts)
    out = out[np.append(True, np.diff(out) > SAME * size)]
    out[0], out[-1] = low, high
    return out


def _growing(gap: float, size: float, ratio: float, largest: float) -> NDArray[np.float64]:
    """Return edge lengths that together fill a gap, and grow from `size` by a common factor.

    If possible, the factor is at most `ratio`.
    """
    if gap <= 0:
        return np.empty(0)

    def edges(growth: float, count: int) -> NDArray[np.float64]:
        return np.minimum(size * growth ** np.arange(1, count + 1), largest)

    enough = 1
    while edges(ratio, enough).sum() < gap:
        enough *= 2
    count = 1 + int(np.cumsum(edges(ratio, enough))[:-1].searchsorted(gap))
    best = None
    for n in {count, max(1, count - 1)}:
        most = gap / size + 1
        if edges(most, n).sum() < gap:
            continue
        growth = scipy.optimize.brentq(lambda g, n=n: edges(g, n).sum() - gap, 0.0, most)
        if best is None or abs(np.log(growth)) < abs(np.log(best[0])):
            best = growth, n
    out = edges(*best)
    return out * (gap / out.sum())
