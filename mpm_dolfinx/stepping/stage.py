# SPDX-License-Identifier: MIT
"""A stage: the bodies that are present, and the conditions on them."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base import _compat
from mpm_dolfinx.base.validation import all_of, check_names, given, line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import IMPULSES, QUANTITIES, VOLUMES, Acting, Loads, Outcome, Place, Setting
from mpm_dolfinx.conditions.conditions import (
    Displacement,
    Drained,
    Inflow,
    OnSide,
    Pressure,
    Quiet,
    Rain,
    RigidPlate,
    Source,
    Tied,
    Traction,
)
from mpm_dolfinx.conditions.jumps import before_jumps, functions_of_time, motions, up_to_jumps
from mpm_dolfinx.conditions.sides import Sides
from mpm_dolfinx.conditions.unit_weights import with_weight
from mpm_dolfinx.conditions.walls import fixed_corners, fixed_nodes, with_axis
from mpm_dolfinx.contact.conducting import ConductingContacts
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.pairing import Contacts
from mpm_dolfinx.contact.ties import Ties
from mpm_dolfinx.contact.tool import Tool, motion_by_forces
from mpm_dolfinx.contact.tool_placing import Tools
from mpm_dolfinx.domains.lattice import Lattice, lattices
from mpm_dolfinx.dynamics.quiet_sides import QuietSides
from mpm_dolfinx.flow.drained_sides import DrainedSides
from mpm_dolfinx.flow.feeding import Feeding
from mpm_dolfinx.grid.grid import SIDES, Grid
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.mechanics.given_displacements import GivenDisplacements
from mpm_dolfinx.mechanics.momentum import MomentumForms
from mpm_dolfinx.mechanics.plates import Plates
from mpm_dolfinx.mechanics.tractions import Pressures, Tractions

Condition = Traction | Pressure | Displacement | RigidPlate | Quiet | Tied | Drained | Inflow | Rain | Tool | Contact
"""Conditions on the bodies."""
KINDS: tuple[type[Acting], ...] = (Tractions, Pressures, Plates, GivenDisplacements, QuietSides, Ties, Tools, Contacts)
"""Classes of loads in the balance of momentum, for conditions without a method `acting`."""
FED: tuple[type[Feeding], ...] = (DrainedSides,)
"""Classes of terms in the balance of fluid, for conditions without a method `feeding`."""


def checked(conditions: Sequence[Condition]) -> Sequence[Condition]:
    """Return the conditions.  Raise ValueError for an object that is not a condition."""
    if isinstance(conditions, Sequence) and any(isinstance(one, (OnSide, Source)) for one in conditions):
        raise ValueError("conditions: OnSide and Source are terms, must be given as terms=")
    if isinstance(conditions, Sequence) and not isinstance(conditions, (str, bytes)):
        own = [one for one in conditions if hasattr(one, "acting") or hasattr(one, "feeding")]
        all_of("conditions", [one for one in conditions if one not in own], get_args(Condition))
    else:
        all_of("conditions", conditions, get_args(Condition))
    if len({id(one) for one in conditions}) < len(conditions):
        twice = next(one for i, one in enumerate(conditions) if any(one is other for other in conditions[:i]))
        raise ValueError(f"conditions: {line(twice)} is given twice, must be given once")
    return conditions


def contacts_of(conditions: Sequence[Any]) -> list[Contact]:
    """Return the contacts among the conditions."""
    return [one for one in conditions if isinstance(one, Contact)]


def named(conditions: Sequence[Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Return the conditions by name.  A default name consists of type and side, and of a number if necessary.

    `known`: conditions of the previous stage by name.  Conditions that continue keep their names.

    Raises
    ------
    ValueError
        A name is invalid, or two conditions have the same name.
    """
    given = [getattr(one, "name", None) for one in conditions]
    for name, one in zip(given, conditions, strict=True):
        if name is not None and not (isinstance(name, str) and re.fullmatch(r"[\w .-]+", name)):
            raise ValueError(f"{line(one)}: name = {line(name)}, must consist of letters, digits, blanks and _ . -")
        if name is not None and given.count(name) > 1:
            raise ValueError(f"{line(one)}: name = {line(name)} is the name of another condition, must be unique")
    kept = {id(one): name for name, one in known.items() if name not in given}
    given = [name or kept.get(id(one)) for name, one in zip(given, conditions, strict=True)]
    out: dict[str, Any] = {}
    for name, one in zip(given, conditions, strict=True):
        base, count = name or _default(one), 1
        name = base
        while name in out or (name in given and one is not conditions[given.index(name)]):
            count += 1
            name = f"{base}_{count}"
        out[name] = one
    return out


def _default(condition: Any) -> str:
    """Return the default name of a condition, from its type and side."""
    kind = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(condition).__name__).lower()
    side = getattr(condition, "side", None)
    return kind if side is None else f"{kind}_{re.sub(r'[^A-Za-z0-9]+', '_', str(side))}"


@dataclass(frozen=True, eq=False)
class Stage:
    """The conditions of a stage."""

    given: Mapping[str, Condition]  # conditions by name, as given
    named: Mapping[str, Condition]  # as `given`, but water pressures have the unit weight of the pore fluid
    conditions: Mapping[str, Any]  # walls (in axisymmetry also the axis), and gravity
    present: tuple[bool, ...]  # whether each body is present
    later: tuple[int, ...]  # indices of bodies to be added
    free: NDArray[np.bool_]  # (nodes, d) whether walls leave each component free
    axisymmetric: bool  # see `Grid`
    lattices: Sequence[Lattice]  # of present bodies
    materials: SceneMaterials  # of the scene
    acting: tuple[Acting, ...]  # loads in the balance of momentum
    feeding: tuple[Feeding, ...]  # terms in the balance of fluid

    @property
    def inertia(self) -> bool:
        """Whether bodies have inertia."""
        return self.conditions["inertia"]

    @cached_property
    def surfaces(self) -> list[Surface]:
        """Faces of all conditions except tools and contacts."""
        return [faces for one in (*self.acting, *self.feeding) for faces in one.surfaces]

    @cached_property
    def _functions_of_time(self) -> list:
        return functions_of_time(self.given.values(), self.conditions["gravity"])

    def without_jump(self, t: float, dt: float) -> tuple[float, bool]:
        """Return the length of a step from t (s), in s, and whether a displacement of a side or a tool jumps at t.

        The length is `dt`, or less if a function of time jumps in the step.
        """
        end = before_jumps(self._functions_of_time, t, t + dt)
        sudden = any(value.jumps(t) for one in self.given.values() for value in motions(one))
        return dt if end == t + dt else end - t, sudden

    def up_to_jumps(self, t: float, dt: float) -> float:
        """Return the length of the step from t (s), see `jumps.up_to_jumps`."""
        return up_to_jumps(self._functions_of_time, t, dt) if self._functions_of_time else dt

    def check_motions(self, t: float) -> None:
        """Raise ValueError if a displacement of a stage with inertia jumps after the time `t`, in s."""
        for name, one in self.given.items() if self.inertia else ():
            for value in motions(one):
                if any((value(time) != value.values[-1]).any() for time in (t, *value.times[value.times > t])):
                    raise ValueError(f"{name}: {line(one)} jumps, must be continuous with inertia")

    @property
    def faces(self) -> list[Surface]:
        """Faces of all conditions, including the faces that tools may touch."""
        return [*self.surfaces, *(one.outside for one in self.acting if one.outside is not None)]

    def of(self, *kinds: type) -> dict[str, Any]:
        """Return the conditions of the given classes, by name."""
        return {name: one for name, one in self.named.items() if isinstance(one, kinds)}

    def followed(self, grid: Grid) -> str | None:
        """Return the name of the tool that the lines of a grid follow, or None if this tool is absent."""
        for name, one in self.of(Tool).items():
            if one is grid.follow or one.name == grid.follow.name is not None:
                return name
        return None

    def moved(self, grid: Grid, t: float, outcome: Outcome) -> NDArray[np.float64] | None:
        """Return the displacement (d,) of the tool that grid lines follow, in m, or None without such a tool.

        `t`, s: time of the displacement.
        """
        if (name := self.followed(grid)) is None:
            return None
        tool = self.given[name]
        pose = tool.pose(t, grid.dim, motion_by_forces(outcome, name))
        middle = getattr(tool.shape, "middle", pose.centre)
        return pose.put(middle) - middle

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all loads are symmetric."""
        return all(one.symmetric for one in self.acting)

    @property
    def held(self) -> list[tuple[Any, Surface, Sequence[int]]]:
        """Conditions that support faces, each with its faces and axes."""
        return [one for acting in self.acting for one in acting.held]

    def supported(self, corners: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask (d,) of the axes along which walls or conditions support the bodies.

        `corners` (n, 2^d, d): corners of the domains.
        """
        out = fixed_corners(self.materials.grid, self.conditions["walls"], corners).any(axis=(0, 1))
        out[[axis for _, _, axes in self.held for axis in axes]] = True
        return out

    def placed(self, place: Place) -> list[Loads]:
        """Return the loads in the balance of momentum in a substep."""
        with _compat.Timer("loads"):
            return [one.placed(place) for one in self.acting]

    def check_start(self, place: Place) -> None:
        """Raise an error if the positions of bodies or tools at the start of the stage are invalid."""
        for one in self.acting if place.begins else ():
            one.check_start(place)

    def kept(self, n: int) -> dict[str, NDArray[np.float64]]:
        """Return the point data of the conditions, with their initial values at n points."""
        return {data: rows for one in self.acting for of in one.kept(n).values() for data, rows in of.items()}

    def data_names(self, names: Collection[str]) -> set[str]:
        """Return the names of the point data of the conditions `names`."""
        return {data for one in self.acting for name, of in one.kept(0).items() if name in names for data in of}

    def same(self, before: Stage) -> set[str]:
        """Return the names of conditions that continue from the stage `before`.

        Such a condition is the same object in both stages, or has the same user-defined name.
        """
        shared = ((name, one) for name, one in self.given.items() if name in before.given)
        return {name for name, one in shared if one is before.given[name] or getattr(one, "name", None) == name}

    def equals(self, before: Stage) -> bool:
        """Return whether walls, gravity, inertia and all conditions are those of the stage `before`."""
        if not all(np.array_equal(value, before.conditions[name]) for name, value in self.conditions.items()):
            return False
        now, then = ({name: id(one) for name, one in of.given.items()} for of in (self, before))
        return now == then

    @property
    def lasting(self) -> list[Surface]:
        """Faces whose domains must not be replaced: their conditions depend on displacements since seeding."""
        return [*(faces for _, faces, _ in self.held), *(faces for one in self.acting for faces in one.seeded)]

    @cached_property
    def totals(self) -> Mapping[str, str]:
        """For each result with a time integral, by name: name of the integral since the start of the condition."""
        return VOLUMES | IMPULSES if self.inertia else VOLUMES

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return placeholders `value` for results that the first step will compute, by quantity and name."""
        d = self.free.shape[1]
        out = {quantity: {} for quantity in QUANTITIES}
        out["wall_reactions"] = {wall: np.full(d, value) for wall in SIDES[d]}
        for one in (*self.feeding, *self.acting):
            for quantity, values in one.unknown(value).items():
                out[quantity] = out.get(quantity, {}) | values
        for quantity, total in self.totals.items():
            if out.get(quantity):
                out[total] = out.get(total, {}) | {name: np.zeros_like(of) for name, of in out[quantity].items()}
        return out

    def initial_outcome(
        self, before: Stage, outcome: Outcome, value: float
    ) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the results of conditions at the beginning of the stage.  New conditions have placeholders `value`."""
        same = {name for name, one in self.given.items() if before.given.get(name) is one}
        now, then = self.conditions["walls"], before.conditions["walls"]
        same |= {wall for wall in SIDES[self.free.shape[1]] if set(now.get(wall, "")) == set(then.get(wall, ""))}
        out = self.unknown(value)
        for quantity, values in out.items():
            kept = outcome.get(quantity, {})
            values |= {name: kept[name] for name in same & kept.keys() & values.keys()}
        return out

    def kinetic(self, outcome: Outcome) -> float:
        """Return the kinetic energy (J) of free tools."""
        d, tools = self.free.shape[1], self.of(Tool)
        moving = [(tools[name].mass, v) for name, v in outcome.get("tool_velocity", {}).items() if name in tools]
        moving += [(tools[name].inertia(d), v) for name, v in outcome.get("tool_spin", {}).items() if name in tools]
        return sum(m / 2 * float((v**2).sum()) for m, v in moving)

    def gravity_at(self, t: float) -> NDArray[np.float64] | None:
        """Return the acceleration of gravity (d,) at time t (s), in m/s^2, or None without gravity."""
        gravity = self.conditions["gravity"]
        name = f"gravity at t = {t:g} s"
        d = self.free.shape[1]
        if gravity is None:
            return None
        return _gravity(given(name, gravity, t, None, d, number=False), name, d, self.axisymmetric)


def stage(
    bodies: Sequence[Body],
    materials: SceneMaterials,
    momentum: MomentumForms,
    fed: Sequence[Feeding],
    conditions: Mapping[str, Any],
    present: Sequence[bool],
    later: Sequence[int],
    known: Mapping[str, Any],
) -> Stage:
    """Return a stage.

    `bodies`, `materials`: all bodies and materials of the scene.
    `momentum`: forms of the balance of momentum.
    `fed`: terms in the balance of fluid that all stages have in common.
    `conditions`: walls, conditions, gravity and inertia: see `Simulation`.
    `present`: whether each body is present.
    `later`: indices of bodies that a later stage adds.
    `known`: conditions of the previous stage by name, see `named`.

    Raises
    ------
    ValueError
        A condition is invalid.
    """
    grid, fluid = materials.grid, materials.fluid
    given_by_name = named(checked(conditions["conditions"]), known)
    by_name = {name: with_weight(one, fluid) for name, one in given_by_name.items()}
    wet = tuple(of for kind in FED for of in kind.conditions)
    for name, one in by_name.items():
        if fluid is None and (isinstance(one, wet) or hasattr(one, "feeding") or getattr(one, "conducts", False)):
            raise ValueError(f"{name}: {line(one)}, must be in a scene with fluid")
    _check_inertia(by_name, bool(conditions["inertia"]))
    gravity = conditions["gravity"]
    if callable(gravity):
        check_names("gravity", gravity, ("t",))
    elif gravity is not None:
        gravity = _gravity(gravity, "gravity", grid.dim, grid.axisymmetric).copy()
    if not any(present):
        raise ValueError("bodies: none is present, must be at least one")
    walls = with_axis(grid, conditions["walls"])
    free = ~fixed_nodes(grid, walls)
    sides = Sides(grid, bodies, present)
    setting = Setting(sides, free, materials, momentum.conditions, by_name)
    feeding = [one.feeding(setting) for one in by_name.values() if hasattr(one, "feeding")]
    feeding += [kind(setting, some) for kind in FED if (some := setting.of(*kind.conditions))]
    conducts = {name: contact.conducts for name, contact in setting.of(Contact).items()}
    feeding += [ConductingContacts(conducts)] * any(conducts.values())
    found = [(kind, setting.of(*kind.conditions)) for kind in KINDS]
    acting = [one.acting(setting) for one in (*momentum.acting, *by_name.values()) if hasattr(one, "acting")]
    acting += [kind(setting, some) for kind, some in found if some]
    lattice = lattices(bodies, present, [(faces, axes) for one in acting for _, faces, axes in one.held])
    return Stage(
        given=given_by_name,
        named=by_name,
        conditions={
            "walls": dict(walls),
            "gravity": gravity,
            "inertia": bool(conditions["inertia"]),
        },  # copies: a stage is immutable
        present=tuple(present),
        later=tuple(later),
        free=free,
        axisymmetric=grid.axisymmetric,
        lattices=lattice,
        materials=materials,
        acting=tuple(acting),
        feeding=(*feeding, *fed),
    )


def _check_inertia(by_name: Mapping[str, Any], inertia: bool) -> None:
    """Raise ValueError if conditions need inertia and the stage has none, or if they do not allow its inertia."""
    for name, one in by_name.items():
        if isinstance(one, Quiet) and not inertia:
            raise ValueError(f"{name}: bodies have no inertia, must be given with inertia=True")
        if isinstance(one, Tool) and one.free and not inertia:
            raise ValueError(f"{name}: the tool has a mass, must be in a stage with inertia=True")
        if not inertia:
            continue
        if isinstance(one, Tool) and one.load is not None and not one.free:
            raise ValueError(f"{name}: the tool has a load but no mass, must have a mass with inertia")


def _gravity(value: ArrayLike, name: str, dim: int, axisymmetric: bool) -> NDArray[np.float64]:
    out = numbers(name, value, (dim,), allowed=f"{dim} finite numbers")
    if axisymmetric and out[0]:
        raise ValueError(f"{name} = {line(value)}, must be (0, g): axisymmetric bodies have weight along the axis only")
    return out
