# SPDX-License-Identifier: MIT
"""Derivatives of nodal forces with respect to the cells' pressures, through laws that depend on suction.

The stress of such a law depends on the pressure in addition to the term chi p of Bishop's stress.  So does the mean
stress pi of cells with mean dilatation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.forms.cell_matrices import along_shapes
from mpm_dolfinx.forms.point_forms import CellSums, FormPoints
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.mechanics.mean_dilatation import MeanDilatation
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData


class OfSuction:
    """Derivatives of the laws' forces with respect to the cells' pressures.

    Parameters
    ----------
    grid
        Background grid.
    dilatation
        Mean dilatation of cells, if any lock.
    """

    def __init__(self, grid: Grid, dilatation: MeanDilatation | None):
        self._dilatation, self._width = dilatation, 2**grid.dim * grid.dim
        self._free: dict[int, CellSums] = {}
        self._locked: dict[int, CellSums] = {}

    def add(self, number: int, points: FormPoints, F, slopes: Sequence, locks: bool) -> None:
        """Add a part of the pieces.

        Parameters
        ----------
        number, points, locks
            Number of the part, its pieces, and whether their laws take the mean dilatation.
        F
            Deformation gradient (d, d), a UFL variable.
        slopes
            UFL derivatives with respect to the pressure: of the first Piola-Kirchhoff stress (d, d) and, with mean
            dilatation, of its derivative with respect to theta.  Empty without suction.
        """
        share = 1 / ufl.det(points.F)
        tensors = [share * ufl.diff(ufl.det(F), F)] if locks else []
        tensors += [share * slope for slope in slopes[:1]]
        along = [part for T in tensors for part in along_shapes(T * points.F.T, points)]
        scalars = [share * slope for slope in slopes[1:]]
        if tensors:
            (self._locked if locks else self._free)[number] = CellSums([*along, *scalars], points)

    def rows(self, data: QuadratureData) -> list[tuple[NDArray[np.int32], NDArray[np.float64]]]:
        """Return cells (c,), and derivatives (c, n), m^(d-1), of nodal forces with respect to their pressures."""
        out = [(data.parts[number].places.filled, sums(data.parts[number])) for number, sums in self._free.items()]
        if self._locked:
            width = 2 * self._width + 1
            sums = [of(data.parts[number]) for number, of in self._locked.items()]
            cells, total, volume = self._dilatation.total(data, [_padded(values, width) for values in sums])
            by_volume, by_stress, slope = np.split(total, (self._width, 2 * self._width), axis=1)
            out.append((cells, by_stress + slope / volume * by_volume))
        return out


def _padded(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return rows of this width, the rest zero."""
    return np.pad(values, ((0, 0), (0, width - values.shape[1])))
