# SPDX-License-Identifier: MIT
"""Report of a step, and the errors that end a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Report:
    """Report of a converged step.

    newton, coupling: iterations; history: relative residuals (momentum, storage); balance: relative error of the fluid
    balance; rederived: inverted particle domains that were re-initialised from F; renewed: domains replaced by renewal;
    easy: whether a longer step may converge too.  Pressures of cells, Pa: error: estimated error; change: largest
    change in the step; extremes: minimum and maximum; sealed: largest change of the same step without flow; first:
    largest change in the first substep; sudden: `first` if the second substep changes little more, else 0.  stress:
    root mean square of the nodal forces over the area of a cell face, Pa; moves: estimated error of the motion, and the
    motion, see `motion_error`; fills: estimated error and largest change of the water content, for unsaturated soil.
    """

    newton: int = 0
    coupling: int = 0
    history: list[tuple[float, float]] = field(default_factory=list)
    balance: float = 0.0
    rederived: int = 0
    renewed: int = 0
    easy: bool = True
    error: float = 0.0
    change: float = 0.0
    extremes: tuple[float, float] | None = None
    sealed: float = 0.0
    first: float = 0.0
    sudden: float = 0.0
    stress: float = 0.0
    moves: tuple[float, float] = (0.0, 0.0)
    fills: tuple[float, float] = (0.0, 0.0)


class StepFailed(RuntimeError):
    """A step that could not be taken; a shorter step may succeed.

    Attributes
    ----------
    history
        Relative residuals (momentum, storage) of its iterations, empty if there were none.
    """

    history: Sequence[tuple[float, float]] = ()


class NotConverged(StepFailed):
    """A step without a solution; `history` has its relative residuals (momentum, storage)."""

    def __init__(self, reason: str, history: Sequence[tuple[float, float]] = ()):
        finite = [h for h in history if np.isfinite(h).all()]
        worst = "momentum" if not finite or finite[-1][0] >= finite[-1][1] else "storage"
        shown = ", ".join(f"({u:.1e}, {p:.1e})" for u, p in finite[-4:])
        super().__init__(reason + (f"; worst in {worst}; last residuals (momentum, storage): {shown}" if shown else ""))
        self.reason = reason
        self.field = worst
        self.history = history


class LeftGrid(StepFailed):
    """A material point outside the grid after a converged step.

    Attributes
    ----------
    report
        Report of the step.  A shorter step helps only if the estimated error of this step is too large.
    """

    def __init__(self, message: str, report: Report | None = None):
        super().__init__(message)
        self.report = report


def raise_interrupt(error: BaseException) -> None:
    """Raise the KeyboardInterrupt that caused an error: some PETSc releases replace it within a solver."""
    cause = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    if cause is not None and cause is not error:
        raise cause from None
