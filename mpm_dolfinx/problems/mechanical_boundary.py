# SPDX-License-Identifier: MIT
"""What acts on the sides of the bodies in the balance of momentum, put where the sides are at the start of a step."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from dolfinx.common import Timer
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.forms.point_forms import Places, PointData
from mpm_dolfinx.parallel.exchange import Exchange, first
from mpm_dolfinx.points.cut_domains import CutDomains, Patches
from mpm_dolfinx.points.faces import Surface, face_vectors
from mpm_dolfinx.points.grid import sum_by
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.problems.conditions import HOLD, RIGIDITY, Displacement, RigidPlate, Traction
from mpm_dolfinx.problems.side_forms import SideData, SideForms
from mpm_dolfinx.problems.sides import Sides, check_apart, gathered
from mpm_dolfinx.validation import line


class MechanicalBoundary:
    """Tractions, rigid plates and given displacements of a stage.

    Parameters
    ----------
    sides
        The sides of the bodies.
    modulus
        Oedometric modulus of the stiffest material, Pa, by which plates and held sides are rigid.
    tractions, displacements, plates
        The conditions.

    Raises
    ------
    ValueError
        Naming a condition whose side no point has, a plate whose faces are not one flat side, or two given
        displacements that contradict each other on the same faces.
    """

    def __init__(
        self,
        sides: Sides,
        modulus: float,
        tractions: Sequence[Traction],
        displacements: Sequence[Displacement],
        plates: Sequence[RigidPlate],
    ):
        self.grid, self._modulus, d = sides.grid, modulus, sides.grid.dim
        self.plates = [(plate, sides.of(plate)) for plate in plates]
        tractions = [*tractions, *(plate.traction(faces.area0.sum(), d) for plate, faces in self.plates)]
        self.loads = [(load, sides.of(load)) for load in tractions]
        self.holds = [(hold, sides.of(hold), hold.axes(d)) for hold in displacements]
        self._loaded: Latest[tuple[Exchange, Places]] = Latest()
        for plate, faces in self.plates:
            _check_flat(plate, faces)
        for (one, faces, axes), (other, others, more) in combinations(self.holds, 2):
            if set(axes) & set(more):
                check_apart(one, faces, other, others)
        for condition in [*tractions, *displacements]:
            if not callable(condition.value):  # what a function gives is checked when it is called
                condition.at(0.0, *([d] if isinstance(condition, Traction) else [np.empty((1, d))]))

    def data(self, forms: SideForms, cut: CutDomains, t: float, points: MaterialPoints) -> SideData:
        """Return what acts at time t (s) on the points where they are now."""
        with Timer("mpm: loads"):
            loads = self._load_data(forms, cut, points, t) if self.loads else None
            plates = self._plate_data(forms, cut, points) if self.plates else None
            none = (None, np.empty(0, dtype=np.int64))
            return SideData(loads, plates, *(self._hold_data(forms, cut, points, t) if self.holds else none))

    def _load_data(self, forms: SideForms, cut: CutDomains, points: MaterialPoints, t: float) -> PointData:
        """Return the dead loads on the surface."""
        patches = [cut.surface(faces) for _, faces in self.loads]
        travel, places = self._loaded(cut.key, lambda: self._loaded_places(patches), self.grid.comm)
        forces = [_force(load, t, p, points) for (load, _), p in zip(self.loads, patches, strict=True)]
        force = travel.send(np.concatenate(forces))
        return PointData(forms.loads, places, np.ones(len(force)), {"force": force})

    def _loaded_places(self, patches: Sequence[Patches]) -> tuple[Exchange, Places]:
        """Return the way of loads to the owners of their cells, and where they act."""
        cell, x = (np.concatenate([getattr(p, name) for p in patches]) for name in ("cell", "x"))
        travel = Exchange(self.grid.comm, self.grid.owner(cell))
        return travel, Places(self.grid, self.grid.local(travel.send(cell)), travel.send(x))

    def _plate_data(self, forms: SideForms, cut: CutDomains, points: MaterialPoints) -> PointData:
        """Return the plates on the surface."""
        d, rows = self.grid.dim, []
        for _, faces in self.plates:
            patches = cut.surface(faces)
            area = patches.area(points)
            length = faces.area0.sum() ** (1 / (d - 1))
            rigidity = RIGIDITY * self._modulus * length * np.linalg.norm(area, axis=1, keepdims=True)
            normal = np.tile(np.eye(d)[faces.axis], (len(area), 1))
            tilt = normal - area / area[:, [faces.axis]]  # slope of the face: its normal is (-slope, 1)
            rows.append((patches.cell, patches.x, np.concatenate([rigidity, normal, tilt], axis=1)))
        cell, x, values = gathered(self.grid, rows, 1 + 2 * d)
        rigidity, normal, tilt = np.split(values, [1, 1 + d], axis=1)
        return forms.plates.at(cell, x, np.ones(len(cell)), rigidity=rigidity, normal=normal, tilt=tilt)

    def _hold_data(
        self, forms: SideForms, cut: CutDomains, points: MaterialPoints, t: float
    ) -> tuple[PointData, NDArray[np.int64]]:
        """Return the given displacements on the surface, one row a place and component, and whose each row is."""
        d, rows = self.grid.dim, []
        stiffness = HOLD * self._modulus / self.grid.h.min()
        for number, (hold, faces, axes) in enumerate(self.holds):
            patches = cut.surface(faces)
            gap = patches.origin(points) + self._given(hold, t, patches.X) - patches.now(points)
            for axis in axes:
                values = np.zeros((len(gap), 3 + d))
                values[:, 0] = number
                values[:, 1] = stiffness * patches.area0
                values[:, 2] = gap[:, axis]
                values[:, 3 + axis] = 1.0
                rows.append((patches.cell, patches.x, values))
        cell, x, values = gathered(self.grid, rows, 3 + d)
        number, stiffness, gap, direction = np.split(values, [1, 2, 3], axis=1)
        data = forms.holds.at(cell, x, np.ones(len(cell)), stiffness=stiffness, gap=gap, direction=direction)
        return data, number[:, 0].astype(np.int64)

    def _given(self, hold: Displacement, t: float, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, that a side is given at places X (m, d) of this process."""
        message, value = "", None
        try:
            value = hold.at(t, X)
        except ValueError as error:
            message = str(error)
        if message := first(self.grid.comm, message):
            raise ValueError(message)
        return value

    def reactions(self, sides: SideData, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the forces (displacements, d), N, of the given displacements at nodal values u (nodes, d), m."""
        grid, holds = self.grid, sides.holds
        if holds is None:
            return np.zeros((0, grid.dim))
        N = grid.shape_values(holds.cells, holds.x)
        moved = np.einsum("mk,mkd,md->m", N, u[grid.cell_nodes[holds.cells]], holds["direction"])
        force = (holds["stiffness"][:, 0] * (holds["gap"][:, 0] - moved))[:, None] * holds["direction"]
        sums = [sum_by(sides.number, column, len(self.holds)) for column in force.T]
        return grid.comm.allreduce(np.stack(sums, axis=1))

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return new corners (m, 2^d, d), m, of domains: prisms of their volume (m,) under faces that are held.

        A held face stays where its tracked corners are: put elsewhere it would be pulled back, all at once.
        """
        index = np.arange(2**self.grid.dim)
        for _, faces, _ in self.holds:
            held = np.flatnonzero(np.isin(ids, faces.id))
            outward = face_vectors(tracked[held], faces.axis, faces.end)
            depth = volume[held, None] * outward / (outward**2).sum(axis=1, keepdims=True)
            face = index ^ ((index >> faces.axis & 1 ^ faces.end) << faces.axis)  # of each corner: that on the face
            corners[held] = tracked[held][:, face] - np.where((face != index)[:, None], depth[:, None], 0.0)
        return corners


def _force(load: Traction, t: float, patches: Patches, points: MaterialPoints) -> NDArray[np.float64]:
    """Return the forces (n, d), N, of a traction at time t (s) on the points of integration of its side."""
    traction = load.at(t, points.x.shape[1])
    if traction.ndim == 0:
        area = patches.area(points)
        traction = traction * area / np.linalg.norm(area, axis=1, keepdims=True)
    return patches.area0[:, None] * traction


def _check_flat(plate: RigidPlate, faces: Surface) -> None:
    """Refuse a plate on faces that are not one flat, connected side as seeded: each part would move by itself."""
    corners, tangential = faces.places(), np.arange(faces.X.shape[2]) != faces.axis
    low, high, height = corners.min(axis=1)[:, tangential], corners.max(axis=1)[:, tangential], corners[..., faces.axis]
    X, extent = (low + high) / 2, high - low
    size = extent.max(axis=0)
    apart = np.flatnonzero(np.abs(height - height[0, 0]).max(axis=1) > 1e-6 * size.min())
    if not len(apart):
        pairs = cKDTree(X / size).query_pairs(1 + 1e-6, p=np.inf, output_type="ndarray")
        i, j = pairs.T
        pairs = pairs[(np.abs(X[i] - X[j]) <= (extent[i] + extent[j]) / 2 + 1e-6 * size).all(axis=1)]
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(X), len(X)))
        _, part = connected_components(graph, directed=False)
        apart = np.flatnonzero(part != part[0])
    if len(apart):
        one, other = corners.mean(axis=1)[[0, apart[0]]]
        where = "slope" if apart[0] == 0 else f"and {other} do not hang together at one height"
        raise ValueError(
            f"{line(plate)}: faces at {one} {where}, must be one flat side normal to an axis; "
            "take a plate with a region for each"
        )
