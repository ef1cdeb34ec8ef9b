# SPDX-License-Identifier: MIT
"""Contact of the bodies' surface with rigid tools: no penetration, Coulomb friction, adhesion.

Pressures and friction are those of `cell_contact`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.conditions.sides import everywhere
from mpm_dolfinx.contact.cell_contact import CellContact, Rows, Touch
from mpm_dolfinx.contact.pushed_tools import PushedTools
from mpm_dolfinx.contact.tools import DISTANCE, Distance, Pose, Tool
from mpm_dolfinx.forms.cell_matrices import insert
from mpm_dolfinx.forms.point_forms import Places
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.points.material_points import MaterialPoints

ROUNDING = 1e-15  # of coordinates


@dataclass(frozen=True, eq=False)
class ToolRows(Rows):
    """Points of integration on faces that look at tools.

    now, carried : (m, d), m, position at the start of the step, and where the tool takes what touches it there; shears
    have turned with the tool.
    """

    now: NDArray[np.float64]
    carried: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ToolTouch(Touch):
    """The contact with tools at some displacement.

    x, n : (m, d) place, m, and gradient of the distance; slope : (m, d, d) minus the derivative of the force by the
    displacement of the row alone, N/m.
    """

    x: NDArray[np.float64]
    n: NDArray[np.float64]
    slope: NDArray[np.float64]


class ToolContact(CellContact):
    """The contact in a substep.

    Parameters
    ----------
    grid
        Background grid.
    names, tools, poses
        The tools, and where they are at the end of the substep, as far as loads had pushed them at the start.
    pushed
        How far loads push them.
    rows, places
        The points of integration, and where the grid sees them.
    back
        See `CellContact`.
    """

    def __init__(
        self,
        grid: Grid,
        names: Sequence[str],
        tools: Sequence[Tool],
        poses: Sequence[Pose],
        pushed: PushedTools,
        rows: ToolRows,
        places: Places,
        back: tuple[Exchange, NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]],
    ):
        super().__init__(grid, names, tools, rows, back)
        self._start, self.pushed, self.places = poses, pushed, places
        self._along = np.array([tool.along(grid.dim) for tool in tools])
        self._N = grid.shape_values(rows.cell, places.x)
        self._touch: Latest[ToolTouch] = Latest()

    @property
    def _reaches(self) -> NDArray[np.float64]:
        """Largest coordinates (tools,), m, of what gaps are measured from: true ones where functions give these."""
        own = np.array([callable(tool.shape) for tool in self.contacts])
        return np.where(own, np.abs([self.grid.lower, self.grid.upper]).max(), self.grid.reach)

    @property
    def _reach(self) -> NDArray[np.float64]:
        return self._reaches[self.rows.number]

    @property
    def _gone(self) -> NDArray[np.float64]:
        """How far (tools, d), m, loads have pushed them in the step."""
        return (self.pushed.ways - self.pushed.start)[:, None] * self._along

    @property
    def _poses(self) -> list[Pose]:
        return [pose._replace(shift=pose.shift + gone) for pose, gone in zip(self._start, self._gone, strict=True)]

    def _shapes(self, x: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return distances (m,), m, from the tools at places x (m, d), with their first and second derivatives."""
        d, m = self.grid.dim, len(x)
        gap, n, second = np.zeros(m), np.zeros((m, d)), np.zeros((m, d, d))

        def ask() -> None:
            for number, (tool, pose) in enumerate(zip(self.contacts, self._poses, strict=True)):
                solid = tool.solid(self.grid.h.min())
                rows = np.flatnonzero(self.rows.number == number)
                y = pose.own(x[rows])
                gap[rows], n[rows] = solid.distance(y), solid.normal(y) @ pose.R.T
                second[rows] = pose.R @ solid.curvature(y) @ pose.R.T
                if isinstance(solid, Distance):
                    _check_distance(tool, x[rows] + self.grid.base, gap[rows], n[rows], self.grid.h.min())

        everywhere(self.grid, ask)
        return gap, n, second

    def at(self, u: NDArray[np.float64]) -> ToolTouch:
        """Return the contact at nodal displacements u (nodes, d), m."""
        now = u.copy()
        key = now, self.pressure.copy(), self.along.copy(), self.pushed.ways.copy()
        return self._touch(key, lambda: self._at_u(now), self.grid.comm)

    def _at_u(self, u: NDArray[np.float64]) -> ToolTouch:
        rows = self.rows
        x = rows.now + np.einsum("mk,mkd->md", self._N, u[self.grid.cell_nodes[rows.cell]])
        distance, n, second = self._shapes(x)
        touch = self.touch(distance, n, x - rows.carried - self._gone[rows.number])
        slope = touch.stiff[:, None, None] * n[:, :, None] * n[:, None, :] - touch.push[:, None, None] * second
        return ToolTouch(**vars(touch), x=x, n=n, slope=rows.area[:, None, None] * slope)

    def settle(self, u: NDArray[np.float64], sticks: bool) -> bool:
        """Choose what slips at u, and if asked for what sticks again; return whether that is another choice."""
        return self.grips and self.choose(self.at(u), sticks)

    def augment(self, u: NDArray[np.float64], unknown: NDArray[np.float64]) -> bool:
        """Augment the pressures where means penetrate too deep at u, see `augmented`; return whether they do.

        Where they do not, tools that a load pushes go on until they meet as much, and u with them.

        unknown (tools,): how well the balance tells forces, N.
        """
        touch = self.at(u)
        if self.augmented(touch, touch.x, "does a wall hold the body there?") > 0:
            return True
        if np.isnan(self.pushed.loads).all():
            return False
        of, along = self.rows.number, self._along[self.rows.number]
        slope = self.rows.area * touch.stiff * (touch.n * along).sum(axis=1) ** 2
        met = self.summed(touch.force, 0 * touch.x)[:, : self.grid.dim]
        slope = over_all(self.grid.comm, sum_by(of, slope, len(met)))
        unknown = unknown + ROUNDING * self._reaches * slope
        goes = self.pushed.go(u, np.einsum("kd,kd->k", met, self._along), slope, unknown)
        self._rounds[0] *= not goes  # of augmentations, which begin anew
        return goes

    def gripped(self, u: NDArray[np.float64], points: MaterialPoints) -> MaterialPoints:
        """Return the points with the pressures and shear tractions that tools have on them at u."""
        return self.carried(self.at(u), points)

    def assemble_matrix(self, A: PETSc.Mat, u: NDArray[np.float64]) -> None:
        """Add minus the derivative of the shear forces by slip and pressure at u; who calls finalises it.

        In each cell the area times grip on the means of N, and the product of rise on these and of the sum of k n N.
        """
        if not self.grips:
            return
        touch, N = self.at(u), self.mean(self._N)
        pushes = (self.rows.area * touch.stiff)[:, None, None] * self._N[:, :, None] * touch.n[:, None, :]
        M = np.einsum("ck,cab,cl,c->ckalb", N, touch.grip, N, self.area)
        M += np.einsum("ck,ca,clb->ckalb", N, touch.rise, self.total(pushes))
        count = M.shape[1] * M.shape[2]
        insert(A, self.grid, self.cell.astype(np.int32), M.reshape(len(M), count, count))

    def touching(self) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
        """Return cells (m,), places (m, d), and directions (m, d) in which tools hold what touches at the start."""
        touch, d = self.at(np.zeros_like(self.grid.node_x)), self.grid.dim
        rows = np.flatnonzero(touch.stiff > 0)
        rough = rows[self.strength.any(axis=1)[self.of[rows]]]
        cell, x = (np.concatenate([of[rows], np.repeat(of[rough], d, axis=0)]) for of in (self.rows.cell, touch.x))
        return cell, x, np.concatenate([touch.n[rows], np.tile(np.eye(d), (len(rough), 1))])

    def forces(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces and moments (tools, d + 1) or, in 3D, (tools, 6) of the tools on the bodies, N and N m."""
        touch, middle = self.at(u), np.array([pose.centre + pose.shift for pose in self._poses])
        return self.summed(touch.force, touch.x - middle[self.rows.number])


def _check_distance(tool: Tool, x: NDArray, gap: NDArray, n: NDArray, h: float) -> None:
    """Refuse a function of the user's that is no distance near the tool."""
    size = np.linalg.norm(n, axis=1)
    wrong = np.flatnonzero((np.abs(gap) < h) & (np.abs(size - 1) > DISTANCE))
    if len(wrong):
        what = f"{line(tool)}: shape has slope {size[wrong[0]]:.3g} at {x[wrong[0]]}"
        raise ValueError(f"{what}, must be a signed distance: of slope 1 near the tool")
