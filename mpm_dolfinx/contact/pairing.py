# SPDX-License-Identifier: MIT
"""Search of contact pairs: opposite positions on the surfaces of two groups."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import NEAR, TINY
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.faces import Surface, surface
from mpm_dolfinx.bodies.touching import BITS, MISFIT, local, weights
from mpm_dolfinx.conditions.acting import Loads, Place, Setting
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.history import Origin, pressure_name, shear_name
from mpm_dolfinx.contact.law import ContactLaw
from mpm_dolfinx.contact.pairs import FacePairs, between_cells
from mpm_dolfinx.contact.problem import ContactProblem, Touching
from mpm_dolfinx.contact.tool_placing import FACING
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all
from mpm_dolfinx.points.cutting import FACES
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.parts import parts_of_domains

REACH = 2.0
"""Largest gap, in cell sizes, that may close in a step, if both bodies move by one cell.  Source: definition."""
DEEP = 0.25
"""Largest penetration at which a pair is found, and smallest gap at which a pair may be dropped, in cell sizes."""
BESIDE = 0.6
"""Distance from another group, in cell sizes, below which Q1 displacements of domain corners get no correction.
Sensitivity (scene "contact" of tests/plateaus.py): half this value changes the result by 1.1e-03, and twice this value
by 6.3e-04. Finer cells change it by 1.1e-02.
"""
PLACES = 1 << 32
"""Upper bound of the number of quadrature points on a surface, on one process."""


class Facets(NamedTuple):
    """Quadrature points of all processes on the faces of one group."""

    x: NDArray[np.float64]  # position (n, d), m
    face: NDArray[np.int64]  # index of the face in its `Surface` (n,)
    cell: NDArray[np.int64]  # lexicographic index of the cell (n,)
    stiffness: NDArray[np.float64]  # moduli and density (n, 3), see `Touching._stiffness`
    corners: NDArray[np.float64]  # current corners of the face (n, 2^(d-1), d), m
    cut: NDArray[np.float64]  # corners of the face at the last grid reset (n, 2^(d-1), d), m
    outward: NDArray[np.float64]  # outward unit normal (n, d)


class Pairs(NamedTuple):
    """Pairs of a point on one surface and the opposite position on another surface."""

    row: NDArray[np.int64]  # index of the point among the quadrature points of this process (m,)
    facet: NDArray[np.int64]  # index in `Facets` of a point on the opposite face (m,)
    t: NDArray[np.float64]  # coordinates of the opposite position on its face, in [0, 1] (m, 2)
    gap: NDArray[np.float64]  # distance to the opposite position, along the normal at the point (m,), m


class Contacts(Touching):
    """The contacts between groups in a stage."""

    conditions, title = (Contact,), "contacts"

    def __init__(self, setting: Setting, contacts: Mapping[str, Contact]):
        super().__init__(setting, contacts)
        sides, self.contacts = setting.sides, tuple(contacts.values())
        self.conducts = any(contact.conducts for contact in self.contacts)
        self._rank = _ranks(setting)
        self._faces: list[tuple[int, Surface, Surface, int]] = []  # index of contact, own faces, opposite faces, sign
        for number, contact in enumerate(self.contacts):
            both = [sides.around(group) for group in contact.groups(len(sides.bodies))]
            for sign, (own, other) in ((1, both), (-1, both[::-1])):
                if not len(own) * len(other) or self._rank[own.id].min() < self._rank[other.id].max():
                    self._faces.append((number, own, other, sign))
        self._found: Latest[tuple[list[tuple[Facets, Pairs]], bool]] = Latest()
        self._cell_pairs: Latest[NDArray[np.int64]] = Latest()

    def placed(self, place: Place) -> Loads:
        """Return the contact loads between groups in a substep."""
        cut, points = place.cut, place.points
        of = cut.points
        found, distant = self._found(cut.key, lambda: (self._opposite_all(cut, of), self._distant(of)), self.grid.comm)
        cell_pairs = partial(self._cell_pairs, cut.key, partial(self._cells_within_reach, cut, found), self.grid.comm)

        def again(u: NDArray[np.float64]) -> tuple[ContactLaw, Origin]:
            moved, _ = cut.followed(u.reshape(-1, self.grid.dim), np.zeros(self.grid.num_local, dtype=bool))
            present = replace(points, corners=points.corners + moved)
            return self._law(place, self._opposite_all(cut, present), present, present, cell_pairs)

        first_law = self._law(place, found, of, points, cell_pairs)
        return ContactLoads(self, cut, *first_law, None if distant else again, cell_pairs)

    def _distant(self, points: MaterialPoints) -> bool:
        """Return whether all groups are so far apart that none can touch in a step, see `check_end`."""
        comm, copy = self.grid.comm, self.grid.copy(points.id)
        groups = [points.corners[copy == k * self.grid.cells] for k in range(self.grid.copies)]
        low = over_all(comm, np.array([of.min(axis=(0, 1), initial=np.inf) for of in groups]), MPI.MIN)
        high = over_all(comm, np.array([of.max(axis=(0, 1), initial=-np.inf) for of in groups]), MPI.MAX)
        gaps = (low[:, None] - high).max(axis=2)
        return bool((np.maximum(gaps, gaps.T)[np.triu_indices(len(low), 1)] > REACH * self.grid.most).all())

    def _law(
        self,
        place: Place,
        found: Sequence[tuple[Facets, Pairs]],
        seen: MaterialPoints,
        present: MaterialPoints,
        cell_pairs: Callable[[], NDArray[np.int64]],
    ) -> tuple[ContactLaw, Origin]:
        """Return the contact law and the material points of its pairs.  `found`: facets and pairs for points `seen`."""
        grid = self.grid
        d = self.grid.dim
        rows = []
        off = ""
        cut, points = place.cut, place.points
        own = self._stiffness(cut.points)
        for i, ((number, faces, others, sign), (facets, pairs)) in enumerate(zip(self._faces, found, strict=True)):
            patches = cut.contact_surface(faces)
            now = facets if present is seen else self._facets(cut, others, present)
            cell = self._under(facets, pairs.facet, _on(facets.cut[pairs.facet], pairs.t))
            if present is not points:
                near = np.isin(patches.cell[pairs.row] * grid.all_cells + cell, cell_pairs())
                slides = not near[pairs.gap < DEEP * self._sizes(patches.now(present)[pairs.row])].all()
                off += f"{line(self.contacts[number])}: bodies slide by more than a cell" * slides
                pairs, cell = Pairs(*(values[near] for values in pairs)), cell[near]
            row = pairs.row
            other = pairs.facet
            at = patches.at[pairs.row]
            y, where = (_on(corners[other], pairs.t) for corners in (now.corners, facets.cut))
            area = patches.area(present)[row]
            size = np.linalg.norm(area, axis=1)
            n = -patches.area(seen)[row]
            n /= np.linalg.norm(n, axis=1, keepdims=True)
            old = np.zeros((len(row), d))
            if self.contacts[number].frictional:
                old = _rotated(points.data[shear_name(self.names[number])][at], n)
            pressure = points.data[pressure_name(self.names[number])][at]
            stiffness = np.minimum(own[at], now.stiffness[other])[:, [0, 0, 2]] * [1.0, 1.0, place.rate]
            serial = (i + grid.comm.rank * len(self._faces)) * PLACES + row
            outward = patches.area(points)[row] if self.conducts else np.zeros((len(row), 0))
            fixed = np.full((len(row), 2), [number, sign])
            scalars = np.column_stack([fixed, serial, size, stiffness, pressure])
            offset = patches.now(present)[row] - y
            vectors = patches.x[row], where, n, offset, old, outward
            rows.append((patches.cell[row], cell, at, np.hstack([scalars, *vectors])))
        if off := first(grid.comm, off):
            raise NotConverged(off)
        cell, other, at, values = (np.concatenate(column) for column in zip(*rows, strict=True))
        exchange = Exchange(grid.comm, grid.owner(cell))
        cell, other, sent = (exchange.send(columns) for columns in (cell, other, values))
        number, sign, serial = sent[:, :3].T.astype(np.int64)
        x, y, n, offset, shear, outward = np.split(sent[:, 8:], d * np.arange(1, 6), axis=1)
        own = number, grid.locals[cell], *sent[:, 3:8].T, shear, x, sign
        pairs = FacePairs(grid, *own, other, y, n, offset, serial, outward)
        return ContactLaw(self.names, self.contacts, pairs), Origin(
            exchange, at, values[:, 0].astype(np.int64), values[:, 3]
        )

    def _opposite_all(self, cut: CutDomains, points: MaterialPoints) -> list[tuple[Facets, Pairs]]:
        """Return the facets and pairs of each contact."""
        return [self._opposite(cut, own, other, points) for _, own, other, _ in self._faces]

    def _cells_within_reach(self, cut: CutDomains, found: Sequence[tuple[Facets, Pairs]]) -> NDArray[np.int64]:
        """Return `first * grid.all_cells + second` for each pair of cells that may be in contact in the step."""
        grid = self.grid
        keys = []
        count = self.grid.all_cells
        for (_, faces, *_), (facets, pairs) in zip(self._faces, found, strict=True):
            patches = cut.contact_surface(faces)
            where = _on(facets.cut[pairs.facet], pairs.t)
            keys.append(patches.cell[pairs.row] * count + self._under(facets, pairs.facet, where))
            cells = np.unique(patches.cell), np.unique(facets.cell)
            index = [np.stack(np.unravel_index(c % grid.cells, tuple(grid.shape)), axis=1) for c in cells]
            near = cKDTree(index[0]).query_ball_tree(cKDTree(index[1]), 1.5, p=np.inf) if len(cells[0]) else []
            times = [len(of) for of in near]
            keys.append(
                np.repeat(cells[0], times) * count + cells[1][np.concatenate([np.zeros(0, int), *near]).astype(int)]
            )
        return np.unique(np.concatenate(keys))

    def _facets(self, cut: CutDomains, faces: Surface, points: MaterialPoints) -> Facets:
        """Return the quadrature points on the faces, of all processes."""
        patches, d = cut.contact_surface(faces), self.grid.dim
        index = FACES[d][faces.face[patches.face]]
        now, then = (np.take_along_axis(p.corners[patches.at], index[:, :, None], axis=1) for p in (points, cut.points))
        stiffness = self._stiffness(cut.points)[patches.at]
        area = patches.area(points)
        n = len(now)
        k = 2 ** (d - 1) * d
        outward = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), TINY)
        whole = np.column_stack([patches.face, patches.cell])
        rows = np.column_stack([patches.now(points), stiffness, now.reshape(n, k), then.reshape(n, k), outward])
        whole, rows = (np.concatenate(self.grid.comm.allgather(part)) for part in (whole, rows))
        x, stiffness, now, then, outward = np.split(rows, np.cumsum([d, 3, k, k]), axis=1)
        shape = (len(rows), 2 ** (d - 1), d)
        return Facets(x, *whole.T, stiffness, now.reshape(shape), then.reshape(shape), outward)

    def _opposite(
        self, cut: CutDomains, faces: Surface, others: Surface, points: MaterialPoints
    ) -> tuple[Facets, Pairs]:
        """Return the facets of `others`, and the pairs: a point on `faces`, and the opposite position on `others`."""
        patches = cut.contact_surface(faces)
        facets = self._facets(cut, others, points)
        d = self.grid.dim
        x, area = patches.now(points), patches.area(points)
        n = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), TINY)
        count = min(2 * d * 2 ** (d - 1), len(facets.x))  # points on a face and its neighbours may be the nearest
        if not count:  # no body of the other group is active
            none = np.zeros(0, dtype=np.int64)
            return facets, Pairs(none, none, np.zeros((0, 2)), np.zeros(0))
        largest = REACH * (self.grid.least if self.grid.even else self.grid.most) + self.grid.most
        _, near = cKDTree(facets.x).query(x, range(1, count + 1), distance_upper_bound=largest)
        row, column = np.nonzero(near < len(facets.x))
        other = near[row, column]
        facing = np.einsum("md,md->m", n[row], facets.outward[other]) < -FACING
        facing &= self._rank[faces.id[patches.face[row]]] < self._rank[others.id[facets.face[other]]]
        row, other = row[facing], other[facing]
        t, gap = _along(facets.corners[other], x[row], n[row])
        h = self._sizes(x[row])
        valid = ((t >= -NEAR) & (t <= 1 + NEAR)).all(axis=1) & (gap <= REACH * h) & (gap >= -DEEP * h)
        row, other, t, gap = (values[valid] for values in (row, other, t, gap))
        order = np.lexsort((np.abs(gap), row))
        order = order[np.append(True, np.diff(row[order]) > 0)[: len(order)]]
        return facets, Pairs(row[order], other[order], t[order], gap[order])

    def _under(self, facets: Facets, chosen: NDArray[np.int64], x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the cell on the inner side of the surface at each position x, which lies on the facet `chosen`."""
        grid, inside = self.grid, x - NEAR * self.grid.least * facets.outward[chosen]
        number = grid.number(grid.index_from_base(inside)) + facets.cell[chosen] // grid.cells * grid.cells
        keys = np.unique(facets.face * grid.all_cells + facets.cell)
        return np.where(np.isin(facets.face[chosen] * grid.all_cells + number, keys), number, facets.cell[chosen])

    def near(self, cut: CutDomains, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_]:
        """For each corner (n, 2^d), return whether it is within `BESIDE` cells of another group after the step."""
        present = replace(points, corners=corners)
        out, far = np.zeros(corners.shape[:2], dtype=bool), BESIDE * self.grid.most
        for _, *pair, _ in self._faces:
            for own, other in (pair, pair[::-1]) if all(map(len, pair)) else ():
                x = self._facets(cut, other, present).x
                low, high = x.min(axis=0, initial=np.inf) - far, x.max(axis=0, initial=-np.inf) + far
                own_rows = self.grid.copy(points.id) == self.grid.copy(own.id[:1])
                at = np.nonzero(own_rows[:, None] & ((low <= corners) & (corners <= high)).all(axis=2))
                distance, _ = cKDTree(x).query(corners[at], distance_upper_bound=far)
                out[at] |= distance < BESIDE * self.grid.sizes_at(corners[at]).max(axis=-1)
        return out

    def _sizes(self, x: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """Return the shortest edge, in m, of the cell at each position x."""
        return self.grid.sizes_at(x).min(axis=-1)

    def check_end(self, cut: CutDomains, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise NotConverged if groups overlap after a step, or may have passed through each other in the step."""
        h, comm = self._sizes(before.corners), self.grid.comm
        moved = points.corners - before.corners
        low, high = (
            over_all(comm, ends(moved, axis=(0, 1), initial=start), op)
            for ends, start, op in ((np.min, np.inf, MPI.MIN), (np.max, -np.inf, MPI.MAX))
        )
        cells = [(np.linalg.norm(moved - by, axis=2) / h).max(initial=0.0) for by in (0.0, (low + high) / 2)]
        if 2 * over_all(comm, np.array(cells), MPI.MAX).min() > REACH:
            raise NotConverged(f"contacts: bodies move by more than {REACH / 2:g} cells in a step")
        if message := self._too_deep(cut, points):
            raise NotConverged(message)

    def check_start(self, place: Place) -> None:
        """Raise an error if groups overlap at the start of the stage."""
        if message := self._too_deep(place.cut, place.points):
            raise ValueError(f"{message}, at the start t = {place.start:g} s, must be apart or touch")

    def _too_deep(self, cut: CutDomains, points: MaterialPoints) -> str:
        """Return a message about an overlap of groups, or "" without an overlap."""
        h, comm = self.grid.least, self.grid.comm
        for number, faces, others, _ in self._faces:
            _, pairs = self._opposite(cut, faces, others, points)
            deepest = over_all(comm, float(pairs.gap.min(initial=np.inf)), MPI.MIN)
            if deepest < -MISFIT * h:
                row = pairs.row[pairs.gap == deepest][:1]
                found = cut.contact_surface(faces).now(points)[row] + cut.grid.base
                where = first(comm, "".join(map(str, found)))
                return f"{line(self.contacts[number])}: bodies overlap by {-deepest / h:.3g} cells at {where}"
        return ""


class ContactLoads(ContactProblem):
    """Contact loads between groups, with pairs that follow the motion of the bodies."""

    def __init__(self, contacts: Contacts, cut: CutDomains, law: ContactLaw, origin: Origin, again, cell_pairs):
        super().__init__(law, origin, again=again, cell_pairs=cell_pairs)
        self._contacts, self._cut = contacts, cut
        self.conducts = contacts.conducts

    def joins(self, unknowns: Unknowns) -> PETSc.Mat:
        """See `Loads`."""
        pairs = self.within_reach()
        return between_cells(unknowns, self.grid, pairs, np.zeros((2, len(pairs))))

    def within_reach(self) -> NDArray[np.int64]:
        """Return the pairs of cells between which contact is possible in the step."""
        return np.stack(np.divmod(self._cell_pairs(), self.grid.all_cells), axis=1)

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners are near other groups."""
        return self._contacts.near(self._cut, points, corners)

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise an error if groups overlap after the step."""
        self._contacts.check_end(self._cut, points, before)


def _ranks(setting: Setting) -> NDArray[np.int64]:
    """Return the index of the connected part of each point.  Parts are sorted by surface area and extent."""
    grid, bodies = setting.grid, setting.sides.bodies
    corners = np.concatenate([body.corners() for body in bodies])
    copy = np.asarray(grid.copy(np.arange(len(corners))))
    part = parts_of_domains(grid, corners + NEAR * (corners.mean(axis=1, keepdims=True) - corners), copy)
    start = np.cumsum([0, *map(len, bodies)])
    area = np.zeros(part.max() + 1)
    for group in np.unique(copy):
        faces = surface(bodies, None, None, [copy[i] == group for i in start[:-1]])
        area += np.bincount(part[faces.id], faces.area0, len(area))
    extents = [[end(corners[part == k], axis=(0, 1)) for end in (np.min, np.max)] for k in range(len(area))]
    keys = [(float(f"{size:.9g}"), *low, *high) for size, (low, high) in zip(area, extents, strict=True)]
    return np.argsort(sorted(range(len(keys)), key=keys.__getitem__))[part]


def _rotated(shear: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate shear tractions (m, d) into the planes with unit normals n (m, d)."""
    flat = shear - np.einsum("md,md->m", shear, n)[:, None] * n
    size = np.maximum(np.linalg.norm(flat, axis=1), TINY)
    return flat * (np.linalg.norm(shear, axis=1) / size)[:, None]


def _on(corners: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions at face coordinates t, in [0, 1], on faces with given corners."""
    if corners.shape[2] == 2:
        return corners[:, 0] + t[:, :1] * (corners[:, 1] - corners[:, 0])
    return np.einsum("mk,mkd->md", weights(t), corners)


def _along(corners: NDArray, x: NDArray, n: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points where lines from x along n cross faces: their face coordinates, and distances from x in m."""
    if corners.shape[2] == 2:  # as in `Faces`, 2D faces have the width 1 along a third axis
        corners = np.dstack([corners[:, BITS[:, 0]], np.broadcast_to(BITS[:, 1], (len(x), 4))])
        x, n = np.column_stack([x, np.full(len(x), 0.5)]), np.column_stack([n, np.zeros(len(x))])
    off = np.einsum("mkd,md->mk", corners - x[:, None], n)
    t = local(corners - off[:, :, None] * n[:, None], x[:, None], n)[0][:, 0]
    return t, np.einsum("mk,mk->m", weights(t), off)
