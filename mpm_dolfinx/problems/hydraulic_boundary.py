# SPDX-License-Identifier: MIT
"""What acts on the sides of the bodies in the storage of the fluid: drained sides and prescribed inflow."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.cut_domains import CutDomains
from mpm_dolfinx.points.cutting import SNAP
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.problems.conditions import Drained, Inflow
from mpm_dolfinx.problems.fluxes import CellContents, OpenSides
from mpm_dolfinx.problems.sides import Sides, check_apart


class HydraulicBoundary:
    """Drained sides and prescribed inflows of a stage.

    Parameters
    ----------
    sides
        The sides of the bodies.
    outlets
        The conditions.

    Raises
    ------
    ValueError
        Naming a condition whose side no point has, or two that act on the same faces.
    """

    def __init__(self, sides: Sides, outlets: Sequence[Drained | Inflow]):
        self._grid = sides.grid
        self.outlets = [(outlet, sides.of(outlet)) for outlet in outlets]
        for one, other in combinations(self.outlets, 2):
            check_apart(*one, *other)

    def data(
        self, cut: CutDomains, points: MaterialPoints, contents: CellContents, weight: NDArray[np.float64] | None
    ) -> OpenSides:
        """Return the open sides where they were cut; weight: rho_w g (d,), N/m^3, if there is gravity."""
        grid = self._grid
        cells, conductances, inflows = [np.empty(0, dtype=np.int32)], [np.empty(0)], [np.empty(0)]
        for outlet, faces in self.outlets:
            patches = cut.surface(faces)
            travel = Exchange(grid.comm, grid.owner(patches.cell))
            cell = grid.local(travel.send(patches.cell))
            area, x = travel.send(patches.area(points)), travel.send(patches.x)
            size = np.linalg.norm(area, axis=1)
            cells.append(cell)
            if isinstance(outlet, Inflow):
                conductances.append(np.zeros(len(cell)))
                inflows.append(outlet.flux * size)
                continue
            centre = grid.midpoints[cell] + contents.centroid[cell]
            distance = np.einsum("md,md->m", x - centre, area) / size
            conductance = contents.mobility[cell] * size / np.maximum(distance, SNAP * grid.h.min())
            outer = np.full(len(cell), outlet.pressure)
            if weight is not None:
                outer -= (x - centre) @ weight
            conductances.append(conductance)
            inflows.append(conductance * outer)
        return OpenSides(*map(np.concatenate, (cells, conductances, inflows)))
