# SPDX-License-Identifier: MIT
"""Push a ball into wet soil in 3D on grid lines that follow it, on any number of processes, and write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm
from mpm_dolfinx.grid.following import carried

SOIL = mpm.Hencky(2e6, 1e6, porosity=0.4, conductivity=1e-4)
LINES = mpm.graded([0, 0, 0], [2.1, 0.9, 0.9], [[[0.9, 0.3, 0.45], [1.2, 0.6, 0.75]]], 0.15, 1.6)


def leading(t, x):
    """Return lines whose smallest cells move along x with time, within the soil."""
    return carried(LINES, np.array([min(2 * t, x[:, 0].max() - 1.5), 0.0, 0.0]))


def pushed(follows=True):
    """Return a wet block under a smooth ball, on lines that follow the ball, or on the lines `leading`."""
    ball = mpm.Tool(mpm.Ball((1.05, 0.45, 0.75), 0.15), lambda t: (2 * t, 0, -0.2 * t))
    grid = mpm.Grid(lines=LINES, follow=ball if follows else leading)
    walls = {"left": "x", "right": "x", "front": "y", "back": "y", "bottom": "xyz"}
    acting = {"conditions": [ball, mpm.Drained("top")], "fluid": mpm.Fluid(), "gravity": (0, 0, -9.81)}
    block, tight = mpm.box(grid, [0, 0, 0], [2.1, 0.9, 0.6]), mpm.Numerics(tolerance=1e-11)
    return mpm.Simulation(grid, [block], [SOIL], walls=walls, numerics=tight, **acting)


if __name__ == "__main__":
    simulation = pushed()
    result = simulation.run(0.1, 0.05, progress=False)
    if state := gathered(simulation):
        np.savez(sys.argv[1], **state, balance=result.balance, lines=np.concatenate(simulation.grid.lines))
