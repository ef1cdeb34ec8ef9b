# SPDX-License-Identifier: MIT
"""Run the beam of `mpi_beam.py` on a finer grid, with multigrid on the background grid."""

import sys
from dataclasses import replace

import numpy as np
from helpers import beam, gathered

from mpm_dolfinx.solve import solver_choice as plan

plan.THRESHOLDS = replace(plan.THRESHOLDS, multigrid_2d=1, coarsest=50)
simulation, _ = beam(h=0.01)
result = simulation.run(0.04, 0.02, progress=False)
solvers = simulation.scene.last[1].solvers
assert solvers.plan.iterative
if state := gathered(simulation, p=simulation.points.pressure):
    print(state["counts"], result.newton, result.coupling)
    np.savez(sys.argv[1], **state, balance=result.balance)
