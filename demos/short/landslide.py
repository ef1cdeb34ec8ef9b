# SPDX-License-Identifier: MIT
"""A slope at rest loses its strength, slides with inertia, and comes to rest."""

import numpy as np

import mpm_dolfinx as mpm

grid = mpm.Grid(lower=[0, 0], upper=[36, 8], cells=[36, 8])  # m
slope = mpm.polygon(grid, [(0, 0), (36, 0), (36, 2), (14, 2), (6, 7), (0, 7)], "outline")
clay = mpm.MohrCoulomb(
    bulk=2e7,
    shear=6e6,
    friction=0,
    dilation=0,
    cohesion=lambda X: np.full(len(X), 40e3),  # Pa: a function of position, so that a stage can change the cohesion
    grain_density=2650,
    porosity=0.4,
)
simulation = mpm.Simulation(
    grid,
    [slope],
    [clay],
    walls={"left": "x", "right": "x", "bottom": "xy"},
    gravity=(0, -9.81),
    initial_stress=mpm.K0(0.7),
    inertia=False,
)
simulation.run(t_end=1, dt=1)
simulation.stage(fields={"cohesion": 6e3}, inertia=True, reset_displacement=True)
simulation.run(t_end=7, dt=0.1, energies=True)
print(f"largest displacement: {np.linalg.norm(simulation.points.displacement, axis=1).max():.1f} m")
mpm.plot(simulation, "displacement").figure.savefig("landslide.png", bbox_inches="tight")
