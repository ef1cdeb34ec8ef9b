# SPDX-License-Identifier: MIT
"""The exact solutions are compared with published numbers, with their equations, and with each other."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

from mpm_dolfinx.verification import exact

NU = 0.2
PLAIN = exact.Mandel(a=1, b=1, bulk=2 * (1 + NU) / (3 * (1 - 2 * NU)), shear=1, mobility=1)
SLABS = {
    "incompressible": exact.Mandel(a=2, b=3, bulk=4, shear=1.5, mobility=0.7, force=5),
    "compressible": exact.Mandel(a=2, b=3, bulk=4, shear=1.5, mobility=0.7, storage=0.3, alpha=0.8, force=5),
    "stiff fluid, auxetic": exact.Mandel(a=0.5, b=1, bulk=0.1, shear=1.5, mobility=2, storage=0.02, force=-3),
}
GAUSS = (1 + np.polynomial.legendre.leggauss(80)[0]) / 2, np.polynomial.legendre.leggauss(80)[1] / 2
slabs = pytest.mark.parametrize("m", SLABS.values(), ids=SLABS)
times = pytest.mark.parametrize("T", [0.004, 0.1, 0.7])


def first(f, x, h):
    """Return the first derivative by differences of fourth order."""
    return (8 * (f(x + h) - f(x - h)) - f(x + 2 * h) + f(x - 2 * h)) / (12 * h)


def second(f, x, h):
    """Return the second derivative by differences of fourth order."""
    return (16 * (f(x + h) + f(x - h)) - f(x + 2 * h) - f(x - 2 * h) - 30 * f(x)) / (12 * h * h)


def strains(m, x, t, h):
    return first(lambda x: m.displacement(x, m.b, t)[0], x, h), m.displacement(x, m.b, t)[1] / m.b


CRYER = (-0.9, -0.3, 0, 0.01, 0.25, 0.49)  # Poisson's ratios
BY_TIME = {
    "terzaghi pressure": lambda T: exact.terzaghi_pressure(np.linspace(0, 3, 7), T * 9 / 0.4, 3, 0.4),
    "terzaghi consolidation": lambda T: exact.terzaghi_consolidation(T * 9 / 0.4, 3, 0.4),
    **{
        f"mandel {what} {name}": lambda T, m=m, f=f: f(m, np.linspace(0, m.a, 7), T * m.a**2 / m.cv)
        for name, m in SLABS.items()
        for what, f in {
            "pressure": exact.Mandel.pressure,
            "displacement": lambda m, x, t: np.hstack(m.displacement(x, m.b, t)),
        }.items()
    },
    **{f"cryer {nu}": lambda T, nu=nu: exact.cryer_pressure(T * 4 / 0.3, 2, 0.3, nu) for nu in CRYER},
}


@pytest.mark.parametrize("f", BY_TIME.values(), ids=BY_TIME)
@pytest.mark.parametrize("T", [0.0201, 0.025])
def test_short_and_long_time_formulas_agree(f, T, monkeypatch):
    long, late = f(T), f(2.0)
    monkeypatch.setattr(exact, "SWITCH", 2.1)
    assert f(T) == pytest.approx(long, rel=1e-11, abs=1e-13)
    assert f(2.0) != pytest.approx(late, rel=1e-2)  # two formulas, not one twice


def test_times_may_be_an_array_across_the_switch():
    T = np.array([1e-6, 0.019, 0.021, 3.0])
    for f in (
        lambda t: exact.terzaghi_pressure(0.3, t, 1, 1),
        lambda t: exact.terzaghi_consolidation(t, 1, 1),
        lambda t: exact.cryer_pressure(t, 1, 1, 0.3),
        lambda t: PLAIN.pressure(0.3, t),
        lambda t: PLAIN.displacement(0.3, 0.2, t)[0],
        lambda t: PLAIN.displacement(0.3, 0.2, t)[1],
    ):
        assert f(T) == pytest.approx([f(t) for t in T], rel=1e-14)
        assert f(T).shape == (4,) and np.ndim(f(1.0)) == 0
    assert PLAIN.pressure(np.zeros((5, 1)), T).shape == (5, 4)


def test_terzaghi_consolidation_at_the_textbook_times():
    # Taylor (1948): T = 0.197 and 0.848 for 50 and 90 percent
    assert exact.terzaghi_consolidation(np.array([0.197, 0.848]), 1, 1) == pytest.approx([0.5, 0.9], abs=5e-4)
    assert exact.terzaghi_consolidation(1e-12, 1, 1) == pytest.approx(2e-6 / np.sqrt(np.pi), rel=1e-14)


@times
def test_terzaghi_pressure_diffuses_from_a_drained_to_a_sealed_end(T):
    height, cv, p0 = 3.0, 0.4, 7.0
    t, z, h = T * height**2 / cv, np.linspace(0.3, 2.7, 9), 0.05 * np.sqrt(T)

    def p(z, t):
        return exact.terzaghi_pressure(z, t, height, cv, p0)

    rate = first(lambda t: p(z, t), t, 1e-3 * t)
    assert rate == pytest.approx(cv * second(lambda z: p(z, t), z, h), rel=1e-5, abs=1e-6 * p0 * cv / height**2)
    assert p(0.0, t) == pytest.approx(0, abs=1e-14)
    sealed = p(height - h * np.arange(5), t) @ [25, -48, 36, -16, 3] / (12 * h)
    assert sealed == pytest.approx(0, abs=1e-5 * p0)
    mean = GAUSS[1] @ p(height * GAUSS[0], t)
    assert 1 - mean / p0 == pytest.approx(exact.terzaghi_consolidation(t, height, cv), rel=1e-12)


def test_terzaghi_starts_from_p0_and_is_a_half_space_at_first():
    assert exact.terzaghi_pressure(0.5, 1e-10, 1, 1, p0=3) == 3
    assert exact.terzaghi_pressure(1e-9, 1e-2, 1, 1) == pytest.approx(1e-8 / np.sqrt(np.pi), rel=1e-10)


def test_mandel_pressure_and_roots_have_the_known_values():
    assert PLAIN.cv == pytest.approx(8 / 3) and PLAIN.nu_undrained == 0.5 and PLAIN.skempton == 1
    assert PLAIN.roots[:3] == pytest.approx([1.28734215, 4.63159966, 7.80597844], abs=6e-9)
    T = np.array([0.01, 0.1, 0.5, 1])
    known = [0.52188057, 0.54770687, 0.29639269, 0.12942193]
    assert PLAIN.pressure(0, T / PLAIN.cv) == pytest.approx(known, abs=6e-9)
    assert PLAIN.pressure(0, 1e-14) == pytest.approx(0.5, rel=1e-6)


@slabs
def test_mandel_roots_solve_their_equation_one_in_each_interval(m):
    nu = (3 * m.bulk - 2 * m.shear) / (6 * m.bulk + 2 * m.shear)
    assert np.tan(m.roots) / m.roots == pytest.approx(np.full(exact.TERMS, (1 - nu) / (m.nu_undrained - nu)), rel=1e-9)
    assert np.array_equal(m.roots // np.pi, np.arange(exact.TERMS))


@slabs
@times
def test_mandel_conserves_fluid(m, T):
    t, x, h = T * m.a**2 / m.cv, m.a * np.linspace(0.1, 0.9, 9), 0.02 * m.a * np.sqrt(T)
    content = first(
        lambda t: m.alpha * sum(strains(m, x, t, h)) + m.storage * m.pressure(x, t),
        t,
        1e-2 * t,
    )
    flow = m.mobility * second(lambda x: m.pressure(x, t), x, h)
    assert content == pytest.approx(flow, rel=1e-5, abs=1e-6 * np.abs(flow).max())
    assert np.abs(flow).max() > 1e-3 * abs(m.force) * m.mobility / m.a**3


@slabs
@times
def test_mandel_is_in_equilibrium(m, T):
    t, x = T * m.a**2 / m.cv, m.a * np.linspace(0.1, 0.9, 9)
    lame, M, scale = m.bulk - 2 / 3 * m.shear, m.bulk + 4 / 3 * m.shear, abs(m.force) / m.a
    across, along = strains(m, x, t, 0.02 * m.a * np.sqrt(T))
    assert M * across + lame * along - m.alpha * m.pressure(x, t) == pytest.approx(np.zeros(9), abs=1e-6 * scale)
    u_left, u_right = m.displacement(np.array([0, m.a]), m.b, t)[0]
    pressures = m.a * GAUSS[1] @ m.pressure(m.a * GAUSS[0], t)
    total = M * along * m.a + lame * (u_right - u_left) - m.alpha * pressures
    assert total == pytest.approx(-m.force, rel=1e-12)
    assert u_left == 0
    assert m.pressure(m.a, t) == pytest.approx(0, abs=1e-14 * scale)
    y = np.linspace(0, m.b, 4)
    assert m.displacement(0.3 * m.a, y, t)[1] == pytest.approx(y / m.b * m.displacement(m.a, m.b, t)[1], rel=1e-14)


@slabs
def test_mandel_goes_from_the_undrained_to_the_drained_elastic_slab(m):
    nu = (3 * m.bulk - 2 * m.shear) / (6 * m.bulk + 2 * m.shear)
    for T, ratio in ((1e-16, m.nu_undrained), (60, nu)):
        u = m.displacement(m.a, m.b, T * m.a**2 / m.cv)
        elastic = m.force / (2 * m.shear) * np.array([ratio, -m.b / m.a * (1 - ratio)])
        assert u == pytest.approx(elastic, rel=1e-6, abs=1e-7 * abs(m.force / m.shear))
    start = m.pressure(0.5 * m.a, 1e-16 * m.a**2 / m.cv)
    assert start == pytest.approx(m.skempton * (1 + m.nu_undrained) * m.force / (3 * m.a), rel=1e-6)
    assert m.pressure(0, 60 * m.a**2 / m.cv) == pytest.approx(0, abs=1e-15)


def test_cryer_has_the_known_values_and_peak():
    known = [1.15389, 1.30750, 1.11788, 0.60663]
    assert exact.cryer_pressure(np.array([0.01, 0.05, 0.1, 0.2]) * 4, 2, 1, 0.25) == pytest.approx(known, abs=6e-6)
    T = np.linspace(0.03, 0.08, 501)
    p = exact.cryer_pressure(T, 1, 1, 0.25, p0=2)
    assert T[p.argmax()] == pytest.approx(0.0494, abs=2e-4)
    assert p.max() == pytest.approx(2 * 1.3075, abs=1e-4)
    assert exact.cryer_pressure(1e-12, 1, 1, 0.25) == pytest.approx(1, abs=1e-5)
    assert exact.cryer_pressure(20, 1, 1, 0.25) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("nu", [-0.5, 0, 0.1, 0.4])
def test_cryer_agrees_with_finite_volumes(nu):
    # e is the volume strain times K + 4G/3: e' = laplace e, e = g at the surface, p = e - g, g = m mean(e) - p0
    n, m = 200, 4 / 3 * (0.5 - nu) / (1 - nu)
    r = np.linspace(0, 1, n + 1)
    volume, conductance = np.diff(r**3) / 3, r[1:] ** 2 * n
    conductance[-1] *= 2
    A = np.diag(conductance[:-1], 1) + np.diag(conductance[:-1], -1)
    A -= np.diag(conductance + np.append(0, conductance[:-1]))
    A[-1] += conductance[-1] * m * 3 * volume
    A /= volume[:, None]
    source = np.zeros(n)
    source[-1] = -conductance[-1] / volume[-1]
    augmented = np.block([[A, source[:, None]], [np.zeros((1, n + 1))]])
    for T in (0.01, 0.05, 0.2):
        e = expm(augmented * T)[:n, n]
        centre = (9 * e[0] - e[1]) / 8  # even in r
        assert exact.cryer_pressure(T, 1, 1, nu) == pytest.approx(centre + 1 - m * 3 * volume @ e, abs=2e-4)


COLUMN = exact.SelfWeightColumn(l0=50, bulk=1e4 / 3, shear=1e4 / 2, density=80, gravity=10)


def test_column_has_the_known_height():
    assert COLUMN.height == pytest.approx(24.059646, abs=6e-7)


@pytest.mark.parametrize("c", [COLUMN, exact.SelfWeightColumn(2, 3e4, 1e4, 1500, 9.81)], ids=["soft", "nu > 0"])
def test_column_carries_its_weight_and_is_continuous(c):
    Y = np.linspace(0, c.l0, 11)
    kirchhoff = (c.bulk + 4 / 3 * c.shear) * np.log(c.stretch(Y))
    assert kirchhoff / c.stretch(Y) == pytest.approx(-c.density * c.gravity * (c.l0 - Y), rel=1e-12)
    assert c.stress(Y) == pytest.approx(kirchhoff / c.stretch(Y), rel=1e-12)
    assert c.stretch(c.l0) == 1
    heights = [quad(c.stretch, 0, y, epsabs=0, epsrel=1e-13)[0] for y in Y]
    assert c.position(Y) == pytest.approx(heights, rel=1e-12)
    assert c.height == c.position(c.l0)


def test_a_stiff_column_shortens_as_a_linear_one():
    c = exact.SelfWeightColumn(l0=2, bulk=1e9, shear=3e8, density=1000, gravity=10)
    assert 2 - c.height == pytest.approx(1000 * 10 * 2**2 / (2 * 1.4e9), rel=1e-4)


ELASTICA = {1: (0.05643, 0.30172), 2: (0.16064, 0.49346), 5: (0.38763, 0.71379), 10: (0.55500, 0.81061)}


@pytest.mark.parametrize(("load", "tip"), ELASTICA.items(), ids=ELASTICA)
def test_elastica_has_the_published_values_and_is_the_limit_of_the_rod(load, tip):
    u, v = exact.elastica_tip(load)
    assert (u, v) == pytest.approx(tip, abs=6e-6)
    L, EI = 3.0, 20.0
    rod = [exact.shear_flexible_rod(L, s, s, EI, load * EI / L**2, points=2)[-1] for s in (np.inf, 1e7, 1e6)]
    assert rod[0] == pytest.approx([L * (1 - u), L * v], abs=1e-7)
    far, near = np.abs(rod[2] - rod[0]).max(), np.abs(rod[1] - rod[0]).max()
    assert far > 1e-6 and near == pytest.approx(far / 10, rel=1e-2)


def test_elastica_for_small_and_large_loads():
    for load in (0.99e-4, 1.01e-4):  # either side of the change to the linear solution
        assert exact.elastica_tip(load) == pytest.approx((load**2 / 15, load / 3), abs=1e-12)
    assert exact.elastica_tip(0) == (0, 0)
    # a long rod ends straight along the load: the first integral gives both exactly, up to exp(-sqrt(load))
    u, v = exact.elastica_tip(1e4)
    assert u == pytest.approx(1 - np.sqrt(2 / 1e4), rel=1e-12)
    assert v == pytest.approx(1 - (2 - np.sqrt(2)) / np.sqrt(1e4), rel=1e-12)


def test_rod_under_small_loads_is_timoshenkos_beam():
    L, EA, GA, EI, q, P = 2.0, 40.0, 15.0, 9.0, 1e-5, 3e-5
    s = np.linspace(0, L, 9)
    under_q = exact.shear_flexible_rod(L, EA, GA, EI, line_load=q, points=s)
    assert under_q[-1, 1] == pytest.approx(q * L**4 / (8 * EI) + q * L**2 / (2 * GA), rel=1e-6)
    bending = q * s**2 * (6 * L**2 - 4 * L * s + s**2) / (24 * EI)
    assert under_q[:, 1] == pytest.approx(bending + q * (L * s - s**2 / 2) / GA, rel=1e-6, abs=1e-15)
    assert under_q[:, 0] == pytest.approx(s, abs=1e-8)
    under_p = exact.shear_flexible_rod(L, EA, GA, EI, end_load=P, points=9)
    assert under_p[:, 1] == pytest.approx(P * s**2 * (3 * L - s) / (6 * EI) + P * s / GA, rel=1e-6, abs=1e-15)


def test_large_deflection_of_the_rod_is_the_derivative_of_its_energy():
    L, EA, GA, EI, P, q = 2.0, 8.0, 5.0, 3.0, 2.0, 1.5
    s, weight = GAUSS

    def energy(P):
        """Return the strain energy minus the work of the loads, and the deflection of the tip."""
        state = exact._rod(np.array([P * L**2, q * L**3]) / EI, EI / (EA * L**2), EI / (GA * L**2))
        _, y, turn, moment = state(s)
        V = P + q * L * (1 - s)
        strain = (moment * EI / L) ** 2 / EI + (V * np.sin(turn)) ** 2 / EA + (V * np.cos(turn)) ** 2 / GA
        tip = L * state(1.0)[1]
        return L * weight @ (strain / 2 - q * L * y) - P * tip, tip

    slope = first(lambda P: energy(P)[0], P, 0.02)
    tip = exact.shear_flexible_rod(L, EA, GA, EI, P, q)[-1]
    assert -slope == pytest.approx(tip[1], rel=1e-6)
    assert tip[1] == pytest.approx(energy(P)[1], rel=1e-12) and tip[1] > 0.5 * L
    assert exact.shear_flexible_rod(L, EA, GA, EI, -P, -q)[-1] == pytest.approx(tip * [1, -1], abs=1e-7)


def slab(**change):
    return exact.Mandel(**{"a": 1, "b": 1, "bulk": 1, "shear": 1, "mobility": 1, **change})


BAD = {
    "terzaghi height": (lambda: exact.terzaghi_pressure(0, 1, -2, 1), "height = -2: must be > 0"),
    "terzaghi cv": (lambda: exact.terzaghi_pressure(0, 1, 1, 0), "cv = 0: must be > 0"),
    "terzaghi t": (lambda: exact.terzaghi_pressure(0, 0, 1, 1), "t = 0: must be > 0"),
    "terzaghi one t": (lambda: exact.terzaghi_pressure(0, [1, -0.5], 1, 1), "t = -0.5: must be > 0"),
    "terzaghi z": (lambda: exact.terzaghi_pressure([0, 2.5], 1, 2, 1), r"z = 2.5: must be in \[0, 2\]"),
    "consolidation t": (lambda: exact.terzaghi_consolidation(-1, 1, 1), "t = -1: must be > 0"),
    "consolidation height": (lambda: exact.terzaghi_consolidation(1, -1, 1), "height = -1: must be > 0"),
    "mandel a": (lambda: slab(a=-1), "a = -1: must be > 0"),
    "mandel b": (lambda: slab(b=0), "b = 0: must be > 0"),
    "mandel bulk": (lambda: slab(bulk=-3), "bulk = -3: must be > 0"),
    "mandel shear": (lambda: slab(shear=float("nan")), "shear = nan: must be > 0"),
    "mandel mobility": (lambda: slab(mobility=0), "mobility = 0: must be > 0"),
    "mandel storage": (lambda: slab(storage=-1e-9), "storage = -1e-09: must be >= 0"),
    "mandel alpha": (lambda: slab(alpha=1.5), r"alpha = 1.5: must be in \(0, 1\]"),
    "mandel no alpha": (lambda: slab(alpha=0), r"alpha = 0: must be in \(0, 1\]"),
    "mandel x": (lambda: slab().pressure(1.1, 1), r"x = 1.1: must be in \[0, 1\]"),
    "mandel t": (lambda: slab().pressure(0, 0), "t = 0: must be > 0"),
    "mandel u at x": (lambda: slab().displacement(-1, 0, 1), r"x = -1: must be in \[0, 1\]"),
    "mandel u at y": (lambda: slab().displacement(0, 2, 1), r"y = 2: must be in \[0, 1\]"),
    "mandel u at t": (lambda: slab().displacement(0, 0, -1), "t = -1: must be > 0"),
    "cryer nu": (lambda: exact.cryer_pressure(1, 1, 1, 0.5), r"nu = 0.5: must be in \(-1, 0.5\)"),
    "cryer negative nu": (lambda: exact.cryer_pressure(1, 1, 1, -1), r"nu = -1: must be in \(-1, 0.5\)"),
    "cryer radius": (lambda: exact.cryer_pressure(1, -1, 1, 0.2), "radius = -1: must be > 0"),
    "cryer cv": (lambda: exact.cryer_pressure(1, 1, -1, 0.2), "cv = -1: must be > 0"),
    "cryer t": (lambda: exact.cryer_pressure(0, 1, 1, 0.2), "t = 0: must be > 0"),
    "column height": (lambda: exact.SelfWeightColumn(-50, 1, 1, 1, 1), "l0 = -50: must be > 0"),
    "column gravity": (lambda: exact.SelfWeightColumn(50, 1, 1, 1, -9.81), "gravity = -9.81: must be > 0"),
    "column Y": (lambda: COLUMN.position([1, 51]), r"Y = 51: must be in \[0, 50\]"),
    "elastica": (lambda: exact.elastica_tip(-1), r"load_parameter = -1: must be in \[0, 1e5\]"),
    "rod length": (lambda: exact.shear_flexible_rod(-1, 1, 1, 1), "length = -1: must be > 0"),
    "rod GA": (lambda: exact.shear_flexible_rod(1, 1, 0, 1), "GA = 0: must be > 0"),
    "rod load": (lambda: exact.shear_flexible_rod(1, 1, 1, 1, np.inf), "end_load, line_load = inf: must be finite"),
    "rod points": (lambda: exact.shear_flexible_rod(1, 1, 1, 1, points=1), "points = 1: must be at least 2"),
    "rod arclength": (lambda: exact.shear_flexible_rod(1, 1, 1, 1, points=[1.5]), r"points = 1.5: must be in \[0, 1\]"),
}


@pytest.mark.parametrize(("call", "message"), BAD.values(), ids=BAD)
def test_bad_input_is_named_with_its_value_and_what_is_allowed(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
