# SPDX-License-Identifier: MIT
"""Element tests: closed forms of elastic and plastic soil, fixed components, refusals, and the command."""

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx import element_test
from mpm_dolfinx.__main__ import main

ELASTIC = mpm.Hencky(bulk=2e7, shear=1e7)
SAND = mpm.DruckerPrager(bulk=2e7, shear=1e7, friction=30.0, dilation=10.0, cohesion=2e3, match="compression")


def test_elastic_tests_are_exact():
    """tau = K tr(eps) I + 2G dev eps of logarithmic strains; Hencky's energy separates equal stretches by 1e-4."""
    K, G, e = ELASTIC.bulk, ELASTIC.shear, 0.1
    r = element_test(ELASTIC, "oedometer", e, steps=5)
    assert r.stress[-1] == pytest.approx(-np.diag([K - 2 / 3 * G] * 2 + [K + 4 / 3 * G]) * e * np.exp(e), rel=2e-7)
    r = element_test(ELASTIC, "triaxial drained", e, steps=5)
    young = 9 * K * G / (3 * K + G)
    assert r.stress[-1, 2, 2] == pytest.approx(-young * e * np.exp(r.volume_strain[-1]), rel=2e-7)
    assert r.volume_strain[-1] == pytest.approx(young * e / (3 * K), rel=2e-7)
    r = element_test(ELASTIC, "triaxial undrained", e, steps=5)
    assert r.q[-1] == pytest.approx(3 * G * e, rel=2e-7) and r.pressure[-1] == pytest.approx(G * e, rel=2e-7)
    r = element_test(ELASTIC, "isotropic", e, steps=5)
    assert r.p[-1] == pytest.approx(3 * K * e * np.exp(3 * e), rel=2e-7)
    r = element_test(ELASTIC, "shear undrained", 1e-4, steps=5)
    assert r.stress[-1, 0, 1] == pytest.approx(1e-4 * G, rel=1e-6)


def test_plastic_tests_reach_the_strength_that_is_given():
    p = 1e5
    r = element_test(SAND, "triaxial drained", 0.05, steps=20, confinement=p)
    s = np.sin(np.radians(30))
    axial = -p * (1 + s) / (1 - s) - 2 * SAND.cohesion * np.cos(np.radians(30)) / (1 - s)
    volume = np.linalg.det(r.F[-1])  # it yields in Kirchhoff stress: the cohesion over J
    axial += 2 * SAND.cohesion * np.cos(np.radians(30)) / (1 - s) * (1 - 1 / volume)
    assert r.stress[-1, 2, 2] == pytest.approx(axial, rel=1e-8)
    assert r.stress[:, 0, 0] == pytest.approx(-p, rel=1e-9) and r.stress[:, 1, 1] == pytest.approx(-p, rel=1e-9)
    assert r.volume_strain[-1] < r.volume_strain.max() - 1e-3, "it dilates"
    undrained = element_test(SAND, "triaxial undrained", 0.05, steps=20, confinement=p)
    J = np.linalg.det(undrained.F)
    assert pytest.approx(J[0], rel=1e-12) == J and undrained.pressure[-1] < 0
    shear = element_test(SAND, "shear drained", [0.05, -0.05], steps=20, confinement=p)
    assert shear.stress[:, 1, 1] == pytest.approx(-p, rel=1e-9)
    assert shear.stress[20, 0, 1] > 0 > shear.stress[40, 0, 1]


def test_the_end_does_not_depend_on_the_steps_where_flow_is_in_proportion():
    ends = [element_test(SAND, "oedometer", 0.05, steps=steps).stress[-1] for steps in (1, 7)]
    assert ends[0] == pytest.approx(ends[1], rel=1e-9, abs=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((ELASTIC, "triaxial", 0.1), "test = 'triaxial', must be one of isotropic, oedometer"),
        ((ELASTIC, "oedometer", np.nan), "strain = nan, must be a finite number"),
        ((mpm.Hencky(bulk=lambda X: 1.0, shear=1.0), "oedometer", 0.1), "Hencky: bulk is a function, must be a number"),
        (("clay", "oedometer", 0.1), "material = 'clay', must be a Skeleton"),
    ],
)
def test_one_line_says_what_is_wrong(arguments, message):
    with pytest.raises(ValueError, match=message):
        element_test(*arguments)


def test_the_command_prints_and_draws(tmp_path, capsys):
    constants = ["M=1.2", "lambda_=0.07", "kappa=0.01", "shear=3e6", "initial_stress=-1e5,-1e5,-1e5"]
    file = tmp_path / "path.png"
    main(
        ["element-test", "ModifiedCamClay", "triaxial drained", "0.1", *constants, "--steps", "20", "--draw", str(file)]
    )
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert len(rows) == 21 and float(rows[0][1]) == pytest.approx(1e5) and file.stat().st_size > 1000
    with pytest.raises(SystemExit):
        main(["element-test", "ModifiedCamClay", "oedometer", "0.1", "shear=3e6"])
    assert "M is not given" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["CamClay", "oedometer", "0.1"], "law = 'CamClay', must be one of BarcelonaBasic, DruckerPrager, "),
        (["laws.py:Clay", "oedometer", "0.1"], "law = 'laws.py:Clay': there is no file laws.py"),
        (["Hencky", "oedometer", "10%"], "strain = '10%', must be a number"),
        (["Hencky", "oedometer", "0.1", "shear=3MPa"], "Hencky: shear = '3MPa', must be a number"),
        (["Hencky", "oedometer", "0.1", "shear"], "Hencky: 'shear' must be name=value, name one of bulk, shear, "),
        (["Hencky", "oedometer", "0.1", "G=3e6"], "Hencky: 'G=3e6' must be name=value"),
        (["Hencky", "oedometer", "0.1", "shear=3e6", "shear=4e6"], "Hencky: 'shear=4e6' is given twice"),
        (["Hencky", "oedometer", "0.1", "shear=3e6"], "Hencky: bulk is not given"),
        (["Hencky", "oedometer", "0.1", "--draw", "nowhere/a.png"], "--draw nowhere/a.png: there is no folder nowhere"),
    ],
)
def test_the_command_says_in_a_line_what_is_wrong(arguments, message, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["element-test", *arguments])
    assert message in capsys.readouterr().err


def test_the_command_drives_a_law_of_the_user(tmp_path, capsys):
    file = tmp_path / "soil.py"
    file.write_text("import mpm_dolfinx\n\nclass Own(mpm_dolfinx.Hencky):\n    pass\n")
    ends = []
    for law in ("Hencky", f"{file}:Own"):
        main(["element-test", law, "oedometer", "0.1", "bulk=2e7", "shear=1e7", "--steps", "1"])
        ends.append(capsys.readouterr().out)
    assert ends[0] == ends[1]
