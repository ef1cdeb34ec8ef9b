# SPDX-License-Identifier: MIT
"""One function chooses the solvers and prints the choice; users pass PETSc's options by the names of its solvers."""

from dataclasses import replace

import pytest
from helpers import limit, pressed, thresholds

from mpm_dolfinx.solve.scheme import Scheme
from mpm_dolfinx.solve.solver_choice import INCOMPLETE, ONE_SWEEP, THREE_SWEEPS, plan


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        ((100, 2), "Schur complement: displacements by factors in blocks, pressures by factors, CG"),
        ((100, 2, {"wet": False}), "momentum alone: displacements by factors"),
        ((2000, 3, {"wet": False}), "momentum alone: displacements by multigrid, GMRES"),
        ((1e6, 2), "both at once: displacements by multigrid, pressures by multigrid, GMRES, else factors in blocks"),
        ((1e6, 2, {"yields": True}), "Schur complement: displacements by factors in blocks, pressures by factors, CG"),
        ((1e6, 2, {"yields": True, "symmetric": False}), "pressures by factors by MUMPS, FGMRES"),
        ((9e4, 2, {"yields": True, "processes": 8}), "displacements by factors in blocks, pressures by factors, CG"),
        ((1e5, 2, {"yields": True, "processes": 2}), "displacements by factors by MUMPS, pressures by factors by M"),
        ((1e5, 2, {"wet": False, "processes": 2}), "momentum alone: displacements by factors"),
        ((100, 2, {"coupling": "fixed-stress"}), "in turn: displacements by factors in blocks, pressures by factors"),
        ((1e6, 3, {"locks": True}), "GMRES"),
        ((1e6, 3, {"locks": True, "yields": True}), "GMRES, else multigrid with sweeps"),
        ((1e4, 3, {"locks": True, "yields": True}), "GMRES, else factors by MUMPS"),
        ((1e6, 3, {"locks": True, "yields": True, "wet": False}), "momentum alone: displacements by multigrid, GMRES"),
    ],
)
def test_a_plan_follows_from_what_the_problem_is_and_says_so(problem, words):
    unknowns, dim, *more = problem
    given = more[0] if more else {}
    found = plan(unknowns, dim, **given)
    assert words in str(found)
    wet_yielding = dim == 3 and given.get("yields") and given.get("wet", True)
    assert found.smoother == (INCOMPLETE if wet_yielding else THREE_SWEEPS if given.get("locks") else ONE_SWEEP)


def test_a_plan_follows_its_table(monkeypatch):
    assert not plan(100, 2).iterative
    thresholds(monkeypatch, multigrid_2d=100)
    assert plan(100, 2).iterative and "both at once" in str(plan(100, 2))


def test_a_scene_shows_its_plan_after_its_first_step():
    s = pressed()
    assert "planned in the first step" in str(s)
    s.step(0.02)
    assert str(s.scene.last[1].plan) in str(s) and "Schur complement" in str(s)


def test_options_of_petsc_reach_their_solver_and_no_other_scene_and_unread_ones_are_told(warned):
    options = {"storage_ksp_type": "fgmres", "storage_ksp_tipe": "cg"}
    other, s = pressed(), limit(pressed(), 25)
    s.scene.scheme = replace(s.scene.scheme, petsc_options=options)
    s.step(0.02), other.step(0.02)
    kinds = [of.scene.last[1].solvers.schur[1].getType() for of in (s, other)]
    assert kinds == ["fgmres", "cg"]
    said = " ".join(warned())
    assert "no solver reads storage_ksp_tipe" in said and "storage_ksp_type" not in said


def test_options_of_no_solver_are_refused():
    with pytest.raises(ValueError, match="petsc_options 'ksp_type': must begin with one of momentum_"):
        Scheme("schur-cg", 1e-8, petsc_options={"ksp_type": "cg"})
