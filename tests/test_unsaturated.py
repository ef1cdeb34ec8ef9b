# SPDX-License-Identifier: MIT
"""Soil whose pores drain under suction, against exact and converged solutions."""

import warnings
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.pores.pore_water import PoreWater
from mpm_dolfinx.solve.newton import Newton

WATER = 9810.0  # N/m^3
STIFF = {"bulk": 1e10, "shear": 5e9}  # Pa: soil that hardly deforms


def column(cells, soils, pressure, conditions=(), edge=None, width=1, **options):
    """Return a column of 1 m between smooth walls. edge: height of the lower end of the second soil, in m."""
    h = 1 / cells
    grid = mpm.Grid([0, 0], [width * h, 1 + 2 * h], [width, cells + 2])
    ends = [0.0, 1.0] if edge is None else [0.0, edge, 1.0]
    bodies = [mpm.box(grid, [0, a], [width * h, b], material=i) for i, (a, b) in enumerate(pairwise(ends))]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    scene = {"fluid": mpm.Fluid(), "walls": walls, "conditions": conditions, "gravity": (0, -9.81), **options}
    return mpm.Simulation(grid, bodies, soils, pressure=pressure, **scene)


def heads(s, z):
    """Return pressures at heights z, in m, divided by the unit weight of water."""
    cell = s.cells()
    return np.interp(z, cell.x[:, 1], cell.pressure) / WATER


def water(s):
    """Return the water in all pores, in m^2."""
    return s.cells().water.sum()


SRIVASTAVA_YEH = {
    1: (-0.0874255, -0.2054024, -0.3388616, -0.2845462),
    6: (-0.0496160, -0.0926696, -0.0924447, -0.0608852),
}
TAKEN_IN = {1: 0.0288, 6: 0.1518453}  # m


def infiltrated(cells, dt):
    """Return the column of Srivastava and Yeh (1991), and the errors of its heads at four heights, by hour."""
    a, k = 5.0, 1e-5
    law = mpm.Gardner(WATER / a)
    soil = mpm.LinearElastic(**STIFF, porosity=0.35, conductivity=k, retention=law)
    sides = [mpm.Drained("bottom"), mpm.Inflow("top", 0.9 * k)]

    def steady(x):
        return WATER / a * np.log(0.1 + 0.9 * np.exp(-a * x[:, 1]))

    s = column(cells, [soil], steady, sides, initial_stress=mpm.K0(0.5))
    start, off = water(s), {}
    for hour, exact in SRIVASTAVA_YEH.items():
        s.run(3600 * hour, dt, progress=False)
        off[hour] = heads(s, [0.1, 0.25, 0.5, 0.75]) - exact
        assert (water(s) - start) * cells == pytest.approx(TAKEN_IN[hour], rel=2e-3)
        assert s.result.balance < 1e-8
    return off


def test_rain_on_exponential_soil_is_that_of_srivastava_and_yeh():
    """The error is below 0.6 % of the largest head with 20 cells, and 0.15 % with 40 cells: second order in h."""
    coarse, fine = (infiltrated(cells, 600) for cells in (20, 40))
    for hour in (1, 6):
        size = np.abs(SRIVASTAVA_YEH[1]).max()
        assert np.abs(coarse[hour]).max() < 0.006 * size
        assert np.abs(fine[hour]).max() < 0.0015 * size
        assert np.log2(np.abs(coarse[hour]).max() / np.abs(fine[hour]).max()) > 1.8


@pytest.mark.slow
def test_rain_on_exponential_soil_is_of_second_order_in_the_step():
    """After 6 h: errors of steps of 900 and 450 s, compared with steps of 112.5 s."""
    soil = mpm.LinearElastic(**STIFF, porosity=0.35, conductivity=1e-5, retention=mpm.Gardner(WATER / 5))
    found = []
    for dt in (900, 450, 112.5):
        sides = [mpm.Drained("bottom"), mpm.Inflow("top", 9e-6)]
        rest = {"initial_stress": mpm.K0(0.5), "numerics": mpm.Numerics(tolerance=1e-11)}
        s = column(20, [soil], lambda x: WATER / 5 * np.log(0.1 + 0.9 * np.exp(-5 * x[:, 1])), sides, **rest)
        s.run(6 * 3600, dt, progress=False)
        found.append(s.cells().pressure)
    errors = [np.abs(p - found[-1]).max() for p in found[:-1]]
    assert np.log2(errors[0] / errors[1]) > 1.8


@pytest.mark.parametrize(
    "cells, front, taken",
    [
        (25, 1.2e-3, 2.5e-3),
        pytest.param(50, 1e-3, 1e-3, marks=pytest.mark.slow),
        pytest.param(100, 2.5e-3, 1e-3, marks=pytest.mark.slow),
    ],
)
def test_a_front_runs_into_dry_soil_as_that_of_celia(cells, front, taken):
    """Celia, Bouloutas and Zarba (1990), second case, after 12 h: position of the head of -5 m, and water."""
    result = check_celia(cells, front, taken, dt=3600)
    assert result.balance < 1e-8


def test_a_front_runs_in_steps_by_the_error_of_its_water():
    """The bounds are the same, with about as many steps. Errors in time are far below errors of the cells."""
    result = check_celia(25, 1.2e-3, 2.5e-3, rtol=3e-2)
    assert result.steps < 35
    assert result.balance < 1e-8


class Celia:
    """Soil and sides of Celia's column, and reference values after 12 h, extrapolated from 1600 finite volumes."""

    law = mpm.VanGenuchten(WATER / 3.35, residual=0.102 / 0.368, n=2.0)
    soil = mpm.LinearElastic(**STIFF, porosity=0.368, conductivity=9.22e-5, retention=law)
    sides = (mpm.Drained("bottom", pressure=-10 * WATER), mpm.Drained("top", pressure=-0.75 * WATER))
    depth, taken_in = 0.375096, 0.026335  # m, of the head of -5 m; m

    def front(self, z, pressure):
        """Return the depth, in m, of a head of -5 m, from pressures at increasing heights z (n,)."""
        return np.interp(5.0, -pressure[::-1] / WATER, 1 - z[::-1])


def check_celia(cells, front, taken, **steps):
    """Run the column of Celia, and return its result."""
    known = Celia()
    s = column(cells, [known.soil], -10 * WATER, known.sides, initial_stress=mpm.K0(0.5))
    start = water(s)
    result = s.run(12 * 3600, progress=False, **steps)
    cell = s.cells()
    assert known.front(cell.x[:, 1], cell.pressure) == pytest.approx(known.depth, abs=front)
    assert (water(s) - start) * cells == pytest.approx(known.taken_in, rel=taken)
    return result


class Liakopoulos:
    """Del Monte sand as a user-defined curve: chi is the saturation."""

    def saturation(self, p):
        return ufl.max_value(1 - 1.9722e-11 * ufl.max_value(-p, 0.0) ** 2.4279, 0.2)

    def relative_permeability(self, p):
        return ufl.max_value(1 - 2.207 * ufl.max_value(1 - self.saturation(p), 1e-30) ** 1.0121, 0.0)


def test_a_column_drains_and_settles_as_that_of_liakopoulos():
    """20 cells, up to 2 h: errors of 0.5 % of the largest pressure, 0.2 % of the settlement, 2 % of the outflow."""
    E, nu, h = 1.3e6, 0.4, 0.05
    law = {"conductivity": 4.5e-10 * WATER, "retention": Liakopoulos()}
    soil = mpm.LinearElastic(bulk=E / 3 / (1 - 2 * nu), shear=E / 2 / (1 + nu), porosity=0.2975, **law)
    at_rest = mpm.K0(nu / (1 - nu))
    s = column(20, [soil], 0.0, [mpm.Drained("bottom")], fluid=mpm.Fluid(bulk=2e9), initial_stress=at_rest)
    top, start = mpm.probes(s.bodies, [[h / 2, 1.0]]), water(s)
    known = {
        5: ((-233.53, -596.34, -1306.2, -2345.0, -3294.2), 0.54974e-3, 3.36719e-6),
        10: ((-376.79, -949.79, -1982.1, -3283.3, -4335.7), 0.77114e-3, 2.72085e-6),
        30: ((-631.67, -1582.23, -3205.4, -4983.1, -6211.2), 1.15932e-3, 1.57255e-6),
        120: ((-906.99, -2267.84, -4542.4, -6847.5, -8264.9), 1.55827e-3, 3.33066e-7),
    }
    for minutes, (pressures, settled, flows) in known.items():
        result = s.run(60 * minutes, 6 * minutes, progress=False, probes=top)
        assert WATER * heads(s, [0.1, 0.25, 0.5, 0.75, 0.9]) == pytest.approx(pressures, abs=5e-3 * -pressures[-1])
        assert -result.displacement[-1, 0, 1] == pytest.approx(settled, rel=2e-3)
        assert s.outflows.array / h == pytest.approx([flows], rel=0.02)
    # what has left is what the surface has sunk by, and the pores have lost; strains are finite: 0.16 %
    assert (start - water(s)) / h == pytest.approx(1.55827e-3 + 7.10386e-3, rel=1e-2)


class Pressed:
    """Linear theory of a column of 1 m with a suction of 20 kPa, under a load of 1 % of the suction."""

    chi, jump, c, modulus, load = 0.3535533906, 0.01985921, 1.03261675e-8, 5e6, 200.0
    law = mpm.VanGenuchten(20e3, n=2.0)
    soil = mpm.LinearElastic(modulus / 3, modulus / 2, porosity=0.4, conductivity=1e-8, retention=law)
    held = 20e3 * np.sqrt(0.5)  # against the suction, so that soil has no stress at first
    sides = (mpm.Drained("top", pressure=-20e3), mpm.Traction("top", (0, held - load)))
    M = (2 * np.arange(400) + 1) * np.pi / 2

    def settled(self, T):
        """Return the settlement, in m."""
        return self.load / self.modulus * (1 - self.chi * self.jump * (2 / self.M**2 * np.exp(-(self.M**2) * T)).sum())

    def pressures(self, T, z):
        """Return the pressure increments at heights z (n,), in m, divided by the first jump."""
        return (2 / self.M * np.sin(self.M * (1 - z[:, None])) * np.exp(-(self.M**2) * T)).sum(axis=1)


def test_unsaturated_soil_consolidates_as_its_linear_theory_says():
    """A load of 1 % of the suction, 40 cells: settlement and pressures, divided by the first jump."""
    exact = Pressed()
    s = column(40, [exact.soil], -20e3, exact.sides, gravity=None)
    top = mpm.probes(s.bodies, [[1 / 80, 1.0]])
    for T in (0.1, 0.5):
        result = s.run(T / exact.c, (T / exact.c - s.t) / 10, progress=False, probes=top)
        assert -result.displacement[-1, 0, 1] == pytest.approx(exact.settled(T), rel=5e-5)
        cell = s.cells()
        found = (cell.pressure + 20e3) / (exact.load * exact.jump)
        assert found == pytest.approx(exact.pressures(T, cell.x[:, 1]), abs=5e-4)


@pytest.mark.parametrize("steps", [1, 5])
def test_a_sealed_cell_pressed_and_let_go_has_its_water_and_suction(steps):
    """Compression by 3 %, in any number of steps: the change of the fluid content is exact."""
    soil = mpm.Hencky(bulk=1e7, shear=5e6, porosity=0.4, retention=mpm.VanGenuchten(20e3, n=2.0))
    press = mpm.Displacement("top", lambda t: (0, -0.03 * (1 - abs(1 - t))))
    felt = -20e3 * np.sqrt(0.5)
    rest = {"gravity": None, "initial_stress": lambda x: np.full((len(x), 3), felt)}
    s = column(2, [soil], -20e3, [press], width=2, numerics=mpm.Numerics(tolerance=1e-12), **rest)
    start = water(s)
    s.run(1, 1 / steps, progress=False)
    assert s.cells().pressure.max() > -18e3
    assert water(s) == pytest.approx(start, rel=1e-12)
    s.run(2, 1 / steps, progress=False)
    assert water(s) == pytest.approx(start, rel=1e-12)
    assert np.abs(s.points.data["owed"]).max() < 1e-13
    full = 0.4 * np.sqrt(0.5) / (s.points.J.mean() - 0.6)  # the side gives way by 1e-6
    assert s.cells().pressure == pytest.approx(-20e3 * np.sqrt(1 / full**2 - 1), rel=1e-9)


@pytest.mark.parametrize("edge", [0.43, 0.5, 0.58])
def test_soils_under_hydrostatic_suction_are_at_rest(edge):
    """Soils with different retention curves, with the interface at any offset from the grid lines."""
    porous = {"bulk": 1e7, "shear": 5e6, "porosity": 0.4}
    laws = mpm.VanGenuchten(WATER / 2, residual=0.1, n=2.0), mpm.Gardner(WATER / 5)
    soils = [mpm.Hencky(**porous, conductivity=k, retention=law) for k, law in zip((1e-5, 1e-3), laws, strict=True)]
    s = column(10, soils, mpm.hydrostatic(0.33), edge=edge, initial_stress=mpm.K0(0.5), width=2)
    s.run(1000, 500, progress=False)
    cell = s.cells()
    assert cell.pressure / WATER == pytest.approx(0.33 - cell.x[:, 1], abs=1e-12)
    z = (np.arange(20000) + 0.5) / 20000
    suction = np.maximum(z - 0.33, 0)
    full = np.where(z < edge, 0.1 + 0.9 / np.sqrt(1 + (2 * suction) ** 2), np.exp(-5 * suction))
    assert water(s) == pytest.approx(0.2 * 0.4 * full.mean(), rel=5e-4)


def test_hydrostatic_suction_is_at_rest():
    law = mpm.VanGenuchten(WATER / 2, residual=0.1, n=2.0)
    soil = mpm.Hencky(bulk=1e7, shear=5e6, porosity=0.4, conductivity=1e-5, retention=law)
    s = column(10, [soil], mpm.hydrostatic(0.33), initial_stress=mpm.K0(0.5), width=2)
    z = (np.arange(2000) + 0.5) / 2000
    full = 0.1 + 0.9 / np.sqrt(1 + (2 * np.maximum(z - 0.33, 0)) ** 2)
    assert water(s) == pytest.approx(0.2 * (0.4 * full).mean(), rel=1e-4)
    s.run(1000, 500, progress=False)
    assert heads(s, [0.05, 0.95]) == pytest.approx([0.28, -0.62], abs=1e-10)
    assert np.abs(s.points.displacement).max() < 1e-10
    # the weight follows the water: stresses at the base are those of the soil and of the water in it
    above = (0.6 * 2650 + 400 * full)[z > 0.05].mean() * 0.95
    assert s.cells().stress[:, 1, 1].min() == pytest.approx(-9.81 * above, rel=1e-3)


def rising(head, k, a, q, z):
    """Return heads at heights z, in m, above a given head in exponential soil, in steady rain of q, in m/s."""
    return np.log(q / k + (np.exp(a * head) - q / k) * np.exp(-a * z)) / a


@pytest.mark.parametrize(("off", "k", "a"), [(0.0, 10, 2.5), (0.3, 10, 2.5), (0.5, 10, 2.5), (0.7, 100, 1)])
def test_seepage_through_layers_is_exact_at_any_offset(off, k, a):
    """Steady flow through exponential soils. k, a: ratios of the upper soil to the lower soil."""
    k, a, q, edge = (1e-6, k * 1e-6), (2.0, 2.0 * a), 0.5e-6, 0.5 + off / 20
    given = {"bulk": 1e13, "shear": 5e12, "porosity": 0.4}  # else a millimetre of settlement counts
    soils = [
        mpm.LinearElastic(**given, conductivity=one, retention=mpm.Gardner(WATER / rate))
        for one, rate in zip(k, a, strict=True)
    ]
    water = {"fluid": mpm.Fluid(bulk=np.inf), "initial_stress": mpm.K0(0.5)}
    sides = [mpm.Drained("bottom"), mpm.Inflow("top", q)]
    s = column(20, soils, lambda x: -0.1 * WATER * x[:, 1], sides, edge=edge, **water)
    s.run(1e9, 2.5e8, progress=False)
    z = s.cells().x[:, 1]
    above = rising(rising(0, k[0], a[0], q, edge), k[1], a[1], q, z - edge)
    exact = np.where(z < edge, rising(0, k[0], a[0], q, z), above)
    assert s.cells().pressure / WATER == pytest.approx(exact, abs=1e-9)


@dataclass(frozen=True)
class Brutsaert(mpm.Retention):
    """A law derived from a class of the package."""

    def effective(self, s):
        return 1 / (1 + (s / self.entry) ** 2)

    def conducts(self, s):
        return self.effective(s) ** 3


class Rising(Liakopoulos):
    """An invalid curve: its saturation increases with suction."""

    def saturation(self, p):
        return 1 - p / 1e4


@pytest.mark.parametrize(
    "law, said",
    [
        (lambda: mpm.VanGenuchten(0.0), "VanGenuchten: entry = 0.0, must be > 0"),
        (lambda: mpm.VanGenuchten(1e3, n=1.0), r"VanGenuchten: n = 1.0, must be in \(1, 20\]"),
        (lambda: mpm.VanGenuchten(1e3, residual=1.0), r"VanGenuchten: residual = 1.0, must be in \[0, 1\)"),
        (lambda: mpm.BrooksCorey(1e3, index=-1.0), r"BrooksCorey: index = -1.0, must be in \(0, 20\]"),
        (lambda: mpm.Gardner("wide"), "Gardner: entry = 'wide', must be > 0"),
        (lambda: mpm.Hencky(1e6, 1e6, retention=3), r"Hencky: retention = 3, must have saturation\(p\) and"),
        (lambda: mpm.Hencky(1e6, 1e6, retention=Rising()), "saturation must fall to 0.5"),
    ],
)
def test_what_is_no_law_of_retention_is_refused(law, said):
    with pytest.raises(ValueError, match=said):
        law()


def test_saturated_scenes_have_nothing_of_retention():
    """No piece field, no form, no table, and rain only where rain falls."""
    s = column(2, [mpm.Hencky(1e6, 1e6, conductivity=1e-6)], 0.0, [mpm.Drained("top")])
    s.run(1, 1, progress=False)
    forms = s.scene.storage
    assert not {"retention", "lever", "pores"} & s.scene.pieces.pieces.sizes.keys()
    assert (forms.retains, forms.fluxes.relative) == (False, None)
    assert not {"rain", "runoff", "rained", "ran_off", "ponded"} & s.state.outcome.keys()


def test_a_specific_yield_does_not_go_with_it():
    law = mpm.Gardner(1e3)
    with pytest.raises(ValueError, match=r"has retention and a specific yield 0\.1, must have only one of them"):
        mpm.Hencky(1e6, 1e6, conductivity_law=mpm.unsaturated(1e3, specific_yield=0.1), retention=law)


def test_laws_of_the_users_are_those_of_the_package():
    """A subclass of `Retention`, and an object: the same water as with the law of the package."""
    sides = [mpm.Drained("top", pressure=-2e3)]
    found = []
    for law in (mpm.VanGenuchten(5e3, n=2.0, l=0.0), Brutsaert(5e3)):
        soil = mpm.LinearElastic(**STIFF, porosity=0.4, conductivity=1e-6, retention=law)
        s = column(5, [soil], -1e4, sides, initial_stress=mpm.K0(0.5))
        s.run(600, 300, progress=False)
        found.append(water(s))
    assert found[0] != pytest.approx(found[1], rel=1e-3)  # laws differ, and both are seen


@pytest.mark.parametrize("cells, steps", [(4, 13), pytest.param(50, 160, marks=pytest.mark.slow)])
def test_a_body_at_rest_in_itself_keeps_its_water_and_suction_wherever_it_is_carried(cells, steps):
    """The sides move over several cells, in steps of a third of a cell; rows of domains cross grid lines."""
    h, table, end = 1 / 8, 0.3, 1000.0
    grid = mpm.Grid([0, 0], [1 + (cells + 2) * h, 1 + 2 * h], [cells + 10, 10])
    law = mpm.VanGenuchten(WATER / 2, residual=0.1, n=2.0)
    soil = mpm.Hencky(bulk=1e7, shear=5e6, porosity=0.4, conductivity=1e-5, retention=law)
    sides = [mpm.Displacement(side, lambda t: (t / end * cells * h, 0), components="x") for side in ("left", "right")]
    scene = {"fluid": mpm.Fluid(), "walls": {"bottom": "y"}, "conditions": sides, "gravity": (0, -9.81)}
    body = mpm.box(grid, [0.3 * h, 0], [1 + 0.3 * h, 7.3 * h])
    s = mpm.Simulation(grid, [body], [soil], pressure=mpm.hydrostatic(table), initial_stress=mpm.K0(1.0), **scene)
    start = water(s)
    s.run(end, end / steps, progress=False)
    cell = s.cells()
    assert water(s) == pytest.approx(start, rel=1e-12)
    assert np.abs(s.points.data["owed"] * s.points.volume0).sum() < 1e-6 * start
    assert cell.pressure == pytest.approx(WATER * (table - cell.x[:, 1]), abs=1e-6 * WATER * (7.3 * h - table))


@pytest.mark.slow
def test_a_column_in_axisymmetry_and_in_3d_is_that_of_plane_strain():
    """Water infiltrates from above: pressures are equal."""
    law = mpm.VanGenuchten(5e3, n=2.0)
    soil = mpm.Hencky(bulk=1e7, shear=5e6, porosity=0.4, conductivity=1e-6, retention=law)
    found = []
    for dim, axisymmetric in ((2, False), (2, True), (3, False)):
        grid = mpm.Grid([0] * dim, [0.2] * (dim - 1) + [1.4], [1] * (dim - 1) + [7], axisymmetric=axisymmetric)
        walls = {"left": "x", "right": "x", "bottom": "zy"[dim == 2]} | (
            {"front": "y", "back": "y"} if dim == 3 else {}
        )
        scene = {"walls": walls, "gravity": [0] * (dim - 1) + [-9.81], "fluid": mpm.Fluid(), "pressure": -1e4}
        body = mpm.box(grid, [0] * dim, [0.2] * (dim - 1) + [1.0])
        rest = mpm.K0(0.5)
        top = [mpm.Drained("top", pressure=-1e3)]
        s = mpm.Simulation(grid, [body], [soil], conditions=top, initial_stress=rest, **scene)
        s.run(1800, 300, progress=False)
        found.append(s.cells().pressure[np.argsort(s.cells().x[:, -1])])
    assert found[0][0] < -8e3
    assert found[1] == pytest.approx(found[0], rel=1e-6)
    assert found[2] == pytest.approx(found[0], rel=1e-6)


@pytest.mark.parametrize("suction", [1e4, pytest.param(3e4, marks=pytest.mark.slow)])
def test_suction_is_strength_by_bishops_stress(suction):
    """Sand with a free side carries (K_p - 1) chi s on its present width."""
    grid, felt = mpm.Grid([0, 0], [1.6, 1.2], [8, 6]), suction / np.sqrt(1 + (suction / 1e4) ** 2)
    law = {"conductivity": 1e-3, "retention": mpm.VanGenuchten(1e4, n=2.0)}
    soil = mpm.MohrCoulomb(bulk=1e7, shear=6e6, porosity=0.4, friction=30.0, dilation=0.0, cohesion=10.0, **law)
    sides = [mpm.Drained("top", pressure=-suction), mpm.Displacement("top", lambda t: (0, -0.02 * t), "y")]
    scene = {"fluid": mpm.Fluid(), "walls": {"left": "x", "bottom": "y"}, "conditions": sides, "pressure": -suction}
    body = mpm.box(grid, [0, 0], [1, 1])
    s = mpm.Simulation(grid, [body], [soil], initial_stress=lambda x: np.full((len(x), 3), -felt), **scene)
    s.run(1, 0.1, progress=False)
    width = s.points.corners[:, :, 0].max()
    assert -s.reactions.array[0, 1] / width == pytest.approx(2 * felt + 20 * np.sqrt(3), rel=2e-3)


def test_a_block_with_suction_falls_as_everything_does():
    """The block has the weight and the mass of soil and water, and keeps its water."""
    soil = mpm.Hencky(1e7, 5e6, porosity=0.4, conductivity=1e-5, retention=mpm.VanGenuchten(2e4, n=2.0))
    grid = mpm.Grid([0, 0], [2, 3], [8, 12])
    scene = {"fluid": mpm.Fluid(), "gravity": (0, -9.81), "walls": {}, "pressure": -3e4, "inertia": True}
    s = mpm.Simulation(grid, [mpm.box(grid, [0.53, 1.61], [1.53, 2.61])], [soil], **scene)
    start = water(s)
    s.run(0.2, 0.02, progress=False)
    assert s.points.displacement[:, 1].mean() == pytest.approx(-9.81 * 0.2**2 / 2, rel=1e-4)
    assert water(s) == pytest.approx(start, rel=1e-9)


@dataclass(frozen=True)
class Unfelt(mpm.VanGenuchten):
    """Suction without effect on the skeleton."""

    def bishop(self, p):
        return 0 * p


def test_water_in_two_soils_that_fall_does_not_flow():
    soils = [
        mpm.Hencky(1e7, 5e6, porosity=0.4, conductivity=k, retention=Unfelt(entry, n=2.0))
        for k, entry in ((1e-3, 2e4), (1e-1, 4e4))
    ]
    grid = mpm.Grid([0, 0], [1, 2], [4, 8])
    scene = {"fluid": mpm.Fluid(), "gravity": (0, -9.81), "walls": {}, "pressure": -1e4, "inertia": True}
    bodies = [mpm.box(grid, [0.2, a], [0.8, a + 0.5], material=i) for i, a in enumerate((0.81, 1.31))]
    s = mpm.Simulation(grid, bodies, soils, **scene)
    s.run(0.04, 0.02, progress=False)
    assert s.points.displacement[:, 1] == pytest.approx(-9.81 * 0.04**2 / 2, rel=2e-4)
    assert s.points.pressure == pytest.approx(-1e4, abs=10)


def test_a_dry_column_swings_with_the_mass_of_its_water():
    """The period is that of soil and its pore water, 8 % less than with full pores."""
    law, p = mpm.VanGenuchten(1e3, residual=0.3, n=4.0), -1e6
    soil = mpm.LinearElastic(1e7, 5e6, porosity=0.4, retention=law)
    grid = mpm.Grid([0, 0], [0.05, 1.1], [1, 22])
    felt = p * 1e3**-3
    period = 4 * np.sqrt((0.6 * 2650 + 400 * (0.3 + 0.7 * 1e3**-3)) / (1e7 + 4 / 3 * 5e6))
    scene = {"fluid": mpm.Fluid(), "walls": {"left": "x", "right": "x", "bottom": "y"}, "pressure": p}
    scene |= {"initial_stress": lambda x: np.full((len(x), 3), felt)}
    speed = lambda x: np.stack([0 * x[:, 0], 1e-3 * np.sin(np.pi * x[:, 1] / 2)], axis=1)  # noqa: E731
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.05, 1])], [soil], inertia=mpm.Moving(speed), **scene)
    top = mpm.probes(s.bodies, [[0.025, 1.0]])
    result = s.run(0.6 * period, period / 80, progress=False, probes=top)
    t, u = result.t, result.displacement[:, 0, 1]
    i = np.flatnonzero((u[:-1] > 0) & (u[1:] <= 0))[0]
    assert 2 * (t[i] + (t[i + 1] - t[i]) * u[i] / (u[i] - u[i + 1])) == pytest.approx(period, rel=1e-3)


class Haverkamp:
    """River sand of Vauclin, Khanji and Vachaud (1979)."""

    def saturation(self, p):
        return 4e4 / (4e4 + ufl.max_value(-100 * p / WATER, 1e-12) ** 2.90)

    def relative_permeability(self, p):
        return 2.99e6 / (2.99e6 + ufl.max_value(-100 * p / WATER, 1e-12) ** 5.0)


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.1, 0.05])
def test_a_water_table_rises_under_rain_as_that_of_vauclin(h):
    """In 2D, after 4 and 8 h: errors of 0.3 cm of the height, and 1.5 % of the flow into the ditch."""
    grid = mpm.Grid([0, 0], [3, 2 + 2 * h], [round(3 / h), round(2 / h) + 2])
    soil = mpm.LinearElastic(**STIFF, porosity=0.3, conductivity=0.35 / 3600, retention=Haverkamp())
    sides = [
        mpm.Rain("top", 0.148 / 3600, region=((-1, 1.9), (0.5, 2.1))),
        mpm.Drained("right", lambda t, x: WATER * (0.65 - x[:, 1]), region=((2.9, -1), (3.1, 0.65)), name="ditch"),
    ]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    scene = {"fluid": mpm.Fluid(), "walls": walls, "conditions": sides, "gravity": (0, -9.81)}
    scene |= {"pressure": mpm.hydrostatic(0.65), "initial_stress": mpm.K0(0.5)}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [3, 2])], [soil], **scene)
    known = {
        4: ((1.1005, 1.0426, 0.9378, 0.8528, 0.7834, 0.7210), 389.6e-4),
        8: ((1.2187, 1.1601, 1.0531, 0.9557, 0.8642, 0.7720), 653.1e-4),
    }
    for hours, (heights, flow) in known.items():
        s.run(3600 * hours, 600, progress=False)
        cell = s.cells()
        columns = np.unique(np.round(cell.x[:, 0], 6))
        tables = []
        for x in columns:
            of = np.abs(cell.x[:, 0] - x) < 1e-5
            order = np.argsort(cell.x[of, 1])
            tables.append(np.interp(0.0, -cell.pressure[of][order], cell.x[of, 1][order]))
        assert np.interp([0, 0.5, 1, 1.5, 2, 2.5], columns, tables) == pytest.approx(heights, abs=3e-3)
        assert 3600 * s.outflows["ditch"] == pytest.approx(flow, rel=0.015)
    assert s.result.balance < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    "cells, times", [(10, "hour day year"), (10, "hour whole"), (9, "hour whole"), (20, "hour whole")]
)
def test_very_dry_sand_beside_clay_is_ponded_and_stands_a_year(cells, times, monkeypatch):
    """From a suction of -100 m: an hour with cut steps, then a day, and steps of a month; or a year in one step."""
    grid = mpm.Grid([0, 0], [1, 1 + 2 / cells], [cells, cells + 2])
    porous = {"bulk": 1e8, "shear": 5e7, "porosity": 0.4}
    sand = mpm.Hencky(**porous, conductivity=1e-4, retention=mpm.VanGenuchten(WATER / 14.5, residual=0.1, n=7.0))
    clay = mpm.Hencky(**porous, conductivity=1e-8, retention=mpm.VanGenuchten(WATER, residual=0.1, n=1.1))
    bodies = [mpm.box(grid, [0, 0], [0.5, 1]), mpm.box(grid, [0.5, 0], [1, 1], material=1)]
    scene = {"fluid": mpm.Fluid(), "walls": {"left": "x", "right": "x", "bottom": "y"}, "gravity": (0, -9.81)}
    scene |= {"conditions": [mpm.Drained("top", pressure=0.1 * WATER)], "pressure": -100 * WATER}
    s, counts = mpm.Simulation(grid, bodies, [sand, clay], initial_stress=mpm.K0(0.5), **scene), []
    advanced, direction = mpm.Simulation.advanced, Newton._direction

    def counted(self, dt):
        counts.append(0)
        return advanced(self, dt)

    def one_more(*arguments):
        counts[-1] += 1
        return direction(*arguments)

    monkeypatch.setattr(mpm.Simulation, "advanced", counted)
    monkeypatch.setattr(Newton, "_direction", one_more)
    day = 86400.0
    runs = {"hour": (3600, 3600), "day": (day, day / 4), "year": (365 * day, 30 * day), "whole": (366 * day, 366 * day)}
    for time in times.split():
        result = s.run(*runs[time], progress=False)
        assert result.balance < 1e-8
    assert max(counts) <= 60
    assert s.cells().pressure.min() > 0


@pytest.mark.parametrize("air_entry", [0.0, 200.0])
def test_a_curve_that_is_infinitely_steep_is_named_when_a_step_fails(air_entry):
    """Rain wets loam with n = 1.3 up to zero suction. With an air entry, all steps converge."""
    law = mpm.VanGenuchten(WATER / 3.35, residual=0.1, n=1.3, air_entry=air_entry)
    soil = mpm.LinearElastic(**STIFF, porosity=0.4, conductivity=1e-5, retention=law)
    sides = [mpm.Drained("bottom", pressure=0.2 * WATER), mpm.Rain("top", 3e-5)]
    s = column(10, [soil], mpm.hydrostatic(0.2), sides, initial_stress=mpm.K0(0.5))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = s.run(3600, 600, progress=False)
    said = [str(w.message) for w in caught if "without air_entry" in str(w.message)]
    assert len(said) == (result.cuts > 0) == (not air_entry)
    assert not said or ("VanGenuchten(" in said[0] and "\n" not in said[0])


@pytest.mark.parametrize("p", [-1e7, -1e3, 1e3, 1e7, 1e9])
@pytest.mark.parametrize("entry", [np.inf, 1e4])
def test_the_pressure_of_a_water_content_is_found_however_large_it_is(p, entry):
    """Two pieces of a cell, of saturated (entry = inf) or unsaturated soil."""

    def full(at):
        S = np.exp(np.minimum(at, 0.0) / entry)
        return S, np.where(at < 0, S / entry, 0.0)

    scale, offset = 1.0 if entry == np.inf else entry, np.array([1.4e4, -1.3e5])
    water = PoreWater(full, np.zeros(2, dtype=int), np.full(2, 1e-10), np.array([0.13, 0.27]), 2.2e9, np.array([scale]))
    found = water.level(water.of_cells(p + offset), np.zeros(1), offset)
    assert found == pytest.approx(p, rel=1e-3)
    assert water.of_cells(found + offset) == pytest.approx(water.of_cells(p + offset), rel=1e-12)
