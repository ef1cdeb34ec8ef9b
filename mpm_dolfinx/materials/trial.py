# SPDX-License-Identifier: MIT
"""Trial elastic strain of multiplicative plasticity, and isotropic functions, in UFL and in numpy.

In UFL, isotropic functions of a tensor are Newton's interpolation polynomials at its eigenvalues.  The polynomials are
exact for smooth functions of each eigenvalue, and remain smooth at equal eigenvalues.  In numpy, `Coaxial` computes the
exact derivatives of return mappings, where each stress depends on all three eigenvalues.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.forms.axes import embedded, planar
from mpm_dolfinx.materials.skeleton import _eigenvalues

PLANE, SPACE = ((0, 0), (1, 1), (2, 2), (0, 1)), ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Indices of the components of a symmetric tensor: `PLANE` in plane strain and axisymmetry, `SPACE` in 3D."""


class Isotropic:
    """Isotropic functions of a symmetric UFL tensor (3, 3)."""

    def __init__(self, b, plane: bool):
        self._b, self._plane = b, plane
        block = ufl.as_matrix([[b[i, j] for j in (0, 1)] for i in (0, 1)]) if plane else b
        self._nodes = _eigenvalues(block, NEAR)

    def __call__(self, f: Callable):
        """Return the tensor f(b) (3, 3) for a function f of one eigenvalue."""
        b = self._b
        I = ufl.Identity(3)
        x = self._nodes
        y = [f(node) for node in self._nodes]
        slope = (y[0] - y[1]) / (x[0] - x[1])
        linear = y[0] * I + slope * (b - x[0] * I)
        if self._plane:
            rows = [[linear[i, j] if i < 2 and j < 2 else 0 for j in range(3)] for i in range(3)]
            rows[2][2] = f(b[2, 2])
            return ufl.as_matrix(rows)
        bend = (slope - (y[1] - y[2]) / (x[1] - x[2])) / (x[0] - x[2])
        return linear + bend * (b - x[0] * I) * (b - x[1] * I)


class Trial:
    """Trial elastic strain for a deformation gradient, in UFL.

    `F`: deformation gradient (d, d).
    `plastic`: C_p^-1 (3, 3).
    `prestretch`: principal elastic stretches (3,) at F = I, or None if all are 1.
    """

    def __init__(self, F, plastic, prestretch=None):
        self.F = embedded(F)
        if prestretch is not None:
            self.F = self.F * ufl.diag(prestretch)
        self.isotropic = Isotropic(self.F * plastic * self.F.T, planar(F))
        strain = self.isotropic(lambda e: ufl.ln(e) / 2)
        self.volumetric = ufl.tr(strain)
        self.deviatoric = strain - self.volumetric / 3 * ufl.Identity(3)


def components(b, plane: bool):
    """Return the components of a symmetric UFL tensor (3, 3), in the order of `PLANE` or `SPACE`."""
    return ufl.as_vector([b[i] for i in (PLANE if plane else SPACE)])


def symmetric(values):
    """Return the symmetric UFL tensor (3, 3) with the six components `values` in the order of `SPACE`."""
    place = {}
    for k, (i, j) in enumerate(SPACE):
        place[i, j] = place[j, i] = values[k]
    return ufl.as_matrix([[place[i, j] for j in range(3)] for i in range(3)])


def eigen(b: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return eigenvalues (n, 3), and axes (n, 3, 3) as columns, of tensors with the components b (n, 4 or 6)."""
    n = len(b)
    if b.shape[1] == len(SPACE):
        full = np.empty((n, 3, 3))
        for k, (i, j) in enumerate(SPACE):
            full[:, i, j] = full[:, j, i] = b[:, k]
        invalid = ~np.isfinite(b).all(axis=1)  # in a diverging iterate
        full[invalid] = np.eye(3)
        x, axes = np.linalg.eigh(full)
        return np.where(invalid[:, None], np.nan, x), axes
    xx, yy, zz, xy = b.T.copy()  # of a strided column, rounding in arctan2 would depend on memory addresses
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    radius, angle = np.hypot(half, xy), np.arctan2(xy, half) / 2
    axes, (c, s) = np.zeros((n, 3, 3)), (np.cos(angle), np.sin(angle))
    axes[:, 0, 0] = c
    axes[:, 1, 0] = s
    axes[:, 0, 1] = -s
    axes[:, 1, 1] = c
    axes[:, 2, 2] = 1.0
    return np.stack([mean + radius, mean - radius, zz], axis=1), axes


class Coaxial:
    """Tensors (n, 3, 3) with the principal axes of n given tensors.

    `x` (n, 3): eigenvalues of the given tensors.  `axes` (n, 3, 3): their principal axes, see `eigen`.
    `y` (n, 3): principal values of the new tensors.
    `plane`: whether the given tensors have only the components in `PLANE`.
    """

    def __init__(self, x: NDArray[np.float64], axes: NDArray[np.float64], y: NDArray[np.float64], plane: bool):
        self._x = x
        self._axes = axes
        self._y = y
        self._inner, self._pairs = (PLANE, ((0, 1),)) if plane else (SPACE, ((0, 1), (0, 2), (1, 2)))
        self._outer = np.stack([self._dyad(a, a) for a in range(3)], axis=2)

    def _dyad(self, a: int, b: int) -> NDArray[np.float64]:
        """Return the components of the symmetric dyad of two axes."""
        u, v = self._axes[:, :, a], self._axes[:, :, b]
        return np.stack([(u[:, i] * v[:, j] + u[:, j] * v[:, i]) / 2 for i, j in self._inner], axis=1)

    @property
    def values(self) -> NDArray[np.float64]:
        """Components (n, 6) of the tensors."""
        out = np.zeros((len(self._x), len(SPACE)))  # in the plane the other components are zero
        out[:, : len(self._inner)] = (self._outer @ self._y[:, :, None])[:, :, 0]
        return out

    def tangent(self, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives (n, 6, components) of `values` with respect to the components of the given tensors.

        In principal axes, dy_ij = (y_i - y_j) / (x_i - x_j) dx_ij for i != j.  The limit for x_i = x_j is
        (dy_i/dx_i - dy_i/dx_j) dx_ij.

        `slopes` (n, 3, 3): dy/dx.
        """
        x = self._x
        y = self._y
        inner = len(self._inner)
        twice = np.array([1.0 if i == j else 2.0 for i, j in self._inner])
        found = np.zeros((len(x), len(SPACE), inner))
        tangent = found[:, :inner]
        tangent[:] = self._outer @ slopes @ (self._outer * twice[:, None]).transpose(0, 2, 1)
        for a, b in self._pairs:
            gap = x[:, a] - x[:, b]
            equal = np.abs(gap) <= SAME * np.abs(x[:, a])
            spin = np.where(equal, slopes[:, a, a] - slopes[:, a, b], (y[:, a] - y[:, b]) / np.where(equal, 1.0, gap))
            side = self._dyad(a, b)
            tangent += (2 * spin[:, None] * side)[:, :, None] * (side * twice)[:, None, :]
        return found
