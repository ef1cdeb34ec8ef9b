# SPDX-License-Identifier: MIT
"""Conditions on sides of bodies: tractions, pressures, displacements, plates, drained sides, prescribed flux, rain.

Sides are named "left", "right", "bottom" and "top", in 3D also "front" (lower y) and "back" (upper y).  The sides of a
mesh have the names in the mesh (`from_mesh`).  A side moves with its body, and excludes faces in contact with another
body at seeding.  Regions and X refer to reference positions, before all maps (`mapped`).  Reference areas are areas at
seeding, after all maps.

A value may be a function of time t, reference positions X and current positions x.  The parameter names of the function
select its arguments.

A new type of condition is a class with the method `acting` or `feeding`.  The method `acting` adds terms to the
momentum balance (`conditions/acting.py`).  The method `feeding` adds terms to the fluid balance (`flow/feeding.py`).
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
    """Base class of conditions.  Results are stored by `name`, by default type and side, such as "displacement_top"."""

    name: str | None = field(default=None, kw_only=True, repr=False)
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"value": NAMES}
    """Attributes that may be functions, and the allowed parameters of each function."""

    def __post_init__(self):
        for name in ("side", "other"):
            if not isinstance(getattr(self, name, ""), str):
                what = f"{type(self).__name__}: {name} = {line(getattr(self, name))}"
                raise ValueError(f"{what}, must be the name of one side; give one condition for each side")
        for name, value in vars(self).items():
            if isinstance(value, (list, tuple, np.ndarray)):
                object.__setattr__(self, name, deepcopy(value))
        for name, among in self.FUNCTIONS.items():
            if callable(getattr(self, name)):
                check_names(f"{line(self)}: {name}", getattr(self, name), among)

    def _given(self, name: str, t: float, *more, **options) -> NDArray[np.float64]:
        """Return the value of an attribute at time t (s)."""
        what, among = f"{line(self)}: {name} at t = {t:g} s", self.FUNCTIONS[name]
        return given(what, getattr(self, name), t, *more, among=among, **options)


@dataclass(frozen=True, eq=False)
class Traction(Condition):
    """Dead traction on a side of the bodies.

    Parameters
    ----------
    side
        Side of the bodies: "left", "right", "bottom", "top", in 3D also "front" (lower y) and "back" (upper y), or a
        name from a mesh.  The condition applies to all bodies that have a side with this name.
    value : number or (d,), or callable (t, X, x) -> number or (d,), also for each position, Pa
        Force per reference area.  A number is the component along the outward normal at the start of the step, negative
        in compression.  Several tractions may act on the same face.
    region : ((d,), (d,)), m
        Lower and upper corner of a box of reference positions.  The traction acts inside this box only.

    Raises
    ------
    ValueError
        No body has this side, or the value is invalid.  `Simulation`, `stage` or a step raises the error.
    """

    side: str
    value: ArrayLike | Callable[..., ArrayLike]
    region: Region | None = None

    def at(self, t: float, dim: int, side: Places | None = None) -> NDArray[np.float64]:
        """Return the traction, in Pa, at time t (s): a vector (d,) or (n, d), or its normal component () or (n,)."""
        return self._given("value", t, side, dim)


@dataclass(frozen=True, eq=False)
class Pressure(Condition):
    """Pressure on a side of the bodies: force per current area, normal to the moving surface.

    The pressure is a total stress.  For water in contact with the pores, a `Drained` must also prescribe the pore
    pressure (`water` returns both).  The tangent is symmetric if the pressure is uniform, and the loaded surface is
    closed or ends at walls that fix the normal displacement.  With an unsymmetric tangent, the stability of dry
    equilibria is not checked.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    value : float or callable (t, X, x) -> float, Pa
        Finite number, positive for compression.
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
        """Return the pressure () or (m,), Pa, at time t (s)."""
        return self._given("value", t, side)


@dataclass(frozen=True, eq=False)
class Quiet(Condition):
    """Quiet (absorbing) boundary of bodies with inertia (Lysmer and Kuhlemeyer 1969).

    The viscous traction on the side is rho c_p times the normal velocity, plus rho c_s times the tangential velocity.
    The density is rho, and c_p and c_s are the speeds of compression and shear waves.  Waves along the normal are
    absorbed.  Waves at 30 degrees to the normal are reflected with up to 4 % of their energy (nu = 0.2 to 0.4).

    Bodies with weight need an earlier stage without inertia, in which a `Displacement` fixes the side.  The tractions
    at the end of this stage continue to act on the quiet side.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    incoming : (d,) or callable t (s) -> (d,), m/s
        Particle velocity of a wave that enters along the inward normal.  A free surface doubles this velocity.
    region : ((d,), (d,)), m
        As for `Traction`.

    Raises
    ------
    ValueError
        `Simulation` or `stage` raises the error.  The bodies have no inertia, or had inertia before the side became
        quiet.  No body has this side.  Another `Quiet`, or a `Displacement` of all components, is on the same part of a
        face.  A wall of the grid fixes the side.  Gravity changes at the start of the stage.
    """

    side: str
    incoming: ArrayLike | Callable[[float], ArrayLike] | None = None
    region: Region | None = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"incoming": ("t",)}

    def at(self, t: float, dim: int) -> NDArray[np.float64]:
        """Return the particle velocity (d,), in m/s, of the incoming wave at time t (s)."""
        return np.zeros(dim) if self.incoming is None else self._given("incoming", t, None, dim, number=False)


@dataclass(frozen=True, eq=False)
class OnSide(Condition):
    """User-defined UFL term on a side of the bodies, such as springs, dashpots or loads that depend on the motion.

    `Simulation(terms=[OnSide(...)])` adds the term to the momentum balance in all stages.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    term
        Function that returns a UFL form, see `user_functions`.  The argument `points` has the area measure `points.dx`
        and the outward normal `points.normal`, both at the start of the step.
    region : ((d,), (d,)), m
        As for `Traction`.

    Raises
    ------
    ValueError
        The function is invalid, or no body has this side.  `Simulation` raises the error, not this constructor.
    """

    side: str
    term: Callable
    region: Region | None = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {}


@dataclass(frozen=True, eq=False)
class Source:
    """User-defined UFL term in the fluid balance: a source or sink in the bodies.

    `Simulation(terms=[Source(...)])` adds the term to the fluid balance in all stages.

    Parameters
    ----------
    term
        Function that returns a UFL form, linear in the test function q of the pressure, see `user_functions`.  A
        positive factor of q (1/s) adds fluid.
    """

    term: Callable


def sorted_terms(terms: Sequence[Callable | OnSide | Source]) -> tuple[list[Callable | OnSide], list[Callable]]:
    """Return the user-defined terms of the momentum balance, and of the fluid balance."""
    if isinstance(terms, (str, bytes)) or not isinstance(terms, Sequence):
        raise ValueError(f"terms = {line(terms)}, must be a list of functions, OnSide and Source")
    sources = [term.term for term in terms if isinstance(term, Source)]
    return [term for term in terms if not isinstance(term, Source)], sources


class Through(NamedTuple):
    """Flow condition at the n quadrature points of a side.  Each value has shape () or (n,)."""

    pressure: NDArray[np.float64] | float  # pore pressure outside, Pa; nan if only the flux is prescribed
    flux: NDArray[np.float64] | float  # prescribed flux into the body, m/s
    one_way: NDArray[np.bool_] | bool  # whether fluid can only leave the body
    driest: NDArray[np.float64] | float = np.nan  # lowest pressure, Pa, at which the flux is prescribed; nan: no limit


@dataclass(frozen=True, eq=False)
class Drained(Condition):
    """Side of the bodies with a prescribed pore pressure.

    `Simulation.outflows` contains the flow through the side.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    pressure : float or callable (t, X, x) -> float, Pa
        Finite pore pressure at the side.  Below a water level: lambda t, x: 9810 * np.maximum(level(t) - x[:, 1], 0).
    region : ((d,), (d,)), m
        Box of reference positions.  The condition acts inside this box only.
    seepage
        Whether the side is a seepage face where `pressure` <= 0, which is above the water level.  Water can leave
        through a seepage face, but cannot enter.

    Raises
    ------
    ValueError
        The pressure is not finite, the scene has no fluid, or no body has this side.  Another `Drained`, `Inflow` or
        `Rain` is on the same part of a face.
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
        """Return the pressure () or (m,), Pa, at time t (s)."""
        return self._given("pressure", t, side)

    def through(self, t: float, side: Places) -> Through:
        """Return the flow condition at time t (s)."""
        pressure = self.at(t, side)
        return Through(pressure, 0.0, self.seepage & (pressure <= 0))


class Flux(Condition):
    """Base class of conditions with a flux, in m/s, through a side."""

    side: str
    flux: float | Callable[..., ArrayLike]
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"flux": NAMES}

    def __post_init__(self):
        super().__post_init__()
        if not callable(self.flux):
            numbers(f"{type(self).__name__}: flux", self.flux)

    def at(self, t: float, side: Places | None = None) -> NDArray[np.float64]:
        """Return the flux () or (m,), m/s, at time t (s)."""
        return self._given("flux", t, side)


@dataclass(frozen=True, eq=False)
class Inflow(Flux):
    """Side of the bodies with a prescribed inflow of fluid.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    flux : float or callable (t, X, x) -> float, m/s
        Volume of fluid, at zero pressure, that enters per current area and time; finite, and negative for outflow.
    region : ((d,), (d,)), m
        Box of reference positions.  The condition acts inside this box only.

    Raises
    ------
    ValueError
        As for `Drained`.
    """

    side: str
    flux: float | Callable[..., ArrayLike]
    region: Region | None = None

    def through(self, t: float, side: Places) -> Through:
        """Return the flow condition at time t (s)."""
        return Through(np.nan, self.at(t, side), False)


@dataclass(frozen=True, eq=False)
class Rain(Flux):
    """Side of the bodies with rain or evaporation.

    All rain infiltrates while the pressure at the side is below `ponding`.  Otherwise, a part of the rain runs off.
    Water evaporates at the prescribed rate while the pressure at the side is above `driest`.  Seepage out of the side
    is possible.

    `Simulation.outflows` contains the flow through the side, and `outcome("runoff")` the run-off, in m^3/s (m^2/s in
    plane strain).  These outcomes are accumulated volumes since the start of the condition, in m^3 (m^2 in plane
    strain): "flowed" (outflow), "rained" (rain less potential evaporation), "ran_off" (run-off and seepage), and
    "ponded" (the pond).  "rained" plus "flowed" equals "ran_off" plus "ponded".

    Steps end at the jumps of `Stepwise` rain.  They also end at the jumps of rain that is a function of time alone, if
    the rain lasts for at least 1/64 of a step.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    flux : float or callable (t, X, x) -> float, m/s
        Rain, as volume at zero pressure, per current area and time.  The flux is finite, and negative for potential
        evaporation.  Vertical rain of rate r on a slope of angle b has the flux r cos(b).
    ponding
        Pressure of a full pond, in Pa, >= 0: its depth times the unit weight of water.  The pond has uniform depth over
        the side.  Ponded water infiltrates or evaporates later.  If a stage ends the condition, the pond runs off.
    driest
        Lowest pressure at the side, in Pa, < 0 and finite: the pore pressure in equilibrium with the air.  By
        Kelvin's equation, -1e7 Pa corresponds to air of 93 % humidity at 20 °C.  If the units are not SI, give a value.
    region : ((d,), (d,)), m
        Box of reference positions.  The condition acts inside this box only.

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
        """Return the flow condition at time t (s)."""
        return Through(self.ponding, self.at(t, side), True, self.driest)


@dataclass(frozen=True, eq=False)
class Tied(Condition):
    """Two opposite sides of a body from `box` with equal displacements (periodic boundary condition).

    Forces on both sides are equal and opposite.  A wave that leaves the body at one side enters at the opposite side.
    No water flows through tied sides.

    Parameters
    ----------
    side, other
        Names of two opposite sides of a body from `box`, as for `Traction`.  Both sides must have congruent faces.

    Raises
    ------
    ValueError
        The sides are not opposite, or their faces differ.  Another `Tied`, a `Quiet`, `Drained`, `Inflow` or `Rain` is
        on the same part of a face.  `Simulation` or `stage` raises the error.
    """

    side: str
    other: str
    region: ClassVar[None] = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {}


RIGIDITY = 1e4
"""Rigidity of a plate, divided by the oedometric modulus of the body and by the length of the side.  Sensitivity (scene
"plate" of tests/plateaus.py): half this value changes the result by 1.3e-06, and twice this value by 6.7e-07.  Finer
cells change it by 4.8e-05.
"""
HOLD = 3e2
"""Penalty stiffness for prescribed displacements, times cell size, divided by the `holding` modulus.

The displacement error is the change of the traction in the step, divided by the stiffness.  If a body is much stiffer
than the penalty, multipliers remove this error (`HoldLoads.augment`).  Sensitivity (scene "soil" of tests/plateaus.py):
half this value changes the result by 5.9e-05, and twice this value by 2.0e-05.  Finer cells change it by 3.0e-02.
"""
YIELDING = 0.1
"""For laws with state variables, the modulus of the penalty is this factor times the elastic modulus.

Sensitivity (scene "soil" of tests/plateaus.py): half this value changes the result by 6.5e-05, and twice this value by
1.9e-05. Finer cells change it by 3.0e-02.
"""


def resistance(material: Skeleton) -> NDArray[np.float64]:
    """Return the reference modulus, in Pa, of a material at a side: the smaller of oedometric modulus and 4 G."""
    return np.minimum(material.oedometric, 4 * material.shear)


def holding(material: Skeleton) -> NDArray[np.float64]:
    """Return the reference modulus, in Pa, of the penalty for prescribed displacements.

    A nearly incompressible Q1 field cannot follow a curved side, so the penalty must not be much stiffer than the shear
    stiffness.  In an undrained cavity, the penalty modulus 300 (lambda + 2G) gives up to 1.9 times the exact pressure.
    The modulus 30 (4G) gives 1.01 times the exact pressure.  Below tools, this modulus is the penalty for gaps that
    deviate from the mean gap of a cell.
    """
    return (YIELDING if material.state else 1.0) * resistance(material)


@dataclass(frozen=True, eq=False)
class Displacement(Condition):
    """Side of the bodies with a prescribed displacement, such as a side under a footing or in a moving clamp.

    `Simulation.reactions` contains the forces of the side on the bodies.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.
    value : (d,) or callable (t, X) -> (d,) or (m, d), m
        Displacement at reference positions X (m, d), since the start of the run, or since a stage set displacements to
        zero.  The value has d components, even if only some of them are prescribed.
    components
        Prescribed components, such as "y".  By default all d components are prescribed.
    region : ((d,), (d,)), m
        Box of reference positions.  The displacement is prescribed inside this box.  The box may end within a cell.
        Nodes of this cell outside the box are prescribed too if the box covers more than half of the cell.

    Raises
    ------
    ValueError
        No body has this side, or `value` or `components` is invalid.  A wall fixes a component whose value is not 0.
        Another `Displacement` prescribes this component on the same part of a face, or, with another value, at a common
        edge.  `Simulation`, `stage` or a step raises the error.
    """

    side: str
    value: ArrayLike | Callable[..., ArrayLike]
    components: str = ""
    region: Region | None = None
    FUNCTIONS: ClassVar[Mapping[str, Sequence[str]]] = {"value": ("t", "X")}
    MOVED: ClassVar[tuple[str, ...]] = ("value",)

    def axes(self, dim: int) -> list[int]:
        """Return the axes of the prescribed components."""
        if not isinstance(self.components, str) or any(c not in "xyz"[:dim] for c in self.components):
            raise ValueError(f"{line(self)}: components must be letters of {'xyz'[:dim]!r}")
        return sorted("xyz".index(c) for c in set(self.components or "xyz"[:dim]))

    def at(self, t: float, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements (n, d), in m, at time t (s) and reference positions X (n, d), in m."""
        value = self._given("value", t, lambda name: X, X.shape[1], number=False)
        return np.broadcast_to(value, X.shape)


@dataclass(frozen=True, eq=False)
class _OfPlate(Traction):
    """Uniform traction of a plate."""

    def at(self, t: float, dim: int, side: Places | None = None) -> NDArray[np.float64]:
        return self.value(t)


@dataclass(frozen=True, eq=False)
class RigidPlate(Condition):
    """Rigid, smooth plate on a flat side of the bodies.  The displacement normal to the side is uniform.

    The penalty energy is kappa/2 int (grad_t x_n)^2 dA, with the position x_n along the normal, the gradient grad_t
    along the side, and the stiffness kappa (`RIGIDITY`).  The plate transfers the total force exactly.

    Parameters
    ----------
    side
        Side of the bodies, as for `Traction`.  The seeded faces must be connected, and in one plane normal to an axis.
    force : float or callable t (s) -> float, N (N/m in plane strain)
        Total force on the side, positive for compression.  In axisymmetry, the force is the total over the
        circumference.
    region : ((d,), (d,)), m
        Box of reference positions.  The plate acts inside this box only.

    Raises
    ------
    ValueError
        The force is not finite, or no body has this side.  The faces are not connected or not coplanar; define one
        plate, with a region, for each part.  `Simulation`, `stage` or a step raises the error.
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
        """Return the plate's traction: the force along `inward` (d,), divided by the reference `area`, in m^(d-1)."""

        def even(t: float) -> NDArray[np.float64]:
            return inward * self._given("force", t) / area

        return _OfPlate(self.side, even, self.region)


def facing(faces: Surface) -> tuple[int, int]:
    """Return the axis nearest to the mean outward normal of seeded faces, and the sign of the normal along it."""
    outward = faces.outward.sum(axis=0)
    axis = int(np.abs(outward).argmax())
    return axis, int(np.sign(outward[axis]))


def inward(faces: Surface) -> NDArray[np.float64]:
    """Return the unit vector (d,) into the body, along the axis nearest to the mean normal of seeded faces."""
    axis, sign = facing(faces)
    return -sign * np.eye(faces.outward.shape[1])[axis]
