# SPDX-License-Identifier: MIT
"""Error estimate of a step with inertia: the difference from a first-order step."""

from __future__ import annotations

from collections.abc import Sequence

from petsc4py import PETSc

import numpy as np

from mpm_dolfinx.mechanics.inertia import Flight, Mass
from mpm_dolfinx.solve.newton import ERROR
from mpm_dolfinx.solve.schur import LinearSolvers


def motion_error(
    solvers: LinearSolvers,
    K: PETSc.Mat,
    mass: Mass,
    flights: Sequence[Flight],
    seconds: float,
    own: float,
    drift: Sequence[float],
) -> tuple[float, float]:
    """Return the estimated error of a step and the size of its motion, both in J^(1/2).

    The first substep ends with the velocity v1 and the acceleration a1, and the last substep with v2 and a2.  A
    first-order step would give a velocity that differs by `seconds * (a2 - a1)`, and a displacement that differs by
    `seconds * (v2 - v1)`.  The estimate is `ERROR` times the energy norm of these differences.  In a resolved mode of
    angular frequency omega, the true error is 0.081 omega dt times this norm, with the step length dt.  `StepSize` uses
    this bound in short steps.  In unresolved modes, a linear solve with the matrix of the substep limits the estimate
    (Hosea and Shampine 1996).

    `K`, `mass`: momentum tangent and mass matrix of the last substep.
    `flights`: velocities and accelerations after the two substeps.
    `seconds`, `own`, in s: weights of the time derivatives of the first and of the last substep, in the last substep.
    `drift`: mean velocity of free bodies at the start of the run, in m/s, see `energies.drift`.
    """
    first, last = flights
    rate = 1 / own**2
    S = mass.stiffness(rate)
    energy = 0.0
    for one, other, stiff in ((first.acceleration, last.acceleration, False), (first.velocity, last.velocity, True)):
        off = other - one
        off.scale(ERROR * seconds)
        filtered = off.duplicate()
        solvers.solve_u.solve(S * off, filtered)
        inert = filtered.dot(S * filtered)
        energy += filtered.dot(K * filtered) - inert if stiff else inert / rate
    return float(np.sqrt(max(energy, 0.0))), mass.size(last.velocity, drift)
