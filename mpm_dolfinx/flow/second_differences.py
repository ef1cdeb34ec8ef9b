# SPDX-License-Identifier: MIT
"""Damping of second differences of the pressure along the axes.

The damping matrix H is defined by sums over cells and axes for all pressures p and test functions q,

    (H p, q) = sum of w D p D q,   D p = h ((p_+ - p) / d_+ - (p - p_-) / d_-).

Here w is the weight of a cell and axis, and h is the edge length of the cell along the axis.  The neighbours along the
axis have the pressures p_+ and p_-.  Their centroids have the distances d_+ and d_- from the centroid of the cell.  The
term of a cell and axis is omitted if one of the two faces normal to the axis has no material.

A uniform gradient is not damped.  The sum of H p over the cells is zero, so damping conserves fluid.
"""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.grid.grid import Grid


def second_differences(
    unknowns: Unknowns,
    grid: Grid,
    strength: NDArray[np.float64],
    centroid: NDArray[np.float64],
    opening: NDArray[np.float64],
) -> PETSc.Mat:
    """Return the matrix H.  The sparsity pattern of H depends on the active cells only.

    `unknowns`: pressure unknowns of the active cells.
    `strength` (n, d), m^d/Pa: 4 w / f, >= 0, of each owned active cell along each axis.  Here f is the smallest
    `opening` at the two faces normal to this axis.
    `centroid` (c, d), m: centroids of the material in the local cells, relative to the midpoints of the cells.
    `opening` (c, d, 2): fractions of the lower and upper faces of the local cells that material covers, in axisymmetry
    times the circumference.
    """
    own = unknowns.owned
    number = unknowns.map.indices
    neighbours = grid.neighbours(own)
    active = (neighbours >= 0) & (number[neighbours] >= 0)
    row, axis = np.nonzero(active.all(axis=2))
    low, high = neighbours[row, axis].T
    middle = own[row]
    share = np.minimum(
        np.minimum(opening[middle, axis, 0], opening[low, axis, 1]),
        np.minimum(opening[middle, axis, 1], opening[high, axis, 0]),
    )
    h = [grid.along(cells, axis) for cells in (low, middle, high)]
    between = (h[0] + h[1]) / 2, (h[1] + h[2]) / 2
    pairs = (low, middle), (middle, high)
    distances = [gap + centroid[b, axis] - centroid[a, axis] for gap, (a, b) in zip(between, pairs, strict=True)]
    steep = [h[1] / np.maximum(d, gap / 2) for gap, d in zip(between, distances, strict=True)]
    values = np.sqrt(share * strength[row, axis] / 4)[:, None] * np.stack([steep[0], -sum(steep), steep[1]], axis=1)
    columns = number[np.stack([low, middle, high], axis=1)].astype(PETSc.IntType)
    starts = np.arange(0, 3 * len(row) + 1, 3, dtype=PETSc.IntType)
    size = ((len(row), None), (unknowns.size, None))
    D = PETSc.Mat().createAIJ(size, csr=(starts, columns.ravel(), values.ravel()), comm=unknowns.comm)
    return D.transposeMatMult(D)
