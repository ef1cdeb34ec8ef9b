# SPDX-License-Identifier: MIT
"""Run the coarse beam with checkpoints and files, or resume it from its checkpoint. The argument is a folder."""

import sys
from pathlib import Path

from helpers import beam

import mpm_dolfinx as mpm

T_END, DT = 0.4, 0.02


def run(folder):
    """Run the beam in a folder, or resume it."""
    simulation, probe = beam(h=0.06)
    file = folder / "run.ckpt"
    after = mpm.resume(simulation, file) if file.exists() else None
    writer, checkpoint = mpm.Writer(simulation, folder / "out", every=3, grid=True), mpm.Checkpoint(file, every=2)
    simulation.run(T_END, DT, probes=probe, observe=writer, checkpoint=checkpoint, after=after, progress=False)
    return simulation


if __name__ == "__main__":
    run(Path(sys.argv[1]))
