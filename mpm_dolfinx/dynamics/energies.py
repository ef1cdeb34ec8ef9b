# SPDX-License-Identifier: MIT
"""Energies of bodies with inertia, and the work of forces on them.

In a step, forces f do the work `dt sum b_i f_i . v_i`.  The sum extends over the substeps i, with their velocities v_i
and the weights b_i of the time integration.  The total work is the work of loads minus the work of stresses, viscous
resistance and friction.  If no domains are renewed, the total work minus the change of kinetic energy is the numerical
dissipation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.mechanics.inertia import velocity_gradients
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.cutting import spreads
from mpm_dolfinx.points.material_points import MaterialPoints


def stored(materials: SceneMaterials, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
    """Return the total kinetic and elastic energy of all points, in J.  All processes must call this function."""
    mass = materials.masses(points)
    v, L = points.velocity, velocity_gradients(points)
    moments = spreads(points.corners, materials.grid.axisymmetric)
    turning = np.einsum("nij,njk,nik->n", L, moments, L)
    kinetic, elastic = mass @ ((v**2).sum(axis=1) + turning) / 2, materials.stored(points) @ points.volume0
    return dict(zip(("kinetic", "elastic"), over_all(materials.grid.comm, np.array([kinetic, elastic])), strict=True))


def drift(materials: SceneMaterials, points: MaterialPoints, held: NDArray[np.bool_]) -> list[float]:
    """Return the mean velocity of all bodies, in m/s.  It is set to 0 along axes with supports and along the radius.

    All processes must call this function.

    `held` (d,): whether supports hold bodies of this process along each axis.
    """
    mass = materials.masses(points)
    held = held | (np.arange(len(held)) < materials.grid.axisymmetric)
    sums = [[mass.sum()] * len(held), mass @ points.velocity, held]
    total, momentum, held = over_all(materials.grid.comm, np.array(sums))
    return np.where(held > 0, 0.0, momentum / total).tolist()


def initial_energies(
    materials: SceneMaterials, points: MaterialPoints, kinetic: float
) -> dict[str, NDArray[np.float64]]:
    """Return the energies at the start of a run, in J, see `Result.energies`.

    `kinetic`: kinetic energy of free tools, in J.
    """
    works = dict.fromkeys(("internal", "viscous", "friction", "external", "renewal"), 0.0)
    return _named(stored(materials, points), works, 0.0, kinetic)


def after(
    before: Mapping[str, NDArray[np.float64]],
    materials: SceneMaterials,
    points: MaterialPoints,
    kinetic: float,
    seconds: Sequence[float],
    powers: Sequence[Mapping[str, float]],
) -> dict[str, NDArray[np.float64]]:
    """Return the energies after a step, in J.

    `kinetic`: kinetic energy of free tools, in J.
    `seconds`: time weights of the substeps, in s.
    `powers`: powers of this process's forces in each substep, in W, see `MomentumProblem.powers`.
    """
    counted = seconds[-len(powers) :] @ np.array([list(of.values()) for of in powers])
    work = zip(powers[0], over_all(materials.grid.comm, counted), strict=True)
    works = {name: float(before[name]) + more for name, more in work}
    now = stored(materials, points)
    start = before["elastic"] + before["dissipated"] - before["internal"]
    works["renewal"] = float(before.get("renewal", 0.0))
    return _named(now, works, start + works["internal"] - now["elastic"], kinetic)


def after_renewal(
    materials: SceneMaterials, energy: Mapping, old: MaterialPoints, new: MaterialPoints, renewed: int
) -> Mapping[str, NDArray[np.float64]]:
    """Return the energies after a renewal of domains, in J.  The entry `renewal` is the energy lost in all renewals."""
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
