# SPDX-License-Identifier: MIT
"""A slender body needs several points over its thickness; with too few, a warning gives the body and the error."""

import re
from contextlib import nullcontext

import numpy as np
import pytest
from extreme.scenes import WATER, Beam, soil
from meshes import box_mesh
from test_bad_input import GRID, scene

import mpm_dolfinx as mpm
from mpm_dolfinx.diagnostics.resolution import LOST_WET

YOUNG, LENGTH, HEIGHT = 12e6, 1.0, 0.1  # Pa, m, m
RUBBER = mpm.NeoHookean(bulk=YOUNG / 3, shear=YOUNG / 2)  # nu = 0: plane strain is plane stress


def bent(cells, per_cell):
    """Return the tip deflection of a cantilever of some cells in thickness, divided by that of a rod with shear."""
    h = HEIGHT / cells
    grid = mpm.Grid([0, 0], [11 * cells * h, 6 * cells * h], [11 * cells, 6 * cells])
    bottom = 4 * HEIGHT
    body = mpm.box(grid, [0, bottom], [LENGTH, bottom + HEIGHT], per_cell=per_cell)
    inertia = HEIGHT**3 / 12
    load = 0.05 * YOUNG * inertia / LENGTH**2
    end = mpm.Traction("right", (0, -load / HEIGHT))
    s = mpm.Simulation(grid, [body], [RUBBER], walls={"left": "xy"}, conditions=[end])
    result = s.run(1.0, 1.0, probes=mpm.probes([body], [[LENGTH, bottom + HEIGHT / 2]]), progress=False)
    rod = load * LENGTH**3 / (3 * YOUNG * inertia) + load * LENGTH / (5 / 6 * RUBBER.shear * HEIGHT)
    return -result.displacement[-1][0, 1] / rod


@pytest.mark.parametrize("n", [2, 3, 4])
def test_n_points_over_the_thickness_lack_one_part_in_n_squared_of_the_bending_stiffness(n):
    assert bent(n, per_cell=1) == pytest.approx(1 / (1 - 1 / n**2), abs=0.01)
    assert bent(n, per_cell=2) == pytest.approx(1, abs=0.04)


@pytest.mark.parametrize(
    "cells, per_cell, said", [(1, 1, "1 point over .* creeps"), (2, 1, "33% too much"), (1, 2, ""), (4, 1, "")]
)
def test_a_body_too_thin_to_bend_is_named(cells, per_cell, said, warned):
    scene([mpm.box(GRID, [0, 0.2], [1.0, 0.2 + 0.1 * cells], per_cell=per_cell)])
    messages = warned()
    assert bool(messages) == bool(said) and re.search(said, " ".join(messages))


def test_a_wet_body_with_one_point_a_cell_is_named_with_what_it_loses(warned):
    """An undrained beam of 1 m x 0.4 m: errors of 11, 3.6 and 1.3 % with 4, 8 and 16 points over its height."""
    for n in (4, 8):
        beam = Beam(soil(conductivity=0), WATER, h=(0.4 / n, 0.4 / n), per_cell=1, offset=0.3, steps=16, drained=())
        scene = beam()
        result = scene.simulation.run(scene.end, scene.end / 16, probes=scene.probes, progress=False)
        lost = result.displacement[-1][0, 1] / beam.elements()[1] - 1
        assert lost == pytest.approx(LOST_WET / n**2, rel=1 / 3)
        assert f"with pore fluid it bends about {LOST_WET / n**2:.0%} too much and creeps" in warned()[0]


@pytest.mark.parametrize(
    ("lower", "per_cell", "refused"), [((0, 0, 0), 1, True), ((0, 0, 0.03), 1, True), ((0, 0.03, 0.03), 1, False)]
)
def test_domains_that_meet_on_grid_lines_only_are_refused_in_3d(lower, per_cell, refused):
    """Earlier, Newton's method found no descent in dry soil, and wet soil alternated from cell to cell."""
    grid = mpm.Grid([0, 0, 0], [1, 1, 1], [10, 10, 10])
    body, walls = mpm.box(grid, lower, np.add(lower, [0.6, 0.6, 0.5]), per_cell=per_cell), {"bottom": "xyz"}
    conditions = [mpm.Traction("top", (0, 0, -1e3))]
    if refused:
        with pytest.raises(
            ValueError, match=r"body 0: one domain in each cell, in line with cells along x and y, .* >= 2$"
        ):
            mpm.Simulation(grid, [body], [RUBBER], walls=walls, conditions=conditions)
        return
    s = mpm.Simulation(grid, [body], [RUBBER], walls={"bottom": "xyz", "left": "xyz"}, conditions=conditions)
    s.step(1.0)
    assert np.abs(s.points.x - s.points.reference.mean(axis=1)).max() < 1e-3


@pytest.mark.parametrize(("kind", "refused"), [("hexahedron", True), ("tetra", False)])
def test_meshes_with_one_domain_in_each_cell_are_refused_in_3d(kind, refused):
    grid = mpm.Grid([0, 0, 0], [0.4, 0.4, 0.4], [4, 4, 4])
    body = mpm.from_mesh(grid, box_mesh(kind, [3, 3, 3], [0, 0, 0], [0.3, 0.3, 0.3]), per_cell=1)
    with pytest.raises(ValueError, match="body 0: one domain in each cell") if refused else nullcontext():
        mpm.Simulation(grid, [body], [RUBBER], walls={"bottom": "xyz"})


@pytest.mark.parametrize("walls", [{"left": "x", "right": "x", "bottom": "y"}])
def test_a_column_between_walls_or_a_layer_among_others_is_not_too_thin(walls, warned):
    narrow = mpm.Grid([0, 0], [0.1, 1.0], [1, 10])
    scene([mpm.box(narrow, [0, 0], [0.1, 1], per_cell=1)], grid=narrow, walls=walls)
    scene([mpm.box(GRID, [0, y], [1, y + 0.1], per_cell=1) for y in (0, 0.1, 0.2)], walls=walls)
    assert not warned()
