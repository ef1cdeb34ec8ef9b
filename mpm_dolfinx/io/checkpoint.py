# SPDX-License-Identifier: MIT
"""Checkpoints: a run that was broken off goes on where it was, on any number of processes.

A checkpoint is numpy's archive of the state between two steps: the points, the pressures of their pieces,
the time, the histories, and a description of the scene by which a file of another one is refused.
"""

from __future__ import annotations

import json
import os
import time
import zlib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.validation import line, numbers, on_disk, path, whole
from mpm_dolfinx.parallel.exchange import at_root, to_root
from mpm_dolfinx.io.writer import WRITABLE, replacing
from mpm_dolfinx.points.bodies import MaterialPoints
from mpm_dolfinx.points.pressure_transport import Carried
from mpm_dolfinx.timeloop import Result, log

if TYPE_CHECKING:
    from mpm_dolfinx.simulation import Simulation

FORMAT, VERSION = "mpm_dolfinx checkpoint", 2
LISTS = ("t", "displacement", "pressure")  # of Result
FOREIGN = "no checkpoint of mpm_dolfinx, must be one"
ZIP = b"PK\3\4"  # how numpy's archives begin


@dataclass
class Checkpoint:
    """Saves a run now and then, and at its end: the `checkpoint` of `Simulation.run`.

    Parameters
    ----------
    file
        The file, for `resume`; it is replaced by a whole one or not at all.
    every
        Output intervals between two checkpoints, >= 1.
    seconds
        Least wall time between two checkpoints, s, >= 0.

    Raises
    ------
    ValueError
        An argument that is none of these.
    OSError
        From the run, when the file cannot be written; the one before stays whole.
    """

    file: str | os.PathLike
    every: int = 1
    seconds: float = 0.0
    _last: float = field(default_factory=time.monotonic, init=False, repr=False)

    def __post_init__(self):
        if path("checkpoint: file", self.file).is_dir():
            raise ValueError(f"checkpoint: file = {line(self.file)}: is a folder, must be a file")
        whole("checkpoint: every", self.every)
        numbers("checkpoint: seconds", self.seconds, test=lambda v: v >= 0, allowed=">= 0")

    def __call__(self, simulation: Simulation) -> None:
        """Save the state if it is time."""
        result, comm = simulation.result, simulation.grid.comm
        due = (len(result.t) - 1) % self.every == 0
        if due and self.seconds > 0:
            due = comm.bcast(time.monotonic() - self._last >= self.seconds)
        if due or result.converged:
            save(simulation, Path(self.file))
            self._last = time.monotonic()


def save(simulation: Simulation, file: Path) -> None:
    """Write the state of a simulation between two steps of a run, and go on as after `resume`."""
    comm, began = simulation.grid.comm, time.perf_counter()
    points, carried, result = simulation.points, simulation.carried, vars(simulation.result)
    state = {"points": vars(points.migrated(to_root(comm, len(points))))}
    if carried is not None:
        state["carried"] = vars(carried.migrated(to_root(comm, len(carried.id))))
    state["result"] = {name: np.array(result[name]) for name in LISTS}
    note = {"version": VERSION, "t": simulation.t, "scene": describe(simulation)}
    note["result"] = {name: value for name, value in result.items() if name not in LISTS}

    def write() -> int:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as part, open(part, "wb") as f:
            np.savez(f, format=np.array(FORMAT), note=np.array(json.dumps(note)), **_named("", state))
        return file.stat().st_size

    with on_disk(f"{file}: checkpoint at t = {simulation.t:g} s", WRITABLE):
        size = at_root(comm, write)
    simulation.coupler.forget()
    seconds = time.perf_counter() - began
    log(comm, "t = %g s: checkpoint %s written: %.3g MB, %.2g s", simulation.t, file, size / 1e6, seconds)


def resume(simulation: Simulation, file: str | os.PathLike) -> Result:
    """Put a simulation into the state of a checkpoint; return its histories, for `run` to go on with (`after`).

    Parameters
    ----------
    simulation
        The scene of the checkpoint, on any number of processes, in the stage of the checkpoint: call its `stage`
        with what came and went first.  Grid, bodies, materials and fluid are compared with the file; loads,
        boundary conditions, terms and sources may differ.  What observers have gathered for themselves is not in
        the file.
    file
        The checkpoint.

    Raises
    ------
    ValueError
        The file is not a whole checkpoint, or one of another scene: says what differs.
    OSError
        The file is not there (FileNotFoundError) or cannot be read.
    """
    file = path("checkpoint: file", file)
    if not hasattr(simulation, "restore"):  # its class is defined later than this
        raise ValueError(f"resume: simulation = {line(simulation)}, must be a Simulation")
    comm, arrays = simulation.grid.comm, {}

    def read() -> tuple[dict, dict, dict]:
        with on_disk("resume", "a checkpoint that can be read"):
            note = _read(file, arrays)
        _check_scene(file, note["scene"], describe(simulation))
        lists = _part(arrays, "result/")
        return note, lists, {name: (values.dtype, values.shape[1:]) for name, values in arrays.items()}

    note, lists, kinds = at_root(comm, read)
    if comm.rank > 0:  # rank 0 has all rows, and passes them on
        arrays = {name: np.empty((0, *shape), dtype=dtype) for name, (dtype, shape) in kinds.items()}
    data, points = _part(arrays, "points/data/"), _part(arrays, "points/")
    carried = _part(arrays, "carried/")
    simulation.restore(MaterialPoints(**points, data=data), Carried(**carried) if carried else None, note["t"])
    result = Result(t=lists["t"].tolist(), displacement=list(lists["displacement"]), **note["result"])
    result.pressure = [tuple(row) for row in lists["pressure"].tolist()]
    log(comm, "t = %g s: resumed from %s after %d steps", simulation.t, file, result.steps)
    return result


def _named(prefix: str, values: dict) -> dict[str, NDArray]:
    """Return arrays in dictionaries of dictionaries by names with slashes."""
    out = {}
    for name, value in values.items():
        out |= _named(f"{prefix}{name}/", value) if isinstance(value, dict) else {prefix + name: value}
    return out


def _part(arrays: dict[str, NDArray], prefix: str) -> dict[str, NDArray]:
    """Take out the arrays whose names begin with a prefix."""
    return {name.removeprefix(prefix): arrays.pop(name) for name in list(arrays) if name.startswith(prefix)}


def _read(file: Path, arrays: dict[str, NDArray]) -> dict:
    """Read the arrays of a checkpoint into `arrays`; return its note."""
    with open(file, "rb") as f:
        begin = f.read(4)
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays.update({name: archive[name] for name in archive.files})
    except Exception as error:  # numpy and zipfile have many for bytes that are not what they expect
        what = "is cut short or damaged, must be a whole checkpoint" if begin == ZIP else FOREIGN
        raise ValueError(f"{file}: {what}") from error
    if str(arrays.pop("format", None)) != FORMAT or "note" not in arrays:
        raise ValueError(f"{file}: {FOREIGN}")
    note = json.loads(str(arrays.pop("note")))
    if note.get("version") != VERSION:
        raise ValueError(f"{file}: checkpoint of version {note.get('version')}, must be {VERSION} for this mpm_dolfinx")
    return note


def describe(simulation: Simulation) -> dict[str, Any]:
    """Return the constants that make the scene, by name, as a checkpoint holds them."""
    grid = simulation.grid
    scene = {"grid cells": grid.shape.tolist(), "grid lower": grid.lower.tolist(), "grid upper": grid.upper.tolist()}
    scene["quadrature"] = simulation.quadrature
    scene["bodies present"] = list(simulation.present)
    for i, body in enumerate(simulation.bodies):
        scene[f"points of body {i}"] = len(body)
        scene[f"material of body {i}"] = int(body.material)
        scene[f"volume of body {i}"] = float(np.broadcast_to(body.spacing, body.lower.shape).prod(axis=1).sum())
        scene[f"checksum of the positions of body {i}"] = zlib.crc32(np.ascontiguousarray(body.centre).tobytes())
    for name, one in [(f"material {i}", m) for i, m in enumerate(simulation.materials)] + [("fluid", simulation.fluid)]:
        scene[name] = None if one is None else type(one).__name__
        constants = {f.name: getattr(one, f.name) for f in fields(one)} if one is not None else {}
        constants = {key: value for key, value in constants.items() if value is not None and not callable(value)}
        scene |= {f"{key} of {name}": np.asarray(value).tolist() for key, value in constants.items()}
    scene["data of the points"] = sorted(simulation.points.data)
    return scene


def _check_scene(file: Path, there: dict[str, Any], here: dict[str, Any]) -> None:
    """Refuse the checkpoint of another scene."""
    for name in {**there, **here}:
        if there.get(name) != here.get(name):
            both = f"{there.get(name)} there, {here.get(name)} here, must agree"
            raise ValueError(f"{file}: checkpoint of another scene: {name}: {both}")
