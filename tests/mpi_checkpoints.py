# SPDX-License-Identifier: MIT
"""Checkpoints of scenes. Arguments: a folder, whether a checkpoint is written in the middle of a run, "write" or
"read", and scenes.

Every checkpoint in the folder is resumed, and the state is saved again, with equal bits for any number of processes.
Then altered checkpoints, a full disk of one process and a missing file are refused on all processes.
"""

import resource
import sys
from pathlib import Path

import mpi_following
import mpi_moving
import mpi_renewal
import numpy as np
import test_far_fluid
from test_altered_checkpoints import ALTERED, PIECES

import mpm_dolfinx as mpm
from mpm_dolfinx.io.checkpoint import save
from mpm_dolfinx.stepping import renewal

renewal.LONGEST = 0.6  # cells: soon


def rained():
    """Return two unsaturated soils in rain, with K0."""
    grid = mpm.Grid([0.3, 0], [1.7, 1.2], [5, 4])
    laws = mpm.VanGenuchten(3e3, residual=0.1, n=2.5), mpm.BrooksCorey(5e3, index=1.5)
    soils = [mpm.Hencky(1e7, 5e6, conductivity=1e-5, retention=law) for law in laws]
    bodies = [mpm.box(grid, [x, 0], [x + 0.7, 1.03], material=i) for i, x in enumerate((0.3, 1.0))]
    acting = {"conditions": [mpm.Rain("top", 5e-5), mpm.Drained("bottom", 2e3)], "fluid": mpm.Fluid()}
    options = {"gravity": (0, -9.81), "pressure": -5e3, "initial_stress": mpm.K0(0.5)}
    return mpm.Simulation(grid, bodies, soils, walls={"left": "x", "right": "x", "bottom": "y"}, **acting, **options)


def few():
    """Return a block of two cells in 3D, so that some processes have no points."""
    grid = mpm.Grid([0, 0, 0], [1, 1, 3], [1, 1, 3])
    soil, top = mpm.Hencky(bulk=1e8, shear=6e7, conductivity=1e-4), mpm.Drained("top")
    walls = {"left": "x", "right": "x", "front": "y", "back": "y", "bottom": "xyz"}
    acting = {"conditions": [mpm.Traction("top", -1e4), top], "fluid": mpm.Fluid()}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0, 0], [1, 1, 1.6])], [soil], walls=walls, **acting)


SCENES = {
    "dug": (mpi_moving.dug, 0.25, 0.125),  # groups in contact, inertia, a stage without one of the bodies
    "carried": (mpi_moving.carried, 0.25, 0.125),
    "renewed": (lambda: mpi_renewal.pushed(wet=True), 0.04, 0.01),
    "following": (mpi_following.pushed, 0.05, 0.025),
    "sinking": (lambda: mpi_following.pushed(load=lambda t: 2e3 * t), 0.05, 0.025),
    "rained": (rained, 600.0, 300.0),
    "few": (few, 2.0, 1.0),
    "parts": (lambda: test_far_fluid.scene("moving", 5.4)[0], 0.2, 0.1),  # one keeps its pieces
}


def contents(file):
    """Return the arrays of a checkpoint."""
    arrays = dict(np.load(file))
    arrays.pop("note")
    return arrays


def refused(simulation, action, kind, words):
    """Assert that all processes raise the same error, in one line, and that the state does not change."""
    before = simulation.state
    try:
        action()
        message = "accepted"
    except kind as error:
        message = str(error)
    assert all(word in message for word in (*words, "")) and "\n" not in message, message
    assert len(set(simulation.grid.comm.allgather(message))) == 1 and simulation.state is before, message


def check(simulation, file):
    """Check that incomplete checkpoints are refused, and that a full disk leaves no checkpoint."""
    comm = simulation.grid.comm
    kept, part = file.read_bytes(), file.with_name("altered")
    comm.barrier()
    for alter in {**ALTERED, **PIECES}.values():
        if not comm.rank:
            arrays = dict(np.load(file))
            alter(arrays)
            with open(part, "wb") as f:
                np.savez(f, **arrays)
        comm.barrier()
        refused(simulation, lambda: mpm.resume(simulation, part), ValueError, [str(part), "must be a whole"])
    for share in range(1, 8):
        if not comm.rank:
            cut, turned = kept[: len(kept) * share // 8], bytearray(kept)
            turned[len(kept) * share // 8] ^= 1
            part.write_bytes(cut if share % 2 else turned)
        comm.barrier()
        refused(simulation, lambda: mpm.resume(simulation, part), ValueError, [str(part), "must be a whole"])
    refused(simulation, lambda: mpm.resume(simulation, file.with_name("none")), OSError, ["resume", "No such file"])
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    if comm.rank == comm.size - 1:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
    refused(simulation, lambda: save(simulation, file), OSError, ["free space"])
    resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert file.read_bytes() == kept


if __name__ == "__main__":
    folder, writes = Path(sys.argv[1]), sys.argv[2] == "write"
    for name in sys.argv[3:] or SCENES:
        make, end, dt = SCENES[name]
        simulation = make()
        comm = simulation.grid.comm
        own = folder / f"{name}-{comm.size}"
        if writes:
            simulation.run(simulation.t + end / 2, dt / 2, progress=False, checkpoint=mpm.Checkpoint(own, every=2))
        comm.barrier()
        files = sorted(folder.glob(f"{name}-?"))
        assert files
        for file in files:
            again = make()
            result = mpm.resume(again, file)
            assert again.t == result.t[-1] > 0
            save(again, folder / "again")
            one, other = map(contents, (file, folder / "again"))
            assert one.keys() == other.keys()
            for key, values in one.items():
                assert values.tobytes() == other[key].tobytes(), (file, key)
        if name == "carried":
            check(again, file)
        if not comm.rank:
            print(name, [file.name for file in files], [key for key in one if key.count("/") == 1])
