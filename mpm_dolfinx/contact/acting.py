# SPDX-License-Identifier: MIT
"""Tools, and contacts of groups of bodies, as conditions that act on the momentum: see `Acting`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.conditions.acting import Acting, At, Loads, Place, Setting, Shares
from mpm_dolfinx.contact.free_tools import FreeTools
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.pairing import Contacts
from mpm_dolfinx.contact.problem import ContactProblem, Gone
from mpm_dolfinx.contact.tool import Tool
from mpm_dolfinx.contact.tool_placing import NEAR, Tools, Ways
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.mechanics.given_displacements import held_faces
from mpm_dolfinx.points.material_points import MaterialPoints


class Touching(Acting):
    """What may touch the bodies, and part from them.

    Parameters
    ----------
    setting, names, found
        Where the conditions are put, their names, and what finds where they touch.
    """

    linear = False

    def __init__(self, setting: Setting, names: Sequence[str], found: Tools | Contacts):
        self._grid = setting.grid
        self.names = tuple(names)
        self.found = found
        self.symmetric = found.symmetric

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return what n points keep of each condition: pressures and shear tractions."""
        return self.found.kept(n)

    def by_name(self, rows: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return rows (conditions, ...) by the names of the conditions."""
        return dict(zip(self.names, rows, strict=True))

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments of this value."""
        return {"tool_forces": self.by_name(np.full((len(self.names), 3 if self._grid.dim == 2 else 6), value))}


class ToolsOfStage(Touching):
    """The tools of a stage.

    Parameters
    ----------
    setting, tools
        Where they are put, and the tools by name.
    """

    conditions, title = (Tool,), "tools"

    def __init__(self, setting: Setting, tools: Mapping[str, Tool]):
        held = [(hold, faces) for hold, faces, _ in held_faces(setting)]
        found = Tools(setting.grid, setting.materials, tools, setting.sides.all(), held)
        super().__init__(setting, tuple(tools), found)
        self.outside = found.faces

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments of this value, and that nothing has pushed them."""
        out, d = super().unknown(value), self._grid.dim
        tools = dict(zip(self.names, self.found.tools, strict=True))
        out["tool_travel"] = {name: np.zeros(d if tool.free else ()) for name, tool in tools.items()}
        if self.found.free:
            out["tool_velocity"] = {name: tool.begins(d) for name, tool in tools.items() if tool.free}
        return out

    def _ways(self, place: Place) -> NDArray[np.float64]:
        """Return how far loads had pushed them at the start of a step (tools,), m; with free tools (tools, d)."""
        gone = [place.before["tool_travel"][name] for name in self.names]
        if self.found.free:
            gone = [np.broadcast_to(way, (self._grid.dim,)) for way in gone]
        return np.array(gone, dtype=float)

    def placed(self, place: Place) -> Loads:
        """Return the contact with them."""
        ways = self._ways(place)
        tools = self.found.going(Ways(place.start, place.t, ways, ways), place.start + place.dt * place.inertia)
        placed = tools, place.cut, place.points, ways, (place.start, place.t)
        if not self.found.free:
            return ToolLoads(*placed)
        velocity = np.zeros_like(ways)
        for k, name in enumerate(self.names):
            velocity[k] = place.before["tool_velocity"].get(name, 0.0)
        options = {"velocity": velocity, "pushes": self.found.pushes(place.t)}
        return FreeToolLoads(*placed, mass=self.found.masses, guides=self.found.guides, **options)

    def check_start(self, place: Place) -> None:
        """Refuse tools that begin in bodies."""
        ways = self._ways(place)
        self.found.going(Ways(place.start, place.start, ways, ways)).check_start(place.cut, place.points, place.start)


class ContactsOfStage(Touching):
    """The contacts of groups in a stage.

    Parameters
    ----------
    setting, contacts
        Where they are put, and the contacts by name.
    """

    conditions, title = (Contact,), "contacts"

    def __init__(self, setting: Setting, contacts: Mapping[str, Contact]):
        found = Contacts(setting.sides, setting.materials, contacts)
        super().__init__(setting, tuple(contacts), found)

    def placed(self, place: Place) -> Loads:
        """Return the contact of the groups."""
        return ContactLoads(self.found, place.cut, place.points)

    def check_start(self, place: Place) -> None:
        """Refuse groups that begin in each other."""
        self.found.check_start(place.cut, place.points, place.start)


class ToolLoads(ContactProblem):
    """Contact with tools.

    Parameters
    ----------
    tools, cut
        The tools as they go, and the domains.
    before, times
        How far loads had pushed tools (tools,), m; the times, s, at the start and at the end.
    """

    def __init__(
        self, tools: Tools, cut: CutDomains, points: MaterialPoints, before: NDArray, times: tuple[float, float]
    ):
        super().__init__(*tools.placed(cut, points, *times))
        self._tools = tools
        self._cut = cut
        self._before = before
        self._times = times
        self.shares, self._gone = Shares(np.inf, 0.0, None), None

    def begun(self, shares: Shares, gone: Gone | None) -> ToolLoads:
        """See `Loads`."""
        out = copy(self)
        out.shares, out._gone = shares, gone
        return out

    def flown(self, at: At) -> Gone:
        """See `Loads`."""
        return Gone(self.shares.own, self.pairs.poses)

    def tool_velocity(self, at: At) -> NDArray[np.float64] | float:
        """See `ContactProblem`: as the method has it from where the tools are in both substeps."""
        pairs = self.pairs
        gone = pairs.carried - pairs.now
        if self._gone is not None:
            there = np.zeros_like(gone)
            for number, pose in enumerate(self._gone.poses):
                on = pairs.number == number
                start = self._tools.pose(number, self._times[0])
                there[on] = pose.put(start.own(pairs.now[on])) - pairs.now[on]
            gone = gone - self.shares.before / self._gone.own * there
        return gone / self.shares.own

    def ended(self, at: At) -> Loads:
        """Return the contact with the tools as they have gone."""
        out = copy(self)
        out._tools = self._tools.going(Ways(*self._times, self._before, self._before + self.found(at).travel))
        return out

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners touch tools."""
        return self._tools.near(corners, self._times[1])

    def outside(
        self, corners: NDArray[np.float64], free: NDArray[np.bool_], everywhere: bool = False
    ) -> NDArray[np.float64]:
        """Return corners with those that are in tools put out."""
        return self._tools.outside(corners, self._times[1], free, np.inf if everywhere else NEAR)

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Refuse a step in which tools have passed bodies, or after which they are in bodies."""
        start, t = self._times
        self._tools.check_end(self._cut, points, t, before, start)


class FreeToolLoads(FreeTools, ToolLoads):
    """Contact with tools some of which are free."""


class ContactLoads(ContactProblem):
    """Contact of groups, whose pairs follow the bodies.

    Parameters
    ----------
    contacts, cut, points
        The contacts, the domains, and the points where they are now.
    """

    def __init__(self, contacts: Contacts, cut: CutDomains, points: MaterialPoints):
        law, origin, again, reach = contacts.placed(cut, points)
        super().__init__(law, origin, again=again, reach=reach)
        self._contacts, self._cut = contacts, cut

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners are beside other groups."""
        return self._contacts.near(self._cut, points, corners)

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Refuse groups that are in each other."""
        self._contacts.check_end(self._cut, points, before)
