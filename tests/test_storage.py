# SPDX-License-Identifier: MIT
"""Storage: hydrostatics, flow patch test, conservation."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from helpers import SOFT, beam, column, set_up

import mpm_dolfinx as mpm
from mpm_dolfinx.materials.skeleton import STANDARD_GRAVITY
from mpm_dolfinx.points.cutting import corner_bits


def residual(s, pressure, dt=1.0):
    """Return the storage residual at rest, with cell pressures `pressure` as functions of height."""
    storage, forms = set_up(s, dt).storage, s.scene.storage
    y = (s.grid.midpoints + s.scene.last[0].contents.centroid)[:, 1]
    forms.p.x.array[:] = forms.p_n.x.array[:] = pressure(y)
    return storage.assemble_residual().vector.array


@pytest.mark.parametrize("offset", [0.0, 0.1, 0.5])
def test_hydrostatic_pressure_does_not_flow(offset):
    s = column(offset=offset, gravity=[0, -STANDARD_GRAVITY], conditions=[mpm.Drained("top")], width=2)
    r = residual(s, lambda y: 1000 * STANDARD_GRAVITY * (1 + offset / 10 - y))
    through = SOFT.conductivity * 0.2  # of a unit gradient
    assert np.abs(r).max() < 1e-12 * through


@pytest.mark.parametrize("bulk", [1e4, np.inf])
@pytest.mark.parametrize("offset", [0.0, 0.1, 0.5])
def test_a_steady_flow_is_even_however_the_body_lies_on_the_grid(offset, bulk):
    """The pressure of water is linear, and so is the density of water as compressible as the pressure is high."""
    drained = [mpm.Drained("top", pressure=0.0), mpm.Drained("bottom", pressure=1e4)]
    s = column(offset=offset, conditions=drained, fluid=mpm.Fluid(bulk=bulk))
    length = 1 + offset / 10
    driving = 1e4 if bulk == np.inf else bulk * np.expm1(1e4 / bulk)
    flux = SOFT.conductivity / 9810 * driving / length * 0.1

    def pressure(y):
        potential = driving * (1 - y / length)
        return potential if bulk == np.inf else bulk * np.log1p(potential / bulk)

    assert np.abs(residual(s, pressure)).max() < 1e-9 * flux


def test_a_prescribed_inflow_passes_through():
    s = column(conditions=[mpm.Inflow("bottom", 1e-5), mpm.Drained("top")])
    s.run(200.0, 20.0)
    gradient = 1e-5 / (SOFT.conductivity / 9810)
    assert s.points.pressure == pytest.approx(gradient * (1 - s.points.x[:, 1]), abs=1e-3 * gradient)


def test_a_rotation_squeezes_no_fluid_out():
    s, _ = beam()
    storage = set_up(s, 1.0).storage
    x, angle = s.grid.node_x - [0.5, 0.7], 0.5
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    s.scene.momentum.u.x.array[:] = (x @ R.T - x).ravel()
    assert np.abs(storage.assemble_residual().vector.array).max() < 1e-14


@pytest.mark.parametrize("bulk", [2.2e9, np.inf])
def test_the_fluid_balance_closes_in_every_step(bulk):
    s, _ = beam(fluid=True)
    s, _ = beam(fluid=mpm.Fluid(bulk=bulk))
    result = s.run(0.2, 0.02)
    assert result.balance <= 1e-8 and result.residual <= 1e-8


def test_a_sealed_body_keeps_its_fluid():
    s = column(conditions=[mpm.Traction("top", (0, -1e4))], material=SOFT)
    result = s.run(1.0, 0.25)
    assert result.balance <= 1e-8
    # all the load is carried by the water but for its compressibility
    undrained = SOFT.oedometric + 2.2e9 / 0.4
    assert s.points.pressure == pytest.approx(1e4 * (1 - SOFT.oedometric / undrained), rel=2e-3)


def test_biot_coefficient_and_grains_enter_the_undrained_response():
    material = mpm.Hencky(bulk=1e7, shear=6e6, porosity=0.3, biot=0.8, grain_bulk=5e7)
    s = column(material=material, fluid=mpm.Fluid(bulk=2e7), conditions=[mpm.Traction("top", (0, -100.0))])
    s.run(1.0, 1.0)
    storage = 0.3 / 2e7 + 0.5 / 5e7
    skempton = 0.8 / (storage * material.oedometric + 0.64)
    assert s.points.pressure == pytest.approx(np.full(len(s.points), 100 * skempton), rel=1e-3)


def test_one_dimensional_consolidation_follows_terzaghi():
    s = column(cells=20, conditions=[mpm.Drained("top"), mpm.Traction("top", (0, -100.0))], offset=0.3)
    height = 1 + 0.3 / 20
    cv = SOFT.conductivity / 9810 * SOFT.oedometric
    t = 0.5 * height**2 / cv
    s.run(t, t / 100)
    m = np.arange(200)
    M, z = np.pi * (m + 0.5), 1 - s.points.x[:, 1, None] / height
    exact = 100 * (2 / M * np.sin(M * z) * np.exp(-(M**2) * 0.5)).sum(axis=1)
    assert np.abs(s.points.pressure - exact).max() < 0.015 * 100


def test_pressure_jumps_are_damped_only_where_next_to_nothing_flows():
    s = column(conditions=[mpm.Drained("top")])
    kappa, lam = SOFT.conductivity / 9810, SOFT.bulk - 2 * SOFT.shear / 3
    tau = 0.25 * 3 / (8 * (lam + 3 * SOFT.shear))  # a quarter of the patch value of Silvester and Kechkar
    enough = tau * s.grid.h[0] ** 2 / kappa  # the step in which a face carries as much by flow
    assert not set_up(s, 10 * enough).storage.damped
    balances = set_up(s, 0.5 * enough)
    assert balances.storage.damped
    damping = balances.matrices.storage.D
    ones, out = damping.createVecs()
    ones.set(1.0)
    damping.mult(ones, out)
    assert out.norm() < 1e-14 * damping.norm(), "an even increment is damped: fluid is lost"
    # flow and damping together carry tau d A on every inner face: here each one half
    row = -np.array([v for v in damping.getRow(3)[1] if v < 0])
    assert len(row) and row == pytest.approx(0.5 * tau * s.grid.h[0] ** 2 * np.ones(len(row)), rel=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_jump_between_two_cells_is_damped_by_a_quarter_of_the_published_stabilisation(dim):
    """S dp V = Q dt - tau h A [dp] for an inflow into one of two cells, without flow between; the skeleton sees the
    sum.

    Published: 3 alpha^2 / (8 (lambda + 3G)) in 2D, for a patch of four cells. The value is the same in 3D: pressures
    that alternate along two axes are a plane strain problem.
    """
    lam, shear, biot, brought = 2e6, 5e6, 0.8, 1e-6  # the last: share of a cell's volume
    soil = mpm.Hencky(bulk=lam + 2 * shear / 3, shear=shear, porosity=0.4, biot=biot)
    grid = mpm.Grid([0] * dim, [1.0, *[0.5] * (dim - 1)], [2, *[1] * (dim - 1)])
    walls = {side: "xyz"[:dim] for side in ("left", "right", "bottom")} | {"top": "xyz"[: dim - 1]}
    walls |= {"front": "xy", "back": "xy"} if dim == 3 else {}
    body, water = mpm.box(grid, [0] * dim, grid.upper), mpm.Fluid(bulk=1e7)

    def filling(points, q):
        return brought * ufl.conditional(ufl.lt(points.position[0], 0.5), 1.0, 0.0) * q * points.dx

    s = mpm.Simulation(grid, [body], [soil], walls=walls, fluid=water, terms=[mpm.Source(filling)])
    s.step(1.0)
    left, p = s.points.x[:, 0] < 0.5, s.points.pressure
    patch = 3 * biot**2 / (8 * (lam + 3 * shear))
    jump = brought / (0.4 / water.bulk + 2 * patch / 4)
    assert p[left].mean() - p[~left].mean() == pytest.approx(jump, rel=1e-5)


def test_a_cell_that_becomes_active_between_active_nodes_gets_an_unknown():
    grid = mpm.Grid([0, 0], [3.0, 3.0], [3, 3])

    def ring(x):
        return (np.abs(x - 1.5) > 0.5).any(axis=1)

    s = mpm.Simulation(grid, [mpm.shape(grid, ring)], [SOFT], fluid=mpm.Fluid(), walls={"left": "xy", "bottom": "xy"})
    assert set_up(s, 1.0).matrices.storage.unknowns.size == 8
    # one domain of the cell below comes to fill the hole, another one the place that it left
    moved, other = np.flatnonzero((np.abs(s.points.x - [1.5, 0.5]) < 0.5).all(axis=1))[:2]
    corners, volume = s.points.corners.copy(), s.points.volume0.copy()
    corners[moved] = 1 + corner_bits(2)
    volume[[moved, other]] = 1.0, 0.5
    s.state = replace(s.state, points=replace(s.points, corners=corners, volume0=volume))
    assert set_up(s, 1.0).matrices.storage.unknowns.size == 9
