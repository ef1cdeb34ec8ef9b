# SPDX-License-Identifier: MIT
"""Cutting the domains keeps volumes, centroids and faces exactly."""

import numpy as np
import pytest

from mpm_dolfinx import Grid, box
from mpm_dolfinx.grid.grid import SNAP
from mpm_dolfinx.points import cutting
from mpm_dolfinx.points.cutting import corner_bits, cut

GRIDS = {2: Grid([0, 0], [1.0, 1.2], [5, 6]), 3: Grid([0, 0, 0], [1.0, 1.2, 0.8], [4, 4, 4])}


@pytest.fixture(params=[2, 3], ids=["2D", "3D"])
def grid(request):
    return GRIDS[request.param]


def domains(grid, distort):
    """Return domains that fill the box from 0.13 to 0.71, after a smooth motion."""
    body = box(grid, [0.13] * grid.dim, [0.71] * grid.dim)
    x = body.lower[:, None] + corner_bits(grid.dim) * body.spacing
    return x + distort * np.sin(3 * np.roll(x, 1, axis=2))


def simplices(corners):
    """Return the simplices (n, k, d+1, d) of domains, and their volumes, all positive."""
    s = np.moveaxis(cutting.vertices(np.moveaxis(corners, 0, 2)), 2, 0)[:, cutting.simplices(corners.shape[2])]
    return s, np.abs(np.linalg.det(s[:, :, 1:] - s[:, :, :1])) / (2, 6)[s.shape[3] - 2]


def test_pieces_of_undistorted_domains_are_the_boxes_that_they_share_with_the_cells(grid):
    corners = domains(grid, 0.0)
    p = cut(grid, corners)
    index = np.stack(np.unravel_index(p.cell, grid.shape), axis=1)
    low, high = np.maximum(corners[p.point, 0], index * grid.h), np.minimum(corners[p.point, -1], (index + 1) * grid.h)
    edge, whole = high - low, (corners[:, -1] - corners[:, 0])[p.point]
    assert edge.min() > 0 and np.bincount(p.point, edge.prod(axis=1)) == pytest.approx(whole[0].prod(), rel=1e-12)
    assert p.fraction == pytest.approx(edge.prod(axis=1) / whole.prod(axis=1), rel=1e-11)
    assert p.x == pytest.approx((low + high) / 2, rel=1e-12)
    for axis in range(grid.dim):
        section = edge.prod(axis=1) / edge[:, axis]
        within = np.stack([low, index * grid.h, high, (index + 1) * grid.h])[:, :, axis]
        is_open = np.abs(within[[0, 2]] - within[[1, 3]]).T < 1e-12
        assert p.faces[:, axis] == pytest.approx(section[:, None] * is_open, abs=1e-12)


def test_every_domain_has_pieces_and_their_centroids_lie_in_their_cells(grid):
    corners = domains(grid, 0.05)
    p = cut(grid, corners)
    assert np.bincount(p.point, p.fraction) == pytest.approx(np.ones(len(corners)), rel=1e-13)
    assert (grid.number(grid.index(p.x)) == p.cell).all()


def test_pieces_of_distorted_domains_have_the_exact_volume_and_centroid(grid):
    corners = domains(grid, 0.08)
    p = cut(grid, corners)
    s, volume = simplices(corners)
    whole, n = volume.sum(axis=1), int(np.prod(grid.shape))
    assert len(corners) < len(p.point)
    for a in range(grid.dim):
        centroid = (volume * s[..., a].mean(axis=2)).sum(axis=1) / whole
        assert np.bincount(p.point, p.fraction * p.x[:, a]) == pytest.approx(centroid, rel=1e-12)
    filled = np.bincount(p.cell, p.fraction * whole[p.point], minlength=n)
    assert filled.max() == pytest.approx(grid.cell_volume, rel=1e-12), "no cell is filled exactly"


def test_a_domain_about_to_fold_is_cut_as_the_sum_of_its_simplices(grid):
    """An inverted simplex counts as negative, because it lies in the domain's neighbours too."""
    corners = domains(grid, 0.0)[:1]
    low, size = corners[0, 0], corners[0, -1] - corners[0, 0]
    corners[0, 1] = low + np.array([0.2, 0.6, 0.7])[: grid.dim] * size  # across the diagonal
    p = cut(grid, corners)
    s, volume = simplices(corners)
    before, _ = simplices(domains(grid, 0.0)[:1])
    turned = np.linalg.det(s[:, :, 1:] - s[:, :, :1]) * np.linalg.det(before[:, :, 1:] - before[:, :, :1]) < 0
    assert turned.any() and not turned.all()
    volume[turned] *= -1
    total = volume[0].sum()
    moment = (volume[0, :, None] * s[0].mean(axis=1)).sum(axis=0)
    assert p.fraction @ p.x == pytest.approx(moment / total, rel=1e-12)
    n, cells = 20000, int(np.prod(grid.shape))
    within = np.random.default_rng(0).dirichlet(np.ones(grid.dim + 1), size=n) @ s[0]  # points of the simplices
    share = np.bincount(grid.number(grid.index(within.reshape(-1, grid.dim))), np.repeat(volume[0] / n, n), cells)
    assert np.bincount(p.cell, p.fraction, cells) == pytest.approx(share / total, abs=0.01)


def test_every_chunk_of_domains_is_cut_alike(grid, monkeypatch):
    corners = domains(grid, 0.05)
    whole = cut(grid, corners)
    monkeypatch.setattr("mpm_dolfinx.points.cutting.CHUNK", 5 * 2**grid.dim)
    parts = cut(grid, corners)
    assert all(
        (getattr(whole, name) == getattr(parts, name)).all() for name in ("point", "cell", "fraction", "x", "faces")
    )


def test_open_faces_agree_on_both_sides_and_are_whole_within_the_body(grid):
    p = cut(grid, domains(grid, 0.04))
    n = int(np.prod(grid.shape))
    for axis in range(grid.dim):
        area = grid.cell_volume / grid.h[axis]
        ends = [np.bincount(p.cell, p.faces[:, axis, end], minlength=n).reshape(grid.shape) for end in (0, 1)]
        lower, upper = (np.moveaxis(e, axis, 0) for e in ends)
        assert np.abs(lower[1:] - upper[:-1]).max() < 1e-12 * area
        within = tuple(grid.index(np.full(grid.dim, 0.45)))
        assert [upper.max(), ends[0][within], ends[1][within]] == pytest.approx([area] * 3, rel=1e-12)


@pytest.mark.parametrize("gap", [0.0, 0.5, 1.0, 1.5, 2.0, 5.0])
@pytest.mark.parametrize("rounding", [-1e-5, 0.0, 1e-5])
def test_the_face_between_two_domains_is_open_however_near_it_is_to_a_grid_plane(grid, gap, rounding):
    """If two domains meet at the distance where vertices are snapped, rounding may snap only one of them."""
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
    lengths = np.diff(np.clip(np.arange(grid.shape[0] + 1) * grid.h[0], 0.21, 0.98))
    assert len(p.cell) == len(np.unique(p.cell)) == 4
    assert p.fraction == pytest.approx(lengths[lengths > 0] / 0.77, rel=1e-12)


@pytest.mark.parametrize(("overhang", "count"), [(0.0, lambda d: 1), (5e-11, lambda d: 1), (2e-10, lambda d: 1 + d)])
def test_what_a_domain_has_beyond_a_grid_line_is_a_piece_if_it_is_thicker_than_the_snap_and_no_sliver(
    grid, overhang, count
):
    """A part beyond one line is a piece. A part beyond two lines is smaller than 1e-12 of the domain."""
    corners = grid.h * (1 + corner_bits(grid.dim) * (1 + overhang))
    assert len(cut(grid, corners[None]).point) == count(grid.dim)


@pytest.mark.parametrize("below", [0.0, 2e-11])
def test_a_domain_that_is_thinner_than_the_snap_and_lies_along_a_plane_keeps_all_of_its_pieces(grid, below):
    size = np.array([2.5, *[1.0] * (grid.dim - 2), 5e-11])
    corners = grid.h * (np.ones(grid.dim) + corner_bits(grid.dim) * size)
    corners[:, -1] -= below * grid.h[-1]
    p = cut(grid, corners[None])
    index = np.stack(np.unravel_index(p.cell, grid.shape), axis=1)
    assert np.bincount(index[:, 0], p.fraction)[1:] == pytest.approx([0.4, 0.4, 0.2], rel=1e-5)
    assert np.bincount(index[:, -1], p.fraction)[1] == pytest.approx(1 - below / 5e-11, rel=1e-5)
