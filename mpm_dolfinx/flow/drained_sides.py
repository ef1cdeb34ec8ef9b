# SPDX-License-Identifier: MIT
"""Drained sides, seepage faces, rain, prescribed inflows: what passes through the sides of the bodies.

What leaves a cell through a face is T r [p - p_out + rho_w g . (x_out - x)], T = A kappa / d by the distance d of the
cell's centroid, or what is prescribed.  A seepage face lets nothing in: it is open where the flow at the start of the
substep, and then that of a solution, asks for it (`SideFeeds.settle`), a primal-dual active set (Hintermueller, Ito and
Kunisch 2002).  Rain is what is given, but no more than what the pressure of its pond presses in; what evaporates is no
more than what the driest pressure sucks out.  A pond of volume V supplies V / dt besides, spread over its side, in the
step whose rates change it.  So rain is what soaks in, what ponds and what runs off, to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import Setting
from mpm_dolfinx.conditions.conditions import Drained, Inflow, Rain
from mpm_dolfinx.conditions.sides import check_apart, everywhere, gathered, on_side
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.feeding import Feeding, Feeds, Fluid, Leaving, Wet
from mpm_dolfinx.flow.fluxes import Conduction, OpenSides
from mpm_dolfinx.flow.unsaturated import Relative
from mpm_dolfinx.forms.point_forms import PointData
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.parallel.exchange import over_all

THICK = np.sqrt(2)
"""Largest section of a cube over its face.  Source: exact bound (Ball 1986).

A convex body behind a plane has its centroid at least its volume / ((d + 1) THICK h^(d-1)) behind it.  A face that is
closer to the centroid of what its cell holds, or behind it, bounds a part of that only, and must not drain it at once.
"""


class DrainedSides(Feeding):
    """Drained sides and prescribed inflows of a stage.

    Parameters
    ----------
    setting
        Where they are put.
    outlets
        The conditions by name.

    Raises
    ------
    ValueError
        Naming a condition whose side no point has, or two that act on the same faces.
    """

    conditions, title = (Drained, Inflow, Rain), "open sides"

    def __init__(self, setting: Setting, outlets: Mapping[str, Drained | Inflow | Rain]):
        self._grid = setting.grid
        self._names, self.count = tuple(outlets), len(outlets)
        self._rains = tuple(isinstance(outlet, Rain) for outlet in outlets.values())
        weight = setting.materials.fluid.unit_weight if any(self._rains) else 1.0
        self._ponds = tuple(one.ponding / weight if isinstance(one, Rain) else None for one in outlets.values())
        self._outlets = [(outlet, setting.sides.of(outlet)) for outlet in outlets.values()]
        self.varies = any(callable(getattr(one, name)) for one in outlets.values() for name in one.FUNCTIONS)
        self.varies |= any(self._ponds)
        for one, other in combinations(self._outlets, 2):
            check_apart(*one, *other)
        self._constant: Latest[OpenSides] = Latest()

    @property
    def surfaces(self) -> list[Surface]:
        """The faces."""
        return [faces for _, faces in self._outlets]

    def unknown(self, value: float) -> dict[str, NDArray[np.float64]]:
        """Return outflows of this value before a first step."""
        return {name: np.array(value) for name in self._names}

    def dry(self, value: float) -> dict[str, NDArray[np.float64]]:
        """Return run-offs of this value before a first step."""
        return {name: np.array(value) for name, rain in zip(self._names, self._rains, strict=True) if rain}

    def empty(self) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return volumes that flow and run off where rain falls, before a first step."""
        if not any(self._rains):
            return {}
        return {"flowed": self.unknown(0.0), "ran_off": self.dry(0.0), "ponded": self.dry(0.0)}

    def fed(self, cut: CutDomains, pieces: PointData) -> NDArray[np.int64]:
        """Return the points at the faces."""
        return np.concatenate([patch.at for patch in cut.surfaces(self.surfaces)])

    def placed(self, wet: Wet) -> SideFeeds:
        """Return the open sides where they were cut, with what they give at the time."""
        if self.varies:
            return SideFeeds(self._sides(wet), wet, self._grid, self._names, self._ponds)
        key = (wet.cut.key, wet.contents.key, wet.points)
        sides = self._constant(key, lambda: self._sides(wet), self._grid.comm)
        return SideFeeds(sides, wet, self._grid, self._names, self._ponds)

    def _sides(self, wet: Wet) -> OpenSides:
        grid, rows = self._grid, []
        patches = wet.cut.surfaces(self.surfaces)
        for i, ((outlet, _), p) in enumerate(zip(self._outlets, patches, strict=True)):
            given, n = everywhere(grid, partial(outlet.through, wet.t, on_side(p, wet.points))), len(p.x)
            columns = [np.resize(column, (n, 1)) for column in (i, *given)]
            rows.append((p.cell, p.x, np.concatenate([*columns, p.area(wet.points)], axis=1)))
        cell, x, values = gathered(grid, rows, 5 + grid.dim)
        number = values[:, 0].astype(np.int64)
        pressure, flux, one_way, driest = values[:, 1:5].T
        area = values[:, 5:]
        drains = np.isfinite(pressure)
        size, reach = np.linalg.norm(area, axis=1), x - grid.midpoints[cell] - wet.contents.centroid[cell]
        least = wet.contents.fill[wet.contents.slot(cell)] * grid.sizes(cell).min(axis=-1) / THICK / (grid.dim + 1)
        normal = area / size[:, None]
        distance = np.einsum("md,md->m", reach, normal)
        shape = size / np.maximum(distance, least)
        if grid.axisymmetric:  # half-way to the centroid rings are as much longer or shorter
            shape = shape * (1 - distance * normal[:, 0] / (2 * x[:, 0]))
        shape, pressure = (np.where(drains, values, 0.0) for values in (shape, pressure))
        rains = np.isfinite(driest)
        given, rain = np.where(rains, 0.0, flux * size), np.where(rains, flux * size, np.nan)
        return OpenSides(number, cell, shape, pressure, given, one_way > 0, area, reach, rain, driest)


@dataclass(frozen=True)
class OpenFaces:
    """Faces on open sides as the cells conduct; arrays over m faces.

    at (m,): place of the cell among the n active owned ones; conductance, inflow (m,): outflow per unit of the cell's
    mass potential, m^d/(Pa s), and what is prescribed or driven in, m^d/s; seeps (m,): whether nothing may flow in;
    reach (m, d): way from the cell's centroid, m.
    """

    at: NDArray[np.int64]
    conductance: NDArray[np.float64]
    inflow: NDArray[np.float64]
    seeps: NDArray[np.bool_]
    reach: NDArray[np.float64]

    def outflow(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what leaves through each face (m,), were it open both ways, m^d/s."""
        return self.conductance * fluid.pi[self.at] - self.inflow

    def open_by(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what leaves through each face (m,) by a unit of the cell's mass potential, m^d/(Pa s)."""
        return self.conductance

    rises = open_by

    def aslant(
        self, fluid: Fluid, beyond: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | float, NDArray[np.float64] | float]:
        """Return what flows besides through faces that see more pressure (m,), Pa: a flow, m^d/s, and a share."""
        return np.where(self.seeps, 0.0, self.open_by(fluid) * beyond * fluid.density[self.at]), 0.0

    def driven(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what forces of inertia on the fluid drive out through each face (m,), m^d/s."""
        along = np.einsum("md,md->m", fluid.force[self.at], self.reach)
        return np.where(self.seeps, 0.0, self.open_by(fluid) * along)


@dataclass(frozen=True)
class UnsaturatedFaces(OpenFaces):
    """The same of soil whose pores drain; conductance: over the mobility.

    relative: mobilities by pressures; cells (m,): behind the faces; normal (m, d): of the faces; outer (m,): potentials
    beyond, less the weight of the fluid on the way, Pa; beyond (m,): pressures there, Pa; fall (m,): the weight on the
    way, Pa.
    """

    relative: Relative
    cells: NDArray[np.int32]
    normal: NDArray[np.float64]
    outer: NDArray[np.float64]
    beyond: NDArray[np.float64]
    fall: NDArray[np.float64]

    def outflow(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what leaves through each face (m,), were it open both ways, m^d/s."""
        return self.open_by(fluid) * (fluid.pi[self.at] - self.outer) - self.inflow

    def aslant(
        self, fluid: Fluid, beyond: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | float, NDArray[np.float64] | float]:
        """Return what flows besides: as conductivities change by decades in a step, a share of what does anyway.

        It is no more than that, so no soil is emptied by it.
        """
        drives = fluid.pi[self.at] - self.outer
        share = np.divide(beyond, drives, out=np.zeros_like(beyond), where=drives != 0).clip(-1, 1)
        return 0.0, np.where(self.seeps, 0.0, share)

    def open_by(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what leaves through each face (m,) by a unit of the difference of potentials, m^d/(Pa s)."""
        return self.conductance * self._through(fluid)[0]

    def rises(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return by how much more leaves as the cell's pressure rises, never less."""
        return self.conductance * self._through(fluid)[1]

    def _through(self, fluid: Fluid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return k_r of the faces (m,) at the cells' pressures, and the slopes of what it lets through."""
        return self.relative.through_sides(self.cells, self.normal, fluid.p[self.at], self.beyond, self.fall)


@dataclass(frozen=True)
class RainedFaces(OpenFaces):
    """The same where rain may fall; rain (m,): m^d/s, nan where there is none; pond, dry: faces at either bound.

    What leaves is minus the rain, or what leaves at the bound that it would pass.  So seepage is the rain's: `seeps` is
    false there.
    """

    rain: NDArray[np.float64]
    pond: OpenFaces
    dry: OpenFaces

    def outflow(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what leaves through each face (m,), m^d/s."""
        wet = self.pond.outflow(fluid)
        return np.where(np.isnan(self.rain), wet, np.clip(-self.rain, wet, self.dry.outflow(fluid)))

    def aslant(
        self, fluid: Fluid, beyond: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | float, NDArray[np.float64] | float]:
        """Return what flows besides; rain is what is given."""
        return tuple(np.where(np.isnan(self.rain), values, 0.0) for values in self.pond.aslant(fluid, beyond))

    def driven(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what forces of inertia on the fluid drive out through each face (m,); rain is what is given."""
        return np.where(np.isnan(self.rain), super().driven(fluid), 0.0)

    def open_by(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return what leaves through each face (m,) by a unit of the difference of potentials, m^d/(Pa s)."""
        return self.pond.open_by(fluid)

    def rises(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return by how much more leaves as the cell's pressure rises."""
        out = np.where(self.rain <= -self.dry.outflow(fluid), self.dry.rises(fluid), 0.0)
        return np.where(self.rain < -self.pond.outflow(fluid), out, self.pond.rises(fluid))


class SideFeeds(Feeds):
    """Open sides in a substep.

    Parameters
    ----------
    sides
        Their faces.
    wet
        When and where.
    grid
        Background grid.
    names, ponds
        Of the conditions, by the numbers of the faces, and how deep water may pond, m; None: no rain.
    """

    def __init__(self, sides: OpenSides, wet: Wet, grid: Grid, names: tuple[str, ...], ponds: tuple[float | None, ...]):
        self._rains = tuple(depth is not None for depth in ponds)
        self._names, self._before = names, wet.outcome
        self._contents, self._comm = wet.contents, grid.comm
        self._fallen = sides.rain
        self.sides, self._most = self._pond(sides, ponds, wet.dt) if any(ponds) else (sides, np.zeros(len(names)))
        self._seeps = sides.seeps & np.isnan(sides.driest)
        self.settles = bool(self._seeps.any())
        self.linear = not any(self._rains)
        self._drain = wet.drains
        self._flows, self._aslant = np.ones(len(sides.cells), dtype=bool), 0.0
        self._share: NDArray[np.float64] | float = 0.0

    def _pond(
        self, sides: OpenSides, ponds: tuple[float | None, ...], dt: float
    ) -> tuple[OpenSides, NDArray[np.float64]]:
        """Return sides that ponds supply with what they hold in a time, s, at their pressure; their volumes when full.

        ponds (n,): their depths, m, at most.
        """
        depth, number = np.array([depth or 0.0 for depth in ponds]), sides.number
        size = np.linalg.norm(sides.area, axis=1)
        area = over_all(self._comm, sum_by(number, size, len(self._names)))
        most = depth * area
        full = np.divide(self._ponded, most, out=np.zeros(len(depth)), where=most > 0)
        held = np.divide(self._ponded, area, out=np.zeros(len(depth)), where=area > 0)
        pressure = np.where(np.isnan(sides.rain), sides.pressure, full[number] * sides.pressure)
        return replace(sides, pressure=pressure, rain=sides.rain + (held / dt)[number] * size), most

    @property
    def _ponded(self) -> NDArray[np.float64]:
        """What ponds hold at the start of the step, m^d, by number of the condition."""
        held = self._before.get("ponded", {})
        return np.array([float(held.get(name, 0.0)) for name in self._names])

    def conducting(self, flow: Conduction) -> OpenFaces:
        """Return the faces as the cells conduct."""
        faces = self._faces(self.sides, flow)
        if not any(self._rains):
            return faces
        driest = np.where(np.isnan(self.sides.driest), self.sides.pressure, self.sides.driest)
        dry = self._faces(replace(self.sides, pressure=driest), flow)
        same = (faces.at, faces.conductance, faces.inflow, faces.seeps, faces.reach)
        return RainedFaces(*same, self.sides.rain, faces, dry)

    def _faces(self, sides: OpenSides, flow: Conduction) -> OpenFaces:
        """Return faces with these pressures beyond."""
        at = self._contents.slot(sides.cells)
        conductance, inflow = sides.driven(at, flow)
        reach = flow.deformed(at, sides.reach)
        if flow.relative is None:
            return OpenFaces(at, conductance, inflow, self._seeps, reach)
        fall = np.zeros(len(at)) if flow.weight is None else reach @ flow.weight
        where = flow.relative, sides.cells, sides.normal, sides.outer(at, flow), sides.pressure, fall
        return UnsaturatedFaces(at, conductance, sides.given, self._seeps, reach, *where)

    def begin(self, at: OpenFaces, fluid: Fluid, beyond: NDArray[np.float64]) -> None:
        """Open seepage faces as the flow asks for; their cells' pressures alone count for these."""
        self._flows = at.outflow(fluid) >= 0
        self._aslant, self._share = at.aslant(fluid, beyond)

    def leaving(self, at: OpenFaces, fluid: Fluid) -> Leaving:
        """Return what leaves the cells, what flows aslant as it did at the start of the substep."""
        through, counts = self._through(at, fluid), self._counts(at)
        if fluid.force is not None:
            through = through + at.driven(fluid)
        turnover = sum_by(at.at, counts * at.open_by(fluid), len(fluid.pi)) * np.abs(fluid.pi)
        gain = sum_by(at.at, np.abs(through), len(fluid.pi)) if self._drain else 0.0  # steady rain changes nothing
        return Leaving(sum_by(at.at, through, len(fluid.pi)), turnover, gain)

    def slope(self, at: OpenFaces, fluid: Fluid) -> NDArray[np.float64]:
        """Return the derivative of what leaves."""
        return sum_by(at.at, self._counts(at) * (1 + self._share) * at.rises(fluid), len(fluid.pi))

    def settle(self, at: OpenFaces, fluid: Fluid) -> int:
        """Open and close seepage faces as the flow asks for; return how many do."""
        flows = at.outflow(fluid) > 0
        changes = int(np.count_nonzero((flows != self._flows) & at.seeps))
        self._flows = flows
        return changes

    def outflows(self, at: OpenFaces, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return what leaves through the sides of each condition, m^d/s, by name."""
        sums = over_all(self._comm, sum_by(self.sides.number, self._through(at, fluid), len(self._names)))
        return {name: np.array(sums[i]) for i, name in enumerate(self._names)}

    def run_off(self, at: OpenFaces, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return what of the rain does not soak in, m^d/s, by name of the conditions of rain."""
        if not any(self._rains):
            return {}
        left = np.maximum(self._fallen, 0.0) + np.minimum(self._through(at, fluid), 0.0)  # nan where none falls
        runs = over_all(self._comm, sum_by(self.sides.number, left, len(self._names)))
        runs = np.where(self._ponded < self._most, 0.0, np.maximum(runs, 0.0))  # a pond feeds the soil as well
        return {name: np.array(runs[i]) for i, name in enumerate(self._names) if self._rains[i]}

    def passing(self, at: OpenFaces, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return what leaves through the sides of each condition, and what falls on it (2,), m^d/s."""
        if not any(self._rains):
            return {}
        both = np.stack([self._through(at, fluid), np.nan_to_num(self._fallen)])
        sums = over_all(self._comm, np.stack([sum_by(self.sides.number, row, len(self._names)) for row in both]))
        return dict(zip(self._names, sums.T, strict=True))

    def volumes(
        self, passed: Sequence[Mapping[str, NDArray[np.float64]]], seconds: Sequence[float]
    ) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return what has left through sides, what has run off them, and what ponds hold."""
        if not any(self._rains):
            return {}
        flowed, fell = np.einsum("s,snk->kn", seconds, [[of[name] for name in self._names] for of in passed])
        before = {quantity: self._before.get(quantity, {}) for quantity in ("flowed", "ran_off")}
        held = self._ponded + fell + flowed
        ponded = held.clip(0, self._most)
        more = {"flowed": flowed, "ran_off": np.maximum(held - ponded, 0.0)}
        out: dict[str, dict[str, NDArray[np.float64]]] = {"ponded": {}, "flowed": {}, "ran_off": {}}
        for i, name in enumerate(self._names):
            for quantity in more if self._rains[i] else ("flowed",):
                out[quantity][name] = before[quantity].get(name, 0.0) + more[quantity][i]
            if self._rains[i]:
                out["ponded"][name] = np.array(ponded[i])
        return out

    def _counts(self, at: OpenFaces) -> NDArray[np.bool_]:
        """Return which faces (m,) are open."""
        return self._flows | ~at.seeps

    def _through(self, at: OpenFaces, fluid: Fluid) -> NDArray[np.float64]:
        """Return what leaves through each face (m,), m^d/s."""
        return np.where(self._counts(at), (1 + self._share) * at.outflow(fluid), 0.0) + self._aslant
