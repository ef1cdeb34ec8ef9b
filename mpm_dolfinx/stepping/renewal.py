# SPDX-License-Identifier: MIT
"""Renewal: replacement of distorted particle domains of flowing soil by new ones, at a reset of the grid.

F of yielded soil is updated by increments, so the domains of this soil serve for integration only. A cell is filled
anew if it contains a piece of a domain of yielded soil that is longer than `LONGEST`:

* A full cell is divided into four equal domains.
* A cell that the surface crosses once is filled with quadrilaterals about the centroid of the filled part. The surface
in the cell becomes a polyline of `EDGES` edges. The filled area does not change.

The parts of old domains outside these cells become new domains. Each cell conserves mass, volume, mass of fluid, and
mass-weighted sums of other point data. With inertia, each cell also conserves momentum and angular momentum. Point data
of a new domain are means over the old domains in its area, corrected to first order for its centroid. Cells are not
filled anew if they contain soil whose law cannot yield, several bodies, several crossings of the surface, or a
prescribed side. Soil that has not yielded is renewed only in cells that it shares with distorted domains of yielded
soil. Otherwise the parts of yielded domains that enter such a cell would accumulate there.
Domains whose remaining parts would lose a face on the surface are renewed in all their cells or in none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.fluid_content import pressure_of
from mpm_dolfinx.domains.pressure_transport import at_start, transport
from mpm_dolfinx.domains.refilled_cells import New, RefilledCells, misshapen
from mpm_dolfinx.domains.renewed_faces import AREA, ENDS, PARENT, PART, ROOT, SeededFaces, is_part, with_faces
from mpm_dolfinx.dynamics.renewed_velocities import MOTION, centred, velocities
from mpm_dolfinx.grid.grid import means_of_rows, sum_by
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.parallel.exchange import first, over_all
from mpm_dolfinx.points.cutting import centroids, domain_volumes
from mpm_dolfinx.points.material_points import ACROSS, MaterialPoints, body_of, in_space, unstretched
from mpm_dolfinx.stepping.state import State, Stay

LONGEST = 1.0
"""Largest length of a domain, in cell sizes, that does not cause a renewal. Source: definition."""


class Renewal:
    """Renewal of the particle domains in a scene."""

    def __init__(self, faces: SeededFaces, materials: SceneMaterials):
        self._grid = materials.grid
        self._bodies = faces.bodies
        self._starts = np.cumsum([0, *map(len, faces.bodies)])
        self._materials = materials
        self._faces = faces
        self._signs: Latest[tuple[NDArray, NDArray]] = Latest()

    def long(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of domains that are longer than `LONGEST` cells, or partly inverted."""
        return misshapen(self._grid, points.corners, LONGEST)

    def flowed(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of points that have yielded or have been renewed."""
        renewed = (points.id >= self._starts[-1]) & ~is_part(points)
        return self._may_yield(points) & (self._materials.evolved(points) | renewed)

    def _may_yield(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of points whose laws have the state variable `plastic`."""
        if "plastic" not in points.data:
            return np.zeros(len(points), dtype=bool)
        return np.array(["plastic" in law.state for law in self._materials.laws])[self._materials.law_of(points)]

    def _free(self, state: State) -> NDArray[np.bool_]:
        """Return a mask (n,) of points whose domains may be replaced.  Parts of elastic domains are divided instead."""
        free = self.flowed(state.points) | (self._may_yield(state.points) & ~is_part(state.points))
        free &= ~self._faces.needed(state.stage.lasting, state.points)
        if state.watched is not None:
            free &= ~np.isin(state.points.id, state.watched)
        return free if state.stay is None else free & ~state.stay.keeps

    def renewed(self, state: State) -> tuple[State, int]:
        """Return the state with renewed domains, and the number of replaced domains. All processes must call this.

        After a renewal, the first process has all points. A failure raises NotConverged.
        """
        comm = self._grid.comm
        needs = self.long(state.points)
        if not over_all(comm, int(needs.any() and (needs & self.flowed(state.points) & self._free(state)).any())):
            return state, 0
        if comm.size > 1:
            state = state.migrated(np.zeros(len(state.points), dtype=np.int32), comm)
        made, count = state, 0
        message = ""
        try:
            if comm.rank == 0:
                made, count = self._renewed(state)
        except (ValueError, ArithmeticError, IndexError, np.linalg.LinAlgError) as error:  # raised below, by all
            message = str(error)
        if message := first(comm, message):
            raise NotConverged(f"renewal of domains: {message}")
        count = over_all(comm, count)
        if not count:
            return state, 0
        stay = made.stay and replace(made.stay, points=with_faces(made.stay.points))
        return replace(made, points=with_faces(made.points), stay=stay), count

    def _renewed(self, state: State) -> tuple[State, int]:
        stage, points = state.stage, state.points
        signs = self._signs((stage,), lambda: self._faces.signatures(stage.faces), MPI.COMM_SELF)
        needs, body = self.long(points), body_of(points.id, self._starts)
        moves = MOTION[0] in points.data
        masks = self._free(state), self.flowed(points), needs
        given = self._grid, points, body, *masks, self._faces.of(points), signs, moves
        work = RefilledCells(*given)
        while (torn := work.torn).any():
            work = RefilledCells(*given, work.whole | torn)
        if not work.chosen.any():
            return state, 0
        new = [work.full(), work.partial(), work.remainders[0]]
        group = np.concatenate([one.group for one in new])
        made = self._filled(points, work, new, tuple(stage.kept(0)))
        if moves:
            masses = self._materials.masses(points), self._materials.masses(made)
            v, L = velocities(work, made.corners, made.x, group, masses)
            made = replace(made, data={**made.data, **dict(zip(MOTION, (v, L @ made.F), strict=True))})
        kept = ~work.affected
        replaced = points.id[work.affected]
        stay, pieces = state.stay, state.pieces
        if stay is not None:
            rows = _joined(stay.points, made, kept)
            order = np.argsort(np.concatenate([points.id[kept], made.id]))
            stay = Stay(rows, np.concatenate([stay.keeps[kept], np.zeros(len(made), dtype=bool)])[order])
        if pieces is not None:
            pressure = self._pressures(state, work, made, group)
            brought = at_start(replace(made, pressure=pressure))
            if pieces.of_cell is not None:
                brought = replace(brought, of_cell=pressure, start=pressure)
            pieces = pieces.of(replaced, kept=False).joined(brought)
        return replace(state, points=_joined(points, made, kept), pieces=pieces, stay=stay), len(replaced)

    def _pressures(
        self, state: State, work: RefilledCells, made: MaterialPoints, group: NDArray
    ) -> NDArray[np.float64]:
        """Return the pressures of the new domains: means of the old pressures, weighted by storage or volume.

        In unsaturated scenes, pressures are hydrostatic in each cell, and conserve the pore water of the cell.
        """
        materials, pieces = self._materials, work.pieces
        points = state.points
        bulk = materials.fluid.bulk
        rest = None if materials.retentions is None else materials.retentions.weight.value
        piece, groups, share = work.into
        of, count = pieces.point[piece], int(group.max()) + 1
        others = pieces.fraction.copy()
        others[piece] = 0.0  # very thin pieces are added to the other pieces of their domain
        whole = sum_by(pieces.point, others, len(points))
        volume, new_volume = (of_points.volume0 * of_points.J for of_points in (points, made))

        def brought(values: NDArray) -> NDArray:
            """Return the parts of `values` of the pieces that enter the new domains."""
            held = sum_by(pieces.point, others * values, len(points))
            mean = np.divide(held, whole, out=np.zeros(len(points)), where=whole > 0)[of]
            return pieces.fraction[piece] * values[piece] + (share - pieces.fraction[piece]) * mean

        def over(values: NDArray, weight: NDArray) -> NDArray:
            return sum_by(groups, values * weight[of], count)

        given = state.pieces.potentials(bulk)
        potential = transport(given if rest is None else given.less(rest), points, pieces)
        brings = brought(potential)
        even = over(brings, volume) / over(share, volume)
        if rest is not None:  # heads are not linear in the content, which is conserved
            p = pressure_of(potential + pieces.x @ rest, bulk)
            p += state.water_changes(points, pieces.point, pieces.fraction, p)[pieces.point]
            held = materials.pore_water(points, itemgetter(pieces.point), 1.0, np.arange(len(p))).of_cells(p)
            held = over(brought(held), volume)
            middle = means_of_rows(group, new_volume, made.x, count)
            water = materials.pore_water(made, np.asarray, new_volume, group)
            head = (made.x - middle[group]) @ rest
            return water.level(held, even + middle @ rest, head)[group] + head
        store = materials.storage(points) * volume
        stored = sum_by(group, materials.storage(made) * new_volume, count)
        return pressure_of(np.divide(over(brings, store), stored, out=even, where=stored > 0), bulk)[group]

    def _filled(
        self, points: MaterialPoints, work: RefilledCells, new: Sequence[New], touched: Sequence[str]
    ) -> MaterialPoints:
        """Return the material points of the new domains."""
        corners, group, parent, area, ends = (np.concatenate(column) for column in zip(*new, strict=True))
        old, at, share = work.pairs(corners, group)
        piece, groups, part = work.into
        source = work.pieces.point[piece]
        n, mass = len(corners), points.volume0
        J = points.J
        weight = share * mass[old]
        x = centroids(corners)
        off = x - means_of_rows(at, weight, points.x[old], n)
        size = np.abs(domain_volumes(corners, self._grid.axisymmetric))
        count = int(group.max()) + 1
        M, V = (sum_by(groups, part * of[source], count) for of in (mass, mass * J))

        def mean(values: NDArray) -> NDArray:
            flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
            if not flat.shape[1]:
                return np.zeros((n, *values.shape[1:]))
            means = means_of_rows(at, weight, flat[old], n) + np.einsum("ni,nik->nk", off, work.slopes(flat, group))
            low, high = np.full((count, flat.shape[1]), np.inf), np.full((count, flat.shape[1]), -np.inf)
            np.minimum.at(low, groups, flat[source])
            np.maximum.at(high, groups, flat[source])
            return np.clip(means, low[group], high[group]).reshape(n, *values.shape[1:])

        like = np.exp(mean(np.log(J)))
        volume0, volume = (size / one / sum_by(group, size / one, count)[group] for one in (like, 1.0))
        if work.pieces.second.size:
            volume0, volume = (centred(work, group, x, *of) for of in ((volume0, mass), (volume, mass * J)))
        volume0, volume = M[group] * volume0, V[group] * volume  # both mass and volume are exact
        ratio = volume / volume0

        def kept(values: NDArray) -> NDArray:
            """Return means of `values` that conserve their mass-weighted sum and stay within their range."""
            means = mean(values).reshape(n, -1)
            for column, of in zip(means.T, values.reshape(len(values), means.shape[1]).T, strict=True):
                missing = sum_by(groups, part * (mass * of)[source], count) - sum_by(group, volume0 * column, count)
                end = np.full(count, np.inf), np.full(count, -np.inf)
                np.minimum.at(end[0], groups, of[source])
                np.maximum.at(end[1], groups, of[source])
                margin = np.where(missing > 0, end[1], end[0])[group] - column
                whole = sum_by(group, volume0 * margin, count)
                column += np.divide(missing, whole, out=np.zeros(count), where=whole != 0)[group] * margin
            return means.reshape(n, *values.shape[1:])

        material = np.zeros(n, dtype=points.material.dtype)
        material[at] = points.material[old]
        body = np.zeros(n, dtype=np.int64)
        body[at] = work.body[old]
        moved = mean(points.x - centroids(points.origin))
        d = points.F.shape[1]
        stretch = ratio[:, None, None] ** (1 / d)
        F = stretch * np.eye(d)
        fixed = x * [not self._grid.axisymmetric, True]  # radii are stretched too
        data = {}
        logs = np.zeros((len(points), 3, 3))
        logs[work.affected] = _of_tensors(np.log, self._elastic(points, np.flatnonzero(work.affected)))
        across = np.exp(mean(np.log(points.data[ACROSS]))) if ACROSS in points.data else None
        data["plastic"] = _pulled(F, across, _of_tensors(np.exp, kept(logs)))
        for name, values in points.data.items():
            if name in touched:
                data[name] = work.on_faces(values, parent, group)
            elif name == ACROSS:
                data[name] = across
            elif name == ROOT:
                data |= {ROOT: np.full(n, -1), PART: np.zeros((n, 2, 2))}
            elif name not in (PARENT, AREA, ENDS, PART, *MOTION, "plastic"):
                data[name] = kept(values)
        data |= {PARENT: parent, AREA: area, ENDS: ends}
        number = (points.id - self._starts[-1]) // len(self._bodies)
        number = number[(number >= 0) & (number % 2 == 0)].max(initial=-2) + 2  # parts have odd numbers
        return MaterialPoints(
            id=self._starts[-1] + body + len(self._bodies) * (number + 2 * np.arange(n)),
            corners=corners,
            F=F,
            volume0=volume0,
            material=material,
            pressure=kept(points.pressure),
            x=x,
            origin=corners - moved[:, None],
            reference=fixed[:, None] + (corners - fixed[:, None]) / stretch,
            data=data,
        )

    def _elastic(self, points: MaterialPoints, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the elastic left Cauchy-Green tensors of the points with indices `rows`."""
        F = unstretched(points.F_of_laws[rows])
        return F @ points.data["plastic"][rows] @ F.swapaxes(1, 2)


def _joined(points: MaterialPoints, made: MaterialPoints, kept: NDArray[np.bool_]) -> MaterialPoints:
    """Return the points that are kept, together with the new points."""
    return with_faces(points).map(lambda rows: rows[kept]).joined(made)


def _of_tensors(function: np.ufunc, b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply a function, such as the logarithm, to the eigenvalues of symmetric tensors, and return the tensors."""
    value, axes = np.linalg.eigh(b)
    return (axes * function(value)[:, None]) @ axes.swapaxes(1, 2)


def _pulled(F: NDArray[np.float64], across: NDArray[np.float64] | None, b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse plastic tensors C_p^-1 from deformation gradients F and elastic Cauchy-Green tensors b."""
    inverse = np.linalg.inv(unstretched(F if across is None else in_space(F, across)))
    return inverse @ b @ inverse.swapaxes(1, 2)
