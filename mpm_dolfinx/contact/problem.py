# SPDX-License-Identifier: MIT
"""The contact of a substep: with tools, or of groups of bodies with one another.

With w = B u, how the places of pairs move apart in the step, forces on the nodes are B^T f(w): those on both bodies are
equal and opposite to rounding, whatever the iterations leave.  Where both sides deform, pairs, normals and gaps are at
first those of the start of the step.  What balances with them is balanced anew with those of where it has come to,
until gaps are those of the faces at the end of the step.

Unknowns beside u are the multipliers, see `law`, and the ways of tools that loads push: these are moved along the
directions e of their loads until e . f = load.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest, same
from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import EPSILON, SAME
from mpm_dolfinx.conditions.acting import At, Loads, Unmet
from mpm_dolfinx.contact.history import Origin
from mpm_dolfinx.contact.law import ContactLaw, ContactState, Touch
from mpm_dolfinx.contact.pairs import Geometry, Pairs, at_nodes, petsc_matrix
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.points.material_points import MaterialPoints

FOLLOWS = 8  # how often pairs are found at most in a step
DEPTH = 5e-4  # cells: by how much gaps may differ from those of pairs that are found anew
ROUNDS = 20  # steps of tools to where they begin to bear their loads


@dataclass(frozen=True, eq=False)
class Pushes:
    """What pushes k tools: names that errors call them; start (k,), m, how far before the step; direction
    (k, d), unit vectors; load (k,), N, nan where there is none.
    """

    names: Sequence[str]
    start: NDArray[np.float64]
    direction: NDArray[np.float64]
    load: NDArray[np.float64]


class Found(NamedTuple):
    """The contact at some displacement: where pairs are, and what acts on them."""

    at: Geometry
    touch: Touch


class Current(NamedTuple):
    """The conditions of the pairs as they are found at present, where these come from, and the state of iterations.

    follows: how often pairs have been found anew.
    """

    law: ContactLaw
    origin: Origin
    state: ContactState
    follows: int = 0


class ContactProblem(Loads):
    """The contact; `now` is replaced as it is solved.

    Parameters
    ----------
    law, origin
        The conditions at the start of the step, and where their pairs come from.
    pushes
        What pushes tools.
    again
        Returns the law and origin of the pairs that points meet at displacements, a local array, m, see `FacePairs`.
    reach
        Returns all pairs of lexicographic cells that pairs of this process may be in, first * cells + second.
    """

    linear, smooth, touches, multiplies = False, False, True, True

    def __init__(
        self,
        law: ContactLaw,
        origin: Origin,
        pushes: Pushes | None = None,
        again: Callable[[NDArray[np.float64]], tuple[ContactLaw, Origin]] | None = None,
        reach: Callable[[], NDArray[np.int64]] | None = None,
    ):
        self.grid = law.grid
        self.pushes = pushes
        self._again = again
        self._reach = reach
        self.now = Current(law, origin, law.begins())
        self._operator: Latest[tuple[PETSc.Mat, PETSc.Vec]] = Latest()
        self._found: Latest[Found] = Latest()
        if self.pushed:
            self.now = self.now._replace(state=self._started())
        self._begun = self._aimed = self.now
        self._change = np.zeros(self._size)
        self._tangent: tuple = ()

    @property
    def pairs(self) -> Pairs:
        """The pairs at present."""
        return self.now.law.pairs

    @property
    def pushed(self) -> bool:
        """Whether loads push tools."""
        return self.pushes is not None and not np.isnan(self.pushes.load).all()

    @property
    def couples(self) -> bool:
        """Whether nodes of different cells act on one another through the contact."""
        return self._reach is not None

    @property
    def _loads(self) -> NDArray[np.float64]:
        """Loads on the tools (contacts,), N, nan where there is none."""
        return np.full(len(self.now.law.contacts), np.nan) if self.pushes is None else self.pushes.load

    @property
    def _size(self) -> int:
        """Unknowns on this process."""
        return len(self.now.law.area) + len(self.now.law.contacts)

    def found(self, at: At) -> Found:
        """Return the contact at u."""
        key = self.now, at.unknowns, at.u[at.unknowns.owned]
        return self._found(key, lambda: self._find(self._apart_by(self.now.law, at), self.now.state), self.grid.comm)

    def _apart_by(self, law: ContactLaw, at: At) -> NDArray[np.float64]:
        """Return w (m, d), m, of the pairs of a law."""
        B, w = self._B(law, at.unknowns)
        B.mult(at.unknowns.gather_owned(at.u[at.unknowns.owned]), w)
        return w.array_r.reshape(-1, self.grid.dim).copy()

    def _B(self, law: ContactLaw, unknowns: Unknowns) -> tuple[PETSc.Mat, PETSc.Vec]:
        """Return B of the pairs of a law, and room for its product."""

        def make() -> tuple[PETSc.Mat, PETSc.Vec]:
            B = law.pairs.operator(unknowns)
            return B, B.createVecLeft()

        return self._operator((law, unknowns), make, self.grid.comm) if law is self.now.law else make()

    def _find(self, w: NDArray[np.float64], state: ContactState) -> Found:
        at = self.pairs.at(w, state.way)
        return Found(at, self.now.law.touch(state, at))

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Take the forces at u off."""
        self._add(at, residual, on, -self.found(at).touch.force)

    def _add(self, at: At, out: PETSc.Vec, on: Unknowns, force: NDArray[np.float64]) -> None:
        """Add forces on the points (m, d), N, to those of the nodes."""
        B, w = self._B(self.now.law, at.unknowns)
        w.array_w[:] = force.ravel()
        B = B if on is at.unknowns else self.pairs.operator(on)
        B.multTransposeAdd(w, out, out)

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return zeros wherever pairs that follow the bodies may couple nodes in the step; None without such."""
        if self._reach is None:
            return None
        grid, d = self.grid, self.grid.dim
        cell, other = np.divmod(self._reach(), len(grid.owners))
        travel = Exchange(grid.comm, grid.owner(cell))
        cell, other = travel.send(cell), travel.send(other)
        key, of = np.unique(cell, return_inverse=True)
        m = len(cell)
        all_of = scipy.sparse.csr_matrix((np.ones(m), (of, np.arange(m))), shape=(len(key), m))
        together = all_of.T @ all_of
        all_of = scipy.sparse.kron(together, np.ones((d, d)), format="csr")
        B = at_nodes(grid, unknowns, grid.local(cell), np.ones((m, 2 ** (d + 1))), other)
        out = petsc_matrix(all_of, m * d, grid.comm, own=True).PtAP(B)
        out.zeroEntries()
        return out

    def coupling(self, at: At) -> PETSc.Mat:
        """Return minus the derivative of the forces at u."""
        where, touch = self.found(at)
        law = self.now.law
        self._tangent = law, touch.presses
        B, _ = self._B(law, at.unknowns)
        return petsc_matrix(law.tangent(touch, where), B.getLocalSize()[0], self.grid.comm, own=True).PtAP(B)

    def serves(self, at: At) -> bool:
        """Return whether what touches at u on this process did so where the tangent was assembled."""
        return same(self._tangent, (self.now.law, self.found(at).touch.presses))

    def unmet(self, at: At) -> Unmet:
        """Return by how much multipliers are off the tractions at u, and loads of tools off what these meet, N."""
        found = self.found(at)
        law = self.now.law
        off, unknown = law.unmet(self.now.state, found.touch)
        met, slope, how_well = self._met(found)
        own = self.grid.comm.rank == 0  # each load counts once
        touching = np.full(len(law.contacts), -1)
        touching[self.pairs.number[found.touch.presses]] = self.pairs.cell[found.touch.presses]
        goes = (slope > 0) & (np.abs(self.now.state.way) < self.grid.h.min())
        load = own * np.where(goes, np.nan_to_num(self._loads - met), 0.0)
        cells = np.concatenate([law.cell, touching])
        return Unmet(np.concatenate([off, load]), np.concatenate([unknown, own * how_well]), cells)

    def drive(self, at: At, x: NDArray[np.float64], out: PETSc.Vec) -> None:
        """Add the forces on the nodes by which a change x of the unknowns, N, would drive the bodies."""
        where, touch = found = self.found(at)
        law = self.now.law
        change, gone = self._split(found, x)
        force = law.acts(touch, where, law.trial(change))
        self._add(at, out, at.unknowns, force + law.slope(touch, where, gone) if self.pushed else force)

    def response(self, at: At, x: NDArray[np.float64], v: PETSc.Vec) -> NDArray[np.float64]:
        """Return by how much x, with displacements v, m, brings multipliers and loads nearer: see `Loads`."""
        where, touch = found = self.found(at)
        law = self.now.law
        change, gone = self._split(found, x)
        B, w = self._B(law, at.unknowns)
        B.mult(v, w)
        apart = w.array_r.reshape(-1, self.grid.dim) - gone
        nearer = change - law.answer(touch, law.trial(change, where, apart))
        met = np.zeros(len(law.contacts))
        if self.pushed:
            met = self._along_loads(law.acts(touch, where, law.trial(change)) - law.slope(touch, where, apart))
        return np.concatenate([law.area * nearer, met * (self.grid.comm.rank == 0)])

    def aim(self, at: At, x: NDArray[np.float64]) -> None:
        """Let x be the change of the unknowns, N, along which `go` goes from where they are at u."""
        change, _ = self._split(self.found(at), x)
        self._aimed = self.now
        self._change = np.concatenate([change, self._ways(self.found(at), x)])

    def go(self, shares: NDArray[np.float64]) -> None:
        """Go so far along the change of the unknowns, shares (n,) of it."""
        law, state = self.now.law, self._aimed.state
        count = len(law.contacts)
        change = shares * self._change
        pressure = state.pressure + change[: len(change) - count]
        h = self.grid.h.min()
        way = over_all(self.grid.comm, change[len(change) - count :]) / self.grid.comm.size
        gone = replace(state, pressure=pressure, way=np.clip(state.way + way, -h, h), begins=False)
        self.now = self._aimed._replace(state=gone)

    def restart(self) -> None:
        """Go back to where the iterations began."""
        self.now = self._begun

    def _split(self, found: Found, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a change x of multipliers (k,), Pa, and how far it moves the places of tools (m, d), m."""
        law = self.now.law
        change = x[: len(x) - len(law.contacts)] / law.area
        if not self.pushed:
            return change, np.zeros((len(law.of), self.grid.dim))
        _, slope, _ = self._met(found)
        load = over_all(self.grid.comm, x[len(x) - len(law.contacts) :])
        gone = np.divide(load, slope, out=np.zeros(len(load)), where=slope > 0)
        return change, gone[self.pairs.number, None] * self.pushes.direction[self.pairs.number]

    def _ways(self, found: Found, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far x moves tools (contacts,), m."""
        load = x[len(x) - len(self.now.law.contacts) :]
        if not self.pushed:
            return 0 * load
        _, slope, _ = self._met(found)
        return np.divide(over_all(self.grid.comm, load), slope, out=np.zeros(len(load)), where=slope > 0)

    def _nearer(self, found: Found) -> NDArray[np.float64]:
        """Return how far tools that nothing touches go to meet their loads at one place (contacts,), m."""
        met, _, _ = self._met(found)
        far, touches = self._seek(found)
        return np.where((np.nan_to_num(self._loads - met) > 0) & ~touches, np.minimum(far, self.grid.h.min()), 0.0)

    def _along_loads(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (contacts,), N, of forces (m, d) on the points along the loads of tools."""
        along = (self.pushes.direction[self.pairs.number] * force).sum(axis=1)
        return self.now.law.by_contact(along[:, None])[:, 0] * ~np.isnan(self._loads)

    def _met(self, found: Found) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return what tools meet along their loads (contacts,), N, its derivative, N/m, and how well it is known, N."""
        law = self.now.law
        if not self.pushed:
            return (np.zeros(len(law.contacts)),) * 3
        slope = self._along_loads(law.slope(found.touch, found.at, self.pushes.direction[self.pairs.number]))
        off = law.rounding * found.touch.presses
        return self._along_loads(found.touch.force), slope, law.by_contact(off[:, None])[:, 0]

    def _seek(self, found: Found) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return how far tools go (contacts,), m, until a place alone would bear the load, and which tools touch.

        Infinity where there is no such place.
        """
        law = self.now.law
        of = self.pairs.number
        k = law.stiffness[law.of]
        along = (found.at.n * self.pushes.direction[of]).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            more = self.pushes.load[of] / (self.pairs.area * along) - self.now.state.pressure[law.of]
            far = found.at.gap + more / k
            far = np.where(along > 0, far / along, np.inf)
        nearest = np.full(len(self.pushes.load), np.inf)
        np.minimum.at(nearest, of, far)
        touches = law.by_contact((found.touch.push > 0)[:, None].astype(float))[:, 0] > 0
        return over_all(self.grid.comm, nearest, MPI.MIN), touches

    def _started(self) -> ContactState:
        """Return the state with tools where they go before the bodies do: at most to where one place bears the load."""
        state = self.now.state
        still = np.zeros_like(self.pairs.x)
        h = self.grid.h.min()
        for _ in range(ROUNDS):
            found = self._find(still, state)
            met, slope, _ = self._met(found)
            shift = np.divide(np.nan_to_num(self._loads - met), slope, out=self._nearer(found), where=slope > 0)
            before = state.way
            state = replace(state, way=np.clip(before + np.minimum(shift, self._seek(found)[0]), -h, h))
            if np.abs(state.way - before).max() <= EPSILON * self.grid.reach:
                break
        return state

    def settle(self, at: At, sticks: bool) -> bool:
        """Choose what slips at u, and if asked for what sticks again; return whether that is another choice."""
        found, state, changed = self.found(at), self.now.state, False
        if self.now.law.grips:
            state, changed = self.now.law.choose(state, found.touch, sticks)
        if self.pushed and (nearer := self._nearer(found)).any():
            h = self.grid.h.min()
            state, changed = replace(state, way=np.clip(state.way + nearer, -h, h)), True
        self.now = self.now._replace(state=state)
        return changed

    def augment(self, at: At, unknown: NDArray[np.float64]) -> bool:
        """Refuse tools that do not meet their loads."""
        if not self.pushed:
            return False
        found = self.found(at)
        met, slope, how_well = self._met(found)
        load, h = self.pushes.load, self.grid.h.min()
        wrong = np.abs(np.nan_to_num(met - load)) > np.maximum(SAME * np.nan_to_num(load), how_well)
        _, touches = self._seek(found)
        lost = wrong & ((self.now.state.way >= h) | (touches & (slope <= 0)))
        for k in np.flatnonzero(lost)[:1]:
            why = f"meets {met[k]:.6g} N, however far it goes: do the bodies hold it?"
            if met[k] == 0:
                why = "meets nothing within a cell: does it begin where it touches the bodies?"
            raise NotConverged(f"{self.pushes.names[k]}: is pushed by {load[k]:.6g} N and {why}")
        return False

    def follow(self, at: At) -> bool:
        """Find pairs anew at u, a local array, m; return whether these change the balance."""
        if self._again is None or self.now.follows == FOLLOWS:
            return False
        new = Current(*self._again(at.u), self.now.state)
        new, off = self._continued(new, at)
        if off <= DEPTH:
            return False
        self.now = new
        return True

    def _continued(self, new: Current, at: At) -> tuple[Current, float]:
        """Return the contact with pairs that were found at u, and by how much gaps differ from the present, cells.

        What touches in neither does not count.
        """
        found = self.found(at)
        law = self.now.law
        state = self.now.state
        pairs = new.law.pairs
        gap = np.einsum("md,md->m", pairs.n, pairs.apart)
        pairs = replace(pairs, apart=pairs.apart - self._apart_by(new.law, at))
        now = ContactLaw(law.names, law.contacts, pairs)
        fresh = now.begins()
        _, here, there = np.intersect1d(now.key, law.key, return_indices=True)
        carried = {name: getattr(fresh, name).copy() for name in ("pressure", "slip", "resticks")}
        for name, values in carried.items():
            values[here] = getattr(state, name)[there]
        _, row, there = np.intersect1d(pairs.place, self.pairs.place, return_indices=True)
        push = found.touch.push
        off, lost = np.maximum(-gap, 0.0), push > 0
        off[row] = np.where((push[there] > 0) | (gap[row] < 0), np.abs(gap[row] - found.at.gap[there]), 0.0)
        lost[there] = False
        most = float(off.max(initial=0.0)) / self.grid.h.min() if not lost.any() else np.inf
        state = replace(fresh, **carried, way=state.way, begins=False)
        going_on = Current(now, new.origin, state, self.now.follows + 1)
        return going_on, over_all(self.grid.comm, most, MPI.MAX)

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with the pressures and shear tractions that contacts have on them at u."""
        law, origin, *_ = self.now
        contacts = dict(zip(law.names, law.contacts, strict=True))
        return origin.means(contacts, points, *law.tractions(self.found(at).touch))

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments (d + 1,), in 3D (6,), on the bodies, N and N m, and how far loads push tools, m."""
        where, touch = self.found(at)
        names = self.now.law.names
        out = {"tool_forces": dict(zip(names, self.now.law.forces(touch, where), strict=True))}
        if self.pushes is not None:
            out["tool_travel"] = dict(zip(names, self.pushes.start + self.now.state.way, strict=True))
        return out

    def touching(self) -> tuple[NDArray[np.int32], NDArray[np.int64] | None, NDArray[np.float64], NDArray[np.float64]]:
        """Return cells (m,), lexicographic ones of other sides that deform, places and directions (m, d) of what holds.

        That is what touches at the start of the step.
        """
        law = self.now.law
        at, touch = self._find(np.zeros_like(self.pairs.x), replace(self.now.state, way=np.zeros(len(law.contacts))))
        d = self.grid.dim
        other = self.pairs.other_side()
        on = np.flatnonzero(touch.presses)
        rough = on[law.strength.any(axis=1)[law.of[on]]]
        rows = np.concatenate([on, np.repeat(rough, d)])
        along = np.concatenate([at.n[on], np.tile(np.eye(d), (len(rough), 1))])
        return self.pairs.cell[rows], None if other is None else other[0][rows], self.pairs.x[rows], along

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what rounding leaves: that of gaps as well, which goes with coordinates."""
        if self.pairs.other_side() is not None:
            return of_cells
        out, cells = of_cells.copy(), self.pairs.cell
        np.maximum.at(out, cells, out[cells] + self.now.law.rounding)
        return out

    @property
    def rounding_beside(self) -> float:
        """What rounding leaves on other sides, in other cells."""
        if self.pairs.other_side() is None:
            return 0.0
        return over_all(self.grid.comm, float(self.now.law.rounding.max(initial=0.0)), MPI.MAX)
