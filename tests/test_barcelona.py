# SPDX-License-Identifier: MIT
"""Soil that collapses when it is wetted: closed forms of the Barcelona Basic Model in Bishop's stress, and scenes."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import ufl
from helpers import set_up
from laws import LawAtPoints
from scenes.comparing import differences
from scenes.description import Block, Condition, Scene
from scenes.frames import Frame
from scenes.running import run
from scipy.optimize import brentq

import mpm_dolfinx as mpm
from mpm_dolfinx import element_test

NET, S0 = 6e4, 1e5  # Pa: net stress and suction at the start
WET, KAPPA, R, BETA, REFERENCE, OCR = 0.1, 0.02, 0.4, 2e-5, 1e4, 1.5
RETENTION = mpm.VanGenuchten(50e3, n=1.6)


def felt(s):
    """Return Bishop's suction stress chi s, in Pa."""
    return (1 + (s / 50e3) ** 1.6) ** (1 / 1.6 - 1) * s


def slope(s):
    """Return lambda(s)."""
    return WET * ((1 - R) * np.exp(-BETA * s) + R)


def power(s):
    """Return the power of the loading-collapse curve."""
    return (WET - KAPPA) / (slope(s) - KAPPA)


P0 = NET + felt(S0)
CLAY = mpm.ModifiedCamClay(
    M=1.2, lambda_=WET, kappa=KAPPA, shear=3e6, initial_stress=(-P0,) * 3, OCR=OCR, retention=RETENTION
)
CONSTANTS = {name: value for name, value in vars(CLAY).items() if name != "bulk"}
SOIL = mpm.BarcelonaBasic(**CONSTANTS, r=R, beta=BETA, reference=REFERENCE)


def wetted(suctions, net=NET):
    """Return ln J, and ln of P_c0 divided by its initial value, along suctions at an isotropic net stress.

    ln J = -kappa ln(P / P_0) - (lambda(0) - kappa) ln(P_c0 / initial P_c0), with P = J (net + chi s) <= P_c(s).
    """
    out, start = [], np.log(OCR * P0 / REFERENCE) / power(S0)
    size = start

    def mean(x, s):
        return np.log(np.exp(x) * (net + felt(s)))

    def off(x, s, size):
        return x + KAPPA * (mean(x, s) - np.log(P0)) + (WET - KAPPA) * (size - start)

    for s in suctions:
        x = brentq(off, -1, 1, (s, size), xtol=1e-15)
        if mean(x, s) - np.log(REFERENCE) > power(s) * size:
            x = brentq(lambda x, s=s: off(x, s, (mean(x, s) - np.log(REFERENCE)) / power(s)), -1, 1, xtol=1e-15)
            size = (mean(x, s) - np.log(REFERENCE)) / power(s)
        out.append((x, size - start))
    return np.array(out).T


# ---- at a point ------------------------------------------------------------------------------------


def test_soil_that_gets_wet_swells_then_collapses_and_dries_as_its_closed_form():
    r = element_test(SOIL, "wetting isotropic", [0.0, S0, 0.0, 1.5 * S0], steps=20, suction=S0)
    volume, size = wetted(r.strain)
    assert -r.volume_strain == pytest.approx(volume, abs=1e-10)
    assert r.state["consolidated"] == pytest.approx(size, abs=1e-9)
    assert r.p == pytest.approx(NET + felt(r.strain), rel=1e-10)
    swells = np.argmax(volume[:21])
    assert volume[swells] > 1e-3 and (r.state["consolidated"][: swells + 1] == 0).all()
    assert volume[20] < -0.04
    assert r.state["consolidated"][40:61] == pytest.approx(size[40], abs=1e-9), "getting wet again it is elastic"


def test_in_one_step_it_collapses_as_far():
    at_once = element_test(SOIL, "wetting isotropic", 0.0, steps=1, suction=S0)
    assert -at_once.volume_strain[-1] == pytest.approx(wetted([0.0])[0][0], abs=1e-12)


@pytest.mark.parametrize("s", [0.0, 3e4, S0])
def test_soil_of_a_constant_suction_is_compressed_along_its_lambda(s):
    r = element_test(SOIL, "isotropic", [0.04, 0.03], steps=20, suction=s)
    ln_J = -3 * r.strain
    at_yield = -KAPPA * np.log(OCR)
    loading = np.where(ln_J > at_yield, -ln_J / KAPPA, np.log(OCR) - (ln_J - at_yield) / slope(s))
    loading[21:] = loading[20] - (ln_J[21:] - ln_J[20]) / KAPPA
    assert r.p * np.exp(ln_J) == pytest.approx(P0 * np.exp(loading), rel=1e-10)


def test_strength_grows_with_suction_as_bishops_stress():
    """Drained tests with constant lateral net stress end at q = M p', with p' = net + chi s + q / 3."""
    for s in (0.0, 3e4, S0):
        soil = replace(SOIL, initial_stress=(-NET - felt(s),) * 3)
        r = element_test(soil, "triaxial drained", 2.0, steps=50, suction=s)
        assert r.q[-1] == pytest.approx(3 * CLAY.M / (3 - CLAY.M) * (NET + felt(s)), rel=1e-6)


@pytest.fixture(scope="module", params=[2, pytest.param(3, marks=pytest.mark.slow)], ids=["2D", "3D"])
def points(request):
    stress = (-0.8 * P0, -1.2 * P0, -P0)
    return [LawAtPoints(replace(m, initial_stress=stress), request.param) for m in (SOIL, CLAY)]


def strained(dim):
    """Return deformation gradients near I, with compression on average."""
    return np.eye(dim) * 0.995 + 0.02 * np.random.default_rng(dim).normal(size=(60, dim, dim))


def test_without_suction_it_is_modified_cam_clay_to_the_bit(points):
    soil, clay = points
    F = strained(soil.dim)
    assert (soil.kirchhoff(F) == clay.kirchhoff(F)).all()
    new, same = soil.update(F), clay.update(F)
    assert (new["plastic"] == same["plastic"]).all() and (np.abs(same["consolidated"]) > 1e-3).sum() > 20
    assert new["consolidated"] == pytest.approx(same["consolidated"], abs=1e-15)


def test_under_a_suction_it_is_modified_cam_clay_of_another_lambda(points):
    """P_c also differs: soil seeded at 1e4 Pa is tested at 3e4 Pa."""
    soil, s, start = points[0], 3e4, 1e4
    F, m = strained(soil.dim), points[0].material
    state = {"suction": np.full(60, s), "suction_at_start": np.full(60, start)}
    size = REFERENCE * (m.yield_pressure / REFERENCE) ** (power(s) / power(start))
    same = replace(points[1].material, lambda_=slope(s), OCR=OCR * size / m.yield_pressure)
    same = LawAtPoints(same, soil.dim)
    assert soil.kirchhoff(F, state) == pytest.approx(same.kirchhoff(F), abs=1e-11 * P0)
    hardened = soil.update(F, state)["consolidated"]
    assert (np.abs(hardened) > 1e-3).sum() > 10
    assert hardened == pytest.approx(same.update(F)["consolidated"] / power(s), abs=1e-12)
    found, by_differences = soil.tangent(F, state, h=3e-7)
    error = np.abs(found - by_differences).max(axis=(1, 2, 3, 4)) / np.abs(found).max(axis=(1, 2, 3, 4))
    assert error.max() < 1e-7


def test_soil_softened_below_its_reference_does_not_feel_suction():
    """Otherwise this soil would become weaker as it dries."""
    weak = replace(SOIL, reference=5 * P0)
    found = [element_test(weak, "oedometer", 0.05, steps=5, suction=s).stress[-1] for s in (0.0, S0)]
    assert (found[0] == found[1]).all()
    assert not np.allclose(found[0], element_test(SOIL, "oedometer", 0.05, steps=5, suction=S0).stress[-1], rtol=1e-2)


# ---- in scenes -------------------------------------------------------------------------------------


def sample(soil, n, suction, conditions=(), **options):
    """Return a cylinder of 1 m under the net stress, with suction on its sides as a function of time."""
    grid = mpm.Grid([0, 0], [1 + 2 / n] * 2, [n + 2] * 2, axisymmetric=True)
    sides = [one for side in ("right", "top") for one in (mpm.Pressure(side, NET), mpm.Drained(side, suction))]
    walls = {"left": "x", "bottom": "y"}
    options = {"pressure": -S0, "numerics": mpm.Numerics(tolerance=1e-10), **options}
    scene = {"fluid": mpm.Fluid(), "walls": walls, "conditions": [*sides, *conditions]}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [soil], **scene, **options)


def states(s):
    """Return suction, ln J, and ln of P_c0 divided by its initial value, of the points."""
    return s.points.data["suction"], np.log(s.points.J), s.points.data["consolidated"]


@pytest.mark.parametrize("steps", [1, 8])
def test_a_sample_in_a_scene_swells_collapses_and_dries_as_its_closed_form(steps):
    """The error is below 1e-8 at all times, also in one step: water flows fast, so suctions are nearly uniform."""
    turn, end = 1e9, 1.5e9
    soil = replace(SOIL, conductivity=1e-3)
    s = sample(soil, 2, lambda t: -S0 * abs(1 - t / turn))
    seen = []
    for t in [turn, end] if steps == 1 else [*np.linspace(0, turn, steps + 1)[1:], end]:
        s.run(t, t - s.t, progress=False)
        suction, volume, size = states(s)
        seen.append(suction.mean())
        exact = wetted(seen)[:, -1]
        assert volume == pytest.approx(exact[0], abs=1e-8)
        assert size == pytest.approx(exact[1], abs=1e-7)
        assert s.result.balance < 1e-8 and s.result.cuts == 0
    assert seen[-2] < 1e-2 and min(np.log(s.points.J)) < -0.04


def test_a_column_in_a_scene_gets_wet_as_in_the_oedometer():
    """An element test at the suctions of the scene agrees to 1e-7. The column is sheared as it collapses."""
    s = narrow(replace(SOIL, conductivity=1e-3), 3, lambda t: -S0 * (1 - t / 1e9))
    lab = element_test(replace(SOIL, conductivity=1e-3), "wetting oedometer", 0.0, steps=5, suction=S0)
    for k in range(1, 6):
        s.run(2e8 * k, 2e8, progress=False)
        suction, volume, size = states(s)
        assert suction == pytest.approx(lab.strain[k], abs=1.0)
        assert volume == pytest.approx(-lab.volume_strain[k], abs=1e-6)
        assert size == pytest.approx(lab.state["consolidated"][k], abs=1e-5)
        assert s.effective_stress()[:, 0, 0] == pytest.approx(lab.stress[k, 0, 0], rel=1e-5)
    assert lab.q[-1] > 0.3 * lab.p[-1]


def narrow(soil, cells, suction, width=1, **options):
    """Return a column of 1 m under the net stress, with suction at its base as a function of time."""
    h = 1 / cells
    grid = mpm.Grid([0, 0], [width * h, 1 + 2 * h], [width, cells + 2])
    conditions = [mpm.Pressure("top", NET), mpm.Drained("bottom", suction)]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    options = {"pressure": -S0, "numerics": mpm.Numerics(tolerance=1e-10), **options}
    body = mpm.box(grid, [0, 0], [width * h, 1])
    return mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls=walls, conditions=conditions, **options)


@pytest.mark.parametrize(
    ("cells", "dt", "settles"), [(5, 1e6, 0.01), pytest.param(10, 1e5, 0.004, marks=pytest.mark.slow)]
)
def test_a_front_that_wets_a_column_leaves_it_collapsed_as_in_the_oedometer(cells, dt, settles):
    """The balance of the absorbed water is checked."""
    s = narrow(replace(SOIL, conductivity=1e-8), cells, 0.0)
    lab = element_test(SOIL, "wetting oedometer", 0.0, steps=100, suction=S0)
    result = s.run(1e7, dt, progress=False)
    suction, volume, _ = states(s)
    assert result.balance < 1e-8 and suction.max() < 1.0
    assert volume.mean() == pytest.approx(-lab.volume_strain[-1], rel=settles)
    assert np.abs(volume + lab.volume_strain[-1]).max() < 0.08 * lab.volume_strain[-1]


def layers(axisymmetric, other):
    """Return two soils in common cells, at suctions at which wetting makes the first soil collapse."""
    grid = mpm.Grid([0.0] * 2, [1.0] * 2, [4] * 2, axisymmetric=axisymmetric)
    left = 0.0 if axisymmetric else 0.1
    edges = (0, 0.37, 0.7)
    bodies = [mpm.box(grid, [left, edges[i]], [0.7, edges[i + 1]], material=i) for i in range(2)]
    soils = [replace(SOIL, OCR=1.0, conductivity=1e-8), other]
    return mpm.Simulation(grid, bodies, soils, fluid=mpm.Fluid(bulk=1e7), pressure=-8e4, walls={"bottom": "xy"})


@pytest.mark.parametrize(
    ("axisymmetric", "other"),
    [(False, CLAY), (True, mpm.Hencky(3e6, 2e6, retention=RETENTION))],
    ids=["beside clay", "axisymmetric, beside elastic soil"],
)
def test_the_tangent_has_what_stresses_change_by_with_suction(axisymmetric, other):
    """The tangent is compared with finite differences, for collapsing soil. Without this part, forces differ by more
    than half.
    """
    s, rng = layers(axisymmetric, other), np.random.default_rng(3)
    _, momentum, storage = set_up(s, 1e-6)
    u, p = momentum.system.unknowns, storage.system.unknowns
    u.add(momentum.forms.u.x, 1.0, u.gather_owned(2e-4 * rng.standard_normal(u.size)))
    p.add(storage.forms.p.x, 1.0, p.gather_owned(2e4 + 1e3 * rng.standard_normal(p.size)))
    momentum.assemble_residual()
    momentum.assemble_tangent()
    dp, found = p.gather_owned(rng.standard_normal(p.size)), []
    for more in ([], momentum.of_suction()):
        storage.assemble_residual()
        storage.assemble_tangent(of_suction=more)
        B, out = storage.system.B_momentum, momentum.system.unknowns.vector()
        B.multTranspose(dp, out)
        found.append(-out.array)
    forces = []
    for step in (1.0, -2.0):
        p.add(storage.forms.p.x, step, dp)
        forces.append(momentum.assemble_residual()[0].array.copy())
    forces = (forces[0] - forces[1]) / 2
    size = np.abs(forces).max()
    assert np.abs(found[1] - forces).max() < 1e-8 * size
    assert np.abs(found[0] - forces).max() > 0.4 * size


def test_soil_under_its_weight_is_at_rest_with_its_suction():
    """The soil is seeded on the yield surface above a water table; then rain makes it collapse."""
    soil = replace(SOIL, OCR=1.0, conductivity=1e-6)
    s = narrow(
        soil,
        5,
        lambda t, x: 9810 * (-5 - x[:, 1]),
        2,
        pressure=mpm.hydrostatic(-5.0),
        gravity=(0, -9.81),
        initial_stress=mpm.K0(0.6, surcharge=NET),
    )
    s.run(1000, 500, progress=False)
    assert np.abs(s.points.displacement).max() < 1e-9
    assert s.points.data["suction"] == pytest.approx(9810 * (5 + s.points.x[:, 1]), rel=1e-9)
    s.stage(conditions=[mpm.Pressure("top", NET), mpm.Inflow("top", 1e-7)])
    s.run(1e5, 2.5e4, progress=False)
    assert np.log(s.points.J).max() < 0 < s.points.data["consolidated"].min()


def test_it_shows_the_same_in_any_frame():
    """Scenes in other units, mirrored, translated, cut at a checkpoint, with a far body, and in another order agree."""
    law = {"M": 1.1, "lambda_": 0.08, "kappa": 0.015, "shear": 2e6, "initial_stress": (-6e4,) * 3, "porosity": 0.4}
    law |= {"r": 0.4, "beta": 4e-5, "reference": 3e3, "conductivity": 1e-7}
    law |= {"retention": ("VanGenuchten", {"entry": 2e4, "n": 1.8})}
    soils = ("BarcelonaBasic", law), ("BarcelonaBasic", law | {"OCR": 1.4})
    ground = Block((0.0, 0.0), (2.0, 1.6), 0), Block((0.0, 1.6), (2.0, 2.2), 1)
    strip = Condition("pressure", "top", (4e4,), 1e4, region=((-9.0, -9.0), (0.9, 9.0)))
    conditions = Condition("pressure", "top", (2e4,)), strip, Condition("inflow", "top", (2e-7,))
    walls = {"bottom": "xy", "left": "x", "right": "x"}
    scene = Scene(3, (4, 5), (0.5, 0.5), False, ground, soils, walls, conditions, fluid=2.2e9, level=-5.0, end=1e5)
    units = {"length": 1e3, "stress": 1e-3, "time": 60.0}
    frame = Frame((0, 1), (-1, 1), (1e4, -3e4), **units, order=7, far="tight", cut=True)
    base = run(scene, Frame.plain(2))
    assert base[-1].fields["volume"].min() < -5e-3
    assert max(differences(scene, base, run(scene, frame)).values()) < 1e-8


def test_a_sample_that_may_vibrate_collapses_as_far():
    """The sample is wetted slowly, with inertia."""
    soil = replace(SOIL, conductivity=1e-3)
    s = sample(soil, 2, lambda t: -S0 * (1 - t / 1e9), inertia=True)
    s.run(1e9, 2.5e8, progress=False)
    volume = states(s)[1]
    exact = wetted([0.0])[:, -1]
    assert volume == pytest.approx(exact[0], abs=1e-7)


@dataclass(frozen=True)
class Swelling(mpm.Hencky):
    """Soil without stress that swells: ln J is swell times the decrease of the suction."""

    state: ClassVar = {"suction": 0.0}
    swell: mpm.Field = 1e-6

    @staticmethod
    def energy(F, bulk, shear, suction, swell):
        return mpm.Hencky.energy(F, bulk, shear) + bulk * swell * suction * ufl.ln(ufl.det(F))


def test_an_energy_of_the_users_sees_suction():
    """In a column, (K + 4G / 3) ln J + K swell s = -J (net + chi s)."""
    soil = Swelling(bulk=3e6, shear=2e6, retention=RETENTION, conductivity=1e-3)
    s = narrow(soil, 2, lambda t: -S0 * (1 - t / 2e9))
    s.run(1e9, 5e8, progress=False)
    held, oedometric = 3e6 * 1e-6 * S0 / 2, 3e6 + 8e6 / 3
    exact = brentq(lambda x: oedometric * x + held + np.exp(x) * (NET + felt(S0 / 2)), -0.2, 0.2)
    assert np.log(s.points.J) == pytest.approx(exact, abs=1e-7)


# ---- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"r": 0.2}, "BarcelonaBasic: r = 0.2, must be > kappa / lambda_ = 0.2 and <= 1"),
        ({"r": 1.5}, "BarcelonaBasic: r = 1.5, must be > kappa / lambda_ = 0.2 and <= 1"),
        ({"r": None}, "BarcelonaBasic: r is not given, must be > kappa / lambda_, <= 1"),
        ({"beta": -1e-5}, "BarcelonaBasic: beta = -1e-05, must be >= 0 1/Pa and finite"),
        ({"reference": 0.0}, "BarcelonaBasic: reference = 0.0, must be > 0 Pa and finite"),
        ({"OCR": 0.5}, "BarcelonaBasic: OCR = 0.5, must be >= 1"),
    ],
)
def test_one_line_says_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")) as caught:
        replace(SOIL, **change)
    assert "\n" not in str(caught.value)


def test_it_needs_a_law_of_retention_and_suctions_that_are_none():
    dry = replace(SOIL, retention=None)
    with pytest.raises(ValueError, match="BarcelonaBasic: retention = None, must be a retention curve"):
        narrow(dry, 2, 0.0)
    with pytest.raises(ValueError, match="BarcelonaBasic: retention = None, must be a retention curve in wetting"):
        element_test(dry, "wetting isotropic", 0.0, suction=S0)
    with pytest.raises(ValueError, match=r"suction = -1\.0, must be >= 0 Pa"):
        element_test(SOIL, "isotropic", 0.1, suction=-1.0)
    with pytest.raises(ValueError, match=r"strain = .*, must be suctions >= 0 Pa in wetting"):
        element_test(SOIL, "wetting isotropic", [1e4, -1.0], suction=S0)
