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
from mpm_dolfinx.conditions.conditions import Displacement, Drained, Inflow, Pressure, RigidPlate, Traction
from mpm_dolfinx.conditions.sides import Sides
from mpm_dolfinx.conditions.unit_weights import weighed
from mpm_dolfinx.contact.tool import Tool
from mpm_dolfinx.domains.lattice import Lattice, lattices
from mpm_dolfinx.flow.hydraulic_boundary import HydraulicBoundary
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.skeleton import Fluid
from mpm_dolfinx.mechanics.mechanical_boundary import MechanicalBoundary

CONDITIONS = {
    "tractions": (Traction, Pressure),
    "displacements": Displacement,
    "drained": Drained,
    "inflows": Inflow,
    "plates": RigidPlate,
    "tools": Tool,
}


@dataclass(frozen=True, eq=False)
class Stage:
    """The conditions in force.

    conditions: as they were given, by name, the axis among the fixed walls; present: which bodies are there; later:
    those that may still come; free: (nodes, d), components that no wall holds; axisymmetric: as the grid; lattices: of
    the bodies that are there; mechanical, hydraulic: what acts on the sides of the bodies.
    """

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
        fixed, tractions, displacements, drained, inflows, plates, tools, contacts, gravity: see `Simulation`; terms: on
        sides.
    present, later
        Which bodies are there, and which may still come.

    Raises
    ------
    ValueError
        Naming the condition, its value and what is allowed.
    """
    for name, kind in CONDITIONS.items():
        all_of(name, conditions[name], kind)
    if fluid is None and (conditions["drained"] or conditions["inflows"]):
        raise ValueError("drained and inflow sides need a fluid")
    gravity = conditions["gravity"]
    if callable(gravity):
        check_names("gravity", gravity, ("t",))
    elif gravity is not None:
        gravity = _gravity(gravity, "gravity", grid.dim, grid.axisymmetric).copy()
    if not any(present):
        raise ValueError("bodies: none is there, must be at least one")
    fixed = with_axis(grid, conditions["fixed"])
    free = ~_fixed(grid, fixed)
    own = {name: tuple(values) for name, values in conditions.items() if name not in ("fixed", "gravity")}
    own["tractions"] = tuple(replace(load, value=weighed(load.value, fluid)) for load in own["tractions"])
    own["drained"] = tuple(replace(side, pressure=weighed(side.pressure, fluid)) for side in own["drained"])
    conditions = {**own, "fixed": dict(fixed), "gravity": gravity}  # nobody changes what a stage was given
    sides = Sides(grid, bodies, present)
    acting = (conditions[name] for name in ("tractions", "displacements", "plates", "tools", "terms"))
    mechanical = MechanicalBoundary(sides, free, materials, *acting, conditions["contacts"])
    hydraulic = HydraulicBoundary(sides, [*conditions["drained"], *conditions["inflows"]])
    held = [(faces, axes) for _, faces, axes in mechanical.holds]
    held += [(faces, range(grid.dim)) for _, faces in mechanical.plates]
    lattice = lattices(bodies, present, held)
    return Stage(conditions, tuple(present), tuple(later), free, grid.axisymmetric, lattice, mechanical, hydraulic)


def _gravity(value: ArrayLike, name: str, dim: int, axisymmetric: bool) -> NDArray[np.float64]:
    out = numbers(name, value, (dim,), allowed=f"{dim} finite numbers")
    if axisymmetric and out[0]:
        raise ValueError(f"{name} = {line(value)}, must be (0, g): axisymmetric bodies have weight along the axis only")
    return out


def _fixed(grid: Grid, fixed: Mapping[str, str]) -> NDArray[np.bool_]:
    """Return which components (nodes, d) are held by walls."""
    d = grid.dim
    out = np.zeros((len(grid.node_x), d), dtype=bool)
    if not isinstance(fixed, Mapping):
        raise ValueError(f"fixed = {line(fixed)}, must be walls with their components, such as {{'left': 'xy'}}")
    for wall, axes in fixed.items():
        if not isinstance(axes, str) or not axes or any(a not in "xyz"[:d] for a in axes):
            raise ValueError(f"fixed wall {wall!r}: components {axes!r}, must be some of {'xyz'[:d]!r}")
        for a in axes:
            out[grid.wall_nodes(wall), "xyz".index(a)] = True
    return out
