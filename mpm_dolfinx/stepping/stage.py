# SPDX-License-Identifier: MIT
"""A stage: which bodies are there and what acts on them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from dolfinx.common import Timer
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.given_values import check_names, given
from mpm_dolfinx.base.validation import all_of, line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import QUANTITIES, Acting, Loads, Outcome, Place, Setting
from mpm_dolfinx.conditions.axis import with_axis
from mpm_dolfinx.conditions.conditions import Displacement, Drained, Inflow, Pressure, RigidPlate, Traction
from mpm_dolfinx.conditions.names import named
from mpm_dolfinx.conditions.sides import Sides
from mpm_dolfinx.conditions.unit_weights import weighed
from mpm_dolfinx.contact.acting import ContactsOfStage, ToolsOfStage
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.tools import Tool
from mpm_dolfinx.domains.lattice import Lattice, lattices
from mpm_dolfinx.flow.hydraulic_boundary import HydraulicBoundary
from mpm_dolfinx.grid.grid import SIDES, Grid
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.skeleton import Fluid
from mpm_dolfinx.mechanics.given_displacements import GivenDisplacements
from mpm_dolfinx.mechanics.momentum import MomentumForms
from mpm_dolfinx.mechanics.plates import Plates
from mpm_dolfinx.mechanics.pressures import Pressures
from mpm_dolfinx.mechanics.tractions import Tractions

CONDITIONS = {
    "tractions": (Traction, Pressure),
    "displacements": Displacement,
    "drained": Drained,
    "inflows": Inflow,
    "plates": RigidPlate,
    "tools": Tool,
    "contacts": Contact,
}
"""Lists in which conditions are given, and what may stand in them beside conditions of the user's own."""
KINDS: tuple[type[Acting], ...] = (Tractions, Pressures, Plates, GivenDisplacements, ToolsOfStage, ContactsOfStage)
"""What acts for conditions that do not say it themselves, by their method `acting`."""


@dataclass(frozen=True, eq=False)
class Stage:
    """The conditions in force.

    conditions: as they were given, by lists, the axis among the walls; present: which bodies are there; later:
    those that may still come; free: (nodes, d), components that no wall holds; axisymmetric: as the grid; lattices: of
    the bodies that are there; materials: of the scene; named: all conditions on the bodies, by their names; acting:
    what they do to the momentum; hydraulic: to the storage of the fluid.
    """

    conditions: Mapping[str, Any]
    present: tuple[bool, ...]
    later: tuple[int, ...]
    free: NDArray[np.bool_]
    axisymmetric: bool
    lattices: Sequence[Lattice]
    materials: SceneMaterials
    named: Mapping[str, Any]
    acting: tuple[Acting, ...]
    hydraulic: HydraulicBoundary

    @property
    def surfaces(self) -> list[Surface]:
        """The faces of all conditions but tools and contacts."""
        return [
            *(faces for one in self.acting for faces in one.surfaces),
            *(faces for _, faces in self.hydraulic.outlets),
        ]

    def of(self, *kinds: type) -> dict[str, Any]:
        """Return the conditions of some classes by their names."""
        return {name: one for name, one in self.named.items() if isinstance(one, kinds)}

    @property
    def symmetric(self) -> bool:
        """Whether the tangent of what acts is symmetric."""
        return all(one.symmetric for one in self.acting)

    @property
    def held(self) -> list[tuple[Any, Surface, Sequence[int]]]:
        """Conditions that hold faces, these, and along which axes."""
        return [one for acting in self.acting for one in acting.held]

    def placed(self, place: Place) -> list[Loads]:
        """Return what acts on the momentum in a substep."""
        with Timer("mpm: loads"):
            return [one.placed(place) for one in self.acting]

    def kept(self, n: int) -> dict[str, NDArray[np.float64]]:
        """Return what n points keep of the conditions, as these begin."""
        return {data: rows for one in self.acting for of in one.kept(n).values() for data, rows in of.items()}

    def data_names(self, names: Collection[str]) -> set[str]:
        """Return under which names points keep data of conditions of some names."""
        return {data for one in self.acting for name, of in one.kept(0).items() if name in names for data in of}

    def same(self, before: Stage) -> set[str]:
        """Return the names of conditions that there were in the stage before, or that had the name given to them."""
        shared = ((name, one) for name, one in self.named.items() if name in before.named)
        return {name for name, one in shared if one is before.named[name] or getattr(one, "name", None) == name}

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return an outcome of this value, where no step has been taken."""
        d = self.free.shape[1]
        out = {quantity: {} for quantity in QUANTITIES}
        out["wall_reactions"] = {wall: np.full(d, value) for wall in SIDES[d]}
        out["outflows"] = self.hydraulic.unknown(value)
        for one in self.acting:
            for quantity, values in one.unknown(value).items():
                out[quantity] = out.get(quantity, {}) | values
        return out

    def begun(self, before: Stage, outcome: Outcome, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the outcome as the stage begins after another: of this value for what is new in it."""
        same = {name for name, one in self.named.items() if before.named.get(name) is one}
        if self.conditions["walls"] == before.conditions["walls"]:
            same |= SIDES[self.free.shape[1]].keys()
        return {
            quantity: {name: outcome[quantity][name] if name in same else new for name, new in values.items()}
            for quantity, values in self.unknown(value).items()
        }

    def gravity_at(self, t: float) -> NDArray[np.float64] | None:
        """Return the acceleration of gravity (d,) at time t (s), m/s^2; None without."""
        gravity, name, d = self.conditions["gravity"], f"gravity at t = {t:g} s", self.free.shape[1]
        if gravity is None:
            return None
        return _gravity(given(name, gravity, t, None, d, number=False), name, d, self.axisymmetric)


def stage(
    grid: Grid,
    bodies: Sequence[Body],
    materials: SceneMaterials,
    fluid: Fluid | None,
    momentum: MomentumForms,
    conditions: Mapping[str, Any],
    present: Sequence[bool],
    later: Sequence[int],
) -> Stage:
    """Return a stage.

    Parameters
    ----------
    grid, bodies
        Background grid, and all bodies of the scene.
    materials
        Those of the scene.
    fluid
        Pore fluid, if there is one.
    momentum
        Forms, and what acts in all stages.
    conditions
        walls, gravity, and the lists of `CONDITIONS`: see `Simulation`.
    present, later
        Which bodies are there, and which may still come.

    Raises
    ------
    ValueError
        Naming the condition, its value and what is allowed.
    """
    for name, kind in CONDITIONS.items():
        all_of(name, [one for one in conditions[name] if not hasattr(one, "acting")], kind)
    if fluid is None and (conditions["drained"] or conditions["inflows"]):
        raise ValueError("drained and inflow sides need a fluid")
    gravity = conditions["gravity"]
    if callable(gravity):
        check_names("gravity", gravity, ("t",))
    elif gravity is not None:
        gravity = _gravity(gravity, "gravity", grid.dim, grid.axisymmetric).copy()
    if not any(present):
        raise ValueError("bodies: none is there, must be at least one")
    walls = with_axis(grid, conditions["walls"])
    free = ~_held(grid, walls)
    own = {name: tuple(values) for name, values in conditions.items() if name not in ("walls", "gravity")}
    for name, value in (("tractions", "value"), ("drained", "pressure")):
        own[name] = tuple(_weighed(one, value, fluid) for one in own[name])
    conditions = {**own, "walls": dict(walls), "gravity": gravity}  # nobody changes what a stage was given
    sides = Sides(grid, bodies, present)
    by_name = named([one for name in CONDITIONS for one in conditions[name]])
    setting = Setting(sides, free, materials, momentum.conditions, by_name)
    found = [(kind, setting.of(*kind.conditions)) for kind in KINDS]
    acting = [one.acting(setting) for one in (*momentum.acting, *by_name.values()) if hasattr(one, "acting")]
    acting += [kind(setting, mine) for kind, mine in found if mine]
    hydraulic = HydraulicBoundary(sides, setting.of(Drained, Inflow))
    lattice = lattices(bodies, present, [(faces, axes) for one in acting for _, faces, axes in one.held])
    what = (conditions, tuple(present), tuple(later), free, grid.axisymmetric, lattice, materials)
    return Stage(*what, by_name, tuple(acting), hydraulic)


def _weighed(condition: Any, name: str, fluid: Fluid | None) -> Any:
    """Return a condition whose pressure of water has a unit weight, see `weighed`."""
    given = getattr(condition, name, None)
    value = weighed(given, fluid)
    return condition if value is given else replace(condition, **{name: value})


def _gravity(value: ArrayLike, name: str, dim: int, axisymmetric: bool) -> NDArray[np.float64]:
    out = numbers(name, value, (dim,), allowed=f"{dim} finite numbers")
    if axisymmetric and out[0]:
        raise ValueError(f"{name} = {line(value)}, must be (0, g): axisymmetric bodies have weight along the axis only")
    return out


def _held(grid: Grid, walls: Mapping[str, str]) -> NDArray[np.bool_]:
    """Return which components (nodes, d) are held by walls."""
    d = grid.dim
    out = np.zeros((len(grid.node_x), d), dtype=bool)
    if not isinstance(walls, Mapping):
        raise ValueError(f"walls = {line(walls)}, must be walls with their components, such as {{'left': 'xy'}}")
    for wall, axes in walls.items():
        if not isinstance(axes, str) or not axes or any(a not in "xyz"[:d] for a in axes):
            raise ValueError(f"walls: {wall!r}: components {axes!r}, must be some of {'xyz'[:d]!r}")
        for a in axes:
            out[grid.wall_nodes(wall), "xyz".index(a)] = True
    return out
