# SPDX-License-Identifier: MIT
"""A rigid sphere indents a saturated gel.  The initial and the drained force give Poisson's ratio of the gel."""

import mpm_dolfinx as mpm

RADIUS, DEPTH, SIZE = 2e-3, 1e-4, 4e-3  # m
lines = mpm.graded([0, 0], [SIZE, 1.05 * SIZE], [[[0, 0.8 * SIZE], [0.2 * SIZE, 1.05 * SIZE]]], size=1e-4, ratio=1.2)
grid = mpm.Grid(lines=lines, axisymmetric=True)
gel = mpm.Hencky(bulk=1e4, shear=7.5e3, porosity=0.9, conductivity=1e-7)  # Pa, Pa, -, m/s: Poisson's ratio is 0.2
sphere = mpm.Tool(mpm.Ball((0, SIZE + RADIUS), RADIUS), displacement=lambda t: (0, -DEPTH * min(1, t / 0.01)))
simulation = mpm.Simulation(
    grid,
    [mpm.box(grid, [0, 0], [SIZE, SIZE])],
    [gel],
    fluid=mpm.Fluid(),
    walls={"right": "x", "bottom": "y"},
    conditions=[sphere, mpm.Drained("right"), mpm.Drained("top")],
)
simulation.run(t_end=0.01, dt=0.005)
mpm.plot(simulation, "pressure").figure.savefig("gel_indentation.png", bbox_inches="tight")
at_once = simulation.tool_forces["tool"][1]
simulation.run(t_end=5000, rtol=1e-2, t_eval=[1, 10, 100, 1000])
drained = simulation.tool_forces["tool"][1]
print(f"Poisson's ratio: {1 - at_once / drained / 2:.3f}")
