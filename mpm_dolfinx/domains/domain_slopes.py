# SPDX-License-Identifier: MIT
"""Deformation gradients that vary linearly within the particle domains of elastic soil.

The gradient F of a point is the mean over its domain.  With constant F in each of n domains over the thickness of a
beam, the bending stiffness would be too small by the fraction `1/n^2`.  At a piece with the local coordinates xi in its
domain, the gradient is therefore

    F(xi) = F (1 + e),   F e = sum_a D_a (xi_a - mean of xi_a over the reference volume).

The sum is over the axes a.  The slopes D_a are a least-squares fit to F of the neighbours of the same material that
share a face.  The fit reproduces linear fields on any mesh.  The reference volume of the domain is conserved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.domains.divided_domains import SeededDomains
from mpm_dolfinx.domains.renewed_faces import ROOT, is_part, roots
from mpm_dolfinx.grid.grid import FACES, sum_by
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.points.material_points import MaterialPoints, body_of, cofactor, determinant


class Neighbours:
    """Neighbours of the `chosen` domains across shared faces, including neighbours on other processes."""

    def __init__(self, comm: MPI.Intracomm, bodies: Sequence[Body], points: MaterialPoints, chosen: NDArray[np.bool_]):
        dim = bodies[0].dim
        seeded = points.id < sum(map(len, bodies))
        self.rows = rows = (chosen & (seeded | is_part(points))).nonzero()[0]
        """Indices (k,) of the points whose neighbours are sought."""
        key = _seeded_faces(bodies, points.id[rows], seeded[rows])
        if ROOT in points.data:
            key = _faces_of_parts(comm, bodies, points.map(lambda values: values[rows]), key)
        key = key.reshape(2 * dim * len(rows), key.shape[2])
        partner = _pairs(key)
        self._unpaired = (partner < 0).nonzero()[0]
        self._exchange = Exchange(comm, (np.add.reduce(key[self._unpaired], axis=1) % comm.size).astype(np.int32))
        self._partners = _pairs(self._exchange.send(key[self._unpaired]))
        found = self._exchange.back(self._partners >= 0)
        partner[self._unpaired[found]] = len(key) + found.nonzero()[0]
        self._partner = partner.reshape(-1, 2 * dim).T.copy()  # index of the opposite face; -1 if there is none

    def at_neighbours(self, own: NDArray[np.float64], faces: Sequence[NDArray[np.float64]]) -> Callable[[int], tuple]:
        """Return a function of a face index.  It gives values and face centres of neighbours, and whether they exist.

        `own` (c, k): c values of each of k points.
        `faces`: centres (d, k), in m, of the faces of the points, for each face index.
        """
        centres = np.array(faces).transpose(1, 2, 0).reshape(len(faces[0]), own.shape[1] * len(faces))
        point = np.arange(own.shape[1]).repeat(len(faces))
        if self._exchange.comm.size > 1:
            rows = np.concatenate([own[:, point[self._unpaired]], centres[:, self._unpaired]])
            away = self._exchange.back(self._exchange.send(rows.T.copy())[self._partners]).T
            point = np.append(point, own.shape[1] + np.arange(len(self._unpaired)))
            own, centres = (
                np.concatenate(pair, axis=1) for pair in zip((own, centres), np.split(away, [len(own)]), strict=True)
            )

        def of(face: int) -> tuple[NDArray, NDArray, NDArray]:
            at = self._partner[face]
            return own.take(point[at], axis=1), centres.take(at, axis=1), at >= 0

        return of


class LinearGradients:
    """Deformation gradients at the pieces of the domains in a scene."""

    def __init__(self, comm: MPI.Intracomm, bodies: Sequence[Body]):
        self._comm, self._bodies = comm, bodies
        self._neighbours: Latest[Neighbours] = Latest()

    def at_pieces(
        self, cut: CutDomains, F: NDArray[np.float64], elastic: NDArray[np.bool_], soils: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the gradients at the pieces.  In inelastic domains, F is constant.  All processes must call this."""
        make = partial(Neighbours, self._comm, self._bodies, cut.points, elastic)
        return linear_gradients(self._neighbours((cut.points.id, elastic), make, self._comm), cut, F, soils)


def _seeded_faces(bodies: Sequence[Body], ids: NDArray[np.int64], seeded: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return integers (keys) that identify each face of seeded domains.  Both domains at a face have the same key."""
    dim, starts = bodies[0].dim, np.cumsum([0, *map(len, bodies)])
    of, key = np.where(seeded, body_of(ids, starts), -1), np.zeros((len(ids), 2 * dim), dtype=np.int64)
    for i, body in enumerate(bodies):
        chosen = (of == i).nonzero()[0]
        corners = (2**dim * starts[i] + body.nodes(ids[chosen] - starts[i]))[:, FACES[dim]]
        # the key of a face: lowest corner index, and index of the opposite corner
        first = corners.argmin(axis=2)[:, :, None]
        ends = (np.take_along_axis(corners, at, axis=2)[:, :, 0] for at in (first, corners.shape[2] - 1 - first))
        key[chosen] = np.ravel_multi_index(tuple(ends), (2**dim * starts[-1],) * 2)
    return key[:, :, None]


def _faces_of_parts(
    comm: MPI.Intracomm, bodies: Sequence[Body], points: MaterialPoints, seeded: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return a key for each face, also of parts of domains.  Both domains at a face have the same key.

    `seeded`: keys of the faces of whole domains, for bodies without a lattice.
    """
    dim, part = bodies[0].dim, is_part(points)
    root, ends = roots(points)
    places, size = SeededDomains(bodies).places(root), np.ptp(ends, axis=2)
    extremes = (np.min, MPI.MIN), (np.max, MPI.MAX)
    least, most = (over_all(comm, float(of(size, initial=1.0)), op) for of, op in extremes)
    levels = int(np.log2(most / least)) + 1
    level = np.rint(np.log2(size / least)).astype(np.int64)
    on_lattice = places[:, 0] >= 0
    lower, upper = (np.rint((places[:, 1:] + ends[..., k]) / least).astype(np.int64) for k in (0, 1))
    # the second number of a key: the body on whose lattice the face lies, or the seeded domain
    shape = (*(upper.max(axis=0, initial=0) + 1), *(levels,) * dim, dim)
    shape = tuple(over_all(comm, np.array(shape), MPI.MAX))
    out = np.concatenate([seeded, np.full(seeded.shape, len(bodies))], axis=2)
    for axis, (end, corner) in product(range(dim), enumerate((lower, upper))):
        at, across = lower.copy(), level.copy()
        at[:, axis], across[:, axis] = corner[:, axis], 0
        number = np.ravel_multi_index((*at.T, *across.T, np.full(len(at), axis)), shape)
        key = np.stack([number, places[:, 0]], axis=1)
        out[:, 2 * axis + end] = np.where((part | on_lattice)[:, None], key, out[:, 2 * axis + end])
    return out


def _pairs(key: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of the partner of each row of keys: another, identical row.  Rows without a partner have -1."""
    order, out = np.lexsort(key.T), np.full(len(key), -1)
    same = np.logical_and.reduce(key[order[1:]] == key[order[:-1]], axis=1).nonzero()[0]
    out[order[same]], out[order[same + 1]] = order[same + 1], order[same]
    return out


def linear_gradients(
    neighbours: Neighbours, cut: CutDomains, F: NDArray[np.float64], soils: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return deformation gradients (m, k, k) at the pieces of this process's points.

    `neighbours`: neighbours of the domains in which F may vary.
    `cut`: cut particle domains.
    `F` (n, k, k): deformation gradients of the points.
    `soils` (n, c): material constants.  Points with identical rows have the same material.
    """
    # the last axis is the point or piece: numpy takes several times as long for rows of a few numbers each
    of, fraction = cut.pieces.point, cut.pieces.fraction
    d, k = cut.grid.dim, F.shape[1]
    slope, inverse = np.zeros((d, k, k, len(F))), np.zeros((d, d, len(F)))
    slope[..., neighbours.rows], inverse[..., neighbours.rows] = _slopes(neighbours, cut, F, soils)
    x = cut.pieces.x.T
    offset = x - sum_by(of, fraction * x, len(F)).take(of, axis=1)
    xi = np.add.reduce(inverse.take(of, axis=2) * offset, axis=1)
    J, base = determinant(F), F.transpose(1, 2, 0).copy()
    cofactors = cofactor(F).transpose(2, 1, 0).copy()
    e = np.einsum("ijn,ajkn->aikn", cofactors / J, slope)
    ratio = e.trace(axis1=1, axis2=2)
    # the mean is weighted by reference volumes; the second-order part would change the domain's volume and is removed
    variances = sum_by(of, (fraction * xi)[:, None] * xi, len(F))
    weight, part = np.add.reduce(variances * ratio, axis=1), np.einsum("abn,bjkn->ajkn", variances, e)
    second = 0.5 * (np.add.reduce(weight[:, None, None] * e) - np.einsum("aijn,ajkn->ikn", e, part))
    base = base - np.einsum("ijn,jkn->ikn", base, second) + np.add.reduce(weight[:, None, None] * slope)
    out = base.take(of, axis=2)
    for along, change in zip(xi, slope, strict=True):
        out += along * change.take(of, axis=2)
    out = np.ascontiguousarray(out.transpose(2, 0, 1))
    ratios = determinant(out)
    if (inverted := ratios <= 0).any():  # such domains keep a uniform gradient
        even = np.isin(of, of[inverted])
        out[even] = F[of[even]]
        ratios[even] = J[of[even]]
    return out * (J * sum_by(of, fraction / ratios, len(F)))[of, None, None] ** (1 / k)


def _slopes(
    neighbours: Neighbours, cut: CutDomains, F: NDArray[np.float64], soils: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the derivatives of F with respect to local coordinates, and inverse matrices of edge vectors."""
    rows = neighbours.rows
    d, k = cut.grid.dim, F.shape[1]
    corners = cut.points.corners[rows].transpose(1, 2, 0).copy()
    faces = [np.add.reduce(corners[at]) / 2 ** (d - 1) for at in FACES[d]]
    edges = np.array([faces[2 * a + 1] - faces[2 * a] for a in range(d)]).swapaxes(0, 1)
    inverse = _inverse(edges)
    own = np.concatenate([F.reshape(len(F), k * k)[rows].T, np.add.reduce(corners) / 2**d, soils[rows].T])
    others = neighbours.at_neighbours(own, faces)
    nearest = NEAR * np.minimum.reduce(np.add.reduce(np.abs(edges)))
    A, B = np.zeros((d, d, len(rows))), np.zeros((d, k * k, len(rows)))
    for axis in range(d):
        some = np.zeros(len(rows), dtype=bool)
        for face in (2 * axis, 2 * axis + 1):
            neighbours_columns, at_face, known = others(face)
            joined = known & np.logical_and.reduce(np.abs(at_face - faces[face]) <= nearest)
            joined &= np.logical_and.reduce(neighbours_columns[k * k + d :] == own[k * k + d :])
            xi = np.add.reduce(inverse * (neighbours_columns[k * k : k * k + d] - own[k * k : k * k + d]), axis=1)
            xi[:, ~joined] = 0.0
            change = neighbours_columns[: k * k] - own[: k * k]
            B += xi[:, None] * change
            A += xi[:, None] * xi
            some |= joined
        A[axis, axis, ~some] += 1.0  # without a neighbour along this axis the slope is zero
    return np.einsum("abn,bmn->amn", _inverse(A), B).reshape(d, k, k, len(rows)), inverse


def _inverse(A: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverses of matrices (d, d, n)."""
    A = A.transpose(2, 0, 1)
    return (cofactor(A).transpose(0, 2, 1) / determinant(A)[:, None, None]).transpose(1, 2, 0).copy()
