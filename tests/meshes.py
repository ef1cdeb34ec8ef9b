# SPDX-License-Identifier: MIT
"""Boxes as meshes of meshio, with the side names of `box`."""

from itertools import permutations

import meshio
import numpy as np

from mpm_dolfinx.grid.grid import SIDES
from mpm_dolfinx.points.cutting import FACES, corner_bits

IN_ORDER = {4: [0, 1, 3, 2], 8: [0, 1, 3, 2, 4, 5, 7, 6]}


def box_mesh(kind, cells, lower, upper, parts=None, place=None):
    """Return a box as a mesh of one kind of cells. `parts`: functions of the cell centres, by name."""
    dim = len(cells)
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(lower, upper, cells, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    index = np.stack(np.unravel_index(np.arange(np.prod(cells)), cells), axis=1)
    bits = corner_bits(dim)
    nodes = np.ravel_multi_index(tuple(np.moveaxis(index[:, None] + bits, 2, 0)), tuple(np.add(cells, 1)))
    simplices = [[sum(1 << a for a in p[:k]) for k in range(dim + 1)] for p in permutations(range(dim))]
    blocks, sets = [], {}
    facet, facet_splits = ("line", [[0, 1]]) if dim == 2 else ("quad", [IN_ORDER[4]])
    if kind == "tetra":
        facet, facet_splits = "triangle", [[0, 1, 3], [0, 2, 3]]
    for name, (axis, end) in SIDES[dim].items():
        on = nodes[index[:, axis] == end * (cells[axis] - 1)][:, FACES[dim][2 * axis + end]]
        sets[name] = len(blocks)
        blocks.append((facet, np.concatenate([on[:, split] for split in facet_splits])))
    if kind in ("quad", "hexahedron"):
        body = nodes[:, IN_ORDER[2**dim]]
    elif kind == "wedge":  # the tops and bottoms are the last two sides
        body = nodes[:, [[0, 1, 3, 4, 5, 7], [0, 3, 2, 4, 7, 6]]].reshape(-1, 6)
        blocks[4:] = [("triangle", on[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)) for _, on in blocks[4:]]
    elif kind == "pyramid":
        tips = np.repeat(len(x) + np.arange(len(nodes)), 6)[:, None]
        body = np.concatenate([nodes[:, FACES[3][:, IN_ORDER[4]]].reshape(-1, 4), tips], axis=1)
        x = np.concatenate([x, x[nodes].mean(axis=1)])
    else:
        body = nodes[:, simplices].reshape(-1, dim + 1)
    if kind == "triangle":  # every other cell is cut the other way
        other = np.repeat(index.sum(axis=1) % 2 == 1, 2)
        body[other] = nodes[:, [[0, 1, 2], [1, 2, 3]]].reshape(-1, 3)[other]
    middle = x[body].mean(axis=1)
    blocks.append((kind, body))
    sets = {
        name: [np.arange(len(b)) if i == at else [] for i, (_, b) in enumerate(blocks)] for name, at in sets.items()
    }
    for name, inside in (parts or {}).items():
        sets[name] = [[] for _ in blocks[:-1]] + [np.flatnonzero(inside(middle))]
    x = x if place is None else place(x)
    return meshio.Mesh(np.pad(x, ((0, 0), (0, 3 - dim))), blocks, cell_sets=sets)
