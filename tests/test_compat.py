# SPDX-License-Identifier: MIT
"""Undocumented behaviour of dolfinx on which forms at points rely: a new release fails here first."""

import subprocess
import sys

import numpy as np
import pytest
import ufl
from dolfinx import fem

from mpm_dolfinx import Grid
from mpm_dolfinx.base import _compat
from mpm_dolfinx.forms.point_forms import FormPoints, PointForm

GRID = Grid([0, 0], [2.0, 1.0], [4, 3])


def assembled(points, data, integrand, space):
    b = np.zeros_like(fem.Function(space).x.array)
    PointForm(integrand * points.dx, points).assemble_vector(b, data)
    return b


def test_the_kernel_is_called_once_for_every_entry_of_the_list():
    space = _compat.function_space(GRID.mesh, "DG", 0)
    points = FormPoints(GRID, load=())
    cells = np.array([5, 2, 5, 5, 0, 2], dtype=np.int32)
    at = points.at(cells, GRID.midpoints[cells], np.ones(6), load=np.array([1.0, 10, 100, 1000, 7, 20]))
    b = assembled(points, at, points.load * ufl.TestFunction(space), space)
    expected = np.zeros(GRID.num_local)
    expected[[5, 2, 0]] = 1101, 30, 7
    assert b == pytest.approx(expected), "a cell listed several times is no longer integrated as often, row by row"


def test_coefficients_are_packed_in_the_kernels_order():
    space = _compat.function_space(GRID.mesh, "DG", 0)
    points = FormPoints(GRID, a=(), b=(2,), c=(2, 2))
    cells = np.array([1, 1, 3], dtype=np.int32)
    data = {"a": np.array([1.0, 2, 3]), "b": np.arange(6.0).reshape(3, 2), "c": 10 * np.arange(12.0).reshape(3, 2, 2)}
    at = points.at(cells, GRID.midpoints[cells], np.ones(3), **data)
    q = ufl.TestFunction(space)
    found = assembled(points, at, (points.c[0, 1] + 1e3 * points.b[1] + 1e6 * points.a) * q, space)
    each = data["c"][:, 0, 1] + 1e3 * data["b"][:, 1] + 1e6 * data["a"]
    message = "the columns of packed coefficients are no longer in the order of the kernel's coefficients"
    assert found[1] == pytest.approx(each[0] + each[1]) and found[3] == pytest.approx(each[2]), message


def test_interior_facets_are_integrated_once_each():
    V = _compat.function_space(GRID.mesh, "DG", 0)
    dS = ufl.Measure("dS", domain=GRID.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 0})
    q, one = ufl.TestFunction(V), fem.Function(V)
    one.x.array[:] = 1.0
    form = _compat.CompiledForm(one("+") * ufl.avg(q) * dS)
    inner = GRID.interior_facets(np.ones(GRID.num_local, dtype=bool), np.arange(GRID.num_local))
    b = np.zeros(GRID.num_local)
    for facets in (inner, inner[:5]):
        form.bind(facets)
        b[:] = 0.0
        form.assemble_vector(b)
        if facets is inner:
            length = 3 * 3 * GRID.h[1] + 4 * 2 * GRID.h[0]
            assert b.sum() == pytest.approx(length), "interior facets are counted otherwise than once"
    ends = GRID.facet_cells[inner[:5]]
    across = np.abs(np.diff(GRID.midpoints[ends], axis=1)[:, 0])
    lengths = np.where(across[:, 0] > 1e-9, GRID.h[1], GRID.h[0])
    assert b.sum() == pytest.approx(lengths.sum()), "a list of facets is not integrated as listed"


def test_an_unsupported_release_is_refused_in_one_line():
    code = "import dolfinx; dolfinx.__version__ = '0.7.3'; import mpm_dolfinx"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "ImportError: dolfinx 0.7.3 is not supported; mpm_dolfinx needs 0.5.2, 0.9, 0.10 or 0.11"
    )
