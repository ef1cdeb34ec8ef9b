# SPDX-License-Identifier: MIT
"""The same script runs on one process or on several: `mpirun -n 2 python processes.py`."""

import mpm_dolfinx as mpm

grid = mpm.Grid(lower=[0, 0], upper=[8, 2.5], cells=[32, 10])  # m: the cells are distributed among the processes
ground = mpm.box(grid, [0, 0], [8, 2])
clay = mpm.Hencky(bulk=2e6, shear=1e6, porosity=0.5, conductivity=1e-9)
load = mpm.Traction("top", (0, -2e4), region=((0, 0), (2, 3)))
simulation = mpm.Simulation(
    grid,
    [ground],
    [clay],
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "bottom": "xy"},
    conditions=[load, mpm.Drained("top")],
)
middle = mpm.probes([ground], [[0, 2]])
result = simulation.run(t_end=1e5, dt=2e4, probes=middle)  # histories are the same on all processes
axes = mpm.plot(simulation, "displacement_y")  # all processes must call `plot`; the first process draws
if grid.comm.rank == 0:
    axes.figure.savefig("processes.png", bbox_inches="tight")
    print(f"settlement: {-1000 * result.displacement[-1, 0, 1]:.6f} mm")
