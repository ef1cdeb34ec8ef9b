# SPDX-License-Identifier: MIT
"""The memory of the step-size rule of `simulation/step_size.py` between two steps."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StepControl:
    """Memory of a run's step sizes.

    Parameters
    ----------
    interval : s
        Output interval of the run, 0 without one.
    small : s
        Next trial step.
    waits, kept
        See `StepSize.grown`.
    change : Pa
        Largest pressure change since the start of the run.
    first : Pa/s
        See `Report`: value of the last step over its length, if the grid is reset.
    motion : J^(1/2)
        Largest motion since the start of the run, see `motion_error`; None if it is not needed.
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
