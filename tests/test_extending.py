# SPDX-License-Identifier: MIT
"""User-defined physics: energies, fields, conductivities, terms, sources, state, several laws in one scene."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import ufl
from helpers import SOFT, beam, column, limit, set_up

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM


def load(height):
    """Return a load on points of a height."""
    return mpm.Traction("top", lambda t: (0, -1e6 * min(1, t)), region=((-1, height), (1, height)))


class Own(mpm.Skeleton):
    """Hencky's law as a user-defined law."""

    @staticmethod
    def energy(F, shear, bulk):
        return mpm.Hencky.energy(F, bulk, shear)


@dataclass(frozen=True)
class Fibrous(mpm.NeoHookean):
    fibre: float = 0.0
    direction: mpm.Field = (1.0, 0.0)

    @staticmethod
    def energy(F, bulk, shear, fibre, direction):
        along = F * direction
        return mpm.NeoHookean.energy(F, bulk, shear) + fibre / 4 * (ufl.inner(along, along) - 1) ** 2


@dataclass(frozen=True)
class Damaged(mpm.Hencky):
    state: ClassVar = {"damage": 0.0}

    @staticmethod
    def energy(F, bulk, shear, damage):
        return (1 - damage) * mpm.Hencky.energy(F, bulk, shear)

    @staticmethod
    def update(F, damage):
        return {"damage": ufl.max_value(damage, abs(ufl.ln(ufl.det(F))))}


# ---- laws and fields ------------------------------------------------------------------------------


def test_an_energy_of_ones_own_gives_what_the_built_in_law_gives():
    own = Own(bulk=SOFT.bulk, shear=SOFT.shear, porosity=SOFT.porosity, conductivity=SOFT.conductivity)
    (s, _), (other, _) = beam(h=0.06), beam(h=0.06, material=own)
    assert s.run(0.1, 0.02).converged and other.run(0.1, 0.02).converged
    assert np.abs(s.points.x - other.points.x).max() < 1e-12
    assert np.abs(s.points.pressure - other.points.pressure).max() < 1e-12 * np.abs(s.points.pressure).max()
    assert np.abs(s.effective_stress() - other.effective_stress()).max() < 1e-12 * SOFT.shear


def two_halves(lower, upper, **options):
    """Return a column of two materials, one above the other."""
    grid = mpm.Grid([0, 0], [0.1, 1.4], [1, 14])
    bodies = [mpm.box(grid, [0, 0], [0.1, 0.5]), mpm.box(grid, [0, 0.5], [0.1, 1], material=1)]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(
        grid, bodies, [lower, upper], walls=walls, conditions=[load(1.0), *options.pop("conditions", [])], **options
    )


def test_a_function_of_place_equals_two_materials():
    """All data that may be functions of position are functions here, with a step at the other scene's interface."""
    water = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")], "gravity": [0, -9.81]}
    names = ("bulk", "shear", "porosity", "conductivity", "biot", "grain_bulk", "grain_density")
    below = (1e7, 6e6, 0.3, 1e-4, 0.9, 1e9, 2600.0)
    above = (4e6, 3e6, 0.5, 3e-5, 0.8, 5e8, 2000.0)
    fields = {n: lambda X, a=a, b=b: np.where(X[:, 1] < 0.5, a, b) for n, a, b in zip(names, below, above, strict=True)}
    scenes = [
        two_halves(*(mpm.Hencky(**dict(zip(names, v, strict=True))) for v in (below, above)), **water),
        two_halves(*[mpm.Hencky(**fields)] * 2, **water),
    ]
    for s in scenes:
        s.run(1.0, 0.25)
    assert np.abs(scenes[0].points.x - scenes[1].points.x).max() < 1e-12
    p = scenes[0].points.pressure
    assert np.abs(p - scenes[1].points.pressure).max() < 1e-10 * np.abs(p).max()
    assert set(scenes[1].points.data) == {*names, "owed", "due"}


def test_a_beam_whose_moduli_vary_follows_finite_elements():
    soft_end = mpm.Hencky(bulk=lambda X: 1e7 / 3 * (2 - X[:, 0]), shear=lambda X: 5e6 * (2 - X[:, 0]))
    s, probe = beam(material=soft_end, fluid=False, ramp=1.0)
    tip = s.run(1.0, 0.25, probes=probe).displacement[-1]
    load = mpm.Traction("top", lambda t: (0, -54e3 * min(1, t)), region=((0.05, -np.inf), (1.0, np.inf)))
    fem = BiotFEM(mpm.Grid([0, 0], [1, 0.3], (40, 12)), soft_end, walls={"left": "xy"}, conditions=[load])
    exact = fem.run(1.0, 0.25, probes=[[1.0, 0.15]]).displacement[-1]
    assert tip == pytest.approx(exact, rel=4e-3)


def test_oblique_fibres_on_the_points_follow_finite_elements():
    """Inclined fibres push a sheet sideways as it is compressed; they rotate with the points."""

    def slanted(X):
        angle = np.radians(30 + 30 * X[:, 1])
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    tissue = Fibrous(bulk=1e6, shear=6e5, fibre=4e6, direction=slanted)
    scene = {"walls": {"bottom": "xy"}, "conditions": [mpm.Traction("top", lambda t: (0, -2e5 * t))]}
    grid = mpm.Grid([-0.5, 0], [2.0, 1.2], [40, 24])
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [tissue], **scene)
    place = [[0.5, 1.0]]
    u = s.run(1.0, 0.25, probes=mpm.probes(s.bodies, place)).displacement[-1]
    exact = BiotFEM(mpm.Grid([0, 0], [1, 1], (16, 16)), tissue, **scene).run(1.0, 0.25, probes=place).displacement[-1]
    assert np.abs(u - exact).max() < 4e-3 * np.abs(exact).max() and abs(exact[0, 0]) > 0.02
    assert s.points.data["direction"].shape == (len(s.points), 2)


def test_several_laws_in_one_scene_share_it_as_one_law_would():
    """Two names of one law give two integrals. Their sum is the integral of the law, also with mean dilatation."""
    for stiff in (SOFT, replace(SOFT, bulk=5e7)):
        own = Own(bulk=stiff.bulk, shear=stiff.shear, conductivity=stiff.conductivity)
        water = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")]}
        one, two = two_halves(stiff, stiff, **water), two_halves(stiff, own, **water)
        for s in (one, two):
            s.run(1.0, 0.25)
        assert [len(s.scene.momentum.law_forms) for s in (one, two)] == [1, 2]
        assert np.abs(one.points.x - two.points.x).max() < 1e-12
        assert np.abs(one.effective_stress() - two.effective_stress()).max() < 1e-7 * SOFT.shear


def test_each_body_has_the_stress_of_its_own_law():
    """Hencky, neo-Hookean and Drucker-Prager soil in one column; under a dead load the stress equals the load
    everywhere.
    """
    grid = mpm.Grid([0, 0], [0.1, 1.8], [1, 18])
    sand = mpm.DruckerPrager(2e7, 1e7, friction=30.0, dilation=0.0, cohesion=1e4)
    materials = [mpm.Hencky(1e7, 6e6), mpm.NeoHookean(4e6, 3e6), sand]
    bodies = [mpm.box(grid, [0, 0.5 * k], [0.1, 0.5 * (k + 1)], material=k) for k in range(3)]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    s = mpm.Simulation(grid, bodies, materials, walls=walls, conditions=[load(1.5)])
    s.run(1.0, 1.0)  # in one step the layers are cells
    assert s.effective_stress()[:, 1, 1] == pytest.approx(-1e6 * np.ones(len(s.points)), rel=1e-6)
    stretch = s.points.F[:, 1, 1].reshape(3, -1)
    assert np.ptp(stretch, axis=1).max() < 1e-6 and np.ptp(stretch[:, 0]) > 0.02
    hardened = s.points.data["hardened"].reshape(3, -1)
    assert (hardened[:2] == 0).all() and hardened[2].min() > 1e-3


def test_state_changes_once_a_step_and_only_if_it_converged():
    s = column(fluid=False, material=Damaged(1e6, 6e5), conditions=[mpm.Displacement("top", lambda t, X: (0, -t), "y")])
    s.run(0.2, 0.05)
    assert s.points.data["damage"] == pytest.approx(-np.log(0.8), abs=1e-4)
    before = {name: values.copy() for name, values in s.points.data.items()}
    limit(s, 1)
    with pytest.raises(mpm.NotConverged):
        s.step(0.7)
    assert (s.points.data["damage"] == before["damage"]).all()
    sound = (1e6 + 4 / 3 * 6e5) * np.log(0.8) / 0.8
    assert s.effective_stress()[:, 1, 1] == pytest.approx((1 + np.log(0.8)) * sound, rel=1e-3)


# ---- conductivity ---------------------------------------------------------------------------------


@pytest.mark.parametrize("law", [mpm.kozeny_carman, lambda conductivity, J: conductivity * ufl.exp(5 * (J - 1))])
def test_consolidation_with_a_conductivity_law_follows_finite_elements(law):
    soil = mpm.Hencky(bulk=1e6, shear=6e5, porosity=0.5, conductivity=1e-4, conductivity_law=law)
    scene = {"conditions": [mpm.Traction("top", lambda t: (0, -4e5 * min(1, t / 10))), mpm.Drained("top")]}
    s = column(cells=20, material=soil, **scene)
    settlement = np.array(s.run(50, 2.5, probes=mpm.probes(s.bodies, [[0.025, 1.0]])).displacement)[1:, 0, 1]
    scene |= {"walls": {"left": "x", "right": "x", "bottom": "y"}, "fluid": mpm.Fluid()}
    exact, constant = (
        np.array(
            BiotFEM(mpm.Grid([0, 0], [0.05, 1], (1, 40)), m, **scene).run(50, 2.5, probes=[[0.025, 1]]).displacement
        )[1:, 0, 1]
        for m in (soil, replace(soil, conductivity_law=None))
    )
    # one takes the flow over the geometry of a step's start, the other over that of its end: first order in the step
    assert np.abs(settlement - exact).max() < 0.01 * np.abs(exact).max()
    assert np.abs(constant - exact).max() > 0.1 * np.abs(exact).max(), "the law makes no difference"


def test_a_conductivity_that_depends_on_place_is_evaluated_at_the_pieces():
    """k = k0 exp(y): the pressure of the steady flow is known."""
    soil = mpm.Hencky(
        1e9, 1e9, conductivity=1e-6, conductivity_law=lambda conductivity, x: conductivity * ufl.exp(x[1])
    )
    s = column(cells=20, material=soil, conditions=[mpm.Drained("top"), mpm.Drained("bottom", pressure=1e3)])
    s.run(1000, 100)
    y = s.points.x[:, 1]
    exact = 1e3 * (np.exp(-y) - np.exp(-1)) / (1 - np.exp(-1))
    assert s.points.pressure == pytest.approx(exact, abs=1.5)
    assert s.points.pressure.reshape(2, 20, 2).mean(axis=(0, 2)) == pytest.approx(
        exact.reshape(2, 20, 2).mean(axis=(0, 2)), abs=1.0
    )


# ---- terms and sources ----------------------------------------------------------------------------


def test_a_body_force_equals_gravity():
    density = 0.6 * SOFT.grain_density

    def weight(points, v, t):
        return density / ufl.det(points.F) * 10 * t * points.value(v)[1] * points.dx

    scenes = column(fluid=False, gravity=lambda t: (0, -10 * t)), column(fluid=False, terms=[weight])
    for s in scenes:
        s.run(1.0, 0.25)
    # the term spreads the weight within a domain by its varying volume ratio
    assert np.abs(scenes[0].points.x - scenes[1].points.x).max() < 1e-11


def foundation(points, u):
    U = points.displacement + points.value(u)
    return 4e6 / 2 * ufl.inner(U, U) / ufl.det(points.F) * points.dx


def foundation_in_v(points, u, v):
    return 4e6 * ufl.inner(points.displacement + points.value(u), points.value(v)) / ufl.det(points.F) * points.dx


def test_an_elastic_foundation_converges_to_its_exact_solution_at_second_order():
    errors, soil = [], mpm.LinearElastic(bulk=3e5, shear=1e5)
    kappa = np.sqrt(4e6 / soil.oedometric)
    for cells in (8, 16, 32):
        s = column(
            cells=cells, fluid=False, material=soil, terms=[foundation], conditions=[mpm.Traction("top", (0, -10))]
        )
        Y = s.points.x[:, 1].copy()
        s.run(1.0, 0.25)
        exact = -10 / (soil.oedometric * kappa) * np.sinh(kappa * Y) / np.cosh(kappa)
        errors.append(np.abs(s.points.x[:, 1] - Y - exact).max() / np.abs(exact).max())
    assert errors[-1] < 6e-4 and (np.log2(np.divide(errors[:-1], errors[1:])) > 1.8).all()


def test_an_energy_and_its_forces_give_the_same_and_may_hold_a_body_alone():
    """The tangent of the energy is factorised as a symmetric matrix, the tangent of the forces is not."""
    grid, positions = mpm.Grid([0, 0], [1.0, 1.4], [10, 14]), []
    body = mpm.box(grid, [0.3, 0.33], [0.7, 1.0])
    pull = mpm.Traction("top", (1e3, -1e3))
    for term in (foundation, foundation_in_v):
        s = mpm.Simulation(grid, [body], [SOFT], walls={}, terms=[term], conditions=[pull])
        s.run(1.0, 0.5)
        positions.append(s.points.corners.mean(axis=1))
        assert s.scene.momentum.symmetric == (term is foundation)
    assert np.abs(positions[0] - positions[1]).max() < 1e-10
    # the springs balance the load: 4e6 N/m^3 times the mean displacement and the height
    assert (positions[0] - body.centre).mean(axis=0) * 4e6 * 0.67 == pytest.approx([1e3, -1e3], rel=5e-5)


def test_a_term_without_symmetry_has_a_consistent_tangent_coupled_too():
    """A force F b, which rotates with the material."""

    def follower(points, u, v):
        F = (ufl.Identity(2) + points.grad(u)) * points.F
        return -ufl.inner(F * ufl.as_vector([2e5, 0]), points.value(v)) / ufl.det(points.F) * points.dx

    s, _ = beam(h=0.06, terms=[follower])
    assert s.scene.scheme.coupling == "schur-fgmres"
    s.run(0.1, 0.02)
    m, rng = set_up(s, 0.02).momentum, np.random.default_rng(0)
    unknowns = m.system.unknowns
    u, w = (1e-3 * rng.normal(size=unknowns.size) for _ in range(2))

    def residual(x):
        m.forms.u.x.array[unknowns.owned] = x
        return m.assemble_residual()[0].array.copy()

    slope = (residual(u + 1e-4 * w) - residual(u - 1e-4 * w)) / 2e-4
    residual(u)
    x = unknowns.vector()
    x.array[:] = w
    assert (m.assemble_tangent() * x).array == pytest.approx(slope, abs=1e-7 * np.abs(slope).max())


def viscous(points, u, dt):
    rate = ufl.sym(points.grad(u)) / dt
    return 2e6 * dt * ufl.inner(rate, rate) * points.dx  # 2 eta D, eta = 2e6 Pa s


def test_a_viscous_stress_takes_the_length_of_each_step():
    soil, load = mpm.LinearElastic(bulk=SOFT.bulk, shear=SOFT.shear), 100.0
    s = column(fluid=False, material=soil, terms=[viscous], conditions=[mpm.Traction("top", (0, -load))])
    strain = 0.0
    for dt in (0.5, 0.5, 0.1, 2.0):
        s.step(dt)
        strain = (-load + 4e6 / dt * strain) / (soil.oedometric + 4e6 / dt)
        assert s.points.F[:, 1, 1] - 1 == pytest.approx(strain, rel=1e-4)


def test_a_source_raises_the_steady_pressure_and_the_balance_closes():
    rate, soil = 1e-7, replace(SOFT, conductivity=1e-6)
    s = column(
        cells=20,
        material=soil,
        conditions=[mpm.Drained("top")],
        terms=[mpm.Source(lambda points, q: rate * q * points.dx)],
    )
    result = s.run(5000, 250)
    exact = rate * 9810 / 1e-6 / 2 * (1 - s.points.x[:, 1] ** 2)
    lattice = (2, 20, 2)
    assert s.points.pressure.reshape(lattice).mean(axis=(0, 2)) == pytest.approx(
        exact.reshape(lattice).mean(axis=(0, 2)), abs=2e-3 * exact.max()
    )
    assert result.balance < 1e-8


def test_a_source_may_depend_on_the_pressure_and_on_time():
    """Leakage c p out of a layer at pressure p0: p'' = c p / kappa. Newton's method uses the derivative."""
    leak, soil = 4e-10, replace(SOFT, conductivity=1e-6)
    s = column(
        cells=20,
        material=soil,
        conditions=[mpm.Drained("top", pressure=1e3)],
        terms=[mpm.Source(lambda points, q, p: -leak * p * q * points.dx)],
    )
    result = s.run(2e4, 1e3)
    a = np.sqrt(leak * 9810 / 1e-6)
    lattice = (2, 20, 2)
    mean = lambda values: values.reshape(lattice).mean(axis=(0, 2))  # noqa: E731
    assert mean(s.points.pressure) == pytest.approx(mean(1e3 * np.cosh(a * s.points.x[:, 1]) / np.cosh(a)), rel=2e-3)
    assert result.newton < 3 * result.steps and result.balance < 1e-8
    closed = column(terms=[mpm.Source(lambda points, q, t: 1e-9 * t * q * points.dx)], material=soil)
    closed.run(4.0, 1.0)
    # 1e-9 4^2 / 2 of water into what gives way by M
    assert closed.points.J - 1 == pytest.approx(8e-9 / (1 + 0.4 * SOFT.oedometric / 2.2e9), rel=1e-3)


# ---- bad input ------------------------------------------------------------------------------------


class NoLaw(mpm.Skeleton):
    pass


class Unknown(mpm.Skeleton):
    @staticmethod
    def energy(F, bulk, stiffness):
        return bulk


@dataclass(frozen=True)
class Taken(mpm.Hencky):
    weight: float = 1.0

    @staticmethod
    def energy(F, weight):
        return weight


class WrongUpdate(Damaged):
    @staticmethod
    def update(F, damage):
        return {"damage": F}


class Fibres(mpm.NeoHookean):
    """A law whose direction has more components than F in the plane and in plane strain."""

    @staticmethod
    def energy(F, bulk, shear):
        stretch = F * ufl.as_vector((1.0, 0.0, 0.0, 0.0))
        return mpm.NeoHookean.energy(F, bulk, shear) + ufl.inner(stretch, stretch)


CASES = {
    "sum over two sizes": (lambda: column(fluid=False, material=Fibres(1, 1)), "Fibres.*must be"),
    "no law": (lambda: column(fluid=False, material=NoLaw(1, 1)), "NoLaw: defines neither of energy and kirchhoff"),
    "unknown parameter": (lambda: column(fluid=False, material=Unknown(1, 1)), "'stiffness' of its functions, must"),
    "reserved name": (lambda: column(fluid=False, material=Taken(1, 1)), "the name 'weight' is taken"),
    "field of the wrong shape": (
        lambda: column(fluid=False, material=replace(SOFT, bulk=lambda X: X.mean())),
        r"bulk\(X\) has shape \(\), must be \(\d+,\), one value for each position",
    ),
    "field out of range": (
        lambda: column(fluid=False, material=replace(SOFT, bulk=lambda X: X[:, 1] - 0.5)),
        "bulk = -0.475, must be > 0",
    ),
    "update of another shape": (
        lambda: column(fluid=False, material=WrongUpdate(1, 1)).step(1.0),
        r"WrongUpdate.update: returns \{'damage': \(2, 2\)\}, must have",
    ),
    "unknown argument of a term": (
        lambda: column(fluid=False, terms=[lambda points, w: w]), "argument 'w', must be one of points, u, v, t, dt"),
    "source without fluid": (lambda: column(fluid=False, terms=[mpm.Source(lambda q: q)]), "need a fluid"),
    "unknown argument of a conductivity": (
        lambda: column(material=replace(SOFT, conductivity_law=lambda stress: stress)), "argument 'stress', must be"),
    "negative conductivity": (
        lambda: column(material=replace(SOFT, conductivity_law=lambda J: 1 - 2 * J)).step(1.0), "k = -1 at .* >= 0"),
    "state in the reference": (
        lambda: BiotFEM(mpm.Grid([0, 0], [1, 1], (2, 2)), Damaged(1, 1), walls={}), "the reference has no state"),
}  # fmt: skip


@pytest.mark.parametrize(("make", "message"), CASES.values(), ids=CASES)
def test_one_line_says_what_is_wrong(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_term_of_nothing_changes_nothing_where_one_of_two_materials_is_a_field():
    grid = mpm.Grid([0, 0], [0.5, 1.2], [5, 12])
    bodies = [mpm.box(grid, [0, 0], [0.5, 0.5]), mpm.box(grid, [0, 0.5], [0.5, 1], material=1)]
    materials = [mpm.Hencky(bulk=2e6, shear=1e6), mpm.Hencky(bulk=lambda X: 1e6 * (2 - X[:, 1]), shear=1e6)]

    def nothing(points, v, t):
        return (t - t) * points.value(v)[0] * points.dx

    settled = []
    for terms in ([], [nothing]):
        s = mpm.Simulation(
            grid,
            bodies,
            materials,
            walls={"left": "x", "right": "x", "bottom": "y"},
            conditions=[mpm.Traction("top", lambda t: -1e5 * t)],
            terms=terms,
        )
        s.run(1.0, 0.25, progress=False)
        settled.append(s.points.corners)
    assert np.abs(settled[1] - settled[0]).max() < 1e-12
