# SPDX-License-Identifier: MIT
"""A T-bar, a rigid cylinder, is pushed sideways through clay, deep below the surface.

The clay is von Mises's, undrained, of strength s_u in plane strain.  The bar is wished in place and pushed until the
clay flows all around it.  Then its resistance is that of Randolph and Houlsby (1984), for adhesion alpha s_u on it,

    N = F / (s_u D) = pi + 2 asin(alpha) + 4 cos(pi/4 - asin(alpha)/2) (sqrt(2) + sin(pi/4 - asin(alpha)/2)).

Half of the clay, a block eight diameters wide and high, lies between smooth walls under a pressure on its top that
keeps the gap behind the bar closed; as that settles the clay, it loads the bar downwards first.  In a narrower block
the bar resists less: in one four diameters wide, with 8 and 16 cells over the diameter, 10.9 and 10.8 if it is rough.

Errors are those of the mean of N over the last quarter of the push; `spread` is by how much it varies there.
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
STEP = 1 / 24  # cells that the bar goes in a step


def exact(alpha: float) -> float:
    """Return N of Randolph and Houlsby."""
    delta = np.arcsin(alpha)
    half = np.pi / 4 - delta / 2
    return np.pi + 2 * delta + 4 * np.cos(half) * (np.sqrt(2) + np.sin(half))


def clay(cells: int) -> tuple:
    """Return a grid with so many cells over the diameter, half of the block around the bar, the region of its top."""
    h = D / cells
    n = round(HALF * cells)
    grid = mpm.Grid([HALF, HALF + 4 * h], [n, 2 * n + 4], lower=[0, -HALF])
    around, outward = 4 * round(np.pi * D / 2 / (FINE * h) / 4), round(np.log(2 * HALF / D) * D / 2 / (FINE * h))
    size = np.array([outward, around]) * h / 2

    top = ((0, 0.75 * size[1] - HALF - 1e-9), tuple(size))

    def ring(X: np.ndarray) -> np.ndarray:  # from the bar to the block's sides, ever larger
        angle = np.pi * (X[:, 1] + HALF) / size[1]
        e = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
        reach = HALF / np.abs(e).max(axis=1)
        return e * (D / 2 * (2 * reach / D) ** (X[:, 0] / size[0]))[:, None]

    return grid, mpm.mapped(grid, mpm.box(grid, [0, -HALF], size - [0, HALF]), ring), top


@dataclass
class Push:
    """A push, a step each: depths over D, and resistances over s_u D.

    frame: corners (n, 4, 2), m, how far points have moved (n,), m, and what the bar fills (m, 4, 2), m, at the end.
    """

    depth: list[float] = field(default_factory=list)
    N: list[float] = field(default_factory=list)
    frame: tuple = ()
    steps: int = 0
    cuts: int = 0


def push(alpha: float, cells: int, depth: float, steps: int) -> Push:
    """Press the clay, then push a bar of roughness alpha to a depth, over D, in so many steps."""
    grid, body, top = clay(cells)
    soil = mpm.DruckerPrager(bulk=50 * SHEAR, shear=SHEAR, friction=0.0, dilation=0.0, cohesion=STRENGTH)
    bar = mpm.Tool(mpm.Ball((0, 0), D / 2), lambda t: (0, -D * max(0, t - 1)), adhesion=alpha * STRENGTH)
    load = mpm.Pressure("right", lambda t: PRESSURE * min(1, t), region=top)
    simulation = mpm.Simulation(grid, [body], [soil], fixed=WALLS, tractions=[load], tools=[bar])
    simulation.run(1.0, 1.0, progress=False)
    out, start = Push(), simulation.points.x

    def see(s: mpm.Simulation) -> None:
        out.depth.append(s.t - 1)
        out.N.append(-2 * float(s.tool_forces[0, 1]) / STRENGTH / D)

    result = simulation.run(1 + depth, depth / steps, observe=see, progress=False)
    points, drawn = simulation.points, bar.drawn(grid, simulation.t)
    out.frame = points.corners, np.linalg.norm(points.x - start, axis=1), drawn
    out.steps, out.cuts = result.steps, result.cuts
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo; return what --json prints."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=8, help="cells over the diameter")
    parser.add_argument("--rough", nargs="*", type=float, default=list(ROUGH), help="alpha")
    parser.add_argument("--depth", type=float, default=0.16, help="of the pushes, over the diameter")
    o = parser.parse_args(argv)
    if not 4 <= o.cells <= 32 or not 0 < o.depth <= 1 or any(not 0 <= alpha <= 1 for alpha in o.rough):
        parser.error(f"--cells {o.cells} --depth {o.depth} --rough {o.rough}: must be 4 to 32, in (0, 1], in [0, 1]")
    steps, runs = max(2, round(o.depth * o.cells / STEP)), {}
    with common.results(o) as out:
        out |= {"errors": {}, "cuts": 0, "steps": 0}
        for alpha in o.rough:
            run = runs[alpha] = push(alpha, o.cells, o.depth, steps)
            last = np.array(run.N[-max(1, steps // 4) :])
            out["errors"][f"alpha {alpha:g}"] = float(last.mean() / exact(alpha) - 1)
            out[f"spread {alpha:g}"] = float(np.ptp(last) / last.mean())
            out["cuts"], out["steps"] = out["cuts"] + run.cuts, out["steps"] + run.steps
            found = f"alpha = {alpha:g}: N = {last.mean():.3f}, exact {exact(alpha):.3f}"
            print(f"{found}; {run.cuts} of {run.steps} steps cut", flush=True)
        draw(o, runs)
        out["converged"] = out["cuts"] <= 0.1 * out["steps"]
    return out


def draw(o: Namespace, runs: dict[float, Push]) -> None:
    """Draw resistances, and how far the clay has moved around the smoothest and the roughest bar."""
    ends = dict.fromkeys([*list(runs)[:1], *list(runs)[-1:]])
    fig, axes = common.figure(1, 1 + len(ends), (13, 4))
    for k, (alpha, run) in enumerate(runs.items()):
        axes[0, 0].plot(run.depth, run.N, color=f"C{k}", label=f"α = {alpha:g}")
        axes[0, 0].axhline(exact(alpha), color=f"C{k}", ls="--", lw=0.8)
    axes[0, 0].set(xlabel="depth / D (-)", ylabel="F / (s_u D) (-)", title="resistance; dashed: exact")
    axes[0, 0].legend(fontsize=9)
    axes[0, 0].grid(alpha=0.3)
    for ax, alpha in zip(axes[0, 1:], ends, strict=True):
        corners, moved, bar = runs[alpha].frame
        domains = common.domains(ax, corners, moved / (o.depth * D), cmap="viridis", clim=(0, 1.5))
        common.domains(ax, bar, facecolor="0.6", edgecolor="0.6")
        ax.set(aspect="equal", xlim=(0, 2), ylim=(-2, 2), xlabel="x (m)", ylabel="y (m)", title=f"α = {alpha:g}")
        fig.colorbar(domains, ax=ax, label="displacement / depth (-)", shrink=0.8)
    common.save(fig, o.out / "penetration.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
