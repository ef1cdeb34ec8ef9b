# SPDX-License-Identifier: MIT
"""Velocity of the solid in a substep, for forms that depend on the velocity."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray


class Velocity:
    """Velocity `(u - past) / own` at the end of a substep.

    `u`, in m: displacement increment of the step.
    `own`, in s: Runge-Kutta coefficient a_ii of the substep times the length dt of the step; in backward Euler, dt.
    `past`, in m: part of u that is due to the velocity in the previous substep; in backward Euler, zero.
    """

    def __init__(self, u: fem.Function):
        self._u, self._past = u, fem.Function(u.function_space)
        self._own = fem.Constant(u.function_space.mesh, 1.0)
        self.value = (u - self._past) / self._own
        """Velocity as a UFL expression, in m/s."""

    @property
    def nodal(self) -> NDArray[np.float64]:
        """Nodal velocities, in m/s, as a local array."""
        return (self._u.x.array - self._past.x.array) / float(self._own.value)

    def among(self, form: ufl.Form) -> bool:
        """Return whether a form depends on the velocity."""
        return self._past in form.coefficients()

    def set(self, own: float, past: float, dofs: NDArray[np.int64]) -> None:
        """Set `own`, in s.  Set the field `past` to the present u, multiplied by the argument `past`."""
        self._own.value.fill(own)
        self._past.x.array[dofs] = past * self._u.x.array[dofs]
