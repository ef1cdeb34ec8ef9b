# SPDX-License-Identifier: MIT
"""Ghost penalty: nearly empty cells deform as the fuller ones beside them (Burman 2010, Coombs 2023).

gamma s 2G h/3 int [d_n u].[d_n v] dS on the step's increment: cells that are hardly filled then spoil neither the
conditioning nor the answer.  It acts like a viscosity of the step where it acts on what carries the body, so it is
kept from there:

* The strength s of a face falls from 1 to 0 as the emptier cell's share of the fuller one's filling rises to RATIO, and
  with the square of the fuller one's share of the fullest cell's beside the emptier: it leads from full cells to empty
  ones, whose free nodes follow at next to no work.  Faces between alike cells would resist kinks of the body itself.
* Its scale is the shear modulus.  With lambda + 2G nearly empty cells of nearly incompressible bodies would have to
  stretch as the cell beside them does, whatever their own volume asks for; so they would, in soil that flows, with 2G.

Bodies that are integrated at their points have cells with too few points for their nodes anywhere: there all faces of
cells that are not full carry a fifth of the penalty.
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
"""Strength gamma of the ghost penalty.  Plateau (beam): halved 9.9e-06, doubled 1.9e-05, cells 1.5e-02."""
YIELDING = 0.02
"""Least share of it for nearly incompressible laws with a state."""
RATIO = 0.3
"""A cell filled less than this share of a neighbour is nearly empty: faces between the two carry the penalty.

Plateau (soil): halved 1.3e-03, doubled 5.9e-04, cells 3.0e-02.
"""
SPARSE, FULL = 0.2, 0.9
"""Strength where bodies are integrated at their points, and filling below which cells carry it."""


def stiffness(material: Skeleton) -> NDArray[np.float64]:
    """Return the modulus that scales the penalty, Pa: 2G, less of nearly incompressible laws with a state.

    Nearly empty cells of soil that flows keep a volume of their own, at odds with the penalty: with 2G the limit load
    of a footing rises by 0.3 (nu = 0.49) and 0.75 % (0.499) as the penalty does tenfold, by 0.004 % at nu = 0.3.
    There it stays as it is: without it Newton's method fails in frictional soil that is pushed deep.
    """
    share = np.minimum(1.0, 4 * material.shear / material.oedometric) ** 2 if material.state else 1.0
    return 2 * np.maximum(YIELDING, share) * material.shear


def kinks(grid: Grid, V: fem.FunctionSpace, strength: ufl.core.expr.Expr, power: int) -> FacetForm:
    """Return the form int strength h^power [d_n u].[d_n v] dS over faces, h the mean edge of the cells across, m."""
    n = ufl.FacetNormal(grid.mesh)("+")
    *_, across = across_faces(grid, n)
    dS = ufl.Measure("dS", domain=grid.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 2})
    jumps = [ufl.dot(ufl.grad(w)("+") - ufl.grad(w)("-"), n) for w in (ufl.TrialFunction(V), ufl.TestFunction(V))]
    return FacetForm(strength * across**power * ufl.inner(*jumps) * dS, grid.comm)


class GhostPenalty:
    """The form, with modulus and filled share of the cells.

    Parameters
    ----------
    grid
        Background grid.
    V
        Space of the displacement.
    at_points
        Whether bodies are integrated at their points.

    Attributes
    ----------
    modulus
        Scale of the penalty by what the cells hold, Pa, see `stiffness`.
    shear
        Mean over what the cells hold of the shear modulus of laws with a history, Pa, 0 of others.
    firmness
        Form of the elastic shear stiffness over whole cells, times their filled share: what makes tangents firmer.
    fill, beside
        Filled share of each cell, and of the fullest of its neighbours.
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
        self.firmness = FacetForm(2 * self.fill * self.shear * around * ufl.inner(*strains) * dx, grid.comm)

    def _scale(self):
        """Return the strength of a face times its modulus, the harmonic mean of both cells', Pa, as UFL."""
        fills, moduli, beside = ([f("+"), f("-")] for f in (self.fill, self.modulus, self.beside))
        full, little = ufl.max_value(*fills), ufl.min_value(*fills)
        fullest = ufl.conditional(ufl.lt(*fills), *beside)  # beside the emptier one
        strength = ufl.max_value(0.0, 1 - little / (RATIO * full)) * (full / fullest) ** 2
        if self._at_points:
            strength = SPARSE
        return strength * 2 * moduli[0] * moduli[1] / (moduli[0] + moduli[1])

    def set_contents(
        self, own: NDArray[np.int64], volume: NDArray[np.float64], *moduli: NDArray[np.float64]
    ) -> NDArray[np.int64]:
        """Set the contents of the owned cells (n,) that are not empty; return all active local cells, ascending.

        Volumes (n,), m^d, and `modulus` and `shear`, Pa, times volume (n,); `fill` is zero before.
        """
        grid, fill = self.grid, self.fill.x.array
        fill[own] = volume / grid.volumes(own)
        for f, total in zip((self.modulus, self.shear), moduli, strict=True):
            f.x.array[own] = total / volume
        for f in (self.fill, self.modulus):
            f.x.scatter_forward()
        ghosts = grid.num_owned + np.flatnonzero(fill[grid.num_owned :])
        neighbours = grid.facet_cells[grid.cell_facets[own]].sum(axis=2) - own[:, None]  # -1 where there is none
        self.beside.x.array[own] = np.where(neighbours >= 0, fill[neighbours], 0.0).max(axis=1, initial=0.0)
        self.beside.x.scatter_forward()
        return np.concatenate([own, ghosts])

    def on(self, facets: NDArray[np.int32], at_walls: NDArray[np.int32]) -> Loads:
        """Return the penalty on faces of this process, and on those of them in cells that walls hold nodes of."""
        return GhostLoads(self.form.on(facets), self.form.on(at_walls))

    def facets(self, facets: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return those of the inner faces that carry the penalty."""
        fill = self.fill.x.array[self.grid.facet_cells[facets]]
        return facets[fill.min(axis=1) < (FULL if self._at_points else RATIO * fill.max(axis=1))]


class GhostLoads(Loads):
    """The ghost penalty on faces of a cut, on all and on those at walls."""

    def __init__(self, everywhere: FacetSum, at_walls: FacetSum):
        self._everywhere, self._at_walls = everywhere, at_walls

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add its matrix."""
        (self._at_walls if walls else self._everywhere).assemble_matrix(A)
