# SPDX-License-Identifier: MIT
"""A soft column settles to less than half its height under its own weight.

A dry column between smooth walls, l0 = 50 m high, has E = 10 kPa, nu = 0 and the density rho0 = 80 kg/m³. Gravity,
increased to g = 10 m/s² in equal steps, compresses the column to 24.06 m. The soil at its foot is compressed to 0.3 of
its initial height, so points cross many cells. The first Piola-Kirchhoff stress at the reference height Y carries the
weight above: `P = -rho0 g (l0 - Y)`. In a column of constant width P equals Cauchy's stress. With Hencky's law, the
stretch follows from Lambert's W function. Source: the column of AMPLE (Coombs & Augarde 2020,
doi:10.1016/j.advengsoft.2019.102748), here with a hundredth of its stiffness. The demo runs on one process.

`stress` is the mean error of the stress over the points, divided by rho0 g l0 and weighted by volume. `height` is the
relative error of the column's height. With 64 cells over the initial height, `stress` is 6.4e-6, and the published
error of GIMP is 4.4e-4. `--quadrature point` integrates at the points instead of over the pieces of their domains. With
this option, the error is about 8 % with any number of cells.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.exact import SelfWeightColumn

YOUNG, POROSITY = 1e4, 0.4  # Pa, -
EXACT = SelfWeightColumn(l0=50.0, bulk=YOUNG / 3, shear=YOUNG / 2, density=80.0, gravity=10.0)
FOAM = mpm.Hencky(bulk=EXACT.bulk, shear=EXACT.shear, porosity=POROSITY, grain_density=EXACT.density / (1 - POROSITY))


@dataclass
class Outcome:
    """The column at rest, with initial heights Y (n,) and present heights y (n,) of the points, in m."""

    Y: np.ndarray
    y: np.ndarray
    stress: np.ndarray
    volume: np.ndarray
    height: float
    result: mpm.Result


def run(cells: int = 64, steps: int = 40, quadrature: str = "domain") -> Outcome:
    """Load the column, `cells` cells high, in equal steps."""
    h = EXACT.l0 / cells
    grid = mpm.Grid([0, 0], [h, EXACT.l0], [1, cells])
    column = mpm.box(grid, [0, 0], [h, EXACT.l0], per_cell=2)
    simulation = mpm.Simulation(
        grid,
        [column],
        [FOAM],
        walls={"left": "x", "right": "x", "bottom": "y"},
        gravity=lambda t: (0, -EXACT.gravity * t),
        numerics=mpm.Numerics(quadrature=quadrature),
    )
    top = mpm.probes([column], [[h / 2, EXACT.l0]])
    result = simulation.run(1.0, 1 / steps, probes=top)
    points, stress = simulation.points, simulation.effective_stress()[:, 1, 1]
    height = EXACT.l0 + float(result.displacement[-1][0, 1])
    return Outcome(column.centre[:, 1], points.x[:, 1], stress, points.volume0, height, result)


def errors(out: Outcome) -> dict[str, float]:
    """Return the errors by name; the docstring of this file explains the names."""
    scale = EXACT.density * EXACT.gravity * EXACT.l0
    stress = np.average(np.abs(out.stress - EXACT.stress(out.Y)), weights=out.volume) / scale
    return {"stress": float(stress), "height": abs(out.height / EXACT.height - 1)}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=64, help="cells over the initial height")
    parser.add_argument("--steps", type=int, default=40, help="equal steps in which gravity increases")
    o = parser.parse_args(argv)
    if o.cells < 1 or o.steps < 1:
        parser.error(f"--cells {o.cells} --steps {o.steps}: must be >= 1")
    with common.results(o) as out:
        outcome, rival = run(o.cells, o.steps), run(o.cells, o.steps, "point")
        out |= {"errors": errors(outcome), "wall_s": outcome.result.wall, "standard_mpm": errors(rival)}
        print(f"{o.cells} cells, {o.steps} steps, {out['wall_s']:.1f} s; exact height {EXACT.height:.4f} m")
        both = {"exact domains": (outcome, out["errors"]), "standard MPM": (rival, out["standard_mpm"])}
        head = ["", "error of stress / (rho0 g l0), mean", "height (m)", "its error"]
        rows = ([name, f"{e['stress']:.2e}", f"{x.height:.4f}", f"{e['height']:.1e}"] for name, (x, e) in both.items())
        common.table([head, *rows])
        draw(o, outcome, rival)
    return out


def draw(o: Namespace, out: Outcome, rival: Outcome) -> None:
    """Draw the stress against the present height, with the exact curve and the stress by standard MPM."""
    fig, ((ax,),) = common.figure(1, 1, (6.5, 5))
    Y = np.linspace(0, EXACT.l0, 201)
    ax.plot(EXACT.stress(Y) / 1e3, EXACT.position(Y), color="black", lw=1, label="exact")
    ax.plot(rival.stress / 1e3, rival.y, "s", ms=2.5, color="C3", alpha=0.5, label="standard MPM, at the points")
    ax.plot(out.stress / 1e3, out.y, "o", ms=3, mfc="none", color="C0", label="material points, exact domains")
    ax.set(xlabel="vertical stress (kPa)", ylabel="present height (m)")
    ax.set_title(f"Column under its own weight: {EXACT.l0:g} m sink to {out.height:.2f} m")
    ax.legend()
    ax.grid(alpha=0.3)
    common.save(fig, o.out / "self_weight_column.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
