# SPDX-License-Identifier: MIT
"""Mandel's slab is compared with its exact solution, the cantilever with rod theory and converged finite elements."""

from functools import cache

import cantilever
import mandel
import numpy as np
import pytest
from helpers import rates

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

# ---- Mandel: in space, against the exact solution of what backward Euler leaves of the equation ----


def backward_euler(x, stages, steps):
    """Return p (Pa) at x after some stages of mandel.SAMPLES by backward Euler, exact in space, as a sum of modes."""
    ratio = (1 - mandel.NU) / (0.5 - mandel.NU)  # tan r = ratio r
    n, r = np.arange(4000) * np.pi, (np.arange(4000) + 0.5) * np.pi
    for _ in range(60):  # contracts
        r = n + np.arctan(ratio * r)
    left = np.prod([(1 + r**2 * T / steps) ** -float(steps) for T in np.diff((0, *mandel.SAMPLES[:stages]))], axis=0)
    shapes = np.cos(np.multiply.outer(x / mandel.WIDTH, r)) - np.cos(r)
    return mandel.FORCE / (2 * mandel.WIDTH) * shapes @ (left * 2 * np.sin(r) / (r - np.sin(r) * np.cos(r)))


@cache
def slab(cells, steps, method="sdirk2"):
    return mandel.run(cells, steps, method)


def error_in_space(cells, stage, steps=10):
    """Return the largest error of p a / force over the cells at the end of a stage."""
    out = slab(cells, steps, "backward-euler")[1]
    k = (stage + 1) * steps - 1
    assert out.time[k] == pytest.approx(mandel.SAMPLES[stage])
    error = out.p[k] - backward_euler(out.x[k], stage + 1, steps)
    return np.abs(error).max() * mandel.WIDTH / mandel.FORCE


def test_the_modes_are_those_of_the_exact_solution():
    x = np.linspace(0, 1, 11)
    t = mandel.WIDTH**2 / mandel.EXACT.cv
    assert backward_euler(x, 4, 10**6) == pytest.approx(mandel.EXACT.pressure(x, t), abs=1e-5 * mandel.FORCE)


@pytest.mark.parametrize(
    "stage, ceiling", [(0, 1.2e-3), (1, 1.3e-4), (2, 6e-5), (3, 5e-5)], ids=map(str, mandel.SAMPLES)
)
def test_the_slabs_pressure_is_of_second_order_in_the_cell_size(stage, ceiling):
    errors = [error_in_space(cells, stage) for cells in (10, 20, 40)]
    assert rates(errors).min() > 1.8 and errors[-1] < ceiling, errors


def test_the_pressure_rise_in_the_middle_is_exact_within_three_per_mille():
    errors, out = mandel.run()
    peak = max(p[0, 0] for p in out.p) * mandel.WIDTH / mandel.FORCE
    assert peak > 0.55  # 0.5 at first
    assert errors["p_max"] < 3e-4 and errors["p_rise"] < 3e-3
    assert max(error for name, error in errors.items() if name != "p_rise") < 1.2e-3


def test_the_plate_stays_even_and_settles_as_exact():
    errors, out = slab(40, 30)
    spread = [np.ptp(top) / top.mean() for top in out.settlement]
    assert max(spread) < 1e-5 and errors["settlement"] < 4e-4


# ---- cantilever ----


@cache
def finite_elements():
    """Return the displacement (2,) of the tip at alpha = 1 and 5 by Taylor-Hood elements, converged to 1e-5."""
    body = [cantilever.LENGTH, cantilever.HEIGHT]
    fem = BiotFEM(mpm.Grid([0, 0], body, [40, 4]), cantilever.RUBBER, **cantilever.PHYSICS)
    result = fem.run(5, 0.5, probes=[[body[0], body[1] / 2]])
    return {alpha: result.displacement[round(2 * alpha)][0] for alpha in (1, 5)}


@cache
def bent(cells):
    return cantilever.run(cells, 40, last=5)


def tip_error(cells, alpha):
    tip = bent(cells)[1].axis[alpha][-1] - [cantilever.LENGTH, 0]
    return np.linalg.norm(tip - finite_elements()[alpha]) / cantilever.LENGTH


@pytest.mark.parametrize("alpha, ceiling", [(1, 6e-4), (5, 1.5e-3)])
def test_the_cantilevers_tip_is_the_rods(alpha, ceiling):
    errors = bent(8)[0]
    assert max(errors[f"v_{alpha}"], errors[f"u_{alpha}"]) < ceiling


@pytest.mark.parametrize("alpha, ceiling", [(1, 5.5e-4), (5, 1.2e-3)])
def test_the_cantilevers_tip_is_the_finite_elements(alpha, ceiling):
    assert tip_error(8, alpha) < ceiling


def test_the_cantilevers_tip_converges_to_the_finite_elements():
    errors = [tip_error(cells, 5) for cells in (4, 8, 16)]
    assert rates(errors).min() > 1.85 and errors[-1] < 1.2e-4, errors  # the elements are converged to 1e-5


def test_the_finite_elements_differ_from_the_rod_by_the_rods_own_error():
    for alpha, ceiling in ((1, 1e-4), (5, 8e-4)):
        assert np.abs(finite_elements()[alpha] + [cantilever.LENGTH, 0] - cantilever.rod(alpha)[-1]).max() < ceiling


@pytest.mark.slow
def test_the_cantilever_hangs_as_the_rod_does():
    errors, _ = cantilever.run(16, 40)
    assert max(errors.values()) < 1.1e-3, errors
