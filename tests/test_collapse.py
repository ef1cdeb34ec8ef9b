# SPDX-License-Identifier: MIT
"""A column of sand collapses and runs out as in experiments."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

G, REPOSE = 9.81, np.radians(31)


def collapsed(n, aspect=1.0, steps=26, lasts=3.5):
    """Return a run of a column, 1 m wide, n cells, that is let go; its depths in columns half a cell wide, and these.

    steps: in the time in which it would fall by half its height; lasts: so many of these times.
    Sand that flows in simple shear without dilating bears sin phi of its pressure there: that is tan of its repose.
    """
    h, height = 1 / n, aspect
    grid = mpm.Grid([0, 0], [5.0, height + 2 * h], [5 * n, round(height * n) + 2])
    column = mpm.box(grid, [0, 0], [1, height])
    young = 200 * 1560 * G * height
    soil = mpm.MohrCoulomb(
        bulk=young / 1.2,
        shear=young / 2.6,
        friction=np.degrees(np.arcsin(np.tan(REPOSE))),
        dilation=0.0,
        cohesion=1e-3 * 1560 * G * height,
        porosity=0.4,
        grain_density=2600.0,
    )
    gate = mpm.Displacement("right", (0, 0), "x")
    options = {"walls": {"left": "x", "bottom": "xy"}, "gravity": (0, -G), "inertia": False}
    s = mpm.Simulation(grid, [column], [soil], conditions=[gate], **options)
    s.run(1.0, 1.0, progress=False)
    s.stage(inertia=True, conditions=[])
    fall = np.sqrt(height / G)
    energies = s.run(1.0 + lasts * fall, fall / steps, energies=True, progress=False).energies
    low, high = (end(s.points.corners[:, :, 0], axis=1) for end in (np.min, np.max))
    edges = np.arange(0, 5.0 + h / 4, h / 2)
    share = np.clip((edges - low[:, None]) / (high - low)[:, None], 0, 1)
    depth = (s.points.volume0 * s.points.J) @ np.diff(share, axis=1) / (h / 2)
    return energies, edges, depth


@pytest.mark.slow
def test_a_column_of_sand_runs_out_as_far_as_lube_s():
    """Lube et al. (2005): by 1.2 times its width, as high as wide; front where it is a few grains deep."""
    e, edges, depth = collapsed(8)
    front = edges[np.flatnonzero(depth > 0.05).max() + 1]
    assert front - 1 == pytest.approx(1.2, rel=0.15)
    assert depth[edges[:-1] > front].sum() * 0.0625 < 0.03  # a thin sheet runs on
    total = e["kinetic"] + e["elastic"] + e["dissipated"] - e["external"]
    assert np.abs(total - total[0]).max() < 0.06 * e["external"][-1] and e["kinetic"][-1] < 0.02 * e["external"][-1]
    print(front - 1, np.abs(total - total[0]).max() / e["external"][-1], e["kinetic"][-1] / e["external"][-1])
