# SPDX-License-Identifier: MIT
"""Free water at bodies: buoyancy, and pressures that remain when the water falls."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

WEIGHT = 9810.0
MUD = {"bulk": 2e6, "shear": 1e6, "porosity": 0.4, "conductivity": 1e-5}


def bank(level, h=0.25):
    """Return a block of 1 m in water up to a level, under gravity."""
    grid = mpm.Grid([0, 0], [3.0, 2.0], [round(3 / h), round(2 / h)])
    body = mpm.box(grid, [1, 0], [2, 1])
    loads, heads = zip(*(mpm.water(side, level) for side in ("left", "right", "top")), strict=True)
    return mpm.Simulation(
        grid,
        [body],
        [mpm.Hencky(grain_density=1000.0, **MUD)],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        conditions=[*loads, *heads],
        gravity=lambda t: (0, -9.81 * min(1.0, t / 10)),
    )


@pytest.mark.parametrize("h", [0.25, 0.125])
def test_soil_as_heavy_as_water_hardly_moves_in_still_water(h):
    """Pressures balance it at any position of its sides. The rest, due to constant cell pressures, decreases with h."""
    s = bank(lambda t: 1.5 * min(1.0, t / 10), h=h)
    s.run(2e4, 1e3, progress=False)
    points = s.points
    assert points.pressure == pytest.approx(WEIGHT * (1.5 - points.x[:, 1]), abs=1e-3 * WEIGHT)
    moved = np.abs(points.x - points.origin.mean(axis=1)).max()
    assert moved < 0.15 * h * WEIGHT / (2 * (2e6 + 4e6 / 3))  # what soil without water would settle by
    assert np.abs(s.effective_stress()).max() < 0.2 * h * WEIGHT


def test_heavier_soil_under_water_carries_its_weight_less_the_waters():
    grid = mpm.Grid([0, 0], [0.5, 2.0], [2, 16])
    body = mpm.box(grid, [0, 0], [0.5, 1.0])
    load, head = mpm.water("top", 1.5)
    s = mpm.Simulation(
        grid,
        [body],
        [mpm.Hencky(grain_density=2650.0, **{**MUD, "bulk": 2e8, "shear": 1e8})],
        fluid=mpm.Fluid(),
        walls={"bottom": "y", "left": "x", "right": "x"},
        conditions=[load, head],
        gravity=(0, -9.81),
    )
    s.run(2e5, 2e4, progress=False)
    y = s.points.x[:, 1]
    buoyant = 0.6 * 1650 * 9.81
    assert s.effective_stress()[:, 1, 1] == pytest.approx(-buoyant * (1 - y), rel=1e-3)
    assert s.points.pressure == pytest.approx(WEIGHT * (1.5 - y), rel=1e-3)


def test_water_that_falls_leaves_a_seepage_face():
    """Rapid drawdown: pore pressures lag behind, water leaves the formerly wet side, and none enters above."""
    s = bank(lambda t: 1.0 if t <= 1e3 else max(0.25, 1.0 - (t - 1e3) / 2e3))
    s.run(1e3, 1e2, progress=False)
    full = s.points.pressure.copy()
    s.run(2.5e3, 1e2, progress=False)
    left, right, top = s.outflows.array
    assert left == pytest.approx(right, rel=1e-6) and left > 0 and top >= 0
    y, p = s.points.x[:, 1], s.points.pressure
    middle = (np.abs(s.points.x[:, 0] - 1.5) < 0.2) & (y < 0.2)
    assert (p[middle] < full[middle]).all() and (p[middle] > WEIGHT * (0.25 - y[middle])).all()


def test_water_that_is_not_as_heavy_as_the_pores_is_named(warned):
    """Sea water in the pores, fresh water on the sides: earlier, water silently infiltrated the soil."""
    grid = mpm.Grid([0, 0], [0.5, 2.0], [2, 8])
    cases = [(1000.0, 9810.0, 9.8, 0), (1025.0, 9810.0, 9.81, 2), (1025.0, 10055.0, 9.81, 0)]
    for density, unit_weight, g, named in cases:
        load, head = mpm.water("top", 1.5, unit_weight=unit_weight)
        s = mpm.Simulation(
            grid,
            [mpm.box(grid, [0, 0], [0.5, 1.0])],
            [mpm.Hencky(**MUD)],
            fluid=mpm.Fluid(density=density),
            walls={"bottom": "y", "left": "x", "right": "x"},
            conditions=[load, head],
            gravity=(0, -g),
            pressure=mpm.hydrostatic(1.5, unit_weight),
        )
        said = [message for message in warned() if "unit_weight" in message]
        assert len(said) == named, said
    s.stage(conditions=[load, mpm.water("top", 1.2, unit_weight=9810.0)[1]])
    (message,) = warned()
    assert message.startswith("water at 'top': unit_weight = 9810 N/m^3") and "is 10055.2" in message


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"level": np.nan}, "water: level = nan"),
        ({"level": 1.0, "unit_weight": 0.0}, "water: unit_weight = 0"),
        ({"level": 1.0, "side": 3}, "side = 3"),
    ],
)
def test_water_that_is_none_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        load, head = mpm.water(**{"side": "top", **arguments})
        bank_with = {"conditions": [load, head]}
        grid = mpm.Grid([0, 0], [1.0, 1.0], [2, 2])
        body, soil = mpm.box(grid, [0, 0], [1, 0.5]), mpm.Hencky(**MUD)
        mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls={"bottom": "xy"}, **bank_with)


def test_a_level_that_a_function_does_not_give_is_refused_by_its_step():
    with pytest.raises(ValueError, match=r"level at t = .* s = nan, must be a finite number"):
        bank(lambda t: np.nan).run(1.0, 1.0, progress=False)
