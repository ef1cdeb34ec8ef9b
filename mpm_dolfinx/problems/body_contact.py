# SPDX-License-Identifier: MIT
"""Contact of groups of bodies: no penetration, Coulomb friction, adhesion.

The points of integration on the surface of one group, the one with the smaller surface, look along their normals for
the faces of the other.  Places and normals of these pairs are found when the grid is reset, gaps at the start of each
step.  In a step the gap is linear in the displacements: with w = B u, how both sides of the pairs move apart,

    g = g_n + n . w,      p = <lambda - k g>,      forces B^T f,

so the forces on both bodies are equal and opposite to rounding, whatever the iterations leave.  Pressure and friction
are those of `tool_contact`: lambda by cells, augmented; shear tractions by the mean slip of a cell, with active sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.constitutive.fields import SceneMaterials
from mpm_dolfinx.errors import NotConverged
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all
from mpm_dolfinx.points.contact import BITS, local, weights
from mpm_dolfinx.points.cut_domains import DEPTH as UNDER
from mpm_dolfinx.points.cut_domains import CutDomains
from mpm_dolfinx.points.cutting import FACES
from mpm_dolfinx.points.faces import Surface, surface
from mpm_dolfinx.points.grid import Grid, sum_by
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.problems.conditions import HOLD, holding, resistance
from mpm_dolfinx.problems.contacts import Contact
from mpm_dolfinx.problems.sides import Sides
from mpm_dolfinx.problems.tool_contact import (
    BEGINS,
    CLOSE,
    DEPTH,
    FACING,
    LEAST,
    RAMP,
    ROUNDS,
    SLIVER,
    STIFF,
    TOUCH,
)
from mpm_dolfinx.validation import line

REACH = 2.0
"""Cells: what is farther apart cannot touch within a step; steps in which bodies move farther are refused."""
CANDIDATES = {2: 8, 3: 24}
"""Nearest points of the other surface whose faces are tried."""
BESIDE = 0.6
"""Cells from points on the other surface: corners that are nearer go with it."""
SLOW, STIFFER = 0.3, 10.0
"""Where a round leaves more than this share of the penetration, k is made so many times larger."""
EDGE = 1e-6
"""Of a face: what passes beside it by less meets it."""


class Facets(NamedTuple):
    """Points on the faces of the other group, those of all processes; arrays over n of them.

    x : (n, d), m; face : (n,) row of the `Surface`; cell : (n,) lexicographic; resistance, holding : (n,), Pa;
    corners, cut : (n, 2^(d-1), d), m, of the face at present and when the grid was reset; outward : (n, d) unit normal.
    """

    x: NDArray[np.float64]
    face: NDArray[np.int64]
    cell: NDArray[np.int64]
    resistance: NDArray[np.float64]
    holding: NDArray[np.float64]
    corners: NDArray[np.float64]
    cut: NDArray[np.float64]
    outward: NDArray[np.float64]


class Pairs(NamedTuple):
    """Points of one surface that face the other; arrays over m pairs.

    row : (m,) point among the patches of this process; facet : (m,) one of the `Facets` on the face that it meets;
    t : (m, 2) where on the face; gap : (m,), m, along the point's normal.
    """

    row: NDArray[np.int64]
    facet: NDArray[np.int64]
    t: NDArray[np.float64]
    gap: NDArray[np.float64]


class Rows(NamedTuple):
    """Pairs, at the owners of the points' cells; arrays over m rows.

    number, cell : (m,) contact, local cell; other : (m,) lexicographic cell of the other side; x, y : (m, d), m, where
    the grid sees both sides; area : (m,), m^(d-1); resistance, holding : (m,), Pa; pressure : (m,) before the step, Pa;
    n : (m, d) normal out of the other side; apart, shear : (m, d) from the other side to the point, m, and traction on
    the point, Pa, at the start of the step.
    """

    number: NDArray[np.int64]
    cell: NDArray[np.int32]
    other: NDArray[np.int64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    area: NDArray[np.float64]
    resistance: NDArray[np.float64]
    holding: NDArray[np.float64]
    pressure: NDArray[np.float64]
    n: NDArray[np.float64]
    apart: NDArray[np.float64]
    shear: NDArray[np.float64]


class Touch(NamedTuple):
    """The contact at some displacement: of m rows, and of k conditions, one a contact and cell.

    force : (m, d) on the points, N; push : (m,) pressure, Pa; stiff : (m,) minus its derivative by the gap, Pa/m;
    pressure : (k,) its mean, Pa; and see `tool_contact.Touch`: sticks (k,), trial, shear (k, d), most (k,), grip
    (k, d, d), rise (k, d).
    """

    force: NDArray[np.float64]
    push: NDArray[np.float64]
    stiff: NDArray[np.float64]
    pressure: NDArray[np.float64]
    sticks: NDArray[np.bool_]
    trial: NDArray[np.float64]
    shear: NDArray[np.float64]
    most: NDArray[np.float64]
    grip: NDArray[np.float64]
    rise: NDArray[np.float64]


class BodyContact:
    """The contact of groups in a substep.

    Parameters
    ----------
    grid
        Background grid.
    contacts
        The contacts, and with which sign each row counts for the bodies of its `one`.
    rows
        The pairs.
    back
        The way of the rows to the owners of their cells; and of each row before it: index of its material point on
        this process, contact, and area, m^(d-1).
    """

    def __init__(
        self,
        grid: Grid,
        contacts: Sequence[Contact],
        signs: NDArray[np.float64],
        rows: Rows,
        back: tuple[Exchange, NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]],
    ):
        self.grid, self._contacts, self._signs, self._rows, self._back = grid, contacts, signs, rows, back
        key, self._at = np.unique(rows.number * grid.num_local + rows.cell, return_inverse=True)
        self._whole = sum_by(self._at, rows.area, len(key))
        strength = np.array([(contact.friction, contact.adhesion) for contact in contacts], dtype=float)
        self._strength = strength[key // grid.num_local]
        h = grid.h.min()
        self._stiffness, self._hold = STIFF / h * rows.resistance, HOLD / h * self._mean(rows.holding)
        self.grips = any(contact.grips for contact in contacts)
        self._along = np.zeros((len(key), grid.dim))  # direction of the shear of what slips, else zero
        self._turned = np.zeros(len(key), dtype=bool)  # what has slipped, and stuck again
        self._lambda, self._rounds = self._mean(rows.pressure), np.zeros(1, dtype=np.int64)
        self._off = np.full(1, np.inf)  # cells: what has penetrated in the round before
        self._operator: Latest[tuple[PETSc.Mat, PETSc.Vec]] = Latest()
        self._touch: Latest[Touch] = Latest()

    def _mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the means (k, ...) over the area of values (m, ...) in the conditions."""
        size, columns = len(self._whole), values.reshape(len(values), int(np.prod(values.shape[1:], dtype=int))).T
        out = np.stack([sum_by(self._at, self._rows.area * column, size) / self._whole for column in columns], axis=1)
        return out.reshape(size, *values.shape[1:])

    def operator(self, unknowns: Unknowns) -> tuple[PETSc.Mat, PETSc.Vec]:
        """Return B, which gives how far pairs move apart (m d,), m, from the unknowns, and room for its product."""

        def make() -> tuple[PETSc.Mat, PETSc.Vec]:
            grid, rows, d = self.grid, self._rows, self.grid.dim
            numbers = unknowns.map.indices.reshape(-1, d)
            travel = Exchange(grid.comm, grid.owner(rows.other))
            there = travel.back(numbers[grid.cell_nodes[grid.local(travel.send(rows.other))]])
            column = np.concatenate([numbers[grid.cell_nodes[rows.cell]], there], axis=1)
            index = np.stack(np.unravel_index(rows.other % grid.cells, tuple(grid.shape)), axis=1)
            off = (rows.y - grid.lower) / grid.h - index - 0.5
            other = np.prod(0.5 + off[:, None] * grid.signs, axis=2)
            value = np.concatenate([grid.shape_values(rows.cell, rows.x), -other], axis=1)
            value = np.broadcast_to(value[:, None], (len(value), d, value.shape[1]))
            column, m = column.swapaxes(1, 2), len(rows.cell) * d
            row = np.broadcast_to(np.arange(m).reshape(-1, d, 1), column.shape)
            kept = column >= 0
            shape, own = (m, max(1, unknowns.global_size)), (row[kept], column[kept])
            csr = scipy.sparse.csr_matrix((value[kept], own), shape=shape)
            B = _matrix(csr, unknowns.size, grid.comm)
            return B, B.createVecLeft()

        return self._operator(unknowns, make, self.grid.comm)

    def at(self, unknowns: Unknowns, u: NDArray[np.float64]) -> Touch:
        """Return the contact at displacements u, a local array, m."""
        now = u[unknowns.owned]
        key = now, self._lambda.copy(), self._stiffness.copy(), self._along.copy(), unknowns

        def make() -> Touch:
            B, w = self.operator(unknowns)
            B.mult(unknowns.gather_owned(now), w)
            return self._at_w(w.array_r.reshape(-1, self.grid.dim))

        return self._touch(key, make, self.grid.comm)

    def _at_w(self, w: NDArray[np.float64]) -> Touch:
        rows, at, area = self._rows, self._at, self._rows.area
        gap = np.einsum("md,md->m", rows.n, rows.apart + w)
        push = np.maximum(0.0, self._lambda[at] - self._stiffness * gap)
        touches = (push > 0) | (gap <= TOUCH * self._reach)
        pressure, on = self._mean(push), np.zeros(len(self._whole), dtype=bool)
        on[at[touches]] = True
        normal = self._mean(rows.n)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), LEAST)
        friction = _, _, shear, *_ = self._friction(normal, self._mean(w), pressure, on)
        force = area[:, None] * (push[:, None] * rows.n + shear[at])
        return Touch(force, push, self._stiffness * touches, pressure, *friction)

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

    def push(self, unknowns: Unknowns, u: NDArray[np.float64], residual: PETSc.Vec) -> None:
        """Take the forces of the contact at u off a residual, N."""
        force = self.at(unknowns, u).force
        B, w = self.operator(unknowns)
        w.array_w[:] = -force.ravel()
        B.multTransposeAdd(w, residual, residual)

    def tangent(self, unknowns: Unknowns, u: NDArray[np.float64]) -> PETSc.Mat:
        """Return minus the derivative of the forces at u."""
        touch, rows, d, comm = self.at(unknowns, u), self._rows, self.grid.dim, self.grid.comm
        m = len(rows.cell)
        own = (rows.area * touch.stiff)[:, None, None] * rows.n[:, :, None] * rows.n[:, None, :]
        D = scipy.sparse.bsr_matrix((own, np.arange(m), np.arange(m + 1)), shape=(m * d, m * d)).tocsr()
        if self.grips:  # means over the conditions, of displacements and of pressures
            share = rows.area / self._whole[self._at]
            mean = scipy.sparse.csr_matrix((share, (self._at, np.arange(m))), shape=(len(self._whole), m))
            wide = scipy.sparse.kron(mean, scipy.sparse.identity(d), format="csr")
            k, whole = len(self._whole), self._whole[:, None, None]
            blocks = (np.arange(k), np.arange(k + 1))
            grip = scipy.sparse.bsr_matrix((whole * touch.grip, *blocks), shape=(k * d, k * d))
            rise = scipy.sparse.bsr_matrix((whole * touch.rise[:, :, None], *blocks), shape=(k * d, k))
            pressed = (touch.stiff[:, None] * rows.n)[:, None]
            slope = scipy.sparse.bsr_matrix((pressed, np.arange(m), np.arange(m + 1)), shape=(m, m * d))
            D = D + wide.T @ (grip @ wide + rise @ (mean @ slope))
        B, _ = self.operator(unknowns)
        D = _matrix(scipy.sparse.csr_matrix(D), m * d, comm, own=True)
        return D.PtAP(B)

    def settle(self, unknowns: Unknowns, u: NDArray[np.float64], sticks: bool) -> bool:
        """Choose what slips at u, and if asked for what sticks again; return whether that is another choice."""
        if not self.grips:
            return False
        touch, before = self.at(unknowns, u), self._slips
        size = np.linalg.norm(touch.trial, axis=1)
        goes_on = (size > (1 - CLOSE) * touch.most) & (np.einsum("kd,kd->k", touch.trial, self._along) > 0)
        exceeds = (size > (1 + CLOSE) * touch.most) & (sticks | ~self._turned)
        slips = np.where(before, goes_on if sticks else True, exceeds)
        self._turned[:] |= before & ~slips
        new = (slips & (goes_on | ~before))[:, None]
        self._along[:] = np.where(new, touch.trial / np.maximum(size, LEAST)[:, None], slips[:, None] * self._along)
        return over_all(self.grid.comm, int((slips != before).sum())) > 0

    def augment(self, unknowns: Unknowns, u: NDArray[np.float64]) -> bool:
        """Take the present pressures for lambda where means penetrate too deep at u; return whether they do.

        Raises
        ------
        NotConverged
            They still do: something holds both bodies where they are.
        """
        touch, h = self.at(unknowns, u), self.grid.h.min()
        # what is a sliver of a cell has too little area to be pushed out by itself, and goes with its neighbours
        whole = np.minimum(1.0, self._whole / (SLIVER * self.grid.cell_volume / self.grid.h.max()))
        off = whole * (touch.pressure - self._lambda) / self._mean(self._stiffness) / h
        most = over_all(self.grid.comm, float(np.abs(off).max(initial=0.0)), MPI.MAX)
        if most <= DEPTH:
            return False
        self._rounds[0] += 1
        if self._rounds[0] > ROUNDS:
            rows = np.flatnonzero(np.isin(self._at, np.flatnonzero(np.abs(off) == most)))[:1]
            x = [f"{line(self._contacts[self._rows.number[row]])}: at {self._rows.x[row]}" for row in rows]
            message = f"{''.join(x)} penetrates by {most:.2g} cells: does something hold both bodies there?"
            raise NotConverged(first(self.grid.comm, message if x else ""))
        self._lambda[:] = touch.pressure
        if most > SLOW * self._off[0]:  # fluid, or what hardly changes its volume, resists more than k
            self._stiffness[:] *= STIFFER
        self._off[0] = most
        return True

    @property
    def rounding(self) -> float:
        """What rounding of coordinates makes of the forces, N, of this process."""
        return 1e-15 * float((self._stiffness * self._rows.area).max(initial=0.0)) * self._reach

    @property
    def _reach(self) -> float:
        return float(np.abs(np.concatenate([self.grid.lower, self.grid.upper])).max())

    def touching(self) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return cells (m,), lexicographic ones of the other side, places and directions (m, d) of what touches."""
        rows, d = self._rows, self.grid.dim
        gap = np.einsum("md,md->m", rows.n, rows.apart)
        on = np.flatnonzero((rows.pressure > 0) | (gap <= TOUCH * self._reach))
        rough = on[self._strength.any(axis=1)[self._at[on]]]
        all_rows = np.concatenate([on, np.repeat(rough, d)])
        along = np.concatenate([rows.n[on], np.tile(np.eye(d), (len(rough), 1))])
        return rows.cell[all_rows], rows.other[all_rows], rows.x[all_rows], along

    def forces(self, unknowns: Unknowns, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces and moments (contacts, d + 1), in 3D (contacts, 6), on the bodies of `one`, N and N m.

        Moments count about the origin, with the places of the start of the step.
        """
        rows, d, count = self._rows, self.grid.dim, len(self._contacts)
        f, arm = self._signs[rows.number, None] * self.at(unknowns, u).force, rows.x
        moment = np.cross(arm, f) if d == 3 else (arm[:, 0] * f[:, 1] - arm[:, 1] * f[:, 0])[:, None]
        columns = np.concatenate([f, moment], axis=1).T
        return over_all(self.grid.comm, np.stack([sum_by(rows.number, c, count) for c in columns], axis=1))

    def gripped(self, unknowns: Unknowns, u: NDArray[np.float64], points: MaterialPoints) -> MaterialPoints:
        """Return the points with the pressures and shear tractions that contacts have on them at u."""
        touch, (travel, at, of, area) = self.at(unknowns, u), self._back
        off = (self._rows.shear - self._mean(self._rows.shear)[self._at]) * touch.sticks[self._at, None]
        shear, push = travel.back(touch.shear[self._at] + off), travel.back(touch.push)
        data, n = dict(points.data), len(points)
        for number, contact in enumerate(self._contacts):
            rows = np.flatnonzero(of == number)
            whole = np.maximum(sum_by(at[rows], area[rows], n), LEAST)
            means = [sum_by(at[rows], area[rows] * column, n) / whole for column in (push[rows], *shear[rows].T)]
            data[pressure_name(number)] = means[0]
            if contact.grips:
                data[shear_name(number)] = np.stack(means[1:], axis=1)
        return replace(points, data=data)


def pressure_name(number: int) -> str:
    """Return the name under which points have the pressure (n,), Pa, of a contact on their faces."""
    return f"contact_{number}_pressure"


def shear_name(number: int) -> str:
    """Return the name under which points keep the shear traction (n, d), Pa, of a contact."""
    return f"contact_{number}_shear"


def _matrix(rows: scipy.sparse.csr_matrix, columns: int, comm: MPI.Intracomm, own: bool = False) -> PETSc.Mat:
    """Return a matrix of rows of this process, with so many columns of it; own: that have no entries in others."""
    start = int(comm.exscan(columns) or 0) if own and comm.size > 1 else 0
    csr = [values.astype(PETSc.IntType) for values in (rows.indptr, rows.indices + start)]
    A = PETSc.Mat().createAIJ(((rows.shape[0], None), (columns, None)), csr=(*csr, rows.data), comm=comm)
    A.assemble()
    return A


class Contacts:
    """The contacts of a stage.

    Parameters
    ----------
    sides
        The sides of the bodies.
    materials
        Those of the scene.
    contacts
        The contacts.
    """

    def __init__(self, sides: Sides, materials: SceneMaterials, contacts: Sequence[Contact]):
        self.grid, self._materials, self.contacts = sides.grid, materials, tuple(contacts)
        self._faces: list[tuple[Surface, Surface]] = []
        signs = []
        for contact in self.contacts:
            both = contact.groups(len(sides.bodies))
            there = [[i in group and bool(here) for i, here in enumerate(sides.present)] for group in both]
            faces = [surface(sides.bodies, None, None, some) for some in there]
            swap = (faces[1].area0.sum(), faces[1].id[0]) < (faces[0].area0.sum(), faces[0].id[0])
            self._faces.append((faces[1], faces[0]) if swap else (faces[0], faces[1]))
            signs.append(-1.0 if swap else 1.0)
        self._signs = np.array(signs)
        self._found: Latest[list[tuple[Facets, Pairs]]] = Latest()

    @property
    def symmetric(self) -> bool:
        """Whether the tangent is symmetric."""
        return not any(contact.grips for contact in self.contacts)

    def grip(self, points: MaterialPoints) -> MaterialPoints:
        """Return points with tractions of the contacts: zero."""
        n, data = len(points), dict(points.data)
        for number, contact in enumerate(self.contacts):
            data[pressure_name(number)] = np.zeros(n)
            if contact.grips:
                data[shear_name(number)] = np.zeros((n, self.grid.dim))
        return replace(points, data=data) if self.contacts else points

    def placed(self, cut: CutDomains, points: MaterialPoints) -> BodyContact | None:
        """Return the contact in a step, with the points where they are at its start."""
        if not self.contacts:
            return None
        grid, d, rows = self.grid, self.grid.dim, []
        found = self._found(cut.key, lambda: [self._met(cut, *faces, cut.points) for faces in self._faces], grid.comm)
        own = [self._materials.table(cut.points, of) for of in (resistance, holding)]
        for number, ((faces, others), (facets, pairs)) in enumerate(zip(self._faces, found, strict=True)):
            patches = cut.surface(faces)
            now = facets if points is cut.points else self._facets(cut, others, points)
            row, other, at = pairs.row, pairs.facet, patches.at[pairs.row]
            y, where = (_on(corners[other], pairs.t) for corners in (now.corners, facets.cut))
            area = patches.area(points)[row]
            size = np.linalg.norm(area, axis=1)
            n = -patches.area(cut.points)[row]  # as the pairs were found
            n /= np.linalg.norm(n, axis=1, keepdims=True)
            old = np.zeros((len(row), d))
            if self.contacts[number].grips:
                old = _turned(points.data[shear_name(number)][at], n)
            pressure = points.data[pressure_name(number)][at]
            moduli = [np.minimum(a[at], b[other]) for a, b in zip(own, (now.resistance, now.holding), strict=True)]
            scalars = np.stack([np.full(len(row), number), size, *moduli, pressure], axis=1)
            apart = patches.now(points)[row] - y
            cell = self._under(facets, other, where)
            rows.append((patches.cell[row], cell, at, np.hstack([scalars, patches.x[row], where, n, apart, old])))
        cell, other, at, values = (np.concatenate(column) for column in zip(*rows, strict=True))
        travel = Exchange(grid.comm, grid.owner(cell))
        cell, other, sent = (travel.send(columns) for columns in (cell, other, values))
        number, *scalars = sent[:, :5].T
        x, y, *vectors = np.split(sent[:, 5:], 5, axis=1)
        placed = Rows(number.astype(np.int64), grid.local(cell), other, x, y, *scalars, *vectors)
        back = (travel, at, values[:, 0].astype(np.int64), values[:, 1])
        return BodyContact(grid, self.contacts, self._signs, placed, back)

    def _facets(self, cut: CutDomains, faces: Surface, points: MaterialPoints) -> Facets:
        """Return points on faces of all processes, with the points where they are."""
        patches, d = cut.surface(faces), self.grid.dim
        index = FACES[d][faces.face[patches.here]]
        now, then = (
            np.take_along_axis(of.corners[patches.at], index[:, :, None], axis=1) for of in (points, cut.points)
        )
        moduli = [self._materials.table(cut.points, of)[patches.at] for of in (resistance, holding)]
        area, n, k = patches.area(points), len(now), 2 ** (d - 1) * d
        outward = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), LEAST)
        whole = np.column_stack([patches.here, patches.cell])
        rows = np.column_stack([patches.now(points), *moduli, now.reshape(n, k), then.reshape(n, k), outward])
        whole, rows = (np.concatenate(self.grid.comm.allgather(part)) for part in (whole, rows))
        x, moduli, now, then, outward = np.split(rows, np.cumsum([d, 2, k, k]), axis=1)
        shape = (len(rows), 2 ** (d - 1), d)
        return Facets(x, *whole.T, *moduli.T, now.reshape(shape), then.reshape(shape), outward)

    def _met(self, cut: CutDomains, faces: Surface, others: Surface, points: MaterialPoints) -> tuple[Facets, Pairs]:
        """Return the points on the faces of the other group, and which of these the points on the faces meet."""
        patches, facets, d = cut.surface(faces), self._facets(cut, others, points), self.grid.dim
        x, area = patches.now(points), patches.area(points)
        n = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), LEAST)
        count = min(CANDIDATES[d], len(facets.x))
        reach = REACH * self.grid.h.min() + self.grid.h.max()
        _, near = cKDTree(facets.x).query(x, range(1, count + 1), distance_upper_bound=reach)
        row, column = np.nonzero(near < len(facets.x))
        other = near[row, column]
        facing = np.einsum("md,md->m", n[row], facets.outward[other]) < -FACING
        row, other = row[facing], other[facing]
        t, gap = _along(facets.corners[other], x[row], n[row])
        met = ((t >= -EDGE) & (t <= 1 + EDGE)).all(axis=1) & (np.abs(gap) <= REACH * self.grid.h.min())
        row, other, t, gap = row[met], other[met], t[met], gap[met]
        order = np.lexsort((np.abs(gap), row))
        order = order[np.append(True, np.diff(row[order]) > 0)[: len(order)]]
        return facets, Pairs(row[order], other[order], t[order], gap[order])

    def _under(self, facets: Facets, chosen: NDArray[np.int64], x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the cells (m,) just under places x (m, d) on faces that hold a part of these, else of their facets."""
        grid, inside = self.grid, x - UNDER * self.grid.h.min() * facets.outward[chosen]
        number = grid.number(grid.index(inside)) + facets.cell[chosen] // grid.cells * grid.cells
        keys = np.unique(facets.face * len(grid.owners) + facets.cell)
        return np.where(np.isin(facets.face[chosen] * len(grid.owners) + number, keys), number, facets.cell[chosen])

    def near(self, cut: CutDomains, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which corners (n, 2^d, d) of domains are beside another group: these follow the Q1 field alone.

        points: as they were at the start of the step.
        """
        out, reach = np.zeros(corners.shape[:2], dtype=bool), BESIDE * self.grid.h.max()
        for pair in self._faces:
            for own, other in (pair, pair[::-1]):
                x = self._facets(cut, other, points).x
                mine = np.flatnonzero(self.grid.copy(points.id) == self.grid.copy(own.id[:1]))
                distance, _ = cKDTree(x).query(corners[mine], distance_upper_bound=reach)
                out[mine] |= distance < reach
        return out

    def check_end(self, cut: CutDomains, points: MaterialPoints, before: MaterialPoints) -> None:
        """Refuse a step in which groups may have passed into each other unseen, or have.

        Raises
        ------
        NotConverged
            Saying where; a shorter step may do.
        """
        h, comm = self.grid.h.min(), self.grid.comm
        moved = np.linalg.norm(points.corners - before.corners, axis=2).max(initial=0.0) if self.contacts else 0.0
        if self.contacts and 2 * over_all(comm, float(moved), MPI.MAX) > REACH * h:
            raise NotConverged(f"contacts: bodies move by more than {REACH / 2:g} cells in a step")
        for contact, (faces, others) in zip(self.contacts, self._faces, strict=True):
            _, pairs = self._met(cut, faces, others, points)
            deepest = over_all(comm, float(pairs.gap.min(initial=np.inf)), MPI.MIN)
            if deepest < -BEGINS * h:
                row = pairs.row[pairs.gap == deepest][:1]
                where = first(comm, "".join(f"{x}" for x in cut.surface(faces).now(points)[row]))
                raise NotConverged(f"{line(contact)}: bodies are {-deepest / h:.3g} cells in each other at {where}")


def _turned(shear: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return tractions (m, d) turned by the least angle into the planes with normals n (m, d)."""
    flat = shear - np.einsum("md,md->m", shear, n)[:, None] * n
    size = np.maximum(np.linalg.norm(flat, axis=1), LEAST)
    return flat * (np.linalg.norm(shear, axis=1) / size)[:, None]


def _on(corners: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the places (m, d) at coordinates t (m, 2), from 0 to 1, on faces (m, 2^(d-1), d)."""
    if corners.shape[2] == 2:
        return corners[:, 0] + t[:, :1] * (corners[:, 1] - corners[:, 0])
    return np.einsum("mk,mkd->md", weights(t), corners)


def _along(corners: NDArray, x: NDArray, n: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where lines from x (m, d) along n meet faces (m, 2^(d-1), d), in their coordinates (m, 2), and how far."""
    if corners.shape[2] == 2:  # as in `Faces`, a unit of length wide along a third axis
        corners = np.dstack([corners[:, BITS[:, 0]], np.broadcast_to(BITS[:, 1], (len(x), 4))])
        x, n = np.column_stack([x, np.full(len(x), 0.5)]), np.column_stack([n, np.zeros(len(x))])
    off = np.einsum("mkd,md->mk", corners - x[:, None], n)
    t = local(corners - off[:, :, None] * n[:, None], x[:, None], n)[0][:, 0]
    return t, np.einsum("mk,mk->m", weights(t), off)
