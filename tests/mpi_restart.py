# SPDX-License-Identifier: MIT
"""Checkpoints on several processes. Arguments: a checkpoint of one process, a checkpoint to write, and the state to
write.

The script resumes the first checkpoint and runs to the end. Another run writes the second checkpoint in the middle,
with output files.
"""

import sys

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


if __name__ == "__main__":
    theirs, ours, out = sys.argv[1:]
    end = to_the_end(*beam(h=0.06), theirs)
    simulation, probe = beam(h=0.06)
    writer = mpm.Writer(simulation, ours + ".out", grid=True)
    simulation.run(T_END / 2, DT, probes=probe, checkpoint=mpm.Checkpoint(ours), observe=writer, progress=False)
    counts = simulation.grid.comm.gather(len(simulation.points))
    if counts:
        np.savez(out, counts=counts, **end)
