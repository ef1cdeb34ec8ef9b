# SPDX-License-Identifier: MIT
"""Results are equal on any number of processes."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import common
import footing
import numpy as np
import pytest
import slump

from mpm_dolfinx.grid.partition import Partition, boxes


def mpirun(processes: int, script: str, *arguments: str) -> None:
    """Run a script of this folder by mpirun. A failing process aborts all. The time limit detects hanging processes."""
    here = Path(__file__).parent
    environment = dict(os.environ)  # given whole: mpirun must not see the MPI variables of this process
    folders = (here, here.parent, here.parent / "demos")
    environment["PYTHONPATH"] = os.pathsep.join([*map(str, folders), environment.get("PYTHONPATH", "")])
    command = ["mpirun", "--oversubscribe", "-n", str(processes), sys.executable, "-m", "mpi4py", script, *arguments]
    done = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]


NAMES = (
    "beam slab stages waves laws layers initial 3d cycles mesh tools axisymmetric contact grids strike sizes "
    "following division shared shaken parts few_cells probes"
)
SCENES = [*(f"mpi_{name}.py" for name in NAMES.split()), "mpi_tools.py meshes"]
TOGETHER = {
    1: ["mpi_exchange.py", *SCENES],
    2: [f"mpi_{name}.py" for name in ("exchange", "refusals", "second_scene", "bodies")],
    3: ["mpi_exchange.py", *SCENES, "mpi_bodies.py"],
}
"""Scripts that processes run one after the other, by number of processes."""
SLOW = [(f"mpi_{name}.py", n) for name, n in (("wetting", (3,)), ("rain", (2, 3, 4)), ("tied", (2, 3)))]
SLOW += [("mpi_following_3d.py", (2,)), *((f"mpi_contact.py {kind}", (2, 3)) for kind in ("axisymmetric", "conducts"))]


def together(processes):
    """Return a fixture: the folder of the results of scripts on some processes."""

    @pytest.fixture(scope="module")
    def folder(tmp_path_factory):
        return ran(tmp_path_factory.mktemp(f"processes-{processes}"), processes, TOGETHER[processes])

    return folder


def ran(folder, processes, scripts):
    """Run scripts on some processes, and return the folder of their results."""
    folder.mkdir(exist_ok=True)
    mpirun(processes, "mpi_scenes.py", str(folder), *scripts)
    return folder


one, two, three = map(together, TOGETHER)


def same(scene, one, others):
    """Assert that a scene has the same results on one process, and on other numbers of processes (folders)."""
    states = {processes: np.load(folder / f"{scene}.npz") for processes, folder in {1: one, **others}.items()}
    for processes, state in states.items():
        assert len(state["counts"]) == processes and state["balance"] <= 1e-8
        assert state["x"] == pytest.approx(states[1]["x"], abs=1e-10)
        for name in set(state.files) - {"x", "tip", "balance", "counts"}:
            size = np.abs(states[1][name]).max()
            assert state[name] == pytest.approx(states[1][name], abs=1e-8 * size), name


@pytest.mark.parametrize("scene", SCENES)
def test_the_state_is_the_same_on_several_processes(scene, one, three):
    same(scene, one, {3: three})


@pytest.mark.slow
@pytest.mark.parametrize("scene, several", SLOW)
def test_the_state_of_a_large_scene_is_the_same_on_several_processes(scene, several, tmp_path):
    one, *others = (ran(tmp_path / str(processes), processes, [scene]) for processes in (1, *several))
    same(scene, one, dict(zip(several, others, strict=True)))


def test_scripts_that_check_themselves_end_without_an_error(one, two, three):
    """Rows travel and are counted, all processes seed or refuse the same meshes, and raise the same errors.

    A second scene on a grid is as even as alone. Earlier, the grid kept the distribution of the first scene, and of
    bodies before their maps: one process had all points.
    """
    assert np.load(two / "mpi_second_scene.py.npz")["imbalance"].max() < 1.3


def test_a_demo_of_several_processes_prints_what_one_does_or_is_refused(tmp_path, capsys, monkeypatch):
    """Earlier, the footing's demo ended with an IndexError at its first picture, and others drew only some points."""
    push = "../demos/footing.py --cells 3 --depth 0.05 --steps 2 --box 2 --out".split()
    mpirun(2, *push, str(tmp_path))
    monkeypatch.setattr(common, "MPI", SimpleNamespace(COMM_WORLD=SimpleNamespace(size=2, rank=0)))
    for demo, arguments in ((slump, []), (footing, ["--cells", "3"])):
        with pytest.raises(SystemExit):
            demo.main([*arguments, "--out", str(tmp_path)])
        assert "runs on one process, not 2" in capsys.readouterr().err


def test_no_process_is_left_without_a_cell_where_there_are_as_many():
    rng = np.random.default_rng(5)
    for _ in range(400):
        shape, processes = tuple(rng.integers(1, 6, rng.integers(2, 4))), int(rng.integers(2, 9))
        load = rng.integers(0, 5, shape) * (rng.random(shape) < rng.random())
        partition = Partition(boxes(load.astype(float), processes), shape)
        owner = partition.owner(np.indices(shape)).ravel()
        counts = np.bincount(owner, minlength=processes)
        assert all((np.flatnonzero(owner == rank) == partition.cells(rank)).all() for rank in range(processes))
        assert len(counts) == processes and np.count_nonzero(counts) == min(processes, load.size), (shape, processes)


def test_imbalance_memory_and_traffic_are_those_of_the_processes(tmp_path):
    found = {}
    for processes in (1, 2):
        mpirun(processes, "mpi_imbalance.py", str(tmp_path / "out.npz"))
        found[processes] = dict(np.load(tmp_path / "out.npz"))
    one, two = found[1], found[2]
    assert not one["sent"].any() and not one["whole_imbalance"].size, "a process alone sends nothing"
    assert one["whole_points"] == two["whole_points"] == 400 and two["half_points"] == 200
    assert 1.5 < two["whole_memory"] / one["whole_memory"] < 3
    for when in ("whole", "half"):
        counts = two[f"{when}_counts"]
        assert two[f"{when}_imbalance"] == pytest.approx(counts.max(axis=0) / counts.mean(axis=0))
    assert two["whole_imbalance"].max() < 1.1
    assert two["half_imbalance"].max() < 1.1, "what is left, on one process, is distributed anew"
    (transfers, other), messages, sent = two["sent"].T
    assert transfers == other > 0 and (messages <= transfers).all() and (sent > 8 * messages).any()


@pytest.mark.parametrize("scene", ["carried", "dug"])
@pytest.mark.parametrize("processes", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 4))])
def test_bodies_that_leave_their_processes_are_distributed_anew_with_the_same_answer(scene, processes, tmp_path):
    """Earlier, the scene kept the initial cells. A resumed run begins with equal bits. On two processes it also ends
    with equal bits: a sum then has a contribution of one other process, and the order of messages does not matter.
    """
    files = [tmp_path / f"{scene}-{n}.npz" for n in (processes, 1)]
    for n, file in zip((processes, 1), files, strict=True):
        mpirun(n, "mpi_moving.py", str(file), str(tmp_path / "checkpoint"))
    several, one = map(np.load, files)
    print(f"difference of a resumed run: {several['resumed']:.1e}")
    assert several["read"] and (several["end"] or processes > 2)
    assert max(several["resumed"], several["off"]) < 1e-11, "more than the tolerance of Newton's method"
    assert several["imbalance"] < 1.3 < 1.5 < several["fixed"]
    for name in set(one.files) - {"imbalance"}:
        assert several[name] == pytest.approx(one[name], abs=1e-8 * np.abs(one[name]).max(), nan_ok=True), name


SHARES = [("1e4", ["boxes", "meshes"], 0.28), pytest.param("3e5", ["boxes"], 0.3, marks=pytest.mark.slow)]


@pytest.mark.parametrize("points, kinds, bound", SHARES)
def test_no_process_holds_arrays_of_the_whole_scene(points, kinds, bound, tmp_path):
    """The excess over a quarter is due to borders between processes, and to uneven numbers of points.

    The largest shares are 0.266 of 1e4 points, and 0.265 of 3e5 points.
    """
    scenes = {of: f"mpi_held.py {points} {of}" for of in kinds}
    for processes in (1, 4):
        ran(tmp_path, processes, scenes.values())
    for of, scene in scenes.items():
        one, four = (dict(np.load(tmp_path / f"{scene}-{processes}.npz")) for processes in (1, 4))
        assert one["whole"][0] > 0 and not four["whole"].any(), "lengths of bodies and of the grid"
        assert four["points"].sum() == one["points"][0] and (four["asked"] <= four["points"]).all()
        assert four["asked"].sum() == one["asked"][0] > 0
        print(f"shares: {four['held'] / one['held'][0]}")
        assert (four["held"] < bound * one["held"][0]).all()
        assert not one["files"].any() and four["files"].any() == (of == "meshes"), "one copy of a mesh on a machine"
        size = (tmp_path / f"{scene}-1.checkpoint").stat().st_size
        assert (four["written"] < 2 * size / 4).all() and (four["read"] < 3 * size / 4).all(), "shares of a checkpoint"
