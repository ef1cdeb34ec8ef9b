# SPDX-License-Identifier: MIT
"""Families of scenes for `extreme_cases`. Scenes of a family share one extreme property and an error bound."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from math import exp, inf, log, nan

import numpy as np
from extreme.scenes import (
    INCOMPRESSIBLE,
    SOIL,
    WATER,
    Beam,
    Error,
    M,
    Make,
    Scene,
    column,
    off,
    settled,
    soil,
    square,
    stretch,
    tip,
)
from scipy.optimize import brentq

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.exact import SelfWeightColumn


@dataclass(frozen=True)
class Family:
    """Scenes that share one extreme property.

    cases: generator of pairs (setting, scene).
    bound: largest allowed error of a scene.
    """

    cases: Callable[[], Iterator[tuple[str, Make]]]
    bound: float


FAMILIES: dict[str, Family] = {}


def family(bound: float):
    """Register a generator of pairs (setting, scene) as a family."""

    def register(cases):
        FAMILIES[cases.__name__.replace("_", "-")] = Family(cases, bound)
        return cases

    return register


def decades(low: int, high: int, step: int = 1) -> list[float]:
    """Return powers of ten from 10^low to 10^high, each 10^step times as large as the power before."""
    return [float(f"1e{n}") for n in range(low, high + 1, step)]


@family(0.01)
def conductivity():
    """Compare a beam with finite elements, for k = 1e-14 to 1e2 m/s. The beam drains at its free end."""
    for k in decades(-14, 2):
        yield f"k = {k:.0e} m/s", Beam(soil(conductivity=k), WATER)


@family(0.02)
def time_step():
    """Compare Terzaghi's layer with the exact solution, for dt = 1e-9 to 1e9 s."""
    water = {"fluid": INCOMPRESSIBLE, "conditions": [mpm.Drained("top")], "load": 1e-5 * M}
    for dt in decades(-9, 9):
        yield f"dt = {dt:.0e} s", column(partial(terzaghi, 0.05), (SOIL, 1.0), end=10 * dt, steps=10, **water)


def terzaghi(h: float, s: mpm.Simulation, r: mpm.Result) -> float:
    """Return the larger of two errors: of the pressures, and of the settlement.

    The error of the pressures is the mean absolute error over the points, divided by the load. The error of the
    settlement is divided by the final settlement.
    """
    m = (np.arange(20000) + 0.5) * np.pi
    left = np.exp(-(m**2) * s.t * SOIL.conductivity / INCOMPRESSIBLE.unit_weight * M)
    middle = (np.floor(s.points.x[:, 1:] / h) + 0.5) * h
    p = (2 / m * left * np.sin(m * (1 - middle)) * np.sinc(m * h / (2 * np.pi))).sum(axis=1)
    return max(
        np.abs(s.points.pressure / (1e-5 * M) - p).mean(), off(-tip(r)[1] / 1e-5, 1 - (2 / m**2 * left).sum(), 1)
    )


@family(0.01)
def time_step_of_a_beam():
    """Compare a beam with finite elements, for dt = 1e-9 to 1e9 s. The beam drains at its free end."""
    for dt in decades(-9, 9, 3):
        yield f"dt = {dt:.0e} s", Beam(SOIL, WATER, end=8 * dt)


@family(0.01)
def fluid_bulk():
    """Compare an undrained column with exact values, and an undrained beam with FEM, for K_w = 1e4 Pa to infinity."""
    load = 1e-5 * M
    for bulk in [*decades(4, 12), inf]:
        p = load / (1 + SOIL.storage(bulk, SOIL.porosity) * M)

        def error(s, r, p=p):
            return max(off(s.points.pressure, p, load), off(-tip(r)[1] * M, load - p, load))

        yield f"column, K_w = {bulk:.0e} Pa", column(error, (SOIL, 1.0), fluid=mpm.Fluid(bulk), load=load)
        yield f"beam, K_w = {bulk:.0e} Pa", Beam(SOIL, mpm.Fluid(bulk), drained=())


@family(0.02)
def combined():
    """Compare beams near the undrained or drained limit with finite elements in this limit, for several K_w and nu."""
    for bulk in (1e4, 2.2e9, inf):
        for nu in (0.0, 0.499):
            sealed = Beam(soil(nu=nu, conductivity=0), mpm.Fluid(bulk), drained=())
            for name, k, dt, limit in (("undrained", 1e-14, 1e-9, sealed), ("drained", 1e2, 1e9, Beam(soil(nu=nu)))):
                wet = Beam(soil(nu=nu, conductivity=k), mpm.Fluid(bulk), end=8 * dt)
                yield f"{name}, K_w = {bulk:.0e} Pa, nu = {nu}", partial(beside, wet, limit)


def beside(beam: Beam, limit: Beam) -> Scene:
    """Return the scene of `beam`. The reference is the finite element solution for the beam `limit`."""
    return replace(beam(), error=lambda s, r: off(tip(r), limit.elements()))


@family(0.02)
def poisson():
    """Compare a dry and a saturated beam with finite elements, for nu = 0 to 0.499."""
    for nu in (0.0, 0.2, 0.3, 0.4, 0.45, 0.48, 0.49, 0.499):
        truth = (80, 32) if nu > 0.45 else (40, 16)
        yield f"drained, nu = {nu}", Beam(soil(nu=nu), truth=truth)
        yield f"wet, nu = {nu}", Beam(soil(nu=nu), WATER, truth=truth)


@family(0.01)
def steps():
    """Compare a drained and an undrained beam with finite elements, for 1 to 640 load steps."""
    for n in (1, 2, 5, 10, 20, 40, 80, 160, 320, 640):
        yield f"drained, {n} steps", Beam(SOIL, steps=n, ramp=1.0)
        if n <= 160:
            yield f"undrained, {n} steps", Beam(soil(conductivity=0), WATER, drained=(), steps=n, ramp=1.0)


CUTS = {"on a grid line": 0.5, "within a cell": 0.50625}  # heights of the interface, m; cells of 1/80 m
DROP = 1e-2  # pressure difference, Pa, too small to move the layers


@family(0.02)
def contrast_of_conductivity():
    """Compare steady flow through two layers with exact pressures, for ratios of k from 1e-8 to 1e8."""
    for name, cut in CUTS.items():
        for ratio in decades(-8, 8, 1 if cut == 0.5 else 2):
            layers = (SOIL, cut), (soil(conductivity=SOIL.conductivity * ratio), 1.0)
            ends = [mpm.Drained(side, p, ([-inf, y], [inf, y])) for side, p, y in (("bottom", DROP, 0), ("top", 0, 1))]
            flow = {"h": 1 / 80, "end": 1e15, "fluid": INCOMPRESSIBLE, "conditions": ends}
            yield f"{ratio:.0e}, interface {name}", column(partial(series, cut, ratio), *layers, **flow)


def series(cut: float, ratio: float, s: mpm.Simulation, r: mpm.Result) -> float:
    """Return the largest error of the pressures, divided by the pressure drop across the layers."""
    cells = s.cells()
    y = cells.x[:, 1]
    lost = np.where(y < cut, y, cut + (y - cut) / ratio) / (cut + (1 - cut) / ratio)
    return off(cells.pressure / DROP, 1 - lost, 1)


@family(0.02)
def contrast_of_stiffness():
    """Compare two layers under large and tiny loads with exact settlements, for ratios of E from 1e-6 to 1e6."""
    for name, cut in CUTS.items():
        for ratio in decades(-6, 6, 1 if cut == 0.5 else 2):
            for strain in (1e-2, 1e-6, 1e-10) if ratio in (1e-6, 1e6) else (1e-2,):
                load = strain * M * min(1, ratio)
                exact = cut * (stretch(load / M) - 1) + (1 - cut) * (stretch(load / M / ratio) - 1)
                layers = (SOIL, cut), (soil(1e7 * ratio), 1.0)
                setting = f"{ratio:.0e}, strain {strain:.0e}, interface {name}"
                yield setting, column(settled(exact), *layers, h=1 / 80, load=load)


@family(0.01)
def offset():
    """Compare a beam with finite elements, at 20 random positions on the grid."""
    for i, (x, y) in enumerate(np.random.default_rng(0).random((20, 2))):
        place = {"offset": float(y), "h": (1 / (19 + float(x)), 0.05)}
        yield f"{i}: {x:.3f}, {y:.3f} of a cell", Beam(soil(conductivity=1e-5), WATER, **place)


@family(0.02)
def rotation():
    """Compare a square, rotated by 0 to 90 degrees, with exact values (undrained) or with results on a finer grid."""
    K, S = SOIL.drained_modulus(2), SOIL.storage(WATER.bulk, SOIL.porosity)
    J = stretch(1e5 / (2 * K)) ** 2
    a = brentq(lambda a: 2 * K * log(a) / a - (1 - a * a) / (S * a) + 1e5, 0.5, 1)
    p = (1 - a * a) / (S * a * a)
    for angle in (0, 5, 15, 30, 45, 60, 75, 90):
        yield f"drained, {angle} degrees", square(angle, lambda s, r: off(s.points.J, J, 1 - J))
        sealed = {"fluid": WATER, "steps": 1}
        yield f"undrained, {angle} degrees", square(angle, lambda s, r: off(s.points.pressure, p), **sealed)
        yield f"draining, {angle} degrees", square(angle, draining_error, **DRAINING)


DRAINING = {"cells": 24, "fluid": WATER, "end": 0.4, "steps": 16, "drained": ("left", "right", "bottom", "top")}


def held(s: mpm.Simulation) -> float:
    """Return the mean pressure of the points, in Pa."""
    return float(s.points.volume0 @ s.points.pressure / s.points.volume0.sum())


@cache
def half_drained() -> float:
    """Return the final mean pressure, in Pa, of the unrotated square on a grid of half the cell size."""
    scene = square(0, None, **{**DRAINING, "cells": 48})()
    scene.simulation.run(scene.end, scene.end / scene.steps, progress=False)
    return held(scene.simulation)


def draining_error(s: mpm.Simulation, r: mpm.Result) -> float:
    """Return the error of the mean pressure, divided by the initial pressure of 1e5 Pa."""
    return off(held(s), half_drained(), 1e5)


@family(0.02)
def rotation_of_a_beam():
    """Compare a beam, rotated by 5 to 90 degrees and fixed by a prescribed displacement, with finite elements."""
    for angle in (5, 15, 30, 45, 60, 75, 90):
        yield f"{angle} degrees", Beam(soil(conductivity=1e-5), WATER, angle=angle, h=(0.025, 0.025))


@family(0.01)
def points_per_cell():
    """Compare a beam with finite elements, for 1 to 5 points per cell and direction."""
    for n in range(1, 6):
        for y in (0.0, 0.3):
            many = {"per_cell": n, "offset": y, "h": (0.025, 0.025)}
            yield f"{n} x {n} points, {y} of a cell", Beam(soil(conductivity=1e-5), WATER, **many)


@family(0.01)
def filling():
    """Compare a beam with FEM, and a column with exact values. Of their outermost cells, 1e-10 to 0.5 is filled."""
    for f in (*decades(-10, -1), 0.5):
        yield f"beam, {f:.0e} of a cell", Beam(soil(conductivity=1e-5), WATER, offset=1 - f)
        top = 1 + 0.05 * f
        yield f"column, {f:.0e} of a cell", column(settled(top * (stretch(0.1) - 1)), (SOIL, top), load=0.1 * M)


@family(0.01)
def few_points():
    """Compare columns of at most one cell, or of one point, with the exact settlement."""
    for name, h, n in (("1 cell, 1 point", 1, 1), ("1 cell, 2 x 2 points", 1, 2), ("0.1 of a cell, 1 point", 10, 1)):
        yield name, column(settled(stretch(0.1) - 1), (SOIL, 1.0), h=h, per_cell=n, load=0.1 * M)


@family(1.0)
def thin():
    """Compare beams with Q1 elements on cells of the same size. Beams are half a cell, one or two cells high.

    The thinnest beam has at least two points over its height. With one point the beam would creep, and the package
    would warn.
    """
    for height, h, cells in ((0.05, 0.1, (10, 1)), (0.1, 0.1, (10, 1)), (0.1, 0.05, (20, 2))):
        for n in (3, 4) if height < h else (2, 3):
            for y in (0.0, 0.3):
                beam = Beam(load=500.0, size=(1.0, height), truth=(40, 4), h=(h, h), offset=y, per_cell=n)
                yield f"{height / h:g} cells, {n} x {n} points, {y} of a cell", partial(beside_q1, beam, cells)


def beside_q1(beam: Beam, cells: tuple[int, int]) -> Scene:
    """Return the scene of the beam, with the error divided by the error of Q1 elements on `cells` cells."""
    scene = beam()
    bound = off(beam.elements("q1-dg0", cells), beam.elements())
    return replace(scene, error=lambda s, r: off(tip(r), beam.elements()) / bound)


@family(0.01)
def weight():
    """Compare columns under their weight with exact heights (rho g H / E = 1e-6 to 10), and beams with FEM."""
    density = (1 - SOIL.porosity) * SOIL.grain_density
    for ratio in decades(-6, 1):
        E = density * 10 / ratio
        exact = SelfWeightColumn(1.0, E / 3, E / 2, density, 10.0).height - 1
        yield f"{ratio:.0e}", column(settled(exact), (soil(E), 1.0), steps=10, gravity=lambda t: (0, -10 * t))
    for g in (1.0, 10.0):
        yield f"beam, {g:g} m/s2", Beam(load=0, weight=g)
    for bulk in (1e6, inf):
        buoyant = -(1 - SOIL.porosity) * (SOIL.grain_density - 1000) * 9.81 / (2 * M)
        wet = {"fluid": mpm.Fluid(bulk), "conditions": [mpm.Drained("top")], "gravity": (0, -9.81)}
        yield f"wet, K_w = {bulk:.0e} Pa", column(settled(buoyant), (SOIL, 1.0), end=1e9, steps=5, **wet)


@family(0.01)
def suction():
    """Compare a column under pore pressures of -10 to 0.5 times the modulus with exact values, or expect a refusal."""
    for ratio in (*(-x for x in decades(-6, 1)), 0.01, 0.1, 0.3, 0.4, 0.5):
        a = stretch(-ratio) if ratio < exp(-1) else nan

        def error(s, r, a=a, p=ratio * M):
            return max(off(tip(r)[1], a - 1), off(s.points.pressure, p))

        physics = {"end": 1e9, "room": 30, "fluid": WATER, "conditions": [mpm.Drained("top", ratio * M)]}
        yield f"p = {ratio:g} M", column(error if a > 1 - SOIL.porosity else None, (SOIL, 1.0), **physics)
    for p in (-1e3, -1e6):
        S = SOIL.storage(1e6, SOIL.porosity)
        a = brentq(lambda a, p=p, S=S: M * log(a) / a - p - (1 - a) / (S * a), 0.5, 1)
        yield f"sealed, {p:g} Pa at the start", column(settled(a - 1), (SOIL, 1.0), fluid=mpm.Fluid(1e6), pressure=p)


@family(0.02)
def buckling():
    """Compare a slender cantilever under 0.5 to 2 times its buckling load with finite elements."""
    # under a larger load the beam would curl back behind its clamp, where the grid ends
    critical = np.pi**2 * M * 0.1**2 / 12 / 4
    slender = Beam(load=200.0, size=(1.0, 0.1), truth=(40, 4), truth_steps=40, h=(0.0125, 0.0125), ramp=1.0)
    for ratio, n in ((0.5, 40), (0.9, 40), (1.1, 40), (1.1, 1), (1.5, 40), (1.5, 1), (2.0, 40), (2.0, 1)):
        yield f"{ratio} times, {n} steps", replace(slender, thrust=ratio * critical, steps=n)


@family(0.01)
def overload():
    """Compare a column under loads of -1 to 100 times the modulus with exact values, or expect a refusal."""
    for law in (mpm.Hencky, mpm.NeoHookean, mpm.LinearElastic):
        for ratio in (0.1, 1, 10, 100, -0.1, -0.3, -0.4, -1):
            error = pressed(soil(law=law), ratio * M)
            yield f"{law.__name__}, {ratio:g} M", column(error, (soil(law=law), 1.0), load=ratio * M, room=40)
    for load in (2e5, 2e6, 2e7):
        yield f"beam, {load:.0e} Pa", Beam(load=load, steps=1, truth_steps=40, ramp=1.0)


def pressed(material, load: float) -> Error | None:
    """Return a function that computes the error of the settlement under a load (Pa), or None without equilibrium."""

    def excess(a):
        lam = material.bulk - 2 * material.shear / 3
        stress = {mpm.Hencky: M * log(a) / a, mpm.LinearElastic: M * (a - 1)}
        return load + stress.get(type(material), material.shear * (a - 1 / a) + lam * log(a) / a)

    low, high = (1e-6, 1.0) if load > 0 else (1.0, exp(1) if isinstance(material, mpm.Hencky) else 1e3)
    return settled(brentq(excess, low, high, xtol=1e-15) - 1) if excess(low) * excess(high) < 0 else None


@family(0.01)
def units():
    """Compare beams of 1e-6 to 1e6 m, or with E = 1 to 1e15 Pa, with the scaled FEM solution for 1 m and 10 MPa."""
    exact = Beam().elements()
    for x in decades(-6, 6, 3):
        beam = Beam(size=(x, 0.4 * x), h=(0.05 * x, 0.05 * x))
        yield f"{x:.0e} m", lambda b=beam, e=x * exact: replace(b(), error=lambda s, r: off(tip(r), e))
    for E in (1.0, 1e3, 1e11, 1e15):
        beam = Beam(soil(E), load=2e-3 * E)
        yield f"{E:.0e} Pa", partial(beside, beam, Beam())


@family(1e-4)
def rain():
    """Compare a column under rain with exact heads, for k = 1e-12 to 1 m/s and alpha h = 1e-3 to 1e3.

    The rain increases from (k / 20) to (k / 2). Here alpha is Gardner's constant (1/m) and h is the cell size (m).
    """
    for k in [*decades(-12, 0, 4), 0.1]:
        for steep in decades(-3, 3):
            yield f"k = {k:.0e} m/s, alpha h = {steep:.0e}", partial(rained, k, steep)


def rained(k: float, steep: float) -> Scene:
    """Return a column under steady rain, for `steep` = alpha h."""

    def steady(share: float, alpha: float, z: np.ndarray) -> np.ndarray:
        return np.log(share + (1 - share) * np.exp(-alpha * z)) / alpha

    def exact(z: np.ndarray) -> np.ndarray:
        return steady(0.5, 10 * steep, z)

    def start(z: np.ndarray) -> np.ndarray:
        return steady(0.05, 10 * steep, z)

    return exponential([k], [10 * steep], [mpm.Rain("top", k / 2)], exact, start, 100 / k)


@family(1e-4)
def evaporation():
    """Compare a drying column with exact heads, for k = 1e-12 to 1 m/s and alpha h = 1e-3 to 1e2.

    The pressure head at the surface does not fall below -1.5 m. `rain` defines alpha h.
    """
    for k in decades(-12, 0, 4):
        for steep in decades(-3, 2):
            yield f"k = {k:.0e} m/s, alpha h = {steep:.0e}", partial(dried, k, steep)


def dried(k: float, steep: float, driest: float = -1.5) -> Scene:
    """Return the drying column, with `steep` = alpha h and the lowest pressure head `driest`, in m."""
    alpha = 10 * steep

    def exact(z: np.ndarray) -> np.ndarray:
        lost = (np.exp(alpha * (z - 1)) - np.exp(-alpha)) / -np.expm1(-alpha)
        return np.log1p(lost * np.expm1(alpha * (driest + 1))) / alpha - z

    sun = mpm.Rain("top", -1e3 * k, driest=driest * 9810.0)
    return exponential([k], [alpha], [sun], exact, np.negative, 100 / k)


@family(1e-4)
def layered_rain():
    """Compare two layers under rain with exact heads, for ratios of k from 1e-3 to 1e3 and alpha h = 1e-2 to 1e2.

    `rain` defines alpha h. The interface is not on a grid line.
    """
    for ratio in decades(-3, 3, 2):
        for steep in decades(-2, 2):
            for other in (0.1, 10.0):
                given = partial(rained_layers, ratio, steep, other)
                yield f"k ratio {ratio:.0e}, alpha h = {steep:.0e}, {steep * other:.0e}", given
    for grid in ("axisymmetric", "3D"):
        yield grid, partial(rained_layers, 10.0, 0.3, 3.0, grid)


def rained_layers(ratio: float, steep: float, other: float, grid: str = "plane") -> Scene:
    """Return a column of two layers under rain, with `steep` = alpha h of the lower layer.

    ratio: conductivity of the upper layer, divided by the conductivity of the lower layer.
    other: alpha of the upper layer, divided by alpha of the lower layer.
    """
    k, alpha, edge = [1e-6, 1e-6 * ratio], [10 * steep, 10 * steep * other], 0.53
    rain = min(k) / 2

    def exact(z: np.ndarray, q: float = rain) -> np.ndarray:
        def above(head: float, i: int, way: np.ndarray) -> np.ndarray:
            return np.log(q / k[i] + (np.exp(alpha[i] * head) - q / k[i]) * np.exp(-alpha[i] * way)) / alpha[i]

        return np.where(z < edge, above(0.0, 0, z), above(above(0.0, 0, edge), 1, np.maximum(z - edge, 0.0)))

    def start(z: np.ndarray) -> np.ndarray:
        return exact(z, rain / 5)

    return exponential(k, alpha, [mpm.Rain("top", rain)], exact, start, 1e3 / rain, edge, grid)


def exponential(
    k: list[float],
    alpha: list[float],
    sides: list,
    exact: Callable[[np.ndarray], np.ndarray],
    start: Callable[[np.ndarray], np.ndarray],
    end: float,
    edge: float | None = None,
    kind: str = "plane",
) -> Scene:
    """Return a column of one or two exponential soils over a water table, with its exact heads.

    k: conductivity of each soil, in m/s.
    alpha: Gardner's constant of each soil, in 1/m.
    exact, start: final and initial head as functions of the height, in m.
    edge: height of the lower end of the second soil, in m.
    kind: "plane", "axisymmetric" or "3D".
    """
    h, weight, d = 0.1, 9810.0, 3 if kind == "3D" else 2
    grid = mpm.Grid([0] * d, [h] * (d - 1) + [1 + 2 * h], [1] * (d - 1) + [12], axisymmetric=kind == "axisymmetric")
    soils = [
        mpm.LinearElastic(1e9, 5e8, porosity=0.4, conductivity=one, retention=mpm.Gardner(weight / a))
        for one, a in zip(k, alpha, strict=True)
    ]
    ends = [0.0, 1.0] if edge is None else [0.0, edge, 1.0]
    flat = [0.0] * (d - 1)
    bodies = [mpm.box(grid, [*flat, a], [*[h] * (d - 1), b], material=i) for i, (a, b) in enumerate(pairwise(ends))]
    walls = {"left": "x", "right": "x", "bottom": "xyz"[d - 1]} | ({"front": "y", "back": "y"} if d == 3 else {})
    if kind == "axisymmetric":
        del walls["left"]
    simulation = mpm.Simulation(
        grid,
        bodies,
        soils,
        fluid=mpm.Fluid(),
        gravity=(*flat, -9.81),
        walls=walls,
        conditions=[mpm.Drained("bottom"), *sides],
        pressure=lambda x: weight * start(x[:, -1]),
        initial_stress=mpm.K0(0.5),
        numerics=mpm.Numerics(tolerance=1e-9),  # the residual contains the rounding errors of a steady state
    )

    def error(s: mpm.Simulation, result: mpm.Result) -> float:
        cell = s.cells()
        return off(cell.pressure / weight, exact(cell.x[:, -1]))

    return Scene(simulation, end, 20, error)


@family(1e-3)
def ponding():
    """Compare a ponded column of van Genuchten's soil with exact steady heads, for initial heads of -1 to -100 m."""
    for n in (1.2, 2.0, 7.0):
        for head in (-1.0, -10.0, -100.0):
            for alpha in (0.5, 15.0):
                yield f"n = {n:g}, alpha = {alpha:g} /m, head {head:g} m", partial(ponded, n, head, alpha)


def ponded(n: float, head: float, alpha: float) -> Scene:
    """Return a column that is ponded by 0.1 m of water until it is saturated, and drained at its base.

    n, alpha: van Genuchten's parameters; alpha is in 1/m.
    head: initial head, in m.
    """
    law = mpm.VanGenuchten(9810.0 / alpha, residual=0.1, n=n, air_entry=100.0)
    soil = mpm.LinearElastic(1e9, 5e8, porosity=0.4, conductivity=1e-5, retention=law)
    grid = mpm.Grid([0, 0], [0.1, 1.2], [1, 12])

    def error(s: mpm.Simulation, result: mpm.Result) -> float:
        return off(s.cells().pressure / 9810.0, 0.1 * s.cells().x[:, 1], 1)

    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [0.1, 1])],
        [soil],
        fluid=mpm.Fluid(),
        gravity=(0, -9.81),
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[mpm.Drained("bottom"), mpm.Drained("top", pressure=981.0)],
        pressure=9810.0 * head,
        initial_stress=mpm.K0(0.5),
    )
    return Scene(simulation, 1e7, 20, error)
