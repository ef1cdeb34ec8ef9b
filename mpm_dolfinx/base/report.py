# SPDX-License-Identifier: MIT
"""What a step took."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Report:
    """What a converged step took: Newton and coupling iterations, relative residuals, fluid balance, and mending.

    rederived: domains that had folded and were re-derived from F; easy: whether the next step may be longer; error,
    change, extremes: estimated error, and largest change, of the cells' pressures in the step, and the least and the
    largest of them, Pa; sealed: largest change had no fluid flowed, Pa; first: change in the first substep, Pa; sudden:
    the same where it is so fast that the step may overshoot, Pa; stress: what forces of the nodes stand for, Pa; moves:
    estimated error of the motion, and the motion, see `motion_error`.
    """

    newton: int = 0
    coupling: int = 0
    history: list[tuple[float, float]] = field(default_factory=list)
    balance: float = 0.0
    rederived: int = 0
    easy: bool = True
    error: float = 0.0
    change: float = 0.0
    extremes: tuple[float, float] | None = None
    sealed: float = 0.0
    first: float = 0.0
    sudden: float = 0.0
    stress: float = 0.0
    moves: tuple[float, float] = (0.0, 0.0)
