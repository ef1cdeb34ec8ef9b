# SPDX-License-Identifier: MIT
"""The tangent of a scene as matrices: derivatives of the residuals."""

import numpy as np
import pytest
from helpers import set_up

import mpm_dolfinx as mpm


def block(fluid: bool, dim: int = 2, law: type[mpm.Skeleton] = mpm.Hencky, **options) -> mpm.Simulation:
    """Return a block that an inclined load has bent, with a fixed base."""
    grid = mpm.Grid([0.0] * dim, [1.0] * dim, [5] * dim)
    soil = law(bulk=1e5, shear=1e5, conductivity=1e-3, **options)
    wet = {"fluid": mpm.Fluid(bulk=1e7), "conditions": [mpm.Drained("right")]} if fluid else {}
    load = mpm.Traction("top", [2e3] + [0.0] * (dim - 2) + [-1e3])
    body = mpm.box(grid, [0.1] * (dim - 1) + [0.0], [0.7] * dim)
    s = mpm.Simulation(
        grid, [body], [soil], walls={"bottom": "xyz"[:dim]}, conditions=[load, *wet.pop("conditions", [])], **wet
    )
    s.step(1.0)
    return s


@pytest.mark.parametrize("fluid", [False, True], ids=["dry", "wet"])
def test_products_of_the_tangent_are_what_residuals_change_by(fluid):
    """The step is short, because the tangent omits the derivative of fluxes by displacements."""
    s, rng, dt = block(fluid), np.random.default_rng(2), 1e-4
    found = s.tangent(dt)
    _, momentum, storage = set_up(s, dt)
    du, u = rng.standard_normal(len(found.x)), momentum.forms.u
    dp = 1e5 * rng.standard_normal(len(found.cells)) if fluid else None
    forces, fluids, unknowns = [], [], momentum.system.unknowns
    for step in (1e-6, -2e-6):
        unknowns.add(u.x, step, unknowns.gather_owned(du))
        if fluid:
            storage.system.unknowns.add(storage.forms.p.x, step, storage.system.unknowns.gather_owned(dp))
            fluids.append(storage.assemble_residual().vector.array.copy())
        forces.append(momentum.assemble_residual()[0].array.copy())
    forces, fluids = ((of[0] - of[1]) / 2e-6 if of else None for of in (forces, fluids))
    told = found.stiffness @ du + (found.pressure @ dp if fluid else 0.0)
    assert told == pytest.approx(forces, abs=1e-6 * np.abs(forces).max())
    if fluid:
        flows = found.content @ du + found.storage @ dp
        assert flows == pytest.approx(fluids, abs=1e-3 * np.abs(fluids).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_a_rigid_translation_takes_no_force_but_beside_what_is_held(dim):
    s = block(False, dim)
    found, h = s.tangent(1.0), s.grid.h[0]
    free = found.x[:, -1] > 1.5 * h
    scale = abs(found.stiffness).sum(axis=1).max()
    for axis in range(dim):
        forces = found.stiffness @ (found.components == axis).astype(float)
        assert np.abs(forces[free]).max() < 1e-12 * scale < np.abs(forces).max()


def test_the_tangent_leaves_the_next_step_as_it_was():
    s, other = (block(True, law=mpm.LinearElastic) for _ in range(2))
    s.tangent(1e-3)
    s.step(1.0), other.step(1.0)
    assert np.abs(s.points.x - other.points.x).max() < 1e-12
