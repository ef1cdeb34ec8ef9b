# SPDX-License-Identifier: MIT
"""What a scene is: plain data, drawn from all features by a seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

Vector = tuple[float, ...]
G = 9.81  # m/s^2
WATER = 1000.0  # kg/m^3
ELASTIC = ("Hencky", "NeoHookean", "LinearElastic")
PLASTIC = ("DruckerPrager", "SofteningDruckerPrager", "MohrCoulomb", "ModifiedCamClay")
AXES = "xyz"
FAR = 1e6  # m: beyond everything


@dataclass(frozen=True)
class Block:
    """A body: a box, bent by `slant`, or filled by a mesh.

    kind: "box", "quad", "triangle" ("hexahedron", "tetra" in 3D); lower, upper, m; per_cell: points; slant: by which
    share of its width its top is shifted; uneven: by which share of an edge inner nodes of a mesh lie off, by its seed.
    """

    lower: Vector
    upper: Vector
    material: int
    per_cell: int = 2
    kind: str = "box"
    slant: float = 0.0
    uneven: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Condition:
    """A condition on a side.

    kind: "traction", "normal", "pressure", "displacement", "plate", "drained", "seepage", "inflow", "rain", "springs",
    "quiet", "tied"; value: along the axes, or one number, of rain its flux, m/s, and pressures of its pond and of air,
    Pa; it grows until the time `ramp`, s, if that is not 0; components: that are given; region: box of reference
    positions, m.
    """

    kind: str
    side: str
    value: Vector
    ramp: float = 0.0
    components: str = ""
    region: tuple[Vector, Vector] | None = None


@dataclass(frozen=True)
class RigidTool:
    """A tool: shape "ball", "plate" or "wedge" at a place, m; travel, m, until `ramp`, s, or a load, N, along it.

    mass: of a free tool, kg/m, that flies with the velocity travel / ramp and turns with a spin, 1/s.
    """

    shape: str
    place: Vector
    size: float
    travel: Vector
    ramp: float
    friction: float = 0.0
    adhesion: float = 0.0
    load: float = 0.0
    mass: float = 0.0
    moment: float = 0.0
    spin: float = 0.0


@dataclass(frozen=True)
class Stage:
    """What changes after the first run: "remove", "add", "load", "reset", "free", "move", "rest".

    With "move" inertia begins, and with "rest" it ends.
    """

    kind: str
    body: int = -1


@dataclass(frozen=True)
class Scene:
    """A scene in SI units, its height along the last axis.

    cells, h : (d,), -, m — of the grid, which begins at the origin; materials: name of the law, its constants;
    initial: stress at rest, None or "K0" or "given", with `ratio` and `surcharge`, Pa; level: of the water table, m;
    contact: friction between the last body and the others; rate: of a source, 1/s; stiffness: of springs in the bodies,
    N/m^4; uneven: whether grid lines lie at random; renewal: whether domains of yielded soil are renewed;
    follows: whether grid lines follow the first tool; inertia: whether bodies have it; flight: their velocity at the
    start, m/s.
    """

    seed: int
    cells: tuple[int, ...]
    h: Vector
    axisymmetric: bool
    bodies: tuple[Block, ...]
    materials: tuple[tuple[str, Mapping[str, Any]], ...]
    walls: Mapping[str, str]
    conditions: tuple[Condition, ...] = ()
    tools: tuple[RigidTool, ...] = ()
    fluid: float | None = None
    gravity: float = 0.0
    initial: str | None = None
    ratio: float = 0.5
    surcharge: float = 0.0
    level: float | None = None
    contact: float | None = None
    rate: float = 0.0
    stiffness: float = 0.0
    end: float = 1.0
    steps: int = 2
    rtol: float | None = None
    method: str = "sdirk2"
    stage: Stage | None = None
    tolerance: float = 1e-11
    uneven: bool = False
    renewal: bool = False
    follows: bool = False
    inertia: bool = False
    flight: Vector = ()

    @property
    def dim(self) -> int:
        return len(self.cells)

    @property
    def size(self) -> np.ndarray:
        """Edges of the grid (d,), m."""
        return np.array(self.cells) * np.array(self.h)

    def lines(self) -> list[np.ndarray]:
        """Places of the grid lines along each axis, m; uneven: neighbouring cells are up to three times as wide."""
        if not self.uneven:
            return [h * np.arange(n + 1) for n, h in zip(self.cells, self.h, strict=True)]
        rng, out = np.random.default_rng(self.seed), []
        if self.follows:  # fine about the middle, where lines are carried along
            wide = (1 + 0.5 * np.abs(np.arange(n) - (n - 1) / 2) for n in self.cells)
            of = (np.append(0.0, np.cumsum(width)) for width in wide)
            return [size * x / x[-1] for x, size in zip(of, self.size, strict=True)]
        for n, size in zip(self.cells, self.size, strict=True):
            x = np.append(0.0, np.cumsum(rng.uniform(1, 3, n)))
            out.append(size * x / x[-1])
        return out

    def with_(self, **changes) -> Scene:
        return replace(self, **changes)

    def line(self) -> str:
        """Return what the scene has, in one line."""
        laws = "+".join(self.materials[b.material][0] for b in self.bodies)
        kinds = "+".join(b.kind + ("*" if b.slant else "") for b in self.bodies)
        conditions = " ".join(f"{c.kind}@{c.side}" for c in self.conditions)
        parts = [
            f"{self.seed}:",
            "axi" if self.axisymmetric else f"{self.dim}D",
            f"{kinds} {laws}",
            "dry" if self.fluid is None else "wet",
            conditions,
            *(
                f"tool {t.shape}{' pushed' if t.load else ' free' if t.mass else ''}"
                + (" rough" if t.friction + t.adhesion else "")
                for t in self.tools
            ),
            f"contact {self.contact:.1g}" if self.contact is not None else "",
            f"initial {self.initial}" if self.initial else "",
            "+".join(law["retention"][0] for _, law in self.materials if law.get("retention")),
            "source" if self.rate else "",
            "springs" if self.stiffness else "",
            "inertia" if self.inertia else "",
            "flight" if self.flight else "",
            "renewal" if self.renewal else "",
            "lines follow" if self.follows else "",
            self.method if self.method != "sdirk2" else "",
            f"rtol {self.rtol:g}" if self.rtol else "",
            f"stage {self.stage.kind}" if self.stage else "",
        ]
        return " ".join(part for part in parts if part)


@dataclass
class Draw:
    """Random choices of a seed."""

    seed: int
    r: np.random.Generator = field(init=False)

    def __post_init__(self):
        self.r = np.random.default_rng(self.seed)

    def yes(self, share: float) -> bool:
        return bool(self.r.random() < share)

    def between(self, low: float, high: float) -> float:
        return float(self.r.uniform(low, high))

    def order(self, low: float, high: float) -> float:
        return float(10 ** self.r.uniform(low, high))

    def whole(self, low: int, high: int) -> int:
        """Return a number from low to high, both of them possible."""
        return int(self.r.integers(low, high + 1))

    def one(self, *of, weights=None):
        p = None if weights is None else np.divide(weights, np.sum(weights))
        return of[int(self.r.choice(len(of), p=p))]


def material(draw: Draw, law: str, wet: bool) -> tuple[str, dict[str, Any]]:
    """Return a law and its constants."""
    E, nu = draw.order(5.7, 7.0), draw.one(0.2, 0.3, 0.4, 0.47)
    constants = {
        "bulk": E / 3 / (1 - 2 * nu),
        "shear": E / 2 / (1 + nu),
        "porosity": draw.between(0.3, 0.5),
        "grain_density": draw.between(2500, 2800),
    }
    if wet:
        constants["conductivity"] = draw.order(-9, -4) if draw.yes(0.85) else 0.0
        constants["biot"] = draw.between(0.7, 1.0) if draw.yes(0.2) else 1.0
        constants["kozeny_carman"] = draw.yes(0.2) and constants["conductivity"] > 0
    if law in PLASTIC[:3]:
        friction = draw.between(15, 35)
        dilation = draw.one(0.0, 0.5, 1.0) * friction
        constants |= {"cohesion": draw.order(3.6, 4.6), "friction": friction, "dilation": dilation}
    if law == "SofteningDruckerPrager":
        constants |= {"residual": 0.7 * constants["cohesion"], "slip": draw.between(0.1, 0.3)}
        constants |= {"viscosity": draw.one(0.0, 1e4)}
    if law == "ModifiedCamClay":
        del constants["bulk"]
        lam = draw.between(0.05, 0.1)
        constants |= {"M": draw.between(0.9, 1.3), "lambda_": lam, "kappa": lam / draw.between(4, 6)}
        constants |= {"initial_stress": (-5e4,) * 3, "OCR": draw.between(1.0, 2.5)}
    return law, constants


def laws(draw: Draw, at_rest: bool) -> list[str]:
    """Return one or two laws; Cam Clay needs a stress at rest."""
    known = (*ELASTIC, *PLASTIC) if at_rest else (*ELASTIC, *PLASTIC[:3])
    weights = [4, 1, 1.5, 2, 0.7, 2, 2][: len(known)]
    return [draw.one(*known, weights=weights) for _ in range(draw.whole(1, 2))]


def drawn(seed: int, **given) -> Scene:
    """Return the scene of a seed; given: choices that are not to be drawn, "dim", "axisymmetric", "wet", "laws"."""
    draw = Draw(seed)
    dim, axisymmetric = draw.one((2, False), (2, True), (3, False), weights=[6, 2, 1])
    dim, axisymmetric = given.get("dim", dim), given.get("axisymmetric", axisymmetric)
    cells = tuple(draw.whole(*((5, 7) if dim == 2 else (3, 4))) for _ in range(dim))
    h = [draw.between(0.3, 0.6)] * dim
    if draw.yes(0.5):
        h = [draw.between(0.3, 0.6) for _ in range(dim)]
    size = np.array(cells) * h
    wet, gravity = given.get("wet", draw.yes(0.6)), draw.one(0.0, G)
    contact = draw.one(0.0, 0.3) if not axisymmetric and draw.yes(0.12) else None
    initial = draw.one("K0", "given") if gravity and contact is None and draw.yes(0.6) else None
    names = given.get("laws") or laws(draw, initial is not None)
    lower, upper, walls = _ground(draw, size, h, dim, axisymmetric)
    bodies, materials = [], []
    tops = _levels(draw, upper[-1], h[-1], 2 if contact is not None else draw.whole(1, 3))
    for i, (low, high) in enumerate(pairwise(tops)):
        block = Block(
            (*lower[:-1], low), (*upper[:-1], high), i, draw.one(1, 2, 3, weights=[1, 6, 1]) if dim == 2 else 2
        )
        if draw.yes(0.3):
            kind = draw.one("quad", "triangle") if dim == 2 else "hexahedron"
            block = replace(block, kind=kind, uneven=draw.between(0.05, 0.2), seed=draw.whole(0, 10**6))
        bodies.append(block)
        materials.append(material(draw, draw.one(*names), wet))
    if contact is not None:  # the last one is a block on the others
        wide = upper[0] - lower[0]
        gap = draw.one(0.0, 0.02 * h[-1])
        low, high = list(bodies[-1].lower), list(bodies[-1].upper)
        low[0], high[0] = lower[0] + draw.between(0.1, 0.25) * wide, upper[0] - draw.between(0.1, 0.3) * wide
        low[-1] += gap
        bodies[-1] = replace(bodies[-1], lower=tuple(low), upper=tuple(high))
    elif not walls.keys() & {"right"} and draw.yes(0.4):
        slant = draw.between(0.05, 0.25)
        bodies = [replace(b, slant=slant) for b in bodies]
    scene = Scene(seed, cells, tuple(h), axisymmetric, tuple(bodies), tuple(materials), walls)
    scene = scene.with_(
        fluid=draw.one(np.inf, 2.2e9, 1e7) if wet else None,
        gravity=gravity,
        initial=initial,
        ratio=draw.between(0.4, 1.0),
        surcharge=draw.between(5e3, 3e4) if initial else 0.0,
        contact=contact,
        end=draw.order(1, 4),
        steps=draw.whole(2, 3),
        method=draw.one("sdirk2", "backward-euler", weights=[3, 1]),
    )
    scene = _loaded(draw, scene)
    if wet:
        scene = _watered(draw, scene)
    scene = scene.with_(
        rtol=2e-3 if wet and scene.method == "sdirk2" and draw.yes(0.15) else None,
        rate=draw.order(-9, -7) if wet and contact is None and draw.yes(0.15) else 0.0,
        stiffness=draw.order(3, 5) if contact is None and draw.yes(0.15) else 0.0,
    )
    return scene.with_(stage=_stage(draw, scene))


def draining(seed: int, **given) -> Scene:
    """Return the scene of a seed whose pores drain: with retention, a water table, rain or evaporation; as `drawn`."""
    scene, draw = drawn(seed, wet=True, **given), Draw([seed, 4])
    kinds = [_retention(draw) for _ in range(draw.whole(1, 2))]
    of = [draw.one(*kinds) if draw.yes(0.85) else None for _ in scene.materials]
    of[0] = of[0] or kinds[0]
    materials = tuple((law, c | {"retention": kind}) for (law, c), kind in zip(scene.materials, of, strict=True))
    top = scene.bodies[-1].upper[-1]
    scene = scene.with_(materials=materials, level=top * draw.between(-0.5, 0.9))
    if draw.yes(0.3):
        return scene
    rain = draw.one(-1.0, 1.0, weights=[1, 2]) * draw.order(-8, -4), draw.one(0.0, 200.0), -draw.order(4, 6)
    kept = [c for c in scene.conditions if c.side != "top" or c.kind not in ("drained", "seepage", "inflow")]
    region = _above(scene) if scene.contact is not None else None
    return scene.with_(
        conditions=(*kept, Condition("rain", "top", rain, scene.end * draw.one(0.0, 0.6), region=region))
    )


def newer(seed: int, **given) -> Scene:
    """Return the scene of a seed in 2D with inertia, quiet or tied sides, a free tool, or lines that follow a tool."""
    scene, draw = drawn(seed, dim=2, axisymmetric=False, **given), Draw([seed, 5])
    while scene.contact is not None:
        scene = drawn(draw.whole(0, 10**6), dim=2, axisymmetric=False, **given).with_(seed=seed)
    kind = draw.one("inertia", "quiet", "tied", "free", "follow")
    scene = scene.with_(stage=None, rtol=None, initial=None, surcharge=0.0, level=None, method="sdirk2")
    if kind in ("inertia", "quiet", "free") or (kind == "tied" and draw.yes(0.5)):
        scene = _moving(draw, scene)
    if kind == "quiet":
        side, walls = "right" if "right" not in scene.walls else "bottom", dict(scene.walls)
        if side == "bottom":
            del walls["bottom"]
            up = np.array([0.0, 0.4 * scene.h[1]])  # off the grid's edge
            raised = (replace(b, lower=tuple(b.lower + up), upper=tuple(b.upper + up)) for b in scene.bodies)
            tools = (replace(t, place=tuple(t.place + up)) for t in scene.tools)
            scene = scene.with_(gravity=0.0, bodies=tuple(raised), tools=tuple(tools))
        kept = [c for c in scene.conditions if c.side != side]
        return scene.with_(walls=walls, conditions=(*kept, Condition("quiet", side, ())))
    if kind == "tied":
        low, high = 0.7 * scene.h[0], scene.size[0] - 0.8 * scene.h[0]
        blocks = (replace(b, slant=0.0, kind="box") for b in scene.bodies)
        bodies = tuple(replace(b, lower=(low, b.lower[1]), upper=(high, b.upper[1])) for b in blocks)
        kept = [c for c in scene.conditions if c.side not in ("left", "right")]
        tied = Condition("tied", "left", ())
        return scene.with_(bodies=bodies, walls={"bottom": "xy"}, conditions=(*kept, tied))
    if kind in ("free", "follow"):
        flat = tuple(replace(b, slant=0.0) for b in scene.bodies)
        kept = tuple(c for c in scene.conditions if c.side != "top" or c.kind in ("drained", "seepage", "inflow"))
        scene = scene.with_(bodies=flat, conditions=kept)
        push, ramp = draw.between(0.02, 0.15) * scene.h[-1], scene.end * draw.one(0.3, 1.0)
        tool = replace(_tool(draw, scene, push, ramp, draw.order(3.3, 4.3)), load=0.0)
        if kind == "follow":
            return scene.with_(tools=(tool,), uneven=True, follows=True)
        mass = draw.between(0.3, 3.0) * 2000 * tool.size**2
        spins = {"moment": mass * (tool.size / draw.between(1.0, 3.0)) ** 2, "spin": draw.between(-1, 1) / scene.end}
        return scene.with_(tools=(replace(tool, shape="ball", mass=mass, **spins),))
    return scene


def flowing(seed: int, **given) -> Scene:
    """Return the scene of a seed in 2D whose domains are renewed: weak soil under a tool or a footing; as `drawn`."""
    draw = Draw([seed, 6])
    given = {"dim": 2, "axisymmetric": draw.yes(0.5), "laws": [draw.one(*PLASTIC[:3])]} | given
    scene = drawn(seed, **given)
    while scene.contact is not None:
        scene = drawn(draw.whole(0, 10**6), **given).with_(seed=seed)
    weak = [(law, c | {"cohesion": c["cohesion"] * draw.order(-1, 0)}) for law, c in scene.materials]
    top, ramp = scene.bodies[-1], scene.end * draw.one(0.5, 1.0)
    kept = [c for c in scene.conditions if c.side != "top" or c.kind in ("drained", "seepage", "inflow")]
    push, part = draw.between(0.2, 0.6) * scene.h[-1], _part(scene, draw.between(0.3, 0.6))
    scene = scene.with_(materials=tuple(weak), steps=draw.whole(4, 6), renewal=True, conditions=tuple(kept), tools=())
    if draw.yes(0.5):
        tool = replace(_tool(draw, scene, push, ramp, 0.0), load=0.0)
        scene = scene.with_(tools=(tool,))
    else:
        footing = Condition("displacement", "top", (0.0, -push), ramp, draw.one("y", "xy"), part)
        scene = scene.with_(conditions=(footing, *scene.conditions))
    beside = (part[1][0] if not scene.tools else (top.lower[0] + 2 * top.upper[0]) / 3, -FAR), (FAR, FAR)
    load = draw.one("none", "traction", "pressure")
    if load != "none":
        value = {"traction": (0.0, -1.0), "pressure": (1.0,)}[load]
        value = tuple(draw.order(2.5, 3.5) * v for v in value)
        scene = scene.with_(conditions=(*scene.conditions, Condition(load, "top", value, ramp, region=beside)))
    if scene.surcharge:
        scene = scene.with_(initial=None, surcharge=0.0, level=None)
    if scene.tools and scene.stage and scene.stage.kind in ("remove", "add"):
        scene = scene.with_(stage=None)
    if not scene.axisymmetric and draw.yes(0.4):
        scene = _moving(draw, scene.with_(stage=None, rtol=None, initial=None, level=None, method="sdirk2"))
        scene = scene.with_(steps=2 * scene.steps)
    return scene


def shaken(seed: int, **given) -> Scene:
    """Return the scene of a seed with inertia: any of `drawn` or `draining`, which flies, begins to move, or stops."""
    draw = Draw([seed, 7])
    scene = (draining if draw.yes(0.2) else drawn)(seed, **given)
    before, kind = scene.stage, draw.one("none", "move", "rest", "as drawn", weights=[3, 2, 1, 2])
    scene = _moving(draw, scene.with_(rtol=None, stage=None))
    stage = {"none": None, "as drawn": before}.get(kind, Stage(kind, len(scene.bodies) - 1))
    freely = draw.order(0, 3) if draw.yes(0.5) else 1.0
    laws = tuple(
        (n, c | {"conductivity": c["conductivity"] * freely} if "conductivity" in c else c) for n, c in scene.materials
    )
    speed = draw.order(-2, 0)
    flight = tuple(speed * draw.between(-1, 1) for _ in range(scene.dim)) if draw.yes(0.5) and kind != "move" else ()
    if flight and scene.axisymmetric:
        flight = (0.0, *flight[1:])
    rtol = 1e-2 if scene.method == "sdirk2" and draw.yes(0.15) else None
    return scene.with_(stage=stage, materials=laws, flight=flight, rtol=rtol)


def _moving(draw: Draw, scene: Scene) -> Scene:
    """Return the scene with inertia, in which waves pass it a few times."""
    slowest = min(np.sqrt(law["shear"] / law["grain_density"]) for _, law in scene.materials)
    end = draw.between(0.5, 2.0) * scene.size[-1] / slowest
    ramped = (replace(c, ramp=c.ramp / scene.end * end) for c in scene.conditions)
    tools = (replace(t, ramp=t.ramp / scene.end * end) for t in scene.tools)
    changes = {"conditions": tuple(ramped), "tools": tuple(tools), "end": float(end), "steps": draw.whole(3, 5)}
    return scene.with_(inertia=True, **changes)


def _retention(draw: Draw) -> tuple[str, dict[str, float]]:
    """Return a law of retention and its constants."""
    name = draw.one("VanGenuchten", "Gardner", "BrooksCorey")
    constants = {"entry": draw.order(3.0, 4.5), "residual": draw.one(0.0, 0.1)}
    if name == "VanGenuchten":
        constants |= {"n": draw.between(1.3, 4.0), "air_entry": 0.02 * constants["entry"]}
    if name == "BrooksCorey":
        constants["index"] = draw.between(0.5, 4.0)
    return name, constants


def _ground(draw: Draw, size, h, dim: int, axisymmetric: bool):
    """Return the box that the ground fills, m, and the walls that hold it."""
    lower, upper = np.zeros(dim), size - np.array(h) * draw.between(1.1, 1.9)
    walls = {"bottom": draw.one(AXES[dim - 1], AXES[:dim])}
    for axis, (low, high) in enumerate([("left", "right"), ("front", "back")][: dim - 1]):
        if draw.yes(0.55):  # between walls
            upper[axis] = size[axis]
            walls |= {low: AXES[axis], high: AXES[axis]}
        else:
            lower[axis] = 0.0 if axisymmetric or draw.yes(0.5) else draw.between(0.6, 1.4) * h[axis]
            if lower[axis] == 0.0:
                walls[low] = AXES[axis]
            else:
                walls["bottom"] = AXES[:dim]
    if axisymmetric:
        walls.pop("left", None)
    return lower, upper, walls


def _levels(draw: Draw, top: float, h: float, layers: int) -> np.ndarray:
    """Return the levels between layers, m, off the grid lines."""
    z = np.linspace(0, top, layers + 1)
    z[1:-1] += [draw.between(-0.2, 0.2) * h for _ in z[1:-1]]
    return z


def _part(scene: Scene, share: float) -> tuple[Vector, Vector]:
    """Return a region with so much of the top body's width from its left."""
    top = scene.bodies[-1]
    high = [FAR] * scene.dim
    high[0] = top.lower[0] + share * (top.upper[0] - top.lower[0])
    return (-FAR,) * scene.dim, tuple(high)


def _above(scene: Scene) -> tuple[Vector, Vector]:
    """Return a region with the upper body alone, of a scene with a contact."""
    low = [-FAR] * scene.dim
    low[-1] = (scene.bodies[-1].lower[-1] + scene.bodies[-1].upper[-1]) / 2
    return tuple(low), (FAR,) * scene.dim


def _loaded(draw: Draw, scene: Scene) -> Scene:
    """Return the scene with loads."""
    d, top, ramp = scene.dim, scene.bodies[-1], scene.end * draw.one(0.3, 1.0)
    down = np.zeros(d)
    down[-1] = -1.0
    kinds = ["traction", "part", "normal", "pressure", "displacement", "footing", "plate", "tool", "none"]
    load, q = draw.one(*kinds), draw.order(3.3, 4.3)
    push = draw.between(0.02, 0.15) * scene.h[-1]
    region = _above(scene) if scene.contact is not None else None
    if scene.contact is not None:  # nothing but what presses it holds the block on the others
        load = "displacement"
    part = _part(scene, draw.between(0.4, 0.6))
    conditions, tools = [], []
    if load == "traction":
        conditions.append(Condition("traction", "top", tuple(q * down), ramp, region=region))
    if load == "part":
        aside = np.eye(d)[0] * (0.0 if scene.axisymmetric else 0.2)
        conditions.append(Condition("traction", "top", tuple(q * (down + aside)), ramp, region=part))
    if load == "normal":
        conditions.append(Condition("normal", "top", (-q,), ramp, region=region))
    if load == "pressure":
        conditions.append(Condition("pressure", "top", (q,), ramp, region=region))
    if load in ("displacement", "footing"):
        components = AXES[d - 1] if scene.contact is None and draw.yes(0.5) else AXES[:d]
        region = part if load == "footing" else region
        conditions.append(Condition("displacement", "top", tuple(push * down), ramp, components, region))
    if load == "plate":
        conditions.append(Condition("plate", "top", (q * (top.upper[0] - top.lower[0]),), ramp, region=region))
        scene = scene.with_(tolerance=1e-9)  # what rounding makes of its rigidity is more than 1e-11 of the forces
    if load == "tool":
        tools.append(_tool(draw, scene, push, ramp, q))
    if scene.surcharge:
        conditions.append(Condition("traction", "top", tuple(scene.surcharge * down)))
    free = "right" not in scene.walls and scene.contact is None
    if free and draw.yes(0.4):
        aside = np.zeros(d)
        aside[0] = -q / 2
        kind = draw.one("traction", "pressure", "springs")
        value = {"traction": tuple(aside), "pressure": (q / 2,), "springs": (draw.order(5, 7),)}[kind]
        conditions.append(Condition(kind, "right", value, ramp))
    return scene.with_(conditions=tuple(conditions), tools=tuple(tools))


def _tool(draw: Draw, scene: Scene, push: float, ramp: float, q: float) -> RigidTool:
    """Return a tool on the top of the scene."""
    d, top = scene.dim, scene.bodies[-1]
    wide, shape = top.upper[0] - top.lower[0], draw.one("ball", "plate", "wedge")
    place = (np.array(top.lower) + top.upper) / 2
    place[0] = top.lower[0] + (0.0 if scene.axisymmetric else draw.between(0.35, 0.65) * wide)
    place[-1] = top.upper[-1]
    if top.slant and not scene.axisymmetric:
        place[0] -= top.slant * wide / 2
    travel = np.zeros(d)
    travel[-1] = -push
    rough = {"friction": 0.3} if draw.yes(0.4) else {"adhesion": 2e3} if draw.yes(0.2) else {}
    if not scene.axisymmetric and rough and draw.yes(0.5):
        travel[0] = 0.5 * push
    load = q * 0.3 * wide if draw.yes(0.15) and shape == "ball" else 0.0
    return RigidTool(shape, tuple(place), 0.3 * wide, tuple(travel), ramp, load=load, **rough)


def _watered(draw: Draw, scene: Scene) -> Scene:
    """Return the scene with a water table and open sides."""
    d, ramp = scene.dim, scene.end * draw.one(0.3, 1.0)
    level = None
    if scene.initial and draw.yes(0.6):
        level = scene.bodies[-1].upper[-1] * draw.between(0.6, 1.0)
    kind = draw.one("top", "part", "bottom", "right", "inflow", "seepage", "sealed", weights=[3, 1, 1, 1, 1, 1, 2])
    part, low = _part(scene, draw.between(0.4, 0.6)), [FAR] * d
    low[-1] = 1e-6
    bottom = ((-FAR,) * d, tuple(low))
    if scene.contact is not None:
        part = _above(scene)
        kind = "part" if kind in ("top", "right", "inflow", "seepage") else kind
    conditions = list(scene.conditions)
    if kind in ("top", "right"):
        conditions.append(Condition("drained", kind, (0.0,)))
    if kind == "part":
        conditions.append(Condition("drained", "top", (0.0,), region=part))
    if kind == "bottom":
        conditions.append(Condition("drained", "bottom", (0.0,), region=bottom))
    if kind == "inflow":
        conditions.append(Condition("inflow", "top", (draw.order(-9, -7),), ramp))
    if kind == "seepage":
        conditions.append(Condition("seepage", "top", (0.0,)))
    return scene.with_(conditions=tuple(conditions), level=level)


def _stage(draw: Draw, scene: Scene) -> Stage | None:
    """Return what changes after the first run, if anything."""
    kind, last = (
        draw.one("none", "load", "reset", "remove", "add", "free", weights=[4, 1, 1, 1, 1, 1]),
        len(scene.bodies) - 1,
    )
    if kind == "none" or (kind in ("remove", "add") and (last == 0 or scene.contact is not None or scene.tools)):
        return None
    if kind in ("free", "reset") and scene.contact is not None:  # the block would be held by nothing
        return None
    if kind == "free" and not any(c.kind == "displacement" for c in scene.conditions):
        return None
    return Stage(kind, last)
