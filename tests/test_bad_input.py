# SPDX-License-Identifier: MIT
"""Bad input gets one line that names the object, the value and what is allowed, before any work."""

import numpy as np
import pytest
from helpers import SOFT, beam, column, top_load

import mpm_dolfinx as mpm

GRID = mpm.Grid([1.0, 1.0], [10, 10])
BODY = mpm.box(GRID, [0, 0.2], [0.5, 0.5])


def scene(**options):
    return mpm.Simulation(GRID, [BODY], [SOFT], **{"fixed": {"left": "xy"}, **options})


CASES = {
    "grid of no cells": (lambda: mpm.Grid([1, 1], [0, 3]), "cells >= 1"),
    "grid of one dimension": (lambda: mpm.Grid([1], [3]), "2 or 3 entries"),
    "grid turned over": (lambda: mpm.Grid([1, -1], [3, 3]), "upper > lower"),
    "body outside the grid": (lambda: mpm.box(GRID, [0.5, 0.5], [1.5, 0.8]), "points outside the grid"),
    "body of no extent": (lambda: mpm.box(GRID, [0.5, 0.5], [0.5, 0.8]), "upper > lower"),
    "body in no cell": (lambda: mpm.shape(GRID, lambda x: x[:, 0] > 2), "fits in no cell"),
    "no points per cell": (lambda: mpm.box(GRID, [0, 0], [1, 1], per_cell=0), "per_cell = 0, must be an integer >= 1"),
    "load on no point": (
        lambda: scene(tractions=[mpm.Traction("top", (0, 1), region=((0.8, 0), (1, 1)))]),
        "no point has this side in the region",
    ),
    "unknown side": (lambda: scene(tractions=[mpm.Traction("lid", (0, 1))]), "side 'lid': in 2D a side is one of"),
    "unknown wall": (lambda: scene(fixed={"west": "x"}), "side 'west': in 2D a side is one of"),
    "unknown component": (lambda: scene(fixed={"left": "z"}), "components 'z', must be some of 'xy'"),
    "drained without fluid": (lambda: scene(drained=[mpm.Drained("left")]), "need a fluid"),
    "unknown quadrature": (lambda: scene(quadrature="gauss"), "must be domain or point"),
    "unknown coupling": (lambda: scene(coupling="monolithic"), "must be one of schur-cg"),
    "no such material": (
        lambda: mpm.Simulation(GRID, [mpm.box(GRID, [0, 0], [1, 1], material=1)], [SOFT], fixed={"left": "xy"}),
        "material = 1, must be an index of the 1 materials",
    ),
    "probe outside": (lambda: mpm.probes([BODY], [[0.9, 0.9]]), "probe at .* outside the bodies"),
    "no step": (lambda: scene().run(1.0, 0.0), "must be dt > 0"),
    "negative step": (lambda: scene().step(-1.0), "dt = -1.0, must be > 0"),
    "end before start": (lambda: scene().run(-1.0, 0.1), "t_end > 0"),
    "no end": (lambda: scene().run(np.inf, 0.1), "t_end = inf: must be .* finite"),
    "nothing holds the body": (lambda: scene(fixed={"right": "xy"}).run(1, 1), "3 of 3 ways"),
    "the body may turn": (lambda: scene(fixed={"left": "x"}).run(1, 1), "1 of 3 ways"),
}


@pytest.mark.parametrize(("make", "message"), CASES.values(), ids=CASES)
def test_one_line_says_what_is_wrong(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_point_that_leaves_the_grid_is_named_with_its_time():
    s, _ = beam(fluid=False, ramp=1.0, load=400e3)
    with pytest.raises(mpm.GaveUp, match=r"point \d+ at \[.*\] left the grid .* at t = ") as caught:
        s.run(2.0, 0.1)
    assert np.isfinite(s.points.x).all() and caught.value.result.t[-1] == pytest.approx(s.t)


def test_a_column_that_slides_is_refused():
    with pytest.raises(ValueError, match="free to move as a rigid body in 1 of 3 ways"):
        column(fluid=False, fixed={"left": "x", "right": "x"}, tractions=[top_load()]).run(1.0, 1.0)


@pytest.mark.parametrize("fluid, message", [(False, "the body is turned inside out"), (True, "the pores have closed")])
def test_a_load_that_leaves_no_volume_is_refused(fluid, message):
    """The linear law has an answer for any load: half of the volume is more than the pores, twice more than all."""
    law = mpm.LinearElastic(SOFT.bulk, SOFT.shear, porosity=0.4, conductivity=1.0)
    load = [mpm.Traction("top", (0, -(0.5 if fluid else 2.0) * law.oedometric))]
    s = column(fluid=fluid, material=law, tractions=load, **({"drained": [mpm.Drained("top")]} if fluid else {}))
    with pytest.raises(mpm.GaveUp, match=f"{message}, J <= .*: point"):
        s.run(1e6, 1e6)
    assert s.t == 0 and (s.points.J == 1).all()
