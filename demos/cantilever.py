# SPDX-License-Identifier: MIT
"""Large deflection of a cantilever under a dead load at its end.

A dry beam, 1 m long and 0.05 m high, is clamped at its left end. A dead load P is spread evenly over its right end. The
load parameter `alpha = P L² / (E I)` is 1, 2, 5 and 10, with the length L, Young's modulus E and the second moment of
area I. P and I = height³ / 12 are per unit depth. At alpha = 10 the tip deflection is 0.81 L, and the shortening is
0.56 L. Poisson's ratio is zero, so plane strain equals plane stress. The law is neo-Hookean.

There are two references. The elastica (Bisshopp & Drucker 1945) neither stretches nor shears. The geometrically exact
rod (Reissner 1972, Simo 1985) also stretches, with the stiffness E A, and shears, with the stiffness 5/6 G A. Here A is
the area of the section and G the shear modulus. The demo runs on one process.

Each alpha has two errors, such as `v_1` and `u_1`: the differences between beam and rod, divided by L. Errors `v` refer
to the tip deflection, and errors `u` to the shortening. Converged finite elements have errors of at most 0.08 %. On
fine grids the material points converge to these finite elements with second order in the cell size.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.exact import elastica_tip, shear_flexible_rod

LENGTH, HEIGHT, YOUNG = 1.0, 0.05, 12e6  # m, m, Pa
BOX = np.array([1.05, 1.0])  # m
RUBBER = mpm.NeoHookean(bulk=YOUNG / 3, shear=YOUNG / 2)
STIFFNESS = YOUNG * HEIGHT**3 / 12  # E I per depth, N m
LOADS = (1, 2, 5, 10)  # alpha
ARC = np.linspace(0, LENGTH, 41)  # m; arc lengths of the probes on the axis


def traction(alpha: float) -> tuple[float, float]:
    """Return the traction on the right end, in Pa, for the load parameter alpha."""
    return 0.0, -alpha * STIFFNESS / LENGTH**2 / HEIGHT


PHYSICS = {"walls": {"left": "xy"}, "conditions": [mpm.Traction("right", traction)]}


@dataclass
class Outcome:
    """Results of a run: the axis (k, 2) of the beam in m, for each alpha, and the `mpm.Result`."""

    axis: dict[int, np.ndarray]
    result: mpm.Result


def run(cells: int = 8, steps: int = 40, last: int = 10) -> tuple[dict[str, float], Outcome]:
    """Increase alpha to `last` in increments of 10 / `steps`, and bend the beam.

    Returns the errors by name, and the results of the run.
    """
    h = HEIGHT / cells
    grid = mpm.Grid([0, 0], BOX, np.rint(BOX / h).astype(int))
    bottom = BOX[1] - 2 * HEIGHT + h / 2
    body = mpm.box(grid, [0, bottom], [LENGTH, bottom + HEIGHT], per_cell=2)
    simulation = mpm.Simulation(grid, [body], [RUBBER], **PHYSICS)
    places = np.stack([ARC, np.full(len(ARC), bottom + HEIGHT / 2)], axis=1)
    result = simulation.run(last, 10 / steps, probes=mpm.probes([body], places))
    start = np.stack([ARC, np.zeros(len(ARC))], axis=1)
    at = {alpha: result.displacement[round(alpha * steps / 10)] for alpha in LOADS if alpha <= last}
    out = Outcome({alpha: start + u for alpha, u in at.items()}, result)
    return errors(out), out


def rod(alpha: float) -> np.ndarray:
    """Return the axis (k, 2) of the rod at the arc lengths `ARC`, in m."""
    axial, transverse = YOUNG * HEIGHT, 5 / 6 * RUBBER.shear * HEIGHT
    return shear_flexible_rod(LENGTH, axial, transverse, STIFFNESS, -alpha * STIFFNESS / LENGTH**2, points=ARC)


def errors(out: Outcome) -> dict[str, float]:
    """Return the errors by name; the docstring of this file explains the names."""
    off = {alpha: np.abs(axis[-1] - rod(alpha)[-1]) / LENGTH for alpha, axis in out.axis.items()}
    return {f"{name}_{alpha}": float(e[i]) for i, name in ((1, "v"), (0, "u")) for alpha, e in off.items()}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=8, help="cells over the height")
    parser.add_argument("--steps", type=int, default=40, help="equal increments of the load to alpha = 10")
    o = parser.parse_args(argv)
    if o.cells < 1 or o.steps < 10 or o.steps % 10:
        parser.error(f"--cells {o.cells}: must be >= 1; --steps {o.steps}: must be a multiple of 10")
    with common.results(o) as out:
        found, outcome = run(o.cells, o.steps)
        out |= {"errors": found, "wall_s": outcome.result.wall}
        print(f"{o.cells} cells, {o.steps} steps, {out['wall_s']:.1f} s")
        report(outcome, found)
        draw(o, outcome)
    return out


def report(out: Outcome, found: dict[str, float]) -> None:
    """Print the deflection and the shortening of beam, rod and elastica."""
    print("alpha |     v/L      rod elastica  v - rod |     u/L      rod elastica  u - rod")
    for alpha, axis in out.axis.items():
        (x, y), (rod_x, rod_y), (u, v) = axis[-1] / LENGTH, rod(alpha)[-1] / LENGTH, elastica_tip(alpha)
        print(f"{alpha:5} | {-y:7.5f} {-rod_y:8.5f} {v:8.5f} {found[f'v_{alpha}']:8.3%}", end=" | ")
        print(f"{1 - x:7.5f} {1 - rod_x:8.5f} {u:8.5f} {found[f'u_{alpha}']:8.3%}")


def draw(o: Namespace, out: Outcome) -> None:
    """Draw the axes of beam and rod, and the tips of beam and elastica."""
    fig, ((left, right),) = common.figure(1, 2, (11, 4.8))
    for i, (alpha, axis) in enumerate(out.axis.items()):
        left.plot(*rod(alpha).T, color="black", lw=1, label=None if i else "shear-flexible rod")
        left.plot(*axis.T, "o", ms=3, color=f"C{i}", markevery=2, label=rf"points, $\alpha$ = {alpha}")
    left.set(xlabel="x (m)", ylabel="y (m)", title="Axis of the beam", aspect="equal", xlim=(-0.02, 1.02))
    left.legend(loc="lower right")
    alphas = np.linspace(0, max(out.axis), 101)
    for i, name in enumerate(("shortening u / L", "deflection v / L")):
        right.plot(alphas, [elastica_tip(a)[i] for a in alphas], color="black", lw=1, label=None if i else "elastica")
        drawn = [(LENGTH - axis[-1, 0], -axis[-1, 1])[i] / LENGTH for axis in out.axis.values()]
        right.plot(list(out.axis), drawn, "o", ms=5, color=f"C{i + 4}", label=name)
    right.set(xlabel=r"load $\alpha = P L^2 / (E I)$ (-)", ylabel="displacement of the tip / L (-)", title="Tip")
    right.set(xlim=(0, 1.02 * max(out.axis)), ylim=(0, 1))
    right.legend(loc="lower right")
    for ax in (left, right):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "cantilever.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
