# SPDX-License-Identifier: MIT
"""Fills: bodies that are added in a later stage, on the displaced surface of other bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags

from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.touching import MISFIT, Cover, Faces, covered, covers, local, meeting, warn_near, weights
from mpm_dolfinx.grid.grid import FACES, REACH, Grid
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn
from mpm_dolfinx.points.cutting import TANGLED, centroids, domain_volumes, volumes
from mpm_dolfinx.points.material_points import MaterialPoints

UPRIGHT = 0.95  # cosine of the largest angle between an axis and the normals of faces on the side opposite to a contact


@dataclass
class Contact:
    """Contact between a seeded fill and a body, as pairs of faces."""

    side: tuple[int, int]  # (axis, end) of the fill
    own: Faces  # faces of the fill on this side
    other: Faces  # surface faces of the body
    cover: Cover  # pairs of these faces in contact
    moved: NDArray[np.float64]  # displacement of the corners of the body's faces since seeding (n, 4, d), m

    def area(self) -> float:
        """Return the contact area, in m^(d-1)."""
        return float(covered(len(self.own.row), self.cover) @ np.linalg.norm(self.own.outward, axis=1))

    def corners(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the domains (n, 1) of the fill's faces in the pairs, and the indices (n, 4) of their corners."""
        face = self.cover.face
        return self.own.row[face][:, None], self.own.index[face]

    def given(self) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which corners of the fill's faces touch the body, and the body's displacements at these corners."""
        face, by = self.cover.face, self.cover.by
        s, _ = local(self.other.corners[by], self.own.corners[face], self.other.outward[by])
        on = np.abs(s - 0.5).max(axis=2) <= 0.5 + np.maximum(self.cover.slack, SAME)[:, None]
        return on, weights(np.clip(s, 0, 1).reshape(-1, 2)).reshape(*s.shape[:2], 4) @ self.moved

    def misfit(self, u: NDArray[np.float64]) -> float:
        """Return the largest distance, in m, between corners of the body's faces and faces of the displaced fill."""
        on = (np.abs(self.cover.t - 0.5) <= 0.5).all(axis=2)
        share = weights(np.clip(self.cover.t, 0, 1).reshape(-1, 2)).reshape(*on.shape, 4)
        off = share @ u[self.corners()] - self.moved
        return float(np.linalg.norm(off, axis=2)[on].max(initial=0.0))


def touches(bodies: Sequence[Body], others: Sequence[int], fill: int) -> bool:
    """Return whether a seeded fill touches one of the bodies `others`."""
    own = Faces.around(bodies[fill])
    return any(len(covers(own, Faces.around(bodies[other])).face) for other in others)


def put(
    grid: Grid, bodies: Sequence[Body], others: Sequence[int], fill: int, points: MaterialPoints, new: MaterialPoints
) -> MaterialPoints:
    """Return the material points of a fill on the displaced surface of the active bodies.

    Sides of the fill that touch another body at seeding get the present displacement of this body.  The side opposite
    to the largest contact is not displaced.  Displacements between these sides are interpolated.  The fill has no
    velocity and no strain.

    Parameters
    ----------
    bodies, others, fill
        All bodies (`bodies`), the indices of the active bodies (`others`), and the index of the fill (`fill`).
    points, new
        Points of this process: present points of the active bodies (`points`), and seeded points of the fill (`new`).

    Raises
    ------
    ValueError
        An active body has moved into the space of the fill.
    """
    body = bodies[fill]
    corners = bodies[fill].corners() - grid.base
    misfit = 0.0
    found = {other: _contacts(grid, bodies, other, body, points) for other in others}
    contacts = [contact for one in found.values() for contact in one]
    if any(contact.moved.any() for contact in contacts):
        u = _follow(grid, body, corners, contacts)
        misfit = max(contact.misfit(u) for contact in contacts)
        _check_shape(grid, fill, corners, u)
        corners = corners + u
    if misfit > MISFIT * grid.least:
        what = "stage: add: body %d: its straight edges are up to %.2g m off the surface on which it is placed"
        warn(grid.comm, ResolutionWarning, what + "; seed it with the spacing of the body below", fill, misfit)
    for other, touching in found.items():
        depth, gap, x = _penetration(grid, bodies, other, corners, points, misfit)
        if depth:
            what = f"stage: add: body {fill}: body {other} has moved into it by {depth:.3g} m at {x + grid.base}"
            raise ValueError(f"{what}; must be seeded in space where no body is now")
        together = grid.copies == 1 or np.ptp(grid.copy(np.array([_start(bodies, i) for i in (other, fill)]))) == 0
        if together and not touching:
            warn_near(grid, f"bodies {other} and {fill}", gap, x + grid.base)
    own = corners[new.id - _start(bodies, fill)]
    if (own == new.corners).all():
        return new
    volume = domain_volumes(own, grid.axisymmetric)
    return replace(new, corners=own, x=centroids(own), volume0=volume, origin=own, reference=own)


def _start(bodies: Sequence[Body], body: int) -> int:
    """Return the identifier of the first material point of a body."""
    return sum(len(b) for b in bodies[:body])


def _contacts(grid: Grid, bodies: Sequence[Body], other: int, fill: Body, points: MaterialPoints) -> list[Contact]:
    """Return the contacts between a fill and a body."""
    around, out = Faces.around(bodies[other]), []
    for axis in range(grid.dim):
        for end in (0, 1):
            own = Faces.of(fill, *fill.facing(axis, end))
            cover = covers(own, around)
            if len(cover.face):
                rows, pair = np.unique(around.row[cover.by], return_inverse=True)
                now = np.zeros((len(rows), 2**grid.dim, grid.dim))
                known, at = points.find(_start(bodies, other) + rows)
                now[known] = points.corners[at]
                moved = over_all(grid.comm, now) - (bodies[other].corners(rows) - grid.base)
                moved = moved[pair[:, None], around.index[cover.by]]
                out.append(Contact((axis, end), own, around, cover, moved))
    return out


def _follow(grid: Grid, body: Body, corners: NDArray[np.float64], contacts: Sequence[Contact]) -> NDArray[np.float64]:
    """Return the displacements, in m, of the corners of a fill."""
    number = body.nodes(np.arange(len(body)))
    nodes, node = np.unique(number, return_inverse=True)
    node = node.reshape(number.shape)
    u = np.zeros((len(nodes), grid.dim))
    hits = np.zeros(len(nodes))
    x = np.empty((len(nodes), grid.dim))
    x[node] = corners
    for contact in contacts:
        on, moved = contact.given()
        at = node[contact.corners()]
        np.add.at(u, at[on], moved[on])
        np.add.at(hits, at[on], 1.0)
    u[hits > 0] /= hits[hits > 0, None]
    sides: dict[tuple[int, int], float] = {}
    for contact in contacts:
        sides[contact.side] = sides.get(contact.side, 0.0) + contact.area()
    axis, end = max(sides, key=sides.get)
    opposite = Faces.of(body, *body.facing(axis, 1 - end, UPRIGHT))
    fixed = np.minimum(np.abs(x - grid.low), np.abs(x - grid.high)) < SAME * grid.finest  # components normal to walls
    fixed[hits > 0] = True
    fixed[node[opposite.row[:, None], opposite.index]] = True
    K = _springs(body, node, len(nodes))
    return np.stack([_between(K, *column) for column in zip(fixed.T, u.T, strict=True)], axis=1)[node]


def _springs(body: Body, node: NDArray[np.int64], count: int) -> csr_array:
    """Return the stiffness matrix of springs along the edges of a body's domains."""
    X, ends = body.reference(), [(FACES[body.dim][2 * axis], FACES[body.dim][2 * axis + 1]) for axis in range(body.dim)]
    a, b = (np.concatenate([node[:, pair[k]].ravel() for pair in ends]) for k in (0, 1))
    length = np.concatenate([((X[:, f] - X[:, g]) ** 2).sum(axis=2).ravel() for f, g in ends])
    stiffness = length.min() / length
    W = coo_array((np.tile(stiffness, 2), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(count, count))
    return (diags(W.sum(axis=1)) - W).tocsr()


def _between(K: csr_array, fixed: NDArray[np.bool_], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the displacements of a network of springs with stiffness K, if the `fixed` nodes move by u."""
    out, free = u.copy(), np.flatnonzero(~fixed)
    if len(free):
        held = np.flatnonzero(fixed)
        rows = K[free]
        A = rows[:, free].tocsr()
        csr = (A.indptr.astype(PETSc.IntType), A.indices.astype(PETSc.IntType), A.data)
        matrix = PETSc.Mat().createAIJ(A.shape, csr=csr, comm=MPI.COMM_SELF)  # every process solves for the whole fill
        solver = PETSc.KSP().create(MPI.COMM_SELF)
        solver.setErrorIfNotConverged(True)
        solver.setOperators(matrix)
        solver.setType("cg")
        solver.getPC().setType("icc")
        solver.setTolerances(rtol=NEAR**2)
        x, b = matrix.createVecs()
        b.array[:] = -(rows[:, held] @ u[held])
        solver.solve(b, x)
        out[free] = x.array
        for made in (solver, matrix, x, b):
            made.destroy()
    return out


def _check_shape(grid: Grid, fill: int, corners: NDArray, u: NDArray) -> None:
    """Raise an error if a domain of the displaced fill is nearly flat, or outside the grid."""
    now = corners + u
    ratio = volumes(now) / volumes(corners)
    k = int(np.argmin(ratio))
    far = np.linalg.norm(u, axis=2).max()
    name = f"stage: add: body {fill}: its seeded neighbour has moved by up to {far:.3g} m"
    if ratio[k] < TANGLED:
        raise ValueError(
            f"{name}; the domain at {corners[k].mean(axis=0) + grid.base} keeps {ratio[k]:.2g} of its volume, "
            f"must keep at least {TANGLED}"
        )
    out = np.flatnonzero(grid.outside(now.reshape(-1, grid.dim), REACH))
    if len(out):
        x = now.reshape(-1, grid.dim)[out[0]] + grid.base
        raise ValueError(f"{name}; a corner of the fill moves to {x}, must be inside {grid.lower} to {grid.upper}")


def _penetration(
    grid: Grid, bodies: Sequence[Body], other: int, corners: NDArray, points: MaterialPoints, misfit: float
) -> tuple[float, float, NDArray[np.float64]]:
    """Return the overlap (m) of body and fill, their gap (cells), and its position; one of overlap and gap is 0."""
    start = _start(bodies, other)
    rows = np.flatnonzero((points.id >= start) & (points.id < start + len(bodies[other])))
    both = [(c, np.full(len(c), MISFIT / 2 * grid.least + misfit)) for c in (points.corners[rows], corners)]
    found = grid.comm.allgather(meeting(*both, grid.in_cells))
    deepest, nearest = max(found, key=lambda m: m[0]), min(found, key=lambda m: m[1])
    return deepest if deepest[0] else nearest
