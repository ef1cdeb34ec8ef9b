# SPDX-License-Identifier: MIT
"""Displacements as functions of time, from recorded accelerations or velocities."""

from __future__ import annotations

import os

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import flag, line, numbers, on_disk, path

QUANTITIES = ("acceleration", "velocity")
ALLOWED = "two columns of at least two rows, with increasing times in s and finite values"


class Record:
    """Recorded motion along a direction, as a function of time (s) that returns the displacement (d,), in m.

    Recorded values are interpolated linearly in time and integrated exactly.  The motion is zero before the first
    recorded time.  After the last recorded time the velocity is constant.

    Parameters
    ----------
    record : file, or (n, 2)
        Two columns: times (in s) and values.  Blanks or commas separate the columns of a file, and # starts a comment.
    direction : (d,)
        Direction of the motion.  Its length multiplies the values: use (9.81, 0) for a record in units of g.
    quantity
        Recorded quantity: "acceleration" (m/s^2) or "velocity" (m/s).
    at_rest
        Whether to correct the accelerations by a linear function of time, so that displacement and velocity are zero at
        the end of the record.

    Raises
    ------
    ValueError
        Values are not finite, times do not increase, or there are fewer than two rows.
    OSError
        The file cannot be read.
    """

    def __init__(
        self,
        record: str | os.PathLike | ArrayLike,
        direction: ArrayLike,
        quantity: str = "acceleration",
        at_rest: bool = False,
    ):
        if quantity not in QUANTITIES:
            raise ValueError(f"Record: quantity = {line(quantity)}, must be one of {', '.join(QUANTITIES)}")
        flag("Record: at_rest", at_rest)
        if at_rest and quantity == "velocity":
            raise ValueError("Record: at_rest = True, must be False for velocities")
        self.direction = numbers("Record: direction", direction, (2,), (3,), allowed="2 or 3 finite numbers")
        rows = numbers(
            "Record", _read(record) if isinstance(record, (str, os.PathLike)) else record, None, allowed=ALLOWED
        )
        if rows.ndim != 2 or rows.shape[1] != 2 or len(rows) < 2 or not (np.diff(rows[:, 0]) > 0).all():
            raise ValueError(f"Record = {line(record)} of shape {rows.shape}, must be {ALLOWED}")
        t, values = rows.T
        if at_rest:
            end, T = _linear(t, values).antiderivative(), t[-1] - t[0]
            moments = [end(t[-1]), end.antiderivative()(t[-1])]
            level, slope = np.linalg.solve([[T, T**2 / 2], [T**2 / 2, T**3 / 6]], moments)
            values = values - level - slope * (t - t[0])
        rate = _linear(t, values)
        velocity = rate if quantity == "velocity" else rate.antiderivative()
        self._of = velocity.derivative(), velocity, velocity.antiderivative()
        self.end = float(t[-1])
        """Last time of the record, s."""

    def __call__(self, t: float) -> NDArray[np.float64]:
        """Return the displacement (d,), m, at time t (s)."""
        *_, u = self._of
        return self._within(u, t) + max(t - self.end, 0.0) * self.velocity(min(t, self.end))

    def velocity(self, t: float) -> NDArray[np.float64]:
        """Return the velocity (d,), m/s, at time t (s)."""
        return self._within(self._of[1], t)

    def acceleration(self, t: float) -> NDArray[np.float64]:
        """Return the acceleration (d,), m/s^2, at time t (s)."""
        return self._within(self._of[0], t) * (t <= self.end)

    def _within(self, value: scipy.interpolate.PPoly, t: float) -> NDArray[np.float64]:
        """Return a quantity at time t: zero before the record, and constant after the record."""
        return self.direction * (float(value(min(t, self.end))) if t >= value.x[0] else 0.0)


def _linear(t: NDArray[np.float64], values: NDArray[np.float64]) -> scipy.interpolate.PPoly:
    """Return the piecewise linear interpolant of values at times t, in s."""
    return scipy.interpolate.PPoly(np.stack([np.diff(values) / np.diff(t), values[:-1]]), t)


def _read(record: str | os.PathLike) -> NDArray[np.float64]:
    """Return the two columns of a file."""
    file = path("Record", record)
    with on_disk(f"Record: {file}", "a file that can be read"):
        text = file.read_text()
    try:
        return np.loadtxt(text.replace(",", " ").splitlines(), ndmin=2)
    except ValueError as error:
        raise ValueError(f"Record: {file}: {line(str(error))}, must be {ALLOWED}") from error
