# SPDX-License-Identifier: MIT
"""Let rain fall on sand next to loam, while both soils move, and write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [2.4, 1.2], [16, 8])
soils = [
    mpm.Hencky(1e7, 5e6, conductivity=k, retention=law)
    for k, law in ((1e-5, mpm.VanGenuchten(3e3, residual=0.1, n=2.5)), (1e-6, mpm.BrooksCorey(5e3, index=1.5)))
]
edges = (0.3, 0.97, 1.6)
bodies = [mpm.box(grid, [edges[i], 0], [edges[i + 1], 1.03], material=i) for i in range(2)]
simulation = mpm.Simulation(
    grid,
    bodies,
    soils,
    fluid=mpm.Fluid(),
    walls={"bottom": "y"},
    conditions=[
        mpm.Rain("top", 5e-5, ponding=50.0, name="rain"),
        mpm.Drained("bottom", 2e3),
        *[mpm.Displacement(side, lambda t: (2e-4 * t, 0), "x") for side in ("left", "right")],
    ],
    gravity=(0, -9.81),
    pressure=-5e3,
    initial_stress=mpm.K0(0.5),
    numerics=mpm.Numerics(tolerance=1e-10),
)
result = simulation.run(1800.0, 300.0, progress=False)
points, cells = simulation.points, simulation.cells()
volumes = [simulation.outcome(name).array for name in ("flowed", "ponded", "ran_off")]
water = grid.comm.allreduce(cells.water.sum())
if state := gathered(simulation, p=points.pressure, u=points.displacement):
    assert volumes[2].sum() > 0, "nothing runs off"
    np.savez(sys.argv[1], **state, volumes=np.concatenate(volumes), water=water, balance=result.balance)
