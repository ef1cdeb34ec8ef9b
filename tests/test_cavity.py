# SPDX-License-Identifier: MIT
"""Undrained expansion of a cylindrical cavity in von Mises soil, by a prescribed displacement of its wall."""

import numpy as np
import pytest
from scipy.integrate import quad

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.cavity import cavity

RIGIDITY, OUTER, NEAR = 50.0, 10.0, 5.0  # G over s_u; outer radii over that of the cavity
MARKS = (1.05, 1.2, 1.5, 2.0)  # radius of the cavity over the first one


def exact(a, outer=OUTER):
    """Return (p_a - p_b) / s_u of incompressible soil at a / a0, the integral of the stress difference.

    tau_theta - tau_r is 4G ln(r/R), limited to 2 s_u, with R^2 = r^2 - a^2 + a0^2.
    """
    b, elastic = np.sqrt(outer**2 + a**2 - 1), np.exp(1 / (2 * RIGIDITY))
    flows = np.sqrt((a**2 - 1) / (1 - elastic**-2))  # radius up to which it does
    plastic, inner = min(flows, b), 2 * np.log(min(flows, b) / a)
    return inner + quad(lambda r: -2 * RIGIDITY * np.log(1 - (a**2 - 1) / r**2) / r, plastic, b)[0]


def soil(bulk):
    """Return von Mises soil with s_u = 1 and a bulk modulus, divided by G."""
    return mpm.DruckerPrager(bulk=bulk * RIGIDITY, shear=RIGIDITY, friction=0.0, dilation=0.0, cohesion=1.0)


def pressures(cells, bulk, marks, outer):
    """Return (p_a - p_b) / s_u of a quarter of the ring at the marks.

    Parameters
    ----------
    cells
        Over the cavity's radius; its wall goes a fifth of one in a step.
    bulk
        Bulk modulus over G.
    marks
        Radii of the cavity over the first one, multiples of a fifth of a cell.
    outer
        Radius of the ring over that of the cavity.
    """
    h = 1 / cells
    size = int(np.ceil(np.sqrt(outer**2 + marks[-1] ** 2 - 1) / h)) + 2
    grid = mpm.Grid([0] * 2, [size * h] * 2, [size] * 2)

    def angle(X):
        return X[:, 1:] * np.pi / (2 * (outer - 1))

    def ray(X):
        return np.concatenate([np.cos(angle(X)), np.sin(angle(X))], axis=1)

    body = mpm.box(grid, [0, 0], [outer - 1] * 2)
    body = mpm.mapped(grid, body, lambda X: (1 + X[:, :1]) * ray(X))
    wall = mpm.Displacement("left", lambda t, X: t * ray(X))
    s = mpm.Simulation(grid, [body], [soil(bulk)], walls={"left": "x", "bottom": "y"}, conditions=[wall])
    found = []
    for mark in marks:
        steps = round((mark - 1 - s.t) / (0.2 * h) + 0.499)
        s.run(mark - 1, (mark - 1 - s.t) / steps)
        found.append(s.reactions.array[0] / mark)
        print(
            f"{cells} cells, K = {bulk:g} G, a/a0 = {mark}: {found[-1]} s_u, exact {exact(mark, outer):.4f}, "
            f"{found[-1].mean() / exact(mark, outer) - 1:+.2%}"
        )
    return np.array(found)


def radial(bulk, outer):
    """Return the solution of `exact` by radial elements, for soil with a finite bulk modulus, divided by G."""
    hole, found = cavity(soil(bulk), outer, 150), []
    for a in np.unique(np.round([*np.linspace(1.0025, 1.1, 40), *np.linspace(1.11, MARKS[-1], 90), *MARKS], 9)):
        hole = hole.widened(a)
        found += [hole.pressure] * (a in MARKS)
    return np.array(found)


def check(reference, *scene, error):
    __tracebackhide__ = True
    assert pressures(*scene) == pytest.approx(np.tile(np.array(reference)[:, None], 2), rel=error)


def test_the_exact_pressures_are_those_of_fine_quadrature():
    assert [exact(a) for a in MARKS] == pytest.approx([2.4903, 3.5121, 3.7100, 3.2484], abs=5e-5)


@pytest.mark.parametrize("bulk", [10, 1000])
def test_a_cavity_is_widened_in_soil_that_flows(bulk):
    """With K = 10 G, the first pressure is 1.6 % lower than in incompressible soil."""
    check([exact(a) for a in MARKS[:2]], 4, bulk, MARKS[:2], OUTER, error=0.07)


@pytest.mark.slow
@pytest.mark.parametrize("bulk", [10, 1000])
@pytest.mark.parametrize(("cells", "error"), [(8, 0.015), (16, 0.005)])
def test_pressures_in_a_cavity_converge(cells, error, bulk):
    """Undrained expansion to twice the radius. The radial elements have K = 1000 G."""
    reference = radial(bulk, NEAR)
    if bulk == 1000:
        assert reference == pytest.approx([exact(a, NEAR) for a in MARKS], rel=2e-4)
    check(reference, cells, bulk, MARKS, NEAR, error=error)
