# SPDX-License-Identifier: MIT
"""Materials: the stored energy of the skeleton in UFL, and the constants of skeleton and pore fluid.

Both the material point method and the finite element reference use these, so the law is written once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import inf
from typing import ClassVar

import ufl

LOCKING = 0.43
"""Poisson's ratio above which the mean dilatation of a cell is used, at twice the cost of a step.

Tip of the drained beam at h = 0.015 m, plain and with it: -0.02 and +0.22 % at nu = 0.3, -0.44 and +0.21 % at
0.45, -2.0 and +0.21 % at 0.49, -10.3 and -0.02 % at 0.499; at h = 0.06 m and 0.499: -56 and -0.4 %.
"""


@dataclass(frozen=True)
class Skeleton:
    """Porous skeleton: constants that every law has.

    Parameters
    ----------
    bulk
        Drained bulk modulus K, Pa, > 0 (3D modulus, also in plane strain).
    shear
        Shear modulus G, Pa, > 0.
    porosity
        Volume fraction of the pores at the start n0, in (0, 1).
    conductivity
        Hydraulic conductivity k, m/s, >= 0.
    biot
        Biot coefficient alpha, in [porosity, 1].
    grain_bulk
        Bulk modulus of the grains K_s, Pa, > 0; infinite for incompressible grains.
    grain_density
        Density of the grains, kg/m^3, >= 0; used with gravity only.
    """

    bulk: float
    shear: float
    porosity: float = 0.4
    conductivity: float = 0.0
    biot: float = 1.0
    grain_bulk: float = inf
    grain_density: float = 2650.0

    parameters: ClassVar[tuple[str, ...]] = ("bulk", "shear")
    """Names of the constants that the energy takes."""

    def __post_init__(self):
        for name in ("bulk", "shear"):
            _check(self, name, 0 < getattr(self, name) < inf, "> 0 and finite")
        _check(self, "grain_bulk", 0 < self.grain_bulk, "> 0")
        for name in ("conductivity", "grain_density"):
            _check(self, name, 0 <= getattr(self, name) < inf, ">= 0 and finite")
        _check(self, "porosity", 0 < self.porosity < 1, "in (0, 1)")
        _check(self, "biot", self.porosity <= self.biot <= 1, f"in [porosity = {self.porosity:g}, 1]")

    @staticmethod
    def energy(F, bulk, shear):
        """Return the stored energy density psi(F) per reference volume, Pa, as UFL."""
        raise NotImplementedError

    def drained_modulus(self, dim: int) -> float:
        """Return the drained bulk modulus of the dimension K_dr, Pa: K in 3D, lambda + G in plane strain."""
        return self.bulk if dim == 3 else self.bulk + self.shear / 3

    @property
    def poisson(self) -> float:
        """Poisson's ratio nu."""
        return (3 * self.bulk - 2 * self.shear) / (6 * self.bulk + 2 * self.shear)

    @property
    def nearly_incompressible(self) -> bool:
        """Whether P1 cells would lock, so that the law is given the mean dilatation of each cell (`dilatation`)."""
        return self.poisson > LOCKING

    @property
    def oedometric(self) -> float:
        """Oedometric (P-wave) modulus lambda + 2G, Pa."""
        return self.bulk + 4 / 3 * self.shear

    def pressure_damping(self, dim: int) -> float:
        """Return tau, 1/Pa: a quarter of the jump stabilisation of a patch of 2^dim cells.

        3 alpha^2 / (8 (lambda + 3G)) in 2D, 9 alpha^2 / (32 (lambda + 4G)) in 3D; a quarter is better
        conditioned and smears less (Silvester and Kechkar 1990; Camargo, White and Borja 2021).
        """
        lam = self.bulk - 2 * self.shear / 3
        patch = 3 / (8 * (lam + 3 * self.shear)) if dim == 2 else 9 / (32 * (lam + 4 * self.shear))
        return 0.25 * self.biot**2 * patch

    def storage(self, fluid_bulk: float, porosity):
        """Return the storage coefficient S = n/K_w + (alpha - n)/K_s, 1/Pa, at a porosity."""
        return porosity / fluid_bulk + (self.biot - porosity) / self.grain_bulk


def _check(obj, name: str, ok: bool, allowed: str) -> None:
    if not ok:
        raise ValueError(f"{type(obj).__name__}: {name} = {getattr(obj, name)!r}, must be {allowed}")


@dataclass(frozen=True)
class Hencky(Skeleton):
    """Hencky's law: psi = lambda/2 (ln J)^2 + G sum_i (ln lambda_i)^2, lambda_i the principal stretches.

    Plane strain in 2D.  Hencky (1928); a small constant under the root keeps the derivatives of the
    eigenvalues of C = F^T F finite where they coincide.  It enters the deviatoric part only, whose
    derivative vanishes there: at rest there is no stress at all.
    """

    @staticmethod
    def energy(F, bulk, shear):
        d, ln_J = F.ufl_shape[0], ufl.ln(ufl.det(F))
        logs = [ufl.ln(e) / 2 for e in _eigenvalues_over_mean(F.T * F)]
        deviatoric = sum(l**2 for l in logs) - sum(logs) ** 2 / d
        return ((bulk - 2 * shear / 3) / 2 + shear / d) * ln_J**2 + shear * deviatoric


def _eigenvalues_over_mean(C):
    """Return the eigenvalues of a symmetric 2x2 or 3x3 tensor, divided by their mean, as UFL."""
    if C.ufl_shape[0] == 2:
        mean = (C[0, 0] + C[1, 1]) / 2
        radius = ufl.sqrt(((C[0, 0] - C[1, 1]) ** 2 + 4 * C[0, 1] ** 2) / (4 * mean**2) + 2.5e-9)
        return 1 + radius, 1 - radius
    mean = ufl.tr(C) / 3
    D = C / mean - ufl.Identity(3)
    r = ufl.sqrt(ufl.inner(D, D) / 6 + 1e-10)
    phi = ufl.acos((1 - 1e-6) * ufl.det(D) / (2 * r * r * r)) / 3
    return tuple(1 + 2 * r * ufl.cos(phi + 2 * ufl.pi * k / 3) for k in range(3))


@dataclass(frozen=True)
class NeoHookean(Skeleton):
    """Compressible neo-Hookean law: psi = G/2 (F:F - d - 2 ln J) + lambda/2 (ln J)^2."""

    @staticmethod
    def energy(F, bulk, shear):
        ln_J = ufl.ln(ufl.det(F))
        lam = bulk - 2 * shear / 3
        return shear / 2 * (ufl.inner(F, F) - F.ufl_shape[0] - 2 * ln_J) + lam / 2 * ln_J**2


@dataclass(frozen=True)
class LinearElastic(Skeleton):
    """Linear elasticity of small strain: psi = lambda/2 (tr eps)^2 + G eps:eps, eps = sym F - I.

    The law of the seed paper; not objective, so only for small rotations.
    """

    @staticmethod
    def energy(F, bulk, shear):
        eps = ufl.sym(F) - ufl.Identity(F.ufl_shape[0])
        return (bulk - 2 * shear / 3) / 2 * ufl.tr(eps) ** 2 + shear * ufl.inner(eps, eps)


LAWS = {"hencky": Hencky, "neo-hookean": NeoHookean, "linear": LinearElastic}


@dataclass(frozen=True)
class Fluid:
    """Pore fluid.

    Parameters
    ----------
    bulk
        Bulk modulus K_w, Pa, > 0; infinite for an incompressible fluid.
    density
        Density rho_w, kg/m^3, > 0.
    """

    bulk: float = 2.2e9
    density: float = 1000.0

    def __post_init__(self):
        for f in fields(self):
            _check(self, f.name, 0 < getattr(self, f.name), "> 0")

    @property
    def unit_weight(self) -> float:
        """Unit weight rho_w g, N/m^3, that turns a hydraulic conductivity into a mobility k/(rho_w g)."""
        return self.density * STANDARD_GRAVITY


STANDARD_GRAVITY = 9.81  # m/s^2, by which hydraulic conductivities are defined
