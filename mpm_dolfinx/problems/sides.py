# SPDX-License-Identifier: MIT
"""The sides of the bodies that conditions name."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.given_values import Places
from mpm_dolfinx.parallel.exchange import Exchange, first
from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.points.cut_domains import Patches
from mpm_dolfinx.points.faces import Surface, joined, limits, surface
from mpm_dolfinx.points.grid import Grid, rounding
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.validation import line


class Sides:
    """Finds the faces of conditions, the same object for conditions on the same faces.

    Parameters
    ----------
    grid, bodies
        Background grid and all bodies of the scene.
    present
        Which bodies are there.
    """

    def __init__(self, grid: Grid, bodies: Sequence[Body], present: Sequence[bool]):
        self.grid, self.bodies, self.present = grid, bodies, present
        self._found: dict[tuple[str, bytes], Surface] = {}

    def of(self, condition) -> Surface:
        """Return the faces of a condition's side and region; ValueError where there are none."""
        key = (str(condition.side), limits(condition.region, self.grid.dim).tobytes())
        if key not in self._found:
            found = surface(self.bodies, condition.side, condition.region, self.present)
            self._found[key] = found.off_axis() if self.grid.has_axis else found
        if not len(self._found[key]):
            where = " in the region" if condition.region is not None else ""
            where += " off the axis" if self.grid.has_axis else ""
            raise ValueError(f"{line(condition)}: no point has this side{where}, must be one of a body")
        copies = np.unique(self.grid.copy(self._found[key].id))
        if len(copies) > 1:
            what = f"{line(condition)}: {len(copies)} groups of bodies have this side"
            raise ValueError(f"{what}, must be one; limit it to one by a region, and give one for each")
        return self._found[key]

    def around(self, bodies: Sequence[int]) -> Surface:
        """Return the faces on all sides of those of some bodies that are there, what lies on other bodies included."""
        key = ("", np.array(bodies).tobytes())
        if key not in self._found:
            there = [bool(here) and i in bodies for i, here in enumerate(self.present)]
            self._found[key] = surface(self.bodies, None, None, there)
        return self._found[key]

    def all(self) -> Surface:
        """Return the faces on all sides of all groups of bodies: what groups have on one another may part."""
        start = np.cumsum([0, *(len(body) for body in self.bodies[:-1])])
        copy = np.broadcast_to(self.grid.copy(start), len(self.bodies))
        return joined([self.around(np.flatnonzero(copy == group).tolist()) for group in np.unique(copy)])


def everywhere(grid: Grid, ask: Callable[[], NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return what functions of the user's give on this process; raise on all what is raised on one."""
    message, value = "", None
    try:
        value = ask()
    except ValueError as error:
        message = str(error)
    if message := first(grid.comm, message):
        raise ValueError(message)
    return value


def on_side(patches: Patches, points: MaterialPoints) -> Places:
    """Return what gives the places at which functions of the user's are asked on a side."""
    return lambda name: patches.X if name == "X" else patches.now(points)


def gathered(grid: Grid, rows: Sequence[tuple], width: int) -> tuple[NDArray, NDArray, NDArray]:
    """Send (cells, positions, values) to the owners of the cells; return (owned cells, positions, values)."""
    empty = (np.empty(0, dtype=np.int64), np.empty((0, grid.dim)), np.empty((0, width)))
    parts = [np.concatenate(column) for column in zip(empty, *rows, strict=True)]
    travel = Exchange(grid.comm, grid.owner(parts[0]))
    cell, x, values = map(travel.send, parts)
    return grid.local(cell), x, values


def check_apart(one, faces: Surface, other, others: Surface) -> None:
    """Refuse two conditions, of a kind that excludes the other, on the same part of a face."""
    first, stop = (np.searchsorted(others.id, faces.id, end) for end in ("left", "right"))
    a = np.repeat(np.arange(len(faces)), stop - first)  # all pairs of parts of one domain's faces
    b = np.arange(len(a)) - np.repeat(np.cumsum(stop - first) - stop, stop - first)
    same = faces.face[a] == others.face[b]
    a, b = a[same], b[same]
    low, high = np.maximum(faces.X[a, 0], others.X[b, 0]), np.minimum(faces.X[a, 1], others.X[b, 1])
    size = faces.X[a, 1] - faces.X[a, 0]
    common = (high - low > 1e-9 * size) | (size <= 1e-9 * size.max(axis=1, keepdims=True))  # they lie across this axis
    both = np.flatnonzero(common.all(axis=1))
    if len(both):
        x = (low[both[0]] + high[both[0]]) / 2
        raise ValueError(f"{line(one)} and {line(other)}: both act at {x}, must not; limit them by regions")


def meeting(bodies: Sequence[Body], one: Surface, other: Surface) -> NDArray[np.float64]:
    """Return the reference positions (k, d), m, of corners that faces of two conditions have in common.

    Bodies that a map has put elsewhere have corners in common with themselves only.
    """

    def corners(faces: Surface) -> NDArray[np.float64]:
        body = np.searchsorted(np.cumsum([len(b) for b in bodies]), faces.id, side="right")
        moved = np.array([i if b.map is not None else -1 for i, b in enumerate(bodies)])[body]
        X = faces.corners
        return np.concatenate([X, np.broadcast_to(moved[:, None, None], (*X.shape[:2], 1))], axis=2).reshape(
            -1, dim + 1
        )

    dim = bodies[0].dim
    x, near = corners(other), 1e-9 * min(b.spacing.min() for b in bodies) + rounding(one.X)
    distance, _ = cKDTree(corners(one)).query(x, distance_upper_bound=near)
    return x[distance <= near, :dim]
