# SPDX-License-Identifier: MIT
"""Output of a run on disk and on the terminal."""

import csv
import importlib
import io
import logging
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

from mpi4py import MPI

import dolfinx
import meshio
import numpy as np
import pytest
from helpers import beam
from mpi_output import sheared
from test_mpi import mpirun
from test_restart import block, cut_beam

import mpm_dolfinx as mpm
from mpm_dolfinx.__main__ import main
from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.points.cutting import volumes


def with_h5py():
    """Skip the test without an h5py that works with dolfinx; the h5py of PyPI has its own HDF5."""
    try:
        importlib.import_module("h5py")
    except Exception as error:
        pytest.skip(f"h5py: {error}")


def index(file):
    """Return the times of an index and the files of each time."""
    out = {}
    for item in ElementTree.parse(file).iter("DataSet"):
        out.setdefault(float(item.get("timestep")), []).append(file.parent / item.get("file"))
    return out


def table(file):
    """Return the columns of a CSV file."""
    with open(file, newline="") as f:
        rows = list(csv.DictReader(f))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def fields(file):
    """Return the arrays of a text file of dolfinx."""
    arrays = ElementTree.parse(file).iter("DataArray")
    return {a.get("Name", "x"): np.array(a.text.split(), dtype=float) for a in arrays}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the beam after seven intervals, the folder of its files, and its states at the ends of all intervals."""
    folder, states = tmp_path_factory.mktemp("out") / "beam", []
    simulation, probe = beam(h=0.06)
    axis = np.tile([1.0, 2.0], (len(simulation.points), 1))
    simulation.stage(fields={"grains": 0.1 * simulation.points.id, "axis": axis})

    def keep(s):
        cells = s.cells()  # fills the cells anew
        states.append((s.points, s.effective_stress(), s.scene.momentum.ghost.fill.x.array.copy(), cells))

    keep(simulation)
    simulation.run(0.14, 0.02, probes=probe, observe=[mpm.Writer(simulation, folder, every=3, grid=True), keep])
    return simulation, folder, states


def test_start_end_and_every_third_state_are_written(written):
    _, folder, _ = written
    assert list(index(folder / "points.pvd")) == pytest.approx([0, 0.06, 0.12, 0.14])
    assert list(index(folder / "grid.pvd")) == pytest.approx([0.06, 0.12, 0.14])


def test_points_are_read_back_as_they_were(written):
    _, folder, states = written
    for (file,), k in zip(index(folder / "points.pvd").values(), (0, 3, 6, 7), strict=True):
        points, stress = states[k][:2]
        mesh = meshio.read(file)
        data = {name: rows for name, (rows,) in mesh.cell_data.items()}
        out_of_plane = np.zeros(len(points))
        corners = np.sort(mesh.points[mesh.cells[0].data][:, :, :2], axis=1)
        assert corners == pytest.approx(np.sort(points.corners, axis=1), abs=1e-15)
        expected = {name: getattr(points, name) for name in ("id", "material", "pressure", "J")}
        expected |= {"F_xx": points.F[:, 0, 0], "F_xy": points.F[:, 0, 1], "F_yx": points.F[:, 1, 0]}
        expected |= {"effective_stress_xy": stress[:, 0, 1], "effective_stress_yy": stress[:, 1, 1]}
        expected |= {"displacement": np.column_stack([points.displacement, out_of_plane])}
        expected |= {"grains": 0.1 * points.id, "axis": np.tile([1.0, 2.0, 0.0], (len(points), 1))}
        for name, values in expected.items():
            assert np.array_equal(data[name], values), name


def test_the_cells_of_a_file_fill_the_body(written):
    _, folder, states = written
    for (file,), k in zip(index(folder / "points.pvd").values(), (0, 3, 6, 7), strict=True):
        mesh = meshio.read(file)
        assert mesh.cells[0].type == "quad"
        x = mesh.points[mesh.cells[0].data]
        a, b = x[:, 2] - x[:, 0], x[:, 3] - x[:, 1]
        area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2  # next to nothing for corners in a wrong order
        volume = states[k][0].volume0 * states[k][0].J
        assert area.min() > 0.5 * volume.min() and area.sum() == pytest.approx(volume.sum(), rel=1e-3 if k else 1e-12)


def test_domains_in_3d_are_hexahedra(tmp_path):
    simulation, _ = block()
    mpm.Writer(simulation, tmp_path)
    mesh = meshio.read(tmp_path / "points" / "000000.vtu")
    assert mesh.cells[0].type == "hexahedron" and "pressure" not in mesh.cell_data
    x = mesh.points[mesh.cells[0].data]
    e = x[:, [1, 3, 4]] - x[:, :1]
    assert np.linalg.det(e) == pytest.approx(simulation.points.volume0)
    for corner, sides in ((2, [0, 1]), (5, [0, 2]), (6, [0, 1, 2]), (7, [1, 2])):
        assert x[:, corner] - x[:, 0] == pytest.approx(e[:, sides].sum(axis=1)), "VTK numbers the corners otherwise"
    assert mesh.cell_data["F"][0].shape == (len(x), 9)


def test_fields_of_the_grid_are_read_back_as_they_were(written):
    simulation, folder, states = written
    for (file,), k in zip(index(folder / "grid.pvd").values(), (3, 6, 7), strict=True):
        found, (fill, held) = fields(file), states[k][2:]
        x = found["x"].reshape(-1, 3)[:, :2]
        middle = x[found["connectivity"].astype(int).reshape(-1, 4)].mean(axis=1)
        cells = simulation.grid.cell_number[: simulation.grid.num_owned]
        at = np.argsort(cells)[simulation.grid.number(simulation.grid.index(middle))]
        assert found["fill"] == pytest.approx(fill[at], rel=1e-12)
        names = {"pressure": held.pressure, "x_y": held.x[:, 1], "displacement_x": held.displacement[:, 0]}
        names |= {"stress_xy": held.stress[:, 0, 1], "effective_stress_yy": held.effective_stress[:, 1, 1]}
        for name, rows in names.items():
            everywhere = np.zeros(len(fill))
            everywhere[held.cell] = rows
            assert found[name] == pytest.approx(everywhere[at], rel=1e-12), name
        assert found["fill"].sum() * simulation.grid.cell_volume == pytest.approx(0.3, rel=1e-3)


def test_all_times_are_in_one_file(tmp_path, capsys):
    """Also if a body is removed between two times, and without h5py."""
    with_h5py()
    grid = mpm.Grid([0, -0.4], [1.4, 1.2], [7, 8])
    bodies = [mpm.box(grid, [0, y], [1, y + 0.4]) for y in (0, 0.4)]
    loads = [mpm.Traction("right", (0, -1e4))]
    scene = mpm.Simulation(grid, bodies, [mpm.Hencky(1e6, 1e6)], walls={"left": "xy"}, conditions=loads)
    scene.run(1, 1, observe=mpm.Writer(scene, tmp_path))
    scene.stage(remove=[1])
    after = scene.run(2, 1, observe=mpm.Writer(scene, tmp_path))
    main(["one-file", str(tmp_path)])
    assert capsys.readouterr().out == f"{tmp_path / 'points.xdmf'}\n" and after.converged
    files = index(tmp_path / "points.pvd")
    with meshio.xdmf.TimeSeriesReader(tmp_path / "points.xdmf") as series:
        assert series.num_steps == len(files) == 3
        for k, (t, (file,)) in enumerate(files.items()):
            mesh, series.mesh_grid = meshio.read(file), series.collection[k]
            x, cells = series.read_points_cells()
            found = series.read_data(k)
            assert np.array_equal(x, mesh.points) and np.array_equal(cells[0].data, mesh.cells[0].data)
            assert found[0] == t and found[2].keys() == mesh.cell_data.keys() > {"effective_stress_yy", "J"}
            assert all(np.array_equal(found[2][name], rows) for name, rows in mesh.cell_data.items())
    xpath = {"name": "2", "xpath": "/Xdmf/Domain/Grid"}
    with dolfinx.io.XDMFFile(MPI.COMM_SELF, str(tmp_path / "points.xdmf"), "r") as file:
        domains = file.read_mesh(dolfinx.mesh.GhostMode.none, **xpath)
    assert domains.topology.index_map(2).size_local == len(scene.points) < len(after.t) * len(bodies[0])
    assert domains.geometry.x[:, 1].min() == scene.points.corners[..., 1].min() < 0
    said = ElementTree.parse(tmp_path / "points.xdmf").iter("Information")
    assert {item.get("Name"): item.get("Value") for item in said}["displacement"].startswith("m, ")


def test_one_file_says_what_it_cannot_do(tmp_path, monkeypatch, capsys):
    with pytest.raises(ValueError, match=r"one_file: folder = .*: has no points\.pvd, must be the folder of a Writer"):
        mpm.one_file(tmp_path)
    (tmp_path / "points.pvd").touch()
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(SystemExit):
        main(["one-file", str(tmp_path)])
    assert "one_file: h5py: import of h5py halted; None in sys.modules; must be Debian's" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.xdmf"))


def test_the_table_holds_the_histories(written):
    simulation, folder, _ = written
    result, found = simulation.result, table(folder / "history.csv")
    assert np.array_equal(found["t"], result.t)
    assert np.array_equal(np.column_stack([found["p_min"], found["p_max"]]), result.pressure)
    assert np.array_equal(np.column_stack([found["ux_0"], found["uy_0"]]), np.array(result.displacement)[:, 0])
    for name in ("steps", "newton", "coupling", "cuts", "balance", "residual"):
        assert found[name][0] == 0 and found[name][-1] == getattr(result, name)
    assert (np.diff(found["wall"]) > 0).all()


def reactions(file, sides=("bottom", "top")):
    """Return the forces (rows, displacements, 2) of two prescribed displacements in a table."""
    found = table(file)
    return np.stack([[found[f"reaction_{axis}_displacement_{side}"] for axis in "xy"] for side in sides]).transpose(
        2, 0, 1
    )


def test_the_table_holds_the_forces_of_given_displacements(tmp_path):
    """The run is uninterrupted, resumed, or on two processes."""
    (simulation, writer), forces = sheared(tmp_path / "whole"), [np.zeros((2, 2))]
    simulation.run(1.0, 0.25, observe=[writer, lambda s: forces.append(s.reactions.array)])
    whole = reactions(tmp_path / "whole" / "history.csv")
    assert np.array_equal(whole, forces)
    assert whole.sum(axis=1) == pytest.approx(0, abs=1e-6 * np.abs(whole).max())  # foot and top balance
    assert np.abs(whole[1:]).min() > 1e4  # N/m

    simulation, writer = sheared(tmp_path / "parts")
    checkpoint = mpm.Checkpoint(tmp_path / "run.ckpt", every=2)
    simulation.run(0.5, 0.25, observe=writer, checkpoint=checkpoint)
    simulation, _ = sheared(tmp_path / "other")
    after = mpm.resume(simulation, checkpoint.file)
    writers = [mpm.Writer(simulation, tmp_path / name) for name in ("parts", "new")]
    simulation.run(1.0, 0.25, observe=writers, after=after)
    assert np.array_equal(reactions(tmp_path / "parts" / "history.csv"), whole)
    new = reactions(tmp_path / "new" / "history.csv")
    assert np.array_equal(new, whole[2:])

    mpirun(2, "mpi_output.py", str(tmp_path / "two"))
    assert reactions(tmp_path / "two" / "history.csv") == pytest.approx(whole, abs=1e-8 * np.abs(whole).max())


def test_forces_of_displacements_that_a_stage_sets_are_not_known_before_its_first_step(tmp_path):
    simulation, writer = sheared(tmp_path / "first")
    simulation.run(0.25, 0.25, observe=writer)
    simulation.stage()
    before = simulation.reactions.array
    simulation.run(0.5, 0.25, observe=mpm.Writer(simulation, tmp_path / "kept"))
    assert np.array_equal(reactions(tmp_path / "kept" / "history.csv")[0], before)
    sides = [mpm.Displacement(side, (0, 0)) for side in ("left", "right")]
    simulation.stage(conditions=sides, reset_displacement=True)
    simulation.run(0.75, 0.25, observe=mpm.Writer(simulation, tmp_path / "set"))
    found = reactions(tmp_path / "set" / "history.csv", ("left", "right"))
    assert np.isnan(found[0]).all() and np.isfinite(found[1]).all()


def test_an_interrupted_run_leaves_whole_files_which_another_continues(tmp_path):
    simulation, probe = beam(h=0.06)

    def interrupt(s):
        if s.t > 0.07:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulation.run(0.2, 0.02, probes=probe, observe=[mpm.Writer(simulation, tmp_path), interrupt])
    times = np.linspace(0, 0.08, 5)
    assert list(index(tmp_path / "points.pvd")) == pytest.approx(times)
    assert all(len(meshio.read(file).points) for (file,) in index(tmp_path / "points.pvd").values())
    file = tmp_path / "history.csv"
    assert table(file)["t"] == pytest.approx(times)
    file.write_text(file.read_text()[:-5])  # the last row is broken off
    simulation.run(0.1, 0.02, probes=probe, observe=mpm.Writer(simulation, tmp_path), after=simulation.result)
    assert list(index(tmp_path / "points.pvd")) == pytest.approx([*times, 0.1])
    assert table(file)["t"] == pytest.approx([*times[:4], 0.1])
    again, _ = beam(h=0.06)
    again.run(0.02, 0.02, observe=mpm.Writer(again, tmp_path))
    assert list(index(tmp_path / "points.pvd")) == list(table(file)["t"]) == [0.0, 0.02], "a new run begins anew"


def test_a_writer_made_before_the_run_was_resumed_harms_nothing(tmp_path):
    simulation, _ = beam(h=0.06)
    checkpoint = mpm.Checkpoint(tmp_path / "run.ckpt")
    simulation.run(0.04, 0.02, observe=mpm.Writer(simulation, tmp_path), checkpoint=checkpoint)
    other, probe = beam(h=0.06)
    early = mpm.Writer(other, tmp_path)
    after = mpm.resume(other, checkpoint.file)
    with pytest.raises(ValueError, match=r"writer: made at t = 0 s, but the run starts at t = 0\.04 s; must"):
        other.run(0.06, 0.02, observe=early, after=after)
    assert list(index(tmp_path / "points.pvd")) == list(table(tmp_path / "history.csv")["t"]) == [0.0, 0.02, 0.04]
    both = r"its columns are t, .*, p_max, the columns of the run are t, .*, p_max, x_0, y_0, ux_0, uy_0, p_0;"
    with pytest.raises(ValueError, match=both):
        other.run(0.08, 0.02, probes=probe, observe=mpm.Writer(other, tmp_path))
    with pytest.raises(ValueError, match="every = 0, must be an integer >= 1"):
        mpm.Writer(other, tmp_path, every=0)


def test_steps_checkpoints_and_resumptions_are_logged(tmp_path, caplog, monkeypatch):
    simulation, _ = cut_beam()
    monkeypatch.setattr(Report, "easy", property(lambda self: True, lambda self, value: None))  # few are allowed here
    checkpoint = mpm.Checkpoint(tmp_path / "run.ckpt")
    with caplog.at_level(logging.INFO, "mpm_dolfinx"):
        simulation.run(0.08, 0.02, checkpoint=checkpoint)
        mpm.resume(simulation, checkpoint.file)
    said = "\n".join(record.getMessage() for record in caplog.records if record.name == "mpm_dolfinx")
    assert said.count("step cut to") == simulation.result.cuts > 0
    assert said.count(f"checkpoint {checkpoint.file} written") == 4
    assert "step grows to 0.01 s" in said and "t = 0.08 s: resumed from" in said


@pytest.mark.parametrize("progress", [True, False])
def test_the_first_step_that_is_cut_is_named_without_being_asked_for(progress, caplog):
    simulation, _ = cut_beam()
    simulation.run(0.08, 0.02, progress=progress)
    said = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
    assert simulation.result.cuts > 1
    assert [("step cut to" in message, "level INFO" in message) for message in said] == [(True, True)] * progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_shows_on_a_terminal_and_nowhere_else(monkeypatch, capsys):
    simulation, _ = beam(h=0.06)
    simulation.run(0.02, 0.02)
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(logging.getLogger(), "handlers", [logging.StreamHandler(sys.stderr)])
    result = simulation.run(0.06, 0.02, observe=lambda s: logging.getLogger("mpm_dolfinx").warning("between"))
    assert "between" in re.split(r"[\r\n]", sys.stderr.getvalue()), "a message is not on a line of its own"
    shown = rf"100%.*t=0.06 s, steps={result.steps}, newton={result.newton}, coupling={result.coupling}"
    assert re.search(shown, sys.stderr.getvalue())
    monkeypatch.setattr(sys, "stderr", Terminal())
    simulation.run(0.08, 0.02, progress=False)
    assert sys.stderr.getvalue() == "" and capsys.readouterr().out == ""


def test_nothing_in_the_package_prints_but_the_command():
    for file in Path(mpm.__file__).parent.glob("*.py"):
        assert file.name == "__main__.py" or not re.search(r"\bprint\(", file.read_text()), file


def test_info_names_versions_and_solvers():
    done = subprocess.run([sys.executable, "-m", "mpm_dolfinx", "info"], capture_output=True, text=True)
    lines = dict(line.split(maxsplit=1) for line in done.stdout.splitlines())
    assert done.returncode == 0 and "not found" not in done.stdout
    assert lines["mpm_dolfinx"] == mpm.__version__ and lines["dolfinx"] == dolfinx.__version__
    assert lines["numpy"] == np.__version__ and "mumps" in lines["solvers"].split(", ")
    assert {"fenics-basix", "fenics-ffcx", "fenics-ufl", "PETSc", "petsc4py", "MPI", "Python"} <= lines.keys()


@pytest.mark.parametrize("arguments", [[], ["nonsense"], ["info", "more"]])
def test_nonsense_gets_the_usage(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("usage: python -m mpm_dolfinx ")


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    simulation, _ = beam(h=0.06)
    script = "import sys; from helpers import beam; import mpm_dolfinx as mpm; mpm.Writer(beam(h=0.06)[0], sys.argv[1])"
    here = {"cwd": Path(__file__).parent, "capture_output": True, "text": True}
    lock = "import fcntl, sys; fcntl.lockf(open(sys.argv[1], 'w'), fcntl.LOCK_EX | fcntl.LOCK_NB)"

    def held():
        return subprocess.run([sys.executable, "-c", lock, str(tmp_path / ".lock")], **here).returncode != 0

    with mpm.Writer(simulation, tmp_path) as writer:
        again = mpm.Writer(simulation, tmp_path)
        other = subprocess.run([sys.executable, "-c", script, str(tmp_path)], **here)
        assert other.returncode == 1 and "another run writes into it, must be a separate folder" in other.stderr
    assert writer.closed and held(), "one that is open holds the folder"
    del again
    assert not held()


def test_a_closed_writer_writes_no_more_and_another_goes_on(tmp_path):
    simulation, _ = beam(h=0.06)
    with mpm.Writer(simulation, tmp_path) as first:
        simulation.run(0.02, 0.02, observe=first)
    first.close()
    with pytest.raises(ValueError, match=f"{tmp_path} is closed, must be open"):
        simulation.run(0.04, 0.02, observe=first, after=simulation.result)
    with mpm.Writer(simulation, tmp_path) as second:
        simulation.run(0.06, 0.02, observe=second, after=simulation.result)
    assert list(index(tmp_path / "points.pvd")) == [0.0, 0.02, 0.06]


def test_points_are_shown_in_one_line_of_numbers():
    simulation, _ = beam(h=0.06)
    shown = repr(simulation.points)
    assert "\n" not in shown and len(shown) < 160
    assert re.match(rf"MaterialPoints\({len(simulation.points)} points in 2D, 0.3 m\^2 at rest, J 1 to 1, ", shown)


def test_tools_are_written_where_they_are(tmp_path):
    """A disc that moves down, and an invisible plate outside of the grid."""
    grid = mpm.Grid([0, 0], [1.0, 1.0], [8, 8])
    disc = mpm.Tool(mpm.Ball((0.5, 0.75), 0.25), displacement=lambda t: (0, -0.06 * t))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    soil, beside = mpm.Hencky(bulk=1e6, shear=6e5), mpm.Tool(mpm.HalfSpace((0, 1.5), (0, -1)))
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.5])], [soil], walls=walls, conditions=[disc, beside])
    s.run(1.0, 1.0, observe=mpm.Writer(s, tmp_path))
    files = index(tmp_path / "tools.pvd")
    assert list(files) == [0.0, 1.0]
    drawn = meshio.read(files[1.0][0])
    assert not drawn.cell_data["tool"][0].any()
    assert drawn.cell_data["force"][0] == pytest.approx(
        np.tile([*s.tool_forces.array[0, :2], 0.0], (len(drawn.cells[0]), 1))
    )
    r = np.linalg.norm(drawn.points[:, :2] - [0.5, 0.69], axis=1)
    assert r.max() == pytest.approx(0.25, rel=1e-6) and (r > 0.24).sum() > 16


@pytest.mark.parametrize("dim", [2, 3])
def test_tools_are_drawn_up_to_their_surface(dim):
    grid, up = mpm.Grid([0] * dim, [1.0] * dim, [8] * dim), np.eye(dim)[-1]
    edges = np.array(np.meshgrid(*[[0.0, 0.4]] * dim)).reshape(dim, -1).T
    drawn = mpm.Tool(mpm.Convex(edges), displacement=0.33 * up).drawn(grid, 0.0)
    assert drawn.min(axis=(0, 1)) == pytest.approx(0.33 * up, abs=1e-9)
    assert drawn.max(axis=(0, 1)) == pytest.approx(0.4 + 0.33 * up)
    assert volumes(drawn).sum() == pytest.approx(0.4**dim, rel=0.01)
