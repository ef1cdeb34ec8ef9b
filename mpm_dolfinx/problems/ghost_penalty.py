# SPDX-License-Identifier: MIT
"""Ghost penalty: jumps of the normal derivative on faces of partly filled cells (Burman 2010, Coombs 2023).

gamma M h/3 int [d_n u].[d_n v] dS, M = lambda + 2G, on the step's increment only: cells that are hardly filled
then spoil neither the conditioning nor the answer.
"""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.forms.point_forms import FacetForm
from mpm_dolfinx.points.grid import Grid

GHOST = 1e-2
"""Strength gamma of the ghost penalty; 1e-3 to 1/30 changes the beam's tip by 1e-5."""
FULL = 0.9
"""A cell filled less than this is partly filled: its faces carry the ghost penalty."""


class GhostPenalty:
    """The form, with the modulus M (Pa) and the filled share of the cells.

    Parameters
    ----------
    grid
        Background grid.
    V
        Space of the displacement.
    """

    def __init__(self, grid: Grid, V: fem.FunctionSpace):
        self.grid, cellwise = grid, grid.cellwise()
        self.modulus, self.fill = fem.Function(cellwise), fem.Function(cellwise)
        v, du, n = ufl.TestFunction(V), ufl.TrialFunction(V), ufl.FacetNormal(grid.mesh)
        h = fem.Constant(grid.mesh, grid.h)
        across = sum(abs(n("+")[a]) * h[a] for a in range(grid.dim))
        dS = ufl.Measure("dS", domain=grid.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 2})

        def kink(w):
            return ufl.dot(ufl.grad(w)("+") - ufl.grad(w)("-"), n("+"))

        form = GHOST / 3 * ufl.avg(self.modulus) * across * ufl.inner(kink(du), kink(v)) * dS
        self.form = FacetForm(form, grid.comm)

    def set_contents(self, volume: NDArray[np.float64], stiffness: NDArray[np.float64]) -> None:
        """Set volumes (cells,), m^d, of what the owned cells hold, and their oedometric moduli times volume."""
        self.fill.x.array[:] = volume / self.grid.cell_volume
        self.modulus.x.array[:] = np.divide(stiffness, volume, out=np.zeros_like(stiffness), where=volume > 0)
        for f in (self.fill, self.modulus):
            f.x.scatter_forward()

    def facets(self, facets: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return those of the inner faces that belong to a partly filled cell."""
        return facets[(self.fill.x.array < FULL)[self.grid.facet_cells[facets]].any(axis=1)]
