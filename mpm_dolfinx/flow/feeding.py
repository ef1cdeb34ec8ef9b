# SPDX-License-Identifier: MIT
"""What acts on the storage of the pore fluid: the one protocol of drained sides, inflows, sources.

To add a condition: give it a method `feeding(setting)`, which returns a `Feeding`.  It is placed twice: `Feeding` once
a stage, where it finds its faces; `Feeding.placed` once a substep.  Its `Feeds` add to what leaves the cells as often
as the residual is assembled.  The storage loops over them, and knows none by name.  So does the momentum over its own:
`conditions/acting.py`.
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
    """When and where a condition acts in a substep.

    cut, points: the domains as they are cut, and the points with the places that count; contents: of the cells;
    pieces: points of integration, None where only open sides are asked for; t: end of the substep, s; drains: whether
    pores drain under suction; dt: the step, s; outcome: of the step before.
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
    """The fluid in the active owned cells at present: pressures p and mass potentials pi (n,), Pa; density (n,).

    The latter is that over the density at zero pressure.  force (n, d), N/m^3: of inertia, None without.
    """

    p: NDArray[np.float64]
    pi: NDArray[np.float64]
    density: NDArray[np.float64]
    force: NDArray[np.float64] | None = None


class Leaving(NamedTuple):
    """What leaves the active owned cells (n,), m^d/s; turnover: in size, both ways; gain: what sources bring, in size.

    Rounding is measured by the turnover, the balance by the gain too.
    """

    cells: NDArray[np.float64]
    turnover: NDArray[np.float64] | float = 0.0
    gain: NDArray[np.float64] | float = 0.0


class Feeds:
    """What a condition does to the fluid of the cells in a substep; of what a class does not define it does nothing.

    Arrays are over the n active owned cells.  `at` is what `conducting` has returned for the present displacements.
    """

    linear: bool = True
    """Whether what leaves is linear in the mass potentials, for good."""
    settles: bool = False
    """Whether it has an active set, see `settle`."""
    sides: OpenSides | None = None
    """Faces beyond which it gives a pressure or a flux."""

    def conducting(self, flow: Conduction) -> Any:
        """Return what depends on how the cells conduct and have moved; kept as long as these stay the same."""

    def begin(self, at: Any, fluid: Fluid, beyond: NDArray[np.float64]) -> None:
        """Begin a substep; beyond (m,), Pa: what `sides` see more than the pressure of their cell, see `aslant`."""

    def leaving(self, at: Any, fluid: Fluid) -> Leaving:
        """Return what leaves the cells."""
        raise NotImplementedError

    def slope(self, at: Any, fluid: Fluid) -> NDArray[np.float64] | float:
        """Return the derivative (n,) of what leaves by the cell's pressure, m^d/(Pa s)."""
        return 0.0

    def settle(self, at: Any, fluid: Fluid) -> int:
        """Choose the active set anew; return how much of it, on this process, has changed."""
        return 0

    def outflows(self, at: Any, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return what leaves the bodies by each condition, m^d/s, by name; all processes together."""
        return {}

    def run_off(self, at: Any, fluid: Fluid) -> dict[str, NDArray[np.float64]]:
        """Return what falls on the bodies and does not soak in, m^d/s, by name; all processes together."""
        return {}

    def passing(self, at: Any, fluid: Fluid) -> Mapping[str, NDArray[np.float64]]:
        """Return what `volumes` needs of a substep, by name; all processes together."""
        return {}

    def volumes(
        self, passed: Sequence[Mapping[str, NDArray[np.float64]]], seconds: Sequence[float]
    ) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return volumes since the conditions began, m^d, by quantity and name, after a step.

        passed, seconds: of its substeps, see `passing`, and the times that these count, s.
        """
        return {}


def open_sides(feeds: Sequence[Feeds], dim: int) -> OpenSides:
    """Return the open sides of all that acts on the fluid, with what they give."""
    return OpenSides.joined([one.sides for one in feeds if one.sides is not None], dim)


class Feeding:
    """The conditions of one kind in a stage."""

    conditions: ClassVar[tuple[type, ...]] = ()
    """Classes of conditions of this kind."""
    title: ClassVar[str] = "conditions of the user's own"
    """What they are called where a scene lists what it has."""
    count: int = 0
    """How many there are."""
    varies: bool = False
    """Whether what the sides give changes with time or place."""
    surfaces: Sequence[Surface] = ()
    """Faces on which they act."""

    def placed(self, wet: Wet) -> Feeds:
        """Return what they do in a substep."""
        raise NotImplementedError

    def fed(self, cut: CutDomains, pieces: PointData) -> NDArray[np.int64]:
        """Return points, some maybe often, whose bodies may gain or lose fluid by it."""
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
