# SPDX-License-Identifier: MIT
"""A slice of one cell between smooth walls, in 3D, is in plane strain: stresses, pressures and displacements agree."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

PLANE = [0, 2]  # axes of the slice that plane strain has


def scene(across, make):
    """Return a scene in plane strain (0), or of a slice of a number of cells, after three steps.

    make: function that returns size, walls and options of the body, from a function that maps (x, z) into the scene.
    """
    flat = across == 0

    def place(x, z, y=0.0):
        return (x, z) if flat else (x, y, z)

    grid = mpm.Grid(place(0, 0, 0), place(0.6, 0.4, 0.1 * across), [6, 4] if flat else [6, across, 4])
    low, high, soil, walls, load, options = make(place)
    body = mpm.box(grid, place(*low), place(*high, 0.1 * across))
    held = {side: axes.replace("z", "y" if flat else "z") for side, axes in walls.items()}
    conditions = [
        mpm.Traction("top", lambda t: place(0, load * min(1, t)), region=(place(0.2, 0, -1), place(0.4, 1, 1)))
    ]
    options = {"numerics": mpm.Numerics(tolerance=1e-11)} | options
    conditions += options.pop("conditions", [])
    walls = held if flat else held | {"front": "y", "back": "y"}
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=conditions, **options)
    s.run(1.0, 1 / 3, progress=False)
    return s


def beam(soil, **options):
    """Return a function that makes a clamped beam in bending."""
    return lambda place: ((0, 0.03), (0.5, 0.27), soil, {"left": "xz"}, -6e3, options)


def ground(soil, **options):
    """Return a function that makes loaded ground with an initial stress."""

    def make(place):
        weighs = {"gravity": place(0, -10.0), "initial_stress": mpm.K0(0.6, surcharge=2e3)}
        walls = {"left": "x", "right": "x", "bottom": "z"}
        return (0, 0), (0.6, 0.27), soil, walls, -3e3, weighs | {"conditions": [mpm.Pressure("top", 2e3)]} | options

    return make


def fields(s):
    """Return displacements, effective stresses, pressures and positions of the points in the plane."""
    X = s.points.origin.mean(axis=1)
    axes = [*range(s.grid.dim), 2][:3] if s.grid.dim == 2 else [0, 2, 1]
    stress = s.point_fields().effective_stress[:, axes][:, :, axes]
    moved, plane = s.points.x - X, PLANE if s.grid.dim == 3 else [0, 1]
    order = np.lexsort((X[:, 1] if s.grid.dim == 3 else 0 * X[:, 0], *np.round(X[:, plane], 9).T))
    return [values[order] for values in (moved[:, plane], stress, s.points.pressure)]


CLAY = mpm.ModifiedCamClay(M=1.0, lambda_=0.1, kappa=0.02, shear=3e5, initial_stress=(-1e3, -1e3, -1e3), OCR=1.2)
STIFF = {"bulk": 5e7 / 3, "shear": 1e6 / 3}  # nu = 0.49
SOFT = {"bulk": 1e6, "shear": 5e5}
STRENGTH = {"bulk": 2e6, "shear": 1e6, "friction": 25.0, "cohesion": 1e4}


def slow(*case):
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("make", "yields"),
    [
        (beam(mpm.NeoHookean(**SOFT), fluid=mpm.Fluid()), False),
        (beam(mpm.NeoHookean(**STIFF)), False),
        (beam(mpm.DruckerPrager(**STRENGTH, dilation=10.0), fluid=mpm.Fluid()), True),
        (ground(mpm.NeoHookean(**SOFT)), False),
        slow(beam(mpm.Hencky(**STIFF), fluid=mpm.Fluid()), False),
        slow(beam(mpm.MohrCoulomb(**STRENGTH, dilation=0.0), fluid=mpm.Fluid()), True),
        slow(ground(mpm.Hencky(**STIFF), fluid=mpm.Fluid()), False),
        slow(ground(CLAY), True),
        slow(beam(mpm.NeoHookean(**STIFF), numerics=mpm.Numerics(quadrature="point", tolerance=1e-11)), False),
    ],
    ids=[
        "wet",
        "nearly incompressible",
        "wet soil that yields and dilates",
        "stress at rest",
        "nearly incompressible, wet",
        "Mohr-Coulomb, wet",
        "nearly incompressible, stress at rest",
        "Cam Clay, stress at rest",
        "a point a cell",
    ],
)
def test_a_slice_between_smooth_walls_is_in_plane_strain(make, yields):
    flat, slab = (scene(across, make) for across in (0, 1))
    assert yields == bool(flat.scene.materials.evolved(flat.points).any())
    for one, other in zip(fields(flat), fields(slab), strict=True):
        assert other == pytest.approx(np.repeat(one, 2, axis=0), abs=1e-7 * np.abs(one).max())
