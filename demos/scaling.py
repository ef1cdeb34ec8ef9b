# SPDX-License-Identifier: MIT
"""Cost of a step: time of each part, memory, and messages, for different numbers of material points and processes.

Two saturated bodies move slowly through the grid. The first body is the beam of `poroelastic_beam.py` in 2D, with
direct solvers, in a background box six times as large. The second body is a cube of 1 m in 3D, sheared and compressed,
with multigrid. Each run is a new process, or several processes under mpirun (--processes 1 2). The time is the
processor time of the fastest step after the first. On several processes, the time is the largest time of all processes,
including waiting. Memory is the peak since the start of the process.

The exponent of a part of the step is the slope of log(time) against log(points), fitted to the larger half of the
sizes. `kB a point` is the slope of the memory against the number of points. Runs on several processes also print the
load balance and the messages of a step. The load balance (`imbalance`) is the largest number of pieces of a process,
divided by the mean number. Messages are counted on the process with the most messages. `exchange` counts the messages
of the package, and `solvers` the messages of PETSc's Krylov solvers. Messages of MUMPS and of dolfinx are not counted.

If there are runs on one process and on several, a cost model is fitted. The time T of a step (s), with n points on P
processes is

    T = e + a n / P + b H + c log2 P,

where H is the number of points along the faces that a process shares with others. The cost e is the same for any n and
P. The other terms are the work for all points, the work for points at shared faces, and the number of messages. In 2D
the model excludes the solvers, because the cost of factorisations is not proportional to n / P.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from mmap import mmap
from pathlib import Path
from types import FunctionType, ModuleType

from mpi4py import MPI
from petsc4py import PETSc

import common
import numpy as np
import poroelastic_beam as beam
from dolfinx import fem
from dolfinx.mesh import Mesh
from numpy.typing import NDArray
from scipy.optimize import nnls

import mpm_dolfinx as mpm
from mpm_dolfinx.base import _compat
from mpm_dolfinx.forms import point_forms
from mpm_dolfinx.parallel.exchange import traffic
from mpm_dolfinx.simulation.summary import peak_memory
from mpm_dolfinx.simulation.timeloop import PARTS

SIZES: dict[str, dict[int, Sequence[float]]] = {
    "quick": {2: (500, 2000), 3: (200, 1000)},
    "default": {2: (1e3, 3e3, 1e4, 3e4, 1e5), 3: (1e3, 3e3, 1e4, 3e4)},
    "largest": {2: (1e3, 3e3, 1e4, 3e4, 1e5, 3e5, 1e6), 3: (1e3, 3e3, 1e4, 3e4, 1e5, 3e5)},
}
STEPS = 3  # after the first
SOLVERS = ("factorisation", "linear solve")


# ---- one run -------------------------------------------------------------------------------------


def scene(dim: int, points: float) -> tuple[mpm.Simulation, float]:
    """Return the scene of a body with about `points` points, and its time step, in s."""
    if dim == 2:
        h = np.sqrt(4 * beam.LENGTH * beam.HEIGHT / points)
        return beam.scene(beam.arguments(["--h", str(h), "--ramp", "0.6"]))[0], 0.02
    n = max(2, round((points / 8) ** (1 / 3)))
    margin = 1.5 + n // 8  # cells: the cube leans by a tenth of its width
    grid = mpm.Grid([0] * 3, [1 + 2 * margin / n] * 3, [n + round(2 * margin)] * 3)
    lower = np.array([margin, margin, 0]) / n
    load = mpm.Traction("top", lambda t: (2e4 * t, 1e4 * t, -5e4 * t))
    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, lower, lower + 1)],
        [mpm.Hencky(bulk=4e6 / 3, shear=1e6, conductivity=1e-5)],
        fluid=mpm.Fluid(),
        walls={"bottom": "xyz"},
        conditions=[mpm.Drained("top"), load],
    )
    return simulation, 0.25


def sent() -> np.ndarray:
    """Return counts of this process: messages and bytes of exchanges; messages, bytes and reductions of solvers."""
    events = [PETSc.Log.Event(name).getPerfInfo() for name in ("KSPSolve", "PCSetUp")]
    solver = [sum(e[name] for e in events) for name in ("numMessages", "messageLength", "numReductions")]
    return np.array([traffic.messages, traffic.bytes, *solver], dtype=float)


def measure(dim: int, points: float, count: int = STEPS) -> dict:
    """Return the costs of the fastest of `count` steps after the first; all processes must call this function."""
    PETSc.Log.begin()
    began = time.perf_counter()
    simulation, dt = scene(dim, points)
    first = simulation.run(dt, dt, progress=False)
    comm, setup, before = simulation.grid.comm, time.perf_counter() - began, sent()
    steps = []
    for _ in range(count):
        start = time.process_time()
        result = simulation.run(simulation.t + dt, dt, progress=False)
        steps.append((comm.allreduce(time.process_time() - start, MPI.MAX), result))
    seconds, best = min(steps, key=lambda step: step[0])
    profile = {part: wall * seconds / best.wall for part, wall in best.profile.items()}
    on_grid, matrices = simulation.scene.last
    most = np.max(comm.allgather((sent() - before) / count), axis=0).tolist()
    counted = comm.allgather(held(simulation)[0])
    names = ("exchange_messages", "exchange_bytes", "solver_messages", "solver_bytes", "solver_reductions")
    return {
        "dim": dim,
        "processes": comm.size,
        "points": best.points,
        "active_cells": on_grid.active_cells,
        "grid_cells": int(simulation.grid.shape.prod()),
        "unknowns": matrices.momentum.unknowns.global_size + matrices.storage.unknowns.global_size,
        "newton": best.newton,
        "coupling": best.coupling,
        "cuts": first.cuts + sum(result.cuts for _, result in steps),
        "setup_s": setup,
        "step": seconds,
        **profile,
        "rest": seconds - sum(profile.values()),
        "memory_MB": best.memory,
        "most_MB": max(comm.allgather(peak_memory())),
        "counted_MB": max(sum(kinds.values()) for kinds in counted) / 2**20,
        "imbalance": best.imbalance.get("pieces", 1.0),
        **dict(zip(names, most, strict=True)),
    }


def held(root: object, buffers: bool = True) -> tuple[dict[str, int], set[int]]:
    """Return the bytes of the arrays in an object on this process, by kind of array, and the lengths of all axes.

    Shared memory counts once. Arrays in files that are mapped into memory have the kind "files"; the lengths of their
    axes are omitted.

    buffers: whether to count the buffers of integrands too.
    """
    objects, seen = [root], set()
    arrays: dict[int, NDArray] = {}
    files: dict[int, NDArray] = {}
    out = dict.fromkeys(("arrays", "files", "mesh", "matrices"), 0)
    while objects:
        one = objects.pop()
        if id(one) in seen or isinstance(one, (type, ModuleType)):
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            while isinstance(one.base, np.ndarray):
                one = one.base
            mapped = isinstance(getattr(one.base, "obj", None), mmap)
            (files if mapped else arrays)[one.__array_interface__["data"][0]] = one
        elif isinstance(one, PETSc.Mat):
            if one.handle and "aij" in one.getType():  # other matrices store no entries
                entries = int(one.getInfo(PETSc.Mat.InfoType.LOCAL)["nz_allocated"])
                out["matrices"] += entries * (8 + np.dtype(PETSc.IntType).itemsize)
        elif isinstance(one, PETSc.Vec):
            out["matrices"] += 8 * one.getLocalSize() if one.handle and one.getType() else 0
        elif isinstance(one, fem.Function):
            objects.append(one.x.array)
            objects.append(one.function_space)
        elif isinstance(one, Mesh):
            out["mesh"] += one.geometry.x.nbytes + sum(link.nbytes for link in _compat.links(one))
        elif isinstance(one, FunctionType):  # globals of a function belong to no scene
            objects += [one.__closure__, one.__defaults__]
        elif buffers or not isinstance(one, point_forms.Rows):
            objects.extend(gc.get_referents(one))
    lengths = {length for array in arrays.values() for length in array.shape}
    sums = {kind: sum(array.nbytes for array in of.values()) for kind, of in (("arrays", arrays), ("files", files))}
    return out | sums, lengths


def in_own_process(dim: int, points: float, processes: int, count: int = STEPS) -> dict:
    """Run `measure` in a new process, or in several new processes, and return its result."""
    command = [sys.executable, "-m", "mpi4py", __file__, "--one", *map(str, (dim, points, count))]
    if processes > 1:
        command = ["mpirun", "--oversubscribe", "-n", str(processes), *command]
    # Open MPI: a waiting process yields the processor, so that times do not depend on other work
    environment = {**os.environ, "OMPI_MCA_mpi_yield_when_idle": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{dim}D, {points:g} points, {processes} processes: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


# ---- many runs -----------------------------------------------------------------------------------


def exponents(rows: list[dict]) -> dict[str, float]:
    """Return the exponent of each part of a step, the initial memory (MB), and the memory per point (kB)."""
    upper = rows[(len(rows) - 1) // 2 :]
    n, memory = (np.array([row[name] for row in rows], dtype=float) for name in ("points", "memory_MB"))
    slope, base = np.polyfit(n, memory, 1, w=1 / memory)
    found = {"MB at first": float(base), "kB a point": 1024 * float(slope)}
    for part in ("step", *PARTS, "rest"):
        seconds = np.array([row[part] for row in upper])
        if (seconds > 0).all():
            found[part] = float(np.polyfit(np.log(n[-len(upper) :]), np.log(seconds), 1)[0])
    return found


def halo(dim: int, n: float, processes: int) -> float:
    """Return the number H of points along the faces that one of 2^k processes shares with others."""
    turn = round(np.log2(processes))
    halved = np.array([turn // dim + (axis < turn % dim) for axis in range(dim)])
    sides = n ** (1 / dim) / 2.0**halved
    return float((np.minimum(halved, 2) * sides.prod() / sides).sum())


def terms(dim: int, n: float, processes: int, imbalance: float = 1.0) -> list[float]:
    """Return the factors of e, a, b and c in the cost model: 1, n / P, H and log2 P."""
    return [1.0, imbalance * n / processes, halo(dim, n, processes), np.log2(processes)]


def modelled(row: dict) -> float:
    """Return the measured time, in s, that the cost model describes: a whole step, but in 2D without the solvers."""
    return row["step"] - (sum(row[part] for part in SOLVERS) if row["dim"] == 2 else 0.0)


def fit(rows: list[dict]) -> dict[str, float]:
    """Return the coefficients of the cost model (s), and its largest relative error over all runs."""
    timed = [row for row in rows if row["processes"] <= (os.cpu_count() or 1)]
    A = np.array([terms(row["dim"], row["points"], row["processes"], row["imbalance"]) for row in timed])
    T = np.array([modelled(row) for row in timed])
    coefficients, _ = nnls(A / T[:, None], np.ones(len(T)))
    found = dict(zip("eabc", coefficients.tolist(), strict=True))
    return {**found, "worst": float(np.abs(A @ coefficients / T - 1).max())}


def predicted(model: dict[str, float], dim: int, n: float, processes: int) -> float:
    """Return the time of a step that the cost model predicts, in s."""
    return float(np.dot(terms(dim, n, processes), [model[name] for name in "eabc"]))


# ---- reporting -----------------------------------------------------------------------------------


def by_part(rows: list[dict], found: dict[str, float]) -> str:
    """Return a Markdown table with the time and the exponent of each part of a step, and with the memory."""
    lines = [["seconds of a step", *(f"{row['points']}" for row in rows), "exponent"]]
    for part in ("step", *PARTS, "rest"):
        lines.append([part, *(f"{row[part]:.2g}" for row in rows), f"{found.get(part, np.nan):.2f}"])
    memory = [f"{row['memory_MB']:.0f}" for row in rows]
    return common.markdown([*lines, ["memory (MB)", *memory, f"{found['kB a point']:.1f} kB a point"]])


def by_processes(rows: list[dict]) -> str:
    """Return a Markdown table of time, memory, imbalance and messages of a step."""
    columns = {
        "points": "points",
        "processes": "processes",
        "step (s)": "step",
        "memory (MB)": "memory_MB",
        "of a process": "most_MB",
        "counted": "counted_MB",
        "imbalance": "imbalance",
        "exchange: messages": "exchange_messages",
        "bytes": "exchange_bytes",
        "solvers: messages": "solver_messages",
        "bytes ": "solver_bytes",
        "reductions": "solver_reductions",
    }
    values = ([row[key] for key in columns.values()] for row in rows)
    return common.markdown([list(columns), *([f"{v:.0f}" if v >= 100 else f"{v:.3g}" for v in row] for row in values)])


def prediction(model: dict[str, float], dim: int) -> str:
    """Return the cost model and its predictions for many processes as text."""
    form = f"{model['e']:.2g} + {model['a']:.2g} n/P + {model['b']:.2g} H + {model['c']:.2g} log2 P"
    lines = [f"{dim}D: T = {form} s, within {100 * model['worst']:.0f} % of the runs"]
    for share in (1e4, 1e5):
        times = [f"{predicted(model, dim, share * P, P):.2f} s on {P}" for P in (1, 2, 64, 1024, 4096)]
        lines.append(f"    {share:g} points a process: {', '.join(times)}")
    return "\n".join(lines)


def draw(out: Path, rows: list[dict]) -> None:
    """Draw the time of the parts and the memory against the number of points."""
    dims, processes = (sorted({row[name] for row in rows}) for name in ("dim", "processes"))
    fig, axes = common.figure(len(dims), 2, (13, 4.4 * len(dims)))
    for dim, (left, right) in zip(dims, axes, strict=True):
        for p, mark in zip(processes, "os^D*P", strict=False):
            mine = [row for row in rows if (row["dim"], row["processes"]) == (dim, p)]
            n, label = [row["points"] for row in mine], f"{p} process" + "es" * (p > 1)
            left.loglog(n, [row["step"] for row in mine], f"k{mark}-", lw=2, label=f"step, {label}")
            right.loglog(n, [row["memory_MB"] for row in mine], f"k{mark}-", label=label)
        draw_parts(left, right, [row for row in rows if (row["dim"], row["processes"]) == (dim, processes[0])])
        left.set(ylabel="time per step (s)", title=f"{dim}D: a step, its parts and their exponents")
        right.set(ylabel="peak memory, all processes (MB)", title=f"{dim}D: memory", ylim=(100, None))
        for ax in (left, right):
            ax.set(xlabel="material points")
            ax.grid(alpha=0.3)
        left.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        right.legend(fontsize=8)
    common.save(fig, out / "scaling.png", dpi=120)


def draw_parts(left, right, rows: list[dict]) -> None:
    """Draw times of the eight most expensive parts of a step, and memory."""
    n, found = np.array([row["points"] for row in rows]), exponents(rows)
    for k, part in enumerate(sorted((*PARTS, "rest"), key=lambda part: -rows[-1][part])[:8]):
        label = f"{part}, {found.get(part, np.nan):.2f}"
        left.loglog(n, [row[part] for row in rows], "osv^D*Pd"[k] + "-", ms=3, lw=1, label=label)
    middle = (len(rows) - 1) // 2
    left.loglog(n, rows[middle]["step"] * n / n[middle], "k:", lw=1, label="exponent 1")
    base, slope = found["MB at first"], found["kB a point"]
    right.loglog(n, base + slope / 1024 * n, "k:", lw=1, label=f"{base:.0f} MB + {slope:.1f} kB a point")


def write(out: Path, rows: list[dict]) -> dict:
    """Write tables and pictures, print the tables, and return the exponents and the cost model for 2D and 3D."""
    common.write_csv(out / "scaling.csv", rows[0], (row.values() for row in rows))
    text, found = [], {}
    for dim in sorted({row["dim"] for row in rows}):
        mine = [row for row in rows if row["dim"] == dim]
        several = sorted({row["processes"] for row in mine})
        fewest = [row for row in mine if row["processes"] == several[0]]
        found[f"{dim}D"] = {"exponents": exponents(fewest)}
        text += [
            f"{dim}D on {several[0]} process{'es' * (several[0] > 1)}:",
            "",
            by_part(fewest, found[f"{dim}D"]["exponents"]),
            "",
        ]
        if several[-1] > 1:
            text += ["What a process sends in a step:", "", by_processes(mine), ""]
        if several[0] == 1 < several[-1]:
            found[f"{dim}D"]["model"] = fit(mine)
            text += [prediction(found[f"{dim}D"]["model"], dim), ""]
    (out / "scaling.md").write_text("\n".join(text))
    print("\n".join(text))
    draw(out, rows)
    return found


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__, processes=True)
    add = parser.add_argument
    add("--dims", type=int, nargs="+", choices=(2, 3), default=[2, 3], help="dimensions")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="a few small sizes")
    size.add_argument("--largest", action="store_true", help="up to 1e6 points in 2D, 3e5 in 3D: a quarter of an hour")
    size.add_argument("--points", type=float, nargs="+", help="numbers of points, instead of the default sizes")
    add("--processes", type=int, nargs="+", default=[1], help="numbers of processes; under mpirun: its own")
    add("--one", nargs=3, help=argparse.SUPPRESS)  # a run in a process of its own: dimension, points, steps
    o = parser.parse_args(argv)
    if min(o.processes) < 1:
        parser.error(f"--processes {min(o.processes)}: must be >= 1")
    comm = MPI.COMM_WORLD
    if o.one:
        row = measure(int(o.one[0]), float(o.one[1]), int(o.one[2]))
        if comm.rank == 0:
            print(json.dumps(row))
        return {"converged": True}
    sizes = SIZES["quick" if o.quick else "largest" if o.largest else "default"]
    sizes = dict.fromkeys((2, 3), o.points) if o.points else sizes
    with common.results(o) as out:
        rows = out["rows"] = []
        for dim, points in [(each, points) for each in o.dims for points in sizes[each]]:
            for processes in o.processes if comm.size == 1 else [comm.size]:
                row = measure(dim, points) if comm.size > 1 else in_own_process(dim, points, processes)
                rows.append(row)
                if comm.rank == 0:
                    what = f"{dim}D, {row['points']:8} points, {processes} processes"
                    print(f"{what}: {row['step']:.3g} s a step, {row['memory_MB']:.0f} MB", flush=True)
        if comm.rank == 0:
            out |= write(o.out, rows)
    return out


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
