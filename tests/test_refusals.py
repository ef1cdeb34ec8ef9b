# SPDX-License-Identifier: MIT
"""Errors of user functions, wrong indices, files and contradictions give one line, and no data are lost."""

import resource
from dataclasses import dataclass

import numpy as np
import pytest
import ufl
from helpers import refused_in_one_line
from test_bad_input import BODY, GRID, NAN, WATER, law, run, sand, scene, sides, soil

import mpm_dolfinx as mpm
from mpm_dolfinx.bodies.bodies import check_different

UPPER = mpm.box(GRID, [0, 0.5], [0.5, 0.6])  # on BODY
LOAD = {"conditions": [mpm.Traction("top", -1e3)]}


def two(**options):
    return scene([BODY, UPPER], **options)


def wet(law=None, **options):
    conditions = [mpm.Drained("top"), *options.pop("conditions", LOAD["conditions"])]
    soils = [soil(conductivity=1e-4, conductivity_law=law)]
    return scene(materials=soils, fluid=WATER, conditions=conditions, **options)


def bad(*values):
    """Return a function that raises KeyError."""
    raise KeyError(f"no entry for {values[:1]}")


def steps(simulation, **options):
    return simulation.run(1.0, 0.25, progress=False, **options)


def file(text):
    """Return a case: a writer into a folder with a file of another program."""

    def make(folder):
        name, content = text
        (folder / name).write_text(content)
        mpm.Writer(scene(), folder)

    return make


def archive(**arrays):
    """Return a case: a checkpoint that is another archive of numpy."""

    def make(folder):
        np.savez(folder / "other.npz", **arrays)
        mpm.resume(scene(), folder / "other.npz")

    return make


def other_columns(folder):
    s = scene()
    writer = mpm.Writer(s, folder)
    s.run(1.0, 0.5, observe=writer, progress=False)
    s.run(2.0, 0.5, observe=writer, probes=mpm.probes([BODY], [[0.1, 0.3]]), progress=False)


@dataclass(frozen=True)
class Scaled(mpm.Hencky):
    scale: mpm.Field = 1.0

    @staticmethod
    def energy(F, bulk, shear, scale):
        return scale * mpm.Hencky.energy(F, bulk, shear)


@dataclass(frozen=True)
class Fibre(mpm.Hencky):
    along: mpm.Field = (1.0, 0.0, 0.0)

    @staticmethod
    def energy(F, bulk, shear, along):
        return mpm.Hencky.energy(F, bulk, shear) * ufl.inner(F * along, F * along)


ENERGY = mpm.Hencky.energy
APART = [mpm.box(GRID, [0, 0], [0.3, 0.5]), mpm.box(GRID, [0.6, 0], [0.9, 0.5])]
STEP = [mpm.box(GRID, [0, 0], [0.5, 0.5]), mpm.box(GRID, [0.5, 0], [0.9, 0.3])]

CASES = {
    # ---- functions of time and place: what is called, what the line names, what it says of the value
    "traction of no argument": (lambda: sides("Traction", "top", lambda: 1.0), "Traction(side='top'", "of ()"),
    "traction that raises": (lambda: steps(sides("Traction", "top", bad)), "value at t = 0.25 s", "KeyError"),
    "traction of nothing": (lambda: steps(sides("Traction", "top", lambda t: None)), "value at t = 0.25 s", "None"),
    "complex traction": (lambda: sides("Traction", "top", (0, 1j)), "Traction(side='top'", "1j"),
    "traction in words": (lambda: sides("Traction", "top", ("0", "1")), "Traction(side='top'", "'0'"),
    "plate that raises": (lambda: steps(sides("RigidPlate", "top", bad)), "RigidPlate(side='top'", "KeyError"),
    "gravity of no argument": (lambda: scene(gravity=lambda: (0, 1)), "gravity", "of ()"),
    "field that raises": (lambda: scene(materials=[soil(bulk=lambda X: X[:, 7])]), "Hencky: bulk", "IndexError"),
    "shape that raises": (lambda: mpm.shape(GRID, lambda x: x[:, 2] < 1), "body: inside(x)", "IndexError"),
    "shape of a distance": (lambda: mpm.shape(GRID, lambda x: x[:, 0] - 0.5), "body: inside(x)", "float64"),
    "shape that is no function": (lambda: mpm.shape(GRID, [1, 2]), "body: inside(x)", "not callable"),
    "map that is no function": (lambda: mpm.mapped(GRID, BODY, 3), "body: the map", "not callable"),
    # ---- laws
    "energy of nothing": (lambda: scene(materials=[law(energy=lambda F: None)]), "returns", "None"),
    "energy that is a tensor": (
        lambda: scene(materials=[law(energy=lambda F, bulk: bulk * F)]),
        "returns shape",
        "(2, 2)",
    ),
    "energy that raises": (lambda: scene(materials=[law(energy=lambda F: bad())]), "raises", "KeyError"),
    "energy without F": (lambda: scene(materials=[law(energy=lambda F, bulk: bulk)]), "depends on F", "returns"),
    "energy of numpy": (lambda: scene(materials=[law(energy=lambda F: np.linalg.det(F))]), "raises", "LinAlgError"),
    "energy of 3D in 2D": (
        lambda: scene(materials=[law(energy=lambda F: ufl.inner(F, ufl.Identity(3)))]),
        "raises",
        "Shapes do not match",
    ),
    "fibre of 3D in 2D": (lambda: scene(materials=[Fibre(1e6, 1e6)]), "Fibre.energy", "index of sizes 3 and 2"),
    "stress that is a number": (
        lambda: scene(materials=[law(kirchhoff=lambda F, bulk: bulk * ufl.tr(F))]),
        "returns shape",
        "()",
    ),
    "law with an energy and a stress": (
        lambda: scene(materials=[law(energy=ENERGY, kirchhoff=lambda F, bulk: bulk * F)]),
        "Law: defines both",
        "energy and kirchhoff",
    ),
    "constant of nan": (lambda: scene(materials=[Scaled(1e6, 1e6, scale=NAN)]), "Scaled: scale", "nan"),
    "constant in words": (lambda: scene(materials=[Scaled(1e6, 1e6, scale="two")]), "Scaled: scale", "two"),
    "field of nan in a law": (
        lambda: scene(materials=[Scaled(1e6, 1e6, scale=lambda X: NAN * X[:, 0])]),
        "Scaled: scale",
        "nan",
    ),
    "state in words": (lambda: scene(materials=[law(energy=ENERGY, state={"k": "a"})]), "Law: state 'k'", "'a'"),
    "state that is no dictionary": (
        lambda: run_law(update=lambda F, k: k, state={"k": 0.0}),
        "Law.update: its result",
        "must be a dict",
    ),
    "dilation above friction somewhere": (
        lambda: scene(materials=[sand(friction=lambda X: 10 + X[:, 0], dilation=20)]),
        "DruckerPrager: dilation",
        "= 20",
    ),
    "Biot coefficient below the porosity somewhere": (
        lambda: scene(materials=[soil(porosity=lambda X: 0.5 + X[:, 0], biot=0.3)]),
        "Hencky: biot",
        "= 0.3",
    ),
    # ---- conductivity laws, terms and sources
    "conductivity of nan": (lambda: steps(wet(lambda J: ufl.ln(J - 2))), "conductivity law: k", "= nan at"),
    "conductivity without end": (lambda: steps(wet(lambda J: 1 / (J - J))), "conductivity law: k", "inf"),
    "conductivity that is a tensor": (lambda: wet(lambda F: F), "returns shape", "(2, 2)"),
    "conductivity of nothing": (lambda: wet(lambda F: None), "returns", "None"),
    "conductivity that raises": (lambda: wet(lambda J: bad(J)), "raises", "KeyError"),
    "term that raises": (lambda: scene(terms=[lambda points: points.colour]), "raises", "not 'colour'"),
    "term that is a vector": (lambda: scene(terms=[lambda points, v: points.value(v) * points.dx]), "raises", "UFL"),
    "term over the grid": (lambda: scene(terms=[lambda u: ufl.inner(u, u) * ufl.dx]), "terms", "over the grid"),
    "term of neither": (lambda: scene(terms=[lambda points: points.F[0, 0] * points.dx]), "terms", "neither u nor v"),
    "term of v squared": (
        lambda: scene(terms=[lambda points, v: points.value(v)[0] ** 2 * points.dx]),
        "terms",
        "linear in v",
    ),
    "term alone": (lambda: scene(terms=lambda points: points.dx), "terms", "a list of functions"),
    "source alone": (lambda: wet(terms=mpm.Source(lambda points, q: q * points.dx)), "terms", "a list of functions"),
    "source on the grid's sides": (lambda: wet(terms=[mpm.Source(lambda q: q * ufl.ds)]), "sources", "over the grid"),
    "source of q squared": (
        lambda: wet(terms=[mpm.Source(lambda points, q: q * q * points.dx)]),
        "sources",
        "linear in q",
    ),
    # ---- grid, bodies, stages
    "grid for nobody": (lambda: mpm.Grid([0, 0], [1, 1], [2, 2], comm="world"), "grid: comm", "'world'"),
    "grid of too many cells": (lambda: mpm.Grid([0, 0], [1, 1], [10**6, 10**6]), "grid: cells", "1e+12"),
    "scene without a grid": (lambda: mpm.Simulation("grid", [BODY], [soil()], walls={}), "grid", "'grid'"),
    "box without a grid": (lambda: mpm.box(None, [0, 0], [1, 1]), "body: grid", "None"),
    "body of a larger grid": (
        lambda: scene([mpm.box(mpm.Grid([0, 0], [2, 2], [20, 20]), [0, 0], [2, 1])]),
        "body 0",
        "outside the grid",
    ),
    "true fluid": (lambda: scene(fluid=True), "fluid = True", "must be a Fluid"),
    "pressure without fluid": (lambda: scene(pressure=100.0), "pressure = 100.0", "needs a fluid"),
    "couplings": (lambda: scene(numerics=mpm.Numerics(coupling=["schur-cg"])), "coupling", "['schur-cg']"),
    "a number that is to come": (lambda: mpm.Later(1), "Later: body = 1", "must be a Body"),
    "an excavation of a number": (lambda: two().stage(remove=1), "stage: remove = 1", "must be a list"),
    "an excavation of a body": (lambda: two().stage(remove=[UPPER]), "stage: remove", "(0, 1), and listed once"),
    "a fill that comes twice": (
        lambda: scene([BODY, mpm.Later(UPPER)]).stage(add=[1, 1]),
        "stage: add: body 1",
        "(1), and listed once",
    ),
    "reset in words": (lambda: two().stage(reset_displacement="no"), "reset_displacement", "'no'"),
    "sides in a list": (lambda: sides("Traction", ["top", "left"], 1.0), "Traction: side = ", "['top', 'left']"),
    # ---- conditions that contradict each other
    "drained twice": (
        lambda: wet(conditions=[mpm.Drained("top"), mpm.Drained("top", 1e5, region=((0, 0), (0.3, 1)))]),
        "Drained(side='top'",
        "both act at",
    ),
    "drained where water is pressed in": (
        lambda: wet(conditions=[mpm.Inflow("top", 1.0)]),
        "Inflow(side='top'",
        "both act",
    ),
    "displaced to two places": (
        lambda: scene(conditions=[*(mpm.Displacement("top", (0, y)) for y in (0.1, 0.2))]),
        "Displacement(side='top'",
        "both act at",
    ),
    "a plate on two columns": (
        lambda: scene(APART, conditions=[mpm.RigidPlate("top", 1.0)]),
        "RigidPlate(side='top'",
        "are not connected at one height",
    ),
    "a plate on a step": (
        lambda: scene(STEP, conditions=[mpm.RigidPlate("top", 1.0)]),
        "RigidPlate(side='top'",
        "one flat",
    ),
    "a body that nothing holds beside one that is held": (
        lambda: steps(scene(APART)),
        "walls: the part at [0.65 0.05]",
        "3 of 3 modes",
    ),
    # ---- running
    "end in words": (lambda: run("1", 0.1), "t_end", "'1'"),
    "ends": (lambda: run(np.array([1.0, 2.0]), 0.1), "t_end", "array([1., 2.])"),
    "step in words": (lambda: run(1.0, "0.1"), "dt", "'0.1'"),
    "step to nowhere": (lambda: run(1.0, 1e-300), "dt", "= 1e-300"),
    "one step in words": (lambda: scene().step("1"), "dt", "'1'"),
    "to go on after a word": (lambda: run(after="before"), "after", "'before'"),
    "checkpoints in a list": (lambda: run(checkpoint=[mpm.Checkpoint("f")]), "checkpoint", "[Checkpoint("),
    "probes of a part of the scene": (lambda: run_two(mpm.probes([UPPER], [[0.1, 0.55]])), "probes", "1 bodies"),
    "probe in a body that has gone": (
        lambda: run_two(mpm.probes([BODY, UPPER], [[0.1, 0.55]]), remove=[1]),
        "probe at [0.1  0.55]",
        "body 1 is absent",
    ),
    "probes of a body alone": (lambda: mpm.probes(BODY, [[0.1, 0.3]]), "probes: bodies", "Body"),
    # ---- files
    "writer of a word": (lambda folder: mpm.Writer("scene", folder), "writer: simulation", "'scene'"),
    "writer to nothing": (lambda: mpm.Writer(scene(), None), "writer: folder", "None"),
    "writer every word": (lambda folder: mpm.Writer(scene(), folder, every="2"), "writer: every", "'2'"),
    "writer of a grid in words": (lambda folder: mpm.Writer(scene(), folder, grid="no"), "writer: grid", "'no'"),
    "writer of another scene": (
        lambda folder: run(observe=mpm.Writer(scene(), folder)),
        "writer",
        "another simulation",
    ),
    "writer over another index": (file(("points.pvd", "no XML")), "points.pvd", "no Writer's file"),
    "writer over another series": (file(("points.pvd", "<a><DataSet/></a>")), "points.pvd", "no Writer's file"),
    "writer over another table": (file(("history.csv", "a,b\n1,2\n")), "history.csv", "no Writer's file"),
    "writer of other columns": (other_columns, "history.csv", "ux_0"),
    "checkpoint to nothing": (lambda: mpm.Checkpoint(None), "checkpoint: file", "None"),
    "checkpoint to a folder": (lambda folder: mpm.Checkpoint(folder), "checkpoint: file", "is a folder"),
    "checkpoint from nothing": (lambda: mpm.resume(scene(), None), "checkpoint: file", "None"),
    "a state that is none": (lambda: run_from(None), "state = None", "a state of this simulation"),
    "a state of another scene": (lambda: run_from(scene().state), "state = State(t=0.0", "a state of this simulation"),
    "a plate's force that is nan": (
        lambda: steps(scene(conditions=[mpm.RigidPlate("top", lambda t: NAN)])),
        "RigidPlate(side='top'",
        "force at t = ",
    ),
    "safety of a word": (lambda: mpm.factor_of_safety("scene"), "simulation = 'scene'", "must be a Simulation"),
    "checkpoint into a word": (lambda: mpm.resume("scene", "file"), "simulation", "'scene'"),
    "another archive": (archive(a=np.zeros(3)), "other.npz", "checkpoint of mpm_dolfinx"),
    "a checkpoint without a note": (archive(format=np.array("mpm_dolfinx checkpoint")), "other.npz", "checkpoint of"),
    "a checkpoint without a version": (
        archive(format=np.array("mpm_dolfinx checkpoint"), note=np.array("{}")),
        "other.npz",
        "version None",
    ),
}


def run_law(**functions):
    steps(scene(materials=[law(energy=lambda F, bulk, shear, k: ENERGY(F, bulk, shear), **functions)]))


def run_from(state):
    s = scene()
    s.state = state
    steps(s)


def run_two(probes, **stage):
    s = two()
    s.stage(**stage)
    steps(s, probes=probes)


@pytest.mark.parametrize(("make", "name", "value"), CASES.values(), ids=CASES)
def test_one_line_names_the_object_the_value_and_what_is_allowed(make, name, value, tmp_path):
    refused_in_one_line(make, name, value, tmp_path, 500)


@pytest.mark.parametrize("options", [{}, LOAD], ids=["alone", "loaded"])
@pytest.mark.parametrize("fluid", [None, WATER], ids=["dry", "wet"])
def test_a_term_that_becomes_nan_is_no_convergence(options, fluid):
    def term(points, v, t):
        return ufl.ln(0.7 - t) * points.value(v)[0] * points.dx

    s = scene(terms=[term], fluid=fluid, **options)
    with pytest.raises(mpm.GaveUp, match="nan in the residual of the momentum") as caught:
        steps(s)
    assert 0.69 < s.t < 0.7 and np.isfinite(s.points.x).all() and caught.value.result.t[-1] == 0.5


@pytest.mark.parametrize(("value", "of"), [("nan", ufl.ln), ("inf", lambda left: 1 / ufl.max_value(left, 0.0))])
def test_a_source_that_is_no_longer_finite_is_no_convergence(value, of):
    s = wet(terms=[mpm.Source(lambda points, q, t: 1e-6 * of(0.7 - t) * q * points.dx)])
    with pytest.raises(mpm.GaveUp, match=f"{value} in the residual of the storage, from a source"):
        steps(s)
    assert 0.69 < s.t < 0.7 and np.isfinite(s.points.pressure).all()


def test_a_state_that_becomes_nan_is_not_kept():
    def grow(k):
        return {"k": ufl.ln(k - 1.5)}  # 1, then nothing

    material = law(energy=lambda F, bulk, shear, k: ENERGY(F, bulk, shear), state={"k": 4.0}, update=grow)
    s = scene(materials=[material], conditions=[mpm.Traction("top", -1e-3)])
    with pytest.raises(mpm.GaveUp, match=r"Law.update: 'k' is not finite at \["):
        steps(s)
    assert s.t == 0.25 and s.points.data["k"] == pytest.approx(np.log(2.5))


@pytest.fixture
def small_disk():
    """Return a function that limits the size of files, as a full disk does."""
    size, most = resource.getrlimit(resource.RLIMIT_FSIZE)  # Python ignores SIGXFSZ
    yield lambda limit=size: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, most))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of zipfile, which fails twice
@pytest.mark.parametrize("what", ["points", "grid", "checkpoint"])
def test_a_full_disk_loses_nothing(what, tmp_path, small_disk):
    grid = mpm.Grid([0, 0], [1.0, 1.0], [60, 60]) if what == "grid" else GRID  # the grid's file is the larger one
    s = scene([mpm.box(grid, [0, 0.2], [0.1, 0.4])], grid=grid, **LOAD)
    checkpoint = mpm.Checkpoint(tmp_path / "run.ckpt")
    observer = checkpoint if what == "checkpoint" else mpm.Writer(s, tmp_path, grid=what == "grid")
    steps_so_far = s.run(0.5, 0.25, observe=observer, progress=False)
    whole = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    small_disk({"points": 1000, "grid": 100_000, "checkpoint": 1000}[what])
    with pytest.raises(OSError, match=r"(writer|checkpoint) at t = 0.75 s: .* free space; .* continues the run"):
        s.run(1.0, 0.25, observe=observer, progress=False, after=steps_so_far)
    assert s.t == 0.75 and all(path.exists() for path in whole)
    if what == "checkpoint":
        assert mpm.resume(scene([mpm.box(grid, [0, 0.2], [0.1, 0.4])], **LOAD), checkpoint.file).t[-1] == 0.5
    small_disk()
    result = s.run(1.0, 0.25, observe=observer, progress=False, after=s.result)
    assert result.t.tolist() == [0, 0.25, 0.5, 0.75, 1] and result.converged


@pytest.mark.parametrize(
    "make", [lambda f: mpm.Writer(scene(), f / "file" / "folder"), lambda f: mpm.resume(scene(), f)]
)
def test_a_path_that_cannot_be_names_the_object_and_the_path(make, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match=r"(writer|resume): .* must be .*/") as caught:
        make(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("body", [BODY, mpm.mapped(GRID, BODY, lambda x: 1.1 * x)], ids=["box", "mapped"])
def test_a_body_that_is_named_twice_is_refused(body):
    check_different([body, UPPER, mpm.box(GRID, [0, 0.2], [0.5, 0.5])])  # as large and in the same place: to come later
    with pytest.raises(ValueError, match=r"^bodies 0 and 2: are the same object, must be two[^\n]*$"):
        check_different([body, UPPER, body])


def test_conditions_bodies_and_probes_equal_only_themselves():
    """Values may be arrays or functions; `in`, `index` and dictionaries need equality and a hash."""
    load, region = np.array([0.0, -1.0]), np.array([[0.0, 0.0], [1.0, 1.0]])
    makes = {
        "Traction": lambda: mpm.Traction("top", load, region),
        "Displacement": lambda: mpm.Displacement("top", load, region=region),
        "Drained": lambda: mpm.Drained("top", region=region),
        "Inflow": lambda: mpm.Inflow("top", 1.0, region),
        "RigidPlate": lambda: mpm.RigidPlate("top", 1.0, region),
        "Body": lambda: mpm.box(GRID, [0, 0], [1, 1]),
        "Probes": lambda: mpm.probes([BODY], [[0.1, 0.3]]),
    }
    for name, make in makes.items():
        one, other = make(), make()
        assert one == one and one != other and [other, one].index(one) == 1 and {one: name}[one] == name


def test_a_result_is_shown_in_a_line():
    assert len(repr(run(1.0, 0.01))) < 400


def test_mapped_bodies_are_not_integrated_at_points():
    """Their domains would be boxes from the first step on, while displacements count from the seeded positions."""
    grid = mpm.Grid([0, 0], [1.0, 1.0], [4, 4])
    body = mpm.mapped(grid, mpm.box(grid, [0, 0], [0.5, 0.5]), lambda x: x + 0.1 * x[:, ::-1])
    with pytest.raises(ValueError, match=r"body 0 is mapped or a mesh, must be a box along the grid"):
        mpm.Simulation(
            grid,
            [body],
            [mpm.Hencky(bulk=1e6, shear=1e6)],
            walls={"bottom": "xy"},
            numerics=mpm.Numerics(quadrature="point"),
        )


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (lambda: mpm.Hencky(E=1e7, nu=0.3), TypeError, r"bulk = E / \(3 - 6 nu\) and shear = E / \(2 \+ 2 nu\)"),
        (lambda: wet(lambda conductivity, J: conductivity * np.exp(J)), ValueError, "ufl.exp and the like in place of"),
        (lambda: scene(BODY), ValueError, "^bodies = a single LatticeBody, must be a list"),
        (lambda: scene().points.position, AttributeError, "'position', must be one of id, .* x, .* J, displacement"),
        (lambda: scene().points.velocity, AttributeError, "'velocity', must be one of id, .* velocity .with inertia."),
    ],
    ids=["Young's modulus", "numpy in a law", "a body without a list", "an unknown field of points", "no inertia"],
)
def test_messages_tell_the_right_spelling(make, error, said):
    with pytest.raises(error, match=said):
        make()
