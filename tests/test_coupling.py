# SPDX-License-Identifier: MIT
"""The coupler: schemes agree, steps are cut and grow, giving up is clear and keeps the state."""

import numpy as np
import pytest
from helpers import beam

import mpm_dolfinx as mpm


@pytest.fixture(scope="module")
def tip():
    s, probe = beam()
    return s.run(0.08, 0.02, probes=probe).displacement[-1]


@pytest.mark.parametrize("coupling", ["schur-fgmres", "fixed-stress", "fixed-stress-full"])
def test_all_couplings_give_the_same_answer(tip, coupling):
    s, probe = beam(coupling=coupling)
    result = s.run(0.08, 0.02, probes=probe)
    assert result.displacement[-1] == pytest.approx(tip, rel=1e-6)
    assert result.residual <= 1e-8 and result.cuts == 0


def test_the_krylov_scheme_needs_few_iterations(tip):
    s, _ = beam()
    result = s.run(0.08, 0.02)
    assert result.coupling <= 30 * result.steps


def test_beta_as_printed_in_the_paper_diverges_and_says_so():
    s, _ = beam(coupling="fixed-stress-paper")
    before = s.points.copy()
    with pytest.raises(mpm.GaveUp, match=r"gave up at t = 0 s with dt = .* diverges \(beta is below") as caught:
        s.run(0.08, 0.02)
    assert len(caught.value.history) > 2 and caught.value.result.t == [0.0]
    assert (s.points.corners == before.corners).all() and s.t == 0, "the last good state is lost"


def test_a_step_that_does_not_converge_is_cut_and_grows_again():
    s, probe = beam(fluid=False, ramp=1.0)
    s.coupler.max_iterations = 5
    result = s.run(3.0, 1.0, probes=probe)
    whole, _ = beam(fluid=False, ramp=1.0)
    reference = whole.run(1.0, 0.1, probes=probe).displacement[-1]
    assert result.converged and result.cuts > 0
    assert 3 < result.steps < 30 and result.t == [0, 1, 2, 3]
    assert result.displacement[-1] == pytest.approx(reference, rel=2e-3)


def test_the_state_of_the_last_good_step_goes_on_after_giving_up():
    s, probe = beam()
    s.run(0.04, 0.02)
    s.coupler.max_iterations = 0
    with pytest.raises(mpm.GaveUp, match=r"at t = 0.04 s .*no convergence in 0 iterations"):
        s.run(0.08, 0.02)
    s.coupler.max_iterations = 25
    resumed = s.run(0.08, 0.02, probes=probe).displacement[-1]
    whole, _ = beam()
    assert (resumed == whole.run(0.08, 0.02, probes=probe).displacement[-1]).all()


def test_without_a_fluid_there_is_no_storage_problem():
    s, _ = beam(fluid=False)
    assert s.storage is None
    assert np.isfinite(s.run(0.04, 0.02).wall)
