# SPDX-License-Identifier: MIT
"""A column of sand collapses, with the run-out of experiments."""

import pytest
from collapse import CELLS, SCATTER, STEPS, collapsed, published


@pytest.mark.slow
@pytest.mark.parametrize("renewal", [False, True])
def test_a_column_of_sand_runs_out_as_far_as_lube_s(renewal):
    """The column is as high as wide. It comes to rest, and energies balance to 2 % of the weight's work."""
    one = collapsed(1.0, CELLS[1.0], STEPS, renewal=renewal)
    assert (one.result.renewals > 20) is renewal
    assert one.run_out == pytest.approx(published(1.0), rel=SCATTER)
    assert one.lost < 0.02 and one.left < 1e-3
