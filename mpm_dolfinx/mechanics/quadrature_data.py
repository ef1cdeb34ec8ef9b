# SPDX-License-Identifier: MIT
"""What the pieces of a step carry: fields of the points and constants of their materials."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.domains.domain_gradient import cell_ratios
from mpm_dolfinx.domains.domain_slopes import LinearGradients
from mpm_dolfinx.forms.point_forms import FormPoints, Places, PointData
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.materials.evaluate import ConductivityAtPieces
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.skeleton import Fluid, Skeleton
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import ACROSS, MaterialPoints, in_plane, in_space

TOLD = 50
"""Share of what corners tell in the volume ratios with which cells begin a step, over G / (lambda + 2G); at most all.

The rest is what the points of a cell have: with nu = 0.4999 all of what corners tell would change stresses at a reset
by more than bodies bear.
"""
STIFF = 8
"""(lambda + 2G) / G from which on corners of wet bodies tell ever less: all with nu = 0.43, nothing from 0.47 on.

What corners tell beside the Q1 field presses water out of such skeletons anew in every step, however short: with eight
cells over a beam's depth its extreme pressures would be 43 % off with nu = 0.49, six to thirty times too large with
0.499, and steps by error would never grow.
"""
SHARE = 0.5
"""Share of what a cell's gradient differs from its mean that laws see where all soil in it flows and dilates.

Flow that dilates by sin psi of its shear at four points asks too much of a Q1 cell also where the volume is its mean:
a footing with associated flow, phi = 20 degrees, 9 and 17 cells over its width, then carries 4.4 and 3.4 % too much,
and the load still rises.  With one point a cell it carries 6.6 and 3.2 % too little, and flows.
"""


def told_share(material: Skeleton, wet: bool) -> NDArray[np.float64]:
    """Return how much of the volume ratio with which its cells begin a step is what the domains' corners tell."""
    stiffness = material.oedometric / material.shear
    return np.clip(2 - stiffness / STIFF, 0.0, 1.0) if wet else np.minimum(1.0, TOLD / stiffness)


@dataclass(frozen=True)
class QuadratureData:
    """The pieces of a step, those of each part of them (`SceneMaterials.parts`), and which these are."""

    pieces: PointData
    parts: tuple[PointData, ...]
    rows: tuple[NDArray[np.int64] | slice, ...]

    def shape_gradients(self) -> NDArray[np.float64]:
        """Return the gradients (m, 2^d, d), 1/m, of the shape functions where laws see them."""
        if self.parts[0] is self.pieces:
            return self.pieces.places.shape_gradients(slice(None))
        n, d = self.pieces.x.shape
        out = np.empty((n, 2**d, d))
        for rows, part in zip(self.rows, self.parts, strict=True):
            out[rows] = part.places.shape_gradients(slice(None))
        return out


@dataclass(frozen=True)
class PiecePlaces:
    """Where the pieces of a cut lie, and which rows of them belong to each of several parts, with their places.

    lever (m, d), m: ways to the pieces from the centroids of what their cells hold, once these are known.
    """

    pieces: Places
    parts: tuple[tuple[NDArray[np.int64], Places], ...]
    lever: NDArray[np.float64] | None = None


class QuadraturePoints:
    """The pieces as points of integration, with the fields that the scene's forms take.

    Parameters
    ----------
    grid
        Background grid.
    scene, bodies
        The materials of the scene, and all its bodies.
    fluid
        Pore fluid, if any.
    weighs
        Whether there is gravity.
    extended
        Whether functions of the user's may ask for anything that the points carry.

    Attributes
    ----------
    pieces
        The points of integration.
    laws
        Each law with the pieces that follow it, and whether they see the mean dilatation, see `SceneMaterials.parts`.
    varies
        Whether mobilities change with the deformation.
    layered
        Whether points differ in what they conduct.
    """

    def __init__(
        self,
        grid: Grid,
        scene: SceneMaterials,
        bodies: Sequence[Body],
        fluid: Fluid | None,
        weighs: bool,
        extended: bool,
    ):
        self._grid, self._fluid = grid, fluid
        self._linear = LinearGradients(grid.comm, bodies) if scene.some_elastic else None
        self._scene = scene
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
        """Return where the pieces of a cut lie."""
        pieces, parts = Places(self._grid, cut.cells, cut.x, cut.mixed, cut.hoop), []
        seen = self._seen(cut, pieces)
        if len(self.laws) > 1 or seen is not pieces:
            part = cut.to_cells(self._scene.part_of(cut.points))
            rows = [np.flatnonzero(part == number) for number in range(len(self.laws))]
            parts = [(own, seen.part(own)) for own in rows]
        return PiecePlaces(pieces, tuple(parts))

    def _seen(self, cut: CutDomains, pieces: Places) -> Places:
        """Return where laws see the gradient: the pieces, but where soil flows and dilates, see `SHARE`."""
        if not self._scene.dilates or self._grid.axisymmetric:
            return pieces
        flows = cut.to_cells(self._scene.dilating(cut.points))
        size, volume = self._grid.num_local, (cut.points.volume0 * cut.points.J)[cut.pieces.point]
        weight = cut.pieces_to_cells(cut.pieces.fraction * volume)
        whole = sum_by(cut.cells, weight, size)
        all_flow = sum_by(cut.cells, weight * ~flows, size)[cut.cells] == 0
        if not over_all(self._grid.comm, int(all_flow.any())):
            return pieces
        columns = [sum_by(cut.cells, weight * column, size)[cut.cells] for column in cut.x.T]
        middle = np.stack(columns, axis=1) / whole[cut.cells, None]
        share = np.where(all_flow, SHARE, 1.0)[:, None]
        mixed = None if cut.mixed is None else share**2 * cut.mixed
        return Places(self._grid, cut.cells, middle + share * (cut.x - middle), mixed)

    def data(self, cut: CutDomains, places: PiecePlaces, points: MaterialPoints) -> QuadratureData:
        """Return the pieces with all their data: those of a cut, with what the points carry now."""
        changing = {name: cut.to_cells(values) for name, values in self._changing(points).items()}
        if self._linear is not None and cut.domains:
            changing |= {name: cut.pieces_to_cells(values) for name, values in self._gradients(cut, points).items()}
        fields = {**self._constant(cut, points), **changing, **self._own(cut, points)}
        fields["lever"] = np.zeros_like(cut.x) if places.lever is None else places.lever
        weight = cut.pieces_to_cells(cut.pieces.fraction * (points.volume0 * points.J)[cut.pieces.point])
        if self._locks and cut.domains:
            share = self._scene.locking(points) * self._scene.table(points, lambda m: told_share(m, bool(self._fluid)))
            factor = cell_ratios(cut, points, share, self._scene.evolved(points)) / cut.to_cells(points.J)
            weight, fields["F"] = factor * weight, factor[:, None, None] ** (1 / cut.grid.stretches) * fields["F"]
            if ACROSS in fields:
                fields[ACROSS] = np.cbrt(factor) * fields[ACROSS]
            if self._weighs:  # points weigh what they do, however large cells see them
                fields["density"] = fields["density"] / factor
        pieces = PointData(self.pieces, places.pieces, weight, fields)
        if not places.parts:
            return QuadratureData(pieces, (pieces,), (slice(None),))
        parts = zip(self.laws, places.parts, strict=True)
        data = tuple(pieces.part(of, where, rows) for (_, of, _), (rows, where) in parts)
        return QuadratureData(pieces, data, tuple(rows for rows, _ in places.parts))

    def _constant(self, cut: CutDomains, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return what the materials bring to their pieces for good."""
        values = tuple(points.data[name] for name in self._scene.field_names)

        def make() -> dict[str, NDArray[np.float64]]:
            fields = self._scene.parameters(points)
            if self._fluid:
                fields["biot"] = self._scene.table(points, lambda m: m.biot)
                fields["storage_at_one"] = self._scene.storage_at_one(points)
                if self._scene.drains:
                    fields["drainage"] = self._scene.drainage(points)
                if self._scene.retentions:
                    fields["retention"] = self._scene.retention_rows(points)
            if self.varies:
                fields["conductivity"] = self._scene.table(points, lambda m: m.conductivity)
                fields["porosity0"] = self._scene.table(points, lambda m: m.porosity)
            return {name: cut.to_cells(rows) for name, rows in fields.items()}

        return self._constants((cut.key, values), make, self._grid.comm)

    def _changing(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return what the points bring to their pieces and what changes with them."""
        fields = {"F": points.F, **self._scene.state(points)}
        fields |= {ACROSS: points.data[ACROSS]} if self._scene.across else {}
        if self._extended:  # what laws take is known for all materials, and zero in `data` for those of other points
            fields |= {name: rows for name, rows in points.data.items() if name not in self._scene.shapes}
        if self._fluid:
            fields["storage"] = self._scene.storage(points)
        if self._fluid and self._scene.retentions:
            fields["pores"] = self._scene.porosity(points)
        if self._weighs:
            fields["density"] = self._scene.density(points)
        return fields

    def _gradients(self, cut: CutDomains, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return F, and a stretch across the plane if laws see one, at the pieces of this process's points."""
        of_materials = self._scene.elastic(points), self._scene.alike(points)
        if not self._scene.across:
            return {"F": self._linear.at_pieces(cut, points.F, *of_materials)}
        F = self._linear.at_pieces(cut, in_space(points.F, points.data[ACROSS]), *of_materials)
        return dict(zip(("F", ACROSS), in_plane(F), strict=True))

    def _own(self, cut: CutDomains, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return what differs from piece to piece of a point, where functions of the user's may ask for it."""
        fields = {}
        if self._extended or self.varies:
            fields["position"] = cut.pieces.x + cut.grid.base
        if self._extended:
            fields["displacement"] = cut.total_displacement(points)
        return {name: cut.pieces_to_cells(values) for name, values in fields.items()}

    def rows(self, cut: CutDomains, points: MaterialPoints, value: Callable[[Skeleton], float]) -> NDArray[np.float64]:
        """Return a constant of the materials at the pieces (m,)."""
        return cut.to_cells(self._scene.table(points, value))

    def mobility(
        self, cut: CutDomains, law: ConductivityAtPieces | None, data: PointData, begins: bool
    ) -> NDArray[np.float64]:
        """Return the mobility k / (rho_w g) at the pieces (m,), m^2/(Pa s), by a law at the present u."""
        if law is None:
            return self.rows(cut, cut.points, lambda m: m.conductivity) / self._fluid.unit_weight
        return law.evaluate(data, cut.to_cells(cut.points.material), begins) / self._fluid.unit_weight

    @property
    def materials(self) -> SceneMaterials:
        """The materials of the scene."""
        return self._scene

    def masses(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the masses (n,), kg, of the points, pore fluid included."""
        return self._scene.present_density(points) * points.volume0 * points.J

    def conducting(self, cut: CutDomains) -> NDArray[np.float64]:
        """Return what pieces (m, 2) that conduct alike have in common."""
        return cut.to_cells(self._scene.conducting(cut.points))

    def fixed_stress(self, cut: CutDomains, points: MaterialPoints, of_fluid: bool) -> NDArray[np.float64]:
        """Return beta of the fixed-stress operator at the pieces, 1/Pa, before the scheme's factor.

        `of_fluid`: 1/K_w, with which the plain iteration converges for stiff skeletons only.
        """
        if of_fluid:
            return np.full(len(cut.cells), 1 / self._fluid.bulk)
        beta = self._scene.table(points, lambda m: m.biot**2 / m.drained_modulus(self._grid.stretches)) * points.J
        return cut.to_cells(beta)
