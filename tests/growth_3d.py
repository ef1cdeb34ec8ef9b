# SPDX-License-Identifier: MIT
"""Bend a beam in 3D in 25 steps, and print the memory of the process after each step, in MB."""

import json
from pathlib import Path

import mpm_dolfinx as mpm

if __name__ == "__main__":
    grid = mpm.Grid([0, 0, 0], [1.3, 0.5, 1.0], [13, 5, 10])
    beam = mpm.box(grid, [0, 0.1, 0.63], [1.0, 0.3, 0.83])
    soil = mpm.Hencky(bulk=1e7 / 3, shear=5e6)
    pull = mpm.Traction("right", lambda t: (0, 0, -3e4 * t))
    simulation = mpm.Simulation(grid, [beam], [soil], walls={"left": "xyz"}, conditions=[pull])
    sizes = []
    for _ in range(25):
        simulation.step(1 / 25)
        sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20)
    print(json.dumps(sizes))
