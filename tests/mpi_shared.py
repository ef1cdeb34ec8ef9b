# SPDX-License-Identifier: MIT
"""Press yielding wet soil, with factors that the processes share, and write the state."""

import sys
from dataclasses import replace

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import solver_choice as plan

plan.THRESHOLDS = replace(plan.THRESHOLDS, mumps=1)
grid = mpm.Grid([0, 0], [1, 1.25], [16, 20])
soil = mpm.DruckerPrager(bulk=2e6, shear=1e6, friction=20.0, dilation=0.0, cohesion=1e3, conductivity=1e-7)
simulation = mpm.Simulation(
    grid,
    [mpm.box(grid, [0, 0], [1, 1])],
    [soil],
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "bottom": "xy"},
    conditions=[mpm.Traction("top", lambda t: (0, -3e3 * t), region=((0, 0.5), (0.5, 2))), mpm.Drained("top")],
)
result = simulation.run(1.0, 0.5, progress=False)
solvers = simulation.scene.last[1].solvers
for ksp in (solvers.solve_u, solvers.schur[1]):
    factors = ksp.pc.getFactorMatrix()
    entries = grid.comm.allgather(factors.getMumpsInfo(9))
    assert grid.comm.size == 1 or max(entries) < sum(entries), entries
assert max(grid.comm.allgather(simulation.points.data["plastic"].max(initial=0.0))) > 1e-5
if state := gathered(simulation):
    np.savez(sys.argv[1], **state, balance=result.balance)
