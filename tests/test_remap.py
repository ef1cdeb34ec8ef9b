# SPDX-License-Identifier: MIT
"""The remap of pressures changes nothing at rest, conserves fluid in motion, and is exact for linear fields."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import beam

import mpm_dolfinx as mpm
from mpm_dolfinx.bodies.bodies import material_points
from mpm_dolfinx.domains.pressure_transport import CellPressures, PiecePressures, Reconstruction, transport
from mpm_dolfinx.points.cutting import cut
from mpm_dolfinx.stepping import step

MOVES = [0.01, 0.3, 2.6]


def random_beam():
    """Return a beam at the start of a step, with random cell pressures and soft water."""
    s, _ = beam(offset=0.3, fluid=mpm.Fluid(bulk=1e6))
    pressure = np.random.default_rng(0).normal(size=s.grid.num_local) * 1e5
    return s, pressure


def moved(s, state, pressure, way):
    """Return a state on a grid with cell pressures (cells,) after a rigid motion (in cells) and a reset."""
    state, on_grid, *_ = step.set_up(s.scene, state, 1.0)
    s.scene.storage.p.x.array[:] = pressure
    s.scene.momentum.u.x.array[:] = np.tile(way * s.grid.h, len(s.grid.node_x))
    before = stored(on_grid, pressure)
    state, _ = s.scene.motion.advanced(state, on_grid, on_grid.data_of(state), 0.0, (), stays=False)
    s.scene.on_grid(state.points).start(state)
    return state, before


def moving_body(move, pressure, slope, bounds):
    """Return the pieces of a rigid body, their positions after a motion (in cells), and the motion (m)."""
    grid = mpm.Grid([0, 0], [2.0, 2.0], [20, 20])
    points = material_points(grid, [mpm.box(grid, [0.33, 0.41], [1.2, 1.0])])
    old, way = cut(grid, points.corners), move * grid.h * [0.8, 1.0]
    p, s = pressure(old.x), slope(old.x)
    carried = PiecePressures(points.id[old.point], old.cell, old.fraction, p, old.x + way, s, bounds(p))
    return carried, points, cut(grid, points.corners + way), way


def test_a_hundred_resets_of_a_body_at_rest_change_nothing():
    s, pressure = random_beam()
    state, now = s.state, pressure
    for _ in range(100):
        state, _ = moved(s, state, now, 0.0)
        now = s.scene.storage.p.x.array.copy()
    cells = s.scene.last[0].contents.filled
    assert state.resets == 0 and np.abs(now[cells] - pressure[cells]).max() < 1e-13 * np.abs(pressure).max()


@pytest.mark.parametrize("way", [0.0, 0.4, 1.7])
def test_the_fluid_stored_in_all_cells_is_kept_without_new_extremes(way):
    """`way` is in cells. The storage coefficient varies from point to point with the porosity."""
    s, pressure = random_beam()
    F = s.points.F * (1 + 0.1 * np.sin(s.points.x[:, :1] * 9))[:, :, None]
    at_rest = np.einsum("nab,nkb->nka", np.linalg.inv(F), s.points.corners - s.points.x[:, None])
    points = replace(s.points, F=F, reference=at_rest)
    _, before = moved(s, replace(s.state, points=points), pressure, way)
    on_grid, after = s.scene.last[0], s.scene.storage.p.x.array
    assert stored(on_grid, after) == pytest.approx(before, rel=1e-12)
    cells = on_grid.contents.filled
    assert after[cells].min() >= pressure.min() - 1e-6 and after[cells].max() <= pressure.max() + 1e-6


def stored(on_grid, p):
    """Return the sum of w S K (exp(p / K) - 1): the fluid mass stored by the pressure, as a volume at zero pressure."""
    return (on_grid.weight * on_grid.data.pieces["storage"][:, 0]) @ (1e6 * np.expm1(p[on_grid.cut.cells] / 1e6))


@pytest.mark.parametrize("move", MOVES)
def test_a_moving_body_keeps_the_mean_of_each_point_and_the_bounds(move):
    random = np.random.default_rng(1).normal
    old, points, new, _ = moving_body(
        move,
        pressure=lambda x: random(size=len(x)),
        slope=lambda x: 100 * random(size=x.shape),
        bounds=lambda p: np.stack([p - 0.1, p + 0.1], axis=1),
    )
    after = transport(old, points, new)
    assert after.min() >= old.bounds.min() - 1e-12 and after.max() <= old.bounds.max() + 1e-12
    total = np.bincount(old.id, old.fraction * old.pressure)
    assert np.bincount(new.point, new.fraction * after) == pytest.approx(total, abs=1e-12)


@pytest.mark.parametrize("move", MOVES)
def test_a_linear_pressure_moves_with_the_body(move):
    slope = np.array([3.0, -2.0])
    old, points, new, way = moving_body(
        move,
        pressure=lambda x: x @ slope,
        slope=lambda x: np.tile(slope, (len(x), 1)),
        bounds=lambda p: np.tile([-9.0, 9.0], (len(p), 1)),
    )
    assert transport(old, points, new) == pytest.approx((new.x - way) @ slope, abs=1e-12)


def reconstruct(p, filled=None):
    """Return (midpoints, slopes, bounds) of cells with values p(x): all full, or only cells with `filled(x)`."""
    grid = mpm.Grid([0, 0], [1.0, 0.5], [10, 5])
    faces = np.ones((grid.num_local, 2, 2))
    if filled is not None:
        faces[~filled(grid.midpoints)] = 0.0
    nowhere, cells = np.zeros((grid.num_local, 2)), np.arange(grid.num_owned)
    sealed = np.full((grid.num_owned, 2, 2, 2), np.nan)
    slope, bounds = Reconstruction(grid)(CellPressures(cells, p(grid.midpoints), nowhere, faces, sealed), nowhere)
    return grid.midpoints, slope, bounds


def test_slopes_of_a_linear_field_are_exact_but_at_the_surface():
    x, slope, _ = reconstruct(lambda x: 3 * x[:, 0] - 2 * x[:, 1])
    inner = np.abs(x - [0.5, 0.25]) < [0.39, 0.19]
    for axis, exact in enumerate((3.0, -2.0)):
        assert slope[inner[:, axis], axis] == pytest.approx(exact, rel=1e-12)
        assert (slope[~inner[:, axis], axis] == 0).all()


def test_there_is_no_slope_across_a_closed_face_nor_in_a_body_one_cell_thick():
    _, slope, bounds = reconstruct(lambda x: x[:, 0] + 100 * x[:, 1], filled=lambda x: np.abs(x[:, 1] - 0.25) < 0.01)
    assert (slope[:, 1] == 0).all() and slope[:, 0].max() > 0.9
    assert np.ptp(bounds, axis=1).max() < 0.21


def test_a_reconstruction_passes_neither_a_neighbour_nor_an_extreme():
    random = np.random.default_rng(2)
    values = random.normal(size=50)
    _, slope, bounds = reconstruct(lambda x: values)
    for corner in ([-1, -1], [-1, 1], [1, -1], [1, 1]):
        at = values + slope @ (0.05 * np.array(corner))
        assert (at >= bounds[:, 0] - 1e-12).all() and (at <= bounds[:, 1] + 1e-12).all()
    assert bounds.min() == values.min() and bounds.max() == values.max()
    highest, lowest = np.argmax(values), np.argmin(values)
    assert (slope[[highest, lowest]] == 0).all()
