# SPDX-License-Identifier: MIT
"""Cell types of meshes: their facets, and their division into particle domains.

A triangle is divided into three quadrilaterals, and a tetrahedron into four hexahedra.  Each of these domains has a
vertex of the cell as a corner.  The other corners of the domain are midpoints of edges, facets and the cell.  A wedge
is divided like an extruded triangle, and a pyramid like two tetrahedra.  Quadrilaterals and hexahedra are not divided.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import FACES, corner_bits

KINDS = {2: {"triangle": 3, "quad": 4}, 3: {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5}}
"""Types of cells that become particle domains, and their numbers of vertices."""
SIDES_OF = {2: {"line": 2}, 3: {"triangle": 3, "quad": 4}}
"""Types of the facets that form sides, and their numbers of vertices."""
AS_LATTICE = {"quad": [0, 1, 3, 2], "hexahedron": [0, 1, 3, 2, 4, 5, 7, 6]}
"""Permutation of meshio's vertices to tensor-product order, in which the first axis varies fastest."""
SECOND_ORDER = {
    **{"line3": "line", "triangle6": "triangle", "triangle7": "triangle", "quad8": "quad", "quad9": "quad"},
    **{"tetra10": "tetra", "hexahedron20": "hexahedron", "hexahedron24": "hexahedron", "hexahedron27": "hexahedron"},
    **{"wedge12": "wedge", "wedge15": "wedge", "wedge18": "wedge", "pyramid13": "pyramid", "pyramid14": "pyramid"},
}
"""First-order type of each second-order cell type.  Second-order cells list their vertices first."""
LOOPS = {
    "line": [(0, 1)],
    "triangle": [(0, 1), (1, 2), (2, 0)],
    "quad": [(0, 1), (1, 3), (3, 2), (2, 0)],
    "tetra": [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)],
    "hexahedron": [(a, b, d, c) for a, b, c, d in FACES[3].tolist()],
    "wedge": [(0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)],
    "pyramid": [(0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)],
}
"""Vertices around each facet of a cell type.  Quadrilaterals and hexahedra have tensor-product order."""


class Block(NamedTuple):
    """Cells of one type: name of the type, and nodes (n, k)."""

    type: str
    data: NDArray[np.int64]


def edges(kind: str) -> list[tuple[int, int]]:
    """Return the vertices of each edge of a cell type."""
    around = [pair for loop in LOOPS[kind] for pair in zip(loop, (*loop[1:], loop[0]), strict=True)]
    return sorted({tuple(sorted(pair)) for pair in around})


def distinct(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Group equal rows of an array (n, k).  Return the index of the first row of each group, and the group of each row.

    The groups are sorted by the values of their rows.
    """
    order = np.lexsort(rows.T[::-1])
    new = np.append(True, (np.diff(rows[order], axis=0) != 0).any(axis=1))[: len(rows)]
    which = np.empty(len(rows), dtype=np.int64)
    which[order] = np.cumsum(new) - 1
    return order[new], which


@dataclass(frozen=True)
class Part:
    """A particle domain that is a part of a mesh cell."""

    corners: tuple[tuple[int, ...], ...]  # (2^d,): each corner is the mean of these vertices
    faces: tuple[tuple[int, ...], ...]  # (2d,): vertices of the facet that contains the face; () inside the cell


def _of_simplices(kind: str, *simplices: tuple[int, ...]) -> list[Part]:
    """Return the particle domains of a cell that is a union of simplices."""
    d, out = len(simplices[0]) - 1, []
    bits = corner_bits(d)
    for simplex in simplices:
        for v in simplex:
            others = [w for w in simplex if w != v]
            faces = [()] * (2 * d)
            for axis in range(d):
                of = {*simplex} - {others[axis]}
                faces[2 * axis] = next((loop for loop in LOOPS[kind] if of <= {*loop}), ())
            corners = [(v, *(w for w, bit in zip(others, row, strict=True) if bit)) for row in bits]
            out.append(Part(tuple(corners), tuple(faces)))
    return out


def _wedge() -> list[Part]:
    """Return the particle domains of a wedge."""
    out, quads = [], LOOPS["wedge"][2:]
    for part in _of_simplices("triangle", (0, 1, 2)):
        corners = [tuple(v + end for v in of) for end in (0, 3) for of in part.corners]
        sides = [next((loop for loop in quads if of and {*of} <= {*loop}), ()) for of in part.faces]
        out.append(Part(tuple(corners), (*sides, *LOOPS["wedge"][:2])))
    return out


def _whole(dim: int) -> list[Part]:
    """Return the particle domain of a quadrilateral or hexahedron: the whole cell."""
    return [Part(tuple((k,) for k in range(2**dim)), tuple(map(tuple, FACES[dim].tolist())))]


PARTS = {
    "triangle": _of_simplices("triangle", (0, 1, 2)),
    "quad": _whole(2),
    "tetra": _of_simplices("tetra", (0, 1, 2, 3)),
    "hexahedron": _whole(3),
    "wedge": _wedge(),
    "pyramid": _of_simplices("pyramid", (0, 1, 2, 4), (0, 2, 3, 4)),
}
