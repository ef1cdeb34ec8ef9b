# SPDX-License-Identifier: MIT
"""Newton's iterations where soil yields: they may stray for a while, are called back, and go on as in the last step."""

from dataclasses import replace

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import watchdog
from mpm_dolfinx.solve.schur import LinearSolvers
from mpm_dolfinx.solve.watchdog import PATIENCE, WORK, Search, Watchdog, shortened
from mpm_dolfinx.stepping import balances


def test_the_residual_may_grow_for_some_full_steps_and_descends_after_them():
    where = [np.zeros(1)]
    dog = Watchdog(1.0, where)
    for count in range(PATIENCE):
        assert not dog.strays(2.0) and dog.limit(2.0) == np.inf
        dog = dog.after(2.0 + count, 1.0, list)
    assert dog.strays(2.0) and dog.where is where
    down = replace(dog, since=0, descends=True)
    assert down.limit(1.0) == 1.0 and not down.strays(np.inf)
    again = down.after(0.5, 1.0, list)
    assert again.least == 0.5 and again.where == [] and not again.since and not again.descends  # full steps again


@pytest.mark.parametrize("residual", [1e5, np.inf])
def test_iterations_that_run_away_are_called_back_at_once(residual):
    assert Watchdog(1.0, []).strays(residual)
    assert Watchdog(np.inf, []).strays(np.inf) and not Watchdog(np.inf, []).strays(1e9)


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_a_step_is_shortened_to_where_a_parabola_of_the_squared_residual_is_least(share):
    curvature = 1 / share  # r^2 = 1 - 2 s + curvature s^2
    assert shortened(np.sqrt(1 - 2 + curvature), 1.0) == pytest.approx(share)
    assert shortened(np.inf, 1.0) == 0.5 and shortened(1e9, 1.0) == 0.1 and shortened(1.0, 1.0) == 0.5


def pushed(dim: int = 2) -> mpm.Simulation:
    """Return soft ground, of which a given displacement pushes half of the top, beyond its limit load."""
    n, free = 6, [np.inf] * (dim - 1)
    grid = mpm.Grid([0] * dim, [1.0] * (dim - 1) + [1.25], [n] * (dim - 1) + [n + 2])
    soil = mpm.DruckerPrager(bulk=2e6, shear=1e6, friction=20.0, dilation=0.0, cohesion=1e4, conductivity=1e-7)
    push = [0.0] * (dim - 1) + [-0.02]
    region = ([-np.inf] * dim, [0.45, *free])
    footing = mpm.Displacement("top", lambda t, X: np.multiply(t, push), region=region)
    walls = {"left": "x", "right": "x", "bottom": "xyz"[:dim]} | ({"front": "y", "back": "y"} if dim == 3 else {})
    body = mpm.box(grid, [0] * dim, [1] * dim)
    drained = mpm.Drained("top", region=([0.5, *[-np.inf] * (dim - 1)], [np.inf] * dim))
    bodies = {"conditions": [footing, drained], "fluid": mpm.Fluid()}
    return mpm.Simulation(grid, [body], [soil], walls=walls, **bodies)


def test_a_step_goes_on_as_the_last_one_where_soil_flows():
    s = pushed()
    s.run(3, 1)
    before = s.state
    goes_on = s.step(1.0)
    s.state = replace(before, velocity=None)
    at_rest = s.step(1.0)
    assert goes_on.newton < at_rest.newton
    # the second entry is where the iterations begin: less out of balance than a tenth of where they would at rest
    assert goes_on.history[1][0] < 0.1 * at_rest.history[0][0]


def test_the_second_substep_begins_as_the_first_went_on_where_soil_flows(monkeypatch):
    """Exactly so in a steady flow; at the end of the first substep it would begin far out of balance."""
    s = pushed()
    s.run(3, 1)
    before, goes_on = s.state, s.step(1.0)
    s.state, so_far = before, balances.going_on
    monkeypatch.setattr(balances, "going_on", lambda *at: None if at[2].before > 0 else so_far(*at))
    assert goes_on.newton < s.step(1.0).newton


def test_a_direction_that_leads_backwards_is_turned_round(monkeypatch):
    """As those of tangents with less than no stiffness; turned by the linear solver they change no bit."""
    s = pushed()
    s.run(2, 1)
    before, forwards = s.state, s.step(1.0)
    there, solve = s.state, LinearSolvers.solve

    def backwards(solvers: LinearSolvers, *how) -> int:
        count = solve(solvers, *how)
        solvers.turn_round()
        return count

    s.state = before
    monkeypatch.setattr(LinearSolvers, "solve", backwards)
    assert s.step(1.0).history == forwards.history and np.array_equal(s.points.x, there.points.x)


def test_a_run_resumed_where_soil_flows_ends_with_the_same_bits(tmp_path):
    whole, part = pushed(), pushed()
    whole.run(4, 1)
    part.run(2, 1, checkpoint=mpm.Checkpoint(tmp_path / "run.ckpt"))
    new = pushed()
    after = mpm.resume(new, tmp_path / "run.ckpt")
    assert np.array_equal(new.state.velocity, part.state.velocity)
    new.run(4, 1, after=after)
    assert np.array_equal(new.points.x, whole.points.x) and np.array_equal(new.points.pressure, whole.points.pressure)


def test_bodies_that_do_not_yield_remember_no_velocities():
    grid = mpm.Grid([0, 0], [1.0, 1.0], [4, 4])
    body, load = mpm.box(grid, [0, 0], [0.5, 0.5]), mpm.Traction("top", (0, -1e3))
    s = mpm.Simulation(grid, [body], [mpm.Hencky(bulk=1e6, shear=1e6)], walls={"bottom": "xy"}, conditions=[load])
    s.step(1.0)
    assert s.state.velocity is None


@pytest.mark.parametrize("dim", [2, 3])
def test_firmness_resists_shear_as_elastic_soil_does_and_neither_turns_nor_shifts(dim):
    """The entries of inner nodes of full cells are exact."""
    s = pushed(dim)
    s.step(1.0)
    m = s.scene.last[1].momentum
    at, axis = m.unknowns.nodes
    x = s.scene.grid.node_x[at]
    inner = (np.abs(x[:, :-1] - 0.5) < 0.3).all(axis=1) & (x[:, -1] > 0.2) & (x[:, -1] < 0.6)
    h = s.scene.grid.h
    slopes = np.prod(2 * h / 3) * 3 / h**2  # squared, of a node's shape function, integrated
    exact = 1e6 * (slopes + slopes.sum())[axis[inner]]
    assert inner.sum() > 8 and m.firm.getDiagonal().array_r[inner] == pytest.approx(exact)
    crossed = x[:, [1, 0, *range(2, dim)]] * [1, 1, *[0] * (dim - 2)]
    for field in (crossed * ([-1, 1, 0][:dim]), crossed, np.ones_like(x)):  # uniform stress: no force inside
        forces = m.firm * m.unknowns.gather_owned(field[np.arange(len(at)), axis])
        assert np.abs(forces.array_r[inner]).max() < 1e-9 * 1e6


def test_a_step_that_goes_too_far_is_shortened_to_where_the_forces_do_no_work():
    for end in (0.01, 0.1, 0.5):  # where the work is zero, then it grows steeply
        search, work = Search(), np.inf
        while search is not None:
            step = search.step
            work = 1 - step / end if step < end else -10 * (step / end - 1)
            search = search.after(work)
        assert abs(work) <= WORK and step <= 1.1 * end
    assert Search().after(0.5) is None and Search().after(1.5) is None  # full steps
    assert Search().after(np.nan).step == Search().after(100.0).step == 0.2


def test_a_shortened_step_goes_on_to_where_the_work_turns_though_the_residual_falls_before():
    """Else points that it would unload stay on their yield surface, and the next steps are as short."""
    full = Search()
    assert full.after(0.9, falls=True) is None and full.after(-1.5, falls=True) is None
    short = full.after(-85.0, falls=False)
    assert 0.1 <= short.step < 0.2
    longer = short.after(0.9, falls=True)
    assert short.step < longer.step < 1.0


def test_tangents_become_firmer_after_steps_that_are_next_to_nothing_and_soft_again_after_full_ones():
    dog = Watchdog(0.01, [])
    usual = dog.firmness(0.01)
    firm = dog.after(0.02, 0.02, list)
    assert firm.firmness(0.01) == pytest.approx(10 * usual)
    assert firm.after(0.02, 0.5, list).firm == firm.firm  # neither short nor long
    assert firm.after(0.02, 1.0, list).firm == firm.firm  # not below the least: the next would be short again
    soft = firm.after(0.009, 1.0, list)
    assert soft.firmness(0.01) == usual == soft.after(0.008, 1.0, list).firmness(0.01)


def test_tangents_of_soil_that_has_not_yielded_stay_as_they_are_while_each_step_gains_much():
    dog = Watchdog(1.0, [], eases=True)
    assert dog.firmness(1.0) == 0.0 == dog.after(0.05, 1.0, list).firmness(0.05)
    firm = dog.after(0.5, 1.0, list)
    assert firm.firmness(0.5) > 0 and firm.after(1e-3, 1.0, list).firmness(1e-3) > 0  # from then on
    assert Watchdog(1.0, []).after(0.05, 1.0, list).firmness(0.05) > 0


def test_iterations_converge_while_the_least_residual_falls():
    dog, steady = Watchdog(1.0, []), Watchdog(1.0, [])
    for k in range(12):
        dog, steady = dog.after(0.7**k, 1.0, list), steady.after(0.8**k, 1.0, list)
    assert dog.converges and not steady.converges


def steps_taken(monkeypatch, dt: float, **values) -> int:
    """Return the Newton steps of three steps of dt of pushed ground with other constants of the watchdog."""
    with monkeypatch.context() as patched:
        for name, value in values.items():
            patched.setattr(watchdog, name, value)
        s = pushed()
        return sum(s.step(dt).newton for _ in range(3))


def test_steps_to_where_forces_do_no_work_save_newton_steps(monkeypatch):
    searched, full = (sum(steps_taken(monkeypatch, dt, **tries) for dt in (1.0, 1.5)) for tries in ({}, {"TRIES": 1}))
    assert searched < 0.8 * full and searched < 110


def test_long_time_steps_fail_without_these_and_firm_tangents(monkeypatch):
    with pytest.raises(mpm.NotConverged):
        steps_taken(monkeypatch, 1.0, TRIES=1, FIRM=0.0)


def test_steps_in_which_soil_yields_for_the_first_time_take_fewer_newton_steps_with_firmer_tangents(monkeypatch):
    firm = sum(pushed().step(dt).newton for dt in (2.0, 3.0))
    monkeypatch.setattr(watchdog, "FIRM", 0.0)
    assert firm < 0.85 * sum(pushed().step(dt).newton for dt in (2.0, 3.0))


def test_a_firmer_tangent_leads_to_the_same_equilibrium(monkeypatch):
    found = []
    for firm in (1.0, 0.0):
        monkeypatch.setattr(watchdog, "FIRM", firm)
        s = pushed()
        for _ in range(3):
            s.step(0.25)
        found.append(s.points)
    assert found[0].x == pytest.approx(found[1].x, abs=1e-9)
    assert found[0].pressure == pytest.approx(found[1].pressure, abs=1e-5 * np.abs(found[1].pressure).max())
