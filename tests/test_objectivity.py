# SPDX-License-Identifier: MIT
"""Laws along paths with cycles and rotations: a rotating observer sees rotated stresses."""

import numpy as np
import pytest
from extending_with_ufl import Crushable
from laws import LawAtPoints

import mpm_dolfinx as mpm

LAWS = {
    "hencky": mpm.Hencky(bulk=2e7, shear=1e7),
    "neo-hookean": mpm.NeoHookean(bulk=2e7, shear=1e7),
    "drucker-prager": mpm.DruckerPrager(bulk=2e7, shear=1e7, friction=30, dilation=10, cohesion=1e5, hardening=1e6),
    "mohr-coulomb": mpm.MohrCoulomb(bulk=2e7, shear=1e7, friction=30, dilation=10, cohesion=1e5, tension=5e4),
    "softening": mpm.SofteningDruckerPrager(
        bulk=2e7, shear=1e7, friction=20, dilation=5, cohesion=1e5, residual=2e4, slip=0.02
    ),
    "user's, in numpy": Crushable(bulk=2e7, shear=1e7, limit=1e5),
    "cam clay": mpm.ModifiedCamClay(
        M=1.2, lambda_=0.07, kappa=0.014, shear=3e6, initial_stress=(-1e5, -1e5, -1e5), OCR=1.5
    ),
}


def path(dim, steps=24, points=6):
    """Return deformation gradients (steps, n, d, d) of two cycles, different at each point, and rotations (steps, d,
    d).
    """
    rng = np.random.default_rng(dim)
    amplitude, phase = 0.04 * rng.normal(size=(points, dim, dim)), 2 * np.pi * rng.random(size=(points, dim, dim))
    times = np.arange(1, steps + 1) / steps
    F = np.array([np.eye(dim) + amplitude * (np.sin(4 * np.pi * t + phase) - np.sin(phase)) for t in times])
    spin = rng.normal(size=(dim, dim))
    w, V = np.linalg.eig(spin - spin.T)
    turns = np.array([(V * np.exp(2 * w * t)) @ np.linalg.inv(V) for t in times]).real
    return F, turns


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", LAWS)
def test_stress_turns_with_the_observer_and_the_state_does_not_see_him(name, dim):
    law, yields = LawAtPoints(LAWS[name], dim), False
    still, turning, largest = {}, {}, 0.0
    for F, Q in zip(*path(dim), strict=True):
        tau, seen = law.kirchhoff(F, still), law.kirchhoff(Q @ F, turning)
        largest = max(largest, np.abs(tau).max())  # at the end of a cycle there may be none
        assert np.abs(seen - Q @ tau @ Q.T).max() < 1e-8 * largest
        if law.law.update is not None:
            still, turning = law.update(F, still), law.update(Q @ F, turning)
            yields |= max(np.abs(values - law.law.state[name]).max() for name, values in still.items()) > 1e-3
            for variable, values in still.items():
                assert np.abs(turning[variable] - values).max() < 1e-8
    assert yields == (law.law.update is not None)
