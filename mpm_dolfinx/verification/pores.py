# SPDX-License-Identifier: MIT
"""Pores of the finite element reference that drain under suction, see `retention`; pressures are over a unit."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray

from mpm_dolfinx.pores.retention import GAUSS, property_of, restrained, scale_of


class Pores:
    """Pores of one law.

    Parameters
    ----------
    domain
        Mesh of the forms.
    law
        The law of retention; None: pores stay full.
    unit
        Unit of the pressures, Pa.
    """

    def __init__(self, domain: mesh.Mesh, law, unit: float):
        self.law, self._unit = law, fem.Constant(domain, unit)
        if law is not None:
            self._scale = scale_of(law) / unit
            self._drains = fem.Constant(domain, self._scale)

    def of(self, name: str, p):
        """Return a property at pressures p as UFL: see `Retentions.of`."""
        return ufl.as_ufl(1.0) if self.law is None else property_of(self.law, name, self._unit * p)

    def between(self, p0, p1):
        """Return the mean of k_r over the pressures between two as UFL.

        Its points of integration lie evenly on the scale of `retention.logarithm`. On the scale of the pressure all of
        them would be dry between a wet cell and a very dry one.
        """
        if self.law is None:
            return 1.0
        ends = []
        for p in (p0, p1):
            dry = ufl.max_value(-p / self._drains, 0.0)
            ends.append(ufl.max_value(p / self._drains, 0.0) - ufl.ln(dry + ufl.sqrt(dry**2 + 1)))
        total = mean = 0.0
        for x, weight in zip(*np.polynomial.legendre.leggauss(GAUSS), strict=True):
            y = (ends[0] + ends[1]) / 2 + float(x) * (ends[0] - ends[1]) / 2
            dry = ufl.min_value(y, 0.0)
            share = float(weight) * ufl.cosh(dry)
            p = self._drains * (ufl.max_value(y, 0.0) + ufl.sinh(dry))
            mean += share * self.of("relative_permeability", p)
            total += share
        return mean / total

    def reached(self, p: NDArray[np.float64], dp: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return by how much pressures p (n,) are to fall where Newton's method asks for falls dp (n,)."""
        return restrained(p, dp, self._scale)
