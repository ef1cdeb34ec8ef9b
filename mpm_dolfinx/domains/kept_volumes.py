# SPDX-License-Identifier: MIT
"""Correction of the corners of yielded particle domains, so that the domains keep the volumes of their points.

In yielded soil, F is updated by increments, so the volumes of domains and points would drift apart.  After a step, the
corners of yielded domains therefore move by the vectors d that minimise

    sum_p V_p e_p^2 + SOFT^2 sum_p V_p (mean (d / h)^2 + sum_a mean (D_a / h)^2),  V_p e_p = V_p - V - dV/dx d.

The sums are over the points p with the volumes V_p.  The domain of a point has the volume V before this motion, and
dV/dx is the derivative of V with respect to the corners.  The relative volume error after the motion is e_p.  D_a is
the difference of d between both ends of an edge along axis a.  Each mean is over the corners, or over the edges along
a, of the domain.  The cell size is h.  The method is similar to implicit density projection (Kugelstadt et al. 2019).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bmat, csr_matrix, diags, identity
from scipy.sparse.linalg import lsmr, norm

from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.domains.domain_gradient import volume_slopes
from mpm_dolfinx.grid.grid import Grid, linked, sum_by
from mpm_dolfinx.parallel.exchange import to_root

SOFT = 0.15
"""Weight of the motion d of the corners, and of its differences along edges, relative to the volume errors.

Sensitivity (scene "flow" of tests/plateaus.py): half this value changes the result by 1.5e-04, and twice this value by
2.4e-04. Finer cells change it by 9.1e-02.
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
        order = rows.ids.argsort()  # so that sums do not depend on the number of processes
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
    weight = sum_by(at.ravel(), share.T.repeat(corners, axis=1), count).T
    scale = np.divide(~held, np.sqrt(weight), out=np.zeros((count, d)), where=weight > 0)
    ends = [(k, k + 2**a) for a in range(d) for k in range(corners) if not k >> a & 1]
    edge, of = np.unique(np.sort(at[:, ends]).reshape(-1, 2) @ [count, 1], return_inverse=True)
    stiff = np.sqrt(2 * sum_by(of.ravel(), share.T.repeat(len(ends), axis=1), len(edge)).T)
    pairs, axes = np.stack(divmod(edge, count), axis=1)[:, None], np.arange(d)
    values = stiff[:, :, None] * scale[pairs[:, 0]].swapaxes(1, 2) * [1, -1]
    changes = _sparse(values.reshape(-1, 2), pairs * d + axes[:, None], count * d)
    values = (slope * scale[at] / np.sqrt(whole)[:, None, None]).reshape(n, -1)
    A = _sparse(values, at[:, :, None] * d + axes, count * d)
    # the unknowns are weighted d, e and D, so that rows may be scaled: narrow domains have large slopes
    A = bmat([[A, SOFT * identity(n), None], [changes, None, identity(changes.shape[0])]], "csr")
    size = norm(A, axis=1)
    off = np.append((whole - now) / np.sqrt(whole), np.zeros(changes.shape[0])) / size
    found = lsmr(diags(1 / size) @ A, off, atol=SAME**1.5, btol=SAME**1.5)[0]
    return (found[: count * d].reshape(-1, d) * scale)[number]


def _sparse(values: NDArray[np.float64], columns: NDArray[np.int64], count: int) -> csr_matrix:
    """Return a matrix (m, count), whose rows have the values (m, k) in the columns (m, k)."""
    m, k = values.shape
    return csr_matrix((values.ravel(), columns.ravel(), np.arange(m + 1) * k), (m, count))


def _joined(
    body: NDArray[np.int64], number: NDArray[np.int64], x: NDArray[np.float64], tolerance: float
) -> NDArray[np.int64]:
    """Return an index for each corner of domains.  Coincident corners have the same index.

    Corners coincide if their seeded indices are equal, or if their distance is below `tolerance`, in m.
    """
    keys = [body.repeat(x.shape[1])]
    for column in x.reshape(-1, x.shape[2]).T:
        order = column.argsort()
        keys.append(np.cumsum(np.diff(column[order], prepend=-np.inf) > tolerance)[order.argsort()])
    seeded = number.ravel() >= 0
    place, node = (
        np.unique(np.ravel_multi_index(keys, [int(key.max(initial=0)) + 1 for key in keys]), return_inverse=True)[1]
        for keys in (keys, [keys[0][seeded], number.ravel()[seeded]])
    )
    count = int(place.max(initial=0)) + 1
    total = count + int(node.max(initial=0)) + 1
    return linked(total, place.ravel()[seeded], count + node.ravel())[0][place].reshape(number.shape)
