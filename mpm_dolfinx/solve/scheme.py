# SPDX-License-Identifier: MIT
"""Coupling schemes of the balances of momentum and fluid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mpm_dolfinx.base.validation import numbers
from mpm_dolfinx.solve.petsc_options import check

COUPLINGS = {
    "schur-cg": 0.75,
    "schur-fgmres": 0.75,
    "fixed-stress": 0.75,
    "fixed-stress-full": 1.0,
    "fixed-stress-fluid": None,
}
"""Coupling schemes, each with the factor f in the fixed-stress coefficient `beta = f alpha^2 / K_dr`.

Here alpha is Biot's coefficient, K_dr the drained bulk modulus, K_w that of the fluid. With None, beta is `1 / K_w`.
"""


@dataclass(frozen=True)
class Scheme:
    """A coupling scheme with its tolerance and limits.

    Parameters
    ----------
    coupling
        Name in `COUPLINGS`.
    tolerance
        Tolerance, in (0, 1), of the momentum residual relative to the forces, and of the fluid residual relative to the
        exchanged fluid volume.
    most_newton, most_coupling
        Largest numbers of Newton steps, and of coupling iterations with "fixed-stress", in a step.
    petsc_options
        PETSc options for the solvers, such as {"momentum_pc_factor_mat_ordering_type": "nd"}. Names begin with one of
        `petsc_options.PREFIXES`. A warning lists options that no solver of the scene reads.

    Raises
    ------
    ValueError
        A value is outside its range.
    """

    coupling: str
    tolerance: float
    most_newton: int = 25
    most_coupling: int = 200
    petsc_options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if not isinstance(self.coupling, str) or self.coupling not in COUPLINGS:
            raise ValueError(f"coupling {self.coupling!r}: must be one of {', '.join(COUPLINGS)}")
        numbers("tolerance", self.tolerance, test=lambda v: (0 < v) & (v < 1), allowed="in (0, 1)")
        check(self.petsc_options)

    @property
    def richardson(self) -> bool:
        """Whether solves of the two balances alternate."""
        return self.coupling.startswith("fixed-stress")

    @property
    def of_fluid(self) -> bool:
        """Whether beta is 1/K_w."""
        return COUPLINGS[self.coupling] is None

    @property
    def beta(self) -> float:
        """Factor f in the fixed-stress coefficient, see `COUPLINGS`, or 1 for `beta = 1 / K_w`."""
        return COUPLINGS[self.coupling] or 1.0
