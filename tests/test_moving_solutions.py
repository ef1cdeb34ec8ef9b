# SPDX-License-Identifier: MIT
"""Manufactured motions at large strain are met at second order in the cells and steps together."""

import numpy as np
import pytest
import ufl

import mpm_dolfinx as mpm

YOUNG, NU, RHO = 1e3, 0.3, 1e3  # waves of 1 m/s along a bar
LAM, MU = YOUNG * NU / (1 + NU) / (1 - 2 * NU), YOUNG / 2 / (1 + NU)
SOIL = mpm.NeoHookean(bulk=LAM + 2 / 3 * MU, shear=MU, grain_density=2 * RHO, porosity=0.5)


def pushed(force):
    """Return the term of a body force, m/s^2, UFL of reference positions and time, of the mass at rest."""

    def term(points, v, t):
        b = force(points.position - points.displacement, t)
        return -RHO / ufl.det(points.F) * ufl.inner(b, points.value(v)) * points.dx

    return term


def swinging_apart(n, t_end, amplitude=0.05):
    """Return the error of u, over its amplitude, of x_i = X_i + A sin(2 pi X_i) sin(pi t + phi_i), phi = (0, pi).

    Wallstedt and Guilkey (2008), between walls that let slide.
    """
    phase = (0.0, np.pi)

    def u(X, t, sin):
        return [amplitude * sin(2 * np.pi * X[i]) * sin(np.pi * t + phase[i]) for i in range(2)]

    def force(X, t):
        swing = [ufl.sin(np.pi * t + p) for p in phase]
        F = [1 + 2 * np.pi * amplitude * ufl.cos(2 * np.pi * X[i]) * swing[i] for i in range(2)]
        J, now = F[0] * F[1], u(X, t, ufl.sin)
        each = [4 * MU / RHO - 1 - 4 * (LAM * (ufl.ln(J) - 1) - MU) / (RHO * F[i] ** 2) for i in range(2)]
        return ufl.as_vector([np.pi**2 * now[i] * each[i] for i in range(2)])

    def velocity(x):
        return np.pi * amplitude * np.sin(2 * np.pi * x) * np.cos(phase)

    grid = mpm.Grid([0, 0], [1, 1], [n, n])
    walls = {"left": "x", "right": "x", "bottom": "y", "top": "y"}
    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [1, 1])],
        [SOIL],
        walls=walls,
        terms=[pushed(force)],
        inertia=True,
        velocity=velocity,
    )
    s.run(t_end, 1 / n, progress=False)
    X = s.points.reference
    found = s.points.corners - X
    exact = np.stack(u(np.moveaxis(X, 2, 0), s.t, np.sin), axis=2)
    return np.abs(found - exact).max() / amplitude


@pytest.mark.slow
def test_a_square_whose_sides_swing_apart_is_met_at_second_order():
    off = [swinging_apart(n, 1.5) for n in (8, 16, 32)]
    assert off[1] < 0.02 and np.log2(off[0] / off[1]) > 1.8 and np.log2(off[1] / off[2]) > 1.8, off
