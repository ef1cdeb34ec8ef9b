# SPDX-License-Identifier: MIT
"""Tensors at positions in the bodies, from a fit to surrounding points (`local_fit`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.bodies.faces import interpolate
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.cutting import centroids, edges
from mpm_dolfinx.points.local_fit import RADIUS, fitted, near
from mpm_dolfinx.points.material_points import MaterialPoints, body_of


def fitted_at(
    comm: MPI.Comm,
    sizes: Sequence[int],
    points: MaterialPoints,
    id: NDArray[np.int64],
    xi: NDArray[np.float64],
    tensor: Callable[[MaterialPoints], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return tensors (m, k, k) at positions in particle domains.  All processes must call this function.

    The fit uses points of the same body and material, with weights that depend on the distance in the reference
    configuration.

    `sizes`: number of points of each body of the scene.
    `id` (m,): identifiers of the domains that contain the positions, the same on all processes.
    `xi` (m, d): local coordinates of the positions in these domains, the same on all processes.
    `tensor`: function from material points to tensors (n, k, k).
    """
    m = len(id)
    d = xi.shape[1]
    local, at = points.find(id)
    seeded = edges(points.reference[at])
    frames = [np.linalg.inv(E) for E in (seeded, points.F[at][:, :d, :d] @ seeded)]
    of = (points.reference, points.corners)
    columns = [*(interpolate(corners[at], xi[local]) for corners in of), *(E.reshape(-1, d * d) for E in frames)]
    own = np.zeros((m, 2 * d + 2 * d * d + 1))
    own[local] = np.column_stack([*columns, points.material[at]])
    X, x, seeded, now, material = np.split(over_all(comm, own), np.cumsum([d, d, d * d, d * d]), axis=1)
    seeded, now = (frame.reshape(m, d, d) for frame in (seeded, now))
    seeded[~seeded.any(axis=(1, 2))] = np.eye(d)
    middle, last = centroids(points.reference), np.cumsum([0, *sizes])
    probe, row = _near(middle, X, RADIUS * np.abs(np.linalg.inv(seeded)).sum(axis=2).max(axis=1))
    body, own_body = (body_of(ids, last) for ids in (points.id[row], id[probe]))
    weight = near(np.einsum("rij,rj->ri", seeded[probe], middle[row] - X[probe]))
    weight = weight * ((body == own_body) & (points.material[row] == material[probe, 0]))
    probe, row, weight = (values[weight > 0] for values in (probe, row, weight))
    used, place = np.unique(row, return_inverse=True)
    values = tensor(points.map(lambda rows: rows[used]))[place]
    shape = values.shape[1:]
    values = values.reshape(len(row), int(np.prod(shape)))
    offset = np.einsum("rij,rj->ri", now[probe], points.x[row] - x[probe])
    return fitted(comm, m, 1, probe, offset, values, weight).reshape(m, *shape)


def _near(x: NDArray[np.float64], places: NDArray[np.float64], radius: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Return pairs of indices, one in `places` and one in x, of positions closer than `radius` along each axis."""
    low, high = ((places + sign * radius[:, None]).T for sign in (-1, 1))
    bounds = low.min(axis=1, initial=np.inf), high.max(axis=1, initial=-np.inf)
    some = np.flatnonzero(((x >= bounds[0]) & (x <= bounds[1])).all(axis=1))
    if not len(some):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    found = cKDTree(x[some]).query_ball_point(places, radius, p=np.inf)
    return np.repeat(np.arange(len(places)), list(map(len, found))), some[np.concatenate(found).astype(np.int64)]
