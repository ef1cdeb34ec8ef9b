# SPDX-License-Identifier: MIT
"""Forms on the sides of the bodies, compiled when first asked for: loads, pressures, plates, given displacements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.conditions.conditions import OnSide
from mpm_dolfinx.contact.problem import ContactProblem
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.forms.unknowns import sum_ghosts
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.mechanics.held_cells import HeldCells


@dataclass(frozen=True)
class SideData:
    """What acts on the sides of the bodies in a step; None where there is no such condition.

    loads: with their force; pressures: with their force on the area at the start of the step; plates: with their
    rigidity, normal and present tilt; holds: components of given displacements, with stiffness, direction and gap;
    held: what holds them; row: which of it each component is; share (m, 2^d): of its force on each node, but for what
    walls bear; own: of each term of the user's own; contacts: with tools, and of groups of bodies.
    """

    loads: PointData | None
    pressures: PointData | None
    plates: PointData | None
    holds: PointData | None
    held: HeldCells | None
    row: NDArray[np.int64]
    share: NDArray[np.float64]
    own: tuple[PointData, ...] = ()
    contacts: tuple[ContactProblem, ...] = ()

    def moved(self, u: fem.Function) -> SideData:
        """Return the same with the forces that what holds sides has after a displacement u, m, of the nodes.

        Given displacements are then off their place, and plates tilted, by so much more.
        """
        holds, plates = self.holds, self.plates
        if holds is not None:
            holds = holds.having(gap=holds["gap"][:, 0] - self.along(u.x.array.reshape(-1, holds.points.grid.dim)))
        if plates is not None:
            n, d = plates["normal"], plates.points.grid.dim
            slope = np.einsum("ni,nij->nj", n, plates.gradients(u).reshape(-1, d, d))
            plates = plates.having(tilt=plates["tilt"] + slope - (slope * n).sum(axis=1, keepdims=True) * n)
        return replace(self, holds=holds, plates=plates)

    @property
    def asked(self) -> NDArray[np.int64] | None:
        """Which components of which rows (m,) hold sides; None where nothing does."""
        if self.holds is None:
            return None
        return self.holds.points.grid.dim * self.row + self.holds["direction"].argmax(axis=1)

    def along(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacement (m,), m, of each component that is given, at nodal values u (nodes, d), m."""
        at_nodes = u[self.holds.points.grid.cell_nodes[self.holds.cells]]
        return np.einsum("mk,mkd,md->m", self.held.shape[self.row], at_nodes, self.holds["direction"])

    def pull(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the force (m,), N, along each component that is given, at nodal values u (nodes, d), m."""
        return self.holds["stiffness"][:, 0] * (self.holds["gap"][:, 0] - self.along(u))

    def pulled(self, u: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return unrolled local degrees of freedom (n,), and forces (n,), N, on them that reactions count."""
        d, data = self.holds.points.grid.dim, self.holds
        dofs = d * data.points.grid.cell_nodes[data.cells] + data["direction"].argmax(axis=1)[:, None]
        return dofs.ravel(), (self.share * self.pull(u)[:, None]).ravel()


def functions_of(terms):
    """Return the functions of terms in bodies and on sides; what is no list of them as it is."""
    if isinstance(terms, str) or not isinstance(terms, Sequence):
        return terms
    return [term.term if isinstance(term, OnSide) else term for term in terms]


class OwnTerm(NamedTuple):
    """A term of the user's on a side: as it was given, its points, its form, and the tangent of that if it has one."""

    given: OnSide
    points: FormPoints
    form: PointForm
    slope: PointForm | None


class SideForms:
    """The forms, with the points at which they are evaluated.

    Parameters
    ----------
    grid
        Background grid.
    u
        Increment of the displacement in the step.
    """

    def __init__(self, grid: Grid, u: fem.Function):
        V = u.function_space
        self._grid, self._u, self._v, self._du = grid, u, ufl.TestFunction(V), ufl.TrialFunction(V)
        self.own: list[OwnTerm] = []
        """The user's terms on sides."""

    def own_points(self) -> FormPoints:
        """Return new points for a term of the user's, with what it may ask for."""
        d = self._grid.dim
        return FormPoints(self._grid, normal=(d,), position=(d,), displacement=(d,))

    def own_forces(self, sides: SideData) -> NDArray[np.float64]:
        """Return the nodal forces of the user's terms at u, a local array."""
        self.forces.x.array[:] = 0.0
        for term, points in zip(self.own, sides.own, strict=True):
            term.form.assemble_vector(self.forces.x.array, points)
        return sum_ghosts(self.forces)

    def assemble_own(self, K: PETSc.Mat, sides: SideData) -> None:
        """Add the tangent of the user's terms at u to K, which the caller finalises."""
        for term, points in zip(self.own, sides.own, strict=True):
            if term.slope is not None:
                term.slope.assemble_matrix(K, points)

    @cached_property
    def loads(self) -> FormPoints:
        """Points with a force."""
        return FormPoints(self._grid, force=(self._grid.dim,))

    @cached_property
    def traction(self) -> PointForm:
        """Work of dead loads."""
        p = self.loads
        return PointForm(ufl.inner(p.force, p.value(self._v)) * p.dx, p)

    @cached_property
    def pressures(self) -> FormPoints:
        """Points with a pressure."""
        return FormPoints(self._grid, push=(self._grid.dim,))

    @cached_property
    def forces(self) -> fem.Function:
        """Room for the nodal forces of pressures."""
        return fem.Function(self._u.function_space)

    @cached_property
    def pressed(self) -> PointForm:
        """Work of pressures on the present area."""
        return PointForm(self._pressed(), self.pressures)

    @cached_property
    def pressed_slope(self) -> PointForm:
        """Their tangent: as the surface moves it turns and stretches."""
        return PointForm(-ufl.derivative(self._pressed(), self._u, self._du), self.pressures)

    def _pressed(self) -> ufl.Form:
        """Return -p n da . v, n da = det(Delta) Delta^-T n_n da_n (Nanson) at the present iterate."""
        p = self.pressures
        delta = ufl.variable(ufl.Identity(self._grid.stretches) + p.grad(self._u))
        turned = ufl.diff(ufl.det(delta), delta)
        if self._grid.axisymmetric:
            turned = ufl.as_matrix([[turned[i, j] for j in (0, 1)] for i in (0, 1)])
        return ufl.inner(turned * p.push, p.value(self._v)) * p.dx

    @cached_property
    def plates(self) -> FormPoints:
        """Points under rigid plates."""
        return FormPoints(self._grid, rigidity=(), normal=(self._grid.dim,), tilt=(self._grid.dim,))

    @cached_property
    def plate(self) -> PointForm:
        """Stiffness of plates against a slope of their normal displacement."""
        return PointForm(self._bend(self._slope(self._du)), self.plates)

    @cached_property
    def tilt(self) -> PointForm:
        """What turns plates back that are tilted."""
        return PointForm(-self._bend(self.plates.tilt), self.plates)

    def _slope(self, w):
        """Return the tangential gradient of the normal displacement, grad_t(w_n), at the plates."""
        n = self.plates.normal
        gradient = ufl.dot(n, self.plates.plane_grad(w))
        return gradient - ufl.dot(gradient, n) * n

    def _bend(self, slope) -> ufl.Form:
        """Return the work of plates that bend or turn by a slope: kappa slope . grad_t(v_n)."""
        return self.plates.rigidity * ufl.inner(slope, self._slope(self._v)) * self.plates.dx

    @cached_property
    def holds(self) -> FormPoints:
        """Points, or means over points, with a given displacement along a direction."""
        d = self._grid.dim
        moments = {"squares": (d, d), **({"product": ()} if d == 3 else {})}
        return FormPoints(self._grid, stiffness=(), direction=(d,), gap=(), **moments)

    @cached_property
    def hold(self) -> PointForm:
        """Stiffness that holds the given displacement."""
        h = self.holds
        return PointForm(h.stiffness * self._along(self._du) * self._along(self._v) * h.dx, h)

    @cached_property
    def pull(self) -> PointForm:
        """Force towards the given displacement."""
        return PointForm(self.holds.stiffness * self.holds.gap * self._along(self._v) * self.holds.dx, self.holds)

    def _along(self, w):
        """Return the mean of a Q1 field, along the direction that is held, by the moments of the places it is over."""
        h, second = self.holds, ufl.grad(ufl.grad(w))
        i, j, k = ufl.indices(3)
        mean = w + ufl.dot(ufl.grad(w), h.offset) + ufl.as_vector(second[i, j, k] * h.squares[j, k], i) / 2
        if self._grid.dim == 3:  # of third derivatives of a trilinear function one is not zero
            mean += ufl.grad(second)[:, 0, 1, 2] * h.product
        return ufl.dot(mean, h.direction)
