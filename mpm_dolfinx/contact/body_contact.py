# SPDX-License-Identifier: MIT
"""Contact of groups of bodies: no penetration, Coulomb friction, adhesion.

The points of integration on the surface of one group, the one with the smaller surface, look along their normals for
the faces of the other.  With w = B u, how both sides of the pairs move apart in the step,

    g = g_m + n . (w - w_m),      p = <lambda - k g>,      forces B^T f,

so the forces on both bodies are equal and opposite to rounding, whatever the iterations leave.  Pairs, normals n and
gaps g_m are at first those of the start of the step, with w_m = 0.  What balances with them is balanced anew with those
of where it has come to, until gaps are those of the faces at the end of the step.  Pressure and friction
are those of `cell_contact`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.contact.cell_contact import CellContact, Rows, Touch
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.points.material_points import MaterialPoints

SAME_GAP, FOLLOWS = 5e-4, 8
"""Cells: by how much gaps may differ from those of faces at the end of a step; how often pairs are found at most."""
SLOW, STIFFER = 0.6, 10.0
"""Where a round leaves more than this share of the penetration, k is made so many times larger."""


@dataclass(frozen=True, eq=False)
class PairRows(Rows):
    """Pairs, at the owners of the points' cells; moduli are the lower ones of both sides, shears act on the points.

    other : (m,) lexicographic cell of the other side; x, y : (m, d), m, where the grid sees both sides; n : (m, d)
    normal out of the other side; apart : (m, d), m, from the other side to the point where the pairs were found;
    place : (m,) number of the point, the same for all pairs that it has in a step.
    """

    other: NDArray[np.int64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    n: NDArray[np.float64]
    apart: NDArray[np.float64]
    place: NDArray[np.int64]


class BodyContact(CellContact):
    """The contact of groups in a substep.

    Parameters
    ----------
    grid
        Background grid.
    names, contacts, signs
        The contacts, and with which sign each row counts for the bodies of its `one`.
    rows
        The pairs.
    back
        See `CellContact`.
    reach
        Returns in which pairs of cells the pairs of this process's points may be in the step, see `Contacts`.
    """

    def __init__(
        self,
        grid: Grid,
        names: Sequence[str],
        contacts: Sequence[Contact],
        signs: NDArray[np.float64],
        rows: PairRows,
        back: tuple[Exchange, NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]],
        reach: Callable[[], NDArray[np.int64]],
    ):
        super().__init__(grid, names, contacts, rows, back)
        self._signs, self._reach_of_pairs = signs, reach
        self._apart = rows.apart.copy()  # at no displacement
        self._raised = np.ones(1)
        self._off = np.full(1, np.inf)  # cells: what has penetrated in the round before
        self._operator: Latest[tuple[PETSc.Mat, PETSc.Vec]] = Latest()
        self._touch: Latest[Touch] = Latest()

    def operator(self, unknowns: Unknowns) -> tuple[PETSc.Mat, PETSc.Vec]:
        """Return B, which gives how far pairs move apart (m d,), m, from the unknowns, and room for its product."""
        return self._operator(unknowns, lambda: self._apart_by(unknowns), self.grid.comm)

    def _apart_by(self, unknowns: Unknowns) -> tuple[PETSc.Mat, PETSc.Vec]:
        grid, rows = self.grid, self.rows
        index = np.stack(np.unravel_index(rows.other % grid.cells, tuple(grid.shape)), axis=1)
        off = (rows.y - grid.low) / grid.h - index - 0.5
        other = np.prod(0.5 + off[:, None] * grid.signs, axis=2)
        value = np.concatenate([grid.shape_values(rows.cell, rows.x), -other], axis=1)
        B = self._of_nodes(unknowns, rows.cell, rows.other, value)
        return B, B.createVecLeft()

    def _of_nodes(
        self, unknowns: Unknowns, cell: NDArray[np.int32], other: NDArray[np.int64], value: NDArray[np.float64]
    ) -> PETSc.Mat:
        """Return the matrix with values (m, 2 * 2^d) at the nodes of cells, and of others, component by component."""
        grid, d = self.grid, self.grid.dim
        numbers = unknowns.map.indices.reshape(-1, d)
        travel = Exchange(grid.comm, grid.owner(other))
        there = travel.back(numbers[grid.cell_nodes[grid.local(travel.send(other))]])
        column = np.concatenate([numbers[grid.cell_nodes[cell]], there], axis=1).swapaxes(1, 2)
        value, m = np.broadcast_to(value[:, None], (len(value), d, value.shape[1])), len(cell) * d
        row = np.broadcast_to(np.arange(m).reshape(-1, d, 1), column.shape)
        kept = column >= 0
        shape, own = (m, max(1, unknowns.global_size)), (row[kept], column[kept])
        return _matrix(scipy.sparse.csr_matrix((value[kept], own), shape=shape), unknowns.size, grid.comm)

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
        return self.touch(np.einsum("md,md->m", self.rows.n, self._apart + w), self.rows.n, w)

    def push(self, unknowns: Unknowns, u: NDArray[np.float64], residual: PETSc.Vec) -> None:
        """Take the forces of the contact at u off a residual, N."""
        force = self.at(unknowns, u).force
        B, w = self.operator(unknowns)
        w.array_w[:] = -force.ravel()
        B.multTransposeAdd(w, residual, residual)

    def push_on(self, held: Unknowns, unknowns: Unknowns, u: NDArray[np.float64], residual: PETSc.Vec) -> None:
        """Take its forces at u on other components of nodes, which do not move, off a residual of these, N."""
        force = self.at(unknowns, u).force
        B, w = self._apart_by(held)
        w.array_w[:] = -force.ravel()
        B.multTransposeAdd(w, residual, residual)

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return zeros wherever a `tangent` may have entries in the step, as pairs follow the bodies."""
        grid, d = self.grid, self.grid.dim
        cell, other = np.divmod(self._reach_of_pairs(), len(grid.owners))
        travel = Exchange(grid.comm, grid.owner(cell))
        cell, other = travel.send(cell), travel.send(other)
        key, of = np.unique(cell, return_inverse=True)
        m = len(cell)
        together = scipy.sparse.identity(m)
        if self.grips:
            all_of = scipy.sparse.csr_matrix((np.ones(m), (of, np.arange(m))), shape=(len(key), m))
            together = all_of.T @ all_of
        all_of = scipy.sparse.kron(together, np.ones((d, d)), format="csr")
        B = self._of_nodes(unknowns, grid.local(cell), other, np.ones((m, 2 ** (d + 1))))
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

    def continues(self, before: BodyContact, unknowns: Unknowns, u: NDArray[np.float64]) -> float:
        """Take over what another contact of the step has come to at u; return by how much gaps differ, in cells.

        The pairs of this one were found at u.  Those that do not touch in either do not count.
        """
        B, w = self.operator(unknowns)
        B.mult(unknowns.gather_owned(u[unknowns.owned]), w)
        self._apart[:] = self.rows.apart - w.array_r.reshape(-1, self.grid.dim)
        size = self.grid.num_local
        _, here, there = np.intersect1d(
            self.number * size + self.cell, before.number * size + before.cell, return_indices=True
        )
        for mine, its in ((self.pressure, before.pressure), (self.along, before.along), (self._turned, before._turned)):
            mine[here] = its[there]
        _, row, at = np.intersect1d(self.rows.place, before.rows.place, return_indices=True)
        self.stiffness[:] *= before.raised
        self._raised[:] = before.raised
        B, w = before.operator(unknowns)
        B.mult(unknowns.gather_owned(u[unknowns.owned]), w)
        then = np.einsum("md,md->m", before.rows.n, before._apart + w.array_r.reshape(-1, self.grid.dim))
        gap, push = np.einsum("md,md->m", self.rows.n, self.rows.apart), before.at(unknowns, u).push
        off, lost = np.maximum(-gap, 0.0), push > 0
        off[row], lost[at] = np.where((push[at] > 0) | (gap[row] < 0), np.abs(gap[row] - then[at]), 0.0), False
        most = float(off.max(initial=0.0)) / self.grid.h.min() if not lost.any() else np.inf
        return over_all(self.grid.comm, most, MPI.MAX)

    @property
    def raised(self) -> float:
        """By how much k has been raised."""
        return float(self._raised[0])

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
            self._raised[:] *= STIFFER
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
        return self.summed(self._signs[rows.number, None] * self.at(unknowns, u).force, rows.x + self.grid.base)


class Following:
    """The contact of groups in a substep, whose pairs follow the bodies where these slide along curved surfaces.

    Parameters
    ----------
    first
        The contact with pairs as at the start of the step.
    again
        Returns the contact with the pairs that points meet at displacements, a local array, m.
    """

    def __init__(self, first: BodyContact, again: Callable[[NDArray[np.float64]], BodyContact]):
        self._again, self._found = again, [first]

    @property
    def now(self) -> BodyContact:
        """The contact at present."""
        return self._found[-1]

    def follow(self, unknowns: Unknowns, u: NDArray[np.float64]) -> bool:
        """Find pairs anew at u, a local array, m; return whether these change the balance."""
        if len(self._found) > FOLLOWS:
            return False
        new = self._again(u)
        if new.continues(self.now, unknowns, u) <= SAME_GAP:
            return False
        self._found.append(new)
        return True


def _matrix(rows: scipy.sparse.csr_matrix, columns: int, comm: MPI.Intracomm, own: bool = False) -> PETSc.Mat:
    """Return a matrix of rows of this process, with so many columns of it; own: that have no entries in others."""
    rows.sort_indices()  # as PETSc wants them
    start = int(comm.exscan(columns) or 0) if own and comm.size > 1 else 0
    csr = [values.astype(PETSc.IntType) for values in (rows.indptr, rows.indices + start)]
    A = PETSc.Mat().createAIJ(((rows.shape[0], None), (columns, None)), csr=(*csr, rows.data), comm=comm)
    A.assemble()
    return A
