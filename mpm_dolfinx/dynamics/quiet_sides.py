# SPDX-License-Identifier: MIT
"""Quiet boundaries that absorb waves.

A quiet side exerts the traction `t = t_0 - Z (v - 2 v_in)`.  Here t_0 is the constant traction at rest, v is the
velocity of the side, and v_in is the velocity of an incoming wave (Joyner and Chen 1975).  The impedance is `Z = rho
c_p n n + rho c_s (I - n n)`, with the normal n, the density rho, and the speeds c_p of compression waves and c_s of
shear waves (Lysmer and Kuhlemeyer 1969).  The speeds refer to undrained soil with small-strain moduli.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import combinations

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import Acting, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import Displacement, Quiet
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.forms.velocity import Velocity
from mpm_dolfinx.grid.grid import Grid


def traction_name(name: str) -> str:
    """Return the name of the point field that contains the traction t_0 of a quiet side at rest."""
    return f"{name}_traction"


class QuietForms:
    """Forms at points on quiet sides, with the normal and three more fields.

    `across`: tangential impedance, in kg/m^2/s.
    `along`: normal impedance minus tangential impedance, in kg/m^2/s.
    `force`: traction at rest plus traction of incoming waves, in Pa.
    """

    def __init__(self, grid: Grid, u: fem.Function, velocity: Velocity):
        self.points = p = FormPoints(grid, normal=(grid.dim,), across=(), along=(), force=(grid.dim,))
        v, du = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
        rate = ufl.dot(p.normal, p.value(velocity.value)) * p.normal
        resists = ufl.inner(p.across * p.value(velocity.value) + p.along * rate, p.value(v)) * p.dx
        self.resists, self.slope = PointForm(resists, p), PointForm(ufl.derivative(resists, u, du), p)
        self.stays = PointForm(ufl.inner(p.force, p.value(v)) * p.dx, p)


class QuietSides(Acting):
    """The quiet sides of a stage.

    Parameters
    ----------
    setting, sides
        Setting of the stage, and its quiet sides by name.

    Raises
    ------
    ValueError
        Two quiet sides overlap.  Prescribed displacements or walls of the grid fix all displacement components on a
        face of a quiet side.
    """

    conditions, title = (Quiet,), "quiet sides"

    def __init__(self, setting: Setting, sides: Mapping[str, Quiet]):
        self._grid, self._forms = setting.grid, setting.forms
        self._materials = setting.materials
        self._sides = {name: (side, setting.sides.of(side)) for name, side in sides.items()}
        for (one, faces), (other, others) in combinations(self._sides.values(), 2):
            faces.check_apart(others, (one, other))
        for side in sides.values():
            side.at(0.0, self._grid.dim)
            setting.sides.check_moves(side, setting.of(Displacement).values(), setting.free)

    def named(self, names: Collection[str]) -> dict[str, Surface]:
        """Return the faces of the named sides."""
        return {name: faces for name, (_, faces) in self._sides.items() if name in names}

    @property
    def surfaces(self) -> list[Surface]:
        """Faces of all quiet sides."""
        return [faces for _, faces in self._sides.values()]

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return point fields for the tractions t_0 of the sides, with zeros at n points as initial values."""
        return {name: {traction_name(name): np.zeros((n, self._grid.dim))} for name in self._sides}

    def placed(self, place: Place) -> Loads:
        """Return the loads on the sides in their present position."""
        rows, d = [], self._grid.dim
        points = place.points
        rho, shear = self._materials.present_density(points), self._materials.table(points, lambda m: m.shear)
        across, along = np.sqrt(rho * shear), np.sqrt(rho * self._materials.confined_modulus(points))
        for name, (side, faces) in self._sides.items():
            p = place.cut.surface(faces)
            area, at = p.area(points), p.at
            incoming = side.at(place.t, d)
            size = np.linalg.norm(area, axis=1, keepdims=True)
            n = area / size
            z, more = across[at], along[at] - across[at]
            push = 2 * (z[:, None] * incoming + (more * (n @ incoming))[:, None] * n)
            force = push + points.data[traction_name(name)][at] * p.area0[:, None] / size
            fields = {"size": size[:, 0], "normal": n, "across": z, "along": more, "force": force}
            rows.append((p.cell, p.x, fields))
        cell, x, fields = self._grid.gathered(rows)
        forms = self._forms(QuietForms, self._forms.velocity)
        return QuietLoads(forms, forms.points.at(cell, x, fields.pop("size"), **fields))


class QuietLoads(Loads):
    """Loads of the quiet sides in a substep."""

    def __init__(self, forms: QuietForms, data: PointData):
        self._forms, self._data = forms, data

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add the nodal forces of incoming waves, and of the constant tractions t_0 of sides at rest."""
        self._forms.stays.assemble_vector(b, self._data)

    def resists(self, b: NDArray[np.float64]) -> None:
        """Add the nodal forces of the viscous resistance."""
        self._forms.resists.assemble_vector(b, self._data)

    def tangent(self, K: PETSc.Mat) -> None:
        """Add the derivative of the viscous resistance to the momentum tangent."""
        self._forms.slope.assemble_matrix(K, self._data)
