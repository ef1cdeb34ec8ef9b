# SPDX-License-Identifier: MIT
"""A body from a mesh of triangles that meshio reads: a wedge of earth under its weight."""

import meshio
import numpy as np

import mpm_dolfinx as mpm

n = 8
rows = [[(x, y) for x in np.linspace(0, 4 - y / 2, n + 1)] for y in np.linspace(0, 4, n + 1)]
corner = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
triangles = np.concatenate([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]).reshape(-1, 3)
mesh = meshio.Mesh(np.concatenate(rows), [("triangle", triangles)])  # or meshio.read("a_file"), or the name of a file

grid = mpm.Grid(lower=[0, 0], upper=[5, 5], cells=[15, 15])  # m
wedge = mpm.from_mesh(grid, mesh)
earth = mpm.Hencky(bulk=5e6, shear=3e6, porosity=0.4, grain_density=2650)
simulation = mpm.Simulation(grid, [wedge], [earth], walls={"left": "x", "bottom": "xy"}, gravity=(0, -9.81))
simulation.run(t_end=1, dt=1)
print(f"weight: {simulation.wall_reactions['bottom'][1] / 1000:.2f} kN/m")
mpm.plot(simulation, "displacement_y").figure.savefig("mesh_from_meshio.png", dpi=80, bbox_inches="tight")
