# SPDX-License-Identifier: MIT
"""Unit weight of the fluid, which converts hydraulic conductivity to mobility."""

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

WEIGHS = 5e-3  # largest relative difference of two unit weights of water, or of two gravities, without a warning
DENSITIES = (500.0, 2000.0)  # kg/m^3: densities of liquids, from oils to brines
SOFTEST = 1e5  # Pa: bulk modulus of a gas at atmospheric pressure.  Source: exact, by Boyle's law

T = TypeVar("T")
Gravity = ArrayLike | Callable[[float], ArrayLike] | None


def under(fluid: Fluid | None, gravity: Gravity) -> Fluid | None:
    """Return the fluid, with the gravity of the scene if this gravity is constant and the fluid has no other."""
    if fluid is None or fluid.gravity is not None or gravity is None or callable(gravity):
        return fluid
    strength = float(np.linalg.norm(numbers("gravity", gravity, None, allowed="finite numbers")))
    return replace(fluid, gravity=strength) if strength else fluid


def weighed(value, fluid: Fluid | None):
    """Return the value of a condition.  A water pressure without unit weight gets the unit weight of the pore fluid."""
    by_fluid = isinstance(value, OfWater) and value.given is None and fluid is not None
    return replace(value, given=fluid.unit_weight) if by_fluid else value


def waters(conditions: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the water pressures of the conditions, each with a label that names the side."""
    each = ((one, value) for one in conditions.values() for value in getattr(one, "__dict__", {}).values())
    return [(f"water at {one.side!r}", value) for one, value in each if hasattr(value, "unit_weight")]


def with_weight(condition: T, fluid: Fluid | None) -> T:
    """Return the condition with unit weights for all its water pressures."""
    new = {
        name: weighed(value, fluid)
        for name, value in getattr(condition, "__dict__", {}).items()
        if isinstance(value, OfWater)
    }
    return replace(condition, **new) if new else condition


def warn_units(comm: MPI.Intracomm, fluid: Fluid, gravity: Gravity) -> None:
    """Warn if the scene has no gravity, and the constants of the fluid are implausible in SI units."""
    if fluid.gravity is not None or gravity is not None:
        return
    if not DENSITIES[0] <= fluid.density <= DENSITIES[1] or fluid.bulk < SOFTEST:
        what = "%s: no liquid has these constants in SI units; conductivities are divided by density x %.4g m/s^2, "
        warn(
            comm,
            ConditionWarning,
            f"{what}because the scene has no gravity; in other units give Fluid(gravity=...)",
            line(fluid),
            STANDARD_GRAVITY,
        )


def warn_levels(comm: MPI.Intracomm, fluid: Fluid | None, gravity: Gravity, levels: Sequence[tuple[str, Any]]) -> None:
    """Warn of water levels with an implausible unit weight, such as a value that differs from the pore fluid's.

    `levels`: name and water pressure of each level.
    """
    g = 0.0 if gravity is None or callable(gravity) else float(np.linalg.norm(gravity))
    if fluid is None:
        levels = [(name, value) for name, value in levels if isinstance(value, OfWater) and value.given is None and g]
        own, of = 1000 * g, "water under the scene's gravity"
    else:
        own, of = (fluid.unit_weight if callable(gravity) else fluid.density * g), "the pore fluid"
    weights = {(name, value.unit_weight if isinstance(value, OfWater) else own) for name, value in levels}
    if g and np.linalg.norm(np.add(gravity, g * np.eye(len(gravity))[-1])) > WEIGHS * g:
        for name in sorted({name for name, value in levels if isinstance(value, OfWater)}):
            along = line(np.asarray(gravity).tolist())
            what = f"the level is a height along the last axis, but gravity is {along}, so this water is not at rest"
            warn(comm, ConditionWarning, "%s: %s; give the pressure as a function of x", name, what)
    for name, weight in sorted(weights):
        if abs(weight - own) > WEIGHS * max(weight, own):
            what = "%s: unit_weight = %.6g N/m^3, but density times gravity of %s is %.6g, so at equal "
            what = f"{what}levels the two are not in equilibrium"
            warn(comm, ConditionWarning, what, name, weight, of, own)


def other_gravity(fluid: Fluid, gravity: Sequence[NDArray[np.float64]]) -> float | None:
    """Return the magnitude of the last `gravity`, in m/s^2, if conductivities refer to another gravity, or else None.

    If gravity varies in the step, and its last magnitude is at most 9.81 m/s^2, the function returns None.

    `gravity`: accelerations of gravity, in m/s^2, at the start of a step and at later times in the step.
    """
    first, last = gravity[0], float(np.linalg.norm(gravity[-1]))
    rests = all(np.array_equal(first, g) for g in gravity) and last > 0
    beyond = last > (1 + WEIGHS) * STANDARD_GRAVITY
    if fluid.gravity is None and (beyond or (rests and abs(last / STANDARD_GRAVITY - 1) > WEIGHS)):
        return last
    return None
