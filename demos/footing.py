# SPDX-License-Identifier: MIT
"""A strip footing is pushed into saturated soil, as deep as it is wide: fast, at a middling rate and slowly.

Half of the footing, rough and rigid, is a given displacement of a part of the soil's top; the soil is Drucker
and Prager's with cohesion c, weightless, and drains at its top beside the footing.  v is the rate of the push,
V = v B / c_v its ratio to that of consolidation, B the footing's width.

Bearing capacity (Prandtl 1921): q = (2 + pi) s_u without friction; with friction and associated flow q = c N_c,
N_c = (exp(pi tan phi) tan^2(45 deg + phi/2) - 1) / tan phi.  Both are met by soil so stiff that it flows before
the geometry changes (--cells and twice as fine).  The soil that is pushed deep does not dilate: undrained its
strength is s_u = xi c; drained its capacity lies between that of Davis's (1968) reduced friction and c N_c.
Deeper down the footing carries more than at the surface: it is embedded, and soil heaves beside it.

A node under the footing carries half a cell to either side, so faces are held up to half a cell before its edge.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import poroelastic_beam as beam

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
WATER = mpm.Fluid()
CV = SOIL.conductivity / WATER.unit_weight * SOIL.oedometric  # m²/s
RATES = {"fast": 1000.0, "middling": 1.0, "slow": 1e-3}  # V
STEP = 1 / 28  # of a cell: how far the footing goes in a step
STIFF = 100  # times stiffer is the soil that meets the theory
BOX = (4.0, 2.5)  # width and height of half the soil over B


def capacity(friction: float) -> float:
    """Return Prandtl's N_c of a friction angle (degrees)."""
    t = np.tan(np.radians(friction))
    return 2 + np.pi if t == 0 else (np.exp(np.pi * t) * np.tan(np.pi / 4 + np.radians(friction) / 2) ** 2 - 1) / t


LIMITS = {  # over c; Davis: tan phi* = sin phi of the same strength in plane strain
    "undrained": SOIL.xi * capacity(0.0),
    "drained, Davis": SOIL.xi * capacity(np.degrees(np.arctan(SOIL.eta))),
    "drained, associated": capacity(FRICTION),
}


@dataclass
class Frame:
    """A moment of a push: time over its duration, settlement over B, corners, m, and pressures of the points, Pa."""

    t: float
    settlement: float
    corners: np.ndarray
    pressure: np.ndarray


@dataclass
class Push:
    """A push: settlement over B and load over B c, an entry a step; some frames; the step of its end; its runs."""

    settlement: list[float] = field(default_factory=lambda: [0.0])
    load: list[float] = field(default_factory=lambda: [0.0])
    frames: list[Frame] = field(default_factory=list)
    pushed: int = 0
    results: list[mpm.Result] = field(default_factory=list)

    def total(self, name: str) -> float:
        """Return the sum of a count of `Result`."""
        return sum(getattr(result, name) for result in self.results)

    @property
    def at_end(self) -> Frame:
        """The frame at the end of the push."""
        return next(frame for frame in self.frames if frame.t >= 1 - 1e-9)


def push(
    soil: mpm.DruckerPrager,
    cells: int,
    depth: float,
    rate: float | None,
    *,
    box=BOX,
    rest=0.0,
    steps: int | None = None,
) -> Push:
    """Push the footing.

    Parameters
    ----------
    soil, cells
        The soil, and cells over the footing's width, odd.
    depth
        Depth of the push over B.
    rate
        V; None: without water.
    box
        Width and height of half the soil over B.
    rest
        Time of consolidation after the push, over B²/c_v.
    steps
        Equal steps of the push; by default those of `STEP`.
    """
    h = WIDTH / cells
    columns, rows, air = (round(size * cells) for size in (*box, 0.25 + 0.5 * depth))
    grid = mpm.Grid([columns * h, (rows + air) * h], [columns, rows + air])
    body = mpm.box(grid, [0, 0], [columns * h, rows * h])
    end, edge = (depth * WIDTH**2 / (CV * rate) if rate else 1.0), (WIDTH - h) / 2
    under, beside = ((0, 0), (edge, np.inf)), ((edge, 0), (np.inf, np.inf))
    footing = mpm.Displacement("top", lambda t, X: (0, -depth * WIDTH * min(1, t / end)), region=under)
    water = {"fluid": WATER, "drained": [mpm.Drained("top", region=beside)]} if rate else {}
    fixed = {"left": "x", "right": "x", "bottom": "xy"}
    simulation = mpm.Simulation(grid, [body], [soil], fixed=fixed, displacements=[footing], **water)
    out = Push()

    def observe(s: mpm.Simulation) -> None:
        out.settlement.append(depth * min(1, s.t / end))
        out.load.append(-2 * s.reactions[0, 1] / (WIDTH * COHESION))
        if len(out.load) % 5 == 0 or s.result.converged:
            out.frames.append(Frame(s.t / end, out.settlement[-1], s.points.corners.copy(), s.points.pressure.copy()))

    steps = steps or max(10, round(depth * cells / STEP))
    out.results.append(simulation.run(end, end / steps, observe=observe))
    out.pushed = len(out.load) - 1
    if rest:
        later = rest * WIDTH**2 / CV
        out.results.append(simulation.run(end + later, later / 40, observe=observe))
    return out


def limit_loads(cells: int) -> dict[str, float]:
    """Return the limit loads of very stiff soil over Prandtl's, less one."""
    stiff = replace(SOIL, bulk=STIFF * SOIL.bulk, shear=STIFF * SOIL.shear)
    clay, sand = replace(stiff, friction=0.0, conductivity=0.0), replace(stiff, dilation=FRICTION)
    undrained = push(clay, cells, 0.0012, RATES["fast"], box=(2.0, 1.2), steps=40)
    drained = push(sand, cells, 0.003, None, box=(4.0, 1.7), steps=40)
    return {
        "undrained": undrained.load[-1] / capacity(0.0) - 1,
        "drained": drained.load[-1] / capacity(FRICTION) - 1,
    }


def main(argv: list[str] | None = None) -> dict:
    """Run the demo; return what --json prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--cells", type=int, default=9, help="cells over the footing's width, odd")
    parser.add_argument("--depth", type=float, default=1.0, help="depth of the push over the footing's width")
    parser.add_argument("--out", type=Path, default=Path("out/footing"), help="folder for pictures")
    parser.add_argument("--json", action="store_true", help="print the results as one line of JSON at the end")
    o = parser.parse_args(argv)
    if o.cells < 3 or o.cells % 2 == 0 or not 0 < o.depth <= 1.5:
        parser.error(f"--cells {o.cells} --depth {o.depth:g}: must be odd and >= 3, and in (0, 1.5]")
    out = {"errors": {}, "converged": False}
    try:
        for cells in (o.cells, 2 * o.cells - 1):
            for name, error in limit_loads(cells).items():
                out["errors"][f"{name}_{cells}"] = error
                print(f"{name:>9} limit load with {cells} cells over the width: {error:+.1%}")
        runs = {}
        for name, rate in RATES.items():
            runs[name] = push(SOIL, o.cells, o.depth, rate, rest=10.0 if name == "middling" else 0.0)
        out |= report(runs) | {"converged": True}
        draw(o.out, runs)
        animate(o.out, runs["middling"])
        print(f"pictures: {o.out}/footing.png, footing.gif")
    except mpm.GaveUp as error:
        print(f"error: {error}", file=sys.stderr)
    if o.json:
        print(json.dumps(out))
    return out


def report(runs: dict[str, Push]) -> dict:
    """Print what the pushes were like and return it."""
    out = {}
    for name, run in runs.items():
        out[name] = found = {
            "load": run.load[run.pushed],
            "load_at_rest": run.load[-1],
            "pressure": float(run.at_end.pressure.max() / COHESION),
            "balance": max(result.balance for result in run.results),
            **{count: run.total(count) for count in ("steps", "cuts", "newton", "rederived", "wall")},
        }
        print(
            f"{name:>9} (V = {RATES[name]:g}): q / c = {found['load']:.2f}, p up to {found['pressure']:.2g} c, "
            f"{found['steps']} steps, {found['cuts']} cuts, {found['rederived']} domains re-derived, "
            f"{found['wall']:.0f} s"
        )
    middling = runs["middling"]
    left = np.abs(middling.frames[-1].pressure).max() / COHESION
    print(f"consolidated at rest: q / c = {middling.load[-1]:.2f}, p down to {left:.2g} c")
    print("theory at the surface: " + ", ".join(f"{name} {value:.2f}" for name, value in LIMITS.items()))
    return out


def view(ax, pair: tuple[Frame, Frame], limits: tuple[float, float]):
    """Draw the pressure, in c, of two frames as left and right half of the soil, and the footing."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Rectangle

    surface = BOX[1] * WIDTH
    for sign, frame in zip((-1, 1), pair, strict=True):
        corners = frame.corners[:, [0, 1, 3, 2]] * [sign, 1] - [0, surface]
        quads = PolyCollection(corners, array=frame.pressure / COHESION, cmap="viridis", clim=limits)
        quads.set(edgecolors="face", linewidth=0.1)
        ax.add_collection(quads)
    place = (-WIDTH / 2, -pair[0].settlement * WIDTH)
    ax.add_patch(Rectangle(place, WIDTH, 0.5 * WIDTH, facecolor="0.75", edgecolor="black", lw=0.8))
    ax.axhline(0, color="grey", lw=0.6, ls=":")
    ax.set(aspect="equal", xlim=(-2.5, 2.5), ylim=(-2.0, 0.6), xlabel="x / B (-)", ylabel="y / B (-)")
    return quads


def scale(run: Push) -> tuple[float, float]:
    """Return the ends of the colours, in c, that show the pressures of a push."""
    return 0.0, float(np.quantile(run.at_end.pressure, 0.999) / COHESION)


def draw(out: Path, runs: dict[str, Push]) -> None:
    """Draw pressures at the end of the middling push and after it, and the load over the settlement at all rates."""
    fig, ((left, right),) = beam.figure(1, 2, (12, 4.6))
    run = runs["middling"]
    quads = view(left, (run.at_end, run.frames[-1]), scale(run))
    fig.colorbar(quads, ax=left, label="pore pressure / c (-)", shrink=0.8, extend="both")
    left.axvline(0, color="white", lw=0.8)
    left.set_title("Middling push: at its end (left), consolidated (right)")
    for name, each in runs.items():
        upto = each.pushed + 1
        right.plot(each.settlement[:upto], each.load[:upto], label=f"{name}, V = {RATES[name]:g}")
    right.plot([run.settlement[-1]] * 2, [run.load[run.pushed], run.load[-1]], "o-", ms=4, color="C1", mfc="none")
    for (name, value), style in zip(LIMITS.items(), ("--", ":", "-."), strict=True):
        right.axhline(value, color="black", lw=0.8, ls=style, label=f"{name}: {value:.2f}")
    right.set(xlabel="settlement / B (-)", ylabel="mean pressure under the footing / c (-)")
    right.set(xlim=(0, None), ylim=(0, None), title="Load and settlement; theory is for the surface")
    right.legend(fontsize=8)
    right.grid(alpha=0.3)
    out.mkdir(parents=True, exist_ok=True)
    fig.savefig(out / "footing.png", dpi=100)


def animate(out: Path, run: Push) -> None:
    """Draw the push and what follows as an animation."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    fig, ((ax,),) = beam.figure(1, 1, (6.4, 3.9))
    quads = view(ax, (run.frames[0], run.frames[0]), scale(run))
    fig.colorbar(quads, ax=ax, label="pore pressure / c (-)", shrink=0.8, extend="both")
    ax.set_title(" ")
    fig.canvas.draw()
    fig.set_layout_engine("none")  # laid out once

    def show(k: int) -> None:
        ax.clear()
        frame = run.frames[k]
        view(ax, (frame, frame), scale(run))
        ax.set_title("pushed" if frame.t < 1 else "at rest: the soil consolidates")

    chosen = np.unique(np.linspace(0, len(run.frames) - 1, 40, dtype=int))
    FuncAnimation(fig, show, frames=chosen).save(out / "footing.gif", PillowWriter(fps=6), dpi=70)


if __name__ == "__main__":
    sys.exit(0 if main()["converged"] else 1)
