# SPDX-License-Identifier: MIT
"""Separate bodies do not affect each other, neither by their stiffness nor by their motion."""

from functools import cache

import numpy as np
import pytest
from far_bodies import E, beside
from scipy.optimize import brentq

import mpm_dolfinx as mpm

CLAY = mpm.DruckerPrager(bulk=E / 1.8, shear=E / 2.6, friction=20.0, dilation=0.0, cohesion=30.0, conductivity=1e-4)


@cache
def after(kind, stiffer=1.0, wet=False, law=None, steps=2, plate=False):
    """Return displacements, stresses and pressures of the beam after some steps, and the residuals of these steps."""
    options = {} if law is None else {"numerics": mpm.Numerics(tolerance=1e-10)}  # far below what is compared
    s = beside(kind, stiffer, wet, law, plate, **options)
    n, start = len(s.bodies[0]), s.points.x
    told = [s.step(1.0).history[-1] for _ in range(steps)]
    points = s.points
    found = [(points.x - start)[:n], s.effective_stress()[:n], *[points.pressure[:n]] * wet]
    return found, np.max(told, axis=0)


def off(one, other):
    """Return the largest difference, divided by the largest value."""
    return max(np.abs(a - b).max() / np.abs(b).max() for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("stiffer", [1e2, 1e6, 1e10, 1e13])
def test_a_body_at_rest_however_stiff_changes_nothing_and_hides_no_residual(stiffer):
    (found, told), (alone, as_is) = after("rests", stiffer), after(None)
    assert off(found, alone) < 1e-11 and told == pytest.approx(as_is, rel=1e-3)


@pytest.mark.parametrize("kind", ["moves", "loaded"])
@pytest.mark.parametrize("stiffer", [1.0, 1e10])
def test_what_a_far_body_does_changes_nothing(kind, stiffer):
    assert off(after(kind, stiffer)[0], after(None)[0]) < 1e-11


def test_a_plate_is_rigid_beside_what_it_lies_on():
    """In an earlier version, the stiffest body determined the rigidity of plates: a distant body changed the result."""
    assert off(after("rests", 1e10, plate=True)[0], after(None, plate=True)[0]) < 1e-11


@pytest.mark.parametrize(("kind", "stiffer"), [("rests", 1e10), ("moves", 1e8), ("drains", 1.0), ("drains", 1e6)])
def test_a_wet_body_takes_the_same_step_whatever_others_do(kind, stiffer):
    assert off(after(kind, stiffer, wet=True, steps=1)[0], after(None, wet=True, steps=1)[0]) < 1e-9


def test_pressures_of_soil_that_does_not_conduct_are_the_same_next_to_soil_that_does():
    """Earlier, pressures in cells varied hydrostatically only if any soil conducted: errors up to 9e-3."""
    found = []
    for kind in (None, "drains"):
        law = mpm.Hencky(bulk=E / 1.8, shear=E / 2.6, grain_density=2.0, porosity=0.4)
        water = {"density": 1.0, "bulk": 100 * E}
        s = beside(
            kind, 1e6, True, law, gravity=[0, -1.0], fluid=mpm.Fluid(**water), numerics=mpm.Numerics(tolerance=1e-11)
        )
        start = s.points.x
        for _ in range(2):
            s.step(1.0)
        n = len(s.bodies[0])
        found.append([(s.points.x - start)[:n], s.effective_stress()[:n], s.points.pressure[:n]])
    assert off(*found) < 1e-9


@pytest.mark.parametrize("kind", ["moves", "loaded"])
def test_soil_that_yields_takes_the_same_step_whatever_others_do(kind):
    """The line search of each part is separate. The beam has yielded, and the distant body has not."""
    (found, told), (alone, as_is) = (after(one, 1e4, law=CLAY) for one in (kind, None))
    q = alone[1][:, 0, 0] - alone[1][:, 1, 1]
    assert np.abs(q).max() > 30.0 and off(found, alone) < 1e-9 and told[0] <= 1e-10 and as_is[0] <= 1e-10


def touching(kind, group=1, way=0.02):
    """Return results of two blocks in contact after three steps, next to a third body of one of their groups."""
    grid = mpm.Grid([0, 0], [4.2, 1.6], [21, 8])
    bodies = [mpm.box(grid, [0.13, 0.0], [1.33, 0.55]), mpm.box(grid, [0.43, 0.55], [1.03, 0.95])]
    groups = [[0], [1]]
    press = mpm.Displacement("top", lambda t, X: (0, -way * min(t, 1.0)), region=((0.4, 0.9), (1.1, 1.0)))
    conditions = [press]
    if kind:
        bodies.append(mpm.box(grid, [2.73, 0.41], [3.31, 0.97]))
        groups[group].append(2)
        moves = (lambda t, X: (0.04 * t, 0.02 * t)) if kind == "moves" else (0, 0)
        conditions.append(mpm.Displacement("bottom", moves, region=((2.0, 0.3), (4.0, 0.6))))
    if kind == "pressed":  # in contact too
        bodies.append(mpm.box(grid, [2.58, 0.97], [3.15, 1.36]))
        groups[1 - group].append(3)
        conditions.append(mpm.Displacement("top", lambda t, X: (0, -0.1 * min(t, 1)), region=((2.0, 1.3), (4.0, 1.4))))
    given = {"walls": {"bottom": "xy"}, "numerics": mpm.Numerics(tolerance=1e-11)}
    conditions.append(mpm.Contact(*groups, friction=0.3))
    s = mpm.Simulation(grid, bodies, [CLAY], conditions=conditions, **given)
    n, start = sum(map(len, bodies[:2])), s.points.x
    for _ in range(3):
        s.step(1.0)
    return (s.points.x - start)[:n], s.effective_stress()[:n], s.tool_forces.array


@pytest.mark.parametrize("way", [0.005, 0.05])
@pytest.mark.parametrize("group", [0, 1])
def test_bodies_in_contact_are_not_affected_by_the_motion_of_a_body_beyond_their_reach(way, group):
    """In an earlier version, all groups formed one part, which was cut anew when the distant body moved: changes of
    4e-6.

    The group with the smaller surface had the contact points, so the distant body's surface decided on them.
    """
    assert off(touching("moves", group, way), touching(None, group, way)) < 1e-9


def test_bodies_in_contact_are_not_affected_by_others_whose_contact_is_harder_to_find():
    """Earlier, pressures were augmented and pairs found anew in all contacts: the stress changed by 2e-3."""
    (x, stress, _), (alone, as_is, _) = touching("pressed"), touching(None)
    assert off((x, stress), (alone, as_is)) < 1e-9


@pytest.mark.parametrize("stiffer", [1e6, 1e10, 1e14])
def test_a_soft_part_is_solved_for_however_stiff_what_it_sits_on_is(stiffer):
    """Rounding is estimated at each node, and the reported residual includes the residual of the soft part."""
    grid, load = mpm.Grid([0, 0], [0.1, 1.0], [1, 10]), 0.03
    soft, hard = (mpm.Hencky(bulk=f * 1e5, shear=f * 1e5) for f in (1, stiffer))
    bodies = [mpm.box(grid, [0, 0], [0.1, 0.5]), mpm.box(grid, [0, 0.5], [0.1, 0.9], material=1)]
    pull = mpm.Traction("top", (0, load * soft.oedometric), region=((-np.inf, 0.8), (np.inf, np.inf)))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    s = mpm.Simulation(grid, bodies, [hard, soft], walls=walls, conditions=[pull])
    history = s.step(1.0).history
    strain = s.points.F[s.points.material == 1, 1, 1] - 1
    assert strain == pytest.approx(np.full(len(strain), brentq(lambda a: np.log(a) / a - load, 1, 2) - 1), rel=1e-7)
    assert history[0][0] == pytest.approx(1.0) and history[-1][0] < 1e-8
