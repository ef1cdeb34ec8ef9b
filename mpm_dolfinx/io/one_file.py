# SPDX-License-Identifier: MIT
"""Material points at all output times of a run, in one XDMF file for ParaView."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING
from xml.etree.ElementTree import SubElement

from mpi4py import MPI

import numpy as np

from mpm_dolfinx.base.validation import line_of, path
from mpm_dolfinx.io.units import FIELDS
from mpm_dolfinx.io.writer import Series

if TYPE_CHECKING:  # meshio takes long to import, so functions import it
    import meshio


def one_file(folder: str | os.PathLike) -> Path:
    """Join the point files of a `Writer` in one time series: `points.xdmf` and `points.h5`.

    ParaView, VTK and meshio (xdmf.TimeSeriesReader) read these files.  dolfinx reads the particle domains at one output
    time as a mesh: `XDMFFile.read_mesh(name="2", xpath="/Xdmf/Domain/Grid")` reads the third output time.  The elements
    `<Information>` in points.xdmf describe the fields and their units.  The files of the `Writer` remain.  During a
    run, the function joins all files written so far.

    Parameters
    ----------
    folder
        Folder of the `Writer`.  Both files appear in this folder when they are complete.

    Returns
    -------
    Path
        Path of points.xdmf.

    Raises
    ------
    ValueError
        The folder contains no points of a `Writer`, or no h5py that is compatible with dolfinx is installed.
    OSError
        The folder is not writable, or the disk is full.
    """
    import meshio

    folder = path("one_file: folder", folder)
    if not (folder / "points.pvd").exists():
        raise ValueError(f"one_file: folder = {folder}: has no points.pvd, must be the folder of a Writer")
    try:
        import h5py
    except Exception as error:  # PyPI's h5py brings a second HDF5, which conflicts with dolfinx's in many ways
        which = "Debian's (apt install python3-h5py) or, with conda's dolfinx, conda-forge's"
        raise ValueError(f"one_file: h5py: {line_of(error)}; must be {which}") from error
    entries = Series(MPI.COMM_SELF, folder / "points.pvd", np.inf).entries
    with TemporaryDirectory(dir=folder) as part:  # the old files remain until the new files are complete
        writer = meshio.xdmf.TimeSeriesWriter(Path(part) / "points.xdmf")
        writer.h5_filename = "points.h5"  # meshio's default is in the working directory
        with h5py.File(Path(part) / "points.h5", "w") as writer.h5_file:
            for name, meaning in FIELDS["points.pvd: the domains of the material points"].items():
                SubElement(writer.domain, "Information", Name=name, Value=meaning)
            for k, (t, files) in enumerate(entries):
                _add(writer, k, t, joined([meshio.vtu.read(file) for file in files]))
            writer.__exit__()
        for suffix in (".h5", ".xdmf"):
            os.replace(Path(part) / f"points{suffix}", folder / f"points{suffix}")
    return folder / "points.xdmf"


def joined(pieces: Sequence[meshio.Mesh]) -> meshio.Mesh:
    """Return the particle domains of all processes as one mesh, ordered by id."""
    if len(pieces) == 1:
        return pieces[0]
    order = np.argsort(np.concatenate([piece.cell_data["id"][0] for piece in pieces]))
    corners = np.concatenate([piece.points[piece.cells[0].data] for piece in pieces])[order]
    names = pieces[0].cell_data
    data = {name: [np.concatenate([piece.cell_data[name][0] for piece in pieces])[order]] for name in names}
    cells = np.arange(corners[..., 0].size).reshape(corners.shape[:2])
    return type(pieces[0])(corners.reshape(-1, 3), [(pieces[0].cells[0].type, cells)], cell_data=data)


def _add(writer: meshio.xdmf.TimeSeriesWriter, number: int, t: float, mesh: meshio.Mesh) -> None:
    """Add the mesh and the fields of one output time to the time series."""
    grid = SubElement(writer.collection, "Grid", Name=str(number), GridType="Uniform")
    SubElement(grid, "Time", Value=repr(t))
    writer.points(grid, mesh.points)
    writer.cells(mesh.cells, grid)
    writer.cell_data(mesh.cell_data, grid)
