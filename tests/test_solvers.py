# SPDX-License-Identifier: MIT
"""Factors in blocks solve what they are given."""

from petsc4py import PETSc

import numpy as np
import pytest
from helpers import SOFT

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import monolithic
from mpm_dolfinx.solve.linear import allow_no_diagonal, direct_solver, multigrid_solver, nodal_solver, solved


def momentum(dim: int):
    """Return the momentum's matrices of a cube on rollers: some nodes have one unknown, some two or three."""
    grid = mpm.Grid([1.0] * dim, [4] * dim)
    walls = {"left": "x", "bottom": "xyz"[dim - 1], "front": "y"}
    fixed = {wall: axis for wall, axis in walls.items() if dim == 3 or wall != "front"}
    body, load = mpm.box(grid, [0] * dim, [0.6] * dim), [0.0] * (dim - 1) + [-1e4]
    s = mpm.Simulation(grid, [body], [SOFT], fixed=fixed, tractions=[mpm.Traction("top", load)])
    s.step(1.0)
    return s.scene.last[1].momentum


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
def test_blocks_of_nodes_solve_as_single_unknowns_do_also_when_the_matrix_changes(dim, symmetric):
    m = momentum(dim)
    assert m.unknowns.size < dim * len(np.unique(m.unknowns.nodes[0]))  # some blocks are not full
    K, (b, x) = m.K.copy(), m.K.createVecs()
    b.array_w[:] = np.random.default_rng(1).standard_normal(b.size)
    solver = nodal_solver(K, "nodal", m.unknowns, symmetric)
    for factor in (1.0, 3.0):
        scale = b.duplicate()
        scale.array_w[:] = factor
        if not symmetric:
            scale.array_w[::2] = 2 * factor
        K.diagonalScale(L=scale)
        solver.setOperators(K)
        solver.solve(b, x)
        single = x.duplicate()
        direct_solver(K, "single", symmetric).solve(b, single)
        assert x.array == pytest.approx(single.array, rel=1e-9, abs=1e-9 * abs(single.array).max())
        assert (K * x).array == pytest.approx(b.array, abs=1e-9)


def test_a_linear_solver_that_breaks_off_fails_the_step():
    A = PETSc.Mat().createDense((2, 2), array=np.eye(2), comm=PETSc.COMM_SELF)
    A.assemble()
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.pc.setType(PETSc.PC.Type.NONE)
    ksp.setOperators(A)
    b, x = A.createVecs()
    b.set(np.nan)
    ksp.solve(b, x)
    with pytest.raises(mpm.NotConverged, match=r"linear solver of the storage broke off .* reason -9"):
        solved(ksp, "storage")


def pushed(bulk: float) -> list[mpm.result.Report]:
    """Return what two steps take of a saturated cube, of which a given displacement pushes a quarter of the top."""
    n = 8
    grid = mpm.Grid([1.0, 1.0, 1.25], [n, n, n + 2])
    walls = dict.fromkeys(("left", "right"), "x") | dict.fromkeys(("front", "back"), "y") | {"bottom": "xyz"}
    quarter, beside = ((-np.inf,) * 3, (0.45, 0.45, np.inf)), ((0.5, 0, 0), (np.inf,) * 3)
    push = mpm.Displacement("top", lambda t, X: (0, 0, -0.01 * t), region=quarter)
    soil = mpm.Hencky(bulk=bulk, shear=1e6, conductivity=1e-7)
    drained, body = mpm.Drained("top", region=beside), mpm.box(grid, [0, 0, 0], [1, 1, 1])
    s = mpm.Simulation(grid, [body], [soil], fixed=walls, displacements=[push], drained=[drained], fluid=mpm.Fluid())
    return [s.step(1.0), s.step(1.0)]


def test_the_first_solve_of_a_step_leaves_little_of_both_residuals_whatever_given_displacements_pull():
    """A thousandth of their pull, which is the first residual, is as much as all forces: it cost two more steps."""
    for report in pushed(2e6):
        assert max(report.history[0]) > 100 and max(report.history[1]) < 0.5 and report.newton <= 8


@pytest.mark.parametrize("bulk", [50e6, 500e6])
def test_nearly_incompressible_bodies_in_3d_take_few_iterations_a_solve(bulk):
    """nu = 0.49, 0.499; with multigrid alone the latter takes 60 a solve."""
    report = pushed(bulk)[1]
    assert report.coupling < 15 * report.newton


def test_factors_in_place_of_a_multigrid_cycle_solve_the_same_problem(monkeypatch):
    """They are those of the tangent before, the matrix is the present one."""
    few = pushed(500e6)[0]
    monkeypatch.setattr(monolithic, "FACTORISED", 0)
    many = pushed(500e6)[0]
    assert few.coupling < many.coupling / 3
    assert few.stress == pytest.approx(many.stress, rel=1e-7) and few.change == pytest.approx(many.change, rel=1e-5)


def test_coarse_unknowns_that_nothing_resists_do_not_break_the_multigrid_of_soil_that_yields_off():
    """Aggregates of fewer unknowns than rigid body modes, as a body has them that lies askew to the grid."""
    A = PETSc.Mat().createAIJ((60, 60), nnz=3, comm=PETSc.COMM_SELF)
    for i in range(60):
        A.setValue(i, i, 2.0)
        if i % 20:
            A.setValue(i, i - 1, -1.0), A.setValue(i - 1, i, -1.0)
    A.assemble()
    b, x = A.createVecs()
    modes = []
    for k in range(6):
        b.array_w[:] = np.arange(1.0, 61.0) ** k
        b.normalize()
        modes.append(b.copy())
    q, _ = np.linalg.qr(np.stack([mode.array for mode in modes], axis=1))
    for mode, column in zip(modes, q.T, strict=True):
        mode.array_w[:] = column
    A.setNearNullSpace(PETSc.NullSpace().create(vectors=modes, comm=PETSc.COMM_SELF))
    ksp = multigrid_solver(A, "askew", "sor")
    PETSc.Options(ksp.getOptionsPrefix())["pc_gamg_coarse_eq_limit"] = 5
    ksp.setFromOptions()
    allow_no_diagonal(ksp, A)
    ksp.setOperators(A)
    b.set(1.0)
    ksp.solve(b, x)
    assert solved(ksp, "askew") > 0 and ksp.getConvergedReason() > 0
