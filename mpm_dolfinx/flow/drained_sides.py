# SPDX-License-Identifier: MIT
"""Flow through the sides of bodies: drained sides, seepage faces, rain, prescribed inflows.

Through a drained face, the outflow of a cell is `T r [p - p_out + rho_w g . (x_out - x)]`.  The cell has the pressure
p, and x is the centroid of its material.  The face has the outside pressure p_out and the centroid x_out.  The
transmissibility is T = A kappa / d, with the area A of the face, and the distance d from x to the face.  The mobility
kappa is the conductivity divided by the unit weight of the fluid.  The factor r is the density of the fluid, divided by
its density rho_w at zero pressure.

At a seepage face, fluid can only leave.  A primal-dual active-set method (Hintermueller, Ito and Kunisch 2002) opens
faces with outflow, and closes all other faces.

Infiltration equals the rain, but is at most the inflow under the pressure of ponded water.  Evaporation is at most the
outflow at the pressure `Rain.driest`.  In a step of length dt, a pond of volume V adds the rate V / dt to the rain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import Setting
from mpm_dolfinx.conditions.conditions import Drained, Inflow, Rain
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.feeding import Beginning, Feeding, Feeds, Fluid, Leaving, Wet
from mpm_dolfinx.flow.fluxes import Conduction, OpenSides
from mpm_dolfinx.flow.plausible_sides import Plausible
from mpm_dolfinx.flow.unsaturated import Relative
from mpm_dolfinx.forms.point_forms import PointData
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import over_all, together


class DrainedSides(Feeding):
    """Drained sides, prescribed inflows and rain of a stage.

    Raises
    ------
    ValueError
        A condition is on a side without points, or two conditions are on the same part of a face.
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
        self._gives = not all(isinstance(outlet, Drained) for outlet in outlets.values())
        for (one, faces), (other, others) in combinations(self._outlets, 2):
            faces.check_apart(others, (one, other))
        self._constant: Latest[OpenSides] = Latest()
        self._plausible = Plausible(setting.materials)

    @property
    def surfaces(self) -> list[Surface]:
        """Faces on which the conditions act."""
        return [faces for _, faces in self._outlets]

    def check(self, begins: Beginning) -> None:
        """Warn of implausible rain and pressures at their beginning."""
        for name, (one, faces), rains in zip(self._names, self._outlets, self._rains, strict=True):
            if name in begins.names and rains:
                self._plausible.rain(name, faces.id, begins)
                self._plausible.flux(name, 0.0 if callable(one.flux) else one.flux)
            elif name in begins.names:
                self._plausible.pressure(name, getattr(one, "pressure", None), faces.places(), begins)

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return placeholders for the results before the first step: `value` for rates, and zero for volumes."""
        out = {"outflows": {name: np.array(value) for name in self._names}}
        rains = [name for name, rain in zip(self._names, self._rains, strict=True) if rain]
        start = {"rain": value, "runoff": value, "ran_off": 0.0, "ponded": 0.0} if rains else {}
        return out | {quantity: {name: np.array(one) for name in rains} for quantity, one in start.items()}

    def fed(self, cut: CutDomains, pieces: PointData) -> NDArray[np.int64]:
        """Return the indices of points with faces on open sides.  Indices may be repeated."""
        return np.concatenate([patch.at for patch in cut.surfaces(self.surfaces)])

    def placed(self, wet: Wet) -> SideFeeds:
        """Return the flow through the open sides in a substep."""
        if self.varies:
            return SideFeeds(self._sides(wet), wet, self._names, self._ponds, self._gives)
        key = (wet.cut.key, wet.contents.key, wet.points)
        sides = self._constant(key, lambda: self._sides(wet), self._grid.comm)
        return SideFeeds(sides, wet, self._names, self._ponds, self._gives)

    def _sides(self, wet: Wet) -> OpenSides:
        grid, rows = self._grid, []
        patches = wet.cut.surfaces(self.surfaces)
        for i, ((outlet, _), p) in enumerate(zip(self._outlets, patches, strict=True)):
            given = together(grid.comm, partial(outlet.through, wet.t, p.positions(wet.points)))
            if self._rains[i] and callable(outlet.flux) and self._names[i] not in self._plausible.heavy:
                self._plausible.flux(self._names[i], given.flux if len(p.x) else 0.0)
            values = np.empty((5, len(p.x)))
            for row, value in zip(values, (i, *given), strict=True):
                row[:] = value
            rows.append((p.cell, p.x, {"values": values.T, "area": p.area(wet.points)}))
        cell, x, fields = grid.gathered(rows)
        number, pressure, flux, one_way, driest = fields["values"].T
        area = fields["area"]
        number = number.astype(np.int64)
        drains = np.isfinite(pressure)
        size, offset, shape = wet.contents.shapes(cell, x, area)
        shape, pressure = (np.where(drains, values, 0.0) for values in (shape, pressure))
        rains = np.isfinite(driest)
        given, rain = np.where(rains, 0.0, flux * size), np.where(rains, flux * size, np.nan)
        return OpenSides(number, cell, shape, pressure, given, one_way > 0, area, offset, rain, driest)


@dataclass(frozen=True)
class OpenFaces:
    """Faces on open sides with their conductances.  Arrays have an entry for each of m faces."""

    at: NDArray[np.int64]  # index of the cell among the n active owned cells (m,)
    conductance: NDArray[np.float64]  # outflow per unit of the cell's mass potential (m,), m^d/(Pa s)
    inflow: NDArray[np.float64]  # inflow that is prescribed, or caused by the outside pressure (m,), m^d/s
    seeps: NDArray[np.bool_]  # whether fluid can only leave (m,)
    offset: NDArray[np.float64]  # vector from the centroid of the cell's material to the face (m, d), m

    def outflow(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face, in m^d/s.  Seepage faces count as open."""
        return self.conductance * fluid.pi[self.at] - self.inflow

    def open_by(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face, divided by the mass potential of the cell, in m^d/(Pa s)."""
        return self.conductance

    derivative = open_by

    def nonorthogonal(
        self, fluid: Fluid, difference: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | float, NDArray[np.float64] | float]:
        """Return the two terms of the non-orthogonal correction: a flow (m^d/s), and a fraction of the two-point flux.

        `difference` (m,), Pa: correction of the cell pressure at each face.
        """
        return np.where(self.seeps, 0.0, self.open_by(fluid) * difference * fluid.density[self.at]), 0.0

    def driven(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face due to inertia forces on the fluid, in m^d/s."""
        return np.add.reduce(fluid.force(self.at) * self.by_force(fluid), axis=1)

    def by_force(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the derivative (m, d) of the outflow `driven` with respect to the inertia force, in m^(d+3)/(N s)."""
        return np.where(self.seeps, 0.0, self.open_by(fluid))[:, None] * self.offset


@dataclass(frozen=True)
class UnsaturatedFaces(OpenFaces):
    """Faces on open sides of unsaturated soil.  The values of `conductance` are for saturated soil."""

    relative: Relative  # relative conductivities of the cells
    cells: NDArray[np.int32]  # cells behind the faces (m,)
    normal: NDArray[np.float64]  # unit normals (m, d)
    outer: NDArray[np.float64]  # mass potential at the pressure `outside - drop` (m,), Pa
    outside: NDArray[np.float64]  # pressure outside (m,), Pa
    drop: NDArray[np.float64]  # hydrostatic pressure drop from the centroid to the face (m,), Pa

    def outflow(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face, in m^d/s.  Seepage faces count as open."""
        return self.open_by(fluid) * (fluid.pi[self.at] - self.outer) - self.inflow

    def nonorthogonal(
        self, fluid: Fluid, correction: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | float, NDArray[np.float64] | float]:
        """Return the two terms of the non-orthogonal correction: zero flow, and a fraction of the two-point flux.

        The fraction is limited to [-1, 1].
        """
        difference = fluid.pi[self.at] - self.outer
        share = np.divide(correction, difference, out=np.zeros_like(correction), where=difference != 0).clip(-1, 1)
        return 0.0, np.where(self.seeps, 0.0, share)

    def open_by(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face per unit difference of mass potentials, in m^d/(Pa s)."""
        return self.conductance * self._through(fluid)[0]

    def derivative(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the derivative (>= 0) of the outflow with respect to the cell pressure, in m^d/(Pa s)."""
        return self.conductance * self._through(fluid)[1]

    def _through(self, fluid: Fluid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return both results of `Relative.through_sides`: k_r (m,) of the faces, and the derivative (m,)."""
        return self.relative.through_sides(self.cells, self.normal, fluid.p[self.at], self.outside, self.drop)


@dataclass(frozen=True)
class RainedFaces(OpenFaces):
    """Faces on all open sides.  This class replaces `OpenFaces` if at least one side has rain.

    The outflow through a face with rain is minus the rain, but limited by two bounds.  The bounds are the outflows at
    the pressure of the pond and at the pressure `Rain.driest`.
    """

    fallen: NDArray[np.float64]  # rain (m,), m^d/s; nan for faces without rain
    rain: NDArray[np.float64]  # rain and inflow from ponds (m,), m^d/s; nan for faces without rain
    pond: OpenFaces  # these faces with the pressure of the pond outside
    dry: OpenFaces  # these faces with the driest pressure outside

    def outflow(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face, in m^d/s."""
        ponded = self.pond.outflow(fluid)
        rained = np.minimum(np.maximum(-self.rain, ponded), self.dry.outflow(fluid))
        return np.where(np.isnan(self.rain), ponded, rained)

    def nonorthogonal(
        self, fluid: Fluid, difference: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | float, NDArray[np.float64] | float]:
        """Return the non-orthogonal correction.  Faces with rain have no correction."""
        dry = np.isnan(self.rain)
        return tuple(np.where(dry, values, 0.0) for values in self.pond.nonorthogonal(fluid, difference))

    def by_force(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the derivative (m, d) of `driven` with respect to the inertia force, or zero for faces with rain."""
        return np.where(np.isnan(self.rain)[:, None], super().by_force(fluid), 0.0)

    def open_by(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face per unit difference of mass potentials, in m^d/(Pa s)."""
        return self.pond.open_by(fluid)

    def derivative(self, fluid: Fluid) -> NDArray[np.float64]:
        """Return the derivative of the outflow with respect to the pressure of the cell, in m^d/(Pa s)."""
        out = np.where(self.rain <= -self.dry.outflow(fluid), self.dry.derivative(fluid), 0.0)
        return np.where(self.rain < -self.pond.outflow(fluid), out, self.pond.derivative(fluid))


class SideFeeds(Feeds):
    """Flow through open sides in a substep.

    `sides`: faces of the open sides.  `sides.number` is the index of the condition in `names` and `ponds`.
    `wet`: data of the substep.
    `names`: names of the conditions.
    `ponds`, m: largest depth of the pond of each condition, or None without rain.
    `gives`: whether a condition prescribes a flux.
    """

    def __init__(
        self, sides: OpenSides, wet: Wet, names: tuple[str, ...], ponds: tuple[float | None, ...], gives: bool
    ):
        self._names, self._before = names, wet.outcome
        self._at, self._comm = wet.contents.slot(sides.cells), wet.cut.grid.comm
        self._ponds, self._fallen = ponds, sides.rain
        self._gives = gives
        self.sides, self._most = self._pond(sides, ponds, wet.dt) if any(ponds) else (sides, np.zeros(len(names)))
        self._seeps = sides.seeps & np.isnan(sides.driest)
        self.settles = bool(np.logical_or.reduce(self._seeps))
        self.linear = ponds.count(None) == len(ponds)
        self._drain = wet.drains
        self._flows, self._nonorthogonal = True, 0.0
        self._share: NDArray[np.float64] | float = 0.0

    def _pond(
        self, sides: OpenSides, ponds: tuple[float | None, ...], dt: float
    ) -> tuple[OpenSides, NDArray[np.float64]]:
        """Return open sides, whose rain includes the inflow from ponds, and the largest volume (m^d) of each pond."""
        depth, number = np.array([depth or 0.0 for depth in ponds]), sides.number
        size = np.linalg.norm(sides.area, axis=1)
        area = over_all(self._comm, sum_by(number, size, len(self._names)))
        most = depth * area
        full = np.divide(self._ponded, most, out=np.zeros(len(depth)), where=most > 0)
        depths = np.divide(self._ponded, area, out=np.zeros(len(depth)), where=area > 0)
        pressure = np.where(np.isnan(sides.rain), sides.pressure, full[number] * sides.pressure)
        return replace(sides, pressure=pressure, rain=sides.rain + (depths / dt)[number] * size), most

    @property
    def _ponded(self) -> NDArray[np.float64]:
        """Volumes (m^d) of the ponds at the start of the step."""
        volumes = self._before.get("ponded", {})
        return np.array([float(volumes.get(name, 0.0)) for name in self._names])

    def conducting(self, flow: Conduction, driest: NDArray[np.float64] | None = None) -> OpenFaces:
        """Return the faces with their conductances.  `driest` (m,), Pa: replaces `sides.pressure`."""
        at, sides = self._at, self.sides if driest is None else replace(self.sides, pressure=driest)
        if self._gives:
            stretch = flow.stretch(at, sides.normal)
            sides = replace(sides, given=sides.given * stretch)
        (conductance, inflow), offset = sides.driven(at, flow), flow.deformed(at, sides.offset)
        faces = OpenFaces(at, conductance, inflow, self._seeps, offset)
        if flow.relative is not None:
            drop = np.zeros(len(at)) if flow.weight is None else offset @ flow.weight
            rest = flow.relative, sides.cells, sides.normal, sides.outer(at, flow), sides.pressure, drop
            faces = UnsaturatedFaces(at, conductance, sides.given, self._seeps, offset, *rest)
        if self.linear or driest is not None:
            return faces
        dry = self.conducting(flow, np.where(np.isnan(sides.driest), sides.pressure, sides.driest))
        fallen = self._fallen * stretch
        rain = fallen + (sides.rain - self._fallen)  # the volume of a pond does not depend on its area
        return RainedFaces(at, conductance, faces.inflow, self._seeps, offset, fallen, rain, faces, dry)

    def begin(self, at: OpenFaces, fluid: Fluid, difference: NDArray[np.float64]) -> None:
        """See `Feeds`.  Seepage faces with an outflow are opened."""
        self._flows = at.outflow(fluid) >= 0
        self._nonorthogonal, self._share = at.nonorthogonal(fluid, difference)

    def leaving(self, at: OpenFaces, fluid: Fluid) -> Leaving:
        """Return the outflow of the cells, including the non-orthogonal correction."""
        flux = self._through(at, fluid)
        if fluid.force is not None:
            flux = flux + at.driven(fluid)
        rows = np.array([flux, self._if_open(at, at.open_by(fluid)), np.abs(flux) * self._drain])
        cells, turnover, gain = sum_by(at.at, rows, len(fluid.pi))
        return Leaving(cells, turnover * np.abs(fluid.pi), gain)  # rain is no gain: steady rain changes no storage

    def slope(self, at: OpenFaces, fluid: Fluid) -> NDArray[np.float64]:
        """Return the derivative of the outflow with respect to the pressure of the cell."""
        return sum_by(at.at, self._if_open(at, (1 + self._share) * at.derivative(fluid)), len(fluid.pi))

    def by_force(self, at: OpenFaces, fluid: Fluid) -> NDArray[np.float64]:
        """Return the derivative of the outflow with respect to the inertia force."""
        return sum_by(at.at, at.by_force(fluid).T, len(fluid.pi)).T

    def settle(self, at: OpenFaces, fluid: Fluid) -> int:
        """Open the seepage faces with outflow, and close all others.  Return the number of changes on this process."""
        flows = at.outflow(fluid) > 0
        changes = int(np.count_nonzero((flows != self._flows) & at.seeps))
        self._flows = flows
        return changes

    def outcome(self, at: OpenFaces, fluid: Fluid) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the outflow through the sides of each condition, in m^d/s; for `Rain` also the rain and the run-off.

        Run-off is rain that neither infiltrates nor fills a pond.
        """
        rows = through = self._through(at, fluid)
        if not self.linear:  # nan without rain
            excess = np.maximum(at.fallen, 0.0) + np.minimum(through, 0.0)
            rows = np.stack([through, at.fallen, excess])
        sums = over_all(self._comm, sum_by(self.sides.number, rows, len(self._names)))
        if self.linear:
            return {"outflows": dict(zip(self._names, sums, strict=True))}
        out, rain, runs = sums
        runs = np.where(self._ponded < self._most, 0.0, np.maximum(runs, 0.0))  # < 0 if a pond supplies the soil
        found = {"outflows": dict(zip(self._names, out, strict=True)), "rain": {}, "runoff": {}}
        for name, pond, *of in zip(self._names, self._ponds, rain, runs, strict=True):
            if pond is not None:
                found["rain"][name], found["runoff"][name] = of
        return found

    def volumes(
        self, now: Mapping[str, Mapping[str, NDArray[np.float64]]]
    ) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return two volumes (m^d) for each condition with rain: ponded water, and the sum of run-off and seepage."""
        if self.linear:
            return {}
        out: dict[str, dict[str, NDArray[np.float64]]] = {"ponded": {}, "ran_off": {}}
        for name, pond, most in zip(self._names, self._ponds, self._most, strict=True):
            if pond is not None:
                free = now["rained"][name] + now["flowed"][name]  # rain that did not infiltrate
                out["ponded"][name] = np.clip(free - self._before["ran_off"][name], 0.0, most)
                out["ran_off"][name] = free - out["ponded"][name]
        return out

    def _if_open(self, at: OpenFaces, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the `values` (m,) of the faces, set to zero at closed seepage faces."""
        return np.where(self._flows | ~at.seeps, values, 0.0) if self.settles else values

    def _through(self, at: OpenFaces, fluid: Fluid) -> NDArray[np.float64]:
        """Return the outflow (m,) through each face, in m^d/s."""
        return self._if_open(at, (1 + self._share) * at.outflow(fluid)) + self._nonorthogonal
