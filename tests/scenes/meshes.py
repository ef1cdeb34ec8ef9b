# SPDX-License-Identifier: MIT
"""Meshes of blocks with uneven inner nodes, in any frame and order."""

from __future__ import annotations

from itertools import permutations

import meshio
import numpy as np

from mpm_dolfinx.grid.grid import SIDES
from mpm_dolfinx.points.cutting import FACES, corner_bits
from scenes.description import Block, Scene
from scenes.frames import Frame

IN_ORDER = {4: [0, 1, 3, 2], 8: [0, 1, 3, 2, 4, 5, 7, 6]}


def mesh_of(scene: Scene, block: Block, frame: Frame, shuffle: np.random.Generator | None) -> meshio.Mesh:
    """Return a block's mesh; its sides have the names of a box in the frame."""
    d = scene.dim
    lower, upper = np.array(block.lower), np.array(block.upper)
    count = np.maximum(1, np.rint((upper - lower) / scene.h * block.per_cell * (0.75 if d == 2 else 0.6))).astype(int)
    index = np.stack(np.unravel_index(np.arange(np.prod(count + 1)), count + 1), axis=1)
    inner = ((index > 0) & (index < count)).all(axis=1)
    off = np.random.default_rng(block.seed).uniform(-1, 1, index.shape) * inner[:, None] * block.uneven
    x = frame.place(lower + (index + off) * (upper - lower) / count, scene)
    cell = np.stack(np.unravel_index(np.arange(np.prod(count)), count), axis=1)
    nodes = np.ravel_multi_index(tuple(np.moveaxis(cell[:, None] + corner_bits(d), 2, 0)), tuple(count + 1))
    blocks, sets = [], {}
    for name, (axis, end) in SIDES[d].items():
        on = nodes[cell[:, axis] == end * (count[axis] - 1)][:, FACES[d][2 * axis + end]]
        sets[frame.side(name)] = len(blocks)
        blocks.append(("line" if d == 2 else "quad", on if d == 2 else on[:, IN_ORDER[4]]))
    if block.kind == "triangle":
        simplices = [[sum(1 << a for a in p[:k]) for k in range(d + 1)] for p in permutations(range(d))]
        cells = nodes[:, simplices].reshape(-1, d + 1)
        other = np.repeat(cell.sum(axis=1) % 2 == 1, 2)
        cells[other] = nodes[:, [[0, 1, 2], [1, 2, 3]]].reshape(-1, 3)[other]
    else:
        cells = nodes[:, IN_ORDER[2**d]]
    if shuffle is not None:
        cells = shuffle.permutation(cells)
        number = shuffle.permutation(len(x))
        x, cells = x[np.argsort(number)], number[cells]
        blocks = [(kind, number[rows]) for kind, rows in blocks]
    blocks.append((block.kind, cells))
    names = {n: [np.arange(len(b)) if i == at else [] for i, (_, b) in enumerate(blocks)] for n, at in sets.items()}
    return meshio.Mesh(np.pad(x, ((0, 0), (0, 3 - d))), blocks, cell_sets=names)
