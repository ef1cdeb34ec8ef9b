# SPDX-License-Identifier: MIT
"""Two-point fluxes of the pore fluid between cells, through what the bodies cover of the faces, and their damping.

The coefficients of the forms are what cells hold, set anew whenever the grid is reset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.forms.point_forms import FacetForm
from mpm_dolfinx.points.grid import Grid, sum_by


@dataclass(frozen=True)
class OpenSides:
    """Open sides of the bodies: owned cell behind each face (m,), conductance (m^d/(Pa s)) and inflow (m^d/s).

    conductance: outflow per unit of the cell's pressure; inflow: prescribed, or driven in by an outer
    pressure and gravity.
    """

    cells: NDArray[np.int32]
    conductance: NDArray[np.float64]
    inflow: NDArray[np.float64]


@dataclass(frozen=True)
class PieceContents:
    """What pieces bring to their owned cells; arrays over m pieces.

    cells (m,); weight: volumes, m^d; x (m, d): centroids, m; mobility kappa, m^2/(Pa s); faces (m, d, 2): areas on
    the lower and upper faces of the cell, m^(d-1); fixed_stress: the coefficient beta, 1/Pa; damping: the strength
    tau of the damping of pressure jumps, 1/Pa.
    """

    cells: NDArray[np.int32]
    weight: NDArray[np.float64]
    x: NDArray[np.float64]
    mobility: NDArray[np.float64]
    faces: NDArray[np.float64]
    fixed_stress: NDArray[np.float64]
    damping: NDArray[np.float64]


class CellContents:
    """What the cells hold since the grid was reset; arrays over local cells, ghosts included, zero where empty.

    Parameters
    ----------
    forms
        The forms, whose coefficients are set.
    pieces
        What the pieces bring.
    filled
        Owned active cells.
    """

    def __init__(self, forms: FluxForms, pieces: PieceContents, filled: NDArray[np.int64]):
        grid = forms.grid
        self.filled, self._slot = filled, np.zeros(grid.num_local, dtype=np.int64)
        self._slot[filled] = np.arange(len(filled))
        cells, weight = pieces.cells, pieces.weight
        volume = self.total(cells, weight)
        self.volume = volume.sum()
        """Volume of all that this process's cells hold, m^d."""
        shapes = (forms.centroid, forms.lower_face, forms.upper_face)
        for f in (forms.mobility, forms.damping, forms.fixed_stress, *shapes):
            f.x.array[:] = 0.0
        values = {forms.mobility: self.total(cells, weight * pieces.mobility) / volume}
        values[forms.damping] = self.total(cells, weight * pieces.damping) / volume
        values[forms.fixed_stress] = self.total(cells, weight * pieces.fixed_stress)
        for f, rows in values.items():
            f.x.array[filled] = rows
        centroid, lower, upper = (f.x.array.reshape(-1, grid.dim) for f in shapes)
        for a in range(grid.dim):
            centroid[filled, a] = self.total(cells, weight * pieces.x[:, a]) / volume - grid.midpoints[filled, a]
            for target, end in ((lower, 0), (upper, 1)):
                target[filled, a] = self.total(cells, pieces.faces[:, a, end]) * grid.h[a] / grid.cell_volume
        for f in (*values, *shapes):
            f.x.scatter_forward()
        self.mobility, self.damping, self.fixed_stress = (f.x.array.copy() for f in values)
        """Mobility kappa, m^2/(Pa s); strength tau of the damping, 1/Pa; fixed-stress coefficient times volume."""
        self.centroid, self.open = centroid.copy(), np.stack([lower, upper], axis=2)
        """Centroids (c, d) of what the cells hold from their midpoints, m; open shares of their faces (c, d, 2)."""

    def total(self, cells: NDArray[np.int32], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum values over the rows of each filled cell."""
        return sum_by(self._slot[cells], values, len(self.filled))

    def slot(self, cells: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the places of cells among the filled ones."""
        return self._slot[cells]


class FluxForms:
    """The forms over the faces between active cells, and their coefficients.

    Parameters
    ----------
    grid
        Background grid.
    weight : (d,), N/m^3
        Weight of the pore fluid rho_w g as UFL, None without gravity.
    flows
        Whether anything conducts; without, there are no fluxes.
    """

    def __init__(self, grid: Grid, weight: ufl.core.expr.Expr | None, flows: bool):
        self.grid, mesh, d, Q = grid, grid.mesh, grid.dim, grid.cellwise()
        q, dp = ufl.TestFunction(Q), ufl.TrialFunction(Q)
        self.mobility, self.damping, self.fixed_stress = (fem.Function(Q) for _ in range(3))
        self.centroid, self.lower_face, self.upper_face = (fem.Function(grid.cellwise((d,))) for _ in range(3))
        n, h = ufl.FacetNormal(mesh), fem.Constant(mesh, grid.h)
        n0 = n("+")
        across = sum(abs(n0[a]) * h[a] for a in range(d))

        def opening(side, sign):
            """Share of the face that the body covers, on the side of the cell that sign * n0 points to."""
            lower, upper = self.lower_face(side), self.upper_face(side)
            return sum(
                ufl.conditional(ufl.gt(sign * n0[a], 0.5), upper[a], 0.0)
                + ufl.conditional(ufl.lt(sign * n0[a], -0.5), lower[a], 0.0)
                for a in range(d)
            )

        share = ufl.min_value(opening("+", 1), opening("-", -1))
        d0 = across / 2 - ufl.dot(self.centroid("+"), n0)
        d1 = across / 2 + ufl.dot(self.centroid("-"), n0)
        k0, k1 = self.mobility("+"), self.mobility("-")
        T = share * k0 * k1 / (d0 * k1 + d1 * k0 + 1e-300)
        dS = ufl.Measure("dS", domain=mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 0})
        self.flux = FacetForm(T * ufl.jump(dp) * ufl.jump(q) * dS, grid.comm) if flows else None
        self.dt = fem.Constant(mesh, 0.0)
        damped = ufl.max_value(ufl.avg(self.damping) * share * (d0 + d1) - self.dt * T, 0.0)
        self.damp = FacetForm(damped * ufl.jump(dp) * ufl.jump(q) * dS, grid.comm)
        smaller = ufl.min_value(self.fixed_stress("+"), self.fixed_stress("-"))
        volume = fem.Constant(mesh, grid.cell_volume)  # not a number: each would be compiled anew
        self.alternation = FacetForm(smaller / (4 * d) * across / volume * ufl.jump(dp) * ufl.jump(q) * dS, grid.comm)
        self.gravity = None
        if weight is not None and flows:
            apart = across * n0 + self.centroid("-") - self.centroid("+")
            self.gravity = FacetForm(T * ufl.dot(weight, apart) * ufl.jump(q) * dS, grid.comm)
