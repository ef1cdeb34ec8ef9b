# SPDX-License-Identifier: MIT
"""The weight above a position, for domains of any shape, and next to interfaces of bodies."""

import numpy as np
import pytest

from mpm_dolfinx.bodies.overburden import overburden
from mpm_dolfinx.points.cutting import corner_bits


def block(dim, cells=4, shift=0.3):
    """Return the corners of domains that fill a cube with edge `cells`, between irregular nodes."""
    nodes = np.stack(np.meshgrid(*[np.arange(cells + 1.0)] * dim, indexing="ij"), axis=-1)
    inner = ((nodes > 0) & (nodes < cells)).all(axis=-1)
    nodes += np.random.default_rng(1).uniform(-shift, shift, nodes.shape) * inner[..., None]
    places = np.stack(np.meshgrid(*[np.arange(cells)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return np.stack([np.stack([nodes[tuple(place + bits)] for bits in corner_bits(dim)]) for place in places])


@pytest.mark.parametrize("dim", [2, 3])
def test_domains_with_bent_faces_weigh_what_their_column_does(dim):
    """Earlier, faces were planes through their midpoint: near a corner a domain was missed, 7 % of the weight."""
    corners = block(dim)
    x = corners.mean(axis=1)
    weight, surface = overburden(corners, np.full(len(corners), 2.0), x)
    assert weight == pytest.approx(2.0 * (4.0 - x[:, -1]), rel=1e-12)
    assert surface == pytest.approx(4.0)


def test_a_border_above_a_position_prefers_no_side():
    corners = block(2, cells=2, shift=0.0)
    weight = np.where(corners.mean(axis=1)[:, 0] < 1, 1.0, 3.0)
    found, _ = overburden(corners, weight, np.array([[1.0, 0.5]]))
    assert found == pytest.approx([1.5 * 2.0])
