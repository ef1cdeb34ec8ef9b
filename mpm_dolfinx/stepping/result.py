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
from mpm_dolfinx.conditions.acting import IMPULSES, MOTIONS, OF_RAIN, QUANTITIES, VOLUMES
from mpm_dolfinx.conditions.names import ByName

OUTCOMES = tuple(dict.fromkeys([*QUANTITIES, *VOLUMES.values(), *OF_RAIN, *MOTIONS, *IMPULSES.values(), "energy"]))
"""Names of the results of the package's conditions. User-defined conditions may have other results."""


@dataclass(frozen=True)
class Result:
    """Histories of a run, with one row for each output time, including the start.

    Histories are read-only arrays (n, ...) for n output times.  Without probes, arrays of probes have an axis of length
    0.

    Parameters
    ----------
    rows
        Records at the output times, see `Row`.
    steps, newton, coupling
        Numbers of steps, of Newton iterations and of coupling iterations so far.
    cuts, rejected
        Numbers of steps that were repeated with a shorter length: `cuts` without convergence, `rejected` for a large
        error. In runs with equal steps, a step is rejected only if the pressure jumps.
    reinitialised
        Number of inverted domains that were re-initialised from F.
    renewed
        Number of particle domains replaced by renewal, division or merging.
    renewals
        Number of resets of the grid that replaced particle domains.
    balance
        Largest relative error of the fluid mass balance so far.
    residual
        Largest relative residual of the momentum and fluid equations so far.
    wall, profile
        Wall time of the whole run, and wall times of its tasks on this process, s.
    converged
        Whether the run has reached `t_end`, or an event has ended it.
    event
        The event that ended the run: index in `until`, from 0, and time, s. None without an event.
    points
        Number of material points at the end of the run.
    memory
        Peak memory (MB) of all processes, including libraries.
    imbalance
        Largest numbers of points, pieces and cells on a process, each divided by the mean over processes.
    """

    rows: Rows = field(default_factory=Rows, repr=False)
    """Results at the output times, one row each."""
    steps: int = 0
    newton: int = 0
    coupling: int = 0
    cuts: int = 0
    rejected: int = 0
    reinitialised: int = 0
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
        """Output times (n,), in s."""
        return self.rows.column("t")

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacements (n, probes, d) of the probes, in m."""
        return self.rows.column("displacement")

    @property
    def position(self) -> NDArray[np.float64]:
        """Positions (n, probes, d) of the probes, in m."""
        return self.rows.column("position")

    @property
    def pressure(self) -> NDArray[np.float64]:
        """Smallest and largest pore pressure (n, 2) of the material points, in Pa, or (n, 0) without fluid."""
        return self.rows.column("pressure")

    @property
    def probe_pressure(self) -> NDArray[np.float64]:
        """Pore pressures (n, probes) at the probes, in Pa. The shape is (n, 0) without fluid."""
        return self.rows.column("probe_pressure")

    @property
    def probe_stress(self) -> NDArray[np.float64]:
        """Effective stresses (n, probes, 3, 3) with tension positive, in Pa, or (n, 0, 3, 3) if not recorded."""
        return self.rows.column("probe_stress")

    @cached_property
    def reactions(self) -> ByName[NDArray[np.float64]]:
        """Force (times, d) of each prescribed displacement on the bodies by name, in N."""
        return self.outcome("reactions")

    @cached_property
    def wall_reactions(self) -> ByName[NDArray[np.float64]]:
        """Force (times, d) of each wall of the grid on the bodies, in N, see `Simulation`."""
        return self.outcome("wall_reactions")

    @cached_property
    def outflows(self) -> ByName[NDArray[np.float64]]:
        """Outflow (times,) through each open side by name, in m^3/s."""
        return self.outcome("outflows")

    @cached_property
    def tool_forces(self) -> ByName[NDArray[np.float64]]:
        """Forces (N) and moments (N m) of tools and contacts on bodies by name: arrays (times, 3), in 3D (times, 6)."""
        return self.outcome("tool_forces")

    @cached_property
    def tool_travel(self) -> ByName[NDArray[np.float64]]:
        """Displacement (times,) of each load-controlled tool by name, in m, without its prescribed displacement."""
        return self.outcome("tool_travel")

    @cached_property
    def energies(self) -> ByName[NDArray[np.float64]]:
        """Energies and works (times,), in J (J/m in plane strain), of a `run(energies=True)`, by name.

        `kinetic`: kinetic energy of bodies and free tools.
        `elastic`: elastic energy, or 0 for laws without a known elastic energy.
        `external`: work of all loads.
        `internal`: work of the stresses.
        `dissipated`: `internal` minus `elastic`. In wet bodies, this includes the work of flow and storage of water.
        `viscous`: work of quiet sides and user-defined terms.
        `friction`: work of slip at tools and contacts.
        `renewal`: kinetic and elastic energy that renewed domains have lost.

        Works are summed from the start of the run. The sum `kinetic` + `elastic` + `dissipated` + `viscous` +
        `friction` + `renewal` - `external` is constant, up to numerical dissipation.
        """
        return self.outcome("energy")

    def outcome(self, quantity: str) -> ByName[NDArray[np.float64]]:
        """Return the results (n, ...) of conditions, by name. Results are nan at times without the condition.

        `quantity`: name of the results, such as "reactions".
        """
        rows = [outcome.get(quantity, {}) for outcome in self.rows.outcomes]
        like = {name: np.full_like(value, np.nan) for row in rows for name, value in row.items()}
        return ByName({name: np.array([row.get(name, none) for row in rows]) for name, none in like.items()})

    def to_dataframe(self):
        """Return the histories as a pandas data frame with the columns of `history.csv`, and one row for each time.

        `attrs["units"]` of the frame contains the unit of each column. Raise ImportError if pandas is not installed.
        """
        return data_frame(self, {name: self.outcome(name) for name in OUTCOMES})

    def to_xarray(self):
        """Return the histories as an xarray data set with the dimensions time, probe, axis, row and column.

        Each variable has its unit as an attribute. Attributes of the data set are the numbers of steps and iterations.
        Raise ImportError if xarray is not installed.
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
            reinitialised=self.reinitialised + report.reinitialised,
            renewed=self.renewed + report.renewed,
            renewals=self.renewals + (report.renewed > 0),
            balance=max(self.balance, report.balance),
            residual=max(self.residual, *report.history[-1]),
        )

    def shares(self) -> str:
        """Return a table with the time (s) of each task, its share of the run time, the memory, and the imbalance."""
        rows = [*self.profile.items(), ("rest", self.wall - sum(self.profile.values()))]
        lines = [f"{name:18} {s:8.2f} s {100 * s / max(self.wall, 1e-9):5.1f} %" for name, s in rows]
        if self.points:  # measured at the end of a run
            each = 1024 * self.memory / self.points
            lines.append(f"{'memory':18} {self.memory:8.0f} MB, {each:.3g} kB for each of {self.points} points")
        if self.imbalance:
            ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in self.imbalance.items())
            lines.append(f"{'most over mean':18} {ratios} (1: perfect balance)")
        return "\n".join(lines)


class GaveUp(RuntimeError):
    """Error that ends a run, because a step does not converge for any step length.

    The simulation has the state after the last successful step. A new run continues from this state.

    Attributes
    ----------
    result
        Histories up to the last successful step.
    history
        Relative residuals (momentum, storage) in the iterations of the failed step, if any.
    """

    def __init__(self, message: str, result: Result, history: Sequence[tuple[float, float]] = ()):
        super().__init__(message)
        self.result, self.history = result, history
