# SPDX-License-Identifier: MIT
"""An embankment under water is built in lifts on soft clay, and the clay consolidates.

By symmetry, half of the section is computed, with the plane of symmetry at x = 0. On 6 m of clay, a lift of 1 m with
slopes of 1:2 is built every 90 days. After four lifts the clay consolidates for ten years. Each lift is a polygon with
named edges (`mpm.polygon`, by gmsh). A lift is placed on the settled ground and filled up to its design level, so it is
thicker than 1 m. Each lift is drained at its slope and crest. Pressures are in excess of the hydrostatic pressure of
the sea, and weights are buoyant. The weight of the lifts is a term in UFL. The clay is in equilibrium with its own
weight from the start. The demo runs on one process.

Check: at the end the lowest points of the clay carry the weight of all lifts. `carried` is the integral of the
effective stress over the lowest points, divided by the weight of all lifts. In equilibrium `carried` is 1.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np
import ufl

import mpm_dolfinx as mpm

DAY = 86400.0  # s
CLAY, CREST, SLOPE, LIFTS = (
    6.0,
    4.0,
    2.0,
    4,
)  # m: depth of the clay, half the width of the crest; slope: run divided by rise; lifts of 1 m
WIDTH = 24.0  # m: of the section
PAUSE, END = 90 * DAY, 3650 * DAY  # time between two lifts; time after the last lift
BUOYANT = 0.6 * (2650 - 1000) * 9.81  # N/m^3


@dataclass(frozen=True)
class Weighed(mpm.Hencky):
    """Hencky's law with a buoyant unit weight, in N/m^3, for the term `weight`."""

    unit_weight: mpm.Field = 0.0

    @staticmethod
    def energy(F, bulk, shear, unit_weight):
        """Return the stored energy per reference volume (UFL), in Pa."""
        return mpm.Hencky.energy(F, bulk, shear)


SOFT = Weighed(bulk=3e5, shear=1.5e5, porosity=0.5, conductivity=5e-9, unit_weight=lambda X: np.zeros(len(X)))
SAND = Weighed(bulk=1e7, shear=6e6, conductivity=1e-6, unit_weight=lambda X: np.full(len(X), BUOYANT))


def weight(points, v):
    """Return the virtual work (UFL) of the buoyant weight for the test function v."""
    return points.unit_weight / ufl.det(points.F) * points.value(v)[1] * points.dx


def lift(grid: mpm.Grid, k: int):
    """Return the k-th lift: a polygon with named edges."""
    low, high = (CREST + SLOPE * (LIFTS - k - end) for end in (0, 1))
    y = CLAY + k
    edges = ["base", "slope", "crest", "axis"]
    return mpm.polygon(grid, [(0, y), (low, y), (high, y + 1), (0, y + 1)], edges, material=1)


@dataclass
class Bund:
    """Histories: times (s), settlements of axis and toe (m), and excess pressures in the clay (Pa).

    frames: title, corners (n, 4, 2) in m, and excess pressures (n,) in Pa at some times.
    carried: fraction of the lifts' weight that the lowest points carry at the end.
    """

    t: list[float] = field(default_factory=list)
    axis: list[float] = field(default_factory=list)
    toe: list[float] = field(default_factory=list)
    excess: list[float] = field(default_factory=list)
    frames: list[tuple[str, np.ndarray, np.ndarray]] = field(default_factory=list)
    carried: float = 0.0
    wall: float = 0.0
    steps: int = 0


def run(h: float = 0.5, steps: int = 6) -> Bund:
    """Build the embankment on cells of size h (m), in `steps` steps for each lift."""
    grid = mpm.Grid([0, 0], [WIDTH, CLAY + LIFTS + 1], np.rint(np.array([WIDTH, CLAY + LIFTS + 1]) / h).astype(int))
    bodies = [mpm.box(grid, [0, 0], [WIDTH, CLAY]), *[lift(grid, k) for k in range(LIFTS)]]
    simulation = mpm.Simulation(
        grid,
        [bodies[0], *map(mpm.Later, bodies[1:])],
        [SOFT, SAND],
        walls={"left": "x", "right": "x", "bottom": "xy"},
        fluid=mpm.Fluid(),
        terms=[weight],
        conditions=[mpm.Drained("top")],
    )
    out = Bund()
    probes = mpm.probes(bodies, [[0.0, CLAY - 1e-6], [CREST + SLOPE * LIFTS, CLAY - 1e-6]])
    middle = int(np.argmin(np.linalg.norm(bodies[0].centre - (0.0, CLAY / 2), axis=1)))

    def observe(s: mpm.Simulation) -> None:
        u = s.result.displacement[-1][:, 1]
        p = s.points.pressure
        for values, value in zip((out.t, out.axis, out.toe, out.excess), (s.t, *u, p[middle]), strict=True):
            values.append(float(value))

    for k in range(LIFTS):
        simulation.stage(add=[k + 1], conditions=[mpm.Drained(side) for side in ("top", "slope", "crest")])
        last, now = k == LIFTS - 1, simulation.t
        times = [(now + 5 * DAY, 1), (now + PAUSE, steps), (now + END, 5 * steps)] if last else [(now + PAUSE, steps)]
        for part, (end, count) in enumerate(times):
            dt = (end - simulation.t) / count
            result = simulation.run(end, dt, probes=probes, observe=observe, progress=False)
            out.wall, out.steps = out.wall + result.wall, out.steps + result.steps
            if last and part != 1:  # just after the last lift, and at the end
                points = simulation.points
                title = f"{simulation.t / DAY:.0f} days after the first lift"
                out.frames.append((title, points.corners.copy(), points.pressure))
    bottom = bodies[0].named("bottom")[0]
    points, stress = simulation.points, simulation.effective_stress()[:, 1, 1]
    width = points.corners[bottom, 1, 0] - points.corners[bottom, 0, 0]
    lifted = BUOYANT * points.volume0[len(bodies[0]) :].sum()
    out.carried = float(-(stress[bottom] * width).sum() / lifted)
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--h", type=float, default=0.5, help="cell size, m")
    parser.add_argument("--steps", type=int, default=6, help="steps between two lifts")
    o = parser.parse_args(argv)
    if not 0.1 <= o.h <= 1 or o.steps < 1:
        parser.error(f"--h {o.h}: must be 0.1 to 1 m; --steps {o.steps}: must be >= 1")
    with common.results(o) as out:
        bund = run(o.h, o.steps)
        out |= {"carried": bund.carried, "settlement": -bund.axis[-1], "wall_s": bund.wall}
        print(f"the clay's lowest points carry {bund.carried:.4f} of the weight of the lifts")
        print(f"settlement on the axis: {-bund.axis[-1]:.3f} m, at the toe {-bund.toe[-1]:.3f} m")
        most, end = max(bund.excess) / 1e3, bund.excess[-1] / 1e3
        print(f"excess pressure in the middle of the clay: {most:.1f} kPa at most, {end:.2f} kPa at the end")
        draw(o, bund)
        print(f"{bund.steps} steps, {bund.wall:.1f} s")
    return out


def draw(o: Namespace, bund: Bund) -> None:
    """Draw the section at two times, and settlements and excess pressures against time."""
    fig, axes = common.figure(2, 2, (13, 6.4))
    most = max(np.quantile(np.abs(p), 0.995) for _, _, p in bund.frames) / 1e3
    for ax, (title, corners, excess) in zip(axes[0], bund.frames, strict=True):
        domains = common.domains(ax, corners, excess / 1e3, cmap="viridis", clim=(0, most))
        ax.plot([CREST + SLOPE * LIFTS, CREST, 0], [CLAY, CLAY + LIFTS, CLAY + LIFTS], color="grey", lw=0.8, ls=":")
        ax.plot([0, WIDTH], [CLAY, CLAY], color="grey", lw=0.8, ls=":")
        ax.set(
            aspect="equal",
            xlim=(0, WIDTH),
            ylim=(0, CLAY + LIFTS + 0.5),
            title=f"{title}; dotted: as built",
            xlabel="x (m)",
            ylabel="y (m)",
        )
    fig.colorbar(domains, ax=axes[0], label="excess pressure (kPa)", shrink=0.8)
    (ax, below), days = axes[1], np.array(bund.t) / DAY
    ax.plot(days, bund.axis, color="C0", label="on the axis")
    ax.plot(days, bund.toe, color="C0", ls="--", label="at the toe")
    ax.set_ylabel("ground's displacement, up (m)")
    ax.legend(loc="lower left")
    below.plot(days, np.array(bund.excess) / 1e3, color="C0")
    below.set_ylabel("excess pressure in mid-clay (kPa)")
    for ax in axes[1]:
        ax.set(xlim=(0, None), xlabel="days after the first lift")
        ax.set_xscale("symlog", linthresh=100)
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "embankment.png")


if __name__ == "__main__":
    main()
