# SPDX-License-Identifier: MIT
"""Bodies of boxes on a lattice store few numbers, and return the same domains as arrays."""

import tracemalloc
from dataclasses import replace

import meshio
import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.bodies.bodies import points_in_cells
from mpm_dolfinx.domains.lattice import Lattice
from mpm_dolfinx.points.cutting import FACES


def some(dim: int) -> mpm.Grid:
    return mpm.Grid(lower=[-0.2] * dim, upper=[1.0] * dim, cells=[6, 4, 5][:dim])


@pytest.mark.parametrize("dim", [2, 3])
def test_all_boxes_of_a_lattice_are_what_they_are_one_by_one(dim):
    body = mpm.box(some(dim), [-0.13] * dim, [0.7, 0.5, 0.9][:dim], per_cell=3)
    one_by_one = replace(body, filled=np.arange(len(body)))
    chosen = np.random.default_rng(1).permutation(len(body))[:7]
    for of in (lambda b: b.lower, lambda b: b.sides, lambda b: b.centre_of(chosen), lambda b: b.nodes(chosen)):
        assert (of(body) == of(one_by_one)).all()
    for of in (lambda b: b.bounds, lambda b: b.outer(), lambda b: b.named("top"), lambda b: b.named("left")):
        assert all((a == b).all() for a, b in zip(of(body), of(one_by_one), strict=True))
    assert body.lattice == one_by_one.lattice == body.count
    assert [body.across(a) for a in range(dim)] == [one_by_one.across(a) for a in range(dim)]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_shape_has_its_surface_where_no_neighbour_is(dim):
    rng = np.random.default_rng(dim)
    grid = some(dim)
    body = mpm.shape(grid, lambda x: rng.random(len(x)) < 0.6)
    corners = body.corners()
    faces = np.stack([corners[:, index].mean(axis=1) for index in FACES[dim]], axis=1)
    _, at, count = np.unique(np.rint(faces / 1e-6).reshape(-1, dim), axis=0, return_inverse=True, return_counts=True)
    assert (body.sides.reshape(len(body), 2 * dim) == (count == 1)[at.ravel()].reshape(len(body), -1)).all()
    row, face = body.outer()
    assert len(row) == (count == 1).sum() and body.sides.reshape(len(body), -1)[row, face].all()
    number, x = body.nodes(np.arange(len(body))).ravel(), np.rint(corners.reshape(-1, dim) / 1e-6)
    pairs = np.unique(np.column_stack([number, x]), axis=0)
    assert len(pairs) == len(np.unique(number)) == len(np.unique(x, axis=0)), "a number a place"


def test_what_is_known_of_a_large_body_as_seeded_takes_next_to_no_memory():
    """Earlier versions kept 34 bytes per point, and took up to 600 bytes per point to describe the body for a
    checkpoint.
    """
    grid = mpm.Grid([0, 0, 0], [1.0, 1.0, 1.0], [40, 40, 40])
    points_in_cells(grid, [])
    tracemalloc.start()
    try:
        body = mpm.box(grid, [0, 0, 0], [1, 1, 1])
        lattice = Lattice(body, 0, [], (np.array([0]), np.array([[0, 1, 2, 3]])))
        kept = tracemalloc.get_traced_memory()[0]
        points_in_cells(grid, [body])
        mpm.probes([body], [[0.5, 0.5, 0.5]])
        assert body.bounds[1] == pytest.approx(1.0)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(body) == 512000 and not lattice.held_of(np.arange(2))[0].any() and kept < 1e4 and peak < 25 * len(body)


def test_the_last_digit_of_coordinates_does_not_decide_how_many_rows_a_box_has():
    """5.5 cells with one point each: rounding gave 122 or 131 points of two boxes."""
    h = 0.3720326671282925
    for per_cell, rows in ((1, 6), (3, 16)):
        found = []
        for cells in (0, 4, 10000, -30000):
            grid = mpm.Grid([cells * h] * 2, [(7 + cells) * h] * 2, [7, 7])
            lower = np.array([0.7 + cells, 0.0 + cells]) * h
            found.append(len(mpm.box(grid, lower, lower + np.array([5.5, 1.0]) * h, per_cell=per_cell)))
        assert found == [rows * per_cell] * 4, found


@pytest.mark.parametrize("kind", ["box", "triangles", "quadrilaterals"])
def test_domains_share_the_digits_of_their_corners_far_from_the_origin(kind):
    """Gaps in the last digit interrupt lines of flow through layers. In an earlier version, a distant flow changed by
    1e-6.
    """
    grid = mpm.Grid(lower=[4.1e5, -9.3e5], upper=[4.1e5 + 2.1, -9.3e5 + 1.3], cells=[6, 4])
    if kind == "box":
        body = mpm.box(grid, grid.lower + 0.17, grid.upper - 0.13, per_cell=3)
    else:
        x = grid.lower + np.array([[0.1, 0.1], [1.9, 0.2], [1.7, 1.1], [0.3, 1.0], [1.07, 0.59]])
        cells = {"triangles": ("triangle", [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])}
        cells["quadrilaterals"] = ("quad", [[0, 1, 2, 3]])
        body = mpm.from_mesh(grid, meshio.Mesh(x, [cells[kind]]), per_cell=3)
    node, x = body.nodes(np.arange(len(body))).ravel(), body.corners().reshape(-1, 2)
    first, at = np.unique(node, return_index=True, return_inverse=True)[1:]
    assert (x == x[first][at]).all() and len(first) < len(node) / 2
