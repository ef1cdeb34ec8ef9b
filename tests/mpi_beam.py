# SPDX-License-Identifier: MIT
"""Run the coarse beam on however many processes there are and write its state, ordered by point."""

import sys

import numpy as np
from helpers import beam

simulation, probe = beam(load=54e3)
result = simulation.run(0.1, 0.02, probes=probe, progress=False)
parts = simulation.grid.comm.gather((simulation.points.id, simulation.points.x, simulation.points.pressure))
if parts:
    ids, x, p = (np.concatenate(a) for a in zip(*parts, strict=True))
    order = np.argsort(ids)
    tip = np.array([u[0] for u in result.displacement])
    np.savez(sys.argv[1], tip=tip, x=x[order], p=p[order], balance=result.balance, counts=[len(q[0]) for q in parts])
