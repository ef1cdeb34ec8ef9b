# SPDX-License-Identifier: MIT
"""Push a disc through clay with renewal of domains, on any number of processes, and write its state."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.stepping import renewal as domains

CLAY = mpm.DruckerPrager(5e6, 1e5, friction=0.0, dilation=0.0, cohesion=1e3, conductivity=1e-6)


def pushed(cells=8, renewal=True, wet=False, rings=False, suction=False, **more):
    """Return a simulation of a disc, or with `rings` a ball, that is pushed into a block next to a pressure.

    cells: number of cells over the width of the block.
    suction: the soil is unsaturated, above a water table.
    """
    grid = mpm.Grid([0, 0], [1.0, 1.2], [cells, 5 * cells // 4], axisymmetric=rings)
    block = mpm.box(grid, [0, 0], [1.0, 0.83])
    disc = mpm.Tool(mpm.Ball((0, 1.13), 0.3), lambda t: (0, -t), adhesion=100.0)
    load = mpm.Pressure("top", lambda t: 1e3 * min(1, 10 * t), region=([0.5, 0], [1, 1]))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    numerics = mpm.Numerics(renewal=renewal)
    conditions, fluid = ([disc, load, mpm.Drained("top")], mpm.Fluid()) if wet else ([disc, load], None)
    options = {"walls": walls, "conditions": conditions, "numerics": numerics, "fluid": fluid, **more}
    soil = CLAY
    if suction:
        soil = replace(CLAY, retention=mpm.VanGenuchten(2e3, n=2.5))
        options |= {"conditions": [disc, load], "gravity": (0, -9.81), "pressure": lambda x: -9810 * (x[:, 1] - 0.2)}
    return mpm.Simulation(grid, [block], [soil], **options)


def main(file, *words):
    """Write the state of a run of some kind, in two parts, or with "restart" from a checkpoint."""
    domains.LONGEST = 0.6  # cells: soon
    file = Path(file)
    kind = {"wet": "wet" in words, **{name: True for name in ("inertia", "rings", "suction") if name in words}}
    simulation = pushed(**kind)
    if "restart" in words:
        half = mpm.Checkpoint(file.with_suffix(".checkpoint"))
        simulation.run(0.06, 0.01, checkpoint=half, until=lambda s: s.t > 0.03, progress=False)
        simulation = pushed(**kind)
        simulation.run(0.06, 0.01, after=mpm.resume(simulation, half.file), progress=False)
    else:
        simulation.run(0.06, 0.01, until=lambda s: s.t > 0.03, progress=False)
        simulation.run(0.06, 0.01, after=simulation.result, progress=False)
    points = simulation.points
    names = ("plastic", "tool_shear")
    velocity = points.data.get("velocity", np.zeros_like(points.x))
    rows = points.id, points.x, points.volume0, points.pressure, *(points.data[name] for name in names), velocity
    parts = simulation.grid.comm.gather(rows)
    if parts:
        order = np.argsort(np.concatenate([part[0] for part in parts]))
        titles = ("id", "x", "volume0", "pressure", "plastic", "shear", "velocity")
        of = dict(zip(titles, map(np.concatenate, zip(*parts, strict=True)), strict=True))
        more = {"force": simulation.tool_forces.array, "renewed": simulation.result.renewed}
        np.savez(file.with_suffix(".npz"), **{name: values[order] for name, values in of.items()}, **more)


if __name__ == "__main__":
    main(*sys.argv[1:])
