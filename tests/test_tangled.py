# SPDX-License-Identifier: MIT
"""Extreme shear and separation: inverted domains are re-initialised from F, volume and forces are correct."""

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.points.cutting import corner_bits, parallelepipeds, tangled

SOFT = mpm.NeoHookean(bulk=1e7 / 3, shear=5e6)  # Hencky's law loses its stiffness at such shear


def sheared(sides, gamma=5.0, steps=100):
    """Return (simulation, result) of a block of 5 x 5 cells whose sides are sheared by gamma in total."""
    grid = mpm.Grid([0, 0], [5.4, 0.9], [54, 9])
    body = mpm.box(grid, [0.2, 0.13], [0.7, 0.63])

    def value(t, X):
        return np.stack([gamma * t * (X[:, 1] - 0.13), 0 * t * X[:, 0]], axis=1)

    held = [mpm.Displacement(side, value) for side in sides]
    s = mpm.Simulation(grid, [body], [SOFT], walls={}, conditions=held)
    return s, s.run(1.0, 1 / steps)


def test_a_block_sheared_by_500_percent_keeps_volume_and_stress():
    s, result = sheared(("left", "right", "bottom", "top"))
    F = np.array([[1, 5], [0, 1]])
    stress = SOFT.shear * (F @ F.T - np.eye(2))
    volume = s.points.volume0 * s.points.J
    assert volume.sum() == pytest.approx(0.25, rel=3e-3)
    mean = np.einsum("n,nij->ij", volume, s.effective_stress()) / volume.sum()
    assert mean == pytest.approx(stress, abs=2e-3 * stress.max())
    assert np.median(np.abs(s.points.F - F)) < 5e-3 and result.cuts == 0


def test_a_block_sheared_between_plates_goes_on_where_domains_have_folded(monkeypatch):
    """No domain is really inverted. Corners with slightly less than the volume of the domain count as inverted."""
    monkeypatch.setattr("mpm_dolfinx.points.cutting.TANGLED", 0.87)
    s, result = sheared(("bottom", "top"), gamma=4.0, steps=80)
    assert result.converged and result.residual <= 1e-8
    assert result.reinitialised > 0, "no domain folded: the test shows nothing"
    bottom, top = s.reactions.array
    assert bottom + top == pytest.approx([0, 0], abs=1e-5 * np.abs(top).max())


@pytest.mark.parametrize("softness", [1e-3, 1e-6])
def test_a_column_tears_at_a_weak_layer(softness):
    """The layer is stretched to twenty times its height. The rest keeps its volume, and carries the same force."""
    grid = mpm.Grid([0, 0], [0.6, 3.2], [6, 32])
    column = [mpm.box(grid, [0.1, 0], [0.53, 0.5]), mpm.box(grid, [0.1, 0.5], [0.53, 0.6], material=1)]
    column.append(mpm.box(grid, [0.1, 0.6], [0.53, 1.0]))
    weak = mpm.NeoHookean(bulk=softness * SOFT.bulk, shear=softness * SOFT.shear)
    top = mpm.Displacement("top", lambda t, X: (0, 1.9 * t))
    s = mpm.Simulation(grid, column, [SOFT, weak], walls={"bottom": "xy"}, conditions=[top])
    s.run(1.0, 0.01)
    volume, layer = s.points.volume0 * s.points.J, s.points.material == 1
    assert volume[~layer].sum() == pytest.approx(0.43 * 0.9, rel=2e-2 if softness > 1e-4 else 2e-4)
    assert volume.sum() == pytest.approx(0.43 * 2.9, rel=1e-2)
    stretch = 20.0
    force = 0.43 * weak.shear * (stretch - 1 / stretch)  # nu = 0; uniaxial nominal stress
    assert s.reactions.array[0, 1] == pytest.approx(force, rel=0.15)  # the layer's ends are clamped by stiff blocks


def test_a_folded_domain_is_found_and_its_own_domain_is_not():
    box = 0.1 * corner_bits(2)
    flipped = box[[3, 1, 2, 0]]
    flat = box * [1, 0.1]
    many = np.stack([box, flipped, flat, 6 * box])
    assert tangled(many, np.full(4, 0.01)).tolist() == [False, True, True, True]
    F = np.array([[1.0, 5.0], [0.3, 2.0]])
    own = parallelepipeds(np.zeros((1, 2)), F[None], np.array([[0.1, 0.1]]))
    assert not tangled(own, np.array([0.01 * np.linalg.det(F)]))[0]
    assert own.mean(axis=1) == pytest.approx(np.zeros((1, 2)))


def test_folding_is_found_in_3d():
    box = corner_bits(3).astype(float)[None]
    turned = box @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    mirrored = box * [1, 1, -1]
    assert [tangled(b, np.ones(1))[0] for b in (box, turned, mirrored)] == [False, False, True]
