# SPDX-License-Identifier: MIT
"""What acts on the sides of the bodies in the storage of the fluid: drained sides and prescribed inflow."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.conditions.conditions import Drained, Inflow
from mpm_dolfinx.conditions.sides import Sides, check_apart, everywhere, gathered, on_side
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.fluxes import CellContents, OpenSides
from mpm_dolfinx.points.material_points import MaterialPoints

THICK = np.sqrt(2)
"""Largest section of a cube over its face.  Source: exact bound (Ball 1986).

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
        The conditions by name.

    Raises
    ------
    ValueError
        Naming a condition whose side no point has, or two that act on the same faces.
    """

    def __init__(self, sides: Sides, outlets: Mapping[str, Drained | Inflow]):
        self._grid, self.names = sides.grid, tuple(outlets)
        self.outlets = [(outlet, sides.of(outlet)) for outlet in outlets.values()]
        self.varies = any(callable(o.flux if isinstance(o, Inflow) else o.pressure) for o in outlets.values())
        """Whether what the sides give depends on time or place."""
        for one, other in combinations(self.outlets, 2):
            check_apart(*one, *other)
        self._constant: Latest[OpenSides] = Latest()

    def unknown(self, value: float) -> dict[str, NDArray[np.float64]]:
        """Return outflows of this value before a first step."""
        return {name: np.array(value) for name in self.names}

    def data(self, cut: CutDomains, points: MaterialPoints, contents: CellContents, t: float) -> OpenSides:
        """Return the open sides where they were cut, with what they give at time t (s)."""
        if self.varies:
            return self._placed(cut, points, contents, t)
        key = (cut.key, contents.key, points)
        return self._constant(key, lambda: self._placed(cut, points, contents, t), self._grid.comm)

    def _placed(self, cut: CutDomains, points: MaterialPoints, contents: CellContents, t: float) -> OpenSides:
        grid, rows = self._grid, []
        patches = cut.surfaces([faces for _, faces in self.outlets])
        for i, ((outlet, _), p) in enumerate(zip(self.outlets, patches, strict=True)):
            value, n = everywhere(grid, partial(outlet.at, t, on_side(p, points))), len(p.x)
            columns = np.full((n, 1), i), np.resize(value, (n, 1)), p.area(points)
            rows.append((p.cell, p.x, np.concatenate(columns, axis=1)))
        cell, x, values = gathered(grid, rows, 2 + grid.dim)
        number = values[:, 0].astype(np.int64)
        value = values[:, 1]
        area = values[:, 2:]
        drains = np.array([isinstance(outlet, Drained) for outlet, _ in self.outlets], dtype=bool)[number]
        seeps = np.array([getattr(outlet, "seepage", False) for outlet, _ in self.outlets], dtype=bool)[number]
        size, reach = np.linalg.norm(area, axis=1), x - grid.midpoints[cell] - contents.centroid[cell]
        least = contents.fill[contents.slot(cell)] * grid.h.min() / THICK / (grid.dim + 1)
        normal = area / size[:, None]
        distance = np.einsum("md,md->m", reach, normal)
        shape = size / np.maximum(distance, least)
        if grid.axisymmetric:  # half-way to the centroid rings are as much longer or shorter
            shape = shape * (1 - distance * normal[:, 0] / (2 * x[:, 0]))
        shape, pressure = (np.where(drains, values, 0.0) for values in (shape, value))
        given = np.where(drains, 0.0, value * size)
        return OpenSides(number, cell, shape, pressure, given, seeps & (value <= 0), area, reach)
