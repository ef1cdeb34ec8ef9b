# SPDX-License-Identifier: MIT
"""Scenes are built in a frame and run; what they show is brought back into the frame of their description."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem
from helpers import without
from numpy.typing import NDArray

import mpm_dolfinx as mpm
from mpm_dolfinx.points.cutting import centroids
from mpm_dolfinx.points.material_points import body_of
from scenes.description import FAR, WATER, Condition, G, RigidTool, Scene
from scenes.frames import Frame
from scenes.meshes import mesh_of

BEYOND, EMPTY, THICK = 3, 1.3, 1.2  # rows of cells that a far body needs, of which are empty, and its thickness


@dataclass
class Built:
    """A simulation of a scene in a frame.

    order: where each body of the scene is in its list; loads: their factor; numbers: of each kind, which conditions of
    the description those of the simulation are, -1 those of a far body.
    """

    scene: Scene
    frame: Frame
    simulation: mpm.Simulation
    order: list[int]
    loads: dict[str, float]
    numbers: dict[str, list[int]]
    laws: list[mpm.Skeleton]

    def own(self, kind: str) -> list[int]:
        """Return the rows of the scene's own conditions of a kind, in the order of the description."""
        numbers = self.numbers[kind]
        return [numbers.index(number) for number in sorted(numbers) if number >= 0]


def build(scene: Scene, frame: Frame) -> Built:
    """Return a simulation of a scene in a frame."""
    return _Builder(scene, frame).built()


class _Builder:
    def __init__(self, scene: Scene, frame: Frame):
        self.scene, self.frame = scene, frame
        self.shuffle = np.random.default_rng(frame.order) if frame.order else None
        self.loads, self.of_far = {"factor": frame.load}, []

    def built(self) -> Built:
        scene, frame, far = self.scene, self.frame, self.frame.far is not None
        more = np.array([0] * (scene.dim - 1) + [BEYOND * far])
        size = scene.size + more * scene.h
        lower, upper = frame.box(np.zeros(scene.dim), size, scene)
        cells = np.abs(frame.vector(np.add(scene.cells, more))).astype(int).tolist()
        self.grid = mpm.Grid(lower, upper, cells, axisymmetric=scene.axisymmetric)
        if scene.uneven:
            lines = scene.lines()
            lines[-1] = np.append(lines[-1], scene.size[-1] + scene.h[-1] * np.arange(1, BEYOND * far + 1))
            x = [np.zeros((len(lines[axis]), scene.dim)) for axis in frame.axes]
            for along, axis in zip(x, frame.axes, strict=True):
                along[:, axis] = lines[axis]
            lines = [np.sort(frame.place(along, scene)[:, k]) for k, along in enumerate(x)]
            follow = {"follow": self.tool(scene.tools[0])} if scene.follows else {}
            self.grid = mpm.Grid(lines=lines, axisymmetric=scene.axisymmetric, **follow)
        bodies = self.permuted(list(range(len(scene.bodies) + far)))
        laws = self.permuted(list(range(len(scene.materials) + far)))
        self.order = [bodies.index(i) for i in range(len(bodies))]
        self.law = [laws.index(i) for i in range(len(laws))]
        found = [self.far_body() if i == len(scene.bodies) else self.body(i) for i in bodies]
        materials = [self.far_law() if i == len(scene.materials) else self.material(*scene.materials[i]) for i in laws]
        conditions = self.conditions()
        if far:
            self.far_conditions(conditions)
        numbered = {name: self.permuted(list(enumerate(values))) for name, values in conditions.items()}
        numbers = {name: [-1 if v in self.of_far else i for i, v in values] for name, values in numbered.items()}
        conditions = {name: [v for _, v in values] for name, values in numbered.items()}
        later = [self.order[scene.stage.body]] if scene.stage and scene.stage.kind == "add" else []
        walls = {frame.side(side): frame.components(letters) for side, letters in scene.walls.items()}
        if far:
            walls[frame.side("top")] = "xyz"[: scene.dim]
        walls = dict(self.permuted(list(walls.items())))
        options = self.options(later)
        terms = [*conditions.pop("terms"), *map(mpm.Source, conditions.pop("sources"))]
        acting = [one for values in conditions.values() for one in values]
        options |= {"walls": walls, "conditions": acting, "terms": terms}
        found = [mpm.Later(body) if i in later else body for i, body in enumerate(found)]
        simulation = mpm.Simulation(self.grid, found, materials, **options)
        return Built(scene, frame, simulation, self.order, self.loads, numbers, materials)

    def permuted(self, values: list) -> list:
        """Return a list in the frame's order."""
        return values if self.shuffle is None else [values[i] for i in self.shuffle.permutation(len(values))]

    # ---- bodies and materials ---------------------------------------------------------------

    def body(self, number: int):
        scene, frame, block = self.scene, self.frame, self.scene.bodies[number]
        own = {"per_cell": block.per_cell, "material": self.law[block.material]}
        if block.kind == "box":
            body = mpm.box(self.grid, *frame.box(block.lower, block.upper, scene), **own)
        else:
            body = mpm.from_mesh(self.grid, mesh_of(scene, block, frame, self.shuffle), **own)
        if not block.slant:
            return body
        left, top = block.lower[0], scene.bodies[-1].upper[-1]

        def narrower(x):
            y = frame.place_back(x, scene)
            y[:, 0] -= block.slant * (y[:, 0] - left) * y[:, -1] / top
            return frame.place(y, scene)

        return mpm.mapped(self.grid, body, narrower)

    def far_body(self):
        scene = self.scene
        lower, upper = 0.3 * scene.size, 0.7 * scene.size
        if scene.axisymmetric:
            lower[0] = 0.0
        upper[-1] = scene.size[-1] + BEYOND * scene.h[-1]
        lower[-1] = upper[-1] - THICK * scene.h[-1]
        self.far_box = lower, upper
        law = {"material": self.law[len(scene.materials)]}
        return mpm.box(self.grid, *self.frame.box(lower, upper, scene), per_cell=2, **law)

    def far_law(self):
        kind, law = self.frame.far, "Hencky"
        constants = {"bulk": 3e6, "shear": 2e6, "porosity": 0.4, "grain_density": 2600.0, "conductivity": 1e-6}
        if kind == "stiff":
            constants |= {"bulk": 3e12, "shear": 2e12}
        elif kind == "yielding":
            law, constants = "DruckerPrager", constants | {"cohesion": 1e5, "friction": 20.0, "dilation": 0.0}
        elif kind == "incompressible":
            constants["bulk"] = 2e8
        elif kind == "tight":
            constants["conductivity"] = 0.0
        return self.material(law, constants)

    def far_conditions(self, conditions: dict[str, list]) -> None:
        scene, frame = self.scene, self.frame
        region = frame.box(self.far_box[0] - 0.1 * np.array(scene.h), self.far_box[1] + 0.1 * np.array(scene.h), scene)
        region = tuple(map(tuple, region))
        loads = {"moving": 2e5, "yielding": 5e4, "incompressible": 2e5, "tight": 2e5}
        if load := loads.get(frame.far):
            aside = np.zeros(scene.dim)
            aside[-1], aside[0] = -load, 0.0 if scene.axisymmetric else load / 2
            push = self.traction(aside, scene.end / 3)
            self.of_far.append(mpm.Traction(frame.side("bottom"), push, region=region))
            conditions["tractions"] += self.of_far
        if frame.far == "draining" and scene.fluid is not None:
            self.of_far.append(mpm.Drained(frame.side("right"), 0.0, region=region))
            conditions["drained"] += self.of_far

    def material(self, law: str, constants: dict):
        frame, given = self.frame, dict(constants)
        if given.pop("kozeny_carman", False):
            given["conductivity_law"] = mpm.kozeny_carman
        for name in ("bulk", "shear", "cohesion", "residual", "reference"):
            if name in given:
                given[name] *= frame.stress
        if "beta" in given:
            given["beta"] /= frame.stress
        if "initial_stress" in given:
            given["initial_stress"] = tuple(frame.stress * s for s in given["initial_stress"])
        if "slip" in given:
            given["slip"] *= frame.length
        if "viscosity" in given:
            given["viscosity"] *= frame.stress * frame.time
        given["grain_density"] = given.get("grain_density", 2650.0) * frame.density
        if kind := given.get("retention"):
            name, numbers = kind
            given["retention"] = getattr(mpm, name)(
                **numbers | {k: frame.stress * numbers[k] for k in ("entry", "air_entry") if k in numbers}
            )
        if given.get("conductivity"):  # such that k / gamma_w is a length^2 over stress and time
            mobility = given["conductivity"] / (WATER * G) * frame.length**2 / frame.stress / frame.time
            given["conductivity"] = mobility * self.water(np.inf).unit_weight
        return getattr(mpm, law)(**given)

    # ---- conditions -------------------------------------------------------------------------

    def conditions(self) -> dict[str, list]:
        names = (
            "tractions",
            "displacements",
            "plates",
            "drained",
            "inflows",
            "tools",
            "contacts",
            "terms",
            "sources",
            "others",
        )
        out = {name: [] for name in names}
        kinds = {
            "traction": "tractions",
            "normal": "tractions",
            "pressure": "tractions",
            "displacement": "displacements",
        }
        kinds |= {
            "plate": "plates",
            "drained": "drained",
            "seepage": "drained",
            "inflow": "inflows",
            "rain": "inflows",
            "springs": "terms",
            "quiet": "others",
            "tied": "others",
        }
        for condition in self.scene.conditions:
            out[kinds[condition.kind]].append(self.condition(condition))
        out["tools"] = [self.tool(tool) for tool in self.scene.tools]
        if self.scene.follows:  # the one that the lines follow
            out["tools"][0] = self.grid.follow
        if self.scene.contact is not None:
            last = self.order[len(self.scene.bodies) - 1]
            others = [i for k, i in enumerate(self.order) if k != len(self.scene.bodies) - 1]
            out["contacts"] = [mpm.Contact(last, others, friction=self.scene.contact)]
            assert not self.scene.rate and not self.scene.stiffness
        stiffness = self.scene.stiffness * self.frame.stress / self.frame.length**2
        if stiffness:

            def springs(points, u):
                U = points.displacement + points.value(u)
                return _constant(points, stiffness) * ufl.inner(U, U) / ufl.det(points.F) * points.dx

            out["terms"].append(springs)
        rate = self.scene.rate / self.frame.time
        if rate:
            out["sources"] = [lambda points, q: _constant(points, rate) * q * points.dx]
        return out

    def region(self, condition: Condition) -> tuple:
        """Return where a condition acts: in the scene, not on a body that is far from it."""
        scene = self.scene
        low, high = np.full(scene.dim, -FAR), np.full(scene.dim, FAR)
        high[-1] = scene.size[-1]
        if condition.region is not None:
            low, high = np.maximum(low, condition.region[0]), np.minimum(high, condition.region[1])
        return tuple(map(tuple, self.frame.box(low, high, scene)))

    def grown(self, value, ramp: float) -> Callable[[float], NDArray[np.float64]]:
        """Return a value as it grows in time, times the factor of loads."""
        loads, unit = self.loads, self.frame.time
        return lambda t: value * loads["factor"] * (min(1.0, t / unit / ramp) if ramp else 1.0)

    def traction(self, value, ramp: float) -> Callable:
        return self.grown(self.frame.stress * self.frame.vector(value), ramp)

    def condition(self, c: Condition):
        frame, scene = self.frame, self.scene
        side, region = frame.side(c.side), self.region(c)
        if c.kind == "tied":
            return mpm.Tied(side, frame.side("right"))
        if c.kind == "quiet":
            return mpm.Quiet(side, region=region)
        if c.kind == "traction":
            return mpm.Traction(side, self.traction(c.value, c.ramp), region=region)
        if c.kind == "normal":
            value = self.grown(frame.stress * c.value[0], c.ramp)
            return mpm.Traction(side, lambda t: float(value(t)), region=region)
        if c.kind == "pressure":
            return mpm.Pressure(side, self.grown(frame.stress * c.value[0], c.ramp), region=region)
        if c.kind == "displacement":
            value = self.grown(frame.length * frame.vector(c.value), c.ramp)
            return mpm.Displacement(side, lambda t, X: value(t), frame.components(c.components), region=region)
        if c.kind == "plate":
            return mpm.RigidPlate(side, self.grown(frame.force(scene) * c.value[0], c.ramp), region=region)
        if c.kind == "inflow":
            return mpm.Inflow(side, self.grown(frame.length / frame.time * c.value[0], c.ramp), region=region)
        if c.kind == "rain":
            flux = self.grown(frame.length / frame.time * c.value[0], c.ramp)
            pond, driest = (frame.stress * p for p in c.value[1:])
            return mpm.Rain(side, flux, ponding=pond, driest=driest, region=region)
        if c.kind == "springs":
            stiffness = c.value[0] * frame.stress / frame.length

            def springs(points, u):
                U = points.displacement + points.value(u)
                return _constant(points, stiffness / 2) * ufl.inner(U, U) * points.dx

            return mpm.OnSide(side, springs, region=region)
        outer = 0.0 if scene.level is None or c.kind == "seepage" else self.head
        return mpm.Drained(side, outer, region=region, seepage=c.kind == "seepage")

    def head(self, t, x) -> NDArray[np.float64]:
        """Return the pressure of water at rest at places of this frame."""
        return self.frame.stress * WATER * G * (self.scene.level - self.frame.place_back(x, self.scene)[:, -1])

    def tool(self, tool: RigidTool) -> mpm.Tool:
        frame, scene, d = self.frame, self.scene, self.scene.dim
        up = np.zeros(d)
        up[-1] = 1.0
        place = np.array(tool.place)
        if tool.shape == "ball":
            shape = mpm.Ball(frame.place(place + tool.size * up, scene), tool.size * frame.length)
        elif tool.shape == "plate":
            shape = mpm.HalfSpace(frame.place(place, scene), -frame.vector(up))
        else:
            shape = mpm.Cone(frame.place(place, scene), frame.vector(up), 65.0)
        own = {"friction": tool.friction, "adhesion": tool.adhesion * frame.stress}
        if tool.mass:
            way = frame.length * frame.vector(tool.travel) / tool.ramp / frame.time * frame.load
            own |= {"mass": tool.mass * frame.mass(scene), "moment": tool.moment * frame.mass(scene) * frame.length**2}
            own |= {"velocity": tuple(way), "spin": frame.turn * tool.spin / frame.time}
            return mpm.Tool(shape, centre=frame.place(place + tool.size * up, scene), **own)
        travel = self.grown(frame.length * frame.vector(tool.travel), tool.ramp)
        if not tool.load:
            return mpm.Tool(shape, displacement=travel, centre=frame.place(place, scene), **own)
        load = self.grown(frame.force(scene) * tool.load, tool.ramp)
        own |= {"load": load, "direction": frame.vector(-up)}
        return mpm.Tool(shape, centre=frame.place(place, scene), **own)

    def water(self, bulk: float) -> mpm.Fluid:
        frame = self.frame
        gravity = G * frame.length / frame.time**2
        return mpm.Fluid(bulk=bulk * frame.stress, density=WATER * frame.density, gravity=gravity)

    # ---- options ----------------------------------------------------------------------------

    def options(self, later: list[int]) -> dict:
        scene, frame = self.scene, self.frame
        out = {"numerics": mpm.Numerics(method=scene.method, tolerance=scene.tolerance, renewal=scene.renewal)}
        if scene.inertia:
            way = frame.vector(scene.flight) * frame.length / frame.time if scene.flight else None
            begins = not (scene.stage and scene.stage.kind == "move")
            out["inertia"] = begins if way is None else mpm.Moving(tuple(way))
        down = np.zeros(scene.dim)
        down[-1] = -scene.gravity * frame.length / frame.time**2
        if scene.gravity:
            out["gravity"] = tuple(frame.vector(down) * frame.load)
        if scene.fluid is not None:
            out["fluid"] = self.water(scene.fluid)
            if scene.level is not None:
                out["pressure"] = lambda x: self.head(0.0, x)
        if scene.initial:
            stress = self.given_stress
            if scene.initial == "K0":
                stress = mpm.K0(scene.ratio, surcharge=scene.surcharge * frame.stress)
            here = [i for i in self.order[: len(scene.bodies)] if i not in later]
            out["initial_stress"] = {i: stress for i in self.permuted(here)}
        return out

    def given_stress(self, x) -> NDArray[np.float64]:
        """Return effective stresses (n, 3, 3) that are in balance in level ground of an even density."""
        scene, frame = self.scene, self.frame
        y, top = frame.place_back(x, scene)[:, -1], scene.bodies[-1].upper[-1]
        p = WATER * G * (scene.level - y) if scene.level is not None else 0.0
        vertical = -np.maximum(scene.surcharge + 2000 * scene.gravity * (top - y) - p, 1e3)
        along = np.full((len(x), 3), scene.ratio) * vertical[:, None]
        along[:, scene.dim - 1] = vertical
        axes = [*frame.axes, 2][:3]
        return frame.stress * along[:, axes][:, :, None] * np.eye(3)


def _constant(points, value: float) -> fem.Constant:
    """Return a number of a user-defined term, with which the term is not compiled anew for each scene."""
    return fem.Constant(points.grid.mesh, value)


@dataclass
class Shown:
    """What a scene shows at a time, in the frame of its description; arrays over its points by places at rest.

    Where domains are renewed places are those now.  steps: how many the run took up to each output so far.
    """

    place: NDArray[np.float64]
    fields: dict[str, NDArray[np.float64]]
    steps: list[int]


def shown(built: Built, steps: list[int]) -> Shown:
    """Return what a simulation shows now; steps: see `Shown`."""
    scene, frame, s = built.scene, built.frame, built.simulation
    points, d = s.points, scene.dim
    number = body_of(points.id, np.cumsum([0, *map(len, s.bodies)]))
    own = np.isin(number, built.order[: len(scene.bodies)])
    if scene.renewal:  # points are others than those at rest
        places, rest = points.x[own], centroids(points.origin[own])
    else:
        rest = points.origin[own].mean(axis=1)
        places = np.concatenate([body.corners().mean(axis=1) for body in s.bodies])[points.id][own]
    stress = s.point_fields().effective_stress[own]
    fields = {
        "displacement": frame.vector_back((points.x[own] - rest) / frame.length),
        "stress": frame.tensor_back(stress / frame.stress),
        "volume": points.J[own] - 1,
    }
    if scene.inertia:
        fields["velocity"] = frame.vector_back(points.velocity[own] * frame.time / frame.length)
        if "energy" in s.state.outcome and not frame.far:
            energies = np.array(list(s.state.outcome["energy"].values()))
            fields["energies"] = energies / (frame.force(scene) * frame.length)
    if scene.fluid is not None:
        fields["pressure"] = points.pressure[own] / frame.stress
    if any(law.get("retention") for _, law in scene.materials):
        fields["saturation"] = s.point_fields().saturation[own]
    if any(c.kind == "rain" for c in scene.conditions):
        volumes = [s.outcome(name).array.sum() for name in ("ran_off", "ponded")]
        fields["rain"] = np.array(volumes) / (frame.flow(scene) * frame.time)
    fields["reactions"] = frame.vector_back(
        s.reactions.array.reshape(-1, d)[built.own("displacements")] / frame.force(scene)
    )
    drained = len(built.numbers["drained"])
    rows = [*built.own("drained"), *(drained + i for i in built.own("inflows"))]
    fields["outflows"] = s.outflows.array[rows] / frame.flow(scene)
    tools = len(built.numbers["tools"])
    rows = [*built.own("tools"), *(tools + i for i in built.own("contacts"))]
    fields["tools"] = frame.vector_back(s.tool_forces.array.reshape(-1, 3 * d - 3)[rows, :d] / frame.force(scene))
    fields["travel"] = s.tool_travel.array[built.own("tools")] / frame.length
    if any(tool.mass for tool in scene.tools):
        fields["travel"] = frame.vector_back(fields["travel"])
        fields["rotation"] = s.outcome("tool_rotation").array * frame.turn
    return Shown(frame.place_back(places, scene), fields, list(steps))


def _stage(built: Built) -> None:
    """Begin the scene's stage."""
    scene, kind = built.scene, built.scene.stage.kind
    body = built.order[scene.stage.body]
    if kind == "remove":
        built.simulation.stage(remove=[body])
    if kind == "add":
        built.simulation.stage(add=[body])
    if kind == "load":
        built.loads["factor"] *= 1.3
    if kind in ("move", "rest"):
        built.loads["factor"] *= 1.3
        built.simulation.stage(inertia=kind == "move")
    if kind == "reset":
        built.simulation.stage(reset_displacement=True, conditions=without(built.simulation, mpm.Displacement))
        built.numbers["displacements"] = []
    if kind == "free":
        built.simulation.stage(conditions=without(built.simulation, mpm.Displacement))
        built.numbers["displacements"] = []


def run(scene: Scene, frame: Frame) -> list[Shown]:
    """Return what a scene shows at the ends of its stages."""
    built, dt, end = build(scene, frame), scene.end * frame.time / scene.steps, scene.end * frame.time
    steps: list[int] = []
    moves = scene.inertia and not (scene.stage and scene.stage.kind in ("move", "rest", "remove", "add"))
    options = {
        "progress": False,
        "observe": lambda simulation: steps.append(simulation.result.steps),
        "energies": moves,
    }
    if scene.rtol:
        built.simulation.run(end, rtol=scene.rtol, t_eval=[end], **options)
    elif frame.cut:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "cut"
            built.simulation.run(dt, dt, checkpoint=mpm.Checkpoint(file), **options)
            built = build(scene, frame)
            before = mpm.resume(built.simulation, file)
        built.simulation.run(end, dt, after=before, **options)
    else:
        built.simulation.run(end, dt, **options)
    out = [shown(built, steps)]
    if scene.stage:
        _stage(built)
        built.simulation.run(end + dt, dt, **options)
        out.append(shown(built, steps))
    return out


def counted(scene: Scene, count: Callable[[Built], None], begun: Callable[[Built], None]) -> None:
    """Take the steps of a scene as it is, none of which is cut; call a function before the first and after each.

    begun: called once the scene's stage has begun.
    """
    built, dt = build(scene, Frame.plain(scene.dim)), scene.end / scene.steps
    count(built)
    for _ in range(scene.steps):
        built.simulation.step(dt)
        count(built)
    if scene.stage:
        _stage(built)
        begun(built)
        built.simulation.step(dt)
        count(built)
