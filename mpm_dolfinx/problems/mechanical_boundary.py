# SPDX-License-Identifier: MIT
"""The conditions on the sides of the bodies, put where the sides are at the start of a step."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mpm_dolfinx.validation import line
from mpm_dolfinx.problems.conditions import HOLD, RIGIDITY, Displacement, Drained, Inflow, RigidPlate, Traction
from mpm_dolfinx.points.cutting import SNAP
from mpm_dolfinx.parallel.exchange import Exchange, first
from mpm_dolfinx.points.grid import Grid, sum_by
from mpm_dolfinx.problems.momentum import Momentum
from mpm_dolfinx.points.cut_domains import Placement
from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.problems.storage import Storage
from mpm_dolfinx.points.faces import Surface, face_vectors, surface


class Boundary:
    """The sides of a scene's bodies and what acts on them.

    Parameters
    ----------
    grid, bodies
        Background grid and all bodies of the scene.
    present
        Which bodies are there.
    modulus
        Oedometric modulus of the stiffest material, Pa, by which plates and held sides are rigid.
    tractions, displacements, plates, outlets
        The conditions; outlets are drained sides and prescribed inflows.

    Raises
    ------
    ValueError
        Naming a condition whose side no point has, a plate whose faces are not one flat side, or two conditions
        that contradict each other on the same faces.
    """

    def __init__(
        self,
        grid: Grid,
        bodies: Sequence[Body],
        present: Sequence[bool],
        modulus: float,
        tractions: Sequence[Traction],
        displacements: Sequence[Displacement],
        plates: Sequence[RigidPlate],
        outlets: Sequence[Drained | Inflow],
    ):
        self.grid, self._bodies, self._present, self._modulus = grid, bodies, list(present), modulus
        self._found: dict[tuple[str, str], Surface] = {}
        self._loaded: tuple[Placement, Exchange] | None = None
        self.plates = [(plate, self._faces(plate)) for plate in plates]
        tractions = [*tractions, *(plate.traction(faces.area0.sum(), grid.dim) for plate, faces in self.plates)]
        self.loads = [(load, self._faces(load)) for load in tractions]
        self.holds = [(hold, self._faces(hold), hold.axes(grid.dim)) for hold in displacements]
        self.outlets = [(outlet, self._faces(outlet)) for outlet in outlets]
        for plate, faces in self.plates:
            _check_flat(plate, faces)
        for one, other in combinations(self.outlets, 2):
            _check_apart(*one, *other)
        for (one, faces, axes), (other, others, more) in combinations(self.holds, 2):
            if set(axes) & set(more):
                _check_apart(one, faces, other, others)
        for condition in [*tractions, *displacements]:
            if not callable(condition.value):  # what a function gives is checked when it is called
                condition.at(0.0, *([grid.dim] if isinstance(condition, Traction) else [np.empty((1, grid.dim))]))

    def _faces(self, condition) -> Surface:
        """Return the faces of a condition's side, the same object for conditions on the same faces."""
        key = (str(condition.side), str(condition.region))
        if key not in self._found:
            self._found[key] = surface(self._bodies, condition.side, condition.region, self._present)
        if not len(self._found[key]):
            where = " in the region" if condition.region else ""
            raise ValueError(f"{line(condition)}: no point has this side{where}, must be one of a body")
        return self._found[key]

    def place_loads(self, place: Placement, momentum: Momentum, t: float) -> None:
        """Put the dead loads of time t (s) on the surface."""
        d = self.grid.dim
        cells, places, forces = [np.empty(0, dtype=np.int64)], [np.empty((0, d))], [np.empty((0, d))]
        for load, faces in self.loads:
            patches = place.surface(faces)
            cells.append(patches.cell)
            places.append(patches.x)
            traction = load.at(t, self.grid.dim)
            if traction.ndim == 0:
                area = patches.area(place.points)
                traction = traction * area / np.linalg.norm(area, axis=1, keepdims=True)
            forces.append(patches.area0[:, None] * traction)
        if self._loaded is None or self._loaded[0] is not place:
            cell, x = np.concatenate(cells), np.concatenate(places)
            self._loaded = place, Exchange(self.grid.comm, self.grid.owner(cell))
            cell, x = self._loaded[1].send(cell), self._loaded[1].send(x)
            momentum.loads.place(self.grid.local(cell), x, np.ones(len(cell)), force=np.zeros_like(x))
        momentum.loads.renew(force=self._loaded[1].send(np.concatenate(forces)))

    def place_plates(self, place: Placement, momentum: Momentum) -> None:
        """Put the plates on the surface."""
        grid, rows = self.grid, []
        for _, faces in self.plates:
            patches = place.surface(faces)
            area = patches.area(place.points)
            length = faces.area0.sum() ** (1 / (grid.dim - 1))
            rigidity = RIGIDITY * self._modulus * length * np.linalg.norm(area, axis=1, keepdims=True)
            normal = np.tile(np.eye(grid.dim)[faces.axis], (len(area), 1))
            tilt = normal - area / area[:, [faces.axis]]  # slope of the face: its normal is (-slope, 1)
            rows.append((patches.cell, patches.x, np.concatenate([rigidity, normal, tilt], axis=1)))
        cell, x, values = self._gathered(rows, 1 + 2 * grid.dim)
        rigidity, normal, tilt = np.split(values, [1, 1 + grid.dim], axis=1)
        momentum.plates.place(cell, x, np.ones(len(cell)), rigidity=rigidity, normal=normal, tilt=tilt)

    def place_holds(self, place: Placement, momentum: Momentum, t: float) -> None:
        """Put the given displacements of time t (s) on the surface: one row a place and component."""
        d, rows = self.grid.dim, []
        stiffness = HOLD * self._modulus / self.grid.h.min()
        for number, (hold, faces, axes) in enumerate(self.holds):
            patches = place.surface(faces)
            gap = patches.origin(place.points) + self._given(hold, t, patches.X) - patches.now(place.points)
            for axis in axes:
                values = np.zeros((len(gap), 3 + d))
                values[:, 0] = number
                values[:, 1] = stiffness * patches.area0
                values[:, 2] = gap[:, axis]
                values[:, 3 + axis] = 1.0
                rows.append((patches.cell, patches.x, values))
        cell, x, values = self._gathered(rows, 3 + d)
        number, stiffness, gap, direction = np.split(values, [1, 2, 3], axis=1)
        self._number = number[:, 0].astype(np.int64)
        momentum.holds.place(cell, x, np.ones(len(cell)), stiffness=stiffness, gap=gap, direction=direction)

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

    def reactions(self, momentum: Momentum) -> NDArray[np.float64]:
        """Return the forces (holds, d), N, by which the given displacements act at the present displacement."""
        grid, holds = self.grid, momentum.holds
        N = grid.shape_values(holds.cells, holds.x)
        u = momentum.u.x.array.reshape(-1, grid.dim)[grid.cell_nodes[holds.cells]]
        direction = holds.data["direction"]
        moved = np.einsum("mk,mkd,md->m", N, u, direction)
        force = (holds.data["stiffness"][:, 0] * (holds.data["gap"][:, 0] - moved))[:, None] * direction
        sums = [sum_by(self._number, column, len(self.holds)) for column in force.T]
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

    def open_outlets(self, place: Placement, storage: Storage, weight: NDArray[np.float64] | None) -> None:
        """Set the conductances of drained sides and the inflows; weight: rho_w g (d,), N/m^3, if there is gravity."""
        grid, d = self.grid, self.grid.dim
        cells, conductances, inflows = [np.empty(0, dtype=np.int32)], [np.empty(0)], [np.empty(0)]
        for outlet, faces in self.outlets:
            patches = place.surface(faces)
            travel = Exchange(grid.comm, grid.owner(patches.cell))
            cell = grid.local(travel.send(patches.cell))
            area, x = travel.send(patches.area(place.points)), travel.send(patches.x)
            size = np.linalg.norm(area, axis=1)
            cells.append(cell)
            if isinstance(outlet, Inflow):
                conductances.append(np.zeros(len(cell)))
                inflows.append(outlet.flux * size)
                continue
            centre = grid.midpoints[cell] + storage.centroid.x.array.reshape(-1, d)[cell]
            distance = np.einsum("md,md->m", x - centre, area) / size
            conductance = storage.mobility.x.array[cell] * size / np.maximum(distance, SNAP * grid.h.min())
            outer = np.full(len(cell), outlet.pressure)
            if weight is not None:
                outer -= (x - centre) @ weight
            conductances.append(conductance)
            inflows.append(conductance * outer)
        storage.set_fluxes(np.concatenate(cells), np.concatenate(conductances), np.concatenate(inflows))

    def _gathered(self, rows: list, width: int) -> tuple[NDArray, NDArray, NDArray]:
        """Send (cells, positions, values) to the owners of the cells; return (owned cells, positions, values)."""
        empty = (np.empty(0, dtype=np.int64), np.empty((0, self.grid.dim)), np.empty((0, width)))
        parts = [np.concatenate(column) for column in zip(empty, *rows, strict=True)]
        travel = Exchange(self.grid.comm, self.grid.owner(parts[0]))
        cell, x, values = map(travel.send, parts)
        return self.grid.local(cell), x, values


def _check_flat(plate: RigidPlate, faces: Surface) -> None:
    """Refuse a plate on faces that are not one flat, connected side: each part would move by itself."""
    height, tangential = faces.X[:, 0, faces.axis], np.arange(faces.X.shape[2]) != faces.axis
    X, size = faces.X.mean(axis=1), np.ptp(faces.X, axis=1)[:, tangential].max(axis=0)
    apart = np.flatnonzero(np.abs(height - height[0]) > 1e-6 * size.min())
    if not len(apart):
        pairs = cKDTree(X[:, tangential] / size).query_pairs(1 + 1e-6, p=np.inf, output_type="ndarray")
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(X), len(X)))
        _, part = connected_components(graph, directed=False)
        apart = np.flatnonzero(part != part[0])
    if len(apart):
        where = f"faces at {X[0]} and {X[apart[0]]} do not hang together"
        raise ValueError(f"{line(plate)}: {where}, must be one flat side; take a plate with a region for each")


def _check_apart(one, faces: Surface, other, others: Surface) -> None:
    """Refuse two conditions, of a kind that excludes the other, on the same part of a face."""
    if (faces.axis, faces.end) != (others.axis, others.end):
        return
    _, a, b = np.intersect1d(faces.id, others.id, return_indices=True)
    low, high = np.maximum(faces.X[a, 0], others.X[b, 0]), np.minimum(faces.X[a, 1], others.X[b, 1])
    common = high - low > 1e-9 * (faces.X[a, 1] - faces.X[a, 0])
    common[:, faces.axis] = True
    both = np.flatnonzero(common.all(axis=1))
    if len(both):
        x = (low[both[0]] + high[both[0]]) / 2
        raise ValueError(f"{line(one)} and {line(other)}: both act at {x}, must not; limit them by regions")
