# SPDX-License-Identifier: MIT
"""The finite element reference: beam theory, consolidation, and its two elements against each other."""

import numpy as np
import pytest
import ufl
from helpers import SOFT, top_load

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM
from mpm_dolfinx.verification.exact import euler_bernoulli

SIZE, TIP = ([0, 0], [1, 0.3]), [[1.0, 0.15]]


def test_a_lightly_loaded_beam_follows_beam_theory():
    load = mpm.Traction("top", (0, -10.0))
    fem = BiotFEM(*SIZE, (24, 8), SOFT, walls={"left": "xy"}, conditions=[load])
    tip = fem.run(1.0, 1.0, probes=TIP).displacement[-1][0, 1]
    bending = euler_bernoulli(np.array([1.0]), 10.0, 1.0, 1e7, 0.3**3 / 12)[0]
    shear = 10.0 / (2 * 5 / 6 * 5e6 * 0.3)
    assert -tip == pytest.approx(bending + shear, rel=5e-3)


def test_both_elements_converge_to_one_answer():
    tips = {}
    for element, cells in {"taylor-hood": (20, 6), "q1-dg0": (67, 20)}.items():
        drained = [mpm.Drained("left"), mpm.Drained("right")]
        options = dict(walls={"left": "xy"}, fluid=mpm.Fluid(), conditions=[top_load(), *drained])
        fem = BiotFEM(*SIZE, cells, SOFT, element=element, **options)
        result = fem.run(0.2, 0.02, probes=TIP)
        assert result.converged and result.residual <= 1e-8
        tips[element] = result.displacement[-1][0, 1]
    assert tips["q1-dg0"] == pytest.approx(tips["taylor-hood"], rel=5e-3)


@pytest.mark.parametrize("element", ["taylor-hood", "q1-dg0"])
def test_one_dimensional_consolidation_follows_terzaghi(element):
    options = dict(walls={"left": "x", "right": "x", "bottom": "y"}, fluid=mpm.Fluid(bulk=np.inf))
    load, drained = mpm.Traction("top", (0, -100.0)), [mpm.Drained("top")]
    fem = BiotFEM([0, 0], [0.1, 1], (1, 40), SOFT, element=element, conditions=[load, *drained], **options)
    t = 0.5 / (SOFT.conductivity / 9810 * SOFT.oedometric)
    result = fem.run(t, t / 100, probes=[[0.05, 1.0]])
    settlement = -result.displacement[-1][0, 1] / (100 / SOFT.oedometric)
    assert settlement == pytest.approx(0.7639503, rel=4e-3)  # degree of consolidation at T_v = 0.5
    assert result.pressure[-1][1] == pytest.approx(37.07774, rel=1e-2)


def test_a_term_of_the_velocity_and_a_spring_make_a_dry_block_creep_exactly():
    """Kelvin-Voigt, its spring doubled by an energy: strain = q / 2M (1 - exp(-2M t / eta))."""
    eta, load, modulus = 1e8, 1e3, SOFT.oedometric

    def damper(points, velocity, v):
        return eta * ufl.inner(ufl.sym(points.grad(velocity)), ufl.sym(points.grad(v))) * points.dx

    def stiffer(points, u):  # an energy: as much again as the oedometric modulus
        strain = points.grad(points.displacement + u)
        return modulus / 2 * strain[1, 1] ** 2 / ufl.det(points.F) * points.dx

    walls = {"left": "x", "right": "x", "bottom": "y"}
    top = mpm.Traction("top", (0, -load))
    fem = BiotFEM([0, 0], [1, 1], (2, 2), SOFT, walls=walls, conditions=[top], terms=[damper, stiffer])
    result = fem.run(20.0, 0.5, probes=[[0.5, 1.0]])
    exact = load / (2 * modulus) * (1 - np.exp(-2 * modulus * 20.0 / eta))
    assert -result.displacement[-1][0, 1] == pytest.approx(exact, rel=2e-3)


def test_terms_that_the_reference_cannot_take_are_refused_in_a_line():
    def reference(**options):
        return BiotFEM([0, 0], [1, 1], (2, 2), SOFT, walls={"left": "xy"}, **options)

    with pytest.raises(ValueError, match="drained sides and sources need a fluid"):
        reference(terms=[mpm.Source(lambda points, q: q * points.dx)])
    with pytest.raises(ValueError, match=r"terms = .*, must be a list of functions"):
        reference(terms=5)
    with pytest.raises(ValueError, match=r"argument 'w', must be some of points, t, u, v, dt, velocity"):
        reference(terms=[lambda w: w])
    with pytest.raises(ValueError, match="depends on neither u nor v"):
        reference(terms=[lambda points, t: t * points.dx])


def test_a_modulus_that_jumps_between_cells_is_that_of_each_cell():
    stiff = lambda X: np.where(X[:, 1] > 0.5, 4e6, 1e6)  # noqa: E731
    law = mpm.LinearElastic(bulk=lambda X: stiff(X) / 3, shear=lambda X: stiff(X) / 2)
    load = mpm.Traction("top", (0, -1.0))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    column = BiotFEM([0, 0], [0.5, 1], [1, 2], law, walls=walls, conditions=[load])
    column.step(1.0)
    assert column.displacement(np.array([[0.25, 1.0]]))[0, 1] == pytest.approx(-0.5e-6 - 0.125e-6, rel=1e-6)
