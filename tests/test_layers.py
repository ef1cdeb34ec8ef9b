# SPDX-License-Identifier: MIT
"""Layers of different conductivity, with interfaces at any position on the grid."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.grid.grid import SIDES

H, TINY = 0.1, 1e-3  # m, Pa: so little that nothing moves
SAND = mpm.Hencky(bulk=1e7 / 3, shear=5e6, porosity=0.4, conductivity=1e-4)
CLAY = mpm.Hencky(bulk=1e7 / 3, shear=5e6, porosity=0.4, conductivity=1e-10)
INCOMPRESSIBLE = mpm.Fluid(bulk=np.inf)


def along(conductivity, J):
    return conductivity * ufl.exp(3 * (J - 1))


def side(which, at, pressure, dim=2, axis=None):
    """Return the open side of a scene in the plane `at` normal to an axis, or else the last open side."""
    axis = dim - 1 if axis is None else axis
    low, high = np.full(dim, -np.inf), np.full(dim, np.inf)
    low[axis], high[axis] = at - 1e-9, at + 1e-9
    return mpm.Drained(which, pressure, (low, high))


def column(seams, materials=(SAND, CLAY), dim=2, width=H, per_cell=2, place=None, **options):
    """Return a column of sand, 1 m high, with seams of clay between given heights (m)."""
    grid = mpm.Grid([0] * dim, [*[width] * (dim - 1), 1.2], [*[round(width / H)] * (dim - 1), 12])
    heights = np.array([0.0, *np.ravel(seams), 1.0])
    bodies = [
        mpm.box(grid, [*[0] * (dim - 1), a], [*[width] * (dim - 1), b], per_cell=per_cell, material=i % 2)
        for i, (a, b) in enumerate(pairwise(heights))
        if b > a
    ]
    bodies = bodies if place is None else [mpm.mapped(grid, body, place) for body in bodies]
    walls = {name: "xyz"[axis] for name, (axis, end) in SIDES[dim].items() if (axis, end) != (dim - 1, 1)}
    return mpm.Simulation(grid, bodies, list(materials), walls=walls, **options)


def ends(dim, pressure=TINY):
    """Return the open lower and upper ends of a column."""
    lower, upper = (name for name, (axis, _) in SIDES[dim].items() if axis == dim - 1)
    return [side(lower, 0, pressure, dim), side(upper, 1, 0.0, dim)]


def outflow(simulation):
    """Return the outflow through the open sides at the end of the last step, m^d/s."""
    return simulation.outflows.array.clip(min=0).sum()


def steady(simulation):
    """Return the steady outflow, m^d/s."""
    simulation.run(simulation.t + 1e15, 1e15, progress=False)
    return outflow(simulation)


def resistance(thickness, clay=CLAY):
    """Return the resistance of a column of 1 m with a thickness of clay, in Pa s/m."""
    return 9810 * ((1 - thickness) / SAND.conductivity + thickness / clay.conductivity)


SEAMS = {
    "a cell": [(0.5, 0.6)],
    "a quarter of a cell": [(0.5, 0.525)],
    "two in a cell": [(0.5, 0.51), (0.54, 0.575)],
    "three cells": [(0.5, 0.8)],
}


@pytest.mark.parametrize("seams", SEAMS)
@pytest.mark.parametrize("offset", [0.0, 0.1, 0.25, 0.5, 0.9])
def test_steady_flow_across_seams_is_exact_at_any_offset(seams, offset):
    seams = np.array(SEAMS[seams]) + offset * H
    s = column(seams, fluid=INCOMPRESSIBLE, conditions=[*ends(2)])
    over = steady(s) / (TINY * H / resistance(np.diff(seams).sum()))
    print(f"{offset} cells off the lines: flow / exact - 1 = {over - 1:.0e}")
    assert over == pytest.approx(1, rel=1e-8)


@pytest.mark.parametrize("options", [{"dim": 3}, {"per_cell": 1}, {"per_cell": 3}], ids=str)
def test_steady_flow_is_exact_in_3d_and_with_any_number_of_points(options):
    dim = options.get("dim", 2)
    s = column([(0.525, 0.625)], fluid=INCOMPRESSIBLE, conditions=ends(dim), **options)
    assert steady(s) == pytest.approx(TINY * H ** (dim - 1) / resistance(0.1), rel=1e-8, abs=0)


@pytest.mark.parametrize("seams", SEAMS)
@pytest.mark.parametrize("offset", [0.0, 0.25, 0.9])
def test_steady_flow_along_seams_is_exact_at_any_offset(seams, offset):
    seams, width = np.array(SEAMS[seams]) + offset * H, 0.4
    drained = [side("left", 0.0, TINY, axis=0), side("right", width, 0.0, axis=0)]
    s = column(seams, fluid=INCOMPRESSIBLE, conditions=drained, width=width)
    share = 1 - np.diff(seams).sum()
    exact = (share * SAND.conductivity + (1 - share) * CLAY.conductivity) / 9810 * TINY / width
    assert steady(s) == pytest.approx(exact, rel=1e-8, abs=0)


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_a_seam_at_an_open_end_resists_as_exact(offset):
    s = column([(0.9 + offset * H, 1.0)], fluid=INCOMPRESSIBLE, conditions=[*ends(2)])
    assert steady(s) == pytest.approx(TINY * H / resistance(0.1 - offset * H), rel=1e-8, abs=0)


def test_a_rounding_of_places_changes_no_flow_where_points_of_two_layers_do_not_match():
    """Earlier, a line through the middle of three points lay on a border: positions 1e-9 cells away changed results by
    5e-5.
    """

    def flow(off):
        grid = mpm.Grid([0, 0], [2 * H, 1.2], [2, 12])
        layers = [(0, 0.13, 2), (0.13, 0.37, 3), (0.37, 1, 2)]
        bodies = [
            mpm.mapped(
                grid,
                mpm.box(grid, [0, low], [2 * H, high], per_cell=per_cell, material=per_cell - 2),
                lambda x: x + off * H * np.sin(np.pi * x[:, :1] / H) * np.cos(1e3 * x[:, 1:]) * [1, 0],
            )
            for low, high, per_cell in layers
        ]
        s = mpm.Simulation(
            grid,
            bodies,
            [SAND, CLAY],
            fluid=INCOMPRESSIBLE,
            walls={"left": "x", "right": "x"},
            conditions=[
                mpm.Displacement("bottom", (0, 0)),
                *ends(2),
            ],
        )
        return steady(s)

    assert flow(1e-9) == pytest.approx(flow(0.0), rel=1e-7, abs=0)


def test_a_conductivity_that_jumps_with_the_place_or_on_the_points_is_layered_too():
    def by_place(x):
        return ufl.conditional(ufl.And(ufl.gt(x[1], 0.525), ufl.lt(x[1], 0.625)), 1e-10, 1e-4)

    def by_points(X):
        return np.where((X[:, 1] > 0.525) & (X[:, 1] < 0.625), 1e-10, 1e-4)

    seams = [(0.525, 0.625)]  # where domains end
    for soil in (
        mpm.Hencky(bulk=1e7, shear=5e6, conductivity=1e-4, conductivity_law=by_place),
        mpm.Hencky(bulk=1e7, shear=5e6, conductivity=by_points),
    ):
        s = column(seams, [soil, soil], fluid=INCOMPRESSIBLE, conditions=[*ends(2)])
        assert steady(s) == pytest.approx(TINY * H / resistance(0.1), rel=1e-8, abs=0)


def test_water_at_rest_does_not_flow_through_seams():
    s = column([(0.525, 0.625)], fluid=mpm.Fluid(), conditions=[side("top", 1, 0.0)], gravity=(0, -10.0))
    s.run(1e15, 1e15, progress=False)
    on_grid, _ = s.scene.last
    y = (s.grid.midpoints + on_grid.contents.centroid)[on_grid.cells, 1]
    p = s.scene.storage.p.x.array[on_grid.cells]
    settled = 1 - s.points.corners[:, :, 1].max()
    assert p == pytest.approx(1e4 * (1 - y), abs=1e4 * 2 * settled)


def test_flow_across_a_seam_is_exact_wherever_the_load_moves_it():
    clay, sand = (
        mpm.Hencky(bulk=1e7 / 3, shear=5e6, porosity=0.4, conductivity=k, conductivity_law=along) for k in (1e-9, 1e-4)
    )
    for load in (3e4, 3e5, 1.5e6):
        s = column(
            [(0.5, 0.6)],
            [sand, clay],
            fluid=INCOMPRESSIBLE,
            conditions=[
                *ends(2, 1.0),
                mpm.Traction("top", lambda t, load=load: (0, -load * min(1, t / 1e9)), ([0, 1], [H, 1])),
            ],
        )
        s.run(1e10, 2.5e8, progress=False)
        thickness = s.points.volume0 * s.points.J / H
        kappa = np.where(s.points.material == 1, 1e-9, 1e-4) / 9810 * np.exp(3 * (s.points.J - 1))
        resists = (thickness / kappa).sum()
        assert outflow(s) == pytest.approx(H / resists, rel=1e-4, abs=0)


def below_after_a_day(offset, load):
    """Return the pressure below a seam of one cell after a day, divided by the load on the drained top."""
    top = [0, 1], [H, 1]
    load_on_top = [mpm.Traction("top", (0, -load), top)]
    s = column(np.array([(0.5, 0.6)]) + offset * H, fluid=mpm.Fluid(), conditions=[*ends(2)[1:], *load_on_top])
    s.run(86400, 3600, progress=False)
    return s.points.pressure[s.points.x[:, 1] < 0.25].mean() / load


def test_a_seam_holds_the_pressure_below_it_wherever_it_lies_and_is_carried():
    on_lines = below_after_a_day(0, 100)
    assert on_lines == pytest.approx(0.873, abs=0.01), "with cells an eighth as large"
    for offset, load in [(0, 1e4), (0, 3e5), (0.1, 100), (0.25, 3e5), (0.5, 100), (0.9, 1e4)]:
        below = below_after_a_day(offset, load)
        print(f"{offset} cells off the lines, {load:g} Pa: p / load {below:.4f}, on the lines {on_lines:.4f}")
        assert below == pytest.approx(on_lines, rel=0.02)


@pytest.mark.parametrize("slope", [0.01, 0.1, 0.2])
def test_aslant_a_seam_is_a_barrier_and_a_drain_conducts(slope):
    """The seam is one cell thick and 1 m long. The exact flow is that of a thin layer."""
    low, high, width, steep = 0.45, 0.55, 1.0, 1 + slope**2

    def place(x):
        share = np.where(x[:, 1] < low, x[:, 1] / low, np.where(x[:, 1] > high, (1 - x[:, 1]) / (1 - high), 1.0))
        return np.stack([x[:, 0], x[:, 1] + share * slope * (x[:, 0] - 0.5)], axis=1)

    scene = {"seams": [(low, high)], "width": width, "place": place, "fluid": INCOMPRESSIBLE}
    across = steady(column(conditions=[*ends(2)], **scene))
    assert across == pytest.approx(TINY * width / (9810 * 0.1 / steep / CLAY.conductivity), rel=0.2, abs=0)
    drained = [side("left", 0.0, TINY, axis=0), side("right", width, 0.0, axis=0)]
    along = steady(column(materials=[CLAY, SAND], conditions=drained, **scene))
    assert along == pytest.approx(0.1 / steep * SAND.conductivity / 9810 * TINY / width, rel=0.2, abs=0)


def test_cells_that_conduct_alike_are_treated_as_ever():
    other = mpm.Hencky(bulk=2e7, shear=5e6, conductivity=SAND.conductivity)
    s = column([(0.525, 0.625)], [SAND, other], fluid=mpm.Fluid(), conditions=[*ends(2)])
    s.step(1.0)
    on_grid, _ = s.scene.last
    mobility = on_grid.mobility(on_grid.data, True)
    assert mobility.share is None and mobility.shift is None
    assert mobility.mean == pytest.approx(SAND.conductivity / 9810, rel=1e-15, abs=0)


def settled(ratio, offset, thickness=1):
    """Return the settlement of a column with a soft layer, some cells thick, divided by the exact settlement."""
    soft = mpm.Hencky(bulk=SAND.bulk / ratio, shear=SAND.shear / ratio)
    load = [mpm.Traction("top", (0, -1.0), ([0, 1], [H, 1]))]
    s = column([((3 + offset) * H, (3 + offset + thickness) * H)], [SAND, soft], conditions=load)
    for _ in range(2):
        s.step(1.0)
    exact = (1 + thickness * H * (ratio - 1)) / SAND.oedometric
    return (1 - s.points.corners[:, :, 1].max()) / exact


@pytest.mark.parametrize(
    ("ratio", "offset", "thickness", "lost"),
    [(10, 0.5, 1, 0.736), (100, 0.5, 1, 0.97), (100, 0.25, 1, 0.96), (10, 0.5, 4, 0.184), (0.01, 0.5, 1, 0.109)],
)
def test_a_soft_layer_off_the_grid_lines_is_named_once_with_what_it_loses(ratio, offset, thickness, lost, warned):
    error = 1 - settled(ratio, offset, thickness)
    (message,) = warned()
    contrast = max(ratio, 1 / ratio)
    assert "bodies 0 and 1" in message and f"up to {contrast:g} times" in message and "grid lines" in message
    assert f"material {int(ratio > 1)}" in message
    said = float(message.split("about ")[1].split(" %")[0]) / 100
    assert said == pytest.approx(lost, abs=0.006)
    gives = max(thickness * H * ratio, 0) if ratio > 1 else 1 - thickness * H
    assert error == pytest.approx(said * gives / (1 + thickness * H * (ratio - 1)), rel=0.05)


@pytest.mark.parametrize(("dim", "rings", "order"), [(2, False, -1), (3, False, 1), (2, True, -1)])
def test_a_soft_layer_is_named_in_space_and_in_rings_and_in_any_order(dim, rings, order, warned):
    grid = mpm.Grid([0] * dim, [*[2 * H] * (dim - 1), 1.2], [*[2] * (dim - 1), 12], axisymmetric=rings)
    soft, flat = mpm.Hencky(bulk=SAND.bulk / 10, shear=SAND.shear / 10), [0] * (dim - 1)
    ends = pairwise((0, 3.5 * H, 4.5 * H, 1))
    bodies = [mpm.box(grid, [*flat, a], [*[2 * H] * (dim - 1), b], material=i % 2) for i, (a, b) in enumerate(ends)]
    walls = {name: "xyz"[axis] for name, (axis, end) in SIDES[dim].items() if (axis, end) != (dim - 1, 1)}
    top = list(SIDES[dim])[-1]
    load = mpm.Traction(top, (*flat, -1.0), ([*flat, 0.99], [9] * dim))
    s = mpm.Simulation(grid, bodies[::order], [SAND, soft], walls=walls, conditions=[load])
    s.step(1.0)
    (message,) = warned()
    assert "material 1, up to 10 times as soft" in message and "about 74 %" in message
    exact = (1 + 9 * H) / SAND.oedometric
    assert (1 - s.points.corners[:, :, -1].max()) / exact == pytest.approx((1 + 9 * H - 0.736 * 10 * H) / 1.9, rel=0.01)


def test_a_soft_layer_whose_interfaces_move_on_is_named_again(warned):
    """A settlement of 3 % moves the interfaces 0.3 cells off the grid lines: the error is 11 %, then half."""
    soft = mpm.Hencky(bulk=SAND.bulk / 10, shear=SAND.shear / 10)
    load = [mpm.Traction("top", lambda t: (0, -2e5 * t), ([0, 1], [H, 1]))]
    s = column([(0.5, 0.6)], [SAND, soft], conditions=load)
    s.run(1.0, 0.05, progress=False)
    said = [float(message.split("about ")[1].split(" %")[0]) for message in warned()]
    assert said[0] < 15 and said[-1] > 40
    assert (np.diff(np.log2(said)) > 0.95).all()


@pytest.mark.parametrize(("ratio", "offset"), [(100, 0.0), (100, 1e-3), (2, 0.5), (0.5, 0.5)])
def test_layers_that_lose_little_are_not_named(ratio, offset, warned):
    assert settled(ratio, offset) == pytest.approx(1, abs=0.031)
    assert not warned()


def test_pieces_whose_boxes_overlap_a_little_are_counted_once():
    """Earlier, a line along the border of two deformed pieces crossed both: the conductivity of a cell was a quarter
    too large.
    """
    found = []
    for by in (0.0, 1e-4, 1e-3):
        grid = mpm.Grid([0, 0], [H, 1.2], [1, 12])
        bodies = [mpm.box(grid, [0, 0], [H, 0.55]), mpm.box(grid, [0, 0.55], [H, 1.0], per_cell=1, material=1)]
        walls = {"left": "x", "right": "x", "bottom": "y"}
        clay = replace(CLAY, conductivity=1e-7)
        s = mpm.Simulation(grid, bodies, [SAND, clay], walls=walls, conditions=ends(2), fluid=INCOMPRESSIBLE)
        corners = s.points.corners.copy()
        inner = np.isclose(corners[:, :, 0], H / 2)
        left = (s.points.x[:, 0] < H / 2)[:, None]
        corners[:, :, 0] += H * by * inner * np.where(left, 1, -1)
        s.state = replace(s.state, points=replace(s.points, corners=corners))
        found.append(steady(s))
    assert np.divide(found[1:], found[0]) == pytest.approx(np.ones(2), abs=1e-3)


@pytest.mark.parametrize("conductivity", [0.0, 1e-12])
def test_pressures_trapped_in_an_impermeable_wall_do_not_change_the_flow_beside_it(conductivity):
    """The wall's face is a fifth of a cell off its grid line.  Weight raises its pressure without initial stress."""
    h, width, gravity = 0.5, 1.4, (0, -9.81)
    grid = mpm.Grid([0, 0], [4 * h, 8 * h], [4, 8])
    bodies = [mpm.box(grid, [0, 0], [width, 4]), mpm.box(grid, [width, 0], [2, 4], material=1)]
    sand = mpm.LinearElastic(bulk=4e9, shear=2e9, conductivity=1e-5)
    wall = mpm.LinearElastic(bulk=4e9, shear=2e9, porosity=0.05, conductivity=conductivity)
    ends = {"top": ((0, 3.9), (width, 4.1)), "bottom": ((0, -0.1), (width, 0.1))}
    heads = {"top": 1.0, "bottom": 4.0}
    drained = [mpm.Drained(side, 9810 * heads[side], region=region) for side, region in ends.items()]
    walls = {"left": "x", "right": "x", "bottom": "xy", "top": "xy"}
    flows = []
    for stress in (None, mpm.K0(0.5)):
        scene = {"walls": walls, "conditions": drained, "gravity": gravity, "initial_stress": stress}
        s = mpm.Simulation(grid, bodies, [sand, wall], fluid=mpm.Fluid(), pressure=mpm.hydrostatic(4.0), **scene)
        s.run(1e6, 2e5, progress=False)
        flows.append(-s.outflows["drained_top"] / (1e-5 * 0.25 * width))
    assert flows[0] == pytest.approx(flows[1], rel=1e-5)
    assert flows[0] == pytest.approx(1, abs=0.008)
