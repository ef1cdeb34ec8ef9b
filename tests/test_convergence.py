# SPDX-License-Identifier: MIT
"""Orders of convergence to exact solutions; each order has a minimum, and each error a maximum."""

from functools import cache

import numpy as np
import pytest
import self_weight_column
import terzaghi
from helpers import rates

consolidated = cache(terzaghi.run)

# ---- Terzaghi: in space, against the exact solution of what backward Euler leaves of the equation ----


def backward_euler(z, steps, size):
    """Return p / p0 at depths z and the consolidation after equal steps of backward Euler, exact in space."""
    m = (np.arange(4000) + 0.5) * np.pi
    left = (1 + m**2 * size) ** -float(steps)
    return (2 / m * np.sin(np.outer(z, m)) * left).sum(axis=1), 1 - (2 / m**2 * left).sum()


@cache
def errors_in_space(cells, steps=20):
    """Return the largest errors of p / p0 and of the consolidation over depth and time, with equal time steps."""
    out = terzaghi.run(cells, steps, method="backward-euler")
    exact = [backward_euler(z, k + 1, 1 / steps) for k, z in enumerate(out.z)]
    p = max(np.abs(p - e[0]).max() for p, e in zip(out.p, exact, strict=True))
    return p, max(abs(s - e[1]) for s, e in zip(out.settlement, exact, strict=True))


@pytest.mark.parametrize("which, ceiling", [(0, 4e-4), (1, 1e-4)], ids=["pressure", "settlement"])
def test_consolidation_is_of_second_order_in_the_cell_size(which, ceiling):
    errors = [errors_in_space(cells)[which] for cells in (10, 20, 40, 80)]
    assert rates(errors).min() > 1.7 and errors[-1] < ceiling, errors


@pytest.mark.parametrize("method, order", [("sdirk2", 1.9), ("backward-euler", 0.9)])
def test_consolidation_in_time_is_of_the_order_of_the_method(method, order):
    """Errors of cell pressures at T_v = 0.5 and 1, compared with a run in which the error in time is negligible."""
    runs = [terzaghi.run(20, steps, method=method) for steps in (10, 20, 40)]
    true = consolidated(20, 320)
    for time in (0.5, 1.0):
        errors = [np.abs(out.p[out.at(time)] - true.p[true.at(time)]).max() for out in runs]
        assert rates(errors).min() > order, errors


def test_consolidation_is_as_exact_as_its_cells_in_a_hundred_steps():
    errors = terzaghi.errors(terzaghi.run(50, 100))
    assert max(errors[name] for name in ("p_0.1", "p_0.5", "p_1")) < 2e-4 and errors["settlement"] < 2e-4, errors


def test_steps_chosen_by_their_error_keep_to_it():
    out = terzaghi.run(50, rtol=1e-3)
    errors = terzaghi.errors(out)
    assert max(errors[name] for name in ("p_0.1", "p_0.5", "p_1")) < 1e-3 and out.result.steps <= 40, errors


@pytest.mark.parametrize("strain", [1e-4, 1e-7])
def test_consolidation_does_not_depend_on_how_small_the_load_is(strain):
    """Domains that leave their cells by very small distances must not close the faces between cells."""
    p = terzaghi.run(50, 50, strain).p
    assert max(np.abs(a - b).max() for a, b in zip(p, consolidated(50, 50).p, strict=True)) < 3 * max(strain, 1e-5)


# ---- column under its own weight ----


@cache
def column_errors(cells, quadrature="domain"):
    return self_weight_column.errors(self_weight_column.run(cells, 40, quadrature))


CEILINGS = {4: 3.5e-2, 8: 1.1e-2, 16: 3.7e-3, 32: 1e-3, 64: 4.4e-4}  # published for GIMP: those of 16 and 64


@pytest.mark.parametrize("cells", CEILINGS)
def test_the_columns_stress_is_as_good_as_published(cells):
    assert column_errors(cells)["stress"] < CEILINGS[cells]


@pytest.mark.parametrize("cells, ceiling", [(16, 4e-4), (32, 5e-5), (64, 8e-6)])
def test_the_columns_stress_varies_within_domains(cells, ceiling):
    """With one gradient per domain, errors were 9.8e-4, 3.0e-4 and 1.3e-4; its heights were accurate only by chance."""
    assert column_errors(cells)["stress"] < ceiling


def test_the_columns_stress_converges_with_the_cell_size():
    errors = [column_errors(cells)["stress"] for cells in (4, 8, 16, 32)]
    assert rates(errors).min() > 1.5, errors


@pytest.mark.parametrize("cells, ceiling", [(16, 4.5e-4), (32, 1.2e-4), (64, 3e-5)])
def test_the_columns_height_is_exact(cells, ceiling):
    assert column_errors(cells)["height"] < ceiling


def test_the_columns_stress_does_not_converge_when_integrated_at_the_points():
    errors = [column_errors(cells, "point")["stress"] for cells in (8, 16, 32, 64)]
    assert min(errors) > 0.03, errors
