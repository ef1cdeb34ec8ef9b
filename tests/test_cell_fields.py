# SPDX-License-Identifier: MIT
"""Fields of the cells are of second order and up to date, and do not affect a run."""

import manufactured as made
import numpy as np
import pytest
from helpers import SOFT, beam, column

import mpm_dolfinx as mpm


def test_fields_of_the_cells_are_of_second_order():
    """Displacement, pressure, effective and total stress, at the centroids of the material in the cells.

    On twice as many cells again, the order of stresses is 1.6, with linear or constant gradients in domains.
    """
    errors = []
    for cells in (6, 24):
        s = made.scene(cells)
        for _ in range(2 * cells):
            s.step(6.0 / cells)
        errors.append(made.errors_of_cells(s))
    errors = np.array(errors)
    assert np.log2(errors[0] / errors[1]).min() / 2 > 1.65 and errors[-1].max() < 1.5e-3, errors


@pytest.mark.parametrize("load", [1e-6, 0.1], ids=["points that stay in their cells", "points that leave them"])
def test_an_undrained_column_has_its_stresses_and_volume(load):
    q = load * SOFT.oedometric
    s = column(offset=0.3, fluid=mpm.Fluid(bulk=5e6), conditions=[mpm.Traction("top", (0, -q))])
    s.step(1.0)
    cells = s.cells()
    assert (s.state.stay is not None) == (load < 1e-5)
    assert cells.stress[:, 1, 1] == pytest.approx(-q, rel=1e-3)
    assert cells.effective_stress[:, 1, 1] + q == pytest.approx(cells.pressure, rel=1e-3, abs=1e-3 * q)
    assert cells.volume @ cells.x / cells.volume.sum() == pytest.approx(s.points.x.mean(axis=0), rel=1e-3)
    assert cells.volume.sum() == pytest.approx((s.points.volume0 * s.points.J).sum(), rel=1e-12)


def test_a_scene_at_rest_has_fields_before_its_first_step_and_without_fluid():
    s = column(fluid=False)
    cells = s.cells()
    assert cells.pressure is None and np.array_equal(cells.stress, cells.effective_stress)
    assert np.abs(cells.displacement).max() < 1e-15 and cells.volume == pytest.approx(0.01)
    wet = column(pressure=5e3)
    assert wet.cells().pressure == pytest.approx(5e3) and wet.cells().stress[:, 0, 0] == pytest.approx(-5e3)


def test_looking_at_the_cells_changes_no_bit_of_a_run_nor_of_an_old_state():
    runs = []
    for look in (False, True):
        s, _ = beam(h=0.06)
        s.run(0.04, 0.02, progress=False)
        before = s.state
        seen = s.cells() if look else None
        s.run(0.1, 0.02, after=s.result, observe=lambda s, look=look: s.cells() if look else None, progress=False)
        runs.append((s.points.x, s.points.pressure, s.points.F))
    assert all(np.array_equal(a, b) for a, b in zip(*runs, strict=True))
    s.state = before
    assert np.array_equal(s.cells().pressure, seen.pressure) and np.array_equal(s.cells().stress, seen.stress)
