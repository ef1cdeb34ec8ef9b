# SPDX-License-Identifier: MIT
"""Contact of groups of bodies: open gaps, uniform pressure, friction, fluid, restart, and refusals."""

from itertools import pairwise

import numpy as np
import pytest
from layers import compliance, errors

import mpm_dolfinx as mpm
from mpm_dolfinx.contact.pairing import Contacts

E = 1e6  # Pa
SOIL = mpm.Hencky(bulk=E / 3, shear=E / 2, porosity=0.4, conductivity=1e-6)  # nu = 0
WALLS = {2: {"bottom": "y", "left": "x", "right": "x"}, 3: {"bottom": "z", "left": "x", "front": "y"}}


def two_blocks(
    offset=0.37,
    gap=0.01,
    path=lambda t: -0.1 * min(1, 2.5 * t, 2.5 * (1 - t)),
    dim=2,
    wet=False,
    order=1,
    tolerance=1e-8,
    **contact,
):
    """Return two blocks between walls, with their interface off the grid lines; the upper block follows a path."""
    n = 8 if dim == 2 else 3
    low, high, y = [0.0] * (dim - 1), [1.0] * (dim - 1), 0.5 + offset / n
    grid = mpm.Grid([0] * dim, [*high, 2.0], [n] * (dim - 1) + [2 * n])
    lower = mpm.box(grid, [*low, 0], [*high, y], per_cell=2)
    upper = mpm.box(grid, [*low, y + gap], [*high, y + gap + 0.5], per_cell=3)
    above = ([*low, y + gap + 0.3], [*high, 2.0])
    held = mpm.Displacement("top", lambda t, X: [*low, path(t)], region=above)
    fluid = {}
    if wet:
        drained = [mpm.Drained("top", region=above), mpm.Drained("bottom", region=([*low, 0], [*high, 0.2]))]
        fluid = {"fluid": mpm.Fluid(), "conditions": drained}
    contacts = [mpm.Contact(0, 1, **contact)]
    bodies = [lower, upper][::order]
    walls = WALLS[dim]
    return mpm.Simulation(
        grid,
        bodies,
        [SOIL],
        walls=walls,
        conditions=[held, *contacts, *fluid.pop("conditions", [])],
        numerics=mpm.Numerics(tolerance=tolerance),
        **fluid,
    )


def pressed_by(depth, height):
    """Return the stress of a body between walls after a compression by a depth."""
    return E * np.log(1 - depth / height) / (1 - depth / height)


@pytest.mark.parametrize(("cells", "distant"), [(1.9, False), (2.1, True)])
def test_groups_within_reach_of_a_step_are_paired_again(cells, distant):
    """A step moves groups by at most two cells towards each other."""
    s = two_blocks(gap=cells / 8)
    (contacts,) = (one for one in s.state.stage.acting if isinstance(one, Contacts))
    assert contacts._distant(s.points) is distant


@pytest.mark.parametrize(("dim", "offset", "order"), [(2, 0.0, 1), (2, 0.37, -1), (2, 0.98, 1), (3, 0.37, 1)])
def test_blocks_approach_touch_press_evenly_and_part(dim, offset, order):
    s = two_blocks(offset, dim=dim, order=order, tolerance=1e-12)
    forces, spread = [], []

    def see(s):
        stress = s.effective_stress()[:, -1, -1]
        forces.append((-order * s.tool_forces.array[0, dim - 1], -s.reactions.array[0, dim - 1]))
        spread.append(np.ptp(stress))

    s.run(1.0, 0.2, observe=see)
    contact, held = np.array(forces).T
    height, depth = 1 + offset / (8 if dim == 2 else 3), 0.09
    assert contact[2] == pytest.approx(-pressed_by(depth, height), rel=1e-3)
    assert contact == pytest.approx(held, rel=1e-10, abs=1e-6)
    assert contact[-1] == 0.0
    assert max(spread) < 1e-6 * contact[2]


def test_a_gap_far_below_a_cell_carries_nothing():
    s = two_blocks(gap=1e-6, path=lambda t: 0.01 * t)
    s.run(1.0, 0.5)
    assert s.tool_forces.array.tolist() == [[0.0, 0.0, 0.0]]
    assert np.abs(s.effective_stress()).max() < 1e-6
    s = two_blocks(gap=1e-6, path=lambda t: -0.5e-6 * t)
    s.run(1.0, 1.0)
    assert s.tool_forces.array.tolist() == [[0.0, 0.0, 0.0]]


def pushed(share, **contact):
    """Return the sliding distance of a block on another block, under 1 kPa and a fraction of a shear of 400 Pa, in 5
    steps.
    """
    grid = mpm.Grid([0, 0], [3, 2], [12, 8])
    lower, upper = mpm.box(grid, [0.3, 0], [2.7, 0.55]), mpm.box(grid, [1, 0.55], [1.8, 0.95], per_cell=3)
    load = mpm.Traction("top", lambda t: (share * 300 * min(t, 1), -1e3), region=([0, 0.8], [3, 2]))
    contacts = [mpm.Contact(1, 0, **contact)]
    s = mpm.Simulation(grid, [lower, upper], [SOIL], walls={"bottom": "xy"}, conditions=[load, *contacts])
    s.run(1.0, 0.25)
    assert s.tool_forces.array[0, :2] == pytest.approx([-share * 0.8 * 300, 0.8e3], rel=1e-6)
    before = s.points.x[:, 0].copy()
    s.run(2.0, 0.25, after=s.result)
    return np.abs(s.points.x[:, 0] - before).max()


@pytest.mark.parametrize("contact", [{"friction": 0.3}, {"friction": 0.1, "adhesion": 200.0}])
def test_a_block_sticks_below_what_friction_and_adhesion_bear_and_slides_above(contact):
    assert pushed(0.995, **contact) < 1e-4
    with pytest.raises(mpm.GaveUp):  # no equilibrium
        pushed(1.005, **contact)


def stack(order):
    """Return positions and forces of three stacked blocks of three groups under an inclined load, in some order of
    bodies.
    """
    grid, heights = mpm.Grid([-0.3, 0], [1.6, 2], [8, 10]), [0, 0.43, 0.97, 1.5]
    made = [([0, low], [1, high]) for low, high in pairwise(heights)]
    bodies = [mpm.box(grid, *made[i], per_cell=2 + i, material=i) for i in order]
    soils = [mpm.Hencky(bulk=e / 3, shear=e / 2) for e in (E, 100 * E, 3 * E)]
    low, mid, top = (order.index(i) for i in range(3))
    contacts = [mpm.Contact(top, mid, friction=0.1), mpm.Contact(mid, low, friction=0.3), mpm.Contact(low, top)]
    held = mpm.Displacement("top", lambda t, X: (0.02 * t, -0.1 * t), region=([0, 1.4], [1, 2]))
    s = mpm.Simulation(grid, bodies, soils, walls={"bottom": "xy"}, conditions=[held, *contacts])
    s.run(1.0, 0.5)
    start = np.cumsum([0, *(len(body) for body in bodies)])
    return np.concatenate([s.points.x[start[i] : start[i + 1]] for i in (low, mid, top)]), s.tool_forces.array


def test_three_groups_do_the_same_in_any_order():
    (x, forces), (other, exchanged) = stack([0, 1, 2]), stack([2, 0, 1])
    assert other == pytest.approx(x, abs=1e-12)
    assert exchanged == pytest.approx(forces, abs=1e-9 * E)
    assert forces[0, :2] == pytest.approx(
        forces[1, :2], abs=1e-6 * E
    )  # what the lowest bears is what the highest presses
    assert forces[2].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("stiff", "spacings"), [((100, 1), (1, 5)), ((1, 100), (1, 5)), ((100, 1), (5, 1))])
def test_a_block_over_the_seam_of_two_others_presses_them_evenly(stiff, spacings):
    """Three groups meet in one cell. Blocks are a hundred times as stiff as others, or have finer domains."""
    grid, (low, high) = mpm.Grid([0, 0], [1, 2], [8, 16]), (0.55, 1.05)
    below = [mpm.box(grid, a, b, per_cell=spacings[0]) for a, b in (([0, 0], [0.53, low]), ([0.53, 0], [1, low]))]
    above = mpm.box(grid, [0, low], [1, high], per_cell=spacings[1], material=1)
    soils = [mpm.Hencky(bulk=k * E / 3, shear=k * E / 2) for k in stiff]
    press = mpm.Traction("top", (0, -1e4), region=([0, 1], [1, 2]))
    contacts = [mpm.Contact(2, 0, friction=0.2), mpm.Contact(1, 2), mpm.Contact(0, 1)]
    walls = {"bottom": "y", "left": "x", "right": "x"}
    s = mpm.Simulation(grid, [*below, above], soils, walls=walls, conditions=[press, *contacts])
    s.run(1.0, 1.0)
    assert s.effective_stress()[:, 1, 1] == pytest.approx(np.full(len(s.points), -1e4), rel=1e-3)
    assert s.tool_forces.array[:, 1] == pytest.approx([5.3e3, -4.7e3, 0], abs=1)


@pytest.mark.parametrize(("wet", "friction"), [(False, 0.3), (True, 0.3)])
def test_contact_resumes_bit_for_bit_and_keeps_the_fluid(tmp_path, wet, friction):
    def scene():
        return two_blocks(path=lambda t: -0.1 * np.sin(np.pi * t / 1e3), wet=wet, friction=friction)

    whole, parts, resumed = scene(), scene(), scene()
    whole.run(600.0, 100.0)
    parts.run(300.0, 100.0, checkpoint=mpm.Checkpoint(tmp_path / "half.npz"))
    resumed.run(600.0, 100.0, after=mpm.resume(resumed, tmp_path / "half.npz"))
    assert whole.tool_forces.array.tobytes() == resumed.tool_forces.array.tobytes()
    assert all(a.tobytes() == b.tobytes() for a, b in zip(whole.points.arrays, resumed.points.arrays, strict=True))
    assert np.abs(whole.tool_forces.array[0, 1]) > 1e4
    if wet:
        assert whole.result.balance < 1e-8


def heap(wet=False):
    """Return a block on soil of another group, with later fills of the block's group."""
    grid, y = mpm.Grid([0, 0], [1, 2], [4, 8]), 0.5 + 0.3 / 4
    heights = [(0, y), (y, y + 0.4), (y + 0.4, y + 0.7), (y, y + 0.6)]
    bodies = [mpm.box(grid, [0, low], [1, high], per_cell=2 + i) for i, (low, high) in enumerate(heights)]
    soil = mpm.Hencky(bulk=E / 3, shear=E / 2, porosity=0.4, conductivity=1e-5, grain_density=2000)
    walls, contact = {"bottom": "y", "left": "x", "right": "x"}, mpm.Contact([1, 2, 3], 0, friction=0.2)
    conditions = [contact, *[mpm.Drained("bottom", region=([0, 0], [1, 0]))] * wet]
    given = {"gravity": [0, -10.0], "fluid": mpm.Fluid() if wet else None}
    bodies[2:] = map(mpm.Later, bodies[2:])
    return mpm.Simulation(grid, bodies, [soil], walls=walls, conditions=conditions, **given)


@pytest.mark.parametrize("wet", [False, True])
def test_the_contact_bears_what_is_on_it_as_bodies_come_and_go(wet):
    """Loads also change in a stage. Wet bodies lose a little of their water's weight as they settle."""
    s, first, again = heap(wet), len(heap().bodies[0]), 1600.0 if wet else 1200.0

    def weight():
        return again * s.points.volume0[s.points.id >= first].sum()

    s.run(2e3, 1e3)
    for t, g, stage in ((4e3, 10, {"add": [2]}), (6e3, 20, {"gravity": [0, -20.0]}), (8e3, 20, {"remove": [2]})):
        s.stage(**stage)
        s.run(t, 1e3, after=s.result)
        assert s.tool_forces.array[0, 1] == pytest.approx(g * weight(), rel=2e-3 if wet else 1e-6)
    assert weight() == pytest.approx(0.4 * again, rel=1e-9)
    s.stage(remove=[1])
    s.run(1e4, 1e3, after=s.result)
    assert s.tool_forces.array.tolist() == [[0.0, 0.0, 0.0]]
    s.stage(add=[3])
    s.run(1.2e4, 1e3, after=s.result)
    assert s.tool_forces.array[0, 1] == pytest.approx(20 * weight(), rel=2e-3 if wet else 1e-6)
    assert not wet or s.result.balance < 1e-8


def test_moments_of_a_rough_plate_and_of_a_contact_on_a_block_sum_to_zero():
    grid = mpm.Grid([0, 0], [1, 1.5], [10, 15])
    bodies = [mpm.box(grid, [0.1, 0], [0.9, 0.5]), mpm.box(grid, [0.25, 0.5], [0.75, 1])]
    to = (0.01, -0.02)  # m
    lid = mpm.Tool(mpm.HalfSpace((0, 1), (0, -1)), lambda t: np.multiply(t, to), friction=0.6, name="lid")
    conditions = [mpm.Contact(1, 0, friction=0.4, name="on"), lid]
    s = mpm.Simulation(grid, bodies, [SOIL], walls={"bottom": "xy"}, conditions=conditions)
    s.run(1, 1, progress=False)
    x, y, about_lid = s.tool_forces["lid"]
    assert s.tool_forces["on"] == pytest.approx([-x, -y, -(about_lid + to[0] * y - to[1] * x)], rel=1e-6)


@pytest.mark.parametrize("order", [1, -1])
def test_a_plate_presses_bodies_of_two_groups_evenly(order):
    """The bodies stand side by side, with different spacings. Both recover elastically when the plate is lifted."""
    grid, y = mpm.Grid([0, 0], [2, 2], [8, 8]), 0.85
    bodies = [mpm.box(grid, [0, 0], [1, y]), mpm.box(grid, [1, 0], [2, y], per_cell=3)][::order]
    plate = mpm.Tool(mpm.HalfSpace([1, y + 0.01], [0, -1]), displacement=lambda t: (0, -0.1 * np.sin(np.pi * t)))
    walls = {"bottom": "y", "left": "x", "right": "x"}
    s = mpm.Simulation(grid, bodies, [SOIL], walls=walls, conditions=[mpm.Contact(0, 1, friction=0.2), plate])
    s.run(0.5, 0.25)
    most, least = (2 * pressed_by(depth, y) for depth in (0.09, 0.09 - 5e-4 * grid.h[1]))
    assert most < s.tool_forces.array[0, 1] < least  # bodies may reach into plates as far
    assert np.abs(s.tool_forces.array[1]).max() < 1e-4 * E  # nothing presses them on each other
    assert np.ptp(s.effective_stress()[:, 1, 1]) < 1e-3 * E * 0.1
    s.run(1.0, 0.25, after=s.result)
    assert s.tool_forces.array.tolist() == [[0.0, 0.0, 0.0]] * 2


def test_a_tool_presses_a_face_that_another_group_lay_on(tmp_path):
    s = two_blocks(gap=0.0, path=lambda t: 0.5 * min(t, 1))
    write = mpm.Writer(s, tmp_path)
    s.run(1.0, 0.25, observe=write)
    top = s.points.corners[s.points.id < len(s.bodies[0]), :, 1].max()
    plate = mpm.Convex([[-0.5, top], [1.5, top], [1.5, top + 0.2], [-0.5, top + 0.2]])
    s.stage(conditions=[*s.conditions, mpm.Tool(plate, displacement=lambda t: (0, -0.1 * (t - 1)))])
    s.run(2.0, 0.5)
    assert s.tool_forces.array[:, 1] == pytest.approx([pressed_by(0.1, top), 0], rel=1e-3)


@pytest.mark.parametrize(("wet", "friction"), [(False, 0.0), (True, 0.5)])
def test_a_block_on_soil_at_rest_stays_there(wet, friction):
    """On level soil, the block does not move. On soil with an edge, it moves as little as the balance allows."""
    density = 1600.0 if wet else 1200.0
    soil = mpm.Hencky(bulk=E / 3, shear=E / 2, porosity=0.4, conductivity=1e-6, grain_density=2000)
    for width, still in ((1.0, 1e-12), (0.6, 1e-5)):
        grid, y = mpm.Grid([0, 0], [1, 2], [8, 16]), 0.55
        bodies = [mpm.box(grid, [0, 0], [1, y]), mpm.box(grid, [0, y], [width, y + 0.6], per_cell=3)]
        water = {"fluid": mpm.Fluid(), "pressure": mpm.hydrostatic(y + 0.6, 1e4)} if wet else {}
        rest = {
            "gravity": [0, -10],
            "initial_stress": mpm.K0(1.0),
            "conditions": [mpm.Contact(1, 0, friction=friction)],
        }
        walls = {"bottom": "xy", "left": "x", "right": "x"}
        s = mpm.Simulation(grid, bodies, [soil], walls=walls, **rest, **water)
        before = s.points.x.copy()
        s.run(20.0, 10.0)
        assert np.abs(s.points.x - before).max() < still * grid.h.min()
        assert s.tool_forces.array[0, 1] == pytest.approx(10 * density * 0.6 * width, rel=1e-3)


def test_what_are_no_contacts_is_refused():
    grid = mpm.Grid([0, 0], [1, 2], [4, 8])
    boxes = [mpm.box(grid, [0, y], [1, y + 0.5]) for y in (0, 0.5, 1.0)]
    deep = mpm.box(grid, [0, 0.3], [1, 0.9])

    def scene(bodies, *contacts, **more):
        return mpm.Simulation(
            grid, bodies, [SOIL], walls={"bottom": "xy"}, conditions=[*contacts, *more.pop("conditions", [])], **more
        )

    with pytest.raises(ValueError, match=r"Contact: friction = -0.1, must be >= 0 and finite"):
        mpm.Contact(0, 1, friction=-0.1)
    with pytest.raises(ValueError, match=r"Contact: other = 2, must be indices of the bodies, 0 to 1"):
        scene(boxes[:2], mpm.Contact(0, 2))
    with pytest.raises(ValueError, match=r"body 0 is in one = 0 and in other = .*, must be in one of the two"):
        scene(boxes[:2], mpm.Contact(0, [0, 1]))
    with pytest.raises(ValueError, match=r"body 2 is in no group, must be in one group"):
        scene(boxes, mpm.Contact(0, 1))
    with pytest.raises(ValueError, match=r"groups \(0,\) and \(2,\) have 0 contacts, must have one"):
        scene(boxes, mpm.Contact(0, 1), mpm.Contact(1, 2))
    with pytest.raises(ValueError, match=r"body 1 is in the groups .*, must be in one group; name all"):
        scene(boxes, mpm.Contact(0, [1, 2]), mpm.Contact(0, 1))
    with pytest.raises(ValueError, match=r"bodies 0 and 1: overlap at .* by 0.2 m, must be apart or touch"):
        scene([boxes[0], deep], mpm.Contact(0, 1))
    with pytest.raises(ValueError, match=r"2 groups of bodies have this side, must be one group; limit each"):
        scene(boxes[:2], mpm.Contact(0, 1), conditions=[mpm.Traction("left", 0.0)])
    with pytest.raises(ValueError, match=r"quadrature = 'point', must be 'domain' with contacts"):
        scene(boxes[:2], mpm.Contact(0, 1), numerics=mpm.Numerics(quadrature="point"))
    with pytest.raises(ValueError, match=r"terms: not available with contacts, must be absent"):
        scene(boxes[:2], mpm.Contact(0, 1), terms=[lambda at: 0])
    with pytest.raises(ValueError, match=r"is free to move as a rigid body in 1 of 3 modes"):
        scene(boxes[:2], mpm.Contact(0, 1), gravity=[0, -10]).step(1.0)  # slides
    with pytest.raises(ValueError, match=r"is free to move as a rigid body in 3 of 3 modes"):
        scene(boxes[::2], mpm.Contact(0, 1, friction=0.3), gravity=[0, -10]).step(1.0)
    sand = mpm.MohrCoulomb(bulk=2e7, shear=1e7, friction=30.0, dilation=10.0, cohesion=5e3)
    s = mpm.Simulation(
        grid, boxes[:2], [sand], walls={"bottom": "xy"}, conditions=[mpm.Contact(0, 1)], gravity=[0, -10]
    )
    with pytest.raises(ValueError, match=r"factor_of_safety: the scene has contacts, must have none"):
        mpm.factor_of_safety(s)


@pytest.mark.parametrize(("steps", "error"), [(1, 0.06), pytest.param(10, 0.08, marks=pytest.mark.slow)])
def test_curved_bodies_press_each_other_with_the_exact_pressures(steps, error):
    """14 cells over the half-width, in one step and in many steps. The upper body is curved, and held at its top."""
    cells, R, L, nu = 16, 200.0, 4.0, 0.3
    top = L + 0.3 / cells
    grid = mpm.Grid([0, 0], [L, 2 * L + 2], [round(L * cells), round((2 * L + 2) * cells)])

    def bend(x):
        return x + np.column_stack([0 * x[:, 0], (1 - (x[:, 1] - top) / L) * x[:, 0] ** 2 / (2 * R)])

    bodies = [mpm.box(grid, [0, 0], [L, top]), mpm.mapped(grid, mpm.box(grid, [0, top], [L, top + L]), bend)]
    above = ([0, top + L / 2], [L, 2 * L + 2])
    held = mpm.Displacement("top", lambda t, X: (0, -0.0043 * t), components="y", region=above)
    soil = mpm.Hencky(bulk=E / (3 - 6 * nu), shear=E / (2 + 2 * nu))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, bodies, [soil], walls=walls, conditions=[held, mpm.Contact(0, 1)])
    s.run(1.0, 1.0 / steps)
    layers = [compliance(L, top, E, nu, rough=True), compliance(L, L, E, nu, rough=False)]
    pressure, half_width = errors(
        s.points.x[:, 0], s.points.data["contact_pressure"], L, R, layers, 2 * abs(s.tool_forces["contact"][1])
    )
    assert pressure < error
    assert abs(half_width) < 0.01


def test_a_block_slides_off_the_edge_of_another():
    """The block never penetrates the other block. Without friction, no force acts along its path until it falls."""
    grid = mpm.Grid([0, 0], [2.2, 1.2], [22, 12])
    bodies = [mpm.box(grid, [0.2, 0], [1.1, 0.53]), mpm.box(grid, [0.4, 0.53], [0.8, 0.93], per_cell=3)]
    path = mpm.Displacement("top", lambda t, X: (0.1 * max(0, t - 1), -0.01 * min(t, 1)), region=([0, 0.9], [2.2, 1.2]))
    gel = mpm.Hencky(bulk=1e6, shear=6e5)
    s = mpm.Simulation(grid, bodies, [gel], walls={"bottom": "xy"}, conditions=[path, mpm.Contact(1, 0)])
    forces, deepest = [], []

    def see(s):
        contacts, cut = s.state.stage.acting[-1], s.scene.last[0].cut
        deepest.append(-min(pairs.gap.min(initial=0.0) for _, pairs in contacts._opposite_all(cut, s.points)))
        forces.append(s.tool_forces.array[0, :2])

    s.run(9.0, 0.5, observe=see)
    along, normal = np.abs(forces).T
    assert max(deepest) < 1e-3 * grid.h.min()
    assert (along[2:6] < 0.01 * normal[2:6]).all() and (normal[2:6] > 0.8 * normal[1]).all()
    assert forces[-1].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("share", [0.995, 1.005])
def test_a_block_on_a_slope_of_another_body_slips_where_its_tangent_is_the_coefficient_of_friction(share):
    """The slope is inclined to the grid. Gravity rotates to an angle below or above the friction angle."""
    (c, s), mu = (np.cos(0.25), np.sin(0.25)), 0.3
    turn = np.array([[c, -s], [s, c]])
    grid = mpm.Grid([0, 0], [3, 2], [18, 12])
    flat = mpm.box(grid, [0, 0], [1.8, 0.4]), mpm.box(grid, [0.6, 0.4], [1.2, 0.6], per_cell=3)
    bodies = [mpm.mapped(grid, body, lambda x: x @ turn.T + (0.6, 0.1)) for body in flat]
    held = mpm.Displacement("bottom", (0, 0), region=([-0.1, -0.1], [1.9, 0.1]))
    rock = mpm.Hencky(bulk=1e8, shear=6e7, grain_density=2000, porosity=0.4)

    def gravity(t):
        angle = np.arctan(mu * share * min(t, 1))
        return turn @ [-10 * np.sin(angle), -10 * np.cos(angle)]

    options = {"walls": {}, "conditions": [held], "gravity": gravity}
    scene = mpm.Simulation(
        grid, bodies, [rock], conditions=[mpm.Contact(1, 0, friction=mu), *options.pop("conditions", [])], **options
    )
    if share > 1:
        with pytest.raises(mpm.GaveUp):
            scene.run(1.0, 0.25)
        assert scene.t * share == pytest.approx(1, rel=5e-3)
    else:
        scene.run(1.0, 0.25)
        before = scene.points.x.copy()
        scene.run(6.0, 0.25, after=scene.result)
        assert np.abs(scene.points.x - before).max() < 1e-5 * grid.h.min()


@pytest.mark.slow
def test_a_disc_rolls_between_two_bodies():
    """The disc is held first. Then friction alone moves it half as far as the upper body, and rotates it."""
    n, R, y = 8, 0.5, 1.3
    grid, c, on = mpm.Grid([0, 0], [4, 2], [4 * n, 2 * n]), np.array([1.5, y - R]), ([1, 0.75], [1.1, 0.85])
    round_off = lambda x: c + (x - c) * np.sqrt(1 - ((x - c) / R)[:, ::-1] ** 2 / 2)  # noqa: E731
    disc = mpm.mapped(grid, mpm.box(grid, c - R, c + R), round_off)
    bodies = [mpm.box(grid, [0.5, 0], [3.5, 0.3]), disc, mpm.box(grid, [0.5, y], [3, 1.6])]
    gel, contacts = mpm.Hencky(bulk=1e6, shear=6e5), [mpm.Contact(*pair, friction=0.5) for pair in ((1, 0), (2, 1))]
    press = mpm.Displacement("top", lambda t, X: (0.6 * max(0, t - 1), -0.03 * min(t, 1)), region=([0, 1.5], [4, 2]))
    hold = mpm.Displacement("left", lambda t, X: (0, -0.015 * t), region=on)
    contacts.append(mpm.Contact(0, 2))
    s = mpm.Simulation(grid, bodies, [gel], walls={"bottom": "xy"}, conditions=[hold, press, *contacts])
    s.run(1.0, 0.25)
    s.stage(conditions=[press])
    mine = (s.points.id >= len(bodies[0])) & (s.points.id < len(bodies[0]) + len(disc))
    before = s.points.x[mine]
    s.run(2.0, 0.125)
    way = s.points.x[mine].mean(axis=0) - before.mean(axis=0)
    a, b = before - before.mean(axis=0), s.points.x[mine] - s.points.x[mine].mean(axis=0)
    angle = np.arctan2((a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]).sum(), (a * b).sum())
    assert (way[0], angle) == (pytest.approx(0.3, rel=5e-3), pytest.approx(0.6, rel=1e-2))
