# SPDX-License-Identifier: MIT
"""Cryer's sphere: loaded and drained at its surface, with a rise of pressure at the centre.

A saturated sphere is loaded suddenly by a constant normal traction p0, and its surface is drained. The outer shell
drains first, shrinks, and compresses the core. The pressure at the centre rises by nearly a third above p0 before it
falls (Cryer 1963). Fluid and grains are incompressible, and Poisson's ratio is 0.25. One octant is computed: a lattice
of boxes, mapped smoothly into the sphere. With --axisymmetric, a quarter of a disc is computed.

`peak` is the relative error of the largest pressure at the centre. `curve` is the largest error of the pressure at the
centre from T = 0.02 on, divided by p0. T is the reduced time `c_v t / R²`, with the coefficient of consolidation c_v,
the time t and the radius R.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.exact import cryer_pressure

RADIUS, LOAD, NU = 1.0, 100.0, 0.25  # m, Pa, -
SHEAR, CONDUCTIVITY = 1e6, 1e-6  # Pa, m/s
SAND = mpm.LinearElastic(bulk=SHEAR * 2 * (1 + NU) / (3 - 6 * NU), shear=SHEAR, conductivity=CONDUCTIVITY)
WATER = mpm.Fluid(bulk=np.inf)
CV = CONDUCTIVITY / WATER.unit_weight * SAND.oedometric  # m²/s
END = 0.12  # reduced time
CUBE = 0.8 * RADIUS  # m; edge of the lattice: an octant has the volume of a cube of 0.81 R
SQUARE = 0.85 * RADIUS  # m; edge of the lattice of a quarter disc
OUTER = ("right", "back", "top")  # sides of the lattice that become the surface of the ball


def ball(x: np.ndarray) -> np.ndarray:
    """Map positions (n, 3) in m from the cube [-`CUBE`, `CUBE`]^3 to the ball."""
    a = x / CUBE
    b, c = np.roll(a, -1, axis=1) ** 2, np.roll(a, -2, axis=1) ** 2
    return RADIUS * a * np.sqrt(1 - b / 2 - c / 2 + b * c / 3)


def disc(x: np.ndarray) -> np.ndarray:
    """Map positions (n, 2) in m from the square [-`SQUARE`, `SQUARE`]^2 to the disc."""
    a = x / SQUARE
    return RADIUS * a * np.sqrt(1 - a[:, ::-1] ** 2 / 2)


def scene(cells: int, axisymmetric: bool = False, grid: mpm.Grid | None = None) -> mpm.Simulation:
    """Return the octant or the quarter disc, with `cells` cells over the radius unless `grid` is given."""
    h = RADIUS / cells
    if axisymmetric:
        grid = grid or mpm.Grid([0] * 2, [RADIUS + h] * 2, [cells + 1] * 2, axisymmetric=True)
        sides = "right", "top"
        quarter = mpm.mapped(grid, mpm.box(grid, [0, 0], [SQUARE] * 2), disc)
        pressed, drained = [mpm.Traction(s, -LOAD) for s in sides], [mpm.Drained(s) for s in sides]
        acting = {"walls": {"bottom": "y"}, "conditions": [*pressed, *drained]}
        return mpm.Simulation(grid, [quarter], [SAND], fluid=WATER, **acting)
    grid = grid or mpm.Grid([0] * 3, [RADIUS + h] * 3, [cells + 1] * 3)
    octant = mpm.mapped(grid, mpm.box(grid, [0] * 3, [CUBE] * 3), ball)
    walls = {"left": "x", "front": "y", "bottom": "z"}
    pressed, drained = [mpm.Traction(s, -LOAD) for s in OUTER], [mpm.Drained(s) for s in OUTER]
    return mpm.Simulation(grid, [octant], [SAND], fluid=WATER, walls=walls, conditions=[*pressed, *drained])


@dataclass
class Outcome:
    """Reduced times (k,), pressures (k,) at the centre divided by p0, and the cost of the run."""

    T: np.ndarray
    pressure: np.ndarray
    result: mpm.Result
    cells: int


def run(
    cells: int = 20, steps: int = 100, axisymmetric: bool = False, grid: mpm.Grid | None = None
) -> tuple[dict[str, float], Outcome]:
    """Run to the reduced time `END` in equal steps, and return the errors by name."""
    simulation, history = scene(cells, axisymmetric, grid), []

    def observe(s: mpm.Simulation) -> None:
        nearest = np.square(s.points.x).sum(axis=1)
        at = np.argmin(nearest) if len(nearest) else None
        found = (nearest[at], s.points.pressure[at]) if len(nearest) else (np.inf, 0.0)
        history.append(min(s.grid.comm.allgather(found))[1] / LOAD)

    end = END * RADIUS**2 / CV
    result = simulation.run(end, end / steps, observe=observe)
    out = Outcome(
        END * np.arange(1, steps + 1) / steps, np.array(history), result, simulation.scene.last[0].active_cells
    )
    return errors(out), out


def exact(T: np.ndarray) -> np.ndarray:
    """Return the exact pressure at the centre at reduced times, divided by p0."""
    return cryer_pressure(T, 1.0, 1.0, NU)


def errors(out: Outcome) -> dict[str, float]:
    """Return the errors by name; the docstring of this file explains the names."""
    late = out.T >= 0.02
    highest = exact(np.linspace(0.04, 0.06, 2001)).max()
    return {
        "peak": float(abs(out.pressure.max() / highest - 1)),
        "curve": float(np.abs(out.pressure - exact(out.T))[late].max()),
    }


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__, processes=True)
    parser.add_argument("--cells", type=int, default=20, help="cells over the radius")
    parser.add_argument("--steps", type=int, default=100, help=f"equal steps to the reduced time {END}")
    parser.add_argument("--axisymmetric", action="store_true", help="a quarter of a disc instead of the octant")
    parser.add_argument("--profile", action="store_true", help="print the run time of each part of the program")
    o = parser.parse_args(argv)
    if o.cells < 2 or o.steps < 1:
        parser.error(f"--cells {o.cells}: must be >= 2; --steps {o.steps}: must be >= 1")
    with common.results(o) as out:
        found, outcome = run(o.cells, o.steps, o.axisymmetric)
        result = outcome.result
        out |= {"errors": found, "active_cells": outcome.cells, "wall_s": result.wall}
        report(outcome, found)
        if o.profile:
            print(result.shares())
        draw(o, outcome)
    return out


def report(out: Outcome, found: dict[str, float]) -> None:
    """Print the computed and the exact pressure at the centre."""
    shown = np.unique(np.linspace(0, len(out.T) - 1, 13).astype(int))
    rows = ([f"{x:.4f}" for x in (out.T[k], out.pressure[k], exact(out.T[k]))] for k in shown)
    common.table([["T", "p/p0", "exact"], *rows])
    r = out.result
    print(f"{out.cells} cells, {r.steps} steps, {r.newton} Newton and {r.coupling} linear iterations, {r.wall:.1f} s")
    print(f"errors: peak {found['peak']:.2%}, curve {found['curve']:.2%}")


def draw(o: Namespace, out: Outcome) -> None:
    """Draw the computed and the exact pressure at the centre."""
    fig, ((ax,),) = common.figure(1, 1, (7, 4.5))
    T = np.linspace(1e-3, out.T[-1], 400)
    ax.plot(T, exact(T), color="black", lw=1, label="Cryer (1963)")
    ax.plot(out.T, out.pressure, "o", ms=4, mfc="none", label=f"material points, {o.cells} cells to the radius")
    ax.axhline(1, color="grey", lw=0.6, ls="--", label="the load")
    ax.set(xlabel="reduced time $c_v t / R^2$ (-)", ylabel="pressure at the centre / load (-)", title="Cryer's sphere")
    ax.set(xlim=(0, out.T[-1]), ylim=(0.9, 1.4))
    ax.legend(loc="lower left")
    ax.grid(alpha=0.3)
    common.save(fig, o.out / "cryer.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
