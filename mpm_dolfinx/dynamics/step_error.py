# SPDX-License-Identifier: MIT
"""The error of a step of bodies with inertia, by its difference from a step of first order."""

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
) -> tuple[float, float]:
    """Return the estimated error of a step's motion, and the motion itself, both as roots of twice an energy, J^(1/2).

    The difference to a step of first order is seconds (a2 - a1) in the velocities, seconds (v2 - v1) in the
    displacements.  The matrix of the substep makes it bounded for modes that the step does not resolve, as in Hosea and
    Shampine (1996); the share ERROR of it counts.  A mode that a step resolves is off by 0.081 omega dt of it.

    Parameters
    ----------
    solvers, K, mass
        Of the last substep: solvers, tangent of the momentum, mass.
    flights
        After the two substeps.
    seconds, own
        Times, s, in which the first rate of two counts, and the last one.
    """
    first, last = flights
    rate, M = 1 / own**2, mass.M
    energy = 0.0
    for one, other, stiff in (
        (first.acceleration, last.acceleration, False),
        (first.velocity, last.velocity, True),
    ):
        off = other - one
        off.scale(ERROR * seconds)
        filtered = off.duplicate()
        solvers.solve_u.solve(M * off * rate, filtered)
        inert = filtered.dot(M * filtered)
        energy += filtered.dot(K * filtered) - rate * inert if stiff else inert
    return float(np.sqrt(max(energy, 0.0))), float(np.sqrt(last.velocity.dot(M * last.velocity)))
