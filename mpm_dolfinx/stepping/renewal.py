# SPDX-License-Identifier: MIT
"""Domains of soil that has flowed, renewed as the grid is reset.

Yielded soil carries F by increments, so its domains are quadrature only: they may be divided anew if the new ones fill
the same region, keep its surface, and hold what the old ones did.  Where a domain has become longer than a cell, the
cells that it lies in are filled anew:

* a full cell with its halves along each axis;
* a cell that the surface passes through once with quadrilaterals about the centroid of what the body fills.  The
  surface there becomes two edges with the ends and the area of what it was.

What old domains have beyond these cells is cut off, and stays as it is.  Masses and volumes are exact in each cell; the
logarithm of the elastic left Cauchy-Green tensor, and what else points carry, are means over the overlap, by mass.
Cells that hold elastic soil, several bodies, sides with given displacements, or more than one pass of the surface are
left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import EPSILON, NEAR, SAME, TINY
from mpm_dolfinx.bodies.bodies import Body, body_of
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.domains.renewed_faces import AREA, ENDS, PARENT, keys, with_faces
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.cutting import (
    FACES,
    _slice,
    centroids,
    corner_bits,
    cut,
    simplex_volumes,
    vertices,
    volumes,
)
from mpm_dolfinx.points.material_points import ACROSS, MaterialPoints, in_space
from mpm_dolfinx.points.polygons import NONE, Polygons
from mpm_dolfinx.stepping.stage import Stage

LONGEST = 1.0
"""Cells that a domain may be long; the nodes bend a longer one, whose edges are straight.  Source: definition."""
EDGES = 4
"""Edges that the surface has in a cell afterwards; with two a bar in clay loses 5 % of its resistance in the step."""
BENT = 1 - 3**0.5 / 2
"""Cells by which the surface turns at a corner; what bends less is divided evenly.

Source: exact, a chord of one cell in a circle of a cell's radius: the grid sees no smaller one.
"""
APART = 0.01
"""Cells by which ends of the surface of two domains may part, and be one."""
CRUMB = APART**2
"""Share of a cell that is no domain of its own: what is left of one beside it has its mass.  Source: definition."""
SMALL = (0.5 / EDGES) ** 2
"""Share of a cell: where less is left of a domain, its cell is filled anew as well.

Source: definition, half of an edge wide.
"""
COVERED = 0.25
"""Share of a cell by which its pieces may miss what its surface says that it holds.  Source: definition, one domain."""
RING = np.array([0, 1, 3, 2])
"""Corners of a domain, anti-clockwise."""
SIDE = np.array([2, 1, 3, 0])
"""Face of a domain that each edge of the ring is."""
START, END = np.array([2, 1, 0, 3]), np.array([0, 3, 1, 2])
"""Corners at which each face starts and ends, anti-clockwise."""


class Parts(NamedTuple):
    """Parts of the surface in cells: rows (m,) of the faces, cell (m,), ends (m, 2, 2) in the cell, from 0 to 1.

    t : (m, 2) places of the ends on the face, from 0 to 1; side : (m,) that of the cell on which it lies, else -1.
    """

    row: NDArray[np.int64]
    cell: NDArray[np.int64]
    x: NDArray[np.float64]
    t: NDArray[np.float64]
    side: NDArray[np.int64]


@dataclass(frozen=True)
class OuterFaces:
    """Faces of domains (m,) that are on the surface: point, number of the face, its key, and as seeded its length, m,
    and reference positions of its ends (m, 2, 2), m, the lower one first.
    """

    point: NDArray[np.int64]
    face: NDArray[np.int64]
    key: NDArray[np.int64]
    area: NDArray[np.float64]
    ends: NDArray[np.float64]


class New(NamedTuple):
    """New domains: corners (n, 4, 2), m; the group (n,) that shares what it gets; keys, lengths and ends of faces."""

    corners: NDArray[np.float64]
    group: NDArray[np.int64]
    parent: NDArray[np.int64]
    area: NDArray[np.float64]
    ends: NDArray[np.float64]


class Renewal:
    """Renews domains of a scene.

    Parameters
    ----------
    grid, bodies, materials
        Those of the scene.
    """

    def __init__(self, grid: Grid, bodies: Sequence[Body], materials: SceneMaterials):
        self._grid = grid
        self._bodies = bodies
        self._starts = np.cumsum([0, *map(len, bodies)])
        self._materials = materials
        self._signs: Latest[tuple[NDArray, NDArray]] = Latest()

    @cached_property
    def _outer(self) -> OuterFaces:
        """All outer faces of the bodies as seeded, ordered by key."""
        found = []
        for start, body in zip(self._starts, self._bodies, strict=False):
            row, face = body.outer()
            at = FACES[2][face]
            X, x = (np.take_along_axis(of(row), at[:, :, None], axis=1) for of in (body.reference, body.corners))
            size = np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
            found.append((start + row, face, keys(start + row, face), size, X))
        columns = [np.concatenate(column) for column in zip(*found, strict=True)]
        order = np.argsort(columns[2])
        return OuterFaces(*(column[order] for column in columns))

    def _faces(self, points: MaterialPoints) -> OuterFaces:
        """Return the outer faces of points."""
        seeded = self._outer
        here, at = points.find(seeded.point)
        columns = [(at, *(v[here] for v in (seeded.face, seeded.key, seeded.area, seeded.ends)))]
        if PARENT in points.data:
            at, face = np.nonzero(points.data[PARENT] != NONE)
            columns.append((at, face, *(points.data[name][at, face] for name in (PARENT, AREA, ENDS))))
        return OuterFaces(*map(np.concatenate, zip(*columns, strict=True)))

    def long(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return which domains (n,) have an edge longer than `LONGEST` cells, or are turned inside out in a part."""
        ring = points.corners[:, RING] / self._grid.h
        edge = np.roll(ring, -1, axis=1) - ring
        parts = simplex_volumes(vertices(np.ascontiguousarray(points.corners.transpose(1, 2, 0))))
        turned = parts.min(axis=0, initial=0.0) < -CRUMB * self._grid.cell_volume
        return ((edge**2).sum(axis=2).max(axis=1) > LONGEST**2) | turned

    def flowed(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return which points (n,) have yielded, and have a law whose elastic strain is known."""
        if "plastic" not in points.data:
            return np.zeros(len(points), dtype=bool)
        known = np.array(["plastic" in law.state for law in self._materials.laws])[self._materials.law_of(points)]
        return known & (self._materials.evolved(points) | (points.id >= self._starts[-1]))

    def due(self, points: MaterialPoints, watched: NDArray[np.int64] | None) -> bool:
        """Return whether domains of this process should be renewed; watched (m,): numbers of points that may not."""
        return bool((self._free(points, watched) & self.long(points)).any())

    def _free(self, points: MaterialPoints, watched: NDArray[np.int64] | None) -> NDArray[np.bool_]:
        """Return which points (n,) may be renewed."""
        flowed = self.flowed(points)
        return flowed if watched is None else flowed & ~np.isin(points.id, watched)

    def renewed(
        self, points: MaterialPoints, stage: Stage, watched: NDArray[np.int64] | None, comm: MPI.Comm
    ) -> tuple[MaterialPoints, int]:
        """Return points some of whose domains are renewed, and how many were; of all processes together.

        Parameters
        ----------
        points
            All points on the first process, none on others.
        stage
            The conditions in force.
        watched : (m,)
            Numbers of points that may not be renewed.
        comm
            The processes.
        """
        made, count = (points, 0) if comm.rank else self._renewed(points, stage, self._free(points, watched))
        count = over_all(comm, count)
        return (with_faces(made) if count else made), count

    def _renewed(self, points: MaterialPoints, stage: Stage, free: NDArray[np.bool_]) -> tuple[MaterialPoints, int]:
        held, touched = [faces for _, faces, _ in stage.held], tuple(stage.kept(0))
        signs = self._signs((stage,), lambda: self._signatures(stage.faces, held), MPI.COMM_SELF)
        work = _Work(self._grid, points, body_of(points.id, self._starts), free, self.long(points))
        work.classify(self._faces(points), signs)
        if not work.chosen.any():
            return points, 0
        new = [work.full(), *work.partial(), work.rest()]
        return self._filled(points, work, new, touched)

    def _signatures(
        self, surfaces: Sequence[Surface], held: Sequence[Surface]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return for all outer faces, by key, a number of the conditions that act on them; -1 where they may not be
        renewed.
        """
        key = self._outer.key
        kind = np.zeros((len(key), len(surfaces)), dtype=np.int8)
        barred = np.zeros(len(key), dtype=bool)
        for k, faces in enumerate(surfaces):
            at = np.minimum(np.searchsorted(key, keys(faces.id, faces.face)), len(key) - 1)
            ok = key[at] == keys(faces.id, faces.face)
            whole = np.ptp(faces.xi, axis=1).max(axis=1) > 2 - SAME
            kind[at[ok & whole], k] = 1
            barred[at[ok & ~whole]] = True
        for faces in held:
            barred |= np.isin(key, keys(faces.id, faces.face))
        number = np.unique(kind, axis=0, return_inverse=True)[1].ravel() if len(surfaces) else np.zeros(len(key), int)
        return key, np.where(barred, NONE, number)

    def _filled(
        self, points: MaterialPoints, work: _Work, new: Sequence[New], touched: Sequence[str]
    ) -> tuple[MaterialPoints, int]:
        """Return the points with new domains in place of those that are gone."""
        corners, group, parent, area, ends = (np.concatenate(column) for column in zip(*new, strict=True))
        old, at, share, of_group = work.pairs(corners, group)
        n, mass = len(corners), points.volume0
        J = points.J
        weight = share * mass[old]
        total = sum_by(at, weight, n)

        x = centroids(corners)
        off = x - np.stack([sum_by(at, weight * column, n) / total for column in points.x[old].T], axis=1)

        def mean(values: NDArray) -> NDArray:
            flat = values[old].reshape(len(old), int(np.prod(values.shape[1:])))
            sums = [sum_by(at, weight * column, n) / total for column in flat.T]
            if sums:
                rise = work.rise(values.reshape(len(values), flat.shape[1]), group)
                low, high = np.full((n, flat.shape[1]), np.inf), np.full((n, flat.shape[1]), -np.inf)
                np.minimum.at(low, at, flat)
                np.maximum.at(high, at, flat)
                means = np.stack(sums, axis=1)
                means = np.clip(means + np.einsum("ni,nik->nk", off, rise), low, high)
                return means.reshape(n, *values.shape[1:])
            return np.stack(sums, axis=1).reshape(n, *values.shape[1:]) if sums else np.zeros((n, *values.shape[1:]))

        size = np.abs(volumes(corners))
        count = int(group.max()) + 1
        gone, groups, part = of_group
        M, V = (sum_by(groups, part * of[gone], count) for of in (mass, mass * J))
        A = sum_by(group, size, count)
        like = np.exp(mean(np.log(J)))
        scale = V / M * sum_by(group, size / like, count) / A  # mass and volume are both exact
        ratio = like * scale[group]
        volume0 = V[group] * size / A[group] / ratio
        gone_rows = np.unique(gone)
        material = np.zeros(n, dtype=points.material.dtype)
        material[at] = points.material[old]
        body = np.zeros(n, dtype=np.int64)
        body[at] = work.body[old]
        moved = mean(points.x - centroids(points.origin))
        d = points.F.shape[1]
        F = ratio[:, None, None] ** (1 / d) * np.eye(d)
        data = {}
        log = _log(self._elastic(points, gone_rows))
        logs = np.zeros((len(points), 3, 3))
        logs[gone_rows] = log
        across = np.exp(mean(np.log(points.data[ACROSS]))) if ACROSS in points.data else None
        data["plastic"] = _pulled(F, across, _exp(mean(logs)))
        for name, values in points.data.items():
            if name in touched:
                data[name] = work.on_faces(values, corners, parent, group, points)
            elif name == ACROSS:
                data[name] = across
            elif name not in (PARENT, AREA, ENDS, "plastic"):
                data[name] = mean(values)
        data |= {PARENT: parent, AREA: area, ENDS: ends}
        used = points.id[points.id >= self._starts[-1]]
        number = (used.max(initial=self._starts[-1] - 1) - self._starts[-1]) // len(self._bodies) + 1
        made = MaterialPoints(
            id=self._starts[-1] + body + len(self._bodies) * (number + np.arange(n)),
            corners=corners,
            F=F,
            volume0=volume0,
            material=material,
            pressure=mean(points.pressure),
            x=x,
            origin=corners - moved[:, None],
            reference=x[:, None] + (corners - x[:, None]) / ratio[:, None, None] ** 0.5,
            data=data,
        )
        kept = np.ones(len(points), dtype=bool)
        kept[gone_rows] = False
        stay = with_faces(points).map(lambda rows: rows[kept])
        return stay.joined(made), len(gone_rows)

    def _elastic(self, points: MaterialPoints, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the elastic left Cauchy-Green tensors (m, 3, 3) of some points."""
        F = np.tile(np.eye(3), (len(rows), 1, 1))
        seen = points.F_of_laws[rows]
        F[:, : seen.shape[1], : seen.shape[1]] = seen
        return F @ points.data["plastic"][rows] @ F.swapaxes(1, 2)


def _log(b: NDArray[np.float64]) -> NDArray[np.float64]:
    value, axes = np.linalg.eigh(b)
    return (axes * np.log(value)[:, None]) @ axes.swapaxes(1, 2)


def _exp(e: NDArray[np.float64]) -> NDArray[np.float64]:
    value, axes = np.linalg.eigh(e)
    return (axes * np.exp(value)[:, None]) @ axes.swapaxes(1, 2)


def _pulled(F: NDArray[np.float64], across: NDArray[np.float64] | None, b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return C_p^-1 (n, 3, 3) of elastic left Cauchy-Green tensors b (n, 3, 3) at F."""
    whole = np.tile(np.eye(3), (len(F), 1, 1))
    seen = F if across is None else in_space(F, across)
    whole[:, : seen.shape[1], : seen.shape[1]] = seen
    back = np.linalg.inv(whole)
    return back @ b @ back.swapaxes(1, 2)


class _Work:
    """What is renewed in one reset.

    Parameters
    ----------
    grid, points, body
        Grid, points, and the body of each (n,).
    flowed, needs
        Which points (n,) may be renewed, and whose domains should.
    """

    def __init__(
        self,
        grid: Grid,
        points: MaterialPoints,
        body: NDArray[np.int64],
        flowed: NDArray[np.bool_],
        needs: NDArray[np.bool_],
    ):
        self.grid = grid
        self.points = points
        self.body = body
        self.flowed = flowed
        self._needs = needs
        self.pieces = cut(grid, points.corners)
        self.cell = self.pieces.cell + (grid.copy(points.id)[self.pieces.point] if grid.copies > 1 else 0)
        self.cells = grid.cells * grid.copies

    def _at(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which points (n,) have a piece in some cells."""
        out = np.zeros(len(self.points), dtype=bool)
        out[self.pieces.point[cells[self.cell]]] = True
        return out

    def classify(self, faces: OuterFaces, signs: tuple[NDArray, NDArray]) -> None:
        """Find the cells that are renewed, and what the surface makes of them."""
        of, cell = self.pieces.point, self.cell
        body = self.body[of]
        low, high = np.full(self.cells, np.iinfo(np.int64).max), np.full(self.cells, -1)
        np.minimum.at(low, cell, body)
        np.maximum.at(high, cell, body)
        barred = low != high
        barred[cell[~self.flowed[of]]] = True
        self.faces = faces
        self.parts = parts = self._parts(faces)
        sign = signs[1][np.searchsorted(signs[0], faces.key[parts.row])]
        inner = parts.side == NONE
        barred[parts.cell[sign == NONE]] = True
        for rows, place, count in (
            (inner, parts.cell, self.cells),
            (~inner, 4 * parts.cell + np.maximum(parts.side, 0), 4 * self.cells),
        ):
            least, most = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
            np.minimum.at(least, place[rows], sign[rows])
            np.maximum.at(most, place[rows], sign[rows])
            barred[np.flatnonzero((most > least) & (most >= 0)) // (count // self.cells)] = True
        self._chains(inner, barred)
        area = sum_by(cell, self.pieces.fraction * np.abs(volumes(self.points.corners))[of], self.cells)
        region = self.grid.cell_volume * np.where(self.passed, self.region.area_of(self.cells), 1.0)
        barred |= np.abs(area - region) > COVERED * self.grid.cell_volume
        chosen = np.zeros(self.cells, dtype=bool)
        chosen[cell[(self.flowed & self._needs)[of]]] = True
        chosen &= ~barred
        small = self.pieces.fraction * np.abs(volumes(self.points.corners))[of] < SMALL * self.grid.cell_volume
        more = chosen
        while more.any():
            more = np.zeros(self.cells, dtype=bool)
            more[cell[self._at(chosen)[of] & small & ~(barred | chosen)[cell]]] = True
            chosen |= more
        self.chosen = chosen
        self.gone = self._at(chosen)

    def _parts(self, faces: OuterFaces) -> Parts:
        """Return the parts of the surface in cells."""
        grid = self.grid
        corners = self.points.corners[faces.point]
        n = np.arange(len(faces.face))
        ends = np.stack([corners[n, START[faces.face]], corners[n, END[faces.face]]])
        y = (ends - grid.low) / grid.h
        nearest = np.rint(y)
        y = np.where(np.abs(y - nearest) < grid.snap, nearest, y)
        t = np.broadcast_to(np.array([0.0, 1.0])[:, None, None], (2, len(n), 1))
        s, row = np.concatenate([y, t], axis=2).transpose(0, 2, 1), n
        for axis in range(2):
            s, row = _slice(s, row, axis)
        s = np.where((s[0, 2] <= s[1, 2])[None, None], s, s[::-1])
        way = s[1, :2] - s[0, :2]
        size = np.hypot(*way)
        some = size > NEAR
        s, way = s[:, :, some], way[:, some]
        row, size = row[some], size[some]
        outward = np.stack([way[1], -way[0]]) / size
        middle = s[:, :2].mean(axis=0)
        flat = np.abs(way) < grid.snap[:, None]
        on = flat & (np.abs(middle - np.rint(middle)) < grid.snap[:, None])
        index = np.floor(np.where(on, np.rint(middle) - (outward > 0), middle)).astype(np.int64)
        index = np.clip(index, 0, (grid.shape - 1)[:, None])
        side = np.where(on[0], np.where(outward[0] > 0, 1, 0), np.where(on[1], np.where(outward[1] > 0, 3, 2), NONE))
        number = grid.number(index.T)
        if grid.copies > 1:
            number = number + grid.copy(self.points.id)[faces.point[row]]
        return Parts(row, number, (s[:, :2] - index).transpose(2, 0, 1), s[:, 2].T, side)

    def _chains(self, inner: NDArray[np.bool_], barred: NDArray[np.bool_]) -> None:
        """Find what the surface leaves of cells that it passes through once; bar the others that it is in."""
        parts = self.parts
        cell, x = parts.cell[inner], parts.x[inner]
        self.passed = np.zeros(self.cells, dtype=bool)
        self.passed[cell] = True
        on = (np.minimum(x, 1 - x) < NEAR).any(axis=2)
        starts, ends = (np.flatnonzero(on[:, k]) for k in (0, 1))
        once = self.passed.copy()
        way = np.stack([sum_by(cell, column, self.cells) for column in (x[:, 1] - x[:, 0]).T], axis=1)
        P, Q = np.zeros((self.cells, 2)), np.zeros((self.cells, 2))
        for at, k, place in ((starts, 0, P), (ends, 1, Q)):
            once &= np.bincount(cell[at], minlength=self.cells) == 1
            place[cell[at]] = x[at, k]
        once &= np.abs(Q - P - way).max(axis=1) < APART
        once &= np.linalg.norm(Q - P, axis=1) > APART
        a, b = x[:, 0] - P[cell], x[:, 1] - P[cell]
        bulge = sum_by(cell, (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2, self.cells)
        along = np.einsum("mi,mi->m", a + b, (Q - P)[cell])
        order = np.lexsort((along, cell))
        order = order[once[cell[order]]]
        cell, x = cell[order], x[order]
        apart = (np.abs(x[1:, 0] - x[:-1, 1]).max(axis=1) > APART) & (cell[1:] == cell[:-1])
        once[cell[1:][apart]] = False
        barred |= self.passed & ~once
        kept = once[cell]
        cell, x = cell[kept], x[kept]
        at = np.flatnonzero(once)
        surface = _resampled(np.searchsorted(at, cell), x, P[at], Q[at], bulge[at])
        self.region = region = _Region(at, surface)
        barred[at[~region.sound]] = True

    # ---- new domains ----------------------------------------------------------------------------

    def _group(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of each renewed cell among these."""
        number = np.cumsum(self.chosen) - 1
        return number[cells]

    def _place(self, cells: NDArray[np.int64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places (n, k, 2), m, of places y (n, k, 2) in cells (n,), from 0 to 1."""
        index = np.stack(np.unravel_index(cells % self.grid.cells, tuple(self.grid.shape)), axis=1)
        return self.grid.low + self.grid.h * (index[:, None] + y)

    def full(self) -> New:
        """Return the new domains of full cells."""
        cells = np.flatnonzero(self.chosen & ~self.passed)
        bits = corner_bits(2)
        y = (bits[:, None] + bits[None]) / 2  # (4 domains, 4 corners, 2)
        of = np.repeat(cells, 4)
        local = np.tile(y, (len(cells), 1, 1))
        return self._beside(of, local, *_no_faces(len(of)))

    def partial(self) -> list[New]:
        """Return the new domains of cells that the surface passes through."""
        out = []
        inner = np.flatnonzero(self.parts.side == NONE)
        parts = Parts(*(column[inner] for column in self.parts))
        order = np.argsort(parts.cell, kind="stable")
        whole = sum_by(parts.cell, self.faces.area[parts.row] * np.ptp(parts.t, axis=1), self.cells)
        for rows, local, surface in self.region.quadrilaterals(self.chosen):
            cells = self.region.cells[rows]
            parent, area, ends = _no_faces(len(cells))
            at, face = np.nonzero(surface)
            lower, upper = (local[at, FACES[2][face, k]] for k in (0, 1))
            key, X = self._nearest(parts, order, cells[at], lower, upper)
            parent[at, face], ends[at, face] = key, X
            edge = np.linalg.norm(upper - lower, axis=1)
            total = sum_by(cells[at], edge, self.cells)  # of both edges that it becomes
            area[at, face] = edge / total[cells[at]] * whole[cells[at]]
            out.append(self._beside(cells, local, parent, area, ends))
        return out

    def _nearest(
        self,
        parts: Parts,
        order: NDArray[np.int64],
        cells: NDArray[np.int64],
        lower: NDArray[np.float64],
        upper: NDArray[np.float64],
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return of edges in cells (m,) the key (m,) of the part of the surface nearest to their middles, and the
        reference positions (m, 2, 2), m, of their ends, by the parts nearest to these.
        """
        first = np.searchsorted(parts.cell[order], cells, side="left")
        stop = np.searchsorted(parts.cell[order], cells, side="right")
        edge = np.repeat(np.arange(len(cells)), stop - first)
        part = order[
            np.arange(len(edge)) - np.repeat(np.cumsum(stop - first) - (stop - first), stop - first) + first[edge]
        ]
        a, way = parts.x[part, 0], parts.x[part, 1] - parts.x[part, 0]
        found = []
        for place in ((lower + upper) / 2, lower, upper):
            share = np.einsum("ri,ri->r", place[edge] - a, way) / np.maximum((way**2).sum(axis=1), TINY)
            share = np.clip(share, 0.0, 1.0)
            far = np.linalg.norm(a + share[:, None] * way - place[edge], axis=1)
            best = np.lexsort((far, edge))
            best = best[np.searchsorted(edge[best], np.arange(len(cells)))]
            t0, t1 = parts.t[part[best]].T
            found.append((parts.row[part[best]], t0 + share[best] * (t1 - t0)))
        key = self.faces.key[found[0][0]]
        return key, np.stack([self._seeded_at(*one) for one in found[1:]], axis=1)

    def _seeded_at(self, row: NDArray[np.int64], t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reference positions (m, 2), m, of places t (m,) on faces, from 0 at their start to 1."""
        face = self.faces.face[row]
        turned = START[face] != FACES[2][face, 0]
        share = np.where(turned, 1 - t, t)[:, None]
        low, high = self.faces.ends[row].transpose(1, 0, 2)
        return low + share * (high - low)

    def _beside(
        self,
        cells: NDArray[np.int64],
        local: NDArray[np.float64],
        parent: NDArray[np.int64],
        area: NDArray[np.float64],
        ends: NDArray[np.float64],
    ) -> New:
        """Return new domains of cells (n,), with faces where sides of their cells are the surface."""
        parts = self.parts
        on = np.flatnonzero(parts.side != NONE)
        place = 4 * parts.cell[on] + parts.side[on]
        order = np.argsort(place, kind="stable")
        bordered = Parts(parts.row[on], place, parts.x[on], parts.t[on], parts.side[on])
        length = np.linalg.norm(bordered.x[:, 1] - bordered.x[:, 0], axis=1)
        seeded = self.faces.area[bordered.row] * np.ptp(bordered.t, axis=1)
        known = np.unique(place)
        for side in range(4):
            axis, end = divmod(side, 2)
            for face in range(4):
                a, b = (local[:, k] for k in FACES[2][face])
                flat = (np.abs(a[:, axis] - end) < NEAR) & (np.abs(b[:, axis] - end) < NEAR)
                flat &= np.linalg.norm(b - a, axis=1) > NEAR
                at = np.flatnonzero(flat & np.isin(4 * cells + side, known))
                if not len(at):
                    continue
                here = 4 * cells[at] + side
                key, X = self._nearest(bordered, order, here, a[at], b[at])
                # the parts may end within the side
                middle = (a[at, 1 - axis] + b[at, 1 - axis]) / 2
                low, high = np.full(4 * self.cells, np.inf), np.full(4 * self.cells, -np.inf)
                np.minimum.at(low, place, bordered.x[:, :, 1 - axis].min(axis=1))
                np.maximum.at(high, place, bordered.x[:, :, 1 - axis].max(axis=1))
                covered = (middle > low[here]) & (middle < high[here])
                dense = sum_by(place, seeded, 4 * self.cells) / np.maximum(sum_by(place, length, 4 * self.cells), TINY)
                at, here = at[covered], here[covered]
                key, X = key[covered], X[covered]
                parent[at, face], ends[at, face] = key, X
                area[at, face] = np.linalg.norm(b[at] - a[at], axis=1) * dense[here]
        return New(self._place(cells, local), self._group(cells), parent, area, ends)

    def rest(self) -> New:
        """Return what domains that are gone leave beyond the renewed cells: each piece a group."""
        pieces, points = self.pieces, self.points
        left = np.flatnonzero(self.gone[pieces.point] & ~self.chosen[self.cell])
        area = pieces.fraction[left] * np.abs(volumes(points.corners[pieces.point[left]]))
        left = left[area > CRUMB * self.grid.cell_volume]
        rings, of = _convex(points.corners[pieces.point[left]])
        rings, of = rings.of(np.repeat(np.arange(len(of)), 4)), np.repeat(of, 4)
        halves = np.tile((_BOX + corner_bits(2)[:, None]) / 2, (len(of) // 4, 1, 1))
        polygons = rings.within(self._place(self.cell[left][of], halves)).simplified(NEAR * self.grid.h.min())
        row, quads, edge = polygons.quadrilaterals()
        piece = left[of[row]]
        sound = Polygons.rings(quads).area > CRUMB**2 * self.grid.cell_volume
        piece, quads = piece[sound], quads[sound]
        edge = edge[sound]
        self.left, number = np.unique(piece, return_inverse=True)
        corners = np.empty_like(quads)
        corners[:, RING] = quads
        parent, area, ends = _no_faces(len(quads))
        faces = self.faces
        index = np.full((len(points), 4), NONE)
        index[faces.point, faces.face] = np.arange(len(faces.face))
        for k in range(4):
            at = np.flatnonzero(edge[:, k] != NONE)
            row = index[pieces.point[piece[at]], edge[at, k]]
            at, row = at[row != NONE], row[row != NONE]
            face = SIDE[k]
            old = points.corners[faces.point[row]]
            low, high = (old[np.arange(len(row)), FACES[2][faces.face[row], e]] for e in (0, 1))
            way = high - low
            t = [
                np.einsum("ri,ri->r", corners[at, c] - low, way) / np.maximum((way**2).sum(axis=1), TINY)
                for c in FACES[2][face]
            ]
            parent[at, face] = faces.key[row]
            area[at, face] = faces.area[row] * np.abs(t[1] - t[0])
            X0, X1 = faces.ends[row].transpose(1, 0, 2)
            ends[at, face] = np.stack([X0 + s[:, None] * (X1 - X0) for s in t], axis=1)
        return New(corners, int(self.chosen.sum()) + number.ravel(), parent, area, ends)

    # ---- what they get --------------------------------------------------------------------------

    def rise(self, values: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the slopes (n, 2, k) of values (points, k) in the cells of new domains, fitted to what lies there."""
        pieces, h = self.pieces, self.grid.h
        weight = pieces.fraction * self.points.volume0[pieces.point]
        whole = np.maximum(sum_by(self.cell, weight, self.cells), TINY)

        def means(columns: NDArray) -> NDArray:
            return np.stack([sum_by(self.cell, weight * c, self.cells) / whole for c in columns.T], axis=1)

        y, q = self.points.x[pieces.point] / h, values[pieces.point]
        y = y - means(y)[self.cell]
        q = q - means(q)[self.cell]
        normal = means((y[:, :, None] * y[:, None]).reshape(-1, 4)).reshape(-1, 2, 2)
        right = means((y[:, :, None] * q[:, None]).reshape(len(y), -1)).reshape(-1, 2, q.shape[1])
        value, axes = np.linalg.eigh(normal)
        some = value > SAME  # cells squared: along a row of places nothing is known across it
        back = np.where(some, 1 / np.where(some, value, 1.0), 0.0)
        slope = (axes * back[:, None]) @ axes.swapaxes(1, 2) @ right / h[:, None]
        return slope[np.concatenate([np.flatnonzero(self.chosen), self.cell[self.left]])[group]]

    def pairs(
        self, corners: NDArray[np.float64], group: NDArray[np.int64]
    ) -> tuple[NDArray, NDArray, NDArray, tuple[NDArray, NDArray, NDArray]]:
        """Return pairs of old and new domains: both, and the share of the old one's mass in the new one.

        Last, of pieces of old domains: the domain, the group that they go to, and their share of it.
        """
        pieces = self.pieces
        into = np.flatnonzero(self.chosen[self.cell] & self.gone[pieces.point])
        piece = np.concatenate([into, self.left])
        groups = np.concatenate([self._group(self.cell[into]), int(self.chosen.sum()) + np.arange(len(self.left))])
        share = pieces.fraction[piece]
        whole = sum_by(pieces.point[piece], share, len(self.points))
        share = share / whole[pieces.point[piece]]  # of slivers that are dropped
        order = np.argsort(group, kind="stable")
        first, stop = (np.searchsorted(group[order], groups, side=side) for side in ("left", "right"))
        count = stop - first
        of = np.repeat(np.arange(len(piece)), count)
        at = order[np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count) + first[of]]
        old = pieces.point[piece[of]]
        common = np.zeros(len(of))
        rings, which = _convex(self.points.corners[old])
        common += np.maximum(sum_by(which, rings.within(corners[at][which][:, RING]).area, len(of)), 0.0)
        common += EPSILON * np.abs(volumes(corners[at]))  # what no piece lies on gets the mean of its cell
        total = sum_by(of, common, len(piece))
        gone = pieces.point[piece]
        return old, at, share[of] * common / total[of], (gone, groups, share)

    def on_faces(
        self,
        values: NDArray[np.float64],
        corners: NDArray[np.float64],
        parent: NDArray[np.int64],
        group: NDArray[np.int64],
        points: MaterialPoints,
    ) -> NDArray[np.float64]:
        """Return what new domains (n, ...) keep on their faces: means of what the surface in their cell had."""
        parts = self.parts
        inside = np.flatnonzero(self.chosen[parts.cell])
        cell, of = parts.cell[inside], self.faces.point[parts.row[inside]]
        length = np.linalg.norm((parts.x[inside, 1] - parts.x[inside, 0]) * self.grid.h, axis=1)
        flat = values[of].reshape(len(of), int(np.prod(values.shape[1:])))
        count = int(self.chosen.sum())
        number = self._group(cell)
        whole = np.maximum(sum_by(number, length, count), TINY)
        means = np.stack([sum_by(number, length * column, count) / whole for column in flat.T], axis=1)
        pieces = values[self.pieces.point[self.left]].reshape(len(self.left), flat.shape[1])
        out = np.concatenate([means, pieces])[group] * (parent != NONE).any(axis=1)[:, None]
        return out.reshape(len(corners), *values.shape[1:])


def _no_faces(n: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return keys, lengths and ends of faces of n domains that have none on the surface."""
    return np.full((n, 4), NONE), np.zeros((n, 4)), np.zeros((n, 4, 2, 2))


def _convex(corners: NDArray[np.float64]) -> tuple[Polygons, NDArray[np.int64]]:
    """Return domains (n, 4, 2) as convex polygons, whose edges have the numbers of faces, and the domain of each."""
    ring = corners[:, RING]
    edge = np.tile(SIDE, (len(ring), 1))
    away = np.roll(ring, -1, axis=1) - ring
    before = np.roll(away, 1, axis=1)
    turn = before[:, :, 0] * away[:, :, 1] - before[:, :, 1] * away[:, :, 0]
    bent = turn.min(axis=1) < 0
    even = np.flatnonzero(~bent)
    out, of = [(ring[even], edge[even])], [even]
    at = np.flatnonzero(bent)
    if len(at):
        halves = [[(0, 1, 2, 2), (0, 2, 3, 3)], [(1, 2, 3, 3), (1, 3, 0, 0)]]
        kept = [[(0, 1, NONE, NONE), (NONE, 2, NONE, 3)], [(1, 2, NONE, NONE), (NONE, 3, NONE, 0)]]
        areas = np.array([[Polygons.rings(ring[at][:, list(half)]).area for half in two] for two in halves])
        best = areas.min(axis=1).argmax(axis=0)
        for way in (0, 1):
            for half, numbers in zip(halves[way], kept[way], strict=True):
                rows = at[best == way]
                rows = rows[Polygons.rings(ring[rows][:, list(half)]).area > 0]
                number = np.array([SIDE[k] if k != NONE else NONE for k in numbers])
                out.append((ring[rows][:, list(half)], np.tile(number, (len(rows), 1))))
                of.append(rows)
    x, edge = (np.concatenate(column) for column in zip(*out, strict=True))
    return Polygons.rings(x, edge), np.concatenate(of)


_BOX = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])
_HALVES = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]]) / 2
MOST = EDGES + 10  # vertices of what a cell holds: of the surface, of halves of its sides, and one more


class _Region:
    """What the bodies fill of cells (n,) that the surface passes through once, in coordinates from 0 to 1.

    Parameters
    ----------
    cells
        The cells.
    surface : (n, EDGES + 1, 2)
        Vertices of the surface in them, from where it enters to where it leaves, with the body on its left.
    """

    def __init__(self, cells: NDArray[np.int64], surface: NDArray[np.float64]):
        self.cells = cells
        start, end = (2 * _around(surface[:, k]) for k in (-1, 0))  # in halves of a side
        end = np.where(end <= start + NEAR, end + 8, end)
        first = np.floor(start + NEAR).astype(np.int64) + 1
        count = np.maximum(0, np.ceil(end - NEAR).astype(np.int64) - first)
        x = np.zeros((len(cells), MOST, 2))
        x[:, : EDGES + 1] = surface
        for k in range(8):
            has = count > k
            x[has, EDGES + 1 + k] = _HALVES[(first[has] + k) % 8]
        size = EDGES + 1 + count
        odd = np.flatnonzero(size % 2)
        after = np.where((np.arange(MOST) < size[:, None] - 1)[:, :, None], np.roll(x, -1, axis=1), x[:, :1])
        after = np.where((np.arange(MOST) < size[:, None])[:, :, None], after, x)
        length = np.linalg.norm(after - x, axis=2)[odd]
        length[:, :EDGES] = 0.0  # not of the surface
        at = length.argmax(axis=1)
        place = np.arange(MOST)[None]
        middle = (x[odd, at] + after[odd, at]) / 2
        grown = np.take_along_axis(x[odd], np.where(place <= at[:, None], place, place - 1)[:, :, None], axis=1)
        grown[np.arange(len(odd)), at + 1] = middle
        x[odd] = grown
        self._size = size + size % 2
        last = np.take_along_axis(x, (self._size - 1)[:, None, None], axis=1)
        x = np.where((np.arange(MOST) < self._size[:, None])[:, :, None], x, last)
        self._x = x
        ring = Polygons(x, self._size, np.full(x.shape[:2], NONE))
        self.area = ring.area
        self._middle = ring.centroid
        after = np.where((np.arange(MOST) == self._size[:, None] - 1)[:, :, None], x[:, :1], np.roll(x, -1, axis=1))
        a, b = x - self._middle[:, None], after - self._middle[:, None]
        sees = a[:, :, 0] * b[:, :, 1] - a[:, :, 1] * b[:, :, 0]
        sees = np.where(np.arange(MOST) < self._size[:, None], sees, 1.0)
        self.sound = (sees.min(axis=1) > 0) & (self.area > APART**2)

    def area_of(self, count: int) -> NDArray[np.float64]:
        """Return the areas of so many cells, from 0 to 1; of those without a region 1."""
        out = np.ones(count)
        out[self.cells] = self.area
        return out

    def quadrilaterals(
        self, chosen: NDArray[np.bool_]
    ) -> list[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]]:
        """Return rows (m,) of this, corners (m, 4, 2) of the domains there, and which faces (m, 4) are the surface."""
        out = []
        rows = np.flatnonzero(chosen[self.cells])
        corners, of = [np.zeros((0, 4, 2))], [rows[:0]]
        surface = [np.zeros((0, 4), dtype=bool)]
        for k in range(0, MOST, 2):
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
        out.append((np.concatenate(of), np.concatenate(corners), np.concatenate(surface)))
        return out


def _resampled(
    of: NDArray[np.int64], x: NDArray[np.float64], P: NDArray[np.float64], Q: NDArray[np.float64], bulge: NDArray
) -> NDArray[np.float64]:
    """Return vertices (n, EDGES + 1, 2) of surfaces from P to Q (n, 2), evenly along their parts.

    Their area beyond the chords, bulge (n,), stays what it is: vertices are shifted by what they would lose.

    of, x : (m,), (m, 2, 2): surface of each part, one after the other, and its ends.
    """
    length = np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
    gone = np.concatenate([[0.0], np.cumsum(length)])
    first, stop = (np.searchsorted(of, np.arange(len(P)), side=side) for side in ("left", "right"))
    ends = gone[first], gone[stop]
    out = np.concatenate([P[:, None], np.zeros((len(P), EDGES - 1, 2)), Q[:, None]], axis=1)
    at = np.zeros((len(P), EDGES + 1))
    at[:, 0], at[:, -1] = ends

    def divide(low: int, high: int) -> None:
        """Put a vertex between two: at the sharpest corner, or in the middle of what is nearly straight."""
        middle = (low + high) // 2
        a, chord = out[:, low], out[:, high] - out[:, low]
        off = x[:, 0] - a[of]
        far = np.abs(chord[of, 0] * off[:, 1] - chord[of, 1] * off[:, 0])
        far /= np.maximum(np.linalg.norm(chord, axis=1), TINY)[of]
        within = (gone[:-1] > at[of, low]) & (gone[:-1] < at[of, high])
        far = np.where(within, far, 0.0)
        order = np.lexsort((far, of))
        corner = order[stop - 1]
        aim = (at[:, low] + at[:, high]) / 2
        aim = np.where(far[corner] > BENT, gone[corner], aim)
        part = np.clip(np.searchsorted(gone, aim, side="right") - 1, first, stop - 1)
        t = (aim - gone[part]) / np.maximum(length[part], TINY)
        at[:, middle] = aim
        out[:, middle] = x[part, 0] + t[:, None] * (x[part, 1] - x[part, 0])

    step = EDGES
    while step > 1:
        for low in range(0, EDGES, step):
            divide(low, low + step)
        step //= 2
    y = out - P[:, None]
    has = (y[:, :-1, 0] * y[:, 1:, 1] - y[:, :-1, 1] * y[:, 1:, 0]).sum(axis=1) / 2
    way = out[:, 2:] - out[:, :-2]
    normal = np.stack([way[:, :, 1], -way[:, :, 0]], axis=2)
    size = np.maximum(np.linalg.norm(way, axis=2), TINY)
    shift = 2 * (bulge - has) / size.sum(axis=1)
    out[:, 1:-1] += shift[:, None, None] * normal / size[:, :, None]
    return np.clip(out, 0.0, 1.0)


def _around(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where places (n, 2) on the border of the unit square lie, anti-clockwise, from 0 to 4."""
    near = np.stack([x[:, 1], 1 - x[:, 0], 1 - x[:, 1], x[:, 0]], axis=1)
    side = near.argmin(axis=1)
    along = np.stack([x[:, 0], 1 + x[:, 1], 3 - x[:, 0], 4 - x[:, 1]], axis=1)
    return along[np.arange(len(x)), side] % 4
