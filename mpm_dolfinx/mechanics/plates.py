# SPDX-License-Identifier: MIT
"""Rigid plates: a uniform traction on a side, and a penalty on the tilt of this side, see `RigidPlate`."""

from __future__ import annotations

from collections.abc import Mapping

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.conditions.acting import Acting, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import RIGIDITY, RigidPlate, Traction, facing, inward
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.grid.grid import Grid, linked
from mpm_dolfinx.mechanics.tractions import Tractions
from mpm_dolfinx.parallel.exchange import over_all


class PlateForms:
    """Forms of a penalty on the tilt of a side under a plate."""

    def __init__(self, grid: Grid, u: fem.Function):
        self.points = p = FormPoints(grid, rigidity=(), normal=(grid.dim,), tilt=(grid.dim,))
        v, du = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)

        def slope(w):
            """Return the tangential gradient of the normal displacement."""
            gradient = ufl.dot(p.normal, p.plane_grad(w))
            return gradient - ufl.dot(gradient, p.normal) * p.normal

        self.bend = PointForm(p.rigidity * ufl.inner(slope(du), slope(v)) * p.dx, p)
        self.tilt = PointForm(-p.rigidity * ufl.inner(p.tilt, slope(v)) * p.dx, p)


class Plates(Acting):
    """The rigid plates of a stage, by name.

    The faces under a plate must be one flat side (ValueError).
    """

    conditions, title = (RigidPlate,), "rigid plates"

    def __init__(self, setting: Setting, plates: Mapping[str, RigidPlate]):
        self._grid = setting.grid
        self._forms = setting.forms
        self._materials = setting.materials
        self._faces = [setting.sides.of(plate) for plate in plates.values()]
        even: dict[str, Traction] = {}
        for (name, plate), faces in zip(plates.items(), self._faces, strict=True):
            area = faces.area0 * self._grid.around(faces.places().mean(axis=1))
            even[name] = plate.traction(area.sum(), inward(faces))
            _check_flat(plate, faces.places(), facing(faces)[0])
        self._even = Tractions(setting, even)
        self.surfaces = self._faces
        self.held = [
            (plate, faces, range(self._grid.dim)) for plate, faces in zip(plates.values(), self._faces, strict=True)
        ]

    def placed(self, place: Place) -> Loads:
        """Return the plates in a substep, with their stiffness, normal and present tilt."""
        d = self._grid.dim
        rows = []
        grid = self._grid
        oedometric = self._materials.table(place.points, lambda m: m.oedometric)
        for faces in self._faces:
            patches = place.cut.surface(faces)
            area = patches.area(place.points)
            length = faces.area0.sum() ** (1 / (d - 1))
            modulus = oedometric[patches.at].max(initial=0.0)  # only of the material under the plate
            rigidity = RIGIDITY * over_all(grid.comm, float(modulus), MPI.MAX) * length
            rigidity = rigidity * np.linalg.norm(area, axis=1)
            axis = facing(faces)[0]
            normal = np.tile(np.eye(d)[axis], (len(area), 1))
            tilt = normal - area / area[:, [axis]]  # slope of the face; the face's normal is (-slope, 1)
            rows.append((patches.cell, patches.x, {"rigidity": rigidity, "normal": normal, "tilt": tilt}))
        cell, x, fields = grid.gathered(rows)
        forms = self._forms(PlateForms)
        return PlateLoads(forms, forms.points.at(cell, x, np.ones(len(cell)), **fields), self._even.placed(place))


class PlateLoads(Loads):
    """Plates in a substep.  The loads `even` are the uniform tractions of the plates."""

    stiff = True

    def __init__(self, forms: PlateForms, data: PointData, even: Loads):
        self._forms = forms
        self._data = data
        self._even = even

    def dead(self, b: NDArray[np.float64]) -> None:
        """Add the uniform tractions, and the forces that reduce the tilt."""
        self._even.dead(b)
        self._forms.tilt.assemble_vector(b, self._data)

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the stiffness of the penalty on the tilt."""
        self._forms.bend.assemble_matrix(A, self._data)

    def moved(self, u: fem.Function) -> Loads:
        """Return the plates after an additional displacement u of the nodes."""
        data, d = self._data, self._data.points.grid.dim
        slope = np.einsum("ni,nij->nj", data["normal"], data.gradients(u.x.array).reshape(-1, d, d))
        slope = slope - (slope * data["normal"]).sum(axis=1, keepdims=True) * data["normal"]
        return PlateLoads(self._forms, data.having(tilt=data["tilt"] + slope), self._even)

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """The cells under plates."""
        return self._data.cells


def _check_flat(plate: RigidPlate, corners: NDArray[np.float64], axis: int) -> None:
    """Raise ValueError if the faces under a plate are not one flat, connected side.

    `corners` (n, 2^(d-1), d), in m: corners of the faces.
    `axis`: axis normal to the side.
    """
    tangential = np.arange(corners.shape[2]) != axis
    low = corners.min(axis=1)[:, tangential]
    high = corners.max(axis=1)[:, tangential]
    height = corners[..., axis]
    X, extent = (low + high) / 2, high - low
    size = extent.max(axis=0)
    apart = np.flatnonzero(np.abs(height - height[0, 0]).max(axis=1) > NEAR * size.min())
    if not len(apart):
        pairs = cKDTree(X / size).query_pairs(1 + NEAR, p=np.inf, output_type="ndarray")
        i, j = pairs.T
        pairs = pairs[(np.abs(X[i] - X[j]) <= (extent[i] + extent[j]) / 2 + NEAR * size).all(axis=1)]
        part, _ = linked(len(X), *pairs.T)
        apart = np.flatnonzero(part != part[0])
    if len(apart):
        one, other = corners.mean(axis=1)[[0, apart[0]]]
        where = "slope" if apart[0] == 0 else f"and {other} are not connected at one height"
        raise ValueError(
            f"{line(plate)}: faces at {one} {where}, must be one flat side normal to an axis; "
            "use one plate with a region for each side"
        )
