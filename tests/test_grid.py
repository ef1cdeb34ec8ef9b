# SPDX-License-Identifier: MIT
"""The grid finds points by arithmetic, and dolfinx numbers cells and nodes as the package assumes."""

import numpy as np
import pytest

from mpm_dolfinx import Grid
from mpm_dolfinx.base import _compat

GRIDS = [Grid([0.5, -1.0], [1.5, 1.0], [6, 5]), Grid([0, 0, 0], [1.0, 2.0, 1.5], [3, 4, 2])]


@pytest.fixture(params=GRIDS, ids=["2D", "3D"])
def grid(request):
    return request.param


def test_a_point_is_found_in_the_cell_that_holds_it(grid):
    x = np.random.default_rng(1).uniform(grid.low, grid.high, (200, grid.dim))
    cells = grid.locals[grid.number(grid.index_from_base(x))]
    assert (np.abs(x - grid.midpoints[cells]) <= grid.h / 2 * (1 + 1e-12)).all()


def test_points_on_the_upper_wall_belong_to_the_last_cell(grid):
    assert (grid.index(grid.upper[None]) == grid.shape - 1).all()
    assert not grid.outside(np.stack([grid.low, grid.high])).any()
    assert grid.outside(grid.high[None] + 1e-6).all()


def test_shape_functions_interpolate_multilinear_fields_with_their_gradients(grid):
    x = np.random.default_rng(2).uniform(grid.low, grid.high, (50, grid.dim))
    cells = grid.locals[grid.number(grid.index_from_base(x))]
    N, dN = grid.shape_values(cells, x), grid.shape_gradients(cells, x)

    def f(y):
        return np.prod(1 + 0.5 * y, axis=-1)

    nodal = f(grid.node_x[grid.cell_nodes[cells]])
    assert np.einsum("mk,mk->m", N, nodal) == pytest.approx(f(x), rel=1e-13)
    for a in range(grid.dim):
        slope = 0.5 * f(x) / (1 + 0.5 * x[:, a])
        assert np.einsum("mk,mk->m", dN[:, :, a], nodal) == pytest.approx(slope, rel=1e-12)


def test_facets_between_active_cells_are_the_inner_faces_of_their_block(grid):
    block = (np.array(np.unravel_index(grid.cell_number, grid.shape)).T < 2).all(axis=1)
    facets = grid.interior_facets(block, np.flatnonzero(block))
    assert len(facets) == grid.dim * 2 ** (grid.dim - 1)


# What dolfinx does not promise but the package relies on


def test_dolfinx_lists_the_vertices_of_all_cells_in_one_order(grid):
    corners = grid.node_x[grid.cell_nodes] - grid.midpoints[:, None]
    assert np.abs(corners - grid.signs * grid.h / 2).max() < 1e-14, "cells no longer share one vertex order"


def test_dolfinx_numbers_dg0_dofs_as_cells(grid):
    dofs = _compat.cell_dofs(_compat.function_space(grid.mesh, "DG", 0))
    assert (dofs.ravel() == np.arange(grid.num_local)).all(), "DG0 dofs are no longer the cell indices"


def test_dolfinx_numbers_vector_dofs_as_scalar_ones(grid):
    V = _compat.function_space(grid.mesh, "Lagrange", 1, (grid.dim,))
    assert V.dofmap.bs == grid.dim
    assert (_compat.cell_dofs(V) == grid.cell_nodes).all(), "Q1 vector and scalar dofmaps differ"


def test_only_what_is_made_with_the_mesh_makes_it():
    """Notebooks, debuggers and `copy` request unknown names from any object."""
    grid, shared = Grid([0, 0], [1.0, 1.0], [2, 2]), Grid([0, 0], [1.0, 1.0], [2, 2])
    for name in ("_repr_html_", "_ipython_display_", "shape_", "__array__"):
        assert not hasattr(grid, name)
    assert grid._cells is None
    # of these spaces, of places between lines, and of local cells the grid has methods
    own = {"cellwise", "memory", "at", "_index", "_window"}
    made = vars(shared._of_process).keys() - own
    assert {"mesh", "cell_nodes"} <= made
    for name in made:
        assert hasattr(Grid([0, 0], [1.0, 1.0], [2, 2]), name), f"{name} is made with the mesh, but is not there before"
