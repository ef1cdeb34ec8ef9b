# SPDX-License-Identifier: MIT
"""Places in the bodies whose displacement, pressure and stress are wanted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.bodies import Body
from mpm_dolfinx.points.faces import interpolate
from mpm_dolfinx.points.grid import rounding
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.validation import all_of, flag, line, numbers


@dataclass(frozen=True, eq=False)
class Probes:
    """Tracked positions: material particles whose displacement is wanted; m of them.

    x0 : (m, d) reference positions; id : (m,) the domain that holds each; xi : (m, d) place in it;
    bodies: those of the scene that they are for; stressed: whether their stress is wanted too.
    """

    x0: NDArray[np.float64]
    id: NDArray[np.int64]
    xi: NDArray[np.float64]
    bodies: tuple[Body, ...] = ()
    stressed: bool = False

    def check(self, bodies: Sequence[Body], present: Sequence[bool]) -> None:
        """Refuse, with a ValueError, a scene of other bodies, or one from which a probed body has gone."""
        if len(bodies) != len(self.bodies) or not all(map(_same, bodies, self.bodies)):
            what = f"made for {len(self.bodies)} bodies, the scene has {len(bodies)}"
            raise ValueError(f"probes: {what}; must be made with all bodies of the scene, in its order")
        body = np.searchsorted(np.cumsum([len(b) for b in bodies]), self.id, side="right")
        gone = np.flatnonzero(~np.asarray(present)[body])
        if len(gone):
            raise ValueError(f"probe at {self.x0[gone[0]]}: in body {body[gone[0]]}, must be in one that is there now")

    def displacement(self, points: MaterialPoints, comm: MPI.Intracomm) -> NDArray[np.float64]:
        """Return the displacements (m, d), m, on every process."""
        here, at = points.find(self.id)
        return self._shared(comm, here, interpolate(points.corners[at] - points.origin[at], self.xi[here]))

    def position(self, points: MaterialPoints, comm: MPI.Intracomm) -> NDArray[np.float64]:
        """Return the present positions (m, d), m, on every process."""
        here, at = points.find(self.id)
        return self._shared(comm, here, interpolate(points.corners[at], self.xi[here]))

    def at_points(
        self, points: MaterialPoints, comm: MPI.Intracomm, value: Callable[[MaterialPoints], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return what a function gives of the points whose domains hold the probes, (m, ...), on every process."""
        here, at = points.find(self.id)
        return self._shared(comm, here, value(points.map(lambda rows: rows[at])))

    def _shared(self, comm: MPI.Intracomm, here: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values (m, ...) on every process of those of the probes that are here."""
        out = np.zeros((len(self.id), *values.shape[1:]))
        out[here] = values
        return over_all(comm, out)


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


def probes(bodies: Sequence[Body], x0: ArrayLike, *, stress: bool = False) -> Probes:
    """Return probes: material particles that a run records, the `probes` of `Simulation.run`.

    Recorded are displacement and position, with a fluid the pore pressure and, if asked for, the effective stress; see
    `Row`.

    Parameters
    ----------
    bodies
        All bodies of the scene, in its order.
    x0 : (m, d), m
        Reference positions, before a map, inside or on the surface of the bodies.  Where bodies touch, a position
        belongs to the first of them: keep off by a little to have the other.
    stress
        Record the effective stress too.

    Raises
    ------
    ValueError
        A position outside the bodies; from the run: other bodies than the scene's, or one that is not there now.
    """
    all_of("probes: bodies", bodies, Body, 1)
    flag("probes: stress", stress)
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
    return Probes(x0, ids, xi, tuple(bodies), stress)
