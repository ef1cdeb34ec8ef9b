# SPDX-License-Identifier: MIT
"""Probes: material particles whose displacement, pressure and stress a run records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.tolerances import ROUND_OFF, SAME
from mpm_dolfinx.base.validation import all_of, flag, line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.faces import interpolate
from mpm_dolfinx.grid.grid import corner_bits, in_chunks, rounding
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.material_points import MaterialPoints


@dataclass(frozen=True, eq=False)
class Probes:
    """Material particles at which a run records results."""

    x0: NDArray[np.float64]  # (n, d) reference positions, in m
    id: NDArray[np.int64]  # (n,) identifier of each probe's particle domain
    xi: NDArray[np.float64]  # (n, d) local coordinates in this domain
    bodies: tuple[Body, ...] = ()  # all bodies of the scene
    stressed: bool = False  # whether stresses are recorded too

    def check(self, bodies: Sequence[Body], present: Sequence[bool]) -> None:
        """Raise ValueError if the probes were made for another scene's bodies, or if a probe is in an absent body."""
        if len(bodies) != len(self.bodies) or not all(map(_same, bodies, self.bodies)):
            what = f"made for {len(self.bodies)} bodies, the scene has {len(bodies)}"
            raise ValueError(f"probes: {what}; must be made with all bodies of the scene, in the scene's order")
        body = np.searchsorted(np.cumsum([len(b) for b in bodies]), self.id, side="right")
        absent = np.flatnonzero(~np.asarray(present)[body])
        if len(absent):
            first = absent[0]
            raise ValueError(f"probe at {self.x0[first]}: body {body[first]} is absent, must be present")

    def displacement(self, points: MaterialPoints, comm: MPI.Intracomm) -> NDArray[np.float64]:
        """Return the displacements (n, d) of all probes, in m, on every process."""
        known, at = points.find(self.id)
        return self._shared(comm, known, interpolate(points.corners[at] - points.origin[at], self.xi[known]))

    def position(self, points: MaterialPoints, comm: MPI.Intracomm) -> NDArray[np.float64]:
        """Return the present positions (n, d) of all probes, in m, on every process."""
        known, at = points.find(self.id)
        return self._shared(comm, known, interpolate(points.corners[at], self.xi[known]))

    def _shared(
        self, comm: MPI.Intracomm, known: NDArray[np.int64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the values of all probes on all processes.  `values`: values of the probes `known` on this process."""
        out = np.zeros((len(self.id), *values.shape[1:]))
        out[known] = values
        return over_all(comm, out)


def check_there(probes: Probes, points: MaterialPoints, comm: MPI.Intracomm) -> None:
    """Raise ValueError if renewal has replaced the particle domain of a probe."""
    found = np.zeros(len(probes.id))
    found[points.find(probes.id)[0]] = 1.0
    missing = np.flatnonzero(over_all(comm, found) == 0)
    if len(missing):
        what = f"probe at {probes.x0[missing[0]]}: its domain was renewed in a run without this probe"
        raise ValueError(f"{what}; all runs must use this probe, or omit Numerics(renewal=True)")


def _same(a: Body, b: Body) -> bool:
    """Return whether two bodies have the same material points."""
    equal = len(a) == len(b) and a.dim == b.dim
    return a is b or (equal and all(np.array_equal(a.lower_of(p), b.lower_of(p)) for p in in_chunks(len(a))))


def positions(x0: ArrayLike, dim: int) -> NDArray[np.float64]:
    """Return the reference positions of n probes as an array (n, d), in m."""
    allowed = f"positions of {dim} finite coordinates"
    x = np.atleast_2d(numbers("probes: x0", x0, None, allowed=allowed))
    if x.shape[1:] != (dim,):
        raise ValueError(f"probes: x0 = {line(x0)}, must be {allowed}")
    return x


def probes(bodies: Sequence[Body], x0: ArrayLike, *, stress: bool = False) -> Probes:
    """Return the material particles at which `Simulation.run` records results, for its argument `probes`.

    A run records displacements and positions of the particles, and in scenes with fluid also pore pressures.

    Parameters
    ----------
    bodies
        All bodies, in the order in which the scene lists them.
    x0 : (n, d), m
        Reference positions inside bodies or on their surfaces; in a `mapped` body, positions before mapping.  A probe
        on a common surface of two bodies belongs to the first of these bodies in `bodies`.  For the second body, give a
        position inside this body.
    stress
        Whether the run also records effective stresses.

    Raises
    ------
    ValueError
        A position is outside the bodies.  `Simulation.run` raises ValueError if its scene has other bodies, or if the
        body of a probe is absent.
    """
    all_of("probes: bodies", bodies, Body, 1)
    flag("probes: stress", stress)
    x0 = positions(x0, bodies[0].dim)
    ids, xi = np.empty(len(x0), dtype=np.int64), np.empty(x0.shape)
    for i, x in enumerate(x0):  # a loop is fast enough for a few positions
        found = next(_domains_at(bodies, x, rounding(x0)), None)
        if found is None:
            raise ValueError(f"probe at {x}: outside the bodies, must be in a body or on its surface")
        ids[i], xi[i] = found
    return Probes(x0, ids, xi, tuple(bodies), stress)


def _domains_at(
    bodies: Sequence[Body], x: NDArray[np.float64], rounded: float
) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield each particle domain that contains the position `x`, and the local coordinates of `x` in this domain."""
    start = 0
    for body in bodies:
        for part in in_chunks(len(body)):
            spacing = body.boxes(part)
            slack = SAME + 2 * rounded / spacing
            near = np.flatnonzero((np.abs((x - body.lower_of(part)) / spacing - 0.5) <= 0.5 + slack).all(axis=1))
            place = coordinates(body.reference(part.start + near), x)
            for on in np.flatnonzero((np.abs(place) <= 1 + 2 * slack[near]).all(axis=1)):
                yield start + part.start + int(near[on]), place[on]
        start += len(body)


def coordinates(corners: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the local coordinates of a position in each of n domains.  Inside a domain, these are from -1 to 1."""
    signs, xi = 2 * corner_bits(len(x)) - 1, np.zeros((len(corners), len(x)))
    for _ in range(20):  # Newton's method; the first step is exact for parallelepipeds
        hats = 0.5 * (1 + signs * xi[:, None, :])
        dN = np.stack([0.5 * signs[:, a] * np.delete(hats, a, axis=2).prod(axis=2) for a in range(len(x))], axis=2)
        slope, off = np.einsum("nkd,nka->nda", corners, dN), x - interpolate(corners, xi)
        step = (np.linalg.pinv(slope) @ off[:, :, None])[:, :, 0]  # a position outside the domain may have no solution
        xi = np.clip(xi + step, -2.0, 2.0)
        if np.abs(step).max(initial=0.0) < ROUND_OFF:
            break
    return xi
