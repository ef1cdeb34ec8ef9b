# SPDX-License-Identifier: MIT
"""Newton's iterations in yielding soil: lengths of their steps, and their start from the last motion."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import line_search as search
from mpm_dolfinx.solve import newton
from mpm_dolfinx.solve.line_search import EXPLODES, SHORTEST, WORK, Halving, Search
from mpm_dolfinx.solve.schur import LinearSolvers
from mpm_dolfinx.stepping import balances


def test_a_step_of_what_does_not_yield_is_halved_where_the_residual_explodes_or_is_not_finite():
    assert Halving().after(np.nan, 0.9 * EXPLODES) is None
    assert Halving().after(np.nan, np.inf).step == Halving().after(np.nan, 2 * EXPLODES).step == 0.5
    assert Halving(1.5 * SHORTEST).after(np.nan, np.inf) is None


def pushed(dim: int = 2) -> mpm.Simulation:
    """Return soft ground; a prescribed displacement pushes half of its top beyond the limit load."""
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
    """In a steady flow the start is exact. From the end of the first substep, the residual would be large."""
    goes_on, so_far = steps_taken(monkeypatch, 2.0), balances.going_on
    monkeypatch.setattr(balances, "going_on", lambda *at: None if at[2].substep.before > 0 else so_far(*at))
    assert goes_on < steps_taken(monkeypatch, 2.0)


def test_a_direction_that_leads_backwards_is_turned_round(monkeypatch):
    """Tangents with negative stiffness give such directions. Their reversal in the linear solver changes no bit."""
    s = pushed()
    s.run(2, 1)
    before, forwards = s.state, s.step(1.0)
    there, solve = s.state, LinearSolvers.solve

    def backwards(solvers: LinearSolvers, *how, **goals) -> int:
        count = solve(solvers, *how, **goals)
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
    assert inner.sum() > 8 and m.elastic_shear.getDiagonal().array_r[inner] == pytest.approx(exact)
    crossed = x[:, [1, 0, *range(2, dim)]] * [1, 1, *[0] * (dim - 2)]
    for field in (crossed * ([-1, 1, 0][:dim]), crossed, np.ones_like(x)):  # uniform stress: no force inside
        forces = m.elastic_shear * m.unknowns.gather_owned(field[np.arange(len(at)), axis])
        assert np.abs(forces.array_r[inner]).max() < 1e-9 * 1e6


def test_a_step_that_goes_too_far_is_shortened_to_where_the_residuals_do_no_work():
    for end in (0.01, 0.1, 0.4):  # where the work is zero, linear in the step
        found = Search().after(1 - 1 / end, 2.0)
        assert found.step == pytest.approx(end) and found.after(0.4, 2.0) is None
    assert Search().after(WORK, 2.0) is None and Search().after(-0.9, 0.9) is None  # full steps
    assert Search().after(np.nan, np.inf).step == 0.5


@given(end=st.floats(0.002, 0.9), before=st.floats(0.0, 2.0), behind=st.floats(1.0, 1e6))
def test_a_step_ends_with_little_work_also_where_the_work_has_a_kink(end, before, behind):
    """The work decreases slowly and then fast, as where points yield."""
    search, tried = Search(), 0
    while search is not None:
        step, tried = search.step, tried + 1
        work = 1 - before * min(step, end) - behind * max(0, step - end)
        search = search.after(work, 2.0)
    assert abs(work) <= WORK or abs(step - end) <= SHORTEST or work > 0
    assert tried <= 2 + 2 * np.log2(1 / SHORTEST)


def steps_taken(monkeypatch, dt: float, **values) -> int:
    """Return the Newton steps in three steps dt of pushed ground, with other constants of the search."""
    with monkeypatch.context() as patched:
        for name, value in values.items():
            patched.setattr(newton if name == "SHIFT" else search, name, value)
        s = pushed()
        return sum(s.step(dt).newton for _ in range(3))


def test_a_step_is_full_where_the_forces_balance_and_the_fluid_does_not():
    """The work of both residuals counts. The work of the forces, almost zero at first, would shorten the steps."""
    grid = mpm.Grid([0, 0], [0.3, 0.8], [3, 8])
    soil = mpm.DruckerPrager(
        bulk=2e7, shear=1e7, friction=30.0, dilation=0.0, cohesion=2e4, porosity=0.6, conductivity=1e-5
    )
    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [0.3, 0.63])],
        [soil],
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[mpm.Traction("top", (0.0, -300.0)), mpm.Drained("top")],
        fluid=mpm.Fluid(bulk=1e8),
    )
    assert s.step(0.5).newton <= 6  # none within 25


def test_steps_to_where_forces_do_no_work_save_newton_steps(monkeypatch):
    searched, full = (sum(steps_taken(monkeypatch, dt, **work) for dt in (1.0, 1.5)) for work in ({}, {"WORK": 1e300}))
    assert searched < 0.8 * full and searched < 110


def test_the_tangent_has_the_fluxes_derivative_by_displacements_only_where_the_storage_is_farther_out(monkeypatch):
    taken, direction = [], newton.Newton._direction

    def noted(self: newton.Newton, errors: newton.Errors, slow: bool) -> int:
        taken.append((slow, errors.p.max() > errors.u.max()))
        return direction(self, errors, slow)

    monkeypatch.setattr(newton.Newton, "_direction", noted)
    s = pushed()
    assert sum(s.step(2.0).newton for _ in range(3)) == len(taken)
    assert (True, True) in taken and (True, False) not in taken


def test_firmer_tangents_save_newton_steps_where_soil_yields_for_the_first_time(monkeypatch):
    # single steps differ by a factor of two with the last digits of the linear solvers (38 or 67), sums do not
    steps = (2.0, 2.5, 3.0, 3.5, 4.0, 5.0)
    firm = sum(pushed().step(dt).newton for dt in steps)
    monkeypatch.setattr(newton, "SHIFT", 0.0)
    assert firm < 0.9 * sum(pushed().step(dt).newton for dt in steps)


def test_a_firmer_tangent_leads_to_the_same_equilibrium(monkeypatch):
    found = []
    for firm in (1.0, 0.0):
        monkeypatch.setattr(newton, "SHIFT", firm)
        s = pushed()
        for _ in range(3):
            s.step(0.25)
        found.append(s.points)
    assert found[0].x == pytest.approx(found[1].x, abs=1e-9)
    assert found[0].pressure == pytest.approx(found[1].pressure, abs=1e-5 * np.abs(found[1].pressure).max())
