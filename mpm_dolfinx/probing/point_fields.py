# SPDX-License-Identifier: MIT
"""Fields of the material points: stresses in three dimensions, stress invariants, porosity, saturation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.scene import Scene


@dataclass(frozen=True)
class PointFields:
    """Fields of the n material points of this process. Stresses are Cauchy stresses, tension positive.

    Attributes
    ----------
    effective_stress, stress : (n, 3, 3), Pa
        Effective and total stress.  In axisymmetry x is radial, y is axial, and zz is the circumferential stress.  In
        plane strain zz is the out-of-plane stress.  User-defined laws may not define this stress; zz and the invariants
        are then nan.
    mean_effective_stress : (n,), Pa
        `p' = -tr(effective stress) / 3`, positive in compression.
    deviatoric_stress : (n,), Pa
        `q = sqrt(3/2 s : s)`, with the deviatoric stress s. In a triaxial test q is |axial stress - radial stress|.
    porosity : (n,)
        Present porosity, `1 - (1 - n_0) / J`, with the initial porosity n_0 and the volume ratio J.
    saturation : (n,)
        Degree of saturation of the pores; 0 without fluid.
    """

    effective_stress: NDArray[np.float64]
    stress: NDArray[np.float64]
    mean_effective_stress: NDArray[np.float64]
    deviatoric_stress: NDArray[np.float64]
    porosity: NDArray[np.float64]
    saturation: NDArray[np.float64]


def point_fields(scene: Scene, points: MaterialPoints) -> PointFields:
    """Return the fields at some points; all processes must call it."""
    materials, effective = scene.materials, scene.materials.effective_stress_3d(points)
    pore = materials.pore_stress(points)
    mean = np.trace(effective, axis1=1, axis2=2) / 3
    deviator, stress = (effective - part[:, None, None] * np.eye(3) for part in (mean, pore))
    q = np.sqrt(1.5 * np.square(deviator).sum(axis=(1, 2)))
    full = np.full(len(points), 0.0 if scene.fluid is None else 1.0)
    if materials.retentions is not None:
        full = materials.saturation(points, points.pressure)[0]
    return PointFields(effective, stress, -mean, q, materials.porosity(points), full)
