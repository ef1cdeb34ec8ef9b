# SPDX-License-Identifier: MIT
"""A body from a polygon with named edges, meshed with quadrilaterals by gmsh."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from inspect import signature
from threading import current_thread, main_thread

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.tolerances import ROUND_OFF
from mpm_dolfinx.base.validation import line, numbers, whole
from mpm_dolfinx.bodies.mesh_cells import AS_LATTICE
from mpm_dolfinx.bodies.meshes import Mesh, MeshBody, seeded
from mpm_dolfinx.grid.grid import Grid, begin_with, cross_in_plane


def polygon(
    grid: Grid,
    corners: ArrayLike,
    sides: Sequence[str] | str,
    *,
    holes: Mapping[str, ArrayLike] | None = None,
    size: float | None = None,
    per_cell: int = 2,
    material: int = 0,
) -> MeshBody:
    """Return a polygonal body, such as a slope or a soil layer, seeded with material points.  This function needs gmsh.

    Each soil layer is a separate polygon.  Adjacent polygons are bonded, and may have quadrilaterals of different size.

    Parameters
    ----------
    grid
        Background grid, in 2D.
    corners : (n, 2), m
        Corners in sequence, clockwise or counterclockwise.
    sides
        Name of the edge from each corner to the next, or "" for no name.  A single name applies to all edges.
    holes : name -> (k, 2), m
        Corners of each hole, such as a tunnel.  The boundary of a hole is one side with the name of the hole.
    size
        Edge length of the quadrilaterals, m.  By default the cell size divided by `per_cell`.
    per_cell, material
        As for `from_mesh`.

    Raises
    ------
    ImportError
        gmsh is missing.
    ValueError
        A polygon or hole crosses itself or another outline, or leaves the grid.  The number of side names is wrong.
    """
    begin_with("body: grid", grid)
    if grid.dim != 2:
        raise ValueError(f"polygon: the grid has {grid.dim} dimensions, must have 2; in 3D, use `from_mesh`")
    outline = _outline("corners", corners)
    sides = [sides] * len(outline) if isinstance(sides, str) else sides
    if not isinstance(sides, Sequence) or len(sides) != len(outline) or not all(isinstance(s, str) for s in sides):
        raise ValueError(
            f"polygon: sides = {line(sides)}, must be a name for each of {len(outline)} edges, or one name for all"
        )
    if not isinstance(holes or {}, Mapping) or not all(isinstance(name, str) for name in holes or {}):
        raise ValueError(f"polygon: holes = {line(holes)}, must map the name of each hole's side to the hole's corners")
    loops = [(outline, sides)]
    for name, inner in (holes or {}).items():
        inner = _outline(f"hole {name!r}", inner)
        loops.append((inner, [name] * len(inner)))
    if size is None and not grid.even:
        raise ValueError("polygon: size = None, must be a length in m, because the grid has unequal cells")
    default = grid.least / whole("body: per_cell", per_cell)
    edge = float(numbers("polygon: size", default if size is None else size, test=lambda v: (v > 0) & np.isfinite(v)))
    _check_simple([corners for corners, _ in loops])
    how = {"per_cell": per_cell, "material": material, "warns": size is not None}
    return seeded(grid, lambda: _filled(loops, edge), "polygon", **how)


def _outline(name: str, corners: ArrayLike) -> NDArray[np.float64]:
    """Return the corners of an outline, or raise ValueError if two neighbouring corners coincide."""
    allowed = "at least 3 corners of 2 finite coordinates each, without equal neighbours"
    x = numbers(f"polygon: {name}", corners, None, allowed=allowed)
    if x.ndim != 2 or x.shape[1] != 2 or len(x) < 3 or not np.any(np.roll(x, -1, axis=0) != x, axis=1).all():
        raise ValueError(f"polygon: {name} = {line(corners)} of shape {x.shape}, must be {allowed}")
    return x


def _check_simple(outlines: Sequence[NDArray[np.float64]]) -> None:
    """Raise an error for outlines that cross themselves or each other, and for holes outside the polygon."""
    a, stop = np.concatenate(outlines), np.cumsum([len(x) for x in outlines])
    after = np.concatenate([np.roll(rows, -1) for rows in np.split(np.arange(len(a)), stop[:-1])])
    b = a[after]
    i, j = np.triu_indices(len(a), 1)
    adjacent = (after[i] == j) | (after[j] == i)
    # two edges intersect unless both ends of one edge lie on the same side of the other
    slack = ROUND_OFF * np.ptp(outlines[0], axis=0).max() ** 2
    sides = [_areas(a[i], b[i], a[j]), _areas(a[i], b[i], b[j]), _areas(a[j], b[j], a[i]), _areas(a[j], b[j], b[i])]
    separate = np.any([(np.minimum(*s) > slack) | (np.maximum(*s) < -slack) for s in (sides[:2], sides[2:])], axis=0)
    low, high = np.minimum(a, b), np.maximum(a, b)
    separate |= ((low[i] > high[j]) | (low[j] > high[i])).any(axis=1)  # collinear edges
    folded = adjacent & (np.abs(np.where(after[i] == j, sides[1], sides[0])) <= slack)
    folded &= np.einsum("nd,nd->n", b[i] - a[i], b[j] - a[j]) < 0
    crossing = np.flatnonzero((~separate & ~adjacent) | folded)
    if len(crossing):
        one, other = ([a[k[crossing[0]]].tolist(), b[k[crossing[0]]].tolist()] for k in (i, j))
        raise ValueError(f"polygon: the edges {one} and {other} touch or cross, must be apart")
    for k, hole in enumerate(outlines[1:], start=1):
        within = [_inside(hole[0], outline) for m, outline in enumerate(outlines) if m != k]
        if not within[0] or any(within[1:]):
            raise ValueError(f"polygon: the hole at {hole[0]} must be inside the polygon, and outside other holes")


def _areas(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the signed areas of the parallelograms (b - a, c - a), positive for counterclockwise corners."""
    return cross_in_plane(b - a, c - a)


def _inside(x: NDArray[np.float64], outline: NDArray[np.float64]) -> bool:
    """Return whether a position is inside a polygon."""
    a, b = outline - x, np.roll(outline, -1, axis=0) - x
    crosses = (a[:, 1] > 0) != (b[:, 1] > 0)
    return bool((crosses & ((cross_in_plane(a, b) > 0) == (b[:, 1] > a[:, 1]))).sum() % 2)


@contextmanager
def _gmsh() -> Iterator:
    """Provide gmsh with a new model.  Restore the user's gmsh state on exit."""
    main = current_thread() is main_thread()  # other threads may not set handlers
    handler = signal.getsignal(signal.SIGINT)
    try:
        import gmsh
    except ImportError as error:
        what = "polygon: needs gmsh: on Debian `apt install python3-gmsh`, elsewhere `conda install python-gmsh`"
        raise ImportError(what, name="gmsh") from error
    reports = hasattr(gmsh, "isInitialized")  # missing before 4.9: then initialise again and never finalise
    running, verbosity = reports and gmsh.isInitialized(), 0.0
    if running or not reports:
        with suppress(Exception):  # before 4.9 this raises after an earlier finalisation
            verbosity = gmsh.option.getNumber("General.Terminal")
            gmsh.option.setNumber("General.Terminal", 0)  # hides the message about the second initialisation
    if not running:
        interruptible = {"interruptible": main} if "interruptible" in signature(gmsh.initialize).parameters else {}
        gmsh.initialize(**interruptible)
    before = gmsh.model.getCurrent()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("mpm_dolfinx polygon")
        yield gmsh
    finally:
        gmsh.model.remove()
        gmsh.model.setCurrent(before)
        gmsh.option.setNumber("General.Terminal", verbosity)
        if reports and not running:
            gmsh.finalize()
        if main and handler is not None:
            signal.signal(signal.SIGINT, handler)


def _filled(loops: Sequence[tuple[NDArray[np.float64], Sequence[str]]], size: float) -> Mesh:
    """Return the mesh of a polygon with holes, mostly of quadrilaterals with edge length `size`."""
    extent = np.ptp(loops[0][0], axis=0).max()
    origin = extent * np.round(loops[0][0][0] / extent, -2)  # gmsh aborts at large coordinates
    with _gmsh() as gmsh:
        geo = gmsh.model.geo
        named = {}
        curves = []
        for corners, names in loops:
            points = [geo.addPoint(*x, 0.0, size) for x in corners - origin]
            lines = [geo.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
            curves.append(geo.addCurveLoop(lines))
            for tag, name in zip(lines, names, strict=True):
                named.setdefault(name, []).append(tag)
        surface = geo.addPlaneSurface(curves)
        geo.synchronize()
        gmsh.model.mesh.setRecombine(2, surface)  # triangles, divided into three, have less accurate stresses
        gmsh.model.mesh.generate(2)
        tags, x, _ = gmsh.model.mesh.getNodes()
        number = np.zeros(int(max(tags, default=0)) + 1, dtype=np.int64)
        number[tags] = np.arange(len(tags))
        triangles, squares = (number[gmsh.model.mesh.getElementsByType(k)[1]].reshape(-1, k + 1) for k in (2, 3))
        cells = {"triangle": triangles, "quad": squares[:, AS_LATTICE["quad"]]}
        sides = {
            name: [number[gmsh.model.mesh.getElementsByType(1, tag)[1]].reshape(-1, 2) for tag in lines]
            for name, lines in named.items()
            if name
        }
    return Mesh(origin + x.reshape(-1, 3)[:, :2], {kind: rows for kind, rows in cells.items() if len(rows)}, {}, sides)
