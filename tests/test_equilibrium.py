# SPDX-License-Identifier: MIT
"""Forces of walls, conditions and tools on the bodies: equilibrium with loads and weight, and exact values."""

import numpy as np
import pytest
from helpers import SOFT, beam, column, joined, without

import mpm_dolfinx as mpm
from mpm_dolfinx.conditions.walls import wall_shares
from mpm_dolfinx.grid.grid import SIDES, sum_by
from mpm_dolfinx.io.checkpoint import save

SOIL = mpm.Hencky(bulk=2e8, shear=1e8, porosity=0.4, conductivity=1e-5, grain_density=2650)
G = 9.81


def weight(s):
    """Return the weight (d,), in N, of grains and pore water, summed over the points."""
    if s.scene.gravity is None:
        return np.zeros(s.grid.dim)
    p, n = s.points, SOIL.porosity
    mass = ((1 - n) * SOIL.grain_density * p.volume0).sum()
    if s.scene.fluid is not None:
        mass += 1000 * ((p.J - (1 - n)) * p.volume0).sum()
    return np.array([*[0.0] * (s.grid.dim - 1), -mass * G])


def off(s, load=0.0, axes=slice(None)):
    """Return the resultant of all forces on the bodies, divided by the largest force."""
    d, tools = s.grid.dim, s.state.stage.of(mpm.Tool)
    pressed = [s.tool_forces[name][:d] for name in tools]
    forces = [*s.wall_reactions.values(), *s.reactions.values(), *pressed, weight(s)]
    forces = np.array([*forces, np.broadcast_to(load, d)])
    return np.abs(forces.sum(axis=0)[axes]).max() / np.abs(forces).max()


def held_and_pressed(water):
    """Return a block with nearly empty cells at two walls, with a prescribed side and a rough tool, and its load."""
    grid = mpm.Grid([0, 0], [2.2, 1.7], [11, 8])
    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [1.93, 1.1])],
        [SOIL],
        walls={"left": "xy", "bottom": "y"},
        gravity=(0, -G),
        **water
        | {
            "conditions": [
                mpm.Displacement("right", lambda t: (0, -1e-3 * t)),
                mpm.Traction("top", (3e3, -1e4)),
                mpm.Tool(mpm.Ball((1.0, 1.3), 0.2), displacement=lambda t: (0, -2e-3 * t), friction=0.3),
                *water.get("conditions", []),
            ]
        },
    )
    return s, (3e3 * 1.93, -1e4 * 1.93)


def under_a_plate(water):
    grid = mpm.Grid([0, 0], [2.2, 1.7], [11, 8])
    body, plate = mpm.box(grid, [0, 0], [1.93, 1.1]), mpm.RigidPlate("top", 1e4)
    walls = {"left": "x", "bottom": "xy"}
    return mpm.Simulation(
        grid,
        [body],
        [SOIL],
        walls=walls,
        gravity=(0, -G),
        **joined({"conditions": [plate]}, water),
    ), (0, -1e4)


def a_thin_layer(water):
    """Return a layer slightly thicker than a cell: the ghost penalty of its top acts on nodes of the floor."""
    grid, load = mpm.Grid([0, 0], [2.0, 1.0], [10, 5]), (2e3, -1e4)
    options = {"walls": {"bottom": "xy"}, "conditions": [mpm.Traction("top", load)], "gravity": (0, -G)}
    return mpm.Simulation(
        grid, [mpm.box(grid, [0.1, 0], [1.9, 0.22])], [SOIL], **joined(options, water)
    ), 1.8 * np.array(load)


def held_in_the_cells_of_a_wall(water):
    """Return a block whose prescribed top ends in the cells next to a wall, without touching the wall."""
    grid, walls = mpm.Grid([0, 0], [2.2, 1.7], [11, 8]), {"left": "x", "bottom": "xy"}
    held = mpm.Displacement("top", lambda t: (5e-4 * t, -1e-3 * t))
    body = mpm.box(grid, [0.07, 0], [1.3, 1.1])
    return mpm.Simulation(grid, [body], [SOIL], walls=walls, **joined({"conditions": [held]}, water)), (
        0,
        0,
    )


def pushed_along_a_wall(water):
    """Return a block, and a plate one cell high with a prescribed side, pushed along a rough floor."""
    grid, walls = mpm.Grid([0, 0], [2.2, 1.7], [11, 8]), {"bottom": "xy"}
    bodies = [mpm.box(grid, [0.27, 0], [0.9, 1.1]), mpm.box(grid, [1.3, 0], [1.9, 0.2])]
    near = [((0, 0), (1, 2)), ((1, 0), (2, 2))]
    sides = [mpm.Displacement("left", lambda t: (1e-2 * t, 0), "x", region=region) for region in near]
    return mpm.Simulation(
        grid,
        bodies,
        [SOIL],
        walls=walls,
        gravity=(0, -G),
        **joined({"conditions": [*sides]}, water),
    ), (0, 0)


def in_a_corner(water):
    grid = mpm.Grid([0, 0, 0], [1.1, 1.1, 1.4], [5, 5, 6])
    load, walls = (3e3, 10.0, -1e4), {"left": "xyz", "back": "y", "front": "yz", "bottom": "xz"}
    options = {"walls": walls, "conditions": [mpm.Traction("top", load)], "gravity": (0, 0, -G)}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0, 0], [0.93, 1.1, 1.03])], [SOIL], **joined(options, water))
    return s, np.array(load) * 0.93 * 1.1


def a_cylinder(water):
    grid = mpm.Grid([0, 0], [1.1, 1.4], [5, 6], axisymmetric=True)
    load = mpm.Traction("top", (0, -1e4))
    options = {"walls": {"bottom": "xy"}, "conditions": [load], "gravity": (0, -G)}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.93, 1.03])], [SOIL], **joined(options, water)), (
        0.0,
        -1e4 * np.pi * 0.93**2,
    )


def two_groups(water):
    """Return a block that slips on a thin block; contact pairs act on nodes that the floor fixes."""
    grid = mpm.Grid([0, 0], [1.0, 1.2], [10, 12])
    bodies = [mpm.box(grid, [0, 0], [0.9, 0.09]), mpm.box(grid, [0, 0.12], [0.7, 0.55])]
    push = mpm.Displacement("top", lambda t: (0, -0.04 * t), "y", region=((0, 0.5), (1, 1)))
    options = {"walls": {"left": "x", "bottom": "xy"}, "gravity": (0, -G), "conditions": [push]}
    contact = mpm.Contact(1, 0, friction=0.3)
    return mpm.Simulation(
        grid,
        bodies,
        [SOIL],
        conditions=[contact, *options.pop("conditions", [])],
        **options,
        **(water and {"fluid": mpm.Fluid()}),
    ), 0


def held_beside_walls(water, move=lambda t: (0.0, 0.0), **options):
    """Return a block with a prescribed side; the rough floor also fixes the last nodes of this side."""
    grid = mpm.Grid([0, 0], [2.0, 1.4], [8, 7])
    side = mpm.Displacement("left", move, "x")
    options = {"walls": {"right": "x", "bottom": "xy"}, "gravity": (0, -G), "conditions": [side], **options}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [2.0, 1.0])], [SOIL], **joined(options, water)), 0


def held_on_the_floor(water):
    return held_beside_walls(
        water, walls={"left": "x", "right": "x", "bottom": "xy"}, conditions=[mpm.Displacement("bottom", (0, 0))]
    )


SCENES = [held_and_pressed, under_a_plate, a_thin_layer, held_in_the_cells_of_a_wall, pushed_along_a_wall, in_a_corner]
SCENES += [a_cylinder, two_groups, held_beside_walls, held_on_the_floor]


@pytest.mark.parametrize("wet", [False, True], ids=["dry", "wet"])
@pytest.mark.parametrize("scene", SCENES)
def test_all_forces_on_the_bodies_are_in_balance(scene, wet):
    s, load = scene({"fluid": mpm.Fluid(), "conditions": [mpm.Drained("right")]} if wet else {})
    s.run(1.0, 0.5, progress=False)
    assert off(s, load, slice(1, 2) if s.grid.axisymmetric else slice(None)) < 1e-7
    assert not any(
        np.any(force) for wall, force in s.wall_reactions.items() if wall not in s.state.stage.conditions["walls"]
    )


@pytest.mark.parametrize("rest", [mpm.K0(0.5), None], ids=["initial stress", "without"])
def test_a_side_that_begins_to_move_along_a_wall_carries_what_it_does_that_moves_from_the_start(rest):
    """In an earlier version, matrices of other cells held this side: reactions were forty times too large."""
    begins, moves = (
        held_beside_walls({}, lambda t, start=start: (1e-3 * max(0.0, t - start), 0.0), initial_stress=rest)[0]
        for start in (1.0, 0.0)
    )
    before = np.zeros(2)
    for s, end in ((begins, 1.0), (begins, 1.5), (moves, 0.5)):
        s.run(end, 0.5, progress=False)
        assert off(s) < 1e-7
        before = s.reactions.array[0] if s.t == 1.0 else before
    assert begins.reactions.array[0] == pytest.approx(moves.reactions.array[0], rel=1e-2)
    assert moves.reactions.array[0, 0] > 10 * before[0]


def test_forces_on_a_held_side_and_on_the_floor_at_its_foot_are_those_of_the_stress_at_rest():
    """In an earlier version, the floor carried the part of the side's last node a second time."""
    s, _ = held_beside_walls({}, initial_stress=mpm.K0(0.5))
    s.run(1.0, 1.0, progress=False)
    assert s.reactions.array[0, 0] == pytest.approx(-weight(s)[1] / 2 * 0.5 / 2, rel=1e-6)
    assert np.abs(s.wall_reactions["bottom"][0]) < 1e-6 * s.reactions.array[0, 0]


def test_walls_of_a_column_bear_what_is_on_them():
    """Under a uniform load the force of each wall is known from the column's oedometric stress."""
    s = column(cells=5, width=2, fluid=False, conditions=[mpm.Traction("top", (0, -1e4))])
    s.run(1.0, 1.0, progress=False)
    (left, bottom), stress = (s.wall_reactions[wall] for wall in ("left", "bottom")), s.effective_stress()
    height = s.points.corners[..., 1].max()
    assert bottom == pytest.approx([0.0, 1e4 * 0.4], rel=1e-7)
    assert left == pytest.approx([-stress[0, 0, 0] * height, 0.0], rel=1e-6)
    assert s.wall_reactions["right"] == pytest.approx(-left, rel=1e-6, abs=1e-13 * bottom[1])  # rounding of the load
    assert not s.wall_reactions["top"].any()


def test_what_several_walls_hold_counts_once():
    """The wall normal to the component carries the force. Otherwise walls have equal shares, in any order."""
    grid = mpm.Grid([0] * 3, [1.0] * 3, [2] * 3)
    on_walls = np.flatnonzero((np.abs(grid.node_x[:, :2] - 0.5) > 0.4).any(axis=1))
    dofs = (3 * on_walls[:, None] + np.arange(3)).ravel()
    for order in (("left", "right", "front", "back"), ("back", "front", "right", "left")):
        shares = wall_shares(grid, dict.fromkeys(order, "xyz"), dofs)
        walls = dict(zip(SIDES[3], sum_by(dofs % 3, shares, 3), strict=True))
        for wall in ("left", "right"):  # 9 nodes, 6 of them on edges
            assert walls[wall].tolist() == [9, 3, 3 + 6 / 2]
        for wall in ("front", "back"):
            assert walls[wall].tolist() == [3, 9, 3 + 6 / 2]
        assert not walls["bottom"].any() and sum(walls.values()).sum() == len(dofs)


def test_forces_and_outflows_are_histories_of_a_run(tmp_path):
    """Steps of a beam: the clamp carries the load, one half by the wall and the other half by a prescribed side."""
    s, probe = beam(h=0.1, load=5.4e3)
    s.run(0.06, 0.02, probes=probe, progress=False)
    s.stage(
        walls={"right": "x"},
        conditions=[*without(s, mpm.Drained), mpm.Displacement("left", (0, 0)), mpm.Drained("left")],
    )
    result = s.run(0.1, 0.02, probes=probe, after=s.result, progress=False)
    t, walls = result.t, result.wall_reactions
    assert walls.keys() == {"left", "right", "bottom", "top"} and walls["left"].shape == (len(t), 2) == (6, 2)
    load = 5.4e3 * 0.95 * np.minimum(1, np.array(t) / 0.06)
    assert walls["left"][:4, 1] == pytest.approx(load[:4], rel=1e-5)
    assert not walls["left"][4:].any() and not walls["top"].any()
    clamp, drained = result.reactions["displacement_left"], result.outflows
    assert clamp.shape == (6, 2) and np.isnan(clamp[:4]).all() and clamp[4:, 1] == pytest.approx(load[4:], rel=1e-5)
    assert drained["drained_left"].shape == (6,) and np.isnan(drained["drained_right"][4:]).all()
    assert drained["drained_left"][-1] == s.outflows["drained_left"]
    assert np.array_equal(walls["left"][-1], s.wall_reactions["left"])
    save(s, tmp_path / "run.ckpt")
    again = mpm.resume(s, tmp_path / "run.ckpt")
    for name in ("reactions", "outflows", "wall_reactions"):
        of_both = again.outcome(name), result.outcome(name)
        assert all(np.array_equal(of_both[0][one], values, equal_nan=True) for one, values in of_both[1].items())


def test_the_axis_of_revolution_pushes_nothing_outward():
    grid = mpm.Grid([0, 0], [1.0, 1.0], [4, 4], axisymmetric=True)
    body = mpm.box(grid, [0, 0], [1, 1])
    options = {"walls": {"left": "y", "right": "x", "bottom": "y"}, "conditions": [mpm.Traction("top", (0, -1e4))]}
    s = mpm.Simulation(grid, [body], [SOFT], **options)
    s.run(1.0, 1.0, progress=False)
    assert s.wall_reactions["left"][0] == 0.0
    assert s.wall_reactions["left"][1] + s.wall_reactions["bottom"][1] == pytest.approx(1e4 * np.pi, rel=1e-8)
