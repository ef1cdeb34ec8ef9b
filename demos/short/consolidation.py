# SPDX-License-Identifier: MIT
"""Consolidation: a saturated clay layer of 10 m settles under 50 kPa and drains at its top."""

import matplotlib.pyplot as plt

import mpm_dolfinx as mpm

YEAR = 3.156e7  # s
grid = mpm.Grid(lower=[0, 0], upper=[1, 11], cells=[1, 22])  # m
layer = mpm.box(grid, [0, 0], [1, 10])
clay = mpm.LinearElastic(bulk=4e6, shear=3e6, conductivity=1e-9)  # Pa, Pa, m/s
simulation = mpm.Simulation(
    grid,
    [layer],
    [clay],
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "bottom": "y"},
    conditions=[mpm.Traction("top", (0, -5e4)), mpm.Drained("top")],
)
top = mpm.probes([layer], [[0.5, 10]])
outputs = [0.1 * YEAR * k for k in range(1, 21)]
result = simulation.run(t_end=2 * YEAR, rtol=1e-3, t_eval=outputs, probes=top)  # adaptive steps
print(f"settlement after two years: {-1000 * result.displacement[-1, 0, 1]:.1f} mm")
plt.plot([t / YEAR for t in result.t], 1000 * result.displacement[:, 0, 1])
plt.xlabel("time (years)")
plt.ylabel("displacement of the top (mm)")
plt.savefig("consolidation.png", bbox_inches="tight")
