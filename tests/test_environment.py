# SPDX-License-Identifier: MIT
"""The environment of the package: installed packages, folders without write access, remains of other runs."""

import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from test_mpi import mpirun

SCENE = """
import mpm_dolfinx as mpm
grid = mpm.Grid([0, 0], [1, 1], [4, 4])
body = mpm.box(grid, [0.25, 0], [0.75, 0.5])
load = mpm.Traction("top", -1e3)
s = mpm.Simulation(grid, [body], [mpm.Hencky(1e6, 6e5)], walls={"bottom": "xy"}, conditions=[load])
print("ran" if s.run(1, 1, progress=False).converged else "did not")
"""
ROOT = Path(__file__).parent.parent
ONE = {"returncode": 0, "stdout": "ran\n", "stderr": ""}


def environment(**changes):
    """Return the environment of this process with changes; None removes a variable."""
    out = {**os.environ, "PYTHONPATH": str(ROOT), **changes}
    return {name: str(value) for name, value in out.items() if value is not None}


def start(code=SCENE, **changes):
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env=environment(**changes),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C reaches all of a terminal's processes
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # which what a shell runs with & ignores
    )


def ended(process):
    """Return the output of a process after its end."""
    out, err = process.communicate(timeout=120)
    return {"returncode": process.returncode, "stdout": out, "stderr": err}


def last_line(code, **changes):
    """Return the last line of a failing program's output."""
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
    assert line.startswith("ImportError: PETSc has complex numbers") and "python3-dolfinx-real" in line


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be a user without a name")
def test_a_user_without_a_home_is_told_to_set_one():
    code = f"import os; os.setuid(54321); os.environ.pop('HOME'); exec({'import mpm_dolfinx'!r})"
    assert last_line(code).startswith("ImportError: HOME is not set")


# ---- folders that cannot be written


def test_without_a_folder_for_what_is_compiled_a_run_says_so_once_and_goes_on(tmp_path):
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "tmp").mkdir()
    cache = tmp_path / "file" / "fenics"
    end = ended(start(XDG_CACHE_HOME=tmp_path / "file", TMPDIR=tmp_path / "tmp"))
    assert end["stdout"] == "ran\n" and end["returncode"] == 0
    assert end["stderr"].count("\n") == 1 and f"{cache}: Not a directory" in end["stderr"]
    assert "set XDG_CACHE_HOME to another" in end["stderr"] and str(tmp_path / "tmp") in end["stderr"]
    assert not list((tmp_path / "tmp").glob("mpm_dolfinx-*")), "what was compiled is removed at the end"


def test_settings_of_dolfinx_that_cannot_be_read_are_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    line = last_line(SCENE, XDG_CONFIG_HOME=tmp_path / "file")
    assert line.startswith(f"OSError: {tmp_path / 'file'}/") and "set HOME or XDG_CONFIG_HOME" in line


def test_a_c_compiler_that_fails_is_named_and_not_the_law(tmp_path):
    line = last_line(SCENE, XDG_CACHE_HOME=tmp_path, CC="false")
    assert line.startswith("OSError: C compiler: CompileError: command ") and "false' failed" in line
    assert not list((tmp_path / "fenics").iterdir())


def test_what_is_wrong_around_one_process_all_of_them_say(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", "false")
    scene = "\n    ".join(SCENE.splitlines())
    (tmp_path / "scene.py").write_text(
        f"try:{scene}\nexcept OSError as error:\n    assert str(error).startswith('C compiler: CompileError: ')\n"
        "else:\n    raise AssertionError('ran without a compiler')"
    )
    mpirun(2, str(tmp_path / "scene.py"))


# ---- what other runs have left


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Return a cache with the compiled forms of the scene."""
    cache = tmp_path_factory.mktemp("compiled")
    assert ended(start(XDG_CACHE_HOME=cache)) == ONE, "the compiler's calls are not to be seen"
    return cache


def test_a_second_run_compiles_nothing(compiled, tmp_path):
    cache = shutil.copytree(compiled, tmp_path / "cache")
    assert ended(start(XDG_CACHE_HOME=cache)) == ONE
    first, second = ({file.name for file in each.glob("fenics/*.c")} for each in (compiled, cache))
    assert first == second != set(), "the name of a library depends on the libraries compiled before it"


def unfinished(age):
    def damage(library, source):
        source.with_suffix(".c.cached").unlink()
        os.utime(source, (time.time() - age,) * 2)

    return damage


def cut(share):
    return lambda library, source: os.truncate(library, int(share * library.stat().st_size))


DAMAGE = {
    "unfinished since a second": unfinished(1),
    "unfinished since a day": unfinished(86400),
    "empty": cut(0),
    "cut in the head": cut(0.001),
    "cut in two": cut(0.5),
    "cut near the end": cut(0.8),
    "no library": lambda library, source: library.unlink(),
    "no source": lambda library, source: source.unlink(),
    "another library": lambda library, source: shutil.copy(sys.modules["_ctypes"].__file__, library),
}


def test_what_a_run_that_was_broken_off_has_left_ends_no_later_one(compiled, tmp_path):
    """As many runs as it takes to damage a library in each way; of later releases there are few libraries."""
    damages, runs = list(DAMAGE.values()), 0
    while damages:
        cache = shutil.copytree(compiled, tmp_path / f"{(runs := runs + 1)}")
        for source in sorted(cache.glob("fenics/*.c"), key=lambda file: file.stat().st_size, reverse=True):
            if damages:
                damages.pop(0)(next(cache.glob(f"fenics/{source.stem}.*so")), source)
        assert ended(start(XDG_CACHE_HOME=cache)) == ONE
        assert not list(cache.glob("fenics/.*"))


def compiling(folder):
    """Return whether a form is being compiled."""
    try:
        return any(folder.glob(".mpm_dolfinx-*/*.c"))
    except FileNotFoundError:  # a folder that has just been removed
        return False


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_run_may_be_broken_off_while_it_compiles(how, tmp_path):
    process, folder = start(XDG_CACHE_HOME=tmp_path), tmp_path / "fenics"
    while process.poll() is None and not compiling(folder):
        time.sleep(0.002)
    time.sleep(0.2)
    os.killpg(process.pid, how)
    assert ended(process)["returncode"] != 0
    ready = {mark.name.removesuffix(".cached") for mark in folder.glob("*.cached")}
    assert {file.name for file in folder.glob("*.c")} == ready, "what is in the cache is whole"
    assert how != signal.SIGINT or not list(folder.glob(".*")), "Ctrl-C leaves nothing"
    assert ended(start(XDG_CACHE_HOME=tmp_path)) == ONE


def test_two_runs_compile_at_once_and_remove_what_was_killed_a_day_ago(tmp_path):
    left = [tmp_path / "fenics" / f".mpm_dolfinx-{name}" for name in ("old", "new")]
    for folder in left:
        folder.mkdir(parents=True)
    os.utime(left[0], (time.time() - 2 * 86400,) * 2)
    runs = [start(XDG_CACHE_HOME=tmp_path) for _ in range(2)]
    assert [ended(run) for run in runs] == [ONE, ONE]
    assert not left[0].exists() and left[1].exists()


@pytest.mark.parametrize("writable", [True, False])
def test_two_processes_compile_together(writable, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path if writable else tmp_path / "file"))
    (tmp_path / "scene.py").write_text(SCENE)
    mpirun(2, str(tmp_path / "scene.py"))


# ---- logging


@pytest.mark.parametrize("fails", [False, True])
def test_logging_is_left_as_it_was(fails, tmp_path):
    code = """
import logging
import mpm_dolfinx as mpm
logging.disable(logging.WARNING)
root = logging.getLogger()
root.handlers[:] = [logging.StreamHandler()]
root.setLevel(logging.DEBUG)
before = list(root.handlers), root.level, list(root.filters), root.manager.disable
try:
    exec({scene!r})
except OSError:
    print("failed")
assert (root.handlers, root.level, root.filters, root.manager.disable) == before
"""
    end = ended(start(code.format(scene=SCENE), XDG_CACHE_HOME=tmp_path, **({"CC": "false"} if fails else {})))
    assert (end["returncode"], end["stdout"]) == (0, "failed\n" if fails else "ran\n"), end["stderr"]


def test_logging_can_be_set_up_after_the_import(tmp_path):
    """In an earlier version, the import added a handler to the root logger, and `basicConfig` had no effect."""
    code = """
import logging
before = list(logging.getLogger().handlers), logging.getLogger().level
import mpm_dolfinx as mpm
assert (logging.getLogger().handlers, logging.getLogger().level) == before
logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")
from mpm_dolfinx.parallel.messages import MPI, log
log(MPI.COMM_WORLD, "step cut to %g s", 0.5)
"""
    end = ended(start(code, XDG_CACHE_HOME=tmp_path))
    assert end["returncode"] == 0 and end["stderr"].splitlines()[-1] == "mpm_dolfinx: step cut to 0.5 s", end["stderr"]


def test_the_import_does_not_suppress_warnings(tmp_path):
    """ffcx of dolfinx 0.5 sends warnings to a handler of the root logger, which the import removes."""
    code = "import warnings, mpm_dolfinx as mpm; warnings.warn('result', mpm.ResultWarning)"
    end = ended(start(code, XDG_CACHE_HOME=tmp_path))
    assert "ResultWarning: result" in end["stderr"]


def test_the_users_own_messages_are_not_kept_back(tmp_path):
    code = f"import logging; logging.basicConfig(level=logging.INFO, force=True)\n{SCENE}\nlogging.info('done')"
    end = ended(start(code, XDG_CACHE_HOME=tmp_path))
    assert end["stderr"].splitlines()[-1] == "INFO:root:done" and "gcc" not in end["stderr"]


# ---- the shell's scripts


def script(*arguments, **options):
    clean = environment(PYTHONPATH=None, **{name: None for name in os.environ if name.startswith("OMPI_")})
    done = subprocess.run(["bash", *map(str, arguments)], env=clean, capture_output=True, text=True, **options)
    return {"returncode": done.returncode, "stdout": done.stdout, "stderr": done.stderr}


def test_a_demo_runs_on_two_processes_also_as_root(tmp_path):
    beam = ("poroelastic_beam", "--h", "0.1", "--t-end", "0.04", "--out", tmp_path)
    end = script(ROOT / "demos" / "run.sh", "-n", "2", *beam)
    assert end["returncode"] == 0, end["stderr"]
    assert (tmp_path / "pressure.png").exists()


def test_help_lists_the_demos_with_a_line_each():
    listed = [line.split(maxsplit=1) for line in script(ROOT / "demos" / "run.sh", "--help")["stdout"].splitlines()]
    for demo in (ROOT / "demos").glob("*.py"):
        title = demo.read_text().splitlines()[1].strip('"')
        assert ([demo.stem, title] in listed) is (demo.stem != "common"), demo


@pytest.mark.parametrize("processes", ["0", "two", ""])
def test_a_number_of_processes_that_is_none_is_refused(processes):
    end = script(ROOT / "demos" / "run.sh", "-n", processes)
    assert end["returncode"] == 2 and end["stderr"] == f"-n {processes}: must be a number of processes, such as -n 2\n"


@pytest.mark.skipif(shutil.which("apt-get") is None, reason="a .venv is made on Debian only")
def test_a_demo_runs_from_a_folder_that_cannot_be_written(tmp_path):
    for part in (".ci", "demos", "mpm_dolfinx"):
        shutil.copytree(ROOT / part, tmp_path / "project" / part)
    (tmp_path / "project" / ".venv").write_text("in the way, also root's")
    end = script(tmp_path / "project" / "demos" / "run.sh", "terzaghi", "--cells", "2", "--steps", "10", cwd=tmp_path)
    assert end["returncode"] == 0 and (tmp_path / "out" / "terzaghi" / "terzaghi.png").exists(), end["stderr"]
    assert "/project/.venv cannot be made: taking /usr/bin/python3" in end["stderr"]
