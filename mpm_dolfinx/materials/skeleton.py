# SPDX-License-Identifier: MIT
"""Materials: the law of the skeleton in UFL, and the constants of skeleton and pore fluid.

Both the material point method and the finite element reference use these, so a law is written once.
A law of your own is a frozen dataclass derived from `Skeleton`: see there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from inspect import signature
from math import inf
from typing import Any, ClassVar

import numpy as np
import ufl
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.validation import at_places, functions, instance, line, numbers
from mpm_dolfinx.forms.axes import planar
from mpm_dolfinx.materials.user_functions import expression
from mpm_dolfinx.pores.retention import check_retention

Field = float | Sequence[float] | Callable[[NDArray[np.float64]], ArrayLike]
"""A constant (number or vector), or a function of the reference positions X (n, d), m, that gives (n, ...)."""

BY_SCENE = ("dt", "cell_size")
"""What the scene gives to laws: time since the start of the step, s, and mean length of a cell, m."""

DRIED = ("suction", "suction_at_start")
"""States that the scene sets where a law has them: suction max(-p, 0) at the end of a substep, and as seeded, Pa."""

LOCKING = 0.43
"""Poisson's ratio above which the mean dilatation of a cell is used, at twice the cost of a step.

Tip of the drained beam at h = 0.015 m, plain and with it: -0.02 and +0.22 % at nu = 0.3, -0.44 and +0.21 % at
0.45, -2.0 and +0.21 % at 0.49, -10.3 and -0.02 % at 0.499; at h = 0.06 m and 0.499: -56 and -0.4 %.
"""

APART = 1e-4
"""By how much equal eigenvalues are set apart, in proportion to them, so that their derivatives are finite.

Plateau (beam): halved 1.8e-09, doubled 7.2e-09, cells 1.5e-02.
"""


@dataclass(frozen=True)
class Skeleton:
    """Porous skeleton: what every law has.  All but the last may differ from place to place, see `Field`.

    Parameters
    ----------
    bulk
        Drained bulk modulus K, Pa, > 0 (3D modulus, also in plane strain).
    shear
        Shear modulus G, Pa, > 0.
    porosity
        Volume fraction of the pores at the start n0, in (0, 1).
    conductivity
        Hydraulic conductivity k, m/s, >= 0.
    biot
        Biot coefficient alpha, in [porosity, 1].
    grain_bulk
        Bulk modulus of the grains K_s, Pa, > 0; infinite for incompressible grains.
    grain_density
        Density of the grains, kg/m^3, >= 0; used with gravity only.
    conductivity_law
        Function that gives the conductivity k, m/s, in UFL, at the present deformation.  It is called with
        those of these arguments that it names: conductivity (the field above), F, J = det F, porosity,
        porosity0, x (present position), p (pore pressure of the cell at the start of the substep, Pa).
    retention
        How pores drain under suction, and how they then conduct: `VanGenuchten`, `Gardner`, `BrooksCorey` or an object
        with their methods, see `retention`; by keyword.  None: pores stay full.

    A law adds its own parameters as fields of the dataclass and defines one of these static methods, which
    are called with those arguments that they name: F, the law's fields and properties, its state.  F is (d, d), in
    axisymmetry (3, 3) with the hoops' stretch last, see `axes`.  So it is in plane strain, with the stretch across the
    plane, for laws that take it, where Q1 cells would lock and of soil that is seeded with a stress.

    energy
        Stored energy psi per reference volume, Pa.  Stress and tangent are UFL's derivatives.
    kirchhoff
        Kirchhoff stress tau = J sigma', Pa, (d, d) or (3, 3), where there is no energy; the tangent is UFL's.

    What evolves is the law's `state`, name -> value at the start, which `update` (F, ...) -> {name: UFL}
    sets anew at the points after every converged step; a state that is not finite cuts the step.

    Stresses that no closed formula gives have local `unknowns`, name -> value where their iteration begins, which
    `kirchhoff` and `update` may name.  They are of order one, and so are their equations:

    residual
        Called with the law's fields, its state, its unknowns, and `trial`; gives name -> UFL of the unknown's shape,
        which Newton's method makes zero at each point.
    solution
        In place of residual, in numpy: called with arrays (n, ...) of the law's fields, its state and `trial`, gives
        name -> (the unknown (n, ...), {name of a trial value: its derivative by it (n, ..., ...)}).  For returns with
        many cases, and laws that exist elsewhere: their stress, and what `update` sets the state to, are the unknowns.
        A derivative may be a function without arguments that gives it: it is called where there is a tangent to make.
        One that is left out is zero.  Where it gives NaN or infinity there is no solution: the step is cut.  A law with
        an `energy` that is not stationary in these unknowns takes many Newton steps, for want of second derivatives.
    trial
        (F, ...) -> {name: UFL}: all by which the residuals depend on F; without it they name F itself.  What is no UFL
        in it the residuals do not see; `kirchhoff` and `update` may name `trial` too, and see all of it.

    All of these functions may name `dt`, the time since the start of the step, s: laws of rates, whose state at the end
    of a step has to give its stress at dt = 0.  And `cell_size`, the mean length of a cell of the grid, m: by this what
    softens is made independent of the grid.

    A law that depends on suction has `suction`: 0.0 in its state, and may have `suction_at_start`: 0.0.  The scene sets
    them: max(-p, 0) at the end of a substep, and as seeded, Pa.  Local unknowns see it as one of the `trial`.

    bulk and shear
    are also what the scheme takes its scales from (ghost penalty, fixed-stress coefficient, damping of pressures),
    for every law.

    Raises
    ------
    ValueError
        A constant that is out of its range; from the scene: fields that are, names or shapes that do not agree, or
        functions that raise or give anything but UFL of the shape that is wanted.

    Examples
    --------
    A law of your own is a frozen dataclass (the README has one with a fibre)::

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

    energy: ClassVar[Callable | None] = None
    kirchhoff: ClassVar[Callable | None] = None
    update: ClassVar[Callable | None] = None
    unknowns: ClassVar[Mapping[str, ArrayLike]] = {}
    trial: ClassVar[Callable | None] = None
    residual: ClassVar[Callable | None] = None
    solution: ClassVar[Callable | None] = None
    dilates: ClassVar[bool] = False
    """Whether the law has an angle of `dilation`."""
    elastic_hencky: ClassVar[bool] = False
    """Whether stresses are those of elastic strains by Hencky's law: then they tell the elastic energy."""
    linear: ClassVar[bool] = False
    """Whether the stress is linear in F: one factorisation then serves for as long as the active cells stay."""
    state: ClassVar[Mapping[str, ArrayLike]] = {}
    by_scene: ClassVar[tuple[str, ...]] = ()
    """Which of `BY_SCENE` the law's functions take."""
    parameters: ClassVar[tuple[str, ...]] = ()
    """Names of the fields and properties that the law's functions take."""

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        for name in ("state", "unknowns"):
            instance(f"{cls.__name__}: {name}", getattr(cls, name), Mapping)
        functions = (cls.energy, cls.kirchhoff, cls.update, cls.trial, cls.residual, cls.solution)
        names = dict.fromkeys(name for f in functions for name in cls.taken_by(f))
        cls.by_scene = tuple(name for name in BY_SCENE if name in names)
        own = {"F", *BY_SCENE, *cls.state, *cls.unknowns, *(["trial"] if cls.unknowns else [])}
        cls.parameters = tuple(name for name in names if name not in own)
        if "energy" in vars(cls) and "linear" not in vars(cls):
            cls.linear = False  # not what the law had that this one is derived from

    @staticmethod
    def taken_by(function: Callable | None) -> list[str]:
        """Return the names of the arguments of one of the law's functions."""
        return [] if function is None else list(signature(function).parameters)

    def __post_init__(self):
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
                f"{type(self).__name__}: retention beside a specific yield {drains:g}, must be one of them"
            )
        _check(self, "porosity", lambda v: v >= drains, f">= the specific yield {drains:g}")
        if not callable(self.porosity):
            n = f" = {self.porosity:g}" if np.ndim(self.porosity) == 0 else ""
            _check(self, "biot", lambda v: (self.porosity <= v) & (v <= 1), f"in [porosity{n}, 1]")

    def at(self, X: NDArray[np.float64]) -> Skeleton:
        """Return this material with its fields evaluated at reference positions X (n, d), m: arrays (n, ...)."""
        values, scalars = {}, [f.name for f in fields(Skeleton)]
        for name in constants_of(self):
            value, what = getattr(self, name), f"{type(self).__name__}: {name}"
            if callable(value):
                given = at_places(what, f"one value for each of {len(X)} positions", value, "X", X)
                values[name] = given = numbers(f"{what}(X)", given, None, allowed="numbers", test=np.isreal)
                if given.shape[:1] != (len(X),) or (name in scalars and given.ndim > 1):
                    more = "" if name in scalars else " ..."
                    allowed = f"one value a position, ({len(X)},{more})"
                    raise ValueError(f"{what}(X) has shape {given.shape}, must be {allowed}")
            elif name in scalars and np.ndim(value):
                raise ValueError(f"{what} has shape {np.shape(value)}, must be a number or a function of X")
        return replace(self, **values)

    @property
    def symmetric(self) -> bool:
        """Whether the tangent is symmetric; laws that give the stress are taken not to be."""
        return self.kirchhoff is None

    def check_cells(self, cell_size: float) -> None:
        """Refuse cells too large for a law that softens, with a ValueError; cell_size: m."""

    @classmethod
    def first_piola(cls, F, values: Mapping[str, object]):
        """Return the first Piola-Kirchhoff effective stress (d, d), Pa, as UFL.

        Parameters
        ----------
        F
            Deformation gradient (d, d), a UFL variable.
        values
            UFL values of the parameters and of the state.
        """
        if cls.kirchhoff is None:
            return ufl.diff(expression(cls.energy, [()], "F", F=F, **values), F)
        return cls.kirchhoff_in_plane(F, values) * ufl.inv(F).T

    @classmethod
    def kirchhoff_in_plane(cls, F, values: Mapping[str, object]):
        """Return the Kirchhoff stress of the shape of F, Pa, as UFL, of a law that gives it."""
        d = F.ufl_shape[0]
        tau = cls._kirchhoff(F, values, (d, d))
        return ufl.as_matrix([[tau[a, b] for b in range(d)] for a in range(d)])

    @classmethod
    def _kirchhoff(cls, F, values: Mapping[str, object], shape: tuple[int, int]):
        """Return the Kirchhoff stress of a shape or (3, 3), Pa, as UFL; it may depend on F by local unknowns alone."""
        return expression(cls.kirchhoff, [shape, (3, 3)], "" if cls.unknowns else "F", F=F, **values)

    @classmethod
    def out_of_plane(cls, F, values: Mapping[str, object]):
        """Return the effective Cauchy stress across the plane of plane strain, Pa, as UFL; None if the law has none.

        Parameters
        ----------
        F
            Deformation gradient (2, 2), a UFL variable.
        values
            UFL values of the parameters and of the state.
        """
        if cls.kirchhoff is not None:
            tau = cls._kirchhoff(F, values, (2, 2))
            return tau[2, 2] / ufl.det(F) if tau.ufl_shape == (3, 3) else None
        if cls.unknowns:  # by how much these change with a stretch across the plane is not known
            return None
        whole = ufl.variable(ufl.as_matrix([[F[0, 0], F[0, 1], 0], [F[1, 0], F[1, 1], 0], [0, 0, 1]]))
        try:
            energy = expression(cls.energy, [()], "F", F=whole, **values)
        except ValueError:  # a law of the user's for the plane only
            return None
        return ufl.diff(energy, whole)[2, 2] / ufl.det(F)

    def drained_modulus(self, dim: int) -> float:
        """Return the drained bulk modulus K_dr, Pa, of so many axes of F: K of three, lambda + G in plane strain."""
        return self.bulk if dim == 3 else self.bulk + self.shear / 3

    @property
    def poisson(self) -> float:
        """Poisson's ratio nu."""
        return (3 * self.bulk - 2 * self.shear) / (6 * self.bulk + 2 * self.shear)

    @property
    def nearly_incompressible(self) -> bool:
        """Whether Q1 cells would lock, so that the law is given the mean dilatation of each cell (`dilatation`)."""
        return self.poisson > LOCKING

    @property
    def oedometric(self) -> float:
        """Oedometric (P-wave) modulus lambda + 2G, Pa."""
        return self.bulk + 4 / 3 * self.shear

    def pressure_damping(self) -> float:
        """Return tau, 1/Pa: a quarter of the jump stabilisation of 2 x 2 cells, half of it for laws with a state.

        3 alpha^2 / (8 (lambda + 3G)); a quarter is better conditioned and smears less (Silvester and Kechkar 1990;
        Camargo, White and Borja 2021).  That of 2 x 2 x 2 cells is up to 0.44 less: too little in 3D for pressures that
        alternate along two axes alone, which are those of plane strain.  What alternates as soil begins to yield
        stays: the damping, of the step's increments, does not see it any more.
        """
        lam = self.bulk - 2 * self.shear / 3
        return (0.5 if self.state else 0.25) * self.biot**2 * 3 / (8 * (lam + 3 * self.shear))

    def storage(self, fluid_bulk: float, porosity):
        """Return the storage coefficient S = n/K_w + (alpha - n)/K_s, 1/Pa, at a porosity."""
        return porosity / fluid_bulk + (self.biot - porosity) / self.grain_bulk


def constants_of(material: Skeleton) -> list[str]:
    """Return the names of a material's constants, which may differ from place to place."""
    return [f.name for f in fields(material) if f.name not in ("conductivity_law", "retention")]


def check_given(obj, allowed: Mapping[str, str]) -> None:
    """Refuse a material without one of the constants that have no values safe to assume; allowed: what they may be."""
    for name, what in allowed.items():
        if getattr(obj, name) is None:
            raise ValueError(f"{type(obj).__name__}: {name} is not given, must be {what}")


def _check(obj, name: str, test: Callable, allowed: str) -> None:
    """Refuse a constant, or the first value of an array, that fails a test; fields wait until they are evaluated."""
    value = getattr(obj, name)
    if callable(value):
        return
    try:
        good = np.asarray(test(value))
    except TypeError:
        good = np.array(False)
    if not good.all():
        value = value if good.ndim == 0 else float(np.broadcast_to(value, good.shape)[np.argmin(good)])
        raise ValueError(f"{type(obj).__name__}: {name} = {line(value)}, must be {allowed}")


@dataclass(frozen=True)
class Hencky(Skeleton):
    """Hencky's law: psi = lambda/2 (ln J)^2 + G sum_i (ln lambda_i)^2, lambda_i the principal stretches.

    Plane strain in 2D.  Hencky (1928); a small constant under the root keeps the derivatives of the
    eigenvalues of C = F^T F finite where they coincide.  It enters the deviatoric part only, whose
    derivative vanishes there: at rest there is no stress at all.  Parameters as for `Skeleton`.
    """

    @staticmethod
    def energy(F, bulk, shear):
        """Return psi, Pa, as UFL of F (d, d)."""
        d, ln_J = F.ufl_shape[0], ufl.ln(ufl.det(F))
        if d == 3 and planar(F):
            return bulk / 2 * ln_J**2 + shear * _deviatoric(F)
        C = F.T * F
        if d == 2:
            deviatoric = _spread(C) ** 2 / 2
        else:
            logs = [ufl.ln(e) / 2 for e in _eigenvalues(C / (ufl.tr(C) / d))]
            deviatoric = sum(l**2 for l in logs) - sum(logs) ** 2 / d
        return ((bulk - 2 * shear / 3) / 2 + shear / d) * ln_J**2 + shear * deviatoric


def _deviatoric(F):
    """Return sum l_i^2 - (sum l_i)^2 / 3 of the logarithmic stretches l_i of an axisymmetric F, as UFL."""
    whole = F.T * F
    C = ufl.as_matrix([[whole[i, j] for j in (0, 1)] for i in (0, 1)])
    return _spread(C) ** 2 / 2 + (ufl.ln(ufl.det(C)) / 2 - ufl.ln(whole[2, 2])) ** 2 / 6


def _spread(C):
    """Return by how much the logarithms of the principal stretches of a symmetric 2x2 tensor differ, as UFL.

    Its eigenvalues over their mean are 1 + radius and 1 - radius: one quotient, where second derivatives of C / mean
    take twice as many divisions.
    """
    ratio = ((C[0, 0] - C[1, 1]) ** 2 + 4 * C[0, 1] ** 2) / (C[0, 0] + C[1, 1]) ** 2
    radius = ufl.sqrt(ratio + APART**2 / 4)
    return (ufl.ln(1 + radius) - ufl.ln(1 - radius)) / 2


def _eigenvalues(C, apart: float = APART):
    """Return the eigenvalues of a symmetric 2x2 or 3x3 tensor as UFL, equal ones set apart."""
    if C.ufl_shape[0] == 2:
        mean = (C[0, 0] + C[1, 1]) / 2
        radius = ufl.sqrt((C[0, 0] - C[1, 1]) ** 2 + 4 * C[0, 1] ** 2 + apart**2) / 2
        return mean + radius, mean - radius
    mean = ufl.tr(C) / 3
    D = C - mean * ufl.Identity(3)
    r = ufl.sqrt(ufl.inner(D, D) / 6 + (apart / 10) ** 2)
    phi = ufl.acos((1 - (10 * apart) ** 2) * ufl.det(D) / (2 * r * r * r)) / 3
    return tuple(mean + 2 * r * ufl.cos(phi + 2 * ufl.pi * k / 3) for k in range(3))


@dataclass(frozen=True)
class NeoHookean(Skeleton):
    """Compressible neo-Hookean law: psi = G/2 (F:F - d - 2 ln J) + lambda/2 (ln J)^2.

    Plane strain in 2D.  Simo and Pister (1984).  Parameters as for `Skeleton`.
    """

    @staticmethod
    def energy(F, bulk, shear):
        """Return psi, Pa, as UFL of F (d, d)."""
        ln_J = ufl.ln(ufl.det(F))
        lam = bulk - 2 * shear / 3
        return shear / 2 * (ufl.inner(F, F) - F.ufl_shape[0] - 2 * ln_J) + lam / 2 * ln_J**2


@dataclass(frozen=True)
class LinearElastic(Skeleton):
    """Linear elasticity of small strain: psi = lambda/2 (tr eps)^2 + G eps:eps, eps = sym F - I.

    Not objective, so only for small rotations.  Parameters as for `Skeleton`.
    """

    linear: ClassVar[bool] = True

    @staticmethod
    def energy(F, bulk, shear):
        """Return psi, Pa, as UFL of F (d, d)."""
        eps = ufl.sym(F) - ufl.Identity(F.ufl_shape[0])
        return (bulk - 2 * shear / 3) / 2 * ufl.tr(eps) ** 2 + shear * ufl.inner(eps, eps)


def kozeny_carman(conductivity, porosity, porosity0):
    """Return k = k0 n^3 / (1 - n)^2 / (n0^3 / (1 - n0)^2), m/s, the law of Kozeny (1927) and Carman (1937).

    To be given to a material as its `conductivity_law`.

    Parameters
    ----------
    conductivity
        k0, m/s: the material's conductivity, at the porosity at the start.
    porosity, porosity0
        Porosity now and at the start, n and n0, in (0, 1).
    """
    return conductivity * (porosity / porosity0) ** 3 * ((1 - porosity0) / (1 - porosity)) ** 2


def filled(p, suction):
    """Return how full the pores that drain are at a pressure p, Pa, from 0 at -`suction` to 1 at `suction`: a cubic."""
    x = ufl.max_value(0.0, ufl.min_value(1.0, (1 + p / suction) / 2))
    return x**2 * (3 - 2 * x)


@dataclass(frozen=True, eq=False)
class unsaturated:
    """A conductivity law by which water flows below a free surface only: to be given as `conductivity_law`.

    The conductivity falls from k at p = `suction` to `least` k at p = -`suction`, by a cubic without kinks (Bathe and
    Khoshgoftaar 1979).  By the same cubic pores lose their `specific_yield`; the rest is held by suction, and in the
    weight all pores are full.  The conductivity is that of the pressure at the start of each substep: steady flow is
    reached in steps of some (cell size)^2 / (coefficient of consolidation), and a surface that falls or rises passes
    less than a cell in a step.

    Parameters
    ----------
    suction
        Pa, > 0: half to once the weight of water over a cell's height.
    least
        In (0, 1).
    specific_yield
        Volume of water that drains from a volume of soil as the free surface falls through it, in [0, 1), at most the
        porosity.  With 0 a surface that falls does so at once, and the law is one of steady flow.
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
        """Return the conductivity, m/s, as UFL."""
        return conductivity * (self.least + (1 - self.least) * filled(p, self.suction))


@dataclass(frozen=True)
class Fluid:
    """Pore fluid.

    Parameters
    ----------
    bulk
        Bulk modulus K_w, Pa, > 0; infinite for an incompressible fluid.
    density
        Density rho_w at zero pressure, kg/m^3, > 0, by which its weight counts; that of flowing mass is
        rho_w exp(p / K_w).
    gravity
        Acceleration under which conductivities are what they are, m/s^2, > 0; by default that of the scene where it is
        given as a vector, which is not zero, else 9.81.  In a scene without gravity, or with one that changes with
        time, give it where lengths or times have other units than m and s.

    Raises
    ------
    ValueError
        Naming the constant that is out of its range.
    """

    bulk: float = 2.2e9
    density: float = 1000.0
    gravity: float | None = None

    def __post_init__(self):
        _check(self, "bulk", lambda v: 0 < v, "> 0")
        if self.gravity is not None:
            _check(self, "gravity", lambda v: (0 < v) & (v < inf), "> 0 and finite")
        _check(self, "density", lambda v: (0 < v) & (v < inf), "> 0 and finite")
        object.__setattr__(self, "density", float(self.density))  # an integer times gravity is no form that compiles

    @property
    def unit_weight(self) -> float:
        """Unit weight rho_w g, N/m^3, that turns a hydraulic conductivity into a mobility k/(rho_w g)."""
        return self.density * (self.gravity or STANDARD_GRAVITY)


STANDARD_GRAVITY = 9.81  # m/s^2, by which conductivities are defined.  Source: standard gravity of 1901, three digits
