# SPDX-License-Identifier: MIT
"""Bodies that consist of boxes of a lattice, which need little memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.tolerances import NEAR, SAME
from mpm_dolfinx.base.validation import asked, numbers, whole
from mpm_dolfinx.bodies.bodies import Body, check_inside
from mpm_dolfinx.grid.grid import MOST, Grid, among, begin_with, corner_bits, in_chunks


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class LatticeBody(Body):
    """A body of boxes on a lattice.  Rows, which are layers of boxes normal to an axis, may differ in width."""

    rows: tuple[NDArray[np.float64], ...]  # coordinates of the rows' boundaries along each axis (count + 1,), m
    widths: tuple[NDArray[np.float64], ...]  # widths of the rows along each axis (count,), m
    filled: NDArray[np.integer] | None = None  # lexicographic indices of the body's boxes (n,), ascending; None: all

    def __len__(self) -> int:
        return int(np.prod(self.count)) if self.filled is None else len(self.filled)

    @cached_property
    def count(self) -> tuple[int, ...]:
        """Number of boxes of the lattice along each axis."""
        return tuple(map(len, self.widths))

    @cached_property
    def spacing(self) -> NDArray[np.float64]:
        """Smallest width (d,) of a row along each axis, in m."""
        return np.array([widths.min() for widths in self.widths])

    @property
    def dim(self) -> int:
        """Number d of dimensions."""
        return len(self.rows)

    def _index(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the lattice indices (n, d) of the chosen domains."""
        if self.filled is not None:
            numbers = self.filled[chosen]
        elif isinstance(chosen, slice):
            numbers = np.arange(*chosen.indices(len(self)))
        else:
            numbers = np.arange(len(self))[chosen] if chosen.dtype == bool else chosen
        return np.stack(np.unravel_index(numbers, self.count), axis=-1)

    def _at(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the positions (..., d), in m, of lattice corners with indices (..., d)."""
        return np.stack([rows[i] for rows, i in zip(self.rows, np.moveaxis(index, -1, 0), strict=True)], axis=-1)

    def lower_of(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the lower corners (n, d), in m, of the chosen reference domains."""
        return self._at(self._index(chosen))

    def boxes(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the edge lengths (n, d), in m, of the chosen reference domains."""
        return np.stack([widths[i] for widths, i in zip(self.widths, self._index(chosen).T, strict=True)], axis=-1)

    def centre_of(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the reference positions (n, d), in m, of the centres of the chosen domains."""
        return self.lower_of(chosen) + 0.5 * self.boxes(chosen)

    def reference(self, chosen: slice | NDArray[np.int64] = slice(None)) -> NDArray[np.float64]:
        """Return the corners (n, 2^d, d), in m, of the chosen reference domains.

        If several domains share a corner, its coordinates are bitwise equal in all of them.
        """
        return self._at(self._index(chosen)[:, None] + corner_bits(self.dim))

    def sides_of(self, chosen: slice | NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each face (domain, axis, end) of the chosen domains lies on the body's surface, (n, d, 2)."""
        index = self._index(chosen)
        out = np.stack([index == 0, index == np.array(self.count) - 1], axis=-1)
        if self.filled is None:
            return out
        for axis, end in np.ndindex(self.dim, 2):
            inner = np.flatnonzero(~out[:, axis, end])
            neighbour = index[inner]
            neighbour[:, axis] += 2 * end - 1
            out[inner, axis, end] = ~among(np.ravel_multi_index(tuple(neighbour.T), self.count), self.filled)
        return out

    def _with_face(self, axis: int, end: int) -> NDArray[np.int64]:
        """See `Body`."""
        if self.filled is not None:
            return super()._with_face(axis, end)
        along = [np.arange(n) for n in self.count]
        along[axis] = np.array([end * (self.count[axis] - 1)])
        return np.ravel_multi_index(np.ix_(*along), self.count).ravel()

    @cached_property
    def _ends(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Smallest and largest lattice indices (d,) of the domains."""
        if self.filled is None:
            return np.zeros(self.dim, np.int64), np.array(self.count) - 1
        parts = [self._index(part) for part in in_chunks(len(self))]
        return np.min([p.min(axis=0) for p in parts], axis=0), np.max([p.max(axis=0) for p in parts], axis=0)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner (d,), in m, of the bounding box of all reference domains."""
        low, high = self._ends
        return self._at(low), self._at(high + 1)

    def neighbour(self, rows: NDArray[np.int64], step: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the neighbours (n,) of domains `rows` (n,) at lattice offsets `step` (n, d)."""
        number = np.ravel_multi_index(tuple((self._index(rows) + step).T), self.count)
        return number if self.filled is None else np.searchsorted(self.filled, number)

    @property
    def lattice(self) -> tuple[int, ...]:
        """Number of lattice boxes along each axis of the body's bounding box, including empty boxes."""
        low, high = self._ends
        return tuple(high - low + 1)

    def places(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the lattice indices (n, d) of domains, counted from the lower corner of the body's bounding box."""
        return self._index(rows) - self._ends[0]

    def nodes(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the node indices (n, 2^d) of the corners of domains.  A corner that domains share has one index."""
        corners = self.places(rows)[:, None] + corner_bits(self.dim)
        return np.ravel_multi_index(tuple(np.moveaxis(corners, 2, 0)), tuple(np.add(self.lattice, 1)))

    def corner_rows(self, axis: int) -> NDArray[np.float64]:
        """Return the coordinates, in m, of the boundaries of the body's rows along an axis."""
        low, high = self._ends
        return self.rows[axis][low[axis] : high[axis] + 2]


def _rows(
    grid: Grid, axis: int, low: float, high: float, per_cell: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the boundaries and widths of rows from `low` to `high`, in m, with `per_cell` rows in each whole cell."""
    if grid.even:
        count = int(_rounded((high - low) / (grid.h[axis] / per_cell)))
        width = (high - low) / count
        return low + np.arange(count + 1) * width, np.broadcast_to(width, count)
    lines = grid.lines[axis] + grid.base[axis]
    tolerance = SAME * grid.finest[axis]
    ends = np.concatenate([[low], lines[(lines > low + tolerance) & (lines < high - tolerance)], [high]])
    width = grid.widths[axis][grid.cells_along(axis, (ends[1:] + ends[:-1]) / 2 - grid.base[axis])]
    count = _rounded(np.diff(ends) / width * per_cell)
    parts = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(ends[:-1], ends[1:], count, strict=True)]
    rows = np.concatenate([*parts, [high]])
    return rows, np.diff(rows)


def _rounded(rows: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return numbers of rows as integers >= 1, unaffected by rounding errors of coordinates."""
    return np.maximum(1, np.rint(NEAR * np.rint(rows / NEAR))).astype(np.int64)


def box(grid: Grid, lower: ArrayLike, upper: ArrayLike, per_cell: int = 2, material: int = 0) -> Body:
    """Return a box-shaped body, seeded with material points on a lattice.

    Parameters
    ----------
    grid
        Background grid.
    lower, upper : (d,), m
        Corners of the box, inside the grid.  Corners need not lie on grid lines.
    per_cell
        Points per cell and direction, >= 1, rounded so that whole domains fill the box.  With 1 point, bodies are too
        flexible and creep.  In 3D, use at least 2.
    material
        Index of the material in the scene's list, >= 0.

    Raises
    ------
    ValueError
        A corner is outside the grid, `upper` is not above `lower`, or `per_cell` or `material` is invalid.
    """
    begin_with("body: grid", grid)
    lower, upper = (
        numbers(f"body: {name}", x, (grid.dim,), allowed=f"{grid.dim} finite coordinates")
        for name, x in (("lower", lower), ("upper", upper))
    )
    if not (upper > lower).all():
        raise ValueError(f"body: box {lower.tolist()} to {upper.tolist()}, upper must be > lower")
    material, per_cell = whole("body: material", material, 0), whole("body: per_cell", per_cell)
    rows, widths = zip(*(_rows(grid, a, lower[a], upper[a], per_cell) for a in range(grid.dim)), strict=True)
    return check_inside(grid, LatticeBody(rows=rows, widths=widths, material=material))


def shape(
    grid: Grid, inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]], per_cell: int = 2, material: int = 0
) -> Body:
    """Return a body of arbitrary shape, seeded with material points on a lattice.

    The body consists of all lattice boxes with centres inside the shape, so its surface has steps.  For smooth sides,
    use `polygon`, `from_mesh` or `mapped`.

    Parameters
    ----------
    grid
        Background grid.
    inside
        Function from positions (n, d), in m, to booleans (n,), True inside the shape.
    per_cell
        Points per cell and direction, >= 1.
    material
        Index of the material in the scene's list, >= 0.

    Raises
    ------
    ValueError
        `inside` raises an exception, returns other values than booleans, or is False everywhere.  `per_cell` or
        `material` is invalid.
    """
    begin_with("body: grid", grid)
    material, per_cell = whole("body: material", material, 0), whole("body: per_cell", per_cell)
    rows, widths = zip(*(_rows(grid, a, grid.lower[a], grid.upper[a], per_cell) for a in range(grid.dim)), strict=True)
    whole_lattice = LatticeBody(rows=rows, widths=widths, material=material)
    x = whole_lattice.centre
    allowed = f"one bool for each position, ({len(x)},)"
    filled = np.asarray(asked("body: inside(x)", allowed, inside, x))
    if filled.shape != (len(x),) or filled.dtype != bool:  # such as a signed distance
        raise ValueError(f"body: inside(x) has shape {filled.shape} of {filled.dtype}, must be {allowed}")
    if not filled.any():
        raise ValueError(
            "body: inside(x) is False at all points, must be True at one: is the shape smaller than a cell?"
        )
    numbers_of = np.flatnonzero(filled).astype(np.int32 if len(filled) <= MOST else np.int64)
    return check_inside(grid, replace(whole_lattice, filled=numbers_of))
