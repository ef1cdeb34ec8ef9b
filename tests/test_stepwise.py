# SPDX-License-Identifier: MIT
"""Values that jump in time: every place takes `Stepwise`, and steps of any length give the same results."""

import warnings

import numpy as np
import pytest

import mpm_dolfinx as mpm

SOIL = {"bulk": 4e6, "shear": 2e6, "porosity": 0.4}
JUMP = 2.5  # s


def steps(low, high, at=JUMP):
    """Return a value that jumps at the time `at`."""
    return mpm.Stepwise([0, at], [low, high])


def block(conditions=(), conductivity=1e-4, **options):
    """Return a block, 2 m wide and 2 m high, between smooth walls on a rough base."""
    grid = mpm.Grid([0, 0], [2, 3], [4, 6])
    options = {"walls": {"bottom": "xy", "left": "x", "right": "x"}, **options}
    soil = mpm.Hencky(**SOIL, conductivity=conductivity)
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [2, 2])], [soil], conditions=conditions, **options)


def plate(**motion):
    """Return a plate of soil's width, as a tool on top of the block."""
    return mpm.Tool(mpm.HalfSpace((0, 2), (0, -1)), name="plate", **motion)


WET, HEAVY = {"fluid": mpm.Fluid(gravity=9.81)}, {"gravity": (0, -9.81)}
PLACES = {
    "traction": lambda: block([mpm.Traction("top", steps(0, -1e3))]),
    "vector": lambda: block([mpm.Traction("top", steps((0, 0), (0, -1e3)))]),
    "pressure": lambda: block([mpm.Pressure("top", steps(0, 1e3))]),
    "plate": lambda: block([mpm.RigidPlate("top", steps(0, 1e3))]),
    "displacement": lambda: block([mpm.Displacement("top", steps((0, 0), (0, -1e-3)), "y")]),
    "tool": lambda: block([plate(displacement=steps((0, 0), (0, -1e-3)))]),
    "load": lambda: block([plate(load=steps(10, 1e3), direction=(0, -1))]),
    "gravity": lambda: block(gravity=steps((0, 0), (0, -9.81))),
    "drained": lambda: block([mpm.Drained("top", steps(0, 1e3))], **WET),
    "inflow": lambda: block([mpm.Inflow("top", steps(0, 1e-6))], **WET),
    "rain": lambda: block([mpm.Rain("top", steps(0, 1e-6))], **WET),
    "level": lambda: block(mpm.water("top", steps(2, 2.2)), **WET, **HEAVY),
    "wave": lambda: block([mpm.Quiet("bottom", steps((0, 0), (1e-6, 0)))], walls={"left": "xy"}, inertia=True),
}


@pytest.mark.parametrize("rate", [steps(0, 1e-6), lambda t: 1e-6 * (t > JUMP)], ids=["stepwise", "function"])
def test_step_refuses_a_jump_within_the_step(rate):
    """Earlier, `step` took it: rain that began within a step was counted from its start, or not in this step."""
    s = block([mpm.Rain("top", rate)], **WET)
    s.step(2.0)
    with pytest.raises(ValueError, match=r"step: dt = 1\.0 s from t = 2\.0 s: .*, must be at most 0\.[45]"):
        s.step(1.0)
    assert s.t == 2.0
    s.step(s.without_jump(1.0)[0])
    s.step(1.0)
    assert s.t == pytest.approx(3.5, rel=1e-12)
    assert s.outcome("rained")["rain_top"] == pytest.approx(2e-6, rel=1e-9)


@pytest.mark.parametrize("rate", [steps(0, 1e-6, at=0.3), lambda t: 1e-6 * (t > 0.3)], ids=["stepwise", "function"])
def test_step_takes_a_step_that_ends_at_a_jump_up_to_rounding(rate):
    """Earlier, the third step used the value of a function after its jump: 15 % too much rain."""
    s = block([mpm.Rain("top", rate)], **WET)
    for _ in range(5):
        s.step(0.1)  # without rounding, the third step would end at the jump, not at 0.30000000000000004 s
    assert s.outcome("rained")["rain_top"] == pytest.approx(0.4e-6, rel=1e-9)


@pytest.mark.parametrize("place", PLACES)
def test_a_step_ends_at_the_jump_wherever_the_value_stands(place):
    """Earlier, jumps of water levels, and of the motion and the load of tools, were within a step."""
    s = PLACES[place]()
    s.run(2.0, 2.0, t_eval=[0.01, 2.0], progress=False)
    taken = []
    while s.t < 4.4:
        taken.append(s.state.stage.without_jump(s.t, 1.0)[0])
        s.step(taken[-1])
    assert taken == pytest.approx([0.5, 1.0, 1.0], rel=1e-12)


@pytest.mark.parametrize("dt", [1.0, 3.0])
def test_a_tool_that_jumps_at_an_output_drags_the_soil_with_its_whole_friction(dt):
    """Earlier, a step from the time of the jump did not see the motion: friction was 5 % too small."""
    ways = (0, 0), (0, -2e-3), (1e-3, -2e-3)
    s = block([plate(displacement=mpm.Stepwise([0, 1, 2], ways), friction=0.3)])
    s.run(3.0, dt, progress=False)
    shear, normal = s.tool_forces["plate"][:2]
    assert shear == pytest.approx(-0.3 * normal, rel=1e-6)


@pytest.mark.parametrize("jump", [2.0, 2.5, 2.9])
def test_steps_that_end_at_jumps_do_not_overshoot_a_sudden_load(jump):
    """Earlier, only steps of the full length were halved after a jump: errors were up to 140 Pa."""
    found = []
    for dt in (1.0, 0.02):
        s = block([mpm.Traction("top", steps(0, -1e3, jump)), mpm.Drained("top")], conductivity=1e-2, **WET)
        s.run(3.0, dt, progress=False)
        found.append(s.cells().pressure)
    assert found[0] == pytest.approx(found[1], abs=36)


def test_times_hold_up_to_rounding():
    """A time that steps have added up may differ from the time of a table by rounding errors."""
    table = mpm.Stepwise([0.8, 1.2, 2.0], [1.0, 2.0, 3.0])
    early, late = np.cumsum(np.full(8, 0.1))[-1], 3 * 0.4
    assert early < 0.8 and late > 1.2
    assert [float(table(t)) for t in (early, 0.8, late, 1.2 + 1e-9, 2.0, 2.1)] == [1, 1, 1, 2, 2, 3]
    with pytest.raises(ValueError, match=r"Stepwise: t = 0\.79 s, must not be before the first time, 0\.8 s"):
        table(0.79)
    s = block()
    s.run(early, 0.1, progress=False)
    s.stage(conditions=[mpm.Traction("top", mpm.Stepwise([0.8], [-1e3]))])
    s.run(1.0, 0.1, progress=False)
    assert s.points.displacement[:, 1].min() < -1e-4


@pytest.mark.parametrize("make", ["displacement", "tool"])
def test_a_displacement_that_jumps_is_refused_with_inertia(make):
    """Earlier, impulses depended on whether the jump was at the start of a step."""
    late = [mpm.Displacement("top", mpm.Stepwise([0, 1], [(0, 0), (0, -1e-3)]), "y")]
    if make == "tool":
        late = [plate(displacement=mpm.Stepwise([0, 1], [(0, 0), (0, -1e-3)]))]
    with pytest.raises(ValueError, match=r"Stepwise\(\[0.0, 1.0\], .* jumps, must be continuous with inertia"):
        block(late, inertia=True)
    s = block(late, inertia=False)
    with pytest.raises(ValueError, match="jumps, must be continuous with inertia"):
        s.stage(inertia=True)
    s.run(2.0, 1.0, progress=False)
    s.stage(inertia=True)  # all jumps are over
    s.step(1e-4)


def test_equal_steps_after_a_displacement_that_jumps_in_wet_soil_are_named():
    """With equal steps of 0.5 s, the reaction is +750 kN/m after the jump. It is -45 kN/m in short steps."""
    top = mpm.Displacement("top", mpm.Stepwise([0, 1], [(0, 0), (0, -2e-3)]), "y", name="top")
    s = block([top, mpm.Drained("bottom")], **WET)
    with pytest.warns(mpm.ResolutionWarning, match=r"t = 1 s: a displacement jumps.*; use rtol"):
        s.run(1.5, 0.5, progress=False)
    s = block([top, mpm.Drained("bottom")], **WET)
    with warnings.catch_warnings():
        warnings.simplefilter("error", mpm.ResolutionWarning)
        s.run(1.5, 0.5, rtol=1e-3, progress=False)
    assert s.reactions["top"][1] == pytest.approx(-45094, rel=0.01)


class Broken(Exception):
    """The run ends after a checkpoint."""


@pytest.mark.parametrize("rate", [mpm.Stepwise([0, 1.7], [0, 1e-7]), lambda t: 0.0 if t < 1.7 else 1e-7])
def test_a_run_that_was_broken_off_goes_on_across_jumps(rate, tmp_path):
    """Earlier, no checkpoint could be written after equal steps that a jump had shortened."""
    sides = [mpm.Traction("top", steps(0, -1e3)), mpm.Drained("top"), mpm.Inflow("bottom", rate)]
    whole, first, second = (block(sides, **WET) for _ in range(3))
    whole.run(3.0, 0.7, progress=False)

    checkpoint = mpm.Checkpoint(tmp_path / "run.npz")

    def stored(s):
        checkpoint(s)
        if s.t > 2:
            raise Broken

    with pytest.raises(Broken):
        first.run(3.0, 0.7, checkpoint=stored, progress=False)
    second.run(3.0, 0.7, after=mpm.resume(second, tmp_path / "run.npz"), progress=False)
    assert (second.points.pressure == whole.points.pressure).all()
    assert second.outcome("flowed") == whole.outcome("flowed")
