# SPDX-License-Identifier: MIT
"""Overburden: weight of the domains vertically above positions in the bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.bodies.touching import face_vectors
from mpm_dolfinx.points.cutting import FACES


def overburden(
    corners: NDArray[np.float64], unit_weight: NDArray[np.float64], x: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the overburden stress (m,), Pa, at positions, and the level of the ground surface above them (m,), m.

    Parameters
    ----------
    corners : (n, 2^d, d), m
        Corners of the convex particle domains of all bodies; the last axis is vertical.
    unit_weight : (n,), N/m^3
        Unit weights of the domains.
    x : (m, d), m
        Positions in the domains.
    """
    low, high = corners.min(axis=1), corners.max(axis=1)
    half = (high - low)[:, :-1].max(initial=0.0) / 2
    aside = SAME * (high - low)[:, :-1].min(initial=np.inf) * np.sqrt([2.0, 3.0])[: x.shape[1] - 1]
    across, line = np.unique(x[:, :-1] + aside, axis=0, return_inverse=True)
    line, middle = line.reshape(len(x)), (low + high)[:, :-1] / 2
    pairs = cKDTree(across).sparse_distance_matrix(cKDTree(middle), half * (1 + SAME), p=np.inf, output_type="ndarray")
    ray, domain = pairs["i"], pairs["j"]
    inside = ((across[ray] >= low[domain, :-1]) & (across[ray] <= high[domain, :-1])).all(axis=1)
    ray, domain = ray[inside], domain[inside]
    bottom, top = _chord(corners[domain], across[ray], low[domain, -1], high[domain, -1])
    crossed = top > bottom
    ray = ray[crossed]
    weight = unit_weight[domain[crossed]]
    bottom = bottom[crossed]
    top = top[crossed]
    surface = np.full(len(across), -np.inf)
    np.maximum.at(surface, ray, top)
    # positions on the same vertical line share cumulative sums, sorted by line and height
    order = np.lexsort((bottom, ray))
    ray = ray[order]
    weight = weight[order]
    bottom = bottom[order]
    top = top[order]
    total = np.concatenate([[0.0], np.cumsum(weight * (top - bottom))])
    ends = np.searchsorted(ray, np.arange(len(across)), side="right")
    scale = 1 + np.ptp(corners[..., -1])
    after = np.searchsorted(ray * scale + (bottom - corners[..., -1].min()), line * scale + x[:, -1] - low[:, -1].min())
    own = np.maximum(after - 1, 0)
    part = np.where(ray[own] == line, weight[own] * np.maximum(top[own] - x[:, -1], 0.0), 0.0)
    return total[ends[line]] - total[after] + part, np.maximum(surface[line], x[:, -1])


def _chord(corners: NDArray, across: NDArray, low: NDArray, high: NDArray) -> tuple[NDArray, NDArray]:
    """Return the heights (m,), m, at which vertical lines at (m, d-1) enter and leave domains (m, 2^d, d)."""
    d = corners.shape[2]
    for face in range(2 * d):
        n, on = face_vectors(corners, face), corners[:, FACES[d][face]].mean(axis=1)
        depth = ((across - on[:, :-1]) * n[:, :-1]).sum(axis=1)  # n . (x - on) <= 0 inside
        slope = n[:, -1]
        steep = np.abs(slope) > SAME * np.linalg.norm(n, axis=1)
        at = on[:, -1] - np.divide(depth, slope, out=np.zeros(len(n)), where=steep)
        high = np.where(steep & (slope > 0), np.minimum(high, at), high)
        low = np.where(steep & (slope < 0), np.maximum(low, at), low)
        high = np.where(~steep & (depth > 0), -np.inf, high)
    return low, high
