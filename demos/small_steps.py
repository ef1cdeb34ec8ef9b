# SPDX-License-Identifier: MIT
"""As the time step tends to zero, the error tends to the spatial error, for columns at rest and in motion.

Terzaghi's column (demo `terzaghi`) consolidates until the reduced time `T_v = c_v t / height²` is 0.1, with the
coefficient of consolidation c_v and the time t. The column takes 1, 10, ..., 10 000 equal steps. The error is the root
mean square of (p - exact) / p0 at the centroids of all cells. Here p is the pressure, and p0 its initial value. With
many steps, the remaining error must be the spatial error. The spatial error follows from exact integration in time.
Three columns are computed:

* column at rest on the grid.
* moving column: during consolidation the base moves down by half the height, through half of all cells.
* moving column with soft water: the storage coefficient of the water is 1/M, with the oedometric modulus M of the
  skeleton.

Motion adds an error, which is largest at the drained top, in cells that contain little of the column.

The overshoot, the largest p / p0 - 1 in all steps, is zero for the column at rest, with steps of any length. In 2D and
3D, small steps cause checkerboard modes of the pressure; damping of the pressure jumps (`mpm_dolfinx/flow/storage.py`)
removes these modes. The demo shows the first step after a strip load on a layer, with and without damping. The demo
runs on one process.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

import common
import numpy as np
import terzaghi
from coupling_iterations import LAWS, roughness
from numpy.typing import NDArray
from scipy.linalg import expm

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.exact import terzaghi_pressure

HEIGHT, SOIL = terzaghi.HEIGHT, terzaghi.SOIL
T_END = 0.1
CASES = {"resting": (0.0, 0.0), "moving": (0.5, 0.0), "moving, soft water": (0.5, 1.0)}
"""For each column: base displacement divided by height, and storage coefficient of the water multiplied by M."""
STRIP_STEPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # length of the step, divided by the time of consolidation


@dataclass
class Run:
    """A column at `T_END`: depths of the centroids divided by the height, and pressures divided by p0."""

    z: NDArray[np.float64]
    p: NDArray[np.float64]
    error: float
    overshoot: float


def column(cells: int, steps: int, way: float = 0.0, softness: float = 0.0, strain: float = 1e-5) -> Run:
    """Consolidate a column until `T_END` in equal steps, while its base moves down by `way` times `HEIGHT`."""
    h, modulus = HEIGHT / cells, SOIL.oedometric
    load, p0 = strain * modulus, strain * modulus / (1 + softness)
    water = mpm.Fluid(bulk=SOIL.porosity * modulus / softness if softness else np.inf)
    t_end = T_END * HEIGHT**2 * (1 + softness) / (SOIL.conductivity / water.unit_weight * modulus)
    below = int(np.ceil(way * cells))
    grid = mpm.Grid([0, -below * h], [h, HEIGHT], [1, cells + below])
    foot = mpm.Displacement("bottom", lambda t, X: (0, -way * HEIGHT * t / t_end), "y")
    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [h, HEIGHT])],
        [SOIL],
        fluid=water,
        walls={"left": "x", "right": "x", **({} if way else {"bottom": "y"})},
        conditions=[mpm.Traction("top", (0, -load)), *([foot] if way else []), mpm.Drained("top")],
    )
    highest = []
    simulation.run(t_end, t_end / steps, observe=lambda s: highest.append(s.points.pressure.max() / p0))
    scene, (on_grid, _) = simulation.scene, simulation.scene.last
    here = on_grid.contents.filled
    # cells contain the points as they were at the start of the last step
    y = (grid.base + grid.midpoints[here] + on_grid.contents.centroid[here])[:, 1] + way * HEIGHT * (1 - 1 / steps)
    z, p = np.clip(1 - y / HEIGHT, 0, 1), scene.storage.p.x.array[here] / p0
    volume = scene.momentum.ghost.fill.x.array[here]
    error = np.sqrt(volume @ (p - terzaghi_pressure(z, T_END, 1.0, 1.0)) ** 2 / volume.sum())
    order = np.argsort(z)
    return Run(z[order], p[order], float(error), max(highest))


def error_of_cells(cells: int) -> float:
    """Return the spatial error of two-point fluxes, by exact integration in time."""
    laplacian = 2 * np.eye(cells) - np.eye(cells, k=1) - np.eye(cells, k=-1)
    laplacian[0, 0] = laplacian[-1, -1] = 1
    outflow = laplacian.copy()
    outflow[0, 0] += 2  # drained half a cell above the first centroid
    store = np.eye(cells) + SOIL.pressure_damping() * SOIL.oedometric * laplacian
    p = expm(-T_END * cells**2 * np.linalg.solve(store, outflow)) @ np.ones(cells)
    z = (np.arange(cells) + 0.5) / cells
    return float(np.sqrt(np.mean((p - terzaghi_pressure(z, T_END, 1.0, 1.0)) ** 2)))


def strip(cells: int, dt: float, law: type[mpm.Skeleton]) -> NDArray[np.float64]:
    """Return the pressures (nx, ny), divided by the load, after one step under a strip load.

    dt: length of the step, divided by the time of consolidation.
    """
    grid = mpm.Grid([0, 0], [2 * HEIGHT, HEIGHT], [2 * cells, cells])
    soil = law(bulk=SOIL.bulk, shear=SOIL.shear, porosity=SOIL.porosity, conductivity=SOIL.conductivity)
    load = 1e-5 * SOIL.oedometric
    simulation = mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [2 * HEIGHT, HEIGHT])],
        [soil],
        fluid=terzaghi.WATER,
        walls={"left": "xy", "right": "xy", "bottom": "xy"},
        conditions=[mpm.Traction("top", (0, -load), region=((0, 0), (HEIGHT / 2, 2 * HEIGHT))), mpm.Drained("top")],
    )
    simulation.step(dt * HEIGHT**2 / terzaghi.CV)
    p = np.empty(grid.shape.prod())
    p[grid.cell_number] = simulation.scene.storage.p.x.array / load
    return p.reshape(grid.shape)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=25, help="cells over the height of the column")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 10, 100, 1000, 10000], help="numbers of steps")
    parser.add_argument("--strip-cells", type=int, default=20, help="cells over the height of the layer")
    o = parser.parse_args(argv)
    for name in ("cells", "steps", "strip_cells"):
        if np.min(getattr(o, name)) < 1:
            parser.error(f"--{name.replace('_', '-')} {np.min(getattr(o, name))}: must be >= 1")
    with common.results(o) as out:
        runs = {name: [column(o.cells, n, *case) for n in o.steps] for name, case in CASES.items()}
        limit = error_of_cells(o.cells)
        rows = (
            [f"{n}", f"{T_END / n:.0e}", *(f"{r[k].error:.2e}" for r in runs.values())] for k, n in enumerate(o.steps)
        )
        common.table([["steps", "dt (T_v)", *(f"error, {name}" for name in runs)], *rows])
        print(f"error of {o.cells} cells, exact in time: {limit:.2e}")
        overshoot = {name: max(run.overshoot for run in case) - 1 for name, case in runs.items()}
        print("largest p / p0 - 1 of all steps: " + ", ".join(f"{name} {x:.1e}" for name, x in overshoot.items()))
        strips = {name: [strip(o.strip_cells, dt, law) for dt in STRIP_STEPS] for name, law in LAWS.items()}
        for name, fields in strips.items():
            print(f"strip load, {name:>8}: roughness " + ", ".join(f"{roughness(p):.2%}" for p in fields))
        draw(o, runs, limit)
        draw_strip(o, strips)
        out |= {
            "steps": o.steps,
            "errors": {name: [run.error for run in case] for name, case in runs.items()},
            "error_of_cells": limit,
            "overshoot": overshoot,
            "roughness": {name: [roughness(p) for p in fields] for name, fields in strips.items()},
        }
    return out


def draw(o: Namespace, runs: dict[str, list[Run]], limit: float) -> None:
    """Draw the error against the step, and pressures against depth."""
    fig, ((left, *profiles),) = common.figure(1, 3, (14, 4.6))
    dt = T_END / np.array(o.steps)
    marks = dict(zip(runs, "ox+", strict=True))
    for name, case in runs.items():
        left.loglog(dt, [run.error for run in case], f"{marks[name]}-", mfc="none", label=name)
    left.axhline(limit, color="black", lw=1, ls="--", label=f"{o.cells} cells, exact in time")
    left.set(xlabel="step / time of consolidation (-)", ylabel="rms error of p / p0 (-)")
    left.set(title=f"Error at $T_v$ = {T_END:g}")
    left.legend()
    z = np.linspace(0, 1, 201)
    for k, ax in zip((0, -1), profiles, strict=True):
        ax.plot(terzaghi_pressure(z, T_END, 1.0, 1.0), z, color="black", lw=1, label="exact")
        for name, case in runs.items():
            ax.plot(case[k].p, case[k].z, marks[name], ms=5, mfc="none", label=name)
        title = f"Pressure of the cells, {o.steps[k]} step" + "s" * (o.steps[k] > 1)
        ax.set(xlabel="pore pressure / p0 (-)", ylabel="depth / height (-)", title=title, ylim=(1, 0))
        ax.legend(loc="lower left")
    for ax in (left, *profiles):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "small_steps.png")


def draw_strip(o: Namespace, strips: dict[str, list[NDArray[np.float64]]]) -> None:
    """Draw the pressure after the smallest step, and the roughness of the pressure against the step."""
    fig, ((*axes, right),) = common.figure(1, len(strips) + 1, (15, 3.8))
    for ax, (name, fields) in zip(axes, strips.items(), strict=True):
        extent = (0, 2 * HEIGHT, 0, HEIGHT)
        image = ax.imshow(
            fields[-1].T, origin="lower", extent=extent, cmap="viridis", clim=(0, strips["damped"][-1].max())
        )
        ax.plot([0, HEIGHT / 2], [HEIGHT] * 2, color="crimson", lw=4, clip_on=False)
        ax.set(xlabel="x (m)", ylabel="y (m)", title=f"{name}: p / load after one step of {STRIP_STEPS[-1]:g}")
        fig.colorbar(image, ax=ax, shrink=0.7)
        right.semilogx(STRIP_STEPS, [100 * roughness(p) for p in fields], "o-", ms=4, label=name)
    right.set(xlabel="step / time of consolidation (-)", ylabel="roughness (% of the largest p)", ylim=(0, None))
    right.legend()
    right.grid(alpha=0.3)
    common.save(fig, o.out / "small_steps_strip.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
