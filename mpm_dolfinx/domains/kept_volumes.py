# SPDX-License-Identifier: MIT
"""Correction of the corners of yielded particle domains, so that the domains keep the volumes of their points.

In yielded soil, F is updated by increments, so the volumes of domains and points would drift apart.  After a step, the
corners of yielded domains therefore move by the vectors d that minimise

    sum_p V_p e_p^2 + sum_k (g_k / 2)^2 + SOFT^2 sum_p V_p (mean (d / h)^2 + sum_a mean (D_a / h)^2),
    V_p e_p = V_p - V - dV/dx d.

The sums are over the points p with the volumes V_p.  The domain of a point has the volume V before this motion, and
dV/dx is the derivative of V with respect to the corners.  The relative volume error after the motion is e_p.  D_a is
the difference of d between both ends of an edge along axis a.  Each mean is over the corners, or over the edges along
a, of the domain.  The cell size is h.

Corners of renewed domains may lie on an edge of another domain, between its ends (hanging corners).  The distance of
the hanging corner k from its edge after the motion is g_k.  Between corner and edge is a triangle of area L g_k / 2, in
which domains overlap or soil is missing, for an edge of length L.  The second sum contains the squares of these areas,
divided by L^2.  This sum is used in plane strain only.  If corners hang, the correction is repeated once, because
volumes of thin domains are not linear in d.  The method is similar to implicit density projection (Kugelstadt et al.
2019).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bmat, csr_matrix, diags, identity, vstack
from scipy.sparse.linalg import lsmr, norm, splu
from scipy.spatial import cKDTree

from mpm_dolfinx.base.tolerances import NEAR, SAME, TINY
from mpm_dolfinx.domains.domain_gradient import volume_slopes
from mpm_dolfinx.grid.grid import Grid, linked, means_of_rows, sum_by
from mpm_dolfinx.parallel.exchange import to_root

SOFT = 0.15
"""Weight of the motion d of the corners, and of its differences along edges, relative to the volume errors.

Sensitivity (scene "flow" of tests/plateaus.py): half this value changes the result by 1.6e-04, and twice this value by
1.4e-04. Finer cells change it by 8.5e-02.
"""
HANGING = 1e-3
"""Largest distance of a hanging corner from its edge, divided by the cell size.

Sensitivity (scene "flow" of tests/plateaus.py): half this value changes the result by 1.3e-04, and twice this value by
1.1e-05. Finer cells change it by 8.5e-02.
"""

OF_CELL = 1 / 4
"""Smallest V_p in the third sum for renewed domains, divided by the volume of a cell.

Without it, corners of very thin domains would move far, also out of the surface.  Source: definition, the volume of one
of the four new domains of a full cell.
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
    before: NDArray[np.float64]  # corners at the start of the step (n, 2^d, d), m


def with_volumes(grid: Grid, domains: Domains) -> NDArray[np.float64]:
    """Return the corners (n, 2^d, d), in m, after the correction."""
    root = to_root(grid.comm, len(domains.ids))
    rows = Domains(*map(root.send, domains))
    motion = np.zeros_like(rows.corners)
    if grid.comm.rank == 0:
        order = rows.ids.argsort()  # so that sums do not depend on the number of processes
        ordered = Domains(*(values[order] for values in rows))
        moved, hang = _motion(grid, ordered)
        if hang:
            moved = moved + _motion(grid, ordered._replace(corners=ordered.corners + moved))[0]
        motion[order] = moved
    return domains.corners + root.back(motion)


def _motion(grid: Grid, domains: Domains) -> tuple[NDArray[np.float64], bool]:
    """Return the motion of the corners of all domains, in m, and whether corners hang."""
    d, yielded = grid.dim, domains.yielded
    number = _joined(domains.body, domains.number, domains.corners, NEAR * grid.least)
    count = int(number.max(initial=-1)) + 1
    fixed = ~(domains.free & yielded[:, None, None])
    held = np.stack([np.bincount(number.ravel(), fixed[:, :, a].ravel(), count) > 0 for a in range(d)], axis=1)
    now, slope = volume_slopes(domains.corners[yielded], grid.axisymmetric)
    at, whole = number[yielded], domains.volume[yielded]
    n, corners = at.shape
    middle = domains.corners[yielded].mean(axis=1)
    size = grid.sizes_at(middle)
    least = OF_CELL * size.prod(axis=-1) * grid.around(middle) * (domains.number[yielded, 0] < 0)
    share = np.maximum(whole, least)[:, None] / corners / size**2
    weight = sum_by(at.ravel(), share.T.repeat(corners, axis=1), count).T
    hangs = _hanging(grid, domains, number, ~held.all(axis=1) & (weight > 0).all(axis=1))
    scale = np.divide(~held, np.sqrt(weight), out=np.zeros((count, d)), where=weight > 0)
    ends = [(k, k + 2**a) for a in range(d) for k in range(corners) if not k >> a & 1]
    edge, of = np.unique(np.sort(at[:, ends]).reshape(-1, 2) @ [count, 1], return_inverse=True)
    stiff = np.sqrt(2 * sum_by(of.ravel(), share.T.repeat(len(ends), axis=1), len(edge)).T)
    pairs, axes = np.stack(divmod(edge, count), axis=1)[:, None], np.arange(d)
    values = stiff[:, :, None] * scale[pairs[:, 0]].swapaxes(1, 2) * [1, -1]
    changes = _sparse(values.reshape(-1, 2), pairs * d + axes[:, None], count * d)
    values = (slope * scale[at] / np.sqrt(whole)[:, None, None]).reshape(n, -1)
    A = _sparse(values, at[:, :, None] * d + axes, count * d)
    values = (hangs.slopes * scale[hangs.corners]).reshape(-1, 3 * d)
    closing = _sparse(values, hangs.corners[:, :, None] * d + axes, count * d)
    A, missing = vstack([A, closing]), np.append((whole - now) / np.sqrt(whole), hangs.missing)
    if closing.shape[0]:  # LSMR takes thousands of iterations where many corners hang
        found = _least(A, changes, missing)
        return (found.reshape(-1, d) * scale)[number], True
    # the unknowns are weighted d, e and D, so that rows may be scaled: narrow domains have large slopes
    A = bmat([[A, SOFT * identity(n), None], [changes, None, identity(changes.shape[0])]], "csr")
    size = norm(A, axis=1)
    off = np.append(missing, np.zeros(changes.shape[0])) / size
    found = lsmr(diags(1 / size) @ A, off, atol=SAME**1.5, btol=SAME**1.5)[0]
    return (found[: count * d].reshape(-1, d) * scale)[number], False


def _least(A: csr_matrix, D: csr_matrix, b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vector x that minimises `|b - A x|^2 + SOFT^2 (|x|^2 + |D x|^2)`, from its augmented system."""
    size = np.hypot(norm(A, axis=1), SOFT)
    A = diags(1 / size) @ A
    augmented = bmat([[identity(A.shape[1]) + D.T @ D, A.T], [A, diags(-((SOFT / size) ** 2))]], "csc")
    # quasi-definite, so that pivots on the diagonal are stable in any order (Vanderbei 1995)
    factors = splu(augmented, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve(np.append(np.zeros(A.shape[1]), b / size))[: A.shape[1]]


class _Hanging(NamedTuple):
    """Corners of renewed domains that lie between the ends of an edge of another domain."""

    corners: NDArray[np.int64]  # indices of the corner and of both ends of its edge (k, 3)
    slopes: NDArray[np.float64]  # derivatives of half the distance with respect to these corners (k, 3, d)
    missing: NDArray[np.float64]  # minus half the distance (k,), m


def _hanging(grid: Grid, domains: Domains, number: NDArray[np.int64], moves: NDArray[np.bool_]) -> _Hanging:
    """Return the hanging corners.  `number` (n, 2^d): indices of corners.  `moves` (count,): which corners may move."""
    count, d = len(moves), grid.dim
    if d != 2 or grid.axisymmetric or not (domains.number < 0).any():
        return _Hanging(np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3, d)), np.zeros(0))
    every = number.ravel()  # means, because corners with the same index differ by rounding and by `NEAR`
    x, now = (
        means_of_rows(every, np.ones(len(every)), rows.reshape(-1, d), count)
        for rows in (domains.before, domains.corners)
    )
    ends = np.sort(number[:, [(0, 1), (1, 3), (2, 3), (0, 2)]].reshape(-1, 2))
    edge, at = np.unique(ends @ [count, 1], return_inverse=True)
    own = at.reshape(-1, 4, 1) * count + number[:, None]  # corners do not hang on edges of their own domains
    a, b = np.divmod(edge, count)
    free = np.flatnonzero(moves)
    near = cKDTree(x[free]).query_ball_point((x[a] + x[b]) / 2, np.linalg.norm(x[b] - x[a], axis=1) / 2)
    of, node = np.repeat(np.arange(len(a)), list(map(len, near))), free[np.concatenate([[], *near]).astype(np.int64)]
    other = ~np.isin(of * count + node, own)
    of, node = of[other], node[other]
    a, b = a[of], b[of]
    chord, off = x[b] - x[a], x[node] - x[a]
    long = np.maximum(np.linalg.norm(chord, axis=1), TINY)
    along, least = (chord * off).sum(axis=1) / long, HANGING * grid.sizes_at(x[node]).min(axis=-1)
    away = np.abs(chord[:, 0] * off[:, 1] - chord[:, 1] * off[:, 0]) / long
    on = (away < least) & (along > least) & (long - along > least)
    t, rows = (along / long)[on, None], np.stack([node, a, b], axis=1)[on]
    node, a, b = now[rows.T]
    normal = (b - a)[:, ::-1] * [1, -1]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), TINY) * 2
    gap = ((1 - t) * a + t * b - node) * normal
    return _Hanging(rows, normal[:, None] * np.stack([np.ones_like(t), t - 1, -t], axis=1), gap.sum(axis=1))


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
