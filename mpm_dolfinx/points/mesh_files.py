# SPDX-License-Identifier: MIT
"""Meshes of others as bodies: files and objects of meshio, meshes of dolfinx with their tags."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from typing import Any

import meshio
import numpy as np
from dolfinx import mesh as dolfinx_mesh
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.parallel.exchange import at_root
from mpm_dolfinx.points.cutting import FACES
from mpm_dolfinx.points.grid import Grid
from mpm_dolfinx.points.meshes import FACETS, KINDS, Mesh, MeshBody, seeded
from mpm_dolfinx.validation import instance, line, line_of, path

TAGS = ("gmsh:physical", "medit:ref", "cell_tags")
"""Data of meshio's cells that number parts and sides."""
FLAT = 1e-9  # of the size of a mesh in the plane: how far its vertices may lie off it
AS_LATTICE = {"quad": [0, 1, 3, 2], "hexahedron": [0, 1, 3, 2, 4, 5, 7, 6]}
"""Vertices of meshio's cells with the first axis fastest."""


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
    """Seed a body from a mesh: its cells are the points' domains; return the body.

    Sides have the names of the mesh's facets: gmsh's physical groups of lines in 2D, of surfaces in 3D, or facet tags.
    A body of each part of a mesh shares its inner faces with those of the others: no surface is between them while both
    are there.  Reference positions are those of the mesh.  Its points lie on no lattice, along which waves that no node
    sees would be filtered.

    Parameters
    ----------
    grid
        Background grid.
    mesh
        A file that meshio reads, a meshio mesh, or a dolfinx mesh: of triangles and quadrilaterals in 2D, of tetrahedra
        and hexahedra in 3D, of first order.  In 2D the vertices' third coordinate is the same for all.
    part
        Name of a group of cells, such as a physical group; by default all cells.
    cell_tags, facet_tags
        Of a dolfinx mesh.
    names
        Numbers of tags by the names that they get; others without a name are called by their digits, such as "3".
    per_cell
        Points per cell of the grid and direction that are wanted, >= 1: domains with an edge of more than 1.5 cells /
        per_cell are split.
    material
        Index of the material in the scene's list, >= 0.

    Raises
    ------
    ValueError
        A file that is not there or cannot be read, another kind of mesh, unknown parts, cells that are flat, inside out
        or not convex, vertices outside the grid, hanging or doubled nodes.
    """
    instance("body: grid", grid, Grid)
    name, names = "mesh", _numbers(names)
    if isinstance(mesh, (str, os.PathLike)):
        name, file = f"mesh {os.fspath(mesh)}", path("mesh", mesh)
        mesh = at_root(grid.comm, lambda: _file(file))
    if isinstance(mesh, meshio.Mesh):
        if cell_tags is not None or facet_tags is not None:
            raise ValueError("mesh: cell_tags and facet_tags must be of a dolfinx mesh; a meshio mesh has its own")
        found = _of_meshio(grid.dim, mesh, names)
    else:
        instance("mesh", mesh, dolfinx_mesh.Mesh)
        found = _of_dolfinx(grid.dim, mesh, cell_tags, facet_tags, names)
    return seeded(grid, found, part, per_cell, material, name)


def _file(file) -> meshio.Mesh:
    """Return the mesh of a file; what meshio prints of it is kept for the message."""
    said = StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            return meshio.read(file)
    except (Exception, SystemExit) as error:  # meshio ends the program where it cannot read a file
        why = line_of(error) if isinstance(error, Exception) else " ".join(said.getvalue().split())
        raise ValueError(f"mesh {file}: {why}; must be a file that meshio reads") from None


def _of_meshio(dim: int, mesh: meshio.Mesh, names: Mapping[str, int]) -> Mesh:
    """Return a mesh of meshio's."""
    blocks = [(block.type, np.asarray(block.data, dtype=np.int64)) for block in mesh.cells]
    allowed = [*KINDS[dim], *FACETS[dim], "vertex", "line"]
    for kind, _ in blocks:
        if kind not in allowed:
            raise ValueError(f"mesh: has cells {kind!r}, must be of {' and '.join(KINDS[dim])} for a grid in {dim}D")
    cells = {kind: [np.empty((0, count), np.int64)] for kind, count in KINDS[dim].items()}
    parts, sides = {}, {}
    for i, (kind, rows) in enumerate(blocks):
        inner, facet = kind in KINDS[dim], kind in FACETS[dim]
        found = dict(_groups(mesh, i, len(rows), dim if inner else dim - 1, names)) if inner or facet else {}
        for name, chosen in found.items():
            if inner:
                start = sum(map(len, cells[kind]))
                parts.setdefault(name, {k: [] for k in cells})[kind].append(start + np.flatnonzero(chosen))
            else:
                sides.setdefault(name, []).append(rows[chosen])
        if inner:
            cells[kind].append(rows[:, AS_LATTICE.get(kind, slice(None))])
    parts = {
        name: {kind: np.concatenate([np.empty(0, np.int64), *rows]) for kind, rows in found.items()}
        for name, found in parts.items()
    }
    cells = {kind: np.concatenate(rows) for kind, rows in cells.items()}
    return Mesh(_plane(dim, np.asarray(mesh.points, dtype=float)), cells, parts, sides)


def _groups(
    mesh: meshio.Mesh, block: int, count: int, dim: int, names: Mapping[str, int]
) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield names of groups, and which cells (count,) of a block of meshio's belong to them."""
    known = {name: int(tag) for name, (tag, d) in _pairs(mesh.field_data) if d == dim}
    for key in TAGS:
        if key in mesh.cell_data:
            yield from numbered(np.asarray(mesh.cell_data[key][block]), {**known, **names})
    for name, rows in mesh.cell_sets.items():
        if rows[block] is not None and len(rows[block]) and not name.startswith("gmsh:"):
            yield name, np.isin(np.arange(count), rows[block])


def _pairs(field_data: Mapping[str, Any]) -> Iterator[tuple[str, NDArray]]:
    """Yield the names of gmsh's physical groups with their numbers and dimensions."""
    for name, value in field_data.items():
        if np.shape(value) == (2,):
            yield name, value


def _numbers(names: Mapping[str, int] | None) -> Mapping[str, int]:
    """Return the numbers of tags by names that a user gives, if any."""
    whole = (int, np.integer)
    if names is not None and not (
        isinstance(names, Mapping) and all(isinstance(k, str) and isinstance(v, whole) for k, v in names.items())
    ):
        raise ValueError(f"mesh: names = {line(names)}, must be numbers of tags by names, such as {{'top': 3}}")
    return names or {}


def numbered(tags: NDArray[np.int64], names: Mapping[str, int]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield names, and which of some tags (n,) they stand for; tags without a name are called by their digits."""
    for name, number in names.items():
        if (tags == number).any():
            yield name, tags == number
    for number in np.setdiff1d(tags, list(names.values())).tolist():
        if number:  # 0 is no group
            yield str(number), tags == number


def _plane(dim: int, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the first coordinates (nodes, dim) of vertices (nodes, 2 or 3); refuse what leaves the plane."""
    if x.shape[1] < dim:
        raise ValueError(f"mesh: its vertices have {x.shape[1]} coordinates, must have the grid's {dim}")
    if len(x) and x.shape[1] > dim and np.ptp(x[:, 2]) > FLAT * np.ptp(x[:, :2]):
        low, high = x[:, 2].min(), x[:, 2].max()
        raise ValueError(f"mesh: a surface in space, z from {low:.3g} to {high:.3g}, must be flat in 2D")
    return x[:, :dim]


def _of_dolfinx(dim: int, mesh, cell_tags, facet_tags, names: Mapping[str, int]) -> Mesh:
    """Return a dolfinx mesh, whole on every process; cells are ordered by their places, however they are shared out."""
    topology, kind = mesh.topology, _compat.cell_kind(mesh)
    kind = {"quadrilateral": "quad", "tetrahedron": "tetra"}.get(kind, kind)
    if topology.dim != dim or kind not in KINDS[dim]:
        raise ValueError(f"mesh: has cells {kind!r}, must be of {' or '.join(KINDS[dim])} for a grid in {dim}D")
    for name, tags, of in (("cell_tags", cell_tags, dim), ("facet_tags", facet_tags, dim - 1)):
        if tags is not None and getattr(tags, "dim", None) != of:
            raise ValueError(f"mesh: {name} = {line(tags)}, must be tags of entities of dimension {of}")
    owned, _ = _compat.num_cells(mesh)
    dofs = _compat.geometry_dofs(mesh)[:owned]
    if dofs.shape[1] != KINDS[dim][kind]:
        raise ValueError(f"mesh: its cells have {dofs.shape[1]} nodes, must have {KINDS[dim][kind]}: of first order")
    topology.create_connectivity(dim, dim - 1)
    facets = topology.connectivity(dim, dim - 1).array.reshape(-1, len(_facets(dim, kind)))[:owned]
    nodes = mesh.geometry.index_map().local_to_global(np.arange(len(mesh.geometry.x), dtype=np.int32))
    rows = mesh.comm.allgather(
        (nodes, mesh.geometry.x, nodes[dofs], _tag_of(cell_tags, np.arange(owned)), _tag_of(facet_tags, facets))
    )
    number, x, cells, tag, side = map(np.concatenate, zip(*rows, strict=True))
    vertices = np.empty((number.max(initial=-1) + 1, 3))
    vertices[number] = x
    vertices = _plane(dim, vertices)
    order = np.lexsort(vertices[cells].mean(axis=1).T)
    cells, tag, side = cells[order], tag[order], side[order]
    parts = {name: {kind: np.flatnonzero(rows)} for name, rows in numbered(tag, names)}
    sides = {
        name: [cells[on[:, k]][:, corners] for k, corners in enumerate(_facets(dim, kind))]
        for name, on in numbered(side, names)
    }
    return Mesh(vertices, {kind: cells}, parts, sides)


def _tag_of(tags, entities: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the tags of entities of this process, 0 of those without one."""
    found = np.zeros(entities.shape, dtype=np.int64)
    if tags is not None and len(tags.indices):
        at = np.minimum(np.searchsorted(tags.indices, entities), len(tags.indices) - 1)
        found = np.where(tags.indices[at] == entities, tags.values[at], 0)
    return found


def _facets(dim: int, kind: str) -> list[NDArray[np.int64]]:
    """Return the vertices of each facet of a cell, as dolfinx orders them."""
    if KINDS[dim][kind] == dim + 1:
        return [np.delete(np.arange(dim + 1), k) for k in range(dim + 1)]
    return sorted(FACES[dim].tolist())
