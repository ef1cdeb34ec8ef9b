# SPDX-License-Identifier: MIT
"""Expansion of a cylindrical cavity in soil at finite strain, as a reference for laws and scenes.

The model is one-dimensional.  The initial radius of the cavity is 1.  The initial pressures at the wall of the cavity
and at the outer radius are equal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_banded

from mpm_dolfinx.base.tolerances import ITERATIONS, SAME
from mpm_dolfinx.materials.evaluate import LawAtPoints
from mpm_dolfinx.materials.skeleton import Skeleton

State = dict[str, NDArray[np.float64]]


class _Rings:
    """A law at n rings of soil with radial and circumferential stretches (n, 2)."""

    def __init__(self, material: Skeleton, count: int, state: Mapping[str, ArrayLike] | None = None):
        law = type(material)
        values = {name: np.asarray(getattr(material, name), dtype=float) for name in law.parameters}
        start = {name: np.asarray(v, dtype=float) for name, v in (dict(law.state) | dict(state or {})).items()}
        self._law = LawAtPoints(None, law, {name: v.shape for name, v in (values | start).items()})
        self._values, self.start = _tiled(values, count), _tiled(start, count)

    def _data(self, stretches: NDArray[np.float64], state: State, repeat: int = 1):
        F = np.insert(stretches, 2, 1.0, axis=1)[:, None] * np.eye(3)
        cells = np.arange(len(F), dtype=np.int32) % 8
        inputs = {name: np.concatenate([v] * repeat) for name, v in (self._values | state).items()}
        return self._law.points.at(cells, self._law.grid.midpoints[cells], np.ones(len(F)), F=F, **inputs)

    def kirchhoff(self, stretches: NDArray[np.float64], state: State, repeat: int = 1) -> NDArray[np.float64]:
        """Return the radial and circumferential Kirchhoff stresses (n, 2), in Pa, for stretches (n, 2).

        `repeat`: how often `stretches` contains each ring.
        """
        stress = self._law.stress(self._data(stretches, state, repeat))
        return stress[:, [0, 1], [0, 1]] * stretches.prod(axis=1, keepdims=True)

    def nominal(self, stretches: NDArray[np.float64], state: State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the nominal stresses (n, 2), in Pa, and their derivatives with respect to the stretches."""
        nudges = SAME * np.array([[0, 0], [1, 0], [0, 1]])
        near = (stretches + nudges[:, None, :]).reshape(-1, 2)
        P = (self.kirchhoff(near, state, len(nudges)) / near).reshape(len(nudges), -1, 2)
        return P[0], (P[1:] - P[0]).transpose(1, 2, 0) / SAME

    def updated(self, stretches: NDArray[np.float64], state: State) -> State:
        """Return the state after a step that ends with the given stretches."""
        return state | dict(self._law.new_state(self._data(stretches, state), 0.0))


@dataclass(frozen=True)
class Cavity:
    """A thick cylinder of soil in plane strain under inner and outer pressure, with linear elements."""

    rings: _Rings  # soil, one ring for each element
    R: NDArray[np.float64]  # initial radii of the nodes, m
    r: NDArray[np.float64]  # present radii of the nodes, m
    state: State  # state of the law
    far: float  # pressure at the outer radius, Pa
    pressure: float  # pressure at the cavity wall, Pa

    def widened(self, radius: float) -> Cavity:
        """Return the cylinder after a drained step that expands the cavity to a radius, in m."""
        n, r = len(self.R), self.r.copy()
        r += (radius - r[0]) * r[0] / r  # initial guess, the motion of incompressible soil
        r[0] = radius
        middle, h = (self.R[1:] + self.R[:-1]) / 2, np.diff(self.R)
        weight = middle * h
        g = 1 / h
        t = 1 / (2 * middle)
        B = np.array([[-g, t], [g, t]])  # (node, stretch, element)
        exact = False
        for _ in range(ITERATIONS):
            P, D = self.rings.nominal(_stretches(self.R, r), self.state)
            forces = np.einsum("ase,es->ae", B, P) * weight
            force = np.append(forces[0], 0.0) + np.append(0.0, forces[1])
            inside = force[0]
            force[-1] += self.far * r[-1]  # the pressure follows the surface
            scale = np.abs(forces).max() + self.far * r[-1]
            force[0] = 0.0
            if exact:
                state = self.rings.updated(_stretches(self.R, r), self.state)
                return replace(self, r=r, state=state, pressure=inside / r[0])
            exact = np.abs(force).max() < SAME * scale  # the next step is the last
            K = np.einsum("ase,est,bte->eab", B, D, B) * weight[:, None, None]
            bands = np.zeros((3, n))
            bands[1, :-1] += K[:, 0, 0]
            bands[1, 1:] += K[:, 1, 1]
            bands[0, 1:], bands[2, :-1] = K[:, 0, 1], K[:, 1, 0]
            bands[1, -1] += self.far
            bands[1, 0], bands[0, 1] = 1.0, 0.0
            step, length = solve_banded((1, 1), bands, force), 1.0
            while np.any(np.diff(r - length * step) <= 0):
                length /= 2
            r = r - length * step
        raise RuntimeError(f"cavity: no equilibrium was found at a radius of {radius:g}")


def cavity(
    material: Skeleton, outer: float, elements: int = 300, state: Mapping[str, ArrayLike] | None = None
) -> Cavity:
    """Return a cylinder with a cavity in its initial state.

    Parameters
    ----------
    material
        The soil.
    outer
        Outer radius divided by the initial radius of the cavity; at least 100 to represent infinite soil.
    elements
        Number of elements, whose sizes form a geometric progression.
    state
        Initial state variables of the law; by default the state of the material.
    """
    R, rings = np.geomspace(1, outer, elements + 1), _Rings(material, elements, state)
    far = -float(rings.kirchhoff(np.ones((elements, 2)), rings.start)[-1, 0])
    return Cavity(rings, R, R, rings.start, far, far)


def undrained(material: Skeleton, outer: float, radii: Sequence[float], rings: int = 2000) -> tuple[float, float]:
    """Return two radial stresses, in Pa, after undrained expansion of a cavity.

    The first stress is the total stress at the outer radius minus the total stress at the wall.  The second stress is
    the effective stress at the wall.  The volume of soil is constant.  A ring of initial radius R therefore has the
    radius r, with r^2 - a^2 = R^2 - 1.

    `radii`: successive radii a of the cavity, in small steps.
    """
    edges = np.geomspace(1, outer, rings + 1)
    R, law = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2), _Rings(material, rings)
    state = law.start
    for a in radii:
        r = np.sqrt(R**2 + a**2 - 1)
        stretches = np.stack([R / r, r / R], axis=1)
        tau, state = law.kirchhoff(stretches, state), law.updated(stretches, state)
    ends = np.sqrt(edges**2 + a**2 - 1)
    drop = np.sum((tau[:, 1] - tau[:, 0]) * np.log(ends[1:] / ends[:-1]))
    return float(drop), float(np.polyfit(R[:3] - 1, tau[:3, 0], 2)[-1])


def _stretches(R: NDArray[np.float64], r: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.diff(r) / np.diff(R), (r[1:] + r[:-1]) / (R[1:] + R[:-1])], axis=1)


def _tiled(values: Mapping[str, NDArray[np.float64]], count: int) -> dict[str, NDArray[np.float64]]:
    return {name: np.tile(v, (count, *[1] * v.ndim)) for name, v in values.items()}
