# SPDX-License-Identifier: MIT
"""Factor of safety: the largest number by which the strength of the soil can be divided before the bodies fail.

Trials with different factors give bounds of this number.  The factor divides cohesion, tensile strength and the
tangents of the angles of friction and dilation (Griffiths and Lane 1999).  Failure of Newton's method is no criterion,
because it may also fail in soil that is strong enough.  Instead, a trial adds a viscous stress to the soil, and
computes the motion in time.  The criterion is the overload, the ratio of the viscous stress to the shear stress.  If
the soil is strong enough, the bodies come to rest, and the overload vanishes.  In a slide, the overload approaches the
missing strength divided by the present strength, for any viscosity and cell size.

The viscosity of a point follows from its own strength and stiffness, and each connected part of the bodies has its own
overload.  Soil far from a slide therefore hardly affects the result, even if it is soft or yields under its own weight.

All trials start after one step with soil that cannot yield.  In this step, bodies in equilibrium keep their stresses.
Bodies that are not in equilibrium get elastic stresses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from mpm_dolfinx.base.errors import Report
from mpm_dolfinx.base.validation import flag, line, numbers, whole
from mpm_dolfinx.materials.frictional import Frictional
from mpm_dolfinx.materials.skeleton import Skeleton
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.parallel.messages import log
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.simulation.timeloop import run
from mpm_dolfinx.stepping.initial_state import begin_stage
from mpm_dolfinx.stepping.result import GaveUp
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State
from mpm_dolfinx.stepping.step import step

if TYPE_CHECKING:
    from mpm_dolfinx.simulation.simulation import Simulation

WIDER, WIDEST = 2**0.5, 16.1
"""`WIDER`: ratio of two successive factors in the search for bounds.  `WIDEST`: largest factor."""
LACKS = 0.25
"""Largest overload with which a body counts as being at rest, divided by `rtol`.

Sensitivity (scene "safety" of tests/plateaus.py): half this value changes the result by 6.7e-03, and twice this value
by 0.0e+00. Finer cells change it by 3.8e-02.
"""
STRAINS = 2.0
"""Shear strain of a trial that barely slides, divided by the smaller of two values: overload, elastic strain at yield.

Sensitivity (scene "safety" of tests/plateaus.py): half this value changes the result by 1.1e-02, and twice this value
by 8.2e-03.  Finer cells change it by 3.8e-02.
"""
CREEP, PART = "creep_viscosity", "part"
"""Fields of the points: viscosity in a trial, in Pa s, and index of the connected part of the bodies."""
STRENGTHS = ("cohesion", "residual", "hardening", "tension", "friction", "dilation")
ANGLES = ("friction", "dilation")


@dataclass(frozen=True)
class Safety:
    """A factor of safety, with the results of its trials.

    factor
        Mean of the two bounds.
    bounds
        Largest factor of a trial that came to rest, and smallest factor of a trial with a slide.
    overloads
        Dictionary from the factor of each trial to the overloads (n,) in its n steps.  The overload of a step is the
        work of the viscous stress, divided by the work of the shear stress, in soil that may yield.  If the bodies have
        several connected parts, the largest overload of a part counts.
    newton
        Number of Newton steps of all trials.
    """

    factor: float
    bounds: tuple[float, float]
    overloads: Mapping[float, NDArray[np.float64]]
    newton: int

    def __str__(self) -> str:
        """Return the factor and its bounds."""
        return f"factor of safety {self.factor:.3f}, between {self.bounds[0]:.3f} and {self.bounds[1]:.3f}"


def factor_of_safety(
    simulation: Simulation, *, dt: float | None = None, rtol: float = 0.01, steps: int = 10, progress: bool = True
) -> Safety:
    """Return the factor of safety: the largest number by which the strength can be divided before the bodies fail.

    The simulation does not change.  No earlier `run` is necessary, even if the bodies are not in equilibrium.  Suction
    contributes to the strength through the effective stress.  The factor does not divide the friction of tools.  The
    result depends on `rtol` if only a thin weak layer at the surface slides.  All processes must call this function.

    Parameters
    ----------
    simulation
        Scene with its loads, which keep their present values.  If a load jumps now, the value after the jump counts.
    dt
        Length of a step, in s, > 0.  Default: if fluid flows in the scene, pore pressures keep their present values.
        With a given length, fluid flows in the trials too: a short step leads to undrained failure, and a long step to
        drained failure at the final pore pressures.  Rain then goes on too.  The step must be long compared with
        viscous time scales of laws and terms.
    rtol
        Final relative difference of the bounds, in [1e-4, 0.5].
    steps
        Largest number of steps in a trial, >= 8.  A body that still moves after these steps counts as sliding.
    progress
        Whether to show a progress bar on a terminal.

    Raises
    ------
    ValueError
        An argument is invalid, the strength of a soil cannot be divided, or the bodies have no stress.  The bodies
        still come to rest with 1/16 of their strength, or still slide with 16 times their strength.
    GaveUp
        Even the shortest step of a trial does not converge.
    """
    if not isinstance(getattr(simulation, "scene", None), Scene):
        raise ValueError(f"simulation = {line(simulation)}, must be a Simulation")
    if simulation.state.stage.inertia:
        raise ValueError("factor_of_safety: bodies have inertia, must be quasi-static: stage(inertia=False)")
    held = dt is None and simulation.scene.flows
    positive = {"allowed": "> 0 and finite", "test": lambda v: (0 < v) & (v < np.inf)}
    dt, steps = float(numbers("dt", 1.0 if dt is None else dt, **positive)), whole("steps", steps, 8)
    rtol = float(numbers("rtol", rtol, allowed="in [1e-4, 0.5]", test=lambda v: (1e-4 <= v) & (v <= 0.5)))
    flag("progress", progress)
    comm = simulation.grid.comm
    overloads = {}
    least = LACKS * rtol
    with _Bar(progress and comm.rank == 0) as bar:
        weakened = _Weakened(simulation, dt, steps, least, held)

        def rests(factor: float) -> bool:
            overloads[factor] = weakened.overloads(factor, lambda *now: bar.show(factor, *now))
            count, last = len(overloads[factor]), overloads[factor][-1]
            judged = "rests" if last <= least else "slides"
            log(comm, "strength over %.4g: %s, overload %.2g in step %d", factor, judged, last, count)
            bar.tried(factor, judged)
            return judged == "rests"

        safe, unsafe = _bracket(rests)
        while unsafe > safe * (1 + rtol):
            trial = float(np.sqrt(safe * unsafe))
            safe, unsafe = (trial, unsafe) if rests(trial) else (safe, trial)
    return Safety((safe + unsafe) / 2, (safe, unsafe), overloads, sum(weakened.newton))


class _Bar:
    """Progress bar for the trials on a terminal."""

    def __init__(self, shown: bool):
        self._bar = tqdm(bar_format="{desc}, {n_fmt} steps, {elapsed}{postfix}", disable=None if shown else True)
        self._bar.set_description("factor of safety")
        self._logs = nullcontext() if self._bar.disable else logging_redirect_tqdm()  # the log appears above the bar
        self._known = {"rests": "", "slides": ""}

    def __enter__(self) -> _Bar:
        self._logs.__enter__()
        return self

    def __exit__(self, *raised) -> None:
        self._logs.__exit__(*raised)
        self._bar.close()

    def show(self, factor: float, count: int, overload: float) -> None:
        """Show the factor of a trial, and the number and the overload of its latest step."""
        self._bar.update()
        known = "".join(f", {what} at {at}" for what, at in self._known.items() if at)
        self._bar.set_postfix_str(f"strength over {factor:.4g}: step {count}, overload {overload:.1e}{known}")

    def tried(self, factor: float, judged: str) -> None:
        """Store the result `judged` of a trial, "rests" or "slides"."""
        self._known[judged] = f"{factor:.4g}"


def _bracket(rests: Callable[[float], bool]) -> tuple[float, float]:
    """Return a factor at which the bodies rest, and a larger factor at which they slide."""
    known, wider = 1.0, WIDER if (begins := rests(1.0)) else 1 / WIDER
    while 1 / WIDEST <= (trial := known * wider) <= WIDEST:
        if rests(trial) != begins:
            return min(known, trial), max(known, trial)
        known = trial
    found, allowed = ("come to rest", "slide") if begins else ("slide", "come to rest")
    what = f"factor_of_safety: the bodies {found} with strength divided by {known:.3g}"
    raise ValueError(f"{what}, must {allowed} at some factor")


def _ends(overloads: Sequence[float], steps: int, least: float) -> bool:
    """Return whether the overloads of the first steps already determine the result of a trial.

    The bodies slide if the overload, at its present rate of decrease, does not vanish in the remaining steps.  This is
    certain, because the overload decreases ever more slowly.
    """
    *before, last = overloads
    rate = min(1.0, last / before[-1]) if before else 0.0
    return last <= least or last * rate ** (steps - len(overloads)) > least


@dataclass
class _Trial:
    """Scene and state of a trial for the time loop, with the number of Newton steps in each time step.

    Loads keep their values at the time `present`, in s.
    """

    scene: Scene
    state: State
    newton: list[int]
    present: float

    def advanced(self, dt: float) -> tuple[State, Report]:
        """Return the state after a step of length `dt`, in s, and the report of the step."""
        state, report = step(self.scene, replace(self.state, t=self.present - dt), dt)
        self.newton.append(report.newton)
        return replace(state, t=self.state.t + dt), report

    def without_jump(self, dt: float) -> tuple[float, bool]:
        """Return `dt` and False, because nothing jumps."""
        return dt, False


class _Weakened:
    """Copy of a scene with variable strength and with a viscous stress."""

    def __init__(self, simulation: Simulation, dt: float, steps: int, least: float, held: bool):
        scene = simulation.scene
        self._dt = dt
        self._steps = steps
        self._least = least
        for m in scene.materials.materials:
            if m.state and not isinstance(m, Frictional):
                what = f"factor_of_safety: strength of {type(m).__name__} cannot be divided"
                raise ValueError(f"{what}; the law must have friction and cohesion")
        if not any(isinstance(m, Frictional) for m in scene.materials.materials):
            raise ValueError("factor_of_safety: no material has a strength; one must have friction and cohesion")
        if scene.grid.copies > 1:
            raise ValueError("factor_of_safety: the scene has contacts, must have none")
        initial = begin_stage(scene, simulation.state, {}, [], [], False, {})  # without data of the old grid

        def resistance(points, u, dt):
            strain = ufl.sym(points.grad(u))
            return getattr(points, CREEP) / dt * ufl.inner(strain, strain) * points.dx

        materials = [_as_fields(m) for m in scene.materials.materials]
        terms, sources = scene.extensions
        if held:  # sources keep the pressures, and no fluid flows
            eps = np.finfo(float).eps
            materials = [replace(m, conductivity=eps**2, conductivity_law=None) for m in materials]
            moduli = scene.materials.table(initial.points, lambda m: m.oedometric)
            stiffness = over_all(scene.grid.comm, float(moduli.min(initial=np.inf)), MPI.MIN)
            supply = fem.Constant(scene.grid.mesh, 1 / (np.cbrt(eps) * stiffness * dt))
            sources = [*sources, lambda points, q, p, p_n: supply * (p_n - p) * q * points.dx]
        self._scene = Scene(
            scene.grid,
            scene.bodies,
            materials,
            scene.fluid,
            numerics=replace(scene.numerics, method="backward-euler"),
            weighs=scene.gravity is not None,
            pressure=0.0,
            extensions=([*terms, resistance], sources),
            initial={},  # the materials already have their data for initial stresses
            own=(CREEP,),
        )
        self._strengths, self.newton = _strengths(scene, initial.points), []
        points = replace(initial.points, data={**initial.points.data, **self._strengths, CREEP: 0 * initial.points.J})
        initial = begin_stage(self._scene, replace(initial, points=points), {}, [], [], False, {})
        start = self._unyielding(initial)
        stress = self._scene.materials.effective_stress_3d(start.points)
        _check_stress(self._scene, start.points, stress)
        part, self._parts = self._scene.on_grid(start.points).parts
        data = {CREEP: self._viscosity(start.points, stress), PART: part}
        self._start = replace(start, points=replace(start.points, data=start.points.data | data))

    def overloads(self, factor: float, tell: Callable[[int, float], None]) -> NDArray[np.float64]:
        """Return the overloads in the steps of a trial.  `tell`: is called with number and overload of each step."""
        weaker = {name: _over(name, value, factor) for name, value in self._strengths.items()}
        trial, out = self._trial(self._start, weaker), []
        while len(out) < self._steps and not (out and _ends(out, self._steps, self._least)):
            before = trial.state.points
            self._go_on(trial, f"strength / {factor:g}")
            out.append(self._overload(before, trial.state.points))
            tell(len(out), out[-1])
        return np.array(out)

    def _unyielding(self, initial: State) -> State:
        """Return the state after a step with soil that cannot yield."""
        moduli = self._scene.materials.table(initial.points, lambda m: m.oedometric)
        stronger = {name: np.maximum(own, moduli) for name, own in self._strengths.items() if name not in ANGLES}
        trial = self._trial(initial, stronger)
        self._go_on(trial, "soil that cannot yield")
        return replace(trial.state, t=initial.t)

    def _viscosity(self, points: MaterialPoints, stress: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the viscosity (n,) of each point, in Pa s, from its effective stress (n, 3, 3), in Pa."""
        phi, pressure = np.radians(self._strengths["friction"]), -np.trace(stress, axis1=1, axis2=2) / 3
        strength = self._strengths.get("cohesion", 0.0) * np.cos(phi) + np.maximum(pressure, 0) * np.sin(phi)
        modulus = self._scene.materials.table(points, lambda m: m.shear)
        return self._steps / STRAINS * np.maximum(self._least * modulus, strength) * self._dt

    def _trial(self, start: State, data: Mapping[str, NDArray[np.float64]]) -> _Trial:
        """Return a trial that starts from the state `start`, but with the new values `data` of point data."""
        points = replace(start.points, data={**start.points.data, **data})
        start = replace(start, points=points, velocity=None, result=None, control=None)
        return _Trial(self._scene, start, self.newton, start.t)

    def _go_on(self, trial: _Trial, what: str) -> None:
        """Compute a step of a trial.  `what`: description of the soil for an error message."""
        try:
            run(trial, trial.state.t + self._dt, self._dt, progress=False)
        except GaveUp as error:
            raise GaveUp(f"factor_of_safety: {what}: {error}", error.result, error.history) from error

    def _overload(self, before: MaterialPoints, now: MaterialPoints) -> float:
        """Return the overload of a step.  Points that have moved to another process are ignored."""
        _, old, new = np.intersect1d(before.id, now.id, assume_unique=True, return_indices=True)
        d = before.F.shape[1]
        increment = now.F[new] @ np.linalg.inv(before.F[old]) - np.eye(d)
        strain = np.pad((increment + increment.transpose(0, 2, 1)) / 2, ((0, 0), (0, 3 - d), (0, 3 - d)))
        stress = self._scene.materials.effective_stress_3d(now)[new]
        volume, size = _yielding_volume(self._scene, now)[new], partial(np.linalg.norm, axis=(1, 2))
        viscous = 2 * now.data[CREEP][new] / self._dt * size(strain) ** 2
        densities = viscous, size(_deviator(stress)) * size(_deviator(strain))
        work = [np.bincount(now.data[PART][new], volume * density, self._parts) for density in densities]
        viscous_work, whole_work = over_all(self._scene.grid.comm, np.array(work))
        return float(np.divide(viscous_work, whole_work, out=np.zeros(self._parts), where=viscous_work > 0).max())


def _deviator(tensors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the deviatoric parts of tensors (n, 3, 3)."""
    return tensors - np.trace(tensors, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)


def _yielding_volume(scene: Scene, points: MaterialPoints) -> NDArray[np.float64]:
    """Return the volume (n,) of each point, or 0 for points that cannot yield."""
    return points.volume0 * points.J * scene.materials.table(points, lambda m: isinstance(m, Frictional) + 0 * m.shear)


def _check_stress(scene: Scene, points: MaterialPoints, stress: NDArray[np.float64]) -> None:
    """Raise ValueError if soil that may yield has no effective stress.  `stress` (n, 3, 3), in Pa."""
    grid, volume = scene.grid, _yielding_volume(scene, points)
    moduli = scene.materials.table(points, lambda m: m.oedometric)
    far = 2**grid.dim * grid.reach / grid.least  # a gradient is a sum over the corners
    size = np.linalg.norm(stress, axis=(1, 2))
    total, rounding = over_all(grid.comm, np.array([size @ volume, np.finfo(float).eps * far * moduli @ volume]))
    if not total > rounding:
        raise ValueError("factor_of_safety: the bodies have no stress, must be in equilibrium under loads")


def _of(m: Skeleton) -> list[str]:
    """Return the names of the constants of a material that the factor of safety divides."""
    if not isinstance(m, Frictional):
        return []
    own = {f.name for f in fields(m)} & set(STRENGTHS)
    return [name for name in STRENGTHS if name in own and (callable(v := getattr(m, name)) or np.isfinite(v))]


def _as_fields(m: Skeleton) -> Skeleton:
    """Return a copy of a material in which functions of position replace all constant strengths."""
    carried = {name: partial(_constant, value=getattr(m, name)) for name in _of(m) if not callable(getattr(m, name))}
    if isinstance(m, Frictional) and m.symmetric:
        carried |= {"dilation": carried.get("friction", m.friction)}
    return replace(m, **carried)


def _constant(X: NDArray[np.float64], value: float) -> NDArray[np.float64]:
    return np.full(len(X), value)


def _strengths(scene: Scene, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
    """Return the values of strengths at the points, by name.  Points without a strength have zeros."""
    out = {}
    for i, m in enumerate(scene.materials.materials):
        rows = np.flatnonzero(points.material == i)
        for name in _of(m):
            own = getattr(m, name)
            out.setdefault(name, np.zeros(len(points)))[rows] = points.data[name][rows] if callable(own) else own
    return out


def _over(name: str, value: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    """Return a strength divided by a factor.  For an angle, the factor divides the tangent."""
    return np.degrees(np.arctan(np.tan(np.radians(value)) / factor)) if name in ANGLES else value / factor
