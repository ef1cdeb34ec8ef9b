# SPDX-License-Identifier: MIT
"""The time loop: steps that are cut when they do not converge and grow again, and their histories."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from inspect import signature
from logging import INFO, WARNING
from math import inf
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np
from dolfinx.common import Timer
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.errors import LeftGrid, Report, StepFailed
from mpm_dolfinx.base.histories import Row, Rows
from mpm_dolfinx.base.time_integration import EULER, Substep
from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.base.validation import flag, functions, instance, line
from mpm_dolfinx.dynamics.energies import begun
from mpm_dolfinx.parallel.exchange import first
from mpm_dolfinx.parallel.messages import ResolutionWarning, log, logger, warn
from mpm_dolfinx.probing.probe_fields import probe_pressures, probe_stresses
from mpm_dolfinx.probing.probes import Probes, check_there
from mpm_dolfinx.simulation.events import Event, Events, Step
from mpm_dolfinx.simulation.step_size import StepSize, Times, measured, step_rule
from mpm_dolfinx.simulation.summary import imbalance, peak_memory
from mpm_dolfinx.stepping.result import GaveUp, Result
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State
from mpm_dolfinx.stepping.step_control import StepControl

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

Observer = Callable[[Any], None]
"""Called with the simulation."""


class Simulated(Protocol):
    """What the time loop drives: a `Simulation`, whose `state` it replaces."""

    scene: Scene
    state: State

    def advanced(self, dt: float, *how: Sequence[Substep]) -> tuple[State, Report]:
        """Return the state after a step of dt, s, and what it took; how: substeps, if not those of the scene."""


def run(
    simulation: Simulated,
    t_end: float,
    dt: float | None = None,
    *,
    rtol: float | None = None,
    t_eval: Sequence[float] | None = None,
    first_step: float | None = None,
    max_step: float = inf,
    until: Event | Sequence[Event] | None = None,
    probes: Probes | None = None,
    observe: Observer | Sequence[Observer] = (),
    checkpoint: Observer | None = None,
    after: Result | None = None,
    energies: bool = False,
    progress: bool = True,
) -> Result:
    """Advance to t_end, in steps of dt or in steps chosen by their error.

    A step that does not converge is cut in two; steps then grow again.

    Parameters
    ----------
    t_end
        End time, s, not a duration: > t.
    dt
        Step and output interval, s, > 0; one step to t_end where it is longer than that.  With `rtol` the output
        interval only; without it and `t_eval` every step is an output.
    rtol
        Choose the steps by their error: that of the pore pressures stays below about rtol of their largest change
        since the run began, or of what they would change by in the step if no fluid flowed, which is more where it
        flows away within the step; at least ten times `tolerance`, and < 1.  Where nothing flows the steps are as long
        as the output intervals; refused there with terms of the velocity, of which no error is known.  Of bodies with
        inertia the motion counts too, see `motion_error`, in proportion to the largest since the run began.  So does
        the water content of soil that drains under suction, to the largest change of it in a step so far.  The error
        is estimated, as a share of that of a first-order step: true ones were 0.7 to 5 times as large, the latter in
        the step after a load jumps, see `solve.newton.ERROR`.
    t_eval : (m,), s
        Output times, increasing, in (t, t_end]; t_end is one of them in any case.  Steps end at output times.
    first_step, max_step
        With `rtol`: the first step to try, not of a run that goes on, and the longest, s, > 0.  By default the first is
        about the time in which pressures diffuse through a cell, times 20 rtol, or a thousandth of the first output.
    until
        Functions of the simulation, or one, that end the run before t_end: where the sign of a number changes within a
        step, or a truth turns true, such as `lambda s: -s.points.displacement[:, 1].min() - 0.1`.  What is so at the
        start is no event.  Steps of other lengths find where: the last state is the first one found in which the event
        has occurred, a thousandth of that step after it at most.  It is an output; `Result.event` says which and when.
        On several processes all give the same.  Histories that an event has ended are at their end, as at t_end, where
        a run goes on with them; without `until` it goes on.
    probes
        Particles that are recorded.
    observe
        Called with the simulation at each output time, such as a `Writer`; its `result` then holds the histories so
        far.
    checkpoint
        Called after all observers: a `Checkpoint`.
    after
        Histories to go on with, of a run with the same steps: what `resume` returns, or `result` of a run that was
        interrupted.
    energies
        Record energies of bodies with inertia, and works from the start of the run on: `Result.energies`.
    progress
        Show a progress bar on a terminal, and warn of the first step that is cut; the others are logged as INFO by the
        logger `mpm_dolfinx`.

    Returns
    -------
    The histories.

    Raises
    ------
    ValueError
        An argument, or what a function of time gives, is none that is allowed.
    GaveUp
        With the histories so far; `points` and `t` are those of the last good step.
    """
    comm = simulation.scene.grid.comm
    simulation.scene.check(simulation.state)
    _check_alike(comm, {"t_end": t_end, "dt": dt, "rtol": rtol, "t_eval": t_eval, "max_step": max_step})
    if probes is not None and not isinstance(probes, Probes):
        raise ValueError(f"probes = {line(probes)}, must be what `probes` gives")
    observers = [observe] if callable(observe) else observe
    if probes is not None:
        probes.check(simulation.scene.bodies, simulation.state.stage.present)
        check_there(probes, simulation.state.points, comm)
    functions("observe", observers)
    for observer in observers:
        if _takes_nothing(observer):
            raise ValueError(f"observe: {line(observer)}, must be a function of the simulation")
    functions("checkpoint", [checkpoint] if checkpoint is not None else [])
    if after is not None:
        instance("after", after, Result)
    flag("energies", energies)
    simulation.state = _counting(simulation.scene, simulation.state, energies, after is not None)
    simulation.state = replace(simulation.state, watched=None if probes is None else probes.id)
    now = simulation.state.t
    start = now if after is None else after.rows[0].t
    times = Times(start, now, t_end, dt, t_eval, rtol, after is not None)
    rule = step_rule(times, rtol, first_step, max_step, simulation.scene, simulation.state.points)
    result, control = _histories(simulation, times, rule, probes, after)
    stopwatch, last = _Stopwatch(result), result.rows[-1].t
    events = Events(simulation, until)
    targets = [] if until is not None and result.event is not None else times.after(last)
    _note(simulation, replace(result, converged=not targets, event=None if targets else result.event), control)
    bar = _bar(start, last, times.end, progress and comm.rank == 0)

    def output(converged: bool) -> None:
        with Timer("mpm: output"):
            ended = replace(simulation.state.result, converged=converged)
            _note(simulation, stopwatch.read(ended).more(_row(simulation, probes)))
            for observer in observers:
                _observe(observer, simulation, comm)
            _note(simulation, stopwatch.read(simulation.state.result))
            if checkpoint is not None:
                checkpoint(simulation)

    # messages above the bar, not into it
    with bar, nullcontext() if bar.disable else logging_redirect_tqdm([logger] if logger.handlers else None):
        for target in targets:
            while not rule.ended(simulation.state.t, target, simulation.state.control):
                before = simulation.state.t
                if _take_step(simulation, rule, target, progress, events):
                    output(True)
                    return _note(simulation, stopwatch.read(_measured(simulation)))
                there = rule.ended(simulation.state.t, target, simulation.state.control)
                if times.each and not there:
                    output(False)
                _show(bar, simulation.state, before)
            simulation.state = replace(simulation.state, t=target)
            output(target == times.end)
    return _note(simulation, stopwatch.read(_measured(simulation)))


def _check_alike(comm: MPI.Intracomm, given: dict[str, Any]) -> None:
    """Refuse arguments that are not the same on all processes, which would wait for each other."""
    texts = comm.allgather([line(value) for value in given.values()])
    for k, name in enumerate(given):
        for rank, text in enumerate(texts):
            if text[k] != texts[0][k]:
                what = f"{name} = {texts[0][k]} on process 0, {text[k]} on process {rank}"
                raise ValueError(f"{what}, must be the same on all")


def _bar(start: float, now: float, end: float, shown: bool) -> tqdm:
    """Return a progress bar in time."""
    form = "{percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"
    return tqdm(total=end - start, initial=now - start, bar_format=form, disable=None if shown else True)


def _show(bar: tqdm, state: State, before: float) -> None:
    """Show where a run is."""
    result = state.result
    bar.update(state.t - before)
    counts = {"t": f"{state.t:.4g} s", "steps": result.steps, "newton": result.newton, "coupling": result.coupling}
    seldom = {"cuts": result.cuts, "refused": result.rejected}
    bar.set_postfix(counts | {name: count for name, count in seldom.items() if count})


def _note(simulation: Simulated, result: Result, control: StepControl | None = None) -> Result:
    """Note the histories so far in the state, and the memory of the step sizes if it has changed."""
    simulation.state = replace(simulation.state, result=result, control=control or simulation.state.control)
    return result


def _takes_nothing(function: Callable) -> bool:
    """Return whether a function is known to have no argument; of some that are built in nothing is known."""
    try:
        return not signature(function).parameters
    except (TypeError, ValueError):
        return False


def _observe(observer: Callable, simulation: Simulated, comm: MPI.Intracomm) -> None:
    """Call an observer; raise on all processes if it raises on one, that none waits for the others."""
    raised = None
    try:
        observer(simulation)
    except BaseException as error:  # also Ctrl-C
        raised = error
    where = first(comm, "" if raised is None else f"process {comm.rank}")
    if raised is not None:
        raise raised
    if where:
        raise RuntimeError(f"observe: {line(observer)} has raised an error on {where}")


def _histories(
    simulation: Simulated, times: Times, rule: StepSize, probes: Probes | None, after: Result | None
) -> tuple[Result, StepControl]:
    """Return new histories that begin with the present state, or those to go on with, and the memory of the steps."""
    state = simulation.state
    latest = simulation.state.result
    control = simulation.state.control
    if after is None:
        motion = 0.0 if rule.by_error and state.stage.inertia else None
        before = 0.0 if control is None else control.first
        begun = StepControl(times.interval, rule.first, first=before, motion=motion)
        return Result(Rows([_row(simulation, probes)])), begun
    if latest is None or control is None or after.rows.run is not latest.rows.run:
        raise ValueError("after: histories of another run, must be those of the last one, or what `resume` returns")
    after = latest  # which may have gone on since, or not
    now = state.t
    start = after.rows[0]
    last = after.rows[-1].t
    # a run that was broken off has taken a part of its next interval
    if control.interval != times.interval or not last <= now <= times.next(last):
        what = f"dt = {times.interval!r} from t = {now!r}: the run to go on with has dt = {control.interval!r}"
        raise ValueError(f"{what}, t = {last!r}; with other steps, or t_eval, begin new histories: without after")
    count = 0 if probes is None else len(probes.id)
    if (recorded := len(start.displacement)) != count:
        raise ValueError(f"probes: the run to go on with has {recorded} of them")
    if count and probes.stressed != (len(start.probe_stress) > 0):
        raise ValueError(f"probes: stress = {probes.stressed}, must be what the run to go on with has")
    return after, control


def _counting(scene: Scene, state: State, energies: bool, goes_on: bool) -> State:
    """Return the state with energies from which works count, or with those of a run that goes on; or without any."""
    if energies and not state.stage.inertia:
        raise ValueError("energies = True: bodies have no inertia, must be a stage with inertia=True")
    if energies and goes_on and "energy" in state.outcome:
        return state
    outcome = {quantity: of for quantity, of in state.outcome.items() if quantity != "energy"}
    if energies:
        outcome["energy"] = begun(scene.materials, state.points, state.stage.kinetic(outcome))
    return replace(state, outcome=outcome)


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


def _take_step(simulation: Simulated, rule: StepSize, target: float, aloud: bool, events: Events) -> bool:
    """Take one step towards a time, s; return whether an event has ended the run in it."""
    step, new = _advance(simulation, rule, target, aloud)
    found = events.within(step, new)
    if found is None:
        simulation.state = new
        return False
    event = found.number, found.new.t
    new = _accepted(rule, step.start, found.dt, found.new, found.report)
    simulation.state = replace(new, result=replace(new.result, event=event))
    return True


def _accepted(
    rule: StepSize, start: State, taken: float, new: State, report: Report, wanted: float | None = None
) -> State:
    """Return the state after a step of a length, s, with the histories; wanted: what it should have been, s."""
    grown = measured(start.control, report, start.result)
    grown = rule.grown(taken, report, grown, failed=taken < (1 - SAME) * (wanted or taken))
    grown = replace(grown, first=0.0 if new.stays else report.first / taken)
    return replace(new, result=start.result.after(report), control=grown)


def _advance(simulation: Simulated, rule: StepSize, target: float, aloud: bool) -> tuple[Step, State]:
    """Return a step towards a time, s, and its end, cut until it converges and is exact enough.

    aloud: say of the first cut of a run that there are some.
    """
    comm = simulation.scene.grid.comm
    wanted = None
    whole = None
    while True:
        state = simulation.state
        result = simulation.state.result
        control = simulation.state.control
        taken, how = rule.fitted(target - state.t, control.small), ()
        wanted, whole = wanted or rule.wanted(taken), whole or taken
        try:
            new, report = simulation.advanced(taken)
        except StepFailed as failed:
            cut, counted = rule.cut(taken, control), replace(result, cuts=result.cuts + 1)
            left = _has_left(failed, rule, taken, state)
            if not left and cut.small >= rule.least(wanted, state.t):
                _note(simulation, counted, cut)
                loud = aloud and not result.cuts
                level, more = (WARNING, "; others: messages of level INFO") if loud else (INFO, "")
                log(comm, "t = %g s: step cut to %.3g s: %s%s", state.t, taken / 2, failed, more, level=level)
                continue
            if (found := _by_euler(simulation, whole, failed)) is None:
                tried = result if left else _note(simulation, counted, replace(cut, small=taken))
                raise GaveUp(_why(state.t, taken, failed), tried, failed.history) from failed
            taken = whole
            how = (EULER,)
            (new, report) = found
        now = measured(control, report, result)
        if (shrinks := rule.refused(taken, report, now)) < 1:
            small = wanted = taken * shrinks
            if state.t + small == state.t:
                why = f"gave up at t = {state.t:g} s: no step is short enough for rtol = {rule.rtol:g}"
                raise GaveUp(why, result, report.history)
            _note(simulation, replace(result, rejected=result.rejected + 1), replace(control, small=small))
            continue
        new = _accepted(rule, state, taken, new, report, wanted)
        if not rule.by_error and new.control.small > control.small:
            log(comm, "t = %g s: step grows to %.3g s", new.t, new.control.small)
        return Step(state, taken, how), new


def _by_euler(simulation: Simulated, dt: float, failed: StepFailed) -> tuple[State, Report] | None:
    """Return the state after a step of dt (s) by backward Euler, and what it took; None: that fails too.

    Where loads jump the second substep goes far beyond what is left of them, which soil may not bear.
    """
    if isinstance(failed, LeftGrid) or len(simulation.scene.substeps) == 1:
        return None
    try:
        found = simulation.advanced(dt, EULER)
    except StepFailed:
        return None
    what = "t = %g s: a step of %.3g s by backward Euler, of first order: none by %s has converged: %s"
    values = simulation.state.t, dt, simulation.scene.numerics.method, failed
    warn(simulation.scene.grid.comm, ResolutionWarning, what, *values)
    return found


def _has_left(failed: StepFailed, rule: StepSize, taken: float, state: State) -> bool:
    """Return whether points leave the grid in a step that is exact enough: shorter ones would only lead there."""
    if not isinstance(failed, LeftGrid) or failed.report is None:
        return False
    return rule.refused(taken, failed.report, measured(state.control, failed.report, state.result)) == 1


def _why(t: float, small: float, failed: StepFailed) -> str:
    """Return why a run gave up at t with a step `small`, s."""
    if isinstance(failed, LeftGrid):
        return str(failed)
    why = "shorter steps help only where loads grow with time, as functions of t; the soil may have no equilibrium"
    return f"gave up at t = {t:g} s with dt = {small:.3g} s: {failed}; {why} (collapse, buckling)"


def _row(simulation: Simulated, probes: Probes | None) -> Row:
    """Return what the histories hold of the present state."""
    scene, state = simulation.scene, simulation.state
    comm = scene.grid.comm
    d = scene.grid.dim
    points = state.points
    wet = scene.fluid is not None
    out = {"displacement": np.zeros((0, d)), "position": np.zeros((0, d))}
    if wet:
        ends = comm.allgather((points.pressure.min(initial=np.inf), points.pressure.max(initial=-np.inf)))
        out["pressure"] = np.array([min(e[0] for e in ends), max(e[1] for e in ends)])
    if probes is not None:
        out["displacement"] = probes.displacement(points, comm)
        out["position"] = probes.position(points, comm) + scene.grid.base
    if probes is not None and wet:
        out["probe_pressure"] = probe_pressures(scene, state, probes)
    if probes is not None and probes.stressed:
        out["probe_stress"] = probe_stresses(scene, state, probes)
    return Row(state.t, **out, outcome=state.outcome)


def _measured(simulation: Simulated) -> Result:
    """Return the histories with the memory, and how evenly processes share the work."""
    comm, state = simulation.scene.grid.comm, simulation.state
    points, memory = comm.allreduce(np.array([len(state.points), peak_memory()])).tolist()
    even = imbalance(simulation.scene, state) if comm.size > 1 else {}
    return replace(state.result, points=int(points), memory=memory, imbalance=even)
