# SPDX-License-Identifier: MIT
"""Jumps of given functions of time, at which the steps of a run end."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.tolerances import ROUND_OFF
from mpm_dolfinx.base.validation import line, numbers, takes
from mpm_dolfinx.conditions.conditions import Flux

SAMPLES = 64
"""Number of equal parts of a step, at whose ends a flux is evaluated.  Source: definition, see `Rain`."""


class Stepwise:
    """Piecewise constant function of time, such as recorded rates of rain, for values of conditions and for gravity.

    The value `values[k]` begins at `times[k]`, and remains until `times[k + 1]`.  The last value has no end.  Steps end
    at all `times`, so the volumes of rain and inflow are exact to rounding.  Results at `times[k]` belong to the value
    before `times[k]`.

    Parameters
    ----------
    times : (n,), s
        Increasing times at which the values begin.
    values : (n,) or (n, d)
        Values in the unit of the condition.

    Raises
    ------
    ValueError
        Times do not increase, their number differs from the number of values, or a number is not finite.  A run raises
        the error if it needs a value before the first time.
    """

    def __init__(self, times: ArrayLike, values: ArrayLike):
        self.times = numbers("Stepwise: times", times, None, allowed="increasing times, s").copy()
        if self.times.ndim != 1 or not len(self.times) or not (np.diff(self.times) > 0).all():
            raise ValueError(f"Stepwise: times = {line(times)}, must be increasing times, s")
        self.values = numbers("Stepwise: values", values, None, allowed="finite numbers").copy()
        if self.values.ndim not in (1, 2) or len(self.values) != len(self.times):
            what = f"Stepwise: values of shape {self.values.shape}"
            raise ValueError(f"{what}, must be one value, or a row of components, for each of {len(self.times)} times")

    def __call__(self, t: float) -> NDArray[np.float64]:
        """Return the value () or (d,) at time t (s)."""
        if t < self.times[0]:
            raise ValueError(f"Stepwise: t = {t:g} s, must not be before the first time, {self.times[0]:g} s")
        return self.values[np.searchsorted(self.times, t, side="right") - 1]


def functions_of_time(conditions: Iterable[Any], gravity: Any) -> list[Stepwise | Callable[[float], NDArray]]:
    """Return the functions at whose jumps steps end: each `Stepwise`, and each flux that depends on time alone."""
    out = [gravity] if isinstance(gravity, Stepwise) else []
    for one in conditions:
        for value in (getattr(one, name) for name in getattr(one, "FUNCTIONS", ())):
            if isinstance(value, Stepwise):
                out.append(value)
            elif isinstance(one, Flux) and callable(value) and takes(value) == ("t",):
                out.append(one.at)
    return out


def before_jumps(functions: Iterable[Stepwise | Callable[[float], NDArray]], start: float, end: float) -> float:
    """Return `end`, or a time just before the first jump of a function in the step from `start` to `end`, in s."""
    near = ROUND_OFF * max(abs(start), abs(end))  # the step ends before the jump, even if its end is rounded
    for function in functions:
        if isinstance(function, Stepwise):
            later = function.times[function.times > start + near]
            if len(later) and later[0] <= end + near:
                end = min(end, later[0] - near / 4)
            continue
        while end - start > 2 * near and (jump := _jump(function, start + near, end, near / 4)) is not None:
            end = jump
    return end


def _jump(of: Callable[[float], NDArray], low: float, high: float, near: float) -> float | None:
    """Return a time at most 2 `near` before the largest jump of a function between two times, or None without a jump.

    Bisection halves an interval.  If the function does not jump, the difference of its values at the ends of the
    interval decreases faster than the square root of the length of the interval.
    """
    t = np.linspace(low, high, SAMPLES + 1)
    values = [float(of(float(time))) for time in t]
    k = int(np.abs(np.diff(values)).argmax())
    (low, high), (first, last) = t[k : k + 2], values[k : k + 2]
    size, length = abs(last - first), high - low
    while high - low > near:
        middle = (low + high) / 2
        value = float(of(middle))
        if abs(value - first) > abs(last - value):
            high, last = middle, value
        else:
            low, first = middle, value
        if abs(last - first) <= size * np.sqrt((high - low) / length):
            return None
    return low - near
