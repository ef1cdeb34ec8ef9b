# SPDX-License-Identifier: MIT
"""Tools, and contacts of groups of bodies, as conditions that act on the momentum: see `conditions.acting`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.conditions.acting import Acting, At, Loads, Place, Setting
from mpm_dolfinx.contact.body_contact import Following
from mpm_dolfinx.contact.cell_contact import CellContact
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.pairing import Contacts
from mpm_dolfinx.contact.tool_contact import ToolContact
from mpm_dolfinx.contact.tool_placing import NEAR, Tools, Ways
from mpm_dolfinx.contact.tools import Tool
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.forms.unknowns import Unknowns, sum_ghosts
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.mechanics.given_displacements import held_faces
from mpm_dolfinx.mechanics.tractions import DeadForces
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import MaterialPoints


class Touching(Acting):
    """What may touch the bodies, and part from them.

    Parameters
    ----------
    setting, names, found
        Where the conditions are put, their names, and what finds where they touch.
    """

    def __init__(self, setting: Setting, names: Sequence[str], found: Tools | Contacts):
        self._grid, self.names, self.found = setting.grid, tuple(names), found
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


class Slopes:
    """Points with a force that changes with their displacement, and minus its derivative."""

    def __init__(self, grid: Grid, u: fem.Function):
        self.points = p = FormPoints(grid, slope=(grid.dim, grid.dim))
        v, du = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
        self.work = PointForm(ufl.inner(p.slope * p.value(du), p.value(v)) * p.dx, p)


class ToolsOfStage(Touching):
    """The tools of a stage.

    Parameters
    ----------
    setting, tools
        Where they are put, and the tools by name.
    """

    conditions = (Tool,)

    def __init__(self, setting: Setting, tools: Mapping[str, Tool]):
        held = [(hold, faces) for hold, faces, _ in held_faces(setting)]
        self.forms, self.room = setting.forms, fem.Function(setting.forms.u.function_space)
        found = Tools(setting.grid, setting.materials, tools, setting.sides.all(), held)
        super().__init__(setting, tuple(tools), found)

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments of this value, and that no load has pushed them."""
        return super().unknown(value) | {"tool_travel": self.by_name(np.zeros(len(self.names)))}

    def _ways(self, place: Place) -> NDArray[np.float64]:
        """Return how far loads had pushed them at the start of a step (tools,), m."""
        return np.array([place.before["tool_travel"][name] for name in self.names], dtype=float)

    def placed(self, place: Place) -> Loads:
        """Return the contact with them."""
        ways = self._ways(place)
        tools = self.found.going(Ways(place.start, place.t, ways, ways))
        contact = tools.placed(place.cut, place.points, place.start, place.t)
        return ToolLoads(self, contact, tools, place.cut, ways, (place.start, place.t))

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

    conditions = (Contact,)

    def __init__(self, setting: Setting, contacts: Mapping[str, Contact]):
        found = Contacts(setting.sides, setting.materials, contacts)
        super().__init__(setting, tuple(contacts), found)

    def placed(self, place: Place) -> Loads:
        """Return the contact of the groups."""
        return ContactLoads(self, self.found.placed(place.cut, place.points), place.cut)

    def check_start(self, place: Place) -> None:
        """Refuse groups that begin in each other."""
        self.found.check_start(place.cut, place.points, place.start)


class TouchLoads(Loads):
    """A contact in a substep."""

    linear, smooth, touches = False, False, True

    def __init__(self, acting: Touching, cut: CutDomains):
        self._acting, self._cut, self._grid = acting, cut, cut.grid


class ToolLoads(TouchLoads):
    """Contact with tools.

    Parameters
    ----------
    acting, contact, tools
        The conditions, the contact, and the tools as they go.
    cut, before, times
        The domains; how far loads had pushed tools (tools,), m, and the times, s, at the start and at the end.
    """

    def __init__(
        self,
        acting: ToolsOfStage,
        contact: ToolContact,
        tools: Tools,
        cut: CutDomains,
        before: NDArray[np.float64],
        times: tuple[float, float],
    ):
        super().__init__(acting, cut)
        self.contact, self._tools, self._before, self._times = contact, tools, before, times

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Take the forces at u off."""
        forces, force, room = self._acting.forms(DeadForces), self.contact.at(at.nodal).force, self._acting.room
        room.x.array[:] = 0.0
        data = PointData(forces.points, self.contact.places, np.ones(len(force)), {"force": force})
        forces.work.assemble_vector(room.x.array, data)
        residual.array_w[:] -= sum_ghosts(room)[on.owned]

    def tangent(self, K: PETSc.Mat) -> None:
        """Add minus the derivative of the forces at u."""
        slopes, u = self._acting.forms(Slopes), self._acting.forms.u.x.array.reshape(-1, self._grid.dim)
        slope = self.contact.at(u).slope
        data = PointData(slopes.points, self.contact.places, np.ones(len(slope)), {"slope": slope})
        slopes.work.assemble_matrix(K, data)
        self.contact.assemble_matrix(K, u)

    def settle(self, at: At, sticks: bool) -> bool:
        """Choose what slips."""
        return self.contact.settle(at.nodal, sticks)

    def augment(self, at: At, unknown: NDArray[np.float64]) -> bool:
        """Shift pressures where tools penetrate too deep; those that loads push go on until they meet as much."""
        rows, of_tools = self.contact.rows, np.zeros(len(self._before))
        np.maximum.at(of_tools, rows.number, unknown[rows.cell])
        return self.contact.augment(at.nodal, over_all(self._grid.comm, of_tools, MPI.MAX))

    def touching(self) -> tuple:
        """Return where tools hold what touches."""
        cells, *places = self.contact.touching()
        return cells, None, *places

    def rounding(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what rounding leaves: that of tools with coordinates as well."""
        out, cells = of_cells.copy(), self.contact.rows.cell
        np.maximum.at(out, cells, out[cells] + self.contact.rounding)
        return out

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments on the bodies, and how far loads have pushed tools, m."""
        by_name = self._acting.by_name
        return {"tool_forces": by_name(self.contact.forces(at.nodal)), "tool_travel": by_name(self.contact.pushed.ways)}

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with pressures and shear tractions."""
        return self.contact.gripped(at.nodal, points)

    def ended(self, at: At) -> Loads:
        """Return the contact with the tools as they have gone."""
        tools = self._tools.going(Ways(*self._times, self._before, self.contact.pushed.ways))
        return ToolLoads(self._acting, self.contact, tools, self._cut, self._before, self._times)

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


class ContactLoads(TouchLoads):
    """Contact of groups, whose pairs follow the bodies."""

    couples = True

    def __init__(self, acting: ContactsOfStage, contact: Following, cut: CutDomains):
        super().__init__(acting, cut)
        self._following = contact

    @property
    def _now(self) -> CellContact:
        return self._following.now

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Take the forces at u off."""
        if on is at.unknowns:
            self._now.push(*at, residual)
        else:
            self._now.push_on(on, *at, residual)

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat | None:
        """Return zeros where pairs may join nodes."""
        return self._now.pattern(unknowns)

    def coupling(self, at: At) -> PETSc.Mat | None:
        """Return minus the derivative of the forces at u."""
        return self._now.tangent(*at)

    def settle(self, at: At, sticks: bool) -> bool:
        """Choose what slips."""
        return self._now.settle(*at, sticks)

    def augment(self, at: At, unknown: NDArray[np.float64]) -> bool:
        """Shift pressures where groups penetrate too deep."""
        return self._now.augment(*at)

    def follow(self, at: At) -> bool:
        """Find pairs anew."""
        return self._following.follow(*at)

    def touching(self) -> tuple:
        """Return where groups hold one another."""
        return self._now.touching()

    @property
    def rounding_beside(self) -> float:
        """What rounding leaves on other sides, in other cells."""
        return over_all(self._grid.comm, float(self._now.rounding.max(initial=0.0)), MPI.MAX)

    def outcome(self, at: At) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return forces and moments on the bodies of `one`."""
        return {"tool_forces": self._acting.by_name(self._now.forces(*at))}

    def gripped(self, at: At, points: MaterialPoints) -> MaterialPoints:
        """Return the points with pressures and shear tractions."""
        return self._now.gripped(*at, points)

    def near(self, points: MaterialPoints, corners: NDArray[np.float64]) -> NDArray[np.bool_] | bool:
        """Return which corners are beside other groups."""
        return self._acting.found.near(self._cut, points, corners)

    def check_end(self, points: MaterialPoints, before: MaterialPoints) -> None:
        """Refuse groups that are in each other."""
        self._acting.found.check_end(self._cut, points, before)
