# SPDX-License-Identifier: MIT
"""The state of a scene: all that it remembers between two steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.conditions.acting import Outcome
from mpm_dolfinx.domains.pressure_transport import PiecePressures
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.material_points import MaterialPoints, PlacedPoints
from mpm_dolfinx.stepping.result import Result
from mpm_dolfinx.stepping.stage import Stage
from mpm_dolfinx.stepping.step_control import StepControl


def _freeze(kept: Mapping[str, Any]) -> None:
    """Let nobody write into the arrays of what is kept."""
    for values in kept.values():
        if isinstance(values, np.ndarray):
            values.flags.writeable = False
        elif isinstance(values, Mapping):
            _freeze(values)


@dataclass(frozen=True, eq=False)
class Stay:
    """What still holds of the last reset of the grid: points that hardly move since stay in the cells that cut them.

    points
        The material points when the grid was reset.
    keeps : (n,)
        Points for which it still holds: those of parts of the bodies that hardly move.  None: for all.
    """

    points: MaterialPoints
    keeps: NDArray[np.bool_] | None = None

    def __post_init__(self):
        _freeze(vars(self))

    def migrated(self, exchange: Exchange) -> Stay:
        """Return what holds for points that go to their destinations, by the exchange of points."""
        keeps = self.keeps
        if keeps is not None:
            keeps = exchange.send(keeps)[np.argsort(exchange.send(self.points.id))]
        return Stay(self.points.migrated(exchange), keeps)


@dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """All that a scene remembers between two steps.  A step makes a new one; nobody changes one.

    A checkpoint holds all of it but the stage, which the script gives.

    t
        Time, s.
    points
        The material points of this process.  Their places count from the grid's `base`, unlike those of
        `Simulation.points`, which a state refuses: `PlacedPoints.from_base` gives them back.
    pieces
        Pressures that the pieces of the points' domains have, and take to the next grid; None without fluid.
    stay
        What holds of the last reset of the grid; None where the next step resets all of it.
    resets
        How often the grid has been reset.
    outcome
        What conditions do to the bodies, by quantity and name, at the end of the last step; nan before the first one of
        a stage that has others.  reactions (d,), N, of given displacements; wall_reactions (d,), N, of the grid's
        walls; outflows, m^3/s (m^2/s in plane strain), volumes at zero pressure that leave through open sides;
        tool_forces (d + 1,), in 3D (6,), N and N m, forces and moments of tools and contacts on the bodies;
        tool_travel, m, how far loads have pushed tools beyond their displacement; and what the user's own give.
    stage
        The conditions in force.
    begins
        Whether no step of the stage has been taken.
    velocity : (unknowns,), m/s
        Of the nodes of this process in the last step, ghosts included: where Newton's method may begin where bodies
        yield or touch.  None before the first step, and elsewhere.
    held : (unknowns,), N
        Forces on the nodes of this process, ghosts included, that hold what the scheme's error leaves out of balance of
        an initial stress; None without, once a stage begins, and once bodies have moved so far that the grid is reset.
    rest : (unknowns,), m
        Displacement of the nodes of this process, ghosts included, for which given displacements and plates have the
        forces of an initial stress at rest; None once a stage changes these, and once the grid is reset.
    watched : (m,)
        Numbers of the points whose domains probes are in, which are not renewed.
    result, control
        Histories of the last run, and the memory of its step sizes; None before the first one.
    """

    t: float
    points: MaterialPoints
    pieces: PiecePressures | None
    stay: Stay | None = None
    resets: int = 0
    outcome: Outcome
    stage: Stage
    begins: bool = True
    velocity: NDArray[np.float64] | None = None
    held: NDArray[np.float64] | None = None
    rest: NDArray[np.float64] | None = None
    watched: NDArray[np.int64] | None = None
    result: Result | None = None
    control: StepControl | None = None

    def __post_init__(self):
        if isinstance(self.points, PlacedPoints):
            raise ValueError("state: points are at true places, must count from the grid's base: use points.from_base")
        _freeze(vars(self))

    @property
    def stays(self) -> bool:
        """Whether all points stay in the cells that cut them."""
        return self.stay is not None and self.stay.keeps is None

    @property
    def as_cut(self) -> MaterialPoints:
        """The points where the next step has them cut: those that hardly move stay as they were."""
        if self.stay is None:
            return self.points
        return self.stay.points if self.stay.keeps is None else self.stay.points.where(self.stay.keeps, self.points)

    def of_pieces(self, name: str, fresh: NDArray[np.float64], point: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return what pieces have: values of this name where they stay, else fresh ones (m, ...).

        point : (m,)
            Which of the points each piece belongs to; those that are kept have the pieces that they had.
        """
        if self.stay is None:
            return fresh
        values, keeps = getattr(self.pieces, name), self.stay.keeps
        if keeps is None:
            return values
        out = fresh.copy()
        out[keeps[point]] = values[keeps[np.searchsorted(self.points.id, self.pieces.id)]]
        return out

    def migrated(self, destination: NDArray[np.int32], comm: MPI.Intracomm) -> State:
        """Return the state after every point, with its pieces, went to its destination (n,), a rank."""
        exchange = Exchange(comm, destination)
        pieces = self.pieces
        if pieces is not None:
            pieces = pieces.migrated(Exchange(comm, destination[np.searchsorted(self.points.id, pieces.id)]))
        stay = self.stay and self.stay.migrated(exchange)
        return replace(self, points=self.points.migrated(exchange), pieces=pieces, stay=stay)

    def at_owners(self, grid: Grid) -> State:
        """Return the state with points and pieces at the processes that own the points' cells."""
        if grid.comm.size == 1:
            return self
        placed = self.as_cut
        return self.migrated(grid.owner(grid.number(grid.index_from_base(placed.x)) + grid.copy(placed.id)), grid.comm)
