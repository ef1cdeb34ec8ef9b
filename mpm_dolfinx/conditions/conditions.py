# SPDX-License-Identifier: MIT
"""Conditions on the sides of the bodies: tractions, pressures, displacements, plates, drained sides, prescribed inflow.

A side is named "left", "right", "bottom" or "top", in 3D also "front" (lower y) and "back" (upper y), by where it is
in the seeded body, before a map; sides of a mesh as it names them (`from_mesh`).  It moves with the body.  What of it
lies on another body, as seeded, does not count.
Regions and X are reference positions, before all maps (`mapped`); areas are those as seeded, after them.

A new kind of condition is a class like these in a file of its own, with a method `acting` for what it does to the
momentum, see `conditions/acting.py`, or `feeding` for what it does to the fluid, see `flow/feeding.py`.

Values may be functions of the time t, the reference places X and the present places x, by these names: how they are
called, and what they may give, stands in `validation`.

What is wrong with a condition is said, with a ValueError, when it is made, or a scene or a stage with it; of what
functions give at the step that asks for it.  A condition equals only itself: values and regions may be arrays and
functions, which have no equality of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import NAMES, Places, check_names, flag, given, line, numbers
from mpm_dolfinx.bodies.faces import Region, Surface
from mpm_dolfinx.materials.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class Condition:
    """What a condition is given, in lists and arrays too, is its own: nobody changes it.

    name: by which its results are found; without, its kind and side, such as "displacement_top".
    """

    name: str | None = field(default=None, kw_only=True, repr=False)
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"value": NAMES}
    """Values that may be functions, and of what."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if isinstance(value, (list, tuple, np.ndarray)):
                object.__setattr__(self, name, deepcopy(value))
        for name, among in self.FUNCTIONS.items():
            if callable(getattr(self, name)):
                check_names(f"{line(self)}: {name}", getattr(self, name), among)

    def _given(self, name: str, t: float, *more, **options) -> NDArray[np.float64]:
        """Return one of its values at time t (s), see `validation.given`."""
        what, among = f"{line(self)}: {name} at t = {t:g} s", self.FUNCTIONS[name]
        return given(what, getattr(self, name), t, *more, among=among, **options)


@dataclass(frozen=True, eq=False)
class Traction(Condition):
    """Dead traction on a side of the bodies.

    Parameters
    ----------
    side
        Side of the bodies: "left", "right", "bottom", "top", in 3D also "front" (lower y) and "back" (upper y); of
        bodies from meshes as these name it.  Where several bodies have one of this name it is all of them.
    value : (d,) or number, or callable (t, X, x) -> (d,) or number, or one of these a place, Pa
        Force per reference area; a number acts along the outward normal at the start of the step, negative: presses.
        Several tractions on one face add up.
    region : ((d,), (d,)), m
        Lower and upper corner of the box of reference positions to which the traction is limited; faces partly in
        it count with that part.

    Raises
    ------
    ValueError
        From the scene or the step: no point has the side, or the value is none that is allowed.
    """

    side: str
    value: ArrayLike | Callable[..., ArrayLike]
    region: Region | None = None

    def at(self, t: float, dim: int, side: Places | None = None) -> NDArray[np.float64]:
        """Return the traction (d,) or (m, d), or () or (m,) along the normal, at time t (s), Pa, in a dimension."""
        return self._given("value", t, side, dim)


@dataclass(frozen=True, eq=False)
class Pressure(Condition):
    """Pressure on a side of the bodies, wherever it goes: normal to the present surface, per present area.

    It adds up with tractions.  It acts on skeleton and pore fluid together: of water that also
    enters the pores, `Drained` gives the pressure.  Where pressures of one value meet walls that hold the surface's
    ends, or one another all around the body, they have a potential; else the tangent is unsymmetric (LU, FGMRES), and
    nothing tells whether an equilibrium without pore fluid is stable.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    value : float or callable (t, X, x) -> float, Pa
        Finite; positive: presses, negative: sucks.  With functions of places the tangent is unsymmetric.
    region : ((d,), (d,)), m
        As for `Traction`.

    Raises
    ------
    ValueError
        As for `Traction`.
    """

    side: str
    value: float | Callable[..., ArrayLike]
    region: Region | None = None

    def at(self, t: float, side: Places | None = None) -> NDArray[np.float64]:
        """Return the pressure () or (m,) at time t (s), Pa."""
        return self._given("value", t, side)


@dataclass(frozen=True, eq=False)
class Quiet(Condition):
    """Quiet side of bodies with inertia: waves leave through it (Lysmer and Kuhlemeyer 1969).

    It resists by the impedances of the material, rho c_p along the normal and rho c_s across, times the velocity.
    Waves along the normal leave wholly; of others that meet it aslant a few per cent come back.  A side that a stage
    without inertia held keeps the tractions that it bore.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    incoming : (d,) or callable t (s) -> (d,), m/s
        Velocity of particles at the side in a wave that comes in along the normal, alone: at a free surface twice as
        much arrives.
    region : ((d,), (d,)), m
        As for `Traction`.

    Raises
    ------
    ValueError
        From the scene: bodies have no inertia, or had it before the side was quiet; no point has the side; another
        `Quiet` acts on the same part of a face.
    """

    side: str
    incoming: ArrayLike | Callable[[float], ArrayLike] | None = None
    region: Region | None = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"incoming": ("t",)}

    def at(self, t: float, dim: int) -> NDArray[np.float64]:
        """Return the velocity (d,) of the incoming wave at time t (s), m/s."""
        return np.zeros(dim) if self.incoming is None else self._given("incoming", t, None, dim, number=False)


@dataclass(frozen=True, eq=False)
class OnSide(Condition):
    """Term of the user's own on a side of the bodies, in UFL: springs, dashpots, loads that depend on what moves.

    Given among the `terms` of the scene, for all of its stages.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    term
        Function as those of `terms`, see `user_functions`; its `points` are those of integration on the side:
        `points.dx` measures the area at the start of the step, and `points.normal` is the outward normal then.
    region : ((d,), (d,)), m
        As for `Traction`.

    Raises
    ------
    ValueError
        From the scene: it is no such function, or no point has the side.
    """

    side: str
    term: Callable
    region: Region | None = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {}


@dataclass(frozen=True, eq=False)
class Source:
    """Term of the user's own in the storage of fluid, in UFL: fluid that wells up or is lost in the bodies.

    Given among the `terms` of the scene, for all of its stages.

    Parameters
    ----------
    term
        Function with a test function q of the pressure, see `user_functions`; positive: volume comes, 1/s.
    """

    term: Callable


def sorted_terms(terms: Sequence[Callable | OnSide | Source]) -> tuple[list[Callable | OnSide], list[Callable]]:
    """Return the user's terms in the balance of momentum, and those in the storage of fluid."""
    if isinstance(terms, (str, bytes)) or not isinstance(terms, Sequence):
        raise ValueError(f"terms = {line(terms)}, must be a list of functions, OnSide and Source")
    sources = [term.term for term in terms if isinstance(term, Source)]
    return [term for term in terms if not isinstance(term, Source)], sources


class Through(NamedTuple):
    """What a side lets through at its places, each () or (m,).

    pressure: beyond it, Pa, nan where the flux alone is given; flux: into the body, m/s; one_way: nothing flows in;
    driest: the least pressure at which the flux is what is given, Pa, nan where it is not bounded by pressures.
    """

    pressure: NDArray[np.float64] | float
    flux: NDArray[np.float64] | float
    one_way: NDArray[np.bool_] | bool
    driest: NDArray[np.float64] | float = np.nan


@dataclass(frozen=True, eq=False)
class Drained(Condition):
    """Side of the bodies, moving with them, at which the pore pressure is given.

    What leaves through it is in the simulation's `outflows`.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    pressure : float or callable (t, X, x) -> float, Pa
        Outer pore pressure, finite: under a water level, lambda t, x: 9810 * np.maximum(level(t) - x[:, 1], 0).
    region : ((d,), (d,)), m
        Box of reference positions to which the drained faces are limited.
    seepage
        A seepage face: where the outer pressure is not positive, as above a water level, water leaves but does not
        enter.  There the pressure is at most the outer one, or nothing flows.

    Raises
    ------
    ValueError
        The pressure is no finite number; from the scene: there is no fluid, no point has the side, or another
        `Drained` or `Inflow` acts on the same part of a face.
    """

    side: str
    pressure: float | Callable[..., ArrayLike] = 0.0
    region: Region | None = None
    seepage: bool = False
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"pressure": NAMES}

    def __post_init__(self):
        super().__post_init__()
        flag("Drained: seepage", self.seepage)
        if not callable(self.pressure):
            numbers("Drained: pressure", self.pressure)

    def at(self, t: float, side: Places | None = None) -> NDArray[np.float64]:
        """Return the pressure () or (m,) at time t (s), Pa."""
        return self._given("pressure", t, side)

    def through(self, t: float, side: Places) -> Through:
        """Return what the side lets through at time t (s)."""
        pressure = self.at(t, side)
        return Through(pressure, 0.0, self.seepage & (pressure <= 0))


class Flux(Condition):
    """Condition with a flux (m/s) through a side, a number or a function of t, X, x."""

    side: str
    flux: float | Callable[..., ArrayLike]
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"flux": NAMES}

    def __post_init__(self):
        super().__post_init__()
        if not callable(self.flux):
            numbers(f"{type(self).__name__}: flux", self.flux)

    def at(self, t: float, side: Places | None = None) -> NDArray[np.float64]:
        """Return the flux () or (m,) at time t (s), m/s."""
        return self._given("flux", t, side)


@dataclass(frozen=True, eq=False)
class Inflow(Flux):
    """Side of the bodies through which fluid is pressed in.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    flux : float or callable (t, X, x) -> float, m/s
        Volume at zero pressure per present area and time into the body, finite; negative: out of it.
    region : ((d,), (d,)), m
        Box of reference positions to which the faces are limited.

    Raises
    ------
    ValueError
        As for `Drained`.
    """

    side: str
    flux: float | Callable[..., ArrayLike]
    region: Region | None = None

    def through(self, t: float, side: Places) -> Through:
        """Return what the side lets through at time t (s)."""
        return Through(np.nan, self.at(t, side), False)


@dataclass(frozen=True, eq=False)
class Rain(Flux):
    """Side of the bodies on which rain falls, or from which water evaporates, as much as the soil lets.

    Rain soaks in until the pressure at the side is that of `ponding`: what soil does not take then runs off.  Water
    evaporates until the pressure is `driest`.  What seeps out of the body leaves it too.  What passes the side is in
    the simulation's `outflows`, and what runs off in `simulation.outcome("runoff")`, m^3/s (m^2/s in plane strain).
    Volumes since the condition began, m^3 (m^2): `outcome("flowed")` out of the body, also through other open sides,
    `outcome("ran_off")`, what seeps out here included, and what stands on the side, `outcome("ponded")`.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    flux : float or callable (t, X, x) -> float, m/s
        Rain that falls on the present area of the side in a time, as a volume at zero pressure, finite; negative: what
        would evaporate from a wet side.  Rain that falls straight down on a slope of angle b has flux cos(b).
    ponding
        Pressure of the water that stands on the side before it runs off, Pa, >= 0: its depth times its weight.  One
        pond, of the same depth all over the side, fills before anything runs off, and later soaks in or evaporates.
    driest
        Least pressure at the side, Pa, < 0 and finite: the suction of the air.  By Kelvin's equation -1e7 Pa is in
        balance with air of 93 % humidity at 20 °C.
    region : ((d,), (d,)), m
        Box of reference positions to which the faces are limited.

    Raises
    ------
    ValueError
        As for `Drained`.
    """

    side: str
    flux: float | Callable[..., ArrayLike]
    ponding: float = 0.0
    driest: float = -1e7
    region: Region | None = None

    def __post_init__(self):
        super().__post_init__()
        numbers("Rain: ponding", self.ponding, test=lambda v: (0 <= v) & (v < np.inf), allowed=">= 0 and finite")
        numbers("Rain: driest", self.driest, test=lambda v: (v < 0) & (v > -np.inf), allowed="< 0 and finite")

    def through(self, t: float, side: Places) -> Through:
        """Return what the side lets through at time t (s)."""
        return Through(self.ponding, self.at(t, side), True, self.driest)


RIGIDITY = 1e4
"""Rigidity of a plate, in units of (oedometric modulus of the body) x (length of the side)."""
HOLD = 3e2
"""Stiffness of what holds the mean of a given displacement in a cell, in units of (modulus by `holding`) / (cell size).

The side gives way by (change of stress in the step, but for its turn) / (modulus) x cell size / HOLD, always measured
from its given place: nothing adds up.

Plateau (soil): halved 5.9e-05, doubled 2.0e-05, cells 3.0e-02.
"""
WEAK = 8.0
"""The same for what is left of it at the points of integration, of (modulus + 10 stress) / (cell size).

Plateau (soil): halved 5.0e-06, doubled 7.9e-06, cells 3.0e-02.
"""
YIELDING = 0.1
"""Share of the elastic modulus that sides are held by where the law has a state: soil bears little beside it.

Plateau (soil): halved 6.5e-05, doubled 1.9e-05, cells 3.0e-02.
"""


def resistance(material: Skeleton) -> NDArray[np.float64]:
    """Return what a side resists with, Pa: the oedometric modulus, at most that of nu = 1/3, which is 4G."""
    return np.minimum(material.oedometric, 4 * material.shear)


def holding(material: Skeleton) -> NDArray[np.float64]:
    """Return the modulus, Pa, in units of which a side is held.

    By as much as a Q1 field whose cells keep their volume cannot follow a curved side it is pushed by what holds it.
    That must not be stiff beside the body's shear: an undrained cavity in soil, widened with 3e2 (lambda + 2G), has up
    to 1.9 times the pressure that it should have, with 30 times 4G 1.01.
    """
    return (YIELDING if material.state else 1.0) * resistance(material)


@dataclass(frozen=True, eq=False)
class Displacement(Condition):
    """Side of the bodies whose displacement is given: a footing, a clamp that moves, a body carried along.

    The forces that it takes are `reactions` of the simulation.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    value : (d,) or callable (t, X) -> (d,) or (m, d), m
        Displacement of the side since the start, or since a stage reset it, at the reference positions X (m, d), of
        which a bent body's map gives the places as seeded.  A number for every component, also for those that are
        free.
    components
        Components that are given, such as "y"; the others are free.  By default all.
    region : ((d,), (d,)), m
        Box of reference positions to which the condition is limited.  A cell of which the region, where it ends within
        a side, covers no more than half is not held: the last node carries half a cell beyond it.

    Raises
    ------
    ValueError
        From the scene or the step: no point has the side, the value or the components are none that are allowed, a wall
        holds what is to move, another `Displacement` gives a component on the same part of a face, or another value of
        it where the two meet.
    """

    side: str
    value: ArrayLike | Callable[..., ArrayLike]
    components: str = ""
    region: Region | None = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"value": ("t", "X")}

    def axes(self, dim: int) -> list[int]:
        """Return the axes of the given components."""
        if not isinstance(self.components, str) or any(c not in "xyz"[:dim] for c in self.components):
            raise ValueError(f"{line(self)}: components must be some of {'xyz'[:dim]!r}")
        return sorted("xyz".index(c) for c in set(self.components or "xyz"[:dim]))

    def at(self, t: float, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacement (m, d), m, at time t (s) of reference positions X (m, d)."""
        value = self._given("value", t, lambda name: X, X.shape[1], number=False)
        return np.broadcast_to(value, X.shape)


@dataclass(frozen=True, eq=False)
class _OfPlate(Traction):
    """The even traction of a plate, which refuses what its force gives by the plate's name."""

    def at(self, t: float, dim: int, side: Places | None = None) -> NDArray[np.float64]:
        return self.value(t)


@dataclass(frozen=True, eq=False)
class RigidPlate(Condition):
    """Rigid, smooth plate on a flat side of the bodies: one displacement along the side's axis for all its faces.

    The slope of the faces is penalised, kappa/2 int |grad_t x_n|^2 dA; an even displacement is free, so
    the plate carries the given total force exactly.  It does not tilt.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`; its faces, as seeded, lie in one plane normal to an axis and hang
        together.
    force : float or callable t (s) -> float, N (N/m in plane strain)
        Total force that presses on the side, in axisymmetry all around; negative: pulls.
    region : ((d,), (d,)), m
        Box of reference positions to which the plate is limited.

    Raises
    ------
    ValueError
        The force is no finite number; from the scene or the step: no point has the side, or its faces do not hang
        together or lie at different heights (take a plate with a region for each part).
    """

    side: str
    force: float | Callable[[float], float]
    region: Region | None = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"force": ("t",)}

    def __post_init__(self):
        super().__post_init__()
        if not callable(self.force):
            numbers("RigidPlate: force", self.force)

    def traction(self, area: float, inward: NDArray[np.float64]) -> Traction:
        """Return the even traction of the plate, along a direction (d,), on its reference area, m^(d-1)."""

        def even(t: float) -> NDArray[np.float64]:
            return inward * self._given("force", t) / area

        return _OfPlate(self.side, even, self.region)


def facing(faces: Surface) -> tuple[int, int]:
    """Return along which axis faces look, as seeded, and with which sign."""
    outward = faces.outward.sum(axis=0)
    axis = int(np.abs(outward).argmax())
    return axis, int(np.sign(outward[axis]))


def inward(faces: Surface) -> NDArray[np.float64]:
    """Return the direction (d,) along an axis that faces look away from, as seeded."""
    axis, sign = facing(faces)
    return -sign * np.eye(faces.outward.shape[1])[axis]
