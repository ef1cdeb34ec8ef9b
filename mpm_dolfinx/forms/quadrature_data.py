# SPDX-License-Identifier: MIT
"""What the pieces of a step carry: fields of the points and constants of their materials."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.forms.point_forms import FormPoints
from mpm_dolfinx.points.grid import Grid
from mpm_dolfinx.constitutive.fields import ConductivityAtPieces, SceneMaterials
from mpm_dolfinx.constitutive.skeleton import Fluid, Skeleton
from mpm_dolfinx.points.cut_domains import Placement
from mpm_dolfinx.points.bodies import MaterialPoints


class IntegrationData:
    """The pieces as points of integration, with the fields that the scene's forms take.

    Parameters
    ----------
    grid
        Background grid.
    scene
        The materials of the scene.
    points
        The material points; only the names and shapes of their data matter.
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
        Each law with the pieces that follow it.
    """

    def __init__(
        self,
        grid: Grid,
        scene: SceneMaterials,
        points: MaterialPoints,
        fluid: Fluid | None,
        weighs: bool,
        extended: bool,
    ):
        self.grid, self.fluid = grid, fluid
        self._scene, self._weighs, self._extended = scene, weighs, extended
        self._varies = bool(fluid and scene.conductivity_laws)
        d = grid.dim
        shapes: dict[str, tuple[int, ...]] = {"F": (d, d), **scene.shapes}
        if fluid:
            shapes |= {"biot": (), "storage": ()}
        if weighs:
            shapes |= {"density": ()}
        if extended:
            data = {name: values.shape[1:] for name, values in points.data.items()}
            shapes |= {"position": (d,), "displacement": (d,), **data}
        if self._varies:
            shapes |= {"position": (d,), "conductivity": (), "porosity0": ()}
        self.pieces = FormPoints(grid, **shapes)
        self.laws = scene.parts(self.pieces, ["F", "biot"] if fluid else ["F"])
        self._conductivity = ConductivityAtPieces(scene, self.pieces) if fluid else None

    def place(self, place: Placement, points: MaterialPoints) -> None:
        """Put the pieces where they have been cut."""
        fields = {**self._scene.values(points), **self._constants(points), **self._changing(points)}
        fields = {name: place.to_cells(values) for name, values in fields.items()}
        self.pieces.place(place.cells, place.x, self._weight(place, points), **fields, **self._own(place, points))
        self._part_laws(place, points)

    def renew(self, place: Placement, points: MaterialPoints) -> None:
        """Renew what has changed since the pieces were cut; they stay where they are."""
        fields = {name: place.to_cells(values) for name, values in self._changing(points).items()}
        self.pieces.renew(self._weight(place, points), **fields, **self._own(place, points))
        self._part_laws(place, points)

    def _weight(self, place: Placement, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the volumes of the pieces (m,), m^d."""
        pieces = place.pieces
        return place.pieces_to_cells(pieces.fraction * (points.volume0 * points.J)[pieces.point])

    def _part_laws(self, place: Placement, points: MaterialPoints) -> None:
        """Give each of several laws the pieces that follow it."""
        if len(self.laws) > 1:
            law = place.to_cells(self._scene.law_of(points))
            for number, (_, part) in enumerate(self.laws):
                part.take(self.pieces, np.flatnonzero(law == number))

    def _constants(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return what the materials bring to their pieces for good."""
        fields = {}
        if self.fluid:
            fields["biot"] = self._scene.table(points, lambda m: m.biot)
        if self._varies:
            fields["conductivity"] = self._scene.table(points, lambda m: m.conductivity)
            fields["porosity0"] = self._scene.table(points, lambda m: m.porosity)
        return fields

    def _changing(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return what the points bring to their pieces and what changes with them."""
        fields = {"F": points.F, **self._scene.state(points)}
        if self._extended:  # what laws take is known for all materials, and zero in `data` for those of other points
            fields |= {name: rows for name, rows in points.data.items() if name not in self._scene.shapes}
        if self.fluid:
            fields["storage"] = self._scene.storage(points, self.fluid)
        if self._weighs:
            n, wet = self._scene.porosity(points), self.fluid.density if self.fluid else 0.0
            fields["density"] = (1 - n) * self._scene.table(points, lambda m: m.grain_density) + n * wet
        return fields

    def _own(self, place: Placement, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return what differs from piece to piece of a point, where functions of the user's may ask for it."""
        fields = {}
        if self._extended or self._varies:
            fields["position"] = place.pieces.x
        if self._extended:
            fields["displacement"] = place.total_displacement()
        return {name: place.pieces_to_cells(values) for name, values in fields.items()}

    @property
    def stays(self) -> bool:
        """Whether no more changes than `renew` renews while the pieces stay where they are."""
        return not self._varies

    def rows(self, place: Placement, points: MaterialPoints, value: Callable[[Skeleton], float]) -> NDArray[np.float64]:
        """Return a constant of the materials at the pieces (m,)."""
        return place.to_cells(self._scene.table(points, value))

    def mobility(self, place: Placement, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the mobility k / (rho_w g) at the pieces (m,), m^2/(Pa s)."""
        if not self._varies:
            return self.rows(place, points, lambda m: m.conductivity) / self.fluid.unit_weight
        return self._conductivity.evaluate(place.to_cells(points.material)) / self.fluid.unit_weight

    def fixed_stress(self, place: Placement, points: MaterialPoints, as_printed: bool) -> NDArray[np.float64]:
        """Return beta of the fixed-stress operator at the pieces, 1/Pa, before the scheme's factor.

        `as_printed`: 1/K_w, as in the seed paper.
        """
        if as_printed:
            return np.full(len(self.pieces.cells), 1 / self.fluid.bulk)
        beta = self._scene.table(points, lambda m: m.biot**2 / m.drained_modulus(self.grid.dim)) * points.J
        return place.to_cells(beta)
