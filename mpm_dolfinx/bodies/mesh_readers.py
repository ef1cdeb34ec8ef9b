# SPDX-License-Identifier: MIT
"""Reader of mesh files with meshio.  Known errors of meshio are corrected, or raise ValueError."""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import TemporaryDirectory

import meshio
import numpy as np

from mpm_dolfinx.bodies import abaqus_files, gmsh_files


def read(file: Path) -> meshio.Mesh:
    """Return the mesh of a file."""
    if abaqus_files.is_abaqus(file):
        return abaqus_files.read(file)
    version = gmsh_files.version(file) if file.suffix.lower() == ".msh" else ""
    if version in ("4", "4.1"):
        return gmsh_files.read(file)
    if version == "4.0":
        raise ValueError("gmsh's format 4.0, must be 2.2 or 4.1; gmsh -0 -format msh41 converts the file")
    mesh = _bulk(file) if file.suffix.lower() in (".bdf", ".nas", ".fem") else meshio.read(file)
    _check_pieces(file, mesh)
    return mesh


def _bulk(file: Path) -> meshio.Mesh:
    """Return the mesh of a Nastran file.  The file may lack the header that meshio needs."""
    text = file.read_text(errors="replace")
    if re.search(r"^BEGIN\s+BULK", text, re.MULTILINE | re.IGNORECASE):
        return meshio.read(file, "nastran")
    with TemporaryDirectory() as folder:
        whole = Path(folder) / "bulk.bdf"
        whole.write_text("BEGIN BULK\n" + text + ("" if re.search("^ENDDATA", text, re.MULTILINE) else "\nENDDATA\n"))
        return meshio.read(whole, "nastran")


def _check_pieces(file: Path, mesh: meshio.Mesh) -> None:
    """Raise an error for a VTK file with several pieces if meshio reads only the last one."""
    if file.suffix.lower() != ".vtu":
        return
    counts = re.findall(rb"<Piece\b[^>]*NumberOfCells\s*=\s*[\"'](\d+)", file.read_bytes())
    read, whole = sum(len(block.data) for block in mesh.cells), sum(map(int, counts))
    if len(counts) > 1 and read != whole:
        why = f"because meshio reads only the last piece, of {read} cells"
        raise ValueError(f"{len(counts)} pieces with {whole} cells in total, must be one piece, {why}")


def check_systems(mesh: meshio.Mesh) -> None:
    """Raise an error for Nastran nodes in local coordinate systems, because meshio ignores these systems."""
    systems = np.asarray(mesh.point_data.get("nastran:ref", 0))
    if systems.any():
        raise ValueError(f"mesh: GRID is in the coordinate system {systems[systems != 0][0]}, must be in the basic one")


def sets_of(mesh: meshio.Mesh) -> dict[str, list]:
    """Return the cell indices of sets, counted from 0 in each block."""
    flac = {name: rows for name, rows in mesh.cell_sets.items() if re.match("(zone|face):", name)}
    count = [len(block.data) for block in mesh.cells]
    start = np.cumsum([0, *count[:-1]])
    pairs = [(np.asarray(r), k) for rows in flac.values() for k, r in enumerate(rows)]
    if not all((r >= start[k]).all() and (r < start[k] + count[k]).all() for r, k in pairs):
        return dict(mesh.cell_sets)
    within = {name: [np.asarray(r) - s for r, s in zip(rows, start, strict=True)] for name, rows in flac.items()}
    return {**mesh.cell_sets, **within}
