# SPDX-License-Identifier: MIT
"""Reset of the grid: domains are cut into pieces, active cells are found, and matrices are created.

A step begins with a reset if any corner of a domain has moved by more than a small fraction of a cell. Other steps
reuse the pieces and matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.caching import Keyed, Latest
from mpm_dolfinx.base.fluid_content import mass_potential, pressure_of
from mpm_dolfinx.base.tolerances import ROUND_OFF, TINY
from mpm_dolfinx.conditions.acting import At, Loads
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.domains.pressure_transport import AtPlaces, CellPressures, Reconstruction, share_within, transport
from mpm_dolfinx.flow.borders import Borders
from mpm_dolfinx.flow.feeding import Feeds, Wet, open_sides
from mpm_dolfinx.flow.fluxes import CellContents, Conduction, Mobility, OpenSides, PieceContents
from mpm_dolfinx.flow.layers import graded, mixed_cells
from mpm_dolfinx.flow.nonorthogonal import Gradients, nonorthogonal_facets, off_middle
from mpm_dolfinx.flow.storage import Outflow, StorageForms, StorageSystem
from mpm_dolfinx.forms.unknowns import collect_garbage
from mpm_dolfinx.mechanics.ghost_penalty import FULL, RATIO, stiffness
from mpm_dolfinx.mechanics.momentum import MomentumForms, MomentumSystem
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData, QuadraturePoints
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.parts import joined_parts
from mpm_dolfinx.pores.pore_water import PoreWater
from mpm_dolfinx.solve.scheme import Scheme
from mpm_dolfinx.solve.schur import LinearSolvers, planned
from mpm_dolfinx.stepping.stage import Stage
from mpm_dolfinx.stepping.state import State


class OnGrid(Keyed):
    """The bodies on the grid, as cut at the last reset.

    `quadrature`: integration points of the scene.
    `momentum`, `storage`: forms of the two balances. `storage` is None without fluid.
    `cut`: the cut particle domains.
    `of_fluid`: whether the fixed-stress coefficient beta is 1/K_w, see `Scheme`.
    """

    def __init__(
        self,
        quadrature: QuadraturePoints,
        momentum: MomentumForms,
        storage: StorageForms | None,
        cut: CutDomains,
        of_fluid: bool,
    ):
        grid = cut.grid
        points = cut.points
        self.cut = cut
        self._quadrature, self._materials = quadrature, quadrature.materials
        self._storage, self._u = storage, momentum.u
        self._momentum = momentum
        self._places = quadrature.places(cut)
        self.data = quadrature.data(cut, self._places, points)
        """Integration points at the reset of the grid."""
        pieces = self.data.pieces
        self.weight = weight = pieces["weight"][:, 0] * grid.volumes(pieces.cells)
        """Volumes (m,) of the pieces, in m^d."""
        area, x = cut.plane(weight)
        scales = stiffness, lambda m: m.shear if m.state else 0.0  # only yielding laws need regularisation
        moduli = [area * self._rows(scale) for scale in scales]
        own = self._places.pieces.filled
        self.active = momentum.set_contents(own, *self._places.pieces.total(np.array([area, *moduli])))
        """The cells that contain material."""
        self.cells = self.active.cells
        self.fill = np.zeros(grid.num_local)
        """Volume fraction of material in the local cells."""
        self.fill[self.cells] = momentum.ghost.fill.x.array[self.cells]
        self.facets = self.active.facets
        """Faces of this process between two active cells."""
        self.penalised = momentum.ghost.facets(self.facets)
        """Faces with a ghost penalty."""
        rows = self._rows(lambda m: m.oedometric) * grid.around(cut.x)
        self.stiffness = np.zeros(grid.num_local)
        """Largest oedometric modulus (Pa) in each local cell, in axisymmetry times the circumference (N/m)."""
        order = rows.argsort(kind="stable")
        self.stiffness[cut.cells[order]] = rows[order]  # the largest value of a cell is assigned last
        self.contents = None
        self._mixed, self._borders = None, None
        self.layered = quadrature.layered
        self._sides: Latest[OpenSides] = Latest()
        if storage is not None:
            # 1/K_w in place of beta converges for stiff skeletons only
            beta = (lambda m: 1 / storage.bulk) if of_fluid else lambda m: m.biot**2 / m.drained_modulus(grid.stretches)
            brought = PieceContents(
                cells=cut.cells,
                weight=weight,
                area=area,
                x=x,
                faces=cut.faces(),
                fixed_stress=self._rows(beta) * (1.0 if of_fluid else cut.to_cells(points.J)),
                damping=self._rows(lambda m: m.pressure_damping()),
            )
            self.contents = CellContents(storage.fluxes, brought, own)
            if quadrature.materials.retentions is not None:
                lever = x - grid.midpoints[cut.cells] - self.contents.centroid[cut.cells]
                self._places = replace(self._places, lever=lever)
                self.data = quadrature.data(cut, self._places, points)
            if quadrature.layered:
                alike = cut.to_cells(self._materials.conducting(points))
                self._mixed = mixed_cells(cut, alike, self.contents)
                if storage.fluxes.relative is not None:
                    law = cut.to_cells(quadrature.materials.retention_of(cut.points))
                    self._borders = Borders(self.contents, cut.cells, alike, law, self.facets, self._mixed)

    @cached_property
    def resisting_mass(self) -> NDArray[np.float64]:
        """Ratio of inertial to elastic resistance (n,) in the filled owned cells, for a motion in t = 1 s.

        Let 2 x 2 cells of Q1 elements have a consistent mass. A displacement of the middle node over the time t has a
        resistance proportional to `lambda + 3G + rho h^2 / (3 t^2)`.
        """
        filled, cut = self.contents.filled, self.cut
        density = cut.to_cells(self._materials.present_density(cut.points))
        modulus = self._rows(lambda m: m.macroelement)
        density, modulus = map(self.contents.mean, (density, modulus))
        return density * cut.grid.sizes(filled).min(axis=-1) ** 2 / (3 * modulus)

    @property
    def mixes(self) -> bool:
        """Whether any cell contains several soils whose ratio of conductivities varies with pressure."""
        return self._mixed is not None and self._storage.fluxes.relative is not None

    @cached_property
    def not_full(self) -> NDArray[np.int32]:
        """Faces with a ghost mass: faces between a partly filled cell and another active cell."""
        fill = self.fill[self.cut.grid.facet_cells[self.facets]]
        return self.facets[fill.min(axis=1) < np.maximum(FULL, RATIO * fill.max(axis=1))]  # includes `penalised`

    @property
    def masses(self) -> NDArray[np.float64]:
        """Masses (n,), kg, of the points."""
        return self._materials.masses(self.cut.points)

    def _rows(self, value: Callable[[Any], float]) -> NDArray[np.float64]:
        """Return a material constant at the integration points."""
        return self.cut.to_cells(self._materials.table(self.cut.points, value))

    def data_of(self, state: State) -> QuadratureData:
        """Return the integration points with the present data of the material points."""
        if not state.stay:
            return self.data
        with _compat.Timer("integration data"):
            return self._quadrature.data(self.cut, self._places, state.points)

    def start(self, state: State) -> NDArray[np.float64] | None:
        """Set the pressures at the start of a step.  Return the corrections (n,), m^d, of volume defects in the step.

        The result refers to the filled owned cells, and is None without fluid.
        """
        if self._storage is None:
            return None
        with _compat.Timer("remap"):
            p_n = self._storage.p_n.x
            p_n.array[self.contents.filled] = self.pressures(state)
            p_n.scatter_forward()
        self._storage.p.x.array[self.cells] = p_n.array[self.cells]
        share = self.cut.shares(state.points.volume0 * state.points.data["due"])
        return self.contents.total(self.data.pieces["biot"][:, 0] * share)

    def pressures(self, state: State) -> NDArray[np.float64]:
        """Return the pressures (Pa) of the filled owned cells at the start of a step."""
        if not state.stays:
            bulk = self._storage.bulk
            retentions, new = self._materials.retentions, self.cut.pieces
            old, rest = state.pieces.potentials(bulk), None if retentions is None else retentions.weight.value
            # hydrostatic pressures are excluded, because the storage of unsaturated soil is not linear
            carried = transport(old if rest is None else old.less(rest), self.cut.points, new)
            carried = carried if rest is None else carried + new.x @ rest
            if state.stay:
                carried = mass_potential(self.of_pieces(state, "of_cell", pressure_of(carried, bulk)), bulk)
            p = pressure_of(self._means(carried), bulk)
            water = self.pore_water(self.cut.points)
            return p if water is None else water.level(water.of_cells(self._carried(state, carried)), p, self.heads)
        p = np.zeros(self.cut.grid.num_local)
        p[self.cut.cells] = self.cut.pieces_to_cells(state.pieces.of_cell)
        return p[self.contents.filled]

    def _carried(self, state: State, pi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures (Pa) of the pieces from their mass potentials pi (Pa), see `fluid_content`.

        The pore water of each point is conserved.
        """
        pieces, there = self.cut.pieces, pressure_of(pi, self._storage.bulk)
        more = state.water_changes(self.cut.points, pieces.point, pieces.fraction, there)
        if state.stay:
            more = np.where(state.stay.keeps, 0.0, more)
        return self.cut.pieces_to_cells(there + more[pieces.point])

    def of_pieces(self, state: State, name: str, fresh: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the array `name` (m, ...) of `PiecePressures` for all pieces. New pieces have the values `fresh`."""
        return state.of_pieces(name, fresh, self.cut.pieces.point)

    @contextmanager
    def as_reset(self, state: State) -> Iterator[QuadratureData]:
        """Yield the integration points at the last reset, with u = 0 and the pressure p at the reset."""
        at = [(self._u.x.array, self._momentum.active.now.dofs)]
        if self._storage is not None:
            at += [(f.x.array, self.cells) for f in (self._storage.p, self._storage.p_n)]
        now = [values[rows] for values, rows in at]
        self._u.x.array[self._momentum.active.now.dofs] = 0.0
        if self._storage is not None:
            if state.stay:
                self.set_pressures(self.of_pieces(state, "start", self.pressures_of_pieces()))
            self._storage.p.x.array[self.cells] = self._storage.p_n.x.array[self.cells]
        try:
            yield self.data
        finally:
            for (values, rows), before in zip(at, now, strict=True):
                values[rows] = before

    def pressures_of_pieces(self) -> NDArray[np.float64]:
        """Return the pressure (m,), in Pa, of each piece's cell at the start of a step."""
        return self.cut.to_pieces(self._storage.p_n.x.array[self.cut.cells])

    def set_pressures(self, at_pieces: NDArray[np.float64]) -> None:
        """Set the cell pressures at the start of a step from the pressures (Pa) of the pieces."""
        p_n = self._storage.p_n.x
        p_n.array[self.cut.cells] = self.cut.pieces_to_cells(at_pieces)
        p_n.scatter_forward()

    def _means(self, at_pieces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean potentials of the pieces in the filled owned cells.

        Means are weighted by storage, or by volume in cells without storage.
        """
        contents, points = self.contents, self.cut.points
        store = self.cut.shares(self._materials.storage(points) * points.volume0 * points.J)
        potential = self.cut.pieces_to_cells(at_pieces)
        held, moment, mean = contents.total(np.array([store, store * potential, contents.weight * potential]))
        return np.divide(moment, held, out=mean / contents.volume, where=held > 0)

    def pressures_at_pieces(
        self,
        reconstruction: Reconstruction,
        store: NDArray[np.float64],
        stage: Stage,
        t: float,
        water: PoreWater | None,
        at_rest: AtPlaces | None,
    ) -> list[NDArray[np.float64]]:
        """Return pressures (m,) of the pieces, their slopes (m, d) and bounds (m, 2), from the pressures of the cells.

        The mean mass potential of the pieces equals the potential of their cell. In unsaturated scenes, the pore water
        of a cell is conserved instead.

        `store` (m,), m^d/Pa: storage of the pieces, which is their weight in means.
        `t`, s: time of the pressures on open sides.
        `water`: pore water of the pieces, in unsaturated scenes.
        `at_rest`: hydrostatic pressures, subtracted before the reconstruction, or None without gravity.
        """
        pieces = self.data.pieces
        contents = self.contents
        bulk = self._storage.bulk if water is None else np.inf
        p_n = self._storage.p_n.x.array
        cells = pieces.cells
        offset = pieces.places.offset
        at = contents.slot(pieces.cells)
        store = self.cut.pieces_to_cells(store)
        weight = np.where(contents.total(store)[at] > 0, store, self.weight)
        total, *moments = contents.total(np.concatenate([weight[None], weight * offset.T]))
        origin = (moments / total).T
        seen = self._cell_pressures(p_n, stage, t, bulk, at_rest)
        slope, bounds = reconstruction(seen, origin)
        rise, here = np.add.reduce(slope[at] * (offset - origin[at]), axis=1), seen.p[contents.filled]
        share = share_within(rise, *(bounds.T - here), at)  # drained sides may be inclined to the grid
        pi = here[at] + share[at] * rise
        slope, bounds = (slope * share[:, None])[at], bounds[at]
        if at_rest is not None:
            resting = at_rest(cells, self.cut.grid.midpoints[cells] + offset)
            step = np.eye(offset.shape[1])
            slope = slope + at_rest(cells[:1], step) - at_rest(cells[:1], 0 * step)
            pi, bounds = pi + resting, bounds + resting[:, None]
        if water is not None:
            mean = p_n[contents.filled]
            beyond = pi - mean[at]
            pi = water.level(water.of_cells(mean[at] + self.heads), mean, beyond)[at] + beyond
        slope = slope / (1 + pi / bulk)[:, None]
        values = pressure_of(pi, bulk), slope, pressure_of(bounds, bulk)
        return [self.cut.to_pieces(rows) for rows in values]

    def softness(self, state: State) -> NDArray[np.float64] | float:
        """Return the ratio (m,) of the elastic to the tangent shear modulus of the pieces at the start of the step."""
        data = state.points.data
        return self.cut.to_cells(data["softness"]) if "softness" in data else 1.0

    def pressures_up_to_surface(
        self, reconstruction: Reconstruction, stage: Stage, t: float, at_rest: AtPlaces | None = None
    ) -> NDArray[np.float64]:
        """Return the pressures (m,) at the centroids of the pieces, in Pa.

        The mean pressure over the pieces of a cell equals the cell pressure.

        `t`, s: time of the pressures on drained sides.
        `at_rest`: hydrostatic pressures, or None without gravity.
        """
        places, p = self._places.pieces, self._storage.p.x.array
        seen = self._cell_pressures(p, stage, t, at_rest=at_rest)
        x, middle = self.cut.plane(self.weight)[1], self.cut.grid.midpoints[self.cut.cells]
        limited = (at_rest, self._alike) if self._materials.retentions is not None else ()
        pressures = reconstruction.up_to_surface(seen, x - middle, places.slots, *limited)
        if at_rest is not None and not limited:
            pressures = pressures + at_rest(self.cut.cells, x)
        return self.cut.to_pieces(pressures)

    @cached_property
    def _alike(self) -> NDArray[np.bool_] | bool:
        """Whether each filled owned cell and its neighbour (n, d, 2) contain the same soil alone."""
        if not self.layered:
            return True
        grid, filled = self.cut.grid, self.contents.filled
        slot = self.contents.slot(self.cut.cells)
        out, neighbours = True, grid.neighbours(filled)
        for kind in self.cut.to_cells(self._materials.conducting(self.cut.points)).T:
            first, soil = np.zeros(len(filled)), fem.Function(grid.cellwise())
            first[slot] = kind
            several = self.contents.total((kind != first[slot]).astype(float)) > 0
            soil.x.array[filled] = np.where(several, np.nan, first)
            soil.x.scatter_forward()
            out &= soil.x.array[filled][:, None, None] == soil.x.array[neighbours]
        return out

    def _cell_pressures(
        self, p: NDArray[np.float64], stage: Stage, t: float, bulk: float = np.inf, at_rest: AtPlaces | None = None
    ) -> CellPressures:
        """Return the cell pressures as mass potentials, with the data from which their slopes are computed."""
        contents = self.contents
        wet = Wet(self.cut, self.cut.points, contents, t)
        place = lambda: open_sides([one.placed(wet) for one in stage.feeding], self.cut.grid.dim)  # noqa: E731
        sides = self._sides((stage, t), place, self.cut.grid.comm)
        if bulk < np.inf:
            sides = replace(sides, pressure=mass_potential(sides.pressure, bulk))
        cells, seen = self.cells, np.zeros(len(p))
        seen[cells] = mass_potential(p[cells], bulk)
        if at_rest is not None:
            middle, centroid = self.cut.grid.midpoints, contents.centroid
            seen[cells] -= at_rest(cells, middle[cells] + centroid[cells])
            beyond = middle[sides.cells] + centroid[sides.cells] + sides.offset
            sides = replace(sides, pressure=sides.pressure - at_rest(sides.cells, beyond))
        outer = sides.ahead(contents.slot(sides.cells), seen[contents.filled])
        return CellPressures(contents.filled, seen, contents.centroid, contents.open, outer)

    def mobility(self, data: QuadratureData, begins: bool) -> Mobility:
        """Return the mobility of the filled owned cells at the present displacements u.

        `begins`: whether invalid values raise ValueError.
        """
        law, cut = self._storage.conductivity, self.cut
        if law is None:
            at_pieces = self._rows(lambda m: m.conductivity)
        else:
            at_pieces = law.evaluate(data.pieces, cut.to_cells(cut.points.material), begins)
        at_pieces = at_pieces / self._materials.fluid.unit_weight
        mean, share = self.contents.mean(at_pieces), None
        if law is not None:
            share = graded(self.contents, self._places.pieces.offset, at_pieces, mean)
        if self._storage.fluxes.relative is not None:
            return self._relative_mobility(at_pieces, mean, share)
        return Mobility(mean, share) if self._mixed is None else self._mixed.mobility(at_pieces, mean, share)

    def _relative_mobility(
        self, full: NDArray[np.float64], mean: NDArray[np.float64], share: NDArray[np.float64] | None
    ) -> Mobility:
        """Return the mobility of cells in unsaturated soil."""
        cut = self.cut
        law = cut.to_cells(self._materials.retention_of(cut.points))
        count = self._storage.fluxes.relative.count
        shares = np.stack([self.contents.mean(full * (law == i)) for i in range(count)], axis=1)
        shares = np.divide(shares, mean[:, None], out=np.zeros_like(shares), where=mean[:, None] > 0)
        given = {"shares": shares, "borders": self._borders}
        if self._mixed is None:
            return Mobility(mean, share, **given)
        k = self._materials.saturation(
            cut.points, cut.to_pieces(self._storage.p_before.x.array[cut.cells]), cut.pieces.point
        )[3]
        mobility = self._mixed.mobility(full, mean, share, full * np.maximum(cut.pieces_to_cells(k), TINY))
        return replace(mobility, paths=self._mixed.paths(full, law, count, mobility.shift), **given)

    def pore_water(self, points: MaterialPoints) -> PoreWater | None:
        """Return the pore water of the pieces with the porosities of the points, or None in saturated scenes."""
        materials, cut = self._materials, self.cut
        if materials.retentions is None:
            return None
        volume, slot = cut.shares(points.volume0 * points.J), self.contents.slot(cut.cells)
        return materials.pore_water(points, cut.to_cells, volume, slot, self.scale)

    @property
    def heads(self) -> NDArray[np.float64]:
        """Pressures (m,) of unsaturated pieces minus the pressures of their cells, in Pa."""
        return self._materials.retentions.heads(self._places.lever)

    @cached_property
    def scale(self) -> NDArray[np.float64] | None:
        """Suctions (Pa) at which filled owned cells drain, at most 1 / `TINY`.  None in saturated scenes."""
        if self._materials.retentions is None:
            return None
        slot = self.contents.slot(self.cut.cells)
        return self._materials.scales(self.cut.points, self.cut.to_cells, slot, len(self.contents.filled))

    def resting_mobility(self) -> Mobility:
        """Return the conductivities (m/s) of filled owned cells in the reference configuration, as a `Mobility`."""
        at_pieces = self._rows(lambda m: m.conductivity)
        mean = self.contents.mean(at_pieces)
        return Mobility(mean) if self._mixed is None else self._mixed.mobility(at_pieces, mean, None)

    def rests(self, state: State) -> NDArray[np.int64] | None:
        """Return indices of filled owned cells whose points all keep their pieces, or None if no point keeps them."""
        if not state.stay:
            return None
        moves = self.cut.to_cells(~state.stay.keeps).astype(float)
        return (self.contents.total(moves) == 0).nonzero()[0]

    def valid(self, crossed: NDArray[np.float64], loads: Sequence[Loads]) -> NDArray[np.bool_]:
        """Return a mask (n,) of points that may keep their pieces, because their connected part hardly moves.

        `crossed`: see `CutDomains.crossed`.
        """
        part, count = self.parts if self.cut.grid.copies == 1 else self.parts_of_points(loads)
        return self.cut.valid(crossed, part, count)[part]

    def parts_of_cells(self, loads: Sequence[Loads]) -> tuple[NDArray[np.int64], int]:
        """Return the index of the connected part of each cell, and the number of parts. Contact connects parts."""
        if self.cut.grid.copies == 1:
            return self.active.parts_of_cells
        pairs = np.concatenate([one.within_reach() for one in loads])
        return joined_parts(self.cut.grid, *self.active.parts_of_cells, pairs)

    def parts_of_points(self, loads: Sequence[Loads]) -> tuple[NDArray[np.int64], int]:
        """Return the index of the connected part of each point, and the number of parts. Contact connects parts."""
        return self._of_points(*self.parts_of_cells(loads))

    @cached_property
    def parts(self) -> tuple[NDArray[np.int64], int]:
        """Index of the connected part of each point, from 0, and the number of parts."""
        return self._of_points(*self.active.parts_of_cells)

    def _of_points(self, part: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], int]:
        """Return the index of each point's connected part, and the number of these parts."""
        out = np.zeros(len(self.cut.points), dtype=np.int64)
        out[self.cut.pieces.point] = self.cut.to_pieces(part[self.cut.cells] - 1)
        return out, count

    @property
    def active_cells(self) -> int:
        """Number of active cells of all processes."""
        grid = self.cut.grid
        return int(grid.comm.allreduce(int((self.cells < grid.num_owned).sum())))


class System:
    """Vectors, matrices and solvers for one set of active cells.

    `momentum`, `storage`: compiled forms. `storage` is None without fluid.
    `dofs`: local indices of the unknown components of displacement.
    `stiff`: whether plates or prescribed displacements have a penalty.
    `symmetric`: whether the tangent of the momentum balance is symmetric.
    `loads`: loads at the last reset.
    """

    def __init__(
        self,
        momentum: MomentumForms,
        storage: StorageForms | None,
        scheme: Scheme,
        on_grid: OnGrid,
        dofs: NDArray[np.int64],
        stiff: bool,
        symmetric: bool,
        loads: Sequence[Loads],
    ):
        self._scheme = scheme
        self.symmetric = symmetric
        self.storage = None
        own = on_grid.cells[on_grid.cells < momentum.grid.num_owned]
        parts = momentum.parts(*on_grid.parts_of_cells(loads))
        self.momentum = MomentumSystem(momentum, dofs, own, on_grid.penalised, stiff, parts)
        if storage is not None:
            unknowns = self.momentum.unknowns
            joins = [one.joins for one in loads if one.conducts]
            self.storage = StorageSystem(storage, on_grid.cells, on_grid.facets, unknowns, parts, joins)
        self.plan = planned(scheme, self.momentum, self.storage, symmetric)
        """Solution method of the linearised problem."""

    @cached_property
    def solvers(self) -> LinearSolvers:
        """The solvers, created on first use."""
        return LinearSolvers(self.plan, self._scheme, self.momentum, self.storage)

    def end_step(self) -> None:
        """Delete the coarse grids of multigrid to free memory, unless a tangent is reused."""
        if "solvers" in vars(self) and self.plan.iterative and self.solvers.tangent.value is None:
            del self.solvers
            collect_garbage(self.momentum.unknowns.comm)


class Assembled(Keyed):
    """Penalties and fluxes, which steps reuse until the next reset or stage. `loads`: loads at the last reset."""

    def __init__(
        self,
        momentum: MomentumForms,
        storage: StorageForms | None,
        system: System,
        on_grid: OnGrid,
        stage: Stage,
        loads: Sequence[Loads],
    ):
        self._system = system
        self.momentum = system.momentum
        self.storage = system.storage
        self.symmetric = system.symmetric
        self.plan = system.plan
        self.end_step = system.end_step
        self._on_grid, self._stage = on_grid, stage
        self._nodal, self._varies = momentum.nodal, storage is not None and storage.conductivity is not None
        self._bulk, self._fluxes = (storage.bulk, storage.fluxes) if storage is not None else (np.inf, None)
        by_pressure = on_grid.mixes or (self._varies and storage.conductivity.by_pressure)
        self._by_pressure = storage.p_before if by_pressure else None
        self._mobility: Latest[Mobility] = Latest()
        self._outflow: Latest[Outflow] = Latest()
        own, self.mass = self.momentum, None
        own.set_penalty(loads if stage.inertia else [own.ghost, *loads])
        if stage.inertia:
            where = on_grid.cut, on_grid.data.pieces.places, on_grid.masses, on_grid.fill, on_grid.not_full
            self.mass = momentum.inertia.on(*where, own.unknowns, own.held, own.ghost)
            own.mass = self.mass.M
        self.momentum.set_rounding(self._rounding(momentum, loads))
        self.round_off = float(self.momentum.rounding.norm())
        """Norm (N) of the rounding error in the residual of the momentum balance."""
        self._off = None
        if self.storage is not None:
            self.storage.set_alternation()
            if (form := storage.fluxes.nonorthogonal) is not None:
                self._off = form.on(nonorthogonal_facets(on_grid.contents, on_grid.facets))
        self._gradients: Latest[Gradients | None] = Latest()
        self._of_cells: Latest[tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]] = Latest()

    @property
    def solvers(self) -> LinearSolvers:
        """The linear solvers of the system."""
        return self._system.solvers

    def _rounding(self, momentum: MomentumForms, loads: Sequence[Loads]) -> NDArray[np.float64]:
        """Return the rounding errors (N) of the residual at active local nodes, caused by stiffness and penalties."""
        grid, on_grid = self._on_grid.cut.grid, self._on_grid
        cells, of_cells = on_grid.cells, np.zeros(grid.num_local)
        of_cells[cells] = ROUND_OFF * on_grid.stiffness[cells] * grid.volumes(cells) / grid.sizes(cells).min(axis=-1)
        for one in loads:
            of_cells = one.rounding(of_cells)
        own = cells[cells < grid.num_owned]
        at_nodes = momentum.at_nodes(own, [of_cells[own, None]])[0] / 2 ** (grid.dim - 1)  # as in cells at a flat side
        return at_nodes + sum(one.rounding_beside for one in loads)

    def flow(
        self,
        state: State,
        weight: NDArray[np.float64] | None,
        data: QuadratureData,
        t: float,
        dt: float,
        loads: Sequence[Loads],
        present: At,
    ) -> tuple[list[Feeds], Callable[[bool], Outflow]]:
        """Return the conditions on the fluid, and a function `outflow(begins)` that returns the fluxes at u.

        If `begins` is True, this function raises ValueError for invalid values.

        `state`: state at the start of the step.
        `weight` (d,), N/m^3: unit weight of the fluid, or None without gravity.
        `data`: integration points.
        `t`, s: time of the pressures and fluxes on open sides.
        `dt`, s: length of the step.
        `loads`: loads in the balance of momentum. `present`: present displacements.
        """
        on_grid = self._on_grid
        contents = self._on_grid.contents
        grid = self._on_grid.cut.grid
        u = self._nodal
        varies = (t,) if any([one.varies for one in self._stage.feeding]) else ()
        at = state.points if weight is not None or varies else on_grid.cut.points  # because gravity may depend on time
        of_step = on_grid.scale is not None, dt, state.outcome, loads, present
        wet = Wet(on_grid.cut, at, contents, t, data.of_points, *of_step)
        feeds = [one.placed(wet) for one in self._stage.feeding]
        sides = open_sides(feeds, grid.dim)

        def mobility(begins: bool) -> Mobility:
            if self._varies:
                return on_grid.mobility(data, begins)
            together = [grid.comm] if mixture else []  # without pressures, the cache key is equal on all processes
            return self._mobility(mixture, lambda: on_grid.mobility(data, True), *together)

        def fit() -> Gradients | None:
            needed = self._off.some or off_middle(sides, grid).any()
            return Gradients(contents, sides, *of_cells) if needed else None

        def mobility_and_fill() -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
            unequal = partial(self._fluxes.unequal, contents.filled)
            return unequal(mobility(True).mean) if layered else None, unequal(contents.fill) if unsaturated else None

        layered, unsaturated = on_grid.layered and not self._varies, on_grid.scale is not None
        mixture, of_cells = (), (None, None)
        if self._by_pressure is not None:
            mixture = (self._by_pressure.x.array[on_grid.cells],)
            varies = (*varies, *mixture)
        if self._off is not None and (layered or unsaturated):
            of_cells = self._of_cells((), mobility_and_fill, grid.comm)
        where = (sides.cells, sides.shape, sides.seeps, sides.area, sides.offset)
        gradients = None if self._off is None else self._gradients(where, fit)
        off = gradients and (self._off, gradients, sides)

        def set_fluxes(begins: bool, nodal: NDArray[np.float64] | None = None) -> Outflow:
            motion = None if nodal is None else contents.motion(nodal, rests)
            flow = Conduction(steady or mobility(begins), motion, weight, self._bulk)
            return self.storage.set_fluxes(contents, feeds, flow, off)

        rests = steady = None
        if state.stays and not self._varies:
            of_cut = self._outflow((at, weight, *varies), partial(set_fluxes, True), grid.comm)
            return feeds, lambda begins: of_cut
        if not self._varies:
            rests, steady = on_grid.rests(state), mobility(True)
        at_u = (data.pieces.key, weight, *varies)  # a substep begins at the end of the previous one

        def outflow(begins: bool) -> Outflow:
            nodal = u[contents.nodes]
            return self._outflow((*at_u, nodal), partial(set_fluxes, begins, nodal), grid.comm)

        return feeds, outflow
