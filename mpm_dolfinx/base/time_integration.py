# SPDX-License-Identifier: MIT
"""Time integration: the substeps of a step, for the material points and the finite element reference alike.

The momentum has no rate.  The content zeta of a cell has: zeta' + Q(u, p) = 0.  With u, p counted from the start n,

    backward-euler   zeta(u, p) - zeta_n + dt Q(u, p) = 0,
    sdirk2           zeta(u1, p1) - zeta_n + gamma dt Q(u1, p1) = 0                               loads at t + gamma dt,
                     zeta(u2, p2) - zeta_n + gamma dt Q(u2, p2) + (1 - gamma) dt Q(u1, p1) = 0    loads at t + dt,

with gamma = 1 - 1 / sqrt(2): Alexander's method (1977), of second order and L-stable; it needs no rate at the start,
which the remap has made noisy.  (u2, p2) is the end of the step.  After a jump of the loads one long step overshoots
by a fifth, two halves of it do not: see `step_size`.  The rates of the two substeps tell the error of the step: see
`solve.newton.note_pressures`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GAMMA = 1 - 1 / np.sqrt(2)  # Source: Alexander (1977), the L-stable method of two stages


@dataclass(frozen=True)
class Substep:
    """A stage of a diagonally implicit Runge-Kutta method: three shares of the step.

    end: time at which it balances; own: of the rate there; before: of the rate of the substep before.
    """

    end: float
    own: float
    before: float


METHODS = {
    "sdirk2": (Substep(GAMMA, GAMMA, 0.0), Substep(1.0, GAMMA, 1 - GAMMA)),
    "backward-euler": (Substep(1.0, 1.0, 0.0),),
}


def in_step(
    share: float, start: NDArray[np.float64], now: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the displacement of a first substep in which what is moved as given has the velocity that it should.

    The method has u = share dt v there, and from u at both substeps the velocity at the end.  With the given u itself
    that is of first order, and accelerations of none.  v is that of the parabola through three given displacements.

    share: of the step, at which the substep ends; start, now, end: displacements at the start, there, and at the end.
    """
    return start + ((2 * share - 1) * (now - start) - share**2 * (end - start)) / (share - 1)


EULER = METHODS["backward-euler"]


def substeps(method: str, evolves: bool) -> tuple[Substep, ...]:
    """Return the substeps of a method; of a scene in which nothing has a rate, one.

    Raises
    ------
    ValueError
        There is no such method.
    """
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"method {method!r}: must be one of {', '.join(METHODS)}")
    return METHODS[method if evolves else "backward-euler"]
