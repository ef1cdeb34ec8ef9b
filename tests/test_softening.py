# SPDX-License-Identifier: MIT
"""Soil that softens with slip, and laws that use the time step: exact paths, and independence of the grid."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import ufl
from helpers import column
from scipy.optimize import brentq

import mpm_dolfinx as mpm
from mpm_dolfinx import element_test

C, G, SLIP = 1e4, 1e6, 0.1  # Pa, Pa, m
CLAY = mpm.SofteningDruckerPrager(
    bulk=20 * G, shear=G, friction=0.0, dilation=0.0, cohesion=C, residual=C / 4, slip=SLIP
)


def test_in_simple_shear_the_cohesion_falls_with_the_slip_in_a_cell():
    """Small strain, no friction: tau = c - (c - c_r) min(1, gamma_p h / s)."""
    h = 2.0
    t = element_test(CLAY, "shear drained", 0.12, steps=60, cell_size=h, rate=1.0)
    tau, gamma = t.stress[:, 0, 1], t.strain
    plastic = gamma - tau / G
    exact = C - 0.75 * C * np.minimum(1, plastic * h / SLIP)
    flows = gamma > C / G + 1e-9
    assert tau[flows] == pytest.approx(exact[flows], rel=2e-2)
    assert tau[-1] == pytest.approx(C / 4, rel=1e-2)
    assert t.state["hardened"][-1] == pytest.approx(plastic[-1], rel=1e-2)


def test_a_viscosity_adds_its_stress_at_a_rate():
    """tau = c + eta dgamma/dt in flow; at rest it would relax with eta / G."""
    viscous = replace(CLAY, residual=C, viscosity=1e5)
    fast, slow = (
        element_test(viscous, "shear undrained", 0.1, cell_size=1.0, rate=r).stress[-1, 0, 1] for r in (0.05, 1e-9)
    )
    assert slow == pytest.approx(C, rel=5e-3)
    assert fast - slow == pytest.approx(1e5 * 0.05, rel=5e-3)


def run_out(cells):
    """Return the run-out, in m, of a bank of 10 m whose weight increases within a second beyond its strength."""
    size, weight, h = 10.0, 1e4, 10.0 / cells
    grid = mpm.Grid([0, 0], [3 * size, size + h], [3 * cells, cells + 1])
    moduli = {"bulk": 60 * size * weight, "shear": 30 * size * weight, "friction": 0.0, "dilation": 0.0}
    strength = {"cohesion": 0.22 * size * weight, "residual": 0.1 * size * weight, "slip": 1.0}
    clay = mpm.SofteningDruckerPrager(**moduli, **strength, viscosity=0.01 * size * weight)

    def falls(points, v, t):
        grown = ufl.conditional(ufl.lt(t, 1), t, 1) * weight
        return grown / ufl.det(points.F) * points.value(v)[1] * points.dx

    walls = {"left": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [size, size])], [clay], walls=walls, terms=[falls])
    s.run(1.0, 0.2)
    s.run(21.0, 0.5)
    s.run(421.0, 100.0)
    return s.points.corners[:, :, 0].max() - size


@pytest.mark.slow
def test_a_bank_that_softens_slides_as_far_on_cells_half_as_large():
    """7.79, 7.78 and 7.47 m on 5, 10 and 20 cells. With softening by strain, it would be 8.21 m on 20 cells."""
    assert run_out(10) == pytest.approx(run_out(20), rel=0.05)


@dataclass(frozen=True)
class Maxwell(mpm.Skeleton):
    """Volume strain with a relaxing part: ln J = e + k, k' = e / relaxation, pressure K e; elastic in shear."""

    relaxation: mpm.Field = 1.0

    state: ClassVar = {"kept": 0.0}

    @staticmethod
    def kirchhoff(F, bulk, shear, relaxation, kept, dt):
        b = F * F.T
        return bulk * Maxwell.elastic(F, relaxation, kept, dt) * ufl.Identity(2) + shear * (b - ufl.Identity(2))

    @staticmethod
    def elastic(F, relaxation, kept, dt):
        return (ufl.ln(ufl.det(F)) - kept) / (1 + dt / relaxation)

    @staticmethod
    def update(F, relaxation, kept, dt):
        return {"kept": ufl.ln(ufl.det(F)) - Maxwell.elastic(F, relaxation, kept, dt)}


def crept(steps, dt, load, m):
    """Return the stretch of a column after steps of dt, in s, under a load, in Pa: recurrence of backward Euler."""
    kept = 0.0
    for _ in range(steps):

        def stress(a, kept=kept):
            return (m.bulk * (np.log(a) - kept) / (1 + dt / m.relaxation) + m.shear * (a * a - 1)) / a

        stretch = brentq(lambda a: stress(a) + load, 0.3, 1.5, xtol=1e-15)
        kept = np.log(stretch) - (np.log(stretch) - kept) / (1 + dt / m.relaxation)
    return stretch


@pytest.mark.parametrize("fluid", [False, True])
def test_a_law_sees_the_length_of_the_step(fluid):
    """Also with flowing water, where a step has two substeps."""
    m = Maxwell(bulk=2e6, shear=1e6, relaxation=2.0, conductivity=1e3)
    top = [mpm.Traction("top", (0, -3e5)), *[mpm.Drained("top")] * fluid]
    s = column(cells=3, material=m, fluid=fluid, conditions=top)
    for _ in range(3):
        s.step(1.0)
    height = s.points.corners[:, :, 1].max()
    assert height == pytest.approx(crept(3, 1.0, 3e5, m), rel=1e-4 if fluid else 1e-9)
    assert s.effective_stress()[:, 1, 1] == pytest.approx(-3e5, rel=1e-3 if fluid else 1e-7)
    if not fluid:
        with pytest.raises(ValueError, match="must be left out: without flow of fluid, velocities have no error"):
            s.run(4.0, rtol=1e-3)


def test_one_line_says_what_is_wrong():
    for options, message in (
        ({"residual": 2 * C}, r"residual = 20000.0, must be in \[0, cohesion\]"),
        ({"slip": None}, "slip is not given, must be > 0 m"),
        ({"hardening": 1.0}, "hardening = 1.0, must be 0: this law softens"),
        ({"viscosity": -1.0}, "viscosity = -1.0, must be >= 0 and finite"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(CLAY, **options)
    with pytest.raises(ValueError, match=r"slip = 0.0001, must be > 0.0025 m in cells of 0.333333 m"):
        column(cells=3, fluid=False, material=replace(CLAY, slip=1e-4))
    with pytest.raises(ValueError, match="rate is not given, must be > 0: SofteningDruckerPrager depends on it"):
        element_test(CLAY, "oedometer", 0.1)
    named = type("Named", (mpm.Hencky,), {"state": {"dt": 0.0}})
    with pytest.raises(ValueError, match="Named: the name 'dt' is taken"):
        column(cells=3, fluid=False, material=named(bulk=1e6, shear=1e6))
