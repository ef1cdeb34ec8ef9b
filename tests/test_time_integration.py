# SPDX-License-Identifier: MIT
"""Time: order of the steps, laws in substeps, jumps, adaptive steps, and output times."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import ufl
from helpers import SOFT, beam, column, rates

import mpm_dolfinx as mpm
from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.base.time_integration import METHODS
from mpm_dolfinx.simulation import simulation
from mpm_dolfinx.simulation.step_size import StepSize
from mpm_dolfinx.stepping.state import StepControl
from mpm_dolfinx.verification.exact import terzaghi_consolidation

OPEN = mpm.Drained("top")


def loaded(load, **options):
    return column(conditions=[mpm.Traction("top", (0, -load)), *options.pop("conditions", [])], **options)


def ramp(load, end):
    return [mpm.Traction("top", lambda t: (0, -load * min(1.0, t / end) ** 2))]


SOFT_WATER = mpm.Fluid(bulk=5e6)
HALVING = replace(SOFT, conductivity_law=lambda conductivity, J: conductivity * ufl.exp(5 * (J - 1)))
SCENES = {
    "compressible fluid and grains": {"fluid": SOFT_WATER, "material": replace(SOFT, grain_bulk=5e7, biot=0.9)},
    "conductivity law": {"material": HALVING},
    "gravity of time": {"gravity": lambda t: (0, -500.0 * min(1.0, t / 40) ** 2)},
    "source of time": {"terms": [mpm.Source(lambda points, q, t: 1e-4 * ufl.sin(t / 20) * q * points.dx)]},
}


@pytest.mark.parametrize("name", SCENES)
def test_what_changes_within_a_step_is_of_second_order(name):
    """A column of one metre settles by a tenth, through cells of a fifth."""

    def end(steps):
        s = column(cells=5, conditions=[*ramp(1e6, 40), OPEN], **SCENES[name])
        top = mpm.probes(s.bodies, [[0.1, 1.0]])
        return s.run(40.0, 40 / steps, probes=top, progress=False).displacement[-1][0, 1]

    runs = [end(steps) for steps in (4, 8, 16, 64)]
    errors = [abs(u - runs[-1]) for u in runs[:-1]]
    assert rates(errors).min() > 1.7 and errors[-1] < 3e-5, errors
    assert rates(errors)[-1] > 1.9 or name == "conductivity law", errors


@pytest.mark.parametrize("steps", [1, 7, 100])
def test_a_sealed_bodys_fluid_keeps_its_mass_whatever_the_steps(steps):
    """rho V of the pores is constant: (n0 + J - 1) exp(p / K_w) = n0, for water as soft as the skeleton at large
    strain.
    """
    s = column(cells=4, conditions=[*ramp(3e6, 1.0)], fluid=SOFT_WATER)
    s.run(1.0, 1 / steps, progress=False)
    J, p = s.points.J, s.points.pressure
    assert J.max() < 0.9
    assert (SOFT.porosity + J - 1) * np.exp(p / SOFT_WATER.bulk) == pytest.approx(SOFT.porosity, rel=1e-7)


def hencky_column(width, headroom=0, load=1.0, porosity=0.7, **options):
    """Return (simulation, probe at the top, c_v) of a column of 50 cells under a sudden load, divided by its modulus.

    With k = k0 J^3 / (1 - ln J) the stretch diffuses linearly, at any strain.
    """
    h, law = 1 / 50, {"conductivity": 1e-4, "conductivity_law": linear_diffusion}
    soil = mpm.Hencky(1e6 / 3, 5e5, porosity=porosity, **law)
    grid = mpm.Grid([0, 0], [width * h, 1.0 + headroom * h], [width, 50 + headroom])
    body, push = mpm.box(grid, [0, 0], [width * h, 1.0]), [mpm.Traction("top", (0, -load * soil.oedometric))]
    walls, water = {"left": "x", "right": "x", "bottom": "y"}, mpm.Fluid(bulk=np.inf)
    s = mpm.Simulation(
        grid,
        [body],
        [soil],
        fluid=water,
        walls=walls,
        conditions=[*push, OPEN],
        **options,
    )
    return s, mpm.probes([body], [[h / 2, 1.0]]), 1e-4 * soil.oedometric / 9810


@pytest.mark.parametrize("width", [1, 2])
def test_a_conductivity_law_is_taken_at_the_stages_of_the_step(width):
    """Also for adjacent cells: earlier, their differences grew in Newton's steps until the iteration failed."""
    s, top, cv = hencky_column(width)
    final = 1 - 0.5671432904097838  # ln J / J = -1 at the end
    result = s.run(0.1 / cv, 0.1 / cv / 20, probes=top, progress=False)
    late = s.run(0.5 / cv, 0.1 / cv / 4, probes=top, progress=False)
    u, T = (np.concatenate([getattr(r, name)[1:] for r in (result, late)]) for name in ("displacement", "t"))
    u, T = -u[:, 0, 1], T * cv
    error = u / (final * terzaghi_consolidation(T, 1.0, 1.0)) - 1
    assert abs(error[T > 0.0499][0]) < 1.2e-3 and np.abs(error[T > 0.0999]).max() < 1e-3
    assert result.cuts == 0 and result.balance < 1e-8 and np.ptp(np.sort(s.points.J)[: 2 * width]) < 1e-8


@pytest.mark.parametrize("dt", [1e-2, 1.5e-3, 1e-5])
@pytest.mark.parametrize("width", [2, 3])
def test_a_first_step_is_taken_however_long_it_is(width, dt):
    """From T_v = 1e-5, before any drainage. Newton's method then needs the derivative of fluxes by strains."""
    s, _, cv = hencky_column(width, headroom=5, numerics=mpm.Numerics(method="backward-euler"))
    report = s.step(dt / cv)
    assert report.newton <= 15 and np.ptp(np.sort(s.points.J)[: 2 * width]) < 1e-8


def test_a_step_that_makes_a_law_meaningless_is_shortened():
    """The first Newton step inverts the top cells, where k is not a number, and is therefore shortened."""
    s, _, cv = hencky_column(1, headroom=5, load=1.5, porosity=0.8, numerics=mpm.Numerics(method="backward-euler"))
    report = s.step(0.005 / cv)
    assert np.isinf(report.history).any() and 0.475 < s.points.J.min() < 0.6  # ln J / J = -1.5 at 0.475


def test_a_run_takes_a_step_by_backward_euler_before_it_gives_up(monkeypatch, warned):
    s, tried = loaded(100.0, cells=2, conditions=[OPEN]), []

    def step(scene, state, dt, how=()):
        tried.append((dt, len(how or scene.substeps(state.stage))))
        if tried[-1][1] == 2 and state.t < 1.0:
            raise mpm.NotConverged("no such step", [])
        return so_far(scene, state, dt, how)

    so_far = simulation.step
    monkeypatch.setattr(simulation, "step", step)
    result = s.run(3.0, 1.0, progress=False)
    assert result.t.tolist() == [0, 1, 2, 3] and result.cuts > 5 and [dt for dt, count in tried if count == 1] == [1.0]
    assert "a step of 1 s by backward Euler" in warned()[0]
    monkeypatch.setattr("mpm_dolfinx.simulation.timeloop.EULER", METHODS["sdirk2"])
    with pytest.raises(mpm.GaveUp, match=r"gave up at t = 0 s .*no such step"):
        again = loaded(100.0, cells=2, conditions=[OPEN])
        again.run(3.0, 1.0, progress=False)


def linear_diffusion(conductivity, J):
    return conductivity * J**3 / (1 - ufl.ln(J))


@pytest.mark.parametrize("dt", [0.3, 3.0, 30.0, 300.0])
def test_a_body_that_is_loaded_sealed_and_then_drained_does_not_ring(dt):
    s = loaded(100.0, cells=20)
    s.run(1.0, 1.0, progress=False)
    p0 = s.points.pressure.max()
    s.stage(conditions=[*s.conditions, mpm.Drained("top")])
    extremes = np.array(s.run(1 + 3 * dt, dt, progress=False).pressure)
    assert extremes.min() > -1e-3 * p0 and extremes.max() < p0 * (1 + 1e-3)


def test_backward_euler_is_an_option_and_of_first_order():
    def end(steps, method):
        s = column(cells=5, numerics=mpm.Numerics(method=method), conditions=[*ramp(1e4, 40), OPEN])
        s.run(40.0, 40 / steps, progress=False)
        return s.points.pressure

    true = end(128, "sdirk2")
    errors = [np.abs(end(steps, "backward-euler") - true).max() for steps in (4, 8, 16)]
    assert 0.8 < rates(errors).min() < 1.3


@pytest.mark.parametrize("method", METHODS)
def test_volumes_that_flow_out_are_the_loss_of_water(method, tmp_path):
    """A jump of the load: the outflow at the end of a step, times its length, is no volume."""

    def scene():
        numerics = mpm.Numerics(method=method)
        given = [OPEN, mpm.Inflow("bottom", 1e-3, name="well"), mpm.Traction("top", (0, -1e4))]
        return column(conditions=given, numerics=numerics, fluid=SOFT_WATER)

    s, start = scene(), scene().cells().water.sum()
    file = tmp_path / "state.npz"
    result = s.run(20, 5, checkpoint=mpm.Checkpoint(file), progress=False)
    flowed = s.outcome("flowed")
    assert flowed["well"] == pytest.approx(-1e-3 * 0.1 * 20, rel=1e-12)
    assert sum(flowed.values()) == pytest.approx(start - s.cells().water.sum(), rel=1e-9)
    assert result.outcome("flowed")["drained_top"][[0, -1]].tolist() == [0.0, flowed["drained_top"]]
    later = scene()
    later.run(30, 5, after=mpm.resume(later, file), progress=False)
    s.run(30, 5, after=s.result, progress=False)
    assert later.outcome("flowed") == s.outcome("flowed") != flowed


def test_a_term_of_the_velocity_makes_a_dry_body_creep_exactly():
    """Kelvin-Voigt: strain = q / M (1 - exp(-M t / eta)), under a constant load."""
    eta, load = 1e8, 1e3

    def damper(points, velocity, v):
        return eta * ufl.inner(ufl.sym(points.grad(velocity)), ufl.sym(points.grad(v))) * points.dx

    for options in ({"fluid": False}, {"material": replace(SOFT, conductivity=0.0)}):
        with pytest.raises(ValueError, match=r"must be left out: without flow of fluid, velocities have no error"):
            loaded(load, cells=2, terms=[damper], **options).run(20.0, rtol=1e-2)

    def error(steps):
        s = loaded(load, cells=2, fluid=False, terms=[damper])
        s.run(20.0, 20 / steps, progress=False)
        exact = load / SOFT.oedometric * (1 - np.exp(-SOFT.oedometric * 20.0 / eta))
        return np.abs((1 - s.points.J) / exact - 1).max()

    errors = [error(steps) for steps in (10, 20, 40)]
    assert rates(errors).min() > 1.9 and errors[-1] < 2e-3


# ---- steps chosen by their error -----------------------------------------------------------------

TIME = 1.0 / (SOFT.conductivity / 9810 * SOFT.oedometric)  # s: T_v = 1
DRIVEN = {
    "a load that stays": (0.05, lambda: loaded(100.0, conditions=[OPEN])),
    "a load that rises": (
        0.05,
        lambda: column(conditions=[*ramp(100.0, 2 * TIME), OPEN]),
    ),
    "a load that swings": (0.02, lambda: column(conditions=[swinging(6), OPEN])),
    "one that swings slowly": (
        0.2,
        lambda: column(conditions=[swinging(0.5), OPEN]),
    ),
    "a source": (
        0.02,
        lambda: column(
            terms=[mpm.Source(lambda points, q, t: 1e-9 * ufl.sin(8 * t / TIME) * q * points.dx)], conditions=[OPEN]
        ),
    ),
    "a drained side": (0.02, lambda: column(conditions=[mpm.Drained("top", lambda t: 100.0 * np.sin(8 * t / TIME))])),
}


def spring(points, q, t):
    return 1e-9 * ufl.sin(8 * t / TIME) * q * points.dx


def swinging(speed):
    return mpm.Traction("top", lambda t: (0, -100.0 * np.sin(speed * t / TIME)))


@pytest.mark.parametrize("name", DRIVEN)
def test_the_estimated_error_is_that_of_a_run_to_a_factor_that_is_told_whatever_drives_the_water(name):
    """Compared with steps an eighth as long: 0.7 to 5 times the estimate, see `newton.ERROR`."""
    dt, make = DRIVEN[name]
    s, fine, errors, estimates = make(), make(), [], []
    for _ in range(10):
        estimates.append(s.step(dt * TIME).error)
        for _ in range(8):
            fine.step(dt * TIME / 8)
        errors.append(np.abs(fine.scene.storage.p.x.array - s.scene.storage.p.x.array).max())
    assert 0.7 < max(errors) / max(estimates) < 5.5, (errors, estimates)


def test_output_times_are_hit_whatever_the_steps():
    times, seen = [1e-3, 0.5, 7.0, 100.0], []
    result = loaded(100.0, conditions=[OPEN]).run(
        300.0, rtol=1e-3, t_eval=times, observe=lambda s: seen.append(s.t), progress=False
    )
    assert result.t.tolist() == [0.0, *times, 300.0] == [0.0, *seen] and result.converged
    assert result.steps > 10


def test_steps_grow_over_six_decades_of_consolidation():
    """From T_v = 1e-6 to 1, in the cells, compared with steps so short that the error in time is negligible.

    Most of the error is the damping of the first steps.
    """
    cv = SOFT.conductivity / 9810 * SOFT.oedometric

    def run(rtol):
        s, p = loaded(100.0, cells=20, conditions=[OPEN]), []
        times = np.logspace(-6, 0, 7) / cv
        result = s.run(
            times[-1], rtol=rtol, t_eval=times, observe=lambda s: p.append(s.points.pressure), progress=False
        )
        return result.steps, np.array(p).reshape(-1, 2, 20, 2).mean(axis=(1, 3))

    (steps, p), (_, true) = run(8e-5), run(1e-5)
    assert steps <= 100 and np.abs(p - true).max() < 1e-3 * 100


def test_a_jump_of_the_load_within_the_run_is_found():
    """The load doubles at 7.3 s, between outputs: steps shrink towards this time, and the error meets its tolerance."""
    jump = [mpm.Traction("top", lambda t: (0, -100.0 if t < 7.3 else -200.0))]

    s, true = (column(cells=10, conditions=[*jump, OPEN]) for _ in range(2))
    result = s.run(20.0, rtol=1e-3, t_eval=[20.0], progress=False)
    for t_end, dt in ((7.3 - 1e-9, 0.4), (9.3, 0.05), (20.0, 0.2)):  # pressures within 0.002 Pa of steps of 0.02 s
        true.run(t_end, dt, progress=False)
    assert result.rejected > 3 and result.steps < 60
    assert np.abs(s.points.pressure - true.points.pressure).max() < 2e-3 * 200


def test_pressures_that_flow_away_within_a_step_do_not_hold_it_up():
    """A beam of gravel bends as without water: pressures are 1e-4 of the load. Earlier it took 1466 steps, now 23."""
    material = replace(SOFT, conductivity=1.0)
    wet, tip = beam(h=0.06, material=material)
    result = wet.run(0.3, rtol=3e-3, t_eval=[0.06], probes=tip, progress=False)
    dry, tip = beam(h=0.06, fluid=False)
    drained = dry.run(0.3, 0.02, probes=tip, progress=False)
    assert result.steps < 40 and result.displacement[-1] == pytest.approx(drained.displacement[-1], rel=2e-3)


def test_the_first_step_and_the_longest_are_what_was_asked_for():
    times = []
    s = loaded(100.0, conditions=[OPEN])
    s.run(
        50.0, rtol=mpm.Adaptive(0.1, first_step=1e-4, max_step=2.0), observe=lambda s: times.append(s.t), progress=False
    )
    steps = np.diff([0.0, *times])
    assert steps[0] == 1e-4 and steps.max() <= 2.0 * (1 + 1e-12) and times[-1] == 50.0


def test_no_step_is_longer_than_asked_at_the_end_or_where_a_run_goes_on():
    times = []
    s = loaded(100.0, conditions=[OPEN])
    options = {"rtol": 0.1, "observe": lambda s: times.append(s.t), "progress": False}
    with pytest.raises(KeyboardInterrupt):
        s.run(500.0, **options | {"observe": Stop(3)})
    assert s.state.control.small > 2.0
    times.append(s.t)
    s.run(s.t + 4.05, **options | {"rtol": mpm.Adaptive(0.1, max_step=2.0)}, after=s.result)
    assert len(times) == 4 and np.diff(times).max() <= 2.0 * (1 + 1e-9)


def test_where_nothing_flows_a_step_is_as_long_as_an_output_interval():
    s, _ = beam(fluid=False, load=54.0)
    assert s.run(0.3, 0.1, rtol=1e-3, progress=False).steps == 3


def test_a_run_with_steps_by_their_error_resumes_with_the_same_bits(tmp_path):
    file, times = tmp_path / "half.npz", np.linspace(0.02, 0.3, 8)

    def scene():
        s, _ = beam(h=0.06)
        return s

    whole = scene()
    end = whole.run(0.3, rtol=5e-3, t_eval=times, checkpoint=mpm.Checkpoint(file, every=4), progress=False)
    half = scene()
    with pytest.raises(KeyboardInterrupt):
        half.run(
            0.3, rtol=5e-3, t_eval=times, observe=Stop(4), checkpoint=mpm.Checkpoint(file, every=4), progress=False
        )
    resumed = scene()
    again = resumed.run(0.3, rtol=5e-3, t_eval=times, after=mpm.resume(resumed, file), progress=False)
    assert np.array_equal(resumed.points.corners, whole.points.corners)
    assert np.array_equal(resumed.points.pressure, whole.points.pressure)
    assert np.array_equal(again.t, end.t) and (again.steps, again.rejected) == (end.steps, end.rejected)


BAD = {
    "no step": ({}, r"dt = None, must be given, or rtol"),
    "rtol too large": ({"rtol": 1.0}, r"rtol = 1\.0, must be in \[1e-07, 1\)"),
    "rtol below the solver's": ({"rtol": 1e-9}, r"rtol = 1e-09, must be in \[1e-07, 1\)"),
    "both output rules": ({"dt": 1.0, "rtol": 1e-3, "t_eval": [1.0]}, r"dt = 1\.0, must be left out with rtol and"),
    "times that fall": ({"rtol": 1e-3, "t_eval": [2.0, 1.0]}, r"t_eval = .*must be increasing times in \(0, 4\] s"),
    "times after the end": ({"dt": 1.0, "t_eval": [2.0, 9.0]}, r"t_eval = .*must be increasing times in \(0, 4\] s"),
    "times of words": ({"dt": 1.0, "t_eval": ["a"]}, r"t_eval = "),
}


@pytest.mark.parametrize("name", BAD)
def test_steps_that_cannot_be_are_refused_in_a_line(name):
    options, message = BAD[name]
    s = column(cells=2, conditions=[OPEN])
    with pytest.raises(ValueError, match=message) as caught:
        s.run(4.0, **options, progress=False)
    assert "\n" not in str(caught.value) and s.t == 0


@pytest.mark.parametrize("limits", [{"first_step": -1.0}, {"max_step": 0.0}])
def test_steps_are_limited_by_positive_lengths(limits):
    with pytest.raises(ValueError, match=rf"{next(iter(limits))} = -?\d\.0, must be > 0"):
        mpm.Adaptive(1e-3, **limits)


def test_a_method_that_has_no_error_cannot_choose_its_steps():
    s = column(cells=2, numerics=mpm.Numerics(method="backward-euler"), conditions=[OPEN])
    with pytest.raises(ValueError, match=r"method backward-euler has no error estimate, the method must be sdirk2"):
        s.run(4.0, rtol=1e-3, progress=False)
    with pytest.raises(ValueError, match=r"method 'rk4': must be one of sdirk2, backward-euler"):
        column(cells=2, numerics=mpm.Numerics(method="rk4"))


class Stop:
    """Interrupts a run after a number of outputs."""

    def __init__(self, count):
        self.count = count

    def __call__(self, simulation):
        if len(simulation.result.rows) - 1 > self.count:
            raise KeyboardInterrupt


def driven(fails: Callable[[int, float], bool], intervals: int) -> tuple[int, StepControl, list[float]]:
    """Return cuts, memory and lengths of equal steps; `fails` selects failing steps by interval and length."""
    rule, control, cuts, taken = StepSize(1.0, 1.0), StepControl(small=1.0), 0, []
    for interval in range(intervals):
        left = 1.0
        while left > 1e-9:
            length = rule.fitted(left, control.small)
            if fails(interval, length):
                control, cuts = rule.cut(length, control), cuts + 1
            else:
                taken.append(length)
                control = rule.grown(length, Report(), control, failed=False)
                left -= length
    return cuts, control, taken


def test_a_step_that_fails_once_is_cut_and_grows_at_once():
    cuts, control, taken = driven(lambda k, length: k == 3 and length == 1.0, 6)
    assert cuts == 1 and taken == [1, 1, 1, 0.5, 0.5, 1, 1] and control.waits == 0


def test_steps_whose_growth_fails_again_and_again_wait_longer_and_longer():
    cuts, _, taken = driven(lambda k, length: length > 0.3, 100)
    assert cuts <= 12 and len(taken) == 400
    *_, only_at_first = driven(lambda k, length: k < 20 and length > 0.3, 100)
    assert only_at_first[-50:] == [1.0] * 50, "and grow back"


def test_what_is_as_sudden_in_every_step_is_no_jump_of_the_loads():
    rule, found = StepSize(1.0, 1.0), StepControl(change=[100.0])
    report = Report(first=np.array([10.0]), sudden=np.array([10.0]))
    assert rule.refused(1.0, report, found, 1.0) == 0.5
    assert rule.next(0.5, report, replace(found, small=0.5), False) == 0.5
    again = replace(found, first=[10.0], small=0.5)  # Pa/s, in the step before
    assert rule.refused(1.0, report, again, 1.0) == 1.0
    assert rule.next(0.5, replace(report, sudden=np.array([5.0])), again, False) == 1.0
    assert rule.refused(1.0, replace(report, sudden=np.array([21.0])), again, 1.0) == 0.5
