# SPDX-License-Identifier: MIT
"""Interface of the conditions on the pore fluid: drained sides, inflows, rain, sources.

In each stage, the method `feeding(setting)` of a condition creates a `Feeding`.  `Feeding.placed` returns the `Feeds`
of a substep.  `Feeds.leaving` returns the outflow from the cells.  `conditions/acting.py` defines the same interface
for the momentum balance.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.fluxes import CellContents, Conduction, OpenSides
from mpm_dolfinx.forms.point_forms import PointData
from mpm_dolfinx.points.material_points import MaterialPoints


class Wet(NamedTuple):
    """Data of a substep for the conditions on the fluid."""

    cut: CutDomains  # particle domains cut by the grid
    points: MaterialPoints  # material points at their current positions
    contents: CellContents  # material in the cells
    t: float  # end of the substep, s
    pieces: PointData | None = None  # quadrature points; None if only open sides are needed
    drains: bool = False  # whether pores drain under suction
    dt: float = np.inf  # length of the step, s
    # results of the conditions in the previous step
    outcome: Mapping[str, Mapping[str, NDArray[np.float64]]] = MappingProxyType({})
    loads: Sequence[Any] = ()  # loads in the balance of momentum; empty if only open sides are needed
    at: Any = None  # present displacements, see `acting.At`


class Beginning(NamedTuple):
    """Data for the checks of conditions at the start of a stage."""

    points: MaterialPoints  # material points at their current positions
    names: Collection[str]  # names of the conditions that begin
    gravity: NDArray[np.float64] | None  # acceleration of gravity (d,), m/s^2; None without gravity


class Fluid(NamedTuple):
    """Fluid in the n active owned cells."""

    p: NDArray[np.float64]  # pressure (n,), Pa
    pi: NDArray[np.float64]  # mass potential (n,), Pa, see `fluid_content`
    density: NDArray[np.float64]  # density divided by the density at zero pressure (n,)
    # function that returns the inertia forces (k, d), N/m^3, on the fluid in k of the n cells, or None
    force: Callable[[NDArray[np.int64]], NDArray[np.float64]] | None = None


class Leaving(NamedTuple):
    """Outflow (m^d/s) from the n active owned cells due to a condition."""

    cells: NDArray[np.float64]  # outflow (n,)
    turnover: NDArray[np.float64] | float = 0.0  # sum of absolute flows, the scale of rounding errors
    gain: NDArray[np.float64] | float = 0.0  # absolute value of sources, for the scale of errors of the fluid balance


class Feeds:
    """Flow rates of the conditions of one kind in a substep.  Subclasses define `leaving`.

    Arrays have one entry for each of the n active owned cells.  The argument `at` is the result of `conducting`.
    """

    linear: bool = True
    """Whether the outflow is always linear in the mass potentials pi (see `fluid_content`)."""
    settles: bool = False
    """Whether the condition has an active set, which `settle` updates."""
    sides: OpenSides | None = None
    """Faces with an outside pressure or a prescribed flux."""

    def conducting(self, flow: Conduction) -> Any:
        """Return the argument `at` of the methods below.  It depends on conductivities and on the motion of cells."""

    def begin(self, at: Any, fluid: Fluid, difference: NDArray[np.float64]) -> None:
        """Start a substep.

        `difference` (m,), Pa: correction of the cell pressures at `sides`, see `nonorthogonal`.
        """

    def leaving(self, at: Any, fluid: Fluid) -> Leaving:
        """Return the outflow from the cells."""
        raise NotImplementedError

    def slope(self, at: Any, fluid: Fluid) -> NDArray[np.float64] | float:
        """Return the derivative (n,) of the outflow with respect to the pressure of the cell, in m^d/(Pa s)."""
        return 0.0

    def by_force(self, at: Any, fluid: Fluid) -> NDArray[np.float64] | float:
        """Return the derivative (n, d), in m^(d+3)/(N s), of the outflow with respect to `fluid.force` in the cell."""
        return 0.0

    def coupling(self, at: Any, fluid: Fluid, unknowns: Any) -> PETSc.Mat | None:
        """Return a matrix: derivatives of outflows with respect to cell pressures, without `slope`; None if zero."""

    def settle(self, at: Any, fluid: Fluid) -> int:
        """Update the active set, and return the number of changes on this process."""
        return 0

    def outcome(self, at: Any, fluid: Fluid) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return results of the conditions, by quantity and name, such as "outflows": the outflow from the bodies, in
        m^d/s.  All processes must call this method after each substep.
        """
        return {}

    def volumes(
        self, now: Mapping[str, Mapping[str, NDArray[np.float64]]]
    ) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return volumes (m^d) at the end of a step, in addition to `outcome`, by quantity and condition.

        `now`: results of all conditions at the end of the step, including the time integrals `acting.VOLUMES`.
        """
        return {}


def open_sides(feeds: Sequence[Feeds], dim: int) -> OpenSides:
    """Return the open sides of all conditions on the fluid."""
    return OpenSides.joined([one.sides for one in feeds if one.sides is not None], dim)


class Feeding:
    """All conditions of one kind in a stage."""

    conditions: ClassVar[tuple[type, ...]] = ()
    """Classes of conditions of this kind."""
    title: ClassVar[str] = "user-defined conditions"
    """Name of these conditions in the summary of a scene."""
    count: int = 0
    """Number of conditions."""
    varies: bool = False
    """Whether prescribed pressures or fluxes depend on time or position."""
    surfaces: Sequence[Surface] = ()
    """Faces on which the conditions act."""

    def check(self, begins: Beginning) -> None:
        """Warn of implausible conditions at the start of a stage.  All processes call this method."""

    def placed(self, wet: Wet) -> Feeds:
        """Return the flow rates of the conditions in a substep."""
        raise NotImplementedError

    def fed(self, cut: CutDomains, pieces: PointData) -> NDArray[np.int64]:
        """Return the indices of points at which fluid may enter or leave.  Indices may be repeated."""
        return np.empty(0, dtype=np.int64)

    def unknown(self, value: float) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return placeholders for `Feeds.outcome` before the first step: zero for volumes, otherwise `value`."""
        return {}
