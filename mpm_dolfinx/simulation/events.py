# SPDX-License-Identifier: MIT
"""Events that end a run: zeros of functions of the simulation, located within a step."""

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
"""Accuracy of an event's time, relative to the length of the step.  Source: definition, as documented in `until`."""

Event = Callable[[Any], float]
"""A function of the simulation that returns a number or a boolean."""


class Simulated(Protocol):
    """Interface of a `Simulation`. Its `state` is only replaced as a whole."""

    scene: Scene
    state: State

    def advanced(self, dt: float, *how: Sequence[Substep]) -> tuple[State, Report]:
        """Return the state after a step of dt, s, and its report; how: substeps, by default the scene's substeps."""


class Step(NamedTuple):
    """A completed step."""

    start: State  # state at the start
    dt: float  # length of the step, s
    how: tuple  # substeps, if they differ from those of the scene


class Found(NamedTuple):
    """An event within a step."""

    number: int  # index of its function
    dt: float  # time from the start of the step, s
    new: State  # state at the event
    report: Report  # report of the step to the event


class Events:
    """The events of a run.

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
        An entry is not a function, returns no number, or returns different numbers on different processes.
    """

    def __init__(self, simulation: Simulated, until: Event | Sequence[Event] | None):
        self._until = [until] if callable(until) else [] if until is None else until
        functions("until", self._until)
        self._simulation = simulation
        if self._until:
            self._values()

    def within(self, step: Step, new: State) -> Found | None:
        """Return the first event within a step that ends in the state `new`, or None if there is no event.

        Trial steps from `step.start` locate the event. Brent's method chooses their lengths for functions that return
        numbers; booleans are located by bisection. The result is the first state found after the event, at most the
        fraction `LOCATED` of the step later. Afterwards, even after an error, `state` of the simulation is
        `step.start`.
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
        new, report = self._simulation.advanced(end, *step.how)  # repeated: the scene keeps data of its last step
        return Found(int(_crossed(before, tried[end]).argmax()), end, new, report)

    def _at(self, step: Step, dt: float, tried: dict[float, list[float]]) -> list[float]:
        """Return the functions' values at the end of a step of length dt, s, and store them in `tried`."""
        if dt not in tried:
            self._simulation.state = step.start
            new, _ = self._simulation.advanced(dt, *step.how)
            self._simulation.state = replace(new, result=step.start.result, control=step.start.control)
            tried[dt] = self._values()
        return tried[dt]

    def _values(self) -> list[float]:
        """Return the values of the functions, with booleans as 1 or -1. An error on one process is raised on all."""
        s, comm = self._simulation, self._simulation.scene.grid.comm
        out = by_user(comm, "until: a function", lambda: [_number(k, of(s)) for k, of in enumerate(self._until)])
        check_alike(comm, {f"until: function {k}": value for k, value in enumerate(out)})
        return out


def check_alike(comm: MPI.Intracomm, given: Mapping[str, Any]) -> None:
    """Raise ValueError if values differ between processes: the processes would wait for each other."""
    texts = comm.allgather([line(value) for value in given.values()])
    for k, name in enumerate(given):
        for rank, text in enumerate(texts):
            if text[k] != texts[0][k]:
                what = f"{name} = {texts[0][k]} on process 0, {text[k]} on process {rank}"
                raise ValueError(f"{what}, must be the same on all")


def _crossed(before: Sequence[float], now: Sequence[float]) -> NDArray[np.bool_]:
    """Return a mask of values with another sign than at the start of a step, where they are not zero."""
    sign = np.sign(before)
    return (sign != 0) & (np.sign(now) != sign)


def _number(k: int, value) -> float:
    """Return the value of a function as a number; booleans are 1 or -1."""
    if isinstance(value, (bool, np.bool_)):
        return 1.0 if value else -1.0
    try:
        out = float(value)
    except (TypeError, ValueError):
        out = np.nan
    if not np.isfinite(out):
        raise ValueError(f"until: function {k} gives {line(value)}, must be a finite number, or True or False")
    return out
