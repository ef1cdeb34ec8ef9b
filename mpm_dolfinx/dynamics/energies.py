# SPDX-License-Identifier: MIT
"""Energies of bodies with inertia, and the work of forces on them.

The work of forces f in a step is `dt sum b_i f_i . v_i` over its substeps, with the weights b_i of the time
integration. The work of all forces is the work of loads minus the work of stresses, viscous resistance and friction.
Without renewal, the work of all forces minus the change of kinetic energy is the numerical dissipation of method and
grid resets.
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
    """Return the kinetic and elastic energies, J, of points; all processes must call it."""
    mass = materials.present_density(points) * points.volume0 * points.J
    v, L = points.data[VELOCITY], velocity_gradients(points)
    moments = spreads(points.corners, materials.grid.axisymmetric)
    turning = np.einsum("nij,njk,nik->n", L, moments, L)
    kinetic, elastic = mass @ ((v**2).sum(axis=1) + turning) / 2, materials.stored(points) @ points.volume0
    return dict(zip(("kinetic", "elastic"), over_all(materials.grid.comm, np.array([kinetic, elastic])), strict=True))


def initial_energies(
    materials: SceneMaterials, points: MaterialPoints, kinetic: float, renews: bool
) -> dict[str, NDArray[np.float64]]:
    """Return the energies, J, at the start, see `Result.energies`.  `internal` is the work of the stresses.

    kinetic: kinetic energy of free tools, J; renews: whether domains may be renewed.
    """
    works = dict.fromkeys(("internal", "viscous", "friction", "external", *["renewal"] * renews), 0.0)
    return _named(stored(materials, points), works, 0.0, kinetic)


def after(
    before: Mapping[str, NDArray[np.float64]],
    materials: SceneMaterials,
    points: MaterialPoints,
    kinetic: float,
    seconds: Sequence[float],
    powers: Sequence[Mapping[str, float]],
) -> dict[str, NDArray[np.float64]]:
    """Return the energies, J, after a step, from the energies before the step.

    kinetic: kinetic energy of free tools, J.
    seconds: time weights of the substeps, s.
    powers: powers of the substeps on this process, in W, see `MomentumProblem.powers`.
    """
    counted = seconds[-len(powers) :] @ np.array([list(of.values()) for of in powers])
    work = zip(powers[0], over_all(materials.grid.comm, counted), strict=True)
    works = {name: float(before[name]) + more for name, more in work}
    now = stored(materials, points)
    start = before["elastic"] + before["dissipated"] - before["internal"]
    works |= {name: float(before[name]) for name in ("renewal",) if name in before}
    return _named(now, works, start + works["internal"] - now["elastic"], kinetic)


def after_renewal(
    materials: SceneMaterials, energy: Mapping, old: MaterialPoints, new: MaterialPoints, renewed: int
) -> Mapping[str, NDArray[np.float64]]:
    """Return the energies, J, after renewal of domains; `renewal` is the total energy lost by renewals."""
    if not renewed:
        return energy
    now = stored(materials, new)
    change = {name: now[name] - value for name, value in stored(materials, old).items()}
    change["renewal"] = -sum(change.values())
    return {**energy, **{name: energy.get(name, 0.0) + value for name, value in change.items()}}


def _named(
    now: Mapping[str, float], works: Mapping[str, float], dissipated: float, kinetic: float
) -> dict[str, NDArray[np.float64]]:
    now = {**now, "kinetic": now["kinetic"] + kinetic}
    return {name: np.array(float(value)) for name, value in {**now, **works, "dissipated": dissipated}.items()}
