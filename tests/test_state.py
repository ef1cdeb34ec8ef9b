# SPDX-License-Identifier: MIT
"""The state holds all history of a scene: equal accepted steps give equal bits, with any trials between them."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from helpers import arrays_of, beam, limit, set_up
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from interrupting import interrupted

import mpm_dolfinx as mpm
from mpm_dolfinx.base.histories import Row
from mpm_dolfinx.io.checkpoint import save
from mpm_dolfinx.stepping.state import StepControl

SAND = mpm.DruckerPrager(
    bulk=2e7,
    shear=1e7,
    friction=20.0,
    dilation=0.0,
    cohesion=lambda X: 2e4 + 0 * X[:, 0],
    porosity=0.6,
    conductivity=1e-5,
)
CLAY = mpm.Hencky(bulk=lambda X: 2e7 + 0 * X[:, 0], shear=1e7, conductivity=1e-6)
LINEAR = mpm.LinearElastic(bulk=2e7, shear=1e7, conductivity=1e-6)
LAWS = {"sand": SAND, "clay": CLAY, "linear": LINEAR}
FIELD = {"sand": "cohesion", "clay": "bulk"}


class Refusal(Exception):
    """Exception of a user function."""


def scene(law, wet, held):
    """Return a column off the grid lines, and the dictionary that its load reads."""
    grid = mpm.Grid([0, 0], [0.3, 0.8], [3, 8])
    asked = {"load": 300.0, "refuses": False}

    def load(t):
        if asked["refuses"]:
            raise Refusal
        return 0.0, -asked["load"]

    options = {"conditions": [mpm.Traction("top", load)]}
    if held:
        options = {"conditions": [mpm.Displacement("top", lambda t, X: (0, 1e-7 * load(t)[1]), "y")]}
    if wet:
        options = {"fluid": mpm.Fluid(bulk=1e8), "conditions": [*options["conditions"], mpm.Drained("top")]}
    walls = {"left": "x", "right": "x", "bottom": "y"}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.3, 0.63])], [LAWS[law]], walls=walls, **options)
    return s, asked


def same_bits(a: mpm.State, b: mpm.State) -> None:
    """Assert that two states are equal, bit for bit."""
    assert (a.t, a.resets, a.begins) == (b.t, b.resets, b.begins)
    one, other = contents(a), contents(b)
    assert one.keys() == other.keys()
    for name in one:
        assert np.array_equal(one[name], other[name], equal_nan=True), name


def contents(state):
    """Return all arrays of a state by their names."""
    out = {f"points {k}": v for k, v in arrays_of(state.points).items()}
    out |= {f"{what} {name}": value for what, of in state.outcome.items() for name, value in of.items()}
    if state.pieces is not None:
        out |= {f"pieces {name}": rows for name, rows in state.pieces.arrays.items()}
    if state.stay is not None:
        out |= {f"stay {k}": v for k, v in arrays_of(state.stay.points).items()}
        out |= {} if state.stay.keeps is None else {"keeps": state.stay.keeps}
    return out


class Driven(RuleBasedStateMachine):
    """Drives a scene at random. A new scene with only the accepted steps must end in the same state."""

    @initialize(law=st.sampled_from(sorted(LAWS)), wet=st.booleans(), held=st.booleans())
    def begin(self, law, wet, held):
        self.made, self.accepted = (law, wet, held), []
        self.s, self.asked = scene(*self.made)

    def act(self, name, *arguments):
        """Take an action that changes the state if it succeeds."""
        perform(self.s, self.asked, name, *arguments)
        self.accepted.append((name, *arguments))

    @rule(dt=st.sampled_from([0.5, 3.0]))
    def step(self, dt):
        before = self.s.state
        try:
            self.act("step", dt)
        except mpm.NotConverged:
            assert self.s.state is before

    @rule(load=st.sampled_from([0.0, 300.0, 2e4, 3e5]))
    def load(self, load):
        self.act("load", load)

    @precondition(lambda self: self.made[0] in FIELD)
    @rule(factor=st.sampled_from([0.5, 1.5]))
    def change_of_a_material_field(self, factor):
        field = FIELD[self.made[0]]
        self.act("field", field, factor)
        seen = set_up(self.s, 0.5).momentum.data.pieces[field]
        assert np.array_equal(np.unique(seen), np.unique(self.s.points.data[field])), "the step does not see it"

    @rule(reset=st.booleans())
    def stage(self, reset):
        self.act("stage", reset)

    @rule()
    def refused_step(self):
        before, self.asked["refuses"] = self.s.state, True
        with pytest.raises(ValueError, match="Refusal"):
            self.s.step(0.5)
        self.asked["refuses"] = False
        assert self.s.state is before

    @rule(newton=st.integers(0, 1))
    def step_that_does_not_converge(self, newton):
        before, scheme = self.s.state, self.s.scene.scheme
        load, self.asked["load"] = self.asked["load"], 1e7
        limit(self.s, newton if self.made[0] != "linear" else 0)
        with pytest.raises((mpm.NotConverged, mpm.LeftGrid)):
            self.s.step(5.0)
        self.asked["load"], self.s.scene.scheme = load, scheme
        self.s.scene.forget()
        assert self.s.state is before

    @rule(lines=st.integers(1, 4))
    def interrupt_at_the_end(self, lines):
        self.interrupted(1.0, lines)

    @rule(share=st.floats(0, 1))
    def interrupt(self, share):
        self.interrupted(share, 0)

    def interrupted(self, share, lines):
        """Interrupt a step after a fraction of its lines."""
        before = self.s.state
        self.s.scene.forget()  # as many lines in both
        with interrupted(10**9) as counted:
            self.s.step(0.5)
        after, self.s.state = self.s.state, before  # a state can be taken back
        self.s.scene.forget()
        with interrupted(max(0, int(share * counted()) - lines)):
            self.s.step(0.5)
        if self.s.state is not before:  # it was over by then
            same_bits(self.s.state, after)
            self.accepted.append(("step", 0.5))

    @rule()
    def look(self):
        """Read results, which must change nothing."""
        str(self.s), self.s.effective_stress(), self.s.reactions.array, self.s.points.pressure
        with pytest.raises(ValueError, match="read-only"):
            self.s.points.pressure[:] = 5e4

    @rule(resume=st.booleans())
    def checkpoint(self, resume):
        s = self.s
        with TemporaryDirectory() as folder:
            file, before = Path(folder) / "run.ckpt", s.state
            if s.result is None:
                s.state = replace(s.state, result=mpm.Result(rows=[Row(s.t)]), control=StepControl())
            save(s, file)
            if not resume:
                s.state = before
                return
            asked = dict(self.asked)
            self.s, self.asked = scene(*self.made)
            self.asked |= asked
            mpm.resume(self.s, file)

    def teardown(self):
        fresh, asked = scene(*self.made)
        for name, *arguments in self.accepted:
            fresh.scene.forget()  # what is kept from step to step changes nothing
            perform(fresh, asked, name, *arguments)
        same_bits(self.s.state, fresh.state)


def perform(s, asked, name, *arguments):
    """Apply an action to a scene."""
    if name == "step":
        s.step(*arguments)
    elif name == "load":
        asked["load"] = arguments[0]
    elif name == "field":
        field, factor = arguments
        s.stage(fields={field: factor * s.points.data[field]})
    else:
        s.stage(reset_displacement=arguments[0])


TestDriven = Driven.TestCase
TestDriven.settings = settings(
    max_examples=25, stateful_step_count=14, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)


def interrupted_runs(count):
    """Return the state of an uninterrupted run, and states of runs that were interrupted once and continued."""
    s, probe = beam(h=0.1, offset=0.3)
    s.run(0.1, 0.02, probes=probe, progress=False)
    states, moments = [], np.random.default_rng(0).integers(0, 9000, count)
    for after in moments:
        one, probe = beam(h=0.1, offset=0.3)
        with interrupted(int(after)):
            one.run(0.1, 0.02, probes=probe, progress=False)
        if one.result is not None and one.result.converged:
            states.append(one.state)
            continue
        one.run(0.1, 0.02, probes=probe, progress=False, after=one.result)
        states.append(one.state)
    return s.state, states


@pytest.mark.parametrize("count", [15, pytest.param(200, marks=pytest.mark.slow)])
def test_a_run_that_is_interrupted_anywhere_goes_on_to_the_same_end(count):
    alone, states = interrupted_runs(count)
    for state in states:
        same_bits(state, alone)
        assert np.array_equal(state.result.t, alone.result.t)
        assert np.array_equal(state.result.displacement, alone.result.displacement)


def test_a_kept_state_keeps_its_histories():
    """Earlier, its histories grew with the run, and a second continuation from the state was refused."""
    s, _ = scene("clay", True, True)
    s.run(1.0, 0.5, progress=False)
    before, rows = s.state, s.result.rows
    ends = []
    for _ in range(2):
        s.state = before
        result = s.run(2.0, 0.5, after=s.result, progress=False)
        ends.append((s.state, result))
        assert before.result.rows is rows and len(rows) == 3
    same_bits(ends[0][0], ends[1][0])
    for name in ("t", "pressure"):
        assert np.array_equal(*(getattr(result, name) for _, result in ends)), name
    for name in ("reactions", "outflows"):
        assert np.array_equal(*(result.outcome(name).array for _, result in ends)), name
    assert len(ends[0][1].t) == 5 and ends[0][1].steps == ends[1][1].steps
    s.state = before  # and from histories that another continuation has made, those of the state are taken
    assert s.run(1.5, 0.5, after=ends[0][1], progress=False).t.tolist() == [0.0, 0.5, 1.0, 1.5]


def test_nobody_writes_into_a_state_or_its_histories():
    s, _ = scene("sand", True, True)
    probe = mpm.probes(s.bodies, [[0.1, 0.2]])
    s.run(1.0, 0.5, probes=probe, progress=False)
    state, row = s.state, s.result.rows[-1]
    kept = [value for outcome in (state.outcome, row.outcome) for of in outcome.values() for value in of.values()]
    for array in [*kept, state.velocity, row.displacement, row.probe_pressure]:
        assert not array.flags.writeable
    with pytest.raises(TypeError):
        s.result.rows[0] = row


def test_a_step_within_a_stay_depends_on_the_state_alone():
    """Open sides are inclined to their cells. Earlier, pressure slopes there were kept from the last reset."""

    def build():
        grid = mpm.Grid([0, 0], [2, 1.6], [16, 13])
        bodies = [mpm.box(grid, [0, 0], [2, 0.5]), mpm.box(grid, [0, 0.5], [0.9, 0.9])]
        soil = mpm.Hencky(bulk=2e6, shear=6e5, conductivity=1e-6)
        walls, load = {"left": "x", "right": "x", "bottom": "xy"}, mpm.Traction("top", (0, -2e3))
        water = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")], "pressure": mpm.hydrostatic(0.5)}
        return mpm.Simulation(
            grid,
            bodies,
            [soil],
            walls=walls,
            gravity=(0, -9.81),
            conditions=[load, *water.pop("conditions", [])],
            **water,
        )

    one, other, states = build(), build(), []
    for _ in range(8):
        one.step(5.0)
        states.append(one.state)
    within = [k for k in range(1, 8) if states[k - 1].stay is not None]
    assert within
    for k in within:
        other = build()
        other.state = replace(states[k - 1], stage=other.state.stage)
        other.step(5.0)
        assert np.array_equal(other.points.pressure, states[k].points.pressure), k
