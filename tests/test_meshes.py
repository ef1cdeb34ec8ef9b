# SPDX-License-Identifier: MIT
"""Bodies from meshes: cells are the domains of the points, facets are the sides."""

import signal
from threading import Thread

from mpi4py import MPI

import basix
import dolfinx.mesh
import meshio
import numpy as np
import pytest
import ufl
from helpers import refused_in_one_line
from meshes import box_mesh
from scipy.integrate import solve_bvp
from scipy.spatial import Delaunay

import mpm_dolfinx as mpm
from mpm_dolfinx.base import _compat
from mpm_dolfinx.bodies.faces import surface
from mpm_dolfinx.points.cutting import volumes

GRID = mpm.Grid([0, 0], [2, 1.5], [10, 8])
SPACE = mpm.Grid([0, 0, 0], [2, 2, 2], [4, 4, 4])
KINDS = {"triangle": (8, 4), "quad": (8, 4), "tetra": (4, 2, 2), "hexahedron": (4, 2, 2)}
ALL = KINDS | {"wedge": (4, 2, 2), "pyramid": (4, 2, 2)}
SOIL = mpm.Hencky(bulk=1e6 / 1.2, shear=1e6 / 2.4)


def of_kind(kind, upper=(2.0, 1.0, 1.0), **options):
    """Return a grid, and a box of one kind of cells in it."""
    dim = len(ALL[kind])
    grid = GRID if dim == 2 else SPACE
    return grid, mpm.from_mesh(grid, box_mesh(kind, ALL[kind], (0,) * dim, upper[:dim], **options))


def skewed(x):
    """Return positions in a parallelepiped of two units."""
    return x @ np.array([[0.8, 0.2, 0.0], [-0.3, 1.0, 0.1], [0.2, -0.1, 0.9]])[: x.shape[1], : x.shape[1]] + 0.3


@pytest.mark.parametrize("kind", ALL)
def test_domains_fill_the_mesh_and_sides_have_its_area_and_names(kind):
    grid, body = of_kind(kind)
    assert volumes(body.corners()).sum() == pytest.approx(2.0, rel=1e-12) and volumes(body.corners()).min() > 0
    areas = {"left": 1, "right": 1, "bottom": 2, "top": 2, "front": 2, "back": 2}
    for name in body.names:
        faces = surface([body], name)
        assert faces.area0.sum() == pytest.approx(areas[name], rel=1e-12)
    assert len(body.names) == 2 * grid.dim
    edges = np.linalg.norm(np.diff(body.corners(), axis=1)[:, ::2] / grid.h, axis=2)
    assert edges.max() <= 0.75, "large cells are split"


@pytest.mark.parametrize("kind", ["triangle", "quad", "tetra", "hexahedron"])
def test_regions_and_other_bodies_cut_faces_exactly(kind):
    grid, body = of_kind(kind, parts={"all": lambda x: x[:, 0] > -1})
    dim = grid.dim
    region = ((0.31, *(0.13,) * (dim - 1)), (1.17, *(0.77,) * (dim - 2), 2))
    width, depth = 0.86, 0.64 if dim == 3 else 1.0
    assert surface([body], "top", region).area0.sum() == pytest.approx(width * depth, rel=1e-10)
    top = surface([body], "top", region)
    assert (top.X[:, 0] >= top.region[0] - 1e-12).all() and (top.X[:, 1] <= top.region[1] + 1e-12).all()
    upon = mpm.box(grid, [0.0, *[0.0] * (dim - 2), 1.0], [1.3, *[0.9] * (dim - 2), 1.4])
    free = 2 - 1.3 * (0.9 if dim == 3 else 1.0)
    tops = surface([body, upon], "top")
    assert tops.area0[tops.id < len(body)].sum() == pytest.approx(free, rel=1e-9)


def test_slanted_faces_are_limited_by_regions_in_space():
    body = mpm.from_mesh(SPACE, box_mesh("tetra", (4, 4, 4), (0, 0, 0), (1, 1, 1), place=skewed))
    whole, halves = surface([body], "top"), 0.0
    for low, high in ((-9, 0.9), (0.9, 9)):
        halves += surface([body], "top", ((low, -9, -9), (high, 9, 9))).area0.sum()
    assert halves == pytest.approx(whole.area0.sum(), rel=1e-10)


@pytest.mark.parametrize("kind", [*KINDS, "wedge"])
def test_a_linear_field_is_exact_however_the_mesh_lies(kind):
    dim = len(ALL[kind])
    grid = mpm.Grid([0] * dim, [2.2] * dim, [6] * dim)
    body = mpm.from_mesh(grid, box_mesh(kind, (3,) * dim, (0,) * dim, (1,) * dim, place=skewed))
    H = np.array([[0.05, 0.1, 0.02], [-0.03, -0.08, 0.04], [0.01, 0.06, 0.03]])[:dim, :dim]
    sides = [mpm.Displacement(name, lambda t, X: t * X @ H.T) for name in body.names]
    s = mpm.Simulation(grid, [body], [SOIL], walls={}, conditions=sides)
    s.run(1.0, 1.0, progress=False)
    assert s.points.F == pytest.approx(np.tile(np.eye(dim) + H, (len(s.points), 1, 1)), abs=2e-3)


def tip(body, grid, load, x):
    """Return the deflection of the end of a body, fixed at its left, under a load on its top."""
    walls = {"left": "xyz"[: grid.dim]} | ({"front": "y", "back": "y"} if grid.dim == 3 else {})
    down = (0,) * (grid.dim - 1) + (-load,)
    traction = mpm.Traction("top", lambda t: np.multiply(t, down))
    s = mpm.Simulation(grid, [body], [SOIL], walls=walls, conditions=[traction])
    return s.run(1.0, 0.25, probes=mpm.probes([body], [x]), progress=False).displacement[-1][0, -1]


def test_a_beam_of_a_mesh_bends_as_one_of_boxes():
    grid, low, high, x = mpm.Grid([0, 0], [2.2, 1.5], [22, 15]), (0, 0.75), (2, 1.25), [2.0, 1.0]
    boxes = {n: tip(mpm.box(grid, low, high, per_cell=n), grid, 4e3, x) for n in (2, 3, 4)}
    limit = boxes[2] + (boxes[4] - boxes[2]) * 4 / 3  # what is left falls as one over the points squared
    assert boxes[3] == pytest.approx(limit + (boxes[2] - limit) * 4 / 9, rel=3e-4)
    assert tip(mpm.from_mesh(grid, box_mesh("quad", (40, 10), low, high)), grid, 4e3, x) == pytest.approx(
        boxes[2], rel=1e-3
    )
    triangles = tip(mpm.from_mesh(grid, box_mesh("triangle", (24, 6), low, high)), grid, 4e3, x)
    assert triangles == pytest.approx(boxes[3], rel=1.5e-3), "864 points, 900"
    assert boxes[3] < triangles < limit


@pytest.mark.slow
def test_a_beam_of_a_mesh_in_3d_bends_as_one_of_boxes():
    grid, low, high, x = (
        mpm.Grid([0, 0, 0], [1.8, 0.4, 1.2], [18, 4, 12]),
        (0, 0, 0.6),
        (1.5, 0.4, 1.0),
        [1.5, 0.2, 0.8],
    )
    boxes = {n: tip(mpm.box(grid, low, high, per_cell=n), grid, 3e3, x) for n in (2, 4)}
    hexahedra = mpm.from_mesh(grid, box_mesh("hexahedron", (30, 8, 8), low, high))
    tetrahedra = mpm.from_mesh(grid, box_mesh("tetra", (11, 3, 3), low, high))
    assert tip(hexahedra, grid, 3e3, x) == pytest.approx(boxes[2], rel=1e-3)
    assert tip(tetrahedra, grid, 3e3, x) == pytest.approx(boxes[4], rel=1e-3), "19008 points, 15360"


def cylinder(p, bulk, shear):
    """Return a function for u, sigma_r and sigma_t at radii R from 1 to 2 m of a cylinder, Hencky's law, inner pressure
    p.
    """

    def stresses(R, r, slope):
        strain = np.array([np.log(slope), np.log(r / R), 0 * R])
        tau = 2 * shear * (strain - strain.sum(axis=0) / 3) + bulk * strain.sum(axis=0)
        return tau[0] / slope, tau[1] / (r / R)  # nominal

    def slope_of(R, r, P):
        slope = np.ones_like(R)
        for _ in range(30):
            at, beyond = (stresses(R, r, s)[0] for s in (slope, slope * (1 + 1e-7)))
            slope = slope - (at - P) / ((beyond - at) / (slope * 1e-7))
        return slope

    def slopes(R, y):
        slope = slope_of(R, *y)
        radial, hoop = stresses(R, y[0], slope)
        return np.stack([slope, -(radial - hoop) / R])

    R = np.linspace(1, 2, 101)
    start = np.stack([R + p / shear / R, 0 * R - p / 2])
    y = solve_bvp(slopes, lambda a, b: np.array([a[1] + p * a[0], b[1]]), R, start, tol=1e-9).sol

    def at(R):
        r, P = y(R)
        slope = slope_of(R, r, P)
        hoop = stresses(R, r, slope)[1]
        return r - R, P / (r / R), hoop / slope

    return at


def pressed_hole(body, side, p, steps, cells):
    """Return the rms errors of displacements and stresses of a quarter of a cylinder with radii 1 and 2 m."""
    bulk, shear = 2e6, 1e6
    grid = mpm.Grid([0] * 2, [2.6] * 2, [round(2.6 * cells)] * 2)
    body = body(grid)
    load = mpm.Pressure(side, lambda t: p * t)
    s = mpm.Simulation(grid, [body], [mpm.Hencky(bulk, shear)], walls={"left": "x", "bottom": "y"}, conditions=[load])
    s.run(1.0, 1 / steps, progress=False)
    X = s.points.x - s.points.displacement
    u, radial, hoop = cylinder(p, bulk, shear)(np.linalg.norm(X, axis=1).clip(1, 2))
    x, stress, volume = s.points.x, s.effective_stress(), s.points.volume0
    out = x / np.linalg.norm(x, axis=1)[:, None]
    around = np.stack([-out[:, 1], out[:, 0]], axis=1)
    along, across = (np.einsum("ni,nij,nj->n", e, stress, e) for e in (out, around))
    moved = np.einsum("ni,ni->n", s.points.displacement, out)
    wrong = (along - radial) ** 2 + (across - hoop) ** 2
    exact = radial**2 + hoop**2
    return np.sqrt([volume @ (moved - u) ** 2 / (volume @ u**2), volume @ wrong / (volume @ exact)])


@pytest.mark.parametrize(("p", "steps"), [(1e3, 1), (2e5, 5)])
def test_a_pressed_hole_has_the_exact_displacements_and_stresses(p, steps):
    polar = lambda x: (1 + x[:, :1]) * np.stack([np.cos(x[:, 1]), np.sin(x[:, 1])], axis=1)  # noqa: E731
    ring = box_mesh("quad", (48, 72), (0, 0), (1, np.pi / 2), place=polar)
    moved, stress = pressed_hole(lambda grid: mpm.from_mesh(grid, ring), "left", p, steps, 24)
    assert moved < 5e-4 and stress < 5e-3


@pytest.mark.parametrize(("p", "steps"), [(1e3, 1), pytest.param(2e5, 5, marks=pytest.mark.slow)])
def test_a_polygon_is_as_exact(p, steps):
    """A mesh of triangles with the same size of cells has stresses with an error of 0.73 %."""
    pytest.importorskip("gmsh")
    inner, outer = (np.linspace(0, np.pi / 2, 1 + n) for n in (48, 96))
    inner, outer = (r * np.stack([np.cos(a), np.sin(a)], axis=1).clip(0) for r, a in ((1, inner), (2, outer[::-1])))
    sides = [*["hole"] * 48, "axis", *["out"] * 96, "floor"]

    def ring(grid):
        return mpm.polygon(grid, np.concatenate([inner, outer]), sides)

    moved, stress = pressed_hole(ring, "hole", p, steps, 24)
    assert moved < 5e-4 and stress < 5e-3


def test_a_polygon_is_filled_up_to_sides_with_their_names():
    body = outlined([(0, 0), (1.8, 0), (0.6, 1), (0, 1)], ["base", "slope", "crest", "axis"])
    assert volumes(body.corners()).sum() == pytest.approx(1.2, rel=1e-12)
    assert surface([body], "slope").area0.sum() == pytest.approx(np.hypot(1.2, 1.0), rel=1e-12)


def test_a_slope_under_an_even_pressure_has_an_even_stress():
    body = outlined([(0, 0), (1.8, 0), (0.6, 1), (0, 1)], ["base", "slope", "crest", "axis"])
    loads = [mpm.Pressure(side, lambda t: 5e5 * t) for side in ("slope", "crest")]
    s = mpm.Simulation(GRID, [body], [SOIL], walls={"left": "x", "bottom": "y"}, conditions=loads)
    s.run(1.0, 0.2, progress=False)
    assert s.effective_stress() == pytest.approx(np.tile(-5e5 * np.eye(2), (len(body), 1, 1)), abs=1.0)


@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_parts_of_a_mesh_share_their_inner_faces(kind):
    mesh = box_mesh(kind, (8, 4), (0, 0), (2, 1), parts={"one": lambda x: x[:, 0] < 1, "two": lambda x: x[:, 0] > 1})
    one, two = (mpm.from_mesh(GRID, mesh, part) for part in ("one", "two"))
    assert len(one) == len(two) and surface([one, two], "top").area0.sum() == pytest.approx(2.0, rel=1e-12)
    assert set(one.names) == {"left", "bottom", "top"} and set(two.names) == {"right", "bottom", "top"}
    walls, load = {"left": "x", "bottom": "y"}, mpm.Traction("right", (-1e5, 0))
    both = mpm.Simulation(GRID, [one, two], [SOIL], walls=walls, conditions=[load])
    whole = mpm.Simulation(GRID, [mpm.from_mesh(GRID, mesh)], [SOIL], walls=walls, conditions=[load])
    for s in (both, whole):
        s.run(1.0, 1.0, progress=False)
    assert both.points.F.mean(axis=0) == pytest.approx(whole.points.F.mean(axis=0), rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_dolfinx_mesh_with_tags_is_the_mesh_of_meshio(kind):
    dim, cells = len(KINDS[kind]), KINDS[kind]
    name = {"quad": "quadrilateral", "tetra": "tetrahedron"}.get(kind, kind)
    make = dolfinx.mesh.create_rectangle if dim == 2 else dolfinx.mesh.create_box
    mesh = make(
        MPI.COMM_WORLD, [np.zeros(dim), np.array([2.0, 1.0, 1.0][:dim])], cells, getattr(dolfinx.mesh.CellType, name)
    )
    facets = np.sort(dolfinx.mesh.locate_entities_boundary(mesh, dim - 1, lambda x: np.isclose(x[dim - 1], 1)))
    part = np.sort(dolfinx.mesh.locate_entities(mesh, dim, lambda x: x[0] < 1 + 1e-9))
    tags = {"facet_tags": dolfinx.mesh.meshtags(mesh, dim - 1, facets, np.full(len(facets), 3, np.int32))}
    tags["cell_tags"] = dolfinx.mesh.meshtags(mesh, dim, part, np.full(len(part), 5, np.int32))
    grid, other = of_kind(kind)
    whole = mpm.from_mesh(grid, mesh, **tags)
    half = mpm.from_mesh(grid, mesh, "clay", names={"top": 3, "clay": 5}, **tags)
    assert len(whole) == len(other) == 2 * len(half) and whole.names == ("3",) and half.names == ("top",)
    assert surface([whole], "3").area0.sum() == pytest.approx(2) == 2 * surface([half], "top").area0.sum()


@pytest.mark.parametrize("kind", ["triangle", "quadrilateral"])
def test_a_dolfinx_mesh_of_second_order_is_that_of_its_vertices(kind, warned):
    x = [(0, 0), (1, 0), (0, 1)] + ([(0.6, 0.6), (0, 0.5), (0.5, 0)] if kind == "triangle" else [(1, 1)])
    x += [(0.5, 0), (0, 0.5), (1.05, 0.5), (0.5, 1), (0.5, 0.5)] if kind == "quadrilateral" else []
    cells, x = np.arange(len(x))[None] if MPI.COMM_WORLD.rank == 0 else np.empty((0, len(x)), int), np.array(x)
    if _compat.OLD:
        domain = ufl.Mesh(ufl.VectorElement("Lagrange", kind, 2))
        mesh = dolfinx.mesh.create_mesh(MPI.COMM_WORLD, cells, x, domain)
    else:
        domain = ufl.Mesh(basix.ufl.element("Lagrange", kind, 2, shape=(2,)))
        mesh = dolfinx.mesh.create_mesh(MPI.COMM_WORLD, cells=cells, x=x, e=domain)
    body = mpm.from_mesh(GRID, mesh)
    assert volumes(body.corners()).sum() == pytest.approx(0.5 if kind == "triangle" else 1)
    off = "0.14" if kind == "triangle" else "0.05"
    (message,) = warned()
    assert "1 cells are of second order" in message and f"up to {off} m off" in message


@pytest.mark.parametrize("kind", ALL)
def test_cells_may_be_numbered_either_way_round(kind):
    grid, body = of_kind(kind)
    mesh = box_mesh(kind, ALL[kind], (0,) * grid.dim, (2.0, 1.0, 1.0)[: grid.dim])
    mirrored = {"triangle": [0, 2, 1], "quad": [0, 3, 2, 1], "tetra": [0, 2, 1, 3], "pyramid": [0, 3, 2, 1, 4]}
    mirrored |= {"wedge": [3, 4, 5, 0, 1, 2], "hexahedron": [4, 5, 6, 7, 0, 1, 2, 3]}
    mesh.cells[-1].data[::2] = mesh.cells[-1].data[::2][:, mirrored[kind]]
    other = mpm.from_mesh(grid, mesh)
    assert volumes(other.corners()).sum() == pytest.approx(2) and volumes(other.corners()).min() > 0
    areas = [{name: surface([b], name).area0.sum() for name in b.names} for b in (body, other)]
    assert areas[0] == pytest.approx(areas[1])


@pytest.mark.parametrize("kind", ["triangle", "quad", "tetra", "hexahedron", "wedge"])
def test_a_strip_that_is_bent_round_until_its_ends_meet_is_refused_once_they_overlap(kind):
    """Overlapping cells share no facet there, and shared facets have a cell on either side."""
    dim = len(ALL[kind])
    grid = mpm.Grid([0] * dim, [4, 4, 1][:dim], [8, 8, 2][:dim])

    def ring(turns):
        def place(x):
            angle, r = 2 * np.pi * turns * x[:, 0], 1 + x[:, 1]
            return np.column_stack([2 + r * np.cos(angle), 2 + r * np.sin(angle), *x[:, 2:].T])

        return mpm.from_mesh(grid, box_mesh(kind, (24, 2, 2)[:dim], (0,) * dim, (1, 0.5, 0.5)[:dim], place=place))

    assert len(ring(0.99)) > 0
    with pytest.raises(ValueError, match="cells overlap"):
        ring(1.001)


@pytest.mark.parametrize("dim", [2, 3])
def test_no_mesh_of_which_two_cells_hold_one_place_is_taken(dim):
    """Meshes of random points with one displaced point, without some cells, or with two additional cells."""
    rng, grid, taken = np.random.default_rng(dim), mpm.Grid([0] * dim, [1.0] * dim, [1] * dim), {True: 0, False: 0}
    for trial in range(30):
        x = rng.random((rng.integers(dim + 3, 20), dim))
        cells = Delaunay(x).simplices
        if trial % 3 == 0:
            x[rng.integers(len(x))] = rng.random(dim)
        elif trial % 3 == 1:
            cells = cells[rng.random(len(cells)) < 0.6]
        else:
            cells, x = np.concatenate([cells, cells + len(x)]), np.concatenate([x, x + rng.random(dim)]) / 2
        edges = x[cells[:, 1:]] - x[cells[:, :1]]
        cells, edges = (rows[np.abs(np.linalg.det(edges)) > 1e-4] for rows in (cells, edges))
        places = rng.random((2000, dim))
        at = np.einsum("pcj,cji->pci", places[:, None] - x[cells[:, 0]], np.linalg.inv(edges))
        twice = ((at.min(axis=2) > 1e-3) & (at.sum(axis=2) < 0.999)).sum(axis=1).max(initial=0) > 1
        try:
            seed(x, [("triangle" if dim == 2 else "tetra", cells)], grid=grid, per_cell=1)
            taken[twice] += 1
        except ValueError as error:
            assert any(said in str(error) for said in ("overlap", "on one side", "has no"))
    assert taken[False] > 10 and not taken[True]


def test_warped_hexahedra_fill_their_mesh_however_they_are_numbered():
    mesh, rng = box_mesh("hexahedron", (4,) * 3, (0,) * 3, (1,) * 3), np.random.default_rng(0)
    inner = ((mesh.points > 1e-9) & (mesh.points < 1 - 1e-9)).all(axis=1)
    mesh.points[inner] += rng.uniform(-0.025, 0.025, (inner.sum(), 3))  # a tenth of an edge
    mesh.cells[-1].data[::2] = mesh.cells[-1].data[::2][:, [1, 2, 3, 0, 5, 6, 7, 4]]
    body = mpm.from_mesh(mpm.Grid([0] * 3, [1.0] * 3, [4] * 3), mesh, per_cell=1)
    assert volumes(body.corners()).sum() == pytest.approx(1.0, rel=1e-13)


def test_a_file_names_sides_and_parts_by_gmsh_s_groups_or_numbers(tmp_path):
    mesh = box_mesh("triangle", (4, 2), (0, 0), (2, 1))
    tags = [np.full(len(block.data), k + 1) for k, block in enumerate(mesh.cells)]
    groups = {"base": np.array([3, 1]), "clay": np.array([5, 2])}
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    for version in ("gmsh22",):
        file = tmp_path / f"{version}.msh"
        meshio.write(
            file, meshio.Mesh(mesh.points, mesh.cells, cell_data=data, field_data=groups), version, binary=False
        )
        body = mpm.from_mesh(GRID, file, "clay")
        assert body.names == ("1", "2", "base", "4") or set(body.names) == {"1", "2", "base", "4"}
        assert surface([body], "base").area0.sum() == pytest.approx(2.0)


def test_probes_are_found_in_any_domain():
    for kind in ALL:
        grid, body = of_kind(kind, place=skewed, upper=(1, 1, 1))
        x = body.reference().mean(axis=1)[::7]
        found = mpm.probes([body], x)
        assert (found.id == np.arange(len(body))[::7]).all() and found.xi == pytest.approx(0 * x, abs=1e-9)
        with pytest.raises(ValueError, match="outside the bodies"):
            mpm.probes([body], [0.01] * grid.dim)


def test_a_bent_mesh_keeps_its_sides_and_reference_positions():
    body = mpm.from_mesh(GRID, box_mesh("triangle", (8, 4), (0, 0), (1, 1)))
    turned = mpm.mapped(GRID, body, lambda x: np.stack([1.2 - x[:, 1], x[:, 0]], axis=1))
    top = surface([turned], "top", ((0.25, 0), (0.75, 1)))
    assert top.area0.sum() == pytest.approx(0.5) and top.places()[:, :, 0] == pytest.approx(0.2)
    assert top.X[:, :, 1] == pytest.approx(1.0)


def test_a_fill_of_a_mesh_lies_on_the_settled_ground():
    grid = mpm.Grid([0, 0], [1.2, 1.2], [12, 12])
    ground = mpm.from_mesh(grid, box_mesh("triangle", (12, 5), (0, 0), (1.2, 0.5)))
    trapezoid = lambda x: np.stack([x[:, 0] * (1 - 0.5 * x[:, 1]), 0.5 + 0.3 * x[:, 1]], axis=1)  # noqa: E731
    fill = mpm.from_mesh(grid, box_mesh("triangle", (9, 4), (0, 0), (0.8, 1), place=trapezoid))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    load = mpm.Traction("top", (0, -1e5), region=((0, 0), (0.8, 0.5)))
    s = mpm.Simulation(grid, [ground, mpm.Later(fill)], [SOIL], walls=walls, conditions=[load])
    s.run(1.0, 0.25, progress=False)
    top = surface([ground], "top")
    settled = s.points.corners[top.id][:, :, 1].max(axis=1).min()
    assert settled < 0.47
    s.stage(add=[1], conditions=[])
    new = s.points.of(np.arange(len(ground)), kept=False)
    area = volumes(s.points.corners).sum()
    assert new.corners[:, :, 1].max() == pytest.approx(0.8, abs=1e-9), "its top stays where it was seeded"
    on = new.corners[new.corners[:, :, 1] < 0.5]
    assert on[:, 1].min() == pytest.approx(settled, abs=2e-3)
    s.run(2.0, 0.5, progress=False)
    assert volumes(s.points.corners).sum() > area and s.points.J[len(ground) :].mean() > 0.9


def test_a_resumed_mesh_ends_as_one_that_was_never_interrupted(tmp_path):
    def scene():
        body = mpm.from_mesh(GRID, box_mesh("triangle", (6, 4), (0, 0), (1, 1)))
        return mpm.Simulation(
            GRID,
            [body],
            [SOIL],
            walls={"bottom": "xy"},
            conditions=[mpm.Traction("top", lambda t: (2e4 * t, -2e4 * t))],
        )

    whole, part = scene(), scene()
    whole.run(1.0, 0.25, progress=False)
    files = {"checkpoint": mpm.Checkpoint(tmp_path / "run.ckpt"), "observe": mpm.Writer(part, tmp_path / "out")}
    part.run(0.5, 0.25, progress=False, **files)
    again = scene()
    after = mpm.resume(again, tmp_path / "run.ckpt")
    again.run(1.0, 0.25, progress=False, after=after)
    assert (again.points.corners == whole.points.corners).all()
    written = meshio.read(tmp_path / "out" / "points" / "000000.vtu")
    assert len(written.points) == 4 * len(part.points)


def seed(points, cells, part=None, grid=GRID, **options):
    return mpm.from_mesh(grid, meshio.Mesh(np.array(points, dtype=float), cells), part, **options)


def two_meshes(kind, x):
    """Return two boxes of one kind of cells; the second box begins at a given position."""
    one, two = (box_mesh(kind, (1,) * 3, (low, 0, 0), (low + 1, 1, 1)) for low in (0, x))
    rows = np.concatenate([one.cells[-1].data, two.cells[-1].data + len(one.points)])
    return meshio.Mesh(np.concatenate([one.points, two.points]), [(kind, rows)])


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
HANGING = [*SQUARE, (2, 0, 0), (2, 1, 0), (1, 0.5, 0), (2, 0.5, 0)]
BOX = box_mesh("triangle", (2, 2), (0, 0), (1, 1))
BAD = {
    "a file that is not there": (lambda: mpm.from_mesh(GRID, "no.msh"), "mesh no.msh", "not found"),
    "a file of no mesh": (lambda: mpm.from_mesh(GRID, __file__), "mesh ", "meshio reads"),
    "no mesh": (lambda: mpm.from_mesh(GRID, 3), "mesh = 3", "must be a Mesh"),
    "a cell that is not convex": (
        lambda: seed([*SQUARE[:2], (0.2, 0.2, 0), SQUARE[3]], [("quad", [[0, 1, 2, 3]])]),
        "mesh: 1 cells are flat, inverted or not convex",
        "[0.3 0.3]",
    ),
    "a cell that crosses itself": (lambda: seed(SQUARE, [("quad", [[0, 2, 1, 3]])]), "mesh: 1 cells", "must be convex"),
    "a flat cell": (lambda: seed(SQUARE, [("triangle", [[0, 1, 1]])]), "mesh: 3 cells", "flat"),
    "a vertex outside": (lambda: seed(np.add(SQUARE, (1.5, 0, 0)), [("quad", [[0, 1, 2, 3]])]), "mesh", "[2.5 0. ]"),
    "hanging nodes": (
        lambda: seed(HANGING, [("quad", [[0, 1, 2, 3], [1, 4, 7, 6], [6, 7, 5, 2]])]),
        "mesh: ",
        "must share nodes",
    ),
    "three cells at a facet": (
        lambda: seed([*SQUARE, (0.5, 0.7, 0)], [("triangle", [[0, 1, 2], [0, 1, 3], [0, 1, 4]])]),
        "mesh: three cells share the facet",
        "[0.5 0. ]",
    ),
    "a surface in space": (
        lambda: seed([*SQUARE[:3], (0, 1, 0.5)], [("quad", [[0, 1, 2, 3]])]),
        "mesh: cells have z from",
        "0.5",
    ),
    "cells of third order": (lambda: seed(SQUARE, [("triangle10", [[0, 1, 2] * 3 + [3]])]), "mesh: ", "'triangle10'"),
    "a cell twice": (
        lambda: seed(SQUARE, [("quad", [[0, 1, 2, 3], [1, 2, 3, 0]])]),
        "mesh: 1 cells (quad) occur more than once",
        "[0.5 0.5]",
    ),
    "a quadrilateral and its triangles": (
        lambda: seed(SQUARE, [("quad", [[0, 1, 2, 3]]), ("triangle", [[0, 1, 2], [0, 2, 3]])]),
        "mesh: 4 facets have both of their cells on one side",
        "[0.5 0. ]",
    ),
    "a cell that is folded back": (
        lambda: seed([*SQUARE, (0.3, 0.6, 0)], [("triangle", [[0, 1, 2], [1, 2, 4]])]),
        "mesh: 1 facets have both of their cells on one side",
        "[1.  0.5]",
    ),
    "cells in one another": (
        lambda: seed([*SQUARE, *np.add(SQUARE, (0.9, 0.5, 0))], [("quad", [[0, 1, 2, 3], [4, 5, 6, 7]])]),
        "mesh: 2 cells overlap, most deeply at [0.95 0.75]",
        "by 0.1 m",
    ),
    "a small cell in a large one": (
        lambda: seed(
            [*SQUARE, *np.add(np.multiply(SQUARE, 0.1), (0.4, 0.4, 0))],
            [("quad", [[0, 1, 2, 3], [4, 5, 6, 7]])],
        ),
        "mesh: 2 cells overlap",
        "[0.45 0.45",
    ),
    "tetrahedra in one another": (
        lambda: mpm.from_mesh(SPACE, two_meshes("tetra", 0.99)),
        "mesh: 12 cells overlap",
        "by 0.01 m",
    ),
    "a node that is not there": (lambda: seed(SQUARE, [("quad", [[0, 1, 2, 4]])]), "has node 4", "one of the 4"),
    "a vertex that is nowhere": (
        lambda: seed([*SQUARE[:3], (np.nan, 1, 0)], [("quad", [[0, 1, 2, 3]])]),
        "mesh",
        "nan",
    ),
    "no vertices": (lambda: seed(np.empty((0, 3)), []), "mesh: has no vertices", "must have cells"),
    "no cells": (lambda: seed(SQUARE, []), "mesh: has no triangle and no quad", "2D"),
    "data that are not there": (
        lambda: mpm.from_mesh(GRID, BOX, cell_tags="rock"),
        "mesh: cell_tags = 'rock'",
        "cells have no data",
    ),
    "surfaces in 3D": (lambda: mpm.from_mesh(SPACE, BOX), "mesh: has no tetra and no hexahedron", "3D"),
    "tetrahedra in 2D": (
        lambda: mpm.from_mesh(GRID, box_mesh("tetra", (1, 1, 1), (0, 0, 0), (1, 1, 1))),
        "mesh: has cells 'tetra'",
        "2D",
    ),
    "an unknown part": (lambda: mpm.from_mesh(GRID, BOX, "clay"), "mesh: part 'clay'", "no parts with a name"),
    "an unknown side": (
        lambda: mpm.Simulation(
            GRID, [mpm.from_mesh(GRID, BOX)], [SOIL], walls={"left": "xy"}, conditions=[mpm.Traction("crest", 1.0)]
        ),
        "side 'crest'",
        "left, right, bottom, top",
    ),
    "names that are no numbers": (lambda: mpm.from_mesh(GRID, BOX, names={"top": "3"}), "mesh: names", "'3'"),
    "tags of meshio": (lambda: mpm.from_mesh(GRID, BOX, facet_tags=1), "mesh: ", "dolfinx"),
    "an edge without a name": (lambda: outlined(sides=["a"] * 3), "polygon: sides", "4 edges"),
    "a polygon that crosses itself": (
        lambda: outlined([(0, 0), (1, 1), (1, 0), (0, 1)]),
        "polygon: the edges",
        "[[0.0, 0.0], [1.0, 1.0]]",
    ),
    "a hole outside": (
        lambda: outlined([(0, 0), (1, 0), (1, 1), (0, 1)], holes={"a": [(1.2, 0), (1.4, 0), (1.3, 1)]}),
        "polygon: the hole",
        "[1.2 0. ]",
    ),
    "a polygon of two corners": (lambda: outlined([(0, 0), (1, 1)]), "polygon: corners", "(2, 2)"),
    "quadrilaterals of no size": (lambda: outlined(size=0.0), "polygon: size", "0.0"),
    "points a cell": (lambda: mpm.from_mesh(GRID, BOX, per_cell=0), "body: per_cell", "0"),
}


@pytest.mark.parametrize(("make", "name", "value"), BAD.values(), ids=BAD)
def test_a_bad_mesh_is_refused_in_one_line(make, name, value, tmp_path):
    refused_in_one_line(make, name, value, tmp_path, 400)


def outlined(corners=((0, 0), (2, 0), (1, 1), (0, 1)), sides=("base", "slope", "crest", ""), **options):
    pytest.importorskip("gmsh")
    return mpm.polygon(GRID, corners, sides, **options)


def test_a_polygon_has_the_names_of_its_edges_and_lies_on_others():
    hears = signal.getsignal(signal.SIGINT)
    slope, ground = outlined(np.add([(0, 0), (2, 0), (1, 1), (0, 1)], (0, 0.5))), mpm.box(GRID, [0, 0], [2, 0.5])
    assert signal.getsignal(signal.SIGINT) is hears, "gmsh takes Ctrl-C to itself"
    assert volumes(slope.corners()).sum() == pytest.approx(1.5) and set(slope.names) == {"base", "slope", "crest"}
    areas = {name: surface([slope, ground], name).area0.sum() for name in ("base", "slope", "crest", "top")}
    assert areas == pytest.approx({"base": 0, "slope": np.sqrt(2), "crest": 1, "top": 0}, abs=1e-9)
    size = np.sqrt(volumes(slope.corners()) / GRID.cell_volume)
    assert 0.38 < size.mean() < 0.6, "two points a cell and direction"


def test_a_polygon_is_filled_in_any_thread():
    """Only the main thread may set signal handlers."""
    grid = mpm.Grid([0, 0], [1, 1], [4, 4])
    found = []
    pytest.importorskip("gmsh")
    corners = [(0.1, 0.1), (0.9, 0.1), (0.5, 0.8)]
    thread = Thread(target=lambda: found.append(mpm.polygon(grid, corners, ["edge"] * 3)))
    thread.start()
    thread.join()
    assert len(found[0]) == len(mpm.polygon(grid, corners, ["edge"] * 3))


def test_a_polygon_in_national_coordinates_is_filled():
    """Earlier, gmsh ended the process."""
    pytest.importorskip("gmsh")
    origin = np.array([512000.0, 5.4e6])
    grid = mpm.Grid(origin, np.add(origin, [6, 3]), [24, 12])
    body = mpm.polygon(grid, np.add(origin, [(0, 0), (5, 0), (3, 2), (1, 2)]), ["base"] * 4)
    assert np.abs(volumes(body.corners())).sum() == pytest.approx(7.0, rel=1e-8)


def test_holes_are_sides_and_other_gmsh_models_stay():
    gmsh = pytest.importorskip("gmsh")
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([1 + 0.3 * np.cos(angle), 0.6 + 0.3 * np.sin(angle)], axis=1)
    gmsh.initialize()
    gmsh.model.add("own")
    body = outlined([(0, 0), (2, 0), (2, 1.2), (0, 1.2)], "wall", holes={"lining": ring}, size=0.1)
    assert gmsh.model.getCurrent() == "own"
    lining = surface([body], "lining")
    assert lining.area0.sum() == pytest.approx(24 * 0.6 * np.sin(np.pi / 24))
    assert np.einsum("md,md->m", lining.outward, lining.places().mean(axis=1) - (1, 0.6)).max() < 0
    gmsh.finalize()
    outlined(size=0.5)  # after somebody has ended it


def test_domains_that_are_far_too_small_are_named(warned):
    mpm.from_mesh(GRID, box_mesh("quad", (100, 2), (0, 0), (0.2, 0.002)))
    assert "smaller than 0.2 of the grid's resolution" in warned()[0]


def test_a_polygon_warns_of_small_domains_for_a_given_size_only(warned):
    pytest.importorskip("gmsh")
    grid, wedge = mpm.Grid([0, 0], [20, 12], [40, 24]), [[0, 0], [20, 0], [0, 8]]
    mpm.polygon(grid, wedge, "side")
    assert not warned()
    mpm.polygon(grid, wedge, "side", size=0.25)
    assert "smaller than 0.2 of the grid's resolution" in warned()[0]
