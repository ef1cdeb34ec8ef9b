# SPDX-License-Identifier: MIT
"""Numerical options of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mpm_dolfinx.base.time_integration import substeps
from mpm_dolfinx.base.validation import flag
from mpm_dolfinx.solve.scheme import Scheme

QUADRATURES = ("domain", "point")


@dataclass(frozen=True)
class Numerics:
    """Numerical options of a scene.

    Parameters
    ----------
    quadrature
        "domain": exact integration over cut particle domains. "point": integration at material points, as in standard
        MPM; allowed only for boxes along the grid, and not in axisymmetry.
    coupling
        Coupling scheme of the balances of momentum and fluid, one of `COUPLINGS`.
    tolerance
        Tolerance, in (0, 1), of the momentum residual relative to the forces, and of the fluid residual relative to the
        exchanged fluid volume.
    method
        Time integration: "sdirk2" (second order) or "backward-euler".
    renewal
        Whether to replace particle domains of yielded soil that are longer than a cell, see `stepping/renewal.py`.
        Renewal requires quadrature "domain", and yielding soil in 2D, without a `Contact` and without `specific_yield`.
        Axisymmetric scenes with inertia have no renewal.  On a grid with `follow`, elastic domains are also divided and
        merged (`stepping/division.py`).  Division requires dry or saturated soil, without `Contact` and inertia.
    keep_volumes
        Whether corners of yielded domains are corrected, so that domains have the volumes of their points, see
        `domains/kept_volumes.py`. This option has no effect with quadrature "point".
    petsc_options
        PETSc options for the solvers, see `Scheme`.

    Raises
    ------
    ValueError
        An option is invalid.
    """

    quadrature: str = "domain"
    coupling: str = "schur-cg"
    tolerance: float = 1e-8
    method: str = "sdirk2"
    renewal: bool = False
    keep_volumes: bool = True
    petsc_options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if self.quadrature not in QUADRATURES:
            raise ValueError(f"quadrature {self.quadrature!r}: must be {' or '.join(QUADRATURES)}")
        substeps(self.method, True)
        flag("renewal", self.renewal)
        flag("keep_volumes", self.keep_volumes)
        _ = self.scheme  # checks coupling, tolerance and options

    @property
    def scheme(self) -> Scheme:
        """Coupling scheme of the balances of momentum and fluid, with its tolerance."""
        return Scheme(self.coupling, self.tolerance, petsc_options=self.petsc_options)


DEFAULT = Numerics()
