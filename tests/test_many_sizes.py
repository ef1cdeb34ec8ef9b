# SPDX-License-Identifier: MIT
"""Cells of many sizes, between random lines, have the properties of equal cells, also in the limit of equal sizes."""

import cryer
import footing
import manufactured as made
import numpy as np
import poroelastic_beam
import pytest
import terzaghi
from helpers import SOFT, left_after_a_way_and_back, rates, refused_in_one_line, thresholds

import mpm_dolfinx as mpm
from mpm_dolfinx.grid.grid import SIDES
from mpm_dolfinx.points.cutting import centroids, corner_bits, cut
from mpm_dolfinx.verification.biot_fem import BiotFEM
from mpm_dolfinx.verification.exact import terzaghi_pressure

KINDS = [(2, False), (2, True), (3, False)]
EXACT = mpm.Numerics(tolerance=1e-12)


def at_random(low, high, cells, seed=0, ratio=3.0):
    """Return lines whose neighbouring cells differ by a factor of up to three."""
    rng = np.random.default_rng(seed)
    out = []
    for a, b, n in zip(low, high, cells, strict=True):
        x = np.append(0.0, np.cumsum(rng.uniform(1, ratio, n)))
        out.append(a + (b - a) * x / x[-1])
    return out


def uneven(dim, axisymmetric=False, seed=0, high=1.3):
    cells = (8, 7) if dim == 2 else (5, 4, 5)
    return mpm.Grid(lines=at_random([0] * dim, [high] * dim, cells, seed), axisymmetric=axisymmetric)


def nearly_equal(lower, upper, cells, **more):
    """Return the grid of equal cells, and a grid whose lines differ by slightly more than rounding."""
    equal = mpm.Grid(lower, upper, cells, **more)
    lines = [np.linspace(a, b, n + 1) for a, b, n in zip(lower, upper, cells, strict=True)]
    for x in lines:
        x[1:-1] *= 1 + 1e-12 * (-1) ** np.arange(len(x) - 2)
    other = mpm.Grid(lines=lines, **more)
    assert equal.even and not other.even
    return equal, other


# ---- lines --------------------------------------------------------------------------------------------


def test_lines_that_are_equally_far_apart_are_the_grid_of_equal_cells():
    """The arithmetic is the same, and therefore the bits and the time."""
    equal = mpm.Grid([0.1, -0.3], [1.3, 0.9], [12, 10])
    lines = mpm.Grid(lines=[np.linspace(0.1, 1.3, 13), np.linspace(-0.3, 0.9, 11)])
    ends = []
    for grid in (equal, lines):
        assert grid.even and (grid.h == equal.h).all()
        body = mpm.box(grid, [0.1, 0.1], [1.1, 0.4])
        load = mpm.Traction("top", lambda t: (0, -1e4 * t))
        options = {"walls": {"left": "xy"}, "fluid": mpm.Fluid(), "conditions": [load, mpm.Drained("right")]}
        s = mpm.Simulation(grid, [body], [SOFT], **options)
        s.run(0.1, 0.05, progress=False)
        ends.append(s.points)
    assert (ends[0].corners == ends[1].corners).all() and (ends[0].pressure == ends[1].pressure).all()


@pytest.mark.parametrize("largest", [0.4, np.inf])
def test_graded_lines_meet_the_boxes_and_grow_by_the_ratio(largest):
    lower, upper = np.array([-2.0, 0.0]), np.array([5.0, 3.0])
    boxes = [[[0.0, 1.0], [1.0, 2.0]], [[3.2, 0.0], [4.0, 2.5]]]
    lines = mpm.graded(lower, upper, boxes, 0.1, 1.15, largest)
    for a, x in enumerate(lines):
        width = np.diff(x)
        assert x[0] == lower[a] and x[-1] == upper[a]
        assert width.max() < min(largest, 1.0) * (1 + 1e-12) and (width[1:] / width[:-1]).max() < 1.15 + 1e-9
        for box in boxes:
            inside = (x[:-1] > box[0][a] - 1e-9) & (x[1:] < box[1][a] + 1e-9)
            assert width[inside] == pytest.approx(0.1) and inside.sum() == round((box[1][a] - box[0][a]) / 0.1)


@pytest.mark.parametrize("gap", [1e-3, 0.05, 0.1])
def test_no_cell_is_narrow_where_boxes_are_near_each_other_or_a_side(gap):
    """Lines that follow a tool would otherwise follow the narrowest cell."""
    near = mpm.graded([0, 0], [1, 1], [[[0, 0], [0.4, 1]], [[0.4 + gap, 0], [1, 1 - gap]]], 0.1)
    for x in near:
        assert np.diff(x) == pytest.approx(0.1)


def test_points_and_nodes_are_found_and_shape_functions_are_exact_for_linear_fields():
    for dim, axisymmetric in KINDS:
        grid = uneven(dim, axisymmetric)
        x = np.random.default_rng(1).uniform(grid.low, grid.high, (200, dim))
        cells = grid.locals[grid.number(grid.index_from_base(x))]
        assert (np.abs(x - grid.midpoints[cells]) <= grid.sizes(cells) / 2 * (1 + 1e-12)).all()
        assert grid.in_cells(grid.node_x) == pytest.approx(grid.node_places(np.arange(len(grid.node_x)))[:, :-1])
        A = np.random.default_rng(2).normal(size=(dim, dim))
        assert grid.at(cells, x, grid.node_x @ A.T) == pytest.approx(x @ A.T, abs=1e-12)
        slopes = np.einsum("nkd,nkc->ncd", grid.shape_gradients(cells, x), (grid.node_x @ A.T)[grid.cell_nodes[cells]])
        assert slopes == pytest.approx(np.broadcast_to(A, slopes.shape), abs=1e-12)


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_domains_are_cut_exactly(dim, axisymmetric):
    """Volumes, centroids, and areas on faces between cells, from both sides."""
    grid, rng = uneven(dim, axisymmetric), np.random.default_rng(3)
    F = np.eye(dim) + 0.3 * rng.normal(size=(100, dim, dim))
    corners = rng.uniform(0.4, 0.9, (100, 1, dim)) + np.einsum("nab,kb->nka", 0.2 * F, corner_bits(dim) - 0.5)
    corners = corners.clip(1e-3, 1.299)
    p = cut(grid, corners)
    index = np.stack(np.unravel_index(p.cell, tuple(grid.shape)), axis=1)
    assert (p.x > grid.places(index)).all() and (p.x < grid.places(index + 1)).all()
    assert np.bincount(p.point, p.fraction) == pytest.approx(1, abs=1e-13)
    if not axisymmetric:
        mean = np.stack([np.bincount(p.point, p.fraction * p.x[:, a]) for a in range(dim)], axis=1)
        assert mean == pytest.approx(centroids(corners), abs=1e-13)
    key = p.point * grid.cells + p.cell
    for axis in range(dim):
        stride = int(np.prod(grid.shape[axis + 1 :]))
        beyond = dict(zip(key.tolist(), p.faces[:, axis, 0], strict=True))
        there = [beyond.get(k + stride, 0.0) for k in key.tolist()]
        assert p.faces[:, axis, 1] == pytest.approx(there, abs=1e-14)
    finer = mpm.Grid(  # each cell in two: volumes add up
        lines=[np.sort(np.append(x, (x[1:] + x[:-1]) / 2)) for x in grid.lines], axisymmetric=axisymmetric
    )
    q = cut(finer, corners)
    there = grid.number(np.stack(np.unravel_index(q.cell, tuple(finer.shape)), axis=1) // 2)
    parts = np.bincount(np.searchsorted(key, q.point * grid.cells + there), q.fraction, len(key))
    assert parts == pytest.approx(p.fraction, abs=1e-12)


# ---- exact solutions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_even_stresses_are_exact(dim, axisymmetric):
    """A block that ends within cells is compressed on all sides by a tenth, in two steps; lines cross its domains."""
    grid = uneven(dim, axisymmetric)
    body = mpm.box(grid, [0] * dim, [1.03, 1.01, 0.97][:dim] if dim == 3 else [1.03, 1.01])
    push = (lambda t: -3e5 * t) if not axisymmetric else (lambda t: -4e5 * t)
    sides = ["right", "top", "back"][:dim]
    walls = {"left": "x", "bottom": "y"} if dim == 2 else {"left": "x", "front": "y", "bottom": "z"}
    loads = [mpm.Pressure(side, push) for side in sides]
    soil = mpm.NeoHookean(bulk=2e6, shear=1e6)
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=loads, numerics=EXACT)
    s.run(1.0, 0.5, progress=False)
    stress = s.effective_stress()
    assert np.abs(stress - stress.mean(axis=0)).max() < 1e-10 * np.abs(stress).max()
    assert np.abs(s.points.F - s.points.F.mean(axis=0)).max() < 1e-10
    assert grid.cells_between(s.points.reference, s.points.corners).max() > 0.1


@pytest.mark.parametrize("dim, axisymmetric", KINDS)
def test_linear_pressures_are_exact(dim, axisymmetric):
    """Steady flow through a block that ends within cells, in cells and at probes, with gravity."""
    grid, g = uneven(dim, axisymmetric), np.array([0.0] * (dim - 1) + [-9.81])
    slope = np.array([0.0 if axisymmetric else 3e3, -2e3, 1e3])[:dim]
    body = mpm.box(grid, [0] * dim, [1.03] * dim)
    rock = mpm.Hencky(bulk=1e15, shear=1e15, porosity=0.4, conductivity=1e-4)
    names = ["bottom", "top"] if axisymmetric else list(SIDES[dim])
    drained = [mpm.Drained(name, lambda x: 1e4 + x @ slope) for name in names]
    hold = dict.fromkeys(("left", "bottom", "front")[: dim if dim == 3 else 2], "xyz"[:dim])
    options = {"walls": hold, "fluid": mpm.Fluid(bulk=np.inf), "gravity": g, "conditions": drained, "numerics": EXACT}
    s = mpm.Simulation(grid, [body], [rock], **options)
    asked = mpm.probes([body], np.random.default_rng(4).uniform(0.05, 0.98, (6, dim)))
    result = s.run(2e3, 1e3, probes=asked, progress=False)
    cells = s.cells()
    assert np.abs(cells.pressure - 1e4 - cells.x @ slope).max() < 1e-10 * 2e4
    assert np.abs(result.probe_pressure[-1] - 1e4 - asked.x0 @ slope).max() < 1e-8 * 2e4


def test_a_quadratic_motion_is_followed_exactly_by_corners():
    """Differences at the ends of an edge are divided by the distances, so corners follow parabolas."""
    from mpm_dolfinx.domains.bending import followed

    grid = uneven(2)
    cells = np.arange(grid.num_owned, dtype=np.int32)
    x = grid.midpoints + 0.3 * grid.sizes(cells) * [1, -1]

    def motion(x):
        return np.stack([x[:, 0] ** 2 - x[:, 0] * x[:, 1], x[:, 1] ** 2 + 2 * x[:, 0]], axis=1)

    field, more = followed(grid, cells, x, motion(grid.node_x), np.ones(grid.num_local, dtype=bool))
    assert field + more == pytest.approx(motion(x), abs=1e-12)


# ---- beside equal cells -------------------------------------------------------------------------------


def beam(grid):
    """Return a clamped wet beam with stiff ground, which sags under its weight."""
    soil = mpm.Hencky(1e7, 4e6, porosity=0.4, conductivity=1e-5)
    acting = [mpm.Traction("right", lambda t: (0, -300 * t)), mpm.Drained("top")]
    body = mpm.box(grid, [0, 0.3], [1, 0.6])
    more = {"fluid": mpm.Fluid(), "gravity": (0, -9.81), "walls": {"left": "xy"}, "conditions": acting}
    return mpm.Simulation(grid, [body], [soil], **more)


def layers(grid):
    """Return two settling layers; the conductivity of the upper layer changes."""
    bodies = [mpm.box(grid, [0, 0], [1, 0.4]), mpm.box(grid, [0, 0.4], [1, 0.8], material=1)]
    law = mpm.kozeny_carman
    soils = [mpm.Hencky(1e5, 4e4, porosity=0.4, conductivity=k, conductivity_law=law) for k in (1e-5, 1e-4)]
    acting = [mpm.Drained("top"), mpm.Traction("top", lambda t: (0, -1000.0 * t))]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(grid, bodies, soils, fluid=mpm.Fluid(), walls=walls, conditions=acting)


def yielding(grid, **soil):
    """Return soil with a side pushed in, next to its drained top."""
    soil = mpm.DruckerPrager(1e6, 4e5, porosity=0.4, conductivity=1e-5, cohesion=1e3, friction=20.0, dilation=5.0)
    push = mpm.Displacement("top", lambda t: (0, -0.02 * t), region=([0, 0.7], [0.35, 0.9]))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    body = mpm.box(grid, [0, 0], [1, 0.8])
    return mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls=walls, conditions=[push])


def softening(grid):
    """Return soil whose softening depends on the size of each cell."""
    soil = mpm.SofteningDruckerPrager(
        1e6, 4e5, cohesion=1e3, friction=0.0, dilation=0.0, residual=500.0, slip=0.05, viscosity=10.0
    )
    push = mpm.Displacement("top", lambda t: (0, -0.01 * t), region=([0, 0.7], [0.35, 0.9]))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.8])], [soil], walls=walls, conditions=[push])


def vibrating(grid):
    """Return a wet beam with inertia after its release."""
    soil = mpm.Hencky(1e5, 4e4, porosity=0.4, conductivity=1e-3, grain_density=2600)
    body = mpm.box(grid, [0, 0.3], [0.6, 0.6])
    more = {"fluid": mpm.Fluid(), "inertia": True, "gravity": (0, -9.81), "walls": {"left": "xy"}}
    return mpm.Simulation(grid, [body], [soil], conditions=[mpm.Drained("top")], **more)


def touched(grid):
    """Return soft soil under a rough disc."""
    tool = mpm.Tool(mpm.Ball([0.5, 1.0], 0.2), displacement=lambda t: (0, -0.05 * t), friction=0.3)
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    soil = mpm.Hencky(1e5, 4e4)
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.8])], [soil], walls=walls, conditions=[tool])


def draining(grid):
    """Return soil that drains under suction."""
    dries = mpm.VanGenuchten(entry=1e4, n=2.0)
    soil = mpm.Hencky(1e6, 4e5, porosity=0.4, conductivity=1e-5, retention=dries)
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    more = {"fluid": mpm.Fluid(), "gravity": (0, -9.81), "walls": walls}
    body = mpm.box(grid, [0, 0], [1, 0.8])
    return mpm.Simulation(grid, [body], [soil], conditions=[mpm.Drained("bottom", -5e3)], **more)


def sliding(grid):
    """Return a block pushed along another one, with friction."""
    lower, upper = mpm.box(grid, [0.1, 0], [1.1, 0.5]), mpm.box(grid, [0.4, 0.5], [0.7, 0.8])
    load = mpm.Traction("top", lambda t: (300 * t, -1e3), region=([0, 0.7], [1.2, 1.2]))
    acting = [load, mpm.Contact(1, 0, friction=0.5)]
    soil = mpm.Hencky(1e6 / 3, 5e5)
    return mpm.Simulation(grid, [lower, upper], [soil], walls={"bottom": "xy"}, conditions=acting)


def of_points(grid):
    """Return a dry beam with integration at its points."""
    load = mpm.Traction("right", lambda t: (0, -100 * t))
    numerics = mpm.Numerics(quadrature="point")
    body = mpm.box(grid, [0, 0.3], [1, 0.6])
    return mpm.Simulation(
        grid, [body], [mpm.Hencky(1e5, 4e4)], walls={"left": "xy"}, conditions=[load], numerics=numerics
    )


SCENES = [(beam, 1.0), (layers, 1.0), (yielding, 1.0), (softening, 1.0), (vibrating, 0.1), (touched, 1.0)]
SCENES += [(draining, 1e3), (of_points, 1.0), (sliding, 1.0)]


@pytest.mark.parametrize(
    "make, end",
    [pytest.param(*s, marks=[] if s[0] in (beam, touched, sliding) else [pytest.mark.slow]) for s in SCENES],
)
def test_lines_that_are_nearly_equal_show_what_equal_cells_do(make, end):
    """The test compares all terms of the code for cells of many sizes with the code for equal cells."""
    ends = []
    for grid in nearly_equal([0, 0], [1.2, 1.2], [12, 12]):
        s = make(grid)
        s.run(end, end / 2, progress=False)
        moved = s.points.corners - s.points.reference
        ends.append([moved, s.effective_stress(), s.points.pressure])
    for one, other in zip(*ends, strict=True):
        assert np.abs(one - other).max() <= 1e-5 * np.abs(one).max()


def test_multigrid_takes_as_many_iterations_on_graded_lines(monkeypatch):
    """As many iterations as on equal cells of mean size, to within a half, and the solution of a direct solver."""
    found = []
    lines = mpm.graded([0, -0.6], [1.2, 0.4], [[[0.0, 0.0], [0.3, 0.3]]], 0.02, 1.1)
    for grid, least in ((mpm.Grid([0, -0.6], [1.2, 0.4], [36, 30]), 1), (mpm.Grid(lines=lines), 1), (None, 10**6)):
        thresholds(monkeypatch, multigrid_2d=least, coarsest=50)
        grid = grid or mpm.Grid(lines=lines)
        load, more = mpm.Traction("top", lambda t: (0, -1e5 * t)), {"fluid": mpm.Fluid(), "walls": {"left": "xy"}}
        body, soil = mpm.box(grid, [0, 0], [1, 0.3]), mpm.Hencky(6.7e6, 3.1e6, porosity=0.4, conductivity=1e-5)
        s = mpm.Simulation(grid, [body], [soil], conditions=[load, mpm.Drained("right")], **more)
        result = s.run(0.04, 0.02, progress=False)
        found.append((result.coupling / result.newton, s.points.corners))
    assert found[1][0] < 1.5 * found[0][0], found
    assert np.abs(found[1][1] - found[2][1]).max() < 1e-9


# ---- errors -------------------------------------------------------------------------------------------


def smooth(cells, strength):
    """Return lines from 0 to 1 with smoothly varying distances, of ratio (1 + strength) / (1 - strength)."""
    t = np.arange(cells + 1) / cells
    return t + strength / (2 * np.pi) * np.sin(2 * np.pi * t)


@pytest.mark.slow
@pytest.mark.parametrize("strength, sizes, per_cell", [(0.6, (6, 12, 24), 2), (-0.6, (24, 48), 1)])
def test_displacement_and_pressure_are_of_second_order_on_smoothly_graded_lines(strength, sizes, per_cell):
    """Cells of ratio 1 : 4, fine in the middle or at both sides, while the top moves by a fifth of the block."""
    found = []
    for cells in sizes:
        x, steps = smooth(cells, strength), per_cell * cells
        lines = [x, np.append(x, 1 + (1 - x[-2]) * np.array([1, 2]))]
        grid = mpm.Grid(lines=lines)
        s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [made.SOIL], **made.PHYSICS)
        for _ in range(steps):
            assert s.step(12.0 / steps).balance < 1e-8
        found.append(made.errors(s))
    print("orders of displacement and pressure:", *rates(found))
    assert rates(found).min() > 1.9, found


def over_equal(name, errors, *, bound=1.3):
    """Print and check the largest and the rms error of a history on graded lines, divided by those on equal cells."""
    largest, mean = (np.divide(*(of(e) for e in errors[::-1])) for of in (np.max, lambda e: np.sqrt(np.mean(e**2))))
    print(f"{name}: error on graded lines over that of equal cells: largest {largest:.2f}, mean {mean:.2f}")
    assert 0 < largest <= bound and 0 < mean <= bound, errors


@pytest.mark.parametrize("low, largest, until, part", [(0.7, np.inf, 0.01, 0.55), (0.4, 2.0, 0.1, 0.85)])
def test_a_boundary_layer_needs_fine_cells_where_it_is(low, largest, until, part):
    """Terzaghi's column with fine cells above `low`: fewer cells have the same error while a boundary layer exists.

    From T = 0.1 on, the pressure varies in the whole column, and only cells in its lower part may be larger.
    """
    errors, cells, times = [], 50, np.array([0.005, 0.01, 0.1])
    h, load = 1 / cells, 1e-5 * terzaghi.SOIL.oedometric
    lines = mpm.graded([0, 0], [h, 1], [[[0, low], [h, 1]]], h, 1.2, largest * h)
    for grid in (mpm.Grid([0, 0], [h, 1], [1, cells]), mpm.Grid(lines=lines)):
        acting = [mpm.Traction("top", (0, -load)), mpm.Drained("top")]
        walls = {"left": "x", "right": "x", "bottom": "y"}
        body, more = mpm.box(grid, [0, 0], [h, 1]), {"fluid": terzaghi.WATER, "walls": walls}
        s = mpm.Simulation(grid, [body], [terzaghi.SOIL], conditions=acting, **more)
        of = []
        for T in times:
            dt = 2.5e-4 if T <= 0.01 else 1e-3
            s.run(T / terzaghi.CV, dt / terzaghi.CV, progress=False)
            at = s.cells()
            of.append(np.abs(at.pressure / load - terzaghi_pressure(1 - at.x[:, 1], T, 1.0, 1.0)).max())
        errors.append(np.array(of))
    ratios = errors[1] / errors[0]
    print(f"Terzaghi, errors at T = {times} over those of equal cells:", ratios)
    assert (ratios[times <= until] < 1.3).all(), errors
    assert len(lines[1]) - 1 < part * cells


def test_a_beam_bends_and_drains_on_graded_lines_as_on_equal_ones():
    """Lines are fine at the clamp. Errors of the whole history, compared with finite elements in equal steps."""
    o = poroelastic_beam.arguments(["--h", "0.03", "--dt", "0.06"])
    (equal, bottom), errors, active = poroelastic_beam.scene(o), [], []
    h, top = equal.grid.h, bottom + poroelastic_beam.HEIGHT
    lines = mpm.graded(equal.grid.lower, equal.grid.upper, [[[0, bottom], [0.3, top + h[1] / 2]]], h, 1.2)
    grid = mpm.Grid(lines=lines)
    beam = mpm.box(grid, [0, bottom], [poroelastic_beam.LENGTH, top])
    graded = mpm.Simulation(grid, [beam], [poroelastic_beam.material(o)], **poroelastic_beam.physics(o))
    size = [poroelastic_beam.LENGTH, poroelastic_beam.HEIGHT]
    fem = BiotFEM(mpm.Grid([0, 0], size, (40, 12)), poroelastic_beam.material(o), **poroelastic_beam.physics(o))
    exact = np.array(fem.run(o.t_end, o.dt, probes=[[1.0, 0.15]]).displacement)[1:, 0, 1]
    for s in (equal, graded):
        result = s.run(o.t_end, o.dt, probes=mpm.probes(s.bodies, [[1.0, bottom + 0.15]]), progress=False)
        errors.append(np.abs(np.array(result.displacement)[1:, 0, 1] / exact - 1))
        active.append(s.scene.last[0].active_cells)
    over_equal("beam", errors)
    assert active[1] < 0.6 * active[0], active


def test_a_sphere_consolidates_on_graded_lines_as_on_equal_ones():
    """Cryer's sphere in axisymmetry, with fine cells at its centre and its surface: whole history of the pressure."""
    n, errors, active = 20, [], []
    upper, fine = [1 + 1 / n] * 2, [[[0, 0], [0.25, 0.25]], [[0.75, 0.75], [1 + 1 / n] * 2]]
    for grid in (None, mpm.Grid(lines=mpm.graded([0, 0], upper, fine, 1 / n, 1.2), axisymmetric=True)):
        _, out = cryer.run(n, 48, True, grid)
        errors.append(np.abs(out.pressure - cryer.exact(out.T)))
        active.append(out.cells)
    over_equal("sphere", errors)
    assert active[1] < 0.85 * active[0], active


# ---- what else ----------------------------------------------------------------------------------------


def test_a_run_goes_on_from_a_checkpoint_with_the_same_bits_and_on_the_same_lines_only(tmp_path):
    file, ends = tmp_path / "kept", []
    for parts in (1, 2):
        s = beam(uneven(2))
        result = s.run(0.5, 0.5, progress=False, checkpoint=mpm.Checkpoint(file))
        if parts == 2:
            s = beam(uneven(2))
            result = mpm.resume(s, file)
        s.run(1.0, 0.5, progress=False, after=result)
        ends.append(s.points)
    assert (ends[0].corners == ends[1].corners).all() and (ends[0].pressure == ends[1].pressure).all()
    other = beam(uneven(2, seed=1))
    refused_in_one_line(lambda: mpm.resume(other, file), "lines", "0.", None, 1000)


@pytest.mark.parametrize(
    "make, name, value",
    [
        (lambda: mpm.Grid(lines=[[0, 1]]), "grid: lines", "[[0, 1]]"),
        (lambda: mpm.Grid(lines=[[0, 1], [0, 2, 1]]), "grid: lines along y", "[0, 2, 1]"),
        (lambda: mpm.Grid(lines=[[0, 1], [0, np.nan]]), "grid: lines along y", "nan"),
        (lambda: mpm.Grid([0, 0], lines=[[0, 1], [0, 1]]), "grid: lines", "lower"),
        (lambda: mpm.Grid(lines=[[0, 1, 3], [-1, 1]]).h, "grid", "sizes"),
        (lambda: mpm.Grid(lines=[[-1, 1, 2], [0, 1]], axisymmetric=True), "axisymmetric", "radius"),
        (lambda: mpm.graded([0, 0], [1, 1], [[[0, 0], [2, 1]]], 0.1), "graded: fine", "[[[0, 0], [2, 1]]]"),
        (lambda: mpm.graded([0, 0], [1, 1], [[[0, 0], [1, 1]]], 0.1, ratio=1.0), "graded: ratio", "1"),
        (lambda: mpm.graded([0, 0], [1, 1], [[[0, 0], [1, 1]]], 0.1, largest=0.01), "graded: largest", "0.01"),
        (lambda: mpm.polygon(uneven(2), [[0, 0], [1, 0], [0, 1]], "side"), "polygon: size", "None"),
    ],
)
def test_what_lines_do_not_allow_is_refused_in_one_line(make, name, value):
    refused_in_one_line(make, name, value, None, 200)


def test_bodies_in_contact_press_each_other_evenly_between_lines_at_random():
    """The penetration that contact allows is a thousandth of a cell."""
    lines, low, high = at_random([0, 0], [1, 2], [8, 16], 5), 0.54625, 1.06
    grid = mpm.Grid(lines=lines)
    bodies = [mpm.box(grid, [0, 0], [1, low], per_cell=2), mpm.box(grid, [0, low], [1, high], per_cell=3)]
    hold = mpm.Displacement("top", (0, -0.1), region=([0, 0.8], [1, 2]))
    walls = {"bottom": "y", "left": "x", "right": "x"}
    soil = mpm.Hencky(bulk=1e6 / 3, shear=5e5)
    s = mpm.Simulation(grid, bodies, [soil], walls=walls, conditions=[hold, mpm.Contact(0, 1)])
    s.step(1.0)
    stretch = 1 - 0.1 / high
    exact = 1e6 * np.log(stretch) / stretch
    assert s.tool_forces.array[0, 1] == pytest.approx(exact, rel=1e-3)
    assert np.abs(s.effective_stress()[:, 1, 1] / exact - 1).max() < 2e-3


@pytest.mark.parametrize(("start", "way", "cut"), [(0.2, 0.04, False), (0.2, 0.12, True), (2.0, 0.12, False)])
def test_bodies_slide_in_a_step_by_a_cell_of_the_size_where_they_are(start, way, cut):
    """Cells of 0.05 m up to x = 1.2 m, and of 0.2 m beyond; y is divided equally."""
    grid = mpm.Grid(lines=[np.append(np.linspace(-0.4, 1.2, 33), np.linspace(1.4, 3.4, 11)), np.linspace(0, 1.2, 13)])
    ends = ((start - 0.2, 0), (start + 1, 0.4)), ((start, 0.4), (start + 0.4, 0.8))
    hold = mpm.Displacement("top", lambda t: (way * t, -0.004 * t), region=([-0.4, 0.7], [3.4, 1.2]))
    more = {"walls": {"bottom": "xy"}, "conditions": [hold, mpm.Contact(0, 1)]}
    s = mpm.Simulation(grid, [mpm.box(grid, *each) for each in ends], [SOFT], **more)
    assert bool(s.run(1.0, 1.0, progress=False).cuts) is cut


@pytest.mark.slow
def test_a_footing_in_a_large_box_of_graded_cells_carries_what_it_does_in_a_small_one_of_equal_cells():
    loads = [footing.limit_load("undrained", 5, footing.FAR[how], how == "graded").load[-1] for how in footing.FAR]
    assert loads[1] == pytest.approx(loads[0], rel=0.01)


@pytest.mark.slow
def test_a_body_that_is_carried_through_graded_lines_and_back_is_as_one_in_equal_cells():
    """A wet beam is clamped to a moving support, and bent on its path: residual stress and pressure."""
    h = 0.05
    lines = mpm.graded([-0.2, 0], [2.6, 1.2], [[[-0.2, 0.45], [1.0, 0.85]]], h, 1.2, 3 * h)
    grids = mpm.Grid([-0.2, 0], [2.6, 1.2], [56, 24]), mpm.Grid(lines=lines)
    left = [left_after_a_way_and_back(grid) for grid in grids]
    assert (left[1] < 1.5 * left[0]).all(), left
