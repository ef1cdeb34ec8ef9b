# SPDX-License-Identifier: MIT
"""Checks that the parts of a scene fit together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.base.validation import all_of, check_names, flag, functions, instance, line, numbers
from mpm_dolfinx.bodies.bodies import Body, Later, Moving, check_bodies
from mpm_dolfinx.conditions.conditions import OnSide
from mpm_dolfinx.grid.grid import Grid, begin_with
from mpm_dolfinx.materials.skeleton import Fluid, Skeleton
from mpm_dolfinx.parallel.messages import ConditionWarning, ResolutionWarning, warn


def checked_parts(
    grid: Grid, bodies: Sequence[Body | Later], materials: Sequence[Skeleton]
) -> tuple[list[Body], list[int]]:
    """Return the bodies, and indices of bodies absent in the first stage. Raise ValueError for invalid arguments."""
    begin_with("grid", grid)
    all_of("bodies", bodies, (Body, Later), 1)
    all_of("materials", materials, Skeleton, 1)
    later = [i for i, body in enumerate(bodies) if isinstance(body, Later)]
    bodies = [body.body if isinstance(body, Later) else body for body in bodies]
    check_bodies(grid, bodies)
    for i, one in enumerate(materials):
        friction = getattr(one, "friction", None)
        if not (friction is None or callable(friction)) and 0 < np.max(friction) < 1:
            what = "material %d: friction = %.3g degrees, less than 1; must be in degrees, not in radians"
            warn(grid.comm, ConditionWarning, what, i, np.max(friction))
    return bodies, later


def check_options(
    bodies: Sequence[Body],
    fluid: Fluid | None,
    pressure: float | Callable,
    terms: Sequence[Callable],
    sources: Sequence[Callable],
    quadrature: str,
) -> None:
    """Raise an error if terms, sources or quadrature are invalid, or if pressure or sources are given without fluid."""
    rotated = [i for i, body in enumerate(bodies) if not body.aligned]
    if quadrature == "point" and rotated:
        raise ValueError(f"quadrature = 'point': body {rotated[0]} is mapped or a mesh, must be a box along the grid")
    functions("terms", _functions_of(terms))
    functions("sources", sources)
    if fluid is not None:
        instance("fluid", fluid, Fluid)
    elif callable(pressure) or numbers("pressure", pressure):
        raise ValueError(f"pressure = {line(pressure)}: needs a fluid")
    elif sources:
        raise ValueError("sources need a fluid")


def check_axisymmetry(grid: Grid, bodies: Sequence[Body], quadrature: str) -> None:
    """Raise an error for point quadrature on grids that do not support it. Warn about narrow holes around the axis."""
    if quadrature == "point" and (grid.axisymmetric or grid.follow is not None):  # fine cells would become empty
        raise ValueError("quadrature = 'point', must be 'domain' in axisymmetry, and on grid lines that follow")
    if not grid.has_axis:
        return
    x = np.concatenate([body.corners() for body in bodies])
    inner = x[:, :, 0].min(axis=1)
    h = grid.widths[0][0]
    near = np.flatnonzero(inner < h * (1 - NEAR))
    row = grid.index(x[near].mean(axis=1))[:, 1]
    touches = np.zeros(grid.shape[1] + 2, dtype=bool)
    for k in range(3):  # an inclined surface leaves the axis in the next row of cells
        touches[row[inner[near] <= NEAR * h] + k] = True
    hole = near[~touches[row + 1]]
    if len(hole):  # nodes of the first cells lie on the axis, and are fixed
        k = hole[inner[hole].argmin()]
        what = "a hole of radius %.3g m about the axis, at %s, is narrower than a cell of %.3g m, so that its side "
        what += "moves like a solid core; use smaller cells, or a grid that begins at a radius > 0"
        warn(grid.comm, ResolutionWarning, what, inner[k], x[k].mean(axis=0), h)


def initial_velocity(grid: Grid, quadrature: str, inertia: bool | Moving | None) -> ArrayLike | Callable | None:
    """Return the initial velocity, or None if no stage has inertia.

    Raise ValueError if the scene does not allow inertia or the velocity.
    """
    if inertia is None:
        return None
    moves = isinstance(inertia, Moving)
    flag("inertia", moves or inertia)
    velocity = inertia.velocity if moves else np.zeros(grid.dim)
    if quadrature != "domain":
        raise ValueError(f"inertia = {line(inertia)}, must be None with quadrature {quadrature!r}")
    if callable(velocity):
        check_names("velocity", velocity, ("x",))
    elif numbers("velocity", velocity, (grid.dim,), allowed=f"{grid.dim} finite numbers")[0] and grid.axisymmetric:
        raise ValueError(f"velocity = {line(velocity)}, must be (0, v): axisymmetric bodies move along the axis")
    return velocity


def check_masses(materials: Sequence[Skeleton], fluid: Fluid | None) -> None:
    """Raise ValueError if a dry body has no mass, because its velocity would be undetermined."""
    for number, one in enumerate(materials):
        if fluid is None and one.grain_density == 0:
            raise ValueError(f"material {number}: grain_density = 0, must be > 0 for bodies with inertia")


def _functions_of(terms):
    """Return the functions of all terms, in bodies and on sides."""
    if isinstance(terms, str) or not isinstance(terms, Sequence):
        return terms
    return [term.term if isinstance(term, OnSide) else term for term in terms]
