# SPDX-License-Identifier: MIT
"""Inertia: consistent mass, velocities of points and nodes, and the accelerations of the substeps.

A substep of a step of length dt balances rho a with a = (u - u^) / (g dt)^2: u^ is the displacement of free flight,

    u^ = b dt v_1 + g dt (v_n + b dt a_1),      v = v_n + dt (b a_1 + g a),

g and b the shares of its own rate and of that of the substep before (`time_integration`).  Only velocities are carried
from step to step.  SDIRK2 loses GAMMA^4 (omega dt)^4, 0.74 % of (omega dt)^4, of the energy of an oscillation in a
step, and damps modes that the step cannot resolve.

The mass is that of the pieces of the domains, with their second moments S about their centroids x_k,

    (M + G) v_n = sum m_k [N(x_k) v(x_k) + grad N . (L S_k)],    M = sum m_k [N N^T + grad N S_k grad N^T],

G = c rho h^3 int [[d_n N]] [[d_n N]] dS on faces of cells that are not full.  G is zero for affine fields, on which M
and the right side agree: linear and angular momentum survive the way to the grid and back to rounding.  Points carry v
and the rate of F, an affine field v + F' F^-1 (x - x_p) over their domain.  Its increments come from the grid
(Brackbill and Ruppel 1986; consistent mass: Burgess, Sulsky and Brackbill 1992).  The first substep of SDIRK2 is the
midpoint rule of a shorter step, in which a chord stands for the arc of a turn: see `chord`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import ROUND_OFF
from mpm_dolfinx.base.validation import at_places, check_names, flag, line, numbers
from mpm_dolfinx.conditions.acting import At, Loads
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.forms.point_forms import FormPoints, Places, PointData, PointForm
from mpm_dolfinx.forms.unknowns import Unknowns, matrix, sum_ghosts
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.mechanics.ghost_penalty import kinks
from mpm_dolfinx.points.cutting import spreads
from mpm_dolfinx.points.material_points import MaterialPoints, middle

GHOST_MASS = 0.02
"""Strength c of the ghost mass: a turning block keeps its momentum and energy alike with a tenth and ten times of it.

That is a test of `tests/test_inertia.py`.
"""
RELAXES = 2.0
"""Rate, per cell that a corner has moved, at which velocities of points relax to those of the grid.

It removes what points have and nodes do not see.  A bar of 20 cells that vibrates and flies over 50, 40 steps a period,
has errors of its velocity of 1.7, 1.2, 1.2 and 1.2 % after 25 periods with 0, 0.1, 2 and 10, and loses 1.58, 1.60, 1.60
and 1.67 % of its energy.
"""

VELOCITY, RATE = "velocity", "F_rate"
"""Names of what points carry: velocity (n, d), m/s, at the centroid, and rate of F (n, d, d), 1/s."""


def resting(points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
    """Return what points carry that are at rest."""
    return moving(points, np.zeros(points.x.shape[1]), 0.0)


def checked_velocity(
    grid: Grid, quadrature: str, inertia: bool | None, velocity: ArrayLike | Callable | None
) -> ArrayLike | Callable | None:
    """Return the velocity at the start of bodies that may have inertia, zero where none is given; None of others.

    Raises
    ------
    ValueError
        A velocity without inertia, or inertia where there can be none.
    """
    if inertia is None:
        if velocity is not None:
            raise ValueError(f"velocity = {line(velocity)}: bodies have no inertia, must be given with inertia=True")
        return None
    flag("inertia", inertia)
    if quadrature != "domain":
        raise ValueError(f"inertia = {inertia}: not with quadrature {quadrature!r}, must be left out")
    if velocity is not None and not inertia:
        raise ValueError(f"velocity = {line(velocity)}: bodies are at rest at first, must be given with inertia=True")
    if callable(velocity):
        check_names("velocity", velocity, ("x",))
    elif grid.axisymmetric and velocity is not None and np.ravel(velocity)[:1].any():
        raise ValueError(f"velocity = {line(velocity)}, must be (0, v): axisymmetric bodies move along the axis")
    return np.zeros(grid.dim) if velocity is None else velocity


def moving(
    points: MaterialPoints,
    velocity: ArrayLike | Callable[[NDArray], ArrayLike],
    base: NDArray[np.float64],
    rings: bool = False,
) -> dict[str, NDArray[np.float64]]:
    """Return what points carry that move as given: `VELOCITY` and `RATE`.

    Parameters
    ----------
    velocity : (d,) or callable x (n, d) -> (n, d), m/s
        Velocity, or a function of places, of which domains take the nearest affine field.
    base : (d,), m
        Place from which those of the points count.
    rings
        Whether domains are rings, whose centroids are those of their volumes.

    Raises
    ------
    ValueError
        It has another shape, or is not finite.
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


def inverses(A: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverses of matrices (n, d, d): in the plane in a tenth of the time of numpy's."""
    if A.shape[1] > 2:
        return np.linalg.inv(A)
    (a, b), (c, e) = A.transpose(1, 2, 0)
    out = np.stack([e, -b, -c, a], axis=1) / (a * e - b * c)[:, None]
    return out.reshape(A.shape)


def chord(G: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the increment less one that laws see in a midpoint rule, and the turn of their stress, both (n, d, d).

    With C = F^T F at both ends of the rule, F_n and F_n + 2 D, its mean is F^T F + D^T D for F = F_n + D.  Laws see

        F~ = F + F^-T D^T D / 2,     F~^T F~ = F^T F + D^T D + O(D^4),     P = F F~^-1 P(F~):

    a rigid turn then stretches nothing, however stiff the body, and P F^T is symmetric, so moments balance.

    Parameters
    ----------
    G : (n, d, d)
        Gradient of the displacement since the start of the step.
    """
    one = np.eye(G.shape[1])
    delta = one + G
    seen = delta + 0.5 * inverses(delta).swapaxes(1, 2) @ (G.swapaxes(1, 2) @ G)
    return seen - one, delta @ inverses(seen)


class InertiaForms:
    """The compiled forms of inertia, and what those of stresses and fluxes see of it.

    Parameters
    ----------
    points
        All points of integration.
    of_laws
        Those of each law.
    u
        Increment of the displacement in the step, m.
    """

    def __init__(self, points: FormPoints, of_laws: Sequence[FormPoints], u: fem.Function):
        self.grid, V = points.grid, u.function_space
        grid, d = self.grid, self.grid.dim
        self._u, self._flight, self._rate = u, fem.Function(V), fem.Constant(grid.mesh, 0.0)
        self.acceleration = self._rate * (u - self._flight)
        """Acceleration at u as UFL, m/s^2."""
        self._midpoint = fem.Constant(grid.mesh, 0.0)
        for seen in dict.fromkeys([points, *of_laws] if not grid.axisymmetric else []):  # no ring turns rigidly
            chords: Latest[tuple[NDArray, NDArray]] = Latest()
            seen.follow("gradient", (d, d), partial(self._seen, chords, 0))
            seen.follow("turn", (d, d), partial(self._seen, chords, 1))
        a, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        self.pieces = p = FormPoints(grid, spread=(d, d))
        self._mass = PointForm(
            (ufl.inner(p.value(a), p.value(v)) + ufl.inner(p.plane_grad(a) * p.spread, p.plane_grad(v))) * p.dx, p
        )
        self.moving = p = FormPoints(grid, velocity=(d,), turn=(d, d))
        self._momentum = PointForm((ufl.inner(p.velocity, p.value(v)) + ufl.inner(p.turn, p.plane_grad(v))) * p.dx, p)
        self.density = fem.Function(grid.cellwise())
        """Density (cells,) of what the cells hold, kg/m^3."""
        self.work = fem.Function(V)
        self._ghost = kinks(grid, V, GHOST_MASS * ufl.avg(self.density), 3)

    def set_substep(self, inertia: Inertia | None, midpoint: bool) -> None:
        """Set the acceleration that forms see, none of bodies at rest; midpoint: whether the substep is such a rule."""
        self._midpoint.value = float(midpoint and inertia is not None)
        self._rate.value = 0.0 if inertia is None else inertia.rate
        if inertia is not None:
            self._flight.x.array[:] = inertia.flight

    def at(self, cells: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the accelerations (n, d), m/s^2, at u in cells, by values (n, 2^d) of the shape functions there."""
        nodal = self._rate.value * (self._u.x.array - self._flight.x.array).reshape(-1, self.grid.dim)
        return np.einsum("nk,nkd->nd", values, nodal[self.grid.cell_nodes[cells]])

    def _seen(self, chords: Latest[tuple[NDArray, NDArray]], which: int, data: PointData) -> NDArray[np.float64]:
        """Return gradients that laws see, or turns of their stress (n, d^2): see `chord`.

        chords: the last ones, that all forms at the same u share.
        """
        G, d = data.gradients(self._u), self.grid.dim
        if self._midpoint.value:
            return chords(G, lambda: chord(G.reshape(-1, d, d)))[which].reshape(-1, d * d)
        return np.broadcast_to(np.eye(d).ravel(), G.shape) if which else G

    def on(
        self,
        cut: CutDomains,
        mass: NDArray[np.float64],
        fill: NDArray[np.float64],
        facets: NDArray[np.int32],
        unknowns: Unknowns,
        held: Unknowns,
    ) -> Mass:
        """Return the mass of bodies on the grid.

        Parameters
        ----------
        cut
            The domains of the points, cut.
        mass : (n,), kg
            Of the points.
        fill : (cells,)
            Filled shares of the local cells.
        facets
            Faces between two active cells one of which is not full.
        unknowns, held
            Of the displacement, and what walls hold.
        """
        grid = self.grid
        rows = cut.pieces_to_cells(cut.pieces.fraction * mass[cut.pieces.point])
        places = Places(grid, cut.cells, cut.x, cut.mixed, cut.hoop)
        pieces = PointData(self.pieces, places, rows, {"spread": cut.second})
        content = sum_by(cut.cells, rows, grid.num_local)
        volume = fill * grid.cell_volume
        self.density.x.array[:] = np.divide(content, volume, out=np.zeros_like(content), where=volume > 0)
        self.density.x.scatter_forward()
        ghost = self._ghost.on(facets)
        matrices = []
        for of in (unknowns, held):
            A = matrix(of, unknowns, grid.dim * 3**grid.dim + 2 * grid.dim * 3 ** (grid.dim - 1) * grid.dim)
            self._mass.assemble_matrix(A, pieces)
            ghost.assemble_matrix(A)
            A.assemble()
            matrices.append(A)
        return Mass(self, cut, pieces, unknowns, *matrices)


class Mass:
    """The mass of the bodies on the grid, while a cut serves.

    Parameters
    ----------
    forms
        Compiled forms.
    cut
        The domains of the points, cut.
    pieces
        Their pieces, with masses, kg, as weights.
    unknowns
        Of the displacement.
    M, held
        Masses, kg, of the unknowns, and of what walls hold beside them.
    """

    def __init__(
        self,
        forms: InertiaForms,
        cut: CutDomains,
        pieces: PointData,
        unknowns: Unknowns,
        M: PETSc.Mat,
        held: PETSc.Mat,
    ):
        self._forms, self._cut, self._pieces, self.unknowns, self.M, self.held = forms, cut, pieces, unknowns, M, held
        self._solver = ksp = PETSc.KSP().create(unknowns.comm)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.getPC().setType(PETSc.PC.Type.JACOBI)
        ksp.setOperators(M)
        ksp.setTolerances(rtol=ROUND_OFF, atol=0.0)

    def velocity(self, points: MaterialPoints) -> PETSc.Vec:
        """Return the velocities of the unknowns, m/s: the projection of those of the points."""
        cut, forms, pieces, b = self._cut, self._forms, self._pieces, self._forms.work.x.array
        L = velocity_gradients(points)
        v = points.data[VELOCITY][cut.pieces.point] + np.einsum("nij,nj->ni", L[cut.pieces.point], self._off)
        turn = L[cut.pieces.point] @ cut.pieces.second
        fields = {"velocity": cut.pieces_to_cells(v), "turn": cut.pieces_to_cells(turn)}
        b[:] = 0.0
        forms._momentum.assemble_vector(b, PointData(forms.moving, pieces.places, pieces.volume, fields))
        rhs = self.unknowns.gather(sum_ghosts(forms.work), self.unknowns.vector())
        out = self.unknowns.vector()
        self._solver.solve(rhs, out)
        return out

    def carried(
        self, points: MaterialPoints, velocities: tuple[PETSc.Vec, PETSc.Vec], moved: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float64]]:
        """Return velocities and rates of F that points have after a step.

        Parameters
        ----------
        points
            At the start of the step.
        velocities
            Of the unknowns, at its start and end, m/s.
        moved : (n,)
            Cells by which corners have moved at most where the grid is reset, else 0.
        """
        start, end = velocities
        out = {name: points.data[name] + more for name, more in self._at_points(points, end - start).items()}
        if self._forms.grid.comm.allreduce(int(moved.any())):
            k = -np.expm1(-RELAXES * moved)
            for name, values in self._at_points(points, start).items():
                own = points.data[name]
                out[name] += k.reshape(-1, *[1] * (own.ndim - 1)) * (values - own)
        return out

    def local(self, v: PETSc.Vec) -> NDArray[np.float64]:
        """Return a vector of the unknowns as a local array, ghosts included, zero where walls hold."""
        work = self._forms.work
        work.x.array[:] = 0.0
        self.unknowns.add(work, 1.0, v)
        return work.x.array.copy()

    @cached_property
    def _off(self) -> NDArray[np.float64]:
        """Ways (m, d), m, from the centroids of the domains to those of their pieces."""
        pieces = self._cut.pieces
        return pieces.x - self._cut.mean(pieces.x)[pieces.point]

    @cached_property
    def _focus(self) -> NDArray[np.float64]:
        """Inverses (n, d, d), 1/m^2, of the second moments of the domains about their centroids."""
        return inverses(self._cut.mean(self._off[:, :, None] * self._off[:, None] + self._cut.pieces.second))

    def _at_points(self, points: MaterialPoints, v: PETSc.Vec) -> dict[str, NDArray[np.float64]]:
        """Return the affine field over each domain that is nearest to nodal velocities: `VELOCITY` and `RATE`."""
        cut, grid, d, nodal = self._cut, self._forms.grid, self._forms.grid.dim, self.local(v)
        at, slope = grid.at(cut.cells, cut.x, nodal.reshape(-1, d)), self._pieces.gradients_of(nodal)
        at, slope = (cut.to_pieces(values) for values in (at, slope.reshape(-1, d, d)))
        mean = cut.mean(at)
        moment = (at - mean[cut.pieces.point])[:, :, None] * self._off[:, None] + slope @ cut.pieces.second
        return {VELOCITY: mean, RATE: cut.mean(moment) @ self._focus @ points.F[:, :d, :d]}


def velocity_gradients(points: MaterialPoints) -> NDArray[np.float64]:
    """Return the velocity gradients (n, d, d), 1/s, of points, in axisymmetry in the plane."""
    d = points.x.shape[1]
    return points.data[RATE] @ inverses(points.F[:, :d, :d])


class Inertia(Loads):
    """Inertia in a substep.

    Parameters
    ----------
    mass
        Of the bodies on the grid.
    flight
        Displacement of free flight, m.
    rate
        (Own share of the step)^-2, 1/s^2.
    """

    holding = True

    def __init__(self, mass: Mass, flight: PETSc.Vec, rate: float):
        self._mass, self._flight, self.rate = mass, flight, rate

    @cached_property
    def flight(self) -> NDArray[np.float64]:
        """The displacement of free flight, a local array, m."""
        return self._mass.local(self._flight)

    def acceleration(self, at: At) -> PETSc.Vec:
        """Return the accelerations of the unknowns at u, m/s^2."""
        u = at.unknowns.gather(at.u, at.unknowns.vector())
        u.axpy(-1.0, self._flight)
        u.scale(self.rate)
        return u

    def inertia(self, at: At) -> PETSc.Vec:
        """Return the forces that accelerate the bodies at u, N."""
        return self._mass.M * self.acceleration(at)

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Add what accelerates nodes beside walls to what these bear."""
        if on is not self._mass.unknowns:
            residual += self._mass.held * self.acceleration(at)

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return zeros where the mass has entries."""
        zeros = self._mass.M.copy()
        zeros.zeroEntries()
        return zeros

    @cached_property
    def _slope(self) -> PETSc.Mat:
        slope = self._mass.M.copy()
        slope.scale(self.rate)
        return slope

    def coupling(self, at: At) -> PETSc.Mat:
        """Return the derivative of the forces by u."""
        return self._slope


class Flight(NamedTuple):
    """Velocities of the unknowns, m/s, at the start of a step and after a substep, and its acceleration, m/s^2."""

    start: PETSc.Vec
    velocity: PETSc.Vec
    acceleration: PETSc.Vec | None = None

    def free(self, own: float, before: float) -> PETSc.Vec:
        """Return the displacement of free flight at the end of the next substep, m; own, before: its shares, s."""
        flight = self.start * own
        if self.acceleration is not None:
            flight += self.velocity * before + self.acceleration * (own * before)
        return flight

    def after(self, acceleration: PETSc.Vec, own: float, before: float) -> Flight:
        """Return what is known after the next substep."""
        velocity = self.start + acceleration * own
        if self.acceleration is not None:
            velocity += self.acceleration * before
        return Flight(self.start, velocity, acceleration)
