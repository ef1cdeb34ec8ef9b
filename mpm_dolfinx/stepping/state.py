# SPDX-License-Identifier: MIT
"""State of a scene: all data that one step passes to the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from mpm_dolfinx.conditions.acting import Outcome
from mpm_dolfinx.domains.pressure_transport import PiecePressures
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.points.material_points import MaterialPoints, PlacedPoints
from mpm_dolfinx.stepping.result import Result
from mpm_dolfinx.stepping.stage import Stage


def _freeze(kept: Mapping[str, Any]) -> None:
    """Make all arrays of a mapping read-only."""
    left = [kept]
    for one in left:
        for values in one.values():
            if isinstance(values, np.ndarray):
                values.flags.writeable = False
            elif isinstance(values, dict):
                left.append(values)


@dataclass(frozen=True)
class StepControl:
    """Data of the step-size control that one step passes to the next, see `simulation/step_size.py`.

    Parameters
    ----------
    interval : s
        Output interval of the run; 0 if output intervals are not equal.
    small : s
        Length of the next trial step.
    waits, kept
        See `StepSize.grown`.
    change : (bodies,), Pa
        Largest pressure change of each body since the start of the run.
    first : (bodies,), Pa/s
        Pressure change in the first substep of the last step, divided by the length of the last step.
    start : (2, bodies), Pa
        Smallest and largest cell pressure of each body at the start of the run; None before the first step.
    motion : J^(1/2)
        Largest size of the motion (`motion_error`) since the start of the run; None without a limit on its error.
    drift : m/s
        Mean velocity of free bodies at the start of the run, see `motion_error`.
    filled
        Largest change of the water content in any step so far, also in earlier runs.
    """

    interval: float = 0.0
    small: float = 0.0
    waits: int = 0
    kept: int = 1
    change: Sequence[float] = (0.0,)
    first: Sequence[float] = (0.0,)
    start: Sequence[Sequence[float]] | None = None
    motion: float | None = None
    drift: Sequence[float] = (0.0,)
    filled: float = 0.0


@dataclass(frozen=True, eq=False)
class Stay:
    """Points that keep the pieces of their domains, because they have hardly moved since the last reset of the grid.

    points
        The material points at the reset of the grid.
    keeps : (n,)
        Whether each point keeps its pieces; None if all points keep their pieces.
    """

    points: MaterialPoints
    keeps: NDArray[np.bool_] | None = None

    def __post_init__(self):
        _freeze(vars(self))


@dataclass(frozen=True, eq=False)
class Trend:
    """Motion of the points in the last steps (at most three).

    lengths : (k,)
        Lengths (s) of the steps, beginning with the last step.
    rates : (n, k, d (1 + d)), with fluid (n, k, d (1 + d) + 1)
        Mean rates in each of these steps: of x (m/s), of F (1/s), and in scenes with fluid, of pressures (Pa/s).
    """

    lengths: NDArray[np.float64]
    rates: NDArray[np.float64]

    def __post_init__(self):
        _freeze(vars(self))

    def over(self, seconds: float, implicit: bool = False, first: float = 0.0) -> NDArray[np.float64]:
        """Return the changes (n, ...) in a time `seconds` (s), by polynomial extrapolation.

        `implicit`: whether the rate at the end of this time replaces the mean rate.
        `first`, s: length of the first substep, or 0. If > 0, `seconds` times the substep's final rate is subtracted.
        """
        order, last = np.arange(1, len(self.lengths) + 1), self.lengths[0]
        ends, powers = -self.lengths.cumsum()[:, None] / last, (seconds / last) ** order * (order if implicit else 1)
        if first:
            powers = powers - seconds / first * (first / last) ** order * order
        *_, shares, singular = dgesv((ends**order).T, powers)
        if singular:  # two steps have the same end, to rounding
            raise np.linalg.LinAlgError("Trend: lengths of steps differ by too many orders of magnitude")
        weights = -self.lengths * shares[::-1].cumsum()[::-1]
        return np.add.reduce(self.rates * weights[:, None], axis=1)


NODAL = ("velocity", "held", "rest")
"""Nodal fields of a `State`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """All data of a scene that one step passes to the next. States are immutable: each step returns a new state.

    A checkpoint stores all of these data, except `stage` and `watched`.

    t
        Time, s.
    points
        Material points of this process. Their positions are relative to `Grid.base`. `Simulation.points` have true
        positions; `PlacedPoints.from_base` converts these.
    pieces
        Pressures of the pieces of the particle domains, for the transfer to the next grid. None without fluid.
    stay
        Points that keep their pieces, or None if the next step resets the whole grid.
    resets
        Number of resets of the grid.
    lines
        Coordinates (n,), m, of moving grid lines at the last reset, relative to `Grid.base`, by axis "x", "y", "z".
        None before the first reset, and for fixed grid lines.
    outcome
        Results of conditions at the end of the last step, by quantity and name. Results of new conditions are nan
        before the first step of a stage. `reactions` (d,), N: forces of prescribed displacements on the bodies.
        `wall_reactions` (d,), N: forces of the grid's walls on the bodies. `outflows`, m^3/s (m^2/s in plane strain):
        flow through open sides and conducting contacts, as volumes at zero pressure. `tool_forces` (3,), in 3D (6,):
        forces (N) and moments (N m) of tools and contacts on the bodies. `tool_travel`, m: displacement of a tool due
        to forces. `flowed`, m^3 (m^2): integral of `outflows`. `impulse` and `wall_impulse`, N s: integrals of forces
        with inertia. User-defined conditions may have other quantities.
    stage
        The present stage, with its conditions.
    begins
        Whether the next step is the first step of the stage.
    velocity : (unknowns,), m/s
        Nodal velocities in the last step on this process, with ghosts. In scenes with yield or quasi-static contact,
        they give the initial guess of Newton's method. None before the first step, and in all other scenes.
    trend
        Motion in the last steps.  In elastic bodies, it gives the initial guess of Newton's method.  None in scenes
        without elastic bodies, and after bodies were added.
    held : (unknowns,), N
        Additional nodal forces on this process, with ghosts, for equilibrium at the start of a stage. None without such
        forces, and after a reset of the grid.
    rest : (unknowns,), m
        Nodal displacement on this process, with ghosts, at which prescribed displacements and plates balance an initial
        stress. None after a stage that changes these conditions, and after a reset of the grid.
    watched : (m,)
        Ids of the points whose domains contain probes. Renewal does not replace these domains.
    result, control
        Histories and step control of the last run. None before the first run.
    """

    t: float
    points: MaterialPoints
    pieces: PiecePressures | None
    stay: Stay | None = None
    resets: int = 0
    lines: Mapping[str, NDArray[np.float64]] | None = None
    outcome: Outcome
    stage: Stage
    begins: bool = True
    velocity: NDArray[np.float64] | None = None
    trend: Trend | None = None
    held: NDArray[np.float64] | None = None
    rest: NDArray[np.float64] | None = None
    watched: NDArray[np.int64] | None = None
    result: Result | None = None
    control: StepControl | None = None

    def __post_init__(self):
        if isinstance(self.points, PlacedPoints):
            raise ValueError("state: points have true positions, must be relative to the grid's base: see from_base")
        _freeze(vars(self))

    @property
    def stays(self) -> bool:
        """Whether all points keep their pieces."""
        return self.stay is not None and self.stay.keeps is None

    @property
    def as_cut(self) -> MaterialPoints:
        """Points at the last reset. Points that do not keep their pieces are at present positions."""
        if self.stay is None:
            return self.points
        return self.stay.points if self.stay.keeps is None else self.stay.points.where(self.stay.keeps, self.points)

    def of_pieces(self, name: str, fresh: NDArray[np.float64], point: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the array `name` (m, ...) of `pieces` for all present pieces. New pieces have the values `fresh`.

        `point` (m,): index of the point of each piece.
        """
        if self.stay is None:
            return fresh
        values, keeps = getattr(self.pieces, name), self.stay.keeps
        if keeps is None:
            return values
        out = fresh.copy()
        out[keeps[point]] = values[keeps[np.searchsorted(self.points.id, self.pieces.id)]]
        return out

    def water_changes(
        self, points: MaterialPoints, point: NDArray[np.int64], fraction: NDArray[np.float64], p: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the changes (n,) of the pressures p, in Pa, of m new pieces, after which each point keeps its water.

        `points`: the n present points.
        `point`, `fraction` (m,): point of each new piece, and its fraction of the volume of the domain.
        """
        materials, old = self.stage.materials, self.pieces
        owner = points.id.searchsorted(old.id)
        then = materials.pore_water(points, itemgetter(owner), old.fraction, owner)
        now = materials.pore_water(points, itemgetter(point), fraction, point)
        return now.level(then.of_cells(old.pressure), np.zeros(len(points)), p)

    def migrated(self, destination: NDArray[np.int32], comm: MPI.Intracomm) -> State:
        """Send points and their pieces to the processes `destination` (n,), and return the state."""
        exchange = Exchange(comm, destination)
        pieces = self.pieces
        if pieces is not None:
            pieces = pieces.migrated(Exchange(comm, destination[np.searchsorted(self.points.id, pieces.id)]))
        stay, trend = self.stay, self.trend
        order = np.argsort(exchange.send(self.points.id))
        if stay is not None:
            keeps = None if stay.keeps is None else exchange.send(stay.keeps)[order]
            stay = Stay(stay.points.migrated(exchange), keeps)
        trend = trend and Trend(trend.lengths, exchange.send(trend.rates)[order])
        return replace(self, points=self.points.migrated(exchange), pieces=pieces, stay=stay, trend=trend)

    def at_owners(self, grid: Grid) -> State:
        """Return the state with points and pieces on the processes that own their cells."""
        if grid.comm.size == 1:
            return self
        placed = self.as_cut
        owner = grid.owner(grid.number(grid.index_from_base(placed.x)) + grid.copy(placed.id))
        moves = over_all(grid.comm, int((owner != grid.comm.rank).any()))
        return self.migrated(owner, grid.comm) if moves else self
