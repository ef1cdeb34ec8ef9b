# SPDX-License-Identifier: MIT
"""Changes of the results of a small scene with half and twice a number: `python tests/plateaus.py` measures all.

Arguments are numbers and scenes, such as domains/lattice.py:FAST@cycles. Without arguments, all numbers with a plateau
are measured, see `house`. The printed changes are the largest relative change of a result, and the change with finer
cells.
"""

import importlib
import sys
import time
from functools import cache
from pathlib import Path

import house
import numpy as np

import mpm_dolfinx as mpm

sys.path.insert(0, str(Path(__file__).parents[1] / "demos"))
import cycles
import footing
import helpers
import infiltration
import mpi_renewal
import slope as slopes
import vibration


def bent(h: float, nu: float = 0.0) -> dict[str, float]:
    """Return tip displacement and pressures of a saturated beam under a load on its top."""
    material = mpm.Hencky(bulk=1e7 / (3 * (1 - 2 * nu)), shear=1e7 / (2 * (1 + nu)), porosity=0.4, conductivity=1e-4)
    s, probe = helpers.beam(h=h, material=material)
    run = s.run(0.12, 0.02, probes=probe)
    tip, pressure = np.array(run.displacement), np.array(run.pressure)
    return {"tip": tip[-1].ravel()[1], "pressure": np.abs(pressure).max()}


def adaptive(h: float) -> dict[str, np.ndarray]:
    """Histories of the tip and the pressures of a saturated beam in adaptive steps."""
    s, _ = helpers.beam(h=h)
    low, _ = s.bodies[0].bounds
    probes = mpm.probes(s.bodies, low + np.array([[1.0, 0.15], [0.5, 0.1]]))
    run = s.run(0.12, 0.02, rtol=0.02, probes=probes, progress=False)
    return {"tip": run.displacement[:, 0, 1], "pressure": run.pressure, "inside": run.probe_pressure[:, 1]}


def at_points(h: float) -> dict[str, np.ndarray]:
    """History of the tip of a dry beam with integration at its points."""
    s, probe = helpers.beam(h=h, fluid=False, ramp=1.0, numerics=mpm.Numerics(quadrature="point"))
    return {"tip": s.run(1.0, 0.1, probes=probe, progress=False).displacement[:, 0, 1]}


def cycled(h: float) -> dict[str, float]:
    """Return the tip displacement of a dry beam after two load cycles, and its residual stress divided by the first
    peak.
    """
    run = cycles.cycle(h, 54e3, 2, 10)
    return {"tip": run["tips"][5], "left": 1 + run["left"][-1]}


def pushed(cells: int) -> dict[str, float]:
    """Return the load of a footing on yielding wet soil."""
    return {"load": footing.effort(cells, 0.06, 4, 2.0, "sdirk2")["load"]}


def strip(cells: int) -> dict[str, float]:
    """Return the load of a rough strip on soil without friction."""
    from test_footing import rough_strip

    return {"load": rough_strip(cells, "displacement")}


def flowing(cells: int) -> dict[str, float]:
    """Return the load of a disc that is pushed into clay with renewal of domains."""
    from mpm_dolfinx.stepping import renewal

    before, renewal.LONGEST = renewal.LONGEST, 0.6
    simulation = mpi_renewal.pushed(cells)
    simulation.run(0.06, 0.08 / cells, progress=False)
    renewal.LONGEST = before
    return {"load": float(simulation.tool_forces["tool"][1])}


def slope(cells: int) -> dict[str, float]:
    """Return settlement and pressures of loaded wet layers, which are inclined to the grid."""
    grid = mpm.Grid([0, 0], [1.5, 1.5], [3 * cells, 3 * cells])
    soils = [
        mpm.Hencky(bulk=1e7 / 3, shear=5e6, porosity=0.4, conductivity=conductivity) for conductivity in (1e-4, 1e-6)
    ]
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    boxes = [mpm.box(grid, [0, a], [0.6, b], material=i) for i, (a, b) in enumerate(((0.0, 0.3), (0.3, 0.6)))]
    bodies = [mpm.mapped(grid, body, lambda X: X @ turn.T + [0.5, 0.3]) for body in boxes]
    low, high = ((-np.inf, -np.inf), (np.inf, 0.15)), ((-np.inf, 0.45), (np.inf, np.inf))
    held = mpm.Displacement("bottom", (0, 0), region=low)
    load = mpm.Traction("top", lambda t: -1e5 * min(1, 10 * t) * turn[:, 1], region=high)
    acts = [held, load, mpm.Drained("top", region=high)]
    s = mpm.Simulation(grid, bodies, soils, walls={}, conditions=acts, fluid=mpm.Fluid())
    run = s.run(0.4, 0.1, probes=mpm.probes(bodies, [[0.3, 0.55], [0.3, 0.1]]))
    move, pressure = np.array(run.displacement), np.array(run.pressure)
    return {"tip": np.linalg.norm(move[-1].ravel()), "pressure": np.abs(pressure).max()}


def wetted(cells: int) -> dict[str, float]:
    """Return depth and absorbed water of a wetting front in dry soil (Celia)."""
    _, places, waters, _ = infiltration.front(cells, 3600.0)
    *_, (depth, _) = infiltration.FRONT.values()
    return {"front": depth + places[-1], "water": 1 + waters[-1]}


def forces_of(s: mpm.Simulation, end: float, dt: float, *names: str) -> dict[str, np.ndarray]:
    """Return the history of each named outcome: the forces (steps, conditions, d) on bodies, without moments."""
    seen: dict[str, list[np.ndarray]] = {name: [] for name in names}

    def see(s: mpm.Simulation) -> None:
        for name in names:
            seen[name].append(np.array(getattr(s, name).array)[:, :2])

    s.run(end, dt, observe=see, progress=False)
    return {name: np.array(values) for name, values in seen.items()}


EXACT = mpm.Numerics(tolerance=1e-10)
GROUND = mpm.Hencky(bulk=1e6 / 1.2, shear=1e6 / 2.6)
ROLLERS = {"left": "x", "right": "x", "bottom": "xy"}


def dragged(cells: int) -> dict[str, np.ndarray]:
    """A rough disc that presses soil and is then dragged over it, next to a rough block that presses it."""
    grid = mpm.Grid([0, 0], [4, 1.5], [4 * cells, round(1.5 * cells)])
    body = mpm.box(grid, [0, 0], [4, 1.03])

    def path(t: float) -> tuple[float, float]:
        return 0.1 * max(0.0, t - 1), -0.1 * min(1, t)

    disc = mpm.Tool(mpm.Ball((1.0, 1.53), 0.5), path, friction=0.3, adhesion=2e3)
    block = mpm.Convex([(2.43, 1.03), (3.07, 1.03), (3.07, 1.4), (2.43, 1.4)])
    rough = mpm.Tool(block, lambda t: (0, path(t)[1]), friction=0.5)
    s = mpm.Simulation(grid, [body], [GROUND], walls=ROLLERS, conditions=[disc, rough], numerics=EXACT)
    return forces_of(s, 2.0, 0.125, "tool_forces")


def rubbed(cells: int) -> dict[str, np.ndarray]:
    """A block with a round base, pressed on another one and pushed aside: its base slides in part, then as a whole."""
    grid = mpm.Grid([0, 0], [3, 1.5], [3 * cells, round(1.5 * cells)])
    lower = mpm.box(grid, [0, 0], [3, 0.53], material=0)
    upper = mpm.mapped(
        grid,
        mpm.box(grid, [1, 0.53], [2, 1.03], per_cell=3, material=1),
        lambda x: x + (1.03 - x[:, 1:]) * np.array([0, 0.2]) * (2 * x[:, :1] - 3) ** 2,
    )

    def path(t: float) -> tuple[float, float]:
        return 0.1 * max(0.0, t - 1), -0.08 * min(1, t)

    held = mpm.Displacement("top", path, region=((1, 0.9), (2, 1.1)))
    soils = [GROUND, mpm.Hencky(bulk=2e6, shear=1e6)]
    acts = [held, mpm.Contact(1, 0, friction=0.3)]
    s = mpm.Simulation(grid, [lower, upper], soils, walls=ROLLERS, conditions=acts, numerics=EXACT)
    return forces_of(s, 2.0, 0.125, "tool_forces")


def gripped(cells: int) -> dict[str, np.ndarray]:
    """A block on a rough base whose top is moved down and aside and is turned, over more than a cell."""
    grid = mpm.Grid([0, 0], [2, 1.5], [2 * cells, round(1.5 * cells)])

    def path(t: float, X: np.ndarray) -> np.ndarray:
        angle, arm = 0.15 * t, X - [0.9, 1.03]
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return arm @ turn.T - arm + [0.2 * t, -0.2 * t]

    held = [mpm.Displacement("top", path), mpm.Displacement("bottom", (0, 0))]
    body = mpm.box(grid, [0.43, 0.03], [1.37, 1.03])
    s = mpm.Simulation(grid, [body], [GROUND], walls={}, conditions=held, numerics=EXACT)
    return forces_of(s, 1.0, 0.125, "reactions")


def tilted(cells: int) -> dict[str, np.ndarray]:
    """A rigid plate under a load on two soils side by side, of which one is soft: forces of the walls."""
    grid = mpm.Grid([0, 0], [2, 1.5], [2 * cells, round(1.5 * cells)])
    halves = [mpm.box(grid, [a, 0], [a + 1, 1.03], material=a) for a in (0, 1)]
    soils = [GROUND, mpm.Hencky(bulk=2e6, shear=1e6)]
    plate = mpm.RigidPlate("top", lambda t: 2e5 * t)
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, halves, soils, walls=walls, conditions=[plate])
    return forces_of(s, 1.0, 0.25, "wall_reactions")


def vibrating(cells: int) -> dict[str, np.ndarray]:
    """A free bar that vibrates and moves over 2.5 of its lengths in 10 periods: histories of its end and its energy."""
    run = vibration.flown(cells, 10, 20)
    return {name: run[name] for name in ("swing", "energy")}


def stable(cells: int) -> dict[str, float]:
    """Return the factor of safety of a slope."""
    return {"factor": mpm.factor_of_safety(slopes.slope(cells), rtol=0.0025, progress=False).factor}


SCENES = {
    "beam": (bent, 0.06, 0.03),
    "clay": (lambda h: bent(h, 0.46), 0.06, 0.03),
    "cycles": (cycled, 0.06, 0.03),
    "soil": (pushed, 5, 9),
    "strip": (strip, 5, 9),
    "slope": (slope, 6, 12),
    "dry": (wetted, 25, 50),
    "flow": (flowing, 8, 16),
    "tool": (dragged, 8, 16),
    "contact": (rubbed, 8, 16),
    "held": (gripped, 8, 16),
    "plate": (tilted, 8, 16),
    "adaptive": (adaptive, 0.06, 0.03),
    "points": (at_points, 0.06, 0.03),
    "bar": (vibrating, 10, 20),
    "safety": (stable, 4, 8),
}
"""Function of each scene, its cells (number or size) while a number is varied, and finer cells for comparison."""


def holders(where: str, name: str) -> list:
    """Return the modules that hold a number under its name, beginning with the module that defines it."""
    own = importlib.import_module(".".join([house.ROOT.name, *Path(where).with_suffix("").parts]))
    every = [importlib.import_module(m.name) for m in house.modules() if m.path.name != "__main__.py"]
    return [own, *(m for m in every if m is not own and getattr(m, name, None) is getattr(own, name))]


@cache
def answer(scene: str, finer: bool = False) -> dict[str, float]:
    """Return the results of a scene with the present numbers."""
    run, *cells = SCENES[scene]
    return run(cells[finer])


def change(a: dict[str, float], b: dict[str, float]) -> float:
    """Return the largest change of an answer, divided by the answer, or by the largest value of a history."""
    return max(float(np.abs(a[name] - b[name]).max() / np.abs(b[name]).max()) for name in b)


def moved(where: str, name: str, scene: str) -> tuple[float, float, float]:
    """Return the changes of a scene's results with half and twice a number, and with finer cells."""
    run, cells, _ = SCENES[scene]
    plain, modules, out = answer(scene), holders(where, name), []
    value = getattr(modules[0], name)
    for factor in (0.5, 2):
        other = type(value)(value * factor) if isinstance(value, int | float) else tuple(v * factor for v in value)
        try:
            for module in modules:
                setattr(module, name, other)
            out.append(change(run(cells), plain))
        finally:
            for module in modules:
                setattr(module, name, value)
    return out[0], out[1], change(answer(scene, True), plain)


def main(arguments: list[str]) -> None:
    """Print a line for each number."""
    noted = {}
    for where, name, said in house.named():
        if flat := house.plateau(said):
            noted[f"{where.split(':')[0]}:{name}"] = flat
    for item in arguments or [f"{item}@{flat[0]}" for item, flat in noted.items()]:
        number, _, scene = item.partition("@")
        where, _, name = number.rpartition(":")
        began = time.time()
        found = moved(where, name, scene)
        half, twice, cells = (f"{value:.1e}" for value in found)
        where = f'Sensitivity (scene "{scene}" of tests/plateaus.py): half this value changes the result by {half}'
        told = f"{where}, and twice this value by {twice}. Finer cells change it by {cells}."
        print(f"{number} {told}  {time.time() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
