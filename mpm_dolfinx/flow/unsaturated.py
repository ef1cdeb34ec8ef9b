# SPDX-License-Identifier: MIT
"""Fluxes in soil whose pores drain: conductivities by the pressures on both sides of a face.

Through a face soil conducts as on the mean over the pressures between the two sides (`retention.Conductance`): neither
that of the wetter side, which would let a front run ahead, nor the mean of both.  A cell that holds several soils
conducts by the sum of their shares.  In series their resistances are those at the start of a substep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import pressure_of
from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.flow.fluxes import OpenFaces
from mpm_dolfinx.grid.grid import Grid, sum_by
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
            close = ufl.lt(abs(p0 - p1), SAME * (abs(p0) + abs(p1) + scale))
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
            close = np.abs(p - outer) < SAME * (np.abs(p) + np.abs(outer) + law.scale)
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

    def through(self, pi: NDArray[np.float64], even: bool = False) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what leaves through each face (m,), m^d/s, and its derivative by the cell's pressure, m^d/(Pa s).

        even: but for that of what the weight drives.
        """
        p = pressure_of(pi, self.bulk)[self.at]
        k, slope = self.relative.through_sides(self.cells, p, self.beyond)
        drives = pi[self.at] - self.outer
        leaves = self.conductance * k * drives
        rises = self.conductance * (k + slope * (p - self.beyond if even else drives))
        shut = self.seeps & (leaves < 0)
        return np.where(shut, 0.0, leaves) - self.inflow, np.where(shut, 0.0, rises)

    def outflow(self, pi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what leaves through each face from cells at potentials (n,), Pa; m^d/s."""
        return self.through(pi)[0]

    def seepage(self, pi: NDArray[np.float64], flows: NDArray[np.bool_], even: bool = False) -> tuple[NDArray, NDArray]:
        """Return what leaves cells (n,) through all faces, m^d/s, and its derivative, m^d/(Pa s)."""
        return tuple(sum_by(self.at, values, len(pi)) for values in self.through(pi, even))
