# SPDX-License-Identifier: MIT
"""Flow with a free surface: a conductivity that vanishes above it."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

UPPER, LOWER, WIDTH, TOP, K = 10.0, 2.0, 9.6, 12.0, 1e-5  # m, m, m, m, m/s


def dam(cells, heads=(UPPER, LOWER), **options):
    """Return a rectangular dam of hard soil on an impervious base, so many cells high, with water at its two sides."""
    h = TOP / cells
    grid = mpm.Grid([WIDTH + 2 * h, TOP + 2 * h], [round(WIDTH / h) + 2, cells + 2])
    law = mpm.unsaturated(0.5 * 9810 * h)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=K, conductivity_law=law)
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [h, 0], [WIDTH + h, TOP])],
        [soil],
        fluid=mpm.Fluid(),
        fixed={"bottom": "xy"},
        drained=[mpm.water(side, level)[1] for side, level in zip(("left", "right"), heads, strict=True)],
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(UPPER),
        **options,
    )


@pytest.mark.parametrize("cells, error", [(20, 0.01), pytest.param(40, 0.005, marks=pytest.mark.slow)])
def test_a_dam_lets_through_what_dupuit_and_charny_say(cells, error):
    """Q = k (H1^2 - H2^2) / (2 L), whatever the free surface, which ends on a seepage face above the tail water."""
    s = dam(cells)
    s.run(600, 20, progress=False)
    flow = K * (UPPER**2 - LOWER**2) / (2 * WIDTH)
    assert s.outflows == pytest.approx([-flow, flow], rel=error)
    cell, h = s.cells(), TOP / cells
    left, right = (
        cell.x[(np.abs(cell.x[:, 0] - x) < h) & (cell.pressure > 0), 1].max() for x in (1.5 * h, WIDTH + 0.5 * h)
    )
    assert UPPER - 1.5 * h < left < UPPER + h and LOWER + h < right < 0.7 * UPPER


def test_between_equal_levels_water_is_at_rest():
    s = dam(10, heads=(UPPER, UPPER), initial_stress=mpm.K0(0.3))
    s.run(20, 20, progress=False)
    assert np.abs(s.outflows).max() < 1e-12 * K
    cell = s.cells()
    assert cell.pressure == pytest.approx(9810 * (UPPER - cell.x[:, 1]), abs=1e-6 * 9810)


def test_what_drains_above_a_surface_that_falls_is_not_known():
    """It falls at once: pores above it count as full. A limit that the pages tell of."""
    s = dam(10, heads=(UPPER, UPPER))
    s.run(20, 20, progress=False)
    s.stage(drained=[mpm.water(side, lambda t: max(LOWER, UPPER - (t - 20) / 10))[1] for side in ("left", "right")])
    s.run(120, 10, progress=False)
    cell = s.cells()
    assert cell.x[cell.pressure > 0, 1].max() < LOWER + 2 * TOP / 10
    assert s.outflows.sum() * 100 < 0.01 * 0.3 * WIDTH * (UPPER - LOWER), "the last flow, for all of the time"


@pytest.mark.parametrize("arguments, said", [((0.0,), "suction = 0.0"), ((1e3, 1.0), "least = 1.0")])
def test_what_is_no_such_law_is_refused(arguments, said):
    with pytest.raises(ValueError, match=f"unsaturated: {said}"):
        mpm.unsaturated(*arguments)
