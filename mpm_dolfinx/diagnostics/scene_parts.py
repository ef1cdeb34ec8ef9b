# SPDX-License-Identifier: MIT
"""Checks that the parts of a scene fit together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpm_dolfinx.base.validation import all_of, chosen, functions, instance, line, numbers
from mpm_dolfinx.bodies.bodies import Body, check_bodies
from mpm_dolfinx.conditions.conditions import OnSide
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.skeleton import Fluid, Skeleton


def check_parts(grid: Grid, bodies: Sequence[Body], materials: Sequence[Skeleton], later: Sequence[int]) -> None:
    """Raise an error for invalid grid, bodies or materials, bodies outside the grid, or invalid `later` indices."""
    instance("grid", grid, Grid)
    all_of("bodies", bodies, Body, 1)
    all_of("materials", materials, Skeleton, 1)
    check_bodies(grid, bodies)
    chosen("later", later, range(len(bodies)), "indices of the bodies")


def check_options(
    bodies: Sequence[Body],
    fluid: Fluid | None,
    pressure: float | Callable,
    terms: Sequence[Callable],
    sources: Sequence[Callable],
    quadrature: str,
) -> None:
    """Raise an error for invalid terms, sources or quadrature, and for pressures and sources without fluid."""
    rotated = [i for i, body in enumerate(bodies) if not body.aligned]
    if quadrature == "point" and rotated:
        raise ValueError(f"quadrature 'point': body {rotated[0]} is mapped or a mesh, must be a box along the grid")
    functions("terms", _functions_of(terms))
    functions("sources", sources)
    if fluid is not None:
        instance("fluid", fluid, Fluid)
    elif callable(pressure) or numbers("pressure", pressure):
        raise ValueError(f"pressure = {line(pressure)}: needs a fluid")
    elif sources:
        raise ValueError("sources need a fluid")


def _functions_of(terms):
    """Return the functions of terms in bodies and on sides; an invalid list is returned unchanged."""
    if isinstance(terms, str) or not isinstance(terms, Sequence):
        return terms
    return [term.term if isinstance(term, OnSide) else term for term in terms]
