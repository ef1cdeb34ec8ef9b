# SPDX-License-Identifier: MIT
"""Out-of-plane stresses, their invariants, and histories of probes, compared with exact values."""

import csv
import re
from dataclasses import dataclass

import meshio
import numpy as np
import pytest
import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.io.units import FIELDS

BULK, SHEAR = 2e6, 1e6


def column(law, fluid=None, dim=2, top=-0.1, **options):
    """Return a unit block on smooth walls after a uniform compression by a tenth in one step: lambda_y = 0.9."""
    grid = mpm.Grid([0] * dim, [1.5] * dim, [3] * dim)
    every = {"left": "x", "right": "x", "bottom": "xyz"[dim - 1], "front": "y", "back": "y"}
    walls = {name: axes for name, axes in every.items() if dim == 3 or name not in ("front", "back")}
    body = mpm.box(grid, [0.0] * dim, [1.5] * (dim - 1) + [1.0])
    move = mpm.Displacement("top", lambda t, X: [0.0] * (dim - 1) + [top * t], components="xyz"[dim - 1])
    return mpm.Simulation(
        grid, [body], [law], walls=walls, fluid=fluid, conditions=[move, *options.pop("conditions", [])], **options
    ), body


@pytest.mark.parametrize("law", [mpm.Hencky, mpm.NeoHookean, mpm.LinearElastic])
def test_stress_across_the_plane_of_an_oedometer_is_that_of_the_sides(law):
    simulation, _ = column(law(bulk=BULK, shear=SHEAR))
    simulation.step(1.0)
    fields = simulation.point_fields()
    assert fields.effective_stress[:, 2, 2] == pytest.approx(fields.effective_stress[:, 0, 0], rel=1e-6)
    assert fields.effective_stress[:, :2, :2] == pytest.approx(simulation.effective_stress())
    q = np.abs(fields.effective_stress[:, 1, 1] - fields.effective_stress[:, 0, 0])
    assert fields.deviatoric_stress == pytest.approx(q, rel=1e-6)
    assert fields.porosity == pytest.approx(1 - 0.6 / simulation.points.J)


def test_henckys_mean_stress_is_that_of_the_volume_and_the_same_in_3d():
    for dim in (2, 3):
        simulation, _ = column(mpm.Hencky(bulk=BULK, shear=SHEAR), dim=dim)
        simulation.step(1.0)
        fields, J = simulation.point_fields(), simulation.points.J
        assert J == pytest.approx(0.9, rel=1e-3)  # a given side gives way by a little
        assert fields.mean_effective_stress == pytest.approx(-BULK * np.log(J) / J)
        assert fields.deviatoric_stress == pytest.approx(-2 * SHEAR * np.log(J) / J)


def test_stress_of_soil_that_yields_is_on_its_surface():
    clay = mpm.DruckerPrager(bulk=BULK, shear=SHEAR, friction=0.0, dilation=0.0, cohesion=1e4)
    simulation, _ = column(clay)
    simulation.step(1.0)
    fields, J = simulation.point_fields(), simulation.points.J
    assert fields.deviatoric_stress * J == pytest.approx(np.sqrt(3) * 1e4)
    assert fields.mean_effective_stress == pytest.approx(-BULK * np.log(J) / J)


def test_total_stress_has_bios_share_of_the_pressure():
    law = mpm.Hencky(bulk=BULK, shear=SHEAR, biot=0.8, grain_bulk=1e9)
    simulation, _ = column(law, mpm.Fluid(), top=-1e-3)
    simulation.step(1.0)
    fields, p = simulation.point_fields(), simulation.points.pressure
    assert p.min() > 1e3
    less = 0.8 * p[:, None, None] * np.eye(3)
    assert fields.stress == pytest.approx(fields.effective_stress - less)


@dataclass(frozen=True)
class Plane(mpm.Skeleton):
    """A user-defined law for plane scenes only."""

    @staticmethod
    def kirchhoff(F, bulk, shear):
        e = ufl.sym(F) - ufl.Identity(2)
        return bulk * ufl.tr(e) * ufl.Identity(2) + 2 * shear * ufl.dev(e)


def test_a_law_for_the_plane_only_has_no_stress_across_it():
    simulation, _ = column(Plane(bulk=BULK, shear=SHEAR))
    simulation.step(1.0)
    fields = simulation.point_fields()
    assert np.isnan(fields.effective_stress[:, 2, 2]).all() and np.isfinite(fields.effective_stress[:, 1, 1]).all()


def probed(folder, checkpoint=None, t_end=1.0, fluid=True, stress=True):
    simulation, body = column(mpm.Hencky(bulk=BULK, shear=SHEAR), mpm.Fluid() if fluid else None, top=-1e-3)
    probes = mpm.probes([body], [[0.2, 0.9], [1.5, 0.1]], stress=stress)
    observe = mpm.Writer(simulation, folder)
    result = simulation.run(t_end, 0.25, probes=probes, observe=observe, progress=False)
    return simulation, probes, result


def test_probes_record_position_pressure_and_stress_of_a_uniform_column(tmp_path):
    simulation, _, result = probed(tmp_path)
    fields = simulation.point_fields()
    assert result.position[-1] == pytest.approx(np.array([[0.2, 0.9], [1.5, 0.1]]) + result.displacement[-1])
    assert result.probe_pressure[-1] == pytest.approx(simulation.points.pressure[:2], rel=1e-6)
    assert result.probe_stress[-1] == pytest.approx(fields.effective_stress[:2], rel=1e-4, abs=1.0)
    assert len(result.probe_stress) == len(result.t) == 5
    assert np.abs(result.probe_stress[0]).max() < 1e-9


def test_history_names_what_it_holds_and_the_text_beside_it_says_what_that_is(tmp_path):
    _, _, result = probed(tmp_path)
    with open(tmp_path / "history.csv", newline="") as f:
        *_, last = csv.DictReader(f)
    assert float(last["y_1"]) == result.position[-1][1, 1] and float(last["p_0"]) == result.probe_pressure[-1][0]
    assert float(last["szz_1"]) == result.probe_stress[-1][1, 2, 2]
    said = (tmp_path / "fields.txt").read_text()
    points, history = (FIELDS[next(file for file in FIELDS if file.startswith(name))] for name in ("points", "history"))
    names = {part for rows in (history, points) for key in rows for part in key.split(", ")}
    by_name = tuple(re.split("_x_|_moment|_NAME", key)[0] for key in history if "NAME" in key or "WALL" in key)
    assert all(name.replace("_1", "_0") in names or name.startswith(by_name) for name in last)
    written = meshio.read(tmp_path / "points" / "000001.vtu").cell_data
    assert all(name in names or name.rsplit("_", 1)[0] in names for name in written)
    assert all(name in said for name in names)


def test_without_asking_there_is_no_stress_and_without_fluid_no_pressure(tmp_path):
    _, _, result = probed(tmp_path, fluid=False, stress=False)
    assert result.probe_pressure.shape == (5, 0) and result.probe_stress.shape == (5, 0, 3, 3)
    assert result.pressure.shape == (5, 0) and result.position.shape == (5, 2, 2)


def test_a_run_goes_on_with_probes_of_the_same_kind_only(tmp_path):
    simulation, probes, result = probed(tmp_path, t_end=0.5)
    other = mpm.probes(simulation.bodies, probes.x0)
    with pytest.raises(ValueError, match="probes: stress = False, must be as in the run that is continued"):
        simulation.run(1.0, 0.25, probes=other, after=result, progress=False)


def test_what_is_recorded_of_probes_outlives_a_checkpoint(tmp_path):
    simulation, _, result = probed(tmp_path)
    file = tmp_path / "run.ckpt"
    mpm.Checkpoint(file)(simulation)
    again, _ = column(mpm.Hencky(bulk=BULK, shear=SHEAR), mpm.Fluid(), top=-1e-3)
    read = mpm.resume(again, file)
    for name in ("position", "probe_pressure", "probe_stress", "displacement", "pressure"):
        assert np.array_equal(getattr(read, name), getattr(result, name)), name


def test_cam_clay_has_its_initial_stress_across_the_plane_too():
    stress = (-5e4, -1e5, -6e4)
    clay = mpm.ModifiedCamClay(shear=2e6, M=1.2, lambda_=0.1, kappa=0.02, initial_stress=stress, OCR=2.0)
    simulation, _ = column(clay)
    found = simulation.point_fields().effective_stress
    assert found == pytest.approx(np.broadcast_to(np.diag(stress), found.shape), abs=1e-3)
