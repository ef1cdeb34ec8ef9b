# SPDX-License-Identifier: MIT
"""Time loop of a run, which computes steps and records histories."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from inspect import signature
from logging import INFO, WARNING
from typing import Any

import numpy as np
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.errors import CannotFollow, LeftGrid, Report, StepFailed
from mpm_dolfinx.base.histories import Row, Rows
from mpm_dolfinx.base.time_integration import EULER
from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.base.validation import flag, functions, instance, line
from mpm_dolfinx.dynamics.energies import drift, initial_energies
from mpm_dolfinx.parallel.exchange import by_user
from mpm_dolfinx.parallel.messages import ConditionWarning, ResolutionWarning, log, logger, warn
from mpm_dolfinx.probing.probe_fields import probe_pressures, probe_stresses
from mpm_dolfinx.probing.probes import Probes, check_there
from mpm_dolfinx.simulation.events import Event, Events, Simulated, Step, check_alike
from mpm_dolfinx.simulation.step_size import Adaptive, StepSize, Times, measured, step_rule
from mpm_dolfinx.simulation.summary import imbalance, peak_memory
from mpm_dolfinx.stepping.distribution import distribute
from mpm_dolfinx.stepping.result import GaveUp, Result
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State, StepControl

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
"""Parts of a run whose wall time is measured."""

Observer = Callable[[Any], None]
"""A function that a run calls with the simulation as argument."""


def run(
    simulation: Simulated,
    t_end: float,
    dt: float | None = None,
    *,
    rtol: float | Adaptive | None = None,
    t_eval: Sequence[float] | None = None,
    until: Event | Sequence[Event] | None = None,
    probes: Probes | None = None,
    observe: Observer | Sequence[Observer] = (),
    checkpoint: Observer | None = None,
    after: Result | None = None,
    energies: bool = False,
    progress: bool = True,
) -> Result:
    """Advance to t_end, in steps of dt or in adaptive steps.

    A step that does not converge is halved.  Later steps become longer again.

    Parameters
    ----------
    t_end
        End time, s, > t (not a duration).
    dt
        Length of a step, and output interval, s, > 0; limited to t_end - t. With `rtol`, `dt` is only the output
        interval. With `rtol`, but without `dt` and `t_eval`, every step is an output.
    rtol
        Tolerance of adaptive steps, or `Adaptive`, which adds limits of the step length. The estimated error of the
        pore pressures stays below about `rtol` times the larger of two pressure changes: the largest change since the
        start of the run, and the undrained change in the step. `rtol` is at least ten times `tolerance`, and < 1. If no
        fluid flows, each step is one output interval.  Without flow, terms and laws that depend on velocity raise
        ValueError: their error cannot be estimated.  With inertia, `rtol` also limits the error of the motion, relative
        to the largest motion since the start, see `motion_error`.  In unsaturated soil, `rtol` also limits the error of
        the water content, relative to the largest change of water content in any step so far.  The estimated error of a
        pressure is the fraction `solve.newton.ERROR` of the error of a first-order step.  In tests, the largest true
        error of a run was 0.7 to 5 times the largest estimate.  The factor 5 occurred after a jump of the load.
    t_eval : (n,), s
        Output times, increasing, in (t, t_end].  The time t_end is always an output time. Steps end at output times.
    until
        One function of the simulation, or several, that end the run before t_end. An event occurs within a step when a
        returned number changes its sign, or a returned boolean changes. A number that is zero at the start of a step
        causes no event.  Example of a number: `lambda s: -s.points.displacement[:, 1].min() - 0.1`.  The run ends at
        most a thousandth of the step length after the event.  The final state is an output, and `Result.event` contains
        the function's index and the time. The functions must return equal values on all processes.  An event ends the
        run like t_end.  A later run without `until` may continue its histories.
    probes
        Material particles at which results are recorded.
    observe
        Functions of the simulation, called at each output time, such as a `Writer`.  During a call, `Simulation.result`
        contains the histories so far.
    checkpoint
        Function called after all observers, such as a `Checkpoint`.
    after
        Histories that this run continues: the result of `resume`, or `Simulation.result` after an interrupted run. `dt`
        must be the same as in that run.
    energies
        Whether to record energies of bodies with inertia, and the work of forces since the start, in `Result.energies`.
    progress
        Whether to show a progress bar on a terminal, and to warn of the first reduced step. The logger `mpm_dolfinx`
        reports all later reduced steps at level INFO.

    Returns
    -------
    The histories.

    Raises
    ------
    ValueError
        An argument is invalid, or a function of time returns an invalid value.
    GaveUp
        The shortest allowed step failed. The exception contains the histories so far, and the simulation is in the
        state after the last completed step.
    """
    comm = simulation.scene.grid.comm
    simulation.scene.check(simulation.state)
    check_alike(comm, {"t_end": t_end, "dt": dt, "rtol": rtol, "t_eval": t_eval})
    if probes is not None and not isinstance(probes, Probes):
        raise ValueError(f"probes = {line(probes)}, must be a result of `probes`")
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
    state = simulation.scene.followed(simulation.state)  # the first step depends on the size of the cells
    rule = step_rule(times, rtol, simulation.scene, state)
    result, control = _histories(simulation, times, rule, probes, after)
    stopwatch, last = _Stopwatch(result), result.rows[-1].t
    events = Events(simulation, until)
    targets = [] if until is not None and result.event is not None else times.after(last)
    _note(simulation, replace(result, converged=not targets, event=None if targets else result.event), control)
    bar = _bar(start, last, times.end, progress and comm.rank == 0)

    def output(converged: bool) -> None:
        with _compat.Timer("output"):
            ended = replace(simulation.state.result, converged=converged)
            _note(simulation, stopwatch.read(ended).more(_row(simulation, probes)))
            for observer in observers:
                by_user(comm, f"observe: {line(observer)}", partial(observer, simulation))
            if checkpoint is not None:
                _note(simulation, stopwatch.read(simulation.state.result))
                checkpoint(simulation)

    # messages appear above the bar
    with bar, nullcontext() if bar.disable else logging_redirect_tqdm([logger] if logger.handlers else None):
        for target in targets:
            while not rule.ended(simulation.state.t, target, simulation.state.control):
                before = simulation.state.t
                if _take_step(simulation, rule, target, progress, events):
                    output(True)
                    return _note(simulation, stopwatch.read(_measured(simulation)))
                reached = rule.ended(simulation.state.t, target, simulation.state.control)
                if times.each and not reached:
                    output(False)
                _show(bar, simulation.state, before)
            simulation.state = replace(simulation.state, t=target)
            output(target == times.end)
    return _note(simulation, stopwatch.read(_measured(simulation)))


def _bar(start: float, now: float, end: float, shown: bool) -> tqdm:
    """Return a progress bar for the time of a run."""
    form = "{percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"
    return tqdm(total=end - start, initial=now - start, bar_format=form, disable=None if shown else True)


def _show(bar: tqdm, state: State, before: float) -> None:
    """Update the progress bar of a run.  Until now the bar has shown the time `before`, in s."""
    result = state.result
    bar.update(state.t - before)
    counts = {"t": f"{state.t:.4g} s", "steps": result.steps, "newton": result.newton, "coupling": result.coupling}
    seldom = {"cuts": result.cuts, "refused": result.rejected}
    bar.set_postfix(counts | {name: count for name, count in seldom.items() if count})


def _note(simulation: Simulated, result: Result, control: StepControl | None = None) -> Result:
    """Store histories, and optionally a step control, in the state of the simulation.  Return the histories."""
    simulation.state = replace(simulation.state, result=result, control=control or simulation.state.control)
    return result


def _takes_nothing(function: Callable) -> bool:
    """Return whether a function has no parameters."""
    try:
        return not signature(function).parameters
    except (TypeError, ValueError):
        return False


def _histories(
    simulation: Simulated, times: Times, rule: StepSize, probes: Probes | None, after: Result | None
) -> tuple[Result, StepControl]:
    """Return the histories and the step control at the start of a run."""
    state = simulation.state
    latest = simulation.state.result
    control = simulation.state.control
    if after is None:
        before = {} if control is None else {"first": control.first, "filled": control.filled}
        fresh = StepControl(times.interval, rule.first, **before)
        if rule.by_error and state.stage.inertia:
            held = state.stage.supported(state.points.corners)
            fresh = replace(fresh, motion=0.0, drift=drift(simulation.scene.materials, state.points, held))
        return Result(Rows([_row(simulation, probes)])), fresh
    if latest is None or control is None or after.rows.run is not latest.rows.run:
        raise ValueError("after: histories of another run, must be histories of the last run, or a result of `resume`")
    after = latest  # the run may have advanced since `after`
    now = state.t
    start = after.rows[0]
    last = after.rows[-1].t
    # an interrupted run may have stopped between two outputs
    if control.interval != times.interval or not last <= now <= times.next(last):
        what = f"dt = {times.interval!r} from t = {now!r}: the run that is continued has dt = {control.interval!r}"
        raise ValueError(f"{what}, t = {last!r}; for other steps or t_eval, run without `after` (new histories)")
    count = 0 if probes is None else len(probes.id)
    if (recorded := len(start.displacement)) != count:
        raise ValueError(f"probes: {count} probes, must be {recorded}, as in the run that is continued")
    if count and probes.stressed != (len(start.probe_stress) > 0):
        raise ValueError(f"probes: stress = {probes.stressed}, must be as in the run that is continued")
    return after, control


def _counting(scene: Scene, state: State, energies: bool, goes_on: bool) -> State:
    """Return the state at the start of a run, with its energies if `energies` is True."""
    if energies and not state.stage.inertia:
        raise ValueError("energies = True: bodies have no inertia, must be in a stage with inertia=True")
    if energies and goes_on and "energy" in state.outcome:
        return state
    outcome = {quantity: of for quantity, of in state.outcome.items() if quantity != "energy"}
    if energies:
        kinetic = state.stage.kinetic(outcome)
        outcome["energy"] = initial_energies(scene.materials, state.points, kinetic)
    return replace(state, outcome=outcome)


class _Stopwatch:
    """Wall time and profile of a run, including the runs that it continues."""

    def __init__(self, result: Result):
        self._start = time.perf_counter() - result.wall
        self._timed = {part: _compat.seconds[part] - result.profile.get(part, 0.0) for part in PARTS}

    def read(self, result: Result) -> Result:
        """Return the result with the present wall time and profile."""
        profile = {part: _compat.seconds[part] - self._timed[part] for part in PARTS}
        return replace(result, wall=time.perf_counter() - self._start, profile=profile)


def _take_step(simulation: Simulated, rule: StepSize, target: float, verbose: bool, events: Events) -> bool:
    """Compute one step towards the time `target`, in s, and return whether an event ends the run."""
    distribute(simulation)
    step, new = _advance(simulation, rule, target, verbose)
    found = events.within(step, new)
    if found is None:
        simulation.state = new
        return False
    event = found.number, found.new.t
    new = _accepted(rule, step.start, found.dt, found.new, found.report)
    simulation.state = replace(new, result=replace(new.result, event=event))
    return True


def _accepted(
    rule: StepSize, start: State, size: float, new: State, report: Report, preferred: float | None = None
) -> State:
    """Return the state after an accepted step, with new histories and a new step control."""
    grown = measured(start.control, report)
    grown = rule.grown(size, report, grown, failed=size < (1 - SAME) * (preferred or size))
    grown = replace(grown, first=np.divide(report.first, size).tolist())
    return replace(new, result=start.result.after(report), control=grown)


def _advance(simulation: Simulated, rule: StepSize, target: float, verbose: bool) -> tuple[Step, State]:
    """Return a step towards the time `target`, in s, and the state at its end.

    The step is shortened until it converges and its errors are within the tolerances.
    """
    comm = simulation.scene.grid.comm
    preferred = whole = halved = None
    cause: StepFailed | None = None
    while True:
        state = simulation.state
        result = simulation.state.result
        control = simulation.state.control
        size, how = rule.fitted(target - state.t, control.small), ()
        size, sudden = simulation.without_jump(size)
        if sudden and not (whole or rule.by_error):
            _warn_sudden(simulation)
        preferred, whole = preferred or rule.preferred(size), whole or size
        halved = halved or rule.whole(size, control.small)
        try:
            new, report = simulation.advanced(size)
        except StepFailed as failed:
            cause = cause if isinstance(cause, CannotFollow) else failed  # its message is clearer than later ones
            cut, counted = rule.cut(size, control), replace(result, cuts=result.cuts + 1)
            if not result.cuts:
                _warn_steep(simulation.scene, failed)
            left = _has_left(failed, rule, size, state, halved)
            if not left and cut.small >= rule.least(preferred, state.t):
                _note(simulation, counted, cut)
                verbose_step = verbose and not result.cuts
                level, more = (WARNING, "; others: messages of level INFO") if verbose_step else (INFO, "")
                log(comm, "t = %g s: step cut to %.3g s: %s%s", state.t, size / 2, failed, more, level=level)
                continue
            if (found := _by_euler(simulation, whole, failed)) is None:
                tried = result if left else _note(simulation, counted, replace(cut, small=size))
                raise GaveUp(_why(state.t, size, cause), tried, failed.history) from failed
            size = whole
            how = (EULER,)
            (new, report) = found
        now = measured(control, report)
        if (shrinks := rule.refused(size, report, now, halved)) < 1:
            small = preferred = size * shrinks
            if state.t + small == state.t:
                why = f"gave up at t = {state.t:g} s: no step is short enough for rtol = {rule.rtol:g}"
                raise GaveUp(why, result, report.history)
            _note(simulation, replace(result, rejected=result.rejected + 1), replace(control, small=small))
            continue
        new = _accepted(rule, state, size, new, report, preferred)
        if not rule.by_error and new.control.small > control.small:
            log(comm, "t = %g s: step grows to %.3g s", new.t, new.control.small)
        return Step(state, size, how), new


def _by_euler(simulation: Simulated, dt: float, failed: StepFailed) -> tuple[State, Report] | None:
    """Return the state and the report after a step by backward Euler, or None if this step also fails.

    After a jump of the loads, SDIRK2 may fail: it overshoots, and the soil may be too weak for the overshoot.
    """
    if isinstance(failed, LeftGrid) or len(simulation.scene.substeps(simulation.state.stage)) == 1:
        return None
    try:
        found = simulation.advanced(dt, EULER)
    except StepFailed:
        return None
    what = "t = %g s: a step of %.3g s by backward Euler, of first order, because no step by %s converged: %s"
    values = simulation.state.t, dt, simulation.scene.numerics.method, failed
    warn(simulation.scene.grid.comm, ResolutionWarning, what, *values)
    return found


def _warn_sudden(simulation: Simulated) -> None:
    """Warn of a displacement that jumps in a scene with flow of fluid."""
    if len(simulation.scene.substeps(simulation.state.stage)) > 1:
        what = "t = %g s: a displacement jumps, and equal steps are too long for the sudden pore pressures; use rtol"
        more = ", or a function that is continuous in time"
        warn(simulation.scene.grid.comm, ResolutionWarning, what + more, simulation.state.t)


def _warn_steep(scene: Scene, failed: StepFailed) -> None:
    """Warn of a retention curve with infinite dk_r/ds at s = 0, if a step failed in the balance of fluid."""
    if getattr(failed, "field", None) != "storage" or scene.materials.retentions is None:
        return
    for law in scene.materials.retentions.laws:
        if getattr(law, "steep", False):
            what = (
                "%s: n < 2 without air_entry, so dk_r/ds is infinite at s = 0, and steps may fail or become very short;"
            )
            more = " give air_entry, for example the pressure of 0.02 m of water"
            warn(scene.grid.comm, ConditionWarning, what + more, line(law))
            return


def _has_left(failed: StepFailed, rule: StepSize, size: float, state: State, whole: float) -> bool:
    """Return whether points leave the grid in a step whose errors are within the tolerances."""
    if not isinstance(failed, LeftGrid) or failed.report is None:
        return False
    return rule.refused(size, failed.report, measured(state.control, failed.report), whole) == 1


def _why(t: float, small: float, failed: StepFailed) -> str:
    """Return the error message of a run that gave up."""
    if isinstance(failed, LeftGrid):
        return str(failed)
    why = "shorter steps help only where loads grow with time, as functions of t; the soil may have no equilibrium"
    return f"gave up at t = {t:g} s with dt = {small:.3g} s: {failed}; {why} (collapse, buckling)"


def _row(simulation: Simulated, probes: Probes | None) -> Row:
    """Return the results at the present time as a row of the histories."""
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
    """Return the histories with the memory use and the load balance of the processes."""
    comm, state = simulation.scene.grid.comm, simulation.state
    points, memory = comm.allreduce(np.array([len(state.points), peak_memory()])).tolist()
    even = imbalance(simulation.scene, state) if comm.size > 1 else {}
    return replace(state.result, points=int(points), memory=memory, imbalance=even)
