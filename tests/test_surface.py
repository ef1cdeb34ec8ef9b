# SPDX-License-Identifier: MIT
"""Bodies in contact have no surface at the interface: free parts of faces, exact for boxes and after maps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import numbers, repeatable

import mpm_dolfinx as mpm
from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.bodies.faces import face_vectors, surface

SOIL = mpm.Hencky(bulk=1e6, shear=6e5)


@st.composite
def stacks(draw, dim):
    """Return a box with up to three boxes side by side on it, with different spacings and offsets."""
    grid = mpm.Grid([0] * dim, [4.0] * dim, [4] * dim)

    def box(low, high):
        return mpm.box(grid, low, high, per_cell=draw(st.integers(1, 7)))

    flat = dim - 1
    low, high = numbers(draw, 0, 1.5, flat), numbers(draw, 2, 4, flat)
    height = draw(st.floats(0.3, 1.0))
    boxes = [box([*low, 0], [*high, height])]
    ends = np.sort(numbers(draw, 0, 4, 2 * draw(st.integers(1, 3))))
    for a, b in zip(ends[::2], ends[1::2], strict=True):
        across = np.sort(numbers(draw, 0, 4, 2, flat - 1), axis=0)
        if b - a > 0.05 and (np.ptp(across, axis=0) > 0.05).all():
            boxes.append(box([a, *across[0], height], [b, *across[1], height + draw(st.floats(0.1, 3.0))]))
    return boxes


def moments(low, high):
    """Return the area of boxes (n, 2, k) in k dimensions, and its first moments."""
    area = np.maximum(high - low, 0).prod(axis=1)
    return np.concatenate([[area.sum()], (area[:, None] * (low + high) / 2).sum(axis=0)])


@pytest.mark.parametrize("dim", [2, 3])
def test_what_lies_under_other_boxes_is_not_free_and_all_else_is(dim):
    @repeatable(100)
    @given(stacks(dim))
    def check(boxes):
        top = surface(boxes, "top")
        low, high = (np.stack([f(b) for b in boxes])[:, :-1] for f in (corner, lambda b: corner(b, 1)))
        whole = moments(low, high)
        under = moments(
            np.maximum(low[1:], low[0]), np.maximum(np.minimum(high[1:], high[0]), np.maximum(low[1:], low[0]))
        )
        assert moments(top.X[:, 0, :-1], top.X[:, 1, :-1]) == pytest.approx(whole - under, rel=1e-10, abs=1e-10)
        assert top.area0.sum() == pytest.approx(whole[0] - under[0], rel=1e-10)
        bottom = surface(boxes, "bottom")
        assert bottom.area0.sum() == pytest.approx(whole[0] - under[0], rel=1e-10)

    check()


def corner(body, end=0):
    return body.lower.min(axis=0) if end == 0 else (body.lower + body.spacing).max(axis=0)


def test_free_parts_of_a_face_do_not_overlap_and_a_region_cuts_each():
    grid = mpm.Grid([0, 0, 0], [4.0, 4.0, 4.0], [4, 4, 4])
    below = mpm.box(grid, [0, 0, 0], [4, 4, 1], per_cell=1)
    posts = [mpm.box(grid, [x, y, 1], [x + 0.4, y + 0.3, 2], per_cell=9) for x in (0.2, 1.1) for y in (0.3, 2.2)]
    region = ((0.1, 0.2, 1), (1.35, 2.35, 1))
    top = surface([below, *posts], "top", region)
    low, high = top.X[:, 0, :2], top.X[:, 1, :2]
    common = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    assert (np.minimum(common[..., 0], common[..., 1])[~np.eye(len(top), dtype=bool)] < 1e-12).all()
    assert len(top) > len(np.unique(top.id)) and top.area0.sum() == pytest.approx(1.25 * 2.15 - 0.65 * 0.45, rel=1e-12)


def test_bodies_touch_where_their_maps_put_them():
    grid = mpm.Grid([0, 0], [4.0, 2.0], [8, 4])
    below, above = mpm.box(grid, [0, 0], [4, 1]), mpm.box(grid, [0, 0], [2, 0.5], per_cell=3)
    bodies = [below, mpm.mapped(grid, above, lambda x: np.add(x, [0.7, 1]))]
    top = surface(bodies, "top")
    assert top.area0.sum() == pytest.approx(4.0, rel=1e-12)
    assert top.area0[top.id < len(below)].sum() == pytest.approx(2.0, rel=1e-12)
    moved = mpm.mapped(grid, mpm.box(grid, [0, 1], [2, 1.5]), lambda x: np.add(x, [0, 0.3]))
    assert surface([below, moved], "top").area0.sum() == pytest.approx(6.0, rel=1e-12), "it has left the body"


@pytest.mark.parametrize("per_cell", [2, 3, 5])
def test_a_curve_that_two_bodies_follow_with_other_domains_is_no_surface(per_cell):
    """The edges of the two bodies are different chords of the curve."""
    grid = mpm.Grid([0, 0], [3.0, 2.0], [12, 8])

    def wave(x):
        return x + np.stack([0.1 * x[:, 1], 0.2 * np.sin(2 * x[:, 0])], axis=1)

    low, high = mpm.box(grid, [0.2, 0.3], [2, 0.8]), mpm.box(grid, [0.7, 0.8], [1.5, 1.2], per_cell=per_cell)
    bodies = [mpm.mapped(grid, body, wave) for body in (low, high)]
    top = surface(bodies, "top")
    X = np.sort(top.X[top.id < len(low), :, 0].ravel())
    assert [X[0], X[-1], np.abs(np.diff(X)).max()] == pytest.approx([0.2, 2.0, 0.8], abs=2e-3)


@pytest.mark.parametrize("per_cell", [1, 2, 5])
def test_under_a_body_that_is_turned_in_3d_exactly_what_it_covers_is_not_free(per_cell):
    grid = mpm.Grid([0, 0, 0], [4.0, 4.0, 2.0], [8, 8, 4])
    below, above = mpm.box(grid, [0, 0, 0], [4, 4, 1], 2), mpm.box(grid, [0, 0, 1], [2, 1.5, 1.5], per_cell)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = mpm.mapped(grid, above, lambda x: (x - [1, 0.75, 0]) @ [[c, s, 0], [-s, c, 0], [0, 0, 1]] + [2.1, 1.9, 0])
    top = surface([below, turned], "top")
    own = top.id < len(below)
    area, middle = top.area0[own], top.places()[own][:, :, :2]
    a, b, d = middle[:, 1] - middle[:, 0], middle[:, 2] - middle[:, 0], middle[:, 3] - middle[:, 0]
    triangles = np.stack([np.linalg.det(np.stack(two, axis=1)) for two in ((a, d), (d, b))]) / 2  # of each part
    centre = np.stack([middle[:, [0, 1, 3]].mean(axis=1), middle[:, [0, 2, 3]].mean(axis=1)])
    assert np.abs(triangles).sum(axis=0) == pytest.approx(area, rel=1e-9)
    moment = (np.abs(triangles)[..., None] * centre).sum(axis=(0, 1))
    # free parts thinner than SAME of a face are left out
    assert area.sum() == pytest.approx(16 - 3, rel=SAME) and moment == pytest.approx([32 - 6.3, 32 - 5.7], rel=SAME)
    assert surface([below, turned], "top", ((0, 0, 0), (2.1, 4, 1))).area0.sum() == pytest.approx(8.4 - 1.5, rel=SAME)
    assert surface([below, turned], "bottom").area0.sum() == pytest.approx(16.0, rel=1e-10), "nothing of it is free"


def test_a_load_on_what_is_free_beside_a_turned_body_carries_its_whole_force():
    grid = mpm.Grid([-0.5] * 3, [4.5, 4.5, 2.0], [10, 10, 5])
    below, above = mpm.box(grid, [0, 0, 0], [4, 4, 1], 2), mpm.box(grid, [0, 0, 1], [2, 1.5, 1.5], 2)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = mpm.mapped(grid, above, lambda x: (x - [1, 0.75, 0]) @ [[c, s, 0], [-s, c, 0], [0, 0, 1]] + [2.1, 1.9, 0])
    ground = ((0, 0, 0), (4, 4, 0))
    hold, load = mpm.Displacement("bottom", (0, 0, 0), region=ground), mpm.Traction("top", (0, 0, -1e3))
    s = mpm.Simulation(grid, [below, turned], [SOIL], walls={}, conditions=[hold, load])
    s.run(1.0, 1.0, progress=False)
    assert s.reactions.array[0, 2] == pytest.approx(16e3, rel=1e-6)


def test_a_curved_interface_in_3d_between_other_lattices_is_no_surface():
    """Chords leave slivers between the bodies. If these were drained, the bodies would lose their water."""
    errors = []
    for cells in (10, 20):
        grid = mpm.Grid([0] * 3, [1.6] * 3, [cells] * 3)

        def bend(x):
            u = [np.sin(3 * x[:, 1]) + x[:, 1] / 2, np.sin(2 * x[:, 0]), np.sin(3 * x[:, 0]) * np.cos(2 * x[:, 1])]
            return x + 0.2 + 0.05 * np.stack(u, axis=1)

        boxes = mpm.box(grid, [0.1] * 3, [1, 1, 0.5]), mpm.box(grid, [0.3, 0.3, 0.5], [0.9] * 3, per_cell=3)
        bodies = [mpm.mapped(grid, body, bend) for body in boxes]
        top = surface(bodies, "top")
        part = top.X[top.id < len(bodies[0]), :, :2]
        assert not ((part[:, 0] > 0.31) & (part[:, 1] < 0.89)).all(axis=1).any()
        sides = [body.corners(np.flatnonzero(body.sides[:, 2, 1 - k])) for k, body in enumerate(bodies)]
        whole, under = (np.linalg.norm(face_vectors(c, 5 - k), axis=1).sum() for k, c in enumerate(sides))
        errors.append(top.area0[top.id < len(bodies[0])].sum() / (whole - under) - 1)
    assert abs(errors[1]) < 4e-4 and abs(errors[1] / errors[0]) < 0.6


def test_a_body_that_a_map_has_drawn_to_a_point_has_sides():
    grid = mpm.Grid([0] * 3, [2.0] * 3, [4] * 3)
    box = mpm.box(grid, [0, 0, 0], [1, 1, 1])
    cone = mpm.mapped(grid, box, lambda x: np.stack([x[:, 0] * (1.5 - x[:, 2]), x[:, 1] * x[:, 0], x[:, 2]], axis=1))
    bodies = [cone, mpm.mapped(grid, mpm.box(grid, [0, 0, 1], [1, 1, 2]), lambda x: x * [0.5, 0.5, 1])]
    left = surface(bodies, "left")
    assert left.area0[left.id < len(cone)].sum() < 1e-12 and left.area0.sum() == pytest.approx(0.5, rel=1e-12)
    assert np.isfinite(surface(bodies, "top").area0).all() and len(surface(bodies, "bottom"))


def test_a_second_map_comes_after_the_first():
    grid = mpm.Grid([0, 0], [4.0, 4.0], [8, 8])
    body = mpm.box(grid, [0.5, 0.5], [1.5, 1.5])
    first, second = (lambda x: x * [1, 2]), (lambda x: x + [0.5, 0.1] * x[:, ::-1])
    twice = mpm.mapped(grid, mpm.mapped(grid, body, first), second)
    assert twice.corners() == pytest.approx(mpm.mapped(grid, body, lambda x: second(first(x))).corners(), abs=0)
    assert surface([twice], "top", ((0, 1.2), (1.0, 2))).X[:, 1, 0].max() == 1.0, "regions are those before all maps"


def scene(grid, bodies, **options):
    return mpm.Simulation(grid, bodies, [SOIL], walls={"bottom": "xy"}, **options)


def test_a_body_bent_into_another_is_refused_with_the_depth():
    grid = mpm.Grid([0, 0], [4.0, 2.0], [8, 4])
    below, above = mpm.box(grid, [0, 0], [4, 1]), mpm.box(grid, [0, 1], [2, 1.5])
    with pytest.raises(ValueError, match=r"bodies 0 and 1: overlap at .* by 0.2 m, must be apart or touch"):
        scene(grid, [below, mpm.mapped(grid, above, lambda x: x - [0, 0.2])])
    with pytest.raises(ValueError, match=r"overlap at .*, must be apart or touch"):
        scene(grid, [below, mpm.mapped(grid, above, lambda x: x - np.outer(x[:, 0], [0, 0.01]))])
    scene(grid, [below, mpm.mapped(grid, above, lambda x: x + np.outer(x[:, 0], [0, 0.1]))])


def test_a_plate_lies_on_the_body_as_it_is_bent():
    grid = mpm.Grid([0, 0], [4.0, 4.0], [8, 8])
    body, plate = mpm.box(grid, [0, 0], [2, 1]), [mpm.RigidPlate("top", 1e3)]
    with pytest.raises(ValueError, match=r"RigidPlate\(.* slope, must be one flat side normal to an axis"):
        scene(grid, [mpm.mapped(grid, body, lambda x: x + np.outer(x[:, 0] * x[:, 1], [0, 0.3]))], conditions=plate)
    sheared = mpm.mapped(grid, body, lambda x: x + np.outer(x[:, 1], [0.5, 0]))
    assert scene(grid, [sheared], conditions=plate).run(1.0, 1.0, progress=False).converged


def test_bodies_that_do_not_touch_and_yet_will_stick_are_named_with_their_distance(warned):
    grid = mpm.Grid([0, 0], [4.0, 4.0], [8, 8])
    below = mpm.box(grid, [0, 0], [4, 1])

    def warnings(low):
        scene(grid, [below, mpm.box(grid, [1, low], [2, 2])])
        return warned()

    assert "bodies 0 and 1: 0.4 cells apart at" in warnings(1.2)[0]
    assert warnings(1.0) == [] and warnings(1.6) == []
    scene(grid, [below, mpm.box(grid, [0, 1], [4, 1.2]), mpm.box(grid, [1, 1.2], [2, 2])])
    assert not warned(), "what lies between holds them apart"
