# SPDX-License-Identifier: MIT
"""A column of sand collapses, with the run-out of experiments."""

from types import SimpleNamespace

import numpy as np
import pytest
from collapse import BALANCE, CELLS, COARSE, GRAIN, SCATTER, STEPS, collapsed, column, depths, front, moving, published


@pytest.mark.slow
@pytest.mark.parametrize("renewal", [False, True])
def test_a_column_of_sand_runs_out_as_far_as_lube_s(renewal):
    """The column is as high as wide. Energies balance to 1.5 % of the work of the weight.

    The heap vibrates at the end, with 0.14 % of this work.
    """
    one = collapsed(1.0, CELLS[1.0], STEPS, renewal=renewal)
    assert (one.result.renewals > 20) is renewal
    assert one.run_out == pytest.approx(published(1.0), rel=SCATTER)
    assert one.lost < BALANCE and one.left < 2e-3


def test_depths_are_those_of_the_domains():
    """Two parallelograms share an inclined edge, so their depths add up to the depth of a strip."""
    low = np.array([[0.0, 0.0], [0.5, 0.1], [0.1, 0.3], [0.6, 0.4]])
    corners = low + np.array([[0.0, 0.0], [0.5, 0.1]])[:, None]
    x, depth = depths(SimpleNamespace(points=SimpleNamespace(corners=corners)))
    inside = (x > 0.105) & (x < 0.995)
    assert depth[inside] == pytest.approx(0.28, abs=1e-12) and x[-1] > 1.1
    assert GRAIN * depth.sum() == pytest.approx(0.28, rel=0.01)


def test_coarse_sand_under_water_moves_as_dry_sand_under_reduced_gravity():
    """Under the whole weight, the front would move almost twice as far in this time."""
    fronts = []
    for conductivity in (0.0, COARSE):
        s, fall = column(1.0, 6, conductivity=conductivity), moving(conductivity)[1] ** -0.5
        s.run(fall, fall / 10, progress=False)
        fronts.append(front(*depths(s)) - 1)
    assert fronts[1] == pytest.approx(fronts[0], rel=0.02) and fronts[0] > 0.2
