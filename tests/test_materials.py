# SPDX-License-Identifier: MIT
"""The stored energies: objectivity, small-strain limit, constants."""

from math import inf

import numpy as np
import pytest
import ufl
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from mpm_dolfinx import Fluid, Hencky, LinearElastic, NeoHookean, kozeny_carman


def energy(law, F):
    """Evaluate the UFL energy of a plain matrix."""
    return float(law.energy(ufl.as_matrix(F.tolist()), 2.0, 1.0)(()))


def rotation(dim, angle):
    R = np.eye(dim)
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return R


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", [Hencky, NeoHookean])
def test_energy_does_not_change_under_rotation(law, dim):
    F = np.eye(dim) + 0.3 * np.random.default_rng(0).normal(size=(dim, dim))
    F *= np.sign(np.linalg.det(F))
    assert energy(law, rotation(dim, 1.1) @ F) == pytest.approx(energy(law, F), rel=1e-9)


@pytest.mark.parametrize("law", [Hencky, NeoHookean])
@pytest.mark.parametrize("dim", [2, 3])
def test_energy_at_small_strain_is_linear_elastic(law, dim):
    E = np.random.default_rng(3).normal(size=(dim, dim))
    E = 1e-2 * (E + E.T)
    assert energy(law, np.eye(dim) + E) == pytest.approx(energy(LinearElastic, np.eye(dim) + E), rel=0.1)
    E *= 1e-1
    assert energy(law, np.eye(dim) + E) == pytest.approx(energy(LinearElastic, np.eye(dim) + E), rel=0.01)
    for aslant in (0, 1e-30):  # the third axis is principal, or is treated as any other
        assert energy(law, np.eye(dim) + aslant) == pytest.approx(0, abs=1e-20)


def test_hencky_of_a_principal_stretch_is_the_formula():
    a, b = np.log(1.3), np.log(0.8)
    exact = (2 - 2 / 3) / 2 * (a + b) ** 2 + a**2 + b**2
    assert energy(Hencky, rotation(2, 0.4) @ np.diag([1.3, 0.8])) == pytest.approx(exact, rel=1e-7)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", [Hencky, NeoHookean])
def test_a_tiny_strain_gives_a_tiny_stress(law, dim):
    E = 1e-7 * np.diag([1.0, -0.3, 0.5][:dim])
    F = ufl.variable(ufl.as_matrix((np.eye(dim) + E).tolist()))
    P = apply_derivatives(apply_algebra_lowering(ufl.diff(law.energy(F, 2.0, 1.0), F)))
    exact = (2 - 2 / 3) * np.trace(E) + 2 * E[1, 1]
    assert float(P[1, 1](())) == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"bulk": -1.0}, "bulk = -1.0, must be > 0"),
        ({"shear": 0.0}, "shear = 0.0, must be > 0"),
        ({"bulk": inf}, "bulk = inf, must be > 0 and finite"),
        ({"porosity": 1.0}, r"porosity = 1.0, must be in \(0, 1\)"),
        ({"porosity": -0.1}, r"porosity = -0.1, must be in \(0, 1\)"),
        ({"conductivity": -1e-4}, "conductivity = -0.0001, must be >= 0"),
        ({"biot": 0.2}, r"biot = 0.2, must be in \[porosity = 0.4, 1\]"),
        ({"grain_bulk": 0.0}, "grain_bulk = 0.0, must be > 0"),
    ],
)
@pytest.mark.parametrize("law", [Hencky, NeoHookean, LinearElastic])
def test_constants_out_of_range_are_refused(law, constants, message):
    with pytest.raises(ValueError, match=message):
        law(**{"bulk": 1e6, "shear": 1e6, **constants})


def test_an_incompressible_fluid_is_allowed_and_a_negative_modulus_is_not():
    assert Hencky(1.0, 1.0).storage(Fluid(bulk=inf).bulk, 0.4) == 0
    with pytest.raises(ValueError, match=r"bulk = -2.0, must be > 0"):
        Fluid(bulk=-2.0)


def test_a_law_derived_from_the_linear_one_is_not_linear_by_itself():
    class Derived(LinearElastic):
        @staticmethod
        def energy(F, bulk):
            return bulk * ufl.tr(F) ** 4

    assert LinearElastic.linear and not Derived.linear and Derived.parameters == ("bulk",)


def test_fields_are_evaluated_and_checked_where_they_are_needed():
    X = np.array([[0.0, 0.0], [1.0, 0.0]])
    soil = Hencky(bulk=lambda X: 1 + X[:, 0], shear=1.0).at(X)
    assert soil.bulk == pytest.approx([1, 2]) and soil.oedometric == pytest.approx([1 + 4 / 3, 2 + 4 / 3])
    with pytest.raises(ValueError, match=r"shear = -1.0, must be > 0"):
        Hencky(bulk=1.0, shear=lambda X: -X[:, 0]).at(X[1:])


def test_kozeny_and_carmans_conductivity_is_that_of_the_start_at_the_start():
    assert kozeny_carman(2.0, 0.4, 0.4) == 2.0
    assert kozeny_carman(1.0, 0.2, 0.4) == pytest.approx((0.2 / 0.4) ** 3 * (0.6 / 0.8) ** 2)
