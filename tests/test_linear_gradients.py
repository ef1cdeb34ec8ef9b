# SPDX-License-Identifier: MIT
"""Deformation gradients that vary linearly within particle domains."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box_mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.domains.domain_gradient import gradient
from mpm_dolfinx.domains.domain_slopes import LinearGradients
from mpm_dolfinx.points.material_points import determinant

SOIL = mpm.Hencky(bulk=1e6, shear=1e6)


def seeded(dim, kind):
    """Return a scene of one body on a lattice or from a mesh, in cells that cut its domains."""
    lower, upper = np.full(dim, 0.13), np.full(dim, 0.83)
    grid = mpm.Grid(np.zeros(dim), np.ones(dim), [5] * dim)
    body = mpm.box(grid, lower, upper, per_cell=2)
    if kind == "skew":
        body = mpm.mapped(grid, body, lambda X: X + 0.1 * np.roll(X, 1, axis=1) - 0.04)
    elif kind == "mesh":
        body = mpm.from_mesh(grid, box_mesh("quad", (6, 6), lower, upper))
    return mpm.Simulation(grid, [body], [SOIL], walls={"bottom": "xyz"[:dim]})


def at_pieces(s, F, alike=None):
    """Return F at the pieces of points with these gradients, and the cut."""
    cut, n = CutDomains(s.grid, s.points, True), len(s.points)
    alike = np.zeros((n, 1)) if alike is None else alike
    linear = LinearGradients(s.grid.comm, s.bodies)
    return linear.at_pieces(cut, F, np.ones(n, dtype=bool), alike), cut


@pytest.mark.parametrize(("dim", "kind"), [(2, "lattice"), (2, "skew"), (2, "mesh"), (3, "lattice"), (3, "skew")])
def test_linear_fields_are_met_and_uniform_ones_stay(dim, kind):
    s = seeded(dim, kind)
    rng = np.random.default_rng(1)
    x, even = s.points.x, np.eye(dim) + 0.3 * rng.standard_normal((dim, dim))
    found, cut = at_pieces(s, np.broadcast_to(even, (len(x), dim, dim)).copy())
    assert np.abs(found - even).max() < 1e-12
    slope = 1e-5 * rng.standard_normal((dim, dim, dim))  # the part of second order is below 1e-9
    found, cut = at_pieces(s, even + np.einsum("na,aij->nij", x, slope))
    off = found - even - np.einsum("na,aij->nij", cut.pieces.x, slope)
    assert np.abs(off).max() < 1e-9 < 1e-3 * np.abs(slope).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_pieces_have_the_volume_of_their_domain_at_rest(dim):
    s = seeded(dim, "lattice")
    bent = (
        s.points.corners + 0.05 * np.sin(6 * s.points.corners) + 0.03 * np.sin(4 * np.roll(s.points.corners, 1, axis=2))
    )
    points = replace(s.points, corners=bent, x=bent.mean(axis=1))
    F = gradient(points.corners, points.reference)
    cut = CutDomains(s.grid, points, True)
    n = len(points)
    found = LinearGradients(s.grid.comm, s.bodies).at_pieces(cut, F, np.ones(n, dtype=bool), np.zeros((n, 1)))
    assert np.ptp(determinant(found)) > 0.1
    at_rest = cut.mean(1 / determinant(found))
    assert at_rest == pytest.approx(1 / determinant(F), rel=1e-12)


def test_other_soil_tells_nothing():
    """In layers of one body, each layer has its own gradient up to the interface."""
    s = seeded(2, "lattice")
    upper = s.points.x[:, 1] > 0.48
    F = np.eye(2) + 0.1 * upper[:, None, None] * np.diag([0.0, 1.0])
    found, cut = at_pieces(s, F, upper[:, None].astype(float))
    assert np.abs(found - F[cut.pieces.point]).max() < 1e-14
    smeared, _ = at_pieces(s, F)
    assert np.abs(smeared - F[cut.pieces.point]).max() > 1e-2
