# SPDX-License-Identifier: MIT
"""Fluxes in unsaturated soil: conductivities of faces from the pressures on both sides.

The relative conductivity k_r of a face is the mean of k_r over all pressures between the pressures on both sides.  With
gravity, the mean is corrected so that steady flow with exponential k_r is exact (`fitted`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import CENTRAL, EPSILON, SECOND, TINY
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.pores.retention import Conductance, Retentions


class Functions(NamedTuple):
    """Elementary functions for one type of arguments: arrays or UFL expressions."""

    ln: Callable[[Any], Any]
    exp: Callable[[Any], Any]
    tanh: Callable[[Any], Any]
    where: Callable[[Any, Any, Any], Any]
    less: Callable[[Any, Any], Any]
    largest: Callable[[Any, Any], Any]


NUMPY = Functions(np.log, np.exp, np.tanh, np.where, np.less, np.maximum)
UFL = Functions(ufl.ln, ufl.exp, ufl.tanh, ufl.conditional, ufl.lt, ufl.max_value)


class Between(NamedTuple):
    """Relative conductivity k_r between the two sides of a face."""

    k: Any  # value of k_r
    slopes: tuple[Any, Any]  # derivatives with respect to the pressures on both sides, 1/Pa


def fitted(p: Sequence, tables: Sequence[Sequence], drop, scale, of: Functions) -> Between:
    """Return the relative conductivity k_r between the two sides of a face, with derivatives.

    Let k be the mean of k_r over the pressures between both sides (Kirchhoff 1894).  Let x be the jump of k_r, divided
    by k.  Let y be the product of x and `drop`, divided by the pressure jump.  With `s(z) = sinh(z / 2) / (z / 2)`, the
    result is `k s(x + y) / (s(x) s(y))`.  The result is exact for steady flow with an exponential k_r (Baker 1995).

    `p`: pressures on both sides, Pa.
    `tables`: three values on each side: integral of k_r (Pa), k_r, and derivative of k_r (1/Pa).
    `drop`: pressure drop due to the weight of the fluid, from the first side to the second, Pa.
    `scale`: characteristic suction of k_r, Pa.
    `of`: elementary functions of arrays or of UFL expressions.
    """
    (phi0, k0, d0), (phi1, k1, d1) = tables
    jump = p[0] - p[1]
    close = of.less(abs(jump), CENTRAL * (abs(p[0]) + abs(p[1]) + scale))
    divisor = of.where(close, 1.0, jump)
    mean = of.largest(of.where(close, (k0 + k1) / 2, (phi0 - phi1) / divisor), 0.0)
    rise0, rise1 = of.where(close, d0 / 2, (k0 - mean) / divisor), of.where(close, d1 / 2, (mean - k1) / divisor)
    least = of.largest(mean, EPSILON * (abs(k0) + abs(k1)) + TINY)
    x = (k0 - k1) / least
    x0, x1 = (d0 - x * rise0) / least, -(d1 + x * rise1) / least
    rate = of.where(close, (d0 + d1) / of.largest(k0 + k1, EPSILON * scale * abs(d0 + d1) + TINY), x / divisor)
    y = rate * drop
    y0, y1 = (of.where(close, 0.0, drop * (slope - sign * rate) / divisor) for slope, sign in ((x0, 1), (x1, -1)))
    (both, by_both), (one, by_one), (other, by_other) = (_log_sinhc(z, of) for z in (x + y, x, y))
    factor = of.exp(both - one - other)
    k = factor * mean
    sides = ((rise0, x0, y0), (rise1, x1, y1))
    slopes = (factor * slope_k + k * ((by_both - by_one) * dx + (by_both - by_other) * dy) for slope_k, dx, dy in sides)
    return Between(k, tuple(slopes))


def _log_sinhc(z, of: Functions) -> tuple[Any, Any]:
    """Return `ln(sinh(z / 2) / (z / 2))` and its derivative with respect to z."""
    small = of.less(abs(z), SECOND)
    half = of.where(small, 1.0, z / 2)
    size = abs(half)
    value = size + of.ln((1 - of.exp(-2 * size)) / (2 * size))
    return of.where(small, z * z / 24, value), of.where(small, z / 12, (1 / of.tanh(half) - 1 / half) / 2)


class Laws:
    """Relative conductivities as functions of pressure.  Index 0 is soil without a retention curve."""

    def __init__(self, grid: Grid, laws: Sequence):
        self.conductances = [Conductance(grid, law) for law in laws]
        self.scales = np.array([1 / TINY, *(law.scale for law in self.conductances)])
        """Characteristic suctions of the laws, Pa."""

    def between(
        self, law: NDArray[np.int64], p: Sequence[NDArray[np.float64]], drop: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return k_r (m,) between two pressures, and its derivatives (2, m), see `fitted`.

        `law` (m,): index of the retention curve of each face.
        `p`, Pa: pressures on both sides.
        """
        k, slopes = np.ones(len(law)), np.zeros((2, len(law)))
        for number, one in enumerate(self.conductances, 1):
            rows = np.flatnonzero(law == number)
            if len(rows):
                ends = [side[rows] for side in p]
                found = fitted(ends, [one(side).T for side in ends], drop[rows], one.scale, NUMPY)
                k[rows], slopes[:, rows] = found.k, found.slopes
        return k, slopes


class Relative:
    """Relative conductivities of cells as functions of the cell pressures.

    Attributes
    ----------
    shares
        Fractions (DG0) of a cell's saturated mobility: of soil without a retention curve, then of soil with each curve.
    laws
        Relative conductivities as functions of pressure.
    """

    def __init__(self, grid: Grid, retentions: Retentions):
        self.laws = Laws(grid, retentions.laws)
        self.count = len(self.laws.scales)
        self.shares = fem.Function(grid.cellwise((self.count,)))
        self._tables = fem.Function(grid.cellwise((3 * (self.count - 1),)))
        self._grid = grid
        self._borders: Latest[Any] = Latest()
        self._flows: Latest[Any] = Latest()

    def between(self, pressure: fem.Function, drop) -> list[Between]:
        """Return k_r of each law between the two sides of a face, as UFL variables, see `fitted`."""
        out = []
        for i, law in enumerate(self.laws.conductances):
            tables = [[self._tables(side)[3 * i + j] for j in range(3)] for side in "+-"]
            scale = fem.Constant(self._grid.mesh, law.scale)
            found = fitted([pressure(side) for side in "+-"], tables, drop, scale, UFL)
            out.append(found._replace(k=ufl.variable(found.k)))
        return out

    def conducts(self, side: str, means: Sequence):
        """Return k_r of the cell on one side of a face, as UFL.

        `means`: k_r of each retention curve.
        """
        return self.shares(side)[0] + sum(self.shares(side)[1 + i] * k for i, k in enumerate(means))

    def set_pressures(
        self, p: NDArray[np.float64], force: NDArray[np.float64] | None, gradients: tuple[NDArray[np.float64], ...]
    ) -> Any:
        """Set the coefficients of forms for the pressures of the local cells.

        Return the fluxes through faces between cells of different soil (see `borders`), or None without such faces.

        `p` (c,), Pa: pressures of the local cells.
        `force` (c, d), N/m^3: inertia force on the fluid.
        `gradients`: see `FluxForms.gradients`.
        """
        self._tables.x.array[:] = np.concatenate([law(p) for law in self.laws.conductances], axis=1).ravel()
        if (faces := self._borders.value) is None:
            return None
        pair, *slopes = (values[faces.pair] for values in (p, *gradients))
        key = (faces, pair, force, *slopes)
        return self._flows(key, lambda: faces.flows(pair, force, *slopes), self._grid.comm)

    def uniform(self, facets: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the `facets` between active cells that have the same soil on both sides."""
        faces = self._borders.value
        return facets if faces is None else faces.borders.uniform

    def at(self, cells: NDArray[np.int64], p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return k_r (m,) of owned cells at the pressures p (m,), in Pa."""
        k = np.stack([np.ones(len(p)), *(law(p)[:, 1] for law in self.laws.conductances)], axis=1)
        return (self.shares.x.array.reshape(-1, self.count)[cells] * k).sum(axis=1)

    def through_sides(
        self,
        cells: NDArray[np.int32],
        normal: NDArray[np.float64],
        p: NDArray[np.float64],
        outer: NDArray[np.float64],
        drop: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return k_r (m,) between cells and sides, and `d[k_r (p - outer + drop)]/dp` (m,).

        `cells` (m,): owned cells.
        `normal` (m, d): normals of the sides.
        `p` (m,), Pa: pressures in the cells.
        `outer` (m,), Pa: pressures outside the sides.
        `drop` (m,), Pa: pressure drop due to the weight of the fluid, from the centroid to the face.
        """
        shares = self.shares.x.array.reshape(-1, self.count)[cells]
        k, derivative = shares[:, 0].copy(), shares[:, 0].copy()
        for law, share in zip(self.laws.conductances, shares.T[1:], strict=True):
            between = fitted((p, outer), (law(p).T, law(outer).T), drop, law.scale, NUMPY)
            k += share * between.k
            derivative += share * (between.k + between.slopes[0] * (p - outer + drop))
        if (faces := self._borders.value) is not None:
            found = faces.borders.through_sides(self.laws, faces.mobility, cells, normal, p, outer, drop)
            for rows, *of_borders in found:
                k[rows], derivative[rows] = of_borders
        return k, np.maximum(derivative, 0.0)

    def set_shares(self, filled: NDArray[np.int64], shares: NDArray[np.float64]) -> None:
        """Set the coefficient `shares` in the filled owned cells to the given fractions (n, count)."""
        self.shares.x.array[:] = 0.0
        self.shares.x.array.reshape(-1, self.count)[filled] = shares
        self.shares.x.scatter_forward()

    def set_borders(self, contents, flow, places: NDArray[np.float64], moved: NDArray[np.float64]) -> None:
        """Store the faces between cells of different soil with their current conductivities, see `borders`."""
        borders = flow.mobility.borders
        make = partial(borders.faces, self.laws, contents, flow, places, moved) if borders else lambda: None
        self._borders(object(), make)
