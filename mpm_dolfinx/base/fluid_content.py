# SPDX-License-Identifier: MIT
"""Fluid content of the pores: the quantity stored in the fluid balance.

Let alpha be Biot's coefficient, J the volume ratio, and p the pore pressure.  The content zeta per reference volume
changes by d zeta = alpha dJ + S J dp.  The storage coefficient S = n / K_w + (alpha - n) / K_s contains the bulk moduli
K_w of water and K_s of grains.  The porosity is n = 1 - (1 - n0) / J, where n0 is the porosity at J = 1.  Therefore S J
is a linear function a J + b of J, where a is the value of S at n = 1, and

    d zeta = (alpha / rho) d[(J + b / a) rho],    rho = exp(a p / alpha).

The term in brackets is the mass of a fluid of density rho that fills the volume J + b / a.  The change of zeta in a
step is alpha times the change of this mass, divided by rho at the mean pressure of the step.  This formula is
second-order accurate for any J(t), p(t).  If no fluid flows, the change of zeta is exactly zero in a step of any size.

Fluxes between cells conserve mass.  The density of the fluid is rho_w exp(p / K_w).  The mass flux is -rho_w kappa grad
pi.  The mobility kappa is the conductivity divided by the unit weight.  Kirchhoff's transformation gives the mass
potential pi = K_w (exp(p / K_w) - 1).  The mean density between the pressures p- and p+ is rho_w (pi+ - pi-) / (p+ -
p-).
"""

from __future__ import annotations

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import EPSILON

SERIES = (120 * EPSILON) ** 0.25
"""Argument z below which (sinh(z) / z) is computed as (1 + z^2 / 6).  Source: the next term z^4 / 120 is epsilon."""


def change_of_content(alpha, a, storage, J, dp):
    """Return as UFL the change of the fluid content in a step, divided by the volume at the start of the step.

    `alpha`: Biot coefficient.
    `a`, `storage`: storage coefficient S, in 1/Pa, at the porosity 1 (`a`), and at the start of the step (`storage`).
    `J`: volume at the end of the step, divided by the volume at its start.
    `dp`: change of the pore pressure, Pa.
    """
    z = a * dp / (2 * alpha)
    return _change(alpha, a, storage, J, dp, ufl.cosh(z), _sinhc(z))


def change_at_points(alpha, a, storage, J, dp) -> NDArray[np.float64]:
    """Return the changes (n,) of the fluid content of points in a step, see `change_of_content`."""
    z = a * dp / (2 * alpha)
    small = np.abs(z) < SERIES
    away = np.where(small, 1.0, z)
    return _change(alpha, a, storage, J, dp, np.cosh(z), np.where(small, 1 + z**2 / 6, np.sinh(away) / away))


def mass_potential(p, bulk: float):
    """Return the mass potentials pi (n,) at pressures p (n,), both in Pa.

    `bulk`, Pa: bulk modulus K_w of water.
    """
    return p if np.isinf(bulk) else bulk * np.expm1(p / bulk)


def pressure_of(pi, bulk: float):
    """Return the pressures (n,) at mass potentials pi (n,), both in Pa.

    `bulk`, Pa: bulk modulus K_w of water.
    """
    return pi if np.isinf(bulk) else bulk * np.log1p(pi / bulk)


def mass_potential_form(p, compliance):
    """Return as UFL the mass potential pi at the pressure p, both in Pa.

    `compliance`: compressibility 1 / K_w of water, in 1/Pa.
    """
    return p * density_between(p, 0.0, compliance)


def density_between(p0, p1, compliance):
    """Return as UFL the mean density between two pressures, in Pa, divided by the density at p = 0."""
    return ufl.exp(compliance * (p0 + p1) / 2) * _sinhc(compliance * (p0 - p1) / 2)


def mean_density(p0, p1, bulk: float) -> NDArray[np.float64]:
    """Return `density_between` as numbers (n,), for pressures p0 and p1 (n,), in Pa.  `bulk` is K_w, in Pa."""
    z = (p0 - p1) / (2 * bulk)
    small = np.abs(z) < SERIES
    away = np.where(small, 1.0, z)
    return np.exp((p0 + p1) / (2 * bulk)) * np.where(small, 1 + z**2 / 6, np.sinh(away) / away)


def _sinhc(z):
    small = ufl.lt(abs(z), SERIES)
    away = ufl.conditional(small, 1.0, z)  # UFL evaluates and differentiates both branches
    return ufl.conditional(small, 1 + z**2 / 6, ufl.sinh(away) / away)


def _change(alpha, a, storage, J, dp, cosh, sinhc):
    return alpha * (J - 1) * cosh + (storage + a * (J - 1) / 2) * dp * sinhc
