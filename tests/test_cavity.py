# SPDX-License-Identifier: MIT
"""A cylindrical cavity in von Mises's soil is widened undrained, by the given displacement of its wall."""

import numpy as np
import pytest
from scipy.integrate import quad

import mpm_dolfinx as mpm

RIGIDITY, OUTER = 50.0, 10.0  # G over s_u, outer radius over that of the cavity
MARKS = (1.05, 1.2, 1.5, 2.0)  # radius of the cavity over the first one


def exact(a):
    """Return (p_a - p_b) / s_u of incompressible soil at a / a0: the integral of the difference of the stresses.

    tau_theta - tau_r is 4G ln(r/R) up to 2 s_u, R^2 = r^2 - a^2 + a0^2.
    """
    b, elastic = np.sqrt(OUTER**2 + a**2 - 1), np.exp(1 / (2 * RIGIDITY))
    flows = np.sqrt((a**2 - 1) / (1 - elastic**-2))  # radius up to which it does
    plastic, inner = min(flows, b), 2 * np.log(min(flows, b) / a)
    return inner + quad(lambda r: -2 * RIGIDITY * np.log(1 - (a**2 - 1) / r**2) / r, plastic, b)[0]


def pressures(cells, bulk, marks):
    """Return (p_a - p_b) / s_u of a quarter of the ring at the marks.

    Parameters
    ----------
    cells
        Over the cavity's radius; its wall goes a fifth of one in a step.
    bulk
        Bulk modulus over G.
    marks
        Radii of the cavity over the first one, multiples of a fifth of a cell.
    """
    h = 1 / cells
    size = int(np.ceil(np.sqrt(OUTER**2 + marks[-1] ** 2 - 1) / h)) + 2
    grid = mpm.Grid([size * h] * 2, [size] * 2)

    def angle(X):
        return X[:, 1:] * np.pi / (2 * (OUTER - 1))

    def ray(X):
        return np.concatenate([np.cos(angle(X)), np.sin(angle(X))], axis=1)

    body = mpm.box(grid, [0, 0], [OUTER - 1] * 2)
    body = mpm.mapped(grid, body, lambda X: (1 + X[:, :1]) * ray(X))
    soil = mpm.DruckerPrager(bulk=bulk * RIGIDITY, shear=RIGIDITY, friction=0.0, dilation=0.0, cohesion=1.0)
    wall = mpm.Displacement("left", lambda t, X: t * ray(X))
    s = mpm.Simulation(grid, [body], [soil], fixed={"left": "x", "bottom": "y"}, displacements=[wall])
    found = []
    for mark in marks:
        steps = round((mark - 1 - s.t) / (0.2 * h) + 0.499)
        s.run(mark - 1, (mark - 1 - s.t) / steps)
        found.append(s.reactions[0] / mark)
        print(f"{cells} cells, K = {bulk:g} G, a/a0 = {mark}: {found[-1]} s_u, exact {exact(mark):.4f}")
    return np.array(found)


def check(cells, bulk, marks, error):
    __tracebackhide__ = True
    reference = np.array([exact(a) for a in marks])[:, None]
    assert pressures(cells, bulk, marks) == pytest.approx(np.tile(reference, 2), rel=error)


def test_the_exact_pressures_are_those_of_fine_quadrature():
    assert [exact(a) for a in MARKS] == pytest.approx([2.4903, 3.5121, 3.7100, 3.2484], abs=5e-5)


@pytest.mark.parametrize("bulk", [10, 1000])
def test_a_cavity_is_widened_in_soil_that_flows(bulk):
    """By 1.6 % less pressure at first than incompressible soil with K = 10 G."""
    check(4, bulk, MARKS[:2], 0.07)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cells", "bulk", "marks", "error"), [(8, 10, 4, 0.03), (8, 1000, 4, 0.015), (16, 1000, 2, 0.01)]
)
def test_pressures_in_a_cavity_converge(cells, bulk, marks, error):
    check(cells, bulk, MARKS[:marks], error)
