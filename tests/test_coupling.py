# SPDX-License-Identifier: MIT
"""Coupling: schemes agree, steps are cut and grow, and a run that gives up explains why and keeps its state."""

from dataclasses import replace

import coupling_iterations as demo
import numpy as np
import pytest
from helpers import SOFT, beam, limit, set_up

import mpm_dolfinx as mpm
from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.flow.storage import FILTER


@pytest.fixture(scope="module")
def tip():
    s, probe = beam()
    return s.run(0.08, 0.02, probes=probe).displacement[-1]


@pytest.mark.parametrize("coupling", ["schur-fgmres", "fixed-stress", "fixed-stress-full"])
def test_all_couplings_give_the_same_answer(tip, coupling):
    s, probe = beam(numerics=mpm.Numerics(coupling=coupling))
    result = s.run(0.08, 0.02, probes=probe)
    assert result.displacement[-1] == pytest.approx(tip, rel=1e-6)
    assert result.residual <= 1e-8 and result.cuts == 0


def test_the_krylov_scheme_needs_few_iterations(tip):
    s, _ = beam()
    result = s.run(0.08, 0.02)
    assert result.coupling <= 6 * result.newton and result.newton <= 5 * 2 * result.steps


def test_the_fluid_s_compressibility_as_beta_diverges_and_says_so():
    s, _ = beam(numerics=mpm.Numerics(coupling="fixed-stress-fluid"))
    before = s.points
    with pytest.raises(mpm.GaveUp, match=r"gave up at t = 0 s with dt = .* diverges \(beta is below") as caught:
        s.run(0.08, 0.02)
    assert len(caught.value.history) > 2 and caught.value.result.t.tolist() == [0.0]
    assert (s.points.corners == before.corners).all() and s.t == 0, "the last good state is lost"


@pytest.mark.parametrize(("newton", "steps"), [(8, [0.5, 0.5, 1, 1]), (9, [0.5] * 6)])
def test_a_step_that_has_been_cut_grows_again_once_it_is_easy(newton, steps, monkeypatch):
    s, _ = beam(h=0.06)
    taken = []

    def step(scene, state, dt):
        if not taken and dt > 0.6:
            raise mpm.NotConverged("too long", [])
        taken.append(dt)
        return replace(state, t=state.t + dt), Report(newton=newton, history=[(0.0, 0.0)], easy=3 * newton <= 25)

    monkeypatch.setattr("mpm_dolfinx.simulation.simulation.step", step)
    result = s.run(3.0, 1.0, progress=False)
    assert result.cuts == 1 and taken == steps


def test_a_step_that_does_not_converge_is_cut_and_grows_again():
    s, probe = beam(fluid=False, ramp=1.0)
    limit(s, 5)
    result = s.run(3.0, 1.0, probes=probe)
    whole, _ = beam(fluid=False, ramp=1.0)
    reference = whole.run(1.0, 0.1, probes=probe).displacement[-1]
    assert result.converged and result.cuts > 0
    assert 3 < result.steps < 30 and result.t.tolist() == [0, 1, 2, 3]
    assert result.displacement[-1] == pytest.approx(reference, rel=2e-3)


def test_the_state_of_the_last_good_step_goes_on_after_giving_up():
    s, probe = beam()
    s.run(0.04, 0.02)
    limit(s, 0)
    with pytest.raises(mpm.GaveUp, match=r"at t = 0.04 s .*no convergence in 0 iterations"):
        s.run(0.08, 0.02)
    limit(s, 25)
    resumed = s.run(0.08, 0.02, probes=probe).displacement[-1]
    whole, _ = beam()
    assert (resumed == whole.run(0.08, 0.02, probes=probe).displacement[-1]).all()


def test_without_a_fluid_there_is_no_storage_problem():
    s, _ = beam(fluid=False)
    assert s.scene.storage is None
    assert np.isfinite(s.run(0.04, 0.02).wall)


OWN = ("Schur-CG",)


@pytest.mark.parametrize("scene", demo.SCENES)
def test_a_linear_solve_takes_few_iterations_from_drained_to_undrained_whatever_the_cell_size(scene):
    """To 1e-8, from k = 1e-14 m/s and dt = 1e-9 s to k = 1e2 m/s and dt = 1e9 s, with water from 1e4 Pa to
    incompressible.
    """
    most = [demo.worst(demo.scan(scene, h, schemes=OWN)) for h in (0.06, 0.03)]
    assert max(most) <= 14 and np.ptp(most) <= 1


def test_only_the_product_of_conductivity_and_step_matters():
    counts = []
    for k_dt in (1e-8, 1e-6):
        for conductivity in (1e-14, 1e-8, 1e2):
            s, _ = beam(material=replace(SOFT, conductivity=conductivity))
            counts.append(demo.count(demo.linearise(s, k_dt / conductivity), "Schur-CG")[0])
    assert len(set(counts[:3])) == len(set(counts[3:])) == 1 and counts[0] > counts[3]


def test_the_plain_fixed_stress_iteration_needs_more_and_the_fluid_s_compressibility_as_beta_diverges():
    own, plain, fluid = (
        demo.worst(demo.scan("beam", 0.06, bulks=[2.2e9], k_dt=[-23, -8, -6], schemes=[scheme]))
        for scheme in ("Schur-CG", "fixed stress, 3/4", "fixed stress, 1/K_w")
    )
    assert own < plain / 2 < np.inf and fluid == np.inf


def test_the_filter_takes_at_most_what_the_fixed_stress_operator_has():
    """0 <= L <= beta V, also in almost empty cells: the preconditioner is positive definite."""
    s, _ = beam(offset=0.01)
    balances = set_up(s, 0.02)
    storage, contents = balances.matrices.storage, balances.start.on_grid.contents
    L, V = storage.L, contents.fixed_stress
    assert V.min() < 0.02 * V.max(), "no cell is hardly filled"
    x, y = L.createVecs()
    index = s.grid.index_from_base(s.grid.midpoints[storage.unknowns.owned])
    for values in (np.random.default_rng(0).normal(size=x.size), (-1.0) ** index.sum(axis=1), np.ones(x.size)):
        x.array_w[:] = values
        L.mult(x, y)
        share = (x.array @ y.array) / (values @ (V * values))
        assert -1e-12 <= share <= 1 + 1e-12
        checkers = (values == (-1.0) ** index.sum(axis=1)).all()
        assert share > 0.85 if checkers else share < 0.6
    assert 0 < FILTER < 1


def test_the_undrained_pressure_has_no_checkers():
    rough = {
        (h, name): demo.roughness(demo.cells(demo.undrained(h, law)[0]))
        for h in (0.06, 0.03)
        for name, law in demo.LAWS.items()
    }
    for h in (0.06, 0.03):
        assert rough[h, "damped"] < 0.5 * rough[h, "undamped"]
    assert rough[0.03, "damped"] < 0.006
    assert rough[0.03, "damped"] < 0.35 * rough[0.06, "damped"], "what is left is not the curvature of the pressure"


def slender(thrust, side_load):
    """Return a cantilever of 1 m x 0.1 m under a multiple of its buckling load, and a probe at its tip."""
    grid = mpm.Grid([0, 0], [1.2, 1.6], [48, 64])
    body = mpm.box(grid, [0, 1.2], [1, 1.3])
    critical = np.pi**2 * 1e7 * 0.1**2 / 12 / 4  # Pa
    press = mpm.Traction("right", lambda t: (-thrust * critical * t, 0))
    push = mpm.Traction("top", lambda t: (0, -side_load * t))
    s = mpm.Simulation(grid, [body], [SOFT], walls={"left": "xy"}, conditions=[press, push])
    return s, mpm.probes([body], [[1, 1.25]])


def test_a_slender_body_pressed_at_once_beyond_its_buckling_load_buckles():
    tips = []
    for dt in (1.0, 0.05):
        s, probe = slender(1.6, 200.0)
        result = s.run(1.0, dt, probes=probe)
        tips.append(result.displacement[-1][0])
        assert (result.cuts > 0) == (dt == 1.0), "the straight equilibrium is unstable and must be refused"
    assert tips[1][1] < -0.6 and tips[0] == pytest.approx(tips[1], abs=0.05)


def test_a_body_that_nothing_disturbs_has_no_stable_equilibrium_beyond_its_buckling_load():
    s, _ = slender(1.6, 0.0)
    with pytest.raises(mpm.GaveUp, match="the equilibrium is unstable, its tangent has 1 negative eigenvalue"):
        s.run(1.0, 0.05)
    assert 0.6 < s.t < 0.7  # it stood up to its buckling load, at 1 / 1.6
