# SPDX-License-Identifier: MIT
"""Momentum: patch tests, rigid motion, loads and weight."""

import numpy as np
import pytest
from helpers import SOFT, beam, column, set_up

import mpm_dolfinx as mpm
from mpm_dolfinx.mechanics.ghost_penalty import GHOST


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.77])
@pytest.mark.parametrize("law", [mpm.Hencky, mpm.NeoHookean])
def test_uniform_compression_is_exact_however_the_body_lies_on_the_grid(offset, law):
    material = law(bulk=2e5, shear=1e5)
    s = column(fluid=False, offset=offset, material=material, conditions=[mpm.Traction("top", lambda t: (0, -5e4 * t))])
    s.run(1.0, 0.25)
    stretch = s.points.F[:, 1, 1]
    assert np.ptp(stretch) < 1e-6, "stretch is not uniform"
    # the column's first Piola-Kirchhoff stress is the load
    lam, a = 2e5 - 2e5 / 3, stretch.mean()
    P = (lam + 2e5) * np.log(a) / a if law is mpm.Hencky else 1e5 * (a - 1 / a) + lam * np.log(a) / a
    assert pytest.approx(-5e4, rel=1e-5) == P


def test_weight_gives_the_stress_of_the_column_above():
    s = column(fluid=False, gravity=[0, -10], cells=8)
    s.run(1.0, 1.0)
    density = 0.6 * SOFT.grain_density
    strain = -density * 10 * (1 - s.points.x[:, 1]) / SOFT.oedometric
    assert s.points.F[:, 1, 1] - 1 == pytest.approx(strain, abs=0.08 * abs(strain).max())


def test_a_rotation_of_the_nodes_gives_no_force():
    s, _ = beam(fluid=False)
    momentum = set_up(s, 1e-12).momentum
    x = s.grid.node_x - [0.5, 0.7]
    angle = 0.7
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    s.scene.momentum.u.x.array[:] = (x @ R.T - x).ravel()
    _, scale = momentum.assemble_residual()
    assert scale < 1e-9 * SOFT.shear


def test_the_load_is_the_traction_times_the_area_also_where_a_domain_is_partly_loaded():
    s, _ = beam(fluid=False, ramp=1.0)
    assert set_up(s, 1.0).momentum._external.reshape(-1, 2).sum(axis=0) == pytest.approx([0, -54e3 * 0.95], rel=1e-12)


@pytest.mark.parametrize("strain", [1e-3, 1e-9])
def test_a_tiny_load_is_carried_however_stiff_a_part_of_the_body_is(strain):
    """The round-off in the stiff part exceeds the load."""
    grid = mpm.Grid([0, 0], [0.1, 1.0], [1, 10])
    bodies = [mpm.box(grid, [0, 0], [0.1, 0.5]), mpm.box(grid, [0, 0.5], [0.1, 1.0], material=1)]
    soft, hard = mpm.Hencky(bulk=1e5, shear=1e5), mpm.Hencky(bulk=1e13, shear=1e13)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    load = mpm.Traction("top", (0, -strain * soft.oedometric), region=((-np.inf, 0.9), (np.inf, np.inf)))
    s = mpm.Simulation(grid, bodies, [soft, hard], walls=walls, conditions=[load])
    result = s.run(1.0, 1.0, probes=mpm.probes(bodies, [[0.05, 1.0]]))
    assert result.displacement[-1][0, 1] == pytest.approx(-0.5 * strain, rel=2e-3)


@pytest.mark.parametrize("dt", [1.0, 1e3, 1e12, np.inf])
def test_a_step_longer_than_the_run_is_one_step(dt):
    s = column(fluid=False, conditions=[mpm.Traction("top", (0, -1e4))])
    result = s.run(1.0, dt)
    assert result.steps == 1 and s.points.F[:, 1, 1] == pytest.approx(1 - 1e4 / SOFT.oedometric, abs=1e-5)


def test_the_answer_does_not_depend_on_the_number_of_steps():
    tips = []
    for n in (10, 80):
        s, probe = beam(fluid=False, ramp=1.0, h=0.02)
        tips.append(s.run(1.0, 1 / n, probes=probe).displacement[-1][0, 1])
    assert np.ptp(tips) < 5e-4 * abs(tips[0])


def test_the_answer_does_not_depend_on_how_the_beam_lies_on_the_grid():
    tips = []
    for offset in (0.0, 0.25, 0.5):
        s, probe = beam(fluid=False, ramp=1.0, offset=offset)
        tips.append(s.run(1.0, 0.1, probes=probe).displacement[-1][0, 1])
    assert np.ptp(tips) < 5e-4 * abs(tips[0])


def test_a_large_load_is_held_for_hundreds_of_steps_without_drift():
    s, probe = beam(fluid=False, ramp=1.0, load=162e3, box=2.4)
    result = s.run(11.0, 0.05, probes=probe)
    tips = np.array(result.displacement)[20:, 0, 1]
    assert result.converged and np.ptp(tips) < 1e-3 * abs(tips[0])


def test_the_ghost_penalty_hardly_changes_the_tip(monkeypatch):
    tips = []
    for strength in (GHOST / 10, GHOST):
        monkeypatch.setattr("mpm_dolfinx.mechanics.ghost_penalty.GHOST", strength)
        s, probe = beam(fluid=False, ramp=1.0)
        tips.append(s.run(1.0, 0.1, probes=probe).displacement[-1][0, 1])
    assert tips[0] != tips[1] and np.ptp(tips) < 2e-4 * abs(tips[0])


def test_three_dimensions_equal_plane_strain():
    h, tips = 0.1, []
    for dim in (2, 3):
        grid = mpm.Grid([0] * dim, [1.2, *[h] * (dim - 2), 1.0], [12, *[1] * (dim - 2), 10])
        body = mpm.box(grid, [0, *[0] * (dim - 2), 0.45], [1, *[h] * (dim - 2), 0.75])
        walls = {"left": "xy"} if dim == 2 else {"left": "xyz", "front": "y", "back": "y"}
        load = mpm.Traction("top", lambda t, dim=dim: (*[0] * (dim - 1), -30e3 * t))
        material = mpm.NeoHookean(bulk=1e7 / 3, shear=5e6)
        s = mpm.Simulation(grid, [body], [material], walls=walls, conditions=[load])
        probe = mpm.probes([body], [[1, *[h / 2] * (dim - 2), 0.6]])
        tips.append(s.run(1.0, 0.5, probes=probe).displacement[-1][0, [0, -1]])
    assert tips[1] == pytest.approx(tips[0], rel=1e-6)


def test_the_stress_of_the_points_is_that_of_the_law():
    s = column(fluid=False, material=SOFT, conditions=[mpm.Traction("top", lambda t: (0, -2e6 * t))])
    s.run(1.0, 0.25)
    J = s.points.J
    stress = s.effective_stress()
    lam = SOFT.bulk - 2 * SOFT.shear / 3
    assert stress[:, 1, 1] == pytest.approx((lam + 2 * SOFT.shear) * np.log(J) / J, rel=1e-6)
    assert stress[:, 0, 0] == pytest.approx(lam * np.log(J) / J, abs=1e-6 * abs(stress).max())
    assert np.abs(stress[:, 0, 1]).max() < 1e-9 * np.abs(stress).max()


@pytest.mark.parametrize("offset", [0.0, 0.4])
def test_a_rigid_plate_settles_evenly_on_uneven_ground_and_carries_its_force(offset):
    grid = mpm.Grid([0, 0], [1.0, 1.4], [10, 14])
    soft, hard = mpm.Hencky(bulk=1e6, shear=6e5), mpm.Hencky(bulk=4e6, shear=2.4e6)
    top = 1 + offset / 10
    bodies = [mpm.box(grid, [0, 0], [0.5, top]), mpm.box(grid, [0.5, 0], [1, top], material=1)]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    s = mpm.Simulation(grid, bodies, [soft, hard], walls=walls, conditions=[mpm.RigidPlate("top", 1e3)])
    probes = mpm.probes(bodies, [[0.0, top], [0.3, top], [1.0, top]])
    u = s.run(1.0, 0.5, probes=probes).displacement[-1]
    assert np.ptp(u[:, 1]) < 1e-3 * abs(u[0, 1])
    stress, volume = s.effective_stress()[:, 1, 1], s.points.volume0
    assert stress @ volume / volume.sum() == pytest.approx(-1e3, rel=1e-2)
