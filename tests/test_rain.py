# SPDX-License-Identifier: MIT
"""Rain infiltrates until the surface ponds, then runs off; water evaporates until the surface is dry."""

import warnings
from functools import cache

import numpy as np
import pytest
import rain
import ufl
from richards import infiltration
from test_unsaturated import STIFF, WATER, column, water

import mpm_dolfinx as mpm
from mpm_dolfinx.conditions.jumps import before_jumps

K = 1e-5  # m/s


def rained(flux, cells=10, retention=True, **options):
    """Return a column with a head of 0.2 m at its base, and rain on its top."""
    law = mpm.VanGenuchten(WATER / 3.35, residual=0.1, n=2.0) if retention else None
    soil = mpm.LinearElastic(**STIFF, porosity=0.4, conductivity=K, retention=law)
    sides = [mpm.Drained("bottom", pressure=0.2 * WATER), mpm.Rain("top", flux, name="rain", **options)]
    return column(cells, [soil], mpm.hydrostatic(0.2), sides, initial_stress=mpm.K0(0.5))


@pytest.mark.parametrize("retention", [True, False])
@pytest.mark.parametrize(("depth", "flows"), [(0.0, 0.8), pytest.param(0.05, 0.85, marks=pytest.mark.slow)])
def test_rain_beyond_what_soil_takes_ponds_and_runs_off(retention, depth, flows):
    """Steady state: Darcy flow between pond and base. The rest of a rain of three times the conductivity runs off."""
    s = rained(3 * K, ponding=depth * WATER, retention=retention)
    start = water(s)
    for _ in range(6):
        s.run(s.t + 3600, 600, progress=False)
        out, runs = 10 * s.outflows.array, 10 * s.outcome("runoff")["rain"]
        if s.outcome("ponded")["rain"] == pytest.approx(depth / 10, rel=1e-12):  # else the rain fills the pond as well
            assert -out[1] + runs == pytest.approx(3 * K, rel=1e-10)  # rain is what soaks in and what runs off
    assert [out[0], -out[1], runs] == pytest.approx([flows * K, flows * K, (3 - flows) * K], rel=1e-3)
    assert not retention or water(s) > start


def test_a_stage_that_ends_a_pond_says_so():
    """Earlier, the water of the pond vanished without a word."""
    s = rained(9 * K, ponding=0.02 * WATER, retention=True)
    s.run(1800, 300, progress=False)
    pond = s.outcome("ponded")["rain"]
    drain, rain = s.conditions
    with warnings.catch_warnings():
        warnings.simplefilter("error", mpm.ResultWarning)
        s.stage(conditions=[rain, drain, mpm.Traction("top", (0, -1.0))])
    assert s.outcome("ponded")["rain"] == pond > 0
    with pytest.warns(mpm.ConditionWarning, match=rf"stage: rain: its pond of {pond:.3g} m\^2 runs off"):
        s.stage(conditions=[drain, mpm.Rain("top", 0.0, ponding=0.02 * WATER, name="rain")])
    assert s.outcome("ponded")["rain"] == 0


def test_conditions_that_continue_keep_their_default_names():
    """A pond stayed with the name of the condition that ended, and the message named the pond that continues."""
    law = mpm.VanGenuchten(WATER / 3.35, residual=0.1, n=2.0)
    soil = mpm.LinearElastic(**STIFF, porosity=0.4, conductivity=K, retention=law)
    drain, dry = mpm.Drained("bottom"), mpm.Rain("top", 0.0, region=([0.1, 0], [0.2, 2]))
    wet = mpm.Rain("top", 9 * K, ponding=0.02 * WATER, region=([0, 0], [0.1, 2]))
    s = column(10, [soil], mpm.hydrostatic(0.2), [drain, dry, wet], width=2)
    s.run(600.0, 60.0, progress=False)
    pond = s.outcome("ponded")["rain_top_2"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        s.stage(conditions=[drain, wet])
    assert s.outcome("ponded")["rain_top_2"] == pond > 0
    with pytest.warns(mpm.ConditionWarning, match="stage: rain_top_2: its pond of"):
        s.stage(conditions=[drain])


@pytest.mark.parametrize("retention", [True, False])
def test_all_rain_is_stored_ponds_runs_off_or_flows_out(retention):
    """A storm fills a pond of 2 cm, and the pond then infiltrates and evaporates."""
    s = rained(lambda t: 9 * K if t <= 1800 else -1e-6, ponding=0.02 * WATER, retention=retention)
    start, depths = water(s), []
    for end in (600, 1800, 2100, 2400):
        s.run(end, 300, progress=False)
        flowed, ran = s.outcome("flowed").array, s.outcome("ran_off")["rain"]
        pond, fell = s.outcome("ponded")["rain"], (9 * K * min(end, 1800) - 1e-6 * max(end - 1800, 0)) / 10
        assert fell == pytest.approx(-flowed[1] + pond + ran, rel=1e-8)
        # storage is balanced to the tolerance of the steps
        assert water(s) - start == pytest.approx(-flowed.sum(), abs=1e-8 * start)
        depths.append(10 * pond)
    assert depths[1] == pytest.approx(0.02, rel=1e-12)
    assert ran > 0
    assert depths[1] > depths[2] > depths[3] >= 0


@pytest.mark.slow
def test_a_slope_that_fails_in_a_storm_comes_to_rest_and_its_water_is_all_there():
    """The wet slope slides by a tenth of its height, with inertia from one equilibrium to the next."""
    grid = mpm.Grid([0, 0], [3.5, 1.25], [28, 10])
    law = {"conductivity": 1e-4, "retention": mpm.VanGenuchten(5e3, residual=0.05, n=2.5), "porosity": 0.4}
    soil = mpm.MohrCoulomb(bulk=3e6, shear=1.5e6, friction=25.0, dilation=0.0, cohesion=100.0, **law)
    bank = mpm.polygon(grid, [[0, 0], [1.9, 0], [1, 1], [0, 1]], ["bottom", "slope", "top", "left"])
    scene = {"fluid": mpm.Fluid(), "gravity": (0, -9.81), "walls": {"left": "x", "bottom": "xy"}, "inertia": False}
    scene |= {"pressure": mpm.hydrostatic(-0.35), "initial_stress": mpm.K0(0.5)}
    s = mpm.Simulation(grid, [bank], [soil], conditions=[mpm.Rain("top", 3e-4, name="rain")], **scene)
    start = water(s)
    with pytest.raises(mpm.GaveUp):
        s.run(4000, 100, progress=False)
    s.stage(inertia=True)
    speeds = []
    for _ in range(8):
        s.run(s.t + 0.25, 0.025, progress=False)
        speeds.append(np.linalg.norm(s.points.velocity, axis=1).max())
        assert water(s) - start == pytest.approx(-s.outcome("flowed").array.sum(), abs=1e-8 * start)
    assert s.outcome("ran_off")["rain"] > 0
    assert np.linalg.norm(s.points.displacement, axis=1).max() > 0.1
    assert speeds[-1] < 0.2 * max(speeds)


def test_light_rain_soaks_in_and_its_water_is_all_there():
    s = rained(0.3 * K, cells=20)
    start = water(s)
    s.run(3600, 600, progress=False)
    assert s.outcome("runoff").array == [0.0]
    assert s.outflows["rain"] == pytest.approx(-0.3 * K / 20, rel=1e-12)
    assert s.outcome("rained")["rain"] == pytest.approx(0.3 * K * 3600 / 20, rel=1e-12)
    names = ("rain", "runoff", "rained", "flowed", "ran_off", "ponded")
    assert {type(s.outcome(name)["rain"]) for name in names} == {np.float64}
    assert 20 * (water(s) - start) == pytest.approx(0.3 * K * 3600, rel=1e-4)


def test_rain_may_begin_and_end_in_a_stage_that_keeps_the_other_conditions():
    s = rained(0.3 * K)
    drained, rain = s.conditions
    for conditions, flow in (([drained], None), ([drained, rain], -0.3 * K / 10)):
        s.stage(conditions=conditions)
        s.run(s.t + 600, 300, progress=False)
        assert s.outflows.get("rain") == (None if flow is None else pytest.approx(flow, rel=1e-12))
    assert s.outcome("flowed")["rain"] == pytest.approx(600 * flow, rel=1e-12)


def test_water_evaporates_at_its_rate_and_then_as_the_driest_pressure_lets_it():
    s = rained(-1e-7, driest=-5 * WATER)
    s.run(3600, 1200, progress=False)
    assert 10 * s.outflows["rain"] == pytest.approx(1e-7, rel=1e-10)
    s.run(4 * 86400, 43200, progress=False)
    assert 0 < 10 * s.outflows["rain"] < 0.5e-7
    assert s.cells().pressure.min() > -5 * WATER


def test_a_wet_slope_seeps_where_no_rain_falls():
    s = rained(0.0, retention=False)
    s.stage(conditions=[mpm.Drained("bottom", pressure=1.5 * WATER), mpm.Rain("top", 0.0, name="rain")])
    s.run(1e4, 2e3, progress=False)
    assert 10 * s.outflows["rain"] == pytest.approx(0.5 * K, rel=1e-4)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"flux": "much"}, "Rain: flux = 'much', must be a finite number"),
        ({"flux": 1e-6, "ponding": -1.0}, r"Rain: ponding = -1.0, must be >= 0 and finite"),
        ({"flux": 1e-6, "driest": 0.0}, r"Rain: driest = 0.0, must be < 0 and finite"),
    ],
)
def test_what_is_no_rain_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        mpm.Rain("top", **given)


def test_rain_on_a_drained_side_is_refused():
    sides = [mpm.Drained("top"), mpm.Rain("top", 1e-6)]
    with pytest.raises(ValueError, match="top"):
        column(2, [mpm.Hencky(1e6, 1e6)], 0.0, sides)


def test_rain_is_the_same_on_the_left_as_on_the_right():
    """The scene is mirrored; results agree to rounding."""
    found = []
    for side, other in (("left", "right"), ("right", "left")):
        grid = mpm.Grid([-1, 0], [1, 0.5], [20, 5])
        law = mpm.BrooksCorey(3e3, index=1.5)
        soil = mpm.Hencky(bulk=1e7, shear=5e6, porosity=0.4, conductivity=K, retention=law)
        walls = {"left": "x", "right": "x", "bottom": "y"}
        rain = mpm.Rain(side, 3e-6)
        scene = {"walls": walls, "conditions": [rain, mpm.Drained(other, seepage=True)], "fluid": mpm.Fluid()}
        body = mpm.box(grid, [-1, 0], [1, 0.4])
        s = mpm.Simulation(grid, [body], [soil], pressure=-6e3, gravity=(0, -9.81), **scene)
        s.run(1200, 300, progress=False)
        p = s.cells().pressure[np.lexsort(np.round(s.cells().x * [1 if side == "left" else -1, 1], 6).T)]
        found.append(p)
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_a_resumed_run_goes_on_as_the_one_that_was_not_broken_off(tmp_path):
    """A moving body; results agree bit by bit."""

    def scene(index=1.5):
        grid = mpm.Grid([-1, 0], [1.4, 0.6], [24, 6])
        soil = mpm.Hencky(1e6, 5e5, porosity=0.4, conductivity=K, retention=mpm.BrooksCorey(3e3, index=index))
        acting = [mpm.Rain("top", 2 * K, name="rain"), mpm.Displacement("left", lambda t: (t * 2e-4, 0), "x")]
        given = {"pressure": -6e3, "gravity": (0, -9.81), "fluid": mpm.Fluid(), "initial_stress": mpm.K0(0.5)}
        body = mpm.box(grid, [-1, 0], [1, 0.43])
        return mpm.Simulation(grid, [body], [soil], walls={"bottom": "y"}, conditions=acting, **given)

    whole, broken, later = scene(), scene(), scene()
    whole.run(600, 200, progress=False)
    broken.run(400, 200, progress=False, checkpoint=mpm.Checkpoint(tmp_path / "c.npz"))
    later.run(600, 200, progress=False, after=mpm.resume(later, tmp_path / "c.npz"))
    assert whole.state.resets > 2
    assert np.array_equal(whole.cells().pressure, later.cells().pressure)
    assert np.array_equal(whole.outcome("runoff").array, later.outcome("runoff").array)
    with pytest.raises(ValueError, match="retention of material 0"):
        mpm.resume(scene(2.0), tmp_path / "c.npz")


def two_soils_in_the_rain(length=1.0, stress=1.0, time=1.0, at=(0.0, 0.0), mirror=False, swapped=False, far=False):
    """Return cell pressures and outflows of sand next to loam in oscillating rain, in the units of the sand."""
    gravity = 9.81 * length / time**2
    density = 1000 * stress * time**2 / length**2
    lower = np.multiply(at, length / 10)
    grid = mpm.Grid(lower, lower + np.multiply([3.0, 1.4], length), [30, 14])
    soils = [
        mpm.Hencky(
            bulk=1e7 * stress,
            shear=5e6 * stress,
            conductivity=k * length / time,
            grain_density=2.6 * density,
            retention=mpm.VanGenuchten(entry * stress, residual=0.1, n=n),
        )
        for k, entry, n in ((1e-5, 2943.0, 2.5), (1e-6, 9810.0, 3.0))
    ]
    boxes = [([0.5, 0], [0.93, 1.03], 0), ([0.93, 0], [1.5, 1.03], 1)] + [([2.2, 0], [2.7, 0.8], 0)] * far
    if mirror:
        boxes = [([2 - high[0], 0], [2 - low[0], high[1]], m) for low, high, m in boxes]
    if swapped:
        soils, boxes = soils[::-1], [(low, high, 1 - m) for low, high, m in boxes[::-1]]
    bodies = [mpm.box(grid, *(lower + np.multiply(x, length) for x in ends), material=m) for *ends, m in boxes]
    flux = lambda t: 3e-6 * (1 + np.sin(t / time / 2000)) * length / time  # noqa: E731
    near = (lower, lower + np.multiply([1.6, 1.4], length))
    sides = [
        mpm.Rain("top", flux, ponding=100 * stress, driest=-1e6 * stress, region=near),
        mpm.Drained("bottom", pressure=2000 * stress, region=near),
    ]
    fluid = mpm.Fluid(density=density, bulk=2e8 * stress, gravity=gravity)
    water = {"fluid": fluid, "gravity": [0, -gravity], "pressure": -5000 * stress, "initial_stress": mpm.K0(0.5)}
    numerics = mpm.Numerics(tolerance=1e-9)
    s = mpm.Simulation(grid, bodies, soils, walls={"bottom": "xy"}, conditions=sides, numerics=numerics, **water)
    assert s.run(2000 * time, 500 * time, progress=False).cuts == 0
    cells = s.cells()
    x = (cells.x - lower) / length
    pressure = cells.pressure[x[:, 0] < 1.8] / stress
    x = x[x[:, 0] < 1.8]
    x[:, 0] = 2 - x[:, 0] if mirror else x[:, 0]
    order = np.lexsort(np.round(x, 6).T)
    return pressure[order], s.outflows.array * time / length**2


in_the_plain_frame = cache(two_soils_in_the_rain)


@pytest.mark.parametrize(
    "other",
    [
        {"length": 1e3, "stress": 1e-3, "time": 60.0},
        pytest.param({"length": 1e-4, "stress": 10.0, "time": 0.01}, marks=pytest.mark.slow),
        {"mirror": True},
        {"swapped": True},
        {"far": True},
        pytest.param({"at": (1e4, -3e4)}, marks=pytest.mark.slow),
    ],
    ids=["large units", "small units", "mirrored", "reordered", "beside a far body", "far from the origin"],
)
def test_rain_on_two_soils_is_the_same_in_any_frame(other):
    for found, value in zip(two_soils_in_the_rain(**other), in_the_plain_frame(), strict=True):
        assert found == pytest.approx(value, abs=1e-8 * np.abs(value).max())


def test_a_long_slope_under_steady_rain_is_as_safe_as_its_suction_says():
    """Dry soil, and rain of nine tenths of the conductivity: factors at 1, 2, 3 and 5 m, from computed pressures."""
    known = {
        0.0: (1.1636053, 1.0462666, 1.0145471, 0.9397027),
        0.9: (1.1739380, 1.0324996, 0.9845665, 0.9397027),
    }
    s = rain.column(20)
    for days, (share, factors) in zip((0, 20), known.items(), strict=True):
        if days:
            s.run(days * rain.DAY, 2 * rain.DAY, progress=False)
        depth, _, felt = rain.found(s)
        at = np.interp(rain.DEPTHS, np.append(depth, rain.TABLE), np.append(felt, 0.0))
        assert rain.safety(rain.DEPTHS, at) == pytest.approx(factors, rel=1e-3)
        assert rain.exact(rain.DEPTHS, share) == pytest.approx(factors, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("depth, share, cells", [(3.0, 0.0, 8), (3.0, 0.9, 8), (1.0, 0.0, 20), (1.0, 0.9, 20)])
def test_a_long_slope_slides_when_its_strength_is_divided_by_its_factor(depth, share, cells):
    """A column that can only shear along the slope, with its base at a depth: strength reduction with suction and
    weight.

    Flow is associated, so the exact factor is (c' + (sigma + chi s) tan phi) / tau.
    """
    steep, alpha = np.cos(rain.SLOPE), rain.ALPHA
    height = depth * steep
    h = height / cells
    grid = mpm.Grid([0, 0], [3 * h, height + 2 * h], [3, cells + 2])
    law = {"conductivity": rain.K, "retention": mpm.Gardner(WATER / alpha), "porosity": 0.35}
    angles = {"friction": 32.0, "dilation": 32.0, "cohesion": rain.COHESION}
    soil = mpm.MohrCoulomb(bulk=2e7, shear=1e7, **angles, **law)

    def full(y):
        return share + (1 - share) * np.exp(-alpha * (y + (rain.TABLE - depth) * steep) * steep)

    def alike(points, u):  # nothing changes along the slope
        along = points.grad(u)[:, 0]
        return 1e12 * ufl.inner(along, along) * points.dx

    def pressure(y):
        return WATER / alpha * np.log(full(y))

    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [h, 0], [2 * h, height])],
        [soil],
        fluid=mpm.Fluid(gravity=9.81),
        gravity=(9.81 * np.sin(rain.SLOPE), -9.81 * steep),
        walls={"bottom": "xy"},
        terms=[alike],
        pressure=lambda x: pressure(x[:, 1]),
        conditions=[mpm.Drained("bottom", float(pressure(0.0))), mpm.Rain("top", share * rain.K * steep)],
    )
    factor = mpm.factor_of_safety(s, dt=1e6, rtol=0.005, progress=False).factor
    y = (np.arange(2000) + 0.5) / 2000 * height
    weight = depth * 9.81 * (0.65 * 2650 + 350 * full(y)).mean()
    held = rain.COHESION + (weight * steep**2 - full(0.0) * pressure(0.0)) * np.tan(rain.FRICTION)
    assert factor == pytest.approx(held / (weight * np.sin(rain.SLOPE) * steep), rel=0.01)


@pytest.mark.parametrize("steps", [{"rtol": 1e-2}, {"dt": 1100.0}, {"dt": 1800.0}, {"dt": 7200.0}])
@pytest.mark.parametrize(
    "flux",
    [
        mpm.Stepwise([0, 3600], [0.3 * K, 0]),
        mpm.Stepwise([0, 2000, 2030], [0, 36 * K, 0]),
        lambda t: 0.3 * K if t < 3600 else 0.0,
        lambda t: 0.3 * K if t <= 3600 else 0.0,
    ],
)
def test_rain_that_jumps_within_a_step_falls_completely(flux, steps):
    s = rained(flux)
    result = s.run(7200, **steps, progress=False)
    assert s.outcome("rained")["rain"] == pytest.approx(0.3 * K * 3600 / 10, rel=1e-12)
    assert result.cuts == 0


def test_a_jump_ends_the_step_and_no_smooth_function_does():
    jumps = [(0.3, np.sign), (0.5, lambda d: d >= 0), (0.7, lambda d: np.sin(d) + (d > 0))]
    for at, of in jumps:
        end = before_jumps([lambda t, at=at, of=of: of(t - at)], 0.0, 1.0)
        assert at - 1e-13 < end < at
        assert before_jumps([lambda t, at=at, of=of: of(t - at)], end, 1.0) == 1.0
    for of in (np.sin, lambda t: min(t, 0.3), lambda t: np.exp(-1e4 * (t - 0.4) ** 2), lambda t: 5.0):
        assert before_jumps([of], 0.0, 1.0) == 1.0
    table = mpm.Stepwise([0.0, 0.2, 0.6], [1.0, 2.0, 3.0])
    ends = [0.0]
    while ends[-1] < 1:
        ends.append(before_jumps([table], ends[-1], 1.0))
    assert ends == pytest.approx([0, 0.2, 0.6, 1], rel=1e-13)
    assert [float(table(end)) for end in ends] == [1, 1, 2, 3]


@pytest.mark.parametrize(
    ("times", "values", "said"),
    [
        ([0, 0], [1, 2], r"Stepwise: times = \[0, 0\], must be increasing times"),
        ([0, 1], [1], r"Stepwise: values of shape \(1,\), must be one value, or .*, for each of 2 times"),
        ([0, 1], [1, np.nan], "Stepwise: values = .*nan.*must be finite numbers"),
    ],
)
def test_tables_with_errors_are_refused(times, values, said):
    with pytest.raises(ValueError, match=said):
        mpm.Stepwise(times, values)


def test_a_time_before_the_table_is_refused():
    with pytest.raises(ValueError, match=r"t = .*must not be before the first time, 10000 s"):
        rained(mpm.Stepwise([1e4], [K])).run(3600, 600, progress=False)


def test_steps_end_at_jumps_of_tractions():
    grid = mpm.Grid([0, 0], [0.5, 1.5], [1, 3])
    load = mpm.Traction("top", mpm.Stepwise([0, 5], [0, -1e3]))
    soil = mpm.LinearElastic(bulk=1e6, shear=6e5)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.5, 1])], [soil], walls=walls, conditions=[load])
    s.run(5, 5, progress=False)
    assert s.points.displacement[:, 1].min() == 0  # the value before the jump
    s.run(10, 5, progress=False)
    assert s.points.displacement[:, 1].min() == pytest.approx(-0.875 * 1e3 / 1.8e6, rel=1e-3)


def test_infiltration_and_evaporation_are_those_of_richards_equation():
    """Rain beyond the conductivity of loam, then evaporation until the soil limits it."""
    law = mpm.VanGenuchten(2725.0, residual=0.18, n=1.56, air_entry=200.0)
    soil = mpm.LinearElastic(**STIFF, porosity=0.43, conductivity=2.9e-6, retention=law)
    ends, rates = [6 * 3600.0, 5 * 86400.0, 20 * 86400.0], [5e-6, -1e-7, -1e-7]
    rain = mpm.Rain("top", mpm.Stepwise([0, *ends[:-1]], rates), name="rain")
    s = column(20, [soil], mpm.hydrostatic(-1.0), [rain], initial_stress=mpm.K0(0.5))
    entered = []
    for end in ends:
        s.run(end, rtol=1e-2, t_eval=[end], progress=False)
        entered.append(-20 * s.outcome("flowed")["rain"])
    constants = {"alpha": WATER / law.entry, "n": law.n, "air_entry": law.air_entry / WATER, "residual": law.residual}
    constants |= {"porosity": 0.43, "conductivity": 2.9e-6}
    exact = infiltration(constants, 1.0, -1.0, list(zip(ends, rates, strict=True)), -1e7 / WATER)
    assert entered[0] == pytest.approx(exact[0], rel=2e-3)
    assert entered[0] - np.array(entered[1:]) == pytest.approx(exact[0] - exact[1:], rel=1.5e-2)
    assert exact[0] - exact[2] < 0.3 * 1e-7 * 20 * 86400  # the soil limits evaporation


@pytest.mark.slow
def test_nearly_empty_cells_of_a_bank_do_not_stop_its_evaporation():
    """Loam over sand swells in rain, by up to 1e-4 cells above a grid line.  These cells dry first."""
    half, slope = 43200.0, np.arctan2(4, 6)
    grid = mpm.Grid([0, 0], [18, 8], [18, 16])
    edges = [(0, 2), (18, 2), (18, 3), (12, 3), (6, 7), (0, 7)]
    bank = mpm.polygon(grid, edges, ["bed", "end", "toe", "slope", "crest", "axis"])
    of_loam = {"porosity": 0.43, "conductivity": 2.9e-6, "retention": mpm.VanGenuchten(2725.0, residual=0.18, n=1.56)}
    of_sand = {"porosity": 0.4, "conductivity": 8e-5, "retention": mpm.VanGenuchten(677.0, residual=0.1, n=2.68)}
    loam = mpm.MohrCoulomb(bulk=8e6, shear=4e6, friction=28, dilation=0, cohesion=5e3, **of_loam)
    sand = mpm.MohrCoulomb(bulk=3e7, shear=1.5e7, friction=36, dilation=4, cohesion=500, **of_sand)
    rain = mpm.Stepwise([0, half], [5e-6, -3e-8])
    inclined = mpm.Stepwise([0, half], np.cos(slope) * np.array([5e-6, -3e-8]))
    sides = [mpm.Rain("crest", rain, ponding=300.0), mpm.Rain("toe", rain), mpm.Rain("slope", inclined)]
    sides.append(mpm.Drained("right", mpm.hydrostatic(1.5)))
    scene = {"walls": {"left": "x", "right": "x", "bottom": "xy"}, "fluid": mpm.Fluid(), "gravity": (0, -9.81)}
    scene |= {"conditions": sides, "pressure": mpm.hydrostatic(1.5), "initial_stress": mpm.K0(0.5)}
    s = mpm.Simulation(grid, [bank, mpm.box(grid, [0, 0], [18, 2], material=1)], [loam, sand], **scene)
    start = water(s)
    result = s.run(4 * half, rtol=1e-2, t_eval=[half, 4 * half], progress=False)
    assert result.cuts <= 2
    assert result.steps < 60
    assert s.cells().pressure.min() > -1e7
    assert water(s) - start == pytest.approx(-s.outcome("flowed").array.sum(), abs=1e-8 * start)
    assert s.outcome("rained").array.sum() == pytest.approx(18 * half * (5e-6 - 3 * 3e-8), rel=1e-4)
