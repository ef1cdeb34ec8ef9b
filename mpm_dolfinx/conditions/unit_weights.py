# SPDX-License-Identifier: MIT
"""The unit weight that turns conductivities into mobilities: by the scene's gravity, whatever its units."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import line, numbers
from mpm_dolfinx.materials.initial_stress import OfWater
from mpm_dolfinx.materials.skeleton import STANDARD_GRAVITY, Fluid
from mpm_dolfinx.parallel.messages import ConditionWarning, warn

WEIGHS = 5e-3  # share by which unit weights of water, and gravities, may differ without a warning
DENSITIES = (500.0, 2000.0)  # kg/m^3: of oils and brines
SOFTEST = 1e5  # Pa: bulk modulus of a gas at the pressure of the atmosphere.  Source: exact, by Boyle's law

T = TypeVar("T")
Gravity = ArrayLike | Callable[[float], ArrayLike] | None


def under(fluid: Fluid | None, gravity: Gravity) -> Fluid | None:
    """Return a fluid whose conductivities are those under the gravity of its scene, if that is known, m/s^2."""
    if fluid is None or fluid.gravity is not None or gravity is None or callable(gravity):
        return fluid
    strength = float(np.linalg.norm(numbers("gravity", gravity, None, allowed="finite numbers")))
    return replace(fluid, gravity=strength) if strength else fluid


def weighed(value, fluid: Fluid | None):
    """Return a pressure of water that has, where its unit weight was not given, that of the pore fluid."""
    by_fluid = isinstance(value, OfWater) and value.given is None and fluid is not None
    return replace(value, given=fluid.unit_weight) if by_fluid else value


def waters(conditions: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the pressures of water that conditions have, with the sides on which they act."""
    each = ((one, value) for one in conditions.values() for value in getattr(one, "__dict__", {}).values())
    return [(f"water at {one.side!r}", value) for one, value in each if hasattr(value, "unit_weight")]


def with_weight(condition: T, fluid: Fluid | None) -> T:
    """Return a condition whose pressures of water have a unit weight, see `weighed`."""
    new = {
        name: weighed(value, fluid)
        for name, value in getattr(condition, "__dict__", {}).items()
        if isinstance(value, OfWater)
    }
    return replace(condition, **new) if new else condition


def warn_units(comm: MPI.Intracomm, fluid: Fluid, gravity: Gravity) -> None:
    """Warn of a fluid in a scene without gravity that is none in SI units, by which its unit weight counts."""
    if fluid.gravity is not None or gravity is not None:
        return
    if not DENSITIES[0] <= fluid.density <= DENSITIES[1] or fluid.bulk < SOFTEST:
        what = "%s: no liquid in SI units, but without gravity its unit weight is density x %.4g m/s^2; in other units "
        warn(
            comm,
            ConditionWarning,
            f"{what}give Fluid(gravity=...), by which conductivities become mobilities",
            line(fluid),
            STANDARD_GRAVITY,
        )


def other_gravity(fluid: Fluid, gravity: Sequence[NDArray[np.float64]]) -> float | None:
    """Return the strength of a gravity, m/s^2, that has come to rest, and is not that of the fluid's conductivities.

    Parameters
    ----------
    gravity
        At the start of a step, and at times in it.
    """
    first, last = gravity[0], float(np.linalg.norm(gravity[-1]))
    rests = all(np.array_equal(first, g) for g in gravity) and last > 0
    beyond = last > (1 + WEIGHS) * STANDARD_GRAVITY
    if fluid.gravity is None and (beyond or (rests and abs(last / STANDARD_GRAVITY - 1) > WEIGHS)):
        return last
    return None
