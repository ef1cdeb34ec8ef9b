# SPDX-License-Identifier: MIT
"""Stages: conditions change, displacements are reset, bodies are excavated and filled."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers import column, top_load

import mpm_dolfinx as mpm

GRAVITY = (0.0, -9.81)
DENSE = mpm.Hencky(bulk=1e6, shear=6e5, porosity=0.4, conductivity=1e-3, grain_density=2500.0)
WALLS = {"left": "x", "right": "x", "bottom": "y"}


def blocks(heights=(0.5, 0.5), later=False, **options):
    """Return a simulation of stacked blocks, 1 m wide, and a probe in the middle of the lowest block's top."""
    grid = mpm.Grid([0, 0], [1.0, 1.4], [10, 14])
    bottoms = np.concatenate([[0], np.cumsum(heights)])
    bodies = [mpm.box(grid, [0, a], [1, b]) for a, b in pairwise(bottoms)]
    options = {"gravity": GRAVITY, "walls": WALLS} | options
    probes = mpm.probes(bodies, [[0.5, heights[0]]])
    if later:
        bodies[1] = mpm.Later(bodies[1])
    return mpm.Simulation(grid, bodies, [DENSE], **options), probes


def vertical(s):
    """Return the vertical stresses of the points, ordered by id."""
    return dict(zip(s.points.id.tolist(), s.effective_stress()[:, 1, 1].tolist(), strict=True))


def test_after_a_reset_displacements_count_from_there():
    s, probe = blocks()
    first = s.run(1.0, 1.0, probes=probe).displacement[-1]
    stress = vertical(s)
    s.stage(conditions=[mpm.Traction("top", (0, -1e4))], reset_displacement=True)
    second = s.run(2.0, 1.0, probes=probe).displacement
    whole, probe = blocks(conditions=[mpm.Traction("top", lambda t: (0, -1e4 * (t > 1)))])
    both = whole.run(2.0, 1.0, probes=probe).displacement
    assert second[0] == pytest.approx(np.zeros((1, 2)), abs=0)
    assert first + second[-1] == pytest.approx(both[-1], abs=1e-12)
    assert vertical(s) == pytest.approx(vertical(whole), rel=1e-9)
    assert max(vertical(s).values()) < max(stress.values()), "the weight's stress is kept and the load's added"


@pytest.mark.parametrize("inertia", [True, False])
def test_a_stage_that_changes_nothing_is_no_stage(inertia):
    """Earlier, it reset the grid: with inertia, velocities changed by .6 % in the next step."""
    shear = mpm.Traction("top", (1.0, -1.0))
    kept = {"walls": WALLS, "gravity": GRAVITY, "inertia": inertia}
    found = []
    for stages in ([], [{}, kept], [{"gravity": (0.0, -9.82)}]):
        s, _ = blocks(conditions=[shear, mpm.Displacement("left", (0, 0), "x")], inertia=inertia)
        s.run(0.02, 0.002, progress=False)
        for changes in stages:
            s.stage(**changes | {"conditions": s.conditions} if changes else {})
        s.run(0.022, 0.002, progress=False)
        found.append(s.points.x)
    assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], found[2])


def test_results_of_a_wall_go_on_if_another_wall_changes():
    """Earlier, reactions and impulses of all walls began anew."""
    s, _ = blocks(inertia=True)
    s.run(0.02, 0.002, progress=False)
    before = s.outcome("wall_impulse")["bottom"]
    s.stage(walls={**WALLS, "top": "y"})
    assert np.array_equal(s.outcome("wall_impulse")["bottom"], before) and before[1] > 0
    assert np.isfinite(s.wall_reactions["left"]).all() and np.isnan(s.wall_reactions["top"]).all()
    s.run(0.022, 0.002, progress=False)
    assert s.outcome("wall_impulse")["bottom"][1] > before[1]


def test_what_a_load_did_to_an_elastic_body_goes_with_it():
    s, probe = blocks(conditions=[mpm.Traction("top", lambda t: (0, -1e4 * min(1, t)))], gravity=None)
    s.run(1.0, 0.5, probes=probe)
    s.stage(conditions=[])
    left = s.run(2.0, 1.0, probes=probe).displacement[-1]
    assert np.abs(left).max() < 1e-6


def test_an_excavation_relieves_what_lies_below():
    s, probe = blocks()
    s.run(1.0, 0.5)
    s.stage(remove=[1])
    s.run(2.0, 1.0, probes=probe)
    alone, probe = blocks(heights=(0.5,))
    alone.run(1.0, 0.5, probes=probe)
    assert len(s.points) == len(alone.points)
    assert vertical(s) == pytest.approx(vertical(alone), abs=2e-3 * 0.5 * 15e3)


def test_the_top_of_what_is_left_is_a_side():
    """The pressure of the excavated soil's water drains through the new surface."""
    s, _ = blocks(fluid=mpm.Fluid(), pressure=1e3, gravity=(0, 0), conditions=[mpm.Drained("top")])
    s.run(10.0, 10.0)
    s.stage(remove=[1])
    result = s.run(1000.0, 100.0)
    assert result.balance < 1e-8
    assert np.abs(s.points.pressure).max() < 1e-3 * 1e3


@pytest.mark.parametrize("remove, area", [([1], 0.8), ([1, 2], 1.0)])
def test_a_condition_that_moves_on_to_what_an_excavation_lays_bare_is_named(warned, remove, area):
    grid = mpm.Grid([0, 0], [1.0, 1.4], [10, 14])
    bodies = [mpm.box(grid, *part) for part in (([0, 0], [1, 0.5]), ([0, 0.5], [0.8, 1]), ([0.8, 0.5], [1, 1]))]
    load = [mpm.Traction("top", (0, -1e3), region=((0, 0), (0.9, 2))), mpm.Traction("top", (0, -1e3))]
    s = mpm.Simulation(grid, bodies, [DENSE], walls=WALLS, conditions=[*load[1:]])
    s.stage(remove=remove)
    (message,) = warned()
    assert "Traction(side='top'" in message and f"on {area:.3g} m of newly exposed faces" in message
    other = mpm.Simulation(grid, bodies, [DENSE], walls=WALLS, conditions=[*load[1:]])
    other.stage(remove=remove, conditions=[replace(one) for one in load])
    assert not warned(), "they were given anew"


def test_a_fill_loads_what_lies_below():
    s, _ = blocks(heights=(0.5, 0.3), later=True)
    assert len(s.points) == 20 * 10
    s.run(1.0, 1.0)
    density = 0.6 * 2500
    column = 0.5 * density * 9.81
    assert min(vertical(s).values()) == pytest.approx(-0.95 * column, rel=1e-3)  # at the lowest points
    settled = s.points.corners[:, :, 1].max()
    assert settled < 0.5
    s.stage(add=[1])
    result = s.run(2.0, 1.0)
    assert result.converged and len(s.points) == 20 * 16
    assert min(vertical(s).values()) == pytest.approx(-0.775 * density * 9.81, rel=0.01)


def test_a_wet_fill_keeps_the_fluids_balance():
    s, _ = blocks(fluid=mpm.Fluid(), later=True, conditions=[mpm.Drained("top")])
    s.run(1.0, 0.5)
    s.stage(add=[1], conditions=[mpm.Drained("top")])
    result = s.run(2.0, 0.5)
    assert result.balance < 1e-8 and np.isfinite(s.points.pressure).all() and len(s.points) == 400


def test_walls_plates_and_given_displacements_come_and_go():
    s, probe = blocks(gravity=None, walls=WALLS)
    s.stage(conditions=[mpm.RigidPlate("top", 1e3)])
    down = s.run(1.0, 1.0, probes=probe).displacement[-1]
    assert down[0, 1] == pytest.approx(-0.5 * 1e3 / DENSE.oedometric, rel=1e-2)
    s.stage(conditions=[mpm.Displacement("top", (0, 0), "y")])
    back = s.run(2.0, 1.0, probes=probe).displacement[-1]
    assert abs(back[0, 1]) < 1e-6 and s.reactions.array.shape == (1, 2)
    s.stage(conditions=[], walls={"bottom": "xy"})
    assert s.run(3.0, 1.0).converged


@pytest.mark.parametrize(
    "stage, message",
    [
        ({"remove": [2]}, r"remove: body 2, must be one of the bodies that are present \(0, 1\), and listed once"),
        ({"add": [0]}, "stage: add: body 0, must be one of the bodies that are still to be added"),
        ({"conditions": [mpm.Drained("top")]}, "must be in a scene with fluid"),
        ({"gravity": (0, -1)}, "gravity: the scene has none"),
    ],
)
def test_what_cannot_be_is_refused(stage, message):
    s, _ = blocks(gravity=None)
    with pytest.raises(ValueError, match=message):
        s.stage(**stage)


def bent(later=False):
    """Return a simulation of two bodies that a map has bent, one on the other, under a load from above."""
    grid = mpm.Grid([0, 0], [1.0, 1.4], [10, 14])
    boxes = [mpm.box(grid, [0, a], [0.5, a + 0.5]) for a in (0.0, 0.5)]
    bodies = [mpm.mapped(grid, body, lambda x: x + [0.1, 0] * np.sin(x[:, [1]])) for body in boxes]
    load = [mpm.Traction("top", -1e3)]
    bodies[1:] = map(mpm.Later if later else lambda body: body, bodies[1:])
    return mpm.Simulation(grid, bodies, [DENSE], walls={"bottom": "xy"}, conditions=load)


def test_a_mapped_body_comes_later_and_goes():
    s = bent(later=True)
    assert s.run(1.0, 1.0, progress=False).converged
    low = s.points.x[:, 1].max()
    s.stage(add=[1])
    assert s.run(2.0, 1.0, progress=False).converged and s.points.x[:, 1].max() > 0.9
    s.stage(remove=[1])
    assert s.run(3.0, 1.0, progress=False).converged
    assert s.points.x[:, 1].max() == pytest.approx(low, abs=1e-4)


def test_a_mapped_body_has_no_face_where_a_region_is():
    s = bent()
    s.stage(conditions=[mpm.Traction("right", -1e3, region=((0, 0), (1, 0.3)))])
    assert s.run(1.0, 1.0, progress=False).converged
    with pytest.raises(ValueError, match="no point has this side in the region"):
        s.stage(conditions=[mpm.Traction("top", -1e3, region=((0.8, 0), (1, 2)))])


def test_an_unknown_result_is_refused_and_a_known_one_without_a_condition_is_empty():
    s = column(fluid=False, conditions=[top_load()])
    assert s.outcome("runoff") == {}
    with pytest.raises(KeyError, match=r"outcome: quantity = 'run-off', must be one of reactions, .*, runoff, "):
        s.outcome("run-off")
