# SPDX-License-Identifier: MIT
"""Seepage with a free surface through a dam of unsaturated soil, while the level of the reservoir falls.

A dam, 6 m high with slopes of 1:2, stands on an impervious base. At first the water table is at the level of the
reservoir, 5 m. Then the downstream slope becomes permeable, and the flow becomes steady. Finally the reservoir falls by
2 m in five days, and the free surface (zero pressure) falls as the soil drains. Above the free surface, water flows
under suction (`mpm.VanGenuchten`). The water of the reservoir loads the upstream slope. Slopes above water are seepage
faces.

Checks:

* `flow`: outflow of a rectangular dam, divided by the exact outflow. The dam is L = 9.6 m wide, with water levels of H1
  = 10 m and H2 = 2 m at its sides, and hydrostatic suction above these levels. Without suction, the exact flow is
  `k (H1^2 - H2^2) / (2 L)` (Dupuit, Charny), with the conductivity k. With suction, Kirchhoff's potential replaces the
  head. The potential is the integral of the relative permeability over the head.
* `steady`: inflow of the dam divided by its outflow, before the reservoir falls.
* `drained`: outflow of a column, divided by the outflow that finite elements on cells a quarter as large give. The free
  surface in the column falls from 8 m towards 2 m.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

HEIGHT, CREST, SLOPE = 6.0, 3.0, 2.0  # m, m, slope: run divided by rise
BASE = CREST + 2 * SLOPE * HEIGHT
LEVELS = (5.0, 3.0)  # m: level of the reservoir, before and after the fall
WEIGHT = 9810.0  # N/m^3
LOAM = mpm.LinearElastic(
    bulk=1e9,
    shear=5e8,
    porosity=0.4,
    conductivity=1e-6,
    retention=mpm.VanGenuchten(WEIGHT / 2, residual=0.15, n=2.0),
)
DAY = 86400.0  # s
SETTLES = (0.1, 1.0, 10.0, 100.0)  # days: lengths of the steps until the flow is steady
FALLS, SEEN = 5.0, (5.0, 15.0, 40.0)  # days: duration of the fall; times since its start, for the picture


@dataclass
class Dam:
    """Results of the dam in steady flow and at each time of `SEEN`.

    flows: outflows (2,) through both slopes, in m^2/s.
    frames: corners (n, 4, 2) in m, and pressures (n,) in Pa, of the domains.
    """

    flows: list[np.ndarray] = field(default_factory=list)
    frames: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    balance: float = 0.0
    wall: float = 0.0
    steps: int = 0

    def run(self, simulation: mpm.Simulation, days: float, steps: int) -> None:
        """Run for a number of days, in equal steps."""
        result = simulation.run(simulation.t + days * DAY, days * DAY / steps, progress=False)
        self.wall, self.steps = self.wall + result.wall, self.steps + result.steps
        self.balance = max(self.balance, result.balance)

    def see(self, simulation: mpm.Simulation) -> None:
        """Record the present flows, corners and pressures."""
        self.flows.append(simulation.outflows.array)
        self.frames.append((simulation.points.corners.copy(), simulation.points.pressure))


def run(h: float = 0.5, steps: int = 10) -> Dam:
    """Run the dam on cells of size h (m), first to steady flow and then during the drawdown."""
    grid = mpm.Grid([0, 0], [BASE + 2, HEIGHT + 1], np.rint(np.array([BASE + 2, HEIGHT + 1]) / h).astype(int))

    def trapezoid(X: np.ndarray) -> np.ndarray:
        wide = 1 - 2 * SLOPE * X[:, 1] / BASE
        return np.stack([1 + BASE / 2 + (X[:, 0] - BASE / 2) * wide, X[:, 1]], axis=1)

    body = mpm.mapped(grid, mpm.box(grid, [0, 0], [BASE, HEIGHT]), trapezoid)

    def conditions(level: float | Callable[[float], float]) -> dict:
        load, head = mpm.water("left", level)
        return {"conditions": [load, head, mpm.Drained("right", seepage=True)]}

    simulation = mpm.Simulation(
        grid,
        [body],
        [LOAM],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(LEVELS[0]),
        initial_stress=mpm.K0(0.5, surcharge=lambda x: WEIGHT * np.maximum(LEVELS[0] - x[:, 1], 0)),
        **conditions(LEVELS[0]),
    )
    out = Dam()
    for days in SETTLES:
        out.run(simulation, steps * days, steps)
    out.see(simulation)
    begun = simulation.t
    simulation.stage(
        **conditions(lambda t: np.interp(t, [begun, begun + FALLS * DAY], LEVELS)),
    )
    for days in np.diff(SEEN, prepend=0.0):
        out.run(simulation, days, steps)
        out.see(simulation)
    return out


def rectangular(cells: int) -> float:
    """Return the flow through a rectangular dam, divided by the exact flow."""
    levels, width, top = (10.0, 2.0), 9.6, 12.0
    h = top / cells
    grid = mpm.Grid([0, 0], [width + 2 * h, top + 2 * h], [round(width / h) + 2, cells + 2])

    def heads(x: np.ndarray) -> np.ndarray:
        return WEIGHT * (np.interp(x[:, 0], [h, h + width], levels) - x[:, 1])

    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, [h, 0], [width + h, top])],
        [LOAM],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        conditions=[mpm.Drained("left", heads), mpm.Drained("right", heads)],
        gravity=(0, -9.81),
        pressure=heads,
        initial_stress=mpm.K0(0.5),
    )
    for days in (1.0, 10.0, 100.0, 1000.0):
        simulation.run(simulation.t + days * DAY, days * DAY / 4, progress=False)
    exact = LOAM.conductivity / width * (driving(levels[0], top) - driving(levels[1], top))
    return float(simulation.outflows["drained_right"] / exact)


def driving(level: float, top: float) -> float:
    """Return the integral of Kirchhoff's potential over the height `top` (m) of a hydrostatic side, in m^2."""
    law, suction = LOAM.retention, np.linspace(0, top - level, 100001)
    filled = (1 + (suction * WEIGHT / law.entry) ** law.n) ** (1 / law.n - 1)
    k_r = filled**law.l * (1 - (suction * WEIGHT / law.entry) ** (law.n - 1) * filled) ** 2
    step = suction[1]
    up_to = np.append(0.0, np.cumsum((k_r[1:] + k_r[:-1]) / 2 * step))
    return float(level**2 / 2 - (up_to[1:] + up_to[:-1]).sum() / 2 * step)


def drained(cells: int, days: float = 100.0) -> tuple[float, float]:
    """Return the outflow (m) from a column 10 m high, by material points and by finite elements.

    The free surface starts at 8 m, and the head at the base is lowered to 2 m.
    """
    high, head, h = 8.0, 2.0, 10.0 / cells
    grid = mpm.Grid([0, 0], [h, 10.0 + h], [1, cells + 1])
    scene = {"fluid": mpm.Fluid(), "walls": {"left": "x", "right": "x", "bottom": "y"}}
    scene |= {"conditions": [mpm.Drained("bottom", WEIGHT * head)], "pressure": mpm.hydrostatic(high)}
    body = mpm.box(grid, [0, 0], [h, 10])
    simulation = mpm.Simulation(grid, [body], [LOAM], gravity=(0, -9.81), initial_stress=mpm.K0(0.5), **scene)
    start = simulation.cells().water.sum()
    simulation.run(days * DAY, days * DAY / 50, progress=False)
    # stiff elements: they start without stress, under their weight
    hard = replace(LOAM, bulk=1e12, shear=5e11)
    fem = BiotFEM(
        mpm.Grid([0, 0], [h, 10], [1, 4 * cells]), hard, gravity=lambda t: (0, -9.81), element="q1-dg0", **scene
    )
    full = fem.water()
    fem.run(days * DAY, days * DAY / 100, probes=[[0, 10]])
    return float(start - simulation.cells().water.sum()) / h, (full - fem.water()) / h


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--h", type=float, default=0.5, help="cell size, m")
    parser.add_argument("--steps", type=int, default=10, help="steps in each period until steady flow, and in the fall")
    parser.add_argument(
        "--cells", type=int, default=40, help="cells over the height of the rectangular dam, and of the column"
    )
    o = parser.parse_args(argv)
    if not 0.1 <= o.h <= 1 or o.steps < 1 or not 10 <= o.cells <= 200:
        h, steps = f"--h {o.h}: must be 0.1 to 1 m", f"--steps {o.steps}: must be >= 1"
        parser.error(f"{h}; {steps}; --cells {o.cells}: must be 10 to 200")
    with common.results(o) as out:
        flow = rectangular(o.cells)
        print(f"rectangular dam, {o.cells} cells high: flow over the exact one {flow:.4f}", flush=True)
        lost = drained(o.cells)
        print("column, {} cells high: outflow {:.4f} m, by finite elements {:.4f} m".format(o.cells, *lost), flush=True)
        dam = run(o.h, o.steps)
        flows = (
            [f"{day:g}", *(f"{q:.3e}" for q in (-q[0], q[1]))] for day, q in zip((0, *SEEN), dam.flows, strict=True)
        )
        common.table([["days of drawdown", "flow in (m²/s)", "flow out (m²/s)"], *flows])
        steady = float(-dam.flows[0][0] / dam.flows[0][1])
        draw(o, dam)
        print(f"{dam.steps} steps, {dam.wall:.1f} s, fluid balance {dam.balance:.1e}")
        out |= {
            "flow": flow,
            "drained": lost[0] / lost[1],
            "balance": dam.balance,
            "steady": steady,
            "wall_s": dam.wall,
        }
    return out


def draw(o: Namespace, dam: Dam) -> None:
    """Draw pressures in steady flow, and the free surfaces during the drawdown."""
    fig, axes = common.figure(2, 1, (9, 4.9))
    (corners, p), ax = dam.frames[0], axes[0, 0]
    domains = common.domains(ax, corners, p / 1e3, cmap="viridis", clim=(-WEIGHT * 2 / 1e3, WEIGHT * LEVELS[0] / 1e3))
    fig.colorbar(domains, ax=ax, label="pore pressure (kPa)", shrink=0.8)
    axes[1, 0].plot(*np.array([[1, 0], [13, HEIGHT], [16, HEIGHT], [28, 0], [1, 0]]).T, color="grey", lw=0.8)
    for k, (day, (corners, p)) in enumerate(zip((0.0, *SEEN), dam.frames, strict=True)):
        for ax in axes[:, 0] if k == 0 else axes[1:, 0]:
            level, color = np.interp(day, [0, FALLS], LEVELS), "w" if ax is axes[0, 0] else f"C{k}"
            ax.tricontour(*corners.mean(axis=1).T, p, levels=[0.0], colors=color, linewidths=1.5)
            ax.plot([0, 1 + SLOPE * level], [level, level], color=f"C{k}", label=f"{day:g}")
            ax.set(aspect="equal", xlim=(0, BASE + 2), ylim=(0, HEIGHT + 0.5), xlabel="x (m)", ylabel="y (m)")
    axes[0, 0].set_title("Steady seepage; white: free surface, p = 0")
    axes[1, 0].set_title("Free surface while the reservoir falls by 2 m in 5 days")
    axes[1, 0].legend(title="days", fontsize=9, loc="upper right")
    common.save(fig, o.out / "dam.png")


if __name__ == "__main__":
    main()
