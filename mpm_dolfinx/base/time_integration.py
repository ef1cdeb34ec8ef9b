# SPDX-License-Identifier: MIT
"""Time integration: the substeps (stages) of a time step.

Without inertia the momentum balance has no time derivative.  The fluid content zeta of a cell satisfies zeta' + Q(u, p)
= 0 with the displacement u, the pressure p, and the net outflow Q.  The subscript n denotes the start of a step of
length dt, and 1 and 2 denote the ends of its substeps.  The two methods are

    backward-euler   zeta(u, p) - zeta_n + dt Q(u, p) = 0,
    sdirk2           zeta(u1, p1) - zeta_n + gamma dt Q(u1, p1) = 0                               loads at t + gamma dt,
                     zeta(u2, p2) - zeta_n + gamma dt Q(u2, p2) + (1 - gamma) dt Q(u1, p1) = 0    loads at t + dt.

With gamma = 1 - 1 / sqrt(2), `sdirk2` is Alexander's method (1977).  This method is second-order and L-stable.  It does
not use zeta' at the start of the step, because a grid reset makes zeta' noisy.  After a jump of the loads, the pressure
in one long step overshoots by a fifth of the jump, but not in two half steps (see `step_size`).  The flow rates Q of
the two substeps give an estimate of the error, see `solve.newton.note_pressures`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GAMMA = 1 - 1 / np.sqrt(2)  # Source: Alexander (1977), the L-stable method of two stages


@dataclass(frozen=True)
class Substep:
    """A stage of a diagonally implicit Runge-Kutta method.  Times and weights are fractions of the step length."""

    end: float  # c_i: time at which the stage is in equilibrium
    own: float  # a_ii: weight of the rate of this stage
    before: float  # a_i,i-1: weight of the rate of the previous stage


METHODS = {
    "sdirk2": (Substep(GAMMA, GAMMA, 0.0), Substep(1.0, GAMMA, 1 - GAMMA)),
    "backward-euler": (Substep(1.0, 1.0, 0.0),),
}


def in_step(
    share: float, start: NDArray[np.float64], now: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the displacement to prescribe at the end of the first substep.

    The scheme computes the velocity v as the displacement in the substep, divided by the length `share` dt of the
    substep.  If the exact displacement were prescribed, v would be first-order accurate, and accelerations would not
    converge.  The prescribed displacement is therefore (`start` + `share` dt v), where v is the slope of a parabola at
    the end of the substep.  This parabola passes through the three exact displacements.

    `share`: end of the substep as a fraction of the step.
    `start`, `now`, `end`: exact displacements at the start of the step, end of the substep, and end of the step.
    """
    return start + ((2 * share - 1) * (now - start) - share**2 * (end - start)) / (share - 1)


EULER = METHODS["backward-euler"]


def substeps(method: str, evolves: bool) -> tuple[Substep, ...]:
    """Return the substeps of a method.  A scene without time derivatives (`evolves` is False) has one substep."""
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"method {method!r}: must be one of {', '.join(METHODS)}")
    return METHODS[method if evolves else "backward-euler"]
