# SPDX-License-Identifier: MIT
"""The poroelastic beam against body-fitted Taylor-Hood finite elements with the same time step."""

import numpy as np
import poroelastic_beam as demo
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM


def run(arguments="", cells=(40, 12), probe=((1.0, 0.15),)):
    """Return the results of material points and of finite elements for the scene of the demo."""
    o = demo.arguments(arguments.split())
    simulation, bottom = demo.scene(o)
    result = simulation.run(o.t_end, o.dt, probes=mpm.probes(simulation.bodies, np.add(probe, [0, bottom])))
    fem = BiotFEM(mpm.Grid([0, 0], [demo.LENGTH, demo.HEIGHT], cells), demo.material(o), **demo.physics(o))
    return result, fem.run(o.t_end, o.dt, probes=probe)


@pytest.fixture(scope="module")
def beam():
    return run()


def error(result, fem):
    u, exact = (np.array(r.displacement)[1:, 0, 1] for r in (result, fem))
    return np.abs(u / exact - 1)


def off(result):
    """Return the errors of the tip at demo.TIMES, compared with finite elements that are converged in time."""
    found = {round(t, 9): u[0, 1] for t, u in zip(result.t, result.displacement, strict=True)}
    return np.abs([found[t] / u - 1 for t, u in zip(demo.TIMES, demo.TRUTH, strict=True)])


def test_the_tip_is_exact_in_space_and_time(beam):
    errors = off(beam[0])
    # before it drains the tip is off by the cells' own error, 0.19 % in ever smaller steps
    assert errors[0] < 1e-2 and errors[2] < 2.7e-3 and errors[3:].max() < 5e-4, errors


def test_the_tip_is_as_exact_in_half_the_steps_if_their_error_chooses_them():
    o = demo.arguments(["--rtol", "6e-3"])
    simulation, bottom = demo.scene(o)
    probe = mpm.probes(simulation.bodies, [[1.0, bottom + 0.15]])
    result = simulation.run(o.t_end, **demo.output_times(o), probes=probe)
    assert off(result)[3:].max() < 1e-3 and result.steps <= 30, (off(result), result.steps)


@pytest.mark.slow
def test_the_tip_after_the_ramp_is_of_second_order_in_the_step():
    """Differences of three runs under the full load; the tip moves through fifteen cells."""

    def tip(dt):
        o = demo.arguments(f"--ramp 0.08 --t-end 0.24 --dt {dt}".split())
        simulation, bottom = demo.scene(o)
        probe = mpm.probes(simulation.bodies, [[1.0, bottom + 0.15]])
        return simulation.run(o.t_end, o.dt, probes=probe).displacement[-1][0, 1]

    tips = [tip(dt) for dt in (0.04, 0.02, 0.01)]
    first, second = np.abs(np.diff(tips))
    assert np.log2(first / second) > 1.9 and second < 2e-4 * abs(tips[-1]), tips


def test_the_pressure_extremes_follow_the_finite_elements(beam):
    p, exact = (np.array(r.pressure)[1:] for r in beam)
    largest = np.maximum.accumulate(np.abs(exact).max(axis=1))
    assert (np.abs(p - exact).max(axis=1) < 0.05 * largest).all()
    for k in (9, 59):  # 0.2 s and 1.2 s
        assert np.abs(p[k] - exact[k]).max() < 0.05 * np.abs(exact[k]).max()


def test_fluid_balance_and_residuals_close_in_every_step(beam):
    assert beam[0].balance <= 1e-8 and beam[0].residual <= 1e-8 and beam[0].cuts == 0


def test_the_tip_is_the_same_on_all_releases(beam):
    """The reference was recorded with dolfinx 0.5.2."""
    tip = np.array(beam[0].displacement)[:, 0]
    assert tip[3] == pytest.approx([-0.024834357, -0.230016549], rel=1e-6)
    assert tip[60] == pytest.approx([-0.063750014, -0.348521414], rel=1e-6)


@pytest.mark.parametrize("extra", ["", "--bulk 8.3333e6 --shear 3.84615e6"], ids=["nu 0", "nu 0.3"])
def test_the_drained_tip_is_that_of_the_finite_elements(extra):
    result, fem = run(f"--drained --ramp 1 --t-end 1 --dt 0.1 {extra}")
    assert error(result, fem)[-1] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("load", ["54e3", "162e3"])
def test_the_drained_tip_holds_for_hundreds_of_steps(load, monkeypatch):
    monkeypatch.setattr(demo, "BOX", np.array([1.5, 2.4]))
    o = demo.arguments(f"--drained --ramp 1 --t-end 1 --dt 0.05 --load {load}".split())
    simulation, bottom = demo.scene(o)
    probe = mpm.probes(simulation.bodies, [[1.0, bottom + 0.15]])
    tips = np.array(simulation.run(16.0, o.dt, probes=probe).displacement)[20:, 0, 1]
    fem = BiotFEM(mpm.Grid([0, 0], [1, 0.3], demo.REFERENCE_CELLS), demo.material(o), **demo.physics(o))
    exact = fem.run(1.0, o.dt, probes=[[1.0, 0.15]]).displacement[-1][0, 1]
    assert np.abs(tips / exact - 1).max() < 1e-3


def test_the_undrained_tip_is_that_of_sealed_finite_elements_and_does_not_creep():
    o = demo.arguments("--conductivity 1e-12 --t-end 0.3".split())
    simulation, bottom = demo.scene(o)
    result = simulation.run(o.t_end, o.dt, probes=mpm.probes(simulation.bodies, [[1.0, bottom + 0.15]]))
    sealed = demo.physics(o)
    sealed["conditions"] = sealed["conditions"][:1]
    fem = BiotFEM(mpm.Grid([0, 0], [1, 0.3], (40, 12)), demo.material(o), **sealed)
    exact = fem.run(0.06, o.dt, probes=[[1.0, 0.15]]).displacement[-1][0, 1]
    tips = np.array(result.displacement)[3:, 0, 1]
    assert tips[0] == pytest.approx(exact, rel=6e-3)
    assert np.ptp(tips) < 5e-3 * abs(tips[0])
    assert result.balance <= 1e-8 and result.coupling < 9 * result.newton and result.newton < 8 * result.steps
