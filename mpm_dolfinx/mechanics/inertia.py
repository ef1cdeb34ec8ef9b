# SPDX-License-Identifier: MIT
"""Inertia: consistent mass, velocities of material points and nodes, and accelerations in the substeps.

The inertial force per volume is rho a, with the density rho and the acceleration a = (u - u^) / (g dt)^2.  The
displacement since the start of the step is u.  The predictor u^ is the displacement without forces:

    u^ = b dt v_1 + g dt (v_n + b dt a_1),      v = v_n + dt (b a_1 + g a).

The velocity is v_n at the start of the step, and v at the end of the substep.  The previous substep has the velocity
v_1 and the acceleration a_1.  In the time integration (`time_integration`), this substep has the coefficient g, and the
previous substep has b.  In an oscillation of angular frequency omega, each step of SDIRK2 dissipates the
fraction GAMMA^4 (omega dt)^4 = 0.0074 (omega dt)^4 of the energy.

The mass is integrated over the pieces of the particle domains.  Piece k has the mass m_k, the centroid x_k, and the
second moments S_k about x_k.  With the shape functions N and the velocity gradient L, the nodal velocities v_n follow
from

    (M + G) v_n = sum m_k [N(x_k) v(x_k) + grad N . (L S_k)],
    M = sum m_k [N N^T + grad N S_k grad N^T + sum_(a < b) d_a d_b N (S_k)_aa (S_k)_bb d_a d_b N^T].

In 2D, M is exact for rectangles along the axes.  The mixed derivatives d_a d_b vanish for affine velocity fields.

The ghost mass `G = c rho h^3 int [[d_n N]] [[d_n N]] dS` acts on faces of cells that are not full.  Here c is
`GHOST_MASS`, h is the cell size, and [[d_n N]] is the jump of the normal derivative.  The ghost mass has no effect on
affine velocity fields.  The transfer to the grid and back conserves linear and angular momentum to rounding.

The ghost penalty P (`ghost_penalty`) has the force P (u - u^) = (g dt)^2 P a, so (g dt)^2 P is part of the mass, also
in the equation of v_n.  On the displacement u of the step, the penalty would be a viscosity and would dissipate energy.
In long steps, (g dt)^2 P removes the kinks from v_n and u^ at faces with a penalty.  The penalty then acts as without
inertia, and kinks of a fast vibration do not become displacements.

A material point stores the velocity v and the rate F' of F.  The velocity in its domain is v + F' F^-1 (x - x_p), with
the position x_p of the point.  Increments of nodal velocities give the increments of v and F' (Brackbill and Ruppel
1986; consistent mass: Burgess, Sulsky and Brackbill 1992).  The first substep of SDIRK2 is a midpoint rule, corrected
for rotations (`chord`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from itertools import combinations, combinations_with_replacement
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_matrix, csr_matrix

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import NEAR, ROUND_OFF, SAME
from mpm_dolfinx.base.validation import at_places, numbers
from mpm_dolfinx.conditions.acting import At, Loads
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.forms.point_forms import CellSums, FormPoints, Places, PointData
from mpm_dolfinx.forms.unknowns import Unknowns, matrix, sum_ghosts
from mpm_dolfinx.grid.grid import corner_bits, sum_by
from mpm_dolfinx.mechanics.ghost_penalty import kinks
from mpm_dolfinx.points.cutting import spreads
from mpm_dolfinx.points.material_points import RATE, VELOCITY, MaterialPoints, middle

GHOST_MASS = 0.02
"""Strength c of the ghost mass.  A rotating block has the same energies with 0.002 and 0.2 (tests/test_inertia.py).
Sensitivity (scene "bar" of tests/plateaus.py): half this value changes the result by 6.4e-03, and twice this value by
1.4e-02.  Finer cells change it by 1.1e-01.
"""
RELAXES = 2.0
"""Rate r of relaxation: in a motion by n cells, the unrepresented part of the point velocities decays by the factor
exp(-r n).

Relaxation removes velocity modes of the points that the nodes cannot represent (`Mass.carried`).  In a test, a
vibrating bar of 20 cells moves across 50 cells, with 40 steps a period.  After 25 periods the rms error of the velocity
is 1.4 % at the rate 0, and 0.7 % at the rates 0.1, 2 and 10.  The energy loss is 0.79 % at the rate 0, 0.81 % at the
rates 0.1 and 2, and 0.86 % at 10.

Sensitivity (scene "bar" of tests/plateaus.py): half this value changes the result by 5.2e-04, and twice this value by
6.6e-04. Finer cells change it by 1.1e-01.
"""


def resting(points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
    """Return zero velocities and zero rates of F for points at rest."""
    return moving(points, np.zeros(points.x.shape[1]), 0.0)


def moving(
    points: MaterialPoints,
    velocity: ArrayLike | Callable[[NDArray], ArrayLike],
    base: NDArray[np.float64],
    rings: bool = False,
) -> dict[str, NDArray[np.float64]]:
    """Return the point data `VELOCITY` and `RATE` of a velocity field.

    `velocity`: vector (d,), in m/s, or function of positions x (n, d) with values (n, d).  In each domain, the data
    represent the affine field nearest to the values at the corners.
    `base` (d,), in m: origin of the coordinates of the points.
    `rings`: whether the domains are rings (axisymmetry).
    """
    n, corners, d = points.corners.shape
    places = (points.corners + base).reshape(-1, d)
    shape = (len(places), d) if callable(velocity) else (d,)
    allowed = f"finite numbers of shape {shape}"
    values = at_places("velocity", allowed, velocity, "x", places) if callable(velocity) else velocity
    values = numbers("velocity", values, shape, allowed=allowed)
    values = np.broadcast_to(values, places.shape).reshape(n, corners, d)
    off = points.corners - middle(points.corners)[:, None]
    v = values.mean(axis=1)
    moment = np.einsum("nki,nkj->nij", values - v[:, None], off)
    L = np.linalg.solve(np.einsum("nki,nkj->nij", off, off), moment.swapaxes(1, 2)).swapaxes(1, 2)
    x = points.x
    if rings:
        x = x + spreads(points.corners, False)[:, 0] / points.x[:, :1]
    v = v + np.einsum("nij,nj->ni", L, x - middle(points.corners))
    return {VELOCITY: v, RATE: L @ points.F[:, :d, :d]}


def columns(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values (n, ...) as a contiguous array (..., n)."""
    return np.ascontiguousarray(values.transpose(*range(1, values.ndim), 0))


def inverses(A: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverses of matrices (d, d, n)."""
    if len(A) > 2:
        return columns(np.linalg.inv(A.transpose(2, 0, 1)))
    (a, b), (c, e) = A
    return np.array([[e, -b], [-c, a]]) / (a * e - b * c)


def product(A: NDArray[np.float64], B: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the products of matrices (d, d, n)."""
    out = A[:, 0, None] * B[0]
    for j in range(1, len(B)):
        out += A[:, j, None] * B[j]
    return out


def chord(G, midpoint):
    """Return F~ - I and F F~^-1 for a midpoint rule in which rotations cause no strain, as UFL.

    The deformation gradients at the start, midpoint and end of the step are F_n, F = F_n + D and F_n + 2 D.
    The mean of the right Cauchy-Green tensors at the start and at the end is F^T F + D^T D.  Laws are evaluated at F~,
    for which F~^T F~ is nearly this mean.  The law gives the stress P(F~).  The step has the Piola-Kirchhoff stress P:

        F~ = F + F^-T D^T D / 2,     F~^T F~ = F^T F + D^T D + O(D^4),     P = F F~^-1 P(F~).

    P F^T is symmetric, so moments balance.

    `G` (d, d): gradient of the displacement since the start of the step.
    `midpoint`: 1 for a midpoint rule, and 0 for F~ = F.
    """
    one = ufl.Identity(G.ufl_shape[0])
    delta = one + G
    more = G + midpoint / (2 * ufl.det(delta)) * ufl.cofac(delta) * G.T * G
    seen = one + more
    return more, 1 / ufl.det(seen) * delta * ufl.cofac(seen).T  # `ufl.inv` would divide each component


class InertiaForms:
    """Compiled forms of mass and momentum, with the coefficients of the midpoint rule.

    `points`: all integration points.
    `of_laws`: integration points of each law.
    """

    def __init__(self, points: FormPoints, of_laws: Sequence[FormPoints], u: fem.Function):
        self.grid, V = points.grid, u.function_space
        grid, d = self.grid, self.grid.dim
        self._u, self._rate = u, fem.Constant(grid.mesh, 0.0)
        self._flight = fem.Function(V)
        self.moved = fem.Function(V)
        """Displacement minus the inertial predictor at the last call of `move`, in m."""
        self.acceleration = self._rate * self.moved
        """Acceleration as UFL, in m/s^2."""
        self.midpoint = fem.Constant(grid.mesh, 0.0)
        """1 in a substep with a midpoint rule, and 0 in other substeps."""
        for seen in [points, *of_laws] if not grid.axisymmetric else []:  # axisymmetric bodies: no spin
            seen.chord = partial(chord, midpoint=self.midpoint)
        self.pieces = p = FormPoints(grid, spread=(d, d))
        both = ufl.as_vector([p.spread[a, a] * p.spread[b, b] for a, b in combinations(range(d), 2)])
        terms = [
            N * M + ufl.dot(g, p.spread * h) + sum(s * t * both[k] for k, (s, t) in enumerate(zip(n, m, strict=True)))
            for (N, g, n), (M, h, m) in combinations_with_replacement(p.shapes(), 2)
        ]
        self._mass = CellSums(terms, p)
        self.density = fem.Function(grid.cellwise())
        """Density of the material in the cells, in kg/m^3."""
        self.work = fem.Function(V)
        self._ghost = kinks(grid, V, GHOST_MASS * ufl.avg(self.density), 3)

    def set_substep(self, inertia: Inertia | None, midpoint: bool) -> None:
        """Set the coefficients of forms in a substep.  `midpoint`: whether the substep uses a midpoint rule."""
        self.midpoint.value = float(midpoint and inertia is not None)
        self._rate.value = 0.0 if inertia is None else inertia.rate
        if inertia is not None:
            self._flight.x.array[:] = inertia.flight

    def move(self) -> None:
        """Evaluate the acceleration at u."""
        np.subtract(self._u.x.array, self._flight.x.array, out=self.moved.x.array)

    def at(self, nodes: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return accelerations, in m/s^2, in cells with these nodes.  `values`: shape functions at the positions."""
        nodal = self.moved.x.array.reshape(-1, self.grid.dim)[nodes]
        return self._rate.value * np.add.reduce(values[:, :, None] * nodal, axis=1)

    def on(
        self,
        cut: CutDomains,
        places: Places,
        mass: NDArray[np.float64],
        fill: NDArray[np.float64],
        facets: NDArray[np.int32],
        unknowns: Unknowns,
        held: Unknowns,
        penalty: Loads,
    ) -> Mass:
        """Return the mass of the bodies on the grid.

        `places`: pieces of the domains in owned cells.
        `mass` (n,), in kg: masses of the points.
        `fill` (cells,): volume fractions of the local cells.
        `facets`: faces between two active cells, at least one of them not full.
        `unknowns`: unknown displacements.  `held`: displacements that walls of the grid fix.
        `penalty`: ghost penalty.
        """
        grid = self.grid
        of_pieces = cut.shares(mass)
        pieces = PointData(self.pieces, places, of_pieces, {"spread": cut.pieces_to_cells(cut.pieces.second)})
        content = sum_by(cut.cells, of_pieces, grid.num_local)
        volume = fill * grid.volumes(np.arange(grid.num_local))
        self.density.x.array[:] = np.divide(content, volume, out=np.zeros_like(content), where=volume > 0)
        self.density.x.scatter_forward()
        ghost = self._ghost.on(facets)
        nodes, matrices = 2**grid.dim, []
        of_cells = np.empty((len(places.filled), nodes, nodes))
        i, j = np.triu_indices(nodes)
        of_cells[:, i, j] = of_cells[:, j, i] = self._mass(pieces)
        at, length = grid.cell_nodes[places.filled], 3**grid.dim + 2 * grid.dim * 3 ** (grid.dim - 1)
        for of in (unknowns, held):
            near = (of.map.indices.reshape(-1, grid.dim)[at] >= 0).any(axis=(1, 2))
            both = [matrix(of, unknowns, length) for _ in range(1 + penalty.some)]
            for A in both:
                A.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, True)  # the matrices do not couple the axes
            for dofs in (at[near] * grid.dim + axis for axis in range(grid.dim * near.any())):
                both[0].setValuesLocalRCV(*[dofs.astype(PETSc.IntType)] * 2, of_cells[near], addv=True)
            ghost.assemble_matrix(both[0])
            penalty.penalty(both[-1], of is held)
            for A in both:
                A.assemble()
            matrices.append((both[0], both[1] if penalty.some else None))
        return Mass(self, cut, pieces, unknowns, *matrices)


class Mass:
    """Mass of the bodies on the grid, constant until the next reset of the grid.

    `pieces`: integration points of the pieces, with masses, in kg, as weights.
    `matrices`: mass matrix `M`, in kg, and ghost penalty `ghost`, in N/m, with the rows of the unknowns.  Without faces
    that have a penalty, `ghost` is None.
    `held`: the same matrices with the rows of displacements that walls of the grid fix.
    """

    def __init__(
        self, forms: InertiaForms, cut: CutDomains, pieces: PointData, unknowns: Unknowns, matrices: tuple, held: tuple
    ):
        self._forms, self._cut, self._pieces, self.unknowns = forms, cut, pieces, unknowns
        self.M, self.ghost = matrices
        self.held = held
        self._stiffness = Latest()
        self._solver = ksp = PETSc.KSP().create(unknowns.comm)
        ksp.setType(PETSc.KSP.Type.CG)
        kinds = PETSc.PC.Type  # the same preconditioner; the faster one is for one process
        ksp.getPC().setType(kinds.EISENSTAT if ksp.comm.size == 1 else kinds.SOR)
        ksp.setTolerances(rtol=ROUND_OFF, atol=0.0, divtol=np.inf)

    def stiffness(self, rate: float) -> PETSc.Mat:
        """Return the derivative, in N/m, of the inertia forces with respect to u.  `rate`, in 1/s^2: see `Inertia`."""
        return self._stiffness(rate, lambda: self.M * rate if self.ghost is None else self.M * rate + self.ghost)

    def velocity(self, fields: NDArray[np.float64], rate: float) -> PETSc.Vec:
        """Return the velocities of the unknowns, in m/s, projected from the velocities of the points.

        `fields`: result of `affine`.  `rate`, in 1/s^2: see `Inertia`.
        """
        cut, work = self._cut, self._forms.work
        sent = cut.pieces_to_cells(fields.take(cut.pieces.point, axis=2).transpose(2, 0, 1))
        for axis, momenta in enumerate(columns(sent) * self._pieces.volume):
            work.x.array[axis :: len(fields)] = self._shapes[0] @ momenta.ravel()
        rhs, out = self.unknowns.gather(sum_ghosts(work), self.unknowns.vector()), self.unknowns.vector()
        rate = max(rate, self._least_rate)
        rhs.scale(rate)
        self._solver.setOperators(self.stiffness(rate))
        self._solver.solve(rhs, out)
        return out

    def size(self, velocity: PETSc.Vec, drift: ArrayLike) -> float:
        """Return the mass norm, in J^(1/2), of velocities relative to a uniform velocity `drift` (d,).

        The result is at least `NEAR` times the mass norm of the velocities.
        """
        uniform = np.zeros_like(self._forms.work.x.array)
        uniform.reshape(-1, self._forms.grid.dim)[:] = drift
        relative = velocity - self.unknowns.gather(uniform, self.unknowns.vector())
        size, whole = (float(np.sqrt(v.dot(self.M * v))) for v in (relative, velocity))
        return max(size, NEAR * whole)

    def carried(
        self,
        points: MaterialPoints,
        velocities: tuple[PETSc.Vec, PETSc.Vec],
        rate: float,
        moved: NDArray | None,
        parts: tuple[NDArray[np.int64], int],
    ) -> dict[str, NDArray[np.float64]]:
        """Return the point data `VELOCITY` and `RATE` after a step.

        Let Q v be the projection of point velocities v to the nodes and back.  The part that relaxes is (1 - Q)^2 v, as
        in XPIC of order 2 (Hammerquist and Nairn 2017).  Modes that the nodes represent partly are thus damped less
        than by (1 - Q) v.  This part has at most the kinetic energy that the variation of Q v within cells has.
        Without this limit it would remain in a body that comes to rest.

        `points`: material points at the start of the step.
        `velocities`: velocities of the unknowns, in m/s, at the start and at the end of the step.
        `rate`, in 1/s^2: see `Inertia`.
        `moved` (n,): motion of the points in the step, in cell sizes, or 0 for points that keep their pieces.  None:
        all points keep them.
        `parts`: index (n,) of the connected part of each point, and the number of parts.
        """
        change = self._at_points(velocities[1] - velocities[0])
        if moved is not None:
            seen, now = self._at_points(velocities[0]), affine(points)
            unseen = now - seen - self._at_points(self.velocity(now - seen, rate))
            excess = self._excess(points, unseen, seen + change, *parts)
            change -= np.where(moved > 0, np.maximum(-np.expm1(-RELAXES * moved), excess), 0.0) * unseen
        rates = product(change[:, 1:], columns(points.F[:, : len(change), : len(change)]))
        return {VELOCITY: points.velocity + change[:, 0].T, RATE: points.data[RATE] + rates.transpose(2, 0, 1)}

    def _excess(
        self, points: MaterialPoints, unseen: NDArray, seen: NDArray, part: NDArray[np.int64], count: int
    ) -> NDArray[np.float64]:
        """Return the fraction (n,) of the `unseen` velocities beyond their largest energy, see `carried`."""
        grid, (L, rate) = self._forms.grid, (unseen[:, 1:], seen[:, 1:])
        own = (unseen[:, 0] ** 2).sum(axis=0) + (product(L, self._second[0]) * L).sum(axis=(0, 1))
        within = ((rate**2).sum(axis=0).T * grid.sizes_at(points.x) ** 2).sum(axis=1) / 12
        energies = sum_by(part, points.volume0 * points.J * [own, within], count)
        grid.comm.Allreduce(MPI.IN_PLACE, energies)
        own, within = energies
        return 1 - np.sqrt(np.divide(within, own, out=np.ones(count), where=own > within))[part]

    def local(self, v: PETSc.Vec) -> NDArray[np.float64]:
        """Return a vector of the unknowns as a local array with zeros at fixed displacements."""
        work = self._forms.work
        work.x.array[:] = 0.0
        self.unknowns.add(work.x, 1.0, v)
        return work.x.array.copy()

    @cached_property
    def _offsets(self) -> NDArray[np.float64]:
        """Vectors (d, m), in m, from centroids of domains to centroids of pieces."""
        point = self._cut.pieces.point
        off = columns(self._cut.pieces.x - self._cut.points.x[point])
        return off - self._mean(off).take(point, axis=1)

    @cached_property
    def _second(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Second moments (d, d, n) of the domains about their centroids, in m^2, and inverses of these matrices."""
        second = self._mean(self._offsets[:, None] * self._offsets + columns(self._cut.pieces.second))
        return second, inverses(second)

    @cached_property
    def _shapes(self) -> tuple[csc_matrix, csr_matrix]:
        """Matrix (nodes, (1 + d) m) from momenta of the m pieces to nodes, and from nodes to velocities of the pieces.

        The second matrix is the transpose, but in 3D its gradients are means over pieces.
        """
        cut, places = self._cut, self._pieces.places
        off, second = (columns(cut.pieces_to_cells(of)) for of in (self._offsets.T, cut.pieces.second))
        grid, d, out = places.grid, places.grid.dim, []
        nodes = grid.cell_nodes[places.cells]
        of = grid.over_edges(grid.monomials.T[:, :, None], places.cells)
        values = sum(of[:, k] * np.multiply.reduce(places.offset.T[bits == 1]) for k, bits in enumerate(corner_bits(d)))
        index = np.tile(nodes.ravel(), 1 + d), np.arange(0, (1 + d) * nodes.size + 1, 2**d, dtype=nodes.dtype)
        for at in (places,) if d == 2 else (Places(grid, places.cells, places.x), places):
            slopes = np.array([sum(of[:, k | 1 << a] * terms for k, terms in at.products[a]) for a in range(d)])
            moments = (x * values + sum(map(np.multiply, S, slopes)) for x, S in zip(off, second, strict=True))
            data = np.array([rows.T for rows in (values, *moments)]).ravel()
            out.append(csr_matrix((data, *index), (len(index[1]) - 1, len(grid.node_x))))
        return out[0].T, out[-1]

    @cached_property
    def _least_rate(self) -> float:
        """Smallest `rate`, in 1/s^2, for which the sum of mass and ghost penalty has half of the digits of the mass."""
        if self.ghost is None:
            return 0.0
        ratio = self.ghost.getDiagonal().array_r / self.M.getDiagonal().array_r
        return SAME * self._forms.grid.comm.allreduce(ratio.max(initial=0.0), MPI.MAX)

    def _mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the volume-weighted mean (..., n) of values (..., m) over the pieces of each point."""
        pieces = self._cut.pieces
        return sum_by(pieces.point, pieces.fraction * values, len(self._cut.points))

    def _at_points(self, v: PETSc.Vec) -> NDArray[np.float64]:
        """Return affine fields as `affine`: in each domain, the field nearest to the field of the nodal velocities."""
        cut, d, nodal = self._cut, self._forms.grid.dim, self.local(v)
        of = np.array([self._shapes[1] @ nodal[axis::d] for axis in range(d)]).reshape(d, 1 + d, -1)
        out = self._mean(columns(cut.to_pieces(of.transpose(2, 0, 1))))
        out[:, 1:] = product(out[:, 1:], self._second[1])
        return out


def affine(points: MaterialPoints) -> NDArray[np.float64]:
    """Return the velocities of the domains (d, 1 + d, n): of the points, in m/s, and velocity gradients, in 1/s."""
    return np.concatenate([columns(points.velocity)[:, None], velocity_gradients(points).transpose(1, 2, 0)], axis=1)


def velocity_gradients(points: MaterialPoints) -> NDArray[np.float64]:
    """Return the velocity gradients (n, d, d) of the points, in 1/s, without a circumferential component."""
    d = points.x.shape[1]
    return product(columns(points.data[RATE]), inverses(columns(points.F[:, :d, :d]))).transpose(2, 0, 1)


class Inertia(Loads):
    """Inertia forces in a substep.

    `flight`, in m: inertial predictor, the displacement without forces.
    `rate`, in 1/s^2: acceleration divided by (displacement - flight).
    """

    holding = True

    def __init__(self, mass: Mass, flight: PETSc.Vec, rate: float):
        self._mass, self._flight, self.rate = mass, flight, rate
        self._work, self._forces = flight.duplicate(), flight.duplicate()

    @cached_property
    def flight(self) -> NDArray[np.float64]:
        """Inertial predictor, in m, as a local array."""
        return self._mass.local(self._flight)

    def acceleration(self, at: At) -> PETSc.Vec:
        """Return the accelerations of the unknowns at u, in m/s^2."""
        return self._moved(at) * self.rate

    def _moved(self, at: At) -> PETSc.Vec:
        """Return the displacements of the unknowns minus the predictor, in m."""
        u = at.unknowns.gather(at.u, self._work)
        u.axpy(-1.0, self._flight)
        return u

    def inertia(self, at: At) -> PETSc.Vec:
        """Return the inertia forces at u, in N."""
        self._mass.stiffness(self.rate).mult(self._moved(at), self._forces)
        return self._forces

    @cached_property
    def rounding_at_unknowns(self) -> NDArray[np.float64]:
        """Rounding errors of the inertia forces, in N."""
        moved = self._flight.copy()
        moved.abs()
        return ROUND_OFF * self.rate * np.abs((self._mass.M * moved).array_r)

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Add the inertia forces to the residual at fixed nodes."""
        if on is not self._mass.unknowns:
            (M, ghost), moved = self._mass.held, self._moved(at)
            residual += M * moved * self.rate if ghost is None else M * moved * self.rate + ghost * moved

    def coupling(self, at: At) -> PETSc.Mat:
        """See `Loads`."""
        return self._mass.stiffness(self.rate)


class Flight(NamedTuple):
    """Velocities and acceleration of the unknowns within a step."""

    start: PETSc.Vec  # velocities at the start of the step, m/s
    velocity: PETSc.Vec  # velocities after the last substep, m/s
    acceleration: PETSc.Vec | None = None  # acceleration in the last substep, m/s^2

    def free(self, own: float, before: float) -> PETSc.Vec:
        """Return the predictor of the next substep, in m."""
        flight = self.start * own
        if self.acceleration is not None:
            flight += self.velocity * before + self.acceleration * (own * before)
        return flight

    def after(self, acceleration: PETSc.Vec, own: float, before: float) -> Flight:
        """Return the velocities and the acceleration after the next substep."""
        velocity = self.start + acceleration * own
        if self.acceleration is not None:
            velocity += self.acceleration * before
        return Flight(self.start, velocity, acceleration)
