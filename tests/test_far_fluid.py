# SPDX-License-Identifier: MIT
"""A body that is far away changes nothing: what is owed to points, and what is sealed, is asked of each part."""

from functools import cache

import numpy as np
import pytest
import ufl
from scipy.ndimage import label

import mpm_dolfinx as mpm
from mpm_dolfinx.problems.parts import parts_of_cells

AWAY = (np.array([1.9, 0.0]), np.array([2.4, 2.0]))  # m, around the far body


def source(points, q):
    return 1e-3 * ufl.conditional(ufl.gt(points.position[0], 1.8), 1.0, 0.0) * q * points.dx


FAR = {
    "resting": {"displacements": [mpm.Displacement("bottom", (0, 0), region=AWAY)]},
    "moving": {
        "displacements": [
            mpm.Displacement(side, lambda t, X: np.array([0.3 * np.sin(2 * np.pi * t), 0.0]), region=AWAY)
            for side in ("bottom", "top")
        ]
    },
    "draining": {
        "displacements": [mpm.Displacement("bottom", (0, 0), region=AWAY)],
        "drained": [mpm.Drained("right", lambda t: 1e3 * t, region=AWAY)],
    },
    "fed": {"displacements": [mpm.Displacement("bottom", (0, 0), region=AWAY)], "sources": [source]},
}


@cache
def sealed_beam(far=None, load=54e3):
    """Return what a load cycle leaves of a sealed beam: its change of volume, stresses, pressures and places."""
    h = 0.1
    grid = mpm.Grid([2.6, 1.2], [26, 12])
    bodies = [mpm.box(grid, [0, 0.65], [1, 0.95])]
    soils = [mpm.Hencky(bulk=1e7 / 3, shear=5e6, conductivity=1e-4)]
    if far:
        bodies.append(mpm.box(grid, [2.0, 0.6], [2.3, 0.9], material=1))
        soils.append(mpm.Hencky(bulk=3e7, shear=2e7, conductivity=1e-4))
    pressed = mpm.Traction("top", lambda t: (0, -load * (1 - abs(2 * t - 1))), region=((0, -1), (1.0 + h, 9)))
    s = mpm.Simulation(
        grid, bodies, soils, fluid=mpm.Fluid(), fixed={"left": "xy"}, tractions=[pressed], **FAR.get(far, {})
    )
    s.run(1.0, 0.1, progress=False)
    own, p = slice(len(bodies[0])), s.points
    volume = (p.volume0 * (p.J - 1 + 0.4 / 2.2e9 * p.pressure))[own].sum() / 0.3
    return volume, s.effective_stress()[own], p.pressure[own], p.x[own]


@pytest.mark.parametrize("far", FAR)
def test_a_sealed_beam_does_not_see_a_body_far_away(far):
    """One that moved changed the stress left by 2e-3; one that drained let the volume drift eleven times as far."""
    alone, beside = sealed_beam(), sealed_beam(far)
    assert abs(beside[0]) < 2e-4 and beside[0] == pytest.approx(alone[0], rel=1e-6)
    for values, values0 in zip(beside[1:], alone[1:], strict=True):
        assert values == pytest.approx(values0, rel=0, abs=1e-8 * np.abs(values0).max())


def test_cells_with_common_nodes_are_one_part():
    rng = np.random.default_rng(1)
    for shape, share in (((13, 11), 0.15), ((7, 6, 5), 0.06)):
        grid = mpm.Grid([1.0] * len(shape), shape)
        filled = rng.random(int(np.prod(shape))) < share
        part, count = parts_of_cells(grid, filled[grid.cell_number])
        expected, number = label(filled.reshape(shape), structure=np.ones((3,) * len(shape)))
        assert count == number > 3 and (part == expected.ravel()[grid.cell_number]).all()
