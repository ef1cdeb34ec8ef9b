# SPDX-License-Identifier: MIT
"""Excavate half of a body on any number of processes, and write the load balance and the amount of communication."""

import sys

import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.parallel.exchange import traffic

grid = mpm.Grid([0, 0], [2.0, 0.6], [20, 6])
bodies = [mpm.box(grid, [0, 0], [1, 0.5]), mpm.box(grid, [1, 0], [2, 0.5])]
walls = {"left": "x", "right": "x", "bottom": "xy"}
simulation = mpm.Simulation(
    grid, bodies, [mpm.Hencky(bulk=1e6, shear=6e5)], walls=walls, gravity=lambda t: (0, -9.81 * t)
)


def measured(t_end):
    """Return the reported imbalance and memory of a run, and on process 0 the values of all processes."""
    result = simulation.run(t_end, 0.5, progress=False)
    pieces = simulation.scene.last[0].data.pieces
    mine = (len(simulation.points), len(pieces.cells), len(pieces.places.filled))
    print(result.shares())
    return list(result.imbalance.values()), result.memory, result.points, grid.comm.gather(mine)


whole = measured(1.0)
simulation.stage(remove=[1])
half = measured(2.0)
sent = grid.comm.gather((traffic.transfers, traffic.messages, traffic.bytes))
if sent:
    names = ("imbalance", "memory", "points", "counts")
    states = {f"{when}_{n}": v for when, s in (("whole", whole), ("half", half)) for n, v in zip(names, s, strict=True)}
    np.savez(sys.argv[1], sent=sent, **states)
