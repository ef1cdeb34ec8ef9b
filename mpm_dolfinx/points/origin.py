# SPDX-License-Identifier: MIT
"""Where points of integration on surfaces come from, and what material points keep of what acts there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import Exchange


@dataclass(frozen=True, eq=False)
class Origin:
    """Where points of integration come from: their way to the owners of their cells, and what each (n,) is before it.

    point : (n,) index of its material point on this process; number : (n,) condition; area : (n,), m^(d-1).
    """

    travel: Exchange
    point: NDArray[np.int64]
    number: NDArray[np.int64]
    area: NDArray[np.float64]

    def means(self, count: int, conditions: int, values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return for each condition the means (count, k) of values (m, k) at their owners, zero where it does not act.

        count: of the material points of this process.
        """
        values = self.travel.back(values)
        out = []
        for number in range(conditions):
            rows = np.flatnonzero(self.number == number)
            at, area = self.point[rows], self.area[rows]
            whole = sum_by(at, area, count)
            whole[whole == 0] = 1.0
            out.append(np.stack([sum_by(at, area * column, count) / whole for column in values[rows].T], axis=1))
        return out
