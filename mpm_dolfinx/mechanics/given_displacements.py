# SPDX-License-Identifier: MIT
"""Prescribed displacements of sides, by penalties (`held_cells`).

If a side lags behind its prescribed displacement, each prescribed component in each cell gets a multiplier (method of
multipliers, Hestenes 1969).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from itertools import combinations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import CannotFollow
from mpm_dolfinx.base.time_integration import GAMMA, in_step
from mpm_dolfinx.base.tolerances import EPSILON, NEAR, TINY
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.faces import Surface, face_vectors
from mpm_dolfinx.conditions.acting import Acting, At, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import HOLD, Displacement, holding, resistance
from mpm_dolfinx.domains.cut_domains import Patches
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.forms.unknowns import sum_ghosts
from mpm_dolfinx.grid.grid import Grid, sum_by, sums_of_rows
from mpm_dolfinx.mechanics.held_cells import HeldCells, HeldPoints, inner_cells
from mpm_dolfinx.mechanics.rigid_motion import rigid_motion, rotated
from mpm_dolfinx.parallel.exchange import first, over_all, together
from mpm_dolfinx.parallel.messages import ConditionWarning, warn
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.parts import Parts

ARTEFACT = "%s: not at its prescribed position at %s, so %s"


class HoldForms:
    """Forms of the penalties: stiffness, and force towards the prescribed position."""

    def __init__(self, grid: Grid, u: fem.Function):
        d = grid.dim
        moments = {"squares": (d, d), **({"product": ()} if d == 3 else {})}
        self.points = h = FormPoints(grid, stiffness=(), direction=(d,), gap=(), **moments)
        v, du = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)

        def along(w):
            """Return the component of a Q1 field w along `direction`: its mean over an area with the moments in `h`."""
            second = ufl.grad(ufl.grad(w))
            i, j, k = ufl.indices(3)
            mean = w + ufl.dot(ufl.grad(w), h.offset) + ufl.as_vector(second[i, j, k] * h.squares[j, k], i) / 2
            if d == 3:  # the only third derivative of a trilinear function that is not zero
                mean += ufl.grad(second)[:, 0, 1, 2] * h.product
            return ufl.dot(mean, h.direction)

        self.hold = PointForm(h.stiffness * along(du) * along(v) * h.dx, h)
        self.pull = PointForm(h.stiffness * h.gap * along(v) * h.dx, h)


class GivenDisplacements(Acting):
    """The prescribed displacements of a stage, by name.

    Two conditions must not prescribe the same component on the same part of a face (ValueError).
    """

    conditions, title = (Displacement,), "given displacements"

    def __init__(self, setting: Setting, displacements: Mapping[str, Displacement]):
        self._grid = setting.grid
        self._forms = setting.forms
        self._materials = setting.materials
        self._free, self._names = setting.free, list(displacements)
        self._meeting: list[tuple[Displacement, Displacement, list[int], NDArray[np.float64]]] = []
        self._warned: set[tuple[int, str]] = set()  # index of the condition, and text, of each warning in the log
        sides, d = setting.sides, self._grid.dim
        whole = [(hold, sides.of(hold), hold.axes(d)) for hold in displacements.values()]
        for (one, faces, axes), (other, others, more) in combinations(whole, 2):
            if common := sorted(set(axes) & set(more)):
                faces.check_apart(others, (one, other))
                self._meeting.append((one, other, common, sides.meeting(faces, others)))
        self._holds = self.held = setting.held
        for hold in displacements.values():
            if not callable(hold.value):  # values of functions are checked when they are called
                hold.at(0.0, np.empty((1, d)))

    @property
    def space(self) -> fem.FunctionSpace:
        """Function space of the nodal displacements."""
        return self._forms.u.function_space

    @property
    def surfaces(self) -> list[Surface]:
        """Faces with prescribed displacements."""
        return [faces for _, faces, _ in self._holds]

    def check_start(self, place: Place) -> None:
        """Warn of sides that jump to a prescribed displacement at the start of a stage with inertia."""
        if not (place.inertia and place.dt):
            return
        for number, (hold, faces, axes) in enumerate(self._holds):
            jump = self._jump(place, place.points, hold, axes, place.cut.surface(faces))
            jump = over_all(self._grid.comm, float(np.abs(jump).max(initial=0.0)), MPI.MAX)
            if jump:
                what = "%s: moves its side by %.3g m at once at t = %.6g s, as bodies with inertia begin to move; %s"
                why = "its values refer to the start or the last reset_displacement, must begin at the present position"
                self._warn(number, what, jump, place.start, why)

    def _jump(
        self, place: Place, points: MaterialPoints, hold: Displacement, axes: Sequence[int], p: Patches
    ) -> NDArray[np.float64]:
        """Return the gaps (n, d), in m, between a side and its prescribed positions at the start of a stage.

        The result is zero for gaps that the elastic strain of a cell explains.
        """
        out = np.zeros_like(p.now(points))
        if not place.begins:
            return out
        out[:, axes] = (p.origin(points) + self._given(hold, place.start, p.X) - p.now(points))[:, axes]
        tension, modulus = self._materials.total_stress(points), self._materials.table(points, holding)
        strain = np.linalg.norm(out, axis=1) / self._grid.sizes_at(p.x).min(axis=-1)
        sudden = strain > np.maximum(NEAR, np.linalg.norm(tension[p.at], axis=(1, 2)) / modulus[p.at])
        return np.where(sudden[:, None], out, 0.0)

    def placed(self, place: Place) -> Loads:
        """Return the penalties in a substep."""
        d, comm = self._grid.dim, self._grid.comm
        self._check_meeting(place.t)
        ends = (place.start, place.start + place.dt) if place.dt > 0 else ()  # empty if dt = 0, without displacement
        held = HeldCells(self._grid, self._held_points(place, ends))
        placed, message = [], ""
        for axis in range(d):
            given = np.array([axis in axes for *_, axes in self._holds])
            *rows, wrong = held.rows(axis, given, self._free[:, axis])
            placed.append((*rows, np.tile(np.eye(d)[axis], (len(rows[0]), 1))))
            if wrong >= 0:
                hold, x = self._holds[held.number[wrong]][0], held.x[wrong] + self._grid.base
                what = f"{line(hold)}: moves {'xyz'[axis]} at {x}"
                message = f"{what}, which a wall of the grid fixes there; must be 0 there, or free at the wall"
        if message := first(comm, message):
            raise ValueError(message)
        row, stiffness, gap, own, direction = map(np.concatenate, zip(*placed, strict=True))
        fields = {name: values[row] for name, values in held.moments.items()}
        fields |= {"stiffness": stiffness, "gap": gap, "direction": direction}
        forms = self._forms(HoldForms)
        data = forms.points.at(held.cell[row], held.x[row], np.ones(len(row)), **fields)
        return HoldLoads(self, forms, data, held, row, own, place)

    def _held_points(self, place: Place, ends: Sequence[float]) -> HeldPoints:
        """Return the integration points on sides.  `ends`: start and end of the step, in s; empty if dt = 0."""
        cut, points = place.cut, place.points
        d, t = self._grid.dim, place.t
        rows, bounds = [], []
        patches = cut.surfaces([faces for _, faces, _ in self._holds])
        chosen = np.unique(np.concatenate([p.at for p in patches]))
        cut_points = cut.points if ends else points  # at the positions of the cut domains
        now, before = (of.map(lambda values: values[chosen]) for of in (points, cut_points))
        stress = self._materials.total_stress(now)
        modulus, resists = (self._materials.table(before, of) for of in (holding, resistance))
        # values at the last reset of the grid, like the stiffnesses: constant until the next reset
        tension = np.linalg.norm(stress if points is cut_points else self._materials.total_stress(before), axis=(1, 2))
        confined = [self._materials.confined_modulus(before, *most) for most in ((), (1 / EPSILON,))]
        moves = place.inertia and place.dt > TINY
        inertial = self._materials.present_density(before) / (GAMMA * place.dt) ** 2 if moves else 0.0 * modulus
        inertial = inertial * self._grid.sizes_at(before.x).min(axis=-1) ** 2
        moduli = {"modulus": modulus, "tension": tension, "resistance": resists, "inertial": inertial}
        moduli |= dict(zip(("confined", "undrained"), confined, strict=True))
        for number, ((hold, *_, axes), p) in enumerate(zip(self._holds, patches, strict=True)):
            at, now = np.searchsorted(chosen, p.at), p.now(points)
            given = [self._given(hold, time, p.X) for time in (t, *ends)] if ends else 3 * [np.zeros_like(now)]
            if place.inertia and ends and t < ends[1]:
                given[0] = in_step((t - ends[0]) / (ends[1] - ends[0]), given[1], given[0], given[2])
            start, to = (p.origin(points) + given[k] for k in (1, 0))
            step, given = given[0] - given[1], np.concatenate(given[1:], axis=1)
            if place.inertia and ends:
                step = step + self._jump(place, points, hold, axes, p)
            R = rotated(self._grid.comm, p.area0, now, to) if len(axes) == d else np.eye(d)  # rotates the traction
            force, gap = np.einsum("ij,njk,nk->ni", R, stress[at, :d, :d], p.area(points)), to - now
            fields = {name: p.area0 * values[at] for name, values in moduli.items()}
            fields |= {"number": np.full(len(gap), number), "area": p.area0, "gap": gap, "step": step, "given": given}
            rows.append((p.cell, p.x, fields | {"normal": p.area(cut.points), "force": force}))
            bounds.append([start.max(axis=0, initial=-np.inf), -start.min(axis=0, initial=np.inf)])
        cell, x, fields = self._grid.gathered(rows)
        extent = over_all(self._grid.comm, np.array(bounds), MPI.MAX).sum(axis=1)
        sides = [(axes, size) for (*_, axes), size in zip(self._holds, extent, strict=True)]
        inner = inner_cells(self._grid, place.fill, sides, fields["number"].astype(np.int64), cell, fields["normal"])
        if over_all(self._grid.comm, int((inner != cell).any())):
            cell, x, fields = self._grid.gathered([(self._grid.cell_number[inner], x, fields)])
        number = fields.pop("number").astype(np.int64)
        return HeldPoints(number=number, cell=cell, x=x, **fields)

    def _check_meeting(self, t: float) -> None:
        """Raise ValueError if prescribed displacements differ where two sides meet."""
        for one, other, axes, X in self._meeting:
            jump = np.abs(self._given(one, t, X) - self._given(other, t, X))[:, axes].max(axis=1)
            if jump.max(initial=0.0) > NEAR * self._grid.least:
                what = f"{line(one)} and {line(other)}: differ by {jump.max():.3g} m at t = {t:g} s where they meet"
                raise ValueError(f"{what}, at {X[jump.argmax()]}; must be equal there, or the sides two cells apart")

    def _given(self, hold: Displacement, t: float, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the prescribed displacements, in m, at reference positions X (n, d)."""
        return together(self._grid.comm, lambda: hold.at(t, X))

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return placeholders for the reactions, by quantity and name of the condition: every component is `value`."""
        return {"reactions": {name: np.full(self._grid.dim, value) for name in self._names}}

    def reactions(self, loads: HoldLoads, at: At) -> dict[str, NDArray[np.float64]]:
        """Return the force of each condition on the bodies at u, in N."""
        held = loads.held
        data = loads.data
        force = loads.pull(at.nodal)
        reported = {number for number, what in self._warned if what == ARTEFACT}
        axis = data["direction"].argmax(axis=1)
        for number, x in held.beyond(loads.row, axis, force, loads.reached(at), reported):
            why = "the reaction is an artefact; does another condition also hold the side, or is the step too large?"
            self._warn(number, ARTEFACT, x + self._grid.base, why)
        number, force = held.number[loads.row], loads.share.sum(axis=1) * force + loads.kept_at_rest(at)
        force = force[:, None] * data["direction"]
        sums = over_all(self._grid.comm, sums_of_rows(number, force, len(self._holds)))
        return dict(zip(self._names, sums, strict=True))

    def _warn(self, number: int, what: str, *values) -> None:
        """Warn about a boundary condition.  The same warning about a condition is not repeated."""
        if (number, what) not in self._warned:
            warn(self._grid.comm, ConditionWarning, what, line(self._holds[number][0]), *values)
            self._warned.add((number, what))

    def check_came(self, place: Place, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise CannotFollow if all points of a side follow less than half of their prescribed increment."""
        for hold, faces, axes in self._holds:
            p = place.cut.surface(faces)
            start, end = (self._given(hold, t, p.X) for t in (place.start, place.t))
            jump = self._jump(place, before, hold, axes, p)  # jump from the position to a prescribed value
            gaps = (p.origin(before) + start - p.now(before) - jump, p.origin(points) + end - p.now(points))
            old, new, increment = (np.linalg.norm(v[:, axes], axis=1) for v in (*gaps, end - start + jump))
            moves = increment > NEAR * self._grid.least
            share = 1 - ((new - old)[moves] / increment[moves]).min(initial=np.inf)
            share = over_all(self._grid.comm, float(share), MPI.MAX)
            if -np.inf < share < 0.5:  # less than half of the increment
                what = f"{line(hold)}: the bodies follow at most {max(0.0, share):.0%} of the prescribed increment"
                raise CannotFollow(f"{what}, must be free to move; undrained soil keeps its volume")

    def under_held(
        self, ids: NDArray[np.int64], tracked: NDArray[np.float64], volume: NDArray[np.float64], corners: NDArray
    ) -> NDArray[np.float64]:
        """Return the corners of re-initialised domains `ids`, in m.  Domains at prescribed sides become prisms.

        Each prism has the volume of its domain, and keeps the corners on the side.

        `tracked`, `corners` (n, 2^d, d), in m: corners before and after re-initialisation from F.
        `volume` (n,): volumes of the domains, in axisymmetry areas of their sections.
        """
        index = np.arange(2**self._grid.dim)
        for _, faces, _ in self._holds:
            held = np.flatnonzero(np.isin(ids, faces.id))
            number = faces.face[np.searchsorted(faces.id, ids[held])]  # only the first held face of a domain
            axis, end = (k[:, None] for k in np.divmod(number, 2))
            outward = face_vectors(tracked[held], number)
            depth = volume[held, None] * outward / (outward**2).sum(axis=1, keepdims=True)
            face = index ^ ((index >> axis & 1 ^ end) << axis)  # for each corner, its partner on the held face
            there = np.take_along_axis(tracked[held], face[:, :, None], axis=1)
            corners[held] = there - np.where((face != index)[:, :, None], depth[:, None], 0.0)
        return corners


class HoldLoads(Loads):
    """Prescribed displacements in a substep, as penalties on k components.

    `data`: integration points, one for each component, with stiffness, direction and gap.
    `held`: geometry and stiffness of all penalties.
    `row` (k,): index, in `held`, of the penalty of each component.
    `share` (k, 2^d): fraction of the force of each component on each node, see `HeldCells.rows`.
    `place`: time and cut domains of the substep.
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
        place: Place,
    ):
        self._acting = acting
        self._forms = forms
        self.data = data
        self.held = held
        self.row = row
        self.share = share
        self._place = place
        self._d = data.points.grid.dim
        self.key = np.append(self._d * row + data["direction"].argmax(axis=1), place.dt if place.inertia else 0.0)
        self.under_held = acting.under_held
        self._asked = data["gap"][:, 0]  # prescribed increments of means: `augment` has not changed the gaps yet
        self._lacked = np.full(1, np.inf)  # for each side of a connected part: sum of gaps in the last `augment`

    def augment(self, at: At) -> bool:
        """Add the penalty forces to the multipliers of sides that lag behind.  Return whether any force changed.

        The updates end when one update leaves more than half of the mean gap of every side.
        """
        if not self._place.dt:
            return False
        means, axis = self.row < self.held.limit.shape[1], self.data["direction"].argmax(axis=1)
        side = (self._d * self.held.number[self.row] + axis) * at.parts.count + at.parts.cells[self.data.cells]
        count = len(self._acting.held) * self._d * at.parts.count
        weight = np.where(means, self.data["stiffness"][:, 0], 0.0)
        gap = np.where(means, self._asked - self._along(at.nodal), 0.0)
        paths = gap, np.abs(self.held.path[self.row, axis])
        sums = np.stack([sum_by(side, weight * path, count) for path in paths])
        lacks, goes = np.abs(over_all(self.data.points.grid.comm, sums))
        least = np.where(np.isinf(self._lacked), 1 / HOLD, NEAR)
        more = (least * goes < lacks) & (lacks < self._lacked / 2) & (goes > 0)
        self._lacked = np.where(more, lacks, self._lacked)
        self.data = self.data.having(gap=self.data["gap"][:, 0] + gap * more[side])
        return bool(more.any())

    @property
    def _dofs(self) -> NDArray[np.int64]:
        """Local dofs (k, 2^d) of the nodes of each component."""
        axis = self.data["direction"].argmax(axis=1)
        return self._d * self.data.points.grid.cell_nodes[self.data.cells] + axis[:, None]

    def reached(self, at: At) -> NDArray[np.bool_]:
        """Return whether each component has reached its prescribed value, within `1 / sqrt(HOLD)` of its increment."""
        return np.abs(self._asked - self._along(at.nodal)) * np.sqrt(HOLD) <= np.abs(self._asked)

    def pulls(self, b: NDArray[np.float64]) -> None:
        """Add the forces towards the prescribed displacements."""
        self._forms.pull.assemble_vector(b, self.data)

    def penalty(self, A: PETSc.Mat, walls: bool) -> None:
        """Add the penalty stiffness."""
        if not walls:
            self._forms.hold.assemble_matrix(A, self.data)

    def moved(self, u: fem.Function) -> Loads:
        """Return the penalties after an additional displacement u of the nodes."""
        out = copy(self)
        static = (self.held.static[self.row] * self.data["direction"]).sum(axis=1)
        less = static * self._along(u.x.array.reshape(-1, self._d))
        out.data = self.data.having(gap=self.data["gap"][:, 0] - less)
        return out

    def _along(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacement along each prescribed component, in m, from nodal displacements."""
        at_nodes = u[self.data.points.grid.cell_nodes[self.data.cells]]
        return np.einsum("mk,mkd,md->m", self.held.shape[self.row], at_nodes, self.data["direction"])

    def pull(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the force along each prescribed component, in N, from nodal displacements."""
        return self.data["stiffness"][:, 0] * (self.data["gap"][:, 0] - self._along(u))

    def pulling(self, at: At, v: NDArray[np.float64]) -> float:
        """Return the power of the penalty forces, in W."""
        return float(self.pull(at.nodal) @ self._along(v.reshape(-1, self._d)))

    def kept_at_rest(self, at: At) -> NDArray[np.float64] | float:
        """Return the part of the forces `At.held` that belongs to each component, in N.

        These forces cancel penalty forces of bodies at rest, for instance of a lag after one static step.  Components
        that act on the same node share its force in proportion to their stiffness.
        """
        if at.held is None:
            return 0.0
        dofs = self._dofs
        weight = self.share * self.data["stiffness"][:, :1]
        total = fem.Function(self._acting.space)
        np.add.at(total.x.array, dofs, weight)
        sum_ghosts(total)
        total.x.scatter_forward()
        whole = total.x.array[dofs]
        return (np.divide(weight, whole, out=np.zeros_like(weight), where=whole > 0) * at.held[dofs]).sum(axis=1)

    def counted(self, at: At) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return local dofs and their penalty forces, which are not reactions of walls, see `Loads.counted`."""
        return self._dofs.ravel(), (self.share * self.pull(at.nodal)[:, None]).ravel()

    def guess(self, parts: Parts, nodal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return an initial guess of the nodal displacements, or None if no connected part rotates.

        The guess of a rotated part is the rigid motion nearest to its prescribed displacements.  For all other parts,
        the guess is `nodal`.
        """
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
        """Return cells, positions and directions of the prescribed components, for the check of supports."""
        return self.data.cells, None, self.data.x, self.data["direction"]

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """Cells with prescribed components."""
        return self.data.cells

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rounding errors in cells: `of_cells` plus the errors of the penalty forces."""
        grid = self.data.points.grid
        held = np.zeros(grid.num_local)
        np.maximum.at(held, self.data.cells, self.data["stiffness"][:, 0])
        return of_cells + 4 * EPSILON * grid.reach * held

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise CannotFollow if the bodies did not follow the sides."""
        self._acting.check_came(self._place, points, before)

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the reactions."""
        return {"reactions": self._acting.reactions(self, at)}
