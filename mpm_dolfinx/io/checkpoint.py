# SPDX-License-Identifier: MIT
"""Checkpoints: files from which an interrupted run is resumed, on any number of processes.

A checkpoint is a numpy archive with the state between two steps (`State`) and a description of the scene.  The points
are in the order of their ids.  Each process writes and reads an equal number of points.
"""

from __future__ import annotations

import json
import os
import time
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.histories import COLUMNS, Rows
from mpm_dolfinx.base.validation import instance, line, numbers, on_disk, path, whole
from mpm_dolfinx.conditions.acting import IMPULSES, MOTIONS, VOLUMES, Outcome
from mpm_dolfinx.domains.pressure_transport import PiecePressures
from mpm_dolfinx.domains.renewed_faces import PARENT, ROOT, with_faces, with_parts
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.io.writer import WRITABLE
from mpm_dolfinx.parallel.exchange import Exchange, at_root, evenly, together
from mpm_dolfinx.parallel.messages import log
from mpm_dolfinx.parallel.shared_archives import Member, members, read, some_rows, write
from mpm_dolfinx.points.material_points import MaterialPoints, body_of
from mpm_dolfinx.simulation.simulation import Simulation
from mpm_dolfinx.stepping.distribution import distribute_by
from mpm_dolfinx.stepping.result import Result
from mpm_dolfinx.stepping.state import NODAL, State, Stay, StepControl, Trend

FORMAT, VERSION = "mpm_dolfinx checkpoint", 17  # Source: the format of the files
FOREIGN = "not a checkpoint of mpm_dolfinx, must be one"
ZIP = b"PK\3\4"  # first bytes of a numpy archive
POINTS, PIECES = "points/id", "pieces/id"
# first part of the names of arrays that are stored by rows -> name of the array with their row numbers
NUMBERED = {"points/": POINTS, "stay/": POINTS, "trend/rates": POINTS, "pieces/": PIECES}
NUMBERED |= {f"{name}/": f"{name}/node" for name in NODAL}
LEAVE = ("pressure", "slope", "bounds")  # fields of pieces that are not stored if all points keep their pieces
# metadata of a checkpoint, with their types
NOTE = {"t": float, "resets": int, "begins": bool, "scene": dict, "result": dict, "control": dict, "partition": list}


@dataclass
class Checkpoint:
    """Saves the state of a run at intervals and at the end of the run.

    It is the argument `checkpoint` of `Simulation.run`.

    Parameters
    ----------
    file
        Path of the checkpoint, in a folder to which all processes have access.  When a new checkpoint is complete, it
        replaces the old one.
    every
        Number of output intervals between two checkpoints, >= 1.
    seconds
        Shortest wall time between two checkpoints, s, >= 0.

    Raises
    ------
    ValueError
        An argument is out of range.
    OSError
        The file cannot be written.  The run raises this error, and the previous checkpoint remains intact.
    """

    file: str | os.PathLike
    every: int = 1
    seconds: float = 0.0
    _written: float = field(default_factory=time.monotonic, init=False, repr=False)

    def __post_init__(self):
        if path("checkpoint: file", self.file).is_dir():
            raise ValueError(f"checkpoint: file = {line(self.file)}: is a folder, must be a file")
        whole("checkpoint: every", self.every)
        numbers("checkpoint: seconds", self.seconds, test=lambda v: v >= 0, allowed=">= 0")

    def __call__(self, simulation: Simulation) -> None:
        """Save the state if `every` and `seconds` require a checkpoint, or if the run ends."""
        result, comm = simulation.result, simulation.grid.comm
        writes = (len(result.rows) - 1) % self.every == 0
        if writes and self.seconds > 0:
            writes = comm.bcast(time.monotonic() - self._written >= self.seconds)
        if writes or result.converged:
            save(simulation, Path(self.file))
            self._written = time.monotonic()


def save(simulation: Simulation, file: Path) -> None:
    """Write the state of a simulation to a file, between two steps of a run."""
    comm = simulation.grid.comm
    start = time.perf_counter()
    state = simulation.state
    arrays = _arrays(state.migrated(evenly(comm, state.points.id), comm))
    for name in NODAL:
        arrays |= _nodal_rows(simulation, name, getattr(state, name))
    rows = {name: arrays.pop(name) for name in list(arrays) if _numbered(name)}
    note = {"version": VERSION, "t": state.t, "resets": state.resets, "begins": state.begins}
    note |= {"scene": describe(simulation), "result": _fields(state.result, but="rows"), "control": vars(state.control)}
    note["partition"] = simulation.grid.partition.boxes.tolist()
    arrays = {"format": np.array(FORMAT), "note": np.array(json.dumps(note)), **arrays}
    with on_disk(f"{file}: checkpoint at t = {state.t:g} s", WRITABLE):
        size = write(comm, file, arrays, rows)
    seconds = time.perf_counter() - start
    log(comm, "t = %g s: checkpoint %s written: %.3g MB, %.2g s", state.t, file, size / 1e6, seconds)


def resume(simulation: Simulation, file: str | os.PathLike) -> Result:
    """Restore a simulation from a checkpoint, and return the histories for `run(after=...)`.

    Parameters
    ----------
    simulation
        The scene of the checkpoint.  Grid, bodies, fluid and materials must be the same as in the checkpoint.  Loads,
        conditions, terms, sources and the number of processes may differ.  If the run had several stages, first call
        `stage` to bring the scene to the stage of the checkpoint.  A checkpoint contains no data of observers.
    file
        Path of the checkpoint.

    Raises
    ------
    ValueError
        The file is not a complete checkpoint, or belongs to another scene.  The error leaves the simulation unchanged.
    OSError
        The file does not exist (FileNotFoundError), or cannot be read.
    """
    instance("resume: simulation", simulation, Simulation)
    file, comm = path("checkpoint: file", file), simulation.grid.comm

    def index() -> tuple[dict[str, NDArray], dict[str, Member], dict[str, Any], NDArray[np.int64]]:
        arrays, rows, note = _read(file)
        _check_scene(file, note["scene"], describe(simulation))
        return arrays, rows, note, _partition(file, note["partition"], simulation.grid)

    with on_disk("resume", "a checkpoint that can be read"):
        arrays, rows, note, boxes = at_root(comm, index)
        with _complete(file):
            arrays |= read(comm, file, rows, together(comm, lambda: _ranges(comm, file, rows)))
    count = rows[POINTS].shape[0]
    state = together(comm, lambda: _state(file, arrays, note, simulation, count))
    # the file's distribution of cells gives bitwise equal results, except for sums in the order of messages
    if len(boxes) == comm.size > 1 and (boxes != simulation.grid.partition.boxes).any():
        distribute_by(simulation, boxes)
    nodal = {name: simulation.grid.from_rows(*of) for name in NODAL if (of := getattr(state, name)) is not None}
    simulation.grid.move(state.lines)
    simulation.state = replace(state, stage=simulation.state.stage, **nodal).at_owners(simulation.grid)
    log(comm, "t = %g s: resumed from %s after %d steps", state.t, file, state.result.steps)
    return simulation.result


def _fields(of: Any, but: str = "") -> dict[str, Any]:
    return {f.name: getattr(of, f.name) for f in fields(of) if f.name != but}


def _arrays(state: State) -> dict[str, NDArray]:
    """Return all arrays of a state, by their names in the file."""
    named = {"points": _fields(state.points), "outcome": state.outcome}
    named["result"] = {name: state.result.rows.column(name) for name in COLUMNS}
    for i, outcome in enumerate(state.result.rows.outcomes):
        for name, value in _named("", outcome).items():
            named["result"].setdefault(f"outcome/{name}", {"row": [], "value": []})
            for rows, one in zip(named["result"][f"outcome/{name}"].values(), (i, value), strict=True):
                rows.append(one)
    if state.pieces is not None:
        named["pieces"] = state.pieces.arrays
    if state.lines is not None:
        named["lines"] = state.lines
    if state.trend is not None:
        named["trend"] = vars(state.trend)
    if state.stay is not None:
        named["stay"] = {"points": _fields(state.stay.points)}
        if state.stay.keeps is not None:
            named["stay"]["keeps"] = state.stay.keeps
    return _named("", named)


def _state(file: Path, arrays: dict[str, NDArray], note: dict[str, Any], simulation: Simulation, count: int) -> State:
    """Return the state in a file with `count` points.  Raise ValueError if the file belongs to another simulation.

    Nodal fields of the state are pairs: node numbers and values.
    """
    now, dim = simulation.state, simulation.grid.dim
    wet = simulation.scene.fluid is not None
    with _complete(file):
        points = _points(_part(arrays, "points/"), now.points)
        _check_ids(points, simulation, count)
        stay = None
        pieces = None
        of_stay = _part(arrays, "stay/")
        if of_stay:
            in_cut = of_stay.pop("keeps", None)
            stay = Stay(_points(_part(of_stay, "points/"), now.points), in_cut)
            if in_cut is not None and (in_cut.dtype != bool or in_cut.shape != points.id.shape):
                raise ValueError(f"stay/keeps: {in_cut.dtype} of shape {in_cut.shape}, must be a bool for each point")
            if not np.array_equal(stay.points.id, points.id):
                raise ValueError("stay/points/id: points differ from the points of the bodies")
        if wet:
            own = _part(arrays, "pieces/")
            _check_pieces(own, points.id, dim)
            leaves = dict.fromkeys(LEAVE) if stay is not None and stay.keeps is None else {}
            pieces = PiecePressures(**own, **leaves)
            if (pieces.of_cell is None or pieces.start is None) != (stay is None):
                raise ValueError("pieces/of_cell, pieces/start: must both be given if stay/ is given, and only then")
        of_trend = _part(arrays, "trend/")
        trend = Trend(**of_trend) if of_trend else None
        if trend is not None:
            _check_trend(trend, points, wet)
        lines = _part(arrays, "lines/") or None
        if lines is not None:
            _check_lines(lines, simulation.grid)
        histories = _part(arrays, "result/")
        times = histories["t"]
        outcomes = _outcomes(_part(histories, "outcome/"), len(times))
        result, control = Result(Rows.of_columns(histories, outcomes), **note["result"]), StepControl(**note["control"])
        outcome = _nested(_part(arrays, "outcome/"))
        nodal = [_nodal(name, _part(arrays, f"{name}/"), simulation.grid) for name in NODAL]
        if arrays or not all(np.isfinite([note["t"], *times])):
            raise ValueError(f"has {', '.join(arrays) or 'times that are not finite'}")
        return State(
            t=note["t"],
            points=points,
            pieces=pieces,
            stay=stay,
            resets=note["resets"],
            lines=lines,
            outcome=_like(outcome, now.outcome),
            stage=None,
            begins=note["begins"],
            trend=trend,
            result=result,
            control=control,
            **dict(zip(NODAL, nodal, strict=True)),
        )


def _outcomes(arrays: dict[str, NDArray], count: int) -> list[dict[str, dict[str, NDArray]]]:
    """Return the results of conditions (reactions, outflows and others) at each of `count` output times."""
    out: list[dict[str, dict[str, NDArray]]] = [{} for _ in range(count)]
    for quantity, names in _nested(arrays).items():
        for name, found in names.items():
            for i, value in zip(found["row"], found["value"], strict=True):
                out[i].setdefault(quantity, {})[name] = value
    return out


def _like(outcome: dict[str, dict[str, NDArray]], now: Outcome) -> dict[str, dict[str, NDArray]]:
    """Return the stored results of the present conditions.  Raise ValueError if a result is invalid.

    A condition without a stored result keeps its present result.
    """
    found = {q: {name: outcome.get(q, {}).get(name, value) for name, value in of.items()} for q, of in now.items()}
    if "energy" in outcome:
        found["energy"] = outcome["energy"]
    for quantity, of in found.items():
        for name, value in of.items():
            if quantity == "energy" and (value.shape or not np.isfinite(value)):
                raise ValueError(f"outcome/{quantity}/{name} is not a finite number")
            if quantity == "energy":
                continue
            if value.shape != now[quantity][name].shape or value.dtype != np.float64:
                raise ValueError(f"outcome/{quantity}/{name}: wrong type or shape ({value.dtype}, {value.shape})")
            sums = *VOLUMES.values(), *IMPULSES.values(), "ran_off", "ponded", "tool_travel", *MOTIONS
            if quantity in sums and not np.isfinite(value).all():
                raise ValueError(f"outcome/{quantity}/{name} is not finite")
    return found


def _nested(arrays: dict[str, NDArray]) -> dict[str, Any]:
    """Return nested dictionaries: the array with the name "a/b" becomes the entry ["a"]["b"]."""
    out: dict[str, Any] = {}
    for name, value in arrays.items():
        *folders, last = name.split("/")
        at = out
        for folder in folders:
            at = at.setdefault(folder, {})
        at[last] = value
    return out


def _points(arrays: dict[str, NDArray], like: MaterialPoints) -> MaterialPoints:
    """Return material points from stored arrays.  Raise ValueError if names, types or shapes differ from `like`."""
    data = _part(arrays, "data/")
    like = with_faces(like) if PARENT in data else like
    like = with_parts(like) if ROOT in data else like
    points = MaterialPoints(**arrays, data=data)
    kinds = {**vars(like), **like.data}
    for name, rows in {**arrays, **data}.items():
        kind = kinds[name]
        if rows.dtype != kind.dtype or rows.shape != (len(points), *kind.shape[1:]) or not np.isfinite(rows).all():
            raise ValueError(f"points/{name}: wrong type or shape ({rows.dtype}, {rows.shape}), or not finite")
    if set(data) != set(like.data):
        raise ValueError(f"points/data: {', '.join(data)}, must be the names in `points.data` of the simulation")
    return points


def _check_ids(points: MaterialPoints, simulation: Simulation, count: int) -> None:
    """Raise ValueError if the points of a file with `count` points do not belong to the present bodies."""
    lengths, present = np.array([len(body) for body in simulation.bodies]), np.asarray(simulation.state.stage.present)
    starts = np.concatenate([[0], lengths.cumsum()])
    whole = count == lengths[present].sum() and (points.id < starts[-1]).all()
    replaced = PARENT in points.data or ROOT in points.data
    if (points.id < 0).any() or not present[body_of(points.id, starts)].all() or not (whole or replaced):
        raise ValueError("points/id: points differ from the points of the bodies")


def _partition(file: Path, given: list, grid: Grid) -> NDArray[np.int64]:
    """Return the box of cells of each process that wrote a file.  Raise ValueError if the boxes are invalid."""
    with _complete(file):
        boxes = np.array(given, dtype=np.int64).reshape(-1, 2, grid.dim)
        grid.check_boxes(boxes)
    return boxes


def _nodal_rows(simulation: Simulation, name: str, nodal: NDArray[np.float64] | None) -> dict[str, NDArray]:
    """Return the nodes that this process writes, and their values.  Nodes with zero values are omitted."""
    if nodal is None:
        return {}
    grid, owned = simulation.grid, simulation.scene.momentum.u.function_space.dofmap.index_map.size_local
    values, node = nodal.reshape(-1, grid.dim)[:owned], grid.node_numbers()[:owned]
    order = node.argsort()
    order = order[values[order].any(axis=1)]
    exchange = Exchange(grid.comm, evenly(grid.comm, node[order]))
    node, values = exchange.send(node[order]), exchange.send(values[order])
    order = node.argsort()
    return {f"{name}/node": node[order], f"{name}/values": values[order]}


def _check_lines(arrays: dict[str, NDArray], grid: Grid) -> None:
    """Raise ValueError if the arrays cannot be positions of this grid's lines, or if these lines cannot move."""
    shapes = {letter: x.shape for letter, x in zip("xyz", grid.lines, strict=False)}
    if grid.follow is None or {name: x.shape for name, x in arrays.items()} != shapes:
        raise ValueError("lines: these are not lines of the grid")
    for letter, low, high in zip(shapes, grid.low, grid.high, strict=True):
        x = arrays[letter]
        if x.dtype != np.float64 or not (np.diff(x) > 0).all() or x[0] != low or x[-1] != high:
            raise ValueError("lines: must ascend from one side of the grid to the opposite side")


def _nodal(name: str, arrays: dict[str, NDArray], grid: Grid) -> tuple[NDArray, NDArray] | None:
    """Return nodes and values of a stored nodal field, or None if the file does not contain the field."""
    if not arrays:
        return None
    node, values = arrays.pop("node"), arrays.pop("values")
    right = node.dtype == np.int64 and values.dtype == np.float64 and values.shape == (len(node), grid.dim)
    if arrays or not right or not np.isfinite(values).all():
        raise ValueError(f"{name}: must be finite nodal values on the grid")
    if len(node) and not 0 <= node[0] <= node[-1] < grid.copies * grid.nodes:
        raise ValueError(f"{name}: the grid has no nodes with these indices")
    return node, values


def _check_trend(trend: Trend, points: MaterialPoints, wet: bool) -> None:
    """Raise ValueError if the stored rates of the last steps do not fit the points, see `Trend`."""
    (n, d), k = points.x.shape, len(trend.lengths)
    right = k in (1, 2, 3) and trend.lengths.shape == (k,) and trend.rates.shape == (n, k, d * (1 + d) + wet)
    numbers_only = all(v.dtype == np.float64 and np.isfinite(v).all() for v in vars(trend).values())
    if not (right and numbers_only and (trend.lengths > 0).all()):
        raise ValueError("trend: does not fit the points, is not finite, or has a step of length zero")


def _check_pieces(arrays: dict[str, NDArray], ids: NDArray[np.int64], dim: int) -> None:
    """Raise ValueError if the arrays do not describe pieces of the points with these ids."""
    shapes, count = {"x": (dim,), "slope": (dim,), "bounds": (2,)}, len(arrays["id"])
    for name, rows in arrays.items():
        kind = np.int64 if name in ("id", "cell") else np.float64
        if rows.dtype != kind or rows.shape != (count, *shapes.get(name, ())) or not np.isfinite(rows).all():
            raise ValueError(f"pieces/{name}: wrong type or shape ({rows.dtype}, {rows.shape}), or not finite")
    if not np.array_equal(np.unique(arrays["id"]), ids):
        raise ValueError("pieces/id: points differ from the points of the bodies")


def _named(prefix: str, values: dict) -> dict[str, NDArray]:
    """Return one dictionary of all arrays in nested dictionaries: ["a"]["b"] gets the name `prefix` + "a/b"."""
    out = {}
    for name, value in values.items():
        out |= _named(f"{prefix}{name}/", value) if isinstance(value, Mapping) else {prefix + name: value}
    return out


def _part(arrays: dict[str, NDArray], prefix: str) -> dict[str, NDArray]:
    """Move all arrays whose names begin with a prefix to a new dictionary, and remove the prefix from their names."""
    return {name.removeprefix(prefix): arrays.pop(name) for name in list(arrays) if name.startswith(prefix)}


@contextmanager
def _complete(file: Path) -> Iterator[None]:
    """Context that replaces errors in reading by a ValueError, which reports a damaged checkpoint."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, BadZipFile) as error:
        raise ValueError(f"{file}: is cut short or damaged ({line(error)}), must be a whole checkpoint") from error


def _numbered(name: str) -> str | None:
    """Return the name of the array with the row numbers (ids) of the array `name`, or None if there is none."""
    return next((numbers for start, numbers in NUMBERED.items() if name.startswith(start)), None)


def _ranges(comm: MPI.Intracomm, file: Path, of: dict[str, Member]) -> dict[str, tuple[int, int]]:
    """Return the rows (start, stop) that this process reads, by array.  Raise ValueError if row numbers are invalid."""
    out = {}
    for name in dict.fromkeys(map(_numbered, of)):
        first, last = (of[name].shape[0] * (comm.rank + k) // comm.size for k in (0, 1))
        if name == PIECES:
            first, last = (_before(file, of, row) for row in out[POINTS])
        numbers = some_rows(file, of[name], first, min(last + 1, of[name].shape[0]))
        if (np.diff(numbers) < (name != PIECES)).any():
            raise ValueError(f"{name}: row numbers must ascend")
        out[name] = first, last
    for name, member in of.items():
        if member.shape[0] != of[_numbered(name)].shape[0]:
            raise ValueError(f"{name}: array of shape {member.shape}, must have a row for each number")
    return {name: out[_numbered(name)] for name in of}


def _before(file: Path, of: dict[str, Member], row: int) -> int:
    """Return the number of pieces that belong to the points stored before row `row`."""
    points, pieces = of[POINTS], of[PIECES]
    if row == points.shape[0]:
        return pieces.shape[0]
    ids = some_rows(file, points, row, row + 1)
    return bisect_left(range(pieces.shape[0]), ids[0], key=lambda k: some_rows(file, pieces, k, k + 1)[0])


def _read(file: Path) -> tuple[dict[str, NDArray], dict[str, Member], dict[str, Any]]:
    """Return the arrays without row numbers, the positions of all other arrays in the file, and the metadata."""
    with open(file, "rb") as f:
        begin = f.read(4)
    what = "is cut short or damaged, must be a whole checkpoint" if begin == ZIP else FOREIGN
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if not _numbered(name)}
            rows = [name for name in archive.files if _numbered(name)]
    except Exception as error:  # damaged bytes raise many types of errors in numpy and zipfile
        raise ValueError(f"{file}: {what}") from error
    if str(arrays.pop("format", None)) != FORMAT or "note" not in arrays:
        raise ValueError(f"{file}: {FOREIGN}")
    try:
        note = json.loads(str(arrays.pop("note")))
        version, kinds = note.get("version"), {name: type(note.get(name)) for name in NOTE}
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{file}: {what}") from error
    if version != VERSION:
        raise ValueError(f"{file}: checkpoint of version {version}, must be {VERSION} for this mpm_dolfinx")
    if kinds != NOTE:
        raise ValueError(f"{file}: {what}")
    with _complete(file):
        return arrays, members(file, rows), note


def describe(simulation: Simulation) -> dict[str, Any]:
    """Return the constants that identify a scene, by name."""
    kept = sorted(simulation.state.stage.kept(0))
    more = {"bodies present": list(simulation.present), "data that points keep of conditions": kept}
    return {**simulation.scene.description, **more}


def _check_scene(file: Path, stored: dict[str, Any], present: dict[str, Any]) -> None:
    """Raise ValueError if the checkpoint belongs to another scene."""
    for name in {**stored, **present}:
        if stored.get(name) != present.get(name):
            both = f"{stored.get(name)} in file, {present.get(name)} here, must be equal"
            raise ValueError(f"{file}: checkpoint of another scene: {name}: {both}")
