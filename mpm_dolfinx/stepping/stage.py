# SPDX-License-Identifier: MIT
"""A stage: which bodies are there and what acts on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.given_values import check_names, given
from mpm_dolfinx.base.validation import all_of, line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.axis import with_axis
from mpm_dolfinx.conditions.conditions import (
    Displacement,
    Drained,
    Inflow,
    OnSide,
    Pressure,
    RigidPlate,
    Source,
    Traction,
)
from mpm_dolfinx.conditions.sides import Sides
from mpm_dolfinx.conditions.unit_weights import weighed
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.tools import Tool
from mpm_dolfinx.domains.lattice import Lattice, lattices
from mpm_dolfinx.flow.hydraulic_boundary import HydraulicBoundary
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.skeleton import Fluid
from mpm_dolfinx.mechanics.mechanical_boundary import MechanicalBoundary

Condition = Traction | Pressure | Displacement | RigidPlate | Drained | Inflow | Tool | Contact
"""What acts on the bodies."""
KINDS = {
    "tractions": (Traction, Pressure),
    "displacements": (Displacement,),
    "outlets": (Drained, Inflow),
    "plates": (RigidPlate,),
    "tools": (Tool,),
    "contacts": (Contact,),
}


def by_kind(conditions: Sequence[Condition]) -> dict[str, tuple]:
    """Return conditions by their kind, in their order; ValueError where one is none."""
    known = tuple(kind for kinds in KINDS.values() for kind in kinds)
    if isinstance(conditions, Sequence) and any(isinstance(one, (OnSide, Source)) for one in conditions):
        raise ValueError("conditions: OnSide and Source are terms, must be given as terms=")
    all_of("conditions", conditions, known)
    if len({id(one) for one in conditions}) < len(conditions):
        twice = next(one for i, one in enumerate(conditions) if any(one is other for other in conditions[:i]))
        raise ValueError(f"conditions: {line(twice)} is given twice, must be given once")
    return {name: tuple(one for one in conditions if isinstance(one, kinds)) for name, kinds in KINDS.items()}


@dataclass(frozen=True, eq=False)
class Stage:
    """The conditions in force.

    given: the conditions, as they were given; conditions: by kind, with walls, the axis among them, gravity and terms;
    present: which bodies are there; later: those that may still come; free: (nodes, d), components that no wall holds;
    axisymmetric: as the grid; lattices: of the bodies that are there; mechanical, hydraulic: what acts on the sides of
    the bodies.
    """

    given: tuple[Condition, ...]
    conditions: Mapping[str, Any]
    present: tuple[bool, ...]
    later: tuple[int, ...]
    free: NDArray[np.bool_]
    axisymmetric: bool
    lattices: Sequence[Lattice]
    mechanical: MechanicalBoundary
    hydraulic: HydraulicBoundary

    @property
    def surfaces(self) -> list[Surface]:
        """The faces of all conditions but tools and contacts."""
        return [*self.mechanical.surfaces, *(faces for _, faces in self.hydraulic.outlets)]

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
    conditions
        walls, conditions, gravity: see `Simulation`; terms: on sides.
    present, later
        Which bodies are there, and which may still come.

    Raises
    ------
    ValueError
        Naming the condition, its value and what is allowed.
    """
    own = by_kind(conditions["conditions"])
    if fluid is None and own["outlets"]:
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
    given, own["terms"] = tuple(conditions["conditions"]), tuple(conditions["terms"])
    own["tractions"] = tuple(replace(load, value=weighed(load.value, fluid)) for load in own["tractions"])
    own["outlets"] = tuple(
        replace(side, pressure=weighed(side.pressure, fluid)) if isinstance(side, Drained) else side
        for side in own["outlets"]
    )
    conditions = {**own, "walls": dict(walls), "gravity": gravity}  # nobody changes what a stage was given
    sides = Sides(grid, bodies, present)
    acting = (conditions[name] for name in ("tractions", "displacements", "plates", "tools", "terms"))
    mechanical = MechanicalBoundary(sides, free, materials, *acting, conditions["contacts"])
    hydraulic = HydraulicBoundary(sides, conditions["outlets"])
    held = [(faces, axes) for _, faces, axes in mechanical.holds]
    held += [(faces, range(grid.dim)) for _, faces in mechanical.plates]
    lattice = lattices(bodies, present, held)
    return Stage(
        given=given,
        conditions=conditions,
        present=tuple(present),
        later=tuple(later),
        free=free,
        axisymmetric=grid.axisymmetric,
        lattices=lattice,
        mechanical=mechanical,
        hydraulic=hydraulic,
    )


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
