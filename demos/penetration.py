# SPDX-License-Identifier: MIT
"""A T-bar, which is a rigid cylinder, is pushed through clay, normal to its axis and deep below the surface.

The clay is undrained, and follows von Mises's law with the plane-strain strength s_u. F is the force per length of the
bar, and D is its diameter. The bar starts inside the clay and is pushed until the clay flows all around it. The
resistance N of a bar with the adhesion alpha s_u on its surface is then (Randolph and Houlsby 1984)

    N = F / (s_u D) = pi + 2 asin(alpha) + 4 cos(pi/4 - asin(alpha)/2) (sqrt(2) + sin(pi/4 - asin(alpha)/2)).

The clay is a block, eight diameters wide and high, between smooth walls. Half of the block is computed. A pressure on
the top keeps the gap behind the bar closed. In a narrower block the resistance is lower.

Clay that flows around the bar stretches by a factor of about e^4 for each diameter of depth. New domains therefore
replace domains longer than a cell (`renewal`). Errors refer to the mean of N over the last quarter of a diameter.
`spread` is the range of N over this distance, divided by the mean.

A smooth bar is also pushed through saturated ("wet") clay by one diameter, at three rates V. The rate is
`V = v D / c_v`, with the velocity v and the coefficient of consolidation c_v. Water exerts the pressure on the top, so
the clay starts without effective stress.

With --follow the bar is pushed once more, on grid lines that follow the bar. The number of cells does not change.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np

import mpm_dolfinx as mpm

D, HALF = 1.0, 4.0  # m: diameter, half of the width and of the height of the block
FINE = 0.3  # size of the points' domains at the bar, in cells
STRENGTH, PRESSURE = 1e3, 2e4  # Pa: s_u of the undrained clay, and the pressure on the block
SHEAR = 100 * STRENGTH
ROUGH = (0.0, 0.5, 1.0)
WALLS = {"left": "x", "right": "x", "bottom": "y"}
STEADY = 0.25  # last part of the depth in which N is used, in diameters
STEP, WET_STEP = 1 / 12, 1 / 18  # motion of the bar in a step, in cell sizes: dry and wet clay
CLAY = mpm.DruckerPrager(2 * SHEAR, SHEAR, friction=0.0, dilation=0.0, cohesion=STRENGTH, conductivity=1e-9)
WATER = mpm.Fluid()
CV = CLAY.conductivity / WATER.unit_weight * CLAY.oedometric  # m²/s
RATES = {"fast": 1000.0, "intermediate": 1.0, "slow": 1e-2}  # V
SETTLED = 1e-3  # time in which the pressure is applied, divided by the time of the push
BALANCE = 1e-8  # allowed relative error of the fluid balance
FINE_ZONE, RATIO = 1.0, 1.3  # m: region of small cells around the bar; ratio of cell sizes outside this region


def exact(alpha: float) -> float:
    """Return the resistance N of Randolph and Houlsby for the roughness alpha."""
    delta = np.arcsin(alpha)
    half = np.pi / 4 - delta / 2
    return np.pi + 2 * delta + 4 * np.cos(half) * (np.sqrt(2) + np.sin(half))


def clay(cells: int, y: float = 0.0, follow: mpm.Tool | None = None) -> tuple:
    """Return the grid, half of the block around a bar at the height y (m), and the region of the block's top.

    cells: number of cells over the diameter.
    follow: bar that grid lines follow, or None.
    """
    h = D / cells
    n = round(HALF * cells)
    even = grid = mpm.Grid([0, -HALF], [HALF, HALF + 4 * h], [n, 2 * n + 4])
    if follow is not None:
        zone = [[0, y - FINE_ZONE], [FINE_ZONE, y + FINE_ZONE]]
        grid = mpm.Grid(lines=mpm.graded(even.lower, even.upper, [zone], h, RATIO), follow=follow)
    around, outward = 4 * round(np.pi * D / 2 / (FINE * h) / 4), round(np.log(2 * HALF / D) * D / 2 / (FINE * h))
    corners = [0, np.arctan2(HALF, HALF + y), np.pi - np.arctan2(HALF, HALF - y), np.pi]
    at = np.interp(np.linspace(0, np.pi, around + 1), np.pi * np.array([0, 1, 3, 4]) / 4, corners)
    size = np.array([outward, len(at) - 1]) * h / 2

    top = ((0, size[1] - around / 4 * h / 2 - HALF), tuple(size))

    def ring(X: np.ndarray) -> np.ndarray:  # from the bar to the sides of the block, with increasing size
        angle = np.interp((X[:, 1] + HALF) / (h / 2), np.arange(len(at)), at)
        e = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
        reach = 1 / np.maximum(e[:, 0] / HALF, np.abs(e[:, 1]) / np.where(e[:, 1] > 0, HALF - y, HALF + y))
        return e * (D / 2 * (2 * reach / D) ** (X[:, 0] / size[0]))[:, None] + [0, y]

    return grid, mpm.mapped(grid, mpm.box(even, [0, -HALF], size - [0, HALF]), ring), top


@dataclass
class Push:
    """Results of a push.

    depth: depth divided by D, for each step.
    N: resistance, for each step.
    excess: excess pressure divided by s_u, for each step.
    steady: whether a step counts in the error of N.
    frame: final corners (n, 4, 2) in m, the values (n,) to draw, and the shape of the bar (k, 4, 2) in m.
    lines: final grid lines along both axes, in m.
    """

    depth: list[float] = field(default_factory=list)
    N: list[float] = field(default_factory=list)
    steady: list[bool] = field(default_factory=list)
    excess: list[float] = field(default_factory=list)
    frame: tuple = ()
    lines: tuple = ()
    steps: int = 0
    cuts: int = 0
    balance: float = 0.0


def push(alpha: float, cells: int, depth: float, follow: bool = False) -> Push:
    """Load the clay, then push a bar of roughness alpha by `depth` diameters."""
    y, begin, out = depth * D / 2, 1.0, Push()
    soil = mpm.DruckerPrager(bulk=50 * SHEAR, shear=SHEAR, friction=0.0, dilation=0.0, cohesion=STRENGTH)
    bar = mpm.Tool(mpm.Ball((0, y), D / 2), lambda t: (0, -D * max(0, t - begin)), adhesion=alpha * STRENGTH)
    grid, body, top = clay(cells, y=y, follow=bar if follow else None)
    load = mpm.Pressure("right", lambda t: PRESSURE * min(1, t / begin), region=top)
    numerics = mpm.Numerics(renewal=True)
    simulation = mpm.Simulation(grid, [body], [soil], walls=WALLS, conditions=[load, bar], numerics=numerics)
    simulation.run(begin, begin, progress=False)

    def see(s: mpm.Simulation) -> None:
        out.depth.append(s.t - begin)
        out.N.append(-2 * float(s.tool_forces["tool"][1]) / STRENGTH / D)
        out.steady.append(s.t - begin > depth - STEADY)

    result = simulation.run(begin + depth, depth / max(2, round(depth * cells / STEP)), observe=see, progress=False)
    points, drawn = simulation.points, bar.drawn(grid, simulation.t)
    out.frame = points.corners, np.linalg.norm(points.displacement, axis=1) / (depth * D), drawn
    out.lines = tuple(x + start for x, start in zip(simulation.grid.lines, simulation.grid.base, strict=True))
    out.steps, out.cuts = result.steps, result.cuts
    return out


def push_wet(rate: float, cells: int, depth: float) -> Push:
    """Push a smooth bar by `depth` diameters into wet clay, at the rate V = `rate`."""
    grid, body, top = clay(cells)
    speed = rate * CV / D  # m/s
    start, end = SETTLED * depth * D / speed, (1 + SETTLED) * depth * D / speed
    bar = mpm.Tool(mpm.Ball((0, 0), D / 2), lambda t: (0, -speed * max(0, t - start)))

    def pressure(t: float) -> float:
        return PRESSURE * min(1, t / start)

    acting = [mpm.Pressure("right", pressure, region=top), bar, mpm.Drained("right", pressure, region=top)]
    given = {"walls": WALLS, "conditions": acting, "fluid": WATER, "numerics": mpm.Numerics(renewal=True)}
    simulation = mpm.Simulation(grid, [body], [CLAY], **given)
    simulation.run(start, start, progress=False)
    out = Push()

    def see(s: mpm.Simulation) -> None:
        gone = speed * max(0, s.t - start)
        out.depth.append(gone / D)
        out.N.append(-2 * float(s.tool_forces["tool"][1]) / STRENGTH / D)
        x = s.points.x + np.array([0, gone])
        front = (np.linalg.norm(x, axis=1) < D / 2 + grid.h[0] / 2) & (-x[:, 1] > x[:, 0])
        volume = s.points.volume0[front]
        out.excess.append(float(volume @ (s.points.pressure[front] - PRESSURE) / volume.sum() / STRENGTH))

    result = simulation.run(end, (end - start) / max(2, round(depth * cells / WET_STEP)), observe=see, progress=False)
    points = simulation.points
    out.frame = points.corners, (points.pressure - PRESSURE) / STRENGTH, bar.drawn(grid, simulation.t)
    out.steps, out.cuts, out.balance = result.steps, result.cuts, result.balance
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=8, help="cells over the diameter")
    parser.add_argument("--rough", nargs="*", type=float, default=list(ROUGH), help="roughnesses alpha of the bar")
    parser.add_argument("--depth", type=float, default=1.0, help="depth of each push, divided by the diameter")
    parser.add_argument("--wet-cells", type=int, default=4, help="cells over the diameter in saturated clay")
    parser.add_argument("--wet-depth", type=float, default=1.0, help="depth in saturated clay, divided by the diameter")
    parser.add_argument("--follow", action="store_true", help="push the last bar again, on grid lines that follow it")
    o = parser.parse_args(argv)
    if not 4 <= o.cells <= 32 or not 0 < o.depth <= 4 or any(not 0 <= alpha <= 1 for alpha in o.rough):
        cells, depth = f"--cells {o.cells}: must be 4 to 32", f"--depth {o.depth}: must be in (0, 4]"
        parser.error(f"{cells}; {depth}; --rough {o.rough}: must be in [0, 1]")
    if not 4 <= o.wet_cells <= 32 or not 0 < o.wet_depth <= 1:
        parser.error(f"--wet-cells {o.wet_cells}: must be 4 to 32; --wet-depth {o.wet_depth}: must be in (0, 1]")
    runs = {}
    with common.results(o) as out:
        out |= {"errors": {}, "cuts": 0, "steps": 0}
        for alpha in o.rough:
            run = runs[alpha] = push(alpha, o.cells, o.depth)
            last = np.array(run.N)[run.steady]
            out["errors"][f"alpha {alpha:g}"] = float(last.mean() / exact(alpha) - 1)
            out[f"spread {alpha:g}"] = float(np.ptp(last) / last.mean())
            out["cuts"], out["steps"] = out["cuts"] + run.cuts, out["steps"] + run.steps
            found = f"alpha = {alpha:g}: N = {last.mean():.3f}, {last.min():.3f} to {last.max():.3f}"
            print(f"{found}, exact {exact(alpha):.3f}; {run.cuts} of {run.steps} steps cut", flush=True)
        if o.follow and runs:
            out["follow"] = following(o, *list(runs.items())[-1])
        wet = {name: push_wet(rate, o.wet_cells, o.wet_depth) for name, rate in RATES.items()}
        for name, run in wet.items():
            out[name] = {"N": run.N[-1], "excess": run.excess[-1], "steps": run.steps, "cuts": run.cuts}
            found = f"V = {RATES[name]:g}: N = {run.N[-1]:.2f}, excess pressure ahead {run.excess[-1]:.2f} s_u"
            print(f"{found}; {run.cuts} of {run.steps} steps cut, fluid balance {run.balance:.1e}", flush=True)
        out["balance"] = max(run.balance for run in wet.values())
        draw(o, runs, wet)
        most = max(run.cuts / run.steps for run in wet.values())
        out["converged"] = max(most, out["cuts"] / max(1, out["steps"])) <= 0.1 and out["balance"] <= BALANCE
    return out


def following(o: Namespace, alpha: float, equal: Push) -> dict[str, float]:
    """Push a bar on grid lines that follow it, and compare resistance and number of cells with a run on equal cells."""
    run = push(alpha, o.cells, o.depth, follow=True)
    N, beside = (np.array(each.N)[each.steady].mean() for each in (run, equal))
    count, whole = (np.prod([len(x) - 1 for x in each.lines]) for each in (run, equal))
    found = f"alpha = {alpha:g}, lines that follow: N = {N:.3f} in {count} cells, {beside:.3f} in {whole} equal cells"
    print(f"{found}; {run.cuts} of {run.steps} steps cut", flush=True)
    fig, grid = common.figure(1, 2, (12, 7))
    axes = grid.ravel()
    for each, name in ((equal, f"{whole} equal cells"), (run, f"{count} cells that follow")):
        axes[0].plot(each.depth, each.N, label=name)
    axes[0].axhline(exact(alpha), color="k", ls="--", lw=0.8)
    axes[0].set(xlabel="depth / D (-)", ylabel="F / (s_u D) (-)", title="dashed: exact", ylim=(0, None))
    axes[0].legend(fontsize=9)
    show(axes[1], run, "displacement / that of the bar (-)", f"lines that follow, α = {alpha:g}", (0, 1))
    x, y = run.lines
    axes[1].vlines(x, y[0], y[-1], color="k", lw=0.4)
    axes[1].hlines(y, x[0], x[-1], color="k", lw=0.4)
    axes[1].set(xlim=(0, HALF), ylim=(-HALF, HALF))
    common.save(fig, o.out / "lines.png", dpi=80)
    return {"load": float(N / beside - 1), "cells": float(count / whole)}


def draw(o: Namespace, runs: dict[float, Push], wet: dict[str, Push]) -> None:
    """Draw resistances, displacements of the clay, and pore pressures in wet clay."""
    fig, axes = common.figure(2, 4, (17, 8.5))
    for k, (alpha, run) in enumerate(runs.items()):
        axes[0, 0].plot(run.depth, run.N, color=f"C{k}", label=f"α = {alpha:g}")
        axes[0, 0].axhline(exact(alpha), color=f"C{k}", ls="--", lw=0.8)
    title = "undrained clay; dashed: exact"
    axes[0, 0].set(ylabel="F / (s_u D) (-)", title=title, ylim=(0, None))
    for ax, alpha in zip(axes[0, 1:3], [*list(runs)[:1], *list(runs)[-1:]], strict=False):
        title = f"undrained clay, α = {alpha:g}"
        show(ax, runs[alpha], "displacement / that of the bar (-)", title, (0, 1))
    for name, run in wet.items():
        axes[0, 3].plot(run.depth, run.N, label=f"V = {RATES[name]:g}")
        axes[1, 0].plot(run.depth, run.excess, label=f"V = {RATES[name]:g}")
    most = max(np.abs(run.frame[1]).max() for run in wet.values())
    for ax, (name, run) in zip(axes[1, 1:], wet.items(), strict=True):
        show(ax, run, "excess pore pressure / s_u (-)", f"{name}, V = v D / c_v = {RATES[name]:g}", (-most, most))
    axes[0, 3].set(ylabel="F / (s_u D) (-)", title="Saturated clay, smooth bar, three rates V", ylim=(0, None))
    axes[1, 0].set(ylabel="excess pore pressure / s_u (-)", title="Saturated clay, ahead of the bar")
    for ax in (axes[0, 0], axes[0, 3], axes[1, 0]):
        ax.set_xlabel("depth / D (-)")
        ax.legend(fontsize=9)
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "penetration.png", dpi=80)


def show(ax, run: Push, label: str, title: str, clim: tuple[float, float]) -> None:
    """Draw the final state of a push."""
    corners, values, bar = run.frame
    domains = common.domains(ax, corners, values, cmap="viridis" if clim[0] == 0 else "RdBu_r", clim=clim)
    common.domains(ax, bar, facecolor="0.6", edgecolor="0.6")
    ax.set(aspect="equal", xlim=(0, 2), ylim=(-2.5, 2), xlabel="x (m)", ylabel="y (m)", title=title)
    ax.figure.colorbar(domains, ax=ax, label=label, shrink=0.8)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
