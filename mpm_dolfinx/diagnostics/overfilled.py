# SPDX-License-Identifier: MIT
"""Cells that hold more than they have room for: bodies overlap, or domains that folded lie on their neighbours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn

FULL = 1.2
"""Of a cell: domains that have not folded stay below 1.08 where soil is pushed aside by half a footing's width."""


def warn_overfilled(cut: CutDomains, bodies: Sequence[Body]) -> Callable[..., Any] | None:
    """Warn of the fullest cell, with the bodies in it, if it is overfilled; return what looks for the next."""
    grid, points = cut.grid, cut.points
    volume = cut.to_cells(points.volume0 * points.J) * cut.pieces_to_cells(cut.pieces.fraction)
    fill = sum_by(cut.cells, cut.plane(volume)[0], grid.num_owned) / grid.cell_volume
    most = over_all(grid.comm, float(fill.max(initial=0.0)), MPI.MAX)
    if not cut.domains or most <= FULL:
        return warn_overfilled
    number = over_all(grid.comm, int(grid.cell_number[fill.argmax()]) if most in fill else -1, MPI.MAX)
    found, x = bodies_in(cut, bodies, number)
    who = f"bodies {', '.join(map(str, found))}" if len(found) > 1 else f"domains of body {found[0]}"
    warn(
        grid.comm,
        ResolutionWarning,
        "the cell at %s is filled to %.0f %%, more than it holds: %s overlap",
        x,
        100 * most,
        who,
    )
    return None


def bodies_in(cut: CutDomains, bodies: Sequence[Body], cell: int) -> tuple[list[int], NDArray[np.float64]]:
    """Return the bodies in a lexicographic cell, and its midpoint (d,), m; on all processes together."""
    grid, ids = cut.grid, cut.points.id[cut.pieces.point[cut.pieces.cell == cell]]
    own = np.searchsorted(np.cumsum([len(body) for body in bodies]), ids, side="right")
    found = sorted({int(i) for rows in grid.comm.allgather(own) for i in rows})
    return found, grid.lower + (np.array(np.unravel_index(cell % grid.cells, grid.shape)) + 0.5) * grid.h
