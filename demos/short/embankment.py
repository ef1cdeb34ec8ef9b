# SPDX-License-Identifier: MIT
"""Settlement under the middle of an embankment on soft clay, which consolidates after the construction."""

import mpm_dolfinx as mpm

YEAR = 3.156e7  # s
grid = mpm.Grid(lower=[0, -3], upper=[20, 3], cells=[40, 12])  # m: half of the ground, by symmetry
clay = mpm.box(grid, [0, -3], [20, 0])
bank = mpm.polygon(grid, [(0, 0), (12, 0), (8, 2), (0, 2)], ["base", "slope", "crest", "axis"], material=1, size=0.3)
soils = [
    mpm.Hencky(bulk=1.5e6, shear=7e5, porosity=0.6, grain_density=2650, conductivity=1e-9),
    mpm.Hencky(bulk=1e7, shear=5e6, porosity=0.3, grain_density=2650, conductivity=1e-5),
]
simulation = mpm.Simulation(
    grid,
    [clay, mpm.Later(bank)],
    soils,
    fluid=mpm.Fluid(),
    walls={"left": "x", "right": "x", "bottom": "xy"},
    conditions=[mpm.Drained("top")],
    gravity=(0, -9.81),
    pressure=mpm.hydrostatic(0),
    initial_stress=mpm.K0(0.6),
)
simulation.run(t_end=1, dt=1)  # the clay at rest
seepage = [mpm.Drained(side, seepage=True) for side in ("slope", "crest")]  # water may leave here, but not enter
simulation.stage(add=[1], conditions=[*simulation.conditions, *seepage])
middle = mpm.probes([clay, bank], [[0, 0]])
result = simulation.run(t_end=5 * YEAR, rtol=1e-2, t_eval=[0.1 * YEAR, YEAR], probes=middle)
print(f"settlement after five years: {-result.displacement[-1, 0, 1]:.3f} m")
mpm.plot(simulation, "displacement_y").figure.savefig("embankment.png", bbox_inches="tight")
