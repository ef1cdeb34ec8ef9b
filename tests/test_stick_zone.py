# SPDX-License-Identifier: MIT
"""Stick and slip under a disc that is pressed into a block and pulled sideways (Cattaneo 1938, Mindlin 1949)."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

E = 1e6  # Pa


def pulled(cells, size, steps, per_cell):
    """Yield the contact while a disc on a nearly incompressible block is pulled: Q / (mu P), positions, p and q.

    The half-width is about 1 m. A stiff disc on such a block acts as a contact of equal bodies.
    """
    R, mu, h = 20.0, 0.3, 1 / cells
    grid = mpm.Grid([-size, 0], [size, size + 4 * h], [round(2 * size * cells), round(size * cells) + 4])
    top = size + 0.3 * h
    disc = mpm.Ball((0, top + R), R)
    tool = mpm.Tool(disc, lambda t: (0.016 * max(0, t - 1), -0.05 * min(1, t)), friction=mu)
    gel = mpm.Hencky(bulk=E / (3 - 6 * 0.49), shear=E / (2 + 2 * 0.49))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, [mpm.box(grid, [-size, 0], [size, top], per_cell)], [gel], walls=walls, conditions=[tool])
    s.run(1.0, 1.0)
    for k in range(1, steps + 1):
        s.run(1 + k / 4, 0.25)
        p, q = s.points.data["tool_pressure"], s.points.data["tool_shear"][:, 0]
        on = np.flatnonzero(p > 0)
        on = on[np.argsort(s.points.x[on, 0])]
        yield -s.tool_forces.array[0, 0] / (mu * s.tool_forces.array[0, 1]), s.points.x[on, 0], mu * p[on], q[on]


def ellipse(x, values, half):
    """Return the half-width of the ellipse that is fitted to values (n,) at x (n,) over the inner 0.8 of it."""
    middle = 0.0
    for _ in range(5):
        inner = np.abs(x - middle) < 0.8 * half
        a, b, c = np.polyfit(x[inner], values[inner] ** 2, 2)
        middle, half = -b / (2 * a), np.sqrt((b / (2 * a)) ** 2 - c / a)
    return half


@pytest.mark.slow
def test_a_disc_that_is_pulled_sticks_where_cattaneo_and_mindlin_say():
    """mu p minus the shear is an ellipse over the stick zone; 16 cells over the half-width."""
    for pull, x, most, q in pulled(16, 6.0, 3, 1):
        exact = np.sqrt(1 - pull)
        half = ellipse(x, most, 1.0)
        stick = ellipse(x, most - q, exact * half) / half
        print(f"Q/(mu P) = {pull:.3f}: stick zone {stick:.4f}, exact {exact:.4f} of the half-width")
        assert half == pytest.approx(1.0, rel=0.1)
        assert stick == pytest.approx(exact, rel=0.03)


def test_shear_where_it_sticks_does_not_alternate_from_cell_to_cell():
    """Stiff friction causes shears of alternating signs, as large as their mean, which displace no node."""
    *_, (pull, x, _, q) = pulled(8, 4.0, 2, 1)
    inner = q[np.abs(x) < 0.45]
    assert pull == pytest.approx(0.35, abs=0.05) and len(inner) == 8
    assert np.abs(inner[1:-1] - (inner[:-2] + inner[2:]) / 2).max() < 0.2 * inner.mean()
