# SPDX-License-Identifier: MIT
"""A slice of one cell between smooth walls, in 3D, is in plane strain: stresses, pressures and displacements agree."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

PLANE = [0, 2]  # axes of the slice that plane strain has


def bent(across, soil, **options):
    """Return a clamped beam that is bent, in plane strain or as a slice of so many cells across."""
    flat = across == 0

    def place(x, z, y=0.0):
        return (x, z) if flat else (x, y, z)

    cells = [6, 4] if flat else [6, across, 4]
    grid = mpm.Grid(place(0, 0, 0), place(0.6, 0.4, 0.1 * across), cells)
    body = mpm.box(grid, place(0, 0.03), place(0.5, 0.27, 0.1 * across))
    walls = {"left": "xy"} if flat else {"left": "xz", "front": "y", "back": "y"}
    load = mpm.Traction("top", place(0, -3e3), region=(place(0.2, 0, -1), place(1, 1, 1)))
    s = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=[load], **options)
    s.run(1.0, 1.0, progress=False)
    return s


def fields(s):
    """Return displacements, effective stresses and pressures of the points in the plane, and the points' places."""
    X = s.points.origin.mean(axis=1)
    axes = [*range(s.grid.dim), 2][:3] if s.grid.dim == 2 else [0, 2, 1]
    stress = s.point_fields().effective_stress[:, axes][:, :, axes]
    moved, plane = s.points.x - X, PLANE if s.grid.dim == 3 else [0, 1]
    order = np.lexsort((X[:, 1] if s.grid.dim == 3 else 0 * X[:, 0], *np.round(X[:, plane], 9).T))
    return [values[order] for values in (moved[:, plane], stress, s.points.pressure)]


def test_jumps_of_the_pressure_are_damped_in_a_slice_as_in_plane_strain():
    soil = mpm.Hencky(bulk=1e6, shear=5e5)
    flat, slab = (fields(bent(n, soil, fluid=mpm.Fluid())) for n in (0, 1))
    for one, other in zip(flat, slab, strict=True):
        each = np.repeat(one, 2, axis=0)
        assert other == pytest.approx(each, abs=1e-6 * np.abs(one).max())


def test_mean_dilatation_in_a_slice_is_that_of_plane_strain_but_for_the_cells_own_error():
    """In plane strain the mean scales the gradient in the plane, in a slice across it too: a limit in the README."""
    soil = mpm.Hencky(bulk=5e7 / 3, shear=1e6 / 3)  # nu = 0.49
    flat, slab = (fields(bent(n, soil)) for n in (0, 1))
    moved, stress, _ = (
        np.abs(other - np.repeat(one, 2, axis=0)).max() / np.abs(one).max() if one.any() else 0.0
        for one, other in zip(flat, slab, strict=True)
    )
    print(f"differences of displacements and stresses over the largest: {moved:.2g}, {stress:.2g}")
    assert moved < 2e-2 and stress < 7e-2
