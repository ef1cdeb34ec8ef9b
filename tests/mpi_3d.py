# SPDX-License-Identifier: MIT
"""Run a saturated block in 3D with iterative solvers, on any number of processes, and write its state."""

import sys
from dataclasses import replace

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import solver_choice as plan

plan.THRESHOLDS = replace(plan.THRESHOLDS, multigrid_3d=0)
grid = mpm.Grid([0] * 3, [1.2] * 3, [6] * 3)
block = mpm.box(grid, [0.2, 0.2, 0], [0.9, 0.93, 0.77])
soil = mpm.Hencky(bulk=4e6 / 3, shear=1e6, conductivity=1e-7)
simulation = mpm.Simulation(
    grid,
    [block],
    [soil],
    fluid=mpm.Fluid(),
    walls={"bottom": "xyz"},
    conditions=[
        mpm.Drained("top"),
        mpm.Traction("top", lambda t: (2e4 * t, 1e4 * t, -5e4 * t)),
        mpm.Pressure("right", lambda t: 2e4 * t),
    ],
    numerics=mpm.Numerics(tolerance=1e-11),
)
result = simulation.run(1.0, 0.5, progress=False)
points = simulation.points
simulation.cells()
if state := gathered(simulation, p=points.pressure):
    np.savez(sys.argv[1], **state, balance=result.balance, walls=simulation.wall_reactions.array)
    print(result.newton, result.coupling, result.cuts)
