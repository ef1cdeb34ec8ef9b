# SPDX-License-Identifier: MIT
"""Contact pressure by multipliers, Coulomb friction and adhesion by conditions, one a contact and cell.

With the gap g of a place, and one multiplier lambda a contact and cell, the contact pressure is

    p = <lambda - k (g + J lambda)>.

lambda is an unknown, and to be the mean of p in the cell (Alart and Curnier 1991): then g + J lambda = 0 in the mean of
what touches, whatever k is.
One multiplier a cell is more than a Q1 field on cut cells tells apart: J, the sum of the differences to cells beside
it, leaves no wave from cell to cell (Burman and Hansbo 2010, Comput. Methods Appl. Mech. Engrg. 199).  A pressure that
is linear along the surface has none.

Friction acts on the mean slip s of the cell in the step,
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
from functools import cached_property

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import EPSILON, NEAR, TINY
from mpm_dolfinx.contact.history import Rough
from mpm_dolfinx.contact.pairs import Geometry, Pairs
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.parallel.exchange import Exchange, over_all

JUMP = 0.01
"""Compliance of differences between cells, in units of (cell size) / (what resists)."""
GRIP = 6.0
"""k_t in units of (what resists) / (cell size): stiffer shears alternate from cell to cell, which displaces no node."""
TOUCH = 1e-13  # of the grid: what is nearer touches, but for rounding; light bodies press no deeper than 1e-8 cells
RAMP = 10.0  # adhesion over the normal pressure, at most


@dataclass(frozen=True, eq=False)
class ContactState:
    """What iterations change of k conditions, beside the displacements.

    pressure : (k,) lambda, Pa; way : (contacts,), m, by which loads have pushed tools in the step; slip : (k, d)
    direction of the shear of what slips, else zero; resticks : (k,) what has slipped, and stuck again; parts : (k,) and
    then has left; stuck : (k, d) traction, Pa, of what stuck at the last choice; begins : before the first iteration.
    """

    pressure: NDArray[np.float64]
    way: NDArray[np.float64]
    slip: NDArray[np.float64]
    resticks: NDArray[np.bool_]
    parts: NDArray[np.bool_]
    stuck: NDArray[np.float64]
    begins: bool = False

    @property
    def slips(self) -> NDArray[np.bool_]:
        """Which conditions (k,) slip."""
        return self.slip.any(axis=1)


@dataclass(frozen=True, eq=False)
class Touch:
    """The contact at some displacement: of m pairs, and of k conditions.

    force : (m, d) on the points, N; push : (m,) pressure, Pa; presses : (m,) what touches; pressure : (k,) mean of the
    pressure, Pa; sticks : (k,) what touches, and does not slip; trial, shear : (k, d) traction if all stuck, and as it
    is, Pa; most : (k,) what it may be, Pa; grip : (k, d, d) minus its derivative by the slip, Pa/m; rise : (k, d) that
    by the pressure.
    """

    force: NDArray[np.float64]
    push: NDArray[np.float64]
    presses: NDArray[np.bool_]
    pressure: NDArray[np.float64]
    sticks: NDArray[np.bool_]
    trial: NDArray[np.float64]
    shear: NDArray[np.float64]
    most: NDArray[np.float64]
    grip: NDArray[np.float64]
    rise: NDArray[np.float64]


class Jumps:
    """Differences of what conditions have to that of conditions in cells beside theirs.

    Parameters
    ----------
    grid
        Background grid.
    number, cell : (k,)
        Surface, and owned local cell of each condition; sorted by the first, then by the second.
    """

    def __init__(self, grid: Grid, number: NDArray[np.int64], cell: NDArray[np.int64]):
        beside = grid.beside(cell).reshape(len(cell), 2 * grid.dim)
        row, column = np.nonzero(beside >= 0)
        asked = grid.cell_number[beside[row, column]].astype(np.int64)
        self._travel = Exchange(grid.comm, grid.owner(asked))
        key = self._travel.send(number[row]) * grid.num_local + grid.local(self._travel.send(asked))
        own = number * grid.num_local + cell
        at = np.searchsorted(own, key)
        there = np.append(own, -1)[at] == key
        self._row, self._there, self._at = row, self._travel.back(there), np.where(there, at, 0)

    def __call__(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (k, n) of the differences of values (k, n)."""
        sent = values[self._at] if len(values) else np.zeros((len(self._at), values.shape[1]))
        off = self._there[:, None] * (values[self._row] - self._travel.back(sent))
        return np.stack([sum_by(self._row, column, len(values)) for column in off.T], axis=1)


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
        self.grid = grid = pairs.grid
        self.names = names
        self.contacts = contacts
        self.pairs = pairs
        key, self.of = np.unique(pairs.number * grid.num_local + pairs.cell, return_inverse=True)
        self.key = key
        """Contact and cell (k,) of the conditions, in one number."""
        self.number, self.cell = np.divmod(key, grid.num_local)
        self.area = sum_by(self.of, pairs.area, len(key))
        strength = np.array([(contact.friction, contact.adhesion) for contact in contacts], dtype=float)
        self.strength = strength[self.number]
        plane = self.total(pairs.area / grid.around(pairs.x))
        self._jumps = Jumps(grid, self.number, self.cell)
        face = grid.cell_volume / grid.h.max()
        self._compliance = JUMP * grid.h.min() * face / (self.mean(pairs.resistance) * plane)
        self.stiffness = 1 / (4 * (grid.dim - 1) * self._compliance)
        """k, Pa/m."""
        self.grips = any(contact.grips for contact in contacts)
        self._hold = GRIP / grid.h.min() * self.mean(pairs.resistance)

    def begins(self) -> ContactState:
        """Return the state in which iterations begin: with the pressures of the step before, and all sticks."""
        k, d = len(self.key), self.grid.dim
        none = np.zeros(k, dtype=bool)
        still = np.zeros(len(self.contacts))
        return ContactState(
            self.mean(self.pairs.pressure), still, np.zeros((k, d)), none, none, np.zeros((k, d)), begins=True
        )

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

    def _off(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return J of multipliers (k,), Pa, in m."""
        return self._compliance * self._jumps(values[:, None])[:, 0]

    def touch(self, state: ContactState, at: Geometry) -> Touch:
        """Return the contact of the pairs where they are."""
        gap = at.gap + self._off(state.pressure)[self.of]
        push = state.pressure[self.of] - self.stiffness[self.of] * gap
        presses = (push > 0) | (gap <= TOUCH * np.abs([self.grid.lower, self.grid.upper]).max())
        if state.begins and not self.grips:  # bodies have not given way yet: what pressed before does
            before = state.pressure[self.of] > 0
            some = self.by_contact(before[:, None].astype(float))[:, 0] > 0
            presses = np.where(some[self.pairs.number], before, presses)
        push = presses * push
        on = np.zeros(len(self.area), dtype=bool)
        on[self.of[presses]] = True
        pressure = self.mean(push)
        normal = self.mean(at.n)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), TINY)
        friction = _, _, shear, *_ = self._friction(state, normal, self.mean(at.slip), pressure, on)
        force = self.pairs.area[:, None] * (push[:, None] * at.n + shear[self.of])
        return Touch(force, push, presses, pressure, *friction)

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

    def trial(
        self, change: NDArray[np.float64], at: Geometry | None = None, apart: NDArray | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return by how much pressures (m,), Pa, would change if all touched, and the slip (m, d), m.

        change: of multipliers (k,), Pa; apart: by how much the places of pairs move apart (m, d), m.
        """
        out = (change - self.stiffness * self._off(change))[self.of]
        if apart is None:
            return out, np.zeros((len(out), self.grid.dim))
        return out - self.stiffness[self.of] * (at.n * apart).sum(axis=1), apart

    def answer(self, touch: Touch, trial: tuple[NDArray[np.float64], NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return by how much the pressures (k,) do, Pa."""
        return self.mean(touch.presses * trial[0])

    def acts(
        self, touch: Touch, at: Geometry, trial: tuple[NDArray[np.float64], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return by how much forces (m, d), N, on the points change, as far as they are smooth."""
        force = (touch.presses * trial[0])[:, None] * at.n
        if self.grips:
            shear = touch.rise * self.answer(touch, trial)[:, None]
            force = force + (shear - np.einsum("kij,kj->ki", touch.grip, self.mean(trial[1])))[self.of]
        return self.pairs.area[:, None] * force

    def tangent(self, touch: Touch, at: Geometry) -> scipy.sparse.csr_matrix:
        """Return minus the derivative D (m d, m d) of the forces by w; that shears turn is left out."""
        pairs = self.pairs
        d = self.grid.dim
        m = len(pairs.cell)
        stiff = pairs.area * self.stiffness[self.of] * touch.presses
        own = stiff[:, None, None] * at.n[:, :, None] * at.n[:, None, :]
        if at.curvature is not None:
            own = own - (pairs.area * touch.push)[:, None, None] * at.curvature
        D = scipy.sparse.bsr_matrix((own, np.arange(m), np.arange(m + 1)), shape=(m * d, m * d))
        if not self.grips:
            return D.tocsr()
        k = len(self.area)
        columns, blocks = np.arange(m * d), (np.arange(k), np.arange(k + 1))
        rows = (self.of[:, None] * d + np.arange(d)).ravel()
        share = np.repeat(pairs.area / self.area[self.of], d)
        along = scipy.sparse.csr_matrix((share, (rows, columns)), shape=(k * d, m * d))
        across = (stiff[:, None] * at.n).ravel(), (np.repeat(self.of, d), columns)
        grip = scipy.sparse.bsr_matrix((self.area[:, None, None] * touch.grip, *blocks), shape=(k * d, k * d))
        rise = scipy.sparse.bsr_matrix((touch.rise[:, :, None], *blocks), shape=(k * d, k))
        rises = rise @ scipy.sparse.csr_matrix(across, shape=(k, m * d))
        return (D + along.T @ (grip @ along + rises)).tocsr()

    def slope(self, touch: Touch, at: Geometry, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return D v (m, d) for v (m, d): see `tangent`."""
        out = -self.acts(touch, at, self.trial(np.zeros(len(self.area)), at, v))
        if at.curvature is not None:
            push = (self.pairs.area * touch.push)[:, None]
            out = out - push * np.einsum("mij,mj->mi", at.curvature, v)
        return out

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

    def unmet(self, state: ContactState, touch: Touch) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return by how much multipliers are off the pressures (k,), N, and what rounding may make of that."""
        return self.area * (touch.pressure - state.pressure), self.total(self.rounding)

    @cached_property
    def rounding(self) -> NDArray[np.float64]:
        """What rounding of coordinates makes of the forces (m,), N, of the pairs."""
        return 4 * EPSILON * self.pairs.reach * self.stiffness[self.of] * self.pairs.area

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
        return touch.pressure[self.of], touch.shear[self.of] + off
