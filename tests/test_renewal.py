# SPDX-License-Identifier: MIT
"""Renewal of yielded domains at a grid reset conserves their contents, their volume and their surface."""

from dataclasses import replace

import mpi_renewal
import numpy as np
import penetration as demo
import pytest
import ufl
from scenes.comparing import differences, resolved
from scenes.description import Block, Condition, RigidTool, Scene
from scenes.frames import Frame
from scenes.running import build, run
from test_initial_stress import ground, moved, vertical
from test_many_sizes import at_random
from test_mpi import mpirun

import mpm_dolfinx as mpm
from mpm_dolfinx.domains.renewed_faces import SeededFaces
from mpm_dolfinx.grid.grid import FACE_SIGNS, FACES
from mpm_dolfinx.mechanics.inertia import velocity_gradients
from mpm_dolfinx.points.cutting import cut, domain_volumes, volumes
from mpm_dolfinx.points.polygons import Polygons
from mpm_dolfinx.stepping import renewal

CLAY = mpm.DruckerPrager(bulk=5e6, shear=1e5, friction=0.0, dilation=0.0, cohesion=1e3)


def block(conditions=(), hole=False, uneven=False, rings=False, inner=0.07, **options):
    """Return a simulation of a block off the grid lines, with or without a round hole.

    uneven: whether lines are random. rings: whether the block is axisymmetric, `inner` m from the axis.
    """
    grid = mpm.Grid([0, 0], [2, 1.5], [16, 12], axisymmetric=rings)
    if uneven:
        grid = mpm.Grid(lines=at_random([0, 0], [2, 1.5], [16, 12]), axisymmetric=rings)
    outline = [[inner, 0.04], [1.86, 0.04], [1.86, 1.23], [inner, 1.23]]
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    round_hole = np.stack([1 + 0.3 * np.cos(angle), 0.65 + 0.3 * np.sin(angle)], axis=1)
    sides, holes = ["bottom", "right", "top", "left"], {"hole": round_hole} if hole else None
    body = mpm.polygon(grid, outline, sides, holes=holes, size=1 / 16)
    return mpm.Simulation(grid, [body], [CLAY], walls={}, conditions=list(conditions), **options)


def yielded(s, strain, hardened=0.0):
    """Return the points with an elastic strain (n, 2, 2) in the plane, marked as yielded."""
    e = np.zeros((len(s.state.points), 3, 3))
    e[:, :2, :2] = strain
    value, axes = np.linalg.eigh(2 * e)
    plastic = (axes * np.exp(value)[:, None]) @ axes.swapaxes(1, 2)
    rows = np.broadcast_to(hardened, len(e)).astype(float)
    return replace(s.state.points, data=s.state.points.data | {"plastic": plastic, "hardened": rows})


def renewed(s, points, monkeypatch, longest=1e-3):
    """Return the points after renewal of domains longer than a number of cells, and the number of these domains."""
    monkeypatch.setattr(renewal, "LONGEST", longest)
    own = renewal.Renewal(SeededFaces(s.grid, s.bodies), s.scene.materials)
    state, count = own.renewed(replace(s.state, points=points))
    return state.points, count


def strain_of(s, points):
    """Return the elastic strains (n, 3, 3)."""
    own = renewal.Renewal(SeededFaces(s.grid, s.bodies), s.scene.materials)
    return renewal._of_tensors(np.log, own._elastic(points, np.arange(len(points)))) / 2


@pytest.mark.parametrize(
    ("hole", "uneven", "given"),
    [
        (False, False, {}),
        (True, False, {}),
        (True, True, {}),
        (True, False, {"rings": True, "inner": 0.0}),
        (True, True, {"rings": True, "inner": 0.2}),
    ],
)
def test_masses_volumes_region_and_surface_stay(monkeypatch, hole, uneven, given):
    s = block(hole=hole, uneven=uneven, **given)
    old = yielded(s, 1e-3 * np.diag([1.0, -1.0]))
    new, count = renewed(s, old, monkeypatch)
    assert count > 0.9 * len(old)
    assert new.volume0.sum() == pytest.approx(old.volume0.sum(), rel=1e-13)
    assert (new.volume0 * new.J).sum() == pytest.approx((old.volume0 * old.J).sum(), rel=1e-13)
    assert volumes(new.corners).min() > 0
    before, after = (domain_volumes(points.corners, s.grid.axisymmetric).sum() for points in (old, new))
    assert after == pytest.approx(before, rel=1e-4)
    own = renewal.Renewal(SeededFaces(s.grid, s.bodies), s.scene.materials)
    before, after = (own._faces.of(points) for points in (old, new))
    total = [faces.area.sum() for faces in (before, after)]
    assert total[1] == pytest.approx(total[0], rel=1e-6 if uneven else 1e-12)  # near corners merge
    for faces, points in ((before, old), (after, new)):
        ends = np.take_along_axis(points.corners[faces.point], FACES[2][faces.face][:, :, None], axis=1)
        assert np.abs(ends - faces.ends).max() < 2e-3  # nothing has moved


@pytest.mark.parametrize(("uneven", "rings"), [(False, False), (True, False), (False, True)])
def test_strains_that_are_linear_stay_within_second_order(monkeypatch, uneven, rings):
    s = block(uneven=uneven, rings=rings, inner=0.0 if rings else 0.07)
    slope = 1e-3 * np.array([[1.0, 0.3], [-0.4, 0.8]])

    def field(x):
        return np.stack([[x @ slope[0], x @ slope[1]], [x @ slope[1], -(x @ slope[0])]]).transpose(2, 0, 1)

    new, count = renewed(s, yielded(s, field(s.state.points.x)), monkeypatch)
    off = strain_of(s, new)[:, :2, :2] - field(new.x)
    assert count and np.sqrt((off**2).mean()) < 6e-6
    assert np.abs(off).max() < 1e-4


@pytest.mark.parametrize(("uneven", "rings"), [(False, False), (True, False), (True, True)])
def test_many_renewals_keep_what_a_body_holds(monkeypatch, uneven, rings, count=12):
    """The block rotates or rises between renewals, so that other cells cut it."""
    s = block(hole=True, uneven=uneven, rings=rings, inner=0.0 if rings else 0.07)
    points = yielded(s, 1e-3 * np.diag([1.0, -1.0]), 0.1 + s.state.points.x[:, 0])
    points = replace(points, data=points.data | {"of the user": points.x[:, ::-1] * [-1.0, 1.0]})

    def held():
        mass = points.volume0
        carried = [mass @ points.data[name] for name in ("hardened", "of the user")]
        return np.hstack([mass.sum(), mass @ points.J, *carried])

    before, size = held(), domain_volumes(points.corners, rings).sum()
    R = np.array([[np.cos(0.03), -np.sin(0.03)], [np.sin(0.03), np.cos(0.03)]])
    middle = np.array([1.0, 0.65])
    for k in range(count):
        turn = R if k % 20 < 10 else R.T
        moved = {name: middle + (getattr(points, name) - middle) @ turn.T for name in ("corners", "x")}
        if rings:
            rise = [0.0, 0.03 if k % 8 < 4 else -0.03]
            moved = {name: getattr(points, name) + rise for name in ("corners", "x")}
        points, number = renewed(s, replace(points, **moved), monkeypatch, 0.5)
        assert number
    off = domain_volumes(points.corners, rings).sum() / size - 1
    print(f"{count} renewals: {held() / before - 1}, size {off:.1e}, {len(points)} points for {len(s.points)}")
    assert held() == pytest.approx(before, rel=1e-12)
    assert len(points) < 2 * len(s.points)
    assert abs(off) < 5e-3


@pytest.mark.slow
def test_a_thousand_renewals_keep_what_a_body_holds(monkeypatch):
    test_many_renewals_keep_what_a_body_holds(monkeypatch, False, False, 1000)


def momenta(s, points):
    """Return mass and momentum (3,), angular momentum, the centre of mass (2,), and the kinetic energy."""
    pieces, density = cut(s.grid, points.corners, second=True), s.scene.materials.present_density(points)
    at, L = pieces.point, velocity_gradients(points)
    m, x = pieces.fraction * (density * points.volume0 * points.J)[at], pieces.x
    v = points.velocity[at] + np.einsum("nij,nj->ni", L[at], x - points.x[at])
    turning = L[at] @ pieces.second
    spin = x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + turning[:, 1, 0] - turning[:, 0, 1]
    energy = (v**2).sum(axis=1) + np.einsum("nij,nij->n", turning, L[at])
    return np.array([m.sum(), *(m @ v)]), m @ spin, m @ x / m.sum(), m @ energy / 2


@pytest.mark.parametrize("uneven", [False, True])
def test_momentum_stays_and_a_uniform_velocity(monkeypatch, uneven):
    """The block rotates, so that the grid cuts it anew. Its centre is fixed to a millionth of a cell."""
    s = block(hole=True, uneven=uneven, inertia=True)
    points, middle = yielded(s, 1e-3 * np.diag([1.0, -1.0])), np.array([1.0, 0.65])
    R = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    points = replace(points, **{name: middle + (getattr(points, name) - middle) @ R.T for name in ("corners", "x")})
    x, y = points.x.T
    wavy = np.stack([np.sin(3 * y) + 1, x**2], axis=1)
    slope = np.array([[0 * x, 3 * np.cos(3 * y)], [2 * x, 0 * x]]).transpose(2, 0, 1)
    for v, L, energy in ((np.ones_like(wavy), 0 * slope, 1e-13), (wavy, slope, 1e-4)):
        old = replace(points, data=points.data | {"velocity": v, "F_rate": L @ points.F})
        new, count = renewed(s, old, monkeypatch, 0.4)
        assert count > 700
        before, after = momenta(s, old), momenta(s, new)
        assert after[0] == pytest.approx(before[0], rel=1e-13)
        assert after[1] == pytest.approx(before[1], rel=1e-5)
        assert after[2] == pytest.approx(before[2], abs=1e-6)
        assert after[3] == pytest.approx(before[3], rel=energy)
    new, _ = renewed(s, replace(old, data=old.data | {"velocity": 1 + 0 * v, "F_rate": 0 * L}), monkeypatch, 0.4)
    assert np.abs(new.velocity - 1).max() < 1e-13 and np.abs(new.data["F_rate"]).max() < 1e-12


def test_clay_that_flies_and_stretches_keeps_its_momentum_and_tells_its_energy():
    """Renewal dissipates less than a thousandth of the energy."""
    grid = mpm.Grid([-1, -1], [1.5, 1.5], [20, 20])
    block = mpm.box(grid, [-0.3, -0.3], [0.3, 0.3])
    clay = mpm.DruckerPrager(5e5, 1e4, friction=0.0, dilation=0.0, cohesion=50.0, porosity=0.4, grain_density=2700.0)
    motion = np.array([[2.5, -1.0], [1.0, -2.5]])
    options = {"walls": {}, "inertia": mpm.Moving(lambda x: [1.0, 0.5] + x @ motion.T)}
    s = mpm.Simulation(grid, [block], [clay], numerics=mpm.Numerics(renewal=True), **options)
    before = momenta(s, s.state.points)
    result = s.run(0.5, 0.02, energies=True, progress=False)
    after, e = momenta(s, s.state.points), result.energies
    assert result.renewed > 50 and result.cuts == 0
    assert after[0] == pytest.approx(before[0], rel=1e-12)
    assert after[1] == pytest.approx(before[1], rel=1e-3)
    assert after[2] - before[2] == pytest.approx([0.5, 0.25], abs=1e-4)
    assert 0 < e["renewal"][-1] < 1e-3 * e["kinetic"][0]
    total = e["kinetic"] + e["elastic"] + e["dissipated"] + e["renewal"]
    assert total == pytest.approx(total[0], rel=3e-3)
    assert np.abs(np.diff(total)).max() < 3e-4 * total[0]  # no jump where domains are renewed


def test_elastic_soil_is_left_alone(monkeypatch):
    """Elastic soil is renewed only in cells that it shares with distorted domains of yielded soil."""
    s = block()
    new, count = renewed(s, s.state.points, monkeypatch)
    assert count == 0 and new is s.state.points
    half = s.state.points.x[:, 0] < 1
    some = yielded(s, 1e-3 * np.diag([1.0, -1.0]) * half[:, None, None])
    new, count = renewed(s, some, monkeypatch)
    beyond = some.corners[:, :, 0].min(axis=1) > np.ceil(8 * some.corners[half, :, 0].max()) / 8
    _, at = new.find(some.id[beyond])
    assert count > 0 and len(at) == beyond.sum() > 0.7 * (~half).sum()
    assert (new.corners[at] == some.corners[beyond]).all() and (new.F[at] == some.F[beyond]).all()
    gone = np.setdiff1d(some.id[~half], new.id)
    assert len(gone) and np.isin(gone, some.id[~beyond]).all()


def springs(points, u):
    return 1e3 * ufl.inner(points.displacement, points.value(u)) * points.dx


@pytest.mark.parametrize(
    ("condition", "terms", "side"),
    [
        (mpm.Displacement("bottom", lambda t, X: 0 * X), [], "bottom"),
        (mpm.Tied("left", "right"), [], "left"),
        (None, [mpm.OnSide("left", springs)], "left"),
    ],
    ids=["held", "tied", "springs"],
)
def test_conditions_on_displacements_of_sides_act_on_these(monkeypatch, condition, terms, side):
    """Earlier, new domains had a mean displacement: held and tied sides slid, and the run failed."""
    monkeypatch.setattr(renewal, "LONGEST", 0.6)
    grid = mpm.Grid([0, 0], [1.5, 1.5], [12, 12])
    box = mpm.box(grid, [0.28, 0.2 * (side == "bottom")], [1.2, 0.8])
    ball = mpm.Tool(mpm.Ball((0.5, 1.1), 0.3), lambda t: (0.1 * t, -0.15 * t), adhesion=500.0)
    acting = {"conditions": [ball, condition] if condition else [ball], "terms": terms}
    acting["walls"] = {} if side == "bottom" else {"bottom": "xy"}
    s = mpm.Simulation(grid, [box], [mpi_renewal.CLAY], numerics=mpm.Numerics(renewal=True), **acting)
    result = s.run(0.5, 1 / 16, progress=False)
    points, stage = s.points, s.state.stage
    needed = [*(faces for _, faces, _ in stage.held), *(faces for one in stage.acting for faces in one.seeded)]
    assert result.renewed > 10 and needed
    for patch in map(s.scene.on_grid(points).cut.surface, needed):
        assert patch.origin(points) + patch.base == pytest.approx(patch.X, abs=1e-12)


@pytest.mark.parametrize("rings", [False, True])
def test_pressures_act_on_renewed_sides_as_before(monkeypatch, rings):
    """Forces and moments of the loads do not change, also on a region of a side."""
    load = mpm.Pressure("top", 1e3, region=([0.5, 0], [1.31, 2]))
    s = block([load, mpm.Traction("hole", (100.0, 200.0))], hole=True, rings=rings, inner=0.2 if rings else 0.07)
    old = yielded(s, 1e-3 * np.diag([1.0, -1.0]))
    new, count = renewed(s, old, monkeypatch)
    found = []
    for points in (old, new):
        cut = s.scene.on_grid(points).cut
        patches = cut.surfaces(s.state.stage.surfaces)
        area = [p.area(points) for p in patches]
        moment = [(p.X[:, 0] * a[:, 1]).sum() for p, a in zip(patches, area, strict=True)]
        found.append([*np.sum(area[0], axis=0), *moment, *(p.area0.sum() for p in patches)])
    assert count and found[1] == pytest.approx(found[0], rel=2e-3, abs=1e-3)


@pytest.mark.parametrize("folded", [True, False])
def test_the_surface_stays_closed_if_only_some_cells_of_a_domain_can_be_renewed(monkeypatch, folded):
    """A corner of the block is pushed into the domain below, or the top is slightly above a grid line.

    Without the folded part, or without thin parts above the grid line, the surface would be open.
    """
    grid = mpm.Grid([0, 0], [4, 4], [4, 4])
    s = mpm.Simulation(grid, [mpm.box(grid, [0.25, 0.25], [2.75, 2.25])], [CLAY], walls={})
    old = yielded(s, 1e-3 * np.diag([1.0, -1.0]))
    corners = old.corners.copy()
    if folded:
        corners[np.linalg.norm(corners - [2.75, 2.25], axis=2) < 1e-9] = [2.6, 1.7]
    else:
        corners[:, :, 1] = np.minimum(corners[:, :, 1], 2 + 1e-6)
    stays = [2.5, 1.5] if folded else [1.5, 2.0]
    s.state = replace(s.state, watched=old.id[np.linalg.norm(old.x - stays, axis=1) < 1e-9])
    new, count = renewed(s, replace(old, corners=corners), monkeypatch)
    found = []
    for points in (replace(old, corners=corners), new):
        faces = SeededFaces(s.grid, s.bodies).of(points)
        first, last = (points.corners[faces.point, FACES[2][faces.face, k]] for k in (0, 1))
        found.append(np.linalg.norm(last - first, axis=1).sum())
    assert count and len(s.state.watched) == 1
    assert found[1] == pytest.approx(found[0], rel=1e-6)
    assert (np.array(FACE_SIGNS)[faces.face] @ (last - first)) == pytest.approx([0, 0], abs=1e-9)


@pytest.mark.parametrize("off", [0.0, 1e-12, -1e-12, 0.25])
def test_regions_prevent_renewal_only_if_they_divide_faces(off):
    """Rounding of the ends of a region does not divide a face."""
    grid = mpm.Grid([0, 0], [4, 4], [4, 4])
    pressure = mpm.Pressure("top", 1.0, region=([1 + off, 0.0], [2.0 - off, 3.0]))
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [2, 2])], [CLAY], walls={"bottom": "xy"}, conditions=[pressure])
    number = SeededFaces(s.grid, s.bodies).signatures(s.state.stage.faces)[1]
    assert (number < 0).any() == (off == 0.25)


SUCTION = {"retention": ("VanGenuchten", {"entry": 2e3, "residual": 0.0, "n": 2.5})}


def layers(wet, rings=False):
    """Return the scene of a rough disc that is pushed obliquely into two layers of clay, dry or wet, next to a
    pressure.

    wet: "above" the water table, the upper layer is unsaturated.
    rings: in axisymmetry, with a ball that is pushed along the axis.
    """
    constants = {"bulk": 5e6, "shear": 1e5, "friction": 0.0, "dilation": 0.0, "porosity": 0.4, "conductivity": 1e-8}
    clay = [("DruckerPrager", constants | {"cohesion": c, "grain_density": 2600.0}) for c in (1e3, 1.5e3)]
    blocks = Block((0.0, 0.0), (1.0, 0.5), 0), Block((0.0, 0.5), (1.0, 0.83), 1)
    conditions = [Condition("pressure", "top", (1e3,), 0.3, region=((0.65, 0.0), (1.0, 1.0)))]
    if wet == "above":
        clay[1] = clay[1][0], clay[1][1] | SUCTION
    elif wet:
        conditions.append(Condition("drained", "top", (0.0,)))
    place, way = ((0.0, 0.83), (0.0, -0.07)) if rings else ((0.44, 0.83), (0.02, -0.07))
    disc = RigidTool("ball", place, 0.25, way, 1.0, adhesion=100.0)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    scene = Scene(0, (8, 10), (0.125, 0.125), rings, blocks, tuple(clay), walls, tuple(conditions), tools=(disc,))
    scene = scene.with_(level=0.4, gravity=9.81) if wet == "above" else scene
    return scene.with_(steps=8, fluid=2.2e9 if wet else None, renewal=True)


@pytest.mark.parametrize(
    ("wet", "inertia", "rings"),
    [
        (False, False, False),
        pytest.param(True, False, False, marks=pytest.mark.slow),
        (True, True, False),
        pytest.param("above", False, False, marks=pytest.mark.slow),
        pytest.param("above", True, False, marks=pytest.mark.slow),
        (False, False, True),
        (True, False, True),
        pytest.param("above", False, True, marks=pytest.mark.slow),
    ],
)
def test_domains_are_renewed_alike_in_any_frame(monkeypatch, wet, inertia, rings):
    """The scene is mirrored, rotated, translated, in other units and orders, with another body, and restarted."""
    monkeypatch.setattr(renewal, "LONGEST", 0.6)
    scene, plain = layers(wet, rings).with_(inertia=inertia), Frame.plain(2)
    # with inertia, thin domains of the eighth step amplify the rounding of displacements to 1.5e-8
    scene = scene.with_(steps=6 if wet == "above" else 7) if inertia else scene
    base = run(scene, plain)
    assert len(base[-1].place) > (1.25 if rings else 1.3) * 208
    mirrored = Frame((0, 1), (-1, 1), (1e4, -3e4), length=1e-4, stress=1e3, time=1e-3, order=3, far="resting")
    turned = Frame((1, 0), (-1, 1), (0.0, 0.0), length=1e3, stress=1e-3, time=1e3, order=5, cut=True)
    if wet == "above" and inertia:  # a jump of the far body's pressures halves steps, also without renewal
        mirrored = replace(mirrored, far=None)
    if rings:
        mirrored = replace(mirrored, signs=(1, -1), cells=(0.0, -3e4))
        turned = replace(turned, axes=(0, 1), signs=(1, 1))
    for frame in (mirrored, turned):
        apart, rounding = differences(scene, base, run(scene, frame)), resolved(scene, frame, base)
        assert max(v - 100 * rounding[name] for name, v in apart.items()) < 1e-8, (frame, apart)


@pytest.mark.parametrize(("rings", "off", "motion"), [(False, 0.13, 1e-6), (True, 0.0, 1e-9), (True, 0.13, 1e-4)])
def test_layers_at_rest_stay_there_when_all_their_domains_are_renewed(monkeypatch, rings, off, motion):
    """Two layers with pore water, whose surface is `off` above a grid line.

    Motions are divided by the settlement under the weight. In axisymmetry, the weight of a domain has one integration
    point, so new domains at a surface off the grid lines move by a ten-thousandth.
    """
    monkeypatch.setattr(renewal, "LONGEST", 1e-3)
    monkeypatch.setattr(renewal.Renewal, "flowed", lambda self, points: np.ones(len(points), dtype=bool))
    s = ground("mohr-coulomb", off=off, axisymmetric=rings, numerics=mpm.Numerics(renewal=True))
    result = s.run(1.0, 1.0, progress=False)
    assert result.renewed > 0.9 * 104
    assert moved(s) < motion * (-vertical(0.0) * 3 / 1e7)


@pytest.mark.parametrize("rings", [False, True])
def test_cells_keep_their_fluid_and_pressure(monkeypatch, rings):
    """Compared with the pressures and volume defects, except for parts of a millionth of a cell."""
    monkeypatch.setattr(renewal, "LONGEST", 0.6)
    s = build(layers(True, rings), Frame.plain(2)).simulation
    s.run((5 if rings else 4) / 8, 1 / 8, progress=False)
    old = s.state
    new, count = s.scene.for_reset(old, True)
    assert count > 10 and np.ptp(old.points.pressure) > 1e3
    pressures, fluid = [], []
    for state in (old, new):
        on_grid = s.scene.on_grid(state.points)
        p = np.zeros(s.grid.num_local)
        p[on_grid.contents.filled] = on_grid.pressures(state)
        pressures.append(p)
        points, cut = state.points, on_grid.cut
        pores = s.scene.materials.porosity(points) * points.volume0 * points.J
        held = cut.pieces.fraction * pores[cut.pieces.point] * np.exp(p[cut.cells] / s.scene.fluid.bulk)
        fluid.append([held.sum(), points.volume0 @ points.data["owed"], points.volume0 @ points.data["due"]])
    assert pressures[1] == pytest.approx(pressures[0], abs=1e-6 * np.abs(pressures[0]).max())
    assert fluid[1] == pytest.approx(fluid[0], rel=1e-12)


@pytest.mark.parametrize("inertia", [pytest.param(False, marks=pytest.mark.slow), True])
def test_cells_of_unsaturated_soil_keep_their_water(monkeypatch, inertia):
    """Pressures change by a hundredth of the hydrostatic difference over a cell at most.

    Cells exchange parts of domains of a millionth of a cell.
    """
    monkeypatch.setattr(renewal, "LONGEST", 0.6)
    s = build(layers("above").with_(inertia=inertia), Frame.plain(2)).simulation
    s.run(4 / 8, 1 / 8, progress=False)
    new, count = s.scene.for_reset(s.state, True)
    assert count > 10
    pressures, water, momentum = [], [], []
    for state in (s.state, new):
        on_grid = s.scene.on_grid(state.points)
        pressures.append(on_grid.pressures(state))
        at_pieces = pressures[-1][on_grid.contents.slot(on_grid.cut.cells)] + on_grid.heads
        water.append(on_grid.pore_water(state.points).of_cells(at_pieces))
        if inertia:
            momentum.append(s.scene.materials.masses(state.points) @ state.points.velocity)
    assert pressures[0].min() < -1e3
    assert water[1].sum() == pytest.approx(water[0].sum(), rel=1e-13)
    assert water[1] == pytest.approx(water[0], abs=1e-6 * np.abs(water[0]).max())
    assert pressures[1] == pytest.approx(pressures[0], abs=0.01 * 9810 * s.grid.h[1])
    if inertia:
        assert momentum[1] == pytest.approx(momentum[0], rel=1e-12)


def bar_in_clay(cells, alpha, soil, rest, speed, follow=False, **options):
    """Return a simulation of a T-bar of 1 m in the middle of a polygon of clay, five diameters wide and high.

    The bar rests until the time `rest`, while the pressure increases. follow: whether grid lines follow the bar.
    """
    wide, h = 2.5, 1 / cells
    bar = mpm.Tool(mpm.Ball((0, 0.8), 0.5), lambda t: (0, -speed * max(0, t - rest)), adhesion=alpha * demo.STRENGTH)
    grid = mpm.Grid([0, -wide], [wide, wide + 4 * h], [round(wide / h), round(2 * wide / h) + 4])
    if follow:
        zone = [[0, 0.8 - demo.FINE_ZONE], [demo.FINE_ZONE, 0.8 + demo.FINE_ZONE]]
        grid = mpm.Grid(lines=mpm.graded(grid.lower, grid.upper, [zone], h, demo.RATIO), follow=bar)
    angle = np.linspace(np.pi / 2, -np.pi / 2, 33)
    arc = np.stack([0.5 * np.cos(angle), 0.8 + 0.5 * np.sin(angle)], axis=1)
    arc[[0, -1], 0] = 0.0
    outline = np.concatenate([[[0, -wide], [wide, -wide], [wide, wide], [0, wide]], arc])
    clay = mpm.polygon(grid, outline, ["bottom", "right", "top", "left", *["bar"] * 32, "left"], size=h / 2)
    conditions = [mpm.Pressure("top", lambda t: demo.PRESSURE * min(1, t / rest)), bar]
    if options:
        conditions.append(mpm.Drained("top", lambda t: demo.PRESSURE * min(1, t / rest)))
    options |= {"walls": {"left": "x", "right": "x", "bottom": "y"}, "conditions": conditions}
    s = mpm.Simulation(grid, [clay], [soil], numerics=mpm.Numerics(renewal=True), **options)
    s.run(rest, rest, progress=False)
    return s


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "depth", "follow"), [(0.5, 1.25, False), (1.0, 1.25, False), (0.5, 1.0, True)])
def test_clay_from_a_polygon_flows_around_a_bar(alpha, depth, follow, cells=8):
    """Without renewal, a partly rough bar fails at 0.9 diameters."""
    soil = mpm.DruckerPrager(bulk=5e6, shear=1e5, friction=0.0, dilation=0.0, cohesion=demo.STRENGTH)
    s = bar_in_clay(cells, alpha, soil, rest=1.0, speed=1.0, follow=follow)
    result = s.run(1 + depth, 1 / cells / 12, progress=False)
    N = -2 * result.tool_forces["tool"][1:, 1] / demo.STRENGTH / demo.exact(alpha)
    windows = N[-108:].reshape(-1, 12).mean(axis=1)
    print(f"alpha = {alpha}: {np.round(100 * windows - 100, 2)} %; {result.cuts} of {result.steps} steps cut")
    assert result.converged and result.renewals > 5 and result.cuts <= 0.1 * result.steps
    assert windows[-4:] == pytest.approx(1, abs=0.03)
    assert (N[1:] / N[:-1])[24:].min() > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("rate", demo.RATES.values())
def test_wet_clay_flows_around_a_bar(rate, cells=4, depth=1.0):
    """At any rate no step is cut, and the fluid is in balance."""
    speed = rate * demo.CV / demo.D
    rest = demo.SETTLED * depth / speed
    s = bar_in_clay(cells, 0.0, demo.CLAY, rest, speed, fluid=demo.WATER)
    result = s.run(rest + depth / speed, 1 / cells / 18 / speed, progress=False)
    N = -2 * result.tool_forces["tool"][1:, 1] / demo.STRENGTH
    print(f"V = {rate}: N = {N[-36:].mean():.2f}, {result.renewals} renewals, {result.cuts} cuts, {result.balance:.1e}")
    assert result.converged and result.renewals > 5 and result.cuts <= 0.05 * result.steps
    assert result.balance < 1e-8
    assert (N[1:] / N[:-1])[24:].min() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("cells", "depth", "error"), [(9, 3.0, 0.04), (17, 0.25, 0.03)])
def test_clay_is_pressed_through_a_die_of_half_its_width(cells, depth, error, strength=1e3):
    """Hill's pressure (1950) on a smooth square die is strength (1 + pi / 2), for any displacement.

    The edge of the die lies in the middle of a cell, with a radius of one cell. The surface catches at a sharp edge.
    When corners left the edges on which they hang, cells were filled to 102 % within one half-width.
    """
    h, long = 1 / cells, depth + 1.5
    low, high = -np.ceil((2 * depth + 0.75) * cells) / cells, np.ceil((long + 0.25) * cells) / cells
    grid = mpm.Grid([0, low + h / 2], [1, high + h / 2], [cells, round((high - low) * cells)])
    angle = np.linspace(np.pi, np.pi / 2, 7)
    edge = np.stack([0.5 + h + h * np.cos(angle), -h + h * np.sin(angle)], axis=1)
    outline = np.concatenate([[[0, -0.25], [0.5, -0.25]], edge, [[1, 0], [1, long], [0, long]]])
    billet = mpm.polygon(grid, outline, ["exit", "land", *["die"] * 7, "right", "top", "left"])
    soil = mpm.DruckerPrager(5e6, 1e5, friction=0.0, dilation=0.0, cohesion=strength)
    die = mpm.Tool(mpm.Convex([*edge, [0.5, -0.5], [1.5, -0.5], [1.5, 0]]))
    ram = mpm.Tool(mpm.HalfSpace((0, long), (0, -1)), lambda t: (0, -t), name="ram")
    options = {"walls": {"left": "x", "right": "x"}, "numerics": mpm.Numerics(renewal=True)}
    s = mpm.Simulation(grid, [billet], [soil], conditions=[die, ram], **options)
    fill = []
    look = [lambda s: fill.append(s.cells().volume.max() / h**2)]
    result = s.run(depth, h / 8, observe=look, progress=False)
    p = -result.tool_forces["ram"][1:, 1] / strength / (1 + np.pi / 2)
    parts = [part.mean() for part in np.array_split(p, round(4 * depth))]
    print(f"p over the exact one, means over quarters of the half-width: {np.round(parts, 3)}, {result.cuts} cuts")
    print(f"fullest cell {100 * max(fill):.2f} %, p from {p[8:].min():.3f} to {p[8:].max():.3f}")
    assert result.converged and result.renewals > 5
    assert p.mean() == pytest.approx(1, abs=error)
    assert p[8:] == pytest.approx(1, abs=0.1)
    assert max(fill) < 1.005


@pytest.mark.parametrize(
    ("processes", "kind"),
    [
        (1, ["wet", "inertia"]),
        (3, ["wet"]),
        (1, ["rings"]),
        (1, ["wet", "suction", "inertia"]),
        *(
            pytest.param(n, kind, marks=pytest.mark.slow)
            for n, kind in ((1, []), (2, []), (2, ["wet"]), (2, ["wet", "suction"]))
        ),
        *(pytest.param(2, kind, marks=pytest.mark.slow) for kind in (["inertia"], ["wet", "rings"])),
    ],
)
def test_a_run_that_renews_is_the_same_after_a_restart_and_on_several_processes(processes, kind, tmp_path, monkeypatch):
    """Results on one process agree to the bit."""
    monkeypatch.setattr(renewal, "LONGEST", renewal.LONGEST)
    mpi_renewal.main(tmp_path / "parts", "restart", *kind)
    if processes > 1:
        mpirun(processes, "mpi_renewal.py", str(tmp_path / "whole"), *kind)
    else:
        mpi_renewal.main(tmp_path / "whole", *kind)
    one, other = (np.load(tmp_path / f"{name}.npz") for name in ("whole", "parts"))
    assert one["renewed"] == other["renewed"] > 0
    assert np.array_equal(one["id"], other["id"])
    for name in ("x", "volume0", "pressure", "plastic", "force", "shear", "velocity"):
        size = np.abs(other[name]).max()
        assert one[name] == pytest.approx(other[name], abs=(0 if processes == 1 else 1e-7) * size)


def test_domains_of_probes_and_those_of_a_scene_that_renews_nothing_stay(monkeypatch):
    """A probe is placed where a domain would be renewed."""
    monkeypatch.setattr(renewal, "LONGEST", 0.6)

    def run(place=None, **options):
        simulation = mpi_renewal.pushed(**options)
        probe = mpm.probes(simulation.bodies, [[0.99, 0.01] if place is None else place])
        return simulation, simulation.run(0.05, 0.01, probes=probe, progress=False), probe.id[0]

    simulation, result, _ = run()
    assert result.renewed > 0 and result.renewals > 0
    body = simulation.bodies[0]
    gone = np.setdiff1d(np.arange(len(body)), simulation.points.id)
    simulation, _, probe = run(body.centre_of(gone[:1])[0])
    assert probe == gone[0] and probe in simulation.points.id
    _, result, _ = run(renewal=False)
    assert result.renewed == result.renewals == 0
    with pytest.raises(ValueError, match="renewal"):
        mpm.Numerics(renewal=1)


def test_polygons_are_cut_and_divided():
    ring = Polygons.rings(np.array([[[0.0, 0.0], [2, 0], [2, 2], [0, 2]]]), np.array([[0, 1, 2, 3]]))
    half = ring.cut(np.array([[1.0, 1.0]]), np.array([2.0]))
    assert half.area == pytest.approx([2.0]) and half.simplified(1e-9).count.tolist() == [3]
    on_a_side = np.array([[[0.5, 0.0], [1.0, 0.0], [1.0, 4e-4], [1.0, 0.5], [0.504, 0.5]]])
    for edge, count in (([0, 1, 1, 2, 3], 4), ([0, 1, 2, 3, 4], 5)):
        assert Polygons.rings(on_a_side, np.array([edge])).simplified(1e-9).count.tolist() == [count]
    sliver = np.array([[0.0, 0.0], [1.0, 0.3], [1.0, 0.9], [0.0, 1e-4]])
    for k, sign in np.ndindex(4, 2):  # earlier, a mirror image kept the other one of two vertices that nearly coincide
        x = np.roll(sliver * [2 * sign - 1, 1], k, axis=0)[None, :: 2 * sign - 1]
        (found,) = Polygons.rings(x).simplified(1e-3).x * [2 * sign - 1, 1]
        assert found[np.argsort(found[:, 1])] == pytest.approx(np.array([[0, 5e-5], [1, 0.3], [1, 0.9]]), abs=1e-15)
    trapezoid = np.array([[0.0, 0.0], [0.1, 0.0], [0.4, 1.0], [0.0, 1.0], [0.0, 0.9]])
    for k, sign in np.ndindex(5, 2):  # earlier, mirror images were divided along other diagonals, of equal areas
        x = np.roll(trapezoid * [2 * sign - 1, 1], k, axis=0)[None, :: 2 * sign - 1]
        widths = np.ptp(Polygons.rings(x).quadrilaterals()[1][:, :, 0], axis=1)
        assert sorted(widths) == pytest.approx([0.1, 0.4])
    other = np.array([[[1.0, -1.0], [3, 1], [1, 3], [-1, 1]]])
    within = ring.within(other)
    row, quads, _ = within.quadrilaterals()
    assert Polygons.rings(quads).area.sum() == pytest.approx(within.area[0]) and set(row) == {0}
    assert np.allclose(within.centroid, [[1, 1]])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {
                "fluid": mpm.Fluid(),
                "law": replace(mpi_renewal.CLAY, conductivity_law=mpm.unsaturated(1e3, specific_yield=0.1)),
            },
            "has `specific_yield`",
        ),
        ({"law": mpm.Hencky(1e6, 1e6)}, "has no soil"),
        ({"axisymmetric": True, "inertia": True}, "has inertia in axisymmetry"),
    ],
)
def test_scenes_whose_domains_cannot_be_renewed_are_refused(options, message):
    soil = options.pop("law", mpi_renewal.CLAY)
    grid = mpm.Grid([0, 0], [1.0, 1.0], [4, 4], axisymmetric=options.pop("axisymmetric", False))
    bodies, walls = [mpm.box(grid, [0, 0], [1.0, 0.5])], {"bottom": "xy"}
    with pytest.raises(
        ValueError, match=rf"Numerics\(renewal=True\): the scene {message}.*, must be of soil that yields"
    ):
        mpm.Simulation(grid, bodies, [soil], walls=walls, numerics=mpm.Numerics(renewal=True), **options)
