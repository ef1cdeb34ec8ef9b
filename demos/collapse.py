# SPDX-License-Identifier: MIT
"""Columns of dry sand collapse: run-out and height against published experiments, and energies.

A column of width L and height a L stands on a rough floor against a smooth wall, with a = 0.5, 1, 4 and 8. The right
side of the column is released suddenly. In the experiments of Lube, Huppert, Sparks and Freundt (2005) with sand, sugar
and rice, the front moves by 1.2 a L for a < 1.8, and by 1.9 a^(2/3) L for a > 2.8. The angles of repose are near 31
degrees.

The sand follows the Mohr-Coulomb law without dilation. In simple shear its strength is sin(phi) times the normal stress
(Davis 1968), so sin(phi) = tan(31 degrees). In fast flow the friction coefficient increases by 0.26 I / (I_0 + I), with
the inertial number I and I_0 = 0.279 (Jop, Forterre and Pouliquen 2006). With the secant at I = I_0, this increase is
equivalent to a viscosity of `0.47 d sqrt(p rho_s)`, with the grain size d = L/100, the pressure p and the grain density
rho_s. In the demo the viscosity is constant, and p is the pressure in the middle of a heap half as high as the column.
With a constant viscosity, run-outs are as accurate as with a local viscosity (Ionescu, Mangeney, Bouchut and Roche
2015). With the slope at I = 0, the viscosity is twice as large, and run-outs are 12 to 18 % too short for a = 1 and 4.
Without viscosity, shear localises in single cells. The front is the point at which the depth of the sand is one grain.

Sand that lands on the floor stops above it, by a tenth to a fifth of a cell. Cells next to the floor therefore have a
quarter of the height of other cells.

Sources: Lube, Huppert, Sparks and Freundt (2005), Phys. Rev. E 72, 041301, as in Lagree, Staron and Popinet (2011), J.
Fluid Mech. 686, 378.
"""

from __future__ import annotations

from argparse import Namespace
from typing import NamedTuple

import common
import numpy as np

import mpm_dolfinx as mpm

GRAVITY, DENSITY, REPOSE = 9.81, 1560.0, np.radians(31.0)  # m/s², kg/m³, -
STIFF, COHESION = 200.0, 1e-3  # Young's modulus and cohesion, divided by rho g H
GRAIN, RISE = 0.01, (0.64 - 0.38) / (2 * 0.279)  # m; (mu_2 - mu_s) / (2 I_0) of Jop et al.
FALLS, SHOWN = 3.5, np.array([0.5, 1.0, 1.5, 2.0])  # duration, and times of the profiles, in units of sqrt(H/g)
CELLS = {0.5: 16, 1.0: 12, 4.0: 6, 8.0: 6}  # cells over the width, for each aspect ratio
SCATTER, BALANCE = 0.15, 0.015  # allowed errors: of the run-out; of the energy balance, relative to the weight's work
STEPS = 50  # in the time sqrt(H/g)


class Heap(NamedTuple):
    """Results for a column; `run_out` and `height` are in m.

    lost: largest error of the energy balance, divided by the work of the weight.
    left: final kinetic energy, divided by the work of the weight.
    before, after: initial and final corners of the domains, in m.
    profiles: middles of vertical strips, and depths of sand in these strips, in m.
    """

    run_out: float
    height: float
    lost: float
    left: float
    before: np.ndarray
    after: np.ndarray
    profiles: list[tuple[np.ndarray, np.ndarray]]
    result: mpm.Result


def published(aspect: float) -> float:
    """Return the run-out according to Lube et al., divided by the width of the column."""
    return float(np.interp(aspect, (1.8, 2.8), (0, 1)) * (1.9 * aspect ** (2 / 3) - 1.2 * aspect) + 1.2 * aspect)


def column(aspect: float, cells: int, grain: float = GRAIN, renewal: bool = False) -> mpm.Simulation:
    """Return a column at rest, 1 m wide, with `cells` cells over the width.

    grain: grain size, in m; zero means no viscosity.
    renewal: whether long particle domains are replaced by new domains.
    """
    h, reach = 1 / cells, np.ceil(1.4 * published(aspect) + 2.5)
    rows = h * np.arange(1, round(aspect * cells) + 3)
    grid = mpm.Grid(lines=[np.linspace(0, reach, round(reach * cells) + 1), [0, h / 4, h / 2, *rows]])
    weight = DENSITY * GRAVITY * aspect
    sand = mpm.MohrCoulomb(
        bulk=STIFF * weight / 1.2,
        shear=STIFF * weight / 2.6,
        friction=np.degrees(np.arcsin(np.tan(REPOSE))),
        dilation=0.0,
        cohesion=COHESION * weight,
        porosity=0.4,
        grain_density=DENSITY / 0.6,
    )
    gate = mpm.Displacement("right", (0, 0), "x")
    viscosity = RISE * grain * np.sqrt(DENSITY / 0.6 * weight / 4)
    options = {"walls": {"left": "x", "bottom": "xy"}, "gravity": (0, -GRAVITY), "inertia": False}
    options |= {"terms": [common.viscous(viscosity)] if grain else [], "numerics": mpm.Numerics(renewal=renewal)}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, aspect])], [sand], conditions=[gate], **options)
    s.run(1.0, 1.0, progress=False)
    s.stage(inertia=True, conditions=[])
    s.t = 0.0
    return s


def depths(s: mpm.Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return positions x, one grain apart and up to beyond the front, and the depths of sand at these positions, in m.

    A depth is the sum of the lengths in which a vertical line cuts the domains.
    """
    ring = s.points.corners[:, [0, 1, 3, 2]]
    x = np.arange(0, ring[:, :, 0].max() + 2 * GRAIN, GRAIN)
    out = np.zeros_like(x)
    for k in range(4):
        (ax, ay), (bx, by) = ring[:, k].T[:, :, None], ring[:, k - 1].T[:, :, None]
        cut, run = (ax <= x) != (bx <= x), bx - ax
        y = ay + (by - ay) * np.divide(x - ax, run, out=np.zeros(cut.shape), where=cut)
        out += (cut * np.sign(run) * y).sum(axis=0)
    return x, out


def collapsed(aspect: float, cells: int, steps: float, grain: float = GRAIN, renewal: bool = False) -> Heap:
    """Release a column and return its `Heap`.

    steps: number of steps in the time sqrt(H/g) for the height H.
    grain, renewal: see `column`.
    """
    s = column(aspect, cells, grain, renewal)
    fall = np.sqrt(aspect / GRAVITY)
    before, profiles = s.points.corners.copy(), []

    def look(s: mpm.Simulation) -> None:
        if np.abs(s.t - SHOWN * fall).min() < 0.5 * fall / steps:
            profiles.append(depths(s))

    result = s.run(FALLS * fall, fall / steps, energies=True, observe=look, progress=False)
    x, depth = depths(s)
    k = np.flatnonzero(depth > GRAIN).max()
    front = x[k] + (depth[k] - GRAIN) / (depth[k] - depth[k + 1]) * (x[k + 1] - x[k])
    e = result.energies
    work = e["external"][-1]
    shares = common.unbalanced(e) / work, e["kinetic"][-1] / work
    return Heap(front - 1, depth.max(), *shares, before, s.points.corners, profiles, result)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--aspects", type=float, nargs="+", default=list(CELLS), help="height-to-width ratios")
    parser.add_argument("--finer", type=float, default=1.0, help="factor for the number of cells over the width")
    parser.add_argument("--steps", type=float, default=STEPS, help="steps in the time sqrt(H/g)")
    parser.add_argument("--grain", type=float, default=GRAIN, help="grain size divided by the width; 0: no viscosity")
    parser.add_argument("--renewal", action="store_true", help="replace particle domains that are longer than a cell")
    o = parser.parse_args(argv)
    if not all(0.25 <= a <= 16 for a in o.aspects):
        parser.error(f"--aspects {o.aspects}: must be in [0.25, 16]")
    if not (0.5 <= o.finer <= 4 and 4 <= o.steps <= 400 and 0 <= o.grain <= 0.1):
        parser.error(
            f"--finer {o.finer:g} --steps {o.steps:g} --grain {o.grain:g}: not in [0.5, 4], [4, 400], [0, 0.1]"
        )
    with common.results(o) as out:
        rows, heaps = [], {}
        for a in o.aspects:
            cells = max(2, round(o.finer * CELLS[min(CELLS, key=lambda k: abs(np.log(k / a)))]))
            heaps[a] = one = collapsed(a, cells, o.steps, o.grain, o.renewal)
            off = one.run_out / published(a) - 1
            out[f"{a:g}"] = {"run_out": one.run_out, "off": off, "height": one.height, "lost": one.lost, "cells": cells}
            rows.append(
                [f"{a:g}", f"{cells}", f"{one.run_out:.2f}", f"{published(a):.2f}", f"{off:+.0%}", f"{one.lost:.1%}"]
            )
        common.table([["a", "cells", "run-out / L", "Lube et al.", "off", "energy lost"], *rows])
        within = all(abs(of["off"]) <= SCATTER and of["lost"] <= BALANCE for of in out.values())
        usual = (o.aspects, o.finer, o.steps, o.grain, o.renewal) == (list(CELLS), 1.0, STEPS, GRAIN, False)
        out["converged"] = within or not usual
        draw(o, heaps)
    return out


def draw(o: Namespace, heaps: dict[float, Heap]) -> None:
    """Draw a column in motion, the run-outs, and the energies."""
    fig, ((way, runs, energy),) = common.figure(1, 3, (15, 4))
    a = min(heaps, key=lambda a: abs(a - 1))
    one = heaps[a]
    moved = np.linalg.norm((one.after - one.before).mean(axis=1), axis=1)
    drawn = common.domains(way, one.after, moved, cmap="viridis")
    fig.colorbar(drawn, ax=way, label="displacement / L", shrink=0.6)
    way.plot([0, 1, 1], [a, a, 0], color="grey", lw=0.8)
    for x, depth in one.profiles:
        way.plot(x[depth > 0], depth[depth > 0], color="grey", lw=0.8)
    way.autoscale_view()
    way.set(xlabel="x / L", ylabel="y / L", aspect="equal", title=rf"$a$ = {a:g}; grey: every 0.5 $\sqrt{{H/g}}$")
    every = np.geomspace(0.4, 10, 100)
    law = np.array([published(each) for each in every])
    runs.fill_between(every, (1 - SCATTER) * law, (1 + SCATTER) * law, color="0.9")
    runs.loglog(every, law, "k--", lw=1, label="Lube et al. (2005), 15 %")
    runs.plot(list(heaps), [one.run_out for one in heaps.values()], "o", label="material points")
    runs.set(xlabel="height / width", ylabel="run-out / width", title="Run-out")
    runs.legend()
    e, t = heaps[a].result.energies, heaps[a].result.t
    work = e["external"][-1]
    names = {"external": "work of the weight", "dissipated": "lost to friction", "viscous": "viscous"}
    for name, label in {**names, "kinetic": "kinetic"}.items():
        style = "--" if name == "kinetic" else "-"
        energy.plot(t * np.sqrt(GRAVITY / a), e[name] / work, style, lw=1.2, label=label)
    total = e["kinetic"] + e["elastic"] + e["dissipated"] + e["viscous"]
    energy.plot(t * np.sqrt(GRAVITY / a), total / work, "k:", lw=1, label="sum of all but the work")
    energy.set(xlabel=r"$t\,\sqrt{g/H}$", ylabel="energy / work", title=f"Energies, $a$ = {a:g}")
    energy.legend(fontsize=8)
    for ax in (runs, energy):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "collapse.png", dpi=90)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
