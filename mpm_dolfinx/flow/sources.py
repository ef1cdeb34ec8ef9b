# SPDX-License-Identifier: MIT
"""User-defined sources of the pore fluid, see `user_functions` and `conditions.Source`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import line
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.flow.feeding import Feeding, Feeds, Fluid, Leaving, Wet
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.materials.user_functions import compiling, form


class Sources(Feeding):
    """All sources of a scene, for all stages.

    `sources`: user functions that return UFL terms.
    `pieces`: quadrature points of all pieces.
    `p`, `p_n`: present pore pressure of the cells (DG0), and pressure at the start of the step, Pa.
    `t`, s: time at the end of the substep, a UFL constant.
    """

    title = "sources"

    def __init__(
        self, sources: Sequence[Callable], pieces: FormPoints, p: fem.Function, p_n: fem.Function, t: fem.Constant
    ):
        Q = p.function_space
        q, one = ufl.TestFunction(Q), fem.Function(Q)
        one.x.array[:] = 1.0
        self._work = fem.Function(Q)
        self.count = len(sources)
        self._forms, self._slopes = [], []
        for source in sources:
            gain = form("sources", source, points=pieces, q=q, p=p, p_n=p_n, t=t)
            if len(gain.arguments()) != 1:
                raise ValueError(f"sources: {line(source)} does not depend on q, must be linear in q")
            if p in gain.coefficients():
                self._slopes.append(PointForm(ufl.derivative(gain, p, one), pieces))
            with compiling(f"sources: {line(source)}", "linear in q"):
                self._forms.append(PointForm(gain, pieces))
        self.linear = not self._slopes

    def gain(self, pieces: PointData) -> NDArray[np.float64]:
        """Return the inflow (m^d/s) into each filled cell, as an array over local cells."""
        return self._sum(self._forms, pieces)

    def slope(self, pieces: PointData) -> NDArray[np.float64]:
        """Return the derivative (m^d/(Pa s)) of `gain` with respect to cell pressures, as an array over local cells."""
        return self._sum(self._slopes, pieces)

    def _sum(self, forms: Sequence[PointForm], pieces: PointData) -> NDArray[np.float64]:
        b = self._work.x.array
        b[pieces.places.filled] = 0.0
        for one in forms:
            one.assemble_vector(b, pieces)
        return b

    def placed(self, wet: Wet) -> Feeds:
        """Return the inflow from the sources in a substep."""
        return SourceFeeds(self, wet)

    def fed(self, cut: CutDomains, pieces: PointData) -> NDArray[np.int64]:
        """Return the indices of points with pieces in cells that contain a source. Indices may be repeated."""
        return cut.pieces.point[cut.to_pieces(self.gain(pieces)[cut.cells] != 0)]


class SourceFeeds(Feeds):
    """Inflow from the sources in a substep."""

    def __init__(self, sources: Sources, wet: Wet):
        self._sources = sources
        self._pieces, self._cells = wet.pieces, wet.contents.filled
        self.linear = sources.linear

    def leaving(self, at: None, fluid: Fluid) -> Leaving:
        """Return the inflow into the cells, as a negative outflow."""
        gain = self._sources.gain(self._pieces)[self._cells]
        return Leaving(-gain, gain=np.abs(gain))

    def slope(self, at: None, fluid: Fluid) -> NDArray[np.float64]:
        """Return minus the derivative of the inflow with respect to the pressure of the cell."""
        return -self._sources.slope(self._pieces)[self._cells]
