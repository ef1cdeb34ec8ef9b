# SPDX-License-Identifier: MIT
"""Initial stresses and pressures: in equilibrium at once, with the response to later loads as after loading."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

WEIGHT = 9810.0
WATER = {"porosity": 0.4, "conductivity": 1e-6}
CLAY = {"M": 1.2, "lambda_": 0.07, "kappa": 0.015, "shear": 3e6, "initial_stress": (-1e5,) * 3, "OCR": 2.0}
LAWS = {
    "hencky": lambda E, **more: mpm.Hencky(bulk=E, shear=E / 2, **more),
    "linear": lambda E, **more: mpm.LinearElastic(bulk=E, shear=E / 2, **more),
    "mohr-coulomb": lambda E, **more: mpm.MohrCoulomb(
        bulk=E, shear=E / 2, friction=30, dilation=0, cohesion=1e3, **more
    ),
    "cam clay": lambda E, **more: mpm.ModifiedCamClay(**CLAY, **more),
}


def ground(law="hencky", dim=2, off=0.13, level=2.0, axisymmetric=False, later=False, **options):
    """Return two layers, 3 m, with interface and surface off the grid lines and a phreatic level within."""
    width = [2.0] if dim == 2 else [1.0, 1.0]
    grid = mpm.Grid([0] * dim, [*width, 4.0], [*(round(2 * w) for w in width), 8], axisymmetric=axisymmetric)
    bodies = [
        mpm.box(grid, [*[0.0] * (dim - 1), low], [*width, high], material=m)
        for m, (low, high) in enumerate([(0.0, 1 + off), (1 + off, 3 + off)])
    ]
    if later:
        bodies[1] = mpm.Later(bodies[1])
    every = {"left": "x", "right": "x", "front": "y", "back": "y", "bottom": "xyz"[dim - 1]}
    walls = {name: axes for name, axes in every.items() if dim == 3 or name not in ("front", "back")}
    materials = [LAWS[law](1e7, **WATER), LAWS[law](6e6, **{**WATER, "porosity": 0.3})]
    return mpm.Simulation(
        grid,
        bodies,
        materials,
        fluid=mpm.Fluid(),
        walls=walls,
        **{
            "gravity": [*[0.0] * (dim - 1), -9.81],
            "pressure": mpm.hydrostatic(level),
            "initial_stress": mpm.K0(0.5),
            **options,
        },
    )


def vertical(y, off=0.13, level=2.0):
    """Return the exact vertical effective stress, in Pa."""
    upper, lower = 9.81 * (0.7 * 2650 + 300), 9.81 * (0.6 * 2650 + 400)
    weight = upper * (3 + off - np.maximum(y, 1 + off)) + lower * np.maximum(1 + off - y, 0)
    return -weight + WEIGHT * (level - y)


def moved(s):
    """Return the largest displacement of corners, in m."""
    return np.abs(s.points.corners - s.points.origin).max()


@pytest.mark.parametrize(
    "law, dim, axisymmetric",
    [
        *((law, 2, False) for law in LAWS),
        ("hencky", 2, True),
        ("mohr-coulomb", 2, True),
        pytest.param("hencky", 3, False, marks=pytest.mark.slow),
        pytest.param("linear", 2, True, marks=pytest.mark.slow),
        pytest.param("cam clay", 2, True, marks=pytest.mark.slow),
    ],
)
def test_layered_soil_at_rest_is_not_moved_by_a_first_step(law, dim, axisymmetric):
    s = ground(law, dim, axisymmetric=axisymmetric)
    fields, y = s.point_fields(), s.points.x[:, -1]
    exact = vertical(y)
    stress = fields.effective_stress
    assert stress[:, dim - 1, dim - 1] == pytest.approx(exact, abs=0.02 * np.abs(exact).max())
    for axis in {0, 1, 2} - {dim - 1}:
        assert stress[:, axis, axis] == pytest.approx(exact / 2, abs=0.02 * np.abs(exact).max())
    for dt in (1.0, 1e4):
        s.run(s.t + dt, dt, progress=False)
        assert moved(s) < 1e-9
    assert s.points.F == pytest.approx(np.tile(np.eye(s.grid.stretches), (len(s.points), 1, 1)), abs=1e-12)


def test_along_the_grid_stresses_at_rest_are_the_exact_ones():
    s = ground(off=0.0)
    exact = vertical(s.points.x[:, 1], off=0.0)
    stress = s.point_fields().effective_stress
    assert stress[:, 1, 1] == pytest.approx(exact, rel=1e-9)
    assert stress[:, 2, 2] == pytest.approx(exact / 2, rel=1e-9)


def slope(level, soil, h=0.25, axisymmetric=False, **options):
    """Return a bank with an inclined side, wet up to a level, or a mound."""
    grid = mpm.Grid([0, 0], [5.5, 3.0], [round(5.5 / h), round(3 / h)], axisymmetric=axisymmetric)
    bank = mpm.mapped(
        grid, mpm.box(grid, [0, 0], [5.1, 2.2]), lambda X: np.stack([X[:, 0] * (1 - X[:, 1] / 4.4), X[:, 1]], axis=1)
    )
    loads, heads = zip(*(mpm.water(side, level) for side in ("right", "top")), strict=True)
    return mpm.Simulation(
        grid,
        [bank],
        [soil],
        fluid=mpm.Fluid(),
        conditions=[*loads, *heads, *options.pop("conditions", [])],
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(level),
        initial_stress=mpm.K0(0.5, surcharge=lambda x: WEIGHT * np.maximum(level - x[:, 1], 0.0)),
        **{"walls": {"left": "x", "bottom": "xy"}, **options},
    )


HELD = {"walls": {"left": "x"}, "conditions": [mpm.Displacement("bottom", (0, 0))]}
"""Holds the base of such a bank in place of the wall."""


@pytest.mark.parametrize("level, axisymmetric, h", [(0.83, False, 0.25), (3.0, False, 0.5), (0.83, True, 0.5)])
def test_a_bank_in_still_water_stays_where_it_is(level, axisymmetric, h):
    """The bank is partly submerged: neither soil nor water moves."""
    soil = mpm.MohrCoulomb(bulk=5e6, shear=2.5e6, friction=35, dilation=0, cohesion=5e3, **WATER)
    s = slope(level, soil, h, axisymmetric)
    for dt in (1.0, 1e4):
        s.run(s.t + dt, dt, progress=False)
        assert moved(s) < 1e-9 * 2.2 and np.abs(s.outflows.array).max() < 1e-9 * 1e-6
    s.stage(gravity=(0, -9.0))
    s.run(s.t + 1e4, 1e4, progress=False)
    assert moved(s) > 1e-5


def oedometric(stress, law):
    """Return the stretch of laterally confined soil under a vertical Cauchy stress (below about 1e6 Pa)."""
    K, G = 2e6, 1e6
    of = {
        "hencky": lambda x: (K + 4 * G / 3) * np.log(x) / x,
        "linear": lambda x: (K + 4 * G / 3) * (x - 1),  # its first Piola-Kirchhoff stress, here the same
    }[law]
    x = np.linspace(0.5, 1.0, 200001)
    return np.interp(stress, of(x), x)


@pytest.mark.parametrize("law, axisymmetric", [("hencky", False), ("linear", False), ("hencky", True)])
def test_soil_is_loaded_on_as_if_its_stress_had_come_by_loading(law, axisymmetric):
    """The initial stress is a tenth of the modulus; then half as much is added. The stretch must be exact."""
    grid = mpm.Grid([0, 0], [0.5, 1.2], [2, 12], axisymmetric=axisymmetric)
    column, first, second = mpm.box(grid, [0, 0], [0.5, 1.0]), -3e5, -4.5e5
    material = {"hencky": mpm.Hencky, "linear": mpm.LinearElastic}[law](bulk=2e6, shear=1e6, porosity=0.4)
    stretch = oedometric(first, law)
    lateral = {"hencky": 1 / stretch * np.log(stretch), "linear": stretch * 0 + (stretch - 1) / stretch}[law] * (
        2e6 - 2e6 / 3
    )
    s = mpm.Simulation(
        grid,
        [column],
        [material],
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[mpm.Traction("top", lambda t: (0, first if t == 0 else second))],
        initial_stress=lambda x: np.tile([lateral, first, lateral], (len(x), 1)),
    )
    probe = mpm.probes([column], [[0.25, 1.0]])
    settled = s.run(1.0, 1.0, probes=probe, progress=False).displacement[-1][0, 1]
    assert settled == pytest.approx(oedometric(second, law) / stretch - 1, rel=1e-6)
    assert s.point_fields().porosity == pytest.approx(1 - 0.6 / (1 + settled), rel=1e-6)


def test_clay_is_at_its_own_pressure_and_overconsolidation_everywhere():
    s = ground("cam clay", off=0.0)
    fields, data = s.point_fields(), s.points.data
    p, q = fields.mean_effective_stress, fields.deviatoric_stress
    clay = s.scene.materials.materials[0]
    size = s.scene.materials.table(s.points, lambda m: m.yield_pressure)
    assert size == pytest.approx(2.0 * (p + q**2 / (1.2**2 * p)), rel=1e-9)
    assert data["bulk"] == pytest.approx(p / clay.kappa, rel=1e-9)


def test_a_fill_has_the_stress_that_it_is_given_and_else_none():
    for given in (None, mpm.K0(1.0)):
        more = {} if given is None else {1: given}
        s = ground(off=0.0, initial_stress={0: mpm.K0(0.5), **more}, later=True, level=0.0)
        s.stage(add=[1])
        stress = s.point_fields().effective_stress[s.points.id >= 16 * 4]
        y = s.points.x[s.points.id >= 16 * 4, 1]
        exact = vertical(y, 0.0, 0.0) if given else np.zeros(len(y))
        assert stress[:, 1, 1] == pytest.approx(exact, rel=1e-9) and stress[:, 0, 0] == pytest.approx(exact, rel=1e-9)


def test_a_checkpoint_holds_all_of_it(tmp_path):
    soil, states = mpm.Hencky(bulk=5e6, shear=2.5e6, **WATER), []
    for _ in range(2):
        s = slope(1.1, soil, h=0.5, **HELD)
        if not states:
            s.run(10.0, 10.0, progress=False, checkpoint=mpm.Checkpoint(tmp_path / "a"))
        else:
            mpm.resume(s, tmp_path / "a")
        states.append(s.state)
        assert s.state.held is not None
        s.run(20.0, 10.0, after=s.result, progress=False)
        assert moved(s) < 2e-9
    assert states[1].held.tolist() == states[0].held.tolist()
    assert states[1].rest.tolist() == states[0].rest.tolist() and np.abs(states[0].rest).max() > 0


PAIRS = {
    "hencky": lambda: mpm.Hencky(bulk=1e7, shear=6e6),
    "by place": lambda: mpm.Hencky(bulk=lambda X: 1e7 + 1e6 * X[:, 1], shear=6e6),
    "sand": lambda: mpm.MohrCoulomb(bulk=1e7, shear=6e6, friction=35, dilation=0, cohesion=1e3),
    "clay": lambda: mpm.ModifiedCamClay(**CLAY),
}


@pytest.mark.parametrize("below, above", [(a, b) for a in PAIRS for b in PAIRS if {a, b} & {"sand", "clay"} and a != b])
def test_laws_may_lie_on_one_another_in_any_order(below, above):
    """Three points for each law, as many as axes of a tensor, with their initial stress."""
    grid = mpm.Grid([0, 0], [0.5, 4.0], [1, 8])
    layers = [mpm.box(grid, [0, y], [0.5, y + 1.5], per_cell=1, material=m) for m, y in enumerate((0, 1.5))]
    walls, load = {"left": "x", "right": "x", "bottom": "y"}, {"conditions": [mpm.Traction("top", -1e3)]}
    s = mpm.Simulation(
        grid,
        layers,
        [PAIRS[below](), PAIRS[above]()],
        walls=walls,
        gravity=(0, -9.81),
        initial_stress=mpm.K0(0.6, surcharge=1e3),
        **load,
    )
    exact = -1e3 - 9.81 * 0.6 * 2650 * (3 - s.points.x[:, 1])
    stress = s.point_fields().effective_stress
    assert stress[:, 1, 1] == pytest.approx(exact, rel=1e-9)
    for axis in (0, 2):
        assert stress[:, axis, axis] == pytest.approx(0.6 * exact, rel=1e-9)
    s.step(1.0)
    assert moved(s) < 1e-9


def test_forces_that_hold_a_rest_go_where_the_body_moves_or_is_dug_away():
    s = slope(3.0, mpm.Hencky(bulk=5e6, shear=2.5e6, **WATER))
    s.stage(conditions=[])
    s.run(1e6, 1e6, progress=False)
    assert moved(s) > 1e-3 and s.state.held is None


@pytest.mark.parametrize(
    "options, said",
    [
        ({"initial_stress": mpm.Hencky}, "must be"),
        ({"initial_stress": 3.0}, "initial_stress: {0: 3.0}, must be a K0"),
        ({"initial_stress": {7: mpm.K0(0.5)}}, "initial_stress: {7: K0"),
        ({"initial_stress": lambda x: x}, "must be three normal stresses or a symmetric tensor"),
        ({"gravity": (1.0, -9.81)}, r"K0 with gravity = \[1.0, -9.81\], gravity must point down"),
        ({"pressure": lambda x: np.nan}, r"pressure\(x\) = nan, must be a finite number, or one for each"),
        ({"law": "mohr-coulomb", "initial_stress": mpm.K0(0.1)}, "for soil too weak for this stress, omit"),
        ({"law": "mohr-coulomb", "initial_stress": mpm.K0(5.0)}, r"principal stresses .* degrees allows K0 from .* to"),
        ({"law": "mohr-coulomb", "level": 6.0}, "K0 needs the weight of open water as surcharge"),
        ({"law": "cam clay", "initial_stress": lambda x: np.tile([0, 1e4, 0], (len(x), 1))}, "a compressive mean"),
    ],
)
def test_what_is_no_initial_state_is_refused(options, said):
    with pytest.raises(ValueError, match=said):
        ground(**options)


@pytest.mark.parametrize("law", ["hencky", "linear"])
def test_open_water_without_a_surcharge_is_warned_of(law, recwarn):
    """Elastic soil started in tension, without a warning.  Frictional soil is refused."""
    ground(law, level=2.9), ground(law, level=6.0, initial_stress=mpm.K0(0.5, surcharge=2.87 * WEIGHT))
    assert not [one for one in recwarn if "tension" in str(one.message)]
    with pytest.warns(mpm.ConditionWarning, match="K0 gives vertical tension, such as .* water as surcharge"):
        ground(law, level=6.0)


def test_loads_beyond_the_limit_load_have_no_initial_state():
    """A vertical cut, 2 m high, under a load on its crest."""
    grid = mpm.Grid([0, 0], [6, 3], [12, 6])
    clay = mpm.MohrCoulomb(bulk=5e7, shear=1e7, friction=0.0, dilation=0.0, cohesion=2e4)
    load, cut = mpm.Traction("top", (0, -6e4)), [mpm.box(grid, [0, 0], [4, 2])]
    options = {"walls": {"left": "x", "bottom": "xy"}, "gravity": (0, -9.81), "conditions": [load]}
    with pytest.raises(ValueError, match="limit load, omit initial_stress or apply them in later"):
        mpm.Simulation(grid, cut, [clay], initial_stress=mpm.K0(0.8), **options)


@pytest.mark.parametrize("value", [-0.1, np.inf, "half"])
def test_what_is_no_ratio_is_refused(value):
    with pytest.raises(ValueError, match="K0: ratio = "):
        mpm.K0(value)


def test_a_stage_changes_what_was_given_as_a_function_of_place_only():
    grid = mpm.Grid([0, 0], [0.5, 1.25], [2, 5])
    body = mpm.box(grid, [0, 0], [0.5, 1])
    soil = mpm.Hencky(bulk=1e6, shear=5e5, conductivity=lambda X: np.zeros(len(X)))
    s = mpm.Simulation(
        grid,
        [body],
        [soil],
        fluid=mpm.Fluid(),
        walls={"bottom": "y", "left": "x", "right": "x"},
        conditions=[mpm.Drained("top", 1e3)],
    )
    s.run(10.0, 10.0, progress=False)
    assert np.abs(s.points.pressure).max() < 1e-9
    s.stage(fields={"conductivity": 1e-3})
    s.run(1e4, 1e3, progress=False)
    assert s.points.pressure == pytest.approx(1e3, rel=1e-3)
    with pytest.raises(
        ValueError, match="'shear': a constant of Hencky, must be given to it as a function of position"
    ):
        s.stage(fields={"shear": np.full(len(s.points), 4e5)})


def test_soil_whose_strain_is_lost_in_rounding_bears_an_initial_stress():
    grid = mpm.Grid([0, 0], [1.0, 1.0], [5, 5])
    body = mpm.box(grid, [0, 0], [1.0, 0.8])
    rock = mpm.LinearElastic(bulk=1e12, shear=5e11)
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    given = {"initial_stress": lambda x: np.full((len(x), 3), -1e4), "conditions": [mpm.Traction("top", (0, -1e4))]}
    s = mpm.Simulation(grid, [body], [rock], walls=walls, **given)
    assert s.effective_stress()[:, [0, 1], [0, 1]] == pytest.approx(-1e4, rel=1e-6)
