# SPDX-License-Identifier: MIT
"""Derivatives of nodal forces with respect to the pressures of cells, for laws that depend on suction.

The stress depends on the pressure p through the suction in the law, and through the term chi p of Bishop's stress.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.forms.cell_matrices import along_shapes
from mpm_dolfinx.forms.point_forms import CellSums, FormPoints, Given
from mpm_dolfinx.mechanics.mean_dilatation import MeanDilatation
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData


def suction_sums(points: FormPoints, F, slopes: Sequence, locks: bool) -> CellSums | None:
    """Return the compiled sums over the points of each cell for `OfSuction`, or None if the law needs no sums.

    `F`: deformation gradient (d, d), a UFL variable.
    `slopes`: UFL derivatives of stresses with respect to the pressure: first Piola-Kirchhoff stress (d, d), and with
    F-bar the mean stress.  Empty for laws without suction.
    `locks`: whether the law uses F-bar.
    """
    share = 1 / ufl.det(points.F)
    tensors = [share * ufl.diff(ufl.det(F), F)] if locks else []
    tensors += [share * slope for slope in slopes[:1]]
    along = [part for T in tensors for part in along_shapes(T * points.F.T, points)]
    return CellSums([*along, *(share * slope for slope in slopes[1:])], points) if tensors else None


class OfSuction:
    """Derivatives of nodal forces with respect to the pressures of cells, for laws that depend on suction.

    `dilatation`: volume ratio and mean stress of each cell for F-bar, or None without F-bar.
    `sums`: results of `suction_sums`, one for each law.
    """

    def __init__(self, dim: int, dilatation: MeanDilatation | None, sums: Sequence[CellSums | None]):
        self._dilatation, self._width = dilatation, 2**dim * dim
        self._locked = {} if dilatation is None else {number: sums[number] for number in dilatation.numbers}
        found = {number: of for number, of in enumerate(sums) if of is not None}
        self._free = {number: of for number, of in found.items() if number not in self._locked}

    def rows(self, data: QuadratureData, given: Sequence[Given]) -> list[tuple[NDArray[np.int32], NDArray[np.float64]]]:
        """Return pairs of arrays: cells, and the derivatives of nodal forces with respect to the pressure of each cell.

        `given`: for each law, values of the fields that the caller passes to an assembly, see `FormPoints.follow`.
        """
        parts = data.parts
        out = [(parts[k].places.filled, of(parts[k], given[k])) for k, of in self._free.items()]
        if self._locked:
            width = 2 * self._width + 1
            sums = [of(parts[k], given[k]) for k, of in self._locked.items()]
            cells, total, volume = self._dilatation.total(data, [_padded(values, width) for values in sums])
            by_volume, by_stress, slope = np.split(total, (self._width, 2 * self._width), axis=1)
            out.append((cells, by_stress + slope / volume * by_volume))
        return out


def _padded(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return values (k, n), padded by zeros to the shape (k, width)."""
    return np.pad(values, ((0, 0), (0, width - values.shape[1])))
