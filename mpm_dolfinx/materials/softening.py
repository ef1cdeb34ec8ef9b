# SPDX-License-Identifier: MIT
"""Drucker and Prager's law with a viscosity, and with a cohesion that decreases with slip.

Softening localises in shear bands one cell wide.  If the cohesion depended on strain, the dissipated work would
decrease with the cell size.  The cohesion c therefore depends on the slip gamma h of a band.  Here gamma is the plastic
shear strain, and h is the cell size (crack band: Bazant and Oh 1983; Pietruszczak and Mroz 1981),

    c = c_0 - (c_0 - c_r) min(1, gamma h / s).

c_0 is the initial cohesion, c_r is the residual cohesion, and s is the slip at which c = c_r.  Softening along a band
dissipates the work (c_0 - c_r) s / 2 per area, on any grid.  Perzyna's viscosity is f = eta dgamma/dt, with the yield
function f and the viscosity eta.  The viscosity is integrated implicitly, and has no effect in slow loading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import ufl

from mpm_dolfinx.base.tolerances import TINY
from mpm_dolfinx.materials.drucker_prager import DruckerPrager, metric, returned, stress
from mpm_dolfinx.materials.skeleton import Field, _check, check_given
from mpm_dolfinx.materials.trial import Trial

GIVEN = {"residual": "in [0, cohesion] Pa", "slip": "> 0 m"}
"""Required constants and their ranges."""


@dataclass(frozen=True, kw_only=True)
class SofteningDruckerPrager(DruckerPrager):
    """Drucker-Prager soil with a viscosity, and with a cohesion that decreases with slip.

    Parameters
    ----------
    residual
        Residual cohesion c_r, Pa, in [0, cohesion]; c_r = c_0 means no softening.
    slip
        Slip s along a shear band, m, > 0, at which the cohesion has fallen to c_r.  `Simulation` raises ValueError if
        cells are so large that soil would soften faster than it unloads elastically.
    viscosity
        Viscosity eta of Perzyna's law f = eta dgamma/dt, Pa s, >= 0, with the yield function f of `DruckerPrager`.

    Other parameters: see `DruckerPrager`; `hardening` must be 0.  The state variable `plastic` is the inverse plastic
    metric C_p^-1 (3, 3).  The state variable `hardened` is xi gamma, where xi is the coefficient of the cohesion, and
    gamma is the plastic shear strain.  Soil in tension at the apex of the cone has the cohesion c_r.

    Raises
    ------
    ValueError
        A constant is out of its range or missing.
    """

    residual: Field = None
    slip: Field = None
    viscosity: Field = 0.0

    state: ClassVar = {"plastic": np.eye(3), "hardened": 0.0}

    def __post_init__(self):
        super().__post_init__()
        check_given(self, GIVEN)
        _check(self, "hardening", lambda v: v == 0, "0: this law softens")
        _check(self, "slip", lambda v: (0 < v) & (v < np.inf), "> 0 and finite")
        _check(self, "viscosity", lambda v: (0 <= v) & (v < np.inf), ">= 0 and finite")
        if not callable(self.cohesion):
            _check(self, "residual", lambda v: (0 <= v) & (v <= self.cohesion), "in [0, cohesion]")

    @property
    def cone(self):
        """Coefficients (..., 3): eta and xi in the yield function, and eta in the plastic potential."""
        return np.stack(np.broadcast_arrays(self.eta, self.xi, self.eta_flow), axis=-1)

    def check_cells(self, cell_size: float) -> None:
        stiff = self.shear + self.bulk * self.eta * self.eta_flow
        least = self.xi * (self.cohesion - self.residual) * cell_size / stiff
        least, slip = (np.ravel(values) for values in np.broadcast_arrays(least, self.slip))
        if (least >= slip).any():
            worst = (least / slip).argmax()
            what = f"{type(self).__name__}: slip = {slip[worst]:g}, must be > {least[worst]:.3g} m in cells of"
            raise ValueError(f"{what} {cell_size:g} m, else the soil softens faster than it unloads")

    @staticmethod
    def kirchhoff(F, bulk, shear, cone, cohesion, residual, slip, viscosity, plastic, hardened, dt, cell_size):
        """Return the Kirchhoff stress (3, 3), in Pa, as UFL."""
        trial = Trial(F, plastic)
        strength = cohesion, residual, slip / cell_size, viscosity / (dt + TINY)
        return stress(trial, _softened(trial, bulk, shear, cone, hardened, *strength), shear)

    @staticmethod
    def update(F, bulk, shear, cone, cohesion, residual, slip, viscosity, plastic, hardened, dt, cell_size):
        """Return the state at the end of the step as UFL, by name."""
        trial = Trial(F, plastic)
        strength = cohesion, residual, slip / cell_size, viscosity / (dt + TINY)
        to = _softened(trial, bulk, shear, cone, hardened, *strength)
        return {"plastic": metric(trial, to, bulk, plastic), "hardened": hardened + to["hardened"]}


def _softened(trial: Trial, bulk, shear, cone, hardened, cohesion, residual, strain, drag) -> dict:
    """Return the result of `drucker_prager.returned` with softening.  At the plastic strain `strain`, c = c_r."""
    end = cone[1] * strain  # value of `hardened` at which c = c_r
    moduli = trial, bulk, shear, *cone
    falling = returned(*moduli, cohesion, (residual - cohesion) / end, hardened, drag)
    left = returned(*moduli, residual, 0.0, hardened, drag)
    # soil in tension at the apex has the residual cohesion
    grown = hardened + falling["hardened"]
    softens = ufl.le(ufl.conditional(ufl.gt(falling["apex"], 0.5), 2 * end, grown), end)
    out = {name: ufl.conditional(softens, falling[name], left[name]) for name in ("p", "ratio", "hardened")}
    yields = (ufl.conditional(to["yields"], 1.0, 0.0) for to in (falling, left))
    return out | {"yields": ufl.gt(ufl.conditional(softens, *yields), 0.5)}
