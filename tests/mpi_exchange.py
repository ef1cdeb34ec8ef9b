# SPDX-License-Identifier: MIT
"""Rows of any type and width, and whole points, are sent to other processes and back; messages are counted."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.bodies.bodies import material_points
from mpm_dolfinx.parallel.exchange import Exchange, traffic

comm = MPI.COMM_WORLD
for n in (0, 1, 500):
    destination = np.random.default_rng(comm.rank).integers(0, comm.size, n).astype(np.int32)
    travel = Exchange(comm, destination)
    sender, number = travel.send(np.full(n, comm.rank)), travel.send(np.arange(n))
    expected = [
        (rank, i) for rank, ends in enumerate(comm.allgather(destination)) for i in np.flatnonzero(ends == comm.rank)
    ]
    assert list(zip(sender, number, strict=True)) == expected
    for dtype in (np.float64, np.int64, np.int32, np.int8, np.bool_):
        for shape in ((), (2,), (3, 3), (0,)):
            rows = np.random.default_rng(n).integers(0, 100, (n, *shape)).astype(dtype)[::-1]
            before = traffic.bytes
            there = travel.send(rows)
            assert there.dtype == dtype and there.shape == (len(expected), *shape)
            assert np.array_equal(travel.back(there), rows)
            away = np.count_nonzero(destination != comm.rank), sum(rank != comm.rank for rank, _ in expected)
            assert traffic.bytes - before == sum(away) * rows[:1].nbytes
    if comm.size == 1:
        assert there is rows and traffic.bytes == 0

# points arrive alike whichever of their arrays are one and the same, also where that differs between processes
grid = mpm.Grid([0, 0], [1, 1], [4, 4])
shared = material_points(grid, [mpm.box(grid, [0, 0], [1, 1])])
apart = replace(shared, origin=shared.origin.copy(), reference=shared.reference.copy())
there = Exchange(comm, (shared.id % comm.size).astype(np.int32))
for points in (shared, apart, apart if comm.rank == 0 else shared):
    moved = points.migrated(there)
    assert (moved.id % comm.size == comm.rank).all() and comm.allreduce(len(moved)) == 64
    assert np.array_equal(moved.corners, moved.origin) and np.array_equal(moved.origin, moved.reference)
    assert np.allclose(moved.corners.mean(axis=1), moved.x)
moved = shared.migrated(there)
assert moved.origin is moved.reference
