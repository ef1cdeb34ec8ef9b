# SPDX-License-Identifier: MIT
"""Run the coarse beam on any number of processes, and write its state, ordered by point."""

import sys

import numpy as np
from helpers import beam

simulation, probe = beam(load=54e3)
result = simulation.run(0.1, 0.05, probes=probe, progress=False)
cells, number = simulation.cells(), simulation.grid.cell_number
held = simulation.grid.comm.gather((number[cells.cell], cells.pressure, cells.stress, cells.volume))
parts = simulation.grid.comm.gather((simulation.points.id, simulation.points.x, simulation.points.pressure))
if parts:
    ids, x, p = (np.concatenate(a) for a in zip(*parts, strict=True))
    order = np.argsort(ids)
    tip = np.array([u[0] for u in result.displacement])
    at, pressure, stress, volume = (np.concatenate(a) for a in zip(*held, strict=True))
    by_cell = np.argsort(at)
    held = {"pressure": pressure[by_cell], "stress": stress[by_cell], "volume": volume[by_cell]}
    held |= {"x": x[order], "p": p[order], "counts": [len(q[0]) for q in parts]}
    np.savez(sys.argv[1], tip=tip, balance=result.balance, **held)
