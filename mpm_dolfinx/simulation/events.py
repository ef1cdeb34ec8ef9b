# SPDX-License-Identifier: MIT
"""Events that end a run: sign changes of the user's functions within a step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np
import scipy
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import Report, StepFailed
from mpm_dolfinx.base.time_integration import Substep
from mpm_dolfinx.base.validation import functions, line
from mpm_dolfinx.parallel.exchange import by_user
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State

LOCATED = 1e-3
"""Accuracy of the time of an event, divided by the length of the step.  Source: definition, see `until` of `run`."""

Event = Callable[[Any], float]
"""A user's function of the simulation that returns a number or a boolean."""


class Simulated(Protocol):
    """The part of a `Simulation` that the time loop needs."""

    scene: Scene
    state: State

    def advanced(self, dt: float, *how: Sequence[Substep]) -> tuple[State, Report]:
        """Return the state after a step of length `dt`, in s, and the report of the step."""

    def without_jump(self, dt: float) -> tuple[float, bool]:
        """Return the length of the next step, at most `dt`, in s, and whether a displacement jumps at its start.

        The step ends where a function of time jumps.
        """


class Step(NamedTuple):
    """A completed step."""

    start: State  # state at the start
    dt: float  # length of the step, s
    how: tuple  # substeps; empty if the step has the substeps of the scene


class Found(NamedTuple):
    """An event within a step."""

    number: int  # index of the function in `until`
    dt: float  # time from the start of the step, s
    new: State  # state at the event
    report: Report  # report of the step that ends at the event


class Events:
    """Search for the events of a run.

    Parameters
    ----------
    simulation
        Simulation at the start of the run.
    until
        One function of the simulation, or several. An event occurs when a returned number changes sign within a step,
        or when a returned boolean changes.

    Raises
    ------
    ValueError
        An entry of `until` is not a function.  A function returns no number, or different numbers on two processes.
    """

    def __init__(self, simulation: Simulated, until: Event | Sequence[Event] | None):
        self._until = [until] if callable(until) else [] if until is None else until
        functions("until", self._until)
        self._simulation = simulation
        if self._until:
            self._values()

    def within(self, step: Step, new: State) -> Found | None:
        """Return the first event within a step that ends in the state `new`, or None if there is no event.

        Trial steps locate the event, by Brent's method for numbers and by bisection for booleans.  The state in the
        result is later than the event by at most `LOCATED` times the length of the step.  After the search, the
        simulation is in the state at the start of the step.
        """
        if not self._until:
            return None
        before = self._values()
        try:
            self._simulation.state = new
            now = self._values()
            return self._located(step, before, now) if _crossed(before, now).any() else None
        finally:
            self._simulation.state = step.start

    def _located(self, step: Step, before: list[float], now: list[float]) -> Found:
        tried = {0.0: before, step.dt: now}
        try:
            for k in range(len(self._until)):
                end = min(dt for dt, values in tried.items() if _crossed(before, values).any())
                if _crossed(before, tried[end])[k] and tried[end][k] != 0:
                    scipy.optimize.brentq(lambda dt, k=k: self._at(step, dt, tried)[k], 0, end, xtol=LOCATED * step.dt)
        except StepFailed as failed:
            what = "until: the search for an event within a step of %.3g s stopped, because a shorter step failed: %s"
            warn(self._simulation.scene.grid.comm, ResolutionWarning, what, step.dt, failed)
        end = min(dt for dt, values in tried.items() if _crossed(before, values).any())
        self._simulation.state = step.start
        new, report = self._simulation.advanced(end, *step.how)  # again, because the scene keeps data of its last step
        return Found(int(_crossed(before, tried[end]).argmax()), end, new, report)

    def _at(self, step: Step, dt: float, tried: dict[float, list[float]]) -> list[float]:
        """Return the values of the user's functions after a trial step of length `dt`, in s."""
        if dt not in tried:
            self._simulation.state = step.start
            new, _ = self._simulation.advanced(dt, *step.how)
            self._simulation.state = replace(new, result=step.start.result, control=step.start.control)
            tried[dt] = self._values()
        return tried[dt]

    def _values(self) -> list[float]:
        """Return the values of the user's functions.  If one fails on any process, all processes raise an error."""
        s, comm = self._simulation, self._simulation.scene.grid.comm
        out = by_user(comm, "until: a function", lambda: [_number(k, of(s)) for k, of in enumerate(self._until)])
        check_alike(comm, {f"until: function {k}": value for k, value in enumerate(out)})
        return out


def check_alike(comm: MPI.Intracomm, given: Mapping[str, Any]) -> None:
    """Raise ValueError if the values differ between processes."""
    texts = comm.allgather([line(value) for value in given.values()])
    for k, name in enumerate(given):
        for rank, text in enumerate(texts):
            if text[k] != texts[0][k]:
                what = f"{name} = {texts[0][k]} on process 0, {text[k]} on process {rank}"
                raise ValueError(f"{what}, must be the same on all")


def _crossed(before: Sequence[float], now: Sequence[float]) -> NDArray[np.bool_]:
    """Return whether the sign of each value has changed since the start of a step."""
    sign = np.sign(before)
    return (sign != 0) & (np.sign(now) != sign)


def _number(k: int, value) -> float:
    """Return the value of a user's function as a number: 1 for True, and -1 for False."""
    if isinstance(value, (bool, np.bool_)):
        return 1.0 if value else -1.0
    try:
        out = float(value)
    except (TypeError, ValueError):
        out = np.nan
    if not np.isfinite(out):
        raise ValueError(f"until: function {k} gives {line(value)}, must be a finite number, or True or False")
    return out
