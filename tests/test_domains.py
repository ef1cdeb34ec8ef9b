# SPDX-License-Identifier: MIT
"""Cutting the domains keeps volumes, centroids and faces exactly."""

import numpy as np
import pytest

from mpm_dolfinx import Grid, box
from mpm_dolfinx.domains import SNAP, corner_bits, cut

GRIDS = {2: Grid([1.0, 1.2], [5, 6]), 3: Grid([1.0, 1.2, 0.8], [4, 3, 4])}


@pytest.fixture(params=[2, 3], ids=["2D", "3D"])
def grid(request):
    return GRIDS[request.param]


def domains(grid, distort):
    """Domains that fill the box from 0.13 to 0.71, moved by a smooth map."""
    body = box(grid, [0.13] * grid.dim, [0.71] * grid.dim)
    x = body.lower[:, None] + corner_bits(grid.dim) * body.spacing
    return x + distort * np.sin(3 * np.roll(x, 1, axis=2))


def volume2d(c):
    a, b = c[:, 3] - c[:, 0], c[:, 2] - c[:, 1]
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def test_pieces_of_undistorted_domains_fill_the_body(grid):
    corners = domains(grid, 0.0)
    p = cut(grid, corners)
    size = (corners[:, -1] - corners[:, 0]).prod(axis=1)
    assert p.fraction @ size[p.point] == pytest.approx(0.58**grid.dim, rel=1e-13)
    moment = (p.fraction * size[p.point]) @ p.x
    assert moment == pytest.approx(np.full(grid.dim, 0.42 * 0.58**grid.dim), rel=1e-12)


def test_fractions_sum_to_one_and_centroids_lie_in_their_cells(grid):
    corners = domains(grid, 0.05)
    p = cut(grid, corners)
    assert np.bincount(p.point, p.fraction) == pytest.approx(np.ones(len(corners)), rel=1e-13)
    assert (grid.number(grid.index(p.x)) == p.cell).all()


def test_pieces_of_distorted_quadrilaterals_have_the_exact_area_and_centroid():
    grid = GRIDS[2]
    corners = domains(grid, 0.08)
    p = cut(grid, corners)
    whole = cut(Grid([1.0, 1.2], [1, 1]), corners)  # one cell: nothing is cut
    assert len(whole.point) == len(corners) < len(p.point)
    area = volume2d(corners)
    for a in range(2):
        assert np.bincount(p.point, p.fraction * p.x[:, a]) == pytest.approx(whole.x[:, a], rel=1e-12)
    inside = np.bincount(p.cell, p.fraction * area[p.point], minlength=30)
    assert inside.max() == pytest.approx(grid.cell_volume, rel=1e-12), "no cell is filled exactly"


def test_open_faces_agree_on_both_sides_and_are_whole_within_the_body(grid):
    p = cut(grid, domains(grid, 0.04))
    n = int(np.prod(grid.shape))
    for axis in range(grid.dim):
        area = grid.cell_volume / grid.h[axis]
        ends = [np.bincount(p.cell, p.faces[:, axis, end], minlength=n).reshape(grid.shape) for end in (0, 1)]
        lower, upper = (np.moveaxis(e, axis, 0) for e in ends)
        assert np.abs(lower[1:] - upper[:-1]).max() < 1e-9 * area
        assert upper.max() <= area * (1 + 1e-12)
    if grid.dim == 2:  # cell (2, 2) lies within the body
        assert lower[2, 2] == pytest.approx(area) == upper[2, 2]


@pytest.mark.parametrize("gap", [0.0, 0.5, 1.0, 1.5, 2.0, 5.0])
@pytest.mark.parametrize("rounding", [-1e-5, 0.0, 1e-5])
def test_the_face_between_two_domains_is_open_however_near_it_is_to_a_grid_plane(grid, gap, rounding):
    """Of two domains that meet where vertices begin to be snapped, rounding may snap one only."""
    low, high = np.zeros(grid.dim), 2 * grid.h
    corners = low + corner_bits(grid.dim) * grid.h + np.zeros((2, 1, grid.dim))
    upper = corner_bits(grid.dim)[:, -1] == 1
    corners[0, upper, -1] = grid.h[-1] * (1 - SNAP * (gap + rounding))
    corners[1, ~upper, -1], corners[1, upper, -1] = grid.h[-1] * (1 - SNAP * (gap - rounding)), high[-1]
    p = cut(grid, corners)
    axis, whole = grid.dim - 1, grid.cell_volume / grid.h[-1]
    index = np.stack(np.unravel_index(p.cell, grid.shape), axis=1)
    below, above = index[:, axis] == 0, index[:, axis] == 1
    assert p.faces[below, axis, 1].sum() >= whole * (1 - 1e-8)
    assert p.faces[above, axis, 0].sum() == pytest.approx(whole, rel=1e-8)


def test_a_domain_many_cells_long_is_cut_into_all_of_them(grid):
    corners = np.full(grid.dim, 0.21) + corner_bits(grid.dim) * (np.array([0.77, 0.01, 0.01])[: grid.dim])
    p = cut(grid, corners[None])
    assert len(p.cell) == len(np.unique(p.cell)) == 4 if grid.dim == 2 else 4
    assert p.fraction.sum() == pytest.approx(1)


def test_a_domain_on_grid_lines_is_one_piece(grid):
    corners = grid.h + corner_bits(grid.dim) * grid.h * (1 + 1e-12)
    assert len(cut(grid, corners[None]).point) == 1
