# SPDX-License-Identifier: MIT
"""A scene and one step of it: cut the domains by the grid, solve for u and p, move the points, reset the grid."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.common import Timer
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.conditions import HOLD, RIGIDITY, Displacement, Drained, Inflow, RigidPlate, Traction
from mpm_dolfinx.coupling import COUPLINGS, Coupler, Report
from mpm_dolfinx.domains import corner_bits
from mpm_dolfinx.exchange import Exchange
from mpm_dolfinx.forms import FormPoints, PointExpression
from mpm_dolfinx.grid import Grid, sum_by
from mpm_dolfinx.materials import Fluid, Skeleton
from mpm_dolfinx.momentum import FULL, Momentum
from mpm_dolfinx.placement import Placement
from mpm_dolfinx.points import Body, MaterialPoints, Probes, Surface, face_vectors, material_points, surface
from mpm_dolfinx.remap import Carried, carry, remap
from mpm_dolfinx.storage import Storage
from mpm_dolfinx.timeloop import Observer, Result, run


class Simulation:
    """A scene and its state.

    Parameters
    ----------
    grid
        Background grid.
    bodies
        Seeded bodies.
    materials
        Material of each index that the bodies name; all of one law.
    fixed
        Walls of the grid with the components that are zero there, such as {"left": "xy", "bottom": "y"}.
    fluid
        Pore fluid; without it there is no storage problem.
    tractions, displacements, drained, inflows, plates
        Boundary conditions on sides of the bodies; other sides are free and sealed.
    gravity : (d,) or callable t -> (d,), m/s^2
        Acceleration of gravity.
    pressure
        Pore pressure at the start, Pa.
    quadrature
        "domain": exact pieces of the points' domains; "point": at the points, as in the seed paper.
    coupling, tolerance
        See `Coupler`.
    """

    def __init__(
        self,
        grid: Grid,
        bodies: Sequence[Body],
        materials: Sequence[Skeleton],
        *,
        fixed: Mapping[str, str],
        fluid: Fluid | None = None,
        tractions: Sequence[Traction] = (),
        displacements: Sequence[Displacement] = (),
        drained: Sequence[Drained] = (),
        inflows: Sequence[Inflow] = (),
        plates: Sequence[RigidPlate] = (),
        gravity: ArrayLike | Callable[[float], ArrayLike] | None = None,
        pressure: float = 0.0,
        quadrature: str = "domain",
        coupling: str = "schur-cg",
        tolerance: float = 1e-8,
    ):
        if quadrature not in ("domain", "point"):
            raise ValueError(f"quadrature {quadrature!r}: must be domain or point")
        if coupling not in COUPLINGS:
            raise ValueError(f"coupling {coupling!r}: must be one of {', '.join(COUPLINGS)}")
        law = type(materials[0])
        if any(type(m) is not law for m in materials):
            raise ValueError("materials: all must be of one law")
        if fluid is None and (drained or inflows):
            raise ValueError("drained and inflow sides need a fluid")
        self.grid, self.materials, self.fluid, self.bodies = grid, materials, fluid, bodies
        self.quadrature = quadrature
        self._gravity_at = gravity if callable(gravity) or gravity is None else lambda t: gravity
        self.gravity = None if gravity is None else fem.Constant(grid.mesh, np.zeros(grid.dim))
        self.t, self.active_cells = 0.0, 0
        self.points = material_points(grid, bodies, pressure)
        self._plates = [(plate, self._faces(bodies, plate)) for plate in plates]
        tractions = [*tractions, *(plate.traction(faces.area0.sum(), grid.dim) for plate, faces in self._plates)]
        self._loads = [(load, self._faces(bodies, load)) for load in tractions]
        self._holds = [(hold, self._faces(bodies, hold), hold.axes(grid.dim)) for hold in displacements]
        self.reactions = np.zeros((len(displacements), grid.dim))
        """(displacements, d): force by which each given displacement acts on the bodies, N (N/m in plane strain)."""
        self._outlets = [(outlet, self._faces(bodies, outlet)) for outlet in (*drained, *inflows)]
        self._law = law

        start = time.perf_counter()
        self._build(law, self._fixed_nodes(fixed), coupling, tolerance)
        self.jit = time.perf_counter() - start
        """Seconds spent on compiling or finding the forms."""
        self._carried = carry(self.points) if fluid else None
        self._prepared = False
        self.result: Result | None = None
        """Histories of the last run, also while it runs."""
        self._stress: PointExpression | None = None

    # ---- building -------------------------------------------------------------------------------

    def _faces(self, bodies: Sequence[Body], condition) -> Surface:
        faces = surface(bodies, condition.side, condition.region)
        if not len(faces):
            raise ValueError(f"{condition}: no point has this side" + (" in the region" if condition.region else ""))
        return faces

    def _fixed_nodes(self, fixed: Mapping[str, str]) -> NDArray[np.bool_]:
        d = self.grid.dim
        out = np.zeros((len(self.grid.node_x), d), dtype=bool)
        for wall, axes in fixed.items():
            if not axes or any(a not in "xyz"[:d] for a in axes):
                raise ValueError(f"fixed wall {wall!r}: components {axes!r}, must be some of {'xyz'[:d]!r}")
            for a in axes:
                out[self.grid.wall_nodes(wall), "xyz".index(a)] = True
        return out

    def _build(self, law, fixed: NDArray[np.bool_], coupling: str, tolerance: float) -> None:
        """Compile the forms that the scene needs."""
        grid, d, fluid = self.grid, self.grid.dim, self.fluid
        shapes: dict[str, tuple[int, ...]] = {"F": (d, d), **{name: () for name in law.parameters}}
        if fluid:
            shapes |= {"biot": (), "storage": ()}
        if self.gravity is not None:
            shapes |= {"density": ()}
        self.pieces = FormPoints(grid, **shapes)
        p = fem.Function(_compat.function_space(grid.mesh, "DG", 0)) if fluid else None
        self.momentum = Momentum(grid, self.pieces, law, fixed, p, self.gravity, bool(self._plates), bool(self._holds))
        self.storage = None
        if fluid:
            weight = None if self.gravity is None else fluid.density * self.gravity
            self.storage = Storage(grid, self.pieces, self.momentum.u, p, weight, coupling != "schur-fgmres")
        self.coupler = Coupler(self.momentum, self.storage, coupling, tolerance)

    def _table(self, value: Callable[[Skeleton], float]) -> NDArray[np.float64]:
        """Return a constant of the materials at the points (n,)."""
        return np.array([value(m) for m in self.materials])[self.points.material]

    # ---- one step -------------------------------------------------------------------------------

    def step(self, dt: float) -> Report:
        """Advance by dt (s).

        Raises
        ------
        NotConverged
            The state is then still that before the step.
        """
        if not dt > 0:
            raise ValueError(f"dt = {dt!r}, must be > 0")
        self._begin(self.t + dt)
        report = self.coupler.solve(dt)
        if self._holds:
            self._react()
        self._move_points()
        self.t += dt
        self._prepared = False
        return report

    def _begin(self, t: float) -> None:
        """Set up the step that ends at time t: grid, loads of that time, u = 0 and the cells' pressure."""
        if self.gravity is not None:
            self.gravity.value = np.asarray(self._gravity_at(t), dtype=float)
        fresh = not self._prepared
        if fresh:
            self._reset_grid()
        elif self.gravity is not None and self.storage:
            self._open_boundary()  # a step is tried again, with the gravity of another time
        self._place_loads(t)
        if fresh:
            self.momentum.set_penalty()
            if self._renumbered:
                self._check_held()
            self._prepared = True
        self.momentum.start()
        if self.storage:
            self.storage.start(t - self.t)

    def _reset_grid(self) -> None:
        """Rebuild the integration data on the fresh grid: pieces, active cells, remapped pressure."""
        with Timer("mpm: cut domains"):
            self.placement = place = Placement(self.grid, self.points, self.quadrature, self.t)
        if self.storage:
            with Timer("mpm: remap"):
                self._brought = remap(self._carried, self.points, place.pieces)
        with Timer("mpm: integration data"):
            J = self.points.J
            self.pieces.place(
                place.cells,
                place.pieces_to_cells(place.pieces.x),
                place.pieces_to_cells(place.pieces.fraction * (self.points.volume0 * J)[place.pieces.point]),
                **{name: place.to_cells(values) for name, values in self._fields(J).items()},
            )
            self._activate(J)

    def _fields(self, J: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return what the points bring to their pieces."""
        fields = {"F": self.points.F}
        for name in self._law.parameters:
            fields[name] = self._table(lambda m, name=name: getattr(m, name))
        n = 1 - (1 - self._table(lambda m: m.porosity)) / J
        if self.fluid:
            storage = np.stack([m.storage(self.fluid.bulk, n) for m in self.materials])
            fields["biot"] = self._table(lambda m: m.biot)
            fields["storage"] = storage[self.points.material, np.arange(len(n))]
        if self.gravity is not None:
            wet = self.fluid.density if self.fluid else 0.0
            fields["density"] = (1 - n) * self._table(lambda m: m.grain_density) + n * wet
        return fields

    def _activate(self, J: NDArray[np.float64]) -> None:
        """Set the active cells and what they hold."""
        grid, pieces, momentum = self.grid, self.pieces, self.momentum
        weight = pieces.data["weight"][:, 0] * grid.cell_volume
        filled = sum_by(pieces.cells, weight, grid.num_local)
        stiffness = sum_by(pieces.cells, weight * self._rows(lambda m: m.oedometric), grid.num_local)
        momentum.fill.x.array[:] = filled / grid.cell_volume
        momentum.modulus.x.array[:] = np.divide(stiffness, filled, out=stiffness, where=filled > 0)
        for f in (momentum.fill, momentum.modulus):
            f.x.scatter_forward()
        fill = momentum.fill.x.array
        active = fill > 0
        cells = np.flatnonzero(active)
        self.active_cells = grid.comm.allreduce(int(active[: grid.num_owned].sum()))
        facets = grid.interior_facets(active, cells)
        renumbered = momentum.set_active(cells, facets, fill < FULL)
        if self._plates:
            self._place_plates()
        if self.storage:
            s = self.storage
            if renumbered:
                s.set_active(cells, facets)
                s.set_coupled(momentum.unknowns)
            s.set_contents(
                pieces.cells,
                weight,
                pieces.x,
                self._rows(lambda m: m.conductivity) / self.fluid.unit_weight,
                self.placement.pieces_to_cells(self.placement.pieces.faces),
                pieces.data["storage"][:, 0],
                self.placement.pieces_to_cells(self._brought),
                self._fixed_stress(J),
                self._rows(lambda m: m.pressure_damping(grid.dim)),
            )
            self._open_boundary()
        if renumbered:
            self.coupler.set_unknowns()
        self._renumbered = renumbered

    def _rows(self, value: Callable[[Skeleton], float]) -> NDArray[np.float64]:
        """Return a constant of the materials at the pieces of this process (m,)."""
        return self.placement.to_cells(self._table(value))

    def _fixed_stress(self, J: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return beta of the fixed-stress operator at the pieces, 1/Pa, before the scheme's factor."""
        if COUPLINGS[self.coupler.coupling] is None:  # as printed in the paper
            return np.full(len(self.pieces.cells), 1 / self.fluid.bulk)
        beta = self._table(lambda m: m.biot**2 / m.drained_modulus(self.grid.dim)) * J
        return self.placement.to_cells(beta)

    def _check_held(self) -> None:
        """Refuse a scene whose body can move as a rigid body: its tangent is singular."""
        grid, momentum = self.grid, self.momentum
        nodes = np.zeros(len(grid.node_x), dtype=bool)
        nodes[grid.cell_nodes[np.flatnonzero(momentum.fill.x.array > 0)]] = True
        node, axis = np.nonzero(nodes[:, None] & ~momentum.free)
        x, direction = grid.node_x[node], np.eye(grid.dim)[axis]
        if self._holds:
            x = np.concatenate([x, momentum.holds.x])
            direction = np.concatenate([direction, momentum.holds.data["direction"]])
        x = x / (grid.upper - grid.lower).max()
        modes = list(direction.T)
        modes += [direction[:, a] * x[:, b] - direction[:, b] * x[:, a] for a in range(grid.dim) for b in range(a)]
        R = np.stack(modes, axis=1)
        gram = grid.comm.allreduce(R.T @ R)
        missing = len(modes) - np.linalg.matrix_rank(gram, tol=1e-12 * max(1.0, np.abs(gram).max()))
        if missing:
            raise ValueError(
                f"fixed walls: the body is free to move as a rigid body in {missing} of {len(modes)} ways; "
                "it must touch walls whose fixed components hold it, or have given displacements"
            )

    def _place_loads(self, t: float) -> None:
        """Put the dead loads of time t on the surface."""
        with Timer("mpm: loads"):
            rows = []
            for load, faces in self._loads:
                here, _, cell, x = self.placement.surface(faces)
                rows.append((cell, x, faces.area0[here, None] * load.at(t)))
            cell, x, force = self._gathered(rows, (self.grid.dim,))
            self.momentum.loads.place(cell, x, np.ones(len(cell)), force=force)
            if self._holds:
                self._place_holds(t)
            self.momentum.set_loads()

    def _place_plates(self) -> None:
        """Put the plates on the surface."""
        grid, rows = self.grid, []
        modulus = max(m.oedometric for m in self.materials)
        for _, faces in self._plates:
            _, at, cell, x = self.placement.surface(faces)
            area = face_vectors(self.points.corners[at], faces.axis, faces.end)
            length = faces.area0.sum() ** (1 / (grid.dim - 1))
            rigidity = RIGIDITY * modulus * length * np.linalg.norm(area, axis=1, keepdims=True)
            normal = np.tile(np.eye(grid.dim)[faces.axis], (len(at), 1))
            tilt = normal - area / area[:, [faces.axis]]  # slope of the face: its normal is (-slope, 1)
            rows.append((cell, x, np.concatenate([rigidity, normal, tilt], axis=1)))
        cell, x, values = self._gathered(rows, (1 + 2 * grid.dim,))
        rigidity, normal, tilt = np.split(values, [1, 1 + grid.dim], axis=1)
        self.momentum.plates.place(cell, x, np.ones(len(cell)), rigidity=rigidity, normal=normal, tilt=tilt)

    def _place_holds(self, t: float) -> None:
        """Put the given displacements of time t on the surface: one row a face and component."""
        d, rows = self.grid.dim, []
        stiffness = HOLD * max(m.oedometric for m in self.materials) / self.grid.h.min()
        for number, (hold, faces, axes) in enumerate(self._holds):
            here, _, cell, x = self.placement.surface(faces)
            gap = faces.x0[here] + hold.at(t, faces.x0)[here] - x
            for axis in axes:
                rows.append((cell, x, np.zeros((len(cell), 3 + d))))
                rows[-1][2][:, 0] = number
                rows[-1][2][:, 1] = stiffness * faces.area0[here]
                rows[-1][2][:, 2] = gap[:, axis]
                rows[-1][2][:, 3 + axis] = 1.0
        cell, x, values = self._gathered(rows, (3 + d,))
        self._hold_number = values[:, 0].astype(np.int64)
        ones = np.ones(len(cell))
        self.momentum.holds.place(
            cell, x, ones, stiffness=values[:, 1:2], gap=values[:, 2:3], direction=np.ascontiguousarray(values[:, 3:])
        )

    def _react(self) -> None:
        """Sum the forces of the given displacements."""
        grid, holds = self.grid, self.momentum.holds
        N = grid.shape_values(holds.cells, holds.x)
        u = self.momentum.u.x.array.reshape(-1, grid.dim)[grid.cell_nodes[holds.cells]]
        direction = holds.data["direction"]
        moved = np.einsum("mk,mkd,md->m", N, u, direction)
        force = (holds.data["stiffness"][:, 0] * (holds.data["gap"][:, 0] - moved))[:, None] * direction
        sums = [sum_by(self._hold_number, column, len(self._holds)) for column in force.T]
        self.reactions = grid.comm.allreduce(np.stack(sums, axis=1))

    def _gathered(self, rows: list, shape: tuple[int, ...]) -> tuple[NDArray, NDArray, NDArray]:
        """Send (cells, positions, values) to the owners of the cells; return (owned cells, positions, values)."""
        empty = (np.empty(0, dtype=np.int64), np.empty((0, self.grid.dim)), np.empty((0, *shape)))
        parts = [np.concatenate(column) for column in zip(empty, *rows, strict=True)]
        travel = Exchange(self.grid.comm, self.grid.owner(parts[0]))
        cell, x, values = map(travel.send, parts)
        return self.grid.local(cell), x, values

    def _open_boundary(self) -> None:
        """Set the conductances of drained sides and the inflows."""
        grid, s, d = self.grid, self.storage, self.grid.dim
        cells, conductances, inflows = [], [], []
        for outlet, faces in self._outlets:
            here, at, cell, x = self.placement.surface(faces)
            whole = face_vectors(self.points.corners[at], faces.axis, faces.end)
            area = whole * (faces.area0[here] / faces.whole0[here])[:, None]
            travel = Exchange(grid.comm, grid.owner(cell))
            cell = grid.local(travel.send(cell))
            area, x = travel.send(area), travel.send(x)
            size = np.linalg.norm(area, axis=1)
            cells.append(cell)
            if isinstance(outlet, Inflow):
                conductances.append(np.zeros(len(cell)))
                inflows.append(outlet.flux * size)
                continue
            centre = grid.midpoints[cell] + s.centroid.x.array.reshape(-1, d)[cell]
            distance = np.einsum("md,md->m", x - centre, area) / size
            conductance = s.mobility.x.array[cell] * size / np.maximum(distance, 1e-3 * grid.h.min())
            outer = np.full(len(cell), outlet.pressure)
            if self.gravity is not None:
                outer -= self.fluid.density * (x - centre) @ self.gravity.value
            conductances.append(conductance)
            inflows.append(conductance * outer)
        empty = np.empty(0)
        s.set_fluxes(
            np.concatenate([empty.astype(np.int32), *cells]),
            np.concatenate([empty, *conductances]),
            np.concatenate([empty, *inflows]),
        )

    def _move_points(self) -> None:
        """Move the corners, update F, take the pressures along."""
        with Timer("mpm: move points"):
            grid, points, place = self.grid, self.points, self.placement
            n, d = len(points), grid.dim
            u = self.momentum.u.x.array.reshape(-1, d)
            _, dN = grid.shape_functions(self.pieces.cells, self.pieces.x)
            gradient = u[grid.cell_nodes[self.pieces.cells]].transpose(0, 2, 1) @ dN
            # F_p <- (sum_k w_k Delta_k / V_p) F_p
            mean = [place.mean(column) for column in place.to_pieces(gradient).reshape(-1, d * d).T]
            points.F = (np.eye(d) + np.stack(mean, axis=1).reshape(n, d, d)) @ points.F
            if self.quadrature == "domain":
                corners = points.corners.reshape(-1, d)
                moved = corners + place.displacement(u, np.repeat(np.arange(n), 2**d), corners)
                points.corners = moved.reshape(n, 2**d, d)
                points.x = points.corners.mean(axis=1)
            else:
                points.x = points.x + place.displacement(u, np.arange(n), points.x)
                offset = (corner_bits(d) - 0.5) * self._spacing()[:, None, :]
                points.corners = points.x[:, None] + np.einsum("nab,nkb->nka", points.F, offset)
            if self.storage:
                p = place.to_pieces(self.storage.p.x.array[self.pieces.cells])
                points.pressure = place.mean(p)
                self._carried = carry(points, place.pieces, p)
            self._migrate()

    def _spacing(self) -> NDArray[np.float64]:
        """Reference size of the points' domains (n, d), m."""
        return np.concatenate([np.broadcast_to(b.spacing, b.lower.shape) for b in self.bodies])[self.points.id]

    def _migrate(self) -> None:
        """Send the points whose cell another process owns."""
        grid = self.grid
        if grid.comm.size == 1:
            return
        owner = grid.owner(grid.number(grid.index(self.points.x)))
        if self._carried is not None:
            travel = Exchange(grid.comm, owner[np.searchsorted(self.points.id, self._carried.id)])
            self._carried = self._carried.migrated(travel)
        self.points = self.points.migrated(Exchange(grid.comm, owner))

    @property
    def carried(self) -> Carried | None:
        """Pressures of the points' pieces between two steps; None without fluid."""
        return self._carried

    def restore(self, points: MaterialPoints, carried: Carried | None, t: float) -> None:
        """Put the scene into a state at time t, s: points and pieces, on whatever processes they are."""
        self.points, self._carried, self.t = points, carried, t
        self._prepared = False
        self._migrate()

    def effective_stress(self) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), Pa, tension positive, at the material points."""
        grid, d = self.grid, self.grid.dim
        if self._stress is None:
            state = FormPoints(grid, F=(d, d), **{name: () for name in self._law.parameters})
            F = ufl.variable(state.F)
            energy = self._law.energy(F, **{name: getattr(state, name) for name in self._law.parameters})
            self._stress = PointExpression(ufl.diff(energy, F) * F.T / ufl.det(F), state)
        x, fields = self.points.x, {name: self._fields(self.points.J)[name] for name in ("F", *self._law.parameters)}
        self._stress.points.place(grid.local(grid.number(grid.index(x))), x, self.points.volume0, **fields)
        return self._stress.evaluate()

    # ---- many steps -----------------------------------------------------------------------------

    def run(
        self,
        t_end: float,
        dt: float,
        *,
        probes: Probes | None = None,
        observe: Observer | Sequence[Observer] = (),
        checkpoint: Observer | None = None,
        after: Result | None = None,
        progress: bool = True,
    ) -> Result:
        """Advance to t_end in steps of dt: see `timeloop.run`."""
        options = {"probes": probes, "observe": observe, "checkpoint": checkpoint, "after": after}
        return run(self, t_end, dt, progress=progress, **options)
