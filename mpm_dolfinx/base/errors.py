# SPDX-License-Identifier: MIT
"""What a step took, and the errors that end it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Report:
    """What a converged step took: Newton and coupling iterations, relative residuals, fluid balance, and mending.

    rederived: domains that had folded and were re-derived from F; renewed: domains that were replaced; easy: whether
    the next step may be longer; error, change, extremes: estimated error, and largest change, of the cells' pressures
    in the step, and the least and the largest of them, Pa; sealed: largest change had no fluid flowed, Pa; first:
    change in the first substep, Pa; sudden: the same where it is so fast that the step may overshoot, Pa; stress: what
    forces of the nodes stand for, Pa; moves: estimated error of the motion, and the motion, see `motion_error`; fills:
    estimated error of the water content, and its largest change, of pores that drain.
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
    """A step could not be taken; a shorter one may succeed.

    Attributes
    ----------
    history
        Relative residuals (momentum, storage) of its iterations, if it came to any.
    """

    history: Sequence[tuple[float, float]] = ()


class NotConverged(StepFailed):
    """A step's equations could not be solved; `history` lists (momentum, storage) relative residuals."""

    def __init__(self, reason: str, history: Sequence[tuple[float, float]] = ()):
        finite = [h for h in history if np.isfinite(h).all()]
        worst = "momentum" if not finite or finite[-1][0] >= finite[-1][1] else "storage"
        shown = ", ".join(f"({u:.1e}, {p:.1e})" for u, p in finite[-4:])
        super().__init__(reason + (f"; worst in {worst}; last residuals (momentum, storage): {shown}" if shown else ""))
        self.reason = reason
        self.field = worst
        self.history = history


class LeftGrid(StepFailed):
    """A material point has left the grid in a step whose equations are solved.

    Attributes
    ----------
    report
        What the step took, and the error of its pressures: a shorter one helps only where this one is too inexact.
    """

    def __init__(self, message: str, report: Report | None = None):
        super().__init__(message)
        self.report = report


def raise_interrupt(error: BaseException) -> None:
    """Raise the KeyboardInterrupt that is behind an error: some PETSc make one of their own of it within a solver."""
    cause = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    if cause is not None and cause is not error:
        raise cause from None
