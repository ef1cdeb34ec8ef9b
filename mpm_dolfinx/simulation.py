# SPDX-License-Identifier: MIT
"""The time loop: cut the domains by the grid, solve for u and p, move the points, reset the grid."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from dolfinx import fem
from dolfinx.common import Timer
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from mpm_dolfinx import _compat
from mpm_dolfinx.coupling import COUPLINGS, Coupler, NotConverged, Report
from mpm_dolfinx.domains import Pieces, corner_bits, cut
from mpm_dolfinx.exchange import Exchange
from mpm_dolfinx.forms import FormPoints
from mpm_dolfinx.grid import Grid
from mpm_dolfinx.materials import Fluid, Skeleton
from mpm_dolfinx.momentum import FULL, Momentum
from mpm_dolfinx.points import (
    Body,
    MaterialPoints,
    Probes,
    SURFACE,
    Region,
    Surface,
    face_vectors,
    interpolate,
    material_points,
    surface,
)
from mpm_dolfinx.remap import Carried, carry, remap
from mpm_dolfinx.storage import Storage

MIN_CUT = 2.0**-10  # of dt: a step is not cut below this


@dataclass(frozen=True)
class Traction:
    """Dead traction on a side of the bodies.

    Parameters
    ----------
    side
        Side of the bodies, see `grid.SIDES`.
    value : (d,) or callable t -> (d,), Pa
        Force per reference area.
    region : ((d,), (d,)), m
        Box of reference positions to which the traction is limited.
    """

    side: str
    value: ArrayLike | Callable[[float], ArrayLike]
    region: Region | None = None

    def at(self, t: float) -> NDArray[np.float64]:
        """Return the traction (d,) at time t (s), Pa."""
        return np.asarray(self.value(t) if callable(self.value) else self.value, dtype=float)


@dataclass(frozen=True)
class Drained:
    """Side of the bodies, moving with them, at which the pore pressure is given.

    Parameters
    ----------
    side
        Side of the bodies.
    pressure
        Outer pore pressure, Pa.
    region : ((d,), (d,)), m
        Box of reference positions to which the drained faces are limited.
    """

    side: str
    pressure: float = 0.0
    region: Region | None = None


@dataclass(frozen=True)
class Inflow:
    """Side of the bodies through which fluid is pressed in.

    Parameters
    ----------
    side
        Side of the bodies.
    flux
        Volume per area and time into the body, m/s; negative: out of it.
    region : ((d,), (d,)), m
        Box of reference positions to which the faces are limited.
    """

    side: str
    flux: float
    region: Region | None = None


@dataclass
class Result:
    """Histories of a run; one entry an output time, the start included.

    t (s); displacement (m, d) of the probes, m; pressure: least and largest on the points, Pa; and of
    the steps so far: steps, newton, coupling (iterations), balance (worst, relative), cuts.
    """

    t: list[float] = field(default_factory=list)
    displacement: list[NDArray[np.float64]] = field(default_factory=list)
    pressure: list[tuple[float, float]] = field(default_factory=list)
    steps: int = 0
    newton: int = 0
    coupling: int = 0
    cuts: int = 0
    balance: float = 0.0
    residual: float = 0.0
    wall: float = 0.0
    converged: bool = False


class GaveUp(RuntimeError):
    """A step failed however small it was cut; `result` holds the histories up to the last good step."""

    def __init__(self, message: str, result: Result, cause: NotConverged):
        super().__init__(message)
        self.result, self.field, self.history = result, cause.field, cause.history


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
    tractions, drained, inflows
        Boundary conditions on sides of the bodies; other sides are free and sealed.
    gravity : (d,), m/s^2
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
        drained: Sequence[Drained] = (),
        inflows: Sequence[Inflow] = (),
        gravity: ArrayLike | None = None,
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
        self.quadrature, self.gravity = quadrature, None if gravity is None else np.asarray(gravity, dtype=float)
        self.t, self.active_cells = 0.0, 0
        self.points = material_points(grid, bodies, pressure)
        self._loads = [(load, self._faces(bodies, load)) for load in tractions]
        self._outlets = [(outlet, self._faces(bodies, outlet)) for outlet in (*drained, *inflows)]
        self._law = law

        start = time.perf_counter()
        self._build(law, self._fixed_nodes(fixed), coupling, tolerance)
        self.jit = time.perf_counter() - start
        """Seconds spent on compiling or finding the forms."""
        self._carried = carry(self.points) if fluid else None
        self._prepared = False

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
        self.momentum = Momentum(grid, self.pieces, law, fixed, p, self.gravity)
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
        if not self._prepared:
            self._reset_grid()
        self._place_loads(self.t + dt)
        self.momentum.start()
        if self.storage:
            self.storage.start()
        report = self.coupler.solve(dt)
        self._move_points()
        self.t += dt
        self._prepared = False
        return report

    def _reset_grid(self) -> None:
        """Rebuild the integration data on the fresh grid: pieces, active cells, remapped pressure."""
        grid, points = self.grid, self.points
        self._check_inside()
        with Timer("mpm: cut domains"):
            self._cut = cut(grid, points.corners) if self.quadrature == "domain" else self._at_points()
        cutting = self._cut
        self._travel = Exchange(grid.comm, grid.owner(cutting.cell))
        send, at = self._travel.send, cutting.point
        with Timer("mpm: integration data"):
            J = points.J
            self.pieces.place(
                grid.local(send(cutting.cell)),
                send(cutting.x),
                send((cutting.fraction * (points.volume0 * J)[at])),
                **{name: send(values[at]) for name, values in self._fields(J).items()},
            )
            self._activate(J)
        self._prepared = True

    def _check_inside(self) -> None:
        flat = self.points.corners.reshape(-1, self.grid.dim) if self.quadrature == "domain" else self.points.x
        out = np.flatnonzero(self.grid.outside(flat))
        if len(out):
            i = out[0] // (len(flat) // len(self.points))
            raise RuntimeError(
                f"point {self.points.id[i]} at {self.points.x[i]} left the grid "
                f"{self.grid.lower} to {self.grid.upper} at t = {self.t:g} s"
            )

    def _at_points(self) -> Pieces:
        """The seed paper's choice: each point is one piece, in its own cell."""
        grid, x, n = self.grid, self.points.x, len(self.points)
        index = grid.index(x)
        size = np.prod(grid.h) / grid.h
        faces = np.zeros((n, grid.dim, 2))
        count = np.bincount(grid.number(index), minlength=int(np.prod(grid.shape)))[grid.number(index)]
        faces += (size / count[:, None])[:, :, None]  # a cell that holds points has open faces
        return Pieces(np.arange(n), grid.number(index), np.ones(n), x.copy(), faces)

    def _fields(self, J: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return what the points bring to their pieces."""
        fields = {"F": self.points.F}
        for name in self._law.parameters:
            fields[name] = self._table(lambda m, name=name: getattr(m, name))
        n = 1 - (1 - self._table(lambda m: m.porosity)) / J
        if self.fluid:
            alpha, grain = self._table(lambda m: m.biot), self._table(lambda m: m.grain_bulk)
            fields |= {"biot": alpha, "storage": n / self.fluid.bulk + (alpha - n) / grain}
        if self.gravity is not None:
            wet = self.fluid.density if self.fluid else 0.0
            fields["density"] = (1 - n) * self._table(lambda m: m.grain_density) + n * wet
        return fields

    def _activate(self, J: NDArray[np.float64]) -> None:
        """Set the active cells and what they hold."""
        grid, pieces, momentum = self.grid, self.pieces, self.momentum
        weight = pieces.data["weight"][:, 0] * grid.cell_volume
        filled = np.bincount(pieces.cells, weights=weight, minlength=grid.num_local)
        stiffness = np.bincount(
            pieces.cells, weights=weight * self._rows(lambda m: m.oedometric), minlength=grid.num_local
        )
        momentum.fill.x.array[:] = filled / grid.cell_volume
        momentum.modulus.x.array[:] = np.divide(stiffness, filled, out=stiffness, where=filled > 0)
        for f in (momentum.fill, momentum.modulus):
            f.x.scatter_forward()
        fill = momentum.fill.x.array
        active = fill > 0
        cells = np.flatnonzero(active)
        self.active_cells = grid.comm.allreduce(int(active[: grid.num_owned].sum()))
        renumbered = momentum.set_active(active, cells, fill < FULL)
        if self.storage:
            s = self.storage
            if renumbered:
                s.set_active(cells, grid.interior_facets(active, cells))
                s.set_coupled(momentum.unknowns)
            s.set_contents(
                pieces.cells,
                weight,
                pieces.x,
                self._rows(lambda m: m.conductivity) / self.fluid.unit_weight,
                self._travel.send(self._cut.faces),
                pieces.data["storage"][:, 0],
                self._travel.send(remap(self._carried, self.points, self._cut)),
                self._fixed_stress(J),
            )
            self._open_boundary()
        if renumbered:
            self.coupler.set_unknowns()
            self._check_held()

    def _rows(self, value: Callable[[Skeleton], float]) -> NDArray[np.float64]:
        """Return a constant of the materials at the pieces of this process (m,)."""
        return self._travel.send(self._table(value)[self._cut.point])

    def _fixed_stress(self, J: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return beta of the fixed-stress operator at the pieces, 1/Pa, before the scheme's factor."""
        if COUPLINGS[self.coupler.coupling] is None:  # as printed in the paper
            return np.full(len(self.pieces.cells), 1 / self.fluid.bulk)
        beta = self._table(lambda m: m.biot**2 / m.drained_modulus(self.grid.dim)) * J
        return self._travel.send(beta[self._cut.point])

    def _check_held(self) -> None:
        """Refuse a scene whose body can move as a rigid body: its tangent is singular."""
        grid, momentum = self.grid, self.momentum
        nodes = np.zeros(len(grid.node_x), dtype=bool)
        nodes[grid.cell_nodes[np.flatnonzero(momentum.fill.x.array > 0)]] = True
        held = nodes[:, None] & ~momentum.free
        modes, d = [np.tile(e, (len(nodes), 1)) for e in np.eye(grid.dim)], grid.dim
        for a in range(d):
            for b in range(a):
                rotation = np.zeros((len(nodes), d))
                rotation[:, a], rotation[:, b] = grid.node_x[:, b], -grid.node_x[:, a]
                modes.append(rotation / (grid.upper - grid.lower).max())
        R = np.stack([m[held] for m in modes], axis=1)
        gram = grid.comm.allreduce(R.T @ R)
        missing = len(modes) - np.linalg.matrix_rank(gram, tol=1e-12 * max(1.0, np.abs(gram).max()))
        if missing:
            raise ValueError(
                f"fixed walls: the body is free to move as a rigid body in {missing} of {len(modes)} ways; "
                "it must touch walls whose fixed components hold it"
            )

    def _surface_points(self, faces: Surface):
        """Return (faces of this process, their points, cells, positions on the surface).

        The cell is that of a place just under the surface, which holds a piece of the domain: its
        shape functions, continued to the surface, put the load on nodes that have stiffness.
        """
        here, at = self.points.find(faces.id)
        corners, xi = self.points.corners[at], faces.xi[here].copy()
        xi[:, faces.axis] *= SURFACE
        cell, _ = self._filled_cell(at, interpolate(corners, xi))
        return here, at, cell, interpolate(corners, faces.xi[here])

    def _filled_cell(self, at: NDArray[np.int64], x: NDArray[np.float64]):
        """Return the cells of positions in domains, and whether a piece of the domain lies there.

        Where none does, the cell is that of the domain's largest piece.
        """
        grid, cutting = self.grid, self._cut
        cell = grid.number(grid.index(x))
        cells = int(np.prod(grid.shape))
        key, keys = at * cells + cell, cutting.point * cells + cutting.cell
        found = np.searchsorted(keys, key)
        inside = keys[np.minimum(found, len(keys) - 1)] == key if len(keys) else np.zeros(0, dtype=bool)
        if not inside.all():
            cell = np.where(inside, cell, cutting.cell[self._largest()[at]])
        return cell, inside

    def _largest(self) -> NDArray[np.int64]:
        """Largest piece of each point (n,)."""
        order = np.lexsort((self._cut.fraction, self._cut.point))
        last = np.cumsum(np.bincount(self._cut.point, minlength=len(self.points))) - 1
        return order[last]

    def _place_loads(self, t: float) -> None:
        """Put the dead loads of time t on the surface."""
        cells, xs, forces = [], [], []
        for load, faces in self._loads:
            here, _, cell, x = self._surface_points(faces)
            cells.append(cell)
            xs.append(x)
            forces.append(faces.area0[here, None] * load.at(t))
        d = self.grid.dim
        cell = np.concatenate([np.empty(0, dtype=np.int64), *cells])
        travel = Exchange(self.grid.comm, self.grid.owner(cell))
        cell, x, force = (
            travel.send(a) for a in (cell, np.concatenate([np.empty((0, d)), *xs]), np.concatenate([np.empty((0, d)), *forces]))
        )
        self.momentum.loads.place(self.grid.local(cell), x, np.ones(len(cell)), force=force)
        self.momentum.set_loads()

    def _open_boundary(self) -> None:
        """Set the conductances of drained sides and the inflows."""
        grid, s, d = self.grid, self.storage, self.grid.dim
        cells, conductances, inflows = [], [], []
        for outlet, faces in self._outlets:
            here, at, cell, x = self._surface_points(faces)
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
                outer -= self.fluid.density * (x - centre) @ self.gravity
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
            grid, points, cutting = self.grid, self.points, self._cut
            n, d = len(points), grid.dim
            u = self.momentum.u.x.array.reshape(-1, d)
            nodes, pieces = grid.cell_nodes, self.pieces
            _, dN = grid.shape_functions(pieces.cells, pieces.x)
            gradient = np.einsum("mka,mkb->mab", u[nodes[pieces.cells]], dN)
            gradient = self._travel.back(gradient).reshape(-1, d * d)
            # F_p <- (sum_k w_k Delta_k / V_p) F_p
            mean = [np.bincount(cutting.point, cutting.fraction * column, minlength=n) for column in gradient.T]
            delta = np.eye(d) + np.stack(mean, axis=1).reshape(n, d, d)
            points.F = delta @ points.F
            if self.quadrature == "domain":
                count = 2**d
                moved = points.corners.reshape(-1, d)
                points.corners = (moved + self._displacement(np.repeat(np.arange(n), count), moved)).reshape(n, count, d)
                points.x = points.corners.mean(axis=1)
            else:
                points.x = points.x + self._displacement(np.arange(n), points.x)
                offset = (corner_bits(d) - 0.5) * self._spacing()[:, None, :]
                points.corners = points.x[:, None] + np.einsum("nab,nkb->nka", points.F, offset)
            if self.storage:
                p = self._travel.back(self.storage.p.x.array[pieces.cells])
                points.pressure = np.bincount(cutting.point, cutting.fraction * p, minlength=n)
                self._carried = carry(points, cutting, p)
            self._migrate()

    def _displacement(self, at: NDArray[np.int64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, at positions in the domains of points `at`."""
        grid = self.grid
        cell, _ = self._filled_cell(at, x)
        travel = Exchange(grid.comm, grid.owner(cell))
        cells, x = grid.local(travel.send(cell)), travel.send(x)
        N, _ = grid.shape_functions(cells, x)
        u = self.momentum.u.x.array.reshape(-1, grid.dim)
        return travel.back(np.einsum("mk,mkd->md", N, u[grid.cell_nodes[cells]]))

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

    # ---- many steps -----------------------------------------------------------------------------

    def run(
        self,
        t_end: float,
        dt: float,
        *,
        probes: Probes | None = None,
        observe: Callable[[Simulation], None] | None = None,
        progress: bool = True,
    ) -> Result:
        """Advance to t_end in steps of dt; a step that does not converge is cut in two, and grows again.

        Parameters
        ----------
        t_end
            End time, s.
        dt
            Step and output interval, s, > 0.
        probes
            Particles whose displacement is recorded.
        observe
            Called after each output interval.
        progress
            Show a progress bar on a terminal.

        Raises
        ------
        GaveUp
            With the histories so far; `points` and `t` are those of the last good step.
        """
        if not (dt > 0 and t_end > self.t):
            raise ValueError(f"dt = {dt!r}, t_end = {t_end!r}: must be dt > 0 and t_end > {self.t:g}")
        result, start, small = Result(), self.t, dt
        self._record(result, probes)
        intervals = max(1, round((t_end - start) / dt))
        began = time.perf_counter()
        quiet = None if progress and self.grid.comm.rank == 0 else True
        with tqdm(total=intervals, disable=quiet, unit="step") as bar:
            for k in range(1, intervals + 1):
                target = t_end if k == intervals else start + k * dt
                while target - self.t > 1e-9 * dt:
                    small = self._try(min(small, target - self.t), dt, result)
                self.t = target
                self._record(result, probes)
                result.wall = time.perf_counter() - began
                if observe is not None:
                    observe(self)
                bar.set_postfix(t=f"{self.t:.4g} s", newton=result.newton, coupling=result.coupling)
                bar.update()
        result.converged = True
        return result

    def _try(self, small: float, dt: float, result: Result) -> float:
        """Take one step of at most `small`, cutting it until it converges; return the next step to try."""
        while True:
            try:
                report = self.step(small)
            except NotConverged as failed:
                result.cuts += 1
                if small / 2 < MIN_CUT * dt:
                    raise GaveUp(f"gave up at t = {self.t:g} s with dt = {small:.3g} s: {failed}", result, failed) from failed
                small /= 2
                continue
            result.steps += 1
            result.newton += report.newton
            result.coupling += report.coupling
            result.balance = max(result.balance, report.balance)
            result.residual = max(result.residual, *report.history[-1])
            return min(2 * small, dt)

    def _record(self, result: Result, probes: Probes | None) -> None:
        comm = self.grid.comm
        result.t.append(self.t)
        if probes is not None:
            result.displacement.append(probes.displacement(self.points, comm))
        if self.fluid:
            p = self.points.pressure
            ends = comm.allgather((p.min(initial=np.inf), p.max(initial=-np.inf)))
            result.pressure.append((min(e[0] for e in ends), max(e[1] for e in ends)))
