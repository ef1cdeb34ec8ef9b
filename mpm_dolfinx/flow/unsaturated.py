# SPDX-License-Identifier: MIT
"""Fluxes in soil whose pores drain: conductivities by the pressures on both sides of a face.

Through a face soil conducts as on the mean over the pressures between the two sides (`retention.Conductance`): neither
that of the wetter side, which would let a front run ahead, nor the mean of both.  A cell that holds several soils
conducts by the sum of their shares.  In series their resistances are those at the start of a substep.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import CENTRAL
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.pores.retention import Conductance, Retentions


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
        self._laws = [Conductance(grid, law) for law in retentions.laws]
        self.count = 1 + len(self._laws)
        self.shares = fem.Function(grid.cellwise((self.count,)))
        self._tables = fem.Function(grid.cellwise((3 * len(self._laws),)))
        self._mesh = grid.mesh

    def between(self, pressure: fem.Function) -> tuple[list, list]:
        """Return k_r of each law between the two sides of a face as UFL variables, and their slopes by both pressures.

        It is the quotient of the differences of the integral and the pressure, or the mean where these are next to
        nothing.
        """
        p0, p1 = pressure("+"), pressure("-")
        means, slopes = [], []
        for i, law in enumerate(self._laws):
            (phi0, k0, d0), (phi1, k1, d1) = ([self._tables(side)[3 * i + j] for j in range(3)] for side in "+-")
            scale = fem.Constant(self._mesh, law.scale)
            close = ufl.lt(abs(p0 - p1), CENTRAL * (abs(p0) + abs(p1) + scale))
            apart = ufl.conditional(close, 1.0, p0 - p1)
            k = ufl.conditional(close, (k0 + k1) / 2, (phi0 - phi1) / apart)
            means.append(ufl.variable(k))
            by_both = (
                ufl.conditional(close, d0 / 2, (k0 - k) / apart),
                ufl.conditional(close, d1 / 2, (k - k1) / apart),
            )
            slopes.append(by_both)
        return means, slopes

    def conducts(self, side: str, means: Sequence):
        """Return the mobility of the cell on a side of a face, as UFL of k_r of each law there."""
        return self.shares(side)[0] + sum(self.shares(side)[1 + i] * k for i, k in enumerate(means))

    def set_pressures(self, p: NDArray[np.float64]) -> None:
        """Set what forms see of the pressures of the local cells (c,), Pa."""
        self._tables.x.array[:] = np.concatenate([law(p) for law in self._laws], axis=1).ravel()

    def through_sides(
        self, cells: NDArray[np.int32], p: NDArray[np.float64], outer: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mobilities (m,) of owned cells between their pressures and others (m,), Pa, and slopes by theirs."""
        shares = self.shares.x.array.reshape(-1, self.count)[cells]
        k, slope = shares[:, 0].copy(), np.zeros(len(p))
        for law, share in zip(self._laws, shares.T[1:], strict=True):
            (phi, here, d), (beyond, there, _) = law(p).T, law(outer).T
            close = np.abs(p - outer) < CENTRAL * (np.abs(p) + np.abs(outer) + law.scale)
            apart = np.where(close, 1.0, p - outer)
            mean = np.where(close, (here + there) / 2, (phi - beyond) / apart)
            k += share * mean
            slope += share * np.where(close, d / 2, (here - mean) / apart)
        return k, slope

    def set_shares(self, filled: NDArray[np.int64], shares: NDArray[np.float64]) -> None:
        """Set the shares (n, count) of the filled owned cells."""
        self.shares.x.array[:] = 0.0
        self.shares.x.array.reshape(-1, self.count)[filled] = shares
        self.shares.x.scatter_forward()
