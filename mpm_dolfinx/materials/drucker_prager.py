# SPDX-License-Identifier: MIT
"""Drucker and Prager's elastoplasticity at finite strain: a law that gives its stress and has a state.

Multiplicative, in principal logarithmic strains: the inverse plastic metric C_p^-1 is the state, the trial
elastic strain is eps = ln(b)/2 with b = F C_p^-1 F^T, elasticity is Hencky's, tau = K tr(eps) I + 2G dev eps,
and the return to the yield surface

    f = sqrt(J_2) + eta p - xi c <= 0,   p = tr(tau)/3 (tension positive),  c = c_0 + H kappa,

is that of small strain, in closed form, to the cone or to its apex (de Souza Neto, Peric and Owen 2008, 8.3 and
14.6).  All of it is UFL; the consistent tangent is UFL's derivative of the stress.
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
"""How the cone meets Mohr and Coulomb's pyramid: (eta, xi) from tangent, sine and cosine of the friction angle."""
LEAST = 1e-20
"""Under the root of the deviatoric strain's square: keeps its derivative finite.

Plateau (soil): halved 2.3e-11, doubled 1.0e-11, cells 3.0e-02.
"""


@dataclass(frozen=True, kw_only=True)
class DruckerPrager(Frictional):
    """Hencky elasticity with a Drucker-Prager yield surface in Kirchhoff stress, perfectly plastic or hardening.

    Parameters
    ----------
    friction
        Friction angle phi, degrees, in [0, 90).
    dilation
        Dilation angle psi, degrees, in [0, friction]; equal to the friction angle the flow is associated, and the
        tangent symmetric.
    cohesion
        Cohesion c_0, Pa, >= 0.  Without any, points without pressure have no stiffness.
    hardening
        Linear hardening H, Pa, >= 0: c = c_0 + H kappa, kappa the accumulated plastic strain (the work conjugate
        of c in associated flow).
    match
        The cone meets Mohr and Coulomb's surface in "plane strain" (the same collapse load there; for associated
        flow exactly), triaxial "compression" (outer cone) or triaxial "extension" (inner cone).  In axisymmetry none
        is Mohr and Coulomb's at all places: von Mises's circular footing carries a tenth less than Tresca's.

    The other parameters are those of `Skeleton`, all by name.  The state is `plastic`, C_p^-1 (3, 3), and
    `hardened`, kappa, in `points.data`.  De Souza Neto, Peric and Owen (2008), 8.3 and 14.6.

    Raises
    ------
    ValueError
        Naming the constant that is out of its range, or is not given: friction, dilation and cohesion have no
        values that are safe to assume.
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
        """Slope of the cone."""
        return self._cone(self.friction)[0]

    @property
    def xi(self):
        """Factor of the cohesion."""
        return self._cone(self.friction)[1]

    @property
    def eta_flow(self):
        """Slope of the cone of the plastic potential."""
        return self._cone(self.dilation)[0]

    @staticmethod
    def kirchhoff(F, bulk, shear, eta, xi, eta_flow, cohesion, hardening, plastic, hardened):
        """Return the Kirchhoff stress (3, 3), Pa, as UFL."""
        trial = Trial(F, plastic)
        to = returned(trial, bulk, shear, eta, xi, eta_flow, cohesion, hardening, hardened)
        return stress(trial, to, shear)

    @staticmethod
    def update(F, bulk, shear, eta, xi, eta_flow, cohesion, hardening, plastic, hardened):
        """Return the state at the end of the step, name -> UFL."""
        trial = Trial(F, plastic)
        to = returned(trial, bulk, shear, eta, xi, eta_flow, cohesion, hardening, hardened)
        return {"plastic": metric(trial, to, bulk, plastic), "hardened": hardened + to["hardened"]}


def stress(trial: Trial, to: dict, shear):
    """Return the Kirchhoff stress (3, 3), Pa, of what `returned` gives."""
    return to["p"] * ufl.Identity(3) + 2 * shear * to["ratio"] * trial.deviatoric


def metric(trial: Trial, to: dict, bulk, plastic):
    """Return C_p^-1 (3, 3) at the end of the step of what `returned` gives."""
    # b = exp(2 eps), the elastic strain now eps = p/(3K) I + ratio dev(trial eps)
    mean, ratio = 2 * to["p"] / (3 * bulk), to["ratio"]
    b = trial.isotropic(lambda e: ufl.exp(mean + ratio * (ufl.ln(e) - 2 * trial.volumetric / 3)))
    back = ufl.inv(trial.F)
    return ufl.conditional(to["yields"], back * b * back.T, plastic)


def returned(trial: Trial, bulk, shear, eta, xi, eta_flow, cohesion, hardening, hardened, drag=0.0) -> dict:
    """Return the stress of a trial elastic strain to the yield surface; drag: viscosity over time, Pa.

    Returns
    -------
    p, ratio: pressure and ratio of the deviator to its trial value; yields: whether the trial stress is outside;
    apex: 1 where it returns to the apex, else 0; hardened: growth of the hardening variable.
    """
    p = bulk * trial.volumetric
    q = shear * ufl.sqrt(2 * ufl.inner(trial.deviatoric, trial.deviatoric) + LEAST)  # sqrt(J_2)
    strength = xi * (cohesion + hardening * hardened)
    f = q + eta * p - strength
    cone = f / (shear + bulk * eta * eta_flow + xi**2 * hardening + drag)
    to_cone = ufl.le(shear * cone, q)
    slope = xi / (eta + EPSILON)  # no friction has no apex, but every branch must be finite
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
