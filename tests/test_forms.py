# SPDX-License-Identifier: MIT
"""Forms at material points equal the explicit sums over points and shape functions."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

from mpm_dolfinx import Grid, Hencky, NeoHookean
from mpm_dolfinx.base import _compat
from mpm_dolfinx.forms.cell_matrices import (
    Beside,
    ElementForces,
    ElementMatrices,
    StackedElementMatrices,
    along_shapes,
    insert_rows,
)
from mpm_dolfinx.forms.point_forms import CellSums, FormPoints, PointExpression, PointForm
from mpm_dolfinx.forms.unknowns import Unknowns, matrix

GRIDS = {2: Grid([0, 0], [1.5, 1.0], [4, 3]), 3: Grid([0, 0, 0], [1.0, 1.2, 0.9], [2, 3, 2])}


class Scene:
    """Random points in a grid, many in one cell and unsorted, with a random nodal field."""

    def __init__(self, dim, n=40, **fields):
        rng = np.random.default_rng(dim)
        self.grid = grid = GRIDS[dim]
        self.points = FormPoints(grid, **fields)
        x = rng.uniform(grid.low, grid.low + 0.7 * (grid.upper - grid.lower), (n, dim))
        self.cells = grid.locals[grid.number(grid.index_from_base(x))]
        self.weight = rng.uniform(0.5, 2, n)
        self.x, self.rng = x, rng
        self.N, self.dN = grid.shape_values(self.cells, x), grid.shape_gradients(self.cells, x)
        self.nodes = grid.cell_nodes[self.cells]
        self.V = _compat.function_space(grid.mesh, "Lagrange", 1, (dim,))
        self.S = _compat.function_space(grid.mesh, "Lagrange", 1)

    def place(self, **data):
        return self.points.at(self.cells, self.x, self.weight, **data)

    def vector(self, form, space, data):
        b = np.zeros_like(fem.Function(space).x.array)
        PointForm(form, self.points).assemble_vector(b, data)
        return b

    def matrix(self, form, space, data):
        unknowns = Unknowns(fem.Function(space), np.arange(len(fem.Function(space).x.array)))
        A = matrix(unknowns, unknowns, unknowns.size)
        PointForm(form, self.points).assemble_matrix(A, data)
        A.assemble()
        return A[:, :]


@pytest.fixture(params=[2, 3], ids=["2D", "3D"])
def dim(request):
    return request.param


@pytest.mark.parametrize(
    "f",
    [lambda x: 0 * x[0] + 3, lambda x: 1 + 2 * x[0] - x[1], lambda x: np.prod(1 + x, axis=0)],
    ids=["constant", "linear", "multilinear"],
)
def test_a_field_of_the_grid_is_summed_at_the_points_exactly(dim, f):
    s = Scene(dim)
    data = s.place()
    w, q = fem.Function(s.S), ufl.TestFunction(_compat.function_space(s.grid.mesh, "DG", 0))
    w.interpolate(lambda x: f(x[:dim]))
    b = s.vector(s.points.value(w) * q * s.points.dx, q.ufl_function_space(), data)
    assert b.sum() == pytest.approx(s.weight @ f(s.x.T), rel=1e-13)


def test_vectors_equal_the_sum_over_shape_functions(dim):
    s = Scene(dim, flow=(dim,))
    flow = s.rng.normal(size=(len(s.x), dim))
    data = s.place(flow=flow)
    v = ufl.TestFunction(s.S)
    form = (s.points.value(v) + ufl.inner(s.points.flow, s.points.grad(v))) * s.points.dx
    expected = np.zeros(s.grid.node_x.shape[0])
    np.add.at(expected, s.nodes, s.weight[:, None] * (s.N + np.einsum("md,mkd->mk", flow, s.dN)))
    assert np.abs(s.vector(form, s.S, data) - expected).max() < 1e-12


def test_matrices_equal_the_sum_over_shape_functions(dim):
    s = Scene(dim, stiffness=())
    k = s.rng.uniform(1, 2, len(s.x))
    data = s.place(stiffness=k)
    u, v = ufl.TrialFunction(s.S), ufl.TestFunction(s.S)
    form = s.points.stiffness * ufl.inner(s.points.grad(u), s.points.grad(v)) * s.points.dx
    expected = np.zeros((s.grid.node_x.shape[0],) * 2)
    local = np.einsum("m,mia,mja->mij", s.weight * k, s.dN, s.dN)
    np.add.at(expected, (s.nodes[:, :, None], s.nodes[:, None, :]), local)
    assert np.abs(s.matrix(form, s.S, data) - expected).max() < 1e-11


@pytest.mark.parametrize("law", [Hencky, NeoHookean])
def test_tangents_differentiated_by_ufl_equal_finite_differences(dim, law):
    s = Scene(dim, n=8, F=(dim, dim))
    data = s.place(F=np.eye(dim) + 0.1 * s.rng.normal(size=(8, dim, dim)))
    u, v = fem.Function(s.V), ufl.TestFunction(s.V)
    u.x.array[:] = 0.02 * s.rng.normal(size=len(u.x.array))
    F = ufl.variable((ufl.Identity(dim) + s.points.grad(u)) * s.points.F)
    P = ufl.diff(law.energy(F, 2.0, 1.0), F)
    residual = ufl.inner(P, s.points.grad(v) * s.points.F) * s.points.dx
    i, j, k, l = ufl.indices(4)
    dF = [s.points.grad(w) * s.points.F for w in (v, ufl.TrialFunction(s.V))]
    K = s.matrix(dF[0][i, j] * ufl.diff(P, F)[i, j, k, l] * dF[1][k, l] * s.points.dx, s.V, data)
    assert np.abs(K - K.T).max() < 1e-10 * np.abs(K).max()

    assemble, direction, step = PointForm(residual, s.points), s.rng.normal(size=len(u.x.array)), 1e-6
    start, ends = u.x.array.copy(), []
    for sign in (1, -1):
        u.x.array[:] = start + sign * step * direction
        ends.append(np.zeros_like(start))
        assemble.assemble_vector(ends[-1], data)
    difference = (ends[0] - ends[1]) / (2 * step)
    assert np.abs(K @ direction - difference).max() < 1e-7 * np.abs(difference).max()


@pytest.mark.parametrize(
    "dim, symmetric, stacked",
    [(2, True, False), (2, False, False), (2, True, True), (3, True, True), (3, False, True)],
)
def test_element_matrices_equal_the_form_point_by_point(dim, symmetric, stacked):
    s = Scene(dim, stiffness=(), F=(dim, dim), skew=(dim, dim))
    F = np.eye(dim) + 0.1 * s.rng.normal(size=(len(s.x), dim, dim))
    data = s.place(stiffness=s.rng.uniform(1, 2, len(s.x)), F=F, skew=s.rng.normal(size=F.shape))
    i, j, k, l = ufl.indices(4)
    one, p = ufl.Identity(dim), s.points
    A = p.stiffness * ufl.as_tensor(one[i, j] * one[k, l] + 0.3 * one[i, k] * one[j, l], (i, k, j, l))
    if not symmetric:
        A += ufl.as_tensor(p.skew[i, k] * p.F[j, l], (i, k, j, l))
    pull = p.F if stacked else one
    u, v = ufl.TrialFunction(s.V), ufl.TestFunction(s.V)
    form = (p.grad(v) * pull)[i, k] * A[i, k, j, l] * (p.grad(u) * pull)[j, l] * p.dx
    unknowns = Unknowns(fem.Function(s.V), np.arange(len(fem.Function(s.V).x.array)))
    matrices = (StackedElementMatrices if stacked else ElementMatrices)(A, p, symmetric)
    for _ in range(2):  # anew where the points have moved
        K = matrix(unknowns, unknowns, unknowns.size)
        matrices.assemble_matrix(K, data)
        K.assemble()
        expected = s.matrix(form, s.V, data)
        assert np.abs(K[:, :] - expected).max() < 1e-12 * np.abs(expected).max()
        rows = s.rng.permutation(len(data.cells))[: len(data.cells) // 2]
        data = data.part(p, data.places.part(rows), rows)


@pytest.mark.parametrize("dim, stacked", [(2, False), (2, True), (3, True)])
def test_element_matrices_sum_what_else_is_asked_for(dim, stacked):
    s = Scene(dim, T=(dim, dim), F=(dim, dim), size=())
    F = np.eye(dim) + 0.1 * s.rng.normal(size=(len(s.x), dim, dim))
    data = s.place(T=s.rng.normal(size=F.shape), F=F, size=s.rng.normal(size=len(s.x)))
    one, p = ufl.Identity(dim), s.points
    A = ufl.outer(one, one)
    matrices = (StackedElementMatrices if stacked else ElementMatrices)(A, p, beside=Beside([one, p.T], [p.size]))
    unknowns = Unknowns(fem.Function(s.V), np.arange(len(fem.Function(s.V).x.array)))
    K = matrix(unknowns, unknowns, unknowns.size)
    sums = matrices.assemble_matrix(K, data)
    pull = p.F if stacked else one
    expected = [CellSums(along_shapes(T * pull.T, p), p)(data) for T in (one, p.T)] + [CellSums([p.size], p)(data)]
    assert sums == pytest.approx(np.concatenate(expected, axis=1), rel=1e-12, abs=1e-14)


def test_element_forces_equal_the_form_point_by_point(dim):
    s = Scene(dim, T=(dim, dim))
    data = s.place(T=s.rng.normal(size=(len(s.x), dim, dim)))
    v, q = ufl.TestFunction(s.V), ufl.TestFunction(_compat.function_space(s.grid.mesh, "DG", 0))
    expected = s.vector(ufl.inner(s.points.T, s.points.grad(v)) * s.points.dx, s.V, data)
    forces, b = ElementForces(s.points.T, s.points), np.zeros_like(expected)
    forces.assemble_vector(b, data)
    assert np.abs(b - expected).max() < 1e-12 * np.abs(expected).max()
    rows, columns = (Unknowns(f, np.arange(len(f.x.array))) for f in map(fem.Function, (q.ufl_function_space(), s.V)))
    A = matrix(rows, columns, columns.size)
    of_cells = CellSums(along_shapes(s.points.T, s.points), s.points)(data)
    insert_rows(A, s.grid, data.places.filled, of_cells)
    A.assemble()
    assert np.abs(A[:, :].sum(axis=0) - expected).max() < 1e-12 * np.abs(expected).max()
    assert np.abs(A[:, :]).sum(axis=1).nonzero()[0] == pytest.approx(data.places.filled)


def test_the_gradient_as_data_equals_the_gradient_in_the_kernel(dim):
    s = Scene(dim)
    data = s.place()
    u = fem.Function(s.V)
    by_numpy, by_kernel = (PointExpression(g, s.points) for g in (s.points.gradient(u), s.points.grad(u)))
    for _ in range(2):  # of the present u
        u.x.array[:] = s.rng.normal(size=len(u.x.array))
        assert by_numpy.evaluate(data) == pytest.approx(by_kernel.evaluate(data), rel=1e-12)


def test_moving_the_points_moves_the_form(dim):
    s = Scene(dim)
    data = s.place()
    v = ufl.TestFunction(s.S)
    form = PointForm(s.points.value(v) * s.points.dx, s.points)
    b = np.zeros(s.grid.node_x.shape[0])
    form.assemble_vector(b, data)
    b[:] = 0
    form.assemble_vector(b, s.points.at(s.cells[:1], s.grid.midpoints[s.cells[:1]], np.array([2.0])))
    assert b.sum() == pytest.approx(2) and np.count_nonzero(b) == 2**dim


def test_an_unknown_field_is_named():
    with pytest.raises(AttributeError, match="have offset, weight, not 'sigma'"):
        _ = FormPoints(GRIDS[2]).sigma
