# SPDX-License-Identifier: MIT
"""Grid lines that follow a tool or a function: each step is as exact as on fixed lines."""

from functools import partial

import mpi_following_3d as in_3d
import numpy as np
import pytest
from helpers import SOFT, imbalance, left_after_a_way_and_back, refused_in_one_line
from meshes import box_mesh
from mpi_following import pushed
from test_many_sizes import EXACT, KINDS, at_random

import mpm_dolfinx as mpm
from mpm_dolfinx.domains.cut_domains import STILL
from mpm_dolfinx.grid.following import carried
from mpm_dolfinx.grid.grid import SIDES


def jumping(dim, axisymmetric=False, every=1.0, high=1.3, last=3):
    """Return a grid with new random lines at regular times, which are fixed from the last time on."""
    cells = (8, 7) if dim == 2 else (5, 4, 5)
    lines = partial(at_random, [0] * dim, [high] * dim, cells)
    return mpm.Grid(lines=lines(0), follow=lambda t: lines(min(round(t / every), last)), axisymmetric=axisymmetric)


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_even_stresses_are_exact_while_lines_jump_at_random(dim, axisymmetric):
    grid = jumping(dim, axisymmetric)
    body = mpm.box(grid, [0] * dim, [1.03, 1.01, 0.97][:dim])
    push = -4e5 if axisymmetric else -3e5
    walls = {"left": "x", "bottom": "y"} if dim == 2 else {"left": "x", "front": "y", "bottom": "z"}
    loads = [mpm.Pressure(side, lambda t: push * t / 4) for side in ["right", "top", "back"][:dim]]
    soil = mpm.NeoHookean(bulk=2e6, shear=1e6)
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=loads, numerics=EXACT)
    s.run(4.0, 1.0, progress=False)
    stress = s.effective_stress()
    assert s.state.resets == 4 and np.abs(grid.lines[1] - grid.seeded[1]).max() > 0.02
    assert np.abs(stress - stress.mean(axis=0)).max() < 1e-10 * np.abs(stress).max()
    assert np.abs(s.points.F - s.points.F.mean(axis=0)).max() < 1e-10


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_linear_pressures_are_exact_while_lines_jump_at_random(dim, axisymmetric):
    """Steady flow through a block that ends within cells, with gravity."""
    grid, g = jumping(dim, axisymmetric, 1e3), np.array([0.0] * (dim - 1) + [-9.81])
    slope = np.array([0.0 if axisymmetric else 3e3, -2e3, 1e3])[:dim]
    rock = mpm.Hencky(bulk=1e15, shear=1e15, porosity=0.4, conductivity=1e-4)
    names = ["bottom", "top"] if axisymmetric else list(SIDES[dim])
    drained = [mpm.Drained(name, lambda x: 1e4 + x @ slope) for name in names]
    hold = dict.fromkeys(("left", "bottom", "front")[: dim if dim == 3 else 2], "xyz"[:dim])
    options = {"walls": hold, "fluid": mpm.Fluid(bulk=np.inf), "gravity": g, "conditions": drained, "numerics": EXACT}
    s = mpm.Simulation(grid, [mpm.box(grid, [0] * dim, [1.03] * dim)], [rock], **options)
    result = s.run(4e3, 1e3, progress=False)
    cells = s.cells()  # of the last step: its lines stay
    assert s.state.resets == 4 and result.balance < 1e-8
    assert np.abs(cells.pressure - 1e4 - cells.x @ slope).max() < 1e-10 * 2e4


def test_sealed_soil_keeps_its_water_and_its_stress_while_lines_jump():
    """The water of each cell changes, but the sum does not, although pressures differ from point to point."""
    grid = jumping(2)
    soil = mpm.Hencky(1e6, 4e5, porosity=0.4)
    walls = dict.fromkeys(SIDES[2], "xy")
    acting = {"pressure": lambda x: 1e4 * np.sin(3 * x[:, 0]) * x[:, 1], "fluid": mpm.Fluid(bulk=1e6), "walls": walls}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1.3, 1.3])], [soil], **acting)
    held = []
    for _ in range(4):
        s.step(1.0)
        cells = s.cells()
        held.append(np.bincount(cells.cell, cells.water, grid.cells))
    assert np.ptp([h.sum() for h in held]) < 1e-12 * held[0].sum()
    assert np.abs(held[1] - held[0]).max() > 0.1 * held[0].mean()


def test_smallest_cells_move_with_the_tool_by_whole_cells_and_the_others_grow_from_them():
    given = [np.array(x) for x in mpm.graded([0, -4], [4, 4], [[[0, -1], [1, 1]]], 0.125, 1.3)]
    lines = carried(given, np.array([0.0, -0.9]))
    assert (lines[0] == given[0]).all() and len(lines[1]) == len(given[1])
    assert lines[1][[0, -1]].tolist() == [-4, 4]
    width, before = np.diff(lines[1]), np.diff(given[1])
    fine = before < 0.126
    assert width[fine] == pytest.approx(0.125) and lines[1][:-1][fine] == pytest.approx(given[1][:-1][fine] - 7 * 0.125)
    grown = width[~fine] / before[~fine]
    below, above = np.split(grown, [np.flatnonzero(fine)[0]])
    for side in (below[::-1], above):  # powers of a common factor
        assert side == pytest.approx(side[0] ** np.arange(1, len(side) + 1))
    assert below.max() < 1 < above.min() and width.min() > 0.1249
    for stays in (0.0, 0.124, -0.124):
        assert all((x == y).all() for x, y in zip(carried(given, np.array([0.0, stays])), given, strict=True))
    for way in (0.3, 3 * (0.1 + 1e-17) * 1.25):  # the same cell, whatever rounding
        up, down = (carried(given, np.array([0.0, sign * way]))[1][:-1][fine][0] for sign in (1, -1))
        assert (
            up - given[1][:-1][fine][0]
            == pytest.approx(0.125 * int(way / 0.125 + 1e-6))
            == given[1][:-1][fine][0] - down
        )


@pytest.mark.parametrize("load", [None, lambda t: 1e5 * t])
def test_a_run_goes_on_from_a_checkpoint_with_the_same_bits(load, tmp_path):
    """A tool with a prescribed path, and a tool under a load, whose position is in the checkpoint."""
    file, ends = tmp_path / "kept", []
    for parts in (1, 2):
        s = pushed(load)
        result = s.run(0.05, 0.025, progress=False, checkpoint=mpm.Checkpoint(file))
        if parts == 2:
            s = pushed(load)
            result = mpm.resume(s, file)
        s.run(0.1, 0.025, progress=False, after=result)
        ends.append((s.points.corners, s.points.pressure, *s.grid.lines))
        assert any((x != y).any() for x, y in zip(s.grid.lines, s.grid.seeded, strict=True))
    assert all((one == other).all() for one, other in zip(*ends, strict=True))


def test_scenes_in_turn_on_one_grid_do_not_disturb_each_other():
    def shifted(grid, offset):
        body = mpm.box(grid, [0, offset], [1.3, 1.0])
        load = mpm.Traction("top", lambda t: (0, -1e4 * t))
        return mpm.Simulation(grid, [body], [SOFT], walls={"bottom": "xy"}, conditions=[load])

    both, alone = jumping(2), shifted(jumping(2), 0.0)
    one, other = shifted(both, 0.0), shifted(both, 0.0)
    other.step(2.0)
    for _ in range(2):
        one.step(1.0)
        other.step(1.0)
        alone.step(1.0)
    assert (one.points.corners == alone.points.corners).all()


def test_bodies_and_scenes_made_after_a_run_begin_on_the_given_lines():
    """Initial stress and pressure depend on the cells; bodies are boxes and meshes."""
    ends, grid = [], jumping(2)
    for used in (True, False):
        grid = grid if used else jumping(2)
        if used:
            early = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1.3, 1])], [SOFT], walls={"bottom": "xy"})
            early.step(2.0)
            early.step(2.0)
            assert (grid.lines[0] != grid.seeded[0]).any()
        corners, names = [(0.2, 0.9), (1, 0.9), (0.6, 1.2)], ["foot", "right", "left"]
        bodies = [mpm.box(grid, [0, 0], [1.3, 0.9]), mpm.polygon(grid, corners, names, size=0.3)]
        acting = {"fluid": mpm.Fluid(), "gravity": (0, -9.81), "walls": dict.fromkeys(SIDES[2], "xy")}
        start = {"initial_stress": mpm.K0(0.5), "pressure": lambda x: 1e3 * np.sin(9 * x[:, 0]) * x[:, 1]}
        s = mpm.Simulation(grid, bodies, [SOFT], **acting, **start)
        s.step(1.0)
        ends.append(s.points)
    assert len(ends[0]) == len(ends[1]) and (ends[0].corners == ends[1].corners).all()
    assert (ends[0].pressure == ends[1].pressure).all()


TURNS = {"rotation_rad": lambda t: 2 * t, "centre": (1.5, 0.5)}
TRIANGLE = mpm.Convex([(1, 1), (2, 1), (1.5, 1.9)])


def away(y):
    """Return the distance from a disc, as a user-defined function."""
    return np.linalg.norm(y - 1.5, axis=1) - 0.2


@pytest.mark.parametrize(
    "tool, way",
    [
        (mpm.Tool(mpm.Ball((1.5, 1.5), 0.2), **TURNS), np.array([-np.sin(1), np.cos(1) - 1])),
        (mpm.Tool(TRIANGLE, lambda t: (0, 0.25 * t), **TURNS), np.array([-0.8 * np.sin(1), 0.8 * np.cos(1) - 0.675])),
        (mpm.Tool(away, lambda t: (0, 1.2 * t), **TURNS), np.array([0, 0.6])),
        (mpm.Tool(mpm.Ball((1.5, 1.5), 0.2), rotation_rad=lambda t: 2 * t, centre=(1.5, 1.5)), np.zeros(2)),
    ],
    ids=["disc", "polygon", "function", "about itself"],
)
def test_lines_follow_the_middle_of_a_tool_that_turns(tool, way):
    """Displacements are rounded to whole cells, towards zero. A function gives its centre."""
    given = [[0, 0.5, 0.8, 1.1, 1.45, 1.55, 1.9, 2.2, 2.5, 3]] * 2
    grid = mpm.Grid(lines=given, follow=tool)
    body = mpm.box(grid, [0, 0], [3, 0.2])
    s = mpm.Simulation(grid, [body], [SOFT], walls={"bottom": "xy"}, conditions=[tool])
    s.t = 0.5
    s.step(1e-3)
    for lines, by in zip(grid.lines, way, strict=True):
        assert lines[4:6] == pytest.approx(np.array([1.45, 1.55]) + np.trunc(by / 0.1 + np.sign(by) * 1e-9) * 0.1)


def test_lines_stay_in_a_stage_without_the_tool_and_follow_one_with_its_name():
    """Another condition may have the same name."""
    disc, again = (mpm.Tool(mpm.Ball((1.5, 1.5), 0.2), lambda t: (0.5 * t, 0), name="bar") for _ in range(2))
    grid = mpm.Grid(lines=[[0, 1, 1.4, 1.6, 2, 3], LINES[1]], follow=disc)
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [3, 1])], [SOFT], walls={"bottom": "xy"}, conditions=[disc])
    found = []
    for conditions in ([disc], [mpm.Displacement("left", (0, 0), name="bar")], [again]):
        s.stage(conditions=conditions)
        s.t += 0.41
        s.step(1e-3)
        found.append(grid.lines[0][2])
    assert found == pytest.approx([1.6, 1.6, 2.0])


def test_a_step_keeps_its_cut_by_the_cells_where_it_moves():
    """A block that moves by half of STILL of the coarse cells keeps its cut in coarse cells, but not in fine cells."""
    kept, y = [], np.append(np.linspace(0, 0.1, 21), np.linspace(0.2, 1.2, 11))
    for low, high in ((0.02, 0.08), (0.5, 0.9)):
        grid = mpm.Grid(lines=[np.array([0, 0.1]), y])
        hold = mpm.Displacement("bottom", (0, 0.5 * STILL * 0.1))
        body = mpm.box(grid, [0, low], [0.1, high])
        s = mpm.Simulation(grid, [body], [SOFT], walls={"left": "x", "right": "x"}, conditions=[hold])
        s.step(1.0)
        kept.append(s.state.stays)
    assert kept == [False, True]


def test_lines_that_move_less_than_corners_may_keep_the_cut():
    """The same holds for fixed lines."""
    for way, resets in ((0.0, 1), (1e-5, 1), (1e-2, 3)):
        given = [np.array([0, 0.1]), np.linspace(0, 1.2, 13) ** 1.1 * 1.2**-0.1]
        moved = lambda t, way=way, given=given: [given[0], given[1] + way * t * np.sin(np.pi * given[1] / 1.2) * 0.01]  # noqa: E731
        grid = mpm.Grid(lines=given, follow=moved)
        s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.1, 1.0])], [SOFT], walls={"bottom": "xy"}, fluid=mpm.Fluid())
        for _ in range(3):
            s.step(1.0)
        assert s.state.resets == resets


@pytest.mark.slow
def test_a_body_carried_through_lines_that_move_against_it_and_back_is_as_one_in_equal_cells():
    """A wet beam is clamped to a moving support, and bent on its path: residual stress and pressure."""
    h = 0.05
    given = mpm.graded([-0.6, 0], [2.6, 1.2], [[[0.0, 0.45], [1.0, 0.85]]], h, 1.2, 3 * h)
    follow = lambda t: carried(given, np.array([-0.25 * np.sin(np.pi * t), 0.05 * np.sin(4 * np.pi * t)]))  # noqa: E731
    grids = mpm.Grid([-0.6, 0], [2.6, 1.2], [64, 24]), mpm.Grid(lines=given, follow=follow)
    left = [left_after_a_way_and_back(grid) for grid in grids]
    assert (left[1] < 1.5 * left[0]).all(), left


def on_swinging_lines(body, conditions, size=0.06, **more):
    """Return wet soil of a box, or a mesh, on graded lines that oscillate along x."""
    given = mpm.graded([0, 0], [2, 2], [[[0.65, 0.88], [0.98, 1.24]]], size, 1.3)
    swing = lambda t: carried(given, np.array([0.4 * np.sin(20 * t), 0.0]))  # noqa: E731
    grid, numerics = mpm.Grid(lines=given, follow=swing), mpm.Numerics(tolerance=1e-11)
    acting = {"fluid": mpm.Fluid(), "conditions": [*conditions, mpm.Drained("top")], "numerics": numerics}
    body = mpm.box(grid, *body) if isinstance(body, tuple) else mpm.from_mesh(grid, body)
    return mpm.Simulation(grid, [body], [SOFT], **acting, **more)


@pytest.mark.parametrize("inertia", [False, True])
def test_tied_sides_hold_on_lines_that_swing_and_a_run_goes_on_with_the_same_bits(inertia, tmp_path):
    ends, file = [], tmp_path / "kept"
    for parts in (1, 2):
        acting = [mpm.Displacement("bottom", (0, 0)), mpm.Tied("left", "right")]
        more = {"inertia": inertia, "gravity": (2.0, -9.81), "walls": {}}
        s, again = (on_swinging_lines(([0.3, 0.1], [1.7, 1]), acting, **more) for _ in range(2))
        result = s.run(0.04, 0.01, progress=False, checkpoint=mpm.Checkpoint(file))
        if parts == 2:
            s, result = again, mpm.resume(again, file)
        result = s.run(0.08, 0.01, progress=False, after=result)
        assert result.balance < 1e-8 and np.abs(s.grid.lines[0] - s.grid.seeded[0]).max() > 0.3
        if not inertia:  # both forces of the base bear one weight
            across, up = s.reactions["displacement_bottom"]
            assert across == pytest.approx(-2 / 9.81 * up, rel=1e-8)
        ends.append(s.points)
    assert (ends[0].corners == ends[1].corners).all() and (ends[0].pressure == ends[1].pressure).all()


def test_soil_and_water_stay_at_rest_on_lines_that_swing():
    start = {"initial_stress": mpm.K0(0.5), "pressure": mpm.hydrostatic(0.93), "gravity": (0, -9.81)}
    s = on_swinging_lines(([0, 0], [2, 0.93]), [], walls={"left": "x", "right": "x", "bottom": "xy"}, **start)
    result = s.run(0.08, 0.01, progress=False)
    assert s.state.resets > 5 and result.balance < 1e-8 and np.abs(s.points.displacement).max() < 1e-12


DISC = mpm.Tool(mpm.Ball((0.8, 1.1), 0.1), lambda t: (0.4 * t, -0.2 * t), friction=0.2)
OTHER = mpm.Tool(mpm.Ball((1.4, 1.2), 0.2), load=lambda t: 1e5 * t, direction=(0, -1))
BLOCK = ([0, 0], [2, 1])


@pytest.mark.parametrize(
    "body, tools, size",
    [(BLOCK, [], (0.3, 0.006)), (box_mesh("triangle", (10, 5), *BLOCK), [DISC], 0.06), (BLOCK, [DISC, OTHER], 0.06)],
    ids=["flat cells", "mesh", "two tools"],
)
def test_forces_and_fluid_are_in_balance_on_lines_that_swing(body, tools, size):
    """Flat cells are fifty times as wide as high."""
    gravity, walls = (2.0, -9.81), {"left": "x", "right": "x", "bottom": "xy"}
    s = on_swinging_lines(body, tools, size, gravity=gravity, walls=walls)
    for _ in range(4):
        before, report = s.points, s.step(0.01)
        off = imbalance(s, before, SOFT, gravity)
        print(f"resultant {off:.1e}, fluid {report.balance:.1e}")
        assert off < 1e-9 and report.balance < 1e-9
    assert np.abs(s.grid.lines[0] - s.grid.seeded[0]).max() > 0.1


@pytest.mark.parametrize("follows", [True, False], ids=["ball", "function"])
def test_lines_follow_in_3d_with_all_balances_and_a_run_goes_on_with_the_same_bits(follows, tmp_path):
    ends, file = [], tmp_path / "kept"
    for parts in (1, 2):
        s = in_3d.pushed(follows)
        result = s.run(0.05, 0.05, progress=False, checkpoint=mpm.Checkpoint(file))
        if parts == 2:
            s = in_3d.pushed(follows)
            result = mpm.resume(s, file)
        result = s.run(0.1, 0.05, progress=False, after=result)
        ends.append(s.points)
        before, report = s.points, s.step(0.025)
        assert np.abs(s.grid.lines[0] - s.grid.seeded[0]).max() > 0.14
        assert max(result.balance, report.balance) < 1e-9
        assert imbalance(s, before, in_3d.SOIL, (0, 0, -9.81)) < 1e-8
    assert (ends[0].corners == ends[1].corners).all() and (ends[0].pressure == ends[1].pressure).all()


LINES = [[0, 1, 1.5, 2, 3], [0, 1, 1.5, 2, 3]]
BALL = mpm.Tool(mpm.Ball((1.5, 1.5), 0.2), lambda t: (0, -t))


def step(follow, lines=LINES, there=True, **more):
    """Take a step at t = 1 s on lines that follow, with or without a tool."""
    grid = mpm.Grid(lines=lines, follow=follow)
    tool = [follow] if isinstance(follow, mpm.Tool) and there else []
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [3, 1])], [SOFT], walls={"bottom": "xy"}, conditions=tool, **more)
    s.t = 1.0
    s.step(0.1)


@pytest.mark.parametrize(
    "make, name, value",
    [
        (lambda: mpm.Grid([0, 0], [1, 1], [2, 2], follow=lambda t: LINES), "grid: follow", "lines"),
        (lambda: mpm.Grid(lines=LINES, follow=3), "grid: follow", "3"),
        (lambda: mpm.Grid(lines=LINES, follow=lambda t, X: LINES), "grid: follow", "X"),
        (lambda: mpm.Grid(lines=[[0, 1, 2], [0, 1, 2]], follow=BALL), "grid: follow", "equal"),
        (lambda: step(lambda t: [LINES[0][:4], LINES[1]]), "grid: follow at t = 1 s", "4 and 5"),
        (lambda: step(lambda t: [[0, 1, 1.5, 2, 4], LINES[1]]), "grid: follow at t = 1 s", "4"),
        (lambda: step(lambda t: [[0, 2, 1, 2.5, 3], LINES[1]]), "grid: follow at t = 1 s", "[0, 2, 1, 2.5, 3]"),
        (lambda: step(lambda t: [[0, np.nan, 1, 2, 3], LINES[1]]), "grid: follow at t = 1 s: lines along x", "nan"),
        (lambda: step(lambda t: None), "grid: follow at t = 1 s: lines", "None"),
        (lambda: step(lambda t: 1 / 0), "grid: follow at t = 1 s", "ZeroDivisionError"),
        (lambda: step(BALL), "grid: follow", "0 m between"),
        (lambda: step(BALL, there=False), "grid: follow", "not in the first stage"),
        (lambda: step(BALL, [LINES[0], [0, 0.5, 1, 2, 3]]), "grid: follow", "begin at a side"),
        (lambda: step(lambda t: LINES, numerics=mpm.Numerics(quadrature="point")), "quadrature", "follow"),
    ],
)
def test_lines_that_cannot_follow_are_refused_in_one_line(make, name, value):
    refused_in_one_line(make, name, value, None, 300)


@pytest.mark.slow
def test_a_cone_meets_the_force_that_it_meets_in_lines_that_are_fine_all_along_its_way():
    """A blunt, rough cone penetrates clay by two cells, in axisymmetry: force in every step."""
    clay, h, way, wide = mpm.DruckerPrager(5e6, 1e5, friction=0.0, dilation=0.0, cohesion=1e3), 0.1, 0.2, 0.6
    forces = []
    for follow in (False, True):
        cone = mpm.Tool(mpm.Cone((0, 2.0), (0, 1), 60.0), lambda t: (0, -t), adhesion=300.0)
        zone = [[0, 2 - wide - (0 if follow else way)], [wide, 2 + wide]]
        more = {"follow": cone} if follow else {}
        grid = mpm.Grid(lines=mpm.graded([0, 0], [2, 3], [zone], h, 1.3), axisymmetric=True, **more)
        body = mpm.box(mpm.Grid([0, 0], [2, 3], [20, 30], axisymmetric=True), [0, 0], [2, 2])
        walls = {"left": "x", "right": "x", "bottom": "y"}
        s = mpm.Simulation(grid, [body], [clay], walls=walls, conditions=[cone])
        result = s.run(way, h / 12, progress=False)
        assert result.cuts == 0 and any((x != y).any() for x, y in zip(grid.lines, grid.seeded, strict=True)) == follow
        forces.append(-result.tool_forces["tool"][1:, 1])
    assert forces[1] == pytest.approx(forces[0], rel=1e-4)
