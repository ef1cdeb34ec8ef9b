# SPDX-License-Identifier: MIT
"""Contact of the bodies' surface with rigid tools: no penetration, Coulomb friction, adhesion.

The normal pressure at a place with the gap g, and its energy by area, are

    p = <lambda - k g>,     psi = p^2 / (2 k).

k is no stiffer than lets a Q1 field follow curved tools, to which its places ask for more than it has nodes;
lambda, one value a tool and cell, is at first the pressure of the step before, and augmented (Uzawa) until the cells'
surfaces penetrate by less than `DEPTH` in the mean.  Friction acts on the mean slip s of the cell against the tool in
the step, from the traction t_n of the step before, which the points keep,

    t = P (t_n - k_t s),     |t| <= mu p + min(adhesion, 10 p)      by radial return,

P the projection on the tangent plane: what sticks is elastic with a stiffness k_t, and gives back what it took.
What slips is chosen after each Newton step (active sets): at first all sticks, whatever it would bear; what slips back
sticks again, as soon as the balance is near, and then for as long.  Decided in each residual anew all would slip to and
fro, for there is no stiffness in slip.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.constitutive.fields import SceneMaterials
from mpm_dolfinx.errors import NotConverged
from mpm_dolfinx.forms.cell_matrices import insert
from mpm_dolfinx.forms.point_forms import Places
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all
from mpm_dolfinx.points.cut_domains import CutDomains
from mpm_dolfinx.points.faces import Surface
from mpm_dolfinx.points.grid import Grid, sum_by
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.problems.conditions import HOLD, Displacement, holding, resistance
from mpm_dolfinx.problems.sides import everywhere
from mpm_dolfinx.problems.tools import DISTANCE, Distance, Pose, Tool
from mpm_dolfinx.validation import line

STIFF = 100.0
"""k in units of (what resists) / (cell size)."""
DEPTH = 5e-4  # cells: mean penetration that is left
BEGINS = 1e-2  # cells: how deep a tool may be in a body as it begins, and where a displacement is given
TOUCH = 1e-13  # of the grid: what is nearer touches, but for rounding; light bodies press no deeper than 1e-8 cells
NEAR = 0.1  # cells: corners that are nearer go with the tool
FACING = 0.5  # cosine between a face's normal and the way to the tool above which it looks at the tool
SLIVER = 0.25  # of a cell's face: of what is smaller less penetration counts
ROUNDS = 20  # augmentations that are tried
CLOSE = 1e-6  # of the traction that slips: what is nearer stays what it is
LEAST = 1e-300
RAMP = 10.0  # adhesion over the normal pressure, at most


def pressure_name(number: int) -> str:
    """Return the name under which points have the pressure (n,), Pa, of a tool on their faces."""
    return f"tool_{number}_pressure"


def shear_name(number: int) -> str:
    """Return the name under which points keep the shear traction (n, d), Pa, of a tool."""
    return f"tool_{number}_shear"


class Rows(NamedTuple):
    """Points of integration on faces that look at tools; arrays over m rows in owned cells.

    number, cell : (m,) tool, and local cell; area : (m,), m^(d-1); resistance, holding : (m,), Pa, see `conditions`;
    pressure : (m,) that the tool had, Pa; now, carried, shear : (m, d) position at the start of the step, where the
    tool takes what touches it there, m; and shear traction that it had, turned with the tool, Pa.
    """

    number: NDArray[np.int64]
    cell: NDArray[np.int32]
    area: NDArray[np.float64]
    resistance: NDArray[np.float64]
    holding: NDArray[np.float64]
    pressure: NDArray[np.float64]
    now: NDArray[np.float64]
    carried: NDArray[np.float64]
    shear: NDArray[np.float64]


class Touch(NamedTuple):
    """The contact at some displacement: of m rows, and of k conditions, one a tool and cell.

    x, n, force : (m, d) place, m, gradient of the distance, force on the body, N; push : (m,) pressure, Pa; stiff :
    (m,) minus its derivative by the gap, Pa/m; slope : (m, d, d) minus that of the force by the displacement of the row
    alone, N/m; pressure : (k,) mean of the pressure, Pa; on, sticks : (k,) what touches, and does not slip; trial,
    shear : (k, d) traction if all stuck, and as it is, Pa; most : (k,) what it may be, Pa; grip : (k, d, d) minus its
    derivative by the slip, Pa/m; rise : (k, d) that by the pressure.
    """

    x: NDArray[np.float64]
    n: NDArray[np.float64]
    force: NDArray[np.float64]
    push: NDArray[np.float64]
    stiff: NDArray[np.float64]
    slope: NDArray[np.float64]
    pressure: NDArray[np.float64]
    on: NDArray[np.bool_]
    sticks: NDArray[np.bool_]
    trial: NDArray[np.float64]
    shear: NDArray[np.float64]
    most: NDArray[np.float64]
    grip: NDArray[np.float64]
    rise: NDArray[np.float64]


class ToolContact:
    """The contact in a substep.

    Parameters
    ----------
    grid
        Background grid.
    tools, poses
        The tools, and where they are at the end of the substep.
    rows, places
        The points of integration, and where the grid sees them.
    travel, points, number, area
        The way of the rows to the owners of their cells; and of each row before it: index of its material point on this
        process, tool, and area, m^(d-1).
    """

    def __init__(
        self,
        grid: Grid,
        tools: Sequence[Tool],
        poses: Sequence[Pose],
        rows: Rows,
        places: Places,
        back: tuple[Exchange, NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]],
    ):
        self.grid, self._tools, self._poses, self._rows, self.places, self._back = (
            grid,
            tools,
            poses,
            rows,
            places,
            back,
        )
        key, self._at = np.unique(rows.number * grid.num_local + rows.cell, return_inverse=True)
        self._number, self._cell = np.divmod(key, grid.num_local)
        self._N = grid.shape_values(rows.cell, places.x)
        self._whole = sum_by(self._at, rows.area, len(key))
        h = grid.h.min()
        self._stiffness, self._hold = STIFF / h * rows.resistance, HOLD / h * self._mean(rows.holding)
        strength = np.array([(tool.friction, tool.adhesion) for tool in tools], dtype=float)
        self._strength = strength[self._number]
        self.grips = any(tool.grips for tool in tools)
        self._along = np.zeros((len(key), grid.dim))  # direction of the shear of what slips, else zero
        self._turned = np.zeros(len(key), dtype=bool)  # what has slipped, and stuck again
        self._lambda, self._rounds = self._mean(rows.pressure), np.zeros(1, dtype=np.int64)
        self._touch: Latest[Touch] = Latest()

    def _total(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (k, ...) of values (m, ...) in the conditions."""
        size = len(self._whole)
        columns = values.reshape(len(values), int(np.prod(values.shape[1:], dtype=int))).T
        out = np.stack([sum_by(self._at, column, size) for column in columns], axis=1)
        return out.reshape(size, *values.shape[1:])

    def _mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the means (k, ...) over the area of values (m, ...) in the conditions."""
        each = (slice(None), *(None,) * (values.ndim - 1))
        return self._total(self._rows.area[each] * values) / self._whole[each]

    def _shapes(self, x: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return distances (m,), m, from the tools at places x (m, d), with their first and second derivatives."""
        d, m = self.grid.dim, len(x)
        gap, n, second = np.zeros(m), np.zeros((m, d)), np.zeros((m, d, d))

        def ask() -> None:
            for number, (tool, pose) in enumerate(zip(self._tools, self._poses, strict=True)):
                solid = tool.solid(self.grid.h.min())
                rows = np.flatnonzero(self._rows.number == number)
                y = pose.own(x[rows])
                gap[rows], n[rows] = solid.distance(y), solid.normal(y) @ pose.R.T
                second[rows] = pose.R @ solid.curvature(y) @ pose.R.T
                if isinstance(solid, Distance):
                    _check_distance(tool, x[rows], gap[rows], n[rows], self.grid.h.min())

        everywhere(self.grid, ask)
        return gap, n, second

    def at(self, u: NDArray[np.float64]) -> Touch:
        """Return the contact at nodal displacements u (nodes, d), m."""
        now = u.copy()
        key = now, self._lambda.copy(), self._along.copy()
        return self._touch(key, lambda: self._at_u(now), self.grid.comm)

    def _at_u(self, u: NDArray[np.float64]) -> Touch:
        rows, at = self._rows, self._at
        x = rows.now + np.einsum("mk,mkd->md", self._N, u[self.grid.cell_nodes[rows.cell]])
        distance, n, second = self._shapes(x)
        push, area = np.maximum(0.0, self._lambda[at] - self._stiffness * distance), rows.area
        touches = (push > 0) | (distance <= TOUCH * self._reach)
        stiff, pressure = self._stiffness * touches, self._mean(push)
        slope = stiff[:, None, None] * n[:, :, None] * n[:, None, :] - push[:, None, None] * second
        on = self._total(touches.astype(float)) > 0
        normal = self._mean(n)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), LEAST)
        friction = _, _, shear, *_ = self._friction(normal, self._mean(x - rows.carried), pressure, on)
        force = area[:, None] * (push[:, None] * n + shear[at])
        return Touch(x, n, force, push, stiff, area[:, None, None] * slope, pressure, on, *friction)

    def _friction(self, n: NDArray, slip: NDArray, pressure: NDArray, on: NDArray) -> tuple:
        """Return what a `Touch` has from `sticks` on; n (k, d): normals."""
        P = np.eye(n.shape[1]) - n[:, :, None] * n[:, None, :]
        hold = np.where(self._strength.any(axis=1), self._hold, 0.0) * on
        (mu, adhesion), slips = self._strength.T, self._slips
        trial = np.einsum("kij,kj->ki", P, self._mean(self._rows.shear) * on[:, None] - hold[:, None] * slip)
        size, ramp = np.maximum(np.linalg.norm(trial, axis=1), LEAST), RAMP * pressure < adhesion
        most = mu * pressure + np.minimum(adhesion, RAMP * pressure)
        onward = slips & (np.einsum("kd,kd->k", trial, self._along) > 0)  # what turns back keeps its shear for now
        along = np.where(onward[:, None], trial / size[:, None], self._along)
        turns = hold * np.where(slips, onward * most / size, 1.0)
        grip = turns[:, None, None] * (P - along[:, :, None] * along[:, None, :])
        rise = (mu + RAMP * ramp)[:, None] * along
        shear = np.where(slips[:, None], most[:, None] * along, trial)
        return ~slips & on, trial, shear, most, grip, rise

    @property
    def _slips(self) -> NDArray[np.bool_]:
        return self._along.any(axis=1)

    def settle(self, u: NDArray[np.float64], sticks: bool) -> bool:
        """Choose what slips at u, and if asked for what sticks again; return whether that is another choice."""
        if not self.grips:
            return False
        touch, before = self.at(u), self._slips
        size = np.linalg.norm(touch.trial, axis=1)
        goes_on = (size > (1 - CLOSE) * touch.most) & (np.einsum("kd,kd->k", touch.trial, self._along) > 0)
        exceeds = (size > (1 + CLOSE) * touch.most) & (sticks | ~self._turned)
        slips = np.where(before, goes_on if sticks else True, exceeds)
        self._turned[:] |= before & ~slips
        new = (slips & (goes_on | ~before))[:, None]
        self._along[:] = np.where(new, touch.trial / np.maximum(size, LEAST)[:, None], slips[:, None] * self._along)
        return over_all(self.grid.comm, int((slips != before).sum())) > 0

    def assemble_matrix(self, A: PETSc.Mat, u: NDArray[np.float64]) -> None:
        """Add minus the derivative of the shear forces by slip and pressure at u; who calls finalises it.

        In each cell the area times grip on the means of N, and the product of rise on these and of the sum of k n N.
        """
        if not self.grips:
            return
        touch, N = self.at(u), self._mean(self._N)
        pushes = (self._rows.area * touch.stiff)[:, None, None] * self._N[:, :, None] * touch.n[:, None, :]
        M = np.einsum("ck,cab,cl,c->ckalb", N, touch.grip, N, self._whole)
        M += np.einsum("ck,ca,clb->ckalb", N, touch.rise, self._total(pushes))
        count = M.shape[1] * M.shape[2]
        insert(A, self.grid, self._cell.astype(np.int32), M.reshape(len(M), count, count))

    def augment(self, u: NDArray[np.float64]) -> bool:
        """Take the present pressures for lambda where means penetrate too deep at u; return whether they do.

        Raises
        ------
        NotConverged
            They still do: something holds the body in the tool.
        """
        touch, h = self.at(u), self.grid.h.min()
        # what is a sliver of a cell has too little area to be pushed out by itself, and goes with its neighbours
        whole = np.minimum(1.0, self._whole / (SLIVER * self.grid.cell_volume / self.grid.h.max()))
        off = whole * (touch.pressure - self._lambda) / self._mean(self._stiffness) / h
        most = over_all(self.grid.comm, float(np.abs(off).max(initial=0.0)), MPI.MAX)
        if most <= DEPTH:
            return False
        self._rounds[0] += 1
        if self._rounds[0] > ROUNDS:
            worst = np.flatnonzero(np.abs(off) == most)[:1]
            x = [f"{line(self._tools[self._number[k]])}: at {touch.x[self._at == k][0]}" for k in worst]
            message = f"{''.join(x)} penetrates by {most:.2g} cells: does a wall hold the body there?"
            raise NotConverged(first(self.grid.comm, message if x else ""))
        self._lambda[:] = touch.pressure
        return True

    @property
    def rounding(self) -> float:
        """What rounding of coordinates makes of the forces, N, of this process."""
        return 1e-15 * float((self._stiffness * self._rows.area).max(initial=0.0)) * self._reach

    @property
    def _reach(self) -> float:
        return float(np.abs(np.concatenate([self.grid.lower, self.grid.upper])).max())

    def touching(self) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
        """Return cells (m,), places (m, d), and directions (m, d) in which tools hold what touches at the start."""
        touch, d = self.at(np.zeros_like(self.grid.node_x)), self.grid.dim
        rows = np.flatnonzero(touch.stiff > 0)
        rough = rows[self._strength.any(axis=1)[self._at[rows]]]
        cell, x = (np.concatenate([of[rows], np.repeat(of[rough], d, axis=0)]) for of in (self._rows.cell, touch.x))
        return cell, x, np.concatenate([touch.n[rows], np.tile(np.eye(d), (len(rough), 1))])

    def forces(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces and moments (tools, d + 1) or, in 3D, (tools, 6) of the tools on the bodies, N and N m."""
        touch, number, d = self.at(u), self._rows.number, self.grid.dim
        middle = np.array([pose.centre + pose.shift for pose in self._poses])
        arm, f = touch.x - middle[number], touch.force
        moment = np.cross(arm, f) if d == 3 else (arm[:, 0] * f[:, 1] - arm[:, 1] * f[:, 0])[:, None]
        columns = np.concatenate([f, moment], axis=1).T
        return over_all(self.grid.comm, np.stack([sum_by(number, c, len(self._tools)) for c in columns], axis=1))

    def gripped(self, u: NDArray[np.float64], points: MaterialPoints) -> MaterialPoints:
        """Return the points with the pressures and shear tractions that tools have on them at u.

        What sticks keeps how it differs from the mean of its cell: averaged anew in every step it would creep.
        """
        touch, (travel, at, of, area) = self.at(u), self._back
        off = (self._rows.shear - self._mean(self._rows.shear)[self._at]) * touch.sticks[self._at, None]
        shear, push = travel.back(touch.shear[self._at] + off), travel.back(touch.push)
        data, n = dict(points.data), len(points)
        for number, tool in enumerate(self._tools):
            rows = np.flatnonzero(of == number)
            whole = np.maximum(sum_by(at[rows], area[rows], n), 1e-300)
            means = [sum_by(at[rows], area[rows] * column, n) / whole for column in (push[rows], *shear[rows].T)]
            data[pressure_name(number)] = means[0]
            if tool.grips:
                data[shear_name(number)] = np.stack(means[1:], axis=1)
        return replace(points, data=data)


def _check_distance(tool: Tool, x: NDArray, gap: NDArray, n: NDArray, h: float) -> None:
    """Refuse a function of the user's that is no distance near the tool."""
    size = np.linalg.norm(n, axis=1)
    wrong = np.flatnonzero((np.abs(gap) < h) & (np.abs(size - 1) > DISTANCE))
    if len(wrong):
        what = f"{line(tool)}: shape has slope {size[wrong[0]]:.3g} at {x[wrong[0]]}"
        raise ValueError(f"{what}, must be a signed distance: of slope 1 near the tool")


class Tools:
    """The tools of a stage.

    Parameters
    ----------
    grid, materials
        Background grid, and the materials of the scene.
    tools
        The tools.
    outside
        The surface of the bodies; called where there are tools.
    held
        Given displacements with their faces, on which tools do not act.
    """

    def __init__(
        self,
        grid: Grid,
        materials: SceneMaterials,
        tools: Sequence[Tool],
        outside: Callable[[], Surface],
        held: Sequence[tuple[Displacement, Surface]],
    ):
        self.grid, self._materials, self.tools, self._held = grid, materials, tuple(tools), held
        for tool in self.tools:
            tool.check(grid.dim)
        self.faces = outside() if self.tools else None
        if self.tools:
            sides = 2 * grid.dim
            taken = [faces.id * sides + faces.face for _, faces in held]
            own = self.faces.id * sides + self.faces.face
            self._free = ~np.isin(own, np.concatenate([np.zeros(0, np.int64), *taken]))

    @property
    def symmetric(self) -> bool:
        """Whether the tangent is symmetric."""
        return not any(tool.grips for tool in self.tools)

    def _kept(self, n: int) -> dict[str, NDArray[np.float64]]:
        """Return what n points keep of the tools, zero."""
        out = {pressure_name(i): np.zeros(n) for i in range(len(self.tools))}
        return out | {shear_name(i): np.zeros((n, self.grid.dim)) for i, tool in enumerate(self.tools) if tool.grips}

    def let_go(self, points: MaterialPoints) -> MaterialPoints:
        """Return points without the tractions of the tools."""
        return replace(points, data={name: rows for name, rows in points.data.items() if name not in self._kept(0)})

    def grip(self, points: MaterialPoints, before: MaterialPoints | None = None) -> MaterialPoints:
        """Return points with tractions of the tools: zero, or those of the same points `before`."""
        new = self._kept(len(points))
        if before is not None:
            here, at = before.find(points.id)
            for name, rows in new.items():
                rows[here] = before.data[name][at]
        return replace(points, data={**points.data, **new}) if new else points

    def placed(self, cut: CutDomains, points: MaterialPoints, start: float, t: float) -> ToolContact | None:
        """Return the contact at time t (s) of a step that began at `start`, with the points where they are now."""
        if not self.tools:
            return None
        grid, d = self.grid, self.grid.dim
        patches = cut.surface(self.faces)
        x, area = patches.now(points), patches.area(points)
        size, free = np.linalg.norm(area, axis=1), self._free[patches.here]
        own = [self._materials.table(cut.points, of)[patches.at] for of in (resistance, holding)]
        poses, found = [tool.pose(t, d) for tool in self.tools], []
        for number, (tool, pose) in enumerate(zip(self.tools, poses, strict=True)):
            before = tool.pose(start, d)
            n = everywhere(grid, lambda tool=tool, pose=pose: tool.solid(grid.h.min()).normal(pose.own(x)) @ pose.R.T)
            at = np.flatnonzero(free & (np.einsum("md,md->m", area, n) < -FACING * size))
            old = points.data[shear_name(number)][patches.at[at]] if tool.grips else np.zeros((len(at), d))
            vectors = [x[at], pose.put(before.own(x[at])), old @ (pose.R @ before.R.T).T]
            pressure = points.data[pressure_name(number)][patches.at[at]]
            scalars = [np.full(len(at), number), size[at], *(values[at] for values in own), pressure]
            found.append((at, np.concatenate([np.stack(scalars, axis=1), *vectors], axis=1)))
        at, values = (np.concatenate(column) for column in zip(*found, strict=True))
        travel = Exchange(grid.comm, grid.owner(patches.cell[at]))
        cell, place, sent = (travel.send(rows) for rows in (patches.cell[at], patches.x[at], values))
        number, *own = sent[:, :5].T
        rows = Rows(number.astype(np.int64), grid.local(cell), *own, *np.split(sent[:, 5:], 3, axis=1))
        back = (travel, patches.at[at], values[:, 0].astype(np.int64), values[:, 1])
        return ToolContact(grid, self.tools, poses, rows, Places(grid, rows.cell, place), back)

    def check_start(self, cut: CutDomains, points: MaterialPoints, t: float) -> None:
        """Refuse tools that are inside of a body at time t (s)."""
        if not self.tools:
            return
        x = np.concatenate([cut.surface(self.faces).now(points), points.x])
        for tool in self.tools:
            deep, where = self._deepest(tool, x, t)
            if deep > BEGINS:
                what = f"{line(tool)}: is {deep:.3g} cells inside of a body, at {where}, at t = {t:g} s as it begins"
                raise ValueError(f"{what}, must be outside of all bodies, or touch them")

    def check_end(self, cut: CutDomains, points: MaterialPoints, t: float) -> None:
        """Refuse a step after which tools have points in them, or meet what is given."""
        for tool in self.tools:
            for hold, faces in self._held:
                deep, where = self._deepest(tool, cut.surface(faces).now(points), t)
                if deep > BEGINS:
                    what = f"{line(tool)} and {line(hold)}: both act at {where} at t = {t:g} s"
                    raise ValueError(f"{what}, must not; limit the displacement by a region, or move the tool")
            deep, where = self._deepest(tool, points.x, t)
            if deep > 0:
                raise NotConverged(f"{line(tool)}: has passed through the surface, to the point at {where}")

    def near(self, corners: NDArray[np.float64], t: float) -> NDArray[np.bool_]:
        """Return which corners (n, 2^d, d) of domains touch tools at time t (s): these follow the Q1 field alone.

        What else they follow would be pushed back by the tool in the next step, and roughen the pressure.
        """
        out, h = np.zeros(corners.shape[:2], dtype=bool), self.grid.h.min()
        x = corners.reshape(-1, self.grid.dim)
        for tool in self.tools:
            own = tool.pose(t, self.grid.dim).own(x)
            gap = everywhere(self.grid, lambda tool=tool, own=own: tool.solid(h).distance(own))
            out |= (gap < NEAR * h).reshape(out.shape)
        return out

    def _deepest(self, tool: Tool, x: NDArray[np.float64], t: float) -> tuple[float, str]:
        """Return how deep places x (m, d) are in a tool at most, in cells, and where."""
        h, pose = self.grid.h.min(), tool.pose(t, self.grid.dim)
        gap = everywhere(self.grid, lambda: tool.solid(h).distance(pose.own(x)))
        deepest = over_all(self.grid.comm, float(gap.min(initial=np.inf)), MPI.MIN)
        here = np.array2string(x[gap.argmin()], precision=6) if len(gap) and gap.min() == deepest else ""
        return -deepest / h, first(self.grid.comm, here)
