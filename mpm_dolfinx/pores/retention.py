# SPDX-License-Identifier: MIT
"""Retention curves: saturation, relative permeability and Bishop's coefficient as functions of the pore pressure.

Pores contain water and air.  Air has zero pressure everywhere, so the suction is s = -p, with the pore pressure p.  At
p >= 0 the pores are saturated.  The saturation S and the relative permeability k_r are functions of p.  The soil has

    content of fluid   n S,      conductivity   k k_r,      stress   sigma = sigma' - alpha chi p

with the porosity n, the saturated conductivity k, the effective stress sigma', Biot's coefficient alpha and Bishop's
coefficient chi (Richards 1931; Bishop 1959).  In the curves of this module chi is the effective saturation
S_e = (S - S_r) / (1 - S_r), with the residual saturation S_r.

A user-defined curve is any object with the methods `saturation(p)` and `relative_permeability(p)`, which return UFL.  A
curve may have a method `bishop(p)` that returns chi; otherwise chi = S.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, fields
from functools import partial
from typing import ClassVar

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering

from mpm_dolfinx.base.tolerances import TINY
from mpm_dolfinx.base.validation import Constants, asked, line, numbers
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointExpression
from mpm_dolfinx.grid.grid import Grid

METHODS = ("saturation", "relative_permeability")


@dataclass(frozen=True)
class Retention(Constants):
    """Base of retention curves defined by an effective saturation S_e: S = S_r + (1 - S_r) S_e.

    A derived law is a frozen dataclass of numbers.  The method `effective(s)` returns S_e, and the method `conducts(s)`
    returns k_r, both as UFL of the suction s >= 0, in Pa.  S_e and k_r must be 1 at s = 0.

    Parameters
    ----------
    entry
        Suction at which pores begin to drain, Pa, > 0.
    residual
        Residual saturation S_r, in [0, 1).

    Raises
    ------
    ValueError
        A constant is out of its range.
    """

    entry: float
    residual: float = 0.0
    FOREIGN: ClassVar = {"alpha": "entry, Pa: 9810 / alpha for alpha in 1/m, or 1000 / alpha for alpha in 1/kPa"}

    def __post_init__(self):
        _number(self, "entry", lambda v: v > 0, "> 0 and finite")
        _number(self, "residual", lambda v: (0 <= v) & (v < 1), "in [0, 1)")

    @property
    def scale(self) -> float:
        """Characteristic suction of the law, in Pa."""
        return self.entry

    def bishop(self, p):
        """Return Bishop's coefficient chi at the pressure p, in Pa, as UFL."""
        return self.effective(ufl.max_value(-p, 0.0))

    def saturation(self, p):
        """Return the saturation S at the pressure p, in Pa, as UFL."""
        return self.residual + (1 - self.residual) * self.effective(ufl.max_value(-p, 0.0))

    def relative_permeability(self, p):
        """Return the relative permeability k_r at the pressure p, in Pa, as UFL."""
        return self.conducts(ufl.max_value(-p, 0.0))


@dataclass(frozen=True)
class VanGenuchten(Retention):
    """Retention curve of van Genuchten (1980), with the relative permeability of Mualem (1976).

    `S_e = (1 + x^n)^-m` and `k_r = S_e^l [1 - x^(n-1) S_e]^2`, with `x = s / entry` and `m = 1 - 1 / n`.

    Parameters
    ----------
    entry
        Characteristic suction, Pa, > 0: unit weight of water divided by van Genuchten's alpha, 1/m.
    residual
        Residual saturation S_r, in [0, 1).
    n
        Exponent, in (1, 20]; large if the pores have similar sizes.
    l
        Exponent for the connectivity of the pores.
    air_entry
        Suction below which all pores are saturated, Pa, >= 0 (Ippisch, Vogel and Bastian 2006).  A usual value is the
        pressure of a few centimetres of water.  If n < 2 and `air_entry` is zero, dk_r/ds is infinite at s = 0.
    """

    n: float = 2.0
    l: float = 0.5
    air_entry: float = 0.0

    def __post_init__(self):
        super().__post_init__()
        _number(self, "n", lambda v: (1 < v) & (v <= 20), "in (1, 20]")
        _number(self, "l", lambda v: v == v, "a finite number")
        _number(self, "air_entry", lambda v: v >= 0, ">= 0 and finite")

    @property
    def steep(self) -> bool:
        """Whether dk_r/ds is infinite at s = 0."""
        return self.n < 2 and not self.air_entry

    def _wide(self, x):
        """Return q = x^(n-1) (1 + x^n)^-m.  Mualem's relative permeability contains the factor (1 - q)^2."""
        return x ** (self.n - 1) * (1 + x**self.n) ** (1 / self.n - 1)

    def _least(self):
        """Return `air_entry / entry`, but at least `TINY` so that powers have finite derivatives."""
        return ufl.max_value(self.air_entry / self.entry, TINY)

    def effective(self, s):
        """Return S_e at the suction s, in Pa, as UFL."""
        x, least = ufl.max_value(s / self.entry, self._least()), self._least()
        return ((1 + x**self.n) / (1 + least**self.n)) ** (1 / self.n - 1)

    def conducts(self, s):
        """Return k_r at the suction s, in Pa, as UFL."""
        x, least = ufl.max_value(s / self.entry, self._least()), self._least()
        return self.effective(s) ** self.l * ((1 - self._wide(x)) / (1 - self._wide(least))) ** 2


@dataclass(frozen=True)
class Gardner(Retention):
    """Exponential retention curve: `S_e = k_r = exp(-s / entry)` (Gardner 1958; Srivastava and Yeh 1991).

    Parameters
    ----------
    entry
        Suction at which S_e = k_r = 1/e, Pa, > 0: unit weight of water divided by Gardner's alpha, 1/m.
    residual
        Residual saturation S_r, in [0, 1).
    """

    def effective(self, s):
        """Return S_e at the suction s, in Pa, as UFL."""
        return ufl.exp(-s / self.entry)

    conducts = effective


@dataclass(frozen=True)
class BrooksCorey(Retention):
    """Power law: `S_e = (s / entry)^-index` and `k_r = S_e^(3 + 2 / index)` (Brooks and Corey 1964).

    Parameters
    ----------
    entry
        Suction below which all pores are saturated, Pa, > 0.
    residual
        Residual saturation S_r, in [0, 1).
    index
        Exponent, in (0, 20]; large if the pores have similar sizes.
    """

    index: float = 2.0

    def __post_init__(self):
        super().__post_init__()
        _number(self, "index", lambda v: (0 < v) & (v <= 20), "in (0, 20]")

    def effective(self, s):
        """Return S_e at the suction s, in Pa, as UFL."""
        return ufl.max_value(s / self.entry, 1.0) ** (-self.index)

    def conducts(self, s):
        """Return k_r at the suction s, in Pa, as UFL."""
        return ufl.max_value(s / self.entry, 1.0) ** (-2 - 3 * self.index)


def _number(law: Retention, name: str, test: Callable, allowed: str) -> None:
    """Raise ValueError if a constant of a law is out of its range."""
    what = f"{type(law).__name__}: {name}"
    numbers(what, getattr(law, name), test=lambda v: np.isfinite(v) & test(v), allowed=allowed)


def check_retention(what: str, law) -> None:
    """Raise ValueError if a retention curve is invalid."""
    missing = [name for name in METHODS if not callable(getattr(law, name, None))]
    if missing:
        raise ValueError(f"{what} = {line(law)}, must have {' and '.join(f'{name}(p)' for name in METHODS)}")
    try:
        scale = scale_of(law)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error
    suctions = scale * np.concatenate([[-1.0, 0.0], np.exp2(np.arange(-8, 3))])
    for name in METHODS:
        values = np.array([_value(getattr(law, name), -s) for s in suctions])
        good = (values[:2] == 1).all() and (values >= 0).all() and (np.diff(values) <= 0).all()
        if not good:
            shown = ", ".join(f"{value:.3g}" for value in values)
            where = ", ".join(f"{-s:.3g}" for s in suctions)
            allowed = "must be 1 for p >= 0, must not increase with suction, and must not be negative"
            raise ValueError(f"{what}: {name} is {shown} at p = {where} Pa, {allowed}")


def sampled(law) -> list[float]:
    """Return the values of S and k_r that a law has at some suctions, and these suctions, in Pa."""
    suctions = scale_of(law) * np.exp2(np.arange(-2, 3))
    return [_value(getattr(law, name), -s) for name in METHODS for s in suctions] + suctions.tolist()


def _value(function: Callable, p: float) -> float:
    """Return the value of a UFL function of the pressure at the pressure p, in Pa."""
    return float(apply_algebra_lowering(ufl.as_ufl(function(ufl.as_ufl(float(p)))))(()))


def chi_at(law, p: float) -> float:
    """Return Bishop's coefficient chi at a pressure, in Pa."""
    return _value(partial(property_of, law, "bishop"), p)


def _empty(function: Callable, suction: float) -> bool:
    """Return whether a function (S or k_r) is at most 0.5, or nan, at a suction in Pa."""
    try:
        return not _value(function, -suction) > 0.5
    except OverflowError:
        return True


def scale_of(law) -> float:
    """Return the characteristic suction of a law, in Pa.

    If the law has no attribute `scale`, the result is approximately the suction at which S = 0.5.  If S is always above
    0.5, the result is the suction at which k_r = 0.5.
    """
    if (scale := getattr(law, "scale", None)) is not None:
        return float(numbers(f"{line(law)}: scale", scale, test=lambda v: v > 0, allowed="> 0"))
    for name in METHODS:
        suction = 1.0
        half = partial(_empty, getattr(law, name))
        while half(suction) and suction > TINY:
            suction /= 2
        while not half(suction) and suction < 1 / TINY:
            suction *= 2
        if half(suction):
            return suction
    raise ValueError(f"{line(law)}: saturation must fall to 0.5 at some suction, or the law must have a `scale`, Pa")


class Retentions:
    """Retention curves of a scene, as UFL expressions of fields at the integration points.

    The points have the field `retention`.  The first entry of this field is the number of the law's class (1, 2, ...),
    or 0 if the pores stay saturated.  The other entries are the constants of the law.  Pieces also have the field
    `lever`, the vector to the piece from the centroid of the material in its cell.  The pressure of a piece is the cell
    pressure plus the hydrostatic difference along `lever`.

    `laws`: distinct retention curves of the scene's materials.
    `everywhere`: whether every material has a retention curve.
    """

    def __init__(self, laws: Sequence, everywhere: bool, grid: Grid):
        self.weight = fem.Constant(grid.mesh, np.zeros(grid.dim))
        """Unit weight of the fluid at the last reset of the grid, in N/m^3; zero if no fluid can flow."""
        self.laws = list(laws)
        self._everywhere = everywhere
        self._kinds = list(dict.fromkeys(type(law) if isinstance(law, Retention) else law for law in self.laws))
        self._first = [next(law for law in self.laws if self._kind(law) == i) for i in range(len(self._kinds))]
        self.width = 1 + max(len(_constants(law)) for law in self.laws)
        """Number of entries of the field `retention`."""

    def _kind(self, law) -> int:
        return self._kinds.index(type(law) if isinstance(law, Retention) else law)

    def row(self, law) -> NDArray[np.float64]:
        """Return the values of the field `retention` for a law, or for saturated soil (None)."""
        out = np.ones(self.width)
        out[0] = 0 if law is None else 1 + self._kind(law)
        if law is not None:
            constants = _constants(law)
            out[1 : 1 + len(constants)] = [getattr(law, name) for name in constants]
        return out

    def number(self, law) -> int:
        """Return the index of a law among `laws`, counted from 1, or 0 for saturated soil (None)."""
        return 0 if law is None else 1 + self.laws.index(law)

    def heads(self, lever: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressure of each piece minus the pressure of its cell, in Pa."""
        return lever @ self.weight.value

    def at(self, p, points: FormPoints):
        """Return the pressures of the points, in Pa, as UFL.  `p`: pressures of their cells, in Pa."""
        return p + ufl.dot(self.weight, points.lever) if "lever" in points.sizes else p

    def of(self, name: str, p, points: FormPoints):
        """Return a property of the pores at integration points as UFL.

        Parameters
        ----------
        name
            "saturation", "relative_permeability" or "bishop".
        p
            Pressures of the cells of the points, Pa.
        points
            Integration points with the field `retention`.  Pieces also need the field `lever`.
        """
        row = points.retention
        p = self.at(p, points)
        values = [property_of(_lifted(of, [row[1 + i] for i in range(self.width - 1)]), name, p) for of in self._first]
        out = values.pop(0) if self._everywhere else 1.0
        first = 2 if self._everywhere else 1
        for number, value in enumerate(values, first):
            out = ufl.conditional(ufl.eq(row[0], number), value, out)
        return out


def _constants(law) -> list[str]:
    """Return the names of the constants of a retention curve, or an empty list for a user-defined curve."""
    return [f.name for f in fields(law)] if isinstance(law, Retention) else []


def _lifted(law, values: Sequence):
    """Return a copy of a law, in which UFL values replace the constants."""
    out = copy(law)
    if isinstance(law, Retention):
        vars(out).update(zip(_constants(law), values, strict=False))
    return out


def property_of(law, name: str, p):
    """Return a property of a law at the pressure p, in Pa, as UFL."""
    if name == "bishop" and not hasattr(law, "bishop"):
        name = "saturation"
    return _called(law, name, p)


def _called(law, name: str, p):
    """Return the result of the method `name` of a law, as UFL."""
    what = f"{line(law)}: {name}"
    out = asked(what, "UFL of p", lambda: ufl.as_ufl(getattr(law, name)(p)))
    if out.ufl_shape:
        raise ValueError(f"{what} has shape {out.ufl_shape}, must be a scalar")
    return out


class SaturationAt:
    """Numerical values of saturation, its derivative, Bishop's coefficient and relative permeability."""

    def __init__(self, grid: Grid, retentions: Retentions):
        self._points = points = FormPoints(grid, p=(), retention=(retentions.width,))
        p = ufl.variable(points.p)
        names = ("saturation", "bishop", "relative_permeability")
        S, chi, k = (retentions.of(name, p, points) for name in names)
        self._values = PointExpression(ufl.as_vector([S, ufl.diff(S, p), chi, k]), points)

    def __call__(
        self, rows: NDArray[np.float64], p: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return S, dS/dp, chi and k_r at pressures p (n,), in Pa.

        `rows` (n, width): values of the field `retention` at n points.
        """
        data = anywhere(self._points, p=p, retention=rows)
        S, slope, chi, k = self._values.evaluate(data).T
        return S, slope, chi, k


def anywhere(points: FormPoints, **fields: NDArray[np.float64]) -> PointData:
    """Return points with the given fields, for expressions of these fields only.  Their positions are placeholders."""
    count = len(next(iter(fields.values())))
    cells = np.zeros(count, dtype=np.int32)
    return points.at(cells, points.grid.midpoints[cells], np.ones(count), **fields)


class Conductance:
    """Integral of the relative permeability with respect to pressure, the potential of flow (Kirchhoff 1894).

    Cubic Hermite polynomials interpolate between tabulated values, which are equidistant in the logarithm of suction.
    """

    def __init__(self, grid: Grid, law):
        self.scale = scale_of(law)
        points = FormPoints(grid, p=())
        k_r = PointExpression(_called(law, "relative_permeability", points.p), points)
        edges = np.exp(np.linspace(*np.log(self.scale * np.array(REACH)), ROWS))
        self._low, self._step = np.log(edges[0]), np.log(edges[1] / edges[0])
        middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
        x, w = np.polynomial.legendre.leggauss(GAUSS)
        at = np.concatenate([edges, (middle[:, None] + half[:, None] * x).ravel()])
        values = k_r.evaluate(anywhere(points, p=-at))
        self._k, inside = values[:ROWS], values[ROWS:].reshape(ROWS - 1, GAUSS)
        parts = half * (inside @ w)
        self._phi = np.append(np.cumsum(parts[::-1])[::-1], 0.0)
        self._whole = self._phi[0] + edges[0] * (1 + self._k[0]) / 2
        self._slope = -self._k * edges * self._step  # derivative of the integral with respect to the row number
        self._edges = edges

    def __call__(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the integral, k_r and dk_r/dp at pressures p, in Pa, as columns."""
        s = np.clip(-p, self._edges[0], self._edges[-1])
        z = (np.log(s) - self._low) / self._step
        i = np.minimum(z.astype(np.int64), ROWS - 2)
        z = z - i
        a, b = self._phi[i], self._phi[i + 1]
        c, d = self._slope[i], self._slope[i + 1]
        # the cubic a + c z + e z^2 + f z^3 in the distance z from the lower row
        e, f = 3 * (b - a) - 2 * c - d, 2 * (a - b) + c + d
        phi = a + z * (c + z * (e + z * f))
        first, second = c + z * (2 * e + 3 * z * f), 2 * e + 6 * z * f
        by = 1 / (s * self._step)
        k, slope = np.maximum(-first * by, 0.0), (second * by - first / s) * by
        out = np.stack([phi, k, slope], axis=1)
        wet = -p < self._edges[0]
        out[wet] = np.stack([self._whole + p, np.ones(len(p)), np.zeros(len(p))], axis=1)[wet]
        out[-p > self._edges[-1], 1:] = 0.0
        return out


REACH = (1e-8, 1e8)
"""Range of tabulated suctions, divided by `scale`.  Source: outside this range k_r is 1 or 0, exact to 1e-8."""
ROWS = 4000
"""Number of tabulated suctions.  Sensitivity (scene "dry" of tests/plateaus.py): half this value changes the result by
2.1e-08, and twice this value by 2.6e-09.  Finer cells change it by 6.6e-03.
"""
GAUSS = 8
"""Number of quadrature points between two tabulated suctions.  Sensitivity (scene "dry" of tests/plateaus.py): half
this value changes the result by 8.2e-10, and twice this value by 1.5e-09.  Finer cells change it by 6.6e-03.
"""


def logarithm(p: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `arcsinh(p / scale)` at negative pressures p, and `p / scale` at positive pressures, both in Pa."""
    return np.where(p < 0, np.arcsinh(p / scale), p / scale)


def pressure_at(y: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pressures, in Pa, at which `logarithm` has the values y."""
    return scale * np.where(y < 0, np.sinh(np.minimum(y, 0.0)), y)


FARTHEST = np.log(10)
"""Largest change of the natural logarithm of the suction in a Newton step.

Without this limit, fronts in dry soil do not converge.  With the limit 2, the column of Celia (1990) takes 310 Newton
steps with 25 cells, and 500 with 100 cells.  With the limit 4, it takes 330 and 920 Newton steps.

Sensitivity (scene "dry" of tests/plateaus.py): half this value changes the result by 7.6e-10, and twice this value by
9.8e-10. Finer cells change it by 6.6e-03.
"""


def restrained(
    p: NDArray[np.float64],
    dp: NDArray[np.float64],
    scale: NDArray[np.float64] | float,
    previous: NDArray[np.float64] | float = 0.0,
) -> NDArray[np.float64]:
    """Return the limited pressure decreases (n,) of a Newton step, in Pa.

    A step across the characteristic suction ends at this suction.  On each side of the characteristic suction the
    saturation is convex or concave, so that Newton's method converges (Wang and Tchelepi 2013).  The logarithm of the
    suction changes by at most `FARTHEST`.  A change of opposite sign to the previous change is at most half as large.

    `p` (n,), in Pa: pressures.
    `dp` (n,), in Pa: decreases of the pressures in the Newton step without limits.
    `scale` (n,), in Pa: characteristic suctions.
    `previous` (n,): changes of `logarithm` in the previous Newton step.
    """
    new, limit = p - dp, -scale
    new = np.where((p - limit) * (new - limit) < 0, limit, new)
    old, y = logarithm(p, scale), logarithm(new, scale)
    most = np.where(previous * (y - old) < 0, np.minimum(np.abs(previous) / 2, FARTHEST), FARTHEST)
    far = (np.abs(y - old) > most) & (np.minimum(old, y) < 0)
    y = old + np.clip(y - old, -most, most)
    new = np.where(far, pressure_at(y, scale), new)
    return np.where(new == p - dp, dp, p - new)
