# SPDX-License-Identifier: MIT
"""Division and merging of elastic particle domains where grid cells become finer or coarser.

Here, all lengths are divided by the cell size. A domain is bisected along a local axis if each half is at least as long
as the domain was at seeding. Two halves merge if the merged domain is at most as long as a domain at seeding. Inside a
body from `box`, neighbouring seeded domains may merge too. Domains are never divided or merged if they have yielded,
contain probes, or have a side with prescribed displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.domains.divided_domains import SeededDomains, halved, joined, with_defect
from mpm_dolfinx.domains.pressure_transport import halved_pieces, joined_pieces
from mpm_dolfinx.domains.renewed_faces import SeededFaces, faces_of_parts, is_part, roots, with_parts
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.state import State


class Division:
    """Division and merging of the particle domains in a scene."""

    def __init__(self, faces: SeededFaces, materials: SceneMaterials):
        self._grid = materials.grid
        self._materials = materials
        self._domains = SeededDomains(faces.bodies)

    def divided(self, state: State) -> tuple[State, int]:
        """Return the state with divided and merged domains, and the number of replaced domains.

        All processes must call this method.
        """
        now, seeded = self._domains.sizes(self._grid, state.points)
        some = _divides(now, seeded).any() or _merges(now, seeded).any()
        if not self._grid.comm.allreduce(int(some and state.stay is None)):
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

    def _free(self, state: State) -> NDArray[np.bool_]:
        """Return a mask of elastic points that may be divided or merged."""
        points, stage = state.points, state.stage
        free = ~self._materials.evolved(points) & (is_part(points) | (points.id < self._domains.starts[-1]))
        if state.watched is not None:
            free &= ~np.isin(points.id, state.watched)
        triangles = [faces.id[(faces.xi[:, -1] == faces.xi[:, -2]).all(axis=1)] for faces in stage.faces]
        fixed = np.concatenate([*(faces.id for faces in stage.lasting), *triangles, np.empty(0, dtype=np.int64)])
        return free & ~np.isin(roots(points)[0], fixed)

    @cached_property
    def _outer(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ids of seeded domains with faces on the surfaces of bodies, and the indices of these faces."""
        found = [body.outer() for body in self._domains.bodies]
        ids = [start + row for start, (row, _) in zip(self._domains.starts, found, strict=False)]
        return np.concatenate(ids), np.concatenate([face for _, face in found])

    def _outside(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask of points with a face on the surface of the seeded body."""
        ids, faces = self._outer
        out = np.isin(points.id, ids)
        out[faces_of_parts(points, ids, faces)[1]] = True
        return out

    def _replaced(
        self, state: State, old: MaterialPoints, new: MaterialPoints, into: NDArray[np.int64], rule: Callable
    ) -> tuple[State, int]:
        """Return the state in which new points replace old points, and the number of old points on all processes."""
        new, ids = with_defect(new, old, into), old.id
        pieces = state.pieces
        if pieces is not None:
            storage = tuple(map(self._materials.storage, (old, new)))
            made = rule(pieces.of(ids), (old, new), into, storage, self._materials.fluid.bulk)
            pieces = pieces.of(ids, kept=False).joined(made)
        points = state.points.of(ids, kept=False).joined(new)
        return replace(state, points=points, pieces=pieces), self._grid.comm.allreduce(len(ids))

    # ---- division -------------------------------------------------------------------------------

    def _halved(self, state: State, axis: int) -> tuple[State, int]:
        now, seeded = self._domains.sizes(self._grid, state.points)
        wants = _divides(now, seeded)[:, axis]
        if self._grid.comm.allreduce(int(wants.any())):
            wants &= self._free(state)
            part = roots(state.points)[1].copy()
            part[:, axis, 1] = part[:, axis].mean(axis=1)
            wants &= self._domains.known(part)
        if not self._grid.comm.allreduce(int(wants.any())):
            return state, 0
        state = replace(state, points=with_parts(state.points), trend=None)
        old = state.points.map(lambda rows: rows[wants])
        new = halved(old, axis, self._domains, self._grid.axisymmetric)
        inside = ~self._outside(new)
        kept = {name: new.data[name].copy() for name in state.stage.kept(0) if name in new.data}
        for rows in kept.values():  # histories of conditions on the surface
            rows[inside] = 0.0
        new = replace(new, data={**new.data, **kept})
        return self._replaced(state, old, new, np.tile(np.arange(len(old)), 2), halved_pieces)

    # ---- merging --------------------------------------------------------------------------------

    def _merging(self, state: State, axis: int) -> NDArray[np.bool_]:
        """Return a mask of halves that are short enough along a local axis to merge."""
        now, seeded = self._domains.sizes(self._grid, state.points)
        wants = _merges(now, seeded)[:, axis]
        if self._grid.comm.allreduce(int(wants.any())):
            wants &= self._free(state)
            inside = np.ptp(roots(state.points)[1], axis=2)[:, axis] < 1
            wants &= inside | ~self._outside(state.points)
        return wants

    def _intervals(self, points: MaterialPoints, axis: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return numbers (n, k) that identify pairs of halves, and whether each domain is the upper half of its pair.

        The two halves of a divided domain have identical rows. The rows of all other domains contain nan.
        """
        root, part = roots(points)
        place, size = self._domains.places(root), np.ptp(part, axis=2)
        lower = place[:, 1:] + part[..., 0]
        outside = size[:, axis] >= 1
        lower[outside, axis] = self._domains.from_middle(place[outside], axis)
        lower /= size
        pair = np.floor(lower[:, axis] / 2)
        upper = lower[:, axis] != 2 * pair
        lower[:, axis] = pair
        return np.concatenate([place[:, :1], lower, size], axis=1), upper

    def _joined(self, state: State, axis: int) -> tuple[State, int]:
        comm = self._grid.comm
        wants = self._merging(state, axis)
        if not comm.allreduce(int(wants.any())):
            return state, 0
        if comm.size > 1:  # both halves move to one process
            rank = np.full(len(wants), comm.rank, dtype=np.int32)
            key = self._intervals(state.points.map(lambda rows: rows[wants]), axis)[0]
            rank[wants] = np.rint(np.abs(np.nan_to_num(key).sum(axis=1))).astype(np.int64) % comm.size
            state = state.migrated(rank, comm)
            wants = self._merging(state, axis)
        at = wants.nonzero()[0]
        key, upper = self._intervals(state.points.map(lambda rows: rows[at]), axis)
        order = np.lexsort([upper, *key.T])
        first, other = order[:-1], order[1:]
        soil = self._materials.soil_rows(state.points)[at]
        pair = (key[first] == key[other]).all(axis=1) & (soil[first] == soil[other]).all(axis=1)
        first, other = at[first[pair]], at[other[pair]]
        if not comm.allreduce(len(first)):
            return state, 0
        state = replace(state, points=with_parts(state.points), trend=None)
        points = state.points
        halves = [points.map(lambda rows, at=at: rows[at]) for at in (first, other)]
        new = joined(*halves, axis, self._domains, self._grid.axisymmetric)
        lower, upper = map(self._outside, halves)
        kept = {name: new.data[name].copy() for name in state.stage.kept(0) if name in new.data}
        for name, rows in kept.items():  # histories of conditions on the surface
            for half, only in zip(halves, (lower & ~upper, upper & ~lower), strict=True):
                rows[only] = half.data[name][only]
        new = replace(new, data={**new.data, **kept})
        old = points.map(lambda rows: rows[np.concatenate([first, other])])
        return self._replaced(state, old, new, np.tile(np.arange(len(new)), 2), joined_pieces)


def _divides(now: NDArray[np.float64], seeded: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each domain is at least twice as long as at seeding, for each axis."""
    return now >= 2 * seeded * (1 - SAME)


def _merges(now: NDArray[np.float64], seeded: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each domain is at most half as long as at seeding, for each axis."""
    return 2 * now <= seeded * (1 + SAME)
