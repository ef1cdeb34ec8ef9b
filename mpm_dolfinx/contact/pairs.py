# SPDX-License-Identifier: MIT
"""Possible contact pairs: quadrature points on a surface, each with a place on a tool or another group.

The relative displacement of a pair is w = B u.  B has the nodes of the point's cell and, for groups, of the
other side.  A place on a tool moves with the tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import line
from mpm_dolfinx.conditions.sides import everywhere
from mpm_dolfinx.contact.shapes import DISTANCE, Distance
from mpm_dolfinx.contact.tool import Pose, Tool
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import Exchange


class Geometry(NamedTuple):
    """Geometry of m pairs at some w.

    gap (m,): gap, m, < 0 in penetration; n (m, d): d gap / dw, the outward unit normal of the other side; curvature (m,
    d, d): second derivative, 1/m, None if zero; slip (m, d): slip in the step, m; arm (m, d): lever arm of moments, m;
    shear (m, d): traction before the step, rotated with the tool, Pa.
    """

    gap: NDArray[np.float64]
    n: NDArray[np.float64]
    curvature: NDArray[np.float64] | None
    slip: NDArray[np.float64]
    arm: NDArray[np.float64]
    shear: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pairs:
    """m pairs in owned cells.

    number, cell (m,): contact, local cell; area (m,): m^(d-1); resistance (m,): lower value of both sides, Pa, see
    `conditions`; pressure (m,), shear (m, d): tractions at the points before the step, Pa; x (m, d): positions of the
    points in the grid, m; sign (contacts,): sign of the forces on the points in the results.
    """

    grid: Grid
    number: NDArray[np.int64]
    cell: NDArray[np.int32]
    area: NDArray[np.float64]
    resistance: NDArray[np.float64]
    pressure: NDArray[np.float64]
    shear: NDArray[np.float64]
    x: NDArray[np.float64]
    sign: NDArray[np.float64]

    def at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Geometry:
        """Return the geometry at w (m, d), m, for displacements of tools by loads (contacts,), m, in the step.

        motion: with free tools (contacts, q): displacements, m, and rotations, rad.
        """
        raise NotImplementedError

    @property
    def largest_coordinate(self) -> NDArray[np.float64] | float:
        """Largest coordinate in the calculation of gaps, m; for each pair (m,), or for all."""
        return self.grid.reach

    def other_side(self) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Return the lexicographic cells (m,) and shape functions (m, 2^d) of deformable other sides, else None."""
        return None

    def operator(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return B, which gives w (m d,), m, from the unknowns."""
        value, other = self.grid.shape_values(self.cell, self.x), self.other_side()
        if other is None:
            return at_nodes(self.grid, unknowns, self.cell, value)
        return at_nodes(self.grid, unknowns, self.cell, np.concatenate([value, -other[1]], axis=1), other[0])


@dataclass(frozen=True, eq=False)
class ToolPairs(Pairs):
    """Points on faces that face tools.

    tools, poses (contacts,): tools, and their poses, with displacements by loads up to the start of the step; now,
    carried (m, d): position of the point at the start of the step, and its image under the motion of the tool, m.
    Shears are rotated with the tool.
    """

    tools: Sequence[Tool]
    poses: Sequence[Pose]
    now: NDArray[np.float64]
    carried: NDArray[np.float64]

    def at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Geometry:
        """See `Pairs`."""
        d = self.grid.dim
        m = len(w)
        h = self.grid.least
        gap = np.zeros(m)
        n = np.zeros((m, d))
        second = np.zeros((m, d, d))
        middle = np.zeros((m, d))
        shift = motion if motion.ndim > 1 else motion[:, None] * [tool.along(d) for tool in self.tools]
        x = self.now + w
        carried = self.carried + shift[self.number, :d]
        shear = self.shear.copy()

        def ask() -> None:
            for number, (tool, pose) in enumerate(zip(self.tools, self.poses, strict=True)):
                solid, rows = tool.solid(h), np.flatnonzero(self.number == number)
                before, pose = pose, pose.moved(shift[number])
                if pose.R is not before.R:
                    turn = pose.R @ before.R.T
                    carried[rows] = pose.put(before.own(self.carried[rows]))
                    shear[rows] = shear[rows] @ turn.T
                y, middle[rows] = pose.own(x[rows]), pose.centre + pose.shift
                gap[rows], n[rows] = solid.distance(y), solid.normal(y) @ pose.R.T
                second[rows] = pose.R @ solid.curvature(y) @ pose.R.T
                if isinstance(solid, Distance):
                    _check_distance(tool, x[rows] + self.grid.base, gap[rows], n[rows], h)

        everywhere(self.grid, ask)
        return Geometry(gap, n, second, x - carried, x - middle, shear)

    @property
    def largest_coordinate(self) -> NDArray[np.float64]:
        """See `Pairs`: user functions are evaluated at true positions, so these determine the rounding error."""
        true = np.array([callable(tool.shape) for tool in self.tools])[self.number]
        return np.where(true, np.abs([self.grid.lower, self.grid.upper]).max(), self.grid.reach)


@dataclass(frozen=True, eq=False)
class FacePairs(Pairs):
    """Points on the surface of one group, and opposite places along their normals on the faces of another.

    other (m,): lexicographic cell of the other side; y (m, d): position of the place in the grid, m; n (m, d): its
    outward normal; offset (m, d): from the place to the point, without the displacement of the step, m; place (m,):
    number of the point, equal for all its pairs in a step.
    """

    other: NDArray[np.int64]
    y: NDArray[np.float64]
    n: NDArray[np.float64]
    offset: NDArray[np.float64]
    place: NDArray[np.int64]

    def at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Geometry:
        """See `Pairs`; moments refer to the positions at the start of the step."""
        gap = np.einsum("md,md->m", self.n, self.offset + w)
        return Geometry(gap, self.n, None, w, self.x + self.grid.base, self.shear)

    def other_side(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """See `Pairs`."""
        return self.other, shape_values_in(self.grid, self.other, self.y)


def shape_values_in(grid: Grid, cells: NDArray[np.int64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Q1 shape functions (m, 2^d) of lexicographic cells (m,) of any process at positions x (m, d), m."""
    index = np.stack(np.unravel_index(cells % grid.cells, tuple(grid.shape)), axis=1)
    off = grid.in_cells(x) - index - 0.5
    return np.prod(0.5 + off[:, None] * grid.signs, axis=2)


def at_nodes(
    grid: Grid,
    unknowns: Unknowns,
    cell: NDArray[np.int32],
    value: NDArray[np.float64],
    other: NDArray[np.int64] | None = None,
) -> PETSc.Mat:
    """Return the matrix with values (m, 2^d) at the nodes of cells, component by component.

    other: lexicographic cells of any process; values (m, 2 * 2^d) then include their nodes.
    """
    d = grid.dim
    numbers = unknowns.map.indices.reshape(-1, d)
    column = numbers[grid.cell_nodes[cell]]
    if other is not None:
        exchange = Exchange(grid.comm, grid.owner(other))
        columns = exchange.back(numbers[grid.cell_nodes[grid.local(exchange.send(other))]])
        column = np.concatenate([column, columns], axis=1)
    column = column.swapaxes(1, 2)
    value, m = np.broadcast_to(value[:, None], (len(value), d, value.shape[1])), len(cell) * d
    row = np.broadcast_to(np.arange(m).reshape(-1, d, 1), column.shape)
    kept = column >= 0
    shape, own = (m, max(1, unknowns.global_size)), (row[kept], column[kept])
    return petsc_matrix(scipy.sparse.csr_matrix((value[kept], own), shape=shape), unknowns.size, grid.comm)


def petsc_matrix(rows: scipy.sparse.csr_matrix, columns: int, comm: MPI.Intracomm, own: bool = False) -> PETSc.Mat:
    """Return a matrix of this process's rows, with `columns` local columns; own: whether all entries are local."""
    rows.sort_indices()  # PETSc requires it
    start = int(comm.exscan(columns) or 0) if own and comm.size > 1 else 0
    csr = [values.astype(PETSc.IntType) for values in (rows.indptr, rows.indices + start)]
    A = PETSc.Mat().createAIJ(((rows.shape[0], None), (columns, None)), csr=(*csr, rows.data), comm=comm)
    A.assemble()
    return A


def _check_distance(tool: Tool, x: NDArray, gap: NDArray, n: NDArray, h: float) -> None:
    """Raise an error for a user function that is not a signed distance near the tool."""
    size = np.linalg.norm(n, axis=1)
    wrong = np.flatnonzero((np.abs(gap) < h) & (np.abs(size - 1) > DISTANCE))
    if len(wrong):
        what = f"{line(tool)}: shape has slope {size[wrong[0]]:.3g} at {x[wrong[0]]}"
        raise ValueError(f"{what}, must be a signed distance: of slope 1 near the tool")
