# SPDX-License-Identifier: MIT
"""Flow with a free surface: the conductivity vanishes above it."""

import dam as demo
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import mpm_dolfinx as mpm

UPPER, LOWER, WIDTH, TOP, K = 10.0, 2.0, 9.6, 12.0, 1e-5  # m, m, m, m, m/s


def dam(cells, heads=(UPPER, LOWER), **options):
    """Return a rectangular dam of hard soil on an impervious base, `cells` cells high, with water at both sides."""
    h = TOP / cells
    grid = mpm.Grid([0, 0], [WIDTH + 2 * h, TOP + 2 * h], [round(WIDTH / h) + 2, cells + 2])
    law = mpm.unsaturated(0.5 * 9810 * h)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=K, conductivity_law=law)
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [h, 0], [WIDTH + h, TOP])],
        [soil],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        conditions=[*(mpm.water(side, level)[1] for side, level in zip(("left", "right"), heads, strict=True))],
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(UPPER),
        **options,
    )


@pytest.mark.parametrize("cells, error", [(20, 0.01), pytest.param(40, 0.005, marks=pytest.mark.slow)])
def test_a_dam_lets_through_what_dupuit_and_charny_say(cells, error):
    """Q = k (H1^2 - H2^2) / (2 L) for any free surface, which ends on a seepage face above the tail water."""
    s = dam(cells)
    s.run(600, 20, progress=False)
    flow = K * (UPPER**2 - LOWER**2) / (2 * WIDTH)
    assert s.outflows.array == pytest.approx([-flow, flow], rel=error)
    cell, h = s.cells(), TOP / cells
    left, right = (
        cell.x[(np.abs(cell.x[:, 0] - x) < h) & (cell.pressure > 0), 1].max() for x in (1.5 * h, WIDTH + 0.5 * h)
    )
    assert UPPER - 1.5 * h < left < UPPER + h and LOWER + h < right < 0.7 * UPPER


@pytest.mark.parametrize("h, error", [(1.0, 0.03), pytest.param(0.5, 0.012, marks=pytest.mark.slow)])
def test_a_well_takes_what_dupuit_and_charny_say(h, error):
    """Q = pi k (H^2 - H_w^2) / ln(R / r), with r = 1 m and R = 11 m, on cells of the radius or half of it."""
    level, r, R = 6.0, 1.0, 11.0
    grid = mpm.Grid([0, 0], [R + h, TOP + 2 * h], [round(R / h) + 1, round(TOP / h) + 2], axisymmetric=True)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, conductivity=K, conductivity_law=mpm.unsaturated(0.5 * 9810 * h))
    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [r, 0], [R, TOP])],
        [soil],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        conditions=[mpm.water("left", level)[1], mpm.water("right", UPPER)[1]],
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(UPPER),
    )
    s.run(600, 20, progress=False)
    over = s.outflows.array / (np.pi * K * (UPPER**2 - level**2) / np.log(R / r))
    print(f"cells of {h} m: flow over Dupuit's {over}")
    assert over == pytest.approx([1, -1], rel=error)


def test_between_equal_levels_water_is_at_rest():
    s = dam(10, heads=(UPPER, UPPER), initial_stress=mpm.K0(0.3))
    s.run(20, 20, progress=False)
    assert np.abs(s.outflows.array).max() < 1e-12 * K
    cell = s.cells()
    assert cell.pressure == pytest.approx(9810 * (UPPER - cell.x[:, 1]), abs=1e-6 * 9810)


@pytest.mark.parametrize("cells, error", [(20, 0.015), pytest.param(40, 0.007, marks=pytest.mark.slow)])
def test_a_free_surface_falls_as_fast_as_its_pores_drain(cells, error):
    """In a column with a prescribed head at its base: dh/dt = -k (1 - H / h) / (specific yield)."""
    k, drains, high, low, head, h = 1e-5, 0.1, 8.0, 4.0, 2.0, 10.0 / cells
    grid = mpm.Grid([0, 0], [h, 10.0 + h], [1, cells + 1])
    law = mpm.unsaturated(0.5 * 9810 * h, specific_yield=drains)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=k, conductivity_law=law)
    acting = {"conditions": [mpm.Drained("bottom", 9810 * head)], "gravity": (0, -9.81), "fluid": mpm.Fluid()}
    start = {"pressure": mpm.hydrostatic(high), "initial_stress": mpm.K0(0.5)}
    walls, numerics = {"left": "x", "right": "x", "bottom": "y"}, mpm.Numerics(method="backward-euler")
    body = mpm.box(grid, [0, 0], [h, 10])
    s = mpm.Simulation(grid, [body], [soil], walls=walls, numerics=numerics, **acting, **start)
    time = drains / k * (high - low + head * np.log((high - head) / (low - head)))
    lost, steps = [], 40
    s.run(time, time / steps, progress=False, observe=lambda s: lost.append(s.outflows["drained_bottom"]))
    assert sum(lost) * time / steps / (drains * h * (high - low)) == pytest.approx(1, abs=error)


@pytest.mark.parametrize("cells", [10, pytest.param(40, marks=pytest.mark.slow)])
def test_a_dam_with_suction_lets_through_what_dupuit_and_charny_say_with_kirchhoff_s_potential(cells):
    """Exact for any retention curve: the integral of k_r, which is linear, gives the flow between given pressures."""
    assert demo.rectangular(cells) == pytest.approx(1, abs=5e-4)


@pytest.mark.slow
def test_a_column_drains_under_suction_as_by_finite_elements_on_finer_cells():
    """The error is below 0.6 % with 40 cells, and of second order in h."""
    coarse, fine = (found / elements - 1 for found, elements in map(demo.drained, (20, 40)))
    assert abs(fine) < 6e-3
    assert abs(coarse) > 3.2 * abs(fine)


@pytest.mark.slow
def test_the_reservoir_of_the_demo_falls_as_on_finer_cells():
    """Flows on cells of 1 m and 0.5 m agree to 3 % in steady flow and after the drawdown, and to 12 % at its end."""
    coarse, fine = (np.array(demo.run(h).flows) for h in (1.0, 0.5))
    assert fine[0] == pytest.approx([-fine[0, 1], fine[0, 1]], rel=1e-4)
    assert coarse[[0, 2, 3]] == pytest.approx(fine[[0, 2, 3]], abs=0.03 * fine.max())
    assert coarse[1] == pytest.approx(fine[1], abs=0.12 * fine.max())


@pytest.mark.slow
def test_a_block_drains_to_its_side_as_boussinesq_says():
    """Dupuit's horizontal flow, while the water at the side falls from 8 m to 6 m: mean height of the free surface."""
    h, length, k, drains, end = 1.0, 40.0, 1e-5, 0.1, 3e6
    cells = 400

    def level(t):
        return np.interp(t, [0, 0.1 * end], [8.0, 6.0])

    def rate(t, y):
        y = np.concatenate([[level(t)], y])
        flow = k * (y[1:] + y[:-1]) / 2 * np.diff(y) * cells / length * np.where(np.arange(cells), 1, 2)
        return np.diff(flow, append=0.0) * cells / length / drains

    exact = solve_ivp(rate, (0, end), np.full(cells, 8.0), t_eval=[0.25 * end, 0.5 * end], method="BDF", rtol=1e-8)
    grid, law = mpm.Grid([0, 0], [length + 2, 11], [42, 11]), mpm.unsaturated(0.5 * 9810 * h, specific_yield=drains)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=k, conductivity_law=law)
    bodies = [mpm.box(grid, [h, 0], [length + h, 10])]
    acting = {"conditions": [mpm.water("left", level)[1]], "gravity": (0, -9.81), "walls": {"bottom": "xy"}}
    start = {"pressure": mpm.hydrostatic(8.0), "initial_stress": mpm.K0(0.3)}
    s = mpm.Simulation(grid, bodies, [soil], fluid=mpm.Fluid(), **acting, **start)
    for t, heights in zip(exact.t, exact.y.T, strict=True):
        s.run(t, end / 40, progress=False)
        cell = s.cells()
        x = np.clip((1 + cell.pressure / law.suction) / 2, 0, 1)
        assert (x**2 * (3 - 2 * x) * cell.volume).sum() / length == pytest.approx(heights.mean(), abs=0.03 * 2)


def test_pores_that_do_not_drain_cost_nothing():
    assert "drainage" not in dam(10).scene.pieces.pieces.sizes


@pytest.mark.parametrize(
    "arguments, said",
    [((0.0,), "suction = 0.0"), ((1e3, 1.0), "least = 1.0"), ((1e3, 0.1, 1.0), "specific_yield = 1.0")],
)
def test_what_is_no_such_law_is_refused(arguments, said):
    with pytest.raises(ValueError, match=f"unsaturated: {said}"):
        mpm.unsaturated(*arguments)


def test_more_cannot_drain_than_there_is():
    law = mpm.unsaturated(1e3, specific_yield=0.35)
    with pytest.raises(ValueError, match=r"porosity = 0\.3, must be >= the specific yield 0\.35"):
        mpm.LinearElastic(1e9, 5e8, porosity=0.3, conductivity_law=law)
