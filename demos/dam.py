# SPDX-License-Identifier: MIT
"""A dam: seepage with a free surface, as the reservoir falls.

A dam of 6 m with slopes of 1:2 stands on an impervious base.  At first the pore water is level with the reservoir, 5
m. Then the other slope is opened, and the flow becomes steady.  Then the reservoir falls by 2 m in five days, and the
free surface follows as the soil drains.  Water flows below the free surface only.  As the surface falls, a tenth of
the soil's volume drains from the pores (`mpm.unsaturated`).  The reservoir loads the wet slope.  Above the water,
both slopes are seepage faces.

Checks:

* `flow`: outflow of a rectangular dam over the exact k (H1^2 - H2^2) / (2 L) of Dupuit and Charny.  The dam is 9.6 m
  wide, with 10 m and 2 m of water at its sides;
* `steady`: inflow of the dam over its outflow, before the reservoir falls;
* `drained`: outflow of a column over the exact one.  Its free surface falls from 8 m to 4 m above its base, where the
  head is 2 m.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, field

import common
import numpy as np

import mpm_dolfinx as mpm

HEIGHT, CREST, SLOPE = 6.0, 3.0, 2.0  # m, m, run over rise
BASE = CREST + 2 * SLOPE * HEIGHT
LEVELS = (5.0, 3.0)  # m: of the reservoir, before and after
WEIGHT, CONDUCTIVITY, YIELD = 9810.0, 1e-6, 0.1  # N/m^3, m/s, -
DAY = 86400.0  # s
SETTLES = (1e-3, 0.01, 0.1, 1.0, 10.0)  # days: steps until the flow is steady
FALLS, SEEN = 5.0, (5.0, 15.0, 40.0)  # days: of the reservoir's fall; after it began, when the free surface is drawn


@dataclass
class Dam:
    """Flows, corners and pressures in steady flow and at each of `SEEN`.

    flows: (2,), m^2/s, out of both slopes; frames: corners (n, 4, 2), m, and pressures (n,), Pa.
    """

    flows: list[np.ndarray] = field(default_factory=list)
    frames: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    balance: float = 0.0
    wall: float = 0.0
    steps: int = 0

    def run(self, simulation: mpm.Simulation, days: float, steps: int) -> None:
        """Run for so many days more, in equal steps."""
        result = simulation.run(simulation.t + days * DAY, days * DAY / steps, progress=False)
        self.wall, self.steps = self.wall + result.wall, self.steps + result.steps
        self.balance = max(self.balance, result.balance)

    def see(self, simulation: mpm.Simulation) -> None:
        """Keep the present flows, corners and pressures."""
        self.flows.append(simulation.outflows.array)
        self.frames.append((simulation.points.corners.copy(), simulation.points.pressure))


def run(h: float = 0.5, steps: int = 10) -> Dam:
    """Lower the reservoir of the dam on cells of size h, m, in so many steps of each length, and of the fall."""
    grid = mpm.Grid([0, 0], [BASE + 2, HEIGHT + 1], np.rint(np.array([BASE + 2, HEIGHT + 1]) / h).astype(int))

    def trapezoid(X: np.ndarray) -> np.ndarray:
        wide = 1 - 2 * SLOPE * X[:, 1] / BASE
        return np.stack([1 + BASE / 2 + (X[:, 0] - BASE / 2) * wide, X[:, 1]], axis=1)

    body = mpm.mapped(grid, mpm.box(grid, [0, 0], [BASE, HEIGHT]), trapezoid)
    law = mpm.unsaturated(0.5 * WEIGHT * h, specific_yield=YIELD)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=CONDUCTIVITY, conductivity_law=law)

    def conditions(level: float | Callable[[float], float]) -> dict:
        load, head = mpm.water("left", level)
        return {"conditions": [load, head, mpm.Drained("right", seepage=True)]}

    simulation = mpm.Simulation(
        grid,
        [body],
        [soil],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(LEVELS[0]),
        initial_stress=mpm.K0(0.5, surcharge=lambda x: WEIGHT * np.maximum(LEVELS[0] - x[:, 1], 0)),
        numerics=mpm.Numerics(method="backward-euler"),
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
    """Return the flow through a rectangular dam, so many cells high, over the exact one."""
    upper, lower, width, top, k = 10.0, 2.0, 9.6, 12.0, 1e-5
    h = top / cells
    grid = mpm.Grid([0, 0], [width + 2 * h, top + 2 * h], [round(width / h) + 2, cells + 2])
    law = mpm.unsaturated(0.5 * WEIGHT * h)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=k, conductivity_law=law)
    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, [h, 0], [width + h, top])],
        [soil],
        fluid=mpm.Fluid(),
        walls={"bottom": "xy"},
        conditions=[mpm.water("left", upper)[1], mpm.water("right", lower)[1]],
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(upper),
    )
    simulation.run(600.0, 20.0, progress=False)
    return float(simulation.outflows["drained_right"] / (k * (upper**2 - lower**2) / (2 * width)))


def drained(cells: int, k: float = 1e-5) -> float:
    """Return the outflow of a column of 10 m over the exact one as its free surface falls; cells over its height.

    With the heads h of the free surface and H at the base, dh/dt = -k (1 - H / h) / (specific yield).
    """
    high, low, head, h = 8.0, 4.0, 2.0, 10.0 / cells
    grid = mpm.Grid([0, 0], [h, 10.0 + h], [1, cells + 1])
    law = mpm.unsaturated(0.5 * WEIGHT * h, specific_yield=YIELD)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=k, conductivity_law=law)
    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [h, 10])],
        [soil],
        fluid=mpm.Fluid(),
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[mpm.Drained("bottom", WEIGHT * head)],
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(high),
        initial_stress=mpm.K0(0.5),
        numerics=mpm.Numerics(method="backward-euler"),
    )
    time = YIELD / k * (high - low + head * np.log((high - head) / (low - head)))
    lost, steps = [], 40
    simulation.run(time, time / steps, progress=False, observe=lambda s: lost.append(s.outflows["drained_bottom"]))
    return float(sum(lost) * time / steps / (YIELD * h * (high - low)))


def main(argv: list[str] | None = None) -> dict:
    """Run the demo; return the results of --json."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--h", type=float, default=0.5, help="cell size, m")
    parser.add_argument("--steps", type=int, default=10, help="steps of each length, and of the fall")
    parser.add_argument(
        "--cells", type=int, default=40, help="cells over the height of the rectangular dam, and of the column"
    )
    o = parser.parse_args(argv)
    if not 0.1 <= o.h <= 1 or o.steps < 1 or not 10 <= o.cells <= 200:
        parser.error(f"--h {o.h} --steps {o.steps} --cells {o.cells}: must be 0.1 to 1 m, >= 1, and 10 to 200")
    with common.results(o) as out:
        flow = rectangular(o.cells)
        print(f"rectangular dam, {o.cells} cells high: flow over the exact one {flow:.4f}", flush=True)
        column = drained(o.cells)
        print(f"column, {o.cells} cells high: water lost over the exact one {column:.4f}", flush=True)
        dam = run(o.h, o.steps)
        flows = (
            [f"{day:g}", *(f"{q:.3e}" for q in (-q[0], q[1]))] for day, q in zip((0, *SEEN), dam.flows, strict=True)
        )
        common.table([["days of drawdown", "flow in (m²/s)", "flow out (m²/s)"], *flows])
        steady = float(-dam.flows[0][0] / dam.flows[0][1])
        draw(o, dam)
        print(f"{dam.steps} steps, {dam.wall:.1f} s, fluid balance {dam.balance:.1e}")
        out |= {"flow": flow, "drained": column, "balance": dam.balance, "steady": steady, "wall_s": dam.wall}
    return out


def draw(o: Namespace, dam: Dam) -> None:
    """Draw pressures in steady flow, and all free surfaces."""
    fig, axes = common.figure(2, 1, (9, 4.9))
    (corners, p), ax = dam.frames[0], axes[0, 0]
    domains = common.domains(ax, corners, p / 1e3, cmap="viridis", clim=(0, WEIGHT * LEVELS[0] / 1e3))
    fig.colorbar(domains, ax=ax, label="pore pressure (kPa)", shrink=0.8)
    axes[1, 0].plot(*np.array([[1, 0], [13, HEIGHT], [16, HEIGHT], [28, 0], [1, 0]]).T, color="grey", lw=0.8)
    for k, (day, (corners, p)) in enumerate(zip((0.0, *SEEN), dam.frames, strict=True)):
        for ax in axes[:, 0] if k == 0 else axes[1:, 0]:
            level, color = np.interp(day, [0, FALLS], LEVELS), "w" if ax is axes[0, 0] else f"C{k}"
            ax.tricontour(*corners.mean(axis=1).T, p, levels=[0.0], colors=color, linewidths=1.5)
            ax.plot([0, 1 + SLOPE * level], [level, level], color=f"C{k}", label=f"{day:g}")
            ax.set(aspect="equal", xlim=(0, BASE + 2), ylim=(0, HEIGHT + 0.5), xlabel="x (m)", ylabel="y (m)")
    axes[0, 0].set_title("steady seepage through the dam; white: its free surface, p = 0")
    axes[1, 0].set_title("free surfaces as the reservoir falls by 2 m in 5 days")
    axes[1, 0].legend(title="days", fontsize=9, loc="upper right")
    common.save(fig, o.out / "dam.png")


if __name__ == "__main__":
    main()
