# SPDX-License-Identifier: MIT
"""Terzaghi's consolidation: a saturated layer is loaded suddenly and drains at its top.

A column of 1 m between smooth walls, impervious at its foot, carries a load p0 from the first step on. At first the
incompressible pore water carries the whole load. As water drains, the load is transferred to the skeleton. The pore
pressure p at depth z and time t follows `dp/dt = c_v d²p/dz²`. The coefficient of consolidation is
`c_v = kappa (K + 4G/3)`, with the mobility kappa, the bulk modulus K and the shear modulus G. The load strains the
skeleton by 1e-5, so small-strain theory is accurate. The reduced time is `T_v = c_v t / height²`. Source: Terzaghi
(1923); series in Verruijt, Theory and Problems of Poroelasticity (2016). The demo runs on one process.

Errors of the pressure are given at T_v = 0.1, 0.5 and 1. Each is the largest error of all cells, divided by p0.
`settlement` is the relative error of the settlement at T_v = 0.5. Steps are equal, or adaptive with --rtol.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.base.time_integration import METHODS
from mpm_dolfinx.verification.exact import terzaghi_consolidation, terzaghi_pressure

HEIGHT = 1.0  # m
SAMPLES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # T_v of the curves in the picture
SOIL = mpm.LinearElastic(bulk=1e7 / 3, shear=5e6, porosity=0.4, conductivity=1e-4)
WATER = mpm.Fluid(bulk=np.inf)
CV = SOIL.conductivity / WATER.unit_weight * SOIL.oedometric  # m²/s


@dataclass
class Outcome:
    """Results at each output time: T_v, depths and pressures of the cells, and settlement.

    Depths are divided by the height, pressures by p0, and settlements by the final settlement.
    """

    result: mpm.Result
    time: list[float] = field(default_factory=list)
    z: list[np.ndarray] = field(default_factory=list)
    p: list[np.ndarray] = field(default_factory=list)
    settlement: list[float] = field(default_factory=list)

    def at(self, time: float) -> int:
        """Return the index of the output time nearest to a reduced time."""
        return int(np.argmin(np.abs(np.array(self.time) - time)))


def run(
    cells: int = 50, steps: int = 100, strain: float = 1e-5, method: str = "sdirk2", rtol: float | None = None
) -> Outcome:
    """Consolidate a column of `cells` cells to T_v = 1, in adaptive steps if `rtol` is given."""
    h, load = HEIGHT / cells, strain * SOIL.oedometric
    grid = mpm.Grid([0, 0], [h, HEIGHT], [1, cells])
    column = mpm.box(grid, [0, 0], [h, HEIGHT], per_cell=2)
    simulation = mpm.Simulation(
        grid,
        [column],
        [SOIL],
        fluid=WATER,
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[mpm.Traction("top", (0, -load)), mpm.Drained("top")],
        numerics=mpm.Numerics(method=method),
    )
    out = Outcome(mpm.Result())
    lattice = (2, cells, 2)  # the four points of a cell: two columns, two rows

    def observe(s: mpm.Simulation) -> None:
        out.time.append(CV * s.t / HEIGHT**2)
        out.z.append(1 - s.points.x[:, 1].reshape(lattice).mean(axis=(0, 2)) / HEIGHT)
        out.p.append(s.points.pressure.reshape(lattice).mean(axis=(0, 2)) / load)

    t_end, top = HEIGHT**2 / CV, mpm.probes([column], [[h / 2, HEIGHT]])
    times = {"dt": t_end / steps} if rtol is None else {"rtol": rtol, "t_eval": np.multiply(SAMPLES, t_end)}
    out.result = simulation.run(t_end, **times, probes=top, observe=observe)
    out.settlement = [-u[0, 1] / (strain * HEIGHT) for u in out.result.displacement[1:]]
    return out


def errors(out: Outcome) -> dict[str, float]:
    """Return the errors by name; the docstring of this file explains the names."""
    found = {}
    for time in (0.1, 0.5, 1.0):
        k = out.at(time)
        found[f"p_{time:g}"] = float(np.abs(out.p[k] - terzaghi_pressure(out.z[k], out.time[k], 1.0, 1.0)).max())
    k = out.at(0.5)
    found["settlement"] = float(abs(out.settlement[k] / terzaghi_consolidation(out.time[k], 1.0, 1.0) - 1))
    return found


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=50, help="cells over the height")
    parser.add_argument("--steps", type=int, default=100, help="equal steps to T_v = 1")
    parser.add_argument("--rtol", type=float, help="tolerance of adaptive steps, instead of equal steps")
    parser.add_argument("--method", choices=tuple(METHODS), default="sdirk2", help="time integration")
    o = parser.parse_args(argv)
    if o.cells < 1 or o.steps < 10:
        parser.error(f"--cells {o.cells}: must be >= 1; --steps {o.steps}: must be >= 10")
    with common.results(o) as out:
        outcome = run(o.cells, o.steps, method=o.method, rtol=o.rtol)
        out |= {"errors": errors(outcome), "steps": outcome.result.steps, "wall_s": outcome.result.wall}
        print(f"{o.cells} cells, {out['steps']} steps, {out['wall_s']:.1f} s")
        scales = {"p_0.1": "p0", "p_0.5": "p0", "p_1": "p0", "settlement": "exact value"}
        common.table(
            [["error", "", "scale"], *([name, f"{out['errors'][name]:.4%}", of] for name, of in scales.items())]
        )
        draw(o, outcome)
    return out


def draw(o: Namespace, out: Outcome) -> None:
    """Draw pressure against depth and settlement against time, with the exact curves."""
    fig, ((left, right),) = common.figure(1, 2, (11, 4.6))
    z = np.linspace(0, 1, 201)
    for i, time in enumerate(SAMPLES):
        k = out.at(time)
        left.plot(terzaghi_pressure(z, out.time[k], 1.0, 1.0), z, color="black", lw=1, label=None if i else "exact")
        left.plot(out.p[k], out.z[k], "o", ms=3, color=f"C{i}", label=f"$T_v$ = {out.time[k]:.3g}")
    left.set(xlabel="pore pressure / load (-)", ylabel="depth / height (-)", title="Pore pressure in the cells")
    left.set(xlim=(-0.02, 1.4), ylim=(1, 0))
    left.legend(loc="upper right")
    time = np.linspace(1e-4, 1, 501)
    right.plot(time, terzaghi_consolidation(time, 1.0, 1.0), color="black", lw=1, label="exact")
    every = max(1, len(out.time) // 40)
    right.plot(out.time[::every], out.settlement[::every], "o", ms=3, label="material points")
    right.set(xlabel="reduced time $T_v$ (-)", ylabel="settlement / final settlement (-)")
    right.set(xlim=(0, 1), ylim=(1, 0), title="Settlement of the top")
    right.legend()
    for ax in (left, right):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "terzaghi.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
