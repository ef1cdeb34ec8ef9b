# SPDX-License-Identifier: MIT
"""Balance of momentum for Q1 displacements on the grid.  Integrals are sums over pieces of particle domains.

The displacement increment u of the step defines Delta = I + grad u, F = Delta F_n, J_n = det F_n and
J_Delta = det Delta.  The residual is the derivative of

    int [psi(F) / J_n - alpha p J_Delta] dV_n  -  work of the loads,

with the energy psi of the skeleton, Biot's coefficient alpha and the pore pressure p.  The residual is thus
`int (P' - alpha p J_Delta Delta^-T) : grad v dV_n = int rho g . v dV_n + tractions`, with the density rho, the
acceleration of gravity g and the test function v.  P' is the first Piola-Kirchhoff effective stress relative to the
start of the step.  A law may define the stress instead of psi.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.conditions.acting import At, FormsOf, Loads, defined
from mpm_dolfinx.conditions.walls import wall_shares
from mpm_dolfinx.forms.cell_matrices import Beside, ElementForces, ElementMatrices, StackedElementMatrices
from mpm_dolfinx.forms.point_forms import NONE, CellSums, FormPoints, Given
from mpm_dolfinx.forms.unknowns import Unknowns, matrix, sum_ghosts, zero
from mpm_dolfinx.forms.velocity import Velocity
from mpm_dolfinx.grid.grid import SIDES, among, sum_by
from mpm_dolfinx.materials.evaluate import by_scene
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.local_unknowns import LocalUnknowns
from mpm_dolfinx.materials.skeleton import Skeleton
from mpm_dolfinx.mechanics.dried import OfSuction, suction_sums
from mpm_dolfinx.mechanics.ghost_penalty import GhostPenalty
from mpm_dolfinx.mechanics.inertia import InertiaForms
from mpm_dolfinx.mechanics.mean_dilatation import FBar, MeanDilatation, SumsOfPart
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.mechanics.user_terms import OwnTerms
from mpm_dolfinx.mechanics.weight import Weight
from mpm_dolfinx.points.active import Active, ActiveSet
from mpm_dolfinx.points.parts import OfParts, Parts, relative

Adds = Callable[[NDArray[np.float64]], None]
"""Function that adds local nodal forces, in N, to an array."""


class FormsOfPart(NamedTuple):
    """Compiled forms of one law."""

    residual: ElementForces
    tangent: ElementMatrices | StackedElementMatrices
    local: LocalUnknowns | None  # None for laws without local unknowns
    means: SumsOfPart | None  # sums for F-bar, None for laws without F-bar
    dried: CellSums | None  # for laws that depend on suction, see `suction_sums`


class MomentumForms:
    """Compiled forms of the balance of momentum of a scene.

    `pieces`: all integration points.  With gravity, the points have the field `density`, in kg/m^3.
    `laws`: for each law, its class, its integration points, and whether the law uses F-bar.
    `pressure`: DG0 pore pressure, or None without fluid.
    `gravity` (d,), in m/s^2: acceleration as a UFL constant, or None.
    `materials`: materials of the scene, and its fluid.
    `at_points`: whether bodies are integrated at their material points.
    `terms`: user-defined terms, see `user_functions`.
    `t`, `dt`, in s: time at the end of the substep, and time since the start of the step, as UFL constants.
    `inertia`: whether bodies may have inertia.
    """

    def __init__(
        self,
        pieces: FormPoints,
        laws: Sequence[tuple[type[Skeleton], FormPoints, bool]],
        pressure: fem.Function | None,
        gravity: fem.Constant | None,
        materials: SceneMaterials,
        at_points: bool,
        terms: Sequence[Callable],
        t: fem.Constant,
        dt: fem.Constant,
        inertia: bool = False,
    ):
        self.grid = grid = pieces.grid
        self._retentions = retentions = materials.retentions
        symmetric = materials.symmetric
        V = _compat.function_space(grid.mesh, "Lagrange", 1, (grid.dim,))
        self.u = fem.Function(V)
        """Displacement increment since the start of the step, in m."""
        rooms = [fem.Function(V) for _ in range(3)]
        self._rooms = [(room, room.x.array) for room in rooms]  # buffers for sums of forces that exist together
        self._fbar = FBar(grid, symmetric) if any(locks for *_, locks in laws) else None
        self.inertia = InertiaForms(pieces, [points for _, points, _ in laws], self.u) if inertia else None
        """Forms of inertia, or None in a scene without inertia."""
        dried = pressure is not None and any("suction" in law.state for law, *_ in laws)
        self.law_forms = [self._forms_of_law(*law, pressure, dried, symmetric, dt) for law in laws]
        """Forms of each law."""
        locked = {number: part.means for number, part in enumerate(self.law_forms) if part.means is not None}
        self.dilatation = MeanDilatation(self._fbar, locked, dt) if locked else None
        self._suction = pressure if dried else None
        sums = [part.dried for part in self.law_forms]
        self._of_suction = OfSuction(grid.dim, self.dilatation, sums) if dried else None
        self.wall_shares: Latest[NDArray[np.float64]] = Latest()
        """The last result of `wall_shares`."""
        self.velocity = Velocity(self.u)
        self.conditions = FormsOf(grid, self.u, self.velocity)
        """Forms of the scene's conditions."""
        self.own = OwnTerms(terms, pieces, self.conditions, t, dt)
        full = None if retentions is None else retentions.of("saturation", pressure, pieces)
        wet = materials.fluid and materials.fluid.density
        weight = [] if gravity is None else [Weight(pieces, self.u, gravity, wet, full)]
        self.acting = [*weight, *[self.own] * bool(terms)]
        """Weight and user-defined terms, which act in all stages."""
        self.symmetric = symmetric and self.own.symmetric
        self.linear = not locked and all(law.linear for law, *_ in laws)
        """Whether the tangent of the laws depends only on the positions of the points."""
        self.elastic = not any(law.state for law, *_ in laws)
        """Whether no law has a state, so that the next substep may reuse a tangent."""
        self.ghost = GhostPenalty(grid, V, at_points)
        kept = [self.ghost.fill.x.array], [f.x.array for f in (self.u, *rooms)]
        self.active = Active(grid, pressure is not None, *kept)
        """Active cells and nodes.  At all other nodes, u is zero."""

    def _forms_of_law(
        self,
        law: type[Skeleton],
        points: FormPoints,
        locks: bool,
        pressure: fem.Function | None,
        dried: bool,
        symmetric: bool,
        dt: fem.Constant,
    ) -> FormsOfPart:
        """Return the compiled forms of a law.  `dried`: whether any law of the scene depends on suction."""
        F = points.deformation(self.u)
        values = {name: getattr(points, name) for name in (*law.parameters, *law.state)}
        values |= by_scene(self.grid, None, law, points) | {"dt": dt}
        p = local = means = None
        if dried and "suction" in law.state:
            p = ufl.variable(self._retentions.at(pressure, points))
            values["suction"] = ufl.max_value(-p, 0.0)
        seen = self._fbar.of(points, F) if locks else F
        if law.unknowns:
            local = LocalUnknowns(law, points, seen, values)
            values, known = values | local.values, values | local.known
        else:
            known = values
        # derivatives with respect to F; derivatives with respect to u compile twenty times as long in 3D
        beside = Beside()
        if locks:
            ratio = ufl.det(points.increment(self.u))
            P, A, beside, means = self._fbar.forms(law, points, F, seen, ratio, values, known)
        else:
            P = law.first_piola(F, known)
            A = ufl.diff(P if known is values else law.first_piola(F, values), F)
        slopes = []
        if p is not None:
            stresses = self._fbar.stresses(law, F, seen, values) if locks else [law.first_piola(F, values)]
            slopes = [ufl.diff(of, p) for of in stresses]
        sums = suction_sums(points, F, slopes, locks) if dried else None
        if pressure is not None:
            of_pressure = -points.biot * pressure * ufl.diff(ufl.det(F), F)
            if self._retentions is not None:
                of_pressure = self._retentions.of("bishop", pressure, points) * of_pressure
            P, A = P + of_pressure, A + ufl.diff(of_pressure, F)
        share = 1 / ufl.det(points.F)  # a common factor: a division would be compiled for each component
        P, A = share * P, share * A
        stress = P * points.F.T
        if points.chord is not None:
            stress = points.chord(points.gradient(self.u))[1] * stress
        residual = ElementForces(stress, points)
        i, j, k, l, m, n = ufl.indices(6)
        if self.grid.dim == 2:
            A = ufl.as_tensor(A[i, m, j, n] * points.F[k, m] * points.F[l, n], (i, k, j, l))
            beside = beside._replace(along=[T * points.F.T for T in beside.along])
            return FormsOfPart(residual, ElementMatrices(A, points, symmetric, beside), local, means, sums)
        return FormsOfPart(residual, StackedElementMatrices(A, points, symmetric, beside), local, means, sums)

    def of_suction(self, data: QuadratureData) -> list[tuple[NDArray[np.int32], NDArray[np.float64]]]:
        """Return the derivatives of nodal forces with respect to cell pressures, see `OfSuction.rows`."""
        return [] if self._of_suction is None else self._of_suction.rows(data, self._given(data, derive=True))

    def set_contents(self, own: NDArray[np.int64], *contents: NDArray[np.float64]) -> ActiveSet:
        """Set the volume fractions and moduli of owned cells with material.  Return the active cells and nodes."""
        self.active.clear()
        cells = self.ghost.set_contents(own, *contents)
        self.active.set(cells, lambda: self.active_nodes(cells).nonzero()[0])
        return self.active.now

    def summed(self, room: int, adders: Sequence[Adds]) -> NDArray[np.float64]:
        """Return the nodal forces of `adders`, summed over processes.  `room`: index of the buffer for the result."""
        carrier, out = self._rooms[room]
        out[self.active.now.dofs] = 0.0
        for add in adders:
            add(out)
        return out if self.grid.comm.size == 1 else sum_ghosts(carrier)

    @cached_property
    def nodal(self) -> NDArray[np.float64]:
        """Displacement increment u as an array (nodes, d), in m."""
        return self.u.x.array.reshape(-1, self.grid.dim)

    def internal(self, data: QuadratureData, others: Sequence[Adds] = ()) -> NDArray[np.float64]:
        """Return the nodal forces of the stresses, plus the forces that `others` add, in N."""
        adders = []
        for forms, part, values in zip(self.law_forms, data.parts, self._nothing or self._given(data), strict=True):
            adders.append(partial(forms.residual.assemble_vector, data=part, given=values))
        return self.summed(0, [*adders, *others])

    def assemble_tangent(self, K: PETSc.Mat, data: QuadratureData) -> None:
        """Add the tangent of the stresses at u to K, without final assembly."""
        parts = zip(self.law_forms, data.parts, self._nothing or self._given(data, derive=True), strict=True)
        sums = [forms.tangent.assemble_matrix(K, part, given) for forms, part, given in parts]
        if self.dilatation is not None:
            self.dilatation.assemble_matrix(K, data, sums)

    def average(self, delta: NDArray[np.float64], data: QuadratureData) -> None:
        """Scale the gradients Delta of pieces with F-bar to the volume ratios of their cells."""
        if self.dilatation is not None:
            self.dilatation.average(delta, data, self._motion)

    @property
    def _motion(self) -> tuple:
        """Cache key that identifies the present displacement and suction."""
        p = None if self._suction is None else self._suction.x.array.copy()
        return self.u.x.array[self.active.now.dofs], self.inertia and float(self.inertia.midpoint.value), p

    @cached_property
    def _nothing(self) -> list[Given]:
        """Result of `_given` if no law has local unknowns or F-bar, and an empty list otherwise."""
        some = self.dilatation is not None or any(forms.local is not None for forms in self.law_forms)
        return [] if some else [NONE] * len(self.law_forms)

    def _given(self, data: QuadratureData, derive: bool = False) -> Sequence[Given]:
        """Set theta and pi of F-bar at u.  Return stresses and local unknowns that the forms of each law need."""

        motion = self._motion

        def solve(derive: bool = False) -> list[Given]:
            parts = zip(self.law_forms, data.parts, strict=True)
            return [NONE if forms.local is None else forms.local.solve(part, derive, motion) for forms, part in parts]

        if self.dilatation is None:
            return solve(derive)
        given = self.dilatation.at(data, motion, solve)
        return [{**a, **b} for a, b in zip(given, solve(derive), strict=True)] if derive else given

    def at_nodes(self, cells: NDArray[np.int32], values: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return nodal sums (k, nodes) of k quantities from their values in the cells."""
        (shared, values_at), nodes = self._rooms[0], self.active.now.nodes
        at = nodes.searchsorted(self.grid.cell_nodes[cells])
        of_nodes = np.array([of + np.zeros(at.shape) for of in values])
        out = sum_by(at.ravel(), of_nodes.reshape(len(values), at.size), len(nodes))
        for row in out if self.grid.comm.size > 1 else ():
            values_at[self.active.now.dofs] = row.repeat(self.grid.dim)
            sum_ghosts(shared)
            shared.x.scatter_forward()
            row[:] = values_at[nodes * self.grid.dim]
        return out

    def parts(self, of: NDArray[np.int64], count: int) -> Parts:
        """Return the connected parts of the bodies from the results of `OnGrid.parts_of_cells`."""
        grid, nodes = self.grid, np.full(len(self.grid.node_x), -1)
        own = self.active.now.cells[self.active.now.cells < grid.num_owned]
        total, count_of = self.at_nodes(own, [of[own, None], np.ones((len(own), 1))])
        nodes[self.active.now.nodes] = np.rint(total / count_of).astype(np.int64) - 1
        return Parts(count, of - 1, nodes)

    def active_nodes(self, cells: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return whether each local node belongs to an active cell of any process."""
        nodes = np.zeros(len(self.grid.node_x), dtype=bool)
        nodes[self.grid.cell_nodes[cells]] = True
        if self.grid.comm.size == 1:
            return nodes
        shared, values = self._rooms[0]
        values[:] = nodes.repeat(self.grid.dim)
        _compat.scatter_reverse_add(shared)
        shared.x.scatter_forward()
        return values[:: self.grid.dim] > 0


class MomentumSystem:
    """Vectors and matrices of the balance of momentum for one set of active cells.

    `dofs`: unrolled local degrees of freedom that are unknowns, ghosts included.
    `cells`: active cells of this process.
    `facets`: faces of this process with a ghost penalty.
    `stiff`: whether plates or prescribed displacements have a penalty.
    `parts`: connected parts of the bodies.
    """

    def __init__(
        self,
        forms: MomentumForms,
        dofs: NDArray[np.int64],
        cells: NDArray[np.int32],
        facets: NDArray[np.int32],
        stiff: bool,
        parts: Parts,
    ):
        self._forms, d = forms, forms.grid.dim
        at_nodes = forms.grid.node_x, forms.grid.near_others[0]
        self.unknowns = Unknowns(forms.u, dofs, at_nodes)
        self.locks = forms.dilatation is not None
        """Whether any law uses F-bar."""
        active = forms.active.now.dofs
        self.touched = active[active < d * forms.u.function_space.dofmap.index_map.size_local]
        """Owned degrees of freedom of active cells, including fixed ones."""
        self.parts, comm = parts, forms.grid.comm
        self.of_parts, self._touched = (
            OfParts(comm, parts.nodes[at // d], parts.count) for at in (self.unknowns.owned, self.touched)
        )
        """Connected part of each unknown, and of each degree of freedom in `touched`."""
        self.rounding = self.unknowns.vector()
        """Rounding error of the residual at each unknown, in N."""
        self.of_whole = self.unknowns.vector()
        """`rounding` of each unknown, in N, times the square root of the number of unknowns in its connected part."""
        self.K = matrix(self.unknowns, self.unknowns, 3**d * d)
        self.mass: PETSc.Mat | None = None
        """Mass matrix, in kg, or None without inertia."""
        self.residual, self.step = self.unknowns.vector(), self.unknowns.vector()
        held = active[~among(active, dofs)]
        self.held = Unknowns(forms.u, held, at_nodes)
        """Degrees of freedom that walls of the grid fix."""
        self.held_residual = self.held.vector()
        self.penalty, self.held_penalty = (self._penalty_matrix(of, facets, stiff) for of in (self.unknowns, self.held))
        at_walls = np.zeros(len(forms.grid.node_x), dtype=bool)
        at_walls[held // d] = True
        near = at_walls[forms.grid.cell_nodes[forms.grid.facet_cells[facets]]].any(axis=(1, 2))
        self.ghost = forms.ghost.on(facets, facets[near])
        """The ghost penalty."""
        self.elastic_shear, self._elastic_shear = None, None  # None in scenes without yielding
        if not forms.elastic:
            self.elastic_shear = matrix(self.unknowns, self.unknowns, 3**d * d)
            self._elastic_shear = forms.ghost.elastic_shear.on(cells)

    @property
    def round_off(self) -> NDArray[np.float64]:
        """Rounding error of the residual in each connected part, in N."""
        return self.of_parts.norms(self.rounding.array_r)

    def forces_of_parts(self, forces: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the norms (k, parts), in N, of k force vectors in each connected part."""
        return self._touched.norms(np.array(forces))

    def set_rounding(self, nodes: NDArray[np.float64]) -> None:
        """Set the rounding errors of the residual at the active local nodes, in N."""
        at = self._forms.active.now.nodes.searchsorted(self.unknowns.owned // self.unknowns.dim)
        self.rounding.array_w[:] = nodes[at]
        self.of_whole.array_w[:] = self.rounding.array_r * np.sqrt(self.of_parts.sizes)[self.of_parts.of]

    @property
    def lines(self) -> tuple[NDArray[np.float64], ...] | None:
        """Grid lines, or None on a grid of equal cells, see `multigrid_solver`."""
        grid = self._forms.grid
        return None if grid.even else grid.lines

    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the grid positions of the unknowns and of the fixed degrees of freedom, see `multigrid_solver`."""
        held = np.setdiff1d(self.touched, self.unknowns.owned)
        node, axis = np.divmod(np.concatenate([self.unknowns.owned, held]), self.unknowns.dim)
        places = self._forms.grid.node_places(node)
        places[:, -1] = places[:, -1] * self.unknowns.dim + axis
        return places[: self.unknowns.size], places[self.unknowns.size :]

    def _penalty_matrix(self, rows: Unknowns, facets: NDArray[np.int32], stiff: bool) -> PETSc.Mat:
        """Return an empty matrix for the penalties."""
        grid = self._forms.grid
        d = grid.dim
        length = 3**d + 2 * d * 3 ** (d - 1)
        if stiff:
            return matrix(rows, self.unknowns, d * length)
        touched = self._forms.active_nodes(grid.facet_cells[facets])
        A = matrix(rows, self.unknowns, np.where(touched[rows.owned // d], length, 1))
        A.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, True)
        return A

    def set_penalty(self, loads: Sequence[Loads]) -> None:
        """Assemble the matrices of penalties and regularisation, which do not depend on u."""
        for penalty in (self.held_penalty, self.penalty):
            zero(penalty)
            for one in loads:
                one.penalty(penalty, penalty is self.held_penalty)
            penalty.assemble()
        if self.elastic_shear is not None:
            zero(self.elastic_shear)
            self._elastic_shear.assemble_matrix(self.elastic_shear)
            self.elastic_shear.assemble()


class MomentumProblem:
    """Balance of momentum of one step.

    `data`: integration points.
    `tolerance`: tolerance of the residual, relative to the forces.
    `goes_on` (unknowns,), in m: displacements extrapolated from the last step, or None.
    `held` (unknowns,), in N: additional forces for equilibrium at the start (`State.held`), or None.
    `yielded`: whether any soil has yielded before this step.
    """

    def __init__(
        self,
        forms: MomentumForms,
        system: MomentumSystem,
        data: QuadratureData,
        loads: Sequence[Loads],
        tolerance: float,
        goes_on: NDArray[np.float64] | None = None,
        held: NDArray[np.float64] | None = None,
        yielded: bool = False,
    ):
        self.forms = forms
        self.system = system
        self.data = data
        self.yielded = yielded
        self.loads = tuple(loads)
        self._goes_on = goes_on
        self._held = held
        self._tolerance = tolerance
        names = "dead", "loads", "resists", "takes_up", "pulls", "push", "inertia", "settle", "augment", "follow"
        self._own = defined(loads, *names)
        with _compat.Timer("loads"):
            external = forms.summed(1, self._own["dead"])[system.touched]
            self._external = external if held is None else external + held[system.touched]

    @property
    def linear(self) -> bool:
        """Whether the tangent depends only on the positions of the points."""
        return self.forms.linear and all(one.linear for one in self.loads)

    @property
    def smooth(self) -> bool:
        """Whether the tangent of one substep may be reused in the next substep."""
        return self.forms.elastic and all(one.smooth for one in self.loads)

    @cached_property
    def at(self) -> At:
        """The present displacements."""
        return At(self.system.unknowns, self.forms.u.x.array, self.system.parts, self._held)

    def settle(self, sticks: bool) -> bool:
        """Update stick and slip in contacts, and return whether any changed.  `sticks` allows slip to become stick."""
        changed = False
        for settle in self._own["settle"]:
            changed |= settle(self.at, sticks)
        return changed

    def augment(self) -> bool:
        """Update multipliers and contact geometry after convergence, and return whether any force changed."""
        changed = False
        for augment in self._own["augment"]:
            changed |= augment(self.at)
        for follow in () if changed else self._own["follow"]:
            changed |= follow(self.at)
        return changed

    def guesses(self) -> list[NDArray[np.float64]]:
        """Return initial guesses of the displacements, in m, for Newton's method.

        Each load may have a guess, such as a rigid rotation.  The motion in the last step gives one more guess.
        """
        found = [one.guess(self.system.parts, self.forms.nodal) for one in self.loads]
        found = [values.ravel() for values in (*found, self._goes_on) if values is not None]
        return [self.freely(values[self.forms.active.now.dofs]) for values in found]

    def freely(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return displacements, in m, with zeros where walls fix them."""
        return np.where(self.system.unknowns.map.indices[self.forms.active.now.dofs] >= 0, values, 0.0)

    def assemble_residual(self) -> tuple[PETSc.Vec, float]:
        """Return the out-of-balance nodal forces at u, and the norm of the force scales, in N."""
        r, scales = self.residual_of_parts()
        return r, float(np.linalg.norm(scales))

    def residual_of_parts(self) -> tuple[PETSc.Vec, NDArray[np.float64]]:
        """Return the out-of-balance nodal forces at u, and the force scales of the connected parts, in N."""
        forms, system = self.forms, self.system
        b, norms = self._unbalanced()
        system.held.gather(b, system.held_residual)  # without penalties; `wall_forces` adds their part on fixed nodes
        if pulls := self._own["pulls"]:
            # penalty forces are not in the scale: at the start of a step they far exceed the other forces
            b[system.touched] -= self.forms.summed(1, pulls)[system.touched]
        r = system.unknowns.gather(b, system.residual)
        step = system.unknowns.gather(forms.nodal.ravel(), system.step)
        system.penalty.multAdd(step, r, r)
        for push in self._own["push"]:
            push(self.at, r, system.unknowns)
        for inertia in self._own["inertia"]:
            r += (forces := inertia(self.at))
            norms.append(system.of_parts.norms(forces.array_r))
        return r, np.maximum.reduce(norms)

    def unbalanced(self) -> NDArray[np.float64]:
        """Return the out-of-balance nodal forces at u without penalties, in N, as a local array."""
        return self._unbalanced()[0].copy()

    def _unbalanced(self) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        """Return the result of `unbalanced`, and the norms of its terms in each connected part, in N."""
        forms, system = self.forms, self.system
        b = forms.internal(self.data, self._own["takes_up"])
        forces, external = b[system.touched], self._external
        terms = [forces]
        if self._own["loads"] or self._own["resists"]:
            rooms = enumerate(("loads", "resists"), start=1)
            loads, own = (forms.summed(room, self._own[name])[system.touched] for room, name in rooms)
            external, forces = external + loads, forces + own
            terms.append(own)
        b[system.touched] = forces - external
        return b, [*system.forces_of_parts([*terms, external])]

    def powers(self) -> dict[str, float]:
        """Return the powers of stresses, viscous resistance, friction and loads at u, in W, on this process."""
        forms, unknowns = self.forms, self.system.unknowns
        v = np.where(unknowns.map.indices >= 0, forms.velocity.nodal, 0.0)  # fixed nodes have no velocity
        owned = forms.u.function_space.dofmap.index_map.size_local * forms.grid.dim
        out = {"internal": forms.internal(self.data)[:owned] @ v[:owned], "viscous": 0.0, "friction": 0.0}
        out["external"] = 0.0
        for one in self.loads:
            acts, resists, taken = np.zeros((3, len(v)))  # contributions to ghost nodes count on this process
            one.dead(acts)
            one.loads(acts)
            one.takes_up(taken)
            one.resists(resists)
            pushed = unknowns.vector()
            one.push(self.at, pushed, unknowns)
            out["external"] += (acts - taken) @ v + one.pulling(self.at, v) - v[unknowns.owned] @ pushed.array_r
            out["viscous"] += resists @ v
            rubs, more = one.rubbing(self.at, v)
            out["friction"] += rubs
            out["external"] += more
        return out

    @cached_property
    def _rounding(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rounding errors at the unknowns, and lower bounds of the force scales in `out_of_balance`, in N."""
        system, parts = self.system, self.system.of_parts
        more = 0.0
        for one in self.loads:
            more = more + one.rounding_at_unknowns
        whole = system.of_whole.array_r + more * np.sqrt(parts.sizes)[parts.of]
        return system.rounding.array_r + more, whole / self._tolerance

    def out_of_balance(
        self, r: PETSc.Vec, scales: NDArray[np.float64], first: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return two relative residuals of each part: one without rounding errors, and one for the convergence test.

        `r`, `scales` (parts,), in N: residuals and force scales.
        `first`: whether this is the first residual of a step, in which rounding errors are not subtracted.
        """
        system, parts = self.system, self.system.of_parts
        both = np.zeros((2, system.unknowns.size))
        size, (rounding, whole) = np.abs(r.array_r), self._rounding
        both[0] = size if first else np.maximum(size - rounding, 0.0)
        least = np.maximum(scales[parts.of], whole)
        np.divide(size, least, out=both[1], where=size > 0)
        counts, full = parts.norms(both)
        full[~(full < np.inf)] = np.inf
        return relative(counts, scales), full

    def wall_forces(self, walls: Mapping[str, str]) -> dict[str, NDArray[np.float64]]:
        """Return the forces of the walls at u, in N, by name.  The residual must have been assembled at this u."""
        system, forces = self.system, self.system.held_residual.copy()
        system.held_penalty.multAdd(system.step, forces, forces)
        for one in self.loads:
            one.push(self.at, forces, system.held)
        dofs, values = [system.held.owned], [forces.array_r]
        for one in self.loads:
            at_walls, counted = one.counted(self.at)
            dofs, values = [*dofs, at_walls], [*values, -counted]
        grid, dofs = self.forms.grid, np.concatenate(dofs)
        shares = self.forms.wall_shares((walls, dofs), partial(wall_shares, grid, walls, dofs))
        out = sum_by(dofs % grid.dim, shares * np.concatenate(values), grid.dim)
        out = out if grid.comm.size == 1 else grid.comm.allreduce(out)
        if grid.has_axis:
            out[0, 0] = 0.0
        return dict(zip(SIDES[grid.dim], out, strict=True))

    def outcome(self) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the reactions and other results of the conditions at u, by quantity and name."""
        out: dict[str, dict[str, NDArray[np.float64]]] = {}
        for one in self.loads:
            for quantity, values in one.outcome(self.at).items():
                out[quantity] = out.get(quantity, {}) | values
        return out

    def of_suction(self, data: QuadratureData | None = None) -> list[tuple[NDArray, NDArray]]:
        """Return the derivatives of nodal forces with respect to cell pressures, see `OfSuction.rows`."""
        return self.forms.of_suction(data or self.data)

    def assemble_tangent(
        self, data: QuadratureData | None = None, shift: NDArray[np.float64] | float = 0.0
    ) -> PETSc.Mat:
        """Return the tangent at u plus the elastic shear stiffness times `shift`.

        `data`: integration points, by default the points of the problem.
        `shift`: one number, or one number for each connected part.
        """
        K = self.system.K
        # the first sum gives K its full sparsity pattern, because PETSc does not always notice a later change
        first = not K.assembled
        zero(K)
        self.forms.assemble_tangent(K, data or self.data)
        for one in self.loads:
            one.tangent(K)
        K.assemble()
        pattern = PETSc.Mat.Structure
        K.axpy(1.0, self.system.penalty, pattern.UNKNOWN if first else pattern.SUBSET_NONZERO_PATTERN)
        if first and self.system.mass is not None:
            zeros = self.system.mass.copy()
            zeros.zeroEntries()
            K.axpy(1.0, zeros, pattern.UNKNOWN)
        for one in self.loads:
            if first and (zeros := one.pattern(self.system.unknowns)) is not None:
                K.axpy(1.0, zeros, pattern.UNKNOWN)
            if (coupling := one.coupling(self.at)) is not None:
                K.axpy(1.0, coupling, pattern.SUBSET_NONZERO_PATTERN)
        shares = shift + np.zeros(self.system.parts.count)
        if (shares == shares[:1]).all():
            if shares.any():
                K.axpy(shares[0], self.system.elastic_shear, pattern.SUBSET_NONZERO_PATTERN)
            return K
        elastic_shear = self.system.elastic_shear.copy()
        elastic_shear.diagonalScale(self.system.unknowns.gather_owned(shares[self.system.of_parts.of]))
        K.axpy(1.0, elastic_shear, pattern.SUBSET_NONZERO_PATTERN)
        return K
