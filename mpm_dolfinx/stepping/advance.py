# SPDX-License-Identifier: MIT
"""End of a step: material points and their domains move, and their state is updated.

The grid is reset at the start of the next step (`grid_reset`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache, partial

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.errors import LeftGrid, NotConverged, Report
from mpm_dolfinx.base.fluid_content import change_at_points
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.conditions.acting import Loads
from mpm_dolfinx.conditions.walls import fixed_corners, stopped
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.domains.domain_gradient import gradient
from mpm_dolfinx.domains.kept_volumes import Domains, with_volumes
from mpm_dolfinx.domains.lattice import filtered, given, seeded
from mpm_dolfinx.domains.pressure_transport import AtPlaces, PiecePressures, Reconstruction
from mpm_dolfinx.flow.storage import StorageForms
from mpm_dolfinx.grid.grid import REACH, Grid, in_chunks, sum_by
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.mechanics.momentum import MomentumForms
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.parallel.exchange import first, over_all
from mpm_dolfinx.points.cutting import centroids, parallelepipeds, tangled, volumes
from mpm_dolfinx.points.material_points import (
    ACROSS,
    MaterialPoints,
    body_of,
    cofactor,
    determinant,
    in_plane,
    in_space,
    with_ratio,
)
from mpm_dolfinx.points.parts import largest_of_bodies
from mpm_dolfinx.stepping.grid_reset import OnGrid
from mpm_dolfinx.stepping.stage import Stage
from mpm_dolfinx.stepping.state import State, Stay, Trend

TAKES_IN = 0.1
"""Rate r of the correction of volume defects: a motion by n cells corrects the fraction 1 - exp(-r n) of the defect.

The defect is the difference between the volume of a domain and the volume that its fluid content implies. Sensitivity
(scene "beam" of tests/plateaus.py): half this value changes the result by 1.7e-03, and twice this value by 2.8e-03.
Finer cells change it by 1.5e-02.
"""


class Motion:
    """Update of the material points at the end of a step.

    `materials`, `bodies`: all materials and bodies of the scene.
    `momentum`, `storage`: forms of the two balances. `storage` is None without fluid.
    `keeps_volumes`: whether corners are corrected so that yielded domains have the volumes of their points.
    """

    def __init__(
        self,
        materials: SceneMaterials,
        bodies: Sequence[Body],
        momentum: MomentumForms,
        storage: StorageForms | None,
        keeps_volumes: bool,
    ):
        self.keeps_volumes, self._materials = keeps_volumes, materials
        self._momentum, self._storage = momentum, storage
        varies = not momentum.linear if storage is None else not (storage.drains or storage.retains)
        self._trends = varies and momentum.elastic and momentum.inertia is None
        self._bodies, self._starts = bodies, np.cumsum([0, *map(len, bodies)])
        self._reconstruction = Reconstruction(momentum.grid) if storage is not None else None

    def advanced(
        self,
        state: State,
        on_grid: OnGrid,
        data: QuadratureData,
        t: float,
        loads: Sequence[Loads],
        net_inflow: NDArray[np.float64] | None = None,
        report: Report | None = None,
        carried: Callable[[NDArray | None, tuple[NDArray[np.int64], int]], dict[str, NDArray]] | None = None,
        stays: bool = True,
    ) -> tuple[State, int]:
        """Return the state at time t (s) after a solved step, and the number of inverted domains.

        `state`: state at the start of the step.
        `on_grid`: the bodies on the grid. `data`: integration points of the bodies at the start of the step.
        `loads`: loads at the end of the step.
        `net_inflow` (n,), m^d: net inflow of fluid into the filled owned cells in the step. With None, volume defects
        do not change.
        `report`: report of the step, for error messages.
        `carried`: function that returns the new velocities of the points (`Mass.carried`).
        `stays`: whether points that hardly move may keep their pieces until the next step.

        Raises
        ------
        NotConverged
            A point is inverted, or its porosity is zero.
        LeftGrid
            A point has left the grid.
        """
        with _compat.Timer("move points"):
            cut, pieces = on_grid.cut, data.pieces
            for one in (pieces, *data.parts):
                one.forget()  # the use of memory peaks below
            grid, d = cut.grid, cut.grid.dim
            nodal = self._momentum.u.x.array.reshape(-1, d)
            deformed = cache(partial(self._deformed, cut, data, nodal))
            if cut.domains:
                yielded = None if self._momentum.elastic else self._materials.evolved(state.points)
                followed = cut.followed(nodal, on_grid.active.contains, not state.stage.inertia, yielded)
                points, keeps, inverted = self._shaped(state, loads, on_grid, followed, deformed)
            else:
                x, F = state.points.x + cut.displacement(nodal), deformed()
                corners = parallelepipeds(x, F[:, :d, :d], self._sizes(state.points))
                points = state.points.strained(F, x=x, corners=corners)
                keeps, inverted = on_grid.valid(cut.crossed(points), loads), 0
            self._check_volumes(points, cut)
            if carried is not None:
                goes, (part, count) = ~(keeps & stays), on_grid.parts
                some = over_all(grid.comm, int(goes.any()))
                moved = goes * cut.moved(cut.crossed(points), part, count)[part] if some else None
                points = replace(points, data=points.data | carried(moved, (part, count)))
            points = self._dried(points, on_grid, data)
            if (data_now := self._materials.updated_state(points, state.points, t - state.t)) is not points.data:
                points = replace(points, data=data_now)
            if self.keeps_volumes:
                points = self._corrected(points, state, loads, keeps & stays)
            carried = None
            if self._storage is not None:
                pressure = cut.to_pieces(self._storage.p.x.array[pieces.cells])
                x = on_grid.of_pieces(state, "x", cut.pieces.x)
                x = x + cut.to_pieces(grid.at(pieces.cells, pieces.x, nodal))
                start = on_grid.of_pieces(state, "start", on_grid.pressures_of_pieces())
                ids, defect = points.id[cut.pieces.point], {}
                of_cut = (ids, cut.pieces.cell, cut.pieces.fraction)
                carried = PiecePressures(*of_cut, None, x, None, None, pressure, start)
                if cut.domains and net_inflow is not None:
                    undrained = partial(self._undrained, state, on_grid, data, loads)
                    storage = cut.to_pieces(pieces["storage"][:, 0])
                    defect = self._volume_defect(state, points, on_grid, storage, undrained, net_inflow, keeps)
                now = self.pressures(on_grid, state.stage, t, nodal)
                points = replace(points, pressure=now, data=points.data | defect)
            _check_inside(cut, points, t, report)
        stays = stays and not (self._materials.retentions and callable(state.stage.conditions["gravity"]))
        new = {"t": t, "points": points, "pieces": carried}
        new["trend"] = self._followed(state, points, t - state.t) if self._trends else None
        keeps = keeps & stays
        again = [not keeps.all()]
        if self._storage is not None:
            again = np.bincount(self._body(points)[~keeps], minlength=len(self._bodies))
        some, *again = over_all(grid.comm, np.array([keeps.any(), *again], dtype=float)) > 0
        if report is not None:
            report.first = np.multiply(report.first, again)
        if not any(again):
            return replace(state, **new, stay=Stay(cut.points)), inverted
        if carried is not None:
            new["pieces"] = self._left(carried, points, state.stage, t, on_grid, some)
        kept = {name: self._kept(getattr(state, name), on_grid, keeps) if some else None for name in ("held", "rest")}
        return replace(state, **new, **kept, stay=Stay(cut.points, keeps) if some else None), inverted

    def _followed(self, state: State, points: MaterialPoints, dt: float) -> Trend:
        """Return the rates of the points in the last steps (at most three), including this step."""
        (n, d), before = points.x.shape, state.trend
        change, gradient_change = points.x - state.points.x, (points.F - state.points.F)[:, :d, :d].reshape(n, d * d)
        pressure = (points.pressure - state.points.pressure)[:, None] if self._storage is not None else change[:, :0]
        rates = np.concatenate([change, gradient_change, pressure], axis=1)[:, None] / dt
        if before is None:
            return Trend(np.array([dt]), rates)
        return Trend(np.array([dt, *before.lengths[:2]]), np.concatenate([rates, before.rates[:, :2]], axis=1))

    def ahead(self, on_grid: OnGrid, state: State, seconds: float, first: float, implicit: bool) -> list[NDArray]:
        """Return extrapolated displacements (m) of active dofs, and with fluid also pressures (Pa) of active cells.

        These values are the initial guess of Newton's method. `Trend.over` explains the last three arguments.
        """
        cut, points = on_grid.cut, state.points
        grid, pieces = cut.grid, on_grid.data.pieces
        places, (n, d) = pieces.places, points.x.shape
        F, ratio = points.F[:, :d, :d], seconds / first if first else 0.0
        change = state.trend.over(seconds, implicit, first)
        slope = change[:, d : d + d * d].reshape(n, d, d) @ cofactor(F).swapaxes(1, 2) / determinant(F)[:, None, None]
        origin = change[:, :d] - (slope @ points.x[:, :, None])[:, :, 0]
        rows = np.concatenate([origin, slope.reshape(n, d * d), change[:, d + d * d :]], axis=1)
        rows = np.concatenate([pieces.volume[None], pieces.volume * cut.to_cells(rows).T])
        sums = places.total(rows)
        volume, sums = sums[0], sums[1:]
        moved, slope = sums[:d], sums[d : d + d * d].reshape(d, d, -1).transpose(2, 1, 0)
        moved = moved[:, :, None] + (grid.node_x[grid.cell_nodes[places.filled]] @ slope).transpose(2, 0, 1)
        whole, *moved = self._momentum.at_nodes(places.filled, [volume[:, None], *moved])
        out = [(np.array(moved) / np.where(whole > 0, whole, 1.0)).T.ravel()]
        out[0] += ratio * self._momentum.u.x.array[self._momentum.active.now.dofs]
        if self._storage is not None:
            cells = self._momentum.active.now.cells
            p, p_n = self._storage.p.x.array[cells], self._storage.p_n.x.array[cells]
            out.append(p_n + ratio * (p - p_n))
            out[1][: len(volume)] += sums[-1] / volume  # owned cells come first; Newton's method updates ghosts
        return out

    def _at_rest(self, stage: Stage, t: float, nodal: NDArray[np.float64] | None) -> AtPlaces | None:
        """Return hydrostatic pressures (Pa) as a function of cells and positions, or None without gravity."""
        gravity, grid = stage.gravity_at(t), self._momentum.grid
        if gravity is None:  # independent of conductivity: a distant permeable body must not change pressures
            return None
        weight = self._materials.fluid.density * gravity
        return lambda cells, x: (x - grid.low + (0.0 if nodal is None else grid.at(cells, x, nodal))) @ weight

    def _kept(
        self, values: NDArray[np.float64] | None, on_grid: OnGrid, keeps: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """Return the values at nodes of cells where points keep their pieces, and zeros at all other nodes."""
        if values is None:
            return None
        cut = on_grid.cut
        kept = np.unique(cut.cells[cut.to_cells(keeps)])
        return np.where(self._momentum.active_nodes(kept).repeat(cut.grid.dim), values, 0.0)

    def pressures(
        self, on_grid: OnGrid, stage: Stage, t: float, nodal: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the pressures (Pa) of the points from the pressures of the cells at time t (s).

        `nodal` (nodes, d), m: displacement since the reset of the grid, or None without motion.
        """
        at_rest = self._at_rest(stage, t, nodal)
        return on_grid.cut.in_plane(on_grid.pressures_up_to_surface(self._reconstruction, stage, t, at_rest))

    def strained(self, points: MaterialPoints, on_grid: OnGrid, data: QuadratureData) -> MaterialPoints:
        """Return the points with new F and state, at unchanged positions."""
        nodal = self._momentum.u.x.array.reshape(-1, on_grid.cut.grid.dim)
        after = self._dried(points.strained(self._deformed(on_grid.cut, data, nodal)), on_grid, data)
        self._check_volumes(after, on_grid.cut)
        return replace(after, data=self._materials.updated_state(after, points, 0.0))

    def _dried(self, points: MaterialPoints, on_grid: OnGrid, data: QuadratureData) -> MaterialPoints:
        """Return the points with their mean suctions, for laws that depend on suction."""
        if self._storage is None or "suction" not in self._materials.state_names:
            return points
        cut, pieces = on_grid.cut, data.pieces
        p = self._storage.p.x.array[pieces.cells] + self._materials.retentions.heads(pieces["lever"])
        mean = cut.mean(cut.to_pieces(np.maximum(-p, 0.0)[:, None]))[:, 0]
        return replace(points, data=points.data | {"suction": mean})

    def _deformed(self, cut: CutDomains, data: QuadratureData, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return F of the points after a step: the mean F of their pieces, scaled to the mean det F of these pieces."""
        pieces = data.pieces
        grid = cut.grid
        n = len(cut.points)
        d = self._materials.stretches
        F = pieces["F"].reshape(-1, grid.stretches, grid.stretches)
        F = F if d == grid.stretches else in_space(F, pieces[ACROSS][:, 0])
        delta = data.increments(nodal)
        if d > grid.dim:
            delta = np.pad(delta, ((0, 0), (0, 1), (0, 1)))
            delta[:, 2, 2] = pieces.places.stretch(nodal) if grid.axisymmetric else 1.0
        self._momentum.average(delta, data)
        columns = np.empty((len(F), d * d + 1))
        for part in in_chunks(len(F)):  # in chunks, because products of all pieces would take much memory
            product = delta[part] @ F[part]
            columns[part, :-1], columns[part, -1] = product.reshape(-1, d * d), determinant(product)
        mean = cut.mean(cut.to_pieces(columns))
        F, J = mean[:, :-1].reshape(n, d, d), mean[:, -1]
        F = with_ratio(F, J)
        if d > grid.stretches:  # other points have no out-of-plane stretch
            scaled, across = in_plane(F)
            F = in_space(scaled, np.where(self._materials.stretched(cut.points), across, 1.0))
        return F

    def _shaped(
        self,
        state: State,
        loads: Sequence[Loads],
        on_grid: OnGrid,
        followed: Iterable[NDArray[np.float64]],
        deformed: Callable[[], NDArray[np.float64]],
    ) -> tuple[MaterialPoints, NDArray[np.bool_], int]:
        """Return points with new corners and F, a mask of points that keep pieces, and the number of inverted domains.

        F of elastic points follows from the corners of their domains. F of yielded points is the result of `deformed`.
        """
        cut, stage = on_grid.cut, state.stage
        grid, inverted = cut.grid, 0
        moved, bend = followed
        own = self._own(stage, state.points)
        near = np.zeros(moved.shape[:2], dtype=bool)
        for one in loads:
            near |= one.near(state.points, state.points.corners + moved)
        free = own & ~near[:, :, None]
        corners = state.points.corners + moved + free * bend
        del moved, bend
        for one in loads:
            corners = one.outside(corners, own)
        points = replace(state.points, corners=corners)
        crossed = cut.crossed(points)
        keeps, evolved = on_grid.valid(crossed, loads), self._materials.evolved(points)
        if over_all(grid.comm, int(not keeps.all())):
            free &= ~keeps[:, None, None]
            crossed = np.add.reduce(crossed, axis=2) * ~evolved[:, None]
            corners = corners + free * filtered(grid, stage.lattices, points, crossed)
            bad = ~keeps & tangled(corners, points.volume0 * points.J, grid.axisymmetric)
            inverted = over_all(grid.comm, int(bad.sum()))
            if inverted:
                corners = untangled(points, corners, bad, deformed(), grid, loads)
                for one in loads:
                    corners[bad] = one.outside(corners[bad], own[bad], everywhere=True)
        F = gradient(corners, points.reference, grid.axisymmetric)
        if self._materials.stretches > grid.stretches:
            F = in_space(F, np.ones(len(F)))
        if self._momentum.dilatation is not None:
            locks = self._materials.locking(points)
            F = with_ratio(F, np.where(locks, determinant(deformed()), determinant(F)))
        if self._materials.evolves:
            F = np.where(evolved[:, None, None], deformed(), F)
        return points.strained(F, corners=corners, x=centroids(corners)), keeps, inverted

    def _own(self, stage: Stage, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask of displacement components of corners that are neither prescribed nor fixed by walls."""
        fixed = fixed_corners(self._momentum.grid, stage.conditions["walls"], points.corners)
        return ~(given(stage.lattices, points) | fixed)

    def _corrected(
        self, points: MaterialPoints, state: State, loads: Sequence[Loads], keeps: NDArray[np.bool_]
    ) -> MaterialPoints:
        """Return the points after a correction of the volumes of yielded domains (`kept_volumes`)."""
        grid, stage = self._momentum.grid, state.stage
        yielded = self._materials.evolved(points) & ~keeps
        if not over_all(grid.comm, int(yielded.sum())):
            return points
        number, held = seeded(stage.lattices, points)
        for one in loads:
            held |= one.near(state.points, points.corners)
        own = self._own(stage, points)
        free, body = own & ~held[:, :, None], self._body(points)
        of, before = (points.id, points.corners, points.volume0 * points.J), state.points.corners
        domains = Domains(*of, yielded, free, body, number, before)
        corners = with_volumes(grid, domains)
        corners[yielded] = stopped(grid, stage.conditions["walls"], corners[yielded], points.corners[yielded])
        for one in loads:
            corners = one.outside(corners, own)
        if flat := over_all(grid.comm, int((volumes(corners) == 0).sum())):  # flat domains cannot be cut into pieces
            raise NotConverged(f"the step flattens {flat} domains")
        return replace(points, corners=corners, x=centroids(corners))

    def _volume_defect(
        self,
        state: State,
        points: MaterialPoints,
        on_grid: OnGrid,
        storage: NDArray[np.float64],
        undrained: Callable[[], NDArray[np.bool_]],
        net_inflow: NDArray[np.float64],
        keeps: NDArray[np.bool_],
    ) -> dict[str, NDArray[np.float64]]:
        """Return the volume defects of the points after a step, per reference volume, and their corrections.

        `storage` (m,), 1/Pa: storage coefficients of the pieces at the start of the step.

        The step adds `(c - q) / alpha` to the defect.  Here c is the increase of the fluid content according to volumes
        and cell pressures, q is the net inflow, and alpha is Biot's coefficient.  Soil with a specific yield has no
        defect.
        """
        before = state.points
        cut = on_grid.cut
        materials = self._materials
        forms = self._storage
        here = cut.shares(before.volume0 * before.J)
        at = on_grid.contents.slot(cut.cells)
        volume = on_grid.contents.total(here)[at]
        p, p_n = (f.x.array[cut.cells] for f in (forms.p, forms.p_n))
        density = np.exp((p + p_n) / (2 * forms.bulk))
        dp, density, inflow_here = map(cut.to_pieces, (p - p_n, density, density * net_inflow[at] / volume))
        alpha, at_one = materials.table(points, lambda m: m.biot), materials.storage_at_one(points)
        biot, of_one, ratio = [values[cut.pieces.point] for values in (alpha, at_one, points.J / before.J)]
        grown = change_at_points(biot, of_one, storage, ratio, dp)
        if materials.retentions is not None:
            of, pores = cut.pieces.point, materials.porosity(before)
            heads = on_grid.heads
            full, empty = (materials.saturation(points, cut.to_pieces(at + heads), of)[0] for at in (p, p_n))
            grown = full * grown + (full - empty) * pores[of] * np.exp(-dp / (2 * forms.bulk))
        grown = cut.mean(density * grown - inflow_here)
        none = materials.drainage(points)[:, 0] > 0 if materials.drains else np.zeros(len(points), dtype=bool)
        defect = np.where(none, 0.0, before.data["owed"] + before.J * grown / alpha)
        if not over_all(cut.grid.comm, int(not keeps.all())):
            return {"owed": defect, "due": np.zeros(len(points))}
        part, count = on_grid.parts
        share = -np.expm1(-TAKES_IN * cut.moved(cut.crossed(points), part, count))[part]
        weight = points.volume0 * ~none
        total, whole = over_all(cut.grid.comm, sum_by(part, np.array([weight * defect, weight]), count))
        mean = np.divide(total, whole, out=np.zeros(count), where=whole > 0) * undrained()
        return {"owed": defect, "due": np.where(none | keeps, 0.0, mean[part] + share * (defect - mean[part]))}

    def _undrained(
        self, state: State, on_grid: OnGrid, data: QuadratureData, loads: Sequence[Loads]
    ) -> NDArray[np.bool_]:
        """Return a mask of connected parts without open sides and without sources."""
        cut, (part, count) = on_grid.cut, on_grid.parts
        fed = [one.fed(cut, data.of_points) for one in state.stage.feeding]
        at = np.concatenate([np.zeros(0, dtype=np.int64), *fed])
        conduct = [one for one in loads if one.conducts]
        whole, wholes = on_grid.parts_of_points(conduct) if conduct else on_grid.parts
        of = np.zeros(count, dtype=np.int64)
        of[part] = whole
        closed = over_all(cut.grid.comm, np.bincount(whole[at], minlength=wholes)) == 0
        return closed[over_all(cut.grid.comm, of, MPI.MAX)]

    def of_bodies(self, on_grid: OnGrid, cells: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the maxima (k, bodies) of k quantities in each body. `values` (k, n): values in active owned cells."""
        (part, count), points = on_grid.active.parts_of_cells, on_grid.cut.points
        inside = np.zeros((len(self._bodies), count), dtype=bool)
        inside[self._body(points), on_grid.parts[0]] = True
        return largest_of_bodies(self._momentum.grid.comm, part[cells] - 1, values, inside)

    def _body(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return the index of each point's body."""
        return body_of(points.id, self._starts)

    def _sizes(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the edge lengths (n, d), in m, of undeformed boxes that have the reference volumes of the points."""
        body = self._body(points)
        rows = [points.id[body == i] - start for i, start in enumerate(self._starts[:-1])]
        size = np.concatenate([one.boxes(row) for one, row in zip(self._bodies, rows, strict=True)])
        return size * (points.volume0 / size.prod(axis=1))[:, None] ** (1 / size.shape[1])

    def _check_volumes(self, points: MaterialPoints, cut: CutDomains) -> None:
        """Raise NotConverged for inverted points and for zero porosity."""
        wet, J = self._storage is not None, points.J
        least = 1 - self._materials.table(points, lambda m: m.porosity) if wet else np.zeros(len(J))
        bad = (~(J > least)).nonzero()[0]
        if over_all(cut.grid.comm, len(bad)):
            shown = [f"point {points.id[i]} at {points.x[i] + cut.grid.base} with J = {J[i]:.3g}" for i in bad[:1]]
            what = "the pores have closed" if wet else "the body is inverted"
            raise NotConverged(f"{what}, J <= {least.max(initial=0):.3g}: {', '.join(shown) or 'elsewhere'}")

    def left_grid(self, state: State, on_grid: OnGrid) -> State:
        """Return the state for a reset of the grid: it contains pore pressures of the pieces for the next grid."""
        pieces = state.pieces and self._left(state.pieces, state.points, state.stage, state.t, on_grid, False)
        return replace(state, pieces=pieces, stay=None)

    def _left(
        self, carried: PiecePressures, points: MaterialPoints, stage: Stage, t: float, on_grid: OnGrid, some: bool
    ) -> PiecePressures:
        """Return the pore pressures of the pieces for the transfer to the next grid."""
        with _compat.Timer("remap"):
            pieces = on_grid.cut.pieces
            store = self._materials.storage(points) * points.volume0 * points.J
            on_grid.set_pressures(carried.of_cell)
            water = on_grid.pore_water(points)
            at_rest = None if water is None else self._at_rest(stage, t, None)
            of_pieces = self._reconstruction, pieces.fraction * store[pieces.point]
            pressure, slope, bounds = on_grid.pressures_at_pieces(*of_pieces, stage, t, water, at_rest)
        none = {} if some else {"of_cell": None, "start": None}
        return replace(carried, pressure=pressure, slope=slope, bounds=bounds, **none)


def _check_inside(cut: CutDomains, points: MaterialPoints, t: float, report: Report | None) -> None:
    """Raise LeftGrid if a corner of a point is outside the grid."""
    grid = cut.grid
    x = points.corners if cut.domains else points.x[:, None]
    message = ""
    if grid.outside(x.reshape(-1, grid.dim), REACH).any():
        beyond = np.maximum(grid.low - x, x - grid.high).max(axis=2)
        i, corner = np.unravel_index(np.argmax(np.where(np.isnan(beyond), np.inf, beyond)), beyond.shape)
        of = f"point {points.id[i]} at {points.x[i] + grid.base}"
        of += f": its corner at {x[i, corner] + grid.base}" if cut.domains else ""
        by = f"by {beyond[i, corner]:.3g} m at t = {t:g} s"
        message = f"{of} left the grid {grid.lower} to {grid.upper} {by}, must stay inside: use a larger grid"
    if message := first(grid.comm, message):
        raise LeftGrid(message, report)


def untangled(
    points: MaterialPoints,
    corners: NDArray[np.float64],
    bad: NDArray[np.bool_],
    F: NDArray[np.float64],
    grid: Grid,
    loads: Sequence[Loads],
) -> NDArray[np.float64]:
    """Return the corners, in m. Inverted domains, flagged by `bad`, have new corners that follow from F."""
    at = bad.nonzero()[0]
    X = points.reference[bad]
    d = grid.dim
    volume0 = volumes(X) if grid.axisymmetric else points.volume0[at]
    F, new = F[at, :d, :d], corners[at].mean(axis=1, keepdims=True)
    new = new + np.einsum("nab,nkb->nka", F, X - X.mean(axis=1, keepdims=True))
    for one in loads:
        new = one.under_held(points.id[at], corners[at], volume0 * determinant(F), new)
    out = corners.copy()
    out[at] = np.minimum(np.maximum(new, grid.low), grid.high)
    return out
