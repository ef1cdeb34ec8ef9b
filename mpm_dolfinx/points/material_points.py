# SPDX-License-Identifier: MIT
"""Material points: what a body remembers while the grid is reset.

Places, corners of their domains, F, pore pressure; and `data` by name: states of laws, what they keep of conditions,
and of bodies with inertia the velocity and the rate of F, which `inertia` carries from step to step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.cutting import centroids

ACROSS = "stretch across"
"""Name of what points of plane strain carry whose laws see a stretch across the plane, that of a mean dilatation."""


def body_of(ids: NDArray[np.int64], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the body (n,) of each point by its number; starts (bodies + 1,): first numbers of bodies, and of none.

    Points beyond those as seeded are of one body after the other.
    """
    beyond = ids - starts[-1]
    return np.where(beyond < 0, np.searchsorted(starts, ids, side="right") - 1, beyond % max(1, len(starts) - 1))


def determinant(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return det F (n,) of (n, d, d); numpy's own, by factors, takes twenty times as long."""
    if F.shape[1] == 2:
        return F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
    return np.einsum("ni,ni->n", F[:, 0], np.cross(F[:, 1], F[:, 2]))


def middle(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means (n, d) of corners (n, 2^d, d); numpy's own takes five times as long."""
    total = corners[:, 0].copy()
    for k in range(1, corners.shape[1]):
        total += corners[:, k]
    total /= corners.shape[1]
    return total


def with_ratio(F: NDArray[np.float64], J: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F (n, d, d), scaled to volume ratios J (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # of what is turned inside out, which is refused afterwards
        ratio = J / determinant(F)
    return F * (np.sign(ratio) * np.abs(ratio) ** (1 / F.shape[1]))[:, None, None]


def in_space(F: NDArray[np.float64], across: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F (n, 3, 3) of its part in the plane (n, 2, 2), scaled to det F, and the stretch across the plane (n,)."""
    out = np.zeros((len(F), 3, 3))
    out[:, :2, :2] = F / np.sqrt(across)[:, None, None]
    out[:, 2, 2] = across
    return out


def in_plane(F: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what `in_space` takes of F (n, 3, 3)."""
    across = F[:, 2, 2]
    return F[:, :2, :2] * np.sqrt(across)[:, None, None], across.copy()


def cofactor(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return det F F^-T (n, d, d) of (n, d, d), a tenth of the time of numpy's own inverse."""
    if F.shape[1] == 2:
        flat = F.reshape(-1, 4)[:, [3, 2, 1, 0]] * [1.0, -1.0, -1.0, 1.0]
        return flat.reshape(F.shape)
    return np.stack([np.cross(F[:, (i + 1) % 3], F[:, (i + 2) % 3]) for i in range(3)], axis=1)


@dataclass(frozen=True, eq=False, repr=False)
class MaterialPoints:
    """Material points of this process; arrays over its n points, that nobody changes.

    Places of a state count from the grid's `base`; those of `Simulation.points` are true.

    Attributes
    ----------
    id : (n,)
        Number of the point in the body.
    corners : (n, 2^d, d), m
        Tracked corners of the point's domain, in the order of `cutting.corner_bits`.
    F : (n, d, d)
        Deformation gradient; where laws see a stretch across the plane its part in the plane, scaled to det F.
    volume0 : (n,), m^d
        Reference volume.
    material : (n,)
        Index of the point's material in the scene's list.
    pressure : (n,), Pa
        Pore pressure, positive in compression: the mean over the domain, of second order; what cells and
        domains take along is the state's.
    x : (n, d), m
        Centroid of the domain, in axisymmetry in the plane: there F and pressure are those of linear fields.
    origin : (n, 2^d, d), m
        Corners from which displacements count: as seeded, or when a stage reset them.
    reference : (n, 2^d, d), m
        Corners of the domain at rest, from which F counts: as seeded, or as put on others.
    data : name -> (n, ...)
        What else the points carry: parameters that differ from point to point, state of the law.
    """

    id: NDArray[np.int64]
    corners: NDArray[np.float64]
    F: NDArray[np.float64]
    volume0: NDArray[np.float64]
    material: NDArray[np.int32]
    pressure: NDArray[np.float64]
    x: NDArray[np.float64]
    origin: NDArray[np.float64]
    reference: NDArray[np.float64]
    data: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "data", MappingProxyType(dict(self.data)))
        for values in self.arrays:
            values.flags.writeable = False

    def __reduce__(self):  # a read-only mapping cannot be sent to other processes
        return type(self), (*(getattr(self, f.name) for f in fields(self) if f.name != "data"), dict(self.data))

    def placed(self, base: NDArray[np.float64]) -> MaterialPoints:
        """Return the points with true places, which counted from a base (d,), m: `PlacedPoints`, but for base 0."""
        return PlacedPoints(**self._moved(base)) if base.any() else self

    def _moved(self, by: NDArray[np.float64]) -> dict[str, Any]:
        """Return the fields with all places moved by (d,), m."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        corners, x = self.corners + by, self.x + by

        def of(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return corners if values is self.corners else values + by

        return own | {"corners": corners, "x": x, "origin": of(self.origin), "reference": of(self.reference)}

    def __repr__(self) -> str:
        """Return one line: how many points, their volume at rest, and the ranges of J and pressure."""
        own = [f"{len(self)} points in {self.F.shape[1]}D"]
        if len(self):
            own.append(f"{self.volume0.sum():.4g} m^{self.F.shape[1]} at rest")
            ranges = {"J": (self.J, ""), "pressure": (self.pressure, " Pa")}
            own += [f"{name} {v.min():.4g} to {v.max():.4g}{unit}" for name, (v, unit) in ranges.items()]
        return f"MaterialPoints({', '.join([*own, *self.data])})"

    @property
    def arrays(self) -> tuple[NDArray, ...]:
        """All arrays."""
        return (*(getattr(self, f.name) for f in fields(self) if f.name != "data"), *self.data.values())

    def __len__(self) -> int:
        return len(self.id)

    @property
    def J(self) -> NDArray[np.float64]:
        """Volume ratio det F (n,)."""
        return determinant(self.F)

    @property
    def F_of_laws(self) -> NDArray[np.float64]:
        """Deformation gradient that laws see (n, 3, 3), in plane strain without a stretch across it (n, 2, 2)."""
        return in_space(self.F, self.data[ACROSS]) if ACROSS in self.data else self.F

    def strained(self, F: NDArray[np.float64]) -> MaterialPoints:
        """Return the points with another deformation gradient, of the shape that laws see."""
        if ACROSS not in self.data:
            return replace(self, F=F)
        F, across = in_plane(F)
        return replace(self, F=F, data={**self.data, ACROSS: across})

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacement (n, d), m, of the centroids, from where displacements count."""
        return self.x - centroids(self.origin)

    def map(self, function: Callable[[NDArray], NDArray]) -> MaterialPoints:
        """Return points with a function applied to each of their arrays: a choice of rows, a copy, a transfer.

        Arrays that are one stay one.
        """
        made: dict[int, NDArray] = {}

        def once(values: NDArray) -> NDArray:
            if id(values) not in made:
                made[id(values)] = function(values)
            return made[id(values)]

        arrays = {f.name: once(getattr(self, f.name)) for f in fields(self) if f.name != "data"}
        return type(self)(**arrays, data={name: once(values) for name, values in self.data.items()})

    def where(self, rows: NDArray[np.bool_], other: MaterialPoints) -> MaterialPoints:
        """Return these points in some rows (n,), and in the others another state of the same points."""

        def chosen(a: NDArray, b: NDArray) -> NDArray:
            return a if a is b else np.where(rows.reshape(-1, *[1] * (a.ndim - 1)), a, b)

        arrays = {f.name: chosen(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)[:-1]}
        return type(self)(**arrays, data={name: chosen(v, other.data[name]) for name, v in self.data.items()})

    def joined(self, other: MaterialPoints) -> MaterialPoints:
        """Return these points and others, ordered by id."""
        order = np.argsort(np.concatenate([self.id, other.id]))
        pairs = {f.name: (getattr(self, f.name), getattr(other, f.name)) for f in fields(self) if f.name != "data"}
        data = {name: np.concatenate([rows, other.data[name]])[order] for name, rows in self.data.items()}
        return type(self)(**{name: np.concatenate(pair)[order] for name, pair in pairs.items()}, data=data)

    def of(self, ids: NDArray[np.int64], kept: bool = True) -> MaterialPoints:
        """Return the points of these ids, or all others."""
        rows = np.isin(self.id, ids) == kept
        return self if rows.all() else self.map(lambda values: values[rows])

    def migrated(self, exchange: Exchange) -> MaterialPoints:
        """Return the points of this process after every point went to its destination, ordered by id."""
        arrays = self.arrays
        one = tuple([values is other for other in arrays].index(True) for values in arrays)
        alike = len(set(exchange.comm.allgather(one))) == 1  # else processes would wait for transfers of the others
        received = (self if alike else self._apart()).map(exchange.send)
        order = np.argsort(received.id)
        return received.map(lambda rows: rows[order])

    def _apart(self) -> MaterialPoints:
        """Return the points with an array of its own for each of their fields."""
        arrays = {f.name: getattr(self, f.name).copy() for f in fields(self) if f.name != "data"}
        return type(self)(**arrays, data={name: values.copy() for name, values in self.data.items()})

    def find(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return (which of `ids` are points of this process, their indices); points are ordered by id."""
        at = np.searchsorted(self.id, ids)
        here = np.flatnonzero((at < len(self)) & (self.id[np.minimum(at, len(self) - 1)] == ids)) if len(self) else []
        here = np.asarray(here, dtype=np.int64)
        return here, at[here]


class PlacedPoints(MaterialPoints):
    """Material points with true places, which do not count from the grid's `base`: no `State` takes them."""

    def from_base(self, base: NDArray[np.float64]) -> MaterialPoints:
        """Return the points with places that count from a base (d,), m, as those of a state."""
        return MaterialPoints(**self._moved(-base))
