# SPDX-License-Identifier: MIT
"""Limits of pressures at probes: no pressure passes those around it, and linear pressures stay exact."""

from itertools import product

import numpy as np
import pytest
from helpers import rates

import mpm_dolfinx as mpm
from mpm_dolfinx.probing.probe_fields import probe_pressures

SOIL = mpm.LinearElastic(bulk=1e7, shear=5e6, conductivity=1e-5)
WEIGHT = 9810.0
EVEN = {2: np.linspace(0, 1.2, 7), 3: np.linspace(0, 1.2, 7)}
UNEVEN = {dim: np.array([0.0, 0.1, 0.22, 0.36, 0.46, 0.7, 1.2]) for dim in (2, 3)}
DOWN = {2: (0, -9.81), 3: (0, 0, -9.81)}
ASLANT = {2: (4.0, -9.0), 3: (4.0, -3.0, -8.0)}
SCENES = [(dim, lines, g) for dim in (2, 3) for lines in (EVEN, UNEVEN) for g in (DOWN, ASLANT)]
NAMES = [f"{d}D {'even' if a is EVEN else 'uneven'} {'down' if g is DOWN else 'aslant'}" for d, a, g in SCENES]


def filled(dim, lines, gravity, pressure, top=1.0, placed=None, **options):
    """Return a saturated scene with these initial pressures, whose body ends within cells."""
    grid = mpm.Grid(lines=[lines] * dim, **options)
    body = mpm.box(grid, [0] * dim, [top] * dim)
    body = body if placed is None else mpm.mapped(grid, body, placed)
    walls = {"bottom": "xyz"[:dim]}
    return mpm.Simulation(grid, [body], [SOIL], fluid=mpm.Fluid(), walls=walls, gravity=gravity, pressure=pressure)


def probed(s, X):
    return probe_pressures(s.scene, s.state, mpm.probes(s.bodies, X))


@pytest.mark.parametrize("dim, lines, g", SCENES, ids=NAMES)
def test_no_probe_passes_the_pressures_or_the_heads_of_the_cells_around_it(dim, lines, g):
    """Each cell has a random pressure. All cells around those of the probes are filled."""
    rng, lines, g = np.random.default_rng(dim), lines[dim], np.array(g[dim])
    of = -(10 ** rng.uniform(2, 4.5, [6] * dim))
    cells = lambda x: tuple((np.searchsorted(lines, x, side="right") - 1).T)  # noqa: E731
    s = filled(dim, lines, g, lambda x: of[cells(x)], top=lines[-1])
    X = rng.uniform(lines[1], lines[-2], (300, dim))
    found, mine = probed(s, X), np.array(cells(X)).T
    middle = (lines[1:] + lines[:-1]) / 2
    values = [of[tuple((mine + step).T)] for step in product((-1, 0, 1), repeat=dim)]
    stills = [1000 * (X - middle[mine + step]) @ g for step in product((-1, 0, 1), repeat=dim)]
    extended = [value + still for value, still in zip(values, stills, strict=True)]
    for around in (values, extended):
        assert (found >= np.min(around, axis=0) - 1e-6).all() and (found <= np.max(around, axis=0) + 1e-6).all()
    assert (np.abs(found - of[cells(X)]) > 1.0).mean() > 0.5, "no constant in each cell"


@pytest.mark.parametrize("top", [1.0, 0.75])
@pytest.mark.parametrize("dim, lines, g", SCENES, ids=NAMES)
def test_a_linear_pressure_is_exact_up_to_all_sides(dim, lines, g, top):
    """Exact to the small weights of the fit, also where the gradients are aslant to the grid."""
    rng = np.random.default_rng(3)
    X = np.concatenate([rng.uniform(0, top, (60, dim)), list(product((0, top), repeat=dim))])
    for slope in (*rng.uniform(-1e4, 1e4, (3, dim)), 1000 * np.array(g[dim]), 0 * X[0]):
        s = filled(dim, lines[dim], g[dim], lambda x, slope=slope: 1e4 + x @ slope, top)
        assert probed(s, X) == pytest.approx(1e4 + X @ slope, abs=1e-8 * 4e4)


@pytest.mark.parametrize("g", [(0, -9.81), (3.0, -9.0), (-9.81, 0)], ids=str)
def test_water_at_rest_is_exact_up_to_sides_aslant(g):
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    placed = lambda X: [0.4, 0.1] + 0.6 * X @ turn  # noqa: E731
    s = filled(2, EVEN[2], g, lambda x: 1e4 + 1000 * x @ g, placed=placed)
    X = np.concatenate([np.random.default_rng(4).uniform(0, 1, (200, 2)), list(product((0, 0.5, 1), repeat=2))])
    assert probed(s, X) == pytest.approx(1e4 + 1000 * placed(X) @ g, abs=1e-8 * 4e4)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_smooth_pressure_is_second_order_accurate_everywhere(dim):
    """The pressure is smooth, with a maximum inside the body."""
    smooth = lambda x: 1e4 * np.cos(2 * x - 1.1).prod(axis=1)  # noqa: E731
    X, errors = np.random.default_rng(5).uniform(0, 1, (400, dim)), []
    for n in (8, 16, 32)[: 5 - dim]:
        s = filled(dim, np.linspace(0, 1.25, n + 1), DOWN[dim], smooth)
        errors.append(np.abs(probed(s, X) - smooth(X)).max())
    print(errors)
    assert rates(errors).min() > 1.8


@pytest.mark.parametrize("dim, even", [(2, True), (2, False), (3, True)], ids=["2D", "2D uneven", "3D"])
def test_behind_a_wetting_front_no_probe_is_wetter_than_the_wet_zone(dim, even):
    """Rain flows down at a unit gradient, so the pressure above the front is that of k_r = rain / conductivity."""
    heights = np.linspace(0, 4, 9) if even else np.array([0, 0.3, 0.7, 1.2, 1.8, 2.3, 2.7, 3.3, 4.0])
    grid = mpm.Grid(lines=[*[[0.0, 0.5]] * (dim - 1), heights])
    sand = mpm.Hencky(1e12, 1e12, conductivity=1e-5, retention=mpm.VanGenuchten(4905.0, residual=0.08, n=2.2))
    s = mpm.Simulation(
        grid,
        [mpm.box(grid, [0] * dim, [*[0.5] * (dim - 1), 4.0])],
        [sand],
        fluid=mpm.Fluid(),
        walls={"left": "x", "right": "x", "bottom": "xyz"[:dim], **({"front": "y", "back": "y"} if dim == 3 else {})},
        conditions=[mpm.Rain("top", 5.556e-6)],
        gravity=DOWN[dim],
        pressure=mpm.hydrostatic(-2.0),
        initial_stress=mpm.K0(0.5),
    )
    X = np.full((81, dim), 0.2)
    X[:, -1] = np.linspace(heights[1] + 0.01, heights[-2] - 0.01, 81)
    result, cells = s.run(8e4, 1e4, probes=mpm.probes(s.bodies, X), progress=False), s.cells()
    found, z, order = result.probe_pressure[-1], result.position[-1, :, -1], np.argsort(cells.x[:, -1])
    around = np.searchsorted(heights, z) - 1 + np.arange(-1, 2)[:, None]
    p = cells.pressure[order][around]
    for values in (p, p - WEIGHT * (z - cells.x[order, -1][around])):
        assert (found >= values.min(axis=0) - 1e-4).all() and (found <= values.max(axis=0) + 1e-4).all()
    wet = cells.pressure.max()
    assert -1700 < wet < -1500 and found.max() < wet + 1e-4 and found.min() < -2e4, "the front is within the column"
