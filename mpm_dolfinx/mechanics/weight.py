# SPDX-License-Identifier: MIT
"""Weight of the bodies, `int rho g . v dV`, and weight of the pore fluid that flows into the bodies in the step."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.conditions.acting import Acting, Loads, Place, Setting
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.mechanics.tractions import DeadLoads


class Weight(Acting):
    """Weight of the bodies and of their pore fluid in a scene.

    `pieces`: all integration points, with `density`, in kg/m^3, at the start of the step.
    `u`: displacement increment of the step.
    `gravity` (d,), in m/s^2: acceleration as a UFL constant.
    `fluid_density`, in kg/m^3: density of the pore fluid, or None without fluid.
    `saturation`: degree of saturation as UFL, or None for saturated soil.
    """

    def __init__(
        self,
        pieces: FormPoints,
        u: fem.Function,
        gravity: fem.Constant,
        fluid_density: float | None,
        saturation: ufl.core.expr.Expr | None = None,
    ):
        pull = ufl.inner(gravity, pieces.value(ufl.TestFunction(u.function_space)))
        self._dead, self._taken_up = PointForm(pieces.density * pull * pieces.dx, pieces), None
        if fluid_density is not None:
            grown = ufl.det(pieces.increment(u)) - 1
            if saturation is not None:  # `density` is for soil with saturated pores
                grown = saturation * grown - (1 - saturation) * pieces.pores
            grown = fem.Constant(pieces.grid.mesh, fluid_density) * grown
            self._taken_up = PointForm(-grown * pull * pieces.dx, pieces)

    def acting(self, setting: Setting) -> Acting:
        """Return the weight in a stage."""
        return self

    def placed(self, place: Place) -> Loads:
        """Return the weight at the integration points."""
        return WeightLoads(self._dead, self._taken_up, place.pieces.pieces)


class WeightLoads(DeadLoads):
    """The weight in a substep."""

    def __init__(self, dead: PointForm, taken_up: PointForm | None, pieces: PointData):
        super().__init__(dead, pieces)
        self._taken_up = taken_up

    def takes_up(self, b: NDArray[np.float64]) -> None:
        """Subtract the weight of the pore fluid that flows into the bodies."""
        if self._taken_up is not None:
            self._taken_up.assemble_vector(b, self.data)
