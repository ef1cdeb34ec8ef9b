# SPDX-License-Identifier: MIT
"""Forces and fluid of a scene, counted from its points and conditions, independently of the scheme.

Forces follow from the work of rigid translations: dead loads by the areas of sides as drawn, weights by the masses of
points, reactions of conditions, tools and walls, and the nodal forces of an initial stress. Fluid follows from the
pores of the points.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.conditions.conditions import HOLD
from mpm_dolfinx.grid.grid import SIDES
from scenes.comparing import NOTHING, softest, stress_of_rounding
from scenes.description import WATER, Block, Condition, Draw, Scene, drawn
from scenes.running import Built

HARD = 1e9
"""Pa: of softer water, what is owed to a point of several cells is no more a volume at one pressure: cells count its
weight by its volume, and it is not told by the points.
"""
ROUNDED = 30
"""What many places and steps make of roundings, see `comparing.resolved`."""
COUNTED = ("traction", "plate", "displacement", "drained", "seepage", "inflow")


def balanced(seed: int, **given) -> Scene:
    """Return a scene whose loads can be counted from its description: no pressures, springs, compressible grains."""
    scene = drawn(seed, **given)
    laws = [
        (law, constants | {"biot": 1.0} if "biot" in constants else constants) for law, constants in scene.materials
    ]
    conditions = tuple(c for c in scene.conditions if c.kind in COUNTED)
    stage = scene.stage if scene.stage and scene.stage.kind in ("load", "free", "reset") else None
    scene = scene.with_(conditions=conditions, materials=tuple(laws), stiffness=0.0, stage=stage, rtol=None)
    if scene.fluid is not None:  # what leaves in a step is then what the last outflow says
        scene = scene.with_(method="backward-euler")
    return scene


def held_by_conditions(seed: int, **given) -> Scene:
    """Return such a scene that no wall touches: its base is held by a given displacement, and nothing else."""
    scene, draw = balanced(seed, **given), Draw([seed, 3])
    bodies = []
    for block in scene.bodies:
        low, high = np.array(block.lower), np.array(block.upper)
        for axis in range(scene.axisymmetric, scene.dim - 1):
            low[axis] = max(low[axis], 0.7 * scene.h[axis])
            high[axis] = min(high[axis], scene.size[axis] - 0.8 * scene.h[axis])
        if scene.axisymmetric:
            high[0] = min(high[0], scene.size[0] - 0.8 * scene.h[0])
        raised = draw.between(0.3, 0.7) if block is scene.bodies[0] else 0.0
        low[-1] += raised * (high[-1] - low[-1])
        bodies.append(Block(**vars(block) | {"lower": tuple(low), "upper": tuple(high)}))
    base = Condition("displacement", "bottom", (0.0,) * scene.dim, 0.0, "")
    conditions = [c for c in scene.conditions if c.side != "bottom"]  # whose region is the floor's
    scene = scene.with_(bodies=tuple(bodies), walls={}, conditions=(*conditions, base), initial=None, level=None)
    return scene.with_(stage=scene.stage if scene.stage and scene.stage.kind == "load" else None)


def area(scene: Scene, condition: Condition) -> float:
    """Return the seeded area of a condition on the free sides of boxes."""
    axis, end = SIDES[scene.dim][condition.side]
    total = 0.0
    for number, block in enumerate(scene.bodies):
        if axis == scene.dim - 1 and number != end * (len(scene.bodies) - 1):
            continue  # another one lies on it
        low, high = np.array(block.lower, dtype=float), np.array(block.upper, dtype=float)
        low[axis] = high[axis] = (low, high)[end][axis]
        if condition.region is not None:
            low, high = np.maximum(low, condition.region[0]), np.minimum(high, condition.region[1])
        total += _size(scene, block, low, high, axis)
    return total


def _size(scene: Scene, block: Block, low: NDArray, high: NDArray, axis: int) -> float:
    """Return the area of a rectangle across an axis after the map that makes blocks narrower above."""
    if (high < low).any():
        return 0.0
    left, top = block.lower[0], scene.bodies[-1].upper[-1]

    def image(x):
        y = np.array(x, dtype=float)
        y[0] -= block.slant * (y[0] - left) * y[-1] / top
        return y

    a, b = image(low), image(high)
    if scene.dim == 2:
        length = float(np.linalg.norm(b - a))
        return length * (np.pi * (a[0] + b[0]) if scene.axisymmetric else 1.0)
    if axis == 0:  # it leans
        return float(np.linalg.norm((b - a)[[0, 2]]) * (b - a)[1])
    others = [k for k in range(3) if k != axis]
    size = np.abs(b - a)[others].prod()
    if axis == 1:  # a trapezium
        upper, lower = (image([x, low[1], z])[0] for x, z in ((high[0], high[2]), (high[0], low[2])))
        size = ((upper - a[0]) + (lower - a[0])) / 2 * (high[2] - low[2])
    return float(size)


@dataclass
class Ledger:
    """Values counted after each step of a scene, see `counted`.

    off : largest resultant of all forces, over the largest force; leaked: spurious gain or loss of fluid, over the
    exchanged fluid; said: terms of the worst one.
    """

    off: float = 0.0
    leaked: float = 0.0
    said: str = ""
    _start: tuple | None = field(default=None, repr=False)
    _moved: float = 0.0
    _out: float = 0.0
    _before: NDArray[np.float64] | None = field(default=None, repr=False)
    _held: NDArray[np.float64] | float = field(default=0.0, repr=False)

    def __call__(self, built: Built) -> None:
        simulation = built.simulation
        if self._start is None:
            self._start = (_fluid(built), _pores(built), simulation.t) if built.scene.fluid is not None else (0, 0, 0)
        else:
            if not (built.scene.gravity and built.scene.fluid is not None and built.scene.fluid < HARD):
                self._count_forces(built)
            if built.scene.fluid is not None:
                self._count_fluid(built)
        self._before = _owed(built)
        self.begun(built)

    def begun(self, built: Built) -> None:
        """Note the forces that hold the state at rest; a stage may end them."""
        held = built.simulation.state.held
        self._held = 0.0 if held is None else held.reshape(-1, built.scene.dim).sum(axis=0)

    def _count_forces(self, built: Built) -> None:
        scene, s = built.scene, built.simulation
        d, ramp = scene.dim, lambda c: min(1.0, s.t / c.ramp) if c.ramp else 1.0
        parts, load = {}, built.loads["factor"]
        for i, c in enumerate(scene.conditions):
            if c.kind == "traction":
                parts[f"traction {i}"] = load * ramp(c) * area(scene, c) * np.array(c.value)
            if c.kind == "plate":
                down = np.zeros(d)
                down[-1] = -1.0
                parts[f"plate {i}"] = load * ramp(c) * c.value[0] * down
        down = np.zeros(d)
        down[-1] = -scene.gravity
        parts["weight"] = _mass(built, self._before) * down
        parts["reactions"] = s.reactions.array.reshape(-1, d).sum(axis=0)
        parts["tools"] = s.tool_forces.array.reshape(-1, 3 * d - 3)[: len(scene.tools), :d].sum(axis=0)
        parts["walls"] = sum(s.wall_reactions.values())
        parts["held at rest"] = self._held  # of which the log has told
        total = np.abs(sum(parts.values())[int(scene.axisymmetric) :]).max()
        d = scene.dim if not scene.axisymmetric else 3
        total = max(0.0, total - ROUNDED * HOLD * stress_of_rounding(scene) * min(scene.h) ** (d - 1))
        # what nothing but itself presses on has a stress of its own
        stress = max(np.abs(s.effective_stress()).max(), NOTHING * softest(scene)) * min(scene.h) ** (d - 1)
        most = max(stress, *(np.abs(v).max() for v in parts.values()))
        if total > self.off * most:
            self.off = total / most
            self.said = f"t = {s.t:.3g}: " + ", ".join(
                f"{k} {np.array2string(np.asarray(v), precision=9)}" for k, v in parts.items()
            )

    def _count_fluid(self, built: Built) -> None:
        scene, s = built.scene, built.simulation
        fluid, pores, t = self._start
        dt, outflows = s.t - t, np.nan_to_num(s.outflows.array)
        volume = pores.sum() + (s.points.volume0 * (1 - _of_points(built, "porosity"))).sum()  # when the step began
        self._out += dt * (float(outflows.sum()) - scene.rate * volume)
        now = _pores(built)
        self._moved += float(np.abs(now - pores).sum()) + dt * (float(np.abs(outflows).sum()) + scene.rate * volume)
        self._start = (fluid, now, s.t)
        digits = np.finfo(float).eps * scene.size.max() / min(scene.h)  # of a strain, as `comparing.stress_of_rounding`
        off = max(0.0, abs(_fluid(built) - fluid + self._out) - ROUNDED * digits * volume)
        if self._moved:
            self.leaked = max(self.leaked, off / self._moved)


def _of_points(built: Built, name: str) -> NDArray[np.float64]:
    """Return a constant of the material of each point."""
    s = built.simulation
    return np.array([getattr(law, name) for law in built.laws], dtype=float)[s.points.material]


def _pores(built: Built) -> NDArray[np.float64]:
    """Return the volume of the pores of each point (n,)."""
    points = built.simulation.points
    return points.volume0 * (points.J - (1 - _of_points(built, "porosity")))


def _fluid(built: Built) -> float:
    """Return the mass of all fluid over its density at zero pressure, with the volume defect of the points, m^d.

    Pressures are the pieces' pressures, carried from cell to cell or kept with the cut.
    """
    s, bulk = built.simulation, built.scene.fluid
    points, density = s.points, 1.0
    if np.isfinite(bulk):
        pieces = s.state.pieces
        pressure = pieces.of_cell if pieces.pressure is None else pieces.pressure
        at = np.searchsorted(points.id, pieces.id)
        density = np.bincount(at, pieces.fraction * np.exp(pressure / bulk), minlength=len(points))
    return float((_pores(built) * density - points.volume0 * points.data.get("owed", 0.0)).sum())


def _mass(built: Built, taken: NDArray[np.float64]) -> float:
    """Return the mass of skeleton and fluid, kg; fluid at zero pressure fills the pores of the balances.

    taken: volume defect and correction of the points at the start of the step (2, n). The volumes of their domains
    differ by the change of it.
    """
    points = built.simulation.points
    grains = points.volume0 * (1 - _of_points(built, "porosity")) * _of_points(built, "grain_density")
    if built.scene.fluid is None:
        return float(grains.sum())
    density = np.exp(points.pressure / built.scene.fluid)  # what is owed is mass
    seen = _pores(built) - points.volume0 * (points.data["owed"] - taken[0] + taken[1]) / density
    return float(grains.sum() + WATER * seen.sum())


def _owed(built: Built) -> NDArray[np.float64]:
    """Return volume defect and correction of the points (2, n), over reference volumes."""
    data = built.simulation.points.data
    return np.stack([data["owed"], data["due"]]) if "owed" in data else np.zeros((2, 1))
