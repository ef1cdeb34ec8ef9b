# SPDX-License-Identifier: MIT
"""The start of a step, and the two balances at the end of each of its substeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.time_integration import Substep
from mpm_dolfinx.conditions.acting import QUANTITIES, At, Loads, Outcome
from mpm_dolfinx.flow.storage import Rates, StorageProblem
from mpm_dolfinx.mechanics.momentum import MomentumProblem
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.stepping.on_grid import Assembled, OnGrid
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State


class Acting(NamedTuple):
    """What acts in a substep: its shares of the step, time, s, loads, and gravity (d,), m/s^2, if there is any."""

    substep: Substep
    t: float
    loads: Sequence[Loads]
    gravity: NDArray[np.float64] | None


class Start(NamedTuple):
    """The start of a step of dt (s): the state on the grid, with the pieces' data, matrices, and what acts.

    yielded: whether soil has yielded before, on any process.
    """

    state: State
    on_grid: OnGrid
    data: QuadratureData
    matrices: Assembled
    dt: float
    yielded: bool
    acting: list[Acting]


class Balances(NamedTuple):
    """The two balances at the end of a substep; storage is None without fluid."""

    momentum: MomentumProblem
    storage: StorageProblem | None

    def outcome(self, state: State) -> Outcome:
        """Return what conditions do to the bodies at the end of a step, see `State`."""
        stage, out = state.stage, {quantity: {} for quantity in QUANTITIES} | self.momentum.outcome()
        out["wall_reactions"] = self.momentum.wall_forces(stage.conditions["walls"])
        out["outflows"] = self.storage.outflows(stage.hydraulic.names) if self.storage else {}
        return out

    def came(self, rates: Rates | None) -> NDArray[np.float64] | None:
        """Return what came to the cells in the step, see `StorageProblem.came`; None without fluid."""
        return self.storage and self.storage.came(rates)


def at_rest(scene: Scene, state: State, loads: list[list[Loads]]) -> list[list[Loads]]:
    """Return what acts in each substep, what holds bodies with its forces of an initial stress at rest."""
    if state.rest is None:
        return loads
    scene.momentum.u.x.array[:] = state.rest
    return [[one.moved(scene.momentum.u) for one in of] for of in loads]


def left(loads: Sequence[Loads], at: At, before: MaterialPoints, after: MaterialPoints) -> MaterialPoints:
    """Return the points after a step with what they keep of the loads; refuse them where they may not be."""
    for one in loads:
        one.check_end(after, before)
    for one in loads:
        after = one.gripped(at, after)
    return after


def going_on(scene: Scene, start: Start, substep: Substep) -> NDArray[np.float64] | None:
    """Return displacements (unknowns,), m, if bodies that yield moved on as in the substep before, or the last step.

    A local array, None where that is not known.
    """
    if substep.before > 0.0 and not scene.momentum.elastic:
        return substep.end / substep.own * scene.momentum.u.x.array
    velocity = start.state.velocity if substep.before == 0.0 else None
    return None if velocity is None else substep.end * start.dt * velocity


def has_yielded(scene: Scene, state: State) -> bool:
    """Return whether soil has yielded before, on any process."""
    if scene.momentum.elastic:
        return False
    evolved = bool(scene.materials.evolved(state.points).any())
    return over_all(scene.grid.comm, evolved, MPI.LOR)


def balances(scene: Scene, start: Start, acting: Acting, before: Rates | None = None) -> Balances:
    """Return the balances at the end of a substep, with u and p as they are; before: rates of the substep before."""
    substep = acting.substep
    on_grid = start.on_grid
    matrices = start.matrices
    dt = start.dt
    scene.set_time(acting.t, substep.end * dt, acting.gravity)
    scene.momentum.own.set_rate(substep.own * dt, substep.before / substep.own)
    forces = scene.scheme.tolerance, going_on(scene, start, substep), start.state.held
    momentum = MomentumProblem(scene.momentum, matrices.momentum, start.data, acting.loads, *forces, start.yielded)
    if scene.storage is None:
        return Balances(momentum, None)
    weight = None if acting.gravity is None else scene.fluid.density * acting.gravity
    flow = matrices.flow(start.state, weight, start.data, acting.t)
    lost = before and before.taken(substep.before * dt)
    carried = on_grid.softness(start.state), substep.end * on_grid.due(start.state)
    options = (on_grid.contents, flow, substep.own * dt, lost, *carried)
    return Balances(momentum, StorageProblem(scene.storage, matrices.storage, start.data.pieces, *options))
