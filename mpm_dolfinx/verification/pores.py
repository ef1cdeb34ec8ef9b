# SPDX-License-Identifier: MIT
"""Unsaturated pores in the finite element reference, whose pressures are scaled."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray

from mpm_dolfinx.pores.retention import GAUSS, property_of, restrained, scale_of


class Pores:
    """Saturation and permeability of pores with one retention curve.

    Parameters
    ----------
    domain
        Mesh of the forms.
    law
        Retention curve; None if the pores stay saturated.
    unit
        Scale, Pa: a scaled pressure is the pressure divided by this value.
    """

    def __init__(self, domain: mesh.Mesh, law, unit: float):
        self.law, self._unit = law, fem.Constant(domain, unit)
        if law is not None:
            self._scale = scale_of(law) / unit
            self._drains = fem.Constant(domain, self._scale)

    def of(self, name: str, p):
        """Return a property of the pores at the scaled pressure p as UFL.  `Retentions.of` lists the names."""
        return ufl.as_ufl(1.0) if self.law is None else property_of(self.law, name, self._unit * p)

    def between(self, p0, p1):
        """Return the mean of k_r between the scaled pressures p0 and p1 as a UFL expression.

        The mean is computed by Gauss quadrature over `retention.logarithm`.  With quadrature over the pressure, all
        quadrature points between a wet cell and a very dry cell would be dry.
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
        """Return the pressure decreases of a Newton step after limitation, see `retention.restrained`.

        `p` (n,): scaled pressures.
        `dp` (n,): scaled pressure decreases before limitation.
        """
        return restrained(p, dp, self._scale)
