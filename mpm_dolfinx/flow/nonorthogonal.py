# SPDX-License-Identifier: MIT
"""Non-orthogonal correction of fluxes between cells and through open sides.

Near sides inclined to the grid, the line between the centroids of two cells is not normal to their common face.  The
component of this line along the face is the vector t, of up to half a cell size.  Without a correction, two-point
fluxes would have an error that does not decrease with the cell size.  Let G be the pressure gradient in a cell minus
the unit weight of the fluid.  The corrected flux is (see `storage` for other symbols)

    Q = T [p+ - p- + rho_w g . (x- - x+) - (G+ + G-)/2 . t].

In unsaturated soil, the term with G is a part of the pressure drop along the face (`unsaturated.fitted`).  The
relative conductivity thus limits this term while a cell drains.  The weights of G+ and G- are the volumes of the
material in both cells, times the fixed-stress coefficients.

At an open side, `p - p_out` is replaced by `p - p_out + G . t`.  The centroid is projected onto the side.  Here t
points from this projection to the centre of the face on the side.

The gradients are a least-squares fit to the pressures of neighbouring cells and drained sides, and to zero flow through
other sides.  A neighbour that conducts less than the cell has a smaller weight in the fit.  In unsaturated soil, nearly
empty cells have small weights too, because their pressures vary most.  The fit is exact for linear pressures.
Gradients are limited so that the corrected pressures at faces stay between the pressures of the neighbours.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.flow.fluxes import CellContents, FluxForms, OpenSides
from mpm_dolfinx.forms.point_forms import FacetSum
from mpm_dolfinx.grid.grid import Grid, sum_by

ALONG = 1e-4
"""Fluxes are corrected if the offset of two centroids along the face exceeds this fraction of the cell size.
Sensitivity (scene "clay" of tests/plateaus.py): half this value changes the result by 2.4e-06, and twice this value by
2.5e-06.  Finer cells change it by 1.2e-02.
"""
NEAREST = 0.1
"""Lower bound of distances in the weights of the least-squares fit, divided by the cell size.  Sensitivity (scene
"slope" of tests/plateaus.py): half this value changes the result by 3.0e-08, and twice this value by 1.2e-06.  Finer
cells change it by 3.4e-03."""
SIDES = 2.0
"""Total weight of the open sides of a cell in the least-squares fit, divided by the weight of one neighbour.
Sensitivity (scene "slope" of tests/plateaus.py): half this value changes the result by 4.8e-06, and twice this value by
2.8e-06.  Finer cells change it by 3.4e-03.
"""


def nonorthogonal_facets(contents: CellContents, facets: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the facets that need the non-orthogonal correction."""
    grid = contents.grid
    first, other = grid.facet_cells[facets].T
    offset = contents.centroid[other] - contents.centroid[first]
    h = grid.sizes(first)
    across = np.abs(grid.midpoints[other] - grid.midpoints[first]) > 0.5 * h
    return facets[(np.where(across, 0.0, np.abs(offset) / h) > ALONG).any(axis=1)]


class Gradients:
    """Pressure gradients minus the unit weight of the fluid, in all cells that need the non-orthogonal correction.

    `contents`: material in the cells.
    `sides`: open sides of the bodies.
    `mobility` (c,), m^2/(Pa s): mobility of the local cells, or None if it is equal in all cells or varies in time.
    `fill` (c,): filled fractions of the local cells in unsaturated soil, else None.
    """

    def __init__(
        self,
        contents: CellContents,
        sides: OpenSides,
        mobility: NDArray[np.float64] | None = None,
        fill: NDArray[np.float64] | None = None,
    ):
        self._grid = grid = contents.grid
        d = contents.grid.dim
        centroid = contents.centroid
        share = contents.open
        towards = np.repeat(np.arange(d), 2)
        at = contents.slot(sides.cells)
        tangential = _along(sides)
        neighbours = grid.neighbours(contents.filled)
        cells = np.maximum(neighbours, 0)
        inside = (neighbours >= 0) & (share[contents.filled] > 0)
        for axis, end in np.ndindex(d, 2):
            inside[:, axis, end] &= share[cells[:, axis, end], axis, 1 - end] > 0
        weight = np.ones(inside.shape)
        if mobility is not None:  # series conductance of both cells, divided by its value for equal mobilities
            own, other = mobility[contents.filled][:, None, None], mobility[cells]
            weight = np.minimum(
                1.0, np.divide(2 * other, own + other, out=np.zeros(inside.shape), where=own + other > 0)
            )
        self._open = np.where(inside, weight, 1.0) * share[contents.filled]
        if fill is not None:
            weight = weight * np.minimum(1.0, fill[cells] / fill[contents.filled][:, None, None])
        cells, inside = cells.reshape(-1, 2 * d), inside.reshape(-1, 2 * d)
        separation = centroid[cells] - centroid[contents.filled][:, None]
        along = np.where(inside[:, :, None], separation / 2, 0.0)
        along[:, np.arange(2 * d), towards] = 0.0
        h = grid.sizes(contents.filled)
        off = np.abs(along / h.reshape(-1, 1, d)).max(axis=(1, 2)) > ALONG / 2
        off[at[off_middle(sides, grid)]] = True
        self.rows = rows = np.flatnonzero(off)
        """Indices, among the filled cells, of the cells that need the correction."""
        distance = grid.between(contents.filled[:, None], cells, towards)
        separation[:, np.arange(2 * d), towards] += np.tile([-1, 1], d) * distance
        self._own = contents.filled[rows]
        self._neighbours = cells[rows]
        self._inside = inside[rows]
        self._weight = weight.reshape(-1, 2 * d)[rows]
        self._along, self._separation = along[rows], separation[rows]
        place = np.full(len(off), -1)
        place[rows] = np.arange(len(rows))
        self._faces = np.flatnonzero(off[at])
        self._at = place[at[self._faces]]
        self._tangential = tangential[self._faces]
        self._known = np.flatnonzero(((sides.shape > 0) & ~sides.seeps)[self._faces])
        self._contents, self._sides = contents, sides

    def _no_flow(self, contents: CellContents, sides: OpenSides) -> NDArray[np.float64]:
        """Return the area vectors of no-flow sides in the filled cells, divided by the areas of cell faces."""
        grid = contents.grid
        out = -(self._open[:, :, 1] - self._open[:, :, 0])
        for axis in range(grid.dim):
            area = sum_by(contents.slot(sides.cells), sides.area[:, axis], len(out))
            out[:, axis] -= area * grid.along(contents.filled, axis) / grid.volumes(contents.filled)
        return np.where(np.linalg.norm(out, axis=1, keepdims=True) > ALONG, out, 0.0)

    @cached_property
    def _units(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gradients for a unit pressure difference to each neighbour, and to each open side."""
        known, d = self._known, self._separation.shape[2]
        at, no_flow = self._at[known], self._no_flow(self._contents, self._sides)[self.rows]
        size = np.linalg.norm(self._sides.area, axis=1)[self._faces[known]]
        weight = SIDES * size / sum_by(at, size, len(self.rows))[at]
        offset = self._sides.offset[self._faces[known]]
        near = np.broadcast_to((NEAREST * self._grid.sizes(self._own).min(axis=-1)) ** 2, len(self._own))
        squared = np.maximum((self._separation**2).sum(axis=2), near[:, None])
        to_cells = (self._inside * self._weight)[:, :, None] * self._separation / squared[:, :, None]
        distance = np.einsum("md,md->m", offset, self._sides.normal[self._faces[known]])
        to_sides = (weight / np.maximum(distance**2, near[at]))[:, None] * offset
        size = np.linalg.norm(no_flow, axis=1, keepdims=True)
        closed = np.divide(no_flow, np.sqrt(np.maximum(size, size**2)), out=np.zeros_like(no_flow), where=size > 0)
        A = np.einsum("nki,nkj->nij", to_cells, self._separation) + closed[:, :, None] * closed[:, None, :]
        for i, j in np.ndindex(d, d):
            A[:, i, j] += sum_by(at, to_sides[:, i] * offset[:, j], len(A))
        inverse = np.linalg.pinv(A, rcond=NEAR, hermitian=True)
        return np.einsum("nij,nkj->nki", inverse, to_cells), np.einsum("mij,mj->mi", inverse[at], to_sides)

    def __call__(
        self, p: NDArray[np.float64], outer: NDArray[np.float64], weight: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return the pressure gradients (k, d) in the k cells `rows`, minus the unit weight of the fluid, in Pa/m.

        `p` (c,), Pa: pressures of all local cells.
        `outer` (m,), Pa: pressures outside the open sides.
        `weight` (d,), N/m^3: unit weight of the fluid, or None without gravity.
        """
        of_cells, of_sides = self._units
        own, at = p[self._own], self._at[self._known]
        to_cells = p[self._neighbours] - own[:, None]
        to_sides = outer[self._faces[self._known]] - own[at]
        if weight is not None:
            to_cells = to_cells - self._separation @ weight
            to_sides = to_sides - self._sides.offset[self._faces[self._known]] @ weight
        to_cells = np.where(self._inside, to_cells, 0.0)
        out = np.einsum("nk,nki->ni", to_cells, of_cells)
        for axis in range(out.shape[1]):
            out[:, axis] += sum_by(at, to_sides * of_sides[:, axis], len(out))
        to_cells = self._weight * to_cells
        low, high = to_cells.min(axis=1, initial=0.0), to_cells.max(axis=1, initial=0.0)
        np.minimum.at(low, at, to_sides)
        np.maximum.at(high, at, to_sides)
        increment = np.einsum("nd,nkd->nk", out, self._along)
        share, slack = np.ones(len(out)), NEAR * (high - low)  # allows rounding of nearly uniform pressures
        for bound, most in ((-low, -increment.min(axis=1)), (high, increment.max(axis=1))):
            bound = bound + slack
            share = np.minimum(share, np.divide(bound, most, out=np.ones(len(out)), where=most > bound))
        return out * share[:, None]

    def through_sides(self, slope: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """Return the correction (count,) of the cell pressure at each open face, in Pa."""
        out = np.zeros(count)
        out[self._faces] = np.einsum("md,md->m", self._tangential, slope[self._at])
        return out


class NonorthogonalFlow(NamedTuple):
    """Non-orthogonal correction of the two-point fluxes."""

    forms: FluxForms
    facets: FacetSum  # form over the faces of `nonorthogonal_facets`
    gradients: Gradients
    contents: CellContents  # material in the cells
    sides: OpenSides  # open sides of the bodies
    weight: NDArray[np.float64] | None  # unit weight of the fluid (d,), N/m^3; None without gravity

    def __call__(self, p: NDArray[np.float64], bulk: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the additional outflows (n,) from filled cells, and the corrections (m,) of pressures at open sides.

        The outflows are in m^d/s, and the corrections in Pa.

        `p` (c,), Pa: pressures of the local cells.
        `bulk`, Pa: bulk modulus of the fluid.
        """
        slope = self.gradients(p, self.sides.pressure, self.weight)
        through = self.gradients.through_sides(slope, len(self.sides.cells))
        filled, active = self.contents.filled, self.contents.active
        if not self.facets.some:
            return np.zeros(len(filled)), through
        density = np.exp(p[active] / bulk)
        outflow = self.forms.along(slope, filled[self.gradients.rows], self.facets, active, density)
        return outflow[filled], through


def off_middle(sides: OpenSides, grid: Grid) -> NDArray[np.bool_]:
    """Return a mask (m,) of open faces that need the non-orthogonal correction."""
    faces, at = np.unique(sides.number * grid.num_local + sides.cells, return_inverse=True)
    size, off = np.sqrt(np.add.reduce(sides.area**2, axis=1)), _along(sides) / grid.sizes(sides.cells)
    mean = sum_by(at, (size[:, None] * off).T, len(faces)) / sum_by(at, size, len(faces))
    return (np.abs(mean) > ALONG).any(axis=0)[at]


def _along(sides: OpenSides) -> NDArray[np.float64]:
    """Return vectors along faces: from the cell's centroid, projected onto the face, to the centre of the face."""
    return sides.offset - np.add.reduce(sides.offset * sides.normal, axis=1, keepdims=True) * sides.normal
