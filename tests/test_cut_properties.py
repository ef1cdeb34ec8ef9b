# SPDX-License-Identifier: MIT
"""The cut of any domain by any grid equals independent clippings, which are exact in 2D."""

from dataclasses import fields
from fractions import Fraction
from itertools import pairwise, product
from math import ceil, factorial, floor

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BSpline
from strategies import numbers, orders, repeatable, turned

from mpm_dolfinx import Grid
from mpm_dolfinx.points.cutting import Pieces, centroids, cut, cut_faces, parallelepipeds

SNAP = 1e-10  # cells: a vertex that is nearer to a grid plane is taken to lie on it
LOST = 5e-12  # share of a domain, or of a face, in slivers that are left out
BITS = {d: np.arange(2**d)[:, None] >> np.arange(d) & 1 for d in (1, 2, 3)}  # ends of the corners along the axes
RING = [0, 1, 3, 2]  # corners of a quadrilateral, counterclockwise


def triangles(face):
    """Return the triangles of a face (4, e) about its midpoint."""
    ring = face[RING]
    return [np.stack([a, b, face.mean(axis=0)]) for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)]


def tetrahedra_of(y):
    """Return the tetrahedra of a hexahedron (8, 3), between its midpoint and the triangles of its faces."""
    faces = [y[BITS[3][:, axis] == end] for axis in range(3) for end in (0, 1)]
    return [np.vstack([triangle, y.mean(axis=0)]) for face in faces for triangle in triangles(face)]


# ---- random domains --------------------------------------------------------------------------------


NEAR = st.sampled_from([sign * e for e in (0, 1e-12, 1e-11, 9e-11, 1.2e-10, 2.5e-10, 1e-9, 1e-7) for sign in (1, -1)])
"""How far a vertex may be from a grid plane that it is near to, cells."""


def put_near_planes(draw, y, near=NEAR):
    """Return corners y (k, d), in cells, after translations that put one corner near a plane, and one other corner."""
    corner = st.integers(0, len(y) - 1)
    for axis in range(y.shape[1]):
        if draw(st.booleans()):
            at = y[draw(corner), axis]
            y[:, axis] += np.rint(at) + draw(near) - at
        if draw(st.booleans()):
            at = draw(corner)
            y[at, axis] = np.rint(y[at, axis]) + draw(near)
    return y


def in_a_grid(draw, y):
    """Return a grid, and positions y (k, d), in cells, as positions in m. The grid may be just large enough."""
    d = y.shape[1]
    y = y - np.floor(y.min(axis=0) + SNAP / 2) + draw(st.integers(0, 2))
    shape = np.ceil(y.max(axis=0) - SNAP / 2).astype(int).clip(1) + draw(st.integers(0, 2))
    h = orders(draw, -3, 3, d)
    lower = h * orders(draw, -2, 4, d) * numbers(draw, -1, 1, d)
    grid = Grid(lower, lower + h * shape, shape)
    return grid, grid.low + y * grid.h


@st.composite
def quadrilaterals(draw):
    """Draw a grid and a convex quadrilateral (4, 2), in m: four points of an ellipse, or a box, of any size and
    thickness.
    """
    y = BITS[2] - 0.5
    if draw(st.booleans()):
        angle = np.pi / 4 * np.array([-3, -1, 3, 1]) + numbers(draw, -0.7, 0.7, 4)
        y = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    size = orders(draw, -5, 0.9) * np.roll([1.0, orders(draw, -7, 0)], draw(st.integers(0, 1)))
    grid, corners = in_a_grid(draw, put_near_planes(draw, numbers(draw, 0, 1, 2) + turned(draw, y * size)))
    ring = exact(corners)
    assume(all(turn(ring[k - 2], ring[k - 1], ring[k]) > 0 for k in range(4)))
    return grid, corners


def turn(a, b, c):
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])


@st.composite
def hexahedra(draw, near=NEAR, folds=False):
    """Draw a grid and a slightly distorted hexahedron (8, 3), in m, without flat or inverted Kuhn tetrahedra."""
    y = BITS[3] - 0.5 + numbers(draw, 0, 0.15) * numbers(draw, -1, 1, 8, 3)
    if folds and draw(st.booleans()):
        corner = draw(st.integers(0, 7))
        y[corner] += numbers(draw, 0, 1) * (y[7 - corner] - y[corner])
    y = numbers(draw, 0, 1, 3) + turned(draw, y * orders(draw, -4, 0.4) * orders(draw, -2, 0, 3))
    grid, corners = in_a_grid(draw, put_near_planes(draw, y, near))
    y = snapped(grid, corners)
    volumes, of_a_box = (np.array([volume(t) for t in tetrahedra_of(1.0 * x)]) for x in (y, BITS[3]))
    volumes *= np.sign(of_a_box)
    assume((np.abs(volumes) if folds else volumes).min() > 1e-2 * volumes.max())
    return grid, corners


@st.composite
def dented(draw):
    """Draw a grid and a box with sides on its planes and one displaced corner; three corners of its face stay on the
    plane.
    """
    y, corner, axis = 0.5 + 1.0 * BITS[3], draw(st.integers(0, 7)), draw(st.integers(0, 2))
    y[:, axis] += 0.5
    y[corner, axis] += (2 * BITS[3][corner, axis] - 1) * numbers(draw, 0.1, 0.9)
    return in_a_grid(draw, y)


# ---- what is compared ------------------------------------------------------------------------------


def snapped(grid, corners):
    """Return corners, in cells, with coordinates near a grid plane moved to this plane."""
    y = (corners - grid.low) / grid.h
    return np.where(np.abs(y - np.rint(y)) < grid.snap, np.rint(y), y)


def error(grid, corners):
    """Return the allowed error of `snapped`, in cells: from rounding, or from a different decision to snap a corner."""
    rounding = 1e-15 * (1 + ((np.abs(corners) + np.abs(grid.low)) / grid.h).max())
    distance = np.abs((corners - grid.low) / grid.h - snapped(grid, corners))
    return rounding + (grid.snap * (np.abs(distance - grid.snap) < rounding)).max()


def pieces(grid, *domains):
    """Return {cell: (fraction, centroid, faces)} of the last domain, in cells; centroids are relative to the cell's
    corner.
    """
    p = cut(grid, np.stack(domains))
    assert (np.diff(p.point * grid.shape.prod() + p.cell) > 0).all() and len(np.unique(p.point)) == len(domains)
    p = Pieces(*(getattr(p, f.name)[p.point == len(domains) - 1] for f in fields(Pieces)))
    assert (p.fraction > 0).all() and (p.fraction <= 1).all() and abs(p.fraction.sum() - 1) < 1e-13
    index = np.stack(np.unravel_index(p.cell, grid.shape), axis=1)
    assert (grid.index_from_base(p.x) == index).all(), "a centroid lies in another cell"
    x, faces = (p.x - grid.low) / grid.h - index, p.faces * (grid.h / grid.cell_volume)[:, None]
    return {tuple(i): row for i, *row in zip(index.tolist(), p.fraction, x, faces, strict=True)}


def agree(found, parts, total, slack):
    """Assert that the pieces have the fractions and the moments of {cell: (volume, moment)}."""
    nothing = 0.0, np.zeros(len(next(iter(found))))
    for cell in found.keys() | parts.keys():
        fraction, x = found.get(cell, nothing)[:2]
        v, moment = parts.get(cell, nothing)
        assert abs(fraction - v / total) < slack, cell
        assert np.abs(fraction * x - moment / total).max() < slack, cell


def span(vertices, axis):
    """Return the cells along an axis that contain vertices (in cells), or have a side on which all vertices lie."""
    low, high = (extreme(v[axis] for v in vertices) for extreme in (min, max))
    return range(floor(low), max(ceil(high), floor(low) + 1))


# ---- 2D: polygons of exact fractions ---------------------------------------------------------------


def exact(y):
    return [[Fraction(x) for x in y[k].tolist()] for k in RING]


def edges(polygon):
    return list(zip(polygon, polygon[1:] + polygon[:1], strict=True))


def clipped(polygon, axis, low):
    """Return the part of a convex polygon in the cells `low` along an axis (Sutherland and Hodgman 1974)."""
    for plane, side in ((low, 1), (low + 1, -1)):
        part = []
        for a, b in edges(polygon):
            da, db = side * (a[axis] - plane), side * (b[axis] - plane)
            if da >= 0:
                part.append(a)
            if da * db < 0:
                part.append([x + (w - x) * da / (da - db) for x, w in zip(a, b, strict=True)])
        polygon = part
    return polygon


def area_and_moment(polygon):
    """Return the area of a polygon and its first moments, by the shoelace formula."""
    twice = [a[0] * b[1] - a[1] * b[0] for a, b in edges(polygon)]
    moment = [sum(w * (a[k] + b[k]) for w, (a, b) in zip(twice, edges(polygon), strict=True)) / 6 for k in (0, 1)]
    return sum(twice) / 2, moment


def parts_of_polygon(polygon):
    """Return {cell: (area, moment about the cell's lower corner)}."""
    out = {}
    for i in span(polygon, 0):
        strip = clipped(polygon, 0, i)
        for j in span(strip, 1):
            area, moment = area_and_moment([[x - i, y - j] for x, y in clipped(strip, 1, j)])
            out[i, j] = float(area), np.array(moment, dtype=float)
    return out


def conditioned(polygon, slack):
    """Return area, perimeter and centroid of a polygon, without vertices that small displacements hardly change."""
    area, moment = area_and_moment(polygon)
    perimeter = sum(np.hypot(*(float(x - w) for x, w in zip(a, b, strict=True))) for a, b in edges(polygon))
    assume(slack * perimeter < 1e-3 * area)
    return float(area), perimeter, np.array([float(m / area) for m in moment])


@repeatable(150)
@given(quadrilaterals())
def test_a_quadrilateral_has_the_pieces_of_the_exact_clipping(scene):
    grid, corners = scene
    found, slack, polygon = pieces(grid, corners), error(grid, corners), exact(snapped(grid, corners))
    area, perimeter, _ = conditioned(polygon, slack)
    agree(found, parts_of_polygon(polygon), area, LOST + 4 * slack * perimeter / area)


@repeatable(100)
@given(quadrilaterals())
def test_the_pieces_of_a_quadrilateral_together_have_its_centroid(scene):
    grid, corners = scene
    y, p = (corners - grid.low) / grid.h, cut(grid, corners[None])
    slack = error(grid, corners) + np.abs(y - snapped(grid, corners)).max()
    area, perimeter, centroid = conditioned(exact(y), slack)
    off = (p.fraction @ p.x - grid.low) / grid.h - centroid
    assert np.abs(off).max() < LOST + 4 * slack * perimeter / area * max(1, perimeter)


@repeatable(50)
@given(st.lists(quadrilaterals(), min_size=2, max_size=4))
def test_a_domain_is_cut_among_others_as_by_itself(scenes):
    grid = Grid([0, 0], [14.0, 14.0], [14, 14])
    domains = [(corners - own.lower) / own.h for own, corners in scenes]
    alone, among, slack = pieces(grid, domains[-1]), pieces(grid, *domains), error(grid, domains[-1])
    area, perimeter, _ = conditioned(exact(domains[-1]), slack)
    agree(alone, {cell: (v, v * x) for cell, (v, x, _) in among.items()}, 1.0, LOST + slack * perimeter / area)


def section(polygon, axis, plane):
    """Return the section of a convex polygon with a line as an interval, or None without intersection."""
    other, cuts = 1 - axis, [v[1 - axis] for v in polygon if v[axis] == plane]
    for a, b in edges(polygon):
        if (a[axis] - plane) * (b[axis] - plane) < 0:
            cuts.append(a[other] + (b[other] - a[other]) * (plane - a[axis]) / (b[axis] - a[axis]))
    return (min(cuts), max(cuts)) if cuts else (0, 0)


def beside(polygon, axis, plane):
    """Return the length of the outline near a line but not on it, projected on the line; flat parts count as on the
    line.
    """
    out = 0.0
    for a, b in edges(polygon):
        low, high = sorted([float(a[axis] - plane), float(b[axis] - plane)])
        band = np.clip(high, -3 * SNAP, 3 * SNAP) - np.clip(low, -3 * SNAP, 3 * SNAP)
        share = band / (high - low) if low < high else 0 < abs(low) < 3 * SNAP
        out += share * abs(float(a[1 - axis] - b[1 - axis]))
    return out


@repeatable(120)
@given(quadrilaterals(), st.sampled_from([0, 1]))
def test_the_open_faces_of_a_quadrilateral_are_the_sections_of_the_polygon(scene, axis):
    grid, corners = scene
    found, slack, polygon = pieces(grid, corners), error(grid, corners), exact(snapped(grid, corners))
    area, perimeter, _ = conditioned(polygon, slack)
    shift, at = slack * perimeter**2 / area, [v[axis] for v in polygon]  # of a section, by vertices off by the slack
    for cell, (_, _, faces) in found.items():
        for end in (0, 1):
            plane = cell[axis] + end
            depth = float(min(plane - min(at), max(at) - plane))
            if not 0 < depth < 3 * shift:
                low, high = section(polygon, axis, plane)
                length = max(0.0, float(min(high, cell[1 - axis] + 1) - max(low, cell[1 - axis])))
                off = 2 * slack + (shift * (1 + perimeter / depth) if depth > 0 else 0) + beside(polygon, axis, plane)
                assert abs(faces[axis, end] - length) <= 1e-14 + off, (cell, end)


# ---- 3D: tetrahedra, cut into tetrahedra -----------------------------------------------------------


def volume(t):
    return np.linalg.det(t[1:] - t[:1]) / 6


def prism(p, q):
    """Return the three tetrahedra of a prism between two triangles."""
    return [np.array([*p[: k + 1], *q[k:]]) for k in range(3)]


def between(tetrahedra, axis, low):
    """Return tetrahedra that fill the part of given tetrahedra in the cells `low` along an axis."""
    for plane, side in ((low, 1), (low + 1, -1)):
        parts = []
        for t in tetrahedra:
            t = t[np.argsort(-side * t[:, axis])]
            depth = side * (t[:, axis] - plane)
            k = int((depth > 0).sum())  # vertices inside, the first ones
            share = depth[:k, None] / (depth[:k, None] - depth[k:])
            meet = t[:k, None] + (t[None, k:] - t[:k, None]) * share[:, :, None]
            if k == 1:
                parts.append(np.array([t[0], *meet[0]]))
            elif k == 2:
                parts += prism([t[0], *meet[0]], [t[1], *meet[1]])
            elif k == 3:
                parts += prism(t[:3], meet[:, 0])
            elif k == 4:
                parts.append(t)
        tetrahedra = parts
    return tetrahedra


def columns(tetrahedra, axes):
    """Return {cell: parts in the cell}, cut along some of the axes only."""
    out = {(): tetrahedra}
    for axis in range(3):
        out = {
            (*cell, i): part
            for cell, whole in out.items()
            for i in span(np.concatenate(tetrahedra), axis)
            if (part := between(whole, axis, i) if axis in axes else whole)
        }
    return out


@repeatable(80)
@given(hexahedra(folds=True))
def test_a_hexahedron_has_the_pieces_of_its_tetrahedra(scene):
    """Inverted tetrahedra count as negative. Pieces with a sign other than that of the whole are excluded."""
    grid, corners = scene
    found, y, slack, parts = pieces(grid, corners), snapped(grid, corners), error(grid, corners), {}
    for whole, upright in zip(tetrahedra_of(y), tetrahedra_of(1.0 * BITS[3]), strict=True):
        sign = np.sign(volume(whole) * volume(upright))
        for cell, tetrahedra in columns([whole], (0, 1, 2)).items():
            volumes = sign * np.abs([volume(t) for t in tetrahedra])
            v, moment = parts.get(cell, (0.0, 0.0))
            parts[cell] = v + volumes.sum(), moment + volumes @ [t.mean(axis=0) - cell for t in tetrahedra]
    net, both = sum(v for v, _ in parts.values()), sum(abs(v) for v, _ in parts.values())
    assume(abs(net) > 1e-2 * both)
    of = {cell: (np.sign(net) * v, moment / (v or 1)) for cell, (v, moment) in parts.items()}
    parts = {cell: (v, v * np.clip(x, SNAP, 1 - SNAP)) for cell, (v, x) in of.items() if v > 0}
    total, extent = sum(v for v, _ in parts.values()), np.ptp(y, axis=0)
    surface = 2 * sum(extent[a - 1] * extent[a] for a in range(3))
    assume(slack * surface < 1e-3 * total)
    agree(found, parts, total, LOST + 10 * slack * surface / total)


@repeatable(70)
@given(hexahedra(near=st.just(0.0)) | dented(), st.sampled_from([0, 1, 2]))
def test_the_open_faces_of_a_hexahedron_are_the_sections_of_its_tetrahedra(scene, axis):
    """The section of a tetrahedron is its volume times the B-spline of its vertices' heights (Curry and Schoenberg
    1966).
    """
    grid, corners = scene
    found, y, off = pieces(grid, corners), snapped(grid, corners), 1e-11  # how far within the cell a section is taken
    distance, extent = np.abs(y[:, axis] - np.rint(y[:, axis])), np.ptp(y, axis=0)
    distance = distance[distance > 0].min(initial=0.5)
    assume(distance > 1e-3 * extent[axis])
    column = columns(tetrahedra_of(y), {0, 1, 2} - {axis})
    for cell, (_, _, faces) in found.items():
        for end in (0, 1):
            plane, area = cell[axis] + (1 - off if end else off), 0.0
            for t in column[cell]:
                heights = np.sort(t[:, axis])
                if heights[0] < plane < heights[-1]:
                    area += abs(volume(t)) * 3 / np.ptp(heights) * BSpline.basis_element(heights)(plane)
            slack = 10 * (error(grid, corners) + off) / distance * extent.prod() / extent[axis]
            assert abs(faces[axis, end] - area) < slack, (cell, end)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("gap", [0, 1e-12, 9e-11, 4e-10, 1e-9, 1e-7, 1e-3])
def test_a_face_is_open_where_the_body_is_no_further_from_it_than_the_snap(d, gap):
    """From above and from below, on both sides of the middle plane."""
    grid, open_ = Grid([0] * d, [2.0] * d, [2] * d), float(gap < SNAP)
    for axis in range(d):
        above, below = BITS[d] * 0.5 + 0.2, BITS[d] * 0.5 + 0.2
        above[:, axis], below[:, axis] = 1 + gap + 0.5 * BITS[d][:, axis], 1 - gap - 0.5 * BITS[d][:, axis][::-1]
        for corners, end in ((above, 0), (below, 1)):
            faces = cut(grid, corners[None]).faces[0, axis] / 0.5 ** (d - 1)
            assert faces[end] == pytest.approx(open_, abs=1e-9) and abs(faces[1 - end]) < 1e-9


# ---- faces -----------------------------------------------------------------------------------------


@st.composite
def surfaces(draw, d):
    """Draw a grid, the corners (2^(d-1), d), in m, of a plane or warped face of a domain, and a face of a unit cube."""
    local = np.insert(BITS[d - 1].astype(float), draw(st.integers(0, d - 1)), draw(st.integers(0, 1)), axis=1)
    y = (local - 0.5 + numbers(draw, -0.2, 0.2, *local.shape)) * orders(draw, -4, 0.5) * orders(draw, -3, 0, d)
    return *in_a_grid(draw, put_near_planes(draw, numbers(draw, 0, 1, d) + turned(draw, y))), local


def squares(simplices, d):
    """Return the integrals of z z^T, z = (1, ...), over simplices, which have their size in the last d coordinates."""
    out = np.zeros((2 * d + 1, 2 * d + 1))
    for z in (np.insert(s, 0, 1.0, axis=1) for s in simplices):
        e = z[1:, -d:] - z[0, -d:]
        size = np.linalg.norm(np.cross(*e) if d == 3 else e)
        out += size * (z.T @ z + np.outer(z.sum(axis=0), z.sum(axis=0))) / (d * (d + 1))
    return out / factorial(d - 1)


def parts_of_simplices(simplices, d):
    """Return {cell: segments or triangles that fill the part in the cell}; the first d coordinates are in cells."""
    out = {}
    for simplex in simplices:
        for cell in product(*(span(simplex, axis) for axis in range(d))):
            part = simplex.tolist()
            for axis in range(d):
                part = clipped(part, axis, cell[axis])
            if part and d == 2:
                out.setdefault(cell, []).append(
                    np.array([min(part, key=lambda v: v[2:]), max(part, key=lambda v: v[2:])])
                )
            elif part:
                out.setdefault(cell, []).extend(np.array([part[0], *two]) for two in pairwise(part[1:]))
    return out


@pytest.mark.parametrize("d", [2, 3])
def test_points_on_a_face_integrate_what_is_quadratic_in_each_cell(d):
    @repeatable(70)
    @given(surfaces(d))
    def check(scene):
        grid, corners, local = scene
        face, x, xi, share, middle = cut_faces(grid, corners[None], local[None])
        assert (face == 0).all() and (share > 0).all() and abs(share.sum() - 1) < LOST
        at, middle = (x - grid.low) / grid.h, (middle - grid.low) / grid.h
        z = np.hstack([np.ones((len(x), 1)), at, xi])
        slack = 10 * (error(grid, corners) + LOST) * (1 + np.abs(z).max() ** 2)
        both = np.hstack([snapped(grid, corners), local])
        whole = triangles(both) if d == 3 else [both]
        assert np.abs(z.T @ (share[:, None] * z) - squares(whole, d)).max() < slack
        if (np.abs(middle - np.rint(middle)) < 1e-9).any():
            return  # it lies in a grid plane, and in the cell on either side
        assert (np.abs(at - np.floor(middle) - 0.5) < 0.5 + 1e-9).all(), "a point is not where its middle is"
        for cell, parts in parts_of_simplices(whole, d).items():
            here = (np.floor(middle) == cell).all(axis=1)
            assert np.abs(z[here].T @ (share[here, None] * z[here]) - squares(parts, d)).max() < slack, cell

    check()


@pytest.mark.parametrize("order", [(1, 0, 2), (0, 2, 1), (2, 1, 0)])
def test_points_on_a_face_do_not_tell_which_axis_was_cut_first(order):
    """In an earlier version, a tool pressure in 3D that is not a polynomial depended on the order of the axes."""

    order, rng = list(order), np.random.default_rng(0)
    grid, waves = Grid([0, 0, 0], [3.0, 4.0, 5.0], [3, 5, 4]), np.array([2.0, 3.0, 4.0])
    turned = Grid(grid.lower[order], grid.upper[order], grid.shape[order])
    local = np.tile(np.insert(BITS[2].astype(float), 2, 1, axis=1), (300, 1, 1))
    corners = (local - 0.5 + rng.uniform(-0.1, 0.1, local.shape)) @ np.linalg.qr(rng.normal(size=(300, 3, 3)))[0]
    corners += rng.uniform(1, 2, (300, 1, 3))

    def integrals(grid, corners, local, waves):
        face, x, _, share, _ = cut_faces(grid, corners, local)
        return np.bincount(face, share * np.cos(x @ waves))

    other = integrals(turned, corners[:, :, order], local[:, :, order], waves[order])
    assert integrals(grid, corners, local, waves) == pytest.approx(other, abs=1e-12)


def test_pieces_in_3d_have_the_moments_of_products_of_what_they_are():
    """The moments of a rotated box equal the sums over its eight parts in each cell."""
    rng = np.random.default_rng(0)
    grid, F = Grid([0, 0, 0], [3.0, 2.0, 4.0], [3, 4, 5]), np.eye(3) + 0.3 * rng.normal(size=(3, 3))
    x, whole = np.array([[1.4, 1.1, 1.9]]), np.full((1, 3), 0.7)
    parts = x + 0.25 * 0.7 * (2 * BITS[3] - 1) @ F.T
    found = []
    for middle, size in ((x, whole), (parts, np.repeat(whole / 2, 8, axis=0))):
        p = cut(grid, parallelepipeds(middle, np.repeat(F[None], len(middle), axis=0), size))
        weight, y = p.fraction / len(middle), p.x - x
        moments = [p.mixed[:, a] + y[:, a - 2] * y[:, a - 1] for a in range(3)]
        found.append([np.bincount(p.cell, weight * m, grid.shape.prod()) for m in moments])
        assert len(np.unique(p.cell)) == 8
    assert found[0] == pytest.approx(np.array(found[1]), abs=1e-14) and np.abs(found[0]).max() > 1e-3


@pytest.mark.parametrize("off", [1e-11, -1e-11])
def test_a_face_whose_middle_lies_on_a_plane_within_rounding_has_the_points_of_one_where_it_does(off):
    """A corner on a plane through the midpoint gave other triangles, which changed a contact by 3e-4."""
    grid = Grid([0] * 3, [4] * 3, [4] * 3)
    local = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]])

    def points(off):
        corners = np.array([[[0.7, 0.3, 0.2], [0.75, 0.9, 0.3], [1.25, 0.35, 0.15], [1.3, 0.8, 0.4]]])
        corners[..., 0] += off
        _, x, _, share, _ = cut_faces(grid, corners, local)
        x, share = x[share > 1e-8], share[share > 1e-8]
        order = np.lexsort(x.round(6).T)
        return np.column_stack([x, share])[order]

    assert points(off) == pytest.approx(points(0.0), rel=0, abs=10 * abs(off))


@pytest.mark.parametrize("d", [2, 3])
def test_centroids_of_partly_inverted_domains_lie_within_their_corners(d):
    corners = np.random.default_rng(d).uniform(size=(1000, 2**d, d))
    x = centroids(corners, within=True)
    assert np.all((corners.min(axis=1) <= x) & (x <= corners.max(axis=1)))
