# SPDX-License-Identifier: MIT
"""Fluxes in unsaturated soil: through faces of cells with several soils, and between cells of different soil.

`series` computes the conductivities of these faces. All other faces have two-point fluxes in UFL (`fluxes`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import mean_density
from mpm_dolfinx.base.tolerances import EPSILON, TINY
from mpm_dolfinx.flow.fluxes import CellContents, Conduction, Mobility
from mpm_dolfinx.flow.layers import MixedCells
from mpm_dolfinx.flow.series import Paths, none, through
from mpm_dolfinx.forms.unknowns import Unknowns, with_ghosts


class Borders:
    """Faces between cells of different soil, and faces of cells with several soils, at the last grid reset.

    `cells` (m,): cell of each piece.
    `soils` (m, k): numbers that identify the soil of each piece.  Equal rows mean equal conductivities.
    `law` (m,): index of the retention curve of each piece.
    `facets`: facets of this process between two active cells.
    `mixed`: cells with several soils, or None.
    """

    def __init__(
        self,
        contents: CellContents,
        cells: NDArray[np.int32],
        soils: NDArray[np.float64],
        law: NDArray[np.int64],
        facets: NDArray[np.int32],
        mixed: MixedCells | None,
    ):
        self.grid = grid = contents.grid
        known = np.zeros((grid.num_local, 2 + soils.shape[1]))
        known[cells, 1:] = np.column_stack([law, soils])
        self.mixed = np.full(grid.num_local, -1)
        """Index of each local cell among the owned mixed cells, -1 for all other cells."""
        if mixed is not None:
            self.mixed[mixed.cells] = np.arange(len(mixed.cells))
            known[mixed.cells, 0] = 1.0
        known = with_ghosts(grid.cellwise(), known)
        self._contents = contents
        self._law = known[:, 1].astype(np.int64)
        first, other = grid.facet_cells[facets].T
        differ = (known[first] != known[other]).any(axis=1) | (known[first, 0] > 0)
        self.facets, self.uniform = facets[differ], facets[~differ]
        """`facets`: facets of this process between cells of different soil.  `uniform`: all other facets."""
        offset = grid.midpoints[grid.facet_cells[self.facets]]
        offset = offset[:, 1] - offset[:, 0]
        self.axis = np.abs(offset).argmax(axis=1)
        """Axis normal to each of `facets`."""
        downward = np.take_along_axis(offset, self.axis[:, None], axis=1) < 0
        self._pair = np.where(downward, grid.facet_cells[self.facets][:, ::-1], grid.facet_cells[self.facets]).T
        of_others = contents.filled if grid.comm.size > 1 else contents.filled[:0]  # other processes need them
        self._cells = np.unique(np.append(self._pair, of_others))
        self._slot = np.searchsorted(self._cells, self._pair)

    def faces(
        self, laws: Any, contents: CellContents, flow: Conduction, places: NDArray[np.float64], moved: NDArray
    ) -> BorderFaces:
        """Return the faces with their current conductivities.

        `laws`: relative conductivities as functions of pressure, see `Laws`.
        `contents`: material in the cells.
        `flow`: conductivities of the filled owned cells.
        `places` (c, d), m: vectors from the midpoints of local cells to their pressure positions (see `layers`).
        `moved` (c, d), m: displacements of the cells in the step.
        """
        grid, d = self.grid, self.grid.dim
        paths, slots = flow.mobility.paths, 1
        if paths is not None:
            slots = paths.law.shape[-1]
            plain = flow._replace(mobility=Mobility(np.ones(len(contents.filled))))
            mixed_slots = contents.slot(np.flatnonzero(self.mixed >= 0))
            paths = paths.eased(plain.along(d)[mixed_slots])
        slots = grid.comm.allreduce(slots, MPI.MAX)
        own = np.flatnonzero(self._cells < grid.num_owned)
        cells, along = self._cells[own], flow.along(d)
        out = none(len(self._cells), len(laws.scales), slots).everywhere(d)
        out.parallel[own, :, :, self._law[cells]] = along[contents.slot(cells)][:, :, None]
        mixed = self.mixed[cells] >= 0
        if paths is not None:
            for of, given in zip(out, paths.with_slots(slots), strict=True):
                of[own[mixed]] = given[self.mixed[cells[mixed]]]
        out = self._from_others(out)
        (first, other), axis = self._pair, self.axis
        h = grid.sizes(np.concatenate([first, other]))
        h = np.broadcast_to(h, (2 * len(axis), d)).reshape(2, len(axis), d)
        rows, unit = np.arange(len(axis)), np.eye(d)[axis]
        across = h[:, rows, axis]
        lengths = [across[i] / 2 - sign * places[of, axis] for i, (of, sign) in enumerate(((first, 1), (other, -1)))]
        lengths = [np.maximum(length, EPSILON * edge) for length, edge in zip(lengths, across, strict=True)]
        shift = moved + places - contents.centroid
        drift = (shift[other] - shift[first]) / 2  # the face moves by the mean displacement of both cells
        offsets = [
            across[i][:, None] / 2 * unit - sign * contents.centroid[cells] + drift
            for i, (cells, sign) in enumerate(((first, 1), (other, -1)))
        ]
        area = np.minimum(contents.open[first, axis, 1], contents.open[other, axis, 0])
        area = area * np.broadcast_to(grid.volumes(first), len(axis)) / across[0]
        two = [out.at(self._slot[0], axis, 1), out.at(self._slot[1], axis, 0)]
        weight = np.zeros(d) if flow.weight is None else flow.weight
        return BorderFaces(self, flow.mobility, laws, self._pair, area, two, lengths, offsets, weight, flow.bulk)

    def through_sides(
        self,
        laws: Any,
        mobility: Mobility,
        cells: NDArray[np.int32],
        normal: NDArray[np.float64],
        p: NDArray[np.float64],
        outer: NDArray[np.float64],
        drop: NDArray[np.float64],
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
        """Yield indices (k,) of open faces of owned mixed cells, and the results of `Relative.through_sides` there."""
        rows = np.flatnonzero(self.mixed[cells] >= 0)
        if not len(rows):
            return
        mixed, count = self.mixed[cells[rows]], len(rows)
        slot = self._contents.slot(cells[rows])
        share = normal[rows] ** 2
        across = mobility.mean[slot] * (share * mobility.share[slot]).sum(axis=1)
        found, ones = np.zeros((2, count)), np.ones(count)
        for axis in range(normal.shape[1]):
            path = mobility.paths.at(mixed, axis, (normal[rows, axis] > 0).astype(np.int64))
            some = through(laws, (p[rows], outer[rows]), [path], [ones], [drop[rows]])
            found += share[:, axis] * np.stack([some.conductance, some.slopes[0]])
        yield rows, *np.divide(found, across, out=np.zeros_like(found), where=across > 0)

    def _from_others(self, paths: Paths) -> Paths:
        """Return the flow paths, in which ghost cells have the values of their owners."""
        if self.grid.comm.size == 1:
            return paths
        columns = [values.reshape(len(self._cells), np.prod(values.shape[1:])) for values in paths]
        width = np.cumsum([column.shape[1] for column in columns])
        rows = np.zeros((self.grid.num_local, width[-1]))
        rows[self._cells] = np.concatenate(columns, axis=1)
        found = np.split(with_ghosts(self.grid.cellwise(), rows)[self._cells], width[:-1], axis=1)
        return Paths(*(part.reshape(of.shape).astype(of.dtype) for part, of in zip(found, paths, strict=True)))


@dataclass(frozen=True, eq=False)
class BorderFaces:
    """Faces between cells of different soil, with their conductivities. Arrays have an entry for each of m faces."""

    borders: Borders
    mobility: Mobility  # mobility of the filled owned cells
    laws: Any  # relative conductivities, see `Laws`
    pair: NDArray[np.int64]  # local cells on both sides (2, m)
    area: NDArray[np.float64]  # areas (m,), m^(d-1)
    paths: list[Paths]  # flow paths from the cells on both sides to the faces, see `through`
    lengths: list[NDArray[np.float64]]  # lengths of the flow paths (m,), m
    offsets: list[NDArray[np.float64]]  # vectors along paths (m, d), m, for pressure drops due to weight
    weight: NDArray[np.float64]  # unit weight of the fluid (d,), N/m^3
    bulk: float  # bulk modulus of the fluid, Pa

    def flows(
        self,
        p: NDArray[np.float64],
        force: NDArray[np.float64] | None,
        slopes: NDArray[np.float64],
        shares: NDArray[np.float64],
    ) -> BorderFlows:
        """Return the fluxes through the faces.

        `p` (2, m), Pa: pressures on both sides of each face.
        `force` (c, d), N/m^3: inertia force on the fluid in the local cells.
        `slopes` (2, m, d), Pa/m: gradients on both sides, whose components along the faces correct the fluxes.
        `shares` (2, m): weights of these gradients.
        """
        lateral = (shares[:, :, None] * slopes).sum(axis=0) / (shares.sum(axis=0)[:, None] + TINY)
        np.put_along_axis(lateral, self.borders.axis[:, None], 0.0, axis=1)
        weight = lateral + (
            self.weight
            if force is None
            else self.weight + with_ghosts(self.borders.grid.cellwise(), force)[self.pair].mean(0)
        )
        drops = [(offset * weight).sum(axis=1) for offset in self.offsets]
        found = through(self.laws, p, self.paths, self.lengths, drops)
        density = self.area * mean_density(*p, self.bulk)
        flux = density * found.conductance * (p[0] - p[1] + sum(drops))
        return BorderFlows(self.pair, flux, [density * slope for slope in found.slopes])


@dataclass(frozen=True)
class BorderFlows:
    """Fluxes through faces between cells of different soil. Arrays have an entry for each of m faces."""

    pair: NDArray[np.int64]  # local cells on both sides (2, m)
    flux: NDArray[np.float64]  # flux from the first to the second cell (m,), m^d/s
    slopes: list[NDArray[np.float64]]  # d flux / dp[0] and -d flux / dp[1] (m,), m^d/(Pa s)

    def add_fluxes(self, out: NDArray[np.float64]) -> None:
        """Add the fluxes to the outflows `out` (c,) of the local cells, in m^d/s."""
        for cells, sign in zip(self.pair, (1, -1), strict=True):
            np.add.at(out, cells, sign * self.flux)

    def add_slopes(self, A: PETSc.Mat, unknowns: Unknowns) -> None:
        """Add the derivatives of the outflows to a matrix (with respect to the pressures), without final assembly."""
        if not len(self.flux):
            return
        number = unknowns.map.indices[self.pair]
        own, other = self.slopes
        values = np.stack([np.stack([own, -other], axis=1), np.stack([-own, other], axis=1)])
        columns = np.broadcast_to(number.T, values.shape)
        starts = np.arange(0, values.size + 1, 2)
        entries = (x.ravel().astype(PETSc.IntType) for x in (starts, columns, number))
        starts, columns, rows = entries
        A.setValuesIJV(starts, columns, values.ravel(), addv=True, rowmap=rows)
