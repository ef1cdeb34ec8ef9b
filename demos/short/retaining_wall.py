# SPDX-License-Identifier: MIT
"""Active thrust of sand on a smooth retaining wall of 3 m that tilts about its toe, away from the sand."""

import mpm_dolfinx as mpm

grid = mpm.Grid(lower=[-0.6, 0], upper=[4.2, 3.6], cells=[16, 12])  # m
sand = mpm.box(grid, [0, 0], [4.2, 3])
soil = mpm.MohrCoulomb(bulk=5e7, shear=3e7, friction=30, dilation=30, cohesion=100, grain_density=2650, porosity=0.4)
wall = mpm.Displacement("left", lambda t, X: [-1e-3 * t, 0] * X[:, [1]], "x", name="wall")
simulation = mpm.Simulation(
    grid,
    [sand],
    [soil],
    walls={"right": "x", "bottom": "xy"},
    conditions=[wall],
    gravity=(0, -9.81),
    initial_stress=mpm.K0(0.5),
)
simulation.run(t_end=1, dt=0.1)
thrust = simulation.reactions["wall"][0]  # N/m
print(f"active thrust: {thrust / 1000:.1f} kN/m")
mpm.plot(simulation, "displacement").figure.savefig("retaining_wall.png", bbox_inches="tight")
