# SPDX-License-Identifier: MIT
"""Reported pressures of points are exact for linear fields, conserve means, and have no new extremes."""

import numpy as np
import pytest
from helpers import SOFT, beam, column

import mpm_dolfinx as mpm
from mpm_dolfinx.domains.pressure_transport import CellPressures, Reconstruction

RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("offset", [0.0, 0.1, 0.9])
def test_a_steady_pressure_between_two_drained_sides_is_linear(offset):
    """The top cell is full, nearly empty, or nearly full."""
    s = column(offset=offset, conditions=[mpm.Drained("top"), mpm.Drained("bottom", pressure=1.0)])
    s.step(1e9)
    assert s.points.pressure == pytest.approx(1 - s.points.x[:, 1] / (1 + offset / 10), abs=1e-6)


@pytest.mark.parametrize("offset", [0.0, 0.1, 0.9])
def test_a_hydrostatic_pressure_is_linear_down_to_the_sealed_floor(offset):
    s = column(offset=offset, gravity=[0, -10.0], conditions=[mpm.Drained("top", pressure=50.0)])
    s.step(1e9)
    top = s.points.corners[..., 1].max()
    assert s.points.pressure == pytest.approx(50 + 1e4 * (top - s.points.x[:, 1]), abs=2e-2)


def cells(shape, filled):
    """Return a grid, its reconstruction, and centroids of cells whose last layer is partly filled."""
    grid = mpm.Grid([0] * len(shape), 0.1 * np.array(shape), shape)
    centroid, faces = np.zeros((grid.num_local, grid.dim)), np.ones((grid.num_local, grid.dim, 2))
    last = grid.midpoints[:, -1] > grid.upper[-1] - grid.h[-1]
    centroid[last, -1] = -0.5 * (1 - filled) * grid.h[-1]
    faces[last, -1, 1] = 0.0
    return grid, Reconstruction(grid), centroid, faces


def outer(grid):
    """Return an empty set of drained sides."""
    return np.full((grid.num_owned, grid.dim, 2, 2), np.nan)


@pytest.mark.parametrize("shape", [(5, 4), (4, 3, 5)], ids=["2D", "3D"])
@pytest.mark.parametrize("filled", [1.0, 0.3, 0.01])
def test_a_linear_pressure_aslant_is_exact_also_at_sealed_sides(shape, filled):
    grid, reconstruction, centroid, faces = cells(shape, filled)
    slope, each, n = np.array([3.0, -2.0, 5.0])[: grid.dim], 7, grid.num_owned
    slot = np.repeat(np.arange(n), each)
    x = centroid[slot] + 0.3 * grid.h * RANDOM.uniform(-1, 1, (len(slot), grid.dim))
    p = (grid.midpoints + centroid) @ slope
    found = reconstruction.up_to_surface(CellPressures(np.arange(n), p, centroid, faces, outer(grid)), x, slot)
    assert found == pytest.approx((grid.midpoints[slot] + x) @ slope, abs=1e-13)


def test_a_steep_pressure_is_not_carried_on_beyond_the_last_cell():
    """The pressure decreases by a factor of ten from cell to cell. An extrapolation would be negative at the no-flow
    end.
    """
    grid, reconstruction, centroid, faces = cells((1, 8), 1.0)
    order = np.argsort(grid.midpoints[:, 1])
    p = np.empty(8)
    p[order] = 10.0 ** np.arange(8)
    x = np.tile([0.0, -0.5 * grid.h[1]], (8, 1))
    found = reconstruction.up_to_surface(CellPressures(np.arange(8), p, centroid, faces, outer(grid)), x, np.arange(8))
    assert (found > 0).all()


def test_points_of_a_cell_keep_its_mean_pressure_and_pass_no_neighbour_nor_drained_side():
    s, _ = beam(offset=0.3, conditions=[mpm.Drained("left", pressure=3e5), mpm.Drained("right")])
    on_grid, scene = s.scene.on_grid(s.points), s.scene
    contents, pieces = on_grid.contents, on_grid.data.pieces
    scene.storage.p.x.array[:] = p = RANDOM.normal(size=s.grid.num_local) * 1e5
    found = on_grid.pressures_up_to_surface(scene.motion._reconstruction, s.state.stage, s.t)
    assert contents.mean(on_grid.cut.pieces_to_cells(found)) == pytest.approx(p[contents.filled], abs=1e-7)
    assert np.abs(found - p[pieces.cells]).max() > 1e4
    assert found.min() > min(p[contents.filled].min(), 0) - 1e-6
    assert found.max() < max(p[contents.filled].max(), 3e5) + 1e-6


def test_a_body_of_one_cell_has_its_pressure():
    grid = mpm.Grid([0, 0], [1.0, 1.0], [2, 2])
    body = mpm.box(grid, [0, 0], [0.5, 0.5])
    load, walls = [mpm.Traction("top", (0, -1e2))], {"left": "x", "bottom": "y"}
    s = mpm.Simulation(grid, [body], [SOFT], fluid=mpm.Fluid(), walls=walls, conditions=load)
    s.step(1.0)
    assert np.ptp(s.points.pressure) == 0 and s.points.pressure[0] > 10


@pytest.mark.parametrize("tilt", [-1e-6, 0.0, 1e-6])
def test_a_drained_side_that_leans_a_little_leaves_the_slope_along_it(tilt):
    """Earlier, rounding decided whether a side inclined over a no-flow base counted as drained, and water at rest lost
    its slope.
    """
    grid = mpm.Grid([0, 0], [1.2, 1.0], [6, 5])
    body = mpm.box(grid, [0.2, 0], [1.0, 0.8])
    body = mpm.mapped(grid, body, lambda X: X + tilt * X[:, [1]] * [1, 0])
    s = mpm.Simulation(
        grid,
        [body],
        [mpm.Hencky(bulk=2e9, shear=1e9, conductivity=1e-6)],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(0.8),
        conditions=[*(mpm.Drained(side, lambda x: 9810 * (0.8 - x[:, 1])) for side in ("left", "right"))],
        initial_stress=mpm.K0(0.5),
    )
    s.run(1.0, 1.0, progress=False)
    assert s.points.pressure == pytest.approx(9810 * (0.8 - s.points.x[:, 1]), abs=10.0)


@pytest.mark.parametrize("drained", [[], [mpm.Drained("top")]], ids=["sealed", "drained"])
@pytest.mark.parametrize("cells", [1, 2])
def test_points_in_few_cells_have_the_slope_of_water_at_rest(cells, drained):
    """At no-flow sides the head has no slope. Earlier, two cells between such sides had 1283 Pa in place of 2283 Pa."""
    grid = mpm.Grid([0, 0], [0.5, 0.75], [2, cells + 1] if cells == 2 else [2, 1])
    soil = mpm.Hencky(bulk=1e8, shear=6e7, conductivity=1e-3)
    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [0.5, 0.5], per_cell=3)],
        [soil],
        fluid=mpm.Fluid(),
        walls={"left": "x", "right": "x", "bottom": "xy"},
        gravity=(0, -9.81),
        conditions=drained,
    )
    s.run(1e5, 2e4, progress=False)
    off = s.points.pressure + 9810 * s.points.x[:, 1]
    assert np.ptp(off) < 0.1 and np.ptp(s.points.pressure) > 2000


@pytest.mark.parametrize("shape", [(5, 4), (4, 3, 5)], ids=["2D", "3D"])
@pytest.mark.parametrize("filled", [1.0, 0.3, 0.01])
def test_a_linear_head_aslant_is_exact_in_unsaturated_soil_too(shape, filled):
    grid, reconstruction, centroid, faces = cells(shape, filled)
    slope, pull, n = np.array([3.0, -2.0, 5.0])[: grid.dim], np.array([-1.0, 0.5, -9.0])[: grid.dim], grid.num_owned
    slot = np.repeat(np.arange(n), 7)
    x = centroid[slot] + 0.3 * grid.h * RANDOM.uniform(-1, 1, (len(slot), grid.dim))
    head = CellPressures(np.arange(n), (grid.midpoints + centroid) @ slope, centroid, faces, outer(grid))
    for alike in (True, RANDOM.random((n, grid.dim, 2)) < 0.5):
        found = reconstruction.up_to_surface(head, x, slot, lambda of, x: x @ pull, alike)
        assert found == pytest.approx((grid.midpoints[slot] + x) @ (slope + pull), abs=1e-12)


@pytest.mark.parametrize("axisymmetric", [False, True])
def test_points_at_a_wetting_front_pass_no_neighbour(axisymmetric):
    """Earlier, only heads were limited: nearly uniform pressures above the front zigzagged by 600 Pa."""
    grid = mpm.Grid([0, 0], [1.0, 4.5], [2, 9], axisymmetric=axisymmetric)
    law = mpm.VanGenuchten(4905.0, residual=0.08, n=2.2)
    soil = mpm.Hencky(bulk=1e7, shear=5e6, conductivity=1e-5, retention=law)
    scene = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "gravity": (0, -9.81), "fluid": mpm.Fluid()}
    scene |= {"pressure": mpm.hydrostatic(-2.0), "initial_stress": mpm.K0(0.5)}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 4])], [soil], conditions=[mpm.Rain("top", 5.556e-6)], **scene)
    s.run(8e4, 1e4, progress=False)
    wet = s.points.x[:, 1] > 2.5
    p = s.points.pressure[wet][np.argsort(s.points.x[wet, 1], kind="stable")]
    assert (np.diff(p) > -1e-3).all()
    cells = s.cells()
    for x, mean in zip(cells.x, cells.pressure, strict=True):
        inside = (np.abs(s.points.x - x) <= 0.26).all(axis=1)
        assert s.points.pressure[inside].mean() == pytest.approx(mean, rel=2e-2)


@pytest.mark.parametrize("level", [-1.0, 0.7])
def test_unsaturated_water_at_rest_is_hydrostatic_next_to_drained_sides(level):
    grid = mpm.Grid([0, 0], [1.0, 2.5], [2, 5])
    soil = mpm.Hencky(bulk=1e9, shear=5e8, conductivity=1e-5, retention=mpm.VanGenuchten(4905.0, n=2.2))
    sides = [mpm.Drained("bottom", 9810.0 * level), mpm.Drained("top", 9810.0 * (level - 2))]
    scene = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "gravity": (0, -9.81), "fluid": mpm.Fluid()}
    scene |= {"pressure": mpm.hydrostatic(level), "initial_stress": mpm.K0(0.5)}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 2])], [soil], conditions=sides, **scene)
    s.step(1e3)
    assert s.points.pressure == pytest.approx(9810 * (level - s.points.x[:, 1]), abs=1.0)
