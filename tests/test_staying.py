# SPDX-License-Identifier: MIT
"""Domains that hardly move keep their cut: results equal those with a cut in each step, without drift of prescribed
sides.
"""

from functools import partial

import numpy as np
import pytest
from helpers import without

import mpm_dolfinx as mpm
from mpm_dolfinx.domains import cut_domains
from mpm_dolfinx.simulation.summary import parts
from mpm_dolfinx.stepping import scene

SOIL = mpm.Hencky(bulk=2e7, shear=1e7, porosity=0.4, conductivity=1e-5)
WATER = mpm.Fluid(bulk=1e8)


def column(load: float, **options) -> mpm.Simulation:
    """Return a column of 1 m, off the grid lines, that consolidates under a load, in Pa."""
    grid = mpm.Grid([0, 0], [0.5, 1.2], [5, 12])
    body = mpm.box(grid, [0, 0], [0.5, 0.97])
    walls = {"left": "x", "right": "x", "bottom": "y"}
    conditions = [mpm.Drained("top"), *options.pop("conditions", [mpm.Traction("top", (0, -load))])]
    return mpm.Simulation(
        grid,
        [body],
        [SOIL],
        fluid=WATER,
        walls=walls,
        conditions=conditions,
        **options,
    )


@pytest.fixture
def cuts(monkeypatch):
    """Return a list that grows whenever domains are cut."""
    made = []

    class Counted(cut_domains.CutDomains):
        def __init__(self, *arguments):
            made.append(arguments)
            super().__init__(*arguments)

    monkeypatch.setattr(scene, "CutDomains", Counted)
    return made


def test_the_answer_is_that_of_cutting_in_every_step(cuts, monkeypatch):
    runs = []
    for stays in (-1.0, cut_domains.STILL):
        monkeypatch.setattr(cut_domains, "STILL", stays)
        s = column(1e4)  # it settles by 3e-3 of a cell
        steps = s.run(40, 0.8, progress=False).steps
        runs.append((s.points.x, s.points.pressure, s.points.F, len(cuts)))
    (x, p, F, often), (x2, p2, F2, total) = runs
    assert often >= steps >= 50 and 5 <= total - often <= 15
    settled = np.abs(x[:, 1] - column(0.0).points.x[:, 1]).max()
    assert np.abs(x2 - x).max() < 1e-4 * settled
    assert np.abs(p2 - p).max() < 1e-4 * 1e4
    assert np.abs(F2 - F).max() < 1e-4 * np.abs(F - np.eye(2)).max()


def test_a_body_at_rest_is_cut_once_and_one_that_moves_in_every_step(cuts):
    rest, moving = column(0.0), column(1e6)
    rest.run(100, 10, progress=False)
    assert len(cuts) == 1 and not parts(rest.scene, rest.state)[0].used
    steps = moving.run(10, 1, progress=False).steps
    assert len(cuts) == 1 + steps and parts(moving.scene, moving.state)[0].used


def test_a_given_displacement_and_a_plate_do_not_drift(cuts):
    push = mpm.Displacement("top", lambda t, X: (0, -1e-6 * t))
    s = column(0.0, conditions=[push])
    s.run(500, 5, progress=False)
    assert len(cuts) < 40
    top = s.points.corners[..., 1].max()
    assert top == pytest.approx(0.97 - 5e-4, abs=1e-7)
    s = column(0.0, conditions=[mpm.RigidPlate("top", 5e3)])
    s.run(500, 5, progress=False)
    top = s.points.corners[..., 1].max(axis=1)
    assert np.ptp(top[top > top.max() - 0.01]) < 1e-9


def test_pressures_and_stages_are_kept_when_the_domains_leave_their_cells():
    s = column(1e4)
    s.run(8, 0.8, progress=False)
    before = s.points.pressure.copy()
    assert before.max() > 3e3
    s.stage(conditions=[*without(s, mpm.Traction), mpm.Traction("top", (0, -1e4))])
    s.run(s.t + 1e-6, 1e-6, progress=False)
    assert s.points.pressure == pytest.approx(before, abs=2e-3 * 1e4)


def test_a_run_goes_on_from_a_checkpoint_with_the_same_bits(tmp_path):
    file = tmp_path / "run.ckpt"
    whole = column(1e4)
    whole.run(20, 0.8, checkpoint=mpm.Checkpoint(file, every=10), progress=False)
    s = column(1e4)
    s.run(16, 0.8, checkpoint=mpm.Checkpoint(file, every=10), progress=False)
    s = column(1e4)
    before = mpm.resume(s, file)
    assert s.t == 16
    s.run(20, 0.8, after=before, progress=False)
    assert np.array_equal(s.points.corners, whole.points.corners)
    assert np.array_equal(s.points.pressure, whole.points.pressure)


@pytest.mark.parametrize("load", [1e4, 1e6], ids=["staying", "moving"])
def test_a_stage_after_a_step_that_failed_begins_with_the_last_good_pressures(load, monkeypatch):
    runs = []
    for fails in (False, True):
        s = column(load)
        s.run(4, 0.8, progress=False)
        if fails:
            with monkeypatch.context() as patch:
                patch.setattr("mpm_dolfinx.stepping.step.solve_substep", partial(fail, s))
                with pytest.raises(mpm.GaveUp):
                    s.run(8, 0.8, progress=False)
        s.stage(conditions=[*without(s, mpm.Traction), mpm.Traction("top", (0, -load))])
        s.run(8, 0.8, progress=False)
        runs.append((s.points.corners, s.points.pressure))
    (x, p), (x2, p2) = runs
    assert p2 == pytest.approx(p, abs=1e-6 * load) and x2 == pytest.approx(x, abs=1e-12)


def fail(s, *_):
    s.scene.storage.p.x.array[:] = np.nan
    raise mpm.NotConverged("made to fail", [])
