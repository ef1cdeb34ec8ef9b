# SPDX-License-Identifier: MIT
"""Undrained strength of Modified Cam Clay, from a triaxial test at one point, without a grid."""

import mpm_dolfinx as mpm

clay = mpm.ModifiedCamClay(
    M=1.2,
    lambda_=0.1,
    kappa=0.02,
    shear=5e6,
    initial_stress=(-1e5, -1e5, -1e5),  # Pa: the clay is consolidated under 100 kPa
    OCR=1.5,
)
test = mpm.element_test(clay, "triaxial undrained", strain=0.3)
test.draw("triaxial.png")
print(f"undrained strength: {test.q[-1] / 2000:.1f} kPa")
