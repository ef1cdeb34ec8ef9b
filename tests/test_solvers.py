# SPDX-License-Identifier: MIT
"""Block factors solve their systems."""

import gc
import weakref
from dataclasses import replace
from functools import cache
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import pytest
from helpers import SOFT, noting, pressed, thresholds

import mpm_dolfinx as mpm
from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.solve import monolithic, schur
from mpm_dolfinx.solve.factors import (
    BlockFactors,
    direct_solver,
    displacement_solver,
    dissection,
    solved,
)
from mpm_dolfinx.solve.solver_choice import NODAL, THRESHOLDS


def momentum(dim: int):
    """Return the momentum matrices of a cube on smooth walls: nodes have one, two or three unknowns."""
    grid = mpm.Grid([0] * dim, [1.0] * dim, [4] * dim)
    every = {"left": "x", "bottom": "xyz"[dim - 1], "front": "y"}
    walls = {wall: axis for wall, axis in every.items() if dim == 3 or wall != "front"}
    body, load = mpm.box(grid, [0] * dim, [0.6] * dim), [0.0] * (dim - 1) + [-1e4]
    s = mpm.Simulation(grid, [body], [SOFT], walls=walls, conditions=[mpm.Traction("top", load)])
    s.step(1.0)
    return s.scene.last[1].momentum


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
def test_blocks_of_nodes_solve_as_single_unknowns_do_also_when_the_matrix_changes(dim, symmetric):
    m = momentum(dim)
    assert m.unknowns.size < dim * len(np.unique(m.unknowns.nodes[0]))  # some blocks are not full
    K, (b, x) = m.K.copy(), m.K.createVecs()
    b.array_w[:] = np.random.default_rng(1).standard_normal(b.size)
    solver = displacement_solver(K, "nodal", m.unknowns, NODAL, symmetric)
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


def test_nested_dissection_orders_nodes_of_any_shape_and_lines_come_after_both_sides():
    x, y = np.meshgrid(np.linspace(0.3, 1.7, 41), np.linspace(-2, 0, 21), indexing="ij")
    at = np.stack([x.ravel(), y.ravel()], axis=1)
    at = at[np.random.default_rng(3).permutation(len(at))][: int(0.9 * len(at))] * (1 + 1e-14)
    order = dissection(at)
    assert sorted(order) == list(range(len(at)))
    line = np.isclose(at[order, 0], 1.0)
    assert line[-line.sum() :].all() and np.ptp(np.sign(at[order, 0] - 1.0)[: (~line).sum()].reshape(-1)) == 2
    left = at[order[~line], 0] < 1
    assert left[: left.sum()].all(), "one side after the other"
    assert len(dissection(at[:0])) == 0 and dissection(at[:1]).tolist() == [0]


def test_factors_by_nested_dissection_fill_little():
    """The bound for n x n nodes is 31/4 n^2 log2 n, with nine neighbours two thirds of it. Here: 0.44 and 0.56."""
    for n in (20, 80):
        i = np.arange(n * n)
        x = np.stack([i % n, i // n], axis=1).astype(float)
        block, axis = np.repeat(i, 2), np.tile([0, 1], n * n)
        near = [(abs(x - x[k]).max(axis=1) <= 1).nonzero()[0] for k in i]
        columns = [np.sort(np.concatenate([2 * near[k], 2 * near[k] + 1])) for k in block]
        rows = np.concatenate([[0], np.cumsum([len(c) for c in columns])])
        columns = np.concatenate(columns)
        factors = BlockFactors(rows, columns, block, axis, x[block], 2, symmetric=True)
        factors.take(np.where(columns == np.repeat(np.arange(len(block)), np.diff(rows)), 100.0, -1.0))
        factors.factorise()
        entries = factors._solver.pc.getFactorMatrix().getInfo()["nz_used"] / 4
        assert entries < 0.65 * 31 / 4 * n**2 * np.log2(n)


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
    with pytest.raises(mpm.NotConverged, match=r"solver of the storage failed after .* \(values are not finite\)"):
        solved(ksp, "storage")


def quarter_pushed(soil: mpm.Skeleton, n: int, step: float) -> mpm.Simulation:
    """Return a saturated cube; a prescribed displacement of `step` (m) per second pushes a quarter of the top."""
    air = n // 4
    grid = mpm.Grid([0, 0, 0], [1.0, 1.0, 1 + air / n], [n, n, n + air])
    walls = dict.fromkeys(("left", "right"), "x") | dict.fromkeys(("front", "back"), "y") | {"bottom": "xyz"}
    quarter, beside = ((-np.inf,) * 3, (0.45, 0.45, np.inf)), ((0.5, 0, 0), (np.inf,) * 3)
    push = mpm.Displacement("top", lambda t, X: (0, 0, -step * t), region=quarter)
    drained, body = mpm.Drained("top", region=beside), mpm.box(grid, [0, 0, 0], [1, 1, 1])
    return mpm.Simulation(grid, [body], [soil], walls=walls, conditions=[push, drained], fluid=mpm.Fluid())


class Pushed(NamedTuple):
    """Reports of steps of a cube; iterations of its solves, and numbers of asked and of made factors."""

    reports: list[Report]
    counts: list[int]
    asked: int
    made: int


@cache
def pushed(bulk: float, steps: int = 2) -> Pushed:
    """Return steps of an elastic cube with few shear stresses."""
    s = quarter_pushed(mpm.Hencky(bulk=bulk, shear=1e6, conductivity=1e-7), 8, 0.01)
    counts, asked = [], []
    solve, make = monolithic.BlockSolver.solve, monolithic.BlockSolver._factorised
    PETSc.Log.begin()
    before = PETSc.Log.Event("MatCholFctrNum").getPerfInfo()["count"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(monolithic.BlockSolver, "solve", noting(counts, solve))
        patch.setattr(monolithic.BlockSolver, "_factorised", lambda self: asked.append(1) or make(self))
        reports = [s.step(1.0) for _ in range(steps)]
    return Pushed(reports, counts, len(asked), PETSc.Log.Event("MatCholFctrNum").getPerfInfo()["count"] - before)


FRICTIONAL = mpm.DruckerPrager(bulk=2e6, shear=1e6, friction=20.0, dilation=0.0, cohesion=1e4, conductivity=1e-7)
LAYERED = mpm.Hencky(
    bulk=lambda X: np.where(X[:, 2] < 0.5, 5e10, 5e7),
    shear=lambda X: np.where(X[:, 2] < 0.5, 1e9, 1e6),
    conductivity=1e-7,
)
BLOCKS = {  # soil, cells, step, m, steps, most iterations
    "nu = 0.499": (mpm.Hencky(bulk=500e6, shear=1e6, conductivity=1e-7), 14, 0.01, 2, 30),
    "nu = 0.49, layers 1 : 1000": (LAYERED, 14, 0.01, 2, 25),
    "beyond the limit load": (FRICTIONAL, 12, 0.005, 10, 25),
    "beyond the limit load, finer": (FRICTIONAL, 24, 0.005, 4, 60),
}


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS)
def test_no_linear_solve_of_a_wet_block_takes_many_iterations(block, monkeypatch):
    """`tests/run.sh -m slow -s tests/test_solvers.py` prints the numbers, and `tests/limit_load_3d.py` those of other
    grids.
    """
    counts, solve = [], monolithic.BlockSolver.solve
    monkeypatch.setattr(monolithic.BlockSolver, "solve", noting(counts, solve))
    soil, n, step, steps, most = BLOCKS[block]
    s, forces = quarter_pushed(soil, n, step), []
    result = s.run(steps, 1, observe=lambda s: forces.append(-s.reactions.array[0, 2]), progress=False)
    took = f"{result.steps} steps, {result.cuts} cuts, {result.newton} Newton steps, {result.wall:.0f} s"
    print(f"{block}, {n}^3: {took}, iterations {np.mean(counts):.1f}, at most {max(counts)}; load {forces} N")
    assert max(counts) <= most and result.cuts == 0
    if soil.state:
        assert forces[-1] < 1.1 * forces[len(forces) // 2], "the load hardly rises any more"


def test_the_first_solve_of_a_step_leaves_little_of_both_residuals_whatever_given_displacements_pull():
    """A thousandth of the prescribed forces, the first residual, is as large as all other forces: it cost two more
    steps.
    """
    for report in pushed(2e6).reports:
        assert max(report.history[0]) > 100 and max(report.history[1]) < 0.5 and report.newton <= 8


@pytest.mark.parametrize("bulk", [pytest.param(50e6, marks=pytest.mark.slow), 500e6])
def test_nearly_incompressible_bodies_in_3d_take_few_iterations_a_solve(bulk):
    """nu = 0.49 and 0.499. With multigrid alone, the second takes 60 iterations per solve."""
    report = pushed(bulk).reports[1]
    assert report.coupling < 15 * report.newton


def yielded(soil: mpm.Skeleton, monkeypatch) -> tuple[mpm.Simulation, list[int], list[int]]:
    """Return a cube after two steps, its iterations, and a list with an entry for each replacement of the cycle."""
    counts, solve = [], monolithic.BlockSolver.solve
    made, make = [], monolithic.BlockSolver._factorised
    with monkeypatch.context() as patch:
        patch.setattr(monolithic.BlockSolver, "solve", noting(counts, solve))
        patch.setattr(monolithic.BlockSolver, "_factorised", lambda self: made.append(1) or make(self))
        s = quarter_pushed(soil, 8, 0.01)
        s.step(1.0), s.step(1.0)
    return s, counts, made


def test_yielding_soil_takes_few_iterations_without_factors(monkeypatch):
    """With three sweeps in place of incomplete factors, a solve takes up to 41 iterations."""
    thresholds(monkeypatch, fallback_3d=0)
    s, counts, made = yielded(FRICTIONAL, monkeypatch)
    assert max(counts) <= 20 and not made and np.abs(s.points.data["plastic"] - np.eye(3)).max() > 0.02


@pytest.mark.slow
def test_sweeps_replace_incomplete_factors_in_nearly_incompressible_soil_and_solve_the_same_problem(monkeypatch):
    stiff, ends = replace(FRICTIONAL, bulk=50e6), []
    for most in (THRESHOLDS.fallback_3d, 0):
        thresholds(monkeypatch, fallback_3d=most)
        ends.append(yielded(stiff, monkeypatch))
    (one, few, _), (other, many, made) = ends
    assert len(made) == 2, "once in each step"
    assert max(few) < max(many)
    assert np.abs(one.points.x - other.points.x).max() < 1e-7
    assert other.points.pressure == pytest.approx(one.points.pressure, abs=1e-5 * np.abs(one.points.pressure).max())


def test_factors_serve_as_soon_as_a_multigrid_cycle_is_foreseen_to_take_too_many_iterations():
    assert max(pushed(50e6).counts) < THRESHOLDS.many  # 38 without foresight


def test_factors_in_place_of_a_multigrid_cycle_solve_the_same_problem(monkeypatch):
    """The factors belong to the previous tangent, and the matrix is the present one."""
    few = pushed(500e6).reports[0]
    thresholds(monkeypatch, fallback_3d=0)
    (many,) = pushed.__wrapped__(500e6, steps=1).reports
    assert few.coupling < many.coupling / 3
    assert few.stress == pytest.approx(many.stress, rel=1e-7) and few.change == pytest.approx(many.change, rel=1e-5)


def test_factors_in_place_of_a_multigrid_cycle_are_made_once_and_serve_other_tangents():
    assert pushed(500e6).made == pushed(500e6).asked > 0


def test_water_flows_through_a_body_whose_nodes_are_all_held():
    """Earlier, PETSc's block factors of a matrix without rows ended the process."""
    grid = mpm.Grid([0, 0], [1.0, 0.1], [10, 1])
    soil, ends = mpm.Hencky(bulk=2e6, shear=1e6, conductivity=1e-3), (("left", 1e3), ("right", 0.0))
    conditions = {"fluid": mpm.Fluid(), "conditions": [*(mpm.Drained(side, pressure=p) for side, p in ends)]}
    body, walls = mpm.box(grid, [0, 0], [1, 0.1]), {"bottom": "xy", "top": "xy"}
    s = mpm.Simulation(grid, [body], [soil], walls=walls, **conditions)
    s.run(1.0, 0.5, progress=False)
    assert s.points.pressure == pytest.approx(1e3 * (1 - s.points.x[:, 0]), abs=1.0)


def strip_pushed() -> mpm.Simulation:
    """Return saturated soil; a prescribed displacement of 0.01 m per second pushes half of the top."""
    grid, half = mpm.Grid([0, 0], [1.0, 1.25], [12, 15]), ((-np.inf, -np.inf), (0.45, np.inf))
    walls, drained = (
        {"left": "x", "right": "x", "bottom": "xy"},
        mpm.Drained("top", region=((0.5, 0), (np.inf, np.inf))),
    )
    push, body = mpm.Displacement("top", lambda t, X: (0, -0.01 * t), region=half), mpm.box(grid, [0, 0], [1, 1])
    given = {"conditions": [push, drained], "fluid": mpm.Fluid()}
    return mpm.Simulation(grid, [body], [FRICTIONAL], walls=walls, **given)


def test_large_bodies_that_yield_end_where_small_ones_do_by_mumps(monkeypatch):
    ends = []
    for least in (THRESHOLDS.mumps, 1):
        thresholds(monkeypatch, mumps=least)
        s = strip_pushed()
        newton = [s.step(1.0).newton for _ in range(2)]
        ends.append((s.points, newton, s.scene.last[1].solvers.solve_u.pc.getFactorSolverType()))
    (petsc, few, _), (mumps, many, package) = ends
    assert package == "mumps" and few == many and np.abs(petsc.data["plastic"] - np.eye(3)).max() > 0.02
    assert np.abs(mumps.x - petsc.x).max() < 1e-10
    assert mumps.pressure == pytest.approx(petsc.pressure, abs=1e-7 * np.abs(petsc.pressure).max())


@pytest.mark.parametrize("solvers", ["factors", "multigrid in 2D", "multigrid in 3D"])
def test_solvers_go_with_their_step_without_the_help_of_pythons_collector(solvers, monkeypatch):
    """Their factors take most of the memory of a large body."""
    made, make = weakref.WeakSet(), schur.LinearSolvers.__init__
    monkeypatch.setattr(schur.LinearSolvers, "__init__", lambda self, *a: made.add(self) or make(self, *a))
    thresholds(monkeypatch, multigrid_2d=1 if solvers == "multigrid in 2D" else THRESHOLDS.multigrid_2d)
    soil = mpm.Hencky(bulk=500e6, shear=1e6, conductivity=1e-7)
    s = quarter_pushed(soil, 8, 0.01) if solvers == "multigrid in 3D" else pressed()
    gc.collect()
    gc.disable()
    try:
        for _ in range(3):
            s.step(0.02)
            assert len(made) == (solvers == "factors"), "coarse grids are gone before the points move"
    finally:
        gc.enable()
