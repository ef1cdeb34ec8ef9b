# SPDX-License-Identifier: MIT
"""Cost of each feature of a scene, measured with a pair of scenes: one with the feature, and one without.

The scene is a square block of 1 m between smooth walls. The load is so small that the active cells do not change. The
feature hardly changes the results. Examples are a gravity of zero, a conductivity of 1e-30 m/s, and a plastic law far
from yield. `settlement` is the relative difference between the final settlements of the two scenes. In the pair "mean
dilatation" (F-bar), the two scenes have different Poisson ratios and therefore different settlements.

The two scenes of a pair take turns of four steps each, --repeat times. The table gives the run time of the
fastest step of each scene. All times are processor times. The compile time is the additional time of the first step
with an empty cache of compiled forms. The memory is the peak memory with a full cache.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise
from tempfile import TemporaryDirectory

from mpi4py import MPI

import common
import numpy as np
from dolfinx import mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.base.time_integration import GAMMA
from mpm_dolfinx.materials.skeleton import LOCKING
from mpm_dolfinx.mechanics import ghost_penalty
from mpm_dolfinx.simulation.summary import peak_memory

SHEAR, LOAD, DT, STEPS = 5e6, 20.0, 1.0, 4  # Pa, Pa a step, s, steps at a time
WATER = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")]}
SEALED = {"fluid": mpm.Fluid()}
HEAVY = {"gravity": (0, 0), "numerics": mpm.Numerics(coupling="schur-fgmres"), **WATER}


def soil(law: type[mpm.Skeleton] = mpm.Hencky, nu: float = 0.0, **options) -> mpm.Skeleton:
    """Return a skeleton with this law and this Poisson ratio."""
    return law(bulk=2 * SHEAR * (1 + nu) / (3 * (1 - 2 * nu)), shear=SHEAR, **options)


def block(
    cells: int,
    material: mpm.Skeleton | None = None,
    box: float = 1.0,
    from_mesh: bool = False,
    axisymmetric: bool = False,
    grid: mpm.Grid | None = None,
    **options,
) -> mpm.Simulation:
    """Return the block, `cells` cells wide, in a grid of width `box`, in m."""
    h = 1 / cells
    count = [round(box * cells), round(box * cells) + 2]
    grid = grid or mpm.Grid([0, 0], [box, box + 2 * h], count, axisymmetric=axisymmetric)
    conditions = options.pop("conditions", [])
    if not any(isinstance(one, (mpm.Traction, mpm.Pressure)) for one in conditions):
        conditions = [mpm.Traction("top", lambda t: (0, -LOAD * t)), *conditions]
    walls = {"left": "x", "right": "x", "bottom": "y"}
    body = meshed(grid, cells) if from_mesh else mpm.box(grid, [0, 0], [1, 1])
    return mpm.Simulation(grid, [body], [material or soil()], walls=walls, conditions=conditions, **options)


def meshed(grid: mpm.Grid, cells: int):
    """Return the block, made from a mesh."""
    square = mesh.create_rectangle(MPI.COMM_SELF, [[0, 0], [1, 1]], [2 * cells] * 2, mesh.CellType.quadrilateral)
    top = np.sort(mesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[1], 1)))
    tags = mesh.meshtags(square, 1, top, np.ones(len(top), dtype=np.int32))
    return mpm.from_mesh(grid, square, facet_tags=tags, names={"top": 1})


def weighted(cells: int) -> mpm.Simulation:
    """Return the block with the ghost penalty on all faces."""
    ratio, ghost_penalty.RATIO = ghost_penalty.RATIO, 1e6
    try:
        simulation = block(cells)
    finally:
        ghost_penalty.RATIO = ratio
    simulation.scene.momentum.ghost.facets = lambda facets: facets
    return simulation


def restless(cells: int, **options) -> mpm.Simulation:
    """Return the block with a grid that is reset in each step."""
    simulation = block(cells, **options)
    motion = simulation.scene.motion
    motion.advanced = partial(motion.advanced, stays=False)
    return simulation


def of_many_sizes(cells: int, moves: bool, **options) -> mpm.Simulation:
    """Return the block in cells of two sizes, with grid lines that oscillate if `moves` is True."""

    def lines(t: float) -> list[np.ndarray]:
        even = [np.linspace(0, end, n + 1) for end, n in ((1, cells), (1 + 2 / cells, cells + 2))]
        for x in even:
            x[1:-1:2] += (0.1 + 0.01 * np.sin(t)) / cells
        return even

    return restless(cells, grid=mpm.Grid(lines=lines(0.0), follow=lines if moves else None), **options)


def refactorised(cells: int) -> mpm.Simulation:
    """Return the draining block, with a linear law that is treated as nonlinear."""
    simulation = linear(cells)
    simulation.scene.momentum.linear = False
    return simulation


def linear(cells: int) -> mpm.Simulation:
    """Return the draining block with a linear law."""
    return block(cells, soil(mpm.LinearElastic, conductivity=1e-4), **WATER)


def draining(cells: int, **options) -> mpm.Simulation:
    """Return the draining block."""
    return block(cells, soil(conductivity=1e-4), **{**WATER, **options})


def layered(cells: int, off: float) -> mpm.Simulation:
    """Return the draining block with four layers of two conductivities; interfaces are `off` cells from grid lines."""
    h, heights = 1 / cells, np.arange(5) / 4
    heights[1:-1] += off * h
    grid = mpm.Grid([0, 0], [1, 1 + 2 * h], [cells, cells + 2])
    bodies = [mpm.box(grid, [0, a], [1, b], material=k % 2) for k, (a, b) in enumerate(pairwise(heights))]
    soils = [soil(conductivity=k) for k in (1e-4, 1e-6)]
    load = mpm.Traction("top", lambda t: (0, -LOAD * t))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(grid, bodies, soils, walls=walls, **WATER | {"conditions": [load, *WATER["conditions"]]})


class Watched(mpm.Hencky):
    """Hencky's law with a damping of pressure jumps four times as strong as in `mpm.Hencky`."""

    def pressure_damping(self) -> float:
        return 4 * super().pressure_damping()


def conducting(cells: int, law: type[mpm.Skeleton]) -> mpm.Simulation:
    """Return the draining block, with a conductivity so large that pressure jumps are not damped."""
    kappa = 8 * soil().pressure_damping() / cells**2 / (GAMMA * DT)
    return block(cells, soil(law, conductivity=kappa * WATER["fluid"].unit_weight), **WATER)


def sealed_soil(cells: int, yields: bool = True) -> mpm.Simulation:
    """Return the undrained block of plastic soil, with pressure damping as in yielding soil if `yields` is True."""
    simulation = block(cells, soil(mpm.DruckerPrager, friction=0.0, dilation=0.0, cohesion=LOAD), **SEALED)
    if not yields:
        simulation.scene.materials._softness.clear()
    return simulation


def plastic(cells: int, law: type[mpm.Skeleton], **constants) -> mpm.Simulation:
    """Return the block of plastic soil far from yield."""
    return block(cells, soil(law, friction=30.0, dilation=0.0, cohesion=1e9, **constants))


def yielded(cells: int, **options) -> mpm.Simulation:
    """Return the block of yielding soil, with a grid that is reset in each step."""
    clay = soil(mpm.DruckerPrager, friction=0.0, dilation=0.0, cohesion=LOAD / 10)
    return restless(cells, material=clay, numerics=mpm.Numerics(**options))


def clayey(cells: int) -> mpm.Simulation:
    """Return the block of overconsolidated clay under an initial stress and a load."""
    p = 1e5  # Pa
    moduli = {"shear": SHEAR, "kappa": p / soil().bulk, "lambda_": 5 * p / soil().bulk}
    clay = mpm.ModifiedCamClay(M=1.2, OCR=4.0, initial_stress=(-p, -p, -p), **moduli)
    return block(cells, clay, conditions=[mpm.Traction("top", lambda t: (0, -p - LOAD * t))])


LOOSE = {"r": 0.5, "beta": 1e-5, "reference": 1e4}


def drying(cells: int, law: type[mpm.ModifiedCamClay], **constants) -> mpm.Simulation:
    """Return the draining block of overconsolidated clay, with suction that grows at the top."""
    p = 1e5  # Pa
    moduli = {"shear": SHEAR, "kappa": p / soil().bulk, "lambda_": 5 * p / soil().bulk, "conductivity": 1e-8}
    clay = law(M=1.2, OCR=4.0, initial_stress=(-p, -p, -p), retention=mpm.VanGenuchten(1e6), **moduli, **constants)
    top = mpm.Traction("top", lambda t: (0, -p - LOAD * t)), mpm.Drained("top", lambda t: -LOAD * t)
    return block(cells, clay, fluid=mpm.Fluid(), conditions=[*top])


def apart(cells: int, **options) -> mpm.Simulation:
    """Return the block and a narrower second body that touches nothing."""
    h = 1 / cells
    grid = mpm.Grid([0, 0], [1.5, 1 + 2 * h], [round(1.5 * cells), cells + 2])
    bodies = [mpm.box(grid, [0, 0], [1, 1]), mpm.box(grid, [1.25, 0], [1.5, 1])]
    load = mpm.Traction("top", lambda t: (0, -LOAD * t), region=((0, 0), (1, 2)))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(
        grid, bodies, [soil()], walls=walls, conditions=[load, *options.pop("conditions", [])], **options
    )


def stacked(cells: int, **options) -> mpm.Simulation:
    """Return two sealed wet blocks in contact.  Their pressures are equal, so no fluid flows between them."""
    h, soils = 1 / cells, [soil(conductivity=1e-4)]
    grid = mpm.Grid([0, 0], [1, 1 + 2 * h], [cells, cells + 2])
    bodies = [mpm.box(grid, [0, a], [1, b]) for a, b in ((0, 0.5), (0.5, 1))]
    load = mpm.Traction("top", lambda t: (0, -LOAD * t), region=((0, 0.9), (1, 2)))
    contact = mpm.Contact(0, 1, **options)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(grid, bodies, soils, walls=walls, fluid=mpm.Fluid(), conditions=[load, contact])


Make = Callable[[int], mpm.Simulation]
PAIRS: dict[str, tuple[Make, Make]] = {
    "pore fluid that drains at once": (block, lambda n: block(n, soil(conductivity=1e3), **WATER)),
    "flux between cells": (lambda n: block(n, **SEALED), lambda n: block(n, soil(conductivity=1e-30), **SEALED)),
    "seepage face": (draining, lambda n: draining(n, conditions=[mpm.Drained("top", seepage=True)])),
    "layers off the grid lines": (partial(layered, off=0.0), partial(layered, off=0.5)),
    "second order in time": (lambda n: draining(n, numerics=mpm.Numerics(method="backward-euler")), draining),
    "body force": (block, lambda n: block(n, gravity=(0, 0))),
    "initial stress": (block, lambda n: block(n, initial_stress=lambda x: np.zeros((len(x), 3)))),
    "pressure that follows the surface": (
        block,
        lambda n: block(n, conditions=[mpm.Pressure("top", lambda t: LOAD * t)]),
    ),
    "rough tool that touches nothing": (
        block,
        lambda n: block(n, conditions=[mpm.Tool(mpm.HalfSpace((0, 2), (0, -1)), friction=0.3)]),
    ),
    "contact of groups that are apart": (
        apart,
        lambda n: apart(n, conditions=[mpm.Contact(0, 1, friction=0.3)]),
    ),
    "contact that conducts": (stacked, lambda n: stacked(n, conducts=True)),
    "inertia": (block, lambda n: block(n, inertia=True)),
    "inertia of wet soil, both scenes with two substeps": (draining, lambda n: draining(n, inertia=True)),
    "free tool that touches nothing": (
        lambda n: block(n, inertia=True),
        lambda n: block(n, inertia=True, conditions=[mpm.Tool(mpm.HalfSpace((0, 2), (0, -1)), mass=1.0)]),
    ),
    "free disc that rotates and touches nothing": (
        lambda n: block(n, inertia=True),
        lambda n: block(n, inertia=True, conditions=[mpm.Tool(mpm.Ball((0.5, 20.0), 0.1), mass=1.0, spin=1.0)]),
    ),
    "quiet side": (
        lambda n: block(n, inertia=True),
        lambda n: block(n, inertia=True, conditions=[mpm.Quiet("right")]),
    ),
    "tied sides": (
        lambda n: block(n, inertia=True),
        lambda n: block(n, inertia=True, conditions=[mpm.Tied("left", "right")]),
    ),
    "ghost penalty on all faces": (block, weighted),
    "damping of pressure jumps": (lambda n: conducting(n, mpm.Hencky), lambda n: conducting(n, Watched)),
    "pressure damping of yielding instead of elastic soil": (lambda n: sealed_soil(n, yields=False), sealed_soil),
    "mean dilatation": (
        lambda n: block(n, soil(nu=LOCKING - 1e-3)),
        lambda n: block(n, soil(nu=LOCKING + 1e-3)),
    ),
    "plastic law, with mean dilatation": (
        block,
        partial(plastic, law=mpm.DruckerPrager),
    ),
    "volumes of yielded domains kept": (partial(yielded, keep_volumes=False), yielded),
    "renewal of domains, where none is renewed": (yielded, partial(yielded, renewal=True)),
    "Mohr-Coulomb instead of Drucker-Prager": (
        partial(plastic, law=mpm.DruckerPrager),
        partial(plastic, law=mpm.MohrCoulomb),
    ),
    "softening instead of Drucker-Prager": (
        partial(plastic, law=mpm.DruckerPrager),
        partial(plastic, law=mpm.SofteningDruckerPrager, residual=1e8, slip=1e3, viscosity=1.0),
    ),
    "Modified Cam Clay instead of Drucker-Prager": (partial(plastic, law=mpm.DruckerPrager), clayey),
    "Barcelona Basic instead of Modified Cam Clay": (
        partial(drying, law=mpm.ModifiedCamClay),
        partial(drying, law=mpm.BarcelonaBasic, **LOOSE),
    ),
    "finite strain instead of a linear law": (lambda n: block(n, soil(mpm.LinearElastic)), block),
    "linear law, factorised in each step": (linear, refactorised),
    "files written in each step": (block, block),
    "grid reset in each step": (block, restless),
    "grid lines that move": (partial(of_many_sizes, moves=False), partial(of_many_sizes, moves=True)),
    "division of domains, where none is divided": (
        partial(of_many_sizes, moves=True),
        partial(of_many_sizes, moves=True, numerics=mpm.Numerics(renewal=True)),
    ),
    "body from a mesh": (block, lambda n: block(n, from_mesh=True)),
    "axisymmetry": (
        lambda n: restless(n, material=soil(conductivity=1e-4), **WATER),
        lambda n: restless(n, material=soil(conductivity=1e-4), axisymmetric=True, **WATER),
    ),
    "free surface with specific yield": (
        lambda n: restless(n, material=soil(conductivity=1e-4, conductivity_law=mpm.unsaturated(1e3)), **WATER),
        lambda n: restless(
            n, material=soil(conductivity=1e-4, conductivity_law=mpm.unsaturated(1e3, 1e-4, 0.1)), **WATER
        ),
    ),
    "rain": (draining, lambda n: draining(n, conditions=[mpm.Rain("top", 1e3)])),
    "retention curve": (
        lambda n: restless(n, material=soil(conductivity=1e-8), **HEAVY),
        lambda n: restless(n, material=soil(conductivity=1e-8, retention=mpm.VanGenuchten(1e6)), **HEAVY),
    ),
    "16 times the background grid": (lambda n: restless(n, box=1 + 2 / n), lambda n: restless(n, box=4.0)),
    "256 times the background grid": (lambda n: restless(n, box=1 + 2 / n), lambda n: restless(n, box=16.0)),
}
QUICK = ("files written in each step",)
MAKES = [make for pair in PAIRS.values() for make in pair]


def take(simulation: mpm.Simulation, folder: str | None) -> tuple[float, mpm.Result]:
    """Take `STEPS` steps, and return the processor time of a step (s) and the result."""
    probe = mpm.probes(simulation.bodies, [[0.5, 1.0]])
    observe = [mpm.Writer(simulation, folder)] if folder else []
    end, began = simulation.t + STEPS * DT, time.process_time()
    result = simulation.run(end, DT, probes=probe, observe=observe, progress=False)
    return (time.process_time() - began) / result.steps, result


def first_step(make: Make, cells: int) -> dict[str, float]:
    """Return the processor time until the end of the first step (s) and the peak memory (MB)."""
    began = sum(os.times()[:4])  # the C compiler's too
    make(cells).step(DT)
    return {"seconds": sum(os.times()[:4]) - began, "memory": peak_memory()}


@cache
def compiled(make: Make, cells: int) -> tuple[float, float]:
    """Return the compilation time of a scene (s) and its peak memory (MB).

    The compilation time is the difference between two processes: one with an empty cache of compiled forms, and one
    with a full cache. The memory is the peak memory of the second process.
    """
    command = [sys.executable, __file__, "--cells", str(cells), "--one", str(MAKES.index(make))]
    with TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": folder}
        runs = [subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)]
    cold, warm = (json.loads(done.stdout.splitlines()[-1]) for done in runs)
    return cold["seconds"] - warm["seconds"], warm["memory"]


def measure(name: str, cells: int, repeat: int) -> dict:
    """Return the costs of a pair of scenes, each as a list of two values: without and with the feature."""
    pair = [make(cells) for make in PAIRS[name]]
    least, tops = [np.inf, np.inf], [0.0, 0.0]
    with TemporaryDirectory() as folder:
        files = [None, folder if name == "files written in each step" else None]
        for turn in range(repeat + 1):  # the first turn is not counted
            for k in (0, 1):
                seconds, result = take(pair[k], files[k] and f"{files[k]}/{turn}")
                tops[k] = result.displacement[-1][0, 1]
                if turn:
                    least[k] = min(least[k], seconds)
    compile_s, memory = zip(*(compiled(make, cells) for make in PAIRS[name]), strict=True)
    ratio, difference = least[1] / least[0], abs(tops[1] / tops[0] - 1)
    return {"step_s": least, "ratio": ratio, "compile_s": compile_s, "memory_MB": memory, "settlement": difference}


def line(name: str, row: dict) -> str:
    """Return a row of the Markdown table."""
    ms, compile_s = 1e3 * np.array(row["step_s"]), row["compile_s"]
    more = row["memory_MB"][1] - row["memory_MB"][0]
    times = f"{ms[0]:.1f} | {ms[1]:.1f} | {row['ratio']:.2f}"
    return f"| {name} | {times} | {compile_s[0]:.1f} | {compile_s[1]:.1f} | {more:+.0f} | {row['settlement']:.0e} |"


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=40, help="cells over the width of the block")
    parser.add_argument("--repeat", type=int, default=8, help="turns of each pair, after one that is not counted")
    parser.add_argument("--quick", action="store_true", help="one pair of small blocks, one turn")
    parser.add_argument("--only", nargs="+", choices=list(PAIRS), metavar="FEATURE", help="rows of these features only")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # index in MAKES
    o = parser.parse_args(argv)
    if min(o.cells, o.repeat) < 1:
        parser.error(f"--cells {o.cells} --repeat {o.repeat}: must be >= 1")
    if o.one is not None:
        print(json.dumps(first_step(MAKES[o.one], o.cells)))
        return {"converged": True}
    with common.results(o) as out:
        cells, repeat = (10, 1) if o.quick else (o.cells, o.repeat)
        head = ["feature", "step without (ms)", "with (ms)", "ratio", "compile without (s)", "with (s)"]
        lines = [common.markdown([[*head, "MB more", "settlement"]])]
        print(lines[0], flush=True)
        out |= {"cells": cells, "pairs": {}}
        for name in o.only or (QUICK if o.quick else PAIRS):
            out["pairs"][name] = measure(name, cells, repeat)
            lines.append(line(name, out["pairs"][name]))
            print(lines[-1], flush=True)
        o.out.mkdir(parents=True, exist_ok=True)
        (o.out / "pruning.md").write_text("\n".join(lines) + "\n")
    return out


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
