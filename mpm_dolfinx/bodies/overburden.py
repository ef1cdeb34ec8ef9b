# SPDX-License-Identifier: MIT
"""Overburden: weight of the domains vertically above positions in the bodies.

Vertical lines are intersected with the faces of domains.  In 3D, each face consists of four triangles about its middle.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.grid.grid import ABOUT_MIDDLE, FACE_SIGNS, FACES, corner_bits, cross_in_plane


def overburden(
    corners: NDArray[np.float64], unit_weight: NDArray[np.float64], x: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the overburden stress (k,), in Pa, and the ground level (k,), in m, above positions x.

    Both results are means over several vertical lines close to the position.

    `corners` (n, 2^d, d), in m: corners of the particle domains of all bodies; the last axis is vertical.
    `unit_weight` (n,), in N/m^3: unit weights of the domains.
    `x` (k, d), in m: positions in the domains.
    """
    if not len(x):
        return np.zeros(0), np.zeros(0)
    least = np.ptp(corners[..., :-1], axis=1).min(initial=np.inf)
    aside = SAME * least * np.sqrt([2.0, 3.0])[: x.shape[1] - 1] * (1 - 2 * corner_bits(x.shape[1] - 1))
    weight, surface = np.mean([_along(corners, unit_weight, x, x[:, :-1] + one) for one in aside], axis=0)
    return weight, surface


def _along(corners: NDArray, unit_weight: NDArray, x: NDArray, places: NDArray) -> tuple[NDArray, NDArray]:
    """Return overburden stresses and ground levels above the heights of x, on vertical lines through `places`."""
    low, high = corners[..., :-1].min(axis=1), corners[..., :-1].max(axis=1)
    half = (high - low).max(initial=0.0) / 2
    across, line = np.unique(places, axis=0, return_inverse=True)
    line = line.reshape(len(x))
    near = cKDTree(across).sparse_distance_matrix(
        cKDTree((low + high) / 2), half * (1 + SAME), p=np.inf, output_type="ndarray"
    )
    ray, domain = near["i"], near["j"]
    inside = ((across[ray] >= low[domain]) & (across[ray] <= high[domain])).all(axis=1)
    ray, domain = ray[inside], domain[inside]
    hits = [(ray[on], z, sign * unit_weight[domain[on]]) for on, z, sign in _hits(corners[domain], across[ray])]
    ray, height, weight = (np.concatenate(column) for column in zip(*hits, strict=True))
    surface = np.full(len(across), -np.inf)
    np.maximum.at(surface, ray, height)
    # positions on the same vertical line share cumulative sums, sorted by line and height
    order = np.lexsort((height, ray))
    ray, height, weight = (values[order] for values in (ray, height, weight))
    base, scale = x[:, -1].min(initial=np.inf), 1 + np.ptp(corners[..., -1])
    height = height - base
    ends = np.searchsorted(ray, line, side="right")
    begins = np.searchsorted(ray * scale + height, line * scale + x[:, -1] - base)
    moment, total = (np.concatenate([[0.0], np.cumsum(values)]) for values in (weight * height, weight))
    moment, total = (values[ends] - values[begins] for values in (moment, total))
    return moment - total * (x[:, -1] - base), np.maximum(surface[line], x[:, -1])


def _hits(corners: NDArray, at: NDArray) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    """Yield the crossings of line i with each face of domain i: indices of lines, heights in m, and signs.

    The sign is 1 if an upward line leaves the domain, and -1 if the line enters the domain.
    """
    d = corners.shape[2]
    for face, turn in zip(FACES[d], FACE_SIGNS, strict=False):
        x = corners[:, face]
        if d == 2:
            a, b = x[:, 0], x[:, 1]
            on = np.flatnonzero((a[:, 0] > at[:, 0]) != (b[:, 0] > at[:, 0]))
            a, b = a[on], b[on]
            share = (at[on, 0] - a[:, 0]) / (b[:, 0] - a[:, 0])
            yield on, a[:, 1] + share * (b[:, 1] - a[:, 1]), turn * np.sign(a[:, 0] - b[:, 0])
            continue
        x = np.concatenate([x, x.mean(axis=1, keepdims=True)], axis=1)
        for corner in ABOUT_MIDDLE:
            part = x[:, corner]
            off = part[:, :, :2] - at[:, None]
            area = cross_in_plane(off[:, [1, 2, 0]], off[:, [2, 0, 1]])  # areas opposite to each corner
            on = np.flatnonzero((area > 0).all(axis=1) | (area < 0).all(axis=1))
            area = area[on]
            whole = area.sum(axis=1)
            yield on, (area * part[on, :, 2]).sum(axis=1) / whole, turn * np.sign(whole)
