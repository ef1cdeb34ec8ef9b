# SPDX-License-Identifier: MIT
"""Places in the bodies whose displacement is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.points.faces import interpolate
from mpm_dolfinx.points.grid import rounding
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.validation import all_of, line, numbers


@dataclass(frozen=True, eq=False)
class Probes:
    """Tracked positions: material particles whose displacement is wanted; m of them.

    x0 : (m, d) reference positions; id : (m,) the domain that holds each; xi : (m, d) place in it;
    bodies: those of the scene that they are for.
    """

    x0: NDArray[np.float64]
    id: NDArray[np.int64]
    xi: NDArray[np.float64]
    bodies: tuple[Body, ...] = ()

    def check(self, bodies: Sequence[Body], present: Sequence[bool]) -> None:
        """Refuse, with a ValueError, a scene of other bodies, or one from which a probed body has gone."""
        if len(bodies) != len(self.bodies) or not all(map(_same, bodies, self.bodies)):
            what = f"made for {len(self.bodies)} bodies, the scene has {len(bodies)}"
            raise ValueError(f"probes: {what}; must be made with all bodies of the scene, in its order")
        body = np.searchsorted(np.cumsum([len(b) for b in bodies]), self.id, side="right")
        gone = np.flatnonzero(~np.asarray(present)[body])
        if len(gone):
            raise ValueError(f"probe at {self.x0[gone[0]]}: in body {body[gone[0]]}, must be in one that is there now")

    def displacement(self, points: MaterialPoints, comm) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, on every process."""
        here, at = points.find(self.id)
        u = np.zeros_like(self.x0)
        u[here] = interpolate(points.corners[at] - points.origin[at], self.xi[here])
        return over_all(comm, u)


def _same(a: Body, b: Body) -> bool:
    """Whether two bodies have the same points."""
    return a is b or (a.lower.shape == b.lower.shape and np.array_equal(a.lower, b.lower))


def positions(x0: ArrayLike, dim: int) -> NDArray[np.float64]:
    """Return places where something is probed, as an array (m, d), m."""
    allowed = f"positions of {dim} finite coordinates"
    x = np.atleast_2d(numbers("probes: x0", x0, None, allowed=allowed))
    if x.shape[1:] != (dim,):
        raise ValueError(f"probes: x0 = {line(x0)}, must be {allowed}")
    return x


def probes(bodies: Sequence[Body], x0: ArrayLike) -> Probes:
    """Return probes: material particles whose displacement a run records, the `probes` of `Simulation.run`.

    Parameters
    ----------
    bodies
        All bodies of the scene, in its order.
    x0 : (m, d), m
        Reference positions, before a map, inside or on the surface of the bodies.  Where bodies touch, a position
        belongs to the first of them: keep off by a little to have the other.

    Raises
    ------
    ValueError
        A position outside the bodies; from the run: other bodies than the scene's, or one that is not there now.
    """
    all_of("probes: bodies", bodies, Body, 1)
    x0 = positions(x0, bodies[0].lower.shape[1])
    centre = np.concatenate([b.centre for b in bodies])
    spacing = np.concatenate([np.broadcast_to(b.spacing, b.lower.shape) for b in bodies])
    ids = np.empty(len(x0), dtype=np.int64)
    for i, x in enumerate(x0):  # a handful of positions, once a scene
        far = np.abs((centre - x) / spacing).max(axis=1)
        ids[i] = np.flatnonzero(far <= far.min() + 1e-9)[0]
    xi = 2 * (x0 - centre[ids]) / spacing[ids]
    far = np.flatnonzero((np.abs(xi) > 1 + 1e-9 + 2 * rounding(x0) / spacing[ids]).any(axis=1))
    if len(far):
        raise ValueError(f"probe at {x0[far[0]]}: outside the bodies, must be in one or on its surface")
    return Probes(x0, ids, xi, tuple(bodies))
