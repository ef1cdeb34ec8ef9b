# SPDX-License-Identifier: MIT
"""Pressures of cells from the pore water of their pieces, in unsaturated soil.

The fluid content of a piece with storage s (m^d/Pa) and pore volume n, less its value at zero pressure, is c(p) = s
pi(p) + n (S(p) - 1) rho(p).  pi is the mass potential, rho the density relative to zero pressure.  A piece above or
below its cell's centroid, or of another soil, has c(p + o) with its own S and offset o.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.fluid_content import mass_potential
from mpm_dolfinx.base.tolerances import EPSILON
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.pores.retention import logarithm, pressure_at

MOST = 2200  # Source: exact bound, twice the halvings of a bracket of doubles (IEEE 754)


@dataclass(frozen=True)
class PoreWater:
    """Water storage of m pieces in n cells.

    saturation: function of pressures (m,), Pa, returns S, its slope (m,), 1/Pa, and maybe more; slot (m,): cell of each
    piece; store (m,), m^d/Pa; pores (m,), m^d; bulk: fluid's bulk modulus, Pa; scale (n,): suction at which pores of a
    cell drain, Pa.
    """

    saturation: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], ...]]
    slot: NDArray[np.int64]
    store: NDArray[np.float64]
    pores: NDArray[np.float64]
    bulk: float
    scale: NDArray[np.float64]

    def emptied(self, p: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (S - 1) rho of the pieces, and its slope, 1/Pa, at pressures (m,), Pa."""
        return emptied(p, self.bulk, *self.saturation(p)[:2])

    def of_cells(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the contents of the cells (n,), m^d, by pressures of their pieces (m,), Pa."""
        return self.sums(mass_potential(p, self.bulk), self.emptied(p)[0])

    def sums(self, pi: NDArray[np.float64], empty: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the contents of the cells (n,), m^d, by potentials, Pa, and (S - 1) rho of their pieces (m,)."""
        return sum_by(self.slot, self.store * pi + self.pores * empty, len(self.scale))

    def level(
        self, content: NDArray[np.float64], p: NDArray[np.float64], offset: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.float64]:
        """Return the pressures (n,), Pa, of cells with given contents (n,), m^d.

        Newton's method on the logarithm of the suction, within a bracket.

        Parameters
        ----------
        p : (n,), Pa
            Initial values, returned unchanged if their contents are right.
        offset : (m,), Pa
            Pressures of pieces minus pressures of their cells.
        """
        count, scale = len(p), self.scale
        rounding = 4 * EPSILON * sum_by(self.slot, self.pores, count)
        y = logarithm(p, scale)
        low, high = np.full(count, -np.inf), np.full(count, np.inf)
        for _ in range(MOST):
            p = pressure_at(y, scale) if _ else p
            at = p[self.slot] + offset
            empty, slope = self.emptied(at)
            off = self.sums(mass_potential(at, self.bulk), empty) - content
            bad = np.abs(off) > rounding + 4 * EPSILON * np.abs(content)
            if not bad.any():
                return p
            low, high = np.where(off < 0, y, low), np.where(off > 0, y, high)
            slopes = sum_by(self.slot, self.store * np.exp(at / self.bulk) + self.pores * slope, count)
            slopes = slopes * np.where(y < 0, scale * np.cosh(y), scale)
            with np.errstate(divide="ignore", invalid="ignore"):
                new = y - np.clip(np.nan_to_num(off / slopes), -2, 2)
                middle = (low + high) / 2
            inside = (new > low) & (new < high)
            new = np.where(inside | ~np.isfinite(middle), new, middle)
            done = (new == y) | (high - low <= 4 * EPSILON * np.abs(y))
            if not (bad & ~done).any():
                return p
            y = np.where(bad, new, y)
        raise NotConverged("pore water: no pressure is found for the water content")


def emptied(
    p: NDArray[np.float64], bulk: float, S: NDArray[np.float64], slope: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (S - 1) rho and its slope, 1/Pa, for pressures (m,), Pa, saturations, and slopes of S, 1/Pa."""
    density = np.exp(p / bulk)
    return (S - 1) * density, (slope + (S - 1) / bulk) * density
