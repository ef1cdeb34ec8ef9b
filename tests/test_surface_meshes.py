# SPDX-License-Identifier: MIT
"""Tools from surface meshes: distances, normals, curvatures, moments, refusals, files, and scenes with these tools."""

from itertools import product

import meshio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from strategies import numbers, orders, repeatable

import mpm_dolfinx as mpm

GEL = mpm.Hencky(bulk=1e6, shear=6e5, grain_density=2000, porosity=0.5)
L_SHAPE = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)])
CORNERS = np.array(list(product([0.0, 1.0], [0.0, 2.0], [0.0, 0.5])))
TETRA = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]


def hull(corners):
    """Return the hull of corners as a mesh.  The orientation of its facets is arbitrary."""
    of = ConvexHull(corners)
    return mpm.SurfaceMesh(of.points, of.simplices)


def icosphere(divisions, centre=(0.0, 0.0, 0.0), radius=1.0):
    """Return a sphere of 20 * 4^divisions triangles, whose vertices are repeated as in an STL file."""
    signs = list(product([-1.0, 1.0], [-1.618, 1.618]))
    x = np.array([p for a, b in signs for p in ((0, a, b), (a, b, 0), (b, 0, a))])
    x = x / np.linalg.norm(x, axis=1)[:, None]
    t = x[ConvexHull(x).simplices]
    for _ in range(divisions):
        m = t + np.roll(t, -1, axis=1)
        m /= np.linalg.norm(m, axis=2, keepdims=True)
        t = np.concatenate([*(np.stack([t[:, k], m[:, k], m[:, k - 1]], axis=1) for k in range(3)), m])
    return mpm.SurfaceMesh(np.array(centre) + radius * t.reshape(-1, 3), np.arange(3 * len(t)).reshape(-1, 3))


def bar(corners, thickness=1.0):
    """Return vertices and triangles of a polygon (n, 2) that is extruded along z."""
    n = len(corners)
    x = np.vstack([np.column_stack([corners, np.full(n, z)]) for z in (0.0, thickness)])
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    fan = {6: [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]}[n]
    sides = [np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])]
    return x, np.vstack([*sides, fan, np.array(fan) + n])


def turned(axis, angle):
    """Return the matrix of a rotation about a unit vector (Rodrigues)."""
    K = np.cross(np.eye(3), axis)
    return np.eye(3) - np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def to_box(y, lower, upper):
    """Return the exact distances from a box."""
    out = np.maximum(lower - y, y - upper)
    return np.linalg.norm(np.maximum(out, 0), axis=1) + np.minimum(out.max(axis=1), 0)


def to_polygon(y, corners):
    """Return the exact distances from a polygon, by brute force over its sides, signed by counting rays."""
    a, b = corners, np.roll(corners, -1, axis=0)
    share = np.clip(np.einsum("nkd,kd->nk", y[:, None] - a, b - a) / ((b - a) ** 2).sum(axis=1), 0, 1)
    far = np.linalg.norm(y[:, None] - a - share[..., None] * (b - a), axis=2).min(axis=1)
    above = (a[:, 1] > y[:, 1:]) != (b[:, 1] > y[:, 1:])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (y[:, 1:] - a[:, 1]) / (b - a)[:, 1] * (b - a)[:, 0]
    return np.where(((y[:, :1] < at) & above).sum(axis=1) % 2 == 1, -far, far)


@st.composite
def boxes(draw):
    d = draw(st.sampled_from([2, 3]))
    lower, size = numbers(draw, -5, 5, d), orders(draw, -1, 1, d)
    seed = draw(st.integers(0, 2**32 - 1))
    return lower, lower + size, np.random.default_rng(seed)


@repeatable(60)
@given(boxes())
def test_distances_from_a_box_are_exact(box):
    """Inside, they and their derivatives are those of `Convex`, also in a turned frame."""
    lower, upper, rng = box
    d = len(lower)
    corners = lower + np.array(list(product([0, 1], repeat=d))) * (upper - lower)
    y = rng.uniform(lower - 1.0, upper + 1.0, (300, d))
    y[:50] = rng.uniform(lower, upper, (50, d))
    mesh, size = hull(corners), np.abs([lower, upper]).max()
    assert mesh.distance(y) == pytest.approx(to_box(y, lower, upper), abs=1e-13 * size)
    convex, inside = mpm.Convex(corners), y[to_box(y, lower, upper) < -1e-9]
    assert mesh.distance(inside) == pytest.approx(convex.distance(inside), abs=1e-13 * size)
    assert np.abs(mesh.normal(inside) - convex.normal(inside)).max() < 1e-12
    assert not mesh.geometry(inside)[2].any()
    if d == 3:
        R = turned(np.array([0.6, 0.0, 0.8]), rng.uniform(0, 6))
        assert hull(corners @ R.T).distance(y @ R.T) == pytest.approx(to_box(y, lower, upper), abs=1e-13 * size)


@pytest.mark.parametrize("reverse", [False, True])
def test_distances_from_a_concave_polygon_are_exact(reverse):
    rng = np.random.default_rng(1)
    y = np.vstack([rng.uniform(-1, 3, (20000, 2)), rng.uniform(0.8, 1.2, (2000, 2))])
    mesh = mpm.SurfaceMesh(L_SHAPE[::-1] if reverse else L_SHAPE)
    assert mesh.distance(y) == pytest.approx(to_polygon(y, L_SHAPE), abs=1e-14)
    away = mesh.moved([10.0, -3.0])
    assert away.distance(np.add(y, [10.0, -3.0])) == pytest.approx(mesh.distance(y), abs=1e-14)


def test_distances_from_a_concave_prism_are_exact():
    rng = np.random.default_rng(2)
    y = rng.uniform(-1, 3, (20000, 3))
    flat, along = to_polygon(y[:, :2], L_SHAPE), np.abs(y[:, 2] - 0.5) - 0.5
    exact = np.minimum(np.maximum(flat, along), 0) + np.hypot(np.maximum(flat, 0), np.maximum(along, 0))
    outside = (flat > 0) | (along > 0) | (np.maximum(flat, along) == exact)
    mesh = mpm.SurfaceMesh(*bar(L_SHAPE))
    assert mesh.distance(y)[outside] == pytest.approx(exact[outside], abs=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_distances_from_a_rough_star_are_those_of_all_facets_and_all_solid_angles(seed):
    """The radii of its vertices are random, also far from the origin and in other units."""
    rng, sphere = np.random.default_rng(seed), icosphere(2)
    x = sphere.vertices * rng.uniform(0.3, 1.5, (len(sphere.vertices), 1))
    y = rng.uniform(-1.5, 1.5, (400, 3))
    t = x[sphere.facets]
    rows = np.arange(len(t))
    one = mpm.SurfaceMesh(x, sphere.facets)
    table = one._table
    far = np.array([table.distances(np.repeat(at[:, None], len(rows), axis=1), rows).min() for at in y])
    a, b, c = (t[None] - y[:, None, None]).transpose(2, 0, 1, 3)
    size = [np.linalg.norm(v, axis=2) for v in (a, b, c)]
    turns = ((a, b, size[2]), (b, c, size[0]), (c, a, size[1]))
    under = np.prod(size, axis=0) + sum((u * v).sum(axis=2) * r for u, v, r in turns)
    angle = 2 * np.arctan2((a * np.cross(b, c)).sum(axis=2), under).sum(axis=1)
    exact = np.where(np.abs(angle) > 2 * np.pi, -far, far)
    assert one.distance(y) == pytest.approx(exact, abs=1e-13)
    shift, unit = np.array([3e3, -1e3, 50.0]), 1e3
    other = mpm.SurfaceMesh(unit * x + shift, sphere.facets)
    assert other.distance(unit * y + shift) == pytest.approx(unit * exact, abs=1e-11 * unit)


@pytest.mark.parametrize("make", [lambda: mpm.SurfaceMesh(L_SHAPE), lambda: mpm.SurfaceMesh(*bar(L_SHAPE))])
def test_normals_and_curvatures_are_derivatives(make):
    mesh, rng, h = make(), np.random.default_rng(3), 1e-5
    d = mesh.dim
    y = rng.uniform(-1, 3, (4000, d))
    near = mesh._table.nearest
    steps = [s * h * e for e in np.eye(d) for s in (-1, 1)]
    same = np.ones(len(y), dtype=bool)
    for step in steps:  # where the nearest facet, edge or vertex does not change
        same &= np.linalg.norm(near(y + step).offset - near(y).offset, axis=1) < 3 * h
    same &= np.abs(mesh.distance(y)) > 0.05
    y = y[same]
    assert len(y) > 3000
    slope = np.stack([(mesh.distance(y + h * e) - mesh.distance(y - h * e)) / (2 * h) for e in np.eye(d)], axis=1)
    bend = np.stack([(mesh.normal(y + h * e) - mesh.normal(y - h * e)) / (2 * h) for e in np.eye(d)], axis=2)
    _, n, second = mesh.geometry(y)
    assert np.linalg.norm(n, axis=1) == pytest.approx(1.0)
    wrong = np.abs(slope - n).max(axis=1) > 1e-6
    wrong |= np.abs(bend - second).max(axis=(1, 2)) > 1e-4
    assert wrong.mean() < 2e-3  # positions within h of a border between facets
    assert (np.abs(second).max(axis=(1, 2)) > 0).mean() > 0.1


def test_on_edges_and_vertices_the_normal_is_a_mean():
    mesh = mpm.SurfaceMesh(*bar(L_SHAPE))
    y = np.array([(0, 0, 0.5), (1, 1, 0.5), (2, 0, 0), (0.5, 0, 0.5), (0.7, 0.7, 1.0)])
    exact = [(-0.5, -0.5, 0), (0.5, 0.5, 0), (1 / 3, -1 / 3, -1 / 3), (0, -1, 0), (0, 0, 1)]
    assert mesh.normal(y) == pytest.approx(np.array(exact), abs=1e-12)
    assert np.abs(mesh.distance(y)).max() < 1e-15 and not mesh.geometry(y)[2].any()


def test_distances_from_a_sphere_converge_with_the_square_of_the_facet_size():
    y = np.random.default_rng(4).normal(size=(2000, 3))
    y *= np.linspace(0.3, 3, len(y))[:, None] / np.linalg.norm(y, axis=1)[:, None]
    errors = [np.abs(icosphere(k).distance(y) - mpm.Ball((0, 0, 0), 1.0).distance(y)).max() for k in (2, 3, 4)]
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(2.0, abs=0.1)


def test_volume_centroid_and_inertia_are_exact():
    box = hull(np.add(CORNERS, [1, 2, 3]))
    a, b, c = 1.0, 2.0, 0.5
    assert box.volume == pytest.approx(a * b * c) and box.centroid == pytest.approx([1.5, 3.0, 3.25])
    assert box.inertia == pytest.approx(np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) / 12, abs=1e-12)
    R = turned(np.array([0.0, 0.6, 0.8]), 0.7)
    assert hull(CORNERS @ R.T).inertia == pytest.approx(R @ box.inertia @ R.T, abs=1e-12)
    flat = mpm.SurfaceMesh(np.add(L_SHAPE, [1e3, 0]))
    parts = [(2.0, np.array([1.0, 0.5]), (4 + 1) / 12), (1.0, np.array([0.5, 1.5]), 2 / 12)]
    centre = sum(m * x for m, x, _ in parts) / 3
    moment = sum(m * (g + ((x - centre) ** 2).sum()) for m, x, g in parts)
    assert flat.volume == pytest.approx(3.0) and flat.centroid - [1e3, 0] == pytest.approx(centre)
    assert flat.inertia == pytest.approx(moment) and mpm.Tool(flat, mass=6.0).inertia(2) == pytest.approx(2 * moment)
    triangles = [mpm.Tool(shape(L_SHAPE[:3]), mass=1.0) for shape in (mpm.Convex, mpm.SurfaceMesh)]
    assert triangles[1].inertia(2) == pytest.approx(triangles[0].inertia(2))


def test_a_surface_inside_another_one_bounds_a_cavity():
    outer, inner = bar(3 * L_SHAPE - 0.5, 3.0), bar(L_SHAPE, 1.0)
    inner = inner[0] + [0.2, 0.2, 1.0], inner[1]
    x, facets = np.vstack([outer[0], inner[0]]), np.vstack([outer[1], inner[1] + len(outer[0])])
    mesh = mpm.SurfaceMesh(x, facets)
    assert mesh.volume == pytest.approx(27 * 3 - 3)
    assert mesh.distance(np.array([[0.7, 0.7, 1.5], [0.1, 0.7, 1.5]])) == pytest.approx([0.5, -0.1])
    square = np.array([(0, 0), (4, 0), (4, 4), (0, 4)])
    rings = np.vstack([square, square / 2 + 1, square / 4 + 1.5])
    around = [(i + 4 * k, (i + 1) % 4 + 4 * k) for k in range(3) for i in range(4)]
    rings = mpm.SurfaceMesh(rings, around)
    assert rings.volume == pytest.approx(16 - 4 + 1)
    assert rings.distance(np.array([[2.0, 2.0], [1.2, 2.0], [0.5, 2.0]])) == pytest.approx([-0.5, 0.2, -0.5])


def test_orientation_repeated_vertices_and_facets_without_extent_have_no_effect():
    x, facets = bar(L_SHAPE)
    y = np.random.default_rng(5).uniform(-1, 3, (500, 3))
    exact = mpm.SurfaceMesh(x, facets).distance(y)
    rng = np.random.default_rng(6)
    mixed = np.where(rng.random(len(facets))[:, None] < 0.5, facets, facets[:, ::-1])
    loose = x[mixed].reshape(-1, 3) + 1e-8 * rng.uniform(-1, 1, (3 * len(facets), 3))
    soup = mpm.SurfaceMesh(np.vstack([loose, loose[:3]]), np.vstack([np.arange(len(loose)).reshape(-1, 3), [0, 0, 1]]))
    assert len(soup.vertices) == len(x) and len(soup.facets) == len(facets)
    assert soup.distance(y) == pytest.approx(exact, abs=1e-7)
    assert mpm.SurfaceMesh(x, mixed).distance(y) == pytest.approx(exact, abs=1e-14)


def pyramids():
    """Return two tetrahedra that touch in one vertex."""
    x = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
    return np.vstack([x, 1 - x + [0, 0, 0] - [1, 1, 1]]), np.vstack([TETRA, np.array(TETRA) + 4])


TWO = np.vstack([CORNERS, np.add(CORNERS, [0.5, 0.5, 0.25])])
HULL = ConvexHull(CORNERS).simplices
BOWTIE = [(0, 0), (1, 1), (1, 0), (0, 1)]
REFUSED = {
    "coordinate": (lambda: mpm.SurfaceMesh([(0, 0), (1, np.nan), (0, 1)]), "finite"),
    "few": (lambda: mpm.SurfaceMesh([(0, 0), (1, 0)]), "3 or more"),
    "no facets": (lambda: mpm.SurfaceMesh(CORNERS), "integers"),
    "index": (lambda: mpm.SurfaceMesh(CORNERS, [(0, 1, 99)]), "from 0 to 7"),
    "fraction": (lambda: mpm.SurfaceMesh(CORNERS, [(0, 1, 0.5)]), "integers"),
    "shape": (lambda: mpm.SurfaceMesh(CORNERS, [(0, 1)]), r"integers \(m, 3\)"),
    "open": (lambda: mpm.SurfaceMesh(CORNERS, HULL[1:]), "belongs to 1 facets, must belong to 2"),
    "edge": (lambda: mpm.SurfaceMesh(CORNERS, [*HULL, *[(0, 1, 7)]]), "facets, must belong to 2"),
    "open line": (lambda: mpm.SurfaceMesh(L_SHAPE, [(k, k + 1) for k in range(5)]), "vertex .* belongs to 1 facets"),
    "vertex": (lambda: mpm.SurfaceMesh(*pyramids()), "touch in the vertex"),
    "thin": (lambda: mpm.SurfaceMesh([(0, 0, 0), (1, 0, 0), (2, 0, 0), (1, 1, 1)], TETRA), "in a line"),
    "flat": (lambda: mpm.SurfaceMesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], TETRA), "no volume"),
    "crossing": (lambda: mpm.SurfaceMesh(TWO, np.vstack([HULL, HULL + 8])), "crosses or touches itself"),
    "touching": (
        lambda: mpm.SurfaceMesh(np.vstack([CORNERS, CORNERS / 2 + [0.1, 0.1, 0.5]]), np.vstack([HULL, HULL + 8])),
        "crosses or touches itself",
    ),
    "bow tie": (lambda: mpm.SurfaceMesh([*BOWTIE, (-0.1, 0.3)]), "crosses or touches itself"),
    "scale": (lambda: mpm.SurfaceMesh.from_mesh("none.stl", scale=0.0), "scale = 0.0, must be > 0"),
    "file": (lambda: mpm.SurfaceMesh.from_mesh("none.stl"), "none.stl"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_surfaces_are_refused_in_one_line(name):
    make, says = REFUSED[name]
    with pytest.raises(ValueError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300 and " must " in str(caught.value)


@pytest.mark.parametrize("ending", ["stl", "binary.stl", "ply", "vtu", "vtk", "obj", "msh", "msh22"])
def test_files_are_read(tmp_path, ending):
    x, facets = bar(L_SHAPE)
    file = tmp_path / f"tool.{ending.replace('msh22', 'msh')}"
    kind = {"stl": "stl", "binary.stl": "stl", "msh": "gmsh", "msh22": "gmsh22"}.get(ending, ending)
    options = {"binary": ending == "binary.stl"} if kind == "stl" else {}
    meshio.write(file, meshio.Mesh(1000 * x, [("triangle", facets)]), file_format=kind, **options)
    y = np.random.default_rng(7).uniform(-1, 3, (500, 3))
    mesh = mpm.SurfaceMesh.from_mesh(file, scale=1e-3)
    assert len(mesh.vertices) == 12
    assert mesh.distance(y) == pytest.approx(mpm.SurfaceMesh(x, facets).distance(y), abs=1e-6)


def test_quadrilaterals_lines_and_open_files(tmp_path):
    quads = np.array([(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)])
    mesh = meshio.Mesh(CORNERS, [("quad", quads)])
    assert mpm.SurfaceMesh.from_mesh(mesh).volume == pytest.approx(1.0)
    ring = np.stack([np.arange(6), np.roll(np.arange(6), -1)], axis=1)
    flat = meshio.Mesh(np.column_stack([L_SHAPE, np.ones(6)]), [("line", ring), ("triangle", [(0, 1, 2)])])
    assert mpm.SurfaceMesh.from_mesh(flat).volume == pytest.approx(3.0)
    x, facets = bar(L_SHAPE)
    meshio.write(tmp_path / "open.stl", meshio.Mesh(x, [("triangle", facets[1:])]))
    with pytest.raises(ValueError, match=r"SurfaceMesh .*open.stl: .*must belong to 2"):
        mpm.SurfaceMesh.from_mesh(tmp_path / "open.stl")
    with pytest.raises(ValueError, match="has cells tetra, must have triangles"):
        mpm.SurfaceMesh.from_mesh(meshio.Mesh(CORNERS, [("tetra", [(0, 1, 2, 4)])]))


def pressed(shape, d=2, **tool):
    """Return a simulation of a gel block under a tool."""
    if d == 2:
        grid, walls, size = mpm.Grid([-0.2, 0], [1.2, 1], [14, 10]), {"bottom": "xy"}, [1, 0.6]
        tool = {"displacement": lambda t: (0.02 * t, -0.05 * t), "friction": 0.3, **tool}
    else:
        grid, walls, size = mpm.Grid([-0.2, -0.2, 0], [1.2, 1.2, 0.8], [7, 7, 4]), {"bottom": "xyz"}, [1, 1, 0.5]
        tool = {"displacement": lambda t: (0.02 * t, 0.01 * t, -0.05 * t), "friction": 0.3, **tool}
    body = mpm.box(grid, [0] * d, size)
    return mpm.Simulation(grid, [body], [GEL], walls=walls, conditions=[mpm.Tool(shape, **tool)])


def forces(*arguments, t_end=1.0, **tool):
    s = pressed(*arguments, **tool)
    s.run(t_end, 0.25, progress=False)
    return s.tool_forces.array[0]


TURN = {"rotation_rad": lambda t: 0.1 * t, "centre": (0.5, 0.6)}


@pytest.mark.parametrize("tool", [{}, TURN, {"load": lambda t: 2e4 * t, "direction": (0, -1), "displacement": 0.0}])
def test_a_box_presses_as_the_hull_of_its_corners(tool):
    corners = np.array(list(product([0.23, 0.71], [0.6, 0.9])))
    convex = forces(mpm.Convex(corners), **tool)
    assert forces(hull(corners), **tool) == pytest.approx(convex, rel=1e-10, abs=1e-10 * np.abs(convex).max())


def test_a_box_presses_as_the_hull_of_its_corners_in_space():
    corners = np.array(list(product([0.23, 0.71], [0.27, 0.77], [0.5, 0.8])))
    convex = forces(mpm.Convex(corners), 3, t_end=0.5)
    assert forces(hull(corners), 3, t_end=0.5) == pytest.approx(convex, rel=1e-10, abs=1e-10 * np.abs(convex).max())


@pytest.mark.slow
def test_the_force_of_a_sphere_converges_with_the_square_of_the_facet_size():
    centre, radius = (0.5, 0.5, 0.9), 0.4
    exact = forces(mpm.Ball(centre, radius), 3)
    errors = [np.abs(forces(icosphere(k, centre, radius), 3) - exact)[2] / np.abs(exact[2]) for k in (2, 3, 4)]
    assert errors[-1] < 0.012 and np.log2(np.divide(errors[:-1], errors[1:])).min() > 1.7


def test_a_concave_tool_presses_as_its_distance_function():
    mesh = mpm.SurfaceMesh([(-0.1, 0.9), (-0.1, 0.2), (0.0, 0.2), (0.0, 0.6), (0.7, 0.6), (0.7, 0.9)])
    one = forces(mesh, displacement=lambda t: (0.03 * t, -0.1 * t))
    assert one[0] > 1e4 and one[1] < -1e5
    assert one == pytest.approx(forces(mesh.distance, displacement=lambda t: (0.03 * t, -0.1 * t)), rel=1e-6)


def test_a_run_is_resumed_with_the_tool(tmp_path):
    shape = hull(np.array(list(product([0.23, 0.71], [0.6, 0.9]))))
    whole, half, again = (pressed(shape) for _ in range(3))
    whole.run(1.0, 0.25, progress=False)
    half.run(0.5, 0.25, checkpoint=mpm.Checkpoint(tmp_path / "half"), progress=False)
    again.run(1.0, 0.25, after=mpm.resume(again, tmp_path / "half"), progress=False)
    assert np.array_equal(again.points.corners, whole.points.corners)
    assert np.array_equal(again.tool_forces.array, whole.tool_forces.array)


def test_a_free_tool_falls_and_turns_as_the_hull_of_its_corners():
    corners = np.array([(0.3, 0.66), (0.62, 0.61), (0.66, 0.81), (0.34, 0.86)])
    grid, found = mpm.Grid([-0.2, 0], [1.2, 1], [14, 10]), []
    options = {"walls": {"bottom": "xy"}, "gravity": (0, -9.81), "inertia": True}
    for shape in (mpm.Convex(corners), mpm.SurfaceMesh(corners)):
        tool = mpm.Tool(shape, mass=100.0, spin=-1.0, velocity=(0.5, -1.0), friction=0.3)
        s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.6])], [GEL], conditions=[tool], **options)
        s.run(0.1, 0.005, progress=False)
        found.append([*s.outcome("tool_travel").array[0], s.outcome("tool_rotation").array[0]])
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    assert found[0][1] < -0.01  # the lowest corner has reached the soil


def test_facets_are_drawn():
    mesh = mpm.SurfaceMesh(*bar(L_SHAPE))
    tool, grid = mpm.Tool(mesh, displacement=(0, 0, 1.0)), mpm.Grid([-1, -1, -1], [3, 3, 3], [4, 4, 4])
    cells = tool.drawn(grid, 0.0)
    assert cells.shape == (len(mesh.facets), 8, 3)
    assert cells[:, :3] == pytest.approx(mesh.vertices[mesh.facets] + [0, 0, 1.0])
    flat = mpm.Tool(mpm.SurfaceMesh(L_SHAPE)).drawn(mpm.Grid([-1, -1], [3, 3], [8, 8]), 0.0)
    assert np.abs(to_polygon(flat.reshape(-1, 2), L_SHAPE).max()) < 1e-6


def test_a_half_section_is_refused_in_axisymmetry():
    grid = mpm.Grid([0, 0], [1, 1], [5, 5], axisymmetric=True)
    body = mpm.box(grid, [0, 0], [1, 0.5])
    walls = {"bottom": "y", "left": "x", "right": "x"}
    square = np.array([(0, 0.5), (0.4, 0.5), (0.4, 0.8), (0, 0.8)])
    with pytest.raises(ValueError, match="a side lies on the axis"):
        mpm.Simulation(grid, [body], [GEL], walls=walls, conditions=[mpm.Tool(mpm.SurfaceMesh(square))]).step(0.1)
    whole = np.array([(-0.4, 0.5), (0.4, 0.5), (0.4, 0.8), (-0.4, 0.8)])
    found = []
    for shape in (mpm.Convex(whole), mpm.SurfaceMesh(whole)):
        tool = mpm.Tool(shape, displacement=lambda t: (0, -0.02 * t))
        s = mpm.Simulation(grid, [body], [GEL], walls=walls, conditions=[tool])
        s.run(1.0, 0.5, progress=False)
        found.append(s.tool_forces.array[0])
    assert found[1] == pytest.approx(found[0], rel=1e-10, abs=1e-6)


@pytest.mark.slow
def test_many_positions_are_searched_at_once():
    """A loop over 1e5 positions would take minutes."""
    from time import process_time

    sphere, y = icosphere(5), np.random.default_rng(8).uniform(-1.2, 1.2, (100_000, 3))
    assert len(sphere.facets) == 20480
    start = process_time()
    gap = sphere.distance(y)
    assert process_time() - start < 10 and np.abs(gap - np.linalg.norm(y, axis=1) + 1).max() < 3e-4
