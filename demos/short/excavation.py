# SPDX-License-Identifier: MIT
"""Pumping rate of a pit below the water table, which is excavated in three lifts and kept dry."""

import mpm_dolfinx as mpm

DAY = 86400.0  # s
grid = mpm.Grid(lower=[0, 0], upper=[20, 11], cells=[40, 22])  # m: half of the pit and the ground, by symmetry
lifts = [mpm.box(grid, [0, y], [6, y + 1]) for y in (9, 8, 7)]  # from the surface down
ground = mpm.polygon(
    grid, [(0, 0), (20, 0), (20, 10), (6, 10), (6, 7), (0, 7)], ["base", "far", "crest", "wall", "pit", ""]
)
sand = mpm.Hencky(bulk=4e7, shear=2e7, porosity=0.4, grain_density=2650, conductivity=1e-5)
far = mpm.Drained("far", lambda t, x: 9810 * (9 - x[:, 1]), name="far")  # the water table stays at 9 m
simulation = mpm.Simulation(
    grid,
    [*lifts, ground],
    [sand],
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "bottom": "xy"},
    conditions=[far],
    gravity=(0, -9.81),
    pressure=mpm.hydrostatic(9),
    initial_stress=mpm.K0(0.5),
)
for lift in range(3):
    bottom = mpm.Drained("pit" if lift == 2 else "top", name="pit")  # kept dry
    exposed = ((0, 9 - lift), (20, 10))  # m: no water passes the sheet pile
    sheet_pile = mpm.Displacement("wall", (0, 0), "x", region=exposed, name="sheet pile")
    simulation.stage(remove=[lift], conditions=[far, sheet_pile, bottom])
    simulation.run(t_end=simulation.t + DAY, dt=DAY / 4)
print(f"water to be pumped: {DAY * simulation.outflows['pit']:.2f} m^3 a day and metre of the half pit")
mpm.plot(simulation, "pressure").figure.savefig("excavation.png", dpi=80, bbox_inches="tight")
