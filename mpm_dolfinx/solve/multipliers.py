# SPDX-License-Identifier: MIT
"""Multipliers of surfaces in the linear problem of a Newton step: they are found beside displacements and pressures.

With E how far multipliers x are from what they are to be, A the tangent, in which surfaces are stiff, and G x the
forces by which a change of x would drive the bodies,

    du = A^-1 (G x - R),     F(x, du) = E.

F is linear, and the identity where bodies do not give way.  It is solved by GCR (Eisenstat, Elman, Schultz 1983) for x:
each iteration solves with A once, as does what there is without multipliers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.flow.storage import StorageProblem
from mpm_dolfinx.mechanics.momentum import MomentumProblem
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.solve.schur import LinearSolvers

ACCURACY = 1e-3
"""Share of what multipliers are off by, or change by, that a linear solve leaves."""


def solved_with(
    solvers: LinearSolvers,
    momentum: MomentumProblem,
    storage: StorageProblem | None,
    solve: Callable[[], int],
    idle: NDArray[np.bool_],
) -> int:
    """Solve for displacements, pressures and multipliers; return the iterations of `solve`.

    Parameters
    ----------
    solvers
        They hold the directions, against which (u, p) are to go.
    momentum, storage
        With the residuals.
    solve
        Solves for (u, p) with these; returns the iterations.
    idle : (parts,)
        Which parts stay where they are.
    """
    count = solve()
    if not momentum.multiplies:
        return count
    comm = momentum.forms.grid.comm

    def dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
        return over_all(comm, float(a @ b))

    def found() -> list[NDArray[np.float64]]:
        return [vector.array_r.copy() for vector in directions]

    unmet = momentum.unmet()
    acts = ~np.append(idle, False)[unmet.part]
    directions = [solvers.du] if storage is None else [solvers.du, solvers.dp]
    residuals = [momentum.system.residual] if storage is None else [momentum.system.residual, storage.system.residual]
    kept = [vector.array_r.copy() for vector in residuals]
    total = found()
    x = np.zeros(len(unmet.off))
    before = acts * momentum.response(x, solvers.du)  # they go against it
    left = acts * unmet.off + before
    least = ACCURACY**2 * (dot(unmet.off, unmet.off) + dot(before, before))
    taken = []
    while dot(left, left) > least and len(taken) < solvers.most:
        change = left
        for vector in residuals:
            vector.set(0.0)
        momentum.drive(change, residuals[0])
        count += solve()
        moved, nearer = found(), acts * momentum.response(change, solvers.du)
        for other_change, other_moved, other_nearer in taken:
            share = dot(nearer, other_nearer)
            nearer = nearer - share * other_nearer
            change = change - share * other_change
            moved = [one - share * other for one, other in zip(moved, other_moved, strict=True)]
        size = np.sqrt(dot(nearer, nearer))
        if not size > 0:
            break
        taken.append((change / size, [one / size for one in moved], nearer / size))
        change, moved, nearer = taken[-1]
        share = dot(left, nearer)
        x, left = x + share * change, left - share * nearer
        total = [one - share * other for one, other in zip(total, moved, strict=True)]
    for vectors, values in ((directions, total), (residuals, kept)):
        for vector, each in zip(vectors, values, strict=True):
            vector.array_w[:] = each
    momentum.aim(x)
    return count
