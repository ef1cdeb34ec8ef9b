# SPDX-License-Identifier: MIT
"""Data of the integration points of a step: fields of the material points, and constants of their materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.domains.domain_gradient import cell_ratios
from mpm_dolfinx.domains.domain_slopes import LinearGradients
from mpm_dolfinx.forms.point_forms import FormPoints, Places, PointData
from mpm_dolfinx.grid.grid import in_chunks, means_of_rows, sum_by
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.skeleton import Skeleton
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import ACROSS, MaterialPoints, in_plane, in_space

STIFF_DRY = 50
"""Value of (lambda + 2G) / G above which the weight of the volume ratio from corners decreases in dry bodies.

The volume ratio at the start of a step is a weighted mean of two values: from the corners of domains (`cell_ratios`),
and from F of the points.  The first has the weight min(1, `STIFF_DRY` G / (lambda + 2G)).  With nu = 0.4999 and a
weight of 1, the stress change at a reset of the grid would exceed the stresses in the bodies.
"""
STIFF_WET = 8
"""Value of (lambda + 2G) / G above which the weight of the volume ratio from corners decreases in wet bodies.

The weight is 1 at nu = 0.43, and 0 at nu = 0.47.  With a weight of 1, the largest pressures of a beam with eight cells
over its depth have errors of 43 % at nu = 0.49.  At nu = 0.499 these pressures are six to thirty times too large.
"""
SHARE = 0.5
"""In cells of flowing, dilatant soil, the deviation of grad u from its cell mean is multiplied by this factor.

Without this factor, dilatancy would lock Q1 cells.  With the factor 1, the load of a footing (phi = psi = 20 degrees)
does not reach a limit.  This load is 4.4 % too large with 9 cells over the width of the footing, and 3.4 % with 17
cells.  With the factor 0, the limit load is 6.6 % too small with 9 cells, and 3.2 % with 17 cells.
"""


def corner_share(material: Skeleton, wet: bool) -> NDArray[np.float64]:
    """Return the weight of the volume ratio from the corners of domains, at the start of a step."""
    stiffness = material.oedometric / material.shear
    return np.minimum(1.0, np.maximum(2 - stiffness / STIFF_WET, 0.0) if wet else STIFF_DRY / stiffness)


@dataclass(frozen=True)
class QuadratureData:
    """Integration points of a step, with their fields.  A part contains the integration points of one law."""

    pieces: PointData  # all integration points
    parts: tuple[PointData, ...]  # integration points of each part
    rows: tuple[NDArray[np.int64] | slice, ...]  # indices in `pieces` of each part's integration points
    of_points: PointData  # like `pieces`, but volumes and F are not scaled for F-bar; for user-defined terms

    def increments(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return I + grad u at the integration points of the laws."""
        n, d = self.pieces.x.shape
        out, nodes = np.empty((n, d, d)), self.pieces.points.grid.cell_nodes
        for rows, part in zip(self.rows, self.parts, strict=True):
            own = np.arange(n)[rows]
            for chunk in in_chunks(len(own)):
                at_nodes = nodal[nodes[part.cells[chunk]]].transpose(0, 2, 1)
                out[own[chunk]] = np.eye(d) + at_nodes @ part.places.shape_gradients(chunk)
        return out


@dataclass(frozen=True)
class PiecePlaces:
    """Positions of the pieces of the cut domains."""

    pieces: Places  # of all pieces
    parts: tuple[tuple[NDArray[np.int64], Places], ...]  # indices and positions of the pieces of each part
    lever: NDArray[np.float64] | None = None  # vectors (n, d), in m, to pieces from the centroid of their cell's soil


class QuadraturePoints:
    """Pieces of particle domains as integration points, with the fields of the scene's forms.

    `weighs`: whether the scene has gravity.
    `extended`: whether user-defined functions may use any field of the material points.

    Attributes
    ----------
    pieces
        The integration points.
    laws
        Each law with its integration points, and whether the law uses F-bar.
    varies
        Whether mobilities change with the deformation.
    layered
        Whether the conductivity differs between points.
    """

    def __init__(self, scene: SceneMaterials, bodies: Sequence[Body], weighs: bool, extended: bool):
        self._grid, self._fluid = grid, fluid = scene.grid, scene.fluid
        self._linear = LinearGradients(grid.comm, bodies) if scene.some_elastic else None
        self.materials = scene
        self._weighs = weighs
        self._extended = extended
        self.varies = bool(fluid and scene.conductivity_laws)
        self.layered = bool(fluid and scene.conducts and scene.layered)
        d = grid.dim
        own = {"F": (grid.stretches, grid.stretches)} | ({ACROSS: ()} if scene.across else {})
        shapes: dict[str, tuple[int, ...]] = {**own, **scene.shapes}
        if fluid:
            shapes |= {"biot": (), "storage": (), "storage_at_one": ()}
            shapes |= {"drainage": (2,)} if scene.drains else {}
            if scene.retentions:
                shapes |= {"retention": (scene.retentions.width,), "pores": (), "lever": (d,)}
        if weighs:
            shapes |= {"density": ()}
        if extended:
            data = {name: values.shape[1:] for name, values in scene.seeded.data.items()}
            shapes |= {"position": (d,), "displacement": (d,), **data}
        if self.varies:
            shapes |= {"position": (d,), "conductivity": (), "porosity0": ()}
        self.pieces = FormPoints(grid, **shapes)
        common = [*own, *["biot"] * bool(fluid), *["retention", "lever"] * bool(scene.retentions)]
        self.laws = scene.parts(self.pieces, common)
        self._locks = any(locks for *_, locks in self.laws)
        self._constants: Latest[dict[str, NDArray[np.float64]]] = Latest()

    def places(self, cut: CutDomains) -> PiecePlaces:
        """Return the positions of the pieces of cut domains."""
        pieces, parts = Places(self._grid, cut.cells, cut.x, cut.mixed, cut.hoop), []
        law_places = self._law_places(cut, pieces)
        if len(self.laws) > 1 or law_places is not pieces:
            part = cut.to_cells(self.materials.part_of(cut.points))
            rows = [(part == number).nonzero()[0] for number in range(len(self.laws))]
            parts = [(own, law_places.part(own)) for own in rows]
        return PiecePlaces(pieces, tuple(parts))

    def _law_places(self, cut: CutDomains, pieces: Places) -> Places:
        """Return the positions at which laws are evaluated.  `SHARE` moves them towards their mean in the cell."""
        if not self.materials.dilates or self._grid.axisymmetric:
            return pieces
        flows = cut.to_cells(self.materials.dilating(cut.points))
        size, volume = self._grid.num_local, (cut.points.volume0 * cut.points.J)[cut.pieces.point]
        weight = cut.pieces_to_cells(cut.pieces.fraction * volume)
        all_flow = sum_by(cut.cells, weight * ~flows, size)[cut.cells] == 0
        if not over_all(self._grid.comm, int(all_flow.any())):
            return pieces
        middle = means_of_rows(cut.cells, weight, cut.x, size)[cut.cells]
        share = np.where(all_flow, SHARE, 1.0)[:, None]
        mixed = None if cut.mixed is None else share**2 * cut.mixed
        return Places(self._grid, cut.cells, middle + share * (cut.x - middle), mixed)

    def data(self, cut: CutDomains, places: PiecePlaces, points: MaterialPoints) -> QuadratureData:
        """Return the integration points of cut domains with all their fields in the present state."""
        within = self._gradients(cut, points) if self._linear is not None and cut.domains else {}
        even = {name: values for name, values in self._changing(points).items() if name not in within}
        fields = {**self._constant(cut, points), **{name: cut.to_cells(values) for name, values in even.items()}}
        fields |= {name: cut.pieces_to_cells(values) for name, values in within.items()} | self._own(cut, points)
        if self.materials.retentions:
            fields["lever"] = np.zeros_like(cut.x) if places.lever is None else places.lever
        weight = cut.shares(points.volume0 * points.J)
        apart = self._extended and self._locks
        of_points = PointData(self.pieces, places.pieces, weight, fields) if apart else None
        if self._locks and cut.domains:
            share = self.materials.table(points, lambda m: corner_share(m, bool(self._fluid)))
            share = self.materials.locking(points) * share
            factor = cell_ratios(cut, points, share, self.materials.evolved(points)) / cut.to_cells(points.J)
            weight, fields["F"] = factor * weight, factor[:, None, None] ** (1 / cut.grid.stretches) * fields["F"]
            if ACROSS in fields:
                fields[ACROSS] = np.cbrt(factor) * fields[ACROSS]
            if self._weighs:  # the weight of a material point does not depend on the cell's volume ratio
                fields["density"] = fields["density"] / factor
        pieces = PointData(self.pieces, places.pieces, weight, fields)
        of_points = of_points or pieces
        if not places.parts:
            return QuadratureData(pieces, (pieces,), (slice(None),), of_points)
        parts = zip(self.laws, places.parts, strict=True)
        data = tuple(pieces.part(of, where, rows) for (_, of, _), (rows, where) in parts)
        return QuadratureData(pieces, data, tuple(rows for rows, _ in places.parts), of_points)

    def _constant(self, cut: CutDomains, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return the material constants at the integration points."""
        values = tuple(points.data[name] for name in self.materials.field_names)

        def make() -> dict[str, NDArray[np.float64]]:
            fields = self.materials.parameters(points)
            if self._fluid:
                fields["biot"] = self.materials.table(points, lambda m: m.biot)
                fields["storage_at_one"] = self.materials.storage_at_one(points)
                if self.materials.drains:
                    fields["drainage"] = self.materials.drainage(points)
                if self.materials.retentions:
                    fields["retention"] = self.materials.retention_rows(points)
            if self.varies:
                fields["conductivity"] = self.materials.table(points, lambda m: m.conductivity)
                fields["porosity0"] = self.materials.table(points, lambda m: m.porosity)
            return {name: cut.to_cells(rows) for name, rows in fields.items()}

        return self._constants((cut.key, values), make, self._grid.comm)

    def _changing(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return the fields of material points that change from step to step."""
        fields = {"F": points.F, **self.materials.state(points)}
        fields |= {ACROSS: points.data[ACROSS]} if self.materials.across else {}
        if self._extended:  # fields of laws are in `_constant`; in `data` each is valid only at points of its own law
            fields |= {name: rows for name, rows in points.data.items() if name not in self.materials.shapes}
        if self._fluid:
            fields["storage"] = self.materials.storage(points)
        if self._fluid and self.materials.retentions:
            fields["pores"] = self.materials.porosity(points)
        if self._weighs:
            fields["density"] = self.materials.density(points)
        return fields

    def _gradients(self, cut: CutDomains, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return F at the pieces, and the out-of-plane stretch if laws use it."""
        of_materials = self.materials.elastic(points), self.materials.soil_rows(points)
        if not self.materials.across:
            return {"F": self._linear.at_pieces(cut, points.F, *of_materials)}
        F = self._linear.at_pieces(cut, in_space(points.F, points.data[ACROSS]), *of_materials)
        return dict(zip(("F", ACROSS), in_plane(F), strict=True))

    def _own(self, cut: CutDomains, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return the fields that differ between pieces of a material point, for user-defined functions."""
        fields = {}
        if self._extended or self.varies:
            fields["position"] = cut.pieces.x + cut.grid.base
        if self._extended:
            fields["displacement"] = cut.total_displacement(points)
        return {name: cut.pieces_to_cells(values) for name, values in fields.items()}
