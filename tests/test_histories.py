# SPDX-License-Identifier: MIT
"""Histories of a run as arrays."""

import pickle
import time

import numpy as np
import pytest
from helpers import column

import mpm_dolfinx as mpm
from mpm_dolfinx.base.histories import COLUMNS, Row, Rows


def rows(n, m=3):
    return [Row(0.5 * k, np.full((m, 2), float(k))) for k in range(n)]


def test_histories_are_arrays_of_the_right_number_of_axes():
    s = column(cells=4, fluid=False)
    result = s.run(2.0, 1.0, progress=False)
    empty = {"displacement": (3, 0, 2), "position": (3, 0, 2), "probe_pressure": (3, 0), "probe_stress": (3, 0, 3, 3)}
    empty |= {"pressure": (3, 0)}
    assert {name: getattr(result, name).shape for name in empty} == empty
    assert result.t.tolist() == [0, 1, 2] and result.wall_reactions["left"].shape == (3, 2) and result.reactions == {}
    probes = mpm.probes(s.bodies, [[0.05, 0.5]], stress=True)
    wet = column(cells=4).run(1.0, 1.0, probes=probes, progress=False)
    shapes = {"displacement": (2, 1, 2), "probe_pressure": (2, 1), "probe_stress": (2, 1, 3, 3), "pressure": (2, 2)}
    assert {name: getattr(wet, name).shape for name in shapes} == shapes
    none = mpm.Result()
    assert none.t.shape == (0,) and none.displacement.shape == (0, 0, 0) and none.wall_reactions == {}


def test_histories_go_on_in_two_ways_from_where_they_were_kept():
    kept = Rows(rows(3))
    one, other = kept.more(Row(7.0, np.ones((3, 2)))), kept.more(Row(8.0, np.zeros((3, 2))))
    assert one.column("t").tolist() == [0, 0.5, 1, 7] and other.column("t").tolist() == [0, 0.5, 1, 8]
    assert len(kept) == 3 and one.run is kept.run is other.run and Rows(rows(3)).run is not kept.run
    assert not one.column("displacement").flags.writeable and kept[-1].t == kept[2].t == 1.0
    copy = pickle.loads(pickle.dumps(one))
    assert all(np.array_equal(copy.column(name), one.column(name)) for name in COLUMNS)


def test_rows_that_grow_are_filled_up_and_leave_those_that_were_kept():
    kept = Rows(rows(2))
    wider = kept.more(Row(1.0, np.zeros((4, 2)))).more(Row(2.0, np.zeros((1, 2))))
    assert kept.column("displacement").shape == (2, 3, 2) and wider.column("displacement").shape == (4, 4, 2)
    assert np.isnan(wider.column("displacement")[:, :, 0]).sum(axis=1).tolist() == [1, 1, 0, 3]


@pytest.mark.parametrize("count", [200, 6400])
def test_another_row_takes_as_long_in_a_long_run(count, times={}):  # noqa: B006
    """The time of an additional row, and of reading the last row, is constant. A copy of all rows would take 32 times
    as long.
    """
    row, result, spent = Row(0.0, np.zeros((50, 2))), mpm.Result(Rows([Row(0.0, np.zeros((50, 2)))] * count)), []
    for _ in range(200):
        began = time.perf_counter()
        result = result.more(row)
        assert result.displacement[-1, 0, 1] == 0
        spent.append(time.perf_counter() - began)
    times[count] = np.median(spent)
    assert max(times.values()) < 5 * min(times.values())
