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
from mpm_dolfinx.conditions.acting import Setting
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.pairing import ContactLoads
from mpm_dolfinx.contact.problem import FOLLOWS
from mpm_dolfinx.flow.drained_sides import shapes
from mpm_dolfinx.flow.feeding import Feeding, Feeds, Fluid, Leaving, Wet
from mpm_dolfinx.flow.fluxes import CellContents, Conduction, OpenSides
from mpm_dolfinx.flow.series import none, through
from mpm_dolfinx.forms.cell_matrices import between_cells
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import Exchange, over_all


class ConductingContacts(Feeding):
    """The contacts of a stage, at least one of which conducts fluid."""

    conditions, title = (Contact,), "contacts that conduct"
    varies = True  # the closed pairs change

    def __init__(self, setting: Setting, contacts: Mapping[str, Contact]):
        conduct = {name: one for name, one in contacts.items() if one.conducts}
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
        """Return pressure (Pa), position (m), force (N/m^3), pressure drop (Pa) and conductances (m^d/(Pa s)) of cells.

        The position is that of the centroid.  The force is the unit weight plus the inertia force.  The pressure drop
        from the centroid to the surface is due to this force.  Unsaturated soil has a conductance for each law.
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
        drop = (flow.deformed(self.at, self.offset) * force).sum(axis=1)
        conductance = (flow.across(self.at, self.normal) * shape)[:, None]
        if flow.relative is not None:
            conductance = conductance * flow.mobility.shares[self.at]
        return np.column_stack([fluid.p[self.at], x, force, drop, conductance])

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


class Flows(NamedTuple):
    """Flows through the closed pairs on this process."""

    links: Links
    flux: NDArray[np.float64]  # flow from the cell of the point to the opposite cell (m,), m^d/s
    scale: NDArray[np.float64]  # scale of the rounding error of the flow (m,), m^d/s
    slopes: NDArray[np.float64]  # derivatives of the flow, see `between_cells` (2, m), m^d/(Pa s)


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

    def _flows(self, flow: Conduction, fluid: Fluid) -> Flows:
        """Return the flows through the closed pairs."""
        links, d = self._now, self._grid.dim
        near = links.near.rows(self._contents, flow, fluid)
        far = links.exchange.back(links.far.rows(self._contents, flow, fluid))
        cuts = np.cumsum([1, d, d, 1])
        (p, x, force, ahead, own), (other, y, beyond, _, opposite) = (
            np.split(row, cuts, axis=1) for row in (near, far)
        )
        p, other = p[:, 0], other[:, 0]
        drop = ((y - x) * (force + beyond)).sum(axis=1) / 2
        if flow.relative is None:
            own, opposite = own[:, 0], opposite[:, 0]
            conductance = own * np.divide(opposite, own + opposite, out=np.zeros(len(own)), where=own + opposite > 0)
            slopes = conductance, conductance
        else:
            no_series, ones = none(len(p), own.shape[1], 1), np.ones(len(p))
            paths = [no_series._replace(parallel=parallel) for parallel in (own, opposite)]
            drops = ahead[:, 0], drop - ahead[:, 0]
            conductance, slopes = through(flow.relative.laws, (p, other), paths, (ones, ones), drops)
        places, correction = self._correction
        difference = p - other + drop
        _, row, column = np.intersect1d(self._contact.pairs.place[links.closed], places, return_indices=True)
        difference[row] += correction[column]
        density = mean_density(p, other, flow.bulk)
        scale = density * conductance * (np.abs(p) + np.abs(other))
        return Flows(links, density * conductance * difference, scale, np.stack(slopes))

    def leaving(self, at: Conduction, fluid: Fluid) -> Leaving:
        """Return the outflow of the cells to cells of other groups."""
        links, flux, scale, _ = self._flows(at, fluid)
        rows, n = np.stack([flux, scale]), len(fluid.p)
        own, other = (sum_by(links.near.at, rows, n), sum_by(links.far.at, links.exchange.send(rows.T).T, n))
        return Leaving(own[0] - other[0], own[1] + other[1])

    def coupling(self, at: Conduction, fluid: Fluid, unknowns: Unknowns) -> PETSc.Mat:
        """Return the derivative of the outflow with respect to the pressures of both sides."""
        links, *_, slopes = self._flows(at, fluid)
        return between_cells(unknowns, self._grid, links.pairs, slopes)

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
        links, flows, *_ = self._flows(at, fluid)
        pairs = self._contact.pairs
        sums = sum_by(pairs.number[links.closed], pairs.sign[links.closed] * flows, len(self._every))
        sums = over_all(self._grid.comm, sums)
        return {name: np.array(sums[self._every.index(name)]) for name in self._names}
