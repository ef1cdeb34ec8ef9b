# SPDX-License-Identifier: MIT
"""Flow of pore fluid through the closed parts of contacts between groups.

A pair consists of two opposite positions on the surfaces in contact (`pairs`).  While the gap of a pair is closed,
fluid flows between the two cells that contain these positions.  The flow is a two-point flux, as between neighbouring
cells (`flow/fluxes.py`), so the pressure is continuous across the contact:

    Q = r [p_1 - p_2 + rho_w g . (x_2 - x_1)] / (d_1 / (A kappa_1) + d_2 / (A kappa_2)).

A is the contact area of the pair, and kappa is the mobility in a cell, in the direction normal to the surface.  The
distance d is measured from the centroid x of the material in a cell to the surface.  The factor r is the density of the
fluid, divided by its reference density.  The set of closed pairs is updated between Newton steps, at most `ROUNDS`
times in a substep.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.contact.law import ROUNDS
from mpm_dolfinx.contact.problem import ContactProblem
from mpm_dolfinx.flow.feeding import Feeding, Feeds, Fluid, Leaving, Wet
from mpm_dolfinx.flow.fluxes import Conduction, HalfFaces, OpenSides
from mpm_dolfinx.flow.series import none, through
from mpm_dolfinx.parallel.exchange import Exchange, over_all


class ConductingContacts(Feeding):
    """The contacts that conduct pore fluid in a stage.  `conducts`: for each contact name, whether it conducts."""

    title = "contacts that conduct"
    varies = True  # because the set of closed pairs changes

    def __init__(self, conducts: Mapping[str, bool]):
        self._conducts = conducts
        self.count = sum(conducts.values())

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return placeholders for the flows before the first step: `value` for each contact that conducts."""
        return {"outflows": {name: np.array(value) for name, conducts in self._conducts.items() if conducts}}

    def placed(self, wet: Wet) -> Feeds:
        """Return the flow through the contacts in a substep."""
        loads = [one for one in wet.loads if one.conducts]
        return ContactFeeds(loads[0], wet, self._conducts) if loads else Feeds()


class Links(NamedTuple):
    """The closed pairs on this process."""

    law: Any  # contact law of the pairs
    closed: NDArray[np.bool_]  # whether each pair of the law is closed (m,)
    changes: int  # number of changes of the closed pairs in the substep
    exchange: Exchange  # sends pairs to the owners of their opposite cells
    near: HalfFaces  # cells of the points
    far: HalfFaces  # opposite cells on this process


class Flows(NamedTuple):
    """Flows through the k closed pairs of `links`."""

    links: Links
    flux: NDArray[np.float64]  # flow from the cell of the point to the opposite cell (k,), m^d/s
    scale: NDArray[np.float64]  # scale of the rounding error of the flow (k,), m^d/s
    slopes: NDArray[np.float64]  # derivatives of the flow, see `between_cells` (2, k), m^d/(Pa s)


class ContactFeeds(Feeds):
    """Flow through closed contacts in a substep.

    `contact`: contact loads between groups.
    `wet`: quantities of the fluid balance in the substep.
    `conducts`: for each contact name, whether the contact conducts fluid.
    """

    settles = True

    def __init__(self, contact: ContactProblem, wet: Wet, conducts: Mapping[str, bool]):
        self._contact = contact
        self._wet = wet
        self._conducts = conducts
        self._grid = wet.contents.grid
        self._links = links = self._linked(0)
        self.sides = OpenSides.joined([links.near.side, links.far.side], self._grid.dim)
        self._correction = np.zeros(0, dtype=np.int64), np.zeros(0)

    def _linked(self, changes: int) -> Links:
        """Return the pairs that are closed at the present displacements, and the cells on both sides."""
        contents, pairs = self._wet.contents, self._contact.pairs
        closed = self._contact.closed(self._wet.at)
        other, area = pairs.other[closed], pairs.outward[closed]
        exchange = Exchange(self._grid.comm, self._grid.owner(other))
        y, opposite = np.split(exchange.send(np.hstack([pairs.y[closed], -area])), 2, axis=1)
        near = HalfFaces(contents, pairs.cell[closed], pairs.x[closed], area)
        far = HalfFaces(contents, self._grid.locals[exchange.send(other)], y, opposite)
        return Links(self._contact.now.law, closed, changes, exchange, near, far)

    @property
    def _now(self) -> Links:
        """The closed pairs, determined again if the contact law has new pairs."""
        if self._contact.now.law is not self._links.law:
            self._links = self._linked(self._links.changes)
        return self._links

    def conducting(self, flow: Conduction) -> Conduction:
        """Return `flow` unchanged."""
        return flow

    def begin(self, at: Conduction, fluid: Fluid, difference: NDArray[np.float64]) -> None:
        """Store the non-orthogonal correction of the pressure difference at each closed pair."""
        links = self._links
        near, far = np.split(difference, [len(links.near.at)])  # in the order of `sides`
        self._correction = self._contact.pairs.place[links.closed], near - links.exchange.back(far)

    def _flows(self, flow: Conduction, fluid: Fluid) -> Flows:
        """Return the flows through the closed pairs."""
        links, d = self._now, self._grid.dim
        sides = links.near.rows(flow, fluid.p, fluid.force), links.far.rows(flow, fluid.p, fluid.force)
        (p, x, force, ahead, own), (other, y, beyond, _, opposite) = (
            np.split(rows, np.cumsum([1, d, d, 1]), axis=1) for rows in (sides[0], links.exchange.back(sides[1]))
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
        difference = p - other + drop
        places, correction = self._correction
        _, row, column = np.intersect1d(self._contact.pairs.place[links.closed], places, return_indices=True)
        difference[row] += correction[column]
        conductance = flow.density(p, other) * conductance
        return Flows(links, conductance * difference, conductance * (np.abs(p) + np.abs(other)), np.stack(slopes))

    def leaving(self, at: Conduction, fluid: Fluid) -> Leaving:
        """Return the flow from each cell to cells of other groups."""
        links, flux, scale, _ = self._flows(at, fluid)
        rows = np.stack([flux, scale])
        own, other = links.near.total(rows), links.far.total(links.exchange.send(rows.T).T)
        return Leaving(own[0] - other[0], own[1] + other[1])

    def coupling(self, at: Conduction, fluid: Fluid, unknowns: Any) -> PETSc.Mat:
        """Return the derivative of `leaving` with respect to the cell pressures."""
        links, *_, slopes = self._flows(at, fluid)
        return self._contact.pairs.conducting(unknowns, links.closed, slopes)

    def settle(self, at: Conduction, fluid: Fluid) -> int:
        """Update the set of closed pairs.  Return how many pairs of this process have opened or closed."""
        links = self._now
        changes = int((self._contact.closed(self._wet.at) != links.closed).sum())
        if links.changes == ROUNDS or not over_all(self._grid.comm, changes):
            return 0
        self._links = self._linked(links.changes + 1)
        return changes

    def outcome(self, at: Conduction, fluid: Fluid) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the flows, in m^d/s, from the bodies `one` to the bodies `other` of each contact."""
        links, flux, *_ = self._flows(at, fluid)
        pairs = self._contact.pairs
        number, sign = pairs.number[links.closed], pairs.sign[links.closed]
        sums = over_all(self._grid.comm, np.bincount(number, sign * flux, len(self._conducts)))
        both = zip(self._conducts.items(), sums, strict=True)
        return {"outflows": {name: np.array(flow) for (name, conducts), flow in both if conducts}}
