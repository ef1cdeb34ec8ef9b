# SPDX-License-Identifier: MIT
"""Fields of the material points: stresses, stress invariants, porosity and saturation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.scene import Scene


@dataclass(frozen=True)
class PointFields:
    """Fields of the n material points of this process.  Stresses are Cauchy stresses, positive in tension.

    Attributes
    ----------
    effective_stress, stress : (n, 3, 3), Pa
        Effective stress and total stress.  In axisymmetry the axes x, y, z are the radial, axial and circumferential
        directions.  In plane strain z is the out-of-plane direction.  If a user-defined law does not define the
        out-of-plane stress, this stress and the invariants are nan.
    mean_effective_stress : (n,), Pa
        `p' = -tr(effective stress) / 3`, positive in compression.
    deviatoric_stress : (n,), Pa
        `q = sqrt(3/2 s : s)`, with the deviator s of the stress.  In a triaxial test, q is the absolute difference of
        axial and radial stress.
    porosity : (n,)
        Present porosity, `1 - (1 - n_0) / J`, with the initial porosity n_0 and the volume ratio J.
    saturation : (n,)
        Degree of saturation of the pores, 0 in a scene without fluid.
    """

    effective_stress: NDArray[np.float64]
    stress: NDArray[np.float64]
    mean_effective_stress: NDArray[np.float64]
    deviatoric_stress: NDArray[np.float64]
    porosity: NDArray[np.float64]
    saturation: NDArray[np.float64]


def point_fields(scene: Scene, points: MaterialPoints) -> PointFields:
    """Return the fields of material points.  All processes must call this function."""
    materials, effective = scene.materials, scene.materials.effective_stress_3d(points)
    pore = materials.pore_stress(points)
    mean = np.trace(effective, axis1=1, axis2=2) / 3
    deviator, stress = (effective - part[:, None, None] * np.eye(3) for part in (mean, pore))
    q = np.sqrt(1.5 * np.square(deviator).sum(axis=(1, 2)))
    full = np.full(len(points), 0.0 if scene.fluid is None else 1.0)
    if materials.retentions is not None:
        full = materials.saturation(points, points.pressure)[0]
    return PointFields(effective, stress, -mean, q, materials.porosity(points), full)
