# SPDX-License-Identifier: MIT
"""Contact of groups of bodies: no penetration, Coulomb friction, adhesion.

The points of integration on the surface of one group, the one with the smaller surface, look along their normals for
the faces of the other.  Places and normals of these pairs are found when the grid is reset, gaps at the start of each
step.  In a step the gap is linear in the displacements: with w = B u, how both sides of the pairs move apart,

    g = g_n + n . w,      p = <lambda - k g>,      forces B^T f,

so the forces on both bodies are equal and opposite to rounding, whatever the iterations leave.  Pressure and friction
are those of `cell_contact`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.grid import Grid
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.problems.cell_contact import CellContact, Rows, Touch
from mpm_dolfinx.problems.contacts import Contact

SLOW, STIFFER = 0.6, 10.0
"""Where a round leaves more than this share of the penetration, k is made so many times larger."""


@dataclass(frozen=True, eq=False)
class PairRows(Rows):
    """Pairs, at the owners of the points' cells; moduli are the lower ones of both sides, shears act on the points.

    other : (m,) lexicographic cell of the other side; x, y : (m, d), m, where the grid sees both sides; n : (m, d)
    normal out of the other side; apart : (m, d), m, from the other side to the point at the start of the step.
    """

    other: NDArray[np.int64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    n: NDArray[np.float64]
    apart: NDArray[np.float64]


class BodyContact(CellContact):
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
        See `CellContact`.
    """

    def __init__(
        self,
        grid: Grid,
        contacts: Sequence[Contact],
        signs: NDArray[np.float64],
        rows: PairRows,
        back: tuple[Exchange, NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]],
    ):
        super().__init__(grid, "contact", contacts, rows, back)
        self._signs = signs
        self._off = np.full(1, np.inf)  # cells: what has penetrated in the round before
        self._operator: Latest[tuple[PETSc.Mat, PETSc.Vec]] = Latest()
        self._touch: Latest[Touch] = Latest()

    def operator(self, unknowns: Unknowns) -> tuple[PETSc.Mat, PETSc.Vec]:
        """Return B, which gives how far pairs move apart (m d,), m, from the unknowns, and room for its product."""

        def make() -> tuple[PETSc.Mat, PETSc.Vec]:
            grid, rows, d = self.grid, self.rows, self.grid.dim
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
        key = now, self.pressure.copy(), self.stiffness.copy(), self.along.copy(), unknowns

        def make() -> Touch:
            B, w = self.operator(unknowns)
            B.mult(unknowns.gather_owned(now), w)
            return self._at_w(w.array_r.reshape(-1, self.grid.dim))

        return self._touch(key, make, self.grid.comm)

    def _at_w(self, w: NDArray[np.float64]) -> Touch:
        return self.touch(np.einsum("md,md->m", self.rows.n, self.rows.apart + w), self.rows.n, w)

    def push(self, unknowns: Unknowns, u: NDArray[np.float64], residual: PETSc.Vec) -> None:
        """Take the forces of the contact at u off a residual, N."""
        force = self.at(unknowns, u).force
        B, w = self.operator(unknowns)
        w.array_w[:] = -force.ravel()
        B.multTransposeAdd(w, residual, residual)

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return zeros wherever a `tangent` may have entries: scipy leaves those out that are zero at present."""
        m, d = len(self.rows.cell), self.grid.dim
        together = scipy.sparse.identity(m)
        if self.grips:
            of = scipy.sparse.csr_matrix((np.ones(m), (self.of, np.arange(m))), shape=(len(self.area), m))
            together = of.T @ of
        all_of = scipy.sparse.kron(together, np.ones((d, d)), format="csr")
        B, _ = self.operator(unknowns)
        out = _matrix(all_of, m * d, self.grid.comm, own=True).PtAP(B)
        out.zeroEntries()
        return out

    def tangent(self, unknowns: Unknowns, u: NDArray[np.float64]) -> PETSc.Mat:
        """Return minus the derivative of the forces at u."""
        touch, rows, d, comm = self.at(unknowns, u), self.rows, self.grid.dim, self.grid.comm
        m = len(rows.cell)
        own = (rows.area * touch.stiff)[:, None, None] * rows.n[:, :, None] * rows.n[:, None, :]
        D = scipy.sparse.bsr_matrix((own, np.arange(m), np.arange(m + 1)), shape=(m * d, m * d)).tocsr()
        if self.grips:  # means over the conditions, of displacements and of pressures
            share = rows.area / self.area[self.of]
            mean = scipy.sparse.csr_matrix((share, (self.of, np.arange(m))), shape=(len(self.area), m))
            wide = scipy.sparse.kron(mean, scipy.sparse.identity(d), format="csr")
            k, whole = len(self.area), self.area[:, None, None]
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
        return self.grips and self.choose(self.at(unknowns, u), sticks)

    def augment(self, unknowns: Unknowns, u: NDArray[np.float64]) -> bool:
        """Augment the pressures where means penetrate too deep at u, see `augmented`; return whether they do."""
        most = self.augmented(self.at(unknowns, u), self.rows.x, "does something hold both bodies there?")
        if not most:
            return False
        if most > SLOW * self._off[0]:  # fluid, or what hardly changes its volume, resists more than k
            self.stiffness[:] *= STIFFER
        self._off[0] = most
        return True

    def gripped(self, unknowns: Unknowns, u: NDArray[np.float64], points: MaterialPoints) -> MaterialPoints:
        """Return the points with the pressures and shear tractions that contacts have on them at u."""
        return self.carried(self.at(unknowns, u), points)

    def touching(self) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return cells (m,), lexicographic ones of the other side, places and directions (m, d) of what touches."""
        rows, d = self.rows, self.grid.dim
        gap = np.einsum("md,md->m", rows.n, rows.apart)
        on = np.flatnonzero(self.touches(rows.pressure, gap))
        rough = on[self.strength.any(axis=1)[self.of[on]]]
        all_rows = np.concatenate([on, np.repeat(rough, d)])
        along = np.concatenate([rows.n[on], np.tile(np.eye(d), (len(rough), 1))])
        return rows.cell[all_rows], rows.other[all_rows], rows.x[all_rows], along

    def forces(self, unknowns: Unknowns, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces and moments (contacts, d + 1), in 3D (contacts, 6), on the bodies of `one`, N and N m.

        Moments count about the origin, with the places of the start of the step.
        """
        rows = self.rows
        return self.summed(self._signs[rows.number, None] * self.at(unknowns, u).force, rows.x)


def _matrix(rows: scipy.sparse.csr_matrix, columns: int, comm: MPI.Intracomm, own: bool = False) -> PETSc.Mat:
    """Return a matrix of rows of this process, with so many columns of it; own: that have no entries in others."""
    rows.sort_indices()  # as PETSc wants them
    start = int(comm.exscan(columns) or 0) if own and comm.size > 1 else 0
    csr = [values.astype(PETSc.IntType) for values in (rows.indptr, rows.indices + start)]
    A = PETSc.Mat().createAIJ(((rows.shape[0], None), (columns, None)), csr=(*csr, rows.data), comm=comm)
    A.assemble()
    return A
