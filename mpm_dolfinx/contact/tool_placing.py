# SPDX-License-Identifier: MIT
"""The tools of a stage: poses, contact pairs, and checks for penetration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from functools import partial
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.time_integration import in_step
from mpm_dolfinx.base.tolerances import SAME, TINY
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.touching import MISFIT
from mpm_dolfinx.conditions.acting import At, Loads, Outcome, Place, Setting, Shares
from mpm_dolfinx.contact.history import Origin, pressure_name, shear_name
from mpm_dolfinx.contact.law import DEPTH, ContactLaw
from mpm_dolfinx.contact.moved_tools import Moved, MovedTools
from mpm_dolfinx.contact.pairs import ToolPairs
from mpm_dolfinx.contact.problem import ContactProblem, SubstepMotion, Touching
from mpm_dolfinx.contact.tool import Pose, Tool, rotation
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all, together
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn
from mpm_dolfinx.points.material_points import MaterialPoints, middle

NEAR = 0.1
"""Distance from a tool, in cell sizes, below which Q1 displacements of domain corners get no correction.
Sensitivity (scene "tool" of tests/plateaus.py): half this value changes the result by 3.8e-03, and twice this value by
1.4e-03. Finer cells change it by 6.3e-02."""
FACING = 0.5  # smallest cosine of the angle between two normals that have the same direction, or opposite directions
HALVINGS = int(-np.log2(DEPTH))  # number of bisections that locate the edge of a tool to `DEPTH` cell sizes


def _box(x: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], MPI.Op]]:
    """Return both corners of the bounding box of x, each with the MPI operation that combines it over all processes."""
    return [(x.min(axis=0, initial=np.inf), MPI.MIN), (x.max(axis=0, initial=-np.inf), MPI.MAX)]


def motion_count(dim: int) -> int:
    """Return the number of degrees of freedom of a tool: d displacements, and in 2D a rotation."""
    return dim + (dim == 2)


def _outwards(tool: Tool, y: NDArray[np.float64], depth: NDArray[np.float64], h: float) -> NDArray[np.float64]:
    """Return motions (n, d), in m, that move positions y (n, d) out of a tool by `depth` (n, 1) along the normal.

    If the normal varies within the depth, its mean replaces it.  The result is continuous at edges and axes.
    """
    out = depth * tool.solid(h).normal(y)
    ends = [[tool.gap(y + sign * depth * e, h) for sign in (1, -1)] for e in np.eye(y.shape[1])]
    mean = np.stack([(ahead - behind) / 2 for ahead, behind in ends], axis=1)
    varies = np.abs(mean - out).max(axis=1, keepdims=True, initial=0.0) > SAME * h
    return np.where(varies, mean, out)


Normals = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Function that returns the outward unit normals (k, d) of a tool at positions (k, d)."""


class Below(NamedTuple):
    """Patches of surfaces (m,), and the patches (k,) among them that face a tool."""

    x: NDArray[np.float64]  # positions (m, d), m
    unit: NDArray[np.float64]  # outward unit normals of the bodies (m, d)
    rows: NDArray[np.int64]  # indices of the patches that face the tool (k,)
    on: NDArray[np.float64]  # positions from which distances to edges are measured (k, d), m: in 2D on the tool
    out: NDArray[np.float64]  # outward unit normals of the tool there (k, d); in 3D opposite to the normals of bodies
    extent: NDArray[np.float64]  # distances to the ends of the patches (k,), m; in 3D, 0, as patches are not divided


class LoadMotion(NamedTuple):
    """Displacements and rotations of tools that forces cause, at the start and the end of a step."""

    start: float  # start of the step, s
    end: float  # end of the step, s
    before: NDArray[np.float64]  # motions at the start (k, q), m and rad
    after: NDArray[np.float64]  # motions at the end (k, q), m and rad

    def at(self, t: float) -> NDArray[np.float64]:
        """Return the motions at time t (s), by linear interpolation in the step."""
        share = (t - self.start) / (self.end - self.start) if self.end > self.start else 1.0
        return self.before + share * (self.after - self.before)


class Tools(Touching):
    """The tools of a stage, with their motion in a step."""

    conditions, title = (Tool,), "tools"

    def __init__(self, setting: Setting, tools: Mapping[str, Tool]):
        super().__init__(setting, tools)
        grid, self.tools = setting.grid, tuple(tools.values())
        self._held = [(hold, faces) for hold, faces, _ in setting.held]
        """Prescribed displacements with their faces.  Tools must not touch these faces."""
        still = np.zeros((len(self.tools), motion_count(grid.dim)))
        self.by_loads, self._end = LoadMotion(0.0, 0.0, still, still), None
        if len({id(tool) for tool in self.tools}) < len(self.tools):
            raise ValueError("tools: one tool is listed twice, tools must be distinct")
        for tool in self.tools:
            tool.check(grid.dim)
            if grid.axisymmetric and tool.along(grid.dim)[0]:
                raise ValueError(f"Tool: direction = {line(tool.direction)}, must be along the axis in axisymmetry")
            if grid.axisymmetric and tool.begins(grid.dim)[0]:
                raise ValueError(f"Tool: velocity = {line(tool.velocity)}, must be along the axis in axisymmetry")
            if grid.axisymmetric and tool.free and (tool.spin or np.isfinite(tool.moment or np.inf)):
                raise ValueError(f"{line(tool)}: spin and moment must be left out in axisymmetry")
            if grid.axisymmetric and getattr(tool.shape, "on_axis", False):
                raise ValueError(f"{line(tool)}: a side lies on the axis, the tool must extend over the axis")
            if not callable(tool.displacement) and not callable(tool.rotation_rad):
                self._pose(tool, 0.0)
        self.tools = tuple(tool.on(grid) for tool in self.tools)
        self.outside, sides = setting.sides.all(), 2 * grid.dim
        held = [faces.id * sides + faces.face for _, faces in self._held]
        own = self.outside.id * sides + self.outside.face
        self._free = ~np.isin(own, np.concatenate([np.zeros(0, np.int64), *held]))

    @property
    def turning(self) -> list[bool]:
        """Whether each tool is free and rotates."""
        return [tool.rotates(self.grid.dim) and not self.grid.axisymmetric for tool in self.tools]

    def going(self, by_loads: LoadMotion, end: float | None = None) -> Tools:
        """Return a copy of the tools with the motion due to forces in a step."""
        tools = copy(self)
        tools.by_loads, tools._end = by_loads, end
        return tools

    def pose(self, number: int, t: float) -> Pose:
        """Return the pose of a tool at time t (s)."""
        return self._pose(self.tools[number], t)

    def _posed(self, tool: Tool, start: float, t: float) -> Pose:
        """Return the pose of a tool at the end of a substep; with inertia, `in_step` changes the pose."""
        pose = self._pose(tool, t)
        if self._end is None or not start < t < self._end or tool.free:
            return pose
        before, end = self._pose(tool, start), self._pose(tool, self._end)
        share = (t - start) / (self._end - start)
        shift = in_step(share, before.shift, pose.shift, end.shift)
        if not (end.R != before.R).any():
            return pose._replace(shift=shift)
        rotations = [of.R @ before.R.T for of in (pose, end)]
        angle = in_step(share, 0.0, *(np.arctan2(turn[1, 0], turn[0, 0]) for turn in rotations))
        return pose._replace(shift=shift, R=rotation(angle) @ before.R)

    def _pose(self, tool: Tool, t: float) -> Pose:
        """Return the pose of a tool at time t.  Raise ValueError for a motion that is not axisymmetric."""
        pose = tool.pose(t, self.grid.dim, self.by_loads.at(t)[self.tools.index(tool)])
        if self.grid.axisymmetric and (pose.shift[0] or pose.R[0, 1]):
            what = f"moves by {pose.shift}{' and rotates' * bool(pose.R[0, 1])} at t = {t:g} s"
            raise ValueError(f"{line(tool)}: {what}, must move by (0, z) and not rotate in axisymmetry")
        return pose

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the results before the first step: forces `value` (placeholder), zero motions, initial velocities."""
        out, d = super().unknown(value), self.grid.dim
        tools = dict(zip(self.names, self.tools, strict=True))
        out["tool_travel"] = {name: np.zeros(d if tool.free else ()) for name, tool in tools.items()}
        turning = [name for name, rotates in zip(self.names, self.turning, strict=True) if rotates]
        of_free = {
            "tool_velocity": {name: tool.begins(d) for name, tool in tools.items() if tool.free},
            "tool_rotation": {name: np.array(0.0) for name in turning},
            "tool_spin": {name: np.array(float(tools[name].spin)) for name in turning},
        }
        return out | {quantity: values for quantity, values in of_free.items() if values}

    def _before(self, place: Place) -> NDArray[np.float64]:
        """Return the displacements and rotations of tools that forces have caused before a step."""
        return self._motions(place.before, "tool_travel", "tool_rotation")

    def _motions(self, before: Outcome, along: str, around: str) -> NDArray[np.float64]:
        """Return an array (tools, q) of the results `along` (such as displacements) and `around` (rotations)."""
        d = self.grid.dim
        out = np.zeros((len(self.tools), motion_count(d)))
        for row, name, tool in zip(out, self.names, self.tools, strict=True):
            value = before.get(along, {}).get(name, 0.0)
            row[:d] = value if np.ndim(value) else value * tool.along(d)
            row[d:] = before.get(around, {}).get(name, 0.0)
        return out

    def placed(self, place: Place) -> Loads:
        """Return the contact loads of tools in a substep."""
        before = self._before(place)
        tools = self.going(LoadMotion(place.start, place.t, before, before), place.start + place.dt * place.inertia)
        moved = self._moved(place)
        return MovedToolLoads(tools, place, moved=moved) if moved.guides.any() else ToolLoads(tools, place)

    def _moved(self, place: Place) -> Moved:
        """Return mass, motion and load of tools that forces move; none move while an initial stress is balanced."""
        d, q = self.grid.dim, motion_count(self.grid.dim)
        of = [tool for tool in self.tools if tool.free or (tool.load is not None and place.t > place.start)]
        moves = [tool in of and tool.free == place.inertia for tool in self.tools]
        load, guides = np.zeros(len(self.tools)), np.zeros((len(self.tools), q, q))
        mass, direction = np.zeros((2, len(self.tools), q))
        for k in np.flatnonzero(moves):
            tool = self.tools[k]
            load[k] = np.nan_to_num(tool.pushes(place.t))
            direction[k, :d] = tool.along(d)
            guides[k, :d, :d] = tool.guide(d) * (np.arange(d) >= self.grid.axisymmetric)[:, None]
            mass[k, :d] = tool.mass or 0.0
            if self.turning[k]:
                guides[k, d, d], mass[k, d] = 1.0, tool.inertia(d)
        velocity = self._motions(place.before, "tool_velocity", "tool_spin")
        return Moved(mass, guides, velocity, load, direction)

    def contact(self, place: Place) -> tuple[ContactLaw, Origin]:
        """Return the contact law in a substep, and the material points of its pairs."""
        cut, points = place.cut, place.points
        start, t = place.start, place.t
        grid, d = self.grid, self.grid.dim
        patches = cut.contact_surface(self.outside)
        x, area = patches.now(points), patches.area(points)
        size, free = np.linalg.norm(area, axis=1), self._free[patches.face]
        unit, around = area / np.maximum(size, TINY)[:, None], np.broadcast_to(grid.around(x), size.shape)
        stiffness = self._stiffness(cut.points)[patches.at] * [1.0, 1.0, place.rate]
        poses, found = [self._posed(tool, start, t) for tool in self.tools], []
        for number, (tool, pose) in enumerate(zip(self.tools, poses, strict=True)):
            before = self._pose(tool, start)
            n = self._normals(tool, pose, x)
            at = np.flatnonzero(free & (np.einsum("md,md->m", unit, n) < -FACING))
            gap = together(grid.comm, partial(tool.gap, pose.own(x[at]), grid.least))
            below = Below(x, unit, at, x[at], -unit[at], np.zeros(len(at)))
            if d == 2:  # patches are Gauss points: distance to the nearer end of a face, on the tool
                extent = (1 - 3**-0.5) * size[at] / np.maximum(around[at], TINY)
                extent = np.maximum(TINY, extent * np.abs((unit * n).sum(axis=1)[at]))
                below = below._replace(on=x[at] - gap[:, None] * n[at], out=n[at], extent=extent)
            share, shift = self._covered(partial(self._normals, tool, pose), below)
            kept = share > SAME
            at, gap = at[kept], gap[kept]
            share, shift = share[kept], shift[kept]
            shift -= np.einsum("md,md->m", shift, unit[at])[:, None] * unit[at]  # along the surface of the body
            now, gap = x[at] + shift, gap + np.einsum("md,md->m", shift, n[at])
            share = share * grid.around(now) / np.maximum(around[at], TINY)
            old = (
                points.data[shear_name(self.names[number])][patches.at[at]]
                if tool.frictional
                else np.zeros((len(at), d))
            )
            own = before.own(now)
            vectors = [patches.x[at] + shift, now, pose.put(own), n[at], old @ (pose.R @ before.R.T).T]
            pressure = points.data[pressure_name(self.names[number])][patches.at[at]]
            gaps = [together(grid.comm, partial(tool.gap, own, grid.least)), gap]
            scalars = [np.full(len(at), number), share * size[at], *stiffness[at].T, pressure, *gaps]
            found.append((at, np.concatenate([np.stack(scalars, axis=1), *vectors], axis=1)))
        at, values = (np.concatenate(column) for column in zip(*found, strict=True))
        exchange = Exchange(grid.comm, grid.owner(patches.cell[at]))
        cell, sent = exchange.send(patches.cell[at]), exchange.send(values)
        number, *own, start_gap, side_gap = sent[:, :8].T
        places, now, carried, side, shear = np.split(sent[:, 8:], 5, axis=1)
        acts = np.ones(len(number)), self.tools, poses, now, carried, start_gap, side_gap, side
        pairs = ToolPairs(grid, number.astype(np.int64), grid.locals[cell], *own, shear, places, *acts)
        origin = Origin(exchange, patches.at[at], values[:, 0].astype(np.int64), values[:, 1])
        return ContactLaw(self.names, self.tools, pairs), origin

    def _normals(self, tool: Tool, pose: Pose, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the outward unit normals (m, d) of a tool at positions x (m, d)."""
        if self.grid.axisymmetric:  # beyond the axis is the mirror image, so the tip of a cone is no edge
            x = np.column_stack([np.abs(x[:, 0]), x[:, 1]])
        n = together(self.grid.comm, lambda: tool.solid(self.grid.least).normal(pose.own(x)) @ pose.R.T)
        return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), TINY)

    def _cells(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions divided by the cell size."""
        return x / self.grid.h if self.grid.even else self.grid.in_cells(x)

    def _covered(self, normals: Normals, below: Below) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the parts of k patches below a tool on which the contact acts.

        The results are fractions of the areas (k,), and vectors (k, d), in m, from the middles of the patches to the
        middles of these parts.  The last loaded node also represents half a cell beyond an edge of the tool.  Half a
        cell inside the edge therefore has no contact.  Edges beyond which the surface of the body ends are ignored.
        If no patch is left whole, as below a tool narrower than a cell, the contact acts on all patches.
        """
        units, ends = self._ends(normals, below)
        share, shift = np.ones(len(below.rows)), np.zeros_like(below.on)
        edge = (ends < below.extent).any(axis=0)
        if not over_all(self.grid.comm, int(edge.sum())):
            return share, shift
        edge[edge] = self._goes_on(below, below.rows[edge])
        share[edge] = 0.0
        if self.grid.dim == 2:
            share[edge] = np.clip(ends[:, edge].sum(axis=0) / (2 * below.extent[edge]), 0.0, 1.0)
            part = edge & (share > 0)
            shift[part] = ((ends[1] - ends[0])[:, None] / 2 * units[1])[part]
        whole = over_all(self.grid.comm, int((share == 1).sum()))
        return (share, shift) if whole else (np.ones_like(share), np.zeros_like(shift))

    def _ends(self, normals: Normals, below: Below) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return opposite unit tangents (2 a, k, d) at k positions below a tool, and the ends of the contact (2 a, k).

        The tangents are projections of a edges of a cell: in 2D of the edge with the smallest angle to the tangent
        plane.  The ends are distances along the tangents, in m, at most `extent`, and negative outside of the contact.
        """
        on, out = below.on, below.out
        flat = self.grid.dim == 2
        axes = np.eye(self.grid.dim)[np.abs(out).argsort(axis=1, kind="stable")[:, : 1 if flat else None].T]
        half = axes - np.einsum("jkd,kd->jk", axes, out)[:, :, None] * out
        half *= (axes * self.grid.sizes_at(on)).sum(axis=2, keepdims=True) / 2
        half = np.concatenate([-half, half])
        length = np.linalg.norm(half, axis=2)
        units, far = half / np.maximum(length, TINY)[:, :, None], length + below.extent
        ahead = normals((on + far[:, :, None] * units).reshape(-1, self.grid.dim)).reshape(units.shape)
        at = np.nonzero(np.einsum("jkd,kd->jk", ahead, out) <= FACING)
        span, turn = np.stack([np.zeros(len(at[0])), far[at]]), ahead[at] - out[at[1]]
        for _ in range(HALVINGS if flat and over_all(self.grid.comm, len(turn)) else 0):
            middle = span.mean(axis=0)
            beyond = np.einsum("kd,kd->k", turn, normals(on[at[1]] + middle[:, None] * units[at])) > 0
            span[beyond.astype(int), np.arange(len(middle))] = middle
        ends = np.broadcast_to(below.extent, far.shape).copy()
        ends[at] = span.mean(axis=0) - length[at]
        return units, ends

    def _goes_on(self, below: Below, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether the surface of a body goes on beyond the tool within one cell of the patches `rows` (k,)."""
        grid, unit = self.grid, below.unit
        cells = self._cells(below.x)
        low, high = (over_all(grid.comm, end, op) for end, op in _box(cells[rows]))
        off = (np.abs(np.clip(cells, low, high) - cells) <= 1).all(axis=1)
        off[below.rows] = False
        beyond = np.concatenate(grid.comm.allgather(np.hstack([cells[off], unit[off]])))
        near = cKDTree(cells[rows]).sparse_distance_matrix(cKDTree(beyond[:, : grid.dim]), 1.0, output_type="ndarray")
        same = np.einsum("md,md->m", unit[rows[near["i"]]], beyond[near["j"], grid.dim :]) > FACING
        return np.isin(np.arange(len(rows)), near["i"][same])

    def _warn_light(self, place: Place) -> None:
        """Warn of free tools whose mass is less than the mass of soil in half a cell."""
        free = [tool for tool in self.tools if tool.free]
        if not (free and place.inertia and place.dt):
            return
        grid = self.grid
        dense = float(self._materials.present_density(place.points).max(initial=0.0))
        half = over_all(grid.comm, dense, MPI.MAX) * grid.least**grid.dim / 2
        half *= np.pi * grid.least if grid.axisymmetric else 1.0  # half of the first ring of cells about the axis
        for tool in free:
            if tool.mass < half:
                what = "%s: its mass is less than that of half a cell, %.3g kg, so its rebound depends on the step in "
                warn(grid.comm, ResolutionWarning, what + "which it strikes; use smaller cells", line(tool), half)

    def warn_missed(self, place: Place, points: MaterialPoints) -> None:
        """Warn if a tip or corner of a tool without contact is deeper in a body than all surface positions near it."""
        grid, patches = self.grid, place.cut.surface(self.outside)
        for name, tool in zip(self.names, self.tools, strict=True):
            touches = over_all(grid.comm, int((points.data[pressure_name(name)] > 0).any()))
            if touches or callable(tool.shape):
                continue
            before, tips = (self._pose(tool, t).put(tool.solid(grid.least).places) for t in (place.start, place.t))
            at = self._cells(tips)
            x = patches.now(points)
            near = ((self._cells(x) > at.min(axis=0) - 1) & (self._cells(x) < at.max(axis=0) + 1)).all(axis=1)
            if not over_all(grid.comm, int(near.any())):
                continue
            x, area = x[near], patches.area(points)[near]
            pairs = cKDTree(at).sparse_distance_matrix(cKDTree(self._cells(x)), 1.0, output_type="ndarray")
            tip, face = pairs["i"], pairs["j"]
            n, depth = np.zeros_like(tips), np.full(len(tips), np.inf)
            np.add.at(n, tip, area[face])
            n = over_all(grid.comm, n)
            n /= np.maximum(np.linalg.norm(n, axis=1), TINY)[:, None]
            np.minimum.at(depth, tip, np.einsum("md,md->m", x[face] - tips[tip], n[tip]))
            depth = over_all(grid.comm, depth, MPI.MIN)
            inwards = (n * (tips - before)).sum(axis=1) < 0
            if (inwards & np.isfinite(depth) & (depth > MISFIT * grid.least)).any():
                what = "%s: a tip or corner is deeper in a body than all contact positions near it, without a force; "
                warn(grid.comm, ResolutionWarning, what + "use cells smaller than %.3g m", line(tool), grid.least)

    def check_start(self, place: Place) -> None:
        """Raise an error for tools inside a body at the start of the stage."""
        self._warn_light(place)
        before, t = self._before(place), place.start
        points = place.points
        tools, patches = self.going(LoadMotion(t, t, before, before)), place.cut.surface(self.outside)
        x = patches.now(points)
        for number, tool in enumerate(self.tools):
            touches = over_all(self.grid.comm, int((points.data[pressure_name(self.names[number])] > 0).any()))
            deep, where = tools._deepest(tool, points.within() if touches else np.concatenate([x, points.x]), t)
            if deep > (NEAR if touches else MISFIT):
                what = f"{line(tool)}: penetrates a body by {deep:.3g} cells, at {where}, at the start t = {t:g} s"
                raise ValueError(f"{what}, must be outside of all bodies, or touch them")

    def check_end(self, place: Place, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise an error if a tool contains points, touches prescribed sides, or has crossed a body in the step."""
        t, comm = place.t, self.grid.comm
        ends = [middle(of.corners) for of in (before, points)]
        off = [of.corners - x[:, None] for of, x in zip((before, points), ends, strict=True)]
        sizes = sum(np.sqrt(np.einsum("nkd,nkd->n", of, of)) for of in off)  # at least the distances to the corners
        for tool in self.tools:
            for hold, faces in self._held:
                deep, where = self._deepest(tool, place.cut.surface(faces).now(points), t)
                if deep > MISFIT:
                    what = f"{line(tool)} and {line(hold)}: both act at {where} at t = {t:g} s"
                    raise ValueError(f"{what}, must be apart; limit the displacement by a region, or move the tool")
            y, end = (self._pose(tool, at).own(x) for at, x in zip((place.start, t), ends, strict=True))
            gap = together(comm, partial(tool.gap, end, self.grid.least))  # changes by at most the distance
            near = (gap <= sizes + np.linalg.norm(end - y, axis=1)) | callable(tool.shape)
            if not over_all(comm, int(near.any())):
                continue
            x, start = (of.within()[near] for of in (points, before))
            corners = points.corners[near]
            corners = corners[self._gaps(tool, corners, t).min(axis=1) < -MISFIT * self.grid.least]
            deep, where = self._deepest(tool, x, t)
            held, at_middle = self._deepest(tool, middle(corners), t)
            if deep > NEAR or held > 0:  # a round tool may contain the middle of a long domain, but no corner
                where = where if deep > NEAR else at_middle
                raise NotConverged(f"{line(tool)}: has passed through the surface, to {where}; renewal may help")
            if where := self._passed(tool, (start, x), (place.start, t)):
                raise NotConverged(f"{line(tool)}: has passed through a body within a step, at {where}")

    def near(self, corners: NDArray[np.float64], t: float) -> NDArray[np.bool_]:
        """Return which corners (n, 2^d, d) of domains are within `NEAR` cells of a tool at time t (s)."""
        out, h = np.zeros(corners.shape[:2], dtype=bool), self.grid.least
        for tool in self.tools:
            out |= self._gaps(tool, corners, t) < NEAR * h
        return out

    def pushed_out(
        self, corners: NDArray[np.float64], t: float, free: NDArray[np.bool_], most: float
    ) -> NDArray[np.float64]:
        """Return the corners (n, 2^d, d) of domains at time t (s), after a correction of penetrations into tools.

        Penetrations of less than `most` cell sizes are reduced to 2 `DEPTH` cell sizes.  Deeper penetrations do not
        change.  Only the components flagged by `free` (n, 2^d, d) change.
        """
        out, h = corners.copy(), self.grid.least
        for tool in self.tools:
            gap, pose = self._gaps(tool, out, t), self._pose(tool, t)
            gap += 2 * DEPTH * h
            at = (gap < 0) & (gap > -most * h)
            motion = together(self.grid.comm, partial(_outwards, tool, pose.own(out[at]), -gap[at, None], h))
            out[at] += free[at] * (motion @ pose.R.T)
        return out

    def _gaps(self, tool: Tool, corners: NDArray[np.float64], t: float) -> NDArray[np.float64]:
        """Return the distances of corners from a tool at time t, in m."""
        own = self._pose(tool, t).own(corners.reshape(-1, self.grid.dim))
        gap = together(self.grid.comm, lambda: tool.gap(own, self.grid.least))
        return gap.reshape(corners.shape[:2])

    def _passed(self, tool: Tool, x: tuple[NDArray[np.float64], ...], times: tuple[float, ...]) -> str:
        """Return a position, as text, where the path from x[0] to x[1] crosses a tool, or "" without a crossing.

        Source: Hart (1996), for sphere tracing.
        """
        h, comm = self.grid.least, self.grid.comm
        y, end = (self._pose(tool, t).own(at) for at, t in zip(x, times, strict=True))
        length = np.linalg.norm(end - y, axis=1)
        done = np.zeros(len(y))
        on = np.arange(len(y))
        along = (end - y) / np.maximum(length, TINY)[:, None]
        inside = together(self.grid.comm, lambda: (tool.gap(y, h) < 0) | (tool.gap(end, h) < 0))
        a, b = together(self.grid.comm, lambda: (tool.solid(h).normal(y[inside]), tool.solid(h).normal(end[inside])))
        crossed = x[1][inside][np.einsum("nd,nd->n", a, b) < 0][:1]  # inside, and the nearest side of the tool changes
        if where := first(comm, "".join(np.array2string(place, precision=6) for place in crossed + self.grid.base)):
            return where
        on = on[~inside]
        while over_all(comm, len(on)):
            at = y[on] + done[on, None] * along[on]
            gap = together(self.grid.comm, lambda at=at: tool.gap(at, h))
            inside = x[1][on[gap < -2 * DEPTH * h]][:1]  # the middles of thin domains slide along round tools
            if where := first(comm, "".join(np.array2string(place, precision=6) for place in inside + self.grid.base)):
                return where
            done[on] += np.maximum(gap, MISFIT * h)
            on = on[done[on] < length[on]]
        return ""

    def _deepest(self, tool: Tool, x: NDArray[np.float64], t: float) -> tuple[float, str]:
        """Return the largest penetration of positions x into a tool, in cell sizes, and the position as text."""
        h, pose = self.grid.least, self._pose(tool, t)
        gap = together(self.grid.comm, lambda: tool.gap(pose.own(x), h))
        deepest = over_all(self.grid.comm, float(gap.min(initial=np.inf)), MPI.MIN)
        place = (
            np.array2string(x[gap.argmin()] + self.grid.base, precision=6) if len(gap) and gap.min() == deepest else ""
        )
        return -deepest / h, first(self.grid.comm, place)


class ToolLoads(ContactProblem):
    """Contact loads of tools in a substep."""

    def __init__(self, tools: Tools, place: Place):
        super().__init__(*tools.contact(place))
        self._tools, self._place = tools, place
        self.before = tools.by_loads.before
        """Motions (k, q) of the tools, in m and rad, that forces have caused before the step."""
        self.shares, self._earlier = Shares(np.inf, 0.0, None), None

    @property
    def still(self) -> NDArray[np.float64]:
        """See `ContactProblem`."""
        return np.zeros_like(self.before)

    def begun(self, shares: Shares, earlier: SubstepMotion | None) -> ToolLoads:
        """See `Loads`."""
        out = copy(self)
        out.shares, out._earlier = shares, earlier
        return out

    def flown(self, at: At) -> SubstepMotion:
        """See `Loads`."""
        return SubstepMotion(self.shares.own, self.pairs.poses)

    def tool_velocity(self, at: At) -> NDArray[np.float64] | float:
        """See `ContactProblem`."""
        pairs = self.pairs
        moved = pairs.carried - pairs.now
        if self._earlier is not None:
            before = np.zeros_like(moved)
            for number, pose in enumerate(self._earlier.poses):
                on = pairs.number == number
                start = self._tools.pose(number, self._place.start)
                before[on] = pose.put(start.own(pairs.now[on])) - pairs.now[on]
            moved = moved - self.shares.before / self._earlier.own * before
        return moved / self.shares.own

    def ended(self, at: At) -> Loads:
        """Return the contact loads of the tools at their final positions."""
        out = copy(self)
        by_loads = self._tools.by_loads
        out._tools = self._tools.going(by_loads._replace(after=by_loads.before + self.found(at).motion))
        return out

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """See `Loads`.  The result "tool_travel" contains the displacements of tools due to forces, in m."""
        d, displacement = self.grid.dim, {}
        motion = (self.before + self.found(at).motion)[:, :d]
        for name, tool, by_forces in zip(self.now.law.names, self.now.law.contacts, motion, strict=True):
            displacement[name] = by_forces if tool.free else np.array(by_forces @ tool.along(d))
        return super().outcome(at) | {"tool_travel": displacement}

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners are within `NEAR` cells of a tool."""
        return self._tools.near(corners, self._place.t)

    def outside(
        self, corners: NDArray[np.float64], free: NDArray[np.bool_], everywhere: bool = False
    ) -> NDArray[np.float64]:
        """See `Loads`."""
        return self._tools.pushed_out(corners, self._place.t, free, np.inf if everywhere else NEAR)

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """See `Loads`."""
        self._tools.check_end(self._place, points, before)

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """See `Loads`."""
        points = super().gripped(at, points)
        self._tools.warn_missed(self._place, points)
        return points


class MovedToolLoads(MovedTools, ToolLoads):
    """Contact loads of tools.  This class is used if forces move at least one tool."""
