# SPDX-License-Identifier: MIT
"""The time loop: steps that are cut when they do not converge and grow again, and their histories."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from math import inf
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np
from dolfinx.common import Timer
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from mpm_dolfinx import _compat
from mpm_dolfinx.errors import GaveUp, LeftGrid, StepFailed
from mpm_dolfinx.io.summary import imbalance, peak_memory
from mpm_dolfinx.points.probes import Probes
from mpm_dolfinx.result import Report, Result
from mpm_dolfinx.scene import Scene
from mpm_dolfinx.state import State
from mpm_dolfinx.validation import functions, instance, line, numbers

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

Observer = Callable[[Any], None]
"""Called with the simulation."""


class Simulated(Protocol):
    """What the time loop drives: a `Simulation`, whose `state` it replaces."""

    scene: Scene
    state: State

    def advanced(self, dt: float) -> tuple[State, Report]:
        """Return the state after a step of dt, s, and what it took."""


def log(comm: MPI.Intracomm, message: str, *values) -> None:
    """Log a message of the package, once for all processes."""
    if comm.rank == 0:
        logger.info(message, *values)


def run(
    simulation: Simulated,
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
        probes.check(simulation.scene.bodies, simulation.state.stage.present)
    functions("observe", observers)
    functions("checkpoint", [checkpoint] if checkpoint is not None else [])
    if after is not None:
        instance("after", after, Result)
    t_end, dt = _times(simulation.state.t, t_end, dt, after is not None)
    result = _histories(simulation, t_end, dt, probes, after)
    dt, start, done = result.dt, result.rows[0][0], len(result.rows) - 1
    # a last interval that is a fraction of dt counts as one
    intervals = max(done + (t_end - simulation.state.t > 1e-9 * dt), round((t_end - start) / dt))
    stopwatch = _Stopwatch(result)
    _note(simulation, replace(result, converged=done == intervals))
    quiet = None if progress and simulation.scene.grid.comm.rank == 0 else True
    bar = tqdm(total=intervals, initial=done, disable=quiet, unit="step")
    with bar, nullcontext() if bar.disable else logging_redirect_tqdm():  # messages above the bar, not into it
        for k in range(done + 1, intervals + 1):
            target = t_end if k == intervals else start + k * dt
            while target - simulation.state.t > 1e-9 * dt:
                _advance(simulation, target)
                now = simulation.state.result
                bar.set_postfix(t=f"{simulation.state.t:.4g} s", newton=now.newton, coupling=now.coupling)
            with Timer("mpm: output"):
                ended = replace(simulation.state.result, converged=k == intervals)
                simulation.state = replace(simulation.state, t=target, result=stopwatch.read(ended))
                ended.rows.append(_row(simulation, probes))
                for observer in observers:
                    observer(simulation)
                _note(simulation, stopwatch.read(simulation.state.result))
                if checkpoint is not None:
                    checkpoint(simulation)
            bar.update()
    return _note(simulation, stopwatch.read(_measured(simulation)))


def _note(simulation: Simulated, result: Result) -> Result:
    """Note the histories so far in the state."""
    simulation.state = replace(simulation.state, result=result)
    return result


def _times(now: float, t_end: float, dt: float, goes_on: bool) -> tuple[float, float]:
    """Return end and step of a run from `now`, s; ValueError if there are none, or too many steps to tell apart."""
    more, least = (">=", now) if goes_on else (">", np.nextafter(now, inf))
    end = numbers("t_end", t_end, allowed=f"{more} {now:g} s and finite", test=lambda v: (v >= least) & (v < inf))
    allowed = f"> 0, and not below {(end - now) / MOST:g} s"
    return float(end), float(numbers("dt", dt, allowed=allowed, test=lambda v: (v > 0) & (v * MOST >= end - now)))


def _histories(simulation: Simulated, t_end: float, dt: float, probes: Probes | None, after: Result | None) -> Result:
    """Return new histories that begin with the present state, or those to go on with."""
    now = simulation.state.t
    dt = min(dt, t_end - (after.rows[0][0] if after else now))
    if after is None:
        return Result(dt=dt, small=dt, rows=[_row(simulation, probes)])
    latest, broken_off = simulation.state.result, False
    if latest is not None and after.rows is latest.rows:  # of the same run, which may have gone on since
        after = latest
        # and, broken off, have taken a part of its next interval
        broken_off = after.rows[-1][0] <= now <= after.rows[-1][0] + (1 + 1e-9) * dt
    if after.dt != dt or not (after.rows[-1][0] == now or broken_off):
        last = after.rows[-1][0]
        raise ValueError(f"dt = {dt!r} from t = {now!r}: the run to go on with has dt = {after.dt!r}, t = {last!r}")
    shown = after.rows[0][1]
    if (recorded := 0 if shown is None else len(shown)) != (0 if probes is None else len(probes.id)):
        raise ValueError(f"probes: the run to go on with has {recorded} of them")
    return after


class _Stopwatch:
    """Wall time and profile of a run, those that its histories have already included."""

    def __init__(self, result: Result):
        self._began = time.perf_counter() - result.wall
        self._timed = {part: seconds - result.profile.get(part, 0.0) for part, seconds in _timings().items()}

    def read(self, result: Result) -> Result:
        """Return the histories with the seconds so far."""
        profile = {part: seconds - self._timed[part] for part, seconds in _timings().items()}
        return replace(result, wall=time.perf_counter() - self._began, profile=profile)


def _timings() -> dict[str, float]:
    return {part: _compat.seconds(f"mpm: {part}") for part in PARTS}


def _advance(simulation: Simulated, target: float) -> None:
    """Take one step towards a time, s, cutting it until it converges."""
    comm = simulation.scene.grid.comm
    while True:
        state, result = simulation.state, simulation.state.result
        left, small = target - state.t, result.small
        if left < (1 + 1e-9) * small:  # steps that fit but for rounding are all of the same length
            small = small if left > (1 - 1e-9) * small else left
        try:
            new, report = simulation.advanced(small)
        except StepFailed as failed:
            if small / 2 < MIN_CUT * result.dt:
                raise GaveUp(_why(state.t, small, failed), _cut(simulation, small), failed.history) from failed
            _cut(simulation, small / 2)
            log(comm, "t = %g s: step cut to %.3g s: %s", state.t, small / 2, failed)
            continue
        # a step as long as one that has just failed would mostly fail again: in soil that yields, 78 cuts instead of 1
        grown = max(result.small, min(2 * small, result.dt)) if report.easy else result.small
        simulation.state = replace(new, result=result.after(report, grown))
        if grown > 1.01 * result.small:  # not by rounding only
            log(comm, "t = %g s: step grows to %.3g s", new.t, grown)
        return


def _cut(simulation: Simulated, small: float) -> Result:
    """Note a cut, and the step to try next, s."""
    result = simulation.state.result
    return _note(simulation, replace(result, cuts=result.cuts + 1, small=small))


def _why(t: float, small: float, failed: StepFailed) -> str:
    """Return why a run gave up at t with a step `small`, s."""
    if isinstance(failed, LeftGrid):
        return str(failed)
    why = "shorter steps help only where loads grow with time, as functions of t; the soil may have no equilibrium"
    return f"gave up at t = {t:g} s with dt = {small:.3g} s: {failed}; {why} (collapse, buckling)"


def _row(simulation: Simulated, probes: Probes | None) -> tuple:
    """Return what the histories hold of the present state."""
    comm, points, pressure = simulation.scene.grid.comm, simulation.state.points, None
    moved = None if probes is None else probes.displacement(points, comm)
    if simulation.scene.fluid:
        p = points.pressure
        ends = comm.allgather((p.min(initial=np.inf), p.max(initial=-np.inf)))
        pressure = (min(e[0] for e in ends), max(e[1] for e in ends))
    return simulation.state.t, moved, pressure


def _measured(simulation: Simulated) -> Result:
    """Return the histories with the memory, and how evenly processes share the work."""
    comm, state = simulation.scene.grid.comm, simulation.state
    points, memory = comm.allreduce(np.array([len(state.points), peak_memory()])).tolist()
    even = imbalance(simulation.scene, state) if comm.size > 1 else {}
    return replace(state.result, points=int(points), memory=memory, imbalance=even)
