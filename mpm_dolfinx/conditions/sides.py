# SPDX-License-Identifier: MIT
"""Faces of the sides to which conditions apply."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import NEAR, SAME, TINY
from mpm_dolfinx.base.validation import Places, line
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Region, Surface, joined, limits, surface
from mpm_dolfinx.conditions.conditions import Displacement
from mpm_dolfinx.domains.cut_domains import Patches
from mpm_dolfinx.grid.grid import SIDES, Grid, ranges, rounding
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all
from mpm_dolfinx.points.material_points import MaterialPoints


class Sides:
    """Finder of the faces on which a condition acts.  Conditions on the same faces share one `Surface`.

    Parameters
    ----------
    grid, bodies
        Background grid and all bodies of the scene.
    present
        Which bodies are active in the stage.
    """

    def __init__(self, grid: Grid, bodies: Sequence[Body], present: Sequence[bool]):
        self.grid = grid
        self.bodies = bodies
        self.present = present
        self._found: dict[tuple[str, bytes], Surface] = {}

    def of(self, condition) -> Surface:
        """Return the faces of a condition's side and region; raise ValueError if there are none."""
        found = self._of(condition.side, condition.region)
        if not len(found):
            where = " in the region" if condition.region is not None else ""
            where += " off the axis" if self.grid.has_axis else ""
            raise ValueError(f"{line(condition)}: no point has this side{where}, must be a side of a body")
        copies = np.unique(self.grid.copy(found.id))
        if len(copies) > 1:
            what = f"{line(condition)}: {len(copies)} groups of bodies have this side"
            raise ValueError(f"{what}, must be one; limit each condition to one group by a region")
        return found

    def _of(self, side: str, region: Region | None) -> Surface:
        """Return the faces of a side in a region."""
        key = (str(side), limits(region, self.grid.dim).tobytes())
        if key not in self._found:
            found = surface(self.bodies, side, region, self.present)
            self._found[key] = found.off_axis() if self.grid.has_axis else found
        return self._found[key]

    def held(self, condition: Displacement, others: Sequence[Displacement]) -> Surface:
        """Return the faces of a prescribed displacement, without cells that the region covers by at most one half.

        The last prescribed node also moves half a cell outside the region.  If the region covers at most half of its
        last cell, the faces therefore end at the inner side of this cell.  On a side inclined to the grid, they end
        half a cell before the end of the region.  This applies only where the side continues outside the region and no
        other condition prescribes the same components there.

        Parameters
        ----------
        condition
            The prescribed displacement.
        others
            Other prescribed displacements of the same components.
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
            """Return which boxes (m, 2, d) are adjacent to the faces and contain the coordinate x along an axis."""
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
        return shorter if len(shorter) else faces  # the region is narrower than a cell

    def _beyond_nodes(self, side: Surface, at_end: NDArray[np.bool_], axis: int, x: float, sign: int) -> float:
        """Return the length, m, by which to shorten a region that ends at coordinate x along a reference axis.

        `at_end` (m,) tells which faces of the side contain x; `sign` is the direction out of the region.  See `held`.
        """
        faces = np.flatnonzero(at_end)
        X, places = side.corners[faces][:, :, axis], side.places()[faces]
        way, moved = X - X.mean(axis=1, keepdims=True), places - places.mean(axis=1, keepdims=True)
        slope, grid = np.einsum("mk,mkd->d", way, moved) / np.square(way).sum(), self.grid
        there = places.mean(axis=1)[0] + (x - X.mean(axis=1)[0]) * slope - grid.base  # seeded position of the end
        inner = there - sign * NEAR * grid.least / max(float(np.abs(slope).max()), TINY) * slope
        slope = slope / (grid.h if grid.even else grid.sizes_at(inner[None])[0])  # derivative of the map, cells/m
        a = np.abs(slope).argmax()
        if np.abs(np.delete(slope, a)).max() > SAME * abs(slope[a]):
            return 0.5 / float(np.linalg.norm(slope))
        if grid.even:
            end = (places.mean(axis=1)[0, a] - grid.lower[a]) / grid.h[a] + (x - X.mean(axis=1)[0]) * slope[a]
        else:
            end = grid.in_cells(there[None])[0, a]
        share = (sign * np.sign(slope[a]) * end) % 1.0
        return share / abs(float(slope[a])) if share <= (1 + NEAR) / 2 else 0.0

    def check_moves(self, one, holds: Iterable[Displacement], free: NDArray[np.bool_]) -> None:
        """Raise ValueError if a displacement or a wall of the grid fixes all components of faces of a condition.

        `holds` are the prescribed displacements of the stage; `free` (nodes, d) are components that no wall fixes.
        """
        faces, grid = self.of(one), self.grid
        for hold in holds:
            if len(hold.axes(grid.dim)) == grid.dim:
                check_apart(one, faces, hold, self.of(hold))
        x = faces.places()
        for wall, (axis, end) in SIDES[grid.dim].items():
            fixed = not over_all(grid.comm, int(free[grid.wall_nodes(wall)].sum()))
            off = np.abs(x[:, :, axis] - (grid.lower, grid.upper)[end][axis]).max(axis=1)
            on = np.flatnonzero(off <= NEAR * grid.finest[axis])
            if fixed and len(on):
                what = f"{line(one)}: the wall {wall!r} of the grid fixes the side at {x[on[0]].mean(axis=0)}"
                raise ValueError(f"{what}, must leave it free in this stage")

    def around(self, bodies: Sequence[int]) -> Surface:
        """Return all surface faces of some active bodies, including faces in contact with other bodies."""
        key = ("", np.array(bodies).tobytes())
        if key not in self._found:
            there = [bool(here) and i in bodies for i, here in enumerate(self.present)]
            self._found[key] = surface(self.bodies, None, None, there)
        return self._found[key]

    def all(self) -> Surface:
        """Return all surface faces of all contact groups, including faces between groups, which may separate."""
        start = np.cumsum([0, *(len(body) for body in self.bodies[:-1])])
        copy = np.broadcast_to(self.grid.copy(start), len(self.bodies))
        return joined([self.around(np.flatnonzero(copy == group).tolist()) for group in np.unique(copy)])


def everywhere(grid: Grid, ask: Callable[[], NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the values of user functions on this process.  An error on one process is raised on all processes."""
    message, value = "", None
    try:
        value = ask()
    except ValueError as error:
        message = str(error)
    if message := first(grid.comm, message):
        raise ValueError(message)
    return value


def on_side(patches: Patches, points: MaterialPoints) -> Places:
    """Return the function that gives user functions the reference or current positions of points on a side."""
    return lambda name: patches.X if name == "X" else patches.now(points) + patches.base


def gathered(grid: Grid, rows: Sequence[tuple], width: int) -> tuple[NDArray, NDArray, NDArray]:
    """Send rows (cells, positions, values) to the owners of the cells; return local cells, positions and values."""
    empty = (np.empty(0, dtype=np.int64), np.empty((0, grid.dim)), np.empty((0, width)))
    parts = [np.concatenate(column) for column in zip(empty, *rows, strict=True)]
    travel = Exchange(grid.comm, grid.owner(parts[0]))
    cell, x, values = map(travel.send, parts)
    return grid.local(cell), x, values


def check_apart(one, faces: Surface, other, others: Surface) -> None:
    """Raise an error if two conditions that exclude each other act on the same part of a face."""
    first, stop = (np.searchsorted(others.id, faces.id, end) for end in ("left", "right"))
    a, b = ranges(first, stop - first)  # all pairs of faces of the same domain
    same = faces.face[a] == others.face[b]
    a, b = a[same], b[same]
    low, high = np.maximum(faces.X[a, 0], others.X[b, 0]), np.minimum(faces.X[a, 1], others.X[b, 1])
    size = faces.X[a, 1] - faces.X[a, 0]
    common = (high - low > SAME * size) | (size <= SAME * size.max(axis=1, keepdims=True))  # or no extent along an axis
    both = np.flatnonzero(common.all(axis=1))
    if len(both):
        x = (low[both[0]] + high[both[0]]) / 2
        raise ValueError(f"{line(one)} and {line(other)}: both act at {x}, must not; limit them by regions")


def meeting(bodies: Sequence[Body], one: Surface, other: Surface) -> NDArray[np.float64]:
    """Return the reference positions (k, d), m, of corners that faces of two conditions have in common.

    A mapped body has no common corners with other bodies.
    """

    def corners(faces: Surface) -> NDArray[np.float64]:
        body = np.searchsorted(np.cumsum([len(b) for b in bodies]), faces.id, side="right")
        moved = np.array([i if b.map is not None else -1 for i, b in enumerate(bodies)])[body]
        X = faces.corners
        return np.concatenate([X, np.broadcast_to(moved[:, None, None], (*X.shape[:2], 1))], axis=2).reshape(
            -1, dim + 1
        )

    dim = bodies[0].dim
    x, near = corners(other), SAME * min(b.spacing.min() for b in bodies) + rounding(one.X)
    distance, _ = cKDTree(corners(one)).query(x, distance_upper_bound=near)
    return x[distance <= near, :dim]
