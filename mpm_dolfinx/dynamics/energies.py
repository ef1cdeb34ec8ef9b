# SPDX-License-Identifier: MIT
"""Energies of bodies with inertia, and the work of what acts on them.

A step's work of forces f is dt sum b_i f_i . v_i over its substeps, with their velocities: as the method itself counts
accelerations.  What kinetic energy and works do not balance by is lost to the method and to resets of the grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.mechanics.inertia import VELOCITY, velocity_gradients
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.cutting import spreads
from mpm_dolfinx.points.material_points import MaterialPoints


def stored(materials: SceneMaterials, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
    """Return the kinetic and elastic energies, J, of points; on all processes together."""
    mass = materials.present_density(points) * points.volume0 * points.J
    v, L = points.data[VELOCITY], velocity_gradients(points)
    spread = spreads(points.corners, materials.grid.axisymmetric)
    turning = np.einsum("nij,njk,nik->n", L, spread, L)
    kinetic, elastic = mass @ ((v**2).sum(axis=1) + turning) / 2, materials.stored(points) @ points.volume0
    return dict(zip(("kinetic", "elastic"), over_all(materials.grid.comm, np.array([kinetic, elastic])), strict=True))


def begun(materials: SceneMaterials, points: MaterialPoints, kinetic: float) -> dict[str, NDArray[np.float64]]:
    """Return the energies, J, as works begin to count: see `Result.energies`; `internal` is the work of stresses.

    kinetic: that of free tools, J.
    """
    works = dict.fromkeys(("internal", "viscous", "friction", "external"), 0.0)
    return _named(stored(materials, points), works, 0.0, kinetic)


def after(
    before: Mapping[str, NDArray[np.float64]],
    materials: SceneMaterials,
    points: MaterialPoints,
    kinetic: float,
    seconds: Sequence[float],
    powers: Sequence[Mapping[str, float]],
) -> dict[str, NDArray[np.float64]]:
    """Return the energies, J, after a step from those before it.

    kinetic: that of free tools, J.
    seconds, powers: times, s, in which the last powers count, W, on this process, see `MomentumProblem.powers`.
    """
    counted = seconds[-len(powers) :] @ np.array([list(of.values()) for of in powers])
    work = zip(powers[0], over_all(materials.grid.comm, counted), strict=True)
    works = {name: float(before[name]) + more for name, more in work}
    now = stored(materials, points)
    start = before["elastic"] + before["dissipated"] - before["internal"]
    return _named(now, works, start + works["internal"] - now["elastic"], kinetic)


def _named(
    now: Mapping[str, float], works: Mapping[str, float], dissipated: float, kinetic: float
) -> dict[str, NDArray[np.float64]]:
    now = {**now, "kinetic": now["kinetic"] + kinetic}
    return {name: np.array(float(value)) for name, value in {**now, **works, "dissipated": dissipated}.items()}
