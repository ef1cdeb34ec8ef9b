# SPDX-License-Identifier: MIT
"""Exact solutions for comparison: consolidation, columns, beams and rods.  This module does not import dolfinx.

Stress is positive in tension, and pore pressure in compression.  The dimensionless time of consolidation is T = c_v t /
length².  Solutions are series of exponentials, which converge slowly for small T.  For T < `SWITCH` a closed form
replaces the series: the inverse Laplace transform of the solution, with 1 in place of tanh sqrt(s) and coth sqrt(s).
The errors of both are at most of the order of erfc(1/sqrt(`SWITCH`)) < 2e-23, which is below rounding errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipkinc, ellipkm1, erf, erfc, erfcx, lambertw

from mpm_dolfinx.base.tolerances import EPSILON, ROUND_OFF, SAME, TINY

SWITCH = 0.02  # dimensionless time below which the closed form is used.  Source: both forms are exact
TERMS = 20  # number of exponentials.  Source: exact bound, the last term is below exp(-70)
Array = NDArray[np.float64]


def _check(ok, name: str, value: ArrayLike, allowed: str) -> None:
    if not np.all(ok):
        bad = np.broadcast_to(value, np.shape(ok))[np.logical_not(ok)].flat[0]
        raise ValueError(f"{name} = {bad:.12g}: must be {allowed}")


def _positive(**values) -> None:
    for name, value in values.items():
        _check(np.greater(value, 0), name, value, "> 0")


def _within(name: str, value: ArrayLike, upper: float) -> Array:
    array = np.asarray(value, dtype=float)
    _check((array >= 0) & (array <= upper), name, array, f"in [0, {upper:g}]")
    return array


def _by_time(short, long, T: ArrayLike) -> Array:
    """Return the values of the function `short` where T < `SWITCH`, and of the function `long` elsewhere."""
    T = np.asarray(T)
    return np.where(T < SWITCH, short(np.minimum(T, SWITCH)), long(np.maximum(T, SWITCH)))[()]


def _series(amplitudes: Array, roots: Array, T: Array) -> Array:
    return (amplitudes * np.exp(-(roots**2) * T[..., None])).sum(-1)


def _transient(k: complex, z: ArrayLike, T: Array) -> NDArray:
    """Return the inverse Laplace transform of exp(-z X) / (X (X - k)), X = sqrt(s); Abramowitz & Stegun 29.3.90."""
    return np.exp(-np.square(z) / (4 * T)) * erfcx(z / (2 * np.sqrt(T)) - k * np.sqrt(T))


def terzaghi_pressure(z: ArrayLike, t: ArrayLike, height: float, cv: float, p0: float = 1.0) -> Array:
    """Return the pore pressure of a layer that drains at one end only.

    Parameters
    ----------
    z : (...), m, in [0, height]; distance from the drained end; z and t are broadcast
    t : (...), s, > 0; time since the pressure was p0 everywhere
    height : m, > 0; length of the layer
    cv : m²/s, > 0; coefficient of consolidation kappa / (S + alpha²/(K + 4G/3))
    p0 : Pa; pressure at t = 0+

    Returns (...), Pa. Source: Terzaghi (1923); series for all T: Verruijt, Theory and Problems of Poroelasticity.
    """
    _positive(height=height, cv=cv, t=t)
    zeta, T = np.broadcast_arrays(_within("z", z, height) / height, cv * np.asarray(t, dtype=float) / height**2)
    m = (np.arange(TERMS) + 0.5) * np.pi
    return p0 * _by_time(
        lambda T: erf(zeta / (2 * np.sqrt(T))) - erfc((2 - zeta) / (2 * np.sqrt(T))),
        lambda T: _series(2 / m * np.sin(m * zeta[..., None]), m, T),
        T,
    )


def terzaghi_consolidation(t: ArrayLike, height: float, cv: float) -> Array:
    """Return the degree of consolidation: the settlement since t = 0+, divided by the final settlement.

    Parameters as for `terzaghi_pressure`: t (...), s, > 0; height, m, > 0; cv, m²/s, > 0.
    Returns (...), in (0, 1]. Source: Terzaghi (1923); Verruijt.
    """
    _positive(height=height, cv=cv, t=t)
    m = (np.arange(TERMS) + 0.5) * np.pi
    T = cv * np.asarray(t, dtype=float) / height**2
    return _by_time(lambda T: 2 * np.sqrt(T / np.pi), lambda T: 1 - _series(2 / m**2, m, T), T)


@dataclass(frozen=True)
class Mandel:
    """Mandel's slab in plane strain, loaded by rigid smooth plates and drained at its lateral sides.

    The model is a quarter of the slab, with symmetry at x = 0 and y = 0.  The plate is at y = b, and the drained side
    is at x = a.

    Parameters
    ----------
    a, b : m, > 0; width and height of the quarter: half the width and half the height of the slab
    bulk, shear : Pa, > 0; drained moduli K (in three dimensions) and G
    mobility : m²/(Pa s), > 0; kappa = permeability / viscosity = conductivity / (density of the fluid * g)
    storage : 1/Pa, >= 0; storage coefficient S at constant strain, n/K_w + (alpha - n)/K_s
    alpha : in (0, 1]; Biot's coefficient
    force : N/m; resultant on the plate of width a, per metre of depth, positive in compression

    Source: Mandel (1953), Géotechnique 3; Cheng & Detournay (1988), International Journal for Numerical and Analytical
    Methods in Geomechanics 12; Abousleiman and others (1996), Géotechnique 46.
    """

    a: float
    b: float
    bulk: float
    shear: float
    mobility: float
    storage: float = 0.0
    alpha: float = 1.0
    force: float = 1.0

    def __post_init__(self):
        _positive(a=self.a, b=self.b, bulk=self.bulk, shear=self.shear, mobility=self.mobility)
        _check(self.storage >= 0, "storage", self.storage, ">= 0")
        _check(0 < self.alpha <= 1, "alpha", self.alpha, "in (0, 1]")

    @property
    def _oedometric(self) -> float:
        return self.bulk + 4 / 3 * self.shear

    @property
    def cv(self) -> float:
        """Coefficient of consolidation kappa / (S + alpha²/(K + 4G/3)), m²/s."""
        return self.mobility / (self.storage + self.alpha**2 / self._oedometric)

    @property
    def nu_undrained(self) -> float:
        """Undrained Poisson ratio, for the moduli G and K + alpha²/S; 0.5 for S = 0."""
        bulk, shear = self.bulk * self.storage + self.alpha**2, self.shear * self.storage
        return (3 * bulk - 2 * shear) / (6 * bulk + 2 * shear)

    @property
    def skempton(self) -> float:
        """Skempton's coefficient B = alpha / (alpha² + K S)."""
        return self.alpha / (self.alpha**2 + self.bulk * self.storage)

    @property
    def _ratio(self) -> float:
        """The ratio (1 - nu)/(nu_u - nu) > 1, computed without cancellation."""
        return 1 + (self.bulk / self.shear + 1 / 3) * (1 + self._oedometric * self.storage / self.alpha**2)

    @cached_property
    def roots(self) -> Array:
        """The first `TERMS` positive roots of tan(r) = r (1 - nu)/(nu_u - nu)."""
        n = np.arange(TERMS) * np.pi
        r = n + np.pi / 2
        for _ in range(50):  # Newton's method is monotone for a convex function from its positive side
            r = r - (r - n - np.arctan(self._ratio * r)) / (1 - self._ratio / (1 + (self._ratio * r) ** 2))
        return r

    def pressure(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the pore pressure, which is independent of y.

        x : (...), m, in [0, a]; distances from the middle; x and t are broadcast
        t : (...), s, > 0; times

        Returns (...), Pa; at t = 0+ the pressure is B (1 + nu_u) force / (3 a). Source: see the class.
        """
        return self._pressures(x, t)[0]

    def displacement(self, x: ArrayLike, y: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
        """Return the displacement relative to the state without force.

        x : (...), m, in [0, a]; positions; x and t are broadcast
        y : (...), m, in [0, b]; positions; y and t are broadcast
        t : (...), s, > 0; times

        Returns (u_x, u_y), m; u_x is independent of y, and u_y is independent of x. Source: computed from the pressure
        and the force on the plate, with zero total stress at the lateral side.
        """
        x, y = np.asarray(x, dtype=float), _within("y", y, self.b)
        plane = self.bulk + self.shear / 3  # lambda + G
        load = self.force / self.a * self._oedometric / (2 * self.shear)
        strain = (self.alpha * self._pressures(self.a, t)[1] - load) / (2 * plane)
        lateral = self.alpha * self._pressures(x, t)[1] * self.a - (plane - self.shear) * strain * x
        return lateral / self._oedometric, strain * y

    def _pressures(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the pressure, and its integral from 0 to x, divided by a; both in Pa."""
        _positive(t=t)
        xi, T = np.broadcast_arrays(_within("x", x, self.a) / self.a, self.cv * np.asarray(t, dtype=float) / self.a**2)
        p0 = self.skempton * (1 + self.nu_undrained) * self.force / (3 * self.a)
        return p0 * _by_time(lambda T: self._short(xi, T), lambda T: self._long(xi, T), T)

    def _long(self, xi: Array, T: Array) -> Array:
        r, xi = self.roots, xi[..., None]
        shapes = np.stack([np.cos(r * xi) - np.cos(r), np.sin(r * xi) / r - xi * np.cos(r)])
        return _series(2 * np.sin(r) / (r - np.sin(r) * np.cos(r)) * shapes, r, T)

    def _short(self, xi: Array, T: Array) -> Array:
        k = 1 / self._ratio
        e0, e1, e2 = (_transient(k, z, T) for z in (0, 1 - xi, 1 + xi))
        i1, i2 = ((e - erfc(z / (2 * np.sqrt(T)))) / k for e, z in ((e1, 1 - xi), (e2, 1 + xi)))  # divided by X
        return np.stack([e0 - e1 - e2, xi * e0 - i1 + i2])


def cryer_pressure(t: ArrayLike, radius: float, cv: float, nu: float, p0: float = 1.0) -> Array:
    """Return the pore pressure at the centre of a sphere that is loaded and drained at its surface.

    Parameters
    ----------
    t : (...), s, > 0; time
    radius : m, > 0; radius of the sphere
    cv : m²/s, > 0; coefficient of consolidation kappa (K + 4G/3) with incompressible fluid and grains
    nu : in (-1, 0.5); drained Poisson ratio
    p0 : Pa; uniform pressure on the surface, equal to the pore pressure at t = 0+

    Returns (...), Pa. Source: Cryer (1963), Quarterly Journal of Mechanics and Applied Mathematics 16; Verruijt.
    """
    _positive(radius=radius, cv=cv, t=t)
    _check(-1 < nu < 0.5, "nu", nu, "in (-1, 0.5)")
    mu = 2 * (1 - 2 * nu) / (1 - nu)  # 4G/(K + 4G/3)
    T = cv * np.asarray(t, dtype=float) / radius**2
    return p0 * _by_time(lambda T: _cryer_short(mu, T), lambda T: _cryer_long(mu, T), T)


def _cryer_short(mu: float, T: Array) -> Array:
    """Return the inverse Laplace transform of (1 - 2 X exp(-X)) / (X² - mu X + mu), X = sqrt(s)."""
    k = (mu + 1j * np.sqrt(mu * (4 - mu))) / 2
    uniform = (k * _transient(k, 0, T)).imag / k.imag
    gauss = np.exp(-1 / (4 * T)) / np.sqrt(np.pi * T)
    return uniform - 2 * (gauss + (k**2 * _transient(k, 1, T)).imag / k.imag)


def _cryer_long(mu: float, T: Array) -> Array:
    def zero(x):  # (1 - x²/mu) tan(x) = x
        return x * np.cos(x) - (1 - x**2 / mu) * np.sin(x)

    r = np.array([brentq(zero, max(n * np.pi, EPSILON**0.25), (n + 1) * np.pi, xtol=ROUND_OFF) for n in range(TERMS)])
    return _series(2 * (np.sin(r) - r) / ((2 - mu) * np.sin(r) + r * np.cos(r)), r, T)


@dataclass(frozen=True)
class SelfWeightColumn:
    """Column of Hencky's material without lateral strain, standing at Y = 0 under its own weight.

    Without lateral stretch, the Cauchy stress and the first Piola-Kirchhoff stress along the column are both tau /
    stretch.  This stress balances the weight of the column above Y.  For nu = 0, K + 4G/3 equals Young's modulus.

    Parameters
    ----------
    l0 : m, > 0; height without gravity
    bulk, shear : Pa, > 0; moduli K and G of tau = (K + 4G/3) ln(stretch)
    density : kg/m³, > 0; density without gravity
    gravity : m/s², > 0; downwards

    Source: tau / stretch = -density gravity (l0 - Y), solved with Lambert's W; Corless and others (1996), Advances in
    Computational Mathematics 5.
    """

    l0: float
    bulk: float
    shear: float
    density: float
    gravity: float

    def __post_init__(self):
        _positive(**vars(self))

    def _shortening(self, Y: ArrayLike) -> Array:
        """Return -ln(stretch) = w, the solution of w exp(w) = (weight above Y) / (K + 4G/3)."""
        return lambertw(-self.stress(Y) / (self.bulk + 4 / 3 * self.shear)).real

    def stress(self, Y: ArrayLike) -> Array:
        """Return the vertical Cauchy stress (...), in Pa, at reference heights Y (...), in m, from 0 to l0."""
        return -self.density * self.gravity * (self.l0 - _within("Y", Y, self.l0))

    def stretch(self, Y: ArrayLike) -> Array:
        """Return the stretch (...), in (0, 1], at reference heights Y (...), in m, from 0 to l0.

        Source: see the class.
        """
        return np.exp(-self._shortening(Y))

    def position(self, Y: ArrayLike) -> Array:
        """Return the present heights (...), in m, at reference heights Y (...), in m, from 0 to l0.

        Source: integral of the stretch.
        """
        base, w = self._shortening(0.0), self._shortening(Y)
        return self.l0 * (base - w) * (1 + (base + w) / 2) / (base * np.exp(base))

    @property
    def height(self) -> float:
        """Present height of the column, m."""
        return float(self.position(self.l0))


def elastica_tip(load_parameter: float) -> tuple[float, float]:
    """Return the tip displacement of an inextensible cantilever under a dead transverse load at its tip.

    load_parameter : in [0, 1e5]; P L²/(E I), with the load P, the length L and the bending stiffness E I

    Returns (shortening u/L, deflection v/L), with absolute errors of 1e-12.

    Source: Bisshopp & Drucker (1945), Quarterly of Applied Mathematics 3.
    """
    _check(0 <= load_parameter <= 1e5, "load_parameter", load_parameter, "in [0, 1e5]")
    if load_parameter < EPSILON**0.25:
        return load_parameter**2 / 15, load_parameter / 3
    root = np.sqrt(load_parameter)

    def angles(q):  # for a rotation of the tip with the sine 1 - exp(-q)
        return np.exp(-q) / 2, np.arctan2(1, np.sqrt(-np.expm1(-q)))

    def excess(q):
        m1, theta = angles(q)
        return ellipkm1(m1) - ellipkinc(theta, 1 - m1) - root

    m1, theta = angles(q := brentq(excess, 0, 2 * root, xtol=TINY, rtol=4 * EPSILON))
    v = 1 - 2 / root * (ellipe(1 - m1) - ellipeinc(theta, 1 - m1))
    return float(1 - np.sqrt(-2 * np.expm1(-q)) / root), float(v)


def shear_flexible_rod(
    length: float, EA: float, GA: float, EI: float, end_load: float = 0, line_load: float = 0, points: ArrayLike = 101
) -> Array:
    """Return the deformed axis of a geometrically exact planar cantilever with stretch and shear.

    The rod lies along x from its clamp at the origin. Loads are dead loads, positive along +y.

    Parameters
    ----------
    length : m, > 0
    EA : N (N/m in plane strain), > 0, may be inf; axial stiffness
    GA : N (N/m in plane strain), > 0, may be inf; shear stiffness, with the shear correction factor
    EI : N m² (N m in plane strain), > 0; bending stiffness
    end_load : N; force at the end
    line_load : N/m; force per reference length
    points : number of equidistant points from end to end, >= 2, or reference arclengths (n,), m, in [0, length]

    Returns positions (n, 2), in m, by collocation with a residual of 1e-8.

    Source: Reissner (1972), ZAMP 23; Simo (1985), CMAME 49.
    """
    _positive(length=length, EA=EA, GA=GA, EI=EI)
    _check(np.isfinite([end_load, line_load]), "end_load, line_load", [end_load, line_load], "finite")
    _check(np.ndim(points) or points >= 2, "points", points, "at least 2, or arclengths")
    points = points if np.ndim(points) else np.linspace(0, length, points)
    s = _within("points", points, length) / length
    loads = np.array([end_load * length**2, line_load * length**3]) / EI
    return length * _rod(loads, EI / (EA * length**2), EI / (GA * length**2))(s)[:2].T


def _rod(loads: Array, axial: float, shear: float):
    """Return a function of arclength for x, y, rotation and moment of a rod with length 1 and bending stiffness 1."""
    s, state = np.linspace(0, 1, 41), np.zeros((4, 41))
    state[0] = s

    def slope(s, state):
        force = part * (loads[0] + loads[1] * (1 - s))
        cos, sin = np.cos(state[2]), np.sin(state[2])
        stretch, slip = 1 + axial * force * sin, shear * force * cos
        x = stretch * cos - slip * sin
        return np.array([x, stretch * sin + slip * cos, state[3], -force * x])

    for part in np.linspace(0, 1, 1 + max(1, int(np.ceil(np.abs(loads).sum() / 2))))[1:]:
        solution = solve_bvp(slope, lambda a, b: np.append(a[:3], b[3]), s, state, tol=SAME, max_nodes=2**14)
        if not solution.success:
            raise RuntimeError(f"rod under {part:.3g} times its load: {solution.message}")
        s, state = solution.x, solution.y
    return solution.sol


def euler_bernoulli(x: ArrayLike, load: float, length: float, modulus: float, second_moment: float) -> NDArray:
    """Return the deflections (n,), in m, of a cantilever under a uniform load.

    The deflection is w x^2 (6 L^2 - 4 L x + x^2) / (24 E I).

    x : (n,), m; distances from the clamp
    load : N/m; load w, of any sign
    length : m, > 0; length L
    modulus : Pa, > 0; Young's modulus E
    second_moment : m^4, > 0; second moment of area I
    """
    x = np.asarray(x, dtype=float)
    return load * x**2 * (6 * length**2 - 4 * length * x + x**2) / (24 * modulus * second_moment)  # Source: exact
