# SPDX-License-Identifier: MIT
"""Run four laws, three of them with state, with fields and user-defined terms, on any number of processes."""

import sys

import numpy as np
import ufl
from helpers import gathered

import mpm_dolfinx as mpm


def push(points, u, v, t):
    """Return a force that rotates with the material."""
    F = (ufl.Identity(2) + points.grad(u)) * points.F
    return -ufl.inner(F * ufl.as_vector([2e4 * t, 0]), points.value(v)) / ufl.det(points.F) * points.dx


grid = mpm.Grid([0, 0], [1.6, 1.3], [16, 13])
bodies = [
    mpm.box(grid, [0, 0], [0.5, 0.5]),
    mpm.box(grid, [0.5, 0], [1, 0.5], material=3),
    mpm.box(grid, [0, 0.5], [1, 0.8], material=1),
    mpm.box(grid, [0, 0.8], [1, 1.03], material=2),
]
sand = mpm.DruckerPrager(
    bulk=lambda X: 4e6 * (2 - X[:, 1]),
    shear=2e6,
    friction=30.0,
    dilation=5.0,
    cohesion=lambda X: 1e4 + 2e4 * X[:, 0],
    conductivity=1e-4,
    conductivity_law=mpm.kozeny_carman,
)
weak = mpm.MohrCoulomb(bulk=4e6, shear=2e6, friction=30.0, dilation=5.0, cohesion=1e4, tension=5e3, conductivity=1e-4)
gel = mpm.NeoHookean(bulk=2e6, shear=1e6, conductivity=lambda X: 1e-5 * (1 + X[:, 0]))
clay = mpm.ModifiedCamClay(M=1.1, lambda_=0.1, kappa=0.03, shear=1e6, initial_stress=(-1e5,) * 3, conductivity=1e-5)
simulation = mpm.Simulation(
    grid,
    bodies,
    [sand, gel, clay, weak],
    fluid=mpm.Fluid(),
    walls={"left": "x", "bottom": "y"},
    conditions=[
        mpm.Drained("right"),
        mpm.Traction("top", lambda t: (0, -1e5 - 3e4 * t), region=((0, 1), (1, 2))),
        mpm.Traction("right", (-1e5, 0)),
    ],
    terms=[push, mpm.Source(lambda points, q, t: 1e-3 * t * points.displacement[0] * q * points.dx)],
)
result = simulation.run(1.0, 0.5, progress=False)
points = simulation.points
columns = {name: points.data[name] for name in ("plastic", "hardened")}
if state := gathered(simulation, p=points.pressure, stress=simulation.effective_stress(), **columns):
    assert state["hardened"].max() > 1e-3
    np.savez(sys.argv[1], **state, balance=result.balance)
