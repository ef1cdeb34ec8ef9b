# SPDX-License-Identifier: MIT
"""A dam: seepage with a free surface, as the reservoir falls.

A dam of 6 m with slopes of 1:2 on an impervious base.  It begins at rest, with the water of its pores level with the
reservoir, 5 m.  Then its other slope is opened, and the reservoir falls by a metre at a time, with a while for the flow
to settle in steps that grow: soil that a large step dries hardly conducts, and stays dry.  Water flows below the free
surface only (`mpm.unsaturated`); the reservoir presses on the slope that it wets, and both slopes are seepage faces
above it.  The soil is hard, so that times are short: pores count as full above the free surface too, and what drains as
that falls is not in the model.

Check: `flow`, what leaves a rectangular dam (10 m and 2 m of water at its sides, 9.6 m wide) over the exact
k (H1^2 - H2^2) / (2 L) of Dupuit and Charny, whatever its free surface is; and `steady`, what enters the dam over what
leaves it, at the highest level.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np

import mpm_dolfinx as mpm

HEIGHT, CREST, SLOPE = 6.0, 3.0, 2.0  # m, m, run over rise
BASE = CREST + 2 * SLOPE * HEIGHT
LEVELS = (5.0, 4.0, 3.0)  # m: of the reservoir
WEIGHT, CONDUCTIVITY = 9810.0, 1e-6  # N/m^3, m/s
STEPS = (1.0, 10.0, 100.0, 1000.0)  # s: at each level


@dataclass
class Dam:
    """What has been seen at each level: flows at both slopes (m^2/s), corners (n, 4, 2), m, and pressures (n,), Pa."""

    flows: list[np.ndarray] = field(default_factory=list)
    frames: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    balance: float = 0.0
    wall: float = 0.0
    steps: int = 0


def run(h: float = 0.5, steps: int = 15) -> Dam:
    """Lower the reservoir of the dam on cells of size h, m, in so many steps of each length at each level."""
    grid = mpm.Grid([BASE + 2, HEIGHT + 1], np.rint(np.array([BASE + 2, HEIGHT + 1]) / h).astype(int))

    def trapezoid(X: np.ndarray) -> np.ndarray:
        wide = 1 - 2 * SLOPE * X[:, 1] / BASE
        return np.stack([1 + BASE / 2 + (X[:, 0] - BASE / 2) * wide, X[:, 1]], axis=1)

    body = mpm.mapped(grid, mpm.box(grid, [0, 0], [BASE, HEIGHT]), trapezoid)
    law = mpm.unsaturated(0.5 * WEIGHT * h)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=CONDUCTIVITY, conductivity_law=law)

    def conditions(level: float) -> dict:
        load, head = mpm.water("left", level)
        return {"tractions": [load], "drained": [head, mpm.Drained("right", seepage=True)]}

    simulation = mpm.Simulation(
        grid,
        [body],
        [soil],
        fluid=mpm.Fluid(),
        fixed={"bottom": "xy"},
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(LEVELS[0]),
        initial_stress=mpm.K0(0.5, surcharge=lambda x: WEIGHT * np.maximum(LEVELS[0] - x[:, 1], 0)),
        method="backward-euler",
        **conditions(LEVELS[0]),
    )
    out = Dam()
    for level in LEVELS:
        simulation.stage(**conditions(level))
        for dt in STEPS:
            result = simulation.run(simulation.t + steps * dt, dt, progress=False)
            out.wall, out.steps = out.wall + result.wall, out.steps + result.steps
            out.balance = max(out.balance, result.balance)
        out.flows.append(simulation.outflows.copy())
        out.frames.append((simulation.points.corners.copy(), simulation.points.pressure))
    return out


def rectangular(cells: int) -> float:
    """Return the flow through a rectangular dam, so many cells high, over the exact one."""
    upper, lower, width, top, k = 10.0, 2.0, 9.6, 12.0, 1e-5
    h = top / cells
    grid = mpm.Grid([width + 2 * h, top + 2 * h], [round(width / h) + 2, cells + 2])
    law = mpm.unsaturated(0.5 * WEIGHT * h)
    soil = mpm.LinearElastic(bulk=1e9, shear=5e8, porosity=0.3, conductivity=k, conductivity_law=law)
    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, [h, 0], [width + h, top])],
        [soil],
        fluid=mpm.Fluid(),
        fixed={"bottom": "xy"},
        drained=[mpm.water("left", upper)[1], mpm.water("right", lower)[1]],
        gravity=(0, -9.81),
        pressure=mpm.hydrostatic(upper),
    )
    simulation.run(600.0, 20.0, progress=False)
    return float(simulation.outflows[1] / (k * (upper**2 - lower**2) / (2 * width)))


def main(argv: list[str] | None = None) -> dict:
    """Run the demo; return what --json prints."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--h", type=float, default=0.5, help="cell size, m")
    parser.add_argument("--steps", type=int, default=15, help="steps of each length at each level")
    parser.add_argument("--cells", type=int, default=40, help="cells over the height of the rectangular dam")
    o = parser.parse_args(argv)
    if not 0.1 <= o.h <= 1 or o.steps < 1 or not 10 <= o.cells <= 200:
        parser.error(f"--h {o.h} --steps {o.steps} --cells {o.cells}: must be 0.1 to 1 m, >= 1, and 10 to 200")
    with common.results(o) as out:
        flow = rectangular(o.cells)
        print(f"rectangular dam, {o.cells} cells high: flow over the exact one {flow:.4f}", flush=True)
        dam = run(o.h, o.steps)
        flows = (
            [f"{level:g}", *(f"{q:.3e}" for q in (-q[0], q[1]))] for level, q in zip(LEVELS, dam.flows, strict=True)
        )
        common.table([["reservoir at (m)", "flow in (m²/s)", "flow out (m²/s)"], *flows])
        steady = float(-dam.flows[0][0] / dam.flows[0][1])
        draw(o, dam)
        print(f"{dam.steps} steps, {dam.wall:.1f} s, fluid balance {dam.balance:.1e}")
        out |= {"flow": flow, "balance": dam.balance, "steady": steady, "wall_s": dam.wall}
    return out


def draw(o: Namespace, dam: Dam) -> None:
    """Draw pressures at the highest level, and the free surfaces of all."""
    fig, axes = common.figure(2, 1, (9, 6))
    (corners, p), ax = dam.frames[0], axes[0, 0]
    domains = common.domains(ax, corners, p / 1e3, cmap="viridis", clim=(0, WEIGHT * LEVELS[0] / 1e3))
    fig.colorbar(domains, ax=ax, label="pore pressure (kPa)", shrink=0.8)
    axes[1, 0].plot(*np.array([[1, 0], [13, HEIGHT], [16, HEIGHT], [28, 0], [1, 0]]).T, color="grey", lw=0.8)
    for k, (level, (corners, p), flows) in enumerate(zip(LEVELS, dam.frames, dam.flows, strict=True)):
        for ax in axes[:, 0] if k == 0 else axes[1:, 0]:
            color = "w" if ax is axes[0, 0] else f"C{k}"
            ax.tricontour(*corners.mean(axis=1).T, p, levels=[0.0], colors=color, linewidths=1.5)
            ax.plot([0, 1 + SLOPE * level], [level, level], color=f"C{k}", label=f"{1e6 * flows[1]:.2f}")
            ax.set(aspect="equal", xlim=(0, BASE + 2), ylim=(0, HEIGHT + 0.5), xlabel="x (m)", ylabel="y (m)")
    axes[0, 0].set_title("seepage through the dam; white: its free surface, p = 0")
    axes[1, 0].set_title("free surfaces as the reservoir falls")
    axes[1, 0].legend(title="10⁻⁶ m²/s seep out", fontsize=9, loc="upper right")
    common.save(fig, o.out / "dam.png")


if __name__ == "__main__":
    main()
