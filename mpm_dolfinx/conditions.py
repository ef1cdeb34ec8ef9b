# SPDX-License-Identifier: MIT
"""Conditions on the sides of the bodies: dead tractions, drained sides, prescribed inflow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.points import Region


@dataclass(frozen=True)
class Traction:
    """Dead traction on a side of the bodies.

    Parameters
    ----------
    side
        Side of the bodies, see `grid.SIDES`.
    value : (d,) or callable t -> (d,), Pa
        Force per reference area.
    region : ((d,), (d,)), m
        Box of reference positions to which the traction is limited.
    """

    side: str
    value: ArrayLike | Callable[[float], ArrayLike]
    region: Region | None = None

    def at(self, t: float) -> NDArray[np.float64]:
        """Return the traction (d,) at time t (s), Pa."""
        return np.asarray(self.value(t) if callable(self.value) else self.value, dtype=float)


@dataclass(frozen=True)
class Drained:
    """Side of the bodies, moving with them, at which the pore pressure is given.

    Parameters
    ----------
    side
        Side of the bodies.
    pressure
        Outer pore pressure, Pa.
    region : ((d,), (d,)), m
        Box of reference positions to which the drained faces are limited.
    """

    side: str
    pressure: float = 0.0
    region: Region | None = None


@dataclass(frozen=True)
class Inflow:
    """Side of the bodies through which fluid is pressed in.

    Parameters
    ----------
    side
        Side of the bodies.
    flux
        Volume per area and time into the body, m/s; negative: out of it.
    region : ((d,), (d,)), m
        Box of reference positions to which the faces are limited.
    """

    side: str
    flux: float
    region: Region | None = None
