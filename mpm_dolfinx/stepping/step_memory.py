# SPDX-License-Identifier: MIT
"""Data of the step-size rule in `simulation/step_size.py` that one step passes to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class StepControl:
    """Data of a run's step sizes that one step passes to the next.

    Parameters
    ----------
    interval : s
        Output interval of the run, 0 without an interval.
    small : s
        Next trial step.
    waits, kept
        See `StepSize.grown`.
    change : (bodies,), Pa
        Largest pressure change of each body since the start of the run.
    first : (bodies,), Pa/s
        Value `first` of the last step in `Report`, divided by the length of the step.
    start : (2, bodies), Pa
        Smallest and largest cell pressures of each body at the start of the run; None before the first step.
    motion : J^(1/2)
        Largest motion since the start of the run, see `motion_error`; None if unused.
    filled
        Largest change of the water content in a step since the start of the run.
    """

    interval: float = 0.0
    small: float = 0.0
    waits: int = 0
    kept: int = 1
    change: Sequence[float] = (0.0,)
    first: Sequence[float] = (0.0,)
    start: Sequence[Sequence[float]] | None = None
    motion: float | None = None
    filled: float = 0.0
