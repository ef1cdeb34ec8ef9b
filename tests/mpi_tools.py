# SPDX-License-Identifier: MIT
"""Press a disc, or a concave mesh, that slips into a block on any number of processes, and write its state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.3, 1.0], [13, 10])
block = mpm.box(grid, [0.13, 0], [1.17, 0.73])
soil = mpm.Hencky(bulk=4e6 / 3, shear=1e6, conductivity=1e-5)
shape = mpm.Ball((0.65, 0.98), 0.25)
if sys.argv[2:] == ["meshes"]:
    shape = mpm.SurfaceMesh([(0.3, 0.9), (0.3, 0.8), (0.4, 0.73), (0.6, 0.78), (0.7, 0.73), (0.9, 0.73), (0.9, 0.9)])
tools = [
    mpm.Tool(shape, displacement=lambda t: (0.008 * t, -0.02 * t), friction=0.3),
    mpm.Tool(mpm.HalfSpace((1.17, 0), (-1, 0)), load=lambda t: 2e3 * t, direction=(-1, 0)),
]
simulation = mpm.Simulation(
    grid, [block], [soil], fluid=mpm.Fluid(), walls={"bottom": "xy"}, conditions=[mpm.Drained("left"), *tools]
)
result = simulation.run(1.0, 0.5, progress=False)
points = simulation.points
if state := gathered(simulation, p=points.pressure, shear=points.data["tool_shear"]):
    forces = {"forces": simulation.tool_forces.array, "travel": simulation.tool_travel.array}
    np.savez(sys.argv[1], **state, balance=result.balance, **forces)
