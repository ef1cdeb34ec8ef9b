# SPDX-License-Identifier: MIT
"""The origin of the coordinates has no effect: metres at a distance of a kilometre, national coordinates."""

from dataclasses import replace

import meshio
import numpy as np
import pytest
from test_output import fields

import mpm_dolfinx as mpm

SOIL = mpm.Hencky(bulk=1e8, shear=6e7, grain_density=2600.0, conductivity=1e-5)
FREE = "free to move as a rigid body in {} of 3 modes"
SIZES = {"1 m, 500 m away": (500.0, 1.0), "100 m in national coordinates": (5.123456789e6, 100.0)}
NAMES = {"argvalues": SIZES.values(), "ids": SIZES}


def block(origin, size, walls, **options):
    """Return a simulation of a block, half as high as wide, with a load on a part of its top, and probes.

    The grid extends beyond the block, except at the wall that fixes it.
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
    """A body up to the walls, a region that ends at the height of a side, and probes on corners."""
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
    """Earlier, faces on grid lines were closed from below, because rounding put vertices off their plane."""
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
    """Earlier, rounding of the flow between cells moved the whole no-flow body: runs with long steps gave up."""
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


AWAY = np.array([1e4, -3e4]) * 0.25  # m: cells of 0.25 m


def sealed(away, **options):
    """Return a simulation of a soft block with stiff water, and its displacements, in m, since seeding."""
    soil = mpm.Hencky(bulk=6e5, shear=4.5e5, porosity=0.34, biot=0.76)
    grid = mpm.Grid(away, np.add(away, [1.75, 1.25]), [7, 5])
    body = mpm.box(grid, away, np.add(away, [1.75, 0.95]), per_cell=3)
    walls, load = {"bottom": "y", "left": "x", "right": "x"}, mpm.Traction("top", (0, -4e3))
    water = mpm.Fluid(bulk=2.2e9)
    s = mpm.Simulation(
        grid,
        [body],
        [soil],
        fluid=water,
        walls=walls,
        conditions=[load],
        numerics=mpm.Numerics(tolerance=1e-11),
        **options,
    )
    s.run(1.0, 0.5, progress=False)
    return s, s.state.points.displacement


def test_hard_water_in_soft_soil_loses_no_digits_far_from_the_origin():
    """Earlier, rounding of coordinates times the undrained modulus exceeded the tolerance, and the run gave up."""
    (near, moves), (far, others) = sealed(np.zeros(2)), sealed(AWAY)
    assert np.abs(moves).max() < 1e-5, "the water is hard"
    assert np.abs(others - moves).max() < 1e-9 * np.abs(moves).max()
    assert np.abs(far.points.pressure - near.points.pressure).max() < 1e-9 * near.points.pressure.max()
    assert far.points.x == pytest.approx(near.points.x + AWAY, rel=1e-15)


@pytest.mark.parametrize("kind", ["ball", "function"])
def test_tools_and_contacts_press_far_from_the_origin_as_near_it(kind):
    forces, digits = [], 1e-11 if kind == "ball" else 1e-8  # a function of places has not more of them
    for away in (np.zeros(2), AWAY):
        grid = mpm.Grid(away, np.add(away, [2.0, 1.5]), [8, 6])
        base, block = (
            mpm.box(grid, away, np.add(away, [2.0, 0.6])),
            mpm.box(grid, np.add(away, [0.6, 0.6]), np.add(away, [1.3, 1.0])),
        )
        centre = np.add(away, [0.95, 1.25])
        shape = mpm.Ball(centre, 0.25) if kind == "ball" else lambda x, c=centre: np.hypot(*(x - c).T) - 0.25
        tool = mpm.Tool(shape, lambda t: (0.01 * t, -0.02 * t), centre=centre, friction=0.3)
        walls, groups = {"bottom": "xy", "left": "x", "right": "x"}, [mpm.Contact(1, 0, friction=0.3)]
        s = mpm.Simulation(
            grid,
            [base, block],
            [SOIL],
            walls=walls,
            conditions=[tool, *groups],
            numerics=mpm.Numerics(tolerance=digits),
        )
        s.run(1.0, 0.5, progress=False)
        forces.append(s.tool_forces.array)
    moment, at_origin = forces[1][1, 2], np.cross(AWAY, forces[1][1, :2])  # of its own force, which has `digits`
    assert moment - forces[0][1, 2] == pytest.approx(at_origin, rel=1e-9), "moments of contacts count from the origin"
    forces = [f.ravel()[:5] for f in forces]
    assert np.abs(forces[0][:2]).max() > 1e5
    assert np.abs(forces[1] - forces[0]).max() < 1e3 * digits * np.abs(forces[0]).max()


def test_functions_are_asked_at_true_places_and_results_are_there(tmp_path):
    """All functions of position of a scene, and all of its results, far from the origin."""
    low, high, seen = AWAY, np.add(AWAY, [1.0, 1.5]), {}

    def at(name, value):
        def of(x, *_):
            seen.setdefault(name, []).append(np.array(x)[..., :2].reshape(-1, 2))
            return np.broadcast_to(value, (len(x), *np.shape(value)))

        return of

    grid = mpm.Grid(low, high, [4, 6])
    body = mpm.mapped(grid, mpm.box(grid, low, np.add(low, [1.0, 0.9])), lambda x: (at("map", 0.0)(x), x)[1])
    fill = mpm.box(grid, np.add(low, [0, 0.9]), np.add(low, [1.0, 1.2]))
    law = {"conductivity_law": lambda conductivity, x: conductivity * (1 + (x[0] - low[0]) ** 2)}
    soil = mpm.Hencky(bulk=lambda X: at("field", 2e6)(X), shear=1e6, conductivity=1e-5, **law)
    traction = mpm.Traction("top", lambda t, X, x: (at("X", 0.0)(X), at("x", 0.0)(x), (0, -1e3))[-1])
    drained = mpm.Drained("top", lambda t, x: at("drained", 100.0)(x))
    s = mpm.Simulation(
        grid,
        [body, mpm.Later(fill)],
        [soil],
        fluid=mpm.Fluid(),
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[traction, drained],
        gravity=(0, -9.81),
        pressure=at("pressure", 100.0),
        initial_stress={0: at("stress", [-1e3, -2e3, -1e3])},
        terms=[lambda points, v: -1e3 * (points.position[0] - low[0]) * points.value(v)[1] * points.dx],
    )
    probes = mpm.probes([body, fill], np.add(low, [[0.3, 0.4]]))
    writer = mpm.Writer(s, tmp_path, grid=True)
    result = s.run(1.0, 0.5, probes=probes, observe=writer, progress=False)
    s.stage(add=[1])
    s.run(2.0, 0.5, progress=False)
    for name, places in seen.items():
        x = np.concatenate(places)
        assert ((x >= low - 1e-6) & (x <= high + 1e-6)).all(), name
    assert seen.keys() == {"map", "field", "X", "x", "drained", "pressure", "stress"}
    files = [meshio.read(file).points[:, :2] for file in tmp_path.glob("points/*.vtu")]
    grids = [fields(file)["x"].reshape(-1, 3)[:, :2] for file in tmp_path.glob("grid/*_p0_000000.vtu")]
    assert len(files) == 3 and len(grids) == 2
    assert grid.mesh.geometry.x[:, :2].max() == pytest.approx(1.5), "after it is written the mesh is what it was"
    places = (s.points.x, *s.points.corners, *s.points.reference, s.cells().x, np.concatenate(result.position))
    for x in (*places, *files, *grids):
        assert ((x >= low - 1e-6) & (x <= high + 1e-6)).all()
    assert result.position[-1] - result.displacement[-1] == pytest.approx(probes.x0, rel=1e-14)


def test_points_at_true_places_are_no_state():
    """In a state these points would silently be at other positions."""
    grid = mpm.Grid([0, -1], [1, 1], [4, 8])
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.5])], [SOIL], walls={"left": "xy"})
    with pytest.raises(ValueError, match="from_base"):
        replace(s.state, points=s.points)
    again = replace(s.state, points=s.points.from_base(grid.base))
    assert np.array_equal(again.points.corners, s.state.points.corners)
