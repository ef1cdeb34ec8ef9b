# SPDX-License-Identifier: MIT
"""Let a rough rotating disc strike a block that slides on another block, on any number of processes."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [1.6, 1.2], [16, 12])
blocks = [mpm.box(grid, [0.1, 0], [1.5, 0.43]), mpm.box(grid, [0.33, 0.43], [1.13, 0.77])]
soil = mpm.Hencky(bulk=1e6, shear=6e5, grain_density=2000.0)
tool = mpm.Tool(mpm.Ball((0.73, 1.775), 1.0), mass=50.0, velocity=(0.4, -0.5), spin=2.0, friction=0.3)
simulation = mpm.Simulation(
    grid,
    blocks,
    [soil],
    walls={"bottom": "xy"},
    conditions=[tool, mpm.Contact(0, 1, friction=0.2)],
    gravity=(1.0, -9.81),
    inertia=mpm.Moving(lambda x: np.stack([np.where(x[:, 1] > 0.43, 0.3, 0.0), 0 * x[:, 1]], axis=1)),
)
result = simulation.run(0.05, 0.025, energies=True, progress=False)
data = simulation.points.data
if state := gathered(simulation, velocity=data["velocity"], shear=data["tool_shear"]):
    np.savez(
        sys.argv[1],
        **state,
        forces=simulation.tool_forces.array,
        tool=[simulation.tool_travel["tool"], simulation.outcome("tool_velocity")["tool"]],
        spin=[simulation.outcome(name)["tool"] for name in ("tool_rotation", "tool_spin")],
        energies=[of[-1] for of in result.energies.values()],
        balance=result.balance,
    )
