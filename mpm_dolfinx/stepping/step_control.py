# SPDX-License-Identifier: MIT
"""What the rule for the length of steps remembers between two of them."""

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
        The step to try next.
    waits, kept
        See `StepSize.grown`.
    change : Pa
        Largest change of the pressures since the run began.
    first : Pa/s
        See `Report`: of the last step, over its length where the grid is reset.
    motion : J^(1/2)
        Largest motion since the run began, see `motion_error`; None where it is not asked for.
    filled
        Largest change of the water content in a step since the run began.
    """

    interval: float = 0.0
    small: float = 0.0
    waits: int = 0
    kept: int = 1
    change: float = 0.0
    first: float = 0.0
    motion: float | None = None
    filled: float = 0.0
