# SPDX-License-Identifier: MIT
"""Cylindrical cavities in soil, radial, at finite strain, with the laws of the package; not collected by pytest."""

import numpy as np
import ufl
from laws import LawAtPoints
from scipy.linalg import solve_banded

from mpm_dolfinx.forms.point_forms import PointExpression


class Cavity:
    """A ring of soil in plane strain, linear elements with one point each, its hole widened, its outside pressed.

    The hole has the radius 1; the soil begins in equilibrium with the same pressure inside and outside.
    """

    def __init__(self, material, outer, elements=300, state=None):
        self.R = np.geomspace(1, outer, elements + 1)
        self._middle, self._h = (self.R[1:] + self.R[:-1]) / 2, np.diff(self.R)
        self._law = law = LawAtPoints(material, 3)
        parts = [law.P[0, 0], law.P[1, 1]]
        by = [ufl.diff(part, law.F) for part in parts]
        slopes = [d[i, i] for d in by for i in (0, 1)]
        self._radial = PointExpression(ufl.as_vector([*parts, *slopes]), law.points)
        self.state = {name: np.tile(np.asarray(v), (elements, *[1] * np.ndim(v))) for name, v in law.law.state.items()}
        self.state |= {name: np.tile(v, (elements, *[1] * np.ndim(v))) for name, v in (state or {}).items()}
        self.r = self.R.copy()
        self.far = -self._stress(self.r)[-1, 0]

    def _gradients(self, r):
        F = np.tile(np.eye(3), (len(self._h), 1, 1))
        F[:, 0, 0], F[:, 1, 1] = np.diff(r) / self._h, (r[1:] + r[:-1]) / (2 * self._middle)
        return F

    def _stress(self, r):
        return self._law.evaluate(self._radial, self._gradients(r), self.state)

    def widen(self, radius):
        """Widen the hole to a radius in one step, drained; return the pressure in it, Pa."""
        n, r = len(self.R), self.r.copy()
        r += (radius - r[0]) * r[0] / r  # as if incompressible
        r[0] = radius
        for _ in range(40):
            P = self._stress(r)
            weight, g, t = self._middle * self._h, 1 / self._h, 1 / (2 * self._middle)
            force = np.zeros(n)
            np.add.at(force, np.arange(n - 1), weight * (-g * P[:, 0] + t * P[:, 1]))
            np.add.at(force, np.arange(1, n), weight * (g * P[:, 0] + t * P[:, 1]))
            internal = force[0]
            force[-1] += self.far * r[-1]  # the pressure follows the surface
            scale = np.abs(force).max() + np.abs(internal) + self.far * r[-1]
            force[0] = 0.0
            if np.abs(force).max() < 1e-11 * scale:
                self.state = self.state | self._law.update(self._gradients(r), self.state)
                self.r = r
                return internal / r[0]
            B = np.array([[-g, t], [g, t]])  # (node, strain, element)
            D = P[:, 2:].reshape(-1, 2, 2)
            K = np.einsum("ase,est,bte->eab", B, D, B) * weight[:, None, None]
            bands = np.zeros((3, n))
            np.add.at(bands[1], np.arange(n - 1), K[:, 0, 0])
            np.add.at(bands[1], np.arange(1, n), K[:, 1, 1])
            bands[0, 1:], bands[2, :-1] = K[:, 0, 1], K[:, 1, 0]
            bands[1, -1] += self.far
            bands[1, 0], bands[0, 1] = 1.0, 0.0
            step, length = solve_banded((1, 1), bands, force), 1.0
            while np.any(np.diff(r - length * step) <= 0):
                length /= 2
            r = r - length * step
        raise RuntimeError(f"no equilibrium at a radius of {radius:g}")


def undrained(material, outer, widened, points=2000):
    """Return the difference of total pressures over a ring, and the effective radial stress at its wall, Pa.

    All radii follow from the constant volume, so that each point is driven alone: r^2 - a^2 = R^2 - 1.
    widened: radii of the hole, in steps that are small.
    """
    law = LawAtPoints(material, 3)
    edges = np.geomspace(1, outer, points + 1)
    R = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2)
    state = {name: np.tile(np.asarray(v), (points, *[1] * np.ndim(v))) for name, v in law.law.state.items()}
    for a in widened:
        r = np.sqrt(R**2 + a**2 - 1)
        F = np.tile(np.eye(3), (points, 1, 1))
        F[:, 0, 0], F[:, 1, 1] = R / r, r / R
        tau = law.kirchhoff(F, state)
        state = state | law.update(F, state)
    ends = np.sqrt(edges**2 + a**2 - 1)
    drop = np.sum((tau[:, 1, 1] - tau[:, 0, 0]) * np.log(ends[1:] / ends[:-1]))
    wall = np.polyfit(R[:3] - 1, tau[:3, 0, 0], 2)[-1]  # effective radial stress
    return drop, wall
