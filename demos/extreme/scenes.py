# SPDX-License-Identifier: MIT
"""The scenes of `extreme_cases`, on one process: a cantilever, a column, and a square in a corner of the grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from math import ceil, cos, inf, radians, sin

import numpy as np
from scipy.special import lambertw

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM


def soil(young: float = 1e7, nu: float = 0.0, conductivity: float = 1e-4, law=mpm.Hencky):
    """Return a material from Young's modulus (Pa), Poisson's ratio and hydraulic conductivity (m/s)."""
    return law(bulk=young / (3 - 6 * nu), shear=young / (2 + 2 * nu), conductivity=conductivity)


SOIL = soil()
M = SOIL.oedometric  # Pa; equal to Young's modulus, because nu = 0
WATER, INCOMPRESSIBLE = mpm.Fluid(), mpm.Fluid(bulk=inf)


Error = Callable[[mpm.Simulation, mpm.Result], float]


@dataclass
class Scene:
    """A simulation that must be run in equal steps until `end`, in s.

    error: function that computes the error from the simulation and its result; None if no equilibrium exists.
    """

    simulation: mpm.Simulation
    end: float
    steps: int
    error: Error | None
    probes: mpm.Probes | None = None


Make = Callable[[], Scene]


def off(measured, exact, scale: float | None = None) -> float:
    """Return the largest difference from the exact values, divided by `scale` or by the largest exact value."""
    return float(np.abs(np.subtract(measured, exact)).max() / (np.abs(exact).max() if scale is None else scale))


def tip(result: mpm.Result) -> np.ndarray:
    """Return the final displacement (2,) of the first probe, in m."""
    return result.displacement[-1][0]


def settled(exact: float) -> Error:
    """Return a function that returns the relative error of the settlement at the first probe."""
    return lambda s, r: off(tip(r)[1], exact)


def turned(x: np.ndarray, angle: float) -> np.ndarray:
    """Rotate vectors (..., 2) counterclockwise by an angle, in degrees."""
    c, s = cos(radians(angle)), sin(radians(angle))
    return x @ np.array([[c, s], [-s, c]])


def place(s: mpm.Simulation, corners: np.ndarray) -> None:
    """Move the undeformed body: its domains get the corners (n, 4, 2), in m."""
    corners = corners - s.grid.base
    points = replace(s.state.points, corners=corners, origin=corners, x=corners.mean(axis=1))
    s.state = replace(s.state, points=points)


@dataclass(frozen=True)
class Beam:
    """A cantilever, clamped at its left end, with the tip displacement by Taylor-Hood elements as reference."""

    material: mpm.materials.Skeleton = SOIL
    fluid: mpm.Fluid | None = None
    load: float = 2e4  # Pa, on the top, downwards
    thrust: float = 0.0  # Pa, on the free end
    weight: float = 0.0  # m/s^2
    drained: tuple[str, ...] = ("right",)
    end: float = 1.0  # s
    ramp: float = 0.25  # time in which the loads increase, divided by `end`
    steps: int = 8
    size: tuple[float, float] = (1.0, 0.4)  # m
    h: tuple[float, float] = (0.05, 0.05)
    offset: float = 0.5  # distance of the underside from a grid line, divided by the cell size
    per_cell: int = 2
    angle: float = 0.0  # degrees: rotation of beam and loads about the middle of the left end
    truth: tuple[int, int] = (40, 16)  # numbers of Taylor-Hood elements along and across the beam
    truth_steps: int = 8  # steps of these elements if no water drains, otherwise `steps`

    def physics(self) -> dict:
        """Return the conditions that material points and finite elements share."""

        def along(x: float, y: float):
            return lambda t: turned(np.array([x, y]), self.angle) * min(1.0, t / (self.ramp * self.end))

        loads = [mpm.Traction("top", along(0, -self.load)), mpm.Traction("right", along(-self.thrust, 0))]
        out: dict = {"conditions": loads}
        if self.weight:
            out["gravity"] = along(0, -self.weight)
        if self.fluid:
            out |= {"fluid": self.fluid, "conditions": [*loads, *(mpm.Drained(side) for side in self.drained)]}
        return out

    def __call__(self) -> Scene:
        (length, height), (hx, hy) = self.size, self.h
        nx, below, above = ceil(1.2 * length / hx), ceil(length / hy), ceil((1.2 * length + height) / hy)
        left = nx if self.angle else 0
        grid = mpm.Grid([-left * hx, -below * hy], [nx * hx, above * hy], [left + nx, below + above])
        low = np.array([0.0, self.offset * hy])
        body = mpm.box(grid, low, low + self.size, per_cell=self.per_cell)
        middle = low + np.array([0, height / 2])
        physics = self.physics()
        acting, walls = physics.pop("conditions"), {"left": "xy"}
        if self.angle:
            acting, walls = [*acting, mpm.Displacement("left", (0, 0))], {}
        s = mpm.Simulation(grid, [body], [self.material], walls=walls, conditions=acting, **physics)
        place(s, turned(s.points.corners - middle, self.angle) + middle)
        probes = mpm.probes([body], [middle + np.array([length, 0])])
        return Scene(s, self.end, self.steps, lambda s, r: off(turned(tip(r), -self.angle), self.elements()), probes)

    def elements(self, element: str = "taylor-hood", cells: tuple[int, int] | None = None) -> np.ndarray:
        """Return the tip displacement (2,) of the unrotated beam by finite elements, in m."""
        steps = self.steps if self.fluid and self.drained else self.truth_steps
        seen = replace(self, steps=steps, h=(1, 1), offset=0, per_cell=0, angle=0, truth=cells or self.truth)
        return finite_elements(seen, element)


@cache
def finite_elements(beam: Beam, element: str) -> np.ndarray:
    """Return the tip displacement (2,) of the beam by finite elements, in m."""
    fem = BiotFEM(
        mpm.Grid([0, 0], beam.size, beam.truth), beam.material, walls={"left": "xy"}, element=element, **beam.physics()
    )
    return tip(fem.run(beam.end, beam.end / beam.steps, probes=[[beam.size[0], beam.size[1] / 2]]))


def column(error: Error | None, *layers, h=0.05, end=1.0, steps=1, per_cell=2, load=0.0, room=2, **physics) -> Make:
    """Return a function that makes a column, one cell wide, between smooth walls.

    layers: material and height of the top (m) of each layer, from the lowest layer up.
    h: cell size, in m.
    load: load on the top, in Pa.
    room: number of empty cells above the column.
    """

    def make() -> Scene:
        tops = [0.0, *(top for _, top in layers)]
        cells = ceil(tops[-1] / h - 1e-12) + room
        grid = mpm.Grid([0, 0], [h, cells * h], [1, cells])
        bodies = [
            mpm.box(grid, [0, low], [h, high], per_cell=per_cell, material=i)
            for i, (low, high) in enumerate(pairwise(tops))
        ]
        walls = {"left": "x", "right": "x", "bottom": "y"}
        loads = [mpm.Traction("top", (0, -load), region=([-inf, tops[-1]], [inf, inf]))]
        s = mpm.Simulation(
            grid,
            bodies,
            [m for m, _ in layers],
            walls=walls,
            **physics | {"conditions": [*loads, *physics.get("conditions", [])]},
        )
        return Scene(s, end, steps, error, mpm.probes(bodies, [[h / 2, tops[-1]]]))

    return make


def stretch(ratio: float) -> float:
    """Return the stretch a of a column with Hencky's law under a load `q = ratio M`, from `M ln(a) / a = -q`."""
    return float(np.exp(-lambertw(ratio).real))


def square(angle: float, error: Error | None, cells: int = 12, end=1.0, steps=4, fluid=None, drained=()) -> Make:
    """Return a function that makes a square of 0.6 m in the corner between two walls, under 1e5 Pa on all sides.

    angle: rotation of the square, in degrees.
    drained: names of the drained sides of the square.
    """

    def make() -> Scene:
        grid = mpm.Grid([0, 0], [1.2, 1.2], [2 * cells, 2 * cells])
        body = mpm.box(grid, [0, 0], [0.6, 0.6])
        inward = {"left": (1, 0), "right": (-1, 0), "bottom": (0, 1), "top": (0, -1)}
        loads = [mpm.Traction(side, turned(1e5 * np.array(n), angle)) for side, n in inward.items()]
        water = {"fluid": fluid, "conditions": [*(mpm.Drained(side) for side in drained)]} if fluid else {}
        s = mpm.Simulation(
            grid,
            [body],
            [SOIL],
            walls={"left": "x", "bottom": "y"},
            conditions=[*loads, *water.pop("conditions", [])],
            **water,
        )
        corners = turned(s.points.corners, angle)
        place(s, corners - corners.min(axis=(0, 1)))
        return Scene(s, end, steps, error)

    return make
