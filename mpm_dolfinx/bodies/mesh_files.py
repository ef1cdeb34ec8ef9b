# SPDX-License-Identifier: MIT
"""Bodies from mesh files, from mesh objects of meshio, and from dolfinx meshes with tags."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
from dolfinx import mesh as dolfinx_mesh
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.base.validation import instance, line, line_of, path
from mpm_dolfinx.bodies.mesh_cells import AS_LATTICE, KINDS, SECOND_ORDER, SIDES_OF, distinct, edges
from mpm_dolfinx.bodies.meshes import Mesh, MeshBody, seeded
from mpm_dolfinx.grid.grid import FACES, Grid, begin_with
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn

if TYPE_CHECKING:  # meshio takes long to import, so functions import it
    import meshio

TAGS = ("gmsh:physical", "medit:ref", "cell_tags", "MaterialIDs", "attribute", "material", "nastran:ref", "su2:tag")
TAGS += ("avsucd:material", "ugrid:ref", "netgen:index", "tetgen:ref", "cell_markers", "CellEntityIds")
"""Names of the cell data in which meshio stores the tags of parts and sides."""
OF_DOLFINX = {2: {"triangle": 6, "quad": 9}, 3: {"tetra": 10, "hexahedron": 27}}
"""Cell types of dolfinx that become particle domains, and their numbers of nodes at second order."""


def from_mesh(
    grid: Grid,
    mesh: str | os.PathLike | meshio.Mesh | dolfinx_mesh.Mesh,
    part: str | None = None,
    *,
    cell_tags: Any = None,
    facet_tags: Any = None,
    names: Mapping[str, int] | None = None,
    per_cell: int = 2,
    material: int = 0,
) -> MeshBody:
    """Return a body seeded from a mesh.  Each cell of the mesh is divided into one or more particle domains.

    The sides of the body are the named groups of facets in the mesh: Abaqus surfaces, facet tags, or physical groups of
    gmsh.  Two parts of a mesh can become two bodies.  Faces between two active bodies do not belong to the surface.
    The filter of short waves (`domains/lattice.py`) does not act on bodies from meshes.

    Parameters
    ----------
    grid
        Background grid.
    mesh
        A file that meshio reads, an Abaqus input file, a meshio mesh or a dolfinx mesh.  Cells are triangles and
        quadrilaterals in 2D, and tetrahedra, hexahedra, wedges and pyramids in 3D.  Second-order cells are replaced by
        cells with straight edges, with a warning.  2D cells must lie in a plane z = constant.  A dolfinx mesh may be
        distributed over the processes of the grid.
    part
        Name of a group of cells: a physical group, an Abaqus part, instance or set, or a tag in cell data such as
        "MaterialIDs".  By default, the body consists of all cells.
    cell_tags, facet_tags
        Tags of a dolfinx mesh.  For a file, `cell_tags` is the name of the cell data with the tags of parts and sides.
    names
        Tags by name, such as {"top": 3}.  The default name of a tag is its number, such as "3".
    per_cell
        Desired points per grid cell and direction, >= 1.  Domains with an edge longer than 1.5 / `per_cell` times the
        cell size are divided.
    material
        Index of the material in the scene's list, >= 0.

    Raises
    ------
    ValueError
        The file is missing or unreadable, the type of mesh is not supported, or the part is unknown.  Cells are flat,
        inverted, non-convex, repeated or overlapping.  Vertices are outside the grid.  There are hanging or duplicate
        nodes.
    OSError
        A temporary file cannot be written.  Only runs on several processes write temporary files.
    """
    import meshio

    begin_with("body: grid", grid)
    name, names = "mesh", _numbers(names)
    if isinstance(mesh, (str, os.PathLike)):
        name, mesh = f"mesh {os.fspath(mesh)}", path("mesh", mesh)
    if isinstance(mesh, (Path, meshio.Mesh)):
        if not (cell_tags is None or isinstance(cell_tags, str)) or facet_tags is not None:
            raise ValueError(
                "mesh: cell_tags and facet_tags must be tags of a dolfinx mesh, or cell_tags the name of cell data"
            )
        found = partial(_of_meshio, grid, mesh, names, cell_tags, name)
    else:
        instance("mesh", mesh, dolfinx_mesh.Mesh)
        found = _of_dolfinx(grid, mesh, cell_tags, facet_tags, names)
    return seeded(grid, found, name, part=part, per_cell=per_cell, material=material)


def _file(file: Path) -> meshio.Mesh:
    """Return the mesh of a file.  An error message includes the output of meshio."""
    from mpm_dolfinx.bodies import mesh_readers

    output = StringIO()
    try:
        with redirect_stdout(output), redirect_stderr(output):
            return mesh_readers.read(file)
    except (Exception, SystemExit) as error:  # meshio exits for a file that it cannot read
        why = line_of(error) if isinstance(error, Exception) else " ".join(output.getvalue().split())
        why = why or type(error).__name__
        allowed = "" if " must " in why else "; must be a file that meshio reads"
        raise ValueError(f"mesh {file}: {why}{allowed}") from None


def _of_meshio(grid: Grid, mesh: meshio.Mesh | Path, names: Mapping[str, int], tags: str | None, name: str) -> Mesh:
    """Convert a meshio mesh, or a mesh file that meshio reads, to a `Mesh`."""
    from mpm_dolfinx.bodies import mesh_readers

    if isinstance(mesh, Path):
        mesh = _file(mesh)
    mesh_readers.check_systems(mesh)
    dim = grid.dim
    x = _positions(grid.dim, mesh.points)
    sets = mesh_readers.sets_of(mesh)
    known = {"vertex": 1, "line": 2, **SIDES_OF[dim], **KINDS[dim]}
    for other in [block.type for block in mesh.cells if SECOND_ORDER.get(block.type, block.type) not in known][:1]:
        raise ValueError(f"mesh: has cells {other!r}, must have {' and '.join(KINDS[dim])} for a grid in {dim}D")
    blocks = _first_order(name, x, mesh, known, KINDS[dim])
    if tags is not None and tags not in mesh.cell_data:
        known = ", ".join(mesh.cell_data) or "none, for the cells have no data"
        raise ValueError(f"mesh: cell_tags = {line(tags)}, must be the name of cell data of the mesh: {known}")
    cells = {kind: [np.empty((0, count), np.int64)] for kind, count in KINDS[dim].items()}
    parts, sides = {}, {}
    for i, (kind, rows) in enumerate(blocks):
        inner, facet = kind in KINDS[dim], kind in SIDES_OF[dim]
        numbers = _groups(mesh, sets, i, len(rows), dim if inner else dim - 1, names, tags) if inner or facet else ()
        for group, chosen in dict(numbers).items():
            if inner:
                start = sum(map(len, cells[kind]))
                parts.setdefault(group, {k: [] for k in cells})[kind].append(start + np.flatnonzero(chosen))
            else:
                sides.setdefault(group, []).append(rows[chosen])
        if inner:
            cells[kind].append(rows[:, AS_LATTICE.get(kind, slice(None))])
    parts = {
        group: {kind: np.concatenate([np.empty(0, np.int64), *rows]) for kind, rows in found.items()}
        for group, found in parts.items()
    }
    cells, parts = _merged({kind: np.concatenate(rows) for kind, rows in cells.items()}, parts)
    return Mesh(_plane(dim, x, cells), cells, parts, sides)


def surface_of(mesh: str | os.PathLike | meshio.Mesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the vertices (n, d) and the facets of a surface mesh: triangles (m, 3), or lines (m, 2) in a plane mesh.

    Quadrilaterals are divided into two triangles.  Second-order facets are replaced by their corners.
    """
    import meshio

    from mpm_dolfinx.bodies import mesh_readers

    name = "mesh"
    if isinstance(mesh, (str, os.PathLike)):
        name, mesh = f"mesh {os.fspath(mesh)}", _file(path("mesh", mesh))
    instance("mesh", mesh, meshio.Mesh)
    mesh_readers.check_systems(mesh)
    x, known = _positions(2, mesh.points), {"line": 2, "triangle": 3, "quad": 4}
    found = {kind: [] for kind in known}
    for kind, rows in _first_order(name, x, mesh, known, known):
        found[kind].extend([rows] * bool(len(rows)))
    used = np.concatenate([np.zeros(0, np.int64), *(rows.ravel() for of in found.values() for rows in of)])
    plane = x.shape[1] == 2 or np.ptp(x[used], axis=0)[2] <= NEAR * np.ptp(x[used], axis=0).max() if len(used) else True
    triangles = [rows[:, of] for rows in found["quad"] for of in ([0, 1, 2], [0, 2, 3])] + found["triangle"]
    facets = found["line"] if plane else triangles
    if not facets:
        kinds = ", ".join(sorted({block.type for block in mesh.cells})) or "none"
        raise ValueError(f"{name}: has cells {kinds}, must have triangles or quadrilaterals, or lines in a plane z = 0")
    return x[:, : 2 if plane else 3], np.concatenate(facets)


def _positions(dim: int, points: Any) -> NDArray[np.float64]:
    """Return the positions of the vertices of a mesh, in m."""
    x = np.asarray(points, dtype=float)
    if not len(x):
        raise ValueError("mesh: has no vertices, must have cells to fill a body")
    if x.ndim != 2 or not dim <= x.shape[1] <= 3:
        raise ValueError(f"mesh: vertices have shape {x.shape}, must have the grid's {dim} coordinates")
    return x


def _first_order(
    name: str, x: NDArray[np.float64], mesh: meshio.Mesh, known: Mapping[str, int], counted: Collection[str]
) -> list[tuple[str, NDArray[np.int64]]]:
    """Return the cell type, and the corners of the cells, of each block whose type is in `known`.

    `known`: number of corners of each cell type.
    `counted`: cell types whose cells of second order cause a warning.
    """
    blocks = []
    curved, off = 0, 0.0
    for block in mesh.cells:
        kind, rows = SECOND_ORDER.get(block.type, block.type), np.asarray(block.data, dtype=np.int64)
        if kind not in known:
            continue
        rows = rows if rows.ndim == 2 else rows.reshape(len(rows), 0)
        _check_nodes(rows, len(x))
        if kind != block.type and kind in counted and len(rows):
            curved, off = curved + len(rows), max(off, _edge_node_distance(x, rows, kind))
        blocks.append((kind, rows[:, : known[kind]]))
    if curved:
        _warn_curved(name, curved, off)
    return blocks


def _check_nodes(rows: NDArray[np.int64], count: int) -> None:
    """Raise an error for cells with nodes that do not exist."""
    if rows.size and not (rows.min() >= 0 and rows.max() < count):
        worst = rows.min() if rows.min() < 0 else rows.max()
        raise ValueError(f"mesh: a cell has node {worst}, must be one of the {count} nodes, counted from 0")


def _edge_node_distance(x: NDArray[np.float64], rows: NDArray[np.int64], kind: str) -> float:
    """Return the largest distance, in m, of edge nodes of second-order cells from edge midpoints."""
    first, second = np.array(edges(kind)).T
    corners = x[rows[:, AS_LATTICE.get(kind, range(1 + second.max()))]]
    middles = (corners[:, first] + corners[:, second]) / 2
    on = x[rows[:, corners.shape[1] : corners.shape[1] + len(first)]]
    nearest = [np.linalg.norm(middles - on[:, k, None], axis=2).min(axis=1) for k in range(on.shape[1])]
    return float(np.max(nearest, initial=0.0))


def _warn_curved(name: str, count: int, off: float) -> None:
    """Warn that second-order cells are replaced by their corners."""
    what = "%s: %d cells are of second order; only their corners are used, with straight edges; edge nodes lie "
    warn(MPI.COMM_SELF, ResolutionWarning, what + "up to %.2g m off the midpoints", name, count, off)


def _merged(
    cells: dict[str, NDArray[np.int64]], parts: dict[str, dict[str, NDArray[np.int64]]]
) -> tuple[dict[str, NDArray[np.int64]], dict[str, dict[str, NDArray[np.int64]]]]:
    """Return all cells, and the cells of each part.  Cells that several gmsh groups repeat are returned once."""
    cells = dict(cells)
    for kind, rows in cells.items():
        first, same = distinct(np.sort(rows, axis=1))
        if len(first) == len(rows):
            continue
        several = np.flatnonzero(np.bincount(same)[same] > 1)
        member = np.stack([np.isin(several, found[kind]) for found in parts.values()] or [np.zeros(len(several), bool)])
        if len(np.unique(np.stack([same[several], *member]), axis=1).T) < len(several):
            continue  # cells repeated in the same parts are an error if they are seeded
        order = np.argsort(first)  # in the order of the file
        number = np.empty_like(order)
        number[order] = np.arange(len(order))
        cells[kind] = rows[np.sort(first)]
        parts = {name: {**found, kind: np.unique(number[same[found[kind]]])} for name, found in parts.items()}
    return cells, parts


def _groups(
    mesh: meshio.Mesh,
    sets: Mapping[str, list],
    block: int,
    count: int,
    dim: int,
    names: Mapping[str, int],
    tags: str | None,
) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the name of each group, and which cells of a block belong to the group."""
    known = {name: int(tag) for name, (tag, d) in _pairs(mesh.field_data) if int(d) == dim} | dict(names)
    families = getattr(mesh, "cell_tags", None) or {}  # in MED files: names of the groups of each tag
    for key in (tags,) if tags is not None else TAGS:
        if key not in mesh.cell_data:
            continue
        values = np.asarray(mesh.cell_data[key][block]).reshape(count, -1)[:, 0]
        if families and key == "cell_tags":
            for name in sorted({name for of in families.values() for name in of}):
                chosen = np.isin(values, [number for number, of in families.items() if name in of])
                if chosen.any():
                    yield name, chosen
        elif (values == np.rint(values)).all():
            yield from numbered(values.astype(np.int64), known)
        elif tags is not None:
            raise ValueError(f"mesh: cell_tags = {line(tags)}, must be data of integers")
    for name, rows in sets.items():
        if rows[block] is not None and len(rows[block]) and not name.startswith("gmsh:"):
            for called in [other for other, number in known.items() if name == str(number)] or [name]:
                yield called, np.isin(np.arange(count), rows[block])


def _pairs(field_data: Mapping[str, Any]) -> Iterator[tuple[str, NDArray]]:
    """Yield the name, tag and dimension of each physical group of gmsh."""
    for name, value in field_data.items():
        if np.shape(value)[-1:] == (2,):
            for pair in np.reshape(value, (-1, 2)):
                yield name, pair


def _numbers(names: Mapping[str, int] | None) -> Mapping[str, int]:
    """Return the user's tags by name, or an empty mapping without tags."""
    whole = (int, np.integer)
    if names is not None and not (
        isinstance(names, Mapping) and all(isinstance(k, str) and isinstance(v, whole) for k, v in names.items())
    ):
        raise ValueError(f"mesh: names = {line(names)}, must be integer tags by name, such as {{'top': 3}}")
    return names or {}


def numbered(tags: NDArray[np.int64], names: Mapping[str, int]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield each name, and which entries of `tags` (n,) have this name.  Unnamed tags are named by their digits."""
    for name, number in names.items():
        if (tags == number).any():
            yield name, tags == number
    for number in np.setdiff1d(tags, list(names.values())).tolist():
        if number:  # 0 means no group
            yield str(number), tags == number


def _plane(dim: int, x: NDArray[np.float64], cells: Mapping[str, NDArray[np.int64]]) -> NDArray[np.float64]:
    """Return the first `dim` coordinates of vertices, and check that 2D cells have equal z."""
    used = np.unique(np.concatenate([np.empty(0, np.int64), *(rows.ravel() for rows in cells.values())]))
    if not np.isfinite(x[used]).all():
        invalid = used[~np.isfinite(x[used]).all(axis=1)][0]
        raise ValueError(f"mesh: vertex {invalid} is at {x[invalid]}, must be at finite coordinates")
    if len(used) and x.shape[1] > dim and np.ptp(x[used, 2]) > NEAR * np.ptp(x[used, :2], axis=0).max():
        low, high = x[used, 2].min(), x[used, 2].max()
        raise ValueError(f"mesh: cells have z from {low:.3g} to {high:.3g}, must lie in a plane of equal z in 2D")
    return x[:, :dim]


def _of_dolfinx(grid: Grid, mesh, cell_tags, facet_tags, names: Mapping[str, int]) -> Callable[[], Mesh]:
    """Gather a dolfinx mesh on rank 0, and return a function that converts the gathered mesh."""
    dim = grid.dim
    topology = mesh.topology
    kind = _compat.cell_kind(mesh)
    kind = {"quadrilateral": "quad", "tetrahedron": "tetra"}.get(kind, kind)
    if topology.dim != dim or kind not in OF_DOLFINX[dim]:
        raise ValueError(f"mesh: has cells {kind!r}, must have {' or '.join(OF_DOLFINX[dim])} for a grid in {dim}D")
    for name, tags, of in (("cell_tags", cell_tags, dim), ("facet_tags", facet_tags, dim - 1)):
        if tags is not None and getattr(tags, "dim", None) != of:
            raise ValueError(f"mesh: {name} = {line(tags)}, must be tags of entities of dimension {of}")
    owned, _ = _compat.num_cells(mesh)
    dofs = _compat.geometry_dofs(mesh)[:owned]
    vertices, orders = KINDS[dim][kind], OF_DOLFINX[dim][kind]
    if dofs.shape[1] not in (vertices, orders):
        what = f"must have {vertices} for first order or {orders} for second order"
        raise ValueError(f"mesh: cells have {dofs.shape[1]} nodes, {what}")
    curved, off = dofs.shape[1] != vertices, 0.0
    if curved:
        off = _edge_node_distance(mesh.geometry.x, _as_meshio(dofs, kind), kind)
        dofs = dofs[:, :vertices]
    topology.create_connectivity(dim, dim - 1)
    facets = topology.connectivity(dim, dim - 1).array.reshape(-1, len(_facets(dim, kind)))[:owned]
    nodes = mesh.geometry.index_map().local_to_global(np.arange(len(mesh.geometry.x), dtype=np.int32))
    tags = _tag_of(cell_tags, np.arange(owned)), _tag_of(facet_tags, facets)
    root = int(np.argmin(mesh.comm.allgather(grid.comm.rank)))  # the mesh may be on each process alone
    rows = mesh.comm.gather((nodes, mesh.geometry.x, nodes[dofs], *tags, np.array([off])), root)
    return partial(_of_rows, dim, kind, rows, curved, names)


def _of_rows(dim: int, kind: str, rows: list[tuple], curved: bool, names: Mapping[str, int]) -> Mesh:
    """Convert the gathered nodes, cells and tags of a dolfinx mesh to a `Mesh`."""
    number, x, cells, tag, side, off = map(np.concatenate, zip(*rows, strict=True))
    if curved:
        _warn_curved("mesh", len(cells), off.max())
    vertices = np.empty((number.max(initial=-1) + 1, 3))
    vertices[number] = x
    vertices = _plane(dim, vertices, {kind: cells})
    order = np.lexsort(vertices[cells].mean(axis=1).T)
    cells, tag, side = (values[order] for values in (cells, tag, side))
    parts = {name: {kind: np.flatnonzero(rows)} for name, rows in numbered(tag, names)}
    sides = {
        name: [cells[on[:, k]][:, corners] for k, corners in enumerate(_facets(dim, kind))]
        for name, on in numbered(side, names)
    }
    return Mesh(vertices, {kind: cells}, parts, sides)


def _as_meshio(nodes: NDArray[np.int32], kind: str) -> NDArray[np.int32]:
    """Return the nodes of dolfinx cells, sorted as in meshio."""
    order = AS_LATTICE.get(kind, [])
    return np.concatenate([nodes[:, order], nodes[:, len(order) :]], axis=1)


def _tag_of(tags, entities: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the tags of entities on this process, or 0 for entities without a tag."""
    found = np.zeros(entities.shape, dtype=np.int64)
    if tags is not None and len(tags.indices):
        at = np.minimum(np.searchsorted(tags.indices, entities), len(tags.indices) - 1)
        found = np.where(tags.indices[at] == entities, tags.values[at], 0)
    return found


def _facets(dim: int, kind: str) -> list[NDArray[np.int64]]:
    """Return the vertices of each facet of a cell, in dolfinx's order."""
    if KINDS[dim][kind] == dim + 1:
        return [np.delete(np.arange(dim + 1), k) for k in range(dim + 1)]
    return sorted(FACES[dim].tolist())
