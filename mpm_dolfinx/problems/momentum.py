# SPDX-License-Identifier: MIT
"""Balance of momentum: quasi-static, Q1 on the grid, evaluated at the pieces of the points' domains.

With Delta = I + grad u for the increment u since the start of the step, F = Delta F_n and J = det F,
the residual is the derivative of

    int psi(F) / J_n - alpha p det(Delta) dV_n  -  loads,

that is int (P' - alpha p J_Delta Delta^-T) : grad v dV_n = int rho g . v dV_n + tractions, P' the
first Piola-Kirchhoff effective stress relative to the start of the step; a law may also give the stress
itself.  The derivatives are UFL's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.validation import line
from mpm_dolfinx.problems.mean_dilatation import MeanDilatation
from mpm_dolfinx.forms.cell_matrices import ElementForces, ElementMatrices, StackedElementMatrices
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.constitutive.user_functions import compiling
from mpm_dolfinx.constitutive.user_functions import form as form_of
from mpm_dolfinx.forms.point_forms import FacetForm, FormPoints, PointForm
from mpm_dolfinx.points.grid import Grid
from mpm_dolfinx.constitutive.skeleton import Skeleton
from mpm_dolfinx.forms.unknowns import Unknowns, matrix, sum_ghosts, zero

GHOST = 1e-2
"""Strength of the ghost penalty; 1e-3 to 1/30 changes the beam's tip by 1e-5."""
FULL = 0.9
"""A cell filled less than this is partly filled: its faces carry the ghost penalty."""


class Momentum:
    """The momentum problem of a scene.

    Parameters
    ----------
    grid
        Background grid.
    pieces
        All points of integration.
    laws
        Classes of the skeletons' laws, each with the pieces that follow it; they carry F, what the law takes
        and, with fluid, biot.
    fixed : (nodes, d)
        Which components of the displacement are zero at which nodes of the grid.
    pressure
        DG0 pore pressure, None without fluid.
    gravity : (d,), m/s^2
        Acceleration, a UFL constant; the pieces then carry `density`, kg/m^3.
    mean_dilatation
        Whether the laws see one volume change per cell, see `dilatation`.
    symmetric
        Whether the tangents of all laws are symmetric.
    """

    def __init__(
        self,
        grid: Grid,
        pieces: FormPoints,
        laws: Sequence[tuple[type[Skeleton], FormPoints]],
        fixed: NDArray[np.bool_],
        pressure: fem.Function | None = None,
        gravity: fem.Constant | None = None,
        mean_dilatation: bool = False,
        symmetric: bool = True,
    ):
        self.grid, self.pieces = grid, pieces
        V = _compat.function_space(grid.mesh, "Lagrange", 1, (grid.dim,))
        self.u, self._b, self._f, self._pulls = (fem.Function(V) for _ in range(4))
        self.fix(fixed)
        v, du = ufl.TestFunction(V), ufl.TrialFunction(V)

        self.symmetric, self.holding = symmetric, False
        self.linear = not mean_dilatation and all(law.linear for law, _ in laws)
        """Whether the tangent changes with the places of the points only."""
        self.dilatation = MeanDilatation(pieces, self.u, symmetric) if mean_dilatation else None
        self._residuals, self._tangents = [], []
        self.terms: list[PointForm] = []
        for law, points in laws:
            self._add_law(law, points, v, pressure)

        self.loads = FormPoints(grid, force=(grid.dim,))
        self._weight = None
        if gravity is not None:
            self._weight = PointForm(pieces.density * ufl.inner(gravity, pieces.value(v)) * pieces.dx, pieces)
        self.loads = self.plates = self.holds = None
        self._ghost(V, v, du)

    def _add_law(self, law: type[Skeleton], points: FormPoints, v, pressure: fem.Function | None) -> None:
        """Compile residual and tangent of the pieces that follow a law."""
        grid = self.grid
        F = points.deformation(self.u)
        values = {name: getattr(points, name) for name in (*law.parameters, *law.state)}
        if self.dilatation is not None:
            P = self.dilatation.add(law, points, F, values)
        else:
            P = law.first_piola(F, values)
        if pressure is not None:
            P -= points.biot * pressure * ufl.diff(ufl.det(F), F)
        # differentiated by F and contracted: in 3D a twentieth of the compile time of derivatives by u
        P /= ufl.det(points.F)
        A = ufl.diff(P, F)
        i, j, k, l, m, n = ufl.indices(6)
        if grid.dim == 2:
            self._residuals.append(PointForm(ufl.inner(P, points.grad(v) * points.F) * points.dx, points))
            A = ufl.as_tensor(A[i, m, j, n] * points.F[k, m] * points.F[l, n], (i, k, j, l))
            self._tangents.append(ElementMatrices(A, points, self.symmetric))
        else:
            self._residuals.append(ElementForces(P * points.F.T, points))
            self._tangents.append(StackedElementMatrices(A, points, self.symmetric))

    def add(self, term: Callable, t: fem.Constant, dt: fem.Constant) -> None:
        """Add a term of the user's: see `extend`."""
        V = self.u.function_space
        v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
        form = form_of("terms", term, points=self.pieces, u=self.u, v=v, t=t, dt=dt)
        potential = not form.arguments()
        if potential and self.u not in form.coefficients():
            raise ValueError(f"terms: {line(form)}: depends on neither u nor v, must be a form in one of them")
        if potential:
            form = ufl.derivative(form, self.u, v)
        with compiling(f"terms: {line(term)}", "linear in v, or an energy of u"):
            self.terms.append(PointForm(form, self.pieces))
        self._own = fem.Function(V)
        if self.u in form.coefficients():
            self._tangents.append(PointForm(ufl.derivative(form, self.u, du), self.pieces))
            self.holding, self.linear = True, False
            self.symmetric = self.symmetric and potential

    def require(self, loaded: bool, plates: bool, held: bool) -> None:
        """Compile what conditions on sides of the bodies need and has not been compiled yet.

        Parameters
        ----------
        loaded
            There are tractions: points `loads` with their force.
        plates
            There are rigid plates: points `plates` with their rigidity, normal and present tilt.
        held
            Sides have given displacements: points `holds` with stiffness, direction and gap.
        """
        grid, V = self.grid, self.u.function_space
        v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
        if loaded and self.loads is None:
            self.loads = FormPoints(grid, force=(grid.dim,))
            self._traction = PointForm(ufl.inner(self.loads.force, self.loads.value(v)) * self.loads.dx, self.loads)
        if plates and self.plates is None:
            self.plates = FormPoints(grid, rigidity=(), normal=(grid.dim,), tilt=(grid.dim,))
            self._plate = PointForm(self._bend(v, self._slope(du)), self.plates)
            self._tilt = PointForm(-self._bend(v, self.plates.tilt), self.plates)
        if held and self.holds is None:
            self.holds = h = FormPoints(grid, stiffness=(), direction=(grid.dim,), gap=())
            along = ufl.dot(h.value(v), h.direction)
            self._hold = PointForm(h.stiffness * ufl.dot(h.value(du), h.direction) * along * h.dx, h)
            self._pull = PointForm(h.stiffness * h.gap * along * h.dx, h)

    def fix(self, fixed: NDArray[np.bool_]) -> None:
        """Set which components are zero at which nodes (nodes, d); unknowns are numbered anew."""
        self.free, self._dofs = ~fixed, None

    def _slope(self, w):
        """Return the tangential gradient of the normal displacement, grad_t(w_n), at the plates."""
        n = self.plates.normal
        gradient = ufl.dot(n, self.plates.grad(w))
        return gradient - ufl.dot(gradient, n) * n

    def _bend(self, v, slope) -> ufl.Form:
        """Return the work of plates that bend or turn by a slope: kappa slope . grad_t(v_n)."""
        return self.plates.rigidity * ufl.inner(slope, self._slope(v)) * self.plates.dx

    def _ghost(self, V, v, du) -> None:
        """Penalise jumps of the normal derivative on faces of partly filled cells (Burman 2010, Coombs 2023).

        gamma M h/3 int [d_n u].[d_n v] dS, M = lambda + 2G, on the step's increment only.
        """
        cellwise = self.grid.cellwise()
        self.modulus, self.fill = fem.Function(cellwise), fem.Function(cellwise)
        n = ufl.FacetNormal(self.grid.mesh)
        h = fem.Constant(self.grid.mesh, self.grid.h)
        across = sum(abs(n("+")[a]) * h[a] for a in range(self.grid.dim))
        dS = ufl.Measure("dS", domain=self.grid.mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 2})

        def kink(w):
            return ufl.dot(ufl.grad(w)("+") - ufl.grad(w)("-"), n("+"))

        form = GHOST / 3 * ufl.avg(self.modulus) * across * ufl.inner(kink(du), kink(v)) * dS
        self.ghost = FacetForm(form, self.grid.comm)

    def set_active(self, cells: NDArray[np.int32], facets: NDArray[np.int32], partly: NDArray[np.bool_]) -> bool:
        """Number the unknowns of the active cells.

        Parameters
        ----------
        cells, facets
            Active local cells, ghosts included, and the faces between two of them.
        partly : (cells,)
            Which local cells are partly filled.

        Returns
        -------
        Whether cells or unknowns differ from those before, so that matrices have been made anew.
        """
        facets = facets[partly[self.grid.facet_cells[facets]].any(axis=1)]
        nodes = np.zeros(len(self.free), dtype=bool)
        nodes[self.grid.cell_nodes[cells]] = True
        nodes = np.flatnonzero(self._shared(nodes))
        at_nodes = nodes[:, None] * self.grid.dim + np.arange(self.grid.dim)
        dofs = at_nodes[self.free[nodes]]
        # a cell may become active between active nodes, so equal dofs do not mean equal cells
        now = (cells, dofs, facets)
        same = self._dofs is not None and all(map(np.array_equal, now, (self._cells, self._dofs, self._facets)))
        changed = over_all(self.grid.comm, not same) > 0
        if changed:
            self._cells, self._dofs, self._facets = now
            self.unknowns = Unknowns(self.u, dofs)
            owned = self.u.function_space.dofmap.index_map.size_local
            self._touched = at_nodes[nodes < owned].ravel()  # where forces may act, fixed or not
            self.K = matrix(self.unknowns, self.unknowns, 3**self.grid.dim * self.grid.dim)
            self._summed = False
            self.penalty = self._penalty_matrix()
            self.residual, self._du = self.unknowns.vector(), self.unknowns.vector()
            self.ghost.place(facets)
        stiffness = float(self.modulus.x.array[cells].max(initial=0.0)) * self.grid.cell_volume / self.grid.h.min()
        self.round_off = 1e-14 * self.grid.comm.allreduce(stiffness) * np.sqrt(max(1, self.unknowns.global_size))
        return changed

    def _penalty_matrix(self) -> PETSc.Mat:
        """Return an empty matrix for the penalties: the ghost penalty couples like components, of two cells."""
        d = self.grid.dim
        length = 3**d + 2 * d * 3 ** (d - 1)
        if self.plates is not None or self.holds is not None:
            return matrix(self.unknowns, self.unknowns, d * length)
        touched = np.zeros(len(self.free), dtype=bool)
        touched[self.grid.cell_nodes[self.grid.facet_cells[self._facets]]] = True
        A = matrix(self.unknowns, self.unknowns, np.where(self._shared(touched)[self.unknowns.owned // d], length, 1))
        A.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, True)
        return A

    def set_penalty(self) -> None:
        """Assemble what is linear in the step's increment: ghost penalty, and plates and holds at their places."""
        zero(self.penalty)
        self.ghost.assemble_matrix(self.penalty)
        if self.plates is not None:
            self._plate.assemble_matrix(self.penalty)
        if self.holds is not None:
            self._hold.assemble_matrix(self.penalty)
            stiffest = self.holds.data["stiffness"].max(initial=0.0)  # what rounding of places makes of it
            reach = np.abs(np.concatenate([self.grid.lower, self.grid.upper])).max()
            self.round_off += 1e-15 * self.grid.comm.allreduce(stiffest) * reach
        self.penalty.assemble()

    def _shared(self, nodes: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which nodes are active on any process."""
        if self.grid.comm.size == 1:
            return nodes
        self._b.x.array[:] = np.repeat(nodes, self.grid.dim)
        _compat.scatter_reverse_add(self._b)
        self._b.x.scatter_forward()
        return self._b.x.array[:: self.grid.dim] > 0

    def set_loads(self) -> None:
        """Assemble the dead loads and the weight at the present places of points and `loads`."""
        self._f.x.array[:] = 0.0
        if self.loads is not None:
            self._traction.assemble_vector(self._f.x.array)
        if self._weight is not None:
            self._weight.assemble_vector(self._f.x.array)
        if self.plates is not None:
            self._tilt.assemble_vector(self._f.x.array)
        self._external = sum_ghosts(self._f)
        if self.holds is not None:
            self._pulls.x.array[:] = 0.0
            self._pull.assemble_vector(self._pulls.x.array)
            sum_ghosts(self._pulls)

    def start(self) -> None:
        """Begin a step: no displacement."""
        self.u.x.array[:] = 0.0
        if self.dilatation is not None:
            self.dilatation.start()

    def assemble_residual(self) -> tuple[PETSc.Vec, float]:
        """Return the out-of-balance nodal forces at u and their scale, the largest of internal, external, terms (N)."""
        if self.dilatation is not None:
            self.dilatation.update()
        b = self._b.x.array
        b[:] = 0.0
        for residual in self._residuals:
            residual.assemble_vector(b)
        sum_ghosts(self._b)
        forces, external = b[self._touched], self._external[self._touched]
        squares = [forces @ forces, external @ external]
        if self.terms:
            own = self._assemble_terms()[self._touched]
            squares.append(own @ own)
            forces += own
        squares = over_all(self.grid.comm, np.array(squares))
        b[self._touched] = forces - external
        if self.holds is not None:  # no measure of forces: at the start of a step it is far above them
            b[self._touched] -= self._pulls.x.array[self._touched]
        r = self.unknowns.gather(b, self.residual)
        du = self.unknowns.gather(self.u.x.array, self._du)
        self.penalty.multAdd(du, r, r)
        return r, float(np.sqrt(max(squares)))

    def _assemble_terms(self) -> NDArray[np.float64]:
        """Return the nodal forces of the user's terms at u."""
        self._own.x.array[:] = 0.0
        for term in self.terms:
            term.assemble_vector(self._own.x.array)
        return sum_ghosts(self._own)

    def assemble_tangent(self) -> PETSc.Mat:
        """Return the tangent at u."""
        zero(self.K)
        for tangent in self._tangents:
            tangent.assemble_matrix(self.K)
        if self.dilatation is not None:
            self.dilatation.assemble_matrix(self.K)
        self.K.assemble()
        # the first sum gives K the pattern of both
        pattern = PETSc.Mat.Structure
        self.K.axpy(1.0, self.penalty, pattern.SUBSET_NONZERO_PATTERN if self._summed else pattern.UNKNOWN)
        self._summed = True
        return self.K
