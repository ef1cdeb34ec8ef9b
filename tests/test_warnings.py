# SPDX-License-Identifier: MIT
"""Warnings about results, by categories that a user can filter, and log lines."""

import logging
import re
import warnings
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from helpers import SOFT
from test_state import same_bits

import mpm_dolfinx as mpm
from mpm_dolfinx.parallel import messages

WALLS = {"left": "x", "right": "x", "bottom": "xy"}


def overlapping():
    """Return a scene of two bodies that overlap, which its first step detects."""
    grid = mpm.Grid([0, 0], [1, 1], [10, 10])
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.3]), mpm.box(grid, [0, 0.5], [1, 0.8])], [SOFT], walls=WALLS)
    down = np.where(s.points.id < len(s.bodies[0]), 0.0, 0.3)[:, None] * [0, 1]
    moved = replace(s.points, corners=s.points.corners - down[:, None], x=s.points.x - down)
    s.state = replace(s.state, points=moved)
    return s


def thin():
    grid = mpm.Grid([0, 0], [1.0, 1.0], [10, 10])
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.1], per_cell=1)], [SOFT], walls={"left": "xy"})


def sea_water():
    grid, (load, head) = mpm.Grid([0, 0], [0.5, 2.0], [2, 8]), mpm.water("top", 1.5, unit_weight=9810.0)
    water = {"conditions": [load, head], "gravity": (0, -9.81), "fluid": mpm.Fluid(density=1025.0)}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.5, 1.0])], [SOFT], walls=WALLS, **water)


def rained(flux, retention=None, conductivity=1e-5):
    """Return sand below rain, with suction above a water level at a third of its height."""
    grid = mpm.Grid([0, 0], [0.5, 2.0], [2, 8])
    sand = replace(SOFT, conductivity=conductivity, retention=retention)
    rain = {"conditions": [mpm.Rain("top", flux)], "pressure": mpm.hydrostatic(0.5), "fluid": mpm.Fluid()}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.5, 1.5])], [sand], walls=WALLS, gravity=(0, -9.81), **rain)


def drained(pressure, side="right", gravity=(0, -9.81)):
    """Return a sand box with a prescribed pore pressure on one side."""
    grid, water = mpm.Grid([0, 0], [1.0, 2.0], [4, 8]), {"fluid": mpm.Fluid(), "gravity": gravity}
    held = [mpm.Drained(side, pressure)]
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [SOFT], walls=WALLS, conditions=held, **water)


def under_water_along_x(gravity):
    """Return a box below a water level, with gravity that does not point down."""
    grid, level = mpm.Grid([0, 0], [2.0, 1.0], [8, 4]), mpm.hydrostatic(1.5)
    scene = {"conditions": mpm.water("right", 1.5), "fluid": mpm.Fluid(), "gravity": gravity, "pressure": level}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [SOFT], walls=WALLS, **scene)


def in_mm_per_day(t, X):
    return np.where((X[:, 0] < 0.3) & (t > 15), 26.0, 0.0)


def in_radians():
    grid, phi = mpm.Grid([0, 0], [1, 1], [4, 4]), np.radians(32)
    sand = mpm.MohrCoulomb(bulk=1e7, shear=5e6, friction=phi, dilation=0, cohesion=0)
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.5])], [sand], walls=WALLS)


CASES = {
    "of rain in mm/day": (lambda: rained(26.0, mpm.Gardner(1e3)), mpm.ConditionWarning, "rain_top: flux = 26 m/s"),
    "of rain on full pores": (lambda: rained(1e-7), mpm.ConditionWarning, "suction, but no retention curve"),
    "of rain in mm/day as a function": (
        lambda: rained(in_mm_per_day, mpm.Gardner(1e3)).run(40.0, 10.0, progress=False),
        mpm.ConditionWarning,
        "rain_top: flux = 26 m/s",
    ),
    "of rain on soil without conductivity": (
        lambda: rained(1e-7, mpm.Gardner(1e3), 0.0),
        mpm.ConditionWarning,
        "rain_top: the soil at this side has conductivity 0",
    ),
    "of a uniform pressure on a high side": (
        lambda: drained(9810.0),
        mpm.ConditionWarning,
        r"drained_right: pressure = 9810 Pa is uniform, but .* differ by 9810 Pa on this side; .* mpm.hydrostatic",
    ),
    "of an angle": (in_radians, mpm.ConditionWarning, r"friction = 0\.559 degrees, .* not in radians"),
    "of a seeded body": (thin, mpm.ResolutionWarning, "1 point over its thickness"),
    "of conditions": (sea_water, mpm.ConditionWarning, "unit_weight = 9810"),
    "of a water level under gravity along x": (
        lambda: under_water_along_x((-9.81, 0)),
        mpm.ConditionWarning,
        r"pressure: the level .* gravity is \[-9.81, 0.0\], so this water is not at rest",
    ),
    "of a water level under upward gravity": (
        lambda: under_water_along_x((0, 9.81)),
        mpm.ConditionWarning,
        r"water at 'right': the level .* gravity is \[0.0, 9.81\], so this water is not at rest",
    ),
    "of a step": (lambda: overlapping().step(1.0), mpm.ResolutionWarning, "filled to 200 %"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_warning_has_a_category_and_names_the_line_of_the_script(case):
    make, category, words = CASES[case]
    with pytest.warns(category, match=words) as found:
        make()
    own = [one for one in found if issubclass(one.category, mpm.ResultWarning)]  # compilers of forms may warn too
    assert len([one for one in own if re.search(words, str(one.message))]) == 1, "one warning"
    assert issubclass(category, mpm.ResultWarning) and {one.filename for one in own} == {__file__}


def test_a_storm_on_unsaturated_sand_gives_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", mpm.ResultWarning)
        rained(3e-4, mpm.Gardner(1e3))
        rained(lambda t: 3e-4, mpm.Gardner(1e3)).run(1.0, 1.0, progress=False)


def test_saturated_soil_below_unsaturated_soil_gives_no_warning_of_numpy():
    """Earlier, a hyperbolic cosine overflowed at pressures above 710 Pa, in a value that was not used."""
    grid = mpm.Grid([0, 0], [0.2, 1.4], [2, 14])
    layers = [mpm.box(grid, [0, 0], [0.2, 0.53]), mpm.box(grid, [0, 0.53], [0.2, 1], material=1)]
    soils = [replace(SOFT, conductivity=1e-5), replace(SOFT, conductivity=1e-6, retention=mpm.Gardner(5e3))]
    scene = {"pressure": mpm.hydrostatic(0.6), "initial_stress": mpm.K0(0.5), "conditions": [mpm.Rain("top", 5e-7)]}
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        s = mpm.Simulation(grid, layers, soils, fluid=mpm.Fluid(), walls=WALLS, gravity=(0, -9.81), **scene)
        s.run(2000.0, 2000.0, progress=False)


@pytest.mark.parametrize(
    "given", [(0.0,), (mpm.hydrostatic(1.0),), (9810.0, "top"), (9810.0, "right", None), (9810.0, "right", (0, 0))]
)
def test_a_plausible_pressure_on_a_side_gives_no_warning(given):
    """A drain, water at rest, a level side, and a side without gravity."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", mpm.ResultWarning)
        drained(*given)


def test_a_warning_that_is_an_error_leaves_the_scene_as_it_was():
    s, other = overlapping(), overlapping()
    before = s.state
    with warnings.catch_warnings():
        warnings.simplefilter("error", mpm.ResultWarning)
        for _ in range(2):  # what has raised is not held for told
            with pytest.raises(mpm.ResolutionWarning, match="bodies 0, 1 overlap"):
                s.step(1.0)
            assert s.state is before
        warnings.simplefilter("ignore", mpm.ResultWarning)
        s.step(1.0), other.step(1.0)
    same_bits(s.state, other.state)


def test_log_lines_are_shown_from_a_level_on_where_nobody_shows_them(monkeypatch, capsys):
    logger = logging.getLogger("mpm_dolfinx")
    monkeypatch.setattr(logger, "propagate", False)
    monkeypatch.setattr(logger, "handlers", [])
    monkeypatch.setattr(logger, "level", logging.NOTSET)
    mpm.set_log_level("INFO")
    mpm.set_log_level("INFO")
    messages.log(MPI.COMM_SELF, "step cut to %g s", 0.5)
    assert capsys.readouterr().err == "mpm_dolfinx: step cut to 0.5 s\n"
    with pytest.raises(ValueError, match="level = 'LOUD', must be a level of logging"):
        mpm.set_log_level("LOUD")
    logger.setLevel(logging.NOTSET)
