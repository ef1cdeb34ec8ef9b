# SPDX-License-Identifier: MIT
"""Renewal of particle domains: choice of cells, new domains, and transfer of values from old domains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import EPSILON, NEAR, SAME, TINY
from mpm_dolfinx.grid.grid import (
    FACE_SIGNS,
    FACES,
    TURN,
    Grid,
    corner_bits,
    means_of_rows,
    ranges,
    sum_by,
    sums_of_rows,
)
from mpm_dolfinx.points.cutting import cut, domain_volumes, on_planes, sliced, slices_in_cells, volumes
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.polygons import NONE, Polygons
from mpm_dolfinx.points.surface_in_cells import BOX, EDGES, RING, Region, resampled

GAP = 0.01
"""Largest gap, divided by the cell size, at which faces of two domains count as one surface.

Sensitivity (scene "flow" of tests/plateaus.py): half this value changes the result by 4.0e-05, and twice this value by
0.0e+00. Finer cells change it by 8.5e-02.
"""
CRUMB = NEAR
"""Largest area of a removed part of a domain, divided by the area of its cell.

The remaining parts of the domain receive the mass and the seeded faces of a removed part.  Source: `NEAR`.
"""
SMALL = (0.5 / EDGES) ** 2
"""Cells of yielded soil in which a part of an old domain has less than this fraction of the cell area are renewed too.

Source: definition, a square with half the length of a surface edge (`EDGES` edges in a cell).
"""
COVERED = 0.25
"""Largest difference between the area of the pieces in a renewed cell and its filled area, divided by the cell area.

Source: definition, the area of one of the four new domains in a full cell.
"""
SIDE = np.array([2, 1, 3, 0])
"""Face index of each edge of a domain, anticlockwise."""


class Parts(NamedTuple):
    """Parts of the faces on the surface.  Each part lies in one cell."""

    row: NDArray[np.int64]  # index of the face in `OuterFaces` (m,)
    cell: NDArray[np.int64]  # cell (m,)
    x: NDArray[np.float64]  # ends in cell coordinates in [0, 1] (m, 2, 2), anticlockwise
    t: NDArray[np.float64]  # coordinates of the ends along the face, from 0 at its lower to 1 at its upper end (m, 2)
    side: NDArray[np.int64]  # side of the cell on which the part lies, or -1 (m,)


@dataclass(frozen=True)
class OuterFaces:
    """Faces of domains on the surface of the bodies."""

    point: NDArray[np.int64]  # material point (n,)
    face: NDArray[np.int64]  # index of the face in its domain (n,)
    key: NDArray[np.int64]  # key of the seeded face (n,), see `renewed_faces`
    area: NDArray[np.float64]  # seeded area (n,), m^(d-1), in axisymmetry of the ring, m^2
    ends: NDArray[np.float64]  # reference positions of the ends, the lower end first (n, 2, 2), m


class New(NamedTuple):
    """New particle domains."""

    corners: NDArray[np.float64]  # (n, 4, 2), m
    group: NDArray[np.int64]  # index of the group (n,); domains of a group receive values from the same pieces
    parent: NDArray[np.int64]  # key of the seeded face for each face, or -1 (n, 4)
    area: NDArray[np.float64]  # seeded area of each face (n, 4), m^(d-1), in axisymmetry of the ring, m^2
    ends: NDArray[np.float64]  # reference positions of the ends of each face (n, 4, 2, 2), m


def ring_lengths(grid: Grid, x: NDArray[np.float64]) -> NDArray[np.float64] | float:
    """Return the circumference at positions x (n, 2), in m, in axisymmetry, or 1 in plane strain."""
    return np.maximum(grid.around(x), TURN * EPSILON * grid.least) if grid.axisymmetric else 1.0


def misshapen(grid: Grid, corners: NDArray[np.float64], longest: float) -> NDArray[np.bool_]:
    """Return which domains (n, 4, 2) are partly inverted, or longer than `longest` cell sizes."""
    ring = np.ascontiguousarray(corners.transpose(1, 2, 0))[RING]
    middle = ring.sum(axis=0) / 4
    place = ring / grid.h[:, None] if grid.even else grid.in_cells(ring.swapaxes(1, 2)).swapaxes(1, 2)
    (a, b), edge = (ring - middle).swapaxes(0, 1), np.roll(place, -1, axis=0) - place
    twice = a * np.roll(b, -1, axis=0) - b * np.roll(a, -1, axis=0)
    inverted = twice.min(axis=0) < -2 * CRUMB * grid.sizes_at(middle.T).prod(axis=-1)
    return ((edge**2).sum(axis=1).max(axis=0) > longest**2) | inverted


class RefilledCells:
    """The renewed cells at a reset of the grid, and their new domains.

    `body` (n,): index of the body of each point.
    `free` (n,): whether the domains of points may be replaced.
    `flowed` (n,): whether points have yielded or have been renewed.
    `needs` (n,): whether the domains of points need renewal.
    `faces`: surface of the bodies.
    `signs`: keys of seeded faces, and the index of the set of conditions on each of these faces.
    `second`: whether to compute second moments of the pieces.
    `whole` (n,): whether the domains of points are renewed in all their cells or in none, see `torn`.
    """

    def __init__(
        self,
        grid: Grid,
        points: MaterialPoints,
        body: NDArray[np.int64],
        free: NDArray[np.bool_],
        flowed: NDArray[np.bool_],
        needs: NDArray[np.bool_],
        faces: OuterFaces,
        signs: tuple[NDArray, NDArray],
        second: bool = False,
        whole: NDArray[np.bool_] | bool = False,
    ):
        self.grid = grid
        self.points = points
        self.body = body
        self.pieces = cut(grid, points.corners, second)
        self.cell = self.pieces.cell
        self.cells = grid.cells
        self.faces = faces
        self.parts = self._parts()
        excluded = self._excluded(free, signs)
        self.crossed, self.region = self._chains(excluded)
        size = self._areas / self._volume(self.cell)
        filled = np.where(self.crossed, self.region.area_of(self.cells), 1.0)
        excluded |= np.abs(sum_by(self.cell, size, self.cells) - filled) > COVERED
        self.whole = np.broadcast_to(whole, len(points))
        while (more := self._all_of(self.whole, excluded) & ~excluded).any():
            excluded |= more
        elastic = np.zeros(self.cells, dtype=bool)
        elastic[self.cell[~flowed[self.pieces.point]]] = True
        small = (size < SMALL) & ~elastic[self.cell]  # or renewal would spread through elastic soil
        self.chosen = self._chosen(free & flowed & needs, excluded, small)
        """Whether each cell (cells,) is renewed."""
        self.affected = self._at(self.chosen)
        """Whether each point (n,) loses its domain or a part of it."""

    def _volume(self, cells: NDArray[np.int64]) -> NDArray[np.float64] | float:
        """Return the areas of cells, in m^2."""
        return self.grid.sizes_of(cells).prod(axis=-1)

    @cached_property
    def _areas(self) -> NDArray[np.float64]:
        """Areas of the pieces of domains, in axisymmetry of their meridional sections, in m^2."""
        pieces = self.pieces
        whole = np.abs(volumes(self.points.corners))
        if not self.grid.axisymmetric:
            return pieces.fraction * whole[pieces.point]
        area = pieces.fraction / pieces.hoop[:, 3]
        return area * (whole / sum_by(pieces.point, area, len(whole)))[pieces.point]

    def _at(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which points (n,) have a piece in a cell for which `cells` (cells,) is true."""
        out = np.zeros(len(self.points), dtype=bool)
        out[self.pieces.point[cells[self.cell]]] = True
        return out

    def _all_of(self, domains: NDArray[np.bool_], some: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the cells (cells,) of those of the `domains` (n,) that have a piece or a face in `some` cells."""
        of = np.concatenate([self.pieces.point, self.faces.point[self.parts.row]])
        cell = np.concatenate([self.cell, self.parts.cell])
        reached = np.zeros(len(domains), dtype=bool)
        reached[of[some[cell]]] = True
        out = np.zeros(self.cells, dtype=bool)
        out[cell[(domains & reached)[of]]] = True
        return out

    @property
    def torn(self) -> NDArray[np.bool_]:
        """Which domains (n,) would lose faces on the surface, longer than `GAP` in a cell, or have them twice.

        Removed parts smaller than `CRUMB`, and remainders of folded domains, may lose faces.
        """
        parts, new = self.parts, self.remainders[0]
        of, cell = self.faces.point[parts.row], parts.cell
        twice = self.chosen[cell] & ~self.affected[of]
        length = np.linalg.norm(parts.x[:, 1] - parts.x[:, 0], axis=1)
        length = np.where(self.affected[of] & ~self.chosen[cell], length, 0.0)
        at, face = np.nonzero(new.parent != NONE)
        piece = self.remainders[1][new.group[at] - int(self.chosen.sum())]
        low, high = (new.corners[at, FACES[2][face, k]] for k in (0, 1))
        kept = np.linalg.norm((high - low) / self.grid.sizes_of(self.cell[piece]), axis=1)
        place, number = np.unique(
            np.concatenate([of * self.cells + cell, self.pieces.point[piece] * self.cells + self.cell[piece]]),
            return_inverse=True,
        )
        lost = sum_by(number.ravel(), np.concatenate([length, -kept]), len(place)) > GAP
        out = np.zeros(len(self.points), dtype=bool)
        out[of[twice]] = True
        out[place[lost] // self.cells] = True
        return out

    def _excluded(self, free: NDArray[np.bool_], signs: tuple[NDArray, NDArray]) -> NDArray[np.bool_]:
        """Return which cells cannot be renewed: domains must stay, or there are two bodies or conditions on faces."""
        of, cell = self.pieces.point, self.cell
        parts = self.parts
        low, high = np.full(self.cells, np.iinfo(np.int64).max), np.full(self.cells, -1)
        np.minimum.at(low, cell, self.body[of])
        np.maximum.at(high, cell, self.body[of])
        excluded = low != high
        excluded[cell[~free[of]]] = True
        sign = signs[1][np.searchsorted(signs[0], self.faces.key[parts.row])]
        excluded[parts.cell[sign == NONE]] = True
        place = 5 * parts.cell + parts.side + 1  # inside the cell, or on one of its sides
        least, most = np.full(5 * self.cells, np.iinfo(np.int64).max), np.full(5 * self.cells, -1)
        np.minimum.at(least, place, sign)
        np.maximum.at(most, place, sign)
        excluded[np.flatnonzero((most > least) & (most >= 0)) // 5] = True
        return excluded

    def _chosen(
        self, needed: NDArray[np.bool_], excluded: NDArray[np.bool_], small: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return which cells to renew: cells of `needed` points, and cells with `small` parts of old domains."""
        of, cell = self.pieces.point, self.cell
        chosen = np.zeros(self.cells, dtype=bool)
        chosen[cell[needed[of]]] = True
        chosen &= ~excluded
        more = chosen
        while more.any():
            more = np.zeros(self.cells, dtype=bool)
            more[cell[self._at(chosen)[of] & small]] = True
            more |= self._all_of(self.whole, chosen)
            more &= ~(excluded | chosen)
            chosen |= more
        return chosen

    def _ends(self, row: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the present positions (m, 2, 2), in m, of the ends of faces, the lower end first."""
        at = FACES[2][self.faces.face[row]]
        return np.take_along_axis(self.points.corners[self.faces.point[row]], at[:, :, None], axis=1)

    def _parts(self) -> Parts:
        """Return the surface of the bodies, divided into parts by the cells."""
        grid, n = self.grid, np.arange(len(self.faces.face))
        ends = self._ends(n).swapaxes(0, 1)
        y = on_planes(grid, grid.in_cells(ends), ends, 2)[1]
        t = np.broadcast_to(np.array([0.0, 1.0])[:, None, None], (2, len(n), 1))
        s, row = np.concatenate([y, t], axis=2).transpose(0, 2, 1), n
        for axis in range(2):
            s, row = sliced(s, row, axis, grid)
        s = slices_in_cells(grid, s)
        forward = np.array(FACE_SIGNS)[self.faces.face[row]] > 0
        s = np.where((s[0, 2] <= s[1, 2]) == forward, s, s[::-1])
        edge_vector = s[1, :2] - s[0, :2]
        size = np.hypot(*edge_vector)
        some = size > NEAR
        s, edge_vector = s[:, :, some], edge_vector[:, some]
        row, size = row[some], size[some]
        outward = np.stack([edge_vector[1], -edge_vector[0]]) / size
        middle = s[:, :2].mean(axis=0)
        flat = np.abs(edge_vector) < grid.snap[:, None]
        on = flat & (np.abs(middle - np.rint(middle)) < grid.snap[:, None])
        index = np.floor(np.where(on, np.rint(middle) - (outward > 0), middle)).astype(np.int64)
        index = np.clip(index, 0, (grid.shape - 1)[:, None])
        side = np.where(on[0], np.where(outward[0] > 0, 1, 0), np.where(on[1], np.where(outward[1] > 0, 3, 2), NONE))
        return Parts(row, grid.number(index.T), (s[:, :2] - index).transpose(2, 0, 1), s[:, 2].T, side)

    def _chains(self, excluded: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], Region]:
        """Return which cells the surface crosses, and the filled regions of cells with one crossing.

        Cells with several crossings are added to `excluded`.
        """
        inner = self.parts.side == NONE
        cell, x = self.parts.cell[inner], self.parts.x[inner]
        crossed = np.zeros(self.cells, dtype=bool)
        crossed[cell] = True
        on = (np.minimum(x, 1 - x) < NEAR).any(axis=2)
        starts, ends = (np.flatnonzero(on[:, k]) for k in (0, 1))
        once = crossed.copy()
        chord = sums_of_rows(cell, x[:, 1] - x[:, 0], self.cells)
        P, Q = np.zeros((self.cells, 2)), np.zeros((self.cells, 2))
        for at, k, place in ((starts, 0, P), (ends, 1, Q)):
            once &= np.bincount(cell[at], minlength=self.cells) == 1
            place[cell[at]] = x[at, k]
        once &= np.abs(Q - P - chord).max(axis=1) < GAP
        once &= np.linalg.norm(Q - P, axis=1) > GAP
        a, b = x[:, 0] - P[cell], x[:, 1] - P[cell]
        along = np.einsum("mi,mi->m", a + b, (Q - P)[cell])
        order = np.lexsort((along, cell))
        order = order[once[cell[order]]]
        cell, x = cell[order], x[order]
        open_chains = (np.abs(x[1:, 0] - x[:-1, 1]).max(axis=1) > GAP) & (cell[1:] == cell[:-1])
        once[cell[1:][open_chains]] = False
        excluded |= crossed & ~once
        kept = once[cell]
        cell, x = cell[kept], x[kept]
        at = np.flatnonzero(once)
        ends = self._place(at, np.tile(BOX[:, :2], (len(at), 1, 1)))
        around = np.broadcast_to(self.grid.around(ends.reshape(-1, 2)), 2 * len(at)).reshape(-1, 2)
        surface = resampled(np.searchsorted(at, cell), x, P[at], Q[at], around)
        region = Region(at, surface)
        excluded[at[~region.simple]] = True
        return crossed, region

    # ---- new domains ----------------------------------------------------------------------------

    def _group(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the index of each cell among the renewed cells."""
        number = np.cumsum(self.chosen) - 1
        return number[cells]

    def _place(self, cells: NDArray[np.int64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions (n, k, 2), in m, with coordinates y (n, k, 2), from 0 to 1, in cells (n,)."""
        index = np.stack(np.unravel_index(cells % self.grid.cells, tuple(self.grid.shape)), axis=1)
        return self.grid.places(np.broadcast_to(index[:, None], y.shape), y)

    def full(self) -> New:
        """Return the new domains of full cells.  Each full cell is divided into four equal domains."""
        cells = np.flatnonzero(self.chosen & ~self.crossed)
        bits = corner_bits(2)
        y = (bits[:, None] + bits[None]) / 2  # (4 domains, 4 corners, 2)
        of = np.repeat(cells, 4)
        local = np.tile(y, (len(cells), 1, 1))
        return self._partial(of, local, *no_faces(len(of)))

    def partial(self) -> New:
        """Return the new domains of cells that the surface crosses."""
        inner = np.flatnonzero(self.parts.side == NONE)
        inner = inner[np.argsort(self.parts.cell[inner], kind="stable")]
        parts = Parts(*(column[inner] for column in self.parts))
        whole = sum_by(parts.cell, self._seeded(parts.row, parts.t), self.cells)
        rows, local, surface = self.region.quadrilaterals(self.chosen)
        cells = self.region.cells[rows]
        parent, area, ends = no_faces(len(cells))
        at, face = np.nonzero(surface)
        lower, upper = (local[at, FACES[2][face, k]] for k in (0, 1))
        key, X = self._nearest(parts, cells[at], lower, upper)
        parent[at, face], ends[at, face] = key, X
        middle = self._place(cells[at], ((lower + upper) / 2)[:, None])[:, 0]
        edge = np.linalg.norm(upper - lower, axis=1) * ring_lengths(self.grid, middle)
        total = sum_by(cells[at], edge, self.cells)  # length of all new edges on the surface
        area[at, face] = edge / total[cells[at]] * whole[cells[at]]
        return self._partial(cells, local, parent, area, ends)

    def _nearest(
        self, parts: Parts, cells: NDArray[np.int64], lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the key of the seeded face nearest to each new edge, and the reference positions of the edge's ends.

        `parts`: parts of the old surface, ordered by cell.
        """
        first, stop = (np.searchsorted(parts.cell, cells, side=side) for side in ("left", "right"))
        edge, part = ranges(first, stop - first)
        a, edge_vector = parts.x[part, 0], parts.x[part, 1] - parts.x[part, 0]
        found = []
        for place in ((lower + upper) / 2, lower, upper):
            share = np.einsum("ri,ri->r", place[edge] - a, edge_vector) / np.maximum((edge_vector**2).sum(axis=1), TINY)
            share = np.clip(share, 0.0, 1.0)
            far = np.linalg.norm(a + share[:, None] * edge_vector - place[edge], axis=1)
            best = np.lexsort((far, edge))
            best = best[np.searchsorted(edge[best], np.arange(len(cells)))]
            t0, t1 = parts.t[part[best]].T
            found.append((parts.row[part[best]], t0 + share[best] * (t1 - t0)))
        key = self.faces.key[found[0][0]]
        return key, np.stack([self._seeded_at(*one) for one in found[1:]], axis=1)

    def _seeded(self, row: NDArray[np.int64], t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the seeded areas of the parts of faces between two coordinates t."""
        return self._face_areas[row] * self._share(row, t)

    @cached_property
    def _face_areas(self) -> NDArray[np.float64]:
        """Seeded areas of faces, increased so that the remaining parts include the areas of removed parts."""
        parts, left = self.parts, self._left
        of, share = self.faces.point[parts.row], self._share(parts.row, parts.t)
        remains = np.isin(of * self.cells + parts.cell, self.pieces.point[left] * self.cells + self.cell[left])
        remains |= self.chosen[parts.cell] | ~self.affected[of]
        area = self.faces.area
        whole, there = (sum_by(parts.row, share * weight, len(area)) for weight in (1.0, remains))
        return area * np.divide(whole, there, out=np.ones(len(area)), where=there > 0)

    def _share(self, row: NDArray[np.int64], t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fraction of each face that lies between two coordinates t on the face."""
        share = np.ptp(t, axis=1)
        if self.grid.axisymmetric:
            share = share * ring_share(*self._ends(row)[:, :, 0].T, t.mean(axis=1))
        return share

    def _seeded_at(self, row: NDArray[np.int64], t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reference positions at coordinates t on faces."""
        low, high = self.faces.ends[row].transpose(1, 0, 2)
        return low + t[:, None] * (high - low)

    def _partial(
        self,
        cells: NDArray[np.int64],
        local: NDArray[np.float64],
        parent: NDArray[np.int64],
        area: NDArray[np.float64],
        ends: NDArray[np.float64],
    ) -> New:
        """Return new domains.  Their faces on cell sides take over the old surface on these sides."""
        parts = self.parts
        on = np.flatnonzero(parts.side != NONE)
        on = on[np.argsort(4 * parts.cell[on] + parts.side[on], kind="stable")]
        place = 4 * parts.cell[on] + parts.side[on]
        bordered = Parts(parts.row[on], place, parts.x[on], parts.t[on], parts.side[on])
        length = np.linalg.norm(bordered.x[:, 1] - bordered.x[:, 0], axis=1)
        length = length * ring_lengths(self.grid, self._place(parts.cell[on], bordered.x.mean(axis=1)[:, None])[:, 0])
        seeded = self._seeded(bordered.row, bordered.t)
        count = 4 * self.cells
        dense = sum_by(place, seeded, count) / np.maximum(sum_by(place, length, count), TINY)
        known = np.unique(place)
        for side in range(4):
            axis, end = divmod(side, 2)
            low, high = np.full(count, np.inf), np.full(count, -np.inf)  # the parts may end within the side
            np.minimum.at(low, place, bordered.x[:, :, 1 - axis].min(axis=1))
            np.maximum.at(high, place, bordered.x[:, :, 1 - axis].max(axis=1))
            for face in range(4):
                a, b = (local[:, k] for k in FACES[2][face])
                flat = (np.abs(a[:, axis] - end) < NEAR) & (np.abs(b[:, axis] - end) < NEAR)
                flat &= np.linalg.norm(b - a, axis=1) > NEAR
                at = np.flatnonzero(flat & np.isin(4 * cells + side, known))
                if not len(at):
                    continue
                sides = 4 * cells[at] + side
                key, X = self._nearest(bordered, sides, a[at], b[at])
                middle = (a[at, 1 - axis] + b[at, 1 - axis]) / 2
                covered = (middle > low[sides]) & (middle < high[sides])
                at, sides = at[covered], sides[covered]
                key, X = key[covered], X[covered]
                parent[at, face], ends[at, face] = key, X
                around = ring_lengths(self.grid, self._place(cells[at], ((a + b)[at] / 2)[:, None])[:, 0])
                area[at, face] = np.linalg.norm(b[at] - a[at], axis=1) * around * dense[sides]
        return New(self._place(cells, local), self._group(cells), parent, area, ends)

    @cached_property
    def _left(self) -> NDArray[np.int64]:
        """Indices of the pieces of removed domains outside the renewed cells, without pieces smaller than `CRUMB`."""
        left = np.flatnonzero(self.affected[self.pieces.point] & ~self.chosen[self.cell])
        return left[self._areas[left] > CRUMB * self._volume(self.cell[left])]

    @cached_property
    def remainders(self) -> tuple[New, NDArray[np.int64]]:
        """New domains for pieces of removed domains outside renewed cells, and the indices of these pieces."""
        pieces, points = self.pieces, self.points
        left = self._left
        rings, of = _convex(points.corners[pieces.point[left]], self._volume(self.cell[left]))
        faces = self.faces
        index = np.full((len(points), 5), NONE)  # index of each face among the outer faces; the last one stays NONE
        index[faces.point, faces.face] = np.arange(len(faces.face))
        outer = index[pieces.point[left[of]][:, None], rings.edge] != NONE
        rings = replace(rings, edge=np.where(outer, rings.edge, NONE))
        rings, of = rings.of(np.repeat(np.arange(len(of)), 4)), np.repeat(of, 4)
        halves = np.tile((BOX + corner_bits(2)[:, None]) / 2, (len(of) // 4, 1, 1))
        near = NEAR * self.grid.least  # tolerance: rounding would otherwise split a surface on a grid line
        halves = self._place(self.cell[left][of], halves)
        polygons = rings.within(halves, near)
        inside = np.clip(polygons.x, halves.min(axis=1)[:, None], halves.max(axis=1)[:, None])
        row, quads, edge = replace(polygons, x=inside).simplified(near).quadrilaterals()
        piece = left[of[row]]
        large = np.flatnonzero(Polygons.rings(quads).area > CRUMB * self._volume(self.cell[piece]))
        large = large[np.lexsort((self.cell[piece[large]], pieces.point[piece[large]]))]  # crumbs change no numbers
        piece, quads, edge = (values[large] for values in (piece, quads, edge))
        left, number = np.unique(piece, return_inverse=True)
        corners = np.empty_like(quads)
        corners[:, RING] = quads
        parent, area, ends = no_faces(len(quads))
        at, k = np.nonzero(edge != NONE)
        row, face = index[pieces.point[piece[at]], edge[at, k]], SIDE[k]
        low, high = self._ends(row).swapaxes(0, 1)
        chord = high - low
        off = corners[at[:, None], FACES[2][face]] - low[:, None]
        t = np.einsum("rki,ri->rk", off, chord) / np.maximum((chord**2).sum(axis=1), TINY)[:, None]
        parent[at, face], area[at, face] = faces.key[row], self._seeded(row, t)
        ends[at, face] = np.stack([self._seeded_at(row, s) for s in t.T], axis=1)
        return New(corners, int(self.chosen.sum()) + number.ravel(), parent, area, ends), left

    # ---- transfer of values ---------------------------------------------------------------------

    def slopes(self, values: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return slopes (n, 2, k), in units of `values` per m, of least-squares fits in the cells of n new domains."""
        pieces, grid = self.pieces, self.grid
        weight = pieces.fraction * self.points.volume0[pieces.point]

        def means(rows: NDArray) -> NDArray:
            return means_of_rows(self.cell, weight, rows, self.cells)

        y, q = self.points.x[pieces.point] / grid.sizes_of(self.cell), values[pieces.point]
        y, q = (rows - means(rows)[self.cell] for rows in (y, q))
        normal = means(y[:, :, None] * y[:, None])
        right = means(y[:, :, None] * q[:, None])
        value, axes = np.linalg.eigh(normal)
        some = value > SAME  # `value` in squared cell sizes; a single row of pieces determines no slope across it
        inverse = np.where(some, 1 / np.where(some, value, 1.0), 0.0)
        sizes = grid.sizes_of(np.arange(self.cells))[..., None]
        slope = (axes * inverse[:, None]) @ axes.swapaxes(1, 2) @ right / sizes
        cells = np.concatenate([np.flatnonzero(self.chosen), self.cell[self.remainders[1]]])
        return slope[cells[group]]

    @cached_property
    def into(self) -> tuple[NDArray, NDArray, NDArray]:
        """Indices of pieces of removed domains, the groups of new domains that receive them, and mass fractions."""
        pieces, outside = self.pieces, self.remainders[1]
        into = np.flatnonzero(self.chosen[self.cell] & self.affected[pieces.point])
        piece = np.concatenate([into, outside])
        groups = np.concatenate([self._group(self.cell[into]), int(self.chosen.sum()) + np.arange(len(outside))])
        share = pieces.fraction[piece]
        whole = sum_by(pieces.point[piece], share, len(self.points))
        return piece, groups, share / whole[pieces.point[piece]]  # includes the mass of dropped parts

    def pairs(self, corners: NDArray[np.float64], group: NDArray[np.int64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return pairs of an old and a new domain, and the fraction of the old mass that the new domain receives."""
        piece, groups, share = self.into
        order = np.argsort(group, kind="stable")
        first, stop = (np.searchsorted(group[order], groups, side=side) for side in ("left", "right"))
        of, at = ranges(first, stop - first)
        at = order[at]
        old = self.pieces.point[piece[of]]
        rings, which = _convex(self.points.corners[old], self._volume(self.cell[piece[of]]))
        both = rings.within(corners[at][which][:, RING])
        around = self.grid.around(both.centroid) if self.grid.axisymmetric else 1.0
        common = np.maximum(sum_by(which, both.area * around, len(of)), 0.0)
        whole = np.abs(domain_volumes(corners[at], self.grid.axisymmetric))
        common += EPSILON * whole  # a domain without overlap receives the mean of its cell
        total = sum_by(of, common, len(piece))
        return old, at, share[of] * common / total[of]

    def on_faces(
        self, values: NDArray[np.float64], parent: NDArray[np.int64], group: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return point data (n, ...) of new domains: means over old surfaces in their cells, or 0 without a surface."""
        parts = self.parts
        inside = np.flatnonzero(self.chosen[parts.cell])
        cell, of = parts.cell[inside], self.faces.point[parts.row[inside]]
        length = np.linalg.norm((parts.x[inside, 1] - parts.x[inside, 0]) * self.grid.sizes_of(cell), axis=1)
        length = length * ring_lengths(self.grid, self._place(cell, parts.x[inside].mean(axis=1)[:, None])[:, 0])
        flat = values[of].reshape(len(of), int(np.prod(values.shape[1:])))
        count = int(self.chosen.sum())
        number = self._group(cell)
        means = means_of_rows(number, length, flat, count)
        pieces = values[self.pieces.point[self.remainders[1]]]
        out = np.concatenate([means, pieces.reshape(len(pieces), flat.shape[1])])[group]
        out *= (parent != NONE).any(axis=1)[:, None]
        return out.reshape(len(group), *values.shape[1:])


def no_faces(n: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return placeholders for n domains without faces on the surface: keys `NONE`, areas 0 and ends 0."""
    return np.full((n, 4), NONE), np.zeros((n, 4)), np.zeros((n, 4, 2, 2))


def ring_share(r0: NDArray[np.float64], r1: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the radii (n,) at coordinates t (n,) on faces from radius r0 to r1, divided by `(r0 + r1) / 2`."""
    mean = (r0 + r1) / 2
    return np.divide(r0 + t * (r1 - r0), mean, out=np.ones(len(t)), where=mean > 0)


def _convex(corners: NDArray[np.float64], volume: NDArray[np.float64] | float) -> tuple[Polygons, NDArray[np.int64]]:
    """Divide domains into convex polygons.  Return the polygons, and the index of the domain of each polygon."""
    ring = corners[:, RING]
    edge = np.tile(SIDE, (len(ring), 1))
    away = np.roll(ring, -1, axis=1) - ring
    before = np.roll(away, 1, axis=1)
    turn = before[:, :, 0] * away[:, :, 1] - before[:, :, 1] * away[:, :, 0]
    bent = turn.min(axis=1) < -NEAR * volume  # tolerance: rounding would otherwise choose a diagonal
    even = np.flatnonzero(~bent)
    out, of = [(ring[even], edge[even])], [even]
    at = np.flatnonzero(bent)
    if len(at):
        halves = [[(0, 1, 2, 2), (0, 2, 3, 3)], [(1, 2, 3, 3), (1, 3, 0, 0)]]
        kept = [[(0, 1, NONE, NONE), (NONE, 2, NONE, 3)], [(1, 2, NONE, NONE), (NONE, 3, NONE, 0)]]
        areas = np.array([[Polygons.rings(ring[at][:, list(half)]).area for half in two] for two in halves])
        best = areas.min(axis=1).argmax(axis=0)
        for diagonal in (0, 1):
            for half, numbers in zip(halves[diagonal], kept[diagonal], strict=True):
                rows = at[best == diagonal]
                rows = rows[Polygons.rings(ring[rows][:, list(half)]).area > 0]
                number = np.array([SIDE[k] if k != NONE else NONE for k in numbers])
                out.append((ring[rows][:, list(half)], np.tile(number, (len(rows), 1))))
                of.append(rows)
    x, edge = (np.concatenate(column) for column in zip(*out, strict=True))
    return Polygons.rings(x, edge), np.concatenate(of)
