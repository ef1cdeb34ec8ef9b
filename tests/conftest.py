# SPDX-License-Identifier: MIT
"""The tests import scenes of the demos, and processes that wait for messages leave the cores to others."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "demos"))

os.environ["OMPI_MCA_mpi_yield_when_idle"] = "0"  # of this process: see `waiting`
SLEEP = """
#include <stdlib.h>
#include <time.h>
int sched_yield(void) {
    const char *size = getenv("OMPI_COMM_WORLD_SIZE");
    struct timespec t = {0, 20000};
    return size && atoi(size) > 1 ? nanosleep(&t, 0) : 0;
}
"""


@pytest.fixture(scope="session", autouse=True)
def waiting(tmp_path_factory):
    """Let processes of Open MPI that are started here sleep while they wait for messages, if there is a C compiler.

    With `sched_yield`, the process they wait for gets only a part of the cores: scenes on three processes took twice as
    long beside other tests. A process alone must not yield: MUMPS looks for messages all the time, and tests of the
    beam took twice as long beside other tests.
    """
    os.environ["OMPI_MCA_mpi_yield_when_idle"] = "1"
    if compiler := shutil.which("cc"):
        library = str(tmp_path_factory.mktemp("waiting") / "sleep.so")
        subprocess.run([compiler, "-shared", "-fPIC", "-xc", "-", "-o", library], input=SLEEP, text=True, check=True)
        os.environ.setdefault("LD_PRELOAD", library)


@pytest.fixture
def warned(recwarn):
    """Return a function that returns the messages of the package's warnings since its last call."""
    import mpm_dolfinx as mpm  # not above: xdist would hand its workers MPI's variables, with which mpirun ends

    def messages():
        found = [str(one.message) for one in recwarn if issubclass(one.category, mpm.ResultWarning)]
        recwarn.clear()
        return found

    return messages
