# SPDX-License-Identifier: MIT
"""Domains of soil that flows keep its volume, and hardly overfill a cell."""

import numpy as np
import pytest
import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.domains.bending import followed
from mpm_dolfinx.points.cutting import cut, domain_volumes

WEIGHT, STEPS, CELLS = 20e3, 20, 5  # N/m^3, -, over the height
SHEAR = 30 * WEIGHT


def weight(points, v):
    """Return the term of the weight."""
    return WEIGHT / ufl.det(points.F) * points.value(v)[1] * points.dx


def viscous(points, u, dt):
    """Return the term of a viscosity."""
    strain = ufl.sym(points.grad(u))
    return 0.01 * WEIGHT * STEPS / dt * ufl.inner(strain, strain) * points.dx


def volumes(s):
    """Return the volume of the domains over that of the soil, and the largest filling of a cell by soil."""
    points, grid = s.state.points, s.grid
    soil, domains = points.volume0 * points.J, domain_volumes(points.corners, False)
    pieces = cut(grid, points.corners)
    cells = np.bincount(pieces.cell, pieces.fraction * soil[pieces.point])
    return domains.sum() / soil.sum(), cells.max() / grid.h.prod()


@pytest.fixture(scope="module")
def run_out():
    """Return `volumes` after each step (n, 2) of a column of clay that loses its strength and runs out."""
    grid = mpm.Grid([0, 0], [2.4, 1.2], [12, 6])
    strength = np.linspace(0.3, 0.07, STEPS) * WEIGHT
    clay = mpm.DruckerPrager(
        bulk=50 * SHEAR, shear=SHEAR, friction=0.0, dilation=0.0, cohesion=lambda X: np.full(len(X), 0.3 * WEIGHT)
    )
    walls = {"left": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [clay], walls=walls, terms=[weight, viscous])
    s.run(1e9, 1e9, progress=False)
    found = []
    for cohesion in strength:
        s.stage(fields={"cohesion": cohesion})
        s.run(s.t + 1.0, 1.0, progress=False)
        found.append(volumes(s))
    assert s.points.corners[:, :, 0].max() > 1.5
    return np.array(found)


def test_domains_of_clay_that_runs_out_keep_its_volume(run_out):
    print(run_out)
    assert np.abs(run_out[:, 0] - 1).max() < 5e-3


def test_no_cell_holds_much_more_clay_than_its_volume(run_out):
    assert run_out[:, 1].max() < 1.04


def test_the_quadratic_correction_ends_continuously_beside_yielded_soil():
    """On the faces between cells both give the same motion, and none where soil has yielded on both sides."""
    grid, rng = mpm.Grid([0, 0], [1, 1], [8, 8]), np.random.default_rng(3)
    on = np.ones(grid.num_local, dtype=bool)
    u = (grid.node_x - 0.3) ** 2 @ rng.standard_normal((2, 2))
    yields = grid.midpoints[:, 0] > 0.5
    kinks = np.zeros(len(grid.node_x), dtype=bool)
    kinks[grid.cell_nodes[yields]] = True
    inner = np.flatnonzero((np.abs(grid.midpoints - 0.5) < 0.37).all(axis=1))  # a second difference at each end
    for axis in (0, 1):
        beside = grid.beside(inner)[:, axis, 1].astype(np.int32)
        x = grid.midpoints[inner] + 0.3 * grid.h
        x[:, axis] = grid.midpoints[inner, axis] + grid.h[axis] / 2
        bends = [followed(grid, cells.astype(np.int32), x, u, on, kinks)[1] for cells in (inner, beside)]
        assert np.abs(bends[0] - bends[1]).max() < 1e-14 < 1e-4 < np.abs(bends[0]).max()
    cells = np.flatnonzero(yields).astype(np.int32)
    assert not followed(grid, cells, grid.midpoints[cells], u, on, kinks)[1].any()
