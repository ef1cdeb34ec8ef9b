# SPDX-License-Identifier: MIT
"""Division and merging of elastic particle domains where grid cells become finer or coarser.

A domain is bisected along a local axis if both halves then count as many cells as the domain did at seeding. Two halves
merge if the merged domain counts as many cells as at seeding. Whole domains on a lattice inside a body merge
too. Domains that yield, have probes, or are on sides whose displacement a condition needs, remain. In 3D this also
applies to domains at the surface of a body.

Corners of elastic domains determine F, so a division adds no error: both halves share the mapping of the domain. After
merging, F follows from the outer corners. Mass, fluid, and the volume that the fluid has to fill are exact. The number
of cells in the deformed state includes the stretch of the domain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import pressure_of
from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.domains.divided_domains import (
    Identifiers,
    halved,
    halved_faces,
    is_part,
    joined,
    joined_faces,
    roots,
    with_parts,
)
from mpm_dolfinx.domains.pressure_transport import PiecePressures, transport
from mpm_dolfinx.domains.renewed_faces import AREA, ENDS, PARENT, SeededFaces, with_faces
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.cutting import Pieces, edges
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.state import State


class Division:
    """Division and merging of the particle domains in a scene.

    bodies, materials: bodies and materials of the scene.
    """

    def __init__(self, bodies: Sequence[Body], materials: SceneMaterials):
        self._grid = materials.grid
        self._bodies = bodies
        self._materials = materials
        self._faces = SeededFaces(materials.grid, bodies)
        self._identifiers = Identifiers(bodies)

    def divided(self, state: State) -> tuple[State, int]:
        """Return the state with divided and merged domains, and their number; all processes must call it."""
        if state.stay is not None:
            return state, 0
        count, axes = 0, range(self._grid.dim)
        for change in (self._halved, self._joined):
            while True:
                before = count
                for axis in axes:
                    state, number = change(state, axis)
                    count += number
                if count == before:
                    break
        return state, count

    def _sizes(self, points: MaterialPoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the edge lengths (n, d) of the domains in cells: now, and of their seeded domains at seeding."""
        grid, root = self._grid, roots(points)[0]
        now = np.linalg.norm(edges(grid.in_cells(points.corners)), axis=1)
        seeded = np.full(now.shape, np.nan)  # renewed domains have no seeded size
        starts = self._identifiers.starts
        body = starts.searchsorted(root, side="right") - 1
        for i in np.unique(body[root < starts[-1]]):
            at = body == i
            x = self._bodies[i].corners(root[at] - starts[i]) - grid.base
            place = [np.interp(x[..., a], lines, np.arange(len(lines))) for a, lines in enumerate(grid.seeded)]
            seeded[at] = np.linalg.norm(edges(np.stack(place, axis=-1)), axis=1)
        return now, seeded

    def _free(self, state: State) -> NDArray[np.bool_]:
        """Return a mask (n,) of elastic points that may be divided or merged."""
        points, grid, starts = state.points, self._grid, self._identifiers.starts
        free = ~self._materials.evolved(points) & (is_part(points) | (points.id < starts[-1]))
        if state.watched is not None:
            free &= ~np.isin(points.id, state.watched)
        if grid.dim == 2:
            key, number = self._faces.signatures(state.stage.faces)
            faces = self._faces.of(points)
            free[faces.point[number[np.searchsorted(key, faces.key)] < 0]] = False
            return free & ~self._faces.needed(state.stage.lasting, points)
        return free & ~self._outside(points)

    def _outside(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of points with a face on the surface of their body as seeded."""
        out, starts = np.zeros(len(points), dtype=bool), self._identifiers.starts
        if self._grid.dim == 2:
            out[self._faces.of(points).point] = True
            return out
        body = starts.searchsorted(points.id, side="right") - 1
        for i in np.unique(body[points.id < starts[-1]]):
            at = body == i
            out[at] = self._bodies[i].sides_of(points.id[at] - starts[i]).any(axis=(1, 2))
        return out

    def _with_data(self, state: State) -> State:
        points = with_parts(state.points)
        return replace(state, points=with_faces(points) if self._grid.dim == 2 else points, trend=None)

    def _on_faces(self, points: MaterialPoints) -> tuple[NDArray, NDArray, NDArray]:
        """Return `PARENT`, `AREA` and `ENDS` (n, 4, ...) of all points, including seeded domains."""
        faces, n = self._faces.of(points), len(points)
        out = np.full((n, 4), -1), np.zeros((n, 4)), np.zeros((n, 4, 2, 2))
        for rows, of in zip(out, (faces.key, faces.area, faces.ends), strict=True):
            rows[faces.point, faces.face] = of
        return out

    # ---- division -------------------------------------------------------------------------------

    def _halved(self, state: State, axis: int) -> tuple[State, int]:
        now, seeded = self._sizes(state.points)
        wants = now[:, axis] >= 2 * seeded[:, axis] * (1 - SAME)
        if over_all(self._grid.comm, int(wants.any())):
            wants &= self._free(state)
            part = roots(state.points)[1].copy()
            part[:, axis, 1] = part[:, axis].mean(axis=1)
            wants &= self._identifiers.known(part)
        if not over_all(self._grid.comm, int(wants.any())):
            return state, 0
        state = self._with_data(state)
        ids = state.points.id[wants]
        old = state.points.of(ids)
        new = halved(old, axis, self._identifiers, self._grid.axisymmetric)
        if self._grid.dim == 2:
            on = halved_faces(self._on_faces(old), new.reference, axis, self._grid.axisymmetric)
            new = replace(new, data={**new.data, **on, **self._history(state, new, on[PARENT])})
        into = np.tile(np.arange(len(old)), 2)
        if "owed" in new.data:  # soil and fluid fill the same volume as before
            more = sum_by(into, new.volume0 * new.J, len(old)) / old.volume0 - old.J
            new = replace(new, data={**new.data, "owed": new.data["owed"] + more[into]})
        pieces = state.pieces
        if pieces is not None:
            pieces = pieces.of(ids, kept=False).joined(self._divided_pieces(pieces.of(ids), old, new, into))
        points = state.points.of(ids, kept=False).joined(new)
        return replace(state, points=points, pieces=pieces), over_all(self._grid.comm, len(ids))

    def _history(self, state: State, new: MaterialPoints, parent: NDArray[np.int64]) -> dict[str, NDArray]:
        """Return the histories of conditions at new points, which are zero without a face on the surface."""
        off = ~(parent >= 0).any(axis=1)
        names = [name for name in state.stage.kept(0) if name in new.data]
        return {name: np.where(off.reshape(-1, *[1] * (new.data[name].ndim - 1)), 0.0, new.data[name]) for name in names}

    def _divided_pieces(
        self, pieces: PiecePressures, old: MaterialPoints, new: MaterialPoints, into: NDArray[np.int64]
    ) -> PiecePressures:
        """Return one piece for each half: pressures vary linearly within a domain, with the mean slope of its pieces."""
        bulk = self._materials.fluid.bulk
        n = len(old)
        order = np.argsort(into, kind="stable")
        size = new.volume0 * new.J
        fraction = size / sum_by(into, size, n)[into]
        cell = 1 + pieces.cell.max(initial=-1) + np.arange(len(new)) // n
        parts = Pieces(into[order], cell[order], fraction[order], new.x[order], np.empty((len(new), 0, 2)))
        given = pieces.potentials(bulk)
        potential = np.empty(len(new))
        potential[order] = transport(given, old, parts)
        of = old.id.searchsorted(pieces.id)
        store, whole_store = (self._materials.storage(p) * p.volume0 * p.J for p in (new, old))
        missing = whole_store * sum_by(of, pieces.fraction * given.pressure, n) - sum_by(into, store * potential, n)
        total = sum_by(into, store, n)
        potential += np.divide(missing, total, out=np.zeros(n), where=total > 0)[into]
        pressure = pressure_of(potential, bulk)
        slope = sum_by(of, pieces.fraction * pieces.slope.T, n).T[into]
        bounds = np.stack([np.full(n, np.inf), np.full(n, -np.inf)], axis=1)
        np.minimum.at(bounds[:, 0], of, pieces.bounds[:, 0])
        np.maximum.at(bounds[:, 1], of, pieces.bounds[:, 1])
        none = np.full(len(new), -1)
        return PiecePressures(new.id, none, np.ones(len(new)), pressure, new.x, slope, bounds[into])

    # ---- merging --------------------------------------------------------------------------------

    def _merging(self, state: State, axis: int) -> NDArray[np.bool_]:
        """Return a mask (n,) of points whose domains are to be merged along a local axis, if there is another half."""
        now, seeded = self._sizes(state.points)
        wants = 2 * now[:, axis] <= seeded[:, axis] * (1 + SAME)
        if over_all(self._grid.comm, int(wants.any())):
            wants &= self._free(state)
            inside = np.ptp(roots(state.points)[1], axis=2)[:, axis] < 1
            wants &= inside | ~self._outside(state.points)
        return wants

    def _intervals(self, points: MaterialPoints, axis: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return a row (n, k) for each part that is equal for two halves, and which points are upper halves (n,).

        Domains that have no other half have rows with nan.
        """
        root, part = roots(points)
        place, size = self._identifiers.places(root), np.ptp(part, axis=2)
        lower = place[:, 1:] + part[..., 0]
        outside = size[:, axis] >= 1
        lower[outside, axis] = self._identifiers.from_middle(place[outside], axis)
        lower /= size
        pair = np.floor(lower[:, axis] / 2)
        upper = lower[:, axis] != 2 * pair
        lower[:, axis] = pair
        return np.concatenate([place[:, :1], lower, size], axis=1), upper

    def _joined(self, state: State, axis: int) -> tuple[State, int]:
        comm = self._grid.comm
        wants = self._merging(state, axis)
        if not over_all(comm, int(wants.any())):
            return state, 0
        if comm.size > 1:  # both halves move to one process
            rank = np.full(len(wants), comm.rank, dtype=np.int32)
            key = self._intervals(state.points.map(lambda rows: rows[wants]), axis)[0]
            rank[wants] = np.rint(np.abs(key.sum(axis=1))).astype(np.int64) % comm.size
            state = state.migrated(rank, comm)
            wants = self._merging(state, axis)
        at = wants.nonzero()[0]
        key, upper = self._intervals(state.points.map(lambda rows: rows[at]), axis)
        order = np.lexsort([upper, *key.T])
        first, other = order[:-1], order[1:]
        soil = self._materials.soil_rows(state.points)[at]
        pair = (key[first] == key[other]).all(axis=1) & (soil[first] == soil[other]).all(axis=1)
        first, other = at[first[pair]], at[other[pair]]
        if not over_all(comm, len(first)):
            return state, 0
        state = self._with_data(state)
        points = state.points
        halves = [points.map(lambda rows, at=at: rows[at]) for at in (first, other)]
        new = joined(*halves, axis, self._identifiers, self._grid.axisymmetric)
        if self._grid.dim == 2:
            new = replace(new, data={**new.data, **self._joined_data(state, halves, new, axis)})
        old = points.map(lambda rows: rows[np.concatenate([first, other])])
        into = np.tile(np.arange(len(new)), 2)
        if "owed" in new.data:  # soil and fluid fill the same volume as before
            less = sum_by(into, old.volume0 * old.J, len(new)) / new.volume0
            new = replace(new, data={**new.data, "owed": new.data["owed"] + new.J - less})
        pieces = state.pieces
        if pieces is not None:
            pieces = pieces.of(old.id, kept=False).joined(self._joined_pieces(pieces.of(old.id), old, new, into))
        points = points.of(old.id, kept=False).joined(new)
        return replace(state, points=points, pieces=pieces), over_all(comm, len(old))

    def _joined_data(
        self, state: State, halves: Sequence[MaterialPoints], new: MaterialPoints, axis: int
    ) -> dict[str, NDArray]:
        """Return faces, and histories of conditions on faces, of merged points in 2D."""
        on = [self._on_faces(of) for of in halves]
        whole_again = ~is_part(new)
        out = joined_faces(*on, axis)
        for name, none in ((PARENT, -1), (AREA, 0.0), (ENDS, 0.0)):
            out[name][whole_again] = none
        lower, upper = ((parent >= 0).any(axis=1) for parent, _, _ in on)
        for name in state.stage.kept(0):
            if name in new.data:
                rows = new.data[name].copy()
                rows[lower & ~upper] = halves[0].data[name][lower & ~upper]
                rows[upper & ~lower] = halves[1].data[name][upper & ~lower]
                out[name] = rows
        return out

    def _joined_pieces(
        self, pieces: PiecePressures, old: MaterialPoints, new: MaterialPoints, into: NDArray[np.int64]
    ) -> PiecePressures:
        """Return the pieces of merged points: pieces of both halves in one cell become one piece."""
        bulk, n = self._materials.fluid.bulk, len(new)
        order = np.argsort(old.id)
        of = order[np.searchsorted(old.id[order], pieces.id)]
        given = pieces.potentials(bulk)
        size = old.volume0 * old.J
        store = pieces.fraction * (self._materials.storage(old) * size)[of]
        fraction = pieces.fraction * (size / sum_by(into, size, n)[into])[of]
        key = into[of] * (2 + pieces.cell.max(initial=-1)) + 1 + pieces.cell
        _, at, piece = np.unique(key, return_index=True, return_inverse=True)
        piece = piece.ravel()

        def mean(values: NDArray, weight: NDArray) -> NDArray:
            total = sum_by(piece, weight, len(at))
            return np.divide(
                sum_by(piece, weight * values, len(at)), total, out=np.zeros(len(at)), where=total > 0
            )

        potential = mean(given.pressure, np.where(sum_by(piece, store, len(at))[piece] > 0, store, fraction))
        point, share = into[of][at], sum_by(piece, fraction, len(at))
        whole_store = self._materials.storage(new) * new.volume0 * new.J
        missing = sum_by(into[of], store * given.pressure, n) - whole_store * sum_by(point, share * potential, n)
        potential += np.divide(missing, whole_store, out=np.zeros(n), where=whole_store > 0)[point]
        bounds = np.stack([np.full(len(at), np.inf), np.full(len(at), -np.inf)], axis=1)
        np.minimum.at(bounds[:, 0], piece, pieces.bounds[:, 0])
        np.maximum.at(bounds[:, 1], piece, pieces.bounds[:, 1])
        x, slope = (np.stack([mean(c, fraction) for c in of.T], axis=1) for of in (pieces.x, pieces.slope))
        return PiecePressures(
            new.id[point], pieces.cell[at], share, pressure_of(potential, bulk), x, slope, bounds
        )
