# SPDX-License-Identifier: MIT
"""Drucker and Prager's elastoplasticity at finite strain.

Plasticity is multiplicative, in principal logarithmic strains.  The state is the inverse plastic metric C_p^-1.  With
b = F C_p^-1 F^T, the trial elastic strain is eps = ln(b)/2.  Elasticity is Hencky's: the Kirchhoff stress is
tau = K tr(eps) I + 2G dev eps.  The trial stress returns to the yield surface

    f = sqrt(J_2) + eta p - xi c <= 0,   p = tr(tau)/3 (tension positive),  c = c_0 + H kappa,

with J_2 = dev tau : dev tau / 2, the cohesion c, the accumulated plastic strain kappa, and eta and xi from `MATCHES`.
The return mapping has the closed form of small-strain plasticity, on the cone and at its apex (de Souza Neto, Peric and
Owen 2008, 8.3 and 14.6).  The consistent tangent is UFL's derivative of the stress.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import ufl

from mpm_dolfinx.base.tolerances import EPSILON
from mpm_dolfinx.materials.frictional import Frictional
from mpm_dolfinx.materials.skeleton import Field, _check
from mpm_dolfinx.materials.trial import Trial

MATCHES = {
    # Source: Drucker and Prager (1952)
    "plane strain": lambda t, s, c: (t / np.sqrt(1 + 4 / 3 * t**2), 1 / np.sqrt(1 + 4 / 3 * t**2)),
    "compression": lambda t, s, c: (6 * s / np.sqrt(3) / (3 - s), 6 * c / np.sqrt(3) / (3 - s)),
    "extension": lambda t, s, c: (6 * s / np.sqrt(3) / (3 + s), 6 * c / np.sqrt(3) / (3 + s)),
}
"""For each fit to the Mohr-Coulomb law: a function of tan phi, sin phi and cos phi that returns eta and xi."""
LEAST = 1e-20
"""Constant added to the squared deviatoric strain under a square root, so that the root is differentiable at zero.
Sensitivity (scene "soil" of tests/plateaus.py): half this value changes the result by 2.3e-11, and twice this value by
1.0e-11. Finer cells change it by 3.0e-02.
"""


@dataclass(frozen=True, kw_only=True)
class DruckerPrager(Frictional):
    """Perfectly plastic or hardening law with Hencky elasticity, and with a Drucker-Prager cone in Kirchhoff stress.

    Parameters
    ----------
    friction
        Friction angle phi, degrees, in [0, 90).
    dilation
        Dilation angle psi, degrees, in [0, friction].  If psi = phi, flow is associated and the tangent is symmetric.
    cohesion
        Cohesion c_0, Pa, >= 0.  If c_0 is zero, soil without mean stress has no stiffness.
    hardening
        Linear hardening modulus H, Pa, >= 0: c = c_0 + H kappa, with the accumulated plastic strain kappa.
    match
        Stress states in which the cone coincides with the Mohr-Coulomb yield surface.  "plane strain" gives the
        collapse load of the Mohr-Coulomb law in plane strain; this load is exact for associated flow.  "compression" is
        the outer cone of triaxial compression, and "extension" is the inner cone of triaxial extension.  In axisymmetry
        no cone fits all stress states: a circular footing bears 10 % less with von Mises's law than with Tresca's.

    Other parameters: see `Skeleton`.  All parameters are passed by name.  The state variable `plastic` in `points.data`
    is the inverse plastic metric C_p^-1 (3, 3), and `hardened` is kappa.  Source: de Souza Neto, Peric and Owen (2008),
    8.3 and 14.6.

    Raises
    ------
    ValueError
        A constant is out of its range or missing.  Friction, dilation and cohesion have no default values.
    """

    hardening: Field = 0.0
    match: str = "plane strain"

    elastic_hencky: ClassVar = True
    state: ClassVar = {"plastic": np.eye(3), "hardened": 0.0}

    def __post_init__(self):
        super().__post_init__()
        if self.match not in MATCHES:
            raise ValueError(f"{type(self).__name__}: match = {self.match!r}, must be one of {', '.join(MATCHES)}")
        _check(self, "hardening", lambda v: 0 <= v, ">= 0")

    def _cone(self, angle):
        angle = np.radians(angle)
        return MATCHES[self.match](np.tan(angle), np.sin(angle), np.cos(angle))

    @property
    def eta(self):
        """Coefficient eta of the pressure in the yield function."""
        return self._cone(self.friction)[0]

    @property
    def xi(self):
        """Coefficient xi of the cohesion in the yield function."""
        return self._cone(self.friction)[1]

    @property
    def eta_flow(self):
        """Coefficient of the pressure in the plastic potential: eta, computed with the dilation angle."""
        return self._cone(self.dilation)[0]

    @staticmethod
    def kirchhoff(F, bulk, shear, eta, xi, eta_flow, cohesion, hardening, plastic, hardened):
        """Return the Kirchhoff stress (3, 3), in Pa, as UFL."""
        trial = Trial(F, plastic)
        to = returned(trial, bulk, shear, eta, xi, eta_flow, cohesion, hardening, hardened)
        return stress(trial, to, shear)

    @staticmethod
    def update(F, bulk, shear, eta, xi, eta_flow, cohesion, hardening, plastic, hardened):
        """Return the state at the end of the step as UFL, by name."""
        trial = Trial(F, plastic)
        to = returned(trial, bulk, shear, eta, xi, eta_flow, cohesion, hardening, hardened)
        return {"plastic": metric(trial, to, bulk, plastic), "hardened": hardened + to["hardened"]}


def stress(trial: Trial, to: dict, shear):
    """Return the Kirchhoff stress (3, 3), in Pa, from the result of `returned`."""
    return to["p"] * ufl.Identity(3) + 2 * shear * to["ratio"] * trial.deviatoric


def metric(trial: Trial, to: dict, bulk, plastic):
    """Return C_p^-1 (3, 3) at the end of the step from the result of `returned`."""
    # b = exp(2 eps) with the elastic strain eps = p/(3K) I + ratio dev(trial eps)
    mean, ratio = 2 * to["p"] / (3 * bulk), to["ratio"]
    b = trial.isotropic(lambda e: ufl.exp(mean + ratio * (ufl.ln(e) - 2 * trial.volumetric / 3)))
    inverse = ufl.inv(trial.F)
    return ufl.conditional(to["yields"], inverse * b * inverse.T, plastic)


def returned(trial: Trial, bulk, shear, eta, xi, eta_flow, cohesion, hardening, hardened, drag=0.0) -> dict:
    """Return the stress and the hardening that the return mapping gives for a trial strain.

    `drag`: viscosity of Perzyna's law divided by the time step, in Pa.

    Returns
    -------
    `p`: mean stress, in Pa, tension positive.
    `ratio`: final deviatoric stress divided by the trial deviatoric stress.
    `hardened`: increment of the accumulated plastic strain.
    `yields`: whether the trial stress is outside the yield surface.
    `apex`: 1 if the stress returns to the apex, and 0 otherwise.
    """
    p = bulk * trial.volumetric
    q = shear * ufl.sqrt(2 * ufl.inner(trial.deviatoric, trial.deviatoric) + LEAST)  # sqrt(J_2)
    strength = xi * (cohesion + hardening * hardened)
    f = q + eta * p - strength
    cone = f / (shear + bulk * eta * eta_flow + xi**2 * hardening + drag)
    to_cone = ufl.le(shear * cone, q)
    slope = xi / (eta + EPSILON)  # without friction the cone has no apex, but every branch must be finite
    apex = (p - strength / (eta + EPSILON)) / (bulk + slope**2 * hardening)
    yields = ufl.gt(f, 0)

    def choose(elastic, on_cone, at_apex):
        return ufl.conditional(yields, ufl.conditional(to_cone, on_cone, at_apex), elastic)

    return {
        "p": p - choose(0.0, bulk * eta_flow * cone, bulk * apex),
        "ratio": 1 - choose(0.0, shear * cone / q, 1.0),
        "hardened": choose(0.0, xi * cone, slope * apex),
        "yields": yields,
        "apex": choose(0.0, 0.0, 1.0),
    }
