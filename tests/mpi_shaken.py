# SPDX-License-Identifier: MIT
"""Run on any number of processes: a saturated block on a base that accelerates, in short steps, under a free tool."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.4, 1.2], [14, 12])
block = mpm.box(grid, [0.23, 0.23], [1.03, 0.79])
soil = mpm.Hencky(bulk=4e6, shear=2e6, conductivity=1e-4)
conditions = [
    mpm.Displacement("bottom", lambda t: (20 * t**2, 0)),
    mpm.Drained("right"),
    mpm.Tool(mpm.Ball((0.6, 1.0), 0.2), mass=100.0, velocity=(0.2, -1.0), friction=0.3),
]
options = {"fluid": mpm.Fluid(bulk=1e8), "walls": {}, "gravity": (0, -9.81), "inertia": True}
simulation = mpm.Simulation(grid, [block], [soil], conditions=conditions, **options)
result = simulation.run(0.02, 0.01, energies=True, progress=False)
points = simulation.points
if state := gathered(simulation, p=points.pressure, velocity=points.velocity):
    np.savez(
        sys.argv[1],
        **state,
        tool=[*simulation.outcome("tool_velocity")["tool"], simulation.outcome("tool_spin")["tool"]],
        reaction=simulation.reactions.array[0],
        energies=[of[-1] for of in result.energies.values()],
        balance=result.balance,
    )
