# SPDX-License-Identifier: MIT
"""Loads on sides of the bodies: dead tractions, and pressures that follow the surface.

A traction t is a force per reference area A.  With the test function v, the virtual work of t is `int t . v dA`.  The
virtual work of a pressure p is `-int p n . v da`, with the present area a and its normal n.  The tangent of this work
is symmetric up to a line integral over the edges of the surface.  The line integral is zero if the surface is closed,
or ends at walls that fix the normal displacement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.base.validation import by_place
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import Acting, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import Pressure, Traction
from mpm_dolfinx.domains.cut_domains import Patches
from mpm_dolfinx.forms.point_forms import FormPoints, Places, PointData, PointForm
from mpm_dolfinx.grid.grid import SIDES, Grid
from mpm_dolfinx.parallel.exchange import Exchange, over_all, together
from mpm_dolfinx.points.material_points import MaterialPoints


class SideLoads(Acting):
    """All tractions, or all pressures, on sides of the bodies in a stage."""

    def __init__(self, setting: Setting, loads: Mapping[str, Any]):
        self._grid, self._forms = setting.grid, setting.forms
        self._loads = [(load, setting.sides.of(load)) for load in loads.values()]
        self.surfaces = [faces for _, faces in self._loads]
        """Faces with the loads."""
        self._placed: Latest[tuple[Exchange, Places]] = Latest()
        for load in loads.values():
            if not callable(load.value):  # values of functions are checked when they are called
                self._given(load, 0.0, None)

    def forces(self, place: Place) -> tuple[Places, NDArray[np.float64]]:
        """Return integration points in owned cells, and the forces at these points, in N."""
        grid, patches = self._grid, place.cut.surfaces(self.surfaces)
        travel, places = self._placed(place.cut.key, lambda: owners(grid, patches), grid.comm)
        both, points = [*zip(self._loads, patches, strict=True)], place.points
        values = together(grid.comm, lambda: [self._given(of, place.t, p.positions(points)) for (of, _), p in both])
        forces = [self._on(of, value, p, points) for ((of, _), p), value in zip(both, values, strict=True)]
        return places, travel.send(np.concatenate(forces))

    def _given(self, load: Any, t: float, side: Any) -> NDArray[np.float64]:
        """Return the value of a load on a side at time t, in s."""
        raise NotImplementedError

    def _on(
        self, load: Any, value: NDArray[np.float64], patches: Patches, points: MaterialPoints
    ) -> NDArray[np.float64]:
        """Return the forces of a load at the integration points of its side, in N."""
        raise NotImplementedError


class DeadForces:
    """Form of the virtual work of forces at points."""

    def __init__(self, grid: Grid, u: fem.Function):
        self.points = p = FormPoints(grid, force=(grid.dim,))
        self.work = PointForm(ufl.inner(p.force, p.value(ufl.TestFunction(u.function_space))) * p.dx, p)


class Tractions(SideLoads):
    """The tractions of a stage."""

    conditions, title = (Traction,), "tractions"

    def placed(self, place: Place) -> Loads:
        """Return the forces of the tractions at points of the sides."""
        (places, force), forms = self.forces(place), self._forms(DeadForces)
        return DeadLoads(forms.work, PointData(forms.points, places, np.ones(len(force)), {"force": force}))

    def _given(self, load: Traction, t: float, side: Any) -> NDArray[np.float64]:
        return load.at(t, self._grid.dim, side)

    def _on(
        self, load: Traction, value: NDArray[np.float64], patches: Patches, points: MaterialPoints
    ) -> NDArray[np.float64]:
        if value.ndim == 0 or (value.ndim == 1 and by_place(load.value)):  # along the normal
            area = patches.area(points)
            value = value[..., None] * area / np.linalg.norm(area, axis=1, keepdims=True)
        return patches.area0[:, None] * value


class DeadLoads(Loads):
    """Nodal forces that do not depend on the displacement."""

    def __init__(self, work: PointForm, data: PointData):
        self._work, self.data = work, data

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add the nodal forces."""
        self._work.assemble_vector(b, self.data)


def owners(grid: Grid, patches: Sequence[Patches]) -> tuple[Exchange, Places]:
    """Return the exchange that sends values at `patches` to the owners of their cells, and the received positions."""
    cell, x = (np.concatenate([getattr(p, name) for p in patches]) for name in ("cell", "x"))
    travel = Exchange(grid.comm, grid.owner(cell))
    return travel, Places(grid, grid.locals[travel.send(cell)], travel.send(x))


class PressureForms:
    """Forms of the nodal forces of pressures, and of their derivatives."""

    def __init__(self, grid: Grid, u: fem.Function):
        self.points = p = FormPoints(grid, push=(grid.dim,))
        V = u.function_space
        # n da = det(Delta) Delta^-T n_n da_n (Nanson) at the present iterate
        delta = ufl.variable(ufl.Identity(grid.stretches) + p.grad(u))
        rotated = ufl.diff(ufl.det(delta), delta)
        if grid.axisymmetric:
            rotated = ufl.as_matrix([[rotated[i, j] for j in (0, 1)] for i in (0, 1)])
        pushed = ufl.inner(rotated * p.push, p.value(ufl.TestFunction(V))) * p.dx
        self.work, self.slope = PointForm(pushed, p), PointForm(-ufl.derivative(pushed, u, ufl.TrialFunction(V)), p)


class Pressures(SideLoads):
    """The pressures of a stage."""

    conditions, title, linear = (Pressure,), "pressures", False

    def __init__(self, setting: Setting, pressures: Mapping[str, Pressure]):
        super().__init__(setting, pressures)
        self.symmetric = closed(self._grid, setting.free, self._loads)

    def placed(self, place: Place) -> Loads:
        """Return the pressures in a substep."""
        (places, push), forms = self.forces(place), self._forms(PressureForms)
        return PressureLoads(forms, PointData(forms.points, places, np.ones(len(push)), {"push": push}))

    def _given(self, load: Pressure, t: float, side: Any) -> NDArray[np.float64]:
        return load.at(t, side)

    def _on(
        self, load: Pressure, value: NDArray[np.float64], patches: Patches, points: MaterialPoints
    ) -> NDArray[np.float64]:
        return -value[..., None] * patches.area(points)


class PressureLoads(Loads):
    """Pressures in a substep."""

    linear = False

    def __init__(self, forms: PressureForms, data: PointData):
        self._forms, self._data = forms, data

    def loads(self, b: NDArray[np.float64]) -> None:
        """Add the nodal forces of the pressures on the present area."""
        self._forms.work.assemble_vector(b, self._data)

    def tangent(self, K: PETSc.Mat) -> None:
        """Add the tangent, due to rotation and stretch of the surface."""
        self._forms.slope.assemble_matrix(K, self._data)


def closed(grid: Grid, free: NDArray[np.bool_], pressures: Sequence[tuple[Pressure, Surface]]) -> bool:
    """Return whether each surface under one pressure is closed, or ends at walls that fix the normal displacement.

    `free` (nodes, d): whether walls leave each displacement component free.
    """
    if not pressures:
        return True
    if any(by_place(pressure.value) for pressure, _ in pressures):
        return False
    groups: dict[float, list[Surface]] = {}
    for pressure, faces in pressures:
        groups.setdefault(id(pressure.value) if callable(pressure.value) else float(pressure.value), []).append(faces)
    return all(_closed(grid, _held_walls(grid, free), faces) for faces in groups.values())


def _held_walls(grid: Grid, free: NDArray[np.bool_]) -> list[tuple[int, float]]:
    """Return axis and position, in m, of each wall that fixes its normal displacement component."""
    out = []
    for wall, (axis, end) in SIDES[grid.dim].items():
        if not over_all(grid.comm, int(free[grid.wall_nodes(wall), axis].sum())):
            out.append((axis, (grid.lower, grid.upper)[end][axis]))
    return out


def _closed(grid: Grid, walls: Sequence[tuple[int, float]], surfaces: Sequence[Surface]) -> bool:
    """Return whether every edge of the surface belongs to two faces, or is on one of the walls."""
    x = np.concatenate([faces.places() for faces in surfaces])
    count, edges = x.shape[1], _EDGES[grid.dim]
    number = np.rint(
        (x.reshape(-1, grid.dim) - grid.lower) / (NEAR * grid.finest) + 1 / 3
    )  # halfway positions between two integers are avoided
    _, corner = np.unique(number, axis=0, return_inverse=True)
    edge = np.sort(corner.reshape(-1, count)[:, edges].reshape(-1, edges.shape[1]), axis=1)
    x = x[:, edges].reshape(-1, edges.shape[1], grid.dim)
    if grid.dim == 3:  # triangles have one corner twice, and so an edge of zero length
        real = edge[:, 0] != edge[:, 1]
        edge, x = edge[real], x[real]
    _, kind, often = np.unique(edge, axis=0, return_inverse=True, return_counts=True)
    single = x[often[kind.ravel()] == 1]
    held = np.zeros(len(single), dtype=bool)
    for axis, place in walls:
        held |= (np.abs(single[:, :, axis] - place) < NEAR * grid.finest[axis]).all(axis=1)
    return bool(held.all() and often.max(initial=0) <= 2)


_EDGES = {2: np.array([[0], [1]]), 3: np.array([[0, 1], [1, 3], [3, 2], [2, 0]])}
"""Indices of the two corners of each edge of a face in 3D, and of each end of a face in 2D."""
