# SPDX-License-Identifier: MIT
"""Reader of gmsh files of format 4.1, with all physical groups of each entity.

The reader of meshio keeps only the first group of an entity, and fails for entities without a group.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.mesh_cells import Block

TYPES = {
    **{1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8), 6: ("wedge", 6)},
    **{7: ("pyramid", 5), 8: ("line3", 3), 9: ("triangle6", 6), 10: ("quad9", 9), 11: ("tetra10", 10)},
    **{12: ("hexahedron27", 27), 13: ("wedge18", 18), 14: ("pyramid14", 14), 15: ("vertex", 1), 16: ("quad8", 8)},
    **{17: ("hexahedron20", 20), 18: ("wedge15", 15), 19: ("pyramid13", 13)},
}
"""Name in meshio and number of nodes of each gmsh element type.  The nodes of elements are in gmsh's order."""


class _Numbers:
    """Sequential reader of the numbers in a section."""

    def __init__(self, section: bytes, binary: bool):
        self._binary = binary
        self._bytes, self._words = BytesIO(section), iter(() if binary else section.split())

    def take(self, count: int, kind: str = "i") -> NDArray:
        """Return the next `count` numbers, of the type int ("i"), size_t ("u") or double ("d")."""
        dtype, out = np.dtype({"i": "<i4", "u": "<u8", "d": "<f8"}[kind]), float if kind == "d" else np.int64
        if self._binary:
            return np.frombuffer(self._bytes.read(count * dtype.itemsize), dtype).astype(out)
        return np.array(list(islice(self._words, count))).astype(out)


def version(file: Path) -> str:
    """Return the version of a file in gmsh's format, or "" for files in other formats."""
    if not file.is_file():
        return ""
    with file.open("rb") as opened:
        found = re.search(rb"\$MeshFormat\s+(\d+(?:\.\d+)?)\s", opened.read(2**14))
    return found[1].decode() if found else ""


def read(file: Path) -> meshio.Mesh:
    """Return the mesh of a file of format 4.1.  `cell_sets` contains cells by tag, `field_data` tags by group name."""
    data = file.read_bytes()
    _, kind, size = _section(data, "MeshFormat").split()[:3]
    binary = kind == b"1"
    if binary and b"\n\x01\0\0\0" not in _section(data, "MeshFormat"):
        raise ValueError("the byte order of the binary file is not that of this machine, must be the same")
    if binary and size != b"8":
        raise ValueError(f"the binary file has numbers of {size.decode()} bytes, must be 8")
    groups = dict(_groups(_Numbers(_section(data, "Entities"), binary))) if b"$Entities" in data else {}
    if b"$PartitionedEntities" in data:
        raise ValueError("the mesh is partitioned, must be whole; set Mesh.PartitionCreateTopology = 0 in gmsh")
    numbers, x = _nodes(_Numbers(_section(data, "Nodes"), binary))
    order = np.argsort(numbers)
    cells, of = [], []
    for dim, entity, name, rows in _elements(_Numbers(_section(data, "Elements"), binary)):
        at = np.minimum(np.searchsorted(numbers[order], rows), len(order) - 1)
        if (numbers[order][at] != rows).any():
            raise ValueError(f"an element has node {rows[numbers[order][at] != rows][0]}, must be a node of the file")
        cells.append((name, order[at]))
        of.append(groups.get((dim, entity), []))
    tags = sorted({tag for found in of for tag in found})
    sets = {
        str(tag): [np.arange(len(rows) if tag in found else 0) for (_, rows), found in zip(cells, of, strict=True)]
        for tag in tags
    }
    mesh = meshio.Mesh(x, [], cell_sets=sets, field_data=_names(data))
    mesh.cells = [Block(*block) for block in cells]
    return mesh


def _section(data: bytes, name: str) -> bytes:
    """Return the bytes between the first and the last line of a section."""
    found = re.search(rb"\$%b[ \r]*\n(.*?)\s?\$End%b" % (name.encode(), name.encode()), data, re.DOTALL)
    if not found:
        raise ValueError(f"section ${name} is missing, must be in the file")
    return found[1]


def _names(data: bytes) -> dict[str, NDArray[np.int64]]:
    """Return the tags and dimensions of all physical groups, by name."""
    out: dict[str, list[tuple[int, int]]] = {}
    if b"$PhysicalNames" in data:
        for line in _section(data, "PhysicalNames").decode(errors="replace").splitlines()[1:]:
            dim, tag, name = shlex.split(line)
            out.setdefault(name, []).append((int(tag), int(dim)))
    return {name: np.array(pairs) for name, pairs in out.items()}


def _groups(numbers: _Numbers) -> Iterator[tuple[tuple[int, int], list[int]]]:
    """Yield each entity with the tags of its physical groups."""
    for dim, count in enumerate(numbers.take(4, "u")):
        for _ in range(count):
            (tag,) = numbers.take(1)
            numbers.take(6 if dim else 3, "d")
            (many,) = numbers.take(1, "u")
            yield (dim, int(tag)), np.abs(numbers.take(int(many))).tolist()
            if dim:
                (many,) = numbers.take(1, "u")
                numbers.take(int(many))


def _nodes(numbers: _Numbers) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the tags of the nodes, and their positions in m."""
    tags, x = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for _ in range(numbers.take(4, "u")[0]):
        dim, _, parametric = numbers.take(3)
        count = int(numbers.take(1, "u")[0])
        width = 3 + (int(dim) if parametric else 0)
        tags.append(numbers.take(count, "u"))
        x.append(numbers.take(count * width, "d").reshape(count, width)[:, :3])
    return np.concatenate(tags), np.concatenate(x)


def _elements(numbers: _Numbers) -> Iterator[tuple[int, int, str, NDArray[np.int64]]]:
    """Yield the dimension, tag, cell type and element nodes of each entity."""
    for _ in range(numbers.take(4, "u")[0]):
        dim, entity, kind = map(int, numbers.take(3))
        if kind not in TYPES:
            raise ValueError(f"elements have gmsh's type {kind}, must be of first or second order")
        (name, width), count = TYPES[kind], int(numbers.take(1, "u")[0])
        yield dim, entity, name, numbers.take(count * (1 + width), "u").reshape(count, 1 + width)[:, 1:]
