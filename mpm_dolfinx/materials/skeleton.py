# SPDX-License-Identifier: MIT
"""Materials: constitutive laws of the skeleton in UFL, and constants of skeleton and pore fluid.

The material point method and the finite element reference use the same laws.  User-defined laws derive from `Skeleton`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from inspect import signature
from math import inf
from typing import Any, ClassVar

import numpy as np
import ufl
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import Constants, at_places, functions, instance, line, numbers
from mpm_dolfinx.forms.axes import planar
from mpm_dolfinx.materials.user_functions import expression
from mpm_dolfinx.pores.retention import check_retention

Field = float | Sequence[float] | Callable[[NDArray[np.float64]], ArrayLike]
"""A constant (number or vector), or a function of the reference positions X (n, d), in m, that returns values (n, ...).

X contains the points of one process only.  The value at a point must not depend on other points: do not use means.
"""

BY_MODULI = "bulk = E / (3 - 6 nu) and shear = E / (2 + 2 nu)"
BY_GRAINS = "grain_density, kg/m^3, and porosity: dry soil weighs 9.81 (1 - porosity) grain_density, N/m^3"

BY_SCENE = ("dt", "cell_size")
"""Arguments that laws receive from the scene: the time since the start of the step, s, and the cell size, m."""

DRIED = ("suction", "suction_at_start")
"""State variables that the scene sets: suction max(-p, 0), Pa, at the end of a substep, and suction at seeding."""

LOCKING = 0.43
"""Poisson's ratio nu above which cells use F-bar, which doubles the run time of a step.

The tip deflection of a drained beam, in cells of 0.015 m, has these errors:
nu = 0.3: -0.02 % without F-bar, +0.22 % with F-bar.
nu = 0.45: -0.44 % without F-bar, +0.21 % with F-bar.
nu = 0.49: -2.0 % without F-bar, +0.21 % with F-bar.
nu = 0.499: -10.3 % without F-bar, -0.02 % with F-bar.
"""

SEPARATION = 1e-4
"""Relative difference added to equal eigenvalues, so that derivatives are finite.  Sensitivity (scene "beam" of
tests/plateaus.py): half this value changes the result by 1.8e-09, and twice this value by 7.2e-09.  Finer cells change
it by 1.5e-02.
"""


@dataclass(frozen=True)
class Skeleton(Constants):
    """Porous skeleton, the base class of all laws.  Parameters may vary with position, see `Field`.

    Parameters
    ----------
    bulk
        Drained bulk modulus K, Pa, > 0: the modulus in three dimensions, also for plane strain.
    shear
        Shear modulus G, Pa, > 0.
    porosity
        Initial porosity n0, in (0, 1).
    conductivity
        Hydraulic conductivity k, m/s, >= 0.
    biot
        Biot coefficient alpha, in [porosity, 1].
    grain_bulk
        Bulk modulus of the grains K_s, Pa, > 0; infinite for incompressible grains.
    grain_density
        Density of the grains, kg/m^3, >= 0; used only with gravity.
    conductivity_law
        Function that returns the present conductivity k, m/s, as UFL.  Its arguments may be conductivity (the field
        above), F, J = det F, porosity, porosity0, x (present position), and p (pore pressure of the cell at the start
        of the substep, Pa).
    retention
        Retention curve and relative permeability: `VanGenuchten`, `Gardner`, `BrooksCorey` or a user-defined object,
        see `retention`.  Pass this argument by name.  With None the pores stay saturated.

    A law adds its parameters as fields of the dataclass and defines one of the static methods below.  Arguments of a
    method may be F, and the law's fields, properties and state variables.  F is (d, d) in general.  In axisymmetry F is
    (3, 3), with the circumferential stretch last, see `axes`.  In plane strain F is (3, 3), with the out-of-plane
    stretch last, if Q1 cells would lock without F-bar, or if the soil has an initial stress.  For a law that does not
    accept F (3, 3) in plane strain, F is (2, 2).

    energy
        Stored energy psi per reference volume, Pa.  Stress and tangent are UFL's derivatives.
    kirchhoff
        Kirchhoff stress tau = J sigma', Pa, (d, d) or (3, 3), of a law without an energy.  UFL gives the tangent.

    The law's `state` contains the initial values of the history variables, by name.  `update` (F, ...) -> {name: UFL}
    computes new values at the points after every converged step.  If a new value is not finite, the time step is
    reduced.

    A law whose stress has no closed formula has local unknowns.  `unknowns` contains the names of the unknowns, and the
    values at which Newton's method starts.  Unknowns are arguments of `kirchhoff` and `update`.  Unknowns and residuals
    should be scaled to values of about one.

    residual
        Function of the law's fields, state, unknowns and `trial`.  The function returns a dict with UFL for each
        unknown, of the shape of the unknown.  Newton's method solves residual = 0 at each point.
    solution
        Alternative to `residual` in numpy, for return mappings with many cases, and for existing codes.  The function
        takes arrays (n, ...) of the law's fields, state and `trial`.  The function returns a dict with a pair for each
        unknown: the values (n, ...), and a dict of derivatives (n, ..., ...) by name of the trial value.  A derivative
        may also be a function without arguments that returns the array; it is called only for a tangent.  A missing
        derivative is zero.  Without a solution, return NaN or infinity; the time step is then reduced.  Newton's method
        for the balances is slow if the derivative of `energy` with respect to the unknowns is not zero.
    trial
        Function of F that returns trial values as UFL, by name.  Residuals depend on F only through these values.
        Without `trial`, residuals have F as argument.  Only `kirchhoff` and `update` get trial values other than UFL.

    All these functions may have the argument `dt`, the time since the start of the step, s, for rate-dependent laws.
    If a law receives the new state and dt = 0, it must return the stress at the end of the step.  The argument
    `cell_size`, the mean edge length of a cell, m, can make softening independent of the grid.

    A law that depends on suction has the state variable `suction`, and optionally `suction_at_start`, both initially
    0.0.  The scene sets `suction` to max(-p, 0), Pa, at the end of each substep, and `suction_at_start` to the suction
    at seeding.  Laws with local unknowns use `suction` in `trial`.

    For every law, bulk and shear also scale the ghost penalty, the fixed-stress coefficient and the pressure damping.

    Raises
    ------
    ValueError
        A constant is out of its range.  `Simulation` raises ValueError for invalid fields, names, shapes and functions.

    Examples
    --------
    A user-defined law is a frozen dataclass (demos/README.md shows a law with fibres)::

        @dataclass(frozen=True)
        class Stiffening(mpm.NeoHookean):
            factor: mpm.Field = 1.0

            @staticmethod
            def energy(F, bulk, shear, factor):
                return factor * mpm.NeoHookean.energy(F, bulk, shear)
    """

    bulk: Field
    shear: Field
    porosity: Field = 0.4
    conductivity: Field = 0.0
    biot: Field = 1.0
    grain_bulk: Field = inf
    grain_density: Field = 2650.0
    conductivity_law: Callable | None = None
    retention: Any = field(default=None, kw_only=True)

    FOREIGN: ClassVar = {"E": BY_MODULI, "nu": BY_MODULI, "unit_weight": BY_GRAINS, "density": BY_GRAINS}
    energy: ClassVar[Callable | None] = None
    kirchhoff: ClassVar[Callable | None] = None
    update: ClassVar[Callable | None] = None
    unknowns: ClassVar[Mapping[str, ArrayLike]] = {}
    trial: ClassVar[Callable | None] = None
    residual: ClassVar[Callable | None] = None
    solution: ClassVar[Callable | None] = None
    dilates: ClassVar[bool] = False
    """Whether the law has the parameter `dilation`."""
    elastic_hencky: ClassVar[bool] = False
    """Whether Hencky's law relates stresses and elastic strains."""
    linear: ClassVar[bool] = False
    """Whether the stress is linear in F, so that the factorised stiffness matrix can be reused."""
    state: ClassVar[Mapping[str, ArrayLike]] = {}
    by_scene: ClassVar[tuple[str, ...]] = ()
    """The names `dt` and `cell_size`, if they are arguments of the law's functions."""
    parameters: ClassVar[tuple[str, ...]] = ()
    """Names of fields and properties that are arguments of the law's functions."""

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        for name in ("state", "unknowns"):
            instance(f"{cls.__name__}: {name}", getattr(cls, name), Mapping)
        functions = (cls.energy, cls.kirchhoff, cls.update, cls.trial, cls.residual, cls.solution)
        names = dict.fromkeys(name for f in functions for name in cls.arguments_of(f))
        cls.by_scene = tuple(name for name in BY_SCENE if name in names)
        own = {"F", *BY_SCENE, *cls.state, *cls.unknowns, *(["trial"] if cls.unknowns else [])}
        cls.parameters = tuple(name for name in names if name not in own)
        if "energy" in vars(cls) and "linear" not in vars(cls):
            cls.linear = False  # a new energy may be nonlinear

    @staticmethod
    def arguments_of(function: Callable | None) -> list[str]:
        """Return the argument names of one of the law's functions."""
        return [] if function is None else list(signature(function).parameters)

    def __post_init__(self):
        for name, value in vars(self).items():
            if isinstance(value, (list, np.ndarray)):
                object.__setattr__(self, name, deepcopy(value))  # protects against later changes
        functions(
            f"{type(self).__name__}: conductivity_law", [self.conductivity_law] * (self.conductivity_law is not None)
        )
        if self.retention is not None:
            check_retention(f"{type(self).__name__}: retention", self.retention)
        for name in ("bulk", "shear"):
            _check(self, name, lambda v: (0 < v) & (v < inf), "> 0 and finite")
        _check(self, "grain_bulk", lambda v: 0 < v, "> 0")
        for name in ("conductivity", "grain_density"):
            _check(self, name, lambda v: (0 <= v) & (v < inf), ">= 0 and finite")
        _check(self, "porosity", lambda v: (0 < v) & (v < 1), "in (0, 1)")
        drains = getattr(self.conductivity_law, "specific_yield", 0.0)
        if drains and self.retention is not None:
            raise ValueError(
                f"{type(self).__name__}: has retention and a specific yield {drains:g}, must have only one of them"
            )
        _check(self, "porosity", lambda v: v >= drains, f">= the specific yield {drains:g}")
        if not callable(self.porosity):
            n = f" = {self.porosity:g}" if np.ndim(self.porosity) == 0 else ""
            _check(self, "biot", lambda v: (self.porosity <= v) & (v <= 1), f"in [porosity{n}, 1]")

    def at(self, X: NDArray[np.float64]) -> Skeleton:
        """Return this material with its fields evaluated at reference positions X (n, d), in m."""
        values, scalars = {}, [f.name for f in fields(Skeleton)]
        for name in constants_of(self):
            value, what = getattr(self, name), f"{type(self).__name__}: {name}"
            if callable(value):
                given = at_places(what, f"one value for each of {len(X)} positions", value, "X", X)
                values[name] = given = numbers(f"{what}(X)", given, None, allowed="numbers", test=np.isreal)
                if given.shape[:1] != (len(X),) or (name in scalars and given.ndim > 1):
                    more = "" if name in scalars else " ..."
                    allowed = f"({len(X)},{more}), one value for each position"
                    raise ValueError(f"{what}(X) has shape {given.shape}, must be {allowed}")
            elif name in scalars and np.ndim(value):
                raise ValueError(f"{what} has shape {np.shape(value)}, must be a number or a function of X")
        return replace(self, **values)

    @property
    def symmetric(self) -> bool:
        """Whether the tangent is symmetric; assumed false for laws that define `kirchhoff`."""
        return self.kirchhoff is None

    def check_cells(self, cell_size: float) -> None:
        """Raise ValueError if cells of this edge length, in m, are too large for a softening law."""

    @classmethod
    def first_piola(cls, F, values: Mapping[str, object]):
        """Return the first Piola-Kirchhoff effective stress (d, d), in Pa, as UFL.

        `F`: deformation gradient (d, d), a UFL variable.
        `values`: UFL values of the parameters and of the state.
        """
        if cls.kirchhoff is None:
            return ufl.diff(expression(cls.energy, [()], "F", F=F, **values), F)
        return cls.kirchhoff_in_plane(F, values) * ufl.inv(F).T

    @classmethod
    def kirchhoff_in_plane(cls, F, values: Mapping[str, object]):
        """Return the Kirchhoff stress, in Pa, as UFL in the shape of F."""
        d = F.ufl_shape[0]
        tau = cls._kirchhoff(F, values, (d, d))
        return ufl.as_matrix([[tau[a, b] for b in range(d)] for a in range(d)])

    @classmethod
    def _kirchhoff(cls, F, values: Mapping[str, object], shape: tuple[int, int]):
        """Return the Kirchhoff stress, in Pa, as UFL of the given shape or of shape (3, 3)."""
        return expression(cls.kirchhoff, [shape, (3, 3)], "" if cls.unknowns else "F", F=F, **values)

    @classmethod
    def out_of_plane(cls, F, values: Mapping[str, object]):
        """Return the out-of-plane effective Cauchy stress in plane strain, in Pa, as UFL, or None if undefined.

        `F`: deformation gradient (2, 2), a UFL variable.
        `values`: UFL values of the parameters and of the state.
        """
        if cls.kirchhoff is not None:
            tau = cls._kirchhoff(F, values, (2, 2))
            return tau[2, 2] / ufl.det(F) if tau.ufl_shape == (3, 3) else None
        if cls.unknowns:  # their derivative with respect to an out-of-plane stretch is not available
            return None
        whole = ufl.variable(ufl.as_matrix([[F[0, 0], F[0, 1], 0], [F[1, 0], F[1, 1], 0], [0, 0, 1]]))
        try:
            energy = expression(cls.energy, [()], "F", F=whole, **values)
        except ValueError:  # a user-defined law for the plane only
            return None
        return ufl.diff(energy, whole)[2, 2] / ufl.det(F)

    def drained_modulus(self, dim: int) -> float:
        """Return the drained bulk modulus, in Pa: K in 3D, lambda + G in plane strain."""
        return self.bulk if dim == 3 else self.bulk + self.shear / 3

    @property
    def poisson(self) -> float:
        """Poisson's ratio nu."""
        return (3 * self.bulk - 2 * self.shear) / (6 * self.bulk + 2 * self.shear)

    @property
    def nearly_incompressible(self) -> bool:
        """Whether Q1 cells would lock without F-bar, see `mean_dilatation`."""
        return self.poisson > LOCKING

    @property
    def oedometric(self) -> float:
        """Oedometric (P-wave) modulus lambda + 2G, in Pa."""
        return self.bulk + 4 / 3 * self.shear

    def pressure_damping(self) -> float:
        """Return the coefficient tau, in 1/Pa, that damps alternating increments of the pressure.

        For laws with a state, tau is half of the value for macroelements of 2 x 2 cells, 3 alpha^2 / (8 (lambda + 3G))
        (Silvester and Kechkar 1990; Camargo, White and Borja 2021).  For other laws tau is a quarter of the value for
        macroelements, which improves conditioning.  The factor one half would smooth pressures more.  In 3D tau is the
        same as in 2D: the value for 2 x 2 x 2 cells is too small for pressures that alternate along two axes.
        """
        return (0.5 if self.state else 0.25) * self.biot**2 * 3 / (8 * self.macroelement)

    @property
    def macroelement(self) -> float:
        """Modulus lambda + 3G, in Pa, that resists a displacement of the middle node of 2 x 2 cells."""
        return self.bulk + 7 * self.shear / 3

    def storage(self, fluid_bulk: float, porosity):
        """Return the storage coefficient S = n/K_w + (alpha - n)/K_s, in 1/Pa, at a porosity n."""
        return porosity / fluid_bulk + (self.biot - porosity) / self.grain_bulk


def constants_of(material: Skeleton) -> list[str]:
    """Return the names of a material's constants, uniform or functions of position."""
    return [f.name for f in fields(material) if f.name not in ("conductivity_law", "retention")]


def check_given(obj, allowed: Mapping[str, str]) -> None:
    """Raise ValueError if a constant without a default is missing."""
    for name, what in allowed.items():
        if getattr(obj, name) is None:
            raise ValueError(f"{type(obj).__name__}: {name} is not given, must be {what}")


def _check(obj, name: str, test: Callable, allowed: str) -> None:
    """Raise ValueError if a constant is out of its range."""
    value = getattr(obj, name)
    if callable(value):
        return
    try:
        good = np.asarray(test(value) if np.asarray(value).dtype.kind in "iuf" else False)
    except (TypeError, ValueError):
        good = np.array(False)
    if not good.all():
        value = value if good.ndim == 0 else float(np.broadcast_to(value, good.shape)[np.argmin(good)])
        raise ValueError(f"{type(obj).__name__}: {name} = {line(value)}, must be {allowed}")


@dataclass(frozen=True)
class Hencky(Skeleton):
    """Hencky's law: psi = lambda/2 (ln J)^2 + G sum_i (ln lambda_i)^2, with the principal stretches lambda_i.

    2D means plane strain.  Source: Hencky (1928).  The deviatoric part contains a small constant under a square root,
    which keeps the derivatives finite at equal eigenvalues.  Energy and stress at F = I are exactly zero.  Parameters:
    see `Skeleton`.
    """

    @staticmethod
    def energy(F, bulk, shear):
        """Return the stored energy, in Pa, as UFL."""
        d, plane = F.ufl_shape[0], planar(F)
        deviatoric = _deviatoric(F.T * F, plane) - _deviatoric(ufl.Identity(d), plane)
        return (bulk / 2 + (1 / d - 1 / 3) * shear) * ufl.ln(ufl.det(F)) ** 2 + shear * deviatoric


def _deviatoric(C, plane: bool):
    """Return `sum l_i^2 - (sum l_i)^2 / d` as UFL for the logarithmic principal stretches l_i, with C = F^T F (d, d).

    plane: whether the third axis is principal.
    """
    d = C.ufl_shape[0]
    if plane:
        block = ufl.as_matrix([[C[i, j] for j in (0, 1)] for i in (0, 1)])
        across = ufl.ln(ufl.det(block)) / 2 - ufl.ln(C[2, 2]) if d == 3 else 0
        return _stretch_difference(block) ** 2 / 2 + across**2 / 6
    logs = [ufl.ln(e) / 2 for e in _eigenvalues(C / (ufl.tr(C) / d))]
    return sum(l**2 for l in logs) - sum(logs) ** 2 / d


def _stretch_difference(C):
    """Return the difference of the logarithmic principal stretches for the tensor C = F^T F (2, 2), as UFL."""
    ratio = ((C[0, 0] - C[1, 1]) ** 2 + 4 * C[0, 1] ** 2) / (C[0, 0] + C[1, 1]) ** 2
    radius = ufl.sqrt(ratio + SEPARATION**2 / 4)
    return (ufl.ln(1 + radius) - ufl.ln(1 - radius)) / 2


def _eigenvalues(C, separation: float = SEPARATION):
    """Return eigenvalues of a symmetric 2x2 or 3x3 tensor as UFL, slightly separated if they are equal."""
    if C.ufl_shape[0] == 2:
        mean = (C[0, 0] + C[1, 1]) / 2
        radius = ufl.sqrt((C[0, 0] - C[1, 1]) ** 2 + 4 * C[0, 1] ** 2 + separation**2) / 2
        return mean + radius, mean - radius
    mean = ufl.tr(C) / 3
    D = C - mean * ufl.Identity(3)
    r = ufl.sqrt(ufl.inner(D, D) / 6 + (separation / 10) ** 2)
    phi = ufl.acos((1 - (10 * separation) ** 2) * ufl.det(D) / (2 * r * r * r)) / 3
    return tuple(mean + 2 * r * ufl.cos(phi + 2 * ufl.pi * k / 3) for k in range(3))


@dataclass(frozen=True)
class NeoHookean(Skeleton):
    """Compressible neo-Hookean law: psi = G/2 (F:F - d - 2 ln J) + lambda/2 (ln J)^2.

    2D means plane strain.  Source: Simo and Pister (1984).  Parameters: see `Skeleton`.
    """

    @staticmethod
    def energy(F, bulk, shear):
        """Return the stored energy, in Pa, as UFL."""
        ln_J = ufl.ln(ufl.det(F))
        lam = bulk - 2 * shear / 3
        return shear / 2 * (ufl.inner(F, F) - F.ufl_shape[0] - 2 * ln_J) + lam / 2 * ln_J**2


@dataclass(frozen=True)
class LinearElastic(Skeleton):
    """Linear elasticity of small strain: psi = lambda/2 (tr eps)^2 + G eps:eps with eps = sym F - I.

    The law is not objective, so rotations must be small.  Parameters: see `Skeleton`.
    """

    linear: ClassVar[bool] = True

    @staticmethod
    def energy(F, bulk, shear):
        """Return the stored energy, in Pa, as UFL."""
        eps = ufl.sym(F) - ufl.Identity(F.ufl_shape[0])
        return (bulk - 2 * shear / 3) / 2 * ufl.tr(eps) ** 2 + shear * ufl.inner(eps, eps)


def kozeny_carman(conductivity, porosity, porosity0):
    """Return k = k0 n^3 / (1 - n)^2 / (n0^3 / (1 - n0)^2), m/s, the law of Kozeny (1927) and Carman (1937).

    The function can be the `conductivity_law` of a material.

    Parameters
    ----------
    conductivity
        k0, m/s: the material's conductivity at the initial porosity.
    porosity, porosity0
        Present and initial porosity, n and n0, in (0, 1).
    """
    return conductivity * (porosity / porosity0) ** 3 * ((1 - porosity0) / (1 - porosity)) ** 2


def filled(p, suction):
    """Return the saturation of drainable pores: a cubic function of p from 0 at -`suction` to 1 at `suction`."""
    x = ufl.max_value(0.0, ufl.min_value(1.0, (1 + p / suction) / 2))
    return x**2 * (3 - 2 * x)


@dataclass(frozen=True, eq=False)
class unsaturated:
    """Conductivity law for flow below a free surface, as `conductivity_law` of a material.

    A smooth cubic reduces the conductivity from k at p = `suction` to `least` * k at p = -`suction` (Bathe and
    Khoshgoftaar 1979).  Drainable pores empty along the same cubic, and other pores stay full.  The soil's weight is
    computed with full pores.  The law uses the pressure at the start of each substep.  Steady flow therefore needs
    steps of about h^2 / c_v, with the cell size h and the coefficient of consolidation c_v.

    Parameters
    ----------
    suction
        Half the width, Pa, > 0, of the range of p in which the conductivity changes.  Recommended: 0.5 to 1 times unit
        weight of water times cell height.
    least
        Conductivity of drained soil, divided by the conductivity of saturated soil, in (0, 1).
    specific_yield
        Drainable porosity, in [0, 1), at most the porosity.  If it is 0, a free surface moves to its steady position at
        once, so only steady flow is meaningful.
    """

    suction: float
    least: float = 1e-4
    specific_yield: float = 0.0

    def __post_init__(self):
        numbers("unsaturated: suction", self.suction, test=lambda v: (0 < v) & (v < inf), allowed="> 0 and finite")
        numbers("unsaturated: least", self.least, test=lambda v: (0 < v) & (v < 1), allowed="in (0, 1)")
        drains, allowed = self.specific_yield, "in [0, 1)"
        numbers("unsaturated: specific_yield", drains, test=lambda v: (0 <= v) & (v < 1), allowed=allowed)

    def __call__(self, conductivity, p):
        """Return the conductivity, in m/s, as UFL."""
        return conductivity * (self.least + (1 - self.least) * filled(p, self.suction))


@dataclass(frozen=True)
class Fluid(Constants):
    """Pore fluid.

    Parameters
    ----------
    bulk
        Bulk modulus K_w, Pa, > 0; infinite for an incompressible fluid.
    density
        Density rho_w at zero pressure, kg/m^3, > 0.  Weights are computed with rho_w.  Flowing fluid has the density
        rho_w exp(p / K_w).
    gravity
        Acceleration g that defines hydraulic conductivities, m/s^2, > 0.  By default g is the magnitude of the scene's
        gravity.  If this gravity is absent, zero or a function of time, g is 9.81. With units other than m and s,
        scenes without gravity, or with gravity as a function of time, require this argument.

    Raises
    ------
    ValueError
        A constant is out of its range.
    """

    bulk: float = 2.2e9
    density: float = 1000.0
    gravity: float | None = None
    FOREIGN: ClassVar = {"unit_weight": "density = unit_weight / 9.81"}

    def __post_init__(self):
        finite = {"test": lambda v: (0 < v) & (v < inf), "allowed": "> 0 and finite"}
        numbers("Fluid: bulk", self.bulk, test=lambda v: 0 < v, allowed="> 0")
        if self.gravity is not None:
            numbers("Fluid: gravity", self.gravity, **finite)
        numbers("Fluid: density", self.density, **finite)
        object.__setattr__(self, "density", float(self.density))  # forms with an integer times gravity do not compile

    @property
    def unit_weight(self) -> float:
        """Unit weight rho_w g, in N/m^3, that turns a hydraulic conductivity into a mobility k/(rho_w g)."""
        return self.density * (self.gravity or STANDARD_GRAVITY)


STANDARD_GRAVITY = 9.81  # m/s^2, default g that defines conductivities.  Source: standard gravity of 1901
