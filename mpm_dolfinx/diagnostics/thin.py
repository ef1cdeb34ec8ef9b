# SPDX-License-Identifier: MIT
"""Bodies that are seeded with too few points over their thickness to bend as they should."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.touching import Faces, covered, covers
from mpm_dolfinx.grid.grid import SIDES, Grid
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn

COARSE = 0.7  # of a cell: domains above this lack more stiffness than Q1 cells have too much
FEW = 3  # points over the thickness that bend an eighth too much.  Source: exact, 1 / (n^2 - 1)
SLENDER = 4  # length over thickness from which a body bends
LOST_WET = 3.0  # share that wet ones lose, times n^2: beams sealed or open at their end, n = 4 to 32, within a third
FEW_WET = int((100 * LOST_WET) ** 0.5)  # up to which they lose 1 %.  Source: exact, by LOST_WET
SLENDER_WET = 2  # length over thickness from which a wet body bends


def warn_thin(grid: Grid, bodies: Sequence[Body], walls: Mapping[str, str], wet: bool) -> None:
    """Warn for each slender body that is free to bend and has too few points over its thickness.

    A law sees one F in a point's domain: n points over the thickness have 1 - 1/n^2 of the bending stiffness, as
    n layers of constant stress do, however exactly their domains are integrated.  One point carries no moment at
    all: what resists is each step's increment only, and the body creeps from step to step.  With pore fluid (wet)
    more is lost, by measurement, and the body goes on creeping.
    """
    few, slender = (FEW_WET, SLENDER_WET) if wet else (FEW, SLENDER)
    for i, body in enumerate(bodies):
        for axis, letter in enumerate("xyz"[: grid.dim]):
            n, spacing = body.across(axis)
            if spacing > COARSE * grid.h[axis] and n <= few and _bends(grid, bodies, i, axis, walls, slender):
                much = "it carries no moment and creeps"
                if n > 1:
                    much = f"it bends {1 / (n**2 - 1):.0%} too much"
                if n > 1 and wet:
                    much = f"with pore fluid it bends some {LOST_WET / n**2:.0%} too much and creeps"
                what = "body %d: %.3g point%s over its thickness along %s, in cells of %.3g m: %s; take per_cell >= 2"
                warn(grid.comm, ResolutionWarning, what, i, n, "s" if n > 1 else "", letter, grid.h[axis], much)


def _bends(grid: Grid, bodies: Sequence[Body], i: int, axis: int, walls: Mapping[str, str], slender: float) -> bool:
    """Whether a body is slender across an axis, and neither a wall nor another body holds it from that side."""
    body = bodies[i]
    size = body.bounds[1] - body.bounds[0]
    if size.max() < slender * size[axis]:
        return False
    for name in (name for name, (a, _) in SIDES[grid.dim].items() if a == axis):
        end = SIDES[grid.dim][name][1]
        wall = (grid.lower, grid.upper)[end][axis]
        if "xyz"[axis] in walls.get(name, "") and np.abs(body.bounds[end][axis] - wall) < SAME * grid.h[axis]:
            return False
        own = Faces.of(body, *body.facing(axis, end))
        others = (Faces.around(other) for other in bodies if other is not body)
        if sum(covered(len(own.row), covers(own, other)).sum() for other in others) > len(own.row) / 2:
            return False
    return True
