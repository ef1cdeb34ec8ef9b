# SPDX-License-Identifier: MIT
"""Push a saturated block of frictional soil beyond its limit load, and print the iterations of its linear solves.

`python tests/limit_load_3d.py 32 3` computes three steps of a block of 32^3 cells. It also runs on several processes.
"""

import sys

import numpy as np
from helpers import noting
from test_solvers import FRICTIONAL, quarter_pushed

from mpm_dolfinx.solve import monolithic

if __name__ == "__main__":
    n, steps = map(int, sys.argv[1:])
    counts: list[int] = []
    monolithic.BlockSolver.solve = noting(counts, monolithic.BlockSolver.solve)
    simulation, wall, newton = quarter_pushed(FRICTIONAL, n, 0.005), 0.0, 0
    for step in range(1, steps + 1):
        first = len(counts)
        result = simulation.run(step, 1, progress=False)
        wall, newton = wall + result.wall, newton + result.newton
        if not counts:
            sys.exit(f"{n}^3 cells: factors solve this small block, take at least 8^3 cells")
        load = -float(simulation.reactions.array[0, 2])
        if simulation.grid.comm.rank == 0:
            took = f"iterations {np.mean(counts[first:]):.1f}, at most {max(counts[first:])}"
            solves = f"linear solves {result.profile['linear solve']:.0f} s of {result.wall:.0f} s"
            print(f"{n}^3, step {step}: {took}; {solves}, {result.cuts} cuts; load {load:.5g} N", flush=True)
    if simulation.grid.comm.rank == 0:
        print(f"{n}^3, {steps} steps: {newton} Newton steps, at most {max(counts)} iterations, {wall:.0f} s")
