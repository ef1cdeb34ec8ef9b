# SPDX-License-Identifier: MIT
"""Pressures of random bodies on random paths: no loss, no new extremes, and no change of linear fields."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import numbers, orders, repeatable, turned

import mpm_dolfinx as mpm
from mpm_dolfinx.domains.pressure_transport import CellPressures, PiecePressures, Reconstruction, transport
from mpm_dolfinx.points.cutting import Pieces, cut

# ---- random motions --------------------------------------------------------------------------------

AT_REST, CARRIED, STRETCHED, BENT = "at rest", "carried", "turned and stretched", "bent"


@dataclass
class Points:
    """Material points as far as pressures need them: their ids."""

    id: np.ndarray

    def __len__(self):
        return len(self.id)


@dataclass
class Motion:
    """Cells (d,), in m, points, pieces before and after the motion, in m, and random numbers."""

    h: np.ndarray
    points: Points
    before: Pieces
    x: np.ndarray
    after: Pieces
    random: np.random.Generator

    def brought(self, pressure, slope, bounds):
        """Return the values of the pieces after the motion, from those before (the tested code, called by name)."""
        old = self.before
        carried = PiecePressures(self.points.id[old.point], old.cell, old.fraction, pressure, self.x, slope, bounds)
        return transport(carried, self.points, self.after)

    def mean(self, values):
        """Return the mean of piece values before the motion, for each point."""
        return np.bincount(self.before.point, self.before.fraction * values)

    def ends(self, bounds):
        """Return the smallest and the largest bound of each point, for its pieces after the motion."""
        first = np.flatnonzero(np.diff(self.before.point, prepend=-1))
        low, high = np.minimum.reduceat(bounds[:, 0], first), np.maximum.reduceat(bounds[:, 1], first)
        return low[self.after.point], high[self.after.point]


@st.composite
def motions(draw, *kinds):
    """Draw a distorted body of some cells on a grid of any shape, in 2D or 3D, that moves over some cells."""
    d, kind = draw(st.sampled_from([2, 3])), draw(st.sampled_from(kinds))
    h, offset = orders(draw, -2, 2, d), orders(draw, -1, 2, d) * numbers(draw, -1, 1, d)
    grid = mpm.Grid(h * (offset - 8), h * (offset + 8), [16] * d)
    size = numbers(draw, 0.3, 4 if d == 2 else 2, d)
    body = mpm.box(grid, h * (offset - size / 2), h * (offset + size / 2), draw(st.integers(1, 2)))
    y = body.corners() / h - offset
    y = y + numbers(draw, -0.5, 0.5, d) + 0.15 * np.sin(y @ numbers(draw, -1, 1, d, d))

    way = numbers(draw, -2, 2, d) if kind != AT_REST else np.zeros(d)
    F, bend = np.eye(d), numbers(draw, -1, 1, d, d)
    if kind == STRETCHED:
        F = turned(draw, np.diag(numbers(draw, 0.7, 1.3, d)) + 0.2 * np.triu(bend, 1))

    def place(y):
        return h * (y @ F + way + (0.2 * np.sin(y @ bend) if kind == BENT else 0.0) + offset) - grid.base

    before = cut(grid, h * (y + offset) - grid.base)
    after = before if kind == AT_REST else cut(grid, place(y))
    points = Points(3 + np.cumsum(1 + np.arange(len(y)) % 3))  # some have gone to other processes
    return Motion(
        h,
        points,
        before,
        place((before.x + grid.base) / h - offset),
        after,
        np.random.default_rng(draw(st.integers(0, 2**32))),
    )


def anything(motion, wide):
    """Return pressures, slopes and bounds, which may equal the pressures; `wide` scales slopes and bounds."""
    random, of = motion.random, motion.before.point
    p = random.normal(size=len(of)) + 10 * random.normal(size=len(motion.points))[of]
    slope = wide * random.normal(size=motion.x.shape) / motion.h
    return p, slope, p[:, None] + wide * random.random((len(of), 2)) * [-1, 1]


@repeatable(80)
@given(motions(AT_REST, CARRIED, STRETCHED, BENT), st.sampled_from([0.0, 0.1, 3.0]))
def test_each_point_keeps_its_mean_pressure_whatever_the_motion(motion, wide):
    p, slope, bounds = anything(motion, wide)
    after = motion.brought(p, slope, bounds)
    mean = np.bincount(motion.after.point, motion.after.fraction * after)
    assert np.abs(mean - motion.mean(p)).max() < 1e-12 * np.abs(p).max()


@repeatable(20)
@given(motions(CARRIED))
def test_points_that_were_in_no_cell_yet_bring_their_own_pressure(motion):
    n = len(motion.points)
    p, x = motion.random.normal(size=n), motion.random.normal(size=(n, len(motion.h)))
    whole = Pieces(np.arange(n), np.full(n, -1), np.ones(n), x, np.zeros((n, len(motion.h), 2)), np.zeros((n, 0)))
    start = Motion(motion.h, motion.points, whole, x, motion.after, motion.random)
    assert (start.brought(p, np.zeros_like(x), np.stack([p, p], axis=1)) == p[motion.after.point]).all()


@repeatable(80)
@given(motions(CARRIED, STRETCHED, BENT), st.sampled_from([0.0, 0.1, 3.0]))
def test_no_piece_passes_what_some_part_of_its_point_may_have(motion, wide):
    p, slope, bounds = anything(motion, wide)
    after, (low, high) = motion.brought(p, 100 * slope, bounds), motion.ends(bounds)
    assert (after >= low - 1e-13 * np.abs(p).max()).all() and (after <= high + 1e-13 * np.abs(p).max()).all()


@repeatable(40)
@given(motions(AT_REST), st.sampled_from([0.0, 3.0]))
def test_where_nothing_moves_nothing_changes(motion, wide):
    p, slope, bounds = anything(motion, wide)
    assert np.abs(motion.brought(p, slope, bounds) - p).max() < 1e-12 * np.abs(p).max()


@repeatable(40)
@given(motions(CARRIED, STRETCHED, BENT))
def test_an_even_pressure_stays_even(motion):
    even, still = np.full(len(motion.x), 1e5), np.zeros_like(motion.x)
    _, slope, _ = anything(motion, 1e5)
    for s, room in ((still, 1e6), (slope, 0.0)):  # no slope, or no room for one
        assert motion.brought(even, s, even[:, None] + room * np.array([-1, 1])) == pytest.approx(1e5, rel=1e-13)


def linear(motion, room):
    """Return the exact values of a linear pressure after the motion, and the transported values."""
    slope, middle = motion.random.normal(size=motion.x.shape[1]) / motion.h, motion.x.mean(axis=0)
    p = (motion.x - middle) @ slope
    after = motion.brought(p, np.tile(slope, (len(p), 1)), np.tile([-room, room], (len(p), 1)))
    return (motion.after.x - middle) @ slope, after


@repeatable(60)
@given(motions(CARRIED, STRETCHED), st.sampled_from([np.inf, 1e9]))
def test_a_linear_pressure_is_carried_exactly(motion, room):
    exact, after = linear(motion, room)
    assert after == pytest.approx(exact, abs=1e-10)


@repeatable(40)
@given(motions(BENT), st.sampled_from([np.inf, 1e9]))
def test_a_linear_pressure_is_carried_exactly_but_for_the_means_of_points_that_bend(motion, room):
    """The centroids of points then differ slightly from the positions of their pieces; means are conserved."""
    exact, after = linear(motion, room)
    off = after - exact
    mean = np.bincount(motion.after.point, motion.after.fraction * off)
    assert off == pytest.approx(mean[motion.after.point], abs=1e-10)


@repeatable(40)
@given(motions(CARRIED, STRETCHED), st.sampled_from([0.0, 0.1, 3.0]))
def test_a_point_does_not_see_the_others(motion, wide):
    p, slope, bounds = anything(motion, wide)
    after, last = motion.brought(p, slope, bounds), len(motion.points) - 1
    old, new = motion.before.point == last, motion.after.point == last

    def only(pieces, rows):
        return Pieces(
            pieces.point[rows] - last, *(getattr(pieces, f)[rows] for f in ("cell", "fraction", "x", "faces", "mixed"))
        )

    pieces = only(motion.before, old), motion.x[old], only(motion.after, new)
    alone = Motion(motion.h, Points(motion.points.id[last:]), *pieces, motion.random)
    assert alone.brought(p[old], slope[old], bounds[old]) == pytest.approx(after[new], rel=1e-12, abs=1e-12)


# ---- reconstruction --------------------------------------------------------------------------------


@cache
def grid_of(*shape):
    grid = mpm.Grid([0] * len(shape), np.array([1.0, 3.0, 0.5])[: len(shape)], shape)
    return grid, Reconstruction(grid)


@dataclass
class Cells:
    """Cells of a grid with values p; centroids and origins, in cells, from the midpoints; open faces."""

    grid: mpm.Grid
    reconstruction: Reconstruction
    p: np.ndarray
    centroid: np.ndarray
    faces: np.ndarray
    origin: np.ndarray

    def slopes(self, p=None):
        """Return slopes (n, d), per cell, and bounds (n, 2) of all cells (the tested code, called by name)."""
        h, cells = self.grid.h, np.arange(self.grid.num_owned)
        p = self.p if p is None else p
        sealed = np.full((len(cells), len(h), 2, 2), np.nan)
        slope, bounds = self.reconstruction(
            CellPressures(cells, p, self.centroid * h, self.faces, sealed), self.origin * h
        )
        return slope * h, bounds

    @property
    def index(self):
        return np.stack(np.unravel_index(self.grid.cell_number, self.grid.shape), axis=1)

    def neighbours(self, cell):
        """Return (axis, +-1, neighbour) of the neighbours behind open faces of a cell."""
        index = self.index
        for axis in range(self.grid.dim):
            for end in (0, 1):
                beside = index[cell] + (2 * end - 1) * np.eye(self.grid.dim, dtype=int)[axis]
                for other in np.flatnonzero((index == beside).all(axis=1)):
                    if self.faces[cell, axis, end] > 0 and self.faces[other, axis, 1 - end] > 0:
                        yield axis, 2 * end - 1, other


@st.composite
def cells(draw):
    """Draw cells with random values, all different or some equal, with or without offset centroids and closed faces."""
    grid, reconstruction = grid_of(*draw(st.sampled_from([(5, 4), (1, 6), (3, 3, 4), (4, 1, 2)])))
    random, n, d = np.random.default_rng(draw(st.integers(0, 2**32))), grid.num_owned, grid.dim
    p = draw(st.sampled_from([random.normal(size=n), random.integers(-2, 3, size=n)])) * orders(draw, -6, 6)
    faces = random.random((n, d, 2)) * (random.random((n, d, 2)) >= draw(st.sampled_from([0.0, 0.2])))
    centroid, origin = draw(st.sampled_from([0.0, 0.2, 0.49])) * random.uniform(-1, 1, size=(2, n, d))
    return Cells(grid, reconstruction, p + orders(draw, -6, 6), centroid, faces, origin)


@repeatable(100)
@given(cells())
def test_a_reconstruction_keeps_between_the_extremes_of_the_cell_and_its_open_neighbours(scene):
    slope, bounds = scene.slopes()
    ends = np.abs(slope) / 2
    middle = scene.p - (slope * scene.origin).sum(axis=1)
    size = 1e-14 * np.abs(scene.p).max()
    for cell, p in enumerate(scene.p):
        values = [p, *(scene.p[other] for _, _, other in scene.neighbours(cell))]
        assert bounds[cell] == pytest.approx([min(values), max(values)], rel=0, abs=size)
        assert middle[cell] - ends[cell].sum() >= min(values) - size
        assert middle[cell] + ends[cell].sum() <= max(values) + size


def share(slope, origin, low, high):
    """Return the largest fraction of a slope that keeps the values in the cell between `low` and `high`, from p = 0."""
    ends = (np.array([-0.5, 0.5]) - origin[:, None]) * slope[:, None]
    reach = ends.min(axis=1).sum(), ends.max(axis=1).sum()
    return min(1.0, *(room / r for room, r in zip((low, high), reach, strict=True) if r))


@repeatable(100)
@given(cells())
def test_a_slope_is_the_harmonic_mean_of_those_to_both_neighbours_as_far_as_no_extreme_is_passed(scene):
    """The slope is zero if a neighbour is missing, or if the slopes to the two neighbours have different signs."""
    slope, bounds = scene.slopes()
    for cell, p in enumerate(scene.p):
        sides = np.zeros((scene.grid.dim, 2))
        for axis, way, other in scene.neighbours(cell):
            apart = 1 + way * (scene.centroid[other, axis] - scene.centroid[cell, axis])
            sides[axis, (way + 1) // 2] = way * (scene.p[other] - p) / apart
        mean = np.array([2 / (1 / a + 1 / b) if a * b > 0 else 0.0 for a, b in sides])
        mean *= share(mean, scene.origin[cell], *(bounds[cell] - p)) if mean.any() else 1.0
        assert slope[cell] == pytest.approx(mean, rel=1e-9, abs=1e-14 * np.abs(scene.p).max())


@repeatable(60)
@given(cells(), st.data())
def test_slopes_of_linear_values_are_exact_within_the_body_but_for_the_extremes(scene, data):
    """Planes of cells are filled alike. With centred centroids slopes are exact in 2D; in 3D, inclined, neighbours
    limit them.
    """
    d, index = scene.grid.dim, scene.index
    g, off = orders(data.draw, -2, 2, d) * data.draw(st.sampled_from([-1, 1])), numbers(data.draw, -0.4, 0.4, d, 8)
    off *= data.draw(st.integers(0, 1))
    scene.centroid = np.stack([off[a, index[:, a]] for a in range(d)], axis=1)
    scene.origin, scene.faces = scene.centroid, np.ones_like(scene.faces)
    p = (index + scene.centroid) @ g
    slope, _ = scene.slopes(p)
    for cell in np.flatnonzero(((index > 0) & (index < scene.grid.shape - 1)).all(axis=1)):
        rise = [p[other] - p[cell] for _, _, other in scene.neighbours(cell)]
        part = share(g, scene.origin[cell], min(rise), max(rise))
        assert slope[cell] == pytest.approx(part * g, rel=1e-9)
        assert part > 1 - 1e-12 or d == 3 or off.any()
