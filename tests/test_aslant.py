# SPDX-License-Identifier: MIT
"""Flow in bodies inclined to the grid is of second order, through open sides and along no-flow sides."""

from dataclasses import replace

import numpy as np
import pytest

import mpm_dolfinx as mpm

HEIGHT, WIDTH, START, WATER = 1.0, 0.5, 1e3, 1e6  # m, m, Pa, Pa
SOIL = mpm.LinearElastic(bulk=1e12, shear=1e12, porosity=0.4, conductivity=1e-5)
CONSOLIDATION = 1e-5 / 9810 / (0.4 / WATER)  # m^2/s


def turned(cells, angle, drained, off=0.0, dim=2, seepage=False, **options):
    """Return a column of hard soil with soft water, rotated about the last corner of its base.

    seepage: whether the top is a seepage face.
    """
    h = HEIGHT / cells
    grid = mpm.Grid([0] * dim, [*[1.6, 1.6][:2], *[2 * h] * (dim - 2)], [*[round(1.6 / h)] * 2, *[2] * (dim - 2)])
    turn = np.eye(dim)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    foot = np.array([0.7, 0.15, 0.0][:dim]) + off * h * (np.arange(dim) < 2)
    straight = mpm.box(grid, [0.0] * dim, [WIDTH, HEIGHT, 2 * h][:dim])
    body = mpm.mapped(grid, straight, lambda X: foot + X @ turn.T)
    sides = ("bottom", "top") if dim == 2 else ("front", "back")
    simulation = mpm.Simulation(
        grid,
        [body],
        [SOIL],
        fluid=mpm.Fluid(bulk=WATER),
        walls={},
        conditions=[
            mpm.Displacement(sides[0], (0.0,) * dim),
            *(mpm.Drained(sides[end], p, seepage=seepage and end == 1) for end, p in drained),
        ],
        **options,
    )
    return simulation, lambda x: ((x - foot) @ turn)[:, 1]


def consolidated(cells, angle, time):
    """Return the rms error of the cell pressures over the initial pressure, and the relative error of the outflow."""
    s, along = turned(cells, angle, [(1, 0.0)], pressure=START)
    for end, steps in ((1e-2, 6), (time, 10)):
        s.run(end / CONSOLIDATION, (end / CONSOLIDATION - s.t) / steps, progress=False)
    m = np.pi * (np.arange(200) + 0.5)
    decay, cell = np.exp(-(m**2) * time), s.cells()
    exact = (2 / m * np.sin(m * (1 - along(cell.x)[:, None])) * decay).sum(axis=1)
    rms = np.sqrt(np.average((cell.pressure / START - exact) ** 2, weights=cell.volume))
    return rms, s.outflows.array[0] / (WIDTH * 1e-5 / 9810 * START * 2 * decay.sum()) - 1


def test_a_column_that_drains_at_a_slanted_top_is_of_second_order():
    coarse, fine = (consolidated(cells, np.pi / 6, 0.1) for cells in (10, 20))
    assert fine[0] < 5e-4 and abs(fine[1]) < 2e-3
    assert np.log2(coarse[0] / fine[0]) > 1.8, (coarse, fine)
    along = consolidated(20, 0.0, 0.1)
    assert fine[0] < 1.2 * along[0], "as exact as one along the grid"


@pytest.mark.parametrize(
    "angle, off, dim", [(np.pi / 6, 0.0, 2), (0.2, 0.37, 2), pytest.param(np.pi / 6, 0.3, 3, marks=pytest.mark.slow)]
)
def test_steady_flow_through_a_turned_column_is_the_linear_one(angle, off, dim):
    s, along = turned(8, angle, [(0, 2e3), (1, 1e3)], off, dim)
    s.run(1e8, 5e6, progress=False)
    cell = s.cells()
    through = 1e-5 / 9810 * 1e3 * WIDTH * (1 if dim == 2 else 0.25)
    assert cell.pressure == pytest.approx(2e3 - 1e3 * along(cell.x), abs=2.0)
    assert s.outflows.array == pytest.approx([-through, through], rel=2e-3)


@pytest.mark.parametrize("angle", [0.2, np.pi / 6])
def test_a_slanted_seepage_face_lets_out_what_flows_to_it(angle):
    s, along = turned(20, angle, [(0, 1e3), (1, 0.0)], seepage=True)
    s.run(1e8, 1e7, progress=False)
    cell = s.cells()
    assert s.outflows.array == pytest.approx([-1e-5 / 9810 * 1e3 * WIDTH, 1e-5 / 9810 * 1e3 * WIDTH], rel=1e-3)
    assert cell.pressure == pytest.approx(1e3 * (1 - along(cell.x)), abs=2.0)


@pytest.mark.parametrize("length", [1e-4, 1e3])
def test_flow_along_slanted_sides_does_not_depend_on_the_unit_of_length(length):
    """An earlier version weighted the equations of no-flow sides by 1 / h^2, with h in metres: in millimetres, 3 % more
    flowed out.
    """

    def flow(size):
        grid = mpm.Grid([0] * 2, [1.6 * size] * 2, [12, 12])
        turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
        strip = mpm.box(grid, [0, 0], [size, 0.5 * size])
        body = mpm.mapped(grid, strip, lambda X: np.array([0.4, 0.1]) * size + X @ turn)
        s = mpm.Simulation(
            grid,
            [body],
            [replace(SOIL, conductivity=1e-5 * size**2)],
            fluid=mpm.Fluid(bulk=WATER),
            walls={},
            conditions=[mpm.Displacement("bottom", (0.0, 0.0)), mpm.Drained("left", 2e3), mpm.Drained("right", 1e3)],
        )
        s.run(1e5, 2e4, progress=False)
        cell = s.cells()
        order = np.lexsort(np.rint(cell.x.T / size * 1e6))
        return cell.pressure[order], s.outflows.array / size**2

    (p, q), (p0, q0) = flow(length), flow(1.0)
    assert p == pytest.approx(p0, rel=0, abs=1e-10 * p0.max()) and q == pytest.approx(q0, rel=1e-10)


def test_a_body_along_the_grid_has_no_flow_besides():
    s, _ = turned(8, 0.0, [(1, 0.0)], off=0.3, pressure=START)
    s.run(1e4, 1e4, progress=False)
    assert not s.scene.storage.fluxes.nonorthogonal.used
