# SPDX-License-Identifier: MIT
"""Contact problem of a substep, with tools or between groups of bodies.

A pair consists of a quadrature point on a surface and the opposite position on a tool or another group (`pairs`).  The
pairs have the relative displacements `w = B u`.  The contact law gives the forces `f(w)`.  The nodal forces are
`B^T f(w)`.  Between groups, the pairs are first determined at the start of the step.  After convergence, the pairs are
updated at the new positions, and the step is solved again.  The updates end if gaps change by less than `DEPTH` cells.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.conditions.acting import Acting, At, Loads, Setting
from mpm_dolfinx.conditions.conditions import holding, resistance
from mpm_dolfinx.contact.history import Origin, Rough, joined, pressure_name, shear_name
from mpm_dolfinx.contact.law import BEGIN, DEPTH, ROUNDS, ContactLaw, ContactState, Touch
from mpm_dolfinx.contact.pairs import Geometry, Pairs, at_nodes
from mpm_dolfinx.forms.unknowns import Unknowns, collect_garbage, petsc_matrix
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.points.material_points import MaterialPoints


class Found(NamedTuple):
    """Geometry, forces and tool motions of a contact at given displacements."""

    w: NDArray[np.float64]  # relative displacements of the pairs (m, d), m
    at: Geometry  # geometry of the pairs
    touch: Touch  # forces of the pairs
    motion: NDArray[np.float64]  # motions of tools that forces cause (k, q), m and rad
    balanced: NDArray[np.float64]  # forces on points after the Newton increment of the tools (m, d), N
    acts: bool  # whether any pair of any process is in contact, or was in contact in this substep
    equation: Any = None  # equation of motion of tools that forces move, see `moved_tools`


class Current(NamedTuple):
    """Contact law, material points of its pairs, and state of the iterations."""

    law: ContactLaw
    origin: Origin
    state: ContactState
    linear: Found | None = None  # geometry and forces at which the motion of tools is linearised


class SubstepMotion(NamedTuple):
    """Motion of tools in a substep."""

    own: float
    poses: Any
    flight: Any = None


class Touching(Acting):
    """Base class for the tools of a stage, and for the contacts between groups."""

    linear = False

    def __init__(self, setting: Setting, given: Mapping[str, Rough]):
        self.grid, self._materials = setting.grid, setting.materials
        self.names = tuple(given)
        self._frictional = [one.frictional for one in given.values()]
        self.symmetric = not any(self._frictional)

    def _stiffness(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return `resistance` and `holding`, in Pa, and the density, in kg/m^3, of each point, as columns (n, 3)."""
        moduli = [self._materials.table(points, of) for of in (resistance, holding)]
        return np.column_stack([*moduli, self._materials.present_density(points)])

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the initial contact pressures and shear tractions of n points, all zero."""
        out = {name: {pressure_name(name): np.zeros(n)} for name in self.names}
        for name, frictional in zip(self.names, self._frictional, strict=True):
            out[name] |= {shear_name(name): np.zeros((n, self.grid.dim))} if frictional else {}
        return out

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return placeholders for the forces and moments on the bodies: every component is `value`."""
        rows = np.full((len(self.names), 3 if self.grid.dim == 2 else 6), value)
        return {"tool_forces": dict(zip(self.names, rows, strict=True))}


class ContactProblem(Loads):
    """Contact forces in a substep.

    Parameters
    ----------
    law, origin
        Contact law at the start of the step (`law`), and the material points of its pairs (`origin`).
    again
        Function that finds the pairs at nodal displacements (local array, in m), and returns `law` and `origin`.
    cell_pairs
        Function that returns `first * grid.all_cells + second` for each pair of cells that may be in contact.
    """

    linear, smooth, touches = False, False, True
    key = ()

    def __init__(
        self,
        law: ContactLaw,
        origin: Origin,
        again: Callable[[NDArray[np.float64]], tuple[ContactLaw, Origin]] | None = None,
        cell_pairs: Callable[[], NDArray[np.int64]] | None = None,
    ):
        self.grid = law.grid
        self._again = again
        self._cell_pairs = cell_pairs
        self.now = Current(law, origin, law.begins())
        self._operator: Latest[tuple[PETSc.Mat, PETSc.Vec]] = Latest()
        self._found: Latest[Found] = Latest()

    @property
    def pairs(self) -> Pairs:
        """The current contact pairs."""
        return self.now.law.pairs

    @property
    def couples(self) -> bool:
        """Whether the contact couples nodes of different cells, as between groups."""
        return self._cell_pairs is not None

    @property
    def still(self) -> NDArray[np.float64]:
        """Motions (k, q) of tools without forces, which are zero.  Between groups there are no tools, so q = 0."""
        return np.zeros((len(self.now.law.contacts), 0))

    def found(self, at: At) -> Found:
        """Return geometry, forces and tool motions at the displacements u."""

        def find() -> Found:
            w = self._apart_by(self.now.law, at)
            return self._find_at(w, self._motion(w))

        return self._found((self.now, at.unknowns, at.u[at.unknowns.owned]), find, self.grid.comm)

    def _apart_by(self, law: ContactLaw, at: At) -> NDArray[np.float64]:
        """Return the relative displacements of the pairs of a law, in m."""
        B, w = self._B(law, at.unknowns)
        B.mult(at.unknowns.gather_owned(at.u[at.unknowns.owned]), w)
        return w.array_r.reshape(-1, self.grid.dim).copy()

    def _B(self, law: ContactLaw, unknowns: Unknowns) -> tuple[PETSc.Mat, PETSc.Vec]:
        """Return the matrix B of the pairs of a law, and a vector for products with B."""

        def make() -> tuple[PETSc.Mat, PETSc.Vec]:
            B = law.pairs.operator(unknowns)
            return B, B.createVecLeft()

        return self._operator((law, unknowns), make, self.grid.comm) if law is self.now.law else make()

    def _find_at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Found:
        """Return geometry and forces at relative displacements w and given motions of the tools."""
        law, state = self.now.law, self.now.state
        at = law.pairs.at(w, motion)
        touch = law.touch(state, at)
        some = any(of.any() for of in (touch.stiff, state.pressure, state.slip, state.stuck))
        return Found(w, at, touch, motion, touch.force, over_all(self.grid.comm, int(some)) > 0)

    def _motion(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the motions (k, q) of tools that the contact forces cause at relative displacements w of the pairs."""
        return self.still

    def closed(self, at: At) -> NDArray[np.bool_]:
        """Return which pairs (m,) are closed: their gap is at most `DEPTH` cells, and their contact conducts fluid."""
        conducts = np.array([contact.conducts for contact in self.now.law.contacts])
        gap, pairs = self.found(at).at.gap, self.pairs
        return conducts[pairs.number] & (gap <= DEPTH * self.grid.sizes(pairs.cell).min(axis=-1))

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Subtract the contact forces at u from the residual."""
        if not (found := self.found(at)).acts:
            return
        B, w = self._B(self.now.law, at.unknowns)
        w.array_w[:] = -found.balanced.ravel()
        B = B if on is at.unknowns else self.pairs.operator(on)
        B.multTransposeAdd(w, residual, residual)

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return a zero matrix with the sparsity pattern of `coupling`, or None if each pair acts on one cell."""
        out = self._pattern_of_pairs(unknowns) if self._cell_pairs is not None else None
        for cells in self.key:  # a tool that forces move couples the nodes of all cells under it
            B, own = at_nodes(self.grid, unknowns, cells, np.ones((len(cells), 2**self.grid.dim))), unknowns.vector()
            ones = B.createVecLeft()
            ones.set(1.0)
            B.multTranspose(ones, own)
            more = outer(own, own)
            out = more if out is None else out + more
        if out is not None:
            out.zeroEntries()
        return out

    def _pattern_of_pairs(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return a matrix with the sparsity pattern of all possible pairs between groups in the step."""
        grid, d = self.grid, self.grid.dim
        cell, other = np.divmod(self._cell_pairs(), grid.all_cells)
        exchange = Exchange(grid.comm, grid.owner(cell))
        cell, other = exchange.send(cell), exchange.send(other)
        key, of = np.unique(cell, return_inverse=True)
        m = len(cell)
        together = scipy.sparse.identity(m)
        if self.now.law.frictional:
            all_of = scipy.sparse.csr_matrix((np.ones(m), (of, np.arange(m))), shape=(len(key), m))
            together = all_of.T @ all_of
        all_of = scipy.sparse.kron(together, np.ones((d, d)), format="csr")
        B = at_nodes(grid, unknowns, grid.locals[cell], np.ones((m, 2 ** (d + 1))), other)
        return petsc_matrix(all_of, m * d, grid.comm, own=True).PtAP(B)

    def coupling(self, at: At) -> PETSc.Mat | None:
        """Return minus the derivative of the contact forces with respect to the nodal displacements, at u."""
        collect_garbage(self.grid.comm)  # with friction in 3D, matrices of 12 cells fill 60 MB in each iteration
        found, law = self.found(at), self.now.law
        if not found.acts:
            return None
        B, _ = self._B(law, at.unknowns)
        return petsc_matrix(law.tangent(found.touch, found.at), B.getLocalSize()[0], self.grid.comm, own=True).PtAP(B)

    def _nodal(self, unknowns: Unknowns, values: NDArray[np.float64]) -> PETSc.Vec:
        """Return the nodal forces `B^T v` for values v at the pairs."""
        B, w = self._B(self.now.law, unknowns)
        w.array_w[:] = values.ravel()
        out = unknowns.vector()
        B.multTranspose(w, out)
        return out

    def settle(self, at: At, sticks: bool) -> bool:
        """See `Loads`.  Each contact may change between stick and slip in each cell."""
        if not (self.now.law.frictional and self.found(at).acts):
            return False
        state, changed = self.now.law.choose(self.now.state, self.found(at).touch, sticks)
        self.now = self.now._replace(state=state)
        return changed

    def augment(self, at: At) -> bool:
        """Augment the pressures where mean penetrations exceed `DEPTH` cells.  Return whether forces changed."""
        law, state = self.now.law, self.now.state
        if not self.found(at).acts:
            return False
        part = at.parts.cells[law.cell]
        new = law.augmented(state, self.found(at).touch, lambda of: at.parts.largest(self.grid.comm, part, of)[part])
        self.now = self.now._replace(state=new)
        return new is not state

    def follow(self, at: At) -> bool:
        """Update the pairs, and return whether gaps changed by more than `DEPTH` cells."""
        if self._again is None:
            return False
        new, late = self._continued(Current(*self._again(at.u), self.now.state), at)
        if late.any():  # pairs are replaced in these connected parts only
            both = self.now, new
            chosen = [late[at.parts.cells[of.law.cell]] == (of is new) for of in both]
            kept = [rows[of.law.of] for rows, of in zip(chosen, both, strict=True)]
            origin, order = joined([of.origin for of in both], kept)
            law = ContactLaw(new.law.names, new.law.contacts, _merged([of.law.pairs for of in both], kept, order))
            order = np.argsort(np.concatenate([of.law.key[rows] for rows, of in zip(chosen, both, strict=True)]))
            self.now = Current(law, origin, _merged([of.state for of in both], chosen, order))
        return bool(late.any())

    def _continued(self, new: Current, at: At) -> tuple[Current, NDArray[np.bool_]]:
        """Return the contact with updated pairs, and flags of connected parts with gap changes above `DEPTH` cells."""
        found = self.found(at)
        law, state = self.now.law, self.now.state
        pairs = new.law.pairs
        gap = np.einsum("md,md->m", pairs.n, pairs.offset)
        pairs = replace(pairs, offset=pairs.offset - self._apart_by(new.law, at))
        now = ContactLaw(law.names, law.contacts, pairs)
        fresh = now.begins()
        _, new_at, old_at = np.intersect1d(now.key, law.key, return_indices=True)
        carried = {name: getattr(fresh, name).copy() for name in ("pressure", "slip", "resticks")}
        for name, values in carried.items():
            values[new_at] = getattr(state, name)[old_at]
        of_old, of_new = at.parts.cells[law.cell], at.parts.cells[now.cell]
        updates = at.parts.largest(self.grid.comm, of_old, state.updates)
        updates = np.where(updates < 0, BEGIN, updates)
        fresh = replace(fresh, **carried, updates=updates[of_new] + [0, 0, 0, 1])
        _, row, old_at = np.intersect1d(pairs.place, self.pairs.place, return_indices=True)
        push = found.touch.push
        off, missing = np.maximum(-gap, 0.0), push > 0
        off[row] = np.where((push[old_at] > 0) | (gap[row] < 0), np.abs(gap[row] - found.at.gap[old_at]), 0.0)
        missing[old_at] = False
        off = np.concatenate([off / self.grid.least, np.where(missing, np.inf, 0.0)])
        most = at.parts.largest(self.grid.comm, np.concatenate([of_new[now.of], of_old[law.of]]), off)
        return Current(now, new.origin, fresh), (most > DEPTH) & (updates[:, 3] < ROUNDS)

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with the contact pressures and shear tractions at the end of the step."""
        law, origin, *_ = self.now
        contacts = dict(zip(law.names, law.contacts, strict=True))
        found = self.found(at)
        return origin.means(contacts, points, *law.tractions(found.touch, found.at))

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """See `Loads`.  Dissipation is the work of shear tractions, including elastic slip."""
        law = self.now.law
        found = self.found(at)
        B, relative = self._B(law, at.unknowns)
        B.mult(at.unknowns.gather_owned(v[at.unknowns.owned]), relative)
        moves = relative.array_r.reshape(-1, self.grid.dim)
        tool = np.broadcast_to(self.tool_velocity(at), moves.shape)
        shear = law.pairs.area[:, None] * found.touch.shear[law.of]
        # the power of the forces in `push` at the nodes is replaced by the power of the tools
        more = -float((found.balanced * moves).sum()) + float((found.touch.force * tool).sum())
        return -float((shear * (moves - tool)).sum()), more

    def tool_velocity(self, at: At) -> NDArray[np.float64] | float:
        """Return the velocities (m, d), in m/s, of contact positions on tools.  Between groups, they are zero."""
        return 0.0

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """See `Loads`.  Each contact has an array of forces (N) and moments (N m) on bodies: (3,) in 2D, (6,) in 3D."""
        found, where = self.found(at), self.found(at).at
        if self.pairs.other_side() is not None:  # present lever arms, so that moments on a body at rest sum to zero
            where = where._replace(arm=where.arm + self.grid.at(self.pairs.cell, self.pairs.x, at.nodal))
        return {"tool_forces": dict(zip(self.now.law.names, self.now.law.forces(found.touch, where), strict=True))}

    def touching(self) -> tuple[NDArray[np.int32], NDArray[np.int64] | None, NDArray[np.float64], NDArray[np.float64]]:
        """See `Loads`.  With friction or adhesion, contact constrains all directions."""
        law = self.now.law
        at = law.pairs.at(np.zeros_like(self.pairs.x), self.still)
        touch = law.touch(self.now.state, at)
        d = self.grid.dim
        other = self.pairs.other_side()
        on = np.flatnonzero(touch.stiff > 0)
        rough = on[law.strength.any(axis=1)[law.of[on]]]
        rows = np.concatenate([on, np.repeat(rough, d)])
        along = np.concatenate([at.n[on], np.tile(np.eye(d), (len(rough), 1))])
        return self.pairs.cell[rows], None if other is None else other[0][rows], self.pairs.x[rows], along

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Loads`."""
        if self.pairs.other_side() is not None:
            return of_cells
        out, cells = of_cells.copy(), self.pairs.cell
        np.maximum.at(out, cells, out[cells] + self.now.law.rounding(self.now.state))
        return out

    @property
    def rounding_beside(self) -> float:
        """Largest rounding error, in N, of contact forces in the cells that contain opposite positions."""
        if self.pairs.other_side() is None:
            return 0.0
        return over_all(self.grid.comm, float(self.now.law.rounding(self.now.state).max(initial=0.0)), MPI.MAX)


def _merged(both: Sequence[Any], kept: Sequence[NDArray[np.bool_]], order: NDArray[np.int64]) -> Any:
    """Merge the entries that `kept` flags in two `Pairs`, or in two `ContactState`, and sort them by `order`."""
    names = (f.name for f in fields(both[1]) if f.name != "grid")
    columns = {name: [getattr(of, name)[rows] for of, rows in zip(both, kept, strict=True)] for name in names}
    return replace(both[1], **{name: np.concatenate(rows)[order] for name, rows in columns.items()})


def outer(a: PETSc.Vec, b: PETSc.Vec) -> PETSc.Mat:
    """Return the sparse matrix `a b^T`, which stores no zero rows and columns."""
    start, comm = b.owner_range[0], b.comm.tompi4py()
    rows, columns = np.flatnonzero(a.array_r), np.flatnonzero(b.array_r)
    at, value = start + columns, b.array_r[columns]
    if comm.size > 1:
        at, value = (np.concatenate(comm.allgather(part)) for part in (at, value))
    entries = np.outer(a.array_r[rows], value).ravel()
    where = np.repeat(rows, len(at)), np.tile(at, len(rows))
    matrix = scipy.sparse.csr_matrix((entries, where), shape=(len(a.array_r), max(1, b.size)))
    return petsc_matrix(matrix, len(b.array_r), comm)
