# SPDX-License-Identifier: MIT
"""Mesh files: elements and sides are at their positions in the file, or the file is refused in one line."""

import struct

import meshio
import numpy as np
import pytest
from helpers import refused_in_one_line
from meshes import box_mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.bodies.abaqus_files import _kind
from mpm_dolfinx.bodies.faces import surface
from mpm_dolfinx.bodies.mesh_cells import AS_LATTICE, edges
from mpm_dolfinx.bodies.touching import face_vectors
from mpm_dolfinx.points.cutting import volumes

GRID = mpm.Grid([0, 0], [4, 4], [8, 8])
SPACE = mpm.Grid([0, 0, 0], [3, 3, 3], [3, 3, 3])


def volume(file, part=None, grid=GRID, **options):
    """Return the volume and the lower and upper corner of the body of a file, and the areas of its sides."""
    body = mpm.from_mesh(grid, file, part, **options)
    x = body.corners().reshape(-1, grid.dim)
    areas = {name: surface([body], name).area0.sum() for name in body.names}
    return volumes(body.corners()).sum(), x.min(axis=0), x.max(axis=0), areas


def written(folder, text, name="scene.inp"):
    """Return a file with a text."""
    file = folder / name
    file.write_text(text)
    return file


# ---- Abaqus -------------------------------------------------------------------------------------

PARTS = """*Heading
** two parts, both with nodes and elements from 1 on
*Part, name=Soil
*Node
 1, 0., 0.
 2, 1., 0.
 3, 1., 1.
 4, 0., 1.
*Element, type=CPE4P
 1, 1, 2, 3, 4
*Elset, elset=Clay, internal
 1,
*End Part
*Part, name=Wall
*Node
 1, 0., 0.
 2, 2., 0.
 3, 2., 1.
 4, 0., 1.
*Element, type=CPE4
 1, 1, 2, 3, 4
*End Part
*Assembly, name=Assembly
*Instance, name=Soil-1, part=Soil
*End Instance
*Instance, name=Wall-1, part=Wall
 3., 1., 0.
 3., 1., 0., 3., 1., 1., 90.
*End Instance
*Elset, elset=_crest_S3, internal, instance=Soil-1
 1,
*Surface, type=ELEMENT, name=crest
_crest_S3, S3
*Surface, type=ELEMENT, name=foot
Wall-1.1, S4
*End Assembly
"""


def test_parts_of_an_abaqus_file_are_where_their_instances_put_them(tmp_path):
    file = written(tmp_path, PARTS)
    assert volume(file)[0] == pytest.approx(3)
    with pytest.raises(ValueError, match=r"must be one of its parts: 'Soil-1', 'Clay', 'Wall-1'$"):
        mpm.from_mesh(GRID, file, "_crest_S3")  # of a surface
    for part in ("Soil-1", "Clay"):
        V, low, high, areas = volume(file, part)
        assert V == pytest.approx(1) and areas == pytest.approx({"crest": 1})
        assert low == pytest.approx([0, 0]) and high == pytest.approx([1, 1])
    V, low, high, areas = volume(file, "Wall-1")  # shifted by (3, 1), then turned by 90 degrees about (3, 1)
    assert V == pytest.approx(2) and areas == pytest.approx({"foot": 1})
    assert low == pytest.approx([2, 1], abs=1e-12) and high == pytest.approx([3, 3])


def test_parts_without_an_assembly_are_parts_where_they_are(tmp_path):
    file = written(tmp_path, PARTS.split("*Assembly")[0])
    assert volume(file, "Soil")[0] == pytest.approx(1) and volume(file, "Wall")[0] == pytest.approx(2)
    with pytest.raises(ValueError, match=r"scene.inp: 2 cells overlap, most deeply at \[0.5 0.5\]"):
        mpm.from_mesh(GRID, file)


SETS = """*NODE, NSET=ALL
1, 0, 0, 0
2, 1, 0, 0
3, 2, 0, 0
4, 0, 1, 0
5, 1, 1, 0
6, 2, 1, 0
7, 3, 3, 9
*ELEMENT, TYPE=CAX4, ELSET=A
1, 1, 2, 5, 4
*ELSET, ELSET=base
1
*ELEMENT, TYPE=CAX4RP, ELSET=B
2, 2,
3, 6, 5
*ELEMENT, TYPE=SPRINGA, ELSET=springs
3, 1, 7
*ELSET, ELSET=both
A, b
*ELSET, ELSET=spans, GENERATE
1, 2
*SURFACE, NAME=around
both,
"""


def test_sets_of_an_abaqus_file_may_stand_anywhere(tmp_path):
    """Earlier, a set between two blocks of elements caused an IndexError, and an unused node made it a surface in
    space.
    """
    file = written(tmp_path, SETS)
    for part, width in {"base": 1, "A": 1, "B": 1, "both": 2, "spans": 2, None: 2}.items():
        V, low, _, areas = volume(file, part)
        assert V == pytest.approx(width) and (low[0] == 1) == (part == "B")
        assert areas == pytest.approx({"around": 2 + 2 * width}), "without a number: all free faces"


TYPES = {
    **{"triangle": "CPE3 CPS3 CAX3 CPE3H S3R STRI3", "quad": "CPE4 CPE4P CPE4RPH CAX4 CAX4P CPS4R S4R DC2D4 CPEG4"},
    **{"triangle6": "CPE6 CPE6MP CAX6M STRI65", "quad8": "CPE8P CPE8RP CAX8RP S8R", "tetra": "C3D4 C3D4P DC3D4 C3D4H"},
    **{"hexahedron": "C3D8 C3D8P C3D8RPH SC8R", "wedge": "C3D6 C3D6P SC6R", "pyramid": "C3D5", "tetra10": "C3D10MP"},
    **{"hexahedron20": "C3D20RP C3D20", "wedge15": "C3D15", "hexahedron27": "C3D27", "line": "T2D2 B21 B33 R2D2 SAX1"},
    **{"line3": "T3D3 B22 B32", "": "SPRINGA MASS CONN3D2 DASHPOT1"},
}


def test_nodes_may_be_there_again_and_have_exponents_of_fortran(tmp_path):
    again = "> **\n" + SETS.replace("7, 3, 3, 9", "7, 3, 3, 9\n*NODE\n2, 1.0D+00, 0.\n3, 2.")
    assert volume(written(tmp_path, again), "both")[0] == pytest.approx(2)


def test_elements_of_soil_have_the_shape_of_their_names():
    for kind, names in TYPES.items():
        assert {_kind(name) for name in names.split()} == {kind}, names
    for name in ("CINPE4", "COH2D4", "C3D15V", "CAXA41", "U1", "CPE40"):
        with pytest.raises(ValueError, match=f"TYPE={name}: must be"):
            _kind(name)


def input_file(x, cells, name):
    """Return an input file with nodes at positions x, and cells of a type."""
    lines = ["*NODE", *(f"{k + 1}, {', '.join(map(repr, row.tolist()))}" for k, row in enumerate(x))]
    lines += [f"*ELEMENT, TYPE={name}", *(f"{k + 1}, {str(row.tolist())[1:-1]}" for k, row in enumerate(cells + 1))]
    return "\n".join([*lines, ""])


def test_wedges_and_their_faces_are_those_of_abaqus(tmp_path):
    mesh = box_mesh("wedge", (2, 2, 2), (0, 0, 0), (2, 1, 1))
    text = input_file(mesh.points, mesh.cells[-1].data, "C3D6P")
    text += (
        "*ELSET, ELSET=low\n1, 2, 5, 6, 9, 10, 13, 14\n*SURFACE, NAME=floor\nlow, S1\n*SURFACE, NAME=wall\nlow, S3\n"
    )
    V, _, _, areas = volume(written(tmp_path, text), grid=SPACE)
    assert V == pytest.approx(2) and areas["floor"] == pytest.approx(2)
    assert areas["wall"] == pytest.approx(1), "y = 0, z < 0.5: vertices 1, 2, 5, 4 of every other wedge"


SECOND = {"triangle": "CPE6MP", "quad": "CPE8RP", "tetra": "C3D10", "hexahedron": "C3D20RP", "wedge": "C3D15"}


@pytest.mark.parametrize("kind", SECOND)
def test_cells_of_second_order_are_those_of_their_corners_with_a_warning(kind, tmp_path, warned):
    dim = 2 if kind in ("triangle", "quad") else 3
    mesh = box_mesh(kind, (2,) * dim, (0,) * dim, (1,) * dim)
    rows = mesh.cells[-1].data
    ends = np.sort(rows[:, AS_LATTICE.get(kind, range(rows.shape[1]))][:, np.array(edges(kind))], axis=2)
    pairs, at = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    nodes = np.concatenate([rows, len(mesh.points) + at.reshape(len(rows), -1)], axis=1)
    for off in (0.0125, 0.0):  # middles of edges beside their places
        middles = mesh.points[pairs].mean(axis=1) + np.array([off, 0, 0])
        file = written(tmp_path, input_file(np.concatenate([mesh.points, middles]), nodes, SECOND[kind]))
        assert volume(file, grid=GRID if dim == 2 else SPACE)[0] == pytest.approx(1)
        (message,) = warned()
        assert f"{len(rows)} cells are of second order" in message and f"up to {off:.2g} m off" in message


# ---- gmsh ---------------------------------------------------------------------------------------

X = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)]
LEFT, RIGHT, TOP = (1, 2, 5, 4), (2, 3, 6, 5), (6, 5)
NAMES = '$PhysicalNames\n3\n1 7 "crest"\n2 7 "whole"\n2 2 "right"\n$EndPhysicalNames\n'


def format41(folder, binary):
    """Return a file of two squares, in groups 7 and 9, and in 2, 7 and 9; a line in no group, and a line in group 7."""
    entities = [(1, 1, ()), (1, 2, (7,)), (2, 1, (7, 9)), (2, 2, (2, 7, 9))]
    elements = [(1, 1, 1, [(4, 5)]), (1, 2, 1, [TOP]), (2, 1, 3, [LEFT]), (2, 2, 3, [RIGHT])]

    def row(kinds, *values):
        form = "<" + "".join({"i": "i", "u": "Q", "d": "d"}[k] for k in kinds)
        return struct.pack(form, *values) if binary else (" ".join(map(str, values)) + "\n").encode()

    out = [b"$MeshFormat\n", f"4.1 {int(binary)} 8\n".encode(), *([struct.pack("<i", 1), b"\n"] if binary else [])]
    out += [b"$EndMeshFormat\n", NAMES.encode(), b"$Entities\n", row("uuuu", 0, 2, 2, 0)]
    for _, tag, groups in entities:
        out.append(row("i" + "d" * 6 + "u" + "i" * len(groups) + "u", tag, *[0.0] * 6, len(groups), *groups, 0))
    out += [b"\n$EndEntities\n$Nodes\n", row("uuuu", 1, 6, 1, 6), row("iiiu", 2, 1, 1, 6)]  # with parameters
    out += [row("u", k + 1) for k in range(6)] + [row("ddddd", *map(float, x), 0.5, 0.5) for x in X]
    out += [b"\n$EndNodes\n$Elements\n", row("uuuu", 4, 4, 1, 4)]
    for number, (dim, tag, kind, rows) in enumerate(elements):
        out += [row("iiiu", dim, tag, kind, len(rows)), *(row("u" * (1 + len(r)), number + 1, *r) for r in rows)]
    file = folder / "squares.msh"
    file.write_bytes(b"".join([*out, b"\n$EndElements\n"]))
    return file


def format22(folder):
    """Return the same mesh in format 2.2, with a copy of a cell for each of its groups."""
    rows = [(3, g, LEFT) for g in (7, 9)] + [(3, g, RIGHT) for g in (2, 7, 9)] + [(1, 7, TOP)]
    text = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n" + NAMES + "$Nodes\n6\n"
    text += "".join(f"{k + 1} {x} {y} {z}\n" for k, (x, y, z) in enumerate(X)) + f"$EndNodes\n$Elements\n{len(rows)}\n"
    text += "".join(f"{k + 1} {t} 2 {g} 1 {' '.join(map(str, r))}\n" for k, (t, g, r) in enumerate(rows))
    return written(folder, text + "$EndElements\n", "squares.msh")


@pytest.mark.parametrize("made", [format22, lambda f: format41(f, False), lambda f: format41(f, True)])
def test_a_cell_may_be_in_several_groups_of_gmsh(made, tmp_path):
    """Earlier, only one group of a cell was kept in format 4.1, and cells in two groups were refused in format 2.2."""
    file = made(tmp_path)
    for part, width in {None: 2, "whole": 2, "9": 2, "right": 1}.items():
        V, low, _, areas = volume(file, part)
        assert V == pytest.approx(width) and low[0] == 2 - width
        assert areas == pytest.approx({"crest": 1}), "a group of another dimension has the same number"
    assert volume(file, "peat", names={"peat": 9, "edge": 7})[3] == pytest.approx({"crest": 1, "edge": 1})


# ---- others -------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["MaterialIDs", "attribute", "gmsh:physical", "rock"])
def test_data_of_cells_number_parts(key, tmp_path):
    mesh = box_mesh("quad", (4, 2), (0, 0), (2, 1))
    data = {key: [np.repeat([1, 2], 4)], "serial": [np.arange(8)], "porosity": [np.full(8, 0.3)]}
    file = tmp_path / "mesh.vtu"
    meshio.write(file, meshio.Mesh(mesh.points, [mesh.cells[-1]], cell_data=data))
    tags = {"cell_tags": key} if key == "rock" else {}
    assert volume(file, "2", **tags)[1] == pytest.approx([1, 0])
    assert volume(file, "sand", names={"sand": 1}, **tags)[2] == pytest.approx([1, 1])


def test_groups_of_med_have_their_names(tmp_path):
    pytest.importorskip("h5py")
    mesh = box_mesh("quad", (4, 2), (0, 0), (2, 1))
    cells = [("line", mesh.cells[3].data), ("quad", mesh.cells[-1].data)]
    mesh = meshio.Mesh(mesh.points[:, :2], cells, cell_data={"cell_tags": [np.full(4, -3), np.repeat([-1, -2], 4)]})
    mesh.cell_tags, mesh.point_tags = {-1: ["clay", "all"], -2: ["sand", "all"], -3: ["crest"]}, {}
    meshio.write(tmp_path / "mesh.med", mesh)
    for part, width in {"clay": 1, "sand": 1, "all": 2}.items():
        V, _, _, areas = volume(tmp_path / "mesh.med", part)
        assert V == pytest.approx(width) and areas == pytest.approx({"crest": width})


FLAC = """G 1 0 0 0\nG 2 1 0 0\nG 3 0 1 0\nG 4 0 0 1\nG 5 1 1 0\nG 6 0 1 1\nG 7 1 0 1\nG 8 1 1 1
G 9 2 0 0\nG 10 2 1 0\nG 11 2 0 1\nG 12 2 1 1\nG 13 .5 .5 2\nZONES\nZ B8 1 1 2 3 4 5 6 7 8\nZ P5 2 4 7 6 13 8
Z B8 3 2 9 5 7 10 8 11 12\nZGROUP "clay" SLOT 1\n1 3\nZGROUP "cap" SLOT 1\n2\n"""


def test_groups_of_flac3d_are_those_of_their_zones(tmp_path):
    """meshio numbers zones through all blocks: earlier, zones of later blocks were in no group."""
    file = written(tmp_path, FLAC, "zones.f3grid")
    assert volume(file, "zone:clay:1", SPACE)[0] == pytest.approx(2)
    assert volume(file, "zone:cap:1", SPACE)[0] == pytest.approx(1 / 3)


BULK = "GRID,1,,0.,0.,0.\nGRID,2,SYSTEM,1.,0.,0.\nGRID,3,,1.,1.,0.\nGRID,4,,0.,1.,0.\nCQUAD4,1,7,1,2,3,4\n"


def test_bulk_data_of_nastran_need_no_case_before_it(tmp_path):
    assert volume(written(tmp_path, BULK.replace("SYSTEM", ""), "mesh.bdf"), "7")[0] == pytest.approx(1)


def in_two_pieces(folder):
    mesh = box_mesh("quad", (2, 2), (0, 0), (1, 1))
    meshio.write(folder / "one.vtu", meshio.Mesh(mesh.points, [mesh.cells[-1]]), binary=False)
    head, piece, tail = (folder / "one.vtu").read_text().partition("<Piece")
    piece, end, tail = (piece + tail).partition("</Piece>")
    return written(folder, head + 2 * (piece + end) + tail, "two.vtu")


BAD = {
    "pieces of VTK": (in_two_pieces, "two.vtu: 2 pieces with 8 cells", "last piece, of 4 cells"),
    "a system of Nastran": (
        lambda f: written(f, BULK.replace("SYSTEM", "5"), "mesh.bdf"), "mesh: GRID is in the coordinate system", "5"),
    "a file of no nodes": (lambda f: written(f, "*HEADING\n"), "mesh: has no vertices", "must have cells"),
    "elements before nodes": (lambda f: written(f, "*ELEMENT, TYPE=CPE3\n1, 1, 2, 3\n"), "node 1", "must be a number"),
    "a type of elements": (lambda f: written(f, SETS.replace("CAX4RP", "CINAX4")), "scene.inp: *ELEMENT", "CINAX4"),
    "a node that is not there": (lambda f: written(f, SETS.replace("3, 6, 5", "3, 6, 8")), "scene.inp", "node 8"),
    "too few nodes": (lambda f: written(f, SETS.replace("3, 6, 5", "3, 6")), "TYPE=CAX4RP: 4", "5 for each"),
    "no number": (lambda f: written(f, SETS.replace("7, 3, 3, 9", "7, q, 3, 9")), "scene.inp", "'Q'"),
    "generated nodes": (lambda f: written(f, SETS + "*NGEN\n1, 2\n"), "scene.inp: *NGEN", "one by one"),
    "cylindrical coordinates": (lambda f: written(f, SETS.replace("NSET=ALL", "SYSTEM=C")), "SYSTEM=C", "Cartesian"),
    "no type": (lambda f: written(f, SETS.replace(" TYPE=CAX4,", "")), "*ELEMENT: option TYPE", "must"),
    "an element twice": (lambda f: written(f, SETS.replace("2, 2,", "1, 2,")), "element 1 occurs twice", "once"),
    "a node twice": (lambda f: written(f, SETS.replace("7, 3, 3, 9", "6, 3, 3, 9")), "node 6 occurs twice", "once"),
    "an unknown set": (lambda f: written(f, SETS.replace("A, b", "A, c")), "element set 'C'", "A, base, B"),
    "an unknown part": (lambda f: written(f, PARTS.replace("part=Wall", "part=Wa")), "*INSTANCE Wall-1", "'Wa'"),
    "nodes of two parts where they touch": (
        lambda f: written(f, PARTS.replace(" 3., 1., 0.\n 3., 1., 0., 3., 1., 1., 90.\n", " 1.,\n")),
        "scene.inp: ", "must share nodes or belong to two parts"),
    "half a turn": (
        lambda f: written(f, PARTS.replace(", 1., 90.", "")), "*INSTANCE Wall-1: translation", "0 or 7 for"),
    "an old format of gmsh": (
        lambda f: written(f, "$MeshFormat\n4.0 0 8\n$EndMeshFormat\n", "a.msh"), "a.msh: gmsh's format 4.0", "2.2"),
    "a broken file of gmsh": (
        lambda f: written(f, "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n", "b.msh"), "b.msh: section $Nodes", "must be in"),
}  # fmt: skip


@pytest.mark.parametrize(("made", "name", "value"), BAD.values(), ids=BAD)
def test_a_bad_file_is_refused_in_one_line(made, name, value, tmp_path):
    refused_in_one_line(lambda: mpm.from_mesh(GRID, made(tmp_path)), name, value, tmp_path, 400)


def test_wedges_meet_tetrahedra_and_hexahedra_face_to_face():
    """Three unit cubes in an L: tetrahedra on the triangles of a wedge, and a hexahedron next to its quadrilaterals."""
    wedges, tops, cube = (box_mesh(k, (1,) * 3, low, np.add(low, 1)) for k, low in (
        ("wedge", (0, 0, 0)), ("tetra", (0, 0, 1)), ("hexahedron", (1, 0, 0))))  # fmt: skip
    x, at = np.unique(np.concatenate([m.points for m in (wedges, tops, cube)]), axis=0, return_inverse=True)
    at = at.reshape(3, 8)
    cells = [(m.cells[-1].type, at[k][m.cells[-1].data]) for k, m in enumerate((wedges, tops, cube))]
    body = mpm.from_mesh(SPACE, meshio.Mesh(x, cells), per_cell=1)
    assert volumes(body.corners()).sum() == pytest.approx(3) and body.surface.sum() > 0
    row, face = body.outer()
    assert np.linalg.norm(face_vectors(body.corners()[row], face), axis=1).sum() == pytest.approx(14)


def test_bodies_of_tetrahedra_in_one_another_are_refused_however_little():
    """Earlier, plane kites counted as warped faces, and gaps of a tenth of an edge were accepted."""
    one, two = (mpm.from_mesh(SPACE, box_mesh("tetra", (2,) * 3, (x, 0, 0), (x + 1, 1, 1))) for x in (0, 0.99))
    with pytest.raises(ValueError, match=r"bodies 0 and 1: overlap at .* by 0.01 m, must be apart or touch"):
        mpm.Simulation(SPACE, [one, two], [mpm.Hencky(bulk=1e6, shear=5e5)], walls={})
