# SPDX-License-Identifier: MIT
"""Tools that forces move: load-controlled tools without mass, and free tools with mass and weight.

The vector q contains the displacement of a tool in a step and, in 2D, its rotation.  The equation of motion is
`m (q - q^) / (g dt)^2 = l - sum A^T f`, as for nodes (`mechanics/inertia.py`).  The matrix m contains the mass and the
moment of inertia.  The predictor q^ is the motion without forces.  The step has the length dt, and g is the coefficient
of the time integration.  The vector l contains loads and weight, and f contains the contact forces on the points.  The
vector `A q` is the displacement of the contact positions on the tool.  The columns of A are e_x, e_y, and `e_z x r`
with the lever arm r.  A load-controlled tool moves along its load, until the reaction equals the load.

The unknowns q are eliminated (static condensation).  Let w be the relative displacements of the pairs, and dw their
increment.  D is minus the derivative of f with respect to w.  Forces rotate with the tool, so an increment dq changes f
by `(D A + E) dq`.  The columns of E are 0, 0, and `e_z x f`.  The force on the tool changes by the product of dq with

    A^T D A + [[0, e_z x F], [(e_z x F)^T, sum r . f]],     F = sum f.

S is the sum of this matrix and `m / (g dt)^2`.  Newton's method gives

    dq = S^-1 (l - sum A^T f - m (q - q^) / (g dt)^2 + sum (A^T D + E^T) dw).

With this dq, the forces on the points are `f + (D A + E) dq`.  The negative derivative of these forces with respect to
w is `D - (D A + E) S^-1 (A^T D + E^T)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import EPSILON, ROUND_OFF, SAME
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.conditions.acting import At, Shares
from mpm_dolfinx.contact.law import ROUNDS
from mpm_dolfinx.contact.problem import ContactProblem, Found, SubstepMotion, outer
from mpm_dolfinx.mechanics.inertia import Flight
from mpm_dolfinx.parallel.exchange import over_all


class Moved(NamedTuple):
    """Masses, motions and loads of the k tools of a stage, or zeros for tools that forces do not move."""

    mass: NDArray[np.float64]  # masses (k, q), kg, and moments of inertia, kg m^2; 0 for load-controlled tools
    guides: NDArray[np.float64]  # projections (k, q, q) on the motions that each tool can perform, see `motion_count`
    velocity: NDArray[np.float64]  # velocities at the start of the step (k, q), m/s and rad/s
    load: NDArray[np.float64]  # prescribed loads (k,), N
    direction: NDArray[np.float64]  # unit vectors of the loads (k, q)


class MotionEquation(NamedTuple):
    """Linearised equation of motion of the tools."""

    inverse: NDArray[np.float64]  # S^-1 (k, q, q)
    force: NDArray[np.float64]  # out-of-balance force (k, q), N and N m
    off: NDArray[np.float64]  # relative out-of-balance force (k,)
    shift: NDArray[np.float64]  # Newton increment (k, q), m and rad
    slides: NDArray[np.bool_]  # whether a tool in contact has neither mass nor stiffness (k,)


class MovedTools(ContactProblem):
    """Base class that extends `ToolLoads` by the motion of tools due to forces."""

    couples = True

    def __init__(self, *placed, moved: Moved):
        super().__init__(*placed)
        self._moved = moved
        self._moves = moved.guides.any(axis=(1, 2))
        self._forces = moved.load[:, None] * moved.direction
        self.flight = Flight(moved.velocity, moved.velocity)
        """Velocities and accelerations (k, q) of the tools at the start of the substep.

        Velocities are in m/s and rad/s, accelerations are in m/s^2 and rad/s^2.
        """
        self._rate, self._free = 0.0, np.zeros_like(moved.velocity)
        if not moved.mass[self._moves].any():
            self.now = self.now._replace(linear=self._first())

    def _first(self) -> Found:
        """Return the contact at the initial guess of the tool displacements."""
        motion, still = self.still, np.zeros_like(self.pairs.x)
        for _ in range(ROUNDS):
            found = self._find_at(still, motion)
            newton = (found.equation.shift * self._moved.direction).sum(axis=1)
            ahead = np.minimum(newton, self._bearing_displacement(found))
            before, motion = motion, self._limited(motion + ahead[:, None] * self._moved.direction)
            if np.abs(motion - before).max() <= EPSILON * self.grid.reach:
                break
        return self._find_at(still, motion)

    @cached_property
    def key(self) -> tuple[NDArray[np.int32], ...]:
        """For each tool that forces move, the local cells that contain its contact pairs."""
        return tuple(np.unique(self.pairs.cell[self.pairs.number == k]) for k in np.flatnonzero(self._moves))

    def joined(self, substeps: Sequence[MovedTools]) -> MovedTools:
        """See `Loads`."""
        out = copy(self)
        out.key = tuple(np.unique(np.concatenate(cells)) for cells in zip(*(one.key for one in substeps), strict=True))
        return out

    def begun(self, shares: Shares, earlier: SubstepMotion | None) -> MovedTools:
        """See `Loads`."""
        out = super().begun(shares, earlier)
        if earlier is not None:
            out.flight = earlier.flight
        if shares.gravity is not None:
            pulls = np.zeros_like(self._forces)
            pulls[:, : self.grid.dim] = shares.gravity
            out._forces = self._forces + np.einsum("kij,kj->ki", self._moved.guides, self._moved.mass * pulls)
        out._rate, out._free = shares.own**-2, out.flight.free(shares.own, shares.before)
        out.now = self.now._replace(linear=out._find_at(np.zeros_like(self.pairs.x), out._free))
        return out

    def flown(self, at: At) -> SubstepMotion:
        """See `Loads`."""
        flown = super().flown(at)
        return flown._replace(flight=self._after(at)) if self._rate else flown

    def tool_velocity(self, at: At) -> NDArray[np.float64]:
        """See `ContactProblem`."""
        free = self._moves[self.pairs.number, None]
        return np.where(free, self._carried(self.found(at), self._after(at).velocity), super().tool_velocity(at))

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """See `Loads`."""
        rubs, more = super().rubbing(at, v)
        free = self._moves[self.pairs.number]
        more -= float((self.found(at).touch.force * self.tool_velocity(at))[free].sum())
        pushed = float((self._forces * self._after(at).velocity).sum())
        return rubs, more + pushed * (self.grid.comm.rank == 0)

    def _after(self, at: At) -> Flight:
        """Return velocities and accelerations of the tools after the substep."""
        acceleration = self._rate * (self.found(at).motion - self._free)
        return self.flight.after(acceleration, self.shares.own, self.shares.before)

    def _find_at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Found:
        """See `ContactProblem`.  `Found.equation` is the equation of motion of the tools."""
        found = super()._find_at(w, motion)
        equation = self._equation(found)
        pulled = self._pulled(found, equation.shift) if found.acts else 0.0
        return found._replace(equation=equation, balanced=found.touch.force + pulled)

    def _carried(self, found: Found, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements `A q` of the contact positions on the tools."""
        d, of = self.grid.dim, q[self.pairs.number]
        return of[:, :d] + of[:, d:] * across(found.at.arm) if d == 2 else of

    def _pulled(self, found: Found, q: NDArray[np.float64], adjoint: bool = False) -> NDArray[np.float64]:
        """Return the forces `(D A + E) q` for motions q of the tools, or `(D^T A + E) q` if `adjoint`."""
        out = self.now.law.slope(found.touch, found.at, self._carried(found, q), adjoint)
        d = self.grid.dim
        return out + q[self.pairs.number, d:] * across(found.touch.force) if d == 2 else out

    def _onto(self, found: Found, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the contribution `A^T f` of each contact pair to the generalised forces on its tool."""
        if self.grid.dim > 2:
            return force
        return np.hstack([force, (across(found.at.arm) * force).sum(axis=1, keepdims=True)])

    def _sizes(self, found: Found, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return upper bounds of the absolute values of the contributions that `_onto` returns."""
        moment = np.linalg.norm(found.at.arm, axis=1) * np.linalg.norm(force, axis=1)
        return np.hstack([force, moment[:, None][:, : self.grid.dim == 2]])

    def _motion(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the motions of tools at relative displacements w of the pairs, by static condensation."""
        last, law = self.now.linear, self.now.law
        d = self.grid.dim
        dw = w - last.w
        moved = self._onto(last, law.slope(last.touch, last.at, dw))
        if d == 2:
            moved[:, d:] += (across(last.touch.force) * dw).sum(axis=1, keepdims=True)
        on = law.by_contact(np.column_stack([(dw != 0).any(axis=1), moved]))
        if not on[:, 0].any():
            return last.motion
        equation = last.equation
        return self._limited(last.motion + equation.shift + np.einsum("kij,kj->ki", equation.inverse, on[:, 1:]))

    def _limited(self, motion: NDArray[np.float64]) -> NDArray[np.float64]:
        """Limit the motion of load-controlled tools to one cell in a step."""
        if self._rate:
            return motion
        h, e = self.grid.least, self._moved.direction
        return np.clip((motion * e).sum(axis=1, keepdims=True), -h, h) * e

    def _bearing_displacement(self, found: Found) -> NDArray[np.float64]:
        """Return the displacement of each tool (k,), in m, at which a first pair bears the tool's load, or infinity."""
        law, state = self.now.law, self.now.state
        of = self.pairs.number
        along = (found.at.n * self._moved.direction[of, : self.grid.dim]).sum(axis=1)
        k = law.pair_stiffness(state)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = found.at.gap - state.pressure[law.of] / k + self._moved.load[of] / (k * self.pairs.area * along)
            far = np.where(along > 0, far / along, np.inf)
        nearest = np.full(len(self._moves), np.inf)
        np.minimum.at(nearest, of, far)
        return over_all(self.grid.comm, nearest, MPI.MIN)

    def _equation(self, found: Found) -> MotionEquation:
        """Return the linearised equation of motion of the tools."""
        law, d = self.now.law, self.grid.dim
        mass, guides, *_ = self._moved
        motions = guides.transpose(2, 0, 1)
        sums = np.zeros((*mass.shape, 4 + len(motions)))
        if found.acts:
            columns = [self._onto(found, self._pulled(found, q)) for q in motions]
            force = found.touch.force
            onto = self._onto(found, force)
            unknown = (law.rounding(self.now.state) * (found.touch.stiff > 0))[:, None]
            size, least = self._sizes(found, np.abs(force)), self._sizes(found, np.broadcast_to(unknown, force.shape))
            rows = np.stack([onto, size, least, *columns], axis=2)  # empty on processes without contact
            touches = np.repeat((found.touch.push > 0)[:, None, None], len(motions), axis=1)
            sums = law.by_contact(np.concatenate([rows, touches], axis=2))
        S = sums[:, :, 3:-1]
        if d == 2:  # the lever arm changes as the tool moves
            S[:, d, :d] += np.einsum("kij,ki->kj", guides[:, :d, :d], across(sums[:, :d, 0]))
        inertia = self._rate * mass
        inertial = inertia * (found.motion - self._free)
        S = guides @ S + inertia[:, None] * np.eye(len(motions))
        whole = np.trace(S, axis1=1, axis2=2)
        bears = inertia.any(axis=1) | (whole > 0)
        S = S + np.abs(whole)[:, None, None] * (np.eye(len(motions)) - guides)  # regular in fixed directions too
        inverse = np.zeros_like(S)
        inverse[bears] = guides[bears] @ np.linalg.inv(S[bears])
        off = self._forces - inertial - np.einsum("kij,kj->ki", guides, sums[:, :, 0])
        scale = np.maximum(np.abs([self._forces, inertial]).max(axis=0), guides.any(axis=2) * sums[:, :, 1])
        scale[:, :d] = np.linalg.norm(scale[:, :d], axis=1, keepdims=True)
        rounding = sums[:, :, 2] + ROUND_OFF * inertia * (np.abs(found.motion) + np.abs(self._free))
        scale = np.maximum(scale, rounding / SAME)
        share = (np.abs(off) / np.where(scale > 0, scale, 1.0)).max(axis=1)
        shift = np.einsum("kij,kj->ki", inverse, off)
        slides = self._moves & ~bears & (sums[:, 0, -1] > 0)
        if not self._rate:  # a tool without contact moves until a point bears the load; slip alone has no stiffness
            e = self._moved.direction
            seeks = self._moves & ~bears & ~slides & ((off * e).sum(axis=1) > 0)
            shift[seeks] = (np.minimum(self._bearing_displacement(found), self.grid.least)[:, None] * e)[seeks]
        return MotionEquation(inverse, off, share * self._moves, shift, slides)

    def coupling(self, at: At) -> PETSc.Mat | None:
        """See `Loads`."""
        K = super().coupling(at)
        found = self.found(at)
        inverse = found.equation.inverse
        for k in np.flatnonzero(self._moves) if found.acts else ():
            on = (np.arange(len(inverse)) == k)[:, None]
            for e, to in zip(np.eye(inverse.shape[1]), inverse[k].T, strict=True):
                if to.any():
                    pulled = self._pulled(found, on * to), self._pulled(found, on * e, adjoint=True)
                    sides = (self._nodal(at.unknowns, values) for values in pulled)
                    # slightly less, because a massless tool adds no stiffness to a body that only the tool holds
                    K.axpy(SAME - 1.0, outer(*sides), PETSc.Mat.Structure.UNKNOWN)
        return K

    def settle(self, at: At, sticks: bool) -> bool:
        """See `Loads`."""
        found = self.found(at)
        before, changed = self.now.state, super().settle(at, sticks)
        same = self.now.state is before
        self.now = self.now._replace(linear=found if same else self._find_at(found.w, found.motion))
        self._found((self.now, at.unknowns, at.u[at.unknowns.owned]), lambda: self.now.linear, self.grid.comm)
        return changed

    def augment(self, at: At) -> bool:
        """See `Loads`.  Augmentation continues until the tools are in equilibrium."""
        if super().augment(at):
            return True
        found = self.found(at)
        equation = found.equation
        wrong = equation.off > SAME
        if not wrong.any():
            return False
        if not self._rate:
            self._check_bears(found, wrong)
        motion = self._limited(found.motion + wrong[:, None] * equation.shift)
        self.now = self.now._replace(linear=self._find_at(found.w, motion))
        return True

    def _check_bears(self, found: Found, wrong: NDArray[np.bool_]) -> None:
        """Raise NotConverged if no motion of a tool balances its load.  `wrong` (k,) flags the tools out of balance."""
        load, e = self._moved.load, self._moved.direction
        far = (found.motion * e).sum(axis=1) >= (1 - SAME) * self.grid.least
        for k in np.flatnonzero(wrong & (far | found.equation.slides))[:1]:
            reaction = load[k] - found.equation.force[k] @ e[k]
            why = f"the reaction is {reaction:.6g} N for any displacement; do the bodies constrain the tool?"
            if reaction == 0:
                why = "there is no contact within a cell; does the tool start at the surface of a body?"
            raise NotConverged(f"{line(self.now.law.contacts[k])}: load {load[k]:.6g} N, but {why}")

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """See `Loads`.  For free tools, results include velocity (m/s), rotation (rad) and angular velocity (rad/s)."""
        out = super().outcome(at)
        if not self._rate:
            return out
        d, names = self.grid.dim, self.now.law.names
        velocity = self._after(at).velocity
        out["tool_velocity"] = {names[k]: velocity[k, :d] for k in np.flatnonzero(self._moves)}
        rotating = np.flatnonzero(self._moved.guides[:, -1, -1]) if d == 2 else ()
        if len(rotating):
            motion = self.before + self.found(at).motion
            out["tool_rotation"] = {names[k]: np.array(motion[k, d]) for k in rotating}
            out["tool_spin"] = {names[k]: np.array(velocity[k, d]) for k in rotating}
        return out


def across(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross products of e_z with vectors v (m, 2)."""
    return np.stack([-v[:, 1], v[:, 0]], axis=1)
