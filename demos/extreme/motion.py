# SPDX-License-Identifier: MIT
"""Families of scenes with inertia for `extreme_cases`: columns and bars, one cell wide, under small loads.

The reference is a bar of linear finite elements, one for each cell, with the package's time integration.  The reference
holds for steps of any length: in short steps forces change velocities, and in long steps the bar is at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf

import numpy as np
from extreme.families import FAMILIES, decades, family
from extreme.scenes import Make, Scene, off, soil
from numpy.typing import ArrayLike

import mpm_dolfinx as mpm
from mpm_dolfinx.base.time_integration import METHODS
from mpm_dolfinx.mechanics.inertia import velocity_gradients

__all__ = ["FAMILIES"]
N, H = 10, 0.1  # cells of a column, and their size, m
YOUNG, DENSITY = 1e7, 1000.0  # Pa, kg/m^3
CROSSES = H / np.sqrt(YOUNG / DENSITY)  # s, in which a wave crosses a cell
SMALL = 1e-5  # strain
REST = 1e-3
DIGIT = 1e-12  # m; a smaller displacement changes only the last digits of a position
Motion = tuple[np.ndarray, np.ndarray]


def bar(
    young: ArrayLike,
    density: ArrayLike,
    h: ArrayLike,
    dt: float,
    steps: int,
    load: float = 0.0,
    weight: float = 0.0,
    v: ArrayLike | None = None,
    held: bool = True,
) -> Motion:
    """Return nodal displacements and velocities of a bar of linear elements after `steps` steps of SDIRK2.

    young, density, h: Young's modulus, density and length of each element.  load: force on the last node.
    weight: gravity.  v: initial velocities of the nodes.  held: whether the first node is fixed.
    """
    young, density, h = np.broadcast_arrays(*map(np.asarray, (young, density, h)))
    n, k = len(h), np.arange(len(h))
    K, M, f = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1)), np.zeros(n + 1)
    for i, j, stiff, heavy in ((0, 0, 1, 2), (0, 1, -1, 1), (1, 0, -1, 1), (1, 1, 1, 2)):
        K[k + i, k + j] += stiff * young / h
        M[k + i, k + j] += heavy * density * h / 6
    f[-1] = load
    for i in (0, 1):
        f[k + i] += weight * density * h / 2
    free = slice(int(held), None)
    K, M, f = K[free, free], M[free, free], f[free]
    v = np.zeros(n + 1)[free] if v is None else np.array(v, dtype=float)[free]
    x, (first, last) = np.zeros(len(f)), METHODS["sdirk2"]
    own, before = last.own * dt, last.before * dt
    A = np.linalg.inv(M + own**2 * K)
    for _ in range(steps):
        one = A @ (f - K @ (x + first.own * dt * v))
        flight = before * (v + own * one) + own * (v + before * one)
        other = A @ (f - K @ (x + flight))
        x, v = x + flight + own**2 * other, v + before * one + own * other
    lead = np.zeros(int(held))
    return np.append(lead, x), np.append(lead, v)


def ends(s: mpm.Simulation, axis: int) -> tuple[float, float]:
    """Return displacement and velocity, along an axis, of the outermost face of a body."""
    points = s.points
    i = points.x[:, axis].argmax()
    face = points.corners[i, :, axis].max()
    L = velocity_gradients(points)[i, axis, axis]
    u = face - points.origin[i, :, axis].max()
    return float(u), float(points.velocity[i, axis] + L * (face - points.x[i, axis]))


def against(exact: Motion, dt: float, least: float = 0.0) -> Callable[[mpm.Simulation, mpm.Result], float]:
    """Return a function for the larger of two relative errors: of displacement and of velocity at the top.

    least: displacement, m, below which only velocities are compared.  If the bar moves in a step of dt by less than
    `REST` times its displacement, it is at rest, and only displacements are compared.
    """

    def error(s: mpm.Simulation, _: mpm.Result) -> float:
        most = [np.abs(of).max() for of in exact]
        seen = most[0] > least, most[1] * dt > REST * most[0]
        found = zip(ends(s, 1), exact, most, seen, strict=True)
        return max(off(one, of[-1], scale) for one, of, scale, compares in found if compares)

    return error


def column(
    error: Callable,
    dt: float,
    steps: int = 4,
    young: ArrayLike = (YOUNG, YOUNG),
    density: ArrayLike = (DENSITY, DENSITY),
    load: float = 0.0,
    top: float = N * H,
    fluid: mpm.Fluid | None = None,
    units: tuple[float, float, float] = (1.0, 1.0, 1.0),
    **physics,
) -> Make:
    """Return a function that makes a column of two halves between smooth walls, with inertia.

    young, density: of the lower and the upper half. load: stress on the top. units: factors of length, mass, time.
    """
    m, kg, second = units
    stress = kg / (m * second**2)

    def make() -> Scene:
        h = H * m
        grid = mpm.Grid([0, 0], [h, (N + 2) * h], [1, N + 2])
        levels = [0, N // 2 * h, top * m]
        bodies = [mpm.box(grid, [0, levels[i]], [h, levels[i + 1]], material=i) for i in (0, 1)]
        porosity, water = 0.5, fluid.density if fluid else 0.0
        laws = [
            mpm.Hencky(
                bulk=E / 3 * stress,
                shear=E / 2 * stress,
                porosity=porosity,
                grain_density=(rho - porosity * water) / (1 - porosity) * kg / m**3,
            )
            for E, rho in zip(young, density, strict=True)
        ]
        region = ([-inf, levels[1]], [inf, inf])
        loads = [mpm.Traction("top", (0, load * stress), region=region)] if load else []
        options = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "inertia": True, "fluid": fluid, **physics}
        s = mpm.Simulation(grid, bodies, laws, **options, conditions=loads)
        return Scene(s, steps * dt * second, steps, error)

    return make


def halves(one: float, other: float) -> np.ndarray:
    """Return the values of all elements: `one` in the lower half of a column, and `other` in the upper half."""
    return np.repeat([one, other], N // 2)


@family(1e-3)
def inertia_time_step():
    """Compare a column under a sudden load or weight with a bar of finite elements, for dt = 1e-12 to 1e12 s."""
    for dt in decades(-12, 12, 2):
        load, weight = -SMALL * YOUNG, -SMALL * YOUNG / DENSITY
        exact = bar(YOUNG, DENSITY, [H] * N, dt, 4, load=load)
        yield f"load, dt = {dt:.0e} s", column(against(exact, dt, DIGIT), dt, load=load)
        exact = bar(YOUNG, DENSITY, [H] * N, dt, 4, weight=weight)
        yield f"weight, dt = {dt:.0e} s", column(against(exact, dt, DIGIT), dt, gravity=(0, weight))


@family(1e-3)
def inertia_stiffness():
    """Compare a column of two halves with a bar of finite elements, for stiffness ratios from 1e-8 to 1e8."""
    for ratio in decades(-8, 8, 2):
        young, load = (YOUNG, YOUNG * ratio), -SMALL * YOUNG * min(1.0, ratio)
        dt = CROSSES / np.sqrt(min(1.0, ratio))
        exact = bar(halves(*young), DENSITY, [H] * N, dt, 8, load=load)
        yield f"upper half {ratio:.0e} times as stiff", column(against(exact, dt), dt, 8, young=young, load=load)


@family(1e-3)
def inertia_density():
    """Compare a column of two halves with a bar of finite elements, for density ratios from 1e-8 to 1e8."""
    for ratio in decades(-8, 8, 2):
        density, dt = (DENSITY, DENSITY * ratio), CROSSES * np.sqrt(max(1.0, ratio))
        load = -SMALL * YOUNG
        exact = bar(YOUNG, halves(*density), [H] * N, dt, 8, load=load)
        yield f"upper half {ratio:.0e} times as dense", column(against(exact, dt), dt, 8, density=density, load=load)


@family(1e-3)
def inertia_units():
    """Compare a column with a bar of finite elements, in units of 1e-6 to 1e6 m, kg and s."""
    load = -SMALL * YOUNG
    exact = np.array(bar(YOUNG, DENSITY, [H] * N, CROSSES, 8, load=load))
    for k, name in enumerate(("m", "kg", "s")):
        for factor in (1e-6, 1e-3, 1e3, 1e6):
            units = [1.0, 1.0, 1.0]
            units[k] = factor
            m, _, second = units
            scaled = exact[0] * m, exact[1] * m / second

            def error(s, r, scaled=scaled):
                return max(off(one, of[-1], np.abs(of).max()) for one, of in zip(ends(s, 1), scaled, strict=True))

            yield f"{factor:.0e} {name}", column(error, CROSSES, 8, load=load, units=tuple(units))


@family(0.01)
def inertia_filling():
    """Compare a column that fills 1e-10 to 0.9 of its top cell with a bar of finite elements of equal length."""
    weight = -10 * SMALL * YOUNG / DENSITY
    for part in (1e-10, 1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 0.9):
        exact = bar(YOUNG, DENSITY, [H] * N + [part * H], CROSSES, 8, weight=weight)
        yield f"a part {part:.0e}", column(against(exact, CROSSES), CROSSES, 8, top=(N + part) * H, gravity=(0, weight))


@family(0.01)
def inertia_flight():
    """Compare a flying, vibrating bar with finite elements that do not fly, for 0 to 100 cells of flight in a step."""
    amplitude = SMALL * np.sqrt(YOUNG / DENSITY)
    shape = amplitude * np.cos(np.pi * np.arange(N + 1) / N)
    exact = bar(YOUNG, DENSITY, [H] * N, CROSSES, 4, v=shape, held=False)
    for cells in (0, 1, 3, 10, 30, 100):
        yield f"{cells} cells a step", partial(flying, cells * H / CROSSES, shape, exact)


def flying(speed: float, shape: np.ndarray, exact: Motion) -> Scene:
    """Return a bar that flies along x at a speed (m/s) and vibrates."""
    cells = N + 2 + round(4 * speed * CROSSES / H)
    grid = mpm.Grid([0, 0], [cells * H, H], [cells, 1])
    body = mpm.box(grid, [H, 0], [(N + 1) * H, H])

    def velocity(x):
        along = np.interp(x[:, 0] - H, H * np.arange(N + 1), shape)
        return np.stack([speed + along, 0 * along], axis=1)

    def error(s, r):
        u, v = ends(s, 0)
        return max(off(u - speed * s.t, exact[0][-1], np.ptp(exact[0])), off(v - speed, exact[1][-1], np.ptp(exact[1])))

    law = mpm.Hencky(bulk=YOUNG / 3, shear=YOUNG / 2, porosity=0.5, grain_density=2 * DENSITY)
    walls = {"bottom": "y", "top": "y"}
    return Scene(mpm.Simulation(grid, [body], [law], walls=walls, inertia=mpm.Moving(velocity)), 4 * CROSSES, 4, error)


@family(1e-3)
def inertia_base():
    """Compare a block whose side accelerates with the exact motion of the side, for short and long steps."""
    for steps in decades(-6, 3):
        yield f"dt = {steps:.0e} h/c", partial(driven, steps * CROSSES)


def driven(dt: float, steps: int = 4) -> Scene:
    """Return a block whose left side accelerates; no side is on a grid line."""
    grid = mpm.Grid([0, 0], [N * H, N * H], [N, N])
    body = mpm.box(grid, [0.23, 0.23], [0.63, 0.63])
    way = H * min(0.1, SMALL * dt / CROSSES)  # m

    def moved(t):
        return (way * (t / (steps * dt)) ** 2, 0)

    def error(s, r):
        return off(s.points.corners[:, :, 0].min(), 0.23 + way, way)

    hold = mpm.Displacement("left", moved)
    s = mpm.Simulation(grid, [body], [soil(YOUNG)], walls={}, conditions=[hold], inertia=True)
    return Scene(s, steps * dt, steps, error)


@family(0.01)
def inertia_water():
    """Compare an undrained column with finite elements of the undrained modulus, for K_w = 1e4 to 1e12 Pa."""
    for bulk in decades(4, 12):
        law = mpm.Hencky(bulk=YOUNG / 3, shear=YOUNG / 2, porosity=0.5)
        young = YOUNG + 1 / law.storage(bulk, law.porosity)
        dt, weight = H / np.sqrt(young / DENSITY), -SMALL * young / DENSITY
        exact = bar(young, DENSITY, [H] * N, dt, 8, weight=weight)
        fluid = mpm.Fluid(bulk=bulk, density=DENSITY / 2)
        yield f"K_w = {bulk:.0e} Pa", column(against(exact, dt), dt, 8, gravity=(0, weight), fluid=fluid)
