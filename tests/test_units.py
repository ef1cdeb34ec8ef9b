# SPDX-License-Identifier: MIT
"""The same scene in other units of length, force and time."""

from typing import NamedTuple

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.bodies.touching import Faces, covers
from mpm_dolfinx.verification.biot_fem import BiotFEM


class Units(NamedTuple):
    """Numbers of units in a metre, a newton and a second."""

    length: float = 1.0
    force: float = 1.0
    time: float = 1.0

    @property
    def stress(self):
        return self.force / self.length**2

    @property
    def density(self):
        return self.force * self.time**2 / self.length**4

    @property
    def gravity(self):
        return self.length / self.time**2

    def fluid(self, **options):
        return mpm.Fluid(bulk=2.2e9 * self.stress, density=1000 * self.density, **options)

    def soil(self):
        moduli = {"bulk": 2e6 * self.stress, "shear": 1e6 * self.stress}
        speed = self.length / self.time
        return mpm.Hencky(**moduli, porosity=0.4, conductivity=1e-5 * speed, grain_density=2650 * self.density)


OTHERS = {
    "mm, N, s": Units(1e3, 1.0, 1.0),
    "cm, kN, min": Units(1e2, 1e-3, 1 / 60),
    "km, MN, day": Units(1e-3, 1e-6, 1 / 86400),
    "m, kN, s": Units(1.0, 1e-3, 1.0),
}
LOAD = 5e4  # Pa


def column(units, *, water=None, **options):
    """Return the largest pore pressures, in Pa, of a column that is loaded in steps, from the histories."""
    grid = mpm.Grid([0, 0], np.array([0.2, 1.2]) * units.length, [2, 12])
    body = mpm.box(grid, [0, 0], np.array([0.2, 1.0]) * units.length)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    load = mpm.Traction("top", lambda t: (0, -LOAD * units.stress * min(1.0, t / units.time / 10)))
    options = {"conditions": [load, mpm.Drained("top")], **options}
    s = mpm.Simulation(grid, [body], [units.soil()], walls=walls, fluid=water or units.fluid(), **options)
    result = s.run(30 * units.time, 10 * units.time, progress=False)
    return np.array(result.pressure)[:, 1] / units.stress


@pytest.mark.parametrize("name", OTHERS)
def test_a_column_under_gravity_consolidates_alike_in_all_units(name):
    """Earlier, in mm, N and s it had 9.5 in place of 23.0 kPa, because mobilities used 9.81 for any unit of length."""
    units = OTHERS[name]
    want = column(Units(), gravity=(0, -9.81))
    assert column(units, gravity=(0, -9.81 * units.gravity)) == pytest.approx(want, rel=1e-6)
    assert want.max() > 0.3 * LOAD


@pytest.mark.parametrize("name", OTHERS)
def test_without_gravity_the_fluid_says_under_which_conductivities_are(name, warned):
    units, want = OTHERS[name], column(Units())
    assert not warned()
    assert column(units, water=units.fluid(gravity=9.81 * units.gravity)) == pytest.approx(want, rel=1e-6)
    assert not warned()
    column(units)
    (message,) = warned()
    assert "no liquid has these constants in SI units" in message and "give Fluid(gravity=...)" in message


@pytest.mark.parametrize("grows", [True, False], ids=["grows", "as a function"])
def test_a_gravity_of_time_that_comes_to_another_strength_is_named_once(grows, warned):
    units = OTHERS["mm, N, s"]
    ramp = lambda t: min(1.0, t / 15) if grows else 1.0  # noqa: E731
    for unit, water, said in ((Units(), None, 0), (units, None, 1), (units, units.fluid(gravity=9810.0), 0)):
        column(unit, water=water, gravity=lambda t, unit=unit: (0, -9.81 * unit.gravity * ramp(t)))
        messages = [message for message in warned() if "gravity varies in time" in message]
        assert len(messages) == said


def test_fluids_know_their_unit_weight():
    assert mpm.Fluid().unit_weight == 9810.0
    assert mpm.Fluid(density=1e-9, gravity=9810.0).unit_weight == pytest.approx(9.81e-6)
    for wrong in (0.0, -9.81, np.inf, np.nan, "9.81"):
        with pytest.raises(ValueError, match=r"Fluid: gravity = .*, must be > 0 and finite"):
            mpm.Fluid(gravity=wrong)
    units = OTHERS["mm, N, s"]
    grid, walls = mpm.Grid([0, 0], [100.0, 100.0], [1, 1]), {"left": "x", "right": "x", "bottom": "y"}
    scenes = [{"gravity": (0, -9810.0)}, {"gravity": (0, 0)}, {"gravity": lambda t: (0, -9810.0)}, {}]
    found = []
    for options in scenes:
        body = mpm.box(grid, [0, 0], [100.0, 50.0])
        s = mpm.Simulation(grid, [body], [units.soil()], walls=walls, fluid=units.fluid(), **options)
        found.append(s.scene.fluid.unit_weight)
    assert found == pytest.approx([9.81e-6, 9.81e-9, 9.81e-9, 9.81e-9])


@pytest.mark.parametrize("name", OTHERS)
def test_water_on_sides_and_levels_weigh_what_the_pore_fluid_does(name, warned):
    """Earlier, the unit weight was 9810 for any fluid and any units."""
    found = []
    for units in (Units(), OTHERS[name]):
        push, head = mpm.water("top", 1.5 * units.length)
        level = mpm.hydrostatic(1.5 * units.length)
        water = {"conditions": [push, head], "pressure": level, "gravity": (0, -9.81 * units.gravity)}
        found.append(column(units, **water))
    assert found[1] == pytest.approx(found[0], rel=1e-6)
    assert not any("unit_weight" in message for message in warned())


def test_a_unit_weight_that_is_given_stays():
    sea, grid = mpm.Fluid(density=1025), mpm.Grid([0, 0], [1.0, 1.0], [2, 2])
    for given, weight in (({}, 1025 * 9.81), ({"unit_weight": 9810.0}, 9810.0)):
        push, head = mpm.water("top", 2.0, **given)
        s = mpm.Simulation(
            grid,
            [mpm.box(grid, [0, 0], [1, 0.5])],
            [Units().soil()],
            fluid=sea,
            walls={"bottom": "xy"},
            gravity=(0, -9.81),
            conditions=[push, head],
            pressure=mpm.hydrostatic(2.0, **given),
        )
        assert s.points.pressure == pytest.approx(weight * (2.0 - s.points.x[:, 1]))
        pressed, drained = s.state.stage.named.values()
        for value in (pressed.value, drained.pressure):
            assert value(0.0, np.array([[0.0, 1.0]])) == pytest.approx(weight)


@pytest.mark.parametrize(("g", "said"), [(9.81, 0), (9810.0, 1)])
def test_water_on_a_dry_body_is_named_where_gravity_is_of_other_units(g, said, warned):
    grid, (push, _) = mpm.Grid([0, 0], [1.0, 1.0], [2, 2]), mpm.water("top", 2.0)
    body, options = mpm.box(grid, [0, 0], [1, 0.5]), {"walls": {"bottom": "xy"}, "gravity": (0, -g)}
    mpm.Simulation(grid, [body], [mpm.Hencky(bulk=1e6, shear=1e6)], conditions=[push], **options)
    assert sum("unit_weight = 9810" in message for message in warned()) == said


def test_finite_elements_take_the_same_unit_weight():
    units, pressures = OTHERS["mm, N, s"], []
    for unit in (Units(), units):
        water = unit.fluid(gravity=9.81 * unit.gravity)
        load = mpm.Traction("top", (0, -LOAD * unit.stress))
        options = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "conditions": [load, mpm.Drained("top")]}
        size = np.array([0.2, 1.0]) * unit.length
        fem = BiotFEM(mpm.Grid([0, 0], size, [1, 8]), unit.soil(), fluid=water, **options)
        fem.run(10 * unit.time, 10 * unit.time, probes=[size / 2])
        pressures.append(fem.pressure(np.array([[0.0, 0.0]]))[0] / unit.stress)
    assert pressures[1] == pytest.approx(pressures[0], rel=1e-6)


def test_sides_of_bent_bodies_cover_each_other_alike_in_any_unit_of_length():
    """Earlier, the unit width was an edge of faces in plane strain: with longer cells, gaps counted as contact."""

    def contacts(length):
        grid = mpm.Grid([0, -length], [5 * length, 4 * length], [5, 5])

        def bent(x):
            return np.stack([x[:, 0], x[:, 1] + 1e-4 * np.sin(x[:, 0] / length) * (2 * length - x[:, 1])], axis=1)

        lower, upper = mpm.box(grid, [0, 0], [4 * length, 2 * length]), mpm.box(grid, [0, 2 * length], [3 * length] * 2)
        return covers(Faces.around(mpm.mapped(grid, lower, bent)), Faces.around(mpm.mapped(grid, upper, bent)))

    metres = contacts(1.0)
    assert len(metres.face) and metres.slack.max() > 1e-6
    for length in (1e-3, 1e3):
        other = contacts(length)
        assert (other.face == metres.face).all() and other.slack == pytest.approx(metres.slack, rel=1e-4)
