# SPDX-License-Identifier: MIT
"""A scene compiles only the terms that it has, and lists them."""

import numpy as np
import pytest
from benchmark_pruning import PAIRS
from helpers import SOFT, beam, column

import mpm_dolfinx as mpm
from mpm_dolfinx.simulation.summary import parts
from mpm_dolfinx.solve.schur import LinearSolvers

LINEAR = mpm.LinearElastic(bulk=1e7 / 3, shear=5e6, conductivity=1e-4)
SEALED = mpm.Hencky(bulk=1e7 / 3, shear=5e6)
STIFF = mpm.NeoHookean(bulk=1e9, shear=5e6)

ALWAYS = {"stress", "linear solvers"}
FLUID = {"pore pressure", "coupling"}
SCENES = {
    "drained beam": (lambda: beam(fluid=False, load=1e3, offset=0.1)[0], {"tractions", "ghost penalty"}),
    "beam": (
        lambda: beam(load=1e3, offset=0.1)[0],
        FLUID | {"tractions", "ghost penalty", "fluxes between cells", "open sides", "second substep"},
    ),
    "sealed column": (
        lambda: column(material=SEALED, conditions=[mpm.Displacement("top", (0, -0.01), "y")]),
        FLUID | {"given displacements", "damping of pressure jumps"},
    ),
    "linear column": (
        lambda: column(material=LINEAR, fluid=False, conditions=[mpm.Traction("top", (0, -1e3))]),
        {"tractions", "one factorisation for many steps"},
    ),
    "column that drains under its weight": (
        lambda: column(gravity=(0, -9.81), conditions=[mpm.Drained("top")]),
        FLUID | {"body force", "fluxes between cells", "weight of the fluid", "open sides", "second substep"},
    ),
    "incompressible column under a plate": (
        lambda: column(material=STIFF, fluid=False, conditions=[mpm.RigidPlate("top", 1e3)]),
        {"mean dilatation", "rigid plates"},
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_the_scene_has_the_terms_it_needs_and_no_others(name):
    build, used = SCENES[name]
    s = build()
    s.step(1.0)
    assert {part.name for part in parts(s.scene, s.state) if part.used} == ALWAYS | used
    assert all(part.why for part in parts(s.scene, s.state))
    assert len(str(s).splitlines()) == len(parts(s.scene, s.state))


def test_what_is_left_out_is_not_compiled():
    drained, sealed = column(fluid=False), column(material=SEALED)
    drained.step(0.01)
    sealed.step(0.01)
    assert drained.scene.storage is None
    momentum, fluxes = drained.scene.momentum, sealed.scene.storage.fluxes
    assert momentum.dilatation is None and not momentum.acting
    assert not momentum.conditions.made
    assert not momentum.ghost.form.used and fluxes.flux is None and fluxes.gravity is None


def counted(monkeypatch):
    """Return a list that grows with each assembled tangent."""
    made, linearise = [], LinearSolvers.linearise
    monkeypatch.setattr(LinearSolvers, "linearise", lambda *a, **options: (made.append(a), linearise(*a, **options)))
    return made


def test_a_linear_law_is_factorised_once_while_the_domains_stay_cut(monkeypatch):
    s = column(material=LINEAR, conditions=[mpm.Traction("top", lambda t: (0, -1e3 * t)), mpm.Drained("top")])
    count = counted(monkeypatch)
    result = s.run(1.0, 0.05)
    assert len(count) == 1 and result.steps == 20 and result.residual <= 1e-8
    s.run(1.2, 0.1)
    assert len(count) == 2, "another step has another tangent"


def test_a_law_that_is_not_linear_is_linearised_in_every_step(monkeypatch):
    s = column(material=SOFT, fluid=False, conditions=[mpm.Traction("top", lambda t: (0, -1e5 * t))])
    count = counted(monkeypatch)
    s.run(1.0, 0.25)
    assert len(count) >= 4 and np.isfinite(s.points.x).all()


FLUX, DILATION, SECOND = {"fluxes between cells"}, {"mean dilatation"}, {"second substep"}
BENCHMARK = {
    "pore fluid that drains at once": {"pore pressure", "coupling", "open sides"} | FLUX | SECOND,
    "flux between cells": FLUX | SECOND,
    "second order in time": SECOND,
    "body force": {"body force"},
    "free surface with specific yield": {"pores that drain"},
    "retention curve": {"retention"},
    "rain": set(),
    "pressure that follows the surface": {"tractions", "pressures"},
    "inertia": {"inertia"} | SECOND,
    "inertia of wet soil, both scenes with two substeps": {"inertia", "weight of the fluid"},
    "free tool that touches nothing": {"tools"},
    "free disc that rotates and touches nothing": {"tools"},
    "quiet side": {"quiet sides"},
    "tied sides": {"tied sides"},
    "ghost penalty on all faces": {"ghost penalty"},
    "rough tool that touches nothing": {"tools"},
    "contact of groups that are apart": {"contacts"},
    "contact that conducts": {"contacts that conduct"},
    "damping of pressure jumps": {"damping of pressure jumps"},
    "pressure damping of yielding instead of elastic soil": set(),
    "seepage face": set(),
    "initial stress": {"initial stress"},
    "axisymmetry": {"axisymmetry"},
    "body from a mesh": set(),
    "Mohr-Coulomb instead of Drucker-Prager": set(),
    "softening instead of Drucker-Prager": set(),
    "Modified Cam Clay instead of Drucker-Prager": set(),
    "Barcelona Basic instead of Modified Cam Clay": set(),
    "mean dilatation": DILATION,
    "plastic law, with mean dilatation": {"state of the law", "kept volumes"} | DILATION,
    "volumes of yielded domains kept": {"kept volumes"},
    "renewal of domains, where none is renewed": set(),
    "finite strain instead of a linear law": {"one factorisation for many steps"},
    "linear law, factorised in each step": {"one factorisation for many steps"},
    "files written in each step": set(),
    "layers off the grid lines": set(),
    "grid reset in each step": {"reset of the grid"},
    "grid lines that move": {"moving grid lines"},
    "division of domains, where none is divided": set(),
    "16 times the background grid": set(),
    "256 times the background grid": set(),
}


@pytest.mark.parametrize("name", PAIRS)
def test_the_benchmarks_pairs_differ_in_nothing_but_their_feature(name):
    used = []
    for make in PAIRS[name]:
        s = make(4)
        s.step(1.0)
        s.step(1.0)
        used.append({part.name for part in parts(s.scene, s.state) if part.used})
    assert used[0] ^ used[1] == BENCHMARK[name]
