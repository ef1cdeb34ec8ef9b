# SPDX-License-Identifier: MIT
"""Search for the nearest facets of a surface, in a binary tree of oriented boxes (Gottschalk, Lin and Manocha 1996).

Facets are segments in 2D and triangles in 3D.  In this file, arrays of vectors have the component as first index.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import ROUND_OFF, SAME

AT_ONCE = 2**13
"""Number of positions in an array operation, so that the arrays fit into the cache of the processor."""
START = 2**8 - 1
"""Number of nodes above the level of the tree at which the search for a near facet starts."""


class Boxes(NamedTuple):
    """Oriented boxes of the k nodes at one level of the tree."""

    centre: NDArray[np.float64]  # (d, k), m
    frame: NDArray[np.float64]  # unit vectors along the axes of a box: axis, component, node (d, d, k)
    half: NDArray[np.float64]  # half of the edge lengths (d, k), m

    def squares(self, y: NDArray[np.float64], node: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the squared distances (m,), in m^2, of positions y (d, m) from the boxes of nodes (m,)."""
        local = (self.frame.take(node, 2) * (y - self.centre.take(node, 1))).sum(axis=1)
        over = np.abs(local, out=local)
        over -= self.half.take(node, 1)
        np.maximum(over, 0.0, out=over)
        over *= over
        return over.sum(axis=0)


class FacetTree:
    """Binary tree of facets with the vertices `corners` (n, d, d), in m.  A leaf has one facet."""

    def __init__(self, corners: NDArray[np.float64]):
        n, d = corners.shape[:2]
        self._levels: list[Boxes] = []
        self._margin = ROUND_OFF * np.abs(corners).max()
        leaves = 1 << int(n - 1).bit_length()
        order = (np.arange(leaves) * n // leaves)[None]  # some facets have two leaves
        while True:
            x = corners[order].reshape(len(order), -1, d)
            middle = x.mean(axis=1, keepdims=True)
            frame = np.linalg.eigh((x - middle).swapaxes(1, 2) @ (x - middle))[1]
            local = (x - middle) @ frame
            low, high = local.min(axis=1), local.max(axis=1)
            centre = middle[:, 0] + np.einsum("kde,ke->kd", frame, (low + high) / 2)
            self._levels.append(Boxes(*(np.ascontiguousarray(of.T) for of in (centre, frame, (high - low) / 2))))
            if len(order) == leaves:
                break
            along = local[..., -1].reshape(*order.shape, d).mean(axis=2)  # along the longest axis
            order = np.take_along_axis(order, along.argsort(axis=1), axis=1).reshape(2 * len(order), -1)
        self._facet = order[:, 0]

    def near(self, y: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return a facet near each position y (d, m), often the nearest facet."""
        start = min(START.bit_length(), len(self._levels) - 1)
        centre = self._levels[start].centre
        node = ((centre**2).sum(axis=0) - 2 * (y.T @ centre)).argmin(axis=1)
        for boxes in self._levels[start + 1 :]:
            first, second = (boxes.squares(y, 2 * node + k) for k in (0, 1))
            node = 2 * node + (second < first)
        return self._facet[node]

    def within(self, y: NDArray[np.float64], limit: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return pairs of a position and a facet, sorted by position.

        The pairs contain all facets closer than `limit` (m,), in m, to positions y (d, m), and some at larger
        distances.
        """
        at = np.arange(y.shape[1])
        node = np.zeros(len(at), dtype=np.int64)
        most = (limit * (1 + SAME) + self._margin) ** 2
        for boxes in self._levels[1:]:
            at, node = np.repeat(at, 2), np.repeat(2 * node, 2)
            node[1::2] += 1
            kept = np.flatnonzero(boxes.squares(y.take(at, 1), node) <= most.take(at))
            at, node = at[kept], node[kept]
        return at, self._facet[node]
