# SPDX-License-Identifier: MIT
"""Correction of the corners of yielded particle domains, so that the domains keep the volumes of their points.

The volume ratio of a point is a mean over its cell.  The corners of its domain, however, follow a field that varies in
the cell.  In elastic soil, F and the volume ratios of cells are computed from the corners.  In yielded soil, F is
updated by increments.  The volumes of domains and of points would therefore drift apart, and domains would overlap.
After a step the corners of yielded domains therefore move by the vectors d that minimise

    sum_p V_p e_p^2 + SOFT^2 sum_p V_p mean |d / h|^2,  V_p e_p = V_p - V - dV/dx d.

The sums are over the points p.  V_p is the volume of a point, and V is the volume of its domain.  The derivative of V
with respect to the corners is dV/dx.  The relative volume error after the motion is e_p.  The mean is over the corners
of the domain, and h contains the edge lengths of the domain's cell.  Shared corners move together.  Fixed corners, and
corners of elastic domains, do not move.  Kugelstadt et al. (2019) correct cell densities in this way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import lsmr

from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.domains.domain_gradient import volume_slopes
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import to_root

SOFT = 0.1
"""Weight of the motion d of the corners.

Volume errors may alternate between the domains of a regular lattice.  To first order, no motion of the corners reduces
such errors, so the weight is needed.  The result of scene "flow" in tests/plateaus.py changes by the fraction 2.5e-04
with half this value, by 1.4e-04 with twice this value, and by 9.2e-02 with finer cells.
"""


class Domains(NamedTuple):
    """Particle domains of n points."""

    ids: NDArray[np.int64]  # identifiers of the points (n,)
    corners: NDArray[np.float64]  # corners (n, 2^d, d), m
    volume: NDArray[np.float64]  # volumes of the points (n,), m^d, > 0; in axisymmetry of their rings, m^3
    yielded: NDArray[np.bool_]  # whether to correct the domain (n,)
    free: NDArray[np.bool_]  # which displacement components of corners (n, 2^d, d) may change
    body: NDArray[np.int64]  # index of the body (n,)
    number: NDArray[np.int64]  # indices of corners in the seeded body (n, 2^d), >= 0; -1 for renewed domains


def with_volumes(grid: Grid, domains: Domains) -> NDArray[np.float64]:
    """Return the corners (n, 2^d, d), in m, after the correction."""
    root = to_root(grid.comm, len(domains.ids))
    rows = Domains(*map(root.send, domains))
    motion = np.zeros_like(rows.corners)
    if grid.comm.rank == 0:
        order = rows.ids.argsort()  # sums do not depend on the processes
        motion[order] = _motion(grid, Domains(*(values[order] for values in rows)))
    return domains.corners + root.back(motion)


def _motion(grid: Grid, domains: Domains) -> NDArray[np.float64]:
    """Return the motion of the corners of all domains, in m."""
    d, yielded = grid.dim, domains.yielded
    number = _joined(domains.body, domains.number, domains.corners, NEAR * grid.least)
    count = int(number.max(initial=-1)) + 1
    fixed = ~(domains.free & yielded[:, None, None])
    held = np.stack([np.bincount(number.ravel(), fixed[:, :, a].ravel(), count) > 0 for a in range(d)], axis=1)
    now, slope = volume_slopes(domains.corners[yielded], grid.axisymmetric)
    at, whole = number[yielded], domains.volume[yielded]
    n, corners = at.shape
    share = whole[:, None] / corners / grid.sizes_at(domains.corners[yielded].mean(axis=1)) ** 2
    weight = np.stack([np.bincount(at.ravel(), column.repeat(corners), count) for column in share.T], axis=1)
    scale = np.divide(~held, np.sqrt(weight), out=np.zeros((count, d)), where=weight > 0)
    # the unknowns are weighted motions and errors e, so that rows may be scaled: narrow domains have large slopes
    values = np.column_stack([(slope * scale[at]).reshape(n, -1) / np.sqrt(whole)[:, None], np.full(n, SOFT)])
    columns = np.column_stack([(at[:, :, None] * d + np.arange(d)).reshape(n, -1), count * d + np.arange(n)])
    size = np.linalg.norm(values, axis=1)
    A = csr_matrix(((values / size[:, None]).ravel(), columns.ravel(), np.arange(n + 1) * columns.shape[1]))
    found = lsmr(A, (whole - now) / np.sqrt(whole) / size, atol=SAME**1.5, btol=SAME**1.5)[0]
    return (found[: count * d].reshape(-1, d) * scale)[number]


def _joined(
    body: NDArray[np.int64], number: NDArray[np.int64], x: NDArray[np.float64], tolerance: float
) -> NDArray[np.int64]:
    """Return an index for each corner of domains, which is equal for corners that coincide.

    Corners of one body coincide if their seeded indices are equal, or if they are closer than about `tolerance`, in m.
    """
    keys = [body.repeat(x.shape[1])]
    for column in x.reshape(-1, x.shape[2]).T:
        order = column.argsort()
        key = np.zeros(len(column), dtype=np.int64)
        key[order[1:]] = np.cumsum(np.diff(column[order]) > tolerance)
        keys.append(key)
    seeded = number.ravel() >= 0
    place, node = (
        np.unique(np.ravel_multi_index(keys, [int(key.max(initial=0)) + 1 for key in keys]), return_inverse=True)[1]
        for keys in (keys, [keys[0][seeded], number.ravel()[seeded]])
    )
    count = int(place.max(initial=0)) + 1
    total = count + int(node.max(initial=0)) + 1
    links = coo_matrix((np.ones(len(node)), (place.ravel()[seeded], count + node.ravel())), shape=(total, total))
    return connected_components(links, directed=False)[1].astype(np.int64)[place].reshape(number.shape)
