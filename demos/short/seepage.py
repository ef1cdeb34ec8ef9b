# SPDX-License-Identifier: MIT
"""Seepage with a free surface through an earth dam, with water levels of 8 m and 2 m."""

import mpm_dolfinx as mpm

WEIGHT, CONDUCTIVITY = 9810.0, 1e-6  # N/m^3, m/s
grid = mpm.Grid(lower=[-0.5, 0], upper=[10.5, 11], cells=[22, 22])  # m
dam = mpm.box(grid, [0, 0], [10, 10])
law = mpm.unsaturated(WEIGHT / 4)  # hardly any water flows above the free surface
soil = mpm.LinearElastic(bulk=1e9, shear=5e8, conductivity=CONDUCTIVITY, conductivity_law=law)
simulation = mpm.Simulation(
    grid,
    [dam],
    [soil],
    fluid=mpm.Fluid(),
    walls={"bottom": "xy"},
    conditions=[*mpm.water("left", 8.0), *mpm.water("right", 2.0)],
    gravity=(0, -9.81),
    pressure=mpm.hydrostatic(5),
)
simulation.run(t_end=1e8, dt=2e7)
flow = simulation.outflows["drained_right"]
print(f"flow: {flow * 86400:.4f} m^3 a day and metre of the dam")
mpm.plot(simulation, "pressure").figure.savefig("seepage.png", bbox_inches="tight")
