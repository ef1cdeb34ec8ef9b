# SPDX-License-Identifier: MIT
"""Dead tractions on sides of the bodies: int t . v dA on the faces as seeded, where they have moved to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.given_values import by_place
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import Acting, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import Traction
from mpm_dolfinx.conditions.sides import everywhere, on_side
from mpm_dolfinx.domains.cut_domains import Patches
from mpm_dolfinx.forms.point_forms import FormPoints, Places, PointData, PointForm
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.material_points import MaterialPoints


class DeadForces:
    """Points with a force, and its work."""

    def __init__(self, grid: Grid, u: fem.Function):
        self.points = p = FormPoints(grid, force=(grid.dim,))
        self.work = PointForm(ufl.inner(p.force, p.value(ufl.TestFunction(u.function_space))) * p.dx, p)


class Tractions(Acting):
    """The tractions of a stage.

    Parameters
    ----------
    setting, tractions
        Where they are put, and the tractions by name.
    """

    conditions = (Traction,)

    def __init__(self, setting: Setting, tractions: Mapping[str, Traction]):
        self._grid, self._forms = setting.grid, setting.forms
        self._loads = [(load, setting.sides.of(load)) for load in tractions.values()]
        self._placed: Latest[tuple[Exchange, Places]] = Latest()
        for load in tractions.values():
            if not callable(load.value):  # what a function gives is checked when it is called
                load.at(0.0, self._grid.dim)

    @property
    def surfaces(self) -> list[Surface]:
        """The faces."""
        return [faces for _, faces in self._loads]

    def placed(self, place: Place) -> Loads:
        """Return the forces on the surface."""
        patches = place.cut.surfaces(self.surfaces)
        travel, places = self._placed(place.cut.key, lambda: owners(self._grid, patches), self._grid.comm)
        loads = [(load, p) for (load, _), p in zip(self._loads, patches, strict=True)]
        forces = everywhere(
            self._grid, lambda: np.concatenate([_force(load, place.t, p, place.points) for load, p in loads])
        )
        force, forms = travel.send(forces), self._forms(DeadForces)
        return DeadLoads(forms.work, PointData(forms.points, places, np.ones(len(force)), {"force": force}))


class DeadLoads(Loads):
    """Forces that do not depend on the displacement: a linear form, and where it is integrated."""

    def __init__(self, work: PointForm, data: PointData):
        self._work, self.data = work, data

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add the forces."""
        self._work.assemble_vector(b, self.data)


def owners(grid: Grid, patches: Sequence[Patches]) -> tuple[Exchange, Places]:
    """Return the way of loads on patches to the owners of their cells, and where they act."""
    cell, x = (np.concatenate([getattr(p, name) for p in patches]) for name in ("cell", "x"))
    travel = Exchange(grid.comm, grid.owner(cell))
    return travel, Places(grid, grid.local(travel.send(cell)), travel.send(x))


def _force(load: Traction, t: float, patches: Patches, points: MaterialPoints) -> NDArray[np.float64]:
    """Return the forces (n, d), N, of a traction at time t (s) on the points of integration of its side."""
    traction = load.at(t, points.x.shape[1], on_side(patches, points))
    if traction.ndim == 0 or (traction.ndim == 1 and by_place(load.value)):  # along the normal
        area = patches.area(points)
        traction = traction[..., None] * area / np.linalg.norm(area, axis=1, keepdims=True)
    return patches.area0[:, None] * traction
