# SPDX-License-Identifier: MIT
"""Columns of sand collapse, dry and under water: run-out against published experiments, and energies.

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

One column, with a = 1, also collapses below a water level. Its porosity is 0.4, and grains of L/100 have a conductivity
of about 1 m/s for L = 1 m (Kozeny-Carman). Coarse sand moves nearly as dry sand of the same density under gravity
g' = g (rho - rho_w) / rho, with the density rho of saturated sand. In units of L and sqrt(H/g'), the motion of the dry
column is therefore the reference. The acceleration of pore water causes a small difference. In finer sand, flow of
water through pores delays the motion.

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
POROSITY, WATER = 0.4, 1000.0  # -, kg/m³
CELLS = {0.5: 16, 1.0: 12, 4.0: 6, 8.0: 6}  # cells over the width, for each aspect ratio
SCATTER, BALANCE = 0.15, 0.015  # allowed errors: of run-outs; of the energy balance, relative to the weight's work
COARSE = 1.0  # m/s
CONDUCTIVITIES = (COARSE, 1e-3)  # m/s, of columns under water
REST = 1e6  # s: duration of the static step
STEPS = 50  # in the time sqrt(H/g)


class Heap(NamedTuple):
    """Results for a column; `fronts` and `height` are in m.

    fronts: array (steps, 2) of times, in units of sqrt(H/g), and of displacements of the front.
    lost: largest error of the energy balance, divided by the work of the weight.
    left: final kinetic energy, divided by the work of the weight.
    before, after: initial and final corners of the domains, in m.
    profiles: middles of vertical strips, and depths of sand in these strips, in m.
    """

    fronts: np.ndarray
    height: float
    lost: float
    left: float
    before: np.ndarray
    after: np.ndarray
    profiles: list[tuple[np.ndarray, np.ndarray]]
    result: mpm.Result

    @property
    def run_out(self) -> float:
        """Final displacement of the front, in m."""
        return float(self.fronts[-1, 1])


def published(aspect: float) -> float:
    """Return the run-out according to Lube et al., divided by the width of the column."""
    return float(np.interp(aspect, (1.8, 2.8), (0, 1)) * (1.9 * aspect ** (2 / 3) - 1.2 * aspect) + 1.2 * aspect)


def column(
    aspect: float, cells: int, grain: float = GRAIN, renewal: bool = False, conductivity: float = 0.0
) -> mpm.Simulation:
    """Return a column at rest, 1 m wide, with `cells` cells over the width.

    grain: grain size, in m; zero means no viscosity.
    renewal: whether long particle domains are replaced by new domains.
    conductivity: conductivity of the sand of a column under water, in m/s; zero means a dry column.
    """
    h, reach = 1 / cells, np.ceil(1.4 * published(aspect) + 2.5)
    rows = h * np.arange(1, round(aspect * cells) + 3)
    grid = mpm.Grid(lines=[np.linspace(0, reach, round(reach * cells) + 1), [0, h / 4, h / 2, *rows]])
    density, gravity = moving(conductivity)
    weight = density * gravity * aspect
    sand = mpm.MohrCoulomb(
        bulk=STIFF * weight / 1.2,
        shear=STIFF * weight / 2.6,
        friction=np.degrees(np.arcsin(np.tan(REPOSE))),
        dilation=0.0,
        cohesion=COHESION * weight,
        porosity=POROSITY,
        grain_density=DENSITY / (1 - POROSITY),
        conductivity=conductivity,
    )
    gate, level = mpm.Displacement("right", (0, 0), "x"), aspect + 1
    water = [*mpm.water("right", level), *mpm.water("top", level)] if conductivity else []
    viscosity = RISE * grain * np.sqrt(density / (1 - POROSITY) * weight / 4)
    options = {"walls": {"left": "x", "bottom": "xy"}, "gravity": (0, -GRAVITY), "inertia": False}
    options |= {"fluid": mpm.Fluid(density=WATER), "pressure": mpm.hydrostatic(level)} if conductivity else {}
    options |= {"terms": [common.viscous(viscosity)] if grain else [], "numerics": mpm.Numerics(renewal=renewal)}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, aspect])], [sand], conditions=[*water, gate], **options)
    s.run(REST, REST, progress=False)
    s.stage(inertia=True, conditions=water)
    s.t = 0.0
    return s


def moving(conductivity: float) -> tuple[float, float]:
    """Return the density (kg/m³) of the sand, and gravity (m/s²) reduced by buoyancy; zero `conductivity`: dry sand."""
    if not conductivity:
        return DENSITY, GRAVITY
    density = DENSITY + POROSITY * WATER
    return density, GRAVITY * (density - WATER) / density


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


def front(x: np.ndarray, depth: np.ndarray) -> float:
    """Return the position (m) at which the depth of the sand is one grain."""
    k = np.flatnonzero(depth > GRAIN).max()
    return x[k] + (depth[k] - GRAIN) / (depth[k] - depth[k + 1]) * (x[k + 1] - x[k])


def collapsed(
    aspect: float,
    cells: int,
    steps: float,
    grain: float = GRAIN,
    renewal: bool = False,
    conductivity: float = 0.0,
) -> Heap:
    """Release a column and return its `Heap`.

    steps: number of steps in the time sqrt(H/g) for the height H.
    grain, renewal, conductivity: see `column`.
    """
    s = column(aspect, cells, grain, renewal, conductivity)
    fall = np.sqrt(aspect / moving(conductivity)[1])
    before, profiles, fronts = s.points.corners.copy(), [], [(0.0, 0.0)]

    def look(s: mpm.Simulation) -> None:
        x, depth = depths(s)
        fronts.append((s.t / fall, front(x, depth) - 1))
        if np.abs(s.t - SHOWN * fall).min() < 0.5 * fall / steps:
            profiles.append((x, depth))

    result = s.run(FALLS * fall, fall / steps, energies=True, observe=look, progress=False)
    e = result.energies
    work = e["external"][-1]
    shares = common.unbalanced(e) / work, e["kinetic"][-1] / work
    return Heap(np.array(fronts), depths(s)[1].max(), *shares, before, s.points.corners, profiles, result)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--aspects", type=float, nargs="+", default=list(CELLS), help="height-to-width ratios")
    parser.add_argument("--finer", type=float, default=1.0, help="factor for the number of cells over the width")
    parser.add_argument("--steps", type=float, default=STEPS, help="steps in the time sqrt(H/g)")
    parser.add_argument("--grain", type=float, default=GRAIN, help="grain size divided by the width; 0: no viscosity")
    parser.add_argument(
        "--conductivity", type=float, nargs="*", default=list(CONDUCTIVITIES), help="of columns under water, m/s"
    )
    parser.add_argument("--renewal", action="store_true", help="replace particle domains that are longer than a cell")
    o = parser.parse_args(argv)
    if not all(0.25 <= a <= 16 for a in o.aspects):
        parser.error(f"--aspects {o.aspects}: must be in [0.25, 16]")
    if not (0.5 <= o.finer <= 4 and 4 <= o.steps <= 400 and 0 <= o.grain <= 0.1):
        parser.error(
            f"--finer {o.finer:g} --steps {o.steps:g} --grain {o.grain:g}: not in [0.5, 4], [4, 400], [0, 0.1]"
        )
    if not all(1e-6 <= k <= 10 for k in o.conductivity):
        parser.error(f"--conductivity {o.conductivity}: must be in [1e-6, 10] m/s")
    with common.results(o) as out:
        rows, heaps = [], {}
        for a in o.aspects:
            cells = cells_over(a, o.finer)
            heaps[a] = one = collapsed(a, cells, o.steps, o.grain, o.renewal)
            off = one.run_out / published(a) - 1
            out[f"{a:g}"] = {"run_out": one.run_out, "off": off, "height": one.height, "lost": one.lost, "cells": cells}
            rows.append(
                [f"{a:g}", f"{cells}", f"{one.run_out:.2f}", f"{published(a):.2f}", f"{off:+.0%}", f"{one.lost:.1%}"]
            )
        common.table([["a", "cells", "run-out / L", "Lube et al.", "off", "energy lost"], *rows])
        under = under_water(o, heaps)
        for k, (one, apart) in under.items():
            off = one.run_out / heaps[nearest(heaps)].run_out - 1
            out[f"water_{k:g}"] = {"off": off, "apart": apart, "run_out": one.run_out, "lost": one.lost}
        given = (o.aspects, o.finer, o.steps, o.grain, o.renewal, o.conductivity)
        usual = given == (list(CELLS), 1.0, STEPS, GRAIN, False, list(CONDUCTIVITIES))
        checked = [entry for entry in (*(f"{a:g}" for a in heaps), f"water_{COARSE:g}") if entry in out]
        within = all(abs(out[entry]["off"]) <= SCATTER and out[entry]["lost"] <= BALANCE for entry in checked)
        out["converged"] = within or not usual
        draw(o, heaps, {k: one for k, (one, _) in under.items()})
    return out


def under_water(o: Namespace, heaps: dict[float, Heap]) -> dict[float, tuple[Heap, float]]:
    """Return a `Heap` for each conductivity of sand under water, and its distance from the dry column.

    The distance is the largest distance of the fronts at equal times, divided by the run-out of the dry column.
    """
    a, found, rows = nearest(heaps), {}, []
    for k in o.conductivity:
        one = collapsed(a, cells_over(a, o.finer), o.steps, o.grain, o.renewal, k)
        dry = np.interp(one.fronts[:, 0], *heaps[a].fronts.T)
        found[k] = one, float(np.abs(one.fronts[:, 1] - dry).max() / heaps[a].run_out)
        rows.append(
            [f"{k:g}", f"{one.run_out:.2f}", f"{heaps[a].run_out:.2f}", f"{found[k][1]:.1%}", f"{one.lost:.1%}"]
        )
    if rows:
        print(f"\nunder water, a = {a:g}")
        common.table([["k in m/s", "run-out / L", "dry", "largest distance of fronts / run-out", "energy lost"], *rows])
    return found


def nearest(heaps: dict[float, Heap]) -> float:
    """Return the aspect ratio that is nearest to 1."""
    return min(heaps, key=lambda a: abs(np.log(a)))


def cells_over(aspect: float, finer: float) -> int:
    """Return the number of cells over the width."""
    return max(2, round(finer * CELLS[min(CELLS, key=lambda k: abs(np.log(k / aspect)))]))


def draw(o: Namespace, heaps: dict[float, Heap], under: dict[float, Heap]) -> None:
    """Draw a column in motion, the run-outs, the energies, and fronts under water."""
    fig, ((way, runs), (energy, wet)) = common.figure(2, 2, (11, 8))
    a = nearest(heaps)
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
    wet.plot(*heaps[a].fronts.T, "k--", lw=1, label="dry")
    for k, one in under.items():
        wet.plot(*one.fronts.T, lw=1.2, label=f"under water, $k$ = {k:g} m/s")
    wet.set(xlabel=r"$t\,\sqrt{g'/H}$", ylabel="front / L", title=f"Front in units of reduced gravity, $a$ = {a:g}")
    wet.legend(fontsize=8)
    for ax in (runs, energy, wet):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "collapse.png", dpi=90)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
