# SPDX-License-Identifier: MIT
"""Storage of the pore fluid: DG0 on the grid, which is the finite volume method.

In each active cell, with J_Delta = det(I + grad u) (never div u: a rotation would fake a compression),

    int alpha (J_Delta - 1) + S J_Delta (p - p_n) dV_n  +  dt sum_faces Q  =  0,
    Q = T [p+ - p- + rho_w g . (x- - x+)],   T = A / (d+ / kappa+ + d- / kappa-),   kappa = k / (rho_w g),

where A is the exact overlap of the body with the face, x+- are the centroids of what the cells hold
and d+- their distances from the face.  Distances from the centroids keep the error at 0.2 % for any
filling, where half the cell size reaches 12 %.  The sum over the cells is the fluid balance.

Q1 with DG0 is not inf-sup stable: where next to nothing flows within a step, checkers of p go unseen.
Jumps of the step's increment are damped by max(0, tau d - dt kappa / d) A [p - p_n], d = d+ + d-, so that a
face carries at least tau d A: nothing is added where the flow suffices, nothing is left in a steady
state, and no fluid is lost.  tau is a quarter of Silvester and Kechkar's patch value (Camargo, White
and Borja 2021).
"""

from __future__ import annotations

from collections.abc import Callable

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.validation import line
from mpm_dolfinx.forms.cell_matrices import ElementForces
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.constitutive.user_functions import compiling
from mpm_dolfinx.constitutive.user_functions import form as form_of
from mpm_dolfinx.forms.point_forms import FacetForm, FormPoints, PointForm
from mpm_dolfinx.points.grid import Grid, sum_by
from mpm_dolfinx.points.pressure_transport import Reconstruction
from mpm_dolfinx.forms.unknowns import Unknowns, matrix, sum_ghosts, zero

FILTER = 0.75
"""Share of beta V that the filtered fixed-stress operator leaves out for checkers of the pressure, in [0, 1]."""


class Storage:
    """The storage problem of a scene.

    Parameters
    ----------
    grid
        Background grid.
    pieces
        Points of integration with the fields biot and storage (1/Pa).
    displacement
        Increment of the displacement since the start of the step.
    pressure
        DG0 pore pressure, Pa, positive in compression.
    weight : (d,), N/m^3
        Weight of the pore fluid rho_w g as UFL, None without gravity.
    symmetric
        Leave S (p - p_n) dJ_Delta out of the Jacobian, which then is symmetric; it is of the order of
        (p - p_n) / K_w, so Newton's method converges as fast.
    flows
        Whether anything conducts; without, there are no fluxes.
    """

    def __init__(
        self,
        grid: Grid,
        pieces: FormPoints,
        displacement: fem.Function,
        pressure: fem.Function,
        weight: ufl.core.expr.Expr | None = None,
        symmetric: bool = True,
        flows: bool = True,
    ):
        self.grid, self.p = grid, pressure
        Q = pressure.function_space
        self.p_n, self._b = fem.Function(Q), fem.Function(Q)
        q, dp = ufl.TestFunction(Q), ufl.TrialFunction(Q)
        one = fem.Function(Q)
        one.x.array[:] = 1.0
        delta = ufl.variable(pieces.increment(displacement))
        J = ufl.det(delta)
        strain = pieces.biot * (J - 1)
        stored = strain + pieces.storage * J * (pressure - self.p_n)
        change = stored * q * pieces.dx
        self._change = PointForm(change, pieces)
        self._capacity = PointForm(ufl.derivative(change, pressure, one), pieces)
        self._coupling = ElementForces(ufl.diff(strain if symmetric else stored, delta), pieces)
        self._momentum_coupling = self._coupling if symmetric else ElementForces(ufl.diff(strain, delta), pieces)
        self.symmetric, self._pieces = symmetric, pieces
        self._reconstruction = Reconstruction(grid)
        self.sources: list[tuple[PointForm, PointForm | None]] = []
        self._open = np.zeros((grid.num_local, grid.dim, 2))  # shares of faces, while slopes are drawn
        self._slot = np.empty(grid.num_local, dtype=np.int64)  # of active owned cells: place in the vectors
        self.flows, self.damped = flows, False
        self._fluxes(Q, q, dp, weight)

    def add(self, source: Callable, t: fem.Constant) -> None:
        """Add a source of the user's: see `extend`."""
        Q, points = self.p.function_space, self._pieces
        one, self._gain = fem.Function(Q), fem.Function(Q)
        one.x.array[:] = 1.0
        form = form_of("sources", source, points=points, q=ufl.TestFunction(Q), p=self.p, t=t)
        slope = PointForm(ufl.derivative(form, self.p, one), points) if self.p in form.coefficients() else None
        with compiling(f"sources: {line(source)}", "linear in q"):
            self.sources.append((PointForm(form, points), slope))

    def _assemble_sources(self, slope: bool = False) -> NDArray[np.float64]:
        """Return the rate of the sources in each active cell at p (m^d/s), or its derivative by the cell's p."""
        self._gain.x.array[:] = 0.0
        for forms in self.sources:
            if forms[slope] is not None:
                forms[slope].assemble_vector(self._gain.x.array)
        return self._gain.x.array[self.unknowns.owned]

    def _fluxes(self, Q, q, dp, weight) -> None:
        """Two-point fluxes over the inner faces of the active cells."""
        mesh, d = self.grid.mesh, self.grid.dim
        vector = self.grid.cellwise((d,))
        self.mobility = fem.Function(Q)
        self.centroid, self.lower_face, self.upper_face = (fem.Function(vector) for _ in range(3))
        n, h = ufl.FacetNormal(mesh), fem.Constant(mesh, self.grid.h)
        n0 = n("+")
        across = sum(abs(n0[a]) * h[a] for a in range(d))

        def opening(side, sign):
            """Share of the face that the body covers, on the side of the cell that sign * n0 points to."""
            lower, upper = self.lower_face(side), self.upper_face(side)
            return sum(
                ufl.conditional(ufl.gt(sign * n0[a], 0.5), upper[a], 0.0)
                + ufl.conditional(ufl.lt(sign * n0[a], -0.5), lower[a], 0.0)
                for a in range(d)
            )

        share = ufl.min_value(opening("+", 1), opening("-", -1))
        d0 = across / 2 - ufl.dot(self.centroid("+"), n0)
        d1 = across / 2 + ufl.dot(self.centroid("-"), n0)
        k0, k1 = self.mobility("+"), self.mobility("-")
        T = share * k0 * k1 / (d0 * k1 + d1 * k0 + 1e-300)
        dS = ufl.Measure("dS", domain=mesh, subdomain_id=_compat.SUBDOMAIN, metadata={"quadrature_degree": 0})
        self.flux = FacetForm(T * ufl.jump(dp) * ufl.jump(q) * dS, self.grid.comm)
        self.damping = fem.Function(Q)
        self._dt = fem.Constant(mesh, 0.0)
        damped = ufl.max_value(ufl.avg(self.damping) * share * (d0 + d1) - self._dt * T, 0.0)
        self.damp = FacetForm(damped * ufl.jump(dp) * ufl.jump(q) * dS, self.grid.comm)
        self.fixed_stress = fem.Function(Q)
        smaller = ufl.min_value(self.fixed_stress("+"), self.fixed_stress("-"))
        volume = fem.Constant(mesh, self.grid.cell_volume)  # not a number: each would be compiled anew
        alternation = smaller / (4 * d) * across / volume * ufl.jump(dp) * ufl.jump(q) * dS
        self._alternation = FacetForm(alternation, self.grid.comm)
        self.gravity = None
        if weight is not None and self.flows:
            apart = across * n0 + self.centroid("-") - self.centroid("+")
            self.gravity = FacetForm(T * ufl.dot(weight, apart) * ufl.jump(q) * dS, self.grid.comm)

    def set_active(self, cells: NDArray[np.int32], facets: NDArray[np.int32]) -> None:
        """Number the unknowns of the active cells; `facets` are the faces between two of them."""
        self.unknowns, self._active = Unknowns(self.p, cells.astype(np.int64)), cells
        self._slot[self.unknowns.owned] = np.arange(self.unknowns.size)
        self.T = matrix(self.unknowns, self.unknowns, 2 * self.grid.dim + 1)
        self.D = matrix(self.unknowns, self.unknowns, 2 * self.grid.dim + 1)
        self.L = matrix(self.unknowns, self.unknowns, 2 * self.grid.dim + 1)
        self.C = self.P = None
        self.residual, self._p, self._rate, self._p_start = (self.unknowns.vector() for _ in range(4))
        for form in (self.flux, self.damp, self._alternation, self.gravity):
            if form is not None:
                form.place(facets)

    def set_coupled(self, momentum: Unknowns) -> None:
        """Make the coupling matrices for the unknowns of the displacement."""
        length = 2**self.grid.dim * self.grid.dim
        self.B = matrix(self.unknowns, momentum, length)
        self.B_momentum = self.B if self.symmetric else matrix(self.unknowns, momentum, length)

    def set_contents(
        self,
        cells: NDArray[np.int32],
        weight: NDArray[np.float64],
        x: NDArray[np.float64],
        mobility: NDArray[np.float64],
        faces: NDArray[np.float64],
        capacity: NDArray[np.float64],
        pressure: NDArray[np.float64],
        fixed_stress: NDArray[np.float64],
        damping: NDArray[np.float64],
    ) -> None:
        """Sum over the pieces in each owned cell: volume, centroid, mobility, open faces, pressure.

        Parameters
        ----------
        cells, weight, x, mobility, faces
            Cell, volume (m^d), centroid (m), mobility kappa (m^2/(Pa s)) and areas on the cell's
            faces (m^(d-1)) of the pieces.
        capacity : (m,), 1/Pa
            Storage coefficient, by which the pressure is averaged.
        pressure : (m,), Pa
            Pressure that each piece brings.
        fixed_stress : (m,), 1/Pa
            The fixed-stress coefficient beta.
        damping : (m,), 1/Pa
            The strength tau of the damping of pressure jumps.
        """
        grid, filled = self.grid, self.unknowns.owned
        volume = self._total(cells, weight)
        self._volume = volume.sum()
        self.mobility.x.array[filled] = self._total(cells, weight * mobility) / volume
        self.damping.x.array[filled] = self._total(cells, weight * damping) / volume
        centroid, lower, upper = (f.x.array.reshape(-1, grid.dim) for f in self._shapes())
        for a in range(grid.dim):
            centroid[filled, a] = self._total(cells, weight * x[:, a]) / volume - grid.midpoints[filled, a]
            for target, end in ((lower, 0), (upper, 1)):
                target[filled, a] = self._total(cells, faces[:, a, end]) * grid.h[a] / grid.cell_volume
        held = self._total(cells, weight * capacity)
        mean = self._total(cells, weight * pressure) / volume
        stored = self._total(cells, weight * capacity * pressure)
        self.p_n.x.array[filled] = np.divide(stored, held, out=mean, where=held > 0)
        self.fixed_stress.x.array[filled] = self._total(cells, weight * fixed_stress)
        for f in (self.mobility, self.damping, self.fixed_stress, self.p_n, *self._shapes()):
            f.x.scatter_forward()
        zero(self.L)
        self._alternation.assemble_matrix(self.L)
        self.L.assemble()
        if self.C is None:
            _add_diagonal(self.L, np.zeros(self.unknowns.size))  # of a cell without faces
            self.C, self.P = self.L.duplicate(), self.L.duplicate()

    def _total(self, cells: NDArray[np.int32], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum values over the rows of each active owned cell."""
        return sum_by(self._slot[cells], values, self.unknowns.size)

    def at_pieces(self, store: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return pressures (m,), slopes (m, d) and bounds (m, 2) at the pieces, whose mean in a cell is the cell's.

        Parameters
        ----------
        store : (m,), m^d/Pa
            What the pieces store, by which the mean is taken; where a cell stores nothing, by their volumes.
        """
        grid, points, filled, active = self.grid, self._pieces, self.unknowns.owned, self._active
        cells, offset = points.cells, points.x - grid.midpoints[points.cells]
        total = self._total(cells, store)
        weight = np.where(total[self._slot[cells]] > 0, store, points.data["weight"][:, 0])
        total = self._total(cells, weight)
        origin = np.stack([self._total(cells, weight * x) / total for x in offset.T], axis=1)
        centroid, lower, upper = (f.x.array.reshape(-1, grid.dim) for f in self._shapes())
        self._open[active] = np.stack([lower[active], upper[active]], axis=2)
        slope, bounds = self._reconstruction(filled, self.p.x.array, centroid, self._open, origin)
        self._open[active] = 0.0
        at = self._slot[cells]
        p = self.p.x.array[cells] + np.einsum("md,md->m", slope[at], offset - origin[at])
        return p, slope[at], bounds[at]

    def start(self, dt: float) -> None:
        """Begin a step of dt: the pressure that the cells hold, and the damping of its jumps where it is needed."""
        self.p.x.array[:] = self.p_n.x.array
        self.unknowns.gather(self.p_n.x.array, self._p_start)
        filled = self.unknowns.owned
        reach = 4 * self.grid.h.max() ** 2  # no two centroids are further apart than 2 h
        needed = self.damping.x.array[filled] * reach > dt * self.mobility.x.array[filled]
        self.damped = over_all(self.grid.comm, bool(needed.any())) > 0
        if self.damped:
            self._dt.value = dt
            zero(self.D)
            self.damp.assemble_matrix(self.D)
            self.D.assemble()

    def _shapes(self) -> tuple[fem.Function, fem.Function, fem.Function]:
        return self.centroid, self.lower_face, self.upper_face

    def set_fluxes(
        self, cells: NDArray[np.int32], conductance: NDArray[np.float64], inflow: NDArray[np.float64]
    ) -> None:
        """Assemble the fluxes: the inner faces, and the boundary with given conductance and inflow.

        Parameters
        ----------
        cells : (m,)
            Owned cell behind each boundary face.
        conductance : (m,), m^d/(Pa s)
            Outflow per unit of the cell's pressure.
        inflow : (m,), m^d/s
            Prescribed inflow, and what a given outer pressure and gravity drive in.
        """
        self._conductance = self._total(cells, conductance)
        self._inflow = self._total(cells, inflow)
        zero(self.T)
        self._b.x.array[:] = 0.0
        if self.flows:
            self.flux.assemble_matrix(self.T)
        if self.gravity is not None:
            self.gravity.assemble_vector(self._b.x.array)
        self.unknowns.gather(sum_ghosts(self._b), self._rate)
        self._rate.array_w[:] -= self._inflow
        self.T.assemble()
        _add_diagonal(self.T, self._conductance)
        self._outflow = self.T.getDiagonal().array

    def assemble_residual(self, dt: float) -> tuple[PETSc.Vec, float]:
        """Return the fluid volume out of balance in each cell at (u, p) and its scale, sum |change| (m^d)."""
        b, comm = self._b.x.array, self.grid.comm
        b[:] = 0.0
        self._change.assemble_vector(b)
        change = b[self.unknowns.owned]
        self._change_total = change.sum()
        r = self.unknowns.gather(b, self.residual)
        p = self.unknowns.gather(self.p.x.array, self._p)
        # what rounding may leave: of the volumes and of the fluxes that cancel
        turnover = dt * (np.abs(self._outflow) @ np.abs(p.array_r))
        self.round_off = over_all(comm, 2e-15 * (self._volume + turnover))
        flux = self.T * p
        flux.axpy(1.0, self._rate)
        r.axpy(dt, flux)
        if self.damped:
            self.D.multAdd(p - self._p_start, r, r)
        exchanged = float(np.abs(change).sum())
        if self.sources:
            gain = dt * self._assemble_sources()
            r.array_w[:] -= gain
            self._change_total -= gain.sum()
            exchanged += np.abs(gain).sum()
        return r, over_all(comm, float(exchanged))

    def balance(self, dt: float) -> float:
        """Return the change of the fluid's volume, plus what left, less sources (m^d), at the last residual."""
        p = self.p.x.array[self.unknowns.owned]
        out = (self._conductance * p - self._inflow).sum()
        return float(over_all(self.grid.comm, self._change_total + dt * out))

    def assemble_tangent(self, dt: float) -> None:
        """Assemble C = d/dp and B = d/du of the residual at (u, p)."""
        pairs = [(self.B, self._coupling), (self.B_momentum, self._momentum_coupling)]
        for A, form in pairs[: 1 if self.symmetric else 2]:
            zero(A)
            form.assemble_matrix(A)
            A.assemble()
        b = self._b.x.array
        b[:] = 0.0
        self._capacity.assemble_vector(b)
        self.C.zeroEntries()
        self.C.axpy(dt, self.T, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        if self.damped:
            self.C.axpy(1.0, self.D, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        _add_diagonal(self.C, b[self.unknowns.owned])
        if self.sources:
            _add_diagonal(self.C, -dt * self._assemble_sources(slope=True))

    def assemble_preconditioner(self, factor: float, share: float) -> PETSc.Mat:
        """Return the fixed-stress operator C + factor (beta V - share L) for the present C.

        Parameters
        ----------
        factor
            Multiple of beta, >= 0.
        share
            Of the filter L, in [0, 1]: 0 is the fixed-stress operator.  B K^-1 B^T falls from beta V for a smooth
            pressure to a half (at nu = 0) where it alternates along one axis and to nothing for checkers.
            So does beta V - L, with L = sum over the faces of min(beta V+, beta V-) / (4 d) [p][q] <= beta V.
        """
        self.C.copy(self.P, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self.P.axpy(-factor * share, self.L, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        _add_diagonal(self.P, factor * self.fixed_stress.x.array[self.unknowns.owned])
        return self.P


def _add_diagonal(A: PETSc.Mat, values: NDArray[np.float64]) -> None:
    d = A.getDiagonal()
    d.array_w[:] += values
    A.setDiagonal(d)
