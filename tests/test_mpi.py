# SPDX-License-Identifier: MIT
"""The same answer on any number of processes, one of which owns no point."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest


def mpirun(processes: int, script: str, *arguments: str) -> None:
    """Run a script of this folder by mpirun; a failing rank aborts all."""
    here = Path(__file__).parent
    environment = dict(os.environ)  # given whole: mpirun must not see the MPI variables of this process
    environment["PYTHONPATH"] = os.pathsep.join([str(here), str(here.parent), environment.get("PYTHONPATH", "")])
    command = ["mpirun", "--oversubscribe", "-n", str(processes), sys.executable, "-m", "mpi4py", script, *arguments]
    done = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    file = tmp_path_factory.mktemp("mpi") / "one.npz"
    mpirun(1, "mpi_beam.py", str(file))
    return np.load(file)


@pytest.mark.parametrize("processes", [2, 3])
def test_the_beam_is_the_same_on_several_processes(alone, processes, tmp_path):
    mpirun(processes, "mpi_beam.py", str(tmp_path / "many.npz"))
    many = np.load(tmp_path / "many.npz")
    assert len(many["counts"]) == processes
    assert many["x"] == pytest.approx(alone["x"], abs=1e-10)
    assert many["p"] == pytest.approx(alone["p"], abs=1e-8 * np.abs(alone["p"]).max())
    assert many["balance"] <= 1e-8
