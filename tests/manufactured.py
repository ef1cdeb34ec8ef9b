# SPDX-License-Identifier: MIT
"""A manufactured solution (u, p) at large strain, with its body force and source in UFL.

A block of one metre stands between smooth walls. Its water is soft, and its conductivity depends on its volume. The
drained top sinks by a third of the height, and the inside bulges and rotates. All fields are functions of X and t.
"""

import numpy as np
import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

SOIL = mpm.NeoHookean(
    bulk=1e6,
    shear=6e5,
    porosity=0.6,
    conductivity=1e-4,
    conductivity_law=lambda conductivity, J: conductivity * ufl.exp(3 * (J - 1)),
)
WATER = mpm.Fluid(bulk=5e6)
SINK, BULGE, LOAD, TIME = 0.3, 0.08, 2e5, 20.0  # m, m, Pa, s
WALLS = {"left": "x", "right": "x", "bottom": "y"}


def sunk(t, sin):
    """Return the displacement of the top, divided by SINK."""
    return sin(np.pi / 2 * t / TIME) ** 2


def solution(X, t, sin=np.sin, cos=np.cos):
    """Return (u, p) at reference positions (x, y), in m, and time t, in s, as numbers or UFL.

    Walls and floor are free of shear and flow. At the top p = 0, and the traction is uniform.
    """
    (x, y), part = X, sunk(t, sin)
    across = BULGE * part * sin(np.pi * x) * (1 - y) ** 2 * (1 + 2 * y)
    down = SINK * part * (y + 0.5 * cos(np.pi * x) * y * (1 - y) ** 2)
    return (across, -down), LOAD * sin(0.8 * np.pi * t / TIME) * (1 - y**2) * (1 + 0.4 * cos(np.pi * x))


def traction(t):
    """Return the traction on the top, in Pa."""
    stretch = 1 - SINK * sunk(t, np.sin)
    lam = SOIL.bulk - 2 * SOIL.shear / 3
    return 0, SOIL.shear * (stretch - 1 / stretch) + lam * np.log(stretch) / stretch


def _at(points, t):
    """Return X and t as UFL variables, and F and p."""
    X, t = ufl.variable(points.position - points.displacement), ufl.variable(t)
    u, p = solution(X, t, ufl.sin, ufl.cos)
    return X, t, ufl.variable(ufl.Identity(2) + ufl.diff(ufl.as_vector(u), X)), p


def _divergence(f, X):
    """Return the divergence of a vector or tensor with respect to X."""
    slope = ufl.diff(f, X)
    if len(f.ufl_shape) == 1:
        return slope[0, 0] + slope[1, 1]
    return ufl.as_vector([slope[i, 0, 0] + slope[i, 1, 1] for i in range(2)])


def body_force(points, v, t):
    """Return the term of the body force: the work of -Div P, with effective stress and pore pressure."""
    X, _, F, p = _at(points, t)
    P = ufl.diff(SOIL.energy(F, SOIL.bulk, SOIL.shear), F) - p * ufl.det(F) * ufl.inv(F).T
    return ufl.inner(_divergence(P, X), points.value(v)) / ufl.det(points.F) * points.dx


def source(points, q, t):
    """Return the source: rate of the water mass plus divergence of its flow, over the density at zero pressure."""
    X, t, F, p = _at(points, t)
    J = ufl.det(F)
    density = ufl.exp(p / WATER.bulk)
    kappa = SOIL.conductivity_law(SOIL.conductivity, J) / WATER.unit_weight
    flow = -density * kappa * J * ufl.inv(F) * ufl.inv(F).T * ufl.diff(p, X)
    rate = ufl.diff(density * (J - 1 + SOIL.porosity), t) + _divergence(flow, X)
    return rate * q / ufl.det(points.F) * points.dx


PHYSICS = {
    "fluid": WATER,
    "walls": WALLS,
    "conditions": [mpm.Traction("top", traction), mpm.Drained("top")],
    "terms": [body_force, mpm.Source(source)],
}


def scene(cells):
    """Return the block on a grid of `cells` cells per metre."""
    grid = mpm.Grid([0, 0], [1.0, 1 + 2 / cells], [cells, cells + 2])
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [SOIL], **PHYSICS)


def reference(cells):
    """Return the block with Taylor-Hood elements."""
    return BiotFEM(mpm.Grid([0, 0], [1, 1], (cells, cells)), SOIL, **PHYSICS)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def errors(s):
    """Return the rms errors of displacement and pressure, at points or cell centres, divided by the largest exact
    values.
    """
    fem = isinstance(s, BiotFEM)
    X = s.grid.midpoints[: s.grid.num_owned] if fem else s.bodies[0].centre
    found, pressure = (
        (s.displacement(X), s.pressure(X)) if fem else (s.points.corners.mean(axis=1) - X, s.points.pressure)
    )
    u, p = solution(X.T, s.t)
    u = np.stack(u, axis=1)
    return np.array([rms(found - u) / np.abs(u).max(), rms(pressure - p) / np.abs(p).max()])


def stress(X, t):
    """Return the exact effective Cauchy stress (n, 2, 2), in Pa, at reference positions (n, 2), by differences of u."""
    step, slopes = 1e-6, []
    for e in np.eye(2):
        ahead, behind = (np.stack(solution((X + way * step * e).T, t)[0], axis=1) for way in (1, -1))
        slopes.append((ahead - behind) / (2 * step))
    F = np.eye(2) + np.stack(slopes, axis=2)
    J, lam = np.linalg.det(F)[:, None, None], SOIL.bulk - 2 * SOIL.shear / 3
    return (SOIL.shear * (F @ F.swapaxes(1, 2) - np.eye(2)) + lam * np.log(J) * np.eye(2)) / J


def errors_of_cells(s):
    """Return the errors of displacement, pressure and both stresses of the cells, defined as in `errors`."""
    cells = s.cells()
    X = cells.x - cells.displacement
    u, p = solution(X.T, s.t)
    effective = stress(X, s.t)
    total = effective - p[:, None, None] * np.eye(2)
    pairs = [(cells.displacement, np.stack(u, axis=1)), (cells.pressure, p)]
    pairs += [(cells.effective_stress, effective), (cells.stress, total)]
    return np.array([rms(found - exact) / np.abs(exact).max() for found, exact in pairs])
