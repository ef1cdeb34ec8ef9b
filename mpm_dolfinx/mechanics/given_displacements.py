# SPDX-License-Identifier: MIT
"""Given displacements of sides: multipliers hold the means in the cells, see `held_cells`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import scipy.sparse
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.time_integration import in_step
from mpm_dolfinx.base.tolerances import EPSILON, NEAR
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.faces import Surface, face_vectors
from mpm_dolfinx.conditions.acting import Acting, At, Loads, Place, Setting, Unmet
from mpm_dolfinx.conditions.conditions import Displacement, holding, resistance
from mpm_dolfinx.conditions.sides import check_apart, everywhere, meeting
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.forms.unknowns import Unknowns, petsc_matrix
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.mechanics.held_cells import HeldCells, HeldPoints, Jumps
from mpm_dolfinx.mechanics.rigid_motion import rigid_motion, turned
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all
from mpm_dolfinx.parallel.messages import ConditionWarning, warn
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.origin import Origin
from mpm_dolfinx.points.parts import Parts


def traction_name(name: str) -> str:
    """Return the name under which points keep the traction (n, d), Pa, of a given displacement."""
    return f"{name}_traction"


class HoldForms:
    """Means over points, with a given displacement along a direction; what holds it, and pulls to it."""

    def __init__(self, grid: Grid, u: fem.Function):
        d = grid.dim
        moments = {"squares": (d, d), **({"product": ()} if d == 3 else {})}
        self.points = h = FormPoints(grid, stiffness=(), direction=(d,), gap=(), **moments)
        v, du = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)

        def along(w):
            """Return the mean of a Q1 field, along the direction, by the moments of the places it is over."""
            second = ufl.grad(ufl.grad(w))
            i, j, k = ufl.indices(3)
            mean = w + ufl.dot(ufl.grad(w), h.offset) + ufl.as_vector(second[i, j, k] * h.squares[j, k], i) / 2
            if d == 3:  # of third derivatives of a trilinear function one is not zero
                mean += ufl.grad(second)[:, 0, 1, 2] * h.product
            return ufl.dot(mean, h.direction)

        self.hold = PointForm(h.stiffness * along(du) * along(v) * h.dx, h)
        self.pull = PointForm(h.stiffness * h.gap * along(v) * h.dx, h)


class GivenDisplacements(Acting):
    """The given displacements of a stage.

    Parameters
    ----------
    setting, displacements
        Where they are put, and the displacements by name.

    Raises
    ------
    ValueError
        Two give the same component on the same part of a face.
    """

    conditions, title = (Displacement,), "given displacements"

    def __init__(self, setting: Setting, displacements: Mapping[str, Displacement]):
        self._grid = setting.grid
        self._forms = setting.forms
        self._materials = setting.materials
        self._free, self._names = setting.free, list(displacements)
        self._meeting: list[tuple[Displacement, Displacement, list[int], NDArray[np.float64]]] = []
        self._warned: set[int] = set()  # numbers of the conditions, of which nothing but the log knows
        sides, d = setting.sides, self._grid.dim
        whole = [(hold, sides.of(hold), hold.axes(d)) for hold in displacements.values()]
        for (one, faces, axes), (other, others, more) in combinations(whole, 2):
            if common := sorted(set(axes) & set(more)):
                check_apart(one, faces, other, others)
                self._meeting.append((one, other, common, meeting(sides.bodies, faces, others)))
        self._holds = self.held = held_faces(setting)
        for hold in displacements.values():
            if not callable(hold.value):  # what a function gives is checked when it is called
                hold.at(0.0, np.empty((1, d)))

    @property
    def surfaces(self) -> list[Surface]:
        """The faces that are held."""
        return [faces for _, faces, _ in self._holds]

    def placed(self, place: Place) -> Loads:
        """Return what holds them, a row a component, by cells and points."""
        d, comm = self._grid.dim, self._grid.comm
        self._check_meeting(place.t)
        ends = (place.start, place.start + place.dt) if place.dt > 0 else ()  # without: held where they count from
        points, origin = self._held_points(place.cut, place.points, place.t, ends, place.inertia)
        held = HeldCells(self._grid, points)
        placed, message = [], ""
        for axis in range(d):
            given = np.array([axis in axes for *_, axes in self._holds])
            *rows, wrong = held.rows(axis, given, self._free[:, axis])
            kind = np.full(len(rows[0]), axis * len(self._holds))
            placed.append((*rows, np.tile(np.eye(d)[axis], (len(rows[0]), 1)), kind))
            if wrong >= 0:
                hold, x = self._holds[held.number[wrong]][0], held.x[wrong] + self._grid.base
                what = f"{line(hold)}: moves {'xyz'[axis]} at {x}"
                message = f"{what}, where a wall holds it; must be 0 there, or the wall must leave it free"
        if message := first(comm, message):
            raise ValueError(message)
        row, stiffness, gap, traction, own, direction, kind = map(np.concatenate, zip(*placed, strict=True))
        multipliers = Multipliers(self._grid, held, row, kind + held.number[row])
        fields = {name: values[row] for name, values in held.moments.items()}
        fields |= {"stiffness": stiffness, "gap": gap, "direction": direction}
        forms = self._forms(HoldForms)
        data = forms.points.at(held.cell[row], held.x[row], np.ones(len(row)), **fields)
        traction = traction[multipliers.rows]
        more = multipliers, origin, 0 * traction, traction, place.dt > 0
        return HoldLoads(self, forms, data, held, row, own, *more)

    def _held_points(
        self, cut: CutDomains, points: MaterialPoints, t: float, ends: Sequence[float], inertia: bool
    ) -> tuple[HeldPoints, Origin]:
        """Return the points of integration on held sides, at the owners of their cells, and where they come from.

        ends: start and end of the step, s; none for sides at rest; inertia: whether velocities count.
        """
        d, rows = self._grid.dim, []
        patches = cut.surfaces([faces for _, faces, _ in self._holds])
        chosen = np.unique(np.concatenate([p.at for p in patches]))
        cut_points = cut.points if ends else points  # which are where they were cut
        now, before = (of.map(lambda values: values[chosen]) for of in (points, cut_points))
        stress = self._materials.total_stress(now)
        modulus, resists = (self._materials.table(before, of) for of in (holding, resistance))
        # of when the grid was reset, as the stiffnesses: they stay as long as the cut serves
        tension = np.linalg.norm(stress if points is cut_points else self._materials.total_stress(before), axis=(1, 2))
        for number, ((hold, *_, axes), p) in enumerate(zip(self._holds, patches, strict=True)):
            at, now = np.searchsorted(chosen, p.at), p.now(points)
            given = [self._given(hold, time, p.X) for time in (t, *ends)] if ends else 3 * [np.zeros_like(now)]
            if inertia and ends and t < ends[1]:
                given[0] = in_step((t - ends[0]) / (ends[1] - ends[0]), given[1], given[0], given[2])
            to, given = p.origin(points) + given[0], np.concatenate(given[1:], axis=1)
            R = turned(self._grid.comm, p.area0, now, to) if len(axes) == d else np.eye(d)  # as what it carries does
            force, gap = np.einsum("ij,njk,nk->ni", R, stress[at, :d, :d], p.area(points)), to - now
            before = points.data[traction_name(self._names[number])][p.at] @ R.T
            own = (p.area0 * v for v in (1, modulus[at], tension[at], resists[at]))
            each = np.stack([np.full(len(gap), number), *own], axis=1)
            rows.append((p.cell, p.x, np.concatenate([each, gap, given, p.area(cut.points), force, before], axis=1)))
        number = np.repeat(np.arange(len(patches)), [len(p.at) for p in patches])
        point, area = (np.concatenate([getattr(p, name) for p in patches]) for name in ("at", "area0"))
        where, x, values = (np.concatenate(column) for column in zip(*rows, strict=True))
        origin = Origin(Exchange(self._grid.comm, self._grid.owner(where)), point, number, area)
        where, x, values = map(origin.travel.send, (where, x, values))
        number, *own = values[:, :5].T
        own = (*own, x, *np.split(values[:, 5:], [d, 3 * d, 4 * d, 5 * d], axis=1))
        return HeldPoints(number.astype(np.int64), self._grid.local(where), *own), origin

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return what n points keep of each: tractions (n, d), Pa, zero."""
        return {name: {traction_name(name): np.zeros((n, self._grid.dim))} for name in self._names}

    def gripped(self, loads: HoldLoads, points: MaterialPoints) -> MaterialPoints:
        """Return the points with their tractions."""
        traction = np.zeros((len(loads.held.area), self._grid.dim))
        traction[loads.firm] = loads.traction
        means = loads.origin.means(len(points), len(self._names), traction[loads.held.of])
        new = {traction_name(name): values for name, values in zip(self._names, means, strict=True)}
        return replace(points, data={**points.data, **new})

    def _check_meeting(self, t: float) -> None:
        """Refuse given displacements that differ where they meet: no body's stress is finite there."""
        for one, other, axes, X in self._meeting:
            jump = np.abs(self._given(one, t, X) - self._given(other, t, X))[:, axes].max(axis=1)
            if jump.max(initial=0.0) > NEAR * self._grid.h.min():
                what = f"{line(one)} and {line(other)}: differ by {jump.max():.3g} m at t = {t:g} s where they meet"
                raise ValueError(f"{what}, at {X[jump.argmax()]}; must agree there, or leave two cells between them")

    def _given(self, hold: Displacement, t: float, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, that a side is given at places X (m, d) of this process."""
        return everywhere(self._grid, lambda: hold.at(t, X))

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return reactions of this value."""
        return {"reactions": {name: np.full(self._grid.dim, value) for name in self._names}}

    def reactions(self, loads: HoldLoads, at: At) -> dict[str, NDArray[np.float64]]:
        """Return the forces (d,), N, by which each of them acts on the bodies at u."""
        held = loads.held
        data = loads.data
        force = loads.pull(at.nodal)
        self._warn(held, loads.row, data["direction"].argmax(axis=1), force - loads.carried)
        number, force = held.number[loads.row], (loads.share.sum(axis=1) * force)[:, None] * data["direction"]
        sums = np.stack([sum_by(number, column, len(self._holds)) for column in force.T], axis=1)
        return dict(zip(self._names, self._grid.comm.allreduce(sums), strict=True))

    def _warn(
        self, held: HeldCells, row: NDArray[np.int64], axis: NDArray[np.int64], force: NDArray[np.float64]
    ) -> None:
        """Warn, once a condition, of forces that no change of the body's stress balances."""
        for number, x in held.beyond(row, axis, force, self._warned):
            why = "its reaction is an artefact; does something else hold it, or is the step too large?"
            what = "%s: not where it is to be at %s: %s"
            warn(self._grid.comm, ConditionWarning, what, line(self._holds[number][0]), x + self._grid.base, why)
            self._warned.add(number)

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return new corners (m, 2^d, d), m, of domains: prisms of their volume (m,) under faces that are held.

        In axisymmetry the volume is the area in the plane.
        A held face stays where its tracked corners are: put elsewhere it would be pulled back, all at once.
        """
        index = np.arange(2**self._grid.dim)
        for _, faces, _ in self._holds:
            held = np.flatnonzero(np.isin(ids, faces.id))
            number = faces.face[np.searchsorted(faces.id, ids[held])]  # of a domain with two held faces the first
            axis, end = (k[:, None] for k in np.divmod(number, 2))
            outward = face_vectors(tracked[held], number)
            depth = volume[held, None] * outward / (outward**2).sum(axis=1, keepdims=True)
            face = index ^ ((index >> axis & 1 ^ end) << axis)  # of each corner: that on the face
            there = np.take_along_axis(tracked[held], face[:, :, None], axis=1)
            corners[held] = there - np.where((face != index)[:, :, None], depth[:, None], 0.0)
        return corners


class Multipliers:
    """What tractions of means do to the gaps.

    Parameters
    ----------
    grid, held
        Where they are.
    row, kind : (m,)
        Which of it each component is, and its condition and axis, in one number: see `Jumps`.

    Attributes
    ----------
    rows, area, stiffness : (k,)
        Those of the components that are means; area, m^(d-1), and stiffness in the tangent, Pa/m.
    """

    def __init__(self, grid: Grid, held: HeldCells, row: NDArray[np.int64], kind: NDArray[np.int64]):
        self.rows = np.flatnonzero(row < len(held.area))
        of = row[self.rows]
        self.area = held.area[of]
        self.stiffness = held.firm[of]
        self._compliance = held.compliance[of]
        self._jumps = Jumps(grid, kind[self.rows], held.cell[of])

    def jumps(self, traction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return J of tractions, m."""
        return self._compliance * self._jumps(traction)


class Tractions(NamedTuple):
    """Tractions (k,), Pa: those at present, and before a Newton step; and its change."""

    present: NDArray[np.float64]
    before: NDArray[np.float64]
    change: NDArray[np.float64]


class HoldLoads(Loads):
    """Given displacements in a substep.

    Parameters
    ----------
    acting
        The conditions.
    forms, data
        Components that are given, with stiffness, direction and gap.
    held
        What holds them.
    row : (m,)
        Which of it each component is.
    share : (m, 2^d)
        Of its force on each node, but for what walls bear.
    multipliers, origin
        Of the components; where their points come from.
    reference, traction : (k,), Pa
        Of the multipliers, beyond what the body's stress bears: at rest, and as iterations begin.
    multiplies
        Whether tractions are found; else what holds gives way.
    """

    stiff = True

    def __init__(
        self,
        acting: GivenDisplacements,
        forms: HoldForms,
        data: PointData,
        held: HeldCells,
        row: NDArray[np.int64],
        share: NDArray[np.float64],
        multipliers: Multipliers,
        origin: Origin,
        reference: NDArray[np.float64],
        traction: NDArray[np.float64],
        multiplies: bool,
    ):
        self._acting = acting
        self._forms = forms
        self.data = data
        self.held = held
        self.row = row
        self.share = share
        self._of = multipliers
        self.origin = origin
        self._reference = reference
        self._begun = self._now = Tractions(traction, traction, np.zeros_like(traction))
        self._operator: Latest[PETSc.Mat] = Latest()
        self.multiplies = multiplies
        self._d = data.points.grid.dim
        self.key = self._d * row + data["direction"].argmax(axis=1)
        self.under_held = acting.under_held

    def pulls(self, b: NDArray[np.float64]) -> None:
        """Add the forces towards the given displacements."""
        self._forms.pull.assemble_vector(b, self.data)

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the stiffness that holds them; what they count at walls is in `counted`."""
        if not walls:
            self._forms.hold.assemble_matrix(A, self.data)

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Take the forces of the tractions off; walls bear none of them: see `counted`."""
        if on is at.unknowns:
            self._add(residual, on, -self._of.area * self._held())

    def _held(self) -> NDArray[np.float64]:
        """Return the tractions (k,), Pa, that act where gaps are zero."""
        return self.traction - self._of.stiffness * self._of.jumps(self.traction - self._reference)

    def _add(self, out: PETSc.Vec, unknowns: Unknowns, force: NDArray[np.float64]) -> None:
        """Add forces (k,), N, of the means to those of the nodes."""
        B = self._means(unknowns)
        B.multTransposeAdd(self._vector(B, force), out, out)

    def _vector(self, B: PETSc.Mat, values: NDArray[np.float64]) -> PETSc.Vec:
        """Return a vector of the means."""
        out = B.createVecLeft()
        out.array_w[:] = values
        return out

    def _means(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return the matrix that makes the means (k,) of the unknowns."""
        rows = self._of.rows

        def make() -> PETSc.Mat:
            column = unknowns.map.indices[self._dofs[rows]]
            free = column >= 0
            row = np.broadcast_to(np.arange(len(rows))[:, None], column.shape)
            entries = (self.held.shape[self.row[rows]][free], (row[free], column[free]))
            shape = (len(rows), max(1, unknowns.global_size))
            return petsc_matrix(scipy.sparse.csr_matrix(entries, shape=shape), unknowns.size, unknowns.comm)

        return self._operator(unknowns, make, unknowns.comm)

    @cached_property
    def _dofs(self) -> NDArray[np.int64]:
        """Unrolled local degrees of freedom (m, 2^d) of the rows."""
        axis = self.data["direction"].argmax(axis=1)
        return self._d * self.data.points.grid.cell_nodes[self.data.cells] + axis[:, None]

    def unmet(self, at: At) -> Unmet:
        """Return the forces by which the means are to change at u."""
        rows = self._of.rows
        stiffness = self.data["stiffness"][rows, 0]
        off = stiffness * (self.data["gap"][:, 0] - self._along(at.nodal))[rows]
        off -= self._of.area * (self.traction - self._held())
        unknown = 4 * EPSILON * self.data.points.grid.reach * stiffness
        return Unmet(off, unknown, self.data.cells[rows].astype(np.int64))

    def drive(self, at: At, x: NDArray[np.float64], out: PETSc.Vec) -> None:
        """Add the forces on the nodes by which a change x of the forces, N, would drive the bodies."""
        self._add(out, at.unknowns, x - self._of.stiffness * self._of.area * self._of.jumps(x / self._of.area))

    def response(self, at: At, x: NDArray[np.float64], v: PETSc.Vec) -> NDArray[np.float64]:
        """Return by how much less (k,), N, forces are to change after a change x of them and displacements v, m."""
        apart = self._moved_by(at, v) + self._of.jumps(x / self._of.area)
        return self._of.area * self._of.stiffness * apart

    def _moved_by(self, at: At, v: PETSc.Vec) -> NDArray[np.float64]:
        """Return the means (k,), m, of displacements v."""
        B = self._means(at.unknowns)
        out = B.createVecLeft()
        B.mult(v, out)
        return out.array_r.copy()

    @property
    def traction(self) -> NDArray[np.float64]:
        """Tractions (k,), Pa, of the multipliers at present."""
        return self._now.present

    def aim(self, at: At, x: NDArray[np.float64]) -> None:
        """Let x be the change of the forces, N, along which `go` goes."""
        self._now = Tractions(self.traction, self.traction, x / self._of.area)

    def go(self, shares: NDArray[np.float64]) -> None:
        """Change the tractions by shares (k,) of that."""
        self._now = self._now._replace(present=self._now.before + shares * self._now.change)

    def restart(self) -> None:
        """Set the tractions to where iterations began."""
        self._now = self._begun

    def moved(self, u: fem.Function) -> Loads:
        """Return given displacements with the tractions of a displacement u, m, that bodies have at rest."""
        way = self._along(u.x.array.reshape(-1, self._d))
        gap, tractions = self.data["gap"][:, 0] - way, (self._reference, self.traction)
        if self.multiplies:
            rows = self._of.rows
            gap[rows] += way[rows]
            rest = -self._of.stiffness * way[rows]
            tractions = rest, np.where(self.traction == 0, rest, self.traction)
        more = self._of, self.origin, *tractions, self.multiplies
        return HoldLoads(self._acting, self._forms, self.data.having(gap=gap), self.held, self.row, self.share, *more)

    def _along(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacement (m,), m, of each component that is given, at nodal values u (nodes, d), m."""
        at_nodes = u[self.data.points.grid.cell_nodes[self.data.cells]]
        return np.einsum("mk,mkd,md->m", self.held.shape[self.row], at_nodes, self.data["direction"])

    def pull(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the force (m,), N, along each component that is given, at nodal values u (nodes, d), m."""
        force = self.data["stiffness"][:, 0] * (self.data["gap"][:, 0] - self._along(u))
        force[self._of.rows] += self._of.area * self._held()
        return force

    @property
    def carried(self) -> NDArray[np.float64]:
        """Forces (m,), N, of the multipliers as iterations began."""
        out = np.zeros(len(self.row))
        out[self._of.rows] = self._of.area * self._begun.present
        return out

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with the tractions, from which the next step begins."""
        return self._acting.gripped(self, points) if self.multiplies else points

    @property
    def firm(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of means (k,), and axes (k,), of the multipliers."""
        rows = self._of.rows
        return self.row[rows], self.data["direction"][rows].argmax(axis=1)

    def pulling(self, at: At, v: NDArray[np.float64]) -> float:
        """Return the power, W, of what pulls the sides along."""
        return float(self.pull(at.nodal) @ self._along(v.reshape(-1, self._d)))

    def counted(self, at: At) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return degrees of freedom (n,), and forces (n,), N, on them that reactions count."""
        return self._dofs.ravel(), (self.share * self.pull(at.nodal)[:, None]).ravel()

    def guess(self, parts: Parts, nodal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return u with the rigid motions of the parts that given displacements turn; None where they turn none."""
        grid = self.data.points.grid
        if grid.axisymmetric:
            return None
        of, moved = parts.cells[self.data.cells], None
        for part in np.flatnonzero(over_all(grid.comm, sum_by(of, np.ones(len(of)), parts.count))):
            motion = rigid_motion(grid.comm, self.data, grid.node_x, of == part)
            if motion is not None:
                moved = nodal.copy() if moved is None else moved
                moved[parts.nodes == part] = motion[parts.nodes == part]
        return moved

    def touching(self) -> tuple:
        """Return cells, places and directions of what is held."""
        return self.data.cells, None, self.data.x, self.data["direction"]

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """The cells of sides that are held."""
        return self.data.cells

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what rounding leaves: that of rigid sides with coordinates as well."""
        grid = self.data.points.grid
        held = np.zeros(grid.num_local)
        np.maximum.at(held, self.data.cells, self.data["stiffness"][:, 0])
        return of_cells + 4 * EPSILON * grid.reach * held

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the reactions."""
        return {"reactions": self._acting.reactions(self, at)}


def held_faces(setting: Setting) -> list[tuple[Displacement, Surface, Sequence[int]]]:
    """Return the given displacements of a stage with the faces at which they are imposed, and the axes along which."""
    holds = [(hold, hold.axes(setting.grid.dim)) for hold in setting.of(Displacement).values()]
    others = [[other for other, more in holds if other is not hold and set(axes) & set(more)] for hold, axes in holds]
    return [(hold, setting.sides.held(hold, rest), axes) for (hold, axes), rest in zip(holds, others, strict=True)]
