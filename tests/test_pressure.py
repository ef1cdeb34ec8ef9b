# SPDX-License-Identifier: MIT
"""Pressures that follow the surface: uniform stress, no buckling under water, consistent tangent, finite elements."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from helpers import SOFT, column, set_up, without

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import schur
from mpm_dolfinx.solve.solver_choice import plan
from mpm_dolfinx.stepping.step import step
from mpm_dolfinx.verification.biot_fem import BiotFEM

ALL = {2: ("left", "right", "bottom", "top"), 3: ("left", "right", "bottom", "top", "front", "back")}


def around(value, *sides, **options):
    return [mpm.Pressure(side, value, **options) for side in sides]


def hardly_held(points, u):
    """Return the energy of weak springs that hold a floating body in place."""
    U = points.displacement + points.value(u)
    return 1e-3 * ufl.inner(U, U) / ufl.det(points.F) * points.dx


@pytest.mark.parametrize("turn, offset", [(0.0, 0.0), (0.3, 0.0), (1.0, 0.0511), (2.5, 0.03)])
def test_a_floating_block_has_uniform_stress_at_any_turn_and_offset(turn, offset):
    """Under 3 MPa the edges are a fifth shorter. Pressures act on the present area."""
    grid = mpm.Grid([0, 0], [1.2, 1.2], [12, 12])
    c, s = np.cos(turn), np.sin(turn)
    block = mpm.mapped(
        grid,
        mpm.box(grid, [0.3, 0.3], [0.8, 0.8]),
        lambda X: (X - 0.55) @ np.array([[c, s], [-s, c]]) + 0.55 + offset,
    )
    value = lambda t: 3e6 * t  # noqa: E731 - one function for all sides: they close
    accurate = mpm.Numerics(tolerance=1e-10)
    held = {"walls": {}, "terms": [hardly_held], "conditions": around(value, *ALL[2])}
    simulation = mpm.Simulation(grid, [block], [SOFT], numerics=accurate, **held)
    simulation.run(1.0, 0.25)
    assert np.abs(simulation.effective_stress() + 3e6 * np.eye(2)).max() < 1e-9 * 3e6
    assert simulation.points.J.max() < 0.67 and simulation.state.stage.symmetric


@pytest.mark.parametrize("top", [0.6, 0.7, 0.6371])
def test_a_block_between_walls_has_uniform_stress_in_3d(top):
    grid = mpm.Grid([0] * 3, [1.2] * 3, [6] * 3)
    walls = {"left": "x", "front": "y", "bottom": "z"}
    load = around(3e6, "right", "back", "top")
    s = mpm.Simulation(grid, [mpm.box(grid, [0] * 3, [top] * 3)], [SOFT], walls=walls, conditions=load)
    s.run(1.0, 1.0)
    assert np.abs(s.effective_stress() + 3e6 * np.eye(3)).max() < 1e-7 * 3e6
    assert s.state.stage.symmetric


def test_a_block_turned_in_space_has_uniform_stress_under_pressure():
    """Gradients of Q1 functions are bilinear in 3D: with the centroids of the pieces alone, the error was 1 %."""
    grid, (c, s) = mpm.Grid([0] * 3, [1.2] * 3, [6] * 3), (0.8, 0.6)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, s, -c], [0, c, s]])
    block = mpm.mapped(grid, mpm.box(grid, [0.3] * 3, [0.8] * 3), lambda X: (X - 0.55) @ turn.T + 0.56)

    def held(points, u):
        return 1e5 * hardly_held(points, u)

    load = around(3e4, *ALL[3])
    simulation = mpm.Simulation(grid, [block], [SOFT], walls={}, terms=[held], conditions=load)
    simulation.run(1.0, 1.0)
    assert np.abs(simulation.effective_stress() + 3e4 * np.eye(3)).max() < 2e-6 * 3e4


def test_a_sealed_saturated_body_shares_the_pressure_between_water_and_skeleton():
    load = around(1e5, "top")
    s = column(material=mpm.Hencky(bulk=1e7 / 3, shear=5e6), fluid=mpm.Fluid(bulk=1e7), conditions=load)
    s.run(1.0, 1.0)
    total = s.effective_stress()[:, 1, 1] - s.points.pressure
    assert total == pytest.approx(np.full(len(total), -1e5), rel=1e-6)
    assert s.points.pressure.min() > 5e4 and np.ptp(s.points.pressure) < 1e-3


def clamped_column(load):
    """Return the lateral displacement of the top of an inclined column, which buckles under a dead load of 20 kPa."""
    grid = mpm.Grid([0, 0], [1.0, 1.2], [20, 24])
    body = mpm.mapped(grid, mpm.box(grid, [0.45, 0], [0.55, 1.0]), lambda X: X + 0.01 * X[:, 1:] * [1, 0])
    s = mpm.Simulation(grid, [body], [SOFT], walls={"bottom": "xy"}, conditions=load)
    return s.run(1.0, 0.125, probes=mpm.probes([body], [[0.5, 1.0]])).displacement[-1][0, 0]


def test_a_clamped_column_does_not_buckle_under_water():
    """Dead normal loads on sides and top would buckle the column at half of the load on its top alone."""
    with pytest.raises(mpm.GaveUp, match=r"t = 0\.[56]"):
        clamped_column([mpm.Traction(side, lambda t: -2e4 * t) for side in ("left", "right", "top")])
    water = lambda t: 1e6 * t  # noqa: E731
    assert abs(clamped_column(around(water, "left", "right", "top"))) < 2e-3


BEAM = {"region": ((0.05, -np.inf), (1.0, np.inf))}


def pressed_beam(cells, load, wet):
    """Return the simulation of a beam with a load on its top, and a probe at its tip."""
    grid = mpm.Grid([0, 0], [1.2, 1.2], [cells, cells])
    bottom = 0.6 + grid.h[1] / 2
    body = mpm.box(grid, [0, bottom], [1, bottom + 0.3])
    s = mpm.Simulation(
        grid, [body], [SOFT], walls={"left": "xy"}, **wet | {"conditions": [*load, *wet.get("conditions", [])]}
    )
    return s, mpm.probes([body], [[1.0, bottom + 0.15]])


@pytest.mark.parametrize("wet", [False, True])
def test_a_beam_under_a_pressure_that_follows_it_agrees_with_finite_elements(wet):
    """The tip deflects by a third of the length. The loaded surface ends freely, so the tangent is unsymmetric."""
    load, steps = around(lambda t: 54e3 * min(1, t / 0.1), "top", **BEAM), (0.2, 0.02)
    scene = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("left"), mpm.Drained("right")]} if wet else {}
    s, probe = pressed_beam(60, load, scene)
    tip = s.run(*steps, probes=probe).displacement[-1][0]
    fem = BiotFEM(
        mpm.Grid([0, 0], [1, 0.3], (40, 12)),
        SOFT,
        walls={"left": "xy"},
        conditions=[*load, *scene.pop("conditions", [])],
        **scene,
    )
    exact = fem.run(*steps, probes=[[1.0, 0.15]]).displacement[-1][0]
    assert not s.state.stage.symmetric and exact[1] < -0.2
    assert np.abs(tip - exact).max() < 2e-3 * np.abs(exact).max()


def clamped_block(dim, tractions):
    """Return a block clamped at a wall and bent by a first step."""
    lower, upper = [0.0, 0.1, 0.1], [0.47, 0.6, 0.43]
    grid = mpm.Grid([0] * dim, [0.7, 0.7, 0.5][:dim], [7, 7, 5][:dim])
    body = mpm.box(grid, lower[:dim], upper[:dim])
    s = mpm.Simulation(grid, [body], [SOFT], walls={"left": "xyz"[:dim]}, conditions=tractions)
    s.run(0.5, 0.5)
    return s


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("closed", [True, False])
def test_the_tangent_is_the_derivative_of_the_residual_and_symmetric_where_the_surface_is_closed(dim, closed):
    s = clamped_block(dim, around(1e6, *ALL[dim][1:]) if closed else around(2e5, "right"))
    assert s.state.stage.symmetric == closed
    m, rng = set_up(s, 0.2).momentum, np.random.default_rng(0)
    unknowns = m.system.unknowns
    u, v, w = (1e-3 * rng.standard_normal(unknowns.size) for _ in range(3))

    def residual(x):
        m.forms.u.x.array[unknowns.owned] = x
        return m.assemble_residual()[0].array.copy()

    eps = 1e-4
    slope = (residual(u + eps * v) - residual(u - eps * v)) / (2 * eps)
    residual(u)
    K, x, y = m.assemble_tangent(), unknowns.vector(), unknowns.vector()
    x.array[:], y.array[:] = v, w
    assert (K * x).array == pytest.approx(slope, abs=1e-7 * np.abs(slope).max())
    skew = abs(y.dot(K * x) - x.dot(K * y)) / ((K * x).norm() * y.norm())
    assert (skew < (1e-12 if dim == 2 else 1e-5)) == closed, skew


def test_newton_converges_quadratically(monkeypatch):
    monkeypatch.setattr(schur, "plan", lambda *args, **options: replace(plan(*args, **options), keep=0.0))
    for load in (around(54e3, "top", **BEAM), around(1e6, "top", "bottom", "right")):
        s, _ = pressed_beam(20, load, {})
        _, report = step(s.scene, s.state, 1.0)
        errors = [u for u, _ in report.history]
        last = next(k for k, error in enumerate(errors) if error < 1e-4)
        assert errors[last + 1] < 10 * errors[last] ** 1.8


def test_a_stage_may_change_a_dead_load_into_a_pressure():
    s = column(fluid=False, conditions=[mpm.Traction("top", (0, -1e6))])
    s.run(1.0, 1.0)
    s.stage(conditions=[*without(s, mpm.Traction), *around(1e6, "top")])
    s.run(2.0, 1.0)
    other = column(fluid=False, conditions=[*around(1e6, "top")])
    other.run(1.0, 1.0)
    assert np.abs(s.points.x - other.points.x).max() < 1e-9  # the area of its top does not change


def test_surfaces_are_closed_where_one_pressure_meets_itself_or_walls_that_hold_it():
    def symmetric(loads, walls=None, dim=2):
        grid = mpm.Grid([0] * dim, [1.0] * dim, [5] * dim)
        bodies = [mpm.box(grid, [0] * dim, [0.4, 0.6, 0.6][:dim]), mpm.box(grid, [0.4, *[0] * (dim - 1)], [0.8] * dim)]
        walls = walls or {"left": "x", "bottom": "y" if dim == 2 else "z", "front": "y"}
        walls = {name: walls[name] for name in walls if dim == 3 or name != "front"}
        return mpm.Simulation(grid, bodies, [SOFT], walls=walls, conditions=loads).state.stage.symmetric

    assert symmetric(around(1e5, "right", "top")) is False, "the step between the bodies is a gap on the left"
    assert symmetric(around(1e5, "left", "right", "top"))
    assert symmetric(around(1e5, "left", "right", "top", "back"), dim=3)
    assert not symmetric([*around(1e5, "left", "right"), *around(2e5, "top")])
    assert not symmetric(around(1e5, "left", "right", "top"), {"left": "x", "bottom": "x"})
    assert not symmetric(around(1e5, "left", "right", "top", region=((0, 0.1), (1, 1))))
    assert symmetric([mpm.Traction("top", 1e5)])
