# SPDX-License-Identifier: MIT
"""Tractions that replace the reactions of fixed sides when they become quiet sides."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import ROUND_OFF
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.domains.cut_domains import CutDomains
from mpm_dolfinx.grid.grid import sum_by
from mpm_dolfinx.mechanics.tractions import owners
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.parts import Parts


def balancing_tractions(
    cut: CutDomains,
    points: MaterialPoints,
    stresses: Mapping[str, NDArray[np.float64]],
    surfaces: Mapping[str, Surface],
    parts: Parts,
    forces: NDArray[np.float64],
    held: NDArray[np.bool_],
) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return the points of each side of bodies at rest, and the tractions that replace the reactions of this side.

    Tractions are forces per reference area, computed from the stresses.  Additional tractions vary like rigid-body
    displacements.  They give each connected part the same resultant force and moment as its reactions.

    `stresses`: total stresses (faces, k, k), in Pa, with k = d or 3, at the faces of each side.
    `parts`: connected parts of the bodies.
    `forces` (nodes, d), in N: reactions of the sides at the owned nodes of this process, zero at other nodes.
    `held` (nodes, d): whether each displacement component of a node is fixed in the new stage.

    Returns the ids (n,) of the points on each side and their tractions (n, d), in Pa, by name of the side.
    """
    grid, d = cut.grid, cut.grid.dim
    patches = cut.surfaces(list(surfaces.values()))
    area, x = (np.concatenate([getattr(p, name) for p in patches]) for name in ("area0", "x"))
    own = np.concatenate([p.area(points) for p in patches])
    stress = np.concatenate([of[p.face, :d, :d] for of, p in zip(stresses.values(), patches, strict=True)])
    t = np.einsum("nij,nj->ni", stress, own) / area[:, None]
    exchange, places = owners(grid, patches)
    part, nodes = exchange.back(parts.cells[places.cells]), parts.nodes[: len(forces)]
    for one in range(parts.count):
        own_points, own_nodes = part == one, nodes == one
        if not over_all(grid.comm, int(own_points.sum())):
            continue
        free = over_all(grid.comm, held[: len(forces)][own_nodes].sum(axis=0)) == 0
        if grid.axisymmetric:  # radial forces have no resultant
            free[0] = False
        sums = over_all(grid.comm, np.append(area[own_points] @ x[own_points], area[own_points].sum()))
        on_side, on_nodes = (
            _rigid(v - sums[:-1] / sums[-1], free) for v in (x[own_points], grid.node_x[: len(forces)][own_nodes])
        )
        gram = np.einsum("n,knd,lnd->kl", area[own_points], on_side, on_side)
        lacks = np.einsum("knd,nd->k", on_nodes, forces[own_nodes])
        lacks -= np.einsum("n,knd,nd->k", area[own_points], on_side, t[own_points])
        gram, lacks = over_all(grid.comm, gram), over_all(grid.comm, lacks)
        t[own_points] += np.einsum("k,knd->nd", np.linalg.lstsq(gram, lacks, rcond=ROUND_OFF)[0], on_side)
    out, start = {}, 0
    for name, p in zip(surfaces, patches, strict=True):
        chosen, number = np.unique(p.at, return_inverse=True)
        of, whole = t[start : start + len(p.at)], sum_by(number, p.area0, len(chosen))
        means = [sum_by(number, p.area0 * column, len(chosen)) / whole for column in of.T]
        out[name] = points.id[chosen], np.stack(means, axis=1)
        start += len(p.at)
    return out


def _rigid(arm: NDArray[np.float64], free: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return k rigid-body displacements (k, n, d) of n points with lever arms (n, d).

    Displacements along fixed axes are omitted.  If an axis is fixed, rotations are omitted too.
    """
    n, d = arm.shape
    fields = [np.broadcast_to(e, (n, d)) for e in np.eye(d)[free]]
    if free.all():
        axes = [(0, 1), (1, 2), (2, 0)][: 1 if d == 2 else 3]
        fields += [np.outer(arm[:, a], np.eye(d)[b]) - np.outer(arm[:, b], np.eye(d)[a]) for a, b in axes]
    return np.stack(fields) if fields else np.zeros((0, n, d))
