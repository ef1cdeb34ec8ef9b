# SPDX-License-Identifier: MIT
"""Protocol of the conditions on the pore fluid: drained sides, inflows, sources.

A new condition needs a method `feeding(setting)` that returns a `Feeding`.  `Feeding` is made once a stage, and finds
its faces.  `Feeding.placed` is called once a substep, and returns `Feeds`.  These add to the outflow of the cells in
each assembly of the residual.  `conditions/acting.py` is the same protocol for the momentum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.fluxes import CellContents, Conduction, OpenSides
from mpm_dolfinx.forms.point_forms import PointData
from mpm_dolfinx.points.material_points import MaterialPoints


class Wet(NamedTuple):
    """Data of a substep for conditions on the fluid.

    cut: cut domains; points: points at present positions; contents: see `CellContents`; pieces: quadrature points, None
    if only open sides are needed; t: end of the substep, s; drains: whether pores drain under suction; dt: length of
    the step, s; outcome: outcome of the last step.
    """

    cut: CutDomains
    points: MaterialPoints
    contents: CellContents
    t: float
    pieces: PointData | None = None
    drains: bool = False
    dt: float = np.inf
    outcome: Mapping[str, Mapping[str, NDArray[np.float64]]] = MappingProxyType({})


class Fluid(NamedTuple):
    """Fluid in the active owned cells: pressures p and mass potentials pi (n,), Pa; relative density (n,).

    The density is relative to its value at zero pressure.  force (n, d): inertia force, N/m^3, or None.
    """

    p: NDArray[np.float64]
    pi: NDArray[np.float64]
    density: NDArray[np.float64]
    force: NDArray[np.float64] | None = None


class Leaving(NamedTuple):
    """Outflow of the active owned cells (n,), m^d/s; turnover: absolute flows; gain: absolute sources.

    The turnover scales rounding errors, the gain scales the balance.
    """

    cells: NDArray[np.float64]
    turnover: NDArray[np.float64] | float = 0.0
    gain: NDArray[np.float64] | float = 0.0


class Feeds:
    """Effect of a condition on the fluid of the cells in a substep; the defaults have no effect.

    Arrays are over the n active owned cells.  `at` is the result of `conducting` for the present displacements.
    """

    linear: bool = True
    """Whether the outflow is always linear in the mass potentials."""
    settles: bool = False
    """Whether it has an active set, see `settle`."""
    sides: OpenSides | None = None
    """Faces with an outer pressure or a flux."""

    def conducting(self, flow: Conduction) -> Any:
        """Return data that depend on conductivities and motion of the cells; cached until these change."""

    def begin(self, at: Any, fluid: Fluid, difference: NDArray[np.float64]) -> None:
        """Begin a substep; difference (m,), Pa: correction of the cell pressure at `sides`, see `nonorthogonal`."""

    def leaving(self, at: Any, fluid: Fluid) -> Leaving:
        """Return the outflow of the cells."""
        raise NotImplementedError

    def slope(self, at: Any, fluid: Fluid) -> NDArray[np.float64] | float:
        """Return the derivative (n,) of the outflow with respect to the cell's pressure, m^d/(Pa s)."""
        return 0.0

    def settle(self, at: Any, fluid: Fluid) -> int:
        """Update the active set; return the number of changes on this process."""
        return 0

    def outflows(self, at: Any, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return the outflow from the bodies by each condition, m^d/s, by name; a collective call."""
        return {}

    def run_off(self, at: Any, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return the rain that does not infiltrate, m^d/s, by name; a collective call."""
        return {}

    def passing(self, at: Any, fluid: Fluid) -> Mapping[str, NDArray[np.float64]]:
        """Return the rates of a substep for `volumes`, by name; a collective call."""
        return {}

    def volumes(
        self, rates: Sequence[Mapping[str, NDArray[np.float64]]], seconds: Sequence[float]
    ) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return volumes since the conditions began, m^d, by quantity and name, after a step.

        rates: rates in its substeps, see `passing`; seconds: time weights of these substeps, s.
        """
        return {}


def open_sides(feeds: Sequence[Feeds], dim: int) -> OpenSides:
    """Return the open sides of all conditions on the fluid."""
    return OpenSides.joined([one.sides for one in feeds if one.sides is not None], dim)


class Feeding:
    """The conditions of one kind in a stage."""

    conditions: ClassVar[tuple[type, ...]] = ()
    """Classes of conditions of this kind."""
    title: ClassVar[str] = "user-defined conditions"
    """Their name in the summary of a scene."""
    count: int = 0
    """Number of conditions."""
    varies: bool = False
    """Whether pressures or fluxes change with time or position."""
    surfaces: Sequence[Surface] = ()
    """Faces on which they act."""

    def placed(self, wet: Wet) -> Feeds:
        """Return the effect of the conditions in a substep."""
        raise NotImplementedError

    def fed(self, cut: CutDomains, pieces: PointData) -> NDArray[np.int64]:
        """Return points, with repetitions, of bodies that may gain or lose fluid."""
        return np.empty(0, dtype=np.int64)

    def unknown(self, value: float) -> dict[str, NDArray[np.float64]]:
        """Return `Feeds.outflows` of this value, before a first step."""
        return {}

    def dry(self, value: float) -> dict[str, NDArray[np.float64]]:
        """Return `Feeds.run_off` of this value, before a first step."""
        return {}

    def empty(self) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return `Feeds.volumes` before a first step."""
        return {}
