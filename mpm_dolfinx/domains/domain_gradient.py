# SPDX-License-Identifier: MIT
"""Deformation gradients of domains, and volume ratios of cells, as corners tell them, whichever way they have taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.points.cutting import FACE_SIGNS, FACES, cross, domain_volumes, volumes
from mpm_dolfinx.points.material_points import MaterialPoints, cofactor, determinant


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
    F, then = _of_hexahedra(corners, reference)
    return F * np.cbrt(volumes(corners) / then / determinant(F))[:, None, None]


def _of_hexahedra(
    corners: NDArray[np.float64], reference: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean F (n, 3, 3) over the simplices, and the volumes at rest (n,), m^3, of which it is a derivative.

    Sums over corners of x_k and dV/dX_k, of the volumes by faces, with the points last.
    """
    x, X = (np.ascontiguousarray((y - y[:, :1]).transpose(1, 2, 0)) for y in (corners, reference))
    slope = np.zeros_like(X)
    for face, sign in zip(FACES[3], FACE_SIGNS, strict=True):
        p, q, r, s = X[face]
        total = p + q + r + s
        a = s - p
        b = r - q
        area, by_a, by_b = (sign / 24 * cross(*pair) for pair in ((a, b), (b, total), (total, a)))
        for corner, own in zip(face, (-by_a, -by_b, by_b, by_a), strict=True):
            slope[corner] += area + own
    volume = (X * slope).sum(axis=(0, 1)) / 3
    return np.moveaxis(np.einsum("kan,kbn->abn", x, slope) / volume, 2, 0).copy(), volume


def cell_ratios(
    cut: CutDomains, points: MaterialPoints, share: NDArray[np.float64], flows: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the volume ratios (m,) with which the pieces of a cut begin a step where cells see one.

    That of a cell is the volume that the corners of its domains tell over that at rest: it remembers no path, and what
    the cell does not see of it does no work.  By increments alone points would drift from the volumes of their domains,
    which nothing would bring back.  All others begin with the points' own, and so do cells in which soil has yielded:
    beside what flows volumes of domains tell nothing.

    Parameters
    ----------
    cut, points
        The domains as cut by the cells, and the points as they are now.
    share : (n,)
        Of what corners tell in the logarithm of the ratio, the rest is the points' own; 0 at those that see their own.
    flows : (n,)
        Which points have yielded.
    """
    cells, size = cut.cells, cut.grid.num_local
    told = cut.to_cells(determinant(gradient(points.corners, points.reference, cut.grid.axisymmetric)))
    J, share = cut.to_cells(points.J), cut.to_cells(share)
    weight = (share > 0) * cut.to_cells(points.volume0) * cut.pieces_to_cells(cut.pieces.fraction)
    terms = weight, weight * share, weight * J, weight * told, cut.to_cells(1.0 * flows)
    rest, part, own, now, yielded = (sum_by(cells, term, size)[cells] for term in terms)
    sees = (weight > 0) & (yielded == 0)
    rest, own, now = (np.where(sees, total, 1.0) for total in (rest, own, now))
    return np.where(sees, own / rest * (now / own) ** (part / rest), J)
