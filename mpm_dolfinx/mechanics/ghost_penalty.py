# SPDX-License-Identifier: MIT
"""Ghost penalty: nearly empty cells follow the deformation of fuller neighbours (Burman 2010, Coombs 2023).

The ghost penalty adds the term `gamma s 2G h/3 int [d_n u].[d_n v] dS` over faces between cells.  Here u is the
displacement increment of the step, v the test function, and [d_n u] the jump of the normal derivative.  With inertia, u
is the increment minus the inertial predictor (`inertia`).  Gamma is `GHOST`, G the shear modulus, and h the cell size.
The factor s is between 0 and 1 for each face:

    s = max(0, 1 - f_1 / (RATIO f_2)) (f_2 / f_3)^2,     f_1 <= f_2,

with the volume fractions f_1 and f_2 of the two cells, and the largest volume fraction f_3 of the neighbours of cell 1.
The penalty therefore acts on nearly empty cells only.  With integration at the material points (`quadrature="point"`),
s is 0.2 on all faces of cells that are not full.
"""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.conditions.acting import Loads
from mpm_dolfinx.forms.point_forms import FacetForm, FacetSum
from mpm_dolfinx.grid.grid import TURN, Grid, across_faces
from mpm_dolfinx.materials.skeleton import Skeleton

GHOST = 0.05
"""Strength of the ghost penalty.  Sensitivity (scene "beam" of tests/plateaus.py): half this value changes the result
by 9.9e-06, and twice this value by 1.9e-05.  Finer cells change it by 1.5e-02.
"""
YIELDING = 0.02
"""Smallest value of the factor that reduces the penalty for nearly incompressible laws with a state.  Sensitivity
(scene "flow" of tests/plateaus.py): half this value changes the result by 6.2e-04, and twice this value by 1.0e-03.
Finer cells change it by 8.5e-02.
"""
RATIO = 0.3
"""If the ratio of the volume fractions of two cells is below this value, their common face has a penalty.

Sensitivity (scene "soil" of tests/plateaus.py): half this value changes the result by 1.3e-03, and twice this value by
5.9e-04. Finer cells change it by 3.0e-02.
"""
SPARSE = 0.2
"""Strength of the penalty for integration at material points.  Sensitivity (scene "points" of tests/plateaus.py): half
this value changes the result by 5.2e-03, and twice this value by 4.2e-03.  Finer cells change it by 9.5e-03.
"""
FULL = 0.9
"""Largest volume fraction of a penalised cell for integration at material points.  Sensitivity (scene "points" of
tests/plateaus.py): half this value changes the result by 5.7e-04, and twice this value by 4.1e-04.  Finer cells change
it by 9.5e-03.
"""


def stiffness(material: Skeleton) -> NDArray[np.float64]:
    """Return the modulus of the penalty, in Pa: 2G, or less for nearly incompressible laws with a state."""
    share = np.minimum(1.0, 4 * material.shear / material.oedometric) ** 2 if material.state else 1.0
    return 2 * np.maximum(YIELDING, share) * material.shear


def kinks(grid: Grid, V: fem.FunctionSpace, strength: ufl.core.expr.Expr, power: int) -> FacetForm:
    """Return the form `int strength h^power [d_n u].[d_n v] dS` over faces, with the cell size h."""
    n = ufl.FacetNormal(grid.mesh)("+")
    *_, across = across_faces(grid, n)
    dS = ufl.Measure("dS", domain=grid.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 2})
    jumps = [ufl.dot(ufl.grad(w)("+") - ufl.grad(w)("-"), n) for w in (ufl.TrialFunction(V), ufl.TestFunction(V))]
    return FacetForm(strength * across**power * ufl.inner(*jumps) * dS, grid.comm)


class GhostPenalty:
    """Form of the ghost penalty, with modulus and volume fraction of the cells as coefficients.

    `V`: space of the displacement.
    `at_points`: whether bodies are integrated at their material points.

    Attributes
    ----------
    modulus
        Mean modulus of the penalty in each cell, Pa.
    shear
        Mean shear modulus in each cell, Pa; zero for laws without a state.
    elastic_shear
        Form of the elastic shear stiffness, for the regularisation of tangents.
    fill, beside
        Volume fraction of each cell, and the largest volume fraction of its neighbours.
    """

    def __init__(self, grid: Grid, V: fem.FunctionSpace, at_points: bool):
        self.grid = grid
        self._at_points = at_points
        cellwise = grid.cellwise()
        self.modulus, self.shear, self.fill, self.beside = (fem.Function(cellwise) for _ in range(4))
        v = ufl.TestFunction(V)
        du = ufl.TrialFunction(V)
        around = TURN * ufl.SpatialCoordinate(grid.mesh)[0] if grid.axisymmetric else ufl.as_ufl(1.0)
        self.form = kinks(grid, V, GHOST / 3 * self._scale() * around("+"), 1)
        dx = ufl.Measure("dx", domain=grid.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 2})
        strains = [ufl.sym(ufl.grad(w)) for w in (du, v)]
        self.elastic_shear = FacetForm(2 * self.fill * self.shear * around * ufl.inner(*strains) * dx, grid.comm)

    def _scale(self):
        """Return the penalty's strength on a face times the mean modulus of both cells, as UFL."""
        fills, moduli, beside = ([f("+"), f("-")] for f in (self.fill, self.modulus, self.beside))
        full, little = ufl.max_value(*fills), ufl.min_value(*fills)
        fullest = ufl.conditional(ufl.lt(*fills), *beside)  # largest volume fraction next to the emptier cell
        strength = ufl.max_value(0.0, 1 - little / (RATIO * full)) * (full / fullest) ** 2
        if self._at_points:
            strength = SPARSE
        return strength * 2 * moduli[0] * moduli[1] / (moduli[0] + moduli[1])

    def set_contents(
        self, own: NDArray[np.int64], volume: NDArray[np.float64], *moduli: NDArray[np.float64]
    ) -> NDArray[np.int64]:
        """Set the volume fractions and moduli of owned cells with material.  Return all active local cells.

        `own` (n,): owned cells that contain material.
        `volume` (n,), in m^d: volume of the material in each cell.
        `moduli`: two arrays (n,), `modulus` times volume and `shear` times volume.
        """
        grid, fill = self.grid, self.fill.x.array
        fill[own] = volume / grid.volumes(own)
        for f, total in zip((self.modulus, self.shear), moduli, strict=True):
            f.x.array[own] = total / volume
        for f in (self.fill, self.modulus):
            f.x.scatter_forward()
        ghosts = grid.num_owned + fill[grid.num_owned :].nonzero()[0]
        neighbours = grid.facet_cells[grid.cell_facets[own]].sum(axis=2) - own[:, None]  # -1 at the grid's boundary
        self.beside.x.array[own] = np.where(neighbours >= 0, fill[neighbours], 0.0).max(axis=1, initial=0.0)
        self.beside.x.scatter_forward()
        return np.concatenate([own, ghosts])

    def on(self, facets: NDArray[np.int32], at_walls: NDArray[np.int32]) -> Loads:
        """Return the penalty on `facets`.  The faces `at_walls` are next to walls of the grid."""
        return GhostLoads(self.form.on(facets), self.form.on(at_walls))

    def facets(self, facets: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the inner faces that have a penalty."""
        fill = self.fill.x.array[self.grid.facet_cells[facets]]
        return facets[fill.min(axis=1) < (FULL if self._at_points else RATIO * fill.max(axis=1))]


class GhostLoads(Loads):
    """Ghost penalty on inner faces of partly filled cells."""

    def __init__(self, everywhere: FacetSum, at_walls: FacetSum):
        self._everywhere, self._at_walls = everywhere, at_walls
        self.some = everywhere.some
        """Whether any process has faces with a penalty."""

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the matrix of the penalty."""
        (self._at_walls if walls else self._everywhere).assemble_matrix(A)
