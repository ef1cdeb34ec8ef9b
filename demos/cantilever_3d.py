# SPDX-License-Identifier: MIT
"""A cantilever of square section with a load inclined to the grid: tip displacement, and cost of a step.

A dry beam, 1 m long and 0.1 m high and wide, is clamped at x = 0. A dead load P acts on its free end in the direction
(0, 3, -4) / 5. A square section has equal stiffness about all axes, so the beam must bend in the direction of the load.
The reference is the geometrically exact rod with stretch and shear (Reissner 1972, Simo 1985). The load parameter is
`alpha = P L² / (E I)`, with the length L, Young's modulus E and the second moment of area I. The material is elastic,
so the deflection must not depend on the number of steps. The demo runs on any number of processes. --profile prints the
cost of a step.

All errors are divided by L. `v` is the error of the tip deflection against the rod, and `u` is the error of the
shortening. `w` is the displacement of the tip normal to the plane of bending. `drift` is the largest distance of the
tip from its position in the run with the most steps.

The tip deflection is too large because the stress is constant in each domain. With n domains over the height the error
is about 1/n². In 10 steps, `v` is 0.0129 with 2 cells over the height, 0.0034 with 4 cells, and 0.0010 with 8 cells.
"""

from __future__ import annotations

import resource
from argparse import Namespace

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.grid.grid import corner_bits
from mpm_dolfinx.verification.exact import shear_flexible_rod

LENGTH, SIDE, YOUNG = 1.0, 0.1, 12e6  # m, m, Pa
ALONG, ACROSS = np.array([0, 3, -4]) / 5, np.array([0, 4, 3]) / 5
RUBBER = mpm.NeoHookean(bulk=YOUNG / 3, shear=YOUNG / 2)  # nu = 0
STIFFNESS = YOUNG * SIDE**4 / 12  # E I, N m²
OFFSET = np.array([0, 0.37, 0.5])  # offset of the beam from the grid lines, cells


def rod(alpha: float) -> tuple[float, float]:
    """Return the shortening and the deflection of the rod's tip, in m."""
    area, load = SIDE**2, alpha * STIFFNESS / LENGTH**2
    x, y = shear_flexible_rod(LENGTH, YOUNG * area, 5 / 6 * RUBBER.shear * area, STIFFNESS, load, points=2)[-1]
    return LENGTH - x, y


def scene(cells: int, alpha: float) -> tuple[mpm.Simulation, mpm.surface.Probes]:
    """Return the beam and the middle of its free end; at 1 s the load parameter is alpha."""
    h = SIDE / cells
    reach = np.abs(ALONG) * rod(alpha)[1] * 1.05
    span = np.array([LENGTH * 1.05, SIDE, SIDE]) + reach + 3 * h
    span[1:] += h
    count = np.ceil(span / h).astype(int)
    grid = mpm.Grid([0, 0, 0], count * h, count)
    lower = OFFSET * h
    lower[1:] += h
    lower[2] += np.ceil(reach[2] / h) * h
    size = np.array([LENGTH, SIDE, SIDE])
    body = mpm.box(grid, lower, lower + size)
    traction = ALONG * alpha * STIFFNESS / LENGTH**2 / SIDE**2
    pull = mpm.Traction("right", lambda t: traction * t)
    simulation = mpm.Simulation(grid, [body], [RUBBER], walls={"left": "xyz"}, conditions=[pull])
    return simulation, mpm.probes([body], [lower + size * [1, 0.5, 0.5]])


def run(cells: int, steps: int, alpha: float, taken: int | None = None) -> tuple[np.ndarray, mpm.Result, dict]:
    """Return the tip displacement (3,) in m, the result and the costs of a run.

    steps: number of steps to the full load.
    taken: number of computed steps; None means all steps.
    """
    simulation, tip = scene(cells, alpha)
    result = simulation.run((taken or steps) / steps, 1 / steps, probes=tip)
    comm, (on_grid, matrices) = simulation.grid.comm, simulation.scene.last
    memory = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1024
    costs = {
        "steps": result.steps,
        "active_cells": on_grid.active_cells,
        "grid_cells": int(simulation.grid.shape.prod()),
        "unknowns": matrices.momentum.unknowns.global_size,
        "newton_iterations": result.newton,
        "linear_iterations": result.coupling,
        "seconds_per_step": result.wall / result.steps,
        "memory_MB": memory,
    }
    if cells <= 8:
        costs["surface"] = surface(simulation)
    return result.displacement[-1][0], result, costs


def surface(simulation: mpm.Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the outer faces (k, 4, 3) of the body (m), and the axial stretch (k,) at each face."""
    (corners, F), (body,) = common.whole(simulation, "corners", "F"), simulation.bodies
    bits, faces, stretch = corner_bits(3), [], []
    for axis in range(3):
        for end in (0, 1):
            on = body.sides[:, axis, end]
            faces.append(corners[on][:, bits[:, axis] == end][:, [0, 1, 3, 2]])
            stretch.append(np.linalg.norm(F[on, :, 0], axis=1))
    return np.concatenate(faces), np.concatenate(stretch)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__, processes=True)
    add = parser.add_argument
    add("--cells", type=int, default=4, help="cells over the height")
    add("--steps", type=int, nargs="+", default=[10, 20, 40], help="numbers of load steps")
    add("--taken", type=int, default=None, help="take only this number of steps: prints costs, no errors")
    add("--alpha", type=float, default=1.0, help="load parameter")
    add("--profile", action="store_true", help="print the run time of each part of the program")
    o = parser.parse_args(argv)
    if o.cells < 1 or min(o.steps) < 1 or not 0 < o.alpha <= 10:
        parser.error(f"--cells {o.cells}, --steps {o.steps}: must be >= 1; --alpha {o.alpha}: must be in (0, 10]")
    with common.results(o) as out:
        out |= {"errors": {}, "runs": []}
        tips, picture = [], None
        for steps in o.steps:
            tip, result, costs = run(o.cells, steps, o.alpha, o.taken)
            picture = costs.pop("surface", None)
            tips.append(tip)
            out["runs"].append({"load_steps": steps, "tip": tip.tolist(), **costs, "wall_s": result.wall})
            if common.first():
                found = ", ".join(f"{value:.4g} {name.replace('_', ' ')}" for name, value in costs.items())
                print(found + (f"\n{result.shares()}" if o.profile else ""), flush=True)
        if common.first() and o.taken is None:
            out["errors"] = errors(np.array(tips), o.alpha)
            report(o, np.array(tips), out["errors"])
            if picture:
                draw(o, *picture)
    return out


def errors(tips: np.ndarray, alpha: float) -> dict[str, float]:
    """Return the errors of the run with the most steps, by name; the docstring of this file explains the names."""
    u, v = rod(alpha)
    tip = tips[-1]
    drift = np.linalg.norm(tips - tip, axis=1).max()
    distances = {"v": tip @ ALONG - v, "u": -tip[0] - u, "w": tip @ ACROSS, "drift": drift}
    return {name: float(abs(d)) / LENGTH for name, d in distances.items()}


def report(o: Namespace, tips: np.ndarray, found: dict[str, float]) -> None:
    """Print the tip displacements of the beam and of the rod."""
    u, v = rod(o.alpha)
    rows = {steps: (tip @ ALONG, tip @ ACROSS, -tip[0]) for steps, tip in zip(o.steps, tips, strict=True)}
    head = ["load steps", "along (m)", "across (m)", "shortening (m)"]
    common.table([head, *([f"{name}", *(f"{x:.6f}" for x in row)] for name, row in {**rows, "rod": (v, 0, u)}.items())])
    print("errors over L: " + ", ".join(f"{name} {e:.3%}" for name, e in found.items()))


def draw(o: Namespace, faces: np.ndarray, stretch: np.ndarray) -> None:
    """Draw the deformed beam, coloured by the axial stretch."""
    import matplotlib.pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    fig = plt.figure(figsize=(8, 4.6))
    ax = fig.add_axes([-0.05, 0.12, 1.1, 0.95], projection="3d", proj_type="ortho")
    limit = np.abs(stretch - 1).max()
    colours = ScalarMappable(Normalize(1 - limit, 1 + limit), "RdBu_r")
    ax.add_collection3d(Poly3DCollection(faces, facecolors=colours.to_rgba(stretch), edgecolors="0.3", linewidths=0.1))
    low, high = faces.min(axis=(0, 1)), faces.max(axis=(0, 1))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    fig.text(0.5, 0.93, rf"Square cantilever, $P L^2 / (E I)$ = {o.alpha:g}", ha="center", fontsize=12)
    ax.set_box_aspect(high - low, zoom=1.1)
    ax.locator_params(axis="y", nbins=2)
    ax.locator_params(axis="z", nbins=4)
    ax.view_init(elev=25, azim=-70)
    across = fig.add_axes([0.3, 0.13, 0.4, 0.03])
    fig.colorbar(colours, cax=across, orientation="horizontal", label="stretch along the beam (-)")
    common.save(fig, o.out / "cantilever_3d.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
