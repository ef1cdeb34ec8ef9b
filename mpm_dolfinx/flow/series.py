# SPDX-License-Identifier: MIT
"""Fluxes between two cells through unsaturated soils in series.

The pressure of a cell refers to one position in the cell, the pressure position (`layers`).  There may be several soils
between the pressure positions of two cells.  The pressures at the interfaces of these soils are local unknowns of the
common face.  These unknowns satisfy the continuity of the flux, and are eliminated (static condensation).  Steady flow
through layers with exponential relative conductivity is exact for any position of the layers.

A cell is crossed by several lines (`layers`).  Lines with a single soil between pressure position and face conduct in
parallel.  All other lines are replaced by one line with the mean length in each soil.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import EPSILON, SAME, TINY
from mpm_dolfinx.flow.unsaturated import Laws
from mpm_dolfinx.pores.retention import FARTHEST

MOST = 2200  # largest number of iterations.  Source: exact bound, two per halving of an interval of doubles (IEEE 754)


class Paths(NamedTuple):
    """Flow paths from the pressure positions of n cells to their faces.

    The first three indices of the arrays (n, d, 2, ...) are the cell, the axis, and the end of the cell.  `parallel` is
    for lines with a single soil.  Entry 0 of `parallel` is for soil without a retention curve, and each curve has one
    further entry.  The fields `law`, `length` and `resistance` describe one line with s soils in series.
    """

    parallel: NDArray[np.float64]  # mobility of single-soil lines, times their fraction of all lines (l,), m^2/(Pa s)
    law: NDArray[np.int64]  # retention curve of each soil in series, -1 for unused entries (s,)
    length: NDArray[np.float64]  # fraction of the path in each soil (s,)
    resistance: NDArray[np.float64]  # length divided by mobility and by the fraction of series lines (s,), Pa s/m^2

    def at(self, *index) -> Paths:
        """Return the paths at an index of the arrays."""
        return Paths(*(values[index] for values in self))

    def everywhere(self, dim: int) -> Paths:
        """Return the paths (n, d, 2, ...): each of these n paths, repeated for both ends of all axes."""
        parts = ((np.repeat(values, 2 * dim, axis=0), values.shape) for values in self)
        return Paths(*(many.reshape(shape[0], dim, 2, shape[1]) for many, shape in parts))

    def with_slots(self, count: int) -> Paths:
        """Return the paths, padded to `count` soils in series."""
        more = [(0, 0)] * (self.law.ndim - 1) + [(0, count - self.law.shape[-1])]
        law, length, resistance = (
            np.pad(values, more, constant_values=v) for values, v in zip(self[1:], (-1, 0, 0), strict=True)
        )
        return Paths(self.parallel, law, length, resistance)

    def eased(self, factor: NDArray[np.float64]) -> Paths:
        """Return the paths with mobilities multiplied by a factor (n, d) along each axis."""
        factor = factor[:, :, None, None]
        return self._replace(parallel=self.parallel * factor, resistance=self.resistance / factor)


class Through(NamedTuple):
    """Conductances of m faces for the pressures on both sides."""

    conductance: NDArray[np.float64]  # conductances (m,), m/(Pa s)
    slopes: tuple[NDArray[np.float64], NDArray[np.float64]]  # d flux / dp[0] and -d flux / dp[1]


def none(count: int, laws: int, slots: int) -> Paths:
    """Return paths (count, ...) with zero mobility."""
    return Paths(
        np.zeros((count, laws)), np.full((count, slots), -1), np.zeros((count, slots)), np.zeros((count, slots))
    )


class _Links(NamedTuple):
    """Segments of soil along the flow path through a face."""

    face: NDArray[np.int64]  # index of the face
    low: NDArray[np.int64]  # first node
    high: NDArray[np.int64]  # second node
    law: NDArray[np.int64]  # index of the retention curve
    conductance: NDArray[np.float64]  # conductance at k_r = 1, m/(Pa s)
    drop: NDArray[np.float64]  # hydrostatic pressure drop, Pa


class _Flows(NamedTuple):
    """Flows through the segments."""

    k: NDArray[np.float64]  # conductance, m/(Pa s)
    own: NDArray[np.float64]  # derivative of the flux with respect to the pressure of the first node, m/(Pa s)
    other: NDArray[np.float64]  # minus the derivative of the flux with respect to the pressure of the second node
    flux: NDArray[np.float64]  # flux from the first to the second node, m/s
    rounding: NDArray[np.float64]  # rounding error of the flux, m/s


def through(
    laws: Laws,
    p: Sequence[NDArray[np.float64]],
    paths: Sequence[Paths],
    lengths: Sequence[NDArray[np.float64]],
    drops: Sequence[NDArray[np.float64]],
) -> Through:
    """Return the conductances of m faces for the pressures on both sides.

    `laws`: relative conductivities as functions of pressure.
    `p` (m,), Pa: pressures on both sides, as two arrays.
    `paths` (m, ...): paths of one or two cells, from their pressure positions to the face.
    `lengths` (m,), m: lengths of the paths.
    `drops` (m,), Pa: pressure drops along the paths, from the first to the second side, due to the weight of the fluid.
    """
    counts = [np.maximum((path.law >= 0).sum(axis=1), 1) for path in paths]
    kinds, kind = np.unique(np.stack(counts, axis=1), axis=0, return_inverse=True)
    out = np.zeros((3, len(p[0])))
    for i, count in enumerate(kinds):
        rows = np.flatnonzero(kind.ravel() == i)
        of = [[values[rows] for values in each] for each in (p, lengths, drops)]
        out[:, rows] = _Chain(laws, [path.at(rows) for path in paths], count.tolist(), *of).solved()
    return Through(out[0], (out[1], out[2]))


class _Chain:
    """Faces with equal numbers of soils in series.  Each interface between soils has a pressure."""

    def __init__(self, laws: Laws, paths: Sequence[Paths], count: Sequence[int], p, lengths, drops):
        self._laws, self._p = laws, p
        self._size, self._nodes = len(p[0]), sum(count) + 1
        self._counts = count
        faces = np.arange(self._size)
        links, hydrostatic = [], [p[0]]
        for side, path in enumerate(paths):
            first, drop = len(hydrostatic) - 1, drops[side]
            for j in range(count[side]):
                slot = count[side] - 1 - j if side else j  # soils of the second path: from the cell to the face
                used = path.law[:, slot] >= 0
                part = np.where(used, path.length[:, slot], 1.0) * drop
                with np.errstate(divide="ignore"):
                    conductance = np.where(used, 1 / (path.resistance[:, slot] * lengths[side]), 0.0)
                node = np.full(self._size, first + j)
                links.append(_Links(faces, node, node + 1, np.maximum(path.law[:, slot], 0), conductance, part))
                hydrostatic.append(hydrostatic[-1] + part)
            face, law = np.nonzero(path.parallel)
            low, high = (np.full(len(face), node) for node in (first, len(hydrostatic) - 1))
            links.append(_Links(face, low, high, law, path.parallel[face, law] / lengths[side][face], drop[face]))
        self._parts = np.cumsum([0, *(len(one.face) for one in links)])
        self._links = _Links(*(np.concatenate(parts) for parts in zip(*links, strict=True)))
        self._hydrostatic = np.stack(hydrostatic, axis=1)
        self._difference = self._hydrostatic[:, -1] - p[1]

    def solved(self) -> NDArray[np.float64]:
        """Return the fields of `Through` as three rows (3, faces): the conductance, then both entries of `slopes`."""
        links, difference = self._links, self._difference[:, None]
        inner = slice(1, -1)
        scale = np.full(self._hydrostatic.shape, np.inf)
        for node in (links.low, links.high):
            np.minimum.at(scale, (links.face, node), self._laws.scales[links.law])
        scale = scale[:, inner]
        low, high = np.sort([self._hydrostatic, self._hydrostatic - difference], axis=0)[:, :, inner]
        size = np.minimum(scale, np.abs(low) + np.abs(high))
        done = self._nodes == 2
        most, previous = np.full(scale.shape, FARTHEST), np.zeros(scale.shape)
        p = self._hydrostatic - np.arange(self._nodes) / (self._nodes - 1) * difference
        p[:, -1] = self._p[1]
        for _ in range(MOST):
            flows = self._flows(p)
            if done:
                return self._condensed(flows)
            old = p[:, inner].copy()
            step, balanced = self._step(flows)
            if self._nodes == 3:
                low, high = np.where(step > 0, old, low), np.where(step < 0, old, high)
            new = np.clip(old + step, low, high)
            y, to = np.arcsinh(old / scale), np.arcsinh(new / scale)
            # a step opposite to the previous step is at most half as long
            most = np.where(previous * (to - y) < 0, np.abs(previous) / 2, np.minimum(1.25 * most, FARTHEST))
            far = (np.abs(to - y) > most) & (np.minimum(y, to) < 0)
            previous = np.where(far, np.clip(to - y, -most, most), to - y)
            new = np.where(far, (scale * np.sinh(np.where(far, y + previous, 0.0))).clip(low, high), new)
            done = (balanced | (np.abs(new - old) <= SAME * (np.abs(old) + size))).all()
            p[:, inner] = np.where(balanced, old, new)
        raise NotConverged("soils in series: no solution for the pressure at their interface")

    def _flows(self, p: NDArray[np.float64]) -> _Flows:
        """Return the flows at the pressures (Pa) of the interfaces."""
        links = self._links
        ends = p[links.face, links.low], p[links.face, links.high]
        k, slopes = self._laws.between(links.law, ends, links.drop)
        difference, c = ends[0] - ends[1] + links.drop, links.conductance
        rounding = 4 * EPSILON * c * (k + EPSILON**2) * (np.abs(ends[0]) + np.abs(ends[1]) + np.abs(links.drop))
        own, other = np.maximum([k + difference * slopes[0], k - difference * slopes[1]], 0.0)
        return _Flows(c * k, c * own, c * other, c * k * difference, rounding)

    def _chain(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Select the `values` of segments in series, and return them as an array (faces, segments)."""
        starts = np.cumsum([0, *(count + 1 for count in self._counts)])
        number = [i for first, count in zip(starts, self._counts, strict=False) for i in range(first, first + count)]
        return np.stack([values[self._parts[i] : self._parts[i + 1]] for i in number], axis=1)

    def _step(self, flows: _Flows) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the Newton steps (Pa), and whether the flux is continuous within rounding."""
        links, shape = self._links, self._hydrostatic.shape

        def at(node: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.bincount(links.face * shape[1] + node, values, shape[0] * shape[1]).reshape(shape)[:, 1:-1]

        x = at(links.high, flows.flux) - at(links.low, flows.flux)
        balanced = np.abs(x) <= at(links.high, flows.rounding) + at(links.low, flows.rounding)
        diagonal = at(links.high, flows.other) + at(links.low, flows.own) + TINY
        own, other = (self._chain(values)[:, 1:-1] for values in (flows.own, flows.other))
        for i in range(x.shape[1] - 1):  # Thomas's algorithm
            share = own[:, i] / diagonal[:, i]
            diagonal[:, i + 1] = np.maximum(diagonal[:, i + 1] - share * other[:, i], EPSILON * diagonal[:, i + 1])
            x[:, i + 1] += share * x[:, i]
        x[:, -1] /= diagonal[:, -1]
        for i in range(x.shape[1] - 1)[::-1]:
            x[:, i] = (x[:, i] + other[:, i] * x[:, i + 1]) / diagonal[:, i]
        return x, balanced

    def _condensed(self, flows: _Flows) -> NDArray[np.float64]:
        """Return the result of `solved` from the flows through the segments."""
        out, part = None, 0
        rows = np.stack(flows[:3])
        for count in self._counts:
            path = None
            for i in range(part, part + count):
                path = _series(path, rows[:, self._parts[i] : self._parts[i + 1]])
            part += count + 1
            parallel = slice(self._parts[part - 1], self._parts[part])
            face = self._links.face[parallel]
            out = _series(out, path + np.stack([np.bincount(face, row[parallel], self._size) for row in rows]))
        return out


def _series(first: NDArray[np.float64] | None, second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the conductance and both slopes of two segments in series, see `Through`."""
    if first is None:
        return second
    (k, own, other), (after, owns, others) = first, second
    both = owns + other + TINY
    return np.stack([k * (after / (k + after + TINY)), own * (owns / both), other * (others / both)])
