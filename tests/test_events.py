# SPDX-License-Identifier: MIT
"""Runs that end when a function of the simulation changes its sign."""

import numpy as np
import pytest
from helpers import SOFT, column
from test_state import same_bits

import mpm_dolfinx as mpm


def pressed(**options):
    """Return a dry column under a growing load; its top settles by nearly equal amounts in each second."""
    load = mpm.Traction("top", lambda t: (0, -0.05 * t * SOFT.oedometric))
    return column(cells=4, fluid=False, conditions=[load], **options)


def sunk(depth):
    return lambda s: s.points.corners[:, :, 1].max() - (1 - depth)


@pytest.mark.parametrize("truth", [False, True], ids=["number", "truth"])
def test_a_run_ends_where_a_function_changes_its_sign(truth):
    s, depth, seen = pressed(), sunk(0.08), []
    until = (lambda s: bool(depth(s) < 0)) if truth else depth
    result = s.run(4.0, 0.5, until=[lambda s: s.t - 3.9, until], observe=lambda s: seen.append(s.t), progress=False)
    number, t = result.event
    assert (
        number == 1 and t == s.t == result.t[-1] == seen[-1] and result.converged and len(result.t) == result.steps + 1
    )
    exact = pressed()
    exact.run(t, t, progress=False)  # an elastic body: any steps lead there
    assert -0.05 * 0.5e-3 < depth(s) <= 0 and depth(exact) == pytest.approx(depth(s), abs=1e-8)
    assert result.t[:-1].tolist() == [0, 0.5, 1, 1.5][: len(result.t) - 1]


def test_what_is_so_at_the_start_is_no_event():
    until = [lambda s: s.t, lambda s: s.t >= 0, lambda s: s.t - 5]
    result = pressed().run(1.0, 0.5, until=until, progress=False)
    assert result.event is None and result.t.tolist() == [0, 0.5, 1]


def test_the_first_of_two_events_of_a_step_ends_the_run():
    until = [lambda s: s.t - 0.75, lambda s: s.t > 0.6, lambda s: 0.9 - s.t]
    result = pressed().run(1.0, 0.5, until=until, progress=False)
    assert result.event[0] == 1 and 0.6 < result.event[1] < 0.6 + 0.5e-3


def test_a_run_that_was_broken_off_ends_at_the_same_event(tmp_path):
    file, options = tmp_path / "run.ckpt", {"until": sunk(0.08), "progress": False}
    whole, half = pressed(), pressed()
    result = whole.run(4.0, 0.5, **options, checkpoint=mpm.Checkpoint(file))
    again = pressed()
    ended = again.run(4.0, 0.5, **options, after=mpm.resume(again, file))  # the script, started once more
    same_bits(again.state, whole.state)
    assert ended.event == result.event and ended.steps == result.steps

    def broken(s):
        if s.t == 1.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half.run(4.0, 0.5, **options, observe=broken)
    assert half.run(4.0, 0.5, **options, after=half.result).event == result.event
    same_bits(half.state, whole.state)
    assert half.run(4.0, 0.5, after=half.result, progress=False).event is None and half.t == 4.0


def test_what_a_function_raises_leaves_the_state_at_the_start_of_the_step():
    s, count = pressed(), []

    def fails(s):
        count.append(s.t)
        if len(count) == 6:  # while the event is located
            raise OSError("no more")
        return s.t - 0.8

    with pytest.raises(OSError, match="no more"):
        s.run(4.0, 0.5, until=fails, progress=False)
    assert s.t == 0.5 and s.run(4.0, 0.5, until=lambda s: s.t - 0.8, after=s.result, progress=False).event[0] == 0
    assert s.t == pytest.approx(0.8, abs=0.5e-3)


@pytest.mark.parametrize(
    ("until", "words"),
    [(3, "until = 3, must be a list of functions"), (lambda s: np.nan, "function 0 gives nan, must be")],
)
def test_what_is_no_event_is_refused(until, words):
    with pytest.raises(ValueError, match=words):
        pressed().run(1.0, 0.5, until=until, progress=False)
