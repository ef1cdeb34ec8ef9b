# SPDX-License-Identifier: MIT
"""Inertia: a moving body continues to move and keeps its momentum, at any position of the grid lines."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from scipy.optimize import brentq
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import eigsh
from scipy.special import j0, j1

import mpm_dolfinx as mpm
from mpm_dolfinx.base.time_integration import GAMMA
from mpm_dolfinx.mechanics import inertia
from mpm_dolfinx.points.cutting import cut
from mpm_dolfinx.stepping.balances import balances, flight_of
from mpm_dolfinx.stepping.step import set_up

TIGHT = mpm.Numerics(tolerance=1e-10)
BLOCK = mpm.NeoHookean(bulk=1e3 / 1.2, shear=1e3 / 2.6, grain_density=2.0, porosity=0.5)  # nu = 0.3, 1 kg/m^3


class Bar(mpm.LinearElastic):
    """Law P = E (F - 1) along each axis, nu = 0: waves of any amplitude keep their shape."""

    @staticmethod
    def energy(F, bulk, shear):
        return shear * ((F[0, 0] - 1) ** 2 + (F[1, 1] - 1) ** 2 + F[0, 1] ** 2 + F[1, 0] ** 2)


class Dust(mpm.LinearElastic):
    """Law without stress; its shear modulus still scales the ghost penalty."""

    @staticmethod
    def energy(F, bulk, shear):
        return 1e-20 * mpm.LinearElastic.energy(F, bulk, shear)


def csr(A):
    rows, columns, values = A.getValuesCSR()
    return csr_matrix((values, columns, rows), shape=A.getSize())


def momenta(s):
    """Return momentum (d,), angular momentum about the centre of mass, and kinetic energy, summed over the points."""
    points, d = s.points, s.grid.dim
    whole = mpm.Grid(s.grid.lower, s.grid.upper, [1] * d)
    spread = cut(whole, s.state.points.corners, True).second
    mass = s.scene.materials.density(points) * points.volume0 * points.J
    v, L = points.velocity, points.data["F_rate"] @ np.linalg.inv(points.F)
    momentum, centre = mass @ v, mass @ points.x / mass.sum()
    off, slip = points.x - centre, v - momentum / mass.sum()
    moment = np.einsum("ni,nj->nij", off, slip) + spread @ L.swapaxes(1, 2)
    turn = np.einsum("n,nij->ij", mass, moment - moment.swapaxes(1, 2))
    energy = mass @ ((slip**2).sum(axis=1) + np.einsum("nij,njk,nik->n", L, spread, L)) / 2
    return momentum, turn[0, 1], energy


def turning(h=0.25, drift=(0.3, 0.2), numerics=TIGHT, **options):
    """Return a stiff block of 1 x 0.5 m that rotates by 1 rad/s and flies, without walls."""
    grid = mpm.Grid([0, 0], [4.0, 3.0], [round(4 / h), round(3 / h)])
    body = mpm.box(grid, [0.6, 0.7], [1.6, 1.2])
    centre = np.array([1.1, 0.95])

    def velocity(x):
        off = x - centre
        return np.stack([drift[0] - off[:, 1], drift[1] + off[:, 0]], axis=1)

    return mpm.Simulation(grid, [body], [BLOCK], walls={}, inertia=mpm.Moving(velocity), numerics=numerics, **options)


def test_a_block_that_turns_and_flies_keeps_its_momenta_and_energy():
    """Without the chord of `inertia.chord`, it would lose 1.6 % of its angular momentum in two radians."""
    s = turning()
    start = momenta(s)
    assert start[1] == pytest.approx(0.0520833333, rel=1e-8)  # m (a^2 + b^2) / 12
    for _ in range(40):
        s.step(0.05)
    end = momenta(s)
    assert end[0] == pytest.approx(start[0], abs=1e-14)
    assert end[1] == pytest.approx(start[1], rel=3e-4) and end[2] == pytest.approx(start[2], rel=6e-4)


def test_the_chord_is_what_keeps_angular_momentum(monkeypatch):
    monkeypatch.setattr(inertia, "chord", lambda G, midpoint: (G, ufl.Identity(2)))
    s = turning()
    start = momenta(s)[1]
    for _ in range(20):
        s.step(0.1)
    assert momenta(s)[1] < 0.97 * start


@pytest.mark.parametrize("factor", [0.1, 10])
def test_the_ghost_mass_may_be_a_tenth_or_ten_times_as_large(factor, monkeypatch):
    def end():
        s = turning()
        for _ in range(10):
            s.step(0.05)
        return np.array(momenta(s)[1:])

    as_is = end()
    monkeypatch.setattr(inertia, "GHOST_MASS", factor * inertia.GHOST_MASS)
    assert end() == pytest.approx(as_is, rel=2e-4)


@pytest.mark.parametrize("size", [(0.62, 0.41), (0.62, 0.41, 0.31)])
def test_the_ghost_penalty_does_not_act_on_a_motion_that_goes_on(size, monkeypatch):
    """The velocities of dust have kinks next to nearly empty cells, but no forces.  Kinks in the displacement of the
    step would have forces.
    """
    monkeypatch.setattr(inertia, "RELAXES", 0.0)
    d = len(size)
    grid = mpm.Grid([0] * d, [1.2] * d, [12] * d)
    dust = Dust(bulk=1e6, shear=1e6, grain_density=2000.0, porosity=0.5)
    body = mpm.box(grid, [0.2] * d, np.add(0.2, size))
    velocity = lambda x: np.stack([x[:, 1] ** 2, *(0.3 * x[:, 0] ** 2 for _ in range(d - 1))], axis=1)  # noqa: E731
    s = mpm.Simulation(grid, [body], [dust], walls={}, inertia=mpm.Moving(velocity), numerics=TIGHT)
    before = s.points.velocity
    s.step(0.05)
    assert s.scene.momentum.ghost.form.used
    assert np.abs(s.points.velocity - before).max() < 1e-12


def test_relaxation_hardly_damps_waves_that_the_nodes_represent():
    """Dust flies over 10 cells, with a wave of 12 cells in its velocity.  One pass of relaxation would take 0.7 %."""
    grid = mpm.Grid([0, 0], [2.4, 0.8], [24, 8])
    dust = Dust(bulk=1e6, shear=1e6, grain_density=2000.0, porosity=0.5)
    body = mpm.box(grid, [0.23, 0.21], [0.83, 0.61])
    velocity = lambda x: np.stack([1 + 0 * x[:, 0], 0.1 * np.sin(np.pi * (x[:, 0] - 0.53) / 0.6)], axis=1)  # noqa: E731
    s = mpm.Simulation(grid, [body], [dust], walls={}, inertia=mpm.Moving(velocity))
    start = momenta(s)
    s.run(1.0, 0.05, progress=False)
    end = momenta(s)
    assert end[0] == pytest.approx(start[0], abs=1e-11)
    assert end[2] == pytest.approx(start[2], rel=4e-3) and end[2] < start[2]


def test_velocities_that_the_nodes_do_not_represent_vanish_in_a_body_without_deformation():
    """Random velocities of points. Without the limit of `Mass.carried`, 0.98 of their energy would remain."""
    grid = mpm.Grid([0, 0], [2.0, 1.0], [16, 8])
    dust = Dust(bulk=1.0, shear=1.0, grain_density=2.0, porosity=0.5)
    block, moving = mpm.box(grid, [0.3, 0.3], [1.3, 0.8]), mpm.Moving((1.0, 0.0))
    s = mpm.Simulation(grid, [block], [dust], walls={}, inertia=moving, numerics=TIGHT)
    points = s.state.points
    noise = 0.01 * np.random.default_rng(1).normal(size=(len(points), 2))
    noisy = {inertia.VELOCITY: points.data[inertia.VELOCITY] + noise}
    s.state = replace(s.state, points=replace(points, data=points.data | noisy))
    start = momenta(s)
    s.step(1e-3)
    end = momenta(s)
    assert end[0] == pytest.approx(start[0], abs=1e-14) and end[2] < 0.4 * start[2]


def test_a_body_that_flies_far_away_changes_no_velocities_of_points_that_keep_their_pieces():
    """Earlier, the limit of `Mass.carried` acted on a body at rest only if another body moved."""
    grid = mpm.Grid([0, 0], [2.0, 1.0], [8, 4])
    dust = Dust(bulk=1.0, shear=1.0, grain_density=2.0, porosity=0.5)
    bodies = [mpm.box(grid, [0.1, 0.3], [0.6, 0.8]), mpm.box(grid, [1.2, 0.2], [1.7, 0.7])]
    noise = 1e-4 * np.random.default_rng(1).normal(size=(len(bodies[0]), 2))
    found = []
    for speed in (0.0, 0.3):
        fly = mpm.Moving(lambda x, speed=speed: speed * (x[:, :1] > 1) * [1.0, 0.0])
        s = mpm.Simulation(grid, bodies, [dust], walls={}, inertia=fly, numerics=TIGHT)
        velocity = s.state.points.data[inertia.VELOCITY].copy()
        velocity[: len(noise)] += noise
        points = replace(s.state.points, data=s.state.points.data | {inertia.VELOCITY: velocity})
        s.state = replace(s.state, points=points)
        s.step(1e-2)
        found.append(s.points.data[inertia.VELOCITY][: len(noise)])
    assert found[1] == pytest.approx(found[0], abs=1e-12)


def test_steps_of_a_wet_body_that_flies_without_stress_are_not_halved():
    """Earlier, rounding errors of pore pressures (1e-9 Pa) halved steps, so results depended on units by 1e-2 m."""
    grid = mpm.Grid([0, 0], [2.4, 1.2], [24, 12])
    soil = mpm.NeoHookean(bulk=1.7e5, shear=7.7e4, grain_density=2000.0, porosity=0.5, conductivity=1e-4)
    block, moving = mpm.box(grid, [0.23, 0.31], [0.83, 0.71]), mpm.Moving((1.37, 0.093))
    s = mpm.Simulation(grid, [block], [soil], walls={}, inertia=moving, fluid=mpm.Fluid(), numerics=TIGHT)
    result = s.run(0.06, 0.01, progress=False)
    assert np.abs(s.points.pressure).max() < 1e-6
    assert result.rejected == 0


@pytest.mark.parametrize("thin", [1e-3, 0.05])
def test_nearly_empty_cells_rest_after_long_steps_that_follow_short_ones(thin):
    """In long steps the predictor of a vibration is large.  The ghost penalty must not impose its kinks."""

    def strain(after):
        grid = mpm.Grid([0, 0], [1, 1], [10, 10])
        soil = mpm.Hencky(bulk=1e7 / 1.2, shear=1e7 / 2.6, grain_density=2000.0, porosity=0.5)
        body = mpm.box(grid, [0, 0], [0.4 + 0.1 * thin] * 2)
        swing = mpm.Moving(lambda x: x * [2.5, -2.5])
        walls = {"left": "x", "bottom": "xy"}
        s = mpm.Simulation(grid, [body], [soil], walls=walls, gravity=(0, -9.81), inertia=swing if after else False)
        for dt in after or [1.0]:
            s.step(dt)
        return np.abs(s.points.F - np.eye(2)).max()

    assert strain([1e-3] * 40 + [0.1] * 10) < 2 * strain([])


def test_a_uniform_velocity_added_changes_nothing_else(monkeypatch):
    """Whole cells per step. Filter and relaxation depend on the crossed cells, and change F by less than 2e-6."""
    monkeypatch.setattr(inertia, "RELAXES", 0.0)
    still, moves = turning(drift=(0, 0)), turning(drift=(2.5, 0))
    still.step(0.1), moves.step(0.1)
    slip = moves.points.velocity - still.points.velocity
    assert slip == pytest.approx(np.broadcast_to([2.5, 0.0], slip.shape), abs=1e-12)
    for _ in range(3):
        still.step(0.1), moves.step(0.1)
    assert moves.points.F == pytest.approx(still.points.F, abs=2e-6)
    assert (moves.points.x - still.points.x).mean(axis=0) == pytest.approx([1.0, 0.0], abs=1e-8)


def flown(cells, speed=0.23, periods=1.1, amplitude=0.05, per_period=2):
    """Return errors of u and v of a vibrating flying bar, divided by their amplitudes, and of its momentum."""
    h, dt = 1 / cells, 1 / cells * 2 / per_period
    count = cells + 2 * round(speed * periods / h) + 8
    grid = mpm.Grid([0, 0], [count * h, h], [count, 1])
    low = 2.3 * h
    body = mpm.box(grid, [low, 0], [low + 1, h])
    bar = Bar(bulk=1 / 3, shear=0.5, grain_density=2.0, porosity=0.5)

    def velocity(x):
        return np.stack([speed + amplitude * np.cos(np.pi * (x[:, 0] - low)), 0 * x[:, 1]], axis=1)

    walls = {"bottom": "y", "top": "y"}
    s = mpm.Simulation(grid, [body], [bar], walls=walls, inertia=mpm.Moving(velocity), numerics=TIGHT)
    start = momenta(s)[0]
    for _ in range(round(2 * periods / dt)):
        s.step(dt)
    X, t = s.points.reference.mean(axis=1)[:, 0] - low, s.t
    u = speed * t + amplitude / np.pi * np.cos(np.pi * X) * np.sin(np.pi * t)
    v = speed + amplitude * np.cos(np.pi * X) * np.cos(np.pi * t)
    off = (s.points.corners.mean(axis=1)[:, 0] - low - X - u) / (amplitude / np.pi), s.points.velocity[:, 0] - v
    return [np.sqrt((off[0] ** 2).mean()), np.sqrt((off[1] ** 2).mean()) / amplitude, abs(momenta(s)[0] - start).max()]


def test_a_bar_that_vibrates_and_flies_over_the_grid_is_met_at_second_order():
    (u, v, lost), (finer, finer_v, _) = flown(10), flown(20)
    assert u < 0.01 and u / finer > 3.6 and v / finer_v > 3.4 and lost < 1e-14


def test_frequencies_of_a_clamped_beam_are_those_of_spectral_elements():
    """f1 to f3, in Hz, of a beam of 1 x 0.3 m, nu = 0, known to eight digits: 1 % with h = 0.05 m, of second order."""
    exact, off = np.array([3.2441904, 15.985029, 17.6776695]), []
    for h in (0.1, 0.05):
        grid = mpm.Grid([0, 0], [13 * 0.1, 0.8], [round(1.3 / h), round(0.8 / h)])
        beam = mpm.box(grid, [0, 0.2], [1, 0.5])
        law = mpm.LinearElastic(bulk=1e7 / 3, shear=5e6, grain_density=4000.0, porosity=0.5)
        velocity = lambda x: np.stack([0 * x[:, 0], 1e-3 * x[:, 0]], axis=1)  # noqa: E731
        s = mpm.Simulation(grid, [beam], [law], walls={"left": "xy"}, inertia=mpm.Moving(velocity))
        s.step(1e-4)
        _, made = s.scene.last
        M = csr(made.mass.M)
        K = csr(made.momentum.K) - M / (GAMMA * 1e-4) ** 2
        found = np.sqrt(eigsh(K, 3, M, sigma=0)[0]) / (2 * np.pi)
        off.append(found / exact - 1)
    assert (np.array(off) > 0).all() and (off[1] < 0.01).all() and (off[0] / off[1] > 3.4).all()


def column(inertia=True, n=20, **options):
    """Return a dry confined column, 10 m high, with a wave velocity of 188.7 m/s."""
    young, nu = 50e6, 0.3
    soil = mpm.LinearElastic(
        bulk=young / 3 / (1 - 2 * nu), shear=young / 2 / (1 + nu), grain_density=2700.0, porosity=0.3
    )
    h = 10 / n
    grid = mpm.Grid([0, 0], [h, 10 + 2 * h], [1, n + 2])
    body = mpm.box(grid, [0, 0], [h, 10])
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(grid, [body], [soil], walls=walls, inertia=inertia, **options)


def test_a_sudden_load_runs_down_and_doubles_at_the_base():
    """Exact: the stress on the base is zero until t = L / c, then twice the load until 3 L / c."""
    s, c = column(n=40, conditions=[mpm.Traction("top", (0, -1e3))]), np.sqrt(67307692.31 / 1890)
    width, dt = s.points.corners[:, :, 0].max(), 10 / 40 / c
    base = []
    for _ in range(100):
        s.step(dt)
        base.append(s.wall_reactions["bottom"][1] / (1e3 * width))
    base = np.array(base)
    assert np.abs(base[:34]).max() < 0.1 and base[60:100].mean() == pytest.approx(2.0, abs=0.02)


def test_stages_begin_and_end_inertia_with_forces_in_balance():
    """A column settles under its weight without inertia, stays at rest with inertia, and moves on after a load."""
    s = column(inertia=False, gravity=(0, -9.81))
    s.run(1.0, 1.0, progress=False)
    settled = s.points.x.copy()
    s.stage(inertia=True)
    s.run(1.1, 0.02, progress=False)
    assert np.abs(s.points.x - settled).max() < 1e-4 * (10 - settled.max())  # what a reset of the grid leaves
    s.stage(conditions=[mpm.Traction("top", (0, -1e4))])
    s.run(1.12, 0.01, progress=False)
    assert np.abs(s.points.velocity).max() > 1e-3
    s.stage(inertia=False, conditions=[])
    s.run(2.0, 1.0, progress=False)
    assert np.abs(s.points.x - settled).max() < 1e-3 * (10 - settled.max())


@pytest.mark.parametrize("steps", [{"dt": 0.5}, {"rtol": 1e-3}])
def test_a_stage_without_inertia_takes_the_steps_of_a_scene_without_inertia(steps):
    """Without fluid, such a stage has no time derivatives, so steps have one substep."""
    load = mpm.Traction("top", lambda t: (0, -1e5 * t))
    never, later = (column(now, conditions=[load]).run(1.0, progress=False, **steps) for now in (None, False))
    assert (later.steps, later.newton) == (never.steps, never.newton)


PLATE = mpm.Tool(mpm.HalfSpace((0, 10), (0, -1)), displacement=lambda t: (0, -0.02 * min(t, 1)))


@pytest.mark.parametrize(
    ("load", "fluid", "change", "fastest"),
    [
        (mpm.Traction("top", (0, -1e5)), None, 1e-7, 1e-6),
        (mpm.Traction("top", (0, -1e5)), mpm.Fluid(), 1e-5, 1e-4),
        (PLATE, None, 0.02, 5e-4 / 2e-3),  # m/s: the penetration that a step may leave, over the step
    ],
)
def test_the_base_bears_the_same_force_before_and_after_inertia_begins(load, fluid, change, fastest):
    s = column(inertia=False, n=10, gravity=(0, -9.81), conditions=[load], fluid=fluid)
    s.step(1.0)
    before = s.wall_reactions["bottom"][1]
    s.stage(inertia=True)
    for _ in range(10):
        s.step(2e-3)
        assert s.wall_reactions["bottom"][1] == pytest.approx(before, rel=change)
        assert np.abs(s.points.velocity).max() < fastest


@pytest.mark.parametrize("held", [None, mpm.Displacement("bottom", lambda t: (0, 0.03 * min(t, 1)))])
def test_a_block_off_the_grid_lines_stays_at_rest_when_inertia_begins_and_falls_when_it_is_let_go(held):
    """Forces balance the error of the grid reset while the supports do not change."""
    low = 0.53 if held else 0.0
    grid = mpm.Grid([0, 0], [1, 1.2], [10, 12])
    block, walls = mpm.box(grid, [0.32, low], [0.72, low + 0.33]), {} if held else {"bottom": "xy"}
    soil = mpm.Hencky(bulk=1e6, shear=6e5, grain_density=2000.0)
    options = {"conditions": [held] if held else [], "gravity": (0, -9.81), "inertia": False}
    s = mpm.Simulation(grid, [block], [soil], walls=walls, **options)
    s.step(1.0)
    settled = s.state
    s.stage(inertia=True)
    for _ in range(3):
        s.step(2e-3)
        assert np.abs(s.points.velocity).max() < 1e-6  # 2e-3 m/s without these forces
    if held:
        s.state = settled
        s.stage(inertia=True, conditions=[])
        s.step(2e-3)
        mass = s.scene.materials.density(s.points) * s.points.volume0 * s.points.J
        assert mass @ s.points.velocity[:, 1] / mass.sum() == pytest.approx(-9.81 * 2e-3, rel=1e-9)


@pytest.mark.parametrize("size", [0.05, 0.7])
def test_a_body_of_one_domain_flies_across_cells_as_larger_ones(size):
    """Such bodies gave up, or lost velocity: the mode xy of the shape functions of a cell had no mass."""
    grid = mpm.Grid([0, 0], [4, 4], [4, 4])
    start, velocity = np.array([0.17, 1.5]), np.array([2.0, -0.4])
    body = mpm.box(grid, start, start + size, per_cell=1)
    s = mpm.Simulation(grid, [body], [BLOCK], walls={}, inertia=mpm.Moving(velocity))
    s.run(0.7, 0.05, progress=False)
    assert len(body) == 1 and s.points.x[0] == pytest.approx(start + size / 2 + 0.7 * velocity, abs=1e-10)
    assert s.points.velocity[0] == pytest.approx(velocity, abs=1e-10)


def test_a_block_falls_as_stones_do():
    grid = mpm.Grid([0, 0], [1, 4], [5, 20])
    block = mpm.box(grid, [0.3, 3.1], [0.7, 3.5])
    s = mpm.Simulation(grid, [block], [BLOCK], walls={}, gravity=(0, -9.81), inertia=True)
    start = s.points.x.copy()
    s.run(0.5, 0.05, progress=False)
    assert s.points.x - start == pytest.approx(np.broadcast_to([0, -9.81 / 8], start.shape), abs=1e-8)


def breathing(n):
    """Return the computed and the exact first frequency, in Hz, of a solid cylinder in plane strain, of radius 1 m.

    Exact: x J_0(x) = (1 - 2 nu) / (1 - nu) J_1(x), x = omega R / c_p.
    """
    grid = mpm.Grid([0, 0], [1 + 2 / n, 2 / n], [n + 2, 2], axisymmetric=True)
    body = mpm.box(grid, [0, 0], [1, 2 / n])
    law = mpm.LinearElastic(bulk=1e7 / 1.2, shear=1e7 / 2.6, grain_density=2000.0, porosity=0.5)
    velocity = lambda x: np.stack([1e-3 * x[:, 0], 0 * x[:, 0]], axis=1)  # noqa: E731
    walls = {"bottom": "y", "top": "y"}
    s = mpm.Simulation(grid, [body], [law], walls=walls, inertia=mpm.Moving(velocity))
    s.step(1e-5)
    _, made = s.scene.last
    M = csr(made.mass.M)
    found = eigsh(csr(made.momentum.K) - M / (GAMMA * 1e-5) ** 2, 1, M, sigma=0)[0][0]
    x = brentq(lambda x: x * j0(x) - 0.4 / 0.7 * j1(x), 1, 3)
    return np.sqrt(found) / (2 * np.pi), x * np.sqrt((law.bulk + 4 / 3 * law.shear) / 1000) / (2 * np.pi)


def test_a_cylinder_breathes_as_bessel_says():
    off = [found / exact - 1 for found, exact in map(breathing, (6, 12))]
    assert 0 < off[0] < 3e-3 and off[0] / off[1] > 3.8


@pytest.mark.parametrize("hole", [0.0, 0.3])
def test_a_ring_falls_as_stones_do(hole):
    grid = mpm.Grid([0, 0], [1, 4], [5, 20], axisymmetric=True)
    ring = mpm.box(grid, [hole, 3.1], [0.7, 3.5])
    s = mpm.Simulation(grid, [ring], [BLOCK], walls={}, gravity=(0, -9.81), inertia=mpm.Moving((0, 1.0)))
    start = s.points.x.copy()
    s.run(0.4, 0.05, progress=False)
    assert s.points.x - start == pytest.approx(np.broadcast_to([0, 0.4 - 9.81 * 0.08], start.shape), abs=1e-8)


def test_a_block_slides_down_a_smooth_incline_as_fast_as_it_should():
    angle = np.pi / 6
    grid = mpm.Grid([0, 0], [2.0, 1.0], [20, 10])
    block = mpm.box(grid, [0.2, 0.23], [0.5, 0.43])
    stiff = mpm.Hencky(bulk=1e6, shear=6e5, grain_density=2000.0)
    floor = mpm.Tool(mpm.HalfSpace((0, 0.23), (0, 1)))
    gravity = 9.81 * np.array([np.sin(angle), -np.cos(angle)])
    s = mpm.Simulation(grid, [block], [stiff], walls={}, conditions=[floor], gravity=gravity, inertia=True)
    start = s.points.x[:, 0].mean()
    s.run(0.2, 0.01, progress=False)
    assert s.points.x[:, 0].mean() - start == pytest.approx(9.81 * np.sin(angle) * 0.2**2 / 2, rel=1e-5)


def test_a_saturated_column_shakes_as_the_exact_one():
    """u-p form with the fluid's acceleration in its flux: Zienkiewicz, Chang and Bettess (1980), Pi1 = 1, Pi2 = 0.1."""
    frequency, exact = 58.13164491, 1.50970174e-8 * np.exp(-0.7539278j)
    soil = mpm.LinearElastic(
        bulk=50e6 / 1.2, shear=50e6 / 2.6, grain_density=2700.0, porosity=0.3, conductivity=7.70570326e-3
    )
    grid = mpm.Grid([0, 0], [0.5, 11.0], [1, 22])
    body = mpm.box(grid, [0, 0], [0.5, 10])
    load = mpm.Traction("top", lambda t: (0, -np.cos(frequency * t)))
    s = mpm.Simulation(
        grid,
        [body],
        [soil],
        walls={"left": "x", "right": "x", "bottom": "xy"},
        conditions=[load, mpm.Drained("top")],
        fluid=mpm.Fluid(density=1000.0, bulk=2.2e9),
        inertia=True,
    )
    dt, found = 2 * np.pi / frequency / 25, 0.0
    for _ in range(6 * 25):
        s.step(dt)
        if s.t > 5.01 * 25 * dt:
            found += (10 - s.points.corners[:, :, 1].max()) * np.exp(-1j * frequency * s.t) * 2 / 25
    assert abs(found / exact - 1) < 0.04


def test_water_that_flows_freely_does_not_make_a_column_unstable():
    """Exact settlement at 0.05 s of a half-space of stiff water and grains, u-p form (after de Boer, Ehlers and Liu
    1993).

    With the acceleration of the face alone in the flux, pressures would grow from step to step. Water of 1000 kg/m^3
    then has more mass in alternating nodal modes than a third of the mixture of 1670 kg/m^3.
    """
    soil = mpm.LinearElastic(
        bulk=14.515e6 / 1.2, shear=14.515e6 / 2.6, porosity=0.33, grain_density=2000.0, conductivity=1e-2
    )
    grid = mpm.Grid([0, 0], [0.5, 11.0], [1, 22])
    body = mpm.box(grid, [0, 0], [0.5, 10])
    conditions = [mpm.Traction("top", (0, -3e3)), mpm.Drained("top")]
    fluid = mpm.Fluid(density=1000.0, bulk=np.inf, gravity=10.0)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=conditions, fluid=fluid, inertia=True)
    s.run(0.05, 0.0025, progress=False)
    assert 10 - s.points.corners[:, :, 1].max() == pytest.approx(1.7066e-4, rel=0.03)
    assert s.points.pressure.max() == pytest.approx(3e3, rel=0.05)


@pytest.mark.parametrize("kind", ["equal cells", "unequal cells", "unsaturated", "axisymmetric", "3D"])
def test_the_tangent_contains_the_acceleration_of_the_water(kind):
    """Comparison with central differences of the residual, at rest, where the geometry of the fluxes has no effect."""
    d = 3 if kind == "3D" else 2
    options = {"conductivity": 1e-2, "grain_density": 2000.0, "porosity": 0.4}
    if kind == "unsaturated":
        options["retention"] = mpm.VanGenuchten(1e4)
    soil = mpm.Hencky(bulk=1e6, shear=1e6, **options)
    grid = mpm.Grid([0.0] * d, [1.2] * d, [4] * d, axisymmetric=kind == "axisymmetric")
    if kind == "unequal cells":
        grid = mpm.Grid(lines=[[0, 0.2, 0.5, 0.9, 1.2], [0, 0.3, 0.5, 0.8, 1.2]])
    body, walls = mpm.box(grid, [0.0] * d, [1.0] * d), {"bottom": "xyz"[:d], "left": "x"}
    conditions = [mpm.Drained("top")]
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=conditions, fluid=mpm.Fluid(), inertia=True)
    start = set_up(s.scene, s.state, 1e-3)
    both = balances(s.scene, start, start.begun(start.acting[0], None), None, flight_of(start))
    (u, unknowns), storage = (both.momentum.forms.u, both.momentum.system.unknowns), both.storage
    both.momentum.assemble_residual()
    storage.assemble_residual()
    storage.assemble_tangent()
    system, there = storage.system, []
    v = unknowns.gather_owned(np.random.default_rng(3).standard_normal(unknowns.size))
    out, content = system.unknowns.vector(), system.unknowns.vector()
    system.change_by(v, out)
    system.B_momentum.mult(v, content)
    for step in (1e-7, -2e-7):
        unknowns.add(u.x, step, v)
        there.append(storage.assemble_residual().vector.array.copy())
    exact = (there[0] - there[1]) / 2e-7
    assert out.array == pytest.approx(exact, abs=1e-6 * np.abs(exact).max())
    assert np.abs(content.array - exact).max() > 0.1 * np.abs(exact).max()


@pytest.mark.parametrize("steps", [50, 7000])
def test_newton_takes_two_steps_for_a_sudden_load_on_permeable_pores(steps):
    """k / (g dt) = 0.5 and 70: Newton's method took 15 steps in each substep, or failed, when accelerations lagged."""
    soil = mpm.LinearElastic(bulk=12e6, shear=5.6e6, porosity=0.33, grain_density=2000.0, conductivity=1e-2)
    grid = mpm.Grid([0, 0], [0.5, 11.5], [1, 23])
    body = mpm.box(grid, [0, 0.5], [0.5, 10.5])
    conditions = [mpm.Traction("top", (0, -3e3)), mpm.Drained("top"), mpm.Displacement("bottom", (0, 0), "y")]
    fluid, walls = mpm.Fluid(density=1000.0, bulk=np.inf, gravity=10.0), {"left": "x", "right": "x"}
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=conditions, fluid=fluid, inertia=True)
    for _ in range(3):
        assert s.step(0.1 / steps).newton <= 4


def test_newton_takes_one_step_in_each_substep_of_a_column_that_drains_under_a_growing_load():
    """Newton's method took two: the linear solve was as accurate as the smaller residual before the condensation."""
    soil = mpm.Hencky(bulk=1e7 / 3, shear=5e6, conductivity=1e-4)
    grid = mpm.Grid([0, 0], [1, 1.5], [8, 12])
    conditions = [mpm.Traction("top", lambda t: (0, -20 * t)), mpm.Drained("top")]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    column, options = mpm.box(grid, [0, 0], [1, 1]), {"conditions": conditions, "fluid": mpm.Fluid()}
    s = mpm.Simulation(grid, [column], [soil], walls=walls, inertia=True, **options)
    assert [s.step(0.1).newton for _ in range(3)] == [2, 2, 2]


@pytest.mark.parametrize("bulk", [1e7, 2.2e9])
def test_undrained_waves_are_as_exact_as_dry_ones(bulk):
    """A quarter of a wave in 10 cells: the damping of pressure jumps made it too slow, by 7 % for hard water."""
    n, strain = 10, 1e-5
    law = mpm.Hencky(bulk=1e7 / 3, shear=5e6, porosity=0.5, grain_density=1500.0)
    c = np.sqrt((1e7 + 1 / law.storage(bulk, 0.5)) / 1000.0)
    grid = mpm.Grid([0, 0], [1 / n, 1 + 2 / n], [1, n + 2])
    velocity = lambda x: np.stack([0 * x[:, 0], strain * c * np.sin(np.pi / 2 * x[:, 1])], axis=1)  # noqa: E731
    walls, water = {"left": "x", "right": "x", "bottom": "y"}, mpm.Fluid(bulk=bulk, density=500.0)
    body = mpm.box(grid, [0, 0], [1 / n, 1])
    s = mpm.Simulation(grid, [body], [law], walls=walls, fluid=water, inertia=mpm.Moving(velocity))
    s.run(1 / c, 0.1 / c, progress=False)
    top = s.points.corners[:, :, 1].max() - 1
    assert top == pytest.approx(strain * 2 / np.pi, rel=1e-3)


@pytest.mark.parametrize("steps", [1e-3, 1.0])
def test_a_side_that_accelerates_carries_the_mass_of_its_block(steps):
    """A quarter of a wave: the reaction of the exact block.  In short steps the side stayed where it was."""
    c, h, a = np.sqrt(50e6 / 2000), 0.1, 10.0
    grid = mpm.Grid([0, 0], [1.0, h], [10, 1])
    body, walls = mpm.box(grid, [0.23, 0], [0.63, h]), {"bottom": "y", "top": "y"}
    law = mpm.Hencky(bulk=50e6 / 3, shear=25e6, porosity=0.5, grain_density=4000.0)
    push = mpm.Displacement("left", lambda t: (a * t**2 / 2, 0), "x")
    s, dt = mpm.Simulation(grid, [body], [law], walls=walls, conditions=[push], inertia=True), steps * h / c
    for _ in range(4):
        s.step(dt)
    moved = s.points.corners[:, :, 0].min() - 0.23
    assert moved == pytest.approx(a * s.t**2 / 2, rel=1e-3)


@pytest.mark.parametrize("held", [False, True])
def test_soil_with_an_initial_stress_may_have_inertia_from_the_start_or_from_a_stage_on(held):
    """While the stress was balanced, the tangent had no room for the mass of partly full cells: PETSc refused it."""
    grid, law = mpm.Grid([0, 0], [1.2, 1.8], [6, 9]), mpm.Hencky(bulk=1e7, shear=6e6)
    body = mpm.box(grid, [0, 0.25 * held], [1.2, 1.29])
    walls = {"left": "x", "right": "x"} | ({} if held else {"bottom": "y"})
    foot = [mpm.Displacement("bottom", (0, 0), "y")] if held else []
    load = mpm.Traction("top", lambda t: (0, -1e6 * t), ([-1, 1], [0.5, 2]))
    options = {"conditions": [load, *foot], "gravity": (0, -9.81), "initial_stress": mpm.K0(0.5)}
    both = [mpm.Simulation(grid, [body], [law], walls=walls, inertia=begins, **options) for begins in (True, False)]
    both[1].stage(inertia=True)
    for s in both:
        for _ in range(3):
            s.step(1e-3)
    moved = (both[0].points.x - body.corners().mean(axis=1))[:, 1].min()
    assert moved < -1e-7 and np.abs(both[0].points.x - both[1].points.x).max() < 1e-6 * -moved


def test_a_fill_comes_at_rest():
    grid = mpm.Grid([0, 0], [1, 2], [4, 8])
    bodies = [mpm.box(grid, [0, 0], [1, 0.5]), mpm.Later(mpm.box(grid, [0, 0.5], [1, 1]))]
    walls = {"left": "x", "right": "x"}
    s = mpm.Simulation(grid, bodies, [BLOCK], walls=walls, inertia=mpm.Moving((0, 0.1)))
    s.stage(add=[1])
    fill = s.points.id >= len(bodies[0])
    assert (s.points.velocity[fill] == 0).all() and (s.points.velocity[~fill, 1] == 0.1).all()


def test_a_resumed_flight_has_the_same_bits(tmp_path):
    def scene():
        return turning(h=0.5)

    one, other = scene(), scene()
    one.run(0.4, 0.1, checkpoint=mpm.Checkpoint(tmp_path / "flight.npz"), progress=False)
    mpm.resume(other, tmp_path / "flight.npz")
    for s in (one, other):
        s.run(0.8, 0.1, progress=False)
    assert np.array_equal(one.points.x, other.points.x)
    assert np.array_equal(one.points.velocity, other.points.velocity)


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"inertia": (1, 0)}, "inertia = "),
        ({"inertia": 1}, "inertia"),
        ({"inertia": mpm.Moving((1, 0, 0))}, "velocity"),
        ({"inertia": mpm.Moving(lambda X: X)}, "velocity"),
        ({"inertia": True, "numerics": mpm.Numerics(quadrature="point")}, "quadrature"),
        (
            {"inertia": True, "conditions": [mpm.Tool(mpm.HalfSpace((0, 2), (0, -1)), load=1.0, direction=(0, -1))]},
            "no mass",
        ),
    ],
)
def test_what_is_no_inertia_is_refused(options, names):
    grid = mpm.Grid([0, 0], [1, 1], [4, 4])
    with pytest.raises(ValueError, match=names):
        mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.5, 0.5])], [BLOCK], walls={"left": "xy"}, **options)


def test_a_scene_without_inertia_has_none_of_its_forms_and_gets_none():
    s = column(inertia=None)
    assert s.scene.momentum.inertia is None and "velocity" not in s.points.data
    with pytest.raises(ValueError, match="inertia=False"):
        s.stage(inertia=True)


def test_dry_bodies_without_mass_are_refused():
    """Their velocities grew from step to step."""
    grid, soil = mpm.Grid([0, 0], [1, 1], [4, 4]), mpm.Hencky(bulk=1e6, shear=6e5, grain_density=0.0)
    with pytest.raises(ValueError, match="material 0: grain_density = 0, must be > 0"):
        mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.5, 0.5])], [soil], walls={"left": "xy"}, inertia=True)


def test_factors_of_safety_are_of_bodies_without_inertia():
    with pytest.raises(ValueError, match="inertia=False"):
        mpm.factor_of_safety(turning())


def test_steps_by_error_meet_it():
    """A column vibrates for two periods. The error of each step meets the tolerance; the phase error is fifteen times
    it.

    Both errors decrease with rtol as for steps of second order.
    """
    c, period = 188.712839, 40 / 188.712839
    velocity = lambda x: np.stack([0 * x[:, 0], 1e-2 * np.sin(np.pi * x[:, 1] / 20)], axis=1)  # noqa: E731
    found, fine = [], column(mpm.Moving(velocity), n=6)
    fine.run(2 * period, period / 120, progress=False)
    for rtol in (2e-2, 5e-3):
        s = column(mpm.Moving(velocity), n=6)
        result = s.run(2 * period, rtol=rtol, progress=False)
        off = np.abs(s.points.displacement - fine.points.displacement).max() / (1e-2 * 20 / np.pi / c)
        found.append((off / rtol, result.steps))
    assert all(10 < off < 20 for off, _ in found) and 1.7 < found[1][1] / found[0][1] < 2.2


@pytest.mark.parametrize("frame", [0.5, 50.0])
def test_steps_by_error_are_the_same_in_a_frame_that_moves_uniformly(frame):
    """A bar vibrates with velocities of 0.05 m/s, and flies by up to 400 cells.  Steps of a size relative to the whole
    velocity would be up to three times as few, and the error ten times as large."""

    def steps(speed):
        grid = mpm.Grid([0, 0], [1.8 + 0.8 * speed, 0.1], [18 + round(8 * speed), 1])
        bar = mpm.box(grid, [0.23, 0], [1.23, 0.1])
        law = Bar(bulk=1 / 3, shear=0.5, grain_density=2.0, porosity=0.5)
        velocity = lambda x: np.stack([speed + 0.05 * np.cos(np.pi * (x[:, 0] - 0.23)), 0 * x[:, 1]], axis=1)  # noqa: E731
        walls = {"bottom": "y", "top": "y"}
        s = mpm.Simulation(grid, [bar], [law], walls=walls, inertia=mpm.Moving(velocity))
        return np.diff(s.run(0.8, rtol=1e-3, progress=False).t)[:-2]  # the last two are fitted to the end

    still = steps(0.0)
    assert len(still) == 16 and steps(frame) == pytest.approx(still, rel=0.1)


def test_steps_by_error_of_a_body_at_rest_grow():
    """No Newton step, and therefore no tangent, was needed: PETSc raised an error."""
    s = column(conditions=[mpm.Traction("top", lambda t: (0, -1e3 * (t > 1)))])
    assert s.run(1.0, rtol=1e-3, progress=False).steps < 10 and not s.points.displacement.any()


def in_frame(length=1.0, mass=1.0, time=1.0, order=(0, 1), sign=(1, 1), wet=False):
    """Return positions, divided by the length, and J of a rotating block after some steps, in its own frame.

    order, sign: order and signs of the axes of the rotated and mirrored scene.
    """
    order, sign, stress = list(order), np.array(sign), mass / (length * time**2)
    size, low, high = (length * np.array(x)[order] for x in ([4.0, 3.0], [0.6, 0.7], [1.6, 1.2]))
    low, high = (np.where(sign > 0, one, size - other) for one, other in ((low, high), (high, low)))

    def own(x):
        return (np.where(sign > 0, x, size - x) / length)[:, order]

    def velocity(x):
        off = own(x) - [1.1, 0.95]
        return np.stack([0.3 - off[:, 1], 0.2 + off[:, 0]], axis=1)[:, order] * sign * length / time

    law = mpm.NeoHookean(
        bulk=1e3 / 1.2 * stress,
        shear=1e3 / 2.6 * stress,
        grain_density=2 * mass / length**3,
        porosity=0.5,
        conductivity=1e-3 * length / time if wet else 0.0,
    )
    water = mpm.Fluid(density=mass / length**3, bulk=1e5 * stress, gravity=9.81 * length / time**2)
    grid = mpm.Grid([0, 0], size, np.array([16, 12])[order])
    body = mpm.box(grid, low, high)
    options = {"fluid": water} if wet else {}
    s = mpm.Simulation(grid, [body], [law], walls={}, inertia=mpm.Moving(velocity), numerics=TIGHT, **options)
    for _ in range(3):
        s.step(0.1 * time)
    rows = np.lexsort(np.round(own(s.points.reference.mean(axis=1)), 6).T)
    return own(s.points.x)[rows], s.points.J[rows]


@pytest.mark.parametrize("wet", [False, True])
@pytest.mark.parametrize(
    "frame",
    [{"length": 1e3}, {"length": 1e-4}, {"mass": 1e6}, {"time": 86400.0}, {"sign": (-1, 1)}, {"order": (1, 0)}],
    ids=["length x 1e3", "length x 1e-4", "mass x 1e6", "time x 86400", "mirrored", "turned"],
)
def test_a_flight_is_the_same_in_other_units_mirrored_and_turned(frame, wet):
    for found, asked in zip(in_frame(**frame, wet=wet), in_frame(wet=wet), strict=True):
        assert found == pytest.approx(asked, rel=1e-10)


def test_a_body_far_away_changes_nothing():
    alone, found = turning(), []
    grid, centre = alone.grid, np.array([1.1, 0.95])
    bodies = [mpm.box(grid, [0.6, 0.7], [1.6, 1.2]), mpm.box(grid, [2.9, 2.0], [3.4, 2.5], material=1)]
    stiff = mpm.NeoHookean(bulk=1e9, shear=1e9, grain_density=8e3)

    def velocity(x):
        off = x - centre
        return np.where(x[:, :1] < 2.4, np.stack([0.3 - off[:, 1], 0.2 + off[:, 0]], axis=1), [[-0.1, 0.05]])

    both = mpm.Simulation(grid, bodies, [BLOCK, stiff], walls={}, inertia=mpm.Moving(velocity), numerics=TIGHT)
    for s in (alone, both):
        for _ in range(4):
            s.step(0.05)
        found.append(s.points.x[: len(bodies[0])])
    assert found[1] == pytest.approx(found[0], abs=1e-9)


@pytest.mark.parametrize("off", [0.0, 0.4])
def test_stresses_do_not_oscillate_at_surfaces_on_grid_lines(off):
    """Shear of a layer between rollers: the normal stress vanishes. On lines, it was 7 % of the shear stress."""
    grid = mpm.Grid([0, 0], [2.5, 2.0], [10, 8])
    body = mpm.box(grid, [0.5, 0.25 * (1 + off)], [2.0, 0.25 * (7 + off)])
    soil = mpm.Hencky(bulk=2e6, shear=1e6, grain_density=2600.0, porosity=0.4)
    base = mpm.Displacement("bottom", lambda t: (5e-4 * (1 - np.cos(20 * np.pi * t)), 0))
    rollers = [mpm.Displacement(side, (0, 0), "y") for side in ("left", "right")]
    s = mpm.Simulation(grid, [body], [soil], walls={}, conditions=[base, *rollers], inertia=True)
    seen = []
    s.run(0.2, 5e-3, observe=lambda s: seen.append(s.effective_stress()), progress=False)
    normal, shear = (np.sqrt(np.mean(np.array(seen)[..., 0, axis] ** 2)) for axis in (0, 1))
    assert normal < 0.035 * shear
