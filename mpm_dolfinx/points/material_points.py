# SPDX-License-Identifier: MIT
"""Material points, which store the state of the bodies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from operator import attrgetter
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.parallel.exchange import Exchange
from mpm_dolfinx.points.cutting import centroids

ACROSS = "stretch across"
"""Name of the point data with the out-of-plane stretch in plane strain, for laws with F-bar."""
VELOCITY, RATE = "velocity", "F_rate"
"""Names of point data: velocity (n, d), in m/s, at the centroid, and rate of F (n, d, d), in 1/s."""


def body_of(ids: NDArray[np.int64], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index (n,) of the body of each point.

    `starts` (bodies + 1,): first id of each body, and first id of renewed points.
    """
    beyond = ids - starts[-1]
    return np.where(beyond < 0, starts.searchsorted(ids, side="right") - 1, beyond % max(1, len(starts) - 1))


def determinant(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the determinants (n,) of F (n, d, d)."""
    if F.shape[1] == 2:
        return F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
    return np.einsum("ni,ni->n", F[:, 0], np.cross(F[:, 1], F[:, 2]))


def middle(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means (n, d) of corners (n, 2^d, d)."""
    total = corners[:, 0].copy()
    for k in range(1, corners.shape[1]):
        total += corners[:, k]
    total /= corners.shape[1]
    return total


def with_ratio(F: NDArray[np.float64], J: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F (n, d, d), scaled so that its determinants are the volume ratios J (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # inverted points are rejected later
        ratio = J / determinant(F)
    return F * (np.sign(ratio) * np.abs(ratio) ** (1 / F.shape[1]))[:, None, None]


def in_space(F: NDArray[np.float64], across: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F (n, 3, 3) from the out-of-plane stretch (n,) and the scaled in-plane part (n, 2, 2), see `in_plane`."""
    out = np.zeros((len(F), 3, 3))
    out[:, :2, :2] = F / np.sqrt(across)[:, None, None]
    out[:, 2, 2] = across
    return out


def unstretched(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F (n, 3, 3), with an out-of-plane stretch of 1 if F is (n, 2, 2)."""
    out = np.tile(np.eye(3), (len(F), 1, 1))
    out[:, : F.shape[1], : F.shape[1]] = F
    return out


def in_plane(F: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the in-plane part of F (n, 3, 3), scaled to the determinant `det F`, and the out-of-plane stretch."""
    across = F[:, 2, 2]
    return F[:, :2, :2] * np.sqrt(across)[:, None, None], across.copy()


def cofactor(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `det F F^-T` (n, d, d) of F (n, d, d)."""
    if F.shape[1] == 2:
        flat = F.reshape(-1, 4)[:, ::-1] * [1.0, -1.0, -1.0, 1.0]
        return flat.reshape(F.shape)
    return np.stack([np.cross(F[:, (i + 1) % 3], F[:, (i + 2) % 3]) for i in range(3)], axis=1)


@dataclass(frozen=True, eq=False, repr=False)
class MaterialPoints:
    """Material points of this process.  Immutable arrays have a row for each of n points.

    In a `State`, positions are relative to `Grid.base`.  `Simulation.points` has true positions.

    Attributes
    ----------
    id : (n,)
        Identifier of the point, unique in a scene.
    corners : (n, 2^d, d), m
        Tracked corners of the particle domain, in the order of `grid.corner_bits`.
    F : (n, d, d)
        Deformation gradient.  In plane strain with F-bar, this is the in-plane part, scaled so that its determinant is
        the volume ratio.
    volume0 : (n,), m^d
        Reference volume.
    material : (n,)
        Index of the material in the list of the scene.
    pressure : (n,), Pa
        Mean pore pressure in the domain, positive in compression.  The balances use cell pressures instead.
    x : (n, d), m
        Centroid of the domain, or in axisymmetry of its meridional section.  F and pressure refer to x.
    origin : (n, 2^d, d), m
        Corners at zero displacement: at seeding, or at the start of a stage that set displacements to zero.
    reference : (n, 2^d, d), m
        Corners of the domain in the reference configuration of F: seeded corners, or re-initialised corners.
    data : (n, ...) by name
        All other data: state variables of laws, parameters that vary with position, data of conditions, velocity.
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
    INTERNAL = (ACROSS, "owed", "due", "softness")
    """Names of internal data, which users do not need."""

    def __post_init__(self):
        object.__setattr__(self, "data", MappingProxyType(dict(self.data)))
        for values in self.arrays:
            values.flags.writeable = False

    def __reduce__(self):  # a read-only mapping cannot be pickled
        return type(self), (*(getattr(self, f.name) for f in fields(self) if f.name != "data"), dict(self.data))

    def placed(self, base: NDArray[np.float64]) -> MaterialPoints:
        """Return the points with true positions, by adding `base` (d,), in m, to their positions."""
        return PlacedPoints(**self._moved(base)) if base.any() else self

    def _moved(self, by: NDArray[np.float64]) -> dict[str, Any]:
        """Return the fields with all positions translated by a vector."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        corners, x = self.corners + by, self.x + by

        def of(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return corners if values is self.corners else values + by

        return own | {"corners": corners, "x": x, "origin": of(self.origin), "reference": of(self.reference)}

    def __getattr__(self, name: str):
        """Raise AttributeError for an unknown name.  The message lists the names of all fields."""
        if name.startswith("__") or "data" not in vars(self):  # during a copy
            raise AttributeError(name)
        own = ", ".join([*(f.name for f in fields(self)), "J", "displacement", "velocity (with inertia)"])
        data = ", ".join(key for key in self.data if key not in self.INTERNAL)
        raise AttributeError(f"points: {name!r}, must be one of {own}" + f"; data has {data}" * bool(data))

    def __repr__(self) -> str:
        """Return one line with the number of points, their reference volume, and the ranges of J and pressure."""
        own = [f"{len(self)} points in {self.F.shape[1]}D"]
        if len(self):
            own.append(f"{self.volume0.sum():.4g} m^{self.F.shape[1]} at rest")
            ranges = {"J": (self.J, ""), "pressure": (self.pressure, " Pa")}
            own += [f"{name} {v.min():.4g} to {v.max():.4g}{unit}" for name, (v, unit) in ranges.items()]
        return f"MaterialPoints({', '.join([*own, *self.data])})"

    @property
    def arrays(self) -> tuple[NDArray, ...]:
        """All arrays of the points."""
        return (*_ARRAYS(self), *self.data.values())

    def __len__(self) -> int:
        return len(self.id)

    def within(self) -> NDArray[np.float64]:
        """Return positions (n, d), in m, inside the domains.  These are `x`, except for partly inverted domains."""
        return centroids(self.corners, within=True)

    @cached_property
    def J(self) -> NDArray[np.float64]:
        """Volume ratio det F (n,)."""
        J = determinant(self.F)
        J.flags.writeable = False
        return J

    @property
    def F_of_laws(self) -> NDArray[np.float64]:
        """Deformation gradient for laws: (n, 2, 2) in plane strain without `ACROSS` in `data`, otherwise (n, 3, 3)."""
        return in_space(self.F, self.data[ACROSS]) if ACROSS in self.data else self.F

    def strained(self, F: NDArray[np.float64], **others: NDArray[np.float64]) -> MaterialPoints:
        """Return the points with another F, in the shape of `F_of_laws`, and with new values of the fields `others`."""
        if ACROSS not in self.data:
            return replace(self, F=F, **others)
        F, across = in_plane(F)
        return replace(self, F=F, data={**self.data, ACROSS: across}, **others)

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacement (n, d), in m, of the centroids since seeding, or since a stage set displacements to zero."""
        return self.x - centroids(self.origin)

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity (n, d), in m/s, of scenes with inertia.  In other scenes, AttributeError is raised."""
        if VELOCITY not in self.data:
            raise AttributeError  # `__getattr__` writes the message
        return self.data[VELOCITY]

    def map(self, function: Callable[[NDArray], NDArray], shared: bool = True) -> MaterialPoints:
        """Return the points after a function is applied to each array.

        `shared`: whether fields that share an array also share the new array.
        """
        cache: dict[int, NDArray] = {}

        def once(values: NDArray) -> NDArray:
            if not shared or id(values) not in cache:
                cache[id(values)] = function(values)
            return cache[id(values)]

        arrays = {f.name: once(getattr(self, f.name)) for f in fields(self) if f.name != "data"}
        return type(self)(**arrays, data={name: once(values) for name, values in self.data.items()})

    def where(self, rows: NDArray[np.bool_], other: MaterialPoints) -> MaterialPoints:
        """Return both sets of points: these points in the entries `rows` (n,), and `other` in all other entries."""

        def chosen(a: NDArray, b: NDArray) -> NDArray:
            return a if a is b else np.where(rows.reshape(-1, *[1] * (a.ndim - 1)), a, b)

        arrays = {f.name: chosen(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)[:-1]}
        return type(self)(**arrays, data={name: chosen(v, other.data[name]) for name, v in self.data.items()})

    def joined(self, other: MaterialPoints) -> MaterialPoints:
        """Return these points and the points `other`, ordered by id."""
        order = np.concatenate([self.id, other.id]).argsort()
        pairs = {f.name: (getattr(self, f.name), getattr(other, f.name)) for f in fields(self) if f.name != "data"}
        data = {name: np.concatenate([rows, other.data[name]])[order] for name, rows in self.data.items()}
        return type(self)(**{name: np.concatenate(pair)[order] for name, pair in pairs.items()}, data=data)

    def of(self, ids: NDArray[np.int64], kept: bool = True) -> MaterialPoints:
        """Return the points with the given ids, or all other points if `kept` is false."""
        rows = np.isin(self.id, ids) == kept
        return self if rows.all() else self.map(lambda values: values[rows])

    def of_bodies(self, chosen: Sequence[bool], starts: NDArray[np.int64]) -> MaterialPoints:
        """Return the points of the chosen bodies.  For `starts` see `body_of`."""
        rows = np.asarray(chosen)[body_of(self.id, starts)]
        return self if rows.all() else self.map(lambda values: values[rows])

    def migrated(self, exchange: Exchange) -> MaterialPoints:
        """Return the points that `exchange` moves to this process, ordered by id."""
        arrays = self.arrays
        one = tuple([values is other for other in arrays].index(True) for values in arrays)
        equal = len(set(exchange.comm.allgather(one))) == 1  # else numbers of transfers would differ between processes
        received = self.map(exchange.send, equal)
        order = received.id.argsort()
        return received.map(lambda rows: rows[order])

    def find(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the indices (k,) of this process's ids in the array `ids`, and the indices (k,) of their points."""
        at = self.id.searchsorted(ids)
        found = ((at < len(self)) & (self.id[np.minimum(at, len(self) - 1)] == ids)).nonzero()[0] if len(self) else []
        found = np.asarray(found, dtype=np.int64)
        return found, at[found]


_ARRAYS = attrgetter(*(f.name for f in fields(MaterialPoints) if f.name != "data"))
"""Function that returns all arrays of points except `data`."""


class PlacedPoints(MaterialPoints):
    """Material points with true positions, in place of positions relative to `Grid.base`."""

    def from_base(self, base: NDArray[np.float64]) -> MaterialPoints:
        """Return the points with positions relative to `base` (d,), in m, as in a state."""
        return MaterialPoints(**self._moved(-base))
