# SPDX-License-Identifier: MIT
"""A concave tool from an STL file: a bucket carries clay.  The force on the bucket is the weight of the clay."""

from itertools import product

import matplotlib.pyplot as plt
import meshio
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import mpm_dolfinx as mpm

SIDES = np.array([(0, 1, 3, 2), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)])  # of a box without a lid
RIM = np.array([(4, 5, 13, 12), (5, 7, 15, 13), (7, 6, 14, 15), (6, 4, 12, 14)])
unit = np.array([(x, y, z) for z, y, x in product([0, 1], repeat=3)])
vertices = np.vstack([100 + unit * [1000, 800, 700], 200 + unit * [800, 600, 600]])  # mm
quads = np.vstack([SIDES, SIDES + 8, RIM])
meshio.write("bucket.stl", meshio.Mesh(vertices, [("triangle", np.vstack([quads[:, :3], quads[:, [0, 2, 3]]]))]))

grid = mpm.Grid(lower=[0, 0, 0], upper=[1.2, 1.0, 1.0], cells=[6, 5, 5])  # m
clay = mpm.box(grid, [0.2, 0.2, 0.2], [1.0, 0.8, 0.6])
soil = mpm.Hencky(bulk=1e5, shear=6e4, porosity=0.4, grain_density=2650)
bucket = mpm.Tool(mpm.SurfaceMesh.from_mesh("bucket.stl", scale=1e-3), friction=0.3, name="bucket")
simulation = mpm.Simulation(grid, [clay], [soil], walls={}, conditions=[bucket], gravity=(0, 0, -9.81))
simulation.run(t_end=1, dt=1)
print(f"weight of the clay: {simulation.tool_forces['bucket'][2] / 1000:.3f} kN")
ax = plt.figure().add_subplot(projection="3d", box_aspect=(1.2, 1, 1))
ax.add_collection3d(Poly3DCollection(bucket.drawn(grid, 1)[:, :3], alpha=0.2, facecolor="gray", edgecolor="gray"))
points = ax.scatter(*simulation.points.x.T, c=simulation.effective_stress()[:, 2, 2] / 1000, s=10)
ax.figure.colorbar(points, label="stress (kPa)", shrink=0.6, pad=0.12)
ax.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", title="Vertical stress of clay in a bucket")
ax.figure.savefig("tool_from_stl.png", dpi=80, bbox_inches="tight")
