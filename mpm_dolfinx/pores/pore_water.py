# SPDX-License-Identifier: MIT
"""Computation of cell pressures from the water content of pieces, in unsaturated soil.

A piece is the part of a particle domain in one cell.  The piece has the storage s, in m^d/Pa, and the pore volume n, in
m^d.  The fluid content of a piece at the pressure p, minus its content at p = 0, is `c(p) = s pi(p) + n (S(p) - 1)
rho(p)`.  Here `pi = K_w (exp(p / K_w) - 1)` and `rho = exp(p / K_w)`, with the bulk modulus K_w of the fluid, and S is
the saturation.  The pressure of a piece differs from the pressure of its cell by an offset.
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

MOST = 2200  # Source: exact bound, twice the number of halvings of a bracket of doubles (IEEE 754)


@dataclass(frozen=True)
class PoreWater:
    """Water storage of n cells, which contain k pieces of particle domains."""

    # function of pressures (k,), in Pa, that returns S (k,), dS/dp (k,), in 1/Pa, and possibly other values
    saturation: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], ...]]
    slot: NDArray[np.int64]  # (k,) index, from 0, of each piece's cell
    store: NDArray[np.float64]  # (k,) storage, m^d/Pa
    pores: NDArray[np.float64]  # (k,) pore volume, m^d
    bulk: float  # fluid's bulk modulus, Pa
    scale: NDArray[np.float64]  # (n,) suction at which the pores of each cell drain, Pa

    def emptied(self, p: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (S - 1) rho (k,) of the pieces at pressures p, in Pa, and its derivative with respect to p."""
        return emptied(p, self.bulk, *self.saturation(p)[:2])

    def of_cells(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fluid contents of the cells, in m^d, if their pieces have the pressures p, in Pa."""
        return self.sums(mass_potential(p, self.bulk), self.emptied(p)[0])

    def sums(self, pi: NDArray[np.float64], empty: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fluid contents of the cells, in m^d, from pi and `(S - 1) rho` of their pieces."""
        return sum_by(self.slot, self.store * pi + self.pores * empty, len(self.scale))

    def level(
        self, content: NDArray[np.float64], p: NDArray[np.float64], offset: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.float64]:
        """Return the pressures (n,), in Pa, at which the cells have prescribed fluid contents.

        Newton's method solves for the logarithm of the suction, within an interval that contains the solution.

        `content` (n,), in m^d: prescribed fluid contents.
        `p` (n,), in Pa: initial guesses.  Guesses that give the prescribed fluid contents remain unchanged.
        `offset` (k,), in Pa: pressure of each piece minus the pressure of its cell.
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
            slopes = slopes * scale * np.cosh(np.minimum(y, 0.0))
            with np.errstate(divide="ignore", invalid="ignore"):
                most = 2 + np.maximum(y, 0.0)
                new = y - np.clip(np.nan_to_num(off / slopes), -most, most)
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
    """Return (S - 1) rho at pressures p, in Pa, and its derivative with respect to p.

    `bulk`, in Pa: bulk modulus of the fluid.
    `slope` (k,), in 1/Pa: derivative dS/dp.
    """
    density = np.exp(p / bulk)
    return (S - 1) * density, (slope + (S - 1) / bulk) * density
