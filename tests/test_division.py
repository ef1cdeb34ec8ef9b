# SPDX-License-Identifier: MIT
"""Elastic domains are divided where cells become finer, and merged where cells become coarser."""

from functools import partial

import numpy as np
import pytest
from helpers import SOFT, imbalance, refused_in_one_line
from meshes import box_mesh
from mpi_division import GRAVITY, SOIL, fine_about, pressed, pressed_in_3d
from scipy.spatial import cKDTree
from test_many_sizes import EXACT, KINDS

import mpm_dolfinx as mpm
from mpm_dolfinx.grid.grid import SIDES

RENEWAL = mpm.Numerics(renewal=True)


def travelling(dim, high, count, way, axisymmetric=False):
    """Return a grid whose finest cells move along the first axis, from 0.2 of its length by way(t)."""
    others = [np.linspace(0, high, count // 2 + 1)] * (dim - 1)
    lines = lambda t: [fine_about(0, high, count, high * (0.2 + way(t))), *others]  # noqa: E731
    return mpm.Grid(lines=lines(0), follow=lines, axisymmetric=axisymmetric)


def there_and_back(t):
    """Return 0.6 at 3 s, and 0 from 6 s on."""
    return 0.2 * max(0, 3 - abs(t - 3))


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_even_stresses_are_exact_and_seeded_domains_come_back(dim, axisymmetric):
    grid = travelling(dim, 1.3, 6 if dim == 3 else 16, there_and_back, axisymmetric)
    body = mpm.box(grid, [0] * dim, [1.3, 1.01, 0.97][:dim])
    walls = {"left": "x", "bottom": "y"} if dim == 2 else {"left": "x", "front": "y", "bottom": "z"}
    loads = [mpm.Pressure(side, lambda t: 2e5 * t) for side in ["right", "top", "back"][:dim]]
    numerics = mpm.Numerics(renewal=True, tolerance=EXACT.tolerance)
    s = mpm.Simulation(grid, [body], [mpm.NeoHookean(2e6, 1e6)], walls=walls, conditions=loads, numerics=numerics)
    seeded, counts = s.points, []
    for _ in range(6 if dim == 3 else 8):
        result = s.run(s.t + 1.0, 1.0, progress=False)
        counts.append(len(s.points))
        stress, points = s.effective_stress(), s.points
        assert np.abs(stress - stress.mean(axis=0)).max() < 1e-10 * np.abs(stress).max()
        assert points.volume0.sum() == pytest.approx(seeded.volume0.sum(), rel=1e-13)
    print(counts, result.renewed)
    assert any(count != len(seeded) for count in counts)
    again = np.isin(seeded.id, s.points.id)
    at, of = s.points.find(seeded.id[again])
    assert again.mean() > 0.1 and np.abs(s.points.reference[of] - seeded.reference[again][at]).max() < 1e-15


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_sealed_soil_keeps_its_water(dim, axisymmetric):
    """Pressures vary from point to point, with a compressible fluid."""
    grid = travelling(dim, 1.3, 6 if dim == 3 else 16, there_and_back, axisymmetric)
    walls = dict.fromkeys(SIDES[dim], "xyz"[:dim])
    acting = {"pressure": lambda x: 1e5 * np.sin(3 * x[:, 0]) * x[:, 1], "fluid": mpm.Fluid(bulk=1e6), "walls": walls}
    body = mpm.box(grid, [0] * dim, [1.3] * dim)
    s = mpm.Simulation(grid, [body], [mpm.Hencky(1e6, 4e5, porosity=0.4)], **acting, numerics=RENEWAL)
    held, count = [], 0
    for _ in range(6):
        count += s.step(1.0).renewed
        held.append(s.cells().water.sum())
    assert count > 500 and np.ptp(held) < 1e-12 * held[0]


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_linear_pressures_are_exact(dim, axisymmetric):
    """Steady flow with gravity, through a rigid block that ends within cells."""
    grid, g = travelling(dim, 1.3, 6 if dim == 3 else 16, lambda t: there_and_back(t / 1e3), axisymmetric), [0.0] * dim
    g[-1] = -9.81
    slope = np.array([0.0 if axisymmetric else 3e3, -2e3, 1e3])[:dim]
    rock = mpm.Hencky(bulk=1e15, shear=1e15, porosity=0.4, conductivity=1e-4)
    names = ["bottom", "top"] if axisymmetric else list(SIDES[dim])
    drained = [mpm.Drained(name, lambda x: 1e4 + x @ slope) for name in names]
    hold = dict.fromkeys(("left", "bottom", "front")[: dim if dim == 3 else 2], "xyz"[:dim])
    options = {"walls": hold, "fluid": mpm.Fluid(bulk=np.inf), "gravity": g, "conditions": drained}
    numerics = mpm.Numerics(renewal=True, tolerance=EXACT.tolerance)
    s = mpm.Simulation(grid, [mpm.box(grid, [0] * dim, [1.25] * dim)], [rock], **options, numerics=numerics)
    result = s.run(7e3, 1e3, progress=False)
    cells = s.cells()
    assert result.renewed > 20 and result.balance < 1e-8
    assert np.abs(cells.pressure - 1e4 - cells.x @ slope).max() < 1e-10 * 2e4


LAYER = mpm.Hencky(2e6, 1e6, porosity=0.4, conductivity=1e-7)
CENTRE = partial(np.interp, xp=[0, 1], fp=[0.6, 3.4])


def under_a_load_that_travels(numerics, fixed=False, fluid=None):
    """Return a layer under a moving pressure, in cells that are fine under the pressure, or fine everywhere."""
    y, follow = fine_about(0, 1.25, 14, 1.0, 0.25, 3), lambda t: [fine_about(0, 4, 40, CENTRE(t + 1 / 8), 0.3), y]
    lines = [np.linspace(0, 4, 161), y] if fixed else follow(0)
    grid = mpm.Grid(lines=lines, **({} if fixed else {"follow": follow}))
    load = mpm.Pressure("top", lambda t, X: 4e5 * np.exp(-(((X[:, 0] - CENTRE(t)) / 0.1) ** 4)))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    body = mpm.box(grid, [0, 0], [4, 1])
    return mpm.Simulation(grid, [body], [LAYER], walls=walls, conditions=[load], numerics=numerics, fluid=fluid)


@pytest.mark.parametrize("fluid", [None, mpm.Fluid(bulk=1e8)], ids=["dry", "wet"])
def test_division_carries_the_accuracy_of_fine_cells_along(fluid):
    """Means of displacement, stress and pressure under the load, compared with cells that are fine everywhere."""
    errors, means = [], []
    for fixed, numerics in ((True, mpm.Numerics()), (False, mpm.Numerics()), (False, RENEWAL)):
        s, found = under_a_load_that_travels(numerics, fixed, fluid), []
        for k in range(8):
            s.run((k + 1) / 8, 1 / 8, progress=False)
            p, X = s.points, s.points.origin.mean(axis=1)
            weight = p.volume0 * ((np.abs(X[:, 0] - CENTRE(s.t)) < 0.08) & (X[:, 1] > 0.75))
            found.append(weight @ np.stack([p.displacement[:, 1], s.effective_stress()[:, 1, 1], p.pressure]).T)
            found[-1] /= weight.sum()
        means.append(np.array(found))
        errors.append(np.linalg.norm(means[-1] - means[0], axis=0) / (np.linalg.norm(means[0], axis=0) + 1e-9))
        print(errors[-1], len(p))
    assert (errors[2] < 0.04).all() and (errors[2][:2] < 0.4 * errors[1][:2]).all()


PRESSES = partial(pressed, loaded=False), pytest.param(pressed_in_3d, marks=pytest.mark.slow)


@pytest.mark.parametrize("press", PRESSES, ids=["2D", "3D"])
def test_forces_and_fluid_are_in_balance(press):
    """In each step, below a rough disc or ball that rotates and sinks into the soil."""
    s, replaced = press(), 0
    for _ in range(6):
        report = s.step(0.25)
        replaced += report.renewed
        on_grid = s.scene.last[0]
        top = on_grid.cut.surface(s.state.stage.surfaces[0])
        assert top.area0.sum() == pytest.approx(2.0 if s.grid.dim == 2 else 1.8, rel=1e-12)
        gravity = s.state.stage.conditions["gravity"]
        assert report.balance < 1e-10 and imbalance(s, on_grid.cut.points, SOIL, gravity) < 1e-9
    assert replaced > 1000 and s.tool_forces["tool"][s.grid.dim - 1] < -1e3


@pytest.mark.parametrize("axisymmetric, rate", [(False, 0.06), (True, 0.25)])
def test_clay_is_renewed_beside_soil_that_is_divided_with_all_balances(axisymmetric, rate):
    """Wet clay yields below a smooth disc or ball, while the finest cells move to the right."""
    clay = mpm.DruckerPrager(2e6, 1e6, friction=0.0, dilation=0.0, cohesion=2e3, porosity=0.4, conductivity=1e-6)
    ball = mpm.Tool(mpm.Ball((0.0 if axisymmetric else 1.0, 1.25), 0.25), lambda t: (0, -rate * t))
    s = pressed(loaded=False, soil=clay, disc=ball, axisymmetric=axisymmetric)
    for _ in range(9):
        report = s.step(0.05)
        before = s.scene.last[0].cut.points
        assert report.balance < 1e-9 and (axisymmetric or imbalance(s, before, clay, GRAVITY) < 1e-9)
        area = s.scene.last[0].cut.surface(s.state.stage.surfaces[0]).area0.sum()
        assert area == pytest.approx(4 * np.pi if axisymmetric else 2.0, rel=1e-7)
    made = s.points.id[s.points.id >= len(s.bodies[0])] - len(s.bodies[0])
    assert (made % 2 == 0).sum() > 50 < (made % 2 == 1).sum()  # renewed, divided


def test_a_run_goes_on_with_the_same_bits(tmp_path):
    ends, file = [], tmp_path / "kept"
    for parts in (1, 2):
        s, again = pressed(), pressed()
        result = s.run(1.0, 0.25, progress=False, checkpoint=mpm.Checkpoint(file))
        if parts == 2:
            s, result = again, mpm.resume(again, file)
        assert s.run(2.0, 0.25, progress=False, after=result).renewed > 1000
        ends.append(s.points)
    assert all((one == other).all() for one, other in zip(*(points.arrays for points in ends), strict=True))


def test_domains_of_a_mesh_are_divided_and_merge_again():
    """Merging ends at the seeded domains, because domains of a mesh have no lattice."""
    grid = travelling(2, 1.3, 16, there_and_back)
    body = mpm.from_mesh(grid, box_mesh("triangle", (4, 3), [0, 0], [1.3, 1.0]))
    load, walls = mpm.Pressure("top", lambda t: 1e5 * t), {"left": "x", "right": "x", "bottom": "y"}
    s = mpm.Simulation(grid, [body], [mpm.NeoHookean(2e6, 1e6)], walls=walls, conditions=[load], numerics=RENEWAL)
    counts = []
    for _ in range(7):
        s.step(1.0)
        counts.append(len(s.points))
        stress = s.effective_stress()
        assert np.abs(stress - stress.mean(axis=0)).max() < 1e-7 * np.abs(stress).max()
    print(counts)
    assert min(counts) >= counts[0] == len(body) < max(counts)


def in_a_frame(frame):
    """Return a block with odd numbers of rows in a frame, and a function that maps positions to the first frame."""
    to = {"mirrored": lambda x: x * [-1, 1] + [1.7, 0], "exchanged": lambda x: x[:, ::-1]}.get(frame, lambda x: x)

    def lines(t):
        a = fine_about(0, 1.7, 17, 0.4 + 0.9 * np.sin(2 * t) ** 2)
        b = fine_about(0, 1.3, 10, 0.5 + 0.4 * np.sin(3 * t) ** 2, 0.2, 3)
        return [b, a] if frame == "exchanged" else [1.7 - a[::-1] if frame == "mirrored" else a, b]

    top, left, bottom = {"mirrored": ("top", "right", "bottom"), "exchanged": ("right", "bottom", "left")}.get(
        frame, ("top", "left", "bottom")
    )
    walls = {left: "y", bottom: "xy"} if frame == "exchanged" else {left: "x", bottom: "xy"}
    load = mpm.Pressure(top, lambda t, X: 3e4 * t * np.exp(-(((to(X)[:, 0] - 0.6) / 0.2) ** 2)))
    gravity = to(np.array([[2.0, -9.81]]))[0] - to(np.zeros((1, 2)))[0]
    grid, ends = mpm.Grid(lines=lines(0), follow=lines), to(np.array([[0.0, 0.0], [1.45, 0.95]]))
    body = mpm.box(grid, ends.min(axis=0), ends.max(axis=0))
    acting = {"conditions": [load, mpm.Drained(top)], "walls": walls, "gravity": gravity, "fluid": mpm.Fluid()}
    return mpm.Simulation(grid, [body], [SOIL], numerics=mpm.Numerics(renewal=True, tolerance=1e-12), **acting), to


@pytest.mark.parametrize("frame", ["mirrored", "exchanged"])
def test_the_frame_changes_nothing(frame):
    (one, _), (other, to) = in_a_frame(""), in_a_frame(frame)
    assert all(count % 2 for count in one.bodies[0].lattice)
    for _ in range(5):
        counts = [s.step(0.25).renewed for s in (one, other)]
        assert counts[0] == counts[1]
    far, at = cKDTree(one.points.x).query(to(other.points.x))
    assert len(one.points) == len(other.points) and far.max() < 1e-11
    assert other.points.pressure == pytest.approx(one.points.pressure[at], abs=1e-8 * one.points.pressure.max())


def refused(grid, **more):
    """Create a scene with renewal on a grid."""
    options = {"numerics": RENEWAL, **more}
    mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [SOFT], walls={"bottom": "xy"}, **options)


@pytest.mark.parametrize(
    "make, value",
    [
        (lambda: refused(mpm.Grid([0, 0], [1, 1], [4, 4])), "no soil that yields"),
        (lambda: refused(travelling(2, 1.0, 8, np.sin), inertia=True), "inertia"),
    ],
)
def test_scenes_that_cannot_be_divided_are_refused_in_one_line(make, value):
    refused_in_one_line(make, "Numerics(renewal=True)", value, None, 300)
