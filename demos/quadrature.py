# SPDX-License-Identifier: MIT
"""Exact integration over particle domains: tip deflection of the drained beam for different numbers of load steps.

The beam of `poroelastic_beam.py` without water takes its whole load in n equal steps. The material is elastic, so the
deflection must not depend on n. With integration over the exact pieces of the domains, the deflection is independent of
n. With integration at the points, as in standard MPM, the error grows each time a point enters another cell. The finite
element reference takes the load in ten steps.
"""

from __future__ import annotations

import sys
from argparse import Namespace

import common
import numpy as np
import poroelastic_beam as beam

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

PROBE = np.array([[beam.LENGTH, beam.HEIGHT / 2]])


def tip(h: float, steps: int, quadrature: str) -> tuple[float, float]:
    """Return the deflection of the tip (m) and the run time (s); the deflection of a failed run is nan."""
    o = options(h, steps, quadrature)
    simulation, bottom = beam.scene(o)
    try:
        result = simulation.run(1.0, o.dt, probes=mpm.probes(simulation.bodies, np.add(PROBE, [0, bottom])))
    except mpm.GaveUp as error:
        print(f"{quadrature}, {steps} steps: {error}", file=sys.stderr)
        return np.nan, error.result.wall
    return float(result.displacement[-1][0, 1]), result.wall


def options(h: float, steps: int, quadrature: str = "domain") -> Namespace:
    """Return the beam's options for a drained run in equal steps."""
    command = f"--drained --ramp 1 --t-end 1 --dt {1 / steps} --h {h} --quadrature {quadrature}"
    return beam.arguments(command.split())


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--h", type=float, default=0.015, help="cell size, m")
    parser.add_argument("--steps", type=int, nargs="+", default=[10, 20, 40, 80, 160], help="numbers of load steps")
    o = parser.parse_args(argv)
    with common.results(o) as out:
        ten = options(o.h, 10)
        fem = BiotFEM(
            mpm.Grid([0, 0], [beam.LENGTH, beam.HEIGHT], beam.REFERENCE_CELLS), beam.material(ten), **beam.physics(ten)
        )
        exact = float(fem.run(1.0, 0.1, probes=PROBE).displacement[-1][0, 1])
        runs = {q: [tip(o.h, n, q) for n in o.steps] for q in ("domain", "point")}
        tips = {q: [u for u, _ in run] for q, run in runs.items()}
        rows = [["load steps", "tip, domains (m)", "to FEM", "tip, points (m)", "to FEM"]]
        for n, pair in zip(o.steps, zip(*tips.values(), strict=True), strict=True):
            rows.append([str(n), *(x for u in pair for x in (f"{u:.5f}", f"{u / exact - 1:+.3%}"))])
        common.table([*rows, ["FEM", f"{exact:.5f}", "", "", ""]])
        head = ["steps", "domain_m", "domain_s", "point_m", "point_s", "fem_m"]
        numbers = ([n, *d, *p, exact] for n, d, p in zip(o.steps, *runs.values(), strict=True))
        common.write_csv(o.out / "tip.csv", head, numbers)
        draw(o, tips, exact)
        out |= {"steps": o.steps, **tips, "fem": exact, "converged": bool(np.isfinite(tips["domain"]).all())}
    return out


def draw(o: Namespace, tips: dict[str, list[float]], exact: float) -> None:
    """Draw the tip deflection against the number of steps."""
    fig, ((ax,),) = common.figure(1, 1, (7, 4.2))
    ax.axhline(exact, color="black", lw=1, label="Taylor-Hood FEM")
    ax.plot(o.steps, tips["domain"], "o-", label="exact integration over particle domains")
    ax.plot(o.steps, tips["point"], "s--", color="C3", label="standard MPM, point quadrature")
    failed = [n for n, u in zip(o.steps, tips["point"], strict=True) if not np.isfinite(u)]
    if failed:
        level = np.nanmin(tips["point"]) if np.isfinite(tips["point"]).any() else 1.2 * exact
        ax.plot(failed, [level] * len(failed), "x", color="C3", ms=9, label="standard MPM: gave up")
    ax.set(xscale="log", xlabel="number of load steps", ylabel="deflection of the tip (m)")
    ax.set_xticks(o.steps, [str(n) for n in o.steps])
    ax.minorticks_off()
    ax.set_title("Drained beam: tip deflection against the number of load steps")
    ax.legend()
    ax.grid(alpha=0.3)
    common.save(fig, o.out / "quadrature.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
