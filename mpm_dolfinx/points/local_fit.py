# SPDX-License-Identifier: MIT
"""Values at given positions by moving least squares (Lancaster and Salkauskas 1981).

At each position, a polynomial P minimises

    sum_i w(o_i) (P(o_i) - v_i)^2 + sum_k c_k a_k^2,

where v_i are the data, o_i are the offsets of the data from the position, and w is a weight function.  The coefficients
of P are a_k.  The small weights c_k (`UNTOLD`) make the solution unique.  The value at the position is the constant
term of P.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import over_all

RADIUS = 3.0
"""Largest offset with a nonzero weight, in spacings of the data.

Source: exact. A parabola needs three points.  At an end of the data, these points have offsets of 0.5, 1.5 and 2.5.
"""
UNTOLD = (0.0, 1e-10, 1e-6)
"""Weights c_k of polynomial coefficients of degrees 0, 1 and 2, divided by the sum of the data weights.

With weights 0.01 or 100 times as large, pressures of a consolidating column change by 1e-5 of the load.  Sensitivity
(scene "adaptive" of tests/plateaus.py): half this value changes the result by 5.8e-08, and twice this value by 1.2e-07.
Finer cells change it by 3.8e-02.
"""


def near(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights (r,) of data at offsets (r, d), in spacings of the data."""
    return np.clip(1 - (offset / RADIUS) ** 2, 0, None).prod(axis=1) ** 4


def fitted(
    comm: MPI.Intracomm,
    count: int,
    degree: int,
    at: NDArray[np.int64],
    offset: NDArray[np.float64],
    values: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the fitted values (count, width) at `count` positions, on every process, or zero at positions without
    data.

    `degree`: degree of the polynomials, 1 or 2.
    `at` (r,): index, from 0, of the position to which each of r data belongs.
    `offset` (r, d): offset of the data from this position, in spacings of the data.
    `values` (r, width): `width` values of each of the r data.
    `weight` (r,): weights of the data.
    """
    powers = [rows for k in range(degree + 1) for rows in combinations_with_replacement(range(offset.shape[1]), k)]
    size = len(powers)
    basis = np.stack([offset[:, list(p)].prod(axis=1) for p in powers], axis=1)
    rows = (weight[:, None] * basis)[:, :, None] * np.concatenate([basis, values], axis=1)[:, None, :]
    sums = over_all(comm, sum_by(at, rows.reshape(len(at), size * rows.shape[2]).T, count))
    A, b = np.split(sums.T.reshape(count, size, rows.shape[2]), [size], axis=2)
    some = A[:, 0, 0] > 0
    whole = np.where(some, A[:, 0, 0], 1.0)
    small = np.array(UNTOLD)[[len(p) for p in powers]]
    return np.linalg.solve(A + np.eye(size) * (whole[:, None] * small + ~some[:, None])[:, None], b)[:, 0]
