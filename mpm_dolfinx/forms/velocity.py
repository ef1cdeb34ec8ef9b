# SPDX-License-Identifier: MIT
"""The velocity of the bodies in a substep, for forms that ask for it."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray


class Velocity:
    """The velocity (u - past) / own at the end of a substep; of backward Euler past is 0, and own the step.

    Parameters
    ----------
    u
        Increment of the displacement in the step, m.
    """

    def __init__(self, u: fem.Function):
        self._u, self._past = u, fem.Function(u.function_space)
        self._own = fem.Constant(u.function_space.mesh, 1.0)
        self.value = (u - self._past) / self._own
        """As UFL, m/s."""

    @property
    def nodal(self) -> NDArray[np.float64]:
        """Values (unknowns,) at the nodes, a local array, m/s."""
        return (self._u.x.array - self._past.x.array) / float(self._own.value)

    def among(self, form: ufl.Form) -> bool:
        """Return whether a form depends on it."""
        return self._past in form.coefficients()

    def set(self, own: float, past: float, dofs: NDArray[np.int64]) -> None:
        """Set the rate at the end of a substep: time in which it counts, s, and share of the present u before it.

        dofs: the active degrees of freedom.
        """
        self._own.value = own
        self._past.x.array[dofs] = past * self._u.x.array[dofs]
