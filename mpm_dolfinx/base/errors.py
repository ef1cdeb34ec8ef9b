# SPDX-License-Identifier: MIT
"""What ends a step or a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpm_dolfinx.base.report import Report


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
