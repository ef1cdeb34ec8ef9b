# SPDX-License-Identifier: MIT
"""What acts on the sides of the bodies in the storage of the fluid: drained sides and prescribed inflow."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.cut_domains import CutDomains
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.problems.conditions import Drained, Inflow
from mpm_dolfinx.problems.fluxes import CellContents, OpenSides
from mpm_dolfinx.problems.sides import Sides, check_apart, everywhere, on_side

THICK = np.sqrt(2)
"""Largest section of a cube over its face.

A convex body behind a plane has its centroid at least its volume / ((d + 1) THICK h^(d-1)) behind it.  A face that is
closer to the centroid of what its cell holds, or behind it, bounds a part of that only, and must not drain it at once.
"""


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
        self.varies = any(callable(o.flux if isinstance(o, Inflow) else o.pressure) for o in outlets)
        """Whether what the sides give depends on time or place."""
        for one, other in combinations(self.outlets, 2):
            check_apart(*one, *other)
        self._constant: Latest[OpenSides] = Latest()

    def data(self, cut: CutDomains, points: MaterialPoints, contents: CellContents, t: float) -> OpenSides:
        """Return the open sides where they were cut, with what they give at time t (s)."""
        if self.varies:
            return self._placed(cut, points, contents, t)
        key = (cut.key, contents.key, points)
        return self._constant(key, lambda: self._placed(cut, points, contents, t), self._grid.comm)

    def _placed(self, cut: CutDomains, points: MaterialPoints, contents: CellContents, t: float) -> OpenSides:
        grid = self._grid
        none, vectors = np.empty(0), np.empty((0, grid.dim))
        whole, cells = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int32)
        rows = [(whole, cells, none, none, none, np.empty(0, dtype=bool), vectors, vectors)]
        for i, (outlet, faces) in enumerate(self.outlets):
            patches = cut.surface(faces)
            travel = Exchange(grid.comm, grid.owner(patches.cell))
            cell = grid.local(travel.send(patches.cell))
            area, x = travel.send(patches.area(points)), travel.send(patches.x)
            value = partial(outlet.at, t, on_side(patches, points))
            value = travel.send(np.resize(everywhere(grid, value), len(patches.x)))
            size = np.linalg.norm(area, axis=1)
            number, none, normal = np.full(len(cell), i), np.zeros(len(cell)), area / size[:, None]
            reach = x - grid.midpoints[cell] - contents.centroid[cell]
            if isinstance(outlet, Inflow):
                rows.append((number, cell, none, none, value * size, none > 0, area, reach))
                continue
            least = contents.fill[contents.slot(cell)] * grid.h.min() / THICK / (grid.dim + 1)
            shape = size / np.maximum(np.einsum("md,md->m", reach, normal), least)
            rows.append((number, cell, shape, value, none, outlet.seepage & (value <= 0), area, reach))
        return OpenSides(*map(np.concatenate, zip(*rows, strict=True)))
