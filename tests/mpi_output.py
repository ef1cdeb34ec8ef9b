# SPDX-License-Identifier: MIT
"""Run a sheared block with output files on any number of processes. The argument is a folder."""

import sys

import mpm_dolfinx as mpm


def sheared(folder):
    """Return a block with fixed base and sheared, pressed top, and its writer."""
    grid = mpm.Grid([0, 0], [1.4, 1.0], [14, 10])
    body = mpm.box(grid, [0.2, 0.15], [0.9, 0.75])
    sides = [mpm.Displacement("bottom", (0, 0)), mpm.Displacement("top", lambda t, X: (0.2 * t, -0.05 * t))]
    simulation = mpm.Simulation(grid, [body], [mpm.Hencky(bulk=2e6, shear=1e6)], walls={}, conditions=sides)
    return simulation, mpm.Writer(simulation, folder, every=100)


if __name__ == "__main__":
    simulation, writer = sheared(sys.argv[1])
    simulation.run(1.0, 0.25, observe=writer, progress=False)
