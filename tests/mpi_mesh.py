# SPDX-License-Identifier: MIT
"""Run a slope of triangles on a layer of quadrilaterals on any number of processes, and write the state."""

import sys

import numpy as np
from helpers import gathered
from meshes import box_mesh

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.2, 1.2], [12, 12])
slope = box_mesh(
    "triangle", (6, 4), (0, 0), (1, 1), place=lambda x: np.stack([x[:, 0] * (1 - 0.4 * x[:, 1]), x[:, 1] / 2 + 0.4], 1)
)
bodies = [mpm.from_mesh(grid, box_mesh("quad", (13, 4), (0, 0), (1.2, 0.4))), mpm.from_mesh(grid, slope)]
soil = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5)
simulation = mpm.Simulation(
    grid,
    bodies,
    [soil],
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "bottom": "y"},
    conditions=[mpm.Traction("top", lambda t: -1e5 * t), mpm.Drained("right")],
)
result = simulation.run(1.0, 0.5, probes=mpm.probes(bodies, [[0.3, 0.4], [0.3, 0.8]]), progress=False)
if state := gathered(simulation, p=simulation.points.pressure, stress=simulation.effective_stress()):
    np.savez(sys.argv[1], **state, probes=result.displacement[-1], balance=result.balance)
