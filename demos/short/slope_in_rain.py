# SPDX-License-Identifier: MIT
"""Rain infiltrates a slope, so suction and factor of safety decrease."""

import mpm_dolfinx as mpm

HOUR = 3600.0  # s
grid = mpm.Grid(lower=[0, 0], upper=[20, 8.8], cells=[25, 11])  # m
bank = mpm.polygon(
    grid, [(0, 0), (20, 0), (20, 3), (14, 3), (6, 8), (0, 8)], ["base", "", "foot", "slope", "crest", ""]
)
silt = mpm.MohrCoulomb(
    bulk=1e7,
    shear=5e6,
    friction=30,
    dilation=0,
    cohesion=4e3,
    porosity=0.4,
    grain_density=2700,
    conductivity=5e-6,
    retention=mpm.VanGenuchten(entry=1e4, n=2.0),
)
rain = [mpm.Rain(side, 4e-6) for side in ("slope", "crest", "foot")]  # m/s, per area of each side
simulation = mpm.Simulation(
    grid,
    [bank],
    [silt],
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "bottom": "xy"},
    conditions=rain,
    gravity=(0, -9.81),
    pressure=mpm.hydrostatic(2.5),
    initial_stress=mpm.K0(0.5),
)
before = mpm.factor_of_safety(simulation, rtol=0.02).factor
simulation.run(t_end=24 * HOUR, dt=4 * HOUR)
after = mpm.factor_of_safety(simulation, rtol=0.02).factor  # at the present pore pressures
print(f"factor of safety: {after:.2f} after a day of rain, {before:.2f} before")
mpm.plot(simulation, "saturation").figure.savefig("slope_in_rain.png", bbox_inches="tight")
