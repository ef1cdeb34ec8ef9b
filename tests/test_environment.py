# SPDX-License-Identifier: MIT
"""What the package finds around it: what is installed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def environment(**changes):
    """Return the environment of this process with changes, None for what is to be absent."""
    out = {**os.environ, "PYTHONPATH": str(ROOT), **changes}
    return {name: str(value) for name, value in out.items() if value is not None}


def start(code, **changes):
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env=environment(**changes),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C reaches all of a terminal's processes
    )


def ended(process):
    """Return what a process has said, when it has ended."""
    out, err = process.communicate(timeout=120)
    return {"returncode": process.returncode, "stdout": out, "stderr": err}


def last_line(code, **changes):
    """Return what the last line of a failing program says."""
    end = ended(start(code, **changes))
    assert end["returncode"] == 1
    return end["stderr"].splitlines()[-1]


# ---- what is installed


def test_a_missing_dolfinx_is_named_with_what_to_install():
    line = last_line("import sys; sys.modules['dolfinx'] = None; import mpm_dolfinx")
    assert line.startswith(f"ImportError: dolfinx: not found by {sys.executable}")
    assert "apt install python3-dolfinx`" in line and "conda install -c conda-forge fenics-dolfinx`" in line


def test_other_packages_that_are_missing_are_named_too():
    line = last_line("import sys; sys.modules.update(scipy=None, meshio=None); import mpm_dolfinx", PETSC_DIR=None)
    assert line.startswith("ImportError: scipy, meshio: not found by ") and "python3-scipy python3-meshio`" in line


def test_a_place_of_petsc_that_is_none_is_named():
    line = last_line("import sys; sys.modules['petsc4py'] = None; import mpm_dolfinx", PETSC_DIR="/there")
    assert "petsc4py: not found by " in line and "PETSC_DIR = /there" in line and "apt install python3-dolfinx`" in line


def test_petsc_with_complex_numbers_is_refused():
    code = "from petsc4py import PETSc; PETSc.ScalarType = complex; import mpm_dolfinx"
    line = last_line(code)
    assert line.startswith("ImportError: PETSc: its numbers are complex") and "python3-dolfinx-real" in line


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be a user without a name")
def test_a_user_without_a_home_is_told_to_set_one():
    code = f"import os; os.setuid(54321); os.environ.pop('HOME'); exec({'import mpm_dolfinx'!r})"
    assert last_line(code).startswith("ImportError: HOME is not set")
