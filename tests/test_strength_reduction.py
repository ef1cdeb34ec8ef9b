# SPDX-License-Identifier: MIT
"""The factor of safety: exact for a block, limit analysis and published values for slopes; what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import slope
from helpers import SOFT, column

import mpm_dolfinx as mpm

C, PHI, EXACT = 1e4, 20.0, 1.5
CLAY = mpm.MohrCoulomb(bulk=2e8, shear=1e8, friction=PHI, dilation=0.0, cohesion=C)
CONE = mpm.DruckerPrager(bulk=2e8, shear=1e8, friction=PHI, dilation=PHI, cohesion=C)


def strength(factor):
    """Return what a block in plane strain carries with its strength over a factor, Pa."""
    return 2 * C / factor * np.tan(np.pi / 4 + np.arctan(np.tan(np.radians(PHI)) / factor) / 2)


LOAD = strength(EXACT)


def block(materials, load=LOAD, **options):
    """Return a block on a smooth floor at rest under a load on its top, its right side free."""
    grid = mpm.Grid([1.0, 1.0], [4, 4])
    half = (mpm.box(grid, [0, 0], [0.5, 0.25]), mpm.box(grid, [0, 0.25], [0.5, 0.5], material=len(materials) - 1))
    top = mpm.Traction("top", lambda t: (0, -load * min(1, t)), region=((0, 0.3), (0.5, 1)))
    walls = {"left": "x", "bottom": "y"}
    s = mpm.Simulation(grid, half, materials, fixed=walls, tractions=[top], **options)
    s.run(1, 1)
    return s


@cache
def at_rest():
    return block([CLAY])


@pytest.mark.parametrize("materials", [[CLAY], [CONE, replace(CONE, cohesion=lambda X: C + 0 * X[:, 0])]])
def test_a_block_carries_what_its_strength_over_the_factor_does(materials):
    s = block(materials)
    state = s.state
    safety = mpm.factor_of_safety(s, rtol=0.005)
    assert safety.factor == pytest.approx(EXACT, rel=0.005)
    assert safety.bounds[1] < 1.006 * safety.bounds[0]
    assert s.state is state, "the simulation is what it was"


def test_a_block_that_is_too_weak_has_a_factor_below_one():
    strong = replace(CLAY, cohesion=lambda X: 2 * C + 0 * X[:, 0], friction=lambda X: PHI + 0 * X[:, 0])
    s = block([strong], load=strength(0.9))
    s.stage(fields={"cohesion": C})
    assert mpm.factor_of_safety(s).factor == pytest.approx(0.9, rel=0.01)


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (lambda: block([SOFT], load=1e4), {}, "no material has a strength, must have friction and cohesion"),
        (at_rest, {"rtol": 0}, r"rtol = 0, must be in \[1e-4, 0.5\]"),
        (at_rest, {"steps": 3}, "steps = 3, must be an integer >= 8"),
        (at_rest, {"dt": -1}, "dt = -1, must be > 0 and finite"),
        (lambda: block([CLAY], load=0.0), {}, "have no stress, must be at rest under what acts on them"),
        (lambda: block([CLAY], load=-10.0), {}, "come to rest with strength / 16, must not at some factor"),
        (
            lambda: column(cells=2, material=replace(CLAY, conductivity=1e-5)),
            {},
            "dt is not given, must be where fluid flows",
        ),
        (
            lambda: column(
                cells=2,
                fluid=False,
                material=mpm.ModifiedCamClay(M=1, lambda_=0.1, kappa=0.02, shear=1e6, initial_stress=(-1e5,) * 3),
            ),
            {},
            "strength of ModifiedCamClay is none that can be divided, must be a law with friction",
        ),
    ],
)
def test_one_line_says_what_is_wrong(make, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        mpm.factor_of_safety(make(), **options)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_slope_slides_where_limit_analysis_says():
    """Log-spiral 1.368; finite elements 1.4 (Griffiths and Lane 1999)."""
    assert 1.368 < mpm.factor_of_safety(slope.slope(10)).factor < 1.4


@pytest.mark.slow
def test_the_slope_of_a_bench_mark_slides_at_its_own_weight(monkeypatch):
    """ACADS 1a, c = 3 kPa, phi = 19.6 degrees: 0.985 to 1.00; it is at rest with twice the strength."""
    monkeypatch.setattr(slope, "COHESION", 2 * 3e3)
    monkeypatch.setattr(slope, "FRICTION", np.degrees(np.arctan(2 * np.tan(np.radians(19.6)))))
    assert 0.98 * 0.985 < mpm.factor_of_safety(slope.slope(10)).factor / 2 < 1.02
