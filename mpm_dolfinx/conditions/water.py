# SPDX-License-Identifier: MIT
"""Free water against a side of the bodies: its pressure and its head on what it wets, a seepage face above."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import check_names, given, numbers
from mpm_dolfinx.bodies.faces import Region
from mpm_dolfinx.conditions.conditions import Drained, Pressure
from mpm_dolfinx.materials.initial_stress import OfWater


def water(
    side: str,
    level: float | Callable[[float], float],
    *,
    region: Region | None = None,
    unit_weight: float | None = None,
) -> tuple[Pressure, Drained]:
    """Return the two conditions by which still water acts on a side: both are to be given.

    Below its level it presses on the side and is open to the pores, with the hydrostatic pressure; above, the side is
    a seepage face.  Both follow the side as it moves, from step to step.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    level : float or callable t (s) -> float, m
        Height of the free surface, along the last axis; finite.
    region : ((d,), (d,)), m
        Box of reference positions to which the faces are limited.
    unit_weight
        Of the water, N/m^3, > 0; by default that of the scene's fluid.  That of the pores is the fluid's density times
        the gravity of the scene: a warning says where they differ.

    Raises
    ------
    ValueError
        Naming what is out of its range; of a function, at the step that asks for it.
    """
    if unit_weight is not None:
        numbers("water: unit_weight", unit_weight, test=lambda v: (0 < v) & (v < np.inf), allowed="> 0 and finite")
    if callable(level):
        check_names(f"water at {side!r}: level", level, ("t",))
    else:
        numbers("water: level", level)

    pressure = WaterPressure(side, level, unit_weight)
    return Pressure(side, pressure, region), Drained(side, pressure, region, seepage=True)


@dataclass(frozen=True)
class WaterPressure(OfWater):
    """The pressure of free water, as a function of time and places; its unit weight by default that of the scene."""

    side: str
    level: float | Callable[[float], float]
    given: float | None = None

    def __call__(self, t: float, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures (m,), Pa, at places x (m, d)."""
        height = given(f"water at {self.side!r}: level at t = {t:g} s", self.level, t)
        return self.unit_weight * np.maximum(height - x[:, -1], 0.0)
