# SPDX-License-Identifier: MIT
"""Load unsaturated ground, wet it, and write the state, on any number of processes."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

grid = mpm.Grid([0, 0], [2.0, 1.5], [8, 6])
bodies = [mpm.box(grid, [0, 0], [2.0, 0.8]), mpm.box(grid, [0, 0.8], [2.0, 1.2], material=1)]
law = {"M": 1.1, "lambda_": 0.08, "kappa": 0.015, "shear": 2e6, "initial_stress": (-6e4,) * 3, "conductivity": 1e-7}
law |= {"r": 0.4, "beta": 4e-5, "reference": 3e3, "retention": mpm.VanGenuchten(2e4, n=1.8)}
simulation = mpm.Simulation(
    grid,
    bodies,
    [mpm.BarcelonaBasic(**law), mpm.BarcelonaBasic(**law, OCR=1.4)],
    fluid=mpm.Fluid(),
    pressure=mpm.hydrostatic(-5.0),
    gravity=(0, -9.81),
    initial_stress=mpm.K0(0.7, surcharge=2e4),
    walls={"left": "x", "right": "x", "bottom": "xy"},
    conditions=[
        mpm.Pressure("top", 2e4),
        mpm.Traction("top", lambda t: (0, -3e4 * min(1, t / 1e4)), region=((0, 0), (0.9, 2))),
        mpm.Inflow("top", 4e-7),
    ],
    numerics=mpm.Numerics(tolerance=1e-10),
)
result = simulation.run(1e5, 2.5e4, progress=False)
points = simulation.points
columns = {name: points.data[name] for name in ("suction", "consolidated")}
if state := gathered(simulation, p=points.pressure, stress=simulation.effective_stress(), **columns):
    assert state["consolidated"].max() > 1e-2
    np.savez(sys.argv[1], **state, balance=result.balance)
