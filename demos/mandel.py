# SPDX-License-Identifier: MIT
"""Mandel's slab is compressed between rigid plates; the pore pressure in its middle rises before it decreases.

A saturated slab between rigid, smooth, impervious plates carries a force from the first step on. The free sides of the
slab drain and soften first, so the plates load the middle more. The pressure in the middle therefore rises above its
initial value p0 = force / (2a). By symmetry a quarter of the slab is computed, a = 1 m wide and 1 m high, in plane
strain. Poisson's ratio is 0.2, and water and grains are incompressible. The mean strain is 1e-5, so small-strain theory
is accurate. Displacements are linear in y, so few cells over the height suffice. The reduced time is `T = c t / a²`,
with `c = kappa (K + 4G/3)`. Here t is the time, kappa the mobility, K the bulk modulus and G the shear modulus. Source:
Mandel (1953); Abousleiman, Cheng, Cui, Detournay and Roegiers (1996), Géotechnique 46. The demo runs on one process.

Errors:

* `p_0.01`, `p_0.1`, `p_0.5`, `p_1`: largest error of the pressure at this T, multiplied by a / force.
* `p_max`: relative error of the highest pressure in the innermost cell, which occurs at T = 0.07.
* `p_rise`: relative error of the difference between the highest pressure and p0.
* `settlement`: largest relative error of the plate's settlement at T = 0.01, 0.1, 0.5 and 1.

Most of the error is spatial, and decreases with the square of the cell size.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.exact import Mandel

WIDTH, HEIGHT, STRAIN = 1.0, 1.0, 1e-5  # m, m, -
SAMPLES = (0.01, 0.1, 0.5, 1.0)  # reduced times T at which stages of equal steps end
SHEAR, NU = 5e6, 0.2  # Pa, -
SOIL = mpm.LinearElastic(bulk=2 / 3 * SHEAR * (1 + NU) / (1 - 2 * NU), shear=SHEAR, conductivity=1e-4)
WATER = mpm.Fluid(bulk=np.inf)
FORCE = 2 * SHEAR * STRAIN * WIDTH  # N/m
EXACT = Mandel(WIDTH, HEIGHT, SOIL.bulk, SHEAR, SOIL.conductivity / WATER.unit_weight, 0.0, 1.0, FORCE)


@dataclass
class Outcome:
    """Results of a run, with an entry for each step.

    time: reduced time T.
    x, p (columns, rows): positions (m) and pressures (Pa) of the cells.
    settlement: settlements at eleven positions on the top, from the middle to the side, in m.
    """

    time: list[float] = field(default_factory=list)
    x: list[np.ndarray] = field(default_factory=list)
    p: list[np.ndarray] = field(default_factory=list)
    settlement: list[np.ndarray] = field(default_factory=list)
    stages: list[mpm.Result] = field(default_factory=list)

    def at(self, time: float) -> int:
        """Return the index of the step that ends nearest to a reduced time."""
        return int(np.argmin(np.abs(np.array(self.time) - time)))


def run(cells: int = 40, steps: int = 30, method: str = "sdirk2") -> tuple[dict[str, float], Outcome]:
    """Consolidate the quarter until T = 1, with `steps` equal steps between successive times in `SAMPLES`.

    Returns the errors by name, and the histories.
    """
    rows = max(1, cells // 4)  # the solution is linear in y
    grid = mpm.Grid([0, 0], [WIDTH + WIDTH / cells, HEIGHT], [cells + 1, rows])  # the slab bulges into the last column
    quarter = mpm.box(grid, [0, 0], [WIDTH, HEIGHT], per_cell=2)
    simulation = mpm.Simulation(
        grid,
        [quarter],
        [SOIL],
        fluid=WATER,
        walls={"left": "x", "bottom": "y"},
        conditions=[mpm.RigidPlate("top", FORCE), mpm.Drained("right")],
        numerics=mpm.Numerics(method=method),
    )
    top = mpm.probes([quarter], [[x, HEIGHT] for x in np.linspace(0, WIDTH, 11)])
    out = Outcome()
    lattice = (cells, 2, rows, 2)  # a cell holds two columns and two rows of points

    def observe(s: mpm.Simulation) -> None:
        out.time.append(EXACT.cv * s.t / WIDTH**2)
        out.x.append(s.points.x[:, 0].reshape(lattice).mean(axis=(1, 3)))
        out.p.append(s.points.pressure.reshape(lattice).mean(axis=(1, 3)))

    for start, end in zip((0.0, *SAMPLES), SAMPLES, strict=False):
        unit = WIDTH**2 / EXACT.cv
        out.stages.append(simulation.run(end * unit, (end - start) * unit / steps, probes=top, observe=observe))
        out.settlement += [-u[:, 1] for u in out.stages[-1].displacement[1:]]
    return errors(out), out


def exact_peak(x: float) -> float:
    """Return the largest exact pressure over all times at a position, in Pa."""
    return float(EXACT.pressure(x, np.geomspace(1e-3, 1, 5001) * WIDTH**2 / EXACT.cv).max())


def errors(out: Outcome) -> dict[str, float]:
    """Return the errors by name; the docstring of this file explains the names."""
    found, settlement = {}, []
    for k in map(out.at, SAMPLES):
        t = out.time[k] * WIDTH**2 / EXACT.cv
        error = np.abs(out.p[k] - EXACT.pressure(out.x[k], t)).max()
        found[f"p_{out.time[k]:.3g}"] = float(error * WIDTH / FORCE)
        settlement.append(np.abs(out.settlement[k] / -EXACT.displacement(0.0, HEIGHT, t)[1] - 1).max())
    peak, exact, p0 = max(p[0, 0] for p in out.p), exact_peak(out.x[0][0, 0]), FORCE / (2 * WIDTH)
    found |= {"p_max": abs(peak / exact - 1), "p_rise": abs((peak - p0) / (exact - p0) - 1)}
    return {name: float(e) for name, e in (found | {"settlement": max(settlement)}).items()}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=40, help="cells over the width; over the height: a quarter")
    parser.add_argument("--steps", type=int, default=30, help="equal steps to each of T = 0.01, 0.1, 0.5, 1")
    o = parser.parse_args(argv)
    if o.cells < 1 or o.steps < 1:
        parser.error(f"--cells {o.cells} --steps {o.steps}: must be >= 1")
    with common.results(o) as out:
        found, outcome = run(o.cells, o.steps)
        out |= {"errors": found, "wall_s": sum(stage.wall for stage in outcome.stages)}
        print(f"{o.cells} cells, {4 * o.steps} steps, {out['wall_s']:.1f} s")
        of = {name: "force / a" if name[2:3].isdigit() else "exact value" for name in found}
        common.table([["error", "", "scale"], *([name, f"{error:.3%}", of[name]] for name, error in found.items())])
        draw(o, outcome)
    return out


def draw(o: Namespace, out: Outcome) -> None:
    """Draw pressures against x and against time, with the exact curves."""
    fig, ((left, right),) = common.figure(1, 2, (11, 4.6))
    unit, scale, x = WIDTH**2 / EXACT.cv, FORCE / WIDTH, np.linspace(0, WIDTH, 201)
    for i, k in enumerate(map(out.at, SAMPLES)):
        left.plot(x, EXACT.pressure(x, out.time[k] * unit) / scale, "k", lw=1, label=None if i else "exact")
        left.plot(out.x[k][:, 0], out.p[k][:, 0] / scale, "o", ms=4, color=f"C{i}", label=f"T = {out.time[k]:.3g}")
    left.set(xlabel="distance from the middle / a (-)", ylabel="pore pressure · a / force (-)")
    left.set(xlim=(0, 1), ylim=(0, 0.75), title="Pore pressure in the lowest row of cells")
    left.legend(loc="upper center", ncols=3)
    time, centre = np.geomspace(1e-4, 1, 501), out.x[0][0, 0]
    right.semilogx(time, EXACT.pressure(centre, time * unit) / scale, "k", lw=1, label="exact")
    shown = np.unique([out.at(t) for t in np.geomspace(1e-4, 1, 60)])
    right.semilogx(
        [out.time[k] for k in shown], [out.p[k][0, 0] / scale for k in shown], "o", ms=3, label="innermost cell"
    )
    right.axhline(0.5, color="gray", lw=1, ls="--", label="at the moment of loading")
    right.set(xlabel="reduced time T (-)", ylabel="pore pressure · a / force (-)", title="Mandel-Cryer effect")
    right.set(xlim=(1e-4, 1.1), ylim=(0, 0.75))
    right.legend(loc="lower left")
    for ax in (left, right):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "mandel.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
