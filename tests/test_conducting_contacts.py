# SPDX-License-Identifier: MIT
"""Pore fluid through closed contacts: two bodies are as one, layers, rest, slip, separation, restart, refusals."""

from itertools import pairwise

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.exact import terzaghi_pressure

E, WATER = 1e7, 9810.0  # Pa, N/m^3
INCOMPRESSIBLE = mpm.Fluid(bulk=np.inf)
WALLS = {
    2: {"bottom": "y", "left": "x", "right": "x"},
    3: {"bottom": "z", "left": "x", "right": "x", "front": "y", "back": "y"},
}


def stack(
    n=10, border=0.5, k=(1e-6, 1e-6), spacings=(2, 3), dim=2, sides=(), load=1e3, name="flow", ring=False, **options
):
    """Return a column, 1 m high, of two bodies in contact; without a name, the bodies are bonded."""
    w = 2 / n
    grid = mpm.Grid([0] * dim, [*[w] * (dim - 1), 1.2], [*[2] * (dim - 1), round(1.2 * n)], axisymmetric=ring)
    ends = [([*[0] * (dim - 1), a], [*[w] * (dim - 1), b]) for a, b in ((0, border), (border, 1.0))]
    bodies = [mpm.box(grid, *ends[i], per_cell=spacings[i], material=i) for i in (0, 1)]
    given = {"bulk": E / 3, "shear": E / 2, "porosity": 0.4, "grain_density": 2000}
    soils = [mpm.Hencky(**given, conductivity=each) for each in k]
    press = mpm.Traction("top", (*[0] * (dim - 1), -load), region=top(dim))
    contacts = [mpm.Contact(0, 1, conducts=True, name=name)] * (name is not None)
    options = {"fluid": mpm.Fluid(), "walls": WALLS[dim], "conditions": [press, *sides, *contacts], **options}
    return mpm.Simulation(grid, bodies, options.pop("soils", soils), **options)


def top(dim=2):
    return [*[-1] * (dim - 1), 1 - 1e-6], [2] * dim


def bottom(dim=2):
    return [-1] * dim, [*[2] * (dim - 1), 1e-6]


def profile(s):
    """Return the pressures of the cells, by height."""
    cell = s.cells()
    order = np.lexsort((cell.x[:, 0].round(9), cell.x[:, 1].round(9)))
    return cell.x[order, 1], cell.pressure[order]


@pytest.mark.parametrize("k", [(1e-6, 1e-6), (1e-6, 1e-4), (1e-5, 1e-7)])
def test_two_bodies_consolidate_as_one(k):
    """Of equal or different conductivity; the bonded bodies are compared with exact solutions elsewhere."""
    found = []
    for name in ("flow", None):
        s = stack(k=k, name=name, spacings=(2, 2), sides=[mpm.Drained("top", region=top())])
        s.run(50.0, 10.0, progress=False)
        assert s.result.balance < 1e-8
        found.append(np.interp(np.linspace(0.05, 0.95, 10), *profile(s)))
    two, one = found
    assert two == pytest.approx(one, abs=5e-4 * 1e3)
    assert np.ptp(one) > 100


def test_the_pressures_converge_to_those_of_terzaghi_with_second_order():
    """The border is off the grid lines, and the spacings of points differ."""
    errors, t = [], 20.0
    for n in (5, 10, 20):
        sides, steps = [mpm.Drained("top", region=top())], mpm.Numerics(tolerance=1e-10)
        s = stack(n, 0.53, k=(1e-5, 1e-5), load=1.0, sides=sides, numerics=steps, fluid=INCOMPRESSIBLE)
        s.run(t, t / 40, progress=False)
        points = s.points
        exact = terzaghi_pressure(1 - points.x[:, 1], t, 1.0, 1e-5 / WATER * E)
        errors.append(np.sqrt(np.average((points.pressure - exact) ** 2, weights=points.volume0)))
    assert errors[-1] < 1e-3
    assert np.log2(errors[0] / errors[1]) > 1.6 and np.log2(errors[1] / errors[2]) > 1.8


@pytest.mark.parametrize(
    ("border", "more"), [(0.5, {}), (0.53, {}), (0.57, {"ring": True}), (0.53, {"dim": 3, "n": 4})]
)
def test_steady_flow_across_is_exact(border, more):
    dim, k = more.get("dim", 2), (1e-4, 1e-6)
    sides = [mpm.Drained("top", 1.0, region=top(dim)), mpm.Drained("bottom", region=bottom(dim))]
    s = stack(border=border, k=k, sides=sides, load=2.0, fluid=INCOMPRESSIBLE, **more)
    s.run(1e15, 1e15, progress=False)
    width = s.grid.upper[0]
    area = np.pi * width**2 if more.get("ring") else width ** (dim - 1)
    exact = area / (WATER * (border / k[0] + (1 - border) / k[1]))
    assert s.outflows["flow"] == pytest.approx(-exact, rel=1e-12)  # from the upper body to the lower one
    assert s.outflows["drained_top"] == pytest.approx(-exact, rel=1e-12)


@pytest.mark.parametrize("ring", [False, True])
def test_water_at_rest_under_gravity_stays_there(ring):
    rest = {"gravity": [0, -10], "pressure": mpm.hydrostatic(1.0, 1e4), "initial_stress": mpm.K0(0.5), "ring": ring}
    s = stack(border=0.53, k=(1e-5, 1e-3), load=0.0, **rest)
    before = s.points.x.copy()
    s.run(100.0, 50.0, progress=False)
    assert np.abs(s.points.x - before).max() < 1e-12
    assert s.points.pressure == pytest.approx(1e4 * (1 - s.points.x[:, 1]), abs=1e-7)
    assert abs(s.outflows["flow"]) < 1e-17


@pytest.mark.parametrize("border", [0.5, 0.53])
def test_seepage_through_exponential_soils_is_exact(border):
    """Unsaturated: steady rain q on two soils of Gardner, whose heads are known."""
    k, a, q = (1e-6, 1e-5), (2.0, 5.0), 0.5e-6
    given = {"bulk": 1e13, "shear": 5e12, "porosity": 0.4}
    soils = [mpm.LinearElastic(**given, conductivity=k[i], retention=mpm.Gardner(WATER / a[i])) for i in (0, 1)]
    sides = [mpm.Drained("bottom", region=bottom()), mpm.Inflow("top", q, region=top())]
    rest = {"gravity": [0, -9.81], "initial_stress": mpm.K0(0.5), "pressure": lambda x: -0.1 * WATER * x[:, 1]}
    s = stack(20, border, soils=soils, sides=sides, load=0.0, fluid=INCOMPRESSIBLE, **rest)
    s.run(1e9, 2.5e8, progress=False)

    def heads(start, i, z):
        return np.log(q / k[i] + (np.exp(a[i] * start) - q / k[i]) * np.exp(-a[i] * z)) / a[i]

    z, p = profile(s)
    exact = np.where(z < border, heads(0, 0, z), heads(heads(0, 0, border), 1, z - border))
    assert p / WATER == pytest.approx(exact, abs=1e-8)


def sliding(friction, n=10):
    """Return a block that is pressed on another one, slides over its edge after 1 s, and is lifted after 3 s."""
    grid = mpm.Grid([0, 0], [2.2, 1.2], [2 * n + 2, n + 2])
    bodies = [mpm.box(grid, [0.2, 0], [1.6, 0.53]), mpm.box(grid, [1.0, 0.53], [1.5, 0.93], per_cell=3, material=1)]
    soils = [mpm.Hencky(bulk=E / 30, shear=E / 20, porosity=0.4, conductivity=k) for k in (1e-5, 1e-6)]
    above = ([0, 0.9], [2.2, 1.2])

    def path(t):
        return 0.15 * max(0.0, min(t, 3) - 1), 0.05 * max(0.0, t - 3) - 0.01 * min(t, 1)

    held = mpm.Displacement("top", lambda t, X: path(t), region=above)
    drained = mpm.Drained("left", region=([0, 0], [0.3, 1]))
    contact = mpm.Contact(1, 0, conducts=True, friction=friction, name="flow")
    water = {"fluid": mpm.Fluid(), "walls": {"bottom": "xy"}, "conditions": [held, drained, contact]}
    return mpm.Simulation(grid, bodies, soils, **water)


def test_a_sliding_block_conserves_the_fluid_and_conducts_no_more_when_it_is_lifted():
    s, flows = sliding(0.1), []
    s.run(4.0, 0.25, progress=False, observe=lambda s: flows.append((s.t, float(s.outflows["flow"]))))
    assert s.result.balance < 1e-8
    t, flows = np.array(flows).T
    assert (np.abs(flows[t <= 3]) > 1e-8).all()
    assert (flows[t > 3.01] == 0).all() and (t > 3.01).any()


def test_a_run_with_flow_through_a_contact_resumes_bit_for_bit(tmp_path):
    whole, parts, resumed = sliding(0.1), sliding(0.1), sliding(0.1)
    whole.run(1.25, 0.25, progress=False)
    parts.run(0.75, 0.25, checkpoint=mpm.Checkpoint(tmp_path / "half.npz"), progress=False)
    resumed.run(1.25, 0.25, after=mpm.resume(resumed, tmp_path / "half.npz"), progress=False)
    assert whole.outflows.array.tobytes() == resumed.outflows.array.tobytes()
    assert all(a.tobytes() == b.tobytes() for a, b in zip(whole.points.arrays, resumed.points.arrays, strict=True))


def inclined(n, along, angle=0.3):
    """Return the error of steady flow in two bodies inclined to the grid, and of the flow through their contact.

    The pressure gradient across the contact is 1 Pa/m, and `along` Pa/m along the contact.
    """
    c, s = np.cos(angle), np.sin(angle)
    turn, border, width = np.array([[c, -s], [s, c]]), 0.53, 0.8
    grid = mpm.Grid([-0.6, -0.1], [1.2, 1.5], [round(1.8 * n), round(1.6 * n)])
    boxes = [mpm.box(grid, [0, a], [width, b], per_cell=p) for a, b, p in ((0, border, 2), (border, 1, 3))]
    soil = mpm.Hencky(bulk=1e13, shear=1e13, porosity=0.4, conductivity=1e-4)

    def exact(x):
        return x @ turn @ (along, 1.0)

    regions = {"bottom": [([0, -1e-6], [width, 1e-6])], "top": [([0, 1 - 1e-6], [width, 1 + 1e-6])]}
    if along:
        ends = [
            ((0, border), "left", 0),
            ((border, 1), "left", 0),
            ((0, border), "right", width),
            ((border, 1), "right", width),
        ]
        for (low, high), side, x in ends:
            regions.setdefault(side, []).append(([x - 1e-6, low], [x + 1e-6, high]))
    sides = [mpm.Drained(side, exact, region=region) for side, of in regions.items() for region in of]
    sides += [mpm.Displacement(side, (0, 0), region=regions[side][0]) for side in ("bottom", "top")]
    contact = mpm.Contact(0, 1, conducts=True, name="flow")
    bodies = [mpm.mapped(grid, box, lambda x: x @ turn.T) for box in boxes]
    s = mpm.Simulation(grid, bodies, [soil], walls={}, conditions=[*sides, contact], fluid=INCOMPRESSIBLE)
    s.run(5e15, 1e15, progress=False)
    error = np.sqrt(((s.points.pressure - exact(s.points.x)) ** 2).mean())
    return error, s.outflows["flow"] / (-width * 1e-4 / WATER) - 1


@pytest.mark.parametrize("along", [0.0, 1.0])
def test_flow_through_a_contact_inclined_to_the_grid_converges(along):
    """Without the non-orthogonal correction, flows would have errors of 0.4 to 0.9 % with 10 cells."""
    (coarse, flow), (fine, _) = (inclined(n, along) for n in (10, 20))
    assert coarse < 5e-3 and abs(flow) < 2e-3
    assert np.log2(coarse / fine) > 1.2


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_of_three_groups_those_conduct_that_should(order):
    """The lowest block drains into the base, the middle one through it; the highest one keeps its pressure."""
    grid, heights = mpm.Grid([0, 0], [0.2, 1.2], [2, 12]), (0, 0.3, 0.62, 1)
    boxes = [mpm.box(grid, [0, a], [0.2, b]) for a, b in pairwise(heights)]
    low, middle, high = (order.index(i) for i in range(3))
    contacts = [mpm.Contact(high, middle), mpm.Contact(low, high), mpm.Contact(middle, low, conducts=True, name="flow")]
    sides = [mpm.Drained("bottom", region=bottom()), mpm.Traction("top", (0, -1e3), region=top())]
    soil = mpm.Hencky(bulk=E / 3, shear=E / 2, porosity=0.4, conductivity=1e-4)
    water = {"fluid": mpm.Fluid(), "walls": WALLS[2], "conditions": [*contacts, *sides]}
    s = mpm.Simulation(grid, [boxes[i] for i in order], [soil], **water)
    s.run(5.0, 0.5, progress=False)
    p, upper = s.points.pressure, s.points.x[:, 1] > 0.62
    assert p[upper] == pytest.approx(np.full(upper.sum(), p[upper].mean()), rel=1e-3) and p[upper].mean() > 900
    assert p[~upper].max() < 600
    assert set(s.outflows) == {"flow", "drained_bottom"}
    assert 0 < s.outflows["flow"] < s.outflows["drained_bottom"]


def test_a_contact_that_conducts_needs_a_fluid():
    with pytest.raises(ValueError, match=r"flow: Contact\(.*conducts=True\), must be in a scene with fluid"):
        stack(fluid=None)


def test_conducts_is_true_or_false():
    with pytest.raises(ValueError, match="Contact: conducts = 'no', must be True or False"):
        mpm.Contact(0, 1, conducts="no")
