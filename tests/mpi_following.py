# SPDX-License-Identifier: MIT
"""Push a disc into wet soil on grid lines that follow it, on any number of processes, and write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

SOIL = mpm.Hencky(2e5, 1e5, porosity=0.4, conductivity=1e-4)


def pushed(load=None):
    """Return a wet block with lines that follow a disc, on a path or under a load."""
    lines = mpm.graded([0, 0], [2, 2], [[[0.65, 0.88], [0.98, 1.24]]], 0.03, 1.25)
    path = {"displacement": lambda t: (0.42 * t, -0.1 * t)} if load is None else {"load": load, "direction": (0.3, -1)}
    disc = mpm.Tool(mpm.Ball((0.8, 1.1), 0.1), friction=0.2, **path)
    grid = mpm.Grid(lines=lines, follow=disc)
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    acting = {"conditions": [disc, mpm.Drained("top")], "fluid": mpm.Fluid()}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [2, 1])], [SOIL], walls=walls, **acting)


if __name__ == "__main__":
    simulation = pushed()
    result = simulation.run(0.1, 0.05, progress=False)
    if state := gathered(simulation):
        np.savez(sys.argv[1], **state, balance=result.balance, lines=np.concatenate(simulation.grid.lines))
