# SPDX-License-Identifier: MIT
"""Two-point fluxes of the pore fluid between cells, and damping of pressure jumps.

A flux passes through the part of a cell face that material covers.  Fluxes through the deformed cells are pulled back
to the start of the step.  The mobility kappa of a cell is its conductivity divided by the unit weight of the fluid.
With `F = I + grad u` at the centroid of the material and `J = det F`, the pulled-back mobility is `J F^-1 kappa F^-T`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from math import prod
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.caching import Keyed
from mpm_dolfinx.base.fluid_content import density_between, mass_potential, mean_density
from mpm_dolfinx.base.tolerances import ROUND_OFF, TINY
from mpm_dolfinx.forms.point_forms import FacetForm, FacetSum
from mpm_dolfinx.forms.unknowns import sum_ghosts
from mpm_dolfinx.grid.grid import Grid, across_faces, sum_by
from mpm_dolfinx.points.active import Active
from mpm_dolfinx.points.material_points import cofactor, determinant

THICK = np.sqrt(2)
"""Area of the largest plane section of a cube, divided by the area of a face.  Source: exact bound (Ball 1986).

Let V be the volume of a convex body inside a cell of edge length h.  A plane outside this body has a distance of at
least `V / ((d + 1) THICK h^(d-1))` from the centroid of the body.  This bound replaces smaller distances of faces.
"""
ALONG = 0.1
"""A drained side determines the pressure slope along axes on which its unit normal has a component above this value.
Sensitivity (scene "beam" of tests/plateaus.py): half this value changes the result by 9.9e-11, and twice this value by
8.7e-11. Finer cells change it by 1.4e-02.
"""


@dataclass(frozen=True)
class Mobility:
    """Mobility of the n filled owned cells.  `mean` and `share` are for saturated pores, also in unsaturated soil."""

    mean: NDArray[np.float64]  # mean over the pieces (n,), m^2/(Pa s)
    share: NDArray[np.float64] | None = None  # mobility along each axis divided by `mean` (n, d); None if all are 1
    # vector from the centroid to the pressure position of the cell (see `layers`) (n, d), m; None without mixed cells
    shift: NDArray[np.float64] | None = None
    # fractions of the mean that come from soil without a retention curve, and from soil of each curve (n, k)
    shares: NDArray[np.float64] | None = None
    paths: Any = None  # flow paths of mixed cells, see `series`
    borders: Any = None  # faces between cells of different soil


class CellMotion(NamedTuple):
    """Motion of n cells in a step."""

    F: NDArray[np.float64]  # deformation gradient (n, d, d)
    cofactors: NDArray[np.float64]  # cofactor matrix of F (n, d, d)
    ratio: NDArray[np.float64]  # determinant of F (n,)
    moved: NDArray[np.float64]  # displacement (n, d), m
    hoop: NDArray[np.float64] | None  # circumferential stretch (n,); None unless axisymmetric


class Conduction(NamedTuple):
    """Conductivity and motion of the filled owned cells."""

    mobility: Mobility
    motion: CellMotion | None  # motion of the centroids in the step; None for bodies that hardly move
    weight: NDArray[np.float64] | None  # unit weight of the fluid (d,), N/m^3; None without gravity
    bulk: float  # bulk modulus of the fluid, Pa
    relative: Any = None  # relative conductivities, see `unsaturated.Relative`

    def along(self, dim: int) -> NDArray[np.float64]:
        """Return the mobilities (n, d) along the axes, pulled back to the start of the step."""
        kappa, share = self.mobility.mean[:, None], self.mobility.share
        kappa = kappa.repeat(dim, axis=1) if share is None else kappa * share
        if self.motion is None:
            return kappa
        _, cofactors, ratio, _, hoop = self.motion
        along = kappa / ratio[:, None] * np.add.reduce(cofactors**2, axis=1)
        return along if hoop is None else along * hoop[:, None]

    def across(self, at: NDArray[np.int64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pulled-back mobilities `n . J F^-1 kappa F^-T n` (m,) of cells `at` along normals n (m, d)."""
        kappa, share = self.mobility.mean[at], self.mobility.share
        if share is not None:
            kappa = kappa * (share[at] * normal**2).sum(axis=1)
        if self.motion is None:
            return kappa
        _, cofactors, ratio, _, hoop = self.motion
        pulled = cofactors[at] @ normal[:, :, None]
        across = kappa / ratio[at] * np.add.reduce(pulled**2, axis=(1, 2))
        return across if hoop is None else across * hoop[at]

    def stretch(self, at: NDArray[np.int64], normal: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """Return the areas (m,) of faces in cells `at`, divided by areas at the start of the step.

        `normal` (m, d): normals of the faces.
        """
        if self.motion is None:
            return 1.0
        area = np.linalg.norm((self.motion.cofactors[at] @ normal[:, :, None])[:, :, 0], axis=1)
        return area if self.motion.hoop is None else area * self.motion.hoop[at]

    def distance_ratio(self, at: NDArray[np.int64], normal: NDArray, offset: NDArray) -> NDArray[np.float64]:
        """Return distances (m,) of faces from the centroid, divided by distances from the pressure position (`layers`).

        `normal` (m, d): normals of the faces.
        `offset` (m, d), m: vectors from the centroids to the faces.
        """
        distance = (offset * normal).sum(axis=1)
        shifted = distance - (self.mobility.shift[at] * normal).sum(axis=1)
        return np.divide(distance, shifted, out=np.ones(len(distance)), where=shifted > 0)

    def density(self, p: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean relative densities (m,) of fluid between two pressures (m,), Pa, see `fluid_content`."""
        return mean_density(p, other, self.bulk)

    def deformed(self, at: NDArray[np.int64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Multiply vectors (m, d) in cells `at` by the deformation gradients of these cells."""
        return vector if self.motion is None else (self.motion.F[at] @ vector[:, :, None])[:, :, 0]


@dataclass(frozen=True)
class OpenSides:
    """Open sides of the bodies.  Arrays have an entry for each of m faces.  Each face belongs to one owned cell."""

    number: NDArray[np.int64]  # index of the condition (m,)
    cells: NDArray[np.int32]  # cell behind the face (m,)
    shape: NDArray[np.float64]  # area divided by distance to the cell's centroid, 0 for prescribed inflow (m,), m^(d-2)
    pressure: NDArray[np.float64]  # pressure outside (m,), Pa
    given: NDArray[np.float64]  # prescribed inflow (m,), m^d/s
    seeps: NDArray[np.bool_]  # whether fluid can only leave (m,)
    area: NDArray[np.float64]  # outward area vector (m, d), m^(d-1)
    offset: NDArray[np.float64]  # vector from the cell's centroid to the face (m, d), m
    rain: NDArray[np.float64]  # rain (m,), m^d/s; nan without rain
    driest: NDArray[np.float64]  # lowest pressure outside (m,), Pa; nan without rain

    @classmethod
    def joined(cls, several: Sequence[OpenSides], dim: int) -> OpenSides:
        """Return the faces of several open sides as one object."""
        if len(several) == 1:
            return several[0]
        none, vectors = np.empty(0), np.empty((0, dim))
        indices = none.astype(int), none.astype(np.int32)
        empty = cls(*indices, none, none, none, none.astype(bool), vectors, vectors, none, none)
        return cls(*(np.concatenate([getattr(one, f.name) for one in (empty, *several)]) for f in fields(cls)))

    @cached_property
    def normal(self) -> NDArray[np.float64]:
        """Outward unit normals (m, d)."""
        return self.area / np.sqrt(np.add.reduce(self.area**2, axis=1, keepdims=True))

    def driven(self, at: NDArray[np.int64], flow: Conduction) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return c (m,), m^d/(Pa s), and q (m,), m^d/s, for the outflow `c pi - q` with the cell's mass potential pi.

        `at` (m,): index of the cell of each face among the filled cells.
        """
        shape = self.shape
        if flow.mobility.shift is not None:
            shape = shape * flow.distance_ratio(at, self.normal, self.offset)
        conductance = flow.across(at, self.normal) * shape
        return conductance, self.given + conductance * self.outer(at, flow)

    def outer(self, at: NDArray[np.int64], flow: Conduction) -> NDArray[np.float64]:
        """Return the mass potentials (m,), Pa, of outside pressures, reduced to the heights of the cells' centroids."""
        outer = self.pressure if flow.weight is None else self.pressure - flow.deformed(at, self.offset) @ flow.weight
        return mass_potential(outer, flow.bulk)

    def ahead(self, at: NDArray[np.int64], p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pressure differences (Pa) and slopes (Pa/m) from cells to drained sides.

        The result (n, d, 2, 2) has the indices cell, axis, end of the cell, and 0 for the difference or 1 for the
        slope.  Ends without a drained side have the placeholder nan.

        `at` (m,): index of the cell of each face among the filled cells.
        `p` (n,), Pa: pressures of the filled cells.
        """
        out = np.full((len(p), self.normal.shape[1], 2, 2), np.nan)
        distance = np.add.reduce(self.offset * self.normal, axis=1)
        # prescribed inflows have no conductance; closed seepage faces have no pressure
        drained = ((self.shape > 0) & (distance > 0) & ~(self.seeps & (p[at] <= self.pressure))).nonzero()[0]
        at = at[drained]
        normal = self.normal[drained]
        distance = distance[drained]
        area, jump = self.shape[drained] * distance, self.pressure[drained] - p[at]
        cosine = normal[:, :, None] * [-1, 1]
        row, axis, end = (cosine > ALONG).nonzero()
        share = area[row] * cosine[row, axis, end]
        # the pressure is constant along the side, so the pressure gradient is normal to the side
        values = share * [jump[row], (jump / distance)[row] * normal[row, axis]]
        whole, *sums = sum_by((at[row] * out.shape[1] + axis) * 2 + end, np.array([share, *values]), out[..., 0].size)
        out.reshape(-1, 2)[whole > 0] = np.transpose(sums)[whole > 0] / whole[whole > 0, None]
        return out


@dataclass(frozen=True)
class PieceContents:
    """Data of m pieces of particle domains in owned cells."""

    cells: NDArray[np.int32]  # owned cell (m,)
    weight: NDArray[np.float64]  # volume (m,), m^d
    area: NDArray[np.float64]  # volume (m,), m^d; in axisymmetry the area of the section, m^2
    x: NDArray[np.float64]  # centroid (m, d), m; in axisymmetry of the section
    faces: NDArray[np.float64]  # areas on the lower and upper faces of the cell (m, d, 2), m^(d-1)
    fixed_stress: NDArray[np.float64]  # fixed-stress coefficient beta (m,), 1/Pa
    damping: NDArray[np.float64]  # strength tau of the damping of pressure jumps (m,), 1/Pa


class CellContents(Keyed):
    """Material in the cells, at the last grid reset.  Arrays over local cells are valid in active cells only.

    `forms`: forms whose coefficients this class sets.  `pieces`: data of the pieces.
    `filled`: owned active cells.
    """

    def __init__(self, forms: FluxForms, pieces: PieceContents, filled: NDArray[np.int64]):
        self.grid = grid = forms.grid
        self.active = active = forms.active.now.cells
        """Owned active cells and active ghost cells."""
        self.filled, self.nodes = filled, grid.cell_nodes[filled]
        """Filled owned cells (n,), and their nodes (n, 2^d)."""
        self._slot = forms.active.slot
        self._slot[filled] = np.arange(len(filled))
        self.weight, self.area = pieces.weight, pieces.area
        """`weight` (m,): volumes of pieces, m^d.  `area` (m,): `weight`, or in axisymmetry areas of sections, m^2."""
        self._at, d = self._slot[pieces.cells], grid.dim
        rows = [self.weight, self.area, *(self.weight * [pieces.fixed_stress, pieces.damping])]
        rows = [rows, (self.area[:, None] * pieces.x).T, pieces.faces.reshape(len(self.area), 2 * d).T]
        self.volume, area, self.fixed_stress, damping, *sums = self.total(np.concatenate(rows))
        """`volume` (n,): material in filled cells, m^d.  `fixed_stress` (n,): integral of beta in each cell, m^d/Pa."""
        self.fill = np.minimum(area / grid.volumes(filled), 1.0)
        """Volume fractions (n,) of material in the filled cells."""
        shapes = (forms.centroid, forms.lower_face, forms.upper_face)
        self._damped, self._damping = forms.damping.x, damping / self.volume
        forms.fixed_stress.x.array[filled] = self.fixed_stress
        centroid, lower, upper = (f.x.array.reshape(-1, d) for f in shapes)
        centroid[filled] = (sums[:d] / area).T - grid.midpoints[filled]
        rounding = np.reshape(ROUND_OFF * grid.around(grid.midpoints[filled]), (-1, 1))
        for target, faces in ((lower, sums[d::2]), (upper, sums[d + 1 :: 2])):
            share = np.transpose(faces) * grid.sizes(filled) / np.array(grid.volumes(filled)).reshape(-1, 1)
            target[filled] = np.where(share > rounding, share, 0.0)  # rounding errors open no face
        for f in (forms.fixed_stress, *shapes):
            f.x.scatter_forward()
        at = grid.midpoints[filled] + centroid[filled]
        self._unit = np.eye(d)
        shapes = [grid.shape_gradients(filled, at), grid.shape_values(filled, at)[:, :, None]]
        self._shapes = np.concatenate(shapes, axis=2)
        self.centroid, self.open = forms.active.centroid, forms.active.opening
        self.centroid[active] = centroid[active]
        self.open[active, :, 0], self.open[active, :, 1] = lower[active], upper[active]
        """Fractions (c, d, 2) of the cell faces that material covers."""

    def total(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (..., n) of values (..., m) over the pieces of each filled cell."""
        return sum_by(self._at, values, len(self.filled))

    def softest(self, softness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the largest `softness` (see `StorageProblem`) of the pieces in each filled cell, at least 1."""
        softest = np.ones(len(self.filled))
        np.maximum.at(softest, self._at, softness)
        return softest

    def set_damping(
        self, share: NDArray[np.float64] | float = 1.0, less: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.float64]:
        """Set the damping strength of elastic soil in filled cells to `share * tau - less`, at least 0, and return it.

        `share` (n,): factor.
        `less` (n,), 1/Pa: storage due to changes of saturation.
        """
        values = np.maximum(share * self._damping - less, 0.0)
        self._damped.array[self.filled] = values
        self._damped.scatter_forward()
        return values

    def mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the volume-weighted mean (n,) of the values (m,) of the pieces in each filled cell."""
        return self.total(self.weight * values) / self.volume

    def motion(self, nodal: NDArray[np.float64], rests: NDArray[np.int64] | None = None) -> CellMotion:
        """Return the motion of filled cells, at the centroids of their material.

        `nodal` (n, 2^d, d), in m: displacements of the nodes of each cell.
        `rests`: indices of filled cells that do not move.
        """
        hoop, d = None, self.grid.dim
        at_centroids = nodal.transpose(0, 2, 1) @ self._shapes
        F, moved = self._unit + at_centroids[:, :, :d], at_centroids[:, :, d].copy()
        if self.grid.axisymmetric:
            hoop = 1 + moved[:, 0] / (self.grid.midpoints[self.filled, 0] + self.centroid[self.filled, 0])
        if rests is not None:
            F[rests], moved[rests] = self._unit, 0.0
            if hoop is not None:
                hoop[rests] = 1.0
        return CellMotion(F, cofactor(F), determinant(F), moved, hoop)

    def shapes(
        self, cells: NDArray[np.int32], x: NDArray[np.float64], area: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the areas (m,), offsets (m, d) and shapes (m,) of faces in owned cells.

        Offsets, in m, are vectors from the centroid of the cell's material to the face.  Shapes, in m^(d-2), are areas
        divided by the distances from the centroids.

        `x` (m, d), m: positions of the faces.
        `area` (m, d), m^(d-1): outward area vectors.
        """
        grid = self.grid
        size, offset = np.linalg.norm(area, axis=1), x - grid.midpoints[cells] - self.centroid[cells]
        least = self.fill[self.slot(cells)] * grid.sizes(cells).min(axis=-1) / THICK / (grid.dim + 1)
        normal = area / size[:, None]
        distance = np.add.reduce(offset * normal, axis=1)
        shape = size / np.maximum(distance, least)
        if grid.axisymmetric:  # uses the circumference half-way to the centroid
            shape = shape * (1 - distance * normal[:, 0] / (2 * x[:, 0]))
        return size, offset, shape

    @property
    def shape_values(self) -> NDArray[np.float64]:
        """Values (n, 2^d) of the shape functions at the centroids of material in filled cells."""
        return self._shapes[:, :, -1]

    def slot(self, cells: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the index of each cell among the filled cells."""
        return self._slot[cells]


@dataclass(frozen=True)
class HalfFaces:
    """One side of each of m faces, on the process that owns the cell on this side.

    `contents`: material in the cells.
    `cells` (m,): local cells.
    `x` (m, d), m: positions of the faces at the last reset of the grid.
    `area` (m, d), m^(d-1): outward area vectors.
    """

    contents: CellContents
    cells: NDArray[np.int32]
    x: NDArray[np.float64]
    area: NDArray[np.float64]

    @cached_property
    def at(self) -> NDArray[np.int64]:
        """Index (m,) of each face's cell among the filled cells."""
        return self.contents.slot(self.cells)

    @cached_property
    def _shapes(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        return self.contents.shapes(self.cells, self.x, self.area)

    @cached_property
    def side(self) -> OpenSides:
        """The faces as open sides, for the non-orthogonal correction."""
        none, unknown = np.zeros(len(self.at)), np.full(len(self.at), np.nan)
        number, seeps = none.astype(np.int64), none.astype(bool)
        offset = self._shapes[1]
        return OpenSides(number, self.cells, none, none, none, seeps, self.area, offset, unknown, unknown)

    def rows(
        self, flow: Conduction, p: NDArray[np.float64], force: Callable[[NDArray[np.int64]], NDArray[np.float64]] | None
    ) -> NDArray[np.float64]:
        """Return data of the cell at each face, as rows.

        The entries are pressure (Pa), centroid (m), weight and inertia force on the fluid (N/m^3), pressure drop to the
        face (Pa), and conductances (m^d/(Pa s)).  Unsaturated soil has one conductance for each retention curve.

        `p` (n,), Pa: pressures of the filled cells.
        `force`: see `Fluid`.
        """
        contents, d = self.contents, self.area.shape[1]
        size, offset, shape = self._shapes
        normal = self.area / size[:, None]
        if flow.mobility.shift is not None:
            shape = shape * flow.distance_ratio(self.at, normal, offset)
        x = contents.grid.midpoints[self.cells] + contents.centroid[self.cells]
        if flow.motion is not None:
            x = x + flow.motion.moved[self.at]
        pull = np.zeros((len(shape), d)) if flow.weight is None else np.broadcast_to(flow.weight, (len(shape), d))
        if force is not None:
            pull = pull + force(self.at)
        drop = (flow.deformed(self.at, offset) * pull).sum(axis=1)
        conductance = (flow.across(self.at, normal) * shape)[:, None]
        if flow.relative is not None:
            conductance = conductance * flow.mobility.shares[self.at]
        return np.column_stack([p[self.at], x, pull, drop, conductance])

    def total(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (..., n) of values (..., m) over the faces of each filled cell."""
        return sum_by(self.at, values, len(self.contents.filled))


class Face:
    """Geometry of a face between two active cells as UFL.  The normal points from the first cell "+" to the second.

    `centroid` (d,), m: centroid of the material in each cell, relative to the centre of the cell.
    `lower`, `upper` (d,): fractions of the lower and upper faces of each cell that material covers.  In axisymmetry
    they include the circumference.
    """

    def __init__(self, grid: Grid, centroid: fem.Function, lower: fem.Function, upper: fem.Function):
        self.normal = n = ufl.FacetNormal(grid.mesh)("+")
        h0, h1, self.across = across_faces(grid, n)
        self.edges = h0, h1
        """Edge lengths, in m, of both cells along the normal."""
        self.distances = h0 / 2 - ufl.dot(centroid("+"), n), h1 / 2 + ufl.dot(centroid("-"), n)
        """Distances, in m, from the centroids to the face."""
        off = ufl.jump(centroid)
        self.lateral = off - ufl.dot(off, n) * n
        """Difference of the two centroids in the plane of the face, in m."""

        def covered(side: str, sign: int):
            """Return the fraction of the face that the material of one cell covers."""
            return sum(
                ufl.conditional(ufl.gt(sign * n[a], 0.5), upper(side)[a], 0.0)
                + ufl.conditional(ufl.lt(sign * n[a], -0.5), lower(side)[a], 0.0)
                for a in range(grid.dim)
            )

        self.share = ufl.min_value(covered("+", 1), covered("-", -1))
        """Fraction of the face that the material of both cells covers."""
        h = grid.edge_in_forms()("+")
        self.volume = prod(h[a] for a in range(grid.dim))  # divided by h0, this is the area of the face on both sides

    def mean(self, force: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        """Return the mean of an inertia force over two cells, as for the mass: weights 1/6, 2/3, 1/6 of three nodes.

        With the value at the face, freely flowing water would have more mass than all of the soil in modes that
        alternate between nodes.
        """
        (h0, h1), of = self.edges, [ufl.dot(ufl.grad(force)(side), self.normal) for side in "+-"]
        return ufl.avg(force) - (h0**2 * of[0] - h1**2 * of[1]) / (3 * (h0 + h1))


class FluxForms:
    """Compiled forms over the faces between active cells, and their coefficients.

    `weight` (d,), N/m^3: unit weight rho_w g of the pore fluid, as UFL, or None without gravity.
    `flows`: whether any material is permeable.
    `pressure`: pore pressure of the cells (DG0), Pa.
    `bulk`: bulk modulus of the fluid, Pa.
    `inertial`: `InertiaForms.moved`, and the inertia force (d,) on the pore fluid, in N/m^3; None without inertia.
    `relative`: relative conductivities in unsaturated soil, see `unsaturated`, or None.
    """

    def __init__(
        self,
        grid: Grid,
        active: Active,
        weight: ufl.core.expr.Expr | None,
        flows: bool,
        pressure: fem.Function,
        bulk: float,
        inertial: tuple[fem.Function, ufl.core.expr.Expr] | None = None,
        relative: Any = None,
    ):
        self.grid = grid
        self.relative = relative
        mesh = grid.mesh
        d = grid.dim
        Q = grid.cellwise()
        q, dp = ufl.TestFunction(Q), ufl.TrialFunction(Q)
        self.active = active
        self.damping, self.fixed_stress = (fem.Function(Q) for _ in range(2))
        vectors = (fem.Function(grid.cellwise((d,))) for _ in range(6))
        self.mobility, self.moved, self.centroid, self.lower_face, self.upper_face, self.slope = vectors
        face = Face(grid, self.centroid, self.lower_face, self.upper_face)
        n = face.normal
        d0, d1 = face.distances
        k0, k1 = (sum(abs(n[a]) * self.mobility(side)[a] for a in range(d)) for side in "+-")
        offset = face.across * n - ufl.jump(self.centroid + self.moved)
        by_motion = None
        if inertial is not None:
            moved, force = inertial
            inertia = face.mean(force)
            weight = inertia if weight is None else weight + inertia
            by_motion = ufl.derivative(inertia, moved, ufl.TrialFunction(moved.function_space))
        drop = 0.0 if weight is None else ufl.dot(weight, offset)
        slope = ufl.avg(self.slope)
        if relative is not None:  # nearly empty cells, whose pressures vary most, have small weights
            slope = ufl.avg(self.fixed_stress * self.slope) / (ufl.avg(self.fixed_stress) + TINY)
        lateral = ufl.dot(slope, face.lateral)
        between = []
        if relative is not None:
            drop = drop - lateral
            between = relative.between(pressure, drop)
            k0, k1 = (k * relative.conducts(side, [one.k for one in between]) for k, side in ((k0, "+"), (k1, "-")))
        resistance = d0 * k1 + d1 * k0 + TINY
        T = face.share * k0 * k1 / resistance
        dS = ufl.Measure("dS", domain=mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 0})
        self.dt = fem.Constant(mesh, 0.0)
        damped = ufl.max_value(ufl.avg(self.damping) * face.share * (d0 + d1) - self.dt * T, 0.0)
        self.damp = FacetForm(damped * ufl.jump(dp) * ufl.jump(q) * dS, grid.comm)
        smaller = ufl.min_value(self.fixed_stress("+"), self.fixed_stress("-"))
        alternating = smaller / (4 * d) * face.edges[0] / face.volume
        self.alternation = FacetForm(alternating * ufl.jump(dp) * ufl.jump(q) * dS, grid.comm)
        self.density = fem.Function(Q)
        self._sum = fem.Function(Q)
        self.flux = self.nonorthogonal = self.gravity = self.by_motion = None
        if not flows:
            return
        if not grid.axisymmetric:
            self.nonorthogonal = FacetForm(-T * ufl.avg(self.density) * lateral * ufl.jump(q) * dS, grid.comm)
        by_pressure = T * ufl.jump(dp)
        if weight is not None or relative is not None:
            # still water must not flow: its pressure increases with depth by the unit weight at zero pressure.
            # Pressure and weight are in one form, so that rounding errors are small and conserve mass
            density = density_between(pressure("+"), pressure("-"), fem.Constant(mesh, 1 / bulk))
            difference = ufl.jump(pressure) + drop
            self.gravity = FacetForm(T * density * difference * ufl.jump(q) * dS, grid.comm)
            if by_motion is not None:
                conductance = T if relative is None else T * density
                form = conductance * ufl.dot(by_motion, offset) * ufl.jump(q) * dS
                self.by_motion = FacetForm(_compat.expanded(form), grid.comm)
            if relative is not None:

                def by_k(k):
                    """Return the derivative of the transmissibility T with respect to k, one of the values of k_r."""
                    first = d0 * (k1 / resistance) ** 2 * ufl.diff(k0, k)
                    return face.share * (first + d1 * (k0 / resistance) ** 2 * ufl.diff(k1, k))

                # the outflow must rise with the pressure of the cell, and fall with the neighbour's, despite rounding
                own, other = (
                    T * sign + difference * sum(by_k(one.k) * one.slopes[side] for one in between)
                    for side, sign in enumerate((1, -1))
                )
                by_pressure = density * (ufl.max_value(own, 0.0) * dp("+") + ufl.min_value(other, 0.0) * dp("-"))
        self.flux = FacetForm(by_pressure * ufl.jump(q) * dS, grid.comm)

    @property
    def gradients(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gradients (c, d) for the non-orthogonal correction, in Pa/m, and their weights (c,), in local cells."""
        return self.slope.x.array.reshape(-1, self.grid.dim), self.fixed_stress.x.array

    def unequal(self, filled: NDArray[np.int32], mean: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the mobilities of local cells from `mean` of the filled cells, or None if all are equal."""
        comm = self.grid.comm
        if comm.allreduce(mean.max(initial=0.0), MPI.MAX) <= comm.allreduce(mean.min(initial=np.inf), MPI.MIN):
            return None
        out = fem.Function(self.grid.cellwise())
        out.x.array[filled] = mean
        out.x.scatter_forward()
        return out.x.array

    def along(
        self,
        slope: NDArray[np.float64],
        cells: NDArray[np.int64],
        facets: FacetSum,
        active: NDArray[np.int64],
        density: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the outflow of local cells through `facets`, in m^d/s, due to the gradients `slope` in `cells`.

        In unsaturated soil the result is zero, and the forms of the fluxes contain the gradients from now on.

        `slope` (n, d), Pa/m: see `Gradients`.
        `active` (c,): active local cells.
        `density` (c,): density of the fluid in these cells, divided by the density at zero pressure.
        """
        self.density.x.array[active] = density
        self._sum.x.array[active] = 0.0
        of_cells = self.slope.x.array.reshape(-1, self.grid.dim)
        of_cells[active] = 0.0
        of_cells[cells] = slope
        self.slope.x.scatter_forward()
        if self.relative is None:
            facets.assemble_vector(self._sum.x.array)
        return sum_ghosts(self._sum)

    def set_conduction(self, contents: CellContents, flow: Conduction) -> NDArray[np.float64]:
        """Set the coefficients that depend on conductivities of cells.  Return the mobilities (n, d) along the axes."""
        d = self.grid.dim
        filled = contents.filled
        shift = flow.mobility.shift
        mobility = flow.along(d)
        if self.relative is not None:
            self.relative.set_shares(filled, flow.mobility.shares)
        values = [(self.mobility, mobility)]
        if shift is not None:  # the weight of the fluid still refers to the centroids
            values.append((self.centroid, contents.centroid[filled] + shift))
        if self.gravity:
            moved = np.zeros((len(filled), d)) if flow.motion is None else flow.motion.moved
            values.append((self.moved, moved if shift is None else moved - shift))
        for f, rows in values:
            x = f.x
            x.array.reshape(-1, d)[filled] = rows
            x.scatter_forward()
        if self.relative is not None:
            self.relative.set_borders(contents, flow, *(f.x.array.reshape(-1, d) for f in (self.centroid, self.moved)))
        return mobility
