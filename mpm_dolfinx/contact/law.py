# SPDX-License-Identifier: MIT
"""Contact pressure, Coulomb friction and adhesion by conditions, one a contact and cell.

The contact pressure at a place with the gap g, and its energy by area, are

    p = <lambda - k g>,     psi = p^2 / (2 k).

k is no stiffer than lets a Q1 field follow curved surfaces, to which their places ask for more than it has nodes;
lambda, one value a contact and cell, is at first the pressure of the step before, and augmented (Uzawa) until the
cells' surfaces penetrate by less than `DEPTH` in the mean.  Friction acts on the mean slip s of the cell in the step,
from the traction t_n of the step before, which the points keep,

    t = P (t_n - k_t s),     |t| <= mu p + min(adhesion, 10 p)      by radial return,

P the projection on the tangent plane: what sticks is elastic with a stiffness k_t, and gives back what it took.
What slips is chosen after each Newton step (active sets): at first all sticks, whatever it would bear; what slips back
sticks again, as soon as the balance is near, and then for as long.  Decided in each residual anew all would slip to and
fro, for there is no stiffness in slip.  What sticks and leaves slips as well, the second time for good: where the mean
normal of a cell leans, under round tools that just touch, shear alone would push the surface away, to and fro.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import EPSILON, NEAR, TINY
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.contact.history import Rough
from mpm_dolfinx.contact.pairs import Geometry, Pairs
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import first, over_all

STIFF = 100.0
"""k in units of (what resists) / (cell size)."""
GRIP = 6.0
"""k_t in units of (what resists) / (cell size): stiffer shears alternate from cell to cell, which displaces no node."""
DEPTH = 5e-4  # cells: mean penetration that is left
TOUCH = 1e-13  # of the grid: what is nearer touches, but for rounding; light bodies press no deeper than 1e-8 cells
SLIVER = 0.25  # of a cell's face: of what is smaller less penetration counts
ROUNDS = 20  # augmentations that are tried
SLOW, STIFFER = 0.6, 10.0
"""Where a round leaves more than this share of the penetration, k is made so many times larger."""
RAMP = 10.0  # adhesion over the normal pressure, at most


@dataclass(frozen=True, eq=False)
class ContactState:
    """What iterations change of k conditions, beside the displacements.

    pressure : (k,) lambda, Pa; slip : (k, d) direction of the shear of what slips, else zero; resticks : (k,) what has
    slipped, and stuck again; parts : (k,) and then has left; stuck : (k, d) traction, Pa, of what stuck at the last
    choice; raised : by how much k has been; off : penetration, cells, of the last round; rounds : of augmentation;
    follows : how often pairs have been found anew.
    """

    pressure: NDArray[np.float64]
    slip: NDArray[np.float64]
    resticks: NDArray[np.bool_]
    parts: NDArray[np.bool_]
    stuck: NDArray[np.float64]
    raised: float = 1.0
    off: float = np.inf
    rounds: int = 0
    follows: int = 0

    @property
    def slips(self) -> NDArray[np.bool_]:
        """Which conditions (k,) slip."""
        return self.slip.any(axis=1)


@dataclass(frozen=True, eq=False)
class Touch:
    """The contact at some displacement: of m pairs, and of k conditions.

    force : (m, d) on the points, N; push : (m,) pressure, Pa; stiff : (m,) minus its derivative by the gap, Pa/m;
    pressure : (k,) mean of the pressure, Pa; sticks : (k,) what touches, and does not slip; trial, shear : (k, d)
    traction if all stuck, and as it is, Pa; most : (k,) what it may be, Pa; grip : (k, d, d) minus its derivative by
    the slip, Pa/m; rise : (k, d) that by the pressure.
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


class ContactLaw:
    """The conditions of contacts in a substep.

    Parameters
    ----------
    names, contacts
        The contacts.
    pairs
        What may touch.
    """

    def __init__(self, names: Sequence[str], contacts: Sequence[Rough], pairs: Pairs):
        self.grid = pairs.grid
        self.names = names
        self.contacts = contacts
        self.pairs = pairs
        key, self.of = np.unique(pairs.number * self.grid.num_local + pairs.cell, return_inverse=True)
        self.key = key
        """Contact and cell (k,) of the conditions, in one number."""
        self.area = sum_by(self.of, pairs.area, len(key))
        strength = np.array([(contact.friction, contact.adhesion) for contact in contacts], dtype=float)
        self.strength = strength[key // self.grid.num_local]
        h, of_pairs = (self.grid.sizes(cells).min(axis=-1) for cells in (key % self.grid.num_local, pairs.cell))
        self._size = h
        self._stiffness, self._hold = STIFF / of_pairs * pairs.resistance, GRIP / h * self.mean(pairs.resistance)
        self.grips = any(contact.grips for contact in contacts)

    def begins(self) -> ContactState:
        """Return the state in which iterations begin: the pressures of the step before, and all sticks."""
        k, d = len(self.key), self.grid.dim
        none = np.zeros(k, dtype=bool)
        return ContactState(self.mean(self.pairs.pressure), np.zeros((k, d)), none, none, np.zeros((k, d)))

    def total(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (k, ...) of values (m, ...) in the conditions."""
        size = len(self.area)
        columns = values.reshape(len(values), int(np.prod(values.shape[1:], dtype=int))).T
        out = np.stack([sum_by(self.of, column, size) for column in columns], axis=1)
        return out.reshape(size, *values.shape[1:])

    def mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the means (k, ...) over the area of values (m, ...) in the conditions."""
        each = (slice(None), *(None,) * (values.ndim - 1))
        return self.total(self.pairs.area[each] * values) / self.area[each]

    def stiffness(self, state: ContactState) -> NDArray[np.float64]:
        """Return k (m,), Pa/m."""
        return state.raised * self._stiffness

    def touch(self, state: ContactState, at: Geometry) -> Touch:
        """Return the contact of the pairs where they are."""
        stiffness = self.stiffness(state)
        push = np.maximum(0.0, state.pressure[self.of] - stiffness * at.gap)
        touches = (push > 0) | (at.gap <= TOUCH * np.abs([self.grid.lower, self.grid.upper]).max())
        pressure = self.mean(push)
        on = np.zeros(len(self.area), dtype=bool)
        normal = self.mean(at.n)
        on[self.of[touches]] = True
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), TINY)
        friction = _, _, shear, *_ = self._friction(state, normal, self.mean(at.slip), pressure, on)
        force = self.pairs.area[:, None] * (push[:, None] * at.n + shear[self.of])
        return Touch(force, push, stiffness * touches, pressure, *friction)

    def _friction(self, state: ContactState, n: NDArray, slip: NDArray, pressure: NDArray, on: NDArray) -> tuple:
        """Return what a `Touch` has from `sticks` on; n, slip : (k, d), normals and means."""
        P = np.eye(n.shape[1]) - n[:, :, None] * n[:, None, :]
        hold = np.where(self.strength.any(axis=1), self._hold, 0.0) * on
        (mu, adhesion), slips = self.strength.T, state.slips
        trial = np.einsum("kij,kj->ki", P, self.mean(self.pairs.shear) * on[:, None] - hold[:, None] * slip)
        size, ramp = np.maximum(np.linalg.norm(trial, axis=1), TINY), RAMP * pressure < adhesion
        most = mu * pressure + np.minimum(adhesion, RAMP * pressure)
        onward = slips & (np.einsum("kd,kd->k", trial, state.slip) > 0)  # what turns back keeps its shear for now
        along = np.where(onward[:, None], trial / size[:, None], state.slip)
        turns = hold * np.where(slips, onward * most / size, 1.0)
        grip = turns[:, None, None] * (P - along[:, :, None] * along[:, None, :])
        rise = (mu + RAMP * ramp)[:, None] * along
        shear = np.where(slips[:, None], most[:, None] * along, trial)
        return ~slips & on, trial, shear, most, grip, rise

    def tangent(self, touch: Touch, at: Geometry) -> scipy.sparse.csr_matrix:
        """Return minus the derivative D (m d, m d) of the forces by w; that shears turn is left out."""
        pairs = self.pairs
        d = self.grid.dim
        m = len(self.pairs.cell)
        own = touch.stiff[:, None, None] * at.n[:, :, None] * at.n[:, None, :]
        if at.curvature is not None:
            own = own - touch.push[:, None, None] * at.curvature
        own = pairs.area[:, None, None] * own
        D = scipy.sparse.bsr_matrix((own, np.arange(m), np.arange(m + 1)), shape=(m * d, m * d)).tocsr()
        if not self.grips:
            return D
        # means over the conditions, of displacements and of pressures
        share = pairs.area / self.area[self.of]
        mean = scipy.sparse.csr_matrix((share, (self.of, np.arange(m))), shape=(len(self.area), m))
        wide = scipy.sparse.kron(mean, scipy.sparse.identity(d), format="csr")
        k, whole = len(self.area), self.area[:, None, None]
        blocks = (np.arange(k), np.arange(k + 1))
        grip = scipy.sparse.bsr_matrix((whole * touch.grip, *blocks), shape=(k * d, k * d))
        rise = scipy.sparse.bsr_matrix((whole * touch.rise[:, :, None], *blocks), shape=(k * d, k))
        pressed = (touch.stiff[:, None] * at.n)[:, None]
        slope = scipy.sparse.bsr_matrix((pressed, np.arange(m), np.arange(m + 1)), shape=(m, m * d))
        return (D + wide.T @ (grip @ wide + rise @ (mean @ slope))).tocsr()

    def slope(self, touch: Touch, at: Geometry, v: NDArray, adjoint: bool = False) -> NDArray[np.float64]:
        """Return D v (m, d), or its adjoint, for v (m, d): see `tangent`."""
        area, across = self.pairs.area[:, None], (touch.stiff * (at.n * v).sum(axis=1))[:, None]
        out = across * at.n
        if at.curvature is not None:
            out = out - touch.push[:, None] * np.einsum("mij,mj->mi", at.curvature, v)
        if self.grips:
            mean = self.mean(v)
            if adjoint:
                out = out + touch.stiff[:, None] * at.n * (touch.rise * mean).sum(axis=1)[self.of, None]
            else:
                out = out + (touch.rise * self.mean(across))[self.of]
            out = out + np.einsum("kji,kj->ki" if adjoint else "kij,kj->ki", touch.grip, mean)[self.of]
        return area * out

    def choose(self, state: ContactState, touch: Touch, sticks: bool) -> tuple[ContactState, bool]:
        """Choose what slips, and if asked for what sticks again; return the state, and whether the choice is new."""
        before = state.slips
        left = ~before & ~touch.sticks & state.stuck.any(axis=1)
        parts = state.parts | (left & state.resticks)
        bears = np.where(left[:, None], state.stuck, touch.trial)
        size = np.linalg.norm(bears, axis=1)
        goes_on = (size > (1 - NEAR) * touch.most) & (np.einsum("kd,kd->k", bears, state.slip) > 0)
        exceeds = (size > (1 + NEAR) * touch.most) & (sticks | ~state.resticks)
        slips = np.where(before, goes_on | parts if sticks else True, exceeds | left)
        new = (slips & (goes_on | ~before))[:, None]
        slip = np.where(new, bears / np.maximum(size, TINY)[:, None], slips[:, None] * state.slip)
        stuck = touch.trial * touch.sticks[:, None]
        changed = over_all(self.grid.comm, int((slips != before).sum())) > 0
        resticks = state.resticks | (before & ~slips)
        return replace(state, slip=slip, resticks=resticks, parts=parts, stuck=stuck), changed

    def augmented(self, state: ContactState, touch: Touch, x: NDArray[np.float64]) -> ContactState:
        """Return the state with the present pressures for lambda; the same where means penetrate little enough.

        x : (m, d), m, where the points are.  Raises NotConverged after as many rounds as are tried.
        """
        # what is a sliver of a cell has too little area to be pushed out by itself, and goes with its neighbours
        plane = self.total(self.pairs.area / self.grid.around(x))
        whole = np.minimum(1.0, plane / (SLIVER * self.grid.smallest_faces(self.key % self.grid.num_local)))
        off = whole * np.abs(touch.pressure - state.pressure) / self.mean(self.stiffness(state)) / self._size
        most = over_all(self.grid.comm, float(off.max(initial=0.0)), MPI.MAX)
        if most <= DEPTH:
            return state
        if state.rounds == ROUNDS:
            number = self.key // self.grid.num_local
            worst = np.flatnonzero(off == most)[:1]
            where = [f"{line(self.contacts[number[k]])}: at {x[self.of == k][0] + self.grid.base}" for k in worst]
            message = f"{''.join(where)} penetrates by {most:.2g} cells: does a wall hold the body there?"
            raise NotConverged(first(self.grid.comm, message if where else ""))
        # fluid, or what hardly changes its volume, resists more than k
        raised = state.raised * (STIFFER if most > SLOW * state.off else 1.0)
        return replace(state, pressure=touch.pressure, raised=raised, off=most, rounds=state.rounds + 1)

    def rounding(self, state: ContactState) -> NDArray[np.float64]:
        """Return what rounding of coordinates makes of the forces (m,), N, of the pairs."""
        return self.rounding_of_gap * self.stiffness(state) * self.pairs.area

    @property
    def rounding_of_gap(self) -> NDArray[np.float64] | float:
        """What rounding of coordinates makes of gaps, m; of the pairs (m,), or of all."""
        return 4 * EPSILON * self.pairs.reach

    def by_contact(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (contacts, ...) of values (m, ...) over each contact, of all processes."""
        columns = values.reshape(len(values), int(np.prod(values.shape[1:], dtype=int))).T
        sums = np.stack([sum_by(self.pairs.number, column, len(self.contacts)) for column in columns], axis=1)
        return over_all(self.grid.comm, sums).reshape(len(self.contacts), *values.shape[1:])

    def forces(self, touch: Touch, at: Geometry) -> NDArray[np.float64]:
        """Return forces and moments (contacts, d + 1) or, in 3D, (contacts, 6), N and N m, of all processes.

        In axisymmetry moments are zero, and the radial force is the sum of what acts outward.
        """
        force, arm = self.pairs.sign[self.pairs.number, None] * touch.force, at.arm * (not self.grid.axisymmetric)
        cross = np.cross(arm, force) if arm.shape[1] == 3 else arm[:, :1] * force[:, 1:] - arm[:, 1:] * force[:, :1]
        return self.by_contact(np.hstack([force, cross]))

    def tractions(self, touch: Touch) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pressures (m,) and shear tractions (m, d), Pa, of the pairs.

        What sticks keeps how it differs from the mean of its cell: averaged anew in every step it would creep.
        """
        old = self.pairs.shear
        off = (old - self.mean(old)[self.of]) * touch.sticks[self.of, None]
        return touch.push, touch.shear[self.of] + off
