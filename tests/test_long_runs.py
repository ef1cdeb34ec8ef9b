# SPDX-License-Identifier: MIT
"""Many load cycles: the beam returns, and volume and fluid are conserved."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import SOFT

import mpm_dolfinx as mpm

STEPS = 40  # in a cycle


def cycle(h, cycles, material=SOFT, observe=(), **options):
    """Return (simulation, result) of the beam after `cycles` load cycles."""
    grid = mpm.Grid([0, 0], [1.2, 1.2], [round(1.2 / h)] * 2)
    bottom = (round(0.6 / h) + 0.5) * grid.h[1]
    body = mpm.box(grid, [0, bottom], [1, bottom + 0.3])
    load = mpm.Traction("top", lambda t: (0, -27e3 * (1 - np.cos(2 * np.pi * t))), region=((0.05, -1), (1.0, 9)))
    s = mpm.Simulation(
        grid, [body], [material], walls={"left": "xy"}, conditions=[load, *options.pop("conditions", [])], **options
    )
    return s, s.run(cycles, 1 / STEPS, probes=mpm.probes([body], [[1, bottom + 0.15]]), observe=observe)


def returned(result):
    """Return the residual deflection after each cycle, relative to the largest."""
    tip = np.array(result.displacement)[:, 0, 1]
    return np.abs(tip[STEPS::STEPS]) / np.abs(tip).max()


@pytest.mark.slow
def test_a_beam_comes_back_after_2000_steps():
    """0.17 % with h = 0.015 m, 0.65 % with 0.03 m: the residual grows equally in each cycle, and is proportional to
    h^2.
    """
    s, result = cycle(0.02, 50)
    assert result.steps == 2000 and returned(result)[-1] < 5e-3
    assert (s.points.volume0 * s.points.J).sum() == pytest.approx(0.3, rel=1e-4)


def test_what_is_left_of_a_cycle_falls_with_the_cell_size():
    left = [returned(cycle(h, 2)[1]) for h in (0.06, 0.03)]
    assert left[1][-1] < 3e-4 and left[1][-1] < 0.4 * left[0][-1]


@pytest.mark.parametrize(
    ("conductivity", "bulk", "cycles", "most"),
    [
        (0.0, 2.2e9, 1, 2e-7),
        (SOFT.conductivity, np.inf, 1, 3e-6),
        pytest.param(SOFT.conductivity, 2.2e9, 4, 3e-6, marks=pytest.mark.slow),
    ],
)
def test_a_sealed_beam_keeps_the_volume_of_its_domains(conductivity, bulk, cycles, most):
    """Corners do not exactly follow the Q1 field: 7e-5 of the volume in a cycle. The volume defect is corrected.

    The remaining error, from the last step, does not grow.
    """
    volumes = []

    def observe(s):
        points = s.points
        volumes.append(points.volume0 @ (points.J - 1 + SOFT.porosity / bulk * points.pressure) / 0.3)

    material = replace(SOFT, conductivity=conductivity)
    s, result = cycle(0.05, cycles, material=material, observe=observe, fluid=mpm.Fluid(bulk=bulk))
    assert result.steps == cycles * STEPS + result.rejected and result.balance < 1e-8
    print(f"{cycles} cycles, k = {conductivity:g} m/s, K_w = {bulk:g} Pa: volume {volumes[-1]:.1e}")
    assert abs(volumes[-1]) < most and s.points.data["owed"].any(), volumes[-1]


@pytest.mark.parametrize("bulk", [2.2e9, 2e5])
def test_a_sealed_beam_keeps_the_mass_of_compressible_water_that_flows(bulk):
    """A balance of volume would lose 2e-6 of the beam's volume in a cycle, and 9e-4 with the softer water."""
    rows = []

    def observe(s):
        points, carried = s.points, s.state.pieces
        density = np.zeros(len(points))
        np.add.at(density, np.searchsorted(points.id, carried.id), carried.fraction * np.exp(carried.pressure / bulk))
        mass, owed = (points.J - 1 + SOFT.porosity) * density, points.data["owed"]
        rows.append(points.volume0 @ np.stack([mass - owed, owed], axis=1) / (0.3 * SOFT.porosity) - [1, 0])

    _, result = cycle(0.05, 2, observe=observe, fluid=mpm.Fluid(bulk=bulk))
    came, owed = np.abs(rows).max(axis=0)
    print(f"K_w = {bulk:g} Pa: mass {came:.1e}, owed {owed:.1e}")
    assert len(rows) >= 2 * STEPS and came < 1e-8 and owed < 1e-4 and result.balance < 1e-8
    assert abs(rows[-1][1]) < 5e-6
