# SPDX-License-Identifier: MIT
"""A strip footing is pushed into saturated soil, to a depth of its width, at three rates.

The footing is rough and rigid, and has the width B. By symmetry half of the footing is computed, as a prescribed
displacement on a part of the soil's top. The soil is a weightless layer, 2.5 B thick, on rough rock. The soil follows
Drucker and Prager's law with cohesion c, and drains at its free top. The rate is the dimensionless velocity
`V = v B / c_v`, with the velocity v of the footing and the coefficient of consolidation c_v.

A smooth, impervious wall bounds the soil at 8 B from the middle of the footing. With a wall at 16 B, loads change by
less than 1 % at any depth and rate. With a wall at 4 B, drained loads are up to 8 % too large.

Limit loads are computed with very stiff soil, which flows before the geometry changes. Without friction the bearing
capacity is `q = (2 + pi) s_u` (Prandtl 1921), with the undrained strength s_u. With the friction angle phi and
associated flow the capacity is `q = c N_c`, with `N_c = (exp(pi tan(phi)) tan^2(45 deg + phi/2) - 1) / tan(phi)`.

In the push to the depth B the soil does not dilate. An undrained footing at depth D carries (1 + 0.27 sqrt(D/B)) times
the load at the surface (Salgado, Lyamin, Sloan and Yu 2004). The drained capacity at the surface is at most c N_c, and
at least the capacity for the reduced friction of Davis (1968).

The undrained limit load converges from below, with order 1.5: its error is -5.9 % with 5 cells, -2.4 % with 9 cells and
-0.85 % with 17 cells. Use an odd number of cells over the width. With an even number, the effective width of the
footing exceeds the true width by a cell.

The error of the drained limit load is -0.5 % with 5 cells, +0.5 % with 9 cells and +0.9 % with 17 cells.

The limit load of a rough circular footing on Tresca's soil, in axisymmetry, is 6.05 s_u (Cox, Eason and Hopkins 1961).

With --graded, cells are fine in a region of 2 B x 0.75 B below the footing. Outside this region, each cell is a tenth
longer than its finer neighbour, up to eight times the smallest length.

With --square, square and circular footings, rough and smooth, are pushed into Tresca's soil, on graded cells. The
footings are tools. A quarter of the square is computed in 3D. N_c is the limit load, divided by area and c. The bounds
of N_c are 5.52 and 6.22 for a rough square (Salgado, Lyamin, Sloan and Yu 2004), and 2 + pi and 5.71 for a smooth
square (Shield and Drucker 1955). Circles are computed in axisymmetry, on cells about half as large as for squares. The
exact N_c is 6.05 for a rough circle (Cox, Eason and Hopkins 1961), and 5.69 for a smooth circle (Shield 1955).

With non-associated flow the solution is not unique (Rudnicki and Rice 1975). Shear bands change their position between
steps, and on fine grids many steps are cut. The option --viscosity adds a small viscous stress, which makes the
solution unique (Needleman 1988). With --explicit-friction, friction follows from the mean stress at the start of each
step. Flow is then associated within the step (Krabbenhoft, Karim, Lyamin and Sloan 2012).

With --speed, the soil is dry and has inertia. The footing moves with this fraction of the velocity of shear waves. With
a speed of 0, the soil is dry, without inertia.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import ClassVar

import common
import numpy as np
import ufl

import mpm_dolfinx as mpm

WIDTH = 1.0  # m
COHESION, FRICTION = 1e4, 20.0  # Pa, degrees
SHEAR = 100 * COHESION
SOIL = mpm.DruckerPrager(
    bulk=13 / 6 * SHEAR,  # nu = 0.3
    shear=SHEAR,
    friction=FRICTION,
    dilation=0.0,
    cohesion=COHESION,
    porosity=0.4,
    conductivity=1e-8,
)
OF_SOIL = {f.name: getattr(SOIL, f.name) for f in fields(SOIL)}
WATER = mpm.Fluid()
CV = SOIL.conductivity / WATER.unit_weight * SOIL.oedometric  # m²/s
SHEAR_WAVES = (SHEAR / ((1 - SOIL.porosity) * SOIL.grain_density)) ** 0.5  # their velocity in dry soil, m/s
RATES = {"fast": 1000.0, "intermediate": 1.0, "slow": 1e-3}  # V
COLOURS = ("C0", "C1", "C2")  # one for each rate
STEP = 1 / 14  # fraction of a cell that the footing moves in a step
BOX = (8.0, 2.5)  # width and height of half the soil, divided by B
COARSE = 5  # largest number of cells over the width, in runs with a box twice as wide
STIFF = 100  # factor of the stiffness of soil for limit loads
LIMITS_OF = {  # for limit loads: depth divided by B, box
    "undrained": (0.0012, (2.0, 1.2)),
    "drained": (0.003, (4.0, 1.7)),
    "circular": (0.0012, (2.0, 1.2)),
}
NEAR = (1.0, 0.75)  # size of the computed half of the fine region, divided by B
RATIO, LARGEST = 1.1, 8  # ratio of the sizes of neighbouring cells; of the largest and the smallest cells
FAR = {"equal": (2.0, 2.5), "graded": (10.0, 10.0)}  # box of half the soil, divided by B
ROUND = 6.05  # limit load of a rough circular footing, divided by area and s_u
KNOWN = {  # bounds of limit loads, divided by area and s_u
    "square": {"rough": (5.52, 6.22), "smooth": (2 + np.pi, 5.71)},
    "circle": {"rough": (ROUND, ROUND), "smooth": (5.69, 5.69)},
}
SOLID = {"box": 5.0, "near": (0.8, 0.5), "ratio": 1.2}  # for --square, divided by B: soil, fine region; see RATIO
LIMIT_DEPTH, LIMIT_STEPS = 0.0015, 8  # for --square: depth / B, number of steps


def capacity(friction: float) -> float:
    """Return Prandtl's N_c for a friction angle in degrees."""
    t = np.tan(np.radians(friction))
    return 2 + np.pi if t == 0 else (np.exp(np.pi * t) * np.tan(np.pi / 4 + np.radians(friction) / 2) ** 2 - 1) / t


SURFACE = {  # limit loads divided by B c; Davis: reduced friction phi*, tan phi* = sin phi, in plane strain
    "undrained": SOIL.xi * capacity(0.0),
    "drained, Davis": SOIL.xi * capacity(np.degrees(np.arctan(SOIL.eta))),
    "drained, associated": capacity(FRICTION),
}


def embedded(depth):
    """Return the undrained limit load, divided by B c, of a footing at a depth of `depth` times B."""
    return SURFACE["undrained"] * (1 + 0.27 * np.sqrt(depth))


@dataclass(frozen=True, kw_only=True)
class ExplicitFriction(mpm.DruckerPrager):
    """Drucker-Prager soil whose friction follows from the mean stress at the start of each step.

    Within a step, the friction angle equals the dilation angle, so flow is associated. The cohesion contains the rest
    of the friction (Krabbenhoft, Karim, Lyamin and Sloan 2012). Two state variables are added:
    mean: mean Kirchhoff stress, in Pa.
    strength: strength at zero mean stress in the last step, in Pa.
    """

    state: ClassVar = mpm.DruckerPrager.state | {"mean": 0.0, "strength": 0.0}

    @property
    def symmetric(self) -> bool:
        return True

    @staticmethod
    def kirchhoff(F, bulk, shear, eta, xi, eta_flow, cohesion, plastic, hardened, mean, strength, dt):
        """Return the Kirchhoff stress (3, 3) in UFL, in Pa."""
        now = ExplicitFriction.present(eta, xi, eta_flow, cohesion, mean, strength, dt)
        return mpm.DruckerPrager.kirchhoff(F, bulk, shear, eta_flow, 1.0, eta_flow, now, 0.0, plastic, hardened)

    @staticmethod
    def update(F, bulk, shear, eta, xi, eta_flow, cohesion, plastic, hardened, mean, strength, dt):
        """Return the state variables at the end of the step in UFL, by name."""
        now = ExplicitFriction.present(eta, xi, eta_flow, cohesion, mean, strength, dt)
        law = F, bulk, shear, eta_flow, 1.0, eta_flow, now, 0.0, plastic, hardened
        stress = ufl.tr(mpm.DruckerPrager.kirchhoff(*law)) / 3
        return mpm.DruckerPrager.update(*law) | {"mean": stress, "strength": now}

    @staticmethod
    def present(eta, xi, eta_flow, cohesion, mean, strength, dt):
        """Return the strength at zero mean stress, in Pa."""
        return ufl.conditional(ufl.gt(dt, 0), ufl.max_value(xi * cohesion - (eta - eta_flow) * mean, 0), strength)


@dataclass
class Frame:
    """State of footing and soil at one time of a push.

    t: time divided by the duration of the push.
    settlement: settlement of the footing, divided by B.
    corners (n, 4, 2), pressure (n,): corners (m) and pore pressures (Pa) of the domains.
    top (k, 2): positions of the soil's surface (m) from the middle outward.
    """

    t: float
    settlement: float
    corners: np.ndarray
    pressure: np.ndarray
    top: np.ndarray


@dataclass
class Push:
    """Results of a push.

    settlement, load: settlement divided by B, and load divided by area and c, after each step.
    frames: states at some times.
    pushed: index of the last step of the push; later steps are consolidation.
    """

    settlement: list[float] = field(default_factory=lambda: [0.0])
    load: list[float] = field(default_factory=lambda: [0.0])
    frames: list[Frame] = field(default_factory=list)
    pushed: int = 0
    results: list[mpm.Result] = field(default_factory=list)

    def total(self, name: str) -> float:
        """Return the sum of one attribute, such as the number of steps, over all results."""
        return sum(getattr(result, name) for result in self.results)

    @property
    def at_end(self) -> Frame:
        """The frame at the end of the push."""
        return next(frame for frame in self.frames if frame.t >= 1 - 1e-9)


def push(
    soil: mpm.DruckerPrager | mpm.MohrCoulomb,
    cells: int,
    depth: float,
    rate: float | None,
    *,
    box=BOX,
    rest=0.0,
    steps: int | None = None,
    circular: bool = False,
    method: str = "sdirk2",
    graded: bool = False,
    speed: float = 0.0,
) -> Push:
    """Push the footing.

    cells: number of cells over the footing's width, odd.
    depth: depth of the push, divided by B.
    rate: dimensionless velocity V, or None for a scene without water.
    box: width and height of the computed half of the soil, divided by B.
    rest: time of consolidation after the push, divided by B²/c_v.
    steps: number of equal steps of the push; by default a step moves the footing by `STEP` cells.
    circular: whether the footing is a disc of diameter B instead of a strip.
    method: time integration, see `Numerics`.
    graded: whether cells become larger away from the footing.
    speed: velocity of the footing divided by that of shear waves in dry soil. If positive, the soil has inertia.
    """
    h = WIDTH / cells
    columns, rows, air = (round(size * cells) for size in (*box, 0.25 + 0.5 * depth))
    size, cells_of = {"lower": [0, -rows * h], "upper": [columns * h, air * h]}, [columns, rows + air]
    grid = mpm.Grid(**size, cells=cells_of, axisymmetric=circular)
    if graded:
        wide, deep = (round(edge * cells) * h for edge in NEAR)
        lines = mpm.graded(*size.values(), [[[0, -deep], [wide, air * h]]], h, RATIO, LARGEST * h)
        grid = mpm.Grid(lines=lines, axisymmetric=circular)
    body = mpm.box(grid, [0, -rows * h], [columns * h, 0])
    velocity = CV * rate / WIDTH if rate else speed * SHEAR_WAVES or depth * WIDTH  # m/s
    end, edge = depth * WIDTH / velocity, WIDTH / 2
    # the drained part of the top begins at the outermost node of the footing
    under, beside = ((0, -np.inf), (edge, np.inf)), ((edge - h / 2, -np.inf), (np.inf, np.inf))
    footing = mpm.Displacement("top", lambda t, X: (0, -depth * WIDTH * min(1, t / end)), region=under, name="footing")
    sides, water = [footing], {}
    if rate:
        sides.append(mpm.Drained("top", region=beside))
        water = {"fluid": WATER}
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    how = {"numerics": mpm.Numerics(method=method), "inertia": True if speed else None} | water
    simulation = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=sides, **how)
    out = Push()

    def observe(s: mpm.Simulation) -> None:
        out.settlement.append(depth * min(1, s.t / end))
        area = np.pi / 4 * WIDTH**2 if circular else WIDTH / 2  # m^2: disc, or half of the strip
        out.load.append(-s.reactions["footing"][1] / (area * COHESION))
        if len(out.load) % 5 == 0 or s.result.converged:
            corners, pressure = common.whole(s, "corners", "pressure")
            top = corners[body.sides[:, 1, 1]][:, 2:].reshape(-1, 2)
            out.frames.append(Frame(s.t / end, out.settlement[-1], corners, pressure, top))

    steps = steps or max(10, round(depth * cells / STEP))
    out.results.append(simulation.run(end, end / steps, observe=observe))
    out.pushed = len(out.load) - 1
    if rest:
        later = rest * WIDTH**2 / CV
        out.results.append(simulation.run(end + later, later / 40, observe=observe))
    return out


def limit_load(
    how: str, cells: int, box: tuple[float, float] | None = None, graded: bool = False, steps: int = 40
) -> Push:
    """Push the footing into very stiff soil; the returned loads are divided by the theoretical limit load.

    how: key of `LIMITS_OF`.
    box, graded: see `push`; by default the box of `LIMITS_OF`, with cells of equal size.
    steps: number of computed steps of the undrained push, which is complete after 40. Other pushes take 40 steps.
    """
    soil, (depth, own) = replace(SOIL, bulk=STIFF * SOIL.bulk, shear=STIFF * SOIL.shear), LIMITS_OF[how]
    box = box or own
    if how == "circular":
        tresca = mpm.MohrCoulomb(bulk=soil.bulk, shear=soil.shear, friction=0, dilation=0, cohesion=COHESION)
        out = push(tresca, cells, depth, None, box=box, steps=40, circular=True)
    elif how == "undrained":
        clay = replace(soil, friction=0.0, conductivity=0.0)
        out = push(clay, cells, depth * steps / 40, RATES["fast"], box=box, steps=steps, graded=graded)
    else:
        out = push(replace(soil, dilation=FRICTION), cells, depth, None, box=box, steps=40)
    limit = {"undrained": capacity(0.0), "drained": capacity(FRICTION), "circular": ROUND}[how]
    out.load = [load / limit for load in out.load]
    return out


def bearing(shape: str, roughness: str, cells: int) -> dict[str, float]:
    """Push a square in 3D or a circle in axisymmetry to its limit load, and print and return N_c and costs."""
    began, h, flat = time.process_time(), WIDTH / cells, 2 if shape == "square" else 1
    wide, deep = (round(edge * cells) * h for edge in SOLID["near"])
    size = [0.0] * flat + [-SOLID["box"]], [SOLID["box"]] * flat + [2 * h]
    fine = [0.0] * flat + [-deep], [wide] * flat + [2 * h]
    grid = mpm.Grid(lines=mpm.graded(*size, [fine], h, SOLID["ratio"], LARGEST * h), axisymmetric=flat == 1)
    body = mpm.box(grid, size[0], [*size[1][:flat], 0])
    soil = mpm.MohrCoulomb(bulk=STIFF * SOIL.bulk, shear=STIFF * SOIL.shear, friction=0, dilation=0, cohesion=COHESION)
    down, half = np.eye(flat + 1)[flat] * -LIMIT_DEPTH * WIDTH, WIDTH / 2
    block = mpm.Convex(np.array(list(product(*[(-half, half)] * flat, (0.0, WIDTH)))))
    glued = 9 * COHESION if roughness == "rough" else 0.0
    push = mpm.Tool(block, lambda t: down * t, adhesion=glued, name="footing")
    walls = {"left": "x", "right": "x", "bottom": "xyz"[: flat + 1]}
    walls |= dict.fromkeys(("front", "back") * (flat == 2), "y")
    run = mpm.Simulation(grid, [body], [soil], walls=walls, conditions=[push]).run(1.0, 1 / LIMIT_STEPS)
    area = WIDTH**2 / 4 if shape == "square" else np.pi / 4 * WIDTH**2
    N, (low, high) = -run.tool_forces["footing"][:, flat] / (area * COHESION), KNOWN[shape][roughness]
    out = {"N": float(N[-1]), "error": float(min(N[-1] / low - 1, 0) + max(N[-1] / high - 1, 0))}
    out |= {"rise": float(N[-1] / N[-2] - 1), "cells": int(grid.shape.prod()), "points": run.points}
    out |= {"newton": run.newton, "iterations": run.coupling, "MB": run.memory, "cpu": time.process_time() - began}
    if common.first():
        bounds = f"{low:.2f} to {high:.2f}" if low < high else f"{low:.2f}"
        print(f"{roughness} {shape}, {cells} cells over the width: N_c = {N[-1]:.3f}, known {bounds}; ", end="")
        print(f"{out['rise']:+.2%} in the last step; {out['cells']} cells, {run.points} points, ", end="")
        print(f"{run.newton} Newton steps, {run.coupling} iterations, {run.memory:.0f} MB, ", end="")
        print(f"{out['cpu']:.0f} s of processor time", flush=True)
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__, processes=True)
    parser.add_argument("--cells", type=int, default=9, help="cells over the footing's width, odd")
    parser.add_argument("--depth", type=float, default=1.0, help="final depth divided by the footing's width")
    parser.add_argument("--steps", type=int, help="run only the intermediate rate, in this number of equal steps")
    parser.add_argument("--box", type=float, default=BOX[0], help="with --steps: width of half the soil divided by B")
    methods = ("sdirk2", "backward-euler")
    parser.add_argument("--method", choices=methods, default=methods[0], help="with --steps: time integration")
    what = "with --steps: viscosity of the soil, divided by the cohesion and by the time of the push"
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--viscosity", type=float, default=0.0, help=what)
    what = "with --steps: friction from the mean stress at the start of each step"
    how.add_argument("--explicit-friction", action="store_true", help=what)
    what = "with --steps: velocity of the footing, divided by that of shear waves; the soil is dry, with inertia if > 0"
    how.add_argument("--speed", type=float, help=what)
    parser.add_argument(
        "--graded", action="store_true", help="only the undrained limit load, in a large box of graded cells"
    )
    parser.add_argument(
        "--square", action="store_true", help="only limit loads of squares, in 3D, and circles, on graded cells"
    )
    o = parser.parse_args(argv)
    if (o.graded or o.square) and (o.steps, o.depth, o.graded and o.square) != (None, 1.0, False):
        parser.error("--graded, --square: must go without --steps and --depth, and without each other")
    if o.cells < 3 or o.cells % 2 == 0 or not 0 < o.depth <= 1.5:
        parser.error(f"--cells {o.cells}: must be odd and >= 3; --depth {o.depth:g}: must be in (0, 1.5]")
    if o.steps is not None and (o.steps < 1 or not 1 <= o.box <= 32):
        parser.error(f"--steps {o.steps}: must be >= 1; --box {o.box:g}: must be in [1, 32]")
    if not 0 <= o.viscosity <= 1:
        parser.error(f"--viscosity {o.viscosity:g}: must be in [0, 1]")
    if o.speed is not None and not 0 <= o.speed < 1:
        parser.error(f"--speed {o.speed:g}: must be in [0, 1)")
    only = o.box, o.method, o.viscosity, o.explicit_friction, o.speed
    if o.steps is None and only != (BOX[0], methods[0], 0.0, False, None):
        parser.error("--box, --method, --viscosity, --explicit-friction, --speed: must go with --steps")
    if o.steps is None and not o.square:
        parser.refuse_processes(" without --steps or --square")
    with common.results(o) as out:
        if o.square:
            for shape, cells in (("square", o.cells), ("circle", 2 * o.cells - 1)):
                out |= {f"{how} {shape}": bearing(shape, how, cells) for how in KNOWN[shape]}
            return out
        if o.graded:
            out |= of_many_sizes(o.cells, o.out)
            return out
        if o.steps is not None:
            out |= effort(o.cells, o.depth, o.steps, o.box, o.method, o.viscosity, o.explicit_friction, o.speed)
            return out
        stiff = {(how, cells): limit_load(how, cells) for how in LIMITS_OF for cells in (o.cells, 2 * o.cells - 1)}
        out["errors"] = errors(stiff)
        runs = {}
        for name, rate in RATES.items():
            runs[name] = push(SOIL, o.cells, o.depth, rate, rest=10.0 if name == "intermediate" else 0.0)
        out |= report(runs) | {"twice_the_box": twice_the_box(min(o.cells, COARSE), o.depth)}
        draw(o.out, runs, stiff)
        animate(o.out, runs["intermediate"])
    return out


def of_many_sizes(cells: int, folder: Path) -> dict:
    """Compare undrained limit loads: on graded cells in a large box, and on equal cells in a small box.

    Returns the load, the number of points and the processor time (s) for both boxes, and their ratios.
    """
    out, runs = {}, {}
    for how, box in FAR.items():
        began = time.process_time()
        runs[how] = run = limit_load("undrained", cells, box, graded=how == "graded")
        seconds = time.process_time() - began
        out[how] = {"error": run.load[-1] - 1, "points": run.results[0].points, "cpu": seconds}
        print(f"{how:>7} cells, box of {2 * box[0]:g} B x {box[1]:g} B: limit load {run.load[-1] - 1:+.2%}, ", end="")
        print(f"{out[how]['points']} points, {run.total('newton')} Newton steps, {seconds:.0f} s of processor time")
    out["load"] = runs["graded"].load[-1] / runs["equal"].load[-1] - 1
    out["time"] = out["graded"]["cpu"] / out["equal"]["cpu"]
    print(f"graded over equal: load {out['load']:+.2%}, time {out['time']:.2f}")
    seconds = []
    for graded in (False, True):
        began = time.process_time()
        limit_load("undrained", cells, FAR["graded"], graded, steps=1)
        seconds.append(time.process_time() - began)
    out["first"] = seconds[0] / seconds[1]
    print(f"first step in the large box: equal cells take {out['first']:.0f} times as long as graded cells")
    fig, axes = common.figure(1, 2, (12, 4.6))
    for ax, (how, run) in zip(axes[0], runs.items(), strict=True):
        draw_cells(ax, run.frames[-1])
        ax.set_title(f"{how} cells: limit load {run.load[-1] - 1:+.1%}")
    common.save(fig, folder / "footing_graded.png", dpi=90)
    return out


def draw_cells(ax, frame: Frame) -> None:
    """Draw the particle domains, coloured by pore pressure divided by c."""
    from matplotlib.collections import PolyCollection

    corners, p = frame.corners[:, [0, 1, 3, 2]], frame.pressure / COHESION
    quads = PolyCollection(corners, array=p, cmap="viridis", clim=(0, np.quantile(p, 0.99)))
    quads.set(edgecolors="face", linewidth=0.3, snap=False)  # black lines alternate with the pixels
    ax.add_collection(quads)
    ax.autoscale()
    block(ax, frame)
    ax.set(xlim=(0, 10), ylim=(-10, 0.7), ylabel="y / B (-)")
    ax.figure.colorbar(quads, ax=ax, label="pore pressure / c (-)", shrink=0.8, extend="both")


def viscous(viscosity: float, seconds: float) -> mpm.DruckerPrager:
    """Return the soil with a viscosity: the product of `viscosity`, the cohesion and the duration of a push."""
    if viscosity == 0:
        return SOIL
    own = OF_SOIL | {"residual": COHESION, "slip": WIDTH}  # no softening
    return mpm.SofteningDruckerPrager(**own, viscosity=viscosity * COHESION * seconds)


def effort(
    cells: int,
    depth: float,
    steps: int,
    width: float,
    method: str,
    viscosity: float = 0.0,
    explicit: bool = False,
    speed: float | None = None,
) -> dict:
    """Push in equal steps, and print and return load, numbers of steps, and processor time.

    width: width of the computed half of the soil, divided by B.
    speed: see `push`; the soil is then dry. With None, saturated soil is pushed at the intermediate rate.
    """
    began, rate = time.process_time(), RATES["intermediate"]
    soil = ExplicitFriction(**OF_SOIL) if explicit else viscous(viscosity, depth * WIDTH**2 / (CV * rate))
    how = {"rate": rate} if speed is None else {"rate": None, "speed": speed}
    run = push(soil, cells, depth, **how, box=(width, BOX[1]), steps=steps, method=method)
    found = {"points": run.results[0].points, "asked": steps, "load": run.load[-1]}
    found |= {count: run.total(count) for count in ("steps", "cuts", "newton")} | {"cpu": time.process_time() - began}
    if not common.first():
        return found
    print(
        f"{cells} cells over the width, {found['points']} points, pushed by {depth:g} B in {steps} steps: q/c "
        f"{found['load']:.2f}, {found['steps']} steps taken, {found['cuts']} cut, {found['newton']} Newton steps, "
        f"{found['cpu']:.0f} s of processor time"
    )
    return found


def errors(stiff: dict[tuple[str, int], Push]) -> dict[str, float]:
    """Print and return the relative errors of the limit loads of stiff soil."""
    out = {}
    for (how, cells), run in stiff.items():
        out[f"{how}_{cells}"] = run.load[-1] - 1
        rise = run.load[-1] / run.load[3 * len(run.load) // 4] - 1
        print(f"{how:>9} limit load, {cells:>2} cells over the width: {out[f'{how}_{cells}']:+.1%}, ", end="")
        print(f"{rise:+.2%} in the last quarter of the push")
    return out


def twice_the_box(cells: int, depth: float) -> dict[str, float]:
    """Print and return, for each rate, the largest change of the load in a box twice as wide as `BOX`."""
    out = {}
    for name, rate in RATES.items():
        near, far = (push(SOIL, cells, depth, rate, box=(wide * BOX[0], BOX[1])) for wide in (1, 2))
        change = np.interp(near.settlement, far.settlement, far.load)[1:] / near.load[1:] - 1
        worst = np.abs(change).argmax()
        out[name] = float(change[worst])
        where = f"{change[worst]:+.2%} at {near.settlement[1 + worst]:.2f} widths, {change[-1]:+.2%} at the end"
        print(f"a box twice as wide, {cells} cells over the width, {name}: load at most {where}")
    return out


def report(runs: dict[str, Push]) -> dict:
    """Print and return the results of the pushes at three rates."""
    out = {}
    for name, run in runs.items():
        out[name] = found = {
            "load": run.load[run.pushed],
            "load_at_rest": run.load[-1],
            "pressure": float(run.at_end.pressure.max() / COHESION),
            "heave": float(run.at_end.top[:, 1].max() / WIDTH),
            "balance": max(result.balance for result in run.results),
            **{count: run.total(count) for count in ("steps", "cuts", "newton", "reinitialised", "wall")},
        }
        print(
            f"{name:>12}, V = {RATES[name]:<5g}: q/c {found['load']:.2f}, p up to {found['pressure']:.2g} c, "
            f"heave {found['heave']:.2f} B, fluid balance {found['balance']:.0e}, {found['steps']} steps, "
            f"{found['cuts']} cuts, {found['reinitialised']} inverted domains, {found['wall']:.0f} s"
        )
    at_rest, depth = runs["intermediate"], runs["fast"].settlement[-1]
    left = np.abs(at_rest.frames[-1].pressure).max() / COHESION
    out["fast_over_embedded"] = out["fast"]["load"] / embedded(depth) - 1
    print(f"consolidated after the intermediate push: q/c {at_rest.load[-1]:.2f}, p down to {left:.2g} c")
    print(f"fast push over the undrained limit at its depth, {embedded(depth):.2f} c: {out['fast_over_embedded']:+.1%}")
    print("theory at the surface: " + ", ".join(f"{name} {value:.2f} c" for name, value in SURFACE.items()))
    return out


def view(ax, pair: tuple[Frame, Frame], limits: tuple[float, float]):
    """Draw the footing with the pore pressures of two frames, one on each side."""
    from matplotlib.collections import PolyCollection

    for sign, frame in zip((-1, 1), pair, strict=True):
        corners = frame.corners[:, [0, 1, 3, 2]] * [sign, 1]
        quads = PolyCollection(corners, array=frame.pressure / COHESION, cmap="viridis", clim=limits)
        quads.set(edgecolors="face", linewidth=0.1)
        ax.add_collection(quads)
    block(ax, pair[0])
    ax.set(xlim=(-2.5, 2.5), ylim=(-2.2, 0.6), ylabel="y / B (-)")
    return quads


def block(ax, frame: Frame) -> None:
    """Draw the footing and the initial surface of the soil."""
    from matplotlib.patches import Rectangle

    place = (-WIDTH / 2, -frame.settlement * WIDTH)
    ax.add_patch(Rectangle(place, WIDTH, 0.5 * WIDTH, facecolor="0.75", edgecolor="black", lw=0.8, zorder=3))
    ax.axhline(0, color="grey", lw=0.6, ls=":")
    ax.set(aspect="equal", xlabel="x / B (-)")


def scale(run: Push) -> tuple[float, float]:
    """Return the limits of the colour scale for the pressures of a push, divided by c."""
    return 0.0, max(float(np.quantile(frame.pressure, 0.99)) for frame in run.frames) / COHESION


def draw(out: Path, runs: dict[str, Push], stiff: dict[tuple[str, int], Push]) -> None:
    """Draw pressures, loads, the soil's surface, and the limit loads of stiff soil."""
    fig, ((soil, curve), (surface, limit)) = common.figure(2, 2, (12, 7.5))
    run = runs["intermediate"]
    quads = view(soil, (run.at_end, run.frames[-1]), scale(run))
    fig.colorbar(quads, ax=soil, label="pore pressure / c (-)", shrink=0.8, extend="both")
    soil.axvline(0, color="white", lw=0.8)
    soil.set_title("Intermediate push: at its end (left), consolidated (right)")
    draw_loads(curve, runs)
    for (name, each), colour in zip(runs.items(), COLOURS, strict=True):
        x, y = each.at_end.top.T
        for sign in (-1, 1):
            surface.plot(sign * x, y, color=colour, lw=1.2, label=f"{name} push" if sign > 0 else None)
    block(surface, run.at_end)
    surface.set(xlim=(-4 * WIDTH, 4 * WIDTH), ylim=(None, 0.7), aspect="auto", ylabel="y / B (-)")
    surface.set_title("Surface at the end of the push")
    surface.legend(fontsize=8, loc="upper left", ncol=3)
    for (how, cells), each in stiff.items():
        fine = cells == max(c for _, c in stiff)
        style = {
            "color": COLOURS[list(LIMITS_OF).index(how)],
            "lw": 1.5 if fine else 0.8,
            "ls": "-" if fine else "--",
        }
        label = f"{how}, {cells} cells over the width: {each.load[-1] - 1:+.1%}"
        limit.plot(np.array(each.settlement) / each.settlement[-1], each.load, label=label, **style)
    limit.axhline(1, color="black", lw=0.8, ls=":")
    limit.set(xlabel="settlement / final settlement (-)", ylabel="load / theory (-)", xlim=(0, 1), ylim=(0, 1.15))
    limit.set_title("Very stiff soil: load / theoretical limit load")
    limit.legend(fontsize=8, loc="lower right")
    limit.grid(alpha=0.3)
    common.save(fig, out / "footing.png", dpi=90)


def draw_loads(ax, runs: dict[str, Push]) -> None:
    """Draw load against settlement at all rates, with the theoretical limit loads."""
    for (name, each), colour in zip(runs.items(), COLOURS, strict=True):
        upto = each.pushed + 1
        ax.plot(each.settlement[:upto], each.load[:upto], color=colour, label=f"{name}, V = {RATES[name]:g}")
        if len(each.load) > upto:
            ends = [each.load[each.pushed], each.load[-1]]
            ax.plot([each.settlement[-1]] * 2, ends, "o-", ms=4, color=colour, mfc="white", label="then at rest")
    depth = np.array(runs["fast"].settlement)
    ax.plot(depth, embedded(depth), color="black", lw=0.8, ls=":", label="undrained limit at this depth")
    for name, value in SURFACE.items():
        ax.axhline(value, color="black", lw=0.8, ls="--")
        place = {"xytext": (0, -3), "textcoords": "offset points", "ha": "right", "va": "top", "fontsize": 8}
        ax.annotate(f"{name} limit at the surface: {value:.2f}", (depth[-1], value), **place)
    ax.set(xlabel="settlement / B (-)", ylabel="load / (B c) (-)", title="Load; V = velocity · B / c_v")
    ax.set(xlim=(0, 1.02 * depth[-1]), ylim=(0, None))
    ax.legend(fontsize=8, loc="lower right", ncol=2)
    ax.grid(alpha=0.3)


def animate(out: Path, run: Push) -> None:
    """Draw the push and the consolidation as an animation."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    fig, ((ax,),) = common.figure(1, 1, (6.4, 3.9))
    quads = view(ax, (run.frames[0], run.frames[0]), scale(run))
    fig.colorbar(quads, ax=ax, label="pore pressure / c (-)", shrink=0.8, extend="both")
    ax.set_title(" ")
    fig.canvas.draw()
    fig.set_layout_engine("none")  # laid out once

    def show(k: int) -> None:
        ax.clear()
        frame = run.frames[k]
        view(ax, (frame, frame), scale(run))
        ax.set_title(f"pushed, w / B = {frame.settlement:.2f}" if frame.t <= 1 else "at rest: the soil consolidates")

    chosen = np.unique(np.linspace(0, len(run.frames) - 1, 40, dtype=int))
    FuncAnimation(fig, show, frames=chosen).save(out / "footing.gif", PillowWriter(fps=6), dpi=70)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
