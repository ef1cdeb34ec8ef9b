# SPDX-License-Identifier: MIT
"""Deformation gradients of particle domains and volume ratios of cells, computed from corner positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.grid.grid import FACE_SIGNS, FACES, TURN, in_chunks, sum_by
from mpm_dolfinx.points.cutting import cross, domain_volumes, volumes
from mpm_dolfinx.points.material_points import MaterialPoints, cofactor, determinant


def gradient(
    corners: NDArray[np.float64], reference: NDArray[np.float64], axisymmetric: bool = False
) -> NDArray[np.float64]:
    """Return the mean deformation gradients F (n, d, d) of particle domains, or (n, 3, 3) in axisymmetry.

    F is scaled so that det F is the ratio of current to reference volume.  In axisymmetry, the circumferential stretch
    is the ratio of the centroid radii.

    `corners`, `reference` (n, 2^d, d), in m: current corners, and reference corners.
    """
    if corners.shape[2] == 2:
        dx, dX = (y[:, :1:-1] - y[:, :2] for y in (corners, reference))  # the diagonals
        F = dx.swapaxes(1, 2) @ cofactor(dX) / determinant(dX)[:, None, None]
        if not axisymmetric:
            return F
        out = np.zeros((len(F), 3, 3))
        out[:, :2, :2] = F
        now, then = (domain_volumes(y, True) / volumes(y) for y in (corners, reference))
        out[:, 2, 2] = now / then
        return out
    out = np.empty((len(corners), 3, 3))
    for part in in_chunks(len(corners)):
        F, then = _of_hexahedra(corners[part], reference[part])
        out[part] = F * np.cbrt(volumes(corners[part]) / then / determinant(F))[:, None, None]
    return out


def _of_hexahedra(
    corners: NDArray[np.float64], reference: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean F over the simplices of hexahedra, and the reference volumes."""
    x, X = (np.ascontiguousarray((y - y[:, :1]).transpose(1, 2, 0)) for y in (corners, reference))
    slope = _slopes(X)
    volume = (X * slope).sum(axis=(0, 1)) / 3
    return np.moveaxis(np.einsum("kan,kbn->abn", x, slope) / volume, 2, 0).copy(), volume


def _slopes(X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of hexahedron volumes with respect to the corners."""
    slope = np.zeros_like(X)
    for face, sign in zip(FACES[3], FACE_SIGNS, strict=True):
        p, q, r, s = X[face]
        total = p + q + r + s
        a = s - p
        b = r - q
        area, by_a, by_b = (sign / 24 * cross(*pair) for pair in ((a, b), (b, total), (total, a)))
        for corner, own in zip(face, (-by_a, -by_b, by_b, by_a), strict=True):
            slope[corner] += area + own
    return slope


def volume_slopes(
    corners: NDArray[np.float64], axisymmetric: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the volumes (n,) of domains, in m^d, and their derivatives (n, 2^d, d) with respect to the corners.

    In axisymmetry, the volumes of the rings are integrals of `pi r^2 dz`, in m^3.
    """
    now = domain_volumes(corners, axisymmetric)
    if corners.shape[2] == 3:
        return now, _slopes((corners - corners[:, :1]).transpose(1, 2, 0)).transpose(2, 0, 1)
    if not axisymmetric:
        other = (corners[:, [1, 3, 0, 2]] - corners[:, [2, 0, 3, 1]])[:, :, ::-1]  # diagonals
        return now, other * [0.5, -0.5]
    ring = [0, 1, 3, 2]
    (r, z), (r_next, z_next) = (np.moveaxis(corners[:, np.roll(ring, -k)], 2, 0) for k in (0, 1))
    along, square = z_next - z, r**2 + r * r_next + r_next**2
    by_r = (2 * r + r_next) * along + np.roll((r + 2 * r_next) * along, 1, axis=1)
    slope = np.stack([by_r, np.roll(square, 1, axis=1) - square], axis=2)
    return now, TURN / 6 * slope[:, ring]


def cell_ratios(
    cut: CutDomains, points: MaterialPoints, share: NDArray[np.float64], flows: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the volume ratios (m,) of the pieces of a cut at the start of a step.

    With F-bar, a piece has the volume ratio of its cell: the geometric mean of two ratios, weighted by `share`. One
    ratio follows from the corners of the domains, and the other ratio is det F of the points.  Without F-bar, and in
    cells with yielded soil, a piece has the volume ratio of its point.

    `cut`: cut particle domains.
    `points`: points at the start of the step.
    `share` (n,): weight of the ratio from corners in the geometric mean, from 0 to 1; 0 without F-bar.
    `flows` (n,): whether points have yielded.
    """
    cells, size = cut.cells, cut.grid.num_local
    corner_ratio = cut.to_cells(determinant(gradient(points.corners, points.reference, cut.grid.axisymmetric)))
    J, share = cut.to_cells(points.J), cut.to_cells(share)
    weight = (share > 0) * cut.shares(points.volume0)
    terms = weight, weight * share, weight * J, weight * corner_ratio, cut.to_cells(1.0 * flows)
    rest, part, own, now, yielded = (sum_by(cells, term, size)[cells] for term in terms)
    averaged = (weight > 0) & (yielded == 0)
    rest, own, now = (np.where(averaged, total, 1.0) for total in (rest, own, now))
    return np.where(averaged, own / rest * (now / own) ** (part / rest), J)
