# SPDX-License-Identifier: MIT
"""Files of a run: material points and grid for ParaView, histories as a table.

Every output time has its own files, and an index lists these files.  If a run fails, all output so far can be read.
"""

from __future__ import annotations

import csv
import errno
import fcntl
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from weakref import WeakValueDictionary, finalize
from xml.etree import ElementTree

from mpi4py import MPI

import numpy as np
from dolfinx import fem, io
from numpy.typing import NDArray

from mpm_dolfinx.base.tables import columns, components
from mpm_dolfinx.base.validation import flag, instance, line_of, on_disk, path, whole
from mpm_dolfinx.contact.tool import Tool, motion_by_forces
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.io.units import text
from mpm_dolfinx.parallel.exchange import at_root, together
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.simulation.simulation import Simulation
from mpm_dolfinx.stepping.result import OUTCOMES, Result

if TYPE_CHECKING:  # meshio takes long to import, so functions import it
    import meshio

VTK_CELLS = {2: ("quad", [0, 1, 3, 2]), 3: ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6])}
"""VTK's cell type for particle domains in 2D and in 3D, and the order of their corners in VTK."""
WRITABLE = "in a writable folder with free space; `after=simulation.result` continues the run"
COUNTS = ("steps", "newton", "coupling", "cuts", "reinitialised", "balance", "residual", "wall")


class Writer:
    """Writes points, histories and grid of a run to a folder, as an observer of `Simulation.run`.

    The folder contains these files:

    * `points.pvd`: the particle domains with displacement, pore pressure, F, J, all data of the points, stresses and
      porosity;
    * `history.csv`: one row for each output time, with counts and errors of `Result`, smallest and largest pressure,
      quantities at probes, forces of prescribed displacements and tools, and outflows;
    * `fields.txt`: meaning and unit of each field in these files;
    * `tools.pvd`, in scenes with tools: the shapes of the tools, cut along the grid lines, and the tools' forces;
    * `grid.pvd`, with `grid=True`: the fields of the cells (`Simulation.cells`), zero in empty cells.

    ParaView and VTK read all files; meshio reads the points.

    If the folder contains output of earlier times, the new run continues this output.  A run continued by `resume`
    therefore gives the same files as an uninterrupted run.  A writer locks its folder until the writer is closed.

    Parameters
    ----------
    simulation
        The scene, in the state from which the run will start.
    folder
        Folder of the files.
    every
        Number of output intervals between two files of points and grid, >= 1.  The first and last output times always
        have files.
    grid
        Whether to write `grid.pvd`.

    Raises
    ------
    ValueError
        An argument has the wrong type.  Files in the folder are not from a writer, or have other columns than this run.
        The writer is closed, or was created for another simulation or another time.
    OSError
        The folder is not writable, or the disk is full.  `run(..., after=simulation.result)` continues the run.
    """

    def __init__(self, simulation: Simulation, folder: str | os.PathLike, *, every: int = 1, grid: bool = False):
        instance("writer: simulation", simulation, Simulation)
        flag("writer: grid", grid)
        folder = path("writer: folder", folder)
        comm = simulation.grid.comm
        self._t = simulation.t
        self.every, self._simulation = whole("writer: every", every), simulation
        self.closed = False
        """Whether the writer has released the lock of its folder."""
        tools = simulation.state.stage.of(Tool)
        own = tuple(f"{quantity.removesuffix('s')}_" for quantity in (*OUTCOMES, *simulation.state.outcome))
        with on_disk("writer: folder", "writable"):
            self._lock: Lock | None = None
            at_root(comm, lambda: self._hold(folder))
            self._table = Table(comm, folder / "history.csv", self._t, own)
            self._points = Series(comm, folder / "points.pvd", self._t)
            self._grid = Series(comm, folder / "grid.pvd", self._t) if grid else None
            self._tools = Series(comm, folder / "tools.pvd", self._t) if tools else None
            at_root(comm, lambda: (folder / "fields.txt").write_text(text()))
            if not self._points.entries:
                self._write_points(simulation)

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *error) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock of the folder.  A second call has no effect.  Files are complete without this call."""
        self._lock, self.closed = None, True

    def _hold(self, folder: Path) -> None:
        self._lock = Lock.of(folder)

    def __call__(self, simulation: Simulation) -> None:
        """Write a row of the histories.  Once in `every` output intervals, also write points and grid."""
        if self.closed:
            raise ValueError(f"writer: {self._points.file.parent} is closed, must be open during a run")
        if simulation is not self._simulation:
            raise ValueError("writer: made for another simulation, must be made for the simulation of this run")
        with on_disk(f"{self._points.file.parent}: writer at t = {simulation.t:g} s", WRITABLE):
            self._write(simulation)

    def _write(self, simulation: Simulation) -> None:
        result = simulation.result
        if not self._table.columns:
            self._start(result)
        self._table.add(_row(result))
        if (len(result.rows) - 1) % self.every and not result.converged:
            return
        self._write_points(simulation)
        if self._grid is not None:
            self._write_grid(simulation)
        self._write_indices()

    def _start(self, result: Result) -> None:
        """Remove all output later than the start of the run from the indices and from the table."""
        if (start := result.rows[-2][0]) != self._t:
            what = f"writer: made at t = {self._t:g} s, but the run starts at t = {start:g} s"
            raise ValueError(f"{what}; must be made just before the run")
        self._table.start(_row(Result(result.rows[-2:-1])))
        self._write_indices()

    def _write_indices(self) -> None:
        for series in filter(None, (self._points, self._grid, self._tools)):
            series.write_index()

    def _write_points(self, simulation: Simulation) -> None:
        comm, wet = simulation.grid.comm, simulation.scene.fluid is not None
        points = simulation.points
        points = replace(points, data={**points.data, **fields_of_points(simulation)})
        files = self._points.pieces(comm.allgather(len(points)))

        def write() -> None:
            with replacing(files[comm.rank]) as part:
                mesh = solid(points, points.displacement, wet)
                mesh.write(part, file_format="vtu")

        together(comm, write if comm.rank in files else bool)
        self._points.entries.append((simulation.t, list(files.values())))
        if self._tools is not None:
            file = self._tools.next.with_suffix(".vtu")
            at_root(comm, lambda: _write_tools(simulation, file))
            self._tools.entries.append((simulation.t, [file]))

    def _write_grid(self, simulation: Simulation) -> None:
        comm, stem = simulation.grid.comm, self._grid.next
        with _true_places(simulation.grid):
            with io.VTKFile(comm, str(stem.with_suffix(".pvd")), "w") as f:  # writes its index again when it is closed
                f.write_function(_grid_fields(simulation), simulation.t)
        if comm.rank == 0:  # the index of this writer lists the files of all processes; dolfinx 0.5 repeats them
            stem.with_suffix(".pvd").unlink(missing_ok=True)
            stem.with_name(f"{stem.name}000000.pvtu").unlink(missing_ok=True)
        pieces = [stem.with_name(f"{stem.name}_p{rank}_000000.vtu") for rank in range(comm.size)]
        if not comm.allreduce(_ends(pieces[comm.rank]), op=MPI.LAND):  # dolfinx does not report a full disk
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(stem))
        self._grid.entries.append((simulation.t, pieces))


def fields_of_points(simulation: Simulation) -> dict[str, NDArray[np.float64]]:
    """Return porosity, saturation, stress components and stress invariants of the points, by name."""
    fields, wet = simulation.point_fields(), simulation.scene.fluid is not None
    drains = simulation.scene.materials.retentions is not None
    out = {name: getattr(fields, name) for name in ("porosity", "saturation")[: 1 + drains]}
    for name in ("effective_stress", "stress")[: 1 + wet]:
        of = components(getattr(fields, name), simulation.grid.dim)
        out |= {f"{name}_{each}": values for each, values in of.items()}
    return out | {name: getattr(fields, name) for name in ("mean_effective_stress", "deviatoric_stress")}


def _write_tools(simulation: Simulation, file: Path) -> None:
    """Write the shapes of all tools, cut along the grid lines, with the index and the force of each tool."""
    grid, tools = simulation.grid, simulation.state.stage.of(Tool)
    corners = [
        tool.drawn(grid, simulation.t, motion_by_forces(simulation.state.outcome, name)) for name, tool in tools.items()
    ]
    forces = np.stack([simulation.tool_forces[name][: grid.dim] for name in tools])
    number = np.repeat(np.arange(len(tools)), [len(one) for one in corners])
    with replacing(file) as part:
        _cells(np.concatenate(corners), {"tool": number, "force": forces[number]}).write(part, file_format="vtu")


class Lock:
    """An exclusive lock of a folder.  The lock ends when all writers of this process have released it."""

    _held: ClassVar[WeakValueDictionary[Path, Lock]] = WeakValueDictionary()

    def __init__(self, folder: Path):
        file = open(folder / ".lock", "w")
        finalize(self, file.close)
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            what = f"writer: folder = {folder}: another run writes into it, must be a separate folder"
            raise ValueError(what) from error

    @classmethod
    def of(cls, folder: Path) -> Lock:
        """Return the lock of a folder.  Raise ValueError if another run has locked the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        folder = folder.resolve()
        lock = cls._held.get(folder)
        if lock is None:
            lock = cls._held[folder] = cls(folder)
        return lock


def _row(result: Result) -> dict[str, float]:
    """Return the row of `history.csv` for the last output time."""
    row = result.rows[-1]
    out = {"t": row.t, **{name: getattr(result, name) for name in COUNTS}}
    return out | {name: float(value) for name, (value, _) in columns(row, row.outcome).items()}


def solid(points: MaterialPoints, displacement: NDArray[np.float64], wet: bool) -> meshio.Mesh:
    """Return the particle domains as a mesh of unconnected cells, with all fields of the points."""
    fields = {"id": points.id, "material": points.material, "displacement": displacement, "J": points.J, "F": points.F}
    if wet:
        fields["pressure"] = points.pressure
    return _cells(points.corners, {**fields, **points.data})


def _cells(corners: NDArray[np.float64], fields: dict[str, NDArray]) -> meshio.Mesh:
    """Return a mesh of unconnected cells with the given corners and fields."""
    import meshio

    kind, order = VTK_CELLS[corners.shape[2]]
    data = {label: [column] for name, rows in fields.items() for label, column in _columns(name, rows)}
    nodes = corners[:, order].reshape(-1, corners.shape[2])
    return meshio.Mesh(_padded(nodes), [(kind, np.arange(len(nodes)).reshape(-1, len(order)))], cell_data=data)


def _padded(vectors: NDArray) -> NDArray:
    """Return vectors (n, 3), as VTK requires, from vectors (n, d)."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def _columns(name: str, rows: NDArray) -> Iterator[tuple[str, NDArray]]:
    """Yield names and values of the VTK fields for a field of the points.  Tensors (2, 2) need four VTK fields."""
    if rows.shape[1:] == (2, 2):  # not padded to 3 x 3, because the out-of-plane components are unknown
        for i, j in np.ndindex(2, 2):
            yield f"{name}_{'xy'[i]}{'xy'[j]}", rows[:, i, j]
    elif rows.shape[1:] == (2,):
        yield name, _padded(rows)
    else:
        yield name, rows.reshape(len(rows), -1) if rows.ndim > 1 else rows


def _grid_fields(simulation: Simulation) -> list[fem.Function]:
    """Return the fields of the cells as named dolfinx functions."""
    scene, d = simulation.scene, simulation.grid.dim
    cells = simulation.cells()
    fields = {"fill": scene.momentum.ghost.fill.x.array[cells.cell]}
    for i in range(d):
        fields |= {f"{name}_{'xyz'[i]}": getattr(cells, name)[:, i] for name in ("displacement", "x")}
    if cells.pressure is not None:
        fields["pressure"] = cells.pressure
    pairs = list(zip(*np.triu_indices(d), strict=True)) + [(2, 2)] * simulation.grid.axisymmetric
    for i, j in pairs:
        for name in ("effective_stress", "stress")[: 1 if cells.pressure is None else 2]:
            fields[f"{name}_{'xyz'[i]}{'xyz'[j]}"] = getattr(cells, name)[:, i, j]
    out = []
    for name, rows in fields.items():  # scalars only: dolfinx 0.5 writes vectors as nodal fields
        out.append(fem.Function(simulation.grid.cellwise(), name=name))
        out[-1].x.array[cells.cell] = rows
        out[-1].x.scatter_forward()
    return out


@contextmanager
def _true_places(grid: Grid) -> Iterator[None]:
    """Context in which the mesh of a grid is at its true position, not relative to `Grid.base`."""
    x = grid.mesh.geometry.x
    own = x.copy()
    x[:, : grid.dim] += grid.base
    try:
        yield
    finally:
        x[:] = own


def _ends(file: Path) -> bool:
    """Return whether a VTK file exists and is complete."""
    if not file.exists():
        return False
    with open(file, "rb") as f:
        f.seek(-min(64, file.stat().st_size), os.SEEK_END)
        return f.read().rstrip().endswith(b"</VTKFile>")


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Context with a temporary path for a new file, which replaces `file` at the end."""
    part = file.with_name(file.name + ".part")
    yield part
    with open(part, "rb") as f:
        os.fsync(f.fileno())
    os.replace(part, file)


@contextmanager
def _ours(file: Path) -> Iterator[None]:
    """Context that turns errors in reading into a ValueError: the file was not written by a `Writer`."""
    try:
        yield
    except (ElementTree.ParseError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: no Writer's file ({line_of(error)}), must be one, or use another folder") from error


def kept(entries: Sequence[tuple[float, Any]], t: float) -> list[tuple[float, Any]]:
    """Return the entries (time, ...) up to and including the time `t`, or [] if none is before `t`."""
    out = [entry for entry in entries if entry[0] <= t]
    return out if any(entry[0] < t for entry in out) else []


class Series:
    """A time series for ParaView: an index (.pvd), and files in a folder with the same name.

    `entries`: all output times so far, with their files.
    `next`: path of the next file, without suffix.
    """

    def __init__(self, comm: MPI.Intracomm, file: Path, t: float):
        self.comm = comm
        self.file = file
        self.folder = file.with_suffix("")
        self.entries: list[tuple[float, list[Path]]] = at_root(comm, lambda: kept(self._read(), t))

    @property
    def next(self) -> Path:
        return self.folder / f"{len(self.entries):06d}"

    def pieces(self, counts: Sequence[int]) -> dict[int, Path]:
        """Return the path of the next file of each process with points, by rank."""
        names = {rank: f"{self.next.name}_p{rank}.vtu" for rank, count in enumerate(counts) if count}
        names = names if len(counts) > 1 else {0: f"{self.next.name}.vtu"}
        return {rank: self.folder / name for rank, name in names.items()}

    def _read(self) -> list[tuple[float, list[Path]]]:
        self.folder.mkdir(parents=True, exist_ok=True)
        times: dict[float, list[Path]] = {}
        if self.file.exists():
            with _ours(self.file):
                for item in ElementTree.parse(self.file).iter("DataSet"):
                    times.setdefault(float(item.get("timestep")), []).append(self.file.parent / item.get("file"))
        return list(times.items())

    def write_index(self) -> None:
        """Write the index, a list of all output times and their files."""
        root = ElementTree.Element("VTKFile", type="Collection", version="1.0")
        collection = ElementTree.SubElement(root, "Collection")
        for t, files in self.entries:
            for part, file in enumerate(files):
                where = file.relative_to(self.file.parent).as_posix()
                ElementTree.SubElement(collection, "DataSet", timestep=repr(t), part=str(part), file=where)

        def write() -> None:
            with replacing(self.file) as part:
                ElementTree.ElementTree(root).write(part)

        at_root(self.comm, write)


class Table:
    """A table in a CSV file, to which rows are added.  The first column is the time.

    Columns of conditions may change from stage to stage.  The names of these columns begin with one of the texts `own`.
    """

    def __init__(self, comm: MPI.Intracomm, file: Path, t: float, own: tuple[str, ...] = ()):
        self.comm = comm
        self.file = file
        self._own = own
        self._rows = at_root(comm, lambda: kept(self._read(), t))
        self.columns: list[str] = []
        """Names of the columns, known after `start`."""

    def _read(self) -> list[tuple[float, dict[str, str]]]:
        if not self.file.exists():
            return []
        with _ours(self.file):
            text = self.file.read_text()
            whole = text[: text.rfind("\n") + 1].splitlines()  # the last line may be incomplete
            return [(float(row["t"]), row) for row in csv.DictReader(whole)]

    def start(self, first: dict[str, float]) -> None:
        """Write all rows of earlier times, or the row `first` if the table is new."""
        rows = [row for _, row in self._rows] or [first]
        self.columns = list(rows[0])
        self._check(first)

        def write() -> None:
            with replacing(self.file) as part:
                self._append(part, rows, "w")

        at_root(self.comm, write)

    def add(self, row: dict[str, float]) -> None:
        """Add a row to the file.  If the row has new columns, these contain nan in all older rows."""
        self._check(row)
        new = [name for name in row if name not in self.columns]
        self.columns.extend(new)

        def write() -> None:
            if not new:
                return self._append(self.file, [row], "a")
            rows = [values for _, values in self._read()]
            with replacing(self.file) as part:
                self._append(part, [*rows, row], "w")

        at_root(self.comm, write)

    def _check(self, row: dict[str, float]) -> None:
        row_names, known = ([name for name in names if not name.startswith(self._own)] for names in (row, self.columns))
        if row_names != known:
            both = f"{', '.join(known)}, the columns of the run are {', '.join(row_names)}"
            raise ValueError(f"{self.file}: its columns are {both}; must be equal, or use another folder")

    def _append(self, file: Path, rows: Sequence[dict], mode: str) -> None:
        with open(file, mode, newline="") as f:
            writer = csv.DictWriter(f, self.columns, restval="nan", lineterminator="\n")
            if mode == "w":
                writer.writeheader()
            writer.writerows(rows)
