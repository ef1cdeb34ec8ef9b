# SPDX-License-Identifier: MIT
"""Jumps of given functions of time, at which the steps of a run end."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
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

    The value `values[k]` begins after `times[k]`, and remains until `times[k + 1]`.  The value at `times[0]` is
    `values[0]`, and the last value has no end.  Steps of `run` end at all `times`, so volumes of rain and inflow are
    exact to rounding.  `Simulation.step` refuses a jump within a step.  Results and factors of safety at `times[k]`
    belong to the value before `times[k]`.

    Parameters
    ----------
    times : (n,), s
        Increasing times at which the values begin.
    values : (n,) or (n, d)
        Values in the unit of the condition.  With inertia, the displacement of a side or a tool must not jump.

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
        size = np.abs(self.times)
        # a step that ends at a time may end at another number, because of rounding
        self._ends = self.times + ROUND_OFF * np.maximum(size, np.append(0.0, size[:-1]))
        self._first = self.times[0] - ROUND_OFF * size[0]

    def __repr__(self) -> str:
        """Return the call of the constructor, for messages."""
        return f"Stepwise({line(self.times.tolist())}, {line(self.values.tolist())})"

    def __call__(self, t: float) -> NDArray[np.float64]:
        """Return the value () or (d,) at time t (s)."""
        if t < self._first:
            raise ValueError(f"Stepwise: t = {t:g} s, must not be before the first time, {self.times[0]:g} s")
        return self.values[max(0, np.searchsorted(self._ends, t) - 1)]

    def jumps(self, t: float) -> bool:
        """Return whether the value changes at time t (s), up to rounding."""
        k = int(np.searchsorted(self._ends, t))
        at = 0 < k < len(self.times) and abs(t - self.times[k]) <= self._ends[k] - self.times[k]
        return bool(at and (self.values[k] != self.values[k - 1]).any())


def stepwise(conditions: Iterable[Any]) -> list[tuple[str, Stepwise]]:
    """Return the `Stepwise` values of conditions with the name of the attribute, for example of a water level."""
    own = [item for one in conditions for item in getattr(one, "__dict__", {}).items()]
    values = [(name, getattr(value, "level", value)) for name, value in own]
    return [(name, value) for name, value in values if isinstance(value, Stepwise)]


def motions(condition: Any) -> list[Stepwise]:
    """Return the `Stepwise` displacements and rotations of a side or a tool."""
    moved = getattr(condition, "MOVED", ())
    return [value for name, value in stepwise([condition]) if name in moved]


def functions_of_time(conditions: Collection[Any], gravity: Any) -> list[Stepwise | Callable[[float], NDArray]]:
    """Return the functions at whose jumps steps end: each `Stepwise`, and each flux that depends on time alone."""
    out: list[Stepwise | Callable[[float], NDArray]] = [gravity] if isinstance(gravity, Stepwise) else []
    out += [value for _, value in stepwise(conditions)]
    for one in conditions:
        if isinstance(one, Flux) and callable(one.flux) and not isinstance(one.flux, Stepwise):
            out += [one.at] if takes(one.flux) == ("t",) else []
    return out


def before_jumps(functions: Iterable[Stepwise | Callable[[float], NDArray]], start: float, end: float) -> float:
    """Return `end`, or the time of the first jump of a function in the step from `start` to `end`, in s.

    The result is just before the jump of a function that is not `Stepwise`.
    """
    near = ROUND_OFF * max(abs(start), abs(end))
    for function in functions:
        if isinstance(function, Stepwise):
            later = function.times[function.times > start + near]
            end = min([end, *later[:1].tolist()])
            continue
        while end - start > 2 * near and (jump := _jump(function, start + near, end, near / 4)) is not None:
            end = jump
    return end


def up_to_jumps(functions: Iterable[Stepwise | Callable[[float], NDArray]], t: float, dt: float) -> float:
    """Return the length of the step from t (s): `dt` (s), or a number that differs by rounding and ends before a jump.

    Raises ValueError if a function jumps within the step.
    """
    end = before_jumps(functions, t, t + dt)
    before = end - t if end < t + dt else dt
    if dt - before > ROUND_OFF * max(abs(t), abs(t + dt)):
        what = f"step: dt = {dt!r} s from t = {t!r} s: a value jumps within the step"
        raise ValueError(f"{what}, must be at most {before!r} s, so that the step ends at the jump")
    return before


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
    return float(low - near)
