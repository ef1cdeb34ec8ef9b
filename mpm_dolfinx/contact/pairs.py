# SPDX-License-Identifier: MIT
"""Contact pairs: a quadrature point on a surface, and the opposite position on a tool or another group of bodies.

The displacement of the point relative to the opposite position is `w = B u`.  The vector u contains the nodal
displacements.  B interpolates u in the cell of the point.  Between groups, B subtracts u at the opposite position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import line
from mpm_dolfinx.contact.shapes import DISTANCE, Distance
from mpm_dolfinx.contact.tool import Pose, Tool
from mpm_dolfinx.forms.unknowns import Unknowns, petsc_matrix
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import Exchange, together


class Geometry(NamedTuple):
    """Geometry of m contact pairs at relative displacements w (m, d), in m."""

    gap: NDArray[np.float64]  # gap (m,), m; negative in penetration
    n: NDArray[np.float64]  # derivative of the gap with respect to w (m, d): outward unit normal of the other side
    curvature: NDArray[np.float64] | None  # second derivative of the gap (m, d, d), 1/m; None if zero
    slip: NDArray[np.float64]  # slip in the step (m, d), m
    arm: NDArray[np.float64]  # lever arm for moments (m, d), m
    shear: NDArray[np.float64]  # shear traction before the step, rotated with the tool (m, d), Pa


@dataclass(frozen=True, eq=False)
class Pairs:
    """Contact pairs of m points in cells that this process owns."""

    grid: Grid
    number: NDArray[np.int64]  # index of the contact (m,)
    cell: NDArray[np.int32]  # local cell of the point (m,)
    area: NDArray[np.float64]  # area of the surface that the point represents (m,), m^(d-1)
    resistance: NDArray[np.float64]  # reference modulus, the lower value of both sides (m,), Pa, see `conditions`
    holding: NDArray[np.float64]  # for tools on soils that yield a lower modulus (m,), Pa, see `conditions`
    inertia: NDArray[np.float64]  # density / (GAMMA dt)^2, the lower value of both sides (m,), Pa/m^2; 0 in statics
    pressure: NDArray[np.float64]  # contact pressure at the point before the step (m,), Pa
    shear: NDArray[np.float64]  # shear traction at the point before the step (m, d), Pa
    x: NDArray[np.float64]  # position of the point in the undeformed grid (m, d), m
    sign: NDArray[np.float64]  # sign of the forces on points in the results (m,)

    def at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Geometry:
        """Return the geometry at the relative displacements w (m, d), in m.

        `motion` (contacts, q), in m and rad: displacements and rotations of tools due to forces in the step.
        """
        raise NotImplementedError

    @property
    def sunk(self) -> NDArray[np.float64]:
        """Gap (m,) at the start of the step where it is negative, otherwise 0, in m."""
        raise NotImplementedError

    @property
    def largest_coordinate(self) -> NDArray[np.float64] | float:
        """Largest absolute value, in m, of the coordinates from which gaps are computed."""
        return self.grid.reach

    def other_side(self) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Return the cells (m,) and shape functions (m, 2^d) at the opposite positions, or None for tools."""
        return None

    def operator(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return the matrix B, which maps nodal displacements to relative displacements w (m d,)."""
        value, other = self.grid.shape_values(self.cell, self.x), self.other_side()
        if other is None:
            return at_nodes(self.grid, unknowns, self.cell, value)
        return at_nodes(self.grid, unknowns, self.cell, np.concatenate([value, -other[1]], axis=1), other[0])


@dataclass(frozen=True, eq=False)
class ToolPairs(Pairs):
    """Contact pairs between tools and points on a surface."""

    tools: Sequence[Tool]  # (contacts,)
    poses: Sequence[Pose]  # poses of tools at the end of the substep, without motion by loads in the step (contacts,)
    now: NDArray[np.float64]  # position of the point at the start of the step (m, d), m
    carried: NDArray[np.float64]  # position `now` after the motion of the tool (m, d), m
    start_gap: NDArray[np.float64]  # gap at the start of the step (m,), m
    side_gap: NDArray[np.float64]  # gap of the position `now` from the tool in its pose `poses` (m,), m
    side: NDArray[np.float64]  # outward unit normal of the tool there (m, d)

    def at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Geometry:
        """See `Pairs`."""
        d = self.grid.dim
        m = len(w)
        h = self.grid.least
        gap = np.zeros(m)
        n = np.zeros((m, d))
        second = np.zeros((m, d, d))
        middle = np.zeros((m, d))
        x = self.now + w
        carried = self.carried + motion[self.number, :d]
        shear = self.shear.copy()

        def ask() -> None:
            for number, (tool, pose) in enumerate(zip(self.tools, self.poses, strict=True)):
                rows = np.flatnonzero(self.number == number)
                before, pose = pose, pose.moved(motion[number])
                if pose.R is not before.R:
                    turn = pose.R @ before.R.T
                    carried[rows] = pose.put(before.own(self.carried[rows]))
                    shear[rows] = shear[rows] @ turn.T
                y, middle[rows] = pose.own(x[rows]), pose.centre + pose.shift
                solid = tool.solid(h)
                gap[rows], normal, curvature = solid.geometry(y)
                n[rows], second[rows] = normal @ pose.R.T, pose.R @ curvature @ pose.R.T
                if isinstance(solid, Distance):
                    _check_distance(tool, x[rows] + self.grid.base, gap[rows], n[rows], h)

        together(self.grid.comm, ask)
        # in an iteration, a point may pass through the tool; its gap then refers to the side of the tool it came from
        behind = np.flatnonzero(np.einsum("md,md->m", n, self.side) < 0)
        n[behind], second[behind] = self.side[behind], 0.0
        moved = (w - carried + self.carried)[behind]
        gap[behind] = self.side_gap[behind] + np.einsum("md,md->m", n[behind], moved)
        return Geometry(gap, n, second, x - carried, x - middle, shear)

    @property
    def sunk(self) -> NDArray[np.float64]:
        """See `Pairs`."""
        return np.minimum(0.0, self.start_gap)

    @property
    def largest_coordinate(self) -> NDArray[np.float64]:
        """See `Pairs`."""
        true = np.array([callable(tool.shape) for tool in self.tools])[self.number]
        return np.where(true, np.abs([self.grid.lower, self.grid.upper]).max(), self.grid.reach)


@dataclass(frozen=True, eq=False)
class FacePairs(Pairs):
    """Contact pairs of a point on one group, and a position on another group, along the normal at the point."""

    other: NDArray[np.int64]  # lexicographic index of the opposite cell (m,)
    y: NDArray[np.float64]  # opposite position in the undeformed grid (m, d), m
    n: NDArray[np.float64]  # outward unit normal of the other side at y (m, d)
    offset: NDArray[np.float64]  # vector from y to the point, without the displacement in the step (m, d), m
    place: NDArray[np.int64]  # identifier of the point, the same in all updates of the pairs in a step (m,)
    # outward area vector of the point at the start of the step (m, d), m^(d-1); (m, 0) if no contact conducts
    outward: NDArray[np.float64]

    def at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Geometry:
        """See `Pairs`.  Lever arms refer to positions at the start of the step."""
        gap = np.einsum("md,md->m", self.n, self.offset + w)
        return Geometry(gap, self.n, None, w, self.x + self.grid.base, self.shear)

    @property
    def sunk(self) -> NDArray[np.float64]:
        """See `Pairs`."""
        return np.minimum(0.0, np.einsum("md,md->m", self.n, self.offset))

    def other_side(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """See `Pairs`."""
        return self.other, shape_values_in(self.grid, self.other, self.y)

    def conducting(self, unknowns: Unknowns, closed: NDArray[np.bool_], slopes: NDArray[np.float64]) -> PETSc.Mat:
        """Return the result of `between_cells` for the pairs flagged by `closed` (m,)."""
        cells = np.column_stack([self.grid.cell_number[self.cell], self.other])
        return between_cells(unknowns, self.grid, cells[closed], slopes)


def shape_values_in(grid: Grid, cells: NDArray[np.int64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Q1 shape functions (m, 2^d) of cells (m,), by lexicographic index, at positions x (m, d), in m."""
    index = np.stack(np.unravel_index(cells % grid.cells, tuple(grid.shape)), axis=1)
    off = grid.in_cells(x) - index - 0.5
    return np.prod(0.5 + off[:, None] * grid.signs, axis=2)


def on_owners(grid: Grid, cells: NDArray[np.int64]) -> NDArray[np.int32]:
    """Send lexicographic indices of cells to the processes that own the cells.  Return the local indices there."""
    return grid.locals[Exchange(grid.comm, grid.owner(cells)).send(cells)]


def at_nodes(
    grid: Grid,
    unknowns: Unknowns,
    cell: NDArray[np.int32],
    value: NDArray[np.float64],
    other: NDArray[np.int64] | None = None,
) -> PETSc.Mat:
    """Return the matrix that maps the unknowns to weighted sums (m d,) of nodal displacements.

    `value` (m, 2^d): weights at the nodes of the local cells `cell` (m,).
    `other` (m,): lexicographic indices of other cells; `value` (m, 2 * 2^d) then has weights at their nodes too.
    """
    d = grid.dim
    numbers = unknowns.map.indices.reshape(-1, d)
    column = numbers[grid.cell_nodes[cell]]
    if other is not None:
        exchange = Exchange(grid.comm, grid.owner(other))
        columns = exchange.back(numbers[grid.cell_nodes[grid.locals[exchange.send(other)]]])
        column = np.concatenate([column, columns], axis=1)
    column = column.swapaxes(1, 2)
    value, m = np.broadcast_to(value[:, None], (len(value), d, value.shape[1])), len(cell) * d
    row = np.broadcast_to(np.arange(m).reshape(-1, d, 1), column.shape)
    kept = column >= 0
    shape, own = (m, max(1, unknowns.global_size)), (row[kept], column[kept])
    return petsc_matrix(scipy.sparse.csr_matrix((value[kept], own), shape=shape), unknowns.size, grid.comm)


def between_cells(unknowns: Unknowns, grid: Grid, pairs: NDArray[np.int64], slopes: NDArray[np.float64]) -> PETSc.Mat:
    """Return the derivative of the outflow of cells with respect to cell pressures.

    `pairs` (m, 2): lexicographic indices of cells.  Fluid flows from the first to the second cell of each pair.
    `slopes` (2, m), m^d/(Pa s): derivative of the flow with respect to the pressure of the first cell, and minus the
    derivative with respect to the pressure of the second cell.
    """
    (one, other), (own, far) = pairs.T, slopes
    rows, columns = np.concatenate([one, one, other, other]), np.concatenate([one, other, one, other])
    to = Exchange(grid.comm, grid.owner(columns))
    columns = to.back(unknowns.map.indices[grid.locals[to.send(columns)]])
    to = Exchange(grid.comm, grid.owner(rows))
    rows, columns = unknowns.map.indices[grid.locals[to.send(rows)]], to.send(columns)
    values = to.send(np.concatenate([own, -far, -own, far]))
    start = (grid.comm.exscan(unknowns.size) or 0) if grid.comm.size > 1 else 0
    shape = (unknowns.size, max(1, unknowns.global_size))
    at = rows - start, columns
    return petsc_matrix(scipy.sparse.csr_matrix((values, at), shape=shape), unknowns.size, unknowns.comm)


def _check_distance(tool: Tool, x: NDArray, gap: NDArray, n: NDArray, h: float) -> None:
    """Raise an error if a user's distance function has a slope other than 1 near the tool."""
    size = np.linalg.norm(n, axis=1)
    wrong = np.flatnonzero((np.abs(gap) < h) & (np.abs(size - 1) > DISTANCE))
    if len(wrong):
        what = f"{line(tool)}: shape has slope {size[wrong[0]]:.3g} at {x[wrong[0]]}"
        raise ValueError(f"{what}, must be a signed distance, with slope 1 near the tool")
