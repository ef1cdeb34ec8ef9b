# SPDX-License-Identifier: MIT
"""Seepage faces: water leaves under pressure, and does not enter."""

import csv

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

HEIGHT, WEIGHT = 3.0, 9810.0
SOIL = mpm.Hencky(bulk=1e9, shear=5e8, porosity=0.3, conductivity=7e-6, grain_density=1000.0)


def column(base, dim=2, top=0.0, h=0.25, seepage=True, **options):
    """Return a column under gravity with given pressures at its base, and a seepage face on its top."""
    width = 0.5
    box = [*[width] * (dim - 1), HEIGHT + 1.0]
    grid = mpm.Grid([0] * dim, box, [*[2] * (dim - 1), round((HEIGHT + 1.0) / h)])
    every = {"left": "x", "right": "x", "front": "y", "back": "y", "bottom": "xyz"[dim - 1]}
    walls = {name: axes for name, axes in every.items() if dim == 3 or name not in ("front", "back")}
    body = mpm.box(grid, [*[0.0] * (dim - 1), 0.0], [*[width] * (dim - 1), HEIGHT])
    drained = [mpm.Drained("bottom", base), mpm.Drained("top", top, seepage=seepage)]
    gravity = [*[0.0] * (dim - 1), -9.81]
    return mpm.Simulation(
        grid,
        [body],
        [SOIL],
        walls=walls,
        fluid=mpm.Fluid(),
        conditions=[*drained, *options.pop("conditions", [])],
        gravity=gravity,
        **options,
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_a_column_overflows_where_the_head_at_its_base_is_above_its_top(dim):
    """A head of 4 m below a column of 3 m: the outflow of the top is k / 3, as in Kratos' verification."""
    simulation = column(4 * WEIGHT, dim)
    result = simulation.run(1e7, 1e7, progress=False)
    y, p = simulation.points.x[:, -1], simulation.points.pressure
    assert p == pytest.approx(4 * WEIGHT * (1 - y / HEIGHT), rel=1e-3, abs=4e-4 * WEIGHT)
    through = 7e-6 / 3 * 0.5 ** (dim - 1)
    assert simulation.outflows.array == pytest.approx([-through, through], rel=1e-3)
    assert result.balance < 1e-8


def test_a_column_with_its_head_below_its_top_holds_its_water_by_suction():
    simulation = column(2 * WEIGHT)
    simulation.run(1e7, 1e7, progress=False)
    y, p = simulation.points.x[:, 1], simulation.points.pressure
    assert p == pytest.approx(WEIGHT * (2 - y), abs=1e-3 * WEIGHT)
    assert simulation.outflows.array == pytest.approx([0.0, 0.0], abs=1e-10)


def test_without_a_seepage_face_water_would_enter():
    simulation = column(2 * WEIGHT, seepage=False)
    simulation.run(1e7, 1e7, progress=False)
    y, p = simulation.points.x[:, 1], simulation.points.pressure
    assert p == pytest.approx(2 * WEIGHT * (1 - y / HEIGHT), abs=1e-3 * WEIGHT)


def test_under_water_a_seepage_face_is_open_both_ways():
    simulation = column(2 * WEIGHT, top=0.5 * WEIGHT)
    simulation.run(1e7, 1e7, progress=False)
    y, p = simulation.points.x[:, 1], simulation.points.pressure
    assert p == pytest.approx(WEIGHT * (2 - 1.5 * y / HEIGHT), abs=1e-3 * WEIGHT)


def test_a_seepage_face_opens_when_the_soil_is_pressed_and_closes_when_it_swells():
    """A load presses water out. After unloading, no water enters, and the soil stays compressed."""
    grid = mpm.Grid([0, 0], [0.5, 1.25], [2, 20])
    body = mpm.box(grid, [0, 0], [0.5, 1.0])
    soil = mpm.Hencky(bulk=2e6, shear=1e6, conductivity=1e-6)
    load = mpm.Traction("top", lambda t: (0, -1e4 if t <= 1e4 else 0.0))
    s = mpm.Simulation(
        grid,
        [body],
        [soil],
        walls={"left": "x", "right": "x", "bottom": "y"},
        fluid=mpm.Fluid(),
        conditions=[mpm.Drained("top", seepage=True), load],
    )
    probe = mpm.probes([body], [[0.25, 1.0]])
    result = s.run(2e4, 1e3, probes=probe, progress=False)
    settled = np.array(result.displacement)[:, 0, 1]
    assert settled[10] == pytest.approx(-1e4 / (2e6 + 4e6 / 3), rel=1e-2)
    assert settled[-1] == pytest.approx(settled[10], rel=1e-2)
    assert s.points.pressure == pytest.approx(-1e4, rel=2e-2)
    assert result.balance < 1e-8 and result.cuts == 0


def test_outflows_of_a_stage_are_not_known_before_its_first_step_and_prescribed_ones_are_what_they_were(tmp_path):
    simulation = column(2 * WEIGHT)
    assert simulation.outflows.array.tolist() == [0.0, 0.0]
    simulation.run(1e3, 1e3, progress=False)
    simulation.stage(conditions=[mpm.Drained("bottom", 2 * WEIGHT), mpm.Inflow("top", 1e-6)])
    assert np.isnan(simulation.outflows.array).tolist() == [True, True]
    writer = mpm.Writer(simulation, tmp_path)
    simulation.run(2e3, 1e3, observe=writer, progress=False)
    assert simulation.outflows.array[1] == pytest.approx(-1e-6 * 0.5, rel=1e-12)
    with open(tmp_path / "history.csv") as file:
        first, last = csv.DictReader(file)
    names = [f"outflow_{name}" for name in simulation.outflows]
    assert [first[name] for name in names] == ["nan", "nan"]
    assert [float(last[name]) for name in names] == simulation.outflows.array.tolist()


def test_what_is_no_flag_is_refused():
    with pytest.raises(ValueError, match="Drained: seepage = 1"):
        mpm.Drained("top", seepage=1)


@pytest.mark.parametrize("coupling", ["schur-fgmres", "fixed-stress"])
def test_other_couplings_find_the_same_seepage(coupling):
    found = []
    for chosen in ("schur-cg", coupling):
        simulation = column(4 * WEIGHT, numerics=mpm.Numerics(coupling=chosen))
        simulation.run(4e3, 1e3, progress=False)  # on the way there
        found.append(simulation.points.pressure)
    assert found[1] == pytest.approx(found[0], abs=1e-5 * WEIGHT)


def test_the_reference_refuses_seepage_faces():
    options = {"walls": {"bottom": "xy"}, "fluid": mpm.Fluid(), "conditions": [mpm.Drained("top", seepage=True)]}
    with pytest.raises(ValueError, match="drained: seepage = True, must be False"):
        BiotFEM(mpm.Grid([0, 0], [1, 1], [2, 2]), SOIL, **options)
