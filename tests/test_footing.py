# SPDX-License-Identifier: MIT
"""A footing pushed into soil: its edge folds the domains that it holds, and it stays where it is."""

import numpy as np
import pytest
from helpers import SOFT

import mpm_dolfinx as mpm
from mpm_dolfinx.domains import corner_bits, tangled, volumes


@pytest.mark.parametrize("dim", [2, 3])
def test_a_held_domain_that_folds_keeps_its_face_and_its_volume(dim):
    """A face put elsewhere is pulled back, all at once: no step is small enough for that."""
    grid = mpm.Grid([1.0] * dim, [4] * dim)
    body = mpm.box(grid, [0] * dim, [1] * (dim - 1) + [0.5])
    held = mpm.Displacement("top", np.zeros(dim))
    s = mpm.Simulation(grid, [body], [SOFT], fixed={"bottom": "xyz"[:dim]}, displacements=[held])
    points, up = s.points, corner_bits(dim)[:, dim - 1] == 1
    at_top = np.flatnonzero((points.corners[:, up, -1] == 0.5).all(axis=1))
    inside = np.flatnonzero(points.corners[:, :, -1].max(axis=1) < 0.4)
    folded = np.array([at_top[3], inside[5]])
    points.F[folded] = np.diag([1.0] * (dim - 1) + [1.1])
    corners = points.corners.copy()
    points.corners[np.ix_(folded, ~up)] += 0.13 * np.eye(dim)[-1]  # above the upper ones
    assert tangled(points.corners[folded], points.volume0[folded]).all()

    assert s._untangle() == 2
    assert points.corners[folded[0], up] == pytest.approx(corners[folded[0], up], abs=1e-15)
    assert volumes(points.corners[folded]) == pytest.approx(1.1 * points.volume0[folded], rel=1e-12)
    rest = np.setdiff1d(np.arange(len(points)), folded)
    assert np.array_equal(points.corners[rest], corners[rest])
