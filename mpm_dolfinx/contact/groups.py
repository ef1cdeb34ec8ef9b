# SPDX-License-Identifier: MIT
"""Contact between groups of bodies.  Each group has its own copy of the grid, so groups can slide and separate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from mpm_dolfinx.base.validation import flag, line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.grid.grid import Grid, GridOfGroups


@dataclass(frozen=True, eq=False)
class Contact:
    """Two groups of bodies in contact, with slip and separation.

    Bodies of one group are bonded where they touch.  Groups cannot penetrate each other, but may slide and separate.
    In a scene with contacts, each body must belong to a group, and each pair of groups must have one contact.
    `Simulation.tool_forces` contains the forces on the bodies of `one`.

    Parameters
    ----------
    one, other : int or several
        Indices of the bodies of each group.
    friction
        Coulomb's coefficient mu, >= 0.
    adhesion
        Shear strength of the contact in addition to friction, Pa, >= 0, as for a `Tool`.
    conducts
        Whether pore fluid flows through closed parts of the contact.  The pore pressure is then continuous across these
        parts.  A gap of at most 5e-4 cell sizes counts as closed.  `Simulation.outflows` contains the flow from `one`
        to `other`.  With or without flow, friction depends on the total normal stress.
    name
        Name of the contact in results; by default "contact".

    Raises
    ------
    ValueError
        A value is invalid.  `Simulation` also raises this error if two groups share a body, or lack a common `Contact`.
    """

    one: int | Sequence[int]
    other: int | Sequence[int]
    friction: float = 0.0
    adhesion: float = 0.0
    conducts: bool = field(default=False, kw_only=True)
    name: str | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self):
        for name in ("friction", "adhesion"):
            value = getattr(self, name)
            numbers(f"Contact: {name}", value, test=lambda v: (v >= 0) & (v < np.inf), allowed=">= 0 and finite")
        flag("Contact: conducts", self.conducts)

    @property
    def frictional(self) -> bool:
        """Whether the contact resists slip."""
        return self.friction > 0 or self.adhesion > 0

    def groups(self, count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the indices of the bodies of both groups, in a scene of `count` bodies."""
        allowed = f"indices of the bodies, 0 to {count - 1}"
        found = []
        for name in ("one", "other"):
            value = numbers(
                f"Contact: {name}",
                getattr(self, name),
                None,
                allowed=allowed,
                test=lambda i: (i >= 0) & (i < count) & (i % 1 == 0),
            )
            if not value.size:
                raise ValueError(f"Contact: {name} = {line(getattr(self, name))}, must be {allowed}")
            found.append(tuple(sorted({int(i) for i in value.ravel()})))
        if common := set(found[0]) & set(found[1]):
            what = f"Contact: body {min(common)} is in one = {line(self.one)} and in other = {line(self.other)}"
            raise ValueError(f"{what}, must be in one of the two, because a body does not touch itself")
        return found[0], found[1]


def groups_of(contacts: Sequence[Contact], count: int) -> list[tuple[int, ...]]:
    """Return the groups in a scene of `count` bodies, as tuples of body indices, sorted by smallest index."""
    pairs = [contact.groups(count) for contact in contacts]
    groups = sorted({group for pair in pairs for group in pair})
    for one, other in combinations(groups, 2):
        if common := set(one) & set(other):
            what = f"contacts: body {min(common)} is in the groups {line(one)} and {line(other)}"
            raise ValueError(f"{what}, must be in one group; name all bodies of a group in each of its contacts")
        between = sum({*pair} == {one, other} for pair in pairs)
        if between != 1:
            raise ValueError(f"contacts: groups {line(one)} and {line(other)} have {between} contacts, must have one")
    if missing := set(range(count)) - {body for group in groups for body in group}:
        raise ValueError(f"contacts: body {min(missing)} is in no group, must be in one group")
    return groups


def grouped(
    grid: Grid, bodies: Sequence[Body], contacts: Sequence[Contact], quadrature: str, other: dict[str, Any]
) -> Grid:
    """Return the grid of a scene.  With contacts, this grid contains a separate copy of the box for each group.

    Parameters
    ----------
    contacts, quadrature
        See `Simulation`.
    other
        Values, by name, of options that must be absent or empty in a scene with contacts.

    Raises
    ------
    ValueError
        Contacts are invalid, or an option is not available with contacts.
    """
    if not contacts:
        return grid
    if quadrature == "point":
        raise ValueError("quadrature = 'point', must be 'domain' with contacts")
    for name, value in other.items():
        if value is not None and not (isinstance(value, Sequence) and not len(value)):
            raise ValueError(f"{name}: not available with contacts, must be absent")
    group = np.zeros(len(bodies), dtype=np.int64)
    for number, members in enumerate(groups_of(contacts, len(bodies))):
        group[list(members)] = number
    return GridOfGroups(grid, group, np.cumsum([0, *map(len, bodies[:-1])]))
