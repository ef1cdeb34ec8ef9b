# SPDX-License-Identifier: MIT
"""Laws with local unknowns: exact values and tangents, failures that name the point, and refusals."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import ufl
from extending_with_ufl import Crushable
from helpers import column
from laws import LawAtPoints

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM


@dataclass(frozen=True)
class Stiffening(mpm.Skeleton):
    """Pressure K y with y + power y^3 = ln J, and shear from a vector (b_12, b_21): both have closed forms."""

    power: float = 50.0

    unknowns: ClassVar = {"y": 0.0, "shears": (0.0, 0.0)}

    @staticmethod
    def trial(F):
        b = F * F.T
        return {"volume": ufl.ln(ufl.det(F)), "b": ufl.as_vector([b[0, 1], b[1, 0]]), "what is no UFL": F.ufl_shape}

    @staticmethod
    def residual(trial, power, y, shears):
        return {"y": y + power * y**3 - trial["volume"], "shears": 2 * shears - 2 * trial["b"] + (y - y) * shears}

    @staticmethod
    def kirchhoff(trial, bulk, shear, y, shears):
        d = trial["what is no UFL"][0]
        S = [[shears[i] if (i, j) == (i, 1 - i) and i < 2 and j < 2 else 0 for j in range(d)] for i in range(d)]
        return bulk * y * ufl.Identity(d) + shear * ufl.as_matrix(S)


class Named(Stiffening):
    """The same law without trial values: the residuals depend on F."""

    trial = None

    @staticmethod
    def residual(F, power, y, shears):
        return Stiffening.residual(Stiffening.trial(F), power, y, shears)

    @staticmethod
    def kirchhoff(F, bulk, shear, y, shears):
        return Stiffening.kirchhoff(Stiffening.trial(F), bulk, shear, y, shears)


SOIL = Stiffening(bulk=2e6, shear=1e6)


def exact(F, m=SOIL):
    """Return the Kirchhoff stress (n, d, d), Pa, by Cardano's formula."""
    b, d, q = F @ F.transpose(0, 2, 1), F.shape[1], np.log(np.linalg.det(F)) / m.power
    root = np.sqrt(q**2 / 4 + 1 / (27 * m.power**3))
    tau = m.bulk * (np.cbrt(q / 2 + root) + np.cbrt(q / 2 - root))[:, None, None] * np.eye(d)
    tau[:, 0, 1] += m.shear * b[:, 0, 1]
    tau[:, 1, 0] += m.shear * b[:, 1, 0]
    return tau


@pytest.mark.parametrize(("law", "dim"), [(Stiffening, 2), (Stiffening, 3), (Named, 2)])
def test_stress_and_tangent_are_those_of_the_closed_form(law, dim):
    rng = np.random.default_rng(dim)
    F = np.eye(dim) + 0.15 * rng.normal(size=(40, dim, dim))
    at = LawAtPoints(law(bulk=2e6, shear=1e6), dim)
    assert np.abs(at.kirchhoff(F) - exact(F)).max() < 1e-13 * SOIL.bulk
    found, differences = at.tangent(F)
    assert np.abs(found - differences).max() < 1e-8 * np.abs(found).max()


@dataclass(frozen=True)
class Stored(Stiffening):
    """The same unknowns from an energy that is not stationary in them: K y^2 / 2 + G |shears|^2 / 2."""

    kirchhoff: ClassVar = None

    @staticmethod
    def energy(F, bulk, shear, y, shears):
        strain = ufl.tr(F.T * F) / 2 - ufl.ln(ufl.det(F))
        return bulk / 2 * y**2 + shear / 2 * ufl.inner(shears, shears) + shear * strain


@pytest.mark.parametrize("dim", [2, 3])
def test_an_energy_of_local_unknowns_has_its_tangent(dim):
    """Derivatives of the energy by differences, and of the stress with the unknowns' second derivatives."""
    F = np.eye(dim) + 0.1 * np.random.default_rng(dim).normal(size=(20, dim, dim))
    at = LawAtPoints(Stored(bulk=2e6, shear=1e6), dim)
    b, log = F @ F.transpose(0, 2, 1), np.log(np.linalg.det(F))
    pressure = np.trace(exact(F), axis1=1, axis2=2) / dim  # bulk * y
    slope = pressure / (1 + 3 * SOIL.power * (pressure / SOIL.bulk) ** 2)
    db = np.zeros_like(F)  # of b_12^2 dev by F, times F^T, over b_12
    db[:, 0, :], db[:, 1, :] = F[:, 1, :], F[:, 0, :]
    tau = (slope - SOIL.shear)[:, None, None] * np.eye(dim) + SOIL.shear * b
    tau += 2 * SOIL.shear * b[:, 0, 1, None, None] * (db @ F.transpose(0, 2, 1))
    assert log.min() < -0.1 and np.abs(at.kirchhoff(F) - tau).max() < 1e-12 * SOIL.bulk
    found, differences = at.tangent(F)
    assert np.abs(found - differences).max() < 1e-8 * np.abs(found).max()


def settled(material, **options):
    """Return the displacement of the top of a column under a growing load, with or without fluid."""
    s = column(
        cells=4,
        material=material,
        conditions=[mpm.Traction("top", lambda t: (0, -2e5 * t)), *options.pop("conditions", [])],
        **options,
    )
    result = s.run(1.0, 0.25, probes=mpm.probes(s.bodies, [[0.125, 1.0]]))
    return s, result, result.displacement[-1][0, 1]


@pytest.mark.parametrize("locks", [False, True], ids=["plain", "mean dilatation"])
def test_a_column_balances_its_load(locks):
    """P = tau / J of uniform compression. Newton's method keeps its order."""
    s, result, u = settled(SOIL if not locks else replace(SOIL, shear=1e4), fluid=False)
    m = s.materials[0] if hasattr(s, "materials") else s.scene.materials.materials[0]
    assert m.nearly_incompressible == locks
    stretch = 1 + u
    assert exact(np.array([[[1, 0], [0, stretch]]]), m)[0, 1, 1] / stretch == pytest.approx(-2e5, rel=1e-7)
    assert result.newton <= 5 * result.steps and result.cuts == 0


def test_an_energy_of_local_unknowns_keeps_the_order_of_newtons_method():
    """Without the second derivative of the unknowns, the tangent leads to 32 Newton steps in place of 17."""
    _, result, u = settled(Stored(bulk=2e6, shear=1e6), fluid=False)
    assert result.newton <= 5 * result.steps and result.cuts == 0 and -0.2 < u < -0.05


def test_a_column_with_water_ends_where_the_dry_one_does():
    dry = settled(SOIL, fluid=False)[2]
    wet = settled(replace(SOIL, conductivity=1e3), fluid=True, conditions=[mpm.Drained("top")])[2]
    assert wet == pytest.approx(dry, rel=1e-4)


@dataclass(frozen=True)
class Brittle(Stiffening):
    """The same law, without a solution beyond a compression."""

    least: mpm.Field = -0.05

    @staticmethod
    def residual(trial, least, y, shears):
        over = ufl.conditional(ufl.lt(trial["volume"], least), 1.0, 0.0)
        return {"y": (y - trial["volume"]) * (1 - over) + over * (1 + y**2), "shears": shears - trial["b"]}


def test_a_step_without_a_local_solution_is_cut_and_names_the_first_point():
    """ln J = -0.05 is reached at about half of the load. Only the upper half of the column is weak."""
    weak = Brittle(bulk=2e6, shear=1e6, least=lambda X: np.where(X[:, 1] > 0.5, -0.05, -9.0))
    s = column(cells=4, fluid=False, material=weak, conditions=[mpm.Traction("top", lambda t: (0, -2e5 * t))])
    with pytest.raises(mpm.GaveUp, match=r"Brittle: local equations have no solution at \[0\.\d+ +0\.(4[5-9]|[5-9])"):
        s.run(1.0, 0.25)
    assert s.result.cuts > 2 and np.log(s.points.J).min() == pytest.approx(-0.05, rel=0.05)


FOAM = Crushable(bulk=1e6, shear=2e5)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_law_in_numpy_has_the_stress_the_tangent_and_the_state_that_it_gives(dim):
    F = np.eye(dim) + 0.1 * np.random.default_rng(dim).normal(size=(40, dim, dim))
    crushed = {"crushed": np.linspace(-0.1, 0, 40)}
    at, log = LawAtPoints(FOAM, dim), np.log(np.linalg.det(F))
    pressure = np.maximum(-FOAM.limit, FOAM.bulk * (log - crushed["crushed"]))
    assert (pressure == -FOAM.limit).any() and (pressure > -FOAM.limit).any()
    exact = pressure[:, None, None] * np.eye(dim) + FOAM.shear * (F @ F.transpose(0, 2, 1) - np.eye(dim))
    assert np.abs(at.kirchhoff(F, crushed) - exact).max() < 1e-13 * FOAM.bulk
    found, differences = at.tangent(F, crushed)
    assert np.abs(found - differences).max() < 1e-7 * np.abs(found).max()
    assert at.update(F, crushed)["crushed"] == pytest.approx(log - pressure / FOAM.bulk, abs=1e-15)


@pytest.mark.parametrize(
    ("solution", "message"),
    [
        (lambda trial: {"p": (trial["volume"], {})}, r"Wrong.solution: returns p, must return pressure"),
        (lambda trial: {"pressure": (trial["volume"], {"volume": np.eye(2)})}, r"of pressure with respect to volume"),
        (lambda trial: trial["volume"], "its result = .* must be a dict"),
        (lambda trial: trial["strain"], "raises KeyError: 'strain'"),
        (lambda trial: {"pressure": trial["volume"]}, "solution: pressure = .* must be a pair"),
        (lambda trial: {"pressure": 3.0}, "solution: pressure = 3.0, must be a pair"),
        (lambda trial: {"pressure": (trial["volume"], trial["volume"])}, "must be a pair"),
        (lambda trial: {"pressure": (np.zeros(1), {})}, r"solution: pressure has shape \(1,\), must be \(\d+,\)"),
        (
            lambda trial: {"pressure": (1j * trial["volume"], {})},
            "has numbers of type complex128, must be real",
        ),
        (
            lambda trial: {"pressure": (trial["volume"], {"volum": trial["volume"]})},
            "derivative of pressure with respect to 'volum', must be with respect to one of volume",
        ),
        (lambda trial: {"pressure": (trial["volume"], {}), "p": (1, {})}, "returns pressure, p, must return pressure"),
        (lambda trial: {"pressure": ([[1], [1, 2]], {})}, r"pressure = \[\[1\], .* must be an array of shape"),
        (lambda trial: {"pressure": (trial["volume"], {"volume": 1})}, r"to volume has shape \(\), must be \(\d+,\)"),
        (lambda trial: {"pressure": (trial["volume"][:, 3], {})}, "IndexError: .*must be numpy of trial"),
    ],
)
def test_one_line_says_what_is_wrong_with_a_law_in_numpy(solution, message):
    law = type("Wrong", (Crushable,), {"solution": staticmethod(solution)})
    s = column(cells=2, fluid=False, material=law(bulk=1e6, shear=2e5))
    with pytest.raises(ValueError, match=message) as caught:
        s.step(1.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"update": lambda pressure: {"crushed": ufl.as_vector([pressure] * 2)}}, r"returns \{'crushed': \(2,\)\}"),
        ({"update": lambda pressure: {"crush": pressure}}, r"update: returns \{'crush': \(\)\}, must have some of the"),
        ({"update": lambda pressure: {}}, r"Wrong.update: returns \{\}, must have some of .*\{'crushed': \(\)\}"),
        ({"update": lambda pressure: {"crushed": np.zeros(3)}}, r"Wrong.update: crushed = array.* must be UFL"),
        ({"update": lambda pressure: {"crushed": 0.0}}, "Wrong.update: returns only numbers, must be UFL that depends"),
        ({"trial": lambda F: {"volume": 3.0}}, "Wrong.trial: returns {'volume': 3.0}, must contain UFL of F"),
        ({"unknowns": {"pressure": np.nan}}, "Wrong: unknown 'pressure' = nan, must be numbers"),
        ({"unknowns": {"pressure": 0.0, "bulk": 0.0}}, "Wrong: the name 'bulk' is taken; parameters, state and"),
    ],
)
def test_one_line_says_what_is_wrong_around_a_law_in_numpy(change, message):
    members = {name: staticmethod(value) if callable(value) else value for name, value in change.items()}
    with pytest.raises(ValueError, match=message) as caught:
        column(cells=2, fluid=False, material=type("Wrong", (Crushable,), members)(bulk=1e6, shear=2e5)).step(1.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["unknowns", "state"])
def test_what_a_law_has_is_named(name):
    with pytest.raises(ValueError, match=rf"Wrong: {name} = \['pressure'\], must be a Mapping"):
        type("Wrong", (Crushable,), {name: ["pressure"]})


def test_what_a_law_in_numpy_does_to_its_arguments_stays_with_it():
    """A function that overwrites its arguments changes neither the stress nor the tangent."""

    def solution(trial, bulk, crushed):
        np.multiply(trial["volume"], bulk, out=trial["volume"])
        bulk[:] = crushed[:] = np.nan
        return {"pressure": (trial["volume"], {"volume": lambda: np.full(len(bulk), FOAM.bulk)})}

    law = type("Scribbles", (Crushable,), {"solution": staticmethod(solution)})
    F = np.eye(2) + 0.1 * np.random.default_rng(0).normal(size=(5, 2, 2))
    clean = Crushable(bulk=FOAM.bulk, shear=FOAM.shear, limit=1e9)
    found, asked = (LawAtPoints(m, 2) for m in (law(bulk=FOAM.bulk, shear=FOAM.shear), clean))
    assert np.array_equal(found.kirchhoff(F), asked.kirchhoff(F))
    assert found.tangent(F)[0] == pytest.approx(asked.tangent(F)[0], rel=1e-12)


class Torn(Crushable):
    """Foam without pressure beyond a compression."""

    @staticmethod
    def solution(trial, bulk):
        volume = trial["volume"]
        return {"pressure": (np.where(volume > -0.05, bulk * volume, np.nan), {"volume": np.full_like(volume, bulk)})}


def test_a_law_in_numpy_without_a_finite_solution_names_the_first_point():
    with pytest.raises(mpm.NotConverged, match=r"Torn.solution: is not finite at \["):
        mpm.element_test(Torn(bulk=1e6, shear=2e5), "oedometer", strain=0.1)


def test_an_equation_that_leaves_its_unknown_open_names_the_first_point():
    free = lambda trial, y, shears: {"y": trial["volume"] * y**2, "shears": shears - trial["b"]}  # noqa: E731
    law = type("Open", (Stiffening,), {"residual": staticmethod(free)})
    with pytest.raises(mpm.NotConverged, match=r"Open.residual: does not determine the unknowns at \["):
        LawAtPoints(law(bulk=2e6, shear=1e6), 2).kirchhoff(np.eye(2)[None])


class Misnamed(Stiffening):
    @staticmethod
    def residual(trial, power, y):
        return {"x": y - trial["volume"]}


def test_one_line_says_what_is_wrong():
    with pytest.raises(
        ValueError, match=r"Misnamed.residual: returns .*must have the names and shapes \{'y': \(\), 'shears'"
    ) as caught:
        column(fluid=False, material=Misnamed(bulk=1e6, shear=1e6))
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="the reference has no state"):
        BiotFEM(mpm.Grid([0, 0], [1, 1], (2, 2)), SOIL, walls={})
    half = type("Half", (Stiffening,), {"residual": None})
    with pytest.raises(ValueError, match="Half: has unknowns, and 0 of residual and solution; must define one of"):
        column(fluid=False, material=half(bulk=1e6, shear=1e6))
