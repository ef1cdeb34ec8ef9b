# SPDX-License-Identifier: MIT
"""Where the origin of the coordinates is does not matter: metres a kilometre away, national coordinates."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

SOIL = mpm.Hencky(bulk=1e8, shear=6e7, grain_density=2600.0, conductivity=1e-5)
FREE = "free to move as a rigid body in {} of 3 ways"
SIZES = {"1 m, 500 m away": (500.0, 1.0), "100 m in national coordinates": (5.123456789e6, 100.0)}
NAMES = {"argvalues": SIZES.values(), "ids": SIZES}


def block(origin, size, walls, **options):
    """Return a simulation of a block, half as high as wide and pressed on a part of its top, and probes on it.

    There is room beside it, but where a wall holds it.
    """
    lower = np.array([origin, 0.9 * origin])
    room = [[side not in walls for side in sides] for sides in (("left", "bottom"), ("right", "top"))]
    least, most = lower - 0.1 * size * np.array(room[0]), lower + size + 0.1 * size * np.array(room[1])
    grid = mpm.Grid(least, most, np.rint((most - least) / size * 10))
    body = mpm.box(grid, lower, lower + size * np.array([1, 0.53]))
    part = (lower + size * np.array([0.2, 0.53]), lower + size * np.array([0.61, 0.53]))
    load = mpm.Traction("top", -1e4, region=part)
    s = mpm.Simulation(grid, [body], [SOIL], walls=walls, conditions=[load, *options.pop("conditions", [])], **options)
    return s, mpm.probes([body], lower + np.array([[0, 0.53], [0.5, 0.53], [1, 0.2]]) * size)


@pytest.mark.parametrize("origin, size", **NAMES)
@pytest.mark.parametrize("walls", [{"bottom": "xy"}, {"left": "x", "bottom": "y"}, {"right": "xy"}])
def test_a_body_that_is_held_is_held_anywhere(origin, size, walls):
    u = []
    for where in (0.0, origin):
        s, probes = block(where, size, walls, gravity=(0, -9.81), fluid=mpm.Fluid())
        u.append(s.run(1.0, 1.0, probes=probes, progress=False).displacement[-1])
    assert u[1] == pytest.approx(u[0], abs=1e-6 * size)


@pytest.mark.parametrize("origin, size", [(0.0, 1.0), *SIZES.values()], ids=["at the origin", *SIZES])
@pytest.mark.parametrize("walls, ways", [({"left": "x"}, 1), ({"left": "y", "bottom": "x"}, 1), ({"top": "xy"}, 3)])
def test_a_body_that_is_free_is_free_anywhere(origin, size, walls, ways):
    s, _ = block(origin, size, walls)
    with pytest.raises(ValueError, match=FREE.format(ways)):
        s.run(1.0, 1.0, progress=False)


def test_each_of_two_bodies_far_from_each_other_is_looked_at():
    grid = mpm.Grid([0, 0], [600.0, 1.0], [1200, 2])
    bodies = [mpm.box(grid, [x, 0], [x + 1, 1]) for x in (0.0, 599.0)]
    for walls, free in (({"left": "xy", "right": "xy"}, False), ({"left": "xy", "right": "x"}, True)):
        s = mpm.Simulation(grid, bodies, [SOIL], walls=walls)
        if free:
            with pytest.raises(ValueError, match=r"the part at \[599.25 .*" + FREE.format(1)):
                s.run(1.0, 1.0, progress=False)
        else:
            assert s.run(1.0, 1.0, progress=False).converged


@pytest.mark.parametrize("origin", [0.0, 500.0, 5.123456789e6])
def test_what_ends_at_a_side_reaches_it_anywhere(origin):
    """A body up to the walls, a region that ends at the side's own height, probes on the corners."""
    for size in (0.7, 0.9, 1.3):
        lower = np.array([origin, 0.9 * origin])
        upper = lower + size
        grid = mpm.Grid(lower, upper, [7, 11])
        body = mpm.box(grid, lower, upper)
        load = mpm.Traction("top", -1e3, region=([lower[0], upper[1]], upper))
        s = mpm.Simulation(grid, [body], [SOIL], walls={"left": "x", "right": "x", "bottom": "y"}, conditions=[load])
        result = s.run(1.0, 1.0, probes=mpm.probes([body], [lower, upper]), progress=False)
        assert result.displacement[-1] == pytest.approx(
            np.array([[0, 0], [0, -1e3 * size / SOIL.oedometric]]), rel=1e-3
        )


@pytest.mark.parametrize("origin", [3e5, 7e5, 5.4e6])
def test_water_flows_and_rests_in_national_coordinates_as_at_the_origin(origin):
    """Faces on grid lines were closed from below: rounding of the coordinates put vertices there off their plane."""
    pressures = []
    for o in (0.0, origin):
        grid = mpm.Grid([0, o], [0.8, o + 2.6], [4, 13])
        s = mpm.Simulation(
            grid,
            [mpm.box(grid, [0, o], [0.8, o + 1.6])],
            [SOIL],
            fluid=mpm.Fluid(),
            walls={"left": "x", "right": "x", "bottom": "xy"},
            gravity=(0, -9.81),
            pressure=mpm.hydrostatic(o + 1.9),
            initial_stress=mpm.K0(0.5),
        )
        s.run(1.0, 1.0, progress=False)
        rest = s.points.pressure
        assert rest == pytest.approx(9810 * (o + 1.9 - s.points.x[:, 1]), abs=0.01)
        s.stage(conditions=[mpm.Drained("top", 1e4)])
        s.run(2.0, 0.5, progress=False)
        pressures.append(s.points.pressure - rest)
    assert pressures[0].max() > 500 and pressures[1] == pytest.approx(pressures[0], abs=1.0)  # 1e-9 m of strain


@pytest.mark.parametrize("dt", [1e3, 1e6])
def test_layers_under_water_rest_in_national_coordinates_for_any_time(dt):
    """Rounding of the flow between cells moved all of a sealed body, and this the flow: long steps gave up."""
    o = np.array([3.4e5, 3.4e5])
    grid = mpm.Grid(o, np.add(o, [0.4, 0.7]), [4, 7])
    layers = [
        mpm.box(grid, np.add(o, [0, y]), np.add(o, [0.4, top]), material=i)
        for i, (y, top) in enumerate([(0, 0.22), (0.22, 0.47)])
    ]
    soils = [mpm.Hencky(bulk=k, shear=k / 2, conductivity=1e-3) for k in (2e7, 1e7)]
    s = mpm.Simulation(
        grid,
        layers,
        soils,
        fluid=mpm.Fluid(bulk=np.inf),
        walls={"left": "x", "right": "x", "bottom": "xy"},
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(o[1] + 0.47),
        initial_stress=mpm.K0(0.5),
    )
    x, reports = s.points.x, [s.step(dt) for _ in range(2)]
    assert max(report.newton for report in reports) <= 4
    assert np.abs(s.points.x - x).max() <= 1e-9 * 0.7
    assert s.points.pressure == pytest.approx(9810 * (o[1] + 0.47 - s.points.x[:, 1]), abs=1e-3 * 9810)
