# SPDX-License-Identifier: MIT
"""The finite element reference: beam theory, consolidation, and comparison of its two elements."""

import numpy as np
import pytest
import ufl
from helpers import SOFT, top_load
from test_unsaturated import WATER, Celia, Pressed, column, water

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM
from mpm_dolfinx.verification.exact import euler_bernoulli

SIZE, TIP = ([0, 0], [1, 0.3]), [[1.0, 0.15]]


def test_a_lightly_loaded_beam_follows_beam_theory():
    load = mpm.Traction("top", (0, -10.0))
    fem = BiotFEM(mpm.Grid(*SIZE, (24, 8)), SOFT, walls={"left": "xy"}, conditions=[load])
    tip = fem.run(1.0, 1.0, probes=TIP).displacement[-1][0, 1]
    bending = euler_bernoulli(np.array([1.0]), 10.0, 1.0, 1e7, 0.3**3 / 12)[0]
    shear = 10.0 / (2 * 5 / 6 * 5e6 * 0.3)
    assert -tip == pytest.approx(bending + shear, rel=5e-3)


def test_both_elements_converge_to_one_answer():
    tips = {}
    for element, cells in {"taylor-hood": (20, 6), "q1-dg0": (67, 20)}.items():
        drained = [mpm.Drained("left"), mpm.Drained("right")]
        options = dict(walls={"left": "xy"}, fluid=mpm.Fluid(), conditions=[top_load(), *drained])
        fem = BiotFEM(mpm.Grid(*SIZE, cells), SOFT, element=element, **options)
        result = fem.run(0.2, 0.02, probes=TIP)
        assert result.converged and result.residual <= 1e-8
        tips[element] = result.displacement[-1][0, 1]
    assert tips["q1-dg0"] == pytest.approx(tips["taylor-hood"], rel=5e-3)


@pytest.mark.parametrize("element", ["taylor-hood", "q1-dg0"])
def test_one_dimensional_consolidation_follows_terzaghi(element):
    options = dict(walls={"left": "x", "right": "x", "bottom": "y"}, fluid=mpm.Fluid(bulk=np.inf))
    load, drained = mpm.Traction("top", (0, -100.0)), [mpm.Drained("top")]
    fem = BiotFEM(mpm.Grid([0, 0], [0.1, 1], (1, 40)), SOFT, element=element, conditions=[load, *drained], **options)
    t = 0.5 / (SOFT.conductivity / 9810 * SOFT.oedometric)
    result = fem.run(t, t / 100, probes=[[0.05, 1.0]])
    settlement = -result.displacement[-1][0, 1] / (100 / SOFT.oedometric)
    assert settlement == pytest.approx(0.7639503, rel=4e-3)  # degree of consolidation at T_v = 0.5
    assert result.pressure[-1][1] == pytest.approx(37.07774, rel=1e-2)


def test_a_term_of_the_velocity_and_a_spring_make_a_dry_block_creep_exactly():
    """A Kelvin-Voigt material with twice the stiffness: strain = q / 2M (1 - exp(-2M t / eta))."""
    eta, load, modulus = 1e8, 1e3, SOFT.oedometric

    def damper(points, velocity, v):
        return eta * ufl.inner(ufl.sym(points.grad(velocity)), ufl.sym(points.grad(v))) * points.dx

    def stiffer(points, u):  # an energy: as much again as the oedometric modulus
        strain = points.grad(points.displacement + u)
        return modulus / 2 * strain[1, 1] ** 2 / ufl.det(points.F) * points.dx

    walls = {"left": "x", "right": "x", "bottom": "y"}
    top = mpm.Traction("top", (0, -load))
    fem = BiotFEM(mpm.Grid([0, 0], [1, 1], (2, 2)), SOFT, walls=walls, conditions=[top], terms=[damper, stiffer])
    result = fem.run(20.0, 0.5, probes=[[0.5, 1.0]])
    exact = load / (2 * modulus) * (1 - np.exp(-2 * modulus * 20.0 / eta))
    assert -result.displacement[-1][0, 1] == pytest.approx(exact, rel=2e-3)


def test_terms_that_the_reference_cannot_take_are_refused_in_a_line():
    def reference(**options):
        return BiotFEM(mpm.Grid([0, 0], [1, 1], (2, 2)), SOFT, walls={"left": "xy"}, **options)

    with pytest.raises(ValueError, match="drained sides and sources must be given with a fluid"):
        reference(terms=[mpm.Source(lambda points, q: q * points.dx)])
    with pytest.raises(ValueError, match=r"terms = .*, must be a list of functions"):
        reference(terms=5)
    with pytest.raises(ValueError, match=r"argument 'w', must be one of points, t, u, v, dt, velocity"):
        reference(terms=[lambda w: w])
    with pytest.raises(ValueError, match="depends on neither u nor v"):
        reference(terms=[lambda points, t: t * points.dx])


def test_a_modulus_that_jumps_between_cells_is_that_of_each_cell():
    stiff = lambda X: np.where(X[:, 1] > 0.5, 4e6, 1e6)  # noqa: E731
    law = mpm.LinearElastic(bulk=lambda X: stiff(X) / 3, shear=lambda X: stiff(X) / 2)
    load = mpm.Traction("top", (0, -1.0))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    column = BiotFEM(mpm.Grid([0, 0], [0.5, 1], [1, 2]), law, walls=walls, conditions=[load])
    column.step(1.0)
    assert column.displacement(np.array([[0.25, 1.0]]))[0, 1] == pytest.approx(-0.5e-6 - 0.125e-6, rel=1e-6)


def elements(cells, soil, conditions, pressure, element="q1-dg0", **options):
    """Return a column of 1 m of elements between smooth walls, and heights of pressures on its axis."""
    scene = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "fluid": mpm.Fluid(), "element": element, **options}
    fem = BiotFEM(mpm.Grid([0, 0], [1 / cells, 1], (1, cells)), soil, conditions=conditions, pressure=pressure, **scene)
    return fem, (np.arange(cells) + 0.5) / cells


def across(fem, z):
    """Return pressures at heights z (n,), m."""
    return fem.pressure(np.stack([0 * z + 1e-3, z], axis=1))


@pytest.mark.parametrize("element", [pytest.param("taylor-hood", marks=pytest.mark.slow), "q1-dg0"])
def test_unsaturated_soil_consolidates_by_elements_as_its_linear_theory_says(element):
    """Second order in h; material points on the same grid are compared."""
    exact, off = Pressed(), []
    for cells in (10, 20):
        fem, z = elements(cells, exact.soil, exact.sides, -20e3, element, numerics=mpm.Numerics(tolerance=1e-11))
        fem.run(0.1 / exact.c, 0.01 / exact.c, probes=[[1e-3, 1.0]])
        settled = -fem.displacement(np.array([[1e-3, 1.0]]))[0, 1]
        off.append(abs(settled / exact.settled(0.1) - 1))
        found = (across(fem, z) + 20e3) / (exact.load * exact.jump)
        assert found == pytest.approx(exact.pressures(0.1, z), abs=4e-3)
    assert off[0] < 2e-5
    assert off[0] > 3.5 * off[1]
    s = column(20, [exact.soil], -20e3, exact.sides, gravity=None)
    top = mpm.probes(s.bodies, [[1e-3, 1.0]])
    points = s.run(0.1 / exact.c, 0.01 / exact.c, progress=False, probes=top)
    assert -points.displacement[-1, 0, 1] == pytest.approx(settled, rel=2e-5)


@pytest.mark.slow
def test_a_front_runs_into_dry_soil_by_elements_as_by_material_points():
    """Second order in h: position of the head of -5 m after 12 h, and absorbed water."""
    known, fronts, waters = Celia(), [], []
    for cells in (25, 50):
        fem, z = elements(cells, known.soil, known.sides, -10 * WATER, gravity=lambda t: (0, -9.81))
        start = fem.water()
        fem.run(12 * 3600, 3600, probes=[[1e-3, 1.0]])
        fronts.append(known.front(z, across(fem, z)))
        waters.append((fem.water() - start) * cells)
    assert fronts == pytest.approx([known.depth] * 2, abs=4e-3)
    assert waters[1] == pytest.approx(known.taken_in, rel=2.5e-3)
    assert abs(fronts[0] - known.depth) > 2.8 * abs(fronts[1] - known.depth)
    assert abs(waters[0] - known.taken_in) > 3.5 * abs(waters[1] - known.taken_in)
    s = column(25, [known.soil], -10 * WATER, known.sides, initial_stress=mpm.K0(0.5))
    start = water(s)
    s.run(12 * 3600, 3600, progress=False)
    assert known.front(s.cells().x[:, 1], s.cells().pressure) == pytest.approx(fronts[0], abs=5e-3)
    assert (water(s) - start) * 25 == pytest.approx(waters[0], rel=8e-3)


@pytest.mark.slow
@pytest.mark.parametrize("element", ["taylor-hood", "q1-dg0"])
def test_soil_under_hydrostatic_suction_settles_by_elements_under_the_weight_of_its_water(element):
    """No flow except at the base: water is at rest, and strains follow from weight, suction and water."""
    modulus, law = 1e8, mpm.VanGenuchten(WATER / 2, residual=0.1, n=2.0)
    soil = mpm.LinearElastic(modulus / 3, modulus / 2, porosity=0.4, conductivity=1e-5, retention=law)
    base = mpm.Drained("bottom", pressure=0.3 * WATER)
    fem, z = elements(20, soil, [base], lambda x: WATER * (0.3 - x[:, 1]), element, gravity=lambda t: (0, -9.81))
    fem.run(1e6, 2e5, probes=[[1e-3, 1.0]])
    sunk = fem.displacement(np.stack([0 * z + 1e-3, z], axis=1))[:, 1]
    assert across(fem, z) / WATER == pytest.approx(0.3 - z - sunk, abs=1e-6)
    z = (np.arange(2000) + 0.5) / 2000
    felt = 1 / np.sqrt(1 + (2 * np.maximum(z - 0.3, 0)) ** 2)
    held = 0.4 * (0.1 + 0.9 * felt)
    assert 20 * fem.water() == pytest.approx(held.mean(), rel=1e-3)
    above = np.cumsum((9.81 * (0.6 * 2650 + 1000 * held))[::-1])[::-1] / 2000
    settled = (above - felt * WATER * (0.3 - z)).mean() / modulus
    assert -fem.displacement(np.array([[1e-3, 1.0]]))[0, 1] == pytest.approx(settled, rel=1e-3)
