# SPDX-License-Identifier: MIT
"""Masses and velocities of renewed particle domains.  Renewal conserves centres of mass and momenta."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.domains.refilled_cells import RefilledCells
from mpm_dolfinx.grid.grid import means_of_rows, sum_by
from mpm_dolfinx.mechanics.inertia import RATE, VELOCITY, velocity_gradients
from mpm_dolfinx.points.cutting import Pieces, cut

MOTION = VELOCITY, RATE
"""Names of the point fields for the velocity and for the rate of F."""


class Momenta(NamedTuple):
    """Masses, momenta and moments of inertia of groups of pieces.  Each array has one row for each group."""

    mass: NDArray[np.float64]  # (groups,), kg
    centre: NDArray[np.float64]  # centre of mass (groups, 2), m
    velocity: NDArray[np.float64]  # velocity of the centre (groups, 2), m/s
    angular: NDArray[np.float64]  # angular momentum about the centre (groups,), kg m^2/s
    inertia: NDArray[np.float64]  # moment of inertia about the centre (groups,), kg m^2

    @classmethod
    def of(
        cls, pieces: Pieces, piece: NDArray, group: NDArray, mass: NDArray, v: NDArray, L: NDArray, count: int
    ) -> Momenta:
        """Return the momenta of `count` groups of pieces.

        `piece` (k,): indices of k pieces in the array `pieces`.  `group` (k,): index of the group of each piece.
        `mass` (k,), in kg: masses of these pieces.
        `v` (n, 2), in m/s: velocity of each domain.
        `L` (n, 2, 2), in 1/s: velocity gradient of each domain.
        """
        of, x = pieces.point[piece], pieces.x[piece]
        second = pieces.second[piece]
        middle, centre = means_of_rows(of, mass, x, len(v)), means_of_rows(group, mass, x, count)
        at_pieces = v[of] + np.einsum("nij,nj->ni", L[of], x - middle[of])
        velocity = means_of_rows(group, mass, at_pieces, count)
        (x, y), (v_x, v_y) = (x - centre[group]).T, (at_pieces - velocity[group]).T
        rotation = L[of] @ second
        angular = mass * (x * v_y - y * v_x + rotation[:, 1, 0] - rotation[:, 0, 1])
        inertia = mass * (x**2 + y**2 + second[:, 0, 0] + second[:, 1, 1])
        whole, angular, inertia = sum_by(group, np.stack([mass, angular, inertia]), count)
        return cls(whole, centre, velocity, angular, inertia)


def velocities(
    work: RefilledCells, corners: NDArray, x: NDArray, group: NDArray, masses: tuple[NDArray, NDArray]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the velocities and the velocity gradients of new domains.

    Each result is a mean over the old domains that overlap the new domain.  A rigid motion added to each group of
    domains then restores the momentum and the angular momentum of the group.

    `corners` (n, 4, 2), in m: corners of each new domain.
    `x` (n, 2), in m: position of each new domain.
    `group` (n,): index of the group of each new domain.
    `masses`: masses of all old domains, and of all new domains, in kg.
    """
    points = work.points
    n, count = len(x), int(group.max()) + 1
    v, L = points.velocity, velocity_gradients(points)
    old = Momenta.of(work.pieces, *_received(work, masses[0]), v, L, count)
    of, at, share = work.pairs(corners, group)
    weight = share * masses[0][of]
    v = means_of_rows(at, weight, v[of] + np.einsum("nij,nj->ni", L[of], x[at] - points.x[of]), n)
    L = means_of_rows(at, weight, L[of], n)
    pieces = cut(work.grid, corners, second=True)
    of = pieces.point
    new = Momenta.of(pieces, np.arange(len(of)), group[of], pieces.fraction * masses[1][of], v, L, count)
    shift = old.velocity * (old.mass / new.mass)[:, None] - new.velocity
    spin = ((old.angular - new.angular) / new.inertia)[group, None]
    off = x - new.centre[group]
    v = v + shift[group] + spin * np.stack([-off[:, 1], off[:, 0]], axis=1)
    return v, L + spin[:, :, None] * [[0.0, -1.0], [1.0, 0.0]]


def centred(work: RefilledCells, group: NDArray, x: NDArray, mass: NDArray, old: NDArray) -> NDArray[np.float64]:
    """Return masses of new domains, in kg, with which each renewed cell keeps its centre of mass.

    Domains outside renewed cells keep their masses.  A mass changes by at most 50 %, so some cells keep their centre of
    mass only approximately.

    `group` (n,): index of the group of each new domain.
    `x` (n, 2), in m: position of each new domain.
    `mass` (n,), in kg: mass of each new domain before the correction.
    `old` (points,), in kg: masses of the old domains.
    """
    cells, inside = int(work.chosen.sum()), group < work.chosen.sum()
    piece, *received = _received(work, old)
    centre = means_of_rows(*received, work.pieces.x[piece], int(group.max()) + 1)[:cells]
    at, part = group[inside], mass[inside]
    now = means_of_rows(at, part, x[inside], cells)
    off = x[inside] - now[at]
    second = means_of_rows(at, part, off[:, :, None] * off[:, None], cells)
    slope = np.einsum("nij,nj->ni", np.linalg.pinv(second, SAME, hermitian=True), centre - now)
    more = np.einsum("ni,ni->n", slope[at], off)
    most = np.zeros(cells)
    np.maximum.at(most, at, np.abs(more))
    out = mass.copy()
    out[inside] *= 1 + more / np.maximum(1.0, 2 * most)[at]
    return out


def _received(work: RefilledCells, mass: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
    """Return the pieces of removed domains, the groups of new domains that receive them, and the received masses."""
    piece, groups, share = work.into
    return piece, groups, share * mass[work.pieces.point[piece]]
