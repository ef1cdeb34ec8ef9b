# SPDX-License-Identifier: MIT
"""The time loop: steps that are cut when they do not converge and grow again, and their histories."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
from dolfinx.common import Timer
from numpy.typing import NDArray
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from mpm_dolfinx import _compat
from mpm_dolfinx.validation import functions, instance, line, numbers
from mpm_dolfinx.solve.newton import NotConverged
from mpm_dolfinx.points.cut_domains import LeftGrid
from mpm_dolfinx.io.summary import imbalance, peak_memory
from mpm_dolfinx.points.faces import Probes

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
MOST = 1e9
"""Output intervals of a run: with more, a step is lost in the rounding of the time."""
logger = logging.getLogger("mpm_dolfinx")


@dataclass
class Result:
    """Histories of a run, and where its time loop is; one entry an output time, the start included.

    t (s); displacement (m, d) of the probes, m; pressure: least and largest on the points, Pa; and of
    the steps so far: steps, newton, coupling (iterations), balance and residual (worst, relative), cuts,
    rederived (domains that had folded), wall (s), and profile: seconds of each part of the run on this
    process, from dolfinx's timers.  points: material points; memory: peak of all processes, libraries
    included, MB; imbalance: the most that one of several processes has over their mean, at the end of the run.
    dt: output interval, s; small: the step to try next, s; converged: the end has been reached.
    """

    t: list[float] = field(default_factory=list, repr=False)
    displacement: list[NDArray[np.float64]] = field(default_factory=list, repr=False)
    pressure: list[tuple[float, float]] = field(default_factory=list, repr=False)
    steps: int = 0
    newton: int = 0
    coupling: int = 0
    cuts: int = 0
    rederived: int = 0
    balance: float = 0.0
    residual: float = 0.0
    wall: float = 0.0
    dt: float = 0.0
    small: float = 0.0
    converged: bool = False
    profile: dict[str, float] = field(default_factory=dict, repr=False)
    points: int = 0
    memory: float = 0.0
    imbalance: dict[str, float] = field(default_factory=dict)

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


def log(comm: MPI.Intracomm, message: str, *values) -> None:
    """Log a message of the package, once for all processes."""
    if comm.rank == 0:
        logger.info(message, *values)


class GaveUp(RuntimeError):
    """A run could not go on: a step that does not converge however short, a point that has left the grid.

    The simulation is in the state of the last good step, from which other conditions or another step may go on.

    Attributes
    ----------
    result
        Histories up to the last good output time.
    history
        Relative residuals (momentum, storage) of the failed step's iterations, if it was one.
    """

    def __init__(self, message: str, result: Result, history: Sequence[tuple[float, float]] = ()):
        super().__init__(message)
        self.result, self.history = result, history


Observer = Callable[["Simulation"], None]


def run(
    simulation: Simulation,
    t_end: float,
    dt: float,
    *,
    probes: Probes | None = None,
    observe: Observer | Sequence[Observer] = (),
    checkpoint: Observer | None = None,
    after: Result | None = None,
    progress: bool = True,
) -> Result:
    """Advance a simulation: see `Simulation.run`."""
    if probes is not None and not isinstance(probes, Probes):
        raise ValueError(f"probes = {line(probes)}, must be what `probes` gives")
    observers = [observe] if callable(observe) else observe
    if probes is not None:
        probes.check(simulation.bodies, simulation.present)
    functions("observe", observers)
    functions("checkpoint", [checkpoint] if checkpoint is not None else [])
    if after is not None:
        instance("after", after, Result)
    t_end, dt = _times(simulation.t, t_end, dt, after is not None)
    result = simulation.result = _histories(simulation, t_end, dt, probes, after)
    dt, start, done = result.dt, result.t[0], len(result.t) - 1
    # a last interval that is a fraction of dt counts as one
    intervals = max(done + (t_end - simulation.t > 1e-9 * dt), round((t_end - start) / dt))
    result.converged = done == intervals
    stopwatch = _Stopwatch(result)
    quiet = None if progress and simulation.grid.comm.rank == 0 else True
    bar = tqdm(total=intervals, initial=done, disable=quiet, unit="step")
    with bar, nullcontext() if bar.disable else logging_redirect_tqdm():  # messages above the bar, not into it
        for k in range(done + 1, intervals + 1):
            target = t_end if k == intervals else start + k * dt
            while target - simulation.t > 1e-9 * dt:
                _advance(simulation, min(result.small, target - simulation.t), result)
                bar.set_postfix(t=f"{simulation.t:.4g} s", newton=result.newton, coupling=result.coupling)
            simulation.t = target
            result.converged = k == intervals
            with Timer("mpm: output"):
                _record(simulation, result, probes)
                stopwatch.read()
                for observer in observers:
                    observer(simulation)
                stopwatch.read()
                if checkpoint is not None:
                    checkpoint(simulation)
            bar.update()
    _measure(simulation, result)
    stopwatch.read()
    return result


def _times(now: float, t_end: float, dt: float, goes_on: bool) -> tuple[float, float]:
    """Return end and step of a run from `now`, s; ValueError if there are none, or too many steps to tell apart."""
    more, least = (">=", now) if goes_on else (">", np.nextafter(now, inf))
    end = numbers("t_end", t_end, allowed=f"{more} {now:g} s and finite", test=lambda v: (v >= least) & (v < inf))
    allowed = f"> 0, and not below {(end - now) / MOST:g} s"
    return float(end), float(numbers("dt", dt, allowed=allowed, test=lambda v: (v > 0) & (v * MOST >= end - now)))


def _histories(simulation, t_end: float, dt: float, probes: Probes | None, after: Result | None) -> Result:
    """Return new histories that begin with the present state, or those to go on with."""
    dt = min(dt, t_end - (after.t[0] if after else simulation.t))
    if after is None:
        result = Result(dt=dt, small=dt)
        _record(simulation, result, probes)
        return result
    if after.dt != dt or after.t[-1] != simulation.t:
        raise ValueError(
            f"dt = {dt!r} from t = {simulation.t!r}: the run to go on with has dt = {after.dt!r}, t = {after.t[-1]!r}"
        )
    recorded = len(after.displacement[0]) if after.displacement else 0
    if recorded != (0 if probes is None else len(probes.id)):
        raise ValueError(f"probes: the run to go on with has {recorded} of them")
    return after


class _Stopwatch:
    """Wall time and profile of a run, those that its histories have already included."""

    def __init__(self, result: Result):
        self._result = result
        self._began = time.perf_counter() - result.wall
        self._timed = {part: seconds - result.profile.get(part, 0.0) for part, seconds in _timings().items()}

    def read(self) -> None:
        """Note the seconds so far."""
        self._result.wall = time.perf_counter() - self._began
        self._result.profile = {part: seconds - self._timed[part] for part, seconds in _timings().items()}


def _timings() -> dict[str, float]:
    return {part: _compat.seconds(f"mpm: {part}") for part in PARTS}


def _advance(simulation: Simulation, small: float, result: Result) -> None:
    """Take one step of at most `small`, cutting it until it converges."""
    comm = simulation.grid.comm
    while True:
        try:
            report = simulation.step(small)
        except NotConverged as failed:
            result.cuts += 1
            if small / 2 < MIN_CUT * result.dt:
                message = f"gave up at t = {simulation.t:g} s with dt = {small:.3g} s: {failed}"
                raise GaveUp(message, result, failed.history) from failed
            result.small = small = small / 2
            log(comm, "t = %g s: step cut to %.3g s: %s", simulation.t, small, failed)
            continue
        except LeftGrid as failed:
            raise GaveUp(str(failed), result) from failed
        result.steps += 1
        result.rederived += report.rederived
        result.newton += report.newton
        result.coupling += report.coupling
        result.balance = max(result.balance, report.balance)
        result.residual = max(result.residual, *report.history[-1])
        # a step as long as one that has just failed would mostly fail again: in soil that yields, 78 cuts instead of 1
        easy = simulation.coupler.easy(report)
        grown = max(result.small, min(2 * small, result.dt)) if easy else result.small
        if grown > 1.01 * result.small:  # not by rounding only
            log(comm, "t = %g s: step grows to %.3g s", simulation.t, grown)
        result.small = grown
        return


def _record(simulation: Simulation, result: Result, probes: Probes | None) -> None:
    comm, points = simulation.grid.comm, simulation.points
    result.t.append(simulation.t)
    if probes is not None:
        result.displacement.append(probes.displacement(points, comm))
    if simulation.fluid:
        p = points.pressure
        ends = comm.allgather((p.min(initial=np.inf), p.max(initial=-np.inf)))
        result.pressure.append((min(e[0] for e in ends), max(e[1] for e in ends)))


def _measure(simulation: Simulation, result: Result) -> None:
    """Note the memory, and how evenly processes share the work."""
    comm = simulation.grid.comm
    points, result.memory = comm.allreduce(np.array([len(simulation.points), peak_memory()])).tolist()
    result.points = int(points)
    result.imbalance = imbalance(simulation) if comm.size > 1 else {}
