# SPDX-License-Identifier: MIT
"""Side conditions as functions of time and position: loads, heads and inflows."""

from functools import partial

import numpy as np
import pytest
from helpers import column, rates, refused_in_one_line

import mpm_dolfinx as mpm

GRID = mpm.Grid([0, 0], [1.2, 1.2], [12, 12])
SOIL = mpm.Hencky(bulk=1e6, shear=6e5)
WALLS = {"left": "x", "bottom": "y"}
WEIGHT = 9810.0  # of water, N/m^3


def block(*tractions, walls=WALLS, **options):
    """Return a block after a step under tractions."""
    body = mpm.box(GRID, [0, 0], [1, 1])
    s = mpm.Simulation(
        GRID, [body], [SOIL], walls=walls, conditions=[*tractions, *options.pop("conditions", [])], **options
    )
    s.run(1.0, 0.5, progress=False)
    return s


def test_a_traction_of_places_is_the_sum_of_those_of_regions():
    steps = [
        mpm.Traction("right", (4e3, 0), region=((0, 0), (2, 0.45))),
        mpm.Traction("right", -2e3, region=((0, 0.45), (2, 2))),
    ]
    vectors = mpm.Traction("right", lambda X: np.where(X[:, [1]] < 0.45, [4e3, 0.0], [-2e3, 0.0]))
    normal = mpm.Traction("right", lambda t, X: np.where(X[:, 1] < 0.45, 4e3, -2e3) * min(1, t + 0.5))
    apart = block(*steps).points
    for load in (
        vectors,
        normal,
    ):  # 0.45 lies within faces: where the points of integration are, it is a little blurred
        assert block(load).points.x == pytest.approx(apart.x, abs=2e-4)
    even = block(mpm.Traction("right", lambda t, X: np.full(len(X), 4e3)))
    assert even.points.x == pytest.approx(block(mpm.Traction("right", 4e3)).points.x, abs=1e-13)


def test_a_pressure_of_depth_is_exact_in_its_resultant():
    given = mpm.Displacement("left", (0, 0))
    depth = mpm.Pressure("right", lambda x: 5e3 * (1 - x[:, 1]))
    s = block(depth, conditions=[given], walls={"bottom": "y"})
    area = s.points.corners[:, [1, 3]][np.abs(s.points.reference[:, 1, 0] - 1) < 1e-9]
    y = area[:, :, 1]
    push = (5e3 * (1 - y.mean(axis=1)) * np.diff(y, axis=1)[:, 0]).sum()
    assert s.reactions.array[0, 0] == pytest.approx(push, rel=1e-3)


def test_a_side_under_a_level_that_rises_is_at_rest():
    """A block in water at rest: total stress and pore pressure follow the level; the effective stress is constant."""
    level = lambda t: 1.0 + 0.5 * t  # noqa: E731
    depth = lambda t, x: WEIGHT * (level(t) - x[:, 1])  # noqa: E731
    body = mpm.box(GRID, [0, 0], [1.2, 1])
    s = mpm.Simulation(
        GRID,
        [body],
        [mpm.Hencky(bulk=1e7, shear=6e6, conductivity=1.0, grain_density=1000)],
        fluid=mpm.Fluid(density=1000, bulk=2.2e9),
        walls={"left": "x", "right": "x", "bottom": "y"},
        gravity=(0, -9.81),
        conditions=[mpm.Pressure("top", depth), mpm.Drained("top", depth)],
    )
    s.run(20.0, 2.0, progress=False)
    want = WEIGHT * (level(20.0) - s.points.x[:, 1])
    assert s.points.pressure == pytest.approx(want, rel=2e-4)
    assert np.abs(s.effective_stress()).max() < 0.01 * WEIGHT


@pytest.mark.parametrize("name", ["drained", "inflows"])
def test_heads_and_inflows_of_time_are_of_second_order(name):
    stiff = mpm.Hencky(bulk=1e9 / 3, shear=5e8, porosity=0.4, conductivity=4e-6)  # nothing moves, c = 0.4 m^2/s

    def top(steps):
        if name == "drained":
            sides = {"conditions": [mpm.Drained("top", lambda t: 1e4 * np.sin(2 * t))]}
        else:
            into = mpm.Inflow("top", lambda t, X: 1e-6 * np.sin(2 * t) * np.ones(len(X)))
            sides = {"conditions": [into, mpm.Drained("bottom")]}
        s = column(cells=10, material=stiff, **sides)
        s.run(4.0, 4.0 / steps, progress=False)
        return s.points.pressure[s.points.x[:, 1] < 0.5]  # at the side itself the order rises to 2 later

    exact = top(160)
    errors = [np.abs(top(n) - exact).max() / np.abs(exact).max() for n in (10, 20, 40)]
    assert min(rates(errors)) > 1.8 and errors[-1] < 5e-3, errors


def test_water_flows_from_side_to_side_by_the_heads_of_its_ends():
    """A block between two heads: Darcy's flux and linear pressures, at any position of its ends on the grid."""
    body = mpm.box(GRID, [0.03, 0], [1.04, 1])
    k, heads = 1e-3, lambda X: np.where(X[:, 0] < 0.5, 2e4, 5e3)
    s = mpm.Simulation(
        GRID,
        [body],
        [mpm.Hencky(bulk=1e9, shear=6e8, conductivity=k)],
        fluid=mpm.Fluid(),
        walls={"left": "x", "bottom": "xy"},
        conditions=[mpm.Drained("left", heads), mpm.Drained("right", heads)],
    )
    s.run(100.0, 50.0, progress=False)
    want = 2e4 - 1.5e4 * (s.points.x[:, 0] - 0.03) / 1.01
    assert s.points.pressure == pytest.approx(want, rel=1e-3)


KINDS = {
    "Traction": lambda value: mpm.Traction("top", value).at,
    "Pressure": lambda value: mpm.Pressure("top", value).at,
    "Drained": lambda value: mpm.Drained("top", value).at,
    "Inflow": lambda value: mpm.Inflow("top", value).at,
    "Displacement": lambda value: mpm.Displacement("top", value).at,
}
FORMS = {  # what a function may give, and whether it is then one for each place
    "number": (lambda x: 3.0, False),
    "number a place": (lambda x: x[:, 0], False),
    "vector": (lambda x: np.arange(x.shape[1]) - 5.0, True),
    "vector a place": (lambda x: 2 * x, True),
}


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("m", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("form", FORMS)
def test_what_a_function_gives_is_read_alike_at_any_number_of_places(form, m, d):
    """Earlier, a vector with as many entries as components was refused, or read as a number for each position, on some
    processes.
    """
    function, vectors = FORMS[form]
    X = np.random.default_rng(m).random((m, d))
    want = np.broadcast_to(function(X) if m else 0.0, (m, d) if vectors else (m,))
    got = mpm.Traction("top", lambda x: function(x)).at(0.0, d, lambda name: X)
    assert len(got) == 0 if not m else np.array_equal(np.broadcast_to(got, want.shape), want) and got.ndim <= want.ndim
    if vectors:
        assert np.array_equal(mpm.Displacement("top", lambda X: function(X)).at(0.0, X), want)
    else:
        for kind in ("Pressure", "Drained", "Inflow"):
            got = KINDS[kind](lambda t, x: function(x))(0.0, lambda name: X)
            assert np.array_equal(np.broadcast_to(got, (m,)), want), kind


@pytest.mark.parametrize("cells", [1, 2])
def test_a_vector_for_all_places_acts_as_one_without_places(cells):
    grid = mpm.Grid([0, 0], [cells / 2, 1.0], [cells, 4])
    body, walls = mpm.box(grid, [0, 0], [cells / 2, 0.75], per_cell=1), {"left": "x", "right": "x", "bottom": "y"}

    def places(value):
        s = mpm.Simulation(grid, [body], [SOIL], walls=walls, conditions=[mpm.Traction("top", value)])
        s.run(1.0, 1.0, progress=False)
        return s.points.x

    assert np.array_equal(places(lambda t, x: (0, -1e5)), places((0, -1e5)))


@pytest.mark.parametrize("kind", KINDS)
def test_functions_are_called_by_the_names_of_their_parameters(kind):
    X, now = np.array([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0]]), np.array([[0.0, 3.0], [1.0, 3.0], [2.0, 3.0]])
    vector = (lambda v: np.stack([0 * v, v], axis=-1)) if kind == "Displacement" else (lambda v: v)
    places = lambda name: {"X": X, "x": now}[name]  # noqa: E731

    def at(function):
        more = {"Traction": [2, places], "Displacement": [X]}.get(kind, [places])
        values = KINDS[kind](function)(5.0, *more)
        return values[..., 1] if kind == "Displacement" else values

    for of_time in (lambda t: vector(2.0 * t), lambda time: vector(2.0 * time), lambda s, k=2.0: vector(k * s)):
        assert at(of_time) == pytest.approx(10.0)
    for of_places in (lambda X: vector(X[:, 0]), lambda X, t: vector(X[:, 0] + t - 5), lambda *, X: vector(X[:, 0])):
        assert at(of_places) == pytest.approx([0.0, 1.0, 2.0])
    if kind != "Displacement":
        assert at(lambda x, t: x[:, 1] * t) == pytest.approx(15.0)
        assert at(mpm.hydrostatic(4.0, 10.0)) == pytest.approx(10.0)
        assert at(mpm.water("top", lambda t: t, unit_weight=10.0)[1].pressure) == pytest.approx(20.0)

    class Interpolated:  # as those of scipy, whose x may well be the time
        def __call__(self, x):
            return x

    table = partial(np.interp, xp=[0.0, 1.0], fp=[0.0, 1.0])  # of x, which is no place
    wrong = [lambda s, x: 1.0, lambda t, depth: 1.0, lambda: 1.0, lambda **k: 1.0, Interpolated(), table]
    for function in wrong + [lambda x: 1.0] * (kind == "Displacement"):
        with pytest.raises(ValueError, match=f"^{kind}.* must be .*") as caught:
            at(function)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "make",
    [
        lambda f: mpm.RigidPlate("top", f),
        lambda f: mpm.Tool(mpm.Ball((0, 0), 1.0), displacement=f),
        lambda f: mpm.Tool(mpm.Ball((0, 0), 1.0), rotation_rad=f),
        lambda f: mpm.Tool(mpm.Ball((0, 0), 1.0), load=f, direction=(0, 1)),
        lambda f: mpm.water("top", f),
        lambda f: block(gravity=f),
    ],
    ids=["plate", "displacement", "rotation", "load", "level", "gravity"],
)
def test_functions_of_time_alone_are_none_of_places(make):
    """Earlier, a function of x was called with the time."""
    with pytest.raises(ValueError, match=r"a function of \(x\), must be a function of the time alone"):
        make(lambda x: 1.0)


def test_what_a_condition_was_given_is_its_own():
    """Earlier, a load and gravity changed with arrays and lists that a script continued to use."""
    value, region, gravity, loads = np.array([0.0, -1e4]), [[0, 0], [2, 2]], np.array([0.0, -9.81]), []
    loads.append(mpm.Traction("top", value, region))
    walls = dict(WALLS)
    s = mpm.Simulation(GRID, [mpm.box(GRID, [0, 0], [1, 1])], [SOIL], walls=walls, conditions=loads, gravity=gravity)
    value[:], region[1][0], gravity[:], walls["bottom"] = 1e9, 0.1, 1e9, "x"
    loads.append(mpm.Traction("top", (0, 1e9)))
    s.stage(conditions=s.conditions)
    s.run(1.0, 0.5, progress=False)
    same = block(mpm.Traction("top", (0, -1e4)), gravity=(0, -9.81))
    assert s.points.x == pytest.approx(same.points.x, abs=1e-12)


BAD = {
    "of another argument": (
        lambda: block(mpm.Traction("top", lambda t, depth: 1.0)),
        "Traction(side='top'",
        "t, X or x",
    ),
    "of too few places": (lambda: block(mpm.Pressure("top", lambda X: X[:3, 0])), "Pressure(side='top'", "places"),
    "of nan": (lambda: block(mpm.Traction("top", lambda x: x[:, 0] * np.nan)), "Traction(side='top'", "nan"),
    "that raise": (lambda: block(mpm.Traction("top", lambda x: 1 / 0)), "Traction(side='top'", "ZeroDivisionError"),
    "vectors of pressure": (lambda: block(mpm.Pressure("top", lambda x: x)), "Pressure(side='top'", "places"),
    "three components": (lambda: block(mpm.Traction("top", lambda x: (0, 1, 0))), "Traction(side='top'", "places"),
    "a word": (lambda: mpm.Drained("top", "dry"), "Drained: pressure", "'dry'"),
    "of a head": (
        lambda: column(conditions=[mpm.Drained("top", lambda t: "high")]).step(1.0),
        "Drained(side='top'",
        "'high'",
    ),
}


@pytest.mark.parametrize(("make", "name", "value"), BAD.values(), ids=BAD)
def test_bad_functions_are_refused_in_one_line(make, name, value, tmp_path):
    refused_in_one_line(make, name, value, tmp_path, 400)


@pytest.mark.parametrize("condition", [mpm.Inflow("top", 1e-4), mpm.Rain("top", 1e-4)], ids=["inflow", "rain"])
@pytest.mark.parametrize("axisymmetric", [False, True])
def test_a_flux_per_current_area_grows_with_a_side_that_is_stretched(condition, axisymmetric):
    """Earlier, the area at the start of each step counted: volumes were 0.9 % (1.8 %) too small in steps of 2 %."""
    grid = mpm.Grid([0, 0], [1.6, 1.0], [16, 10], axisymmetric=axisymmetric)
    pull = mpm.Displacement("right", lambda t: (0.2 * t, 0), "x")
    body, soil = mpm.box(grid, [0, 0], [1, 0.53]), mpm.Hencky(bulk=2e5, shear=1e5, porosity=0.4, conductivity=1e-2)
    conditions, walls = [pull, condition, mpm.Drained("right")], {"left": "x", "bottom": "y"}
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=conditions, fluid=mpm.Fluid())
    result = s.run(1.0, 0.1, progress=False)
    volume = 1e-4 * (np.pi * (1.2**3 - 1) / 0.6 if axisymmetric else 1.1)
    rate = 1e-4 * (np.pi * 1.2**2 if axisymmetric else 1.2)
    name = next(name for name in s.outflows if name != "drained_right")
    assert -s.outcome("flowed")[name] == pytest.approx(volume, rel=1e-3)
    assert -s.outflows[name] == pytest.approx(rate, rel=1e-3)
    assert result.balance < 1e-8
    if isinstance(condition, mpm.Rain):
        assert s.outcome("rained")[name] == pytest.approx(-s.outcome("flowed")[name], rel=1e-12)
