# SPDX-License-Identifier: MIT
"""The deformation gradient of a domain as its corners tell it, whichever way they have taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.points.cutting import ORIENTATION, kuhn_simplices
from mpm_dolfinx.points.material_points import determinant


def gradient(corners: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean deformation gradient (n, d, d) of domains over the simplices that the cut knows.

    In 2D det F is the ratio of the areas.  In 3D F is scaled to that of the volumes, from which the determinant of the
    mean of a twisted hexahedron differs by second order.

    Parameters
    ----------
    corners, reference : (n, 2^d, d), m
        Corners now, and those of the domains at rest.
    """
    d, F, now, then = corners.shape[2], 0.0, 0.0, 0.0
    for simplex, sign in zip(kuhn_simplices(d), ORIENTATION[d], strict=True):
        dx, dX = (np.diff(y[:, simplex], axis=1) for y in (corners, reference))  # edges as rows
        cofactor = _cofactor(dX)
        F = F + sign * np.einsum("nki,nkj->nij", dx, cofactor)
        then = then + sign * (dX[:, 0] * cofactor[:, 0]).sum(axis=1)
        if d == 3:
            now = now + sign * determinant(dx)
    F = F / then[:, None, None]
    return F if d == 2 else F * np.cbrt(now / then / determinant(F))[:, None, None]


def _cofactor(edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cofactors (n, d, d) of matrices of edges in rows."""
    if edges.shape[1] == 2:
        out = edges[:, ::-1, ::-1].copy()
        out[:, 0, 1] *= -1
        out[:, 1, 0] *= -1
        return out
    return np.stack([np.cross(edges[:, (k + 1) % 3], edges[:, (k + 2) % 3]) for k in range(3)], axis=1)
