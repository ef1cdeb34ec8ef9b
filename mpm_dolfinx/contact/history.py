# SPDX-License-Identifier: MIT
"""Contact pressures and shear tractions that material points store from step to step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import means_of_rows
from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.material_points import MaterialPoints


class Rough(Protocol):
    """Shear strength of a tool or contact: friction coefficient, and adhesion in Pa."""

    friction: float
    adhesion: float
    frictional: bool


def pressure_name(name: str) -> str:
    """Return the name of the point field that stores the contact pressure (n,), in Pa, of a tool or contact."""
    return f"{name}_pressure"


def shear_name(name: str) -> str:
    """Return the name of the point field with the shear traction (n, d), in Pa, of a tool or contact."""
    return f"{name}_shear"


@dataclass(frozen=True, eq=False)
class Origin:
    """Indices of the material point and the contact of each contact pair."""

    exchange: Exchange  # sends the pairs to the owners of their cells
    point: NDArray[np.int64]  # index of the material point on this process (n,)
    number: NDArray[np.int64]  # index of the contact (n,)
    area: NDArray[np.float64]  # contact area (n,), m^(d-1)

    def means(
        self, contacts: Mapping[str, Rough], points: MaterialPoints, push: NDArray, shear: NDArray
    ) -> MaterialPoints:
        """Return the points with the means, over their contact pairs, of pressures `push` and tractions `shear`."""
        push = self.exchange.back(push)
        shear = self.exchange.back(shear)
        data = dict(points.data)
        n = len(points)
        for number, (name, contact) in enumerate(contacts.items()):
            rows = np.flatnonzero(self.number == number)
            at, area = self.point[rows], self.area[rows]
            data[pressure_name(name)] = means_of_rows(at, area, push[rows], n)
            if contact.frictional:
                data[shear_name(name)] = means_of_rows(at, area, shear[rows], n)
        return replace(points, data=data)


def joined(both: Sequence[Origin], kept: Sequence[NDArray[np.bool_]]) -> tuple[Origin, NDArray[np.int64]]:
    """Merge the pairs that `kept` flags in two `Origin`.  Return the result, and the new order of the pairs (n,)."""
    columns, start = [], 0
    comm = both[0].exchange.comm
    for of, rows in zip(both, kept, strict=True):
        sent = np.stack([rows, start + np.cumsum(rows) - 1, np.full(len(rows), comm.rank)], axis=1).astype(np.int64)
        sent = of.exchange.back(sent)
        columns.append([values[sent[:, 0] > 0] for values in (*sent[:, :0:-1].T, of.point, of.number, of.area)])
        start += int(rows.sum())
    owner, index, *own = (np.concatenate(values) for values in zip(*columns, strict=True))
    exchange = Exchange(comm, owner)
    return Origin(exchange, *own), exchange.send(index)
