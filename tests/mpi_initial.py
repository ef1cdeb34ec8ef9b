# SPDX-License-Identifier: MIT
"""Put a bank in still water, load it, and write the state, on any number of processes."""

import sys

import numpy as np
from test_initial_stress import HELD, WATER, moved, slope

import mpm_dolfinx as mpm

soil = mpm.MohrCoulomb(bulk=5e6, shear=2.5e6, friction=35, dilation=0, cohesion=5e3, **WATER)
simulation = slope(1.1, soil, h=0.5, **HELD)
comm = simulation.grid.comm
simulation.run(10.0, 10.0, progress=False)
assert comm.allreduce(moved(simulation)) < 2e-9
before = simulation.effective_stress()
parts = comm.gather((simulation.points.id, before))
simulation.stage(conditions=[*simulation.conditions, mpm.Traction("top", (0, -2e3))])
result = simulation.run(1e3, 1e3, progress=False)
points = simulation.points
after = comm.gather((points.id, points.x, points.pressure, simulation.effective_stress()))
if parts:
    ids, stress = (np.concatenate(a) for a in zip(*parts, strict=True))
    now, x, p, s = (np.concatenate(a) for a in zip(*after, strict=True))
    order, then = np.argsort(ids), np.argsort(now)
    counts = [len(part[0]) for part in parts]
    values = {"x": x[then], "p": p[then], "stress": s[then], "rest": stress[order]}
    np.savez(sys.argv[1], **values, balance=result.balance, counts=counts)
