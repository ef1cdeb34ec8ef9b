# SPDX-License-Identifier: MIT
"""User-defined terms on sides of the bodies: springs, dashpots, and normal loads."""

import numpy as np
import pytest
import ufl

import mpm_dolfinx as mpm

SOIL = mpm.LinearElastic(bulk=2e6, shear=1e6)
MODULUS, LOAD, SPRING = 2e6 + 4e6 / 3, 1e3, 5e5  # Pa, Pa, Pa/m


def springs(points, u):
    """Return the energy of a Winkler foundation."""
    U = points.displacement + points.value(u)
    return SPRING / 2 * U[U.ufl_shape[0] - 1] ** 2 * points.dx


def robin(points, u, v):
    """Return the forces of this energy."""
    U = points.displacement + points.value(u)
    return SPRING * U[1] * points.value(v)[1] * points.dx


def column(terms, dim=2, off=0.03, load=LOAD, **options):
    """Return a column between smooth walls that only the terms support, with its base off the grid lines."""
    grid = mpm.Grid([0] * dim, [0.5] * (dim - 1) + [1.5], [2] * (dim - 1) + [6])
    body = mpm.box(grid, [0] * (dim - 1) + [0.2 + off], [0.5] * (dim - 1) + [1.2 + off])
    every = {"left": "x", "right": "x", "front": "y", "back": "y"}
    walls = {name: axes for name, axes in every.items() if dim == 3 or name in ("left", "right")}
    loads = [mpm.Traction("top", lambda t: [0] * (dim - 1) + [-load * min(t, 1)])]
    s = mpm.Simulation(
        grid, [body], [SOIL], walls=walls, conditions=[*loads, *options.pop("conditions", [])], terms=terms, **options
    )
    return s, mpm.probes([body], [[0.25] * (dim - 1) + [y + off] for y in (0.2, 1.2)])


@pytest.mark.parametrize(("term", "dim"), [(springs, 2), (robin, 2), pytest.param(springs, 3, marks=pytest.mark.slow)])
def test_a_column_on_springs_settles_by_them_and_by_itself(term, dim):
    s, probes = column([mpm.OnSide("bottom", term)], dim)
    for end in (0.5, 2.0):  # displacements of the steps before count
        base, top = s.run(end, 0.25, probes=probes, progress=False).displacement[-1][:, -1]
    assert base == pytest.approx(-LOAD / SPRING, rel=1e-6)
    assert top == pytest.approx(-LOAD / SPRING - LOAD / MODULUS, rel=1e-3)


def test_a_dashpot_lets_a_column_down_at_its_rate():
    def dashpot(points, velocity, v):
        return 1e6 * points.value(velocity)[1] * points.value(v)[1] * points.dx

    s, probes = column([mpm.OnSide("bottom", dashpot)])
    s.run(2.0, 0.25, probes=probes, progress=False)
    before = np.array(s.result.displacement)[-1, 0, 1]
    s.run(4.0, 0.25, probes=probes, progress=False)
    assert np.array(s.result.displacement)[-1, 0, 1] - before == pytest.approx(-2.0 * LOAD / 1e6, rel=1e-6)


def test_a_load_along_the_normal_of_a_slanted_side_is_that_of_a_traction():
    def pressed(points, v):
        return LOAD * ufl.dot(points.normal, points.value(v)) * points.dx

    found = []
    for options in ({"terms": [mpm.OnSide("top", pressed)]}, {"conditions": [mpm.Traction("top", -LOAD)]}):
        grid = mpm.Grid([0, 0], [1.5, 1.5], [6, 6])
        body = mpm.mapped(
            grid, mpm.box(grid, [0, 0], [1, 1]), lambda X: X * (1, 1) + [0.1, 0] + 0.2 * X[:, ::-1] * (0, 1)
        )
        s = mpm.Simulation(grid, [body], [SOIL], walls={"bottom": "xy"}, **options)
        s.run(1.0, 1.0, progress=False)
        found.append(s.points.x)
    assert found[0] == pytest.approx(found[1], abs=1e-10)
    assert np.abs(found[0] - s.points.origin.mean(axis=1)).max() > 1e-4


def test_terms_on_sides_and_in_bodies_act_together_and_later_stages_keep_them():
    def weight(points, v):
        return 1e3 * points.value(v)[1] * points.dx

    s, probes = column([weight, mpm.OnSide("bottom", springs)], load=0.0)
    assert s.run(1.0, 1.0, probes=probes, progress=False).displacement[-1][0, 1] == pytest.approx(
        -1e3 / SPRING, rel=1e-3
    )
    s.stage(conditions=[mpm.Traction("top", (0, -LOAD))])
    base = s.run(2.0, 1.0, probes=probes, progress=False).displacement[-1][0, 1]
    assert base == pytest.approx(-(1e3 + LOAD) / SPRING, rel=1e-3)


@pytest.mark.parametrize(
    ("term", "said"),
    [
        (mpm.OnSide("nowhere", springs), "side 'nowhere': must be one of"),
        (mpm.OnSide("top", 3), "terms: 3, must be a function"),
        (mpm.OnSide("top", lambda points: points.dx), "must be"),
        (mpm.OnSide("top", lambda points, q: 0), "argument 'q', must be one of points, u, v"),
    ],
)
def test_what_is_no_term_on_a_side_is_refused(term, said):
    with pytest.raises(ValueError, match=said):
        column([term])
