# SPDX-License-Identifier: MIT
"""Reference solution: body-fitted, total-Lagrangian finite elements for Biot's equations at finite strain.

The unknowns are the total displacement u and the pore pressure p, positive in compression.  The deformation gradient is
F = I + grad u, and J = det F.  A step starts from state n.  The equations, integrated over the undeformed body, are

    momentum   int [d psi/dF - alpha chi p dJ/dF] : grad v dV  =  int t . v dA + int m g . v dV
    storage    int rho [zeta(J, p) - zeta_n] q dV
               + int int kappa J F^-1 (F^-T grad pi - rho rho_w g) . grad q dV dt  =  0

with the stored energy psi, Biot's coefficient alpha, Bishop's coefficient chi, tractions t (dead loads or pressures),
the mass m of soil and fluid, the acceleration of gravity g, and test functions v and q.  The mobility is
kappa = k/(rho_w g), and the relative density is rho = exp((p + p_n)/(2 K_w)).  `fluid_content` defines the content zeta
and the mass potential pi.  In saturated soil chi = 1.

In unsaturated soil, kappa is multiplied by the relative permeability k_r.  With the saturation S and the porosity n_n
in state n, rho [zeta - zeta_n] becomes S rho [zeta - zeta_n] + (S - S_n) J_n n_n exp(p_n/K_w).

If the pressure is constant in each cell, two-point fluxes replace the last integral of the storage equation.  A
two-point flux is kappa J (F^-T N)^2 / h times the jump of pi and of the potential of gravity.  N is the normal of the
face between two cells, and h is the distance of their centres.  The mean of k_r between the two pressures multiplies
kappa.  Two-point fluxes are not consistent if cells shear.

In axisymmetry F contains the circumferential stretch, and integrals extend over the full circumference.  Materials,
retention curves, user-defined terms and time integration are the same as in the material point method.  The two methods
therefore differ only in discretisation.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import dolfinx.fem.petsc as petsc
import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.errors import NotConverged, Report
from mpm_dolfinx.base.fluid_content import change_of_content, density_between, mass_potential, mass_potential_form
from mpm_dolfinx.base.histories import Row, Rows
from mpm_dolfinx.base.time_integration import Substep, substeps
from mpm_dolfinx.base.tolerances import NEAR, ROUND_OFF, SAME, TINY
from mpm_dolfinx.base.validation import all_of, functions, instance, line, numbers
from mpm_dolfinx.bodies.faces import Region, limits
from mpm_dolfinx.conditions.conditions import RIGIDITY, Drained, Pressure, RigidPlate, Source, Traction, sorted_terms
from mpm_dolfinx.conditions.walls import with_axis
from mpm_dolfinx.forms.axes import block
from mpm_dolfinx.forms.point_forms import PointMeasure
from mpm_dolfinx.grid.grid import TURN, Grid, begin_with, side
from mpm_dolfinx.materials.skeleton import Field, Fluid, Skeleton
from mpm_dolfinx.materials.user_functions import call, compiling, term_of
from mpm_dolfinx.materials.user_functions import form as form_of
from mpm_dolfinx.probing.probes import positions
from mpm_dolfinx.solve.numerics import DEFAULT, Numerics
from mpm_dolfinx.stepping.result import GaveUp, Result
from mpm_dolfinx.verification.pores import Pores

ELEMENTS = {"taylor-hood": (2, ("Lagrange", 1, ())), "q1-dg0": (1, ("DG", 0, ()))}  # degree of u, and space of p
CUT_DEGREE = 20  # quadrature degree on a partly loaded side, because an edge of the region may cut facets


class Space:
    """Space of the unknowns w = (u, p/scale), or w = u without fluid, and functions in this space.

    `old`: w at the start of the step.
    `past`: contribution of the previous substep's rate to the change of w in the step.
    `b`, `f`: residual and loads.
    `same`: copy of w that derivatives of forms treat as a constant.
    `u`, `p`: displacement and scaled pressure, the parts of w.
    `p_dofs`: degrees of freedom of the pressures.
    `of_p`: space of the pressures alone.
    """

    def __init__(self, grid: Grid, wet: bool, degree: int, pressure: tuple[str, int, tuple[int, ...]]):
        self.degree, vector = degree, ("Lagrange", degree, (grid.dim,))
        if wet:
            self.W = _compat.mixed_space(grid.mesh, [vector, pressure])
            self.of_p, dofs = self.W.sub(1).collapse()
            self.p_dofs = np.asarray(dofs)
        else:
            self.W, self.p_dofs = _compat.function_space(grid.mesh, *vector), slice(0)
        self.w, self.old, self.past, self.b, self.f, self.same = (fem.Function(self.W) for _ in range(6))
        self.u, self.p = (self.w.sub(0), self.w.sub(1)) if wet else (self.w, None)


class Forms(NamedTuple):
    """Compiled forms (residual, tangent, flux and loads) and their constants."""

    residual: Any
    tangent: Any
    flux: Any | None
    load: Any | None
    dt: fem.Constant  # time weight of the flux, s
    since: fem.Constant  # time since the start of the step, s
    t: fem.Constant  # time at the end of the substep, s
    # functions of time, each with the UFL constant of its value
    given: list[tuple[Callable[[float], ArrayLike], fem.Constant]]


def _check_scene(grid: Grid, material: Skeleton, fluid: Fluid | None, element: str, conditions: Sequence) -> None:
    """Raise ValueError for a scene that the reference cannot compute."""
    begin_with("grid", grid)
    if not grid.even:
        raise ValueError("grid: cells of several sizes, must be equal in the reference")
    all_of("material", [material], Skeleton)
    all_of("fluid", [fluid] if fluid is not None else [], Fluid)
    if element not in ELEMENTS:
        raise ValueError(f"element {element!r}: must be one of {', '.join(ELEMENTS)}")
    all_of("conditions", conditions, (Traction, Pressure, RigidPlate, Drained))
    for outlet in (one for one in conditions if isinstance(one, Drained)):
        if outlet.seepage:
            raise ValueError("drained: seepage = True, must be False: the reference has no seepage faces")
        if callable(outlet.pressure):
            raise ValueError(f"{line(outlet)}: in the reference the pressure must be a number")
    fields = (material.porosity, material.biot, material.grain_bulk)
    if material.state or material.unknowns or any(map(callable, fields)):
        raise ValueError(
            f"{type(material).__name__}: the reference has no state and no local unknowns; only moduli, "
            "conductivity and parameters of the law may be functions of position, other data must be numbers"
        )


class BiotFEM:
    """Finite element model of a box, with its state.  Without fluid, the model describes the drained skeleton.

    Parameters
    ----------
    grid
        Mesh of the box-shaped body: a `Grid` with cells of equal size.  No other model may use this grid.
    material, fluid
        `material`: skeleton whose law has no state variables and no local unknowns.  `fluid`: pore fluid, or None.
        With steep retention curves (n > 2.5, or with an air entry), steps may fail to converge.
    walls
        Sides of the box, each with the displacement components that are zero there, such as {"left": "xy"}.
    conditions
        `Traction`, `Pressure`, `RigidPlate` and `Drained` on sides.  With "taylor-hood", `Drained` acts only on facets
        that are completely in its region.  All other sides are free of loads, and undrained.
    pressure : Pa
        Initial pore pressure, or a function of positions x (n, d), in m.  The initial effective stress is zero.  Loads
        or strains must therefore balance the initial pressure.
    gravity : callable t -> (d,), m/s^2
        Acceleration of gravity as a function of time.
    terms
        User-defined terms as for `Simulation`, but no terms on sides; see `user_functions` and `Source`.  The argument
        q of a `Source` is a test function of the elements for pressure.
    element
        "taylor-hood" has Q2 displacements and Q1 pressures.  "q1-dg0" has Q1 displacements, cellwise pressures and
        two-point fluxes.
    numerics
        Time integration, and tolerance of the residual.  The tolerance is relative to the larger of the loads and the
        first residual of a step.
    """

    def __init__(
        self,
        grid: Grid,
        material: Skeleton,
        *,
        walls: Mapping[str, str],
        conditions: Sequence[Traction | Pressure | RigidPlate | Drained] = (),
        fluid: Fluid | None = None,
        pressure: float | Callable[[NDArray], ArrayLike] = 0.0,
        gravity: Callable[[float], ArrayLike] | None = None,
        terms: Sequence[Callable | Source] = (),
        element: str = "taylor-hood",
        numerics: Numerics = DEFAULT,
    ):
        _check_scene(grid, material, fluid, element, conditions)
        instance("numerics", numerics, Numerics)
        tractions = [one for one in conditions if isinstance(one, (Traction, Pressure))]
        plates = [one for one in conditions if isinstance(one, RigidPlate)]
        drained = [one for one in conditions if isinstance(one, Drained)]
        terms, sources = sorted_terms(terms)
        functions("terms", terms)
        functions("sources", sources)
        if fluid is None and (drained or sources):
            raise ValueError("conditions: drained sides and sources must be given with a fluid")
        self.grid = grid
        self.material, self.fluid = material, fluid
        radius = ufl.SpatialCoordinate(self.grid.mesh)[0]
        self._around = TURN * radius if grid.axisymmetric else 1.0  # factor from plane to volume integrals
        self.tolerance, self._t = numerics.tolerance, fem.Constant(self.grid.mesh, 0.0)
        self._substeps = substeps(numerics.method, fluid is not None or bool(terms))  # terms may depend on the velocity
        self.scale = float(np.max(material.at(self.grid.midpoints + self.grid.base).oedometric))
        """Scale of the unknown pressure and of both equations, in Pa."""
        self._pores = Pores(self.grid.mesh, material.retention if fluid else None, self.scale)
        self._whole = fem.Constant(self.grid.mesh, 1.0)
        """Factor of the derivative of k_r in the tangent: 0 omits it, and 1 includes it."""
        self._space = Space(self.grid, fluid is not None, *ELEMENTS[element])
        if fluid is not None:
            start = fem.Function(self._space.of_p)
            start.interpolate(partial(self._begin, pressure))
            for w in (self._space.w, self._space.old, self._space.same):
                w.x.array[self._space.p_dofs] = start.x.array / self.scale
        self._bcs = self._conditions(with_axis(self.grid, walls), drained if element == "taylor-hood" else ())
        start = time.perf_counter()
        self._plates = [(plate, self._area(plate)) for plate in plates]
        for load in tractions:
            if not callable(load.value):
                self._traction(load, 0.0)
        tractions = [*tractions, *(plate.traction(area, self._inward(plate.side)) for plate, area in self._plates)]
        outlets = drained if element == "q1-dg0" else None
        with compiling(f"{type(material).__name__}, terms, sources", "UFL, terms linear in v or energies of u"):
            self._forms = self._compile(tractions, outlets, gravity, terms, sources)
        self.jit = time.perf_counter() - start  # time, in s, to compile or load the forms
        self._snes = self._solver()

    @property
    def t(self) -> float:
        """Time, s."""
        return float(self._t.value)

    @property
    def _places(self):
        """True reference positions as UFL, in place of positions relative to the base of the grid."""
        return ufl.SpatialCoordinate(self.grid.mesh) + self._constant(self.grid.base)

    def _constant(self, value: ArrayLike) -> fem.Constant:
        return fem.Constant(self.grid.mesh, np.asarray(value, dtype=float))

    def _field(self, value: Field) -> fem.Constant | fem.Function:
        """Return a parameter as UFL.  A function of position is interpolated quadratically in each cell.

        Interpolation points are slightly inside the cells, because parameters may jump between cells.
        """
        if not callable(value):
            return self._constant(value)
        d, msh = self.grid.dim, self.grid.mesh
        at, middle, centre = (fem.Function(_compat.function_space(msh, "DG", k, (d,))) for k in (2, 2, 0))
        for f in (at, centre):
            f.interpolate(lambda x: x[:d])
        middle.interpolate(centre)
        x = (middle.x.array + (1 - SAME) * (at.x.array - middle.x.array)).reshape(-1, d)
        rows = np.asarray(value(x + self.grid.base), float)
        f = fem.Function(_compat.function_space(msh, "DG", 2, rows.shape[1:]))
        f.x.array[:] = rows.ravel()
        return f

    def _box(self, name: str, region: Region | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and the highest corner of a flat box around a side or a part of it."""
        grid, (axis, end) = self.grid, side(name, self.grid.dim)
        low, high = limits(region, grid.dim) - grid.base
        plane, near = (grid.low, grid.high)[end][axis], NEAR * grid.h
        low, high = np.maximum(low, grid.low) - near, np.minimum(high, grid.high) + near
        if not (low[axis] <= plane <= high[axis] and (low < high).all()):
            raise ValueError(f"side {name!r}: the region {line(region)} must contain a part of the side")
        low[axis], high[axis] = plane - near[axis], plane + near[axis]
        return low, high

    def _prescribe(self, space, value: float, name: str, region: Region | None = None):
        """Return the boundary condition that prescribes a value on a side or a part of it."""
        msh = self.grid.mesh
        d = self.grid.dim
        (low, high) = np.array(self._box(name, region))[:, :, None]
        facets = mesh.locate_entities_boundary(msh, d - 1, lambda x: ((x[:d] >= low) & (x[:d] <= high)).all(axis=0))
        return fem.dirichletbc(PETSc.ScalarType(value), fem.locate_dofs_topological(space, d - 1, facets), space)

    def _conditions(self, walls: Mapping[str, str], drained: Sequence[Drained]) -> list:
        """Return the boundary conditions for zero displacements and for nodal pressures."""
        axes = "xyz"[: self.grid.dim]
        bcs = []
        space = self._space.u.function_space
        for name, held in walls.items():
            if not isinstance(held, str) or not held or not set(held) <= set(axes):
                raise ValueError(f"walls: {name!r}: components {held!r}, must be among {axes!r}")
            bcs += [self._prescribe(space.sub(axes.index(a)), 0.0, name) for a in held]
        return bcs + [self._prescribe(self._space.W.sub(1), o.pressure / self.scale, o.side, o.region) for o in drained]

    def _inward(self, name: str) -> NDArray[np.float64]:
        """Return the inward normal (d,) of a side."""
        axis, end = side(name, self.grid.dim)
        return (1 - 2 * end) * np.eye(self.grid.dim)[axis]

    def _area(self, condition: RigidPlate) -> float:
        """Return the area, in m^(d-1), of the loaded part of a side."""
        low, high = self._box(condition.side, condition.region)
        within = np.minimum(high, self.grid.high) - np.maximum(low, self.grid.low)
        area = float(np.delete(within, side(condition.side, self.grid.dim)[0]).prod())
        middle = (np.maximum(low, self.grid.low) + np.minimum(high, self.grid.high)) / 2
        return area * float(np.squeeze(self.grid.around(middle[None])))

    def _on(self, condition: Traction | Pressure | Drained | RigidPlate, integrand):
        """Return the integral of `integrand` over the loaded or drained part of a side, as UFL."""
        low, high = map(self._constant, self._box(condition.side, condition.region))
        for a, x in enumerate(ufl.SpatialCoordinate(self.grid.mesh)):
            integrand = ufl.conditional(ufl.And(ufl.ge(x, low[a]), ufl.le(x, high[a])), integrand, 0.0)
        degree = 2 * self._space.degree if condition.region is None else CUT_DEGREE
        return self._around * integrand * ufl.ds(domain=self.grid.mesh, metadata={"quadrature_degree": degree})

    def _compile(
        self, loads: Sequence, outlets: Sequence | None, gravity: Callable | None, terms: Sequence, sources: Sequence
    ) -> Forms:
        """Compile loads, residual and tangent.  `outlets`: drained sides, or None with nodal pressures."""
        dt, since, t = (self._constant(1.0) for _ in range(3))
        law = self.material
        space = self._space
        split = ufl.split if self.fluid else lambda f: (f, 0)
        test = ufl.TestFunction(space.W)
        (u, p), (u_n, p_n), (past, _), (v, q) = map(split, (space.w, space.old, space.past, test))
        degree, scale = 2 * space.degree, self._constant(self.scale)
        around, dx = self._around, ufl.dx(domain=self.grid.mesh, metadata={"quadrature_degree": degree})
        F, F_n = (ufl.variable(self._deformation(f)) for f in (u, u_n))
        J, J_n = ufl.det(F), ufl.det(F_n)
        parameters = {name: self._field(getattr(law, name)) for name in law.parameters}
        effective = self._pores.of("bishop", p) * p
        P = law.first_piola(F, parameters) / scale - self._constant(law.biot) * effective * ufl.diff(J, F)
        residual, flux = around * ufl.inner(P, self._grad(v)) * dx, None
        points = SimpleNamespace(  # the configuration at the start of the step
            dx=PointMeasure(self.grid.mesh, around * J_n, "everywhere", degree),
            value=lambda f: f,
            grad=lambda f: ufl.dot(self._grad(f), ufl.inv(F_n)),
            F=F_n,
            displacement=u_n,
            position=self._places + u_n,
            **parameters,
        )
        arguments = {"points": points, "t": t}
        for term in terms:
            more = {"u": u - u_n, "v": v, "dt": since, "velocity": (u - u_n - past) / dt}
            residual += 1 / scale * term_of(term, space.w, test, **arguments, **more)[0]
        gravity_constant = None if gravity is None else self._constant(np.zeros(self.grid.dim))
        if self.fluid:
            content, flux = self._storage(F, u, J_n, p, p_n, q, dt, outlets, gravity_constant)
            flux -= sum(dt * form_of("sources", source, **arguments, q=q, p=scale * p) for source in sources)
            residual += around * content * dx + flux
            flux = _compat.compiled(flux)
        for plate, area in self._plates:
            axis, d = side(plate.side, self.grid.dim)[0], self.grid.dim
            slope = [ufl.as_vector([f[axis].dx(a) for a in range(d) if a != axis]) for f in (u, v)]
            residual += self._on(plate, self._constant(RIGIDITY * area ** (1 / (d - 1))) * ufl.inner(*slope))
        given, dead = [], []
        for load in loads:
            value = self._constant(0.0 if isinstance(load, Pressure) else np.zeros(self.grid.dim))
            given.append((partial(self._traction, load), value))
            if isinstance(load, Pressure):
                along = self._in_plane(ufl.diff(J, F)) * ufl.FacetNormal(self.grid.mesh)
                residual += self._on(load, value / scale * ufl.inner(along, v))
            else:
                dead.append(self._on(load, ufl.inner(value, v) / scale))
        if gravity is not None:
            given.append((partial(self._acceleration, gravity), gravity_constant))
            solid = self._constant((1 - law.porosity) * law.grain_density)
            dead.append(around * solid * ufl.inner(gravity_constant, v) / scale * dx)
            if self.fluid:
                weight = self._constant(self.fluid.density) * self._held(J, p) * gravity_constant
                residual -= around * ufl.inner(weight, v) / scale * dx
        tangent = ufl.derivative(residual, space.w, ufl.TrialFunction(space.W))
        load = _compat.compiled(sum(dead)) if dead else None
        return Forms(_compat.compiled(residual), _compat.compiled(tangent), flux, load, dt, since, t, given)

    def _grad(self, f):
        """Return grad f as UFL, with the shape (3, 3) for vectors in axisymmetry."""
        grad = ufl.grad(f)
        if not (self.grid.axisymmetric and f.ufl_shape):
            return grad
        hoop = f[0] / ufl.SpatialCoordinate(self.grid.mesh)[0]
        return ufl.as_matrix([[grad[0, 0], grad[0, 1], 0], [grad[1, 0], grad[1, 1], 0], [0, 0, hoop]])

    def _deformation(self, u):
        """Return F = I + grad u as UFL."""
        F = ufl.Identity(self.grid.stretches) + self._grad(u)
        return block(F) if self.grid.axisymmetric else F

    def _in_plane(self, T):
        """Return the tensor T, in axisymmetry without its circumferential components."""
        return ufl.as_matrix([[T[i, j] for j in (0, 1)] for i in (0, 1)]) if self.grid.axisymmetric else T

    def _begin(self, pressure: float | Callable, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the initial pressures, in Pa, at positions x (3, n), in m."""
        n, places = x.shape[1], x[: self.grid.dim].T + self.grid.base
        values = pressure(places) if callable(pressure) else pressure
        return np.broadcast_to(numbers("pressure", values, (), (n,), allowed="a number, or one for each position"), n)

    def _held(self, J, p):
        """Return the volume of the pore fluid per reference volume, as UFL."""
        return self._pores.of("saturation", p) * (J - self._constant(1 - self.material.porosity))

    def _storage(self, F, u, J_n, p, p_n, q, dt: fem.Constant, outlets: Sequence[Drained] | None, pull):
        """Return the change of the fluid content, multiplied by q, and the flux in the storage equation, as UFL.

        `pull`: acceleration of gravity, in m/s^2.
        """
        law, J = self.material, ufl.det(F)
        # S is linear in the porosity; S_0 and S_1 are finite for infinite bulk moduli
        S_0, S_1 = (self.scale * law.storage(self.fluid.bulk, n) for n in (0.0, 1.0))
        n, n_n = (1 - self._constant(1 - law.porosity) / volume for volume in (J, J_n))
        a, S = self._constant(S_1), self._constant(S_0) + self._constant(S_1 - S_0) * n_n
        content = J_n * change_of_content(self._constant(law.biot), a, S, J / J_n, p - p_n)
        compliance = self._constant(self.scale / self.fluid.bulk)
        content *= ufl.exp(compliance * (p + p_n) / 2)
        if self._pores.law is not None:
            full = self._pores.of("saturation", p)
            content = full * content + (full - self._pores.of("saturation", p_n)) * J_n * n_n * ufl.exp(
                compliance * p_n
            )
        content *= q
        k = self._field(law.conductivity)
        if law.conductivity_law is not None:
            porosity = {"porosity": n, "porosity0": self._constant(law.porosity)}
            x = self._places + u
            k = call(law.conductivity_law, conductivity=k, F=F, J=J, x=x, **porosity)
        kappa = dt * self._constant(self.scale / self.fluid.unit_weight) * k
        inverse = self._in_plane(ufl.inv(F).T)
        weight = None if pull is None else self._constant(self.fluid.density / self.scale) * pull
        if outlets is not None:
            return content, self._two_point(kappa, F, inverse, p, q, outlets, weight)
        dx = ufl.dx(domain=self.grid.mesh, metadata={"quadrature_degree": 2 * self._space.degree})
        gradient = inverse * ufl.grad(mass_potential_form(p, compliance))
        if weight is not None:
            gradient -= ufl.exp(compliance * p) * weight
        kappa *= self._pores.of("relative_permeability", self._seen)
        return content, self._around * kappa * J * ufl.inner(gradient, inverse * ufl.grad(q)) * dx

    @property
    def _seen(self):
        """Scaled pressure at which k_r is evaluated, as UFL.

        The factor `_whole` determines whether the tangent contains the derivative of k_r.
        """
        now, same = (ufl.split(f)[1] for f in (self._space.w, self._space.same))
        return self._whole * now + (1 - self._whole) * same

    def _two_point(self, kappa, F, inverse, p, q, outlets: Sequence[Drained], weight):
        """Return the fluxes between cells and through drained sides, as UFL.

        `weight` (d,), in 1/m: weight of the fluid per volume, divided by `scale`, or None.
        """
        compliance = self._constant(self.scale / self.fluid.bulk)
        pi = mass_potential_form(p, compliance)
        normal, h = ufl.FacetNormal(self.grid.mesh), self._constant(self.grid.h)
        stretch = ufl.det(F) * ufl.inner(inverse * normal, inverse * normal)
        across = sum(abs(normal[a]) * h[a] for a in range(self.grid.dim))
        dS = ufl.dS(domain=self.grid.mesh, metadata={"quadrature_degree": 2})
        harmonic = 2 * kappa("+") * kappa("-") / (kappa("+") + kappa("-") + TINY)
        around = self._around("+") if self.grid.axisymmetric else 1.0
        edge = across * self._in_plane(F) * normal
        seen, difference = self._seen, ufl.jump(pi)
        if weight is not None:
            drop = ufl.dot(weight("+"), (edge("+") - edge("-")) / 2)
            difference += density_between(p("+"), p("-"), compliance) * drop
        share = self._pores.between(seen("+"), seen("-")) * ufl.avg(stretch) / across("+")
        flux = around * harmonic * share * difference * ufl.jump(q) * dS
        for o in outlets:
            outer = self._constant(o.pressure / self.scale)
            difference = pi - self._constant(mass_potential(o.pressure, self.fluid.bulk) / self.scale)
            if weight is not None:
                difference += density_between(p, outer, compliance) * ufl.dot(weight, edge / 2)
            flux += self._on(o, 2 * kappa * self._pores.between(seen, outer) * stretch / across * difference * q)
        return flux

    def _solver(self) -> PETSc.SNES:
        """Return PETSc's Newton solver, with full steps and a direct linear solver.

        A line search would be very slow for a rotating slender body, because linearised rotations stretch the body.
        """
        options, prefix = PETSc.Options(), "mpm_reference_"
        if not options.hasName(f"{prefix}snes_linesearch_type"):
            options[f"{prefix}snes_linesearch_type"] = "basic"
        snes = PETSc.SNES().create(self.grid.comm)
        snes.setOptionsPrefix(prefix)
        snes.setFunction(self._residual, _compat.petsc_vec(self._space.b).duplicate())
        snes.setJacobian(self._tangent, petsc.create_matrix(self._forms.tangent))
        snes.ksp.setType("preonly")
        snes.ksp.pc.setType("lu")
        snes.ksp.pc.setFactorSolverType("mumps")
        snes.setConvergenceHistory(reset=True)
        snes.setFromOptions()
        return snes

    def _residual(self, _snes: PETSc.SNES, x: PETSc.Vec, out: PETSc.Vec) -> None:
        self._take(x)
        b = self._assemble(self._space.b, self._forms.residual)
        b.axpy(-1.0, _compat.petsc_vec(self._space.f))
        # no lifting, because every iterate satisfies the prescribed values
        petsc.set_bc(b, self._bcs, _compat.petsc_vec(self._space.w), -1.0)
        b.copy(out)

    def _tangent(self, _snes: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, _P: PETSc.Mat) -> None:
        self._take(x)
        A.zeroEntries()
        petsc.assemble_matrix(A, self._forms.tangent, self._bcs)
        A.assemble()

    def _take(self, x: PETSc.Vec) -> None:
        space = self._space
        x.copy(_compat.petsc_vec(space.w))
        space.w.x.scatter_forward()
        space.same.x.array[:] = space.w.x.array

    def _assemble(self, out: fem.Function, form) -> PETSc.Vec:
        out.x.array[:] = 0.0
        petsc.assemble_vector(_compat.petsc_vec(out), form)
        _compat.scatter_reverse_add(out)
        return _compat.petsc_vec(out)

    def step(self, dt: float) -> tuple[int, float]:
        """Advance by dt, in s, > 0, and return the number of Newton iterations and the relative residual.

        If `NotConverged` is raised, the state has not changed.
        """
        numbers("dt", dt, test=lambda v: (0 < v) & (v < np.inf), allowed="> 0 and finite")
        newton, worst = 0, 0.0
        for substep in self._substeps:
            took, residual = self._solve(substep, dt)
            newton, worst = newton + took, max(worst, residual)
        self._space.old.x.array[:] = self._space.w.x.array
        self._t.value += dt
        return newton, worst

    def _acceleration(self, gravity: Callable[[float], ArrayLike], t: float) -> NDArray[np.float64]:
        """Return the acceleration of gravity (d,), in m/s^2, at the time t, in s."""
        d = self.grid.dim
        return numbers("gravity", gravity(t), (d,), allowed=f"{d} finite numbers")

    def _solve(self, substep: Substep, dt: float) -> tuple[int, float]:
        """Solve one substep, and return the number of Newton iterations and the relative residual."""
        forms = self._forms
        space = self._space
        snes = self._snes
        space.past.x.array[:] = substep.before / substep.own * (space.w.x.array - space.old.x.array)
        space.f.x.array[:] = 0.0
        if substep.before and forms.flux is not None:  # flux with the rate at the end of the previous substep
            forms.dt.value = substep.before * dt
            self._assemble(space.f, forms.flux).scale(-1.0)
        forms.dt.value = substep.own * dt
        forms.since.value = substep.end * dt
        forms.t.value = self.t + substep.end * dt
        for value, constant in forms.given:
            constant.value = value(self.t + substep.end * dt)
        load = 0.0
        if forms.load is not None:
            load = self._assemble(space.b, forms.load).norm()
            space.f.x.array[:] += space.b.x.array
        x = _compat.petsc_vec(self._space.w).copy()
        petsc.set_bc(x, self._bcs)
        round_off = ROUND_OFF * self.grid.cell_volume / self.grid.h.min() * np.sqrt(x.getSize())
        snes.setTolerances(self.tolerance, max(self.tolerance * load, round_off), 0.0)
        norms, reason = self._free(x) if self._pores.law is None else self._restrained(x)
        scale = max(load, norms[0], round_off / self.tolerance)
        if reason < 0:
            parts = self._parts(x, scale)
            self._take(_compat.petsc_vec(self._space.old))
            raise NotConverged(f"PETSc SNES stopped with reason {reason}", [parts])
        self._take(x)
        return len(norms) - 1, norms[-1] / scale

    def _free(self, x: PETSc.Vec) -> tuple[NDArray[np.float64], int]:
        """Solve with SNES.  Return the residual norms of all iterations, and PETSc's reason for the end."""
        self._snes.solve(None, x)
        return self._snes.getConvergenceHistory()[0], self._snes.reason

    def _restrained(self, x: PETSc.Vec) -> tuple[list[float], int]:
        """Solve by Newton steps with limited pressure changes, see `retention.restrained`.  Return as `_free` does.

        These tangents omit the derivative of k_r: the first (Celia, Bouloutas and Zarba 1990), a tangent after a
        limited step, and a tangent after an increase of the residual.  In dry soil under gravity, this derivative may
        reverse the Newton step.
        """
        snes, of_p = self._snes, self._space.p_dofs
        of_p = of_p[of_p < x.getLocalSize()]
        relative, absolute, small, most = snes.getTolerances()
        norms: list[float] = []
        reason, self._whole.value = PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT, 0.0
        for _ in range(most):
            before = x.array_r[of_p].copy()
            snes.setTolerances(0.0, 0.0, small, 1)
            snes.solve(None, x)
            (first, last), _ = snes.getConvergenceHistory()
            norms.append(first)
            newton = before - x.array_r[of_p]
            limited = self._pores.reached(before, newton)
            x.array_w[of_p] = before - limited
            reached = self.grid.comm.allreduce(np.array_equal(limited, newton), op=MPI.LAND)
            self._whole.value = float(reached and last < first)
            if reached and last <= max(absolute, relative * norms[0]):
                reason = PETSc.SNES.ConvergedReason.CONVERGED_FNORM_RELATIVE
                break
        snes.setTolerances(relative, absolute, small, most)
        return [*norms, last], reason

    def _traction(self, load: Traction | Pressure, t: float) -> NDArray[np.float64] | float:
        """Return a traction (d,) or a pressure, in Pa, at the time t, in s."""
        if isinstance(load, Pressure):
            return float(load.at(t))
        value = load.at(t, self.grid.dim)
        if not value.ndim:
            raise ValueError(
                f"{line(load)}: value must have {self.grid.dim} components, because the reference has no normals"
            )
        return value

    def _parts(self, x: PETSc.Vec, scale: float) -> tuple[float, float]:
        """Return the norms of the momentum residual and of the storage residual, divided by `scale`."""
        self._residual(self._snes, x, x.duplicate())
        squares = (self._space.b.x.array / scale) ** 2
        squares[_compat.petsc_vec(self._space.b).getLocalSize() :] = 0.0  # ghosts
        storage = squares[self._space.p_dofs].sum()
        return tuple(np.sqrt(self.grid.comm.allreduce(np.array([squares.sum() - storage, storage]))))

    def run(self, t_end: float, dt: float, *, probes: ArrayLike, progress: bool = False) -> Result:
        """Advance to t_end (s) in equal steps dt (s).

        If a step does not converge, `GaveUp` is raised, with the histories before this step.

        Parameters
        ----------
        probes : (n, d), m
            Reference positions in the body at which displacements are recorded.
        progress
            Whether to show a progress bar on a terminal.
        """
        steps = round((t_end - self.t) / dt) if dt > 0 else 0
        if steps < 1 or abs(steps * dt - (t_end - self.t)) > NEAR * dt:
            raise ValueError(f"dt = {dt!r}, t_end = {t_end!r}: dt must divide the remaining {t_end - self.t:g} s")
        x = positions(probes, self.grid.dim)
        out = np.flatnonzero(self.grid.outside(x - self.grid.base))
        if len(out):
            raise ValueError(f"probe at {x[out[0]]}: outside the body, must be in the body or on its surface")
        result, start = Result(Rows([self._row(x)])), time.perf_counter()
        shown = {"disable": not progress or self.grid.comm.rank > 0 or None, "unit": "step", "desc": "finite elements"}
        for _ in tqdm(range(steps), **shown):
            try:
                newton, residual = self.step(dt)
            except NotConverged as failed:
                message = f"gave up at t = {self.t:g} s with dt = {dt:.3g} s: {failed}"
                raise GaveUp(message, result, failed.history) from failed
            result = result.after(Report(newton=newton, history=[(residual, 0.0)])).more(self._row(x))
        return replace(result, wall=time.perf_counter() - start, converged=True)

    def displacement(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (n, d), in m, at reference positions x (n, d), in m, on every process."""
        return self._at(self._space.u, x, self.grid.dim)

    def pressure(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pore pressures (n,), in Pa, at reference positions x (n, d), in m, on every process."""
        return self.scale * self._at(self._space.p, x, 1)[:, 0]

    def water(self) -> float:
        """Return the present volume, in m^d, of the pore fluid in the whole body."""
        u, p = ufl.split(self._space.w)
        dx = ufl.dx(domain=self.grid.mesh, metadata={"quadrature_degree": 2 * self._space.degree})
        held = _compat.compiled(self._around * self._held(ufl.det(self._deformation(u)), p) * dx)
        return self.grid.comm.allreduce(fem.assemble_scalar(held))

    def _at(self, f: fem.Function, x: NDArray[np.float64], size: int) -> NDArray[np.float64]:
        """Return the values of a function at reference positions x (n, d), on every process."""
        grid = self.grid
        out = np.zeros((len(x), size))
        x = x - self.grid.base
        cells = grid.locals[grid.number(grid.index_from_base(x))]
        local = np.flatnonzero((cells >= 0) & (cells < grid.num_owned))
        if len(local):
            out[local] = f.eval(np.pad(x[local], ((0, 0), (0, 3 - grid.dim))), cells[local]).reshape(-1, size)
        return grid.comm.allreduce(out)

    def _row(self, x: NDArray[np.float64]) -> Row:
        """Return the present results as one row of the histories."""
        pressure = np.zeros(0)
        if self.fluid:
            p, comm = self.scale * self._space.w.x.array[self._space.p_dofs], self.grid.comm
            pressure = np.array([comm.allreduce(p.min(), op=MPI.MIN), comm.allreduce(p.max(), op=MPI.MAX)])
        return Row(self.t, self.displacement(x), pressure)
