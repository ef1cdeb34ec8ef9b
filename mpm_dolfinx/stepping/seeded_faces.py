# SPDX-License-Identifier: MIT
"""Outer faces of the bodies in 2D: as seeded, and of the domains that represent them after a renewal or division."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.domains.refilled_cells import OuterFaces, ring_lengths
from mpm_dolfinx.domains.renewed_faces import AREA, ENDS, PARENT, keys
from mpm_dolfinx.grid.grid import FACES, Grid
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.stage import Stage


class SeededFaces:
    """Outer faces of the bodies of a scene.

    grid: background grid; bodies: all bodies of the scene.
    """

    def __init__(self, grid: Grid, bodies: Sequence[Body]):
        self._grid, self._bodies = grid, bodies

    @cached_property
    def seeded(self) -> OuterFaces:
        """All outer faces of the bodies as seeded, ordered by key."""
        found = []
        starts = np.cumsum([0, *map(len, self._bodies)])
        for start, body in zip(starts, self._bodies, strict=False):
            row, face = body.outer()
            at = FACES[2][face]
            X, x = (np.take_along_axis(of(row), at[:, :, None], axis=1) for of in (body.reference, body.corners))
            size = np.linalg.norm(x[:, 1] - x[:, 0], axis=1) * ring_lengths(self._grid, x.mean(axis=1))
            found.append((start + row, face, keys(start + row, face), size, X))
        columns = [np.concatenate(column) for column in zip(*found, strict=True)]
        order = np.argsort(columns[2])
        return OuterFaces(*(column[order] for column in columns))

    def of(self, points: MaterialPoints) -> OuterFaces:
        """Return the outer faces of the points."""
        seeded = self.seeded
        known, at = points.find(seeded.point)
        columns = [(at, *(v[known] for v in (seeded.face, seeded.key, seeded.area, seeded.ends)))]
        if PARENT in points.data:
            at, face = np.nonzero(points.data[PARENT] >= 0)
            columns.append((at, face, *(points.data[name][at, face] for name in (PARENT, AREA, ENDS))))
        return OuterFaces(*map(np.concatenate, zip(*columns, strict=True)))

    def needed(self, stage: Stage, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of points with faces whose displacement from the seeded position conditions need."""
        out = np.zeros(len(points), dtype=bool)
        surfaces = [*(faces for _, faces, _ in stage.held), *(faces for one in stage.acting for faces in one.seeded)]
        if surfaces:
            faces = self.of(points)
            out[faces.point[np.isin(faces.key, np.concatenate([keys(one.id, one.face) for one in surfaces]))]] = True
        return out

    def signatures(self, surfaces: Sequence[Surface]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return keys of outer faces, and the index of each face's set of conditions; -1 for faces that must stay."""
        key = self.seeded.key
        kind = np.zeros((len(key), len(surfaces)), dtype=np.int8)
        barred = np.zeros(len(key), dtype=bool)
        for k, faces in enumerate(surfaces):
            at = np.minimum(np.searchsorted(key, keys(faces.id, faces.face)), len(key) - 1)
            ok = key[at] == keys(faces.id, faces.face)
            whole = np.ptp(faces.xi, axis=1).max(axis=1) >= 2
            kind[at[ok & whole], k] = 1
            barred[at[ok & ~whole]] = True
        number = np.unique(kind, axis=0, return_inverse=True)[1].ravel() if len(surfaces) else np.zeros(len(key), int)
        return key, np.where(barred, -1, number)
