# SPDX-License-Identifier: MIT
"""Layers of different stiffness within a cell, which share its strain: the soft one gives too little."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.diagnostics.overfilled import bodies_in
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.parallel.messages import ResolutionWarning, warn

LOST = 0.03
"""Share of what a soft material gives, lost in cells that it shares, from which a scene is warned of."""
AGAIN = 2.0
"""Times the share that was named, from which it is named again: interfaces move on to the middle of cells."""
FINE = 0.1
"""Of what a soft cell gives: what may be lost in a cell; contrasts below 2.1 stay below."""


def warn_smeared(
    cut: CutDomains, bodies: Sequence[Body], materials: SceneMaterials, least: float = LOST
) -> Callable[..., Any]:
    """Warn of the soft material that loses most in cells shared with stiffer ones, if that is much.

    Parameters
    ----------
    least
        Share of what the material gives from which it is named, in [0, 1].

    Returns
    -------
    callable
        What looks for it the next time.
    """
    grid = cut.grid
    points = cut.points
    count = len(materials.materials)
    volume = cut.to_cells(points.volume0 * points.J) * cut.pieces_to_cells(cut.pieces.fraction)
    whole = over_all(grid.comm, sum_by(cut.to_cells(points.material), volume, count))
    found = []
    for modulus in (lambda m: m.oedometric, lambda m: m.shear):
        lost, contrast, softest = _lost(cut, volume, cut.to_cells(materials.table(points, modulus)))
        of = cut.to_cells(points.material)[softest]
        each = over_all(grid.comm, sum_by(of, lost, count))
        share = np.divide(each, whole, out=np.zeros(count), where=whole > 0)
        i = int(share.argmax())
        found.append((share[i], i, np.where(of == i, lost, 0.0), contrast))
    share, i, lost, contrast = max(found, key=lambda row: row[0])
    if share <= least:
        return partial(warn_smeared, materials=materials, least=least)
    most = over_all(grid.comm, float(lost.max(initial=0.0)), MPI.MAX)
    at = np.flatnonzero(lost == most)[:1]
    cell = over_all(grid.comm, int(grid.cell_number[at].max(initial=-1)), MPI.MAX)
    much = over_all(grid.comm, float(contrast[at].max(initial=0.0)), MPI.MAX)
    those, x = bodies_in(cut, bodies, cell)
    what = "materials of bodies %s share cells, as at %s: material %d, up to %.3g times as soft as its neighbour, "
    what += "gives about %.0f %% too little under a load across the layers; lay interfaces along grid lines, or take "
    what += "smaller cells"
    warn(grid.comm, ResolutionWarning, what, " and ".join(map(str, those)), x, i, much, 100 * share)
    return partial(warn_smeared, materials=materials, least=AGAIN * share)


def _lost(cut: CutDomains, volume: NDArray[np.float64], modulus: NDArray[np.float64]) -> tuple[NDArray, ...]:
    """Return what owned cells lose (n,), m^d of the softest piece in it, their contrasts (n,), and that piece (n,).

    With moduli M and shares s of a cell, layers one upon the other give sum s/M, and with the cell's strain in all of
    them 1 / sum s M.  The difference, over the 1/M of the softest, is lost: at most (1 - sqrt(r))^2 of the cell with
    two moduli, r < 1 their ratio.
    """
    n, order = cut.grid.num_owned, np.argsort(-modulus, kind="stable")
    softest, hardest = (np.zeros(n, dtype=np.int64) for _ in range(2))
    softest[cut.cells[order]], hardest[cut.cells[order[::-1]]] = order, order[::-1]  # the last one stays
    held, stiffness, compliance = (sum_by(cut.cells, volume * y, n) for y in (1.0, modulus, 1 / modulus))
    lost = np.zeros(n)
    contrast = np.ones(n)
    at = np.flatnonzero(held > 0)
    lost[at] = modulus[softest[at]] * (compliance[at] - held[at] ** 2 / stiffness[at])
    contrast[at] = modulus[hardest[at]] / modulus[softest[at]]
    return np.where(lost > FINE * held, lost, 0.0), contrast, softest
