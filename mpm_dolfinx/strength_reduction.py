# SPDX-License-Identifier: MIT
"""The factor of safety: by what the strength of soil may be divided before bodies at rest begin to slide.

Cohesion, tensile strength and the tangents of the angles of friction and dilation are divided by a factor F (Griffiths
and Lane 1999; dilation too, so that associated flow stays associated).  Soil that is too weak has no equilibrium, but a
solver that finds none says nothing about the soil.  So each trial goes on in time against a viscous stress, and what is
judged is its motion: a body that comes to rest slows down from step to step, one that slides goes on at a rate that its
weight and the viscosity determine.  The viscosity is so large that the body hardly changes its shape meanwhile: a slide
that has lowered its crest comes to rest too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.constitutive.frictional import Frictional
from mpm_dolfinx.constitutive.skeleton import Skeleton
from mpm_dolfinx.errors import GaveUp
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.parallel.messages import log
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.result import Report
from mpm_dolfinx.scene import Scene
from mpm_dolfinx.stages import begin_stage
from mpm_dolfinx.state import State
from mpm_dolfinx.step import step
from mpm_dolfinx.timeloop import run
from mpm_dolfinx.validation import line, numbers, whole

if TYPE_CHECKING:
    from mpm_dolfinx.simulation import Simulation

VISCOUS = 1.0
"""Viscosity eta of the stress 2 eta D over the mean effective stress and the length of a step.

A slope 10 cells high at 1.02 and 1.17 times its factor of safety moves by 0.05 and 0.6 cells in 12 steps with this, and
goes on; with a fiftieth of it by 0.15 and 1.6 cells, and comes to rest lower down.
"""
STILL, RESTS = 5e-5, 0.02
"""A step in which nothing moves by this many cells, or by this share of the largest motion of a step, ends at rest."""
SLIDES, OVER = 0.6, 3
"""A step that still moves by this share of what it did so many steps before, from the sixth on, is one of a slide."""
WIDER, WIDEST = 2**0.5, 16.1
"""By how much factors are tried further out until one rests and one slides, and how far from 1 that goes."""
ROUNDING = 1e-12
"""Stress, in proportion to the oedometric modulus, that rounding of strains may make."""
STRENGTHS = ("cohesion", "hardening", "tension", "friction", "dilation")
ANGLES = ("friction", "dilation")


@dataclass(frozen=True)
class Safety:
    """A factor of safety, and how it was found.

    factor
        Mean of the two bounds.
    bounds
        Largest factor at which the bodies came to rest, and smallest at which they did not.
    motions
        Factor -> largest motion of a point in each step of the trial (n,), m.
    """

    factor: float
    bounds: tuple[float, float]
    motions: Mapping[float, NDArray[np.float64]]


def factor_of_safety(simulation: Simulation, *, dt: float | None = None, rtol: float = 0.01, steps: int = 20) -> Safety:
    """Return by what the strength of soil may be divided before bodies at rest begin to slide.

    The simulation stays what it is.  On several processes all call it together.  Suction is in the effective stress,
    and so counts as strength.

    Parameters
    ----------
    simulation
        At rest under the loads that act; where they are functions of time, they should no longer change.
    dt
        Length of a step, s, > 0.  It must be given where fluid flows: short for undrained, long for drained failure.
    rtol
        Relative distance of the bounds at the end, in [1e-4, 0.5].
    steps
        At most so many in a trial, >= 8; who has not come to rest by then slides.

    Raises
    ------
    ValueError
        Naming the argument; soil whose strength is none that can be divided; bodies without stress, that do not slide
        with a sixteenth of their strength, or that do not come to rest with sixteen times as much.
    GaveUp
        A step of a trial that does not converge, however short.
    """
    if not isinstance(getattr(simulation, "scene", None), Scene):
        raise ValueError(f"simulation = {line(simulation)}, must be a Simulation")
    weakened = _Weakened(simulation, _step_of(simulation, dt))
    rtol = float(numbers("rtol", rtol, allowed="in [1e-4, 0.5]", test=lambda v: (1e-4 <= v) & (v <= 0.5)))
    steps, motions = whole("steps", steps, 8), {}

    def rests(factor: float) -> bool:
        motions[factor] = motion = weakened.motion(factor, steps)
        judged = _judged(motion, simulation.grid.h.min()) == "rests"
        what = "rests" if judged else "slides"
        log(simulation.grid.comm, "strength over %.4g: %s, %.1e m in step %d", factor, what, motion[-1], len(motion))
        return judged

    safe, unsafe = _bracket(rests)
    while unsafe > safe * (1 + rtol):
        trial = float(np.sqrt(safe * unsafe))
        safe, unsafe = (trial, unsafe) if rests(trial) else (safe, trial)
    return Safety((safe + unsafe) / 2, (safe, unsafe), motions)


def _bracket(rests: Callable[[float], bool]) -> tuple[float, float]:
    """Return a factor with which bodies rest and a larger one with which they slide, one after the other from 1 on."""
    known, wider = 1.0, WIDER if (begins := rests(1.0)) else 1 / WIDER
    while 1 / WIDEST <= (trial := known * wider) <= WIDEST:
        if rests(trial) != begins:
            return min(known, trial), max(known, trial)
        known = trial
    found = "come to rest" if begins else "slide"
    more = "" if begins else "; what acts on them must not change in time"
    raise ValueError(f"factor_of_safety: the bodies {found} with strength / {known:.3g}, must not at some factor{more}")


def _step_of(simulation: Simulation, dt: float | None) -> float:
    """Return the length of a step, s."""
    if dt is None and simulation.scene.flows:
        raise ValueError("dt is not given, must be where fluid flows: short for undrained, long for drained failure, s")
    return _positive("dt", 1.0 if dt is None else dt)


def _positive(name: str, value: float) -> float:
    return float(numbers(name, value, allowed="> 0 and finite", test=lambda v: (0 < v) & (v < np.inf)))


def _judged(motion: Sequence[float], h: float) -> str:
    """Return "rests", "slides" or "" of the motion of each step so far, m; h: size of a cell, m."""
    if motion[-1] <= max(STILL * h, RESTS * max(motion)):
        return "rests"
    return "slides" if len(motion) > 2 * OVER and motion[-1] >= SLIDES * motion[-1 - OVER] else ""


@dataclass
class _Trial:
    """What the time loop drives."""

    scene: Scene
    state: State

    def advanced(self, dt: float) -> tuple[State, Report]:
        """Return the state after a step of dt, s, and what it took."""
        return step(self.scene, self.state, dt)


class _Weakened:
    """The scene of a simulation with strengths on its points, and a viscous stress; see `factor_of_safety`."""

    def __init__(self, simulation: Simulation, dt: float):
        scene, self._dt = simulation.scene, dt
        for m in scene.materials.materials:
            if m.state and not isinstance(m, Frictional):
                what = f"factor_of_safety: strength of {type(m).__name__} is none that can be divided"
                raise ValueError(f"{what}, must be a law with friction and cohesion")
        if not any(isinstance(m, Frictional) for m in scene.materials.materials):
            raise ValueError("factor_of_safety: no material has a strength, must have friction and cohesion")
        if simulation.state.stage.conditions["contacts"]:
            raise ValueError("factor_of_safety: contacts: must be none")
        at_rest = begin_stage(scene, simulation.state, {}, [], [], False, {})  # free of its grid
        viscosity = fem.Constant(scene.grid.mesh, VISCOUS * _mean_stress(scene, at_rest.points) * dt)  # Pa s

        def resistance(points, u, dt):
            strain = ufl.sym(points.grad(u))
            return viscosity / dt * ufl.inner(strain, strain) * points.dx

        materials = [_as_fields(m) for m in scene.materials.materials]
        options = scene.quadrature, scene.scheme, scene.method, scene.gravity is not None, 0.0
        terms, sources = scene.extensions
        options = *options, [*terms, resistance], sources, {}  # what initial stresses need the materials have
        self._scene = Scene(scene.grid, scene.bodies, materials, scene.fluid, *options)
        self._strengths = _strengths(scene, at_rest.points)
        points = replace(at_rest.points, data={**at_rest.points.data, **self._strengths})
        self._at_rest = begin_stage(self._scene, replace(at_rest, points=points), {}, [], [], False, {})

    def motion(self, factor: float, steps: int) -> NDArray[np.float64]:
        """Return the largest motion of a point in each step (n,), m, until it is known what becomes of it."""
        grid, points, motion = self._scene.grid, self._at_rest.points, []
        weaker = {name: _over(name, value, factor) for name, value in self._strengths.items()}
        points = replace(points, data={**points.data, **weaker})
        trial = _Trial(self._scene, replace(self._at_rest, points=points, velocity=None, result=None))
        while len(motion) < steps and not (motion and _judged(motion, grid.h.min())):
            before = trial.state.points
            try:
                run(trial, trial.state.t + self._dt, self._dt, progress=False)
            except GaveUp as error:
                what = f"factor_of_safety: strength / {factor:g}: {error}"
                raise GaveUp(what, error.result, error.history) from error
            motion.append(over_all(grid.comm, _moved(before, trial.state.points), MPI.MAX))
        return np.array(motion)


def _moved(before: MaterialPoints, now: MaterialPoints) -> float:
    """Return the largest motion of a point, m; those that have gone to another process are left out."""
    _, old, new = np.intersect1d(before.id, now.id, assume_unique=True, return_indices=True)
    return float(np.linalg.norm(now.x[new] - before.x[old], axis=1).max(initial=0.0))


def _mean_stress(scene: Scene, points: MaterialPoints) -> float:
    """Return the mean size of the effective stress, Pa; refuse one that rounding of strains has made."""
    size = np.linalg.norm(scene.materials.effective_stress_3d(points), axis=(1, 2))
    moduli, volume = scene.materials.table(points, lambda m: m.oedometric), points.volume0 * points.J
    sums = np.array([size @ volume, ROUNDING * moduli @ volume, volume.sum()])
    total, rounding, whole_volume = over_all(scene.grid.comm, sums)
    if not total > rounding:
        raise ValueError("factor_of_safety: the bodies have no stress, must be at rest under what acts on them")
    return float(total / whole_volume)


def _of(m: Skeleton) -> list[str]:
    """Return the names of a material's constants that are divided."""
    if not isinstance(m, Frictional):
        return []
    return [n for n in STRENGTHS if hasattr(m, n) and (callable(getattr(m, n)) or np.isfinite(getattr(m, n)))]


def _as_fields(m: Skeleton) -> Skeleton:
    """Return a material whose strengths are carried by its points."""
    fields = {name: partial(_constant, value=getattr(m, name)) for name in _of(m) if not callable(getattr(m, name))}
    if isinstance(m, Frictional) and m.symmetric:
        fields |= {"dilation": fields.get("friction", m.friction)}
    return replace(m, **fields)


def _constant(X: NDArray[np.float64], value: float) -> NDArray[np.float64]:
    return np.full(len(X), value)


def _strengths(scene: Scene, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
    """Return the strengths of the points, name -> (n,), zero where a material has none of the name."""
    out = {}
    for i, m in enumerate(scene.materials.materials):
        rows = np.flatnonzero(points.material == i)
        for name in _of(m):
            own = getattr(m, name)
            out.setdefault(name, np.zeros(len(points)))[rows] = points.data[name][rows] if callable(own) else own
    return out


def _over(name: str, value: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    """Return a strength over a factor."""
    return np.degrees(np.arctan(np.tan(np.radians(value)) / factor)) if name in ANGLES else value / factor
