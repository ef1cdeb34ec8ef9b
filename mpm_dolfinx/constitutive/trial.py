# SPDX-License-Identifier: MIT
"""The trial elastic strain of multiplicative plasticity, and isotropic functions of it, in UFL."""

from __future__ import annotations

import ufl

from mpm_dolfinx.constitutive.skeleton import _eigenvalues


class Trial:
    """The trial elastic strain of a deformation gradient, in UFL.

    Isotropic functions of b are Newton's interpolation polynomials at its eigenvalues: exact, and smooth where
    eigenvalues are equal, because nodes need not be eigenvalues and are kept apart.
    """

    def __init__(self, F, plastic, prestretch=None):
        self.plane = F.ufl_shape == (2, 2)
        self.F = F
        if self.plane:
            self.F = ufl.as_matrix([[F[0, 0], F[0, 1], 0], [F[1, 0], F[1, 1], 0], [0, 0, 1]])
        if prestretch is not None:
            self.F = self.F * ufl.diag(prestretch)
        self.b = self.F * plastic * self.F.T
        block = ufl.as_matrix([[self.b[i, j] for j in (0, 1)] for i in (0, 1)]) if self.plane else self.b
        self.nodes = _eigenvalues(block, 1e-6)
        strain = self.isotropic(lambda e: ufl.ln(e) / 2)
        self.volumetric = ufl.tr(strain)
        self.deviatoric = strain - self.volumetric / 3 * ufl.Identity(3)

    def isotropic(self, f):
        """Return f(b) (3, 3) for a function of the eigenvalues."""
        b, I, x, y = self.b, ufl.Identity(3), self.nodes, [f(node) for node in self.nodes]
        slope = (y[0] - y[1]) / (x[0] - x[1])
        linear = y[0] * I + slope * (b - x[0] * I)
        if self.plane:
            rows = [[linear[i, j] if i < 2 and j < 2 else 0 for j in range(3)] for i in range(3)]
            rows[2][2] = f(b[2, 2])
            return ufl.as_matrix(rows)
        bend = (slope - (y[1] - y[2]) / (x[1] - x[2])) / (x[0] - x[2])
        return linear + bend * (b - x[0] * I) * (b - x[1] * I)
