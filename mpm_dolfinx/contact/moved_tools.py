# SPDX-License-Identifier: MIT
"""Free tools: rigid tools with a mass, which are moved by weight, loads and contact forces.

The motion q of a tool in a step is its displacement and, in 2D, its rotation.  The equation of motion has the form of
that for nodes (`mechanics/inertia.py`): `m (q - q^) / (g dt)^2 = l - sum A^T f`.  Here m contains the mass and the
moment of inertia, and q^ is the motion without forces in the step.  The length of the step is dt, and g is the time
weight of the substep's rate.  The vector l contains loads and weight, and f are the contact forces on the points.  The
product `A q` is the displacement of the contact positions on the tool.  The columns of A are e_x, e_y, and `e_z x r`
with the lever arm r.

The unknowns q are eliminated (static condensation).  Let w be the displacements of the points, and let dw be their
increment.  D is minus the derivative of f with respect to w.  Forces rotate with the tool, so f changes by
`(D A + E) dq`, where E has the columns 0, 0, `e_z x f`.  The force on the tool changes by the product of dq with

    A^T D A + [[0, e_z x F], [(e_z x F)^T, sum r . f]],     F = sum f.

Let S be the sum of this matrix and `m / (g dt)^2`.  Newton's method then gives

    dq = S^-1 (l - sum A^T f - m (q - q^) / (g dt)^2 + sum (A^T D + E^T) dw).

The forces on the points are therefore `f + (D A + E) S^-1 (...)`.  Minus the derivative of these forces is
`D - (D A + E) S^-1 (A^T D + E^T)`.
"""

from __future__ import annotations

from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import ROUND_OFF, SAME
from mpm_dolfinx.conditions.acting import At, Shares
from mpm_dolfinx.contact.problem import ContactProblem, Found, SubstepMotion, outer
from mpm_dolfinx.mechanics.inertia import Flight


class FreeMotion(NamedTuple):
    """Motion of free tools as a linear function of the relative displacements of contact pairs."""

    w: NDArray[np.float64]  # relative displacements of the pairs (m, d), m
    motion: NDArray[np.float64]  # motion of the tools at w (k, q), m and rad
    shift: NDArray[np.float64]  # Newton increment of `motion` (k, q), m and rad
    inverse: NDArray[np.float64]  # S^-1 (k, q, q); its product with further forces is added to the motion
    found: Found  # contact at w


class MotionEquation(NamedTuple):
    """Linearised equation of motion of free tools."""

    inverse: NDArray[np.float64]  # S^-1 (k, q, q)
    off: NDArray[np.float64]  # relative out-of-balance force (k,)
    shift: NDArray[np.float64]  # Newton increment (k, q), m and rad


class FreeTools(ContactProblem):
    """Base class that adds the motion of free tools to `ToolLoads`.

    `placed`: arguments of `ToolLoads`.
    `mass` (k, q): masses, in kg, and moments of inertia, in kg m^2; 0 for tools that are not free.
    `guides` (k, q, q): projections on the motions that each tool can perform, see `motion_count`.
    `velocity` (k, q): velocities at the start of the step, in m/s and rad/s.
    `pushes` (k, q): prescribed loads, in N and N m.
    """

    couples = True

    def __init__(self, *placed, mass: NDArray, guides: NDArray, velocity: NDArray, pushes: NDArray):
        super().__init__(*placed)
        self._mass, self._guides = mass, guides
        self._free_tools = mass[:, 0] > 0
        self._pushes = pushes
        self.flight = Flight(velocity, velocity)
        """Velocities and accelerations (k, q) of the tools at the start of the substep.

        Velocities are in m/s and rad/s, accelerations are in m/s^2 and rad/s^2.
        """
        self._rate, self._free = 0.0, np.zeros_like(velocity)

    def begun(self, shares: Shares, earlier: SubstepMotion | None) -> FreeTools:
        """See `Loads`."""
        out = super().begun(shares, earlier)
        if earlier is not None:
            out.flight = earlier.flight
        if shares.gravity is not None:
            pulls = np.zeros_like(self._pushes)
            pulls[:, : self.grid.dim] = shares.gravity
            out._pushes = self._pushes + np.einsum("kij,kj->ki", self._guides, self._mass * pulls)
        out._rate, out._free = shares.own**-2, out.flight.free(shares.own, shares.before)
        out.now = self.now._replace(linear=out._free_motion(np.zeros_like(self.pairs.x), out._free))
        return out

    def flown(self, at: At) -> SubstepMotion:
        """See `Loads`."""
        return super().flown(at)._replace(flight=self._after(at))

    def tool_velocity(self, at: At) -> NDArray[np.float64]:
        """See `ContactProblem`."""
        free = self._free_tools[self.pairs.number, None]
        return np.where(free, self._moved(self.found(at), self._after(at).velocity), super().tool_velocity(at))

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """See `Loads`.  Contact forces change the energy of free tools, and loads do work on free tools."""
        rubs, more = super().rubbing(at, v)
        free = self._free_tools[self.pairs.number]
        more -= float((self.found(at).touch.force * self.tool_velocity(at))[free].sum())
        pushed = float((self._pushes * self._after(at).velocity).sum())
        return rubs, more + pushed * (self.grid.comm.rank == 0)

    def _after(self, at: At) -> Flight:
        """Return velocities and accelerations of the tools after the substep."""
        acceleration = self._rate * (self.found(at).motion - self._free)
        return self.flight.after(acceleration, self.shares.own, self.shares.before)

    def _find_at(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> Found:
        found = super()._find_at(w, motion)
        if motion.ndim == 1:  # before the first substep
            return found
        return found._replace(balanced=found.touch.force + self._pulled(found, self._equation(found).shift))

    def _moved(self, found: Found, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements `A q` of the contact positions on the tools."""
        d, of = self.grid.dim, q[self.pairs.number]
        return of[:, :d] + of[:, d:] * across(found.at.arm) if d == 2 else of

    def _pulled(self, found: Found, q: NDArray[np.float64], adjoint: bool = False) -> NDArray[np.float64]:
        """Return the forces `(D A + E) q` for motions q of the tools, with `D^T` in place of D if `adjoint`."""
        out = self.now.law.slope(found.touch, found.at, self._moved(found, q), adjoint)
        d = self.grid.dim
        return out + q[self.pairs.number, d:] * across(found.touch.force) if d == 2 else out

    def _onto(self, found: Found, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the generalised forces `A^T f` on the tools."""
        if self.grid.dim > 2:
            return force
        return np.hstack([force, (across(found.at.arm) * force).sum(axis=1, keepdims=True)])

    def _sizes(self, found: Found, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return upper bounds of the generalised forces on the tools, with lever arm times force for a moment."""
        moment = np.linalg.norm(found.at.arm, axis=1) * np.linalg.norm(force, axis=1)
        return np.hstack([force, moment[:, None][:, : self.grid.dim == 2]])

    def _motion(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the motions of tools at given relative displacements, from the last linearisation."""
        last = self.now.linear
        law = self.now.law
        dw = w - last.w
        moved = self._onto(last.found, law.slope(last.found.touch, last.found.at, dw))
        d = self.grid.dim
        if d == 2:
            moved[:, d:] += (across(last.found.touch.force) * dw).sum(axis=1, keepdims=True)
        on = law.by_contact(np.column_stack([(dw != 0).any(axis=1), moved]))
        if not on[:, 0].any():
            return last.motion
        return last.motion + last.shift + np.einsum("kij,kj->ki", last.inverse, on[:, 1:])

    def _free_motion(self, w: NDArray[np.float64], motion: NDArray[np.float64]) -> FreeMotion:
        """Return the linearised motion of the tools."""
        found = self._find_at(w, motion)
        equation = self._equation(found)
        return FreeMotion(w, motion, equation.shift, equation.inverse, found)

    def _equation(self, found: Found) -> MotionEquation:
        """Return the linearised equation of motion of the tools."""
        law = self.now.law
        d = self.grid.dim
        motions = self._guides.transpose(2, 0, 1)
        columns = [self._onto(found, self._pulled(found, q)) for q in motions]
        force = found.touch.force
        onto = self._onto(found, force)
        unknown = (law.rounding(self.now.state) * (found.touch.stiff > 0))[:, None]
        size, least = self._sizes(found, np.abs(force)), self._sizes(found, np.broadcast_to(unknown, force.shape))
        rows = np.stack([onto, size, least, *columns], axis=2)  # empty on processes without contact
        sums = law.by_contact(rows.reshape(len(onto), int(np.prod(rows.shape[1:]))))
        sums = sums.reshape(len(motions[0]), len(motions), 3 + len(columns))
        S = sums[:, :, 3:]
        if d == 2:  # the lever arm changes as the tool moves
            S[:, d, :d] += np.einsum("kij,ki->kj", self._guides[:, :d, :d], across(sums[:, :d, 0]))
        inertia = self._rate * self._mass
        inertial = inertia * (found.motion - self._free)
        S = self._guides @ S + inertia[:, None] * np.eye(len(motions))
        free = self._free_tools
        inverse = np.zeros_like(S)
        inverse[free] = self._guides[free] @ np.linalg.inv(S[free])
        off = self._pushes - inertial - np.einsum("kij,kj->ki", self._guides, sums[:, :, 0])
        scale = np.maximum(np.abs([self._pushes, inertial]).max(axis=0), self._guides.any(axis=2) * sums[:, :, 1])
        scale[:, :d] = np.linalg.norm(scale[:, :d], axis=1, keepdims=True)
        rounding = sums[:, :, 2] + ROUND_OFF * inertia * (np.abs(found.motion) + np.abs(self._free))
        scale = np.maximum(scale, rounding / SAME)
        share = (np.abs(off) / np.where(scale > 0, scale, 1.0)).max(axis=1)
        return MotionEquation(inverse, share * free, np.einsum("kij,kj->ki", inverse, off))

    @property
    def _loaded(self) -> NDArray[np.int64]:
        """Indices of the free tools."""
        return np.flatnonzero(self._free_tools)

    def coupling(self, at: At) -> PETSc.Mat:
        """See `Loads`."""
        K = super().coupling(at)
        found = self.found(at)
        inverse = self._equation(found).inverse
        for k in self._loaded:
            on = (np.arange(len(inverse)) == k)[:, None]
            for e, to in zip(np.eye(inverse.shape[1]), inverse[k].T, strict=True):
                if to.any():
                    pulled = self._pulled(found, on * to), self._pulled(found, on * e, adjoint=True)
                    sides = (self._nodal(at.unknowns, values) for values in pulled)
                    K.axpy(-1.0, outer(*sides), PETSc.Mat.Structure.UNKNOWN)
        return K

    def settle(self, at: At, sticks: bool) -> bool:
        """See `Loads`."""
        w, motion = self._apart_by(self.now.law, at), self.found(at).motion
        changed = super().settle(at, sticks)
        self.now = self.now._replace(linear=self._free_motion(w, motion))
        return changed

    def augment(self, at: At) -> bool:
        """See `Loads`.  The augmentation ends only if the tools are in equilibrium too."""
        if super().augment(at):
            return True
        found = self.found(at)
        equation = self._equation(found)
        if not (equation.off > SAME).any():
            return False
        w = self._apart_by(self.now.law, at)
        self.now = self.now._replace(linear=self._free_motion(w, found.motion + equation.shift))
        return True

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """See `Loads`.  Free tools also have velocities (d,) (m/s), rotations (rad), and angular velocities (rad/s)."""
        out = super().outcome(at)
        d, names = self.grid.dim, self.now.law.names
        motion, velocity = self.pushes.start + self.found(at).motion, self._after(at).velocity
        rotating = self._guides[:, -1, -1]
        out["tool_travel"] = {
            name: motion[k, :d] if self._free_tools[k] else np.array(0.0) for k, name in enumerate(names)
        }
        out["tool_velocity"] = {names[k]: velocity[k, :d] for k in np.flatnonzero(self._free_tools)}
        if d == 2 and rotating.any():
            out |= {
                quantity: {names[k]: np.array(of[k, d]) for k in np.flatnonzero(rotating)}
                for quantity, of in (("tool_rotation", motion), ("tool_spin", velocity))
            }
        return out


def across(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return e_z x v (m, 2) for vectors v (m, 2)."""
    return np.stack([-v[:, 1], v[:, 0]], axis=1)
