# SPDX-License-Identifier: MIT
"""Bodies move away from the cells of their processes: the state with and without a new distribution, and after
restarts.

Arguments: file of the results, and a checkpoint, which the first run writes and a run on fewer processes resumes.
"""

import sys
from pathlib import Path

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm
from mpm_dolfinx.grid import grid as grids

T_END, DT = 0.375, 0.125
TIGHT = mpm.Numerics(tolerance=1e-11, method="backward-euler")
CONTENT = 0.2
"""Fluid content, m^2, of the block of `carried`.  An outflow is a difference of contents, with their rounding error."""


def carried():
    """Return a wet block with friction under a disc; its bottom and the disc move."""
    grid = mpm.Grid([0, 0], [2, 1], [10, 5])
    law = mpm.DruckerPrager(2e5, 1e5, friction=25, dilation=5, cohesion=3e3, porosity=0.4, conductivity=1e-4)
    hold = mpm.Displacement("bottom", lambda t: (1.5 * t, 0.0))
    disc = mpm.Tool(mpm.Ball((0.6, 1.002), 0.3), displacement=lambda t: (1.5 * t, -0.1 * t), name="disc")
    body = mpm.box(grid, [0.1, 0.1], [1.1, 0.7])
    acting = {"conditions": [hold, disc, mpm.Drained("top")], "fluid": mpm.Fluid()}
    return mpm.Simulation(grid, [body], [law], walls={}, **acting, numerics=TIGHT)


def dug():
    """Return a block on a longer block, with inertia and friction, after an excavation at one end."""
    grid = mpm.Grid([0, 0], [2, 1], [10, 5])
    bodies = [mpm.box(grid, [x, 0], [x + 0.8, 0.2]) for x in (0.2, 1.0)] + [mpm.box(grid, [0.2, 0.2], [0.8, 0.4])]
    push = mpm.Traction("left", lambda t: (2e3 * t, 0), region=((0.15, 0.21), (0.25, 0.4)))
    acting = {"conditions": [mpm.Contact([0, 1], [2], friction=0.3), push], "inertia": True}
    acting["gravity"] = lambda t: (0, -9.81 * min(t / 0.1, 1))
    laws, walls = [mpm.Hencky(2e6, 1e6)], {"bottom": "xy"}
    simulation = mpm.Simulation(grid, bodies, laws, walls=walls, **acting, numerics=TIGHT)
    run(simulation, DT)
    simulation.stage(remove=[1])
    return simulation


def reproduce():
    """Select factors without contributions in the order of messages, which MUMPS adds."""
    options = PETSc.Options()
    options["mpm_momentum_pc_type"] = "lu"
    options["mpm_momentum_pc_factor_mat_solver_type"] = "superlu_dist"


def difference(one, other):
    """Return the largest relative difference of two states."""
    least = {n: CONTENT if n.startswith("outflows") else 1e-300 for n in one}
    return max(np.abs(one[n] - other[n]).max() / max(np.abs(other[n]).max(), least[n]) for n in one)


def equal(one, other, but=frozenset()):
    """Return whether two states have equal bits, except for some names."""
    names = one.keys() - but
    return one.keys() == other.keys() and all(np.array_equal(one[n], other[n], equal_nan=True) for n in names)


def run(simulation, t_end, **options):
    """Run to a time, and return the result."""
    return simulation.run(t_end, DT, progress=False, **options)


def state(simulation):
    """Return the state on process 0, and the results of conditions."""
    found = gathered(simulation)
    found.pop("counts", None)
    for quantity, of in simulation.state.outcome.items():
        found |= {f"{quantity} {name}": value for name, value in of.items()}
    return found


if __name__ == "__main__":
    out, file = map(Path, sys.argv[1:])
    make = {"carried": carried, "dug": dug}[out.stem.split("-")[0]]
    DT = T_END / 4 if make is carried else DT
    if MPI.COMM_WORLD.size == 2:
        reproduce()
    simulation = make()
    comm = simulation.grid.comm
    if file.exists():  # of another number of processes
        result = run(simulation, T_END, after=mpm.resume(simulation, file))
        found = state(simulation)
        if not comm.rank:
            np.savez(out, **found, imbalance=result.imbalance["points"] if comm.size > 1 else 1.0)
        sys.exit()
    before = simulation.grid
    run(simulation, T_END - DT, checkpoint=mpm.Checkpoint(file, every=100))
    assert (simulation.grid is before) == (comm.size == 1), "no process distributes anew, or one alone does"
    saved = state(simulation)
    result = run(simulation, T_END, after=simulation.result)
    whole = state(simulation)
    again = make()
    after = mpm.resume(again, file)
    read = state(again)
    run(again, T_END, after=after)
    resumed = state(again)
    grids.IMBALANCE = np.inf
    still = make()
    fixed = run(still, T_END)
    left = state(still)
    if not comm.rank:
        # stresses are computed from the state, and their last bits depend on the order of points on a process
        same = {"read": equal(saved, read, {"stress"}), "end": equal(whole, resumed)}
        off = {"resumed": difference(resumed, whole), "off": difference(whole, left)}
        print(result.imbalance, fixed.imbalance, same, off)
        ratios = [one.imbalance.get("points", 1.0) for one in (result, fixed)]
        np.savez(out, **whole, **same, **off, imbalance=ratios[0], fixed=ratios[1])
