# SPDX-License-Identifier: MIT
"""An interrupted run continues from its checkpoint, with the result of an uninterrupted run."""

import mpm_dolfinx as mpm


def scene():
    grid = mpm.Grid(lower=[0, 0], upper=[0.5, 1.2], cells=[5, 12])  # m
    column = mpm.box(grid, [0, 0], [0.5, 1.0])
    gel = mpm.Hencky(bulk=2e5, shear=1e5, porosity=0.5, conductivity=1e-6)
    load = mpm.Traction("top", lambda t: (0, -1e4 * min(1, t / 10)))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(grid, [column], [gel], fluid=mpm.Fluid(), walls=walls, conditions=[load, mpm.Drained("top")])


whole = scene()
whole.run(t_end=200, dt=10)

first = scene()
first.run(t_end=100, dt=10, checkpoint=mpm.Checkpoint("run.ckpt", every=5))  # every fifth output, and the last

second = scene()  # in the same script, started anew
before = mpm.resume(second, "run.ckpt")
result = second.run(t_end=200, dt=10, after=before)
print(f"difference: {abs(second.points.x - whole.points.x).max():g} m at t = {result.t[-1]:g} s")
mpm.plot(second, "pressure").figure.savefig("restart.png", bbox_inches="tight")
