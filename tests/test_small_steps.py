# SPDX-License-Identifier: MIT
"""With small time steps only the error of the cells remains: no diffusion, no overshoot, no checkerboard."""

from functools import cache

import numpy as np
import pytest
import small_steps as demo
from helpers import column
from terzaghi import SOIL, WATER

import mpm_dolfinx as mpm

column_error = cache(lambda *scene: demo.column(*scene).error)  # of cells, steps, way, softness


def test_at_rest_the_error_is_that_of_the_cells_from_ten_steps_on():
    errors, limit = [demo.column(10, steps).error for steps in (10, 60, 400)], demo.error_of_cells(10)
    assert max(errors) < 1.01 * limit, "long steps are damped less"
    assert errors[-1] == pytest.approx(limit, rel=0.03)


def test_the_error_of_the_cells_is_of_second_order():
    errors = np.array([demo.error_of_cells(cells) for cells in (10, 20, 40)])
    assert np.log2(errors[:-1] / errors[1:]).min() > 1.9


def test_on_the_move_the_error_does_not_grow_with_the_number_of_steps():
    few, many = (column_error(10, steps, 0.5, 0.0) for steps in (100, 200))
    assert many < 1.25 * few and many < 2 * demo.error_of_cells(10)


def test_what_the_remap_does_to_soft_water_is_of_second_order_and_not_of_the_steps():
    """The water is so soft that the skeleton stores almost nothing: the whole pressure is remapped."""
    runs = ((20, 50), (40, 50), (10, 50), (10, 100))
    coarse, fine, few, many = (column_error(*run, 0.5, 20.0) for run in runs)
    assert np.log2(coarse / fine) > 1.9
    assert many < 1.1 * few and many < demo.error_of_cells(10)


def test_soft_water_on_the_move_is_as_exact_as_hard_water():
    soft, hard = (column_error(10, 100, 0.5, softness) for softness in (1.0, 0.0))
    assert soft < hard


@pytest.mark.parametrize("dt", [1e-12, 1e-6, 1e-3, 1.0])
def test_the_first_step_overshoots_by_nothing_however_small(dt):
    """Steps in s. Q1 pressures stop overshooting at the step h^2 / (6 c_v) = 4e-3 s."""
    load = mpm.Traction("top", (0, -100.0))
    s = column(cells=20, material=SOIL, fluid=WATER, conditions=[mpm.Drained("top"), load])
    s.run(dt, dt)
    assert s.points.pressure.max() < 100 * (1 + 1e-6) and s.points.pressure.min() > 0


def test_only_the_damping_keeps_checkers_out_of_the_first_small_step():
    damped, undamped = (
        [demo.roughness(demo.strip(10, dt, law)) for dt in (1e-2, 1e-6, 1e-9)] for law in demo.LAWS.values()
    )
    assert damped[0] == undamped[0], "damped where enough flows"
    assert max(damped[1:]) < damped[0], "a small step is rougher than a long one"
    assert undamped[1] > 5 * damped[1] and undamped[2] > 5 * damped[2]


@pytest.mark.slow
def test_what_the_step_changes_falls_with_the_cells():
    """Jumps of the increment are damped, less with larger flow in a step: the change is a part of the cells' error."""
    changes = []
    for cells in (5, 10, 15):  # over the load's width
        grid = mpm.Grid([-0.2, 0], [1.4, 1], [28 * cells // 5, 4 * cells])
        soil, water = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-4), mpm.Fluid(bulk=2e7)

        def pressed(t, X):
            return np.stack([0 * X[:, 0], -4.5e5 * t * np.exp(-(((X[:, 0] - 0.5) / 0.12) ** 2))], axis=1)

        body, sunk = mpm.box(grid, [0, 0], [1, 0.6]), []
        for steps in ({"dt": 0.02}, {"dt": 0.04}, {"rtol": 1e-3}):
            s = mpm.Simulation(
                grid,
                [body],
                [soil],
                fluid=water,
                walls={"bottom": "xy"},
                conditions=[mpm.Traction("top", pressed), mpm.Drained("left"), mpm.Drained("right")],
            )
            result = s.run(1, progress=False, probes=mpm.probes([body], [[0.5, 0.6]]), **steps)
            sunk.append(result.displacement[-1][0][1])
        changes.append(np.ptp(sunk) / abs(np.mean(sunk)))
    print("settlements in 50, 25 steps and by rtol = 1e-3 differ by", ", ".join(f"{change:.2%}" for change in changes))
    assert changes[0] < 0.015 and changes[1] < 0.004 and changes[2] < 0.002
