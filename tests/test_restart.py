# SPDX-License-Identifier: MIT
"""A resumed run equals an uninterrupted run."""

import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from xml.etree import ElementTree

from mpi4py import MPI

import meshio
import mpi_restart
import numpy as np
import pytest
import restart_run
from helpers import arrays_of, beam, column, limit, thresholds
from test_mpi import mpirun

import mpm_dolfinx as mpm
from mpm_dolfinx.io import checkpoint as restart
from mpm_dolfinx.io.one_file import joined
from mpm_dolfinx.io.writer import Series


def cut_beam():
    simulation, probe = beam(h=0.06)
    return limit(simulation, 4), probe  # most steps are cut


def pressed_column():
    plates, outlets = [mpm.RigidPlate("top", lambda t: 3e4 * t)], [mpm.Drained("top")]
    simulation = column(width=3, offset=0.3, conditions=[*plates, *outlets], gravity=lambda t: (0, -50 * t))
    return simulation, None


def plastic_column():
    options = {
        "friction": 30.0,
        "dilation": 10.0,
        "cohesion": 1e4,
        "porosity": 0.9,
        "conductivity": lambda X: 1e-4 * (1 + X[:, 1]),
    }
    sand = mpm.DruckerPrager(bulk=2e7, shear=1e7, hardening=5e6, **options)
    push = mpm.Displacement("top", lambda t, X: (0, -1.5 * t), "y")
    simulation = column(width=3, cells=6, material=sand, conditions=[push, mpm.Drained("top")])
    return simulation, None


def block(fluid=None):
    grid = mpm.Grid([0, 0, 0], [0.6, 0.4, 0.5], [3, 2, 3])
    body = mpm.box(grid, [0.1, 0, 0], [0.5, 0.4, 0.35])
    load = mpm.Traction("top", lambda t: (2e6 * t, 0, -4e6 * t))
    walls = {"bottom": "xyz", "front": "y", "back": "y"}
    rubber = mpm.NeoHookean(1e7, 5e6, conductivity=1e-4)
    simulation = mpm.Simulation(grid, [body], [rubber], walls=walls, conditions=[load], fluid=fluid)
    return simulation, mpm.probes([body], [[0.5, 0.4, 0.35]])


SCENES = {
    "beam": lambda: beam(h=0.06),
    "at the points": lambda: beam(h=0.06, numerics=mpm.Numerics(quadrature="point"), load=5e3),
    "linear": lambda: beam(h=0.06, load=1e3, material=mpm.LinearElastic(1e7 / 3, 5e6, conductivity=1e-4)),
    "cut steps": cut_beam,
    "plate and gravity": pressed_column,
    "plastic": plastic_column,
    "3D without fluid": block,
}


def same(one, other):
    """Assert that two simulations are in the same state, bit for bit, and have the same histories."""
    assert one.t == other.t
    a, b = arrays_of(one.points), arrays_of(other.points)
    for name in a.keys() | b.keys():
        assert np.array_equal(a[name], b[name]), name
    for f in fields(mpm.Result):
        if f.name not in ("rows", "wall", "profile", "memory"):
            assert np.array_equal(getattr(one.result, f.name), getattr(other.result, f.name)), f.name
    for name in ("t", "displacement", "pressure"):
        assert np.array_equal(getattr(one.result, name), getattr(other.result, name)), name


def every_step(folder):
    """Return an observer that saves every step in a separate file, the first as 2."""
    return lambda s: restart.save(s, folder / f"{len(s.result.t)}")


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_resumed_after_any_step_the_end_is_the_same_to_the_last_bit(scene, tmp_path):
    one, probe = scene()
    one.stage(fields={"grains": 0.1 * one.points.id})
    one.run(0.12, 0.02, probes=probe, checkpoint=every_step(tmp_path))
    for k in (2, 4, 7):
        other, probe = scene()
        other.stage(fields={"grains": np.zeros(len(other.points))})
        after = mpm.resume(other, tmp_path / f"{k}")
        assert len(after.t) == k and after.t[-1] == other.t
        other.run(0.12, 0.02, probes=probe, after=after, checkpoint=every_step(tmp_path / "again"))
        same(one, other)


@pytest.mark.parametrize("fluid", [None, mpm.Fluid()], ids=["dry", "wet"])
def test_resumed_runs_end_with_the_same_bits_by_multigrid_too(fluid, tmp_path, monkeypatch):
    thresholds(monkeypatch, multigrid_3d=50)
    test_resumed_after_any_step_the_end_is_the_same_to_the_last_bit(lambda: block(fluid), tmp_path)


def test_a_run_may_be_made_longer():
    one, probe = beam(h=0.06)
    one.run(0.1, 0.02, probes=probe)
    other, probe = beam(h=0.06)
    first = other.run(0.06, 0.02, probes=probe)
    assert other.run(0.1, 0.02, probes=probe, after=first).t == pytest.approx([0, 0.02, 0.04, 0.06, 0.08, 0.1])
    same(one, other)
    assert other.run(0.1, 0.02, probes=probe, after=first).steps == 5, "a run that is done does nothing"


def test_killed_at_random_moments_a_run_ends_with_the_same_bits_and_files(tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    child = [sys.executable, restart_run.__file__, str(tmp_path / "killed")]
    (tmp_path / "killed").mkdir()
    checkpoint, rng, resumed = tmp_path / "killed" / "run.ckpt", random.Random(7), 0
    for _ in range(3):
        before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        process = subprocess.Popen(child, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and (checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0) == before:
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.15))
        resumed += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not list((tmp_path / "killed").rglob("*.vtu")) or readable(tmp_path / "killed" / "out")
    assert resumed >= 2, "the kills came too late to show anything"
    killed, whole = restart_run.run(tmp_path / "killed"), restart_run.run(tmp_path / "whole")
    same(whole, killed)
    out, files = tmp_path / "whole" / "out", []
    for file in filter(Path.is_file, out.rglob("*")):
        files.append(file.relative_to(out))
        contents = [(tmp_path / name / "out" / files[-1]).read_bytes() for name in ("whole", "killed")]
        if file.name == "history.csv":
            rows = [list(csv.DictReader(content.decode().splitlines())) for content in contents]
            contents = [[{**row, "wall": None} for row in table] for table in rows]
        assert contents[0] == contents[1], file
    assert len(files) > 15


def readable(folder):
    """Return whether all files that the indices name can be read."""
    for index in folder.glob("*.pvd"):
        for item in ElementTree.parse(index).iter("DataSet"):
            assert ElementTree.parse(folder / item.get("file")).getroot().tag == "VTKFile"
    return True


@pytest.fixture(scope="module")
def parallel(tmp_path_factory):
    """Return the beam of one process, and the output folder of `mpi_restart.py` on two processes."""
    folder = tmp_path_factory.mktemp("parallel")
    one, probe = beam(h=0.06)
    half, end, dt = mpi_restart.T_END / 2, mpi_restart.T_END, mpi_restart.DT
    writer = mpm.Writer(one, folder / "one.out", grid=True)
    one.run(half, dt, probes=probe, checkpoint=mpm.Checkpoint(folder / "one"), observe=writer)
    one.run(end, dt, probes=probe, after=one.result)
    mpirun(2, "mpi_restart.py", *(str(folder / name) for name in ("one", "two", "end.npz")))
    return one, folder


def test_one_process_goes_on_where_two_were_and_two_where_one_was(parallel):
    one, folder = parallel
    there, (other, probe) = np.load(folder / "end.npz"), beam(h=0.06)
    assert min(there["counts"]) > 0
    states = [there, mpi_restart.to_the_end(other, probe, folder / "two")]
    for name, values in mpi_restart.state(one).items():
        for state in states:
            assert state[name] == pytest.approx(np.array(values), rel=0, abs=1e-10 * np.abs(values).max()), name


def test_two_processes_write_the_files_of_one(parallel):
    _, folder = parallel
    one, two = (Series(MPI.COMM_SELF, folder / f"{name}.out" / "points.pvd", 1.0).entries for name in ("one", "two"))
    assert [t for t, _ in one] == [t for t, _ in two] and len(one) == 4
    for (_, (here,)), (_, pieces) in zip(one, two, strict=True):
        here, pieces = meshio.read(here), [meshio.read(file) for file in pieces]
        assert len(pieces) == 2 and min(len(piece.points) for piece in pieces) > 0, "a file for each process"
        there = joined(pieces)
        assert there.points == pytest.approx(here.points, abs=1e-12)
        stress = max(np.abs(values).max() for name, (values,) in here.cell_data.items() if "stress" in name)
        for name, (values,) in here.cell_data.items():
            scale = stress if "stress" in name else np.abs(values).max()
            assert there.cell_data[name][0] == pytest.approx(values, rel=0, abs=1e-9 * scale), name
    grids = Series(MPI.COMM_SELF, folder / "two.out" / "grid.pvd", 1.0).entries
    assert [len(files) for _, files in grids] == [2, 2, 2] and readable(folder / "two.out")


QUICK = "dug carried few parts"
SLOW = " renewed following sinking rained"


RUNS = ((3, "write"), (1, "write"), (2, "read"), (4, "read"))


@pytest.mark.parametrize("scenes, runs", [(QUICK, RUNS[:3]), pytest.param(QUICK + SLOW, RUNS, marks=pytest.mark.slow)])
def test_any_number_of_processes_reads_a_checkpoint_and_writes_the_same_bits(scenes, runs, tmp_path):
    """All processes refuse a damaged checkpoint alike, and write none if the disk of one process is full."""
    for processes, task in runs:
        mpirun(processes, "mpi_checkpoints.py", str(tmp_path), task, *scenes.split())


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    file = tmp_path_factory.mktemp("checkpoint") / "run.ckpt"
    simulation, _ = beam(h=0.06)
    simulation.run(0.02, 0.02, checkpoint=mpm.Checkpoint(file))
    return file


def refused(file, match, simulation=None):
    """Assert that a checkpoint is refused in one line, and does not change the scene."""
    simulation = simulation or beam(h=0.06)[0]
    points = simulation.points
    with pytest.raises(ValueError, match=match) as caught:
        mpm.resume(simulation, file)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)
    assert simulation.points is points and simulation.t == 0


def test_a_truncated_checkpoint_is_refused(checkpoint, tmp_path):
    whole, file = checkpoint.read_bytes(), tmp_path / "short"
    simulation = beam(h=0.06)[0]
    for length in (4, 100, 5000, len(whole) // 2, len(whole) - 200, len(whole) - 1):
        file.write_bytes(whole[:length])
        refused(file, "cut short or damaged", simulation)


def test_a_damaged_checkpoint_is_refused(checkpoint, tmp_path):
    whole, file = bytearray(checkpoint.read_bytes()), tmp_path / "damaged"
    whole[len(whole) // 2] ^= 1
    file.write_bytes(whole)
    refused(file, "cut short or damaged")


def test_a_foreign_file_is_refused(checkpoint, tmp_path):
    file, simulation = tmp_path / "foreign", beam(h=0.06)[0]
    for content in (b"", b"# a mesh\n1 2 3\n" * 50, bytes(range(256)) * 10):
        file.write_bytes(content)
        refused(file, "not a checkpoint of mpm_dolfinx", simulation)
    for write in (np.savez, np.save):
        with open(file, "wb") as f:
            write(f, np.arange(3))
        refused(file, "not a checkpoint of mpm_dolfinx", simulation)
    with pytest.raises(FileNotFoundError):
        mpm.resume(simulation, tmp_path / "nothing")


def test_a_checkpoint_of_another_version_is_refused(checkpoint, monkeypatch):
    monkeypatch.setattr(restart, "VERSION", restart.VERSION + 1)
    refused(checkpoint, f"checkpoint of version {restart.VERSION - 1}, must be {restart.VERSION}")


OTHER_SCENES = {
    "material": ({"material": mpm.Hencky(1e7 / 3, 6e6, conductivity=1e-4)}, "shear of material 0: 5000000.0 in file"),
    "law": ({"material": mpm.NeoHookean(1e7 / 3, 5e6, conductivity=1e-4)}, "material 0: Hencky in file, NeoHookean"),
    "grid": ({"h": 0.05}, r"grid cells: \[20, 20\] in file, \[24, 24\] here"),
    "place": ({"offset": 0.6}, "checksum of the positions of body 0"),
    "fluid": ({"fluid": mpm.Fluid(bulk=1e9)}, "bulk of fluid: 2200000000.0 in file, 1000000000.0 here"),
    "dry": ({"fluid": False}, "fluid: Fluid in file, None here"),
    "quadrature": ({"numerics": mpm.Numerics(quadrature="point")}, "quadrature: domain in file, point here"),
}


@pytest.mark.parametrize(("options", "difference"), OTHER_SCENES.values(), ids=OTHER_SCENES)
def test_a_checkpoint_of_another_scene_is_refused_and_the_difference_named(options, difference, checkpoint):
    refused(checkpoint, "another scene: " + difference, beam(**{"h": 0.06, **options})[0])


def test_a_checkpoint_that_cannot_be_finished_leaves_the_one_before(checkpoint, tmp_path, monkeypatch):
    file = tmp_path / "run.ckpt"
    before = shutil.copy(checkpoint, file).read_bytes()
    simulation, _ = beam(h=0.06)
    after = mpm.resume(simulation, file)

    def full(f, array, **options):
        f.write(before[:1000])
        raise OSError("No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    with pytest.raises(OSError, match="No space left"):
        simulation.run(0.04, 0.02, after=after, checkpoint=mpm.Checkpoint(file))
    assert file.read_bytes() == before and (tmp_path / "run.ckpt.part").exists()
    monkeypatch.undo()
    after = mpm.resume(simulation, file)
    simulation.run(0.04, 0.02, after=after, checkpoint=mpm.Checkpoint(file))
    assert mpm.resume(simulation, file).t[-1] == 0.04 and not (tmp_path / "run.ckpt.part").exists()


def test_checkpoints_are_written_as_often_as_asked(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(restart, "save", lambda s, file: written.append(round(s.t, 9)))
    simulation, _ = beam(h=0.06)
    result = simulation.run(0.14, 0.02, checkpoint=mpm.Checkpoint("x", every=3))
    assert written == [0.06, 0.12, 0.14], "every third and the last"
    written.clear()
    simulation.run(0.2, 0.02, after=result, checkpoint=mpm.Checkpoint("x", seconds=1e3))
    assert written == [0.2]


def test_what_makes_no_sense_is_refused_in_one_line():
    simulation, probe = beam(h=0.06)
    for options in ({"every": 0}, {"every": 1.5}, {"seconds": -1.0}):
        with pytest.raises(ValueError, match="checkpoint: "):
            mpm.Checkpoint("x", **options)
    result = simulation.run(0.02, 0.02)
    with pytest.raises(ValueError, match=r"is continued has dt = 0\.02"):
        simulation.run(0.1, 0.01, after=result)
    with pytest.raises(ValueError, match=r"probes: .* must be 0, as in the run that is continued"):
        simulation.run(0.1, 0.02, probes=probe, after=result)
    simulation.step(0.03)
    with pytest.raises(ValueError, match=r"is continued has dt = 0\.02, t = 0\.02"):
        simulation.run(0.1, 0.02, after=result)
