# SPDX-License-Identifier: MIT
"""A poroelastic beam of 1 m x 0.3 m: a saturated cantilever under a constant load.

The beam is clamped at x = 0 and carries a dead load on its top from x = 0.05 m on. The load increases linearly until
the end of the ramp (--ramp), and then remains constant. The ends of the beam are permeable, and its long sides are
impervious. The beam is in plane strain, or equivalently 0.1 m deep between smooth walls (--dim 3). At first the pore
water carries a part of the load. The beam drains and sags by a third of its length.

Two other solutions are drawn. The first solution is Euler-Bernoulli's small-strain beam without water. The second
solution (--reference) is a finite-strain Biot solution with body-fitted Taylor-Hood elements, in steps of a quarter of
--dt.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from dataclasses import replace

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.base.time_integration import METHODS
from mpm_dolfinx.verification.biot_fem import BiotFEM
from mpm_dolfinx.verification.exact import euler_bernoulli

LENGTH, HEIGHT, DEPTH, CLAMP = 1.0, 0.3, 0.1, 0.05  # m; the load begins at x = CLAMP
BOX = np.array([1.5, 1.2])  # m
REFERENCE_CELLS = (67, 20)
TIMES = (0.02, 0.04, 0.06, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2)  # s
TRUTH = (-0.0665718, -0.1444268, -0.2306306, -0.2652579, -0.3085867)
TRUTH += (-0.3378547, -0.3453412, -0.3474797, -0.3481624, -0.3484207)
"""Vertical displacement of the tip (m) at `TIMES`, with `REFERENCE_CELLS` Taylor-Hood elements and steps of 0.005 s."""


def arguments(argv: list[str] | None = None) -> Namespace:
    """Parse the command line."""
    parser = common.Parser(__doc__, __file__, processes=True)
    add = parser.add_argument
    add("--dim", type=int, choices=(2, 3), default=2, help="plane strain, or one cell deep between smooth walls")
    add("--h", type=float, default=0.015, help="cell size, m")
    add("--dt", type=float, default=0.02, help="time step, s")
    add("--rtol", type=float, help="tolerance of adaptive steps, instead of equal steps")
    add("--method", choices=tuple(METHODS), default="sdirk2", help="time integration")
    add("--t-end", type=float, default=1.2, help="end time, s")
    add("--ramp", type=float, default=0.06, help="time in which the load increases, s")
    add("--load", type=float, default=54e3, help="load on the top, Pa, downwards")
    add("--bulk", type=float, default=1e7 / 3, help="drained bulk modulus, Pa")
    add("--shear", type=float, default=5e6, help="shear modulus, Pa")
    add("--conductivity", type=float, default=1e-4, help="hydraulic conductivity, m/s")
    add("--fluid-bulk", type=float, default=2.2e9, help="bulk modulus of the pore fluid, Pa")
    add("--porosity", type=float, default=0.4, help="porosity at the start")
    add("--points-per-cell", type=int, default=2, help="material points per cell and direction")
    add(
        "--quadrature",
        choices=("domain", "point"),
        default="domain",
        help="exact integration of domains, or point quadrature as in standard MPM",
    )
    add("--offset", type=float, default=0.5, help="distance of the beam's underside from a grid line, cells")
    add("--box-scale", type=int, default=1, help="length and height of the background grid, divided by 1.5 m and 1.2 m")
    add("--coupling", choices=tuple(mpm.COUPLINGS), default="schur-cg", help="coupling scheme")
    add("--drained", action="store_true", help="no pore fluid")
    add("--reference", action="store_true", help="also compute the Taylor-Hood solution")
    add("--paraview", action="store_true", help="write points, grid and histories of every step to OUT/paraview")
    add("--profile", action="store_true", help="print the run time of each part of the program")
    options = parser.parse_args(argv)
    for name in ("h", "dt", "t_end", "ramp", "load", "box_scale"):
        if not getattr(options, name) > 0:
            parser.error(f"--{name.replace('_', '-')} {getattr(options, name)}: must be > 0")
    return options


def physics(o: Namespace, dim: int = 2) -> dict:
    """Return the boundary conditions and the fluid."""
    inner = [np.inf] * (dim - 1)
    load = mpm.Traction(
        "top",
        lambda t: [0.0] * (dim - 1) + [-o.load * min(1.0, t / o.ramp)],
        region=((CLAMP, *np.negative(inner)), (LENGTH, *inner)),
    )
    walls = {"left": "xy"} if dim == 2 else {"left": "xyz", "front": "y", "back": "y"}
    if o.drained:
        return {"walls": walls, "conditions": [load]}
    fluid = mpm.Fluid(bulk=o.fluid_bulk)
    ends = [mpm.Drained("left"), mpm.Drained("right")]
    return {"walls": walls, "conditions": [load, *ends], "fluid": fluid}


def material(o: Namespace) -> mpm.Hencky:
    """Return the law of the skeleton."""
    return mpm.Hencky(bulk=o.bulk, shear=o.shear, porosity=o.porosity, conductivity=o.conductivity)


def scene(o: Namespace) -> tuple[mpm.Simulation, float]:
    """Return the simulation, and the height of the beam's lower side on the grid, in m."""
    cells = np.rint(BOX / o.h).astype(int)
    h = BOX / cells
    # a larger box adds whole cells below and above the beam, so the beam lies on the grid as before
    lower = np.array([0, -((o.box_scale - 1) * cells[1] // 2) * h[1]])
    upper, cells = lower + o.box_scale * BOX, o.box_scale * cells
    bottom = (round(0.5 * BOX[1] / o.h) + o.offset) * h[1]
    start, end = np.array([0, bottom]), np.array([LENGTH, bottom + HEIGHT])
    if o.dim == 3:
        lower, upper, start, end = (
            np.insert(x, 1, y) for x, y in ((lower, 0), (upper, DEPTH), (start, 0), (end, DEPTH))
        )
        cells = np.insert(cells, 1, 1)
    grid = mpm.Grid(lower, upper, cells)
    beam = mpm.box(grid, start, end, per_cell=o.points_per_cell)
    conditions = physics(o, o.dim)
    numerics = mpm.Numerics(quadrature=o.quadrature, coupling=o.coupling, method=o.method)
    return mpm.Simulation(grid, [beam], [material(o)], **conditions, numerics=numerics), bottom


def output_times(o: Namespace) -> dict:
    """Return the arguments of `run` for equal or adaptive steps."""
    if o.rtol is None:
        return {"dt": o.dt}
    return {"rtol": o.rtol, "t_eval": [t for t in TIMES if t <= o.t_end]}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    o = arguments(argv)
    try:
        simulation, bottom = scene(o)
    except ValueError as error:
        sys.exit(f"error: {error}")
    axis = np.stack([np.linspace(0, LENGTH, 41), np.full(41, bottom + HEIGHT / 2)], axis=1)
    outputs = max(1, round(o.t_end / o.dt)) if o.rtol is None else len(output_times(o)["t_eval"])
    shown = np.unique(np.rint(np.geomspace(1, outputs, 6)).astype(int))
    snapshots: list[tuple[float, np.ndarray, np.ndarray]] = []

    def observe(s: mpm.Simulation) -> None:
        if len(s.result.rows) - 1 in shown and not o.drained:
            corners, pressure = common.whole(s, "corners", "pressure")
            if o.dim == 3:  # the front
                front = corners[:, 0, 1] < 1e-9
                corners, pressure = corners[front][:, [0, 1, 4, 5]][..., [0, 2]], pressure[front]
            snapshots.append((s.t, corners, pressure))

    observers = [observe]
    if o.paraview:
        observers.append(mpm.Writer(simulation, o.out / "paraview", grid=True))
    probes = mpm.probes(simulation.bodies, axis if o.dim == 2 else np.insert(axis, 1, DEPTH / 2, axis=1))
    with common.results(o) as out:
        failure = None
        try:
            result = simulation.run(o.t_end, **output_times(o), probes=probes, observe=observers)
        except mpm.GaveUp as error:  # the demo shows the results up to the failure
            failure, result = error, error.result
        result = replace(result, rows=[r._replace(displacement=r.displacement[:, [0, -1]]) for r in result.rows])
        out |= summary(simulation, result)
        fem = reference(o, result, axis - [0, bottom]) if o.reference else None
        if common.first():
            report(o, result, fem)
            write_tables(o, axis, result, fem)
            draw_deflection(o, axis, result, fem, shown)
            if snapshots:
                draw_pressure(o, snapshots)
        if failure:
            raise failure
    return out


def reference(o: Namespace, result: mpm.Result, axis: np.ndarray) -> mpm.Result:
    """Return the finite element solution at the output times of `result`, and at the positions `axis` (n, 2)."""
    fem = BiotFEM(mpm.Grid([0, 0], [LENGTH, HEIGHT], REFERENCE_CELLS), material(o), **physics(o))
    found = fem.run(o.t_end, o.dt / 4, probes=axis, progress=True)
    at = [int(np.argmin(np.abs(found.t - t))) for t in result.t]
    return replace(found, rows=[found.rows[k] for k in at])


def summary(simulation: mpm.Simulation, result: mpm.Result) -> dict:
    """Return the results of the run as plain numbers."""
    comm = simulation.grid.comm
    return {
        "tip": [[t, *map(float, u[-1])] for t, u in zip(result.t[1:], result.displacement[1:], strict=True)],
        "p_range": [[t, *map(float, p)] for t, p in zip(result.t[1:], result.pressure[1:], strict=True) if len(p)],
        "wall_s": result.wall,
        "jit_s": simulation.jit,
        "steps": result.steps,
        "newton_iterations": result.newton,
        "coupling_iterations": result.coupling,
        "fluid_balance": result.balance,
        "residual": result.residual,
        "points": comm.allreduce(len(simulation.points)),
        "active_cells": simulation.scene.last[0].active_cells,
        "converged": result.converged,
    }


def report(o: Namespace, result: mpm.Result, fem) -> None:
    """Print the tip deflection and, if computed, the reference deflection."""
    rows = [["tip: t (s)", "u_x (m)", "u_y (m)", *(["FEM (m)", "difference"] if fem else [])]]
    every = max(1, len(result.t) // 12)
    for k in sorted({*range(1, min(4, len(result.t))), *range(every, len(result.t), every), len(result.t) - 1}):
        u = result.displacement[k][-1]
        rows.append([f"{result.t[k]:.3f}", f"{u[0]:.5f}", f"{u[1]:.5f}"])
        if fem:
            exact = fem.displacement[k][-1][1]
            rows[-1] += [f"{exact:.5f}", f"{u[1] / exact - 1:.3%}"]
    common.table(rows)
    print(
        f"{result.steps} steps, {result.newton} Newton and {result.coupling} coupling iterations, "
        f"fluid balance {result.balance:.1e}, {result.wall:.1f} s"
    )
    if o.profile:
        print(result.shares())
    if o.paraview:
        print(f"for ParaView: {o.out}/paraview/points.pvd")


def write_tables(o: Namespace, axis: np.ndarray, result: mpm.Result, fem) -> None:
    """Write the tip deflection against time, and the deflection curves, as CSV."""
    names = ["t_s", "ux_m", "uy_m", *([] if o.drained else ["p_min_Pa", "p_max_Pa"])]
    rows = []
    for k, t in enumerate(result.t):
        rows.append([t, *result.displacement[k][-1], *([] if o.drained else result.pressure[k])])
        rows[-1] += [*fem.displacement[k][-1]] if fem else []
    common.write_csv(o.out / "tip.csv", [*names, *(["fem_ux_m", "fem_uy_m"] if fem else [])], rows)
    histories = zip(result.t, result.displacement, strict=True)
    rows = ([t, x, *v] for t, u in histories for x, v in zip(axis[:, 0], u, strict=True))
    common.write_csv(o.out / "deflection.csv", ["t_s", "x_m", "ux_m", "uy_m"], rows)


def draw_pressure(o: Namespace, snapshots: list) -> None:
    """Draw the pore pressure of the material points at six times."""
    from matplotlib.colors import SymLogNorm

    rows = 1 + (len(snapshots) > 3)
    fig, axes = common.figure(rows, 3, (13, 3 * rows))
    limit = max(np.abs(pressure).max() for _, _, pressure in snapshots) / 1e3
    colours = SymLogNorm(limit / 30, vmin=-limit, vmax=limit)  # the final pressure is a fortieth of the largest
    low, high = snapshots[-1][1].min(axis=(0, 1)), snapshots[0][1].max(axis=(0, 1))
    for ax, (t, corners, pressure) in zip(axes.ravel(), snapshots, strict=False):
        domains = common.domains(ax, corners, pressure / 1e3, cmap="RdBu_r", linewidth=0.1, norm=colours)
        ax.set(aspect="equal", title=f"t = {t:.3g} s", xlabel="x (m)", ylabel="y (m)")
        ax.set(xlim=(-0.03, high[0] + 0.05), ylim=(low[1] - 0.03, high[1] + 0.03))
    bar = fig.colorbar(domains, ax=axes, shrink=0.8, aspect=30, format="%g")
    bar.set_label(f"pore pressure (kPa),\nlogarithmic beyond ±{limit / 30:.0f}")
    bar.set_ticks([sign * x for x in (300, 100, 30, 10) for sign in (-1, 1) if x < limit] + [0])
    for ax in axes.ravel()[len(snapshots) :]:
        ax.set_axis_off()
    common.save(fig, o.out / "pressure.png")


def draw_deflection(o: Namespace, axis: np.ndarray, result: mpm.Result, fem, shown) -> None:
    """Draw the beam's axis at several times, with the reference solutions."""
    import matplotlib

    fig, ((ax,),) = common.figure(1, 1, (8, 5))
    shown = [k for k in shown if k < len(result.t)]
    colours = matplotlib.colormaps["viridis"](np.linspace(0.9, 0, len(shown)))
    y0 = axis[0, 1]
    for k, colour in zip(shown, colours, strict=True):
        x, y = (axis + result.displacement[k]).T
        ax.plot(x, y - y0, color=colour, label=f"t = {result.t[k]:.3g} s")
        if fem:
            x, y = (axis + fem.displacement[k]).T
            label = "Taylor-Hood FEM" if k == shown[-1] else None
            ax.plot(x, y - y0, "o", color="black", ms=3, mfc="none", markevery=4, label=label)
    young = 9 * o.bulk * o.shear / (3 * o.bulk + o.shear)
    nu = young / (2 * o.shear) - 1
    x = axis[:, 0]
    w = -euler_bernoulli(x, o.load, LENGTH, young / (1 - nu**2), HEIGHT**3 / 12)
    ax.plot(x, w, "--", color="crimson", label="Euler-Bernoulli, drained,\nsmall strain, load on all of the top")
    ax.set(xlabel="x (m)", ylabel="height of the beam's axis (m)", title="Deflection of the beam's axis")
    ax.legend(loc="lower left")
    ax.grid(alpha=0.3)
    common.save(fig, o.out / "deflection.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
