# SPDX-License-Identifier: MIT
"""Conditions on the sides of the bodies: dead tractions, rigid plates, drained sides, prescribed inflow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.grid import side
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


RIGIDITY = 1e4
"""Rigidity of a plate, in units of (oedometric modulus of the body) x (length of the side)."""


@dataclass(frozen=True)
class RigidPlate:
    """Rigid, smooth plate on a flat side of the bodies: one displacement along the side's axis for all its faces.

    The slope of the faces is penalised, kappa/2 int |grad_t x_n|^2 dA; an even displacement is free, so
    the plate carries the given total force exactly.

    Parameters
    ----------
    side
        Side of the bodies, normal to an axis.
    force : float or callable t -> float, N (N/m in plane strain)
        Total force that presses on the side; negative: pulls.
    region : ((d,), (d,)), m
        Box of reference positions to which the plate is limited.
    """

    side: str
    force: float | Callable[[float], float]
    region: Region | None = None

    def traction(self, area: float, dim: int) -> Traction:
        """Return the even traction of the plate on its reference area, m^(d-1)."""
        axis, end = side(self.side, dim)
        inward = np.zeros(dim)
        inward[axis] = 1 - 2 * end
        force = self.force if callable(self.force) else lambda t: self.force
        return Traction(self.side, lambda t: inward * force(t) / area, self.region)
