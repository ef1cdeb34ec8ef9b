# SPDX-License-Identifier: MIT
"""Fluxes in soil whose pores drain: conductivities by the pressures on both sides of a face.

Through a face soil conducts as on the mean over the pressures between the two sides (`retention.mean_between`): neither
that of the wetter side, which would let a front run ahead, nor the mean of both.  A cell that holds several soils
conducts by the sum of their shares.  In series their resistances are those at the start of a substep.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import pressure_of
from mpm_dolfinx.flow.fluxes import OpenFaces
from mpm_dolfinx.forms.point_forms import FormPoints, PointExpression
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.materials.retention import Retentions, anywhere, mean_between


class Relative:
    """Conductivities of cells by their pressures.

    Parameters
    ----------
    grid
        Background grid.
    retentions
        The laws of the scene.

    Attributes
    ----------
    shares
        DG0: mobilities, m^2/(Pa s), that soils with full pores bring to a cell, and each of the laws, at k_r = 1.
    """

    def __init__(self, grid: Grid, retentions: Retentions):
        self._laws = retentions.constants(grid)
        self.count = 1 + len(self._laws)
        self.shares = fem.Function(grid.cellwise((self.count,)))
        self._points = points = FormPoints(grid, p=(), outer=(), shares=(self.count,))
        p = ufl.variable(points.p)
        k = self.conducts(points.shares, p, points.outer)
        self._values = PointExpression(ufl.as_vector([k, ufl.diff(k, p)]), points)

    def conducts(self, shares, p0, p1):
        """Return the mobility between two pressures, Pa, of a cell with these shares, as UFL."""
        return shares[0] + sum(shares[1 + i] * mean_between(law, p0, p1) for i, law in enumerate(self._laws))

    def between(
        self, cells: NDArray[np.int32], p: NDArray[np.float64], outer: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mobilities (m,) of owned cells between their pressures and others (m,), Pa, and slopes by theirs."""
        shares = self.shares.x.array.reshape(-1, self.count)[cells]
        k, slope = self._values.evaluate(anywhere(self._points, p=p, outer=outer, shares=shares)).T
        return k, slope

    def set_shares(self, filled: NDArray[np.int64], shares: NDArray[np.float64]) -> None:
        """Set the shares (n, count) of the filled owned cells."""
        self.shares.x.array[:] = 0.0
        self.shares.x.array.reshape(-1, self.count)[filled] = shares
        self.shares.x.scatter_forward()


@dataclass(frozen=True)
class UnsaturatedFaces(OpenFaces):
    """Faces on open sides of soil whose pores drain.

    conductance (m,): over the mobility; inflow (m,): what is prescribed, m^d/s.  cells (m,): behind the faces; beyond
    (m,): pressures there, Pa; outer (m,): mass potentials there, less the weight of the fluid in between, Pa.
    """

    relative: Relative
    cells: NDArray[np.int32]
    beyond: NDArray[np.float64]
    outer: NDArray[np.float64]
    bulk: float

    def through(self, pi: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what leaves through each face (m,), m^d/s, and its derivative by the cell's pressure, m^d/(Pa s)."""
        p = pressure_of(pi, self.bulk)[self.at]
        k, slope = self.relative.between(self.cells, p, self.beyond)
        drives = pi[self.at] - self.outer
        leaves = self.conductance * k * drives
        rises = self.conductance * (k + slope * drives)
        shut = self.seeps & (leaves < 0)
        return np.where(shut, 0.0, leaves) - self.inflow, np.where(shut, 0.0, rises)

    def outflow(self, pi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what leaves through each face from cells at potentials (n,), Pa; m^d/s."""
        return self.through(pi)[0]

    def seepage(self, pi: NDArray[np.float64], flows: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
        """Return what leaves cells (n,) through all faces, m^d/s, and its derivative, m^d/(Pa s)."""
        return tuple(sum_by(self.at, values, len(pi)) for values in self.through(pi))
