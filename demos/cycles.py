# SPDX-License-Identifier: MIT
"""Residual stress of an elastic body after load cycles and after a rotation by 360 degrees.

The drained beam of `poroelastic_beam.py` is loaded and unloaded repeatedly. The beam is elastic, so its stress must
vanish after unloading. Grid displacements have kinks at grid lines. If particle domains followed these kinks, stress
would accumulate at every grid line that a domain crosses, as in standard MPM.

A block is stretched between two fixed sides and then rotated by 360 degrees. The stresses after and before the rotation
must be equal.

The undrained beam has singular edges at the clamp. At a distance r from an edge the stress grows as `r^(x - 1)`, where
x = 0.595 is the root of `cos(pi x / 2) = x` (Williams 1952). Near the edges the residual stress therefore decreases
with the cell size h as h^x. Results are given for the whole beam, far from the clamp, near the clamp, and with springs
instead of the clamp.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace

import common
import numpy as np
import poroelastic_beam as beam

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

STRETCH = 0.1  # stretch of the block before its rotation
BLOCK = 1.0  # m
AWAY = 0.1  # m: distance from the wall beyond which the singular edges have no influence
SPRINGS = 5e7  # Pa/m: springs without singularity in place of the clamp, as stiff as a third of the beam's length
COLORS = ("C1", "C0", "C2", "C4", "C5")  # one colour for each cell size


def options(h: float, load: float, quadrature: str = "domain") -> Namespace:
    """Return the options of `poroelastic_beam.py` for a drained run."""
    return beam.arguments(f"--drained --h {h} --load {load} --quadrature {quadrature}".split())


def conditions(o: Namespace) -> dict:
    """Return the beam's conditions, with a load that rises and falls once in a second."""
    region = ((beam.CLAMP, -np.inf), (beam.LENGTH, np.inf))
    load = mpm.Traction("top", lambda t: (0.0, -o.load * (1 - abs(2 * (t % 1) - 1))), region=region)
    return {"walls": {"left": "xy"}, "conditions": [load]}


def rms(simulation: mpm.Simulation, away: float = 0.0) -> float:
    """Return the rms stress of the points (Pa); points closer than `away` (m) to the wall count as stress-free."""
    stress, volume = simulation.effective_stress(), simulation.points.volume0
    counts = simulation.points.reference.mean(axis=1)[:, 0] > away
    squares = (volume * counts * (stress**2).sum(axis=(1, 2))).sum()
    total = simulation.grid.comm.allreduce(np.array([squares, volume.sum()]))
    return float(np.sqrt(total[0] / total[1]))


def cycle(
    h: float,
    load: float,
    cycles: int,
    steps: int,
    quadrature: str = "domain",
    material=None,
    seed: Callable = mpm.box,
    fluid: mpm.Fluid | None = None,
    springs: float = 0.0,
) -> dict:
    """Load and unload the beam, and return the residual stress and the motion.

    h: cell size, in m.
    load: largest load, in Pa.
    steps: number of steps in a cycle, even.
    quadrature: quadrature rule, see `mpm.Numerics`.
    seed: function that returns the body, such as `mpm.box`.
    fluid: pore fluid of an undrained beam, or None.
    springs: largest stiffness (Pa/m) of springs that support the beam in place of the clamp. The stiffness decreases
    to zero at the edges of the wall, so that no stress is singular.

    Returns these values by name:
    left: rms stress after each cycle, divided by the rms stress at the first peak.
    away: rms stress after each cycle without points near the wall, divided by the rms stress at the first peak.
    times, tips: time (s) and tip deflection (m) of each step.
    lost: work of the load in each cycle, divided by the work up to the first peak.
    volume: difference between the volume changes of the beam and of its water, divided by the volume of the beam.
    balance: error of the fluid balance.
    """
    o = options(h, load, quadrature)
    cells = np.rint(beam.BOX / h).astype(int)
    grid = mpm.Grid([0, 0], beam.BOX, cells)
    bottom = (round(0.5 * beam.BOX[1] / h) + o.offset) * grid.h[1]
    body = seed(grid, [0, bottom], [beam.LENGTH, bottom + beam.HEIGHT], o.points_per_cell)
    given = {"numerics": mpm.Numerics(quadrature=quadrature), "fluid": fluid, **conditions(o)}
    if springs:

        def held_up(points, u):
            y = (points.position[1] - points.displacement[1] - bottom) / beam.HEIGHT
            return springs * 2 * y * (1 - y) * (points.displacement[1] + points.value(u)[1]) ** 2 * points.dx

        given |= {"walls": {"left": "x"}, "terms": [mpm.OnSide("left", held_up)]}
    simulation = mpm.Simulation(grid, [body], [material or beam.material(o)], **given)
    loaded = np.linspace(beam.CLAMP, beam.LENGTH, 201)[:-1] + (beam.LENGTH - beam.CLAMP) / 400
    places = [[beam.LENGTH, bottom + beam.HEIGHT / 2], *([x, bottom + beam.HEIGHT] for x in loaded)]
    stress = [(0.0, 0.0)]

    def observe(s: mpm.Simulation) -> None:
        looks = round(s.t * steps) % steps in (0, steps // 2)
        stress.append((rms(s), rms(s, AWAY)) if looks else (np.nan, np.nan))

    try:
        result = simulation.run(float(cycles), 1 / steps, probes=mpm.probes([body], places), observe=observe)
    except mpm.GaveUp as error:
        print(f"{quadrature}, h = {h:g} m: {error}", file=sys.stderr)
        result = error.result
    times = np.array(result.t)
    u, force = np.array(result.displacement)[:, :, 1], 1 - np.abs(2 * (times % 1) - 1)
    work = -load * (force[1:] + force[:-1]) / 2 * np.diff(u[:, 1:].mean(axis=1))
    done = (len(times) - 1) // steps
    lost = work[: done * steps].reshape(done, steps).sum(axis=1) / work[: steps // 2].sum()
    points, water = simulation.points, fluid and (material or beam.material(o)).porosity / fluid.bulk
    gained = points.J - 1 + water * points.pressure if fluid else points.J - 1
    left, away = (np.array(stress)[steps::steps] / stress[steps // 2][0]).T if done else np.zeros((2, 0))
    return {
        "left": left,
        "away": away,
        "times": times,
        "tips": u[:, 0],
        "lost": lost,
        "force": load * force,
        "cuts": result.cuts,
        "volume": float(points.volume0 @ gained / points.volume0.sum()),
        "balance": result.balance,
    }


def turn(h: float, nu: float = 0.3, steps: int = 90, fluid: mpm.Fluid | None = None) -> float:
    """Rotate the stretched block by 360 degrees, and return the relative rms change of the total stress in its middle.

    With a fluid the block is undrained.
    """
    cells = round(1.8 * BLOCK / h)
    grid = mpm.Grid([0] * 2, [cells * h] * 2, [cells] * 2)
    lower = 0.4 * BLOCK + 0.37 * h
    block = mpm.box(grid, [lower] * 2, [lower + BLOCK] * 2)
    centre = lower + BLOCK / 2

    def given(sign: int):
        def displacement(t, X):
            c, s = np.cos(2 * np.pi * max(0.0, t - 1)), np.sin(2 * np.pi * max(0.0, t - 1))
            x = X - centre + [sign * STRETCH / 2 * BLOCK * min(t, 1.0), 0]
            return x @ np.array([[c, s], [-s, c]]) + centre - X

        return displacement

    held = [mpm.Displacement(side, given(sign)) for side, sign in (("left", -1), ("right", 1))]
    law = mpm.Hencky(bulk=1e6 / (3 * (1 - 2 * nu)), shear=1e6 / (2 * (1 + nu)))
    simulation = mpm.Simulation(grid, [block], [law], fluid=fluid, walls={}, conditions=held)
    middle = (np.abs(simulation.points.x - centre) < BLOCK / 4).all(axis=1)

    def stress() -> np.ndarray:
        pressure = simulation.points.pressure if fluid else np.zeros(len(middle))
        return (simulation.effective_stress() - pressure[:, None, None] * np.eye(2))[middle]

    simulation.run(1.0, 0.2)
    before = stress()
    simulation.run(2.0, 1 / steps)
    change = stress() - before
    return float(np.sqrt((change**2).sum() / (before**2).sum()))


def orders(h: list[float], left: list[float]) -> list[float]:
    """Return the orders of convergence of the residual stress, between successive cell sizes."""
    return [float(np.log(a / b) / np.log(c / d)) for a, b, c, d in zip(left, left[1:], h, h[1:], strict=False)]


def reference(o: Namespace) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip deflection (m) by finite elements, and the load (Pa), at each time of a load cycle."""
    case = options(o.h[-1], o.load)
    size = [0, 0], [beam.LENGTH, beam.HEIGHT], beam.REFERENCE_CELLS
    fem = BiotFEM(mpm.Grid(*size), beam.material(case), **conditions(case))
    result = fem.run(1.0, 1 / o.steps, probes=np.array([[beam.LENGTH, beam.HEIGHT / 2]]))
    return np.array(result.displacement)[:, 0, 1], o.load * (1 - np.abs(2 * (np.array(result.t) % 1) - 1))


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument(
        "--h", type=float, nargs="+", default=[0.06, 0.03], help="cell sizes, m; the last is also used for standard MPM"
    )
    parser.add_argument("--load", type=float, default=54e3, help="largest load, Pa")
    parser.add_argument("--cycles", type=int, default=20, help="load cycles")
    parser.add_argument("--steps", type=int, default=10, help="steps in a cycle, even")
    parser.add_argument(
        "--turn",
        type=float,
        nargs="*",
        default=[0.05, 0.025],
        help="cell sizes of the block, m; the last also undrained",
    )
    parser.add_argument("--undrained", type=int, default=20, help="load cycles of the undrained beam; 0: none")
    o = parser.parse_args(argv)
    if not 0 < len(o.h) <= len(COLORS):
        parser.error(f"--h: {len(o.h)} cell sizes, must be 1 to {len(COLORS)}")
    if o.steps < 2 or o.steps % 2 or o.cycles < 1:
        parser.error(f"--steps {o.steps}: must be even and >= 2; --cycles {o.cycles}: must be >= 1")
    with common.results(o) as out:
        runs = {h: cycle(h, o.load, o.cycles, o.steps) for h in o.h}
        points = cycle(o.h[-1], o.load, o.cycles, o.steps, "point")
        fem = reference(o)
        turned = {h: turn(h) for h in o.turn}
        undrained = {h: turn(h, fluid=mpm.Fluid()) for h in o.turn[-1:]}
        sealed = {"material": replace(beam.material(options(o.h[-1], o.load)), conductivity=0.0), "fluid": mpm.Fluid()}
        sizes = o.h if o.undrained > 0 else []
        wet = [cycle(h, o.load, o.undrained, o.steps, **sealed) for h in sizes]
        sprung = [cycle(h, o.load, o.undrained, o.steps, springs=SPRINGS, **sealed) for h in sizes]

        lines = [["", "residual stress / peak", "work lost in a cycle", "drift of the peaks", "tip without load"]]
        rows = {f"h = {h:g} m": run for h, run in runs.items()} | {f"standard MPM, {o.h[-1]:g} m": points}
        for name, run in rows.items():
            peaks, rest = run["tips"][o.steps // 2 :: o.steps], run["tips"][:: o.steps]
            numbers = (run["left"][-1], run["lost"][-1], peaks[-1] / peaks[0] - 1, rest[-1] / peaks[0])
            lines.append([f"{name}, {len(run['left'])} cycles", *(f"{x:.4%}" for x in numbers)])
        common.table(lines)
        series = {"drained": ("left", list(runs.values())), "undrained": ("left", wet), "away": ("away", wet)}
        series["springs"] = ("left", sprung)
        last = {name: [float(run[key][-1]) for run in of if len(run[key])] for name, (key, of) in series.items()}
        last["near"] = np.sqrt(np.square(last["undrained"]) - np.square(last["away"])).tolist()
        order = {name: orders(o.h, left) for name, left in last.items()}
        what = {"drained": f"drained, {o.cycles} cycles", "undrained": f"undrained, {o.undrained} cycles"}
        what |= {"away": "the same without the region at the clamp", "near": "the region at the clamp alone"}
        what["springs"] = "undrained, on springs instead of the clamp"
        for name, left in last.items():
            numbers = ", ".join(f"{x:.4%}" for x in left)
            steps = "; orders of convergence " + ", ".join(f"{x:.2f}" for x in order[name]) if order[name] else ""
            print(f"{what[name]}: residual stress / peak {numbers}{steps}")
        for h, run in zip(sizes, wet, strict=True):
            print(f"undrained, h = {h:g} m: errors of volume {run['volume']:.1e}, fluid balance {run['balance']:.1e}")
        for what, changes in (("", turned), (" undrained", undrained)):
            for h, change in changes.items():
                print(f"rotated by 360 degrees{what}, h = {h:g} m: the stress in the middle changes by {change:.4%}")
        columns = [*(run["left"] for run in runs.values()), points["left"]]
        numbers = ([k + 1, *(c[k] if k < len(c) else "" for c in columns)] for k in range(o.cycles))
        common.write_csv(o.out / "cycles.csv", ["cycle", *(f"left_h_{h:g}" for h in o.h), "left_at_points"], numbers)
        draw(o, runs, points, fem)
        out |= {"left": {f"{h:g}": run["left"].tolist() for h, run in runs.items()}, "points": points["left"].tolist()}
        out |= {"lost": {f"{h:g}": run["lost"].tolist() for h, run in runs.items()}}
        out |= {"turned": {f"{h:g}": change for h, change in turned.items()}}
        out |= {"undrained": {f"{h:g}": change for h, change in undrained.items()}}
        out |= {"last": last, "orders": order}
        out["converged"] = all(len(run["left"]) == o.cycles for run in runs.values())
    return out


def draw(o: Namespace, runs: dict[float, dict], points: dict, fem: tuple[np.ndarray, np.ndarray]) -> None:
    """Draw the residual stress against the cycles, and the tip deflection in the last cycle."""
    fig, ((left, loop),) = common.figure(1, 2, (11, 4.2))
    for (h, run), color in zip(runs.items(), COLORS, strict=False):
        label = f"exact integration, h = {h:g} m"
        left.plot(np.arange(len(run["left"])) + 1, run["left"], "o-", ms=3, color=color, label=label)
    label = f"standard MPM, h = {o.h[-1]:g} m"
    left.plot(np.arange(len(points["left"])) + 1, points["left"], "s--", ms=3, color="C3", label=label)
    left.set(xlabel="cycles", ylabel="rms stress, unloaded / at peak load", xscale="log", yscale="log")
    left.set_title("Residual stress")
    last = runs[o.h[-1]]
    both = ("exact integration", last, "-", COLORS[len(runs) - 1]), ("standard MPM", points, "s--", "C3")
    for name, run, style, color in both:
        end = len(run["left"]) * o.steps
        part = slice(max(0, end - o.steps), end + 1)
        loop.plot(-run["tips"][part], run["force"][part] / 1e3, style, ms=3, color=color, label=name)
    loop.plot(-fem[0], fem[1] / 1e3, "k:", lw=2.5, label="FEM, first cycle")
    loop.set(xlabel="deflection of the tip (m)", ylabel="load (kPa)")
    loop.set_title(f"Load against deflection, cycle {o.cycles}, h = {o.h[-1]:g} m")
    for ax, place in ((left, "best"), (loop, "upper left")):
        ax.legend(loc=place)
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "cycles.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
