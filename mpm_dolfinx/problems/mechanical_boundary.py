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
from mpm_dolfinx.constitutive.fields import SceneMaterials
from mpm_dolfinx.forms.point_forms import FormPoints, Places, PointData
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.given_values import by_place
from mpm_dolfinx.parallel.exchange import Exchange, first
from mpm_dolfinx.parallel.messages import warn
from mpm_dolfinx.points.cut_domains import CutDomains, Patches
from mpm_dolfinx.points.faces import Surface, face_vectors
from mpm_dolfinx.points.grid import sum_by
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.problems.cell_contact import gripped, let_go
from mpm_dolfinx.problems.closed import closed
from mpm_dolfinx.problems.conditions import (
    RIGIDITY,
    Displacement,
    OnSide,
    Pressure,
    RigidPlate,
    Traction,
    facing,
    holding,
    inward,
    resistance,
)
from mpm_dolfinx.problems.contacts import Contact
from mpm_dolfinx.problems.held_cells import SAME, HeldCells, HeldPoints
from mpm_dolfinx.problems.rigid_motion import turned
from mpm_dolfinx.problems.side_forms import SideData, SideForms
from mpm_dolfinx.problems.sides import Sides, check_apart, everywhere, gathered, meeting, on_side
from mpm_dolfinx.problems.stage_contacts import Contacts
from mpm_dolfinx.problems.stage_tools import Tools, Ways
from mpm_dolfinx.problems.tools import Tool
from mpm_dolfinx.validation import line


class MechanicalBoundary:
    """Tractions, pressures, rigid plates, given displacements and tools of a stage.

    Parameters
    ----------
    sides
        The sides of the bodies.
    free : (nodes, d)
        Components that no wall holds.
    materials
        Those of the scene: plates are rigid by the stiffest one, held sides by their own.
    tractions, displacements, plates, tools
        The conditions.
    terms
        Those of the user's own on sides.
    contacts
        Those of groups of bodies.

    Raises
    ------
    ValueError
        Naming a condition whose side no point has, a plate whose faces are not one flat side, or two given
        displacements that contradict each other on the same faces.
    """

    def __init__(
        self,
        sides: Sides,
        free: NDArray[np.bool_],
        materials: SceneMaterials,
        tractions: Sequence[Traction | Pressure],
        displacements: Sequence[Displacement],
        plates: Sequence[RigidPlate],
        tools: Sequence[Tool],
        terms: Sequence[OnSide],
        contacts: Sequence[Contact] = (),
    ):
        self.grid, self._free, self.materials, d = sides.grid, free, materials, sides.grid.dim
        self.plates = [(plate, sides.of(plate)) for plate in plates]
        self._terms = [sides.of(term) for term in terms]
        self.pressures = [(load, sides.of(load)) for load in tractions if isinstance(load, Pressure)]
        tractions = [load for load in tractions if not isinstance(load, Pressure)]
        for plate, faces in self.plates:
            area = faces.area0 * self.grid.around(faces.places().mean(axis=1))
            tractions.append(plate.traction(area.sum(), inward(faces)))
        self.loads = [(load, sides.of(load)) for load in tractions]
        self.holds = [(hold, sides.of(hold), hold.axes(d)) for hold in displacements]
        self._meeting: list[tuple[Displacement, Displacement, list[int], NDArray[np.float64]]] = []
        self._warned: set[int] = set()  # numbers of the conditions, of which nothing but the log knows
        self._loaded: Latest[tuple[Exchange, Places]] = Latest()
        self._pressed: Latest[tuple[Exchange, Places]] = Latest()
        for plate, faces in self.plates:
            _check_flat(plate, faces)
        for (one, faces, axes), (other, others, more) in combinations(self.holds, 2):
            if common := sorted(set(axes) & set(more)):
                check_apart(one, faces, other, others)
                self._meeting.append((one, other, common, meeting(sides.bodies, faces, others)))
        for k, (hold, _, axes) in enumerate(self.holds):
            others = [other for other, _, more in self.holds if other is not hold and set(axes) & set(more)]
            self.holds[k] = (hold, sides.held(hold, others), axes)
        pressures = [pressure for pressure, _ in self.pressures]
        for condition in [*tractions, *pressures, *displacements]:
            if not callable(condition.value):  # what a function gives is checked when it is called
                more = {Traction: [d], Pressure: [], Displacement: [np.empty((1, d))]}
                condition.at(0.0, *more[type(condition)])
        self.tools = Tools(self.grid, materials, tools, sides.all, [(hold, faces) for hold, faces, _ in self.holds])
        self.contacts = Contacts(sides, materials, contacts)
        self.symmetric = closed(self.grid, free, self.pressures) and self.tools.symmetric and self.contacts.symmetric
        """Whether the tangent of pressures, tools and contacts is symmetric."""

    def forces(self, value: float) -> NDArray[np.float64]:
        """Return an array of forces and moments of tools and contacts, see `ToolContact.forces`, all of one value."""
        count = len(self.tools.tools) + len(self.contacts.contacts)
        return np.full((count, 3 if self.grid.dim == 2 else 6), value)

    @property
    def surfaces(self) -> list[Surface]:
        """The faces of all conditions but tools and contacts."""
        return [faces for _, faces, *_ in (*self.loads, *self.pressures, *self.plates, *self.holds)] + self._terms

    @property
    def touches(self) -> bool:
        """Whether there are tools or contacts."""
        return bool(self.tools.tools or self.contacts.contacts)

    def let_go(self, points: MaterialPoints) -> MaterialPoints:
        """Return points without what tools and contacts have on them."""
        return let_go(points, {**self.tools.kept(0), **self.contacts.kept(0)})

    def grip(self, points: MaterialPoints, before: MaterialPoints | None = None) -> MaterialPoints:
        """Return points with what tools and contacts have on them: nothing, or what the same points had `before`."""
        return gripped(points, {**self.tools.kept(len(points)), **self.contacts.kept(len(points))}, before)

    @property
    def holds_sides(self) -> bool:
        """Whether there are given displacements or plates."""
        return bool(self.holds or self.plates)

    def holds_as(self, other: MechanicalBoundary) -> bool:
        """Return whether the same given displacements and plates hold the same faces."""
        own, others = ([(hold, faces) for hold, faces, *_ in (*of.holds, *of.plates)] for of in (self, other))
        return len(own) == len(others) and all(
            hold is was and np.array_equal(faces.id, then.id) and np.array_equal(faces.xi, then.xi)
            for (hold, faces), (was, then) in zip(own, others, strict=True)
        )

    def check_start(self, cut: CutDomains, points: MaterialPoints, t: float, ways: NDArray[np.float64]) -> None:
        """Refuse a stage that begins at time t (s) with tools in bodies, or with groups of bodies in each other.

        ways (tools,): how far loads have pushed them, m.
        """
        self.tools.going(Ways(t, t, ways, ways)).check_start(cut, points, t)
        self.contacts.check_start(cut, points, t)

    def check_end(
        self, cut: CutDomains, points: MaterialPoints, t: float, before: MaterialPoints, start: float, tools: Tools
    ) -> None:
        """Refuse a step to time t (s) in which tools have passed bodies, or after which tools or groups are in bodies.

        before: the points at the start of the step, at the time `start` (s); tools: as they go.
        """
        tools.check_end(cut, points, t, before, start)
        self.contacts.check_end(cut, points, before)

    def going(self, sides: SideData, start: float, t: float, ways: NDArray[np.float64]) -> tuple[Tools, NDArray]:
        """Return the tools as they go in a step between two times (s), and how far loads have pushed them (tools,), m.

        ways: the same at its start.
        """
        after = ways if sides.tools is None else sides.tools.pushed.ways
        return self.tools.going(Ways(start, t, ways, after)), after

    def touched(
        self, sides: SideData, unknowns: Unknowns, u: NDArray[np.float64], points: MaterialPoints
    ) -> tuple[NDArray[np.float64], MaterialPoints]:
        """Return the forces and moments of tools, then of contacts, and the points with what these have on them.

        u: displacements of the step, a local array, m.
        """
        forces, nodal = self.forces(0.0), u.reshape(-1, self.grid.dim)
        if sides.tools is not None:
            forces[: len(self.tools.tools)] = sides.tools.forces(nodal)
            points = sides.tools.gripped(nodal, points)
        if sides.contact is not None:
            forces[len(self.tools.tools) :] = sides.contact.now.forces(unknowns, u)
            points = sides.contact.now.gripped(unknowns, u, points)
        return forces, points

    def data(
        self,
        forms: SideForms,
        cut: CutDomains,
        step: tuple[float, float],
        ways: NDArray[np.float64],
        t: float,
        points: MaterialPoints,
    ) -> SideData:
        """Return what acts at time t (s) of a step on the points where they are now.

        step: its start and length, s; without a length sides are held where displacements count from.  ways (tools,):
        how far loads had pushed tools at its start, m.
        """
        start, dt = step
        ends = (start, start + dt) if dt > 0 else ()
        with Timer("mpm: loads"):
            loads = self._load_data(forms, cut, points, t) if self.loads else None
            pressures = self._pressure_data(forms, cut, points, t) if self.pressures else None
            plates = self._plate_data(forms, cut, points) if self.plates else None
            none = (None, None, np.empty(0, dtype=np.int64), np.empty((0, 2**self.grid.dim)))
            holds = self._hold_data(forms, cut, points, t, ends) if self.holds else none
            pairs = zip(forms.own, self._terms, strict=True)
            own = tuple(self._own_data(term.points, faces, cut, points) for term, faces in pairs)
            tools = self.tools.going(Ways(start, t, ways, ways)).placed(cut, points, start, t)
            contact = self.contacts.placed(cut, points)
            return SideData(loads, pressures, plates, *holds, tools, own, contact)

    def _load_data(self, forms: SideForms, cut: CutDomains, points: MaterialPoints, t: float) -> PointData:
        """Return the dead loads on the surface."""
        patches = cut.surfaces([faces for _, faces in self.loads])
        travel, places = self._loaded(cut.key, lambda: self._loaded_places(patches), self.grid.comm)
        loads = zip(self.loads, patches, strict=True)
        forces = everywhere(self.grid, lambda: np.concatenate([_force(load, t, p, points) for (load, _), p in loads]))
        force = travel.send(forces)
        return PointData(forms.loads, places, np.ones(len(force)), {"force": force})

    def _pressure_data(self, forms: SideForms, cut: CutDomains, points: MaterialPoints, t: float) -> PointData:
        """Return the pressures on the surface, with their forces on its area at the start of the step."""
        patches = cut.surfaces([faces for _, faces in self.pressures])
        travel, places = self._pressed(cut.key, lambda: self._loaded_places(patches), self.grid.comm)
        pressures = zip(self.pressures, patches, strict=True)
        values = everywhere(self.grid, lambda: [of.at(t, on_side(p, points)) for (of, _), p in pressures])
        forces = [-value[..., None] * p.area(points) for value, p in zip(values, patches, strict=True)]
        push = travel.send(np.concatenate(forces))
        return PointData(forms.pressures, places, np.ones(len(push)), {"push": push})

    def _loaded_places(self, patches: Sequence[Patches]) -> tuple[Exchange, Places]:
        """Return the way of loads to the owners of their cells, and where they act."""
        cell, x = (np.concatenate([getattr(p, name) for p in patches]) for name in ("cell", "x"))
        travel = Exchange(self.grid.comm, self.grid.owner(cell))
        return travel, Places(self.grid, self.grid.local(travel.send(cell)), travel.send(x))

    def _own_data(self, of: FormPoints, faces: Surface, cut: CutDomains, points: MaterialPoints) -> PointData:
        """Return the points of a term of the user's on a side."""
        p = cut.surface(faces)
        area, now = p.area(points), p.now(points)
        size = np.linalg.norm(area, axis=1, keepdims=True)
        rows = np.concatenate([size, area / size, now, now - p.origin(points)], axis=1)
        cell, x, values = gathered(self.grid, [(p.cell, p.x, rows)], 1 + 3 * self.grid.dim)
        normal, position, displacement = np.split(values[:, 1:], 3, axis=1)
        return of.at(cell, x, values[:, 0], normal=normal, position=position, displacement=displacement)

    def _plate_data(self, forms: SideForms, cut: CutDomains, points: MaterialPoints) -> PointData:
        """Return the plates on the surface."""
        d, rows = self.grid.dim, []
        for _, faces in self.plates:
            patches = cut.surface(faces)
            area = patches.area(points)
            length = faces.area0.sum() ** (1 / (d - 1))
            rigidity = RIGIDITY * self.materials.stiffest * length * np.linalg.norm(area, axis=1, keepdims=True)
            axis = facing(faces)[0]
            normal = np.tile(np.eye(d)[axis], (len(area), 1))
            tilt = normal - area / area[:, [axis]]  # slope of the face: its normal is (-slope, 1)
            rows.append((patches.cell, patches.x, np.concatenate([rigidity, normal, tilt], axis=1)))
        cell, x, values = gathered(self.grid, rows, 1 + 2 * d)
        rigidity, normal, tilt = np.split(values, [1, 1 + d], axis=1)
        return forms.plates.at(cell, x, np.ones(len(cell)), rigidity=rigidity, normal=normal, tilt=tilt)

    def _hold_data(
        self, forms: SideForms, cut: CutDomains, points: MaterialPoints, t: float, ends: Sequence[float]
    ) -> tuple[PointData, HeldCells, NDArray[np.int64], NDArray[np.float64]]:
        """Return what holds given displacements, a row a component; by cells and points; which of these each is.

        Last the shares of each row's force on the nodes that no wall bears.
        """
        d, comm = self.grid.dim, self.grid.comm
        self._check_meeting(t)
        held = HeldCells(self.grid, self._held_points(cut, points, t, ends))
        placed, message = [], ""
        for axis in range(d):
            given = np.array([axis in axes for *_, axes in self.holds])
            *rows, wrong = held.rows(axis, given, self._free[:, axis])
            placed.append((*rows, np.tile(np.eye(d)[axis], (len(rows[0]), 1))))
            if wrong >= 0:
                x = held.x[wrong] + self.grid.base
                what = f"{line(self.holds[held.number[wrong]][0])}: moves {'xyz'[axis]} at {x}"
                message = f"{what}, where a fixed wall holds it; must be 0 there, or the wall must leave it free"
        if message := first(comm, message):
            raise ValueError(message)
        row, stiffness, gap, own, direction = map(np.concatenate, zip(*placed, strict=True))
        fields = {name: values[row] for name, values in held.moments.items()}
        fields |= {"stiffness": stiffness, "gap": gap, "direction": direction}
        return forms.holds.at(held.cell[row], held.x[row], np.ones(len(row)), **fields), held, row, own

    def _held_points(self, cut: CutDomains, points: MaterialPoints, t: float, ends: Sequence[float]) -> HeldPoints:
        """Return the points of integration on held sides, at the owners of their cells.

        ends: start and end of the step, s; none for sides at rest.
        """
        d, rows = self.grid.dim, []
        patches = cut.surfaces([faces for _, faces, _ in self.holds])
        chosen = np.unique(np.concatenate([p.at for p in patches]))
        cut_points = cut.points if ends else points  # which are where they were cut
        now, before = (of.map(lambda values: values[chosen]) for of in (points, cut_points))
        stress = self.materials.total_stress(now)
        modulus, resists = (self.materials.table(before, of) for of in (holding, resistance))
        firm = self.materials.confined_modulus(before)
        # of when the grid was reset, as the stiffnesses: they stay as long as the cut serves
        tension = np.linalg.norm(stress if points is cut_points else self.materials.total_stress(before), axis=(1, 2))
        for number, ((hold, *_, axes), p) in enumerate(zip(self.holds, patches, strict=True)):
            at, now = np.searchsorted(chosen, p.at), p.now(points)
            given = [self._given(hold, time, p.X) for time in (t, *ends)] if ends else 3 * [np.zeros_like(now)]
            to, given = p.origin(points) + given[0], np.concatenate(given[1:], axis=1)
            R = turned(self.grid.comm, p.area0, now, to) if len(axes) == d else np.eye(d)  # as what it carries does
            force, gap = np.einsum("ij,njk,nk->ni", R, stress[at, :d, :d], p.area(points)), to - now
            own = (p.area0 * v for v in (1, modulus[at], tension[at], resists[at], firm[at]))
            each = np.stack([np.full(len(gap), number), *own], axis=1)
            rows.append((p.cell, p.x, np.concatenate([each, gap, given, p.area(cut.points), force], axis=1)))
        cell, x, values = gathered(self.grid, rows, 6 + 5 * d)
        number, *own = values[:, :6].T
        return HeldPoints(number.astype(np.int64), cell, *own, x, *np.split(values[:, 6:], [d, 3 * d, 4 * d], axis=1))

    def _check_meeting(self, t: float) -> None:
        """Refuse given displacements that differ where they meet: no body's stress is finite there."""
        for one, other, axes, X in self._meeting:
            jump = np.abs(self._given(one, t, X) - self._given(other, t, X))[:, axes].max(axis=1)
            if jump.max(initial=0.0) > SAME * self.grid.h.min():
                what = f"{line(one)} and {line(other)}: differ by {jump.max():.3g} m at t = {t:g} s where they meet"
                raise ValueError(f"{what}, at {X[jump.argmax()]}; must agree there, or leave two cells between them")

    def _given(self, hold: Displacement, t: float, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, that a side is given at places X (m, d) of this process."""
        return everywhere(self.grid, lambda: hold.at(t, X))

    def reactions(self, sides: SideData, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the forces (displacements, d), N, of the given displacements at nodal values u (nodes, d), m."""
        grid, data, held = self.grid, sides.holds, sides.held
        if data is None:
            return np.zeros((0, grid.dim))
        force = sides.pull(u)
        self._warn(held, sides.row, data["direction"].argmax(axis=1), force)
        number, force = held.number[sides.row], (sides.share.sum(axis=1) * force)[:, None] * data["direction"]
        return grid.comm.allreduce(np.stack([sum_by(number, column, len(self.holds)) for column in force.T], axis=1))

    def _warn(
        self, held: HeldCells, row: NDArray[np.int64], axis: NDArray[np.int64], force: NDArray[np.float64]
    ) -> None:
        """Log a warning, once a condition, of forces that no change of the body's stress balances."""
        for number, x in held.beyond(row, axis, force, self._warned):
            self._warned.add(number)
            why = "its reaction is an artefact; does something else hold it, or is the step too large?"
            what = "%s: not where it is to be at %s: %s"
            warn(self.grid.comm, what, line(self.holds[number][0]), x + self.grid.base, why)

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return new corners (m, 2^d, d), m, of domains: prisms of their volume (m,) under faces that are held.

        In axisymmetry the volume is the area in the plane.
        A held face stays where its tracked corners are: put elsewhere it would be pulled back, all at once.
        """
        index = np.arange(2**self.grid.dim)
        for _, faces, _ in self.holds:
            held = np.flatnonzero(np.isin(ids, faces.id))
            number = faces.face[np.searchsorted(faces.id, ids[held])]  # of a domain with two held faces the first
            axis, end = (k[:, None] for k in np.divmod(number, 2))
            outward = face_vectors(tracked[held], number)
            depth = volume[held, None] * outward / (outward**2).sum(axis=1, keepdims=True)
            face = index ^ ((index >> axis & 1 ^ end) << axis)  # of each corner: that on the face
            there = np.take_along_axis(tracked[held], face[:, :, None], axis=1)
            corners[held] = there - np.where((face != index)[:, :, None], depth[:, None], 0.0)
        return corners


def _force(load: Traction, t: float, patches: Patches, points: MaterialPoints) -> NDArray[np.float64]:
    """Return the forces (n, d), N, of a traction at time t (s) on the points of integration of its side."""
    traction = load.at(t, points.x.shape[1], on_side(patches, points))
    if traction.ndim == 0 or (traction.ndim == 1 and by_place(load.value)):  # along the normal
        area = patches.area(points)
        traction = traction[..., None] * area / np.linalg.norm(area, axis=1, keepdims=True)
    return patches.area0[:, None] * traction


def _check_flat(plate: RigidPlate, faces: Surface) -> None:
    """Refuse a plate on faces that are not one flat, connected side as seeded: each part would move by itself."""
    corners, axis = faces.places(), facing(faces)[0]
    tangential = np.arange(corners.shape[2]) != axis
    low, high, height = corners.min(axis=1)[:, tangential], corners.max(axis=1)[:, tangential], corners[..., axis]
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
