# SPDX-License-Identifier: MIT
"""Choice of solvers by the properties of the problem, and thresholds between solvers.

Without fluid, the momentum balance is solved alone.  With fluid, displacements are eliminated (`schur`), or both
balances are solved together (`monolithic`) or in turn (fixed-stress iterations).  The solver for displacements is
direct (PETSc or MUMPS) or multigrid.
"""

from __future__ import annotations

from dataclasses import dataclass

FACTORS, NODAL, MUMPS, MULTIGRID = "factors", "factors in blocks", "factors by MUMPS", "multigrid"
"""Solvers for displacements or pressures."""
SWEEPS = "multigrid with sweeps"
"""Fallback after too many iterations of multigrid with `INCOMPLETE`: multigrid with the smoother `THREE_SWEEPS`."""
ONE_SWEEP, THREE_SWEEPS = "multigrid", "firmly"
"""Smoothers of multigrid by relaxation. Prefixes of PETSc options contain these names (`momentum_firmly_`)."""
INCOMPLETE = "incomplete"
"""Smoother of multigrid by incomplete factors. Prefixes of PETSc options contain this name."""
ALONE, SCHUR, AT_ONCE, IN_TURN = "momentum alone", "Schur complement", "both at once", "in turn"
"""Methods for the linearised problem."""


@dataclass(frozen=True)
class Thresholds:
    """Thresholds between solvers. `bash demos/run.sh calibrate` measures times on both sides of each threshold.

    multigrid_3d
        From this number of unknown displacements, multigrid replaces a direct solver in 3D. With 1656 unknowns, two
        steps of a block take 0.66 s with a direct solver and 0.59 s with multigrid. With 12784 unknowns, two steps take
        32 s with a direct solver and 4.0 s with multigrid.
    multigrid_2d
        From this number of unknown displacements, multigrid replaces a direct solver in wet 2D scenes without yield.
        From 8000 to 74000 unknowns, the times of both solvers differ by at most 15 %.
    mumps
        From this number of unknown displacements, MUMPS computes factors in wet scenes.  If K is symmetric, MUMPS is
        used on several processes only.  On one process, two steps of a yielding block of 73728 unknowns take 18 s with
        blocks of nodes and 36 s with MUMPS.  With 100000 unknowns, the factors of K have 1.5e7 entries (0.12 GB).
    fallback_3d
        Largest number of unknown displacements in 3D for which a direct solver may replace multigrid.
    many
        Largest number of iterations of a solve. After more iterations, a direct solver replaces multigrid, or the next
        tangent renews the factors of the fixed-stress operator. Limits of 12, 25, 50 and 500 give equally many Newton
        steps (footing, 9 cells).
    coarsest
        Largest number of unknowns on the coarsest grid of multigrid.
    """

    multigrid_3d: int = 1500
    multigrid_2d: int = 30000
    mumps: int = 100000
    fallback_3d: int = 20000
    many: int = 29
    coarsest: int = 1000


THRESHOLDS = Thresholds()
FORCING = 1e-5
"""Smallest relative tolerance of a linear solve.  Sensitivity (scene "soil" of tests/plateaus.py): half this value
changes the result by 4.0e-11, and twice this value by 1.2e-11.  Finer cells change it by 3.0e-02.
"""
FORCING_3D = 1e-3
"""Smallest relative tolerance of a linear solve with multigrid in 3D."""
KEEP = 0.05
"""Largest ratio of successive residuals for which the tangent is reused.  Sensitivity (scene "soil" of
tests/plateaus.py): half this value changes the result by 4.9e-11, and twice this value by 1.0e-11.  Finer cells change
it by 3.0e-02.
"""
KEEP_WET = 0.01
"""Value of `KEEP` in wet 2D scenes without yield.  Sensitivity (scene "beam" of tests/plateaus.py): half this value
changes the result by 1.8e-11, and twice this value by 2.9e-10.  Finer cells change it by 1.5e-02.
"""


@dataclass(frozen=True)
class SolverPlan:
    """Solution method for the linearised problem.

    Parameters
    ----------
    route
        One of `ALONE`, `SCHUR`, `AT_ONCE`, `IN_TURN`.
    displacements, pressures
        Solvers for K and for the fixed-stress operator. `pressures` is "" without fluid.
    krylov
        Name of the iterative solver in PETSc, or "preonly" for a direct solver alone.
    fallback
        Solver that replaces the multigrid cycle on K after many iterations, or "" without such a solver.
    smoother
        Smoother of the multigrid cycle on K: `INCOMPLETE` in wet soil that may yield, `THREE_SWEEPS` in other nearly
        incompressible bodies without a fallback, otherwise `ONE_SWEEP`.
    symmetric
        Whether K is symmetric.
    many, coarsest
        See `Thresholds`.
    forcing
        Smallest relative tolerance of a linear solve.
    keep
        Largest ratio of successive residuals for which the tangent is reused.
    """

    route: str
    displacements: str
    pressures: str
    krylov: str
    fallback: str
    smoother: str
    symmetric: bool
    many: int
    coarsest: int
    forcing: float
    keep: float

    @property
    def iterative(self) -> bool:
        """Whether a multigrid cycle approximates K^-1."""
        return self.displacements == MULTIGRID

    def __str__(self) -> str:
        """Return the plan in one line."""
        how = [f"displacements by {self.displacements}"]
        if self.pressures:
            how.append(f"pressures by {self.pressures}")
        if self.krylov != "preonly":
            how.append(self.krylov.upper())
        if self.fallback:
            how.append(f"else {self.fallback}")
        return f"{self.route}: {', '.join(how)}"


def plan(
    unknowns: int,
    dim: int,
    *,
    wet: bool = True,
    yields: bool = False,
    locks: bool = False,
    symmetric: bool = True,
    processes: int = 1,
    coupling: str = "schur-cg",
) -> SolverPlan:
    """Return the solution method for a problem.

    The tangent is reused while each Newton step multiplies the residual by less than 0.05. In wet 2D scenes without
    yield, this limit is 0.01. In 26 adaptive steps, a drained beam takes 205 Newton steps and 79 tangents with 0.05,
    and 179 Newton steps and 83 tangents with 0.01. With 0.01, a beam in 3D takes up to 1.2 times as long as with 0.05.

    The relative tolerance of linear solves is at least 1e-5 with nonlinear laws, and 1e-3 with multigrid in 3D. A
    footing on 21 cells (backward Euler) takes 299 Newton steps with 1e-5, and 370 with 1e-3.

    Parameters
    ----------
    unknowns
        Number of unknown displacements on all processes.
    dim
        2 or 3.
    wet
        Whether there is fluid.
    yields
        Whether any law may yield.
    locks
        Whether any law may yield or is nearly incompressible.
    symmetric
        Whether K is symmetric.
    processes
        Number of processes.
    coupling
        Name in `scheme.COUPLINGS`.
    """
    limits, in_turn = THRESHOLDS, wet and coupling.startswith("fixed-stress")
    at_once = wet and not in_turn
    if dim == 3:
        multigrid = unknowns >= limits.multigrid_3d
    else:
        multigrid = at_once and not yields and unknowns >= limits.multigrid_2d
    mumps = wet and unknowns >= limits.mumps and (processes > 1 or not symmetric)
    direct = MUMPS if mumps else NODAL if wet else FACTORS
    fallback = ""
    if multigrid and at_once and (dim == 2 or unknowns <= limits.fallback_3d):
        fallback = MUMPS if dim == 3 else direct
    elif multigrid and at_once and yields:
        fallback = SWEEPS
    smoother = INCOMPLETE if multigrid and at_once and yields else THREE_SWEEPS if locks and not fallback else ONE_SWEEP
    if not wet:
        krylov = "gmres" if multigrid else "preonly"
    elif in_turn:
        krylov = "preonly"
    elif multigrid:
        krylov = "gmres"
    else:
        krylov = "cg" if symmetric and coupling == "schur-cg" else "fgmres"
    return SolverPlan(
        route=IN_TURN if in_turn else ALONE if not wet else AT_ONCE if multigrid else SCHUR,
        displacements=MULTIGRID if multigrid else direct,
        pressures="" if not wet else MULTIGRID if multigrid and at_once else MUMPS if mumps else FACTORS,
        krylov=krylov,
        fallback=fallback,
        smoother=smoother,
        symmetric=symmetric,
        many=limits.many,
        coarsest=limits.coarsest,
        forcing=FORCING_3D if multigrid and dim == 3 else FORCING,
        keep=KEEP_WET if wet and dim == 2 and not yields else KEEP,
    )
