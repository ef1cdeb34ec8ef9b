# SPDX-License-Identifier: MIT
"""Contact pressures and shear tractions that material points keep from step to step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.points.origin import Origin


class Rough(Protocol):
    """A tool, or the contact of two groups: mu, adhesion, Pa, and whether it resists slip."""

    friction: float
    adhesion: float
    grips: bool


def pressure_name(name: str) -> str:
    """Return the name under which points have the pressure (n,), Pa, of a tool or contact on their faces."""
    return f"{name}_pressure"


def shear_name(name: str) -> str:
    """Return the name under which points keep the shear traction (n, d), Pa, of a tool or contact."""
    return f"{name}_shear"


def kept(contacts: Mapping[str, Rough], n: int, dim: int) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return what n points keep of each contact, zero: pressures (n,) and, of what resists slip, tractions (n, d)."""
    return {
        name: {pressure_name(name): np.zeros(n), **({shear_name(name): np.zeros((n, dim))} if contact.grips else {})}
        for name, contact in contacts.items()
    }


def let_go(points: MaterialPoints, names: Iterable[str]) -> MaterialPoints:
    """Return points without what they keep under these names."""
    return replace(points, data={name: rows for name, rows in points.data.items() if name not in names})


def gripped(
    points: MaterialPoints, new: Mapping[str, NDArray[np.float64]], before: MaterialPoints | None
) -> MaterialPoints:
    """Return points with new data, or with what the same points kept of it `before`."""
    if before is not None:
        here, at = before.find(points.id)
        for name in new.keys() & before.data.keys():
            new[name][here] = before.data[name][at]
    return replace(points, data={**points.data, **new}) if new else points


def pressed(
    contacts: Mapping[str, Rough], origin: Origin, points: MaterialPoints, push: NDArray, shear: NDArray
) -> MaterialPoints:
    """Return the points with the means of the pressures (m,) and shear tractions (m, d), Pa, of their pairs."""
    data = dict(points.data)
    means = origin.means(len(points), len(contacts), np.column_stack([push, shear]))
    for (name, contact), values in zip(contacts.items(), means, strict=True):
        data[pressure_name(name)] = values[:, 0]
        if contact.grips:
            data[shear_name(name)] = values[:, 1:]
    return replace(points, data=data)
