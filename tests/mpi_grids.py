# SPDX-License-Identifier: MIT
"""Run the beam of `mpi_beam.py` on a finer grid, with multigrid on the background grid."""

import sys
from dataclasses import replace

import numpy as np
from helpers import beam

from mpm_dolfinx.solve import solver_choice as plan

plan.THRESHOLDS = replace(plan.THRESHOLDS, multigrid_2d=1, coarsest=50)
simulation, _ = beam(h=0.01)
result = simulation.run(0.04, 0.02, progress=False)
solvers = simulation.scene.last[1].solvers
assert solvers.plan.iterative
parts = simulation.grid.comm.gather((simulation.points.id, simulation.points.x, simulation.points.pressure))
if parts:
    ids, x, p = (np.concatenate(a) for a in zip(*parts, strict=True))
    order = np.argsort(ids)
    counts = [len(part[0]) for part in parts]
    print(counts, result.newton, result.coupling)
    np.savez(sys.argv[1], x=x[order], p=p[order], counts=counts, balance=result.balance)
