# SPDX-License-Identifier: MIT
"""The deformation gradient of a domain as its corners tell it, whichever way they have taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.points.cutting import ORIENTATION, domain_volumes, kuhn_simplices, volumes
from mpm_dolfinx.points.material_points import cofactor, determinant


def gradient(
    corners: NDArray[np.float64], reference: NDArray[np.float64], axisymmetric: bool = False
) -> NDArray[np.float64]:
    """Return the mean deformation gradient (n, d, d) of domains over the simplices that the cut knows.

    In axisymmetry (n, 3, 3): hoops stretch as the radius of the centroid, so det F is the ratio of the rings' volumes.
    In 2D the diagonals tell all of it, and det F is the ratio of the areas.  In 3D F is scaled to that of the volumes,
    from which the determinant of the mean of a twisted hexahedron differs by second order.

    Parameters
    ----------
    corners, reference : (n, 2^d, d), m
        Corners now, and those of the domains at rest.
    """
    if corners.shape[2] == 2:
        dx, dX = (y[:, [3, 2]] - y[:, [0, 1]] for y in (corners, reference))
        F = np.einsum("nki,nkj->nij", dx, cofactor(dX)) / determinant(dX)[:, None, None]
        if not axisymmetric:
            return F
        out = np.zeros((len(F), 3, 3))
        out[:, :2, :2] = F
        now, then = (domain_volumes(y, True) / volumes(y) for y in (corners, reference))
        out[:, 2, 2] = now / then
        return out
    F, now, then = 0.0, 0.0, 0.0
    for simplex, sign in zip(kuhn_simplices(3), ORIENTATION[3], strict=True):
        dx, dX = (np.diff(y[:, simplex], axis=1) for y in (corners, reference))  # edges as rows
        of_edges = cofactor(dX)
        F = F + sign * np.einsum("nki,nkj->nij", dx, of_edges)
        then = then + sign * (dX[:, 0] * of_edges[:, 0]).sum(axis=1)
        now = now + sign * determinant(dx)
    F = F / then[:, None, None]
    return F * np.cbrt(now / then / determinant(F))[:, None, None]
