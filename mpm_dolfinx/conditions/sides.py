# SPDX-License-Identifier: MIT
"""Faces of the sides to which conditions apply."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import NEAR, SAME, TINY
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Region, Surface, joined, limits, surface
from mpm_dolfinx.conditions.conditions import Displacement
from mpm_dolfinx.grid.grid import SIDES, Grid, rounding
from mpm_dolfinx.parallel.exchange import over_all


class Sides:
    """Finder of the faces on which a condition acts.  `present`: whether each body is active in the stage."""

    def __init__(self, grid: Grid, bodies: Sequence[Body], present: Sequence[bool]):
        self.grid = grid
        self.bodies = bodies
        self.present = present
        self._found: dict[tuple[str, bytes], Surface] = {}

    def of(self, condition) -> Surface:
        """Return the faces of a condition.  Raise ValueError if there are no faces."""
        found = self._of(condition.side, condition.region)
        if not len(found):
            where = " in the region" if condition.region is not None else ""
            where += " off the axis" if self.grid.has_axis else ""
            raise ValueError(f"{line(condition)}: no point has this side{where}, must be a side of a body")
        copies = np.unique(self.grid.copy(found.id))
        if len(copies) > 1:
            what = f"{line(condition)}: {len(copies)} groups of bodies have this side"
            raise ValueError(f"{what}, must be one group; limit each condition to one group by a region")
        return found

    def _of(self, side: str, region: Region | None) -> Surface:
        """Return the faces of a side in a region."""
        key = (str(side), limits(region, self.grid.dim).tobytes())
        if key not in self._found:
            found = surface(self.bodies, side, region, self.present)
            self._found[key] = found.off_axis() if self.grid.has_axis else found
        return self._found[key]

    def held(self, condition: Displacement, others: Sequence[Displacement]) -> Surface:
        """Return the faces of a prescribed displacement.

        If the region ends in a cell, and covers at most half of this cell, the faces in the cell are excluded.  On a
        side inclined to the grid, the faces end half a cell before the end of the region.  Both rules apply only if the
        side continues beyond the region, and none of `others` prescribes displacements there.
        """
        faces, d = self.of(condition), self.grid.dim
        box, X = faces.region.copy(), faces.X
        if not np.isfinite(box).any():
            return faces
        side = self._of(condition.side, None)
        own = np.broadcast_to(self.grid.copy(side.id) == self.grid.copy(faces.id[:1]), len(side))  # same contact group
        size = X[:, 1].max(axis=0) - X[:, 0].min(axis=0)
        near = SAME * size.max() + rounding(X)
        neighbours = [self.of(other).X for other in others]

        def along(boxes: NDArray[np.float64], axis: int, x: float) -> NDArray[np.bool_]:
            """Return which boxes contain the coordinate x along an axis, and overlap the faces along all other axes."""
            across = np.arange(d) != axis
            low, high = X[:, 0].min(axis=0) - near, X[:, 1].max(axis=0) + near
            beside = ((boxes[:, 0] < high) & (boxes[:, 1] > low))[:, across].all(axis=1)
            return beside & (boxes[:, 0, axis] <= x) & (boxes[:, 1, axis] >= x)

        for axis in range(d):
            for end, sign in enumerate((-1, 1)):
                limit = box[end, axis]
                beyond = limit + 2 * sign * near
                goes_on = np.isfinite(limit) and along(side.X[own], axis, beyond).any()
                if goes_on and not any(along(boxes, axis, beyond).any() for boxes in neighbours):
                    at_end = own & along(side.X, axis, limit) & (np.ptp(side.X, axis=1)[:, axis] > 0)
                    box[end, axis] -= sign * self._beyond_nodes(side, at_end, axis, limit, sign)
        box[:, box[0] > box[1]] = faces.region[:, box[0] > box[1]]
        shorter = self._of(condition.side, box)
        return shorter if len(shorter) else faces  # a region narrower than a cell is not shortened

    def _beyond_nodes(self, side: Surface, at_end: NDArray[np.bool_], axis: int, x: float, sign: int) -> float:
        """Return the length, in m, by which to shorten a region at its end x along a reference axis."""
        faces = np.flatnonzero(at_end)
        X, places = side.corners[faces][:, :, axis], side.places()[faces]
        way, moved = X - X.mean(axis=1, keepdims=True), places - places.mean(axis=1, keepdims=True)
        slope, grid = np.einsum("mk,mkd->d", way, moved) / np.square(way).sum(), self.grid
        there = places.mean(axis=1)[0] + (x - X.mean(axis=1)[0]) * slope - grid.base  # seeded position of the end
        inner = there - sign * NEAR * grid.least / max(float(np.abs(slope).max()), TINY) * slope
        slope = slope / grid.sizes_at(inner)  # derivative of the map, cells/m
        a = np.abs(slope).argmax()
        if np.abs(np.delete(slope, a)).max() > SAME * abs(slope[a]):
            return 0.5 / float(np.linalg.norm(slope))
        share = (sign * np.sign(slope[a]) * grid.in_cells(there)[a]) % 1.0
        return share / abs(float(slope[a])) if share <= (1 + NEAR) / 2 else 0.0

    def check_moves(self, one, holds: Iterable[Displacement], free: NDArray[np.bool_]) -> None:
        """Raise ValueError if walls or prescribed displacements fix all displacement components on the side.

        `free` (nodes, d): whether no wall fixes a component.
        """
        faces, grid = self.of(one), self.grid
        for hold in holds:
            if len(hold.axes(grid.dim)) == grid.dim:
                faces.check_apart(self.of(hold), (one, hold))
        x = faces.places()
        for wall, (axis, end) in SIDES[grid.dim].items():
            fixed = not over_all(grid.comm, int(free[grid.wall_nodes(wall)].sum()))
            off = np.abs(x[:, :, axis] - (grid.lower, grid.upper)[end][axis]).max(axis=1)
            on = np.flatnonzero(off <= NEAR * grid.finest[axis])
            if fixed and len(on):
                what = f"{line(one)}: the wall {wall!r} of the grid fixes the side at {x[on[0]].mean(axis=0)}"
                raise ValueError(f"{what}, must leave it free in this stage")

    def around(self, bodies: Sequence[int]) -> Surface:
        """Return all surface faces of the active `bodies`, including faces in contact with other bodies."""
        key = ("", np.array(bodies).tobytes())
        if key not in self._found:
            there = [bool(here) and i in bodies for i, here in enumerate(self.present)]
            self._found[key] = surface(self.bodies, None, None, there)
        return self._found[key]

    def all(self) -> Surface:
        """Return all surface faces of all contact groups, including faces between groups."""
        start = np.cumsum([0, *(len(body) for body in self.bodies[:-1])])
        copy = np.broadcast_to(self.grid.copy(start), len(self.bodies))
        return joined([self.around(np.flatnonzero(copy == group).tolist()) for group in np.unique(copy)])

    def meeting(self, one: Surface, other: Surface) -> NDArray[np.float64]:
        """Return the reference positions (n, d), in m, of corners that faces of both conditions share."""
        dim, ends = self.grid.dim, np.cumsum([len(body) for body in self.bodies])
        moved = np.array([i if body.map is not None else -1 for i, body in enumerate(self.bodies)])

        def corners(faces: Surface) -> NDArray[np.float64]:
            X, of = faces.corners, moved[np.searchsorted(ends, faces.id, side="right")]
            of = np.broadcast_to(of[:, None, None], (*X.shape[:2], 1))
            return np.concatenate([X, of], axis=2).reshape(-1, dim + 1)

        x, near = corners(other), SAME * min(body.spacing.min() for body in self.bodies) + rounding(one.X)
        distance, _ = cKDTree(corners(one)).query(x, distance_upper_bound=near)
        return x[distance <= near, :dim]
