# SPDX-License-Identifier: MIT
"""Run stages with an excavation, a fill and a moving side on any number of processes, and write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.2, 1.4], [12, 14])
boxes = [([0, 0], [1.2, 0.5]), ([0, 0.5], [0.6, 0.8]), ([0.6, 0.5], [1.2, 0.93])]
bodies = [mpm.box(grid, low, high) for low, high in boxes]
soil = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5)
walls = {"left": "x", "right": "x", "bottom": "y"}
options = {"fluid": mpm.Fluid(), "walls": walls, "gravity": (0, -9.81), "conditions": [mpm.Drained("top")]}
simulation = mpm.Simulation(grid, [*bodies[:2], mpm.Later(bodies[2])], [soil], **options)
simulation.run(1.0, 1.0, progress=False)
push = mpm.Displacement("top", lambda t, X: (0, -0.02 * (t - 1)), region=((0.0, 0.0), (0.31, 0.5)))
simulation.stage(add=[2], remove=[1], conditions=[*simulation.conditions, push], reset_displacement=True)
result = simulation.run(2.0, 0.5, probes=mpm.probes(bodies, [[0.3, 0.4], [0.9, 0.9]]), progress=False)
if state := gathered(simulation, p=simulation.points.pressure, stress=simulation.effective_stress()):
    probes, reaction = result.displacement[-1], simulation.reactions.array
    np.savez(sys.argv[1], **state, probes=probes, reaction=reaction, balance=result.balance)
