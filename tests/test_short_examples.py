# SPDX-License-Identifier: MIT
"""Each short example runs unchanged, is short, and prints the value of theory or of finer cells."""

import contextlib
import io
import os
import re
import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
import pytest

DEMOS = Path(__file__).parent.parent / "demos"
SHORT = {path.stem: path for path in sorted((DEMOS / "short").glob("*.py"))}
NEEDS = {"gmsh": ("polygon(", "import gmsh"), "pandas": ("to_dataframe",), "h5py": ("one_file(",)}
LONG = {"excavation", "gel_indentation", "landslide", "slope_in_rain", "slope_stability", "t_bar"}


def consolidation():
    """Terzaghi's settlement, mm, of 10 m after two years."""
    stiffness = 4e6 + 4 / 3 * 3e6
    T = 1e-9 * stiffness / 9810 * 2 * 3.156e7 / 10**2
    odd = np.arange(1, 200, 2) * np.pi / 2
    return 1000 * 5e4 * 10 / stiffness * (1 - np.sum(2 / odd**2 * np.exp(-(odd**2) * T)))


def embankment():
    """Settlement, m, of 3 m of clay in the middle of a much wider bank: confined compression by the weight."""
    weight = 2 * 9.81 * (0.7 * 2650 + 0.3 * 1000)
    return 3 * weight / (1.5e6 + 4 / 3 * 7e5)


def export():
    """Deflection, mm, of Timoshenko's beam in plane strain."""
    bulk, shear = 2e6, 1e6
    plane = 4 * shear * (bulk + shear / 3) / (bulk + 4 / 3 * shear)  # Pa: E / (1 - nu^2)
    load, length, height = 500 * 0.3, 2.0, 0.3
    return 1000 * load * (length**3 / (3 * plane * height**3 / 12) + length / (5 / 6 * shear * height))


def mesh_from_gmsh():
    """Lamé's displacement, mm, of the inner wall."""
    a, b, p, bulk, shear = 0.5, 1.0, 1e4, 2e6, 1e6
    poisson = (3 * bulk - 2 * shear) / (6 * bulk + 2 * shear)
    return 1000 * p * a / (2 * shear) / (b**2 / a**2 - 1) * (1 - 2 * poisson + b**2 / a**2)


def own_law():
    """Force, N/m, of the law in confined compression."""
    stretch = 0.9
    E = (stretch**2 - 1) / 2
    return -2 * 1e4 * E * stretch * np.exp(20 * E**2)


def retaining_wall():
    """Rankine's active thrust, kN/m."""
    K, weight, height, cohesion = 1 / 3, 0.6 * 2650 * 9.81, 3.0, 100
    return (K * weight * height**2 / 2 - 2 * cohesion * height * np.sqrt(K)) / 1000


WANTED = {  # number, and relative tolerance
    "consolidation": (consolidation(), 3e-3),
    "embankment": (embankment(), 0.03),
    "excavation": (0.94, 0.02),  # cells of half the size, m^2 a day
    "export": (export(), 0.01),
    "footing": (2 + np.pi, 0.03),  # Prandtl
    "gel_indentation": (0.2, 0.04),  # of the gel's moduli
    "landslide": (6.6, 0.05),  # cells and steps of half the size
    "mesh_from_gmsh": (mesh_from_gmsh(), 0.01),
    "mesh_from_meshio": (12 * 0.6 * 2650 * 9.81 / 1000, 1e-4),  # area times unit weight
    "own_law": (own_law(), 1e-3),
    "own_term": (1000 * 3e4 / 2e6, 1e-3),  # pressure over stiffness
    "restart": (0.0, 0.0),  # the same bits
    "retaining_wall": (retaining_wall(), 0.03),
    "seepage": (86400 * 1e-6 * (8**2 - 2**2) / 20, 0.015),  # Dupuit and Charny
    "sliding_blocks": (0.3, 0.005),  # its coefficient
    "slope_in_rain": (1.57, 0.05),  # cells and steps of half the size
    "slope_stability": (1.368, 0.03),  # the best log-spiral mechanism
    "t_bar": (4 * np.sqrt(2) + 2 * np.pi, 0.03),  # Randolph and Houlsby
    "tool_from_stl": (0.8 * 0.6 * 0.4 * 0.6 * 2650 * 9.81 / 1000, 1e-3),  # volume times unit weight, kN
    "triaxial": (1.2 / 2 * 100 * (1.5 / 2) ** 0.8, 2e-3),  # M / 2 p (OCR / 2)^(1 - kappa / lambda), kPa
}
ON_PROCESSES = {"processes"}


@cache
def ran(name):
    """Run an example in its own folder, and return its printed text, its variables, and its pictures."""
    for module, signs in NEEDS.items():
        if any(sign in SHORT[name].read_text() for sign in signs):
            pytest.importorskip(module)
    printed = io.StringIO()
    with TemporaryDirectory() as folder, contextlib.chdir(folder), contextlib.redirect_stdout(printed):
        variables = runpy.run_path(str(SHORT[name]))
        pictures = {path.name for path in Path(folder).glob("*.png")}
    plt.close("all")
    return printed.getvalue(), variables, pictures


def number(text):
    """Return the number after the colon of the printed line of an example."""
    (line,) = text.strip().splitlines()
    return float(line.partition(": ")[2].split()[0].rstrip(","))


def test_every_short_example_is_checked_and_in_the_gallery():
    assert {*SHORT} == {*WANTED, *ON_PROCESSES} and len(SHORT) >= 14
    gallery = (DEMOS / "README.md").read_text()
    for name in SHORT:
        assert f"(short/{name}.py)" in gallery, name


def test_pictures_of_the_gallery_are_small_and_those_that_examples_write():
    written = {name for path in SHORT.values() for name in re.findall(r"\w+\.png", path.read_text())}
    kept = {path.name: path.stat().st_size for path in (DEMOS / "pictures" / "short").iterdir()}
    assert written == {*kept} and max(kept.values()) <= 100e3
    assert {*re.findall(r"pictures/short/(\w+\.png)", (DEMOS / "README.md").read_text())} == written


@pytest.mark.parametrize("name", SHORT)
def test_it_is_short_and_stands_alone(name):
    text = SHORT[name].read_text()
    assert 15 <= len(text.splitlines()) <= 40
    assert "common" not in text and text.count("print(") == 1


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in LONG else []) for n in WANTED])
def test_it_prints_the_number_of_theory_or_of_finer_cells(name):
    printed, _, pictures = ran(name)
    wanted, tolerance = WANTED[name]
    assert number(printed) == pytest.approx(wanted, rel=tolerance, abs=0)
    drawn = {f"{name}.png"} & {*re.findall(r"\w+\.png", SHORT[name].read_text())}
    assert pictures == drawn


def test_two_processes_print_what_one_prints(tmp_path):
    (name,) = ON_PROCESSES
    done = subprocess.run(
        ["mpirun", "-n", "2", sys.executable, "-m", "mpi4py", str(SHORT[name])],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(DEMOS.parent)},
        cwd=tmp_path,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    one, two = number(ran(name)[0]), number(done.stdout)
    assert one > 1 and two == pytest.approx(one, rel=1e-6)


@pytest.mark.slow
def test_water_that_is_pumped_from_the_excavation_comes_from_far():
    flows = ran("excavation")[1]["simulation"].outflows
    assert flows["far"] == pytest.approx(-flows["pit"], rel=0.01)


@pytest.mark.slow
def test_the_landslide_loses_what_its_weight_gives_up():
    energies = ran("landslide")[1]["simulation"].result.energies
    total = sum(energies[name] for name in ("kinetic", "elastic", "dissipated")) - energies["external"]
    assert np.abs(total - total[0]).max() < 0.03 * energies["external"][-1]
    assert energies["kinetic"][-1] < 0.01 * energies["kinetic"].max()  # at rest


@pytest.mark.slow
def test_rain_soaks_into_the_slope_and_weakens_it():
    printed, variables, _ = ran("slope_in_rain")
    after, before = map(float, re.findall(r"\d\.\d+", printed))
    assert 2.00 == pytest.approx(before, rel=0.05) and after < 0.9 * before  # cells of half the size
    s = variables["simulation"]
    fallen = 4e-6 * 24 * 3600 * (6 + np.hypot(8, 5) + 6)  # m^2, onto crest, slope and foot
    infiltrated, ran_off = -sum(s.outcome("flowed").array), sum(s.outcome("ran_off").array)
    assert infiltrated + ran_off == pytest.approx(fallen, rel=1e-3) and infiltrated > 0.5 * fallen
