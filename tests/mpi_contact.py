# SPDX-License-Identifier: MIT
"""Press a rotated block, which slips, onto another block, then a tool onto both and onto a fill of the first group."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.3, 1.2], [13, 12], axisymmetric="axisymmetric" in sys.argv)
bodies = [mpm.box(grid, [0.13, 0], [1.17, 0.43]), mpm.box(grid, [0.33, 0.44], [0.87, 0.9], per_cell=3)]
bodies.append(mpm.box(grid, [0.95, 0.43], [1.11, 0.6]))
soil = mpm.Hencky(bulk=4e6 / 3, shear=1e6, conductivity=1e-5)
above = ([0, 0.7], [1.3, 1.2])
simulation = mpm.Simulation(
    grid,
    [*bodies[:2], mpm.Later(bodies[2])],
    [soil],
    fluid=mpm.Fluid(),
    walls={"bottom": "xy"},
    conditions=[
        mpm.Drained("left", region=([0, 0], [0.2, 1])),
        mpm.Drained("top", region=above),
        mpm.Displacement("top", lambda t, X: (0.01 * t, -0.03 * t), region=above),
        mpm.Contact([1, 2], 0, friction=0.2, conducts="conducts" in sys.argv),
    ],
)
simulation.run(0.5, 0.5, progress=False)
simulation.stage(
    add=[2],
    conditions=[
        *simulation.conditions,
        mpm.Tool(mpm.Ball([1.03, 0.7], 0.08), displacement=lambda t: (0, -0.08 * (t - 0.5))),
    ],
)
result = simulation.run(1.0, 0.5, progress=False)
points = simulation.points
shear, push = points.data["contact_shear"], points.data["contact_pressure"]
forces = {"forces": simulation.tool_forces.array, "walls": simulation.wall_reactions.array}
if state := gathered(simulation, p=points.pressure, push=push, shear=shear):
    np.savez(sys.argv[1], **state, outflows=simulation.outflows.array, balance=result.balance, **forces)
