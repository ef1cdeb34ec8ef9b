# SPDX-License-Identifier: MIT
"""A scene and one step of it: cut the domains by the grid, solve for u and p, move the points, reset the grid."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from dolfinx import fem
from dolfinx.common import Timer
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx import summary
from mpm_dolfinx.boundary import Boundary
from mpm_dolfinx.check import all_of, asked, chosen, flag, functions, instance, line, numbers
from mpm_dolfinx.conditions import Displacement, Drained, Inflow, RigidPlate, Traction
from mpm_dolfinx.coupling import COUPLINGS, Coupler, NotConverged, Report
from mpm_dolfinx.domains import parallelepipeds, tangled
from mpm_dolfinx.exchange import Exchange
from mpm_dolfinx.extend import compiling
from mpm_dolfinx.forms import FormPoints
from mpm_dolfinx.grid import Grid, sum_by
from mpm_dolfinx.held import check_held
from mpm_dolfinx.laws import ConductivityAtPieces, SceneMaterials
from mpm_dolfinx.materials import Fluid, Skeleton
from mpm_dolfinx.momentum import FULL, Momentum
from mpm_dolfinx.placement import Placement
from mpm_dolfinx.points import Body, MaterialPoints, Probes, check_apart, check_inside, material_points
from mpm_dolfinx.remap import Carried, at_start, remap
from mpm_dolfinx.storage import Storage
from mpm_dolfinx.thin import warn_thin
from mpm_dolfinx.timeloop import Observer, Result, run
from mpm_dolfinx.unknowns import collect_garbage

CONDITIONS = {
    "tractions": Traction,
    "displacements": Displacement,
    "drained": Drained,
    "inflows": Inflow,
    "plates": RigidPlate,
}


class Simulation:
    """A scene and its state.

    Parameters
    ----------
    grid
        Background grid.
    bodies
        Seeded bodies.
    materials
        Material of each index that the bodies name.
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
    terms, sources
        Functions that give terms of the user's own to the two balances in UFL: see `extend`.
    later
        Indices of bodies that a later stage adds.
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
        terms: Sequence[Callable] = (),
        sources: Sequence[Callable] = (),
        later: Sequence[int] = (),
    ):
        if quadrature not in ("domain", "point"):
            raise ValueError(f"quadrature {quadrature!r}: must be domain or point")
        if not isinstance(coupling, str) or coupling not in COUPLINGS:
            raise ValueError(f"coupling {coupling!r}: must be one of {', '.join(COUPLINGS)}")
        if fluid is None and sources:
            raise ValueError("sources need a fluid")
        instance("grid", grid, Grid)
        all_of("bodies", bodies, Body, 1)
        all_of("materials", materials, Skeleton, 1)
        if fluid is not None:
            instance("fluid", fluid, Fluid)
        elif numbers("pressure", pressure):
            raise ValueError(f"pressure = {line(pressure)}: needs a fluid")
        chosen("later", later, range(len(bodies)), "indices of the bodies")
        functions("terms", terms)
        functions("sources", sources)
        for i, body in enumerate(bodies):
            if body.lower.shape[1] != grid.dim:
                raise ValueError(f"body {i}: has {body.lower.shape[1]} coordinates, must have the grid's {grid.dim}")
            check_inside(grid, body, f"body {i}")
        self.grid, self.materials, self.fluid, self.bodies = grid, materials, fluid, bodies
        self.quadrature = quadrature
        grid.share(np.concatenate([body.centre for body in bodies]))
        self.gravity = None if gravity is None else fem.Constant(grid.mesh, np.zeros(grid.dim))
        self.t, self.active_cells = 0.0, 0
        self.points = material_points(grid, bodies, pressure)
        self._scene = SceneMaterials(grid, materials, bodies, self.points)
        self.present = [body not in later for body in range(len(bodies))]
        """Which bodies are there."""
        check_apart(bodies, self.present)
        warn_thin(grid, bodies, fixed)
        self.placement: Placement | None = None
        """The domains as they have been cut; None where they are to be cut anew."""
        self.resets = 0
        """How often the grid has been reset, and the domains cut."""

        start = time.perf_counter()
        self._build(self._fixed_nodes(fixed), coupling, tolerance, terms, sources)
        self._conditions: dict[str, Any] = {}
        self._set_conditions(
            self.present,
            fixed=fixed,
            tractions=tractions,
            displacements=displacements,
            drained=drained,
            inflows=inflows,
            plates=plates,
            gravity=gravity,
        )
        self.jit = time.perf_counter() - start
        """Seconds spent on compiling or finding the forms."""
        self._carried = at_start(self.points) if fluid else None
        self._waiting = {body: self._take(body) for body in later}
        self._prepared = False
        self.result: Result | None = None
        """Histories of the last run, also while it runs."""

    def __str__(self) -> str:
        """Return a table of the terms and solvers that the scene has, and why it does without the others."""
        return summary.table(self)

    # ---- building -------------------------------------------------------------------------------

    def _fixed_nodes(self, fixed: Mapping[str, str]) -> NDArray[np.bool_]:
        d = self.grid.dim
        out = np.zeros((len(self.grid.node_x), d), dtype=bool)
        if not isinstance(fixed, Mapping):
            raise ValueError(f"fixed = {line(fixed)}, must be walls with their components, such as {{'left': 'xy'}}")
        for wall, axes in fixed.items():
            if not isinstance(axes, str) or not axes or any(a not in "xyz"[:d] for a in axes):
                raise ValueError(f"fixed wall {wall!r}: components {axes!r}, must be some of {'xyz'[:d]!r}")
            for a in axes:
                out[self.grid.wall_nodes(wall), "xyz".index(a)] = True
        return out

    def _build(self, fixed: NDArray[np.bool_], coupling: str, tolerance: float, terms, sources) -> None:
        """Compile the forms that the scene needs."""
        grid, d, fluid, scene = self.grid, self.grid.dim, self.fluid, self._scene
        shapes: dict[str, tuple[int, ...]] = {"F": (d, d), **scene.shapes}
        if fluid:
            shapes |= {"biot": (), "storage": ()}
        if self.gravity is not None:
            shapes |= {"density": ()}
        self._extended = bool(terms or sources)
        if self._extended:
            shapes |= {
                "position": (d,),
                "displacement": (d,),
                **{name: v.shape[1:] for name, v in self.points.data.items()},
            }
        if fluid and scene.conductivity_laws:
            shapes |= {"position": (d,), "conductivity": (), "porosity0": ()}
        self.pieces = FormPoints(grid, **shapes)
        self.laws = scene.parts(self.pieces, ["F", "biot"] if fluid else ["F"])
        p = fem.Function(grid.cellwise()) if fluid else None
        options = {"mean_dilatation": scene.nearly_incompressible, "symmetric": scene.symmetric}
        with compiling(f"materials: {', '.join(law.__name__ for law in scene.laws)}", "laws in UFL of these shapes"):
            self.momentum = Momentum(grid, self.pieces, self.laws, fixed, p, self.gravity, **options)
        self._time, self._dt = fem.Constant(grid.mesh, 0.0), fem.Constant(grid.mesh, 1.0)
        for term in terms:
            self.momentum.add(term, self._time, self._dt)
        self.storage = None
        if not self.momentum.symmetric and coupling == "schur-cg":
            coupling = "schur-fgmres"
        if fluid:
            weight = None if self.gravity is None else fluid.density * self.gravity
            self.storage = Storage(
                grid, self.pieces, self.momentum.u, p, weight, coupling != "schur-fgmres", scene.conducts
            )
            for source in sources:
                self.storage.add(source, self._time)
            self._conductivity = ConductivityAtPieces(scene, self.pieces)
        self.coupler = Coupler(self.momentum, self.storage, coupling, tolerance)

    # ---- stages ---------------------------------------------------------------------------------

    def stage(
        self,
        *,
        fixed: Mapping[str, str] | None = None,
        tractions: Sequence[Traction] | None = None,
        displacements: Sequence[Displacement] | None = None,
        drained: Sequence[Drained] | None = None,
        inflows: Sequence[Inflow] | None = None,
        plates: Sequence[RigidPlate] | None = None,
        gravity: ArrayLike | Callable[[float], ArrayLike] | None = None,
        add: Sequence[int] = (),
        remove: Sequence[int] = (),
        reset_displacement: bool = False,
    ) -> None:
        """Begin a stage: bodies come and go; conditions that are named take the place of those so far.

        Stresses and pressures stay what they are; the next `run` finds the new balance, all at once or, where
        loads depend on time, little by little.

        Parameters
        ----------
        fixed, tractions, displacements, drained, inflows, plates, gravity
            As for the scene; `gravity` only if the scene had it.
        add
            Indices of bodies that were to come `later`: a fill, at rest and without stress where it was seeded.
        remove
            Indices of bodies: an excavation.
        reset_displacement
            From now on displacements count from the present positions.
        """
        if gravity is not None and self.gravity is None:
            raise ValueError("gravity: the scene was made without, must be made with (0, 0) first")
        chosen("stage: remove", remove, np.flatnonzero(self.present).tolist(), "bodies that are present")
        chosen("stage: add", add, list(self._waiting), "bodies that are to come later")
        flag("stage: reset_displacement", reset_displacement)
        present = [(here and body not in remove) or body in add for body, here in enumerate(self.present)]
        check_apart(self.bodies, present)
        named = {"fixed": fixed, "tractions": tractions, "displacements": displacements, "drained": drained}
        named |= {"inflows": inflows, "plates": plates, "gravity": gravity}
        self._set_conditions(present, **{name: value for name, value in named.items() if value is not None})
        for body in remove:
            self._take(body)
        for body in add:
            points = self._waiting.pop(body)
            self.present[body] = True
            self.points = self.points.joined(points)
            if self._carried is not None:
                self._carried = self._carried.joined(at_start(points))
        if reset_displacement:
            self.points.origin = self.points.corners.copy()

    def _take(self, body: int) -> MaterialPoints:
        """Take a body away; return its points."""
        self.present[body] = False
        start = sum(len(b) for b in self.bodies[:body])
        mine = (self.points.id >= start) & (self.points.id < start + len(self.bodies[body]))
        taken, self.points = self.points.map(lambda rows: rows[mine]), self.points.map(lambda rows: rows[~mine])
        if self._carried is not None:
            self._carried = self._carried.kept(self.points.id)
        return taken

    def _set_conditions(self, present: Sequence[bool], **conditions) -> None:
        """Take over the conditions that are named, on the bodies that are there, or none if one is refused."""
        now = self._conditions | conditions
        for name, kind in CONDITIONS.items():
            all_of(name, now[name], kind)
        if self.fluid is None and (now["drained"] or now["inflows"]):
            raise ValueError("drained and inflow sides need a fluid")
        if now["gravity"] is not None and not callable(now["gravity"]):
            self._gravity(now["gravity"], "gravity")
        fixed = self._fixed_nodes(now["fixed"])
        self.boundary = side = Boundary(
            self.grid,
            self.bodies,
            present,
            self._scene.stiffest,
            now["tractions"],
            now["displacements"],
            now["plates"],
            [*now["drained"], *now["inflows"]],
        )
        self._conditions, self._begins = now, True
        self.reactions = np.zeros((len(now["displacements"]), self.grid.dim))
        """(displacements, d): force by which each given displacement acts on the bodies, N (N/m in plane strain)."""
        self.momentum.require(bool(side.loads), bool(side.plates), bool(side.holds))
        self.momentum.fix(fixed)
        self._leave_grid()
        self._prepared = False

    def _gravity(self, value: ArrayLike, name: str) -> NDArray[np.float64]:
        """Return a given acceleration of gravity (d,), m/s^2; `name` for the message of one that is not."""
        return numbers(name, value, (self.grid.dim,), allowed=f"{self.grid.dim} finite numbers")

    def _table(self, value: Callable[..., float], *columns: NDArray) -> NDArray[np.float64]:
        """Return a constant of the materials at the points (n,); `value` also takes columns (n,) of the points."""
        return self._scene.table(self.points, value, *columns)

    # ---- one step -------------------------------------------------------------------------------

    def step(self, dt: float) -> Report:
        """Advance by dt (s).

        Raises
        ------
        NotConverged
            The state is then still that before the step.
        """
        numbers("dt", dt, test=lambda v: (0 < v) & (v < np.inf), allowed="> 0 and finite")
        self._begin(self.t + dt)
        report = self.coupler.solve(dt)
        if self.boundary.holds:
            self.reactions = self.boundary.reactions(self.momentum)
        report.rederived = self._move_points()
        self.t += dt
        self._prepared = False
        return report

    def _begin(self, t: float) -> None:
        """Set up the step that ends at time t: grid, loads of that time, u = 0 and the cells' pressure."""
        collect_garbage(self.grid.mesh.comm)
        self._time.value, self._dt.value = t, t - self.t
        if self.gravity is not None:
            given, name = self._conditions["gravity"], f"gravity at t = {t:g} s"
            given = asked(name, f"{self.grid.dim} numbers for a time", given, t) if callable(given) else given
            self.gravity.value = self._gravity(given, name)
        fresh = not self._prepared and not self._stays()
        if fresh:
            self._reset_grid()
        else:
            if not self._prepared:
                self._stay()
            if self.gravity is not None and self.storage:
                self._open_outlets()  # with the gravity of another time
        self._place_loads(t)
        if fresh:
            self.momentum.set_penalty()
            if self._renumbered and not self.momentum.holding:
                self._check_held()
        self._prepared = True
        self.momentum.start()
        if self.storage:
            self.storage.start(t - self.t)

    def _stays(self) -> bool:
        """Return whether the points have moved so little that nothing need be cut or remapped."""
        changing = self.fluid is not None and self._scene.conductivity_laws
        return self.placement is not None and not changing and self.placement.serves()

    def _stay(self) -> None:
        """Bring the integration data to where the points are now, in the same cells."""
        with Timer("mpm: integration data"):
            J = self.points.J
            self.pieces.renew(self._weight(J), **self._values(self._changing(J)), **self._piece_fields())
            self._part_laws()
            if self.momentum.plates is not None:
                self.boundary.place_plates(self.placement, self.momentum)
            if self.storage:
                self.storage.p_n.x.array[:] = self.storage.p.x.array

    def _leave_grid(self) -> None:
        """Let the points take the pressures of their pieces along; the domains are cut anew in the next step."""
        if self.placement is not None and self.storage:
            with Timer("mpm: remap"):
                self._carried = self._carry()
        self.placement = None

    def _reset_grid(self) -> None:
        """Rebuild the integration data on the fresh grid: pieces, active cells, remapped pressure."""
        self.resets += 1
        self._leave_grid()
        self._migrate()
        with Timer("mpm: cut domains"):
            place = Placement(self.grid, self.points, self.quadrature, self.t)
        if self.storage:
            with Timer("mpm: remap"):
                self._brought = remap(self._carried, self.points, place.pieces)
                self._travelled = np.zeros_like(place.pieces.x)
        with Timer("mpm: integration data"):
            self.placement, J = place, self.points.J
            fields = self._values({**self._scene.values(self.points), **self._constants(), **self._changing(J)})
            self.pieces.place(place.cells, place.x, self._weight(J), **fields, **self._piece_fields())
            self._part_laws()
            self._activate(J)

    def _weight(self, J: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the volumes of the pieces (m,), m^d, on the owners of their cells."""
        pieces = self.placement.pieces
        return self.placement.pieces_to_cells(pieces.fraction * (self.points.volume0 * J)[pieces.point])

    def _values(self, fields: Mapping[str, NDArray]) -> dict[str, NDArray]:
        """Return fields of the points at their pieces, on the owners of their cells."""
        return {name: self.placement.to_cells(values) for name, values in fields.items()}

    def _part_laws(self) -> None:
        """Give each of several laws the pieces that follow it."""
        if len(self.laws) > 1:
            law = self.placement.to_cells(self._scene.law_of(self.points))
            for number, (_, part) in enumerate(self.laws):
                part.take(self.pieces, np.flatnonzero(law == number))

    def _constants(self) -> dict[str, NDArray[np.float64]]:
        """Return what the materials bring to their pieces for good."""
        fields = {}
        if self.fluid:
            fields["biot"] = self._table(lambda m: m.biot)
            if self._scene.conductivity_laws:
                fields["conductivity"] = self._table(lambda m: m.conductivity)
                fields["porosity0"] = self._table(lambda m: m.porosity)
        return fields

    def _changing(self, J: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return what the points bring to their pieces and what changes with them."""
        points = self.points
        fields = {"F": points.F, **self._scene.state(points)}
        if self._extended:  # what laws take is known for all materials, and zero in `data` for those of other points
            fields |= {name: rows for name, rows in points.data.items() if name not in self._scene.shapes}
        if not self.fluid and self.gravity is None:
            return fields
        n = 1 - (1 - self._table(lambda m: m.porosity)) / J
        if self.fluid:
            fields["storage"] = self._table(lambda m, n: m.storage(self.fluid.bulk, n), n)
        if self.gravity is not None:
            wet = self.fluid.density if self.fluid else 0.0
            fields["density"] = (1 - n) * self._table(lambda m: m.grain_density) + n * wet
        return fields

    def _piece_fields(self) -> dict[str, NDArray[np.float64]]:
        """Return what differs from piece to piece of a point, where functions of the user's may ask for it."""
        fields = {}
        if self._extended or (self.fluid and self._scene.conductivity_laws):
            fields["position"] = self.placement.pieces.x
        if self._extended:
            fields["displacement"] = self._displacement()
        return {name: self.placement.pieces_to_cells(values) for name, values in fields.items()}

    def _displacement(self) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, of the pieces' centroids, as those of their domains' corners."""
        points, pieces = self.points, self.placement.pieces
        now, then = (c - c.mean(axis=1, keepdims=True) for c in (points.corners, points.origin))
        stretch = np.linalg.solve(then.swapaxes(1, 2) @ then, then.swapaxes(1, 2) @ now)  # of the corners' pattern
        off = pieces.x - points.x[pieces.point]
        off0 = np.linalg.solve(stretch.swapaxes(1, 2)[pieces.point], off[:, :, None])[:, :, 0]
        return off + (points.x - points.origin.mean(axis=1))[pieces.point] - off0

    def _mobility(self) -> NDArray[np.float64]:
        """Return the mobility k / (rho_w g) at the pieces (m,), m^2/(Pa s)."""
        if not self._scene.conductivity_laws:
            return self._rows(lambda m: m.conductivity) / self.fluid.unit_weight
        return self._conductivity.evaluate(self.placement.to_cells(self.points.material)) / self.fluid.unit_weight

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
        if momentum.plates is not None:
            self.boundary.place_plates(self.placement, self.momentum)
        if self.storage:
            s = self.storage
            if renumbered:
                s.set_active(cells, facets)
                s.set_coupled(momentum.unknowns)
            s.set_contents(
                pieces.cells,
                weight,
                pieces.x,
                self._mobility(),
                self.placement.pieces_to_cells(self.placement.pieces.faces),
                pieces.data["storage"][:, 0],
                self.placement.pieces_to_cells(self._brought),
                self._fixed_stress(J),
                self._rows(lambda m: m.pressure_damping(grid.dim)),
            )
            self._open_outlets()
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
        """Refuse a scene whose body can move as a rigid body; at the start of a stage, any part of it."""
        momentum, holds = self.momentum, self.momentum.holds
        held = (holds.cells, holds.x, holds.data["direction"]) if self.boundary.holds else None
        check_held(self.grid, momentum.fill.x.array > 0, momentum.free, held, self._begins)
        self._begins = False

    def _place_loads(self, t: float) -> None:
        """Put the loads and given displacements of time t on the surface."""
        with Timer("mpm: loads"):
            if self.momentum.loads is not None:
                self.boundary.place_loads(self.placement, self.momentum, t)
            if self.momentum.holds is not None:
                self.boundary.place_holds(self.placement, self.momentum, t)
            self.momentum.set_loads()

    def _open_outlets(self) -> None:
        weight = None if self.gravity is None else self.fluid.density * self.gravity.value
        self.boundary.open_outlets(self.placement, self.storage, weight)

    def _move_points(self) -> int:
        """Move the corners, update F, take the pressures along; return how many domains had folded."""
        folded = 0
        with Timer("mpm: move points"):
            grid, points, place = self.grid, self.points, self.placement
            n, d = len(points), grid.dim
            u = self.momentum.u.x.array.reshape(-1, d)
            N, dN = grid.shape_functions(self.pieces.cells, self.pieces.x)
            at_nodes = u[grid.cell_nodes[self.pieces.cells]].transpose(0, 2, 1)
            gradient = at_nodes @ dN
            delta = np.eye(d) + gradient
            if self.momentum.dilatation is not None:
                delta = self.momentum.dilatation.averaged(delta)
            # F_p <- (sum_k w_k Delta_k / V_p) F_p
            mean = [place.mean(column) for column in place.to_pieces(delta).reshape(-1, d * d).T]
            F = np.stack(mean, axis=1).reshape(n, d, d) @ points.F
            self._check_volumes(np.linalg.det(F))
            self._scene.update_state(replace(points, F=F))
            points.F = F
            moved = place.displacement(u, corners=self.quadrature == "domain")
            if self.quadrature == "domain":
                points.corners = points.corners + moved
                points.x = points.corners.mean(axis=1)
                folded = self._untangle()
            else:
                points.x = points.x + moved
                points.corners = parallelepipeds(points.x, points.F, self._spacing())
            if self.storage:
                points.pressure = place.mean(place.to_pieces(self.storage.p.x.array[self.pieces.cells]))
                self._travelled += place.to_pieces((at_nodes @ N[:, :, None])[:, :, 0])
        return folded

    def _carry(self) -> Carried:
        """Return the pressures that the pieces take along."""
        points, place, pieces, J = self.points, self.placement, self.placement.pieces, self.points.J
        n = 1 - (1 - self._table(lambda m: m.porosity)) / J
        store = self._table(lambda m, n: m.storage(self.fluid.bulk, n), n) * points.volume0 * J
        at_pieces = self.storage.at_pieces(place.pieces_to_cells(pieces.fraction * store[pieces.point]))
        pressure, slope, bounds = map(place.to_pieces, at_pieces)
        x = pieces.x + self._travelled
        return Carried(points.id[pieces.point], pieces.cell, pieces.fraction, pressure, x, slope, bounds)

    def _check_volumes(self, J: NDArray[np.float64]) -> None:
        """Refuse what a law may allow and a body does not: points turned inside out, pores of no volume."""
        least = 1 - self._table(lambda m: m.porosity) if self.fluid else np.zeros(len(J))
        bad = np.flatnonzero(J <= least)
        if self.grid.comm.allreduce(len(bad)):
            shown = [f"point {self.points.id[i]} at {self.points.x[i]} with J = {J[i]:.3g}" for i in bad[:1]]
            what = "the pores have closed" if self.fluid else "the body is turned inside out"
            raise NotConverged(f"{what}, J <= {least.max(initial=0):.3g}: {', '.join(shown) or 'elsewhere'}", [])

    def _untangle(self) -> int:
        """Re-derive from F the domains that have folded: points whose neighbours went elsewhere."""
        points, grid = self.points, self.grid
        bad = np.flatnonzero(tangled(points.corners, points.volume0 * points.J))
        if len(bad):
            corners = parallelepipeds(points.x[bad], points.F[bad], self._spacing()[bad])
            points.corners[bad] = np.clip(corners, grid.lower, grid.upper)
            points.x[bad] = points.corners[bad].mean(axis=1)
        return grid.comm.allreduce(len(bad))

    def _spacing(self) -> NDArray[np.float64]:
        """Reference size of the points' domains (n, d), m."""
        return np.concatenate([b.size() for b in self.bodies])[self.points.id]

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
        """Pressures of the points' pieces between two steps, None without fluid; the next step cuts them anew."""
        self._leave_grid()
        return self._carried

    def restore(self, points: MaterialPoints, carried: Carried | None, t: float) -> None:
        """Put the scene into a state at time t, s: points and pieces, on whatever processes they are."""
        self.points, self._carried, self.t = points, carried, t
        self._prepared, self.placement = False, None
        self._begins = False  # parts that have torn off since are what they are
        if self.active_cells:  # of a step that was taken before
            self.coupler.forget()
        self._migrate()

    def effective_stress(self) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), Pa, tension positive, at the material points."""
        return self._scene.effective_stress(self.points)

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
