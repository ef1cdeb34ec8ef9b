# SPDX-License-Identifier: MIT
"""Positions of points: centroids of their domains, at which all of their data are evaluated."""

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.points.cutting import centroids, cut


def irregular(X):
    """Return positions (n, 3), in m, moved within the unit square or cube by up to a third of a domain; its outline is
    fixed.
    """
    X = np.asarray(X, dtype=float)
    wave = np.prod([4 * X[:, a] * (1 - X[:, a]) for a in range(X.shape[1]) if np.ptp(X[:, a])], axis=0)
    shifts = [np.sin(37 * X @ np.arange(1, X.shape[1] + 1) + k) for k in range(X.shape[1])]
    return X + 0.03 * wave[:, None] * np.stack(shifts, axis=1) * (np.ptp(X, axis=0) > 0)


def at_rest(dim, **options):
    """Return a cube of irregular domains in water at rest, with two or four cells and a fraction over its edge."""
    grid = mpm.Grid([0] * dim, [1.2] * dim, [5 if dim == 2 else 3] * dim, **options)
    body = mpm.mapped(grid, mpm.box(grid, [0.0] * dim, [1.0] * dim), irregular)
    walls = {"left": "x", "bottom": "xyz"[:dim]} | ({"front": "y"} if dim == 3 else {})
    water = {"fluid": mpm.Fluid(), "pressure": mpm.hydrostatic(1.0), "gravity": [*[0] * (dim - 1), -9.81]}
    soil = mpm.Hencky(bulk=1e9, shear=5e8, conductivity=1e-5)
    return mpm.Simulation(grid, [body], [soil], walls=walls, initial_stress=mpm.K0(0.5), **water)


@pytest.mark.parametrize("dim, axisymmetric", [(2, False), (2, True), (3, False)], ids=["2D", "ring", "3D"])
def test_water_at_rest_in_irregular_domains_keeps_its_pressures(dim, axisymmetric):
    s = at_rest(dim, **({"axisymmetric": True} if axisymmetric else {}))
    before = s.points.pressure.copy()
    s.step(1.0)
    assert np.abs(s.points.x - s.points.corners.mean(axis=1)).max() > 1e-3
    assert s.points.pressure == pytest.approx(9810 * (1 - s.points.x[:, -1]), abs=1e-8)
    assert s.points.pressure == pytest.approx(before, abs=1e-8)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_point_is_at_the_centroid_of_its_pieces(dim):
    grid = mpm.Grid([0] * dim, [1.2] * dim, [5] * dim)
    corners = mpm.mapped(grid, mpm.box(grid, [0.0] * dim, [1.0] * dim), irregular).corners()
    pieces, x = cut(grid, corners), centroids(corners)
    for axis in range(dim):
        moment = np.bincount(pieces.point, pieces.fraction * pieces.x[:, axis], len(corners))
        assert moment == pytest.approx(x[:, axis], abs=1e-12)
    assert np.abs(x - corners.mean(axis=1)).max() > 1e-3
