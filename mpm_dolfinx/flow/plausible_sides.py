# SPDX-License-Identifier: MIT
"""Warnings of implausible rain and pressures on the sides of bodies."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.flow.feeding import Beginning
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.parallel.messages import ConditionWarning, warn

HEAVIEST = 31.2e-3 / 60
"""Largest measured rain, in m/s.  Source: World Meteorological Organization: 31.2 mm in a minute, Unionville 1956."""


class Plausible:
    """Checks of the values of rain and of drained sides.  All processes call the methods.

    `heavy`: names of conditions with a warning of `flux`, which is not repeated in a stage.
    """

    def __init__(self, materials: SceneMaterials):
        self._materials, self._comm = materials, materials.grid.comm
        most = max(np.inf if callable(m.conductivity) else np.max(m.conductivity) for m in materials.materials)
        self._most = max(HEAVIEST, 1000 * most)
        self.heavy: set[str] = set()

    def flux(self, name: str, values: NDArray[np.float64] | float) -> None:
        """Warn if a flux into a side, in m/s, is above any rain.  `values`: fluxes on this process."""
        most = self._comm.allreduce(float(np.max(values, initial=0.0)), op=MPI.MAX)
        if most > self._most:
            what = "%s: flux = %.3g m/s, above any rain, and above 1000 times the conductivity; 1 mm/day is 1.16e-8 m/s"
            warn(self._comm, ConditionWarning, what, name, most)
            self.heavy.add(name)

    def rain(self, name: str, ids: NDArray[np.int64], begins: Beginning) -> None:
        """Warn of rain that the soil at its side cannot take up.  `ids`: identifiers of the points at this side."""
        materials, points = self._materials, begins.points
        conductivity = materials.table(points, attrgetter("conductivity"))[points.find(ids)[1]]
        if self._comm.allreduce(float(conductivity.max(initial=-np.inf)), op=MPI.MAX) == 0:
            what = "%s: the soil at this side has conductivity 0, so all rain runs off; give a conductivity"
            warn(self._comm, ConditionWarning, what, name)
        full = materials.retentions is None and not materials.drains
        if full and self._comm.allreduce(float(points.pressure.min(initial=0.0)), op=MPI.MIN) < 0:
            what = "%s: the soil has suction, but no retention curve, so its full pores store no rain; give a retention"
            warn(self._comm, ConditionWarning, what, name)

    def pressure(self, name: str, value: Any, x: NDArray[np.float64], begins: Beginning) -> None:
        """Warn of a uniform pressure, in Pa, on a side that is higher than a cell.  Zero pressure is plausible.

        `x` (..., d), in m: corners of the faces of this side.
        """
        if begins.gravity is None or callable(value) or not value:
            return
        drop = float(np.ptp(x @ begins.gravity))
        if drop > self._materials.grid.least * np.linalg.norm(begins.gravity):
            what = "%s: pressure = %.4g Pa is uniform, but pressures of water at rest differ by %.4g Pa on this side; "
            more = "for a water table give mpm.hydrostatic(level) as pressure, or *mpm.water(side, level)"
            warn(self._comm, ConditionWarning, what + more, name, value, self._materials.fluid.density * drop)
