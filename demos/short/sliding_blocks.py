# SPDX-License-Identifier: MIT
"""Two blocks are in contact, and the upper block is pressed down and slides with friction."""

import mpm_dolfinx as mpm

grid = mpm.Grid(lower=[0, 0], upper=[2, 1.2], cells=[20, 12])  # m
lower, upper = mpm.box(grid, [0, 0], [2, 0.5]), mpm.box(grid, [0.5, 0.5], [1.1, 0.9])
gel = mpm.Hencky(bulk=1e6, shear=6e5)
push = mpm.Displacement("top", lambda t: (0.3 * max(0, t - 1), -0.005 * min(1, t)), region=((0, 0.8), (2, 1)))
contact = mpm.Contact(1, 0, friction=0.3)
simulation = mpm.Simulation(
    grid, [lower, upper], [gel], walls={"left": "x", "right": "x", "bottom": "xy"}, conditions=[push, contact]
)
simulation.run(t_end=2, dt=0.1)
along, normal = simulation.tool_forces["contact"][:2]
print(f"friction: {-along / normal:.3f} of the normal force")
mpm.plot(simulation, "stress_yy").figure.savefig("sliding_blocks.png", bbox_inches="tight")
