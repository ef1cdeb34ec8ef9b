# SPDX-License-Identifier: MIT
"""Free tools: rigid tools with mass, moved by weight, loads and contact forces.

The displacement q of a tool of mass m in a step follows m (q - q^) / (own dt)^2 = l - sum f, as for nodes
(`mechanics/inertia.py`).  Here q^ is its free flight, l its load, and f are the contact forces on the points.  q is
condensed.  Let D be minus the derivative of f by the displacement of the points, S = sum D + m / (own dt)^2, and dw
their increment.  Newton's method then gives

    dq = S^-1 (l - sum f - m (q - q^) / (own dt)^2 + sum D dw),

so forces on the points are f + D S^-1 (...), and minus their derivative is D - D S^-1 D.
"""

from __future__ import annotations

from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.conditions.acting import At, Shares
from mpm_dolfinx.contact.problem import ContactProblem, Found, Gone, outer
from mpm_dolfinx.mechanics.inertia import Flight


class Goes(NamedTuple):
    """Linearised motion of free tools at w (m, d), m: displacement travel + shift (k, d), m, plus inverse (k, d, d) of
    S times further forces.

    found: contact at w.
    """

    w: NDArray[np.float64]
    travel: NDArray[np.float64]
    shift: NDArray[np.float64]
    inverse: NDArray[np.float64]
    found: Found


class Met(NamedTuple):
    """Equation of motion of free tools: inverse (k, d, d) of S; off (k,): relative out-of-balance force; shift (k, d):
    Newton increment, m.
    """

    inverse: NDArray[np.float64]
    off: NDArray[np.float64]
    shift: NDArray[np.float64]


class FreeTools(ContactProblem):
    """Mixin of `ToolLoads` for scenes with free tools.

    Parameters
    ----------
    placed
        Arguments of `ToolLoads`.
    mass, guides
        Masses (k,), kg, 0 for tools that are not free; projections (k, d, d) on their directions of motion.
    velocity, pushes
        Velocities (k, d), m/s, at the start of the step; loads (k, d), N.
    """

    couples = True

    def __init__(self, *placed, mass: NDArray, guides: NDArray, velocity: NDArray, pushes: NDArray):
        super().__init__(*placed)
        self._mass, self._guides = mass, guides
        self._pushes = pushes
        self.flight = Flight(velocity, velocity)
        """Velocities and accelerations of the tools (k, d), m/s and m/s^2, at the start of the substep."""
        self._rate, self._free = 0.0, np.zeros_like(velocity)

    def begun(self, shares: Shares, gone: Gone | None) -> FreeTools:
        """See `Loads`."""
        out = super().begun(shares, gone)
        if gone is not None:
            out.flight = gone.flight
        if shares.gravity is not None:
            out._pushes = self._pushes + self._mass[:, None] * (self._guides @ shares.gravity)
        out._rate, out._free = shares.own**-2, out.flight.free(shares.own, shares.before)
        out.now = self.now._replace(ways=out._goes(np.zeros_like(self.pairs.x), out._free))
        return out

    def flown(self, at: At) -> Gone:
        """See `Loads`."""
        return super().flown(at)._replace(flight=self._after(at))

    def tool_velocity(self, at: At) -> NDArray[np.float64]:
        """See `ContactProblem`."""
        free = (self._mass > 0)[self.pairs.number, None]
        return np.where(free, self._after(at).velocity[self.pairs.number], super().tool_velocity(at))

    def rubbing(self, at: At, v: NDArray[np.float64]) -> tuple[float, float]:
        """See `Loads`: contact forces change the energy of a free tool, and loads do work on it."""
        rubs, more = super().rubbing(at, v)
        free = (self._mass > 0)[self.pairs.number]
        more -= float((self.found(at).touch.force * self.tool_velocity(at))[free].sum())
        pushed = float((self._pushes * self._after(at).velocity).sum())
        return rubs, more + pushed * (self.grid.comm.rank == 0)

    def _after(self, at: At) -> Flight:
        """Return the velocities after the substep."""
        acceleration = self._rate * (self.found(at).travel - self._free)
        return self.flight.after(acceleration, self.shares.own, self.shares.before)

    def _find(self, w: NDArray[np.float64]) -> Found:
        return self._find_at(w, self._travel(w))

    def _find_at(self, w: NDArray[np.float64], way: NDArray[np.float64]) -> Found:
        found = super()._find_at(w, way)
        if way.ndim == 1:  # before the first substep
            return found
        law = self.now.law
        shift = self._met(found).shift[self.pairs.number]
        return found._replace(balanced=found.touch.force + law.slope(found.touch, found.at, shift))

    def _travel(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (k, d), m, of tools at w (m, d), m, along the last Newton step."""
        goes = self.now.ways
        law = self.now.law
        moved = law.slope(goes.found.touch, goes.found.at, w - goes.w)
        on = law.by_contact(np.column_stack([(w != goes.w).any(axis=1), moved]))
        if not on[:, 0].any():
            return goes.travel
        return goes.travel + goes.shift + np.einsum("kij,kj->ki", goes.inverse, on[:, 1:])

    def _goes(self, w: NDArray[np.float64], travel: NDArray[np.float64]) -> Goes:
        """Return the linearised motion of tools with displacements (k, d), m, for bodies at w (m, d), m."""
        found = self._find_at(w, travel)
        met = self._met(found)
        return Goes(w, travel, met.shift, met.inverse, found)

    def _met(self, found: Found) -> Met:
        """Return the equation of motion of the tools at a contact."""
        law = self.now.law
        of, d = self.pairs.number, self.grid.dim
        columns = [law.slope(found.touch, found.at, self._guides[of, :, i]) for i in range(d)]
        sums = law.by_contact(np.stack([found.touch.force, *columns], axis=2).reshape(len(of), -1))
        sums = np.einsum("kij,kjl->kil", self._guides, sums.reshape(-1, d, d + 1))
        heavy = (self._rate * self._mass)[:, None]
        S = sums[:, :, 1:] + heavy[:, :, None] * np.eye(d)
        free = self._mass > 0
        inverse = np.zeros_like(S)
        inverse[free] = self._guides[free] @ np.linalg.inv(S[free])
        back = heavy * (found.travel - self._free)
        off = self._pushes - back - sums[:, :, 0]
        parts = np.linalg.norm([self._pushes, back, sums[:, :, 0]], axis=2).max(axis=0)
        share = np.linalg.norm(off, axis=1) / np.where(parts > 0, parts, 1.0)
        return Met(inverse, share * free, np.einsum("kij,kj->ki", inverse, off))

    def pattern(self, unknowns) -> PETSc.Mat | None:
        """See `Loads`: all nodes under a free tool are coupled."""
        out = None
        for number in np.flatnonzero(self._mass > 0):
            own = self._nodal(unknowns, np.repeat((self.pairs.number == number)[:, None], self.grid.dim, axis=1))
            more = outer(own, own)
            out = more if out is None else out + more
        out.zeroEntries()
        return out

    def coupling(self, at: At) -> PETSc.Mat:
        """See `Loads`."""
        K = super().coupling(at)
        found = self.found(at)
        law = self.now.law
        inverse = self._met(found).inverse
        for k in np.flatnonzero(self._mass > 0):
            on = (self.pairs.number == k)[:, None]
            for e, to in zip(np.eye(self.grid.dim), inverse[k].T, strict=True):
                sides = (
                    self._nodal(unknowns := at.unknowns, law.slope(found.touch, found.at, on * to)),
                    self._nodal(unknowns, law.slope(found.touch, found.at, on * e, adjoint=True)),
                )
                K.axpy(-1.0, outer(*sides), PETSc.Mat.Structure.UNKNOWN)
        return K

    def settle(self, at: At, sticks: bool) -> bool:
        """See `Loads`."""
        w, travel = self._apart_by(self.now.law, at), self.found(at).travel
        changed = super().settle(at, sticks)
        self.now = self.now._replace(ways=self._goes(w, travel))
        return changed

    def augment(self, at: At) -> bool:
        """See `Loads`: tools must be in equilibrium too."""
        if super().augment(at):
            return True
        found = self.found(at)
        met = self._met(found)
        if not (met.off > SAME).any():
            return False
        self.now = self.now._replace(ways=self._goes(self._apart_by(self.now.law, at), found.travel + met.shift))
        return True

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """See `Loads`: with velocities (d,), m/s."""
        out = super().outcome(at)
        for k in np.flatnonzero(self._mass == 0):
            out["tool_travel"][self.now.law.names[k]] = np.array(0.0)
        free, velocity = np.flatnonzero(self._mass > 0), self._after(at).velocity
        return out | {"tool_velocity": {self.now.law.names[k]: velocity[k] for k in free}}
