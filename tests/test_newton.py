# SPDX-License-Identifier: MIT
"""Newton's method: exploding steps are shortened, and residuals above round-off are reduced, however small."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import ufl
from helpers import set_up
from scipy.optimize import brentq

import mpm_dolfinx as mpm

SOIL = mpm.Hencky(bulk=1e5, shear=1e5)
SIDES = {"left": "x", "right": "x"}


@dataclass(frozen=True)
class Stiffening(mpm.Skeleton):
    """A law linear in all components of F - I except the last, along y, with the stress soft e exp(exponent e^2)."""

    soft: mpm.Field = 1.0
    exponent: mpm.Field = 1.0

    @staticmethod
    def energy(F, bulk, soft, exponent):
        H = F - ufl.Identity(2)
        e = H[1, 1]
        return bulk / 2 * (ufl.inner(H, H) - e**2) + soft / (2 * exponent) * (ufl.exp(exponent * e**2) - 1)


@pytest.mark.parametrize(("exponent", "shortened"), [(8, False), (14, True)])
def test_a_newton_step_is_shortened_where_the_residual_grows_more_than_ten_thousandfold(exponent, shortened):
    """A body under lateral tension is pulled upward by 1e5 times less after its release: its tangent along y is that
    soft.

    The first step overshoots to e = 1, with a residual of 3e3 or 1e6 times the initial one. Newton's method then
    returns in a few more iterations than the exponent.
    """
    grid, across = mpm.Grid([0, 0], [1.2, 1.5], [12, 15]), 1e5
    pulls = [mpm.Traction("right", (across, 0)), mpm.Traction("top", lambda t: (0, float(t > 1)))]
    law = Stiffening(bulk=1e3 * across, shear=1e3 * across, exponent=exponent)
    walls = {"left": "x", "bottom": "y"}
    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [1, 1])],
        [law],
        walls=walls,
        conditions=pulls,
        numerics=mpm.Numerics(tolerance=1e-12),
    )
    s.step(1.0)
    s.state = replace(s.state, trend=None)  # the step begins from rest
    report = s.step(1.0)
    residuals = np.array([momentum for momentum, _ in report.history])
    assert (residuals[1] > 1e4 * residuals[0]) == shortened and residuals[1] > 3e2 * residuals[0]
    assert len(report.history) - 1 - report.newton == shortened, "steps that were shortened"
    assert report.newton <= (10 if shortened else 16)
    e = brentq(lambda e: e * np.exp(exponent * e**2) - 1, 0, 1)
    assert s.points.F[:, 1, 1] - 1 == pytest.approx(np.full(len(s.points), e), rel=1e-5)


def pressed_block(t_jump=np.inf):
    """Return a draining block under a growing load, which decreases to a fifth at t_jump (s)."""
    grid = mpm.Grid([0, 0], [1, 1.25], [4, 5])
    load = mpm.Traction("top", lambda t: (0, -1e5 * t * (0.2 if t > t_jump else 1.0)))
    conditions = [load, mpm.Drained("top")]
    soil, body = mpm.Hencky(bulk=1e7 / 3, shear=5e6, conductivity=1e-4), mpm.box(grid, [0, 0], [1, 1])
    return mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls=SIDES | {"bottom": "y"}, conditions=conditions)


@pytest.mark.parametrize("t_jump", [np.inf, 0.75])
def test_an_extrapolated_start_saves_newton_steps_and_changes_no_result_even_after_a_jump(t_jump):
    """The same steps are taken from rest for comparison."""
    ahead, from_rest, counts = pressed_block(t_jump), pressed_block(t_jump), []
    for _ in range(10):
        from_rest.state = replace(from_rest.state, trend=None)
        counts.append([s.step(0.1).newton for s in (ahead, from_rest)])
    for name in ("corners", "pressure"):
        one, other = (getattr(s.state.points, name) for s in (ahead, from_rest))
        assert np.abs(one - other).max() <= 1e-7 * np.abs(other).max()
    assert counts[-1][0] < counts[-1][1] or t_jump < 1


def stretch(load):
    """Return the stretch of a laterally confined bar of SOIL under a dead load, divided by its modulus: ln a / a."""
    return brentq(lambda a: np.log(a) / a - load, 1, 2)


@pytest.mark.parametrize(("stiffer", "load", "error"), [(1e7, 0.01, 1e-4), (1e8, 0.03, 1e-5)])
def test_what_round_off_in_a_stiff_part_does_not_hide_is_solved_for(stiffer, load, error):
    """After Newton's first step, the residual of the soft part is 100 times the round-off of the stiff part."""
    grid = mpm.Grid([0, 0], [0.1, 1.0], [1, 10])
    bodies = [mpm.box(grid, [0, 0], [0.1, 0.5]), mpm.box(grid, [0, 0.5], [0.1, 0.9], material=1)]
    hard = mpm.Hencky(bulk=stiffer * SOIL.bulk, shear=stiffer * SOIL.shear)
    pull = mpm.Traction("top", (0, load * SOIL.oedometric), region=((-np.inf, 0.8), (np.inf, np.inf)))
    s = mpm.Simulation(grid, bodies, [hard, SOIL], walls=SIDES | {"bottom": "y"}, conditions=[pull])
    s.step(1.0)
    a = s.points.F[s.points.material == 1, 1, 1]
    assert a - 1 == pytest.approx(np.full(len(a), stretch(load) - 1), rel=error)


@pytest.mark.parametrize("load", [1e-9, 1e-3])
def test_residuals_and_balance_are_told_as_they_are_also_where_they_are_round_off(load):
    grid = mpm.Grid([0, 0], [0.1, 1.0], [1, 10])
    pull = [mpm.Traction("top", (0, load * SOIL.oedometric))]
    options = {"walls": SIDES | {"bottom": "y"}, "conditions": [*pull, mpm.Drained("top")]}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.1, 0.85])], [SOIL], **options, fluid=mpm.Fluid())
    report = s.step(1.0)
    assert all(0 < residual <= 1e-8 for residual in report.history[-1]) and 0 < report.balance <= 1e-8


def test_what_the_rounding_of_places_far_from_the_origin_does_not_hide_is_solved_for():
    """A bar with a prescribed displacement, a thousand cells from the origin."""
    grid = mpm.Grid([100.0, 0.0], [100.1, 1.2], [1, 12])
    foot, pull = mpm.Displacement("bottom", (0, 0), "y"), mpm.Traction("top", (0, 0.2 * SOIL.oedometric))
    bar = mpm.box(grid, [100.0, 0.1], [100.1, 0.9])
    s = mpm.Simulation(grid, [bar], [SOIL], walls=SIDES, conditions=[foot, pull])
    s.step(1.0)
    assert s.points.F[:, 1, 1] - 1 == pytest.approx(np.full(len(s.points), stretch(0.2) - 1), rel=1e-6)


@pytest.mark.parametrize("share", [1e-12, 2e-13])
def test_fluid_that_comes_in_is_stored_however_little_it_is(share):
    """The error is relative to the body's volume; rounding causes 2e-15."""
    grid, water = mpm.Grid([0, 0], [0.1, 1.0], [1, 10]), mpm.Fluid(bulk=1e7)
    body, walls = mpm.box(grid, [0, 0], [0.1, 0.8]), SIDES | {"bottom": "y"}
    filling = [lambda points, q: share * q * points.dx]
    s = mpm.Simulation(grid, [body], [SOIL], walls=walls, fluid=water, terms=[*(mpm.Source(f) for f in filling)])
    s.step(1.0)
    exact = share / (1 / SOIL.oedometric + SOIL.porosity / water.bulk)
    assert s.points.pressure == pytest.approx(np.full(len(s.points), exact), rel=1e-3)


@pytest.mark.parametrize("difference", [1e-11, 2e-12])
def test_fluid_flows_between_sides_however_little_their_pressures_differ(difference):
    """The error is relative to the pressure. Rounding may add 2e-15 of each flux, and these fluxes cancel."""
    grid, high = mpm.Grid([0, 0], [0.1, 1.0], [1, 10]), 1e5
    soil = mpm.Hencky(bulk=1e7, shear=1e7, conductivity=1e-4)
    sides = [mpm.Drained("top", high), mpm.Drained("bottom", high * (1 + difference))]
    walls = SIDES | {"bottom": "y", "top": "y"}
    body = mpm.box(grid, [0, 0], [0.1, 1.0])
    s = mpm.Simulation(grid, [body], [soil], walls=walls, fluid=mpm.Fluid(), pressure=high, conditions=sides)
    s.step(1e9)
    found = (s.points.pressure - high) / (high * difference)
    assert found == pytest.approx(1 - s.points.x[:, 1], abs=0.01)


def test_what_fluxes_gain_by_displacements_is_what_their_residual_does():
    """With a conductivity law, gravity, and rotating, stretching cells: comparison with central differences."""
    law = lambda conductivity, J: conductivity * J**3 / (1 - ufl.ln(J))  # noqa: E731
    soil = mpm.Hencky(bulk=1e5, shear=1e5, conductivity=1e-2, conductivity_law=law)
    grid, rng = mpm.Grid([0, 0], [1.0, 1.0], [4, 4]), np.random.default_rng(3)
    options = {
        "walls": {"bottom": "xy"},
        "fluid": mpm.Fluid(),
        "gravity": (0, -9.81),
        "pressure": lambda x: 1e3 * x[:, 0],
    }
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.9, 0.8])], [soil], conditions=[mpm.Drained("right")], **options)
    _, momentum, storage = set_up(s, 10.0)
    system, unknowns, u = storage.system, momentum.system.unknowns, momentum.forms.u
    move = lambda v, scale: unknowns.add(u.x, scale, v)  # noqa: E731
    bent, v = (unknowns.gather_owned(size * rng.standard_normal(unknowns.size)) for size in (0.01, 1.0))
    move(bent, 1.0)
    storage.assemble_tangent()
    out, content, there = system.unknowns.vector(), system.unknowns.vector(), []
    slope = storage.flux_slope(u, unknowns, momentum.forms.active.now.dofs)
    system.change_by(v, out, slope)
    system.change_by(v, content)
    for step in (1e-6, -2e-6):
        move(v, step)
        there.append(storage.assemble_residual().vector.array.copy())
    exact = (there[0] - there[1]) / 2e-6
    assert out.array == pytest.approx(exact, abs=1e-4 * np.abs(exact).max())
    assert np.abs(content.array - exact).max() > 0.1 * np.abs(exact).max()
