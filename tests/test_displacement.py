# SPDX-License-Identifier: MIT
"""Prescribed displacements of sides: exact stress and reactions, and rigid motion without stress."""

import numpy as np
import pytest
from helpers import SOFT, column

import mpm_dolfinx as mpm

CENTRE = np.array([0.515, 0.7])


def carried(turns, shift):
    """Return the displacement of a rigid motion: `turns` full rotations and a translation (m) until t = 1."""

    def value(t, X):
        a = 2 * np.pi * turns * t
        R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        return (X - CENTRE) @ R.T + CENTRE + np.array([shift * t, 0.03 * t]) - X

    return value


@pytest.mark.parametrize("turns, shift, steps", [(0, 1.0, 40), (1, 0.0, 72), (1, 1.0, 72)])
def test_a_body_carried_rigidly_keeps_zero_stress(turns, shift, steps):
    """Ten cells, 360 degrees: the stress is below 1e-8 E at all times."""
    grid = mpm.Grid([0, 0], [2.4, 1.4], [24, 14])
    body = mpm.box(grid, [0.2, 0.45], [0.83, 0.95])
    sides = [mpm.Displacement(side, carried(turns, shift)) for side in ("left", "right", "bottom", "top")]
    s = mpm.Simulation(grid, [body], [SOFT], walls={}, conditions=sides)
    worst = []
    s.run(1.0, 1 / steps, observe=lambda s: worst.append(np.abs(s.effective_stress()).max()))
    assert max(worst) < 1e-8 * 1e7
    turned = carried(turns, shift)(1.0, body.centre) + body.centre
    assert s.points.x == pytest.approx(turned, abs=1e-9)


def test_the_reaction_is_that_of_the_stress():
    """Confined compression to 70 %: the nominal stress of Hencky's law is M ln(l) / l."""
    s = column(fluid=False, offset=0.3, conditions=[mpm.Displacement("top", lambda t, X: (0, -0.3 * t), "y")])
    height = s.points.corners[:, :, 1].max()
    s.run(1.0, 0.1)
    stretch = 1 - 0.3 / height
    exact = SOFT.oedometric * np.log(stretch) / stretch * s.grid.h[0]
    assert s.reactions.array[0] == pytest.approx([0, exact], rel=2e-4)


def test_a_side_slides_freely_along_the_components_that_are_not_given():
    grid = mpm.Grid([0, 0], [0.5, 1.2], [5, 12])
    top = mpm.Displacement("top", (0, -0.05), "y")
    body = mpm.box(grid, [0, 0], [0.35, 1])
    s = mpm.Simulation(grid, [body], [SOFT], walls={"bottom": "y", "left": "x"}, conditions=[top])
    s.run(1.0, 0.5)
    strain = np.log(1 - 0.05)  # nu = 0 for this soil: nothing widens
    assert s.effective_stress()[:, 1, 1] * s.points.J == pytest.approx(1e7 * strain, rel=5e-5)
    assert np.abs(s.effective_stress()[:, 0, 0]).max() < 10


def test_given_displacements_hold_a_body_that_no_wall_holds():
    grid = mpm.Grid([0, 0], [1.0, 1.0], [10, 10])
    body = mpm.box(grid, [0.3, 0.3], [0.7, 0.7])
    one = mpm.Displacement("left", (0, 0), "y")
    with pytest.raises(ValueError, match="free to move as a rigid body in 2 of 3 modes"):
        mpm.Simulation(grid, [body], [SOFT], walls={}, conditions=[one]).run(1, 1)
    both = mpm.Displacement("left", (0, 0))
    assert mpm.Simulation(grid, [body], [SOFT], walls={}, conditions=[both]).run(1, 1).converged


def test_components_are_checked():
    with pytest.raises(ValueError, match="components must be letters of 'xy'"):
        column(fluid=False, conditions=[mpm.Displacement("top", (0, 0), "z")])
