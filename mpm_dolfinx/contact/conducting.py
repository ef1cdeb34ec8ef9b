# SPDX-License-Identifier: MIT
"""Flow of pore fluid through the closed parts of contacts between groups.

A pair of opposite positions on two surfaces (`pairs`) conducts fluid between the cells of both positions while its gap
is closed (`ContactLoads.closed`).  The two cells conduct in series, as in the two-point fluxes between cells
(`flow/fluxes.py`), so the pressure is continuous across the surface:

    Q = r [p_1 - p_2 + rho_w g . (x_2 - x_1)] / (d_1 / (A kappa_1) + d_2 / (A kappa_2)).

A is the area of the pair's point, kappa is the mobility of a cell across the surface, and d is the distance from the
centroid x of the cell's material to the surface.  The factor r is that of `storage`.  All quantities refer to the last
reset of the grid, and mobilities are pulled back (`Conduction.across`).

The pressures of both cells are implicit.  The set of closed pairs is an active set: it is fixed while fluxes are
assembled, and updated between Newton steps.  After `FOLLOWS` changes in a substep, it remains fixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import mean_density
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.conditions.acting import Setting
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.pairing import ContactLoads
from mpm_dolfinx.contact.problem import FOLLOWS
from mpm_dolfinx.flow.drained_sides import shapes
from mpm_dolfinx.flow.feeding import Feeding, Feeds, Fluid, Leaving, Wet
from mpm_dolfinx.flow.fluxes import CellContents, Conduction, OpenSides
from mpm_dolfinx.forms.cell_matrices import between_cells
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import Exchange, over_all


class ConductingContacts(Feeding):
    """The contacts of a stage, at least one of which conducts fluid.

    Raises
    ------
    ValueError
        If the scene has unsaturated soil.
    """

    conditions, title = (Contact,), "contacts that conduct"

    def __init__(self, setting: Setting, contacts: Mapping[str, Contact]):
        conduct = {name: one for name, one in contacts.items() if one.conducts}
        if setting.materials.retentions is not None:
            name, one = next(iter(conduct.items()))
            raise ValueError(f"{name}: {line(one)}, must be conducts=False with a retention curve (unsaturated soil)")
        self._names, self._all, self.count = tuple(conduct), tuple(contacts), len(conduct)

    def unknown(self, value: float) -> dict[str, NDArray[np.float64]]:
        """Return the flows before the first step, all equal to `value`."""
        return {name: np.array(value) for name in self._names}

    def placed(self, wet: Wet) -> Feeds:
        """Return the flow through the contacts in a substep."""
        loads = [one for one in wet.loads if one.conducts]
        return ContactFeeds(loads[0], wet, self._all, self._names) if loads else Feeds()


class Half(NamedTuple):
    """One side of m closed pairs, on the owners of its cells."""

    cells: NDArray[np.int32]  # local cells (m,)
    at: NDArray[np.int64]  # indices of the cells among the filled owned cells (m,)
    area: NDArray[np.float64]  # outward area vectors (m, d), m^(d-1)
    normal: NDArray[np.float64]  # outward unit normals (m, d)
    offset: NDArray[np.float64]  # vectors from the centroids of the cells' material to the surface (m, d), m
    shape: NDArray[np.float64]  # areas divided by distances (m,), m^(d-2)

    @classmethod
    def of(cls, contents: CellContents, cells: NDArray[np.int32], x: NDArray, area: NDArray) -> Half:
        """Return a side with positions x (m, d), m, in the cells at the last reset of the grid."""
        size, offset, shape = shapes(contents, cells, x, area)
        return cls(cells, contents.slot(cells), area, area / size[:, None], offset, shape)

    def rows(self, contents: CellContents, flow: Conduction, fluid: Fluid) -> NDArray[np.float64]:
        """Return the pressure (Pa), conductance (m^d/(Pa s)), position (m) and force (N/m^3) of the cell of each pair.

        The position is that of the centroid.  The force is the unit weight plus the inertia force.
        """
        shape, d = self.shape, self.area.shape[1]
        if flow.mobility.shift is not None:
            shape = shape * flow.distance_ratio(self.at, self.normal, self.offset)
        x = contents.grid.midpoints[self.cells] + contents.centroid[self.cells]
        if flow.motion is not None:
            x = x + flow.motion.moved[self.at]
        force = np.zeros((len(shape), d)) if flow.weight is None else np.broadcast_to(flow.weight, (len(shape), d))
        if fluid.force is not None:
            force = force + fluid.force[self.at]
        return np.column_stack([fluid.p[self.at], flow.across(self.at, self.normal) * shape, x, force])

    def side(self) -> OpenSides:
        """Return the closed part of the surface.  It is no no-flow side of its cells, see `Gradients`."""
        none = np.zeros(len(self.at))
        unknown = np.full(len(self.at), np.nan)
        number, free = none.astype(np.int64), none.astype(bool)
        return OpenSides(number, self.cells, none, none, none, free, self.area, self.offset, unknown, unknown)


class Links(NamedTuple):
    """The m closed pairs on this process, and the other sides of pairs, which the exchange sends to their owners."""

    law: object  # contact law of the pairs
    closed: NDArray[np.bool_]  # whether each pair of the law is closed
    changes: int  # number of changes of the closed pairs in the substep
    exchange: Exchange
    near: Half  # cells of the points
    far: Half  # cells of the opposite positions
    pairs: NDArray[np.int64]  # lexicographic cells of both sides (m, 2)


class ContactFeeds(Feeds):
    """Flow through closed contacts in a substep.

    `contact`: contact loads between groups.
    `wet`: data of the substep.
    `every`, `names`: names of all contacts, and of the contacts that conduct.
    """

    settles = True

    def __init__(self, contact: ContactLoads, wet: Wet, every: tuple[str, ...], names: tuple[str, ...]):
        self._contact, self._present, self._contents = contact, wet.at, wet.contents
        self._grid, self._every, self._names = wet.contents.grid, every, names
        self._links = self._linked(0)
        sides = [half.side() for half in (self._links.near, self._links.far)]
        self.sides = OpenSides.joined(sides, self._grid.dim)
        self._correction = self._links.closed[:0], np.zeros(0)

    def _linked(self, changes: int) -> Links:
        """Return the pairs that are closed at u."""
        grid, contents, pairs = self._grid, self._contents, self._contact.pairs
        closed = self._contact.closed(self._present)
        other, area = pairs.other[closed], pairs.outward[closed]
        exchange = Exchange(grid.comm, grid.owner(other))
        far = exchange.send(other), exchange.send(np.hstack([pairs.y[closed], -area]))
        beyond = np.split(far[1], 2, axis=1)
        near = Half.of(contents, pairs.cell[closed], pairs.x[closed], area)
        cells = np.column_stack([grid.cell_number[pairs.cell[closed]], other])
        of = self._contact.now.law
        return Links(of, closed, changes, exchange, near, Half.of(contents, grid.locals[far[0]], *beyond), cells)

    @property
    def _now(self) -> Links:
        """The closed pairs.  They are found again if the contact has updated its pairs."""
        if self._contact.now.law is not self._links.law:
            self._links = self._linked(self._links.changes)
        return self._links

    def conducting(self, flow: Conduction) -> Conduction:
        """Return the conductivity and motion of the cells."""
        return flow

    def begin(self, at: Conduction, fluid: Fluid, difference: NDArray[np.float64]) -> None:
        """Store the non-orthogonal corrections of the pressure differences, see `Feeds`."""
        links = self._links
        near, far = np.split(difference, [len(links.near.at)])  # as in `sides`
        self._correction = self._contact.pairs.place[links.closed], near - links.exchange.back(far)

    @staticmethod
    def _conductance(near: NDArray[np.float64], far: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the conductances (m,) of the closed pairs, in m^d/(Pa s), from the rows of both sides."""
        own, other = near[:, 1], far[:, 1]
        return own * np.divide(other, own + other, out=np.zeros(len(own)), where=own + other > 0)

    def _through(self, at: Conduction, fluid: Fluid) -> tuple[Links, NDArray[np.float64], NDArray[np.float64]]:
        """Return the closed pairs, their flows (m,) in m^d/s, and the scale (m,) of rounding errors of these flows."""
        links, d = self._now, self._grid.dim
        near = links.near.rows(self._contents, at, fluid)
        far = links.exchange.back(links.far.rows(self._contents, at, fluid))
        p, other = near[:, 0], far[:, 0]
        (x, force), (y, beyond) = (np.split(rows[:, 2:], [d], axis=1) for rows in (near, far))
        difference = p - other + ((y - x) * (force + beyond)).sum(axis=1) / 2
        places, correction = self._correction
        _, row, column = np.intersect1d(self._contact.pairs.place[links.closed], places, return_indices=True)
        difference[row] += correction[column]
        conductance = self._conductance(near, far) * mean_density(p, other, at.bulk)
        return links, conductance * difference, conductance * (np.abs(p) + np.abs(other))

    def leaving(self, at: Conduction, fluid: Fluid) -> Leaving:
        """Return the outflow of the cells to cells of other groups."""
        links, *flows = self._through(at, fluid)
        rows, n = np.stack(flows), len(fluid.p)
        own = sum_by(links.near.at, rows, n)
        cells, turnover = own + [[-1], [1]] * sum_by(links.far.at, links.exchange.send(rows.T).T, n)
        return Leaving(cells, turnover)

    def coupling(self, at: Conduction, fluid: Fluid, unknowns: Unknowns) -> PETSc.Mat:
        """Return the derivative of the outflow with respect to the pressures of both sides."""
        links = self._now
        near = links.near.rows(self._contents, at, fluid)
        slopes = self._conductance(near, links.exchange.back(links.far.rows(self._contents, at, fluid)))
        return between_cells(unknowns, self._grid, links.pairs, np.stack([slopes, slopes]))

    def settle(self, at: Conduction, fluid: Fluid) -> int:
        """Update the closed pairs, and return the number of changes on this process."""
        links = self._now
        changes = int((self._contact.closed(self._present) != links.closed).sum())
        if links.changes == FOLLOWS or not over_all(self._grid.comm, changes):
            return 0
        self._links = self._linked(links.changes + 1)
        return changes

    def outflows(self, at: Conduction, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return the flows, in m^d/s, from the bodies `one` to the bodies `other` of each contact."""
        links, flows, _ = self._through(at, fluid)
        pairs = self._contact.pairs
        sums = sum_by(pairs.number[links.closed], pairs.sign[links.closed] * flows, len(self._every))
        sums = over_all(self._grid.comm, sums)
        return {name: np.array(sums[self._every.index(name)]) for name in self._names}
