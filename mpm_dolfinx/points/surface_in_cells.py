# SPDX-License-Identifier: MIT
"""The surface of bodies in single cells in 2D, and quadrilaterals that fill the part of a cell inside the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR, TINY
from mpm_dolfinx.grid.grid import cross_in_plane, sum_by
from mpm_dolfinx.points.polygons import NONE, Polygons

EDGES = 4
"""Number of edges of the surface in a cell with renewed particle domains.

Sensitivity (scene "flow" of tests/plateaus.py): half this value changes the result by 2.8e-03, and twice this value by
2.6e-04. Finer cells change it by 8.5e-02.
"""
BENT = 1 - 3**0.5 / 2
"""Largest deviation of a surface without a corner from its chord, in cell sizes.

Source: exact for an arc with a chord and a radius of one cell size.
"""
RING = np.array([0, 1, 3, 2])
"""Corners of a particle domain, anti-clockwise."""
BOX = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])
"""Corners of a cell (1, 4, 2), anti-clockwise."""
_HALVES = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]]) / 2


class Region:
    """The filled part of n cells that the surface crosses once, in cell coordinates from 0 to 1.

    `cells`: local indices of the cells.
    `surface` (n, EDGES + 1, 2): vertices of the surface in each cell, from entry to exit, with the body on the left.
    """

    def __init__(self, cells: NDArray[np.int64], surface: NDArray[np.float64]):
        self.cells = cells
        edges = surface.shape[1] - 1
        most = edges + 10  # plus corners and midpoints of the cell's sides, and one more vertex
        start, end = (2 * _around(surface[:, k]) for k in (-1, 0))  # in units of half a side of the cell
        end = np.where(end <= start + NEAR, end + 8, end)
        first = np.floor(start + NEAR).astype(np.int64) + 1
        count = np.maximum(0, np.ceil(end - NEAR).astype(np.int64) - first)
        x = np.zeros((len(cells), most, 2))
        x[:, : edges + 1] = surface
        for k in range(8):
            has = count > k
            x[has, edges + 1 + k] = _HALVES[(first[has] + k) % 8]
        size = edges + 1 + count
        odd = np.flatnonzero(size % 2)
        after = np.where((np.arange(most) < size[:, None] - 1)[:, :, None], np.roll(x, -1, axis=1), x[:, :1])
        at = (edges + size[odd] - 1) // 2  # the middle of the edges inside the body
        place = np.arange(most)[None]
        middle = (x[odd, at] + after[odd, at]) / 2
        padded = np.take_along_axis(x[odd], np.where(place <= at[:, None], place, place - 1)[:, :, None], axis=1)
        padded[np.arange(len(odd)), at + 1] = middle
        x[odd] = padded
        self._size = size + size % 2
        last = np.take_along_axis(x, (self._size - 1)[:, None, None], axis=1)
        x = np.where((np.arange(most) < self._size[:, None])[:, :, None], x, last)
        self._x = x
        ring = Polygons(x, self._size, np.full(x.shape[:2], NONE))
        self.area = ring.area
        self._middle = ring.centroid
        a, b = x - self._middle[:, None], ring.after - self._middle[:, None]
        angles = np.where(np.arange(most) < self._size[:, None], cross_in_plane(a, b), 1.0)
        self.simple = (angles.min(axis=1) > 0) & (self.area > NEAR)

    def area_of(self, count: int) -> NDArray[np.float64]:
        """Return the filled area fraction of each of `count` cells.  The fraction is 1 in cells outside `cells`."""
        out = np.ones(count)
        out[self.cells] = self.area
        return out

    def quadrilaterals(
        self, chosen: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return the new domains in chosen cells: cells (m,), corners (m, 4, 2), and flags of surface faces (m, 4)."""
        rows = np.flatnonzero(chosen[self.cells])
        corners, of = [np.zeros((0, 4, 2))], [rows[:0]]
        surface = [np.zeros((0, 4), dtype=bool)]
        for k in range(0, self._x.shape[1], 2):
            at = rows[self._size[rows] > k]
            size = self._size[at]
            two = np.stack([self._x[at, k], self._x[at, k + 1], self._x[at, (k + 2) % size]], axis=1)
            ring = np.concatenate([self._middle[at, None], two], axis=1)
            domain = np.empty_like(ring)
            domain[:, RING] = ring
            on = np.zeros((len(at), 4), dtype=bool)
            on[:, 1] = k < EDGES
            on[:, 3] = k + 1 < EDGES
            corners.append(domain)
            of.append(at)
            surface.append(on)
        return np.concatenate(of), np.concatenate(corners), np.concatenate(surface)


def resampled(
    of: NDArray[np.int64],
    x: NDArray[np.float64],
    P: NDArray[np.float64],
    Q: NDArray[np.float64],
    around: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the surface in n cells as vertices (n, EDGES + 1, 2) from P to Q (n, 2).

    Vertices are at sharp bends, and divide nearly straight parts evenly.  A shift of the vertices conserves the area
    between surface and chord, or in axisymmetry the volume of the ring of this area.

    `of` (m,): index of the cell of each segment, ascending.
    `x` (m, 2, 2): both ends of each segment, in coordinates from 0 to 1 of its cell.
    `around` (n, 2): `Grid.around` at the lower and the upper side of each cell along the first axis.
    """
    length = np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
    arc = np.concatenate([[0.0], np.cumsum(length)])
    first, stop = (np.searchsorted(of, np.arange(len(P)), side=side) for side in ("left", "right"))
    ends = arc[first], arc[stop]
    out = np.concatenate([P[:, None], np.zeros((len(P), EDGES - 1, 2)), Q[:, None]], axis=1)
    at = np.zeros((len(P), EDGES + 1))
    at[:, 0], at[:, -1] = ends
    joint = (x[:, 0] + np.roll(x[:, 1], 1, axis=0)) / 2  # there may be small gaps between segments

    def divide(low: int, high: int) -> None:
        """Place a vertex between two other vertices, at the sharpest bend or in the middle."""
        middle = (low + high) // 2
        a, chord = out[:, low], out[:, high] - out[:, low]
        off = joint - a[of]
        far = np.abs(cross_in_plane(chord[of], off))
        far /= np.maximum(np.linalg.norm(chord, axis=1), TINY)[of]
        within = (arc[:-1] > at[of, low]) & (arc[:-1] < at[of, high])
        far = np.where(within, far, 0.0)
        order = np.lexsort((far, of))
        corner = order[stop - 1]
        target = (at[:, low] + at[:, high]) / 2
        target = np.where(far[corner] > BENT, arc[corner], target)
        at[:, middle] = target
        out[:, middle] = (place(target - NEAR) + place(target + NEAR)) / 2  # the same result from both ends

    def place(target: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions in each cell at the arc lengths `target` along the segments."""
        part = np.clip(np.searchsorted(arc, target, side="right") - 1, first, stop - 1)
        t = (target - arc[part]) / np.maximum(length[part], TINY)
        return x[part, 0] + t[:, None] * (x[part, 1] - x[part, 0])

    step = EDGES
    while step > 1:
        for low in range(0, EDGES, step):
            divide(low, low + step)
        step //= 2
    a, b = x.transpose(1, 0, 2) - P[of]
    gap = (of[1:] == of[:-1])[:, None] * (a[1:] - b[:-1])
    inner, wider = around[:, 0], around[:, 1] - around[:, 0]

    def ring(a: NDArray, b: NDArray, of: NDArray) -> NDArray:
        """Return twice the areas of triangles (P, P + a, P + b), or twice the volumes of their rings in axisymmetry."""
        return cross_in_plane(a, b) * (inner[of] + wider[of] * (P[of, 0] + (a[:, 0] + b[:, 0]) / 3))

    bulge = sum_by(of, ring(a, b, of), len(P)) + sum_by(of[1:], ring(b[:-1], b[:-1] + gap, of[1:]), len(P))
    y = out - P[:, None]
    row = np.arange(len(P)).repeat(EDGES)
    has = sum_by(row, ring(y[:, :-1].reshape(-1, 2), y[:, 1:].reshape(-1, 2), row), len(P))
    chords = out[:, 2:] - out[:, :-2]
    normal = np.stack([chords[:, :, 1], -chords[:, :, 0]], axis=2)
    size = np.maximum(np.linalg.norm(chords, axis=2), TINY)
    shift = (bulge - has) / (size * (inner[:, None] + wider[:, None] * out[:, 1:-1, 0])).sum(axis=1)
    out[:, 1:-1] += shift[:, None, None] * normal / size[:, :, None]
    return np.clip(out, 0.0, 1.0)


def _around(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the arc lengths (0 to 4) of positions on the sides of the unit square, anti-clockwise from (0, 0)."""
    near = np.stack([x[:, 1], 1 - x[:, 0], 1 - x[:, 1], x[:, 0]], axis=1)
    side = near.argmin(axis=1)
    along = np.stack([x[:, 0], 1 + x[:, 1], 3 - x[:, 0], 4 - x[:, 1]], axis=1)
    return along[np.arange(len(x)), side] % 4
