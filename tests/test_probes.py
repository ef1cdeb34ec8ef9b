# SPDX-License-Identifier: MIT
"""Pressures and stresses at probes: exact for linear fields, otherwise of second order."""

from dataclasses import replace

import numpy as np
import pytest
from test_places import irregular

import mpm_dolfinx as mpm
from mpm_dolfinx.probing.probe_fields import probe_stresses

RANDOM = np.random.default_rng(7)
STIFF = {"bulk": 1e12, "shear": 1e12}
WEIGHT = 9810.0
SIDES = {2: {"left": "x", "right": "x"}, 3: {"left": "x", "right": "x", "front": "y", "back": "y"}}
UP = {2: "y", 3: "z"}


def terzaghi(z, T):
    """Return the pressure divided by the load, at heights z above a no-flow base, divided by the drainage path."""
    M = np.pi / 2 * (2 * np.arange(200) + 1)
    return (2 / M * np.sin(M * (1 - z[:, None])) * np.exp(-(M**2) * T)).sum(axis=1)


@pytest.mark.parametrize("cells, allowed", [(10, 0.005), (20, 0.0012), pytest.param(40, 3e-4, marks=pytest.mark.slow)])
def test_a_column_consolidates_at_any_place_as_terzaghi_says(cells, allowed):
    h, times, modulus, k = 1 / cells, [0.06, 0.1, 0.2, 0.5, 1.0], 1e8, 1e-6
    grid = mpm.Grid([0, 0], [h, 1 + h], [1, cells + 1])
    body = mpm.box(grid, [0, 0], [h, 1])
    soil = mpm.LinearElastic(bulk=modulus / 3, shear=modulus / 2, conductivity=k)
    walls, load = SIDES[2] | {"bottom": "y"}, [mpm.Traction("top", (0, -1e3))]
    water = {"fluid": mpm.Fluid(bulk=np.inf), "conditions": [mpm.Drained("top")]}
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=[*load, *water.pop("conditions", [])], **water)
    z, unit = np.linspace(0, 1, 37), WEIGHT / (k * modulus)
    probes = mpm.probes([body], np.column_stack([np.full(37, 0.2 * h), z]))
    rtol = 0.05 * allowed  # errors in time are far smaller
    found = s.run(unit, rtol=rtol, t_eval=unit * np.array(times), probes=probes, progress=False).probe_pressure[1:]
    errors = [np.abs(p / 1e3 - terzaghi(z, T)).max() for T, p in zip(times, found, strict=True)]
    print("errors over the load:", *(f"{e:.5f}" for e in errors))
    assert max(errors) < allowed


@pytest.mark.parametrize(
    "dim, axisymmetric, off, lower, upper, below",
    [
        (2, False, 0.0, 1e-6, 1e-4, 2e4),
        (2, False, 0.3, 1e-4, 1e-6, 2e4),
        (2, True, 0.3, 1e-6, 1e-4, 2e4),
        (3, False, 0.3, 1e-6, 1e-4, 2e4),
        (2, False, 0.3, 1e-6, 1e-4, 0.0),
        (2, False, 0.6, 1e-6, 1e-4, 0.0),
    ],
    ids=["plane", "off", "ring", "space", "peak", "peak between cells"],
)
def test_steady_flow_through_layers_is_exact_up_to_their_interface_and_drained_sides(
    dim, axisymmetric, off, lower, upper, below
):
    """The interface is within a cell, or between cells. Water flows up, or down, against its weight. The pressure has
    its maximum at the interface, if none is prescribed below.
    """
    n, h, meets = (8, 0.125, 0.55) if dim == 2 else (5, 0.2, 0.5)
    grid = mpm.Grid([0] * dim, [2 * h] * (dim - 1) + [1 + h], [2] * (dim - 1) + [n + 1], axisymmetric=axisymmetric)
    z, side = off * h, [2 * h] * (dim - 1)
    ends = ((z, z + meets), (z + meets, z + 1))
    bodies = [mpm.box(grid, [0] * (dim - 1) + [a], [*side, b], material=i) for i, (a, b) in enumerate(ends)]
    s = mpm.Simulation(
        grid,
        bodies,
        [mpm.LinearElastic(**STIFF, conductivity=k) for k in (lower, upper)],
        walls=SIDES[dim],
        fluid=mpm.Fluid(bulk=np.inf),
        conditions=[mpm.Displacement("bottom", [0] * dim, UP[dim]), mpm.Drained("top"), mpm.Drained("bottom", below)],
        gravity=[0] * (dim - 1) + [-9.81],
    )
    y = np.concatenate([np.linspace(0, meets - 1e-9, 9), np.linspace(meets + 1e-9, 1, 9)])
    places = np.column_stack([*[RANDOM.uniform(0, 2 * h, len(y))] * (dim - 1), z + y])
    found = s.run(1e4, 1e4, probes=mpm.probes(bodies, places), progress=False).probe_pressure[-1]
    resists = np.minimum(y, meets) / lower + np.maximum(y - meets, 0) / upper
    head = below + (WEIGHT - below) * resists / (meets / lower + (1 - meets) / upper)
    assert found == pytest.approx(head - WEIGHT * y, abs=1e-6 * 2e4)


@pytest.mark.parametrize("thick", [1, 2, 5], ids=lambda n: f"{n} cells")
def test_water_at_rest_is_exact_just_below_a_drained_surface_and_at_a_sealed_base(thick):
    grid = mpm.Grid([0, 0], [3.0, thick + 1.0], [3, thick + 1])
    body, head = mpm.box(grid, [0, 0], [3, thick]), mpm.hydrostatic(thick + 1.0)
    soil = mpm.LinearElastic(**STIFF, conductivity=1e-4)
    water = {"fluid": mpm.Fluid(), "gravity": (0, -9.81), "pressure": head, "conditions": [mpm.Drained("top", WEIGHT)]}
    s = mpm.Simulation(grid, [body], [soil], walls=SIDES[2] | {"bottom": "y"}, **water)
    places = np.array([[1.3, thick - 0.01], [0, thick], [3, 0], [1.5, 0.1]])
    result = s.run(1e6, 1e6, probes=mpm.probes([body], places), progress=False)
    for p in result.probe_pressure:
        assert p == pytest.approx(WEIGHT * (thick + 1 - places[:, 1]), rel=1e-6)


def test_a_steady_pressure_is_exact_up_to_sides_aslant():
    """The pressures of its cells are accurate to 1e-4 of the pressure."""
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    grid = mpm.Grid([0, 0], [1.6, 1.8], [16, 18])
    box = mpm.box(grid, [0.5, 0.1], [0.9, 1.1])
    placed = lambda X: (X - [0.5, 0.1]) @ turn + [0.55, 0.1]  # noqa: E731
    body, along = mpm.mapped(grid, box, placed), lambda t, x: 1e4 * (x - [0.55, 0.1]) @ turn[1]
    sides = [mpm.Drained(side, along) for side in ("top", "bottom")]
    held = [mpm.Displacement("bottom", (0, 0))]
    soil, water = mpm.LinearElastic(**STIFF, conductivity=1e-5), mpm.Fluid(bulk=np.inf)
    s = mpm.Simulation(grid, [body], [soil], walls={}, fluid=water, conditions=[*held, *sides])
    X = [0.5, 0.1] + RANDOM.uniform(size=(30, 2)) * [0.4, 1.0]
    X = np.concatenate([X, [[0.5, 0.1], [0.9, 1.1], [0.5, 0.7], [0.9, 0.4]]])
    found = s.run(1e5, 1e5, probes=mpm.probes([body], X), progress=False).probe_pressure[-1]
    assert found == pytest.approx(along(0, placed(X)), abs=4e-4 * 1e4)


@pytest.mark.parametrize("contacts", [[], [mpm.Contact(0, 1)]], ids=["gap", "contact"])
def test_what_lies_beyond_a_gap_or_a_contact_tells_nothing(contacts):
    grid, gap = mpm.Grid([0, 0], [0.6, 0.4], [6, 4]), 0.0 if contacts else 0.1
    bodies = [mpm.box(grid, [0, 0], [0.2, 0.4]), mpm.box(grid, [0.2 + gap, 0], [0.6, 0.4])]
    soil = mpm.LinearElastic(**STIFF, conductivity=1e-6)
    walls = {"left": "xy", "right": "xy", "bottom": "xy"}
    ends = {"fluid": mpm.Fluid(), "pressure": lambda x: np.where(x[:, 0] < 0.2, 1e3, 5e3)}
    s = mpm.Simulation(grid, bodies, [soil], walls=walls, conditions=contacts, **ends)
    probes = mpm.probes(bodies, [[0.2 - 1e-6, 0.13], [0.11, 0.4], [0.2 + gap + 1e-6, 0.2]])
    assert s.run(1.0, 1.0, probes=probes, progress=False).probe_pressure[0] == pytest.approx([1e3, 1e3, 5e3])


@pytest.mark.parametrize("place", [0.0, 0.5, 0.9, 1.0])
def test_no_pressure_passes_those_around_it_where_one_jumps(place):
    """Water carries the whole load, except on the drained side."""
    grid = mpm.Grid([0, 0], [0.2, 1.0], [2, 10])
    body, soil = mpm.box(grid, [0, 0], [0.2, 1]), mpm.LinearElastic(bulk=1e6, shear=1e6, conductivity=1e-6)
    walls, load = SIDES[2] | {"bottom": "y"}, [mpm.Traction("top", (0, -1e3))]
    water = {"fluid": mpm.Fluid(bulk=np.inf), "conditions": [mpm.Drained("top")]}
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=[*load, *water.pop("conditions", [])], **water)
    probes = mpm.probes([body], [[0.07, place + d] for d in (-0.03, 0.0, 0.03) if 0 <= place + d <= 1])
    p = s.run(0.1, 0.1, probes=probes, progress=False).probe_pressure[-1]
    most = s.cells().pressure.max()
    assert p.min() >= 0 and p.max() <= most * (1 + 1e-9) and (place == 1 or p.max() > 0.5 * most)


def stressed(grid, bodies, materials, field):
    """Return a simulation whose points have deformation gradients (n, d, d) as functions of position."""
    walls = {"bottom": "xyz"[: grid.dim]}
    s = mpm.Simulation(grid, bodies, materials, walls=walls)
    s.state = replace(s.state, points=replace(s.points, F=field(s.points)))
    return s


@pytest.mark.parametrize("dim, axisymmetric", [(2, False), (2, True), (3, False)], ids=["plane", "ring", "space"])
def test_a_linear_stress_is_exact_at_any_place_of_irregular_domains(dim, axisymmetric):
    """Also at sides, edges and corners, and next to other materials and bodies."""
    grid = mpm.Grid([0] * dim, [2.0] * dim, [5 if dim == 2 else 4] * dim, axisymmetric=axisymmetric)
    boxes = [mpm.box(grid, [a] + [0.0] * (dim - 1), [b] + [1.0] * (dim - 1), material=m) for a, b, m in PARTS]
    bodies = [mpm.mapped(grid, boxes[0], irregular), *boxes[1:]]
    soil, stretches = [mpm.LinearElastic(bulk=k, shear=k) for k in (1e6, 5e6)], grid.stretches
    slope = RANDOM.uniform(-1e-9, 1e-9, (3, dim, stretches, stretches))

    def field(points):
        of = np.searchsorted(np.cumsum([len(b) for b in bodies]), points.id, side="right")
        return np.eye(stretches) + np.einsum("nd,ndij->nij", points.x, slope[of])

    s = stressed(grid, bodies, soil, field)
    for i, body in enumerate(bodies):
        low, high = body.bounds
        X = low + RANDOM.uniform(size=(12, dim)) * (high - low)
        X[:2], X[2:4, 0] = [low, high], [low[0], high[0]]
        X = X + 1e-6 * (0.5 * (low + high) - X)
        probes = mpm.probes(bodies, X, stress=True)
        x = probes.position(s.points, grid.comm)
        e = np.zeros((len(x), 3, 3))
        e[:, :stretches, :stretches] = np.einsum("nd,dij->nij", x, slope[i])
        e = (e + e.swapaxes(1, 2)) / 2
        if axisymmetric:
            e[:, 2, :2] = e[:, :2, 2] = 0.0
        k = soil[body.material].bulk
        exact = (k - 2 * k / 3) * np.trace(e, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * k * e
        found = probe_stresses(s.scene, s.state, probes)
        assert found == pytest.approx(exact, abs=2e-6 * np.abs(exact).max())


PARTS = [(0.0, 1.0, 0), (1.0, 1.6, 1), (1.6, 2.0, 0)]


def test_no_probes_have_no_pressures():
    grid, law = mpm.Grid([0, 0], [1, 1], [2, 2]), mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5)
    body = mpm.box(grid, [0, 0], [1, 1])
    s = mpm.Simulation(grid, [body], [law], fluid=mpm.Fluid(), walls={"left": "xy"})
    result = s.run(1.0, 1.0, probes=mpm.probes([body], np.zeros((0, 2)), stress=True), progress=False)
    assert result.probe_pressure[-1].shape == (0,) and result.probe_stress[-1].shape == (0, 3, 3)
