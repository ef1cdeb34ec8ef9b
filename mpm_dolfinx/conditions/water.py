# SPDX-License-Identifier: MIT
"""Free water at a side of the bodies: hydrostatic pressure below the water level, and a seepage face above."""

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
    """Return two conditions for still water at a side.  The scene must have both conditions.

    Below the water level, hydrostatic pressure acts on the surface and on the pore fluid.  Above the level, the side is
    a seepage face.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    level : float or callable t (s) -> float, m
        Coordinate of the water level along the last axis.  The level must be finite.
    region : ((d,), (d,)), m
        Box of reference positions.  Water acts inside this box only.
    unit_weight
        Unit weight > 0 of the water, in N/m^3.  The default is the unit weight of the scene's fluid.  A warning is
        issued if the unit weight differs from fluid density times gravity.

    Raises
    ------
    ValueError
        A value is out of range.  If `level` is a function, a step raises the error.
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
    """Hydrostatic pressure of free water, as a function of time and position."""

    side: str
    level: float | Callable[[float], float]
    given: float | None = None

    def __call__(self, t: float, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures (n,), in Pa, at positions x (n, d), in m, and time t (s)."""
        height = given(f"water at {self.side!r}: level at t = {t:g} s", self.level, t)
        return self.unit_weight * np.maximum(height - x[:, -1], 0.0)
