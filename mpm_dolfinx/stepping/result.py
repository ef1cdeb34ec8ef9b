# SPDX-License-Identifier: MIT
"""Histories of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.report import Report
from mpm_dolfinx.conditions.acting import Outcome
from mpm_dolfinx.conditions.names import ByName


class Row(NamedTuple):
    """What the histories hold of an output time; None where nothing is asked for, or there is no fluid.

    t, s; displacement (m, d), m, and present position (m, d), m, of the m probes; pressure: least and largest on the
    points, Pa; probe_pressure (m,), Pa, and probe_stress (m, 3, 3), Pa: pore pressure and effective stress, tension
    positive, at the places of the probes, see `probe_fields`; outcome: what conditions do to the bodies, see `State`.
    """

    t: float
    displacement: NDArray[np.float64] | None = None
    pressure: tuple[float, float] | None = None
    position: NDArray[np.float64] | None = None
    probe_pressure: NDArray[np.float64] | None = None
    probe_stress: NDArray[np.float64] | None = None
    outcome: Outcome | None = None


@dataclass(frozen=True)
class Result:
    """Histories of a run, and where its time loop is; one row an output time, the start included.

    rows: what is recorded at the output times, see `Row`; each column is a property too.  Of
    the steps so far: steps, newton, coupling (iterations), balance and residual (worst, relative), cuts (for want of
    convergence), rejected (for their error), change (largest of the pressures since the run began, Pa), rederived
    (domains that had folded), wall (s), and profile: seconds of each part of the run on this process, from dolfinx's
    timers.  points: material points; memory: peak of all processes, libraries included, MB; imbalance: the most that
    one of several processes has over their mean, at the end of the run.
    dt: output interval, s, 0 without one; small: the step to try next, s; converged: the end has been reached; first:
    see `Report`, of the last step over its length where the grid is reset, Pa/s; waits, kept: see `StepSize.grown`.
    """

    rows: tuple[Row, ...] = field(default=(), repr=False)
    """One an output time."""
    steps: int = 0
    newton: int = 0
    coupling: int = 0
    cuts: int = 0
    rejected: int = 0
    change: float = 0.0
    first: float = 0.0
    rederived: int = 0
    balance: float = 0.0
    residual: float = 0.0
    wall: float = 0.0
    dt: float = 0.0
    small: float = 0.0
    waits: int = 0
    kept: int = 1
    converged: bool = False
    profile: dict[str, float] = field(default_factory=dict, repr=False)
    points: int = 0
    memory: float = 0.0
    imbalance: dict[str, float] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "rows", tuple(self.rows))  # a kept one does not grow with the run

    @property
    def t(self) -> list[float]:
        """Output times, s."""
        return self.column("t")

    @property
    def displacement(self) -> list[NDArray[np.float64]]:
        """Displacements (m, d) of the probes at the output times, m."""
        return self.column("displacement")

    @property
    def position(self) -> list[NDArray[np.float64]]:
        """Positions (m, d) of the probes at the output times, m."""
        return self.column("position")

    @property
    def probe_pressure(self) -> list[NDArray[np.float64]]:
        """Pore pressures (m,) at the probes at the output times, Pa."""
        return self.column("probe_pressure")

    @property
    def probe_stress(self) -> list[NDArray[np.float64]]:
        """Effective stresses (m, 3, 3) at the probes at the output times, Pa, tension positive."""
        return self.column("probe_stress")

    @property
    def reactions(self) -> ByName[NDArray[np.float64]]:
        """Forces (times, d), N, of each given displacement on the bodies at the output times, by its name."""
        return self.outcome("reactions")

    @property
    def wall_reactions(self) -> ByName[NDArray[np.float64]]:
        """Forces (times, d), N, of each wall of the grid on the bodies at the output times; see `Simulation`."""
        return self.outcome("wall_reactions")

    @property
    def outflows(self) -> ByName[NDArray[np.float64]]:
        """What leaves (times,), m^3/s, through each open side at the output times, by its name."""
        return self.outcome("outflows")

    @property
    def tool_forces(self) -> ByName[NDArray[np.float64]]:
        """Forces and moments (times, d + 1), in 3D (times, 6), N and N m, of each tool and contact, by its name."""
        return self.outcome("tool_forces")

    @property
    def tool_travel(self) -> ByName[NDArray[np.float64]]:
        """How far a load has pushed (times,), m, each tool beyond its displacement at the output times, by its name."""
        return self.outcome("tool_travel")

    def outcome(self, quantity: str) -> ByName[NDArray[np.float64]]:
        """Return what conditions have done (times, ...) at the output times, by name, such as "reactions".

        nan where a condition was not there.
        """
        rows = [outcome.get(quantity, {}) for outcome in self.column("outcome")]
        like = {name: np.full_like(value, np.nan) for row in rows for name, value in row.items()}
        return ByName({name: np.array([row.get(name, none) for row in rows]) for name, none in like.items()})

    @property
    def pressure(self) -> list[tuple[float, float]]:
        """Least and largest pore pressure on the points at the output times, Pa."""
        return self.column("pressure")

    def column(self, name: str) -> list:
        """Return one quantity of the rows, where it is recorded."""
        return [value for row in self.rows if (value := getattr(row, name)) is not None]

    def more(self, row: Row) -> Result:
        """Return the histories with one more output time."""
        return replace(self, rows=(*self.rows, row))

    def after(self, report: Report, first: float = 0.0) -> Result:
        """Return the histories after one more step; first: see `Result`."""
        return replace(
            self,
            steps=self.steps + 1,
            newton=self.newton + report.newton,
            coupling=self.coupling + report.coupling,
            rederived=self.rederived + report.rederived,
            balance=max(self.balance, report.balance),
            residual=max(self.residual, *report.history[-1]),
            first=first,
        )

    def shares(self) -> str:
        """Return seconds and share of the wall time of each part, memory and imbalance as a table."""
        rows = [*self.profile.items(), ("rest", self.wall - sum(self.profile.values()))]
        lines = [f"{name:18} {s:8.2f} s {100 * s / max(self.wall, 1e-9):5.1f} %" for name, s in rows]
        if self.points:  # measured when a run has ended
            each = 1024 * self.memory / self.points
            lines.append(f"{'memory':18} {self.memory:8.0f} MB, {each:.3g} kB for each of {self.points} points")
        if self.imbalance:
            ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in self.imbalance.items())
            lines.append(f"{'most over mean':18} {ratios} (1: perfect balance)")
        return "\n".join(lines)


class GaveUp(RuntimeError):
    """A run could not go on: a step that fails however short.

    The simulation is in the state of the last good step, from which other conditions or another step may go on.

    Attributes
    ----------
    result
        Histories up to the last good output time.
    history
        Relative residuals (momentum, storage) of the failed step's iterations, if it came to any.
    """

    def __init__(self, message: str, result: Result, history: Sequence[tuple[float, float]] = ()):
        super().__init__(message)
        self.result, self.history = result, history
