# SPDX-License-Identifier: MIT
"""The pressure's remap changes nothing at rest and loses nothing in motion."""

import numpy as np
import pytest
from helpers import beam

import mpm_dolfinx as mpm
from mpm_dolfinx.domains import cut
from mpm_dolfinx.remap import remap


def test_a_thousand_resets_of_a_body_at_rest_change_nothing():
    s, _ = beam(offset=0.3)
    s._begin(0.0)
    pressure = np.random.default_rng(0).normal(size=s.grid.num_local) * 1e5
    s.storage.p.x.array[:] = pressure
    cells = s.storage.unknowns.owned
    for _ in range(1000):
        s._move_points()
        s._reset_grid()
        s.storage.start(1.0)
    assert np.abs(s.storage.p.x.array[cells] - pressure[cells]).max() < 1e-12 * np.abs(pressure).max()


@pytest.mark.parametrize("move", [0.01, 0.3, 2.6])
def test_a_moving_body_keeps_the_mean_and_the_bounds(move):
    grid = mpm.Grid([2.0, 2.0], [20, 20])
    points = mpm.points.material_points(grid, [mpm.box(grid, [0.33, 0.41], [1.2, 1.0])])
    old = cut(grid, points.corners)
    pressure = np.random.default_rng(1).normal(size=400)[old.cell]
    moved = points.corners + move * grid.h * [0.8, 1.0]
    new = cut(grid, moved)
    after = remap(carry(points, old, pressure), points, new)
    assert after.min() >= pressure.min() - 1e-12 and after.max() <= pressure.max() + 1e-12
    total = np.bincount(old.point, old.fraction * pressure)
    assert np.bincount(new.point, new.fraction * after) == pytest.approx(total, abs=1e-12)
