# SPDX-License-Identifier: MIT
"""Run a seam with its own law, off the grid lines; some processes have no part of the seam. Write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0, 0], [0.25, 0.25, 1.25], [2, 2, 10])
seams = [(0, 0.76, 0), (0.76, 0.87, 1), (0.87, 1, 0)]
bodies = [mpm.box(grid, [0, 0, low], [0.25, 0.25, high], material=m) for low, high, m in seams]
sand = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-4, conductivity_law=mpm.kozeny_carman)
clay = mpm.NeoHookean(bulk=5e5, shear=3e5, conductivity=1e-9)
top = [-np.inf, -np.inf, 0.95], [np.inf, np.inf, 1.05]
simulation = mpm.Simulation(
    grid,
    bodies,
    [sand, clay],
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "front": "y", "back": "y", "bottom": "z"},
    conditions=[mpm.Drained("top", 0.0, top), mpm.Traction("top", (0, 0, -1e5), top)],
    gravity=(0, 0, -10),
)
places = [[x, y, z] for x, y in ((0.0, 0.25), (0.11, 0.13)) for z in (0.0, 0.31, 0.75, 0.8, 0.88, 0.99)]
probes = mpm.probes(bodies, places, stress=True)
result = simulation.run(2.0, 1.0, probes=probes, progress=False)
if state := gathered(simulation, p=simulation.points.pressure):
    assert state["p"][state["x"][:, 2] < 0.7].min() > 5e4, "the seam holds nothing back"
    probed = {"probe_p": result.probe_pressure[-1], "probe_stress": result.probe_stress[-1]}
    np.savez(sys.argv[1], **state, balance=result.balance, **probed)
