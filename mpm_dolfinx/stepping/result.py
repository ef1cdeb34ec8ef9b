# SPDX-License-Identifier: MIT
"""Histories of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.base.histories import Row, Rows
from mpm_dolfinx.base.tables import data_frame, data_set
from mpm_dolfinx.conditions.names import ByName

OUTCOMES = ("reactions", "wall_reactions", "outflows", "tool_forces", "tool_travel", "tool_velocity", "energy")
OUTCOMES += ("runoff", "flowed", "ran_off", "ponded")
"""What conditions do to the bodies; those of the user's own may have others."""


@dataclass(frozen=True)
class Result:
    """Histories of a run; one row an output time, the start included.

    Histories are arrays (n, ...) of n output times, which cannot be written into.  Where nothing was asked for they
    have no entries along one of their axes: (n, 0, d) without probes.

    Parameters
    ----------
    rows
        What is recorded at the output times, see `Row`.
    steps, newton, coupling, cuts, rejected
        Numbers so far: steps, iterations, steps cut for want of convergence, and refused for their error.
    rederived
        Domains that had folded, and were derived from F.
    renewed, renewals
        Domains of yielded soil that were replaced by new ones, and resets of the grid at which some were.
    balance, residual
        Worst relative errors so far of the fluid's balance, and of the two problems.
    wall, profile
        Seconds, of the whole run and of each part of it on this process, from dolfinx's timers.
    converged
        Whether the end has been reached.
    event
        Which function of `until` has ended the run, from 0 on, and when, s; None where none has.
    points, memory, imbalance
        At the end of the run: material points, the peak of all processes, libraries included, MB, and the most that
        one of several processes has over their mean.
    """

    rows: Rows = field(default_factory=Rows, repr=False)
    """One an output time."""
    steps: int = 0
    newton: int = 0
    coupling: int = 0
    cuts: int = 0
    rejected: int = 0
    rederived: int = 0
    renewed: int = 0
    renewals: int = 0
    balance: float = 0.0
    residual: float = 0.0
    wall: float = 0.0
    converged: bool = False
    event: tuple[int, float] | None = None
    profile: dict[str, float] = field(default_factory=dict, repr=False)
    points: int = 0
    memory: float = 0.0
    imbalance: dict[str, float] = field(default_factory=dict)

    def __post_init__(self):
        if not isinstance(self.rows, Rows):
            object.__setattr__(self, "rows", Rows(self.rows))
        if self.event is not None:
            object.__setattr__(self, "event", tuple(self.event))

    @property
    def t(self) -> NDArray[np.float64]:
        """Output times (n,), s."""
        return self.rows.column("t")

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacements (n, m, d) of the probes, m."""
        return self.rows.column("displacement")

    @property
    def position(self) -> NDArray[np.float64]:
        """Positions (n, m, d) of the probes, m."""
        return self.rows.column("position")

    @property
    def pressure(self) -> NDArray[np.float64]:
        """Least and largest pore pressure (n, 2) on the points, Pa; (n, 0) without fluid."""
        return self.rows.column("pressure")

    @property
    def probe_pressure(self) -> NDArray[np.float64]:
        """Pore pressures (n, m) at the probes, Pa; (n, 0) without fluid."""
        return self.rows.column("probe_pressure")

    @property
    def probe_stress(self) -> NDArray[np.float64]:
        """Effective stresses (n, m, 3, 3) at the probes, Pa, tension positive; (n, 0, 3, 3) where not asked for."""
        return self.rows.column("probe_stress")

    @cached_property
    def reactions(self) -> ByName[NDArray[np.float64]]:
        """Forces (times, d), N, of each given displacement on the bodies at the output times, by its name."""
        return self.outcome("reactions")

    @cached_property
    def wall_reactions(self) -> ByName[NDArray[np.float64]]:
        """Forces (times, d), N, of each wall of the grid on the bodies at the output times; see `Simulation`."""
        return self.outcome("wall_reactions")

    @cached_property
    def outflows(self) -> ByName[NDArray[np.float64]]:
        """What leaves (times,), m^3/s, through each open side at the output times, by its name."""
        return self.outcome("outflows")

    @cached_property
    def tool_forces(self) -> ByName[NDArray[np.float64]]:
        """Forces and moments (times, d + 1), in 3D (times, 6), N and N m, of each tool and contact, by its name."""
        return self.outcome("tool_forces")

    @cached_property
    def tool_travel(self) -> ByName[NDArray[np.float64]]:
        """How far a load has pushed (times,), m, each tool beyond its displacement at the output times, by its name."""
        return self.outcome("tool_travel")

    @cached_property
    def energies(self) -> ByName[NDArray[np.float64]]:
        """Energies and works (times,), J (J/m in plane strain), of a `run(energies=True)`, by name.

        kinetic and elastic are those of the bodies, and of free tools; elastic is 0 where a law tells none.  The others
        count from the start of the run: external is the work of all that acts, viscous that against quiet sides and
        terms of the user's, friction what slip on tools and between groups takes, internal that of the stresses;
        dissipated is what of this is not elastic, of wet bodies also what the flow takes and water stores.  kinetic +
        elastic + dissipated + viscous + friction - external stays as it is, but for what the method loses.
        """
        return self.outcome("energy")

    def outcome(self, quantity: str) -> ByName[NDArray[np.float64]]:
        """Return what conditions have done (n, ...) at the output times, by name, such as "reactions".

        nan where a condition was not there.
        """
        rows = [outcome.get(quantity, {}) for outcome in self.rows.outcomes]
        like = {name: np.full_like(value, np.nan) for row in rows for name, value in row.items()}
        return ByName({name: np.array([row.get(name, none) for row in rows]) for name, none in like.items()})

    def to_dataframe(self):
        """Return the histories as a data frame of pandas, one row an output time, with the columns of `history.csv`.

        Its `attrs["units"]` has the unit of each column.  ImportError where pandas is not installed.
        """
        return data_frame(self, {name: self.outcome(name) for name in OUTCOMES})

    def to_xarray(self):
        """Return the histories as a data set of xarray, with units as attributes of its variables.

        Dimensions are time, probe and axis, of stresses of probes row and column; conditions have variables by their
        names.  Its attributes are the counts of the run.  ImportError where xarray is not installed.
        """
        counts = {name: getattr(self, name) for name in ("steps", "newton", "cuts", "balance", "residual", "wall")}
        return data_set(self, {name: self.outcome(name) for name in OUTCOMES}, counts)

    def more(self, row: Row) -> Result:
        """Return the histories with one more output time."""
        return replace(self, rows=self.rows.more(row))

    def after(self, report: Report) -> Result:
        """Return the histories after one more step."""
        return replace(
            self,
            steps=self.steps + 1,
            newton=self.newton + report.newton,
            coupling=self.coupling + report.coupling,
            rederived=self.rederived + report.rederived,
            renewed=self.renewed + report.renewed,
            renewals=self.renewals + (report.renewed > 0),
            balance=max(self.balance, report.balance),
            residual=max(self.residual, *report.history[-1]),
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
