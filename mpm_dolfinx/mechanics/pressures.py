# SPDX-License-Identifier: MIT
"""Pressures that follow the surface: -int p n . v da over the present area, with their tangent.

The tangent of a pressure p on a surface is symmetric but for its boundary, whose edges dx contribute p/2 (v x du) . dx.
That vanishes where two surfaces of one pressure meet, and on a wall that holds the normal component: there v, du and
the edge lie in the wall.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.given_values import by_place
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import Acting, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import Pressure
from mpm_dolfinx.conditions.sides import everywhere, on_side
from mpm_dolfinx.forms.point_forms import FormPoints, Places, PointData, PointForm
from mpm_dolfinx.grid.grid import SIDES, Grid
from mpm_dolfinx.mechanics.tractions import owners
from mpm_dolfinx.parallel.exchange import Exchange, over_all


class PressureForms:
    """Points with the force of a pressure on the area at the start of the step; its work, and minus the derivative."""

    def __init__(self, grid: Grid, u: fem.Function):
        self.points = p = FormPoints(grid, push=(grid.dim,))
        V = u.function_space
        # n da = det(Delta) Delta^-T n_n da_n (Nanson) at the present iterate
        delta = ufl.variable(ufl.Identity(grid.stretches) + p.grad(u))
        turned = ufl.diff(ufl.det(delta), delta)
        if grid.axisymmetric:
            turned = ufl.as_matrix([[turned[i, j] for j in (0, 1)] for i in (0, 1)])
        pushed = ufl.inner(turned * p.push, p.value(ufl.TestFunction(V))) * p.dx
        self.work, self.slope = PointForm(pushed, p), PointForm(-ufl.derivative(pushed, u, ufl.TrialFunction(V)), p)


class Pressures(Acting):
    """The pressures of a stage.

    Parameters
    ----------
    setting, pressures
        Where they are put, and the pressures by name.
    """

    conditions, title, linear = (Pressure,), "pressures", False

    def __init__(self, setting: Setting, pressures: Mapping[str, Pressure]):
        self._grid, self._forms = setting.grid, setting.forms
        self._pressures = [(pressure, setting.sides.of(pressure)) for pressure in pressures.values()]
        self._placed: Latest[tuple[Exchange, Places]] = Latest()
        for pressure in pressures.values():
            if not callable(pressure.value):  # what a function gives is checked when it is called
                pressure.at(0.0)
        self.symmetric = closed(self._grid, setting.free, self._pressures)

    @property
    def surfaces(self) -> list[Surface]:
        """The faces."""
        return [faces for _, faces in self._pressures]

    def placed(self, place: Place) -> Loads:
        """Return the pressures on the surface, with their forces on its area at the start of the step."""
        grid, patches = self._grid, place.cut.surfaces(self.surfaces)
        travel, places = self._placed(place.cut.key, lambda: owners(grid, patches), grid.comm)
        both = [(pressure, p) for (pressure, _), p in zip(self._pressures, patches, strict=True)]
        values = everywhere(grid, lambda: [of.at(place.t, on_side(p, place.points)) for of, p in both])
        forces = [-value[..., None] * p.area(place.points) for value, p in zip(values, patches, strict=True)]
        push, forms = travel.send(np.concatenate(forces)), self._forms(PressureForms)
        return PressureLoads(forms, PointData(forms.points, places, np.ones(len(push)), {"push": push}))


class PressureLoads(Loads):
    """Pressures in a substep."""

    linear, varies = False, True

    def __init__(self, forms: PressureForms, data: PointData):
        self._forms, self._data = forms, data

    def loads(self, b: NDArray[np.float64]) -> None:
        """Add the forces on the present area."""
        self._forms.work.assemble_vector(b, self._data)

    def tangent(self, K: PETSc.Mat) -> None:
        """Add the tangent: as the surface moves it turns and stretches."""
        self._forms.slope.assemble_matrix(K, self._data)


def closed(grid: Grid, free: NDArray[np.bool_], pressures: Sequence[tuple[Pressure, Surface]]) -> bool:
    """Return whether the surfaces of equal pressures are closed, or end on walls that hold them.

    Faces whose corners lie on the edges of others are taken to be open.

    Parameters
    ----------
    free : (nodes, d)
        Components that no wall holds.
    pressures
        With the faces on which they act.
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
    """Return axis and place, m, of the walls that hold their normal component."""
    out = []
    for wall, (axis, end) in SIDES[grid.dim].items():
        if not over_all(grid.comm, int(free[grid.wall_nodes(wall), axis].sum())):
            out.append((axis, (grid.lower, grid.upper)[end][axis]))
    return out


def _closed(grid: Grid, walls: Sequence[tuple[int, float]], surfaces: Sequence[Surface]) -> bool:
    """Return whether every edge of some faces belongs to two of them, or lies in a wall that holds it."""
    x = np.concatenate([faces.places() for faces in surfaces])
    count, edges = x.shape[1], _EDGES[grid.dim]
    number = np.rint((x.reshape(-1, grid.dim) - grid.lower) / (NEAR * grid.h) + 1 / 3)  # on no half between two numbers
    _, corner = np.unique(number, axis=0, return_inverse=True)
    edge = np.sort(corner.reshape(-1, count)[:, edges].reshape(-1, edges.shape[1]), axis=1)
    x = x[:, edges].reshape(-1, edges.shape[1], grid.dim)
    if grid.dim == 3:  # of a triangle two corners are the same
        real = edge[:, 0] != edge[:, 1]
        edge, x = edge[real], x[real]
    _, kind, often = np.unique(edge, axis=0, return_inverse=True, return_counts=True)
    lone = x[often[kind.ravel()] == 1]
    held = np.zeros(len(lone), dtype=bool)
    for axis, place in walls:
        held |= (np.abs(lone[:, :, axis] - place) < NEAR * grid.h[axis]).all(axis=1)
    return bool(held.all() and often.max(initial=0) <= 2)


_EDGES = {2: np.array([[0], [1]]), 3: np.array([[0, 1], [1, 3], [3, 2], [2, 0]])}
"""Corners of the edges of a face; in 2D its ends."""
