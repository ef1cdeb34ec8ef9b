# SPDX-License-Identifier: MIT
"""Start of a step, and the balances of momentum and fluid at the end of each substep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.time_integration import Substep
from mpm_dolfinx.conditions.acting import QUANTITIES, At, Loads, Outcome, Shares
from mpm_dolfinx.dynamics.motion_error import motion_error
from mpm_dolfinx.flow.storage import FluidInertia, Rates, StorageProblem
from mpm_dolfinx.mechanics.inertia import Flight, Inertia, affine
from mpm_dolfinx.mechanics.momentum import MomentumProblem
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.grid_reset import Assembled, OnGrid
from mpm_dolfinx.stepping.scene import Scene, When
from mpm_dolfinx.stepping.state import State


class Acting(NamedTuple):
    """Loads of a substep."""

    substep: Substep  # time weights of the substep
    t: float  # time at the end of the substep, s
    loads: Sequence[Loads]
    gravity: NDArray[np.float64] | None  # (d,), m/s^2


class Start(NamedTuple):
    """Data at the start of a step: state, integration points, matrices and loads."""

    state: State
    on_grid: OnGrid
    data: QuadratureData
    matrices: Assembled
    dt: float  # length of the step, s
    yielded: bool  # whether soil has yielded in an earlier step, on any process
    acting: list[Acting]  # loads of each substep
    renewed: int = 0  # number of renewed particle domains
    due: NDArray[np.float64] | None = None  # corrections of volume defects, see `OnGrid.start`

    @property
    def rate(self) -> float:
        """Derivative of acceleration with respect to displacement, equal in all substeps, in 1/s^2."""
        return 1 / float(self.acting[0].substep.own * self.dt) ** 2

    def begun(self, acting: Acting, earlier: Sequence[Any] | None) -> Acting:
        """Return the loads at the beginning of a substep. `earlier`: data of the loads in the previous substep."""
        if not self.state.stage.inertia:
            return acting
        shares = Shares(acting.substep.own * self.dt, acting.substep.before * self.dt, acting.gravity)
        before = earlier or [None] * len(acting.loads)
        return acting._replace(loads=[one.begun(shares, of) for one, of in zip(acting.loads, before, strict=True)])

    def carrying(self, flight: Flight | None) -> Callable[[NDArray | None], dict[str, NDArray]] | None:
        """Return the argument `carried` of `Motion.advanced`, or None without inertia."""
        if flight is None:
            return None
        velocities = flight.start, flight.velocity
        return partial(self.matrices.mass.carried, self.state.points, velocities, self.rate)

    def moves(self, flights: Sequence[Flight | None], substep: Substep) -> tuple[float, float]:
        """Return the error and the size of the motion in the step (`motion_error`), or zeros if the run needs neither.

        `flights`: velocities after each substep.  The list is empty if the bodies have not moved.
        """
        control = self.state.control
        if control is None or control.motion is None or len(flights) < 2:
            return 0.0, 0.0
        times = float(substep.before * self.dt), float(substep.own * self.dt)
        made = self.matrices
        return motion_error(made.solvers, made.momentum.K, made.mass, flights, *times, control.drift)


class Balances(NamedTuple):
    """The balances of momentum and fluid at the end of a substep.  `storage` is None without fluid."""

    momentum: MomentumProblem
    storage: StorageProblem | None
    inertia: Inertia | None = None
    ahead: Callable[[], list[NDArray[np.float64]]] | None = None  # see `Motion.ahead`; None without a trend

    def flown(self, flight: Flight | None, substep: Substep, dt: float) -> Flight | None:
        """Return the velocities at the end of a solved substep, or None without inertia.

        `dt`, s: length of the step.
        """
        if self.inertia is None:
            return None
        acceleration = self.inertia.acceleration(self.momentum.at)
        return flight.after(acceleration, float(substep.own * dt), float(substep.before * dt))

    def results(self, state: State, last: bool) -> Outcome:
        """Return the results of conditions at the end of a substep, by quantity and name.

        `last`: whether the substep is the last one.  Earlier substeps need only the results that are integrated.
        """
        out = self.storage.outcome() if self.storage else {}
        if last or self.inertia:
            out |= self.momentum.outcome()
            out["wall_reactions"] = self.momentum.wall_forces(state.stage.conditions["walls"])
        return out

    def outcome(self, state: State, found: Sequence[Outcome], seconds: NDArray[np.float64]) -> Outcome:
        """Return the results of conditions at the end of a step, by quantity and name, with their time integrals.

        `found`: results of each substep.
        `seconds`, s: time weights of the substeps.
        """
        out = {quantity: {} for quantity in QUANTITIES} | found[-1]
        for weight, of in zip(seconds[-len(found) :], found, strict=True):
            for quantity, total in state.stage.totals.items():
                for name, rate in of.get(quantity, {}).items():
                    sums = out.setdefault(total, dict(state.outcome.get(total, {})))
                    sums[name] = sums.get(name, 0.0) + weight * rate
        return out | (self.storage.volumes(out) if self.storage else {})

    def net_inflow(self, rates: Rates | None) -> NDArray[np.float64] | None:
        """Return the net inflow of fluid into the cells in the step, or None without fluid."""
        return self.storage and self.storage.net_inflow(rates)


def joined(loads: list[list[Loads]]) -> list[list[Loads]]:
    """Return the loads of each substep.  The sparsity pattern of each contact covers all substeps."""
    if not any(map(attrgetter("couples"), chain.from_iterable(loads))):
        return loads
    return [[one.joined(of) for one, of in zip(now, zip(*loads, strict=True), strict=True)] for now in loads]


def at_rest(scene: Scene, state: State, loads: list[list[Loads]]) -> list[list[Loads]]:
    """Return the loads of each substep for nodes displaced by `State.rest`, see `Loads.moved`."""
    if state.rest is None:
        return loads
    scene.momentum.u.x.array[:] = state.rest
    return [[one.moved(scene.momentum.u) for one in of] for of in loads]


def left(loads: Sequence[Loads], at: At, before: MaterialPoints, after: MaterialPoints) -> MaterialPoints:
    """Return the points with updated data of the loads.  Raise an error if a load does not allow the new positions."""
    for one in loads:
        one.check_end(after, before)
    for one in loads:
        after = one.gripped(at, after)
    return after


def flight_of(start: Start) -> Flight | None:
    """Return the velocities of the unknowns at the start of a step, or None without inertia."""
    mass = start.matrices.mass
    if mass is None:
        return None
    v = mass.velocity(affine(start.state.points), start.rate)
    return Flight(v, v)


def leads(scene: Scene, loads: Sequence[Loads]) -> bool:
    """Return whether Newton's method starts at extrapolated displacements: for yield, or quasi-static contact."""
    momentum = scene.momentum
    return not momentum.elastic or (momentum.inertia is None and any([one.touches for one in loads]))


def going_on(scene: Scene, start: Start, acting: Acting) -> NDArray[np.float64] | None:
    """Return displacements (m) extrapolated from the previous substep or step, or None if `leads` is False."""
    substep = acting.substep
    if substep.before > 0.0 and leads(scene, acting.loads):
        return substep.end / substep.own * scene.momentum.u.x.array
    velocity = start.state.velocity if substep.before == 0.0 else None
    return None if velocity is None else substep.end * start.dt * velocity


def has_yielded(scene: Scene, state: State) -> bool:
    """Return whether soil has yielded in an earlier step, on any process."""
    if scene.momentum.elastic:
        return False
    evolved = bool(scene.materials.evolved(state.points).any())
    return over_all(scene.grid.comm, evolved, MPI.LOR)


def balances(
    scene: Scene, start: Start, acting: Acting, before: Rates | None = None, flight: Flight | None = None
) -> Balances:
    """Return the balances at the end of a substep, at the present u and p.

    `before`: outflow rates of the previous substep.
    `flight`: present velocities, or None without inertia.
    """
    substep = acting.substep
    on_grid = start.on_grid
    matrices = start.matrices
    dt = start.dt
    when = When(acting.t, substep.end * dt, acting.gravity, substep.own * dt, substep.before / substep.own)
    options = {"goes_on": going_on(scene, start, acting), "held": start.state.held, "yielded": start.yielded}
    inertia, u = None, None
    loads = acting.loads
    if flight is not None:
        own = float(substep.own * dt)
        inertia = Inertia(matrices.mass, flight.free(own, float(substep.before * dt)), start.rate)
        loads = [*loads, inertia]
        u = inertia.flight  # all other initial guesses cause large inertia forces that hide the imbalance
    if scene.momentum.inertia is not None:
        scene.momentum.inertia.set_substep(inertia, substep.end < 1)
    momentum = scene.balance(when, matrices.momentum, start.data, loads, u, **options)
    follows = start.state.trend is not None and not leads(scene, acting.loads)
    times = float(substep.end * dt), float(substep.own * dt) if substep.before else 0.0, substep.end < 1
    ahead = partial(scene.motion.ahead, on_grid, start.state, *times) if follows else None
    if scene.storage is None:
        return Balances(momentum, None, inertia, ahead)
    weight = None if acting.gravity is None else scene.fluid.density * acting.gravity
    fed = matrices.flow(start.state, weight, start.data, acting.t, dt, acting.loads, momentum.at)
    lost = before and before.integrated(substep.before * dt)
    carried = on_grid.softness(start.state), substep.end * start.due
    options = (on_grid.contents, *fed, substep.own * dt, lost, *carried)
    moves = None
    if inertia is not None:
        resists = on_grid.resisting_mass / float(substep.own * dt) ** 2
        forces, of = partial(pushed_back, scene, on_grid), scene.momentum.inertia
        moves = FluidInertia(of.move, forces, resists, scene.fluid.density, inertia.rate)
    options = (*options, moves, on_grid.scale)
    storage = StorageProblem(scene.storage, matrices.storage, start.data.pieces, *options)
    return Balances(momentum, storage, inertia, ahead)


def pushed_back(scene: Scene, on_grid: OnGrid, cells: NDArray[np.int64] | slice) -> NDArray[np.float64]:
    """Return the inertia forces (n, d) on the pore fluid in the chosen filled owned cells, in N/m^3."""
    contents = on_grid.contents
    return -scene.fluid.density * scene.momentum.inertia.at(contents.nodes[cells], contents.shape_values[cells])
