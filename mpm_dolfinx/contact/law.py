# SPDX-License-Identifier: MIT
"""Contact law: pressure, Coulomb friction and adhesion.

A *contact pair* is a quadrature point on a surface with its opposite position.  All pairs of one contact in one cell
form a *condition*.  At a pair with gap g, the contact pressure p is

    p = <lambda + q - k_s g>,     A q = (1 - k_s / k) int (p - lambda) dA.

<...> is the positive part, and the integral is over the area A of the condition.  If all pairs touch, this means

    p = lambda - k g_m - k_s (g - g_m)

with the mean gap g_m.  For elastic bodies, and between groups, k_s equals the penalty stiffness k.  Tools on soils that
yield have a lower stiffness k_s, see `holding`, because several conditions lock a cell of nearly incompressible soil.
The pressures derive from a convex energy.

Each condition has one multiplier lambda.  In the first iteration, lambda is the pressure after the previous step.
Augmentation (Uzawa's method) updates lambda until the penetrated volume in each cell is below `DEPTH` cell volumes.
Below tools on soils that yield, single pairs may be deeper, by p / k_s.

With inertia, k contains the part k_i = `STIFF` rho h / (GAMMA dt)^2, which resists only the motion in the step.  The
term k g is then k g - k_i min(0, g_0), with the gap g_0 at the start of the step.  Otherwise a short step would remove
an earlier penetration, with the velocity g_0 / dt.

Each condition has one shear traction t.  Radial return gives

    t = P (t_n - k_t s),     |t| <= mu p + min(adhesion, 10 p).

The mean slip of the pairs in the step is s, and t_n is their mean shear traction after the previous step.  P is the
projection on the tangent plane, mu is Coulomb's coefficient, and k_t is the elastic stiffness in stick.

At the start of a substep, all conditions stick.  The set of slipping conditions is updated between Newton steps
(active-set method).  A condition returns to stick if its slip reverses and the forces are near equilibrium.  A
condition without pressure slips.  If a condition has returned to stick and then opens, the condition slips until the
pairs are updated or the substep ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import EPSILON, NEAR, ROUND_OFF, TINY
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.contact.history import Rough
from mpm_dolfinx.contact.pairs import Geometry, Pairs
from mpm_dolfinx.grid.grid import means_of_rows, sum_by, sums_of_rows
from mpm_dolfinx.parallel.exchange import first, over_all

STIFF = 100.0
"""The stiffness k is this factor times the modulus `Pairs.resistance`, divided by the cell size.  Sensitivity (scene
"contact" of tests/plateaus.py): half this value changes the result by 1.9e-03, and twice this value by 1.3e-03.  Finer
cells change it by 1.1e-02.  With inertia, `rho h^2 / (GAMMA dt)^2` is added to the modulus.
"""
GRIP = 6.0
"""The stiffness k_t is this factor times the modulus `Pairs.resistance`, divided by the cell size.  Sensitivity (scene
"contact" of tests/plateaus.py): half this value changes the result by 3.6e-03, and twice this value by 1.9e-03.  Finer
cells change it by 1.1e-02.
"""
DEPTH = 5e-4
"""Allowed mean penetration in a cell, divided by the cell size.  Sensitivity (scene "contact" of tests/plateaus.py):
half this value changes the result by 2.5e-03, and twice this value by 2.6e-03.  Finer cells change it by 1.1e-02.
"""
ROUNDS = int(-np.log2(DEPTH * DEPTH))
"""Largest number of augmentations, and largest number of updates of the contact pairs, in a substep."""
BEGIN = 1.0, np.inf, 0.0, 0.0  # initial values of `ContactState.updates`
STIFFER = 10.0
"""The stiffness k is multiplied by this factor if an augmentation does not halve the penetration."""
RAMP = 10.0
"""Largest ratio of the mobilised adhesion to the normal pressure.  Source: definition, see `Tool`."""


@dataclass(frozen=True, eq=False)
class ContactState:
    """State of the contact iterations in a substep, for the k conditions."""

    pressure: NDArray[np.float64]  # multiplier lambda (k,), Pa
    slip: NDArray[np.float64]  # direction of slip, zero in stick (k, d)
    resticks: NDArray[np.bool_]  # whether the condition has returned from slip to stick (k,)
    parts: NDArray[np.bool_]  # whether the condition has opened after a return to stick (k,)
    stuck: NDArray[np.float64]  # shear traction in stick at the last update of slip (k, d), Pa
    # (k, 4): factor on the stiffness k, penetration in cell sizes after the last augmentation, number of augmentations,
    updates: NDArray[np.float64]  # number of updates of the pairs; the same for all conditions of a connected part

    @property
    def slips(self) -> NDArray[np.bool_]:
        """Whether each condition (k,) slips."""
        return self.slip.any(axis=1)


@dataclass(frozen=True, eq=False)
class Touch:
    """Contact forces on m pairs and k conditions, and derivatives of these forces."""

    force: NDArray[np.float64]  # force on the points (m, d), N
    push: NDArray[np.float64]  # pressure (m,), Pa
    stiff: NDArray[np.float64]  # stiffness k_s (m,), Pa/m; 0 if the pair does not touch
    # minus the derivative of the pressure of a pair with respect to another gap of the condition, per area of the other
    # pair (k,), Pa/m^d, if both touch; minus the derivative with respect to the own gap is `stiff` plus such a term
    joint: NDArray[np.float64]
    pressure: NDArray[np.float64]  # mean pressure (k,), Pa
    sticks: NDArray[np.bool_]  # whether the condition is in contact and sticks (k,)
    trial: NDArray[np.float64]  # shear traction in stick (k, d), Pa
    shear: NDArray[np.float64]  # shear traction (k, d), Pa
    most: NDArray[np.float64]  # shear strength (k,), Pa
    grip: NDArray[np.float64]  # minus the derivative of the shear traction with respect to slip (k, d, d), Pa/m
    by_pressure: NDArray[np.float64]  # derivative of the shear traction with respect to the pressure (k, d)


class ContactLaw:
    """Contact pressures, shear tractions and their derivatives in a substep."""

    def __init__(self, names: Sequence[str], contacts: Sequence[Rough], pairs: Pairs):
        self.grid = pairs.grid
        self.names = names
        self.contacts = contacts
        self.pairs = pairs
        key, self.of = np.unique(pairs.number * self.grid.num_local + pairs.cell, return_inverse=True)
        self.key = key
        """Number (k,) that identifies each condition: `i * num_local + c`, with contact index i and local cell c."""
        self.cell = key % self.grid.num_local
        self.area = sum_by(self.of, pairs.area, len(key))
        strength = np.array([(contact.friction, contact.adhesion) for contact in contacts], dtype=float)
        self.strength = strength[key // self.grid.num_local]
        h, of_pairs = (self.grid.sizes(cells).min(axis=-1) for cells in (self.cell, pairs.cell))
        self._size = h
        inertial = STIFF * of_pairs * pairs.inertia
        stiffness = STIFF / of_pairs * pairs.resistance + inertial
        resistance, holding, self._stiffness = self.mean(np.array([pairs.resistance, pairs.holding, stiffness]).T).T
        self._modulus, self._hold = STIFF / h * resistance, GRIP / h * resistance
        self._share = holding / np.maximum(resistance, TINY)
        self._of_pairs = (self._stiffness * self._share)[self.of]
        self._rounding = ROUND_OFF * np.abs([self.grid.lower, self.grid.upper]).max()
        self._sunk = np.where(inertial > 0, pairs.sunk, 0.0)
        self._kept = inertial / stiffness * self._sunk
        self.frictional = any(contact.frictional for contact in contacts)

    def begins(self) -> ContactState:
        """Return the state at the start of a substep: lambda from the previous step, and all conditions stick."""
        k, d = len(self.key), self.grid.dim
        none, zero = np.zeros(k, dtype=bool), np.zeros((k, d))
        return ContactState(self.mean(self.pairs.pressure), zero, none, none, zero, np.full((k, 4), BEGIN))

    def mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the area-weighted means (k, ...) of values (m, ...) over the pairs of each condition."""
        return means_of_rows(self.of, self.pairs.area, values, len(self.area))

    def stiffness(self, state: ContactState) -> NDArray[np.float64]:
        """Return the stiffness k (k,), in Pa/m, of the conditions."""
        return state.updates[:, 0] * self._stiffness

    def pair_stiffness(self, state: ContactState) -> NDArray[np.float64]:
        """Return the stiffness k_s (m,), in Pa/m, of the pairs."""
        return state.updates[self.of, 0] * self._of_pairs

    def touch(self, state: ContactState, at: Geometry) -> Touch:
        """Return the contact forces on the pairs, and the derivatives of these forces."""
        push, touches, joint = self._pressures(state, at.gap)
        on = np.zeros(len(self.area), dtype=bool)
        if joint is None:
            grip = np.zeros((len(on), self.grid.dim, self.grid.dim))
            none, rows = grip[:, 0, 0], grip[:, 0]
            return Touch(push[:, None] * at.n, push, push, none, none, on, rows, rows, none, grip, rows)
        pressure = self.mean(push)
        normal = self.mean(at.n)
        on[self.of[touches]] = True
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), TINY)
        means = self.mean(at.slip), self.mean(at.shear)
        friction = _, _, shear, *_ = self._friction(state, normal, *means, pressure, on)
        force = self.pairs.area[:, None] * (push[:, None] * at.n + shear[self.of])
        return Touch(force, push, self.pair_stiffness(state) * touches, joint, pressure, *friction)

    def _pressures(self, state: ContactState, gap: NDArray) -> tuple[NDArray, NDArray[np.bool_], NDArray | None]:
        """Return pressures (m,) at gaps (m,), which pairs (m,) touch, and `Touch.joint` (k,), or None without touch."""
        of, area = self.of, self.pairs.area
        k = len(self.area)
        more, parted = 1 / np.maximum(self._share, TINY) - 1, self.area
        at = self.pair_stiffness(state) * (gap - self._kept)
        bears, push = np.zeros(len(gap), dtype=bool), state.pressure / (1 + more)  # lambda + q if no pair touches
        # Newton's method; lambda + q increases, so no pair parts
        while np.logical_or.reduce(new := (at < push[of]) & ~bears):
            bears |= new
            parted = sum_by(of, area * ~bears, k)
            q = -more * (sum_by(of, area * bears * at, k) + parted * state.pressure)
            push = state.pressure + q / np.maximum(self.area + more * parted, TINY)
        # gaps within rounding count as contact, because light bodies penetrate less than 1e-8 cells
        touches = bears | (gap - self._sunk <= self._rounding)
        if not np.logical_or.reduce(touches):
            return np.zeros(len(gap)), touches, None
        whole = np.maximum(self.area + more * sum_by(of, area * ~touches, k), TINY)
        return bears * np.maximum(0.0, push[of] - at), touches, self.stiffness(state) * self._share * more / whole

    def _friction(
        self, state: ContactState, n: NDArray, slip: NDArray, old: NDArray, pressure: NDArray, on: NDArray
    ) -> tuple:
        """Return the last six attributes of `Touch`, `sticks` to `by_pressure`."""
        P = np.eye(n.shape[1]) - n[:, :, None] * n[:, None, :]
        hold = np.where(self.strength.any(axis=1), self._hold, 0.0) * on
        (mu, adhesion), slips = self.strength.T, state.slips
        trial = np.einsum("kij,kj->ki", P, old * on[:, None] - hold[:, None] * slip)
        size, ramp = np.maximum(np.linalg.norm(trial, axis=1), TINY), RAMP * pressure < adhesion
        most = mu * pressure + np.minimum(adhesion, RAMP * pressure)
        onward = slips & (np.einsum("kd,kd->k", trial, state.slip) > 0)  # else t is constant until the next update
        along = np.where(onward[:, None], trial / size[:, None], state.slip)
        scale = hold * np.where(slips, onward * most / size, 1.0)
        grip = scale[:, None, None] * (P - along[:, :, None] * along[:, None, :])
        by_pressure = (mu + RAMP * ramp)[:, None] * along
        shear = np.where(slips[:, None], most[:, None] * along, trial)
        return ~slips & on, trial, shear, most, grip, by_pressure

    def tangent(self, touch: Touch, at: Geometry) -> scipy.sparse.csr_matrix:
        """Return the matrix D (m d, m d): minus the derivative of forces with respect to relative displacements."""
        d, area = self.grid.dim, self.pairs.area
        m, k = len(self.of), len(self.area)
        own = touch.stiff[:, None, None] * at.n[:, :, None] * at.n[:, None, :]
        if at.curvature is not None:
            own = own - touch.push[:, None, None] * at.curvature
        own = area[:, None, None] * own
        D = scipy.sparse.bsr_matrix((own, np.arange(m), np.arange(m + 1)), shape=(m * d, m * d)).tocsr()
        shared = touch.joint.any()
        if not (shared or self.frictional):
            return D
        normal = scipy.sparse.bsr_matrix((at.n[:, None], np.arange(m), np.arange(m + 1)), shape=(m, m * d))
        total = scipy.sparse.csr_matrix((area, (self.of, np.arange(m))), shape=(k, m))  # integrals over conditions
        touches = (touch.stiff > 0).astype(float)
        touching = total @ scipy.sparse.diags(touches) @ normal
        if shared:
            D = D + touching.T @ scipy.sparse.diags(touch.joint) @ touching
        if not self.frictional:
            return D.tocsr()
        wide = scipy.sparse.kron(scipy.sparse.diags(1 / np.maximum(self.area, TINY)) @ total, scipy.sparse.identity(d))
        blocks = (np.arange(k), np.arange(k + 1))
        grip = scipy.sparse.bsr_matrix((self.area[:, None, None] * touch.grip, *blocks), shape=(k * d, k * d))
        by_pressure = scipy.sparse.bsr_matrix((touch.by_pressure[:, :, None], *blocks), shape=(k * d, k))
        pressed = total @ scipy.sparse.diags(touch.stiff) @ normal
        pressed = pressed + scipy.sparse.diags(touch.joint * (total @ touches)) @ touching
        return (D + wide.T @ (grip @ wide + by_pressure @ pressed)).tocsr()

    def _pressed(self, touch: Touch, closing: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the linearised increases (m,) of the pressures, if gaps decrease by `closing` (m,)."""
        touches = touch.stiff > 0
        joint = touch.joint * sum_by(self.of, self.pairs.area * touches * closing, len(self.area))
        return touch.stiff * closing + touches * joint[self.of]

    def slope(self, touch: Touch, at: Geometry, v: NDArray, adjoint: bool = False) -> NDArray[np.float64]:
        """Return `D v` for vectors v (m, d) and the matrix D of `tangent`, or `D^T v` if `adjoint`."""
        across = self._pressed(touch, (at.n * v).sum(axis=1))[:, None]
        out = across * at.n
        if at.curvature is not None:
            out = out - touch.push[:, None] * np.einsum("mij,mj->mi", at.curvature, v)
        if self.frictional:
            mean = self.mean(v)
            if adjoint:
                out = out + self._pressed(touch, (touch.by_pressure * mean).sum(axis=1)[self.of])[:, None] * at.n
            else:
                out = out + (touch.by_pressure * self.mean(across))[self.of]
            out = out + np.einsum("kji,kj->ki" if adjoint else "kij,kj->ki", touch.grip, mean)[self.of]
        return self.pairs.area[:, None] * out

    def choose(self, state: ContactState, touch: Touch, sticks: bool) -> tuple[ContactState, bool]:
        """Update the set of slipping conditions.  Return the new state, and whether this set has changed.

        If `sticks`, slipping conditions may return to stick.
        """
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

    def augmented(self, state: ContactState, touch: Touch, largest: Callable[[NDArray], NDArray]) -> ContactState:
        """Augment lambda in connected parts of the bodies where penetrations exceed `DEPTH`.  Return the new state.

        `largest`: function that replaces each of k values by the largest value in its connected part.  More than
        `ROUNDS` augmentations raise NotConverged.
        """
        # penetrations count by volume, because small parts of faces follow their neighbours
        x = self.pairs.x
        plane = self.pairs.area / np.maximum(self.grid.around(x), TINY)  # both are 0 on the axis
        plane = sum_by(self.of, plane, len(self.area))
        whole = np.minimum(1.0, plane / self.grid.smallest_faces(self.cell))
        # with inertia the allowed penetration decreases as the stiffness increases
        stiffness = state.updates[:, 0] * self._modulus
        off = whole * np.abs(touch.pressure - state.pressure) / stiffness / self._size
        most = largest(off)
        if not over_all(self.grid.comm, int((most > DEPTH).sum())):
            return state
        message = ""
        for k in np.flatnonzero((most > DEPTH) & (off == most) & (state.updates[:, 2] == ROUNDS))[:1]:
            name, where = line(self.contacts[self.key[k] // self.grid.num_local]), x[self.of == k][0] + self.grid.base
            message = f"{name}: penetrates by {most[k]:.2g} cells at {where}; does a wall fix the body there?"
        if message := first(self.grid.comm, message):
            raise NotConverged(message)
        # if penetrations decrease slowly, the pore fluid, or a nearly incompressible body, is stiffer than k
        updates = state.updates + np.array([0, 0, 1, 0])
        updates[:, 0] *= np.where(most > updates[:, 1] / 2, STIFFER, 1.0)
        updates[:, 1] = most
        updates = np.where(most[:, None] > DEPTH, updates, state.updates)
        return replace(state, pressure=np.where(most > DEPTH, touch.pressure, state.pressure), updates=updates)

    def rounding(self, state: ContactState) -> NDArray[np.float64]:
        """Return the rounding errors (m,), in N, of the forces on the pairs."""
        of_gap = 4 * EPSILON * self.pairs.largest_coordinate
        return of_gap * self.stiffness(state)[self.of] * self.pairs.area

    def by_contact(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (contacts, ...) of values (m, ...) over the pairs of each contact, on all processes."""
        return over_all(self.grid.comm, sums_of_rows(self.pairs.number, values, len(self.contacts)))

    def forces(self, touch: Touch, at: Geometry) -> NDArray[np.float64]:
        """Return the forces (N) and moments (N m) on the bodies: (contacts, 3) in 2D, and (contacts, 6) in 3D.

        In axisymmetry, the radial force is the integral of the radial traction, and moments are zero.
        """
        force, arm = self.pairs.sign[:, None] * touch.force, at.arm * (not self.grid.axisymmetric)
        cross = np.cross(arm, force) if arm.shape[1] == 3 else arm[:, :1] * force[:, 1:] - arm[:, 1:] * force[:, :1]
        return self.by_contact(np.hstack([force, cross]))

    def tractions(self, touch: Touch, at: Geometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pressures (m,) and shear tractions (m, d), in Pa, of the pairs."""
        off = (at.shear - self.mean(at.shear)[self.of]) * touch.sticks[self.of, None]
        return touch.push, touch.shear[self.of] + off
