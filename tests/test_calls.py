# SPDX-License-Identifier: MIT
"""Number of calls of Python functions in a step: these calls take most of the time of small scenes."""

import sys

import pytest
from helpers import beam

import mpm_dolfinx as mpm
from mpm_dolfinx.base import _compat

SOIL = mpm.Hencky(bulk=1e7 / 3, shear=5e6, conductivity=1e-4)


def block():
    """Return a draining block of 10 x 10 cells, with so large a load that each step resets the grid."""
    grid = mpm.Grid([0, 0], [1, 1.2], [10, 12])
    load = mpm.Traction("top", lambda t: (0, -1e5 * t))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    body = mpm.box(grid, [0, 0], [1, 1])
    return mpm.Simulation(grid, [body], [SOIL], fluid=mpm.Fluid(), walls=walls, conditions=[load, mpm.Drained("top")])


def dry_beam():
    """Return a dry cantilever that moves into other cells in each step."""
    return beam(fluid=False, ramp=1.0)[0]


def beside_a_tool():
    """Return a dry block of 10 x 10 cells, and a rough tool that touches nothing."""
    grid = mpm.Grid([0, 0], [1, 1.2], [10, 12])
    load = mpm.Traction("top", lambda t: (0, -2e3 * t))
    tool = mpm.Tool(mpm.HalfSpace((0, 2), (0, -1)), friction=0.3)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [SOIL], walls=walls, conditions=[load, tool])


def calls(run):
    """Return the number of calls of Python functions."""
    count = 0

    def seen(frame, event, argument):
        nonlocal count
        count += event == "call"

    sys.setprofile(seen)
    try:
        run()
    finally:
        sys.setprofile(None)
    return count


@pytest.mark.parametrize(
    ("scene", "newton", "most"),
    [  # dolfinx 0.9 makes forms of other cells anew
        (block, 4, 2858),
        (dry_beam, 3, 1540 if _compat.OLD else 9700),
        (beside_a_tool, 1, 2545 if _compat.OLD else 9700),
    ],
    ids=["draining block", "dry beam", "block beside a tool"],
)
def test_a_step_calls_no_more_functions_than_before(scene, newton, most):
    """These ceilings only decrease. They include numpy's own functions, and newer releases of numpy need fewer."""
    s, reports = scene(), []

    def steps(count):
        reports.extend(s.step(0.1) for _ in range(count))

    steps(5)
    made = calls(lambda: steps(4)) / 4
    assert max(report.newton for report in reports[5:]) == newton, "other Newton steps cost other calls"
    assert made <= most
