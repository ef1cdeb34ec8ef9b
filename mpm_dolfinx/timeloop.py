# SPDX-License-Identifier: MIT
"""The time loop: steps that are cut when they do not converge and grow again, and their histories."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

import numpy as np
from dolfinx.common import Timer
from numpy.typing import NDArray
from tqdm import tqdm

from mpm_dolfinx import _compat
from mpm_dolfinx.coupling import NotConverged
from mpm_dolfinx.placement import LeftGrid
from mpm_dolfinx.points import Probes

if TYPE_CHECKING:
    from mpm_dolfinx.simulation import Simulation

PARTS = (
    "cut domains",
    "remap",
    "integration data",
    "loads",
    "residual",
    "tangent",
    "factorisation",
    "linear solve",
    "move points",
    "output",
)
"""Parts of a run that are timed, as `mpm: ...` in dolfinx's own list of timings."""
MIN_CUT = 2.0**-10  # of dt: a step is not cut below this


@dataclass
class Result:
    """Histories of a run; one entry an output time, the start included.

    t (s); displacement (m, d) of the probes, m; pressure: least and largest on the points, Pa; and of
    the steps so far: steps, newton, coupling (iterations), balance and residual (worst, relative), cuts,
    rederived (domains that had folded), wall (s), and profile: seconds of each part of the run on this
    process, from dolfinx's timers.
    """

    t: list[float] = field(default_factory=list)
    displacement: list[NDArray[np.float64]] = field(default_factory=list)
    pressure: list[tuple[float, float]] = field(default_factory=list)
    steps: int = 0
    newton: int = 0
    coupling: int = 0
    cuts: int = 0
    rederived: int = 0
    balance: float = 0.0
    residual: float = 0.0
    wall: float = 0.0
    converged: bool = False
    profile: dict[str, float] = field(default_factory=dict)

    def shares(self) -> str:
        """Return the profile as a table: seconds and share of the wall time of each part."""
        rows = [*self.profile.items(), ("rest", self.wall - sum(self.profile.values()))]
        return "\n".join(f"{name:18} {s:8.2f} s {100 * s / max(self.wall, 1e-9):5.1f} %" for name, s in rows)


class GaveUp(RuntimeError):
    """A run could not go on; `result` holds the histories up to the last good step.

    `history` lists the relative residuals (momentum, storage) of the failed step, if it was one.
    """

    def __init__(self, message: str, result: Result, history: Sequence[tuple[float, float]] = ()):
        super().__init__(message)
        self.result, self.history = result, history


def run(
    simulation: Simulation,
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
        Step and output interval, s, > 0; one step to t_end where it is longer than that.
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
    if not (dt > 0 and simulation.t < t_end < inf):
        raise ValueError(f"dt = {dt!r}, t_end = {t_end!r}: must be dt > 0 and t_end > {simulation.t:g} and finite")
    dt = min(dt, t_end - simulation.t)
    result, start, small = Result(), simulation.t, dt
    _record(simulation, result, probes)
    intervals = max(1, round((t_end - start) / dt))
    began, timed = time.perf_counter(), _timings()
    quiet = None if progress and simulation.grid.comm.rank == 0 else True
    with tqdm(total=intervals, disable=quiet, unit="step") as bar:
        for k in range(1, intervals + 1):
            target = t_end if k == intervals else start + k * dt
            while target - simulation.t > 1e-9 * dt:
                small = _advance(simulation, min(small, target - simulation.t), dt, result)
            simulation.t = target
            with Timer("mpm: output"):
                _record(simulation, result, probes)
                if observe is not None:
                    observe(simulation)
            result.wall = time.perf_counter() - began
            result.profile = {part: after - timed[part] for part, after in _timings().items()}
            bar.set_postfix(t=f"{simulation.t:.4g} s", newton=result.newton, coupling=result.coupling)
            bar.update()
    result.converged = True
    return result


def _timings() -> dict[str, float]:
    return {part: _compat.seconds(f"mpm: {part}") for part in PARTS}


def _advance(simulation: Simulation, small: float, dt: float, result: Result) -> float:
    """Take one step of at most `small`, cutting it until it converges; return the next step to try."""
    while True:
        try:
            report = simulation.step(small)
        except NotConverged as failed:
            result.cuts += 1
            if small / 2 < MIN_CUT * dt:
                message = f"gave up at t = {simulation.t:g} s with dt = {small:.3g} s: {failed}"
                raise GaveUp(message, result, failed.history) from failed
            small /= 2
            continue
        except LeftGrid as failed:
            raise GaveUp(str(failed), result) from failed
        result.steps += 1
        result.rederived += report.rederived
        result.newton += report.newton
        result.coupling += report.coupling
        result.balance = max(result.balance, report.balance)
        result.residual = max(result.residual, *report.history[-1])
        return min(2 * small, dt)


def _record(simulation: Simulation, result: Result, probes: Probes | None) -> None:
    comm, points = simulation.grid.comm, simulation.points
    result.t.append(simulation.t)
    if probes is not None:
        result.displacement.append(probes.displacement(points, comm))
    if simulation.fluid:
        p = points.pressure
        ends = comm.allgather((p.min(initial=np.inf), p.max(initial=-np.inf)))
        result.pressure.append((min(e[0] for e in ends), max(e[1] for e in ends)))
