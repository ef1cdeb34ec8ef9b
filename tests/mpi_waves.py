# SPDX-License-Identifier: MIT
"""Put quiet sides on a saturated block at rest, send a wave into it, and write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [7, 12], [7, 12])
block = mpm.box(grid, [1, 0.4], [6, 10.4])
soil = mpm.Hencky(bulk=4e7, shear=2e7, conductivity=1e-3)
holds = [mpm.Displacement(side, (0, 0), axis) for side, axis in (("bottom", "y"), ("left", "x"), ("right", "x"))]
options = {"fluid": mpm.Fluid(bulk=1e8), "walls": {}, "gravity": (0, -9.81), "inertia": False}
simulation = mpm.Simulation(grid, [block], [soil], conditions=[*holds, mpm.Drained("top")], **options)
simulation.run(100.0, 100.0, progress=False)
quiet = [mpm.Quiet(side, lambda t: (0.1 * (t - 100), 0)) for side in ("bottom", "left", "right")]
simulation.stage(inertia=True, conditions=[*quiet, mpm.Drained("top")], reset_displacement=True)
result = simulation.run(100.2, 0.05, energies=True, progress=False)
points = simulation.points
if state := gathered(simulation, p=points.pressure, velocity=points.velocity, u=points.displacement):
    energies = [of[-1] for of in result.energies.values()]
    np.savez(sys.argv[1], **state, energies=energies, balance=result.balance)
