# SPDX-License-Identifier: MIT
"""Seed bodies from meshes on several processes: files, distributed meshes, refused meshes, warnings, a full disk."""

import sys
import tempfile
import warnings
from pathlib import Path

from mpi4py import MPI

import dolfinx.mesh
import meshio
import numpy as np
from meshes import box_mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.parallel import machine_files

grid = mpm.Grid([0, 0], [1.2, 1.2], [12, 12])
comm, folder = grid.comm, Path(sys.argv[1])
folder.mkdir(exist_ok=True)
tempfile.tempdir = str(folder)


def same(words, make):
    """Check that all processes raise the same error with these words."""
    try:
        make()
        message = "accepted"
    except (ValueError, OSError, Warning) as error:
        message = str(error)
    said = comm.allgather(message)
    assert words in message and len(set(said)) == 1, said


def rows(body):
    """Return the domains and their surface faces, ordered by centres."""
    order = np.lexsort(body.centre.round(9).T)
    return body.vertices[order].mean(axis=1), body.surface[order].sum(axis=(1, 2))


ends = [np.zeros(2), np.ones(2)]
quads = box_mesh("quad", (8, 8), *ends)
if comm.rank == 0:
    quads.write(folder / "quads.vtu")
comm.barrier()
bodies = [mpm.from_mesh(grid, of) for of in (folder / "quads.vtu", quads)]
for of in (MPI.COMM_WORLD, MPI.COMM_SELF):
    mesh = dolfinx.mesh.create_rectangle(of, ends, [8, 8], dolfinx.mesh.CellType.quadrilateral)
    bodies.append(mpm.from_mesh(grid, mesh))
for body in bodies:
    for found, expected in zip(rows(body), rows(bodies[0]), strict=True):
        assert np.allclose(found, expected, rtol=0, atol=1e-14)
    assert len(body) == 256 and np.ptp(comm.allgather(float(body.vertices.sum()))) == 0
    assert not body.vertices.flags.writeable and not body.nodes(slice(None)).flags.writeable
comm.barrier()
assert [file.name for file in folder.iterdir()] == ["quads.vtu"], "files without a name"

same("coordinates", lambda: mpm.from_mesh(grid, meshio.Mesh(np.full((4, 2), np.nan), [("quad", [[0, 1, 2, 3]])])))
same("missing.msh", lambda: mpm.from_mesh(grid, folder / "missing.msh"))
with warnings.catch_warnings():
    warnings.simplefilter("error")
    same("coarser mesh", lambda: mpm.from_mesh(grid, box_mesh("quad", (120, 120), *ends)))


def full(**options):
    """Return a file that behaves as on a full disk."""

    def write(rows):
        raise OSError("the disk is full")

    file = tempfile.NamedTemporaryFile(**options)
    file.writelines = write
    return file


machine_files.NamedTemporaryFile = full
same("the disk is full", lambda: mpm.from_mesh(grid, quads))
