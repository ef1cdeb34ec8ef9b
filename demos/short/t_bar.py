# SPDX-License-Identifier: MIT
"""Resistance of a T-bar, a rough cylinder, in deep undrained clay.  By symmetry, half of the scene is computed."""

import numpy as np

import mpm_dolfinx as mpm

RADIUS, STRENGTH, DEPTH = 0.5, 1e3, 2e4  # m, Pa, Pa: overburden pressure at the depth of the bar
grid = mpm.Grid(lower=[0, -2.5], upper=[2.5, 2.75], cells=[20, 42])
angle = np.linspace(-np.pi / 2, np.pi / 2, 25)
arc = [(RADIUS * np.cos(a), RADIUS * np.sin(a)) for a in angle]
sides = ["bar"] * 24 + ["", "top", "", "", ""]
clay = mpm.polygon(grid, [*arc, (0, 2.5), (2.5, 2.5), (2.5, -2.5), (0, -2.5)], sides, size=0.1)
soil = mpm.DruckerPrager(bulk=5e6, shear=1e5, friction=0, dilation=0, cohesion=STRENGTH)
bar = mpm.Tool(
    mpm.Ball((0, 0), RADIUS), displacement=lambda t: (0, -0.1 * max(0, t - 1)), adhesion=STRENGTH, name="bar"
)
simulation = mpm.Simulation(
    grid,
    [clay],
    [soil],
    walls={"left": "x", "right": "x", "bottom": "y"},
    conditions=[bar, mpm.Pressure("top", lambda t: DEPTH * min(1, t))],
)
simulation.run(t_end=1, dt=1)  # the pressure keeps the gap behind the bar closed
simulation.run(t_end=2, dt=0.1)  # the bar is pushed by a tenth of its diameter
force = -2 * simulation.tool_forces["bar"][1]  # N/m
print(f"resistance: {force / (2 * RADIUS * STRENGTH):.2f} of the strength (Randolph and Houlsby: 11.94)")
mpm.plot(simulation, "displacement").figure.savefig("t_bar.png", dpi=80, bbox_inches="tight")
