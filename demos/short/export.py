# SPDX-License-Identifier: MIT
"""Results as files for ParaView (VTK, XDMF), as a table for pandas, and as a picture."""

import mpm_dolfinx as mpm

grid = mpm.Grid(lower=[0, -0.2], upper=[2.1, 0.5], cells=[42, 14])  # m
beam = mpm.box(grid, [0, 0.1], [2, 0.4])
rubber = mpm.NeoHookean(bulk=2e6, shear=1e6)
tip = mpm.Traction("right", lambda t: (0, -500 * t))
simulation = mpm.Simulation(grid, [beam], [rubber], walls={"left": "xy"}, conditions=[tip])
probe = mpm.probes([beam], [[2, 0.25]])
with mpm.Writer(simulation, "beam", grid=True) as writer:  # beam/points.pvd and beam/grid.pvd for ParaView, history.csv
    result = simulation.run(t_end=1, dt=0.2, probes=probe, observe=writer)
mpm.one_file("beam")  # beam/points.xdmf: all times in one file
table = result.to_dataframe()  # one row for each output time
table.to_csv("beam.csv")
print(f"tip deflection: {-1000 * table['uy_0'].iloc[-1]:.1f} mm")
mpm.plot(simulation, "stress_xx").figure.savefig("export.png", bbox_inches="tight")
