# SPDX-License-Identifier: MIT
"""Arrays of convex polygons in the plane: cuts by lines, and division into quadrilaterals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.grid.grid import means_of_rows

NONE = -1
"""Value in `Polygons.edge` for edges without an identifier."""


@dataclass(frozen=True)
class Polygons:
    """n polygons of up to k vertices, anti-clockwise."""

    x: NDArray[np.float64]  # (n, k, 2) vertices, m, padded by the last vertex
    count: NDArray[np.int64]  # (n,) number of vertices
    edge: NDArray[np.int64]  # (n, k) identifier of the edge from each vertex to the next; cuts preserve it

    @classmethod
    def rings(cls, x: NDArray[np.float64], edge: NDArray[np.int64] | None = None) -> Polygons:
        """Return polygons with the vertices x (n, k, 2), and optional identifiers of edges."""
        n, k = x.shape[:2]
        return cls(x, np.full(n, k), np.full((n, k), NONE) if edge is None else edge)

    def of(self, rows: NDArray) -> Polygons:
        """Return the polygons with indices `rows`."""
        return Polygons(self.x[rows], self.count[rows], self.edge[rows])

    @property
    def after(self) -> NDArray[np.float64]:
        """Position (n, k, 2), in m, of the vertex after each vertex."""
        last = np.arange(self.x.shape[1]) == self.count[:, None] - 1
        return np.where(last[:, :, None], self.x[:, :1], np.roll(self.x, -1, axis=1))

    @property
    def area(self) -> NDArray[np.float64]:
        """Areas (n,) of the polygons, in m^2."""
        return self._moments[0]

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Centroids (n, 2) of the polygons, in m.  A polygon without area has its first vertex as centroid."""
        area, moment = self._moments
        some = area > 0
        return self.x[:, 0] + np.divide(moment, area[:, None], out=np.zeros_like(moment), where=some[:, None])

    @property
    def _moments(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Areas, in m^2, and first moments of area about the first vertices, in m^3."""
        y = self.x - self.x[:, :1]
        after = np.roll(y, -1, axis=1)
        twice = y[:, :, 0] * after[:, :, 1] - y[:, :, 1] * after[:, :, 0]
        return twice.sum(axis=1) / 2, np.einsum("nk,nki->ni", twice, y + after) / 6

    def cut(self, normal: NDArray[np.float64], level: NDArray[np.float64]) -> Polygons:
        """Return the part of each polygon where `normal . x <= level`, with normal (n, 2) and level (n,).

        Source: Sutherland and Hodgman (1974). New edges have no identifier.
        """
        n, k = self.edge.shape
        used = np.arange(k) < self.count[:, None]
        excess = np.where(used, np.einsum("nki,ni->nk", self.x, normal) - level[:, None], 0.0)
        last, x1 = np.arange(k) == self.count[:, None] - 1, self.after
        beyond1 = np.where(last, excess[:, :1], np.roll(excess, -1, axis=1))
        inside = excess <= 0
        crosses = used & (inside != (beyond1 <= 0))
        share = np.divide(excess, excess - beyond1, out=np.zeros_like(excess), where=crosses)
        crossing = self.x + share[:, :, None] * (x1 - self.x)
        x = np.stack([self.x, crossing], axis=2).reshape(n, 2 * k, 2)
        edge = np.stack([self.edge, np.where(inside, NONE, self.edge)], axis=2).reshape(n, 2 * k)
        kept = np.stack([used & inside, crosses], axis=2).reshape(n, 2 * k)
        return _packed(x, edge, kept)

    def within(self, others: NDArray[np.float64], near: float = 0.0) -> Polygons:
        """Return the intersection of each polygon with a convex, anti-clockwise polygon with vertices (n, m, 2).

        `near`, in m: tolerance for vertices outside the other polygon.
        """
        out = self
        for k in range(others.shape[1]):
            edge_vector = others[:, (k + 1) % others.shape[1]] - others[:, k]
            normal = np.stack([edge_vector[:, 1], -edge_vector[:, 0]], axis=1)
            tolerance = near * np.linalg.norm(normal, axis=1)
            out = out.cut(normal, np.einsum("ni,ni->n", normal, others[:, k]) + tolerance)
        return out

    def simplified(self, near: float) -> Polygons:
        """Remove vertices on straight edges.  Replace neighbouring vertices closer than `near`, in m, by their mean."""
        n, most = self.edge.shape
        used = np.arange(most) < self.count[:, None]
        kept = used & (np.abs(self.after - self.x).max(axis=2) > near)
        number = np.cumsum(kept, axis=1) - kept  # vertices after the last kept vertex merge with the first one
        number = number % np.maximum(kept.sum(axis=1), 1)[:, None] + most * np.arange(n)[:, None]
        means = means_of_rows(number[used], np.ones(used.sum()), self.x[used], n * most)  # equal for mirror images
        out = _packed(means[number], self.edge, kept)
        k, last = np.arange(out.edge.shape[1]), np.maximum(out.count - 1, 0)[:, None]
        before = np.roll(out.x, 1, axis=1)  # vertices are padded by the last one
        same = out.edge == np.where(k == 0, np.take_along_axis(out.edge, last, axis=1), np.roll(out.edge, 1, axis=1))
        a, b = out.x - before, out.after - before
        off = np.abs(a[:, :, 0] * b[:, :, 1] - a[:, :, 1] * b[:, :, 0])
        straight = same & (off <= near * np.linalg.norm(b, axis=2))
        return _packed(out.x, out.edge, (k <= last) & ~straight)

    def quadrilaterals(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
        """Divide convex polygons into quadrilaterals of similar area.

        Returns
        -------
        Index (m,) of the polygon of each quadrilateral.
        Vertices (m, 4, 2) and edge identifiers (m, 4) of the quadrilaterals.  In a triangle, the fourth vertex is the
        middle of the longest edge.
        """
        left, rows = self, np.arange(len(self.count))
        found = []
        while len(rows):
            most = int(left.count.max())
            at = left.count == most
            if most > 2:
                some = Polygons(left.x[at][:, :most], left.count[at], left.edge[at][:, :most])
                part, rest = some._divided() if most > 4 else (some, None)
                found.append((rows[at], *(part._of_four() if part.x.shape[1] == 3 else (part.x, part.edge))))
                if rest is not None:
                    left, rows = left.of(~at)._joined(rest), np.concatenate([rows[~at], rows[at]])
                    continue
            left, rows = left.of(~at), rows[~at]
        if not found:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros((0, 4), dtype=np.int64)
        rows, x, edge = (np.concatenate(column) for column in zip(*found, strict=True))
        return rows, x, edge

    def _divided(self) -> tuple[Polygons, Polygons]:
        """Divide polygons with more than four vertices into two parts, the smaller of which is as large as possible.

        If several divisions are equal, as by both diagonals of a trapezoid, the one with the shortest cut is chosen.
        """
        n = self.x.shape[1]
        size = 3 if n == 5 else 4
        firsts = range(3 if n == 6 else n)  # opposite first vertices divide hexagons alike
        parts = np.array([np.roll(self.x, -first, axis=1)[:, :size] for first in firsts])
        area = np.array([Polygons.rings(one).area for one in parts])
        least, length = np.minimum(area, self.area - area), ((parts[:, :, -1] - parts[:, :, 0]) ** 2).sum(axis=2)
        even = least >= least.max(axis=0) - SAME * self.area  # otherwise rounding would choose
        start = np.where(even, length, np.inf).argmin(axis=0)
        order = (start[:, None] + np.arange(n)) % n
        x, edge = np.take_along_axis(self.x, order[:, :, None], axis=1), np.take_along_axis(self.edge, order, axis=1)
        part, rest = edge[:, :size].copy(), edge[:, [0, *range(size - 1, n)]]
        part[:, -1] = rest[:, 0] = NONE
        return Polygons.rings(x[:, :size], part), Polygons.rings(x[:, [0, *range(size - 1, n)]], rest)

    def _of_four(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return triangles as quadrilaterals, with the middle of the longest edge as a vertex."""
        size = np.linalg.norm(self.after - self.x, axis=2)
        order = (size.argmax(axis=1)[:, None] + np.arange(3)) % 3
        x, edge = np.take_along_axis(self.x, order[:, :, None], axis=1), np.take_along_axis(self.edge, order, axis=1)
        middle = (x[:, :1] + x[:, 1:2]) / 2
        return np.concatenate([x[:, :1], middle, x[:, 1:]], axis=1), edge[:, [0, 0, 1, 2]]

    def _joined(self, other: Polygons) -> Polygons:
        """Return these polygons, followed by `other` polygons with at most as many vertices."""
        more = self.x.shape[1] - other.x.shape[1]
        x = np.concatenate([self.x, np.pad(other.x, ((0, 0), (0, more), (0, 0)), mode="edge")])
        edge = np.concatenate([self.edge, np.pad(other.edge, ((0, 0), (0, more)), constant_values=NONE)])
        return Polygons(x, np.concatenate([self.count, other.count]), edge)


def _packed(x: NDArray[np.float64], edge: NDArray[np.int64], kept: NDArray[np.bool_]) -> Polygons:
    """Return polygons with the vertices in `kept` only."""
    count = kept.sum(axis=1)
    most = max(1, int(count.max(initial=0)))
    order = np.argsort(~kept, axis=1, kind="stable")[:, :most]
    order = np.take_along_axis(order, np.minimum(np.arange(most), np.maximum(count - 1, 0)[:, None]), axis=1)
    out = np.take_along_axis(edge, order, axis=1)
    out[np.arange(most) >= np.maximum(count, 1)[:, None]] = NONE
    return Polygons(np.take_along_axis(x, order[:, :, None], axis=1), count, out)
