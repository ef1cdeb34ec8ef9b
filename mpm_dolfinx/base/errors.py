# SPDX-License-Identifier: MIT
"""Report of a time step, and the errors that end a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass
class Report:
    """Report of a converged time step.  All pressures are cell pressures."""

    newton: int = 0  # Newton iterations
    coupling: int = 0  # iterations of the coupled linear solver
    history: list[tuple[float, float]] = field(default_factory=list)  # relative residuals (momentum, storage)
    balance: float = 0.0  # relative error of the fluid balance
    reinitialised: int = 0  # number of inverted particle domains re-initialised from the deformation gradient F
    renewed: int = 0  # number of particle domains replaced by renewal
    easy: bool = True  # whether a longer step may converge too
    error: float = 0.0  # estimated error of the pressures, Pa
    change: NDArray[np.float64] | tuple = (0.0,)  # largest pressure change of each body in the step, Pa
    extremes: NDArray[np.float64] | None = None  # at start and end: smallest and largest pressures (2, 2, bodies), Pa
    undrained: float = 0.0  # largest pressure change, Pa, in the same step without flow
    first: NDArray[np.float64] | tuple = (0.0,)  # `change` in the first substep, Pa; 0 if a body keeps its pieces
    sudden: NDArray[np.float64] | tuple = (0.0,)  # `first`, Pa; 0 if the second substep changes p enough, see `SUDDEN`
    stress: float = 0.0  # root mean square of the nodal forces, divided by the area of a cell face, Pa
    moves: tuple[float, float] = (0.0, 0.0)  # estimated error and size of the motion, see `motion_error`
    fills: tuple[float, float] = (0.0, 0.0)  # in unsaturated soil: estimated error and largest change of water content


class StepFailed(RuntimeError):
    """A time step that failed.  A shorter step may succeed.

    Attributes
    ----------
    history
        Relative residuals (momentum, storage) of each iteration.  The list is empty if there were no iterations.
    """

    history: Sequence[tuple[float, float]] = ()


class NotConverged(StepFailed):
    """A time step without a converged solution."""

    def __init__(self, reason: str, history: Sequence[tuple[float, float]] = ()):
        finite = [h for h in history if np.isfinite(h).all()]
        worst = "momentum" if not finite or finite[-1][0] >= finite[-1][1] else "storage"
        shown = ", ".join(f"({u:.1e}, {p:.1e})" for u, p in finite[-4:])
        super().__init__(reason + (f"; worst in {worst}; last residuals (momentum, storage): {shown}" if shown else ""))
        self.reason = reason
        self.field = worst
        self.history = history


class CannotFollow(NotConverged):
    """A time step in which bodies cannot follow a prescribed displacement.  Shorter steps would fail too."""


class LeftGrid(StepFailed):
    """A material point that is outside the grid after a converged step.

    Attributes
    ----------
    report
        Report of the step.  A shorter step may succeed only if the estimated error in the report exceeds the tolerance.
    """

    def __init__(self, message: str, report: Report | None = None):
        super().__init__(message)
        self.report = report


def raise_interrupt(error: BaseException) -> None:
    """Raise the KeyboardInterrupt that caused an error, if any.  Some PETSc releases report it as a solver error."""
    cause = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    if cause is not None and cause is not error:
        raise cause from None
