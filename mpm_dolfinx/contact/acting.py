# SPDX-License-Identifier: MIT
"""Rigid tools and contact groups as loads in the momentum balance, see `Acting`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.conditions.acting import Acting, At, Loads, Outcome, Place, Setting, Shares
from mpm_dolfinx.contact.free_tools import FreeTools
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.pairing import Contacts
from mpm_dolfinx.contact.problem import ContactProblem, Gone
from mpm_dolfinx.contact.tool import Tool
from mpm_dolfinx.contact.tool_placing import NEAR, Tools, Ways, ways_of
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.mechanics.given_displacements import held_faces
from mpm_dolfinx.points.material_points import MaterialPoints


class Touching(Acting):
    """Contact conditions of one kind in a stage: either tools, or contacts between groups.

    Parameters
    ----------
    setting, names, found
        Data of the stage, names of the conditions, and the object that finds the contact pairs.
    """

    linear = False

    def __init__(self, setting: Setting, names: Sequence[str], found: Tools | Contacts):
        self._grid = setting.grid
        self.names = tuple(names)
        self.found = found
        self.symmetric = found.symmetric

    def kept(self, n: int) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the initial contact history of n points for each condition: pressures and shear tractions."""
        return self.found.kept(n)

    def by_name(self, rows: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return the rows of an array (conditions, ...) by the names of the conditions."""
        return dict(zip(self.names, rows, strict=True))

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments on the bodies, all filled with this value."""
        return {"tool_forces": self.by_name(np.full((len(self.names), 3 if self._grid.dim == 2 else 6), value))}


class ToolsOfStage(Touching):
    """The tools of a stage.

    Parameters
    ----------
    setting, tools
        Data of the stage, and the tools by name.
    """

    conditions, title = (Tool,), "tools"

    def __init__(self, setting: Setting, tools: Mapping[str, Tool]):
        held = [(hold, faces) for hold, faces, _ in held_faces(setting)]
        found = Tools(setting.grid, setting.materials, tools, setting.sides.all(), held)
        super().__init__(setting, tuple(tools), found)
        self.outside = found.faces

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments filled with this value, displacements by loads of zero, and initial velocities."""
        out, d = super().unknown(value), self._grid.dim
        tools = dict(zip(self.names, self.found.tools, strict=True))
        out["tool_travel"] = {name: np.zeros(d if tool.free else ()) for name, tool in tools.items()}
        if self.found.free:
            out["tool_velocity"] = {name: tool.begins(d) for name, tool in tools.items() if tool.free}
        turning = dict(zip(self.names, self.found.turning, strict=True))
        if any(turning.values()):
            out["tool_rotation"] = {name: np.array(0.0) for name, turns in turning.items() if turns}
            out["tool_spin"] = {name: np.array(float(tools[name].spin)) for name, turns in turning.items() if turns}
        return out

    def _ways(self, place: Place) -> NDArray[np.float64]:
        """Return displacements by loads (tools,), m, before a step; with free tools (tools, q), with rotations, rad."""
        if self.found.free:
            return self._of_free(place.before, "tool_travel", "tool_rotation")
        return np.array([place.before["tool_travel"][name] for name in self.names], dtype=float)

    def _of_free(self, before: Outcome, along: str, around: str) -> NDArray[np.float64]:
        """Return the displacements and rotations (tools, q), or the velocities; zero for tools that are not free."""
        d = self._grid.dim
        out = np.zeros((len(self.names), ways_of(d)))
        for row, name in zip(out, self.names, strict=True):
            row[:d] = before[along].get(name, 0.0)
            row[d:] = before.get(around, {}).get(name, 0.0)
        return out

    def placed(self, place: Place) -> Loads:
        """Return the loads by contact with tools in a substep."""
        ways = self._ways(place)
        tools = self.found.going(Ways(place.start, place.t, ways, ways), place.start + place.dt * place.inertia)
        placed = tools, place.cut, place.points, ways, (place.start, place.t)
        if not self.found.free:
            return ToolLoads(*placed)
        velocity = self._of_free(place.before, "tool_velocity", "tool_spin")
        options = {"velocity": velocity, "pushes": self.found.pushes(place.t)}
        return FreeToolLoads(*placed, mass=self.found.masses, guides=self.found.guides, **options)

    def check_start(self, place: Place) -> None:
        """Raise an error if a tool is inside a body at the start."""
        ways = self._ways(place)
        self.found.going(Ways(place.start, place.start, ways, ways)).check_start(place.cut, place.points, place.start)


class ContactsOfStage(Touching):
    """The contacts between groups in a stage.

    Parameters
    ----------
    setting, contacts
        Data of the stage, and the contacts by name.
    """

    conditions, title = (Contact,), "contacts"

    def __init__(self, setting: Setting, contacts: Mapping[str, Contact]):
        found = Contacts(setting.sides, setting.materials, contacts)
        super().__init__(setting, tuple(contacts), found)

    def placed(self, place: Place) -> Loads:
        """Return the loads by contact between groups in a substep."""
        return ContactLoads(self.found, place.cut, place.points)

    def check_start(self, place: Place) -> None:
        """Raise an error if groups overlap at the start."""
        self.found.check_start(place.cut, place.points, place.start)


class ToolLoads(ContactProblem):
    """Loads by contact with tools in a substep.

    Parameters
    ----------
    tools, cut
        Tools with their motion in the step, and cut particle domains.
    before, times
        Displacements caused by loads before the step (tools,), m.  Start of the step and end of the substep, s.
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
        """See `ContactProblem`.  The time integration finds the velocity from tool positions in both substeps."""
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
        """Return the loads by contact with the tools at their final positions."""
        out = copy(self)
        out._tools = self._tools.going(Ways(*self._times, self._before, self._before + self.found(at).travel))
        return out

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners touch tools."""
        return self._tools.near(corners, self._times[1])

    def outside(
        self, corners: NDArray[np.float64], free: NDArray[np.bool_], everywhere: bool = False
    ) -> NDArray[np.float64]:
        """Return the corners, moved out of the tools that they slightly penetrate."""
        return self._tools.outside(corners, self._times[1], free, np.inf if everywhere else NEAR)

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise an error if a tool has passed through a body, or lies inside one."""
        start, t = self._times
        self._tools.check_end(self._cut, points, t, before, start)


class FreeToolLoads(FreeTools, ToolLoads):
    """Loads by contact with tools, among them free tools."""


class ContactLoads(ContactProblem):
    """Loads by contact between groups; the contact pairs follow the motion of the bodies.

    Parameters
    ----------
    contacts, cut, points
        Contacts, cut particle domains, and material points at the start of the step.
    """

    def __init__(self, contacts: Contacts, cut: CutDomains, points: MaterialPoints):
        law, origin, again, reach = contacts.placed(cut, points)
        super().__init__(law, origin, again=again, reach=reach)
        self._contacts, self._cut = contacts, cut

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners are near other groups."""
        return self._contacts.near(self._cut, points, corners)

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Raise an error if groups overlap after the step."""
        self._contacts.check_end(self._cut, points, before)
