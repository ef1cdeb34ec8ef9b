# SPDX-License-Identifier: MIT
"""Data of the step-size rule in `simulation/step_size.py` that one step passes to the next."""

from __future__ import annotations

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
    change : Pa
        Largest pressure change since the start of the run.
    first : Pa/s
        Value `first` of the last step in `Report`, divided by the length of the step; 0 if all points keep their cut.
    motion : J^(1/2)
        Largest motion since the start of the run, see `motion_error`; None if unused.
    filled
        Largest change of the water content in a step since the start of the run.
    """

    interval: float = 0.0
    small: float = 0.0
    waits: int = 0
    kept: int = 1
    change: float = 0.0
    first: float = 0.0
    motion: float | None = None
    filled: float = 0.0
