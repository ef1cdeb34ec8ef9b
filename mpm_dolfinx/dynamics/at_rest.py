# SPDX-License-Identifier: MIT
"""Tractions that sides have borne at rest, of bodies that are let go."""

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


def borne(
    cut: CutDomains,
    points: MaterialPoints,
    stresses: Mapping[str, NDArray[np.float64]],
    surfaces: Mapping[str, Surface],
    parts: Parts,
    forces: NDArray[np.float64],
    held: NDArray[np.bool_],
) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return ids (m,) and tractions (m, d), Pa per reference area, that points bear on sides at rest.

    They are those of the stresses.  What these lack of force and moment to balance a part of the bodies, which
    would go on pushing it, is made up for by rigid fields of tractions.

    Parameters
    ----------
    cut, points
        The domains, cut, and the points.
    stresses, surfaces
        Total stresses (faces, k, k), Pa, on sides by their names, and these.
    parts
        Parts of the bodies.
    forces : (nodes, d), N
        That sides bear at the owned nodes of this process, zero where something else does.
    held : (nodes, d)
        Components that something else holds from now on.
    """
    grid, d = cut.grid, cut.grid.dim
    patches = cut.surfaces(list(surfaces.values()))
    area, x = (np.concatenate([getattr(p, name) for p in patches]) for name in ("area0", "x"))
    own = np.concatenate([p.area(points) for p in patches])
    stress = np.concatenate([of[p.here, :d, :d] for of, p in zip(stresses.values(), patches, strict=True)])
    t = np.einsum("nij,nj->ni", stress, own) / area[:, None]
    travel, places = owners(grid, patches)
    part, nodes = travel.back(parts.cells[places.cells]), parts.nodes[: len(forces)]
    for one in range(parts.count):
        here, there = part == one, nodes == one
        if not over_all(grid.comm, int(here.sum())):
            continue
        free = over_all(grid.comm, held[: len(forces)][there].sum(axis=0)) == 0
        if grid.axisymmetric:  # forces along the radius have no sum
            free[0] = False
        sums = over_all(grid.comm, np.append(area[here] @ x[here], area[here].sum()))
        on_side, on_nodes = (
            _rigid(v - sums[:-1] / sums[-1], free) for v in (x[here], grid.node_x[: len(forces)][there])
        )
        gram = np.einsum("n,knd,lnd->kl", area[here], on_side, on_side)
        lacks = np.einsum("knd,nd->k", on_nodes, forces[there])
        lacks -= np.einsum("n,knd,nd->k", area[here], on_side, t[here])
        gram, lacks = over_all(grid.comm, gram), over_all(grid.comm, lacks)
        t[here] += np.einsum("k,knd->nd", np.linalg.lstsq(gram, lacks, rcond=ROUND_OFF)[0], on_side)
    out, start = {}, 0
    for name, p in zip(surfaces, patches, strict=True):
        chosen, number = np.unique(p.at, return_inverse=True)
        of, whole = t[start : start + len(p.at)], sum_by(number, p.area0, len(chosen))
        means = [sum_by(number, p.area0 * column, len(chosen)) / whole for column in of.T]
        out[name] = points.id[chosen], np.stack(means, axis=1)
        start += len(p.at)
    return out


def _rigid(arm: NDArray[np.float64], free: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return rigid fields (k, n, d) at places (n, d), m, about their origin: shifts along what is free, and turns.

    Of what is held along some axis no turn.
    """
    n, d = arm.shape
    fields = [np.broadcast_to(e, (n, d)) for e in np.eye(d)[free]]
    if free.all():
        axes = [(0, 1), (1, 2), (2, 0)][: 1 if d == 2 else 3]
        fields += [np.outer(arm[:, a], np.eye(d)[b]) - np.outer(arm[:, b], np.eye(d)[a]) for a, b in axes]
    return np.stack(fields) if fields else np.zeros((0, n, d))
