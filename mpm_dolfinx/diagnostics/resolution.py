# SPDX-License-Identifier: MIT
"""Warnings about coarse resolution: overlapping domains, cells with contrasts of stiffness, and thin bodies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.touching import Faces, covered, covers
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.grid.grid import SIDES, Grid, in_chunks, sum_by
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn
from mpm_dolfinx.points.material_points import body_of

FULL = 1.2
"""Filled fraction of a cell above which a warning is given.  Undistorted domains below a deep footing reach 1.08."""


RENEWS = "; Numerics(renewal=True) replaces distorted domains"


def warn_overlaps(
    cut: CutDomains, bodies: Sequence[Body], evolves: bool, renewable: bool = False
) -> Callable[..., Any] | None:
    """Warn about the fullest cell if domains overlap.  Return this function for the next check, or None if warned.

    `evolves`: whether soil yields.  Only then domains may be partly inverted.  Their other parts are larger than the
    domains, and overlap.
    `renewable`: whether the warning names the renewal of domains.
    """
    grid, points = cut.grid, cut.points
    if not cut.domains:
        return None
    volume = cut.shares(points.volume0 * points.J * (cut.unfolded() if evolves else 1.0))
    fill = sum_by(cut.cells, cut.plane(volume)[0], grid.num_owned)[cut.cells] / grid.volumes(cut.cells)
    most = over_all(grid.comm, float(fill.max(initial=0.0)), MPI.MAX)
    if most <= FULL:
        return partial(warn_overlaps, evolves=evolves, renewable=renewable)
    number = over_all(grid.comm, int(grid.cell_number[cut.cells[fill.argmax()]]) if most in fill else -1, MPI.MAX)
    found, x = bodies_in(cut, bodies, number)
    bodies_text = f"bodies {', '.join(map(str, found))}" if len(found) > 1 else f"domains of body {found[0]}"
    warn(
        grid.comm,
        ResolutionWarning,
        "the cell at %s is filled to %.0f %%, more than it can hold: %s overlap, or are partly inverted%s",
        x,
        100 * most,
        bodies_text,
        RENEWS * renewable,
    )
    return None


def bodies_in(cut: CutDomains, bodies: Sequence[Body], cell: int) -> tuple[list[int], NDArray[np.float64]]:
    """Return the bodies in a cell, and the cell's midpoint (d,), in m.  All processes must call this function."""
    grid, ids = cut.grid, cut.points.id[cut.pieces.point[cut.pieces.cell == cell]]
    own = body_of(ids, np.cumsum([0, *map(len, bodies)]))
    found = sorted({int(i) for rows in grid.comm.allgather(own) for i in rows})
    return found, grid.base + grid.places(np.array(np.unravel_index(cell % grid.cells, grid.shape)), 0.5)


LOSS = 0.03
"""A warning is given if a soft material loses this fraction of its deformation in cells with stiffer materials."""
AGAIN = 2.0
"""Factor by which the lost fraction must grow, as interfaces move through cells, before the next warning."""
FINE = 0.1
"""Lost fraction in one cell below which the loss is ignored.  Stiffness ratios below 2.1 never cause this loss."""


def warn_mixed(
    cut: CutDomains, bodies: Sequence[Body], materials: SceneMaterials, least: float = LOSS
) -> Callable[..., Any]:
    """Warn about the soft material whose deformation is reduced most in cells with stiffer materials.

    `least`: lost fraction of the deformation, in [0, 1], above which the function warns.

    Returns
    -------
    callable
        Function for the next check.  If this call has warned, the threshold `least` of the next check is larger.
    """
    grid = cut.grid
    points = cut.points
    count = len(materials.materials)
    volume = cut.shares(points.volume0 * points.J)
    whole = over_all(grid.comm, sum_by(cut.to_cells(points.material), volume, count))
    found = []
    for modulus in (lambda m: m.oedometric, lambda m: m.shear):
        loss, contrast, softest = _losses(cut, volume, cut.to_cells(materials.table(points, modulus)))
        of = cut.to_cells(points.material)[softest]
        each = over_all(grid.comm, sum_by(of, loss, count))
        share = np.divide(each, whole, out=np.zeros(count), where=whole > 0)
        i = int(share.argmax())
        found.append((share[i], i, np.where(of == i, loss, 0.0), contrast))
    share, i, loss, contrast = max(found, key=lambda row: row[0])
    if share <= least:
        return partial(warn_mixed, materials=materials, least=least)
    most = over_all(grid.comm, float(loss.max(initial=0.0)), MPI.MAX)
    at = np.flatnonzero(loss == most)[:1]
    cell = over_all(grid.comm, int(grid.cell_number[at].max(initial=-1)), MPI.MAX)
    contrast_most = over_all(grid.comm, float(contrast[at].max(initial=0.0)), MPI.MAX)
    those, x = bodies_in(cut, bodies, cell)
    what = "materials of bodies %s share cells, as at %s: material %d, up to %.3g times as soft as its neighbour, "
    what += "deforms about %.0f %% too little under a load across the layers; place interfaces on grid lines, or use "
    what += "smaller cells"
    warn(grid.comm, ResolutionWarning, what, " and ".join(map(str, those)), x, i, contrast_most, 100 * share)
    return partial(warn_mixed, materials=materials, least=AGAIN * share)


def _losses(cut: CutDomains, volume: NDArray[np.float64], modulus: NDArray[np.float64]) -> tuple[NDArray, ...]:
    """For each owned cell, return the loss times the volume (m^d), the ratio of moduli, and the softest piece.

    Let M be the moduli and s the volume fractions in a cell.  Layers in series have the compliance `sum (s / M)`, but
    equal strain in the cell gives the compliance `1 / sum (s M)`.  The loss is the difference of both compliances,
    divided by the largest `1 / M`.  If two moduli have the ratio r < 1, the loss is at most `(1 - sqrt(r))^2`.
    """
    n, order = cut.grid.num_owned, np.argsort(-modulus, kind="stable")
    softest, hardest = (np.zeros(n, dtype=np.int64) for _ in range(2))
    softest[cut.cells[order]], hardest[cut.cells[order[::-1]]] = order, order[::-1]  # the last index of a cell remains
    total, stiffness, compliance = (sum_by(cut.cells, volume * y, n) for y in (1.0, modulus, 1 / modulus))
    loss = np.zeros(n)
    contrast = np.ones(n)
    at = np.flatnonzero(total > 0)
    loss[at] = modulus[softest[at]] * (compliance[at] - total[at] ** 2 / stiffness[at])
    contrast[at] = modulus[hardest[at]] / modulus[softest[at]]
    return np.where(loss > FINE * total, loss, 0.0), contrast, softest


COARSE = 0.7  # domain size in cells, above which constant stress lowers the stiffness more than Q1 bending raises it
FEW = 3  # points over the thickness at which the deflection is an eighth too large.  Source: exact, 1 / (n^2 - 1)
SLENDER = 4  # length divided by thickness from which on a body counts as a beam
LOST_WET = 2.5  # lost fraction of a wet beam's stiffness, times n^2; undrained: 1.8 (n = 4), 2.3 (n = 8), 3.2 (n = 16)
FEW_WET = int((100 * LOST_WET) ** 0.5)  # points over the thickness at which the loss is 1 %.  Source: exact
SLENDER_WET = 2  # length divided by thickness from which on a wet body counts as a beam


def warn_thin(grid: Grid, bodies: Sequence[Body], walls: Mapping[str, str], wet: bool) -> None:
    """Warn about each slender body that can bend, and has one point per cell and too few points over its thickness.

    The stress increment of a step is constant in a cut domain.  In a single step, n points over the thickness therefore
    give `1 - 1/n^2` of the bending stiffness.  In several steps the fraction is larger (`domain_slopes`).  A body with
    one point over its thickness carries no moment.  Such a body creeps from step to step, because only the stress
    increments resist bending.  Saturated bodies (`wet`) lose more stiffness, and creep even with several points.
    """
    few, slender = (FEW_WET, SLENDER_WET) if wet else (FEW, SLENDER)
    for i, body in enumerate(bodies):
        for axis, letter in enumerate("xyz"[: grid.dim]):
            n, spacing = body.across(axis)
            h = _edge(grid, body, axis)
            if spacing > COARSE * h and n <= few and _bends(grid, bodies, i, axis, walls, slender):
                consequence = "it carries no moment and creeps"
                if n > 1:
                    consequence = f"it bends up to {1 / (n**2 - 1):.0%} too much"
                if n > 1 and wet:
                    consequence = f"with pore fluid it bends about {LOST_WET / n**2:.0%} too much and creeps"
                what = "body %d: %.3g point%s over its thickness along %s, in cells of %.3g m: %s; take per_cell >= 2"
                warn(grid.comm, ResolutionWarning, what, i, n, "s" if n > 1 else "", letter, h, consequence)


def check_stiff(grid: Grid, bodies: Sequence[Body]) -> None:
    """Raise ValueError for 3D bodies with one domain in each cell, if domains end at grid lines along two axes.

    Displacements that alternate from node to node along both axes then have zero mean gradients in all pieces, and no
    stiffness.  Along the third axis, these displacements may vary in any way.  In 2D each component has a single
    displacement field of this kind, and walls prevent it.
    """
    for i, body in enumerate(bodies if grid.dim == 3 else ()):
        low, between = np.array([[np.inf], [-np.inf]]) * np.ones(grid.dim)  # lower ends: lowest; highest off grid lines
        cells = []
        for part in in_chunks(len(body)):
            x = body.corners(part) - grid.base
            lower = grid.in_cells(x.min(axis=1))
            cells.append(grid.number(grid.index_from_base(x.mean(axis=1))))
            low = np.minimum(low, lower.min(axis=0))
            inside = np.where(np.abs(lower - lower.round()) > NEAR, lower, -np.inf)
            between = np.maximum(between, inside.max(axis=0))
            if (between > low + NEAR).sum() > 1:
                break
        else:
            if len(np.unique(np.concatenate(cells))) == len(body):
                axes = np.array(list("xyz"))[between <= low + NEAR]
                what = "one domain in each cell, in line with cells along %s and %s, must be more: some displacements "
                what += "would have no stiffness; take per_cell >= 2"
                raise ValueError(f"body {i}: " + what % tuple(axes[:2]))


def _edge(grid: Grid, body: Body, axis: int) -> float:
    """Return the mean edge length (m), along an axis, of the grid cells that contain the body."""
    low, high = body.bounds
    return float(((high - low) / np.ptp(grid.in_cells(np.stack([low, high]) - grid.base), axis=0))[axis])


def _bends(grid: Grid, bodies: Sequence[Body], i: int, axis: int, walls: Mapping[str, str], slender: float) -> bool:
    """Return whether a body is thin along an axis, and neither walls nor other bodies prevent such bending."""
    body = bodies[i]
    size = body.bounds[1] - body.bounds[0]
    if size.max() < slender * size[axis]:
        return False
    for name in (name for name, (a, _) in SIDES[grid.dim].items() if a == axis):
        end = SIDES[grid.dim][name][1]
        wall = (grid.lower, grid.upper)[end][axis]
        if "xyz"[axis] in walls.get(name, "") and np.abs(body.bounds[end][axis] - wall) < SAME * grid.finest[axis]:
            return False
        own = Faces.of(body, *body.facing(axis, end))
        others = (Faces.around(other) for other in bodies if other is not body)
        if sum(covered(len(own.row), covers(own, other)).sum() for other in others) > len(own.row) / 2:
            return False
    return True
