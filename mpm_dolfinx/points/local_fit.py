# SPDX-License-Identifier: MIT
"""Values at given positions from polynomials that are fitted to surrounding data (moving least squares).

    sum_i w(o_i) (P(o_i) - v_i)^2 + small terms of P's coefficients -> min,      o_i: offsets from the position.

P is a polynomial, v_i are the data, and w is a weight. The value is the constant term of P (Lancaster and Salkauskas
1981). Polynomials up to the degree of P are exact. The weights decrease smoothly to zero, so values are continuous when
data enter or leave the fit. The small terms set coefficients to zero that the data do not determine, the higher degrees
first.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import over_all

RADIUS = 3.0
"""Offset beyond which the weight is zero, in spacings of the data.

Source: exact. A parabola needs three points: at an end of the data these are at offsets of 0.5, 1.5 and 2.5.
"""
UNTOLD = (0.0, 1e-10, 1e-6)
"""Weights of the coefficients of degrees 0, 1, 2, relative to the data; they affect only undetermined coefficients.

Factors of 0.01 and 100 change the pressures of a consolidating column by 1e-5 of the load.
"""


def near(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights (r,) of data at offsets (r, d), in spacings of the data."""
    return np.clip(1 - (offset / RADIUS) ** 2, 0, None).prod(axis=1) ** 4


class LocalFit:
    """Polynomials about given positions, fitted to the data of all processes.

    Parameters
    ----------
    count
        Number of positions.
    dim
        Number d of coordinates.
    degree
        Degree of the polynomials, 1 or 2.
    width
        Number of values at each position.
    """

    def __init__(self, count: int, dim: int, degree: int, width: int = 1):
        powers = [rows for k in range(degree + 1) for rows in combinations_with_replacement(range(dim), k)]
        self._powers, size = powers, len(powers)
        self._sums, self._shape = np.zeros((count, size * (size + width))), (count, size, size + width)

    def add(self, at: NDArray[np.int64], offset: NDArray, values: NDArray, weight: NDArray) -> None:
        """Add weighted values (r, width) to the fits at positions `at` (r,); offset (r, d), in spacings of the data."""
        basis = np.stack([offset[:, list(p)].prod(axis=1) for p in self._powers], axis=1)
        rows = np.concatenate([basis, values], axis=1)
        outer = (weight[:, None] * basis)[:, :, None] * rows[:, None, :]
        self._sums += sum_by(at, outer.reshape(len(at), self._sums.shape[1]).T, len(self._sums)).T

    def values(self, comm: MPI.Intracomm) -> NDArray[np.float64]:
        """Return the fitted values (count, width) at the positions, on every process; zero without data."""
        size = len(self._powers)
        sums = over_all(comm, self._sums).reshape(self._shape)
        A = sums[:, :, :size].copy()
        b = sums[:, :, size:]
        degree = np.array([len(p) for p in self._powers])
        some = A[:, 0, 0] > 0
        whole = np.where(some, A[:, 0, 0], 1.0)
        A[:, np.arange(size), np.arange(size)] += whole[:, None] * np.array(UNTOLD)[degree] + (~some)[:, None]
        return np.linalg.solve(A, b)[:, 0]
