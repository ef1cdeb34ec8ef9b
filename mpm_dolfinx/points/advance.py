# SPDX-License-Identifier: MIT
"""The end of a step: points move with the grid, their F follows, and pressures travel along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.problems.mechanical_boundary import Boundary
from mpm_dolfinx.solve.newton import NotConverged
from mpm_dolfinx.points.cutting import parallelepipeds, tangled
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.forms.point_forms import FormPoints
from mpm_dolfinx.constitutive.fields import SceneMaterials
from mpm_dolfinx.constitutive.skeleton import Fluid
from mpm_dolfinx.problems.momentum import Momentum
from mpm_dolfinx.points.cut_domains import Placement
from mpm_dolfinx.points.bodies import Body, MaterialPoints, determinant
from mpm_dolfinx.points.pressure_transport import Carried
from mpm_dolfinx.problems.storage import Storage


class Motion:
    """Moves the points of a scene.

    Parameters
    ----------
    scene
        The materials of the scene.
    bodies
        All bodies of the scene.
    pieces
        The points of integration of a step.
    momentum, storage, fluid
        The two problems and the pore fluid; storage and fluid are None without.
    domains
        Whether points have domains of tracked corners; else these follow from F.
    """

    def __init__(
        self,
        scene: SceneMaterials,
        bodies: Sequence[Body],
        pieces: FormPoints,
        momentum: Momentum,
        storage: Storage | None,
        fluid: Fluid | None,
        domains: bool,
    ):
        self.grid, self._scene, self._pieces = momentum.grid, scene, pieces
        self._momentum, self._storage, self._fluid, self._domains = momentum, storage, fluid, domains
        self._size = np.concatenate([body.size() for body in bodies])

    def move(self, points: MaterialPoints, place: Placement, boundary: Boundary) -> int:
        """Move the corners, update F and the state, take the cells' pressures; return how many domains had folded.

        Raises
        ------
        NotConverged
            A point is turned inside out, or its pores have closed; nothing has moved then.
        """
        grid, cells, n, d = self.grid, self._pieces.cells, len(points), self.grid.dim
        u = self._momentum.u.x.array.reshape(-1, d)
        N, dN = grid.shape_functions(cells, self._pieces.x)
        at_nodes = u[grid.cell_nodes[cells]].transpose(0, 2, 1)
        delta = np.eye(d) + at_nodes @ dN
        if self._momentum.dilatation is not None:
            delta = self._momentum.dilatation.averaged(delta)
        # F_p <- (sum_k w_k Delta_k / V_p) F_p
        mean = [place.mean(column) for column in place.to_pieces(delta).reshape(-1, d * d).T]
        F = np.stack(mean, axis=1).reshape(n, d, d) @ points.F
        self._check_volumes(points, determinant(F))
        self._scene.update_state(replace(points, F=F))
        points.F = F
        moved, folded = place.displacement(u, corners=self._domains), 0
        if self._domains:
            points.corners = points.corners + moved
            points.x = points.corners.mean(axis=1)
            if not place.serves():  # nor have they folded then
                folded = self._untangle(points, boundary)
        else:
            points.x = points.x + moved
            points.corners = parallelepipeds(points.x, points.F, self._size[points.id])
        if self._storage is not None:
            points.pressure = place.mean(place.to_pieces(self._storage.p.x.array[cells]))
            place.moved += place.to_pieces((at_nodes @ N[:, :, None])[:, :, 0])
        return folded

    def _check_volumes(self, points: MaterialPoints, J: NDArray[np.float64]) -> None:
        """Refuse what a law may allow and a body does not: points turned inside out, pores of no volume."""
        wet = self._storage is not None
        least = 1 - self._scene.table(points, lambda m: m.porosity) if wet else np.zeros(len(J))
        bad = np.flatnonzero(J <= least)
        if over_all(self.grid.comm, len(bad)):
            shown = [f"point {points.id[i]} at {points.x[i]} with J = {J[i]:.3g}" for i in bad[:1]]
            what = "the pores have closed" if wet else "the body is turned inside out"
            raise NotConverged(f"{what}, J <= {least.max(initial=0):.3g}: {', '.join(shown) or 'elsewhere'}", [])

    def _untangle(self, points: MaterialPoints, boundary: Boundary) -> int:
        """Re-derive from F the domains that have folded: points whose neighbours went elsewhere."""
        grid, volume = self.grid, points.volume0 * points.J
        bad = np.flatnonzero(tangled(points.corners, volume))
        if len(bad):
            corners = parallelepipeds(points.x[bad], points.F[bad], self._size[points.id[bad]])
            corners = boundary.under_held(points.id[bad], points.corners[bad], volume[bad], corners)
            points.corners[bad] = np.clip(corners, grid.lower, grid.upper)
            points.x[bad] = points.corners[bad].mean(axis=1)
        return over_all(grid.comm, len(bad))

    def carry(self, points: MaterialPoints, place: Placement) -> Carried:
        """Return the pressures that the pieces take along when they leave the grid."""
        pieces, storage = place.pieces, self._storage
        store = self._scene.storage(points, self._fluid) * points.volume0 * points.J
        at_pieces = storage.at_pieces(place.pieces_to_cells(pieces.fraction * store[pieces.point]))
        pressure, slope, bounds = map(place.to_pieces, at_pieces)
        x = pieces.x + place.moved
        return Carried(points.id[pieces.point], pieces.cell, pieces.fraction, pressure, x, slope, bounds)
