# SPDX-License-Identifier: MIT
"""Results of extreme input are correct or refused, and the demo detects wrong results."""

from dataclasses import replace
from itertools import count
from math import nan

import extreme_cases as demo
import numpy as np
import pytest
from extreme.families import CUTS, DROP, series
from extreme.motion import FAMILIES
from extreme.scenes import INCOMPRESSIBLE, SOIL, WATER, Beam, M, column, off, settled, soil, square, stretch

import mpm_dolfinx as mpm


def judged(make, bound=1e-2):
    return demo.judge(demo.Row("", ""), make, bound)


def case(name, setting):
    """Return a case of a family, compared with its bound."""
    return judged(dict(FAMILIES[name].cases())[setting], FAMILIES[name].bound)


# ---- the method ------------------------------------------------------------------------------------


@pytest.mark.parametrize("fluid", [None, WATER], ids=["drained", "wet"])
def test_the_condition_number_does_not_grow_as_cells_are_filled_less(fluid):
    rows = [judged(Beam(soil(conductivity=1e-5), fluid, offset=1 - f)) for f in (0.5, 1e-3, 1e-6, 1e-10)]
    assert {r.outcome for r in rows} == {"converged"}
    assert max(r.condition for r in rows) < 1.1 * rows[0].condition < 2e4


def test_a_column_is_exact_however_little_sticks_into_the_next_cell():
    for f in (0.5, 1e-3, 1e-6, 1e-10):
        top = 1 + 0.05 * f
        row = judged(column(settled(top * (stretch(0.1) - 1)), (SOIL, top), load=0.1 * M), 1e-7)
        assert row.outcome == "converged", (f, row)


def test_the_tip_is_the_same_wherever_the_beam_lies_on_the_grid():
    tips = []
    for x, y in np.random.default_rng(7).random((6, 2)):
        scene = Beam(h=(1 / (19 + float(x)), 0.05), offset=float(y))()
        tips.append(scene.simulation.run(1.0, 1 / 8, probes=scene.probes).displacement[-1][0, 1])
    assert np.ptp(tips) < 2e-3 * abs(tips[0]), tips
    assert tips == pytest.approx([Beam().elements()[1]] * 6, rel=4e-3)


@pytest.mark.parametrize("strain", [1e-2, 1e-9])
@pytest.mark.parametrize("ratio", [1e-6, 1.0, 1e6])
def test_layers_of_any_stiffness_in_series_settle_as_exact(ratio, strain):
    load = strain * M * min(1, ratio)
    exact = 0.5 * (stretch(load / M) + stretch(load / M / ratio)) - 1
    row = judged(column(settled(exact), (SOIL, 0.5), (soil(1e7 * ratio), 1.0), load=load), 5e-5)
    assert row.outcome == "converged", row


@pytest.mark.parametrize("ratio", [1e-8, 1e-3, 1.0, 1e8])
def test_steady_flow_through_layers_of_any_conductivity_is_exact(ratio):
    ends = [mpm.Drained(side, p, ([-np.inf, y], [np.inf, y])) for side, p, y in (("bottom", DROP, 0), ("top", 0, 1))]
    layers = (SOIL, 0.5), (soil(conductivity=SOIL.conductivity * ratio), 1.0)

    def error(s, r):
        return series(CUTS["on a grid line"], ratio, s, r)

    row = judged(column(error, *layers, h=1 / 80, end=1e15, fluid=INCOMPRESSIBLE, conditions=ends), 1e-7)
    assert row.outcome == "converged", row


@pytest.mark.parametrize("angle", [0, 7, 45, 80])
def test_a_square_turned_by_any_angle_is_squeezed_evenly(angle):
    J = stretch(1e5 / (2 * SOIL.drained_modulus(2))) ** 2
    assert judged(square(angle, lambda s, r: off(s.points.J, J, 1 - J)), 1e-6).outcome == "converged"


@pytest.mark.parametrize("dt", [1e-9, 1e-3, 1.0, 1e9])
def test_time_steps_of_any_size_give_the_layers_consolidation(dt):
    assert case("time-step", f"dt = {dt:.0e} s").outcome == "converged"


@pytest.mark.parametrize("k", ["1e-12", "1e-01"])
@pytest.mark.parametrize("steep", ["1e-03", "1e+01", "1e+03"])
def test_rain_on_soil_of_any_retention_is_exact(k, steep):
    assert case("rain", f"k = {k} m/s, alpha h = {steep}").outcome == "converged"


@pytest.mark.parametrize("family", [name for name in FAMILIES if name.startswith("inertia")])
def test_scenes_with_inertia_are_right_at_both_ends_of_each_family(family):
    """Sides lagged by 100 % in short steps; undrained waves were too slow by up to 120 %; fast flights gave up."""
    cases = list(FAMILIES[family].cases())
    for setting, make in (cases[0], cases[-1]):
        row = judged(make, FAMILIES[family].bound)
        assert row.outcome == "converged", (setting, row)


@pytest.mark.parametrize("nu", [0.0, 0.499])
def test_water_that_flows_freely_costs_an_iteration_a_substep_at_most(nu):
    truth = {"truth": (80, 32) if nu else (40, 16)}
    wet = judged(Beam(soil(nu=nu, conductivity=1e2), WATER, end=8e9, **truth))
    dry = judged(Beam(soil(nu=nu), **truth))
    assert dry.outcome == wet.outcome == "converged", "no step is cut"
    assert wet.newton <= 2 * (dry.newton + wet.steps)


def test_a_slender_beam_buckles_in_one_step():
    assert case("buckling", "1.1 times, 1 steps").outcome in ("converged", "recovered")


NO_EQUILIBRIUM = {
    "pulled beyond Hencky's peak": lambda: column(None, (SOIL, 1.0), load=-0.4 * M, room=40),
    "turned inside out": lambda: column(None, (soil(law=mpm.LinearElastic), 1.0), load=2 * M, room=40),
    "pores closed": lambda: column(None, (SOIL, 1.0), end=1e9, fluid=WATER, conditions=[mpm.Drained("top", -M)]),
    "far too large a load": lambda: Beam(load=2e7, steps=1, ramp=1.0),
}


@pytest.mark.parametrize("make", NO_EQUILIBRIUM.values(), ids=NO_EQUILIBRIUM)
def test_what_has_no_equilibrium_is_refused_and_says_why(make):
    row = judged(make())
    assert row.outcome == "refused" and len(row.note) > 20 and "\n" not in row.note


# ---- the demo ----------------------------------------------------------------------------------------


def squeezed(error):
    return column(error, (SOIL, 1.0), load=0.1 * M)


def raising(error):
    def make():
        raise error

    return make


def spoilt(s, result):
    """Set the positions to nan."""
    s.state = replace(s.state, points=replace(s.points, x=np.full_like(s.points.x, nan)))
    return 0.0


OUTCOMES = {
    "converged": lambda: squeezed(settled(stretch(0.1) - 1)),
    "wrong": lambda: squeezed(settled(0.99 * (stretch(0.1) - 1))),
    "nan": lambda: squeezed(spoilt),
    "refused": lambda: raising(ValueError("bulk = -1")),
    "hung": lambda: lambda: all(n >= 0 for n in count()),
}


@pytest.mark.parametrize("outcome", OUTCOMES)
def test_the_demo_tells_outcomes_apart(outcome, monkeypatch):
    monkeypatch.setattr(demo, "LIMIT", 1)
    assert judged(OUTCOMES[outcome](), 1e-3).outcome == outcome


def test_an_error_of_unknown_kind_or_a_converged_run_without_equilibrium_is_wrong():
    assert judged(raising(ZeroDivisionError())).outcome == "wrong"
    assert judged(squeezed(None)).outcome == "wrong"


def test_a_residual_that_is_too_large_is_wrong(monkeypatch):
    monkeypatch.setattr(demo, "CLOSED", 1e-300)
    assert judged(Beam(SOIL, WATER)).outcome == "wrong"


def test_there_are_at_least_200_cases_and_60_quick_ones():
    counts = [len(list(f.cases())) for f in FAMILIES.values()]
    assert sum(counts) >= 200 and sum(min(4, n) for n in counts) >= 60
    assert all(0 < f.bound <= 0.02 or name == "thin" for name, f in FAMILIES.items())
