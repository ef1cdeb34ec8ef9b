# SPDX-License-Identifier: MIT
"""Factor of safety of a slope by strength reduction: 10 m high, 2:1, c = 7.8 kPa and phi = 20 degrees."""

import matplotlib.pyplot as plt

import mpm_dolfinx as mpm

grid = mpm.Grid(lower=[0, -5], upper=[46, 12], cells=[46, 17])  # m
corners = [(0, -5), (46, -5), (46, 0), (32, 0), (12, 10), (0, 10)]
ground = mpm.polygon(grid, corners, "outline")
soil = mpm.MohrCoulomb(
    bulk=8e7,
    shear=4e7,
    friction=20,
    dilation=0,
    cohesion=7.8e3,
    porosity=0.4,
    grain_density=2650,
)
walls = {"left": "x", "right": "x", "bottom": "xy"}
simulation = mpm.Simulation(grid, [ground], [soil], walls=walls, gravity=(0, -9.81))
safety = mpm.factor_of_safety(simulation, rtol=0.02)
print(f"factor of safety: {safety.factor:.2f}")
for factor, overload in sorted(safety.overloads.items()):  # the overload of a stable trial falls to zero
    plt.semilogy(range(1, len(overload) + 1), overload, "o-", label=f"trial factor {factor:.3f}")
plt.gca().set(xlabel="step of the trial", ylabel="overload (-)", xticks=range(1, 6))
plt.legend()
plt.savefig("slope_stability.png", bbox_inches="tight")
