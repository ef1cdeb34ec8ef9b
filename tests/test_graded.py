# SPDX-License-Identifier: MIT
"""A conductivity that varies linearly in the cells: in series along its gradient, in parallel normal to it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import SOFT
from test_time_integration import linear_diffusion

import mpm_dolfinx as mpm
from mpm_dolfinx.points.material_points import cofactor
from mpm_dolfinx.verification.exact import terzaghi_consolidation


def mobilities(slope, dim=2, top=0.33):
    """Return the mobilities along the axes (n, d), divided by the arithmetic mean of k = k0 J, J = exp(slope . x).

    The second result (n, 1) is the harmonic mean divided by the arithmetic mean.
    """
    soil = mpm.Hencky(
        SOFT.bulk, SOFT.shear, conductivity=1e-4, conductivity_law=lambda conductivity, J: conductivity * J
    )
    grid = mpm.Grid([0] * dim, [0.4] * dim, [2, 5, 4][:dim])  # cells that are no cubes
    body = mpm.box(grid, [0.0] * dim, [0.4] * (dim - 1) + [top], per_cell=3)
    s = mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls={"bottom": "xyz"[:dim], "left": "x"})
    J = np.exp(s.points.x @ slope)
    on_grid = s.scene.on_grid(replace(s.points, F=J[:, None, None] ** (1 / dim) * np.eye(dim)))
    mobility = on_grid.mobility(on_grid.data, True)
    kappa = np.linalg.det(on_grid.data.pieces["F"].reshape(-1, dim, dim))
    series = 1 / on_grid.contents.mean(1 / kappa) / on_grid.contents.mean(kappa)
    return mobility.share, series[:, None]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("steep", [0.1, 10.0])
def test_pieces_resist_in_series_along_the_gradient_and_conduct_in_parallel_across_it(dim, steep):
    for axis in range(dim):
        n = np.eye(dim)[axis]
        share, series = mobilities(steep * n, dim)
        assert share == pytest.approx(np.where(n == 1, series, 1.0), rel=1e-12) and series.min() < 1 - 1e-6


def test_a_gradient_aslant_counts_along_each_axis_by_what_it_changes_there():
    """Cells of 0.2 m x 0.08 m."""
    share, series = mobilities(np.array([0.03, 0.04]), top=0.32)
    part = np.square([0.03 * 0.2, 0.04 * 0.08])
    assert 1 - share == pytest.approx((1 - series) * part / part.sum(), rel=1e-4)


def test_where_nothing_changes_it_is_the_mean():
    assert mobilities(np.zeros(2))[0] == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize(
    "per_cell, steps, ceilings", [(1, 40, (3e-3, 2e-3)), (2, 40, (3e-3, 2e-3)), (2, 100, (5e-3, 3e-3, 1e-3))]
)
def test_a_column_that_shrinks_to_half_with_a_conductivity_law_settles_in_its_time(per_cell, steps, ceilings):
    """Hencky's law, k = k0 J^3 / (1 - ln J): the conductivity of the top decreases to a tenth, within few cells.

    Errors at T = 0.05, 0.1 and 0.5, in equal steps; the last error has a bound.
    """
    h, soil = 1 / 50, mpm.Hencky(1e6 / 3, 5e5, porosity=0.7, conductivity=1e-4, conductivity_law=linear_diffusion)
    grid = mpm.Grid([0, 0], [h, 1.0], [1, 50])
    body, load = mpm.box(grid, [0, 0], [h, 1.0], per_cell), [mpm.Traction("top", (0, -soil.oedometric))]
    options = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "conditions": [mpm.Drained("top")]}
    s = mpm.Simulation(
        grid,
        [body],
        [soil],
        fluid=mpm.Fluid(bulk=np.inf),
        conditions=[*load, *options.pop("conditions", [])],
        **options,
    )
    cv, final, times = 1e-4 * soil.oedometric / 9810, 1 - 0.5671432904097838, (0.05, 0.1, 0.5)[: len(ceilings)]
    end, top = times[-1] / cv, mpm.probes([body], [[h / 2, 1.0]])  # ln J / J = -1 at the very end
    result = s.run(end, end / steps, probes=top, progress=False)
    u, T = -np.array(result.displacement)[:, 0, 1], np.array(result.t) * cv
    errors = [u[np.argmin(abs(T - t))] / (final * terzaghi_consolidation(t, 1.0, 1.0)) - 1 for t in times]
    assert (np.abs(errors) < ceilings).all() and result.balance < 1e-8, errors


@pytest.mark.parametrize("dim", [2, 3])
def test_cofactors_are_those_of_the_inverse(dim):
    F = np.eye(dim) + 0.3 * np.random.default_rng(0).normal(size=(20, dim, dim))
    exact = np.linalg.det(F)[:, None, None] * np.linalg.inv(F).swapaxes(1, 2)
    assert cofactor(F) == pytest.approx(exact, abs=1e-14)
