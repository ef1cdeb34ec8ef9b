# SPDX-License-Identifier: MIT
"""Checkpoints on several processes. Arguments: a checkpoint of one process, a checkpoint to write, and the state to
write.

The script resumes the first checkpoint and runs to the end. Another run writes the second checkpoint in the middle,
with output files; its resumed run uses as many processes.
"""

import sys

from petsc4py import PETSc

import numpy as np
from helpers import arrays_of, beam

import mpm_dolfinx as mpm
from mpm_dolfinx.parallel.exchange import to_root

T_END, DT = 0.12, 0.02


def state(simulation):
    """Return all points on process 0, and the histories."""
    points = simulation.points.migrated(to_root(simulation.grid.comm, len(simulation.points)))
    own = {name: a for name, a in arrays_of(points).items() if name not in points.data}
    return {**own, "tip": simulation.result.displacement}


def to_the_end(simulation, probe, file):
    """Return the state at the end of a run from a checkpoint."""
    simulation.run(T_END, DT, probes=probe, after=mpm.resume(simulation, file), progress=False)
    return state(simulation)


def same_bits(file):
    """Return whether run and resumed run end with equal bits, with reproducible solvers and a reproducible grid.

    MUMPS adds contributions in the order of messages, and PT-Scotch's partition is not reproducible.
    """
    options = PETSc.Options()
    for name in ("momentum", "storage"):
        options[f"mpm_{name}_pc_type"] = "lu"
        options[f"mpm_{name}_pc_factor_mat_solver_type"] = "superlu_dist"
    simulation, probe = beam(h=0.06)
    simulation.run(T_END / 2, DT, probes=probe, checkpoint=mpm.Checkpoint(file, every=100), progress=False)
    after = mpm.resume(simulation, file)
    simulation.run(T_END, DT, probes=probe, after=after, progress=False)
    one, other = state(simulation), to_the_end(simulation, probe, file)
    return all(np.array_equal(one[name], other[name]) for name in one)


if __name__ == "__main__":
    theirs, ours, out = sys.argv[1:]
    end = to_the_end(*beam(h=0.06), theirs)
    simulation, probe = beam(h=0.06)
    writer = mpm.Writer(simulation, ours + ".out", grid=True)
    simulation.run(T_END / 2, DT, probes=probe, checkpoint=mpm.Checkpoint(ours), observe=writer, progress=False)
    counts = simulation.grid.comm.gather(len(simulation.points))
    same = simulation.grid.comm.allreduce(same_bits(ours + ".same")) == simulation.grid.comm.size
    if counts:
        np.savez(out, same=same, counts=counts, **end)
