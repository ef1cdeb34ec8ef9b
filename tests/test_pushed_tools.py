# SPDX-License-Identifier: MIT
"""Tools under a load move until the bodies resist with the same force."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

SOIL = mpm.Hencky(bulk=1e6, shear=0.6e6, conductivity=1e-6)
BALL = mpm.Ball((1.0, 1.3), 0.3)


def layer(*tools, wet=False, material=SOIL, **options):
    """Return a layer, 2 m wide and 1 m high, on a rough floor."""
    grid = mpm.Grid([0, 0], [2.0, 1.5], [16, 12])
    water = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")]} if wet else {}
    options.setdefault("walls", {"left": "x", "right": "x", "bottom": "xy"})
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [2, 1])],
        [material],
        conditions=[*tools, *options.pop("conditions", []), *water.pop("conditions", [])],
        **water,
        **options,
    )


def pushed(load, shape=BALL, **options):
    return mpm.Tool(shape, load=load, direction=(0, -2), **options)


def test_a_plate_compresses_a_column_by_its_load():
    """Hencky's law: the stress P J, with P = M ln(J) / J, equals the load."""
    s = layer(
        pushed(lambda t: 2e5 * t, mpm.HalfSpace((0, 1.0), (0, -1))), walls={"left": "x", "right": "x", "bottom": "y"}
    )
    s.run(1.0, 0.25)
    height = 1 - s.tool_travel.array[0]
    assert SOIL.oedometric * np.log(height) / height == pytest.approx(-1e5, rel=2e-3)  # contact gives way by 5e-4 h
    assert s.effective_stress()[:, 1, 1] == pytest.approx(np.full(len(s.points), -1e5), rel=1e-6)
    assert s.tool_forces.array[0, :2] == pytest.approx([0, -2e5], rel=1e-6)


@pytest.mark.parametrize("friction, wet", [(0.0, False), (0.3, True)])
def test_a_load_pushes_as_far_as_the_force_of_a_path_says_in_as_many_newton_steps(friction, wet):
    led = layer(mpm.Tool(BALL, displacement=lambda t: (0, -0.05 * t), friction=friction), wet=wet)
    forces = [0.0]
    led.run(1.0, 1 / 16, observe=lambda s: forces.append(-s.tool_forces.array[0, 1]))
    s = layer(pushed(lambda t: float(np.interp(16 * t, np.arange(17), forces)), friction=friction), wet=wet)
    s.run(1.0, 1 / 16)
    assert s.tool_travel.array[0] == pytest.approx(0.05, rel=3e-3)
    assert -s.tool_forces.array[0, 1] == pytest.approx(forces[-1], rel=1e-6)
    assert s.result.newton <= 1.2 * led.result.newton


def test_a_tool_comes_back_as_its_load_goes():
    s, seen = layer(pushed(lambda t: 3e4 * max(0.0, 1 - abs(t - 1)))), []
    s.run(2.25, 0.25, observe=lambda s: seen.append((s.tool_travel.array[0], -s.tool_forces.array[0, 1])))
    travel, force = np.array(seen).T
    assert force == pytest.approx(3e4 * np.maximum(0, 1 - np.abs(0.25 * np.arange(1, 10) - 1)), rel=1e-6, abs=1e-6)
    assert travel.argmax() == 3 and travel[-1] < 0.05 * travel.max()


def test_a_constant_load_is_kept_while_the_layer_drains():
    s, seen = layer(pushed(lambda t: 3e4 * min(1, t / 10)), wet=True), []
    s.run(
        1e4,
        rtol=mpm.Adaptive(1e-2, first_step=1.0),
        observe=lambda s: seen.append((s.t, s.tool_travel.array[0], -s.tool_forces.array[0, 1])),
    )
    t, travel, force = np.array(seen).T
    assert force == pytest.approx(3e4 * np.minimum(1, t / 10), rel=2e-6)
    assert (np.diff(travel[t > 10]) > 0).all() and travel[-1] > 1.5 * travel[np.searchsorted(t, 10)]


def test_a_plate_under_a_load_slips_at_its_friction():
    plate = mpm.Convex([(0.6, 1.0), (1.4, 1.0), (1.4, 1.3), (0.6, 1.3)])
    s = layer(pushed(lambda t: 2e4 * min(t, 1), plate, friction=0.3, displacement=lambda t: (0.02 * max(0, t - 1), 0)))
    s.run(3.0, 0.25)
    assert s.tool_forces.array[0, :2] == pytest.approx([6e3, -2e4], rel=1e-6)


def test_two_loads_squeeze_a_body_between_them():
    left = mpm.Tool(mpm.HalfSpace((0.2, 0), (1, 0)), load=lambda t: 1e4 * t, direction=(1, 0))
    right = mpm.Tool(mpm.HalfSpace((1.2, 0), (-1, 0)), load=lambda t: 1e4 * t, direction=(-1, 0))
    grid = mpm.Grid([0, 0], [1.5, 1.0], [15, 10])
    s = mpm.Simulation(
        grid, [mpm.box(grid, [0.2, 0], [1.2, 0.5])], [SOIL], walls={"bottom": "y"}, conditions=[left, right]
    )
    s.run(1.0, 0.5)
    assert s.tool_forces.array[:, 0] == pytest.approx([1e4, -1e4], rel=1e-6)
    stress = s.effective_stress()[:, 0, 0]
    assert stress == pytest.approx(np.full(len(stress), stress.mean()), rel=1e-3)


def test_tools_beside_each_other_each_meet_their_load():
    """The tools act on each other through the layer. Plates have a common cell."""
    balls = [pushed(lambda t, k=k: (2e3 + 4e3 * k) * t, mpm.Ball((0.4 + 0.6 * k, 1.15), 0.15)) for k in range(3)]
    ends = [(0.0, 0.99), (1.01, 2.0)]
    corners = [[(a, 1.0), (b, 1.0), (b, 1.3), (a, 1.3)] for a, b in ends]
    plates = [pushed(lambda t, load=load: load * t, mpm.Convex(c)) for c, load in zip(corners, (1e5, 2e4), strict=True)]
    for tools, loads in ((balls, [2e3, 6e3, 1e4]), (plates, [1e5, 2e4])):
        s = layer(*tools)
        s.run(1.0, 0.25)
        assert -s.tool_forces.array[:, 1] == pytest.approx(loads, rel=2e-6)
        other = layer(*tools[::-1])
        other.run(1.0, 0.25)
        assert other.tool_travel.array == pytest.approx(s.tool_travel.array[::-1], abs=1e-9)


@pytest.mark.parametrize("load", [1e3, 0.1, 1e-6])
def test_a_light_tool_lies_on_a_heavy_layer(load):
    """Solvers have a tolerance relative to the layer's weight. The plate moves with the layer, even if it is very
    light.
    """
    heavy = mpm.Hencky(bulk=1e6, shear=0.6e6, grain_density=2700, porosity=0.4)
    rolls = {"left": "x", "right": "x", "bottom": "y"}
    options = {"walls": rolls, "gravity": (0, -9.81), "material": heavy}
    s = layer(pushed(load, mpm.HalfSpace((0, 1.0), (0, -1))), **options)
    other = layer(conditions=[mpm.Traction("top", (0, -load / 2))], **options)
    s.run(0.5, 0.25)
    other.run(0.5, 0.25)
    assert s.tool_travel.array[0] == pytest.approx(1 - other.points.corners[..., 1].max(), rel=1e-5)
    assert -s.tool_forces.array[0, 1] == pytest.approx(load, rel=1e-6, abs=1e-4)


@pytest.mark.parametrize("height", [1.0, 1.03])
def test_a_load_acts_from_the_first_step_on(height):
    """Earlier, if the initial stress had to be balanced off the grid lines, the load became a part of this stress."""
    heavy, grid = (
        mpm.Hencky(bulk=1e6, shear=0.6e6, grain_density=2700, porosity=0.4),
        mpm.Grid([0, 0], [1.0, 1.5], [8, 12]),
    )
    plate = pushed(5e3, mpm.HalfSpace((0, height), (0, -1)))
    walls, ways = {"left": "x", "right": "x", "bottom": "y"}, []
    for initial in (mpm.K0(0.5), mpm.K0(0.5, surcharge=5e3)):
        options = {"gravity": (0, -9.81), "initial_stress": initial, "walls": walls, "conditions": [plate]}
        s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, height])], [heavy], **options)
        s.run(1.0, 1.0)
        ways.append(s.tool_travel.array[0] / height)
        assert -s.tool_forces.array[0, 1] == pytest.approx(5e3, rel=1e-6)
    assert ways == pytest.approx([5e3 / SOIL.oedometric, 0.0], rel=0.03, abs=1e-5)


def test_a_load_comes_all_at_once_and_of_any_length_of_its_direction():
    """Earlier, bodies that did not move along lost contact with a ball that returned from a trial step."""
    ways = []
    for load, direction in ((3e4, (0, -1e300)), (lambda t: 3e4 * min(1, 2 * t), (0, -1e-300))):
        s = layer(mpm.Tool(BALL, load=load, direction=direction))
        s.run(1.0, 0.25)
        ways.append(s.tool_travel.array[0])
        assert -s.tool_forces.array[0, 1] == pytest.approx(3e4, rel=2e-6)
    assert ways[0] == pytest.approx(ways[1], rel=3e-3)


@pytest.mark.parametrize("x", [1.0, 0.5])
def test_a_rough_ball_begins_to_press_a_layer(x):
    """Earlier, the shear of sticking cells, alternating with zero shear, pushed the surface away."""
    ball = mpm.Ball((x, 1.15), 0.15)
    for load in (50.0, 1e3):
        s = layer(pushed(lambda t, load=load: load * t, ball, friction=0.3))
        s.run(1.0, 0.25)
        assert -s.tool_forces.array[0, 1] == pytest.approx(load, rel=2e-6)
    for way in (1e-3, 1.2e-3):  # of a path, where it had no balance
        led = [layer(mpm.Tool(ball, displacement=(0, -way), friction=mu)) for mu in (0.0, 0.3, 1.0)]
        for s in led:
            s.step(1.0)
        forces = [-s.tool_forces.array[0, 1] for s in led]
        assert forces == pytest.approx([forces[0]] * 3, rel=0.1)  # cells of which a hundredth touches


def test_a_load_drags_a_tool_as_far_as_friction_holds_it():
    """Along the surface contact alone has no stiffness, and the load is zero at first."""
    block = mpm.Convex([(0.6, 1.0), (1.4, 1.0), (1.4, 1.3), (0.6, 1.3)])
    for most, slips in ((2e3, False), (2e4, True)):
        sunk, drag = lambda t: (0, -0.02 * min(t, 1)), lambda t, most=most: most * max(0.0, t - 1)
        s = layer(mpm.Tool(block, displacement=sunk, load=drag, direction=(1, 0), friction=0.3))
        if slips:
            with pytest.raises(mpm.GaveUp, match=r"load 1[23].* N, but the reaction is 1.* N for any displacement"):
                s.run(2.0, 0.25)
        else:
            s.run(2.0, 0.25)
        assert s.tool_forces.array[0, 0] <= -0.301 * s.tool_forces.array[0, 1]
        assert slips or s.tool_forces.array[0, 0] == pytest.approx(most, rel=1e-6)


def test_steps_of_any_length_follow_a_tool_that_its_load_pushes_aside():
    """The cells in contact depend on the length of the step, and longer steps add some."""
    press = {"load": lambda t: 1e6 * min(t, 1), "direction": (0, -1)}
    ball = mpm.Tool(mpm.Ball((0.83, 1.15), 0.15), lambda t: (-4 * max(t - 1, 0), 0), **press)
    grid, soil = mpm.Grid([0, 0], [1.6, 1.4], [16, 14]), mpm.Hencky(bulk=1e7 / 3, shear=5e6)
    block, walls = mpm.box(grid, [0, 0], [1.6, 1]), {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, [block], [soil], walls=walls, conditions=[ball])
    s.run(1, 0.25, progress=False)
    for dt in (0.001, 0.03):
        state, _ = s.advanced(dt)
        assert state.outcome["tool_forces"]["tool"][1] == pytest.approx(-1e6, rel=1e-6)


def test_a_load_between_two_axes_pushes_stiff_soil_as_far_as_soft_soil():
    """A tool moves along its load only: the equation of its motion must be regular in any unit of stress."""
    found = []
    for unit in (1.0, 1e6):
        soil = mpm.Hencky(bulk=1e6 * unit, shear=0.6e6 * unit)
        tool = mpm.Tool(BALL, load=lambda t, unit=unit: 2e4 * unit * t, direction=(0.3, -1), friction=0.4)
        s = layer(tool, material=soil)
        s.run(1.0, 0.25)
        found.append((s.tool_travel.array[0], s.result.newton))
    (one, steps), (other, others) = found
    assert other == pytest.approx(one, rel=1e-9) and others == steps


def test_a_run_that_is_resumed_ends_with_the_same_bits(tmp_path):
    whole, half, again = (layer(pushed(lambda t: 2e4 * t)) for _ in range(3))
    whole.run(1.0, 0.25)
    half.run(0.5, 0.25, checkpoint=mpm.Checkpoint(tmp_path / "half"))
    again.run(1.0, 0.25, after=mpm.resume(again, tmp_path / "half"))
    assert np.array_equal(again.points.corners, whole.points.corners)
    assert np.array_equal(again.tool_travel.array, whole.tool_travel.array)


def test_a_stage_with_new_tools_lets_go_and_one_without_goes_on():
    s = layer(pushed(lambda t: 2e4 * min(t, 1)))
    s.run(1.0, 0.5)
    travel = s.tool_travel.array
    s.stage(conditions=s.conditions)
    s.run(1.5, 0.25)
    assert s.tool_travel.array == pytest.approx(travel, rel=1e-2)
    assert -s.tool_forces.array[0, 1] == pytest.approx(2e4, rel=1e-6)
    s.stage(conditions=[])
    assert not s.tool_travel


def test_a_load_that_meets_nothing_is_refused():
    with pytest.raises(mpm.GaveUp, match="load 1000 N, but there is no contact within a cell"):
        layer(pushed(1e3, mpm.Ball((1.0, 1.5), 0.3))).run(1.0, 0.5)


@pytest.mark.slow
def test_a_load_that_soil_cannot_bear_is_refused_and_what_it_bore_is_kept():
    clay = mpm.DruckerPrager(bulk=5e6, shear=1e5, friction=0.0, dilation=0.0, cohesion=1e3)
    base = mpm.Convex([(-0.5, 1.0), (0.5, 1.0), (0.5, 1.2), (-0.5, 1.2)])
    s, seen = layer(pushed(lambda t: 4e3 * t, base), material=clay), []
    with pytest.raises(mpm.GaveUp):
        s.run(2.0, 0.25, observe=lambda s: seen.append(-s.tool_forces.array[0, 1]))
    assert 2e3 * (1 - 1e-6) < seen[-1] < 4e3  # (2 + pi) c times half the width is 2.6e3


def test_a_load_pushes_along_the_axis_and_in_space():
    ring, box = mpm.Grid([0, 0], [0.75, 0.75], [6, 6], axisymmetric=True), mpm.Grid([0] * 3, [0.75] * 3, [6] * 3)
    rolls = {"bottom": "xyz", "left": "x", "right": "x", "front": "y", "back": "y"}
    for grid, size, walls, centre in (
        (ring, [0.75, 0.5], {"bottom": "xy", "right": "x"}, (0, 0.75)),
        (box, [0.75, 0.75, 0.5], rolls, (0.375, 0.375, 0.75)),
    ):
        down = (0,) * (grid.dim - 1) + (-1,)
        tool = mpm.Tool(mpm.Ball(centre, 0.25), load=lambda t: 2e3 * t, direction=down)
        body = mpm.box(grid, [0] * grid.dim, size)
        s = mpm.Simulation(grid, [body], [SOIL], walls=walls, conditions=[tool])
        s.run(1.0, 0.5)
        assert s.tool_forces.array[0, grid.dim - 1] == pytest.approx(-2e3, rel=1e-6)
    with pytest.raises(ValueError, match=r"direction = .*must be along the axis"):
        aside = mpm.Tool(mpm.Ball((0, 0.75), 0.25), load=1.0, direction=(1, 0))
        mpm.Simulation(ring, [mpm.box(ring, [0, 0], [0.75, 0.5])], [SOIL], walls={"bottom": "xy"}, conditions=[aside])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"load": 1.0}, "load = 1.0 and direction = None, must be given together"),
        ({"load": np.nan, "direction": (0, -1)}, "load at t = 0 s = nan, must be"),
        ({"load": "1 kN", "direction": (0, -1)}, "load at t = 0 s = '1 kN', must be"),
        ({"load": lambda t: -1.0, "direction": (0, -1)}, "load at t = .* = -1, must be >= 0"),
        ({"load": 1.0, "direction": (0, 0)}, "direction = .*, must be a vector"),
        ({"load": 1.0, "direction": (0, 0, 1)}, "direction = .*, must have 2 components"),
    ],
)
def test_bad_loads_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        layer(mpm.Tool(BALL, **given)).run(1.0, 0.5)
