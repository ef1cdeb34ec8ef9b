# SPDX-License-Identifier: MIT
"""What acts on sides as functions of time and place: loads, heads and inflows."""

import numpy as np
import pytest
from helpers import column, rates, refused_in_one_line

import mpm_dolfinx as mpm

GRID = mpm.Grid([1.2, 1.2], [12, 12])
SOIL = mpm.Hencky(bulk=1e6, shear=6e5)
WALLS = {"left": "x", "bottom": "y"}
WEIGHT = 9810.0  # of water, N/m^3


def block(*tractions, walls=WALLS, **options):
    """Return a block that has taken a step under tractions."""
    body = mpm.box(GRID, [0, 0], [1, 1])
    s = mpm.Simulation(GRID, [body], [SOIL], fixed=walls, tractions=tractions, **options)
    s.run(1.0, 0.5, progress=False)
    return s


def test_a_traction_of_places_is_the_sum_of_those_of_regions():
    steps = [
        mpm.Traction("right", (4e3, 0), region=((0, 0), (2, 0.45))),
        mpm.Traction("right", -2e3, region=((0, 0.45), (2, 2))),
    ]
    vectors = mpm.Traction("right", lambda X: np.where(X[:, [1]] < 0.45, [4e3, 0.0], [-2e3, 0.0]))
    normal = mpm.Traction("right", lambda t, X: np.where(X[:, 1] < 0.45, 4e3, -2e3) * min(1, t + 0.5))
    apart = block(*steps).points
    for load in (
        vectors,
        normal,
    ):  # 0.45 lies within faces: where the points of integration are, it is a little blurred
        assert block(load).points.x == pytest.approx(apart.x, abs=2e-4)
    even = block(mpm.Traction("right", lambda t, X: np.full(len(X), 4e3)))
    assert even.points.x == pytest.approx(block(mpm.Traction("right", 4e3)).points.x, abs=1e-13)


def test_a_pressure_of_depth_is_exact_in_its_resultant():
    given = mpm.Displacement("left", (0, 0))
    depth = mpm.Pressure("right", lambda x: 5e3 * (1 - x[:, 1]))
    s = block(depth, displacements=[given], walls={"bottom": "y"})
    area = s.points.corners[:, [1, 3]][np.abs(s.points.reference[:, 1, 0] - 1) < 1e-9]
    y = area[:, :, 1]
    push = (5e3 * (1 - y.mean(axis=1)) * np.diff(y, axis=1)[:, 0]).sum()
    assert s.reactions[0, 0] == pytest.approx(push, rel=1e-3)


def test_a_side_under_a_level_that_rises_is_at_rest():
    """A block in water that nothing moves: total stress and pore pressure follow the level, effective stress stays."""
    level = lambda t: 1.0 + 0.5 * t  # noqa: E731
    depth = lambda t, x: WEIGHT * (level(t) - x[:, 1])  # noqa: E731
    body = mpm.box(GRID, [0, 0], [1.2, 1])
    s = mpm.Simulation(
        GRID,
        [body],
        [mpm.Hencky(bulk=1e7, shear=6e6, conductivity=1.0, grain_density=1000)],
        fluid=mpm.Fluid(density=1000, bulk=2.2e9),
        fixed={"left": "x", "right": "x", "bottom": "y"},
        gravity=(0, -9.81),
        tractions=[mpm.Pressure("top", depth)],
        drained=[mpm.Drained("top", depth)],
    )
    s.run(20.0, 2.0, progress=False)
    want = WEIGHT * (level(20.0) - s.points.x[:, 1])
    assert s.points.pressure == pytest.approx(want, rel=2e-4)
    assert np.abs(s.effective_stress()).max() < 0.01 * WEIGHT


@pytest.mark.parametrize("name", ["drained", "inflows"])
def test_heads_and_inflows_of_time_are_of_second_order(name):
    stiff = mpm.Hencky(bulk=1e9 / 3, shear=5e8, porosity=0.4, conductivity=4e-6)  # nothing moves, c = 0.4 m^2/s

    def top(steps):
        if name == "drained":
            sides = {"drained": [mpm.Drained("top", lambda t: 1e4 * np.sin(2 * t))]}
        else:
            sides = {"inflows": [mpm.Inflow("top", lambda t, X: 1e-6 * np.sin(2 * t) * np.ones(len(X)))]}
            sides["drained"] = [mpm.Drained("bottom")]
        s = column(cells=10, material=stiff, **sides)
        s.run(4.0, 4.0 / steps, progress=False)
        return s.points.pressure[s.points.x[:, 1] < 0.5]  # at the side itself the order rises to 2 later

    exact = top(160)
    errors = [np.abs(top(n) - exact).max() / np.abs(exact).max() for n in (10, 20, 40)]
    assert min(rates(errors)) > 1.8 and errors[-1] < 5e-3, errors


def test_water_flows_from_side_to_side_by_the_heads_of_its_ends():
    """A block between two heads: Darcy's flux, linear pressures, whatever the place of its ends in the grid."""
    body = mpm.box(GRID, [0.03, 0], [1.04, 1])
    k, heads = 1e-3, lambda X: np.where(X[:, 0] < 0.5, 2e4, 5e3)
    s = mpm.Simulation(
        GRID,
        [body],
        [mpm.Hencky(bulk=1e9, shear=6e8, conductivity=k)],
        fluid=mpm.Fluid(),
        fixed={"left": "x", "bottom": "xy"},
        drained=[mpm.Drained("left", heads), mpm.Drained("right", heads)],
    )
    s.run(100.0, 50.0, progress=False)
    want = 2e4 - 1.5e4 * (s.points.x[:, 0] - 0.03) / 1.01
    assert s.points.pressure == pytest.approx(want, rel=1e-3)


BAD = {
    "of another argument": (
        lambda: block(mpm.Traction("top", lambda t, depth: 1.0)),
        "Traction(side='top'",
        "t, X and x",
    ),
    "of too few places": (lambda: block(mpm.Pressure("top", lambda X: X[:3, 0])), "Pressure(side='top'", "places"),
    "of nan": (lambda: block(mpm.Traction("top", lambda x: x[:, 0] * np.nan)), "Traction(side='top'", "nan"),
    "that raise": (lambda: block(mpm.Traction("top", lambda x: 1 / 0)), "Traction(side='top'", "ZeroDivisionError"),
    "vectors of pressure": (lambda: block(mpm.Pressure("top", lambda x: x)), "Pressure(side='top'", "places"),
    "one vector for places": (lambda: block(mpm.Traction("top", lambda x: (0, 1e3))), "Traction(side='top'", "places"),
    "a word": (lambda: mpm.Drained("top", "dry"), "Drained: pressure", "'dry'"),
    "of a head": (
        lambda: column(drained=[mpm.Drained("top", lambda t: "high")]).step(1.0),
        "Drained(side='top'",
        "'high'",
    ),
}


@pytest.mark.parametrize(("make", "name", "value"), BAD.values(), ids=BAD)
def test_bad_functions_are_refused_in_one_line(make, name, value, tmp_path):
    refused_in_one_line(make, name, value, tmp_path, 400)
