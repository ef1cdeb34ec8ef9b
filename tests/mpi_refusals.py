# SPDX-License-Identifier: MIT
"""All processes raise the same error, even if only one process can detect the cause."""

import warnings
from dataclasses import replace

import numpy as np

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.0, 1.0], [10, 10])
body = mpm.box(grid, [0, 0.2], [0.5, 0.5])


def scene(conductivity_law=None, **options):
    soil = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-4, conductivity_law=conductivity_law)
    return mpm.Simulation(grid, [body], [soil], walls={"left": "xy"}, **options)


def pulled(t, X):
    return 1.2 * t, 0.0


def torn(t, X):
    return np.where(X > 0.4, np.nan, 0.0)


CASES = {
    "left the grid": scene(conditions=[mpm.Displacement("right", pulled)]),
    "conductivity law: k": scene(lambda x: 0.4 - x[0], fluid=mpm.Fluid()),
    "Displacement(side='top'": scene(conditions=[mpm.Displacement("top", torn)]),
}
for words, simulation in CASES.items():
    try:
        simulation.run(1.0, 0.1, progress=False)
        message = "accepted"
    except (ValueError, mpm.GaveUp) as error:
        message = str(error)
    said = grid.comm.allgather(message)
    assert words in message and len(set(said)) == 1, said


try:
    soil = mpm.Hencky(bulk=lambda X: 1e6 + 1e6 * (X[:, 1] - X[:, 1].mean()), shear=6e5)
    mpm.Simulation(grid, [body], [soil], walls={"left": "xy"})
    message = "accepted"
except ValueError as error:
    message = str(error)
assert message.startswith("Hencky: bulk: the value at a position depends on other positions"), message


def seen(simulation):
    if grid.comm.rank == grid.comm.size - 1:
        raise OSError("the disk is full")


try:
    scene().run(1.0, 0.5, observe=seen, progress=False)
    message = "accepted"
except (OSError, RuntimeError) as error:
    message = str(error)
assert "disk is full" in message or f"on process {grid.comm.size - 1}" in message, message

try:
    scene().run(1.0, 0.1 * (1 + grid.comm.rank), progress=False)
    message = "accepted"
except ValueError as error:
    message = str(error)
assert message == "dt = 0.1 on process 0, 0.2 on process 1, must be the same on all", message

mine = [mpm.box(grid, [0, 0.2], [0.3, 0.5]), mpm.box(grid, [0.5, 0.2], [0.8, 0.5])]
simulation = mpm.Simulation(grid, mine, [mpm.Hencky(bulk=1e6, shear=6e5)], walls={"left": "xy", "right": "xy"})
points = simulation.points
left = np.where(points.id < len(mine[0]), 0.0, 0.4)[:, None] * [1, 0]
moved = replace(points, corners=points.corners - left[:, None], x=points.x - left)
simulation.state = replace(simulation.state, points=moved)  # the cells are distributed anew before the step
try:
    with warnings.catch_warnings():
        warnings.simplefilter("error", mpm.ResultWarning)
        simulation.step(1.0)
    message = "accepted"
except mpm.ResolutionWarning as error:
    message = str(error)
said = grid.comm.allgather(message)
assert "overlap" in message and len(set(said)) == 1 and simulation.t == 0, said
after, kept = simulation.state.points, grid.comm.allgather((moved.id, moved.corners))
kept = dict(pair for ids, corners in kept for pair in zip(ids, corners, strict=True))
assert all((kept[i] == corners).all() for i, corners in zip(after.id, after.corners, strict=True))
