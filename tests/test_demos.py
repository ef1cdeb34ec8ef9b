# SPDX-License-Identifier: MIT
"""Every demo runs at quick settings, writes its pictures and prints its results as JSON."""

import contextlib
import io
import json
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).parent.parent
QUICK = {
    "poroelastic_beam": (
        "--h 0.06 --t-end 0.02 --reference --paraview",
        [
            "pressure.png",
            "deflection.png",
            "tip.csv",
            *(f"paraview/{n}" for n in ("points.pvd", "grid.pvd", "history.csv")),
        ],
    ),
    "terzaghi": ("--cells 10 --steps 20", ["terzaghi.png"]),
    "self_weight_column": ("--cells 16", ["self_weight_column.png"]),
    "error_vs_runtime": ("--quick --cases column", ["error_vs_runtime_column.png", "runs.csv", "comparison.md"]),
    "mandel": ("--cells 8 --steps 5", ["mandel.png"]),
    "coupling_iterations": ("--quick --h 0.06", ["iterations.png", "iterations.csv", "iterations.md", "roughness.md"]),
    "small_steps": ("--cells 10 --steps 1 10 40 --strip-cells 10", ["small_steps.png", "small_steps_strip.png"]),
    "cantilever_3d": ("--cells 2 --steps 2 4", ["cantilever_3d.png"]),
    "image": ("--pixels 12", ["image.png"]),
    "strip": ("--cells 8 --steps 4", ["strip.png"]),
    "cryer": ("--cells 4 --steps 6", ["cryer.png"]),
    "cantilever": ("--cells 2 --steps 20", ["cantilever.png"]),
    "cycles": ("--h 0.1 --cycles 2 --undrained 2 --turn 0.25 --steps 4", ["cycles.png", "cycles.csv"]),
    "quadrature": ("--h 0.05 --steps 5 10", ["quadrature.png", "tip.csv"]),
    "extending_with_ufl": ("--cells 8", ["extending_with_ufl.png"]),
    "extreme_cases": (
        "--quick --families filling overload",
        ["extreme_cases.png", "cases.csv", "cases.md", "summary.md"],
    ),
    "slump": ("--cells 6 --steps 20", ["slump.png", "failure.png", "slump.gif"]),
    "triaxial": ("--steps 20", ["triaxial.png"]),
    "cavity": ("--cells 4 --cases well --ratios 2", ["cavity.png"]),
    "indentation": ("--cells 6", ["indentation.png"]),
    "penetration": ("--cells 4 --rough 0.5 --depth 0.1 --wet-depth 0.05", ["penetration.png"]),
    "cone": ("--cells 2 --depth 0.5 --wet-depth 2", ["cone.png"]),
    "retaining_wall": ("--cells 6 --delta 0 --ways active", ["retaining_wall.png"]),
    "barrier": ("--cells 5 --steps 20", ["barrier.png"]),
    "slope": ("--cells 4 --steps 4 --rtol 0.1", ["slope.png"]),
    "landslide": ("--cells 4 --dt 0.2", ["landslide.png"]),
    "collapse": ("--aspects 0.5 --finer 0.5 --steps 13", ["collapse.png"]),
    "falling": ("--cells 3 --dt 0.02", ["falling.png"]),
    "infiltration": ("--cells 10 --rain-step 1800 --front-step 3600", ["infiltration.png"]),
    "drainage": ("--cells 10 --step 120", ["drainage.png"]),
    "rain": ("--cells 10 --step 7200", ["rain.png"]),
    "water_table": ("--h 0.25 --step 1800", ["water_table.png"]),
    "vibration": ("--h 0.1 --cells 8 --periods 1 --steps 16", ["vibration.png"]),
    "wave": ("--cells 8 --steps 10 --periods 2", ["wave.png"]),
    "shaking": ("--cells 4 --steps 60 --bank-cells 4 --bank-steps 20", ["shaking.png"]),
    "dam": ("--h 1 --steps 1 --cells 10", ["dam.png"]),
    "two_gels": ("--cells 4 --hertz 4", ["two_gels.png"]),
    "embankment": ("--h 1 --steps 1", ["embankment.png"]),
    "footing": ("--cells 3 --depth 0.1", ["footing.png", "footing.gif"]),
    "benchmark_beam": ("--h 0.05 --t-end 0.1 --repeat 1", []),
    "benchmark_pruning": ("--quick", ["pruning.md"]),
    "calibrate": ("--quick", ["calibration.md"]),
    "scaling": ("--quick --dims 2 --processes 1 2", ["scaling.png", "scaling.csv", "scaling.md"]),
}
# what they show has tests of its own, or takes long to compile
LONG = {"slump", "water_table", "cavity", "footing", "slope", "image", "falling", "landslide", "vibration", "wave"}
LONG |= {"collapse", "cone", "shaking", "barrier", "penetration", "cycles", "dam", "small_steps", "indentation"}


def run(demo, arguments):
    """Run a demo as its command line does, but in this process, which starts once for all demos."""
    out, err, given = io.StringIO(), io.StringIO(), sys.argv
    file = ROOT / "demos" / f"{demo}.py"
    sys.argv, returncode = [str(file), *arguments.split()], 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            runpy.run_path(str(file), run_name="__main__")
    except SystemExit as end:
        returncode = end.code
        if isinstance(end.code, str):
            returncode = 1
            print(end.code, file=err)
    finally:
        sys.argv = given
        plt.close("all")
    return SimpleNamespace(returncode=returncode, stdout=out.getvalue(), stderr=err.getvalue())


def test_every_demo_is_run():
    assert {p.stem for p in (ROOT / "demos").glob("*.py")} == {*QUICK, "tutorial", "tables", "common"}


def test_pictures_of_the_pages_are_those_of_one_demo():
    drawn = [file for _, files in QUICK.values() for file in files if file.endswith(("png", "gif"))]
    assert len(drawn) == len({*drawn})


def test_the_tutorial_s_assertions_hold(tmp_path):
    done = run("tutorial", f"--out {tmp_path}")
    assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "cut_domain.png").exists()


@pytest.mark.parametrize("demo", [pytest.param(d, marks=[pytest.mark.slow] if d in LONG else []) for d in QUICK])
def test_the_demo_runs(demo, tmp_path):
    if demo == "embankment":
        pytest.importorskip("gmsh")
    arguments, files = QUICK[demo]
    done = run(demo, f"{arguments} --json" + (f" --out {tmp_path}" if files else ""))
    assert done.returncode == 0, done.stderr[-3000:]
    assert json.loads(done.stdout.splitlines()[-1])["converged"]
    for file in files:
        assert (tmp_path / file).stat().st_size > 100


def test_the_beam_prints_all_that_it_promises(tmp_path):
    done = run("poroelastic_beam", f"--h 0.05 --t-end 0.06 --json --out {tmp_path}")
    out = json.loads(done.stdout.splitlines()[-1])
    assert len(out["tip"]) == 3 and len(out["tip"][0]) == 3 and len(out["p_range"][0]) == 3
    assert out["steps"] == 3 and out["points"] == 40 * 12 and out["active_cells"] > 100
    assert out["fluid_balance"] <= 1e-8 and out["wall_s"] > 0 and out["jit_s"] > 0
    assert out["newton_iterations"] > 2 and out["coupling_iterations"] > 2


def test_the_beam_says_how_too_small_a_beta_fails_and_keeps_its_results(tmp_path):
    done = run("poroelastic_beam", f"--h 0.05 --t-end 0.06 --json --coupling fixed-stress-fluid --out {tmp_path}")
    assert done.returncode == 1
    assert "the fixed-stress-fluid iteration diverges (beta is below alpha^2 / (2 K_dr))" in done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["converged"] is False


def test_the_beam_prints_where_the_time_went(tmp_path):
    done = run("poroelastic_beam", f"--h 0.05 --t-end 0.06 --profile --out {tmp_path}")
    shares = [float(line.split()[-2]) for line in done.stdout.splitlines() if line.endswith("%")]
    assert len(shares) > 8 and sum(shares) == pytest.approx(100, abs=1) and min(shares) >= 0


@pytest.mark.parametrize("option", ["--bulk -1", "--porosity 1.5", "--conductivity=-1e-4", "--points-per-cell 0"])
def test_the_beam_refuses_bad_constants_in_one_line(option):
    done = run("poroelastic_beam", option)
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1 and "must be" in done.stderr


@pytest.mark.parametrize("option", ["--h 0", "--dt -1", "--load 0"])
def test_the_beam_refuses_bad_options_in_one_line(option):
    done = run("poroelastic_beam", option)
    assert done.returncode == 2 and done.stderr.splitlines()[-1].endswith("must be > 0")
