# SPDX-License-Identifier: MIT
"""What engineers ask of the material points: stresses in three dimensions, their invariants, porosities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.scene import Scene


@dataclass(frozen=True)
class PointFields:
    """Fields at this process's n material points; stresses are Cauchy's, tension is positive.

    Attributes
    ----------
    effective_stress, stress : (n, 3, 3), Pa
        Of the skeleton, and of skeleton and fluid together.  In axisymmetry x is the radius, y the axis, and zz acts
        along the hoops.  In plane strain zz acts across the plane; it is nan where
        the law is one of the user's for the plane only, and so are the invariants.
    mean_effective_stress : (n,), Pa
        p' = -tr(effective stress) / 3: compression is positive.
    deviatoric_stress : (n,), Pa
        q = sqrt(3/2 s : s), s the deviator of the stress: |axial - radial| stress in a triaxial test.
    porosity : (n,)
        Present volume fraction of the pores, 1 - (1 - n_0) / J.
    saturation : (n,)
        Share of the pores that is full of fluid; without fluid 0.
    """

    effective_stress: NDArray[np.float64]
    stress: NDArray[np.float64]
    mean_effective_stress: NDArray[np.float64]
    deviatoric_stress: NDArray[np.float64]
    porosity: NDArray[np.float64]
    saturation: NDArray[np.float64]


def point_fields(scene: Scene, points: MaterialPoints) -> PointFields:
    """Return the fields of some points; on all processes together."""
    materials, effective = scene.materials, scene.materials.effective_stress_3d(points)
    pore = materials.felt(points)
    mean = np.trace(effective, axis1=1, axis2=2) / 3
    deviator, stress = (effective - part[:, None, None] * np.eye(3) for part in (mean, pore))
    q = np.sqrt(1.5 * np.square(deviator).sum(axis=(1, 2)))
    full = np.full(len(points), 0.0 if scene.fluid is None else 1.0)
    if materials.retentions is not None:
        full = materials.saturation(points, points.pressure)[0]
    return PointFields(effective, stress, -mean, q, materials.porosity(points), full)
