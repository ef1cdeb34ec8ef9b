# SPDX-License-Identifier: MIT
"""References to compare with: body-fitted, total-Lagrangian finite elements for finite-strain Biot, and beam theory.

With the total displacement u, F = I + grad u, J = det F and the pore pressure p (positive in compression)
on the reference configuration of a box, backward Euler from state n:

    momentum   int d/dF [psi(F) - alpha p J] : grad v dV  =  int t . v dA                 (dead tractions t)
    storage    int [alpha (J - J_n) + S J (p - p_n)] q dV  +  dt int kappa J F^-1 F^-T grad p . grad q dV  =  0

S = n/K_w + (alpha - n)/K_s with the porosity n = 1 - (1 - n0)/J_n, kappa = k/(rho_w g).  With pressures constant in
the cells the flux is the two-point one, kappa J |F^-T N|^2 (p+ - p-)/h, h the distance of the cells' centres.
The same material objects serve the material point method, so the two differ in discretisation only.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from mpi4py import MPI
from petsc4py import PETSc

import dolfinx.fem.petsc as petsc
import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from mpm_dolfinx import _compat
from mpm_dolfinx.coupling import NotConverged
from mpm_dolfinx.grid import SIDES, Grid, side
from mpm_dolfinx.materials import Fluid, Skeleton
from mpm_dolfinx.simulation import Drained, GaveUp, Result, Traction

ELEMENTS = {"taylor-hood": (2, ("Lagrange", 1, ())), "q1-dg0": (1, ("DG", 0, ()))}
"""Degree of the displacement and (family, degree, shape) of the pressure."""
CUT_DEGREE = 20  # of quadrature on a side of which a region is loaded: the region's edge may cut facets
MAX_NEWTON = 25


class BiotFEM:
    """A box body and its state; without fluid, the drained skeleton.

    Parameters
    ----------
    lower, upper : (d,), m
        Corners of the body; d = 2 (plane strain) or 3.
    cells : (d,)
        Number of cells along each axis, at least 1.
    material
        Skeleton.
    fixed
        Sides with the components that are zero there, such as {"left": "xy"}.
    fluid
        Pore fluid; its pressure is zero at the start.
    tractions, drained
        Conditions on sides; other sides are free and sealed.
    element
        "taylor-hood": Q2 displacement, Q1 pressure; "q1-dg0": Q1, constant in the cells with two-point fluxes.
    tolerance
        Residual relative to the loads or to the residual at the start of a step, > 0.
    """

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        cells: Sequence[int],
        material: Skeleton,
        *,
        fixed: Mapping[str, str],
        fluid: Fluid | None = None,
        tractions: Sequence[Traction] = (),
        drained: Sequence[Drained] = (),
        element: str = "taylor-hood",
        comm: MPI.Intracomm = MPI.COMM_WORLD,
        tolerance: float = 1e-8,
    ):
        if element not in ELEMENTS:
            raise ValueError(f"element {element!r}: must be one of {', '.join(ELEMENTS)}")
        if fluid is None and drained:
            raise ValueError("drained sides need a fluid")
        self.grid, self.material, self.fluid = Grid(upper, cells, lower, comm), material, fluid
        self.tolerance, self.t = tolerance, 0.0
        self.scale = material.oedometric
        """Unit of the pressure among the unknowns, Pa; both equations are divided by it."""
        self._degree, pressure = ELEMENTS[element]
        self._make_spaces(pressure)
        self._tag_sides()
        nodal = element == "taylor-hood"
        self._bcs = [*self._held(fixed), *(self._open(outlet) for outlet in drained if nodal)]
        self._dt = self._constant(1.0)
        self._loads = [(load, self._constant(np.zeros(self.grid.dim))) for load in tractions]
        start = time.perf_counter()
        self._compile(None if nodal else drained)
        self.jit = time.perf_counter() - start
        """Seconds spent on compiling or finding the forms."""
        self._make_solver()

    def _constant(self, value: ArrayLike) -> fem.Constant:
        return fem.Constant(self.grid.mesh, np.asarray(value, dtype=float))

    def _make_spaces(self, pressure: tuple[str, int, tuple[int, ...]]) -> None:
        """Make the space of the unknowns w = (u, p/scale), or u alone, and the places of u and p in it."""
        msh, vector = self.grid.mesh, ("Lagrange", self._degree, (self.grid.dim,))
        if self.fluid:
            self._W = _compat.mixed_space(msh, [vector, pressure])
            self._U, (V, self._u_dofs) = self._W.sub(0), self._W.sub(0).collapse()
            self._p_dofs = np.asarray(self._W.sub(1).collapse()[1])
        else:
            self._W = self._U = V = _compat.function_space(msh, *vector)
            self._u_dofs, self._p_dofs = slice(None), slice(0)
        self.w, self._old, self._b, self._f = (fem.Function(self._W) for _ in range(4))
        self._u = fem.Function(V)

    def _tag_sides(self) -> None:
        """Find the facets of the sides and number the sides for the measure on the boundary."""
        grid, self._facets = self.grid, {}
        for name in SIDES[grid.dim]:
            axis, end = side(name, grid.dim)
            self._facets[name] = mesh.locate_entities_boundary(
                grid.mesh, grid.dim - 1, lambda x, a=axis, c=(grid.lower, grid.upper)[end][axis]: np.isclose(x[a], c)
            )
        self._number = {name: i for i, name in enumerate(self._facets)}
        facets = np.concatenate(list(self._facets.values()))
        numbers = np.concatenate([np.full(len(f), i, dtype=np.int32) for i, f in enumerate(self._facets.values())])
        order = np.argsort(facets)
        tags = mesh.meshtags(grid.mesh, grid.dim - 1, facets[order], numbers[order])
        self._ds = ufl.Measure("ds", domain=grid.mesh, subdomain_data=tags)

    def _held(self, fixed: Mapping[str, str]) -> list:
        """Return the conditions of zero displacement."""
        d, bcs = self.grid.dim, []
        for name, axes in fixed.items():
            side(name, d)
            if not axes or any(a not in "xyz"[:d] for a in axes):
                raise ValueError(f"fixed side {name!r}: components {axes!r}, must be some of {'xyz'[:d]!r}")
            for component in (self._U.sub("xyz".index(a)) for a in axes):
                dofs = fem.locate_dofs_topological(component, d - 1, self._facets[name])
                bcs.append(fem.dirichletbc(PETSc.ScalarType(0.0), dofs, component))
        return bcs

    def _open(self, outlet: Drained):
        """Return the condition of nodal pressure on a drained side, on facets with their midpoint in the region."""
        d, (axis, _) = self.grid.dim, side(outlet.side, self.grid.dim)
        facets, space = self._facets[outlet.side], self._W.sub(1)
        if outlet.region is not None:
            x = np.delete(mesh.compute_midpoints(self.grid.mesh, d - 1, facets)[:, :d], axis, axis=1)
            low, high = (np.delete(np.asarray(corner, dtype=float), axis) for corner in outlet.region)
            facets = facets[((x >= low) & (x <= high)).all(axis=1)]
        dofs = fem.locate_dofs_topological(space, d - 1, facets)
        return fem.dirichletbc(PETSc.ScalarType(outlet.pressure / self.scale), dofs, space)

    def _on(self, condition: Traction | Drained, integrand):
        """Return the integral over the part of a side that a condition names, as UFL."""
        d, (axis, _) = self.grid.dim, side(condition.side, self.grid.dim)
        degree, x = 2 * self._degree, ufl.SpatialCoordinate(self.grid.mesh)
        if condition.region is not None:
            degree, (low, high) = CUT_DEGREE, map(self._constant, condition.region)
            for a in (a for a in range(d) if a != axis):
                inside = ufl.And(ufl.ge(x[a], low[a]), ufl.le(x[a], high[a]))
                integrand = ufl.conditional(inside, integrand, 0.0)
        return integrand * self._ds(self._number[condition.side], metadata={"quadrature_degree": degree})

    def _compile(self, outlets: Sequence[Drained] | None) -> None:
        """Compile loads, residual and tangent; with `outlets` the pressure is constant in the cells."""
        law, split = self.material, ufl.split if self.fluid else lambda f: (f, None)
        (u, p), (u_n, p_n), (v, q) = map(split, (self.w, self._old, ufl.TestFunction(self._W)))
        dx = ufl.Measure("dx", domain=self.grid.mesh, metadata={"quadrature_degree": 2 * self._degree})
        F, F_n = (ufl.variable(ufl.Identity(self.grid.dim) + ufl.grad(f)) for f in (u, u_n))
        energy = law.energy(F, **{name: self._constant(getattr(law, name)) for name in law.parameters})
        energy /= self._constant(self.scale)
        if self.fluid:
            energy -= self._constant(law.biot) * p * ufl.det(F)
        residual = ufl.inner(ufl.diff(energy, F), ufl.grad(v)) * dx
        if self.fluid:
            J, J_n, alpha = ufl.det(F), ufl.det(F_n), self._constant(law.biot)
            residual += (alpha * (J - J_n) + self._storativity(J_n) * J * (p - p_n)) * q * dx
            kappa = self._dt * self._constant(self.scale * law.conductivity / self.fluid.unit_weight)
            pull = ufl.inv(F).T
            if outlets is None:
                residual += kappa * J * ufl.inner(pull * ufl.grad(p), pull * ufl.grad(q)) * dx
            else:
                residual += self._two_point(kappa, J, pull, p, q, outlets)
        self._residual_form = _compat.compiled(residual)
        self._tangent_form = _compat.compiled(ufl.derivative(residual, self.w, ufl.TrialFunction(self._W)))
        loads = [self._on(load, ufl.inner(t, v) / self._constant(self.scale)) for load, t in self._loads]
        self._load_form = _compat.compiled(sum(loads)) if loads else None

    def _storativity(self, J_n):
        """Return S in the unit of the pressure, at the porosity of the start of the step, as UFL."""
        # linear in the porosity, and both constants stay finite where a bulk modulus is infinite
        at_0, at_1 = (self.scale * self.material.storage(self.fluid.bulk, n) for n in (0.0, 1.0))
        return self._constant(at_0) + self._constant(at_1 - at_0) * (1 - self._constant(1 - self.material.porosity) / J_n)

    def _two_point(self, kappa, J, pull, p, q, outlets: Sequence[Drained]):
        """Return the two-point flux between cells and to drained sides, half a cell away, as UFL."""
        normal, h = ufl.FacetNormal(self.grid.mesh), self._constant(self.grid.h)
        stretch = J * ufl.inner(pull * normal, pull * normal)
        across = sum(abs(normal[a]) * h[a] for a in range(self.grid.dim))
        dS = ufl.Measure("dS", domain=self.grid.mesh, metadata={"quadrature_degree": 2})
        flux = kappa * ufl.avg(stretch) / across("+") * ufl.jump(p) * ufl.jump(q) * dS
        for outlet in outlets:
            outer = self._constant(outlet.pressure / self.scale)
            flux += self._on(outlet, kappa * stretch / (across / 2) * (p - outer) * q)
        return flux

    def _make_solver(self) -> None:
        """Set up Newton's method with line search and a direct solver."""
        self._x = _compat.petsc_vec(self.w).duplicate()
        self._snes = PETSc.SNES().create(self.grid.comm)
        self._snes.setOptionsPrefix("mpm_reference_")
        self._snes.setFunction(self._residual, self._x.duplicate())
        self._snes.setJacobian(self._tangent, petsc.create_matrix(self._tangent_form))
        self._snes.ksp.setType(PETSc.KSP.Type.PREONLY)
        self._snes.ksp.pc.setType(PETSc.PC.Type.LU)
        self._snes.ksp.pc.setFactorSolverType("mumps")
        self._snes.setFromOptions()

    def _residual(self, _snes: PETSc.SNES, x: PETSc.Vec, out: PETSc.Vec) -> None:
        w, b = _compat.petsc_vec(self.w), _compat.petsc_vec(self._b)
        self._take(x)
        self._assemble(self._b, self._residual_form)
        b.axpy(-1.0, _compat.petsc_vec(self._f))
        petsc.set_bc(b, self._bcs, w, -1.0)  # no lifting: every iterate has the prescribed values
        b.copy(out)

    def _tangent(self, _snes: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, _P: PETSc.Mat) -> None:
        self._take(x)
        A.zeroEntries()
        petsc.assemble_matrix(A, self._tangent_form, self._bcs)
        A.assemble()

    def _take(self, x: PETSc.Vec) -> None:
        x.copy(_compat.petsc_vec(self.w))
        self.w.x.scatter_forward()

    def _assemble(self, out: fem.Function, form) -> None:
        out.x.array[:] = 0.0
        petsc.assemble_vector(_compat.petsc_vec(out), form)
        _compat.scatter_reverse_add(out)

    def step(self, dt: float) -> tuple[int, float]:
        """Advance by dt (s, > 0); return the number of Newton iterations and the relative residual.

        Raises
        ------
        NotConverged
            The state is then still that before the step.
        """
        self._dt.value = dt
        for load, value in self._loads:
            value.value[:] = load.at(self.t + dt)
        if self._loads:
            self._assemble(self._f, self._load_form)
        w, f, snes = _compat.petsc_vec(self.w), _compat.petsc_vec(self._f).norm(), self._snes
        petsc.set_bc(w, self._bcs)
        w.copy(self._x)
        round_off = 1e-14 * self.grid.cell_volume / self.grid.h.min() * np.sqrt(w.getSize())
        snes.setTolerances(self.tolerance, max(self.tolerance * f, round_off), 0.0, MAX_NEWTON)
        snes.setConvergenceHistory(MAX_NEWTON + 1, True)
        snes.solve(None, self._x)
        norms, _ = snes.getConvergenceHistory()
        scale = max(f, norms[0], round_off / self.tolerance)
        if snes.reason < 0:
            self._take(_compat.petsc_vec(self._old))
            raise NotConverged(f"PETSc SNES stopped with reason {snes.reason}", [self._parts(scale)])
        self._take(self._x)
        self._old.x.array[:] = self.w.x.array
        self.t += dt
        return snes.its, norms[-1] / scale

    def _parts(self, scale: float) -> tuple[float, float]:
        """Return the norms of the residuals of momentum and storage, relative to `scale`."""
        squares = (self._b.x.array / scale) ** 2
        squares[_compat.petsc_vec(self._b).getLocalSize() :] = 0.0  # ghosts
        parts = np.array([squares[self._u_dofs].sum(), squares[self._p_dofs].sum()])
        return tuple(np.sqrt(_compat.comm_sum(self.grid.comm, parts)))

    def run(self, t_end: float, dt: float, *, probes: ArrayLike, progress: bool = False) -> Result:
        """Advance to t_end (s) in equal steps dt (s) that divide the time left.

        Parameters
        ----------
        probes : (m, d), m
            Reference positions in the body at which the displacement is recorded.
        progress
            Show a progress bar on a terminal.

        Raises
        ------
        GaveUp
            With the histories up to the last good step.
        """
        steps = round((t_end - self.t) / dt) if dt > 0 else 0
        if steps < 1 or abs(steps * dt - (t_end - self.t)) > 1e-6 * dt:
            raise ValueError(f"dt = {dt!r}, t_end = {t_end!r}: dt must divide the {t_end - self.t:g} s left")
        x, result, quiet = np.atleast_2d(np.asarray(probes, dtype=float)), Result(), not progress or self.grid.comm.rank
        self._record(result, x)
        began = time.perf_counter()
        for _ in tqdm(range(steps), disable=bool(quiet) or None, unit="step"):
            try:
                newton, residual = self.step(dt)
            except NotConverged as failed:
                raise GaveUp(f"gave up at t = {self.t:g} s with dt = {dt:.3g} s: {failed}", result, failed) from failed
            result.steps += 1
            result.newton += newton
            result.residual = max(result.residual, residual)
            self._record(result, x)
            result.wall = time.perf_counter() - began
        result.converged = True
        return result

    def displacement(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, at reference positions x (m, d) in the body, on every process."""
        grid, out = self.grid, np.zeros(x.shape)
        cells = grid.local(grid.number(grid.index(x)))
        here = np.flatnonzero((cells >= 0) & (cells < grid.num_owned))
        self._u.x.array[:] = self.w.x.array[self._u_dofs]
        if len(here):
            x3 = np.pad(x[here], ((0, 0), (0, 3 - grid.dim)))
            out[here] = self._u.eval(x3, cells[here]).reshape(-1, grid.dim)
        return _compat.comm_sum(grid.comm, out)

    def _record(self, result: Result, x: NDArray[np.float64]) -> None:
        result.t.append(self.t)
        result.displacement.append(self.displacement(x))
        if self.fluid:
            p, comm = self.scale * self.w.x.array[self._p_dofs], self.grid.comm
            result.pressure.append((comm.allreduce(p.min(), op=MPI.MIN), comm.allreduce(p.max(), op=MPI.MAX)))


def euler_bernoulli(x: ArrayLike, load: float, length: float, modulus: float, second_moment: float) -> NDArray[np.float64]:
    """Return the deflection (n,) of a cantilever under a uniform load: w x^2 (6 L^2 - 4 L x + x^2)/(24 E I), m.

    Parameters
    ----------
    x : (n,), m
        Distances from the clamp, in [0, length].
    load
        Force per length w, N/m, of any sign; the deflection has its sign.
    length, modulus, second_moment
        Length L, m; Young's modulus E, Pa; second moment of area I, m^4; all > 0.
    """
    x = np.asarray(x, dtype=float)
    return load * x**2 * (6 * length**2 - 4 * length * x + x**2) / (24 * modulus * second_moment)
