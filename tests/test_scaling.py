# SPDX-License-Identifier: MIT
"""Time and memory are proportional to the points, not to the grid or the steps."""

from pathlib import Path

import numpy as np
import pytest
import scaling
from helpers import beam, thresholds

import mpm_dolfinx as mpm
from mpm_dolfinx.points.cutting import cut_faces


def memory() -> float:
    """Return the present memory of this process, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def test_memory_does_not_grow_with_the_number_of_steps():
    simulation, _ = beam()
    simulation.run(0.2, 0.02, progress=False)
    before = memory()
    simulation.run(0.8, 0.02, progress=False)
    assert memory() - before < 3, "MB in 30 steps of 360 kB of matrices each"


@pytest.mark.parametrize(("dim", "sizes", "count", "most"), [(2, (2e3, 1e4), 3, 7), (3, (3e3, 2e4), 1, 10)])
def test_memory_for_each_point_is_bounded(dim, sizes, count, most):
    """Peaks scatter by up to 35 MB in 3D. Sizes differ so much that this scatter is below 2 kB per point.

    In 3D, the second step needs as much memory as later steps.
    """
    small, large = (scaling.in_own_process(dim, points, processes=1, count=count) for points in sizes)
    per_point = (large["memory_MB"] - small["memory_MB"]) / (large["points"] - small["points"])
    print(f"{1024 * per_point:.2f} kB")
    assert 0 < 1024 * per_point < most, "kB"


def test_a_run_tells_its_memory_and_its_parts():
    simulation, _ = beam(h=0.06)
    result = simulation.run(0.04, 0.02, progress=False)
    assert 50 < result.memory < 1e5 and result.points == len(simulation.points) and result.imbalance == {}
    *parts, last = result.shares().splitlines()
    assert len(parts) == len(result.profile) + 1 and last.endswith(f"kB for each of {result.points} points")
    shown = float(last.split("MB, ")[1].split()[0])
    assert shown == pytest.approx(1024 * result.memory / result.points, rel=0.01)


def test_iterative_solvers_are_freed_with_the_matrices_they_were_made_for(monkeypatch):
    thresholds(monkeypatch, multigrid_3d=1)
    grid = mpm.Grid([0, 0, 0], [4, 1.5, 2], [16, 6, 8])
    body = mpm.box(grid, [0, 0.25, 0.625], [3.75, 1.25, 1.625])
    law = mpm.LinearElastic(bulk=1e7, shear=1e7, conductivity=1e-4)
    water = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("right")]}
    load = mpm.Traction("top", lambda t: (0, 0, -1e3 * t))
    s = mpm.Simulation(
        grid, [body], [law], walls={"left": "xyz"}, conditions=[load, *water.pop("conditions", [])], **water
    )
    used = []
    for _ in range(10):
        s.step(0.1)
        assert s.scene.last[1].plan.iterative
        used.append(memory())
    assert used[-1] - used[3] < 15, f"MB after each step: {used}, 29 in six steps were none freed"


def test_faces_that_end_on_grid_planes_have_no_points_without_area():
    grid = mpm.Grid([0, 0, 0], [2, 2, 2], [2, 2, 2])
    face = np.array([[[2, 0.25, 0.5], [2, 0.75, 1.0], [2, 0.25, 1.0], [2, 0.75, 1.5]]])
    _, _, _, share, _ = cut_faces(grid, face, face)
    assert share.min() > 0 and share.sum() == pytest.approx(1, abs=1e-14)
