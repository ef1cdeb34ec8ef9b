# SPDX-License-Identifier: MIT
"""Factor of safety of a slope, and run-out after a larger loss of strength.

A slope of 2:1, H = 10 m high, stands on a layer of 5 m. Slope and layer are Mohr-Coulomb soil without dilation, with
the friction angle phi = 20 degrees and the cohesion c = 0.05 gamma H (unit weight gamma).

1. The factor of safety is the largest divisor of c and tan(phi) for which the slope is stable. `mpm.factor_of_safety`
   reduces the strength of the slope at rest, adds a viscous stress, and checks whether this stress decays. The best
   log-spiral mechanism gives 1.368, and finite elements give 1.4 (Griffiths and Lane 1999).
2. For the run-out, the strength of viscous soil is suddenly divided by 1.6. The slope slides until its new shape is
   just stable. The factor of safety of the new shape differs from one by less than 0.1.
"""

from __future__ import annotations

from pathlib import Path

import common
import numpy as np

import mpm_dolfinx as mpm

HEIGHT, CREST, RUN, DEPTH, BEFORE = 10.0, 12.0, 20.0, 5.0, 14.0  # m
WEIGHT, FRICTION, COHESION = 20e3, 20.0, 10e3  # N/m³, degrees, Pa
YOUNG, POISSON = 1e8, 0.3  # Pa, -
LOG_SPIRAL, PUBLISHED = 1.368, 1.4
WEAKER = 1.6
VISCOSITY = 0.1 * WEIGHT * HEIGHT  # Pa s


def shape(cells: int) -> tuple[mpm.Grid, list[mpm.Body]]:
    """Return the grid, with `cells` cells over the slope's height, and the bodies ground and bank."""
    h, middle = HEIGHT / cells, CREST + RUN / 2
    columns, rows = round((CREST + RUN + BEFORE) / h), round(DEPTH / h)
    length = columns * h
    grid = mpm.Grid(lower=[0, -rows * h], upper=[length, HEIGHT + h], cells=[columns, rows + cells + 1])

    def sheared(X: np.ndarray) -> np.ndarray:
        return np.stack([X[:, 0] / middle * (CREST + RUN * (1 - X[:, 1] / HEIGHT)), X[:, 1]], axis=1)

    ground = mpm.box(grid, [0, -rows * h], [length, 0])
    bank = mpm.mapped(grid, mpm.box(grid, [0, 0], [middle, HEIGHT]), sheared)
    return grid, [ground, bank]


def slope(cells: int) -> mpm.Simulation:
    """Return the slope at rest at t = 0."""
    grid, bodies = shape(cells)
    soil = mpm.MohrCoulomb(
        bulk=YOUNG / (3 - 6 * POISSON),
        shear=YOUNG / (2 + 2 * POISSON),
        friction=lambda X: np.full(len(X), FRICTION),
        dilation=0.0,
        cohesion=lambda X: np.full(len(X), COHESION),
    )
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, bodies, [soil], walls=walls, terms=[common.weight(WEIGHT), common.viscous(VISCOSITY)])
    s.run(1e9, 1e9, progress=False)  # time after which viscous stresses are negligible
    s.stage(reset_displacement=True)
    s.t = 0.0
    return s


def slide(s: mpm.Simulation, steps: int) -> mpm.Result:
    """Divide the strength by `WEAKER`. Let the slope run out in `steps` steps of half a second and four long steps."""
    friction = np.degrees(np.arctan(np.tan(np.radians(FRICTION)) / WEAKER))
    s.stage(fields={"friction": friction, "cohesion": COHESION / WEAKER})
    s.run(0.5 * steps, 0.5, progress=False)
    return s.run(1e3 * steps, 250.0 * steps, progress=False)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=10, help="cells over the slope's height, even")
    parser.add_argument("--steps", type=int, default=40, help="steps of the slide")
    parser.add_argument("--rtol", type=float, default=0.01, help="relative accuracy of the factor of safety")
    o = parser.parse_args(argv)
    if o.cells < 2 or o.cells % 2 or o.steps < 1 or not 1e-3 <= o.rtol <= 0.1:
        options = f"--cells {o.cells}: must be even and >= 2; --steps {o.steps}: must be >= 1"
        parser.error(f"{options}; --rtol {o.rtol:g}: must be in [1e-3, 0.1]")
    with common.results(o) as out:
        s = slope(o.cells)
        before = s.points.corners.copy()
        safety = mpm.factor_of_safety(s, rtol=o.rtol)
        out["factor"] = safety.factor
        print(f"factor of safety {safety.factor:.3f}; log-spiral {LOG_SPIRAL}, published {PUBLISHED}", flush=True)
        slide(s, o.steps)
        corners, moved = s.points.corners, np.linalg.norm((s.points.corners - before).mean(axis=1), axis=1)
        out["moved"] = float(moved.max())
        after = mpm.factor_of_safety(s, rtol=3 * o.rtol)
        out |= {"factor_after": after.factor, "converged": abs(after.factor - 1) < 0.1}
        print(f"strength / {WEAKER}: moves by {moved.max():.2f} m; new factor of safety {after.factor:.3f}")
        draw(o.out, safety, before, corners, moved)
    return out


def draw(out: Path, safety: mpm.Safety, before: np.ndarray, corners: np.ndarray, moved: np.ndarray) -> None:
    """Draw the viscous stress in the trial runs, and the slope before and after its slide."""
    fig, ((trials, after),) = common.figure(1, 2, (13, 3.6))
    for factor, shares in sorted(safety.overloads.items()):
        rests = factor <= safety.bounds[0]
        style = {"color": "C0" if rests else "C1", "marker": "o" if rests else "x", "ms": 4, "lw": 1}
        trials.semilogy(np.arange(1, len(shares) + 1), shares, **style)
        trials.annotate(
            f"{factor:.3f}", (len(shares), shares[-1]), fontsize=8, xytext=(3, 0), textcoords="offset points"
        )
    trials.set(
        xlabel="step",
        ylabel="overload (share of the shear stress)",
        title=f"Factor of safety {safety.factor:.3f}; dots: comes to rest, crosses: fails",
    )
    trials.margins(x=0.12)
    quads = common.domains(after, corners, moved, cmap="viridis", linewidth=0.1)
    common.domains(after, before, facecolor="none", edgecolors="grey", linewidth=0.1, alpha=0.5)
    fig.colorbar(quads, ax=after, label="displacement (m)", shrink=0.7)
    after.set(
        xlabel="x (m)", ylabel="y (m)", aspect="equal", title=f"Strength over {WEAKER}: at rest again; grey: before"
    )
    after.autoscale_view()
    common.save(fig, out / "slope.png", dpi=90)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
