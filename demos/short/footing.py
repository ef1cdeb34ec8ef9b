# SPDX-License-Identifier: MIT
"""Bearing capacity of a strip footing on undrained clay.  By symmetry, half of the ground is computed."""

import mpm_dolfinx as mpm

WIDTH, STRENGTH = 1.8, 20e3  # m, Pa; with an odd number of cells over the width
grid = mpm.Grid(lower=[0, -2.4], upper=[4, 0.4], cells=[20, 14])
ground = mpm.box(grid, [0, -2.4], [4, 0])
clay = mpm.MohrCoulomb(bulk=1e10, shear=1e9, friction=0, dilation=0, cohesion=STRENGTH)
footing = mpm.Displacement("top", lambda t: (0, -4e-4 * t), "y", region=((0, -1), (WIDTH / 2, 1)), name="footing")
simulation = mpm.Simulation(
    grid,
    [ground],
    [clay],
    walls={"left": "x", "right": "x", "bottom": "xy"},
    conditions=[footing],
)
simulation.run(t_end=1, dt=0.1)
load = -2 * simulation.reactions["footing"][1]  # N/m, of both halves
print(f"bearing capacity: {load / (WIDTH * STRENGTH):.2f} of the strength (Prandtl: 5.14)")
mpm.plot(simulation, "displacement").figure.savefig("footing.png", bbox_inches="tight")
