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

from collections.abc import Callable, Mapping, Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.common import Timer
from numpy.typing import NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.conditions.conditions import OnSide
from mpm_dolfinx.contact.tool_contact import ToolContact
from mpm_dolfinx.forms.cell_matrices import Beside, ElementForces, ElementMatrices, StackedElementMatrices
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.forms.unknowns import Unknowns, matrix, sum_ghosts, zero
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.materials.evaluate import by_scene
from mpm_dolfinx.materials.local_unknowns import LocalUnknowns
from mpm_dolfinx.materials.skeleton import Skeleton
from mpm_dolfinx.materials.user_functions import compiling, term_of
from mpm_dolfinx.mechanics.ghost_penalty import GhostPenalty
from mpm_dolfinx.mechanics.mean_dilatation import MeanDilatation
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.mechanics.rigid_motion import rigid_motion
from mpm_dolfinx.mechanics.side_forms import OwnTerm, SideData, SideForms
from mpm_dolfinx.mechanics.walls import wall_forces
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.parts import OfParts, Parts, parts_of_cells, relative


class MomentumForms:
    """The compiled forms of the balance of momentum of a scene.

    Parameters
    ----------
    pieces
        All points of integration.
    laws
        Classes of the skeletons' laws, each with the pieces that follow it and whether these see the mean dilatation of
        their cell, see `MeanDilatation`; they carry F, what the law takes and, with fluid, biot.
    pressure
        DG0 pore pressure, None without fluid.
    gravity : (d,), m/s^2
        Acceleration, a UFL constant; the pieces then carry `density`, kg/m^3, at the start of the step.
    fluid_density : kg/m^3
        Of the pore fluid, which pores that widen take up; None without.
    symmetric
        Whether the tangents of all laws are symmetric.
    at_points
        Whether bodies are integrated at their points.
    terms
        The user's, see `user_functions`.
    t, dt : s
        Time at the end of the substep, and time since the start of the step, UFL constants.
    """

    def __init__(
        self,
        pieces: FormPoints,
        laws: Sequence[tuple[type[Skeleton], FormPoints, bool]],
        pressure: fem.Function | None,
        gravity: fem.Constant | None,
        fluid_density: float | None,
        symmetric: bool,
        at_points: bool,
        terms: Sequence[Callable],
        t: fem.Constant,
        dt: fem.Constant,
    ):
        self.grid = grid = pieces.grid
        V = _compat.function_space(grid.mesh, "Lagrange", 1, (grid.dim,))
        self.u = fem.Function(V)
        """Increment of the displacement since the start of the step, m."""
        self._work = [fem.Function(V) for _ in range(4)]  # internal, own, external forces, and pulls of given sides
        averaged = [number for number, (_, _, locks) in enumerate(laws) if locks]
        self.dilatation = MeanDilatation(grid, averaged, symmetric) if averaged else None
        # a rate is (u - past) / own: of backward Euler past is 0, and own the step
        self._past, self._own = fem.Function(V), fem.Constant(grid.mesh, 1.0)
        self._residuals, self._tangents, self._own_tangents = [], [], []
        self._residuals_of_all: list[PointForm] = []
        self._local: dict[int, LocalUnknowns] = {}  # by the number of their part
        self.terms: list[PointForm] = []
        for number, (law, points, locks) in enumerate(laws):
            self._add_law(number, law, points, locks, pressure, symmetric, by_scene(grid) | {"dt": dt})
        self.sides = SideForms(grid, self.u)
        kept = [self._add_term(term, pieces, t, dt) for term in terms]
        self.symmetric = symmetric and all(potential or not holds for potential, holds, _ in kept)
        self.holding = any(holds for _, holds, _ in kept)
        """Whether terms of the user's depend on u."""
        self.rates = any(rate for _, _, rate in kept)
        """Whether terms of the user's depend on the velocity."""
        self.linear = not averaged and not self.holding and all(law.linear for law, *_ in laws)
        """Whether the tangent changes with the places of the points only."""
        self.elastic = not any(law.state for law, *_ in laws)
        """Whether no law has a history: where soil yields, the tangent of one substep leads the next astray."""
        self.weight = None
        if gravity is not None:
            v = ufl.TestFunction(V)
            pull = ufl.inner(gravity, pieces.value(v))
            self.weight = PointForm(pieces.density * pull * pieces.dx, pieces)
            if fluid_density is not None:
                taken_up = fem.Constant(grid.mesh, fluid_density) * (ufl.det(pieces.increment(self.u)) - 1)
                self._residuals_of_all.append(PointForm(-taken_up * pull * pieces.dx, pieces))
        self.ghost = GhostPenalty(grid, V, at_points)

    def _add_law(
        self,
        number: int,
        law: type[Skeleton],
        points: FormPoints,
        locks: bool,
        pressure: fem.Function | None,
        symmetric: bool,
        given: Mapping[str, fem.Constant],
    ) -> None:
        """Compile residual and tangent of the pieces that follow a law."""
        F = points.deformation(self.u)
        values = {name: getattr(points, name) for name in (*law.parameters, *law.state)} | given
        seen = self.dilatation.seen(points, F) if locks else F
        if law.unknowns:
            self._local[number] = local = LocalUnknowns(law, points, seen, values)
            values, known = values | local.values, values | local.known
        else:
            known = values
        # derived by F and contracted: in 3D a twentieth of the compile time of derivatives by u
        beside = Beside()
        if locks:
            ratio = ufl.det(points.increment(self.u))
            P, A, beside = self.dilatation.add(law, points, F, seen, ratio, values, known)
        else:
            P, A = law.first_piola(F, known), ufl.diff(law.first_piola(F, values), F)
        if pressure is not None:
            of_pressure = -points.biot * pressure * ufl.diff(ufl.det(F), F)
            P, A = P + of_pressure, A + ufl.diff(of_pressure, F)
        share = 1 / ufl.det(points.F)  # divided by it, each component would be
        P, A = share * P, share * A
        self._residuals.append(ElementForces(P * points.F.T, points))
        i, j, k, l, m, n = ufl.indices(6)
        if self.grid.dim == 2:
            A = ufl.as_tensor(A[i, m, j, n] * points.F[k, m] * points.F[l, n], (i, k, j, l))
            beside = beside._replace(along=[T * points.F.T for T in beside.along])
            self._tangents.append(ElementMatrices(A, points, symmetric, beside))
        else:
            self._tangents.append(StackedElementMatrices(A, points, symmetric, beside))

    def _add_term(self, term: Callable, pieces: FormPoints, t: fem.Constant, dt: fem.Constant) -> tuple:
        """Add a term of the user's; return whether it has a potential, depends on u, and on the velocity."""
        V = self.u.function_space
        v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
        velocity = (self.u - self._past) / self._own
        more = {"t": t, "dt": dt, "velocity": velocity}
        function, points = (term.term, self.sides.own_points()) if isinstance(term, OnSide) else (term, pieces)
        form, potential = term_of(function, self.u, v, points=points, u=self.u, v=v, **more)
        holds = self.u in form.coefficients()
        with compiling(f"terms: {line(term)}", "linear in v, or an energy of u"):
            own = PointForm(form, points)
            slope = PointForm(ufl.derivative(form, self.u, du), points) if holds else None
        if points is not pieces:
            self.sides.own.append(OwnTerm(term, points, own, slope))
        else:
            self.terms.append(own)
            self._own_tangents.extend([slope] * holds)
        return potential, holds, self._past in form.coefficients()

    def set_rate(self, own: float, past: float) -> None:
        """Set the rate at the end of a substep: time in which it counts, s, and share of the present u before it."""
        self._own.value = own
        if self.rates:
            self._past.x.array[:] = past * self.u.x.array

    def external(self, data: QuadratureData, sides: SideData) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the nodal forces of dead loads, weight and tilted plates, and of given displacements, local arrays."""
        _, _, external, pulls = self._work
        external.x.array[:] = pulls.x.array[:] = 0.0
        if sides.loads is not None:
            self.sides.traction.assemble_vector(external.x.array, sides.loads)
        if self.weight is not None:
            self.weight.assemble_vector(external.x.array, data.pieces)
        if sides.plates is not None:
            self.sides.tilt.assemble_vector(external.x.array, sides.plates)
        if sides.holds is not None:
            self.sides.pull.assemble_vector(pulls.x.array, sides.holds)
        return sum_ghosts(external), sum_ghosts(pulls)

    def pressures(self, sides: SideData) -> NDArray[np.float64]:
        """Return the nodal forces of pressures at u, a local array."""
        forces = self.sides.forces
        forces.x.array[:] = 0.0
        self.sides.pressed.assemble_vector(forces.x.array, sides.pressures)
        return sum_ghosts(forces)

    def pushed(self, contact: ToolContact) -> NDArray[np.float64]:
        """Return the nodal forces of tools at u, a local array."""
        sides, places = self.sides, contact.places
        sides.forces.x.array[:] = 0.0
        force = contact.at(self.nodal).force
        sides.traction.assemble_vector(
            sides.forces.x.array, PointData(sides.loads, places, np.ones(len(force)), {"force": force})
        )
        return sum_ghosts(sides.forces)

    @property
    def nodal(self) -> NDArray[np.float64]:
        """u by nodes (nodes, d), m."""
        return self.u.x.array.reshape(-1, self.grid.dim)

    def internal(self, data: QuadratureData) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the nodal forces of the stresses, and of the user's terms, at u, local arrays."""
        internal, own, _, _ = self._work
        internal.x.array[:] = own.x.array[:] = 0.0
        if self.dilatation is not None:
            self.dilatation.set_ratios(data)
        for number, local in self._local.items():
            local.update(data.parts[number], derive=False)
        if self.dilatation is not None:
            self.dilatation.set_stresses(data)
        for residual, part in zip(self._residuals, data.parts, strict=True):
            residual.assemble_vector(internal.x.array, part)
        for residual in self._residuals_of_all:
            residual.assemble_vector(internal.x.array, data.pieces)
        for term in self.terms:
            term.assemble_vector(own.x.array, data.pieces)
        return sum_ghosts(internal), sum_ghosts(own) if self.terms else own.x.array

    def assemble_tangent(self, K: PETSc.Mat, data: QuadratureData, sides: SideData) -> None:
        """Add the tangent at u to K, which the caller finalises."""
        for number, local in self._local.items():
            local.derive(data.parts[number])
        sums = [tangent.assemble_matrix(K, part) for tangent, part in zip(self._tangents, data.parts, strict=True)]
        for tangent in self._own_tangents:
            tangent.assemble_matrix(K, data.pieces)
        if self.dilatation is not None:
            self.dilatation.assemble_matrix(K, data, sums)
        if sides.pressures is not None:
            self.sides.pressed_slope.assemble_matrix(K, sides.pressures)
        self.sides.assemble_own(K, sides)
        if sides.tools is not None:
            places, slope = sides.tools.places, sides.tools.at(self.nodal).slope
            of_rows = PointData(self.sides.slopes, places, np.ones(len(slope)), {"slope": slope})
            self.sides.pushed_slope.assemble_matrix(K, of_rows)
            sides.tools.assemble_matrix(K, self.nodal)

    def at_nodes(self, cells: NDArray[np.int32], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (nodes,) at the local nodes of what owned cells, of all processes, have (cells,)."""
        shared, nodes = self._work[0], self.grid.cell_nodes[cells]
        sums = sum_by(nodes.ravel(), np.repeat(values, nodes.shape[1]), len(self.grid.node_x))
        shared.x.array[:] = np.repeat(sums, self.grid.dim)
        sum_ghosts(shared)
        shared.x.scatter_forward()
        return shared.x.array[:: self.grid.dim].copy()

    def parts(self, active: NDArray[np.bool_]) -> Parts:
        """Return the parts of the bodies in active cells (cells,).

        Groups press on one another through their contacts: they are one part.
        """
        of, count = parts_of_cells(self.grid, active)
        if self.grid.copies > 1:
            of, count = active.astype(np.int64), 1
        own = np.flatnonzero(active[: self.grid.num_owned])
        total, cells = (self.at_nodes(own, values) for values in (of[own].astype(float), np.ones(len(own))))
        nodes = np.divide(total, cells, out=np.zeros(len(cells)), where=cells > 0)
        return Parts(count, of - 1, np.rint(nodes).astype(np.int64) - 1)

    def active_nodes(self, cells: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return which nodes belong to some active cells of any process."""
        nodes = np.zeros(len(self.grid.node_x), dtype=bool)
        nodes[self.grid.cell_nodes[cells]] = True
        if self.grid.comm.size == 1:
            return nodes
        shared = self._work[0]
        shared.x.array[:] = np.repeat(nodes, self.grid.dim)
        _compat.scatter_reverse_add(shared)
        shared.x.scatter_forward()
        return shared.x.array[:: self.grid.dim] > 0


class MomentumSystem:
    """Vectors and matrices of the displacements of one active set, complete when made.

    Parameters
    ----------
    forms
        The forms.
    dofs
        Unrolled local degrees of freedom, ghosts included, that are unknowns.
    nodes
        Active local nodes, ghosts included.
    cells
        Active cells of this process.
    facets
        Faces of this process that carry the ghost penalty.
    stiff
        Whether sides have plates or given displacements.
    parts
        Parts of the bodies.
    """

    def __init__(
        self,
        forms: MomentumForms,
        dofs: NDArray[np.int64],
        nodes: NDArray[np.int64],
        cells: NDArray[np.int32],
        facets: NDArray[np.int32],
        stiff: bool,
        parts: Parts,
    ):
        self._forms, d = forms, forms.grid.dim
        self.unknowns = Unknowns(forms.u, dofs)
        self.locks = forms.dilatation is not None
        """Whether laws yield or hardly change their volume."""
        owned = nodes[nodes < forms.u.function_space.dofmap.index_map.size_local]
        self.touched = (owned[:, None] * d + np.arange(d)).ravel()
        """Where forces may act, held by walls or not."""
        self.parts, comm = parts, forms.grid.comm
        self.of_parts, self._touched = (
            OfParts(comm, parts.nodes[at // d], parts.count) for at in (self.unknowns.owned, self.touched)
        )
        """Parts of the unknowns."""
        self.rounding = self.unknowns.vector()
        """What rounding may leave of the residual at each unknown, N."""
        self.K = matrix(self.unknowns, self.unknowns, 3**d * d)
        self.residual, self.step = self.unknowns.vector(), self.unknowns.vector()
        every = (nodes[:, None] * d + np.arange(d)).ravel()
        self.held = Unknowns(forms.u, np.setdiff1d(every, dofs))
        """What walls hold."""
        self.held_residual = self.held.vector()
        self.penalty, self.held_penalty = (self._penalty_matrix(of, facets, stiff) for of in (self.unknowns, self.held))
        at_walls = np.zeros(len(forms.grid.node_x), dtype=bool)
        at_walls[self.held.map.indices.reshape(-1, d).max(axis=1, initial=-1) >= 0] = True
        near = at_walls[forms.grid.cell_nodes[forms.grid.facet_cells[facets]]].any(axis=(1, 2))
        self._ghosts = [forms.ghost.form.on(some) for some in (facets[near], facets)]
        self.firm, self._firmness = None, None  # where nothing yields
        if not forms.elastic:
            self.firm, self._firmness = matrix(self.unknowns, self.unknowns, 3**d * d), forms.ghost.firmness.on(cells)

    @property
    def local_parts(self) -> NDArray[np.int64]:
        """Parts (n,) of the degrees of freedom of this process, ghosts included, -1 where nothing is."""
        return np.repeat(self.parts.nodes, self.unknowns.dim)

    @property
    def round_off(self) -> NDArray[np.float64]:
        """What rounding may leave of the residual of each part (parts,), N."""
        return self.of_parts.norms(self.rounding.array_r)

    def force_of_parts(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the norms (parts,), N, of forces where these may act, see `touched`."""
        return self._touched.norms(forces)

    def set_rounding(self, nodes: NDArray[np.float64]) -> None:
        """Set what rounding may leave of the residual at the local nodes, N."""
        self.rounding.array_w[:] = nodes[self.unknowns.owned // self.unknowns.dim]

    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return where on the grid this process's unknowns are, and what walls hold: see `multigrid_solver`."""
        held = np.setdiff1d(self.touched, self.unknowns.owned)
        node, axis = np.divmod(np.concatenate([self.unknowns.owned, held]), self.unknowns.dim)
        places = self._forms.grid.node_places(node)
        places[:, -1] = places[:, -1] * self.unknowns.dim + axis
        return places[: self.unknowns.size], places[self.unknowns.size :]

    def _penalty_matrix(self, rows: Unknowns, facets: NDArray[np.int32], stiff: bool) -> PETSc.Mat:
        """Return an empty matrix for the penalties: the ghost penalty couples like components, of two cells."""
        grid = self._forms.grid
        d = grid.dim
        length = 3**d + 2 * d * 3 ** (d - 1)
        if stiff:
            return matrix(rows, self.unknowns, d * length)
        touched = self._forms.active_nodes(grid.facet_cells[facets])
        A = matrix(rows, self.unknowns, np.where(touched[rows.owned // d], length, 1))
        A.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, True)
        return A

    def set_penalty(self, sides: SideData) -> None:
        """Assemble what is linear in the step's increment, ghost penalty, plates, given displacements, and firmness."""
        for penalty, ghost in zip((self.held_penalty, self.penalty), self._ghosts, strict=True):
            zero(penalty)
            ghost.assemble_matrix(penalty)
            if sides.plates is not None:
                self._forms.sides.plate.assemble_matrix(penalty, sides.plates)
            if sides.holds is not None and penalty is self.penalty:
                self._forms.sides.hold.assemble_matrix(penalty, sides.holds)
            penalty.assemble()
        if self.firm is not None:
            zero(self.firm)
            self._firmness.assemble_matrix(self.firm)
            self.firm.assemble()


class MomentumProblem:
    """The balance of momentum of one step.

    Parameters
    ----------
    forms, system
        Compiled forms; vectors and matrices, with the penalties in them.
    data
        The pieces.
    sides
        What acts on the sides of the bodies.
    tolerance
        Share of the forces to which they are balanced.
    goes_on : (unknowns,)
        Displacements if the bodies moved on as they did before, a local array, m; None where that is not known.
    held : (unknowns,)
        Forces that hold what is out of balance of an initial stress, a local array, N, if there are any.
    yielded
        Whether any soil has yielded before.
    """

    def __init__(
        self,
        forms: MomentumForms,
        system: MomentumSystem,
        data: QuadratureData,
        sides: SideData,
        tolerance: float,
        goes_on: NDArray[np.float64] | None = None,
        held: NDArray[np.float64] | None = None,
        yielded: bool = False,
    ):
        self.forms, self.system, self.data = forms, system, data
        self.yielded = yielded
        self._sides, self._goes_on, self._tolerance = sides, goes_on, tolerance
        with Timer("mpm: loads"):
            external, pulls = forms.external(data, sides)
            if held is not None:
                external += held
            self._external, self._pulls = external[system.touched], pulls[system.touched]

    @property
    def linear(self) -> bool:
        """Whether the tangent changes with the places of the points only."""
        sides = self._sides
        return self.forms.linear and sides.pressures is None and sides.tools is None and sides.contact is None

    @property
    def smooth(self) -> bool:
        """Whether the tangent of one substep may lead the next."""
        return self.forms.elastic and self._sides.tools is None and self._sides.contact is None

    def settle_tools(self, sticks: bool) -> bool:
        """Choose what slips on tools at u, and if asked for what sticks again; return whether it is another choice."""
        tools, contact = self._sides.tools, self._sides.contact
        of_tools = tools is not None and tools.settle(self.forms.nodal, sticks)
        return (contact is not None and contact.now.settle(*self._at, sticks)) or of_tools

    @property
    def _at(self) -> tuple[Unknowns, NDArray[np.float64]]:
        return self.system.unknowns, self.forms.u.x.array

    def augment_tools(self, forces: NDArray[np.float64]) -> bool:
        """Shift the pressures of tools that penetrate too deep; return whether the balance is another one since.

        forces (parts,): what residuals are measured by, N.
        """
        tools, contact = self._sides.tools, self._sides.contact
        of_tools = tools is not None and tools.augment(self.forms.nodal, self._unknown_of_tools(forces))
        return (contact is not None and contact.now.augment(*self._at)) or of_tools

    def _unknown_of_tools(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how well the balance tells the forces of tools (tools,), N: by the parts that they may touch."""
        system, tools = self.system, self._sides.tools
        of_parts = system.round_off + self._tolerance * forces
        unknown = np.zeros(len(tools.contacts))
        np.maximum.at(unknown, tools.rows.number, of_parts[system.parts.cells[tools.rows.cell]])
        return over_all(self.forms.grid.comm, unknown, MPI.MAX)

    def follow_contacts(self) -> bool:
        """Find anew which places of groups face one another at u; return whether the balance is another one since."""
        return self._sides.contact is not None and self._sides.contact.follow(*self._at)

    def guesses(self) -> list[NDArray[np.float64]]:
        """Return displacements (local unknowns,), m, at which Newton's method may begin.

        Those of a turn, if given displacements turn the bodies as one, and those of bodies that move on as before.
        """
        found = [values for values in (self._turned(), self._goes_on) if values is not None]
        return [np.where(self.system.unknowns.map.indices >= 0, values, 0.0) for values in found]

    def _turned(self) -> NDArray[np.float64] | None:
        """Return u with the rigid motions of the parts that given displacements turn; None where they turn none."""
        forms, holds, parts = self.forms, self._sides.holds, self.system.parts
        if holds is None or forms.grid.axisymmetric:
            return None
        of, moved = parts.cells[holds.cells], None
        for part in np.flatnonzero(over_all(forms.grid.comm, sum_by(of, np.ones(len(of)), parts.count))):
            motion = rigid_motion(forms.grid.comm, holds, forms.grid.node_x, of == part)
            if motion is not None:
                moved = forms.nodal.copy() if moved is None else moved
                moved[parts.nodes == part] = motion[parts.nodes == part]
        return None if moved is None else moved.ravel()

    def assemble_residual(self) -> tuple[PETSc.Vec, float]:
        """Return the out-of-balance nodal forces at u and their scale, the largest of internal, external, terms (N)."""
        r, scales = self.residual_of_parts()
        return r, float(np.linalg.norm(scales))

    def residual_of_parts(self) -> tuple[PETSc.Vec, NDArray[np.float64]]:
        """Return the out-of-balance nodal forces at u and the scales (parts,), N, of each part: see above."""
        forms, system = self.forms, self.system
        b, own = forms.internal(self.data)
        forces, external = b[system.touched], self._external
        if self._sides.pressures is not None:
            external = external + forms.pressures(self._sides)[system.touched]
        norms = [system.force_of_parts(forces), system.force_of_parts(external)]
        if forms.terms or forms.sides.own:
            own = own[system.touched]
            if forms.sides.own:
                own = own + forms.sides.own_forces(self._sides)[system.touched]
            norms.append(system.force_of_parts(own))
            forces += own
        b[system.touched] = forces - external
        if self._sides.tools is not None:
            b[system.touched] -= forms.pushed(self._sides.tools)[system.touched]
        system.held.gather(b, system.held_residual)  # walls bear what sides beside them would push them by
        if self._sides.holds is not None:  # no measure of forces: at the start of a step it is far above them
            b[system.touched] -= self._pulls
        r = system.unknowns.gather(b, system.residual)
        step = system.unknowns.gather(forms.u.x.array, system.step)
        system.penalty.multAdd(step, r, r)
        if self._sides.contact is not None:
            self._sides.contact.now.push(*self._at, r)
        return r, np.max(norms, axis=0)

    def out_of_balance(
        self, r: PETSc.Vec, scales: NDArray[np.float64], first: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return residuals r (N) of the parts, relative to scales (parts,), N: what counts of them, and as they are.

        What rounding may leave at a node does not count, but at first: a tiny load drowns in it, which is no reason not
        to solve for it once.  The other ones are relative to no less than what makes this the tolerance.
        """
        system, parts = self.system, self.system.of_parts
        size, rounding = np.abs(r.array_r), system.rounding.array_r
        counts = relative(parts.norms(size if first else np.maximum(size - rounding, 0.0)), scales)
        least = rounding * np.sqrt(parts.sizes)[parts.of] / self._tolerance
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            told = parts.norms(np.where(size > 0, size / np.maximum(scales[parts.of], least), 0.0))
        return counts, relative(told, np.ones(parts.count))

    def wall_forces(self, walls: Mapping[str, str]) -> NDArray[np.float64]:
        """Return the forces (2 d, d), N, of the walls at u, where the residual was last assembled."""
        system, forces = self.system, self.system.held_residual.copy()
        system.held_penalty.multAdd(system.step, forces, forces)
        if self._sides.contact is not None:
            self._sides.contact.now.push_on(system.held, *self._at, forces)
        dofs, forces = system.held.owned, forces.array_r
        if self._sides.holds is not None:  # what given sides count of their own
            pulled, own = self._sides.pulled(self.forms.nodal)
            dofs, forces = np.concatenate([dofs, pulled]), np.concatenate([forces, -own])
        return wall_forces(self.forms.grid, walls, dofs, forces)

    def assemble_tangent(
        self, data: QuadratureData | None = None, firmness: NDArray[np.float64] | float = 0.0
    ) -> PETSc.Mat:
        """Return the tangent at u, of these pieces or of others, with a share of the elastic shear stiffness.

        firmness: the share, one number or one for each part.
        """
        K = self.system.K
        # the first sums give K the pattern of all: PETSc does not always see that it changes later
        first = not K.assembled
        zero(K)
        self.forms.assemble_tangent(K, data or self.data, self._sides)
        K.assemble()
        pattern = PETSc.Mat.Structure
        K.axpy(1.0, self.system.penalty, pattern.UNKNOWN if first else pattern.SUBSET_NONZERO_PATTERN)
        if self._sides.contact is not None:
            if first:
                K.axpy(1.0, self._sides.contact.now.pattern(self.system.unknowns), pattern.UNKNOWN)
            K.axpy(1.0, self._sides.contact.now.tangent(*self._at), pattern.SUBSET_NONZERO_PATTERN)
        shares = np.broadcast_to(firmness, self.system.parts.count)
        if (shares == shares[:1]).all():
            if shares.any():
                K.axpy(shares[0], self.system.firm, pattern.SUBSET_NONZERO_PATTERN)
            return K
        firm = self.system.firm.copy()
        firm.diagonalScale(self.system.unknowns.gather_owned(shares[self.system.of_parts.of]))
        K.axpy(1.0, firm, pattern.SUBSET_NONZERO_PATTERN)
        return K
