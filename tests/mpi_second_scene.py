# SPDX-License-Identifier: MIT
"""Several scenes use one grid, at opposite ends or with mapped bodies: each is as balanced as it would be alone."""

import sys

import numpy as np

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [4.0, 0.5], [20, 5])
assert grid.mesh is not None, "a mesh that was looked at before"


def faint(points, v):
    """Return a very small force."""
    return 1e-30 * points.value(v)[0] * points.dx


def uneven(simulation):
    """Return the largest number of points of a process, divided by the mean."""
    counts = grid.comm.allgather(len(simulation.points))
    return max(counts) / np.mean(counts)


ratios, scenes, laws = [], [], [mpm.Hencky(bulk=1e6, shear=6e5)]
for low in (0.2, 2.6):
    body = mpm.box(grid, [low, 0], [low + 1, 0.4])
    s = mpm.Simulation(grid, [body], laws, walls={"bottom": "xy"})
    ratios.append(uneven(s))
    scenes.append(s)
moved = mpm.mapped(grid, mpm.box(grid, [0.2, 0], [1.2, 0.4]), lambda x: np.add(x, (2, 0)))
s = mpm.Simulation(grid, [moved], laws, walls={"bottom": "xy"})
ratios.append(uneven(s))
again = mpm.Simulation(scenes[1].grid, scenes[1].bodies, laws, walls={"bottom": "xy"})
assert again.grid is scenes[1].grid, "the same points: the same mesh"
kept = mpm.Simulation(grid, scenes[1].bodies, laws, walls={"bottom": "xy"}, terms=[faint])
assert kept.grid is grid, "terms may have been made on the mesh"
if not grid.comm.rank:
    np.savez(sys.argv[1], imbalance=ratios)
