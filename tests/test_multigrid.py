# SPDX-License-Identifier: MIT
"""Multigrid on the background grid has the solution of direct solvers, in as many iterations on any grid."""

from dataclasses import replace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
from helpers import column, noting, pressed, thresholds
from hypothesis import given
from hypothesis import strategies as st

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import monolithic, multigrid
from mpm_dolfinx.solve.multigrid import interpolation, interpolations
from mpm_dolfinx.solve.solver_choice import THRESHOLDS


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Use multigrid for small bodies too."""
    thresholds(monkeypatch, multigrid_2d=1, coarsest=50)


def factorised(monkeypatch) -> list[int]:
    """Return a list that grows with each factorisation that replaces multigrid cycles."""
    made, factorise = [], monolithic.BlockSolver._factorised
    monkeypatch.setattr(monolithic.BlockSolver, "_factorised", lambda self: made.append(1) or factorise(self))
    return made


def same_end(one: mpm.Simulation, other: mpm.Simulation) -> None:
    """Assert that two simulations are in the same state."""
    assert np.abs(one.points.x - other.points.x).max() < 1e-10
    scale = np.abs(one.points.pressure).max()
    assert other.points.pressure == pytest.approx(one.points.pressure, abs=1e-8 * scale)


def test_large_elastic_bodies_in_2d_end_where_those_do_whose_matrices_are_factorised(monkeypatch):
    made, ends, newton = factorised(monkeypatch), [], []
    for least in (10**6, 1):
        thresholds(monkeypatch, multigrid_2d=least)
        ends.append(pressed())
        newton.append(sum(ends[-1].step(0.02).newton for _ in range(4)))
    same_end(*ends)
    assert newton[1] <= newton[0] + 1 and not made


def test_petscs_options_for_factors_are_not_for_multigrid():
    """On two processes, SuperLU as replacement ended the process."""
    A = PETSc.Mat().createAIJ((4, 4), nnz=1, comm=PETSc.COMM_SELF)
    places = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]])
    PETSc.Options()["mpm_momentum_pc_type"] = "lu"
    try:
        solver = multigrid.multigrid_solver(A, "momentum", places, places[:0], nodal=True, coarsest=1)
    finally:
        PETSc.Options().delValue("mpm_momentum_pc_type")
    assert solver.pc.getType() == "mg"


def test_finer_grids_take_no_more_iterations():
    for finer in (1, 2, 4):
        report = pressed(finer).step(0.02)
        assert report.coupling < 11 * report.newton, finer


def layers(X, below: float, above: float):
    """Return one value for a lower layer, a third of the body, and another value for the upper part."""
    return np.where(X[:, 1] < 0.1, below, above)


STIFF_BELOW = {"bulk": lambda X: layers(X, 6e9, 6e6), "shear": lambda X: layers(X, 3e9, 3e6)}
HARD = {
    "nu = 0.495": {"bulk": 310e6},
    "conductivities 1 : 1e6": {"conductivity": lambda X: layers(X, 1e-9, 1e-3)},
    "stiffnesses 1 : 1000": STIFF_BELOW,
    "cells of 1 : 6": {"cells": (12, 60)},
}


@pytest.mark.parametrize("scene", HARD)
def test_contrasts_and_slender_cells_take_few_iterations_more(scene, monkeypatch):
    counts, solve, ends = [], monolithic.BlockSolver.solve, []
    monkeypatch.setattr(monolithic.BlockSolver, "solve", noting(counts, solve))
    for least in (10**6, 1):
        thresholds(monkeypatch, multigrid_2d=least)
        ends.append(pressed(2, **HARD[scene]))
        ends[-1].step(0.02)
    same_end(*ends)
    assert 0 < max(counts) < THRESHOLDS.many


def test_factors_take_the_place_of_cycles_that_take_many_iterations_and_serve_the_rest_of_the_step(monkeypatch):
    made, ends, took = factorised(monkeypatch), [], []
    for most in (1000, 12):
        thresholds(monkeypatch, many=most)
        made.clear()
        ends.append(pressed(2, **STIFF_BELOW))
        took.append((ends[-1].step(0.02), len(made)))
    same_end(*ends)
    (cycles, none), (factors, some) = took
    assert none == 0 < some < factors.newton / 2 and factors.coupling < cycles.coupling


def test_factors_that_take_many_iterations_are_made_anew(monkeypatch):
    made, ends = factorised(monkeypatch), []
    for most in (1000, 4):
        thresholds(monkeypatch, many=most)
        ends.append(pressed())
        ends[-1].step(0.02)
    same_end(*ends)
    assert len(made) > 1


def test_a_step_depends_on_no_step_before(monkeypatch):
    """Otherwise a resumed run would differ from an uninterrupted run."""
    thresholds(monkeypatch, many=4)
    first, second = pressed(), pressed()
    first.step(0.02)
    second.state = replace(first.state, stage=second.state.stage)
    first.step(0.02), second.step(0.02)
    assert np.array_equal(first.points.x, second.points.x)


@pytest.mark.parametrize(("bulk", "load"), [(2.2e9, 1e4), (5e6, 3e6)], ids=["stiff", "soft"])
def test_sealed_bodies_in_which_hardly_any_fluid_changes_places_converge(bulk, load):
    """Earlier, the scales of forces and fluid differed so much that rounding exceeded the tolerance."""
    press = mpm.Traction("top", lambda t: (0, -load * t**2))
    result = column(cells=4, conditions=[press], fluid=mpm.Fluid(bulk=bulk)).run(1.0, 0.01, progress=False)
    assert result.cuts == 0 and result.residual <= 1e-8 and result.balance <= 1e-8


def indices(cells: list[tuple[int, int]], nodal: bool):
    """Return the indices of cells, or of their nodes."""
    if nodal:
        cells = [(i + k, j + l) for i, j in cells for k in (0, 1) for l in (0, 1)]
    return np.unique(cells, axis=0)


cells_of_bodies = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), min_size=1, max_size=400)


@given(cells_of_bodies, st.booleans(), st.integers(1, 3))
def test_linear_functions_are_interpolated_exactly_between_nodes_and_constants_between_cells(cells, nodal, kinds):
    index = indices(cells, nodal)
    places = np.column_stack([np.repeat(index, kinds, axis=0), np.tile(np.arange(kinds), len(index))])
    Q, coarse, _ = interpolation(MPI.COMM_SELF, places, places[:0], nodal)
    assert len(np.unique(coarse, axis=0)) == len(coarse) == Q.size[1] <= len(places)
    x, y = Q.createVecs()
    x.array_w[:] = 1 + coarse @ ([6.0, -10.0, 100.0] if nodal else [0, 0, 100.0])
    Q.mult(x, y)
    assert y.array == pytest.approx(1 + places @ ([3.0, -5.0, 100.0] if nodal else [0, 0, 100.0]), abs=1e-10)


@given(cells_of_bodies, st.booleans(), st.sampled_from([None, "left", "bottom"]))
def test_coarse_unknowns_do_not_depend_on_one_another(cells, nodal, wall):
    """Otherwise coarse matrices would be singular."""
    index = indices(cells, nodal)
    places = np.column_stack([index, np.zeros(len(index), dtype=np.int64)])
    walls = np.zeros(len(index), dtype=bool)
    if nodal and wall is not None:
        walls = index[:, int(wall == "bottom")] == 0
    places, held = places[~walls], places[walls]
    whole = np.eye(len(places))
    for _ in range(3):
        Q, places, held = interpolation(MPI.COMM_SELF, places, held, nodal)
        whole = whole @ Q.convert("dense").getDenseArray().reshape(Q.size, order="F")
        singular = np.linalg.svd(whole, compute_uv=False)
        assert len(singular) == whole.shape[1] and singular.min(initial=1.0) > 1e-6


def test_bodies_of_few_cells_that_coarse_grids_do_not_unite_are_left_to_factors():
    i = np.arange(0, 400, 8)
    index = np.stack([values.ravel() for values in np.meshgrid(i, i)], axis=1)
    places = np.column_stack([index + 1, np.zeros(len(index), dtype=np.int64)])
    steps = interpolations(MPI.COMM_SELF, places, places[:0], nodal=True, coarsest=THRESHOLDS.coarsest)
    assert len(steps) == 1 and len(places) > THRESHOLDS.coarsest
